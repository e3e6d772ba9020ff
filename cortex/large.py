"""Large messages of one publisher: written once into a slot, read there by local readers, sent to others."""

from __future__ import annotations

import logging
import mmap
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import zmq

from cortex.outlet import DONTWAIT, SNDMORE, Backoff, Outlet, Outlets
from cortex.shm import Ring, ShmUnavailable
from cortex.wire import (
    LARGE,
    MASK,
    SLOT,
    AttachAnswer,
    AttachKey,
    RingPlace,
    answer_frame,
    prefix,
)

logger = logging.getLogger(__name__)

COLUMNS = 64
RING_BYTES = 4 << 20
"""A ring of small slots takes this much, so that it stays in cache."""
RING_BYTES_MAX = 2 << 30
PRIVATE_BYTES = 64 << 20
"""Most memory outside rings that waits to be sent."""
RINGS_ALIVE = 4


@dataclass(eq=False)
class Reader:
    """One subscriber's link to this publisher."""

    key: bytes
    request: AttachKey
    outlet: Outlet
    column: int | None

    @property
    def timeout_s(self) -> float:
        """How long this reader may hold up the publisher [s]."""
        return self.request.timeout_ms / 1000.0 if self.request.strict else 0.0


@dataclass(eq=False)
class Slot:
    """Where a large message is written: a slot of a ring, or private memory where there is no ring."""

    buffer: np.ndarray
    ring: Ring | None
    index: int


@dataclass(eq=False)
class _Pin:
    """Memory that a socket still reads."""

    tracker: zmq.MessageTracker
    ring: Ring | None
    slot: int
    size: int


class LargeSender:
    """Slots, leases and zero-copy sends of one publisher.

    Everything that touches readers or sockets runs under the outlets' lock.
    """

    def __init__(self, source: int, *, stamped: bool, topic: str, outlets: Outlets) -> None:
        self._source = source
        self._topic = topic
        self._outlets = outlets
        self._slot_head = prefix(SLOT, source, stamped=stamped)
        self._large_head = prefix(LARGE, source, stamped=stamped)
        self._rings: list[Ring] = []
        self._ring_count = 0
        self._columns: dict[int, Reader] = {}
        self._inline: list[Reader] = []
        self._pins: deque[_Pin] = deque()
        self._private_bytes = 0
        self._unavailable = False
        # What follows from who reads and from the ring in use; see `_plan`.
        self._shares = 1
        self._ring: Ring | None = None
        self._pin_quota = 0
        self._grants: list[tuple[int, int, int]] = []
        self._strict: list[tuple[Reader, int]] = []
        self._slot_outlets: list[Outlet] = []
        self._inline_outlets: list[Outlet] = []

    def _plan(self) -> None:
        """Work out what every message needs, when readers or the ring have changed."""
        self._shares = max(1, len(self._columns) + bool(self._inline))
        ring = self._ring = self._rings[-1] if self._rings else None
        self._pin_quota = 0 if ring is None else max(1, (ring.slots - 1) // self._shares)

        def quota(reader: Reader) -> int:
            return min(self._pin_quota, reader.request.quota or self._pin_quota)

        self._grants = [(column, 1 << column, quota(reader)) for column, reader in self._columns.items()]
        readers = [*self._columns.values(), *self._inline]
        self._strict = [(reader, quota(reader)) for reader in readers if reader.request.strict]
        self._slot_outlets = list({reader.outlet for reader in self._columns.values()})
        self._inline_outlets = list({reader.outlet for reader in self._inline})

    def admit(self, key: bytes, request: AttachKey, outlet: Outlet) -> Reader:
        """Take a reader in, with a column of the lease table if it can map memory."""
        column = None
        if request.shared_memory and outlet.local and not self._unavailable:
            column = next((c for c in range(COLUMNS) if c not in self._columns), None)
        reader = Reader(key, request, outlet, column)
        if column is None:
            self._inline.append(reader)
        else:
            self._columns[column] = reader
        self._plan()
        return reader

    def dismiss(self, reader: Reader) -> None:
        """A reader has left: whatever it held is free."""
        if reader.column is None:
            self._inline.remove(reader)
        else:
            del self._columns[reader.column]
            for ring in self._rings:
                ring.free_column(reader.column)
        self._plan()

    def answer(self, reader: Reader, sequence: int, latched: bytes) -> bytes:
        """The frame that tells a reader its column and the rings."""
        rings: tuple[RingPlace, ...] = ()
        if reader.column is not None:
            rings = tuple(
                RingPlace(r.ring_id, r.slots, r.slot_bytes, r.pid, r.fd) for r in self._rings[-RINGS_ALIVE:]
            )
        return answer_frame(reader.key, AttachAnswer(sequence, reader.column, rings, latched))

    def acquire(self, size: int, sequence: int, *, exact: bool) -> Slot | None:
        """Find memory for a message; the caller holds the lock.

        Args:
            size: Bytes that will be written at most.
            sequence: What the next message will have, for readers that are told of a new ring.
            exact: Whether all messages have this size, so that nothing is kept for growth.

        Returns:
            None if every slot is taken (by loans that were not published).
        """
        self._prune()
        ring = self._ring_for(size, sequence, exact=exact)
        if ring is None:
            return Slot(np.empty(size, np.uint8), None, 0)
        index = ring.acquire()
        return None if index < 0 else Slot(ring.buffer(index), ring, index)

    def abandon(self, slot: Slot) -> None:
        """Give a slot back unpublished; the caller holds the lock."""
        if slot.ring is not None:
            slot.ring.abandon(slot.index)

    def await_strict(self, ring: Ring | None) -> bool:
        """Wait until every reliable reader can take one more; the lock is held, and let go while sleeping.

        Returns:
            False if one could not within its time: it loses the message.
        """
        full = [reader for reader, quota in self._strict if self._is_full(reader, quota, ring)]
        if not full:
            return True
        backoff = Backoff(max(reader.timeout_s for reader in full))
        while any(self._is_full(reader, quota, ring) for reader, quota in self._strict):
            self._outlets.lock.release()
            try:
                more = backoff.wait()
            finally:
                self._outlets.lock.acquire()
            if not more:
                return False
            self._outlets.refresh()
            self._prune()
        return True

    def send(
        self,
        slot: Slot,
        size: int,
        tail: Callable[[int], bytes],
        sequence: int,
        send_strict: Callable[[Outlet, bytes, int], bool],
    ) -> tuple[bool, bool]:
        """Hand a written slot to all readers; the caller holds the lock.

        Args:
            slot: Where the body is.
            size: Its bytes.
            tail: Makes the header's last 48 bytes, given `aux`.
            sequence: The message's number.
            send_strict: Sends one frame over a strict outlet with these flags, waiting for room.

        Returns:
            Whether every reliable reader was served in time, and whether some reader was passed over.
        """
        on_time, passed_over = True, False
        ring = slot.ring
        if ring is not None:
            mask = 0
            for column, bit, quota in self._grants:
                if ring.has_room(column, quota):
                    mask |= bit
                else:
                    passed_over = True
            ring.commit(slot.index, sequence, size, mask)
            if self._grants:
                frame = self._slot_head + tail(ring.ring_id << 32 | slot.index) + MASK.pack(mask)
                for outlet in self._slot_outlets:
                    if not outlet.strict:
                        outlet.send(frame, DONTWAIT)
                    elif not send_strict(outlet, frame, 0):
                        on_time = False
            outlets = self._inline_outlets
        else:
            outlets = list({*self._inline_outlets, *self._slot_outlets})
        for outlet in outlets:
            passed_over |= not self._send_large(outlet, slot, size, tail(0), send_strict)
        return on_time, passed_over

    def _send_large(
        self,
        outlet: Outlet,
        slot: Slot,
        size: int,
        tail: bytes,
        send_strict: Callable[[Outlet, bytes, int], bool],
    ) -> bool:
        """Send header and body without a copy; False if too much waits to be sent already."""
        ring, body = slot.ring, slot.buffer[:size]
        if ring is not None and self._pinned(ring) >= self._pin_quota:
            ring, body = None, body.copy()
        if ring is None:
            if self._private_bytes + size > max(PRIVATE_BYTES, 4 * size):
                return False
            self._private_bytes += size
        head = self._large_head + tail
        on_time = True
        if outlet.strict:
            on_time = send_strict(outlet, head, SNDMORE)
        else:
            outlet.send(head, DONTWAIT | SNDMORE)
        tracker = outlet.send(body.data, DONTWAIT, False, True)
        assert tracker is not None
        if ring is not None:
            ring.pin(slot.index)
        self._pins.append(_Pin(tracker, ring, slot.index, size))
        return on_time

    def prune(self) -> None:
        """Let go of what the sockets have sent, and of old rings; the caller holds the lock."""
        self._prune()
        while len(self._rings) > 1 and self._rings[0].idle:
            self._rings.pop(0).close()

    def _prune(self) -> None:
        for _ in range(len(self._pins)):
            pin = self._pins.popleft()
            if not pin.tracker.done:
                self._pins.append(pin)
            elif pin.ring is not None:
                pin.ring.unpin(pin.slot)
            else:
                self._private_bytes -= pin.size

    def _is_full(self, reader: Reader, quota: int, ring: Ring | None) -> bool:
        if ring is None:
            return self._private_bytes > PRIVATE_BYTES // 2
        if reader.column is not None:
            return not ring.has_room(reader.column, quota)
        return self._pinned(ring) >= self._pin_quota

    def _pinned(self, ring: Ring) -> int:
        return sum(pin.ring is ring for pin in self._pins)

    def _ring_for(self, size: int, sequence: int, *, exact: bool) -> Ring | None:
        if self._unavailable:
            return None
        current, wanted = self._ring, 2 * self._shares + 2
        if current is not None and current.slot_bytes >= size and current.slots >= wanted:
            return current
        page = mmap.PAGESIZE
        slot_bytes = size if exact else size + size // 4
        if current is not None:
            slot_bytes = max(slot_bytes, current.slot_bytes)
        slot_bytes = max(page, -(-slot_bytes // page) * page)
        slots = max(min(max(RING_BYTES // slot_bytes, 4), 64), wanted)
        slots = max(4, min(slots, RING_BYTES_MAX // slot_bytes))
        if current is not None and current.slot_bytes >= size and current.slots >= slots:
            return current
        try:
            ring = Ring(self._source, self._ring_count, slots=slots, slot_bytes=slot_bytes)
        except ShmUnavailable as error:
            if current is not None and current.slot_bytes >= size:
                return current
            self._unavailable = True
            logger.warning("%s: no shared memory, large messages go through sockets: %s", self._topic, error)
            return None
        self._ring_count += 1
        self._rings.append(ring)
        while len(self._rings) > RINGS_ALIVE:
            self._rings.pop(0).close()
        self._plan()
        for reader in self._columns.values():
            frame = self.answer(reader, sequence, b"")
            if not reader.outlet.strict:
                reader.outlet.send(frame, DONTWAIT)
            elif not reader.outlet.try_send(frame):
                reader.outlet.send_anyway(frame)
        return ring

    @property
    def taken_in(self) -> bool:
        """Whether all that was sent through slots has been given back; the caller holds the lock."""
        return all(ring.idle for ring in self._rings)

    def close(self) -> None:
        """Let the rings go; readers keep what they have mapped. The caller holds the lock."""
        for ring in self._rings:
            ring.close()
        self._rings.clear()
        self._plan()
