# mypy: disable-error-code="index,attr-defined,misc,no-untyped-call,var-annotated"
"""The event camera: from frames of log radiance to a sorted stream of events.

Each pixel holds a reference log radiance L_ref. Between two frames log radiance is linear in time; each time
it reaches L_ref + threshold_on (or L_ref - threshold_off) an event is emitted at the crossing time, and L_ref
becomes the level crossed. The kernels, the tie rule and the place of later noise terms are in `event_scan`.

Reference: Lichtsteiner, Posch, Delbruck (2008); Rebecq, Gehrig, Scaramuzza (2018), ESIM.
"""

import itertools
import logging
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field

from neurosim_core.clock import NS_PER_US
from neurosim_core.packets import Events
from neurosim_core.sensors import event_scan
from neurosim_core.sensors.event_scan import LOG_RADIANCE_MAX, SUB_BITS, TILE_SIZE
from neurosim_core.settings import Settings

_log = logging.getLogger(__name__)

_BLOCK_SIZE = 256
_PIXELS_PER_THREAD_MIN = 16_384


class EventCameraConfig(Settings):
    """An ideal event camera: the same two thresholds in every pixel, no noise, no dead time."""

    threshold_on: float = Field(default=0.2, ge=1e-3, le=100.0)
    """Rise of log radiance (natural logarithm) that fires an event of polarity 1."""
    threshold_off: float = Field(default=0.2, ge=1e-3, le=100.0)
    """Fall of log radiance (natural logarithm) that fires an event of polarity 0."""
    event_count_max: int = Field(default=1 << 24, ge=1, le=1 << 30)
    """Most events between two frames. When there are more, the rows from the top are kept as long as they
    fit; the events of the others are lost, and counted in `Events.dropped_count`. The buffer grows up to this
    size times the frames of a batch as needed, 8 bytes per event; sorting takes about 40 bytes per event."""


@dataclass
class _Chunk:
    """Pixels that one launch scans, and its own part of the buffer: launches write to nothing they share."""

    first_pixel: int
    end_pixel: int
    keys: wp.array[wp.int64]
    counters: wp.array[wp.int64]


class EventCamera:
    """An event camera that is fed frames of log radiance.

    Its state survives between calls, and neither the split of frames into calls, the number of threads nor
    the device's scheduling changes the events. Two ways to use it, which may be mixed:

    - `feed` takes a stack of frames and returns its events.
    - `feed_device` launches the scan of a stack without waiting for it, and later `collect` or
      `collect_windows` reads back the number of events and hands them out, sorted.

    Args:
        config: Thresholds and limits.
        width: Width of the sensor [px], 1 to 65536.
        height: Height of the sensor [px], 1 to 65536.
        device: Warp device; on "cpu" the scan is split over the cores.
        sensor: Name of the sensor in the packets.

    Raises:
        ValueError: If width or height is out of range.
    """

    def __init__(
        self, config: EventCameraConfig, *, width: int, height: int, device: str = "cpu", sensor: str = ""
    ) -> None:
        for name, value in (("width", width), ("height", height)):
            if not 1 <= value <= 1 << 16:
                raise ValueError(f"{name} must be in [1, 65536], got {value}")
        self.config = config
        self.width = width
        self.height = height
        self.sensor = sensor
        self.device = wp.get_device(device)
        self._row_shift = SUB_BITS + (width - 1).bit_length()
        self._time_shift = self._row_shift + (height - 1).bit_length() + 1
        self._pool: ThreadPoolExecutor | None = None

        pixel_count = width * height
        self._base = self._empty(pixel_count, wp.float32)
        self._last = [self._empty(pixel_count, wp.float32) for _ in range(2)]
        self._crossed = [self._empty(pixel_count, wp.vec2i) for _ in range(2)]
        self._lead = wp.zeros(pixel_count, dtype=wp.int32, device=self.device)
        self._screened = self.device.is_cpu
        scratch = pixel_count if self._screened else 0
        self._quiet_range = [self._empty(scratch, wp.float32) for _ in range(2)]
        self._chunks = [
            _Chunk(first, end, self._empty(2 * (end - first), wp.int64), self._empty(3, wp.int64))
            for first, end in self._chunk_bounds()
        ]
        self._make_frame_buffers(16)
        wp.load_module(event_scan, device=self.device)

        self._now_ns: int | None = None
        self._scanned: tuple[Any, NDArray[np.int64]] | None = None
        self._forget()

    def reset(self, log_radiance: Any, stamp_ns: int = 0) -> None:
        """Start anew: every pixel's reference is its log radiance now, and earlier events are forgotten.

        Args:
            log_radiance: Natural logarithm of radiance, float32, shape [H, W]; NumPy, Warp or any array of
                the camera's device with `__cuda_array_interface__`. It is copied.
            stamp_ns: Time of this frame [ns].

        Raises:
            ValueError: If shape or dtype is wrong, or a value is not finite or beyond +-1000.
        """
        frame = self._as_warp(log_radiance, (self.height, self.width))
        values = frame.numpy()
        valid = np.abs(values) <= LOG_RADIANCE_MAX
        if not valid.all():
            row, col = (int(index) for index in np.argwhere(~valid)[0])
            raise ValueError(_invalid_message(int((~valid).sum()), f"[{row}, {col}]"))
        wp.copy(self._base, frame.flatten())
        wp.copy(self._last[0], self._base)
        self._crossed[0].zero_()
        self._now_ns = int(stamp_ns)
        self._forget()

    def feed(self, log_radiance: Any, stamps_ns: Any) -> Events:
        """Return the events up to the last of a stack of frames.

        Args:
            log_radiance: Natural logarithm of radiance, float32, shape [K, H, W], K >= 0; NumPy, Warp or any
                array of the camera's device with `__cuda_array_interface__`.
            stamps_ns: Times of the frames [ns], integers, shape [K]; strictly increasing, later than what the
                camera has seen.

        Returns:
            Events in (end of the events returned before, stamps_ns[-1]], sorted by (t, y, x, polarity).

        Raises:
            RuntimeError: If the camera was not reset, or `feed_device` was called without `collect`.
            ValueError: If shape, dtype or stamps are wrong; also if a value is not finite or beyond +-1000,
                in which case the camera must be reset.
        """
        stamps = _as_stamps(stamps_ns)
        frames = self._as_warp(log_radiance, (len(stamps), self.height, self.width))
        if len(stamps) > 0:
            self.feed_device(frames, stamps)
        return self.collect()

    def feed_device(self, log_radiance: wp.array3d[wp.float32], stamps_ns: Any) -> None:
        """Launch the scan of a stack of frames, without waiting for it.

        Nothing is allocated unless the stack is longer than any before. `collect` or `collect_windows` comes
        next; until then `log_radiance` must stay as it is.

        Args:
            log_radiance: Frames on the camera's device, float32, contiguous, shape [K_max, H, W].
            stamps_ns: Times of the first K frames [ns], integers on the host, shape [K], 1 <= K <= K_max;
                strictly increasing, later than what the camera has seen. The frames after K are not read.

        Raises:
            RuntimeError: If the camera was not reset, or the stack before was not collected.
            ValueError: If shape, dtype, device or stamps are wrong, or the stamps are too far from the last
                window collected.
        """
        now_ns = self._require_reset()
        if self._scanned is not None:
            raise RuntimeError("collect() must be called between two feed_device()")
        stamps = _as_stamps(stamps_ns)
        count = len(stamps)
        fits = log_radiance.ndim == 3 and log_radiance.shape[1:] == (self.height, self.width)
        if not (fits and 1 <= count <= log_radiance.shape[0] and log_radiance.is_contiguous):
            raise ValueError(
                f"log_radiance must be contiguous of shape [>= {count}, {self.height}, {self.width}]"
                f" for {count} >= 1 stamps, got {list(log_radiance.shape)}"
                f" with strides {list(log_radiance.strides)}"
            )
        if log_radiance.dtype != wp.float32 or log_radiance.device != self.device:
            raise ValueError(
                f"log_radiance must be float32 on {self.device},"
                f" got {log_radiance.dtype.__name__} on {log_radiance.device}"
            )
        if stamps[0] <= now_ns:
            raise ValueError(f"stamps_ns must be later than {now_ns}, got {stamps[0]}")
        if (span_us := int(stamps[-1]) // NS_PER_US - self._origin_us) >> (63 - self._time_shift):
            limit_s = (1 << (63 - self._time_shift)) / 1e6
            raise ValueError(
                f"stamps_ns must be within {limit_s:g} s of the last window, got {span_us / 1e6:g} s"
            )

        if count > self._row_limit.shape[0]:
            self._make_frame_buffers(count)
        relative = self._stamps_host.numpy()
        relative[0] = now_ns
        relative[1 : count + 1] = stamps
        relative[: count + 1] -= self._origin_us * NS_PER_US
        wp.copy(self._stamps, self._stamps_host, count=count + 1)
        self._scanned = (log_radiance.reshape((log_radiance.shape[0], self.width * self.height)), stamps)
        self._launch(tabulate=False)

    def collect(self) -> Events:
        """Return all events up to the last frame fed, and wait for them.

        Raises:
            RuntimeError: If the camera was not reset.
            ValueError: If a value of the frames was not finite or beyond +-1000; it must be reset then.
        """
        self._finish_scan()
        now_ns = self._require_reset()
        return self._cut([now_ns])[0]

    def collect_windows(self, ends_ns: Sequence[int]) -> list[Events]:
        """Return the events fed so far as one packet per window, and wait for them.

        Windows are (end before, end]. An event belongs to a window by its crossing time, not by the
        microsecond it is rounded to, so the packets do not depend on how the frames were split into stacks.
        Events after the last window stay in the camera.

        Args:
            ends_ns: Ends of the windows [ns]; increasing by at least 1 us, not after the last frame fed.

        Raises:
            RuntimeError: If the camera was not reset.
            ValueError: If `ends_ns` is wrong; also if a value of the frames was not finite or beyond +-1000,
                in which case the camera must be reset.
        """
        self._finish_scan()
        now_ns = self._require_reset()
        ends = [int(end) for end in ends_ns]
        bounds = [self._window_start_ns, *ends]
        if any(b - a < NS_PER_US for a, b in zip(bounds, ends, strict=False)) or bounds[-1] > now_ns:
            raise ValueError(
                f"ends_ns must increase by at least 1000 from {bounds[0]} and not pass {now_ns}, got {ends}"
            )
        return self._cut(ends)

    def _forget(self) -> None:
        self._scanned = None
        self._keys = self._key_buffer(0)
        self._key_count = 0
        self._dropped: list[tuple[int, int]] = []
        self._drop_reported = False
        self._sequence = 0
        self._window_start_ns = self._now_ns or 0
        self._origin_us = self._window_start_ns // NS_PER_US

    def _require_reset(self) -> int:
        if self._now_ns is None:
            raise RuntimeError("reset() must be called before frames are fed")
        return self._now_ns

    def _empty(self, shape: int | tuple[int, int], dtype: Any) -> Any:
        return wp.empty(shape, dtype=dtype, device=self.device)

    def _chunk_bounds(self) -> list[tuple[int, int]]:
        pixel_count = self.width * self.height
        chunk_count = 1
        if self.device.is_cpu:
            chunk_count = max(1, min(_core_count(), self.height, pixel_count // _PIXELS_PER_THREAD_MIN))
        rows = [self.height * chunk // chunk_count for chunk in range(chunk_count + 1)]
        return [(a * self.width, b * self.width) for a, b in itertools.pairwise(rows)]

    def _make_frame_buffers(self, frame_count: int) -> None:
        pinned = self.device.is_cuda
        self._stamps_host = wp.empty(frame_count + 1, dtype=wp.int64, device="cpu", pinned=pinned)
        self._stamps = self._empty(frame_count + 1, wp.int64)
        self._row_limit = wp.full(frame_count, self.height, dtype=wp.int32, device=self.device)
        self._table = self._empty((1, self.height), wp.int32)

    def _as_warp(self, value: Any, shape: tuple[int, ...]) -> Any:
        """Return an array as a contiguous float32 Warp array of this shape on the device."""
        if not isinstance(value, wp.array):
            on_device = hasattr(value, "__cuda_array_interface__")
            value = wp.array(value) if on_device else np.asarray(value)
        dtype = wp.dtype_to_numpy(value.dtype) if isinstance(value, wp.array) else value.dtype
        if tuple(value.shape) != shape or dtype != np.float32:
            raise ValueError(
                f"log_radiance must be float32 of shape {list(shape)},"
                f" got {np.dtype(dtype).name} of shape {list(value.shape)}"
            )
        if isinstance(value, wp.array):
            if value.device != self.device:
                raise ValueError(f"log_radiance must be on {self.device}, got {value.device}")
            return value.contiguous()
        flat = np.ascontiguousarray(value).reshape(-1)  # axes of length 1 may have had any stride
        return wp.array(flat, dtype=wp.float32, shape=shape, device=self.device, copy=False)

    def _launch(self, *, tabulate: bool) -> None:
        """Scan the stack from the state before it; the state after it goes to the second buffers."""
        assert self._scanned is not None
        frames, stamps = self._scanned

        def launch(chunk: _Chunk) -> None:
            chunk.counters.zero_()
            thresholds = [self.config.threshold_on, self.config.threshold_off]
            extent = [chunk.first_pixel, chunk.end_pixel, frames]
            if self._screened:
                wp.launch(
                    event_scan.screen,
                    dim=-(-(chunk.end_pixel - chunk.first_pixel) // TILE_SIZE),
                    inputs=[*thresholds, *extent, len(stamps), self._base, self._crossed[0]],
                    outputs=[*self._quiet_range, self._lead],
                    device=self.device,
                )
            block = _BLOCK_SIZE if self.device.is_cuda else 1
            blocks = -(-(chunk.end_pixel - chunk.first_pixel) // block)
            wp.launch(
                event_scan.scan,
                dim=blocks * block,  # whole blocks: their threads reserve slots together
                block_dim=_BLOCK_SIZE,
                inputs=[
                    *thresholds,
                    self.width,
                    self._row_shift,
                    self._time_shift,
                    *extent,
                    self._stamps,
                    len(stamps),
                    self._lead,
                    self._row_limit,
                    self._base,
                    self._last[0],
                    self._crossed[0],
                    tabulate,
                ],
                outputs=[self._last[1], self._crossed[1], chunk.keys, chunk.counters, self._table],
                device=self.device,
            )

        if len(self._chunks) > 1 and self._pool is None:
            self._pool = ThreadPoolExecutor(len(self._chunks) - 1, thread_name_prefix="event-scan")
        futures = [self._pool.submit(launch, chunk) for chunk in self._chunks[1:]] if self._pool else []
        launch(self._chunks[0])
        for future in futures:
            future.result()

    def _finish_scan(self) -> None:
        """Wait for the scan, redo it if the buffer was too small, and take over its keys and state."""
        if self._scanned is None:
            return
        stamps = self._scanned[1]
        counts = self._read_counts()
        limited = sum(counts) > self.config.event_count_max and self._limit_rows()
        if limited:
            counts = self._read_counts()
        if any(count > chunk.keys.shape[0] for count, chunk in zip(counts, self._chunks, strict=True)):
            for count, chunk in zip(counts, self._chunks, strict=True):
                if count > chunk.keys.shape[0]:
                    chunk.keys = self._empty(1 << (count - 1).bit_length(), wp.int64)
            self._launch(tabulate=False)
        if limited:
            self._row_limit.fill_(self.height)

        parts = [(self._keys, self._key_count)]
        parts += [(chunk.keys, count) for count, chunk in zip(counts, self._chunks, strict=True)]
        self._key_count = sum(count for _, count in parts)
        self._keys = self._key_buffer(self._key_count)
        start = 0
        for keys, count in parts:
            if count > 0:
                wp.copy(self._keys, keys, dest_offset=start, count=count)
                start += count
        self._last.reverse()
        self._crossed.reverse()
        self._now_ns = int(stamps[-1])
        self._scanned = None

    def _read_counts(self) -> list[int]:
        """Wait for the scan and return the number of events of each chunk."""
        counters = np.stack([chunk.counters.numpy() for chunk in self._chunks])
        if invalid_count := int(counters[:, 1].sum()):
            assert self._scanned is not None
            first = len(self._scanned[1]) * self.width * self.height - int(counters[:, 2].max())
            frame, pixel = divmod(first, self.width * self.height)
            row, col = divmod(pixel, self.width)
            self._now_ns = None
            self._scanned = None
            raise ValueError(_invalid_message(invalid_count, f"[{frame}, {row}, {col}]"))
        return [int(count) for count in counters[:, 0]]

    def _limit_rows(self) -> bool:
        """Where a frame has too many events, keep the rows from the top that fit; return whether one has."""
        assert self._scanned is not None
        stamps = self._scanned[1]
        self._table = wp.zeros((len(stamps), self.height), dtype=wp.int32, device=self.device)
        self._launch(tabulate=True)
        total = np.cumsum(self._table.numpy(), axis=1, dtype=np.int64)
        rows = (total <= self.config.event_count_max).sum(axis=1)
        self._table = self._empty((1, self.height), wp.int32)
        for frame in np.flatnonzero(rows < self.height):
            kept = int(total[frame, rows[frame] - 1]) if rows[frame] > 0 else 0
            self._dropped.append((int(stamps[frame]), int(total[frame, -1]) - kept))
        if not (rows < self.height).any():
            return False
        if not self._drop_reported:
            stamp_ns, dropped = self._dropped[-1]
            _log.warning(
                "%s: more than event_count_max = %d events between two frames, %d dropped before %d ns;"
                " further losses are only counted in Events.dropped_count",
                self.sensor or "event camera",
                self.config.event_count_max,
                dropped,
                stamp_ns,
            )
            self._drop_reported = True
        wp.copy(self._row_limit, wp.array(rows, dtype=wp.int32, device=self.device), count=len(rows))
        self._launch(tabulate=False)
        return True

    def _key_buffer(self, count: int) -> wp.array[wp.int64]:
        """Return a buffer for keys that are to be sorted: the radix sort on CUDA wants twice the room."""
        keys: wp.array[wp.int64] = self._empty(2 * count if self.device.is_cuda else count, wp.int64)
        return keys

    def _sort_keys(self) -> None:
        if self.device.is_cpu:
            self._keys.numpy().sort()  # ten times as fast as Warp's radix sort on a CPU
            return
        order = self._empty(2 * self._key_count, wp.int32)
        span_us = self._require_reset() // NS_PER_US - self._origin_us
        end_bit = self._time_shift + span_us.bit_length()
        wp.utils.radix_sort_pairs(self._keys, order, self._key_count, begin_bit=SUB_BITS - 1, end_bit=end_bit)

    def _cut(self, ends: list[int]) -> list[Events]:
        """Sort the keys, hand out those of the windows that end so, and carry the others over."""
        count = self._key_count
        cuts = [0] * len(ends)
        columns = [self._empty(count, dtype) for dtype in (wp.int64, wp.uint16, wp.uint16, wp.uint8)]
        if count > 0 and ends:
            origin_ns = self._origin_us * NS_PER_US
            bounds = wp.array(np.array(ends) - origin_ns, dtype=wp.int64, device=self.device)
            found = self._empty(len(ends), wp.int32)
            wp.launch(
                event_scan.mark_late,
                dim=count,
                inputs=[bounds, self._time_shift],
                outputs=[self._keys],
                device=self.device,
            )
            self._sort_keys()
            wp.launch(
                event_scan.find_ends,
                dim=len(ends),
                inputs=[self._keys, count, bounds, self._time_shift],
                outputs=[found],
                device=self.device,
            )
            wp.launch(
                event_scan.decode,
                dim=count,
                inputs=[self._keys, self._origin_us, self._row_shift, self._time_shift],
                outputs=columns,
                device=self.device,
            )
            cuts = found.numpy().tolist()

        packets = []
        for start, cut, end_ns in zip([0, *cuts], cuts, ends, strict=False):
            dropped = sum(lost for stamp_ns, lost in self._dropped if stamp_ns <= end_ns)
            self._dropped = [(stamp_ns, lost) for stamp_ns, lost in self._dropped if stamp_ns > end_ns]
            # Warp refuses an empty slice
            parts = [c[start:cut] if cut > start else self._empty(0, c.dtype) for c in columns]
            t, x, y, polarity = (p.numpy() for p in parts) if self.device.is_cpu else parts
            packets.append(
                Events(
                    stamp_ns=end_ns,
                    sequence=self._sequence,
                    sensor=self.sensor,
                    t=t,
                    x=x,
                    y=y,
                    polarity=polarity,
                    width=self.width,
                    height=self.height,
                    start_ns=self._window_start_ns,
                    dropped_count=dropped,
                )
            )
            self._sequence += 1
            self._window_start_ns = end_ns
        self._carry_over(cuts[-1] if cuts else 0)
        return packets

    def _carry_over(self, first: int) -> None:
        """Keep the keys from `first` on for later windows, with their time from the last window's end."""
        count = self._key_count - first
        origin_us = self._window_start_ns // NS_PER_US
        keys = self._key_buffer(count)
        if count > 0:
            wp.launch(
                event_scan.carry_over,
                dim=count,
                inputs=[self._keys[first:], origin_us - self._origin_us, self._time_shift],
                outputs=[keys],
                device=self.device,
            )
        self._keys = keys
        self._key_count = count
        self._origin_us = origin_us


def _core_count() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _as_stamps(stamps_ns: Any) -> NDArray[np.int64]:
    stamps = np.asarray(stamps_ns)
    if stamps.size == 0:
        stamps = stamps.astype(np.int64)
    if stamps.ndim != 1 or not np.issubdtype(stamps.dtype, np.integer):
        raise ValueError(
            f"stamps_ns must be integers of shape [K], got {stamps.dtype} of shape {list(stamps.shape)}"
        )
    stamps = stamps.astype(np.int64)
    steps = np.diff(stamps)
    if (steps <= 0).any():
        index = int(np.argmax(steps <= 0))
        raise ValueError(
            f"stamps_ns must be strictly increasing, got {stamps[index + 1]} after {stamps[index]}"
        )
    return stamps


def _invalid_message(count: int, first: str) -> str:
    return (
        f"log_radiance must be finite and within +-{LOG_RADIANCE_MAX:g}:"
        f" {count} values are not, the first at {first}"
    )
