"""Pipes: both ends in C and in Python, and what publishers and subscribers of two processes make of them."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import threading
import time
import tracemalloc
from pathlib import Path

import pytest
import zmq
from peer import Block, is_whole, make_block
from processes import ROOT, SOON_S, wait_for

import cortex.link
import cortex.subscriber
from cortex import keep_last, native, pipe, reliable
from cortex.host import pipe_path, sweep
from cortex.shm import ShmUnavailable
from cortex.wire import BATCH, HEADER_SIZE, LARGE, MESSAGE, SLOT, Header, pack_header

WRITERS = [pipe.PyWriter] + ([native.NativePipeWriter] if native.NativePipeWriter else [])
READERS = [pipe.PyReader] + ([native.NativePipeReader] if native.NativePipeReader else [])


def frame(size: int, kind: bytes = MESSAGE, sequence: int = 0) -> bytes:
    return pack_header(Header(kind, 1, 2, sequence, None, 3, size, 0)) + bytes(
        k % 251 for k in range(sequence, sequence + size)
    )


def slot_frame() -> bytes:
    """A descriptor says the size of the body that it points to, not its own."""
    return pack_header(Header(SLOT, 1, 2, 5, None, 3, 900_000, 0)) + bytes(pipe.SLOT_FRAME_SIZE - HEADER_SIZE)


class Socket:
    """What a reader turns to when its pipe is empty."""

    def __init__(self) -> None:
        self.frames: list[bytes] = []
        self.fd, self._write = os.pipe()

    def __call__(self, flags: int) -> bytes:
        assert flags == zmq.DONTWAIT
        if not self.frames:
            raise zmq.Again
        return self.frames.pop(0)

    def close(self) -> None:
        os.close(self.fd)
        os.close(self._write)


class Ends:
    """Both ends of a pipe."""

    def __init__(self, writer, reader, wait_ms: int = 20) -> None:
        self.fd, write = os.pipe()
        os.set_blocking(self.fd, False)
        os.set_blocking(write, False)
        self.write_fd = os.dup(write)
        os.set_blocking(self.write_fd, False)
        self.socket = Socket()
        self.writer = writer(write, zmq.Again)
        self.reader = reader(self.fd, self.socket.fd, self.socket, zmq.Again, wait_ms)

    def take(self) -> bytes | None:
        try:
            return self.reader.receive(zmq.DONTWAIT)
        except zmq.Again:
            return None

    def close(self) -> None:
        self.writer.close()
        self.socket.close()
        os.close(self.fd)
        os.close(self.write_fd)


@pytest.fixture(
    params=[(w, r) for w in WRITERS for r in READERS], ids=lambda p: f"{p[0].__name__}-{p[1].__name__}"
)
def ends(request):
    both = Ends(*request.param)
    yield both
    both.close()


def test_frames_arrive_whole_and_in_order(ends):
    sent = [frame(0), frame(40), slot_frame(), frame(4000, BATCH), frame(1), frame(20_000)]
    for each in sent:
        ends.writer.send(each, zmq.DONTWAIT)
    assert [ends.take() for _ in sent] == sent
    assert ends.take() is None


def test_the_pipe_is_read_before_the_socket(ends):
    ends.socket.frames = [b"from the socket"]
    ends.writer.send(frame(3))
    assert ends.take() == frame(3)
    assert ends.take() == b"from the socket"
    assert ends.take() is None


def test_a_full_pipe_refuses_and_loses_nothing_that_it_took(ends):
    taken = []

    def fill():
        while True:
            ends.writer.send(frame(700, sequence=len(taken)))
            taken.append(frame(700, sequence=len(taken)))

    with pytest.raises(zmq.Again):
        fill()
    ends.writer.offer(frame(700, sequence=9))  # lost, in silence
    assert len(taken) > 50
    found = []
    while (each := ends.take()) is not None:
        found.append(each)
        ends.writer.flush()  # the last may have fitted in part
    assert found == taken
    ends.writer.send(frame(5))
    assert ends.take() == frame(5)


def test_a_frame_larger_than_the_pipe_goes_through_in_parts(ends):
    large = frame(3_000_000)
    ends.writer.send(large)
    assert not ends.writer.flush()
    found = None
    for _ in range(1000):
        found = ends.take()
        if found is not None:
            break
        ends.writer.flush()
    assert found == large
    assert ends.writer.flush()
    ends.writer.send(frame(1))
    assert ends.take() == frame(1)


def test_memory_grows_with_what_has_come(ends):
    """A header that says a gigabyte takes none; what a large frame took is let go after it."""
    large = pack_header(Header(MESSAGE, 1, 2, 0, None, 3, 20_000_000, 0)) + bytes(20_000_000)
    huge = pack_header(Header(MESSAGE, 1, 2, 0, None, 3, 1 << 30, 0))
    tracemalloc.start()
    try:
        ends.writer.send(large)
        found = None
        while found is None:
            found = ends.take()
            ends.writer.flush()
        assert found == large
        del found
        ends.writer.send(huge + bytes(50_000))
        assert ends.take() is None
        size, peak = tracemalloc.get_traced_memory()
        assert size < 1_000_000
        assert peak < 70_000_000  # the frame, the buffer, and while it grows that before it
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("cut", [1, 3, 63, 64, 100, 4063])
def test_a_frame_that_comes_in_pieces_is_put_together(ends, cut):
    whole = frame(4000)
    os.write(ends.write_fd, whole[:cut])
    assert ends.take() is None
    os.write(ends.write_fd, whole[cut:] + frame(2))
    assert ends.take() == whole
    assert ends.take() == frame(2)


@pytest.mark.parametrize(
    "garbage", [bytes(100), frame(8, LARGE), pack_header(Header(MESSAGE, 1, 2, 0, None, 3, 1 << 40, 0))]
)
def test_what_is_no_frame_comes_out_once_and_ends_it(ends, garbage):
    ends.writer.send(frame(2))
    os.write(ends.write_fd, garbage)
    assert ends.take() == frame(2)
    assert ends.take() == garbage
    ends.writer.send(frame(2))
    assert ends.take() is None
    ends.socket.frames = [b"x"]
    assert ends.take() == b"x"


def test_a_reader_that_is_gone_takes_everything(ends):
    os.close(ends.fd)
    for _ in range(3):
        ends.writer.send(frame(5))
    assert ends.writer.flush()
    ends.fd = os.dup(ends.socket.fd)


@pytest.mark.parametrize("reader", READERS)
def test_waiting_ends_with_a_frame_from_either_side_or_in_time(reader):
    both = Ends(pipe.PyWriter, reader, wait_ms=int(1e3 * SOON_S))
    timer = threading.Timer(0.05, both.writer.send, (frame(7),))
    timer.start()
    assert both.reader.receive(0) == frame(7)
    timer.join()
    both.close()
    brief = Ends(pipe.PyWriter, reader, wait_ms=10)
    with pytest.raises(zmq.Again):
        brief.reader.receive(0)
    brief.close()


def test_an_offer_is_opened_by_its_number_and_leaves_no_name(tmp_path: Path):
    offer = pipe.Offer(tmp_path, 0xABC)
    assert pipe_path(tmp_path, 0xABC).is_fifo()
    assert (pipe_path(tmp_path, 0xABC).stat().st_mode & 0o777) == 0o600
    writer = pipe.open_writer(tmp_path, 0xABC)
    assert writer is not None
    writer.send(frame(0, BATCH))
    assert offer.taken()
    assert list(tmp_path.iterdir()) == []
    offer.close()
    writer.close()


def test_an_offer_that_nobody_takes(tmp_path: Path):
    offer = pipe.Offer(tmp_path, 1)
    assert not offer.taken()
    offer.close()
    assert list(tmp_path.iterdir()) == []
    assert pipe.open_writer(tmp_path, 1) is None
    assert pipe.open_writer(None, 1) is None
    pipe_path(tmp_path, 2).write_bytes(b"no pipe")
    assert pipe.open_writer(tmp_path, 2) is None


@pytest.mark.parametrize("writer", WRITERS, ids=lambda kind: kind.__name__)
def test_a_reader_that_is_gone_ends_no_program_that_does_not_ignore_sigpipe(tmp_path: Path, writer):
    program = f"""
import pathlib, signal
import zmq
from cortex import native, pipe
signal.signal(signal.SIGPIPE, signal.SIG_DFL)
pipe.NativePipeWriter = {"native.NativePipeWriter" if writer is not pipe.PyWriter else None}
offer = pipe.Offer(pathlib.Path({str(tmp_path)!r}), 1)
writer = pipe.open_writer(pathlib.Path({str(tmp_path)!r}), 1)
assert type(writer).__name__ == {writer.__name__!r}
offer.close()
writer.offer(bytes(100))
writer.offer(bytes(10_000_000))
writer.close()
print("alive")
"""
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT)
    assert (found.returncode, found.stdout) == (0, "alive\n"), found.stderr


def test_an_offer_falls_silent(tmp_path: Path):
    """Whoever waits for its descriptor is not woken any more, whatever was written or will be."""
    offer = pipe.Offer(tmp_path, 1)
    writer = pipe.open_writer(tmp_path, 1)
    writer.send(frame(3))
    poll = select.poll()
    poll.register(offer.fd, select.POLLIN)
    assert poll.poll(0)
    before = offer.fd, len(os.listdir("/proc/self/fd"))
    offer.silence()
    assert (offer.fd, len(os.listdir("/proc/self/fd"))) == before
    assert list(tmp_path.iterdir()) == []
    writer.offer(frame(3))
    assert not poll.poll(0)
    writer.close()
    assert not poll.poll(0)
    offer.close()


def test_names_of_dead_readers_are_swept(tmp_path: Path):
    living = pipe.Offer(tmp_path, 1)
    os.mkfifo(pipe_path(tmp_path, 2))
    sweep(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [pipe_path(tmp_path, 1).name]
    living.close()


@pytest.mark.parametrize("policy", [reliable(8, 60.0), keep_last(8)], ids=str)
def test_processes_speak_through_pipes(make_node, start_child, runtime, policy):
    """Small and large messages in one order; no name is left where the nodes meet."""
    child = start_child(
        "endless_publisher", topic="/blocks", sizes=[100, 150_000, 6000, 20_000], rate_hz=400.0
    )
    child.hear()
    node = make_node()
    subscriber = node.subscriber("/blocks", Block, policy=policy)
    numbers = []
    for _ in range(60):
        block = subscriber.recv(SOON_S)
        assert is_whole(block)
        numbers.append(block.number)
    assert numbers == list(range(numbers[0], numbers[0] + 60))
    assert [link._pipe is not None for link in subscriber._links] == [True]
    assert not list(runtime.glob("*/pipe.*"))
    assert subscriber.counters.lost == subscriber.counters.rejected == 0
    child.finish()


def test_a_pipe_that_brings_nonsense_is_left_for_the_socket(make_node, start_child, runtime):
    """What was published meanwhile is counted as lost, and nothing after it."""
    publisher = make_node().publisher("/blocks", Block)
    child = start_child("endless_subscriber", topic="/blocks", policy=["reliable", {"timeout_s": SOON_S}])
    child.hear()
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    (reader,) = publisher._fanout.pipes._direct
    sent = 0

    def publish() -> None:
        nonlocal sent
        assert publisher.publish(make_block(sent, 100))
        sent += 1

    publish()
    wait_for(lambda: child.ask()["count"] == 1)
    reader.pipe.send(b"nonsense" * 20)
    wait_for(lambda: (publish(), child.ask()["count"] > 10)[1])

    def accounts() -> bool:
        found = child.ask()
        assert (found["torn"], found["rejected"]) == (0, 1)
        return found["count"] + found["lost"] == sent

    wait_for(accounts)
    lost = child.ask()["lost"]
    for _ in range(20):
        publish()
    wait_for(lambda: child.ask()["count"] == sent - lost)
    assert not publisher._fanout.pipes._direct


def test_a_pipe_is_read_to_its_end_however_long_that_takes(make_node, start_child, runtime, monkeypatch):
    """Its publisher has left long ago when its reader comes to read."""
    monkeypatch.setattr(cortex.subscriber, "LEAVING_NS", 0)
    child = start_child("peer")
    child.hear()
    child.ask(do="publisher", topic="/blocks", type="Block")
    node = make_node()
    subscriber = node.subscriber("/blocks", Block, policy=reliable(2, SOON_S))
    child.ask(do="await_subscribers", topic="/blocks")
    assert child.ask(do="publish", topic="/blocks", count=40, size=100)["delivered"] == 40
    child.finish()
    wait_for(lambda: not subscriber.sources())
    for _ in range(5):
        subscriber.dismiss(time.monotonic_ns())
    assert [subscriber.recv(SOON_S).number for _ in range(40)] == list(range(40))
    wait_for(lambda: not subscriber._links)
    assert subscriber.counters.lost == 0


@pytest.mark.parametrize("policy", [reliable(8, 60.0), keep_last(8)], ids=str)
def test_a_reader_that_cannot_map_the_first_ring(make_node, start_child, monkeypatch, policy):
    """It attaches anew: the latched message comes all the same, and the pipe that it offered wakes nobody."""

    def refuse(*_):
        raise ShmUnavailable("not here")

    child = start_child("peer")
    child.hear()
    child.ask(do="publisher", topic="/blocks", type="Block", latch=True)
    child.ask(do="publish", topic="/blocks", count=1, start=7, size=100_000)
    monkeypatch.setattr(cortex.link, "RingView", refuse)
    subscriber = make_node().subscriber("/blocks", Block, policy=policy)
    block = subscriber.recv(SOON_S)
    assert (block.number, is_whole(block)) == (7, True)
    (link,) = subscriber._links
    assert link._pipe is None
    poll = select.poll()
    poll.register(link._offer.fd, select.POLLIN)
    assert not poll.poll(0)
    child.ask(do="publish", topic="/blocks", count=2, start=8, size=100_000)
    assert [subscriber.recv(SOON_S).number for _ in range(2)] == [8, 9]
    assert subscriber.counters.lost == subscriber.counters.rejected == 0
    child.finish()


def test_a_reader_in_the_same_process_needs_no_pipe(make_node, runtime):
    node = make_node()
    publisher = node.publisher("/blocks", Block)
    subscriber = node.subscriber("/blocks", Block, policy=reliable())
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    publisher.publish(make_block(1, 100))
    assert subscriber.recv(SOON_S).number == 1
    assert [link._pipe is not None for link in subscriber._links] == [False]
