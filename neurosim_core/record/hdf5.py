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
import logging
import os
import queue
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neurosim_core.clock import NS_PER_S
from neurosim_core.install import need
from neurosim_core.packets import Packet
from neurosim_core.record.columns import deflate
from neurosim_core.record.disk import Disk, disown_when_forked, forked_error
from neurosim_core.record.header import RecordingHeader
from neurosim_core.record.streams import Stream

log = logging.getLogger(__name__)

FORMAT = "neurosim.flight"
FORMAT_VERSION = 2
_FIRST_FLUSH_BYTES = 65536
_DEFLATE_MAX = 8
_QUIET_S = 5.0
"""A disk that takes nothing for so long is said to be waited for; when the interpreter ends, given up [s]."""


class _Flush(NamedTuple):
    """The data that the writing thread puts into the file."""

    streams: list[Stream]
    newest_ns: int
    complete: bool | None = None
    """Whether the recording is, if this is its end."""


class RecordingWriter:
    """Writes packets to a file while they are measured. A context manager.

    Without `close` it is closed when the interpreter ends, and not marked as complete. A process that is
    forked leaves it to its parent.

    Packets of one sensor must come in the order of their stamps. Arrays of 4 kB and more, such as pictures
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
        deflate: Callable[..., list[list[Any]]] = deflate,
    ) -> None:
        """Create the file, replacing one that exists.

        Args:
            path: The file; its folder must exist.
            header: What goes with the packets.
            flush_interval_s: Longest wall-clock time between two flushes [s]; checked when a packet comes.
            buffer_bytes: Flush when the packets that came since the last flush exceed this size. As many may
                still be in the hands of that flush.
            deflate: Compresses chunks as `columns.deflate` does, for several threads at a time.

        Raises:
            OSError: The file cannot be created.
            ImportError: h5py is not installed.
        """
        h5py = import_h5py()
        self._path = Path(path)
        self._flush_interval_s = flush_interval_s
        self._buffer_bytes = buffer_bytes
        self._streams: dict[str, Stream] = {}
        self._deflate = deflate
        self._pool = ThreadPoolExecutor(deflate_count(), "deflate")
        self._order = 0
        self._newest_ns = 0
        self.kept_ns = 0
        """The file holds the packets up to this stamp, whatever happens [ns]."""
        self._pending_bytes = self._flushing_bytes = 0
        self._flushes: queue.SimpleQueue[_Flush | None] = queue.SimpleQueue()
        self._is_idle = threading.Event()
        """Whether all flushes are done."""
        self._is_idle.set()
        self._failure: Exception | None = None
        self._closed = False
        self._is_told = False
        """Whether the failure was raised."""
        self._flushed_bytes = 4 * _FIRST_FLUSH_BYTES
        self._flushed_s = time.monotonic()
        self._disk = Disk(self._path)
        # The oldest format: many programs read it, and no mark "open for writing" bars a killed file. Freed
        # space is never reused: what is on disk stays valid until the next flush is complete.
        self._file = h5py.File(self._disk, "w", libver=("earliest", "v110"), fs_strategy="none")
        cameras = [s.name for s in header.sensors if s.has_events]
        self._root_camera = cameras[0] if cameras else None
        self._is_released = threading.Event()
        # Daemons, which work until the interpreter has called all its exit handlers.
        self._threads = [
            threading.Thread(target=self._write_flushes, name="recording", daemon=True),
            threading.Thread(target=self._watch_disk, name="disk", daemon=True),
        ]
        for thread in self._threads:
            thread.start()
        self._is_exiting = False
        atexit.register(self._close_at_exit)
        disown_when_forked(self)
        try:
            self._described = _write_header(self._file, header)
            self.flush()
        except BaseException:
            self.close(complete=False)
            raise

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
        if self._closed:
            raise ValueError(f"{self._path} is closed")
        is_flushing = not self._is_idle.is_set()
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

        Where the disk takes nothing for some seconds, this is logged. Ctrl-C ends the waiting, and when the
        interpreter ends, so does the process: a thread that hangs in HDF5 would never let it.

        Args:
            complete: All that was to be recorded was written.

        Raises:
            OSError: The disk is full or gone.
        """
        if self._closed:
            return
        self._closed = True
        try:
            if not self._is_told:  # a failure is reported once
                self._finish_flush()
                for stream in self._streams.values():
                    stream.finish()
                self._begin_flush(complete)
                self._finish_flush()
        finally:
            if self._is_idle.is_set():  # else Ctrl-C came: the thread is in HDF5, which lets no other in
                self._release()

    def _close_at_exit(self) -> None:
        self._is_exiting = True
        try:
            if not self._closed:
                self.close(complete=False)
            else:  # Ctrl-C came while `close` waited
                self._finish_flush()
                self._release()
        except KeyboardInterrupt:
            os._exit(130)

    def _release(self) -> None:
        atexit.unregister(self._close_at_exit)
        self._is_released.set()
        self._flushes.put(None)
        for thread in self._threads:  # one that ends with the interpreter may have the lock of h5py, for ever
            thread.join()
        self._pool.shutdown()
        self._file.close()
        self._disk.close()

    def disown(self) -> None:
        """Leave the file to the process that this one was forked from."""
        self._disk.disown()
        self._is_idle.set()
        self._failure, self._is_told = forked_error(self._path), True

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:  # keep what is there, but do not hide the error
            with contextlib.suppress(OSError):
                self.close()

    def _begin_flush(self, complete: bool | None = None) -> None:
        """Let the thread write everything that came."""
        self._finish_flush()
        for stream in self._streams.values():
            stream.take()
        self._flushing_bytes, self._pending_bytes = self._pending_bytes, 0
        self._flushed_bytes += self._flushing_bytes
        self._flushed_s = time.monotonic()
        self._is_idle.clear()
        self._flushes.put(_Flush([*self._streams.values()], self._newest_ns, complete))

    def _finish_flush(self) -> None:
        """Wait for the flush that is under way, and raise what went wrong."""
        taken_bytes = self._disk.taken_bytes
        while not self._is_idle.wait(_QUIET_S):
            if self._is_exiting and self._disk.taken_bytes == taken_bytes:
                self._say_that_it_waits()
                sys.stdout.flush()
                os._exit(1)
            taken_bytes = self._disk.taken_bytes
        self._flushing_bytes = 0
        if self._failure is not None:
            self._is_told = True
            raise self._failure

    def _watch_disk(self) -> None:
        """Say when a write hangs, in whichever thread."""
        taken_bytes = -1
        while not self._is_released.wait(_QUIET_S):
            if self._disk.is_writing and self._disk.taken_bytes == taken_bytes:
                self._say_that_it_waits()
            taken_bytes = self._disk.taken_bytes

    def _say_that_it_waits(self) -> None:
        left = f"{1e-6 * self.pending_bytes:.1f} MB wait for it"
        kept = f"the file is kept up to {self.kept_ns / NS_PER_S:.3f} s"
        log.warning("%s: the disk took nothing for %g s; %s; %s", self._path, _QUIET_S, left, kept)

    def _write_flushes(self) -> None:
        while (flush := self._flushes.get()) is not None:
            try:
                self._flush(*flush)
            except Exception as error:  # raised by `_finish_flush`
                self._failure = error
            self._is_idle.set()

    def _flush(self, streams: list[Stream], newest_ns: int, complete: bool | None) -> None:
        for stream in streams:
            stream.write_rows()
        self._file.flush()
        self._disk.seal()
        for stream in streams:
            stream.commit()
        if complete is not None:
            self._file.attrs["clean"] = complete
        self._file.flush()
        self._disk.seal()
        self.kept_ns = newest_ns

    def _open_stream(self, packet: Packet) -> Stream:
        name = packet.sensor
        if not name or "/" in name:
            raise ValueError(f"a packet needs a sensor name without '/', got {name!r}")
        self._finish_flush()  # which would otherwise find half of a stream
        group = self._described.get(name) or self._file["sensors"].require_group(name)
        stream = self._streams[name] = Stream(group, packet, self._pool, self._deflate)
        if stream.is_events and self._root_camera in (None, name):
            self._root_camera = name
            for key in ("events", "ms_to_idx", "t_offset"):
                self._file[key] = group[key]
        return stream


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


def deflate_count() -> int:
    """Return how many chunks are compressed at a time."""
    return min(_DEFLATE_MAX, os.cpu_count() or 1)


def import_h5py() -> Any:
    """Return the module `h5py`."""
    return need("recordings need h5py", "record", "h5py")
