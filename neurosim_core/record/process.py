"""A recording that a process of its own writes, and more processes, forked from that one, compress.

All this would take Python's interpreter lock from the simulation thread. Packets go through a socket: as a
pickled list, and after it their arrays as they are. Where the stream ends, also because the process that flew
was killed, the file is closed. Threads could compress, but for the lock: a chunk takes it dozens of times,
and each time waits for all others. A thread that hands a chunk to a process asks for it thrice.
"""

from __future__ import annotations

import contextlib
import gc
import itertools
import os
import pickle
import queue
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.packets import Packet, PacketSchema, as_numpy, packet_class, schema_of
from neurosim_core.record.columns import deflate
from neurosim_core.record.disk import disown_when_forked, forked_error, naming_file
from neurosim_core.record.frames import connect, receive_frame, send_frame
from neurosim_core.record.hdf5 import RecordingWriter, deflate_count, import_h5py
from neurosim_core.record.header import RecordingHeader

_QUEUE_BYTES = 32_000_000
"""What may wait to be sent [bytes]."""
_COPIED_BYTES = 4096
"""Smaller arrays are copied at once."""
_FRAME_BYTES = 1_000_000
"""What is larger is not sent together with what comes after it [bytes]."""
_BUFFER_BYTES = 128_000_000
"""What the process takes between two flushes [bytes]: each waits for the last chunks to be compressed."""
_RECEIVED_MAX = 16
"""Frames that a thread of the process that writes receives ahead."""
_SCALARS = (int, float, bool, str)
_ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",  # its threads take time to start
    "MALLOC_MMAP_THRESHOLD_": "1000000000",  # glibc keeps what is freed: to map memory anew takes time
    "MALLOC_TRIM_THRESHOLD_": "1000000000",
}


class _Process:
    """A process that writes a recording, or waits for one."""

    def __init__(self) -> None:
        self.socket, theirs = connect()
        # `-m` would look for modules in the working directory first, where a yaml.py may lie
        path = [entry for entry in sys.path if isinstance(entry, str)]  # Python ignores others
        program = f"import sys; sys.path[:] = {path!r}; from {__name__} import main; main()"
        with theirs:
            self.popen = subprocess.Popen(
                [sys.executable, "-c", program],
                stdin=theirs.fileno(),
                stdout=subprocess.PIPE,
                env=dict(os.environ) | _ENVIRONMENT,
                start_new_session=True,  # Ctrl-C is for the one that flies, which then closes the recording
            )
        disown_when_forked(self)

    def disown(self) -> None:
        """Let it see the end of the stream when the process ends that this one was forked from."""
        self.socket.close()
        if self in _spare:
            _spare.remove(self)


_spare: list[_Process] = []


def start_process() -> None:
    """Start the process of the next recording, beside other work: it takes 0.2 s. Again: does nothing."""
    if not _spare:
        _spare.append(_Process())


def _take_process() -> _Process:
    """Return the process that waits for a recording, or a new one: what waits long may have been killed."""
    while _spare:
        process = _spare.pop()
        if process.popen.poll() is None:
            return process
        process.socket.close()
        process.popen.communicate()  # closes the pipe
    return _Process()


class RecordingProcess:
    """Writes packets to a file as `RecordingWriter` does, in a process of its own.

    `write` hands a packet over, and waits only where the process is far behind. Arrays of 4 kB and more are
    read later and must not change. What goes wrong in the process is raised by the next call. Without `close`
    the file holds what was sent until this process ended, and is not marked as complete.
    """

    def __init__(self, path: Path, header: RecordingHeader) -> None:
        """Create the file, replacing one that exists.

        Raises:
            OSError: The file cannot be created.
        """
        with naming_file(path):
            path.open("wb").close()
        self._path = path
        self.kept_ns: int | None = None
        """When writing has failed: the file holds the packets up to this stamp [ns]; None: unknown."""
        self._process = _take_process()
        self._failure: Exception | None = None
        self._closed = False
        self._classes: dict[type[Packet], tuple[int, tuple[str, ...]]] = {}
        self._queue: queue.SimpleQueue[tuple[int, bytes, Sequence[NDArray[Any]]] | None] = queue.SimpleQueue()
        self._put_bytes = self._sent_bytes = 0
        self._is_sending = True
        self._progress = threading.Event()
        self._thread = threading.Thread(target=self._send, name="recording", daemon=True)
        self._thread.start()
        self._put((os.fspath(path.absolute()), header))
        disown_when_forked(self)

    def write(self, packet: Packet) -> None:
        """Hand one packet over.

        Raises:
            OSError: The disk is full or gone, or the process has ended.
            ValueError, TypeError: A packet before this one cannot be recorded, see `RecordingWriter.write`.
        """
        if self._failure is not None:
            raise self._failure
        if self._closed:
            raise ValueError(f"{self._path} is closed")
        kind = type(packet)
        if kind not in self._classes:
            schema = schema_of(kind).to_json()
            self._classes[kind] = len(self._classes), tuple(field.name for field in fields(kind))
            self._put((*self._classes[kind], schema))
        number, names = self._classes[kind]
        values: list[Any] = []
        arrays: list[NDArray[Any]] = []
        size = 0  # of them
        for name in names:
            value = getattr(packet, name)
            if type(value) not in _SCALARS and not isinstance(value, np.generic):
                array = value = as_numpy(value)
                place: bytes | int = size
                if array.dtype.kind not in "OV":  # of objects it holds addresses; records have names
                    if array.nbytes >= _COPIED_BYTES:
                        arrays.append(np.ascontiguousarray(array).view(np.uint8))
                        size += array.nbytes
                    else:
                        place = array.tobytes()
                    value = array.dtype.str, array.shape, place
            values.append(value)
        self._put((number, size, values), arrays)
        if self._put_bytes - self._sent_bytes > _QUEUE_BYTES:
            self._wait()
        if not self._is_sending:
            self._end(early=True)

    def close(self, *, complete: bool = True) -> None:
        """Wait until all is written, and mark the file as complete unless it is not. Again: does nothing.

        Where the disk takes nothing for some seconds, the process says so. Ctrl-C ends the waiting; what is
        not written yet is lost unless the disk comes back.

        Args:
            complete: All that was to be recorded was written.

        Raises:
            OSError: The disk is full or gone, or the process has ended.
        """
        if not self._closed:
            self._closed = True
            self._put(complete)
            self._queue.put(None)
            self._thread.join()
            self._end(early=self._sent_bytes < self._put_bytes)

    def disown(self) -> None:
        """Leave the recording to the process that this one was forked from."""
        self._closed, self._failure = True, forked_error(self._path)

    def _put(self, content: Any, arrays: Sequence[NDArray[Any]] = ()) -> None:
        body = pickle.dumps(content)
        size = len(body) + sum(array.nbytes for array in arrays)
        self._put_bytes += size
        self._queue.put((size, body, arrays))

    def _send(self) -> None:
        """Send what is put, until that is None or the process has ended; together what waits."""
        is_over = False
        try:
            while not is_over:
                size = 0
                bodies: list[bytes] = []
                arrays: list[NDArray[Any]] = []
                while not bodies or (size < _FRAME_BYTES and not self._queue.empty()):
                    entry = self._queue.get()
                    if is_over := entry is None:
                        break
                    size += entry[0]
                    bodies.append(entry[1])
                    arrays.extend(entry[2])
                if bodies:
                    send_frame(self._process.socket, bodies, arrays)
                self._sent_bytes += size
                self._progress.set()
        except OSError:
            pass  # why it has ended, `_end` finds out
        finally:
            self._is_sending = False
            self._progress.set()

    def _wait(self) -> None:
        """Wait until there is room in the queue."""
        try:
            while True:
                self._progress.clear()
                if self._put_bytes - self._sent_bytes <= _QUEUE_BYTES or not self._is_sending:
                    return
                self._progress.wait()
        except KeyboardInterrupt:
            self._closed = True  # `close` would only wait again
            raise

    def _end(self, *, early: bool = False) -> None:
        """Wait for the end of the process, and raise what went wrong; always if that is `early`."""
        self._closed = True
        self._process.socket.close()
        report = self._process.popen.communicate()[0]
        status = self._process.popen.returncode
        if not status:
            self._failure, self.kept_ns = pickle.loads(report)
        if status or (early and self._failure is None):
            how = f"by signal {-status}" if status < 0 else f"with exit status {status}"
            self._failure = OSError(f"cannot write {self._path}: the process that writes it ended {how}")
        if self._failure is not None:
            raise self._failure


class _Compressors:
    """Processes that are forked from this one, which must not have threads yet; they end with it."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._idle: queue.SimpleQueue[socket.socket] = queue.SimpleQueue()
        for _ in range(count):
            ours, theirs = connect()
            if os.fork() == 0:
                os.closerange(0, 3)  # the end of this process must be seen by those who have them
                ours.close()
                _compress(theirs)
            theirs.close()
            self._idle.put(ours)

    def deflate(self, columns: Sequence[tuple[Sequence[NDArray[Any]], int]]) -> list[list[Any]]:
        """Return what `columns.deflate` does; from as many threads at a time as there are processes.

        Raises:
            OSError: A process has ended.
        """
        link = self._idle.get()
        try:
            forms = [(parts[0].dtype.str, parts[0].shape[1:], length) for parts, length in columns]
            counts = [sum(map(len, parts)) for parts, _ in columns]
            arrays = [np.ascontiguousarray(part) for parts, _ in columns for part in parts]
            send_frame(link, [pickle.dumps((forms, counts))], arrays)
            (sizes,), data = receive_frame(link)
        except (EOFError, OSError):
            raise OSError("a process that compresses has ended") from None
        finally:
            self._idle.put(link)
        ends = itertools.accumulate(itertools.chain(*sizes))
        return [[data[end - size : end] for size, end in zip(column, ends, strict=False)] for column in sizes]


def _compress(link: socket.socket) -> None:
    """Compress what comes, and end the process when nobody asks any more."""
    try:
        while True:
            ((forms, counts),), data = receive_frame(link)
            columns, begin = [], 0
            for (dtype, shape, length), count in zip(forms, counts, strict=True):
                rows: NDArray[Any] = np.ndarray((count, *shape), dtype, data, begin)
                columns.append(([rows], length))
                begin += rows.nbytes
            chunks = deflate(columns)
            body = pickle.dumps([[*map(len, column)] for column in chunks])
            send_frame(link, [body], [np.frombuffer(b"".join(itertools.chain(*chunks)), np.uint8)])
    finally:
        os._exit(0)


def main() -> None:
    """Be the process: write what comes from file 0, the socket, and report on file 1."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # it ends with the one that flies
        signal.signal(number, signal.SIG_IGN)
    gc.disable()  # packets have no cycles
    compressors = _Compressors(deflate_count())
    failure, kept_ns = None, None
    with socket.socket(fileno=0) as source:
        try:
            import_h5py()
            ((path, header), *contents), arrays = receive_frame(source)
            writer = RecordingWriter(path, header, buffer_bytes=_BUFFER_BYTES, deflate=compressors.deflate)
            try:
                _write(writer, source, (contents, arrays))
            finally:
                kept_ns = writer.kept_ns
        except EOFError:  # nothing is recorded
            return
        except Exception as error:  # raised by `_end`
            failure = error
    with contextlib.suppress(BrokenPipeError), open(1, "wb") as report:
        pickle.dump((failure, kept_ns), report)


def _write(
    writer: RecordingWriter, source: socket.socket, first: tuple[list[Any], NDArray[np.uint8]]
) -> None:
    """Write what comes until the stream ends; what is cut off is dropped."""
    classes: dict[int, tuple[Any, Sequence[str]]] = {}
    complete = False
    frames: queue.Queue[tuple[list[Any], NDArray[np.uint8]] | Exception] = queue.Queue(_RECEIVED_MAX)
    frames.put(first)

    def receive() -> None:
        try:
            while True:
                frames.put(receive_frame(source))
        except Exception as error:
            frames.put(error)

    threading.Thread(target=receive, name="receive", daemon=True).start()
    try:
        while not isinstance(frame := frames.get(), (EOFError, OSError)):
            if isinstance(frame, Exception):
                raise frame
            contents, arrays = frame
            begin = 0
            for content in contents:
                if isinstance(content, bool):
                    complete = content
                    return
                number, size, values = content
                if number not in classes:
                    classes[number] = packet_class(PacketSchema.from_json(values)), size
                    continue
                for index, value in enumerate(values):
                    if type(value) is tuple:
                        dtype, shape, place = value
                        at = (place, 0) if isinstance(place, bytes) else (arrays, begin + place)
                        values[index] = np.ndarray(shape, dtype, *at)
                begin += size
                kind, names = classes[number]
                packet = object.__new__(kind)  # a class that is frozen takes 5 us
                packet.__dict__.update(zip(names, values, strict=True))
                writer.write(packet)
    finally:
        writer.close(complete=complete)
