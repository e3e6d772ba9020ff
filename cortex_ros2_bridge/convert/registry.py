"""Conversions that users add, both directions of a type in one file; and those that follow from a schema.

    @to_ros(Battery, "sensor_msgs/msg/BatteryState")
    def battery(message, context): return BatteryState(...)     # a message of ROS, or CDR

    @from_ros("sensor_msgs/msg/BatteryState", Battery)
    def command(message, context): return Battery(...)

    share(Gripper)    # both directions, field by field, as my_robot/msg/Gripper

The bridge imports the modules that the settings name (`converters`), and those of installed packages with an
entry point in the group `cortex_ros2_bridge.converters`. A type that nothing is registered for, and whose
fields all have a counterpart in ROS, goes out field by field without any registration.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.metadata
import importlib.util
import json
import re
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np

from cortex import messages
from cortex.schema import schema_of
from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.backend.base import Buffer, Qos
from cortex_ros2_bridge.convert.context import Context, ConvertError, Out
from cortex_ros2_bridge.convert.measurements import MEASUREMENTS
from cortex_ros2_bridge.convert.records import header, record, stamp_ns_of
from cortex_ros2_bridge.typestore import define, typestore

GROUP = "cortex_ros2_bridge.converters"
STREAM = Qos(depth=1000)
"""Many small messages: at 1 kHz a subscriber may sleep for a second."""
PACKETS = Qos(depth=100)
FRAMES = Qos(depth=10)
"""Few large messages."""
NEWEST = Qos(depth=1)
LATCHED = Qos(durability="transient_local", depth=1)
Direction = Literal["out", "in", "call", "record"]
"""out: Cortex to ROS; in: ROS to Cortex; call: a message of ROS becomes a request to a Cortex service;
record: commands in Cortex go into bags, as the messages of ROS that would give them."""
_EVENT_FIELDS = frozenset(field.name for field in fields(messages.Events))
"""What events with more than that, such as their truth, have too."""
F = TypeVar("F", bound=Callable[..., Any])


class Rule(NamedTuple):
    """What happens by default to a topic of a type; `{topic}`, `{parent}` and `{base}` as in `routes`."""

    cortex_type: str
    """Of a service, that of its request."""
    ros_type: str
    direction: Direction
    name: str
    qos: Qos
    convert: Any
    """`context.Out`, or `context.In`, which also raises `cdr.CdrError`."""
    default: bool = True
    """False: only where the settings ask for it."""
    options: frozenset[str] = frozenset()
    """Names of the options that the conversion knows."""
    robot: bool = False
    """For a robot in ROS, whose sensors come in and whose commands go out: see `BridgeConfig.robot`."""


RULES: list[Rule] = []
"""What the bridge converts by itself; of one type in Cortex, the main one first."""


def standard(
    kind: type[Any],
    ros_type: str,
    name: str = "{topic}",
    qos: Qos = Qos(),  # noqa: B008  (frozen)
    *options: str,
    default: bool = True,
    direction: Direction = "out",
    robot: bool = False,
) -> Callable[[F], F]:
    """Register a conversion of the bridge's own; see `Rule`.

    One to ROS makes a record or CDR, one from ROS takes a plain record.
    """
    to = ros_type.replace("/", "/msg/")

    def register(function: F) -> F:
        convert = encoded(function) if direction in ("out", "record") else _decoded(function, to)
        source = schema_of(kind).name
        RULES.append(Rule(source, to, direction, name, qos, convert, default, frozenset(options), robot))
        return function

    return register


def recorded(kind: type[Any], ros_type: str, name: str, *options: str) -> Callable[[F], F]:
    """Register a conversion of commands for bags; `name` is below {base}."""
    return standard(kind, ros_type, f"{{base}}/{name}", NEWEST, *options, direction="record")


def command(
    kind: type[Any], ros_type: str, name: str, *options: str, default: bool = True
) -> Callable[[F], F]:
    """Register a conversion of commands; `name` is below {base}."""
    return standard(kind, ros_type, f"{{base}}/{name}", NEWEST, *options, default=default, direction="in")


def request(kind: type[Any], ros_type: str, name: str = "{topic}") -> Callable[[F], F]:
    """Register a conversion of requests."""
    return standard(kind, ros_type, name, direction="call")


def encoded(function: Callable[..., Any]) -> Out:
    """Return a conversion to CDR, of one that makes a record or CDR."""

    @functools.wraps(function)
    def convert(message: Any, context: Context) -> Buffer | None:
        made = function(message, context)
        return made if made is None or isinstance(made, Buffer) else cdr.encode(made)

    return convert


def _decoded(function: Callable[..., Any], ros_type: str) -> Callable[[Buffer, Context], Any]:
    @functools.wraps(function)
    def convert(data: Buffer, context: Context) -> Any:
        return function(cdr.decode(data, ros_type), context)

    return convert


@dataclass(frozen=True, kw_only=True)
class Added:
    """What was registered, or follows from a schema."""

    kind: type[Any] | None
    """Class in Cortex; None: it is known by its schema only."""
    fingerprint: int
    rules: tuple[Rule, ...]


ADDED: dict[str, Added] = {}
"""By the name of the type in Cortex."""


def to_ros(kind: type[Any], ros_type: str, *, name: str = "{topic}", qos: Qos = PACKETS) -> Callable[[F], F]:
    """Register a function that makes a message of ROS of one of Cortex.

    The function takes the message and the `Context`, and returns a message of ROS, its CDR, or None for
    nothing now. It raises `ConvertError` for a message that cannot be used.

    Args:
        kind: Class of the message in Cortex.
        ros_type: Such as "sensor_msgs/msg/BatteryState".
        name: Topic in ROS; {topic} stands for the one in Cortex.
        qos: Quality of service in ROS.
    """

    def register(function: F) -> F:
        _add(kind, Rule(schema_of(kind).name, ros_type, "out", name, qos, encoded(function)))
        return function

    return register


def from_ros(
    ros_type: str, kind: type[Any], *, name: str = "{topic}", qos: Qos = PACKETS
) -> Callable[[F], F]:
    """Register a function that makes a message of Cortex of one of ROS.

    The function takes the message, as an object of `msgs`, and the `Context`; arguments are as for `to_ros`.
    """

    def register(function: F) -> F:
        def convert(data: Buffer, context: Context) -> Any:
            return function(cdr.decode(data, ros_type), context)

        _add(kind, Rule(schema_of(kind).name, ros_type, "in", name, qos, convert))
        return function

    return register


def share(kind: type[Any], ros_type: str | None = None) -> None:
    """Let a type cross in both directions, field by field.

    Args:
        kind: Class of the message in Cortex.
        ros_type: Type in ROS with the same fields; None: named as in Cortex, and defined if ROS
            does not know it.

    Raises:
        ValueError: A field has no counterpart.
    """
    plain = json.loads(schema_of(kind).to_json())
    ros_type = _define(plain, ros_type)
    to_ros(kind, ros_type)(_writer(plain, ros_type))
    from_ros(ros_type, kind)(_reader(kind, plain))


def adopt(schema: str, fingerprint: int) -> str:
    """Let messages go out whose type is known by its schema only; returns why not, empty if they do."""
    plain = json.loads(schema)
    name = plain["name"]
    if name in ADDED:
        return "" if ADDED[name].fingerprint == fingerprint else f"another {name} is known already"
    try:
        ADDED[name] = Added(kind=None, fingerprint=fingerprint, rules=tuple(_rules_of(plain)))
    except ValueError as error:
        return str(error)
    return ""


def _rules_of(plain: Any) -> Iterable[Rule]:
    """Yield the rules of a type that is known by its schema only.

    Raises:
        ValueError: A field has no counterpart.
    """
    name, fields_of = plain["name"], {field["name"] for field in plain["fields"]}
    known = MEASUREMENTS.get(name)
    if fields_of >= _EVENT_FIELDS:
        yield from (r._replace(cortex_type=name) for r in RULES if r[:1] + r[2:3] == ("cortex/Events", "out"))
        with contextlib.suppress(ValueError):  # what ROS has no counterpart of stays in Cortex
            ros_type = _define(plain, None)
            yield Rule(name, ros_type, "out", "{topic}/labelled", PACKETS, _writer(plain, ros_type))
    elif _is_picture(plain):
        yield from _picture_rules(plain)
    elif known is not None and known.fields <= fields_of:
        yield Rule(name, known.ros_type, "out", "{topic}", PACKETS, known.convert)
    else:
        ros_type = _define(plain, None)
        yield Rule(name, ros_type, "out", "{topic}", PACKETS, _writer(plain, ros_type))


def _conversion_of(cortex_type: str, ros_type: str) -> Any:
    """Return the bridge's own conversion of a standard type."""
    return next(rule.convert for rule in RULES if rule[:3] == (cortex_type, ros_type, "out"))


def _is_picture(plain: Any) -> bool:
    """Return whether messages are pictures: `data` of [H, W] or [H, W, C], and `encoding`."""
    types = {field["name"]: field["type"] for field in plain["fields"]}
    data = types.get("data")
    ranks = len(data["shape"]) if isinstance(data, dict) and "array" in data else 0
    return "stamp_ns" in types and types.get("encoding") == "str" and ranks in (2, 3)


def _picture_rules(plain: Any) -> Iterable[Rule]:
    """Yield the rules of pictures: `data`, and what labels mean."""
    name, pictures, texts = plain["name"], "sensor_msgs/msg/Image", "std_msgs/msg/String"
    image = _conversion_of("cortex/Image", pictures)

    def send(message: Any, context: Context) -> Any:
        data = message.data if message.data.ndim == 3 else message.data[:, :, None]
        return image(messages.Image(message.stamp_ns, data, message.encoding, message.frame_id), context)

    yield Rule(name, pictures, "out", "{topic}/image_raw", PACKETS, send)
    if any(field["name"] == "labels" and field["type"] == "str" for field in plain["fields"]):
        labels = encoded(lambda message, _: record(texts)(message.labels))
        yield Rule(name, texts, "out", "{topic}/labels", LATCHED, labels)


def load_converters(modules: Iterable[str]) -> list[str]:
    """Import modules with conversions, of entry points and by name or file (.py); returns what went wrong."""
    problems = []
    entries = [(each.name, each.load) for each in importlib.metadata.entry_points(group=GROUP)]
    for name, load in [*entries, *((each, lambda each=each: _import(each)) for each in modules)]:
        try:
            load()
        except Exception as error:  # code of others: the rest of the bridge works without it
            problems.append(f"the converters of {name} cannot be loaded: {type(error).__name__}: {error}")
    return problems


def _import(module: str) -> None:
    if not module.endswith(".py"):
        importlib.import_module(module)
        return
    path = Path(module).resolve()
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None or not path.is_file():
        raise FileNotFoundError(f"there is no {path}")
    sys.modules[path.stem] = loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)


def _add(kind: type[Any], rule: Rule) -> None:
    schema = schema_of(kind)
    before = ADDED.get(schema.name)
    rules = before.rules if before is not None and before.kind is not None else ()
    ADDED[schema.name] = Added(
        kind=kind, fingerprint=schema.fingerprint, rules=(*(r for r in rules if r[:3] != rule[:3]), rule)
    )


# Field by field

_SCALARS = {"bool", "float32", "float64", *(f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64))}


@functools.cache
def ros_type_of(name: str) -> str:
    """Return what a type of Cortex is called in ROS: my_robot/msg/Battery for my_robot/Battery.

    The package of the messages of Cortex itself is cortex_msgs.
    """
    package, _, base = name.replace(".", "/").rpartition("/")
    package = re.sub("[^a-z0-9_]", "_", package.lower()).strip("_") or "cortex"
    base = "".join(part[:1].upper() + part[1:] for part in re.split("[^A-Za-z0-9]+", base))
    return f"{'cortex_msgs' if package == 'cortex' else package}/msg/{base}"


def _define(plain: Any, ros_type: str | None) -> str:
    """Return the ROS type with the fields of a schema; defined, if ROS does not know it."""
    name = ros_type or ros_type_of(plain["name"])
    lines = _lines(plain)
    if name not in typestore().fielddefs:
        define(name, "".join(f"{line}\n" for line in lines))
    known = [field for field, _ in typestore().fielddefs[name][1]]
    wanted = [line.split()[1] for line in lines]
    if known != wanted:
        raise ValueError(f"{name} has the fields {', '.join(known)}, {plain['name']} {', '.join(wanted)}")
    return name


def _lines(plain: Any) -> list[str]:
    """Return the definition in ROS of a schema, a line for each field."""
    names = [field["name"] for field in plain["fields"]]
    lines = ["std_msgs/Header header"] if "stamp_ns" in names else []
    for field in plain["fields"]:
        name, kind = field["name"], field["type"]
        if name == "stamp_ns" or (name == "frame_id" and lines):
            continue
        if not re.fullmatch("[a-z](_?[a-z0-9]+)*", name):
            raise ValueError(f"ROS allows no field {name!r}")
        lines.append(f"{_ros_field(kind, name)} {name}")
        if isinstance(kind, dict) and len(kind.get("shape", ())) > 1:
            lines.append(f"uint32[] {name}_shape")
    return lines


def _ros_field(kind: Any, name: str) -> str:
    if isinstance(kind, str):
        base = {"str": "string", "bytes": "uint8[]"}.get(kind, kind)
        if kind in _SCALARS or base != kind:
            return base
    elif "array" in kind and kind["array"] in _SCALARS:
        sizes = kind["shape"]
        return (
            f"{kind['array']}[{sizes[0]}]"
            if len(sizes) == 1 and isinstance(sizes[0], int)
            else (f"{kind['array']}[]")
        )
    elif "enum" in kind:
        return "int32"
    elif "message" in kind:
        return _define(kind["message"], None).replace("/msg/", "/")
    elif "list" in kind and not _ros_field(kind["list"], name).endswith("]"):
        return f"{_ros_field(kind['list'], name)}[]"
    raise ValueError(f"its field {name} has no counterpart in ROS: {kind}")


def _writer(plain: Any, ros_type: str) -> Out:
    """Return the conversion to ROS of messages of a schema."""
    return lambda message, context: cdr.encode(_to_record(plain, ros_type, message, context))


def _to_record(plain: Any, ros_type: str, message: Any, context: Context) -> Any:
    is_stamped = any(field["name"] == "stamp_ns" for field in plain["fields"])
    values: list[Any] = []
    if is_stamped:
        frame = getattr(message, "frame_id", "") or context.frame_id
        values.append(header(message.stamp_ns, frame, context))
    for field in plain["fields"]:
        name, kind = field["name"], field["type"]
        if is_stamped and name in ("stamp_ns", "frame_id"):
            continue
        value = getattr(message, name)
        values.append(_to_value(kind, value, context))
        if isinstance(kind, dict) and len(kind.get("shape", ())) > 1:
            values.append(np.array(np.shape(value), np.uint32))
    return record(ros_type)(*values)


def _to_value(kind: Any, value: Any, context: Context) -> Any:
    """Return the value in ROS of a field."""
    if isinstance(kind, str):
        return np.frombuffer(bytes(value), np.uint8) if kind == "bytes" else value
    if "array" in kind:
        return np.ascontiguousarray(value, kind["array"]).reshape(-1)
    if "enum" in kind:
        return int(getattr(value, "value", value))
    if "message" in kind:
        inner = kind["message"]
        return _to_record(inner, ros_type_of(inner["name"]), value, context)
    items = [_to_value(kind["list"], each, context) for each in value]
    is_row = isinstance(kind["list"], str) and kind["list"] != "str"
    return np.array(items, kind["list"]) if is_row else items


def _reader(kind: type[Any], plain: Any) -> Callable[[Any, Context], Any]:
    """Return what makes a message of a class of one of ROS with the same fields."""
    fields = [(field["name"], field["type"]) for field in plain["fields"]]
    nested = [name for name, each in fields if isinstance(each, dict) and ({"message", "list"} & each.keys())]
    if nested:
        raise ValueError(
            f"{plain['name']}: nested fields ({', '.join(nested)}) need a converter of their own"
        )
    names = [name for name, _ in fields]

    def convert(message: Any, context: Context) -> Any:
        values: dict[str, Any] = {}
        for name, each in fields:
            if name == "stamp_ns":
                values[name] = stamp_ns_of(message.header.stamp)
            elif name == "frame_id" and "stamp_ns" in names:
                values[name] = message.header.frame_id
            elif isinstance(each, dict) and "array" in each:
                array = np.array(getattr(message, name), each["array"])
                shape = getattr(message, f"{name}_shape", array.shape)
                if int(np.prod(shape)) != array.size:
                    raise ConvertError(f"{name}: {array.size} numbers for the shape {list(shape)}")
                values[name] = array.reshape(tuple(shape))
            else:
                value = getattr(message, name)
                values[name] = bytes(value) if each == "bytes" else value
        return kind(**values)

    return convert
