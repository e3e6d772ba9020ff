"""ROS 2 over DDS, without a ROS installation: nodes on the network see an ordinary node.

Messages are written and read as they are serialised (cyclone.py). Types come from message definitions
(idl.py). graph.py follows and tells who is there.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from cyclonedds.core import DDSException, GuardCondition
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy
from cyclonedds.qos import Qos as DdsQos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.backend.base import BackendError, Buffer, Qos, Serve, TopicInfo
from cortex_ros2_bridge.backend.cyclone import ENTITIES, NO_TYPE_HASH, Refused, take, wait_set, write
from cortex_ros2_bridge.backend.delivery import Delivery
from cortex_ros2_bridge.backend.environment import chosen_distro, cyclone_config, domain_id
from cortex_ros2_bridge.backend.graph import (
    ENCLAVE,
    PARTICIPANT_NAME,
    Endpoint,
    Graph,
    Kind,
    user_data_of_type,
)
from cortex_ros2_bridge.backend.idl import idl_struct, types
from cortex_ros2_bridge.backend.names import (
    REPLY_PREFIX,
    REQUEST_PREFIX,
    TOPIC_PREFIX,
    check_name,
    check_node_name,
)
from cortex_ros2_bridge.msgs import message_class
from cortex_ros2_bridge.typestore import DEFAULT_DISTRO, service_types

_log = logging.getLogger(__name__)

_CLOSE_S = 5.0
"""Longest wait for a thread that was told to end."""
_CLIENT_S = 0.1
"""Longest wait for a client whose request was faster than the discovery of its ear for the reply."""
_CLIENT_BYTES = 16

_Part = TypeVar("_Part")


class _Domains:
    """Domains of this process, with our configuration; each ends with its last user."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._domains: dict[int, Any] = {}
        self._users: dict[int, int] = {}

    def enter(self, number: int, config: str) -> None:
        with self._lock:
            if number not in self._domains:
                try:
                    self._domains[number] = Domain(number, config)
                except DDSException as error:
                    if error.code != DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:
                        raise BackendError(
                            f"DDS domain {number} cannot be joined: {error} "
                            f"(CYCLONEDDS_URI is {os.environ.get('CYCLONEDDS_URI')!r})"
                        ) from error
                    self._domains[number] = None  # another library of this process is there already
            self._users[number] = self._users.get(number, 0) + 1

    def leave(self, number: int) -> None:
        with self._lock:
            self._users[number] -= 1
            if not self._users[number]:
                del self._users[number], self._domains[number]


_domains = _Domains()


class DdsBackend:
    """A node of ROS 2 that speaks DDS itself."""

    name = "dds"
    failure = trouble = ""

    def __init__(
        self,
        *,
        node_name: str = "cortex_bridge",
        namespace: str = "",
        distro: str | None = None,
        domain: int | None = None,
    ) -> None:
        """Join a domain; see `choose.open_backend`. Without a distribution, that of the first node counts."""
        node_name, namespace = check_node_name(node_name, namespace)
        known = chosen_distro(distro)
        self.distro = known or DEFAULT_DISTRO
        self._domain = domain_id(domain)
        self._lock = threading.Lock()
        self._parts: dict[Any, None] = {}
        _domains.enter(self._domain, cyclone_config(known))
        try:
            with ENTITIES:
                self._participant: Any = DomainParticipant(
                    self._domain, DdsQos(Policy.Userdata(ENCLAVE), Policy.EntityName(PARTICIPANT_NAME))
                )
            self._graph = Graph(self._participant, node_name=node_name, namespace=namespace, distro=known)
        except (DDSException, Refused) as error:
            self._participant = None
            _domains.leave(self._domain)
            raise BackendError(f"DDS does not start in domain {self._domain}: {error}") from error

    @property
    def layout(self) -> str | None:
        """Distribution as which the node is announced; None as long as it is not, because nobody is there."""
        return self._graph.layout

    def publisher(self, topic: str, type_name: str, qos: Qos) -> DdsPublisher:
        """Publish on a topic."""
        check_name(topic)
        with self._lock:
            return self._keep(DdsPublisher(self._site(), topic, type_name, qos))

    def subscription(
        self, topic: str, type_name: str, qos: Qos, callback: Callable[[bytes], None]
    ) -> DdsSubscription:
        """Subscribe to a topic."""
        check_name(topic)
        with self._lock:
            return self._keep(DdsSubscription(self._site(), topic, type_name, qos, callback))

    def service(self, name: str, type_name: str, callback: Serve) -> DdsService:
        """Answer requests of nodes that use Cyclone DDS too; services of other implementations differ."""
        check_name(name)
        with self._lock:
            return self._keep(DdsService(self._site(), name, type_name, callback))

    def topics(self) -> list[TopicInfo]:
        """Return what others have."""
        return self._graph.topics()

    def close(self) -> None:
        """Leave the domain."""
        with self._lock:
            if self._participant is None:
                return
            parts, self._parts = list(self._parts), {}
            self._participant = None
        for part in parts:
            part.close()
        self._graph.close()
        _domains.leave(self._domain)

    def _site(self) -> _Site:
        if self._participant is None:
            raise BackendError("this node is closed")
        return _Site(self._participant, self._graph, self.distro, self._forget)

    def _keep(self, part: _Part) -> _Part:
        self._parts[part] = None
        return part

    def _forget(self, part: Any) -> None:
        with self._lock:
            self._parts.pop(part, None)


class _Site(NamedTuple):
    """Where publishers and subscriptions are made."""

    participant: Any
    graph: Graph
    distro: str
    forget: Callable[[Any], None]

    def writer(self, topic: str, kind: Any, qos: Qos, user_data: bytes) -> Any:
        return self._announced("writer", DataWriter, topic, kind, qos, user_data)

    def reader(self, topic: str, kind: Any, qos: Qos, user_data: bytes) -> Any:
        return self._announced("reader", DataReader, topic, kind, qos, user_data)

    def _announced(
        self, role: Kind, make: Callable[..., Any], topic: str, kind: Any, qos: Qos, user_data: bytes
    ) -> Any:
        own = Endpoint(
            role,
            self.participant.guid.bytes,
            topic,
            kind.__idl_typename__.replace(".", "::"),
            user_data,
            qos,
        )
        try:
            with ENTITIES:
                entity = make(
                    self.participant, Topic(self.participant, topic, kind), _dds_qos(qos, user_data)
                )
            self.graph.add(entity.guid.bytes, own)
        except (DDSException, Refused) as error:
            raise BackendError(f"the {role} of {topic} cannot be made: {error}") from error
        return entity


def _dds_qos(qos: Qos, user_data: bytes) -> DdsQos:
    history = Policy.History.KeepLast(qos.depth)
    return DdsQos(
        Policy.DataRepresentation(use_cdrv0_representation=True),
        # Writes do not wait: newer messages push out what a subscriber has not acknowledged.
        Policy.Reliability.Reliable(0) if qos.reliability == "reliable" else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal
        if qos.durability == "transient_local"
        else Policy.Durability.Volatile,
        Policy.DurabilityService(0, history, -1, -1, -1),
        history,
        Policy.WriterDataLifecycle(autodispose=False),
        Policy.Userdata(user_data),
    )


class DdsPublisher:
    """Publishes on one topic."""

    def __init__(self, site: _Site, topic: str, type_name: str, qos: Qos) -> None:
        self._site = site
        self._name = f"{topic} ({type_name})"
        kind = idl_struct(type_name, site.distro)
        self._writer = site.writer(TOPIC_PREFIX + topic, kind, qos, user_data_of_type(type_name, site.distro))
        self._guid = self._writer.guid.bytes

    @property
    def subscriber_count(self) -> int:
        """Subscriptions that match now."""
        writer = self._writer
        return 0 if writer is None else int(writer.get_publication_matched_status().current_count)

    def publish(self, message: Buffer) -> None:
        """Send a message."""
        writer = self._writer
        if writer is None:
            raise BackendError(f"the publisher of {self._name} is closed")
        try:
            write(writer, message)
        except Refused as error:
            raise BackendError(f"a message for {self._name} cannot be sent: {error}") from error

    def close(self) -> None:
        """Withdraw the publisher."""
        if self._writer is not None:
            self._site.graph.remove(self._guid)
            with ENTITIES:
                self._writer = None
            self._site.forget(self)


class _Receiver:
    """Takes what comes to a reader, on its own thread: a slow callback holds up its own topic only."""

    def __init__(self, site: _Site, reader: Any, limit: int, deliver: Delivery, name: str) -> None:
        self._deliver = deliver
        self._closed = threading.Event()
        with ENTITIES:
            self._guard = GuardCondition(site.participant)
        self._thread = threading.Thread(
            target=self._run, args=(site, reader, limit, name), name=f"ros {name}", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """End; waits for a call that is under way."""
        self._closed.set()
        self._guard.set(True)
        self._deliver.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(_CLOSE_S)

    def _run(self, site: _Site, reader: Any, limit: int, name: str) -> None:
        try:
            with ENTITIES:
                waitset = wait_set(site.participant, self._guard, [reader])
            while not self._closed.is_set():
                waitset.wait(duration(infinite=True))
                for message in take(reader, limit):
                    self._deliver(message)
        except (DDSException, Refused):
            if not self._closed.is_set():
                _log.exception("%s is not received any more", name)


class DdsSubscription:
    """Receives from one topic."""

    def __init__(
        self, site: _Site, topic: str, type_name: str, qos: Qos, callback: Callable[[bytes], None]
    ) -> None:
        self._site = site
        kind = idl_struct(type_name, site.distro)
        self._reader = site.reader(TOPIC_PREFIX + topic, kind, qos, user_data_of_type(type_name, site.distro))
        self._guid = self._reader.guid.bytes
        self._lost_count = 0
        self._deliver = Delivery(callback, topic)
        self._receiver = _Receiver(site, self._reader, qos.depth, self._deliver, topic)

    @property
    def publisher_count(self) -> int:
        """Publishers that match now."""
        reader = self._reader
        return 0 if reader is None else int(reader.get_subscription_matched_status().current_count)

    @property
    def lost_count(self) -> int:
        """Messages that Cyclone DDS says were lost; it seldom does."""
        reader = self._reader
        if reader is not None:
            self._lost_count = int(reader.get_sample_lost_status().total_count)
        return self._lost_count

    def close(self) -> None:
        """Withdraw the subscription."""
        if self._reader is not None:
            self._lost_count = self.lost_count
            self._receiver.close()
            self._site.graph.remove(self._guid)
            with ENTITIES:
                self._reader = None
            self._site.forget(self)


class DdsService:
    """Answers the requests to one service, as `rmw_cyclonedds_cpp` asks them.

    Requests and replies are topics; before the fields go the client's number and that of its request.
    """

    def __init__(self, site: _Site, name: str, type_name: str, callback: Serve) -> None:
        self._site = site
        self._callback = callback
        self._request_type, self._response_type = service_types(type_name)
        self._name = name
        identity = ".".join(f"{byte:x}" for byte in os.urandom(16))
        user_data = f"serviceid={identity};".encode() + NO_TYPE_HASH
        qos = Qos(depth=10)
        header = {"guid": types.uint64, "seq": types.int64}
        request = idl_struct(self._request_type, site.distro, header)
        reply = idl_struct(self._response_type, site.distro, header)
        self._writer = site.writer(f"{REPLY_PREFIX}{name}Reply", reply, qos, user_data)
        self._reader = site.reader(f"{REQUEST_PREFIX}{name}Request", request, qos, user_data)
        self._guids = self._writer.guid.bytes, self._reader.guid.bytes
        self._deliver = Delivery(self._answer, name)
        self._receiver = _Receiver(site, self._reader, qos.depth, self._deliver, name)

    def close(self) -> None:
        """Withdraw the service."""
        if self._reader is not None:
            self._receiver.close()
            for guid in self._guids:
                self._site.graph.remove(guid)
            with ENTITIES:
                self._reader = self._writer = None
            self._site.forget(self)

    def _answer(self, data: bytes) -> None:
        client = data[4 : 4 + _CLIENT_BYTES]
        response = message_class(self._response_type)()
        try:
            request = cdr.decode(data[:4] + data[4 + _CLIENT_BYTES :], self._request_type)
            response = self._callback(request, response)
        except Exception:
            self._reply(client, message_class(self._response_type)())
            raise
        self._reply(client, response)

    def _reply(self, client: bytes, response: Any) -> None:
        message = bytes(cdr.encode(response))
        # A client that has just appeared hears us a moment later than we hear it.
        deadline_s = time.monotonic() + _CLIENT_S
        writer, reader = self._writer, self._reader
        while (
            writer.get_publication_matched_status().current_count
            < reader.get_subscription_matched_status().current_count
            and time.monotonic() < deadline_s
        ):
            time.sleep(1e-3)
        write(writer, message[:4] + client + message[4:])
