"""The short cuts of large messages in C: the same bytes, leases and counts as Python, nothing on trust."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from peer import Block, Scan, is_whole, make_block
from processes import SOON_S, wait_for
from test_large import connected, scan, slots_held

from cortex import Closed, keep_last, reliable
from cortex.compiled import native

pytestmark = pytest.mark.skipif(native is None, reason="without the C module there are no short cuts")


def test_what_is_not_as_usual_goes_the_long_way(node):
    """Another class, a wrong dtype, an array that is not contiguous: the same words, and no slot is lost."""
    publisher, subscriber = connected(node, Scan, reliable(64, 5.0))
    for number in range(3):
        publisher.publish(scan(number))
        subscriber.recv(SOON_S)
    with pytest.raises(TypeError, match="carries Scan"):
        publisher.publish(make_block(0, 100_000))
    with pytest.raises(TypeError, match="float64"):
        publisher.publish(Scan(1, np.zeros(100_000)))
    with pytest.raises((TypeError, ValueError), match="stamp_ns"):
        publisher.publish(Scan("soon", np.zeros(100_000, np.float32)))
    assert publisher.publish(Scan(5, np.arange(200_000, dtype=np.float32)[::2]))
    message = subscriber.recv(SOON_S)
    assert message.stamp_ns == 5
    assert (message.ranges == np.arange(0, 200_000, 2)).all()
    del message
    wait_for(lambda: slots_held(publisher) == 0)


def test_publishers_in_several_threads(node):
    """Messages copied with and without the lock, small ones between them: each arrives once, in order."""
    publisher, subscriber = connected(node, Block, reliable(64, 60.0))
    sizes, count, threads = (10, 40_000, 200_000, 600_000), 40, 4
    made = [
        [make_block(1000 * k + number, sizes[(number + k) % 4]) for number in range(count)]
        for k in range(threads)
    ]
    refused = []

    def publish(k):
        refused.extend(block.number for block in made[k] if not publisher.publish(block))

    workers = [threading.Thread(target=publish, args=(k,)) for k in range(threads)]
    for worker in workers:
        worker.start()
    seen = []
    for _ in range(count * threads):
        block = subscriber.recv(SOON_S)
        assert is_whole(block)
        seen.append(block.number)
    for worker in workers:
        worker.join(SOON_S)
    assert not refused
    for k in range(threads):
        assert [number % 1000 for number in seen if number // 1000 == k] == list(range(count))
    assert (subscriber.counters.received, subscriber.counters.lost) == (count * threads, 0)
    assert publisher.counters.published == count * threads


def test_closing_while_others_publish(node):
    """The memory stays as long as somebody copies into it."""
    for _ in range(10):
        publisher, subscriber = connected(node, Scan, keep_last(4))
        message = scan(1, 1_000_000)
        ended = []

        def publish(publisher=publisher, message=message, ended=ended):
            try:
                while True:
                    publisher.publish(message)
            except Closed:
                ended.append(True)

        thread = threading.Thread(target=publish)
        thread.start()
        subscriber.recv(SOON_S)
        time.sleep(0.003)
        publisher.close(linger_s=0.0)
        thread.join(SOON_S)
        assert ended
        subscriber.close()
