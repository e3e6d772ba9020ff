"""Bodies written and read as WIRE.md section 5 says, from the JSON of a schema alone; naive on purpose."""

from __future__ import annotations

import math
import struct
from typing import Any

CODES = {
    "bool": "?",
    "int8": "b",
    "int16": "h",
    "int32": "i",
    "int64": "q",
    "uint8": "B",
    "uint16": "H",
    "uint32": "I",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
DTYPES = ["bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"]
DTYPES += ["float16", "float32", "float64", "complex64", "complex128"]
ITEMSIZES = dict(zip(DTYPES, (1, 1, 2, 4, 8, 1, 2, 4, 8, 2, 4, 8, 8, 16), strict=True))


class Bad(ValueError):
    """The body breaks a rule."""


def up(position: int, multiple: int) -> int:
    while position % multiple:
        position += 1
    return position


def is_fixed_array(kind: dict) -> bool:
    return kind["array"] != "any" and not any(isinstance(n, str) for n in kind["shape"])


def size_and_alignment(kind: Any) -> tuple[int, int]:
    if kind in ("str", "bytes"):
        return 8, 4
    if isinstance(kind, str):
        size = struct.calcsize(CODES[kind])
        return size, size
    if "enum" in kind:
        return 4, 4
    if "list" in kind:
        return 8, 4
    if "array" in kind:
        if not is_fixed_array(kind):
            return 8 + 4 * len(kind["shape"]), 4
        item = ITEMSIZES[kind["array"]]
        size = math.prod(kind["shape"]) * item
        return size, 64 if size >= 1024 else item
    if "optional" in kind:
        size, alignment = size_and_alignment(kind["optional"])
        return up(alignment + size, alignment), alignment
    end, largest = 0, 1
    for field in kind["message"]["fields"]:
        size, alignment = size_and_alignment(field["type"])
        end = up(end, alignment) + size
        largest = max(largest, alignment)
    return up(end, largest), largest


def has_tail(kind: Any) -> bool:
    if isinstance(kind, str):
        return kind in ("str", "bytes")
    if "optional" in kind:
        return has_tail(kind["optional"])
    if "message" in kind:
        return any(has_tail(field["type"]) for field in kind["message"]["fields"])
    return "list" in kind or ("array" in kind and not is_fixed_array(kind))


def encode(schema: dict, value: dict) -> bytes:
    """Write a body; values are as in the vector files, but bytes and arrays' items are bytes."""
    body = bytearray(up(size_and_alignment({"message": schema})[0], 8))
    write(body, 0, {"message": schema}, value)
    return bytes(body)


def append(body: bytearray, data: bytes, alignment: int) -> int:
    if not data:
        return 0
    body += bytes(up(len(body), alignment) - len(body))
    body += data
    return len(body) - len(data)


def write(body: bytearray, at: int, kind: Any, value: Any) -> None:
    if kind in ("str", "bytes"):
        data = value.encode() if kind == "str" else value
        struct.pack_into("<II", body, at, append(body, data, 8), len(data))
    elif isinstance(kind, str):
        struct.pack_into("<" + CODES[kind], body, at, value)
    elif "enum" in kind:
        struct.pack_into("<i", body, at, kind["values"][value])
    elif "array" in kind:
        data = value["items"]
        if is_fixed_array(kind):
            body[at : at + len(data)] = data
            return
        shape = value["shape"]
        offset = append(body, data, 64 if len(data) >= 1024 else 8)
        code = DTYPES.index(value["dtype"])
        struct.pack_into(f"<IBBH{len(shape)}I", body, at, offset, code, len(shape), 0, *shape)
    elif "optional" in kind:
        if value is not None:
            body[at] = 1
            write(body, at + size_and_alignment(kind)[1], kind["optional"], value)
    elif "list" in kind:
        size, alignment = size_and_alignment(kind["list"])
        stride = max(1, up(size, alignment))
        start = append(body, bytes(stride * len(value)), max(8, alignment))
        struct.pack_into("<II", body, at, start, len(value))
        for index, item in enumerate(value):
            write(body, start + index * stride, kind["list"], item)
    else:
        end = at
        for field in kind["message"]["fields"]:
            size, alignment = size_and_alignment(field["type"])
            end = at + up(end - at, alignment)
            write(body, end, field["type"], value[field["name"]])
            end += size


class Reader:
    """Reads one body."""

    def __init__(self, schema: dict, body: bytes) -> None:
        self.schema = schema
        self.body = body
        self.claimed = up(size_and_alignment({"message": schema})[0], 8)

    def message(self) -> dict:
        kind = {"message": self.schema}
        if len(self.body) < self.claimed or (not has_tail(kind) and len(self.body) != self.claimed):
            raise Bad("size")
        value: dict = self.read(0, kind, {})
        if self.claimed > len(self.body):
            raise Bad("items share bytes")
        return value

    def item(self, offset: int, size: int) -> bytes:
        if offset + size > len(self.body):
            raise Bad("beyond the body")
        self.claimed += size
        if self.claimed > len(self.body):  # already here, so that a bomb ends early
            raise Bad("items share bytes")
        return self.body[offset : offset + size]

    def read(self, at: int, kind: Any, names: dict[str, int]) -> Any:
        body = self.body
        if kind in ("str", "bytes"):
            data = self.item(*struct.unpack_from("<II", body, at))
            try:
                return data.decode() if kind == "str" else data
            except UnicodeDecodeError as error:
                raise Bad("text") from error
        if kind == "bool" or (not isinstance(kind, str) and "optional" in kind):
            if body[at] > 1:
                raise Bad("truth")
            if kind == "bool":
                return body[at] == 1
            inner = at + size_and_alignment(kind)[1]
            return self.read(inner, kind["optional"], names) if body[at] else None
        if isinstance(kind, str):
            return struct.unpack_from("<" + CODES[kind], body, at)[0]
        if "enum" in kind:
            (number,) = struct.unpack_from("<i", body, at)
            if number not in kind["values"].values():
                raise Bad("enum")
            return next(name for name, value in kind["values"].items() if value == number)
        if "array" in kind:
            return self.array(at, kind, names)
        if "list" in kind:
            size, alignment = size_and_alignment(kind["list"])
            stride = max(1, up(size, alignment))
            start, count = struct.unpack_from("<II", body, at)
            self.item(start, count * stride)
            return [self.read(start + index * stride, kind["list"], {}) for index in range(count)]
        values, end, names = {}, at, {}
        for field in kind["message"]["fields"]:
            size, alignment = size_and_alignment(field["type"])
            end = at + up(end - at, alignment)
            values[field["name"]] = self.read(end, field["type"], names)
            end += size
        return values

    def array(self, at: int, kind: dict, names: dict[str, int]) -> dict:
        shape = kind["shape"]
        if is_fixed_array(kind):
            size = math.prod(shape) * ITEMSIZES[kind["array"]]
            return {"dtype": kind["array"], "shape": shape, "items": self.body[at : at + size]}
        offset, code, rank, reserved, *actual = struct.unpack_from(f"<IBBH{len(shape)}I", self.body, at)
        if rank != len(shape) or reserved or code >= len(DTYPES):
            raise Bad("descriptor")
        if kind["array"] not in ("any", DTYPES[code]):
            raise Bad("dtype")
        for wanted, size in zip(shape, actual, strict=True):
            if names.setdefault(wanted, size) != size if isinstance(wanted, str) else wanted != size:
                raise Bad("shape")
        item = ITEMSIZES[DTYPES[code]]
        if not math.prod(actual) and math.prod(n for n in actual if n) * item >= 2**63:
            raise Bad("too big even without items")
        items = self.item(offset, math.prod(actual) * item)
        return {"dtype": DTYPES[code], "shape": actual, "items": items}


def decode(schema: dict, body: bytes) -> dict:
    """Read a body, or raise `Bad`."""
    return Reader(schema, body).message()
