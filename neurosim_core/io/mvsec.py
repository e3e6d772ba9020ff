"""Files of MVSEC (HDF5): events, pictures, IMU, depth, flow and poses of the left camera, in one file.

Times are seconds in float64, which tell microseconds apart for 270 years. Names and layouts are those of
MVSEC's `_data` and `_gt` files: depth that is not known is nan there and inf here; pictures are grey. With a
file NAME_data.hdf5 comes what is in NAME_gt.hdf5 beside it.

Reference: Zhu et al. (2018), "The Multivehicle Stereo Event Camera Dataset"; the layout: https://daniilidis-group.github.io/mvsec.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from neurosim_core.io.event_file import BLOCK_EVENTS, EventFileError, EventSource, NoEventsError, events_of
from neurosim_core.io.hdf5_events import damage_of, open_hdf5
from neurosim_core.packets import EventArrays, Image, ImuSample, Odometry, Packet
from neurosim_core.record.disk import Disk
from neurosim_core.record.hdf5 import import_h5py

_GROUP = "davis/left"
_ROWS = {"depth": "depth_image_raw", "pose": "pose", "image": "image_raw", "imu": "imu", "flow": "flow_dist"}
"""Name of each sensor and of its array; `ARRAY_ts` has its times."""


class MvsecSource(EventSource):
    """Reads a file of MVSEC."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._files = [open_hdf5(path)]

    def begin(self) -> None:
        """Find the arrays, also those of the file of ground truth beside one of data."""
        path = self._path
        truth = path.with_name(f"{path.stem.removesuffix('_data')}_gt{path.suffix}")
        if path.stem.endswith("_data") and truth.exists():
            self._files.append(open_hdf5(truth))
        with damage_of(path):
            groups = [file[_GROUP] for file in self._files if _GROUP in file]
            if _GROUP not in self._files[0]:
                raise EventFileError(f"{path} has no {_GROUP}: it is not a file of MVSEC")
            if "events" not in groups[0]:
                raise NoEventsError(f"{path} has no events: ground truth is read with NAME_data.hdf5")
            self._arrays = {name: array for group in groups[::-1] for name, array in group.items()}
            shapes = [self._arrays[_ROWS[n]].shape for n in ("image", "depth") if _ROWS[n] in self._arrays]
            self.size = (int(shapes[0][2]), int(shapes[0][1])) if shapes else None

    def packets(self) -> Iterator[Packet]:
        """Yield what is there besides events, in the order of time.

        Raises:
            EventFileError: The file is damaged.
        """
        streams = [self._rows(name) for name, array in _ROWS.items() if array in self._arrays]
        yield from heapq.merge(*streams, key=lambda packet: packet.stamp_ns)

    def close(self) -> None:
        """Close the file."""
        for file in self._files:
            file.close()

    def read(self) -> Iterator[EventArrays]:
        """See `EventSource.read`."""
        events = self._arrays["events"]
        for begin in range(0, len(events), BLOCK_EVENTS):
            with damage_of(self._path):
                x, y, t_s, polarity = np.asarray(events[begin : begin + BLOCK_EVENTS], np.float64).T
                block = events_of(np.rint(t_s * 1e6), x, y, polarity > 0)
            yield block

    def _rows(self, name: str) -> Iterator[Packet]:
        array = self._arrays[_ROWS[name]]
        with damage_of(self._path):
            stamps = np.rint(np.asarray(self._arrays[f"{_ROWS[name]}_ts"]) * 1e9).astype(np.int64).tolist()
        for row, stamp_ns in enumerate(stamps):
            with damage_of(self._path):
                values = np.asarray(array[row])
            head: dict[str, Any] = {"stamp_ns": stamp_ns, "sequence": row, "sensor": name}
            if name == "imu":
                yield ImuSample(specific_force=values[:3], angular_rate=values[3:], **head)
            elif name == "pose":
                yield Odometry(
                    position=values[:3, 3].copy(),
                    orientation=Rotation.from_matrix(values[:3, :3]).as_quat(),
                    velocity=np.full(3, np.nan),
                    body_rate=np.full(3, np.nan),
                    rotor_speed=np.zeros(0),
                    **head,
                )
            elif name == "depth":
                yield Image(
                    data=np.where(np.isnan(values), np.float32(np.inf), values), encoding="32FC1", **head
                )
            elif name == "flow":
                flow = np.ascontiguousarray(np.moveaxis(values, 0, -1), np.float32)
                yield Image(data=flow, encoding="32FC2", **head)
            else:
                yield Image(data=values, encoding="mono8", **head)


class MvsecSink:
    """Writes a file of MVSEC: of each kind of packets those of the first sensor that sends them."""

    def __init__(self, path: Path, *, width: int, height: int) -> None:
        self._disk = Disk(path)  # on a full disk HDF5's own file would end the process
        self._file: Any = import_h5py().File(self._disk, "w")
        self._group = self._file.create_group(_GROUP)
        self._sensors: dict[str, str] = {}
        self._append("events", np.zeros((0, 4)))

    def write(self, events: EventArrays) -> None:
        """See `EventSink.write`."""
        block = events
        rows = np.empty((len(block.t), 4))
        rows[:, 0], rows[:, 1], rows[:, 2] = block.x, block.y, block.t * 1e-6
        rows[:, 3] = block.polarity.astype(np.float64) * 2.0 - 1.0
        self._append("events", rows)

    def write_packet(self, packet: Packet) -> None:
        """Append a packet, or leave out what MVSEC has no place for."""
        name, row = _row(packet)
        if row is None or self._sensors.setdefault(name, packet.sensor) != packet.sensor:
            return
        self._append(_ROWS[name], row[None])
        self._append(f"{_ROWS[name]}_ts", np.array([packet.stamp_ns * 1e-9]))

    def close(self) -> None:
        """Complete the file."""
        if "image_raw_ts" in self._group:
            self._append("image_raw_event_inds", self._last_events(self._group["image_raw_ts"][:]))
        self._file.close()
        try:
            self._disk.seal()
        finally:
            self._disk.close()

    def _last_events(self, times_s: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the number of the last event before each of some times; -1 if there is none."""
        found = np.full(len(times_s), -1)
        events = self._group["events"]
        for begin in range(0, len(events), BLOCK_EVENTS):
            found += np.searchsorted(events[begin : begin + BLOCK_EVENTS, 2], times_s)
        return found

    def _append(self, name: str, rows: NDArray[Any]) -> None:
        if name not in self._group:
            chunk = max(1, min(65536, 1_000_000 // max(rows[:1].nbytes, 8)))
            self._group.create_dataset(
                name,
                shape=(0, *rows.shape[1:]),
                maxshape=(None, *rows.shape[1:]),
                dtype=rows.dtype,
                chunks=(chunk if rows.ndim <= 2 else 1, *rows.shape[1:]),
                compression="gzip",
                compression_opts=1,
            )
        array = self._group[name]
        array.resize(len(array) + len(rows), axis=0)
        if len(rows):
            array[-len(rows) :] = rows
        self._disk.seal()


def _row(packet: Packet) -> tuple[str, NDArray[Any] | None]:
    """Return the name of the array that a packet goes to, and its row; None if there is none."""
    if isinstance(packet, ImuSample):
        return "imu", np.concatenate([packet.specific_force, packet.angular_rate])
    if isinstance(packet, Odometry):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(packet.orientation).as_matrix()
        pose[:3, 3] = packet.position
        return "pose", pose
    encoding, data = getattr(packet, "encoding", ""), np.asarray(getattr(packet, "data", None))
    if encoding == "32FC1":
        return "depth", np.where(np.isinf(data), np.float32(np.nan), data)
    if encoding == "32FC2":
        return "flow", np.moveaxis(data, -1, 0).astype(np.float64)
    if encoding == "mono8":
        return "image", data
    if encoding == "rgb8":
        return "image", np.rint(data @ np.array([0.299, 0.587, 0.114])).astype(np.uint8)
    return "", None
