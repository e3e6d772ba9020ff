"""A process that speaks DDS as a foreign node does: public functions of cyclonedds, and types of its own.

It reads lines of JSON, such as {"do": "publish", "topic": "rt/x"}, and answers each with {"answer": ...}.
"""

from __future__ import annotations

import json
import struct
import sys
import time
import zlib
from typing import Any

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import InstanceState
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

SOON_S = 60.0


def _struct(name: str, /, **fields: Any) -> Any:
    return make_idl_struct(name.rpartition(".")[2], name, fields)


Time = _struct("builtin_interfaces.msg.dds_.Time_", sec=types.int32, nanosec=types.uint32)
Header = _struct("std_msgs.msg.dds_.Header_", stamp=Time, frame_id=str)
Image = _struct(
    "sensor_msgs.msg.dds_.Image_",
    header=Header,
    height=types.uint32,
    width=types.uint32,
    encoding=str,
    is_bigendian=types.uint8,
    step=types.uint32,
    data=types.sequence[types.uint8],
)
String = _struct("std_msgs.msg.dds_.String_", data=str)
Impostor = _struct("std_msgs.msg.dds_.String_", number=types.float64)
TriggerRequest = _struct(
    "std_srvs.srv.dds_.Trigger_Request_",
    guid=types.uint64,
    seq=types.int64,
    structure_needs_at_least_one_member=types.uint8,
)
TriggerReply = _struct(
    "std_srvs.srv.dds_.Trigger_Response_", guid=types.uint64, seq=types.int64, success=bool, message=str
)
# As `idlc` makes them of the IDL that rosidl makes of each .msg file.
PRIMITIVES = {
    "Bool": bool,
    "Byte": types.byte,  # octet
    "Char": types.uint8,
    "Float32": types.float32,
    "Float64": types.float64,
    "Int8": types.int8,
    "Int16": types.int16,
    "Int32": types.int32,
    "Int64": types.int64,
    "UInt8": types.uint8,
    "UInt16": types.uint16,
    "UInt32": types.uint32,
    "UInt64": types.uint64,
}
KeyValue = _struct("diagnostic_msgs.msg.dds_.KeyValue_", key=str, value=str)
DiagnosticStatus = _struct(
    "diagnostic_msgs.msg.dds_.DiagnosticStatus_",
    level=types.byte,
    name=str,
    message=str,
    hardware_id=str,
    values=types.sequence[KeyValue],
)
Point = _struct("geometry_msgs.msg.dds_.Point_", x=types.float64, y=types.float64, z=types.float64)
Quaternion = _struct(
    "geometry_msgs.msg.dds_.Quaternion_",
    x=types.float64,
    y=types.float64,
    z=types.float64,
    w=types.float64,
)
Pose = _struct("geometry_msgs.msg.dds_.Pose_", position=Point, orientation=Quaternion)
PoseWithCovariance = _struct(
    "geometry_msgs.msg.dds_.PoseWithCovariance_", pose=Pose, covariance=types.array[types.float64, 36]
)
Actuators = _struct(
    "actuator_msgs.msg.dds_.Actuators_",
    header=Header,
    position=types.sequence[types.float64],
    velocity=types.sequence[types.float64],
    normalized=types.sequence[types.float64],
)
KINDS = {
    "Image": Image,
    "String": String,
    "Impostor": Impostor,
    "DiagnosticStatus": DiagnosticStatus,
    "PoseWithCovariance": PoseWithCovariance,
    "Actuators": Actuators,
    **{name: _struct(f"std_msgs.msg.dds_.{name}_", data=kind) for name, kind in PRIMITIVES.items()},
}


def _graph_types(gid_bytes: int) -> Any:
    gid = _struct("rmw_dds_common.msg.dds_.Gid_", data=types.array[types.uint8, gid_bytes])
    node = _struct(
        "rmw_dds_common.msg.dds_.NodeEntitiesInfo_",
        node_namespace=types.bounded_str[256],
        node_name=types.bounded_str[256],
        reader_gid_seq=types.sequence[gid],
        writer_gid_seq=types.sequence[gid],
    )
    return _struct(
        "rmw_dds_common.msg.dds_.ParticipantEntitiesInfo_",
        gid=gid,
        node_entities_info_seq=types.sequence[node],
    )


def _until(condition: Any, timeout_s: float = SOON_S) -> Any:
    deadline = time.monotonic() + timeout_s
    while not (value := condition()) and time.monotonic() < deadline:
        time.sleep(1e-3)
    return value


def _matched(ask: Any) -> Any:
    """Return the matches that CycloneDDS lists; its list is too short where one comes while it is made."""
    try:
        return ask()
    except IndexError:
        return []


class Peer:
    """What the process has, and can do."""

    def __init__(self, domain: int) -> None:
        self.domain = domain
        self.participant: Any = None
        self.endpoint_data = ""
        self.readers: dict[str, Any] = {}
        self.writers: dict[str, Any] = {}
        self.builtin: list[Any] = []
        self.seen: dict[str, Any] = {}
        self.graph: dict[int, Any] = {}
        self.announced: dict[int, dict[str, Any]] = {16: {}, 24: {}}
        self.backend: Any = None

    def join(self, user_data: str = "", endpoint_data: str = "") -> None:
        """Join the domain; everything else does so by itself."""
        self.endpoint_data = endpoint_data
        self.participant = DomainParticipant(self.domain, Qos(Policy.Userdata(user_data.encode())))

    def _topic(self, topic: str, kind: str) -> Any:
        return Topic(self._make(), topic, KINDS[kind])

    def subscribe(self, topic: str, kind: str, matched: bool = True, **qos: Any) -> int:
        """Subscribe, and wait for a publisher; return how many there are."""
        reader = DataReader(self._make(), self._topic(topic, kind), self._qos(**qos))
        self.readers[topic] = reader
        return len(_until(lambda: _matched(reader.get_matched_publications)) if matched else [])

    def _qos(self, reliable: bool = True, durable: bool = False, depth: int = 10) -> Qos:
        return Qos(
            Policy.DataRepresentation(use_cdrv0_representation=True),
            Policy.Reliability.Reliable(100_000_000) if reliable else Policy.Reliability.BestEffort,
            Policy.Durability.TransientLocal if durable else Policy.Durability.Volatile,
            Policy.DurabilityService(0, Policy.History.KeepLast(depth), -1, -1, -1),
            Policy.History.KeepLast(depth),
            Policy.Userdata(self.endpoint_data.encode()),
        )

    def _make(self) -> Any:
        if self.participant is None:
            self.join()
        return self.participant

    def collect(self, topic: str, count: int, timeout_s: float = SOON_S) -> list[Any]:
        """Return that many messages, or fewer if no more come in time."""
        found: list[Any] = []
        _until(lambda: found.extend(self.readers[topic].take(100)) or len(found) >= count, timeout_s)
        return [_shown(sample) for sample in found]

    def advertise(self, topic: str, kind: str, matched: bool = True, **qos: Any) -> int:
        """Make a publisher, and wait for a subscriber; return how many there are."""
        writer = DataWriter(self._make(), self._topic(topic, kind), self._qos(**qos))
        self.writers[topic] = writer
        return len(_until(lambda: _matched(writer.get_matched_subscriptions)) if matched else [])

    def publish(self, topic: str, **fields: Any) -> None:
        """Publish a message."""
        writer = self.writers[topic]
        if writer.data_type is Image:
            fields = {
                "header": Header(stamp=Time(sec=1, nanosec=2), frame_id="lens"),
                "height": 1,
                "width": len(fields["data"]),
                "encoding": "mono8",
                "is_bigendian": 0,
                "step": len(fields["data"]),
                **fields,
            }
        writer.write(writer.data_type(**fields))

    def retract(self, topic: str) -> None:
        """End a publisher; what it published is disposed of."""
        del self.writers[topic]

    def look(self) -> dict[str, Any]:
        """Return what discovery shows: participants, and endpoints by their ids."""
        if not self.builtin:
            for topic in (
                BuiltinTopicDcpsParticipant,
                BuiltinTopicDcpsPublication,
                BuiltinTopicDcpsSubscription,
            ):
                self.builtin.append(BuiltinDataReader(self._make(), topic))
        for reader in self.builtin:
            for sample in reader.take(1000):
                key = sample.key.hex
                if sample.sample_info.instance_state != InstanceState.Alive:
                    self.seen.pop(key, None)
                    continue
                user_data = sample.qos[Policy.Userdata].data if Policy.Userdata in sample.qos else b""
                self.seen[key] = {
                    "topic": getattr(sample, "topic_name", None),
                    "type": getattr(sample, "type_name", None),
                    "participant": sample.participant_key.hex if hasattr(sample, "participant_key") else None,
                    "user_data": bytes(user_data).decode(),
                    "writer": reader is self.builtin[1],
                }
        return self.seen

    def nodes(self, gid_bytes: int) -> dict[str, Any]:
        """Return the newest announcement of each participant, in a layout."""
        if gid_bytes not in self.graph:
            topic = Topic(self._make(), "ros_discovery_info", _graph_types(gid_bytes))
            self.graph[gid_bytes] = DataReader(self._make(), topic, self._qos(durable=True, depth=100))
        announced = self.announced[gid_bytes]
        for sample in self.graph[gid_bytes].take(100):
            if sample.sample_info.valid_data:
                announced[bytes(sample.gid.data).hex()] = [
                    {
                        "name": node.node_name,
                        "namespace": node.node_namespace,
                        "readers": sorted(bytes(gid.data).hex() for gid in node.reader_gid_seq),
                        "writers": sorted(bytes(gid.data).hex() for gid in node.writer_gid_seq),
                    }
                    for node in sample.node_entities_info_seq
                ]
        return announced

    def call(self, name: str, number: int) -> list[Any]:
        """Ask a service of type Trigger as a client of rmw_cyclonedds does; return its reply."""
        request = Topic(self._make(), f"rq{name}Request", TriggerRequest)
        reply = Topic(self._make(), f"rr{name}Reply", TriggerReply)
        reader = DataReader(self._make(), reply, self._qos())
        writer = DataWriter(self._make(), request, self._qos())
        _until(
            lambda: _matched(writer.get_matched_subscriptions) and _matched(reader.get_matched_publications)
        )
        writer.write(
            TriggerRequest(guid=0x123456789ABCDEF0, seq=number, structure_needs_at_least_one_member=0)
        )
        found = _until(lambda: reader.take(1))
        return [[hex(one.guid), one.seq, one.success, one.message] for one in found or []]

    def listen(self, topic: str, type_name: str, depth: int) -> None:
        """Subscribe with our backend."""
        from cortex_ros2_bridge.backend.base import Qos as RosQos
        from cortex_ros2_bridge.backend.dds import DdsBackend

        self.backend = DdsBackend(domain=self.domain, node_name="listener", distro="jazzy")
        self.lengths: list[int] = []
        self.listening = self.backend.subscription(
            topic, type_name, RosQos(depth=depth), lambda message: self.lengths.append(len(message))
        )

    def heard(self) -> dict[str, Any]:
        """Return what came to our subscription."""
        return {"lengths": self.lengths}


def _shown(sample: Any) -> Any:
    if isinstance(sample, Image):
        data = bytes(sample.data)
        return [sample.header.stamp.sec, sample.header.frame_id, sample.encoding, len(data), zlib.crc32(data)]
    if isinstance(sample, String):
        return sample.data
    return struct.pack("<d", sample.number).hex()


def main() -> None:
    """Answer line after line."""
    peer = Peer(int(sys.argv[1]))
    for line in sys.stdin:
        words = json.loads(line)
        answer = getattr(peer, words.pop("do"))(**words)
        print(json.dumps({"answer": answer}), flush=True)
    if peer.backend is not None:
        peer.backend.close()


if __name__ == "__main__":
    main()
