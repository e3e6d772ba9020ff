"""Threads that give way, and cores that are left to others."""

from __future__ import annotations

import ctypes
import os
import platform
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from neurosim_core import priority
from neurosim_core.priority import (
    be_punctual,
    give_way,
    let_the_woken_go_first,
    niceness,
    spared_count,
    sparing,
)
from neurosim_core.render import launch
from neurosim_core.sensors.events import EventCamera, EventCameraConfig


@wp.kernel
def _number(first: int, numbers_out: wp.array[int]) -> None:
    thread = first + wp.tid()
    numbers_out[thread] = thread


on_linux = pytest.mark.skipif(sys.platform != "linux", reason="threads have no priorities of their own")


def in_thread(work: Callable[[], object]) -> None:
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()


@on_linux
def test_a_thread_gives_way_with_those_that_it_starts_and_no_other():
    before, found = niceness(), []

    def work() -> None:
        give_way()
        found.append(niceness())
        in_thread(lambda: found.append(niceness()))

    in_thread(work)
    expected = min(before + priority._STEPS, 19)
    assert found == [expected, expected]
    assert niceness() == before


def turn_ns() -> int:
    """How long turns of the calling thread are [ns]; 0: the kernel does not know of such, before 6.12."""
    attributes = priority._Attributes()
    call = priority._SET_ATTRIBUTES[platform.machine()] + 1  # sched_getattr
    size = ctypes.sizeof(attributes)
    assert ctypes.CDLL(None).syscall(call, 0, ctypes.byref(attributes), size, 0) == 0
    return int(attributes.runtime_ns)


@on_linux
@pytest.mark.skipif(platform.machine() not in priority._SET_ATTRIBUTES, reason="no number of the system call")
def test_who_gives_way_has_longer_turns_than_usual_and_who_is_punctual_has_not():
    usual_ns, found = 1_400_000, []

    def usual() -> None:
        priority.take_turns(usual_ns)  # whatever those of the thread that tests are
        in_thread(lambda: (give_way(), found.append(turn_ns()), in_thread(lambda: found.append(turn_ns()))))
        in_thread(lambda: (be_punctual(), found.append(turn_ns())))
        found.append(turn_ns())

    in_thread(usual)
    long_ns = priority._LONG_TURN_NS
    assert usual_ns < long_ns
    assert found == ([long_ns, long_ns, usual_ns, usual_ns] if turn_ns() else [0, 0, 0, 0])


@on_linux
@pytest.mark.skipif(platform.machine() not in priority._SET_ATTRIBUTES, reason="no number of the system call")
@pytest.mark.parametrize("most_usual_ns", [1_400_000, 2_800_000, 3_000_000, 4_000_000])
def test_turns_of_who_lets_the_woken_go_first_are_between_the_usual_ones_and_those_of_who_gives_way(
    most_usual_ns,
):
    """Shorter turns go first: readers before it, and it before the thread that renders."""
    found: list[int] = []

    def usual() -> None:
        priority.take_turns(most_usual_ns)
        in_thread(lambda: (let_the_woken_go_first(), found.append(turn_ns())))
        in_thread(lambda: (give_way(), found.append(turn_ns())))

    in_thread(usual)
    assert found == [0, 0] or most_usual_ns < found[0] < found[1]


@on_linux
def test_turns_are_given_back():
    def work() -> None:
        before_ns = priority._turn_ns()
        assert let_the_woken_go_first() == before_ns
        priority.take_turns(before_ns)
        assert priority._turn_ns() == before_ns

    in_thread(work)


@on_linux
def test_a_thread_that_was_given_another_policy_keeps_it():
    """Such as by `chrt`; to set turns would set a policy as well."""
    found = []

    def work() -> None:
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        give_way()
        be_punctual()
        found.append(os.sched_getscheduler(0))

    in_thread(work)
    assert found == [os.SCHED_BATCH]


@on_linux
def test_a_thread_is_punctual_and_no_other():
    """The kernel says how much later than asked for a thread may be woken."""

    def slack_ns() -> int:
        return int(Path(f"/proc/{threading.get_native_id()}/timerslack_ns").read_text())

    found = []

    def usual() -> None:
        ctypes.CDLL(None).prctl(priority._SET_TIMER_SLACK, ctypes.c_ulong(50_000), 0, 0, 0)
        in_thread(lambda: (be_punctual(), found.append(slack_ns())))
        found.append(slack_ns())

    in_thread(usual)
    assert found == [priority._SLACK_NS, 50_000]


@pytest.mark.parametrize(("cores", "spared", "used"), [(4, 0, 4), (4, 1, 3), (2, 1, 1), (1, 1, 1)])
def test_a_launch_leaves_cores_to_others(monkeypatch: pytest.MonkeyPatch, cores: int, spared: int, used: int):
    asked = []
    pool = launch._pool
    monkeypatch.setattr(launch, "core_count", lambda: cores)
    monkeypatch.setattr(launch, "_pool", lambda count, nice: asked.append(count) or pool(count, nice))
    numbers = wp.zeros(100_000, dtype=int, device="cpu")
    with sparing(spared):
        launch.launch_split(_number, dim=numbers.size, inputs=[], outputs=[numbers], device="cpu")
    assert asked == ([used] if used > 1 else [])  # alone it needs no pool
    assert np.array_equal(numbers.numpy(), np.arange(numbers.size))
    assert spared_count() == 0


def test_the_events_are_the_same_with_fewer_cores(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("neurosim_core.sensors.event_pixels.core_count", lambda: 4)
    frames = np.random.default_rng(5).normal(0.0, 0.5, (4, 128, 256)).astype(np.float32)

    def events(spared: int) -> list[bytes]:
        camera = EventCamera(EventCameraConfig(), width=256, height=128)
        camera.reset(frames[0])
        with sparing(spared):
            packet = camera.feed(frames[1:], [1_000_000, 2_000_000, 3_000_000])
        return [column.tobytes() for column in packet.numpy()]

    every = events(0)
    assert len(every[0]) > 0
    assert events(1) == events(3) == every
