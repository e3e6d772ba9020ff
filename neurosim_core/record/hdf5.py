"""The writer of recordings: HDF5 files with bounded memory, laid out by the schemas of the packets.

Layout (format version 2). Every array can be read with plain h5py or any other HDF5 program: only gzip
and shuffle are used, which are part of HDF5 itself.

    /                        attributes: format, format_version, version, seed, scene, clean
    /config_yaml             the resolved configuration
    /path/{stamp_ns,position}
    /sensors/<name>          attributes: packet (name of the packet class), schema (JSON of its
                             `packets.PacketSchema`), each constant field of the packet (long
                             texts are datasets); for sensors in the header kind, rate_hz, p_BS, q_BS_xyzw,
                             settings (JSON), and for cameras
                             intrinsics (fx fy cx cy), resolution (width height), and unless they are
                             pinholes distortion_model, distortion
        packet_count         how many packets are complete
        stamp_ns, sequence   one row per packet
        order                counts the packets of the whole file, as written
        <field>              one row per packet for each field of the packet, of the field's type and shape
        <field>              arrays of varying length [n, ...]: the arrays of all packets, one after the other
        <n>_end              one row per packet: where its part of the arrays of length n ends
      event cameras, besides
        events/{x,y,t,p}     column, row, microseconds, 1 brighter | 0 darker; event_end is the index
        ms_to_idx            t[ms_to_idx[ms]] >= 1000 ms and t[ms_to_idx[ms] - 1] < 1000 ms
        t_offset             0: t counts from the start of the episode, as all stamps do
    /events /ms_to_idx /t_offset    the same arrays (hard links) of the first event camera, so that readers
                                    of DSEC files work; they take the group of any other camera just as well

A killed run leaves a readable file. Packets are held in memory and written together at every flush; what
was flushed is never touched again: space in the file is not reused, HDF5's bookkeeping is replaced in one go
after the data, and a row counts only once `packet_count`, which is written last, says so. What is lost is
what came after the last flush.

Reference: DSEC, Gehrig et al. (2021), https://dsec.ifi.uzh.ch/data-format, for events, ms_to_idx, t_offset.
"""

from __future__ import annotations

import contextlib
import os
import time
import zlib
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.install import install_hint
from neurosim_core.packets import Events, FieldSchema, Packet, as_numpy, schema_of
from neurosim_core.record.chunks import import_isal
from neurosim_core.record.disk import Disk
from neurosim_core.record.header import RecordingHeader

FORMAT = "neurosim.flight"
FORMAT_VERSION = 2
HEADER_COLUMNS = ("stamp_ns", "sequence", "order")
DSEC_NAMES = {"t": "events/t", "x": "events/x", "y": "events/y", "polarity": "events/p"}
"""Where the fields of packets of events are stored."""
LARGE_ROW_BYTES = 4096
"""Rows of at least this size, such as pictures, are stored and read one at a time."""

_FLAT_CHUNK = 65536  # 0.5 MB of t: fits HDF5's chunk cache, so appending never reads back
_ROW_CHUNK = 1024
_FIRST_FLUSH_BYTES = 65536
_ATTRIBUTE_MAX_BYTES = 60000
_DEFLATE_THREADS = 8


class RecordingWriter:
    """Writes packets to a file while they are measured. A context manager.

    Packets of one sensor must come in the order of their stamps. Arrays are copied, so a caller may reuse its
    buffers. The first flushes come early, so that a disk that is full soon still holds most of what came.

    Compression is gzip with shuffle, by ISA-L where that is installed, in threads: 35 to 52 M events/s on
    16 cores, 2.8 to 3.3 of 13 bytes left; zlib takes five times as long for the same size. Blosc with zstd is
    not faster, and nobody could read the file without its plug-in.
    """

    def __init__(
        self,
        path: str | Path,
        header: RecordingHeader,
        *,
        flush_interval_s: float = 1.0,
        buffer_bytes: int = 8_000_000,
    ) -> None:
        """Create the file, replacing one that exists.

        Args:
            path: The file; its folder must exist.
            header: What goes with the packets.
            flush_interval_s: Longest wall-clock time between two flushes [s]; checked when a packet comes.
            buffer_bytes: Flush when the packets in memory exceed this size.

        Raises:
            OSError: The file cannot be created.
            ImportError: h5py is not installed.
        """
        h5py = import_h5py()
        self._path = Path(path)
        self._flush_interval_s = flush_interval_s
        self._buffer_bytes = buffer_bytes
        self._streams: dict[str, _Stream] = {}
        self._pool = ThreadPoolExecutor(min(_DEFLATE_THREADS, os.cpu_count() or 1), "deflate")
        self._order = 0
        self._newest_ns = 0
        self.kept_ns = 0
        """The file holds the packets up to this stamp, whatever happens [ns]."""
        self._pending_bytes = 0
        self._flushed_bytes = 4 * _FIRST_FLUSH_BYTES
        self._flushed_s = time.monotonic()
        try:
            self._disk = Disk(self._path)
        except OSError as error:
            raise OSError(f"cannot write {self._path}: {error.strerror}") from error
        # The oldest format: many programs read it, and no mark "open for writing" bars a killed file. Freed
        # space is never reused: what is on disk stays valid until the next flush is complete.
        self._file = h5py.File(self._disk, "w", libver=("earliest", "v110"), fs_strategy="none")
        try:
            self._described = _write_header(self._file, header)
            self._file.flush()
            self._disk.seal()
        except BaseException:
            self._file.close()
            self._disk.close()
            raise
        cameras = [s.name for s in header.sensors if s.kind == "event_camera"]
        self._root_camera = cameras[0] if cameras else None

    @property
    def pending_bytes(self) -> int:
        """Size of the packets that are in memory and not yet in the file [bytes]."""
        return self._pending_bytes

    def write(self, packet: Packet) -> None:
        """Add one packet.

        Raises:
            OSError: The disk is full or gone.
            ValueError: The packet does not continue its stream: its stamp is earlier than the one before, its
                class, a constant or a fixed shape has changed; or it has no sensor name.
            TypeError: A field of the packet's class is of a type that cannot be recorded.
        """
        stream = self._streams.get(packet.sensor) or self._open_stream(packet)
        self._pending_bytes += stream.append(packet, self._order)
        self._order += 1
        self._newest_ns = max(self._newest_ns, packet.stamp_ns)
        due = time.monotonic() - self._flushed_s >= self._flush_interval_s
        if due or self._pending_bytes >= min(self._buffer_bytes, self._flushed_bytes // 4):
            self.flush()

    def flush(self) -> None:
        """Bring everything that was written so far into the file.

        Raises:
            OSError: The disk is full or gone.
        """
        for stream in self._streams.values():
            stream.begin_rows(self._pool)
        for stream in self._streams.values():
            stream.write_rows()
        self._file.flush()
        self._disk.seal()
        for stream in self._streams.values():
            stream.commit()
        self._file.flush()
        self._disk.seal()
        self.kept_ns = self._newest_ns
        self._flushed_bytes += self._pending_bytes
        self._pending_bytes = 0
        self._flushed_s = time.monotonic()

    def close(self, *, complete: bool = True) -> None:
        """Write what is left, and mark the file as complete unless it is not. Closing twice is allowed.

        Args:
            complete: All that was to be recorded was written.

        Raises:
            OSError: The disk is full or gone.
        """
        if not self._file:
            return
        try:
            if not self._disk.failed:  # a failure is reported once
                for stream in self._streams.values():
                    stream.finish()
                self.flush()
                self._file.attrs["clean"] = complete
                self._file.flush()
                self._disk.seal()
        finally:
            self._pool.shutdown()
            self._file.close()
            self._disk.close()

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:  # keep what is there, but do not hide the error
            with contextlib.suppress(OSError):
                self.close()

    def _open_stream(self, packet: Packet) -> _Stream:
        name = packet.sensor
        if not name or "/" in name:
            raise ValueError(f"a packet needs a sensor name without '/', got {name!r}")
        group = self._described.get(name) or self._file["sensors"].require_group(name)
        stream = self._streams[name] = _Stream(group, packet)
        if isinstance(packet, Events) and self._root_camera in (None, name):
            self._root_camera = name
            for key in ("events", "ms_to_idx", "t_offset"):
                self._file[key] = group[key]
        return stream


class _Column:
    """One array of the file that grows by rows, with the rows that are not yet in it."""

    def __init__(
        self, group: Any, name: str, shape: tuple[int, ...], dtype: Any, *, chunk: int, compressed: bool
    ) -> None:
        # A chunk that is stored as it is, is extended in place; a compressed one is written anew, elsewhere.
        filters = {"compression": "gzip", "compression_opts": 1, "shuffle": True} if compressed else {}
        room = [max(1, length) for length in shape]  # an axis may be empty
        self._dataset = group.create_dataset(
            name, shape=(0, *shape), maxshape=(None, *room), dtype=dtype, chunks=(chunk, *room), **filters
        )
        self._shape = shape
        self._dtype = np.dtype(object) if self._dataset.dtype.kind == "O" else np.dtype(dtype)
        self._rows: list[NDArray[Any]] = []
        self._deflates = compressed and self._dtype.kind != "O"
        self._last_chunk = np.empty((0, *shape), self._dtype)  # as far as it is filled, if that deflates
        self._deflated: list[tuple[tuple[int, ...], Future[bytes]]] = []

    def append(self, rows: Any) -> int:
        count = len(rows) if 0 in self._shape else -1
        block = (
            np.asarray(rows).astype(self._dtype, casting="same_kind").reshape(count, *self._shape)
        )  # a copy
        self._rows.append(block)
        return block.nbytes

    def begin_rows(self, pool: ThreadPoolExecutor) -> None:
        """Make room for the rows that came since the last flush, and let the pool compress them."""
        if not self._rows:
            return
        begin = self._dataset.shape[0]
        rows = (
            np.concatenate([self._last_chunk, *self._rows]) if self._deflates else np.concatenate(self._rows)
        )
        self._rows = []
        begin_of_chunk = begin - len(self._last_chunk)
        self._dataset.resize(begin_of_chunk + rows.shape[0], axis=0)
        if not self._deflates:
            if rows.size:
                self._dataset[begin:] = rows
            return
        length, *room = self._dataset.chunks
        filled = len(rows) % length
        self._last_chunk = rows[len(rows) - filled :].copy()  # it may grow later
        for first in range(0, len(rows) if rows.size else 0, length):
            place = (begin_of_chunk + first, *[0] * len(room))
            self._deflated.append((place, pool.submit(_deflate, rows[first : first + length], length)))

    def write_rows(self) -> None:
        """Write what the pool has compressed."""
        for place, chunk in self._deflated:
            self._dataset.id.write_direct_chunk(place, chunk.result())
        self._deflated = []


class _Stream:
    """The packets of one sensor in the file."""

    def __init__(self, group: Any, first: Packet) -> None:
        self._group = group
        self._type = type(first)
        self._columns: dict[str, _Column] = {}
        self._last_ns: int | None = None
        self._written = 0
        schema = schema_of(self._type)
        self._fields = schema.fields
        for name in (field.name for field in schema.fields):
            if name in (*HEADER_COLUMNS, "packet_count") or name.endswith("_end"):
                raise ValueError(f"a field of a packet cannot be called {name!r}: recordings use this name")
        values = self._values(first)
        self._fixed = self._fixed_part(values)
        group.attrs["packet"], group.attrs["schema"] = schema.name, schema.to_json()
        self._packet_count = group.create_dataset("packet_count", data=np.int64(0))
        for name in HEADER_COLUMNS:
            self._add_rows(name, np.int64)
        for field in self._fields:
            if field.constant:
                _write_constant(group, field.name, self._fixed[field.name])
            else:
                self._add_field(field, values[field.name])
        self._ends = {field.varying: 0 for field in self._fields if field.varying}
        for name in self._ends:
            self._add_rows(f"{name}_end", np.int64)
        self._ms_count = 0
        self._is_events = isinstance(first, Events)
        if self._is_events:
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
        fixed = self._fixed_part(values)
        if fixed != self._fixed:
            raise ValueError(f"sensor {packet.sensor!r} was {self._fixed} before, got {fixed}")
        size = 0
        if self._is_events:
            size += self._append_index(values["t"], packet.stamp_ns)
        for field in self._fields:
            if not field.constant:
                value = values[field.name]
                size += self._columns[field.name].append(value if field.varying else value[None])
        lengths = {field.varying: len(values[field.name]) for field in self._fields if field.varying}
        for name, length in lengths.items():
            self._ends[name] += length
            size += self._columns[f"{name}_end"].append(self._ends[name])
        for name, number in zip(HEADER_COLUMNS, (packet.stamp_ns, packet.sequence, order), strict=True):
            size += self._columns[name].append(number)
        self._last_ns = packet.stamp_ns
        self._written += 1
        return size

    def begin_rows(self, pool: ThreadPoolExecutor) -> None:
        for column in self._columns.values():
            column.begin_rows(pool)

    def write_rows(self) -> None:
        for column in self._columns.values():
            column.write_rows()

    def commit(self) -> None:
        """Declare what is in the file as complete."""
        self._packet_count[()] = self._written

    def finish(self) -> None:
        """End the millisecond index one entry after the last event: windows up to the end can be read."""
        if self._is_events:
            self._columns["ms_to_idx"].append(np.array([self._ends["event"]], dtype=np.uint64))

    def _add_rows(self, name: str, dtype: Any) -> None:
        self._columns[name] = _Column(self._group, name, (), dtype, chunk=_ROW_CHUNK, compressed=False)

    def _add_field(self, field: FieldSchema, value: NDArray[Any]) -> None:
        path = DSEC_NAMES.get(field.name, field.name) if issubclass(self._type, Events) else field.name
        dtype: Any = value.dtype if field.dtype == "any" else field.dtype
        if dtype == "str":
            dtype = import_h5py().string_dtype()
        shape = value.shape[1:] if field.varying else value.shape
        count = max(1, int(np.prod(shape)))
        chunk, compressed = _ROW_CHUNK, False
        if field.varying:
            chunk, compressed = max(1, _FLAT_CHUNK // count), True
        elif count * value.dtype.itemsize >= LARGE_ROW_BYTES:
            chunk, compressed = 1, True
        self._columns[field.name] = _Column(
            self._group, path, shape, dtype, chunk=chunk, compressed=compressed
        )

    def _values(self, packet: Packet) -> dict[str, NDArray[Any]]:
        """Return the fields of a packet as arrays; refuse shapes that the schema does not allow."""
        values = {field.name: as_numpy(getattr(packet, field.name)) for field in self._fields}
        lengths: dict[str, int] = {}
        for field in self._fields:
            found, wanted = values[field.name].shape, field.shape
            if field.varying and found:
                lengths.setdefault(field.varying, found[0])
                wanted = (lengths[field.varying], *wanted[1:])
            fits = len(found) == len(wanted) or "..." in wanted
            if not fits or any(isinstance(n, int) and n != m for n, m in zip(wanted, found, strict=False)):
                raise ValueError(
                    f"sensor {packet.sensor!r}: {field.name} must have shape {list(wanted)}, "
                    f"got {list(found)}"
                )
        return values

    def _fixed_part(self, values: dict[str, NDArray[Any]]) -> dict[str, Any]:
        """Return what all packets of the sensor have in common."""
        fixed: dict[str, Any] = {}
        for field in self._fields:
            value = values[field.name]
            if field.constant:
                fixed[field.name] = value.item()
            elif field.shape:
                fixed[field.name] = value.shape[1:] if field.varying else value.shape
                if field.dtype == "any":
                    fixed[field.name] = (*fixed[field.name], value.dtype.name)
        return fixed

    def _append_index(self, t: NDArray[np.int64], stamp_ns: int) -> int:
        """Add the milliseconds up to a packet's stamp: events of later packets are not older than that."""
        milliseconds = np.arange(self._ms_count, stamp_ns // 1_000_000 + 1)
        first = np.searchsorted(t, milliseconds * 1000) + self._ends["event"]
        self._ms_count += len(milliseconds)
        return self._columns["ms_to_idx"].append(first.astype(np.uint64))


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


def _write_header(file: Any, header: RecordingHeader) -> dict[str, Any]:
    """Write what is known before the flight; return the group of each described sensor."""
    file.attrs["format"] = FORMAT
    file.attrs["format_version"] = FORMAT_VERSION
    file.attrs["clean"] = False
    file.attrs["version"] = header.version
    file.attrs["seed"] = header.seed
    file.attrs["scene"] = header.scene
    file["config_yaml"] = header.config_yaml
    file["path/stamp_ns"] = header.path_stamp_ns
    file["path/position"] = header.path_position
    groups: dict[str, Any] = {}
    file.create_group("sensors")
    for index, sensor in enumerate(header.sensors):
        group = groups[sensor.name] = file.create_group(f"sensors/{sensor.name}")
        group.attrs["index"] = index
        group.attrs["kind"] = sensor.kind
        group.attrs["rate_hz"] = sensor.rate_hz
        group.attrs["p_BS"] = sensor.position
        group.attrs["q_BS_xyzw"] = sensor.orientation
        group.attrs["settings"] = sensor.settings
        if sensor.intrinsics is not None:
            lens = sensor.intrinsics
            group.attrs["intrinsics"] = [lens.fx, lens.fy, lens.cx, lens.cy]
            group.attrs["resolution"] = [lens.width, lens.height]
            if lens.distortion_model:
                group.attrs["distortion_model"] = lens.distortion_model
                group.attrs["distortion"] = np.array(lens.distortion, np.float64)
    return groups


def import_h5py() -> ModuleType:
    """Return the module `h5py`.

    Raises:
        ImportError: It is not installed; the message says what to install.
    """
    try:
        import h5py
    except ImportError as error:
        raise ImportError(f"recordings need h5py: {install_hint('record')}") from error
    return h5py


def _deflate(rows: NDArray[Any], length: int) -> bytes:
    """Return what HDF5's filters shuffle and gzip would make of a chunk of so many rows, faster."""
    if len(rows) < length:
        rows = np.concatenate([rows, np.zeros((length - len(rows), *rows.shape[1:]), rows.dtype)])
    shuffled = rows.reshape(-1, 1).view(np.uint8).T.tobytes()
    deflated: bytes = (import_isal() or zlib).compress(shuffled, 1)
    return deflated
