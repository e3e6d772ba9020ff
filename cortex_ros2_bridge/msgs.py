"""Messages of ROS 2 as records: the dataclasses of `rosbags`, with the defaults of ROS.

    from cortex_ros2_bridge.msgs import Imu
    imu = Imu()
    imu.orientation_covariance[0] = -1.0

Fields and constants have the names of ROS. Numbers in a row are NumPy arrays, made of what is set; a `byte`
is an int. Whatever else does not fit a field is refused by `cdr.encode`.
"""

from __future__ import annotations

import difflib
import functools
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from rosbags.interfaces import Nodetype

from cortex_ros2_bridge.typestore import check_type, typestore

_DEFAULTS: dict[str, dict[str, Any]] = {
    # A message definition may give a default; rosbags leaves out these, of standard messages.
    "geometry_msgs/msg/Quaternion": {"w": 1.0},
    "sensor_msgs/msg/NavSatStatus": {"status": -2},
    "simulation_interfaces/srv/StepSimulation_Request": {"steps": 1},
}
_HIDDEN = {"actionlib_msgs", "type_description_interfaces"}
"""Packages whose messages have the names of others that are used more; `message_class` finds them."""
_ROWS = {"bool": "?", "byte": "i1", "char": "u1"}
_PYTHON: dict[str, type[Any]] = {"string": str, "bool": bool, "float32": float, "float64": float}
"""What Python has for a base type; int for all others."""


class Message:
    """What records have that are made by name: every field that is not given has its default."""

    _defaults: ClassVar[dict[str, Callable[[], Any]]] = {}
    _rows: ClassVar[dict[str, np.dtype[Any]]] = {}
    """Fields that are numbers in a row."""

    def __init__(self, **values: Any) -> None:
        for name, value in values.items():
            setattr(self, name, value)
        for name in self._defaults.keys() - values.keys():
            setattr(self, name, self._defaults[name]())

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self._defaults:
            hint = ", ".join(self._defaults)
            raise AttributeError(f"{type(self).__name__} has no field {name!r}, its fields are {hint}")
        super().__setattr__(name, _row(value, self._rows[name]) if name in self._rows else value)


@functools.cache
def message_class(type_name: str) -> Any:
    """Return the class of a type such as "sensor_msgs/msg/Imu".

    Raises:
        UnknownTypeError: There is no such type.
    """
    check_type(type_name)
    entries = typestore().fielddefs[type_name][1]
    defaults = {name: _default(desc) for name, desc in entries}
    given = _DEFAULTS.get(type_name, {})
    defaults |= {name: functools.partial(lambda value: value, value) for name, value in given.items()}
    attributes = {
        "__module__": __name__,
        "_defaults": defaults,
        "_rows": {name: dtype for name, desc in entries if (dtype := _row_of(desc)) is not None},
    }
    return type(type_name.rpartition("/")[2], (Message, typestore().types[type_name]), attributes)


def _row_of(description: Any) -> np.dtype[Any] | None:
    """Return the type of the numbers of a field that has them in a row."""
    kind, what = description
    if kind not in (Nodetype.ARRAY, Nodetype.SEQUENCE) or what[0][0] != Nodetype.BASE:
        return None
    base = what[0][1][0]
    return None if base == "string" else np.dtype(_ROWS.get(base, base))


def _default(description: Any) -> Callable[[], Any]:
    kind, what = description
    if kind == Nodetype.NAME:
        inner: type[Message] = message_class(what)
        return inner
    if kind == Nodetype.BASE:
        return _PYTHON.get(what[0], int)
    count = what[1] if kind == Nodetype.ARRAY else 0
    dtype = _row_of(description)
    if dtype is not None:
        return lambda: np.zeros(count, dtype)
    one = _default(what[0])
    return lambda: [one() for _ in range(count)]


def _row(value: Any, dtype: np.dtype[Any]) -> Any:
    """Return numbers as an array of one axis; an array of the right type stays what it is."""
    given = np.frombuffer(value, dtype) if isinstance(value, (bytes, bytearray)) else np.asarray(value)
    if given.ndim != 1:
        raise TypeError(f"numbers in a row must have one axis, got {value!r:.80}")
    made = np.ascontiguousarray(given, dtype)
    if dtype.kind != "f" and not np.array_equal(made, given):
        raise TypeError(f"{value!r:.80} has numbers that are no {dtype}")
    return made


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
