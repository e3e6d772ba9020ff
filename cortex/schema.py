"""Schemas: the structure of messages as records, canonical JSON and fingerprint (WIRE.md, section 4)."""

from __future__ import annotations

import json
import math
import re
import struct
import threading
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from hashlib import blake2b
from typing import Any, TypeAlias

import numpy as np

from cortex.structure import make_class

_INTEGERS = (f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))
_SCALARS = ("bool", *_INTEGERS, "float32", "float64")
SCALAR_CODES = dict(zip(_SCALARS, "BbhiqBHIQfd", strict=True))
"""Scalar types, and their codes of the struct module; a bool is a byte, so that a 2 can be told from a 1."""
SCALAR_SIZES = {name: struct.calcsize(code) for name, code in SCALAR_CODES.items()}
"""Scalar types and their size [bytes]."""

DTYPE_NAMES = (*_SCALARS[:9], "float16", *_SCALARS[9:], "complex64", "complex128")
"""Types of array items; the index is the code on the wire."""

ANY_DTYPE = "any"
MAX_FIELDS = 256
MAX_DEPTH = 8
MAX_TEXT_BYTES = 1 << 16
MAX_NODES = 2048
"""Most fields, enum values and dimensions of a schema, nested ones included: it takes time to build each."""
MAX_DIMENSIONS = 32
MAX_LABEL = 64
MAX_FIXED_BYTES = 1 << 30
"""Largest fixed block, and so fixed array, of a message: what a body may have by default."""

_FIELD_NAME = re.compile(r"(?!__)[A-Za-z_][A-Za-z0-9_]{0,63}")
_TYPE_NAME = re.compile(r"[A-Za-z0-9_./]{1,128}")
_LABEL_FORBIDDEN = re.compile(r'[\x00-\x1f\x7f"\\\ud800-\udfff]')


class SchemaError(ValueError):
    """A schema, or the annotation it comes from, breaks a rule of WIRE.md section 4."""


@dataclass(frozen=True)
class Unit:
    """The unit of a field, and the frame that its components are expressed in.

    Both are part of the fingerprint: a publisher in degrees and a subscriber in radians do not match.
    """

    unit: str = ""
    """SI symbol such as "m/s"; empty for counts, names and the like."""
    frame: str = ""
    """Name of the frame, such as "world"; empty where there is none."""


@dataclass(frozen=True)
class EnumType:
    """A closed set of named 32-bit integers."""

    name: str
    values: tuple[tuple[str, int], ...]
    """Names and values, in order of definition."""

    def __post_init__(self) -> None:
        _check_type_name(self.name)
        if not self.values:
            raise SchemaError(f"enum {self.name} has no values")
        names = [name for name, _ in self.values]
        for name, value in self.values:
            _check_field_name(name, "enum value")
            if type(value) is not int or not -(2**31) <= value < 2**31:
                raise SchemaError(f"enum {self.name}: {name} is {value!r}, allowed are 32-bit integers")
        if len(set(names)) != len(names):
            raise SchemaError(f"enum {self.name} defines a name twice: {names}")


@dataclass(frozen=True)
class ArrayType:
    """An array: the type of its items, and its shape."""

    dtype: str
    """A name of `DTYPE_NAMES`, or "any"."""
    shape: tuple[int | str, ...]
    """One entry for each dimension: its size, or a name. One name has one size within a message."""

    def __post_init__(self) -> None:
        if self.dtype != ANY_DTYPE and self.dtype not in DTYPE_NAMES:
            raise SchemaError(f"array dtype {self.dtype!r}, allowed are {', '.join(DTYPE_NAMES)} and any")
        if len(self.shape) > MAX_DIMENSIONS:
            raise SchemaError(f"array of {len(self.shape)} dimensions, allowed are {MAX_DIMENSIONS}")
        for size in self.shape:
            if isinstance(size, str):
                _check_field_name(size, "dimension")
            elif type(size) is not int or not 1 <= size < 2**32:
                raise SchemaError(f"array dimension {size!r}, allowed are names and 1 to 2^32 - 1")
        if self.is_fixed:
            size = math.prod(size for size in self.shape if isinstance(size, int))
            _check_fixed_size("array of fixed size", size * np.dtype(self.dtype).itemsize)

    @property
    def is_fixed(self) -> bool:
        """Whether dtype and shape are known, so that the items lie in the fixed block."""
        return self.dtype != ANY_DTYPE and all(isinstance(size, int) for size in self.shape)


@dataclass(frozen=True)
class OptionalType:
    """A value or nothing."""

    item: FieldType

    def __post_init__(self) -> None:
        if isinstance(self.item, OptionalType):
            raise SchemaError("an optional directly within an optional")
        _check_nested(self.item)


@dataclass(frozen=True)
class ListType:
    """Any number of values of one type."""

    item: FieldType

    def __post_init__(self) -> None:
        _check_nested(self.item)


@dataclass(frozen=True)
class Field:
    """One field of a message."""

    name: str
    type: FieldType
    unit: str = ""
    frame: str = ""

    def __post_init__(self) -> None:
        _check_field_name(self.name, "field")
        if isinstance(self.type, str) and self.type not in SCALAR_SIZES and self.type not in ("str", "bytes"):
            raise SchemaError(f"field {self.name}: unknown type {self.type!r}")
        _check_nested(self.type)
        for what, text in (("unit", self.unit), ("frame", self.frame)):
            if not isinstance(text, str) or len(text) > MAX_LABEL or _LABEL_FORBIDDEN.search(text):
                raise SchemaError(
                    f"field {self.name}: {what} {text!r}, allowed are up to {MAX_LABEL} characters, none of "
                    'them a control character, " or \\'
                )


@dataclass(frozen=True)
class Schema:
    """The structure of a message type; two types with equal schemas are the same on the wire."""

    name: str
    fields: tuple[Field, ...]

    def __post_init__(self) -> None:
        _check_type_name(self.name)
        if len(self.fields) > MAX_FIELDS:
            raise SchemaError(f"{self.name} has {len(self.fields)} fields, allowed are {MAX_FIELDS}")
        names = [field.name for field in self.fields]
        if len(set(names)) != len(names):
            twice = sorted({name for name in names if names.count(name) > 1})
            raise SchemaError(f"{self.name} defines a field twice: {', '.join(twice)}")
        if _depth(self) > MAX_DEPTH:
            raise SchemaError(f"{self.name} nests {_depth(self)} levels deep, allowed are {MAX_DEPTH}")
        if _count_nodes(self) > MAX_NODES:
            raise SchemaError(
                f"{self.name} has {_count_nodes(self)} fields, enum values and dimensions with those of "
                f"nested types, allowed are {MAX_NODES}"
            )
        from cortex.layout import block_size  # it needs the records of this module

        _check_fixed_size(self.name, block_size(self))
        if len(self._text.encode()) > MAX_TEXT_BYTES:
            raise SchemaError(f"{self.name}: the schema is longer than {MAX_TEXT_BYTES} bytes")

    @cached_property
    def _text(self) -> str:
        return json.dumps(_schema_to_plain(self), ensure_ascii=False, separators=(",", ":"))

    @cached_property
    def _node_count(self) -> int:
        return len(self.fields) + sum(_count_nodes(field.type) for field in self.fields)

    @cached_property
    def stamp_index(self) -> int:
        """Which field is the stamp: the integer `stamp_ns`; -1 if there is none."""
        kinds = [str(field.type) if field.name == "stamp_ns" else "" for field in self.fields]
        return next((k for k, kind in enumerate(kinds) if kind.startswith(("int", "uint"))), -1)

    @cached_property
    def fingerprint(self) -> int:
        """64 bits that identify the structure."""
        return fingerprint_of(self._text.encode())

    def to_json(self) -> str:
        """Return the canonical text."""
        return self._text

    @classmethod
    def from_json(cls, text: str) -> Schema:
        """Read a canonical text.

        Raises:
            SchemaError: The text is not JSON, not a schema, over a limit, or not canonical.
        """
        if len(text) > MAX_TEXT_BYTES:
            raise SchemaError(f"schema of {len(text)} characters, allowed are {MAX_TEXT_BYTES} bytes")
        try:
            plain = json.loads(text, object_pairs_hook=_unique_keys)
        except (ValueError, RecursionError) as error:
            raise SchemaError(f"schema is not JSON: {error}") from error
        schema = _schema_from_plain(plain, 1)
        if schema.to_json() != text:
            raise SchemaError(f"schema of {schema.name} is not written canonically")
        return schema


FieldType: TypeAlias = "str | EnumType | ArrayType | OptionalType | ListType | Schema"
"""What a field may hold: the name of a scalar type, "str", "bytes", or one of the records."""


class TypeMismatch(TypeError):
    """Two ends of a topic or service disagree about the type; the text shows both structures."""

    def __init__(self, what: str, expected: Schema | None, actual: Schema | None) -> None:
        super().__init__(what, expected, actual)
        self.what = what
        self.expected = expected
        self.actual = actual

    def __str__(self) -> str:
        parts = [self.what]
        for title, schema in (("expected", self.expected), ("actual", self.actual)):
            parts.append(f"{title}: {describe(schema) if schema is not None else 'unknown'}")
        return "\n".join(parts)


def fingerprint_of(data: bytes) -> int:
    """Return the 64-bit fingerprint of some bytes."""
    return int.from_bytes(blake2b(data, digest_size=8).digest(), "little")


def nested(kind: FieldType) -> Iterator[FieldType]:
    """Yield a type, and all that it consists of."""
    yield kind
    if isinstance(kind, (OptionalType, ListType)):
        yield from nested(kind.item)
    elif isinstance(kind, Schema):
        for field in kind.fields:
            yield from nested(field.type)


def schema_of(message_type: type) -> Schema:
    """Return the schema of a message type.

    Raises:
        TypeError: It is not a class made by `@message`.
    """
    schema = vars(message_type).get("__cortex_schema__") if isinstance(message_type, type) else None
    if not isinstance(schema, Schema):
        raise TypeError(f"{message_type!r} is not a message type; decorate the class with @cortex.message")
    return schema


def describe(schema: Schema) -> str:
    """Return the structure as readable text: one line for each field, nested messages indented."""
    return "\n".join([f"{schema.name} ({schema.fingerprint:016x})", *_describe_fields(schema, "  ")])


def describe_field(field: Field, width: int = 0) -> str:
    """Return the name of a field, padded, its type, unit and frame."""
    unit = f" [{field.unit}]" if field.unit else ""
    frame = f" in {field.frame}" if field.frame else ""
    return f"{field.name:<{width}}  {_describe_type(field.type)}{unit}{frame}"


def _describe_fields(schema: Schema, indent: str) -> Iterator[str]:
    names = max((len(field.name) for field in schema.fields), default=0)
    for field in schema.fields:
        yield indent + describe_field(field, names)
        inner: FieldType = field.type
        while isinstance(inner, (OptionalType, ListType)):
            inner = inner.item
        if isinstance(inner, Schema):
            yield from _describe_fields(inner, indent + "  ")


def _describe_type(kind: FieldType) -> str:
    if isinstance(kind, str):
        return kind
    if isinstance(kind, ArrayType):
        return f"{kind.dtype}[{', '.join(str(size) for size in kind.shape)}]"
    if isinstance(kind, EnumType):
        return f"enum {kind.name} {{{', '.join(f'{name} = {value}' for name, value in kind.values)}}}"
    if isinstance(kind, OptionalType):
        return f"optional {_describe_type(kind.item)}"
    if isinstance(kind, ListType):
        return f"list of {_describe_type(kind.item)}"
    return f"message {kind.name}"


# Checks


def _check_field_name(name: object, what: str) -> None:
    if not isinstance(name, str) or not _FIELD_NAME.fullmatch(name):
        raise SchemaError(
            f"{what} name {name!r}, allowed are 1 to 64 of A-Z a-z 0-9 _, not starting with a digit or __"
        )


def _check_type_name(name: object) -> None:
    if not isinstance(name, str) or not _TYPE_NAME.fullmatch(name):
        raise SchemaError(f"type name {name!r}, allowed are 1 to 128 of A-Z a-z 0-9 _ . /")


def _check_nested(kind: FieldType) -> None:
    # A nested message without fields would occupy no byte: a list of them could claim any amount of memory.
    if isinstance(kind, Schema) and not kind.fields:
        raise SchemaError(f"{kind.name} has no fields; only the outermost message may be empty")


def _check_fixed_size(what: str, size: int) -> None:
    if size > MAX_FIXED_BYTES:
        raise SchemaError(f"{what}: a fixed part of {size} bytes, allowed are {MAX_FIXED_BYTES}")


def _count_nodes(kind: FieldType) -> int:
    if isinstance(kind, (OptionalType, ListType)):
        return _count_nodes(kind.item)
    if isinstance(kind, Schema):
        return kind._node_count
    if isinstance(kind, EnumType):
        return len(kind.values)
    return len(kind.shape) if isinstance(kind, ArrayType) else 0


def _depth(kind: FieldType) -> int:
    if isinstance(kind, (OptionalType, ListType)):
        return 1 + _depth(kind.item)
    if isinstance(kind, Schema):
        return 1 + max((_depth(field.type) for field in kind.fields), default=0)
    return 0


# JSON


def _schema_to_plain(schema: Schema) -> dict[str, Any]:
    fields = [
        {"name": field.name, "type": _type_to_plain(field.type), "unit": field.unit, "frame": field.frame}
        for field in schema.fields
    ]
    return {"name": schema.name, "fields": fields}


def _type_to_plain(kind: FieldType) -> Any:
    if isinstance(kind, str):
        return kind
    if isinstance(kind, EnumType):
        return {"enum": kind.name, "values": dict(kind.values)}
    if isinstance(kind, ArrayType):
        return {"array": kind.dtype, "shape": list(kind.shape)}
    if isinstance(kind, OptionalType):
        return {"optional": _type_to_plain(kind.item)}
    if isinstance(kind, ListType):
        return {"list": _type_to_plain(kind.item)}
    return {"message": _schema_to_plain(kind)}


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        raise ValueError(f"a key appears twice among {[key for key, _ in pairs]}")
    return result


def _require(condition: bool, what: str) -> None:
    if not condition:
        raise SchemaError(f"schema: {what}")


def _schema_from_plain(plain: Any, depth: int) -> Schema:
    _require(isinstance(plain, dict) and set(plain) == {"name", "fields"}, "a message is {name, fields}")
    _require(isinstance(plain["fields"], list), "fields must be an array")
    _require(depth <= MAX_DEPTH, f"nested more than {MAX_DEPTH} levels deep")
    fields = []
    for item in plain["fields"]:
        _require(
            isinstance(item, dict) and set(item) == {"name", "type", "unit", "frame"},
            "a field is {name, type, unit, frame}",
        )
        kind = _type_from_plain(item["type"], depth)
        fields.append(Field(item["name"], kind, item["unit"], item["frame"]))
    return Schema(plain["name"], tuple(fields))


def _type_from_plain(plain: Any, depth: int) -> FieldType:
    if isinstance(plain, str):
        _require(plain in SCALAR_SIZES or plain in ("str", "bytes"), f"unknown type {plain!r}")
        return plain
    _require(isinstance(plain, dict), f"a type is a string or an object, not {plain!r:.100}")
    _require(depth <= MAX_DEPTH, f"nested more than {MAX_DEPTH} levels deep")
    keys = set(plain)
    if keys == {"enum", "values"}:
        _require(isinstance(plain["values"], dict), "the values of an enum must be an object")
        return EnumType(plain["enum"], tuple(plain["values"].items()))
    if keys == {"array", "shape"}:
        _require(isinstance(plain["shape"], list), "the shape of an array must be an array")
        return ArrayType(plain["array"], tuple(plain["shape"]))
    if keys == {"optional"}:
        return OptionalType(_type_from_plain(plain["optional"], depth + 1))
    if keys == {"list"}:
        return ListType(_type_from_plain(plain["list"], depth + 1))
    if keys == {"message"}:
        return _schema_from_plain(plain["message"], depth + 1)
    raise SchemaError(f"schema: a type with the keys {sorted(keys)!r:.100} is unknown")


# Classes from schemas

_CACHE_LIMIT = 256
_classes: OrderedDict[str, type] = OrderedDict()
_classes_lock = threading.Lock()


def type_from_schema(schema: Schema) -> type:
    """Return a message class for a schema that came over the wire.

    Equal schemas give the same class while it is among the 256 used last. Its fields are read as attributes;
    a field whose name is also that of a method (`copy`) hides the method, and one named like a keyword is
    read with `getattr`. No code is generated.

    Raises:
        SchemaError: An enum of the schema cannot be an enum in Python.
    """
    # The text, not the fingerprint, is the key: 64 bits do not withstand somebody who looks for collisions.
    key = schema.to_json()
    with _classes_lock:
        if key in _classes:
            _classes.move_to_end(key)
            return _classes[key]
    bindings = tuple(_binding(field.type) for field in schema.fields)
    short_name = re.split(r"[./]", schema.name)[-1] or "Message"
    created = make_class(short_name, [field.name for field in schema.fields])
    attach_schema(created, schema, bindings)
    with _classes_lock:
        created = _classes.setdefault(key, created)
        while len(_classes) > _CACHE_LIMIT:
            _classes.popitem(last=False)
    return created


def attach_schema(message_type: type, schema: Schema, bindings: tuple[Any, ...]) -> None:
    """Make a class a message type.

    Args:
        message_type: Class from `structure`.
        schema: Its structure.
        bindings: For each field the Python class that stands for its enum or message, else None; for
            optionals and lists that of their items.
    """
    attributes = {"schema": schema, "fingerprint": schema.fingerprint, "bindings": bindings}
    for key, value in attributes.items():
        setattr(message_type, f"__cortex_{key}__", value)


def _binding(kind: FieldType) -> Any:
    if isinstance(kind, EnumType):
        try:
            created: Any = Enum(kind.name, list(kind.values), module=__name__)  # type: ignore[misc]
        except (ValueError, TypeError, AttributeError) as error:
            raise SchemaError(f"enum {kind.name} cannot be an enum in Python: {error}") from error
        if [(name, member.value) for name, member in created.__members__.items()] != list(kind.values):
            raise SchemaError(f"enum {kind.name} cannot be an enum in Python: it has reserved names")
        return created
    if isinstance(kind, Schema):
        return type_from_schema(kind)
    if isinstance(kind, (OptionalType, ListType)):
        return _binding(kind.item)
    return None
