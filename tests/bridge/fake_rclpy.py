"""As much of `rclpy` as the bridge uses, in memory; with the names, parameters and errors of Humble to Jazzy.

Nodes of the same domain reach each other. Messages are carried as they are serialised.
"""

from __future__ import annotations

import enum
import inspect
import sys
import threading
import types
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.msgs import message_class


class InvalidHandle(Exception):
    """Something destroyed was used."""


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


def serialize_message(message: Trigger.Request) -> bytes:
    return bytes(cdr.encode(message_class("std_srvs/srv/Trigger_Request")()))


def deserialize_message(data: bytes, kind: type[Trigger.Response]) -> Trigger.Response:
    made, record = kind(), cdr.decode(data, "std_srvs/srv/Trigger_Response")
    made.success, made.message = record.success, record.message
    return made


NAMES = {String: "std_msgs/msg/String"}
WORLD: dict[int, list[Node]] = {}
"""Nodes by domain."""


class Context:
    def __init__(self) -> None:
        self.domain: int | None = None
        self.args: list[str] | None = None
        self._ok = False
        self.wake = threading.Condition()
        self.handle = types.SimpleNamespace(context=self)
        self._callbacks: list[Callable[[], None]] = []

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
        self._ok = False
        for callback in self._callbacks:
            callback()

    def on_shutdown(self, callback: Callable[[], None]) -> None:
        self._callbacks.append(callback)

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
        self.handle = Handle(node.context, qos.depth)

    def push(self, msg: bytes) -> None:
        self.handle.push(msg)


class Handle:
    """What a wait set waits for, with what waits in it."""

    def __init__(self, context: Context, depth: int | None = None) -> None:
        self.is_destroyed = False
        self.waiting: deque[Any] = deque(maxlen=depth)
        self._context = context

    def push(self, item: Any) -> None:
        with self._context.wake:
            self.waiting.append(item)
            self._context.wake.notify_all()

    def destroy(self) -> None:
        with self._context.wake:
            self.is_destroyed = True
            self._context.wake.notify_all()

    def is_ready(self) -> bool:
        return bool(self.waiting)

    def take_message(self, msg_type: type, raw: bool) -> tuple[bytes, dict[str, int]] | None:
        """Return the oldest message that waits, and what is known about it."""
        assert raw, "the fake does not deserialise"
        with self._context.wake:
            return (self.waiting.popleft(), {}) if self.waiting else None

    def service_take_request(self, request_type: type) -> tuple[Any, Any]:
        """Return the oldest request that waits, and what its answer goes to."""
        with self._context.wake:
            return self.waiting.popleft() if self.waiting else (None, None)


class GuardCondition:
    def __init__(self, context: Context) -> None:
        self.handle = Handle(context, 1)

    def trigger(self) -> None:
        self.handle.push(True)


class Service:
    def __init__(
        self, node: Node, srv_type: type, srv_name: str, callback: Callable[..., Any], callback_group: Any
    ) -> None:
        self.node, self.srv_type, self.srv_name, self.callback = node, srv_type, srv_name, callback
        self.callback_group = callback_group
        self.handle = Handle(node.context)

    def send_response(self, response: Any, header: Callable[[Any], None]) -> None:
        assert isinstance(response, self.srv_type.Response)
        header(response)


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

    def create_guard_condition(
        self, callback: Callable[[], Any], callback_group: Any = None
    ) -> GuardCondition:
        return GuardCondition(self.context)

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        yield from self.subs

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
        among.remove(one)
        one.handle.destroy()
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
        service.handle.push(
            (service.srv_type.Request(), lambda response: (done.append(response), answered.set()))
        )
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


class WaitSet:
    """Waits for guard conditions, subscriptions and services, as that of Humble to Rolling does.

    What is destroyed by another thread while it waits ends `wait` with `InvalidHandle`.
    """

    def __init__(
        self,
        subscriptions: int,
        guards: int,
        timers: int,
        clients: int,
        services: int,
        events: int,
        context: Any,
    ) -> None:
        assert (timers, clients, events) == (0, 0, 0)
        self._sizes = {"subscription": subscriptions, "guard_condition": guards, "service": services}
        self._context = context.context
        self._handles: dict[str, list[Handle]] = {}
        self._ready: dict[str, list[bool]] = {}

    def clear_entities(self) -> None:
        self._handles = {kind: [] for kind in self._sizes}

    def add_subscription(self, handle: Handle) -> None:
        self._add("subscription", handle)

    def add_guard_condition(self, handle: Handle) -> None:
        self._add("guard_condition", handle)

    def add_service(self, handle: Handle) -> None:
        self._add("service", handle)

    def wait(self, timeout_ns: int) -> None:
        assert timeout_ns < 0
        handles = [handle for each in self._handles.values() for handle in each]
        with self._context.wake:
            while not any(handle.is_ready() for handle in handles):
                self._context.wake.wait()
                if any(handle.is_destroyed for handle in handles):
                    raise InvalidHandle("cannot use Destroyable because destruction was requested")
            self._ready = {
                kind: [handle.is_ready() for handle in each] for kind, each in self._handles.items()
            }
            for handle in self._handles["guard_condition"]:
                handle.waiting.clear()

    def is_ready(self, kind: str, index: int) -> bool:
        return self._ready[kind][index]

    def _add(self, kind: str, handle: Handle) -> None:
        assert not handle.is_destroyed
        assert len(self._handles[kind]) < self._sizes[kind], f"no room for another {kind}"
        self._handles[kind].append(handle)


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this be imported as rclpy, with a few messages."""
    WORLD.clear()
    modules: dict[str, dict[str, Any]] = {
        "rclpy": {"init": init, "create_node": create_node},
        "rclpy.context": {"Context": Context},
        "rclpy.impl": {},
        "rclpy.impl.implementation_singleton": {
            "rclpy_implementation": types.SimpleNamespace(WaitSet=WaitSet)
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
        "rclpy.serialization": {
            "serialize_message": serialize_message,
            "deserialize_message": deserialize_message,
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
