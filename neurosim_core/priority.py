"""Threads that give way: what takes long must not keep what has to be in time from a core.

A thread that is woken waits for those that run. On Linux with its default settings these may go on for
milliseconds if they are as important, less if they are nicer, and where a core is free there is no wait.
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
_TURN_NS = 20_000_000
"""How long it may go on until the scheduler looks who has waited for longer [ns]."""
_SLACK_NS = 1_000
"""How much later than asked for a thread that is punctual may be woken by a timer [ns]; usually 50,000."""
_SET_ATTRIBUTES = {"x86_64": 314, "aarch64": 274, "riscv64": 274}
"""Numbers of the system call `sched_setattr`, which not every C library has a function for."""
_SET_TIMER_SLACK = 29  # PR_SET_TIMERSLACK of `prctl`

_own = threading.local()


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


def give_way() -> None:
    """Let the calling thread, and threads that it starts from now on, give way to others; for good.

    It is nicer than it was, and takes no core from another when it is woken. From Linux 6.12 on its turns are
    long, too, so that whoever is woken goes first: with turns of the same length it often had to wait for the
    clock of the scheduler, up to 4 ms.

    Only on Linux, where threads have priorities of their own.
    """
    if sys.platform != "linux":
        return
    nice = min(niceness() + _STEPS, 19)
    os.setpriority(os.PRIO_PROCESS, 0, nice)
    if os.sched_getscheduler(0) == os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        _take_turns(os.SCHED_BATCH, nice, _TURN_NS)


def be_punctual() -> None:
    """Let sleeps and timed waits of the calling thread end when they are to, on Linux; for good.

    Others are woken up to 50 us later, so that a core can sleep on.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_TIMER_SLACK, ctypes.c_ulong(_SLACK_NS), 0, 0, 0)


def _take_turns(policy: int, nice: int, turn_ns: int) -> None:
    """Set how long turns of the calling thread are [ns], if the system can; the rest is what it is."""
    call = _SET_ATTRIBUTES.get(platform.machine())
    if call is not None:
        size = ctypes.sizeof(_Attributes)
        attributes = _Attributes(size=size, policy=policy, nice=nice, runtime_ns=turn_ns)
        ctypes.CDLL(None).syscall(call, 0, ctypes.byref(attributes), 0)  # refused: turns stay as they are


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
