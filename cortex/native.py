"""The description of a message type for the C module, where there is one."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import astuple
from typing import Any

import numpy as np

from cortex.compiled import native
from cortex.schema import EnumType, FieldType, Schema
from cortex.table import Kind, Row, Table, TooManyNames

_Coder: Any = native and native.Coder
NativeFastSend: Any = native and native.FastSend
"""Sends small messages; see `fast_send.py`. There is one wherever `make_coder` returns something."""
NativeFastReceive: Any = native and native.FastReceive
"""Takes messages one at a time; see `fast_receive.py`."""


def make_coder(schema: Schema, cls: type, head: bytes = b"") -> Any:
    """Return what writes and reads the messages of a type in C, or None if there is none or it cannot.

    Args:
        schema: Of the type.
        cls: Its class.
        head: The first 24 bytes of a publisher's frames, if it is to make or read them.
    """
    if _Coder is None:
        return None
    try:
        table = _ClassTable(schema, cls)
    except TooManyNames:
        return None  # Python does it
    stamp = schema.stamp_index + 1 if schema.stamp_index >= 0 else -1
    rows = b"".join(struct.pack("8qP5q", *astuple(row)) for row in table.rows)
    return _Coder(rows, tuple(table.objects), stamp, head)


class _ClassTable(Table):
    """The rows of a message class, and the objects whose addresses they have."""

    def __init__(self, schema: Schema, cls: type) -> None:
        self.objects: list[Any] = []
        super().__init__(schema, cls)

    def _keep(self, named: Any) -> int:
        self.objects.append(named)
        return id(named)

    def fields_of(self, schema: Schema, bound: Any) -> Iterator[tuple[Any, Any]]:
        places = (native.slot_of(bound, field.name) for field in schema.fields)
        return zip(places, bound.__cortex_bindings__, strict=True)

    def object_of(self, kind: FieldType, bound: Any) -> Any:
        return self._keep(bound) if isinstance(kind, Schema) else 0

    def dtype_of(self, dtype: np.dtype[Any]) -> Any:
        return self._keep(dtype)

    def members_of(self, kind: EnumType, bound: Any) -> list[Row]:
        """By number, and then once more by address."""
        members = [Row(Kind.MEMBER, code=each.value, object=self._keep(each)) for each in bound]
        by_number = sorted(members, key=lambda row: row.code)
        return by_number + sorted(members, key=lambda row: row.object)
