"""A column of a recording: an array of the file that grows by rows, which threads compress by chunks."""

from __future__ import annotations

import math
import threading
import zlib
from collections.abc import Sequence
from concurrent.futures import Future
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurosim_core.record.chunks import import_isal

_KEPT_BYTES = 4096
"""Pictures and arrays of varying length are kept, not copied, from this size on. A smaller one may be part
of a large block of memory, which it would hold."""
_PARTS_MAX = 64
"""Arrays that are kept apart in a chunk that is not full, when that is flushed."""
_scratch = threading.local()


class Column:
    """One array of the file that grows by rows, with the rows that are not yet in it."""

    def __init__(
        self, group: Any, name: str, shape: tuple[int, ...], dtype: Any, *, chunk: int, compressed: bool
    ) -> None:
        from h5py import h5s

        # A chunk that is stored as it is, is extended in place; a compressed one is written anew, elsewhere.
        filters = {"compression": "gzip", "compression_opts": 1, "shuffle": True} if compressed else {}
        room = [max(1, length) for length in shape]  # an axis may be empty
        self._dataset = group.create_dataset(
            name, shape=(0, *shape), maxshape=(None, *room), dtype=dtype, chunks=(chunk, *room), **filters
        )
        self._h5s = h5s
        self._shape = shape
        self.chunk = chunk
        self._dtype = np.dtype(object) if self._dataset.dtype.kind == "O" else np.dtype(dtype)
        self.deflates = compressed and self._dtype.kind != "O" and 0 not in shape
        self._rows: list[NDArray[Any]] = []
        """Values since the last flush; if that deflates, the content of the last chunk so far."""
        self._begin = self._end = self._flushed_end = 0
        """Their begin and end, and the end of the last flush."""
        self._deflated: list[Chunks] = []
        self._taken: tuple[list[NDArray[Any]], int, int, list[Chunks]] | None = None
        """Rows, begin, end and chunks for `write_rows`."""

    @property
    def is_full(self) -> bool:
        """Whether a whole chunk has come."""
        return self._end - self._begin >= self.chunk

    def check(self, rows: NDArray[Any]) -> None:
        """Refuse, with a TypeError, rows of a type that the column cannot hold."""
        if not np.can_cast(rows.dtype, self._dtype, casting="same_kind"):
            raise TypeError(f"{self._dataset.name} holds {self._dtype}, got {rows.dtype}")

    def append(self, rows: NDArray[Any]) -> int:
        """Add rows; return their size [bytes]."""
        if rows.dtype != self._dtype or not self.deflates or rows.nbytes < _KEPT_BYTES:
            rows = rows.astype(self._dtype, casting="same_kind")
        self._rows.append(rows)
        self._end += len(rows)
        return rows.nbytes

    def cut(self, *, partly: bool) -> tuple[int, list[NDArray[Any]]]:
        """Return the first row and the rows of chunks to compress: those that are full, or the last one."""
        first, count = self._begin, self._end - self._begin
        if partly:
            if self._end == self._flushed_end:
                return first, []
            if len(self._rows) > _PARTS_MAX:
                self._rows = [np.concatenate(self._rows)]
            return first, [*self._rows] if count else []
        if count < self.chunk:
            return first, []
        left = count % self.chunk
        *parts, block = self._rows
        full, rest = np.split(block, [len(block) - left])
        self._rows = [rest.copy() if rest.nbytes < _KEPT_BYTES else rest]
        self._begin = self._end - left
        return first, [*parts, full]

    def note(self, chunks: Chunks) -> None:
        """Take chunks that are being compressed."""
        self._deflated.append(chunks)

    def take(self) -> None:
        """Set aside for `write_rows` what came since the last flush."""
        if self._end == self._flushed_end:
            return
        self._taken = self._rows, self._begin, self._end, self._deflated
        self._deflated, self._flushed_end = [], self._end
        if not self.deflates:
            self._rows, self._begin = [], self._end

    def write_rows(self) -> None:
        """Write what was set aside; from another thread."""
        if self._taken is None:
            return
        rows, begin, end, deflated = self._taken
        self._taken = None
        self._dataset.id.set_extent((end, *self._shape))
        for chunks in deflated:
            for number, chunk in enumerate(chunks.future.result()[chunks.position]):
                place = (chunks.first + number * self.chunk, *[0] * len(self._shape))
                self._dataset.id.write_direct_chunk(place, chunk)
        if self.deflates or 0 in self._shape:
            return
        values = np.concatenate(rows)
        if self._dtype.kind == "O":
            self._dataset[begin:] = values
            return
        place = self._dataset.id.get_space()
        place.select_hyperslab((begin, *[0] * len(self._shape)), values.shape)
        self._dataset.id.write(self._h5s.create_simple(values.shape), place, values)  # saves 50 us


class Chunks(NamedTuple):
    """Chunks of one column that are being compressed."""

    first: int
    """First row."""
    future: Future[list[list[Any]]]
    position: int
    """Of their list in its result."""


def deflate(columns: Sequence[tuple[Sequence[NDArray[Any]], int]]) -> list[list[bytes]]:
    """Return what HDF5's filters shuffle and gzip would make of the chunks of each column, faster.

    Args:
        columns: The parts of the rows of each, and how many rows a chunk has; zeros fill up the last.
    """
    return [_deflate_column(parts, length) for parts, length in columns]


def _deflate_column(parts: Sequence[NDArray[Any]], length: int) -> list[bytes]:
    compress = (import_isal() or zlib).compress
    width = parts[0].itemsize
    size = length * math.prod(parts[0].shape[1:])
    items = [np.ascontiguousarray(part).reshape(-1) for part in parts]
    # Few calls, and memory that stays: each takes the interpreter's lock, on which others wait.
    if len(items) > 1:
        joined = _scratch_bytes("joined", sum(part.nbytes for part in items)).view(items[0].dtype)
        items = [np.concatenate(items, out=joined)]
    planes = _scratch_bytes("planes", size * width).reshape(width, size)
    octets = items[0].view(np.uint8).reshape(-1, width)
    chunks = []
    for begin in range(0, len(octets), size):
        rows = octets[begin : begin + size]
        planes[:, : len(rows)] = rows.T
        planes[:, len(rows) :] = 0
        chunks.append(compress(planes, 1))
    return chunks


def _scratch_bytes(name: str, size: int) -> NDArray[np.uint8]:
    """Return memory of this thread."""
    kept: NDArray[np.uint8] | None = getattr(_scratch, name, None)
    if kept is None or kept.size < size:
        kept = np.empty(size, np.uint8)
        setattr(_scratch, name, kept)
    return kept[:size]
