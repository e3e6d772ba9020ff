"""Who looks at what was flown: what is left out when time is short, and that it is counted."""

from __future__ import annotations

import os
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest
from live_rig import make_config, models_of
from processes import SOON_S, wait_for

from neurosim_core.live import LiveConfig
from neurosim_core.nodes import cameras as module
from neurosim_core.nodes.cameras import Cameras
from neurosim_core.nodes.status import Meter
from neurosim_core.nodes.streaming import Streaming
from neurosim_core.pacing import Pacer
from neurosim_core.priority import spared_count
from neurosim_core.simulation import Batch, Model, State, finish, fly_period, free_lanes, make_state

MS = 1_000_000
PERIODS = 8


@pytest.fixture(name="model", scope="module")
def _model() -> Model:
    return models_of(make_config())["drone"]


@pytest.fixture(name="gate")
def _gate(monkeypatch: pytest.MonkeyPatch) -> Iterator[Gate]:
    gate = Gate(monkeypatch)
    yield gate
    gate.open.set()


class Gate:
    """Holds up the thread that renders, before its picture of a stamp."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.open = threading.Event()
        self.reached = threading.Event()
        self.at_ns = 0
        see = module.see_each

        def held(model: Model, state: State, batch: Batch) -> Any:
            if batch.until_ns >= self.at_ns:
                self.reached.set()
                assert self.open.wait(4 * SOON_S)
            return see(model, state, batch)

        monkeypatch.setattr(module, "see_each", held)


def fly(model: Model, eyes: Cameras, **options: Any) -> State:
    """Fly for 40 ms: 3 pictures, and 9 instants of the event camera."""
    state = make_state(model, lane_count=1, flight_lane_count=2 * PERIODS)
    for _ in range(PERIODS):
        eyes.look("drone", model, state, fly_period(model, state, None)[1], **options)
    return state


def seen(eyes: Cameras) -> Counter[str]:
    return Counter(packet.sensor for _, packets in eyes.take() for packet in packets)


def test_what_waits_is_counted_when_it_is_given_up(model: Model, gate: Gate):
    """The batch of 10 ms is in work, and ends; before it 1 picture and 2 instants were seen, 2 and 6 wait."""
    gate.at_ns = 10 * MS
    eyes = Cameras(inline=False, on_packets=lambda: None)
    state = fly(model, eyes)
    assert gate.reached.wait(SOON_S)
    wait_for(lambda: eyes.has_packets)
    threading.Timer(0.02, gate.open.set).start()
    assert eyes.give_up(SOON_S)
    assert dict(eyes.dropped) == {("drone", "rgb"): 2, ("drone", "events"): 6}
    assert seen(eyes) == {"rgb": 1, "events": 1}
    assert free_lanes(state) == 2 * PERIODS
    assert finish(state) == []  # the window from 10 ms on has seen nothing
    eyes.close()


def test_a_picture_that_takes_too_long_is_given_up_too(model: Model, gate: Gate):
    eyes = Cameras(inline=False, on_packets=lambda: None)
    fly(model, eyes)
    assert gate.reached.wait(SOON_S)
    assert not eyes.give_up(0.0)
    assert dict(eyes.dropped) == {("drone", "rgb"): 3, ("drone", "events"): 9}
    gate.open.set()
    eyes.finish(lambda: False)
    assert not eyes.has_packets
    eyes.reset()
    assert not eyes.dropped
    eyes.close()


def test_a_closed_thread_is_not_waited_for_without_end(
    model: Model, gate: Gate, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(module, "GIVE_UP_S", 0.01)
    eyes = Cameras(inline=False, on_packets=lambda: None)
    fly(model, eyes)
    assert gate.reached.wait(SOON_S)
    closing = threading.Thread(target=eyes.close, daemon=True)
    closing.start()
    closing.join(SOON_S)
    assert not closing.is_alive()


@pytest.mark.parametrize("inline", [True, False])
def test_what_comes_late_is_left_out_where_there_is_no_thread(model: Model, inline: bool):
    eyes = Cameras(inline=inline, on_packets=lambda: None)
    fly(model, eyes, late=True)
    eyes.finish(lambda: False)
    expected = {("drone", "rgb"): 3, ("drone", "events"): 9} if inline else {}
    assert dict(eyes.dropped) == expected
    assert bool(seen(eyes)) is not inline
    eyes.close()


def test_a_core_is_left_to_others_as_long_as_no_picture_waits(model: Model, gate: Gate):
    spared = []
    held = module.see_each
    module.see_each = lambda *job: spared.append(spared_count()) or held(*job)  # the gate puts it back
    eyes = Cameras(inline=False, on_packets=lambda: None)
    fly(model, eyes)
    assert gate.reached.wait(SOON_S)
    gate.open.set()
    eyes.finish(lambda: False)
    eyes.close()
    # as many batches as there are, and the one of stamp 0, which began when no other had come
    assert len(spared) == PERIODS + 1
    assert set(spared[1:-1]) == {0}
    assert spared[-1] == 1


@pytest.mark.skipif(
    sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2, reason="needs Linux and two cores"
)
def test_who_flies_has_a_core_of_its_own_as_long_as_no_picture_waits(model: Model, gate: Gate):
    places = []
    held = module.see_each

    def look(*job: Any) -> Any:
        places.append((spared_count(), os.sched_getaffinity(0), os.sched_getaffinity(flier)))
        return held(*job)

    flier = threading.get_native_id()
    before = os.sched_getaffinity(flier)
    module.see_each = look  # the gate puts it back
    eyes = Cameras(inline=False, on_packets=lambda: None)
    fly(model, eyes)
    assert gate.reached.wait(SOON_S)
    gate.open.set()
    eyes.finish(lambda: False)
    eyes.close()
    assert len(places) == PERIODS + 1
    for spared, renderer, own in places:
        assert (renderer, own) == (before - own if spared else before, own if spared else before)
        assert len(own) == 1 or not spared
    assert places[-1][0] == 1
    wait_for(lambda: os.sched_getaffinity(flier) == before)


@pytest.mark.skipif(sys.platform != "linux", reason="threads have no cores of their own")
def test_who_was_late_on_its_core_leaves_it_for_a_while(
    model: Model, gate: Gate, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(module, "CROWDED_S", 10 * SOON_S)
    places = []
    held = module.see_each
    flier = threading.get_native_id()
    before = os.sched_getaffinity(flier)
    module.see_each = lambda *job: places.append(os.sched_getaffinity(flier)) or held(*job)
    eyes = Cameras(inline=False, on_packets=lambda: None)
    eyes.leave_core()
    fly(model, eyes)
    assert gate.reached.wait(SOON_S)
    gate.open.set()
    eyes.finish(lambda: False)
    eyes.close()
    assert places == [before] * (PERIODS + 1)


@pytest.mark.parametrize(("late_ms", "leaves"), [(0, False), (4, False), (6, True)])
def test_a_core_is_left_by_who_was_later_than_a_scheduler_is(late_ms: int, leaves: bool):
    now_ns = 0
    pacer = Pacer(1.0, clock_ns=lambda: now_ns)
    bell = threading.Event()
    eyes = Cameras(inline=True, on_packets=bell.set)
    left: list[bool] = []
    eyes.leave_core = lambda: left.append(True)
    streaming = Streaming([], eyes, pacer, Meter(), bell=bell)
    now_ns = pacer.wall_ns(10 * MS) + late_ms * MS
    live = LiveConfig()
    assert streaming.publish_until(10 * MS, 10 * MS, live, lambda: False, called=lambda: False)
    assert bool(left) is leaves


class Queue:
    """What a vehicle has to publish: stamps, in order, each in front of the next [ns]."""

    def __init__(self, *stamps_ns: int) -> None:
        self.outlet = self
        self.model = models_of(make_config())["drone"]
        self.lateness_ns: Any = None
        self._stamps_ns = list(stamps_ns)

    @property
    def next_due_ns(self) -> int | None:
        return self._stamps_ns[0] if self._stamps_ns else None

    def publish_due(self, stamp_ns: int) -> None:
        while self._stamps_ns and self._stamps_ns[0] <= stamp_ns:
            self._stamps_ns.pop(0)


@pytest.mark.parametrize(
    ("due_ms", "oversleeps_ms", "leaves"),
    [
        (2, 0, False),  # a picture that took 18 ms: the core was not at fault
        (22, 0, False),
        (22, 4, False),
        (22, 6, True),  # it was not woken when it should have been
    ],
)
def test_a_core_is_not_left_for_pictures_that_take_long(due_ms: int, oversleeps_ms: int, leaves: bool):
    now_ns = 0

    def sleep(seconds: float) -> None:
        nonlocal now_ns
        now_ns += round(seconds * 1e9) + (oversleeps_ms * MS if now_ns < due_ms * MS else 0)

    pacer = Pacer(1.0, clock_ns=lambda: now_ns, sleep=sleep)
    bell = threading.Event()
    eyes = Cameras(inline=True, on_packets=bell.set)
    left: list[bool] = []
    eyes.leave_core = lambda: left.append(True)
    craft: Any = Queue(due_ms * MS)
    streaming = Streaming([craft], eyes, pacer, Meter(), bell=bell)
    now_ns = 20 * MS
    assert streaming.publish_until(40 * MS, 40 * MS, LiveConfig(), lambda: False, called=lambda: False)
    assert bool(left) is leaves


def test_a_request_does_not_keep_the_loop_awake():
    """It is answered at the end of a control period that is near; until then the loop sleeps as before."""
    bell = threading.Event()
    now_ns = 0
    sleeps = 0

    def sleep(seconds: float) -> None:
        nonlocal now_ns, sleeps
        sleeps += 1
        now_ns += 1000 if bell.is_set() else round(seconds * 1e9)
        bell.set()  # somebody asks for something

    pacer = Pacer(1.0, clock_ns=lambda: now_ns, sleep=sleep)
    eyes = Cameras(inline=True, on_packets=bell.set)
    streaming = Streaming([], eyes, pacer, Meter(), bell=bell)
    assert streaming.publish_until(40 * MS, 40 * MS, LiveConfig(), lambda: False, called=lambda: True)
    assert sleeps == 2  # of 20 ms each


@pytest.mark.parametrize(
    ("factor", "period_ms", "late_ms", "pauses_us"),
    [
        (1.0, 10, 0.0, [250]),  # the most that readers need
        (1.0, 10, 2.0, [250]),
        (1.0, 10, 3.0, []),  # behind by more than a quarter of a period
        (1.0, 5, 0.0, [200]),  # a twenty-fifth
        (1.0, 2, 0.0, [80]),
        (1.0, 1, 0.0, []),  # of that it would be too little
        (2.0, 2, 0.0, []),
        (0.5, 1, 0.0, [80]),
        (0.0, 10, 0.0, []),  # as fast as it can
    ],
)
def test_readers_go_first_where_there_is_time(
    monkeypatch: pytest.MonkeyPatch, factor: float, period_ms: float, late_ms: float, pauses_us: list[int]
):
    slept_s: list[float] = []
    asked: list[bool] = []
    monkeypatch.setattr("neurosim_core.nodes.streaming.time.sleep", slept_s.append)
    monkeypatch.setattr("neurosim_core.nodes.streaming.let_the_woken_go_first", lambda: asked.append(1) or 1)
    period_ns = round(period_ms * MS)
    now_ns = 0
    pacer = Pacer(factor, clock_ns=lambda: now_ns)
    bell = threading.Event()
    streaming = Streaming([], Cameras(inline=True, on_packets=bell.set), pacer, Meter(), bell=bell)
    now_ns = pacer.wall_ns(period_ns) + round(late_ms * MS)
    streaming.let_readers_go_first(period_ns, period_ns)
    assert slept_s == pytest.approx([pause * 1e-6 for pause in pauses_us])
    streaming.let_readers_go_first(period_ns, period_ns)
    assert len(asked) == (0.0 < period_ms / (factor or 1e-9) < 1.25)  # once


def test_usual_turns_are_taken_again_where_there_is_time_to_sleep(monkeypatch: pytest.MonkeyPatch):
    turns: list[int] = []
    monkeypatch.setattr("neurosim_core.nodes.streaming.time.sleep", lambda _: None)
    monkeypatch.setattr("neurosim_core.nodes.streaming.let_the_woken_go_first", lambda: 7)
    monkeypatch.setattr("neurosim_core.nodes.streaming.take_turns", turns.append)
    bell = threading.Event()
    cameras, pacer = Cameras(inline=True, on_packets=bell.set), Pacer(1.0, clock_ns=lambda: 0)
    streaming = Streaming([], cameras, pacer, Meter(), bell=bell)
    for period_ns in (10 * MS, MS, MS):
        streaming.let_readers_go_first(period_ns, period_ns)
    assert turns == []
    for _ in range(2):
        streaming.let_readers_go_first(10 * MS, 10 * MS)
    assert turns == [7]
    streaming.let_readers_go_first(MS, MS)
    streaming.take_usual_turns()
    assert turns == [7, 7]
