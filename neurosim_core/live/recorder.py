"""Recording a live run: a thread of its own writes, a bounded queue is in between."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neurosim_core import __version__
from neurosim_core.config import SimulationConfig, to_yaml
from neurosim_core.flight import new_folder
from neurosim_core.install import install_hint
from neurosim_core.live.channel import payload_bytes
from neurosim_core.packets import Packet
from neurosim_core.record import RecordingHeader, RecordingWriter, describe_sensors
from neurosim_core.simulation import Model

QUEUE_BYTES = 16_000_000
"""Most that waits to be written [bytes], besides one packet for each thread that brings some.

gzip writes it in 0.2 s: little enough to be written when somebody who has pressed Ctrl-C waits for it."""
HURRY_S = 1.0
"""How long what waits may take to be written when the run was stopped [s]."""
PATIENCE_S = 30.0
"""How long it may when the run came to its own end [s]."""
CLOSE_FILES_S = 0.3
"""How long it may take to close the files after that [s]."""
SETTINGS = "settings.jsonl"
"""File in the folder of a recording that says which settings were changed when; see `Recorder.change`."""
_POLL_S = 0.05


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
    name: str
    """Of the file."""
    config: SimulationConfig
    """What held when the file began."""
    vehicle: str
    packet: Packet


class Recorder:
    """Writes what the vehicles of a run measure to flight.h5, and after a reset to flight-2.h5, ...

    `write` waits where the disk is too slow, so nothing is lost: the caller takes the time for its own. Once
    the run is stopped nobody waits for longer than a deadline: what is not written then is counted.

    Attributes:
        stop: Set when the run is to end soon.
        unwritten_count: Packets that were not written, as the disk was too slow at the end.
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
            raise ImportError(f"h5py is not installed: {install_hint('record')}")
        self._models = models
        self._folders = folders
        for name, folder in folders.items():
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "config.yaml").write_text(to_yaml(models[name].config, comments=True), "utf-8")
            for later in folder.glob("flight-*.h5"):  # of a run that is replaced
                later.unlink()
            (folder / SETTINGS).unlink(missing_ok=True)
        self.stop = threading.Event()
        self.unwritten_count = 0
        self._run_count = 0
        self._file_count = 0
        self._configs = {name: model.config for name, model in models.items()}
        """Settings that hold now, by vehicle."""
        self._begun = dict(self._configs)
        """Those that held when the files of this run began."""
        self._changes: dict[str, list[dict[str, Any]]] = {name: [] for name in folders}
        self._deadline_s: float | None = None
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
        self._run_count += 1
        self._file_count += not (replace and self._file_count)
        self._begun = {
            name: config.model_copy(update={"seed": seeds[name]}) for name, config in self._configs.items()
        }
        for (
            vehicle,
            changes,
        ) in self._changes.items():  # those of a file that is replaced are in its settings now
            kept = [change for change in changes if change["file"] != self._file_name()]
            if kept != changes:
                self._changes[vehicle] = kept
                self._write_changes(vehicle)

    def change(self, config: SimulationConfig, *, stamp_ns: int) -> None:
        """Note that settings have changed: in settings.jsonl for open files, and in those that begin later.

        Each line is a JSON object: `file`, `stamp_ns` from which on it holds, `key`, `value` and `before`.

        Args:
            config: What holds now.
            stamp_ns: Simulated time [ns].

        Raises:
            OSError: The file cannot be written.
        """
        for vehicle, before in self._configs.items():
            now = self._configs[vehicle] = config.of(vehicle)
            old, new = _flat(before.model_dump(mode="json")), _flat(now.model_dump(mode="json"))
            changed = [key for key in sorted(old.keys() | new.keys()) if old.get(key) != new.get(key)]
            for key in changed:
                values = {"key": key, "value": new.get(key), "before": old.get(key)}
                self._changes[vehicle].append({"file": self._file_name(), "stamp_ns": stamp_ns, **values})
            if changed:
                self._write_changes(vehicle)

    def write(self, vehicle: str, packet: Packet) -> None:
        """Hand a packet over; waits while too much is waiting, until the run is to end.

        Raises:
            OSError: The disk is full or gone.
            ValueError: A packet could not be written.
        """
        size = payload_bytes(packet)
        with self._changed:
            while self._queue_bytes > QUEUE_BYTES and self._failure is None and not self.stop.is_set():
                self._changed.wait(_POLL_S)
            self.check()
            self._queue.append(
                _Entry(self._run_count, self._file_name(), self._begun[vehicle], vehicle, packet)
            )
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
        """Write what waits, close the files and end the thread; give up at a deadline.

        Raises:
            TimeoutError: Not everything was written in time; says how much was not.
            OSError, ValueError: As for `write`, if that has not been told yet.
        """
        with self._changed:
            if self._closed:
                return
            self._closed = True
            limit_s = HURRY_S if self.stop.is_set() else PATIENCE_S
            self._deadline_s = time.monotonic() + limit_s
            self._changed.notify_all()
        self._thread.join(limit_s + CLOSE_FILES_S)
        with self._changed:
            self.check()
            hangs = self._thread.is_alive()
            self.unwritten_count += len(self._queue) + hangs  # and the one that is being written
            count = self.unwritten_count
        if count:
            still = "; it hangs, and the files are not closed" if hangs else ""
            raise TimeoutError(
                f"the disk is too slow: {count:,} packets at the end of the run were not written in "
                f"{limit_s:g} s{still}"
            )

    def _run(self) -> None:
        """Write until closed; for the thread."""
        try:
            with contextlib.ExitStack() as files:
                writers: dict[str, tuple[int, RecordingWriter]] = {}
                while (entry := self._next()) is not None:
                    run, writer = writers.get(entry.vehicle, (0, None))
                    if writer is None or run != entry.run:
                        if writer is not None:
                            writer.close()
                        writer = files.enter_context(self._open(entry))
                        writers[entry.vehicle] = (entry.run, writer)
                    writer.write(entry.packet)
                for _, writer in writers.values():
                    writer.close(complete=not self._queue)
        except Exception as error:  # told to whoever brings packets
            with self._changed:
                self._failure = error
                self._changed.notify_all()

    def _next(self) -> _Entry | None:
        with self._changed:
            if self._deadline_s is not None and time.monotonic() > self._deadline_s:
                return None
            while not self._queue:
                if self._closed:
                    return None
                self._changed.wait()
            entry = self._queue.popleft()
            self._queue_bytes -= payload_bytes(entry.packet)
            self._changed.notify_all()
            return entry

    def _open(self, entry: _Entry) -> RecordingWriter:
        model, config = self._models[entry.vehicle], entry.config
        stamps = np.linspace(0, model.duration_ns, 1001).astype(np.int64)
        header = RecordingHeader(
            config_yaml=to_yaml(config),
            seed=config.seed,
            version=__version__,
            scene=model.scene.name,
            sensors=describe_sensors(config.sensors),
            path_stamp_ns=stamps,
            path_position=model.path.evaluate(stamps).position,
        )
        return RecordingWriter(self._folders[entry.vehicle] / entry.name, header)

    def _file_name(self) -> str:
        return "flight.h5" if self._file_count <= 1 else f"flight-{self._file_count}.h5"

    def _write_changes(self, vehicle: str) -> None:
        text = "".join(json.dumps(change) + "\n" for change in self._changes[vehicle])
        (self._folders[vehicle] / SETTINGS).write_text(text, "utf-8")


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings by dotted key."""
    return dict(_items(values, prefix))


def _items(values: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _items(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value
