"""Message classes of ROS 2: the real ones where ROS is sourced, else stand-ins that behave the same.

    from cortex_ros2_bridge.msgs import Imu
    imu = Imu()
    imu.orientation_covariance[0] = -1.0

A stand-in has the constructor, attributes, defaults, constants and array types of the class that rclpy uses.
It refuses what that refuses when it checks its fields, as those of Humble always do, and those of Jazzy with
ROS_PYTHON_CHECK_FIELDS=1: with an `AssertionError`, or the error of the array that the constructor makes.
"""

from __future__ import annotations

import array
import difflib
import functools
import importlib
import math
import operator
from collections import UserList
from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
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
_FLOAT32_MAX = 3.402823466e38
_EMPTY = "structure_needs_at_least_one_member"  # a byte that stands for an empty message on the wire
_HIDDEN = {"actionlib_msgs", "type_description_interfaces"}
"""Packages whose messages have the names of others that are used more; `message_class` finds them."""


class Field(NamedTuple):
    """One field of a stand-in."""

    name: str
    slot: str
    """Attribute that holds the value."""
    idl_type: str
    """As rclpy names it, such as "sequence<double>"."""
    check: Callable[[Any], Any]
    """Returns the value to store, or raises AssertionError."""
    default: Callable[[], Any]
    convert: Callable[[Any], Any]
    """What the constructor does with a value before it is checked."""


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
                setattr(self, field.name, field.convert(values[field.name]))
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
    """Return the class of a message type: that of ROS if it can be imported, else a stand-in.

    Args:
        type_name: Such as "sensor_msgs/msg/Imu".

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
    fields = [_field(name, desc) for name, desc in entries if name != _EMPTY]
    for name, value in _DEFAULTS.get(type_name, {}).items():
        attributes[f"{name.upper()}__DEFAULT"] = value
        fields = [
            f._replace(default=functools.partial(_as_it_is, value)) if f.name == name else f for f in fields
        ]
    attributes |= {field.name: _accessor(field) for field in fields}
    attributes |= {
        "__slots__": [field.slot for field in fields],
        "__doc__": f"Message class '{base}'.",
        "__module__": __name__,
        "__qualname__": base,
        "__reduce__": _reduce,
        "__ros_type__": type_name,
        "_fields_and_field_types": {field.name: field.idl_type for field in fields},
        "__ros_fields__": tuple(fields),
    }
    return type(base, (Message,), attributes)


def _reduce(self: Message) -> tuple[Any, ...]:
    """Pickle and copy by the name of the type: its class has no place in a module."""
    return _restore, (self.__ros_type__, [getattr(self, slot) for slot in self.__slots__])


def _restore(type_name: str, values: list[Any]) -> Any:
    kind = message_class(type_name)
    return kind(**dict(zip(kind.get_fields_and_field_types(), values, strict=True)))


def _accessor(field: Field) -> Any:
    slot, check = field.slot, field.check

    def put(self: Message, value: Any) -> None:
        setattr(self, slot, check(value))

    return property(operator.attrgetter(slot), put, doc=f"Message field '{field.name}'.")


def _as_it_is(value: Any) -> Any:
    return value


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


def _field(name: str, desc: Any) -> Field:
    check: Callable[[Any], Any]
    default: Callable[[], Any]
    convert: Callable[[Any], Any] = _as_it_is
    kind, what = desc
    if kind == Nodetype.NAME:
        default = message_class(what)
        check = _nested(name, default)
    elif kind == Nodetype.BASE:
        base, limit = what
        check, default = _scalar(name, base, limit), _DEFAULT_OF[_check_of(base)]
    else:
        element, size = what
        base = element[1][0] if element[0] == Nodetype.BASE else ""
        if base in TYPE_CODES and kind == Nodetype.ARRAY:
            dtype = np.dtype("uint8" if base == "char" else base)
            check = _fixed(name, base, dtype, size)
            default = functools.partial(np.zeros, size, dtype)
            convert = functools.partial(np.array, dtype=dtype)
        elif base in TYPE_CODES:
            check = _sequence(name, base, size)
            default = functools.partial(array.array, TYPE_CODES[base])
            convert = functools.partial(_to_array, base)
        else:
            one = _field(name, element)
            check = _list(name, one, size, exact=kind == Nodetype.ARRAY)
            default = functools.partial(_defaults, one, size) if kind == Nodetype.ARRAY else list
    return Field(name, f"_{name}", _idl_type(desc), check, default, convert)


def _defaults(field: Field, size: int) -> list[Any]:
    return [field.default() for _ in range(size)]


def _check_of(base: str) -> str:
    return {"float32": "float", "float64": "float", "string": "string", "bool": "bool", "byte": "byte"}.get(
        base, "int"
    )


def _nested(name: str, kind: Any) -> Callable[[Any], Any]:
    def check(value: Any) -> Any:
        assert isinstance(value, kind), f"The '{name}' field must be a sub message of type '{kind.__name__}'"
        return value

    return check


_PYTHON: dict[str, type[Any]] = {
    "string": str,
    "bool": bool,
    "byte": bytes,
    "float32": float,
    "float64": float,
}
"""What Python has for a base type; int for all others."""


def _scalar(name: str, base: str, limit: int) -> Callable[[Any], Any]:
    kind: type[Any] = _PYTHON.get(base, int)
    low, high = _bounds(base) if kind is int else (-_FLOAT32_MAX, _FLOAT32_MAX)
    number = "float" if kind is float else "integer" if low else "unsigned integer"

    def check(value: Any) -> Any:
        if kind is bytes and isinstance(value, bytearray | memoryview):
            value = bytes(value)
        assert isinstance(value, kind), f"The '{name}' field must be of type '{kind.__name__}'"
        if kind is str:
            assert not limit or len(value) <= limit, f"The '{name}' field must be at most {limit} long"
        elif kind is bytes:
            assert len(value) == 1, f"The '{name}' field must have a length of 1"
        elif kind is int or (base == "float32" and math.isfinite(value)):
            article = "an" if kind is int else "a"
            assert low <= value <= high, f"The '{name}' field must be {article} {number} in [{low}, {high}]"
        return value

    return check


_DEFAULT_OF: dict[str, Callable[[], Any]] = {
    "string": str,
    "bool": bool,
    "byte": functools.partial(bytes, 1),
    "int": int,
    "float": float,
}


def _bounds(base: str) -> tuple[int, int]:
    if base == "char":
        base = "uint8"
    info = np.iinfo(base)
    return int(info.min), int(info.max)


def _is_collection(value: Any) -> bool:
    return isinstance(value, Sequence | AbstractSet | UserList | np.ndarray | array.array) and not isinstance(
        value, str
    )


def _fixed(name: str, base: str, dtype: np.dtype[Any], size: int) -> Callable[[Any], Any]:
    def check(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            assert value.dtype == dtype, (
                f"The '{name}' numpy.ndarray() must have the dtype of 'numpy.{dtype}'"
            )
            assert value.shape == (size,), f"The '{name}' numpy.ndarray() must have a size of {size}"
            return value
        assert _is_collection(value), f"The '{name}' field must be a set or sequence"
        assert len(value) == size, f"The '{name}' field must be a set or sequence with length {size}"
        _check_numbers(name, base, value)
        return np.array(list(value), dtype=dtype)

    return check


def _sequence(name: str, base: str, limit: int) -> Callable[[Any], Any]:
    code = TYPE_CODES[base]

    def check(value: Any) -> Any:
        if isinstance(value, array.array):
            assert value.typecode == code, f"The '{name}' array.array() must have the type code of '{code}'"
        else:
            assert _is_collection(value), f"The '{name}' field must be a set or sequence"
            if not isinstance(value, np.ndarray | bytes):
                _check_numbers(name, base, value)
            try:
                value = _to_array(base, value)
            except (TypeError, OverflowError) as error:
                raise AssertionError(
                    f"The '{name}' field must be a set or sequence and each value of {base}: {error}"
                ) from None
        assert not limit or len(value) <= limit, f"The '{name}' field must be at most {limit} long"
        return value

    return check


def _to_array(base: str, value: Any) -> array.array[Any]:
    """Return a sequence of numbers as an array; without a Python loop where it is one already.

    Raises:
        TypeError: It is none of numbers, or has more than one dimension.
        OverflowError: A number does not fit.
    """
    code = TYPE_CODES[base]
    flat: array.array[Any] = array.array(code)
    if isinstance(value, np.ndarray) and value.ndim != 1:
        raise TypeError(f"only arrays of one dimension can be converted, got {value.ndim}")
    if isinstance(value, np.ndarray) and value.dtype == np.dtype("uint8" if base == "char" else base):
        flat.frombytes(np.ascontiguousarray(value).view(np.uint8).data)
        return flat
    if code == "B" and isinstance(value, bytes | bytearray):
        flat.frombytes(value)
        return flat
    return array.array(code, value)


def _check_numbers(name: str, base: str, values: Any) -> None:
    check = _scalar(name, base, 0)
    for value in values:
        check(value)


def _list(name: str, one: Field, size: int, *, exact: bool) -> Callable[[Any], Any]:
    kind = type(one.default()).__name__

    def check_all(value: Any) -> Any:
        assert _is_collection(value), f"The '{name}' field must be a set or sequence"
        for element in value:
            try:
                one.check(element)
            except AssertionError:
                raise AssertionError(
                    f"The '{name}' field must be a set or sequence and each value of type '{kind}'"
                ) from None
        if exact:
            assert len(value) == size, f"The '{name}' field must be a set or sequence with length {size}"
        else:
            assert not size or len(value) <= size, f"The '{name}' field must be at most {size} long"
        return value

    return check_all


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
