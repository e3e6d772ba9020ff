"""Rerun itself: imported where it is used, and recordings that keep apart."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from neurosim_core.install import install_hint

if TYPE_CHECKING:
    import rerun as rr

TIMELINE = "sim_time"
"""The only timeline: simulated time."""
_QUIET = "warn,re_log_encoding=off,re_sdk::recording_stream=off"
"""What Rerun says: nothing of files that it cannot write, which `RerunLogger.flush` raises, or that have no
footer, which are meant."""


def import_rerun() -> ModuleType:
    """Return the module `rerun`.

    Raises:
        ImportError: It is not installed; the message says what to install.
    """
    quiet = "rerun" not in sys.modules and "RUST_LOG" not in os.environ
    if quiet:
        os.environ["RUST_LOG"] = _QUIET  # read once, at the import
    try:
        import rerun
        import rerun.blueprint
    except ImportError as error:
        raise ImportError(f"the viewer needs Rerun: {install_hint('view')}") from error
    finally:
        if quiet:
            del os.environ["RUST_LOG"]
    return rerun


def open_rerun(path: str | Path | None = None, *, name: str = "", footer: bool = True) -> rr.RecordingStream:
    """Open a recording of its own, independent of others in this process.

    Args:
        path: Write it to this .rrd file; None: the caller connects it (`connect_grpc`, ...).
        name: What the viewer calls it; empty: by the time of its beginning.
        footer: End the file with a table of its chunks, which makes it quick to open. It is collected in
            memory, so what may go on for hours does without.

    Raises:
        OSError: The file cannot be written.
        ImportError: Rerun is not installed.
    """
    rr = import_rerun()
    recording = rr.RecordingStream("neurosim")
    recording.set_log_time_enabled(False)  # wall-clock time has no place in a simulation's recording
    recording.set_log_tick_enabled(False)
    if path is not None:
        try:
            Path(path).touch()
            recording.save(path, write_footer=footer)
        except (OSError, RuntimeError) as error:
            raise OSError(f"cannot write {path}: {error}") from error
    if name:
        recording.send_recording_name(name)
    return recording  # type: ignore[no-any-return]
