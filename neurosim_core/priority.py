"""Threads that give way: what takes long must not keep what has to be in time from a core.

A thread that is woken waits for those that run. On Linux with its default settings these may go on for
milliseconds if they are as important, less if they are nicer, and where a core is free there is no wait.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
import threading
from collections.abc import Iterator

_STEPS = 5
"""How much nicer a thread that gives way is: beside a busy program it gets a quarter of a core."""
_SLACK_NS = 1_000
"""How much later than asked for a thread that is punctual may be woken by a timer [ns]; usually 50,000."""
_SET_TIMER_SLACK = 29  # PR_SET_TIMERSLACK of `prctl`

_own = threading.local()


def give_way() -> None:
    """Let the calling thread, and threads that it starts from now on, give way to others; for good.

    Only on Linux, where threads have priorities of their own. Not by SCHED_BATCH and long turns: beside busy
    programs of others half of the pictures were late then.
    """
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, 0, min(niceness() + _STEPS, 19))


def be_punctual() -> None:
    """Let sleeps and timed waits of the calling thread, and of those that it starts, end when they are to.

    For good, and only on Linux. Others are woken up to 50 us later, so that a core can sleep on.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_TIMER_SLACK, ctypes.c_ulong(_SLACK_NS), 0, 0, 0)


def niceness() -> int:
    """Return how nice the calling thread is: a thread that it starts is as nice."""
    return os.getpriority(os.PRIO_PROCESS, 0)


@contextlib.contextmanager
def sparing(core_count: int) -> Iterator[None]:
    """Leave cores to others: what the calling thread computes on several cores in the block uses fewer.

    Args:
        core_count: How many to leave; one is used in any case.
    """
    before = spared_count()
    _own.spared_count = core_count
    try:
        yield
    finally:
        _own.spared_count = before


def spared_count() -> int:
    """Return how many cores the calling thread leaves to others."""
    count: int = getattr(_own, "spared_count", 0)
    return count
