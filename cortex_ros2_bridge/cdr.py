"""Messages to bytes and back: CDR, little endian, as DDS carries ROS 2 messages; `rosbags` does the work.

An encoded message has its header of four bytes and is padded to a multiple of four. Both byte orders are
decoded. Large arrays are copied once, without a loop in Python.
"""

from __future__ import annotations

import array
import functools
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from cortex_ros2_bridge.backend.base import Buffer
from cortex_ros2_bridge.msgs import EMPTY, TYPE_CODES, Message, as_it_is, message_class
from cortex_ros2_bridge.typestore import check_type, typestore

_LITTLE, _BIG = b"\x00\x01", b"\x00\x00"
_WRONG = (
    SerdeError,
    struct.error,
    ValueError,
    TypeError,
    IndexError,
    AttributeError,
    OverflowError,
    AssertionError,
)
"""What rosbags raises for bytes or values that do not fit a type."""


class CdrError(ValueError):
    """These bytes are not a message of the type, or this message does not fit its type."""


def encode(message: Any) -> memoryview:
    """Return a stand-in, a message of rclpy, or a plain record of a `record_class`, as CDR.

    Raises:
        CdrError: A field has a value that its type cannot hold.
        UnknownTypeError: It is a message of a type that we have no definition of.
    """
    type_name = getattr(message, "__msgtype__", None)
    convert: Callable[[Any], Any] = as_it_is
    if type_name is None:
        type_name = type_name_of(message)
        convert = _to_record(type_name)
    check_type(type_name)
    store = typestore()
    definition = store.get_msgdef(type_name)
    try:
        record = convert(message)
        size = definition.getsize_cdr(0, record, store)
        buffer = bytearray(4 + (size + 3 & -4))
        buffer[:2] = _LITTLE
        definition.serialize_cdr_le(memoryview(buffer)[4:], 0, record, store)
    except _WRONG as error:
        raise CdrError(f"cannot encode a {type_name}: {error}") from error
    return memoryview(buffer).toreadonly()


def decode(data: Buffer, type_name: str | type[Any]) -> Any:
    """Return the message in a buffer, as an object of `msgs.message_class(type_name)`; its arrays are copies.

    The type is given by its name, or by the class that `msgs` has for it.

    Raises:
        CdrError: The data are cut off or too long, hold a length beyond their end, or are no plain CDR.
        UnknownTypeError: There is no such type.
    """
    name = type_name if isinstance(type_name, str) else type_name_of(type_name())
    return _deserialise(data, name, _message_store())


def decode_record(data: Buffer, type_name: str) -> Any:
    """Return what `decode` does as a plain record, which is faster; its arrays are views of the data."""
    return _deserialise(data, type_name, typestore())


def record_class(type_name: str) -> Any:
    """Return the class of plain records of a type: a dataclass without defaults; sequences are arrays."""
    check_type(type_name)
    return typestore().types[type_name]


def type_name_of(message: Any) -> str:
    """Return the type of a stand-in or of a message of rclpy, such as "sensor_msgs/msg/Imu".

    Raises:
        TypeError: It is neither.
    """
    if isinstance(message, Message):
        return message.__ros_type__
    kind = type(message)
    package, _, module = kind.__module__.partition(".")
    folder = module.partition(".")[0]
    if not hasattr(kind, "get_fields_and_field_types") or folder not in ("msg", "srv"):
        raise TypeError(f"{message!r:.80} is not a ROS message")
    return f"{package}/{folder}/{kind.__name__}"


def _deserialise(data: Buffer, type_name: str, store: Typestore) -> Any:
    check_type(type_name)
    view = memoryview(data).cast("B")
    if len(view) < 4:
        raise CdrError(f"{len(view)} bytes are too few for a {type_name}: CDR begins with a header of 4")
    kind = bytes(view[:2])
    if kind not in (_LITTLE, _BIG):
        raise CdrError(
            f"a {type_name} with representation 0x{kind.hex()}, which is not plain CDR (0x0000 or 0x0001)"
        )
    definition = store.get_msgdef(type_name)
    deserialise = definition.deserialize_cdr_le if kind == _LITTLE else definition.deserialize_cdr_be
    body = view[4:]
    try:
        message, end = deserialise(body, 0, definition.cls, store)
    except _WRONG as error:
        raise CdrError(f"{len(view)} bytes are not a {type_name}: {error}") from error
    if not end <= len(body) < end + 4:
        raise CdrError(f"a {type_name} that needs {4 + end} bytes has {len(view)}")
    return message


@functools.cache
def _to_record(type_name: str) -> Callable[[Any], Any]:
    """Return what makes a plain record of a message; `as_it_is` where its attributes serve as they are."""
    check_type(type_name)
    entries = [(name, _to_record_field(desc)) for name, desc in typestore().fielddefs[type_name][1]]
    make = record_class(type_name)
    if [name for name, _ in entries] == [EMPTY]:
        return lambda _message: make(0)
    if all(convert is None for _, convert in entries):
        return as_it_is

    def convert_all(message: Any) -> Any:
        values = []
        for name, convert in entries:
            value = getattr(message, name)
            values.append(value if convert is None else convert(value))
        return make(*values)

    return convert_all


def _to_record_field(desc: Any) -> Callable[[Any], Any] | None:
    """Return what converts the value of a field; None: it stays as it is."""
    kind, what = desc
    if kind == Nodetype.NAME:
        convert = _to_record(what)
        return None if convert is as_it_is else convert
    if kind == Nodetype.BASE:
        return _byte_value if what[0] == "byte" else None
    element, _ = what
    if element[0] == Nodetype.BASE and element[1][0] != "string":
        base = element[1][0]
        if base == "byte":
            return lambda values: np.frombuffer(b"".join(values), np.int8)
        dtype = np.dtype({"bool": "?", "char": "u1"}.get(base, base)).newbyteorder("<")
        return functools.partial(np.ascontiguousarray, dtype=dtype)
    one = _to_record_field(element)
    return None if one is None else lambda values: [one(value) for value in values]


def _byte_value(value: bytes) -> int:
    return int.from_bytes(value, "little", signed=True)


@functools.cache
def _message_store() -> Typestore:
    """Return a type store whose decoder makes the messages of `msgs` at once."""
    store = Typestore()
    store.fielddefs = typestore().fielddefs
    store.types = _Makers()
    return store


class _Makers(dict[str, Any]):
    """What makes a message from its field's values, for each type; made when first asked for."""

    def __missing__(self, type_name: str) -> Callable[..., Any]:
        maker = self[type_name] = _maker(type_name)
        return maker


def _maker(type_name: str) -> Callable[..., Any]:
    kind = message_class(type_name)
    entries = [(name, _from_record_field(desc)) for name, desc in typestore().fielddefs[type_name][1]]
    if [name for name, _ in entries] == [EMPTY]:
        return lambda _placeholder: kind()

    def make(*values: Any) -> Any:
        pairs = zip(entries, values, strict=True)
        return kind(**{name: v if convert is None else convert(v) for (name, convert), v in pairs})

    return make


def _from_record_field(desc: Any) -> Callable[[Any], Any] | None:
    kind, what = desc
    if kind == Nodetype.NAME:
        return None
    if kind == Nodetype.BASE:
        return (lambda value: bytes([value & 0xFF])) if what[0] == "byte" else None
    element, _ = what
    if element[0] != Nodetype.BASE or element[1][0] == "string":
        return None
    base = element[1][0]
    if base == "byte":
        return lambda values: [bytes([value & 0xFF]) for value in values.tolist()]
    if base == "bool":
        return lambda values: values.tolist()
    if kind == Nodetype.ARRAY:
        return np.array  # a copy that can be written to

    def to_array(values: Any) -> array.array[Any]:
        flat = array.array(TYPE_CODES[base])
        flat.frombytes(np.ascontiguousarray(values).view(np.uint8).data)
        return flat

    return to_array
