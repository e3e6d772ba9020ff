"""A core of its own for a thread that must be in time, and the others for one that computes."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import pytest
from processes import SOON_S, wait_for

from neurosim_core import cores
from neurosim_core.cores import OwnCore, all_cores, following

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2, reason="needs Linux and two cores"
)

Result = TypeVar("Result")


def in_thread(work: Callable[[], Result]) -> Result:
    """Do something in a thread of its own: what becomes of this one stays as it is."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(work).result()


@contextmanager
def sleeper() -> Iterator[int]:
    """A thread that sleeps; yields its number."""
    end, number = threading.Event(), []
    begun = threading.Event()

    def sleep() -> None:
        number.append(threading.get_native_id())
        begun.set()
        end.wait()

    thread = threading.Thread(target=sleep)
    thread.start()
    assert begun.wait(SOON_S)
    try:
        yield number[0]
    finally:
        end.set()
        thread.join()


def own() -> frozenset[int]:
    return frozenset(os.sched_getaffinity(0))


def test_two_threads_are_kept_apart_and_let_go():
    def compute() -> None:
        core = OwnCore()
        with sleeper() as punctual:
            core.give(punctual)
            kept = frozenset(os.sched_getaffinity(punctual))
            assert len(kept) == 1
            assert own() == all_cores() - kept
            core.give(punctual)  # again: nothing changes
            assert frozenset(os.sched_getaffinity(punctual)) == kept
            core.take_back()
            assert frozenset(os.sched_getaffinity(punctual)) == own() == all_cores()
            core.take_back()
            assert own() == all_cores()

    in_thread(compute)
    assert own() == all_cores()


def test_who_has_the_core_may_leave_it_at_once():
    """While the other thread computes on; that one goes back to all cores when it says so."""

    def compute() -> None:
        core = OwnCore()
        with sleeper() as punctual:
            core.give(punctual)
            kept = own()
            in_thread(core.leave)
            assert frozenset(os.sched_getaffinity(punctual)) == all_cores()
            assert own() == kept < all_cores()
            core.take_back()
            assert own() == all_cores()
            core.give(punctual)
            assert len(os.sched_getaffinity(punctual)) == 1
            core.take_back()

    in_thread(compute)


def test_another_thread_gets_the_core_instead():
    def compute() -> None:
        core = OwnCore()
        with sleeper() as first, sleeper() as second:
            core.give(first)
            core.give(second)
            assert frozenset(os.sched_getaffinity(first)) == all_cores()
            assert own() == all_cores() - os.sched_getaffinity(second)

    in_thread(compute)


def test_a_thread_that_was_kept_to_a_core_stays_there():
    """Where a user has put it."""

    def compute() -> None:
        core = OwnCore()
        chosen = {max(all_cores())}
        with sleeper() as punctual:
            os.sched_setaffinity(punctual, chosen)
            core.give(punctual)
            core.take_back()
            assert os.sched_getaffinity(punctual) == chosen
            assert own() == all_cores()

    in_thread(compute)


def test_threads_that_it_starts_meanwhile_are_let_go_with_it():
    """They begin where it is kept, as the system has it."""
    go, started, end = threading.Event(), threading.Event(), threading.Event()
    numbers: list[int] = []

    def child() -> None:
        numbers.append(threading.get_native_id())
        started.set()
        end.wait()

    def punctual() -> None:
        numbers.append(threading.get_native_id())
        started.set()
        go.wait()
        thread = threading.Thread(target=child)
        thread.start()
        thread.join()

    def compute() -> None:
        core = OwnCore()
        parent = threading.Thread(target=punctual)
        parent.start()
        try:
            assert started.wait(SOON_S)
            started.clear()
            core.give(numbers[0])
            go.set()
            assert started.wait(SOON_S)
            assert len(os.sched_getaffinity(numbers[1])) == 1
            core.take_back()
            assert [frozenset(os.sched_getaffinity(n)) for n in numbers] == [all_cores()] * 2
        finally:
            go.set()
            end.set()
            parent.join()

    in_thread(compute)


def test_a_thread_that_has_ended_holds_nobody_up():
    def compute() -> None:
        core = OwnCore()
        with sleeper() as punctual:
            pass
        wait_for(lambda: cores._last_core(punctual) is None)  # `join` does not wait for that
        core.give(punctual)
        assert own() == all_cores()
        with sleeper() as punctual:
            core.give(punctual)
        wait_for(lambda: cores._last_core(punctual) is None)
        core.take_back()
        assert own() == all_cores()

    in_thread(compute)


@pytest.mark.parametrize("error", [PermissionError, OSError])
def test_nothing_happens_where_the_system_says_no(monkeypatch: pytest.MonkeyPatch, error: type[OSError]):
    def refuse(*_: object) -> None:
        raise error("no")

    def compute() -> None:
        core = OwnCore()
        with sleeper() as punctual, monkeypatch.context() as patch:
            patch.setattr(os, "sched_setaffinity", refuse)
            core.give(punctual)
            core.take_back()
        assert own() == all_cores()

    in_thread(compute)


def test_one_core_is_not_shared_out(monkeypatch: pytest.MonkeyPatch):
    core = min(all_cores())
    monkeypatch.setattr(cores, "_last_core", lambda _: core)

    def compute() -> None:
        with sleeper() as punctual:
            before = os.sched_getaffinity(punctual)
            os.sched_setaffinity(0, {core})
            OwnCore().give(punctual)
            assert os.sched_getaffinity(punctual) == before

    in_thread(compute)
    assert own() == all_cores()


def test_threads_of_a_pool_follow_whoever_has_them_work():
    """Also those that were started while he kept to some cores, and when he does so no more."""
    with ThreadPoolExecutor(1) as pool:

        def ask() -> frozenset[int]:
            return pool.submit(following(own)).result()

        def compute() -> None:
            core = OwnCore()
            with sleeper() as punctual:
                core.give(punctual)
                assert ask() == own() < all_cores()
                core.take_back()
                assert ask() == all_cores()
                core.give(punctual)
                assert ask() == own() < all_cores()
            core.take_back()

        in_thread(compute)
        assert ask() == all_cores()  # of a thread that never kept to any


def test_two_simulators_do_not_have_the_same_core(monkeypatch: pytest.MonkeyPatch):
    core = min(all_cores())
    monkeypatch.setattr(cores, "_last_core", lambda _: core)

    def compute() -> None:
        one, two = OwnCore(), OwnCore()
        with sleeper() as first, sleeper() as second:
            one.give(first)
            two.give(second)
            assert os.sched_getaffinity(first) == {core}
            assert os.sched_getaffinity(second) == all_cores()
            one.take_back()
            two.give(second)
            assert os.sched_getaffinity(second) == {core}
            two.take_back()

    in_thread(compute)


def test_a_core_that_a_thread_may_not_use_any_more_is_not_given(monkeypatch: pytest.MonkeyPatch):
    """It ran there last, and was told since to run elsewhere."""
    monkeypatch.setattr(cores, "_last_core", lambda _: min(all_cores()))

    def compute() -> None:
        with sleeper() as punctual:
            os.sched_setaffinity(punctual, {max(all_cores())})
            OwnCore().give(punctual)
            assert os.sched_getaffinity(punctual) == {max(all_cores())}
            assert own() == all_cores()

    in_thread(compute)
