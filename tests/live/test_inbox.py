"""Commands as they come: which one is taken, which are refused, what is counted."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import SOON_S, wait_for

from cortex import Node, Publisher
from cortex.messages import Imu
from neurosim_core.live.inbox import _SPIN_S, Inbox
from neurosim_core.live.topics import COMMANDS, command_topic
from neurosim_core.live.translate import command_of
from neurosim_core.vehicle import preset
from neurosim_core.vehicle.command_ranges import command_ranges

ROWS = {
    "motor_speeds": [100.0, 200.0, 300.0, 400.0],
    "rates": [7.0, 0.1, 0.2, 0.3],
    "attitude": [7.0, 0.0, 0.0, 0.0, 1.0],
    "velocity": [1.0, 2.0, 3.0, 0.5],
    "position": [1.0, 2.0, 3.0, 0.5],
}


class Desk:
    """An inbox, and publishers of commands."""

    def __init__(self, node: Node, *, lockstep: bool, beyond: str = "clamp") -> None:
        self.node = node
        ranges = command_ranges(preset("hummingbird", command_ranges={"beyond": beyond}))
        self.inbox = Inbox(node, "drone", rotor_count=4, ranges=ranges, lockstep=lockstep)
        self._publishers: dict[str, Publisher[Any]] = {}

    def publisher(self, mode: str) -> Publisher[Any]:
        if mode not in self._publishers:
            self._publishers[mode] = self.node.publisher(command_topic("drone", mode), COMMANDS[mode])
            assert self._publishers[mode].wait_for_subscribers(1, SOON_S)
        return self._publishers[mode]

    def send(self, mode: str, *, stamp_ns: int = 0, row: Any = None) -> None:
        self.publisher(mode).publish(command_of(mode, ROWS[mode] if row is None else row, stamp_ns=stamp_ns))

    def settle(self, taken: int) -> None:
        """Wait until so many messages have arrived, without taking any."""
        subscribers = self.inbox._subscribers.values()

        def arrived() -> int:
            for subscriber in subscribers:
                subscriber.wait_for_publisher(0.0)  # reads the sockets into the queue
            return sum(len(subscriber._queue) for subscriber in subscribers)

        wait_for(lambda: arrived() >= taken)


@pytest.fixture(params=[False, True], ids=["streaming", "lockstep"])
def desk(shared_runtime: Path, request: pytest.FixtureRequest) -> Iterator[Desk]:
    with Node("inbox") as node:
        yield Desk(node, lockstep=request.param)


@pytest.mark.parametrize("mode", COMMANDS)
def test_every_mode_arrives(desk: Desk, mode: str):
    assert desk.inbox.poll() is None
    desk.send(mode, stamp_ns=7)
    command = wait_for(desk.inbox.poll)
    assert command.mode == mode
    assert command.setpoint.tolist() == ROWS[mode]
    assert command.stamp_ns == 7
    assert desk.inbox.publisher_count == 1


def test_the_newest_of_those_found_together_is_taken(desk: Desk):
    desk.send("position", stamp_ns=20)
    desk.send("motor_speeds", stamp_ns=10)
    desk.send("rates", stamp_ns=30)
    desk.send("rates", stamp_ns=30, row=[9.0, 0.0, 0.0, 0.0])
    desk.settle(4)
    command = desk.inbox.poll()
    assert command is not None
    assert (command.mode, command.setpoint[0]) == ("rates", 9.0)
    assert desk.inbox.counts.superseded == 3
    assert desk.inbox.poll() is None


def test_what_arrives_later_wins_whatever_its_stamp(desk: Desk):
    desk.send("rates", stamp_ns=30)
    assert wait_for(desk.inbox.poll).stamp_ns == 30
    desk.send("rates", stamp_ns=10)
    assert wait_for(desk.inbox.poll).stamp_ns == 10


@pytest.mark.parametrize(
    ("mode", "row"),
    [
        ("motor_speeds", [1.0, 2.0, 3.0]),
        ("motor_speeds", [1.0, np.nan, 3.0, 4.0]),
        ("rates", [np.inf, 0.0, 0.0, 0.0]),
        ("attitude", [7.0, 0.0, 0.0, 0.0, 0.0]),
        ("velocity", [0.0, 0.0, 0.0, np.nan]),
        ("position", [-np.inf, 0.0, 0.0, 0.0]),
    ],
)
def test_bad_commands_are_refused(desk: Desk, mode: str, row: Any, caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            desk.send(mode, row=row)
        desk.settle(3)
        assert desk.inbox.poll() is None
    assert desk.inbox.counts.refused == 3
    assert desk.inbox.refusal.startswith(mode)
    assert len(caplog.records) == 1  # not once for each
    assert mode in caplog.text
    desk.send("rates", stamp_ns=5)
    assert wait_for(desk.inbox.poll).stamp_ns == 5


@pytest.mark.parametrize(("beyond", "taken"), [("clamp", True), ("refuse", False)])
def test_what_is_out_of_range_is_clamped_or_refused(
    shared_runtime: Path, caplog: pytest.LogCaptureFixture, *, beyond: str, taken: bool
):
    """Counted and said either way; the controller clamps what is taken."""
    with Node("inbox") as node, caplog.at_level(logging.WARNING):
        desk = Desk(node, lockstep=False, beyond=beyond)
        desk.send("velocity", row=[1e308, 0.0, 0.0, 0.0], stamp_ns=3)
        desk.settle(1)
        assert (desk.inbox.poll() is not None) == taken
        assert (desk.inbox.counts.clamped, desk.inbox.counts.refused) == ((1, 0) if taken else (0, 1))
        reason = desk.inbox.clamping if taken else desk.inbox.refusal
        assert reason.startswith("a velocity of 1e+308, 0, 0 m/s is out of range: up to 51.")
        assert reason in caplog.text
        desk.inbox.reset()
        assert (desk.inbox.counts.clamped, desk.inbox.counts.refused) == (0, 0)


def test_another_type_on_the_topic_is_refused(desk: Desk):
    with desk.node.publisher(command_topic("drone", "rates"), Imu):
        wait_for(lambda: desk.inbox.poll() is not None or desk.inbox.counts.refused)
        desk.send("position", stamp_ns=5)
        assert wait_for(desk.inbox.poll).mode == "position"


def test_a_flood_is_counted(desk: Desk):
    for stamp_ns in range(500):
        desk.send("rates", stamp_ns=stamp_ns)
    assert wait_for(desk.inbox.poll).stamp_ns <= 499

    def all_counted() -> bool:
        desk.inbox.poll()
        counts = desk.inbox.counts
        taken = sum(s.counters.received for s in desk.inbox._subscribers.values())
        overtaken = sum(s.counters.overtaken for s in desk.inbox._subscribers.values())
        assert counts.superseded <= 500
        return taken + overtaken + counts.lost == 500

    wait_for(all_counted)


def test_wait_takes_the_one_that_fits(desk: Desk):
    desk.send("rates", stamp_ns=10)
    desk.send("rates", stamp_ns=20)
    desk.send("position", stamp_ns=30)
    desk.settle(3)
    command = desk.inbox.wait(lambda c: c.stamp_ns == 20, wake=lambda: False)
    assert command is not None
    assert (command.mode, command.stamp_ns) == ("rates", 20)
    assert desk.inbox.missed is not None
    assert desk.inbox.missed.stamp_ns != 20
    command = desk.inbox.wait(
        lambda c: c.stamp_ns == 40, deadline_s=time.monotonic() + 0.5, wake=lambda: False
    )
    assert command is None
    assert desk.inbox.missed.stamp_ns == 30
    assert desk.inbox.counts.superseded == 2


def test_wait_ends_when_it_is_told_to(desk: Desk):
    calls = []
    assert desk.inbox.wait(lambda c: True, wake=lambda: calls.append(None) or len(calls) == 3) is None
    assert len(calls) == 3


def test_wait_hears_a_command_of_another_mode(desk: Desk):
    """The wait is on the mode that came last; others are looked at now and then."""
    desk.publisher("position")
    desk.send("rates", stamp_ns=1)
    assert desk.inbox.wait(lambda c: True, wake=lambda: False) is not None
    waiting = threading.Event()

    def wake() -> bool:
        waiting.set()
        return False

    sender = threading.Thread(target=lambda: waiting.wait(SOON_S) and desk.send("position", stamp_ns=2))
    sender.start()
    command = desk.inbox.wait(lambda c: True, deadline_s=time.monotonic() + SOON_S, wake=wake)
    sender.join()
    assert command is not None
    assert command.mode == "position"


def test_newcomers_are_told_apart(desk: Desk):
    """One that leaves while another comes leaves the count as it was."""
    assert not desk.inbox.find_newcomers()
    topic = command_topic("drone", "rates")
    with desk.node.publisher(topic, COMMANDS["rates"]) as first:
        assert first.wait_for_subscribers(1, SOON_S)
        wait_for(desk.inbox.find_newcomers)
        assert not desk.inbox.find_newcomers()
    with desk.node.publisher(topic, COMMANDS["rates"]) as second:
        assert second.wait_for_subscribers(1, SOON_S)
        wait_for(desk.inbox.find_newcomers)
    assert not desk.inbox.find_newcomers()


def test_reset_throws_away_and_counts_anew(desk: Desk):
    desk.send("rates", row=[np.nan] * 4)
    desk.send("rates", stamp_ns=3)
    desk.settle(2)
    desk.inbox.reset()
    assert desk.inbox.poll() is None
    assert desk.inbox.counts.refused == 0
    assert desk.inbox.counts.superseded == 0


@pytest.mark.parametrize(("lockstep", "cores", "looks"), [(True, 2, 3), (True, 1, 0), (False, 2, 0)])
def test_only_lockstep_looks_for_commands_and_leaves_the_only_core_to_others(
    shared_runtime: Path, monkeypatch: pytest.MonkeyPatch, *, lockstep: bool, cores: int, looks: int
):
    monkeypatch.setattr("neurosim_core.live.inbox.core_count", lambda: cores)
    with Node("inbox") as node:
        desk = Desk(node, lockstep=lockstep)
        looked_s: list[float] = []
        for subscriber in desk.inbox._subscribers.values():
            monkeypatch.setattr(subscriber, "look_out", looked_s.append)
        for stamp_ns in range(3):
            desk.send("motor_speeds", stamp_ns=stamp_ns)
            desk.settle(1)
            command = desk.inbox.wait(lambda command: True, wake=lambda: False)
            assert command is not None
            assert command.stamp_ns == stamp_ns
        assert looked_s == [_SPIN_S] * looks
