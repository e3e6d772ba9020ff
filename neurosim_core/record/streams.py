"""The packets of one sensor in a recording: its columns, and the checks that packets go on as they began."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.packets import FieldSchema, Packet, as_numpy, schema_of
from neurosim_core.record.columns import Chunks, Column

HEADER_COLUMNS = ("stamp_ns", "sequence", "order")
DSEC_NAMES = {"t": "events/t", "x": "events/x", "y": "events/y", "polarity": "events/p"}
"""Where the fields of packets of events are stored."""
LARGE_ROW_BYTES = 4096
"""Rows of at least this size, such as pictures, are stored and read one at a time."""

_FLAT_CHUNK = 65536
"""Rows of a chunk of arrays of varying length; of events as many as there are pixels, at most 262,144."""
_ROW_CHUNK = 1024
_ATTRIBUTE_MAX_BYTES = 60000


class Stream:
    """The packets of one sensor in the file."""

    def __init__(
        self, group: Any, first: Packet, pool: ThreadPoolExecutor, deflate: Callable[..., list[list[Any]]]
    ) -> None:
        self._group = group
        self._pool = pool
        self._compress = deflate
        self._type = type(first)
        self._columns: dict[str, Column] = {}
        self._last_ns: int | None = None
        self._written = self._taken_count = 0
        schema = schema_of(self._type)
        self._fields = schema.fields
        self._varying = {field.name: field.varying for field in schema.fields}
        """Name of the length of each field that differs from packet to packet; empty if none does."""
        for name in (field.name for field in schema.fields):
            if name in (*HEADER_COLUMNS, "packet_count") or name.endswith("_end"):
                raise ValueError(f"a field of a packet cannot be called {name!r}: recordings use this name")
        values = self._values(first)
        self._check_shapes(first.sensor, values)
        self._fixed = self._fixed_part(values)
        self._form: list[Any] | None = None
        """The result of `_form_of` for packets that fit."""
        group.attrs["packet"], group.attrs["schema"] = schema.name, schema.to_json()
        self._packet_count = group.create_dataset("packet_count", data=np.int64(0))
        self.is_events = schema.has_events
        self._flat_chunk = _FLAT_CHUNK
        if self.is_events:
            pixels = self._fixed["width"] * self._fixed["height"]
            self._flat_chunk = 1 << min(max(pixels.bit_length() - 1, 16), 18)
        for name in HEADER_COLUMNS:
            self._add_rows(name, np.int64)
        for field in self._fields:
            if field.constant:
                _write_constant(group, field.name, self._fixed[field.name])
            else:
                self._add_field(field, values[field.name])
        self._growing = [(f.name, self._columns[f.name]) for f in self._fields if not f.constant]
        self._measured = {varying: name for name, varying in self._varying.items() if varying}
        """A field that has each length."""
        self._ends = dict.fromkeys(self._measured, 0)
        for name in self._ends:
            self._add_rows(f"{name}_end", np.int64)
        self._numbers: list[tuple[int, ...]] = []
        """Of the packets since the last flush: stamp, sequence, order, ends."""
        self._deflating = [column for column in self._columns.values() if column.deflates]
        self._ms_count = 0
        if self.is_events:
            group.create_dataset("t_offset", data=np.int64(0))
            self._add_rows("ms_to_idx", np.uint64)

    def append(self, packet: Packet, order: int) -> int:
        """Keep a packet for the next flush; return its size [bytes]."""
        if type(packet) is not self._type:
            raise ValueError(
                f"sensor {packet.sensor!r} sends {self._type.__name__}, got a {type(packet).__name__}"
            )
        if self._last_ns is not None and packet.stamp_ns < self._last_ns:
            raise ValueError(
                f"sensor {packet.sensor!r}: stamp {packet.stamp_ns} ns comes after {self._last_ns} ns"
            )
        values = self._values(packet)
        form = self._form_of(values)
        if form != self._form:  # before any column has grown: a packet is written whole, or not at all
            self._check(packet.sensor, values)
            self._form = form
        size = 0
        if self.is_events:
            size += self._append_index(values["t"], packet.stamp_ns)
        for name, column in self._growing:
            size += column.append(values[name] if self._varying[name] else values[name][None])
        for length, name in self._measured.items():
            self._ends[length] += len(values[name])
        self._numbers.append((packet.stamp_ns, packet.sequence, order, *self._ends.values()))
        self._last_ns = packet.stamp_ns
        self._written += 1
        self._deflate(partly=False)
        return size + 8 * len(self._numbers[-1])

    def take(self) -> None:
        """Set aside for `write_rows` and `commit` what came since the last flush."""
        self._deflate(partly=True)
        if self._numbers:
            names = (*HEADER_COLUMNS, *(f"{name}_end" for name in self._ends))
            for name, numbers in zip(names, np.array(self._numbers, np.int64).T, strict=True):
                self._columns[name].append(numbers)
            self._numbers = []
        for column in self._columns.values():
            column.take()
        self._taken_count = self._written

    def write_rows(self) -> None:
        """Write what was set aside."""
        for column in self._columns.values():
            column.write_rows()

    def commit(self) -> None:
        """Declare what is in the file as complete."""
        self._packet_count[()] = self._taken_count

    def finish(self) -> None:
        """End the millisecond index one entry after the last event: windows up to the end can be read."""
        if self.is_events:
            self._columns["ms_to_idx"].append(np.array([self._ends["event"]], dtype=np.uint64))

    def _deflate(self, *, partly: bool) -> None:
        """Let the pool compress chunks, those of all columns in one task."""
        if not partly and not any(column.is_full for column in self._deflating):
            return
        cut = [(column, *column.cut(partly=partly)) for column in self._deflating]
        cut = [(column, first, parts) for column, first, parts in cut if parts]
        if cut:
            task = [(parts, column.chunk) for column, _, parts in cut]
            try:
                future = self._pool.submit(self._compress, task)
            except RuntimeError:  # the interpreter ends, and pools take nothing any more
                future = Future()
                future.set_result(self._compress(task))
            for position, (column, first, _) in enumerate(cut):
                column.note(Chunks(first, future, position))

    def _add_rows(self, name: str, dtype: Any) -> None:
        self._columns[name] = Column(self._group, name, (), dtype, chunk=_ROW_CHUNK, compressed=False)

    def _add_field(self, field: FieldSchema, value: NDArray[Any]) -> None:
        path = DSEC_NAMES.get(field.name, field.name) if self.is_events else field.name
        dtype: Any = value.dtype if field.dtype == "any" else field.dtype
        if dtype == "str":
            from h5py import string_dtype

            dtype = string_dtype()
        shape = value.shape[1:] if field.varying else value.shape
        count = max(1, int(np.prod(shape)))
        chunk, compressed = _ROW_CHUNK, False
        if field.varying:
            chunk, compressed = max(1, self._flat_chunk // count), True
        elif count * value.dtype.itemsize >= LARGE_ROW_BYTES:
            chunk, compressed = 1, True
        self._columns[field.name] = Column(
            self._group, path, shape, dtype, chunk=chunk, compressed=compressed
        )

    def _values(self, packet: Packet) -> dict[str, NDArray[Any]]:
        return {name: as_numpy(getattr(packet, name)) for name in self._varying}

    def _form_of(self, values: dict[str, NDArray[Any]]) -> list[Any]:
        """Return what tells whether a packet fits, short of `_check`: types, shapes and constants."""
        lengths: dict[str, tuple[int, ...]] = {}
        form: list[Any] = []
        for field, value in zip(self._fields, values.values(), strict=True):
            varying, shape = self._varying[field.name], value.shape
            if field.constant:
                form.append(value.item())
            elif varying:
                length = shape[:1]
                form.append((value.dtype, lengths.setdefault(varying, length) == length, shape[1:]))
            else:
                form.append((value.dtype, shape))
        return form

    def _check(self, sensor: str, values: dict[str, NDArray[Any]]) -> None:
        """Refuse shapes, types and constants that the schema or the packets before do not allow."""
        self._check_shapes(sensor, values)
        fixed = self._fixed_part(values)
        if fixed != self._fixed:
            raise ValueError(f"sensor {sensor!r} was {self._fixed} before, got {fixed}")
        for name, column in self._growing:
            column.check(values[name])

    def _check_shapes(self, sensor: str, values: dict[str, NDArray[Any]]) -> None:
        lengths: dict[str, int] = {}
        for field in self._fields:
            found, wanted, varying = values[field.name].shape, field.shape, self._varying[field.name]
            if varying and found:
                wanted = (lengths.setdefault(varying, found[0]), *wanted[1:])
            fits = len(found) == len(wanted) or "..." in wanted
            if not fits or any(isinstance(n, int) and n != m for n, m in zip(wanted, found, strict=False)):
                raise ValueError(
                    f"sensor {sensor!r}: {field.name} must have shape {list(wanted)}, got {list(found)}"
                )

    def _fixed_part(self, values: dict[str, NDArray[Any]]) -> dict[str, Any]:
        """Return what all packets of the sensor have in common."""
        fixed: dict[str, Any] = {}
        for field in self._fields:
            value = values[field.name]
            if field.constant:
                fixed[field.name] = value.item()
            elif field.dtype == "any" or any(isinstance(length, str) for length in field.shape):
                fixed[field.name] = value.shape[1:] if self._varying[field.name] else value.shape
                if field.dtype == "any":
                    fixed[field.name] = (*fixed[field.name], value.dtype.name)
        return fixed

    def _append_index(self, t: NDArray[np.int64], stamp_ns: int) -> int:
        """Add the milliseconds up to a packet's stamp: events of later packets are not older than that."""
        count = stamp_ns // 1_000_000 + 1
        first = t.searchsorted(np.arange(1000 * self._ms_count, 1000 * count, 1000)) + self._ends["event"]
        self._ms_count = max(self._ms_count, count)
        return self._columns["ms_to_idx"].append(first.view(np.uint64))


def _write_constant(group: Any, name: str, value: Any) -> None:
    """Write a constant as an attribute; a long text, which no attribute can hold, as a dataset."""
    if isinstance(value, str) and len(value.encode()) > _ATTRIBUTE_MAX_BYTES:
        group.create_dataset(name, data=value)
    else:
        group.attrs[name] = value


def read_constant(group: Any, name: str) -> Any:
    """Return a constant of the packets of a sensor."""
    value = group.attrs[name] if name in group.attrs else group[name].asstr()[()]
    return value.item() if isinstance(value, np.generic) else value
