"""The arbiter against closed forms of queues and a simulation that goes through time by hand."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import pytest
import warp as wp
from scipy import stats

from neurosim_core.packets import Events
from neurosim_core.sensors.event_config import EventCameraConfig
from neurosim_core.sensors.events import EventCamera

MS = 1_000_000


def make_camera(
    width: int, height: int, device: str, readout: dict[str, Any] | None, **rest: Any
) -> EventCamera:
    config = EventCameraConfig(readout=readout, **rest)
    return EventCamera(config, width=width, height=height, device=device, on_host=True)


def burst(
    height: int, width: int, levels: int, device: str, readout: dict[str, Any], until_ns: int = 10 * MS
) -> Events:
    """Every pixel crosses its levels at the same times, the last one at 1 us."""
    camera = make_camera(width, height, device, readout)
    camera.reset(np.zeros((height, width), np.float32))
    frames = np.full((2, height, width), 0.2 * levels, np.float32)
    return camera.feed(frames, [1000, until_ns])


def rows(packet: Events) -> list[tuple[int, int, int, int]]:
    """All events as (t, y, x, polarity)."""
    t, x, y, polarity = (column.tolist() for column in packet.numpy())
    return list(zip(t, y, x, polarity, strict=True))


def walk(seed: int, shape: tuple[int, int], count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    frames = rng.normal(scale=0.3, size=(count, *shape)).cumsum(0).astype(np.float32)
    return frames, np.concatenate([[0], rng.integers(20_000, 60_000, count - 1)]).cumsum()


# ---- event by event


def test_throughput_is_the_bandwidth(device):
    """96 events at once on 4 Meps: one every 250 ns, in the order of rows and columns."""
    found = burst(8, 12, 1, device, {"kind": "event", "bandwidth_hz": 4e6})
    assert found.dropped_count == 0
    expected = sorted(((1000 + 250 * k) // 1000, k // 12, k % 12, 1) for k in range(96))
    assert rows(found) == expected


def test_a_full_queue_loses_events(device):
    """One is read at once, 10 wait, and the other 85 of 96 are lost."""
    found = burst(8, 12, 1, device, {"bandwidth_hz": 1e6, "queue_length": 10})
    assert rows(found) == [(1 + k, 0, k, 1) for k in range(11)]
    assert found.dropped_count == 85


def test_an_idle_bus_changes_nothing(device):
    """Events 100 us apart on 1 Meps: the stamps of the pixels."""
    frames = np.array([0.0, 1.0], np.float32).reshape(2, 1, 1)
    packets = []
    for readout in (None, {"bandwidth_hz": 1e6}, {"kind": "row", "bandwidth_hz": 1e6, "row_s": 5e-6}):
        camera = make_camera(1, 1, device, readout)
        camera.reset(frames[0])
        packets.append(rows(camera.feed(frames[1:], [500_000])))
    assert packets[0] == packets[1] == packets[2] == [(100 * k, 0, 0, 1) for k in range(1, 6)]


def test_sustained_overload(device):
    """Twice the bandwidth for 10 ms: output at the bandwidth, the queue full, the rest lost."""
    camera = make_camera(20, 10, device, {"bandwidth_hz": 2e6, "queue_length": 500}, threshold_on=0.01)
    camera.reset(np.zeros((10, 20), np.float32))
    # 200 pixels of 200 events each, all in different places of their ramps
    frames = 2.0 + np.linspace(0.0, 0.009, 200).reshape(1, 10, 20)
    found = camera.feed(frames.astype(np.float32), [10 * MS])
    total = 200 * 200
    assert total == len(found) + found.dropped_count + 500
    # the bus is busy from the first event to the end: at 2 Meps, less what came before the first
    begin_us = found.numpy().t[0]
    assert len(found) == pytest.approx((10_000 - begin_us) * 2.0, abs=2)
    counts = np.bincount(found.numpy().t)[begin_us + 1 : 9_999]
    assert set(counts.tolist()) == {2}


# ---- row by row


def test_rows_share_a_stamp(device):
    """96 events at once: row r is read after r times (row + 12 events), with one stamp."""
    found = burst(8, 12, 1, device, {"kind": "row", "bandwidth_hz": 4e6, "row_s": 2e-6})
    expected = [(1 + 5 * row, row, col, 1) for row in range(8) for col in range(12)]  # 2 us + 12 / 4 us
    assert rows(found) == expected


def test_rows_that_wait_gather_events(device):
    """Levels at 0.5 and 1 us: the first row is read at 0.5 us, all others with both of their events."""
    found = burst(3, 4, 2, device, {"kind": "row", "bandwidth_hz": 1e9, "row_s": 10e-6})
    expected = [(0, 0, col, 1) for col in range(4)]
    expected += [(10, 1, col, 1) for col in range(4) for _ in range(2)]
    expected += [(20, 2, col, 1) for col in range(4) for _ in range(2)]
    expected += [(30, 0, col, 1) for col in range(4)]
    assert rows(found) == expected


def test_a_pixel_waits_for_its_handshake(device):
    """As above, but what waits to be read fires no second event: 8 are lost."""
    readout = {"kind": "row", "bandwidth_hz": 1e9, "row_s": 10e-6, "handshake": True}
    found = burst(3, 4, 2, device, readout)
    expected = [(t, row, col, 1) for t, row in ((0, 0), (10, 1), (20, 2), (30, 0)) for col in range(4)]
    assert rows(found) == expected
    assert found.dropped_count == 8


def test_rows_and_stamps_are_those_measured_of_gen3(device):
    """At 5.4 Mev/s it has 1.76 events a row and 3.75 rows a stamp: busy at 6.6 Mev/s for 82 % of the time."""
    preset = EventCameraConfig(preset="gen3")
    assert preset.readout is not None
    shot = {"rate_hz": 6.6e6 / (640 * 480), "bright_factor": 1.0, "spread_decades": 0.0}
    camera = make_camera(640, 480, device, preset.readout.model_dump(), shot_noise=shot)
    camera.reset(np.zeros((480, 640), np.float32))
    found = camera.feed(np.zeros((1, 480, 640), np.float32), [10 * MS]).numpy()
    later = found.t > 1000  # until the queue is as long as it gets
    t, y = found.t[later], found.y[later].astype(np.int64)
    stamps, row_count = len(np.unique(t)), len(np.unique(t * 480 + y))
    assert len(t) / row_count == pytest.approx(1.76, rel=0.05)
    assert row_count / stamps == pytest.approx(3.75, rel=0.05)


def test_late_stamps_are_normal(device):
    """Every event 100 us late, with a standard deviation of 20 us, and none before its readout."""
    late = {"bandwidth_hz": 1e12, "latency_s": 1e-4, "jitter_s": 2e-5}
    camera = make_camera(64, 48, device, {"kind": "event", **late})
    camera.reset(np.zeros((48, 64), np.float32))
    delays = []
    for step in range(1, 3):  # events of one feed that are late come with the next
        camera.feed(np.full((1, 48, 64), 0.2 * step, np.float32), [step * MS])
        rest = camera.feed(np.full((1, 48, 64), 0.2 * step, np.float32), [step * MS + MS // 2]).numpy()
        delays.append(np.sort(rest.t) - step * 1000)
        assert len(rest.t) == 64 * 48
        # floored to a microsecond of 20: the distance of the distributions is 0.01 at most, and chance
        worst = stats.kstest(delays[-1] + 0.5, stats.norm(100.0, 20.0).cdf).statistic
        assert worst < 0.01 + 2.5 / np.sqrt(64 * 48)
    assert not np.array_equal(delays[0], delays[1])
    wide = make_camera(64, 48, device, {"kind": "event", **late, "latency_s": 0.0})
    wide.reset(np.zeros((48, 64), np.float32))
    wide.feed(np.full((1, 48, 64), 0.2, np.float32), [MS])
    found = wide.feed(np.full((1, 48, 64), 0.2, np.float32), [2 * MS]).numpy()
    assert found.t.min() >= 1000


# ---- both against a simulation by hand


def nanoseconds(frames: np.ndarray, stamps: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Events of the ideal camera to the nanosecond, rounded up: its clock is a million times as slow."""
    camera = make_camera(frames.shape[2], frames.shape[1], "cpu", None)
    camera.reset(frames[0])
    found = rows(camera.feed(frames[1:], stamps[1:] * 1_000_000))
    return [(-(-t // 1000), y, x, p) for t, y, x, p in found]


def simulate(
    arrivals: list[tuple[int, int, int, int]], readout: dict[str, Any], until_ns: int
) -> tuple[list[tuple[float, int, int, int]], list[int]]:
    """Step from arrival to arrival with lists: what is read when [ns], and when events were lost."""
    event_ns, row_ns = 1e9 / readout["bandwidth_hz"], 1e9 * readout.get("row_s", 0.0)
    waiting: deque[tuple[int, int, int, int]] = deque()
    read: list[tuple[float, int, int, int]] = []
    lost: list[int] = []
    free = 0.0

    def serve(before: float, *, inclusive: bool) -> None:
        nonlocal free
        while waiting:
            begin = max(free, waiting[0][0])
            if begin > before or (begin == before and not inclusive):
                return
            chosen = [waiting[0]]
            if readout["kind"] == "row":
                chosen = [event for event in waiting if event[1] == waiting[0][1]]
            for event in chosen:
                waiting.remove(event)
                read.append((begin, *event[1:]))
            free = begin + row_ns * (readout["kind"] == "row") + len(chosen) * event_ns

    for event in sorted(arrivals):
        # by rows, who comes as the row is latched is still taken; one by one, the bus takes who is there
        serve(event[0], inclusive=readout["kind"] == "event")
        idle = readout["kind"] == "event" and not waiting and free <= event[0]
        held = readout.get("handshake", False) and any(event[1:3] == other[1:3] for other in waiting)
        if held or (len(waiting) >= readout["queue_length"] and not idle):
            lost.append(event[0])
        else:
            waiting.append(event)
    serve(until_ns if readout["kind"] == "row" else float("inf"), inclusive=True)
    return read, lost


@pytest.mark.parametrize(
    "readout",
    [
        {"kind": "event", "bandwidth_hz": 8e6, "queue_length": 100_000},
        {"kind": "event", "bandwidth_hz": 1e6, "queue_length": 60},
        {"kind": "row", "bandwidth_hz": 1e8, "row_s": 1e-6, "queue_length": 100_000},
        {"kind": "row", "bandwidth_hz": 1.6e7, "row_s": 1.6e-5, "queue_length": 90},
        {"kind": "event", "bandwidth_hz": 1e6, "queue_length": 60, "handshake": True},
        {"kind": "row", "bandwidth_hz": 1.6e7, "row_s": 1.6e-5, "queue_length": 90, "handshake": True},
    ],
)
def test_against_a_simulation_by_hand(readout, device):
    """Random walks in bursts: every event, its stamp and every loss."""
    frames, stamps = walk(3, (9, 11), 12)
    read, lost = simulate(nanoseconds(frames, stamps), readout, int(stamps[-1]))
    assert (len(lost) > (50 if "handshake" in readout else 100)) == (readout["queue_length"] < 100)
    camera = make_camera(11, 9, device, readout)
    camera.reset(frames[0])
    found = camera.feed(frames[1:], stamps[1:])
    expected = sorted((int(t // 1000), y, x, p) for t, y, x, p in read if t <= stamps[-1])
    # times of the pixels are rounded up to the nanosecond, in both
    assert rows(found) == expected
    assert found.dropped_count == len(lost)
    late = sum(t > stamps[-1] for t, *_ in read)
    if late:  # what waits at the end comes with the next window
        rest = camera.feed(frames[-1:], [int(stamps[-1]) + 100 * MS])
        assert len(rest) == late


@pytest.mark.parametrize("more", [{}, {"handshake": True, "latency_s": 3e-5, "jitter_s": 1e-5}])
@pytest.mark.parametrize("kind", ["event", "row"])
def test_windows_do_not_depend_on_the_stacks(kind, more, device):
    """Packets, stamps and losses are the same for one stack, single frames, and stacks of 5."""
    readout = {"kind": kind, "bandwidth_hz": 1e6, "row_s": 1e-5, "queue_length": 150, **more}
    frames, stamps = walk(5, (14, 10), 40)

    def windows(length: int) -> list[Events]:
        camera = make_camera(10, 14, device, readout, leak={"rate_hz": 1e3})
        camera.reset(frames[0])
        packets: list[Events] = []
        for first in range(1, 40, length):
            chosen = slice(first, min(first + length, 40))
            camera.feed_device(wp.array(frames[chosen], device=device), stamps[chosen])
            until = int(stamps[chosen][-1])
            packets += camera.collect_windows(list(range(camera.window_start_ns + 70_000, until + 1, 70_000)))
        return [*packets, camera.collect()]

    whole = windows(39)
    assert sum(p.dropped_count for p in whole) > 100
    assert sum(map(len, whole)) > 700
    for length in (1, 5):
        split = windows(length)
        assert [p.dropped_count for p in split] == [p.dropped_count for p in whole]
        for a, b in zip(split, whole, strict=True):
            assert rows(a) == rows(b)
            assert rows(a) == sorted(rows(a))


@pytest.mark.parametrize("kind", ["event", "row"])
def test_reset_empties_the_queue(kind, device):
    readout = {"kind": kind, "bandwidth_hz": 1e5, "row_s": 1e-4, "queue_length": 50}
    frames, stamps = walk(6, (6, 7), 10)
    camera = make_camera(7, 6, device, readout)
    camera.reset(frames[0])
    first = camera.feed(frames[1:], stamps[1:])
    camera.reset(frames[0])
    again = camera.feed(frames[1:], stamps[1:])
    assert first.dropped_count == again.dropped_count > 0
    assert rows(first) == rows(again)
