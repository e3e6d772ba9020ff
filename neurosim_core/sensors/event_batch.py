# mypy: disable-error-code="attr-defined,arg-type"
"""Event cameras that take one frame per call, for frames from other sources.

A call launches the scan of one frame of all cameras and waits for the number of events. Events stay on the
device, unsorted, and are decoded when they are read.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.clock import NS_PER_US
from neurosim_core.packets import EventArrays
from neurosim_core.runtime.cuda import HostCopy, HostInput, RecordedLaunch
from neurosim_core.sensors import event_kernels
from neurosim_core.sensors.event_config import EventCameraConfig
from neurosim_core.sensors.event_input import as_frames, invalid_message
from neurosim_core.sensors.event_kernels import COLUMN_OFFSETS, COLUMN_TYPES, EVENT_BYTES
from neurosim_core.sensors.event_scan import ALL
from neurosim_core.sensors.event_worlds import WorldEventCamera
from neurosim_core.warp_start import start_warp

_ROOM_MIN = 1024
_PIXELS_PER_EVENT = 2
"""The initial capacity of a call is one event for this many pixels."""
_LANES = 1 << 16
"""Number of threads that decode the events of all cameras on CUDA."""


class FrameEvents:
    """The events between two frames, on the device.

    Attributes:
        start_ns: Time of the previous frame [ns].
        stamp_ns: Time of the frame [ns].
        counts: Number of events of each camera.
        dropped_count: Number of lost events of all cameras, beyond `event_count_max`.
    """

    def __init__(
        self, batch: EventCameraBatch, start_ns: int, stamp_ns: int, counts: list[int], dropped_count: int
    ) -> None:
        self._batch = batch
        self._number = batch.frame_number
        self.start_ns, self.stamp_ns = start_ns, stamp_ns
        self.counts = counts
        self.dropped_count = dropped_count
        self._columns: Sequence[Any] | None = None

    def __len__(self) -> int:
        return sum(self.counts)

    @property
    def offsets(self) -> NDArray[np.int32]:
        """Index of the first event of each camera, and the number of events, shape [N + 1]."""
        return np.fromiter(itertools.accumulate(self.counts, initial=0), np.int32, len(self.counts) + 1)

    @property
    def columns(self) -> Sequence[Any]:
        """Time [us], column, row and polarity as Warp arrays of shape [event], ordered by camera.

        The order within a camera is not specified. `wp.to_torch` makes tensors of them without a copy.

        Raises:
            RuntimeError: If the first read comes after the next frame.
        """
        if self._columns is None:
            if self._number != self._batch.frame_number:
                raise RuntimeError(f"events of {self.stamp_ns} ns were not read before the next frame")
            self._columns = self._batch.decode(self)
        return self._columns

    def numpy(self, camera: int = 0) -> EventArrays:
        """Return the events of one camera on the host, sorted by (t, y, x, polarity)."""
        first, end = self.offsets[camera : camera + 2]
        t, x, y, polarity = (column.numpy()[first:end] for column in self.columns)
        order = np.lexsort((polarity, x, y, t))
        return EventArrays(t[order], x[order], y[order], polarity[order])


class EventCameraBatch:
    """N event cameras with a common clock. Each yields the events of an `EventCamera`.

    Frames on the device are read without a copy. Launches go to Warp's current stream, which waits for CUDA's
    default stream; wait for tensors that PyTorch computes on other streams.

    Args:
        config: Settings of the pixels, without a readout.
        count: Number of cameras N.
        width: Width of each camera [px].
        height: Height of each camera [px].
        device: Warp device.
        sensor: Name of the sensors; noise depends on it.
        seed: Seed of camera 0; camera i has seed + i.

    Raises:
        ValueError: If the configuration has a readout.
    """

    def __init__(
        self,
        config: EventCameraConfig,
        *,
        count: int,
        width: int,
        height: int,
        device: str = "cpu",
        sensor: str = "",
        seed: int = 0,
    ) -> None:
        if config.readout is not None:
            raise ValueError("readout is for EventCamera.feed only: the arbiter runs on the host")
        start_warp()
        self.device = wp.get_device(device)
        self._event_count_max = config.event_count_max
        self._shape = (count, height, width)
        self._seeds = [(seed + camera) % (1 << 64) for camera in range(count)]
        self._capacity = max(_ROOM_MIN, width * height // _PIXELS_PER_EVENT)
        self._frames: Any = wp.zeros(self._shape, dtype=wp.float32, device=self.device)
        self._cameras = WorldEventCamera(
            [config] * count,
            width=width,
            height=height,
            instant_count=1,
            device=self.device,
            capacity=self._capacity,
            sensor=sensor,
            seeds=self._seeds,
            ordered=False,
            decodes=False,
        )
        self.terms = self._cameras.terms
        self._all = wp.ones(count, dtype=wp.int32, device=self.device)
        self._counters = HostCopy(wp.zeros((count, 3), dtype=wp.int64, device=self.device))
        self._counters_out = self._counters.mapped()
        self._begin = RecordedLaunch(event_kernels.begin_frame, self.device)
        self._move_counters = RecordedLaunch(event_kernels.move_counters, self.device)
        self._decode = RecordedLaunch(event_kernels.decode, self.device)
        self._offsets = HostInput(wp.zeros(count + 1, dtype=wp.int32, device=self.device))
        self._cameras.look_at(self._frames)
        self._frames_seen = self._cameras.stack.__ctype__().log_radiance
        """Of the recorded launches' parameters: where they read frames."""
        self._scans = [self._cameras.record_scan(state) for state in (0, 1)] if self.device.is_cuda else []
        self._readable: Any = None
        """Shape, type and device of the last array that was read where it is."""
        self._timing = (-1, -1)
        self._stamp_ns: int | None = None
        self._epoch_us = 0
        self._origin_us = 0
        """Begin of the current frame as the device has it; it advances by itself, and changes are sent."""
        self.frame_number = 0
        """Of the last frame, so that nobody reads the events of another."""

    def reset(self, log_radiance: Any, stamp_ns: int = 0) -> None:
        """Reset all pixels: their reference is the given log radiance.

        Args:
            log_radiance: See `step`; it is copied.
            stamp_ns: Time of this frame [ns].

        Raises:
            ValueError: If shape or dtype is wrong, or a value is not finite or beyond +-1000.
        """
        wp.copy(self._frames, self._as_frames(log_radiance))
        self._frames_seen.data = self._frames.ptr
        self._stamp_ns = None
        self.frame_number += 1
        self._epoch_us = int(stamp_ns) // NS_PER_US
        if self.terms:
            self._cameras.seed(self._seeds, reset_ns=int(stamp_ns))
        self._cameras.begin(self._frames, int(stamp_ns), self._all)
        self._read_counters()
        self._stamp_ns = int(stamp_ns)

    def step(self, log_radiance: Any, stamp_ns: int) -> FrameEvents:
        """Return the events between the previous frame and this one; waits until they are counted.

        Args:
            log_radiance: Natural logarithm of radiance, float32, shape [N, H, W], or [H, W] of one camera;
                NumPy, Warp or any array of the device with `__cuda_array_interface__`. The caller may
                change it after the call.
            stamp_ns: Time of the frame [ns], after that of the previous frame.

        Raises:
            RuntimeError: If there was no reset.
            ValueError: If shape, dtype or stamp is wrong; also if a value is not finite or beyond +-1000, in
                which case there must be a reset.
        """
        start_ns = self._stamp_ns
        if start_ns is None:
            raise RuntimeError("call reset() with a first frame before step()")
        if not 0 < stamp_ns - start_ns < self.span_max_ns:
            raise ValueError(
                f"stamp_ns must be later than {start_ns}, that of the previous frame, by less than "
                f"{self.span_max_ns / 1e9:g} s, got {stamp_ns}"
            )
        address, held = self._locate(log_radiance)
        self._begin_frame(start_ns, stamp_ns)
        self._frames_seen.data = address
        if self._scans:
            self._scans[self._cameras.present].launch()
        else:
            self._cameras.take_frames(1, ALL, self._cameras.present)
        counts = self._read_counters()
        dropped_count = 0
        if max(counts) > self._capacity or max(counts) > self._event_count_max:
            counts, dropped_count = self._scan_again(start_ns, stamp_ns, max(counts))
        del held
        self._cameras.present = 1 - self._cameras.present
        self._stamp_ns = stamp_ns
        self.frame_number += 1
        return FrameEvents(self, start_ns, stamp_ns, counts, dropped_count)

    @property
    def span_max_ns(self) -> int:
        """Longest time between two frames [ns]."""
        return NS_PER_US << (62 - self._cameras.layout.time_shift)

    def decode(self, events: FrameEvents) -> Sequence[Any]:
        """Return time, column, row and polarity of the events of the last frame, in arrays of their own."""
        room = len(events)
        spaced = room + room % 2  # columns in a block begin where they may
        block: Any = wp.empty(EVENT_BYTES * max(spaced, 2), dtype=wp.uint8, device=self.device)
        columns: list[Any] = []
        for dtype, offset in zip(COLUMN_TYPES, COLUMN_OFFSETS, strict=True):
            column: Any = wp.array(
                ptr=block.ptr + offset * spaced, dtype=dtype, shape=(room,), device=self.device
            )
            column.block = block  # lives as long as they
            columns.append(column)
        if room == 0:
            return columns
        self._offsets.rows[:] = events.offsets
        self._offsets.upload()
        lanes = max(1, _LANES // self._shape[0]) if self.device.is_cuda else 1
        origin_us = events.start_ns // NS_PER_US - self._origin_us
        arguments = (
            self._cameras.layout,
            lanes,
            origin_us,
            self._cameras.stack,
            self._offsets.array,
            *columns,
        )
        self._decode.launch((self._shape[0], lanes), arguments)
        return columns

    def _begin_frame(self, start_ns: int, stamp_ns: int) -> None:
        """Have the stamps of a frame on the device: ideal pixels only see how far they are apart."""
        timing = (start_ns % NS_PER_US, stamp_ns - start_ns)
        if timing != self._timing or self.terms:
            epoch_ns = self._epoch_us * NS_PER_US
            arguments = [start_ns - epoch_ns, stamp_ns - epoch_ns, self._cameras.stack]
            self._begin.launch(self._shape[0], arguments)
            self._timing = timing
            self._origin_us = (start_ns - epoch_ns) // NS_PER_US

    def _read_counters(self) -> list[int]:
        """Wait for a scan and return how many events each camera has."""
        self._move_counters.launch(self._shape[0], [self._cameras.stack.counters, self._counters_out])
        wp.synchronize_stream(self.device)
        rows = self._counters.view(0, self._shape[0]).tolist()
        if any(row[1] for row in rows):
            camera = next(index for index, row in enumerate(rows) if row[1])
            self._stamp_ns = None
            height, width = self._shape[1:]
            row, column = divmod(height * width - rows[camera][2], width)
            total = sum(row[1] for row in rows)
            raise ValueError(invalid_message(total, f"[{camera}, {row}, {column}]"))
        return [row[0] for row in rows]

    def _scan_again(self, start_ns: int, stamp_ns: int, most: int) -> tuple[list[int], int]:
        """Scan a frame again with room for all events, or as many as may be; return how many there are."""
        room = min(most, self._event_count_max)
        if room > self._capacity:
            self._capacity = 1 << (room - 1).bit_length()
            self._cameras.grow(self._capacity)
        self._begin_frame(start_ns, stamp_ns)
        stack = self._cameras.stack
        stack.dropped.zero_()
        self._cameras.find_keys(1, self._cameras.present)
        counts = self._read_counters()
        dropped_count = int(stack.dropped.numpy().sum())
        stack.overflow.zero_()
        stack.row_limit.fill_(self._shape[1])
        return counts, dropped_count

    def _locate(self, log_radiance: Any) -> tuple[int, Any]:
        """Return where frames are on the device, and what keeps them there."""
        is_tensor, is_array = hasattr(log_radiance, "data_ptr"), isinstance(log_radiance, wp.array)
        if not (is_tensor or is_array):
            frames = self._as_frames(log_radiance)
            return frames.ptr, frames
        kind = (log_radiance.shape, log_radiance.dtype, log_radiance.device)
        address = log_radiance.data_ptr() if is_tensor else log_radiance.ptr
        is_contiguous = log_radiance.is_contiguous() if is_tensor else log_radiance.is_contiguous
        if is_contiguous and kind == self._readable:
            return address, log_radiance
        frames = self._as_frames(log_radiance)
        if frames.ptr == address:
            self._readable = kind
        return frames.ptr, frames

    def _as_frames(self, log_radiance: Any) -> Any:
        count, *of_one = self._shape
        is_one = count == 1 and np.ndim(log_radiance) == 2
        return as_frames(log_radiance, tuple(of_one) if is_one else self._shape, self.device)
