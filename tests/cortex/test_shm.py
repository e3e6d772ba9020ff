"""Leases: who holds a slot, when it is free again, and that a message in use never changes."""

from __future__ import annotations

import gc
import logging
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from cortex import ledger, shm
from cortex.shm import Ring, RingView

SIZE = 4096


@pytest.fixture
def ring() -> Iterator[Ring]:
    made = Ring(7, 1, slots=4, slot_bytes=SIZE)
    yield made
    made.close()


@pytest.fixture
def reader(ring: Ring) -> Iterator[RingView]:
    made = attach(ring, 3)
    yield made
    made.close()


def attach(ring: Ring, column: int) -> RingView:
    return RingView(7, ring.ring_id, ring.slots, ring.slot_bytes, ring.pid, ring.fd, column)


def content(sequence: int, size: int = SIZE) -> np.ndarray:
    """What message `sequence` holds in these tests: no two in a row have a byte in common."""
    return np.full(size, sequence % 251, np.uint8)


def publish(ring: Ring, sequence: int, *columns: int, size: int = SIZE) -> int:
    slot = ring.acquire()
    assert slot >= 0
    ring.buffer(slot)[:size] = content(sequence, size)
    ring.commit(slot, sequence, size, sum(1 << column for column in columns))
    return slot


def test_a_message_arrives_and_is_given_back(ring: Ring, reader: RingView):
    slot = publish(ring, 0, 3, size=100)
    assert ring.outstanding(3) == 1
    message = reader.lease(slot, 0, 100)
    assert message.dtype == np.uint8
    assert message.tobytes() == content(0, 100).tobytes()
    assert not ring.idle
    assert not reader.idle
    del message
    assert ring.outstanding(3) == 0
    assert ring.idle
    assert reader.idle


KEEPERS: dict[str, Callable[[np.ndarray], object]] = {
    "slice": lambda message: message[10:20],
    "slice of a slice": lambda message: message[10:20][2:],
    "strided": lambda message: message[::7],
    "reshaped": lambda message: message.reshape(64, 64).T[3],
    "other dtype": lambda message: message.view(np.float32),
    "made from its buffer": lambda message: np.ndarray((5,), np.float64, message, 8),
    "frombuffer": lambda message: np.frombuffer(message, np.uint32, 4, 16),
    "memoryview": lambda message: memoryview(message)[5:],
    "memoryview, cast": lambda message: memoryview(message).cast("d"),
    "array of a memoryview": lambda message: np.asarray(memoryview(message)[8:]),
    "broadcast": lambda message: np.broadcast_to(message[:3], (9, 3)),
    "record": lambda message: message[:64].view(np.dtype([("a", "<f8"), ("b", "<i8")]))["b"],
    "base": lambda message: message.base,
}


@pytest.mark.parametrize("keeper", KEEPERS.values(), ids=KEEPERS.keys())
def test_any_view_keeps_the_lease(ring: Ring, reader: RingView, keeper: Callable[[np.ndarray], object]):
    kept = keeper(reader.lease(publish(ring, 0, 3), 0, SIZE))
    gc.collect()
    assert ring.outstanding(3) == 1
    del kept
    assert ring.outstanding(3) == 0


def test_copies_do_not_keep_the_lease(ring: Ring, reader: RingView):
    message = reader.lease(publish(ring, 0, 3), 0, SIZE)
    copies = message.copy(), message.tobytes(), message + 1, np.array(message)
    del message
    assert ring.outstanding(3) == 0
    assert copies[0].flags.writeable


def test_parts_of_the_root_die_silently(ring: Ring, reader: RingView):
    """Somebody who slices an array's `base` gets arrays that have no lease, but keep the root that has."""
    base = reader.lease(publish(ring, 0, 3), 0, SIZE).base
    if not isinstance(base, np.ndarray):
        pytest.skip("in C the root is no array")
    part = base[5:10]
    del base
    assert ring.outstanding(3) == 1
    del part
    assert ring.outstanding(3) == 0


def test_messages_cannot_be_written(ring: Ring, reader: RingView):
    message = reader.lease(publish(ring, 0, 3), 0, SIZE)
    with pytest.raises(ValueError, match="read-only"):
        message[0] = 1
    with pytest.raises(ValueError, match="read-only"):
        message.view(np.float32)[:] = 0.0
    with pytest.raises(ValueError, match="cannot set WRITEABLE"):
        message.flags.writeable = True
    with pytest.raises(TypeError, match="read-only"):
        memoryview(message)[0] = 1
    if isinstance(message.base, np.ndarray):  # in C it gives no access to the memory at all
        with pytest.raises(ValueError, match="cannot set WRITEABLE"):
            message.base.flags.writeable = True


def test_an_empty_message(ring: Ring, reader: RingView):
    message = reader.lease(publish(ring, 0, 3, size=0), 0, 0)
    assert message.shape == (0,)
    assert ring.outstanding(3) == 1
    del message
    assert ring.outstanding(3) == 0


@pytest.mark.parametrize(
    ("slot", "sequence", "size"),
    [(-1, 5, 9), (4, 5, 9), (2**32, 5, 9), (0, 5, -1), (0, 5, SIZE + 1), (0, 5, 2**63),
     (0, 4, 9), (0, 5, 8), (1, 5, 9)],
)  # fmt: skip
def test_a_descriptor_that_does_not_fit_is_refused(
    ring: Ring, reader: RingView, slot: int, sequence: int, size: int
):
    assert publish(ring, 5, 3, size=9) == 0
    with pytest.raises(ValueError, match=r"must be 0 to|should hold message"):
        reader.lease(slot, sequence, size)
    assert reader.lease(0, 5, 9).tobytes() == content(5, 9).tobytes()


def test_a_lease_is_not_delivered_twice(ring: Ring, reader: RingView):
    slot = publish(ring, 0, 3)
    message = reader.lease(slot, 0, SIZE)
    with pytest.raises(ValueError, match="delivered before"):
        reader.lease(slot, 0, SIZE)
    reader.release(slot)  # nor given back while it is in use
    assert ring.outstanding(3) == 1
    del message
    with pytest.raises(ValueError, match="lease byte 0"):
        reader.lease(slot, 0, SIZE)


def test_only_who_was_granted_can_lease(ring: Ring, reader: RingView):
    slot = publish(ring, 0, 2)
    with pytest.raises(ValueError, match="leased to column 3"):
        reader.lease(slot, 0, SIZE)
    assert ring.outstanding(2) == 1


def test_slots_are_written_in_turn_and_the_last_only_if_no_other_is_free(ring: Ring, reader: RingView):
    assert [publish(ring, k) for k in range(6)] == [0, 1, 2, 3, 0, 1]
    for sequence, slot in enumerate((2, 3, 0)):
        assert publish(ring, sequence, 3) == slot
    assert publish(ring, 3) == 1
    assert publish(ring, 4) == 1  # the last one, but all others are leased
    reader.release(3)
    assert publish(ring, 5) == 3


def test_no_slot_is_free(ring: Ring, reader: RingView):
    leased = [reader.lease(publish(ring, k, 3), k, SIZE) for k in range(4)]
    assert ring.acquire() == -1
    leased.pop(2)
    assert ring.acquire() == 2
    assert ring.acquire() == -1  # it is being written
    assert [int(message[0]) for message in leased] == [0, 1, 3]


def test_a_slot_is_free_when_all_its_readers_are_done(ring: Ring):
    readers = [attach(ring, column) for column in (0, 31, 63)]
    slots = [publish(ring, k, 0, 31, 63) for k in range(4)]
    for reader in readers:
        assert ring.acquire() == -1
        reader.release(slots[1])
    assert ring.acquire() == slots[1]
    for reader in readers:
        reader.close()


def test_quotas(ring: Ring, reader: RingView):
    assert ring.has_room(3, 1)
    held = [reader.lease(publish(ring, k, 3), k, SIZE) for k in range(3)]
    assert [ring.has_room(3, quota) for quota in (2, 3, 4)] == [False, False, True]
    held.pop(0)  # out of order: not the newest
    assert [ring.has_room(3, quota) for quota in (2, 3, 4)] == [False, True, True]
    assert ring.outstanding(3) == 2
    assert ring.outstanding(4) == 0
    held.clear()
    assert ring.has_room(3, 1)


def test_what_the_reader_sets_in_other_columns_does_not_matter(ring: Ring, reader: RingView):
    """A reader that writes nonsense into the lease table hurts itself only."""
    reader._table[:] = bytes([1]) * len(reader._table)
    assert ring.outstanding(3) == 0
    assert [publish(ring, k, 5) for k in range(4)] == [0, 1, 2, 3]
    assert ring.acquire() == -1
    ring.free_column(5)
    assert ring.acquire() == 0


def test_revoke(ring: Ring, reader: RingView):
    slot = publish(ring, 0, 3, 4)
    ring.revoke(slot, 1 << 3)
    assert (ring.outstanding(3), ring.outstanding(4)) == (0, 1)
    with pytest.raises(ValueError, match="lease byte 0"):
        reader.lease(slot, 0, SIZE)
    reader._table[slot * 64 + 3] = 1  # what a reader sets itself does not count
    for sequence in range(1, 4):
        publish(ring, sequence)
    ring.revoke(slot, 1 << 4)
    assert publish(ring, 4) == slot
    assert ring.outstanding(3) == ring.outstanding(4) == 0


def test_pins_are_counted(ring: Ring):
    slots = [publish(ring, k) for k in range(4)]
    for slot in (*slots, slots[2]):
        ring.pin(slot)
    assert ring.acquire() == -1
    ring.unpin(slots[2])
    assert ring.acquire() == -1
    assert not ring.idle
    ring.unpin(slots[2])
    assert ring.acquire() == slots[2]


def test_an_abandoned_slot_is_no_message(ring: Ring, reader: RingView):
    assert publish(ring, 0, 3) == 0
    reader.release(0)
    for _ in range(4):
        slot = ring.acquire()
        ring.buffer(slot)[:10] = 255
        ring.abandon(slot)
    assert reader.snapshot(0, 0, SIZE) is None
    assert ring.idle
    with pytest.raises(ValueError, match="acquire comes first"):
        ring.abandon(slot)


def test_commit_checks_its_arguments(ring: Ring):
    with pytest.raises(ValueError, match="acquire comes first"):
        ring.commit(0, 0, 0, 0)
    slot = ring.acquire()
    with pytest.raises(ValueError, match="body_size must be 0 to 4096, got 4097"):
        ring.commit(slot, 0, SIZE + 1, 0)
    with pytest.raises(ValueError, match="mask must be"):
        ring.commit(slot, 0, 0, 1 << 64)
    ring.commit(slot, 0, SIZE, (1 << 64) - 1)
    assert [ring.outstanding(column) for column in range(64)] == [1] * 64


def test_many_masks(ring: Ring):
    """More combinations of readers than the ring remembers."""
    for mask in range(1, 3000):
        slot = ring.acquire()
        ring.commit(slot, mask, 0, mask)
        assert [c for c in range(12) if ring.outstanding(c)] == [c for c in range(12) if mask >> c & 1]
        ring.revoke(slot, mask)


def test_heal_gives_back_what_was_dropped_on_the_way(ring: Ring, reader: RingView):
    slots = [publish(ring, k, 3) for k in range(4)]
    arrived = reader.lease(slots[2], 2, SIZE)  # 0 and 1 did not come, 3 may yet
    assert reader.heal(2) == 2
    assert reader.heal(2) == 0
    assert ring.outstanding(3) == 2
    assert reader.lease(slots[3], 3, SIZE)[0] == 3
    assert reader.heal(100) == 0
    assert arrived[0] == 2
    assert ring.outstanding(3) == 1


def test_snapshot(ring: Ring, reader: RingView):
    assert reader.snapshot(0, 0, 0) is None  # never written
    slot = publish(ring, 5, size=9)
    assert reader.snapshot(slot, 5, 9) == content(5, 9).tobytes()
    assert reader.snapshot(slot, 4, 9) is None
    assert reader.snapshot(slot, 5, 8) is None
    with pytest.raises(ValueError, match="slot must be 0 to 3, got 4"):
        reader.snapshot(4, 5, 9)
    for _ in range(4):
        slot = ring.acquire()
        assert reader.snapshot(slot, 5, 9) is None  # being written
        ring.commit(slot, 6, 9, 0)


class Overwriting:
    """Stands for a view's memory: while it is copied, the publisher acts."""

    def __init__(self, memory: memoryview, act: Callable[[], object]) -> None:
        self.memory, self.act = memory, act

    def __getitem__(self, part: slice) -> memoryview:
        self.act()
        return self.memory[part]


@pytest.mark.parametrize("complete", [False, True])
def test_snapshot_notices_a_writer_meanwhile(
    ring: Ring, reader: RingView, complete: bool, monkeypatch: pytest.MonkeyPatch
):
    slots = [publish(ring, k) for k in range(4)]

    def overwrite() -> None:
        assert ring.acquire() == slots[0]
        if complete:  # even with the same number and size
            ring.commit(slots[0], 0, SIZE, 0)

    with monkeypatch.context() as patch:
        patch.setattr(reader, "_memory", Overwriting(reader._memory, overwrite))
        assert reader.snapshot(slots[0], 0, SIZE) is None


def test_barriers_are_placed_where_processors_reorder(monkeypatch: pytest.MonkeyPatch):
    """State, content and leases are stored in order, as seen at the barriers another processor needs."""
    seen: list[tuple[int, int]] = []
    monkeypatch.setattr(shm, "native", None)  # in C they are there in any case
    for module in (shm, ledger):
        monkeypatch.setattr(module, "STORES_IN_ORDER", False)
    ring = Ring(7, 1, slots=4, slot_bytes=SIZE)
    reader = attach(ring, 0)

    def look() -> None:
        header = os.pread(ring.fd, 24, 4096 + 4 * 64)
        seen.append((int.from_bytes(header[:8], "little"), int.from_bytes(header[8:16], "little")))

    for module in (shm, ledger):
        monkeypatch.setattr(module, "fence", look)
    slot = ring.acquire()
    ring.commit(slot, 9, 5, 1)
    assert seen == [(1, 0), (1, 9), (2, 9)]
    assert reader.snapshot(slot, 9, 5) == bytes(5)
    assert reader.heal(10) == 1
    assert len(seen) == 6
    reader.close()
    ring.close()


def test_close_keeps_messages_in_use(ring: Ring, reader: RingView):
    """They must not change when the publisher uses the slots again, nor disturb who gets the column next."""
    messages = [reader.lease(publish(ring, k, 3), k, SIZE)[1:] for k in range(3)]
    publish(ring, 3, 3)  # on the way
    messages.pop(1)
    reader.close()
    reader.close()
    assert ring.outstanding(3) == 0
    successor = attach(ring, 3)
    later = [successor.lease(publish(ring, k, 3), k, SIZE) for k in range(100, 104)]
    assert [message.tobytes() for message in messages] == [content(k, SIZE - 1).tobytes() for k in (0, 2)]
    messages.clear()
    assert ring.outstanding(3) == 4
    assert [int(message[0]) for message in later] == [100, 101, 102, 103]
    for use in (
        lambda: reader.lease(0, 100, SIZE),
        lambda: reader.release(0),
        lambda: reader.snapshot(0, 100, SIZE),
    ):
        with pytest.raises(ValueError, match="closed"):
            use()
    assert reader.heal(1000) == 0
    assert reader.idle
    successor.close()


def test_close_without_memory_for_copies_is_logged(
    ring: Ring, reader: RingView, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    def fail(*_: object) -> None:
        raise OSError("no memory")

    message = reader.lease(publish(ring, 0, 3), 0, SIZE)
    monkeypatch.setattr(shm, "make_private", fail)
    with caplog.at_level(logging.WARNING, "cortex.shm"):
        reader.close()
    assert "cannot be copied and will change: no memory" in caplog.text
    assert ring.outstanding(3) == 0
    assert message[0] == 0


def test_memory_goes_with_its_last_user():
    def mapped() -> int:
        return Path("/proc/self/maps").read_text().count("/memfd:cortex-")

    def open_fds() -> int:
        return len(os.listdir("/proc/self/fd"))

    gc.collect()  # what other tests left in cycles
    before = mapped(), open_fds()
    ring = Ring(7, 1, slots=4, slot_bytes=SIZE)
    reader = attach(ring, 0)
    message = reader.lease(publish(ring, 0, 0), 0, SIZE)
    buffer = ring.buffer(2)
    ring.close()
    ring.close()
    assert ring.fd == -1
    assert message[0] == 0
    buffer[:] = 5  # still there
    reader.close()
    del buffer, message
    assert (mapped(), open_fds()) == before  # `ring` and `reader` themselves do not count
    forgotten = Ring(7, 2, slots=4, slot_bytes=SIZE)
    del forgotten
    assert (mapped(), open_fds()) == before


def test_a_closed_ring(ring: Ring):
    slot = ring.acquire()
    pinned = publish(ring, 0, 3)
    ring.pin(pinned)
    ring.close()
    assert ring.acquire() == -1
    with pytest.raises(ValueError, match="ring 1 is closed"):
        ring.commit(slot, 1, 0, 0)
    ring.abandon(slot)
    ring.unpin(pinned)
    ring.revoke(pinned, 1)
    ring.free_column(3)
    assert ring.outstanding(3) == 0
