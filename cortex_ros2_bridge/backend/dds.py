"""ROS 2 over DDS, without a ROS installation: nodes on the network see an ordinary node.

Messages are written and read as they are serialised (cyclone.py). Types come from message definitions
(idl.py). graph.py follows and tells who is there.
"""

from __future__ import annotations

import logging
import os
import threading
import time
import weakref
from collections.abc import Callable
from typing import Any, TypeVar

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
_Kind = TypeVar("_Kind", bound="_Part")

_made: dict[int, weakref.ref[Any]] = {}
_made_lock = threading.Lock()


def _domain(number: int, config: str) -> Any:
    """Return a domain of this process, with our configuration; it ends with its last user.

    None, if another library of this process has it already.
    """
    with _made_lock:
        domain = _made[number]() if number in _made else None
        if domain is None:
            try:
                domain = Domain(number, config)
            except DDSException as error:
                if error.code == DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:
                    return None
                uri = os.environ.get("CYCLONEDDS_URI")
                raise BackendError(
                    f"DDS domain {number} cannot be joined: {error} (CYCLONEDDS_URI is {uri!r})"
                ) from error
            _made[number] = weakref.ref(domain)
        return domain


class DdsBackend:
    """A node of ROS 2 that speaks DDS itself."""

    name = "dds"
    failure = ""

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
        number = domain_id(domain)
        self._lock = threading.Lock()
        self._parts: dict[_Part, None] = {}
        self._domain = _domain(number, cyclone_config(known))
        try:
            with ENTITIES:
                self.participant: Any = DomainParticipant(
                    number, DdsQos(Policy.Userdata(ENCLAVE), Policy.EntityName(PARTICIPANT_NAME))
                )
            self.graph = Graph(self.participant, node_name=node_name, namespace=namespace, distro=known)
        except (DDSException, Refused) as error:
            raise BackendError(f"DDS does not start in domain {number}: {error}") from error

    def publisher(self, topic: str, type_name: str, qos: Qos) -> DdsPublisher:
        """Publish on a topic."""
        check_name(topic)
        return self._keep(lambda: DdsPublisher(self, topic, type_name, qos))

    def subscription(
        self, topic: str, type_name: str, qos: Qos, callback: Callable[[bytes], None]
    ) -> DdsSubscription:
        """Subscribe to a topic."""
        check_name(topic)
        return self._keep(lambda: DdsSubscription(self, topic, type_name, qos, callback))

    def service(self, name: str, type_name: str, callback: Serve) -> DdsService:
        """Answer requests of nodes that use Cyclone DDS too; services of other implementations differ."""
        check_name(name)
        return self._keep(lambda: DdsService(self, name, type_name, callback))

    def topics(self) -> list[TopicInfo]:
        """Return what others have."""
        return self.graph.topics()

    def close(self) -> None:
        """Leave the domain."""
        with self._lock:
            if self.participant is None:
                return
            parts, self._parts = list(self._parts), {}
            self.participant = None
        for part in parts:
            part.close()
        self.graph.close()
        self._domain = None

    def forget(self, part: _Part) -> None:
        """Take note that a part is closed."""
        with self._lock:
            self._parts.pop(part, None)

    def _keep(self, make: Callable[[], _Kind]) -> _Kind:
        with self._lock:
            if self.participant is None:
                raise BackendError("this node is closed")
            part = make()
            self._parts[part] = None
            return part


class _Part:
    """A publisher, a subscription or a service: entities of DDS, until it is closed."""

    _writer: Any = None
    _reader: Any = None
    _receiver: _Receiver | None = None

    def __init__(self, backend: DdsBackend) -> None:
        self._backend = backend

    def close(self) -> None:
        """Withdraw it; no callback is called any more once this returns."""
        guids = [entity.guid.bytes for entity in (self._writer, self._reader) if entity is not None]
        if not guids:
            return
        if self._receiver is not None:
            self._receiver.close()
        for guid in guids:
            self._backend.graph.remove(guid)
        with ENTITIES:
            self._writer = self._reader = None
        self._backend.forget(self)

    def _make(self, role: Kind, topic: str, kind: Any, qos: Qos, user_data: bytes) -> Any:
        """Make a writer or a reader, and announce it."""
        participant = self._backend.participant
        type_name = kind.__idl_typename__.replace(".", "::")
        own = Endpoint(role, participant.guid.bytes, topic, type_name, user_data, qos)
        make = DataWriter if role == "writer" else DataReader
        try:
            with ENTITIES:
                entity = make(participant, Topic(participant, topic, kind), _dds_qos(qos, user_data))
            self._backend.graph.add(entity.guid.bytes, own)
        except (DDSException, Refused) as error:
            raise BackendError(f"the {role} of {topic} cannot be made: {error}") from error
        return entity

    def _make_of_topic(self, role: Kind, topic: str, type_name: str, qos: Qos) -> Any:
        distro = self._backend.distro
        kind, user_data = idl_struct(type_name, distro), user_data_of_type(type_name, distro)
        return self._make(role, TOPIC_PREFIX + topic, kind, qos, user_data)


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


class DdsPublisher(_Part):
    """Publishes on one topic."""

    def __init__(self, backend: DdsBackend, topic: str, type_name: str, qos: Qos) -> None:
        super().__init__(backend)
        self._name = f"{topic} ({type_name})"
        self._writer = self._make_of_topic("writer", topic, type_name, qos)

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


class _Receiver:
    """Takes what comes to a reader, on its own thread: a slow callback holds up its own topic only."""

    def __init__(self, participant: Any, reader: Any, limit: int, deliver: Delivery, name: str) -> None:
        self._deliver = deliver
        self._closed = threading.Event()
        with ENTITIES:
            self._guard = GuardCondition(participant)
        self._thread = threading.Thread(
            target=self._run, args=(participant, reader, limit, name), name=f"ros {name}", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """End; waits for a call that is under way."""
        self._closed.set()
        self._guard.set(True)
        self._deliver.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(_CLOSE_S)

    def _run(self, participant: Any, reader: Any, limit: int, name: str) -> None:
        try:
            with ENTITIES:
                waitset = wait_set(participant, self._guard, [reader])
            while not self._closed.is_set():
                waitset.wait(duration(infinite=True))
                for message in take(reader, limit):
                    self._deliver(message)
        except (DDSException, Refused):
            if not self._closed.is_set():
                _log.exception("%s is not received any more", name)


class DdsSubscription(_Part):
    """Receives from one topic."""

    def __init__(
        self, backend: DdsBackend, topic: str, type_name: str, qos: Qos, callback: Callable[[bytes], None]
    ) -> None:
        super().__init__(backend)
        self._lost_count = 0
        self._reader = self._make_of_topic("reader", topic, type_name, qos)
        deliver = Delivery(callback, topic)
        self._receiver = _Receiver(backend.participant, self._reader, qos.depth, deliver, topic)

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
        self._lost_count = self.lost_count
        super().close()


class DdsService(_Part):
    """Answers the requests to one service, as `rmw_cyclonedds_cpp` asks them.

    Requests and replies are topics; before the fields go the client's number and that of its request.
    """

    def __init__(self, backend: DdsBackend, name: str, type_name: str, callback: Serve) -> None:
        super().__init__(backend)
        self._callback = callback
        self._request_type, self._response_type = service_types(type_name)
        identity = ".".join(f"{byte:x}" for byte in os.urandom(16))
        user_data = f"serviceid={identity};".encode() + NO_TYPE_HASH
        qos = Qos(depth=10)
        header = {"guid": types.uint64, "seq": types.int64}
        request = idl_struct(self._request_type, backend.distro, header)
        reply = idl_struct(self._response_type, backend.distro, header)
        self._writer = self._make("writer", f"{REPLY_PREFIX}{name}Reply", reply, qos, user_data)
        self._reader = self._make("reader", f"{REQUEST_PREFIX}{name}Request", request, qos, user_data)
        deliver = Delivery(self._answer, name)
        self._receiver = _Receiver(backend.participant, self._reader, qos.depth, deliver, name)

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
