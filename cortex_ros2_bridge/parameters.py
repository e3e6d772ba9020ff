"""ROS parameters of the bridge: its settings and the routes, for `ros2 param` and launch files.

The services of parameters are answered here, for every backend alike. A parameter that is set makes new
settings, which are checked like a file; the routes that they change are opened anew.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from cortex_ros2_bridge.backend.base import Backend
from cortex_ros2_bridge.backend.names import service_path
from cortex_ros2_bridge.bridge import Bridge
from cortex_ros2_bridge.config import BridgeConfig, RouteChange
from cortex_ros2_bridge.msgs import message_class
from cortex_ros2_bridge.options import OPTIONS
from cortex_ros2_bridge.parameter_values import kind_of, message_of, value_of
from cortex_ros2_bridge.routes import Route, known_options

logger = logging.getLogger(__name__)

_FIXED = ("backend", "distro", "cortex_domain", "node", "namespace", "isolate", "autostart")
"""Settings that hold from the start to the end."""
_LIVE = ("defaults", "include", "exclude")


class Described(NamedTuple):
    """One parameter."""

    value: Any
    text: str
    """What it means."""
    fixed: bool


class Parameters:
    """Answers the six services of parameters, until it is closed.

    `make` makes settings of parameters by their dotted names, and raises `ValueError` for wrong ones; `given`
    are those of the start.
    """

    def __init__(
        self,
        bridge: Bridge,
        backend: Backend,
        make: Callable[[Mapping[str, Any]], BridgeConfig],
        given: Mapping[str, Any],
    ) -> None:
        self._bridge = bridge
        self._make = make
        self._given = dict(given)
        self._lock = threading.Lock()
        self._resources = contextlib.ExitStack()
        node = f"{bridge.config.namespace}/{bridge.config.node}"
        for name, answer in (
            ("DescribeParameters", self._describe),
            ("GetParameterTypes", self._types),
            ("GetParameters", self._get),
            ("ListParameters", self._list),
            ("SetParameters", self._set),
            ("SetParametersAtomically", self._set_together),
        ):
            service = backend.service(f"{node}/{service_path(name)}", f"rcl_interfaces/srv/{name}", answer)
            self._resources.callback(service.close)
        self.close = self._resources.close  # withdraws the services

    def all(self) -> dict[str, Described]:
        """Return all parameters by their names."""
        config = self._bridge.config
        texts = "README.md of cortex_ros2_bridge, Settings"
        found = {name: Described(_plain(getattr(config, name)), texts, True) for name in _FIXED}
        for field in dataclasses.fields(config.frames):
            if field.name != "rename":
                value = getattr(config.frames, field.name)
                found[f"frames.{field.name}"] = Described(value, "name of a frame in ROS", True)
        found |= {name: Described(_plain(getattr(config, name)), texts, False) for name in _LIVE}
        routes = {label_of(route): route for route in self._bridge.routes()}
        entries = {change.label: change for change in config.routes if change.label}
        for label in sorted({*routes, *entries}):
            for name, described in _of_route(routes.get(label), entries.get(label)):
                found[f"routes.{label}.{name}"] = described
        return {name: each for name, each in found.items() if each.value is not None}

    def set(self, changes: Mapping[str, Any]) -> str:
        """Change parameters, all or none; returns why that is not possible, empty if it was done."""
        with self._lock:
            known = self.all()
            for name in changes:
                if name not in known and not name.startswith(("routes.", "rename.")):  # those may be new
                    return f"unknown parameter {name!r}"
                if name in known and known[name].fixed:
                    return f"{name} holds from the start to the end of the bridge"
            given = {**self._given, **changes}
            routes = {label_of(route): route for route in self._bridge.routes()}
            for label in {name.split(".")[1] for name in given if name.startswith("routes.")}:
                if label in routes:  # an entry of the settings begins with what it fits
                    given.setdefault(f"routes.{label}.cortex", routes[label].cortex_topic)
                    given.setdefault(f"routes.{label}.type", routes[label].ros_type)
            try:
                self._bridge.reconfigure(self._make(given))
            except ValueError as error:
                return str(error)
            self._given = given
        logger.info("set %s", ", ".join(f"{name} = {value!r}" for name, value in changes.items()))
        return ""

    # Services

    def _describe(self, request: Any, response: Any) -> Any:
        known = self.all()
        make = message_class("rcl_interfaces/msg/ParameterDescriptor")
        found = [(name, known.get(name, Described(None, "", False))) for name in request.names]
        response.descriptors = [
            make(name=name, type=kind_of(each.value)[0], description=each.text, read_only=each.fixed)
            for name, each in found
        ]
        return response

    def _types(self, request: Any, response: Any) -> Any:
        known = self.all()
        response.types = bytes(kind_of(known[n].value)[0] if n in known else 0 for n in request.names)
        return response

    def _get(self, request: Any, response: Any) -> Any:
        known = self.all()
        response.values = [message_of(known[n].value if n in known else None) for n in request.names]
        return response

    def _list(self, request: Any, response: Any) -> Any:
        names = [
            name
            for name in self.all()
            if (not request.prefixes or any(name == p or name.startswith(f"{p}.") for p in request.prefixes))
            and (not request.depth or name.count(".") < request.depth)
        ]
        response.result.names = names
        response.result.prefixes = sorted({name.rpartition(".")[0] for name in names if "." in name})
        return response

    def _set(self, request: Any, response: Any) -> Any:
        response.results = [self._result([parameter]) for parameter in request.parameters]
        return response

    def _set_together(self, request: Any, response: Any) -> Any:
        response.result = self._result(request.parameters)
        return response

    def _result(self, parameters: Iterable[Any]) -> Any:
        reason = self.set({parameter.name: value_of(parameter.value) for parameter in parameters})
        make = message_class("rcl_interfaces/msg/SetParametersResult")
        return make(successful=not reason, reason=reason)


def label_of(route: Route) -> str:
    """Return the name of a route among parameters: its label in the settings, else what it connects."""
    if route.label:
        return route.label
    names = [route.cortex_topic, route.ros_type.rpartition("/")[2]]
    return "_".join(name.strip("/").replace("/", "_") for name in names)


def _of_route(route: Route | None, entry: RouteChange | None) -> Iterable[tuple[str, Described]]:
    """Yield the parameters of a route that is open, or of an entry of the settings, or of both."""
    yield "enabled", Described(entry is None or entry.enabled, "whether the route is open", False)
    if entry is not None:
        yield "cortex", Described(entry.cortex, "Cortex topic, or a pattern", route is not None)
    if route is None:
        return
    if entry is None:
        yield "cortex", Described(route.cortex_topic, "Cortex topic", True)
    yield "type", Described(route.ros_type, "type in ROS", True)
    yield "ros", Described(route.ros_topic, "topic in ROS", False)
    for name, value in dataclasses.asdict(route.qos).items():
        yield f"qos.{name}", Described(value, "quality of service", False)
    for name in sorted(known_options(route)):
        value = route.options.get(name, OPTIONS[name].default)
        yield f"options.{name}", Described(value, f"must be {OPTIONS[name].must}", False)


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
