"""Who looks at what was flown: what is left out when time is short, and that it is counted."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest
from live_rig import make_config, models_of
from processes import SOON_S, wait_for

from neurosim_core.live import cameras as module
from neurosim_core.live.cameras import Cameras
from neurosim_core.live.config import LiveConfig
from neurosim_core.live.pacing import Pacer
from neurosim_core.live.status import Meter
from neurosim_core.live.streaming import Streaming
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
