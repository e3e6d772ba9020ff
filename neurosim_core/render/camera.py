"""The interface of a lens to a renderer, and the pinhole; the other lenses are in `lenses.py`.

A renderer knows nothing of a lens but its table of rays, so that any lens can be used.
"""

from __future__ import annotations

import math
from typing import ClassVar, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from neurosim_core.settings import BaseConfig


class Lens(Protocol):
    """The interface of a lens to a renderer; equal lenses have the same rays, which are kept."""

    def __hash__(self) -> int: ...

    @property
    def width(self) -> int:
        """Width of the picture [px]."""

    @property
    def height(self) -> int:
        """Height of the picture [px]."""

    def ray_table(self, offset_px: tuple[float, float] = (0.5, 0.5)) -> NDArray[np.float32]:
        """Return the unit ray of each pixel in the optical frame C, shape [H, W, 3]."""

    def ray_spread(self) -> NDArray[np.float32]:
        """Return the angle between the rays of neighbouring pixels [rad], shape [H, W]."""

    def blind_pixels(self) -> NDArray[np.bool_] | None:
        """Return which pixels see nothing, shape [H, W]; None: all see."""


class Intrinsics(NamedTuple):
    """A pinhole in pixels: pixel column = fx * x / z + cx, pixel row = fy * y / z + cy."""

    fx: float
    fy: float
    cx: float
    cy: float

    def matrix(self) -> NDArray[np.float64]:
        """Return the camera matrix, shape [3, 3]."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


class PinholeConfig(BaseConfig):
    """A pinhole camera, given by its field of view or by fx, fy, cx, cy, not by both."""

    distortion_model: ClassVar[str] = ""
    """It does not distort."""

    kind: Literal["pinhole"] = "pinhole"
    width: int = Field(gt=0, le=16384)
    """Width of the picture [px]."""
    height: int = Field(gt=0, le=16384)
    """Height of the picture [px]."""
    horizontal_fov_rad: float | None = Field(default=None, gt=0.0, lt=math.pi)
    """Angle between the left and the right border of the picture [rad]; pixels are square, and the optical
    axis goes through the centre."""
    fx: float | None = Field(default=None, gt=0.0)
    """Focal length along a row [px]."""
    fy: float | None = Field(default=None, gt=0.0)
    """Focal length along a column [px]."""
    cx: float | None = None
    """Column of the optical axis [px]; the centre of the first pixel is at 0.5."""
    cy: float | None = None
    """Row of the optical axis [px]; the centre of the first pixel is at 0.5."""

    @model_validator(mode="after")
    def _exactly_one_form(self) -> PinholeConfig:
        pixels = {"fx": self.fx, "fy": self.fy, "cx": self.cx, "cy": self.cy}
        given = [name for name, value in pixels.items() if value is not None]
        if self.horizontal_fov_rad is not None and given:
            raise ValueError(
                f"give horizontal_fov_rad or fx, fy, cx, cy, not both: got horizontal_fov_rad and {given}"
            )
        if self.horizontal_fov_rad is None and len(given) < 4:
            missing = f": missing {[name for name in pixels if name not in given]}" if given else ""
            raise ValueError(f"give horizontal_fov_rad (such as 1.5), or all of fx, fy, cx, cy{missing}")
        return self

    @property
    def distortion_coefficients(self) -> tuple[float, ...]:
        """There are none."""
        return ()

    def intrinsics(self) -> Intrinsics:
        """Return fx, fy, cx, cy [px], whichever way the camera was given."""
        if self.fx is not None and self.fy is not None and self.cx is not None and self.cy is not None:
            return Intrinsics(self.fx, self.fy, self.cx, self.cy)
        assert self.horizontal_fov_rad is not None
        focal = 0.5 * self.width / math.tan(0.5 * self.horizontal_fov_rad)
        return Intrinsics(focal, focal, 0.5 * self.width, 0.5 * self.height)

    def ray_table(self, offset_px: tuple[float, float] = (0.5, 0.5)) -> NDArray[np.float32]:
        """Return the unit ray of each pixel in the optical frame C (x right, y down, z forward).

        Args:
            offset_px: Where in the pixel the ray goes through (column, row) [px]; the centre is (0.5, 0.5).

        Returns:
            Directions, shape [H, W, 3].
        """
        fx, fy, cx, cy = self.intrinsics()
        x = (np.arange(self.width) + offset_px[0] - cx) / fx
        y = (np.arange(self.height) + offset_px[1] - cy) / fy
        length = np.sqrt(x**2 + (y[:, None] ** 2 + 1.0))
        rays = np.empty((self.height, self.width, 3), dtype=np.float32)
        rays[..., 0] = x / length
        rays[..., 1] = y[:, None] / length
        rays[..., 2] = 1.0 / length
        return rays

    def ray_spread(self) -> NDArray[np.float32]:
        """Return the angle between the rays of neighbouring pixels: the root of a pixel's solid angle.

        A pixel of a pinhole at the angle a off the axis covers cos(a)^3 / (fx fy) steradian.

        Returns:
            Angles [rad], shape [H, W].
        """
        fx, fy, _, _ = self.intrinsics()
        cosine = self.ray_table()[..., 2].astype(np.float64)
        return np.sqrt(cosine**3 / (fx * fy)).astype(np.float32)

    def blind_pixels(self) -> None:
        """All pixels see."""
