"""`neurosim fit-sensor`: the settings of a camera are found again in its recordings."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from neurosim_core import cli
from neurosim_core.config import load_config
from neurosim_core.fit.recordings import find_steps, measure_readout
from neurosim_core.fit.sensor import Stimulus, fit_sensor, make_pixel, statistics
from neurosim_core.io import create_events
from neurosim_core.packets import EventArrays
from neurosim_core.sensors.events import EventCamera

WIDTH, HEIGHT, SPAN_S, CONTRAST, RISE_S = 64, 48, 30.0, 4.0, 0.02
TRUTH: dict[str, Any] = {
    "threshold_on": 0.18,
    "threshold_off": 0.24,
    "threshold_spread.sigma_on": 0.02,
    "threshold_spread.sigma_off": 0.03,
    "leak.rate_hz": 0.2,
    "leak.spread_decades": 0.12,
    "shot_noise.rate_hz": 0.5,
    "shot_noise.bright_factor": 1.0,
    "shot_noise.on_fraction": 0.4,
    "shot_noise.spread_decades": 0.2,
    "hot_pixels.fraction": 0.004,
    "hot_pixels.rate_hz": 80.0,
    "hot_pixels.on_fraction": 0.9,
    "refractory_s": 1e-3,
}
READOUT = {"readout.kind": "event", "readout.bandwidth_hz": 3e5}


def record(settings: dict[str, Any], log: Any, time_s: Any, *, seed: int, width: int = WIDTH) -> EventArrays:
    camera = EventCamera(make_pixel(settings), width=width, height=HEIGHT, sensor="real", seed=seed)
    frames = np.broadcast_to(np.asarray(log)[:, None, None], (len(log), HEIGHT, width)).astype(np.float32)
    camera.reset(frames[0])
    return camera.feed(frames[1:], np.rint(1e9 * np.asarray(time_s)[1:]).astype(np.int64)).numpy()


def record_still(settings: dict[str, Any], seed: int = 77, span_s: float = SPAN_S) -> EventArrays:
    return record(settings, [0.0, 0.0], [0.0, span_s], seed=seed)


def record_steps(settings: dict[str, Any], *, periods: int = 9, width: int = WIDTH) -> EventArrays:
    log, time_s = [0.0], [0.0]
    for number in range(periods):
        begin = 0.3 + 0.5 * number
        log += [0.0, math.log(CONTRAST), math.log(CONTRAST), 0.0]
        time_s += [begin, begin + RISE_S, begin + 0.25, begin + 0.25 + RISE_S]
    return record(settings, log, time_s, seed=78, width=width)


@pytest.fixture(scope="module")
def recordings() -> tuple[EventArrays, EventArrays]:
    return record_still(TRUTH), record_steps(TRUTH | READOUT)


def test_settings_are_found_again(recordings):
    """Within five standard errors, or 3 % (errors themselves are known to a quarter)."""
    still, steps = recordings
    stimulus = Stimulus(
        width=WIDTH, height=HEIGHT, still=still, span_s=SPAN_S, steps=steps, contrast=CONTRAST, rise_s=RISE_S
    )
    fit = fit_sensor(stimulus, repeats=6)
    assert fit.settings.keys() - {"threshold_spread.minimum"} == (TRUTH | READOUT).keys()
    for key, true in TRUTH.items():
        error = fit.errors.get(key, 0.0)
        assert fit.settings[key] == pytest.approx(true, abs=5.0 * error + 0.03 * true), key
        assert error < 0.5 * true, key
    assert fit.settings["readout.kind"] == "event"
    assert fit.settings["readout.bandwidth_hz"] == pytest.approx(3e5, rel=0.01)  # 60 events a window
    make_pixel(fit.settings)
    simulated = statistics(fit.simulated)
    for name, value in statistics(fit.real).items():
        if not name.startswith(("silent", "hot")):  # few pixels
            assert simulated[name] == pytest.approx(value, rel=0.1), name


def test_errors_say_how_far_off_the_settings_are():
    """Over cameras, settings are off by their errors: the ratio of mean squares has 18 degrees of freedom."""
    truth = {key: value for key, value in TRUTH.items() if key.startswith(("shot", "leak", "thre"))}
    keys = ("leak.rate_hz", "shot_noise.rate_hz", "shot_noise.on_fraction")
    deviation, error = np.zeros((6, 3)), np.zeros((6, 3))
    for seed in range(6):
        stimulus = Stimulus(width=WIDTH, height=HEIGHT, still=record_still(truth, seed), span_s=SPAN_S)
        fit = fit_sensor(stimulus, repeats=4, seed=100 * seed)
        deviation[seed] = [fit.settings[key] - truth[key] for key in keys]
        error[seed] = [fit.errors[key] for key in keys]
    ratio = math.sqrt(float(((deviation**2).mean(axis=0) / (error**2).mean(axis=0)).mean()))
    assert 0.5 < ratio < 1.8


def test_hot_pixels_are_told_among_pixels_of_many_rates():
    """A few pixels fire a hundred times as often as the others: if not told, they pass for a wide spread."""
    shot = {"rate_hz": 3.0, "bright_factor": 1.0, "on_fraction": 0.7, "spread_decades": 0.35}
    truth = {f"shot_noise.{key}": value for key, value in shot.items()}
    hot = {"hot_pixels.fraction": 0.002, "hot_pixels.rate_hz": 300.0, "hot_pixels.on_fraction": 0.5}
    still = record_still(truth | hot, seed=5)
    fit = fit_sensor(Stimulus(width=WIDTH, height=HEIGHT, still=still, span_s=SPAN_S), repeats=2)
    assert fit.settings["hot_pixels.rate_hz"] == pytest.approx(300.0, rel=0.05)
    for key, true in truth.items():
        assert fit.settings[key] == pytest.approx(true, rel=0.05), key


@pytest.mark.parametrize(("rate_hz", "refractory_s"), [(8.0, 1e-2), (20.0, 2e-3)])
def test_a_dead_time_is_found_in_fast_noise(rate_hz, refractory_s):
    """It is more than a tenth of the time between two events of most pixels, or of the hot ones.

    In 8 s there are 200,000 events or more.
    """
    span_s = 8.0
    truth = {"shot_noise.rate_hz": rate_hz, "shot_noise.bright_factor": 1.0, "refractory_s": refractory_s}
    hot = {"hot_pixels.fraction": 0.05, "hot_pixels.rate_hz": 400.0, "hot_pixels.on_fraction": 0.9}
    still = record_still(truth | (hot if rate_hz > 10.0 else {}), seed=5, span_s=span_s)
    fit = fit_sensor(Stimulus(width=WIDTH, height=HEIGHT, still=still, span_s=span_s), repeats=2)
    assert fit.settings["refractory_s"] == pytest.approx(refractory_s, rel=0.01)
    assert fit.settings["shot_noise.rate_hz"] == pytest.approx(rate_hz, rel=0.03)


def test_what_a_recording_does_not_show_is_left_out_and_said():
    shot = {"shot_noise.rate_hz": 1.0, "shot_noise.bright_factor": 1.0}
    stimulus = Stimulus(width=WIDTH, height=HEIGHT, still=record_still(shot), span_s=SPAN_S)
    fit = fit_sensor(stimulus, repeats=2)
    assert not [key for key in fit.settings if key.startswith(("leak", "refractory", "readout", "hot"))]
    said = " ".join(fit.notes)
    for part in ("thresholds are not told", "no leak", "no dead time", "never saturated"):
        assert part in said
    assert "not still" not in said
    leak = {"leak.rate_hz": 0.3, "leak.spread_decades": 0.1}
    fit = fit_sensor(Stimulus(width=WIDTH, height=HEIGHT, still=record_still(leak), span_s=SPAN_S), repeats=2)
    assert not [key for key in fit.settings if key.startswith("shot_noise")]
    assert fit.settings["leak.rate_hz"] == pytest.approx(0.3, rel=0.02)


def test_thresholds_of_pixels_that_are_alike_are_told_less_exactly():
    """Every pixel has as many events in a step: a range of thresholds does, and the errors say so."""
    alike = {"threshold_on": 0.18, "threshold_off": 0.24, "leak.rate_hz": 0.2}
    stimulus = Stimulus(
        width=WIDTH, height=HEIGHT, still=record_still(alike), span_s=SPAN_S, steps=record_steps(alike),
        contrast=CONTRAST, rise_s=RISE_S,
    )  # fmt: skip
    fit = fit_sensor(stimulus, repeats=2)
    for key in ("threshold_on", "threshold_off"):
        assert 0.005 < fit.errors[key] < 0.02
        assert fit.settings[key] == pytest.approx(alike[key], abs=3.0 * fit.errors[key]), key
    assert "all pixels have the same whole number of events" in " ".join(fit.notes)


@pytest.mark.parametrize("bandwidth_hz", [None, 1e5])
def test_jitter_of_thresholds_is_told_from_their_spread(bandwidth_hz):
    """Counts of one pixel differ from step to step; also with a readout that is late by half a step."""
    jitter = {"threshold_jitter.sigma_on": 0.03, "threshold_jitter.sigma_off": 0.04}
    readout = {} if bandwidth_hz is None else READOUT | {"readout.bandwidth_hz": bandwidth_hz}
    stimulus = Stimulus(
        width=WIDTH, height=HEIGHT, still=record_still(TRUTH | jitter), span_s=SPAN_S,
        steps=record_steps(TRUTH | jitter | readout), contrast=CONTRAST, rise_s=RISE_S,
    )  # fmt: skip
    fit = fit_sensor(stimulus, repeats=2)
    for key in ("threshold_on", "threshold_off"):
        assert fit.settings[key] == pytest.approx(TRUTH[key], rel=0.015), key
    for key, true in jitter.items():
        assert fit.settings[key] == pytest.approx(true, rel=0.12), key
    for key in ("threshold_spread.sigma_on", "threshold_spread.sigma_off"):
        assert fit.settings[key] == pytest.approx(TRUTH[key], rel=0.08), key


def test_a_burst_at_the_start_is_no_rise(recordings):
    """Pixels fire when a camera is switched on: the first rise is not taken to begin there."""
    steps = recordings[1]
    place = np.arange(400)
    burst = EventArrays(
        t=np.concatenate([np.zeros(400, np.int64), steps.t]),
        x=np.concatenate([(place % WIDTH).astype(np.uint16), steps.x]),
        y=np.concatenate([(place // WIDTH).astype(np.uint16), steps.y]),
        polarity=np.concatenate([np.ones(400, np.uint8), steps.polarity]),
    )
    assert np.abs(find_steps(burst)[0] - find_steps(steps)[0]).max() <= 2000


def test_a_readout_by_rows_is_told_from_one_by_events():
    """A window of w rows and n events takes w row_s + n / bandwidth."""
    rows = {"readout.kind": "row", "readout.bandwidth_hz": 4e5, "readout.row_s": 2e-6}
    found = measure_readout(record_steps(TRUTH | rows, periods=2))
    assert found["readout.kind"] == "row"
    assert found["readout.bandwidth_hz"] == pytest.approx(4e5, rel=0.1)
    assert found["readout.row_s"] == pytest.approx(2e-6, rel=0.5)
    assert "readout.kind" not in measure_readout(record_steps(TRUTH, periods=2))


def test_a_recording_that_is_not_still_is_said(recordings):
    fit = fit_sensor(Stimulus(width=WIDTH, height=HEIGHT, still=recordings[1], span_s=5.0), repeats=2)
    assert "the still recording is not still" in " ".join(fit.notes)


def test_light_that_rises_longer_than_it_stays_is_refused(recordings):
    stimulus = Stimulus(
        width=WIDTH, height=HEIGHT, still=recordings[0], steps=recordings[1], contrast=CONTRAST, rise_s=5.0
    )
    with pytest.raises(ValueError, match=r"--rise must be shorter than a level of the steps, 0\.25 s, got 5"):
        fit_sensor(stimulus, repeats=2)


def test_steps_are_found_where_they_are(recordings):
    rises, falls = find_steps(recordings[1])
    assert len(rises) == len(falls) == 8  # the last one may not have been read
    assert np.abs(rises - (300_000 + 500_000 * np.arange(8))).max() < 10_000  # the first threshold, and a bin
    assert np.abs(falls - (550_000 + 500_000 * np.arange(8))).max() < 10_000
    with pytest.raises(ValueError, match="4 or more"):
        find_steps(record_still(TRUTH))


def test_the_command_leaves_settings_and_a_picture(recordings, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, events in zip(("still.raw", "steps.raw"), recordings, strict=True):
        writer = create_events(name, width=WIDTH, height=HEIGHT)
        writer.write(events)
        writer.close()
    command = ["fit-sensor", "still.raw", "steps.raw", "--lux", "300", "--contrast", "4", "--rise", "0.02"]
    assert cli.main([*command, "--repeats", "2", "-o", "cam.yaml"]) == 0
    said = capsys.readouterr().out
    for part in ("leak.rate_hz", "standard error", "simulation", "50 % of intervals below [s]"):
        assert part in said
    pixel = load_config("cam.yaml").sensors["events"].pixel
    assert pixel.threshold_on == pytest.approx(0.18, rel=0.03)
    assert pixel.leak.rate_hz == pytest.approx(0.2, rel=0.05)
    for part in ("300 lux", "+-", "steps.raw"):
        assert part in Path("cam.yaml").read_text()
    assert Path("cam.png").stat().st_size > 10_000
    also = ["--also", "still.raw", "3000", "--repeats", "2", "-o", "both.yaml"]
    assert cli.main(["fit-sensor", "still.raw", "--lux", "0.1", *also]) == 0
    pixel = load_config("both.yaml").sensors["events"].pixel
    assert (pixel.shot_noise, pixel.leak, pixel.hot_pixels) == (None, None, None)
    with np.load(pixel.measured_noise.file) as table:
        assert table["lux"].tolist() == [0.1, 3000.0]
        assert table["on_hz"].mean() == pytest.approx(recordings[0].polarity.sum() / 30 / 64 / 48, rel=1e-3)
    assert cli.main([*command, "-o", "cam.yaml"]) == 1
    assert "already there" in capsys.readouterr().err
    assert cli.main(["fit-sensor", "still.raw", "--lux", "300", "--contrast", "1", "-o", "x.yaml"]) == 1
    assert cli.main(["fit-sensor", "still.raw", "steps.raw", "--lux", "300", "-o", "x.yaml"]) == 1
    assert "say how high the steps are: --contrast" in capsys.readouterr().err
