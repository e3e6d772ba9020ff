"""Serialised messages through Cyclone DDS.

The public functions of `cyclonedds` take and return objects, and serialise them in Python: 35 ms for an
image. What lies below them takes and returns bytes. It is private to cyclonedds 11, which is the version that
this package asks for, and is used in this module only.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable
from typing import Any

from cyclonedds._clayer import ddspy_take, ddspy_write
from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet

from cortex_ros2_bridge.backend.base import Buffer

ENTITIES = threading.RLock()
"""Held while entities of Cyclone DDS are made or deleted, and while discovery is read.

Each of these goes through the binding for Python, which lets other threads run meanwhile, with types that
entities share. Once a process crashed in the making of a topic while discovery was followed; 10^5 topics on
three threads did not make it do so again, nor did valgrind find anything. Messages do not take this lock."""
NO_TYPE_HASH = b"typehash=RIHS01_" + 64 * b"0" + b";"
"""User data of endpoints whose type ROS does not know: nodes of Jazzy warn of those that show no hash."""
_ANY = 0x7F
"""Samples of all states."""


class Refused(Exception):
    """Cyclone DDS did not take a message."""


def write(writer: Any, message: Buffer) -> None:
    """Write a serialised message.

    Raises:
        Refused: It is not a message of the writer's type, or the writer is gone.
    """
    if len(message) <= 4:
        raise Refused("it is not longer than its header")
    if len(message) % 4:  # Cyclone DDS wants whole words
        message = bytes(message) + bytes(-len(message) % 4)
    code = ddspy_write(writer._ref, message)
    if code < 0:
        raise Refused(f"Cyclone DDS returned {code}")


def take(reader: Any, limit: int) -> list[bytes]:
    """Take up to that many messages; with the length rounded up to a multiple of four."""
    samples = ddspy_take(reader._ref, _ANY, limit)
    if isinstance(samples, int):
        raise Refused(f"Cyclone DDS returned {samples}")
    return [data for data, info in samples if info.valid_data]


def wait_set(participant: Any, guard: Any, readers: Iterable[Any]) -> Any:
    """Return what waits for a guard condition and for messages of readers; `ENTITIES` is held."""
    waits = WaitSet(participant)
    waits.attach(guard)
    for reader in readers:
        waits.attach(ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Any))
    return waits
