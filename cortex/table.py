"""The places of a message's values in its body and in its memory: the table that `body_walk.h` goes through.

The C module has such a table of a class (`native.py`), generated C++ of a struct (`cppgen.py`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, TypeAlias

import numpy as np

from cortex.body import shared_names
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


class Kind(IntEnum):
    """What a row is, as `CortexKind` in `body.h`."""

    NUMBER = 0
    BOOL = 1
    ENUM = 2
    FIXED = 3
    VARIABLE = 4
    STR = 5
    BYTES = 6
    OPTIONAL = 7
    LIST = 8
    MESSAGE = 9
    DIMENSION = 10
    DTYPE = 11
    MEMBER = 12


NAMES_MAX = 64
"""Most dimensions of one message that must agree."""

_Scope: TypeAlias = dict[str, int]
"""The names that occur more than once, and their numbers."""


@dataclass
class Row:
    """A value of one type, or something that such a value has; `CortexItem` in `body.h` has the same numbers.

    Attributes:
        kind: What it is.
        code: Number: that of the struct module; variable array: the second number of its descriptor, less the
            index of the dtype; member: its number.
        has_tail: Whether any of it lies outside of the block.
        place: Field: where messages keep it.
        offset: In the block of what it is part of [bytes].
        size: In the block [bytes]; dimension: items (-1: any); dtype: its itemsize.
        first: The first of its rows: fields of a message, what is optional, an element of a list, dimensions
            of an array and then its dtypes, members of an enum by number and then once more by address.
        count: How many fields, dimensions or members.
        object: What the language has for it: a class, a dtype, a member.
        scope: Message, list: how many names each has to itself; dimension: number of its name, -1: none.
        stride: List: distance of its elements [bytes].
        alignment: List: of its first element.
        values: List: how many objects an element becomes.
        dtypes: Array: how many it may have.
    """

    kind: Kind
    code: int = 0
    has_tail: int = 0
    place: Any = 0
    offset: int = 0
    size: int = 0
    first: int = 0
    count: int = 0
    object: Any = 0
    scope: int = 0
    stride: int = 0
    alignment: int = 0
    values: int = 0
    dtypes: int = 0


class TooManyNames(ValueError):
    """More dimensions of one message must agree than there is room for."""


def _scope(kinds: list[FieldType]) -> _Scope:
    scope = {name: number for number, name in enumerate(sorted(shared_names(kinds)))}
    if len(scope) > NAMES_MAX:
        raise TooManyNames(f"more than {NAMES_MAX} dimensions of one message must agree")
    return scope


class Table(ABC):
    """The rows of a message, the outermost first, its fields next.

    Args:
        schema: Of the message.
        bound: What the language has for its type.

    Raises:
        TooManyNames: More dimensions of one message must agree than there is room for.
    """

    def __init__(self, schema: Schema, bound: Any) -> None:
        self.rows = [Row(Kind.MESSAGE)]
        self.rows[0] = self._message(schema, bound, block_size(schema))
        self.rows[0].has_tail = has_tail(schema)

    @abstractmethod
    def fields_of(self, schema: Schema, bound: Any) -> Iterator[tuple[Any, Any]]:
        """Where messages keep each of their fields, and what the language has for the field's type."""

    @abstractmethod
    def object_of(self, kind: FieldType, bound: Any) -> Any:
        """What a message, an array, an optional or a list is in the language."""

    def is_plain(self, kind: ArrayType) -> bool:
        """Whether an array of a fixed shape lies in a message as in a body."""
        return False

    def dimension_of(self, size: int | str) -> Any:
        """What the language has to know of a dimension."""
        return 0

    def dtype_of(self, dtype: np.dtype[Any]) -> Any:
        """What a dtype is in the language."""
        return 0

    def members_of(self, kind: EnumType, bound: Any) -> list[Row]:
        """The members of an enum by number, and behind them what the language wants there."""
        return [Row(Kind.MEMBER, code=number) for number in sorted({number for _, number in kind.values})]

    def _add(self, rows: Sequence[Row]) -> int:
        """Append rows; the number of the first."""
        self.rows += rows
        return len(self.rows) - len(rows)

    def _message(self, schema: Schema, bound: Any, size: int) -> Row:
        scope = _scope([field.type for field in schema.fields])
        first = self._add([Row(Kind.MESSAGE)] * len(schema.fields))  # their places
        fields = zip(schema.fields, self.fields_of(schema, bound), measure_fields(schema)[0], strict=True)
        for number, (field, (place, of), offset) in enumerate(fields, first):
            self.rows[number] = self._value(field.type, of, offset, scope)
            self.rows[number].place = place
        counts = {"count": len(schema.fields), "scope": len(scope)}
        return Row(Kind.MESSAGE, size=size, first=first, object=self.object_of(schema, bound), **counts)

    def _value(self, kind: FieldType, bound: Any, offset: int, scope: _Scope) -> Row:
        """The row of a value, after those that it has."""
        row = self._row(kind, bound, scope)
        row.offset, row.has_tail = offset, has_tail(kind)
        row.size = measure(kind)[0]
        return row

    def _row(self, kind: FieldType, bound: Any, scope: _Scope) -> Row:
        if isinstance(kind, str):
            special = {"bool": Kind.BOOL, "str": Kind.STR, "bytes": Kind.BYTES}.get(kind, Kind.NUMBER)
            return Row(special, code=ord(SCALAR_CODES.get(kind, "-")))
        if isinstance(kind, EnumType):
            return Row(
                Kind.ENUM,
                first=self._add(self.members_of(kind, bound)),
                count=len(set(dict(kind.values).values())),
            )
        if isinstance(kind, ArrayType) and self.is_plain(kind):
            return Row(Kind.NUMBER)
        if isinstance(kind, ArrayType):
            return self._array(kind, bound, scope)
        if isinstance(kind, OptionalType):
            inner = self._value(kind.item, bound, measure(kind)[1], scope)
            return Row(Kind.OPTIONAL, first=self._add([inner]), object=self.object_of(kind, bound))
        if isinstance(kind, ListType):
            return self._list(kind, bound)
        return self._message(kind, bound, measure(kind)[0])

    def _array(self, kind: ArrayType, bound: Any, scope: _Scope) -> Row:
        is_open = kind.dtype == "any"
        dtypes = DTYPES if is_open else (array_dtype(kind),)
        dimensions = [
            Row(
                Kind.DIMENSION,
                size=size if isinstance(size, int) else -1,
                scope=scope.get(str(size), -1),
                object=self.dimension_of(size),
            )
            for size in kind.shape
        ]
        items = [Row(Kind.DTYPE, size=dtype.itemsize, object=self.dtype_of(dtype)) for dtype in dtypes]
        return Row(
            Kind.FIXED if kind.is_fixed else Kind.VARIABLE,
            code=len(kind.shape) << 8 | (0 if is_open else DTYPE_CODES[kind.dtype]),
            first=self._add([*dimensions, *items]),
            count=len(dimensions),
            object=self.object_of(kind, bound),
            dtypes=len(items),
        )

    def _list(self, kind: ListType, bound: Any) -> Row:
        scope = _scope([kind.item])
        return Row(
            Kind.LIST,
            first=self._add([self._value(kind.item, bound, 0, scope)]),
            object=self.object_of(kind, bound),
            scope=len(scope),
            stride=stride_of(kind.item),
            alignment=max(ITEM_ALIGNMENT, measure(kind.item)[1]),
            values=values_of(kind.item),
        )
