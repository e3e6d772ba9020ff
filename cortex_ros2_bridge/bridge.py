"""The bridge: it looks at both sides twenty times a second, and connects what belongs together.

Messages pass on the callback thread of a Cortex node (to ROS) and on threads of the backend (to Cortex); what
is here only opens, closes and counts. Nothing waits for anybody: a queue that is full loses its oldest
messages, which are counted, and shown on /diagnostics.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from cortex import Node, Publisher
from cortex_ros2_bridge import cdr, convert, diagnostics
from cortex_ros2_bridge.backend.base import Backend, BackendError, RosPublisher
from cortex_ros2_bridge.config import QOS, BridgeConfig
from cortex_ros2_bridge.incoming import SERVICES, Caller, Incoming, Target
from cortex_ros2_bridge.msgs import message_class
from cortex_ros2_bridge.outgoing import Feed, Outgoing, StaticTransforms, Whereabouts
from cortex_ros2_bridge.routes import (
    INFO,
    Route,
    Seen,
    kind_of,
    look,
    make_routes,
    odometry_of,
    rule_of,
    shared_topics,
    unfit,
    vehicle_of,
)
from cortex_ros2_bridge.simulation import SERVED, SimulationServices
from cortex_ros2_bridge.tally import Tally, Totals

logger = logging.getLogger(__name__)

LOOK_INTERVAL_S = 0.05
DIAGNOSTICS_INTERVAL_S = 1.0
GONE_S = 10.0
"""For so long a route outlives its Cortex topic, so that a simulator that is restarted finds it open [s]."""
GONE = "its Cortex topic has gone"
RETRY_S = 1.0
"""When a route is tried again that the backend could not open [s]."""
UNFIT_S = 5.0
"""So long after the first topics are seen, settings that fit none of them are said [s]."""
TWICE_S = 12.0
"""So long others may publish our topics too: DDS forgets a bridge that was killed after 10 s [s]."""

Key = tuple[str, str, str, str]


V = TypeVar("V", bound=Any)


class Shared(Generic[V]):
    """Things that several routes use: opened for the first of them, and closed after the last."""

    def __init__(self) -> None:
        """Hold nothing."""
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
class _Link:
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


class Bridge:
    """Connects the topics and services of Cortex with those of ROS 2. A context manager.

    Attributes:
        config: What it does.
        problems: Why there are no routes for some topics, a sentence each.
    """

    def __init__(self, config: BridgeConfig, backend: Backend, node: Node) -> None:
        """Prepare; nothing but /diagnostics is connected before `update` or `run`.

        Args:
            config: What to do.
            backend: The ROS side; it stays open.
            node: The Cortex side; it stays open.

        Raises:
            BackendError: The backend cannot publish.
        """
        self.config = config
        self.problems: list[str] = []
        self._backend = backend
        self._node = node
        self._frames = config.frame_names
        self._tf_static = config.ros_topic("/tf_static")
        self._lock = threading.RLock()
        self._closed = False
        self._seen: Seen | None = None
        self._retry_s: float | None = None
        self._said: set[str] = set()
        self._noted: set[str] = set()
        self._links: dict[Key, _Link] = {}
        self._feeds: Shared[Feed] = Shared()
        self._incoming: Shared[Incoming] = Shared()
        self._ros_publishers: Shared[RosPublisher] = Shared()
        self._cortex_publishers: Shared[Publisher[Any]] = Shared()
        self._vehicles: dict[str, Whereabouts] = {}
        self._static = StaticTransforms(self._frames)
        self._resources = contextlib.ExitStack()
        self._static_publisher: RosPublisher | None = None
        self._simulation: SimulationServices | None = None
        about = config.ros_topic(diagnostics.TOPIC)
        self._diagnostics = self._ros_publishers.take(
            self._resources, about, lambda: backend.publisher(about, diagnostics.TYPE, QOS["default"])
        )
        self._diagnosed_s = time.monotonic()
        self._unfit_s: float | None = None
        self._twice_s: float | None = None
        self._notes: list[str] = []
        self._was_routed = self._had_routes = False
        self._failed_s: float | None = None
        self._failure = ""

    def run(self, stop: threading.Event) -> None:
        """Work until told to stop; what goes wrong with one look is said, and the next one may go well.

        Raises:
            BackendError: The backend is dead for good.
        """
        while not stop.is_set():
            if self._backend.failure:
                raise BackendError(self._backend.failure)
            try:
                self.update()
            except Exception as error:  # streams and commands of others must not end with one mistake
                self._tell_failure(error)
            stop.wait(LOOK_INTERVAL_S)

    def update(self) -> None:
        """Look at both sides once, and connect and disconnect accordingly."""
        with self._lock:
            if self._closed:
                return
            now_s = time.monotonic()
            seen = look(self._node)
            if seen != self._seen or (self._retry_s is not None and now_s >= self._retry_s):
                self._seen, self._retry_s = seen, None
                self._reroute(seen, now_s)
            for key, link in list(self._links.items()):
                if link.gone_s is not None and now_s >= link.gone_s:
                    self._close_link(key)
            newcomers = [incoming.look() for incoming in self._incoming.values()]
            for feed in self._feeds.values():
                if any(newcomers):
                    feed.remind()
                feed.look()
            self._publish_static()
            if now_s - self._diagnosed_s >= DIAGNOSTICS_INTERVAL_S:
                self._look_at_others(seen, now_s)
                self._diagnose(now_s - self._diagnosed_s)
                self._diagnosed_s = now_s

    def reconfigure(self, config: BridgeConfig) -> None:
        """Go on with other settings; routes that they change or leave out are closed, and opened anew."""
        with self._lock:
            seen = self._seen or Seen()
            wanted = {route.key: route for route in make_routes(seen, config)[0]}
            there = {topic.topic for topic in seen.topics} | {name for name, _ in seen.services}
            for key, link in list(self._links.items()):
                if link.route.cortex_topic in there and wanted.get(key) != link.route:
                    self._close_link(key)
            self.config, self._seen = config, None

    def routes(self) -> list[Route]:
        """Return the routes that are open now."""
        with self._lock:
            return [link.route for link in self._links.values()]

    def totals(self) -> dict[str, Totals]:
        """Return what the open routes have done, by "/cortex/topic -> /ros/topic"."""
        with self._lock:
            return {str(link.route): link.tally.totals() for link in self._links.values()}

    def close(self) -> None:
        """Disconnect everything. Node and backend stay open."""
        with self._lock:
            if not self._closed:
                self._closed = True
                for key in list(self._links):
                    self._close_link(key)
                self._resources.close()

    def __enter__(self) -> Bridge:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Routes

    def _reroute(self, seen: Seen, now_s: float) -> None:
        """Open the routes of what is new; those of what has gone have some time to come back."""
        routes, problems = make_routes(seen, self.config)
        wanted = {route.key for route in routes}
        for key, link in self._links.items():
            if key in wanted:
                link.gone_s = None
            elif link.gone_s is None:
                link.gone_s = now_s + GONE_S
                logger.debug("%s: the Cortex side has gone", link.route)
        new = [route for route in routes if route.key not in self._links]
        self._make_way(new)
        for route in new:
            problems += self._open(route, seen, now_s)
        if any(route.key in self._links for route in new):
            logger.info("%d routes are open; --verbose or /diagnostics names them", len(self._links))
        self._cortex_gone(len(wanted))
        self._watch_vehicles(seen)
        if self._simulation is None and self.config.defaults and SERVED.keys() <= dict(seen.services).keys():
            self._simulation = SimulationServices(self._node, self._backend, self.config)
            self._resources.callback(self._simulation.close)
        self.problems = problems
        for problem in problems:
            if problem not in self._said:
                logger.warning("%s", problem)
        self._said = set(problems)

    def _cortex_gone(self, count: int) -> None:
        """Say once that all of the Cortex side has gone."""
        if not count and self._was_routed:
            logger.info("the Cortex side has gone; its routes stay open for %g s", GONE_S)
        self._was_routed = count > 0
        self._had_routes |= self._was_routed

    def _make_way(self, routes: Iterable[Route]) -> None:
        """Close routes whose Cortex side has gone, if others need their ROS topics in another way."""
        for route in routes:
            for key, link in list(self._links.items()):
                old = link.route
                if link.gone_s is None or old.ros_topic != route.ros_topic:
                    continue
                if (old.ros_type, old.qos, old.direction) != (route.ros_type, route.qos, route.direction):
                    self._close_link(key)

    def _open(self, route: Route, seen: Seen, now_s: float) -> list[str]:
        """Open a route; returns why that was not possible."""
        _warm_up(route.ros_type)
        opens = {"out": self._open_out, "in": self._open_in, "call": self._open_call}
        with contextlib.ExitStack() as stack:
            try:
                tally, listeners = opens[route.direction](route, seen, stack)
            except ValueError as error:
                return [f"no route {route}: {error}"]
            except BackendError as error:
                self._retry_s = now_s + RETRY_S
                return [f"no route {route} yet: {error}"]
            self._links[route.key] = _Link(
                route=route, tally=tally, listeners=listeners, resources=stack.pop_all()
            )
        logger.debug("%s (%s)", route, route.ros_type)
        return []

    def _close_link(self, key: Key) -> None:
        link = self._links.pop(key)
        link.resources.close()
        if not self._closed:
            logger.debug("%s: closed", link.route)

    def _open_out(
        self, route: Route, seen: Seen, stack: contextlib.ExitStack
    ) -> tuple[Tally, Callable[[], int]]:
        publisher = self._ros_publishers.take(
            stack,
            route.ros_topic,
            lambda: self._backend.publisher(route.ros_topic, route.ros_type, route.qos),
        )
        feed = self._feed(route.cortex_topic, route.cortex_type, stack)
        if route.ros_topic == self._tf_static:
            tally = Tally(str(route))
            source = route.cortex_topic
            self._tap(feed, lambda message: self._take_transform(source, message, tally), lambda: True, stack)
            return tally, lambda: publisher.subscriber_count
        output = Outgoing(
            route,
            publisher,
            rule_of(route).convert,
            self._context(route),
            latched=any(t.topic == route.cortex_topic and t.latched for t in seen.topics),
        )
        if route.ros_type == "sensor_msgs/msg/CameraInfo" and route.cortex_type != "cortex/CameraInfo":
            info = self._feed(route.cortex_topic + INFO, "cortex/CameraInfo", stack)
            self._tap(info, output.take_camera_info, lambda: True, stack)
        feed.add(output)
        stack.callback(feed.remove, output)
        return output.tally, lambda: output.subscriber_count

    def _open_in(
        self, route: Route, seen: Seen, stack: contextlib.ExitStack
    ) -> tuple[Tally, Callable[[], int]]:
        kind = kind_of(route.cortex_type)
        assert kind is not None  # only types with a class come in
        publisher = self._cortex_publishers.take(
            stack,
            (route.cortex_topic, route.cortex_type),
            lambda: self._node.publisher(route.cortex_topic, kind),
        )
        target = Target(route, publisher, rule_of(route).convert, self._context(route))
        whereabouts = self._whereabouts_of(vehicle_of(route.cortex_topic))

        def subscribe() -> Incoming:
            incoming = Incoming(whereabouts)
            incoming.subscription = self._backend.subscription(
                route.ros_topic, route.ros_type, route.qos, incoming.take
            )
            return incoming

        incoming = self._incoming.take(stack, route.ros_topic, subscribe)
        incoming.add(target)
        stack.callback(incoming.remove, target)
        return target.tally, lambda: incoming.publisher_count

    def _open_call(
        self, route: Route, seen: Seen, stack: contextlib.ExitStack
    ) -> tuple[Tally, Callable[[], int]]:
        caller = Caller(route, self._node, rule_of(route).convert, self._context(route))
        stack.callback(caller.close)
        subscription = self._backend.subscription(route.ros_topic, route.ros_type, route.qos, caller.take)
        stack.callback(subscription.close)
        service = self._backend.service(route.ros_topic, SERVICES[route.ros_type], caller.serve)
        if service is not None:
            stack.callback(service.close)
        return caller.tally, lambda: subscription.publisher_count

    def _context(self, route: Route) -> convert.Context:
        return convert.Context(
            frames=self._frames,
            vehicle=vehicle_of(route.cortex_topic),
            frame_id=route.cortex_topic.strip("/"),
            options=route.options,
        )

    def _feed(self, topic: str, type_name: str, stack: contextlib.ExitStack) -> Feed:
        topics = () if self._seen is None else self._seen.topics
        latched = any(t.topic == topic and t.latched for t in topics)
        return self._feeds.take(
            stack, (topic, type_name), lambda: Feed(self._node, topic, kind_of(type_name), latched=latched)
        )

    def _tap(
        self, feed: Feed, tap: Callable[[Any], None], wants: Callable[[], bool], stack: contextlib.ExitStack
    ) -> None:
        feed.tap(tap, wants)
        stack.callback(feed.untap, tap)

    # Others

    def _look_at_others(self, seen: Seen, now_s: float) -> None:
        """Say what others do, and settings ask for, that does not work or is done twice."""
        self._notes = self._of_other_types() + self._of_another_bridge(now_s) + self._of_settings(seen, now_s)
        for note in self._notes:
            if note not in self._noted:
                logger.warning("%s", note)
        self._noted |= set(self._notes)

    def _of_other_types(self) -> list[str]:
        """Say which of our topics others use with another type, and which topic is for that."""
        ours = {route.ros_topic: route for route in self.routes()}
        notes = []
        for info in self._backend.topics():
            route = ours.get(info.topic)
            if route is None or info.type_name == route.ros_type:
                continue
            if route.direction == "out" and info.subscriber_count:
                notes.append(
                    f"{info.topic}: a node subscribes to it as {info.type_name}, it is {route.ros_type}"
                )
            elif route.direction != "out" and info.publisher_count:
                right = [other.ros_topic for other in ours.values() if _serves(other, route, info.type_name)]
                hint = f"; for {info.type_name}: {' or '.join(right)}" if right else ""
                notes.append(
                    f"{info.topic}: a node publishes {info.type_name}, wanted is {route.ros_type}{hint}"
                )
        return notes

    def _of_another_bridge(self, now_s: float) -> list[str]:
        """Say that others publish what we do: then ROS gets every message twice, and Cortex every command."""
        ours = {route.ros_topic for route in self.routes() if route.direction == "out"}
        ours -= shared_topics(self.config)
        twice = sorted({t.topic for t in self._backend.topics() if t.publisher_count and t.topic in ours})
        if not twice:
            self._twice_s = None
            return []
        self._twice_s = now_s if self._twice_s is None else self._twice_s
        twins = [n for n in self._node.nodes() if n.node != self._node.id and n.name == self._node.name]
        if not twins and now_s - self._twice_s < TWICE_S:
            return []
        who = ", ".join(f"{twin.name}, process {twin.pid} on {twin.host}" for twin in twins)
        what = f"another bridge ({who})" if twins else "another node"
        more = f" and {len(twice) - 1} more of our topics" if len(twice) > 1 else ""
        return [f"{what} publishes {twice[0]}{more} too: ROS gets all of it twice, and Cortex every command"]

    def _of_settings(self, seen: Seen, now_s: float) -> list[str]:
        """Say which settings have fitted nothing for a while; what fits them may come yet."""
        if self._unfit_s is None and seen.topics:
            self._unfit_s = now_s + UNFIT_S
        if self._unfit_s is None or now_s < self._unfit_s:
            return []
        return unfit(seen, self.config)

    # Vehicles

    def _watch_vehicles(self, seen: Seen) -> None:
        """Follow what time it is for the vehicles that are commanded, and how their frames hang together."""
        for vehicle, whereabouts in self._vehicles.items():
            topic = odometry_of(vehicle, seen)
            clock, simulation = (_topic_of(kind, seen) for kind in ("cortex/Clock", "cortex/Simulation"))
            if whereabouts.sources == (topic, clock, simulation):
                continue
            whereabouts.forget((topic, clock, simulation))
            stack = whereabouts.resources
            wants = self._commands_come_for(vehicle)
            if topic is not None:
                self._tap(
                    self._feed(topic, "cortex/Odometry", stack), whereabouts.take_odometry, wants, stack
                )
            if clock is not None:
                self._tap(self._feed(clock, "cortex/Clock", stack), whereabouts.take_clock, wants, stack)
            if simulation is not None:  # it says once what the first command already needs
                feed = self._feed(simulation, "cortex/Simulation", stack)
                self._tap(feed, whereabouts.take_simulation, lambda: True, stack)

    def _keep_static(self) -> None:
        """Forget the transforms of routes that are closed."""
        routes = self.routes()
        sources = {r.cortex_topic for r in routes if r.ros_topic == self._tf_static}
        moving = self.config.ros_topic("/tf")
        self._static.keep(sources, {vehicle_of(r.cortex_topic) for r in routes if r.ros_topic == moving})

    def _whereabouts_of(self, vehicle: str) -> Whereabouts:
        if vehicle not in self._vehicles:
            self._vehicles[vehicle] = Whereabouts(vehicle)
        return self._vehicles[vehicle]

    def _commands_come_for(self, vehicle: str) -> Callable[[], bool]:
        whereabouts = self._vehicles[vehicle]
        return lambda: any(i.heard for i in self._incoming.values() if i.whereabouts is whereabouts)

    def _take_transform(self, source: str, transform: Any, tally: Tally) -> None:
        tally.receive()
        try:
            self._static.add(source, transform)
        except convert.ConvertError as error:
            tally.refuse(str(error))
        else:
            tally.send()

    def _publish_static(self) -> None:
        """Publish all transforms that do not change, if there is a new one."""
        self._keep_static()
        if not self._static.changed:
            return
        try:
            if self._static_publisher is None:
                self._static_publisher = self._ros_publishers.take(
                    self._resources,
                    self._tf_static,
                    lambda: self._backend.publisher(
                        self._tf_static, "tf2_msgs/msg/TFMessage", QOS["latched"]
                    ),
                )
            self._static_publisher.publish(self._static.message())
        except BackendError as error:
            logger.warning("%s: %s", self._tf_static, error)

    def _tell_failure(self, error: Exception) -> None:
        """Say a mistake once a second at most, and on /diagnostics."""
        now_s = time.monotonic()
        if self._failed_s is None or now_s - self._failed_s >= DIAGNOSTICS_INTERVAL_S:
            logger.exception("the bridge goes on, but could not look after everything")
            self._failed_s = now_s
        self._failure = f"{type(error).__name__}: {error}"

    # Diagnostics

    def _diagnose(self, elapsed_s: float) -> None:
        """Publish how everything is doing."""
        failure, self._failure = self._failure, ""
        wrong = self.problems + self._notes + ([self._backend.trouble] if self._backend.trouble else [])
        gone = [link for link in self._links.values() if link.gone_s is not None]
        missing = "" if self._was_routed else "no Cortex topics: no simulator runs"
        if missing and self._had_routes:
            missing = "the Cortex side has gone"
        level = diagnostics.WARN if wrong or missing else diagnostics.OK
        if failure or (missing and self._had_routes):
            level = diagnostics.ERROR
        statuses = [
            diagnostics.Status(
                name="bridge",
                level=level,
                message="; ".join(filter(None, [failure, missing, *wrong])) or f"{len(self._links)} routes",
                values=(
                    ("backend", self._backend.name),
                    ("distro", self._backend.distro),
                    ("routes", str(len(self._links))),
                    ("cortex_subscriptions", str(sum(feed.active for feed in self._feeds.values()))),
                ),
            )
        ]
        for link in self._links.values():
            now = link.tally.totals()
            if link in gone:
                stale = diagnostics.Status(name=str(link.route), level=diagnostics.STALE, message=GONE)
                statuses.append(stale)
                continue
            statuses.append(
                diagnostics.route_status(
                    str(link.route),
                    now,
                    link.before,
                    listeners=link.listeners(),
                    elapsed_s=elapsed_s,
                    reason=link.tally.reason,
                    types=f"{link.route.cortex_type} and {link.route.ros_type}",
                )
            )
            link.before = now
        if self._diagnostics.subscriber_count:
            stamps = [feed.newest for feed in self._feeds.values()]
            array = diagnostics.diagnostic_array(
                statuses, stamp_ns=max(stamps, default=(0.0, 0))[1], node=self.config.node
            )
            try:
                self._diagnostics.publish(array)
            except BackendError as error:
                logger.warning("%s: %s", diagnostics.TOPIC, error)


def _topic_of(type_name: str, seen: Seen) -> str | None:
    return next((t.topic for t in seen.topics if t.type_name == type_name and t.published), None)


def _serves(other: Route, route: Route, ros_type: str) -> bool:
    """Return whether a route takes messages of a type for the vehicle of another one."""
    same = vehicle_of(other.cortex_topic) == vehicle_of(route.cortex_topic)
    return other.direction == route.direction and same and other.ros_type == ros_type


@functools.cache
def _warm_up(ros_type: str) -> None:
    """Let code for a type be generated now: with the first message it would hold up a stream for 20 ms."""
    with contextlib.suppress(ValueError):  # what is wrong with the type is said where it is opened
        cdr.decode_record(cdr.encode(message_class(ros_type)()), ros_type)
