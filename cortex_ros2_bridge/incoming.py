"""ROS to Cortex: commands, checked before they fly anything, and requests to services."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import queue
import threading
import time
from collections.abc import Callable
from typing import Any

from cortex import Closed, Node, Publisher, ServiceFailed, ServiceTimeout, ServiceUnavailable, TypeMismatch
from cortex.messages import SimulatorReply
from cortex.service import Client
from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.backend.base import RosSubscription
from cortex_ros2_bridge.convert import Context, ConvertError
from cortex_ros2_bridge.outgoing import Whereabouts
from cortex_ros2_bridge.routes import CORTEX_TYPES, Route
from cortex_ros2_bridge.tally import Tally

logger = logging.getLogger(__name__)

Convert = Callable[[bytes, Context], Any]

PENDING_S = 1.0
"""How long a command waits for a simulator that is about to subscribe to it [s]."""
CALL_TIMEOUT_S = 30.0
"""How long a service may take to answer; `step` answers when the steps are over [s]."""
ENDS = "the bridge ends"
NOT_ACTIVE = "the bridge is not active"
SERVICES = {
    "std_msgs/msg/Empty": "std_srvs/srv/Trigger",
    "std_msgs/msg/UInt32": "std_srvs/srv/Trigger",
    "neurosim/msg/Reset": "neurosim/srv/Reset",
}
"""The service that stands beside a topic of requests, by the type of the topic."""


class Target:
    """One route from ROS to Cortex: the topic that a command may become one of, if it is meant for it."""

    def __init__(self, route: Route, publisher: Publisher[Any], convert: Convert, context: Context) -> None:
        self.route = route
        self.tally = Tally(str(route))
        self.context = context
        self.publisher = publisher
        self.convert = convert
        is_command = route.cortex_type.startswith("cortex/")
        stale_s = context.option("stale_s") if is_command else context.options.get("stale_s")
        self.stale_ns = None if stale_s is None else round(stale_s * 1e9)
        self.restamp = context.option("stamp") == "now"


class Incoming:
    """One ROS topic of commands; its messages go to the one target that they are meant for.

    Attributes:
        whereabouts: Of the vehicle that is commanded.
        subscription: To be set to what calls `take`.
        publisher_count: How many there are in ROS; as of the last look.
    """

    def __init__(self, whereabouts: Whereabouts, is_active: Callable[[], bool]) -> None:
        self._is_active = is_active
        self.whereabouts = whereabouts
        self.subscription: RosSubscription | None = None
        self.publisher_count = 0
        self._targets: tuple[Target, ...] = ()
        self._lock = threading.Lock()
        self._pending: tuple[Target, Any, float] | None = None
        self._told = 0

    def add(self, target: Target) -> None:
        """Add a target; there is more than one where the message says which (AttitudeTarget)."""
        with self._lock:
            self._targets = (*self._targets, target)

    def remove(self, target: Target) -> None:
        """Remove a target."""
        with self._lock:
            self._targets = tuple(other for other in self._targets if other is not target)
            if self._pending is not None and self._pending[0] is target:
                self._drop_pending("its route is closed")

    def look(self) -> bool:
        """See who in ROS publishes, and what was lost; send what waits. Returns whether somebody has come."""
        subscription = self.subscription
        if subscription is None:
            return False
        before, self.publisher_count = self.publisher_count, subscription.publisher_count
        lost = subscription.lost_count - self._told
        self._told += lost
        with self._lock:
            if lost and self._targets:
                self._targets[0].tally.count("received", count=lost)
                self._targets[0].tally.count("lost", "on the way through ROS", lost)
            self._send_pending()
        return self.publisher_count > before

    def take(self, data: bytes) -> None:
        """Take in a message of ROS, from any thread."""
        with self._lock:
            if not self._targets:
                return
            meant, reason = self._targets[0], "it commands nothing that Cortex has a topic for"
            is_active = self._is_active()
            for target in self._targets if is_active else ():
                try:
                    command = self._convert(target, data)
                except (ConvertError, cdr.CdrError) as error:
                    meant, reason = target, str(error)
                    break
                if command is not None:
                    self._deliver(target, command)
                    return
            meant.tally.count("received")
            meant.tally.count("refused", reason if is_active else NOT_ACTIVE)

    def close(self) -> None:
        """Withdraw the subscription."""
        if self.subscription is not None:
            self.subscription.close()

    def _convert(self, target: Target, data: bytes) -> Any:
        context = target.context
        context.now_ns = self.whereabouts.now_ns or 0
        context.odometry = self.whereabouts.odometry
        context.max_thrust_n = self.whereabouts.max_thrust_n
        context.ranges = self.whereabouts.ranges
        context.excess = ""
        return target.convert(data, context)

    def _deliver(self, target: Target, command: Any) -> None:
        """Send a command to where it belongs, or refuse it."""
        context = target.context
        target.tally.count("received")
        if context.excess:
            target.tally.count("clamped", context.excess)
        if target.restamp:
            command = dataclasses.replace(command, stamp_ns=context.now_ns)
        reason = _staleness(getattr(command, "stamp_ns", 0), self.whereabouts.now_ns, target.stale_ns)
        if reason:
            target.tally.count("refused", reason)
            return
        context.sequence += 1
        if target.publisher.subscriber_count:
            self._drop_pending("a newer one came")
            self._publish(target, command)
        else:
            self._drop_pending("a newer one came before anybody had subscribed to it")
            self._pending = target, command, time.monotonic() + PENDING_S

    def _publish(self, target: Target, command: Any) -> None:
        with contextlib.suppress(Closed):  # the bridge is about to end
            if target.publisher.publish(command):
                target.tally.count("sent")
            else:
                target.tally.count("lost", "a reliable subscriber in Cortex did not take it in in time")

    def _send_pending(self) -> None:
        """Send the command that waits for a subscriber; the lock is held."""
        if self._pending is None:
            return
        target, command, until_s = self._pending
        if target.publisher.subscriber_count:
            self._pending = None
            self._publish(target, command)
        elif time.monotonic() > until_s:
            self._drop_pending("nobody in Cortex subscribes to it")

    def _drop_pending(self, reason: str) -> None:
        if self._pending is not None:
            target, self._pending = self._pending[0], None
            target.tally.count("lost", reason)


class Caller:
    """Turns messages of ROS into requests to one Cortex service, one by one, on a thread of its own.

    The Cortex topic of its route is the name of the service.
    """

    def __init__(
        self, route: Route, node: Node, convert: Convert, context: Context, is_active: Callable[[], bool]
    ) -> None:
        self.route = route
        self.tally = Tally(str(route))
        self._is_active = is_active
        self._convert = convert
        self._context = context
        kind = CORTEX_TYPES[route.cortex_type]
        self._client = node.client(route.cortex_topic, kind, SimulatorReply)
        self._default = kind()
        self._requests: queue.Queue[Any] = queue.Queue(maxsize=4)
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=f"call {route.cortex_topic}", daemon=True)
        self._thread.start()

    def take(self, data: bytes) -> None:
        """Take in a message of ROS; its request waits for those before it."""
        self.tally.count("received")
        try:
            self._requests.put_nowait(self._convert(data, self._context))
        except queue.Full:
            self.tally.count("refused", "there are requests that have not been answered yet")
        except (ConvertError, cdr.CdrError) as error:
            self.tally.count("refused", str(error))

    def serve(self, request: Any, response: Any) -> Any:
        """Call the service for a request of ROS, of one of `SERVICES`; waits for the answer."""
        self.tally.count("received")
        try:
            begin = getattr(request, "begin", None)
            asked = self._default if begin is None else self._convert(bytes(cdr.encode(begin)), self._context)
            response.message = self._call(asked)
        except ConvertError as error:
            response.message = str(error)
            self.tally.count("refused", response.message)
        response.success = not response.message
        return response

    def close(self) -> None:
        """End the thread; a call that is under way is given up."""
        self._closed = True
        self._client.close()
        with contextlib.suppress(queue.Full):
            self._requests.put_nowait(None)
        self._thread.join(1.0)

    def _run(self) -> None:
        while (request := self._requests.get()) is not None and not self._closed:
            self._call(request)

    def _call(self, request: Any) -> str:
        """Call the service; returns why it did not do what was asked, empty if it did."""
        reason, was_answered = ask(self._client, request) if self._is_active() else (NOT_ACTIVE, True)
        if not reason:
            self.tally.count("sent")
        elif was_answered:
            self.tally.count("refused", reason)
        elif reason != ENDS:
            self.tally.count("lost", reason)
        return reason


def ask(client: Client[Any, SimulatorReply], request: Any) -> tuple[str, bool]:
    """Call a service; returns why it did not do what was asked, empty if it did, and whether it answered."""
    try:
        reply = client.call(request, timeout_s=CALL_TIMEOUT_S)
    except Closed:
        return ENDS, False
    except (ServiceFailed, ServiceTimeout, ServiceUnavailable, TypeMismatch) as error:
        return str(error), False
    return "" if reply.accepted else str(reply.reason or "refused"), True


def _staleness(stamp_ns: int, now_ns: int | None, stale_ns: int | None) -> str:
    """Say why a stamp is not that of a command for now; empty if it is, or if the time is not known."""
    if now_ns is None or stale_ns is None:
        return ""
    age_ns = now_ns - stamp_ns
    if age_ns > stale_ns:
        return f"stale: it is stamped {age_ns / 1e9:.3f} s before the newest state"
    if age_ns < -stale_ns:
        return (
            f"it is stamped {-age_ns / 1e9:.3f} s after the newest state: stamps are simulated time "
            "(use_sim_time, or the stamp of the odometry that it answers, or 0 for now)"
        )
    return ""
