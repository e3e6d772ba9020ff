"""Hypothesis strategies for schemas of every kind, and for messages of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from hypothesis import strategies as st

from cortex.schema import (
    DTYPE_NAMES,
    SCALAR_SIZES,
    ArrayType,
    EnumType,
    Field,
    FieldType,
    ListType,
    OptionalType,
    Schema,
    type_from_schema,
)

names = st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,7}", fullmatch=True).filter(lambda name: name != "mro")
type_names = st.from_regex(r"[A-Za-z0-9_./]{1,12}", fullmatch=True)
labels = st.text(st.characters(exclude_categories=("C",), exclude_characters='"\\'), max_size=4)
dimensions = st.one_of(st.sampled_from(["n", "m"]), st.integers(1, 3))
scalars = st.sampled_from([*SCALAR_SIZES, "str", "bytes"])
arrays = st.one_of(
    st.builds(ArrayType, st.sampled_from([*DTYPE_NAMES, "any"]), st.lists(dimensions, max_size=3).map(tuple)),
    st.just(ArrayType("uint8", (33, 32))),  # large enough to be aligned to 64
)
enums = st.builds(
    EnumType,
    type_names,
    st.lists(
        st.tuples(names, st.integers(-(2**31), 2**31 - 1)),
        min_size=1,
        max_size=3,
        unique_by=(lambda pair: pair[0], lambda pair: pair[1]),
    ).map(tuple),
)


def messages(kinds: st.SearchStrategy[FieldType], least: int = 1) -> st.SearchStrategy[Schema]:
    """Schemas whose fields are of the given kinds."""
    fields = st.lists(
        st.builds(Field, names, kinds, labels, labels),
        min_size=least,
        max_size=5,
        unique_by=lambda field: field.name,
    ).map(tuple)
    return st.builds(Schema, type_names, fields)


kinds: st.SearchStrategy[FieldType] = st.recursive(
    st.one_of(scalars, arrays, enums),
    lambda inner: st.one_of(
        inner.filter(lambda kind: not isinstance(kind, OptionalType)).map(OptionalType),
        inner.map(ListType),
        messages(inner),
    ),
    max_leaves=4,
)
schemas = messages(kinds, least=0)
"""Schemas of every kind."""


@st.composite
def values(draw: st.DrawFn, kind: FieldType, bound: Any, sizes: dict[str, int]) -> Any:
    """Values of one type; `sizes` holds the dimensions chosen in this scope."""
    if isinstance(kind, Schema):
        return draw(messages_of(kind, bound))
    if isinstance(kind, OptionalType):
        return draw(values(kind.item, bound, sizes)) if draw(st.booleans()) else None
    if isinstance(kind, ListType):
        return [draw(values(kind.item, bound, {})) for _ in range(draw(st.integers(0, 3)))]
    if isinstance(kind, EnumType):
        return draw(st.sampled_from(list(bound)))
    if isinstance(kind, ArrayType):
        shape = []
        for size in kind.shape:
            if isinstance(size, str):
                size = sizes.setdefault(size, draw(st.sampled_from([0, 1, 2, 9, 140])))
            shape.append(size)
        dtype = draw(st.sampled_from(DTYPE_NAMES)) if kind.dtype == "any" else kind.dtype
        count = math.prod(shape)
        items = np.random.default_rng(draw(st.integers(0, 9))).integers(0, 256, count)
        return (items > 127 if dtype == "bool" else items.astype(np.uint8)).astype(dtype).reshape(shape)
    if kind == "bool":
        return draw(st.booleans())
    if kind == "str":
        return draw(st.text(max_size=5))
    if kind == "bytes":
        return draw(st.binary(max_size=5))
    if kind.startswith("float"):
        return draw(st.floats(width=32 if kind == "float32" else 64, allow_nan=False))
    bits = 8 * SCALAR_SIZES[kind]
    low = 0 if kind.startswith("u") else -(2 ** (bits - 1))
    return draw(st.integers(low, low + 2**bits - 1))


@st.composite
def messages_of(draw: st.DrawFn, schema: Schema, cls: type) -> Any:
    """Messages of a class that has the schema."""
    sizes: dict[str, int] = {}
    bindings = zip(schema.fields, cls.__cortex_bindings__, strict=True)  # type: ignore[attr-defined]
    return cls(*[draw(values(field.type, bound, sizes)) for field, bound in bindings])


@st.composite
def any_message(draw: st.DrawFn, of: st.SearchStrategy[Schema] = schemas) -> Any:
    """Messages of any schema."""
    schema = draw(of)
    return draw(messages_of(schema, type_from_schema(schema)))
