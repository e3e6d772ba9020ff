"""Random numbers with addresses: a number depends on the seed and its name, not on what else is asked for."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np

from neurosim_core.random import stream_id

T = TypeVar("T")


def stream(seed: int, *key: str | int) -> np.random.Generator:
    """Return a generator for the arrays of one subject, such as the noise of a texture."""
    words = [stream_id(str(part)) for part in key]
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(seed, spawn_key=words)))


class Draws:
    """Random numbers of one subject, each with a name."""

    def __init__(self, *key: object) -> None:
        self._key = key

    def under(self, *key: object) -> Draws:
        """Return the numbers of a part of this subject."""
        return Draws(*self._key, *key)

    def uniform(self, name: str, low: float = 0.0, high: float = 1.0) -> float:
        """Return a number in [low, high)."""
        digest = hashlib.blake2b(repr((self._key, name)).encode(), digest_size=8).digest()
        return low + (high - low) * (int.from_bytes(digest, "little") / 2.0**64)

    def chance(self, name: str, probability: float) -> bool:
        """Return True with a probability."""
        return self.uniform(name) < probability

    def pick(self, name: str, options: Sequence[T]) -> T:
        """Return one of several options, each with the same probability."""
        return options[int(self.uniform(name) * len(options))]

    def functions(self, name: str) -> dict[str, Callable[..., Any]]:
        """Return functions for an expression of that name; each call in it is a number of its own."""
        call = (f"{name}.{index}" for index in itertools.count())
        return {
            "uniform": lambda low=0.0, high=1.0: self.uniform(next(call), low, high),
            "jitter": lambda reach: self.uniform(next(call), -reach, reach),
            "chance": lambda probability: self.chance(next(call), probability),
            "pick": lambda *options: self.pick(next(call), options),
        }
