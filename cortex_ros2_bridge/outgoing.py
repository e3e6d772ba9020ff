"""Cortex to ROS: one subscription for each Cortex topic, while somebody listens."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from cortex import Closed, Node, Subscriber, TypeMismatch, keep_last
from cortex.messages import Clock, CommandRanges, Events, Image, Odometry, PointCloud, Simulation, Transform
from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.backend.base import BackendError, Buffer, RosPublisher
from cortex_ros2_bridge.convert import Context, ConvertError, static_transforms, transform_of
from cortex_ros2_bridge.frames import FrameNames
from cortex_ros2_bridge.routes import Route
from cortex_ros2_bridge.tally import Tally

logger = logging.getLogger(__name__)

Convert = Callable[[Any, Context], "Buffer | None"]

QUEUES: dict[type[Any] | None, int] = {Image: 72, PointCloud: 72, Events: 128}
"""Messages that wait for their conversion (the option `queue` changes it): more than by default, so that
Cortex makes room in shared memory for those that wait while others are busy."""
QUEUE = 1024
REMIND_S = (0.1, 0.5, 2.0)
"""When the last message of a latched topic is sent again after somebody in ROS has come [s].

DDS calls a subscriber matched when it knows it, not when the subscriber knows us; and who answers a state at
once may not be heard yet. In lockstep both would wait for ever."""
RECEIVE_S = 0.5
"""How long the thread of a large topic waits before it looks whether it is still wanted [s]."""
CLOSE_S = 2.0
"""Longest wait for a conversion that is under way [s]."""
STREAM_S = 0.05
"""What has sent something within this time needs no reminder [s]."""


class Outgoing:
    """One route from Cortex to ROS.

    Attributes:
        route: The route.
        tally: What it has done.
        context: Of its conversion.
        wanted: Whether anybody in ROS listens, or may later; as of the last look.
        subscriber_count: How many listen; as of the last look.
        whereabouts: Of the vehicle whose commands these are; None: they are none.
    """

    def __init__(
        self, route: Route, publisher: RosPublisher, convert: Convert, context: Context, *, latched: bool
    ) -> None:
        self.route = route
        self.tally = Tally(str(route))
        self.wanted = False
        self.subscriber_count = 0
        self.whereabouts: Whereabouts | None = None
        self._publisher = publisher
        self._convert = convert
        self.context = context
        self._lasting = route.qos.durability == "transient_local"
        self._latched = latched and not self._lasting
        self._lock = threading.Lock()
        self._last: bytes | None = None
        self._last_s = 0.0
        self._remind_s: list[float] = []

    def look(self, is_active: bool) -> bool:
        """See who listens; returns whether anybody does, or may later, and messages may pass."""
        count = self._publisher.subscriber_count
        if self._latched:
            self._remind(count)
        self.subscriber_count = count
        self.wanted = is_active and (self._lasting or count > 0)
        return self.wanted

    def send(self, message: Any) -> None:
        """Convert a message and publish it."""
        tally = self.tally
        tally.count("received")
        if dropped := getattr(message, "dropped_count", 0):
            tally.count("dropped", "events that did not fit into the sensor's buffer", dropped)
        if self.whereabouts is not None:
            self.context.max_thrust_n = self.whereabouts.max_thrust_n
        try:
            data = self._convert(message, self.context)
        except Exception as error:  # whatever is wrong with a message, the next one may be right
            kind = "" if isinstance(error, ConvertError | cdr.CdrError) else f"{type(error).__name__}: "
            tally.count("refused", f"{kind}{error}")
            return
        if data is None:
            return
        self.context.sequence += 1
        with self._lock:
            try:
                self._publisher.publish(data)
            except BackendError as error:
                self.tally.count("lost", str(error))
                return
            self.tally.count("sent")
            if self._latched:
                self._last, self._last_s = bytes(data), time.monotonic()

    def remind(self) -> None:
        """Send the last message of a latched topic again some times, unless new ones come."""
        if self._latched:
            now_s = time.monotonic()
            self._remind_s = [now_s + delay_s for delay_s in REMIND_S]

    def forget(self) -> None:
        """Send the last message no more: it is of a publisher that has gone."""
        with self._lock:
            self._last = None
            self._remind_s = []

    def _remind(self, count: int) -> None:
        """Send the last message of a latched topic again, if it may have been too early for a newcomer."""
        now_s = time.monotonic()
        if count > self.subscriber_count:
            self.remind()
        while self._remind_s and now_s >= self._remind_s[0]:
            self._remind_s.pop(0)
            with self._lock:
                if self._last is not None and now_s - self._last_s > STREAM_S:
                    try:
                        self._publisher.publish(self._last)
                    except BackendError as error:
                        self.tally.count("lost", str(error))


class StaticTransforms:
    """All transforms that do not change, in one message: /tf_static keeps one for whoever comes later."""

    def __init__(self, frames: FrameNames) -> None:
        self._frames = frames
        self._transforms: dict[str, tuple[str, Any]] = {}
        self._vehicles: tuple[str, ...] = ()
        self._lock = threading.Lock()
        self.changed = False

    def add(self, source: str, transform: Transform) -> None:
        """Take in a transform from a Cortex topic, or a newer one of the same child.

        Raises:
            ConvertError: It is none: the one before stays.
        """
        made = transform_of(transform, self._frames)
        with self._lock:
            self._transforms[transform.child] = source, made
            self.changed = True

    def keep(self, sources: Iterable[str], vehicles: Iterable[str]) -> None:
        """Say which topics of transforms there are, and which vehicles move; forget what came from others."""
        there = set(sources)
        with self._lock:
            kept = {child: held for child, held in self._transforms.items() if held[0] in there}
            names = tuple(sorted(set(vehicles)))
            if len(kept) < len(self._transforms) or names != self._vehicles:
                self._transforms, self._vehicles, self.changed = kept, names, True

    def message(self) -> Buffer:
        """Return the message with all of them."""
        with self._lock:
            self.changed = False
            transforms = [transform for _, transform in self._transforms.values()]
            return static_transforms(transforms, self._vehicles, self._frames)


class Feed:
    """One Cortex topic: it is subscribed to only while a route or the bridge itself wants its messages.

    Small messages are converted on the node's callback thread. Large ones (`QUEUES`) have a thread for each
    topic, so that a picture does not hold up an Imu.

    Of a latched topic it keeps the last message, for those who come to want it while it is subscribed to.

    Attributes:
        topic: The topic.
        newest: When the newest message came [s], and its stamp [ns], if it has one.
    """

    def __init__(self, node: Node, topic: str, kind: type[Any] | None, *, latched: bool) -> None:
        self.topic = topic
        self._taps: dict[Callable[[Any], None], Callable[[], bool]] = {}
        self._outputs: tuple[Outgoing, ...] = ()
        self._node = node
        self._kind = kind
        self._latched = latched
        self._last: Any = None
        self._lock = threading.Lock()
        self._queue = QUEUES.get(kind, QUEUE)
        self._subscriber: Subscriber[Any] | None = None
        self._thread: threading.Thread | None = None
        self._told = (0, 0)
        self.newest = (0.0, 0)

    def tap(
        self, function: Callable[[Any], None], wants: Callable[[], bool], stack: contextlib.ExitStack
    ) -> None:
        """Give messages to a function while it wants any, before routes get them, until a stack closes."""
        with self._lock:
            self._taps[function] = wants
            if self._last is not None:
                function(self._last)
        stack.callback(self._untap, function)

    def _untap(self, function: Callable[[Any], None]) -> None:
        with self._lock:
            del self._taps[function]

    def add(self, output: Outgoing) -> None:
        """Let a route have the messages."""
        queue = output.route.options.get("queue")
        self._queue = self._queue if queue is None else queue
        self._outputs = (*self._outputs, output)

    def remove(self, output: Outgoing) -> None:
        """Let a route have no more of them."""
        self._outputs = tuple(other for other in self._outputs if other is not output)

    def _forget(self) -> None:
        """Keep nothing of publishers that have gone."""
        with self._lock:
            self._last = None
        for output in self._outputs:
            output.forget()

    def remind(self) -> None:
        """Let routes of a latched topic send the last message again."""
        for output in self._outputs:
            output.remind()

    @property
    def active(self) -> bool:
        """Whether it is subscribed to."""
        return self._subscriber is not None

    def look(self, is_active: bool) -> None:
        """See who wants its messages, and subscribe or unsubscribe accordingly; count what was lost."""
        wanted = [is_active and wants() for wants in self._taps.values()]
        for output in self._outputs:
            before = output.wanted
            wanted.append(output.look(is_active))
            if output.wanted and not before:
                with self._lock:
                    if self._last is not None:
                        output.send(self._last)
        if any(wanted):
            if self._subscriber is None:
                self._told = (0, 0)
                self._subscribe()
                logger.debug("%s: subscribed", self.topic)
        elif self._subscriber is not None:
            self.close()
            logger.debug("%s: not needed any more", self.topic)
        if self._last is not None and self._subscriber is not None and not self._subscriber.publisher_count:
            self._forget()
        self._count()

    def close(self) -> None:
        """Unsubscribe."""
        self._count()
        subscriber, self._subscriber = self._subscriber, None
        thread, self._thread = self._thread, None
        if subscriber is not None:
            subscriber.close()
        if thread is not None and thread is not threading.current_thread():
            thread.join(CLOSE_S)
        self._last = None

    def _subscribe(self) -> None:
        is_large = self._kind in QUEUES
        subscriber: Subscriber[Any] = self._node.subscriber(
            self.topic, self._kind, None if is_large else self._take, policy=keep_last(self._queue)
        )
        self._subscriber = subscriber
        if is_large:
            self._thread = threading.Thread(
                target=self._receive, args=(subscriber,), name=f"feed {self.topic}", daemon=True
            )
            self._thread.start()

    def _receive(self, subscriber: Subscriber[Any]) -> None:
        """Take messages until the subscription is closed."""
        while self._subscriber is subscriber:
            try:
                message = subscriber.recv(RECEIVE_S)
            except (TimeoutError, TypeMismatch):  # the second is counted by Cortex
                continue
            except Closed:
                return
            self._take(message)

    def _take(self, message: Any) -> None:
        stamp_ns = getattr(message, "stamp_ns", 0)
        if stamp_ns:
            self.newest = time.monotonic(), stamp_ns
        with self._lock:
            if self._latched:
                self._last = message
            for tap in self._taps:
                tap(message)
            for output in self._outputs:
                if output.wanted:
                    output.send(message)

    def _count(self) -> None:
        """Pass on what Cortex lost and rejected since the last look."""
        if self._subscriber is None:
            return
        counters = self._subscriber.counters
        now = counters.lost + counters.overtaken, counters.rejected
        lost, rejected = now[0] - self._told[0], now[1] - self._told[1]
        self._told = now
        for output in self._outputs:
            if lost and output.wanted:
                output.tally.count("received", count=lost)
                output.tally.count("lost", "the bridge, or the machine, is too slow", lost)
            for _ in range(rejected):
                output.tally.count("refused", "a malformed message, or one of another type")


@dataclass(eq=False)
class Whereabouts:
    """What the bridge knows of a vehicle: the newest messages about it, None before the first."""

    vehicle: str
    odometry: Odometry | None = None
    clock: Clock | None = None
    simulation: Simulation | None = None
    """What the vehicles can do; the simulator says it once."""
    sources: tuple[str | None, ...] = (None, None, None)
    """Topics of state, of time and of the simulation; None where there is none."""
    resources: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)
    """What is to be closed when the sources change."""

    def forget(self, sources: tuple[str | None, ...]) -> None:
        """Forget all that came from other sources."""
        self.resources.close()
        self.sources = sources
        self.odometry = self.clock = self.simulation = None

    @property
    def max_thrust_n(self) -> float | None:
        """Thrust with all rotors at their highest speed [N]."""
        said = self.simulation
        known = {} if said is None else dict(zip(said.vehicles, said.thrust_max_n, strict=False))
        return known.get(self.vehicle)

    @property
    def ranges(self) -> CommandRanges | None:
        """What it can be asked for."""
        said = self.simulation
        known = {} if said is None else dict(zip(said.vehicles, said.command_ranges, strict=False))
        return known.get(self.vehicle)

    @property
    def now_ns(self) -> int | None:
        """Time of the newest state, else that of the run [ns]."""
        newest = self.odometry or self.clock
        return None if newest is None else newest.stamp_ns
