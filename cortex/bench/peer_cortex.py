"""Cortex itself, used as its documentation says: typed messages, decoded to objects.

Options: ``loan``, ``inline_max``, ``max_wait_s``, ``tcp`` (an address).
"""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import cortex.node
from cortex.bench.peers import PATIENCE_S, Job, Peer, Send
from cortex.bench.tally import Finished, Floats, Handler
from cortex.message_types import Array, message
from cortex.node import Node
from cortex.policy import reliable


@message(name="bench/Sample")
class Sample:
    """A stamp and an array of any length; the stamp counts the messages."""

    stamp_ns: int
    data: Array["float32", "n"]


_NODES: list[Node] = []


def _node(job: Job, *, listens: bool) -> Node:
    """Return the node: over tcp, who publishes the flood listens."""
    address = job.options.get("tcp")
    if not _NODES:
        if address and not listens:
            # To a node of another host the only way is tcp; no two hosts are needed to measure it.
            cortex.node.host_id = lambda: "another host"  # type: ignore[attr-defined]
        _NODES.append(Node("bench", listen=address if listens else None, insecure=address is not None))
    return _NODES[0]


def _topic(job: Job, topic: str) -> str:
    """Name a topic of this repetition's own: the last one's nodes may still be known."""
    return f"/bench/{job.folder.name}/{topic}"


def _publisher(job: Job, topic: str) -> Send:
    floats = job.floats
    options = {key: job.options[key] for key in ("inline_max", "max_wait_s") if key in job.options}
    publisher = _node(job, listens=topic != "pong").publisher(_topic(job, topic), Sample, **options)
    publish, loan = publisher.publish, publisher.loan

    def send(sequence: int, data: Floats) -> None:
        publish(Sample(sequence, data))

    def send_loan(sequence: int, data: Floats) -> None:
        """Write the stamp and the three items that are checked, as a producer would that fills the slot."""
        with loan(n=floats) as draft:
            draft.stamp_ns = sequence
            draft.data[0] = draft.data[floats // 2] = draft.data[-1] = data[0]

    return send_loan if job.options.get("loan") else send


def _receive(job: Job, topic: str, handle: Handler, how: str) -> None:
    # Large messages wait in the publisher's ring, which bounds their memory.
    policy = reliable(depth=max(8, job.depth), timeout_s=PATIENCE_S)
    subscribe = _node(job, listens=False).subscriber
    done = threading.Event()

    def on_message(sample: Any) -> None:
        try:
            handle(sample.stamp_ns, sample.data)
        except Finished:
            done.set()

    if how == "callback":
        subscribe(_topic(job, topic), Sample, on_message, policy=policy)
        done.wait()  # the runner kills a child that waits for ever
    else:
        _BY[how](subscribe(_topic(job, topic), Sample, policy=policy), handle)


def _by_recv(subscriber: Any, handle: Handler) -> None:
    recv = subscriber.recv
    while True:
        sample = recv(timeout_s=PATIENCE_S)
        handle(sample.stamp_ns, sample.data)


def _by_iterator(subscriber: Any, handle: Handler) -> None:
    for sample in subscriber:
        handle(sample.stamp_ns, sample.data)


def _by_async(subscriber: Any, handle: Handler) -> None:
    async def loop() -> None:
        async for sample in subscriber:
            handle(sample.stamp_ns, sample.data)

    asyncio.run(loop())


_BY = {"recv": _by_recv, "iterator": _by_iterator, "async": _by_async}


def tell_death(job: Job, callback: Any) -> None:
    """Call back when the publisher of a flood has died."""
    node, topic = _node(job, listens=False), _topic(job, "flood")
    node.watch(topic, lambda change: None if change.alive else callback())


def _close() -> None:
    for node in _NODES:
        node.close()


PEER = Peer(_publisher, _receive, close=_close)
