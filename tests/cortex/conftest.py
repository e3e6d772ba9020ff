"""Fixtures for tests with nodes."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from processes import Child
from runtime_directory import runtime

from cortex.node import Node

__all__ = ["runtime"]


@pytest.fixture
def make_node(runtime: Path) -> Iterator[Callable[..., Node]]:
    """Makes nodes, and closes them."""
    with contextlib.ExitStack() as stack:

        def make(name: str = "node", **options: object) -> Node:
            return stack.enter_context(Node(name, **options))  # type: ignore[arg-type]

        yield make


@pytest.fixture
def start_child(runtime: Path) -> Iterator[Callable[..., Child]]:
    """Starts processes of `peer.py` in a role, and ends them."""
    with contextlib.ExitStack() as stack:

        def start(role: str, **arguments: object) -> Child:
            child = Child(role, **arguments)  # type: ignore[arg-type]
            stack.callback(child.end)
            return child

        yield start
