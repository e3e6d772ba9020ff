"""Presets named after sensors, and the settings of pixels as a file has them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import yaml

from neurosim_core.config import ConfigError, SimulationConfig, load_config, to_yaml
from neurosim_core.sensors.event_config import EventCameraConfig, LeakConfig, event_presets
from neurosim_core.sensors.events import EventCamera


def load(pixel: dict[str, object]) -> SimulationConfig:
    return load_config({"sensors": {"dvs": {"kind": "event_camera", "pixel": pixel}}})


def pixel_of(config: SimulationConfig) -> EventCameraConfig:
    return config.sensors["dvs"].pixel


@pytest.mark.parametrize("name", event_presets())
def test_presets_survive_a_file(name):
    config = load({"preset": name})
    pixel = pixel_of(config)
    assert pixel == EventCameraConfig(preset=name)
    assert pixel.terms() or pixel.readout is not None
    for comments in (False, True):
        assert load_config(yaml.safe_load(to_yaml(config, comments=comments))) == config
    assert len(event_presets()[name]["sources"]) > 20


def test_contrasts_are_logarithms():
    """Published contrasts are relative steps of light: DAVIS240C 11 %, DVS128 17 %."""
    assert EventCameraConfig(preset="davis240c").threshold_on == pytest.approx(math.log(1.11), abs=1e-4)
    assert EventCameraConfig(preset="dvs128").threshold_off == pytest.approx(math.log(1.17), abs=1e-4)
    k1 = EventCameraConfig(preset="voltmeter_dvs346").stochastic.k1
    assert 1.0 / k1 == pytest.approx(0.19, abs=1e-3)  # its threshold, in log radiance


def test_v2e_is_as_published():
    """`set_dvs_params` of its code: clean has mismatch alone, noisy no refractory time."""
    clean, noisy = (EventCameraConfig(preset=f"v2e_{name}") for name in ("clean", "noisy"))
    assert clean.terms() == ("spread", "lin_log")
    assert (clean.threshold_on, clean.threshold_off, clean.threshold_spread.sigma_on) == (0.2, 0.2, 0.02)
    assert (noisy.threshold_on, noisy.threshold_off, noisy.threshold_spread.sigma_off) == (0.2, 0.2, 0.05)
    assert (noisy.low_pass.cutoff_hz, noisy.leak.rate_hz, noisy.shot_noise.rate_hz) == (30.0, 0.1, 4.7273)
    for number in (0.0, 20.0, 255.0):  # its factor on 5 Hz is 1 - 0.75 (DN + 20) / 275
        factor = 1.0 + (noisy.shot_noise.bright_factor - 1.0) * number / 255.0
        assert noisy.shot_noise.rate_hz * factor == pytest.approx(
            5.0 * (1 - 0.75 * (number + 20) / 275), 1e-4
        )
    assert (noisy.leak.spread_decades, noisy.shot_noise.spread_decades) == (0.1, 0.0)
    assert (clean.refractory_s, noisy.refractory_s) == (0.0, 0.0)


def v2e_counts(numbers: np.ndarray, dt_s: float, threshold: float, cutoff_hz: float) -> tuple[int, int]:
    """Events of v2e's equations, frame by frame: lin-log map, low-pass by light, levels."""
    seen = np.where(numbers <= 20.0, numbers * math.log(20.0) / 20.0, np.log(np.maximum(numbers, 1e-9)))
    filtered = base = seen[0]
    on = off = 0
    for number, value in zip(numbers[1:], seen[1:], strict=True):
        share = (number + 20.0) / 275.0 * dt_s * 2.0 * math.pi * cutoff_hz if cutoff_hz else 1.0
        filtered += min(share, 1.0) * (value - filtered)
        rise, fall = (max(math.floor(sign * (filtered - base) / threshold), 0) for sign in (1.0, -1.0))
        on, off, base = on + rise, off + fall, base + (rise - fall) * threshold
    return on, off


@pytest.mark.parametrize("number", [2.0, 10.0, 20.0, 100.0])
@pytest.mark.parametrize("cutoff_hz", [0.0, 30.0])
def test_v2e_counts_the_events_of_its_equations(number, cutoff_hz, device):
    """Light that swings more and more around some grey level. Fine frames: both are right to those."""
    time_s = np.arange(0.0, 4.0, 2e-4)
    numbers = number * (1.0 + (0.4 + 0.06 * time_s) * np.sin(2.0 * np.pi * 1.7 * time_s))
    frames = np.log(numbers / 255.0).astype(np.float32).reshape(-1, 1, 1)
    low_pass = {"cutoff_hz": cutoff_hz, "dark_radiance": 20 / 255} if cutoff_hz else None
    noise = {"threshold_spread": None, "leak": None, "shot_noise": None, "low_pass": low_pass}
    counts = []
    for more in ({}, {"lin_log": None}):
        config = EventCameraConfig.model_validate(
            {"preset": "v2e_noisy", "threshold_on": 0.05, "threshold_off": 0.05, **noise, **more}
        )
        camera = EventCamera(config, width=1, height=1, device=device)
        camera.reset(frames[0])
        events = camera.feed(frames[1:], np.rint(1e9 * time_s[1:]).astype(np.int64)).numpy()
        counts.append((int(events.polarity.sum()), int((events.polarity == 0).sum())))
    expected = v2e_counts(numbers, 2e-4, 0.05, cutoff_hz)
    assert min(expected) > 20
    np.testing.assert_allclose(counts[0], expected, atol=2)  # one at the end, one by rounding
    if number < 20.0:
        assert abs(counts[1][0] - expected[0]) > 0.1 * expected[0]  # what the logarithm alone would give


def test_shot_noise_of_v2e_goes_with_the_threshold(device):
    """A polarity's rate is half the nominal one times nominal over own threshold."""
    shot = {"rate_hz": 40.0, "bright_factor": 1.0, "spread_decades": 0.0, "by_threshold": True}
    spread = {"sigma_on": 0.05, "sigma_off": 0.02, "minimum": 0.05}
    config = EventCameraConfig.model_validate({"shot_noise": shot, "threshold_spread": spread})
    camera = EventCamera(config, width=64, height=64, device=device, seed=2)
    camera.reset(np.zeros((64, 64), np.float32))
    events = camera.feed(np.zeros((1, 64, 64), np.float32), [20_000_000_000]).numpy()
    pixel = events.y.astype(int) * 64 + events.x
    quiet = EventCameraConfig.model_validate({"threshold_spread": spread})
    camera = EventCamera(quiet, width=64, height=64, device=device, seed=2, terms=camera.terms)
    for polarity in (1, 0):
        count = np.bincount(pixel[events.polarity == polarity], minlength=64 * 64)
        camera.reset(np.zeros((64, 64), np.float32))
        ramp = np.full((1, 64, 64), 1.0 if polarity else -1.0, np.float32)
        found = camera.feed(ramp, [1_000_000_000]).numpy()
        threshold = np.empty(64 * 64)
        threshold[(found.y.astype(int) * 64 + found.x)[::-1]] = 1e-6 * found.t[::-1]  # of the first event
        expected = 20.0 * 20.0 * 0.2 / threshold
        dispersion = float(((count - expected) ** 2 / expected).mean())
        assert dispersion == pytest.approx(1.0, abs=5.0 * math.sqrt(2.0 / 4096))  # chi2, 4096 pixels
        assert count.sum() == pytest.approx(expected.sum(), abs=5.0 * math.sqrt(expected.sum()))


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
    assert "# ON events per second of a pixel in a still scene, in the dark [Hz]." in text


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
