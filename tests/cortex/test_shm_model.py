"""A ring and its readers against a model of plain lists, under random operations."""

from __future__ import annotations

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from cortex.compiled import native
from cortex.shm import Ring, RingView

SIZE = 4096


def attach(ring: Ring, column: int) -> RingView:
    return RingView(7, ring.ring_id, ring.slots, ring.slot_bytes, ring.pid, ring.fd, column)


def content(sequence: int, size: int = SIZE) -> np.ndarray:
    """What message `sequence` holds: no two in a row have a byte in common."""
    return np.full(size, sequence % 251, np.uint8)


class RingModel(RuleBasedStateMachine):
    """A ring with three readers against a model of plain lists.

    Messages wait in order in each reader's queue; they are leased, given back unread, or dropped on the way.
    """

    def __init__(self) -> None:
        super().__init__()
        self.ring = Ring(7, 1, slots=4, slot_bytes=SIZE)
        self.ring.ledger.plan([])
        self.readers = [attach(self.ring, column) for column in range(3)]
        self.sequence = self.last = 0
        self.last = 3
        self.keeping = self.clock = 0
        self.written = [0] * 4
        self.queues: list[list[tuple[int, int]]] = [[], [], []]  # (slot, sequence) on the way
        self.dropped: list[list[tuple[int, int]]] = [[], [], []]
        self.views: list[list[tuple[int, int, np.ndarray]]] = [[], [], []]
        self.orphans: list[tuple[int, np.ndarray]] = []
        self.pins: list[int] = []

    def holds(self, column: int) -> list[int]:
        waiting = [slot for slot, _ in self.queues[column] + self.dropped[column]]
        return waiting + [slot for slot, _, _ in self.views[column]]

    @rule(mask=st.integers(0, 7), revoked=st.integers(0, 7), abandon=st.sampled_from([False, False, True]))
    def write(self, mask: int, revoked: int, abandon: bool) -> None:
        used = {slot for column in range(3) for slot in self.holds(column)} | set(self.pins)
        if native is None or self.keeping > 0:  # they take turns
            turn = [(self.last + k) % 4 for k in (1, 2, 3, 4)]
        else:  # the one that was written last
            turn = sorted(range(4), key=lambda slot: (-self.written[slot], slot))
        self.keeping -= 1
        expected = next((slot for slot in turn if slot not in used), -1)
        slot = self.ring.acquire()
        assert slot == expected
        if slot < 0:
            return
        self.last = slot
        self.clock += 1
        self.written[slot] = self.clock
        self.ring.buffer(slot)[:] = content(self.sequence)
        if abandon:
            self.ring.abandon(slot)
            return
        self.ring.commit(slot, self.sequence, SIZE, mask)
        if revoked & mask:
            self.ring.revoke(slot, revoked & mask)
        for column in range(3):
            if (mask & ~revoked) >> column & 1:
                self.queues[column].append((slot, self.sequence))
            else:
                copy = self.readers[column].snapshot(slot, self.sequence, SIZE)
                assert copy == content(self.sequence).tobytes()
        self.sequence += 1

    @rule(column=st.integers(0, 2))
    def deliver(self, column: int) -> None:
        if self.queues[column]:
            slot, sequence = self.queues[column].pop(0)
            message = self.readers[column].lease(slot, sequence, SIZE)[5:]
            self.views[column].append((slot, sequence, message))

    @rule(column=st.integers(0, 2))
    def give_back_unread(self, column: int) -> None:
        if self.queues[column]:
            self.readers[column].release(self.queues[column].pop(0)[0])

    @rule(column=st.integers(0, 2))
    def drop_on_the_way(self, column: int) -> None:
        if self.queues[column]:
            self.dropped[column].append(self.queues[column].pop(0))

    @rule(column=st.integers(0, 2))
    def heal(self, column: int) -> None:
        arrived = self.queues[column][0][1] if self.queues[column] else self.sequence
        gone = [item for item in self.dropped[column] if item[1] < arrived]
        assert self.readers[column].heal(arrived) == len(gone)
        self.dropped[column] = [item for item in self.dropped[column] if item not in gone]

    @rule(column=st.integers(0, 2), which=st.integers(0, 3))
    def let_go(self, column: int, which: int) -> None:
        if which < len(self.views[column]):
            del self.views[column][which]

    @rule(column=st.integers(0, 2))
    def replace_reader(self, column: int) -> None:
        self.readers[column].close()
        self.orphans += [(sequence, message) for _, sequence, message in self.views[column]]
        self.queues[column], self.dropped[column], self.views[column] = [], [], []
        self.ring.free_column(column)
        self.readers[column] = attach(self.ring, column)

    @rule()
    def keep(self) -> None:
        self.ring.ledger.keep()
        self.keeping = 4

    @rule(slot=st.integers(0, 3))
    def pin(self, slot: int) -> None:
        self.ring.pin(slot)
        self.pins.append(slot)

    @precondition(lambda self: self.pins)
    @rule()
    def unpin(self) -> None:
        self.ring.unpin(self.pins.pop())

    @precondition(lambda self: self.orphans)
    @rule()
    def forget_orphan(self) -> None:
        self.orphans.pop(0)

    @invariant()
    def counts_agree(self) -> None:
        for column in range(3):
            assert self.ring.outstanding(column) == len(self.holds(column))
            assert self.readers[column].idle is not bool(self.holds(column))
            assert self.readers[column].is_awaited is (len(self.holds(column)) > len(self.views[column]))
        assert self.ring.idle is not bool(self.pins or any(map(self.holds, range(3))))

    @invariant()
    def nothing_changes_in_use(self) -> None:
        for sequence, message in [item[1:] for views in self.views for item in views] + self.orphans:
            assert message.tobytes() == content(sequence, SIZE - 5).tobytes()

    def teardown(self) -> None:
        for reader in self.readers:
            reader.close()
        self.ring.close()


TestRingModel = RingModel.TestCase
TestRingModel.settings = settings(max_examples=200, stateful_step_count=50, deadline=None)
