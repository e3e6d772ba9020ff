"""As much of `rclpy` as the bridge uses, in memory; with the names, parameters and errors of Humble to Jazzy.

Nodes of the same domain reach each other. Messages are carried as they are serialised.
"""

from __future__ import annotations

import contextlib
import enum
import inspect
import sys
import threading
import types
from collections import deque
from collections.abc import Callable
from typing import Any

import pytest


class InvalidHandle(Exception):
    """Something destroyed was used."""


class ExternalShutdownException(Exception):
    """The context was shut down."""


class HistoryPolicy(enum.IntEnum):
    SYSTEM_DEFAULT = 0
    KEEP_LAST = 1
    KEEP_ALL = 2
    UNKNOWN = 3


class ReliabilityPolicy(enum.IntEnum):
    SYSTEM_DEFAULT = 0
    RELIABLE = 1
    BEST_EFFORT = 2
    UNKNOWN = 3


class DurabilityPolicy(enum.IntEnum):
    SYSTEM_DEFAULT = 0
    TRANSIENT_LOCAL = 1
    VOLATILE = 2
    UNKNOWN = 3


class EventCallbacks:
    def __init__(self, *, use_default_callbacks: bool = True) -> None:
        assert not use_default_callbacks, "the fake has no events"


class SignalHandlerOptions(enum.IntEnum):
    NO = 0
    SIGINT = 1
    SIGTERM = 2
    ALL = 3


class QoSProfile:
    def __init__(self, **kwargs: Any) -> None:
        assert set(kwargs) <= {
            "history",
            "depth",
            "reliability",
            "durability",
            "lifespan",
            "deadline",
            "liveliness",
        }
        if "history" not in kwargs and "depth" not in kwargs:
            raise TypeError("History and/or depth settings are required.")
        self.history = HistoryPolicy(kwargs["history"])
        self.depth = kwargs["depth"]
        self.reliability = ReliabilityPolicy(kwargs["reliability"])
        self.durability = DurabilityPolicy(kwargs["durability"])


class String:
    """std_msgs/msg/String."""

    def __init__(self, data: str = "") -> None:
        self.data = data


class Trigger:
    """std_srvs/srv/Trigger."""

    class Request:
        """Nothing."""

    class Response:
        """Fields that check what is assigned, as those of ROS do."""

        def __init__(self) -> None:
            self._success = False
            self._message = ""

        @property
        def success(self) -> bool:
            return self._success

        @success.setter
        def success(self, value: bool) -> None:
            assert isinstance(value, bool), "The 'success' field must be of type 'bool'"
            self._success = value

        @property
        def message(self) -> str:
            return self._message

        @message.setter
        def message(self, value: str) -> None:
            assert isinstance(value, str), "The 'message' field must be of type 'str'"
            self._message = value


NAMES = {String: "std_msgs/msg/String"}
WORLD: dict[int, list[Node]] = {}
"""Nodes by domain."""


class Context:
    def __init__(self) -> None:
        self.domain: int | None = None
        self.args: list[str] | None = None
        self._ok = False
        self.wake = threading.Condition()
        self.nodes: list[Node] = []

    def init(
        self, args: list[str] | None = None, *, initialize_logging: bool = True, domain_id: int | None = None
    ) -> None:
        if self.domain is not None:
            raise RuntimeError("Context.init() must only be called once")
        self.args = sys.argv if args is None else args
        self.domain, self._ok = domain_id if domain_id is not None else 0, True

    def ok(self) -> bool:
        return self._ok

    def shutdown(self) -> None:
        if self.domain is None:
            raise RuntimeError("Context must be initialized before it can be shutdown")
        with self.wake:
            self._ok = False
            self.wake.notify_all()

    def try_shutdown(self) -> None:
        if self._ok:
            self.shutdown()


def init(
    *,
    args: list[str] | None = None,
    context: Context | None = None,
    domain_id: int | None = None,
    signal_handler_options: SignalHandlerOptions | None = None,
) -> None:
    assert context is not None, "the fake has no default context"
    assert signal_handler_options is SignalHandlerOptions.NO
    context.init(args, domain_id=domain_id)


class Publisher:
    def __init__(self, node: Node, msg_type: type, topic: str, qos_profile: QoSProfile) -> None:
        self.node, self.msg_type, self.topic, self.qos_profile = node, msg_type, topic, qos_profile
        self.destroyed = False
        self.kept: deque[bytes] = deque(maxlen=qos_profile.depth)

    def publish(self, msg: Any) -> None:
        if self.destroyed:
            raise InvalidHandle("cannot use Destroyable because destruction was requested")
        if not isinstance(msg, (self.msg_type, bytes)):
            raise TypeError(f"Expected {self.msg_type}, got {type(msg)}")
        assert isinstance(msg, bytes), "the fake does not serialise"
        self.kept.append(msg)
        for subscription in self._matching():
            subscription.push(msg)

    def get_subscription_count(self) -> int:
        if self.destroyed:
            raise InvalidHandle("cannot use Destroyable because destruction was requested")
        return len(self._matching())

    def _matching(self) -> list[Subscription]:
        return [one for node in self.node.world for one in node.subs if one.topic == self.topic]


class Subscription:
    def __init__(
        self, node: Node, msg_type: type, topic: str, callback: Callable[..., Any], qos: QoSProfile, raw: bool
    ) -> None:
        try:
            inspect.signature(callback).bind(object())
        except TypeError:
            raise RuntimeError(
                "Subscription.__init__(): callback should be either be callable with one argument"
            ) from None
        assert raw, "the fake does not deserialise"
        self.node, self.msg_type, self.topic, self.callback = node, msg_type, topic, callback
        self.qos_profile = qos
        self.waiting: deque[bytes] = deque(maxlen=qos.depth)
        self.handle = Taker(self)

    destroyed = False

    def push(self, msg: bytes) -> None:
        with self.node.context.wake:
            self.waiting.append(msg)
            self.node.context.wake.notify_all()


class Taker(contextlib.nullcontext[None]):
    """What a subscription takes its messages from; nothing destroys it within a `with`."""

    def __init__(self, subscription: Subscription) -> None:
        super().__init__()
        self.subscription = subscription

    def take_message(self, msg_type: type, raw: bool) -> tuple[bytes, dict[str, int]] | None:
        """Return the oldest message that waits, and what is known about it."""
        assert raw, "the fake does not deserialise"
        assert msg_type is self.subscription.msg_type
        with self.subscription.node.context.wake:
            return (self.subscription.waiting.popleft(), {}) if self.subscription.waiting else None


class Service:
    def __init__(
        self, node: Node, srv_type: type, srv_name: str, callback: Callable[..., Any], callback_group: Any
    ) -> None:
        self.node, self.srv_type, self.srv_name, self.callback = node, srv_type, srv_name, callback
        self.callback_group = callback_group
        self.waiting: deque[tuple[Any, Callable[[Any], None]]] = deque()
        self.destroyed = False


def _info(end: Publisher | Subscription) -> Any:
    """As TopicEndpointInfo."""
    return types.SimpleNamespace(
        node_name=end.node.get_name(),
        node_namespace=end.node.get_namespace(),
        topic_type=NAMES[end.msg_type],
        qos_profile=end.qos_profile,
    )


class Node:
    def __init__(self, node_name: str, context: Context, namespace: str | None) -> None:
        if not context.ok():
            raise RuntimeError("context is not valid")
        self.name, self.namespace, self.context = node_name, namespace, context
        self.pubs: list[Publisher] = []
        self.subs: list[Subscription] = []
        self.services: list[Service] = []
        assert context.domain is not None
        self.world = WORLD.setdefault(context.domain, [])
        self.world.append(self)

    def create_publisher(
        self,
        msg_type: type,
        topic: str,
        qos_profile: QoSProfile,
        *,
        callback_group: Any = None,
        event_callbacks: Any = None,
        qos_overriding_options: Any = None,
        publisher_class: type = Publisher,
    ) -> Publisher:
        assert isinstance(qos_profile, QoSProfile)
        self.pubs.append(Publisher(self, msg_type, topic, qos_profile))
        return self.pubs[-1]

    def create_subscription(
        self,
        msg_type: type,
        topic: str,
        callback: Callable[..., Any],
        qos_profile: QoSProfile,
        *,
        callback_group: Any = None,
        event_callbacks: Any = None,
        qos_overriding_options: Any = None,
        raw: bool = False,
    ) -> Subscription:
        assert isinstance(qos_profile, QoSProfile)
        subscription = Subscription(self, msg_type, topic, callback, qos_profile, raw)
        self.subs.append(subscription)
        if qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL:
            for node in self.world:
                for publisher in node.pubs:
                    if (
                        publisher.topic == topic
                        and publisher.qos_profile.durability == qos_profile.durability
                    ):
                        for msg in publisher.kept:
                            subscription.push(msg)
        return subscription

    def create_service(
        self,
        srv_type: type,
        srv_name: str,
        callback: Callable[..., Any],
        *,
        qos_profile: Any = None,
        callback_group: Any = None,
    ) -> Service:
        self.services.append(Service(self, srv_type, srv_name, callback, callback_group))
        return self.services[-1]

    def destroy_publisher(self, publisher: Publisher) -> bool:
        publisher.destroyed = True
        self.pubs.remove(publisher)
        return True

    def destroy_subscription(self, subscription: Subscription) -> bool:
        return self._destroy(self.subs, subscription)

    def destroy_service(self, service: Service) -> bool:
        return self._destroy(self.services, service)

    def _destroy(self, among: list[Any], one: Any) -> bool:
        if one not in among:
            return False
        with self.context.wake:
            among.remove(one)
            one.destroyed = True
            self.context.wake.notify_all()
        return True

    def count_publishers(self, topic_name: str) -> int:
        return sum(one.topic == topic_name for node in self.world for one in node.pubs)

    def count_subscribers(self, topic_name: str) -> int:
        return sum(one.topic == topic_name for node in self.world for one in node.subs)

    def get_name(self) -> str:
        return self.name

    def get_namespace(self) -> str:
        return self.namespace or "/"

    def get_publishers_info_by_topic(self, topic_name: str, no_mangle: bool = False) -> list[Any]:
        return [_info(one) for node in self.world for one in node.pubs if one.topic == topic_name]

    def get_subscriptions_info_by_topic(self, topic_name: str, no_mangle: bool = False) -> list[Any]:
        return [_info(one) for node in self.world for one in node.subs if one.topic == topic_name]

    def get_topic_names_and_types(self, no_demangle: bool = False) -> list[tuple[str, list[str]]]:
        found: dict[str, set[str]] = {}
        for node in self.world:
            for one in (*node.pubs, *node.subs):
                found.setdefault(one.topic, set()).add(NAMES[one.msg_type])
        return [(topic, sorted(kinds)) for topic, kinds in found.items()]

    def destroy_node(self) -> None:
        for publisher in list(self.pubs):
            self.destroy_publisher(publisher)
        self.subs.clear()
        self.services.clear()
        self.world.remove(self)

    def call(self, srv_name: str) -> Any:
        """Ask a service, as a client in another thread does; not a method of rclpy."""
        service = next(one for node in self.world for one in node.services if one.srv_name == srv_name)
        done: list[Any] = []
        answered = threading.Event()
        with service.node.context.wake:
            service.waiting.append(
                (service.srv_type.Request(), lambda response: (done.append(response), answered.set()))
            )
            service.node.context.wake.notify_all()
        assert answered.wait(60.0)
        return done[0]


def create_node(
    node_name: str,
    *,
    context: Context | None = None,
    cli_args: list[str] | None = None,
    namespace: str | None = None,
    use_global_arguments: bool = True,
    enable_rosout: bool = True,
    start_parameter_services: bool = True,
    parameter_overrides: Any = None,
    allow_undeclared_parameters: bool = False,
    automatically_declare_parameters_from_overrides: bool = False,
) -> Node:
    assert context is not None, "the fake has no default context"
    return Node(node_name, context, namespace)


class SingleThreadedExecutor:
    """Waits for tasks, subscriptions and services of its nodes, as that of Humble does.

    What is destroyed by another thread while it waits ends `spin_once` with `InvalidHandle`, and the executor
    is of no more use.
    """

    def __init__(self, *, context: Context | None = None) -> None:
        assert context is not None, "the fake has no default context"
        self._context = context
        self._nodes: list[Node] = []
        self._tasks: deque[Callable[[], object]] = deque()
        self._is_shutdown = False
        self.broken = False

    def add_node(self, node: Node) -> bool:
        self._nodes.append(node)
        return True

    def create_task(self, callback: Callable[[], object]) -> None:
        with self._context.wake:
            assert not self._is_shutdown
            self._tasks.append(callback)
            self._context.wake.notify_all()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Run one callback; what it raises ends the call."""
        with self._context.wake:
            if self.broken:
                self._context.wake.wait()  # deaf
            waited_for = [one for node in self._nodes for one in (*node.subs, *node.services)]
            while (job := self._job()) is None:
                if not self._context.ok():
                    raise ExternalShutdownException()
                self._context.wake.wait()
                if any(one.destroyed for one in waited_for):
                    self.broken = True
                    raise InvalidHandle("cannot use Destroyable because destruction was requested")
        job()

    def _job(self) -> Callable[[], object] | None:
        if self._tasks:
            return self._tasks.popleft()
        for node in self._nodes:
            for subscription in node.subs:
                if subscription.waiting:
                    message = subscription.waiting.popleft()
                    return lambda s=subscription, m=message: s.callback(m)
            for service in node.services:
                if service.waiting:
                    request, answer = service.waiting.popleft()
                    return lambda s=service, r=request, a=answer: a(s.callback(r, s.srv_type.Response()))
        return None

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        with self._context.wake:
            self._is_shutdown = True
            return True


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this be imported as rclpy, with a few messages."""
    WORLD.clear()
    modules: dict[str, dict[str, Any]] = {
        "rclpy": {"init": init, "create_node": create_node},
        "rclpy.context": {"Context": Context},
        "rclpy.executors": {
            "SingleThreadedExecutor": SingleThreadedExecutor,
            "ExternalShutdownException": ExternalShutdownException,
        },
        "rclpy.qos": {
            "QoSProfile": QoSProfile,
            "HistoryPolicy": HistoryPolicy,
            "ReliabilityPolicy": ReliabilityPolicy,
            "DurabilityPolicy": DurabilityPolicy,
        },
        "rclpy.event_handler": {
            "PublisherEventCallbacks": EventCallbacks,
            "SubscriptionEventCallbacks": EventCallbacks,
        },
        "rclpy.signals": {"SignalHandlerOptions": SignalHandlerOptions},
        "std_msgs": {},
        "std_msgs.msg": {"String": String},
        "std_srvs": {},
        "std_srvs.srv": {"Trigger": Trigger},
    }
    for name, content in modules.items():
        module = types.ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
