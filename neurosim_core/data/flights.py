"""Recorded flights: any window at any time, read from HDF5 a few windows at once."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.data.batch import FIELDS, Sample
from neurosim_core.data.windows import AT_STAMP, WindowConfig, choose_sensors, field_of, no_ground_truth
from neurosim_core.packets import EventArrays, PacketSchema
from neurosim_core.record.hdf5 import FORMAT, import_h5py
from neurosim_core.record.recording import read_milliseconds

_BATCH_WINDOWS_MAX = 64


class RecordedFlight:
    """The windows of one recording. It may be sent to other processes, and used after a fork.

    `path`: file that `RecordingWriter` wrote. `name`: for its samples; None: the path.

    Attributes:
        span_ns: From the first to the last event packet.
        skipped_count: Windows that were left out, as their ground truth is missing.
    """

    def __init__(self, path: Path, config: WindowConfig, *, name: str | None = None) -> None:
        self.path, self._config = path, config
        self.name = str(path) if name is None else name
        self._file: Any = None
        self._pid = 0
        groups = self._groups()
        found = {sensor: _field(group) for sensor, group in groups.items()}
        chosen = choose_sensors(found, config, source=self.name)
        self._events_sensor = chosen["events"]
        self._sensors = {field: sensor for field, sensor in chosen.items() if config.takes(field)}
        self._columns = {field: self._read_columns(groups[sensor]) for field, sensor in self._sensors.items()}
        camera = groups[self._events_sensor]
        self._camera = self._read_columns(camera)
        self.width, self.height = int(camera.attrs["width"]), int(camera.attrs["height"])
        begin_ns = int(camera["start_ns"][0]) if len(camera["start_ns"]) else 0
        self.span_ns = int(self._camera["stamp_ns"][-1]) - begin_ns if len(self._camera["stamp_ns"]) else 0
        self.ends_ns, self.skipped_count = self._find_windows(begin_ns)
        self.close()

    def __len__(self) -> int:
        return len(self.ends_ns)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_file": None, "_group_of": {}}

    def close(self) -> None:
        """Close the file; it is opened again when it is needed."""
        if self._file is not None and self._pid == os.getpid():
            self._file.close()
        self._file = None

    def read(self, first: int, count: int) -> list[Sample]:
        """Return consecutive windows."""
        samples: list[Sample] = []
        for begin in range(first, first + count, _BATCH_WINDOWS_MAX):
            samples += self._read(begin, min(_BATCH_WINDOWS_MAX, first + count - begin))
        return samples

    def _read(self, first: int, count: int) -> list[Sample]:
        groups = self._groups()
        ends_ns = self.ends_ns[first : first + count]
        starts_ns = ends_ns - self._config.window_ns
        values = {
            field: self._read_rows(field, groups[sensor], starts_ns, ends_ns)
            for field, sensor in self._sensors.items()
        }
        dropped, lost = self._count_losses(starts_ns, ends_ns)
        return [
            Sample(
                stamp_ns=int(ends_ns[row]),
                start_ns=int(starts_ns[row]),
                source=self.name,
                width=self.width,
                height=self.height,
                dropped_count=int(dropped[row]),
                lost_count=int(lost[row]),
                **{field: values[field][row] if field in values else None for field in FIELDS},
            )
            for row in range(count)
        ]

    def _read_rows(
        self, field: str, group: Any, starts_ns: NDArray[np.int64], ends_ns: NDArray[np.int64]
    ) -> list[Any]:
        if field == "events":
            return self._read_events(group, starts_ns // 1000, ends_ns // 1000)
        columns = self._columns[field]
        begin, end = (np.searchsorted(columns["stamp_ns"], ns, side="right") for ns in (starts_ns, ends_ns))
        if field == "imu":
            rows = columns["rows"]
            return [rows[a:b] for a, b in zip(begin.tolist(), end.tolist(), strict=True)]
        at = np.searchsorted(columns["stamp_ns"], ends_ns).tolist()
        if field == "pose":
            return [columns["rows"][row] for row in at]
        return [group["data"][row] for row in at]

    def _read_events(
        self, group: Any, starts_us: NDArray[np.int64], ends_us: NDArray[np.int64]
    ) -> list[EventArrays]:
        span_us, total = (int(starts_us.min()), int(ends_us.max())), int(self._camera["event_end"][-1])
        events = read_milliseconds(group, *span_us, event_count=total)
        begin, end = (np.searchsorted(events.t, us, side="right") for us in (starts_us, ends_us))
        return [events.rows(slice(a, b)) for a, b in zip(begin.tolist(), end.tolist(), strict=True)]

    def _read_columns(self, group: Any) -> dict[str, NDArray[Any]]:
        """Return what is small and needed of a sensor: stamps, and all rows that are not large."""
        count = int(group["packet_count"][()])
        columns = {"stamp_ns": group["stamp_ns"][:count]}
        schema = PacketSchema.from_json(group.attrs["schema"])
        if schema.has_events:
            columns |= {name: group[name][:count] for name in ("dropped_count", "sequence", "event_end")}
        elif schema.name == "ImuSample":
            force, rate = (group[name][:count] for name in ("specific_force", "angular_rate"))
            columns["rows"] = np.concatenate([columns["stamp_ns"][:, None] * 1e-9, force, rate], axis=1)
        elif schema.name == "Odometry":
            columns["rows"] = np.concatenate([group[n][:count] for n in ("position", "orientation")], axis=1)
        return columns

    def _find_windows(self, begin_ns: int) -> tuple[NDArray[np.int64], int]:
        """Return the ends of all windows that have their ground truth, and how many have not."""
        stamps = self._camera["stamp_ns"]
        last_ns = int(stamps[-1]) if len(stamps) else -1
        if self._config.ends is None:
            ends_ns = np.arange(self._config.first_end_ns(begin_ns), last_ns + 1, self._config.stride_ns)
        else:
            ends_ns = self._columns[self._config.ends]["stamp_ns"]
            inside = (ends_ns >= begin_ns + self._config.window_ns) & (ends_ns <= last_ns)
            ends_ns = ends_ns[inside]
        whole = np.ones(len(ends_ns), bool)
        for field in AT_STAMP:
            if field in self._columns:
                has = np.isin(ends_ns, self._columns[field]["stamp_ns"])
                if len(has) and not has.any():
                    raise ValueError(no_ground_truth(self.name, field, self._config))
                whole &= has
        return ends_ns[whole].astype(np.int64), int(np.count_nonzero(~whole))

    def _count_losses(
        self, starts_ns: NDArray[np.int64], ends_ns: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return dropped events and missing packets of each window."""
        stamps, sequence = self._camera["stamp_ns"], self._camera["sequence"]
        gaps = np.maximum(np.diff(sequence, prepend=sequence[:1] - 1) - 1, 0)
        begin, end = (np.searchsorted(stamps, ns, side="right") for ns in (starts_ns, ends_ns))
        sums = [np.concatenate([[0], np.cumsum(counts)]) for counts in (self._camera["dropped_count"], gaps)]
        return sums[0][end] - sums[0][begin], sums[1][end] - sums[1][begin]

    def _groups(self) -> Mapping[str, Any]:
        if self._file is None or self._pid != os.getpid():  # an open file does not survive a fork
            h5py = import_h5py()
            if not self.path.is_file():
                raise FileNotFoundError(f"no file {self.path}")
            try:
                self._file = h5py.File(self.path, "r")
            except OSError as error:
                raise ValueError(f"{self.path} is not a readable HDF5 file: {error}") from None
            self._pid = os.getpid()
            if self._file.attrs.get("format") != FORMAT:
                raise ValueError(
                    f"{self.path} is no recording: `neurosim convert {self.path} flight.h5` makes one"
                )
            groups = {n: g for n, g in self._file["sensors"].items() if "packet_count" in g}
            order = sorted(groups, key=lambda name: int(groups[name].attrs.get("index", 1 << 30)))
            self._group_of = {name: groups[name] for name in order}
        return self._group_of


def _field(group: Any) -> str | None:
    return field_of(PacketSchema.from_json(group.attrs["schema"]), str(group.attrs.get("encoding", "")))
