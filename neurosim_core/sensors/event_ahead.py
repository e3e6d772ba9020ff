# mypy: disable-error-code="index,attr-defined,misc,no-untyped-call,arg-type,operator,no-any-return"
"""Windows of events that are cut on the device before the host has asked for them, or counted anything.

What follows a scan (keys merged with those carried over from the windows before, sorted, cut and taken apart)
needs to know how many keys there are, and only the device does. So the host guesses a size from what came
before, with much room; keys that stand for nothing fill it and sort last. It also has to say at once where
windows will end. All of it is then one sequence of launches, replayed as a graph, and the copy of the events
to the host: of nearly as many as there were lately, and where more have come the host asks again. When it
comes to read, it compares what it guessed with what was counted. Where it guessed wrong nothing is lost: the
keys of the scan and those carried over are still there, and `EventCamera` does the same the other way.

A draft reads what the draft before it carried over, so there is one more of them than may be under way: the
one that the host has read last stays whole.
"""

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.clock import NS_PER_US
from neurosim_core.sensors.event_scan import SUB_BITS, count_until, mark, move_origin, take_apart
from neurosim_core.streams import (
    Graphs,
    HostCopy,
    HostInput,
    LentBlock,
    LentBlocks,
    Milestone,
    make_stream,
    on,
    size_class,
)

wp.set_module_options({"enable_backward": False})

WINDOW_COUNT_MAX = 16
"""Most windows of a draft."""
_ROOM_MIN = 1024
_ROOM_MAX = 1 << 26
_ROOM_PER_PIXEL = 1
"""Keys for which there is room before any have come."""
_RECENT = 4
"""Drafts that the guess of the next size looks back at; there is room for twice the largest of them.

Keys that fill the room are sorted like others. On a tour of a house, 32 ms a draft, there is room for 2.8
times as many keys as come, and one in 140 is guessed wrong; looking back at 16, and never forgetting the
most, there was room for 9.3 times as many.
"""
_ROOMY_BYTES_MAX = 256 << 20
"""Most memory of the host for twice as many events as have come."""
_SPARE_BLOCKS = 3
"""Blocks for the host beyond those that drafts under way are copied to: what readers hold."""

# what a draft counts, then the ends of its windows
_TOTAL = wp.constant(0)
"""Keys there were, with those carried over; more than HELD: the guess was too small."""
_HELD = wp.constant(1)
_CUT = wp.constant(2)
"""Where what is carried over begins."""
_ENDS = wp.constant(3)

# what a draft is told, then the ends of its windows from the origin [ns]
_ORIGIN_US = wp.constant(0)
_STEP_US = wp.constant(1)
"""From the origin of the keys carried over to its own."""
_COPIED = wp.constant(2)
"""Events for which the columns have room; a multiple of 2."""
_BOUNDS = 3

_COLUMN_TYPES = tuple(np.dtype(name) for name in ("int64", "uint16", "uint16", "uint8"))
"""Types of the times, columns, rows and polarities of events."""
_OFFSETS = (0, 8, 10, 12)
"""Where each of them begins in a block with room for one event."""
_EVENT_BYTES = 13

_NOTHING = wp.constant(wp.int64((1 << 63) - 1))
"""Key that sorts behind all others."""


@wp.kernel
def gather(
    # In:
    told: wp.array[wp.int64],
    bounds: wp.array[wp.int64],
    window_count: wp.int32,
    room: wp.int32,
    time_shift: wp.int32,
    carried_keys: wp.array[wp.int64],
    carried_tally: wp.array[wp.int32],
    found_keys: wp.array[wp.int64],
    counters: wp.array[wp.int64],
    # Out:
    keys_out: wp.array[wp.int64],
    tally_out: wp.array[wp.int32],
) -> None:
    """Put keys carried over and keys found together, with `late` set; fill the room that is left.

    Args:
        told: Origin of the keys, and its step from that of the keys carried over [us].
        bounds: Ends of the windows from the origin [ns].
        window_count: How many there are.
        room: Keys that are written, the number of threads.
        time_shift: Bits of a key below its microseconds.
        carried_keys: Keys of the draft before.
        carried_tally: What it counted.
        found_keys: Keys of the scan; those that did not fit are missing.
        counters: Of the scan: the first is how many it found.
        keys_out: Keys, in any order.
        tally_out: How many there are, how many of them are held, and that none is in a window.
    """
    event = wp.tid()
    first = carried_tally[_CUT]
    carried = carried_tally[_HELD] - first
    found = wp.int32(counters[0])
    key = _NOTHING
    if event < carried:
        key = mark(
            move_origin(carried_keys[first + event], told[_STEP_US], time_shift),
            bounds,
            window_count,
            time_shift,
        )
    elif event - carried < wp.min(found, found_keys.shape[0]):
        key = mark(found_keys[event - carried], bounds, window_count, time_shift)
    keys_out[event] = key
    if event == 0:
        tally_out[_TOTAL] = carried + found
        tally_out[_HELD] = wp.min(carried + found, room)
        tally_out[_CUT] = 0


@wp.kernel
def cut(
    # In:
    keys: wp.array[wp.int64],
    room: wp.int32,
    bounds: wp.array[wp.int64],
    window_count: wp.int32,
    time_shift: wp.int32,
    # Out:
    tally_out: wp.array[wp.int32],
) -> None:
    """Find where each window ends in the sorted keys; threads are the windows."""
    window = wp.tid()
    end = count_until(bounds[window], keys, room, time_shift)
    tally_out[_ENDS + window] = end
    if window == window_count - 1:
        tally_out[_CUT] = end


@wp.kernel
def decode_windows(
    # In:
    told: wp.array[wp.int64],
    keys: wp.array[wp.int64],
    tally: wp.array[wp.int32],
    row_shift: wp.int32,
    time_shift: wp.int32,
    # Out:
    columns_8: wp.array[wp.int64],
    columns_2: wp.array[wp.uint16],
    columns_1: wp.array[wp.uint8],
) -> None:
    """Take the keys of all windows apart, like `event_scan.decode`, as far as there is room.

    The outputs are one block of memory as three types: the columns of events are in it one after the other.
    """
    event = wp.tid()
    room = wp.int32(told[_COPIED])
    if event < wp.min(tally[_CUT], room):
        found = take_apart(keys[event], row_shift, time_shift)
        columns_8[event] = told[_ORIGIN_US] + found.time_us
        columns_2[4 * room + event] = found.x
        columns_2[5 * room + event] = found.y
        columns_1[12 * room + event] = found.polarity


@wp.kernel
def carry_all(key_count: wp.int32, tally_out: wp.array[wp.int32]) -> None:
    """Count so many keys of which no window has taken one."""
    tally_out[_TOTAL] = key_count
    tally_out[_HELD] = key_count
    tally_out[_CUT] = 0


@dataclass(eq=False)
class Draft:
    """The windows of one scan, cut ahead, and the buffers for it."""

    told: HostInput
    bounds: wp.array[wp.int64]
    tally: wp.array[wp.int32]
    tally_on_host: HostCopy
    done: Milestone
    keys: wp.array[wp.int64]
    """Twice the capacity: the sort wants that."""
    room: int = 0
    """Keys that fit, as it was guessed."""
    copied: int = 0
    """Events for which its columns have room; where there are more, they are copied once more."""
    ends_ns: tuple[int, ...] = ()
    origin_us: int = 0
    """Origin of its keys' time."""
    dropped: bool = False
    """Nobody has waited for it."""
    block: LentBlock | None = None
    """The columns of its events on the host, one after the other, each with room for `copied`."""

    def total(self) -> int:
        """Return how many keys there were, once it is done: with more than `room` it is of no use."""
        return int(self.tally_on_host.view(int(_TOTAL), 1)[0])

    def cuts(self) -> list[int]:
        """Return where each window ends in the columns, once it is done."""
        cuts: list[int] = self.tally_on_host.view(int(_ENDS), len(self.ends_ns)).tolist()
        return cuts

    def carried(self) -> tuple[int, int]:
        """Return the first of the keys that no window has taken, and their number, once it is done."""
        held, first = self.tally_on_host.view(int(_HELD), 2).tolist()
        return first, held - first


class Drafts:
    """Cuts the windows of one scan after the other, on the device; for keys as in `event_scan`.

    Args:
        pixel_count: Pixels of the camera.
        row_shift: Bits of a key below its row.
        time_shift: Bits of a key below its microseconds.
        under_way_max: How many scans may be under way.
        device: Where.

    Attributes:
        grown: Comes after the copies into new buffers: who reads keys of a draft on another stream waits.
    """

    def __init__(
        self, *, pixel_count: int, row_shift: int, time_shift: int, under_way_max: int, device: Any
    ) -> None:
        self._row_shift, self._time_shift = row_shift, time_shift
        self._device = device
        self._graphs = Graphs(device)
        self._reader = make_stream(device, urgent=True)
        self._drafts = [self._make_draft() for _ in range(under_way_max + 1)]
        self._last = 0
        self._capacity = 0
        self._order = self._empty(0, wp.int32)
        self._columns = self._empty(0, wp.uint8)
        self._more_columns = self._empty(0, wp.uint8)
        self._blocks = LentBlocks(device)
        self._reserved_bytes = 0
        self.grown = Milestone(device)
        self._recent: deque[int] = deque(maxlen=_RECENT)
        self._room = size_class(max(_ROOM_MIN, _ROOM_PER_PIXEL * pixel_count))
        self._copied = self._room
        wp.load_module(__name__, device=device)

    @property
    def ready(self) -> bool:
        """Whether enough is known for a guess."""
        return bool(self._recent)

    def note(self, key_count: int) -> None:
        """Learn how many keys there were after a scan, with those carried over.

        The room changes seldom, as each size has its graphs.
        """
        self._recent.append(key_count)
        recent = max(self._recent)
        room = min(size_class(max(_ROOM_MIN, 2 * recent)), _ROOM_MAX)
        if room > self._room or 2 * room <= self._room:
            self._room = room
        rise = 2 * key_count - self._recent[0]  # or they go on to rise
        step = max(16, 1 << max(0, recent.bit_length() - 5))
        self._copied = min(-(-(9 * max(recent, rise) // 8 + 1) // step) * step, self._room)

    def seed(self, keys: wp.array[wp.int64], count: int, origin_us: int) -> None:
        """Let the next draft carry over keys that the host has counted; no draft is wanted any more.

        Args:
            keys: Keys, copied.
            count: How many of them.
            origin_us: Origin of their time [us].
        """
        draft = self._drafts[self._last]
        self._make_room(max(count, self._room))
        if count > 0:
            wp.copy(draft.keys, keys, count=count)
        wp.launch(carry_all, dim=1, inputs=[count], outputs=[draft.tally], device=self._device)
        draft.origin_us = origin_us

    def launch(
        self,
        keys: wp.array[wp.int64],
        counters: wp.array[wp.int64],
        *,
        ends_ns: tuple[int, ...],
        origin_us: int,
        now_ns: int,
    ) -> Draft:
        """Cut the windows of a scan that was launched on this stream; waits for nothing.

        The draft launched last, or the seed, is what is carried over.

        Args:
            keys: Of the scan, in any order.
            counters: Of the scan.
            ends_ns: Ends of the windows [ns], at most `WINDOW_COUNT_MAX`, increasing.
            origin_us: Origin of the keys' time, at most that of the scan's first event [us].
            now_ns: Last frame of the scan [ns].
        """
        room = self._room
        self._make_room(room)
        before = self._drafts[self._last]
        self._last = (self._last + 1) % len(self._drafts)
        draft = self._drafts[self._last]
        if draft.dropped:  # it may still have to read what it was told, for buffers that were smaller
            draft.done.wait()
            draft.dropped = False
        draft.room, draft.ends_ns, draft.origin_us = room, ends_ns, origin_us
        draft.copied = self._copied
        told = draft.told.rows
        told[int(_COPIED)] = draft.copied
        told[int(_ORIGIN_US)] = origin_us
        told[int(_STEP_US)] = origin_us - before.origin_us
        for window, end_ns in enumerate(ends_ns, _BOUNDS):
            told[window] = end_ns - origin_us * NS_PER_US
        # beyond the span all ones, which sort last
        end_bit = min(63, self._time_shift + (now_ns // NS_PER_US - origin_us + 1).bit_length())
        found = (keys.ptr, keys.shape[0], counters.ptr)
        key = (self._last, self._capacity, found, room, len(ends_ns), end_bit)
        self._graphs.run(key, lambda: self._cut(draft, before, keys, counters, end_bit))
        if ends_ns:
            draft.block = self._blocks.take(_EVENT_BYTES * draft.copied)
            wp.copy(draft.block.array, self._columns, count=_EVENT_BYTES * draft.copied)
        draft.done.set()
        return draft

    def take(self, draft: Draft) -> list[NDArray[Any]]:
        """Return the columns of a draft that is done, none without windows; they are the caller's."""
        if draft.block is None:
            return []
        count = draft.cuts()[-1]
        if count > draft.copied:
            self._copy_again(draft, count)
        room = draft.copied
        rows = self._blocks.lend(draft.block, _EVENT_BYTES * room)
        draft.block = None
        columns = []
        for offset, dtype in zip(_OFFSETS, _COLUMN_TYPES, strict=True):
            columns.append(rows[offset * room : (offset + dtype.itemsize) * room].view(dtype))
        return columns

    def _copy_again(self, draft: Draft, count: int) -> None:
        """Copy all events of a draft that is done, more than were copied, and wait for them."""
        self.drop(draft)
        draft.copied = count + count % 2
        draft.block = self._blocks.take(_EVENT_BYTES * draft.copied)
        draft.told.rows[int(_COPIED)] = draft.copied
        with on(self._reader):
            self.grown.hold()
            draft.told.upload()
            self._decode(draft, count, self._more_columns)
            wp.copy(draft.block.array, self._more_columns, count=_EVENT_BYTES * draft.copied)
            draft.done.set()
        draft.done.wait()

    def drop(self, draft: Draft) -> None:
        """Forget a draft that is not wanted any more."""
        draft.dropped = True
        if draft.block is not None:
            self._blocks.give_back(draft.block)
            draft.block = None

    def _cut(
        self,
        draft: Draft,
        before: Draft,
        keys: wp.array[wp.int64],
        counters: wp.array[wp.int64],
        end_bit: int,
    ) -> None:
        """Launch all of it but the copy of the events."""
        draft.told.upload()
        told, room, window_count = draft.told.array, draft.room, len(draft.ends_ns)
        self._launch(
            gather,
            room,
            [
                *(told, draft.bounds, window_count, room, self._time_shift),
                *(before.keys, before.tally, keys, counters),
            ],
            [draft.keys, draft.tally],
        )
        if window_count == 0:  # all is carried over, in whatever order
            draft.tally_on_host.fetch(0, int(_ENDS))
            return
        wp.utils.radix_sort_pairs(draft.keys, self._order, room, begin_bit=SUB_BITS - 1, end_bit=end_bit)
        self._launch(
            cut,
            window_count,
            [draft.keys, room, draft.bounds, window_count, self._time_shift],
            [draft.tally],
        )
        draft.tally_on_host.fetch(0, int(_ENDS) + window_count)
        self._decode(draft, room, self._columns)

    def _decode(self, draft: Draft, count: int, columns: wp.array[wp.uint8]) -> None:
        """Take at most so many keys apart, as far as the draft says that there is room."""
        self._launch(
            decode_windows,
            count,
            [draft.told.array, draft.keys, draft.tally, self._row_shift, self._time_shift],
            [
                wp.array(ptr=columns.ptr, dtype=dtype, shape=columns.shape[0] // size, device=self._device)
                for dtype, size in ((wp.int64, 8), (wp.uint16, 2), (wp.uint8, 1))
            ],
        )

    def _launch(self, kernel: Any, dim: int, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._device)

    def _make_room(self, count: int) -> None:
        """Let the buffers hold so many keys, and keep the keys that the next draft carries over.

        With them come blocks of the host, for as many events; for about half as many where that is much.
        """
        block_count = len(self._drafts) + _SPARE_BLOCKS
        wanted_bytes = _EVENT_BYTES * self._room
        if block_count * wanted_bytes > _ROOMY_BYTES_MAX:
            wanted_bytes = _EVENT_BYTES * max(self._room // 2, self._copied)
        if wanted_bytes > self._reserved_bytes:
            self._blocks.reserve(wanted_bytes, block_count)
            self._reserved_bytes = size_class(wanted_bytes)
        if count <= self._capacity:
            return
        self._capacity = 1 << (count - 1).bit_length()
        for draft in self._drafts:
            before = draft.keys
            draft.keys = self._empty(2 * self._capacity, wp.int64)
            if before.shape[0] > 0:
                wp.copy(draft.keys, before)
        self._order = self._empty(2 * self._capacity, wp.int32)
        self._columns = self._empty(_EVENT_BYTES * self._capacity, wp.uint8)
        self._more_columns = self._empty(_EVENT_BYTES * self._capacity, wp.uint8)
        self.grown.set()

    def _make_draft(self) -> Draft:
        told = HostInput(wp.zeros(_BOUNDS + WINDOW_COUNT_MAX, dtype=wp.int64, device=self._device))
        tally = wp.zeros(int(_ENDS) + WINDOW_COUNT_MAX, dtype=wp.int32, device=self._device)
        return Draft(
            told=told,
            bounds=told.array[_BOUNDS:],
            tally=tally,
            tally_on_host=HostCopy(tally),
            done=Milestone(self._device),
            keys=self._empty(0, wp.int64),
        )

    def _empty(self, count: int, dtype: Any) -> Any:
        return wp.empty(count, dtype=dtype, device=self._device)
