"""What each child process of a measurement does from its first to its last report."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cortex.bench.age import percentiles
from cortex.bench.children import Channel, ChildFailed
from cortex.bench.job import PATIENCE_S, Job
from cortex.bench.tally import END, WARM, Floats, make_payloads, resident_kb
from cortex.bench.transports import TRANSPORTS

_WARM_PINGS = 20


def publish(channel: Channel, job: Job) -> None:
    """Publish WARM messages until told "go", then a flood, then END messages until told "stop"."""
    factory = TRANSPORTS[job.transport].sender
    assert factory is not None
    sender = factory(job)
    channel.tell("ready", address=dict(sender.address))
    payloads = make_payloads(job.floats)
    deadline = time.monotonic() + PATIENCE_S
    while channel.wait(0.005) is None:
        if time.monotonic() > deadline:
            raise TimeoutError("no subscriber received anything")
        sender.send(WARM, payloads[0])
    cpu_s = time.process_time()
    sent, grown_kb = _flood(sender.send, payloads, job)
    channel.tell("sent", sent=sent, cpu_s=time.process_time() - cpu_s, grown_kb=grown_kb, **sender.report())
    while channel.wait(0.02) is None:
        sender.send(END, payloads[0])
    sender.close()
    channel.tell("closed", shm=sorted(str(path) for path in Path("/dev/shm").glob("*")))


def receive(channel: Channel, job: Job) -> None:
    """Count a flood: report "connected" at the first message of any kind, "result" at the END message."""
    function = TRANSPORTS[job.transport].receive
    assert function is not None
    cpu_s = 0.0

    def connected() -> None:
        nonlocal cpu_s
        cpu_s = time.process_time()
        channel.tell("connected")

    report = function(job, connected)
    report.setdefault("cpu_s", time.process_time() - cpu_s)
    channel.tell("result", **report)


def ask(channel: Channel, job: Job) -> None:
    """Make round trips for the job's time, and report their percentiles."""
    factory = TRANSPORTS[job.transport].client
    assert factory is not None
    client = factory(job)
    channel.tell("ready", address=dict(client.address))
    payload = make_payloads(job.floats)[0]
    deadline = time.monotonic() + PATIENCE_S
    while not client.ping(WARM, payload, 0.05):
        if time.monotonic() > deadline:
            raise TimeoutError("no server answered")
    for k in range(_WARM_PINGS):
        _ping(client.ping, k, payload)
    times_ns: list[int] = []
    end = time.monotonic() + job.seconds
    while len(times_ns) < job.count if job.count else time.monotonic() < end:
        begin = time.perf_counter_ns()
        _ping(client.ping, _WARM_PINGS + len(times_ns), payload)
        times_ns.append(time.perf_counter_ns() - begin)
    client.close()
    channel.tell(
        "result",
        **percentiles(times_ns, "rtt"),
        sent=len(times_ns),
        received=len(times_ns),
        lost=0,
        misordered=0,
        corrupt=0,
    )


def answer(channel: Channel, job: Job) -> None:
    """Answer round trips until the client ends them."""
    function = TRANSPORTS[job.transport].serve
    assert function is not None
    function(job)
    channel.tell("closed")


def _flood(send: Callable[[int, Floats], Any], payloads: tuple[Floats, Floats], job: Job) -> tuple[int, int]:
    """Send the payloads in turn; return how many, and by how much memory grew after the first tenth [kB]."""
    first, second = payloads
    if rate_hz := job.options.get("rate_hz"):
        return _paced(send, first, second, job, rate_hz), 0
    pairs = max(1, min(32, 500_000 // job.payload_bytes))
    sent = 0
    settled_kb: int | None = None
    end = time.perf_counter() + job.seconds
    while sent < job.count if job.count else time.perf_counter() < end:
        for _ in range(pairs):
            send(sent, first)
            send(sent + 1, second)
            sent += 2
        if settled_kb is None and job.count and sent >= job.count // 10:
            settled_kb = resident_kb()
    return sent, 0 if settled_kb is None else resident_kb() - settled_kb


def _paced(
    send: Callable[[int, Floats], Any], first: Floats, second: Floats, job: Job, rate_hz: float
) -> int:
    """Send at a rate, on an absolute schedule, so that a late message does not delay those after it."""
    begin = time.perf_counter()
    for sent in range(job.count or int(job.seconds * rate_hz)):
        early_s = begin + sent / rate_hz - time.perf_counter()
        if early_s > 0.0:
            time.sleep(early_s)
        send(sent, second if sent & 1 else first)
    return job.count or int(job.seconds * rate_hz)


def _ping(ping: Callable[[int, Floats, float], bool], sequence: int, payload: Floats) -> None:
    if not ping(sequence, payload, PATIENCE_S):
        raise ChildFailed(f"round trip {sequence} got no answer in {PATIENCE_S} s")
