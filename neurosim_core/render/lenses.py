"""Lenses other than a pinhole: each turns pixels into rays once, when it is loaded.

A model projects a point of the optical frame C to u = fx x_d + cx, v = fy y_d + cy [px], where (x_d, y_d) is
what distortion makes of the direction (`projection.py`). Pixel centres are at +0.5, half a pixel more than in
OpenCV, ROS and Kalibr. Directions of pixels are found in float64 by Newton's method, or in closed form.

A pixel that no ray reaches, because it is outside the image circle or beyond the range of the model, is
*blind*: it is black, and its depth is infinite.

References: OpenCV documentation, modules calib3d (radtan, rational) and fisheye; Kannala, Brandt (2006), A
Generic Camera Model and Calibration Method for Conventional, Wide-Angle, and Fish-Eye Lenses; Usenko, Demmel,
Cremers (2018), The Double Sphere Camera Model, eq. (40) to (52).
"""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Discriminator, Field, Tag, model_validator

from neurosim_core.render.camera import Intrinsics, PinholeConfig
from neurosim_core.settings import BaseConfig

Vectors = NDArray[np.float64]

_NEWTON_MAX = 50
_RESIDUAL_MAX = 1e-10
"""Distortion is undone to this [1]: with a focal length of 10,000 px, to a millionth of a pixel."""
_ANGLE_MAX_RAD = math.radians(89.0)
"""Largest angle from the axis that polynomials of x / z and y / z are taken for."""
_TABLE_SIZE = 4096


class _Lens(BaseConfig):
    """The base class of all lenses but the pinhole."""

    width: int = Field(gt=0, le=16384)
    """Width of the picture [px]."""
    height: int = Field(gt=0, le=16384)
    """Height of the picture [px]."""
    distortion_model: ClassVar[str]
    """Name of the model in sensor_msgs/CameraInfo, which has none for double spheres and tables."""

    @property
    def distortion_coefficients(self) -> tuple[float, ...]:
        """Parameters of the model, in the order of sensor_msgs/CameraInfo."""
        return getattr(self, "distortion", ())

    def rays(self, u: Vectors, v: Vectors) -> Vectors:
        """Return the unit rays of points of the picture [px], shape [..., 3]; nan where there is none."""
        raise NotImplementedError

    def ray_table(self, offset_px: tuple[float, float] = (0.5, 0.5)) -> NDArray[np.float32]:
        """Return the unit ray of each pixel in C, as `PinholeConfig.ray_table`.

        Where the point of the pixel sees nothing, that of its centre; where that sees nothing, (0, 0, 1).
        """
        rays = self._rays_at(*offset_px)
        blind = np.isnan(rays).any(axis=-1)
        if blind.any():
            rays[blind] = self._rays_at(0.5, 0.5)[blind]
            rays[np.isnan(rays).any(axis=-1)] = (0.0, 0.0, 1.0)
        return np.asarray(rays, dtype=np.float32)

    def ray_spread(self) -> NDArray[np.float32]:
        """Return the root of each pixel's solid angle [rad], by central differences, shape [H, W]."""
        across = self._rays_at(0.75, 0.5) - self._rays_at(0.25, 0.5)
        down = self._rays_at(0.5, 0.75) - self._rays_at(0.5, 0.25)
        solid = 4.0 * np.linalg.norm(np.cross(across, down), axis=-1)
        solid[np.isnan(solid)] = np.nanmedian(solid)
        return np.asarray(np.sqrt(solid), dtype=np.float32)

    def blind_pixels(self) -> NDArray[np.bool_] | None:
        """Return which pixels see nothing, shape [H, W]; None: all see."""
        blind: NDArray[np.bool_] = np.any(np.isnan(self._rays_at(0.5, 0.5)), axis=-1, keepdims=False)
        return blind if blind.any() else None

    def _rays_at(self, column: float, row: float) -> Vectors:
        """Return the unit rays of one point of each pixel, shape [H, W, 3]; nan where there is none."""
        return self.rays(*np.meshgrid(np.arange(self.width) + column, np.arange(self.height) + row))


class _ModelLens(_Lens):
    """A lens given by focal lengths, principal point and what it does to directions."""

    fx: float = Field(gt=0.0)
    """Focal length along a row [px]."""
    fy: float = Field(gt=0.0)
    """Focal length along a column [px]."""
    cx: float
    """Column of the optical axis [px]; the centre of the first pixel is at 0.5."""
    cy: float
    """Row of the optical axis [px]; the centre of the first pixel is at 0.5."""

    def intrinsics(self) -> Intrinsics:
        """Return fx, fy, cx, cy [px]."""
        return Intrinsics(self.fx, self.fy, self.cx, self.cy)

    def undistort(self, x: Vectors, y: Vectors) -> Vectors:
        """Return the unit rays of (x_d, y_d), shape [..., 3]; nan where there is none."""
        raise NotImplementedError

    def rays(self, u: Vectors, v: Vectors) -> Vectors:
        """Return the unit rays of points of the picture [px], shape [..., 3]; nan where there is none."""
        return self.undistort((u - self.cx) / self.fx, (v - self.cy) / self.fy)


class _PolynomialLens(_ModelLens):
    """Radial and tangential distortion of x / z and y / z: OpenCV's model with up to 8 coefficients.

    With r^2 = x^2 + y^2 and g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6):
    x_d = x g + 2 p1 x y + p2 (r^2 + 2 x^2), y_d = y g + p1 (r^2 + 2 y^2) + 2 p2 x y.
    """

    def _coefficients(self) -> tuple[float, ...]:
        """Return k1, k2, p1, p2, k3, k4, k5, k6."""
        given = self.distortion_coefficients
        return (*given, *(0.0 for _ in range(8 - len(given))))

    @model_validator(mode="after")
    def _reaches_the_border(self) -> _PolynomialLens:
        columns, rows = np.arange(self.width + 1.0), np.arange(self.height + 1.0)
        u = np.concatenate([columns, columns, 0.0 * rows, 0.0 * rows + self.width])
        v = np.concatenate([0.0 * columns, 0.0 * columns + self.height, rows, rows])
        lost = np.isnan(self.rays(u, v)).any(axis=-1)
        if lost.any():
            first = int(np.argmax(lost))
            raise ValueError(
                f"no direction is distorted to column {u[first]:g}, row {v[first]:g} of the picture: the "
                "polynomial folds over before the border; check the coefficients and their order, or take "
                "kind equidistant or double_sphere for a wide lens"
            )
        return self

    def _radial(self, r2: Vectors) -> tuple[Vectors, Vectors]:
        """Return g and its derivative by r^2."""
        k1, k2, _, _, k3, k4, k5, k6 = self._coefficients()
        top, bottom = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        slope = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3)
        slope_bottom = k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6)
        return top / bottom, (slope * bottom - top * slope_bottom) / bottom**2

    def _evaluate(self, x: Vectors, y: Vectors) -> tuple[Vectors, ...]:
        """Return x_d and y_d, and their derivatives: dx_d/dx, dx_d/dy = dy_d/dx, dy_d/dy."""
        _, _, p1, p2, *_ = self._coefficients()
        r2 = x * x + y * y
        g, slope = self._radial(r2)
        return (
            x * g + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * g + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            g + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
            2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y,
            g + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
        )

    @property
    @functools.lru_cache(maxsize=32)  # noqa: B019  (a cached_property counts in comparisons)
    def _rising(self) -> tuple[Vectors, Vectors]:
        """Radii of x / z and y / z, and what becomes of them, as far as the latter grow."""
        r = np.tan(np.linspace(0.0, _ANGLE_MAX_RAD, _TABLE_SIZE))
        with np.errstate(all="ignore"):
            distorted = r * self._radial(r * r)[0]
            grows = (np.diff(distorted) > 0.0) & np.isfinite(distorted[1:])
        end = len(r) if grows.all() else int(np.argmin(grows)) + 1
        return r[:end], distorted[:end]

    def undistort(self, x: Vectors, y: Vectors) -> Vectors:
        """Return the unit rays of (x_d, y_d), shape [..., 3]; nan where there is none."""
        radii, distorted = self._rising
        size = np.hypot(x, y)
        scale = np.interp(size, distorted, radii) / np.where(size > 0.0, size, 1.0)
        px, py = x * scale, y * scale  # exact but for the tangential part and the table
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON_MAX):
                fx, fy, xx, xy, yy = self._evaluate(px, py)
                ex, ey, det = fx - x, fy - y, xx * yy - xy * xy
                px, py = px - (yy * ex - xy * ey) / det, py - (xx * ey - xy * ex) / det
                error = np.hypot(ex, ey)
                if np.nanmax(error, initial=0.0) < 1e-3 * _RESIDUAL_MAX:
                    break
            found = (np.hypot(*np.subtract(self._evaluate(px, py)[:2], (x, y))) < _RESIDUAL_MAX) & (det > 0.0)
            found &= np.hypot(px, py) <= radii[-1] * (1.0 + 1e-9)
        rays = np.stack([px, py, np.ones_like(px)], axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        return np.where(found[..., None], rays, np.nan)


class RadtanConfig(_PolynomialLens):
    """A lens with radial and tangential distortion: Kalibr's radtan, plumb_bob of ROS."""

    kind: Literal["radtan"] = "radtan"
    distortion_model: ClassVar[str] = "plumb_bob"
    distortion: Annotated[tuple[float, ...], Field(min_length=4, max_length=5)]
    """Coefficients k1, k2, p1, p2 and, if there is one, k3."""

    @property
    def distortion_coefficients(self) -> tuple[float, ...]:
        """Return k1, k2, p1, p2, k3."""
        return (*self.distortion, *(0.0 for _ in range(5 - len(self.distortion))))


class RationalConfig(_PolynomialLens):
    """A lens with radial distortion by a quotient of polynomials, and tangential distortion."""

    kind: Literal["rational"] = "rational"
    distortion_model: ClassVar[str] = "rational_polynomial"
    distortion: Annotated[tuple[float, ...], Field(min_length=8, max_length=8)]
    """Coefficients k1, k2, p1, p2, k3, k4, k5, k6."""


class _WideLens(_ModelLens):
    """A lens that may see more than a half-space."""

    angle_max_rad: float = Field(default=math.pi, gt=0.0, le=math.pi)
    """Angle from the optical axis beyond which nothing is seen: the border of the image circle [rad]."""


class EquidistantConfig(_WideLens):
    """A fisheye lens after Kannala and Brandt: r_d = a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8).

    a is the angle from the optical axis. It is OpenCV's fisheye model and Kalibr's equi.
    """

    kind: Literal["equidistant"] = "equidistant"
    distortion_model: ClassVar[str] = "equidistant"
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Coefficients k1, k2, k3, k4; zeros are the ideal equidistant projection."""

    def _radius(self, angle: Vectors) -> tuple[Vectors, Vectors]:
        """Return r_d and its derivative."""
        k1, k2, k3, k4 = self.distortion
        a2 = angle * angle
        return (
            angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))),
            1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4))),
        )

    @property
    @functools.lru_cache(maxsize=32)  # noqa: B019  (as above)
    def _rising(self) -> Vectors:
        """Angles up to the border, or up to where the radius ceases to grow, evenly spaced."""
        k1, k2, k3, k4 = self.distortion
        roots = np.roots([9.0 * k4, 7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
        turns = [math.sqrt(root.real) for root in roots if abs(root.imag) < 1e-12 and root.real > 0.0]
        return np.linspace(0.0, min([self.angle_max_rad, *turns]), _TABLE_SIZE)

    def undistort(self, x: Vectors, y: Vectors) -> Vectors:
        """Return the unit rays of (x_d, y_d), shape [..., 3]; nan where there is none."""
        angles = self._rising
        size = np.hypot(x, y)
        angle = np.interp(size, self._radius(angles)[0], angles)
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON_MAX):
                radius, slope = self._radius(angle)
                step = np.where(slope > 0.0, (radius - size) / slope, 0.0)
                angle = np.clip(angle - step, 0.0, angles[-1])
                if np.abs(step).max(initial=0.0) < 1e-15:
                    break
        found = np.abs(self._radius(angle)[0] - size) < _RESIDUAL_MAX
        scale = np.sin(angle) / np.where(size > 0.0, size, 1.0)
        rays = np.stack([x * scale, y * scale, np.cos(angle)], axis=-1)
        return np.where(found[..., None], rays, np.nan)


class DoubleSphereConfig(_WideLens):
    """A fisheye lens whose rays are projected onto two unit spheres and then by a pinhole."""

    kind: Literal["double_sphere"] = "double_sphere"
    distortion_model: ClassVar[str] = "double_sphere"
    xi: float = Field(gt=-1.0, lt=1.0)
    """Distance between the centres of the two spheres."""
    alpha: float = Field(ge=0.0, le=1.0)
    """Position of the pinhole: alpha / (1 - alpha) behind the centre of the second sphere."""

    @property
    def distortion_coefficients(self) -> tuple[float, ...]:
        """Return xi, alpha."""
        return (self.xi, self.alpha)

    def undistort(self, x: Vectors, y: Vectors) -> Vectors:
        """Return the unit rays of (x_d, y_d), shape [..., 3]; nan where there is none: eq. (46) to (52)."""
        xi, alpha = self.xi, self.alpha
        r2 = x * x + y * y
        with np.errstate(all="ignore"):
            mz = (1.0 - alpha * alpha * r2) / (alpha * np.sqrt(1.0 - (2.0 * alpha - 1.0) * r2) + 1.0 - alpha)
            scale = (mz * xi + np.sqrt(mz * mz + (1.0 - xi * xi) * r2)) / (mz * mz + r2)
        rays = np.stack([scale * x, scale * y, scale * mz - xi], axis=-1)
        angle = np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])
        return np.where((angle <= self.angle_max_rad)[..., None], rays, np.nan)


class RayTableConfig(_Lens):
    """A lens given by the ray of each pixel, as a calibration of any camera model can write it."""

    kind: Literal["ray_table"] = "ray_table"
    distortion_model: ClassVar[str] = "ray_table"
    file: Path
    """A NumPy file (.npy), float, shape [H, W, 3]: directions in C (x right, y down, z forward) through the
    centres of the pixels, of any length; nan or zero where a pixel sees nothing. Between centres rays are
    interpolated."""

    @model_validator(mode="after")
    def _has_the_size(self) -> RayTableConfig:
        self.directions()
        return self

    def directions(self) -> Vectors:
        """Return the unit rays of the file, nan where there is none, shape [H, W, 3]."""
        return _read_rays(self.file, self.width, self.height)

    def intrinsics(self) -> Intrinsics:
        """Return the pinhole that is like the lens around the centre of the picture."""
        u, v = np.array(0.5 * self.width), np.array(0.5 * self.height)
        centre = self.rays(u, v)
        slope = centre[:2] / centre[2]
        right, below = self.rays(u + 1.0, v), self.rays(u, v + 1.0)
        fx, fy = 1.0 / (right[0] / right[2] - slope[0]), 1.0 / (below[1] / below[2] - slope[1])
        return Intrinsics(float(fx), float(fy), float(u - fx * slope[0]), float(v - fy * slope[1]))

    def rays(self, u: Vectors, v: Vectors) -> Vectors:
        """Return the unit rays of points of the picture [px], shape [..., 3]; nan where there is none."""
        table = self.directions()
        col = np.clip(np.floor(u - 0.5).astype(int), 0, max(self.width - 2, 0))
        row = np.clip(np.floor(v - 0.5).astype(int), 0, max(self.height - 2, 0))
        x, y = (u - 0.5 - col)[..., None], (v - 0.5 - row)[..., None]  # beyond the border: extrapolated
        right, below = np.minimum(col + 1, self.width - 1), np.minimum(row + 1, self.height - 1)

        def part(weight: Vectors, ray: Vectors) -> Vectors:
            return np.where(weight == 0.0, 0.0, weight * ray)  # no weight: a blind neighbour does not count

        rays = (
            part((1.0 - x) * (1.0 - y), table[row, col])
            + part(x * (1.0 - y), table[row, right])
            + part((1.0 - x) * y, table[below, col])
            + part(x * y, table[below, right])
        )
        return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


@functools.lru_cache(maxsize=8)
def _read_rays(file: Path, width: int, height: int) -> Vectors:
    try:
        table = np.load(file.expanduser(), allow_pickle=False)
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot read the rays of {file}: {error}") from None
    if not isinstance(table, np.ndarray) or table.shape != (height, width, 3) or table.dtype.kind != "f":
        got = f"{table.dtype} {list(table.shape)}" if isinstance(table, np.ndarray) else "several arrays"
        raise ValueError(f"{file} must hold floats of shape [{height}, {width}, 3], got {got}")
    with np.errstate(all="ignore"):
        rays = table.astype(np.float64) / np.linalg.norm(table.astype(np.float64), axis=-1, keepdims=True)
    if np.isnan(rays).all():
        raise ValueError(f"{file} has no pixel with a ray")
    return np.asarray(rays)


def _kind_of(value: Any) -> str:
    return str(value.get("kind", "pinhole") if isinstance(value, dict) else getattr(value, "kind", "pinhole"))


AnyLens = Annotated[
    Annotated[PinholeConfig, Tag("pinhole")]
    | Annotated[RadtanConfig, Tag("radtan")]
    | Annotated[RationalConfig, Tag("rational")]
    | Annotated[EquidistantConfig, Tag("equidistant")]
    | Annotated[DoubleSphereConfig, Tag("double_sphere")]
    | Annotated[RayTableConfig, Tag("ray_table")],
    Discriminator(_kind_of),
]
"""A lens in settings; `kind` says which one, by default pinhole."""
