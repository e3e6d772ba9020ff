"""The file below a recording: whole records or nothing, and no buffer that a crash could take along."""

from __future__ import annotations

import os
from pathlib import Path


class Sink:
    """What the MCAP writer writes to. Each of its `write` calls holds whole records.

    Args:
        path: The file to make.
        overwrite: Whether a file that exists may be replaced.

    Raises:
        FileExistsError: It exists.
        OSError: It cannot be made.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | (os.O_TRUNC if overwrite else os.O_EXCL)
        self._descriptor = os.open(path, flags, 0o666)
        self._position = 0

    def tell(self) -> int:
        """Bytes written so far."""
        return self._position

    def write(self, data: bytes) -> int:
        """Write all of it; if that fails, what was written of it is taken back.

        Raises:
            OSError: The disk is full, or whatever else the kernel says.
        """
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError:
            os.ftruncate(self._descriptor, self._position)
            os.lseek(self._descriptor, self._position, os.SEEK_SET)
            raise
        self._position += len(data)
        return len(data)

    def flush(self) -> None:
        """Nothing waits here: what was written is the kernel's, and survives the death of this process."""

    def close(self) -> None:
        """Close the file."""
        if self._descriptor >= 0:
            descriptor, self._descriptor = self._descriptor, -1
            os.close(descriptor)
