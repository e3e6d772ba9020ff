"""The C module, where it was compiled; without it everything works, more slowly.

`CORTEX_PURE_PYTHON=1` leaves it out, to compare or to find a fault.
"""

from __future__ import annotations

import contextlib
import importlib
import os
from typing import Any

native: Any = None
"""`cortex._native`, or None."""
if not os.environ.get("CORTEX_PURE_PYTHON"):
    with contextlib.suppress(ImportError):  # there was no compiler when this was installed
        native = importlib.import_module("cortex._native")
