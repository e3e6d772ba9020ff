"""Sequences of DSEC (a folder): events of the left camera, rectified, and their depth and flow.

Events come to the whole rectified pixel that is nearest; those which fall beyond the picture are left out
and counted. Depth is from `disparity/event`, by the matrix of `calibration/cam_to_cam.yaml`; flow is that of
`flow/backward`, which says where what a pixel shows was before, as a sensor `optical_flow` does. Neither is
known everywhere: depth is inf there, flow nan.

Reference: Gehrig et al. (2021), "DSEC: A Stereo Event Camera Dataset"; the layout: https://dsec.ifi.uzh.ch/data-format.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from neurosim_core.install import need
from neurosim_core.io.event_file import EventFileError, EventSource, events_of
from neurosim_core.io.hdf5_events import Hdf5Source, damage_of, open_hdf5
from neurosim_core.packets import EventArrays, Image, Packet

EVENTS = Path("events/left/events.h5")
"""A folder with this file is a sequence."""
_DISPARITY_STEPS = 256.0
"""Of a pixel of disparity."""
_FLOW_ZERO, _FLOW_STEPS = 2.0**15, 128.0


class DsecSource(EventSource):
    """Reads a sequence of DSEC."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._events = Hdf5Source(path / EVENTS)
        self.notes = self._events.notes

    def begin(self) -> None:
        """Find the events, and read where their pixels are in the rectified picture."""
        self._events.begin()
        file = self._path / EVENTS.with_name("rectify_map.h5")
        with open_hdf5(file) as maps, damage_of(file):
            found = np.asarray(maps["rectify_map"])
        if found.ndim != 3 or found.shape[2] != 2:
            raise EventFileError(f"{file}: rectify_map has shape {found.shape}, not [height, width, 2]")
        self._rectified = np.rint(found).astype(np.int64)
        self.size = (found.shape[1], found.shape[0])

    def close(self) -> None:
        """Close the file of events."""
        self._events.close()

    def read(self) -> Iterator[EventArrays]:
        """See `EventSource.read`."""
        assert self.size is not None
        width, height = self.size
        seen = left_out = 0
        for events in self._events.read():
            if (events.x >= width).any() or (events.y >= height).any():
                raise EventFileError(f"{self._path / EVENTS}: an event is outside {width} x {height} pixels")
            x, y = np.moveaxis(self._rectified[events.y, events.x], -1, 0)
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            seen += len(x)
            left_out += len(x) - int(inside.sum())
            yield events_of(events.t[inside], x[inside], y[inside], events.polarity[inside])
        if left_out:
            self.notes.append(f"{left_out:,} of {seen:,} events are beyond the rectified picture")

    def packets(self) -> Iterator[Packet]:
        """Yield depth and flow in the order of time.

        Raises:
            EventFileError: A picture or a list of times is damaged.
            ImportError: There are pictures, and PyAV is not installed.
        """
        yield from heapq.merge(self._depth(), self._flow(), key=lambda packet: packet.stamp_ns)

    def _depth(self) -> Iterator[Packet]:
        folder = self._path / "disparity"
        files = sorted((folder / "event").glob("*.png"))
        if not files:
            return
        calibration = self._path / "calibration" / "cam_to_cam.yaml"
        try:
            told = yaml.safe_load(calibration.read_text(encoding="utf-8"))
            matrix = np.array(told["disparity_to_depth"]["cams_03"], np.float64).reshape(4, 4)
        except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError) as error:
            raise EventFileError(
                f"{calibration} must tell disparity_to_depth: cams_03, 4 x 4: {error!r}"
            ) from None
        for number, (file, stamp_us) in enumerate(self._timed(files, folder / "timestamps.txt")):
            disparity_px = _pixels(file) / _DISPARITY_STEPS
            with np.errstate(divide="ignore"):
                depth_m = matrix[2, 3] / (matrix[3, 2] * disparity_px + matrix[3, 3])
            data = np.where(disparity_px > 0.0, depth_m, np.inf).astype(np.float32)
            yield Image(
                stamp_ns=1000 * stamp_us, sequence=number, sensor="depth", data=data, encoding="32FC1"
            )

    def _flow(self) -> Iterator[Packet]:
        folder = self._path / "flow"
        files = sorted((folder / "backward").glob("*.png"))
        if not files:
            if (folder / "forward").is_dir():
                self.notes.append("flow/forward is not read: windows end with what flow/backward tells")
            return
        for number, (file, stamp_us) in enumerate(self._timed(files, folder / "backward_timestamps.txt")):
            pixels = _pixels(file)
            flow = (pixels[..., :2] - _FLOW_ZERO) / _FLOW_STEPS
            data = np.where(pixels[..., 2:] > 0.0, flow, np.nan).astype(np.float32)
            yield Image(stamp_ns=1000 * stamp_us, sequence=number, sensor="flow", data=data, encoding="32FC2")

    def _timed(self, files: list[Path], times: Path) -> list[tuple[Path, int]]:
        """Return each picture with its time [us], the first number of a line."""
        try:
            lines = times.read_text(encoding="utf-8").splitlines()
            stamps = [int(line.split(",")[0]) for line in lines if line.strip() and not line.startswith("#")]
        except (OSError, ValueError) as error:
            raise EventFileError(
                f"{times} does not tell the times of {len(files)} pictures: {error}"
            ) from None
        if len(stamps) != len(files):
            raise EventFileError(f"{times} tells {len(stamps)} times of {len(files)} pictures")
        return [*zip(files, stamps, strict=True)]


def _pixels(file: Path) -> NDArray[np.float64]:
    """Return a picture of 16 bit."""
    av = need("pictures of 16 bit need PyAV", "video", "av")
    try:
        with av.open(str(file)) as container:
            picture: Any = next(container.decode(video=0))
            return np.asarray(picture.to_ndarray(), np.float64)
    except (av.error.FFmpegError, StopIteration, ValueError) as error:
        raise EventFileError(f"{file} is damaged: {error}") from None
