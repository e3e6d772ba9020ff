"""Rings between processes and threads that are killed, fork, end at any moment, or race with each other.

Run as a script, this module is the other process: its argument names one of the functions `as_...`.
"""

from __future__ import annotations

import gc
import os
import queue
import random
import select
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from cortex.ledger import PyLedger
from cortex.shm import Ring, RingView

ROOT = Path(__file__).resolve().parents[2]
SOURCE, SLOTS, SIZE = 11, 4, 65536
DEADLINE_S = 60.0


class Other:
    """Another process that runs one of the functions below."""

    def __init__(self, role: Callable[..., None], *arguments: int) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-W", "error", __file__, role.__name__, *map(str, arguments)],
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,
            start_new_session=True,
        )
        self._rest = b""

    def say(self, *numbers: int) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write((" ".join(map(str, numbers)) + "\n").encode())

    def hear(self) -> list[int]:
        """The numbers on the next line that it prints."""
        assert self.process.stdout is not None
        deadline = time.monotonic() + DEADLINE_S
        while b"\n" not in self._rest:
            ready = select.select([self.process.stdout], [], [], max(0.0, deadline - time.monotonic()))[0]
            assert ready, "the other process is silent"
            chunk = os.read(self.process.stdout.fileno(), 65536)
            if not chunk:
                assert self.process.stderr is not None
                raise AssertionError(f"the other process ended: {self.process.stderr.read().decode()}")
            self._rest += chunk
        line, self._rest = self._rest.split(b"\n", 1)
        return [int(word) for word in line.split()]

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        assert self.process.wait(DEADLINE_S) == -signal.SIGKILL

    def finish(self) -> None:
        """Close its input, and expect that it ends well and in silence."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.stdin = None
        _, errors = self.process.communicate(timeout=DEADLINE_S)
        assert (self.process.returncode, errors.decode()) == (0, "")


@contextmanager
def other(role: Callable[..., None], *arguments: int) -> Iterator[Other]:
    made = Other(role, *arguments)
    try:
        yield made
    finally:
        with suppress(ProcessLookupError):  # its children too, should it have any
            os.killpg(made.process.pid, signal.SIGKILL)
        for stream in (made.process.stdin, made.process.stdout, made.process.stderr):
            if stream is not None:
                stream.close()
        made.process.wait(DEADLINE_S)


def say(*numbers: int) -> None:
    sys.stdout.write(" ".join(map(str, numbers)) + "\n")
    sys.stdout.flush()


def hear() -> list[int]:
    return [int(word) for word in sys.stdin.readline().split()]


def attach(ring: Ring, column: int) -> RingView:
    return RingView(SOURCE, ring.ring_id, ring.slots, ring.slot_bytes, ring.pid, ring.fd, column)


def publish(ring: Ring, sequence: int, mask: int) -> int:
    """Write a message whose every word depends on its number; -1 if no slot is free."""
    slot = ring.acquire()
    if slot >= 0:
        ring.buffer(slot).view(np.uint64)[:] = sequence
        ring.commit(slot, sequence, SIZE, mask)
    return slot


def is_whole(message: np.ndarray | bytes, sequence: int) -> bool:
    return bool((np.frombuffer(message, np.uint64) == sequence).all())


def our_memory() -> int:
    return Path("/proc/self/maps").read_text().count("/memfd:cortex-")


def as_reader(pid: int, fd: int, column: int) -> None:
    """Lease what it is told of, and keep the newest two."""
    view = RingView(SOURCE, 1, SLOTS, SIZE, pid, fd, column)
    kept = []
    say(0)
    while numbers := hear():
        slot, sequence = numbers
        kept.append(view.lease(slot, sequence, SIZE))
        assert is_whole(kept[-1], sequence)
        del kept[:-2]
        say(sequence)


def as_writer() -> None:
    """Publish three messages and wait."""
    ring = Ring(SOURCE, 1, slots=SLOTS, slot_bytes=SIZE)
    for sequence in range(3):
        publish(ring, sequence, 1)
    ring.acquire()  # and die while writing
    say(ring.pid, ring.fd)
    hear()


def as_fast_writer() -> None:
    """Overwrite all slots again and again, whatever the readers do, until the input ends."""
    ring = Ring(SOURCE, 1, slots=2, slot_bytes=SIZE)
    say(ring.pid, ring.fd)
    sequence = 0
    while not select.select([sys.stdin], [], [], 0.0)[0]:
        for _ in range(100):
            publish(ring, sequence, 0)
            sequence += 1


def as_leasing_writer(count: int) -> None:
    """Publish to column 0 as slots become free, and tell slot and number."""
    ring = Ring(SOURCE, 1, slots=SLOTS, slot_bytes=SIZE)
    say(ring.pid, ring.fd)
    hear()
    deadline = time.monotonic() + DEADLINE_S
    sequence = 0
    while sequence < count:
        slot = publish(ring, sequence, 1)
        if slot >= 0:
            say(slot, sequence)
            sequence += 1
        else:
            time.sleep(0)
            assert time.monotonic() < deadline
    hear()
    assert ring.idle


def as_forking() -> None:
    """Fork while a message is leased, while another thread has the ring's lock, and with a slot acquired."""
    ring = Ring(SOURCE, 1, slots=SLOTS, slot_bytes=SIZE)
    view = attach(ring, 0)
    message = view.lease(publish(ring, 5, 1), 5, SIZE)
    publish(ring, 6, 1)  # on the way
    entered, leave = threading.Event(), threading.Event()

    def hold() -> None:
        with ring._lock:
            entered.set()
            leave.wait(DEADLINE_S)

    thread = threading.Thread(target=hold)
    thread.start()
    entered.wait(DEADLINE_S)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12: threads and fork
        child = os.fork()
    if child == 0:
        signal.alarm(10)
        failed = 1
        try:
            assert is_whole(message, 5)
            assert ring.acquire() == -1
            assert ring.fd == -1
            del message
            view.release(1)
            view.heal(100)
            view.close()
            failed = 0
        finally:
            os._exit(failed)
    leave.set()
    thread.join(DEADLINE_S)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert ring.outstanding(0) == 2
    assert is_whole(message, 5)
    assert publish(ring, 7, 0) == 2
    del message
    assert ring.outstanding(0) == 1


def as_ending() -> None:
    """End with leases in globals, cycles and a running thread."""
    ring = Ring(SOURCE, 1, slots=SLOTS, slot_bytes=SIZE)
    view = attach(ring, 0)
    messages = [view.lease(publish(ring, k, 1), k, SIZE) for k in range(4)]
    globals()["kept"] = messages[0][5:]
    cycle = [messages[1]]
    cycle.append(cycle)  # type: ignore[arg-type]
    sys.modules["odd"] = messages[2]  # type: ignore[assignment]
    threading.Thread(target=lambda kept=messages[3]: time.sleep(60.0), daemon=True).start()
    publish.kept = messages  # type: ignore[attr-defined]


def test_a_killed_reader_gives_everything_back():
    """Killed at a random moment, five times; a second reader and its messages do not notice."""
    chance = random.Random(1)
    ring = Ring(SOURCE, 1, slots=SLOTS, slot_bytes=SIZE)
    survivor = attach(ring, 1)
    sequence = 0
    for _ in range(5):
        kept = survivor.lease(publish(ring, sequence, 2), sequence, SIZE)
        kept_sequence = sequence
        sequence += 1
        with other(as_reader, ring.pid, ring.fd, 0) as reader:
            reader.hear()
            for _ in range(chance.randrange(3, 20)):
                slot = publish(ring, sequence, 1)
                if slot < 0:
                    reader.hear()
                    continue
                reader.say(slot, sequence)
                sequence += 1
            reader.kill()
        assert ring.outstanding(0) > 0
        ring.free_column(0)
        assert ring.outstanding(0) == 0
        free = {publish(ring, sequence + k, 0) for k in range(10)}
        assert len(free - {-1}) == 3
        sequence += 10
        assert is_whole(kept, kept_sequence)
        del kept
    assert ring.idle
    survivor.close()
    ring.close()


def test_messages_outlive_a_killed_writer():
    gc.collect()  # what other tests left in cycles
    before = our_memory()
    with other(as_writer) as writer:
        pid, fd = writer.hear()
        view = RingView(SOURCE, 1, SLOTS, SIZE, pid, fd, 0)
        first = view.lease(0, 0, SIZE)
        writer.kill()
    second = view.lease(1, 1, SIZE)
    assert is_whole(first, 0)
    assert is_whole(second, 1)
    assert view.snapshot(3, 3, SIZE) is None
    del first
    view.close()
    assert is_whole(second, 1)
    del view, second
    assert our_memory() == before
    assert not [name for name in os.listdir("/dev/shm") if "cortex" in name]


def test_copies_of_slots_are_never_torn():
    """A reader without leases races with a writer; what it accepts is whole, what is not is refused."""
    accepted = refused = torn = 0
    with other(as_fast_writer) as writer:
        pid, fd = writer.hear()
        view = RingView(SOURCE, 1, 2, SIZE, pid, fd, 0)
        head = os.open(f"/proc/{pid}/fd/{fd}", os.O_RDONLY)
        deadline = time.monotonic() + DEADLINE_S
        slot = 0
        while accepted < 300 or refused < 300:
            assert time.monotonic() < deadline, f"accepted {accepted}, refused {refused}"
            slot = 1 - slot
            header = np.frombuffer(os.pread(head, 24, 4096 + 2 * 64 + slot * 64), np.uint64)
            sequence = int(header[1])
            body = view.snapshot(slot, sequence, SIZE)
            if body is None:
                refused += 1
            else:
                accepted += 1
                torn += not is_whole(body, sequence)
        os.close(head)
        writer.finish()
        view.close()
    assert torn == 0


def test_leased_messages_never_change():
    """A writer fills each slot as soon as it is free, a reader holds some for a while and looks again."""
    chance = random.Random(2)
    held: list[tuple[int, np.ndarray]] = []
    with other(as_leasing_writer, 3000) as writer:
        pid, fd = writer.hear()
        view = RingView(SOURCE, 1, SLOTS, SIZE, pid, fd, 0)
        writer.say(0)
        for expected in range(3000):
            slot, sequence = writer.hear()
            assert sequence == expected
            held.append((sequence, view.lease(slot, sequence, SIZE)))
            while len(held) == SLOTS or (held and chance.random() < 0.5):
                sequence, message = held.pop(chance.randrange(len(held)))
                assert is_whole(message, sequence)
                del message
        held.clear()
        writer.finish()
        view.close()


def test_a_forked_child_leaves_the_leases_to_its_parent():
    with other(as_forking) as process:
        process.finish()


def test_ending_with_leases_is_silent():
    with other(as_ending) as process:
        process.finish()


def test_leases_die_in_other_threads():
    """One thread publishes and leases, four check and drop; nothing changes in use, nothing stays behind."""
    ring = Ring(SOURCE, 1, slots=8, slot_bytes=4096)
    reader = attach(ring, 0)
    work: queue.SimpleQueue[tuple[int, np.ndarray] | None] = queue.SimpleQueue()
    wrong: list[int] = []

    def check() -> None:
        kept: list[np.ndarray] = []
        chance = random.Random(threading.get_ident())
        while (item := work.get()) is not None:
            sequence, message = item
            kept.append(message)
            del item
            if not (message == sequence % 251).all():
                wrong.append(sequence)
            del message
            if len(kept) > 1:
                kept.pop(chance.randrange(2))

    threads = [threading.Thread(target=check) for _ in range(4)]
    for thread in threads:
        thread.start()
    deadline = time.monotonic() + DEADLINE_S
    sequence = 0
    while sequence < 5000:
        assert time.monotonic() < deadline
        slot = ring.acquire()
        if slot < 0:
            time.sleep(0)
            continue
        ring.buffer(slot)[:] = sequence % 251
        ring.commit(slot, sequence, 4096, 1)
        work.put((sequence, reader.lease(slot, sequence, 4096)))
        sequence += 1
    for _ in threads:
        work.put(None)
    for thread in threads:
        thread.join(DEADLINE_S)
    assert not wrong
    assert ring.idle
    reader.close()
    ring.close()


class Yielding:
    """A row of the lease table that lets other threads run whenever it is looked at."""

    def __init__(self, row: memoryview) -> None:
        self.row = row

    def __getitem__(self, column: int) -> int:
        held = self.row[column]
        time.sleep(1e-6)
        return held

    def __setitem__(self, column: int, value: int) -> None:
        self.row[column] = value


def test_writers_in_several_threads_never_share_a_slot(monkeypatch: pytest.MonkeyPatch):
    ring = Ring(SOURCE, 1, slots=5, slot_bytes=4096)
    if isinstance(ring.ledger, PyLedger):  # the one in C lets nobody else run
        monkeypatch.setattr(ring.ledger, "_rows", [Yielding(row) for row in ring.ledger._rows])
    failures: list[BaseException] = []
    written = []

    def write() -> None:
        try:
            for sequence in range(300):
                slot = ring.acquire()
                if slot >= 0:
                    ring.pin(slot)
                    time.sleep(1e-6)
                    ring.commit(slot, sequence, 1, 1 + sequence % 3)  # fails if two threads have the slot
                    ring.free_column(sequence % 2)
                    ring.unpin(slot)
                    written.append(slot)
        except ValueError as error:
            failures.append(error)

    threads = [threading.Thread(target=write) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(DEADLINE_S)
    assert not failures
    assert len(written) > 100
    for column in (0, 1):
        ring.free_column(column)
    assert ring.idle
    ring.close()


if __name__ == "__main__":
    globals()[sys.argv[1]](*map(int, sys.argv[2:]))
