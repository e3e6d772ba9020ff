"""Recording a live run: a thread of its own writes, a bounded queue is in between."""

from __future__ import annotations

import contextlib
import importlib.util
import threading
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from neurosim_core import __version__
from neurosim_core.config import to_yaml
from neurosim_core.flight import new_folder
from neurosim_core.nodes.channel import payload_bytes
from neurosim_core.packets import Packet
from neurosim_core.record import FlightHeader, FlightWriter, describe_sensors
from neurosim_core.simulation import Model

QUEUE_BYTES = 32_000_000
"""Most that waits to be written [bytes], besides one packet for each thread that brings some."""
_POLL_S = 0.1


def open_folders(folder: Path, vehicles: list[str], *, overwrite: bool) -> dict[str, Path]:
    """Return the folder of each vehicle's recording: that of the run, or one in it for each of several.

    Raises:
        FileExistsError: There is a recording already, and it may not be replaced.
        NotADirectoryError: A file is where a folder should be.
    """
    folders = {name: folder if len(vehicles) == 1 else folder / name for name in vehicles}
    for path in (folder, *folders.values()):
        new_folder(path, overwrite=overwrite)
    return folders


class _Entry(NamedTuple):
    """A packet that waits to be written."""

    run: int
    file: int
    vehicle: str
    packet: Packet


class Recorder:
    """Writes what the vehicles of a run measure to flight.h5, and after a reset to flight-2.h5, ...

    `write` waits where the disk is too slow, so nothing is lost: the caller takes the time for its own.
    """

    def __init__(self, folders: Mapping[str, Path], models: Mapping[str, Model]) -> None:
        """Make the folders, leave config.yaml in each, and start to wait for packets.

        Args:
            folders: Where to, by vehicle.
            models: What is flown, by vehicle.

        Raises:
            OSError: A folder cannot be written to.
            ImportError: h5py is not installed.
        """
        if importlib.util.find_spec("h5py") is None:
            raise ImportError("h5py is not installed: pip install 'neurosim[record]'")
        self._models = models
        self._folders = folders
        for name, folder in folders.items():
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "config.yaml").write_text(to_yaml(models[name].config, comments=True), "utf-8")
            for later in folder.glob("flight-*.h5"):  # of a run that is replaced
                later.unlink()
        self._run_count = 0
        self._file_count = 0
        self._seeds = {name: model.config.seed for name, model in models.items()}
        self._queue: deque[_Entry] = deque()
        self._queue_bytes = 0
        self._changed = threading.Condition()
        self._closed = False
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def begin(self, seeds: Mapping[str, int], *, replace: bool) -> None:
        """Begin a new file for each vehicle with the next packet.

        Args:
            seeds: Seed of the sensor noise, by vehicle.
            replace: What was recorded since the last time is not worth a file.
        """
        self._seeds = dict(seeds)
        self._run_count += 1
        self._file_count += not (replace and self._file_count)

    def write(self, vehicle: str, packet: Packet) -> None:
        """Hand a packet over; waits while too much is waiting.

        Raises:
            OSError: The disk is full or gone.
            ValueError: A packet could not be written.
        """
        size = payload_bytes(packet)
        with self._changed:
            while self._queue_bytes > QUEUE_BYTES and self._failure is None:
                self._changed.wait(_POLL_S)
            self.check()
            self._queue.append(_Entry(self._run_count, self._file_count, vehicle, packet))
            self._queue_bytes += size
            self._changed.notify_all()

    def check(self) -> None:
        """Raise what went wrong with the writing.

        Raises:
            OSError, ValueError: As for `write`.
        """
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Write what waits, close the files and end the thread.

        Raises:
            OSError, ValueError: As for `write`, if that has not been told yet.
        """
        with self._changed:
            if self._closed:
                return
            self._closed = True
            self._changed.notify_all()
        self._thread.join()
        self.check()

    def _run(self) -> None:
        """Write until closed; for the thread."""
        try:
            with contextlib.ExitStack() as files:
                writers: dict[str, tuple[int, FlightWriter]] = {}
                while (entry := self._next()) is not None:
                    run, writer = writers.get(entry.vehicle, (0, None))
                    if writer is None or run != entry.run:
                        if writer is not None:
                            writer.close()
                        writer = files.enter_context(self._open(entry.vehicle, entry.file))
                        writers[entry.vehicle] = (entry.run, writer)
                    writer.write(entry.packet)
        except Exception as error:  # told to whoever brings packets
            with self._changed:
                self._failure = error
                self._changed.notify_all()

    def _next(self) -> _Entry | None:
        with self._changed:
            while not self._queue:
                if self._closed:
                    return None
                self._changed.wait()
            entry = self._queue.popleft()
            self._queue_bytes -= payload_bytes(entry.packet)
            self._changed.notify_all()
            return entry

    def _open(self, vehicle: str, number: int) -> FlightWriter:
        model = self._models[vehicle]
        config = model.config.model_copy(update={"seed": self._seeds[vehicle]})
        stamps = np.linspace(0, model.duration_ns, 1001).astype(np.int64)
        header = FlightHeader(
            config_yaml=to_yaml(config),
            seed=config.seed,
            version=__version__,
            scene=model.scene.name,
            sensors=describe_sensors(config.sensors),
            path_stamp_ns=stamps,
            path_position=model.path.evaluate(stamps).position,
        )
        name = "flight.h5" if number <= 1 else f"flight-{number}.h5"
        return FlightWriter(self._folders[vehicle] / name, header)
