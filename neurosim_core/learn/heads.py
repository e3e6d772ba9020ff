"""What dense prediction tells of each pixel: its target, its loss, and the metrics of the field.

References, depth: Hidalgo-Carrio, Gehrig, Scaramuzza (2020), Learning Monocular Dense Depth from Events, for
the multi-scale gradient loss and the cut-off distances; Eigen, Puhrsch, Fergus (2014), for the
scale-invariant loss and the metrics. Flow: Zhu, Yuan, Chaney, Daniilidis (2018), EV-FlowNet, for the robust
loss and the metrics: endpoint error and the share above 3 px, of all pixels and of those with events. Next
events: Das et al. (2025), Fast Feature Field: past events in a form that suffices to tell future ones.
"""

from __future__ import annotations

import math
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

DEPTH_MAX_M = 80.0
"""What is farther away is no target."""
CUTOFFS_M = (10.0, 20.0, 30.0)
"""Mean errors are given for what is nearer than these."""
_VARIANCE_SHARE = 0.5
_GRADIENT_SHARE = 0.25
_SCALES = (1, 2, 4, 8)
OUTLIER_PX = 3.0
_EDGE_PX = 1e-3
"""Errors far below this are squared: the loss has a slope everywhere."""
_RATE_MIN = 1e-4
"""Of a pixel without events: what never came may come."""


class DepthHead:
    """The logarithm of planar depth [log m] at the end of a window; targets are depth [m]."""

    field: ClassVar[str] = "depth"
    start: ClassVar[tuple[float, ...]] = (math.log(2.0),)
    mirrored: ClassVar[tuple[float, ...]] = (1.0,)
    ahead: ClassVar[int] = 0

    def target(self, value: Tensor) -> Tensor:
        """See `Head.target`."""
        return value[..., None, :, :]

    def loss(self, predicted: Tensor, target: Tensor) -> Tensor:
        """See `depth_loss`."""
        return depth_loss(predicted, target)

    def constant(self, targets: Tensor) -> Tensor:
        """Return the mean of log depth of each pixel."""
        known = _known(targets)
        return torch.where(known, targets, 1.0).log().sum(0) / known.sum(0).clamp(min=1)

    def errors(self) -> DepthErrorSums:
        """See `Head.errors`."""
        return DepthErrorSums()


def depth_loss(log_depth: Tensor, depth_m: Tensor) -> Tensor:
    """Return the scale-invariant loss of log depth plus its gradients' at four scales; shapes [..., H, W].

    Pixels without a finite depth below `DEPTH_MAX_M` do not count.
    """
    known = _known(depth_m)
    error = torch.where(known, log_depth - torch.where(known, depth_m, 1.0).log(), 0.0)
    count = known.sum().clamp(min=1)
    mean = error.sum() / count
    loss = (error**2).sum() / count - _VARIANCE_SHARE * mean**2
    for scale in _SCALES:
        e, k = error[..., ::scale, ::scale], known[..., ::scale, ::scale]
        for axis in (-1, -2):
            step, both = torch.diff(e, dim=axis), _neighbours(k, axis)
            loss = loss + _GRADIENT_SHARE / len(_SCALES) * (step.abs() * both).sum() / both.sum().clamp(min=1)
    return loss


def _known(depth_m: Tensor) -> Tensor:
    return torch.isfinite(depth_m) & (depth_m > 0.0) & (depth_m < DEPTH_MAX_M)


def _neighbours(known: Tensor, axis: int) -> Tensor:
    length = known.shape[axis] - 1
    return known.narrow(axis, 0, length) & known.narrow(axis, 1, length)


class DepthErrors(NamedTuple):
    """How far predictions are off, over all pixels with a depth."""

    abs_rel: float
    """Mean of |error| / depth."""
    rmse_log: float
    """Root of the mean squared error of log depth."""
    si_log: float
    """Variance of the error of log depth, mean over pictures: what is left when the scale is right."""
    delta: tuple[float, float, float]
    """Shares of pixels whose ratio to the truth, or its inverse, is below 1.25, 1.25^2, 1.25^3."""
    mean_m: tuple[float, ...]
    """Mean |error| of what is nearer than `CUTOFFS_M` [m]."""

    def __str__(self) -> str:
        cuts = ", ".join(f"{e:.2f} m to {c:g} m" for e, c in zip(self.mean_m, CUTOFFS_M, strict=True))
        deltas = ", ".join(f"{share:.3f}" for share in self.delta)
        return (
            f"AbsRel {self.abs_rel:.3f}, RMSE log {self.rmse_log:.3f}, SiLog {self.si_log:.4f}, "
            f"delta {deltas}; mean error {cuts}"
        )


class DepthErrorSums:
    """Adds up the errors of pictures."""

    def __init__(self) -> None:
        self._sums = torch.zeros(5, dtype=torch.float64)
        self._cuts = torch.zeros(2, len(CUTOFFS_M), dtype=torch.float64)
        self._si_log: list[float] = []
        self._count = 0

    def add(self, log_depth: Tensor, depth_m: Tensor, seen: Tensor | None = None) -> None:
        """Add pictures, shape [..., H, W]; what was seen does not count."""
        for prediction, truth in zip(
            log_depth.reshape(-1, *log_depth.shape[-2:]),
            depth_m.reshape(-1, *depth_m.shape[-2:]),
            strict=True,
        ):
            known = _known(truth)
            if not known.any():
                continue
            goal, found = truth[known].double(), prediction[known].double()
            error, off_m = found - goal.log(), (found.exp() - goal).abs()
            ratio = error.abs().exp()
            terms = [off_m / goal, error**2, *(ratio < 1.25**k for k in (1, 2, 3))]
            self._sums += torch.stack([term.double().sum().cpu() for term in terms])
            self._si_log.append(float(error.var(correction=0)))
            self._count += len(goal)
            for index, cut_m in enumerate(CUTOFFS_M):
                near = goal < cut_m
                self._cuts[:, index] += torch.stack([off_m[near].sum(), near.sum().double()]).cpu()

    def result(self) -> DepthErrors:
        """Return the errors of all pictures."""
        if self._count == 0:
            raise ValueError("no picture has a depth to compare with")
        abs_rel, squared, *deltas = (self._sums / self._count).tolist()
        one, two, three = deltas
        means = (self._cuts[0] / self._cuts[1].clamp(min=1)).tolist()
        si_log = sum(self._si_log) / len(self._si_log)
        return DepthErrors(abs_rel, squared**0.5, si_log, (one, two, three), tuple(means))


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


class FutureHead:
    """Log odds that a pixel has an event of each polarity, darker and brighter, in the next window.

    Pretraining without labels: what predicts them has to know how edges move, which depth and flow follow
    from.
    """

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
