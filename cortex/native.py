"""What the C module, where there is one, needs to know of a message type: a table of rows."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from enum import Enum
from typing import Any, TypeAlias

from cortex.body import shared_names
from cortex.compiled import native
from cortex.layout import (
    DTYPE_CODES,
    DTYPES,
    ITEM_ALIGNMENT,
    array_dtype,
    block_size,
    has_tail,
    measure,
    measure_fields,
    stride_of,
    values_of,
)
from cortex.schema import SCALAR_CODES, ArrayType, EnumType, FieldType, ListType, OptionalType, Schema

_Coder: Any = native and native.Coder
NativeFastSend: Any = native and native.FastSend
"""Sends small messages; see `fast_send.py`. There is one wherever `make_coder` returns something."""
NativeFastReceive: Any = native and native.FastReceive
"""Takes messages one at a time; see `fast_receive.py`."""
_NUMBER, _BOOL, _ENUM, _FIXED, _VARIABLE, _STR, _BYTES, _OPTIONAL, _LIST, _MESSAGE = range(10)
_DIMENSION, _DTYPE, _MEMBER = range(10, 13)
_NAMES_MAX = 64
"""More dimensions of one message that must agree are left to Python."""

_Scope: TypeAlias = dict[str, int]
"""The names that occur more than once, and their numbers."""


@dataclass
class Row:
    """A value of one type, or something that such a value has; `Item` in `_items.h` has the same numbers.

    Attributes:
        kind: One of those above.
        code: Number: that of the struct module; variable array: the second number of its descriptor, less the
            index of the dtype; member: its number.
        has_tail: Whether any of it lies outside of the block.
        slot: Field: where objects of the class keep it.
        offset: In the block of what it is part of [bytes].
        size: In the block [bytes]; dimension: items (-1: any); dtype: its itemsize.
        first: The first of its rows: fields of a message, what is optional, an element of a list, dimensions
            of an array and then its dtypes, members of an enum by number and then once more by address.
        count: How many fields, dimensions or members.
        object: Number of the class, dtype or member.
        scope: Message, list: how many names each has to itself; dimension: number of its name, -1: none.
        stride: List: distance of its elements [bytes].
        alignment: List: of its first element.
        values: List: how many objects an element becomes.
        dtypes: Array: how many it may have.
    """

    kind: int
    code: int = 0
    has_tail: int = 0
    slot: int = 0
    offset: int = 0
    size: int = 0
    first: int = 0
    count: int = 0
    object: int = 0
    scope: int = 0
    stride: int = 0
    alignment: int = 0
    values: int = 0
    dtypes: int = 0


class _TooManyNames(Exception):
    """The C module has no room for so many."""


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
        table = _Table(schema, cls)
    except _TooManyNames:
        return None
    stamp = schema.stamp_index + 1 if schema.stamp_index >= 0 else -1
    rows = b"".join(struct.pack("14q", *astuple(row)) for row in table.rows)
    return _Coder(rows, tuple(table.objects), stamp, head)


def _scope(kinds: list[FieldType]) -> _Scope:
    scope = {name: number for number, name in enumerate(sorted(shared_names(kinds)))}
    if len(scope) > _NAMES_MAX:
        raise _TooManyNames
    return scope


class _Table:
    """The rows of a message, the outermost first, its fields next; and the objects that rows name."""

    def __init__(self, schema: Schema, cls: type) -> None:
        self.rows = [Row(_MESSAGE)]
        self.objects: list[Any] = []
        self.rows[0] = self._message(schema, cls, block_size(schema))
        self.rows[0].has_tail = has_tail(schema)

    def _name(self, named: Any) -> int:
        """The number of an object, which is the next one."""
        self.objects.append(named)
        return len(self.objects) - 1

    def _add(self, rows: Sequence[Row]) -> int:
        """Append rows; the number of the first."""
        self.rows += rows
        return len(self.rows) - len(rows)

    def _message(self, schema: Schema, cls: type, size: int) -> Row:
        scope = _scope([field.type for field in schema.fields])
        bindings = cls.__cortex_bindings__  # type: ignore[attr-defined]
        first = self._add([Row(_MESSAGE)] * len(schema.fields))  # their places
        fields = zip(schema.fields, bindings, measure_fields(schema)[0], strict=True)
        for number, (field, bound, offset) in enumerate(fields, first):
            self.rows[number] = self._value(field.type, bound, offset, scope)
            self.rows[number].slot = native.slot_of(cls, field.name)
        counts = {"count": len(schema.fields), "scope": len(scope)}
        return Row(_MESSAGE, size=size, first=first, object=self._name(cls), **counts)

    def _value(self, kind: FieldType, bound: Any, offset: int, scope: _Scope) -> Row:
        """The row of a value, after those that it has."""
        row = self._row(kind, bound, scope)
        row.offset, row.has_tail = offset, has_tail(kind)
        row.size = measure(kind)[0]
        return row

    def _row(self, kind: FieldType, bound: Any, scope: _Scope) -> Row:
        if isinstance(kind, str):
            special = {"bool": _BOOL, "str": _STR, "bytes": _BYTES}.get(kind, _NUMBER)
            return Row(special, code=ord(SCALAR_CODES.get(kind, "-")))
        if isinstance(kind, EnumType):
            return self._enum(bound)
        if isinstance(kind, ArrayType):
            return self._array(kind, scope)
        if isinstance(kind, OptionalType):
            inner = self._value(kind.item, bound, measure(kind)[1], scope)
            return Row(_OPTIONAL, first=self._add([inner]))
        if isinstance(kind, ListType):
            return self._list(kind, bound)
        return self._message(kind, bound, measure(kind)[0])

    def _enum(self, bound: type[Enum]) -> Row:
        members = [Row(_MEMBER, code=each.value, object=self._name(each)) for each in bound]
        by_number = sorted(members, key=lambda row: row.code)
        by_address = sorted(members, key=lambda row: id(self.objects[row.object]))
        return Row(_ENUM, first=self._add([*by_number, *by_address]), count=len(members))

    def _array(self, kind: ArrayType, scope: _Scope) -> Row:
        is_open = kind.dtype == "any"
        dtypes = DTYPES if is_open else (array_dtype(kind),)
        sizes = [size if isinstance(size, int) else -1 for size in kind.shape]
        names = [scope.get(str(size), -1) for size in kind.shape]
        dimensions = [Row(_DIMENSION, size=size, scope=name) for size, name in zip(sizes, names, strict=True)]
        items = [Row(_DTYPE, size=dtype.itemsize, object=self._name(dtype)) for dtype in dtypes]
        return Row(
            _FIXED if kind.is_fixed else _VARIABLE,
            code=len(kind.shape) << 8 | (0 if is_open else DTYPE_CODES[kind.dtype]),
            first=self._add([*dimensions, *items]),
            count=len(dimensions),
            dtypes=len(items),
        )

    def _list(self, kind: ListType, bound: Any) -> Row:
        scope = _scope([kind.item])
        return Row(
            _LIST,
            first=self._add([self._value(kind.item, bound, 0, scope)]),
            scope=len(scope),
            stride=stride_of(kind.item),
            alignment=max(ITEM_ALIGNMENT, measure(kind.item)[1]),
            values=values_of(kind.item),
        )
