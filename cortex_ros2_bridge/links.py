"""The connections of routes: shared feeds, publishers and subscriptions, and places of vehicles."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from cortex import Node, Publisher
from cortex_ros2_bridge import cdr, convert
from cortex_ros2_bridge.backend.base import Backend, RosPublisher
from cortex_ros2_bridge.config import QOS, BridgeConfig
from cortex_ros2_bridge.incoming import SERVICES, Caller, Incoming, Target
from cortex_ros2_bridge.msgs import message_class
from cortex_ros2_bridge.outgoing import Feed, Outgoing, StaticTransforms, Whereabouts
from cortex_ros2_bridge.routes import INFO, Route, Seen, kind_of, odometry_of, rule_of, vehicle_of
from cortex_ros2_bridge.run_log import RunLog
from cortex_ros2_bridge.tally import Tally, Totals

Opened = tuple[Tally, Callable[[], int]]
V = TypeVar("V", bound=Any)


class Shared(Generic[V]):
    """Things that several routes use: opened for the first of them, and closed after the last."""

    def __init__(self) -> None:
        self._held: dict[Any, tuple[V, int]] = {}

    def take(self, stack: contextlib.ExitStack, key: Any, make: Callable[[], V]) -> V:
        """Return the thing of a key; it is given back when the stack closes."""
        thing, users = self._held[key] if key in self._held else (make(), 0)
        self._held[key] = thing, users + 1
        stack.callback(self._give_back, key)
        return thing

    def values(self) -> list[V]:
        """Return what is open now."""
        return [thing for thing, _ in self._held.values()]

    def _give_back(self, key: Any) -> None:
        thing, users = self._held[key]
        if users > 1:
            self._held[key] = thing, users - 1
        else:
            del self._held[key]
            thing.close()


@dataclass(kw_only=True, eq=False)
class Link:
    """A route that is open."""

    route: Route
    tally: Tally
    listeners: Callable[[], int]
    """How many there are on the ROS side: subscribers, or publishers of commands."""
    resources: contextlib.ExitStack
    gone_s: float | None = None
    """When it is closed, because its Cortex topic has gone [s]."""
    before: Totals = field(default_factory=Totals)
    """As of the last diagnostics."""


class Connections:
    """Opens routes while `is_active` lets messages pass, and follows what they need besides.

    Attributes:
        feeds: Cortex topics.
        incoming: ROS topics of commands.
        publishers: ROS topics.
    """

    def __init__(
        self, config: BridgeConfig, backend: Backend, node: Node, is_active: Callable[[], bool]
    ) -> None:
        self.feeds: Shared[Feed] = Shared()
        self.incoming: Shared[Incoming] = Shared()
        self.publishers: Shared[RosPublisher] = Shared()
        self._backend = backend
        self._node = node
        self._is_active = is_active
        self._frames = config.frame_names
        self._tf, self._tf_static = config.ros_topic("/tf"), config.ros_topic("/tf_static")
        self._seen = Seen()
        self._cortex_publishers: Shared[Publisher[Any]] = Shared()
        self._vehicles: dict[str, Whereabouts] = {}
        self._static = StaticTransforms(self._frames)
        self._static_publisher: RosPublisher | None = None
        self._resources = contextlib.ExitStack()
        self._run_log = RunLog(config.ros_topic("/reset"))
        self._is_logged = False

    def open(self, route: Route, seen: Seen) -> Link:
        """Open a route.

        Raises:
            ValueError: ROS allows it not.
            BackendError: It is not possible now.
        """
        self._seen = seen
        _warm_up(route.ros_type)
        out = self._open_out
        opens = {"out": out, "record": out, "in": self._open_in, "call": self._open_call}
        with contextlib.ExitStack() as stack:
            tally, listeners = opens[route.direction](route, stack)
            return Link(route=route, tally=tally, listeners=listeners, resources=stack.pop_all())
        raise AssertionError("an exit stack swallows nothing")

    def look(self) -> None:
        """See who listens and who commands, and subscribe to what is wanted."""
        newcomers = [incoming.look() for incoming in self.incoming.values()]
        for feed in self.feeds.values():
            if any(newcomers):
                feed.remind()
            feed.look(self._is_active())

    def publish_static(self, routes: list[Route]) -> None:
        """Publish all transforms of these routes that do not change, if there is a new one.

        Raises:
            BackendError: They could not be sent.
        """
        sources = {r.cortex_topic for r in routes if r.ros_topic == self._tf_static}
        self._static.keep(sources, {vehicle_of(r.cortex_topic) for r in routes if r.ros_topic == self._tf})
        if not self._static.changed or not self._is_active():
            return
        if self._static_publisher is None:
            self._static_publisher = self._publisher(
                self._tf_static, "tf2_msgs/msg/TFMessage", QOS["latched"], self._resources
            )
        self._static_publisher.publish(self._static.message())

    def watch_vehicles(self, seen: Seen) -> None:
        """Follow the run, what time it is for the vehicles that are commanded, and what they can do."""
        self._seen = seen
        clock, simulation = (_topic_of(kind, seen) for kind in ("cortex/Clock", "cortex/Simulation"))
        status = _topic_of("cortex/SimulatorStatus", seen)
        if status is not None and not self._is_logged:
            self._is_logged = True
            feed = self._feed(status, "cortex/SimulatorStatus", self._resources)
            feed.tap(self._run_log.take, lambda: True, self._resources)
        for vehicle, whereabouts in self._vehicles.items():
            topics = odometry_of(vehicle, seen), clock, simulation
            if whereabouts.sources == topics:
                continue
            whereabouts.forget(topics)
            wants = self._commands_come_for(vehicle)
            # The simulation is said once, and the first command needs it already.
            wanted = {"Odometry": wants, "Clock": wants, "Simulation": lambda: True}
            for topic, (kind, is_wanted) in zip(topics, wanted.items(), strict=True):
                if topic is not None:
                    stack = whereabouts.resources
                    take = functools.partial(setattr, whereabouts, kind.lower())
                    self._feed(topic, f"cortex/{kind}", stack).tap(take, is_wanted, stack)

    def close(self) -> None:
        """Forget vehicles and transforms; the routes are closed by their links."""
        for whereabouts in self._vehicles.values():
            whereabouts.forget((None, None, None))
        self._vehicles.clear()
        self._resources.close()
        self._static_publisher = None
        self._static = StaticTransforms(self._frames)
        self._is_logged = False

    def _open_out(self, route: Route, stack: contextlib.ExitStack) -> Opened:
        publisher = self._publisher(route.ros_topic, route.ros_type, route.qos, stack)
        feed = self._feed(route.cortex_topic, route.cortex_type, stack)
        if route.ros_topic == self._tf_static:
            tally = Tally(str(route))
            source = route.cortex_topic
            feed.tap(lambda message: self._take_transform(source, message, tally), lambda: True, stack)
            return tally, lambda: publisher.subscriber_count
        output = Outgoing(
            route,
            publisher,
            rule_of(route).convert,
            self._context(route),
            latched=self._is_latched(route.cortex_topic),
        )
        if route.direction == "record":  # thrusts are parts of what the vehicle can do
            output.whereabouts = self._whereabouts_of(route)
        if route.ros_type == "sensor_msgs/msg/CameraInfo" and route.cortex_type != "cortex/CameraInfo":
            info = self._feed(route.cortex_topic + INFO, "cortex/CameraInfo", stack)
            take = functools.partial(setattr, output.context, "camera_info")
            info.tap(take, lambda: True, stack)
        feed.add(output)
        stack.callback(feed.remove, output)
        return output.tally, lambda: output.subscriber_count

    def _open_in(self, route: Route, stack: contextlib.ExitStack) -> Opened:
        kind = kind_of(route.cortex_type)
        assert kind is not None  # only types with a class come in
        publisher = self._cortex_publishers.take(
            stack,
            (route.cortex_topic, route.cortex_type),
            lambda: self._node.publisher(route.cortex_topic, kind),
        )
        target = Target(route, publisher, rule_of(route).convert, self._context(route))
        whereabouts = self._whereabouts_of(route)

        def subscribe() -> Incoming:
            incoming = Incoming(whereabouts, self._is_active)
            incoming.subscription = self._backend.subscription(
                route.ros_topic, route.ros_type, route.qos, incoming.take
            )
            return incoming

        incoming = self.incoming.take(stack, route.ros_topic, subscribe)
        incoming.add(target)
        stack.callback(incoming.remove, target)
        return target.tally, lambda: incoming.publisher_count

    def _open_call(self, route: Route, stack: contextlib.ExitStack) -> Opened:
        caller = Caller(route, self._node, rule_of(route).convert, self._context(route), self._is_active)
        stack.callback(caller.close)
        subscription = self._backend.subscription(route.ros_topic, route.ros_type, route.qos, caller.take)
        stack.callback(subscription.close)
        service = self._backend.service(route.ros_topic, SERVICES[route.ros_type], caller.serve)
        stack.callback(service.close)
        return caller.tally, lambda: subscription.publisher_count

    def _whereabouts_of(self, route: Route) -> Whereabouts:
        vehicle = vehicle_of(route.cortex_topic)
        return self._vehicles.setdefault(vehicle, Whereabouts(vehicle))

    def _context(self, route: Route) -> convert.Context:
        return convert.Context(
            frames=self._frames,
            vehicle=vehicle_of(route.cortex_topic),
            frame_id=route.cortex_topic.strip("/"),
            options=route.options,
        )

    def _publisher(self, topic: str, ros_type: str, qos: Any, stack: contextlib.ExitStack) -> RosPublisher:
        return self.publishers.take(stack, topic, lambda: self._backend.publisher(topic, ros_type, qos))

    def _feed(self, topic: str, type_name: str, stack: contextlib.ExitStack) -> Feed:
        latched, kind = self._is_latched(topic), kind_of(type_name)
        return self.feeds.take(
            stack, (topic, type_name), lambda: Feed(self._node, topic, kind, latched=latched)
        )

    def _is_latched(self, topic: str) -> bool:
        return any(t.topic == topic and t.latched for t in self._seen.topics)

    def _commands_come_for(self, vehicle: str) -> Callable[[], bool]:
        whereabouts = self._vehicles[vehicle]
        return lambda: any(i.publisher_count for i in self.incoming.values() if i.whereabouts is whereabouts)

    def _take_transform(self, source: str, transform: Any, tally: Tally) -> None:
        tally.count("received")
        try:
            self._static.add(source, transform)
        except convert.ConvertError as error:
            tally.count("refused", str(error))
        else:
            tally.count("sent")


def _topic_of(type_name: str, seen: Seen) -> str | None:
    return next((t.topic for t in seen.topics if t.type_name == type_name and t.published), None)


@functools.cache
def _warm_up(ros_type: str) -> None:
    """Let code for a type be generated now: with the first message it would hold up a stream for 20 ms."""
    with contextlib.suppress(ValueError):  # what is wrong with the type is said where it is opened
        cdr.decode(cdr.encode(message_class(ros_type)()), ros_type)
