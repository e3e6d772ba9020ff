"""The arguments after `--ros-args`: names, remappings, parameters and log levels, for every backend alike.

    -r [NODE:]FROM:=TO    FROM: a topic, a service, __node or __ns        -p [NODE:]NAME:=VALUE
    --params-file FILE    --log-level LEVEL

Names are expanded as ROS expands them: `/x` stays, `x` is put under the namespace, `~/x` under the node.
Reference: design.ros2.org, "Topic and Service name mapping to DDS", "Remapping Names", "Parameters".
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from cortex_ros2_bridge.backend.names import check_node_name

LOG_LEVELS: Mapping[str, int] = {"debug": 10, "info": 20, "warn": 30, "error": 40, "fatal": 50}
"""Levels by their names in ROS."""
_TWO = (
    *("-r", "--remap", "-p", "--param", "--params-file"),
    *("--log-level", "--log-config-file", "-e", "--enclave"),
)
_IGNORED = re.compile(r"--(en|dis)able-(rosout|stdout|external-lib)-logs?")
_SCHEME = re.compile(r"ros(topic|service)://")


class RosArgumentError(ValueError):
    """An argument after `--ros-args` is not what ROS allows."""


@dataclass(frozen=True, kw_only=True)
class RosArguments:
    """What the arguments ask for."""

    remaps: tuple[tuple[str, str, str], ...] = ()
    """Node that a rule is for ("" for any), from, to; in order."""
    parameters: tuple[tuple[str, str, Any], ...] = ()
    """Node or pattern of nodes, name, value; in order, later ones win."""
    log_level: int | None = None
    """As in `logging`."""
    useless: tuple[str, ...] = field(default=())
    """Arguments that are allowed, and have no effect here."""

    def names(self, node: str, namespace: str) -> tuple[str, str]:
        """Return name and namespace of a node, "" for none, by its rules `__node` and `__ns`."""
        new = {"__node": node, "__ns": namespace}
        for name in new:
            keys = (name, "__name") if name == "__node" else (name,)
            found = [to for only, rule, to in self.remaps if rule in keys and only in ("", node)]
            new[name] = found[0] if found else new[name]
        try:
            name, space = check_node_name(new["__node"], new["__ns"])
        except ValueError as error:
            raise RosArgumentError(f"--ros-args: {error}") from None
        return name, "" if space == "/" else space

    def remap(self, name: str, node: str, namespace: str) -> str:
        """Return what a topic or a service is called after the first rule that fits."""
        for only, rule, to in self.remaps:
            if only not in ("", node) or rule.startswith("__"):
                continue
            if expand(_SCHEME.sub("", rule), node, namespace) == name:
                return expand(to, node, namespace)
        return name

    def parameters_of(self, node: str, namespace: str) -> dict[str, Any]:
        """Return the parameters of a node by their dotted names."""
        full = f"{namespace}/{node}"
        return {name: value for where, name, value in self.parameters if _fits(where, node, full)}


def split(arguments: Sequence[str]) -> tuple[list[str], RosArguments]:
    """Return the arguments that are not of ROS, and what those of ROS ask for.

    Raises:
        RosArgumentError: One is unknown, incomplete or malformed, or a file of parameters cannot be read.
    """
    others: list[str] = []
    remaps, parameters, useless = [], [], []
    level = None
    words, of_ros = iter(arguments), False
    for word in words:
        if word in ("--ros-args", "--") and (word == "--ros-args") != of_ros:
            of_ros = not of_ros
        elif not of_ros:
            others.append(word)
        elif word in _TWO:
            value = next(words, None)
            if value is None:
                raise RosArgumentError(f"--ros-args: {word} needs a value")
            if word in ("-r", "--remap"):
                remaps.append(_rule(word, value))
            elif word in ("-p", "--param"):
                where, name, text = _rule(word, value)
                parameters.append((where or "/**", name, _yaml(f"{word} {value}", text)))
            elif word == "--params-file":
                parameters += _file(Path(value))
            elif word == "--log-level":
                level = _level(value)
            else:
                useless.append(f"{word} {value}")
        elif _IGNORED.fullmatch(word):
            useless.append(word)
        else:
            raise RosArgumentError(f"--ros-args: unknown argument {word!r}, known: {', '.join(_TWO)}")
    return others, RosArguments(
        remaps=tuple(remaps), parameters=tuple(parameters), log_level=level, useless=tuple(useless)
    )


def expand(name: str, node: str, namespace: str) -> str:
    """Return the full name of a topic or a service."""
    name = name.replace("{node}", node).replace("{ns}", namespace).replace("{namespace}", namespace)
    if name.startswith("~"):
        return f"{namespace}/{node}{name[1:]}"
    return name if name.startswith("/") else f"{namespace}/{name}"


def _rule(word: str, text: str) -> tuple[str, str, str]:
    """Split `[NODE:]NAME:=VALUE`."""
    left, given, right = text.partition(":=")
    scheme = _SCHEME.match(left)
    node, colon, name = ("", "", left) if scheme else left.rpartition(":")
    if not given or not name or (colon and not node):
        raise RosArgumentError(f"--ros-args: {word} takes [NODE:]NAME:=VALUE, got {text!r}")
    return node, name, right


def _level(text: str) -> int | None:
    name, _, level = text.rpartition(":=")
    if level.lower() not in LOG_LEVELS:
        raise RosArgumentError(f"--ros-args: --log-level is one of {', '.join(LOG_LEVELS)}, got {text!r}")
    return None if name and not name.startswith("cortex") else LOG_LEVELS[level.lower()]


def _yaml(what: str, text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise RosArgumentError(f"--ros-args: {what}: not YAML: {' '.join(str(error).split())}") from None


def _file(path: Path) -> list[tuple[str, str, Any]]:
    """Return the parameters of a file, with the patterns of nodes that they are for."""
    try:
        content = _yaml(str(path), path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise RosArgumentError(f"--ros-args: cannot read {path}: {error}") from None
    if not isinstance(content, Mapping):
        raise RosArgumentError(
            f"--ros-args: {path}: it must map nodes to ros__parameters, got {content!r:.80}"
        )
    return list(_walk(content, "", path))


def _walk(content: Mapping[str, Any], where: str, path: Path) -> Iterator[tuple[str, str, Any]]:
    for key, value in content.items():
        if not isinstance(value, Mapping):
            raise RosArgumentError(
                f"--ros-args: {path}: {where or '/'}: {key!r} must be a mapping with ros__parameters"
            )
        if key == "ros__parameters":
            yield from ((where, name, leaf) for name, leaf in flatten(value))
        else:
            yield from _walk(value, f"{where}/{str(key).strip('/')}" if where else str(key), path)


def flatten(content: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the leaves of nested mappings, with dotted names."""
    for key, value in content.items():
        if isinstance(value, Mapping) and value:
            yield from flatten(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", value


def nest(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested mappings of dotted names; the inverse of `flatten`."""
    nested: dict[str, Any] = {}
    for name, value in flat.items():
        *groups, last = name.split(".")
        place = nested
        for group in groups:
            inner = place.setdefault(group, {})
            if not isinstance(inner, dict):
                inner = place[group] = {}
            place = inner
        place[last] = value
    return nested


def _fits(where: str, node: str, full: str) -> bool:
    """Return whether a node is meant: by its name, or by a path in which * is any part and ** any parts."""
    if where == node:
        return True
    parts = re.escape(where if where.startswith("/") else f"/{where}")
    pattern = parts.replace(r"/\*\*", "(/[^/]+)*").replace(r"\*", "[^/]+")
    return re.fullmatch(pattern, full) is not None
