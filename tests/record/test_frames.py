"""What processes of a recording send to each other arrives whole."""

from __future__ import annotations

import pickle
import signal
import socket
import sys
import threading
import time

import numpy as np
import pytest

from neurosim_core.record.frames import connect, receive_frame, send_frame


def test_a_frame_is_received_whole_though_a_signal_comes_within():
    """As when the process is stopped and goes on, or the computer sleeps."""
    data = np.arange(20_000)
    near, far = socket.socketpair()
    onward, end = socket.socketpair()
    before = signal.signal(signal.SIGUSR1, lambda *_: None)
    try:
        send_frame(near, [pickle.dumps("text")], [data])
        near.close()
        sent = b"".join(iter(lambda: far.recv(1 << 20), b""))
        reader = threading.get_ident()

        def forward() -> None:
            for part in (sent[:7], sent[7:100], sent[100:90_000], sent[90_000:]):
                onward.sendall(part)
                time.sleep(0.05)
                signal.pthread_kill(reader, signal.SIGUSR1)
                time.sleep(0.05)

        thread = threading.Thread(target=forward)
        thread.start()
        contents, received = receive_frame(end)
        thread.join()
    finally:
        signal.signal(signal.SIGUSR1, before)
        for link in (far, onward, end):
            link.close()
    assert contents == ["text"]
    assert received.tobytes() == data.tobytes()


@pytest.mark.skipif(sys.platform != "linux", reason="what a socket holds differs")
def test_a_packet_is_sent_before_anybody_receives_it():
    near, far = connect()
    with near, far:
        near.setblocking(False)
        send_frame(near, [pickle.dumps("text")], [np.zeros(300_000, np.uint8)])
        assert receive_frame(far)[1].size == 300_000
