"""Pixels that are not ideal, each term against its closed form or its statistic."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
import warp as wp
from core_counts import cores
from scipy import integrate, optimize, stats

from neurosim_core.config import load_config
from neurosim_core.packets import EventArrays, Events
from neurosim_core.sensors.event_config import EventCameraConfig
from neurosim_core.sensors.events import EventCamera
from neurosim_core.sim import run

MS = 1_000_000
S = 1_000_000_000
ALARM = 1e-6
"""False-alarm rate of each statistic; seeds are fixed, so none is ever met."""

NOISY: dict[str, Any] = {
    "threshold_spread": {"sigma_on": 0.03, "sigma_off": 0.03},
    "refractory_s": 2e-4,
    "leak": {"rate_hz": 5.0},
    "shot_noise": {"rate_hz": 50.0},
    "hot_pixels": {"fraction": 0.02},
}


SPARSE = ("spread", "refractory", "leak", "spontaneous")
SHARED_TERMS = (SPARSE, (*SPARSE, "low_pass"), ("lin_log", "leak", "light_leak", "spontaneous", "measured"))
"""Kernels that cameras share, so that few are compiled; `test_terms_with_zero_coefficients_change_no_bit`."""


def make_camera(
    width: int,
    height: int,
    device: str,
    *,
    seed: int = 0,
    sensor: str = "",
    shared: bool = True,
    **settings: Any,
) -> EventCamera:
    config = EventCameraConfig(**settings)
    needed = set(config.terms())
    terms = next((terms for terms in SHARED_TERMS if shared and needed and needed <= set(terms)), None)
    return EventCamera(
        config, width=width, height=height, device=device, seed=seed, sensor=sensor, terms=terms
    )


def feed(camera: EventCamera, frames: Any, stamps: Any) -> EventArrays:
    """Reset to the first frame and feed the others in one stack."""
    frames = np.asarray(frames, np.float32).reshape(-1, camera.height, camera.width)
    camera.reset(frames[0], stamp_ns=int(stamps[0]))
    return camera.feed(frames[1:], np.asarray(stamps[1:], np.int64)).numpy()


def still(camera: EventCamera, log_radiance: float, stamps: Any) -> EventArrays:
    """A scene in which nothing moves."""
    frame = np.full((len(stamps), camera.height, camera.width), log_radiance, np.float32)
    return feed(camera, frame, stamps)


def of_pixel(found: EventArrays, col: int, row: int = 0) -> EventArrays:
    mine = (found.x == col) & (found.y == row)
    return EventArrays(*(column[mine] for column in found))


def intervals_us(found: EventArrays, width: int) -> np.ndarray:
    """Times between consecutive events of the same pixel."""
    pixel = found.y.astype(np.int64) * width + found.x
    order = np.lexsort((found.t, pixel))
    step, same = np.diff(found.t[order]), np.diff(pixel[order]) == 0
    return step[same]


def assert_poisson(count: int, mean: float, *, resolves: float) -> None:
    """The count is Poisson(mean), and the test would see a bias of the share `resolves`."""
    low, high = stats.poisson(mean).interval(1.0 - ALARM)
    assert low <= count <= high
    assert not low <= mean * (1.0 + resolves) <= high


def assert_same(a: Any, b: Any) -> None:
    for first, second in zip(a, b, strict=True):
        np.testing.assert_array_equal(first, second)


# ---- terms and their absence


def walk(seed: int = 0, shape: tuple[int, ...] = (12, 15), count: int = 9) -> tuple[np.ndarray, np.ndarray]:
    frames = np.random.default_rng(seed).normal(scale=0.3, size=(count, *shape)).cumsum(0)
    return frames.astype(np.float32), np.arange(count) * 1_700_123


def test_what_is_off_is_not_there(device):
    assert make_camera(15, 12, device, shared=False).terms == ()
    assert make_camera(15, 12, device, shared=False, leak={}, readout={}).terms == ("leak", "readout")


@pytest.mark.parametrize(
    "terms",
    [
        (),
        ("low_pass",),
        *SHARED_TERMS,
    ],
)
def test_terms_with_zero_coefficients_change_no_bit(terms, device):
    """Zero spread, time, rates, and an infinite bandwidth: the events of the ideal camera."""
    frames, stamps = walk()
    ideal = feed(make_camera(15, 12, device), frames, stamps)
    camera = EventCamera(EventCameraConfig(), width=15, height=12, device=device, seed=3, terms=terms)
    assert camera.terms == terms
    assert len(ideal.t) > 1000
    assert_same(ideal, feed(camera, frames, stamps))


def test_unknown_terms_are_refused():
    with pytest.raises(ValueError, match="unknown noise kind 'flicker', known: "):
        EventCamera(EventCameraConfig(), width=3, height=2, device="cpu", terms=("flicker",))


# ---- mismatch


def first_event_s(found: EventArrays, pixel_count: int, width: int) -> np.ndarray:
    pixel = found.y.astype(np.int64) * width + found.x
    first = np.full(pixel_count, np.nan)
    first[pixel[::-1]] = found.t[::-1] * 1e-6
    return first


def measure_thresholds(camera: EventCamera) -> list[np.ndarray]:
    """Measure each pixel's thresholds, up and down, as the time of its first event on a ramp of 1 / s."""
    shape = (camera.height, camera.width)
    ramps = [feed(camera, [np.zeros(shape), np.full(shape, sign)], [0, S]) for sign in (1.0, -1.0)]
    return [first_event_s(found, camera.height * camera.width, camera.width) for found in ramps]


def test_thresholds_are_normal_and_stay(device):
    config = {
        "threshold_spread": {"sigma_on": 0.03, "sigma_off": 0.05},
        "threshold_on": 0.3,
        "threshold_off": 0.4,
    }
    camera = make_camera(128, 128, device, seed=5, sensor="a", **config)
    measured = measure_thresholds(camera)
    for value, mean, deviation in zip(measured, (0.3, 0.4), (0.03, 0.05), strict=True):
        # the floor to microseconds shifts by 5e-7: nothing against 0.03
        assert stats.kstest(value, stats.norm(mean, deviation).cdf).pvalue > ALARM
        low, high = stats.chi2(value.size).interval(1.0 - ALARM)
        assert low <= ((value - mean) ** 2).sum() / deviation**2 <= high
        assert not low <= 1.1**2 * value.size <= high  # a spread that is 10 % off would be seen
    assert abs(np.corrcoef(measured)[0, 1]) < 4.9 / 128  # independent: normal with deviation 1 / 128
    # another camera with this seed and name, wherever it starts, is the same one
    frames = np.stack([np.zeros((128, 128)), np.ones((128, 128))])
    again = feed(make_camera(128, 128, device, seed=5, sensor="a", **config), frames, [7 * S, 8 * S])
    np.testing.assert_allclose(first_event_s(again, 128**2, 128) - 7.0, measured[0], atol=1.1e-6)
    for seed, sensor in ((6, "a"), (5, "b")):
        other = feed(make_camera(128, 128, device, seed=seed, sensor=sensor, **config), frames, [0, S])
        assert abs(np.corrcoef(measured[0], first_event_s(other, 128**2, 128))[0, 1]) < 4.9 / 128


def test_thresholds_that_are_drawn_for_each_event(device):
    """On a ramp the intervals of a pixel are independent normal numbers over the slope, up and down."""
    jitter = {"sigma_on": 0.02, "sigma_off": 0.01, "minimum": 0.05}
    for sign, mean, sigma in ((1.0, 0.2, 0.02), (-1.0, 0.15, 0.01)):
        camera = make_camera(40, 30, device, threshold_jitter=jitter, threshold_off=0.15)
        frames = np.stack([np.zeros((30, 40)), np.full((30, 40), sign * 20.0)])
        found = feed(camera, frames, [0, 20 * S])  # 1 / s
        steps = 1e-6 * intervals_us(found, 40)
        assert len(steps) > 100_000
        worst = stats.kstest(steps, stats.norm(mean, sigma).cdf).statistic  # ends are cut off: 1 of 100
        assert worst < 0.01 + stats.kstwobign.isf(ALARM) / math.sqrt(len(steps))
        mine = np.diff(of_pixel(found, 7, 5).t)
        assert abs(np.corrcoef(mine[1:], mine[:-1])[0, 1]) < 5.0 / math.sqrt(len(mine))


def test_jitter_leaks_as_thresholds_without(device):
    """The leak is that of the own threshold: intervals have its mean, and the spread of the jitter."""
    jitter = {"sigma_on": 0.02, "sigma_off": 0.02, "minimum": 0.05}
    leak = {"rate_hz": 2.0, "spread_decades": 0.0}
    found = still(make_camera(40, 30, device, threshold_jitter=jitter, leak=leak), 0.0, [0, 7 * S, 40 * S])
    steps = 1e-6 * intervals_us(found, 40)
    assert steps.mean() == pytest.approx(0.5, rel=0.003)
    assert steps.std() == pytest.approx(0.05, rel=0.03)
    # in the beginning no pixel has leaked beyond its threshold: 2,400 Hz in all, so 24 events in 10 ms
    assert stats.poisson(24.0).cdf((found.t < 10_000).sum()) < 1.0 - ALARM


def test_thresholds_are_clipped_to_their_minimum(device):
    """With a deviation of half the mean, a normal share of Phi((0.05 - 0.2) / 0.1) lies at the minimum."""
    spread = {"sigma_on": 0.1, "sigma_off": 0.0, "minimum": 0.05}
    camera = make_camera(128, 128, device, threshold_spread=spread)
    on, off = measure_thresholds(camera)
    assert on.min() == pytest.approx(0.05, abs=1.1e-6)  # microseconds of a ramp of 1 / s
    np.testing.assert_allclose(off, 0.2, atol=1.1e-6)
    low, high = stats.binom(128**2, stats.norm.cdf(-1.5)).interval(1.0 - ALARM)
    assert low <= (on < 0.05 + 1.1e-6).sum() <= high


# ---- photoreceptor


def time_constant_s(light: float, cutoff_hz: float, dark: float = 0.08, white: float = 1.0) -> float:
    share = min((math.exp(light) + dark) / (white + dark), 1.0)
    return 1.0 / (2.0 * math.pi * cutoff_hz * share)


@pytest.mark.parametrize("frame_count", [1, 37])
def test_step_response_of_the_photoreceptor(frame_count, device):
    """After a step by D at constant light, level n C is crossed at -tau ln(1 - n C / D), tau by the light."""
    light = np.array([-6.0, -3.0, -1.0, -0.2, 0.0, 1.5, 0.4])
    step = np.array([1.03, -1.3, 0.9, 2.1, -0.65, 1.1, 0.25])
    frames = np.stack([light - step, *([light] * (frame_count + 1))])[:, None, :].astype(np.float32)
    stamps = np.concatenate([[0, 1], np.linspace(1, 2 * S, frame_count + 1)[1:].astype(np.int64)])
    camera = make_camera(7, 1, device, low_pass={"cutoff_hz": 40.0})
    found = feed(camera, frames, stamps)
    values = frames.astype(np.float64)[:, 0]
    for col in range(7):
        height = values[1, col] - values[0, col]
        tau_s = time_constant_s(values[1, col], 40.0)
        levels = 0.2 * np.arange(1, int(abs(height) / 0.2) + 1)
        crossing_us = -tau_s * np.log(1.0 - levels / abs(height)) * 1e6
        mine = of_pixel(found, col)
        assert np.all(mine.polarity == (height > 0.0))
        # the floor; the step takes 1 ns; and the light rises in it, which no time constant notices
        np.testing.assert_allclose(mine.t, crossing_us, rtol=1e-9, atol=1.01)


def test_photoreceptor_far_from_constant_light(device):
    """Against an integration to 1e-11 where tau changes fiftyfold within one interval between frames."""
    stamps = np.array([0, 20, 45, 60, 100]) * MS
    samples = np.array([-4.0, 0.0, -3.0, -3.0, -0.9])
    found = feed(make_camera(1, 1, device, low_pass={"cutoff_hz": 60.0}), samples, stamps)

    def rate(time_s: float, value: np.ndarray) -> np.ndarray:
        light = np.interp(time_s, stamps * 1e-9, samples)
        return (light - value) / time_constant_s(light, 60.0)

    oracle = []
    value, reference = -4.0, -4.0
    for begin, end in itertools.pairwise(stamps * 1e-9):
        solution = integrate.solve_ivp(
            rate, (begin, end), [value], method="LSODA", rtol=1e-11, atol=1e-12, dense_output=True
        )
        times = np.linspace(begin, end, 20_001)
        curve = solution.sol(times)[0]
        for index in range(1, len(times)):
            while abs(curve[index] - reference) >= 0.2:
                reference += 0.2 * np.sign(curve[index] - reference)
                oracle.append(
                    optimize.brentq(
                        lambda time, level=reference, sol=solution.sol: sol(time)[0] - level,
                        times[index - 1],
                        times[index],
                    )
                )
        value = curve[-1]
    assert len(found.t) == len(oracle) > 30
    # tau of 2.6 ... 30 ms is held over 1/8 of log radiance, which moves a crossing by about 1e-3 of it
    assert np.abs(found.t * 1e-6 - oracle).max() < 4e-5


def test_crossings_between_frames_on_a_curve_that_turns(device):
    """Closed form of a filter with constant tau on random samples, levels found one by one with brentq."""
    rng = np.random.default_rng(4)
    width, count = 24, 14
    frames = (2.0 + rng.normal(scale=0.7, size=(count, 1, width)).cumsum(0)).astype(np.float32)
    frames = np.maximum(frames, np.float32(0.1))  # at least white, so tau is constant
    stamps = np.concatenate([[0], rng.integers(MS, 9 * MS, count - 1)]).cumsum()
    tau = time_constant_s(1.0, 50.0) * 1e9
    config = {"threshold_on": 0.013, "threshold_off": 0.017}
    found = feed(make_camera(width, 1, device, low_pass={"cutoff_hz": 50.0}, **config), frames, stamps)
    turned = 0
    for col in range(width):
        value = reference = float(frames[0, 0, col])
        oracle = []
        for k in range(1, count):
            before, after = (float(frames[i, 0, col]) for i in (k - 1, k))
            span = int(stamps[k] - stamps[k - 1])
            slope = (after - before) / span

            def curve(t: Any, *, start: Any = before, slope: Any = slope, value: Any = value) -> Any:
                return start + slope * (t - tau) + (value - start + slope * tau) * np.exp(-t / tau)

            grid = np.linspace(0.0, span, 4001)
            points = curve(grid)
            turned += len(np.unique(np.sign(np.diff(points)))) > 1
            for index in range(1, len(grid)):
                while True:
                    if points[index] >= reference + 0.013:
                        reference += 0.013
                    elif points[index] <= reference - 0.017:
                        reference -= 0.017
                    else:
                        break
                    crossing = optimize.brentq(
                        lambda t, level=reference, curve=curve: curve(t) - level,
                        grid[index - 1],
                        grid[index],
                        xtol=1e-6,
                    )
                    oracle.append((stamps[k - 1] + crossing) / 1000.0)
            value = curve(float(span))
        mine = of_pixel(found, col)
        assert len(mine.t) == len(oracle)
        np.testing.assert_allclose(mine.t, oracle, atol=1.01)
    assert turned > 50
    assert len(found.t) > 3000


def test_photoreceptor_of_a_still_scene_is_silent(device):
    light = np.random.default_rng(0).normal(scale=2.0, size=(6, 9))
    camera = make_camera(9, 6, device, low_pass={}, threshold_on=1e-3, threshold_off=1e-3)
    assert len(feed(camera, np.stack([light] * 5), np.arange(5) * MS).t) == 0


# ---- refractory time


@pytest.mark.parametrize("frame_count", [1, 400])
def test_ramp_with_refractory_time(frame_count, device):
    """Slope s: the first event after C / s, then one every t_ref + C / s; frames closer or wider than it."""
    slopes = np.array([3.0, 11.0, 250.0, -3.0, -40.0])
    stamps = np.linspace(0, S, frame_count + 1).astype(np.int64)
    # float64 ramps would be rounded; samples that are multiples of the last float32 are on a line to 1e-7
    frames = (slopes * (stamps * 1e-9)[:, None])[:, None, :].astype(np.float32)
    camera = make_camera(5, 1, device, refractory_s=3e-3, threshold_on=0.25, threshold_off=0.125)
    found = feed(camera, frames, stamps)
    for col, slope in enumerate(slopes):
        climb_s = (0.25 if slope > 0.0 else 0.125) / abs(slope)
        count = math.floor((1.0 - climb_s) / (3e-3 + climb_s)) + 1
        expected_us = (climb_s + np.arange(count) * (3e-3 + climb_s)) * 1e6
        mine = of_pixel(found, col)
        assert abs(len(mine.t) - count) <= 1  # the last may lie at the end
        shared = min(len(mine.t), count)
        assert shared >= 11
        # samples of up to 250 are rounded by 8e-6 each; a reference taken from them moves by as much
        rounding_us = (np.arange(shared) + 1) ** 0.5 * 2e-5 * 1e6 / abs(slope) * (frame_count > 1)
        error_us = np.abs(mine.t[:shared] - expected_us[:shared])
        assert np.all(error_us <= 1.01 + rounding_us)
        assert np.all(mine.polarity == (slope > 0.0))


def test_a_pixel_in_reset_sees_nothing(device):
    """Up and down again within the refractory time: one event, and no level is owed."""
    stamps = np.array([0, 10, 12, 14, 60]) * MS
    samples = [0.0, 0.3, 2.0, 0.3, 0.3]
    found = feed(make_camera(1, 1, device, refractory_s=0.01), samples, stamps)
    assert found.t.tolist() == [6666]


# ---- leak


def test_leak_rate_of_a_still_scene(device):
    """Each pixel fires ON events at a rate of its own, log-normal, in phases that are uniform."""
    camera = make_camera(64, 48, device, leak={"rate_hz": 2.0, "spread_decades": 0.1})
    stamps = np.arange(0, 20 * S + 1, S // 10)
    found = still(camera, -1.3, stamps)
    assert np.all(found.polarity == 1)
    pixel = found.y.astype(int) * 64 + found.x
    time_s = found.t[np.argsort(pixel, kind="stable")] * 1e-6
    counts = np.bincount(pixel, minlength=64 * 48)
    begins = counts.cumsum() - counts
    first_s, last_s = time_s[begins], time_s[begins + counts - 1]
    rate_hz = (counts - 1) / (last_s - first_s)
    assert stats.kstest(np.log10(rate_hz), stats.norm(math.log10(2.0), 0.1).cdf).pvalue > ALARM
    assert stats.kstest(first_s * rate_hz, stats.uniform.cdf).pvalue > ALARM
    # a pixel is as regular as a level is found: to 1e-6 of log radiance, of 0.4 / s
    cycle = np.arange(len(time_s)) - np.repeat(begins, counts)
    np.testing.assert_allclose(
        time_s, np.repeat(first_s, counts) + cycle / np.repeat(rate_hz, counts), atol=5e-6
    )
    assert (last_s + 1.0 / rate_hz > 20.0 - 5e-6).all()
    coarse = still(make_camera(64, 48, device, leak={"rate_hz": 2.0}), -1.3, [0, 20 * S])
    assert len(coarse.t) == len(found.t)
    np.testing.assert_allclose(np.sort(coarse.t), np.sort(found.t), atol=5.0)


def test_leak_against_a_slope(device):
    """Falling by s, the pixel fires OFF every C_off / (s - rate C_on); falling slower than it leaks, ON."""
    slopes = np.array([-1.0, -0.25, -0.02, 0.5])
    config = {"leak": {"rate_hz": 0.5, "spread_decades": 0.0}, "threshold_on": 0.2, "threshold_off": 0.15}
    frames = (slopes * np.array([0.0, 30.0])[:, None])[:, None, :]
    found = feed(make_camera(4, 1, device, **config), frames, [0, 30 * S])
    for col, slope in enumerate(slopes):
        net = slope + 0.5 * 0.2
        mine = of_pixel(found, col)
        assert np.all(mine.polarity == (net > 0.0))
        period_us = (0.2 if net > 0.0 else 0.15) / abs(net) * 1e6
        assert len(mine.t) >= 9
        np.testing.assert_allclose(np.diff(mine.t), period_us, rtol=1e-6, atol=1.01)


def test_leak_keeps_time_for_days(device):
    """Nothing grows with time: after 1e6 s the events are still 1 / rate apart."""
    camera = make_camera(3, 1, device, leak={"rate_hz": 1.0, "spread_decades": 0.0})
    stamps = np.concatenate([[0], np.arange(1, 11) * 100_000 * S, 1_000_000 * S + np.arange(1, 6) * S])
    found = still(camera, 0.3, stamps)
    for col in range(3):
        mine = of_pixel(found, col)
        assert len(mine.t) in (1_000_005, 1_000_004)
        np.testing.assert_allclose(np.diff(mine.t[-8:]), 1e6, atol=5.0)


def test_leak_that_grows_with_light(device):
    """It fires at rate (1 + (factor - 1) I), and on a ramp of log light what has leaked is the integral."""
    leak = {"rate_hz": 1.0, "bright_factor": 5.0, "spread_decades": 0.0}
    for light in (0.0, 0.25, 1.0, 3.0):
        found = still(make_camera(3, 1, device, leak=leak), math.log(max(light, 1e-9)), [0, 3 * S, 20 * S])
        for col in range(3):
            np.testing.assert_allclose(np.diff(of_pixel(found, col).t), 1e6 / (1.0 + 4.0 * light), atol=5.0)
    # log light from -3 to 0 in 3 s: 3 / 0.2 levels, and 3 + 4 (1 - exp(-3)) cycles, of a frame or of many
    for count in (1, 30):
        frames = np.repeat(np.linspace(-3.0, 0.0, count + 1)[:, None, None], 50, axis=2)
        found = feed(make_camera(50, 1, device, leak=leak), frames, np.linspace(0, 3 * S, count + 1))
        events = len(found.t) / 50.0
        assert events == pytest.approx(15.0 + 3.0 + 4.0 * (1.0 - math.exp(-3.0)), abs=0.5)


# ---- shot noise and hot pixels


@pytest.mark.parametrize(("light", "factor"), [(-20.0, 1.0), (math.log(0.5), 0.625), (0.7, 0.25)])
def test_shot_noise_is_poisson_and_falls_with_light(light, factor, device):
    """The rate falls as 1 - 0.75 I: counts, their dispersion, their times, and the share of ON events."""
    shot = {"rate_hz": 8.0, "on_fraction": 0.3, "spread_decades": 0.0}
    camera = make_camera(128, 96, device, seed=1, shot_noise=shot)
    duration_s = 1.0 / factor
    found = still(camera, light, [0, 3 * MS, round(duration_s * S)])
    pixels = 128 * 96
    assert_poisson(len(found.t), 8.0 * pixels, resolves=0.02)
    counts = np.bincount(found.y.astype(int) * 128 + found.x, minlength=pixels)
    low, high = stats.chi2(pixels - 1).interval(1.0 - ALARM)  # dispersion of Poisson counts
    assert low <= counts.var() * pixels / counts.mean() <= high
    on_low, on_high = stats.binom(len(found.t), 0.3).interval(1.0 - ALARM)
    assert on_low <= found.polarity.sum() <= on_high
    assert stats.kstest(found.t / (duration_s * 1e6), stats.uniform.cdf).pvalue > ALARM


LEVELS = [
    {"lux": 1.0, "on_hz": 6.0, "off_hz": 3.0, "spread_decades": 0.0},
    {"lux": 100.0, "on_hz": 2.0, "off_hz": 0.0, "spread_decades": 0.0},
    {"lux": 1000.0, "on_hz": 4.0, "off_hz": 0.0, "spread_decades": 0.0},
]


@pytest.mark.parametrize(
    ("lux", "on_hz", "off_hz"),
    [
        (0.01, 6.0, 3.0),
        (1.0, 6.0, 3.0),
        (10.0, 4.0, 1.5),
        (100.0, 2.0, 0.0),
        (316.2278, 3.0, 0.0),
        (1e5, 4.0, 0.0),
    ],
)
def test_measured_noise_is_linear_in_log_light(lux, on_hz, off_hz, device):
    noise = {"white_lux": 500.0, "levels": LEVELS}
    camera = make_camera(96, 64, device, seed=4, measured_noise=noise)
    found = still(camera, math.log(lux / 500.0), [0, S // 3, 2 * S])
    pixels = 96 * 64
    assert_poisson(int(found.polarity.sum()), 2.0 * on_hz * pixels, resolves=0.05)
    if off_hz:
        assert_poisson(int((found.polarity == 0).sum()), 2.0 * off_hz * pixels, resolves=0.05)
    else:
        assert found.polarity.all()


def test_measured_noise_of_a_table_is_that_of_its_pixels(device, tmp_path):
    """Each pixel does what some measured pixel did, in all lights: one in four fires in the dark alone."""
    lux, on = np.array([1.0, 100.0]), np.array([[40.0, 0.0, 10.0, 0.0], [0.0, 0.0, 20.0, 0.0]])
    np.savez(tmp_path / "noise.npz", lux=lux, on_hz=on, off_hz=on / 2.0)
    noise = {"white_lux": 100.0, "file": tmp_path / "noise.npz"}
    camera = make_camera(64, 64, device, seed=5, measured_noise=noise)
    counts = []
    for light in (0.01, 1.0):
        found = still(camera, math.log(light), [0, 4 * S])
        counts.append(np.bincount(found.y.astype(int) * 64 + found.x, minlength=64 * 64))
    dark, bright = counts
    low, high = stats.binom(64 * 64, 0.25).interval(1.0 - ALARM)
    loud, medium = dark > 150, (dark > 20) & (dark <= 150)  # Poisson of 240, of 60
    assert low <= loud.sum() <= high
    assert low <= medium.sum() <= high
    assert not bright[loud].any()
    assert_poisson(int(bright[medium].sum()), 120.0 * medium.sum(), resolves=0.05)
    assert not dark[~loud & ~medium].any()
    assert {"spontaneous", "measured"} <= set(camera.terms)


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        ({}, "give levels or file"),
        ({"levels": LEVELS[::-1]}, "from dark to bright"),
        ({"levels": LEVELS, "file": "x.npz"}, "give levels or file"),
    ],
)
def test_measured_noise_that_is_not_one_is_refused(noise, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        EventCameraConfig(measured_noise=noise)
    with pytest.raises(ValueError, match="not both"):
        EventCameraConfig(measured_noise={"levels": LEVELS}, shot_noise={})
    np.savez(tmp_path / "noise.npz", lux=[1.0], on_hz=[1.0], off_hz=[1.0])
    with pytest.raises(ValueError, match="must hold lux"):
        make_camera(4, 4, "cpu", measured_noise={"file": tmp_path / "noise.npz"})


def test_waiting_times_of_noise_are_exponential(device):
    """Watched for 200 mean times, so that few waiting times are cut off."""
    camera = make_camera(32, 24, device, shot_noise={"rate_hz": 100.0, "spread_decades": 0.0})
    found = still(camera, -20.0, [0, 2 * S])
    waits = intervals_us(found, 32)
    assert waits.size > 100_000
    # a wait longer than what is left is not seen: for 200 of them, 1 / 200 at most; the KS bound is 7e-3
    distance = stats.kstest(waits, stats.expon(scale=1e4).cdf).statistic
    assert distance < stats.kstwobign.isf(ALARM) / math.sqrt(waits.size) + 1.0 / 200.0
    assert waits.mean() == pytest.approx(1e4, rel=0.02)


def test_noise_does_not_depend_on_where_frames_lie(device):
    """Shot noise of a still scene: the same events, to the bit, for 1 frame, 7, and 200."""
    packets = [
        still(
            make_camera(40, 30, device, seed=2, shot_noise={"rate_hz": 20.0}),
            -1.0,
            np.linspace(0, S, count + 1).astype(np.int64),
        )
        for count in (1, 7, 200)
    ]
    assert len(packets[0].t) > 10_000
    for other in packets[1:]:
        assert_same(packets[0], other)


def test_noise_resets_the_pixel(device):
    """A ramp of 10 C / s that noise interrupts: the time to the next level counts from the noise event."""
    shot = {"rate_hz": 4.0, "on_fraction": 0.0, "bright_factor": 1.0, "spread_decades": 0.0}
    camera = make_camera(64, 1, device, shot_noise=shot)
    found = feed(camera, np.stack([np.zeros(64), np.full(64, 20.0)]), [0, 10 * S])
    checked = 0
    for col in range(64):
        mine = of_pixel(found, col)
        for index in range(1, len(mine.t)):
            step = mine.t[index] - mine.t[index - 1]
            if mine.polarity[index] == 1:  # a level: C / slope after whatever came before
                assert abs(step - 1e5) <= 2
                checked += 1
            else:
                assert step <= 1e5 + 2
    assert checked > 2000


def test_hot_pixels(device):
    """A binomial number of pixels, the same after a reset, fires at the rate; the others never."""
    hot = {"fraction": 0.01, "rate_hz": 200.0, "on_fraction": 0.8}
    camera = make_camera(128, 96, device, seed=9, hot_pixels=hot)
    found = still(camera, 0.0, [0, S])
    chosen = np.unique(found.y.astype(int) * 128 + found.x)
    low, high = stats.binom(128 * 96, 0.01).interval(1.0 - ALARM)
    assert low <= chosen.size <= high
    assert_poisson(len(found.t), 200.0 * chosen.size, resolves=0.05)
    on_low, on_high = stats.binom(len(found.t), 0.8).interval(1.0 - ALARM)
    assert on_low <= found.polarity.sum() <= on_high
    later = still(camera, -3.0, [5 * S, 6 * S])
    np.testing.assert_array_equal(chosen, np.unique(later.y.astype(int) * 128 + later.x))
    assert not np.array_equal(found.t, later.t - 5_000_000)  # the noise itself does not come again


# ---- first passages (DVS-Voltmeter)

VOLTMETER = {"k1": 5.0, "k2": 0.0, "k3": 0.0, "k4": 0.0, "k5": 0.0, "k6": 0.0, "random_phase": False}


def test_voltmeter_without_noise_is_the_ideal_pixel(device):
    """k1 ln L alone: a threshold of 1 / k1 and nothing else."""
    frames, stamps = walk(seed=3)
    frames = np.cumsum(np.abs(np.diff(frames, axis=0, prepend=0.0)), axis=0)  # rising: no level is met twice
    ideal = feed(make_camera(15, 12, device), frames, stamps)
    found = feed(make_camera(15, 12, device, stochastic=VOLTMETER), frames, stamps)
    assert len(ideal.t) == len(found.t) > 1000
    # exp and log of single samples move a crossing by 1e-15 of log radiance, and so by nothing
    np.testing.assert_allclose(np.sort(found.t), np.sort(ideal.t), atol=1.0)


@pytest.mark.parametrize("frame_ns", [20 * MS, 700 * MS])
def test_first_passage_times_are_inverse_gaussian(frame_ns, device):
    """Drift 10 / s, noise 1.2 / sqrt(s): waits are IG(1 / drift, 1 / noise^2), whatever the frames."""
    drift, noise = 10.0, 1.2
    k = {**VOLTMETER, "k4": drift * 1e-6, "k6": noise * 1e-3}
    camera = make_camera(40, 30, device, stochastic=k)
    found = still(camera, 0.0, np.arange(0, 7 * S + 1, frame_ns))
    mean, shape = 1.0 / drift, 1.0 / noise**2
    law = stats.invgauss(mean / shape, scale=shape)
    waits = intervals_us(found, 40) * 1e-6
    assert waits.size > 60_000
    # OFF first: exp(-2 drift / noise^2) = 1e-6; a wait that is cut off at the end: 1 of 70 per pixel
    distance = stats.kstest(waits, law.cdf).statistic
    assert distance < stats.kstwobign.isf(ALARM) / math.sqrt(waits.size) + 1.0 / 200.0
    assert stats.kstest(waits, stats.invgauss(1.1 * mean / shape, scale=shape).cdf).statistic > 0.02
    # events in time T: mean drift T, less the part of a threshold still under way; variance noise^2 T
    pixels = 40 * 30
    deviation = math.sqrt(noise**2 * 7.0 * pixels)
    assert abs(len(found.t) - drift * 7.0 * pixels) <= 4.9 * deviation + pixels


def exit_survival(time: np.ndarray) -> np.ndarray:
    """P(a standard Brownian motion from 0 stays within +-1 until a time); Darling, Siegert (1953)."""
    k = 2 * np.arange(60)[:, None] + 1
    terms = (-1.0) ** ((k - 1) // 2) / k * np.exp(-(k**2) * np.pi**2 * time / 8.0)
    return np.asarray(4.0 / np.pi * terms.sum(axis=0))


def test_exit_times_between_two_thresholds(device):
    """Noise without drift: the time to leave (-1, 1) has a known law, and both ways are as likely."""
    noise = 2.0
    camera = make_camera(128, 96, device, stochastic={**VOLTMETER, "k6": noise * 1e-3})
    found = still(camera, 0.0, np.arange(0, 6 * S + 1, S // 3))
    first_s = first_event_s(found, 128 * 96, 128)
    assert not np.isnan(first_s).any()  # P = 4 / pi exp(-pi^2 24 / 8) = 2e-13
    assert stats.kstest(first_s * noise**2, lambda t: 1.0 - exit_survival(t)).pvalue > ALARM
    low, high = stats.binom(len(found.t), 0.5).interval(1.0 - ALARM)
    assert low <= found.polarity.sum() <= high
    assert len(found.t) / (6.0 * 128 * 96) == pytest.approx(noise**2, rel=0.05)  # renewals: mean 1 / noise^2


def test_a_threshold_behind_is_not_forgotten(device):
    """At -0.95, with a drift of 32 / s upwards: OFF comes first with probability exp(-2 drift 0.05)."""
    k = {**VOLTMETER, "k1": 1.0, "k6": 1e-3}
    frames = np.array([0.0, -0.95, 1.05, 3.05])[:, None, None] * np.ones((1, 96, 128))
    found = feed(make_camera(128, 96, device, stochastic=k), frames, [0, 1000, 62_501_000, 125_001_000])
    pixel = found.y.astype(int) * 128 + found.x
    _, first = np.unique(pixel, return_index=True)
    low, high = stats.binom(128 * 96, math.exp(-2.0 * 32.0 * 0.05)).interval(1.0 - ALARM)
    assert low <= (found.polarity[first] == 0).sum() <= high


def test_voltmeter_noise_and_leak_depend_on_light(device):
    """Drift k4 + k5 L, deviation k3 sqrt(L) / (L + k2) + k6 in thresholds and microseconds, at L = 51."""
    k = {**VOLTMETER, "k2": 9.0, "k3": 8e-3, "k4": 2e-6, "k5": 1e-7, "k6": 1e-4}
    camera = make_camera(64, 48, device, stochastic=k)
    found = still(camera, math.log(0.2), np.arange(0, 4 * S + 1, 50 * MS))
    drift = (2e-6 + 51 * 1e-7) * 1e6
    noise = (8e-3 * math.sqrt(51.0) / 60.0 + 1e-4) * 1e3
    signed = 2.0 * found.polarity.astype(int) - 1.0
    # the voltage at the end is the sum of events and a rest within (-1, 1)
    total = np.bincount(found.y.astype(int) * 64 + found.x, weights=signed, minlength=64 * 48)
    pixels = total.size
    assert total.mean() == pytest.approx(drift * 4.0, abs=1.0 + 4.9 * noise * 2.0 / math.sqrt(pixels))
    first = first_event_s(found, pixels, 64)
    mean, shape = 1.0 / drift, 1.0 / noise**2
    assert stats.kstest(first, stats.invgauss(mean / shape, scale=shape).cdf).statistic < 0.05


def test_voltmeter_random_phase(device):
    """Pixels that have been running begin anywhere below the threshold: their first events spread evenly."""
    k = {**VOLTMETER, "k4": 1e-5, "random_phase": True}
    found = still(make_camera(64, 48, device, stochastic=k), 0.0, [0, S // 10])
    assert len(found.t) == 64 * 48
    assert stats.kstest(found.t * 1e-5, stats.uniform.cdf).pvalue > ALARM


# ---- the same noise, however it is asked for


@pytest.mark.parametrize(
    "config",
    [
        NOISY,
        {**NOISY, "low_pass": {"cutoff_hz": 80.0}},
        {"preset": "voltmeter_dvs240", "refractory_s": 1e-3},
        {
            "threshold_jitter": {},
            "lin_log": {"linear_below": 60.0},
            "leak": {"rate_hz": 500.0, "bright_factor": 3.0},
            "measured_noise": {"levels": [{"lux": 500.0, "on_hz": 90.0, "off_hz": 40.0}]},
        },
    ],
)
def test_split_into_calls_does_not_change_a_bit(config, device):
    """One stack, single frames, and stacks under way together: the same packets."""
    frames, stamps = walk(seed=6, shape=(20, 30), count=25)

    def windows(length: int, ahead: int) -> list[Events]:
        camera = EventCamera(
            EventCameraConfig(**config),
            width=30,
            height=20,
            device=device,
            seed=4,
            scan_count_max=ahead + 1,
            on_host=True,
        )
        camera.reset(frames[0])
        packets: list[Events] = []
        stacks = [range(k, min(k + length, 25)) for k in range(1, 25, length)]
        for fed in range(len(stacks) + ahead):
            if fed < len(stacks):
                chosen = list(stacks[fed])
                camera.feed_device(wp.array(frames[chosen], device=device), stamps[chosen])
            if fed >= ahead:
                until = int(stamps[stacks[fed - ahead][-1]])
                begun = camera.window_start_ns
                ends = list(range(begun + 3 * MS, until + 1, 3 * MS))
                packets += camera.collect_windows(ends, scan_count=1)
        return [*packets, camera.collect()]

    whole = windows(24, 0)
    assert sum(len(packet) for packet in whole) > 2000
    for length, ahead in ((1, 0), (5, 2)):
        split = windows(length, ahead)
        assert len(split) == len(whole)
        for a, b in zip(split, whole, strict=True):
            assert_same(a.numpy(), b.numpy())


def test_threads_do_not_change_a_bit():
    """At 346 x 260 the CPU splits rows over threads: 1, 2 or 5 of them."""
    frames, stamps = walk(seed=8, shape=(260, 346), count=4)
    packets = []
    for threads in (1, 2, 5):
        with cores(threads):
            packets.append(feed(make_camera(346, 260, "cpu", **NOISY), frames, stamps))
    assert len(packets[0].t) > 100_000
    for other in packets[1:]:
        assert_same(packets[0], other)


def test_overflow_keeps_the_rows_of_the_same_noise(device):
    """A scan that is done again for event_count_max draws the same noise: what is kept is what there was."""
    frames, stamps = walk(seed=9, count=6)
    free = feed(make_camera(15, 12, device, **NOISY), frames, stamps)
    camera = make_camera(15, 12, device, event_count_max=90, **NOISY)
    camera.reset(frames[0])
    limited = camera.feed(frames[1:], stamps[1:])
    assert limited.dropped_count > 0
    assert len(limited) + limited.dropped_count == len(free.t)
    everything = set(zip(*(column.tolist() for column in free), strict=True))
    assert set(zip(*(column.tolist() for column in limited.numpy()), strict=True)) <= everything


def test_reset_means_reset(device):
    """The first packet after a reset is that of a fresh camera; after a gap the noise is another."""
    config = {**NOISY, "low_pass": {"cutoff_hz": 80.0}}
    frames, stamps = walk(seed=10)
    fresh = feed(make_camera(15, 12, device, **config), frames, stamps)
    camera = make_camera(15, 12, device, **config)
    later = feed(camera, frames, stamps + S)
    camera.feed_device(wp.array(frames[1:3], device=device), [2 * S, 3 * S])
    again = feed(camera, frames, stamps)
    assert_same(fresh, again)
    assert not np.array_equal(fresh.t, later.t - 1_000_000)


def test_seed_of_a_run():
    """The seed of the settings reaches the pixels; batches do not change it."""

    def packets(**overrides: Any) -> list[np.ndarray]:
        config = load_config(
            {
                "duration_s": 0.1,
                "device": "cpu",
                "renderer": "synthetic",
                "scene": {"kind": "hall", "size_m": [8, 6, 3]},
                "path": {"kind": "hover"},
                "sensors": {
                    "events": {
                        "kind": "event_camera",
                        "lens": {"width": 32, "height": 24, "horizontal_fov_rad": 1.5},
                        "pixel": {"preset": "v2e_noisy", "shot_noise": {"rate_hz": 200.0}},
                    }
                },
            },
            overrides=overrides,
        )
        return [np.stack(p.numpy()) for p in run(config) if isinstance(p, Events)]

    first = packets()
    assert sum(p.shape[1] for p in first) > 1000
    for a, b in zip(first, packets(instants_per_launch=3), strict=True):
        np.testing.assert_array_equal(a, b)
    assert any(a.shape != b.shape or (a != b).any() for a, b in zip(first, packets(seed=1), strict=True))


@pytest.mark.parametrize(
    "config",
    [
        {"refractory_s": -1e-3},
        {"white_radiance": 0.0},
        {"threshold_spread": {"minimum": 0.0}},
        {"low_pass": {"cutoff_hz": 0.0}},
        {"leak": {"rate_hz": math.nan}},
        {"shot_noise": {"bright_factor": 1.5}},
        {"hot_pixels": {"fraction": 2.0}},
        {"stochastic": {"k1": 5.0}},
        {"readout": {"queue_length": 0}},
    ],
)
def test_wrong_configuration_is_refused(config):
    with pytest.raises(ValueError, match=next(iter(config))):
        EventCameraConfig(**config)


def test_wrong_seed_is_refused():
    with pytest.raises(ValueError, match=r"seed must be in \[0, 2\^64\), got -1"):
        make_camera(4, 3, "cpu", seed=-1)
