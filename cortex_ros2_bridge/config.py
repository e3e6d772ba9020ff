"""Settings of the bridge: a YAML file -> one frozen `BridgeConfig`. Every key is documented in README.md."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal

import yaml
from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    StrictBool,
    StrictInt,
    TypeAdapter,
    ValidationError,
)
from typing_extensions import TypedDict

from cortex_ros2_bridge.backend.base import Qos
from cortex_ros2_bridge.backend.names import NAME, check_kind, check_node_name
from cortex_ros2_bridge.frames import FrameNames
from cortex_ros2_bridge.options import OPTIONS, check_option
from cortex_ros2_bridge.ros_args import RosArguments, nest
from cortex_ros2_bridge.typestore import DISTROS

_ROS_TYPE = re.compile(r"[a-z][a-z0-9_]*/msg/[A-Z][A-Za-z0-9]*")
_SHORT_TYPE = re.compile(r"([a-z][a-z0-9_]*)/([A-Z][A-Za-z0-9]*)")

QOS: Mapping[str, Qos] = MappingProxyType(
    {
        "default": Qos(),
        "sensor_data": Qos(reliability="best_effort", depth=5),
        "latched": Qos(durability="transient_local", depth=1),
    }
)
"""Quality of service by the names that YAML may use."""
ROOTED = frozenset({"/clock", "/tf", "/tf_static", "/diagnostics"})
"""ROS topics that every node expects under these very names: a namespace goes before them on request only."""


class ConfigError(ValueError):
    """The settings are wrong; the message names the key, its value and what is allowed."""


def is_ros_name(name: str) -> bool:
    """Return whether ROS allows an absolute topic of this name."""
    return NAME.fullmatch(name) is not None and "__" not in name and not name.endswith("_")


def _ros_name(text: str) -> str:
    if not is_ros_name(text):
        raise ValueError(f"must be a ROS name such as '/drone/imu', parts begin with a letter, got {text!r}")
    return text


def _ros_pattern(text: str) -> str:
    _ros_name(text.replace("{topic}", "/topic"))
    return text


def _namespace(value: str) -> str:
    """Return a namespace with a slash in front and none behind; "" for none."""
    text = value.strip("/")
    return _ros_name(f"/{text}") if text else ""


def _topic_pattern(text: str) -> str:
    if not text.startswith(("/", "*")):
        raise ValueError(f"must be a Cortex topic such as '/drone/imu' or a pattern, got {text!r}")
    return text


def to_ros_type(value: str) -> str:
    """Return a type as ROS 2 writes it: sensor_msgs/msg/Imu, also for sensor_msgs/Imu."""
    text = _SHORT_TYPE.sub(r"\1/msg/\2", value) if value.count("/") == 1 else value
    if not _ROS_TYPE.fullmatch(text):
        raise ValueError(f"must be a ROS type such as sensor_msgs/msg/Imu, got {value!r}")
    return text


def _distro(text: str) -> str:
    if text not in DISTROS:
        raise ValueError(f"must be one of {', '.join(DISTROS)}, got {text!r}")
    return text


def _named_qos(value: Any) -> Any:
    if isinstance(value, str):
        if value not in QOS:
            raise ValueError(f"unknown quality of service {value!r}, known: {', '.join(QOS)}")
        return asdict(QOS[value])
    return value


def _options(given: dict[str, Any]) -> dict[str, Any]:
    for name, option in given.items():
        if name not in OPTIONS:
            raise ValueError(_unknown(name, list(OPTIONS)))
        check_option(name, option)
    return given


def _unknown(name: str, known: list[str]) -> str:
    near = difflib.get_close_matches(name, known, 1)
    return f"unknown key {name!r}, known: {', '.join(known)}" + (
        f", did you mean {near[0]!r}?" if near else ""
    )


def _without_nulls(value: Any) -> Any:
    """Leave out keys without a value: they have their default."""
    return {k: v for k, v in value.items() if v is not None} if isinstance(value, Mapping) else value


RosName = Annotated[str, AfterValidator(_ros_name)]
TopicPattern = Annotated[str, AfterValidator(_topic_pattern)]
_NO_OTHERS = ConfigDict(extra="forbid")


class QosChanges(TypedDict, total=False):
    """Changed policies of a quality of service."""

    __pydantic_config__ = _NO_OTHERS  # type: ignore[misc]

    reliability: Literal["reliable", "best_effort"]
    durability: Literal["volatile", "transient_local"]
    depth: Annotated[StrictInt, Field(ge=1, le=100_000)]


@dataclass(frozen=True, kw_only=True)
class RouteChange:
    """One entry of `routes`: changes of the routes that it matches, or a route of its own."""

    __pydantic_config__: ClassVar[ConfigDict] = _NO_OTHERS

    cortex: TopicPattern
    """Cortex topic, or a pattern with * and ?."""
    type: Annotated[str, AfterValidator(to_ros_type)] | None = None
    """ROS type of the matched routes; where none has it by default, a route of this type is added."""
    ros: Annotated[str, AfterValidator(_ros_pattern)] | None = None
    """ROS topic instead of the default one; {topic} stands for the Cortex topic."""
    qos: Annotated[QosChanges, BeforeValidator(_named_qos)] = field(default_factory=QosChanges)
    """Changed policies of the quality of service."""
    options: Annotated[dict[str, Any], AfterValidator(_options)] = field(default_factory=dict)
    """Options of the conversion, see README.md."""
    enabled: StrictBool = True
    label: str = ""
    """Name of the entry among ROS parameters: `routes.LABEL.qos`."""

    def __post_init__(self) -> None:
        if self.ros and "{topic}" not in self.ros and any(c in self.cortex for c in "*?["):
            raise ValueError(
                f"ros: a pattern fits several topics: the name must contain {{topic}}, got {self.ros!r}"
            )


@dataclass(frozen=True, kw_only=True)
class BridgeConfig:
    """Settings of the bridge."""

    __pydantic_config__: ClassVar[ConfigDict] = _NO_OTHERS

    backend: Annotated[str, AfterValidator(check_kind)] = "auto"
    """ROS side of the bridge: auto, rclpy, dds, or the name of a bag: run.mcap."""
    distro: Annotated[str, AfterValidator(_distro)] | None = None
    """ROS distribution, such as jazzy; None: ROS_DISTRO, or what other nodes show."""
    cortex_domain: Annotated[StrictInt, Field(ge=0)] | None = None
    """Cortex domain; None: CORTEX_DOMAIN. The ROS domain is ROS_DOMAIN_ID."""
    node: Annotated[str, AfterValidator(lambda name: check_node_name(name, "")[0])] = "cortex_bridge"
    """Name of the ROS node."""
    namespace: Annotated[str, AfterValidator(_namespace)] = ""
    """Prefix of all ROS topics but /clock, /tf, /tf_static and /diagnostics."""
    isolate: StrictBool = False
    """Whether the namespace is also a prefix of these topics and of the names of frames."""
    frames: Annotated[FrameNames, BeforeValidator(_without_nulls)] = field(default_factory=FrameNames)
    """Names of frames in ROS."""
    autostart: StrictBool = True
    """Whether the node starts active; false: ROS configures and activates it, as a managed node."""
    defaults: StrictBool = True
    """Whether topics without an entry in `routes` get their default routes."""
    robot: StrictBool = False
    """Whether a controller in Cortex flies a robot in ROS: then its odometry and events come in, its commands
    go out, and nothing else passes."""
    include: tuple[TopicPattern, ...] = ("*",)
    """Cortex topics that may be bridged: patterns with * and ?."""
    exclude: tuple[TopicPattern, ...] = ()
    """Cortex topics that are not bridged: patterns with * and ?."""
    rename: dict[RosName, RosName] = field(default_factory=dict)
    """Prefixes of ROS topics to replace: {/drone/rgb: /front} makes /front/image_raw of an image."""
    routes: tuple[Annotated[RouteChange, BeforeValidator(_without_nulls)], ...] = ()
    """Changes of routes, in order; later entries win."""
    converters: tuple[Annotated[str, Field(min_length=1)], ...] = ()
    """Python modules, or .py files, that register conversions."""
    ros: RosArguments = field(default_factory=RosArguments)
    """ROS arguments after `--ros-args`; not a key of the file."""

    def __post_init__(self) -> None:
        if self.is_bag and not self.autostart:
            raise ValueError(f"autostart: false: nobody can activate a bag ({self.backend})")
        if self.is_bag and self.robot:
            raise ValueError(f"robot: true: nothing comes out of a bag ({self.backend})")

    @property
    def is_bag(self) -> bool:
        """Whether all goes into a bag, and nobody answers."""
        return self.backend.endswith(".mcap")

    def ros_topic(self, name: str) -> str:
        """Return the full name of a topic or service in ROS: with its namespace, and remapped."""
        full = name if name in ROOTED and not self.isolate else self.namespace + name
        return self.ros.remap(full, self.node, self.namespace)

    @property
    def frame_names(self) -> FrameNames:
        """Names of frames, with the namespace before them where it isolates."""
        if not self.isolate or self.frames.prefix or not self.namespace:
            return self.frames
        return replace(self.frames, prefix=f"{self.namespace.strip('/')}/")


def load(
    source: str | Path | Mapping[str, Any] | None, parameters: Mapping[str, Any] | None = None
) -> BridgeConfig:
    """Read settings and check them.

    Args:
        source: A YAML file, a mapping with the same keys, or None for the defaults.
        parameters: ROS parameters by their dotted names, such as {"frames.map": "world"}; they win. Entries
            of `routes` have labels here: {"routes.imu.cortex": "/drone/imu", "routes.imu.qos": "latched"}.
    """
    if isinstance(source, str | Path):
        try:
            raw = yaml.safe_load(Path(source).read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise ConfigError(f"cannot read {source}: {reason}") from None
        except yaml.YAMLError as error:
            raise ConfigError(f"{source} is not YAML: {' '.join(str(error).split())}") from None
    else:
        raw = source
    try:
        return _bridge_config(_merged({} if raw is None else raw, nest(parameters or {})))
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}" if isinstance(source, str | Path) else str(error)) from None


def _merged(raw: object, parameters: Mapping[str, Any]) -> object:
    """Return settings with parameters put in."""
    if not parameters or not isinstance(raw, Mapping):
        return raw
    given = dict(raw)
    for key, value in parameters.items():
        if key == "routes" and isinstance(value, Mapping):
            entries = [dict(entry) if isinstance(entry, Mapping) else entry for entry in given.get(key) or []]
            labelled = {entry.get("label"): entry for entry in entries if isinstance(entry, dict)}
            for label, changes in value.items():
                if label not in labelled:
                    labelled[label] = {"label": label}
                    entries.append(labelled[label])
                for name, change in changes.items() if isinstance(changes, Mapping) else ():
                    before = labelled[label].get(name)
                    if isinstance(before, Mapping) and isinstance(change, Mapping):
                        change = {**before, **change}
                    labelled[label][name] = change
            given[key] = entries
        elif isinstance(value, Mapping) and isinstance(given.get(key), Mapping):
            given[key] = {**given[key], **value}
        else:
            given[key] = value
    return given


SETTINGS = tuple(each.name for each in fields(BridgeConfig) if each.name != "ros")
"""Names of all settings."""
_WORDS = {
    **dict.fromkeys(("dataclass_type", "dict_type"), "must be a mapping"),
    **{"tuple_type": "must be a list", "bool_type": "must be true or false"},
}
_OWNERS: dict[int | str, type[Any]] = {"routes": RouteChange, "frames": FrameNames, "qos": QosChanges}


def _bridge_config(raw: object) -> BridgeConfig:
    given = _without_nulls(raw)
    if isinstance(given, dict) and "ros" in given:  # a field, but no setting
        raise ConfigError(_unknown("ros", list(SETTINGS)))
    if isinstance(given, dict) and "domain" in given:  # its old name, easily taken for that of ROS
        given = {"cortex_domain": given["domain"], **{k: v for k, v in given.items() if k != "domain"}}
    try:
        return TypeAdapter(BridgeConfig).validate_python(given)
    except ValidationError as error:
        raise ConfigError(_explain(error)) from None


def _explain(error: ValidationError) -> str:
    """Say what the first of the errors is, and of which key."""
    item = error.errors()[0]
    loc = [part for part in item["loc"] if part != "[key]"]
    text = item["msg"].removeprefix("Value error, ")
    *groups, key = ["", *(f"[{part}]" if isinstance(part, int) else f".{part}" for part in loc)]
    place = "".join(groups).lstrip(".")
    if item["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
        owner = next((_OWNERS[part] for part in reversed(loc[:-1]) if part in _OWNERS), None)
        known = SETTINGS if owner is None else [n for n in owner.__annotations__ if not n.startswith("__")]
        text = _unknown(str(loc[-1]), list(known))
        return f"{place}: {text}" if place else text
    place = f"{place}{key}".lstrip(".")
    if item["type"] == "value_error":
        return (
            text
            if not place or text.startswith(place)
            else f"{place}{' ' if text.startswith('must') else ': '}{text}"
        )
    if item["type"] == "missing":
        return f"{place} is missing"
    words = f" {_WORDS[item['type']]}" if item["type"] in _WORDS else f": {text}"
    return f"{place or 'the settings'}{words}, got {item['input']!r:.80}"
