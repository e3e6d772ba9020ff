"""Open recordings in a process that was forked: they belong to its parent."""

from __future__ import annotations

import os
import weakref
from pathlib import Path
from typing import Protocol


class _Recording(Protocol):
    def disown(self) -> None:
        """Write nothing any more; called once, in a process that was forked."""


_open: weakref.WeakSet[_Recording] = weakref.WeakSet()


def disown_when_forked(recording: _Recording) -> None:
    """Have `recording.disown()` called in each process that is forked from this one."""
    _open.add(recording)


def forked_error(path: Path) -> RuntimeError:
    """Return what a forked process is told that writes to a recording of its parent."""
    return RuntimeError(f"{path} was opened before this process was forked: only its parent can write to it")


def _disown() -> None:
    for recording in [*_open]:
        recording.disown()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_disown)
