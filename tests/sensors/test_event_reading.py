"""Events are the same however far what is fed is ahead of what is read, and stay as they were handed out."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import pytest
import warp as wp
from allocations import allocations
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from late_device import LateDevice, install

from neurosim_core.packets import Events
from neurosim_core.sensors.event_config import EventCameraConfig, ShotNoiseConfig
from neurosim_core.sensors.events import EventCamera

WIDTH, HEIGHT = 9, 7
FRAME_NS = 1_700
WINDOW_NS = 5_005

# the device does not change between examples
relaxed = settings(
    max_examples=150,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def make_camera(device: str, *, lanes: int = 1, **config: Any) -> EventCamera:
    return EventCamera(
        EventCameraConfig(**config),
        width=WIDTH,
        height=HEIGHT,
        device=device,
        scan_count_max=lanes,
        on_host=True,
    )


def draw_stacks(
    rng: np.random.Generator, lengths: list[int], loudness: list[float]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return a first frame, and stacks that go on from there, by steps of given sizes."""
    shape = (HEIGHT, WIDTH)
    frame = rng.normal(scale=0.3, size=shape).astype(np.float32)
    first, stacks = frame, []
    for length, scale in zip(lengths, loudness, strict=True):
        steps = rng.normal(scale=scale, size=(length, *shape)).astype(np.float32)
        stacks.append(frame + steps.cumsum(axis=0, dtype=np.float32))
        frame = stacks[-1][-1]
    return first, stacks


def ends_until(start_ns: int, end_ns: int) -> list[int]:
    """Return the ends of windows in (start_ns, end_ns], none shorter than a camera takes."""
    return [n * WINDOW_NS for n in range((start_ns + 999) // WINDOW_NS + 1, end_ns // WINDOW_NS + 1)]


def fly(
    camera: EventCamera,
    stacks: list[np.ndarray],
    *,
    lanes: int,
    reads: list[str],
) -> list[Events]:
    """Feed stacks ahead of what is read, and read each somehow."""
    device, packets = camera.device, []
    fed_ns, read_ns = camera.stamp_ns, camera.stamp_ns
    under_way: deque[int] = deque()

    def read() -> None:
        nonlocal read_ns
        number, how = len(stacks) - len(waiting) - len(under_way), reads
        end_ns = under_way.popleft()
        if how[number] == "all":
            while under_way:
                end_ns = under_way.popleft()
            packets.extend(camera.collect_windows(ends_until(read_ns, end_ns)))
        elif how[number] == "collect":
            while under_way:
                end_ns = under_way.popleft()
            packets.append(camera.collect())
        elif how[number] == "early":  # as where a collision ends a run
            packets.extend(camera.collect_windows(ends_until(read_ns, end_ns)[:-1], scan_count=1))
            read_ns = camera.window_start_ns
            return
        else:
            packets.extend(camera.collect_windows(ends_until(read_ns, end_ns), scan_count=1))
        read_ns = end_ns

    waiting = deque(stacks)
    longest = max(len(stack) for stack in stacks)
    lane_frames = [wp.empty((longest, HEIGHT, WIDTH), dtype=float, device=device) for _ in range(lanes)]
    while waiting:
        stack = waiting.popleft()
        stamps = fed_ns + FRAME_NS * np.arange(1, len(stack) + 1)
        fed_ns = int(stamps[-1])
        frames = lane_frames[len(waiting) % lanes]  # the stack that was in them has been read
        wp.copy(frames, wp.array(stack, device=device))
        camera.feed_device(frames, stamps)
        under_way.append(fed_ns)
        if len(under_way) == lanes:
            read()
    while under_way:
        read()
    return [*packets, camera.collect()]


def assert_same(found: list[Events], plain: list[Events]) -> None:
    assert len(found) == len(plain)
    for a, b in zip(found, plain, strict=True):
        assert (a.start_ns, a.stamp_ns, a.sequence, a.dropped_count) == (
            b.start_ns, b.stamp_ns, b.sequence, b.dropped_count,
        )  # fmt: skip
        for first, second in zip(a.numpy(), b.numpy(), strict=True):
            assert first.dtype == second.dtype
            np.testing.assert_array_equal(first, second)


@relaxed
@given(data=st.data(), lanes=st.integers(1, 3), seed=st.integers(0, 2**32 - 1))
def test_packets_are_the_same_however_they_are_read(data, lanes, seed, device):
    """Bursts of events, too many of them, reads in any order: they are those of stacks that are fed whole."""
    count = data.draw(st.integers(2, 12))

    def lists(values: Any) -> Any:
        return data.draw(st.lists(values, min_size=count, max_size=count))

    lengths = lists(st.integers(1, 6))
    loudness = lists(st.sampled_from([0.0, 0.1, 0.3, 0.3, 2.0]))
    reads = lists(st.sampled_from(["one", "one", "one", "all", "collect", "early"]))
    config = data.draw(
        st.sampled_from([{}, {"event_count_max": 60}, {"shot_noise": ShotNoiseConfig(rate_hz=2e4)}])
    )
    first, stacks = draw_stacks(np.random.default_rng(seed), lengths, loudness)
    camera, whole = make_camera(device, lanes=lanes, **config), make_camera("cpu", **config)
    camera.reset(first)
    whole.reset(first)
    packets = fly(camera, stacks, lanes=lanes, reads=reads)
    stamps = FRAME_NS * np.arange(1, sum(lengths) + 1)
    expected = whole.feed(np.concatenate(stacks), stamps)
    found = [np.concatenate(columns) for columns in zip(*(packet.numpy() for packet in packets), strict=True)]
    t, x, y, polarity = found
    order = np.lexsort((polarity, x, y, t))  # a window may end within a microsecond
    for column, expected_column in zip(found, expected.numpy(), strict=True):
        np.testing.assert_array_equal(column[order], expected_column)
    assert sum(packet.dropped_count for packet in packets) == expected.dropped_count


def test_values_that_are_no_log_radiance_are_named(device):
    camera = make_camera(device)
    frames = np.zeros((2, HEIGHT, WIDTH), np.float32)
    camera.reset(frames[0])
    for turn in range(2):
        start_ns = camera.stamp_ns
        camera.feed_device(wp.array(frames, device=device), [start_ns + 1000, start_ns + 2000])
        if turn == 0:
            camera.collect_windows([start_ns + 2000], scan_count=1)
            frames[1, 2, 3] = np.nan
    with pytest.raises(ValueError, match=r"1 values are not, the first at \[1, 2, 3\]"):
        camera.collect_windows([4000], scan_count=1)
    camera.reset(np.zeros((HEIGHT, WIDTH), np.float32), 5000, sequence=7)
    frames[1] = 1.0
    camera.feed_device(wp.array(frames, device=device), [6000, 7000])
    (packet,) = camera.collect_windows([7000], scan_count=1)
    assert (packet.sequence, packet.start_ns) == (7, 5000)
    assert len(packet.t) > 0


def test_events_stay_as_they_are_while_the_camera_goes_on(device):
    """What was handed out is not overwritten, however many packets are kept."""
    count = 40
    first, stacks = draw_stacks(np.random.default_rng(8), [3] * count, [0.3] * count)
    camera = make_camera(device)
    camera.reset(first)
    kept, copies = [], []
    for stack in stacks:
        stamps = camera.stamp_ns + FRAME_NS * np.arange(1, 4)
        camera.feed_device(wp.array(stack, device=device), stamps)
        (packet,) = camera.collect_windows([int(stamps[-1])], scan_count=1)
        kept.append(packet.numpy())
        copies.append([np.array(column) for column in packet.numpy()])
    for columns, copied in zip(kept, copies, strict=True):
        for a, b in zip(columns, copied, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("eagerness", [0.0, 0.7])
@pytest.mark.parametrize("lanes", [1, 2, 3])
@pytest.mark.parametrize(
    "config",
    [{}, {"event_count_max": 300}, {"shot_noise": {"rate_hz": 2e4}}, {"readout": {"bandwidth_hz": 4e6}}],
)
def test_a_device_that_is_late_gives_the_same(monkeypatch, eagerness, lanes, config):
    """As on a GPU, streams run behind the host and beside each other: nobody reads what is not ready."""
    count = 48
    rng = np.random.default_rng([lanes, int(10 * eagerness)])
    lengths = [4] * count
    # the same few sizes come again, so that most of it is replayed
    loudness = rng.choice([0.3, 0.3, 0.3, 1.0], size=count).tolist()
    reads = rng.choice(["one"] * 12 + ["all", "collect", "early"], size=count).tolist()
    first, stacks = draw_stacks(rng, lengths, loudness)
    plain_camera = make_camera("cpu", lanes=lanes, **config)
    plain_camera.reset(first)
    plain = fly(plain_camera, stacks, lanes=lanes, reads=reads)
    late = LateDevice(rng, eagerness)
    with monkeypatch.context() as patch:
        install(patch, late)
        camera = make_camera("cpu", lanes=lanes, **config)
        camera.reset(first)
        packets = fly(camera, stacks, lanes=lanes, reads=reads)
    assert_same(packets, plain)
    assert late.replayed_count > count / 6


def test_frames_are_the_callers_again_when_they_have_been_read(monkeypatch):
    """Also where a scan had to be done again for want of room, and no window ended."""
    packets = []
    for late in (False, True):
        with monkeypatch.context() as patch:
            if late:
                install(patch, LateDevice(np.random.default_rng(2), 0.0))
            camera = make_camera("cpu", threshold_on=0.25)
            camera.reset(np.zeros((HEIGHT, WIDTH), np.float32))
            # three events a pixel fit; the five after them do not, where all of them do
            for number, levels in enumerate((3.1, 8.1), 1):
                rows = np.full((1, HEIGHT, WIDTH), 0.25 * levels, np.float32)
                frames = wp.array(rows, dtype=wp.float32, device="cpu", copy=False)
                camera.feed_device(frames, [FRAME_NS * number])
                camera.collect_windows([], scan_count=1)
                rows.fill(0.0)
            packets.append(camera.collect())
    assert len(packets[0].t) == 8 * HEIGHT * WIDTH
    assert_same(*([packet] for packet in packets))


@pytest.mark.parametrize("lanes", [1, 2])
def test_a_flight_of_changing_views_needs_no_memory(monkeypatch, lanes):
    """The number of events varies more than tenfold, by jumps of five: soon there is room for all."""
    warm, count = 24, 160
    rng = np.random.default_rng(11)
    loudness = rng.choice([0.02, 0.06, 0.3, 0.3, 0.6, 1.5], size=warm + count)
    loudness[:warm:3] = 1.5
    first, stacks = draw_stacks(rng, [16] * (warm + count), loudness.tolist())
    found = []
    install(monkeypatch, LateDevice(rng, 0.5))
    camera = make_camera("cpu", lanes=lanes)
    camera.reset(first)
    frames = [wp.empty((16, HEIGHT, WIDTH), dtype=float, device="cpu") for _ in range(lanes)]
    fed: deque[int] = deque()

    def see(numbers: range) -> None:
        for number in numbers:
            stamps = FRAME_NS * (16 * number + np.arange(1, 17))
            frames[number % lanes].numpy()[:] = stacks[number]
            camera.feed_device(frames[number % lanes], stamps)
            fed.append(int(stamps[-1]))
            if len(fed) == lanes:
                (packet,) = camera.collect_windows([fed.popleft()], scan_count=1)
                found.append(len(packet.t))

    see(range(warm))
    with allocations() as made:
        see(range(warm, warm + count))
    ordered = sorted(found[warm:])
    assert ordered[-count // 10] > 10 * ordered[count // 10]
    assert made == []


@pytest.mark.parametrize("lanes", [1, 2, 3])
@pytest.mark.parametrize("event_count_max", [80, 1 << 20])
@pytest.mark.parametrize("seed", range(6))
def test_frames_that_are_counted_one_by_one_on_a_late_device_give_the_same(
    monkeypatch, seed, event_count_max, lanes
):
    """The host reads each count, with so many frames under way, and takes windows now and then."""
    count, eagerness = 60, 0.1 * seed
    rng = np.random.default_rng([seed, lanes])
    first, stacks = draw_stacks(rng, [1] * count, rng.choice([0.0, 0.3, 3.0], size=count).tolist())
    packets: list[list[Events]] = []
    for late in (False, True):
        with monkeypatch.context() as patch:
            if late:
                install(patch, LateDevice(rng, eagerness))
            camera = make_camera("cpu", lanes=lanes, event_count_max=event_count_max)
            camera.reset(first)
            found: list[Events] = []
            fed: deque[np.ndarray] = deque()

            def read(camera: EventCamera = camera, fed: deque[np.ndarray] = fed) -> None:
                camera.collect_windows([], scan_count=1)
                fed.popleft().fill(0.0)  # the frame is the caller's again

            for number, stack in enumerate(stacks, 1):
                rows = np.array(stack)
                frames = wp.array(rows, dtype=wp.float32, device="cpu", copy=False)
                camera.feed_device(frames, [FRAME_NS * number])
                fed.append(rows)
                if len(fed) == lanes:
                    read()
                if number % 7 == 0:
                    found.append(camera.collect())
                    fed.clear()
                elif number % 5 == 0 and camera.stamp_ns > camera.window_start_ns:  # some events stay
                    found += camera.collect_windows([camera.stamp_ns - 600], scan_count=0)
            packets.append([*found, camera.collect()])
    assert len(packets[0]) > 10
    assert sum(packet.dropped_count for packet in packets[0]) > 0 or event_count_max > 80
    assert_same(*packets)


def test_a_window_that_ends_waits_for_the_stack_under_way(monkeypatch, device):
    """Its events go to where those of the window are sorted."""
    first, stacks = draw_stacks(np.random.default_rng(3), [4] * 20, [0.3] * 20)
    packets: list[list[Events]] = []
    for late in (False, True):
        with monkeypatch.context() as patch:
            if late:
                install(patch, LateDevice(np.random.default_rng(4), 0.0))
            camera = make_camera("cpu" if late else device)
            camera.reset(first)
            found = []
            for number, stack in enumerate(stacks):
                stamps = 4 * FRAME_NS * number + FRAME_NS * np.arange(1, 5)
                camera.feed_device(wp.array(stack, dtype=float, device=camera.device), stamps)
                found += camera.collect_windows([int(stamps[1])], scan_count=0)
                assert camera.stamp_ns == stamps[-1]
                assert camera.collect_windows([], scan_count=1) == []
            packets.append([*found, camera.collect()])
    assert_same(*packets)
    whole = make_camera("cpu")
    whole.reset(first)
    expected = whole.feed(np.concatenate(stacks), FRAME_NS * np.arange(1, 81))
    assert sum(len(packet.t) for packet in packets[0]) == len(expected.t)


def test_a_reset_waits_for_what_is_under_way_on_another_stream(monkeypatch):
    """The stack that nobody reads writes a state where that of the reset goes."""

    def frames(level: float) -> wp.array:
        return wp.array(np.full((1, HEIGHT, WIDTH), 0.25 * level, np.float32), dtype=float, device="cpu")

    for seed in range(20):
        with monkeypatch.context() as patch:
            device = LateDevice(np.random.default_rng(seed), 0.0)
            install(patch, device)
            camera = make_camera("cpu", threshold_on=0.25, threshold_off=0.25)
            camera.reset(np.zeros((HEIGHT, WIDTH), np.float32))
            camera.feed_device(frames(1.1), [2000])
            assert len(camera.collect()) == HEIGHT * WIDTH
            feeder = device.stream
            camera.feed_device(frames(5.1), [4000])
            device.stream = device.make_stream(None)  # one that is not ordered with the feeder
            camera.reset(np.zeros((HEIGHT, WIDTH), np.float32), 10_000)
            with device.on(feeder):
                camera.feed_device(frames(4.1), [12_000])
                assert len(camera.collect()) == 4 * HEIGHT * WIDTH


def test_keys_that_are_carried_over_are_there_before_the_next_are_added(monkeypatch):
    """A count is read, and the buffers grow, when the device has not yet moved what the cut before left."""

    def frames(*levels: float) -> wp.array:
        rows = [np.full((HEIGHT, WIDTH), 0.25 * level + 0.05, np.float32) for level in levels]
        return wp.array(np.stack(rows), dtype=wp.float32, device="cpu")

    for seed in range(20):
        packets: list[list[Events]] = []
        for late in (False, True):
            with monkeypatch.context() as patch:
                if late:
                    install(patch, LateDevice(np.random.default_rng(seed), 0.0))
                camera = make_camera("cpu", lanes=2, threshold_on=0.25, threshold_off=0.25)
                camera.reset(np.zeros((HEIGHT, WIDTH), np.float32))
                found = []
                for number, level in enumerate((5, 0, 5, 0), 1):
                    camera.feed_device(frames(level), [1000 * number])
                    found.append(camera.collect())
                two, one = frames(0, 8), frames(18)
                camera.feed_device(two, [6000, 8000])
                camera.feed_device(one, [10_000])
                found += camera.collect_windows([6000], scan_count=1)
                found += camera.collect_windows([], scan_count=1)
                packets.append([*found, camera.collect()])
        assert_same(*packets)


@pytest.mark.parametrize("late", [False, True])
def test_more_events_than_a_power_of_two_fit_into_what_there_is(monkeypatch, device, late):
    """There is room for four a pixel from the start, and for sorting no more than that."""
    width, height = 40, 30
    levels = np.full((1, height, width), 4.1, np.float32)
    levels[0, : height // 4] = 3.1
    found = []
    if late:
        install(monkeypatch, LateDevice(np.random.default_rng(0), 0.0))
    camera = EventCamera(
        EventCameraConfig(threshold_on=0.25, threshold_off=0.25),
        width=width,
        height=height,
        device="cpu" if late else device,
        on_host=True,
    )
    camera.reset(np.zeros((height, width), np.float32))
    one = np.zeros_like(levels)
    one[0, 3, 4] = 1.1
    for number, rows in enumerate((one, 0.0 * one, *(levels, 0.0 * levels) * 2), 1):
        rows = (0.25 * rows).astype(np.float32)
        camera.feed_device(wp.array(rows, dtype=wp.float32, device=camera.device), [FRAME_NS * number])
        found += camera.collect_windows([FRAME_NS * number], scan_count=1)
    count = int(np.floor(levels).sum())
    assert 4096 < count < 4 * width * height
    assert [len(packet.t) for packet in found] == [1, 1] + [count] * 4
    assert [int(packet.polarity.sum()) for packet in found] == [1, 0] + [count, 0] * 2
