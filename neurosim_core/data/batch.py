"""Samples for learning: windows of events with the ground truth at their ends, alone and in batches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.packets import EventArrays, join_events

FIELDS = ("events", "depth", "flow", "rgb", "imu", "pose")
"""Fields of a sample."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """One window of time (start_ns, stamp_ns]. Fields that are absent or not selected are None."""

    stamp_ns: int
    """End of the window [ns]."""
    start_ns: int
    """Start of the window, not part of it [ns]."""
    source: str
    """Name of the flight."""
    width: int
    """Width of the event camera [px]."""
    height: int
    """Height of the event camera [px]."""
    events: EventArrays | None = None
    """Events with start < t <= stamp, in whole microseconds."""
    depth: NDArray[np.float32] | None = None
    """Planar z at the stamp [m], or the ray length of a `range` camera; inf: no hit; shape [H, W]."""
    flow: NDArray[np.float32] | None = None
    """The flow picture of the stamp [px], shape [H, W, 2]."""
    rgb: NDArray[np.uint8] | None = None
    """The picture of the stamp, shape [H, W, 3] or [H, W]."""
    imu: NDArray[np.float64] | None = None
    """Samples of the window: stamp [s], specific force [m/s^2], angular rate [rad/s], shape [n, 7]."""
    pose: NDArray[np.float64] | None = None
    """p_WB [m] and q_WB (xyzw) at the stamp, shape [7]."""
    dropped_count: int = 0
    """Number of events of the window that the camera lost."""
    lost_count: int = 0
    """Number of missing packets of the event camera in the window."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EventBatch:
    """The events of several windows; window i is `raw[offsets[i]:offsets[i + 1]]`.

    In batches of a `Loader`, the arrays are tensors. Grids are still computed on the host, and returned as
    tensors on the device of the events.
    """

    raw: EventArrays
    """All events, window by window, shape [n]."""
    offsets: NDArray[np.int64]
    """Index of the first event of each window, and the number of events, shape [B + 1]."""
    start_us: NDArray[np.int64]
    """Start of each window [us], shape [B]."""
    stamp_us: NDArray[np.int64]
    """End of each window [us], shape [B]."""
    width: int
    """Width of the sensor [px]."""
    height: int
    """Height of the sensor [px]."""

    def __len__(self) -> int:
        return len(self.start_us)

    def of(self, window: int) -> EventArrays:
        """Return the events of one window."""
        return self.raw.rows(slice(int(self.offsets[window]), int(self.offsets[window + 1])))

    def voxel(self, bins: int = 5) -> NDArray[np.float32]:
        """Return polarity (-1, 1), shared between the two nearest of some moments, shape [B, bins, H, W].

        Moment b is at b / (bins - 1) of the window; with one bin all events are in it.

        Reference: Zhu et al. (2019), "Unsupervised Event-based Learning of Optical Flow, Depth, and
        Egomotion", eq. (1-2).

        Raises:
            ValueError: `bins` is less than 1.
        """
        if bins < 1:
            raise ValueError(f"bins must be at least 1, got {bins}")
        cells = self.width * self.height
        grids = np.empty((len(self), bins, self.height, self.width), np.float32)
        host = self._on_host()
        for window, grid in enumerate(grids):
            t, x, y, polarity = host.of(window)
            place = y.astype(np.intp) * self.width + x
            sign = polarity * 2.0 - 1.0
            if bins == 1:
                grid[0] = np.bincount(place, sign, cells).reshape(grid.shape[1:])
                continue
            start_us, span_us = int(host.start_us[window]), int(host.stamp_us[window] - host.start_us[window])
            moment = (t - start_us) * ((bins - 1) / span_us)
            begins = np.searchsorted(moment, np.arange(bins - 1))  # events are in the order of time
            rows = grid.reshape(bins, cells)
            late: Any = 0.0
            for low, (begin, end) in enumerate(pairwise([*begins, len(t)])):
                here, share = place[begin:end], (moment[begin:end] - low) * sign[begin:end]
                rows[low] = late + np.bincount(here, sign[begin:end] - share, cells)
                late = np.bincount(here, share, cells)
            rows[-1] = late
        return self._as_given(grids)

    def surface(self, tau_s: float | Sequence[float] = (0.01, 0.05)) -> NDArray[np.float32]:
        """Return exp(-(end - t) / tau) of the last event of each pixel, 0 where none is in the window.

        Reference: Lagorce et al. (2017), "HOTS", eq. (3).

        Args:
            tau_s: Time constants [s]; shape [B, 2 tau, H, W]: channels darker and brighter for each.

        Raises:
            ValueError: A time constant is not positive.
        """
        taus = np.atleast_1d(np.asarray(tau_s, np.float64))
        if not (taus > 0.0).all():
            raise ValueError(f"tau_s must be > 0, got {tau_s}")
        surfaces = np.empty((len(self), 2 * len(taus), self.height, self.width), np.float32)
        age_us = np.empty((2, self.height, self.width))
        host = self._on_host()
        for window, surface in enumerate(surfaces):
            t, x, y, polarity = host.of(window)
            age_us.fill(np.inf)
            age_us[polarity, y, x] = host.stamp_us[window] - t  # the last of equal pixels stays
            for index, tau in enumerate(taus):
                np.exp(age_us * (-1e-6 / tau), out=surface[2 * index : 2 * index + 2], casting="same_kind")
        return self._as_given(surfaces)

    def counts(self) -> NDArray[np.float32]:
        """Return the events of each pixel: channels darker and brighter, shape [B, 2, H, W]."""
        counts = np.empty((len(self), 2, self.height, self.width), np.float32)
        host = self._on_host()
        for window, count in enumerate(counts):
            _, x, y, polarity = host.of(window)
            place = (polarity.astype(np.intp) * self.height + y) * self.width + x
            count[:] = np.bincount(place, minlength=count.size).reshape(count.shape)
        return self._as_given(counts)

    def _on_host(self) -> EventBatch:
        """Return the same with NumPy arrays."""
        tensors: Any = self
        if isinstance(tensors.offsets, np.ndarray):
            return self
        return replace(
            self,
            raw=EventArrays(*(column.cpu().numpy() for column in tensors.raw)),
            offsets=tensors.offsets.cpu().numpy(),
            start_us=tensors.start_us.cpu().numpy(),
            stamp_us=tensors.stamp_us.cpu().numpy(),
        )

    def _as_given(self, grids: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return grids as what the events are: an array, or a tensor on their device."""
        tensors: Any = self
        if isinstance(tensors.offsets, np.ndarray):
            return grids
        import torch

        made: Any = torch.from_numpy(grids).to(tensors.offsets.device)
        given: NDArray[np.float32] = made
        return given


@dataclass(frozen=True, kw_only=True, eq=False)
class Batch:
    """A batch of B samples: the fields of `Sample` with a leading axis of windows."""

    stamp_ns: NDArray[np.int64]
    """Shape [B]."""
    start_ns: NDArray[np.int64]
    """Shape [B]."""
    source: tuple[str, ...]
    """Name of the flight of each window."""
    events: EventBatch | None
    """Events of all windows."""
    depth: NDArray[np.float32] | None
    """Shape [B, H, W]."""
    flow: NDArray[np.float32] | None
    """Shape [B, H, W, 2]."""
    rgb: NDArray[np.uint8] | None
    """Shape [B, H, W, 3] or [B, H, W]."""
    imu: NDArray[np.float64] | None
    """Samples of all windows, concatenated, shape [n, 7]."""
    imu_offsets: NDArray[np.int64]
    """Index of the first sample of each window in `imu`, and the number of samples, shape [B + 1]."""
    pose: NDArray[np.float64] | None
    """Shape [B, 7]."""
    dropped_count: NDArray[np.int64]
    """Shape [B]."""
    lost_count: NDArray[np.int64]
    """Shape [B]."""

    def __len__(self) -> int:
        return len(self.stamp_ns)


def collate(samples: Sequence[Sample]) -> Batch:
    """Return samples as a batch.

    Raises:
        ValueError: There are no samples, or their sizes or fields differ.
    """
    if not samples:
        raise ValueError("a batch needs at least one sample")
    first = samples[0]
    for name in ("width", "height"):
        if len({getattr(sample, name) for sample in samples}) > 1:
            raise ValueError(f"samples of one batch must have the same {name}")
    present = {name: [getattr(sample, name) is not None for sample in samples] for name in FIELDS}
    for name, has in present.items():
        if any(has) != all(has):
            missing = next(sample.source for sample, h in zip(samples, has, strict=True) if not h)
            raise ValueError(
                f"{missing} has no {name}, but other samples have: select common fields by fields="
            )
    stamp_ns = np.array([sample.stamp_ns for sample in samples], np.int64)
    start_ns = np.array([sample.start_ns for sample in samples], np.int64)
    events = None
    if first.events is not None:
        parts = [sample.events for sample in samples if sample.events is not None]
        events = EventBatch(
            raw=join_events(parts),
            offsets=_offsets([len(part.t) for part in parts]),
            start_us=start_ns // 1000,
            stamp_us=stamp_ns // 1000,
            width=first.width,
            height=first.height,
        )
    stacked = {
        name: _stack([getattr(sample, name) for sample in samples])
        for name in ("depth", "flow", "rgb", "pose")
    }
    inertial = [sample.imu for sample in samples if sample.imu is not None]
    return Batch(
        stamp_ns=stamp_ns,
        start_ns=start_ns,
        source=tuple(sample.source for sample in samples),
        events=events,
        imu=np.concatenate(inertial) if inertial else None,
        imu_offsets=_offsets([len(rows) for rows in inertial]),
        dropped_count=np.array([sample.dropped_count for sample in samples], np.int64),
        lost_count=np.array([sample.lost_count for sample in samples], np.int64),
        **stacked,
    )


def _stack(values: Sequence[Any]) -> Any:
    if values[0] is None:
        return None
    shapes = {value.shape for value in values}
    if len(shapes) > 1:
        raise ValueError(f"pictures of one batch must have the same size, got {sorted(shapes)}")
    return np.stack(values)


def _offsets(counts: Sequence[int]) -> NDArray[np.int64]:
    return np.concatenate([[0], np.cumsum(counts, dtype=np.int64)]).astype(np.int64)
