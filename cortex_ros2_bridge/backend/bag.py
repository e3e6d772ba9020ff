"""A bag instead of a network: what is published is recorded for `ros2 bag play` and Foxglove.

A bag of rosbag2 is a directory with `metadata.yaml` and a file of type MCAP, in which each topic has the text
of its type's definition.
"""

from __future__ import annotations

import logging
import sqlite3
import struct
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from rosbags.interfaces import Nodetype, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.interfaces import Qos as BagQos
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.errors import WriterError
from rosbags.typesys.store import Typestore

from cortex_ros2_bridge.backend.base import BackendError, Buffer, Qos, TopicInfo, check_message
from cortex_ros2_bridge.backend.environment import chosen_distro
from cortex_ros2_bridge.backend.names import check_name
from cortex_ros2_bridge.typestore import DEFAULT_DISTRO, check_type, typestore

_log = logging.getLogger(__name__)

_CLOCK = "rosgraph_msgs/msg/Clock"
_TIME = "builtin_interfaces/msg/Time"
_AHEAD_NS = 1_000_000_000
"""Furthest that a message may be ahead of the clock; what claims more, has another clock."""
_DISK_ERRORS = (OSError, sqlite3.Error)
_UNLIMITED = QosTime(9223372036, 854775807)


def bag_directory(path: Path) -> Path:
    """Return the directory of a bag: `flight` for `flight.mcap`."""
    return path.with_suffix("") if path.suffix == ".mcap" else path


class BagBackend:
    """Records what is published. Nobody else is there: nothing is ever received.

    Messages are stamped with the time at which they came in, by /clock: so a bag plays as the flight was, and
    what a link delays is late in the bag. Without /clock their own stamps are the time. When /clock goes
    back, because a simulator was reset, the bag goes on.
    """

    name = "bag"
    failure = ""

    def __init__(self, path: str | Path, *, distro: str | None = None, storage: str = "mcap") -> None:
        """Begin a bag; see `choose.open_backend`. The storage is "mcap" or "sqlite3".

        Raises:
            BackendError: There is something at the path already, or it cannot be written.
        """
        self.distro = chosen_distro(distro) or DEFAULT_DISTRO
        self.directory = bag_directory(Path(path))
        self._lock = threading.Lock()
        self._time = _BagTime()
        self._connections: dict[tuple[str, str, Qos], Any] = {}
        self._writer: Writer | None = None
        try:
            # Version 8 of the metadata is what all distributions read, Humble to Jazzy and later.
            writer = Writer(self.directory, version=8, storage_plugin=StoragePlugin[storage.upper()])
            writer.open()
        except (WriterError, *_DISK_ERRORS) as error:
            raise BackendError(f"the bag {self.directory} cannot be made: {error}") from error
        self._writer = writer

    def publisher(self, topic: str, type_name: str, qos: Qos) -> BagPublisher:
        """Record a topic."""
        check_name(topic)
        check_type(type_name, self.distro)
        key = topic, type_name, qos
        with self._lock:
            if self._writer is None:
                raise BackendError("this bag is closed")
            if key not in self._connections:  # a topic that comes back goes on where it was
                self._connections[key] = self._writer.add_connection(
                    topic, type_name, typestore=typestore(self.distro), offered_qos_profiles=[_bag_qos(qos)]
                )
            return BagPublisher(self, self._connections[key], stamp_reader(type_name, typestore(self.distro)))

    def subscription(self, topic: str, *_: Any) -> NoReturn:
        """There are neither subscriptions nor services: nobody publishes, and nobody asks."""
        raise BackendError(f"{topic}: nobody else is there in a bag")

    service = subscription

    def topics(self) -> list[TopicInfo]:
        """Nobody else is there."""
        return []

    def close(self) -> None:
        """Complete the bag."""
        with self._lock:
            writer, self._writer = self._writer, None
            if writer is None:
                return
            try:
                writer.close()
            except _DISK_ERRORS as error:
                writer.abort()
                raise BackendError(f"the bag {self.directory} cannot be completed: {error}") from error
        size_mb = sum(file.stat().st_size for file in self.directory.iterdir()) / 1e6
        _log.info("%d messages, %.1f MB, are in %s", sum(writer.counts.values()), size_mb, self.directory)

    def write(
        self, connection: Any, stamp_ns: int | None, message: Buffer, *, at_ns: int | None = None
    ) -> None:
        """Record a message of a topic, with the stamp that it has itself, or at another time."""
        with self._lock:
            if self._writer is None:
                raise BackendError("this bag is closed")
            is_clock = connection.msgtype == _CLOCK
            came_ns = self._time.at(stamp_ns, is_clock=is_clock) if at_ns is None else at_ns
            data = message if isinstance(message, (bytes, memoryview)) else bytes(message)
            try:
                self._writer.write(connection, came_ns, data)
            except _DISK_ERRORS as error:
                raise BackendError(f"the bag {self.directory} cannot be written: {error}") from error


class BagPublisher:
    """Records one topic."""

    subscriber_count = 1
    """The bag, which wants everything."""

    def __init__(self, bag: BagBackend, connection: Any, read_stamp: Callable[[Buffer], int | None]) -> None:
        self._bag = bag
        self._connection = connection
        self._read_stamp = read_stamp
        self._open = True

    def publish(self, message: Buffer, *, at_ns: int | None = None) -> None:
        """Record a message, as one that came at a time [ns]; None: now, by /clock or its own stamp."""
        if not self._open:
            raise BackendError(f"the publisher of {self._connection.topic} is closed")
        check_message(message, self._connection.topic)
        self._bag.write(self._connection, self._read_stamp(message), message, at_ns=at_ns)

    def close(self) -> None:
        """Record no more; what was recorded stays."""
        self._open = False


class _BagTime:
    """When messages came in."""

    def __init__(self) -> None:
        self._now_ns = 0
        self._offset_ns = 0
        self._has_clock = False

    def at(self, stamp_ns: int | None, *, is_clock: bool) -> int:
        """Return the time of a message [ns], which is never before that of the clock."""
        if is_clock and stamp_ns is not None:
            if stamp_ns + self._offset_ns < self._now_ns and self._has_clock:
                self._offset_ns = self._now_ns - stamp_ns
            self._has_clock = True
            self._now_ns = max(stamp_ns + self._offset_ns, self._now_ns)
        elif stamp_ns is not None:
            own_ns = stamp_ns + self._offset_ns
            if not self._has_clock:
                self._now_ns = max(own_ns, self._now_ns)
            elif self._now_ns < own_ns <= self._now_ns + _AHEAD_NS:
                return own_ns
        return self._now_ns


def stamp_reader(type_name: str, store: Typestore) -> Callable[[Buffer], int | None]:
    """Return a function that reads the stamp [ns] of messages of a type; it returns None where there is none.

    The stamp is the time with which the message begins, as a header does, or, of a message that is a list,
    that with which its first element begins.
    """
    field: Any = (Nodetype.NAME, type_name)
    is_list = False
    while field != (Nodetype.NAME, _TIME):
        kind, detail = field
        if kind == Nodetype.NAME and store.fielddefs[detail][1]:
            field = store.fielddefs[detail][1][0][1]
        elif kind == Nodetype.SEQUENCE and not is_list:
            field, is_list = detail[0], True
        else:
            return lambda message: None
    offset = 8 if is_list else 4  # after the header of CDR, and the number of elements

    def read(message: Buffer) -> int | None:
        if len(message) < offset + 8 or (is_list and not any(message[4:8])):
            return None
        seconds, nanoseconds = struct.unpack_from("<iI", message, offset)
        return max(int(seconds * 1_000_000_000 + nanoseconds), 0)

    return read


def _bag_qos(qos: Qos) -> BagQos:
    return BagQos(
        history=QosHistory.KEEP_LAST,
        depth=qos.depth,
        reliability=QosReliability[qos.reliability.upper()],
        durability=QosDurability[qos.durability.upper()],
        deadline=_UNLIMITED,
        lifespan=_UNLIMITED,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_UNLIMITED,
        avoid_ros_namespace_conventions=False,
    )
