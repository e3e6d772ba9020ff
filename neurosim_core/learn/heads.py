"""Heads of dense prediction: the target of each pixel, its loss, and the metrics of the field.

References, depth: Hidalgo-Carrio, Gehrig, Scaramuzza (2020), Learning Monocular Dense Depth from Events, for
the multi-scale gradient loss and the cut-off distances; Eigen, Puhrsch, Fergus (2014), for the
scale-invariant loss and the metrics. Flow: Zhu, Yuan, Chaney, Daniilidis (2018), EV-FlowNet, for the robust
loss and the metrics: endpoint error and the share above 3 px, of all pixels and of those with events. Next
events: Das et al. (2025), Fast Feature Field: past events in a form that suffices to tell future ones.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

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


class Head(ABC):
    """The prediction of each pixel, and its quality; targets and predictions are [..., C, H, W]."""

    field: ClassVar[str]
    """Of a batch: where the target comes from."""
    start: ClassVar[tuple[float, ...]]
    """Predicted before training, one number for each channel."""
    mirrored: ClassVar[tuple[float, ...]]
    """Factor of each channel in a mirrored picture."""
    ahead: ClassVar[int] = 0
    """Of so many windows later."""

    @abstractmethod
    def target(self, value: Tensor) -> Tensor:
        """Return the target of what a batch has."""

    @abstractmethod
    def loss(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Return what is to become small."""

    @abstractmethod
    def constant(self, targets: Tensor) -> Tensor:
        """Return the best prediction of each pixel without events, of targets [n, C, H, W]."""

    @abstractmethod
    def measure(self, predicted: Tensor, truth: Tensor, seen: Tensor) -> Tensor:
        """Return sums over a picture, shape [1, C, H, W], and the voxels that it was predicted from.

        Sums of several pictures, float64 on the host, may be added.
        """

    @abstractmethod
    def errors(self, sums: Tensor) -> Any:
        """Return the errors of all pictures, a NamedTuple.

        Raises:
            ValueError: There is nothing to compare with.
        """


class DepthHead(Head):
    """The logarithm of planar depth [log m] at the end of a window; targets are depth [m]."""

    field: ClassVar[str] = "depth"
    start: ClassVar[tuple[float, ...]] = (math.log(2.0),)
    mirrored: ClassVar[tuple[float, ...]] = (1.0,)

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

    def measure(self, predicted: Tensor, truth: Tensor, seen: Tensor) -> Tensor:
        """See `Head.measure`; what was seen does not count."""
        known = _known(truth)
        goal, found = truth[known].double(), predicted[known].double()
        error, off_m = found - goal.log(), (found.exp() - goal).abs()
        ratio = error.abs().exp()
        shares = [off_m / goal, error**2, *(ratio < 1.25**k for k in (1, 2, 3)), torch.ones_like(goal)]
        near = [goal < cut_m for cut_m in CUTOFFS_M]
        cuts = [*(off_m[each] for each in near), *near]
        spread = error.var(correction=0) if len(goal) else error.sum()
        return torch.stack(
            [*(each.double().sum() for each in (*shares, *cuts)), spread, known.any().double()]
        ).cpu()

    def errors(self, sums: Tensor) -> DepthErrors:
        """See `Head.errors`."""
        shares, count, cuts, (spread, pictures) = sums.split([5, 1, 2 * len(CUTOFFS_M), 2])
        if not count:
            raise ValueError("no picture has a depth to compare with")
        abs_rel, squared, one, two, three = (shares / count).tolist()
        off_m, near = cuts.chunk(2)
        means = (off_m / near.clamp(min=1)).tolist()
        si_log = float(spread / pictures)
        return DepthErrors(abs_rel, squared**0.5, si_log, (one, two, three), tuple(means))


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
    """Errors of predictions, over all pixels with a depth."""

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


class FlowHead(Head):
    """Where in the picture at the start of a window each pixel of its end was, column and row [px]."""

    field: ClassVar[str] = "flow"
    start: ClassVar[tuple[float, ...]] = (0.0, 0.0)
    mirrored: ClassVar[tuple[float, ...]] = (-1.0, 1.0)

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

    def measure(self, predicted: Tensor, truth: Tensor, seen: Tensor) -> Tensor:
        """See `Head.measure`."""
        off, known = _off(predicted, truth)
        error = off.double().square().sum(-3).sqrt()
        taken = [error[counted] for counted in (known, known & (seen != 0).any(-3))]
        sums = [(each.sum(), (each > OUTLIER_PX).sum(), torch.tensor(len(each))) for each in taken]
        return torch.tensor(sums, dtype=torch.float64)

    def errors(self, sums: Tensor) -> FlowErrors:
        """See `Head.errors`."""
        if sums[0, 2] == 0:
            raise ValueError("no picture has a flow to compare with")
        means = sums[:, :2] / sums[:, 2:].clamp(min=1)
        return FlowErrors(*means.flatten().tolist())


def _off(predicted: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    known = torch.isfinite(target).all(-3)
    return torch.where(known.unsqueeze(-3), predicted - target, 0.0), known


class FlowErrors(NamedTuple):
    """Errors of predictions, over all pixels whose flow is known."""

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
            f"endpoint error {self.endpoint_px:.3f} px, above 3 px {100 * self.outliers:.1f} %; "
            f"where events are {self.events_endpoint_px:.3f} px, {100 * self.events_outliers:.1f} %"
        )


class FutureHead(Head):
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

    def measure(self, predicted: Tensor, truth: Tensor, seen: Tensor) -> Tensor:
        """See `Head.measure`."""
        nats = functional.binary_cross_entropy_with_logits(
            predicted.double(), truth.double(), reduction="sum"
        )
        said, happened = predicted > 0.0, truth > 0
        counts = ((said & happened).sum(), said.sum() + happened.sum(), truth.numel())
        return torch.tensor([nats, *counts], dtype=torch.float64)

    def errors(self, sums: Tensor) -> FutureErrors:
        """See `Head.errors`."""
        nats, hits, both, count = sums.tolist()
        return FutureErrors(nats / count / math.log(2.0), 2.0 * hits / max(both, 1.0))


class FutureErrors(NamedTuple):
    """The quality of predicted events."""

    bits: float
    """Cross entropy of a pixel, a polarity and a window [bit]."""
    f1: float
    """Of those foretold with more than one chance in two: harmonic mean of precision and recall."""

    def __str__(self) -> str:
        return f"{self.bits:.4f} bit for each pixel and polarity, F1 {self.f1:.3f}"


HEADS: dict[str, Head] = {"depth": DepthHead(), "flow": FlowHead(), "pretrain": FutureHead()}
"""What can be learned, by the name of its command."""
