"""NPZ files of NumPy: arrays t (int64 [us]), x, y (uint16), p (uint8), and width and height.

Both directions hold a block in memory, not the arrays. `np.load` opens them.
"""

from __future__ import annotations

import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.io.event_file import BLOCK_EVENTS, EventFileError
from neurosim_core.packets import EventArrays

_DTYPES = {"t": "<i8", "x": "<u2", "y": "<u2", "p": "|u1"}
_COPY_BYTES = 1 << 20


class NpzSource:
    """Reads an NPZ file; `polarity` and `ts` or `timestamps` are other names for p and t."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.notes: list[str] = []
        with open(path, "rb"):
            pass  # an OSError from here on comes of what is in it
        try:
            self._zip = zipfile.ZipFile(path)
            damaged = self._zip.testzip()
        except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError, OSError) as error:
            raise EventFileError(f"{path} is not a whole NPZ file: {error}") from None
        if damaged:
            raise EventFileError(f"{path} is damaged: the checksum of {damaged} is wrong")
        names = {name.removesuffix(".npy"): name for name in self._zip.namelist()}
        others = {"t": ("ts", "timestamps"), "p": ("polarity",)}
        self._members = {}
        for name in _DTYPES:
            found = next((n for n in (name, *others.get(name, ())) if n in names), None)
            if found is None:
                raise EventFileError(f"{path} has no array {name!r}, only {sorted(names)}")
            self._members[name] = names[found]
        self.size: tuple[int, int] | None = None
        if {"width", "height"} <= names.keys():
            self.size = self._number(names["width"]), self._number(names["height"])

    def close(self) -> None:
        """Close the file."""
        self._zip.close()

    def _number(self, member: str) -> int:
        with self._zip.open(member) as file:
            return int(np.lib.format.read_array(file, allow_pickle=False))

    def read(self) -> Iterator[EventArrays]:
        """See `EventSource.read`."""
        files = {name: self._zip.open(member) for name, member in self._members.items()}
        try:
            heads = {name: _read_head(file, self._path) for name, file in files.items()}
            counts = {count for count, _ in heads.values()}
            if len(counts) != 1:
                raise EventFileError(f"{self._path}: arrays have different lengths: {sorted(counts)}")
            (count,) = counts
            for begin in range(0, count, BLOCK_EVENTS):
                length = min(BLOCK_EVENTS, count - begin)
                t, x, y, p = (_read_rows(files[name], heads[name][1], length, self._path) for name in _DTYPES)
                if p.dtype.kind == "i":
                    p = np.where(p == -1, 0, p)
                yield EventArrays(
                    t.astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8)
                )
        finally:
            for file in files.values():
                file.close()


class NpzSink:
    """Writes an NPZ file; the columns lie in temporary files beside it until it is closed."""

    def __init__(self, path: Path, *, width: int, height: int) -> None:
        self._path, self._size = path, (width, height)
        self._columns = {
            name: tempfile.TemporaryFile(dir=path.parent)  # noqa: SIM115 (closed by close())
            for name in _DTYPES
        }
        self._count = 0
        self._zip: zipfile.ZipFile | None = zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1)

    def write(self, events: EventArrays) -> None:
        """See `EventSink.write`."""
        block = events
        for (name, dtype), column in zip(_DTYPES.items(), block, strict=True):
            self._columns[name].write(np.ascontiguousarray(column, dtype).data)
        self._count += len(block.t)

    def close(self) -> None:
        """Complete the file. Closing twice is allowed."""
        if self._zip is None:
            return
        with self._zip as archive:
            self._zip = None
            for name, value in zip(("width", "height"), self._size, strict=True):
                with archive.open(_member(name), "w") as out:
                    np.lib.format.write_array(out, np.array(value))
            for name, dtype in _DTYPES.items():
                head = {"descr": dtype, "fortran_order": False, "shape": (self._count,)}
                with self._columns[name] as column, archive.open(_member(name), "w", force_zip64=True) as out:
                    np.lib.format.write_array_header_1_0(out, head)
                    column.seek(0)
                    shutil.copyfileobj(column, out, _COPY_BYTES)


def _member(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(f"{name}.npy")  # of 1980: the same events give the same bytes
    info.compress_type = zipfile.ZIP_DEFLATED
    return info


def _read_head(file: IO[bytes], path: Path) -> tuple[int, np.dtype[Any]]:
    """Return the length and the type of an array, and leave the file at its first item."""
    try:
        version = np.lib.format.read_magic(file)
        read = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = read(file)
    except ValueError as error:
        raise EventFileError(f"{path}: {error}") from None
    if len(shape) != 1 or dtype.kind not in "iub":
        raise EventFileError(
            f"{path}: arrays of events have one axis and whole numbers, not {shape}, {dtype}"
        )
    return int(shape[0]), dtype


def _read_rows(file: IO[bytes], dtype: np.dtype[Any], count: int, path: Path) -> NDArray[Any]:
    data = file.read(count * dtype.itemsize)
    if len(data) != count * dtype.itemsize:
        raise EventFileError(f"{path}: an array is shorter than its header says")
    return np.frombuffer(data, dtype)
