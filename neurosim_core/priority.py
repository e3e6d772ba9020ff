"""Threads that give way: what takes long must not keep what has to be in time from a core.

A thread that is woken waits for those that run. On Linux with its default settings these may go on for
milliseconds, until the scheduler's clock ticks, even if they are nicer. From Linux 6.12 on a thread may say
how long its turns are: who is woken and has shorter ones than the thread that runs goes first. What share of
a core each has does not depend on that.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import sys
import threading
from collections.abc import Iterator

_STEPS = 5
"""How much nicer a thread that gives way is: beside a busy program it gets a quarter of a core."""
_LONG_TURN_NS = 3_000_000
"""Longer than the usual turn, 2.8 ms on machines of 8 cores or more (3 on earlier kernels) and less on others
[ns]. Not much longer: with turns of 20 ms half of the pictures were late beside busy programs of others."""
_WAKER_TURN_NS = 2_900_000
"""Longer than the usual turn, and shorter than that of a thread that gives way [ns]."""
_TURN_STEP_NS = 100_000
"""How much longer than the turns that a thread has those are at least that it asks for [ns]."""
_SLACK_NS = 1_000
"""How much later than asked for a thread that is punctual may be woken by a timer [ns]; usually 50,000."""
_SET_TIMER_SLACK = 29  # PR_SET_TIMERSLACK of `prctl`
_SET_ATTRIBUTES = {"x86_64": 314, "aarch64": 274, "riscv64": 274}
"""Numbers of the system call `sched_setattr`, which not every C library has a function for; the next is
`sched_getattr`."""

_own = threading.local()


def give_way() -> None:
    """Let the calling thread, and threads that it starts from now on, give way to others; for good.

    Only on Linux, where threads have priorities of their own.
    """
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, 0, min(niceness() + _STEPS, 19))
        take_turns(max(_LONG_TURN_NS, _turn_ns() + 2 * _TURN_STEP_NS))


def be_punctual() -> None:
    """Let sleeps and timed waits of the calling thread, and of those that it starts, end when they are to.

    For good, and only on Linux. Others are woken up to 50 us later, so that a core can sleep on. Turns are as
    usual: with shorter ones it would go before who reads what it has just sent.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_TIMER_SLACK, ctypes.c_ulong(_SLACK_NS), 0, 0, 0)


def let_the_woken_go_first() -> int:
    """Let those that the calling thread wakes go before it, where they have usual turns.

    For one that is at work nearly all the time: beside a busy program it is later than with usual turns.
    Threads and processes that it starts meanwhile are as it is. Only on Linux.

    Returns:
        How long its turns were, for `take_turns` [ns]; 0: not known, and as they were.
    """
    before_ns = _turn_ns()
    if before_ns:
        take_turns(max(_WAKER_TURN_NS, before_ns + _TURN_STEP_NS))
    return before_ns


class _Attributes(ctypes.Structure):
    """`struct sched_attr` of Linux, as far as all its versions have it."""

    _fields_ = (
        ("size", ctypes.c_uint32),
        ("policy", ctypes.c_uint32),
        ("flags", ctypes.c_uint64),
        ("nice", ctypes.c_int32),
        ("priority", ctypes.c_uint32),
        ("runtime_ns", ctypes.c_uint64),
        ("deadline_ns", ctypes.c_uint64),
        ("period_ns", ctypes.c_uint64),
    )


def take_turns(turn_ns: int) -> None:
    """Say how long turns of the calling thread are [ns]; where that cannot be, they are as they were."""
    attributes = _attributes()
    if turn_ns and attributes is not None:
        attributes.runtime_ns = turn_ns
        call = _SET_ATTRIBUTES[platform.machine()]
        ctypes.CDLL(None).syscall(call, 0, ctypes.byref(attributes), 0)


def _turn_ns() -> int:
    """Return how long turns of the calling thread are [ns]; 0: not known."""
    attributes = _attributes()
    return 0 if attributes is None else int(attributes.runtime_ns)


def _attributes() -> _Attributes | None:
    """Return how the calling thread is scheduled; None: not known, or not as usual."""
    call = _SET_ATTRIBUTES.get(platform.machine()) if sys.platform == "linux" else None
    if call is None or os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK != os.SCHED_OTHER:
        return None
    attributes = _Attributes()
    size = ctypes.sizeof(attributes)
    failed = ctypes.CDLL(None).syscall(call + 1, 0, ctypes.byref(attributes), size, 0)
    return None if failed else attributes


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
