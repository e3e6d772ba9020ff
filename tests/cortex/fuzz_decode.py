"""Decode damaged bodies, and demand that each one is decoded or rejected, the same way by all decoders.

C must agree with the general decoder in Python on every body.
"""

from __future__ import annotations

import random
from collections import Counter
from typing import Any

import numpy as np
from wire_vectors import load_vectors

from cortex.codec import Codec, MalformedMessage, codec_of
from cortex.schema import Schema, type_from_schema

INTERESTING = [bytes([n]) for n in (0, 1, 2, 127, 128, 255)]
INTERESTING += [
    n.to_bytes(4, "little")
    for n in (0, 1, 7, 8, 24, 255, 1024, 2**16, 2**30, 2**31 - 1, 2**31, 2**32 - 8, 2**32 - 1)
]
INTERESTING += [n.to_bytes(8, "little") for n in (2**32, 2**63 - 1, 2**64 - 1)]


class Target:
    """One type with its good and malformed bodies."""

    def __init__(self, name: str, vector: dict[str, Any]) -> None:
        self.name = name
        self.codec: Codec = codec_of(type_from_schema(Schema.from_json(vector["schema"])))
        self.bodies = [bytes.fromhex(case["body"]) for case in vector["cases"] + vector["malformed"]]


def targets() -> list[Target]:
    """Return all types of the test vectors."""
    return [Target(name, vector) for name, vector in load_vectors().items()]


def mutate(rng: random.Random, body: bytes) -> bytes:
    """Return a body with a few changes, mostly in its block, where the offsets are."""
    data = bytearray(body)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        at = rng.randrange(len(data) + 1)
        if rng.random() < 0.6:
            at = min(at, rng.randrange(120))
        action = rng.random()
        if action < 0.35:
            change = rng.choice(INTERESTING)
            at -= at % len(change) if rng.random() < 0.8 else 0
            data[at : at + len(change)] = change
        elif action < 0.6 and data:
            data[at % len(data)] ^= 1 << rng.randrange(8)
        elif action < 0.75 and data:
            data[at % len(data)] = rng.randrange(256)
        elif action < 0.85:
            del data[at:]
        elif action < 0.92:
            del data[at : at + rng.choice((1, 4, 8))]
        else:
            data[at:at] = rng.randbytes(rng.choice((1, 4, 8, 64)))
    return bytes(data)


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


def outcome(decode: Any, *arguments: Any) -> Any:
    """Return the decoded message, or None if it was rejected; any other exception is a failure."""
    try:
        return decode(*arguments)
    except MalformedMessage:
        return None


def check(target: Target, body: bytes) -> bool:
    """Decode a body in every way and return whether it was accepted."""
    codec = target.codec
    first = outcome(codec.decode, body)
    framed = b"\xff" * 64 + body + b"\xff" * 64
    within = outcome(codec.decode, framed, 64, len(body))
    general = outcome(codec._body.read, np.frombuffer(framed, np.uint8), 64, len(body))
    accepted = first is not None
    assert accepted == (within is not None) == (general is not None), (target.name, body.hex())
    if accepted:
        # Items never share bytes, and a list element takes a byte at least.
        assert touch(first) <= 2 * len(body), (target.name, body.hex())
        # Through the bytes, which are equal for nan as well.
        again = codec.encode(first, 2**32)
        assert again is not None
        assert again == codec.encode(general, 2**32) == codec.encode(within, 2**32), (target.name, body.hex())
        assert codec.encode(codec.decode(again), 2**32) == again
    return accepted


def run(count: int, seed: int) -> Counter[str]:
    """Check so many mutated bodies and return how many were accepted and rejected."""
    rng = random.Random(seed)
    all_targets = targets()
    results: Counter[str] = Counter()
    for index in range(count):
        target = all_targets[index % len(all_targets)]
        body = mutate(rng, rng.choice(target.bodies))
        accepted = check(target, body)
        results["accepted" if accepted else "rejected"] += 1
    return results
