"""Rerun itself: imported where it is used, and recordings that keep apart."""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path
from typing import Any

from neurosim_core.install import need
from neurosim_core.record.disk import naming_file

TIMELINE = "sim_time"
"""The only timeline: simulated time."""
_QUIET = "warn,re_log_encoding::rrd::file_sink=error"
"""What Rerun says: no warning of files without a footer, which are meant."""
_PIPE_BYTES = 1 << 20


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
    """A recording of Rerun's, and the file that it goes to if it goes to one.

    Attributes:
        recording: Where to log.
    """

    def __init__(self, recording: Any, file: _FileWriter | None = None) -> None:
        self.recording = recording
        self._file = file

    def check(self) -> None:
        """See whether all that has left so far could be written; wait for nothing."""
        if self._file is not None:
            self._file.check()

    def close(self) -> None:
        """Disconnect from the file or viewer."""
        self.recording.disconnect()
        if self._file is not None:
            self._file.join()
            self.check()


class _FileWriter:
    """Writes to a file what Rerun writes into a pipe: on a full disk Rerun's own writing hangs."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._error: OSError | None = None
        self._file = open(path, "wb", buffering=0)  # noqa: SIM115 (closed by the thread)
        self._read_end, self.write_end = os.pipe()
        self._thread = threading.Thread(target=self._run, name="Rerun file", daemon=True)
        self._thread.start()

    def check(self) -> None:
        if self._error is not None:
            with naming_file(self._path):
                raise self._error

    def join(self) -> None:
        self._thread.join()

    def _run(self) -> None:
        with self._file, open(self._read_end, "rb", buffering=0) as pipe:
            while data := pipe.read(_PIPE_BYTES):
                while data and self._error is None:  # after an error, what comes is let go
                    try:
                        data = data[self._file.write(data) :]
                    except OSError as error:
                        self._error = error


def open_rerun(path: str | Path | None = None, *, name: str = "", footer: bool = True) -> RerunStream:
    """Open a recording of its own, independent of others in this process.

    `path`: write it to this .rrd file; None: the caller connects it (`connect_grpc`, ...). `name`: what the
    viewer calls it; empty: by the time of its beginning. `footer`: end the file with a table of its chunks,
    which makes it quick to open. It is collected in memory, so what may go on for hours does without.
    """
    rr = import_rerun()
    recording = rr.RecordingStream("neurosim")
    recording.set_log_time_enabled(False)  # wall-clock time has no place in a simulation's recording
    recording.set_log_tick_enabled(False)
    file = None
    if path is not None:
        try:
            file = _FileWriter(Path(path))
            recording.save(f"/dev/fd/{file.write_end}", write_footer=footer)
        except (OSError, RuntimeError) as error:
            raise OSError(f"cannot write {path}: {error}") from error
        finally:
            if file is not None:
                os.close(file.write_end)  # Rerun has its own; the pipe ends when that is closed
    if name:
        recording.send_recording_name(name)
    return RerunStream(recording, file)
