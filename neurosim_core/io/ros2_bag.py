"""Bags of ROS 2: directories of rosbag2 (MCAP or SQLite), and single MCAP files, which Foxglove opens.

Files of ROS 1 (`.bag`) are read, too. The bridge does all this, by the conversions that it has for running
systems. It is a package that this one does not depend on: it is named here, and imported when a bag is
wanted.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from neurosim_core.install import need
from neurosim_core.io.event_file import (
    EventFileError,
    EventSource,
    PacketCutter,
    choose_topic,
    gather_blocks,
)
from neurosim_core.packets import EventArrays, Odometry, Packet

_VEHICLE = "drone"
_EVENTS = "events"


def open_mcap(path: Path, *, sensor: str = "") -> EventSource:
    """Open a file of type MCAP: a log of Cortex, or a bag of ROS 2."""
    from neurosim_core.io.cortex_log import LogSource

    with open(path, "rb") as file:
        is_bag = file.read(25)[21:] == b"ros2"
    return BagSource(path, sensor=sensor) if is_bag else LogSource(path, sensor=sensor)


class BagSource(EventSource):
    """Reads a bag: events of one camera, and pictures, inertial measurements and odometry."""

    def __init__(self, path: Path, *, sensor: str = "") -> None:
        super().__init__(path)
        bags = _bridge()
        self._sensor, self._event_types, self._error = sensor, bags.EVENT_TYPES, bags.BagError
        try:
            self._bag = bags.BagReader(path)
        except bags.BagError as error:
            raise EventFileError(str(error)) from None

    def read(self) -> Iterator[EventArrays]:
        """See `EventSource.read`."""
        yield from gather_blocks(message for _, message in self._messages(self._topic))

    def packets(self) -> Iterator[Packet]:
        """Yield what is there besides events, in the order in which it was recorded.

        Raises:
            EventFileError: The bag is damaged.
        """
        from neurosim_core.live.messages import to_packet

        counts = dict.fromkeys(self._others, 0)
        for topic, message in self._messages(*self._others) if self._others else ():
            packet = to_packet(message, self._others[topic])
            yield dataclasses.replace(packet, sequence=counts[topic])
            counts[topic] += 1

    def close(self) -> None:
        """Close the bag."""
        self._bag.close()

    def begin(self) -> None:
        """Choose the camera, and the topics of its vehicle."""
        topics = self._bag.topics
        cameras = [topic for topic, kind in topics.items() if kind in self._event_types]
        self._topic = choose_topic(self._path, cameras, self._sensor)
        vehicle = f"{self._topic.rpartition('/')[0]}/"
        self._others = {
            topic: topic.removeprefix(vehicle).removesuffix("/image_raw").strip("/").replace("/", "_")
            for topic in topics
            if topic not in cameras
        }
        found = ((int(m.width), int(m.height)) for _, m in self._messages(self._topic))
        self.size = next(found, (1, 1))

    def _messages(self, *topics: str) -> Iterator[tuple[str, Any]]:
        try:
            yield from self._bag.messages(*topics)
        except self._error as error:
            raise EventFileError(str(error)) from None


class BagSink:
    """Writes a bag: what the bridge would send of a vehicle "drone" with these sensors."""

    def __init__(self, path: Path, *, width: int, height: int, storage: str = "mcap") -> None:
        bags = _bridge()
        self._bags = bags
        with self._errors():
            self._bag = bags.BagWriter(path, storage=storage)
        self._packets = PacketCutter(self.write_packet, width=width, height=height, sensor=_EVENTS)

    def write(self, events: EventArrays) -> None:
        """See `EventSink.write`."""
        self._packets.add(events)

    def write_packet(self, packet: Packet) -> None:
        """Append a packet of any sensor, or leave out what ROS has no message for."""
        from neurosim_core.live.messages import to_message

        body = f"{_VEHICLE}/base_link"
        is_body = isinstance(packet, Odometry)
        try:
            message = to_message(packet, frame_id=body if is_body else f"{_VEHICLE}/{packet.sensor}")
        except TypeError:  # no message can carry it
            return
        with self._errors():
            self._bag.write(f"/{_VEHICLE}/{packet.sensor}", message, frame_id=f"{_VEHICLE}/{packet.sensor}")

    def close(self) -> None:
        """Complete the bag."""
        self._packets.end()
        with self._errors():
            self._bag.close()

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        """Turn the errors of the bridge into those of a sink."""
        try:
            yield
        except self._bags.ConvertError as error:
            raise EventFileError(str(error)) from None
        except self._bags.BackendError as error:
            raise OSError(str(error)) from None


def _bridge() -> Any:
    return need("bags of ROS 2 need rosbags", "ros2", "cortex_ros2_bridge.bag_file")
