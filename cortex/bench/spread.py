"""How sure a median is of a few repetitions."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

_CONFIDENCE = 0.95


@dataclass(frozen=True)
class Spread:
    """A median, and between what the true one lies."""

    median: float
    low: float
    """With `high`, the 95 % interval of the median, whatever the distribution; the range of 8 or fewer."""
    high: float
    count: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread | None:
        """Return the spread of some figures; None if there are none."""
        if not values:
            return None
        ordered = sorted(values)
        left_out = _left_out(len(ordered))
        return cls(statistics.median(ordered), ordered[left_out], ordered[-1 - left_out], len(ordered))

    @property
    def half_width(self) -> float:
        """Half of the interval."""
        return (self.high - self.low) / 2.0

    def leaves_open(self, bound: float) -> bool:
        """Whether the interval has figures on both sides of a bound."""
        return self.low < bound < self.high


def _left_out(count: int) -> int:
    """How many of the smallest figures, and of the largest, lie outside of the interval.

    The true median exceeds each figure with probability 1/2: so how many lie below it is binomial.
    """
    left_out, below = 0, 1 + count
    while 2 * below <= (1.0 - _CONFIDENCE) * 2**count:
        left_out += 1
        below += math.comb(count, left_out + 1)
    return left_out
