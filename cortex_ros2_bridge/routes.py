"""Which Cortex topic goes where in ROS 2, and back: one table of rules, and what settings change.

Routes follow from the types of the topics that Cortex's discovery shows, so that no configuration is needed.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import cortex.messages
from cortex import Node
from cortex.schema import schema_of
from cortex.service import service_number
from cortex_ros2_bridge.backend.base import Qos
from cortex_ros2_bridge.config import BridgeConfig, RouteChange, is_ros_name
from cortex_ros2_bridge.convert import RULES
from cortex_ros2_bridge.convert.registry import ADDED, Direction, Rule, adopt

CORTEX_TYPES: Mapping[str, type[Any]] = {
    schema_of(kind).name: kind
    for kind in (getattr(cortex.messages, name) for name in cortex.messages.__all__)
}
"""The standard messages of Cortex by the names that discovery shows."""

SHARED = frozenset({"/tf", "/tf_static", "/diagnostics"})
"""ROS topics that several routes may publish on."""
INFO = "/info"
"""The calibration of a camera T is on T/info."""


@dataclass(frozen=True, kw_only=True)
class Route:
    """One way for messages."""

    cortex_topic: str
    """Topic, or the name of the service that is called."""
    cortex_type: str
    """Such as "cortex/Imu"; of a service, its request."""
    ros_topic: str
    ros_type: str
    """Such as "sensor_msgs/msg/Imu"."""
    direction: Direction
    qos: Qos = field(default_factory=Qos)
    options: Mapping[str, Any] = field(default_factory=dict)
    """Of the conversion."""
    label: str = ""
    """Its name among ROS parameters, if the settings give one."""

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What tells routes apart."""
        return self.cortex_topic, self.cortex_type, self.ros_topic, self.ros_type

    def __str__(self) -> str:
        arrow = "->" if self.direction in ("out", "record") else "<-"
        return f"{self.cortex_topic} {arrow} {self.ros_topic}"


def rules() -> tuple[Rule, ...]:
    """Return all rules: those of the bridge, and those of types that were added."""
    return (*RULES, *(rule for added in ADDED.values() for rule in added.rules))


def kind_of(type_name: str) -> type[Any] | None:
    """Return the class of a type of Cortex; None if it is known by its schema only."""
    return CORTEX_TYPES[type_name] if type_name in CORTEX_TYPES else ADDED[type_name].kind


def rule_of(route: Route) -> Rule:
    """Return the rule of a route: of several, that which was added last."""
    key = route.cortex_type, route.ros_type, route.direction
    found: Rule = next(rule for rule in reversed(rules()) if rule[:3] == key)
    return found


_TF_SOURCES = ("odometry", "odom")
"""Odometry on topics of these names moves the vehicle in tf; another one of the same vehicle does not."""


class SeenTopic(NamedTuple):
    """A topic that other Cortex nodes have."""

    topic: str
    type_name: str
    fingerprint: int
    published: bool
    latched: bool = False
    """Whether a publisher gives its last message to whoever comes later."""
    schema: str = ""
    """Of a published topic, as Cortex writes it."""


class Seen(NamedTuple):
    """What other Cortex nodes have now."""

    topics: tuple[SeenTopic, ...] = ()
    services: tuple[tuple[str, str], ...] = ()
    """Names of services, and the types of their requests, such as ("/step", "cortex/Step")."""


def look(node: Node) -> Seen:
    """Return what the other Cortex nodes publish, subscribe to and serve now."""
    topics: dict[tuple[str, int, bool], SeenTopic] = {}
    services = set()
    for record in node.nodes():
        if record.node == node.id:
            continue
        for publisher in record.publishers:
            key = publisher.topic, publisher.fingerprint, True
            before = topics.get(key)
            latched = publisher.latch or (before is not None and before.latched)
            topics[key] = SeenTopic(
                publisher.topic, publisher.type_name, publisher.fingerprint, True, latched, publisher.schema
            )
        for subscriber in record.subscribers:
            if subscriber.fingerprint:  # else it takes any type: a recorder
                key = subscriber.topic, subscriber.fingerprint, False
                topics[key] = SeenTopic(subscriber.topic, subscriber.type_name, subscriber.fingerprint, False)
        for service in record.services:
            request = _request_type(service.name, service.service)
            if request is not None:
                services.add((service.name, request))
    return Seen(tuple(topics[key] for key in sorted(topics)), tuple(sorted(services)))


def make_routes(seen: Seen, config: BridgeConfig) -> tuple[list[Route], list[str]]:
    """Return the routes that there are now, in the order of their topics.

    And a sentence for each topic or setting that has none.
    """
    problems = _adopt(seen, config)
    routes: list[Route] = []
    images: dict[str, str] = {}
    for route, rule in _candidates(seen, config):
        if not _wanted(route.cortex_topic, config):
            continue
        fitting = [change for change in config.routes if _fits(change, route)]
        asked = any(change.type is not None for change in fitting)
        there = asked or (rule.default and (config.defaults or bool(fitting)))
        if there and (not fitting or fitting[-1].enabled):
            routes.append(_changed(route, fitting, config, images))
    problems += _useless(seen, config) + _useless_options(routes, config)
    return _without_conflicts(routes, problems, shared_topics(config)), problems


def shared_topics(config: BridgeConfig) -> frozenset[str]:
    """Return the ROS topics on which several routes may publish."""
    return frozenset(config.ros_topic(name) for name in SHARED)


def known_options(route: Route) -> frozenset[str]:
    """Return the names of the options that a route has."""
    more = {"out": {"queue"}, "record": {"queue"}, "in": {"stale_s", "stamp"}, "call": set[str]()}
    return rule_of(route).options | more[route.direction]


def unfit(seen: Seen, config: BridgeConfig) -> list[str]:
    """Say which entries of `routes` fit nothing that is there, or that may have a route."""
    routes = [route for route, _ in _candidates(seen, config) if _wanted(route.cortex_topic, config)]
    found = []
    for number, change in enumerate(config.routes):
        if any(_fits(change, route) for route in routes):
            continue
        if any(fnmatchcase(route.cortex_topic, change.cortex) for route in routes):
            continue  # `_useless` says why
        near = difflib.get_close_matches(change.cortex, {route.cortex_topic for route in routes}, 1)
        hint = f", did you mean {near[0]}?" if near else ""
        found.append(f"routes[{number}]: no Cortex topic fits {change.cortex}{hint}")
    return found


def vehicle_of(topic: str) -> str:
    """Return whose topic it is: "drone" for /drone/imu, /drone/rgb/info or /drone/command/rates."""
    for end in (INFO, "/transform"):
        topic = topic.removesuffix(end)
    base, command, _ = topic.rpartition("/command/")
    return (base if command else topic.rpartition("/")[0]).strip("/")


def odometry_of(vehicle: str, seen: Seen) -> str | None:
    """Return the topic that says where a vehicle is: the one that moves it in tf, else any; or None."""
    topics = [
        t.topic
        for t in seen.topics
        if t.published
        and t.type_name == "cortex/Odometry"
        and _is_known(t)
        and vehicle_of(t.topic) == vehicle
    ]
    return min(topics, key=lambda topic: (topic.rpartition("/")[2] not in _TF_SOURCES, topic), default=None)


def _candidates(seen: Seen, config: BridgeConfig) -> list[tuple[Route, Rule]]:
    found = []
    calibrated = {rule.cortex_type for rule in rules() if rule.ros_type == "sensor_msgs/msg/CameraInfo"}
    pictures = {t.topic for t in seen.topics if t.type_name in calibrated - {"cortex/CameraInfo"}}
    for topic in seen.topics:
        if not _is_known(topic):
            continue
        for rule in rules():
            if rule.cortex_type != topic.type_name or rule.robot != config.robot:
                continue
            if not _may_go(rule, topic, config):
                continue
            if rule.cortex_type == "cortex/CameraInfo" and topic.topic.removesuffix(INFO) in pictures:
                continue  # goes with each picture, and with its stamp
            if rule.name == "/tf" and topic.topic.rpartition("/")[2] not in _TF_SOURCES:
                continue
            found.append((_route(rule, topic.topic), rule))
    for name, request in () if config.is_bag or config.robot else seen.services:
        found += [
            (_route(rule, name), rule)
            for rule in RULES
            if (rule.cortex_type, rule.direction) == (request, "call")
        ]
    return found


def _may_go(rule: Rule, topic: SeenTopic, config: BridgeConfig) -> bool:
    """Return whether a rule is for a topic that is published, or subscribed to, by others."""
    if topic.published:
        return rule.direction == "out" or (rule.direction == "record" and config.is_bag)
    return rule.direction == "in" and not config.is_bag


def _route(rule: Rule, topic: str) -> Route:
    return Route(
        cortex_topic=topic,
        cortex_type=rule.cortex_type,
        ros_topic=_name(rule.name, topic),
        ros_type=rule.ros_type,
        direction=rule.direction,
        qos=rule.qos,
    )


def _name(pattern: str, topic: str) -> str:
    """Fill in a name: {topic} itself, {parent} what it is /info of, {base} what it is a command for."""
    if "{parent}" in pattern and not topic.endswith(INFO):
        return topic
    base, command, _ = topic.rpartition("/command/")
    base = base if command else topic.rpartition("/")[0]
    return pattern.format(topic=topic, parent=topic.removesuffix(INFO), base=base)


def _is_known(topic: SeenTopic) -> bool:
    kind = CORTEX_TYPES.get(topic.type_name)
    if kind is None:
        added = ADDED.get(topic.type_name)
        return added is not None and added.fingerprint == topic.fingerprint
    return bool(schema_of(kind).fingerprint == topic.fingerprint)


def _wanted(topic: str, config: BridgeConfig) -> bool:
    return any(fnmatchcase(topic, pattern) for pattern in config.include) and not any(
        fnmatchcase(topic, pattern) for pattern in config.exclude
    )


def _useless_options(routes: Sequence[Route], config: BridgeConfig) -> list[str]:
    """Say which options no route has that their entry fits."""
    problems = []
    for number, change in enumerate(config.routes):
        known = {name for route in routes if _fits(change, route) for name in known_options(route)}
        problems += [
            f"routes[{number}].options: no route of {change.cortex} has the option {name!r}, "
            f"known: {', '.join(sorted(known))}"
            for name in change.options
            if known and name not in known  # without any, there is no such route now
        ]
    return problems


def _fits(change: RouteChange, route: Route) -> bool:
    return fnmatchcase(route.cortex_topic, change.cortex) and change.type in (None, route.ros_type)


def _changed(
    route: Route, changes: Sequence[RouteChange], config: BridgeConfig, images: dict[str, str]
) -> Route:
    """Apply the settings to a route: of its entries those that fit it.

    ROS topics of images that have been named so far, by Cortex topic, are in `images`, and are added to it.
    """
    name, named, label = route.ros_topic, False, ""
    qos: dict[str, Any] = {}
    options: dict[str, Any] = {}
    for change in changes:
        qos |= change.qos
        options |= change.options
        label = change.label if change.type is not None else label
        if change.ros is not None and (change.type is not None or _is_main(route)):
            name, named = change.ros.format(topic=route.cortex_topic), True
    if named and route.ros_type == "sensor_msgs/msg/Image":
        images[route.cortex_topic] = name
    if not named and route.ros_type == "sensor_msgs/msg/CameraInfo" and route.cortex_topic in images:
        name, named = images[route.cortex_topic].rpartition("/")[0] + "/camera_info", True
    if not named:
        old = max((o for o in config.rename if name == o or name.startswith(o + "/")), key=len, default=None)
        name = name if old is None else config.rename[old] + name[len(old) :]
    return dataclasses.replace(
        route,
        ros_topic=config.ros_topic(name),
        qos=dataclasses.replace(route.qos, **qos),
        options=options,
        label=label,
    )


def _is_main(route: Route) -> bool:
    """Whether it is the first of the routes that a topic has."""
    return next(rule for rule in rules() if rule.cortex_type == route.cortex_type).ros_type == route.ros_type


def _without_conflicts(routes: Iterable[Route], problems: list[str], shared: frozenset[str]) -> list[Route]:
    """Leave out what ROS would not allow or what would make a circle, and say so."""
    kept: dict[str, Route] = {}
    found: dict[tuple[str, str, str, str], Route] = {}
    for route in routes:
        other = kept.get(route.ros_topic)
        reason = ""
        if not is_ros_name(route.ros_topic):
            reason = "ROS allows no such name; rename it"
        elif other is not None and other.ros_type != route.ros_type:
            reason = f"{other} has that topic already, with type {other.ros_type}"
        elif other is not None and other.direction != route.direction:
            reason = f"{other} goes the other way on that topic"
        elif (
            other is not None
            and other.direction == "out"
            and other.cortex_topic != route.cortex_topic
            and route.ros_topic not in shared
        ):
            reason = f"{other} has that topic already; rename one of them"
        elif other is not None and other.qos != route.qos:
            reason = f"{other} has that topic already, with another quality of service"
        if reason:
            problems.append(f"no route {route} ({route.ros_type}): {reason}")
            continue
        kept.setdefault(route.ros_topic, route)
        found.setdefault(route.key, route)
    return list(found.values())


def _adopt(seen: Seen, config: BridgeConfig) -> list[str]:
    """Let published types cross that nothing is registered for; say which topics cannot be converted."""
    problems = []
    for topic in seen.topics:
        if not topic.published or not _wanted(topic.topic, config):
            continue
        name = topic.type_name
        if name in CORTEX_TYPES or name in ADDED:
            if not _is_known(topic):
                what = f"its {name} is of another version ({topic.fingerprint:016x}) than ours"
                problems.append(f"no route for {topic.topic}: {what}")
        elif not topic.schema:
            problems.append(f"no route for {topic.topic}: nothing converts its type {name}")
        elif reason := adopt(topic.schema, topic.fingerprint):
            problems.append(f"no route for {topic.topic} of type {name}: {reason}")
    return problems


def _useless(seen: Seen, config: BridgeConfig) -> list[str]:
    """Say which settings name a topic that is there, and a ROS type that it cannot have."""
    problems = []
    for change in config.routes:
        if change.type is None:
            continue
        types = sorted({rule.ros_type for rule in rules()})
        if change.type not in types:
            problems.append(f"routes: nothing converts to or from {change.type}, known: {', '.join(types)}")
            continue
        there = [
            topic for topic in seen.topics if _is_known(topic) and fnmatchcase(topic.topic, change.cortex)
        ]
        fitting = {rule.cortex_type for rule in rules() if rule.ros_type == change.type}
        if there and not any(topic.type_name in fitting for topic in there) and "*" not in change.cortex:
            known = sorted({r.ros_type for r in rules() if r.cortex_type == there[0].type_name})
            problems.append(
                f"routes: {change.cortex} is a {there[0].type_name}, which does not become a {change.type}, "
                f"but: {', '.join(known)}"
            )
    return problems


@functools.cache
def _request_type(name: str, number: int) -> str | None:
    """Return the type of a service's request, if it is one that the bridge calls."""
    reply = cortex.messages.SimulatorReply
    for rule in RULES:
        if rule.direction == "call" and service_number(name, CORTEX_TYPES[rule.cortex_type], reply) == number:
            return rule.cortex_type
    return None
