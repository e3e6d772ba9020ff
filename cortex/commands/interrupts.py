"""Ctrl-C and SIGTERM in a command: an exception ends it, and the second signal ends the process."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from typing import NoReturn


class Terminated(BaseException):
    """SIGTERM: end as after Ctrl-C, with files closed and leave taken."""


_caught: list[type[BaseException]] = []


def leave(number: int, frame: object) -> NoReturn:
    """Leave at once: nothing is open yet, or closing takes too long. No file is worse than after SIGKILL."""
    os._exit(128 + number)


def raise_at_signals(first: Callable[[], object] = lambda: None) -> None:
    """Let SIGINT raise `KeyboardInterrupt` and SIGTERM `Terminated`, once each; `first` is called before."""
    _caught.clear()

    def on_signal(number: int, frame: object) -> NoReturn:
        signal.signal(number, leave)
        _caught.append(KeyboardInterrupt if number == signal.SIGINT else Terminated)
        first()
        raise _caught[-1]

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)


def raise_again() -> None:
    """Raise what a signal has raised: for loops, since imports, and other code in between, may swallow it."""
    if _caught:
        raise _caught[-1]
