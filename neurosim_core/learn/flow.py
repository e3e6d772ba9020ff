"""Optical flow from events: the endpoint error, as it is learned and as it is told.

References: Zhu, Yuan, Chaney, Daniilidis (2018), EV-FlowNet, for the robust loss and the metrics: endpoint
error and the share above 3 px, of all pixels and of those with events.
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

OUTLIER_PX = 3.0
_EDGE_PX = 1e-3
"""Errors far below this are squared: the loss has a slope everywhere."""


class FlowHead:
    """Where in the picture at the start of a window each pixel of its end was, column and row [px]."""

    field: ClassVar[str] = "flow"
    start: ClassVar[tuple[float, ...]] = (0.0, 0.0)
    mirrored: ClassVar[tuple[float, ...]] = (-1.0, 1.0)
    ahead: ClassVar[int] = 0

    def target(self, value: Tensor) -> Tensor:
        """See `Head.target`."""
        return value[..., :2].movedim(-1, -3)

    def loss(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Return the mean endpoint error of pixels whose flow is known [px]."""
        off, known = _off(predicted, target)
        return ((off.square().sum(-3) + _EDGE_PX**2).sqrt() * known).sum() / known.sum().clamp(min=1)

    def constant(self, targets: Tensor) -> Tensor:
        """Return the mean flow of each pixel."""
        return torch.nanmean(torch.where(torch.isfinite(targets), targets, torch.nan), 0).nan_to_num()

    def errors(self) -> FlowErrorSums:
        """See `Head.errors`."""
        return FlowErrorSums()


def _off(predicted: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    known = torch.isfinite(target).all(-3)
    return torch.where(known.unsqueeze(-3), predicted - target, 0.0), known


class FlowErrors(NamedTuple):
    """How far predictions are off, over all pixels whose flow is known."""

    endpoint_px: float
    """Mean endpoint error [px]."""
    outliers: float
    """Share of pixels whose endpoint error is above 3 px."""
    events_endpoint_px: float
    """Mean endpoint error of pixels with events in the window [px]."""
    events_outliers: float
    """Share of those whose endpoint error is above 3 px."""

    def __str__(self) -> str:
        return (
            f"endpoint error {self.endpoint_px:.3f} px, above 3 px {self.outliers:.1%}; where events are "
            f"{self.events_endpoint_px:.3f} px, {self.events_outliers:.1%}"
        )


class FlowErrorSums:
    """Adds up the errors of pictures."""

    def __init__(self) -> None:
        self._sums = torch.zeros(2, 3, dtype=torch.float64)

    def add(self, predicted: Tensor, truth: Tensor, seen: Tensor) -> None:
        """See `Errors.add`."""
        off, known = _off(predicted, truth)
        error = off.double().square().sum(-3).sqrt()
        for row, counted in enumerate((known, known & (seen != 0).any(-3))):
            taken = error[counted]
            self._sums[row] += torch.stack([taken.sum(), (taken > OUTLIER_PX).sum(), counted.sum()]).cpu()

    def result(self) -> FlowErrors:
        """See `Errors.result`."""
        if self._sums[0, 2] == 0:
            raise ValueError("no picture has a flow to compare with")
        means = self._sums[:, :2] / self._sums[:, 2:].clamp(min=1)
        return FlowErrors(*means.flatten().tolist())
