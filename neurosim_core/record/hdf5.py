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

import atexit
import contextlib
import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.install import need
from neurosim_core.packets import Events, FieldSchema, Packet, as_numpy, schema_of
from neurosim_core.record.columns import Chunks, Column, deflate
from neurosim_core.record.disk import Disk
from neurosim_core.record.header import RecordingHeader

FORMAT = "neurosim.flight"
FORMAT_VERSION = 2
HEADER_COLUMNS = ("stamp_ns", "sequence", "order")
DSEC_NAMES = {"t": "events/t", "x": "events/x", "y": "events/y", "polarity": "events/p"}
"""Where the fields of packets of events are stored."""
LARGE_ROW_BYTES = 4096
"""Rows of at least this size, such as pictures, are stored and read one at a time."""

_FLAT_CHUNK = 65536
"""Rows of a chunk of arrays of varying length; of events as many as there are pixels, at most 262,144."""
_ROW_CHUNK = 1024
_FIRST_FLUSH_BYTES = 65536
_ATTRIBUTE_MAX_BYTES = 60000
_DEFLATE_THREADS = 8
_EXIT_S = 5.0
"""A flush is waited for so long when the interpreter ends [s]."""


class RecordingWriter:
    """Writes packets to a file while they are measured. A context manager.

    Without `close` the file is that of a killed run: what came after the last flush is lost.

    Packets of one sensor must come in the order of their stamps. Arrays of 64 kB and more, such as pictures
    and columns of events, are read later and must not change; smaller ones are copied. The first flushes come
    early, so that a disk that is full soon still holds most of what came.

    Threads compress each chunk as soon as it is full (gzip with shuffle, by ISA-L where that is installed),
    and one more thread writes to the file. `write` waits only where that is `buffer_bytes` behind. What goes
    wrong there is raised by the next call.
    """

    def __init__(
        self,
        path: str | Path,
        header: RecordingHeader,
        *,
        flush_interval_s: float = 1.0,
        buffer_bytes: int = 64_000_000,
    ) -> None:
        """Create the file, replacing one that exists.

        Args:
            path: The file; its folder must exist.
            header: What goes with the packets.
            flush_interval_s: Longest wall-clock time between two flushes [s]; checked when a packet comes.
            buffer_bytes: Flush when the packets that came since the last flush exceed this size. As many may
                still be in the hands of that flush.

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
        self._pending_bytes = self._flushing_bytes = 0
        self._flushing: threading.Thread | None = None
        self._failure: Exception | None = None
        self._is_told = False
        """Whether the failure was raised."""
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
        atexit.register(self._abandon)

    @property
    def pending_bytes(self) -> int:
        """Size of the packets that are not yet in the file [bytes]."""
        return self._pending_bytes + self._flushing_bytes

    def write(self, packet: Packet) -> None:
        """Add one packet.

        Raises:
            OSError: The disk is full or gone.
            ValueError: The packet does not continue its stream: its stamp is earlier than the one before, its
                class, a constant or a fixed shape has changed; or it has no sensor name.
            TypeError: A field of the packet's class is of a type that cannot be recorded.
        """
        is_flushing = self._flushing is not None and self._flushing.is_alive()
        if not is_flushing:
            self._finish_flush()
        stream = self._streams.get(packet.sensor) or self._open_stream(packet)
        self._pending_bytes += stream.append(packet, self._order)
        self._order += 1
        self._newest_ns = max(self._newest_ns, packet.stamp_ns)
        is_due = not is_flushing and time.monotonic() - self._flushed_s >= self._flush_interval_s
        if is_due or self._pending_bytes >= min(self._buffer_bytes, self._flushed_bytes // 4):
            self._begin_flush()

    def flush(self) -> None:
        """Bring everything that was written so far into the file.

        Raises:
            OSError: The disk is full or gone.
        """
        self._begin_flush()
        self._finish_flush()

    def close(self, *, complete: bool = True) -> None:
        """Write what is left, and mark the file as complete unless it is not. Closing twice is allowed.

        Args:
            complete: All that was to be recorded was written.

        Raises:
            OSError: The disk is full or gone.
        """
        if not self._file:
            return
        atexit.unregister(self._abandon)
        try:
            if not self._is_told:  # a failure is reported once
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

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:  # keep what is there, but do not hide the error
            with contextlib.suppress(OSError):
                self.close()

    def _begin_flush(self) -> None:
        """Let a thread write everything that came. A daemon: a disk that hangs must not hold up the exit."""
        self._finish_flush()
        for stream in self._streams.values():
            stream.take()
        self._flushing_bytes, self._pending_bytes = self._pending_bytes, 0
        self._flushed_bytes += self._flushing_bytes
        self._flushed_s = time.monotonic()
        self._flushing = threading.Thread(
            target=self._flush,
            args=([*self._streams.values()], self._newest_ns),
            name="recording",
            daemon=True,
        )
        self._flushing.start()

    def _finish_flush(self) -> None:
        """Wait for the flush that is under way, and raise what went wrong."""
        if self._flushing is not None:
            self._flushing.join()
            self._flushing = None
            self._flushing_bytes = 0
        if self._failure is not None:
            self._is_told = True
            raise self._failure

    def _flush(self, streams: list[_Stream], newest_ns: int) -> None:
        try:
            for stream in streams:
                stream.write_rows()
            self._file.flush()
            self._disk.seal()
            for stream in streams:
                stream.commit()
            self._file.flush()
            self._disk.seal()
            self.kept_ns = newest_ns
        except Exception as error:  # raised by `_finish_flush`
            self._failure = error

    def _abandon(self) -> None:
        """Close the file as it is: HDF5 would do it when there is no interpreter to call, and hang."""
        flushing = self._flushing
        if flushing is not None:
            flushing.join(_EXIT_S)
        if flushing is None or not flushing.is_alive():
            self._file.close()
            self._disk.close()

    def _open_stream(self, packet: Packet) -> _Stream:
        name = packet.sensor
        if not name or "/" in name:
            raise ValueError(f"a packet needs a sensor name without '/', got {name!r}")
        self._finish_flush()  # which would otherwise find half of a stream
        group = self._described.get(name) or self._file["sensors"].require_group(name)
        stream = self._streams[name] = _Stream(group, packet, self._pool)
        if isinstance(packet, Events) and self._root_camera in (None, name):
            self._root_camera = name
            for key in ("events", "ms_to_idx", "t_offset"):
                self._file[key] = group[key]
        return stream


class _Stream:
    """The packets of one sensor in the file."""

    def __init__(self, group: Any, first: Packet, pool: ThreadPoolExecutor) -> None:
        self._group = group
        self._pool = pool
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
        self._fixed = self._fixed_part(values)
        group.attrs["packet"], group.attrs["schema"] = schema.name, schema.to_json()
        self._packet_count = group.create_dataset("packet_count", data=np.int64(0))
        self._is_events = isinstance(first, Events)
        self._flat_chunk = _FLAT_CHUNK
        if isinstance(first, Events):
            self._flat_chunk = 1 << min(max((first.width * first.height).bit_length() - 1, 16), 18)
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
        self._numbers: list[tuple[int, ...]] = []
        """Of the packets since the last flush: stamp, sequence, order, ends."""
        self._deflating = [column for column in self._columns.values() if column.deflates]
        self._ms_count = 0
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
        for field in self._fields:  # before any column has grown: a packet is written whole, or not at all
            if not field.constant:
                self._columns[field.name].check(values[field.name])
        size = 0
        if self._is_events:
            size += self._append_index(values["t"], packet.stamp_ns)
        for field in self._fields:
            if not field.constant:
                value = values[field.name]
                size += self._columns[field.name].append(value if self._varying[field.name] else value[None])
        for length, count in {v: len(values[name]) for name, v in self._varying.items() if v}.items():
            self._ends[length] += count
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
        for column in self._columns.values():
            column.write_rows()

    def commit(self) -> None:
        """Declare what is in the file as complete."""
        self._packet_count[()] = self._taken_count

    def finish(self) -> None:
        """End the millisecond index one entry after the last event: windows up to the end can be read."""
        if self._is_events:
            self._columns["ms_to_idx"].append(np.array([self._ends["event"]], dtype=np.uint64))

    def _deflate(self, *, partly: bool) -> None:
        """Let the pool compress chunks, those of all columns in one task."""
        cut = [(column, *column.cut(partly=partly)) for column in self._deflating]
        cut = [(column, first, parts) for column, first, parts in cut if parts]
        if cut:
            future = self._pool.submit(deflate, [(parts, column.chunk) for column, _, parts in cut])
            for position, (column, first, _) in enumerate(cut):
                column.note(Chunks(first, future, position))

    def _add_rows(self, name: str, dtype: Any) -> None:
        self._columns[name] = Column(self._group, name, (), dtype, chunk=_ROW_CHUNK, compressed=False)

    def _add_field(self, field: FieldSchema, value: NDArray[Any]) -> None:
        path = DSEC_NAMES.get(field.name, field.name) if issubclass(self._type, Events) else field.name
        dtype: Any = value.dtype if field.dtype == "any" else field.dtype
        if dtype == "str":
            dtype = import_h5py().string_dtype()
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
        """Return the fields of a packet as arrays; refuse shapes that the schema does not allow."""
        values = {field.name: as_numpy(getattr(packet, field.name)) for field in self._fields}
        lengths: dict[str, int] = {}
        for field in self._fields:
            found, wanted, varying = values[field.name].shape, field.shape, self._varying[field.name]
            if varying and found:
                wanted = (lengths.setdefault(varying, found[0]), *wanted[1:])
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
            elif field.dtype == "any" or any(isinstance(length, str) for length in field.shape):
                fixed[field.name] = value.shape[1:] if self._varying[field.name] else value.shape
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


def import_h5py() -> Any:
    """Return the module `h5py`."""
    return need("recordings need h5py", "record", "h5py")
