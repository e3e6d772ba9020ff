"""ROS 2 through a ROS installation: `rclpy` carries messages that are serialised already."""

from __future__ import annotations

import importlib
import logging
import threading
from collections.abc import Callable
from typing import Any, TypeVar

from cortex_ros2_bridge.backend.base import BackendError, Buffer, Qos, TopicInfo, Trigger
from cortex_ros2_bridge.backend.delivery import Delivery
from cortex_ros2_bridge.backend.environment import chosen_distro
from cortex_ros2_bridge.backend.names import check_name, check_node_name, split_type
from cortex_ros2_bridge.typestore import DEFAULT_DISTRO

_log = logging.getLogger(__name__)

_CLOSE_S = 5.0
_Part = TypeVar("_Part")


class RclpyBackend:
    """A node of `rclpy`, in a context and with an executor of its own."""

    name = "rclpy"

    def __init__(
        self, *, node_name: str = "cortex_bridge", namespace: str = "", domain: int | None = None
    ) -> None:
        """Start a node.

        Args:
            node_name: Name of the node.
            namespace: Its namespace; "" or "/" for none.
            domain: DDS domain; None: ROS_DOMAIN_ID, else 0.

        Raises:
            ValueError: A name is not valid.
            BackendError: rclpy does not start.
        """
        import rclpy
        from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
        from rclpy.context import Context
        from rclpy.executors import MultiThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        node_name, namespace = check_node_name(node_name, namespace)
        self.distro = chosen_distro() or DEFAULT_DISTRO
        self._lock = threading.Lock()
        self._parts: dict[Any, None] = {}
        self._closed = False
        self._context = Context()
        try:
            rclpy.init(
                args=[],
                context=self._context,
                domain_id=domain,
                signal_handler_options=SignalHandlerOptions.NO,
            )
            self._node: Any = rclpy.create_node(
                node_name, context=self._context, namespace=namespace, use_global_arguments=False
            )
            # One thread for subscriptions, one for services, which take their time.
            self._executor: Any = MultiThreadedExecutor(2, context=self._context)
            self._service_group: Any = MutuallyExclusiveCallbackGroup()
            self._executor.add_node(self._node)
        except Exception as error:  # rclpy has many, of modules without public names
            raise BackendError(f"rclpy does not start: {error}") from error
        self._thread = threading.Thread(target=self._spin, name="ros-executor", daemon=True)
        self._thread.start()

    def publisher(self, topic: str, type_name: str, qos: Qos) -> RclpyPublisher:
        """Publish on a topic."""
        check_name(topic)
        kind = _interface(type_name)
        with self._lock:
            node = self._here()
            return self._keep(RclpyPublisher(self, node.create_publisher(kind, topic, _profile(qos)), topic))

    def subscription(
        self, topic: str, type_name: str, qos: Qos, callback: Callable[[bytes], None]
    ) -> RclpySubscription:
        """Subscribe to a topic; all subscriptions share a thread."""
        check_name(topic)
        kind = _interface(type_name)
        deliver = Delivery(callback, topic)
        with self._lock:
            handle = self._here().create_subscription(kind, topic, deliver, _profile(qos), raw=True)
            return self._keep(RclpySubscription(self, handle, topic, deliver))

    def service(self, name: str, callback: Callable[[], Trigger]) -> RclpyService:
        """Answer requests to a service; all services share a thread."""
        check_name(name)
        kind = _interface("std_srvs/srv/Trigger")
        with self._lock:
            return self._keep(RclpyService(self, self._here(), kind, name, callback, self._service_group))

    def topics(self) -> list[TopicInfo]:
        """Return what others have."""
        with self._lock:
            if self._closed:
                return []
            node, parts = self._node, list(self._parts)
        found = []
        for topic, types in node.get_topic_names_and_types():
            own = [sum(isinstance(part, kind) and part.topic == topic for part in parts) for kind in _ENDS]
            others = node.count_publishers(topic) - own[0], node.count_subscribers(topic) - own[1]
            if others > (0, 0):
                found += [TopicInfo(topic, type_name, *others) for type_name in types]
        return sorted(found)

    def close(self) -> None:
        """End the node."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            parts, self._parts = list(self._parts), {}
        for part in parts:
            part.close()
        self._executor.shutdown(timeout_sec=_CLOSE_S)
        pool = getattr(self._executor, "_executor", None)
        if pool is not None:  # rclpy leaves the threads of its executor behind
            pool.shutdown(wait=False)
        self._thread.join(_CLOSE_S)
        self._node.destroy_node()
        self._context.try_shutdown()

    def destroy(self, part: Any, destroy: Callable[[Any], object], handle: Any) -> None:
        """Take a part out of the node."""
        destroy(handle)
        with self._lock:
            self._parts.pop(part, None)

    @property
    def node(self) -> Any:
        """The node of rclpy."""
        return self._node

    def _spin(self) -> None:
        from rclpy.executors import ExternalShutdownException

        try:
            self._executor.spin()
        except ExternalShutdownException:
            if not self._closed:
                _log.error("the context of rclpy was shut down from outside: nothing is received any more")
        except Exception:  # else the thread would end without a word
            _log.exception("the executor of rclpy failed: nothing is received any more")

    def _here(self) -> Any:
        if self._closed:
            raise BackendError("this node is closed")
        return self._node

    def _keep(self, part: _Part) -> _Part:
        self._parts[part] = None
        return part


class RclpyPublisher:
    """Publishes on one topic."""

    def __init__(self, backend: RclpyBackend, handle: Any, topic: str) -> None:
        self.topic = topic
        self._backend = backend
        self._handle = handle

    @property
    def subscriber_count(self) -> int:
        """Subscriptions that match now."""
        handle = self._handle
        return 0 if handle is None else int(handle.get_subscription_count())

    def publish(self, message: Buffer) -> None:
        """Send a message."""
        handle = self._handle
        if handle is None:
            raise BackendError(f"the publisher of {self.topic} is closed")
        if len(message) <= 4 or bytes(message[:2]) != b"\0\1":
            raise BackendError(f"a message for {self.topic} is not little-endian CDR")
        try:
            handle.publish(message if isinstance(message, bytes) else bytes(message))
        except Exception as error:  # errors of rclpy have no public base
            raise BackendError(f"a message for {self.topic} cannot be sent: {error}") from error

    def close(self) -> None:
        """Withdraw the publisher."""
        handle, self._handle = self._handle, None
        if handle is not None:
            self._backend.destroy(self, self._backend.node.destroy_publisher, handle)


class RclpySubscription:
    """Receives from one topic."""

    lost_count = 0
    """rclpy does not tell."""

    def __init__(self, backend: RclpyBackend, handle: Any, topic: str, deliver: Delivery) -> None:
        self.topic = topic
        self._backend = backend
        self._handle = handle
        self._deliver = deliver

    @property
    def publisher_count(self) -> int:
        """Publishers of the topic now, the own included."""
        return 0 if self._handle is None else int(self._backend.node.count_publishers(self.topic))

    @property
    def error_count(self) -> int:
        """Messages with which the callback raised."""
        return self._deliver.error_count

    def close(self) -> None:
        """Withdraw the subscription."""
        self._deliver.close()
        handle, self._handle = self._handle, None
        if handle is not None:
            self._backend.destroy(self, self._backend.node.destroy_subscription, handle)


class RclpyService:
    """Answers the requests to one service."""

    def __init__(
        self,
        backend: RclpyBackend,
        node: Any,
        kind: Any,
        name: str,
        callback: Callable[[], Trigger],
        group: Any,
    ) -> None:
        self.topic = None
        self._backend = backend
        self._callback = callback
        self._name = name
        self._error_count = 0
        self._handle = node.create_service(kind, name, self._answer, callback_group=group)

    @property
    def error_count(self) -> int:
        """Requests with which the callback raised."""
        return self._error_count

    def close(self) -> None:
        """Withdraw the service."""
        handle, self._handle = self._handle, None
        if handle is not None:
            self._backend.destroy(self, self._backend.node.destroy_service, handle)

    def _answer(self, request: Any, response: Any) -> Any:
        try:
            response.success, response.message = self._callback()
        except Exception as error:  # whatever it raises: the client is told, and the node goes on
            self._error_count += 1
            _log.exception("the service %s failed", self._name)
            response.success, response.message = False, f"{type(error).__name__}: {error}"
        return response


_ENDS = (RclpyPublisher, RclpySubscription)


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


def _profile(qos: Qos) -> Any:
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=qos.depth,
        reliability=ReliabilityPolicy[qos.reliability.upper()],
        durability=DurabilityPolicy[qos.durability.upper()],
    )
