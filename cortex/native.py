"""What the C module needs to know of a message type to write and read it, where there is one.

It is told in rows, which `_items.c` takes. An item, a value of one type, is a tuple of its kind, the code of
the struct module if it is a number, its offset in the block of what it is part of, and what is particular to
the kind:

- enum: (number, member) for each member
- array: dtypes that it may have; sizes (-1: any) and names (a number in the scope, -1: none) of its
  dimensions; and the second number of its descriptor, less the index of the dtype
- optional: the item
- list: the item, the distance of elements, how they are aligned, how many names each has to itself, and how
  many objects each becomes
- message: its class, size of its block, how many names it has, and (name, item) for each field
"""

from __future__ import annotations

from enum import Enum
from typing import Any, TypeAlias

from cortex.body import shared_names
from cortex.compiled import native
from cortex.layout import (
    DTYPE_CODES,
    DTYPES,
    ITEM_ALIGNMENT,
    SCALAR_CODES,
    array_dtype,
    block_size,
    measure,
    measure_fields,
    stride_of,
    values_of,
)
from cortex.schema import ArrayType, EnumType, FieldType, ListType, OptionalType, Schema

_Coder: Any = native and native.Coder
NativeFastSend: Any = native and native.FastSend
"""Sends small messages; see `fast_send.py`. There is one wherever `make_coder` returns something."""
NativeFastReceive: Any = native and native.FastReceive
"""Takes messages one at a time; see `fast_receive.py`."""
_NUMBER, _BOOL, _ENUM, _FIXED, _VARIABLE, _STR, _BYTES, _OPTIONAL, _LIST, _MESSAGE = range(10)
_NAMES_MAX = 64
"""More dimensions of one message that must agree are left to Python."""

_Item: TypeAlias = tuple[int, str, int, Any]
_Message: TypeAlias = tuple[type, int, int, tuple[tuple[str, _Item], ...]]
_Scope: TypeAlias = dict[str, int]
"""The names that occur more than once, and their numbers."""


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
        block = _message(schema, cls, block_size(schema))
    except _TooManyNames:
        return None
    stamps = [
        k for k, field in enumerate(schema.fields) if field.name == "stamp_ns" and "int" in str(field.type)
    ]
    stamp = stamps[0] if stamps and isinstance(schema.fields[stamps[0]].type, str) else -1
    return _Coder(block, stamp, head)


def _scope(kinds: list[FieldType]) -> _Scope:
    scope = {name: number for number, name in enumerate(sorted(shared_names(kinds)))}
    if len(scope) > _NAMES_MAX:
        raise _TooManyNames
    return scope


def _message(schema: Schema, cls: type, size: int) -> _Message:
    scope = _scope([field.type for field in schema.fields])
    bindings = cls.__cortex_bindings__  # type: ignore[attr-defined]
    fields = tuple(
        (field.name, _item(field.type, bound, offset, scope))
        for field, bound, offset in zip(schema.fields, bindings, measure_fields(schema)[0], strict=True)
    )
    return cls, size, len(scope), fields


def _item(kind: FieldType, bound: Any, offset: int, scope: _Scope) -> _Item:
    if isinstance(kind, str):
        special = {"bool": _BOOL, "str": _STR, "bytes": _BYTES}.get(kind, _NUMBER)
        return special, SCALAR_CODES.get(kind, "-"), offset, None
    if isinstance(kind, EnumType):
        return _ENUM, "-", offset, _members(bound)
    if isinstance(kind, ArrayType):
        return _FIXED if kind.is_fixed else _VARIABLE, "-", offset, _array(kind, scope)
    if isinstance(kind, OptionalType):
        return _OPTIONAL, "-", offset, _item(kind.item, bound, measure(kind)[1], scope)
    if isinstance(kind, ListType):
        return _LIST, "-", offset, _list(kind, bound)
    return _MESSAGE, "-", offset, _message(kind, bound, measure(kind)[0])


def _members(bound: type[Enum]) -> tuple[tuple[int, Enum], ...]:
    return tuple((member.value, member) for member in bound)


def _array(kind: ArrayType, scope: _Scope) -> tuple[Any, ...]:
    is_open = kind.dtype == "any"
    sizes = tuple(size if isinstance(size, int) else -1 for size in kind.shape)
    names = tuple(scope.get(str(size), -1) for size in kind.shape)
    code = 0 if is_open else DTYPE_CODES[kind.dtype]
    return DTYPES if is_open else (array_dtype(kind),), sizes, names, len(kind.shape) << 8 | code


def _list(kind: ListType, bound: Any) -> tuple[Any, ...]:
    scope = _scope([kind.item])
    alignment = max(ITEM_ALIGNMENT, measure(kind.item)[1])
    item = _item(kind.item, bound, 0, scope)
    return item, stride_of(kind.item), alignment, len(scope), values_of(kind.item)
