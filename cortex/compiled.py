"""The C module, where it was compiled; without it everything works, more slowly.

`CORTEX_PURE_PYTHON=1` leaves it out, to compare or to find a fault.
"""

from __future__ import annotations

import importlib
import logging
import os
import sys
from typing import Any

logger = logging.getLogger(__name__)

INTERFACE = 21
"""What `_native.c` must say of itself: counts up with each change of what it offers."""


def _load() -> Any:
    if os.environ.get("CORTEX_PURE_PYTHON"):
        return None
    try:
        module = importlib.import_module("cortex._native")
    except ModuleNotFoundError as error:  # there was no compiler when this was installed
        if error.name == "cortex._native":
            return None
        raise
    except ImportError as error:
        logger.warning("the C module of cortex cannot be loaded; all goes on, more slowly: %s", error)
        return None
    if getattr(module, "INTERFACE", 0) != INTERFACE:
        logger.warning(
            "%s is older or newer than cortex and is left out, which is slower: install cortex again",
            module.__file__,
        )
        return None
    return module


def _require_gil() -> None:
    """Refuse to run without the GIL, on which much relies that takes no lock."""
    if not getattr(sys, "_is_gil_enabled", lambda: True)():  # a free-threaded Python
        raise ImportError("cortex needs the GIL: run python with -X gil=1, or PYTHON_GIL=1")


native: Any = _load()
_require_gil()
