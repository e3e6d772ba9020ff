# mypy: disable-error-code="attr-defined,var-annotated"
"""Keys of events that the host has counted: gathered, sorted, cut into windows and taken apart.

Keys are as in `event_levels`. What no window has taken yet stays, and its time goes on from the last cut.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.clock import NS_PER_US
from neurosim_core.runtime.cuda import (
    BufferPool,
    Fence,
    GraphCache,
    HostCopy,
    HostInput,
    RecordedLaunch,
    size_class,
)
from neurosim_core.sensors import event_kernels
from neurosim_core.sensors.event_kernels import COLUMN_OFFSETS, COLUMN_TYPES, EVENT_BYTES
from neurosim_core.sensors.event_levels import SUB_BITS, KeyLayout

if TYPE_CHECKING:
    from neurosim_core.sensors.event_labels import EventLabels
    from neurosim_core.sensors.event_readout import Readout

_KEYS_PER_PIXEL_ON_CPU, _KEYS_PER_PIXEL_ON_CUDA = 16, 4
"""Events for which there is room before any have come: pages that nobody touched cost nothing on a CPU."""
_ROOM_MIN = 1024
_BLOCK_COUNT_MAX = 1 << 26
"""Most events in one block of memory: Warp counts its bytes in 31 bits."""
_HEADER_LENGTH = 3
"""Numbers in the header of a cut, before the ends of its windows."""


def keys_at_first(pixel_count: int, device: Any) -> int:
    """Return for how many events there is room before any have come."""
    return pixel_count * (_KEYS_PER_PIXEL_ON_CPU if device.is_cpu else _KEYS_PER_PIXEL_ON_CUDA)


Cut = Callable[[], tuple[list[Any], list[int]]]
"""Waits for keys to be sorted; returns them as columns, and the index of the first one after each window."""


class LostEvents:
    """Events that are lost, until the packet of their time tells how many."""

    def __init__(self) -> None:
        self._stamps_ns = self._counts = np.zeros(0, np.int64)

    def add(self, stamps_ns: NDArray[np.int64], counts: NDArray[np.int64]) -> None:
        """Note how many events are lost until some stamps."""
        self._stamps_ns = np.concatenate([self._stamps_ns, stamps_ns])
        self._counts = np.concatenate([self._counts, counts])

    def take(self, end_ns: int) -> int:
        """Return how many were lost until a stamp, and forget them."""
        if len(self._counts) == 0:
            return 0
        due = self._stamps_ns <= end_ns
        count = int(self._counts[due].sum())
        self._stamps_ns, self._counts = self._stamps_ns[~due], self._counts[~due]
        return count


class EventKeys:
    """The keys of one camera, of all that has been read from its scans; `labels` is told of each cut.

    Attributes:
        keys: The first `count` of them are keys, in any order; its room is at least that.
        count: How many there are.
        origin_us: Origin of their time [us].
    """

    def __init__(
        self,
        *,
        pixel_count: int,
        layout: KeyLayout,
        device: Any,
        on_host: bool,
        labels: EventLabels | None = None,
    ) -> None:
        self._pixel_count = pixel_count
        self._layout, self._time_shift = layout, layout.time_shift
        self._device = device
        self._on_host = on_host
        self._labels = labels
        self.keys = self._buffer(0)
        self.count = 0
        self.origin_us = 0
        self._read_count = 0
        self._spare = self._buffer(0)
        self._order = self._empty(0, wp.int32)
        self._rooms: dict[int, wp.array[wp.int64]] = {}
        """Of both buffers, by address, what keys may be in."""
        self._blocks = BufferPool(device) if on_host and device.is_cuda else None
        """Host memory for events."""
        self._columns: list[Any] = []
        """What is copied to them: one block of memory, as each type that is in it."""
        self._read = Fence(device)
        self._carry_over = RecordedLaunch(event_kernels.carry_over, device)
        self._make_window_buffers(16)

    def clear(self, origin_us: int) -> None:
        """Forget all keys; those that come have their time from an origin [us]."""
        self.count = self._read_count = 0
        self.origin_us = origin_us

    def append(self, keys: wp.array[wp.int64], first: int, count: int, origin_us: int) -> None:
        """Add `count` keys from `first` on, whose time has its own origin [us]."""
        start = self.count
        self.reserve(start + count)
        self.count += count
        # on CUDA a launch that comes again takes less of the host than a copy
        if count > 0 and origin_us == self.origin_us and self._device.is_cpu:
            wp.copy(self.keys, keys, src_offset=first, dest_offset=start, count=count)
        elif count > 0:
            self._move(keys, first, count, self.keys, start, self.origin_us - origin_us)

    def room(self) -> wp.array[wp.int64]:
        """Return the buffer as far as there may be keys, for a scan to write them behind those there are."""
        self.reserve(self.count + 1)
        return self._rooms[self.keys.ptr]

    def note(self, count: int) -> None:
        """Note that a scan has written `count` keys, from the same origin of time, behind those there are."""
        self.count += count

    def reserve(self, count: int) -> None:
        """Make room for so many keys; those there are stay."""
        if count * (2 if self._device.is_cuda else 1) <= self.keys.shape[0]:
            return
        room = 1 << (count - 1).bit_length()
        room = max(2 * room if self._device.is_cuda else room, keys_at_first(self._pixel_count, self._device))
        room = max(room, _ROOM_MIN)
        keys = self._buffer(room)
        if self.count > 0:
            wp.copy(keys, self.keys, count=self.count)
        self.keys = keys
        self._graphs = GraphCache(self._device)
        self._spare = self._buffer(room)
        self._rooms = {buffer.ptr: buffer[:room] for buffer in (self.keys, self._spare)}
        if self._device.is_cuda:
            self._order = self._empty(2 * room, wp.int32)
            if self._on_host:
                block = self._empty(EVENT_BYTES * min(room, _BLOCK_COUNT_MAX), wp.uint8)
                times, both = (
                    wp.array(ptr=block.ptr, dtype=dtype, shape=block.shape[0] // size, device=self._device)
                    for dtype, size in ((wp.int64, 8), (wp.uint16, 2))
                )
                self._columns = [times, both, both, block]

    def read_out(self, readout: Readout, now_ns: int) -> NDArray[np.int64]:
        """Put the events that the arbiter reads until now in place of those that have happened.

        Times of those that are lost are returned [ns].
        """
        first, arrivals = self._read_count, np.zeros(0, np.int64)
        count = self.count - first
        if count == 0 and readout.waiting_count == 0:
            return arrivals
        if count > 0:
            from neurosim_core.sensors.event_readout import by_nanosecond

            self._launch(by_nanosecond, count, [self.keys, first, self._time_shift], [self._spare])
            self._sort(self._spare, count)
            arrivals = self._spare[:count].numpy()
        read, lost_ns = readout.read(arrivals, origin_us=self.origin_us, now_ns=now_ns)
        self.reserve(first + len(read))
        self.count = first + len(read)
        if len(read) > 0:
            wp.copy(self.keys, wp.array(read, dtype=wp.int64, device="cpu"), dest_offset=first)
        return lost_ns

    def begin_cut(self, ends_ns: Sequence[int], end_bit: int) -> Cut:
        """Launch the sort of the keys; no others may come until what is returned has been called.

        There is one end of a window at least [ns]; `end_bit` is beyond the highest bit that a key may have.
        """
        count, window_count = self.count, len(ends_ns)
        if count == 0:
            return lambda: ([], [0] * window_count)
        if window_count > self._found.shape[0]:
            self._make_window_buffers(window_count)
        pool = self._blocks if count <= _BLOCK_COUNT_MAX else None
        copied = count + count % 2 if pool is not None else 0  # columns in a block begin where they may
        columns = [self._empty(count, dtype) for dtype in COLUMN_TYPES] if pool is None else self._columns
        header = self._header.rows
        header[:_HEADER_LENGTH] = count, copied, self.origin_us
        ends = np.array(ends_ns) - self.origin_us * NS_PER_US
        header[_HEADER_LENGTH : _HEADER_LENGTH + window_count] = ends
        # a graph sorts up to half as many more; launches, of which there are many, take the host far longer
        room = count if pool is None else min(max(_ROOM_MIN, size_class(count)), self._order.shape[0] // 2)

        def launch() -> None:
            self._header.upload()
            header = [self._header.array, self._bounds, window_count]
            self._launch(event_kernels.prepare, room, [*header, self._time_shift], [self.keys])
            self._sort(self.keys, room, begin_bit=SUB_BITS - 1, end_bit=end_bit)
            outputs = [*columns, self._found]
            self._launch(event_kernels.decode_windows, room, [*header, self.keys, self._layout], outputs)
            self._found_on_host.fetch(0, window_count)

        if pool is None:
            launch()
        else:
            self._graphs.run((room, window_count, end_bit, self.keys.ptr), launch)
        if self._labels is not None:
            self._labels.launch(count, *columns[:3], first_x=4 * copied, first_y=5 * copied)
        block = None
        if pool is not None:
            block = pool.acquire(EVENT_BYTES * copied)
            wp.copy(block.array, columns[-1], count=EVENT_BYTES * copied)
        self._read.set()

        def end_cut() -> tuple[list[Any], list[int]]:
            self._read.wait()
            found = columns
            if pool is not None and block is not None:
                rows = pool.hand_out(block, EVENT_BYTES * copied)
                found = []
                for offset, dtype in zip(COLUMN_OFFSETS, map(wp.dtype_to_numpy, COLUMN_TYPES), strict=True):
                    size = np.dtype(dtype).itemsize
                    found.append(rows[offset * copied : (offset + size) * copied].view(dtype))
            elif self._on_host:
                found = [column.numpy() for column in columns]
            return found, self._found_on_host.rows(0, window_count).tolist()

        return end_cut

    def no_events(self) -> list[Any]:
        """Return columns without an event."""
        if self._on_host:
            return [np.zeros(0, wp.dtype_to_numpy(dtype)) for dtype in COLUMN_TYPES]
        return [self._empty(0, dtype) for dtype in COLUMN_TYPES]  # Warp refuses an empty slice

    def carry_over(self, first: int, origin_us: int) -> None:
        """Keep the keys from `first` on for later windows, with their time from an origin [us]."""
        count = self.count - first
        if count > 0:
            self._move(self.keys, first, count, self._spare, 0, origin_us - self.origin_us)
            self.keys, self._spare = self._spare, self.keys
        self.count = self._read_count = count
        self.origin_us = origin_us

    def _move(
        self, keys: Any, first: int, count: int, keys_out: Any, first_out: int, origin_step_us: int
    ) -> None:
        dim = count if self._device.is_cpu else max(_ROOM_MIN, size_class(count))
        arguments = [keys, first, count, origin_step_us, self._time_shift, keys_out, first_out]
        self._carry_over.launch(dim, arguments)

    def _sort(self, keys: wp.array[wp.int64], count: int, **bits: int) -> None:
        """Sort the first keys of a buffer; a GPU compares a range of `bits` alone."""
        if self._device.is_cpu:
            keys.numpy()[:count].sort()  # ten times as fast as Warp's radix sort on a CPU
            return
        wp.utils.radix_sort_pairs(keys, self._order, count, **bits)

    def _buffer(self, count: int) -> wp.array[wp.int64]:
        """Return a buffer for keys that are to be sorted: the radix sort on CUDA wants twice the room."""
        keys: wp.array[wp.int64] = self._empty(2 * count if self._device.is_cuda else count, wp.int64)
        return keys

    def _make_window_buffers(self, window_count: int) -> None:
        self._graphs = GraphCache(self._device)  # they name the buffers
        self._header = HostInput(wp.zeros(_HEADER_LENGTH + window_count, dtype=wp.int64, device=self._device))
        self._bounds = self._header.array[_HEADER_LENGTH:]
        self._found = wp.zeros(window_count, dtype=wp.int32, device=self._device)
        self._found_on_host = HostCopy(self._found)

    def _launch(self, kernel: Any, dim: int, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._device)

    def _empty(self, count: int, dtype: Any) -> Any:
        return wp.empty(count, dtype=dtype, device=self._device)
