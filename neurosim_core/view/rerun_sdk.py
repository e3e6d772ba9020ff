"""Rerun itself: imported where it is used, recordings that keep apart, and how often it is called."""

from __future__ import annotations

import io
import itertools
import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from neurosim_core.install import need

TIMELINE = "sim_time"
"""The only timeline: simulated time."""
_QUIET = "warn,re_log_encoding::rrd::file_sink=error"
"""What Rerun says: no warning of files without a footer, which are meant."""
_PIPE_BYTES = 1 << 20
_BATCH_ROWS = 1024


def import_rerun() -> Any:
    """Return the module `rerun`."""
    quiet = "rerun" not in sys.modules and "RUST_LOG" not in os.environ
    if quiet:
        os.environ["RUST_LOG"] = _QUIET  # read once, at the import
    try:
        return need("the viewer needs Rerun", "view", "rerun", "rerun.blueprint")
    finally:
        if quiet:
            del os.environ["RUST_LOG"]


class RerunStream:
    """A recording of Rerun's, independent of others in this process, and the file that it goes to, if any.

    A thread writes to the file what Rerun writes into a pipe: on a full disk Rerun's own writing hangs.

    Attributes:
        recording: Where to log.
    """

    def __init__(self, path: str | Path | None = None, *, name: str = "", footer: bool = True) -> None:
        """Open it.

        `path`: write it to this .rrd file; None: the caller connects it (`connect_grpc`, ...). `name`: what
        the viewer calls it; empty: by the time of its beginning. `footer`: end the file with a table of its
        chunks, which makes it quick to open. It is collected in memory, so what may go on for hours does
        without.
        """
        self.recording = import_rerun().RecordingStream("neurosim")
        self.recording.set_log_time_enabled(False)  # wall-clock time has no place in a simulation's recording
        self.recording.set_log_tick_enabled(False)
        self._path = path
        self._error: OSError | None = None
        self._writer: threading.Thread | None = None
        if path is not None:
            try:
                self._open_file(path, footer)
            except (OSError, RuntimeError) as error:
                raise OSError(f"cannot write {path}: {error}") from error
        if name:
            self.recording.send_recording_name(name)

    def check(self) -> None:
        """See whether all that has left so far could be written; wait for nothing."""
        if self._error is not None:
            raise OSError(self._error.errno, f"cannot write {self._path}: {self._error.strerror}")

    def close(self) -> None:
        """Disconnect from the file or viewer."""
        self.recording.disconnect()
        if self._writer is not None:
            self._writer.join()
            self.check()

    def _open_file(self, path: str | Path, footer: bool) -> None:
        file = open(path, "wb", buffering=0)  # noqa: SIM115 (closed by the thread)
        read_end, write_end = os.pipe()
        self._writer = threading.Thread(target=self._write, args=(file, read_end), daemon=True)
        self._writer.start()
        try:
            self.recording.save(f"/dev/fd/{write_end}", write_footer=footer)
        finally:
            os.close(write_end)  # Rerun has its own; the pipe ends when that is closed

    def _write(self, file: io.FileIO, read_end: int) -> None:
        with file, open(read_end, "rb", buffering=0) as pipe:
            while data := pipe.read(_PIPE_BYTES):
                while data and self._error is None:  # after an error, what comes is let go
                    try:
                        data = data[file.write(data) :]
                    except OSError as error:
                        self._error = error


def check_new_file(path: Path) -> None:
    """Check that a Rerun file of this name can be written without replacing anything."""
    if path.is_dir():
        raise OSError(f"cannot write {path}: it is a folder")
    if path.suffix != ".rrd":
        raise ValueError(f"a file of Rerun ends in .rrd, got {path}")
    if not path.parent.is_dir():
        raise OSError(f"cannot write {path}: there is no folder {path.parent}")
    if path.exists():
        raise FileExistsError(f"{path} is there already: name another file")


class RerunFiles:
    """Recordings go to files: each to the next of NAME.rrd, NAME-2.rrd, ... that does not exist."""

    compress = True

    def __init__(self, path: Path, say: Callable[[str], None]) -> None:
        """Refuse at once what cannot be written."""
        check_new_file(path)
        self._say = say
        numbered = (path.with_name(f"{path.stem}-{k}{path.suffix}") for k in itertools.count(2))
        self._next = (other for other in itertools.chain([path], numbered) if not other.exists())
        self._path = path

    def open(self, name: str) -> RerunStream:
        """Open the next file."""
        self._path = next(self._next)
        return RerunStream(self._path, name=name, footer=False)

    def check(self) -> bool:
        """Return True: files do not go away."""
        return True

    def close_recording(self, logger: Any) -> None:
        """Close a file, and say so."""
        logger.close()
        self._say(f"wrote {self._path}")


class RateLimit:
    """Lets so many pass that their mean rate is as wanted, whatever rate they come at."""

    def __init__(self, period_ns: int, *, burst_ns: int = 0) -> None:
        """Let the first one pass.

        `period_ns`: mean time between those that pass, at least [ns]. `burst_ns`: how far ahead of the mean
        rate they may be, when they come at once [ns].
        """
        self._period_ns = period_ns
        self._burst_ns = burst_ns
        self._due_ns: dict[str, int] = {}

    def passes(self, key: str, now_ns: int) -> bool:
        """Return whether one of a kind may pass now."""
        earliest_ns = now_ns - self._burst_ns
        due_ns = self._due_ns.get(key, earliest_ns)
        if now_ns < due_ns - self._period_ns:  # time has begun again
            due_ns = now_ns
        if now_ns < due_ns:
            return False
        self._due_ns[key] = max(due_ns + self._period_ns, earliest_ns)
        return True


class Table:
    """Rows of one entity that are sent together."""

    def __init__(self, entity: str, send: Callable[..., None], *, span_ns: int | None) -> None:
        """Start empty.

        `send`: called with the entity, the stamps [ns], and an array of rows for each column, by its name.
        `span_ns`: longest simulated time that rows wait [ns]; None: until there are 1024, or `send`.
        """
        self._entity = entity
        self._send = send
        self._span_ns = span_ns
        self._stamp_ns: list[int] = []
        self._rows: list[dict[str, Any]] = []

    def append(self, stamp_ns: int, **values: Any) -> None:
        """Add a row: a value or an array for each column."""
        if self._stamp_ns and stamp_ns < self._stamp_ns[-1]:  # after a reset
            self.send()
        self._stamp_ns.append(stamp_ns)
        self._rows.append({name: np.array(value, np.float64).reshape(-1) for name, value in values.items()})
        span_ns = stamp_ns - self._stamp_ns[0]
        if len(self._rows) >= _BATCH_ROWS or (self._span_ns is not None and span_ns >= self._span_ns):
            self.send()

    def send(self) -> None:
        """Send the rows that wait."""
        if self._rows:
            columns = {name: np.stack([row[name] for row in self._rows]) for name in self._rows[0]}
            self._send(self._entity, np.array(self._stamp_ns, dtype=np.int64), **columns)
            self._stamp_ns, self._rows = [], []
