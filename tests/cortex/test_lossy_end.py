"""A reader of a lossy socket learns how many messages there were, also where its queue was full."""

from __future__ import annotations

import threading

from peer import Block, make_block
from processes import SOON_S, wait_for

import cortex.node
from cortex import keep_last


def test_the_end_comes_after_a_full_queue(make_node, monkeypatch):
    publisher = make_node("one", listen="127.0.0.1").publisher("/blocks", Block)
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(cortex.node, "host_id", lambda: "another host")
        node = make_node("two", listen="127.0.0.1")
    subscriber = node.subscriber("/blocks", Block, policy=keep_last(4))
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    assert subscriber.wait_for_publisher(SOON_S)
    assert subscriber.carriers == ["tcp"]
    block, count = make_block(0, 10_000), 6_000
    with subscriber._receive_lock:  # nobody reads: queues and buffers fill up, and the rest is dropped
        for _ in range(count):
            publisher.publish(block)
        closing = threading.Thread(target=publisher.close, kwargs={"linger_s": SOON_S})
        closing.start()
        closing.join(0.3)
        assert closing.is_alive()  # the reader has not said yet that it knows
    counters = subscriber.counters
    wait_for(lambda: counters.received + counters.lost + counters.overtaken + len(subscriber._queue) == count)
    closing.join(SOON_S)
    assert not closing.is_alive()
    assert counters.lost > 0
