"""The number of cores that the process may use, whatever the machine has."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager, nullcontext
from typing import Any
from unittest import mock


def cores(count: int | None) -> AbstractContextManager[Any]:
    """Let the process have so many cores; None: as many as it has."""
    if count is None:
        return nullcontext()
    return mock.patch.object(os, "sched_getaffinity", return_value=set(range(count)), create=True)
