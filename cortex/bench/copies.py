"""Copies of memory: what no transport that moves the bytes once can beat."""

from __future__ import annotations

import mmap
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex.bench.children import Channel
from cortex.bench.job import Job
from cortex.bench.tally import make_payloads

Ring = list[NDArray[np.float32]]


def slots_of(payload_bytes: int) -> int:
    """Return how many slots a ring for messages of this size has: about 4 MB of them, 4 to 64."""
    return max(4, min(64, 4_000_000 // payload_bytes))


def copy_alone(channel: Channel, job: Job) -> None:
    """Copy the payloads in turn into one private array, or into a shared ring of slots (option ``ring``)."""
    ring = make_ring(job.floats, slots_of(job.payload_bytes)) if job.options.get("ring") else None
    targets = ring if ring is not None else [np.zeros(job.floats, np.float32)]
    channel.tell("ready")
    channel.wait(10.0)
    channel.tell("result", **_copy_for(job, list(make_payloads(job.floats)), targets))


def copy_in(channel: Channel, job: Job, ring: Ring) -> None:
    """Be the writer of two processes that copy at once: into the slots of a ring that both have mapped."""
    _announce_and_copy(channel, job, list(make_payloads(job.floats)), ring)


def copy_out(channel: Channel, job: Job, ring: Ring) -> None:
    """Be the reader of two processes that copy at once: out of the ring's slots into one private array."""
    _announce_and_copy(channel, job, ring, [np.zeros(job.floats, np.float32)])


def make_ring(floats: int, slots: int) -> Ring:
    """Return the slots of a mapping that forked children share, each at the start of a page, all touched."""
    stride = -(-4 * floats // mmap.PAGESIZE) * mmap.PAGESIZE
    memory = np.frombuffer(mmap.mmap(-1, stride * slots), np.float32)
    memory[:] = 0.0
    return [memory[k * stride // 4 :][:floats] for k in range(slots)]


def _announce_and_copy(channel: Channel, job: Job, sources: Ring, targets: Ring) -> None:
    channel.tell("ready")
    channel.wait(10.0)
    channel.tell("result", **_copy_for(job, sources, targets))


def _copy_for(job: Job, sources: Ring, targets: Ring) -> dict[str, Any]:
    for k in range(max(len(sources), len(targets))):  # touches every page before the clock starts
        np.copyto(targets[k % len(targets)], sources[k % len(sources)])
    chunk = max(1, min(64, 1_000_000 // job.payload_bytes))
    copied = 0
    begin = now = time.perf_counter()
    while copied < job.count if job.count else now - begin < job.seconds:
        for _ in range(chunk):
            np.copyto(targets[copied % len(targets)], sources[copied % len(sources)])
            copied += 1
        now = time.perf_counter()
    return {"rate": copied / (now - begin), "received": copied, "lost": 0, "misordered": 0, "corrupt": 0}
