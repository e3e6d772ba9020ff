"""Damaged bodies of every type are decoded or rejected and nothing else."""

from __future__ import annotations

import os
import tracemalloc

from fuzz_decode import outcome, run, targets


def test_mutated_bodies():
    results = run(int(os.environ.get("CORTEX_FUZZ_BODIES", "20000")), seed=1)
    assert results["accepted"] > 2_000  # else the mutations would only show that wrong sizes are rejected
    assert results["rejected"] > 5_000


def test_rejecting_takes_no_memory():
    """Whatever counts and offsets a body claims, decoding allocates no more than a small multiple of it."""
    everything = [(target, body) for target in targets() for body in target.bodies]
    for target, body in everything:
        for place in range(0, min(len(body) - 4, 96), 4):
            damaged = body[:place] + b"\xff\xff\xff\x7f" + body[place + 4 :]
            tracemalloc.start()
            try:
                outcome(target.codec.decode, damaged)
                peak = tracemalloc.get_traced_memory()[1]
            finally:
                tracemalloc.stop()
            assert peak < 50_000 + 100 * len(body), (target.name, place)
