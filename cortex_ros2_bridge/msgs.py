"""Message classes of ROS 2: the real ones where ROS is sourced, else stand-ins that behave the same.

    from cortex_ros2_bridge.msgs import Imu
    imu = Imu()
    imu.orientation_covariance[0] = -1.0

A stand-in has the constructor, attributes, defaults, constants and array types of the class that rclpy uses.
As those of Jazzy do without ROS_PYTHON_CHECK_FIELDS=1, it takes any value but for numbers in a row; what does
not fit a field is refused by `cdr.encode`.
"""

from __future__ import annotations

import array
import difflib
import functools
import importlib
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype

from cortex_ros2_bridge.typestore import check_type, typestore

TYPE_CODES = {
    "float32": "f",
    "float64": "d",
    "int8": "b",
    "uint8": "B",
    "char": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
}
"""Elements whose sequences are `array.array` and whose arrays are `numpy.ndarray`, and their type codes."""

_IDL_NAMES = {"float32": "float", "float64": "double", "bool": "boolean", "byte": "octet", "char": "uint8"}
_DEFAULTS: dict[str, dict[str, Any]] = {
    # A message definition may give a default; rosbags leaves out these, of standard messages.
    "geometry_msgs/msg/Quaternion": {"w": 1.0},
    "sensor_msgs/msg/NavSatStatus": {"status": -2},
    "simulation_interfaces/srv/StepSimulation_Request": {"steps": 1},
}
EMPTY = "structure_needs_at_least_one_member"
"""A byte that stands for an empty message on the wire."""
_HIDDEN = {"actionlib_msgs", "type_description_interfaces"}
"""Packages whose messages have the names of others that are used more; `message_class` finds them."""


class Field(NamedTuple):
    """One field of a stand-in."""

    name: str
    slot: str
    """Attribute that holds the value."""
    description: Any
    """Its type, as rosbags has it."""
    default: Callable[[], Any]


class Message:
    """A message of ROS 2: what all stand-ins have."""

    __slots__: Any = ()
    __hash__ = None  # type: ignore[assignment]  # as in rclpy: a message can change

    __ros_type__ = ""
    _fields_and_field_types: dict[str, str] = {}  # noqa: RUF012  # rclpy's name; never changed
    __ros_fields__: tuple[Field, ...] = ()

    def __init__(self, **values: Any) -> None:
        unknown = values.keys() - self._fields_and_field_types.keys()
        assert not unknown, f"Invalid arguments passed to constructor: {', '.join(sorted(unknown))}"
        for field in self.__ros_fields__:
            if field.name in values:
                setattr(self, field.name, values[field.name])
            else:
                setattr(self, field.slot, field.default())

    @classmethod
    def get_fields_and_field_types(cls) -> dict[str, str]:
        """Return the names and types of the fields, in their order."""
        return dict(cls._fields_and_field_types)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, self.__class__):
            return False
        for name in self.__slots__:
            ours, theirs = getattr(self, name), getattr(other, name)
            if not (np.array_equal(ours, theirs) if isinstance(ours, np.ndarray) else ours == theirs):
                return False
        return True

    def __repr__(self) -> str:
        package, kind, name = self.__ros_type__.split("/")
        texts = []
        for slot in self.__slots__:
            value = getattr(self, slot)
            text = repr(value)
            if isinstance(value, array.array):  # array('B', [1, 2]) is shown as [1, 2]
                text = text[len("array('B', ") : -1] if value else "[]"
            texts.append(f"{slot[1:]}={text}")
        return f"{package}.{kind}.{name}({', '.join(texts)})"


@functools.cache
def message_class(type_name: str) -> Any:
    """Return the class of a type such as "sensor_msgs/msg/Imu": that of ROS if it imports, else a stand-in.

    Raises:
        UnknownTypeError: There is no such type.
    """
    real = _ros_class(type_name)
    if real is not None:
        return real
    check_type(type_name)
    return _make_class(type_name)


def _ros_class(type_name: str) -> Any | None:
    package, kind, name = type_name.split("/") if type_name.count("/") == 2 else ("", "", "")
    if kind not in ("msg", "srv") or not package.isidentifier():
        return None
    try:
        module = importlib.import_module(f"{package}.{kind}")
    except ImportError:  # ROS is not sourced, or lacks the package
        return None
    if kind == "srv":  # Trigger_Request is Trigger.Request there
        name, _, half = name.rpartition("_")
        return getattr(getattr(module, name, None), half, None)
    return getattr(module, name, None)


def _make_class(type_name: str) -> Any:
    constants, entries = typestore().fielddefs[type_name]
    base = type_name.rpartition("/")[2]
    attributes: dict[str, Any] = {
        name: bytes([int(value)]) if kind == "byte" else value for name, kind, value in constants
    }
    fields = [_field(name, desc) for name, desc in entries if name != EMPTY]
    for name, value in _DEFAULTS.get(type_name, {}).items():
        attributes[f"{name.upper()}__DEFAULT"] = value
        fields = [
            f._replace(default=functools.partial(as_it_is, value)) if f.name == name else f for f in fields
        ]
    attributes |= {field.name: _accessor(field) for field in fields}
    attributes |= {
        "__slots__": [field.slot for field in fields],
        "__doc__": f"Message class '{base}'.",
        "__module__": __name__,
        "__qualname__": base,
        "__ros_type__": type_name,
        "_fields_and_field_types": {field.name: _idl_type(field.description) for field in fields},
        "__ros_fields__": tuple(fields),
    }
    return type(base, (Message,), attributes)


def as_it_is(value: Any) -> Any:
    """Return a value."""
    return value


def _accessor(field: Field) -> Any:
    kind, what = field.description
    is_row = kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) and what[0][0] == Nodetype.BASE
    code = TYPE_CODES.get(what[0][1][0]) if is_row else None

    def put(self: Message, value: Any) -> None:
        if code is not None:
            value = _numbers(code, value, fixed=kind == Nodetype.ARRAY)
        setattr(self, field.slot, value)

    return property(operator.attrgetter(field.slot), put, doc=f"Message field '{field.name}'.")


def _idl_type(desc: Any) -> str:
    kind, what = desc
    if kind == Nodetype.NAME:
        return str(what).replace("/msg/", "/")
    if kind == Nodetype.BASE:
        base, limit = what
        return f"{_IDL_NAMES.get(base, base)}<{limit}>" if limit else _IDL_NAMES.get(base, base)
    element, size = what
    if kind == Nodetype.ARRAY:
        return f"{_idl_type(element)}[{size}]"
    return f"sequence<{_idl_type(element)}, {size}>" if size else f"sequence<{_idl_type(element)}>"


def _field(name: str, description: Any) -> Field:
    default: Callable[[], Any]
    kind, what = description
    if kind == Nodetype.NAME:
        default = message_class(what)
    elif kind == Nodetype.BASE:
        default = functools.partial(bytes, 1) if what[0] == "byte" else _PYTHON.get(what[0], int)
    else:
        (of, element), size = what
        if of == Nodetype.BASE and element[0] in TYPE_CODES:
            code = TYPE_CODES[element[0]]
            zeros = functools.partial(np.zeros, size, code)
            default = zeros if kind == Nodetype.ARRAY else functools.partial(array.array, code)
        else:
            one = _field(name, what[0])
            default = functools.partial(_defaults, one, size if kind == Nodetype.ARRAY else 0)
    return Field(name, f"_{name}", description, default)


def _defaults(field: Field, size: int) -> list[Any]:
    return [field.default() for _ in range(size)]


_PYTHON: dict[str, type[Any]] = {
    "string": str,
    "bool": bool,
    "byte": bytes,
    "float32": float,
    "float64": float,
}
"""What Python has for a base type; int for all others."""


def _numbers(code: str, value: Any, *, fixed: bool) -> Any:
    """Return numbers in a row as rclpy has them; without a Python loop where they are an array already."""
    if isinstance(value, np.ndarray):
        if value.ndim != 1 or (fixed and value.dtype != np.dtype(code)):
            raise TypeError(
                f"an array of {value.ndim} dimensions of {value.dtype} for one of {np.dtype(code)}"
            )
        if not fixed and value.dtype == np.dtype(code):
            return array.array(code, value.tobytes())
    if isinstance(value, array.array) and value.typecode != code:
        raise TypeError(f"an array of type code {value.typecode!r} for one of {code!r}")
    if fixed:
        return value if isinstance(value, np.ndarray) else np.array(list(value), code)
    return value if isinstance(value, array.array) else array.array(code, value)


@functools.cache
def _by_base_name() -> dict[str, str]:
    found: dict[str, str] = {}
    for name in sorted(typestore().fielddefs):
        package, _, base = name.split("/")
        if package not in _HIDDEN and "/msg/" in name:
            assert base not in found, f"{base} is in {found[base]} and {name}"
            found[base] = name
    return found


def __getattr__(name: str) -> Any:
    if name.startswith("_") or name not in _by_base_name():
        near = difflib.get_close_matches(name, _by_base_name(), 1) if not name.startswith("_") else []
        hint = f", did you mean {near[0]!r}?" if near else ""
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")
    return message_class(_by_base_name()[name])


def __dir__() -> list[str]:
    return sorted({*globals(), *_by_base_name()})
