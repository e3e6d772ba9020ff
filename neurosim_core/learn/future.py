"""Pretraining without labels: which pixels have events in the next window, from the windows before.

What predicts the next events has to know how edges move, which depth and flow follow from.

Reference: Das et al. (2025), Fast Feature Field: past events in a form that suffices to tell future ones.
"""

from __future__ import annotations

import math
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

_RATE_MIN = 1e-4
"""Of a pixel without events: what never came may come."""


class FutureHead:
    """Log odds that a pixel has an event of each polarity, darker and brighter, in the next window."""

    field: ClassVar[str] = "events"
    start: ClassVar[tuple[float, ...]] = (-2.0, -2.0)
    mirrored: ClassVar[tuple[float, ...]] = (1.0, 1.0)
    ahead: ClassVar[int] = 1

    def target(self, value: Tensor) -> Tensor:
        """Return 1 where there are events, of counts [..., 2, H, W]."""
        return (value > 0).float()

    def loss(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Return the mean cross entropy [nat]."""
        return functional.binary_cross_entropy_with_logits(predicted, target)

    def constant(self, targets: Tensor) -> Tensor:
        """Return the log odds of how often each pixel has events."""
        return torch.logit(targets.float().mean(0), eps=_RATE_MIN)

    def errors(self) -> FutureErrorSums:
        """See `Head.errors`."""
        return FutureErrorSums()


class FutureErrors(NamedTuple):
    """How well events were foretold."""

    bits: float
    """Cross entropy of a pixel, a polarity and a window [bit]."""
    f1: float
    """Of those foretold with more than one chance in two: harmonic mean of precision and recall."""

    def __str__(self) -> str:
        return f"{self.bits:.4f} bit for each pixel and polarity, F1 {self.f1:.3f}"


class FutureErrorSums:
    """Adds up the errors of pictures."""

    def __init__(self) -> None:
        self._sums = torch.zeros(4, dtype=torch.float64)

    def add(self, predicted: Tensor, truth: Tensor, seen: Tensor | None = None) -> None:
        """See `Errors.add`."""
        nats = functional.binary_cross_entropy_with_logits(
            predicted.double(), truth.double(), reduction="sum"
        )
        said = predicted > 0.0
        counts = [(said & (truth > 0)).sum(), said.sum() + (truth > 0).sum()]
        self._sums += torch.stack(
            [nats.cpu(), *(count.double().cpu() for count in counts), nats.new_tensor(truth.numel()).cpu()]
        )

    def result(self) -> FutureErrors:
        """See `Errors.result`."""
        nats, hits, both, count = self._sums.tolist()
        if not count:
            raise ValueError("no window follows on another")
        return FutureErrors(nats / count / math.log(2.0), 2.0 * hits / max(both, 1.0))
