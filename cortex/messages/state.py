"""Messages of poses, velocities and paths."""

from __future__ import annotations

from typing import Annotated

from cortex.message_types import Array, UInt64, Unit, message


@message(name="cortex/Odometry")
class Odometry:
    """The state of a vehicle; of fixed size."""

    stamp_ns: Annotated[int, Unit("ns")]
    """Time of the state [ns]."""
    position: Annotated[Array["float64", 3], Unit("m", frame="world")]
    """p_WB [m], shape [3]."""
    orientation: Array["float64", 4]
    """q_WB, xyzw, shape [4]."""
    velocity: Annotated[Array["float64", 3], Unit("m/s", frame="world")]
    """v_WB in the world frame [m/s], shape [3]."""
    body_rate: Annotated[Array["float64", 3], Unit("rad/s", frame="body")]
    """w_WB in the body frame [rad/s], shape [3]."""
    sequence: UInt64 = 0
    """Counts the states of one vehicle from 0."""


@message(name="cortex/RotorSpeeds")
class RotorSpeeds:
    """How fast the rotors of a vehicle turn."""

    stamp_ns: Annotated[int, Unit("ns")]
    """Time of the measurement [ns]."""
    speed: Annotated[Array["float64", "rotors"], Unit("rad/s")]
    """Speed of each rotor, never negative [rad/s], shape [rotors]."""
    sequence: UInt64 = 0
    """Counts the measurements of one vehicle from 0."""


@message(name="cortex/Collision")
class Collision:
    """A vehicle touches something; of fixed size."""

    stamp_ns: Annotated[int, Unit("ns")]
    """Time of the contact [ns]."""
    position: Annotated[Array["float64", 3], Unit("m", frame="world")]
    """p_WB [m], shape [3]."""
    clearance_m: Annotated[float, Unit("m")]
    """Distance from the vehicle's centre to the nearest surface, minus its radius [m]; <= 0."""
    sequence: UInt64 = 0
    """Counts the collisions of one vehicle from 0."""


@message(name="cortex/Transform")
class Transform:
    """The pose of a frame in another one: T_PC takes coordinates of the child C to the parent P."""

    stamp_ns: Annotated[int, Unit("ns")]
    """When it holds [ns]."""
    parent: str
    """Name of P."""
    child: str
    """Name of C."""
    translation: Annotated[Array["float64", 3], Unit("m", frame="parent")]
    """p_PC, the origin of the child in the parent [m], shape [3]."""
    rotation: Array["float64", 4]
    """q_PC, xyzw, shape [4]."""
    sequence: UInt64 = 0
    """Counts the transforms of one sender from 0."""


@message(name="cortex/Path")
class Path:
    """Where a vehicle is meant to fly."""

    stamp_ns: Annotated[int, Unit("ns")]
    """From when on it holds [ns]."""
    time_ns: Annotated[Array["int64", "n"], Unit("ns")]
    """When the vehicle is meant to be where [ns], shape [n]."""
    position: Annotated[Array["float64", "n", 3], Unit("m", frame="world")]
    """p_WB [m], shape [n, 3]."""
    frame_id: str = ""
    """Name of the world frame."""
    sequence: UInt64 = 0
    """Counts the paths of one sender from 0."""
