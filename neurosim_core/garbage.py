"""When Python looks for garbage: not while it makes what stays."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def pause_collection() -> Iterator[None]:
    """Look for no garbage in a block: among what a set-up makes, which stays, that takes 0.1 s each time."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@contextlib.contextmanager
def no_collection() -> Iterator[None]:
    """Look for no garbage in a block, nor ever in what is there at its end: once in a process."""
    with pause_collection():
        try:
            yield
        finally:
            gc.freeze()
