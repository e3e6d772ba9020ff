"""WebDataset: windows as files in tar archives, which are read one after the other, or by number.

A window is `KEY.json` (its times and losses), `KEY.events.npz` (t [us], x, y, polarity) and `KEY.FIELD.npy`
for each other field. The library webdataset reads such shards, and so does `Dataset`, without it.
"""

from __future__ import annotations

import io
import json
import shutil
import tarfile
from collections.abc import Iterable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np

from neurosim_core.data.batch import FIELDS, Sample
from neurosim_core.data.windows import WindowConfig
from neurosim_core.packets import EventArrays

_FACTS = ("stamp_ns", "start_ns", "source", "width", "height", "dropped_count", "lost_count")


def write_shards(samples: Iterable[Sample], folder: Path, *, windows: int = 1000) -> list[Path]:
    """Write windows into shards in a new folder; the same windows give the same bytes.

    Args:
        samples: Such as a `Dataset`, or `RunSource(...).samples(...)`; taken one by one.
        folder: It appears once all shards are complete.
        windows: Of a shard, the last of which may have fewer.

    Returns:
        The shards, `windows-000000.tar` and so on.

    Raises:
        FileExistsError: The folder is there already.
        ValueError: `windows` is less than 1.
    """
    if windows < 1:
        raise ValueError(f"windows must be at least 1, got {windows}")
    if folder.exists():
        raise FileExistsError(f"{folder} is there already: name another folder for shards")
    draft = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(draft, ignore_errors=True)  # of a process that was killed
    draft.mkdir(parents=True)
    names: list[str] = []
    numbered = enumerate(samples)
    while part := list(islice(numbered, 1)):
        names.append(f"windows-{len(names):06d}.tar")
        with tarfile.open(draft / names[-1], "w", format=tarfile.USTAR_FORMAT) as tar:
            for number, sample in chain(part, islice(numbered, windows - 1)):
                for name, data in _files(sample):
                    entry = tarfile.TarInfo(f"{number:08d}.{name}")  # its time is 0
                    entry.size = len(data)
                    tar.addfile(entry, io.BytesIO(data))
    draft.replace(folder)
    return [folder / name for name in names]


def _files(sample: Sample) -> Iterator[tuple[str, bytes]]:
    yield "json", json.dumps({name: getattr(sample, name) for name in _FACTS}).encode()
    for field in FIELDS:
        value, data = getattr(sample, field), io.BytesIO()
        if isinstance(value, EventArrays):
            np.savez(data, **value._asdict())
            yield "events.npz", data.getvalue()
        elif value is not None:
            np.save(data, value)
            yield f"{field}.npy", data.getvalue()


class ShardFlight:
    """The windows of one shard. It may be sent to other processes, and used after a fork.

    `path`: a shard, with all windows of one length. `config`: which windows; stride and choice of sensors are
    those with which it was written.

    Attributes:
        skipped_count: 0: what has no ground truth is not in it.
        span_ns: 0: it is not known.
    """

    skipped_count = 0
    span_ns = 0

    def __init__(self, path: Path, config: WindowConfig) -> None:
        self.path, self._config = path, config
        windows: dict[str, dict[str, tuple[int, int]]] = {}
        try:
            with tarfile.open(path) as tar:
                for entry in tar:
                    key, _, name = entry.name.partition(".")
                    windows.setdefault(key, {})[name] = entry.offset_data, entry.size
        except tarfile.TarError as error:
            raise ValueError(f"{path} is not a readable shard: {error}") from None
        self._windows = list(windows.values())
        for number, files in enumerate(self._windows):
            lacks = {"json", *map(_name_of, config.fields or ())} - set(files)
            if lacks:
                raise ValueError(f"{path}: window {number} has no {sorted(lacks)[0]}, but {sorted(files)}")
        if self._windows:
            first = self._facts(0)
            span_ns = first["stamp_ns"] - first["start_ns"]
            if span_ns != config.window_ns:
                raise ValueError(f"{path} has windows of {1e-9 * span_ns:g} s, not {config.window_s:g} s")

    def __len__(self) -> int:
        return len(self._windows)

    def close(self) -> None:
        """Nothing is open between two reads."""

    def read(self, first: int, count: int) -> list[Sample]:
        """Return consecutive windows."""
        return [self._sample(number) for number in range(first, first + count)]

    def _sample(self, number: int) -> Sample:
        files = self._windows[number]
        values: dict[str, Any] = dict.fromkeys(FIELDS)
        for field in FIELDS:
            if self._config.takes(field) and _name_of(field) in files:
                values[field] = self._load(number, field)
        return Sample(**self._facts(number), **values)

    def _load(self, number: int, field: str) -> Any:
        name = _name_of(field)
        try:
            found = np.load(io.BytesIO(self._read(number, name)), allow_pickle=False)
            return EventArrays(*(found[each] for each in EventArrays._fields)) if field == "events" else found
        except Exception as error:  # what NumPy raises for damage is not listed anywhere
            raise ValueError(f"{self.path}: {name} of window {number} is damaged: {error}") from None

    def _facts(self, number: int) -> dict[str, Any]:
        try:
            found = json.loads(self._read(number, "json"))
            return {name: found[name] for name in _FACTS}
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{self.path}: window {number} is damaged: {error}") from None

    def _read(self, number: int, name: str) -> bytes:
        offset, size = self._windows[number][name]
        with open(self.path, "rb") as file:
            file.seek(offset)
            return file.read(size)


def _name_of(field: str) -> str:
    return "events.npz" if field == "events" else f"{field}.npy"
