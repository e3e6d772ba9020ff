"""Logs of Cortex (MCAP): the packets of a vehicle, as `cortex record` found them on its topics."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from neurosim_core.io.event_file import EventFileError, EventSource, choose_topic, gather_blocks
from neurosim_core.packets import PACKET_CLASSES, EventArrays, Events, Packet
from neurosim_core.registry import kinds


class LogSource(EventSource):
    """Reads the sensors of one vehicle from a log."""

    def __init__(self, path: Path, *, sensor: str = "") -> None:
        from cortex.log import LogError, open_log

        super().__init__(path)
        try:
            self._log = open_log(path)
        except LogError as error:
            raise EventFileError(str(error)) from None
        self.notes = [f"{path}: {self._log.cut}"] if self._log.cut else []
        known = _message_types()
        topics = [entry for entry in self._log.topics if entry.topic.count("/") == 2]
        found = {entry.topic: known[entry.schema.name] for entry in topics if entry.schema.name in known}
        self._types = {topic: kind for topic, (kind, _) in found.items()}
        self._cameras = [topic for topic, (_, packet) in found.items() if issubclass(packet, Events)]
        self._sensor = sensor

    def begin(self) -> None:
        """Choose the camera, and with it the vehicle."""
        self._topic = choose_topic(self._path, self._cameras, self._sensor)
        self._vehicle = self._topic.rpartition("/")[0]
        first = next((packet for packet in self.packets() if isinstance(packet, Events)), None)
        self.size = (first.width, first.height) if first else (1, 1)

    def packets(self) -> Iterator[Packet]:
        """Yield the packets of the camera's vehicle, in the order in which they arrived.

        Raises:
            EventFileError: The log is damaged in the middle.
        """
        from cortex import MalformedMessage, TypeMismatch
        from cortex.log import LogError
        from neurosim_core.live.messages import to_packet

        types = {topic: kind for topic, kind in self._types.items() if topic.startswith(f"{self._vehicle}/")}
        try:
            for topic, message, _ in self._log.messages(types=types):
                yield to_packet(message, topic.rpartition("/")[2])
        except (LogError, MalformedMessage, TypeMismatch) as error:
            raise EventFileError(f"{self._path}: {error}") from None

    def read(self) -> Iterator[EventArrays]:
        """See `EventSource.read`."""
        name = self._topic.rpartition("/")[2]
        events = (p.numpy() for p in self.packets() if isinstance(p, Events) and p.sensor == name)
        yield from gather_blocks(events)

    def close(self) -> None:
        """Close the file."""
        self._log.close()


def _message_types() -> dict[str, tuple[type, type[Packet]]]:
    """Return the message type of each packet class that has one, and that class, by the name of the type."""
    from cortex.schema import schema_of
    from neurosim_core.live.messages import message_type

    kinds("sensor")  # a class is known once its module is imported
    types = {}
    for packet in PACKET_CLASSES.values():
        with contextlib.suppress(TypeError):  # arrays without axes: no message can carry it
            kind = message_type(packet)
            types[schema_of(kind).name] = kind, packet
    return types
