"""ROS 2 through a ROS installation: `rclpy` carries messages that are serialised already."""

from __future__ import annotations

import concurrent.futures
import importlib
import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, TypeVar

from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.backend.base import BackendError, Buffer, Qos, Serve, TopicInfo, check_message
from cortex_ros2_bridge.backend.delivery import Delivery
from cortex_ros2_bridge.backend.environment import chosen_distro
from cortex_ros2_bridge.backend.names import check_name, check_node_name, split_type
from cortex_ros2_bridge.msgs import message_class
from cortex_ros2_bridge.typestore import DEFAULT_DISTRO, service_types

_log = logging.getLogger(__name__)

_CLOSE_S = 3.0
"""Longest wait for a thread that was told to end [s]."""
_CALL_S = 10.0
"""Longest wait for an executor to make or destroy something [s]."""
_TAKE_COUNT_MAX = 32
"""So many messages of a topic are taken before others have their turn."""
_SERVICES = "_services"
"""Added to the node's name for the node of its services; `ros2 node list` hides names with a leading "_"."""
_Result = TypeVar("_Result")


class _Loop:
    """A node, and the thread that waits for its messages and requests.

    It does what a `SingleThreadedExecutor` does, but for timers and coroutines, and keeps its wait set. The
    executors of Humble and Jazzy make one for each message, and two more to see that there is nothing else:
    up to 0.5 ms, in which what comes waits.

    Everything that it waits for is made and destroyed on its thread, between two waits: a handle that another
    thread destroys would end it. One that fails nevertheless is not used any more.

    Attributes:
        node: The node of rclpy.
        endpoints: What is open.
        failure: Why it is dead for good; empty while it lives.
    """

    def __init__(self, context: Any, name: str, namespace: str) -> None:
        import rclpy

        self.failure = ""
        self._context = context
        self._jobs: deque[Callable[[], None]] = deque()
        self.endpoints: dict[_Endpoint, None] = {}
        self._closed = False
        self._wait_set: Any = None
        options = {"use_global_arguments": False, "start_parameter_services": False}
        self.node: Any = rclpy.create_node(name, context=context, namespace=namespace, **options)
        self._guard = self.node.create_guard_condition(lambda: None)
        context.on_shutdown(self._wake)
        self._thread = threading.Thread(target=self._run, name=f"executor {name}", daemon=True)
        self._thread.start()

    def call(self, function: Callable[[], _Result]) -> _Result:
        """Call a function on the executor's thread; returns its result, or raises its error.

        Raises:
            BackendError: The executor is dead, or too busy.
        """
        if threading.current_thread() is self._thread:
            return function()
        if self.failure:
            raise BackendError(self.failure)
        future: concurrent.futures.Future[_Result] = concurrent.futures.Future()

        def job() -> None:
            try:
                future.set_result(function())
            except Exception as error:  # it belongs to the caller
                future.set_exception(error)

        self.defer(job)
        try:
            return future.result(_CALL_S)
        except concurrent.futures.TimeoutError:
            raise BackendError(
                self.failure or f"the executor of rclpy has been busy for {_CALL_S} s"
            ) from None

    def defer(self, job: Callable[[], None]) -> None:
        """Have a function called on the executor's thread, after the callbacks that run now."""
        self._jobs.append(job)
        self._wake()

    def _wake(self) -> None:
        if not self._closed:
            self._guard.trigger()

    def add(self, endpoint: _Endpoint) -> None:
        """Make the handle of an endpoint."""

        def make() -> None:
            endpoint.handle = endpoint.make(self.node)
            self.endpoints[endpoint] = self._wait_set = None

        self.call(make)

    def remove(self, endpoint: _Endpoint) -> None:
        """Destroy the handle of an endpoint, after the callbacks that run now."""
        handle, endpoint.handle = endpoint.handle, None

        def destroy() -> None:
            self._wait_set = None
            try:
                getattr(self.node, endpoint.destroyer)(handle)
            except Exception:  # errors of rclpy have no public base; the others go on
                _log.exception("what rclpy has for %s is not destroyed", endpoint.topic)
            self.endpoints.pop(endpoint, None)  # until here discovery tells of it

        self.defer(destroy)

    def close(self) -> None:
        """End the thread, and then the node with all that it has."""
        self._closed = True
        if self._thread.is_alive():
            self._guard.trigger()
            if threading.current_thread() is not self._thread:
                self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            _log.error("a callback still runs %g s after the end: its node is left as it is", _CLOSE_S)
            return
        for endpoint in self.endpoints:
            endpoint.handle = None
        self._wait_set = None
        self.node.destroy_node()

    def _run(self) -> None:
        while not self._closed and not self.failure:
            reason = ""
            try:
                self._spin_once()
            except Exception as error:  # whatever rclpy raises: the node must not go deaf unnoticed
                reason = f"the executor of rclpy has failed: {type(error).__name__}: {error}"
            if not self._context.ok():
                reason = "the context of rclpy was shut down from outside"
            if reason and not self._closed:
                self.failure = reason
                _log.error("%s: nothing is received any more", reason)

    def _spin_once(self) -> None:
        """Wait, and see to all that has come: messages, requests, jobs."""
        from rclpy.impl.implementation_singleton import rclpy_implementation

        subscriptions, services = list(self.node.subscriptions), list(self.node.services)
        if self._wait_set is None:
            sizes = len(subscriptions), 1, 0, 0, len(services), 0
            self._wait_set = rclpy_implementation.WaitSet(*sizes, self._context.handle)
        waits = self._wait_set
        waits.clear_entities()
        waits.add_guard_condition(self._guard.handle)
        for subscription in subscriptions:
            waits.add_subscription(subscription.handle)
        for service in services:
            waits.add_service(service.handle)
        waits.wait(-1)
        for index, subscription in enumerate(subscriptions):
            if waits.is_ready("subscription", index):
                self._take(subscription)
        for index, service in enumerate(services):
            if waits.is_ready("service", index):
                request, header = service.handle.service_take_request(service.srv_type.Request)
                if header is not None:
                    service.send_response(service.callback(request, service.srv_type.Response()), header)
        while self._jobs:
            self._jobs.popleft()()

    def _take(self, subscription: Any) -> None:
        for _ in range(_TAKE_COUNT_MAX):
            taken = subscription.handle.take_message(subscription.msg_type, True)
            if taken is None:
                return
            subscription.callback(taken[0])


class RclpyBackend:
    """A node of `rclpy`, in a context and with executors of its own."""

    name = "rclpy"

    def __init__(
        self, *, node_name: str = "cortex_bridge", namespace: str = "", domain: int | None = None
    ) -> None:
        """Start a node; see `choose.open_backend`."""
        import rclpy
        from rclpy.context import Context
        from rclpy.signals import SignalHandlerOptions

        name, namespace = check_node_name(node_name, namespace)
        self.distro = chosen_distro() or DEFAULT_DISTRO
        self._closed = False
        self._context = Context()
        try:
            options = {"domain_id": domain, "signal_handler_options": SignalHandlerOptions.NO}
            rclpy.init(args=[], context=self._context, **options)
            self._loop = _Loop(self._context, name, namespace)
            self._service_loop = _Loop(self._context, f"_{name}{_SERVICES}", namespace)
        except Exception as error:  # rclpy has many, of modules without public names
            self._context.try_shutdown()  # ends what has begun
            raise BackendError(f"rclpy does not start: {error}") from error

    @property
    def failure(self) -> str:
        """Why nothing is received any more, for good; empty while all is well."""
        return self._loop.failure or self._service_loop.failure

    def publisher(self, topic: str, type_name: str, qos: Qos) -> RclpyPublisher:
        """Publish on a topic."""
        return RclpyPublisher(self._here(), topic, type_name, qos)

    def subscription(
        self, topic: str, type_name: str, qos: Qos, callback: Callable[[bytes], None]
    ) -> RclpySubscription:
        """Subscribe to a topic; all subscriptions share a thread."""
        return RclpySubscription(self._here(), topic, type_name, qos, callback)

    def service(self, name: str, type_name: str, callback: Serve) -> RclpyService:
        """Answer requests to a service; all services share a node and a thread of their own."""
        self._here()
        return RclpyService(self._service_loop, name, type_name, callback)

    def topics(self) -> list[TopicInfo]:
        """Return what others have."""
        if self._closed or self._loop.failure:
            return []
        node, parts = self._loop.node, list(self._loop.endpoints)
        me = node.get_name(), node.get_namespace()
        found: dict[tuple[str, str], tuple[list[Qos], list[Qos]]] = {}
        for topic, _ in node.get_topic_names_and_types():
            for end, kind in enumerate(_ENDS):
                own = [part.seen_qos for part in parts if isinstance(part, kind) and part.topic == topic]
                for each in getattr(node, kind.lister)(topic):
                    qos = _qos_of(each)
                    if (each.node_name, each.node_namespace) == me and qos in own:
                        own.remove(qos)  # more of our name are of another bridge
                    else:
                        found.setdefault((topic, each.topic_type), ([], []))[end].append(qos)
        return [TopicInfo(*names, *map(tuple, ends)) for names, ends in sorted(found.items())]

    def close(self) -> None:
        """End the node."""
        if not self._closed:
            self._closed = True
            self._loop.close()
            self._service_loop.close()
            self._context.try_shutdown()

    def _here(self) -> _Loop:
        if self._closed:
            raise BackendError("this node is closed")
        return self._loop


class _Endpoint:
    """A publisher, a subscription or a service.

    Attributes:
        topic: Its topic, or the name of the service.
        seen_qos: As discovery tells it.
        handle: What rclpy has for it; None once it is closed.
    """

    lister = ""
    """What the node lists those of a topic with."""
    destroyer = ""
    """What the node destroys a handle with."""

    def __init__(self, loop: _Loop, topic: str, type_name: str, qos: Qos) -> None:
        self.topic = check_name(topic)
        self.seen_qos = qos.seen()
        self.handle: Any = None
        self._loop = loop
        self._kind, self._profile = _interface(type_name), _profile(qos)
        loop.add(self)

    def make(self, node: Any) -> Any:
        """Return a handle of a node."""
        raise NotImplementedError

    def close(self) -> None:
        """Withdraw it."""
        if self.handle is not None:
            self._loop.remove(self)


class RclpyPublisher(_Endpoint):
    """Publishes on one topic."""

    lister = "get_publishers_info_by_topic"
    destroyer = "destroy_publisher"

    def make(self, node: Any) -> Any:
        """Return a handle of a node."""
        quiet = _no_events("PublisherEventCallbacks")
        return node.create_publisher(self._kind, self.topic, self._profile, event_callbacks=quiet)

    @property
    def subscriber_count(self) -> int:
        """Subscriptions that match now."""
        handle = self.handle
        return 0 if handle is None else int(handle.get_subscription_count())

    def publish(self, message: Buffer) -> None:
        """Send a message."""
        handle = self.handle
        if handle is None:
            raise BackendError(f"the publisher of {self.topic} is closed")
        check_message(message, self.topic)
        try:
            handle.publish(message if isinstance(message, bytes) else bytes(message))
        except Exception as error:  # errors of rclpy have no public base
            raise BackendError(f"a message for {self.topic} cannot be sent: {error}") from error


class RclpySubscription(_Endpoint):
    """Receives from one topic."""

    lister = "get_subscriptions_info_by_topic"
    destroyer = "destroy_subscription"
    lost_count = 0
    """rclpy does not tell."""

    def __init__(
        self, loop: _Loop, topic: str, type_name: str, qos: Qos, callback: Callable[[bytes], None]
    ) -> None:
        self.deliver = Delivery(callback, topic)
        super().__init__(loop, topic, type_name, qos)

    def make(self, node: Any) -> Any:
        """Return a handle of a node."""
        arguments = {"raw": True, "event_callbacks": _no_events("SubscriptionEventCallbacks")}
        return node.create_subscription(self._kind, self.topic, self.deliver, self._profile, **arguments)

    @property
    def publisher_count(self) -> int:
        """Publishers of the topic now, the own included."""
        return 0 if self.handle is None else int(self._loop.node.count_publishers(self.topic))

    def close(self) -> None:
        """Withdraw the subscription."""
        self.deliver.close()
        super().close()


class RclpyService(_Endpoint):
    """Answers the requests to one service."""

    destroyer = "destroy_service"

    def __init__(self, loop: _Loop, name: str, type_name: str, callback: Serve) -> None:
        self._callback = callback
        self._types = service_types(type_name)
        self._busy = threading.RLock()
        super().__init__(loop, name, type_name, Qos())

    def make(self, node: Any) -> Any:
        """Return a handle of a node."""
        return node.create_service(self._kind, self.topic, self.answer)

    def answer(self, request: Any, response: Any) -> Any:
        """Answer a request; an empty response where the callback raises, or once the service is closed."""
        from rclpy.serialization import deserialize_message, serialize_message

        with self._busy:
            try:
                if self.handle is None:
                    return response
                asked = cdr.decode(serialize_message(request), self._types[0])
                answer = self._callback(asked, message_class(self._types[1])())
                return deserialize_message(bytes(cdr.encode(answer)), type(response))
            except Exception:  # whatever it raises: the client gets an answer, and the node goes on
                _log.exception("the service %s failed", self.topic)
                return type(response)()

    def close(self) -> None:
        """Withdraw the service; waits for an answer that another thread is giving."""
        super().close()
        if self._busy.acquire(timeout=_CLOSE_S):
            self._busy.release()


_ENDS: tuple[type[_Endpoint], ...] = (RclpyPublisher, RclpySubscription)


def _interface(type_name: str) -> Any:
    """Return the class of a message or service.

    Raises:
        ValueError: It is not in the ROS installation.
    """
    package, kind, name = split_type(type_name)
    try:
        return getattr(importlib.import_module(f"{package}.{kind}"), name)
    except (ImportError, AttributeError):
        raise ValueError(
            f"unknown ROS type {type_name!r}: the package {package} of this ROS installation has none, or is "
            f"not installed (apt install ros-$ROS_DISTRO-{package.replace('_', '-')})"
        ) from None


def _no_events(kind: str) -> Any:
    """Return callbacks for no events: for each, whether it comes or not, every wait takes 5 us longer."""
    try:
        module = importlib.import_module("rclpy.event_handler")
    except ImportError:  # Humble
        module = importlib.import_module("rclpy.qos_event")
    return getattr(module, kind)(use_default_callbacks=False)


def _qos_of(endpoint: Any) -> Qos:
    found = endpoint.qos_profile
    return Qos(reliability=found.reliability.name.lower(), durability=found.durability.name.lower())


def _profile(qos: Qos) -> Any:
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=qos.depth,
        reliability=ReliabilityPolicy[qos.reliability.upper()],
        durability=DurabilityPolicy[qos.durability.upper()],
    )
