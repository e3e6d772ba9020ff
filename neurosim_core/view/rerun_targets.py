"""Where the Rerun recordings of a live view go: to a viewer, or into files."""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

from neurosim_core.view.rerun_log import RerunLogger
from neurosim_core.view.rerun_sdk import RerunStream, open_rerun
from neurosim_core.view.rerun_viewer import RerunViewer

CLOSE_S = 0.3


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


class ViewerTarget:
    """Recordings go to a viewer."""

    compress = False

    def __init__(self, viewer: RerunViewer) -> None:
        self._viewer = viewer

    def open(self, name: str) -> RerunStream:
        """Open a recording; the viewer shows it."""
        return self._viewer.open(name)

    def check(self) -> bool:
        """Return False if the window was closed."""
        self._viewer.check()
        return not self._viewer.ended

    def close_recording(self, logger: RerunLogger) -> None:
        """Close a recording. A viewer that does not take it is not waited for."""

        def close() -> None:
            with contextlib.suppress(OSError):
                logger.close()

        closing = threading.Thread(target=close, name="close recording", daemon=True)
        closing.start()
        closing.join(CLOSE_S)


class FileTarget:
    """Each recording is a file: the next of NAME.rrd, NAME-2.rrd, NAME-3.rrd, ... that does not exist."""

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
        return open_rerun(self._path, name=name, footer=False)

    def check(self) -> bool:
        """Return True: files do not go away."""
        return True

    def close_recording(self, logger: RerunLogger) -> None:
        """Close a file, and say so."""
        logger.close()
        self._say(f"wrote {self._path}")


RerunTarget: TypeAlias = ViewerTarget | FileTarget
"""Where Rerun recordings are opened; `compress` says whether pictures should be small, or there at once."""
