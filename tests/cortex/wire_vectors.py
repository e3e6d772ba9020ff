"""Reads the test vectors of `cortex/vectors`, as WIRE.md, section 11, describes them."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

import cortex
from cortex.schema import ArrayType, EnumType, FieldType, ListType, OptionalType, Schema, type_from_schema

DIRECTORY = Path(cortex.__file__).parent / "vectors"


def load_vectors() -> dict[str, dict[str, Any]]:
    """Return the contents of all files of one type, by name."""
    others = {"types.json", "frames.json"}
    paths = sorted(path for path in DIRECTORY.glob("*.json") if path.name not in others)
    return {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in paths}


def message_to_plain(schema: Schema, message: Any) -> dict[str, Any]:
    """Return the value of a message as in the files."""
    return {field.name: _to_plain(field.type, getattr(message, field.name)) for field in schema.fields}


def message_from_plain(schema: Schema, plain: dict[str, Any]) -> Any:
    """Return a message of `type_from_schema(schema)` from its value in the files."""
    return _message_from_plain(schema, type_from_schema(schema), plain)


def _message_from_plain(schema: Schema, cls: Any, plain: dict[str, Any]) -> Any:
    values = {
        field.name: _from_plain(field.type, bound, plain[field.name])
        for field, bound in zip(schema.fields, cls.__cortex_bindings__, strict=True)
    }
    return cls(**values)


def _to_plain(kind: FieldType, value: Any) -> Any:
    if isinstance(kind, Schema):
        return message_to_plain(kind, value)
    if isinstance(kind, OptionalType):
        return None if value is None else _to_plain(kind.item, value)
    if isinstance(kind, ListType):
        return [_to_plain(kind.item, item) for item in value]
    if isinstance(kind, EnumType):
        return value.name
    if isinstance(kind, ArrayType):
        items = np.ascontiguousarray(value).tobytes().hex()
        return {"dtype": value.dtype.name, "shape": list(value.shape), "items": items}
    if kind == "bytes":
        return value.hex()
    if kind.startswith("float") and not math.isfinite(value):
        return str(float(value))
    return value


def _from_plain(kind: FieldType, bound: Any, plain: Any) -> Any:
    if isinstance(kind, Schema):
        return _message_from_plain(kind, bound, plain)
    if isinstance(kind, OptionalType):
        return None if plain is None else _from_plain(kind.item, bound, plain)
    if isinstance(kind, ListType):
        return [_from_plain(kind.item, bound, item) for item in plain]
    if isinstance(kind, EnumType):
        return bound[plain]
    if isinstance(kind, ArrayType):
        return np.frombuffer(bytes.fromhex(plain["items"]), plain["dtype"]).reshape(plain["shape"])
    if kind == "bytes":
        return bytes.fromhex(plain)
    return float(plain) if kind.startswith("float") else plain
