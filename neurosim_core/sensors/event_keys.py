# mypy: disable-error-code="attr-defined"
"""Keys of events that the host has counted: gathered, sorted, cut into windows and taken apart.

Keys are as in `event_levels`. What no window has taken yet stays, and its time goes on from the last cut.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import warp as wp

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
from neurosim_core.sensors import event_cut
from neurosim_core.sensors.event_cut import COLUMN_OFFSETS, COLUMN_TYPES, EVENT_BYTES
from neurosim_core.sensors.event_levels import SUB_BITS
from neurosim_core.sensors.event_readout import Readout

ROOM_PER_PIXEL = 16
"""Events for which there is room on a CPU before any have come: pages that nobody touched cost nothing there,
and memory follows the events, in place of doubling in the middle of a run."""
TOUCHED_COUNT_MAX = 1 << 18
"""Keys of that room that are written to at once: the first busy moment of a run needs no new pages."""
_EVENTS_PER_SAMPLE = 1 / 8
"""Events of a pixel in a frame for which memory of the host is pinned from the start: four times as many as a
tour of a house yields at 1 kHz. To pin takes 1 ms a MB, in which a device stands still."""
_PINNED_BLOCKS = 3
"""What a reader holds, what it reads next, and what is copied to."""
_ROOM_MIN = 1024
_BLOCK_COUNT_MAX = 1 << 26
"""Most events in one block of memory: Warp counts its bytes in 31 bits."""
_HEADER_LENGTH = 3
"""Numbers in the header of a cut, before the ends of its windows."""
_PINNED_BYTES_MAX = 144 << 20
"""Most memory that is pinned for events that have not come."""


def roomy_keys(count: int, touched_count: int) -> wp.array[wp.int64]:
    """Return a buffer on a CPU for more keys than will come, the first of which have pages already."""
    keys: wp.array[wp.int64] = wp.empty(count, dtype=wp.int64, device="cpu")
    keys.numpy()[:touched_count] = 0
    return keys


Cut = Callable[[], tuple[list[Any], list[int]]]
"""Waits for keys to be sorted; returns them as columns, and the index of the first one after each window."""


class Labeller(Protocol):
    """Is told of events while their columns are on the device."""

    def launch(self, count: int, t: Any, x: Any, y: Any, *, first_x: int = 0, first_y: int = 0) -> None:
        """Launch what is done with them.

        Args:
            count: How many events there are.
            t: Their times [us], int64, shape [>= count].
            x: Their columns [px], uint16, from `first_x` on.
            y: Their rows [px], uint16, from `first_y` on.
            first_x: Where the columns begin in `x`.
            first_y: Where the rows begin in `y`.
        """


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
        row_shift: int,
        time_shift: int,
        device: Any,
        on_host: bool,
        labels: Labeller | None = None,
    ) -> None:
        self._pixel_count = pixel_count
        self._row_shift, self._time_shift = row_shift, time_shift
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
        """Where events go that are copied to the host."""
        self._columns: list[Any] = []
        """What is copied to them: one block of memory, as each type that is in it."""
        self._frame_count = 0
        self._read = Fence(device)
        self._carry_over = RecordedLaunch(event_cut.carry_over, device)
        self._make_window_buffers(16)

    def clear(self, origin_us: int) -> None:
        """Forget all keys; those that come have their time from an origin [us]."""
        self.count = self._read_count = 0
        self.origin_us = origin_us

    def expect(self, frame_count: int) -> None:
        """Pin memory of the host for what a stack of so many frames may yield, if events are copied there."""
        if self._blocks is None or frame_count <= self._frame_count:
            return
        self._frame_count = size_class(frame_count)
        events = int(_EVENTS_PER_SAMPLE * self._frame_count * self._pixel_count)
        self._blocks.reserve(min(EVENT_BYTES * events, _PINNED_BYTES_MAX // _PINNED_BLOCKS), _PINNED_BLOCKS)

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
        if self._device.is_cpu:
            room = max(room, ROOM_PER_PIXEL * self._pixel_count)
            keys = roomy_keys(room, TOUCHED_COUNT_MAX)
        else:
            room = max(2 * room, 4 * self._pixel_count, _ROOM_MIN)
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
                self._columns = [
                    wp.array(ptr=block.ptr, dtype=dtype, shape=block.shape[0] // size, device=self._device)
                    for dtype, size in ((wp.int64, 8), (wp.uint16, 2))
                ]
                self._columns.append(block)

    def read_out(self, readout: Readout, now_ns: int) -> None:
        """Put the events that the arbiter reads until now in place of those that have happened."""
        first, count = self._read_count, self.count - self._read_count
        if count == 0 and readout.waiting_count == 0:
            return
        self.reserve(self.count + readout.waiting_count)
        read = readout.read(
            self.keys,
            first=first,
            count=count,
            spare=self._spare,
            order=self._order,
            origin_us=self.origin_us,
            now_ns=now_ns,
        )
        self.count = first + read

    def begin_cut(self, ends_ns: Sequence[int], end_bit: int) -> Cut:
        """Launch the sort of the keys; no others may come until what is returned has been called.

        There is one end of a window at least [ns]; `end_bit` is beyond the highest bit that a key may have.
        """
        count = self.count
        if count == 0:
            return lambda: ([], [0] * len(ends_ns))
        if len(ends_ns) > self._found.shape[0]:
            self._make_window_buffers(len(ends_ns))
        copied = count + count % 2  # columns in a block begin where they may
        header = self._header.rows
        header[:_HEADER_LENGTH] = count, copied, self.origin_us
        header[_HEADER_LENGTH : _HEADER_LENGTH + len(ends_ns)] = (
            np.array(ends_ns) - self.origin_us * NS_PER_US
        )
        if self._blocks is not None and count <= _BLOCK_COUNT_MAX:
            return self._begin_cut_to_host(self._blocks, copied, len(ends_ns), end_bit)
        self._header.upload()
        prepared = [self._header.array, self._bounds, len(ends_ns), self._time_shift]
        self._launch(event_cut.prepare, count, prepared, [self.keys])
        self._sort(count, end_bit)
        self._launch(
            event_cut.find_ends,
            len(ends_ns),
            [self.keys, count, self._bounds, self._time_shift],
            [self._found],
        )
        self._found_on_host.fetch(0, len(ends_ns))
        columns = [self._empty(count, dtype) for dtype in COLUMN_TYPES]
        decoded = [self.keys, self.origin_us, self._row_shift, self._time_shift]
        self._launch(event_cut.decode, count, decoded, columns)
        if self._labels is not None:
            self._labels.launch(count, *columns[:3])
        self._read.set()

        def end_cut() -> tuple[list[Any], list[int]]:
            self._read.wait()
            found = [column.numpy() for column in columns] if self._on_host else columns
            return found, self._found_on_host.rows(0, len(ends_ns)).tolist()

        return end_cut

    def _begin_cut_to_host(self, blocks: BufferPool, copied: int, window_count: int, end_bit: int) -> Cut:
        """Do the same on CUDA with a copy of all events to the host, one column after the other."""
        # a graph sorts up to half as many more; launches, of which there are many, take the host far longer
        room = min(max(_ROOM_MIN, size_class(self.count)), self._order.shape[0] // 2)
        shifts = [self._row_shift, self._time_shift]

        def launch() -> None:
            self._header.upload()
            header = [self._header.array, self._bounds, window_count]
            self._launch(event_cut.prepare, room, [*header, self._time_shift], [self.keys])
            self._sort(room, end_bit)
            outputs = [*self._columns, self._found]
            self._launch(event_cut.decode_windows, room, [*header, self.keys, *shifts], outputs)
            self._found_on_host.fetch(0, window_count)

        self._graphs.run((room, window_count, end_bit, self.keys.ptr), launch)
        if self._labels is not None:
            t, both = self._columns[:2]
            self._labels.launch(self.count, t, both, both, first_x=4 * copied, first_y=5 * copied)
        block = blocks.acquire(EVENT_BYTES * copied)
        wp.copy(block.array, self._columns[-1], count=EVENT_BYTES * copied)
        self._read.set()

        def end_cut() -> tuple[list[Any], list[int]]:
            self._read.wait()
            rows = blocks.hand_out(block, EVENT_BYTES * copied)
            columns = []
            for offset, dtype in zip(COLUMN_OFFSETS, map(wp.dtype_to_numpy, COLUMN_TYPES), strict=True):
                size = np.dtype(dtype).itemsize
                columns.append(rows[offset * copied : (offset + size) * copied].view(dtype))
            return columns, self._found_on_host.rows(0, window_count).tolist()

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

    def _sort(self, count: int, end_bit: int) -> None:
        if self._device.is_cpu:
            self.keys.numpy()[:count].sort()  # ten times as fast as Warp's radix sort on a CPU
            return
        wp.utils.radix_sort_pairs(self.keys, self._order, count, begin_bit=SUB_BITS - 1, end_bit=end_bit)

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
