"""A backend without a network: it keeps what is published, and tests put in what ROS would send."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.backend.base import BackendError, Buffer, Qos, Serve, TopicInfo
from cortex_ros2_bridge.msgs import message_class
from cortex_ros2_bridge.typestore import service_types


class RecordedPublisher:
    def __init__(self, topic: str, type_name: str, qos: Qos, on_close: Callable[[], None]) -> None:
        self.topic, self.type_name, self.qos = topic, type_name, qos
        self.subscriber_count = 0
        self.sent: list[bytes] = []
        self.error: str | None = None
        self.closed = False
        self._on_close = on_close

    def publish(self, message: Buffer) -> None:
        assert not self.closed
        if self.error is not None:
            raise BackendError(self.error)
        self.sent.append(bytes(message))

    def messages(self) -> list:
        return [cdr.decode(data, self.type_name) for data in list(self.sent)]

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self._on_close()


class RecordedSubscription:
    def __init__(
        self, type_name: str, qos: Qos, callback: Callable[[bytes], None], on_close: Callable
    ) -> None:
        self.type_name, self.qos, self._callback, self._on_close = type_name, qos, callback, on_close
        self.publisher_count = 0
        self.lost_count = 0
        self.closed = False

    def put(self, message: object) -> None:
        """Let a message of ROS arrive: an object, or bytes as they are."""
        assert not self.closed
        self._callback(message if isinstance(message, bytes) else bytes(cdr.encode(message)))

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self._on_close()


class RecordedService:
    def __init__(self, type_name: str, callback: Serve, on_close: Callable[[], None]) -> None:
        self.type_name, self._callback, self._on_close = type_name, callback, on_close

    def call(self, **fields: Any) -> Any:
        """Ask it, as a client would; returns the response."""
        request, response = (message_class(name) for name in service_types(self.type_name))
        return self._callback(request(**fields), response())

    def close(self) -> None:
        self._on_close()


class RecordingBackend:
    """Attributes hold what is open, by ROS topic."""

    name = "recording"
    distro = "jazzy"
    failure = ""

    def __init__(self) -> None:
        self.publishers: dict[str, RecordedPublisher] = {}
        self.subscriptions: dict[str, RecordedSubscription] = {}
        self.services: dict[str, RecordedService] = {}
        self.closed_publishers: list[RecordedPublisher] = []
        self.refuse: dict[str, Exception] = {}
        """What opening a topic raises."""
        self.others: list[TopicInfo] = []
        """What others have."""
        self._lock = threading.Lock()

    def publisher(self, topic: str, type_name: str, qos: Qos) -> RecordedPublisher:
        if topic in self.refuse:
            raise self.refuse[topic]
        with self._lock:
            assert topic not in self.publishers, f"{topic} is published twice"
            made = self.publishers[topic] = RecordedPublisher(
                topic, type_name, qos, lambda: self._shut(topic)
            )
        return made

    def subscription(
        self, topic: str, type_name: str, qos: Qos, callback: Callable[[bytes], None]
    ) -> RecordedSubscription:
        if topic in self.refuse:
            raise self.refuse[topic]
        assert topic not in self.subscriptions, f"{topic} is subscribed to twice"
        made = RecordedSubscription(type_name, qos, callback, lambda: self.subscriptions.pop(topic))
        self.subscriptions[topic] = made
        return made

    def service(self, name: str, type_name: str, callback: Serve) -> RecordedService | None:
        made = RecordedService(type_name, callback, lambda: self.services.pop(name, None))
        self.services[name] = made
        return made

    def topics(self) -> list[TopicInfo]:
        return list(self.others)

    def close(self) -> None:
        pass

    @contextlib.contextmanager
    def listening(self, *topics: str) -> Iterator[list[RecordedPublisher]]:
        """Somebody in ROS subscribes to topics for the time of the block."""
        found = [self.publishers[topic] for topic in topics]
        for publisher in found:
            publisher.subscriber_count += 1
        try:
            yield found
        finally:
            for publisher in found:
                publisher.subscriber_count -= 1

    def _shut(self, topic: str) -> None:
        with self._lock:
            self.closed_publishers.append(self.publishers.pop(topic))
