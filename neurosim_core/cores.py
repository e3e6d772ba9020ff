"""Which thread runs on which core: a core of its own for one that must be in time, while another computes.

A scheduler may wake a thread on the core that is busiest with its work instead of one that idles: that of
who woke it, or the only one that is awake in a virtual machine. There it waits for whoever computes until the
scheduler's clock ticks, up to 4 ms, unless the two may not use the same core.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import weakref
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import ParamSpec, TypeVar

_PROCESSOR = 36
"""Where the core is in `/proc/self/task/*/stat`, counted from what follows the name."""

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")
_own = threading.local()
_changing = threading.Lock()


@cache
def all_cores() -> frozenset[int]:
    """Return the cores that this process may use, as of the first call; threads may keep to some since."""
    if hasattr(os, "sched_getaffinity"):
        return frozenset(os.sched_getaffinity(0))
    return frozenset(range(os.cpu_count() or 1))


class OwnCore:
    """A core for a thread that must be in time; a thread that computes much keeps to the others.

    To be used by the thread that computes, but for `leave`. Without effect on one core, or where no Linux is.
    """

    def __init__(self) -> None:
        """Leave everything as it is."""
        all_cores()  # before anybody is kept to some of them
        self._thread_id: int | None = None
        self._core: int | None = None
        self._before: set[int] = set()
        self._mine: frozenset[int] = frozenset()
        self._others: frozenset[int] = frozenset()
        """Where the thread that computes keeps to meanwhile."""
        self._threads: set[str] = set()

    def give(self, thread_id: int) -> None:
        """Let a thread run where it ran last and nowhere else, and the calling one on all other cores.

        Args:
            thread_id: Of this process, as the system counts it (`threading.get_native_id`).
        """
        if thread_id == self._thread_id:
            return
        self.take_back()
        core = _last_core(thread_id)
        if core is None:
            return
        self._mine = frozenset(os.sched_getaffinity(0))
        with _changing:
            # other simulators of this process fly on a core of theirs, and compute on others
            taken = {other._core for other in _holders}
            others = self._mine - {core} - taken
            if not others or core in taken or any(core in other._others for other in _holders):
                return
            try:
                self._before = os.sched_getaffinity(thread_id)
                if core not in self._before:  # somebody has said otherwise since it ran there
                    return
                os.sched_setaffinity(thread_id, {core})
            except OSError:  # it has ended, or the system says no
                return
            _holders.add(self)
            self._thread_id, self._core, self._threads = thread_id, core, _threads()
            self._others = others
        _keep_to(others)

    def take_back(self) -> None:
        """Let both run where they could before, and threads that were started on the core meanwhile."""
        self.leave()
        if hasattr(_own, "cores"):
            _keep_to(self._mine)
            del _own.cores  # where it may run is the system's matter again

    def leave(self) -> None:
        """Let only the thread that has the core run where it could before. Any thread may say so."""
        with _changing:
            thread_id, self._thread_id = self._thread_id, None
            if thread_id is None:
                return
            _holders.discard(self)
            started = _threads() - self._threads
            # if it has ended, the number may be another process's by now
            if os.path.exists(f"/proc/self/task/{thread_id}"):
                started.add(str(thread_id))
            for number in map(int, started):
                with contextlib.suppress(OSError):  # it has ended
                    if os.sched_getaffinity(number) == {self._core}:  # and nobody has said otherwise since
                        os.sched_setaffinity(number, self._before)


_holders: weakref.WeakSet[OwnCore] = weakref.WeakSet()
"""Those that some thread has a core by."""


def following(work: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """Return work for a thread of a pool that keeps to the cores to which the calling thread keeps now."""
    cores: frozenset[int] | None = getattr(_own, "cores", None)

    def run(*arguments: _Parameters.args, **named: _Parameters.kwargs) -> _Result:
        if cores is not None or hasattr(_own, "cores"):
            _keep_to(cores or all_cores())
        return work(*arguments, **named)

    return run


def _keep_to(cores: frozenset[int]) -> None:
    """Let the calling thread run on these cores only."""
    if getattr(_own, "cores", None) != cores:
        _set(0, cores)
        _own.cores = cores


def _set(thread_id: int, cores: set[int] | frozenset[int]) -> None:
    """Say where a thread may run; 0: the calling one. Where the system says no, it is as it was."""
    with contextlib.suppress(OSError):
        os.sched_setaffinity(thread_id, cores)


def _threads() -> set[str]:
    """Return the numbers of the threads of this process; none where they cannot be read."""
    try:
        return set(os.listdir("/proc/self/task"))
    except OSError:
        return set()


def _last_core(thread_id: int) -> int | None:
    """Return the core on which a thread of this process ran last; None if it has ended, or is not Linux's."""
    if sys.platform != "linux":
        return None
    try:
        stat = Path(f"/proc/self/task/{thread_id}/stat").read_text()
    except OSError:
        return None
    return int(stat.rpartition(")")[2].split()[_PROCESSOR])
