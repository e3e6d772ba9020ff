"""Frames through a socket without pyzmq, beside pyzmq itself."""

from __future__ import annotations

import threading
import time

import pytest
import zmq

from cortex.context import Frames

FRAMES = [bytes([size % 251]) * size for size in (0, 1, 29, 30, 33, 34, 5000, 300_000)]
"""Of each way in which libzmq keeps a message."""


@pytest.fixture(params=["inproc://pair", "ipc://{}/pair"])
def pair(request, tmp_path):
    with zmq.Context() as context, context.socket(zmq.PAIR) as left, context.socket(zmq.PAIR) as right:
        context.linger = left.linger = right.linger = 0
        left.bind(request.param.format(tmp_path))
        right.connect(request.param.format(tmp_path))
        right.rcvtimeo = 5000
        yield left, right


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


def test_nothing_there_no_room_and_closed(pair):
    left, right = pair
    sender, receiver = Frames(left), Frames(right)
    thread = threading.Timer(0.05, left.send, [b"late"])
    thread.start()
    assert receiver.receive(0) == b"late"  # it waits without the GIL
    thread.join()
    right.rcvtimeo = 20
    begin_s = time.monotonic()
    for flags in (zmq.DONTWAIT, 0):
        with pytest.raises(zmq.Again):
            receiver.receive(flags)
    assert time.monotonic() - begin_s >= 0.019
    with zmq.Context() as context, context.socket(zmq.PUSH) as lonely, pytest.raises(zmq.Again):
        Frames(lonely).send(b"frame", zmq.DONTWAIT)
    for frames, socket, use in (
        (sender, left, lambda: sender.send(b"frame", zmq.DONTWAIT)),
        (receiver, right, lambda: receiver.receive(zmq.DONTWAIT)),
    ):
        frames.close()
        socket.close(0)
        with pytest.raises(zmq.ZMQError):
            use()
