"""Depth from events: the loss and the metrics of the field.

References: Hidalgo-Carrio, Gehrig, Scaramuzza (2020), Learning Monocular Dense Depth from Events, for the
multi-scale gradient loss and the cut-off distances; Eigen, Puhrsch, Fergus (2014), for the scale-invariant
loss and the metrics.
"""

from __future__ import annotations

import math
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

DEPTH_MAX_M = 80.0
"""What is farther away is no target."""
CUTOFFS_M = (10.0, 20.0, 30.0)
"""Mean errors are given for what is nearer than these."""
_VARIANCE_SHARE = 0.5
_GRADIENT_SHARE = 0.25
_SCALES = (1, 2, 4, 8)


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
