"""The ROS graph over DDS: what others have, and the announcement that shows our endpoints as those of a node.

Discovery of DDS tells of participants and endpoints. Which endpoints belong to which node, each participant
of ROS tells on the topic `ros_discovery_info`. There are two layouts of that message: ids of endpoints have
24 bytes in Humble, and 16 from Iron on. One of the wrong layout hides a node, and on Humble it breaks `ros2
node list` for everybody. So nothing is announced before it is known which of them is spoken: endpoints of
Iron and later show the hash of their type in discovery, those of Humble do not.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np
from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import DDSException, GuardCondition, InstanceState
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy
from cyclonedds.qos import Qos as DdsQos
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from cortex_ros2_bridge.backend.base import Qos, TopicInfo
from cortex_ros2_bridge.backend.cyclone import ENTITIES, Refused, wait_set, write
from cortex_ros2_bridge.backend.idl import idl_struct
from cortex_ros2_bridge.backend.names import TOPIC_PREFIX, ros_topic, ros_type
from cortex_ros2_bridge.typestore import DEFAULT_DISTRO, DISTROS, type_hash, typestore

_log = logging.getLogger(__name__)

PARTICIPANT_NAME = "cortex_ros2_bridge"
"""Name of our participants in DDS: they say nothing about the distribution."""
ENCLAVE = b"enclave=/;"
"""User data by which ROS knows a participant as one of its own."""
DISCOVERY_TOPIC = "ros_discovery_info"
DISCOVERY_TYPE = "rmw_dds_common/msg/ParticipantEntitiesInfo"

Kind = Literal["writer", "reader"]
_DISCOVERED = BuiltinTopicDcpsParticipant, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription
_CLOSE_S = 5.0
_BATCH = 64
_WITHOUT_HASH = next(name for name, distro in DISTROS.items() if not distro.shows_type_hash)


class Endpoint(NamedTuple):
    """A writer or a reader, as discovery shows it."""

    kind: Kind
    participant: bytes
    topic: str
    """As in DDS: "rt/drone/imu"."""
    type_name: str
    """As in DDS: "sensor_msgs::msg::dds_::Imu_"."""
    user_data: bytes
    qos: Qos


def user_data_of_type(type_name: str, distro: str) -> bytes:
    """Return the user data by which endpoints show the hash of their type, from Iron on."""
    return f"typehash={type_hash(type_name, distro)};".encode()


class Graph:
    """Follows discovery on a thread of its own, and announces a node once it knows how.

    Without a distribution, that of the first node of ROS that is seen decides the layout.

    Attributes:
        layout: Distribution whose layout is announced: "humble" or a later one; None: not known yet.
    """

    def __init__(
        self, participant: DomainParticipant, *, node_name: str, namespace: str, distro: str | None
    ) -> None:
        self._participant = participant
        self._key: bytes = participant.guid.bytes
        self._node = node_name, namespace
        self._lock = threading.Lock()
        self._own: dict[bytes, Endpoint] = {}
        self._participants: dict[bytes, tuple[bytes, str]] = {}
        self._endpoints: dict[bytes, Endpoint] = {}
        self._warned: set[bool] = set()
        self._writer: Any = None
        self.layout: str | None = None
        if distro is not None:
            self._speak(distro)
        self._open = True
        with ENTITIES:
            self._guard = GuardCondition(participant)
        self._thread = threading.Thread(target=self._follow, name="ros-graph", daemon=True)
        self._thread.start()

    def add(self, guid: bytes, endpoint: Endpoint) -> None:
        """Announce an endpoint of ours."""
        with self._lock:
            self._own[guid] = endpoint
            self._announce()

    def remove(self, guid: bytes) -> None:
        """Announce that an endpoint is gone."""
        with self._lock:
            if self._own.pop(guid, None) is not None:
                self._announce()

    def topics(self) -> list[TopicInfo]:
        """Return the topics of others, in order of their names."""
        found: dict[tuple[str, str], tuple[list[Qos], list[Qos]]] = {}
        with self._lock:
            for endpoint in self._endpoints.values():
                name = ros_topic(endpoint.topic)
                if name is not None:
                    ends = found.setdefault((name, ros_type(endpoint.type_name)), ([], []))
                    ends[endpoint.kind == "reader"].append(endpoint.qos)
        return [TopicInfo(*names, *map(tuple, ends)) for names, ends in sorted(found.items())]

    def close(self) -> None:
        """Withdraw the announcement and end the thread."""
        with self._lock:
            self._own.clear()
            self._announce()
            with ENTITIES:
                self._writer = None
        self._open = False
        self._guard.set(True)
        self._thread.join(_CLOSE_S)

    def _follow(self) -> None:
        try:
            with ENTITIES:
                readers = [BuiltinDataReader(self._participant, kind) for kind in _DISCOVERED]
                waitset = wait_set(self._participant, self._guard, readers)
            while self._open:
                self._take_participants(readers[0])
                self._take_endpoints(readers[1], "writer")
                self._take_endpoints(readers[2], "reader")
                self._learn()
                waitset.wait(duration(infinite=True))
        except (DDSException, Refused):
            if self._open:
                _log.exception("the ROS graph is not followed any more")

    def _take_participants(self, reader: Any) -> None:
        for sample, alive in _samples(reader):
            with self._lock:
                if not alive:
                    self._participants.pop(sample.key.bytes, None)
                    continue
                qos = sample.qos
                name = qos[Policy.EntityName].name if Policy.EntityName in qos else ""
                self._participants[sample.key.bytes] = _user_data(qos), name

    def _take_endpoints(self, reader: Any, kind: Kind) -> None:
        for sample, alive in _samples(reader):
            if not alive:
                with self._lock:
                    self._endpoints.pop(sample.key.bytes, None)
                continue
            participant, data, qos = sample.participant_key.bytes, _user_data(sample.qos), _qos_of(sample.qos)
            if participant == self._key:
                continue
            endpoint = Endpoint(kind, participant, sample.topic_name, sample.type_name, data, qos)
            with self._lock:
                self._endpoints[sample.key.bytes] = endpoint

    def _learn(self) -> None:
        """Find out which layout the others speak; announce in it."""
        with self._lock:
            heard = {
                b"typehash=" in endpoint.user_data
                for endpoint in self._endpoints.values()
                if endpoint.topic.startswith((TOPIC_PREFIX + "/", DISCOVERY_TOPIC))
                and self._is_ros(endpoint.participant)
            }
            if self.layout is None and heard:
                # In company of both, that without hashes: what is wrong there breaks the tools of everybody.
                self._speak(DEFAULT_DISTRO if min(heard) else _WITHOUT_HASH)
            spoken = DISTROS[self.layout].shows_type_hash if self.layout else True
            for stranger in sorted(heard - {spoken}):
                if stranger not in self._warned:
                    self._warned.add(stranger)
                    _log.warning(
                        "nodes of ROS %s are here too: they cannot see this node's name, announced as in %s",
                        "Iron or later" if stranger else _WITHOUT_HASH.capitalize(),
                        self.layout,
                    )

    def _is_ros(self, participant: bytes) -> bool:
        user_data, name = self._participants.get(participant, (b"", ""))
        return b"enclave=" in user_data and name != PARTICIPANT_NAME

    def _speak(self, distro: str) -> None:
        """Make the writer of announcements, and announce."""
        qos = DdsQos(
            Policy.DataRepresentation(use_cdrv0_representation=True),
            Policy.Reliability.Reliable(0),
            Policy.Durability.TransientLocal,
            Policy.History.KeepLast(1),
            Policy.WriterDataLifecycle(autodispose=False),
        )
        if DISTROS[distro].shows_type_hash:
            qos = DdsQos(Policy.Userdata(user_data_of_type(DISCOVERY_TYPE, distro)), base=qos)
        with ENTITIES:
            topic = Topic(self._participant, DISCOVERY_TOPIC, idl_struct(DISCOVERY_TYPE, distro))
            self._writer = DataWriter(self._participant, topic, qos)
        self.layout = distro
        self._announce()

    def _announce(self) -> None:
        if self._writer is None or self.layout is None:
            return
        store = typestore(self.layout)
        info, node, gid = (
            store.types[f"rmw_dds_common/msg/{name}"]
            for name in ("ParticipantEntitiesInfo", "NodeEntitiesInfo", "Gid")
        )
        gid_bytes = DISTROS[self.layout].gid_bytes

        def as_gid(guid: bytes) -> Any:
            return gid(data=np.frombuffer(guid.ljust(gid_bytes, b"\0"), dtype=np.uint8))

        def gids(kind: Kind) -> list[Any]:
            return [as_gid(guid) for guid, endpoint in self._own.items() if endpoint.kind == kind]

        name, namespace = self._node
        readers, writers = gids("reader"), gids("writer")
        own = node(node_namespace=namespace, node_name=name, reader_gid_seq=readers, writer_gid_seq=writers)
        message = info(gid=as_gid(self._key), node_entities_info_seq=[own])
        write(self._writer, store.serialize_cdr(message, DISCOVERY_TYPE))


def _samples(reader: Any) -> Iterator[tuple[Any, bool]]:
    """Take what is new in discovery; whether it is there or gone."""
    while True:
        with ENTITIES:
            samples = reader.take(_BATCH)
        if not samples:
            return
        for sample in samples:
            info = sample.sample_info
            yield sample, info.valid_data and info.instance_state == InstanceState.Alive


def _qos_of(found: DdsQos) -> Qos:
    reliable = Policy.Reliability in found and found[Policy.Reliability] != Policy.Reliability.BestEffort
    lasting = Policy.Durability in found and found[Policy.Durability] != Policy.Durability.Volatile
    return Qos(
        reliability="reliable" if reliable else "best_effort",
        durability="transient_local" if lasting else "volatile",
    )


def _user_data(qos: DdsQos) -> bytes:
    return bytes(qos[Policy.Userdata].data) if Policy.Userdata in qos else b""
