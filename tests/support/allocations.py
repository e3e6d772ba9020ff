"""The arrays that Warp allocates meanwhile."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any
from unittest import mock

import warp as wp


@contextlib.contextmanager
def allocations() -> Iterator[list[dict[str, Any]]]:
    """Yield the arguments of each array that is made in the block and has memory of its own."""
    made: list[dict[str, Any]] = []
    make = wp.array.__init__

    def counted(array: Any, *args: Any, **kwargs: Any) -> None:
        if kwargs.get("ptr") is None:
            made.append(kwargs)
        make(array, *args, **kwargs)

    with mock.patch.object(wp.array, "__init__", counted):
        yield made
