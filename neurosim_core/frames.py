# mypy: disable-error-code="call-overload"
"""Frames and rotations, once.

W is the world (ENU, z up), B the body (x forward, y left, z up), C a camera (optical: x right, y down, z
forward). Quaternions are xyzw and `q_WB` takes body coordinates to world coordinates. Inner letters match:
`R_WC = R_WB @ R_BC`, `p_WC = p_WB + R_WB @ p_BC`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy  # which imports its parts when they are used
import warp as wp
from numpy.typing import ArrayLike, NDArray
from pydantic import model_validator

from neurosim_core.settings import BaseConfig

Vector3 = tuple[float, float, float]

Q_FORWARD_OPTICAL = (-0.5, 0.5, -0.5, 0.5)
"""Quaternion that takes optical coordinates to those of a forward, left, up frame that looks the same way."""

_FEW = 16
"""Numbers that are checked one by one: up to here that is quicker than by NumPy."""
UNIT_TOLERANCE = 1e-3
"""How far the length of a quaternion that is given as a rotation may be from 1."""


_MOUNT_MAX_M = 20.0
"""What is mounted further from the body was meant in millimetres [m]."""


class Mount(BaseConfig):
    """Pose of a sensor on the body, T_BS, exactly as given."""

    position_m: Vector3 = (0.0, 0.0, 0.0)
    """Origin of the sensor in the body frame (x forward, y left, z up) [m]."""
    rpy_rad: Vector3 = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw of the sensor relative to the body [rad]: R = Rz(yaw) Ry(pitch) Rx(roll). A camera
    with zeros looks forward; positive pitch looks down."""

    @model_validator(mode="after")
    def _units_are_right(self) -> Mount:
        if max(map(abs, self.rpy_rad)) > 2.0 * math.pi:
            radians = [round(math.radians(value), 6) for value in self.rpy_rad]
            raise ValueError(
                f"rpy_rad must be within +-2 pi, got {[*self.rpy_rad]}; if these are degrees, write {radians}"
            )
        if max(map(abs, self.position_m)) > _MOUNT_MAX_M:
            raise ValueError(
                f"position_m must be within +-{_MOUNT_MAX_M:g} m of the body, got {[*self.position_m]}; if "
                f"these are millimetres, write {[1e-3 * value for value in self.position_m]}"
            )
        return self

    def rotation(self) -> scipy.spatial.transform.Rotation:
        """Return R_BS for a sensor with axes forward, left, up."""
        return scipy.spatial.transform.Rotation.from_euler("xyz", self.rpy_rad)

    def quaternion(self) -> NDArray[np.float64]:
        """Return q_BS (xyzw, shape [4]) for a sensor with axes forward, left, up, as `rotation` has it.

        Flights do without SciPy's rotations, which take 0.2 s to import.
        """
        (sin_r, cos_r), (sin_p, cos_p), (sin_y, cos_y) = (
            (math.sin(0.5 * angle), math.cos(0.5 * angle)) for angle in self.rpy_rad
        )
        pitch_roll = _product((0.0, sin_p, 0.0, cos_p), (sin_r, 0.0, 0.0, cos_r))
        return np.array(_product((0.0, 0.0, sin_y, cos_y), pitch_roll))

    def optical_quaternion(self) -> NDArray[np.float64]:
        """Return q_BC (xyzw, shape [4]) for a camera with optical axes right, down, forward."""
        x, y, z, w = _product(self.quaternion().tolist(), Q_FORWARD_OPTICAL)
        return np.array([x, y, z, w]) / math.sqrt(x * x + y * y + z * z + w * w)


def _product(p: Sequence[float], q: Sequence[float]) -> tuple[float, float, float, float]:
    """Return the product of two quaternions, xyzw."""
    (px, py, pz, pw), (qx, qy, qz, qw) = p, q
    return (
        pw * qx + qw * px + (py * qz - pz * qy),
        pw * qy + qw * py + (pz * qx - px * qz),
        pw * qz + qw * pz + (px * qy - py * qx),
        pw * qw - px * qx - py * qy - pz * qz,
    )


@wp.func
def quaternion_exp(rotation: wp.vec3d) -> wp.quatd:
    """Return the unit quaternion of a rotation vector [rad].

    The series below 1e-4 rad is exact to rounding: its next term is 1e-4^6 / 46080.
    """
    half = wp.float64(0.5) * wp.length(rotation)
    scale = wp.float64(0.5)
    if half > wp.float64(5.0e-5):
        scale = wp.sin(half) / (wp.float64(2.0) * half)
    else:
        half2 = half * half
        scale = wp.float64(0.5) * (
            wp.float64(1.0) - half2 / wp.float64(6.0) * (wp.float64(1.0) - half2 / wp.float64(20.0))
        )
    v = scale * rotation
    return wp.quatd(v[0], v[1], v[2], wp.cos(half))


def heading_rad(q_WB: ArrayLike) -> float:
    """Return the yaw of a Z-X-Y sequence [rad]: y_B is orthogonal to (cos yaw, sin yaw, 0).

    Args:
        q_WB: Unit quaternion, xyzw, shape [4].

    Raises:
        ValueError: It is no unit quaternion, by more than rounding in single precision.
    """
    q = np.asarray(q_WB, dtype=np.float64)
    if q.shape != (4,) or not abs(math.hypot(*q.tolist()) - 1.0) < UNIT_TOLERANCE:
        raise ValueError(f"q_WB must be a unit quaternion, got {q.tolist()}")
    x, y, z, w = q.tolist()
    return math.atan2(2.0 * (w * z - x * y), 1.0 - 2.0 * (x * x + z * z))


def normalised(orientation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return quaternions of unit length.

    Raises:
        ValueError: One is 0, or too large to be normalised.
    """
    with np.errstate(over="ignore"):
        norm: NDArray[np.float64] = np.linalg.norm(orientation, axis=1, keepdims=True)
    if not ((norm > 1e-6) & (norm < np.inf)).all():
        raise ValueError(
            f"orientation must not be 0, nor too large to be normalised, got {orientation.tolist()}"
        )
    return orientation / norm


def as_rows(value: Any, *, name: str, count: int, width: int) -> NDArray[np.float64]:
    """Return `value` as float64 [count, width], broadcasting one row to all.

    Raises:
        ValueError: If the shape does not fit or an element is not finite.
    """
    rows = np.asarray(value, dtype=np.float64)
    if count == 1 and rows.shape == (width,) and width <= _FEW and all(map(math.isfinite, rows.tolist())):
        return np.ascontiguousarray(rows).reshape(1, width)  # a command, in every control period
    if rows.shape not in ((width,), (1, width), (count, width)):
        raise ValueError(f"{name} must have shape [{count}, {width}] or [{width}], got {list(rows.shape)}")
    if not np.isfinite(rows).all():
        raise ValueError(f"{name} must be finite, got {rows.tolist()}")
    return np.ascontiguousarray(np.broadcast_to(rows, (count, width)))
