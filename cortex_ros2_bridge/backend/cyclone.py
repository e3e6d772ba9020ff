"""Serialised messages through Cyclone DDS.

The public functions of `cyclonedds` take and return objects, and serialise them in Python: 35 ms for an
image. What lies below them takes and returns bytes. It is private, so it is used in this module only, and
tried out before: if it is not what it was, the public functions do the work, slowly.
"""

from __future__ import annotations

import logging
import os
import threading
from typing import Any, Literal, NamedTuple, Protocol

from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from cortex_ros2_bridge.backend.base import Buffer
from cortex_ros2_bridge.backend.idl import make_struct, types

_log = logging.getLogger(__name__)

Choice = Literal["auto", "fast", "public"]
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


class Transport(Protocol):
    """How serialised messages get into a writer and out of a reader."""

    name: str

    def write(self, writer: Any, message: Buffer) -> None:
        """Write a message.

        Raises:
            Refused: It is not a message of the writer's type, or the writer is gone.
        """

    def take(self, reader: Any, limit: int) -> list[bytes]:
        """Take up to that many messages; with the length rounded up to a multiple of four."""


class Fast:
    """Bytes as they are, through private names of cyclonedds 11.

    Raises:
        ImportError: The names are not there.
    """

    name = "fast"

    def __init__(self) -> None:
        from cyclonedds._clayer import ddspy_take, ddspy_write

        self._take = ddspy_take
        self._write = ddspy_write

    def write(self, writer: Any, message: Buffer) -> None:
        """Write a message."""
        _check_length(message)
        if len(message) % 4:  # Cyclone DDS wants whole words
            message = bytes(message) + bytes(-len(message) % 4)
        code = self._write(writer._ref, message)
        if code < 0:
            raise Refused(f"Cyclone DDS returned {code}")

    def take(self, reader: Any, limit: int) -> list[bytes]:
        """Take up to that many messages."""
        samples = self._take(reader._ref, _ANY, limit)
        if isinstance(samples, int):
            raise Refused(f"Cyclone DDS returned {samples}")
        return [data for data, info in samples if info.valid_data]


class Public:
    """Through objects, with public names only."""

    name = "public"

    def write(self, writer: Any, message: Buffer) -> None:
        """Write a message."""
        _check_length(message)
        try:
            sample = writer.topic.data_type.deserialize(bytes(message))
        except Exception as error:  # whatever its decoder stumbles over
            raise Refused(str(error)) from error
        from cyclonedds.core import DDSException

        try:
            writer.write(sample)
        except DDSException as error:
            raise Refused(str(error)) from error

    def take(self, reader: Any, limit: int) -> list[bytes]:
        """Take up to that many messages."""
        messages = []
        for sample in reader.take(limit):
            if sample.sample_info.valid_data:
                message = sample.serialize(use_version_2=False)
                messages.append(bytes(message) + bytes(-len(message) % 4))
        return messages


def _check_length(message: Buffer) -> None:
    if len(message) <= 4:
        raise Refused("it is not longer than its header")


def choose_transport(participant: DomainParticipant, choice: Choice = "auto") -> Transport:
    """Return the fast transport if it proves itself on this participant, else the public one.

    Raises:
        Refused: The fast one was asked for, and does not work.
    """
    if choice == "public":
        return Public()
    try:
        fast = Fast()
        self_test(participant, fast)
    except (AttributeError, ImportError, TypeError, Refused) as error:
        if choice == "fast":
            raise Refused(f"the fast path of cyclonedds does not work: {error}") from error
        _log.warning("cyclonedds is not the one that was expected (%s): large messages will be slow", error)
        return Public()
    return fast


class Endpoints(NamedTuple):
    """A writer and a reader of the same topic."""

    writer: Any
    reader: Any


def self_test(participant: DomainParticipant, transport: Transport) -> None:
    """Compare a transport with the public functions, on a topic that ROS does not show.

    Raises:
        Refused: They differ.
    """
    kind = make_struct("cortex::SelfTest", {"number": types.uint32, "data": types.sequence[types.uint8]})
    qos = Qos(
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Reliability.Reliable(0),
        Policy.History.KeepLast(4),
        Policy.Userdata(NO_TYPE_HASH),
    )
    topic = Topic(participant, f"cortex_self_test_{os.getpid()}_{os.urandom(4).hex()}", kind, qos)
    both = Endpoints(DataWriter(participant, topic, qos), DataReader(participant, topic, qos))
    # number, length, data, padding
    message = bytes.fromhex("00010000 2a000000 05000000 0102030405 000000")
    sample = kind(number=42, data=[1, 2, 3, 4, 5])
    transport.write(both.writer, memoryview(message))
    if [(taken.number, list(taken.data)) for taken in both.reader.take(2)] != [(42, [1, 2, 3, 4, 5])]:
        raise Refused("a written message is not what is read")
    both.writer.write(sample)
    if transport.take(both.reader, 2) != [message] or transport.take(both.reader, 2) != []:
        raise Refused("a message is not taken as it was written")
    try:
        transport.write(both.writer, message[:14])
    except Refused:
        return
    raise Refused("a truncated message is taken for a whole one")
