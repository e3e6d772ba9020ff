"""Recording a live run: the packets of each vehicle go to the sinks of its settings, a file for each run."""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from neurosim_core.config import SimulationConfig, to_yaml
from neurosim_core.flight import header_of, new_folder
from neurosim_core.install import install_hint
from neurosim_core.packets import Packet
from neurosim_core.sim import Model
from neurosim_core.sinks import SinkConfig, Sinks

_logger = logging.getLogger(__name__)

SETTINGS = "settings.jsonl"
"""File in the folder of a recording that says which settings changed when; see `Recorder.change`."""


def open_folders(folder: Path, vehicles: list[str], *, overwrite: bool) -> dict[str, Path]:
    """Return the folder of each vehicle: that of the run, or one inside it for each of several vehicles."""
    folders = {name: folder if len(vehicles) == 1 else folder / name for name in vehicles}
    for path in (folder, *folders.values()):
        new_folder(path, overwrite=overwrite)
    return folders


class Recorder:
    """Writes what the vehicles measure to flight.h5, and after a reset to flight-2.h5, ...

    Further sinks of the settings get the same packets. `write` waits for a slow disk, so that nothing is
    lost.
    """

    def __init__(self, folders: Mapping[str, Path], models: Mapping[str, Model]) -> None:
        """Make the folders, and write config.yaml to each."""
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
        self._models = models
        self._folders = folders
        self._file_count = 0
        self._configs = {name: model.config for name, model in models.items()}
        self._first_configs = dict(self._configs)
        """The settings that held when the files of this run began."""
        self._changes: dict[str, list[dict[str, Any]]] = {name: [] for name in folders}
        self._sinks: dict[str, Sinks] = {}
        """Those that are open, by vehicle."""

    @property
    def _stem(self) -> str:
        return "flight" if self._file_count <= 1 else f"flight-{self._file_count}"

    @property
    def _file(self) -> str:
        return f"{self._stem}.h5"

    def begin(self, seeds: Mapping[str, int], *, replace: bool) -> None:
        """Complete the files, and begin a new one for each vehicle with its next packet.

        `replace`: replace the last file: its run had not begun.
        """
        self.close()
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
        """Hand a packet to the sinks of its vehicle."""
        if vehicle not in self._sinks:
            model = self._models[vehicle]
            self._sinks[vehicle] = Sinks(
                _live_sinks(model),
                say=_logger.warning,
                folder=self._folders[vehicle],
                stem=self._stem,
                model=model,
                header=header_of(model, self._first_configs[vehicle]),
            )
        try:
            self._sinks[vehicle].write(packet)
        except Exception:  # of an outside sink, too
            for sinks in self._sinks.values():
                sinks.abandon()
            self._sinks.clear()
            raise

    def close(self) -> None:
        """Write what waits, and complete the files."""
        with contextlib.ExitStack() as stack:  # each of them, whatever another one raises
            stack.callback(self._sinks.clear)
            for sinks in self._sinks.values():
                stack.callback(sinks.close)

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
