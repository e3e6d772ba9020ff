"""The interface of a ROS 2 backend: publishers and subscriptions of serialised messages (CDR)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, Protocol

Buffer = bytes | bytearray | memoryview
"""A message in CDR: little endian, with its header of four bytes."""


@dataclass(frozen=True, kw_only=True)
class Qos:
    """Quality of service, as far as the bridge uses it."""

    reliability: Literal["reliable", "best_effort"] = "reliable"
    durability: Literal["volatile", "transient_local"] = "volatile"
    depth: int = 10
    """Messages kept for a subscriber that is not ready [>= 1]."""

    def __post_init__(self) -> None:
        if self.depth < 1:
            raise ValueError(f"depth must be >= 1, got {self.depth}")

    def seen(self) -> Qos:
        """Return what discovery tells of it: all but the depth."""
        return replace(self, depth=Qos.depth)


class TopicInfo(NamedTuple):
    """A topic that other nodes have."""

    topic: str
    """Such as "/drone/imu"."""
    type_name: str
    """Such as "sensor_msgs/msg/Imu"."""
    publishers: tuple[Qos, ...] = ()
    """As discovery tells it of each one, see `Qos.seen`."""
    subscribers: tuple[Qos, ...] = ()


Serve = Callable[[Any, Any], Any]
"""Answers a request: takes the request and an empty response, fills the response in, and returns it."""


class RosPublisher(Protocol):
    """Publishes on one topic."""

    @property
    def subscriber_count(self) -> int:
        """Subscriptions that match now."""

    def publish(self, message: Buffer) -> None:
        """Send a message; never waits for subscribers, and keeps no reference to it.

        Raises:
            BackendError: It could not be sent: it is not a message of this type, or the publisher is closed.
        """

    def close(self) -> None:
        """Withdraw the publisher."""


class RosSubscription(Protocol):
    """Receives from one topic."""

    @property
    def publisher_count(self) -> int:
        """Publishers that match now."""

    @property
    def lost_count(self) -> int:
        """Messages that the middleware says were lost; it does not notice all that were.

        What a newer one has overtaken is not counted.
        """

    def close(self) -> None:
        """Withdraw the subscription; its callback is not called any more once this returns.

        May be called from the callback, which then is the last call.
        """


class RosService(Protocol):
    """Answers the requests to one service; one with which the callback raises with an empty response."""

    def close(self) -> None:
        """Withdraw the service."""


class Backend(Protocol):
    """One participant of a ROS 2 graph: a node.

    All functions may be called from any thread. Those that take a type raise `ValueError` where it is
    unknown, or the name is not valid.
    """

    name: str
    """Such as "dds"; shown to the user."""
    distro: str
    """Distribution whose message definitions are spoken, such as "jazzy"."""

    @property
    def failure(self) -> str:
        """Why nothing is received any more, for good; empty while all is well."""

    def publisher(self, topic: str, type_name: str, qos: Qos) -> RosPublisher:
        """Publish on a topic."""

    def subscription(
        self, topic: str, type_name: str, qos: Qos, callback: Callable[[bytes], None]
    ) -> RosSubscription:
        """Subscribe to a topic; the callback is called with every message, on a thread of the backend.

        At most `qos.depth` messages wait for a callback that is busy; newer ones push out the oldest.
        """

    def service(self, name: str, type_name: str, callback: Serve) -> RosService:
        """Answer requests to a service such as of type "std_srvs/srv/Trigger", on a thread of the backend."""

    def topics(self) -> list[TopicInfo]:
        """Return what is seen on the other side now, in order of names; own endpoints do not count."""

    def close(self) -> None:
        """Leave the graph, with all publishers, subscriptions and services; harmless if done before."""


class BackendError(RuntimeError):
    """ROS 2 cannot be reached, or refused a message."""


def check_message(message: Buffer, topic: str) -> None:
    """Raise `BackendError` unless a message is little-endian CDR."""
    if len(message) <= 4 or bytes(message[:2]) != b"\0\1":
        raise BackendError(f"a message for {topic} is not little-endian CDR")
