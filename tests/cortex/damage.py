"""Bytes as somebody may send them who means no good."""

from __future__ import annotations

import random
from typing import Any

from cortex.codec import MalformedMessage

_NUMBERS = [n.to_bytes(1, "little") for n in (0, 1, 2, 127, 128, 255)]
_NUMBERS += [
    n.to_bytes(4, "little")
    for n in (0, 1, 7, 8, 24, 255, 1024, 2**16, 2**30, 2**31 - 1, 2**31, 2**32 - 8, 2**32 - 1)
]
_NUMBERS += [n.to_bytes(8, "little") for n in (2**32, 2**63 - 1, 2**64 - 1)]


def mutate(rng: random.Random, body: bytes, reach: int | None = None) -> bytes:
    """Return bytes with a few changes.

    Args:
        rng: Chooses them.
        body: What they are made to.
        reach: Most lie within so many first bytes, where a body has its offsets; None: anywhere.
    """
    data = bytearray(body)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        at = rng.randrange(len(data) + 1)
        if reach is not None and rng.random() < 0.6:
            at = min(at, rng.randrange(reach))
        action = rng.random()
        if action < 0.35:
            change = rng.choice(_NUMBERS)
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


def outcome(decode: Any, *arguments: Any) -> Any:
    """Return the decoded message, or None if it was rejected; any other exception is a failure."""
    try:
        return decode(*arguments)
    except MalformedMessage:
        return None
