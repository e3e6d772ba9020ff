"""Commands of a multirotor, from the rotors up to a pose.

Each command holds until the next one. A thrust is the sum over all rotors, along the body's z axis.
"""

from __future__ import annotations

from typing import Annotated

from cortex.message_types import Array, UInt64, Unit, message


@message(name="cortex/MotorCommand")
class MotorCommand:
    """A speed for each rotor."""

    stamp_ns: Annotated[int, Unit("ns")]
    """Time of the state that the command answers [ns]."""
    speed: Annotated[Array["float64", "rotors"], Unit("rad/s")]
    """Commanded speeds [rad/s], shape [rotors]."""
    sequence: UInt64 = 0
    """Counts the commands of one controller from 0."""


@message(name="cortex/RateThrustCommand")
class RateThrustCommand:
    """Thrust and body rates; of fixed size."""

    stamp_ns: Annotated[int, Unit("ns")]
    """Time of the state that the command answers [ns]."""
    thrust_n: Annotated[float, Unit("N", frame="body")]
    """Collective thrust [N]."""
    body_rate: Annotated[Array["float64", 3], Unit("rad/s", frame="body")]
    """w_WB in the body frame [rad/s], shape [3]."""
    sequence: UInt64 = 0
    """Counts the commands of one controller from 0."""


@message(name="cortex/AttitudeCommand")
class AttitudeCommand:
    """Thrust and attitude; of fixed size."""

    stamp_ns: Annotated[int, Unit("ns")]
    """Time of the state that the command answers [ns]."""
    thrust_n: Annotated[float, Unit("N", frame="body")]
    """Collective thrust [N]."""
    orientation: Array["float64", 4]
    """q_WB, xyzw, shape [4]."""
    sequence: UInt64 = 0
    """Counts the commands of one controller from 0."""


@message(name="cortex/VelocityCommand")
class VelocityCommand:
    """A velocity, and how fast to turn; of fixed size."""

    stamp_ns: Annotated[int, Unit("ns")]
    """Time of the state that the command answers [ns]."""
    velocity: Annotated[Array["float64", 3], Unit("m/s", frame="world")]
    """v_WB in the world frame [m/s], shape [3]."""
    yaw_rate_rad_s: Annotated[float, Unit("rad/s", frame="world")] = 0.0
    """Rate of the heading about the world's z axis [rad/s]."""
    sequence: UInt64 = 0
    """Counts the commands of one controller from 0."""


@message(name="cortex/PoseCommand")
class PoseCommand:
    """A place to hover at, and where to look; of fixed size."""

    stamp_ns: Annotated[int, Unit("ns")]
    """Time of the state that the command answers [ns]."""
    position: Annotated[Array["float64", 3], Unit("m", frame="world")]
    """p_WB [m], shape [3]."""
    yaw_rad: Annotated[float, Unit("rad", frame="world")] = 0.0
    """Heading, counter-clockwise from east [rad]."""
    sequence: UInt64 = 0
    """Counts the commands of one controller from 0."""
