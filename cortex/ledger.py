"""The publisher's account of the slots of a ring: which are free, written, leased to whom.

The rules are section 6 of WIRE.md. `_ring.c` has the same as `Ledger`, used where that was compiled; it also
takes the free slot that was written last, which is still in the cache, where this one takes turns.
"""

from __future__ import annotations

from typing import Protocol

from cortex.memory import COLUMNS, HEADER_WORDS, STORES_IN_ORDER, Layout, fence

_SEQUENCE, _SIZE = 1, 2  # where they are in a slot's header; the state is first
NO_SEQUENCE = (1 << 64) - 1
"""What the header of a slot says whose content is not whole."""


class Ledger(Protocol):
    """Slots of one ring. `Ring` checks the arguments, and lets one thread in at a time."""

    def acquire(self) -> int:
        """Return a free slot, which is then being written until `commit` or `abandon`; -1: none is free."""
        ...

    def commit(self, slot: int, sequence: int, size: int, mask: int, /) -> None:
        """Finish a slot, and lease it to the columns whose bits are set."""
        ...

    def abandon(self, slot: int, /) -> None:
        """Give back a slot that was written in part."""
        ...

    def is_writing(self, slot: int, /) -> bool:
        """Whether a slot is being written."""
        ...

    def revoke(self, slot: int, mask: int, /) -> None:
        """Take leases back."""
        ...

    def pin(self, slot: int, /) -> None:
        """Keep a slot from being written; counted."""
        ...

    def unpin(self, slot: int, /) -> None:
        """Take back one `pin`."""
        ...

    def outstanding(self, column: int, /) -> int:
        """Return how many slots a column holds."""
        ...

    def has_room(self, column: int, quota: int, /) -> bool:
        """Say whether a column holds fewer than `quota` slots."""
        ...

    def free_column(self, column: int, /) -> None:
        """Take back all leases of a column."""
        ...

    def is_busy(self) -> bool:
        """Whether any slot is being written, or pinned."""
        ...

    def plan(self, grants: list[tuple[int, int]], /) -> None:
        """Tell the short cut in C which columns get every message, and their quotas.

        From then on it takes the slot that was written last, which is in the cache.
        """
        ...

    def keep(self) -> None:
        """Write the slots that were written longest ago first, once through the ring: some may be copied."""
        ...

    def close(self) -> None:
        """Lend no slot any more."""
        ...


class PyLedger:
    """As `Ledger`.

    Args:
        view: The memory of the ring.
        slots: Number of slots.
        layout: Where its parts are.
    """

    def __init__(self, view: memoryview, slots: int, layout: Layout) -> None:
        table = view[layout.leases : layout.headers]
        self._rows = [table[i : i + COLUMNS] for i in range(0, slots * COLUMNS, COLUMNS)]
        self._headers = view[layout.headers : layout.headers + slots * HEADER_WORDS * 8].cast("Q")
        self._last = slots - 1
        self._state = [0] * slots
        self._busy = [0] * slots  # pins, and one more while the slot is being written
        self._granted: list[tuple[int, ...]] = [()] * slots  # columns of a slot's message, some given back
        self._held: list[set[int]] = [set() for _ in range(COLUMNS)]  # slots of a column, some given back
        self._columns_of: dict[int, tuple[int, ...]] = {0: ()}

    def acquire(self) -> int:
        """Return a free slot, the longest written first; -1: none is free."""
        slot = self._last
        for _ in self._rows:
            slot += 1
            if slot == len(self._rows):
                slot = 0
            if self._busy[slot]:
                continue
            row = self._rows[slot]
            for column in self._granted[slot]:
                if row[column]:
                    break
            else:
                self._last = slot
                self._busy[slot] = 1
                state = self._state[slot] = self._state[slot] + 1
                self._headers[slot * HEADER_WORDS] = state
                if not STORES_IN_ORDER:
                    fence()
                return slot
        return -1

    def commit(self, slot: int, sequence: int, size: int, mask: int, /) -> None:
        """Finish a slot, and lease it to the columns whose bits are set."""
        columns = self._columns_of.get(mask)
        if columns is None:
            columns = self._columns(mask)
        headers, word = self._headers, slot * HEADER_WORDS
        headers[word + _SEQUENCE] = sequence
        headers[word + _SIZE] = size
        if not STORES_IN_ORDER:
            fence()
        headers[word] = self._state[slot] = self._state[slot] + 1
        if columns:
            if not STORES_IN_ORDER:
                fence()
            row, held = self._rows[slot], self._held
            for column in columns:
                row[column] = 1
                held[column].add(slot)
        self._granted[slot] = columns
        self._busy[slot] -= 1

    def abandon(self, slot: int, /) -> None:
        """Give back a slot: what was there is overwritten in part, so nobody may copy it."""
        self.commit(slot, NO_SEQUENCE, 0, 0)

    def is_writing(self, slot: int, /) -> bool:
        """Whether a slot is being written."""
        return bool(self._state[slot] & 1)

    def revoke(self, slot: int, mask: int, /) -> None:
        """Take leases back."""
        revoked = self._columns(mask)
        for column in revoked:
            self._rows[slot][column] = 0
            self._held[column].discard(slot)
        self._granted[slot] = tuple(c for c in self._granted[slot] if c not in revoked)

    def pin(self, slot: int, /) -> None:
        """Keep a slot from being written; counted."""
        self._busy[slot] += 1

    def unpin(self, slot: int, /) -> None:
        """Take back one `pin`."""
        self._busy[slot] -= 1

    def outstanding(self, column: int, /) -> int:
        """Return how many slots a column holds."""
        held = self._held[column]
        if held:
            rows = self._rows
            held.difference_update([slot for slot in held if not rows[slot][column]])
        return len(held)

    def has_room(self, column: int, quota: int, /) -> bool:
        """Say whether a column holds fewer than `quota` slots."""
        # What was granted is an upper bound of what is held: most calls need no look at the lease bytes.
        return len(self._held[column]) < quota or self.outstanding(column) < quota

    def free_column(self, column: int, /) -> None:
        """Take back all leases of a column."""
        for row in self._rows:
            row[column] = 0  # those not granted too: the next reader with this column shall find none
        self._held[column].clear()

    def is_busy(self) -> bool:
        """Whether any slot is being written, or pinned."""
        return any(self._busy)

    def plan(self, grants: list[tuple[int, int]], /) -> None:
        """There is no short cut to tell."""

    def keep(self) -> None:
        """Slots take turns anyway."""

    def close(self) -> None:
        """Lend no slot any more, and let go of the memory."""
        self._rows, self._headers = [], memoryview(b"")
        for held in self._held:
            held.clear()

    def _columns(self, mask: int) -> tuple[int, ...]:
        """Return the columns of a mask and remember them."""
        if len(self._columns_of) >= 1024:  # masks of readers long gone
            self._columns_of = {0: ()}
        columns = self._columns_of[mask] = tuple(c for c in range(COLUMNS) if mask >> c & 1)
        return columns
