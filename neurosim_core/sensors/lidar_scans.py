"""Scan patterns of LiDARs: the direction and the time of each ray of a sweep.

A scan is to the renderer what a lens is: a table of rays. Its rows are rings, its columns follow each other
in time. Directions are azimuth and elevation in the sensor's frame S (x forward, y left, z up): azimuth from
x to y, elevation up from the x-y plane.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from neurosim_core.settings import BaseConfig

_ROWS = (8, 7, 6, 5, 4, 3, 2)  # of a pattern: neighbours in time are cast together

DivergenceRad = Annotated[float, Field(gt=0.0, le=0.1)]


class Scan(BaseConfig):
    """Settings that all scans have."""

    divergence_rad: DivergenceRad = 0.003
    """Beam divergence [rad]: textures are filtered over its footprint. The range is that of the beam axis."""

    @property
    def width(self) -> int:
        """Columns."""
        return _shape(self)[1]

    @property
    def height(self) -> int:
        """Rings."""
        return _shape(self)[0]

    def directions(self) -> NDArray[np.float64]:
        """Return azimuth and elevation of each ray [rad], shape [H, W, 2]."""
        raise NotImplementedError(f"{type(self).__name__} must define `directions()`")

    def fractions(self) -> NDArray[np.float64]:
        """Return when each ray is cast: from 0, the first ray, to 1, the last; shape [H, W]."""
        columns = np.linspace(0.0, 1.0, self.width) if self.width > 1 else np.ones(1)
        return np.broadcast_to(columns, (self.height, self.width))

    def span_s(self, period_s: float) -> float:
        """Return the time from the first ray to the last [s], if the settings do not say it."""
        return period_s * (self.width - 1) / self.width

    def ray_table(self, offset_px: tuple[float, float] = (0.5, 0.5)) -> NDArray[np.float32]:
        """Return the unit ray of each place in the optical frame (right, down, forward), shape [H, W, 3]."""
        azimuth, elevation = np.moveaxis(self.directions(), -1, 0)
        level = np.cos(elevation)
        x, y, z = level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)
        return np.stack([-y, -z, x], axis=-1).astype(np.float32)

    def ray_spread(self) -> NDArray[np.float32]:
        """Return the divergence of each ray [rad], shape [H, W]."""
        return np.full((self.height, self.width), self.divergence_rad, np.float32)

    def blind_pixels(self) -> None:
        """All rays see."""


class SpinningScan(Scan):
    """A column of lasers that turns clockwise seen from above; all lasers of a column fire at once.

    Column 0 looks backwards, so that the cut between sweeps is behind the vehicle.
    """

    kind: Literal["spinning"] = "spinning"
    elevations_rad: Annotated[tuple[float, ...], Field(min_length=1, max_length=1024)]
    """Elevation of each ring, from ring 0 on [rad]."""
    columns: Annotated[int, Field(ge=1, le=16384)] = 1024
    """Number of columns per revolution."""

    def directions(self) -> NDArray[np.float64]:
        """Return azimuth and elevation of each ray [rad], shape [H, W, 2]."""
        azimuth = math.pi - 2.0 * math.pi * np.arange(self.columns) / self.columns
        return np.stack(np.broadcast_arrays(azimuth, np.array(self.elevations_rad)[:, None]), axis=-1)


class RosetteScan(Scan):
    """A beam through two prisms that turn at different speeds: petals around the x axis.

    Each thin prism turns the beam by a constant small angle, in the direction in which it points. The real
    pattern goes on from sweep to sweep; here every sweep is the first.

    Reference: Liu, Yuan, Zhang (2022), Low-cost retina-like robotic lidars based on incommensurable scanning.
    """

    kind: Literal["rosette"] = "rosette"
    half_angle_rad: Annotated[float, Field(gt=0.0, lt=1.5)]
    """Half the angle of the field of view [rad]; each prism turns the beam by half of it."""
    prism_rates_hz: tuple[float, float]
    """Rotation rates of the two prisms [Hz]; opposite signs turn against each other."""
    sweep_s: Annotated[float, Field(gt=0.0)]
    """Duration of a sweep [s]."""
    ray_count: Annotated[int, Field(ge=2, le=1_000_000)]
    """Number of rays per sweep."""

    def directions(self) -> NDArray[np.float64]:
        """Return azimuth and elevation of each ray [rad], shape [H, W, 2]."""
        t_s = self.sweep_s * np.arange(self.ray_count) / self.ray_count
        phase = 2.0 * math.pi * np.outer(self.prism_rates_hz, t_s)
        y, z = np.cos(phase).mean(axis=0), np.sin(phase).mean(axis=0)
        return _in_rows(self.half_angle_rad * np.stack([y, z], axis=-1))

    def fractions(self) -> NDArray[np.float64]:
        """Return when each ray is cast, from 0 to 1, shape [H, W]."""
        return _in_rows(np.linspace(0.0, 1.0, self.ray_count))

    def span_s(self, period_s: float) -> float:
        """Return the time from the first ray to the last [s]."""
        return self.sweep_s * (self.ray_count - 1) / self.ray_count


class PatternScan(Scan):
    """The pattern of a solid-state LiDAR from a file, the same in every sweep."""

    kind: Literal["pattern"] = "pattern"
    file: Path
    """Rows t [s], azimuth [rad], elevation [rad] of each ray: .npy, or text with commas and perhaps one line
    of names. Times must not fall."""

    @field_validator("file")
    @classmethod
    def _has_rays(cls, file: Path) -> Path:
        rows = _read_pattern(str(file))
        if rows.ndim != 2 or rows.shape[1] != 3 or len(rows) < 2 or not np.isfinite(rows).all():
            raise ValueError(
                f"{file} must hold finite numbers of shape [rays >= 2, 3], got {list(rows.shape)}"
            )
        if (np.diff(rows[:, 0]) < 0.0).any():
            row = int(np.argmax(np.diff(rows[:, 0]) < 0.0)) + 1
            raise ValueError(f"{file}: the time of ray {row} is before that of the ray before")
        return file

    def directions(self) -> NDArray[np.float64]:
        """Return azimuth and elevation of each ray [rad], shape [H, W, 2]."""
        return _in_rows(_read_pattern(str(self.file))[:, 1:])

    def fractions(self) -> NDArray[np.float64]:
        """Return when each ray is cast, from 0 to 1, shape [H, W]."""
        t_s = _read_pattern(str(self.file))[:, 0]
        return _in_rows((t_s - t_s[0]) / (t_s[-1] - t_s[0]) if t_s[-1] > t_s[0] else np.ones(len(t_s)))

    def span_s(self, period_s: float) -> float:
        """Return the time from the first ray to the last [s]."""
        return float(np.ptp(_read_pattern(str(self.file))[:, 0]))


AnyScan = Annotated[SpinningScan | RosetteScan | PatternScan, Field(discriminator="kind")]


def _in_rows(rays: NDArray[Any]) -> NDArray[Any]:
    """Return values of rays in the order of time as [H, W, ...], H of them below each other."""
    count = next((count for count in _ROWS if len(rays) % count == 0), 1)
    rows: NDArray[Any] = rays.reshape(-1, count, *rays.shape[1:]).swapaxes(0, 1)
    return rows


@functools.lru_cache(maxsize=8)
def _shape(scan: Scan) -> tuple[int, int]:
    height, width = scan.directions().shape[:2]
    return height, width


@functools.lru_cache(maxsize=8)
def _read_pattern(file: str) -> NDArray[np.float64]:
    if file.endswith(".npy"):
        return np.asarray(np.load(file), dtype=np.float64)
    with Path(file).open() as text:
        names = text.readline()
    header = not names.replace(",", " ").split()[0].lstrip("-+").replace(".", "").isdigit()
    return np.loadtxt(file, delimiter=",", skiprows=int(header), ndmin=2)
