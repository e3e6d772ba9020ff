"""The bridge: it looks at both sides twenty times a second, and connects what belongs together.

Messages pass on the callback thread of a Cortex node (to ROS) and on threads of the backend (to Cortex); what
is here only opens, closes and counts. Nothing waits for anybody: a queue that is full loses its oldest
messages, which are counted, and shown on /diagnostics.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Iterable

from cortex import Node
from cortex_ros2_bridge import cdr, diagnostics
from cortex_ros2_bridge.backend.base import Backend, BackendError
from cortex_ros2_bridge.config import QOS, BridgeConfig
from cortex_ros2_bridge.convert.records import record, status_record, time_of
from cortex_ros2_bridge.lifecycle import ACTIVE, FINALIZED, INACTIVE, STATES, UNCONFIGURED
from cortex_ros2_bridge.links import Connections, Link
from cortex_ros2_bridge.neighbours import Neighbours
from cortex_ros2_bridge.routes import Route, Seen, look, make_routes
from cortex_ros2_bridge.simulation import SERVED, SimulationServices
from cortex_ros2_bridge.tally import Totals

logger = logging.getLogger(__name__)

LOOK_INTERVAL_S = 0.05
DIAGNOSTICS_INTERVAL_S = 1.0
GONE_S = 10.0
"""For so long a route outlives its Cortex topic, so that a simulator that is restarted finds it open [s]."""
RETRY_S = 1.0
"""When a route is tried again that the backend could not open [s]."""

Key = tuple[str, str, str, str]


class Bridge:
    """Connects the topics and services of Cortex with those of ROS 2. A context manager.

    Attributes:
        config: What it does.
        problems: Why there are no routes for some topics, a sentence each.
        state: Of its lifecycle, see `lifecycle.STATES`; messages pass while it is `ACTIVE`.
    """

    def __init__(self, config: BridgeConfig, backend: Backend, node: Node) -> None:
        """Prepare; nothing but /diagnostics is connected before `update` or `run`.

        Raises:
            BackendError: The backend cannot publish.
        """
        self.config = config
        self.problems: list[str] = []
        self.state = ACTIVE if config.autostart else UNCONFIGURED
        self._backend = backend
        self._node = node
        self._lock = threading.RLock()
        self._closed = False
        self._seen: Seen | None = None
        self._retry_s: float | None = None
        self._said: set[str] = set()
        self._links: dict[Key, Link] = {}
        self._connections = Connections(config, backend, node, lambda: self.state == ACTIVE)
        self._neighbours = Neighbours(backend, node)
        self._resources = contextlib.ExitStack()
        self._simulation: SimulationServices | None = None
        about = config.ros_topic(diagnostics.TOPIC)
        self._diagnostics = self._connections.publishers.take(
            self._resources, about, lambda: backend.publisher(about, diagnostics.TYPE, QOS["default"])
        )
        self._diagnosed_s = time.monotonic()
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
            if reason := self._backend.failure:
                self._failure = reason
                self._diagnose(DIAGNOSTICS_INTERVAL_S)
                raise BackendError(reason)
            try:
                self.update()
            except Exception as error:  # streams and commands of others must not end with one mistake
                self._tell_failure(error)
            time.sleep(LOOK_INTERVAL_S)  # not `stop.wait`: a handler of signals may set it, in this thread

    def update(self) -> None:
        """Look at both sides once, and connect and disconnect accordingly."""
        with self._lock:
            if self._closed:
                return
            now_s = time.monotonic()
            seen = look(self._node) if self.state in (INACTIVE, ACTIVE) else Seen()
            if seen != self._seen or (self._retry_s is not None and now_s >= self._retry_s):
                self._seen, self._retry_s = seen, None
                self._reroute(seen, now_s)
            for key, link in list(self._links.items()):
                if link.gone_s is not None and now_s >= link.gone_s:
                    self._close_link(key)
            self._connections.look()
            try:
                self._connections.publish_static(self.routes())
            except BackendError as error:
                logger.warning("%s: %s", self.config.ros_topic("/tf_static"), error)
            if now_s - self._diagnosed_s >= DIAGNOSTICS_INTERVAL_S:
                self._notes = self._neighbours.notes(self.routes(), seen, self.config, now_s)
                self._say(self._notes)
                self._diagnose(now_s - self._diagnosed_s)
                self._diagnosed_s = now_s

    def change_state(self, state: int) -> None:
        """Go on in another state of the lifecycle: with routes open or closed, passing messages or not."""
        with self._lock:
            self.state = state
            if state in (UNCONFIGURED, FINALIZED):
                self._disconnect()
            self.update()

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
                self._disconnect()
                self._resources.close()

    def _disconnect(self) -> None:
        for key in list(self._links):
            self._close_link(key)
        self._connections.close()
        simulation, self._simulation = self._simulation, None
        if simulation is not None:
            simulation.close()
        self._seen = None
        self._was_routed = self._had_routes = False

    def __enter__(self) -> Bridge:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

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
        self._connections.watch_vehicles(seen)
        if (
            self._simulation is None
            and self.config.defaults
            and not self.config.is_bag
            and SERVED.keys() <= dict(seen.services).keys()
        ):
            self._simulation = SimulationServices(
                self._node, self._backend, self.config, lambda: self.state == ACTIVE
            )
        self.problems = problems
        self._say(problems)

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
        try:
            self._links[route.key] = self._connections.open(route, seen)
        except ValueError as error:
            return [f"no route {route}: {error}"]
        except BackendError as error:
            self._retry_s = now_s + RETRY_S
            return [f"no route {route} yet: {error}"]
        logger.debug("%s (%s)", route, route.ros_type)
        return []

    def _close_link(self, key: Key) -> None:
        link = self._links.pop(key)
        link.resources.close()
        if not self._closed:
            logger.debug("%s: closed", link.route)

    def _say(self, sentences: Iterable[str]) -> None:
        """Say each sentence once."""
        for sentence in sentences:
            if sentence not in self._said:
                logger.warning("%s", sentence)
                self._said.add(sentence)

    def _tell_failure(self, error: Exception) -> None:
        """Say a mistake once a second at most, and on /diagnostics."""
        now_s = time.monotonic()
        if self._failed_s is None or now_s - self._failed_s >= DIAGNOSTICS_INTERVAL_S:
            logger.exception("the bridge goes on, but could not look after everything")
            self._failed_s = now_s
        self._failure = f"{type(error).__name__}: {error}"

    def _diagnose(self, elapsed_s: float) -> None:
        """Publish how everything is doing."""
        failure, self._failure = self._failure, ""
        feeds = self._connections.feeds.values()
        wrong = self.problems + self._notes
        missing = "" if self._was_routed else "no Cortex topics: no simulator runs"
        if missing and self._had_routes:
            missing = "the Cortex side has gone"
        if self.state != ACTIVE:
            missing = f"{STATES[self.state]}: nothing passes"
        level = diagnostics.WARN if wrong or (missing and self.state == ACTIVE) else diagnostics.OK
        if failure or (missing and self._had_routes):
            level = diagnostics.ERROR
        values = {
            "backend": self._backend.name,
            "distro": self._backend.distro,
            "routes": str(len(self._links)),
            "cortex_subscriptions": str(sum(feed.active for feed in feeds)),
        }
        message = "; ".join(filter(None, [failure, missing, *wrong])) or f"{len(self._links)} routes"
        node = self.config.node
        statuses = [
            status_record(level, f"{node}: bridge", message, diagnostics.HARDWARE, values.items()),
            *(diagnostics.route_status(link, node, elapsed_s) for link in self._links.values()),
        ]
        if self._diagnostics.subscriber_count:
            newest = max((feed.newest for feed in feeds), default=(0.0, 0))
            head = record("std_msgs/msg/Header")(time_of(newest[1]), "")
            try:
                self._diagnostics.publish(cdr.encode(record(diagnostics.TYPE)(head, statuses)))
            except BackendError as error:
                logger.warning("%s: %s", diagnostics.TOPIC, error)
