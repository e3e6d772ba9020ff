"""The C module of Cortex, which tests of shared memory and of its own paths need."""

from __future__ import annotations

import pytest

from cortex.compiled import native

needs_native = pytest.mark.skipif(
    native is None,
    reason="no C module: install a C compiler and Python's headers, then `pip install -e .` again",
)
