"""Recording a live run: a thread writes, and a bounded queue connects it to the thread that flies."""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from neurosim_core.config import SimulationConfig, to_yaml
from neurosim_core.flight import header_of, new_folder
from neurosim_core.install import install_hint
from neurosim_core.live.links import payload_bytes
from neurosim_core.packets import Packet
from neurosim_core.sim import Model
from neurosim_core.sinks import SinkConfig, Sinks

_logger = logging.getLogger(__name__)

QUEUE_BYTES = 16_000_000
"""Most that waits to be written [bytes]: gzip writes it in 0.2 s."""
STOPPED_S = 1.0
"""How long the writing may go on when the run was stopped [s]."""
ENDED_S = 30.0
"""How long it may go on when the run came to its own end [s]."""
CLOSE_FILES_S = 0.3
"""How long the closing of the files may take after that [s]."""
SETTINGS = "settings.jsonl"
"""File in the folder of a recording that says which settings changed when; see `Recorder.change`."""


def open_folders(folder: Path, vehicles: list[str], *, overwrite: bool) -> dict[str, Path]:
    """Return the folder of each vehicle: that of the run, or one inside it for each of several vehicles."""
    folders = {name: folder if len(vehicles) == 1 else folder / name for name in vehicles}
    for path in (folder, *folders.values()):
        new_folder(path, overwrite=overwrite)
    return folders


class _Entry(NamedTuple):
    """A packet that waits to be written."""

    run: int
    stem: str
    config: SimulationConfig
    """The settings that held when the file began."""
    vehicle: str
    packet: Packet


class Recorder:
    """Writes what the vehicles measure to flight.h5, and after a reset to flight-2.h5, ...

    Further sinks of the settings get the same packets. `write` waits for a slow disk, so that nothing is
    lost. When the run is stopped, packets that are not written by a deadline are counted.

    Attributes:
        stop: Set when the run is to end soon.
    """

    def __init__(self, folders: Mapping[str, Path], models: Mapping[str, Model]) -> None:
        """Make the folders, write config.yaml to each, and start the thread."""
        if not any(_live_sinks(model) for model in models.values()):
            raise ValueError("none of `sinks` records a live run: add one, such as {recording: {kind: hdf5}}")
        for model in models.values():
            for sink_name, sink in _live_sinks(model).items():
                if sink.library is not None and not sink.is_installed():
                    raise ImportError(f"{sink.library[0]} is not installed: {install_hint(sink.library[1])}")
                sink.check(sink_name, model.config.sensors)
        for name, folder in folders.items():
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "config.yaml").write_text(to_yaml(models[name].config, comments=True), "utf-8")
            for old in (*folder.glob("flight-*.h5"), folder / SETTINGS):  # of a recording that is replaced
                old.unlink(missing_ok=True)
        self.stop = threading.Event()
        self._models = models
        self._folders = folders
        self._run_count = self._file_count = 0
        self._configs = {name: model.config for name, model in models.items()}
        self._first_configs = dict(self._configs)
        """The settings that held when the files of this run began."""
        self._changes: dict[str, list[dict[str, Any]]] = {name: [] for name in folders}
        self._deadline_s: float | None = None
        self._queue: deque[_Entry] = deque()
        self._queue_bytes = 0
        self._changed = threading.Condition()
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    @property
    def _stem(self) -> str:
        return "flight" if self._file_count <= 1 else f"flight-{self._file_count}"

    @property
    def _file(self) -> str:
        return f"{self._stem}.h5"

    def begin(self, seeds: Mapping[str, int], *, replace: bool) -> None:
        """Begin a new file for each vehicle with its next packet.

        `replace`: replace the last file: its run had not begun.
        """
        self._run_count += 1
        self._file_count += not (replace and self._file_count)
        for name, config in self._configs.items():
            self._first_configs[name] = config.model_copy(update={"seed": seeds[name]})
            kept = [change for change in self._changes[name] if change["file"] != self._file]
            if kept != self._changes[name]:
                self._changes[name] = kept
                self._write_changes(name)

    def change(self, config: SimulationConfig, *, stamp_ns: int) -> None:
        """Note that settings have changed: in settings.jsonl, and in files that begin later.

        Each line of the file is a JSON object: `file`, `stamp_ns` from which on it holds, `key`, `value` and
        `before`. `stamp_ns`: simulated time [ns].
        """
        for vehicle, before in self._configs.items():
            now = self._configs[vehicle] = config.of(vehicle)
            old, new = (dict(_items(c.model_dump(mode="json"))) for c in (before, now))
            for key in sorted(old.keys() | new.keys()):
                if old.get(key) != new.get(key):
                    values = {"key": key, "value": new.get(key), "before": old.get(key)}
                    self._changes[vehicle].append({"file": self._file, "stamp_ns": stamp_ns, **values})
            self._write_changes(vehicle)

    def write(self, vehicle: str, packet: Packet) -> None:
        """Queue a packet; wait while too much is queued, unless the run is to end."""
        with self._changed:
            while self._queue_bytes > QUEUE_BYTES and self._failure is None and not self.stop.is_set():
                self._changed.wait(0.05)
            self._check()
            first = self._first_configs[vehicle]
            self._queue.append(_Entry(self._run_count, self._stem, first, vehicle, packet))
            self._queue_bytes += payload_bytes(packet)
            self._changed.notify_all()

    def close(self) -> None:
        """Write what is queued, close the files and end the thread; give up at a deadline. Once."""
        limit_s = STOPPED_S if self.stop.is_set() else ENDED_S
        with self._changed:
            if self._deadline_s is not None:
                return
            self._deadline_s = time.monotonic() + limit_s
            self._changed.notify_all()
        self._thread.join(limit_s + CLOSE_FILES_S)
        self._check()
        hangs = self._thread.is_alive()
        count = len(self._queue) + hangs  # and the one that is being written
        if count:
            still = "; it hangs, and the files are not closed" if hangs else ""
            raise TimeoutError(
                f"the disk is too slow: {count:,} packets at the end of the run were not written in "
                f"{limit_s:g} s{still}"
            )

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        try:
            with contextlib.ExitStack() as files:
                writers: dict[str, tuple[int, Sinks]] = {}
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
        except Exception as error:  # raised again in the thread that flies
            with self._changed:
                self._failure = error
                self._changed.notify_all()

    def _next(self) -> _Entry | None:
        """Wait for the next packet; None to end."""
        with self._changed:
            while not self._queue and self._deadline_s is None:
                self._changed.wait()
            if not self._queue or (self._deadline_s is not None and time.monotonic() > self._deadline_s):
                return None
            entry = self._queue.popleft()
            self._queue_bytes -= payload_bytes(entry.packet)
            self._changed.notify_all()
            return entry

    def _open(self, entry: _Entry) -> Sinks:
        model = self._models[entry.vehicle]
        return Sinks(
            _live_sinks(model),
            say=_logger.warning,
            folder=self._folders[entry.vehicle],
            stem=entry.stem,
            model=model,
            header=header_of(model, entry.config),
        )

    def _write_changes(self, vehicle: str) -> None:
        text = "".join(json.dumps(change) + "\n" for change in self._changes[vehicle])
        (self._folders[vehicle] / SETTINGS).write_text(text, "utf-8")


def _live_sinks(model: Model) -> dict[str, SinkConfig]:
    return {name: sink for name, sink in model.config.sinks.items() if sink.is_live}


def _items(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield nested settings by dotted key."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _items(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value
