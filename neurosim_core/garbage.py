"""When Python looks for garbage: not while it makes what stays."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def no_collection() -> Iterator[None]:
    """Look for no garbage in a block, nor ever in what is there at its end; for a process that does it once.

    Each look at the modules and settings of a flight takes 0.1 s, in its set-up or in the midst of it.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if was_enabled:
            gc.enable()
