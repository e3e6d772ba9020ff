"""What `neurosim bench render` found: how pictures are sampled, their errors, and the events of a pan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurosim_core.render.config import TextureFilter

REFERENCE_SAMPLES = 64
"""Samples per pixel of the reference."""
CHECK_PX = 3.0
"""Size of the squares of the checkerboard where they are nearest [px]."""


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """How a picture is sampled; the defaults are those of `RenderConfig`."""

    samples_per_pixel: int = 1
    texture_filter: TextureFilter = "trilinear"
    mip_bias: float = 0.0

    def __str__(self) -> str:
        """Return the settings in words."""
        samples = f"{self.samples_per_pixel} sample{'s' if self.samples_per_pixel > 1 else ''}"
        bias = f", bias {self.mip_bias:+g}" if self.mip_bias else ""
        return f"{samples}, {self.texture_filter}{bias}"


DEFAULT = Sampling()
POINT = Sampling(texture_filter="nearest")
REFERENCE = Sampling(samples_per_pixel=REFERENCE_SAMPLES)
"""Each sample is averaged over an eighth of a pixel, which is nearer to the truth than a sharper bias."""


@dataclass(frozen=True, kw_only=True)
class PictureError:
    """How far pictures of a scene are from the reference, and what they cost."""

    scene: str
    sampling: Sampling
    rms: float
    """Root mean square of the error of log radiance."""
    p99: float
    """99th percentile of its magnitude."""
    picture_s: float
    """Time to render one picture, best of several [s]."""


@dataclass(frozen=True, kw_only=True)
class PanEvents:
    """The events of a pan under one sampling, beside those of the reference."""

    sampling: Sampling
    event_count: int
    true_count: int
    """Events of the reference."""
    missing_count: int
    """Events of the reference that have no partner."""
    wrong_polarity_count: int
    """False events where the reference has one of the other polarity."""
    spurious_count: int
    """Other false events."""
    picture_s: float
    """Time to render one picture [s]."""

    @property
    def false_count(self) -> int:
        """Events that have no partner in the reference."""
        return self.wrong_polarity_count + self.spurious_count


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderResult:
    """What `measure_render` found."""

    device: str
    quick: bool
    width: int
    height: int
    pictures: tuple[PictureError, ...]
    reference_rms: float
    """Root mean square of the error of the reference's log radiance, against 16 times as many samples."""
    pan: tuple[PanEvents, ...]
    pan_width: int
    pan_height: int
    pan_s: float
    """How long it pans [s]."""
    pan_rate_hz: float
    """Renders a second [Hz]."""
    pan_speed_px_s: float
    """Speed of the picture at the centre [px/s]."""
    tolerance_s: float
    """Largest difference in time of two events that are taken for the same [s]."""
    false_per_pixel: NDArray[np.int64]
    """False events of point sampling and of the default in each pixel, shape [2, H, W]."""
    views: NDArray[np.float32]
    """Log radiance at the begin of the pan: point sampling, the default, the reference; shape [3, H, W]."""
