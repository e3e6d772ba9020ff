"""Settings of the bridge: a YAML file -> one frozen `BridgeConfig`. Every key is documented in README.md."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml

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
    """The settings are wrong; the message names the key, its value and what is allowed.

    All that takes a key and its value here raises it.
    """


@dataclass(frozen=True, kw_only=True)
class RouteChange:
    """One entry of `routes`: what is different for the routes that it fits, or a route of its own."""

    cortex: str
    """Cortex topic, or a pattern with * and ?."""
    type: str | None = None
    """Only routes of this ROS type; where there is none by default, it is added."""
    ros: str | None = None
    """ROS topic instead of the default one; {topic} stands for the Cortex topic."""
    qos: Mapping[str, Any] = field(default_factory=dict)
    """Elements of the quality of service that are different."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of the conversion, see README.md."""
    enabled: bool = True
    label: str = ""
    """Name of the entry among ROS parameters: `routes.LABEL.qos`."""


@dataclass(frozen=True, kw_only=True)
class BridgeConfig:
    """What the bridge does."""

    backend: str = "auto"
    """auto, rclpy, dds, or the name of a bag: run.mcap."""
    distro: str | None = None
    """ROS distribution, such as jazzy; None: ROS_DISTRO, or what the other nodes show."""
    cortex_domain: int | None = None
    """Domain of Cortex; None: CORTEX_DOMAIN. That of ROS is ROS_DOMAIN_ID."""
    node: str = "cortex_bridge"
    """Name of the ROS node."""
    namespace: str = ""
    """Goes before all ROS topics but /clock, /tf, /tf_static and /diagnostics."""
    isolate: bool = False
    """Whether the namespace goes before these, too, and before the names of frames."""
    frames: FrameNames = field(default_factory=FrameNames)
    """Names of frames in ROS."""
    autostart: bool = True
    """Whether it begins active; else ROS configures and activates it, as a managed node."""
    defaults: bool = True
    """Whether topics have routes that no entry of `routes` asks for."""
    robot: bool = False
    """Whether a robot in ROS is flown by a controller in Cortex: then its odometry and events come in, its
    commands go out, and nothing else passes."""
    include: tuple[str, ...] = ("*",)
    """Cortex topics that may have routes: patterns with * and ?."""
    exclude: tuple[str, ...] = ()
    """Cortex topics that may not."""
    rename: Mapping[str, str] = field(default_factory=dict)
    """Beginnings of ROS topics to replace: {/drone/rgb: /front} makes /front/image_raw of an image."""
    routes: tuple[RouteChange, ...] = ()
    """Changes, in order; later ones win."""
    converters: tuple[str, ...] = ()
    """Modules, or .py files, that register conversions."""
    ros: RosArguments = field(default_factory=RosArguments)
    """What followed `--ros-args`; no setting of the file."""

    def __post_init__(self) -> None:
        if self.is_bag and not self.autostart:
            raise ConfigError(f"autostart: false: nobody can activate a bag ({self.backend})")
        if self.is_bag and self.robot:
            raise ConfigError(f"robot: true: nothing comes out of a bag ({self.backend})")

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


def _namespace(key: str, value: object) -> str:
    """Return a namespace with a slash in front and none behind; "" for none."""
    if not isinstance(value, str):
        raise ConfigError(f"{key} must be a text, got {value!r:.80}")
    text = value.strip("/")
    return _ros_name(key, f"/{text}") if text else ""


def is_ros_name(name: str) -> bool:
    """Return whether ROS allows an absolute topic of this name."""
    return NAME.fullmatch(name) is not None and "__" not in name and not name.endswith("_")


def to_ros_type(key: str, value: object) -> str:
    """Return a type as ROS 2 writes it: sensor_msgs/msg/Imu, also for sensor_msgs/Imu."""
    text = _SHORT_TYPE.sub(r"\1/msg/\2", _text(key, value)) if str(value).count("/") == 1 else value
    if not isinstance(text, str) or not _ROS_TYPE.fullmatch(text):
        raise ConfigError(f"{key} must be a ROS type such as sensor_msgs/msg/Imu, got {value!r}")
    return text


def qos_changes(key: str, value: object) -> dict[str, Any]:
    """Return the elements of a quality of service that YAML sets: a name of `QOS`, or a mapping."""
    if isinstance(value, str):
        if value not in QOS:
            raise ConfigError(f"{key}: unknown quality of service {value!r}, known: {', '.join(QOS)}")
        return {name.name: getattr(QOS[value], name.name) for name in fields(Qos)}
    changes = _mapping(key, value)
    allowed: dict[str, tuple[str, ...] | None] = {
        "reliability": ("reliable", "best_effort"),
        "durability": ("volatile", "transient_local"),
        "depth": None,
    }
    _refuse_unknown(key, changes, allowed)
    for name, element in changes.items():
        known = allowed[name]
        if known is None:
            if isinstance(element, bool) or not isinstance(element, int) or not 1 <= element <= 100_000:
                raise ConfigError(f"{key}.{name} must be an integer from 1 to 100000, got {element!r}")
        elif element not in known:
            raise ConfigError(f"{key}.{name} must be one of {', '.join(known)}, got {element!r}")
    return dict(changes)


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


def _bridge_config(raw: object) -> BridgeConfig:
    given = dict(_mapping("the settings", raw))
    if "domain" in given:  # its old name, which is easily taken for that of ROS
        given.setdefault("cortex_domain", given.pop("domain"))
    _refuse_unknown("", given, SETTINGS)
    return BridgeConfig(
        **{key: SETTINGS[key](key, value) for key, value in given.items() if value is not None}
    )


def _checked(key: str, check: Callable[..., Any], *values: Any) -> Any:
    try:
        return check(*values)
    except ValueError as error:
        raise ConfigError(f"{key}: {error}") from None


def _backend(key: str, value: object) -> Any:
    return _checked(key, check_kind, _text(key, value))


def _distro(key: str, value: object) -> str:
    text = _text(key, value)
    if text not in DISTROS:
        raise ConfigError(f"{key} must be one of {', '.join(DISTROS)}, got {text!r}")
    return text


def _cortex_domain(key: str, value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ConfigError(f"{key} must be an integer >= 0, got {value!r}")
    return value


def _node_name(key: str, value: object) -> Any:
    return _checked(key, check_node_name, _text(key, value), "")[0]


def _frame_names(key: str, value: object) -> FrameNames:
    given = _mapping(key, value)
    _refuse_unknown(key, given, [f.name for f in fields(FrameNames)])
    try:
        return FrameNames(**{name: text for name, text in given.items() if text is not None})
    except (TypeError, ValueError, AttributeError) as error:
        raise ConfigError(str(error)) from None


def _patterns(key: str, value: object) -> tuple[str, ...]:
    return tuple(_topic_pattern(f"{key}[{n}]", item) for n, item in _items(key, value))


def _renames(key: str, value: object) -> dict[str, str]:
    pairs = _mapping(key, value).items()
    return {_ros_name(key, old): _ros_name(f"{key}.{old}", new) for old, new in pairs}


def _options(key: str, value: object) -> dict[str, Any]:
    given = _mapping(key, value)
    _refuse_unknown(key, given, OPTIONS)
    for name, option in given.items():
        _checked(key, check_option, name, option)
    return dict(given)


def _route_change(key: str, value: object) -> RouteChange:
    given = _mapping(key, value)
    checks: dict[str, Callable[[str, object], Any]] = {
        "cortex": _topic_pattern,
        "type": to_ros_type,
        "ros": _ros_pattern,
        "qos": qos_changes,
        "options": _options,
        "enabled": _flag,
        "label": _text,
    }
    _refuse_unknown(key, given, checks)
    if "cortex" not in given:
        raise ConfigError(f"{key}: `cortex` is missing: the topic, or a pattern such as '/*/imu'")
    change = RouteChange(
        **{name: checks[name](f"{key}.{name}", each) for name, each in given.items() if each is not None}
    )
    if change.ros and "{topic}" not in change.ros and any(c in change.cortex for c in "*?["):
        raise ConfigError(
            f"{key}.ros: a pattern fits several topics: the name must contain {{topic}}, got {change.ros!r}"
        )
    return change


def _ros_pattern(key: str, value: object) -> str:
    text = _text(key, value)
    _ros_name(key, text.replace("{topic}", "/topic"))
    return text


def _refuse_unknown(key: str, given: Mapping[str, Any], known: Iterable[str]) -> None:
    names = list(known)
    for name in given:
        if name not in names:
            near = difflib.get_close_matches(str(name), names, 1)
            hint = f", did you mean {near[0]!r}?" if near else ""
            where = f"{key}: " if key else ""
            raise ConfigError(f"{where}unknown key {name!r}, known: {', '.join(names)}{hint}")


def _mapping(key: str, value: object) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ConfigError(f"{key} must be a mapping, got {value!r:.80}")
    return value


def _items(key: str, value: object) -> Iterable[tuple[int, object]]:
    if not isinstance(value, list | tuple):
        raise ConfigError(f"{key} must be a list, got {value!r:.80}")
    return enumerate(value)


def _text(key: str, value: object) -> str:
    if not isinstance(value, str) or not value:
        raise ConfigError(f"{key} must be a text that is not empty, got {value!r:.80}")
    return value


def _flag(key: str, value: object) -> bool:
    if not isinstance(value, bool):
        raise ConfigError(f"{key} must be true or false, got {value!r:.80}")
    return value


def _topic_pattern(key: str, value: object) -> str:
    text = _text(key, value)
    if not text.startswith(("/", "*")):
        raise ConfigError(f"{key} must be a Cortex topic such as '/drone/imu' or a pattern, got {text!r}")
    return text


def _ros_name(key: str, value: object) -> str:
    text = _text(key, value)
    if not is_ros_name(text):
        raise ConfigError(
            f"{key} must be a ROS name such as '/drone/imu', parts begin with a letter, got {text!r}"
        )
    return text


SETTINGS: Mapping[str, Callable[[str, object], Any]] = {
    "backend": _backend,
    "distro": _distro,
    "cortex_domain": _cortex_domain,
    "node": _node_name,
    "namespace": _namespace,
    "frames": _frame_names,
    "isolate": _flag,
    "autostart": _flag,
    "defaults": _flag,
    "robot": _flag,
    "include": _patterns,
    "exclude": _patterns,
    "rename": _renames,
    "converters": lambda key, value: tuple(_text(f"{key}[{n}]", item) for n, item in _items(key, value)),
    "routes": lambda key, value: tuple(_route_change(f"{key}[{n}]", item) for n, item in _items(key, value)),
}
"""What makes the value of each setting of what YAML says."""
