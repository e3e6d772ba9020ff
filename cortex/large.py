"""Large messages of one publisher: written once into a slot, read there by local readers, sent to others."""

from __future__ import annotations

import mmap
import struct
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import zmq

from cortex.outlet import DONTWAIT, SNDMORE, Backoff, Outlet, Outlets
from cortex.shm import Ring, ShmUnavailable
from cortex.wire import (
    HEADER_SIZE,
    LARGE,
    MESSAGE,
    REST,
    SLOT,
    AttachAnswer,
    AttachKey,
    RingPlace,
    answer_frame,
    message_head,
    pack_place,
)

COLUMNS = 64
RING_BYTES = 4 << 20
"""A ring of small slots takes this much, so that it stays in cache."""
GROWTH_BYTES = 4 << 20
"""What slots of a ring that replaces one for smaller messages have to spare, at most: to make a ring takes a
millisecond or more, and who publishes waits for it."""
DEEP_RING_BYTES = 16 << 20
DEEP_SLOTS = 128
"""What a ring takes, and how many slots, where a reader keeps more messages than by default."""
DEEP_QUOTA = 67
"""A reader that may hold so many messages keeps more than by default, see `keep_last`."""
RING_BYTES_MAX = 2 << 30
PRIVATE_BYTES = 64 << 20
"""Most memory outside rings that waits to be sent."""
RINGS_ALIVE = 4
RINGS_KEPT = 8
"""Rings with those that are written no more, but not yet read by a reliable reader."""
RETRY_S = 5.0
"""After a ring could not be made, none is tried for so long."""
_SLOT_REST = struct.Struct(REST.format + "Q")
"""The rest of a descriptor's header, and the mask."""


@dataclass(eq=False)
class Reader:
    """One subscriber's link to this publisher."""

    key: bytes
    request: AttachKey
    outlet: Outlet
    column: int | None
    member: int | None = None
    """Its number in the publisher's ring, through which its frames go; None: through the outlet."""
    confirmed: int = 0
    """It has accounted for all messages below this."""

    @property
    def timeout_s(self) -> float:
        """How long this reader may hold up the publisher [s]."""
        return self.request.timeout_ms / 1000.0 if self.request.strict else 0.0


class Slot(NamedTuple):
    """Where a large message is written: a slot of a ring, or private memory where there is no ring."""

    buffer: np.ndarray
    ring: Ring | None
    number: int


class Stamps(NamedTuple):
    """What the header of a message says besides its place."""

    sequence: int
    stamp_ns: int
    publish_ns: int


@dataclass(eq=False)
class _Pin:
    """Memory that a socket still reads."""

    tracker: zmq.MessageTracker
    ring: Ring | None
    slot: int
    size: int
    strict: bool


class LargeSender:
    """Slots, leases and zero-copy sends of one publisher.

    Everything that touches readers or sockets runs under the outlets' lock.
    """

    def __init__(
        self,
        source: int,
        fingerprint: int,
        *,
        stamped: bool,
        topic: str,
        outlets: Outlets,
        expected_bytes: int = 0,
    ) -> None:
        self._source = source
        self._expected_bytes = expected_bytes
        self._topic = topic
        self._outlets = outlets
        self._slot_head = message_head(SLOT, source, fingerprint, stamped=stamped)
        self._message_head = message_head(MESSAGE, source, fingerprint, stamped=stamped)
        self._large_head = message_head(LARGE, source, fingerprint, stamped=stamped)
        self._rings: list[Ring] = []
        self._ring_count = 0
        self._columns: dict[int, Reader] = {}
        self._late: set[int] = set()
        """Columns of reliable readers that did not make room in time: they hold up nothing until they do."""
        self._inline: list[Reader] = []
        self._pins: deque[_Pin] = deque()
        self._returned: deque[Slot] = deque()
        self._private_bytes = {False: 0, True: 0}
        self._unavailable_until_s = 0.0
        # What follows from who reads and from the ring in use; see `_plan`.
        self._shares = 1
        self._ring: Ring | None = None
        self._pin_quota = 0
        self._slots_wanted = 4
        self._is_deep = False
        self._grants: list[tuple[int, int, int, bool]] = []
        self._inline_strict = False
        self._has_strict = False
        self._timeout_s = 0.0
        self._slot_outlets: list[Outlet] = []
        self._has_members = False
        self._inline_outlets: list[Outlet] = []

    def _plan(self) -> None:
        """Work out what every message needs, when readers or the ring have changed."""
        inline = {reader.request.strict for reader in self._inline}  # lossy and strict ones have a share each
        self._shares = max(1, len(self._columns) + len(inline))
        ring = self._ring = self._rings[-1] if self._rings else None
        self._is_deep = any(reader.request.quota >= DEEP_QUOTA for reader in self._columns.values())
        self._slots_wanted = self._wanted(ring.slot_bytes if ring is not None else DEEP_RING_BYTES)
        self._pin_quota = 0 if ring is None else max(1, (ring.slots - 1) // self._shares)

        def quota(reader: Reader) -> int:
            return min(self._pin_quota, reader.request.quota or self._pin_quota)

        self._grants = [
            (column, 1 << column, quota(reader), reader.request.strict)
            for column, reader in self._columns.items()
        ]
        if ring is not None:
            ring.ledger.plan([(column, quota) for column, _, quota, _ in self._grants])
        self._has_strict = any(r.request.strict for r in (*self._columns.values(), *self._inline))
        self._inline_strict = any(reader.request.strict for reader in self._inline)
        self._timeout_s = max((r.timeout_s for r in (*self._columns.values(), *self._inline)), default=0.0)
        self._slot_outlets = list(
            {reader.outlet for reader in self._columns.values() if reader.member is None}
        )
        self._has_members = any(reader.member is not None for reader in self._columns.values())
        self._inline_outlets = list({reader.outlet for reader in self._inline})

    def _wanted(self, slot_bytes: int) -> int:
        """How many slots of a size [bytes] the readers want: who keeps many gets more, in bounded memory."""
        wanted = 2 * self._shares + 2
        return max(wanted, min(DEEP_SLOTS, DEEP_RING_BYTES // slot_bytes)) if self._is_deep else wanted

    def admit(self, key: bytes, request: AttachKey, outlet: Outlet, join: Callable[[Reader], None]) -> Reader:
        """Take a reader in; with a column of the lease table and a try to `join` if it can map memory."""
        column = None
        if request.shared_memory and outlet.local:
            column = next((c for c in range(COLUMNS) if c not in self._columns), None)
        reader = Reader(key, request, outlet, column)
        if column is None:
            self._inline.append(reader)
        else:
            self._columns[column] = reader
            join(reader)
        self._plan()
        return reader

    def reserve(self, newcomer: Reader, sequence: int) -> None:
        """Make room for messages that are expected, before the first is sent to a reader.

        Args:
            newcomer: The reader, admitted; its answer will tell it of the rings.
            sequence: What the next message will have.
        """
        if self._expected_bytes and newcomer.column is not None:
            self._ring_for(self._expected_bytes, sequence, exact=True, newcomer=newcomer)

    def dismiss(self, reader: Reader) -> None:
        """A reader has left: whatever it held is free."""
        if reader.column is None:
            self._inline.remove(reader)
        else:
            del self._columns[reader.column]
            self._late.discard(reader.column)
            for ring in self._rings:
                ring.free_column(reader.column)
        self._plan()

    def answer(self, reader: Reader, sequence: int, latched: bytes) -> bytes:
        """The frame that tells a reader its column and the rings."""
        rings: tuple[RingPlace, ...] = ()
        if reader.column is not None:
            rings = tuple(ring.place for ring in self._rings[-RINGS_ALIVE:])
        return answer_frame(reader.key, AttachAnswer(sequence, reader.column, rings, latched))

    @staticmethod
    def _private(size: int) -> Slot:
        return Slot(np.empty(HEADER_SIZE + size, np.uint8)[HEADER_SIZE:], None, 0)

    def acquire(self, size: int, sequence: int, *, exact: bool, spare: bool = False) -> Slot | None:
        """Find memory for a message; the caller holds the lock.

        Args:
            size: Bytes that will be written at most.
            sequence: What the next message will have, for readers that are told of a new ring.
            exact: Whether all messages have this size, so that nothing is kept for growth.
            spare: Whether private memory serves a reliable reader where every slot is taken.

        Returns:
            None if every slot is taken.
        """
        if self._pins or self._returned:
            self._prune()
        ring = self._ring
        if ring is None or ring.slot_bytes < size or ring.slots < self._slots_wanted:
            ring = self._ring_for(size, sequence, exact=exact)
            if ring is None:
                return self._private(size)
        index = ring.acquire()
        if index >= 0:
            return Slot(ring.buffer(index), ring, index)
        # Others hold every slot (a reader joined, and the shares shrank): it travels without one.
        return self._private(size) if spare and self._has_strict else None

    def renew(self, slot: Slot, size: int, sequence: int) -> Slot | None:
        """Move a message out of a ring that readers were told to forget; the caller holds the lock.

        Returns:
            The slot itself if its ring is in use, another with the same bytes, or None if there is none; then
            the slot is given back.
        """
        if slot.ring is None or slot.ring in self._rings[-RINGS_ALIVE:]:
            return slot
        other = self.acquire(size, sequence, exact=False, spare=True)
        if other is not None:
            other.buffer[:size] = slot.buffer[:size]
        slot.ring.abandon(slot.number)
        return other

    def abandon(self, slot: Slot) -> None:
        """Give a slot back unpublished; the caller holds the lock."""
        if slot.ring is not None:
            slot.ring.abandon(slot.number)

    def give_back(self, slot: Slot) -> None:
        """Give a slot back unpublished, as soon as somebody asks for one.

        The caller holds no lock, or any: it may be the garbage collector, in the middle of anything.
        """
        self._returned.append(slot)

    def grant(self, ring: Ring | None) -> tuple[int, bool, bool]:
        """Decide who gets the next message; the caller holds the lock.

        Returns:
            The mask of columns that get a lease, whether a reliable reader has no room, whether some reader
            with shared memory is passed over.
        """
        if ring is None:
            return 0, self._has_strict and self._private_bytes[True] > PRIVATE_BYTES // 2, False
        full = self._inline_strict and self._pinned(ring, strict=True) >= self._pin_quota
        mask, passed_over = 0, False
        for column, bit, quota, strict in self._grants:
            if column in self._late:
                if not ring.has_room(column, max(1, quota // 2)):
                    passed_over = True
                    continue
                self._late.discard(column)
            if ring.has_room(column, quota):
                mask |= bit
            else:
                passed_over = True
                full |= strict
        if passed_over:
            ring.ledger.keep()
        return mask, full, passed_over

    @property
    def short_cut(self) -> Any:
        """The ledger of the ring if every message goes to all readers through its slots; see `gate.py`."""
        if self._ring is None or self._inline or self._late or self._ring.slots < self._slots_wanted:
            return None
        return self._ring.ledger

    def slot_of(self, number: int) -> Slot:
        """A slot of the ring in use that the short cut has written."""
        assert self._ring is not None
        return Slot(self._ring.buffer(number), self._ring, number)

    @property
    def is_leaving_out(self) -> bool:
        """Whether a reliable reader was late and gets nothing, as of the last `grant`."""
        return bool(self._late)

    def await_strict(self, ring: Ring | None, sleep: Callable[[Backoff], bool]) -> bool:
        """Wait until every reliable reader can take one more; the lock is held, and let go while sleeping.

        Args:
            ring: Where the message lies.
            sleep: Sleeps once, see `Patience.sleep`.

        Returns:
            False if one could not within its own time: it loses the message.
        """
        backoff, began_s = Backoff(self._timeout_s), time.monotonic()
        while self.grant(ring)[1]:
            if ring is not None and not self._worth_waiting(ring, time.monotonic() - began_s):
                if not self.grant(ring)[1]:  # it has made room since we looked
                    return not self.is_leaving_out
                self._give_up(ring)
                return False
            if not sleep(backoff):
                if ring is not None:
                    self._give_up(ring)
                return False
            self._prune()
        return not self.is_leaving_out

    def _give_up(self, ring: Ring) -> None:
        """Do not wait for the reliable readers that have no room now, until they have read about half."""
        self._late.update(
            column for column, _, quota, strict in self._grants if strict and not ring.has_room(column, quota)
        )

    def _worth_waiting(self, ring: Ring, waited_s: float) -> bool:
        """Whether a reader that has no room would have us wait for longer than this."""
        if self._inline_strict and self._pinned(ring, strict=True) >= self._pin_quota:
            return waited_s < self._timeout_s
        return any(
            strict and not ring.has_room(column, quota) and waited_s < self._columns[column].timeout_s
            for column, _, quota, strict in self._grants
        )

    def send(
        self,
        slot: Slot,
        size: int,
        mask: int,
        stamps: Stamps,
        send_strict: Callable[[Outlet, bytes, int], bool],
        send_to_ring: Callable[[bytes], bool],
    ) -> tuple[bool, bool]:
        """Hand a written slot to all readers; the caller holds the lock.

        Args:
            slot: Where the body is.
            size: Its bytes.
            mask: The columns that get a lease, from `grant`.
            stamps: Number and times of the message.
            send_strict: Sends one frame over a strict outlet with these flags, waiting for room.
            send_to_ring: Writes one frame into the ring, waiting for reliable readers.

        Returns:
            Whether every reliable reader was served in time, and whether some inline one was passed over.
        """
        on_time, passed_over = True, False
        ring = slot.ring
        if ring is None:
            for outlet in {*self._slot_outlets, *self._inline_outlets}:
                sent = self._send_joined(outlet, slot, size, stamps, send_strict)
                passed_over |= not sent
                on_time &= sent or not outlet.strict
            if self._has_members:
                frame = self._message_head + REST.pack(*stamps, size, 0) + slot.buffer[:size].tobytes()
                on_time &= send_to_ring(frame)
            return on_time, passed_over
        ring.commit(slot.number, stamps.sequence, size, mask)
        if self._columns:
            place = ring.ring_id << 32 | slot.number
            # The ring's place goes along: an announcement that was dropped on its way does no harm.
            frame = self._slot_head + _SLOT_REST.pack(*stamps, size, place, mask) + pack_place(ring.place)
            for outlet in self._slot_outlets:
                if not outlet.strict:
                    outlet.send(frame, DONTWAIT)
                elif not outlet.try_send(frame) and not send_strict(outlet, frame, 0):
                    on_time = False
            on_time &= send_to_ring(frame)
        for outlet in self._inline_outlets:
            sent = self._send_large(outlet, slot, size, REST.pack(*stamps, size, 0), send_strict)
            passed_over |= not sent
            on_time &= sent or not outlet.strict
        return on_time, passed_over

    def _send_joined(
        self,
        outlet: Outlet,
        slot: Slot,
        size: int,
        stamps: Stamps,
        send_strict: Callable[[Outlet, bytes, int], bool],
    ) -> bool:
        """Without a ring, send header and body as a plain message: every reader takes those.

        Returns:
            False if too much waits to be sent already, or a reliable reader has no room.
        """
        if self._private_bytes[outlet.strict] + size > max(PRIVATE_BYTES, 4 * size):
            return False
        whole = slot.buffer.base
        assert whole is not None
        header = self._message_head + REST.pack(*stamps, size, 0)
        whole[:HEADER_SIZE] = np.frombuffer(header, np.uint8)
        frame = whole[: HEADER_SIZE + size]
        try:
            tracker = outlet.lend(frame.data)
        except zmq.Again:
            return send_strict(outlet, frame.tobytes(), 0)
        assert tracker is not None
        self._private_bytes[outlet.strict] += size
        self._pins.append(_Pin(tracker, None, 0, size, outlet.strict))
        return True

    def _send_large(
        self,
        outlet: Outlet,
        slot: Slot,
        size: int,
        rest: bytes,
        send_strict: Callable[[Outlet, bytes, int], bool],
    ) -> bool:
        """Send header and body without a copy; False if too much waits to be sent already."""
        ring, body = slot.ring, slot.buffer[:size]
        if ring is not None and self._pinned(ring, strict=outlet.strict) >= self._pin_quota:
            ring, body = None, body.copy()
        if ring is None:
            if self._private_bytes[outlet.strict] + size > max(PRIVATE_BYTES, 4 * size):
                return False
            self._private_bytes[outlet.strict] += size
        head = self._large_head + rest
        on_time = True
        if outlet.strict:
            on_time = send_strict(outlet, head, SNDMORE)
        else:
            outlet.send(head, DONTWAIT | SNDMORE)
        if outlet.strict:  # who took the header gets the body, too
            outlet.socket.setsockopt(zmq.XPUB_NODROP, 0)
        try:
            tracker = outlet.lend(body.data)
        finally:
            if outlet.strict:
                outlet.socket.setsockopt(zmq.XPUB_NODROP, 1)
        assert tracker is not None
        if ring is not None:
            ring.pin(slot.number)
        self._pins.append(_Pin(tracker, ring, slot.number, size, outlet.strict))
        return on_time

    def prune(self) -> None:
        """Let go of what the sockets have sent, and of old rings; the caller holds the lock."""
        self._prune()
        while len(self._rings) > 1 and self._rings[0].idle:
            self._rings.pop(0).close()

    def _prune(self) -> None:
        while self._returned:
            self.abandon(self._returned.popleft())
        for _ in range(len(self._pins)):
            pin = self._pins.popleft()
            if not pin.tracker.done:
                self._pins.append(pin)
            elif pin.ring is not None:
                pin.ring.unpin(pin.slot)
            else:
                self._private_bytes[pin.strict] -= pin.size

    def _pinned(self, ring: Ring, *, strict: bool) -> int:
        return sum(pin.ring is ring and pin.strict is strict for pin in self._pins)

    def _is_awaited(self, ring: Ring) -> bool:
        """Whether a reliable reader holds slots of a ring, messages on their way to it included."""
        return any(strict and ring.outstanding(column) for column, _, _, strict in self._grants)

    def _ring_for(
        self, size: int, sequence: int, *, exact: bool, newcomer: Reader | None = None
    ) -> Ring | None:
        current, page = self._ring, mmap.PAGESIZE
        crowded = len(self._rings) >= RINGS_KEPT and self._is_awaited(self._rings[0])
        if crowded or time.monotonic() < self._unavailable_until_s:
            return current if current is not None and current.slot_bytes >= size else None
        slot_bytes = size if exact else size + size // 4
        if current is not None:
            if not exact and current.slot_bytes < size:  # messages grow: the next ring is to last
                slot_bytes = max(slot_bytes, size + min(size, GROWTH_BYTES))
            slot_bytes = max(slot_bytes, current.slot_bytes)
        slot_bytes = max(page, -(-slot_bytes // page) * page)
        slots = max(min(max(RING_BYTES // slot_bytes, 4), 64), self._wanted(slot_bytes))
        slots = max(4, min(slots, RING_BYTES_MAX // slot_bytes))
        if current is not None and current.slot_bytes >= size and current.slots >= slots:
            return current
        try:
            ring = Ring(
                self._source, self._ring_count, slots=slots, slot_bytes=slot_bytes, head=self._slot_head
            )
        except ShmUnavailable as error:
            if current is not None and current.slot_bytes >= size:
                self._slots_wanted = current.slots  # make do with what there is
                return current
            self._unavailable_until_s = time.monotonic() + RETRY_S
            self._outlets.note(f"{self._topic}: no shared memory, large messages go through sockets: {error}")
            return None
        self._ring_count += 1
        self._rings.append(ring)
        for old in self._rings[:-RINGS_ALIVE]:
            # Not while a loan lies there, or what a reliable reader has not read; `prune` closes it then.
            if not old.in_writing and not self._is_awaited(old):
                self._rings.remove(old)
                old.close()
        self._plan()
        for reader in self._columns.values():
            if reader is newcomer:
                continue
            frame = self.answer(reader, sequence, b"")
            if not reader.outlet.strict:
                reader.outlet.send(frame, DONTWAIT)
            else:
                reader.outlet.try_send(frame)  # without it the first descriptor tells
        return ring

    @property
    def taken_in(self) -> bool:
        """Whether all that was sent through slots has been given back; the caller holds the lock."""
        self._prune()
        return all(ring.idle for ring in self._rings)

    def close(self) -> None:
        """Let the rings go; readers keep what they have mapped. The caller holds the lock."""
        for ring in self._rings:
            ring.close()
        self._rings.clear()
        self._plan()
