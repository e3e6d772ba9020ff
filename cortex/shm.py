"""Rings of message slots in shared memory: a publisher writes each large message once, readers map it.

Layout and rules are section 6 of WIRE.md. A `Ring` belongs to one publisher, a `RingView` to one of its
readers. A message in a slot is leased to readers: one byte for each slot and column, set by the publisher
before it sends the slot's number, cleared by the reader when the last array that looks at the slot is gone.

Neither side trusts the other. The publisher keeps what it knows (state, grants) in its own memory and reads
back lease bytes only; the reader checks whatever it is told against what it can see.

Memory order. A slot's content reaches the reader together with the ZeroMQ message that names it, and passing
that message orders memory on every processor. The copy of a slot that is not leased (`RingView.snapshot`) and
`RingView.heal` rely on more: that stores become visible, and loads happen, in program order. x86 promises
that; elsewhere `fence` adds barriers, by reasoning, not by experience: no such machine was at hand.
"""

from __future__ import annotations

import logging
import mmap
import os
import threading
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from cortex.compiled import native
from cortex.ledger import NO_SEQUENCE, PyLedger
from cortex.memory import (
    COLUMNS,
    HEADER_WORDS,
    PAGE,
    SLOT_BYTES_MAX,
    SLOTS_MAX,
    STORES_IN_ORDER,
    Head,
    RingGone,
    ShmUnavailable,
    address_of,
    create_ring_memory,
    fence,
    in_forked_child,
    layout_of,
    make_private,
    open_ring_memory,
)
from cortex.wire import RingPlace, pack_place

__all__ = ["Ring", "RingGone", "RingView", "ShmUnavailable"]

_log = logging.getLogger(__name__)

_SEQUENCE, _SIZE = 1, 2  # where they are in a slot's header; the state is first
_U8 = np.dtype(np.uint8)

Bytes = npt.NDArray[np.uint8]


class Room(np.ndarray[Any, np.dtype[np.uint8]]):
    """A slot that is lent: the root of all arrays through which it can be written.

    Those keep it alive, because NumPy's `base` does not reach past a subclass.

    Attributes:
        on_forgotten: Called when the last of them is gone, by any thread in the middle of anything, as the
            garbage collector pleases: it must take no lock. None: the slot is not lent any more.
    """

    __slots__ = ("on_forgotten",)
    on_forgotten: Callable[[], object] | None

    def __del__(self) -> None:
        on_forgotten = getattr(self, "on_forgotten", None)  # a slice has none
        if on_forgotten is not None:
            on_forgotten()


class Ring:
    """The publisher's side of a ring of message slots.

    A message is written so: `acquire` a slot, fill its `buffer`, `commit` it to the columns of the readers
    that shall hold it, send the slot's number; `revoke` it from those to which it could not be sent. All
    methods may be called from any thread; after a fork the child's copy is closed.

    The lock also orders memory: taking it and giving it back are full barriers on x86, so that the state of a
    slot is odd before its content changes and until it is whole, even where a copy bypasses the cache.

    Args:
        source: The publisher's number.
        ring_id: Number of this ring among the publisher's, 0 to 2^32 - 1.
        slots: How many messages the ring holds.
        slot_bytes: Least size of a slot [bytes]; it is rounded up to a multiple of 4096.
        head: What descriptors begin with, for the short cut in C: the first 24 bytes of the header.

    Raises:
        ShmUnavailable: No such memory on this system, or not enough of it.
    """

    def __init__(self, source: int, ring_id: int, *, slots: int, slot_bytes: int, head: bytes = b"") -> None:
        if not 0 < source < 1 << 64:
            raise ValueError(f"source must be 1 to 2^64 - 1, got {source}")
        if not 0 <= ring_id < 1 << 32:
            raise ValueError(f"ring_id must be 0 to 2^32 - 1, got {ring_id}")
        if not 0 < slots <= SLOTS_MAX:
            raise ValueError(f"slots must be 1 to {SLOTS_MAX}, got {slots}")
        if not 0 < slot_bytes <= SLOT_BYTES_MAX:
            raise ValueError(f"slot_bytes must be 1 to {SLOT_BYTES_MAX}, got {slot_bytes}")
        self.source, self.ring_id, self.slots, self.pid = source, ring_id, slots, os.getpid()
        self.slot_bytes = -(-slot_bytes // PAGE) * PAGE
        layout = layout_of(slots, self.slot_bytes)
        self.fd, memory = create_ring_memory(source, ring_id, slots, self.slot_bytes)
        self._close_fd = weakref.finalize(self, os.close, self.fd)
        self._memory: Any = memory
        self._first = layout.slots
        self._buffers: list[Bytes] = [
            np.ndarray((self.slot_bytes,), _U8, memory, layout.slots + k * self.slot_bytes)
            for k in range(slots)
        ]
        self._lock = threading.RLock()  # reentrant: the garbage collector may call unpin anywhere
        self._closed = False
        self.place = RingPlace(ring_id, slots, self.slot_bytes, self.pid, self.fd)
        """What readers are told."""
        self.ledger: Any
        """A `Ledger`."""
        if native is None:
            self.ledger = PyLedger(memoryview(memory), slots, layout)
        else:
            self.ledger = native.Ledger(
                memory,
                slots,
                self.slot_bytes,
                *layout[:3],
                ring_id,
                head.ljust(24, b"\0"),
                pack_place(self.place),
            )
        in_forked_child(self, Ring._after_fork)

    def acquire(self) -> int:
        """Return a slot to write, or -1 if none is free.

        The slot is then being written until `commit` or `abandon`.
        """
        with self._lock:
            return -1 if self._closed else int(self.ledger.acquire())

    def buffer(self, slot: int) -> Bytes:
        """Return a slot's memory, writable, shape [slot_bytes]; write only between acquire and commit."""
        return self._buffers[slot]

    def room(self, slot: int) -> Room:
        """Return a slot's memory as `buffer` does, to be lent to someone who may forget it."""
        room: Room = Room((self.slot_bytes,), _U8, self._memory, self._first + slot * self.slot_bytes)
        return room

    @property
    def memory(self) -> Any:
        """The whole mapping, None after `close`: who keeps it keeps it mapped, and must not write to it."""
        return self._memory

    def commit(self, slot: int, sequence: int, body_size: int, mask: int) -> None:
        """Finish a slot and lease it to readers.

        Args:
            slot: From `acquire`.
            sequence: The message's number.
            body_size: Bytes of the message, at most `slot_bytes`.
            mask: Bit c is set for a reader with column c that shall hold the slot.
        """
        with self._lock:
            self._check_writing(slot)
            if not 0 <= body_size <= self.slot_bytes:
                raise ValueError(f"body_size must be 0 to {self.slot_bytes}, got {body_size}")
            _check_mask(mask)
            self.ledger.commit(slot, sequence, body_size, mask)

    def abandon(self, slot: int) -> None:
        """Give back a slot from `acquire` that will not be committed, as when a message cannot be encoded.

        Harmless after `close`.
        """
        with self._lock:
            if not self._closed:
                self._check_writing(slot)
                self.ledger.abandon(slot)

    def revoke(self, slot: int, mask: int) -> None:
        """Take the leases of `mask` back, because the message could not be sent."""
        with self._lock:
            _check_mask(mask)
            if not self._closed:
                self.ledger.revoke(slot, mask)

    def pin(self, slot: int) -> None:
        """Keep a slot from being written, because a socket still reads from it; pins are counted."""
        with self._lock:
            self.ledger.pin(slot)

    def unpin(self, slot: int) -> None:
        """Take back one `pin`; harmless after `close`."""
        with self._lock:
            self.ledger.unpin(slot)

    def outstanding(self, column: int) -> int:
        """Return how many slots the reader with this column holds now, messages on the way to it included."""
        with self._lock:
            return int(self.ledger.outstanding(column))

    def has_room(self, column: int, quota: int) -> bool:
        """Say whether a column holds fewer than `quota` slots; cheaper than `outstanding`, and as exact."""
        with self._lock:
            return bool(self.ledger.has_room(column, quota))

    def free_column(self, column: int) -> None:
        """Take back all leases of a column, because its reader left or died."""
        with self._lock:
            if not self._closed:
                self.ledger.free_column(column)

    @property
    def in_writing(self) -> bool:
        """Whether a slot is being written, or read by a socket."""
        with self._lock:
            return bool(self.ledger.is_busy())

    @property
    def idle(self) -> bool:
        """Whether no reader, socket or writer uses any slot, so that the ring can be closed unnoticed."""
        with self._lock:
            return not self.ledger.is_busy() and not any(map(self.ledger.outstanding, range(COLUMNS)))

    def close(self) -> None:
        """Close the descriptor and let go of the memory; buffers that someone still has stay valid."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self.fd = -1
            self.ledger.close()
            self._buffers, self._memory = [], None
            self._close_fd()

    def _check_writing(self, slot: int) -> None:
        if self._closed:
            raise ValueError(f"ring {self.ring_id} is closed")
        if not self.ledger.is_writing(slot):
            raise ValueError(f"slot {slot} is not being written: acquire comes first")

    def _after_fork(self) -> None:
        self._lock = threading.RLock()  # another thread of the parent may have had it
        self.close()


def _check_mask(mask: int) -> None:
    if not 0 <= mask < 1 << COLUMNS:
        raise ValueError(f"mask must be 0 to 2^{COLUMNS} - 1, got {mask}")


class _Lease(np.ndarray[Any, np.dtype[np.uint8]]):
    """The root of all arrays that look at one message; gives the slot back when it dies.

    Arrays made from it keep it alive, because NumPy's `base` does not reach past a subclass.
    """

    __slots__ = ("index", "table")
    index: int
    table: memoryview

    def __del__(self) -> None:
        # Runs in any thread, perhaps while the interpreter shuts down: one store, no lock, no global name.
        try:
            self.table[self.index] = 0
        except AttributeError:  # made from the root by someone who took it out of an array's `base`
            return


class RingView:
    """The reader's side of a ring: the slots can be read only, the leases of one column be given back.

    One thread at a time may call the methods; arrays may die in any thread, at exit, and after a fork (where
    they give nothing back: the lease is the parent's; a child that keeps a message must copy it).

    Args:
        source: The publisher's number.
        ring_id: Number of the ring.
        slots: Number of slots.
        slot_bytes: Size of a slot [bytes].
        pid: The publisher's process.
        fd: The ring's descriptor in that process.
        column: The reader's column in the lease table.

    Raises:
        RingGone: The publisher has no such ring any more.
        ShmUnavailable: The memory cannot be reached from here or is not what these arguments say.
    """

    def __init__(
        self, source: int, ring_id: int, slots: int, slot_bytes: int, pid: int, fd: int, column: int
    ) -> None:
        if not 0 < slots <= SLOTS_MAX or not 0 < slot_bytes <= SLOT_BYTES_MAX or slot_bytes % PAGE:
            raise ShmUnavailable(f"ring {ring_id}: {slots} slots of {slot_bytes} bytes are not possible")
        if not 0 <= column < COLUMNS or not 0 < pid < 1 << 31 or not 0 <= fd < 1 << 31:
            raise ShmUnavailable(f"ring {ring_id}: column {column}, process {pid}, descriptor {fd}")
        self.source, self.ring_id, self.slots, self.slot_bytes = source, ring_id, slots, slot_bytes
        self.column = column
        layout = layout_of(slots, slot_bytes)
        head, memory = open_ring_memory(source, ring_id, slots, slot_bytes, pid=pid, fd=fd)
        self._head: Head | None = head
        view = memoryview(head)
        self._table = view[layout.leases : layout.headers]
        self._own = self._table[column::COLUMNS]
        self._headers = view[layout.headers : layout.headers + slots * HEADER_WORDS * 8].cast("Q")
        self._memory = memoryview(memory)[layout.slots :]
        # Sequence of the message last leased from a slot; in memory that the short cut in C can look at.
        self._delivered = memoryview(bytearray(8 * slots)).cast("Q")
        for slot in range(slots):
            self._delivered[slot] = NO_SEQUENCE
        self.short_cut: Any = None
        """`SlotView` of `_ring.c`, which leases slots, too; None where there is no such thing."""
        if native is not None:
            self.short_cut = native.SlotView(
                head, self._memory, self._delivered, slots, slot_bytes, *layout[:2], ring_id, column
            )

    def lease(self, slot: int, sequence: int, size: int) -> Bytes:
        """Return the message in a slot that was granted to this reader, read-only, shape [size].

        The slot is given back when the array and all that was made from it without copying are gone.

        Raises:
            ValueError: The slot does not hold that message, or not for this reader.
        """
        self._check(slot, size)
        index = slot * COLUMNS + self.column
        headers, word = self._headers, slot * HEADER_WORDS
        if self._table[index] != 1 or headers[word + _SEQUENCE] != sequence or headers[word + _SIZE] != size:
            raise ValueError(
                f"slot {slot} of ring {self.ring_id} should hold message {sequence} of {size} bytes, leased "
                f"to column {self.column}, but holds message {headers[word + _SEQUENCE]} of "
                f"{headers[word + _SIZE]} bytes, lease byte {self._table[index]}"
            )
        if self._delivered[slot] == sequence:
            raise ValueError(f"message {sequence} in slot {slot} of ring {self.ring_id} was delivered before")
        if self.short_cut is not None:
            found: Bytes | None = self.short_cut.lease(slot, sequence, size)
            if found is None:
                raise ValueError(f"slot {slot} of ring {self.ring_id} was taken back")
            return found
        root = _Lease((size,), _U8, self._memory, slot * self.slot_bytes)
        root.table, root.index = self._table, index
        self._delivered[slot] = sequence
        view: Bytes = root.view(np.ndarray)
        return view

    def release(self, slot: int) -> None:
        """Give a granted slot back that was not leased."""
        self._check(slot, 0)
        if self._headers[slot * HEADER_WORDS + _SEQUENCE] != self._delivered[slot]:
            self._table[slot * COLUMNS + self.column] = 0

    def heal(self, before_sequence: int) -> int:
        """Give back the slots of messages that were granted but dropped on the way, and return their number.

        Args:
            before_sequence: Sequence of a message that arrived: what is older and not here yet never comes.
        """
        if self._head is None:
            return 0
        leased = self._own.tobytes()
        if not STORES_IN_ORDER:
            fence()
        healed = 0
        slot = leased.find(1)
        while slot >= 0:
            sequence = self._headers[slot * HEADER_WORDS + _SEQUENCE]
            # A delivered one is left to its array, which may be giving it back at this moment.
            if sequence < before_sequence and sequence != self._delivered[slot]:
                self._own[slot] = 0
                healed += 1
            slot = leased.find(1, slot + 1)
        return healed

    def snapshot(self, slot: int, sequence: int, size: int) -> bytes | None:
        """Copy a message that is not leased to this reader; None if it is gone or goes meanwhile."""
        self._check(slot, size)
        headers, word = self._headers, slot * HEADER_WORDS
        state = headers[word]
        if not state or state & 1 or headers[word + _SEQUENCE] != sequence or headers[word + _SIZE] != size:
            return None
        if not STORES_IN_ORDER:
            fence()
        start = slot * self.slot_bytes
        body = self._memory[start : start + size].tobytes()
        if not STORES_IN_ORDER:
            fence()
        return body if headers[word] == state else None

    @property
    def idle(self) -> bool:
        """Whether this reader holds no slot: no array is alive, and no granted message on its way."""
        return 1 not in self._own.tobytes()

    @property
    def is_awaited(self) -> bool:
        """Whether a granted message has not been delivered yet."""
        return self._own.tobytes().count(1) > len(self._in_use())

    def close(self) -> None:
        """Give all leases back and let go of the memory.

        Messages that are still in use stay valid: they become private copies, in place. Call this before the
        publisher can learn that the reader is gone, since it then writes to the reader's slots.

        Raises:
            OSError: The kernel has no memory left for a few pages.
        """
        head, self._head = self._head, None
        if head is None:
            return
        in_use, leased = self._in_use(), self._own.tobytes()
        try:
            first = address_of(self._memory)
            for slot in in_use:
                make_private(first + slot * self.slot_bytes, self.slot_bytes, mmap.PROT_READ)
        except OSError as error:
            _log.warning("ring %d: messages in use cannot be copied and will change: %s", self.ring_id, error)
        slot = leased.find(1)
        while slot >= 0:  # no other byte: the publisher may be granting a slot at this moment
            self._own[slot] = 0
            slot = leased.find(1, slot + 1)
        self._table = self._own = self._headers = self._memory = self._delivered = memoryview(b"")
        self.short_cut = None
        if in_use:
            head.detach()  # when their arrays die, the column may be another reader's

    def _in_use(self) -> list[int]:
        """Slots whose messages were delivered and not given back."""
        leased, headers = self._own.tobytes(), self._headers
        return [
            slot
            for slot, sequence in enumerate(self._delivered)
            if leased[slot] and headers[slot * HEADER_WORDS + _SEQUENCE] == sequence
        ]

    def _check(self, slot: int, size: int) -> None:
        if self._head is None:
            raise ValueError(f"ring {self.ring_id} is closed")
        if not 0 <= slot < self.slots:
            raise ValueError(f"slot must be 0 to {self.slots - 1}, got {slot}")
        if not 0 <= size <= self.slot_bytes:
            raise ValueError(f"size must be 0 to {self.slot_bytes}, got {size}")
