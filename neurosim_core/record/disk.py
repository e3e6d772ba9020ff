"""Files that are written: the one below HDF5, what errors say of a file, and whose it is after a fork."""

from __future__ import annotations

import contextlib
import os
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol


class _Recording(Protocol):
    def disown(self) -> None:
        """Write nothing any more; called once, in a process that was forked."""


_open: weakref.WeakSet[_Recording] = weakref.WeakSet()


def disown_when_forked(recording: _Recording) -> None:
    """Have `recording.disown()` called in each process that is forked from this one: its parent goes on."""
    _open.add(recording)


def forked_error(path: Path) -> RuntimeError:
    """Return what a forked process is told that writes to a recording of its parent."""
    return RuntimeError(f"{path} was opened before this process was forked: only its parent can write to it")


def _disown() -> None:
    for recording in [*_open]:
        recording.disown()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_disown)


@contextlib.contextmanager
def naming_file(path: str | Path) -> Iterator[None]:
    """Name a file in the errors of a block that writes it, unless they do."""
    try:
        yield
    except OSError as error:
        if str(path) in str(error.strerror or error):
            raise
        raise type(error)(f"cannot write {path}: {error.strerror or error}") from error


class Disk:
    """The file below HDF5, which changes what is on disk only at `seal`.

    What HDF5 appends goes to disk at once; what it writes over the part that was sealed before (a few kB of
    its own bookkeeping) is held back until everything that it refers to is on disk. So a process that is
    killed leaves the state of the last seal, unless that hits the millisecond in which this part is written.

    After a failed write it only pretends to write: HDF5 would try again when it closes an object, and crash.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with naming_file(path):
            self._file = open(path, "w+b", buffering=0)  # noqa: SIM115 (closed by close())
        self._error: OSError | None = None
        self.taken_bytes = 0
        """Size of the data that the disk has taken so far [bytes]."""
        self.is_writing = False
        self._is_ours = True
        self._offset = 0
        self._sealed_size = 0
        self._held: dict[tuple[int, int], bytes] = {}

    def seal(self) -> None:
        """Bring what was held back to disk.

        Raises:
            OSError: Something could not be written since the file was opened.
        """
        for (offset, _), data in sorted(self._held.items(), key=lambda item: item[0][0] > 0):
            self._write(offset, memoryview(data))  # first the superblock, which says how long the file is
        self._held.clear()
        if self._error is not None:
            with naming_file(self._path):
                raise self._error
        self._sealed_size = os.fstat(self._file.fileno()).st_size

    def close(self) -> None:
        """Close the file; what was not sealed is lost."""
        self._file.close()

    def disown(self) -> None:
        """Only pretend to write from now on."""
        self._is_ours = False

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move, as a file object does."""
        if whence == os.SEEK_CUR:
            offset += self._offset
        elif whence == os.SEEK_END:
            offset += os.fstat(self._file.fileno()).st_size
        self._offset = offset
        return offset

    def tell(self) -> int:
        """Return the place, as a file object does."""
        return self._offset

    def read(self, size: int) -> bytes:
        """Read without `readinto`; by this method h5py knows a file."""
        buffer = bytearray(size)
        return bytes(buffer[: self.readinto(memoryview(buffer))])

    def readinto(self, buffer: memoryview) -> int:
        """Read what was written last, held back or not."""
        data = os.pread(self._file.fileno(), len(buffer), self._offset)  # forked processes share the position
        found = len(data)
        buffer[:found] = data
        for (offset, size), data in self._held.items():
            low, high = max(offset, self._offset), min(offset + size, self._offset + len(buffer))
            if low < high:
                buffer[low - self._offset : high - self._offset] = data[low - offset : high - offset]
        self._offset += found
        return found

    def write(self, data: memoryview) -> int:
        """Append at once, and hold back what goes over what was sealed."""
        held = min(max(self._sealed_size - self._offset, 0), len(data))
        if held:
            key = (self._offset, held)
            self._held.pop(key, None)  # later writes win where they overlap
            self._held[key] = bytes(data[:held])
        self._write(self._offset + held, data[held:])
        self._offset += len(data)
        return len(data)

    def truncate(self, size: int) -> int:
        """Cut the file, as a file object does."""
        if self._error is None and self._is_ours:
            try:
                self._file.truncate(size)
            except OSError as error:
                self._error = error
        return size

    def flush(self) -> None:
        """Do nothing: HDF5 asks before everything is consistent; `seal` says when it is."""

    def _write(self, offset: int, data: memoryview) -> None:
        while self._error is None and self._is_ours and len(data):
            self.is_writing = True
            try:
                written = os.pwrite(self._file.fileno(), data, offset)
                self.taken_bytes += written
                offset, data = offset + written, data[written:]
            except OSError as error:
                self._error = error
            self.is_writing = False
