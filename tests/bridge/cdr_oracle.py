"""CDR written a second time, value by value, and messages with random content."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from cortex_ros2_bridge.msgs import message_class
from cortex_ros2_bridge.typestore import typestore

FORMATS = {
    "bool": "?",
    "byte": "b",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
EMPTY = "structure_needs_at_least_one_member"


class Writer:
    """Appends values, each at a multiple of its size."""

    def __init__(self, order: str) -> None:
        self.order = order
        self.body = bytearray()

    def number(self, kind: str, value: Any) -> None:
        form = FORMATS[kind]
        size = struct.calcsize(form)
        self.body += bytes(-len(self.body) % size)
        self.body += struct.pack(self.order + form, value)

    def text(self, value: str) -> None:
        coded = value.encode() + b"\0"
        self.number("uint32", len(coded))
        self.body += coded

    def value(self, desc: Any, value: Any) -> None:
        kind, what = desc
        if kind == Nodetype.BASE:
            if what[0] == "string":
                self.text(value)
            else:
                self.number(what[0], value)
        elif kind == Nodetype.NAME:
            self.message(what, value)
        else:
            if kind == Nodetype.SEQUENCE:
                self.number("uint32", len(value))
            for element in value:
                self.value(what[0], element)

    def message(self, type_name: str, message: Any) -> None:
        for name, desc in typestore().fielddefs[type_name][1]:
            self.value(desc, 0 if name == EMPTY else getattr(message, name))


def write(message: Any, type_name: str, order: str = "<") -> bytes:
    """Return a message as CDR, in an order of bytes: < little endian, > big endian."""
    writer = Writer(order)
    writer.message(type_name, message)
    body = bytes(writer.body) + bytes(-len(writer.body) % 4)
    return (b"\0\1\0\0" if order == "<" else b"\0\0\0\0") + body


def random_message(type_name: str, rng: np.random.Generator) -> Any:
    """Return a message all of whose fields are random; sequences have up to three elements."""
    message = message_class(type_name)()
    for name, desc in typestore().fielddefs[type_name][1]:
        if name != EMPTY:
            setattr(message, name, _random(desc, rng))
    return message


def _random(desc: Any, rng: np.random.Generator) -> Any:
    kind, what = desc
    if kind == Nodetype.BASE:
        return _random_base(what[0], rng)
    if kind == Nodetype.NAME:
        return random_message(what, rng)
    element, size = what
    count = size if kind == Nodetype.ARRAY else int(rng.integers(0, min(size or 3, 3) + 1))
    return [_random(element, rng) for _ in range(count)]


def _random_base(base: str, rng: np.random.Generator) -> Any:
    if base == "string":
        return "".join(chr(c) for c in rng.integers(32, 1000, rng.integers(0, 9)))
    if base == "bool":
        return bool(rng.integers(2))
    if base.startswith("float"):
        return float(np.dtype(base).type(rng.normal()))
    info = np.iinfo({"char": "uint8", "byte": "int8"}.get(base, base))
    return int(rng.integers(info.min, info.max, dtype=info.dtype.type, endpoint=True))
