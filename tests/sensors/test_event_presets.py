"""Presets named after sensors, and the settings of pixels as a file has them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import yaml

from neurosim_core.config import ConfigError, SimulationConfig, load_config, to_yaml
from neurosim_core.sensors.event_config import EventCameraConfig, LeakConfig
from neurosim_core.sensors.event_noise_model import terms_of
from neurosim_core.sensors.event_presets import PRESETS
from neurosim_core.sensors.events import EventCamera


def load(pixel: dict[str, object]) -> SimulationConfig:
    return load_config({"sensors": {"dvs": {"kind": "event_camera", "pixel": pixel}}})


def pixel_of(config: SimulationConfig) -> EventCameraConfig:
    return config.sensors["dvs"].pixel


@pytest.mark.parametrize("name", PRESETS)
def test_presets_survive_a_file(name):
    config = load({"preset": name})
    pixel = pixel_of(config)
    assert pixel == EventCameraConfig(preset=name)
    assert terms_of(pixel) or pixel.readout is not None
    for comments in (False, True):
        assert load_config(yaml.safe_load(to_yaml(config, comments=comments))) == config
    assert len(PRESETS[name].sources) > 20


def test_contrasts_are_logarithms():
    """Published contrasts are relative steps of light: DAVIS240C 11 %, DVS128 17 %."""
    assert EventCameraConfig(preset="davis240c").threshold_on == pytest.approx(math.log(1.11), abs=1e-4)
    assert EventCameraConfig(preset="dvs128").threshold_off == pytest.approx(math.log(1.17), abs=1e-4)
    k1 = EventCameraConfig(preset="voltmeter_dvs346").stochastic.k1
    assert 1.0 / k1 == pytest.approx(0.19, abs=1e-3)  # its threshold, in log radiance


def test_v2e_is_as_published():
    """`set_dvs_params` of its code: clean has mismatch alone, noisy no refractory time."""
    clean, noisy = (EventCameraConfig(preset=f"v2e_{name}") for name in ("clean", "noisy"))
    assert terms_of(clean) == ("spread",)
    assert (clean.threshold_on, clean.threshold_off, clean.threshold_spread.sigma_on) == (0.2, 0.2, 0.02)
    assert (noisy.threshold_on, noisy.threshold_off, noisy.threshold_spread.sigma_off) == (0.2, 0.2, 0.05)
    assert (noisy.low_pass.cutoff_hz, noisy.leak.rate_hz, noisy.shot_noise.rate_hz) == (30.0, 0.1, 5.0)
    assert (noisy.leak.spread_decades, noisy.shot_noise.spread_decades) == (0.1, 0.0)
    assert (clean.refractory_s, noisy.refractory_s) == (0.0, 0.0)


def test_single_keys_win():
    pixel = pixel_of(
        load({"preset": "v2e_noisy", "threshold_on": 0.3, "leak": {"rate_hz": 0.7}, "shot_noise": None})
    )
    assert pixel.threshold_on == 0.3
    assert pixel.leak == LeakConfig(rate_hz=0.7, spread_decades=0.1)
    assert pixel.shot_noise is None
    assert pixel.low_pass.cutoff_hz == 30.0
    later = load_config(
        {"sensors": {"dvs": {"kind": "event_camera", "pixel": {"preset": "v2e_noisy"}}}},
        overrides={"sensors.dvs.pixel.low_pass.cutoff_hz": 99.0},
    )
    assert pixel_of(later).low_pass.cutoff_hz == 99.0
    assert pixel_of(later).leak.rate_hz == 0.1


def test_noise_of_ones_own_takes_the_place_of_measured_noise():
    assert EventCameraConfig(preset="davis346").measured_noise is not None
    assert EventCameraConfig(preset="davis346", shot_noise=None).measured_noise is None
    assert EventCameraConfig(preset="davis346", shot_noise={"rate_hz": 2.0}).measured_noise is None


def test_settings_explain_themselves():
    """Also the groups that are off say what they would take."""
    text = to_yaml(load({}), comments=True)
    for key in ("threshold_spread", "low_pass", "leak", "shot_noise", "measured_noise", "hot_pixels"):
        above = text[: text.index(f"      {key}: null")].splitlines()
        assert above[-1].strip().startswith("#")
        assert any("{" in line for line in above[-3:]), key
    text = to_yaml(load({"preset": "davis346"}), comments=True)
    assert "# Events a second and pixel in a still scene, in the dark [Hz]." in text


@pytest.mark.parametrize(
    ("pixel", "message"),
    [
        ({"preset": "davis347"}, "unknown preset 'davis347', known: dvs128, davis240c"),
        ({"leak": {"rate": 1.0}}, "leak.rate: unknown key; did you mean 'rate_hz'"),
        ({"preset": "voltmeter_dvs346", "leak": {}}, "leak must be null where stochastic is given"),
        (
            {"preset": "voltmeter_dvs346", "stochastic": {"k2": 0.0}},
            "k3 / (2 sqrt(k2)) + k6, the largest noise",
        ),
        ({"readout": {"bandwidth_hz": 1.0}}, "queue_length must be at most 60 s of bandwidth_hz = 1"),
        ({"shot_noise": {"rate_hz": -1.0}}, "shot_noise.rate_hz: Input should be greater than or equal to 0"),
    ],
)
def test_mistakes_are_named(pixel, message):
    with pytest.raises(ConfigError, match=r"sensors\.dvs\.pixel") as error:
        load(pixel)
    assert message in str(error.value)


def test_darkness_and_glare_stay_finite(device):
    """The whole range of log radiance that is accepted, in both laws."""
    samples = np.array([0.0, -1000.0, 1000.0, -1000.0, 0.0, 1000.0], np.float32).reshape(-1, 1, 1)
    for config in (
        EventCameraConfig(preset="v2e_noisy", low_pass={"dark_radiance": 0.0}),
        EventCameraConfig(preset="voltmeter_dvs346", stochastic={"k2": 0.0, "k3": 0.0}),
        EventCameraConfig(preset="gen3", readout=None),
    ):
        camera = EventCamera(config, width=1, height=1, device=device)
        camera.reset(samples[0])
        found = camera.feed(samples[1:], np.arange(1, 6) * 1_000_000)
        assert len(found) > 500
        assert np.all(np.diff(found.numpy().t) >= 0)
        assert {0, 1} == set(found.numpy().polarity.tolist())
