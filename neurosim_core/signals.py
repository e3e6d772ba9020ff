"""Handlers of SIGINT (Ctrl-C) and SIGTERM (`kill`) for the duration of a block."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from types import FrameType

INTERRUPTED_LINE = "neurosim: interrupted"
"""What a command says that is interrupted."""
_SET_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of `prctl`


@contextlib.contextmanager
def handle_signals(
    handler: Callable[[int, FrameType | None], object],
    numbers: Sequence[signal.Signals] = (signal.SIGINT, signal.SIGTERM),
) -> Iterator[None]:
    """Have signals call a handler; other threads than the main one are not told of signals."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


@contextlib.contextmanager
def stop_at_signals(stop: threading.Event, *, on_stop: Callable[[], object] | None = None) -> Iterator[None]:
    """Turn signals into an event: they must not break into the writing of a file. A second may.

    Args:
        stop: Is set. The main thread must not `wait` for it but sleep and look: a signal that came while the
            wait holds the event's lock would hang.
        on_stop: Called then, wherever the main thread is: it must take no lock.
    """

    def on_signal(_signal: int, _frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()
        if on_stop is not None:
            on_stop()

    with handle_signals(on_signal):
        yield


@contextlib.contextmanager
def raise_at_signals() -> Iterator[Callable[[], None]]:
    """Turn a signal into a `KeyboardInterrupt`; a second one ends the process on the spot.

    Yields:
        A function for loops to call: it raises again, as imports and libraries may have swallowed it.
    """
    caught: list[int] = []

    def on_signal(number: int, frame: FrameType | None) -> None:
        if caught:
            leave_at_once(number, frame)
        caught.append(number)
        raise KeyboardInterrupt

    def raise_again() -> None:
        if caught:
            raise KeyboardInterrupt

    with handle_signals(on_signal):
        yield raise_again


def leave_at_once(_signal: int, _frame: FrameType | None) -> None:
    """End the process on the spot, as long as nothing is open; imports may swallow a `KeyboardInterrupt`."""
    try:
        for terminal in filter(os.isatty, (1, 2)):
            os.write(terminal, b"\x1b[?25h")  # lines of progress hide the cursor
        os.write(2, f"{INTERRUPTED_LINE}\n".encode())
    finally:  # nobody may read that
        os._exit(130)


def end_with_parent(number: signal.Signals) -> Callable[[], None] | None:
    """Return what a child process does first to get a signal when this process dies. Only Linux can."""
    if sys.platform != "linux":
        return None
    prctl, parent = ctypes.CDLL(None).prctl, os.getpid()

    def ask_kernel() -> None:
        prctl(_SET_PARENT_DEATH_SIGNAL, number)
        if os.getppid() != parent:  # it has died meanwhile
            os._exit(130)

    return ask_kernel
