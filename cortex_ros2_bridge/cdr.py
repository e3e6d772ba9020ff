"""Messages to bytes and back: CDR, little endian, as DDS carries ROS 2 messages; `rosbags` does the work.

An encoded message has its header of four bytes and is padded to a multiple of four. Both byte orders are
decoded. Large arrays are copied once, without a loop in Python.
"""

from __future__ import annotations

import struct
from typing import Any

from rosbags.serde import SerdeError

from cortex_ros2_bridge.backend.base import Buffer
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
    """Return a record, of `msgs` or of a `record_class`, or a message of rclpy, as CDR.

    Raises:
        CdrError: A field has a value that its type cannot hold.
        TypeError: It is no message.
    """
    type_name = getattr(message, "__msgtype__", None)
    if type_name is None:
        return _encode_of_rclpy(message)
    check_type(type_name)
    store = typestore()
    definition = store.get_msgdef(type_name)
    try:
        size = definition.getsize_cdr(0, message, store)
        buffer = bytearray(4 + (size + 3 & -4))
        buffer[:2] = _LITTLE
        definition.serialize_cdr_le(memoryview(buffer)[4:], 0, message, store)
    except _WRONG as error:
        raise CdrError(f"cannot encode a {type_name}: {error}") from error
    return memoryview(buffer).toreadonly()


def _encode_of_rclpy(message: Any) -> memoryview:
    if not hasattr(message, "get_fields_and_field_types"):
        raise TypeError(f"{message!r:.80} is not a ROS message")
    from rclpy.serialization import serialize_message

    data = serialize_message(message)
    return memoryview(data + bytes(-len(data) % 4))


def decode(data: Buffer, type_name: str | type[Any]) -> Any:
    """Return the message in a buffer as a record, a dataclass; its arrays are views of the data.

    The type is given by its name, or by the class that `msgs` has for it.

    Raises:
        CdrError: The data are cut off or too long, hold a length beyond their end, or are no plain CDR.
        UnknownTypeError: There is no such type.
    """
    type_name = type_name if isinstance(type_name, str) else type_name.__msgtype__
    check_type(type_name)
    view = memoryview(data).cast("B")
    if len(view) < 4:
        raise CdrError(f"{len(view)} bytes are too few for a {type_name}: CDR begins with a header of 4")
    kind = bytes(view[:2])
    if kind not in (_LITTLE, _BIG):
        raise CdrError(
            f"a {type_name} with representation 0x{kind.hex()}, which is not plain CDR (0x0000 or 0x0001)"
        )
    store = typestore()
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


def record_class(type_name: str) -> Any:
    """Return the class of records of a type without defaults, which is faster; sequences are arrays."""
    check_type(type_name)
    return typestore().types[type_name]
