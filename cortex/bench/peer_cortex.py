"""Cortex itself, used as its documentation says: typed messages, decoded to objects."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import cortex.node
from cortex.bench.age import Ages
from cortex.bench.cpp_subscriber import binary, cpp_missing
from cortex.bench.job import PATIENCE_S, PONG_FLOATS, Job, Sender
from cortex.bench.samples import FIXED, Reading, Sample
from cortex.bench.tally import END, Finished, Floats, Tally, make_payloads
from cortex.node import Node
from cortex.policy import Policy, latest, reliable

__all__ = [
    "client",
    "cpp_missing",
    "reading_sender",
    "receive",
    "receive_cpp",
    "receive_latest",
    "sender",
    "serve",
]


def sender(job: Job) -> Sender:
    """Make a node with one publisher; options: ``fixed``, ``loan``, ``inline_max``, ``tcp``."""
    return _Sender(job)


class _Sender:
    def __init__(self, job: Job) -> None:
        self.address: Mapping[str, Any] = {}
        self._node = _listening_node("bench_publisher", job)
        kind = _type(job)
        self._publisher = self._node.publisher(_topic(job), kind, **_publisher_options(job))
        self.send = self._loaning(job) if job.options.get("loan") else self._publishing(kind)
        self._refused = 0

    def _publishing(self, kind: Any) -> Callable[[int, Floats], None]:
        publish = self._publisher.publish

        def send(sequence: int, data: Floats) -> None:
            if not publish(kind(sequence, data)):
                self._refused += 1

        return send

    def _loaning(self, job: Job) -> Callable[[int, Floats], None]:
        """Write the stamp and the three items that are checked, as a producer would that fills the slot."""
        loan, floats = self._publisher.loan, job.floats

        def send(sequence: int, data: Floats) -> None:
            with loan(n=floats) as draft:
                draft.stamp_ns = sequence
                draft.data[0] = draft.data[floats // 2] = draft.data[-1] = data[0]

        return send

    def report(self) -> dict[str, Any]:
        return {"refused": self._refused}

    def close(self) -> None:
        self._node.close()


def receive(job: Job, connected: Callable[[], None]) -> dict[str, Any]:
    """Count the messages of one flood in the way that option ``how`` names."""
    done = threading.Event()
    how = job.options.get("how", "callback")

    def finish() -> None:
        done.set()
        if how != "callback":
            raise Finished

    tally = Tally(job.floats, connected=connected, finish=finish, settle_at=job.count // 10)
    node = _connecting_node("bench_subscriber", job)
    try:
        policy = _reliable(job)
        if how == "callback":
            _by_callback(node, job, policy, tally, done)
        else:
            _BY[how](node.subscriber(_topic(job), _type(job), policy=policy), tally, job)
        return tally.report()
    finally:
        node.close()


def _by_callback(node: Node, job: Job, policy: Any, tally: Tally, done: threading.Event) -> None:
    handle = tally.copying_handler() if job.options.get("consume") else tally.handler()

    def on_message(sample: Any) -> None:
        handle(sample.stamp_ns, sample.data)

    node.subscriber(_topic(job), _type(job), on_message, policy=policy)
    # The runner kills a child that waits for ever; this wait only has to be longer than any flood.
    done.wait(job.seconds + 600.0)


def _by_iterator(subscriber: Any, tally: Tally, job: Job) -> None:
    handle = tally.handler()
    try:
        for sample in subscriber:
            handle(sample.stamp_ns, sample.data)
    except Finished:
        return


def _by_recv(subscriber: Any, tally: Tally, job: Job) -> None:
    handle = tally.handler()
    recv = subscriber.recv
    try:
        while True:
            sample = recv(timeout_s=PATIENCE_S)
            handle(sample.stamp_ns, sample.data)
    except Finished:
        return


def _by_batch(subscriber: Any, tally: Tally, job: Job) -> None:
    handle = tally.batch_handler()
    recv_batch = subscriber.recv_batch
    try:
        while True:
            handle(recv_batch(timeout_s=PATIENCE_S))
    except Finished:
        return


def _by_async(subscriber: Any, tally: Tally, job: Job) -> None:
    handle = tally.handler()

    async def loop() -> None:
        try:
            async for sample in subscriber:
                handle(sample.stamp_ns, sample.data)
        except Finished:
            return

    asyncio.run(loop())


_BY: Mapping[str, Callable[[Any, Tally, Job], None]] = {
    "iterator": _by_iterator,
    "recv": _by_recv,
    "batch": _by_batch,
    "async": _by_async,
}


def client(job: Job) -> Client:
    """Make the asking node of a round trip."""
    return Client(job)


class Client:
    """Publishes the payload; receives 40 bytes in the way that option ``how`` names (recv, or a callback)."""

    def __init__(self, job: Job) -> None:
        self.address: Mapping[str, Any] = {}
        self._node = _listening_node("bench_client", job)
        self._type = _type(job)
        self._publish = self._node.publisher(
            _topic(job, "ping"), self._type, **_publisher_options(job)
        ).publish
        self._payload = make_payloads(job.floats)[0]
        self._recv = self._node.subscriber(
            _topic(job, "pong"), Sample, policy=reliable(depth=64, timeout_s=PATIENCE_S)
        ).recv

    def ping(self, sequence: int, data: Floats, timeout_s: float) -> bool:
        """Send one message and wait for its answer."""
        self._publish(self._type(sequence, data))
        recv = self._recv
        try:
            while recv(timeout_s=timeout_s).stamp_ns != sequence:
                pass
        except TimeoutError:
            return False
        return True

    def close(self) -> None:
        """End the server and close."""
        self._publish(self._type(END, self._payload))
        self._node.close()


def serve(job: Job) -> None:
    """Answer each message from the callback that gets it."""
    done = threading.Event()
    node = _connecting_node("bench_server", job)
    publish = node.publisher(_topic(job, "pong"), Sample).publish
    answer = make_payloads(PONG_FLOATS)[0]

    def on_ping(sample: Any) -> None:
        if sample.stamp_ns == END:
            done.set()
        else:
            publish(Sample(sample.stamp_ns, answer))

    node.subscriber(_topic(job, "ping"), _type(job), on_ping, policy=_reliable(job))
    done.wait(job.seconds + 600.0)
    node.close()


def reading_sender(job: Job) -> Sender:
    """Make a publisher of messages that are stamped with the time at which they are published."""
    return _ReadingSender(job)


class _ReadingSender:
    def __init__(self, job: Job) -> None:
        self.address: Mapping[str, Any] = {}
        self._node = _listening_node("bench_publisher", job)
        self._publish = self._node.publisher(_topic(job), Reading).publish

    def send(self, sequence: int, data: Floats) -> None:
        self._publish(Reading(time.monotonic_ns(), sequence, data))

    def report(self) -> dict[str, Any]:
        return {}

    def close(self) -> None:
        self._node.close()


def receive_latest(job: Job, connected: Callable[[], None]) -> dict[str, Any]:
    """Use messages under `latest()`, from `recv` or in a callback (option ``how``); return their ages."""
    ages = Ages(job, connected)
    node = _connecting_node("bench_subscriber", job)
    try:
        if job.options.get("how") == "callback":
            done = threading.Event()

            def on_reading(reading: Reading) -> None:
                ages.use(reading.sequence, reading.stamp_ns)
                if ages.done:
                    done.set()

            node.subscriber(_topic(job), Reading, on_reading, policy=latest())
            done.wait(job.seconds + 600.0)
        else:
            subscriber = node.subscriber(_topic(job), Reading, policy=latest())
            while not ages.done:
                reading = subscriber.recv(timeout_s=PATIENCE_S)
                ages.use(reading.sequence, reading.stamp_ns)
        return ages.report()
    finally:
        node.close()


def receive_cpp(job: Job, connected: Callable[[], None]) -> dict[str, Any]:
    """Run the C++ subscriber, which prints one line when it is connected and one when the flood is over."""
    command = [str(binary()), _topic(job), str(job.floats), str(job.depth)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("connected"):
                connected()
            elif line.startswith("{"):
                report: dict[str, Any] = json.loads(line)
                return report
    raise RuntimeError(f"the C++ subscriber ended with status {process.returncode} and no result")


def _topic(job: Job, role: str = "flood") -> str:
    """Name a topic of this repetition's own: the last one's nodes may still be known."""
    return f"/bench/{job.folder.name or 'here'}/{role}"


def _reliable(job: Job) -> Policy:
    """Lose nothing; large messages wait in the publisher's ring, which bounds their memory."""
    return reliable(depth=max(8, job.depth), timeout_s=PATIENCE_S)


def _type(job: Job) -> Any:
    return FIXED[job.floats] if job.options.get("fixed") else Sample


def _publisher_options(job: Job) -> dict[str, Any]:
    return {key: job.options[key] for key in ("inline_max",) if key in job.options}


def _listening_node(name: str, job: Job) -> Node:
    return Node(name, listen="127.0.0.1" if job.options.get("tcp") else None)


def _connecting_node(name: str, job: Job) -> Node:
    if job.options.get("tcp"):
        # To a node of another host the only way is tcp; no two network namespaces are needed to measure it.
        cortex.node.host_id = lambda: "another host"  # type: ignore[attr-defined]
    return Node(name)
