"""The marker `alone`: a test that observes real time runs while no other process of pytest-xdist runs one.

It keeps the rest of the suite away, and not other users of the machine.
"""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Hold the machine during a test and its fixtures: alone, or shared with the other processes.

    Who waits for the machine keeps the turnstile, so that others do not pass one that is to be alone.
    These locks end with their process, and its children do not have them.
    """
    if not hasattr(item.config, "workerinput"):
        return (yield)
    folder = Path(item.config.option.basetemp).parent  # of the run, all processes have it
    mode = fcntl.LOCK_EX if item.get_closest_marker("alone") else fcntl.LOCK_SH
    with open(folder / "turnstile.lock", "a+") as turnstile, open(folder / "machine.lock", "a+") as machine:
        fcntl.lockf(turnstile, fcntl.LOCK_EX)
        fcntl.lockf(machine, mode)
        fcntl.lockf(turnstile, fcntl.LOCK_UN)
        return (yield)
