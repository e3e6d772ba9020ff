# mypy: disable-error-code="index,attr-defined,misc,var-annotated"
"""The event camera: from frames of log radiance to a sorted stream of events.

Each pixel holds a reference log radiance L_ref. Between two frames, log radiance is linear in time. Each time
it reaches L_ref + threshold_on (or L_ref - threshold_off), the pixel emits an event at the crossing time, and
L_ref becomes the level crossed. `EventCamera` defines the tie rule. The pixels are in `event_pixels`, their
kernels in `event_scan`, noise in `event_noise_model`, and the arbiter of the readout in `event_readout`.

Reference: Lichtsteiner, Posch, Delbruck (2008); Rebecq, Gehrig, Scaramuzza (2018), ESIM.
"""

from __future__ import annotations

import functools
import logging
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.clock import NS_PER_US
from neurosim_core.packets import Events
from neurosim_core.runtime.cuda import Fence, GraphCache, make_stream, use_stream
from neurosim_core.sensors import event_input
from neurosim_core.sensors.event_batch import EventCameraBatch, FrameEvents
from neurosim_core.sensors.event_config import EventCameraConfig
from neurosim_core.sensors.event_keys import EventKeys, LostEvents
from neurosim_core.sensors.event_pixels import Pixels, PixelStates, Scan
from neurosim_core.warp_start import start_warp

if TYPE_CHECKING:
    from neurosim_core.sensors.event_labels import EventLabels
    from neurosim_core.sensors.event_readout import Readout

_log = logging.getLogger(__name__)

_MIXED = "step() and feed() must not be mixed: call reset() between them"


class EventCamera:
    """An event camera whose input is frames of log radiance.

    The camera keeps its state between calls. The events depend neither on how frames are split into calls,
    nor on the number of threads or the scheduling of the device. There are three ways to use it, of which the
    first two can be mixed:

    - `feed` takes a stack of frames and returns its events.
    - `feed_device` launches the scan of a stack without waiting for it. Later, `collect` or
      `collect_windows` reads back the number of events and returns them, sorted. These run on a stream of
      their own, so they wait for their scan only, and not for later launches.
    - `step` takes one frame and counts its events, which stay on the device, unsorted. It is the fastest way
      for single frames; `EventCameraBatch` does it for many cameras.

    A pixel's levels are base + m threshold_on - n threshold_off, where base is its log radiance at the reset.
    Tie rule: a sample reaches a level from below if its value before rounding may be at or above the level,

        sample >= float32(level - max(half an ulp of base, 2^-23 |level - base|)),

    and likewise, mirrored, from above. The first term is the rounding of base, the second that of k C in
    float32, and the conversion that of the sample. Therefore a step of k thresholds gives exactly k events
    from any base, up and down, in float64 and in float32. The level at base itself has no tolerance: a signal
    that slowly returns to base reaches it when its samples equal base. At other levels, an event may be early
    by the time in which the signal changes by these roundings, about one ulp (5e-7 at 5). Such an event is
    stamped at the sample.

    With a readout, the stamp of an event is the time at which it is read, so its crossing may lie before the
    window.

    Args:
        config: Thresholds, limits and noise.
        width: Width of the sensor [px], 1 to 65536.
        height: Height of the sensor [px], 1 to 65536.
        device: Warp device; on "cpu" the scan is split over the cores.
        sensor: Name of the sensor in the packets; cameras with different names have independent noise.
        seed: Seed of the run for all noise, 0 <= seed < 2^64.
        scan_count_max: Number of stacks that may be fed before the first of them is collected.
        on_host: Return events as NumPy arrays also on a CUDA device, which is faster than a later copy.
        terms: Noise terms to compile, a subset of `event_noise_model.TERMS`; by default those of the
            settings. With `CAUSE` added, x is eight times the column plus the cause.
        labels: Computes ground truth of the sorted events on the device.

    Attributes:
        terms: The compiled noise terms, and "readout" if there is one.

    Raises:
        ValueError: If width, height or seed is out of range.
    """

    def __init__(
        self,
        config: EventCameraConfig,
        *,
        width: int,
        height: int,
        device: str = "cpu",
        sensor: str = "",
        seed: int = 0,
        scan_count_max: int = 1,
        on_host: bool = False,
        terms: Sequence[str] | None = None,
        labels: EventLabels | None = None,
    ) -> None:
        for name, value in (("width", width), ("height", height)):
            if not 1 <= value <= 1 << 16:
                raise ValueError(f"{name} must be in [1, 65536], got {value}")
        if not 0 <= seed < 1 << 64:
            raise ValueError(f"seed must be in [0, 2^64), got {seed}")
        self.config = config
        self.width = width
        self.height = height
        self.sensor = sensor
        start_warp()
        self.device = wp.get_device(device)
        # each scan in flight has the state before it, and the last one also the state after it
        ring_size = scan_count_max + 1
        pixel_terms = config.terms() if terms is None else tuple(terms)
        self.terms = pixel_terms if config.readout is None else (*pixel_terms, "readout")
        states = PixelStates(
            [config],
            width=width,
            height=height,
            ring_size=ring_size,
            device=self.device,
            sensor=sensor,
            seeds=[seed],
            terms=pixel_terms,
            split_pixels=True,
        )
        self._time_shift = states.layout.time_shift
        self._pixels = Pixels(states, width=width, height=height, device=self.device)
        self._scan_count_max = scan_count_max
        self._graphs = GraphCache(device)
        self._reader = make_stream(device, high_priority=True)
        self._reader_done = Fence(device)  # only the reader's stream moves keys; feeding waits for it
        self._on_host = on_host or self.device.is_cpu
        self._keys = EventKeys(
            pixel_count=width * height,
            layout=states.layout,
            device=self.device,
            on_host=self._on_host,
            labels=labels,
        )
        # with one scan in flight, it writes its keys directly behind those that wait for their window
        self._in_place = scan_count_max == 1 and states.slot_count == 1
        # on CUDA one scan more than needed: scans and states then rotate together, which needs fewer graphs
        scan_count = ring_size if self.device.is_cuda and not self._in_place else scan_count_max
        self._idle = deque(self._make_scan(16) for _ in range(scan_count))
        self._in_flight: deque[Scan] = deque()
        arbiter: dict[str, Any] = {"height": height, "layout": states.layout, "seed": seed, "sensor": sensor}
        self._readout: Readout | None = None
        if config.readout is not None:
            from neurosim_core.sensors.event_readout import Readout

            self._readout = Readout(config.readout, **arbiter)
        size: dict[str, Any] = {"width": width, "height": height, "device": device}
        new_stepper = functools.partial(EventCameraBatch, config, count=1, sensor=sensor, seed=seed, **size)
        self._make_stepper = functools.cache(new_stepper)
        self._stepper: EventCameraBatch | None = None
        """Holds the pixels since the reset if `step` is used; else None."""
        self._now_ns: int | None = None
        self._fed_ns = 0
        self._window_start_ns = 0
        self._state = 0
        self._clear()

    @property
    def stamp_ns(self) -> int:
        """Time of the last frame whose events were counted [ns]."""
        return self._require_reset()

    @property
    def span_max_ns(self) -> int:
        """Longest time between the end of the last window and a frame [ns]; more pixels shorten it."""
        return NS_PER_US << (63 - self._time_shift)

    @property
    def window_start_ns(self) -> int:
        """Start of the open window [ns]."""
        return self._window_start_ns

    def reset(self, log_radiance: Any, stamp_ns: int = 0, *, sequence: int = 0) -> None:
        """Reset all pixels: their reference is the given log radiance. Earlier events are discarded.

        Args:
            log_radiance: Natural logarithm of radiance, float32, shape [H, W]; NumPy, Warp or any array of
                the camera's device with `__cuda_array_interface__`. It is copied.
            stamp_ns: Time of this frame [ns].
            sequence: Number of the next packet.

        Raises:
            ValueError: If shape or dtype is wrong, or a value is not finite or beyond +-1000.
        """
        frame = event_input.as_frames(log_radiance, (self.height, self.width), self.device)
        event_input.check_reference(frame.numpy())
        for scan in (*self._idle, *self._in_flight):
            scan.done.wait()  # the scan writes states, and reads data that the host overwrites next
        self._pixels.reset(frame, int(stamp_ns))
        if self._readout is not None:
            self._readout.reset(int(stamp_ns))
        self._now_ns = self._fed_ns = self._reset_ns = int(stamp_ns)
        self._stepper = None
        self._clear()
        self._sequence = sequence

    def feed(self, log_radiance: Any, stamps_ns: Any) -> Events:
        """Return the events up to the last of a stack of frames.

        Args:
            log_radiance: Natural logarithm of radiance, float32, shape [K, H, W], K >= 0; NumPy, Warp or any
                array of the camera's device with `__cuda_array_interface__`.
            stamps_ns: Times of the frames [ns], integers, shape [K]; strictly increasing, after the last
                frame.

        Returns:
            Events in (end of the events returned before, stamps_ns[-1]], sorted by (t, y, x, polarity).

        Raises:
            RuntimeError: If the camera was not reset, or `feed_device` was called without `collect`.
            ValueError: If shape, dtype or stamps are wrong; also if a value is not finite or beyond +-1000,
                in which case the camera must be reset.
        """
        stamps = event_input.as_stamps(stamps_ns)
        frames = event_input.as_frames(log_radiance, (len(stamps), self.height, self.width), self.device)
        if len(stamps) > 0:
            scan = self._plan_scan(frames, stamps)
            self._pixels.launch(scan)
            self._mark_launched(scan)
        return self.collect()

    def step(self, log_radiance: Any, stamp_ns: int) -> FrameEvents:
        """Return the events of one frame as soon as they are counted; see `EventCameraBatch.step`.

        Raises:
            RuntimeError: If the camera was not reset, or was used through `feed` since the reset.
        """
        if self._stepper is None:
            if not self._require_reset() == self._fed_ns == self._reset_ns:
                raise RuntimeError(_MIXED)
            stepper = self._make_stepper()
            stepper.reset(self._pixels.states.ring[0].base.reshape((self.height, self.width)), self._reset_ns)
            self._stepper = stepper
        return self._stepper.step(log_radiance, stamp_ns)

    def feed_device(self, log_radiance: wp.array3d[wp.float32], stamps_ns: Any) -> None:
        """Launch the scan of a stack of frames, without waiting for it.

        The call allocates memory only if the stack is longer than all before it, or if the buffer of events
        is full. At most `scan_count_max` calls may come before `collect` or `collect_windows`; until then
        `log_radiance` must not change. All calls must be on one stream.

        Args:
            log_radiance: Frames on the camera's device, float32, contiguous, shape [K_max, H, W].
            stamps_ns: Times of the first K frames [ns], integers on the host, shape [K], 1 <= K <= K_max;
                strictly increasing, after the last frame. Frames after K are not read.

        Raises:
            RuntimeError: If the camera was not reset, or an earlier stack must be collected first.
            ValueError: If shape, dtype, device or stamps are wrong, or the stamps are too far from the last
                window collected.
        """
        scan = self._plan_scan(log_radiance, event_input.as_stamps(stamps_ns))
        self._graphs.run(self._pixels.launch_key(scan), lambda: self._pixels.launch(scan))
        self._mark_launched(scan)

    def _plan_scan(self, log_radiance: wp.array3d[wp.float32], stamps: NDArray[np.int64]) -> Scan:
        """Prepare an idle scan: write the data that its launches read from the host."""
        self._check_feed(log_radiance, stamps)
        self._reader_done.wait_on_stream()
        count = len(stamps)
        if count > self._idle[0].stack.row_limit.shape[1]:
            self._idle[0] = self._make_scan(count)
        scan = self._idle[0]
        if self._in_place:
            scan.keys, scan.first_key = self._keys.room(), self._keys.count
        else:
            self._pixels.make_room(scan)
        scan.begin()
        scan.frames, scan.stamps_ns = log_radiance, stamps
        scan.origin_us = self._keys.origin_us
        scan.state = self._state
        origin_ns = scan.origin_us * NS_PER_US
        scan.times[0] = origin_ns - self._reset_ns
        scan.times[1] = self._fed_ns - origin_ns
        np.subtract(stamps, origin_ns, out=scan.times[2 : count + 2])
        return scan

    def _make_scan(self, frame_count: int) -> Scan:
        return self._pixels.make_scan(frame_count, keys=self._keys.room() if self._in_place else None)

    def _mark_launched(self, scan: Scan) -> None:
        """Move the first idle scan to those in flight. A scan that is only planned changes no state."""
        scan.done.set()
        self._in_flight.append(self._idle.popleft())
        self._state = self._pixels.next_state(self._state)
        self._fed_ns = int(scan.stamps_ns[-1])

    def _check_feed(self, log_radiance: wp.array3d[wp.float32], stamps: NDArray[np.int64]) -> None:
        self._require_reset()
        if self._stepper is not None:
            raise RuntimeError(_MIXED)
        if len(self._in_flight) >= self._scan_count_max:
            raise RuntimeError(f"collect() must be called after {len(self._in_flight)} feed_device()")
        event_input.check_stack(
            log_radiance, stamps, (self.height, self.width), self.device, after_ns=self._fed_ns
        )
        event_input.check_span(int(stamps[-1]), origin_us=self._keys.origin_us, span_max_ns=self.span_max_ns)

    def collect(self) -> Events:
        """Return all events up to the last frame fed, and wait for them.

        Raises:
            RuntimeError: If the camera was not reset.
            ValueError: If a value of the frames was not finite or beyond +-1000; it must be reset then.
        """
        with use_stream(self._reader):
            while self._in_flight:
                self._merge_oldest()
            return self._begin_cut([self._require_reset()])()[0]

    def collect_windows(self, ends_ns: Sequence[int], *, scan_count: int | None = None) -> list[Events]:
        """Return the events fed so far as one packet per window, and wait for them.

        Windows are (previous end, end]. The exact crossing time of an event decides its window, not the
        rounded microsecond, so the packets do not depend on how frames are split into stacks. Events after
        the last window stay in the camera.

        Args:
            ends_ns: Ends of the windows [ns]; increasing by at least 1 us, at most the stamp of the last
                frame that this call waits for.
            scan_count: Largest number of stacks to wait for, oldest first; None: all. With a
                `scan_count_max` of 1, the call waits for the stack in flight if there is a window.

        Raises:
            RuntimeError: If the camera was not reset.
            ValueError: If `ends_ns` is wrong; also if a value of the frames was not finite or beyond +-1000,
                in which case the camera must be reset.
        """
        return self.begin_windows(ends_ns, scan_count=scan_count)()

    def begin_windows(
        self, ends_ns: Sequence[int], *, scan_count: int | None = None
    ) -> Callable[[], list[Events]]:
        """Begin `collect_windows` without waiting for the sort; arguments and errors are the same.

        The returned function waits for the sorted events and returns the packets. Until it is called, no
        other method may be called, except `feed_device` if `scan_count_max` is above 1.
        """
        ends = [int(end) for end in ends_ns]
        in_flight = len(self._in_flight)
        count = in_flight if scan_count is None else min(scan_count, in_flight)
        if ends and self._scan_count_max == 1:
            count = in_flight  # the scan writes into the array that is cut
        if self._in_place and not ends:  # nothing has to be launched
            for _ in range(count):
                self._merge_oldest()
            self._require_reset()
            return list
        with use_stream(self._reader):
            for _ in range(count):
                self._merge_oldest()
            self._reader_done.set()
            now_ns = self._require_reset()
            if not ends:
                return list
            event_input.check_ends(ends, start_ns=self._window_start_ns, now_ns=now_ns)
            return self._begin_cut(ends)

    def _clear(self) -> None:
        scans = [*self._idle, *self._in_flight]
        self._idle = deque(sorted(scans, key=lambda scan: scan.number))  # initial order, so graphs are reused
        self._in_flight.clear()
        self._state = 0
        self._lost, self._warned = LostEvents(), False
        self._sequence = 0
        self._window_start_ns = self._now_ns or 0
        self._keys.clear(self._window_start_ns // NS_PER_US)

    def _require_reset(self) -> int:
        if self._now_ns is None:
            raise RuntimeError("call reset() with a first frame before feed() or step()")
        return self._now_ns

    def _scan_again(self, scan: Scan) -> None:
        """Repeat the scan of a stack."""
        scan.begin()
        self._pixels.launch(scan)
        scan.done.set()

    def _merge_oldest(self) -> None:
        """Wait for the oldest scan, repeat it if its buffer was too small, and add its keys to the others."""
        scan = self._in_flight[0]
        counts = self._read_counts(scan)
        if sum(counts) > self.config.event_count_max or not scan.has_room(counts):
            with use_stream(self._reader):
                counts = self._redo(scan, counts)
                self._reader_done.set()
        if self._in_place:
            self._keys.note(counts[0])
        else:
            for slot, count in enumerate(counts):
                self._keys.append(scan.keys, slot * scan.room, count, scan.origin_us)
        self._now_ns = int(scan.stamps_ns[-1])
        scan.frames = None
        self._idle.append(self._in_flight.popleft())

    def _redo(self, scan: Scan, counts: list[int]) -> list[int]:
        """Repeat a scan, within the event limit and with a larger buffer; return the number of events."""
        limited = sum(counts) > self.config.event_count_max and self._limit_rows(scan)
        if limited:
            counts = self._read_counts(scan)
        if not scan.has_room(counts):
            if self._in_place:
                self._keys.reserve(self._keys.count + counts[0])
                scan.keys = self._keys.room()
            else:
                self._pixels.grow(scan, counts)
            self._scan_again(scan)
            scan.done.wait()  # the caller may overwrite the frames now
        if limited:
            scan.stack.row_limit.fill_(self.height)
        return counts

    def _read_counts(self, scan: Scan) -> list[int]:
        """Wait for a scan and return the number of events of each slot."""
        scan.done.wait()
        counters = scan.counters_on_host.view(0, len(scan.counters))[:, :3].tolist()
        if invalid_count := sum(invalid for _, invalid, _ in counters):
            first = len(scan.stamps_ns) * self.width * self.height - max(place for *_, place in counters)
            frame, pixel = divmod(first, self.width * self.height)
            row, col = divmod(pixel, self.width)
            self._now_ns = None
            self._idle += self._in_flight
            self._in_flight.clear()
            raise ValueError(event_input.invalid_message(invalid_count, f"[{frame}, {row}, {col}]"))
        return [end - scan.first_key for end, _, _ in counters]

    def _limit_rows(self, scan: Scan) -> bool:
        """Limit frames with too many events to the upper rows that fit; return whether there are any."""
        lost = self._pixels.limit_rows(scan, self.config.event_count_max)
        short = np.flatnonzero(lost)
        if len(short) == 0:
            return False
        self._lost.add(scan.stamps_ns[short], lost[short])
        if not self._warned:
            _log.warning(
                "%s: more than event_count_max = %d events between two frames, %d dropped before %d ns;"
                " further losses are only counted in Events.dropped_count",
                self.sensor or "event camera",
                self.config.event_count_max,
                lost[short[0]],
                scan.stamps_ns[short[0]],
            )
            self._warned = True
        self._scan_again(scan)
        return True

    def _begin_cut(self, ends: list[int]) -> Callable[[], list[Events]]:
        """Sort the keys; return a function that returns the packets of the windows and keeps other keys."""
        if self._readout is not None:
            lost_ns = self._keys.read_out(self._readout, self._require_reset())
            self._lost.add(lost_ns, np.ones_like(lost_ns))
        span_us = self._require_reset() // NS_PER_US - self._keys.origin_us
        # with a readout, stamps may be later than the last frame
        end_bit = self._time_shift + (span_us + 1).bit_length() if self._readout is None else 63
        end_cut = self._keys.begin_cut(ends, end_bit)

        def collect() -> list[Events]:
            with use_stream(self._reader):
                columns, cuts = end_cut()
                packets = self._packets(ends, columns, cuts)
                self._keys.carry_over(cuts[-1], self._window_start_ns // NS_PER_US)
                self._reader_done.set()
            return packets

        return collect

    def _packets(self, ends: list[int], columns: list[Any], cuts: list[int]) -> list[Events]:
        """Return the packets of windows; `cuts` are the ends of the windows in the columns."""
        packets = []
        for start, cut, end_ns in zip([0, *cuts], cuts, ends, strict=False):
            found = [column[start:cut] for column in columns] if cut > start else self._keys.no_events()
            packets.append(
                Events(
                    stamp_ns=end_ns,
                    sequence=self._sequence,
                    sensor=self.sensor,
                    **dict(zip(("t", "x", "y", "polarity"), found, strict=True)),
                    width=self.width,
                    height=self.height,
                    start_ns=self._window_start_ns,
                    dropped_count=self._lost.take(end_ns),
                )
            )
            self._sequence += 1
            self._window_start_ns = end_ns
        return packets
