# mypy: disable-error-code="index,attr-defined,misc,var-annotated"
"""The pixels of an event camera: their state, and the launches that take them from one stack to the next.

Scans may be under way one behind the other: each has the state before it and the state after it, in a ring.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.render.launch import core_count, share
from neurosim_core.runtime.cuda import Fence, HostCopy, HostInput
from neurosim_core.sensors import event_kernels
from neurosim_core.sensors.event_keys import ROOM_PER_PIXEL, TOUCHED_COUNT_MAX, roomy_keys
from neurosim_core.sensors.event_noise import PixelNoise
from neurosim_core.sensors.event_states import PixelStates
from neurosim_core.warp_start import refuse_forked_process

_log = logging.getLogger(__name__)

_PIXELS_PER_THREAD_MIN = 16_384
_KEYS_PER_PIXEL = 4
"""Events of a scan for which there is room on CUDA before any have come."""
_COUNTERS = 3
_COUNTERS_ROOM = 16
"""Numbers from the counters of a chunk to those of the next, which another core writes."""


class LostEvents:
    """Counts the events between two frames that are more than a camera may have, and warns of the first."""

    def __init__(self, sensor: str, event_count_max: int) -> None:
        self._sensor, self._event_count_max = sensor, event_count_max
        self._lost: list[tuple[int, int]] = []
        self._reported = False

    def add(self, stamp_ns: int, count: int) -> None:
        """Note how many events before a frame are lost."""
        self._lost.append((stamp_ns, count))
        if not self._reported:
            _log.warning(
                "%s: more than event_count_max = %d events between two frames, %d dropped before %d ns;"
                " further losses are only counted in Events.dropped_count",
                self._sensor or "event camera",
                self._event_count_max,
                count,
                stamp_ns,
            )
            self._reported = True

    def take(self, end_ns: int) -> int:
        """Return how many were lost until a stamp, and forget them."""
        count = sum(lost for stamp_ns, lost in self._lost if stamp_ns <= end_ns)
        self._lost = [(stamp_ns, lost) for stamp_ns, lost in self._lost if stamp_ns > end_ns]
        return count


@dataclass
class Chunk:
    """Pixels that one launch scans, and where their keys go: launches write to nothing they share."""

    first_pixel: int
    end_pixel: int
    keys: wp.array[wp.int64]
    counters: wp.array[wp.int64]
    counters_on_host: HostCopy
    first_key: int = 0
    """Where its keys begin: there are others before."""

    def has_room(self, count: int) -> bool:
        """Return whether so many keys were written, as there is room for them."""
        return self.first_key + count <= int(self.keys.shape[0])


@dataclass(eq=False)
class Scan:
    """The scan of one stack, and buffers: they are its own until its events have been taken over.

    Keys that are written to where they stay are not: other scans and the camera know that buffer.
    """

    number: int
    """Its own for ever: a graph may be made of its buffers."""
    chunks: list[Chunk]
    done: Fence
    inputs: HostInput
    """The counters of each chunk, as they begin; then `times`."""
    times: NDArray[np.int64]
    """Of the inputs: time from the reset to the origin [ns]; then `stamps`."""
    since_reset_ns: wp.array[wp.int64]
    stamps: wp.array[wp.int64]
    """Of the state and of each frame, from the origin [ns]."""
    row_limit: wp.array[wp.int32]
    frames: Any = None
    """Shape [frame, row, column]."""
    stamps_ns: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    origin_us: int = 0
    """Origin of its keys' time."""
    state: int = 0
    """Where in the ring the state before it is; the state after it comes next."""

    def begin(self) -> None:
        """Have each chunk count from its first key on; the next `upload` brings it to the device."""
        for number, chunk in enumerate(self.chunks):
            start = number * _COUNTERS_ROOM
            self.inputs.rows[start : start + _COUNTERS] = chunk.first_key, 0, 0

    def has_room(self, counts: Sequence[int]) -> bool:
        """Return whether all events were written, of which each chunk has so many."""
        return all(chunk.has_room(count) for count, chunk in zip(counts, self.chunks, strict=True))


class Pixels:
    """The pixels of one camera that is fed stacks, on a CPU in chunks for its cores.

    `states` has one more than scans may be under way.
    """

    def __init__(self, states: PixelStates, *, width: int, height: int, device: Any) -> None:
        self.states = states
        self._width, self._height = width, height
        self._device = device
        self._table = self._empty((1, 1, height), wp.int32)
        self._overflow = wp.ones(1, dtype=wp.int32, device=device)
        self._bounds = self._chunk_bounds()
        self._key_room = _KEYS_PER_PIXEL * width * height
        self._scan_number = itertools.count()

    @property
    def noise(self) -> PixelNoise | None:
        """What is not ideal; None: nothing."""
        return self.states.noise[0] if self.states.noise else None

    def reset(self, log_radiance: wp.array2d[wp.float32], stamp_ns: int) -> None:
        """Make a frame every pixel's reference; the first state of the ring is the one that follows."""
        wp.copy(self.states.base.flatten(), log_radiance.flatten())
        wp.copy(self.states.last[0], self.states.base)
        self.states.crossed[0].zero_()
        self.states.set_reset(stamp_ns)
        self.states.begin_noise(self._overflow, 0)

    def next_state(self, state: int) -> int:
        """Return where in the ring the state after another is."""
        return (state + 1) % len(self.states.last)

    @property
    def chunk_count(self) -> int:
        """How many launches share a scan."""
        return len(self._bounds)

    def make_scan(self, frame_count: int, *, keys: wp.array[wp.int64] | None = None) -> Scan:
        """Return buffers for stacks of at most so many frames; keys of one chunk go to `keys`, if given."""
        first_time = len(self._bounds) * _COUNTERS_ROOM
        inputs = HostInput(wp.zeros(first_time + frame_count + 2, dtype=wp.int64, device=self._device))
        chunks = []
        for number, (first, end) in enumerate(self._bounds):
            start = number * _COUNTERS_ROOM
            counters = inputs.array[start : start + _COUNTERS]
            place = self._make_keys(end - first) if keys is None else keys
            chunks.append(Chunk(first, end, place, counters, HostCopy(counters)))
        return Scan(
            number=next(self._scan_number),
            chunks=chunks,
            done=Fence(self._device),
            inputs=inputs,
            times=inputs.rows[first_time:],
            since_reset_ns=inputs.array[first_time : first_time + 1],
            stamps=inputs.array[first_time + 1 :],
            row_limit=wp.full(frame_count, self._height, dtype=wp.int32, device=self._device),
        )

    def _make_keys(self, pixel_count: int) -> wp.array[wp.int64]:
        """Return a buffer for the keys of so many pixels."""
        if self._device.is_cpu:
            return roomy_keys(ROOM_PER_PIXEL * pixel_count, TOUCHED_COUNT_MAX // self.chunk_count)
        keys: wp.array[wp.int64] = self._empty(self._key_room, wp.int64)
        return keys

    def make_room(self, scan: Scan) -> None:
        """Have as much room for the keys of an idle scan as is expected of scans, on CUDA."""
        if self._device.is_cuda and scan.chunks[0].keys.shape[0] < self._key_room:
            scan.chunks[0].keys = self._empty(self._key_room, wp.int64)

    def grow(self, scan: Scan, counts: Sequence[int]) -> None:
        """Make room for the keys that a scan has counted; on CUDA others get room for twice as many."""
        for count, chunk in zip(counts, scan.chunks, strict=True):
            if not chunk.has_room(count):
                chunk.keys = self._empty(1 << (count - 1).bit_length(), wp.int64)
        if 2 * counts[0] > self._key_room:
            self._key_room = 1 << (2 * counts[0] - 1).bit_length()

    def launch_key(self, scan: Scan) -> Hashable:
        """Return the key of the launches of a scan: same key, same launches (`GraphCache`)."""
        keys = tuple((chunk.keys.ptr, chunk.keys.shape[0]) for chunk in scan.chunks)
        frames = scan.frames.ptr, len(scan.stamps_ns)
        return scan.number, scan.state, *frames, keys

    def count_by_row(self, scan: Scan) -> NDArray[np.int32]:
        """Return how many events each frame and row of a stack has, shape [frame, row]; waits for it."""
        self._table = wp.zeros((1, len(scan.stamps_ns), self._height), dtype=wp.int32, device=self._device)
        self.launch(scan, tabulate=True)
        counts: NDArray[np.int32] = self._table.numpy()[0]
        self._table = self._empty((1, 1, self._height), wp.int32)
        return counts

    def launch(self, scan: Scan, *, tabulate: bool = False) -> None:
        """Scan a stack, after `scan.begin`, from the state before it; again, it gives the same one after it.

        With `tabulate` events are only counted, by frame and row, and counters stay as they are.
        """
        before, after = scan.state, self.next_state(scan.state)

        def launch(chunk: Chunk) -> None:
            scan.inputs.upload()
            self.states.launch(
                self._stack(scan, chunk),
                before,
                after,
                frame_count=len(scan.stamps_ns),
                part=event_kernels.COUNT if tabulate else event_kernels.ALL,
                pixels=(chunk.first_pixel, chunk.end_pixel),
            )
            chunk.counters_on_host.fetch(0, _COUNTERS)

        refuse_forked_process()
        share(launch, scan.chunks)  # several on a CPU, one for each core

    def _stack(self, scan: Scan, chunk: Chunk) -> Any:
        """Return what the kernels take for a chunk of a scan: the arrays of one world."""
        stack = event_kernels.Stack()
        stack.log_radiance = scan.frames.reshape((1, scan.frames.shape[0], self._width * self._height))
        stack.stamps = scan.stamps.reshape((1, -1))
        stack.since_reset_ns = scan.since_reset_ns
        stack.row_limit = scan.row_limit.reshape((1, -1))
        stack.overflow = self._overflow
        stack.table = self._table
        stack.keys = chunk.keys.reshape((1, -1))
        stack.counters = chunk.counters.reshape((1, -1))
        return stack

    def _chunk_bounds(self) -> list[tuple[int, int]]:
        pixel_count = self._width * self._height
        chunk_count = 1
        if self._device.is_cpu:
            chunk_count = max(1, min(core_count(), self._height, pixel_count // _PIXELS_PER_THREAD_MIN))
        rows = [self._height * chunk // chunk_count for chunk in range(chunk_count + 1)]
        return [(a * self._width, b * self._width) for a, b in itertools.pairwise(rows)]

    def _empty(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        return wp.empty(shape, dtype=dtype, device=self._device)
