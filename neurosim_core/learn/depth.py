"""Depth from events: a U-Net with memory, its loss, and the metrics of the field.

References: Hidalgo-Carrio, Gehrig, Scaramuzza (2020), Learning Monocular Dense Depth from Events, for the
recurrent U-Net, the multi-scale gradient loss and the cut-off distances; Eigen, Puhrsch, Fergus (2014), for
the scale-invariant loss and the metrics; Ballas, Yao, Pal, Courville (2016), for the convolutional GRU.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

DEPTH_MAX_M = 80.0
"""What is farther away is no target."""
CUTOFFS_M = (10.0, 20.0, 30.0)
"""Mean errors are given for what is nearer than these."""
_STEP = 8
"""Heights and widths are filled up to multiples of this: the network halves them three times."""
_VARIANCE_SHARE = 0.5
_GRADIENT_SHARE = 0.25
_SCALES = (1, 2, 4, 8)

Memory = tuple[Tensor, ...]


class ConvGru(nn.Module):
    """A gated recurrent unit whose products are convolutions."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gates = nn.Conv2d(2 * channels, 2 * channels, 3, padding=1)
        self.candidate = nn.Conv2d(2 * channels, channels, 3, padding=1)

    def forward(self, x: Tensor, memory: Tensor) -> Tensor:
        """Return the memory after an input, both of shape [B, C, H, W]."""
        reset, update = torch.sigmoid(self.gates(torch.cat([x, memory], 1))).chunk(2, 1)
        candidate = torch.tanh(self.candidate(torch.cat([x, reset * memory], 1)))
        return torch.lerp(memory, candidate, update)


def _block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride, 1), nn.GroupNorm(4, outputs), nn.SiLU())


class DepthNet(nn.Module):
    """Predicts the logarithm of depth from voxels of events, window after window.

    Args:
        bins: Channels of a voxel.
        channels: Of the finest level; coarser ones have 2, 4 and 4 times as many.
        depth_m: What it predicts at first [m].
    """

    def __init__(self, bins: int = 5, channels: int = 16, depth_m: float = 2.0) -> None:
        super().__init__()
        self.bins, self.channels = bins, channels
        c = channels
        sizes = (c, 2 * c, 4 * c, 4 * c)
        self.head = _block(bins, c)
        self.down = nn.ModuleList(_block(a, b, 2) for a, b in itertools.pairwise(sizes))
        self.memories = nn.ModuleList(ConvGru(size) for size in sizes[1:])
        self.up = nn.ModuleList(_block(a + b, b) for a, b in zip(sizes[:0:-1], sizes[-2::-1], strict=True))
        self.out = nn.Conv2d(c, 1, 1)
        nn.init.zeros_(self.out.weight)
        self.out.bias = nn.Parameter(torch.tensor([depth_m]).log())

    def forward(self, voxel: Tensor, memory: Memory | None = None) -> tuple[Tensor, Memory]:
        """Return log depth [log m], shape [B, H, W], and the memory after the window.

        Args:
            voxel: Of a window, shape [B, bins, H, W].
            memory: After the window before; None: there is none.
        """
        height, width = voxel.shape[-2:]
        x = torch.sign(voxel) * torch.log1p(voxel.abs())  # pixels with many events do not drown the others
        x = functional.pad(x, (0, -width % _STEP, 0, -height % _STEP))
        levels = [self.head(x)]
        kept = []
        for index, (down, unit) in enumerate(zip(self.down, self.memories, strict=True)):
            x = down(levels[-1])
            kept.append(unit(x, torch.zeros_like(x) if memory is None else memory[index]))
            levels.append(kept[-1])
        x = levels.pop()
        for up in self.up:
            x = up(torch.cat([functional.interpolate(x, scale_factor=2.0), levels.pop()], 1))
        return self.out(x)[:, 0, :height, :width], tuple(kept)


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


class ErrorSums:
    """Adds up the errors of pictures."""

    def __init__(self) -> None:
        self._sums = torch.zeros(5, dtype=torch.float64)
        self._cuts = torch.zeros(2, len(CUTOFFS_M), dtype=torch.float64)
        self._si_log: list[float] = []
        self._count = 0

    def add(self, log_depth: Tensor, depth_m: Tensor) -> None:
        """Add pictures, shape [..., H, W]."""
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
        """Return the errors of all pictures.

        Raises:
            ValueError: None has a depth.
        """
        if self._count == 0:
            raise ValueError("no picture has a depth to compare with")
        abs_rel, squared, *deltas = (self._sums / self._count).tolist()
        one, two, three = deltas
        means = (self._cuts[0] / self._cuts[1].clamp(min=1)).tolist()
        si_log = sum(self._si_log) / len(self._si_log)
        return DepthErrors(abs_rel, squared**0.5, si_log, (one, two, three), tuple(means))
