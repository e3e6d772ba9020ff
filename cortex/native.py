"""The short cuts of the C module for messages of numbers, strings and arrays, where there is one."""

from __future__ import annotations

from typing import Any

from cortex.compiled import native
from cortex.fast import describe_arrays
from cortex.layout import (
    SCALAR_CODES,
    array_dtype,
    block_size,
    measure_fields,
)
from cortex.schema import ArrayType, FieldType, Schema

_Flat: Any = native and native.Flat
NativeGate: Any = native and native.Gate
"""Sends small messages; see `gate.py`. There is one wherever `make_flat` returns something."""
NativePipeWriter: Any = native and native.PipeWriter
NativePipeReader: Any = native and native.PipeReader
"""The ends of a pipe; see `pipe.py`."""
_NUMBER, _BOOL, _FIXED, _VARIABLE, _STR, _BYTES = range(6)
_RANK_MAX = 8
_SHARED_MAX = 16
_FIELDS_MAX = 64


def make_flat(schema: Schema, cls: type, head: bytes = b"") -> Any:
    """Return what writes and reads the messages of a type, or None if the short cuts do not serve it.

    Args:
        schema: Of the type.
        cls: Its class.
        head: The first 24 bytes of a publisher's frames, if it is to make or read them.
    """
    fields = schema.fields
    if _Flat is None or not 0 < len(fields) <= _FIELDS_MAX:
        return None
    known, shared = describe_arrays([field.type for field in fields])
    if shared > _SHARED_MAX:
        return None
    rows = []
    for field, array, offset in zip(fields, known, measure_fields(schema)[0], strict=True):
        row = _row(field.type, array)
        if row is None:
            return None
        kind, code, *rest = row
        rows.append((field.name, kind, code, offset, *rest))
    stamps = [k for k, field in enumerate(fields) if field.name == "stamp_ns" and "int" in str(field.type)]
    stamp = stamps[0] if stamps and isinstance(fields[stamps[0]].type, str) else -1
    return _Flat(cls, rows, block_size(schema), stamp, head)


def _row(kind: FieldType, array: Any) -> tuple[Any, ...] | None:
    """Kind, code, dtype, sizes, names and head of a field; None if it is none of those served."""
    if array is not None:
        if array.dtype is None or array.rank > _RANK_MAX:
            return None
        sizes, names = [-1] * array.rank, [-1] * array.rank
        for axis, size in array.sizes:
            sizes[axis] = size
        for axis, name in array.names:
            names[axis] = name
        return _VARIABLE, "-", array.dtype, tuple(sizes), tuple(names), array.head
    if isinstance(kind, ArrayType):
        if len(kind.shape) > _RANK_MAX:
            return None
        return _FIXED, "-", array_dtype(kind), kind.shape, (-1,) * len(kind.shape), 0
    if not isinstance(kind, str):
        return None
    special = {"bool": _BOOL, "str": _STR, "bytes": _BYTES}.get(str(kind))
    if special is not None:
        return special, "-", None, (), (), 0
    return _NUMBER, SCALAR_CODES[str(kind)], None, (), (), 0
