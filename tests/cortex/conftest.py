"""Fixtures for tests with nodes."""

from __future__ import annotations

import contextlib

import pytest
from peer import Number, connect, without_rings
from processes import Child
from runtime_directory import runtime

from cortex.node import Node
from cortex.policy import reliable

__all__ = ["runtime"]


@pytest.fixture
def make_node(runtime):
    """Makes nodes, and closes them."""
    with contextlib.ExitStack() as stack:

        def make(name: str = "node", **options: object) -> Node:
            return stack.enter_context(Node(name, **options))  # type: ignore[arg-type]

        yield make


@pytest.fixture
def node(make_node):
    """A node that knows only itself, so that no registry has to start."""
    return make_node(registry="off")


@pytest.fixture
def numbers(node):
    """A publisher and its reliable subscriber."""
    publisher, subscriber = connect(node, "/numbers", Number, reliable(256, 60.0))
    return publisher, subscriber


@pytest.fixture
def sockets_alone():
    """All readers of the test attach through sockets."""
    with without_rings():
        yield


@pytest.fixture
def start_child(runtime):
    """Starts processes of `peer.py` in a role, and ends them."""
    with contextlib.ExitStack() as stack:

        def start(role: str, **arguments: object) -> Child:
            child = Child(role, **arguments)  # type: ignore[arg-type]
            stack.callback(child.end)
            return child

        yield start
