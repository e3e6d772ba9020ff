"""Bags as files of messages of Cortex: written by the rules of the bridge, and read back.

What is written is what the bridge would send, each message at its own stamp, but for drawings of events. What
is read back are events, pictures, inertial measurements, odometry and commands, of any bag, also of others,
and of ROS 1.

    with contextlib.closing(BagWriter(Path("flight.mcap"))) as bag:
        bag.write("/drone/imu", Imu(...))
"""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection

from cortex import messages
from cortex.evt3 import EVT3_SIZE_MAX, EventCodecError
from cortex.schema import schema_of
from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.backend.bag import BagBackend, BagPublisher
from cortex_ros2_bridge.backend.base import BackendError, Buffer
from cortex_ros2_bridge.config import BridgeConfig
from cortex_ros2_bridge.convert import RULES, Context, ConvertError
from cortex_ros2_bridge.convert.camera import pixel_type
from cortex_ros2_bridge.convert.commands import xyz
from cortex_ros2_bridge.convert.records import stamp_ns_of
from cortex_ros2_bridge.convert.registry import Rule
from cortex_ros2_bridge.event_codec import read_dvs
from cortex_ros2_bridge.routes import Seen, SeenTopic, make_routes, rule_of, vehicle_of
from cortex_ros2_bridge.typestore import typestore

__all__ = ["EVENT_TYPES", "BackendError", "BagError", "BagReader", "BagWriter", "ConvertError"]


class BagError(ValueError):
    """A bag is damaged, or a message of it cannot be used."""


_Way = tuple[Any, Context, BagPublisher]
"""From a topic of Cortex to one of the bag: a conversion, its context, and what takes its messages."""


class BagWriter:
    """Writes messages of Cortex into a bag: every default route of the bridge from their topics.

    Args:
        path: `flight.mcap` for a single file, which Foxglove opens; else the directory to make.
        storage: "mcap" or "sqlite3", for a directory; Humble reads only the second without a plug-in.

    Raises:
        BackendError: There is something at the path already, or it cannot be written.
    """

    def __init__(self, path: Path, *, storage: str = "mcap") -> None:
        self._file = path if path.suffix == ".mcap" else None
        directory = path if self._file is None else path.with_name(f"{path.stem}.bag")
        self._bag = BagBackend(directory, storage=storage)
        self._ways: dict[str, list[_Way]] = {}
        self._closed = False

    def write(self, topic: str, message: Any, *, frame_id: str = "", at_ns: int | None = None) -> int:
        """Write a message, and return how many messages of ROS were made of it.

        Args:
            topic: In Cortex, such as "/drone/imu".
            message: Any message with a stamp.
            frame_id: Frame of a message that does not name its own, such as "drone/base_link".
            at_ns: Its time in the bag [ns]; None: its stamp.

        Raises:
            ConvertError: ROS has no such values.
            BackendError: The disk is full.
        """
        if topic not in self._ways:
            self._ways[topic] = self._ways_of(topic, message, frame_id)
        written = 0
        for convert, context, publisher in self._ways[topic]:
            data = convert(message, context)
            if data is not None:
                written += 1
                publisher.publish(data, at_ns=message.stamp_ns if at_ns is None else at_ns)
            context.sequence += 1
        return written

    def close(self) -> None:
        """Complete the bag. Closing twice is allowed."""
        if self._closed:
            return
        self._closed = True
        self._bag.close()
        if self._file is not None:
            (self._bag.directory / f"{self._bag.directory.name}.mcap").replace(self._file)
            shutil.rmtree(self._bag.directory)

    def _ways_of(self, topic: str, message: Any, frame_id: str) -> list[_Way]:
        schema = schema_of(type(message))
        seen = SeenTopic(topic, schema.name, schema.fingerprint, True, schema=schema.to_json())
        routes, _ = make_routes(Seen((seen,)), BridgeConfig(backend=".mcap"))
        wide = max(getattr(message, "width", 0), getattr(message, "height", 0)) > EVT3_SIZE_MAX
        ways = []
        has_events = any(route.ros_type in EVENT_TYPES for route in routes)
        for route in routes:
            rule = rule_of(route)
            drawn = has_events and route.ros_type == "sensor_msgs/msg/Image"
            if drawn or route.ros_type == "sensor_msgs/msg/CameraInfo":  # nobody gives a calibration
                continue
            options = {
                **route.options,
                **({"encoding": "mono"} if wide and "encoding" in rule.options else {}),
            }
            context = Context(vehicle=vehicle_of(topic), frame_id=frame_id, options=options)
            publisher = self._bag.publisher(route.ros_topic, route.ros_type, route.qos)
            ways.append((rule.convert, context, publisher))
        return ways


class BagReader:
    """Reads the messages of a bag that have a counterpart in Cortex.

    Args:
        path: A directory, a file of type MCAP, or a file of ROS 1 whose name ends in ".bag".
        max_thrust_n: Thrust of an AttitudeTarget with thrust 1 [N]; None: of the default airframe.

    Raises:
        BagError: It is no bag, is damaged, or cannot be read.

    Attributes:
        topics: Type in ROS of each topic that can be read, but for commands.
        commands: Likewise of commands, which are read where they are asked for.
        others: The topics that cannot be read.
    """

    def __init__(self, path: Path, *, max_thrust_n: float | None = None) -> None:
        self._path = path
        self._max_thrust_n = max_thrust_n
        self._ros1 = path.suffix == ".bag" and path.is_file()
        try:
            self._reader = (rosbag1 if self._ros1 else rosbag2).Reader(path)
            self._reader.open()
        except Exception as error:  # what rosbags raises for damage is not listed anywhere
            raise BagError(f"{path} is not a readable bag: {error}") from None
        self._closed = False
        of_commands = [each for each in self._reader.connections if _rules_of(each)]
        readable = _DECODERS.keys() | _OF_ROBOTS.keys()
        self._connections = [each for each in self._reader.connections if each.msgtype in readable]
        drawn = {f"{each.topic}/image" for each in self._connections if each.msgtype in EVENT_TYPES}
        self._connections = [each for each in self._connections if each.topic not in drawn]
        self.topics = {each.topic: each.msgtype for each in self._connections}
        self.commands = {each.topic: each.msgtype for each in of_commands}
        self._connections += of_commands
        self.others = sorted(
            {each.topic for each in self._reader.connections} - self.topics.keys() - self.commands.keys()
        )

    def messages(self, *topics: str) -> Iterator[tuple[str, Any]]:
        """Yield topics and messages of Cortex in the order in which they were recorded.

        Args:
            topics: Which of `topics` and `commands`; none: all of `topics`.

        Raises:
            BagError: The bag is damaged, or has a message that cannot be used.
        """
        for topic, message, _ in self.timed_messages(*topics):
            yield topic, message

    def timed_messages(self, *topics: str) -> Iterator[tuple[str, Any, int]]:
        """As `messages`, with the time at which each was recorded [ns]."""
        chosen = [each for each in self._connections if each.topic in (topics or self.topics)]
        if not chosen:
            return
        decoders = {each.id: self._decoder_of(each) for each in chosen}
        for connection, data, at_ns in self._raw(chosen):
            try:
                yield connection.topic, decoders[connection.id](data), at_ns
            except (cdr.CdrError, ConvertError, EventCodecError, struct.error, ValueError) as error:
                raise BagError(f"{self._path}: {connection.topic}: {error}") from None

    def _decoder_of(self, connection: Connection) -> Callable[[Buffer], Any]:
        if self._ros1 and connection.msgtype == _EVENT_ARRAY:
            return lambda data: _event_array(data, ros1=True)
        if connection.msgtype in _DECODERS:
            return _DECODERS[connection.msgtype]
        of_robot = _OF_ROBOTS.get(connection.msgtype)
        rules = _rules_of(connection) if of_robot is None else [of_robot]
        context = Context(vehicle=vehicle_of(connection.topic), max_thrust_n=self._max_thrust_n)

        def decode(data: Buffer) -> Any:
            made = (rule.convert(data, context) for rule in rules)
            message = next((each for each in made if each is not None), None)
            context.sequence += 1
            return message

        return decode

    def _raw(self, connections: list[Connection]) -> Iterator[tuple[Connection, Buffer, int]]:
        try:
            for connection, at_ns, data in self._reader.messages(connections):
                if self._ros1 and connection.msgtype != _EVENT_ARRAY:
                    data = typestore().ros1_to_cdr(data, connection.msgtype)
                yield connection, data, at_ns
        except Exception as error:
            raise BagError(f"{self._path} is damaged: {error}") from None

    def close(self) -> None:
        """Close the bag. Closing twice is allowed."""
        if not self._closed:
            self._closed = True
            self._reader.close()


def _rules_of(connection: Connection) -> list[Rule]:
    """Return the rules by which the messages of a topic are commands."""
    kind, topic = connection.msgtype, connection.topic
    commands = [rule for rule in RULES if rule[1:3] == (kind, "in") and not rule.robot]
    return [rule for rule in commands if topic.endswith(rule.name.removeprefix("{base}"))]


def _image(data: Buffer) -> messages.Image:
    made = cdr.decode(data, "sensor_msgs/msg/Image")
    dtype, channels = pixel_type(made.encoding)
    kind = dtype.newbyteorder(">" if made.is_bigendian else "<")
    rows = made.data.reshape(made.height, made.step)[:, : made.width * channels * dtype.itemsize]
    pixels = np.ascontiguousarray(rows).view(kind).astype(dtype)
    return messages.Image(
        stamp_ns=stamp_ns_of(made.header.stamp),
        data=pixels.reshape(made.height, made.width, channels),
        encoding=made.encoding,
        frame_id=made.header.frame_id,
    )


def _imu(data: Buffer) -> messages.Imu:
    made = cdr.decode(data, "sensor_msgs/msg/Imu")
    return messages.Imu(
        stamp_ns=stamp_ns_of(made.header.stamp),
        specific_force=xyz(made.linear_acceleration),
        angular_rate=xyz(made.angular_velocity),
    )


def _event_array(data: Buffer, *, ros1: bool = False) -> messages.Events:
    size, columns = read_dvs(data, ros1=ros1)
    return messages.Events(
        stamp_ns=1000 * int(columns.t[-1]) if len(columns.t) else 0,
        start_ns=1000 * int(columns.t[0]) if len(columns.t) else 0,
        **columns._asdict(),
        width=size[0],
        height=size[1],
    )


_EVENT_ARRAY = "dvs_msgs/msg/EventArray"
EVENT_TYPES = frozenset({"event_camera_msgs/msg/EventPacket", _EVENT_ARRAY})
_DECODERS: dict[str, Callable[[Buffer], Any]] = {
    _EVENT_ARRAY: _event_array,
    "sensor_msgs/msg/Image": _image,
    "sensor_msgs/msg/Imu": _imu,
}
"""What no rule of the bridge takes in."""
_OF_ROBOTS = {rule.ros_type: rule for rule in RULES if rule.robot and rule.direction == "in"}
