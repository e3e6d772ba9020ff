"""The roles of the child processes of a measurement, from their first to their last report."""

from __future__ import annotations

import contextlib
import importlib
import mmap
import threading
import time
from typing import Any

import numpy as np

from cortex.bench.peers import PATIENCE_S, PONG_FLOATS, Job, Peer, Send, peer_of
from cortex.bench.tally import END, WARM, Finished, Floats, Handler, Tally, make_payloads, resident_kb

_WARM_PINGS = 20
_WARM_S = 0.005
"""Between two WARM messages [s]."""
_BLOCKED_NS = 50_000_000
"""A call of `publish` that takes longer was waiting for a reader."""


def publish(pipe: Any, job: Job) -> None:
    """Publish WARM messages until told to go, then a flood, then END messages until told to stop."""
    peer = peer_of(job)
    send = peer.publisher(job, "flood")
    payloads = make_payloads(job.floats)
    deadline = time.monotonic() + PATIENCE_S
    while not pipe.poll(_WARM_S):
        if time.monotonic() > deadline:
            raise TimeoutError("no subscriber received anything")
        send(WARM, payloads[0])
    pipe.recv()
    sent, grown_kb = _flood(send, payloads, job)
    pipe.send({"sent": sent, "grown_kb": grown_kb})
    while not pipe.poll(4 * _WARM_S):
        send(END, payloads[0])
    peer.close()
    pipe.send("closed")


def receive(pipe: Any, job: Job) -> None:
    """Count a flood: report "connected" at the first message of any kind, the result at the END message."""
    cpu_s = 0.0

    def connected() -> None:
        nonlocal cpu_s
        cpu_s = time.process_time()
        pipe.send("connected")

    peer = peer_of(job)
    how = job.options.get("how", "callback")
    tally = Tally(job.floats, connected, settle_at=job.count // 10)
    _receive(peer, job, "flood", tally.handler(consume=bool(job.options.get("consume"))), how)
    pipe.send({"cpu_s": time.process_time() - cpu_s, **tally.report})
    peer.close()


def ask(pipe: Any, job: Job) -> None:
    """Make round trips for the job's time: each answer sends the next message. Report their percentiles."""
    peer = peer_of(job)
    send = peer.publisher(job, "ping")
    payload = make_payloads(job.floats)[0]
    times_ns: list[int] = []
    connected = threading.Event()
    now = time.perf_counter_ns
    expected = begin_ns = end_ns = 0

    def warm() -> None:
        while not connected.wait(_WARM_S):
            send(WARM, payload)

    def on_pong(sequence: int, _data: Floats) -> None:
        nonlocal expected, begin_ns, end_ns
        arrived_ns = now()
        if sequence == WARM and not connected.is_set():
            connected.set()
            warmer.join()
        elif sequence == expected:
            times_ns.append(arrived_ns - begin_ns)
            expected += 1
            if expected == _WARM_PINGS:
                times_ns.clear()
                end_ns = arrived_ns + int(1e9 * job.seconds)
        else:
            return
        if end_ns and arrived_ns > end_ns:
            raise Finished
        begin_ns = now()
        send(expected, payload)

    warmer = threading.Thread(target=warm, daemon=True)
    warmer.start()
    _receive(peer, job, "pong", on_pong, "recv")
    send(END, payload)
    peer.close()
    figures = {}
    if times_ns:
        p50, p99 = np.percentile(times_ns, [50, 99], method="higher") / 1e3
        figures = {"rtt_p50_us": float(p50), "rtt_p99_us": float(p99)}
    pipe.send({"sent": len(times_ns), "received": len(times_ns), **figures})


def answer(pipe: Any, job: Job) -> None:
    """Answer each message with 40 bytes until the client ends."""
    peer = peer_of(job)
    send = peer.publisher(job, "pong")
    payload = make_payloads(PONG_FLOATS)[0]

    def on_ping(sequence: int, _data: Floats) -> None:
        if sequence == END:
            raise Finished
        send(sequence, payload)

    _receive(peer, job, "ping", on_ping, job.options.get("how", "callback"))
    peer.close()
    pipe.send("closed")


def publish_until_freed(pipe: Any, job: Job) -> None:
    """Publish to a reader that takes nothing; report the time at which a blocked `publish` returns."""
    send = peer_of(job).publisher(job, "flood")
    payload = make_payloads(job.floats)[0]
    while not pipe.poll(_WARM_S):
        send(WARM, payload)
    pipe.recv()
    before_ns = time.monotonic_ns()
    for sequence in range(1 << 62):
        send(sequence, payload)
        now_ns = time.monotonic_ns()
        if now_ns - before_ns > _BLOCKED_NS:
            break
        before_ns = now_ns
    pipe.send(now_ns)


def stop_reading(pipe: Any, job: Job) -> None:
    """Receive one message, and stand still in its callback for ever."""

    def handle(_sequence: int, _data: Floats) -> None:
        pipe.send("connected")
        threading.Event().wait()

    peer_of(job).receive(job, "flood", handle, "callback")


def await_death(pipe: Any, job: Job) -> None:
    """Receive a flood; report the time at which the publisher is known to be dead."""
    peer = peer_of(job)
    importlib.import_module("cortex.bench.peer_cortex").tell_death(
        job, lambda: pipe.send(time.monotonic_ns())
    )
    tally = Tally(job.floats, lambda: pipe.send("connected"))
    peer.receive(job, "flood", tally.handler(), "callback")


def copy(pipe: Any, job: Job) -> None:
    """Copy payloads in turn into the slots of a ring, again and again for the job's time, once told to go."""
    stride = -(-job.payload_bytes // mmap.PAGESIZE) * mmap.PAGESIZE
    memory = np.frombuffer(mmap.mmap(-1, stride * job.slots), np.float32)
    memory[:] = 0.0  # touches every page before the clock starts
    sources = make_payloads(job.floats)
    targets = [memory[k * stride // 4 :][: job.floats] for k in range(job.slots)]
    pipe.send("ready")
    pipe.recv()
    copied = 0
    begin = now = time.perf_counter()
    while now - begin < job.seconds:
        for _ in range(max(1, min(64, 250_000 // job.floats))):
            np.copyto(targets[copied % len(targets)], sources[copied % len(sources)])
            copied += 1
        now = time.perf_counter()
    pipe.send({"rate": copied / (now - begin), "sent": copied, "received": copied})


def _receive(peer: Peer, job: Job, topic: str, handle: Handler, how: str) -> None:
    with contextlib.suppress(Finished):
        peer.receive(job, topic, handle, how)


def _flood(send: Send, payloads: tuple[Floats, Floats], job: Job) -> tuple[int, int]:
    pairs = max(1, min(32, 500_000 // job.payload_bytes))
    sent = settled_kb = 0
    begin = time.perf_counter()
    while sent < job.count if job.count else time.perf_counter() < begin + job.seconds:
        for _ in range(pairs):
            send(sent, payloads[0])
            send(sent + 1, payloads[1])
            sent += 2
        if job.count and not settled_kb and sent >= job.count // 10:
            settled_kb = resident_kb()
    return sent, resident_kb() - settled_kb if settled_kb else 0
