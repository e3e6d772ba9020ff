"""The event law against closed forms and an exact brute force."""

from __future__ import annotations

import logging
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import warp as wp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from neurosim_core.packets import Events
from neurosim_core.sensors.event_config import EventCameraConfig
from neurosim_core.sensors.events import EventCamera

MS = 1_000_000

# the device fixture does not change between examples
relaxed = settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def make_camera(width: int, height: int, device: str, **config: Any) -> EventCamera:
    return EventCamera(EventCameraConfig(**config), width=width, height=height, device=device)


def run(frames: Any, stamps: Any, device: str, **config: Any) -> Events:
    """Reset to the first frame and feed the others in one stack."""
    frames = np.asarray(frames, np.float32)
    camera = make_camera(frames.shape[2], frames.shape[1], device, **config)
    camera.reset(frames[0], stamp_ns=int(stamps[0]))
    return camera.feed(frames[1:], np.asarray(stamps[1:], np.int64))


def one_pixel(samples: Any, stamps: Any, device: str, **config: Any) -> Events:
    return run(np.asarray(samples, np.float32).reshape(-1, 1, 1), stamps, device, **config)


def rows(*packets: Events) -> list[tuple[int, int, int, int]]:
    """All events as (t, y, x, polarity), in the order of the packets."""
    return [
        (int(t), int(y), int(x), int(p))
        for packet in packets
        for t, x, y, p in zip(*packet.numpy(), strict=True)
    ]


def assert_same(a: Events, b: Events) -> None:
    assert (a.start_ns, a.stamp_ns, a.dropped_count) == (b.start_ns, b.stamp_ns, b.dropped_count)
    for first, second in zip(a.numpy(), b.numpy(), strict=True):
        assert first.dtype == second.dtype
        np.testing.assert_array_equal(first, second)


def reach(level: Fraction, base: Fraction, direction: int) -> Fraction:
    """The sample that reaches a level from below (direction 1) or above (-1), by the documented tie rule."""
    if level == base:
        return base
    half_ulp = Fraction(float(np.spacing(np.float32(abs(base))))) / 2
    slack = max(half_ulp, abs(level - base) / 2**23)
    return Fraction(float(np.float32(float(level - direction * slack))))


def reach_exactly(level: Fraction, base: Fraction, direction: int) -> Fraction:
    """No tie rule: samples are taken for exact."""
    return level


def brute_force(
    frames: np.ndarray, stamps: Any, on: float, off: float, reach: Any = reach
) -> list[tuple[int, int, int, int]]:
    """The law in rational arithmetic, pixel by pixel; samples are exact, levels are sums of exact steps."""
    events = []
    threshold_on, threshold_off = Fraction(on), Fraction(off)
    for y in range(frames.shape[1]):
        for x in range(frames.shape[2]):
            signal = [Fraction(float(value)) for value in frames[:, y, x]]
            reference = base = signal[0]
            upper, lower = reach(base + threshold_on, base, 1), reach(base - threshold_off, base, -1)
            for k in range(1, len(signal)):
                low, high = signal[k - 1], signal[k]
                while high >= upper or high <= lower:
                    polarity = int(high >= upper)
                    reference += threshold_on if polarity else -threshold_off
                    upper = reach(reference + threshold_on, base, 1)
                    lower = reach(reference - threshold_off, base, -1)
                    fraction = min((reference - low) / (high - low), Fraction(1))
                    ticks = round(fraction * int(stamps[k] - stamps[k - 1]) * 1024)  # of 2^-10 ns
                    time_ns = int(stamps[k - 1]) + Fraction(max(ticks, 1), 1024)
                    events.append((int(time_ns // 1000), y, x, polarity))
    return sorted(events)


def test_log_ramp_fires_at_equal_times(device):
    """L = s t: event n is at n C / s. Slopes of both signs, one per pixel, in one interval of 1 s."""
    slopes = np.array([0.19, 0.21, 1.0, 7.3, 33.3, -0.19, -0.5, -12.75])
    frames = np.stack([np.zeros((1, 8)), slopes[None, :]]).astype(np.float32)
    events = run(frames, [0, 1_000_000_000], device, threshold_on=0.2, threshold_off=0.1).numpy()
    for x, slope in enumerate(frames[1, 0].astype(np.float64)):
        threshold = 0.2 if slope > 0.0 else 0.1
        crossing_us = np.arange(1, np.floor(abs(slope) / threshold) + 1) * threshold / abs(slope) * 1e6
        mine = events.x == x
        assert mine.sum() == len(crossing_us)
        # floored to the microsecond: at most 1 us early, never late
        assert np.all((crossing_us - events.t[mine] >= -1e-6) & (crossing_us - events.t[mine] < 1.0))
        assert np.all(events.polarity[mine] == (slope > 0.0))


@relaxed
@given(
    slope=st.floats(-60.0, 60.0),
    base=st.floats(-8.0, 8.0),
    on=st.floats(0.05, 1.0),
    off=st.floats(0.05, 1.0),
    frame_count=st.integers(1, 12),
    seed=st.integers(0, 2**32 - 1),
)
def test_log_ramp_of_any_slope_split_into_frames(slope, base, on, off, frame_count, seed, device):
    """A ramp sampled at any instants has floor(rise / C) events at n C / slope after its start."""
    steps = np.random.default_rng(seed).integers(1, 20 * MS, frame_count)
    stamps = np.concatenate([[0], np.cumsum(steps)])
    samples = (base + slope * stamps * 1e-9).astype(np.float32)
    events = one_pixel(samples, stamps, device, threshold_on=on, threshold_off=off).numpy()
    threshold = on if slope > 0.0 else off
    levels = abs(slope) * stamps[-1] * 1e-9 / threshold
    resolution = 4.0 * np.spacing(np.float32(16.0))  # of the samples and the base, in log radiance
    assert (
        np.floor(levels - resolution / threshold)
        <= len(events.t)
        <= np.floor(levels + resolution / threshold)
    )
    crossing_us = np.arange(1, len(events.t) + 1) * threshold / max(abs(slope), 1e-30) * 1e6
    # what rounding the samples moves the crossing by, and the floor
    tolerance_us = 1.0 + resolution / max(abs(slope), 1e-30) * 1e6
    assert np.all(np.abs(events.t - np.minimum(crossing_us, stamps[-1] / 1e3)) <= tolerance_us)
    assert np.all(events.polarity == (slope > 0.0))


@pytest.mark.parametrize("arithmetic", [np.float64, np.float32])
@pytest.mark.parametrize("threshold", [0.05, 0.1, 0.15, 0.2, 0.3, 0.35, 0.5, 1.0])
def test_step_of_k_thresholds_gives_k_events(threshold, arithmetic, device):
    """From any base, up or down and back again, although neither k C nor the samples are exact in float32.

    In float64 base and sample are rounded once each; in float32 so are C and k C.
    """
    special = [0.0, 0.001, -0.2, 0.3, 1.0, -1.7, -3.7, 5.0, 7.99, -9.0, 11.3, -11.3, 100.0, 100.1]
    rng = np.random.default_rng(8)
    base = np.concatenate(
        [special, *(rng.uniform(-scale, scale, 40) for scale in (1e-3, 0.1, 1.0, 10.0, 100.0))]
    )
    base = base.astype(arithmetic)
    k = np.concatenate([np.arange(-20, 21), [-60, 60]])
    step = k.astype(arithmetic) * arithmetic(threshold)
    frames = np.broadcast_to(base, (3, len(k), len(base))).astype(np.float32)
    frames[1] = base + step[:, None]
    camera = make_camera(len(base), len(k), device, threshold_on=threshold, threshold_off=threshold)
    camera.reset(frames[0])
    for frame, polarity in ((1, k > 0), (2, k < 0)):
        events = camera.feed(frames[frame : frame + 1], [frame * MS]).numpy()
        counts = np.zeros((len(k), len(base)), int)
        np.add.at(counts, (events.y, events.x), 1)
        np.testing.assert_array_equal(counts, np.broadcast_to(np.abs(k)[:, None], counts.shape))
        np.testing.assert_array_equal(events.polarity, polarity[events.y])


@pytest.mark.parametrize(
    ("base", "step"), [(5.0, 0.1999993), (-9.0, 0.199998), (0.0, 0.19999994), (100.0, 0.19998)]
)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_step_short_of_the_threshold_by_more_than_rounding_is_silent(base, step, sign, device):
    assert len(one_pixel([base, base + sign * step], [0, MS], device)) == 0


@pytest.mark.parametrize("base", [0.0, -1.7, 5.0])
@pytest.mark.parametrize("tail", ["sigmoid", "gauss"])
def test_bar_with_tails_against_exact_samples(base, tail, device):
    """A bar of width 1.5 px, 2 turns per second: pixels creep back to where they began.

    Its samples come near no level but the first one, where there is no slack: the events are those of samples
    taken for exact.
    """
    y, x = np.mgrid[:12, :12] - 5.5
    stamps = np.arange(0, 280) * MS
    angle = 4.0 * np.pi * stamps[:, None, None] * 1e-9
    distance = np.abs(x * np.sin(angle) - y * np.cos(angle))
    if tail == "sigmoid":
        bar = 1.0 / (1.0 + np.exp((distance - 1.5) / 0.25))
    else:
        bar = np.exp(-0.5 * (distance / 1.5) ** 2)
    frames = (base + 1.3 * bar).astype(np.float32)
    events = run(frames, stamps, device)
    assert len(events) > 1000
    assert rows(events) == brute_force(frames, stamps, 0.2, 0.2, reach_exactly)


@pytest.mark.parametrize("base", [0.3, 5.0, -9.0])
def test_slow_ramp_is_early_by_its_rounding_at_most(base, device):
    """1e-3 / s at 1 kHz, about an ulp per sample: the event is at most 1.5 ulp early, and never late."""
    stamps = np.arange(0, 600) * MS
    samples = (np.float32(base) + 0.1995 + 1e-3 * stamps * 1e-9).astype(np.float32)
    samples[0] = base
    [(time_us, _, _, polarity)] = rows(one_pixel(samples, stamps, device))
    ulp = float(np.spacing(np.float32(abs(base))))
    assert polarity == 1
    assert -1.5 * ulp / 1e-3 <= time_us * 1e-6 - 0.5 <= 1e-3 + 0.5 * ulp / 1e-3


@relaxed
@given(seed=st.integers(0, 2**32 - 1), on=st.floats(0.02, 0.6), off=st.floats(0.02, 0.6))
def test_noise_against_brute_force(seed, on, off, device):
    """Random walks on random instants: times, order and counts are those of rational arithmetic."""
    rng = np.random.default_rng(seed)
    frames = rng.normal(scale=0.3, size=(9, 4, 5)).cumsum(axis=0).astype(np.float32)
    stamps = 12_345 + np.concatenate([[0], rng.integers(1, 3 * MS, 8)]).cumsum()
    events = run(frames, stamps, device, threshold_on=on, threshold_off=off)
    assert rows(events) == brute_force(frames, stamps, on, off)


@pytest.mark.parametrize(("amplitude", "frequency_hz"), [(0.08, 50), (0.5, 50), (1.0, 200), (2.3, 30)])
def test_sinusoid_against_brute_force_and_closed_form(amplitude, frequency_hz, device):
    """A sinusoid from 0 crosses n = floor(A / C) levels up, then 2 n per half period, less the last."""
    threshold = 0.15
    stamps = np.arange(0, 200 * MS + 1, MS // 8)
    phase = 2.0 * np.pi * frequency_hz * stamps * 1e-9
    samples = (amplitude * np.sin(phase)).astype(np.float32)
    events = one_pixel(samples, stamps, device, threshold_on=threshold, threshold_off=threshold)
    assert rows(events) == brute_force(samples.reshape(-1, 1, 1), stamps, threshold, threshold)
    # L_ref moves between the levels +-n C: n up, then 2 n at every half period, the last one only back to 0
    n = int(amplitude / threshold)
    half_periods = round(2 * frequency_hz * 0.2)
    swings = n + 2 * n * (half_periods - 1)
    assert swings <= len(events) <= swings + n


@relaxed
@given(threshold=st.floats(0.05, 2.0), base=st.floats(-5.0, 5.0), seed=st.integers(0, 2**32 - 1))
def test_changes_below_the_threshold_never_fire(threshold, base, seed, device):
    """However often it moves, and however large the peak to peak: only the distance to L_ref counts."""
    noise = np.random.default_rng(seed).uniform(-1.0, 1.0, size=(50, 6, 7)) * threshold * 0.9999
    frames = np.concatenate([np.zeros((1, 6, 7)), noise]) + base
    assert len(run(frames, np.arange(51) * MS, device, threshold_on=threshold, threshold_off=threshold)) == 0


def test_static_scene_is_silent(device):
    frame = np.random.default_rng(0).normal(scale=5.0, size=(48, 64)).astype(np.float32)
    events = run(np.stack([frame] * 20), np.arange(20) * MS, device, threshold_on=1e-3, threshold_off=1e-3)
    assert len(events) == 0
    assert [a.dtype for a in events.numpy()] == [np.int64, np.uint16, np.uint16, np.uint8]
    assert [a.shape for a in events.numpy()] == [(0,)] * 4


def test_residual_is_kept(device):
    """1.5 C up, then 0.75 C more: one event each, the second at two thirds of its interval."""
    events = one_pixel([0.0, 0.3, 0.45], [0, MS, 2 * MS], device)
    assert rows(events) == [(666, 0, 0, 1), (1666, 0, 0, 1)]


def test_reversal_needs_a_whole_threshold_from_the_last_level(device):
    """Up to 2.9 C (L_ref 2 C), down to 1.1 C: nothing; to 0.9 C: one event."""
    assert len(one_pixel([0.0, 0.58, 0.22], [0, MS, 2 * MS], device)) == 2
    events = rows(one_pixel([0.0, 0.58, 0.18], [0, MS, 2 * MS], device))
    assert [event[3] for event in events] == [1, 1, 0]
    assert events[2][0] == 1000 + int((0.58 - 0.2) / (0.58 - 0.18) * 1000)


def test_moving_edge(device):
    """A log-linear edge of height 1 and width 4 px moving at 200 px/s passes pixel x at a known time.

    L(x, t) = clip((v t - x) / w, 0, 1) is linear in t for each pixel, and rendered at its kinks: every pixel
    fires 5 events of C = 0.2, at v t = x + w n C.
    """
    x = np.arange(32)
    stamps = np.arange(0, 181) * MS  # a kink every 5 ms, of which all are sampled
    frames = np.clip((200.0 * stamps[:, None] * 1e-9 - x) / 4.0, 0.0, 1.0)[:, None, :].repeat(3, axis=1)
    events = run(frames, stamps, device).numpy()
    assert len(events.t) == 3 * 32 * 5
    for y in range(3):
        for column in range(32):
            t = events.t[(events.x == column) & (events.y == y)]
            expected_us = (column + 4.0 * 0.2 * np.arange(1, 6)) / 200.0 * 1e6
            # samples near 1 have an ulp of 6e-8, on a slope of 50 / s: 1.2 ns; and the floor of 1 us
            np.testing.assert_allclose(t, expected_us, atol=1.01)
    assert np.all(events.polarity == 1)


def test_rotating_bar(device):
    """A dark bar that turns once in front of each pixel: ON and OFF counts and times have a closed form.

    The pixel at angle a sees log radiance -d(a - w t), a triangle of depth 1 and half width 0.1 rad around
    the bar's two ends; rendered at 10 us, linear between.
    """
    height = width = 15
    rate_rad_s = 10.0
    y, x = np.mgrid[:height, :width] - 7.0
    angle = np.arctan2(y, x)
    stamps = np.arange(0, 320 * MS, MS // 10)
    turned = rate_rad_s * stamps[:, None, None] * 1e-9
    distance = np.abs((angle - turned + np.pi / 2) % np.pi - np.pi / 2)
    log_radiance = -np.clip(1.0 - distance / 0.1, 0.0, 1.0)
    events = run(log_radiance, stamps, device, threshold_on=0.3, threshold_off=0.22).numpy()
    for row, col in [(0, 0), (3, 12), (14, 7), (9, 2)]:
        phase = angle[row, col] % np.pi
        if not 0.2 < phase < np.pi - 0.2:
            continue
        mine = (events.x == col) & (events.y == row)
        # depth 1: down 4 * 0.22 = 0.88 (4 events), back up 2 * 0.3 to -0.28 (2), 0.28 stays below 0.3
        np.testing.assert_array_equal(events.polarity[mine], [0, 0, 0, 0, 1, 1])
        levels = np.array([-0.22, -0.44, -0.66, -0.88, -0.58, -0.28])
        side = np.array([-1, -1, -1, -1, 1, 1])
        expected_s = (phase + side * 0.1 * (1.0 + levels)) / rate_rad_s
        # the closest approach falls between samples, the flanks are straight: only rounding and the floor
        np.testing.assert_allclose(events.t[mine], expected_s * 1e6, atol=1.1)


def test_unequal_thresholds(device):
    """ON 0.3, OFF 0.1 on a triangle of height 1: 3 up to 0.9, then 9 down to 0."""
    events = one_pixel([0.0, 1.0, 0.0], [0, MS, 2 * MS], device, threshold_on=0.3, threshold_off=0.1)
    polarity = events.numpy().polarity
    np.testing.assert_array_equal(polarity, [1] * 3 + [0] * 9)


def test_order_is_time_row_column_polarity(device):
    """Whatever pixels share a microsecond, and where events of one pixel coincide."""
    rng = np.random.default_rng(1)
    frames = rng.normal(scale=3.0, size=(9, 20, 30)).cumsum(axis=0).astype(np.float32)
    events = run(frames, np.arange(9) * 40_000, device)  # 40 us: about 100 events in each microsecond
    found = rows(events)
    assert len(found) > 50_000
    assert found == sorted(found)
    a = events.numpy()
    assert (a.x.max(), a.y.max()) == (29, 19)
    assert np.all((a.t >= 0) & (a.t <= 320))


@relaxed
@given(
    splits=st.lists(st.integers(0, 5), min_size=1, max_size=6),
    seed=st.integers(0, 2**32 - 1),
    step_ns=st.integers(1, 2000),
)
def test_split_into_calls_does_not_change_a_bit(splits, seed, step_ns, device):
    """Stacks of any length, also of none, on stamps of a few ns: the same events, the same state."""
    rng = np.random.default_rng(seed)
    count = sum(splits)
    frames = rng.normal(scale=0.4, size=(count + 2, 5, 6)).cumsum(axis=0).astype(np.float32)
    stamps = np.concatenate([[0], rng.integers(1, 1 + step_ns, count + 1)]).cumsum()
    camera = make_camera(6, 5, device)
    camera.reset(frames[0], stamp_ns=int(stamps[0]))
    packets, first = [], 1
    for k in [*splits, 1]:
        packets.append(camera.feed(frames[first : first + k], stamps[first : first + k]))
        first += k
    whole = run(frames, stamps, device)
    # packets are cut exactly at their stamps, which may lie within a microsecond: sort across the cut
    assert sorted(rows(*packets)) == rows(whole)
    for packet, previous in zip(packets[1:], packets, strict=False):
        assert packet.start_ns == previous.stamp_ns
    assert [packet.sequence for packet in packets] == list(range(len(packets)))


@relaxed
@given(splits=st.lists(st.integers(1, 7), min_size=1, max_size=8), seed=st.integers(0, 2**32 - 1))
def test_windows_do_not_depend_on_the_stacks(splits, seed, device):
    """Windows of 3003 ns on frames of 700 ns, in stacks of any length: identical packets."""
    rng = np.random.default_rng(seed)
    count = sum(splits)
    frames = rng.normal(scale=0.4, size=(count + 1, 5, 6)).cumsum(axis=0).astype(np.float32)
    stamps = 5_250 + 700 * np.arange(count + 1)

    def windows(lengths: list[int]) -> list[Events]:
        camera = make_camera(6, 5, device)
        camera.reset(frames[0], stamp_ns=int(stamps[0]))
        packets: list[Events] = []
        first, end_ns = 1, int(stamps[0])
        for k in lengths:
            frame_array = wp.array(frames[first : first + k], device=device)
            camera.feed_device(frame_array, stamps[first : first + k])
            first += k
            ends = list(range(end_ns + 3003, int(stamps[first - 1]) + 1, 3003))
            packets += camera.collect_windows(ends)
            end_ns = ends[-1] if ends else end_ns
        return [*packets, camera.collect()]

    split, whole = windows(splits), windows([count])
    assert len(split) == len(whole)
    for a, b in zip(split, whole, strict=True):
        assert_same(a, b)
    assert sorted(rows(*whole)) == rows(run(frames, stamps, device))


@pytest.mark.parametrize("scan_count_max", [2, 3])
@pytest.mark.parametrize("config", [{}, {"event_count_max": 40}, {"threshold_on": 0.01}])
def test_scans_under_way_change_nothing(device, scan_count_max, config):
    """Stacks fed before earlier ones are collected: same packets, also where a scan is done again."""
    rng = np.random.default_rng(11)
    frames = rng.normal(scale=0.3, size=(33, 6, 7)).cumsum(axis=0).astype(np.float32)
    stamps = np.arange(33) * 1_700

    def windows(camera: EventCamera, ahead: int) -> list[Events]:
        camera.reset(frames[0])
        stacks = [wp.array(frames[k : k + 4], device=device) for k in range(1, 33, 4)]
        packets: list[Events] = []
        end_ns = 0
        for fed in range(len(stacks) + ahead):
            if fed < len(stacks):
                camera.feed_device(stacks[fed], stamps[1 + 4 * fed : 5 + 4 * fed])
            if fed >= ahead:
                ends = list(range(end_ns + 5005, int(stamps[4 * (fed - ahead + 1)]) + 1, 5005))
                packets += camera.collect_windows(ends, scan_count=1)
                end_ns = ends[-1] if ends else end_ns
        return [*packets, camera.collect()]

    camera = EventCamera(
        EventCameraConfig(**config),
        width=7,
        height=6,
        device=device,
        scan_count_max=scan_count_max,
        on_host=True,
    )
    ahead = windows(camera, scan_count_max - 1)
    alone = windows(make_camera(7, 6, device, **config), 0)
    assert all(isinstance(column, np.ndarray) for p in ahead for column in (p.t, p.x, p.y, p.polarity))
    assert sum(packet.dropped_count for packet in ahead) > 0 or "event_count_max" not in config
    assert len(ahead) == len(alone) > 8
    for a, b in zip(ahead, alone, strict=True):
        assert_same(a, b)
        assert a.sequence == b.sequence


def test_more_scans_than_agreed_are_refused(device):
    camera = EventCamera(EventCameraConfig(), width=5, height=4, device=device, scan_count_max=2)
    camera.reset(np.zeros((4, 5), np.float32))
    frames = wp.zeros((1, 4, 5), dtype=float, device=device)
    camera.feed_device(frames, [1000])
    with pytest.raises(ValueError, match="later than 1000"):
        camera.feed_device(frames, [1000])
    camera.feed_device(frames, [2000])
    with pytest.raises(RuntimeError, match=r"after 2 feed_device"):
        camera.feed_device(frames, [3000])
    assert camera.collect().stamp_ns == 2000


def test_windows_are_cut_by_nanoseconds(device):
    """Crossings at 2500.0 and 2500.5 ns share a microsecond; the window ends at 2500."""
    camera = make_camera(2, 1, device)
    camera.reset(np.zeros((1, 2), np.float32))
    rise = np.array([[0.4, 0.2 * 5000 / 2500.5]], np.float32)
    camera.feed_device(wp.array(rise[None], device=device), [5000])
    first, second = camera.collect_windows([2500, 4000])
    assert rows(first) == [(2, 0, 0, 1)]
    assert rows(second) == [(2, 0, 1, 1)]
    assert (first.start_ns, first.stamp_ns, second.start_ns, second.stamp_ns) == (0, 2500, 2500, 4000)
    assert rows(camera.collect()) == [(5, 0, 0, 1)]


def test_crossing_right_after_a_frame_belongs_to_the_window_after(device):
    """1e-7 under the level at 2000 ns, crossed 1e-7 ns later: that window had closed, in any split."""
    camera = make_camera(1, 1, device)
    camera.reset(np.zeros((1, 1), np.float32))
    frames = np.array([0.2 - 1e-7, 100.0], np.float32).reshape(2, 1, 1)
    camera.feed_device(wp.array(frames, device=device), [2000, 2100])
    first, second = camera.collect_windows([2000])[0], camera.collect()
    assert len(first) == 0
    assert rows(second) == [(2, 0, 0, 1)] * 500


def test_device_form_reads_only_its_frames(device):
    """A buffer longer than the stack: the frames behind are not read, though they hold nonsense."""
    frames = np.full((16, 3, 4), np.nan, np.float32)
    frames[:2] = np.array([0.25, 0.5]).reshape(2, 1, 1)
    camera = make_camera(4, 3, device)
    camera.reset(np.zeros((3, 4), np.float32))
    camera.feed_device(wp.array(frames, device=device), [MS, 2 * MS])
    assert len(camera.collect()) == 24
    assert len(camera.collect()) == 0


def test_a_million_events_do_not_drift(device):
    """Triangles between -5 and 5 through 1e6 events, ON and OFF apart: every period has the same events."""
    per_swing = 50
    samples = np.tile(np.array([5.0, -5.0], np.float32), 10_000).reshape(-1, 1, 1)
    stamps = np.arange(1, 20_001) * MS
    camera = make_camera(1, 1, device)
    camera.reset(np.full((1, 1), -5.0, np.float32))
    t = np.concatenate(
        [
            camera.feed(f, s).numpy().t
            for f, s in zip(samples.reshape(40, -1, 1, 1), stamps.reshape(40, -1), strict=True)
        ]
    )
    assert len(t) == 20_000 * per_swing
    expected_us = 1000 * np.arange(20_000)[:, None] + 20 * np.arange(1, per_swing + 1)
    np.testing.assert_array_equal(t.reshape(20_000, per_swing), expected_us)


def test_reference_does_not_drift_with_unequal_thresholds(device):
    """ON 0.3 and OFF 0.1 (neither exact): after 3e5 swings L_ref is still where one swing leaves it.

    A sample 1e-5 short of the next level stays silent, one 1e-5 past it fires.
    """
    samples = np.tile(np.array([0.9, 0.0], np.float32), 20_000).reshape(-1, 1, 1)
    config = {"threshold_on": 0.3, "threshold_off": 0.1}
    for last, count in ((0.29999, 0), (0.30001, 1), (-0.09999, 0), (-0.10001, 1)):
        camera = make_camera(1, 1, device, **config)
        camera.reset(np.zeros((1, 1), np.float32))
        assert len(camera.feed(samples, np.arange(1, 40_001) * 1000)) == 20_000 * (3 + 9)
        assert len(camera.feed(np.full((1, 1, 1), last, np.float32), [50_000_000])) == count


def test_overflow_is_counted_and_keeps_the_top_rows(device, caplog):
    """200 events fit: of 3 rows with 80 each, two are kept, and one lost, in that interval only."""
    config = {"event_count_max": 200, "threshold_on": 0.1, "threshold_off": 0.1}
    frames = np.zeros((4, 3, 8), np.float32)
    frames[1] = 0.55  # 5 per pixel: 120 in total
    frames[2] = 1.55  # 10 per pixel: 240
    frames[3] = 1.15  # 1.5 is the reference: 3 per pixel
    stamps = np.arange(4) * MS
    with caplog.at_level(logging.WARNING):
        events = run(frames, stamps, device, **config)
    free = run(frames, stamps, device, threshold_on=0.1, threshold_off=0.1)
    assert events.dropped_count == 80
    assert len(events) + events.dropped_count == len(free) == 120 + 240 + 72
    kept = [event for event in rows(free) if not (1000 < event[0] <= 2000 and event[1] == 2)]
    assert rows(events) == kept
    assert "event_count_max = 200" in caplog.text
    assert "80 dropped" in caplog.text

    camera = make_camera(8, 3, device, **config)
    camera.reset(frames[0])
    split = [camera.feed(frames[k : k + 1], stamps[k : k + 1]) for k in (1, 2, 3)]
    assert [packet.dropped_count for packet in split] == [0, 80, 0]
    assert rows(*split) == kept


def test_overflow_of_every_row(device):
    """Not even the first row fits: all is lost, and said so; the pixels still followed the signal."""
    camera = make_camera(8, 3, device, event_count_max=10)
    camera.reset(np.zeros((3, 8), np.float32))
    lost = camera.feed(np.full((1, 3, 8), 0.5, np.float32), [MS])
    assert (len(lost), lost.dropped_count) == (0, 48)
    assert len(camera.feed(np.full((1, 3, 8), 0.45, np.float32), [2 * MS])) == 0


def test_buffer_grows_instead_of_losing(device):
    """The buffer begins with 16 events per pixel or less; 301 of each are all there, the state is right."""
    frames = np.zeros((3, 6, 7), np.float32)
    frames[1] = 3.0
    frames[2] = 2.985
    events = run(frames, np.arange(3) * MS, device, threshold_on=0.01, threshold_off=0.01)
    assert (len(events), events.dropped_count) == (6 * 7 * 301, 0)


def test_large_image_is_scanned_in_parts(device):
    """At 346 x 260 the CPU splits rows over threads: equal to brute force on some pixels, and run to run."""
    rng = np.random.default_rng(2)
    frames = rng.normal(scale=0.3, size=(4, 260, 346)).cumsum(axis=0).astype(np.float32)
    stamps = np.arange(4) * MS
    events = run(frames, stamps, device)
    a = events.numpy()
    for row in (0, 129, 130, 259):
        expected = brute_force(frames[:, row : row + 1, :40], stamps, 0.2, 0.2)
        mine = (a.y == row) & (a.x < 40)
        assert [
            (t, 0, x, p) for t, x, p in zip(a.t[mine], a.x[mine], a.polarity[mine], strict=True)
        ] == expected
    assert_same(events, run(frames, stamps, device))


def test_quiet_frames_change_nothing(device):
    """On a CPU they are skipped, however long, up to the frame in which a pixel reaches a level."""
    rng = np.random.default_rng(6)
    frames = rng.normal(scale=0.05, size=(33, 20, 25)).cumsum(axis=0).astype(np.float32)
    stamps = np.arange(33) * MS
    camera = make_camera(25, 20, device)
    camera.reset(frames[0])
    packets = [camera.feed(frames[k : k + 8], stamps[k : k + 8]) for k in (1, 9, 17, 25)]
    assert all(len(packet) > 100 for packet in packets)
    assert rows(*packets) == brute_force(frames, stamps, 0.2, 0.2)


def test_reset_means_reset(device):
    """The first packet after a reset is that of a fresh camera, also in the middle of everything."""
    rng = np.random.default_rng(3)
    frames = rng.normal(size=(6, 4, 5)).cumsum(axis=0).astype(np.float32)
    camera = make_camera(5, 4, device)
    camera.reset(frames[0] + 3.0, stamp_ns=77)
    camera.feed(frames[1:3], [100, 200])
    camera.feed_device(wp.array(frames[3:5], device=device), [300_000, 400_000])
    camera.collect_windows([350_000])
    camera.feed_device(wp.array(frames[3:5], device=device), [500_000, 600_000])
    camera.reset(frames[0], stamp_ns=10)
    again = camera.feed(frames[1:], np.arange(1, 6) * MS)
    fresh = run(frames, [10, *(np.arange(1, 6) * MS)], device)
    assert_same(again, fresh)
    assert again.sequence == fresh.sequence == 0


def test_stamps_far_from_zero(device):
    """Hours into an episode, and before its start, times keep their microsecond."""
    for start_ns in (86_400_000_000_123, -5_000_000_250):
        camera = make_camera(640, 2, device)
        camera.reset(np.zeros((2, 640), np.float32), stamp_ns=start_ns)
        events = camera.feed(np.full((1, 2, 640), 0.4, np.float32), [start_ns + MS])
        t = events.numpy().t
        assert set(t.tolist()) == {(start_ns + MS // 2) // 1000, (start_ns + MS) // 1000}


def test_warp_arrays_are_taken_as_they_are(device):
    frames = np.random.default_rng(4).normal(size=(3, 4, 5)).astype(np.float32)
    camera = make_camera(5, 4, device)
    camera.reset(wp.array(frames[0], device=device))
    events = camera.feed(wp.array(frames[1:], device=device), [MS, 2 * MS])
    assert rows(events) == rows(run(frames, [0, MS, 2 * MS], device))


def test_frames_need_not_be_contiguous(device):
    wide = np.random.default_rng(5).normal(size=(4, 5, 3)).astype(np.float32)
    frames = wide.transpose(2, 0, 1)
    camera = make_camera(5, 4, device)
    camera.reset(frames[0])
    events = camera.feed(frames[1:], [MS, 2 * MS])
    assert rows(events) == rows(run(np.ascontiguousarray(frames), [0, MS, 2 * MS], device))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1001.0, -1e30])
def test_values_that_are_no_log_radiance_are_named(value, device):
    frames = np.zeros((3, 4, 5), np.float32)
    camera = make_camera(5, 4, device)
    with pytest.raises(
        ValueError, match=r"log_radiance must be finite.*1 values are not, the first at \[2, 3\]"
    ):
        camera.reset(np.where(np.arange(20).reshape(4, 5) == 13, value, 0.0).astype(np.float32))
    camera.reset(frames[0])
    frames[1, 2, 3] = frames[2, 0, 1] = value
    with pytest.raises(ValueError, match=r"2 values are not, the first at \[1, 2, 3\]"):
        camera.feed(frames, [MS, 2 * MS, 3 * MS])
    with pytest.raises(RuntimeError, match="reset"):
        camera.feed(frames[:1], [4 * MS])
    camera.reset(frames[0])
    assert len(camera.feed(frames[:1], [MS])) == 0


@pytest.mark.parametrize(
    ("frames", "stamps", "message"),
    [
        (
            np.zeros((1, 4, 4), np.float32),
            [MS],
            r"float32 of shape \[1, 4, 5\], got float32 of shape \[1, 4, 4\]",
        ),
        (np.zeros((4, 5), np.float32), [MS], r"float32 of shape \[1, 4, 5\]"),
        (np.zeros((1, 4, 5)), [MS], "got float64"),
        (np.zeros((2, 4, 5), np.float32), [MS], r"shape \[1, 4, 5\]"),
        (np.zeros((2, 4, 5), np.float32), [MS, MS], f"strictly increasing, got {MS} after {MS}"),
        (np.zeros((1, 4, 5), np.float32), [0], "later than 0, got 0"),
        (np.zeros((1, 4, 5), np.float32), [-3], "later than 0, got -3"),
        (np.zeros((1, 4, 5), np.float32), [0.5], "must be integers"),
        (np.zeros((1, 4, 5), np.float32), MS, "must be integers of shape"),
        (np.zeros((1, 4, 5), np.float32), [2**62], "of the last window"),
    ],
)
def test_wrong_input_is_refused_and_harmless(frames, stamps, message, device):
    camera = make_camera(5, 4, device)
    camera.reset(np.zeros((4, 5), np.float32))
    with pytest.raises(ValueError, match=message):
        camera.feed(frames, stamps)
    assert len(camera.feed(np.full((1, 4, 5), 0.25, np.float32), [MS])) == 20


def test_calls_in_the_wrong_order_are_refused(device):
    camera = make_camera(5, 4, device)
    frames = wp.zeros((2, 4, 5), dtype=float, device=device)
    for call in (
        lambda: camera.feed_device(frames, [1]),
        camera.collect,
        lambda: camera.feed(frames, [1, 2]),
    ):
        with pytest.raises(RuntimeError, match="reset"):
            call()
    with pytest.raises(ValueError, match=r"shape \[4, 5\]"):
        camera.reset(np.zeros((5, 4), np.float32))
    camera.reset(np.zeros((4, 5), np.float32))
    for shape, stamps in (((2, 4, 6), [1]), ((2, 4, 5), [1, 2, 3]), ((2, 4, 5), []), ((4, 5), [1])):
        with pytest.raises(ValueError, match="must be contiguous of shape"):
            camera.feed_device(wp.zeros(shape, dtype=float, device=device), stamps)
    camera.feed_device(frames, [5000, 9000])
    with pytest.raises(RuntimeError, match="collect"):
        camera.feed_device(frames, [10_000])
    for ends in ([9001], [500], [3000, 3999], [4000, 3000]):
        with pytest.raises(ValueError, match="ends_ns must increase"):
            camera.collect_windows(ends)
    assert [packet.stamp_ns for packet in camera.collect_windows([3000, 4000])] == [3000, 4000]
    assert camera.collect().start_ns == 4000


@pytest.mark.parametrize(
    "config",
    [
        {"threshold_on": 0.0},
        {"threshold_off": -0.2},
        {"threshold_on": np.nan},
        {"treshold_on": 0.2},
        {"event_count_max": 0},
    ],
)
def test_wrong_configuration_is_refused(config):
    with pytest.raises(ValueError, match=next(iter(config))):
        EventCameraConfig(**config)


@pytest.mark.parametrize("size", [(0, 4), (4, -1), (4, 65537)])
def test_wrong_size_is_refused(size):
    with pytest.raises(ValueError, match=r"must be in \[1, 65536\]"):
        EventCamera(EventCameraConfig(), width=size[0], height=size[1])


def test_more_events_than_a_block_shares_come_out_the_same(device):
    """Neighbours fire dozens of times a frame, which threads share on CUDA as far as there is room."""
    rng = np.random.default_rng(12)
    frames = rng.normal(scale=3.0, size=(9, 24, 40)).astype(np.float32)
    stamps = 1000 * np.arange(1, 9)
    together = EventCamera(EventCameraConfig(), width=40, height=24, device=device)
    alone = EventCamera(EventCameraConfig(), width=40, height=24, device="cpu")
    together.reset(frames[0])
    alone.reset(frames[0])
    found = together.feed(frames[1:], stamps).numpy()
    pieces = [alone.feed(frames[k : k + 1], stamps[k - 1 : k]).numpy() for k in range(1, 9)]
    assert len(found.t) > 8 * 1024 * (24 * 40 // 256)
    for name in ("t", "x", "y", "polarity"):
        expected = np.concatenate([getattr(piece, name) for piece in pieces])
        np.testing.assert_array_equal(getattr(found, name), expected)
