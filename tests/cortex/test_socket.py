"""Frames through a socket without pyzmq, beside pyzmq itself."""

from __future__ import annotations

import threading
import time

import pytest
import zmq

from cortex.context import Frames

FRAMES = [b"", b"x", b"y" * 29, b"z" * 30, b"a" * 33, b"b" * 34, b"c" * 5000, b"d" * 300_000]


@pytest.fixture(params=["inproc", "ipc"])
def pair(request, tmp_path):
    context = zmq.Context()
    left, right = context.socket(zmq.PAIR), context.socket(zmq.PAIR)
    address = "inproc://pair" if request.param == "inproc" else f"ipc://{tmp_path}/pair"
    left.bind(address)
    right.connect(address)
    right.rcvtimeo = 5000
    yield left, right
    left.close(0)
    right.close(0)
    context.term()


@pytest.mark.parametrize("direct", ["send", "receive", "both"])
def test_what_is_sent_arrives(pair, direct):
    left, right = pair
    send = left.send if direct == "receive" else Frames(left).send
    receive = right.recv if direct == "send" else Frames(right).receive
    for frame in FRAMES:
        send(frame, 0)
        assert receive(0) == frame
    for frame in FRAMES:
        send(frame, zmq.DONTWAIT)
    assert [receive(0) for _ in FRAMES] == FRAMES


def test_nothing_there_and_no_room(pair):
    _, right = pair
    receiver = Frames(right)
    with pytest.raises(zmq.Again):
        receiver.receive(zmq.DONTWAIT)
    right.rcvtimeo = 20
    begin = time.monotonic()
    with pytest.raises(zmq.Again):
        receiver.receive(0)
    assert time.monotonic() - begin >= 0.019

    with zmq.Context() as context, context.socket(zmq.PUSH) as lonely, pytest.raises(zmq.Again):
        Frames(lonely).send(b"frame", zmq.DONTWAIT)


def test_waits_without_the_thread_state(pair):
    left, right = pair
    receiver = Frames(right)
    thread = threading.Timer(0.05, left.send, [b"late"])
    thread.start()
    assert receiver.receive(0) == b"late"
    thread.join()


def test_a_closed_one_raises(pair):
    left, right = pair
    sender, receiver = Frames(left), Frames(right)
    for frames, socket in ((sender, left), (receiver, right)):
        frames.close()
        socket.close(0)
    with pytest.raises(zmq.ZMQError):
        sender.send(b"frame", zmq.DONTWAIT)
    with pytest.raises(zmq.ZMQError):
        receiver.receive(zmq.DONTWAIT)
