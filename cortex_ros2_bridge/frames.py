"""Frames: what they are called in ROS 2 (REP 103, 105), and vectors turned between body and world.

    map -> VEHICLE/odom -> VEHICLE/base_link -> VEHICLE/SENSOR, VEHICLE/SENSOR_optical_frame

Cortex calls the map frame `world` and has no odom frame; as its odometry does not drift, odom is where map
is. Axes agree on both sides: map is ENU, base_link x forward, y left, z up, optical frames x right, y down, z
forward.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ConfigDict

Vector = NDArray[np.float64]
WORLD = "world"
BODY = "base_link"
HEADING = "base_footprint"

FrameKind = Literal["world", "body", "heading"]
"""Fixed to the ground; fixed to the vehicle; below the vehicle, level, x where its nose points."""


@dataclass(frozen=True, kw_only=True)
class FrameNames:
    """Names of frames in ROS."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    prefix: str = ""
    """Prefix of all names but those in `rename`."""
    map: str = "map"
    """Name of Cortex's `world`."""
    odom: str = "odom"
    """Name of the frame in which a vehicle moves, after the name of the vehicle."""
    rename: dict[str, str] = field(default_factory=dict)
    """Names in ROS of single frames, by their names in Cortex, such as {drone/base_link: base_link}."""

    def __post_init__(self) -> None:
        names = {"prefix": self.prefix or "ok", "map": self.map, "odom": self.odom}
        names |= {f"rename.{old}": new for old, new in self.rename.items()}
        for key, name in names.items():
            if not name or name.startswith("/") or any(c.isspace() for c in name):
                raise ValueError(
                    f"frames.{key} must be a name without spaces and a slash in front, got {name!r}"
                )

    def ros(self, frame: str) -> str:
        """Return the name in ROS of a frame of Cortex; of "", "" again."""
        if frame in self.rename:
            return self.rename[frame]
        return f"{self.prefix}{self.map if frame == WORLD else frame}" if frame else ""

    def odom_of(self, vehicle: str) -> str:
        """Return the name in ROS of a vehicle's odom frame; Cortex would call it VEHICLE/odom."""
        return self.ros(f"{vehicle}/{self.odom}" if vehicle else self.odom)

    def body_of(self, vehicle: str) -> str:
        """Return the name in ROS of a vehicle's body frame."""
        return self.ros(f"{vehicle}/{BODY}" if vehicle else BODY)

    def known(self, vehicle: str) -> dict[str, FrameKind]:
        """Return the frames that a command for a vehicle may name, by their full and by their short names."""
        ground = self.ros(WORLD), self.odom_of(vehicle), self.map, self.odom, WORLD
        body = self.body_of(vehicle), f"{vehicle}/{BODY}", BODY
        heading = self.ros(f"{vehicle}/{HEADING}"), f"{vehicle}/{HEADING}", HEADING
        return {
            **dict.fromkeys(ground, "world"),
            **dict.fromkeys(body, "body"),
            **dict.fromkeys(heading, "heading"),
        }

    def kind_of(self, ros_frame: str, vehicle: str) -> FrameKind | None:
        """Return what a frame is that a command names; None if it is none of a vehicle's."""
        return self.known(vehicle).get(ros_frame.lstrip("/"))


def rotate(q: ArrayLike, v: ArrayLike) -> Vector:
    """Return R(q) v: in A, of a unit quaternion q_AB (xyzw) and a vector in B."""
    x, y, z, w = np.asarray(q, np.float64).tolist()
    a, b, c = np.asarray(v, np.float64).tolist()
    # v + 2 u x (u x v + w v) with u = (x, y, z), written out: np.cross takes ten times as long.
    p, r, s = y * c - z * b + w * a, z * a - x * c + w * b, x * b - y * a + w * c
    return np.array([a + 2.0 * (y * s - z * r), b + 2.0 * (z * p - x * s), c + 2.0 * (x * r - y * p)])


def rotate_back(q: ArrayLike, v: ArrayLike) -> Vector:
    """Return R(q)^T v: in B, of a unit quaternion q_AB (xyzw) and a vector in A."""
    x, y, z, w = np.asarray(q, np.float64).tolist()
    return rotate((-x, -y, -z, w), v)


def yaw_rad(q: ArrayLike) -> float:
    """Return where a unit quaternion (xyzw) turns the x axis, counter-clockwise from east [rad]."""
    x, y, z, w = np.asarray(q, np.float64).tolist()
    return float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
