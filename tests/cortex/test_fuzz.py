"""Damaged bodies of every type are decoded or rejected and nothing else, by C as by Python."""

from __future__ import annotations

import os
import random
import tracemalloc
from typing import Any

import numpy as np
from damage import mutate, outcome
from wire_vectors import load_vectors

from cortex.codec import codec_of
from cortex.schema import Schema, type_from_schema

TARGETS = [
    (
        codec_of(type_from_schema(Schema.from_json(vector["schema"]))),
        [bytes.fromhex(case["body"]) for case in vector["cases"] + vector["malformed"]],
    )
    for vector in load_vectors().values()
]
"""The types of the test vectors, with good and malformed bodies."""


def touch(value: Any) -> int:
    """Read everything that a decoded value refers to, and return how much that is."""
    if isinstance(value, np.ndarray):
        assert not value.flags.writeable
        return len(value.tobytes())
    if isinstance(value, (str, bytes)):
        return len(value)
    if isinstance(value, list):
        return sum(map(touch, value)) + len(value)
    names = getattr(value, "__cortex_names__", ())
    return sum(touch(getattr(value, name)) for name in names)


def is_accepted(codec: Any, body: bytes) -> bool:
    """Decode a body in every way and return whether it was accepted."""
    framed = b"\xff" * 64 + body + b"\xff" * 64
    first = outcome(codec.decode, body)
    within = outcome(codec.decode, framed, 64, len(body))
    general = outcome(codec._body.read, np.frombuffer(framed, np.uint8), 64, len(body))
    said = (codec.schema.name, body.hex())
    assert (first is None) == (within is None) == (general is None), said
    if first is None:
        return False
    # Items never share bytes, and a list element takes a byte at least.
    assert touch(first) <= 2 * len(body), said
    # Through the bytes, which are equal for nan as well.
    again = codec.encode(first, 2**32)
    assert again is not None
    assert again == codec.encode(general, 2**32) == codec.encode(within, 2**32), said
    assert codec.encode(codec.decode(again), 2**32) == again
    return True


def test_mutated_bodies():
    rng, accepted, count = random.Random(1), 0, int(os.environ.get("CORTEX_FUZZ_BODIES", "20000"))
    for index in range(count):
        codec, bodies = TARGETS[index % len(TARGETS)]
        accepted += is_accepted(codec, mutate(rng, rng.choice(bodies), reach=120))
    assert accepted > 2_000  # else the mutations would only show that wrong sizes are rejected
    assert count - accepted > 5_000


def test_rejecting_takes_no_memory():
    """Whatever counts and offsets a body claims, decoding allocates no more than a small multiple of it."""
    for codec, body in ((codec, body) for codec, bodies in TARGETS for body in bodies):
        for place in range(0, min(len(body) - 4, 96), 4):
            damaged = body[:place] + b"\xff\xff\xff\x7f" + body[place + 4 :]
            tracemalloc.start()
            try:
                outcome(codec.decode, damaged)
                peak = tracemalloc.get_traced_memory()[1]
            finally:
                tracemalloc.stop()
            assert peak < 50_000 + 100 * len(body), (codec.schema.name, place)
