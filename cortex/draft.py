"""Messages that are written in place: their large arrays are views of the memory that will be sent."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cortex.body import Body, Writer, check_shape
from cortex.layout import DTYPE_CODES, DTYPES, alignment_of, array_dtype
from cortex.schema import ArrayType, Schema, nested

_PLACED_MAX = 64
"""Sizes of drafts whose places are kept."""
RESERVE_BYTES = 4096
"""Room that a draft has for strings, lists and arrays of unknown size."""


_Items = tuple[tuple[str, Any], ...]


class _Place(NamedTuple):
    """Where a variable array of a draft lies."""

    offset: int
    shape: tuple[int, ...]
    dtype: np.dtype[Any]


class Draft:
    """A message being written, with one attribute for each field.

    Fixed arrays, and variable ones whose dimensions were given, are writable views: `draft.data[:] = ...`.
    Assigning to them copies into the view. Other fields are assigned as usual.
    """

    __slots__ = ("__buffer", "__places", "__values", "__views")

    def __init__(self, buffer: NDArray[np.uint8], names: tuple[str, ...], places: dict[str, _Place]) -> None:
        hidden = {"buffer": buffer, "places": places, "values": dict.fromkeys(names, _UNSET), "views": {}}
        for key, value in hidden.items():
            object.__setattr__(self, f"_Draft__{key}", value)

    def __getattr__(self, name: str) -> Any:
        value = self.__views.get(name, self.__values.get(name, _UNSET))
        if value is _UNSET:
            known = "is not set yet" if name in self.__values else f"is none of {', '.join(self.__values)}"
            raise AttributeError(f"field {name} {known}")
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        if name in self.__views:
            view = self.__views[name]
            if np.shape(value) != view.shape:
                raise ValueError(f"{name}: shape {list(np.shape(value))}, expected {list(view.shape)}")
            np.copyto(view, value, casting="equiv")
        elif name in self.__values:
            self.__values[name] = value
        else:
            raise AttributeError(f"field {name} is none of {', '.join(self.__values)}")


_UNSET: Any = object()


class Drafter:
    """Makes and finishes the drafts of one type."""

    def __init__(self, schema: Schema, cls: type, body: Body) -> None:
        self._schema = schema
        self._body = body
        self._names = tuple(field.name for field in schema.fields)
        arrays = [
            (field.name, field.type, field.offset)
            for field in body.fields[cls]
            if isinstance(field.type, ArrayType)
        ]
        self._fields = body.fields[cls]
        self._fixed = [(name, kind, offset) for name, kind, offset in arrays if kind.is_fixed]
        self._variable = [(name, kind) for name, kind, _ in arrays if not kind.is_fixed]
        self._defaults = {field.name: field for field in dataclasses.fields(cls)}
        self.is_by_tail = not any(isinstance(kind, ArrayType) and kind.is_fixed for kind in nested(schema))
        """Whether all arrays of a message lie behind its block, which is cleared before they are copied."""
        self._places = functools.lru_cache(_PLACED_MAX)(self._place)
        """As `_place`, of items: those used last are kept, as they come again."""

    def size(self, dims: Mapping[str, int] | None = None, dtypes: Mapping[str, Any] | None = None) -> int:
        """Return how much memory a draft needs [bytes]: what is known of the body, and 4 KiB for the rest.

        Args:
            dims: Sizes of named dimensions.
            dtypes: For arrays of open dtype, the dtype by field name.

        Raises:
            ValueError: The type has no such dimension or array, or a size is out of range.
        """
        _, end = self._places_of(dims, dtypes)
        return end + RESERVE_BYTES

    def draft(
        self,
        buffer: NDArray[np.uint8],
        dims: Mapping[str, int] | None = None,
        dtypes: Mapping[str, Any] | None = None,
    ) -> Draft:
        """Return a draft in memory of at least `size` bytes; arrays whose size is known are views of it."""
        places, end = self._places_of(dims, dtypes)
        if end > len(buffer):
            raise ValueError(f"{self._schema.name}: draft of {end} bytes, the buffer has {len(buffer)}")
        buffer[: self._body.block] = 0
        draft = Draft(buffer, self._names, places)
        views = draft._Draft__views
        for name, kind, offset in self._fixed:
            views[name] = np.ndarray(kind.shape, array_dtype(kind), buffer, offset)  # type: ignore[arg-type]
        for name, place in places.items():
            views[name] = np.ndarray(place.shape, place.dtype, buffer, place.offset)
        return draft

    def finish(self, draft: Draft) -> int:
        """Write what is not yet in its place and return the size of the body; the views become read-only.

        Raises:
            ValueError: A field without default is not set, or the fields that are no views do not fit.
            TypeError: As `Codec.encode` does.
        """
        buffer = draft._Draft__buffer
        self._set_defaults(draft)
        end = self._write(draft, None)
        if end > len(buffer):
            raise ValueError(
                f"{self._schema.name}: fields without a place need {end - len(buffer)} bytes more than the "
                f"{RESERVE_BYTES} in reserve; give the loan the dimensions of arrays, or publish without it"
            )
        self._write(draft, buffer)
        self.seal(draft)
        return end

    def seal(self, draft: Draft) -> None:
        """Let nobody write to the views of a draft any more."""
        for view in draft._Draft__views.values():
            view.flags.writeable = False

    def _write(self, draft: Draft, memory: NDArray[np.uint8] | None) -> int:
        """Write all but the views, and say where those in the tail lie; return the size of the body."""
        places, values, views = draft._Draft__places, draft._Draft__values, draft._Draft__views
        writer = Writer(self._body.fields, self._body.block, memory)
        for place in places.values():
            _reserve(writer, place.shape, place.dtype)
        sizes: dict[str, int] = {}
        for name, kind, bound, offset in self._fields:
            where = f"{self._schema.name}.{name}"
            if name in places:
                place = places[name]
                check_shape(kind, place.shape, where, sizes)  # type: ignore[arg-type]  # an array's
                writer.describe(place.dtype, place.shape, place.offset, offset)
            elif name not in views:
                writer.put(kind, bound, values[name], offset, where, sizes)
        return writer.end

    def _set_defaults(self, draft: Draft) -> None:
        views, values = draft._Draft__views, draft._Draft__values
        for name, field in self._defaults.items():
            if name in views or values[name] is not _UNSET:
                continue
            if field.default is not dataclasses.MISSING:
                setattr(draft, name, field.default)
            elif field.default_factory is not dataclasses.MISSING:
                setattr(draft, name, field.default_factory())
            else:
                raise ValueError(f"{self._schema.name}.{name} was not set and has no default")

    def _places_of(
        self, dims: Mapping[str, int] | None, dtypes: Mapping[str, Any] | None
    ) -> tuple[dict[str, _Place], int]:
        items = tuple((dims or {}).items()), tuple((dtypes or {}).items())
        try:
            return self._places(*items)
        except TypeError:  # not to be hashed, so no dtype: `_place` says so
            return self._place(*items)

    def _place(self, known_dims: _Items, known_dtypes: _Items) -> tuple[dict[str, _Place], int]:
        """Where the arrays lie whose size is known, and where what follows them begins."""
        dims, dtypes = dict(known_dims), dict(known_dtypes)
        self._check_arguments(dims, dtypes)
        writer = Writer(self._body.fields, self._body.block, None)
        places = {}
        for name, kind in self._variable:
            shape = [dims.get(size) if isinstance(size, str) else size for size in kind.shape]
            dtype = dtypes.get(name) if kind.dtype == "any" else array_dtype(kind)
            if dtype is None or None in shape:
                continue
            known = tuple(int(size) for size in shape if size is not None)
            places[name] = _Place(_reserve(writer, known, np.dtype(dtype)), known, np.dtype(dtype))
        return places, writer.end

    def _check_arguments(self, dims: Mapping[str, int], dtypes: Mapping[str, Any]) -> None:
        names = {size for _, kind in self._variable for size in kind.shape if isinstance(size, str)}
        for name, size in dims.items():
            if name not in names:
                raise ValueError(
                    f"{self._schema.name} has no dimension {name}, its arrays have {sorted(names)}"
                )
            if not 0 <= size < 2**32:
                raise ValueError(f"dimension {name} is {size}, allowed are 0 to 2^32 - 1")
        for name, dtype in dtypes.items():
            if name not in {field for field, kind in self._variable if kind.dtype == "any"}:
                raise ValueError(f"{self._schema.name} has no array {name} of open dtype")
            if np.dtype(dtype) not in DTYPES:
                raise ValueError(f"{name}: dtype {dtype} is none of {', '.join(DTYPE_CODES)}")


def _reserve(writer: Writer, shape: tuple[int, ...], dtype: np.dtype[Any]) -> int:
    """Keep room in the tail for an array that is written in place, and return its offset."""
    size = dtype.itemsize
    for dimension in shape:
        size *= dimension
    return writer.reserve(size, alignment_of(size)) if size else 0
