"""Batches that share a late device give what they give one by one, in whatever order its streams go on."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from late_device import LateDevice, install_pipeline

from neurosim_core.runtime.cuda import Launches
from neurosim_core.runtime.pipeline import Pipeline

BATCH_COUNT = 40


class Run:
    """Batches that leave a number from stage to stage, in buffers that come again."""

    def __init__(self, device: LateDevice, pipeline: Pipeline) -> None:
        self.device, self.pipeline = device, pipeline
        self.state = self.seen = 0
        """Of the vehicle, and of an event camera: what comes next depends on both."""
        self.flown = [0] * pipeline.flown_ahead
        self.rendered = [0] * pipeline.in_flight
        self.events: dict[int, int] = {}
        self.phases: list[str] = []

    def _run(self, stage: str, slot: int, launch: Callable[[], None]) -> None:
        """Launch an operation of the device under a key that comes again with the slot."""
        self.pipeline.run(Launches((stage, slot), lambda: self.device.add(launch)))

    def flight(self, number: int) -> None:
        slot = number % self.pipeline.flown_ahead

        def fly() -> None:
            self.state = self.flown[slot] = 3 * self.state % 1_000_003 + 1

        with self.pipeline.flight(number):
            self._run("flight", slot, fly)

    def look(self, number: int) -> None:
        slot, buffer = number % self.pipeline.flown_ahead, number % self.pipeline.in_flight

        def render() -> None:
            self.rendered[buffer] = 2 * self.flown[slot]

        def scan() -> None:
            self.seen = self.seen // 2 + self.rendered[buffer]
            self.events[buffer] = self.seen

        with self.pipeline.renders(number):
            self._run("render", (slot, buffer), render)
        with self.pipeline.scans(number):
            self._run("scan", buffer, scan)

    def read(self, number: int) -> tuple[int, int]:
        """Wait for a batch, and return what came of it; its buffers are free then."""
        self.pipeline.wait_flight(number)
        state = self.flown[number % self.pipeline.flown_ahead]
        self.pipeline.wait(number)
        return state, self.events[number % self.pipeline.in_flight]


def expected() -> list[tuple[int, int]]:
    state, seen, found = 0, 0, []
    for _ in range(BATCH_COUNT):
        state = 3 * state % 1_000_003 + 1
        seen = seen // 2 + 2 * state
        found.append((state, seen))
    return found


@pytest.fixture(params=range(6))
def make(request, monkeypatch) -> Callable[..., Run]:
    """Return what makes a run on a device whose streams go on as chance will have it."""
    rng = np.random.default_rng(request.param)
    device = LateDevice(rng, eagerness=(0.0, 0.3, 0.7)[request.param % 3])
    install_pipeline(monkeypatch, device)

    def make_run(**options: Any) -> Run:
        chosen = {"flown_ahead": options["in_flight"], "single_graph": False, "adaptive": False, **options}
        return Run(device, Pipeline(device, dict.fromkeys(PHASES, 0.0), **chosen))

    return make_run


PHASES = ("dynamics and control", "render", "events", "launches", "choice of renders")


@pytest.mark.parametrize("in_flight", [1, 2, 5])
def test_batches_in_flight(make, in_flight):
    """The vehicle flies ahead of the cameras by as many batches as there are buffers."""
    run, found, waiting = make(in_flight=in_flight), [], deque()
    for number in range(BATCH_COUNT):
        if len(waiting) == in_flight:
            found.append(run.read(waiting.popleft()))
        run.flight(number)
        run.look(number)
        waiting.append(number)
    found += [run.read(number) for number in waiting]
    assert found == expected()
    assert run.device.replayed_count > BATCH_COUNT


def test_a_batch_as_one_graph(make):
    """Nothing is launched before its end, and all of it comes again as one graph."""
    run, found = make(in_flight=1, single_graph=True), []
    for number in range(BATCH_COUNT):
        with run.pipeline.batch(number):
            run.flight(number)
            run.look(number)
            assert not any(stream.waiting for stream in run.device.streams)
        run.pipeline.wait(number)
        assert (run.state, run.seen) == expected()[number]
        found.append(run.read(number))
    assert found == expected()
    assert run.device.replayed_count == BATCH_COUNT - 2


def test_flights_ahead_of_the_cameras(make):
    """The host reads states as they are flown, and lets the cameras look later."""
    run, states, events = make(in_flight=1, flown_ahead=4), [], []
    for begin in range(0, BATCH_COUNT, 4):
        for number in range(begin, begin + 4):
            run.flight(number)
            run.pipeline.wait_flight(number)
            states.append(run.flown[number % 4])
        for number in range(begin, begin + 4):
            run.look(number)
            run.pipeline.wait(number)
            events.append(run.events[0])
    assert list(zip(states, events, strict=True)) == expected()


def test_what_is_rendered_may_depend_on_the_flight(make):
    """A choice is made of the flight of its batch, while the renders of those before may wait."""
    run, found = make(in_flight=2, adaptive=True), []
    for number in range(BATCH_COUNT):
        run.flight(number)
        seen: list[int] = []
        with run.pipeline.choice(number):
            run.device.add(lambda seen=seen, number=number: seen.append(run.flown[number % 2]))
        run.device.run_until(lambda seen=seen: bool(seen))
        found.append(seen[0])
        run.look(number)
        if number:
            run.read(number - 1)
    assert found == [state for state, _ in expected()]
