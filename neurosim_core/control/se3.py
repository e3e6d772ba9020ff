# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,assignment"
"""Geometric tracking control on SE(3), one Warp function a level; each level hands a target to the one below.

    position -> velocity -> thrust vector -> attitude -> torque -> rotor speeds (allocation.py)

Reference: Lee, Leok, McClamroch (2010), Geometric tracking control of a quadrotor UAV on SE(3), IEEE CDC:
force and moment of the position controlled flight mode, with feed-forward of the desired rate and angular
acceleration. Two things differ. Gains are accelerations (the paper's divided by mass and inertia), so that
one set flies vehicles of any size. And the attitude error is 2 sin(angle / 2) instead of sin(angle) about the
same axis, which agrees for small errors but does not fade towards 180 degrees: Lee (2011), Geometric tracking
control of the attitude dynamics of a rigid body on SO(3), ACC (attitude error function 2 - sqrt(1 + tr)).
"""

from typing import Annotated

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field

from neurosim_core.control.allocation import Motors, clip
from neurosim_core.control.flatness import AttitudeReference, Heading, attitude_reference
from neurosim_core.settings import BaseConfig
from neurosim_core.trajectory.path import PathPoint
from neurosim_core.vehicle.airframe import MultirotorConfig
from neurosim_core.vehicle.command_ranges import command_ranges

wp.set_module_options({"enable_backward": False})

Gain = Annotated[float, Field(ge=0.0, le=1e6)]
Limit = Annotated[float, Field(gt=0.0, le=1e6)]

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_SQUARABLE = wp.constant(wp.float64(1.0e100))
"""The square of a number up to this one is finite."""


class Se3Config(BaseConfig):
    """Gains and limits of the geometric controller.

    Gains are per unit mass and inertia, hence natural frequencies and damping: position sqrt(10) = 3.2 rad/s,
    attitude 20 rad/s. Without motor lag and within limits the attitude error e obeys e'' + rate_gain e' +
    attitude_gain e = 0.
    """

    position_gain_per_s2: Gain = 10.0
    """Acceleration per metre of position error [1/s^2]."""
    velocity_gain_per_s: Annotated[float, Field(gt=0.0, le=1e6)] = 5.0
    """Acceleration per m/s of velocity error [1/s]."""
    attitude_gain_per_s2: Gain = 400.0
    """Angular acceleration per radian of roll and pitch error [1/s^2]."""
    rate_gain_per_s: Gain = 35.0
    """Angular acceleration per rad/s of roll and pitch rate error [1/s]."""
    yaw_gain_per_s2: Gain = 25.0
    """Angular acceleration per radian of yaw error [1/s^2]; lower, because rotors give little yaw torque."""
    yaw_rate_gain_per_s: Gain = 10.0
    """Angular acceleration per rad/s of yaw rate error [1/s]."""
    correction_speed_max_m_s: Limit = 4.0
    """Largest velocity that corrects a position error, in addition to the reference's [m/s]."""
    correction_acceleration_max_m_s2: Limit = 8.0
    """Largest acceleration that corrects errors, in addition to the reference's [m/s^2]. Below 9.81, errors
    alone never turn the vehicle upside down."""
    body_rate_max_rad_s: Limit = 20.0
    """Largest body rate, from feed-forward or as a command [rad/s]."""
    motor_response_s: Limit = 0.02
    """Motors that are slower than this are overdriven so that they close on the wanted speed with this time
    constant [s], as far as their limits allow; needs measured rotor speeds. Choose it no shorter than the
    control period."""
    feed_forward_air: bool = True
    """Whether drag and lift of the vehicle's own model in still air are cancelled; wind is a disturbance."""


@wp.struct
class Se3Parameters:
    """Vehicle, gains and limits, as kernels take them; see `Se3Config` for the gains."""

    mass_kg: wp.float64  # Mass [kg]
    gravity_m_s2: wp.float64  # Gravity [m/s^2]
    inertia: wp.mat33d  # Inertia about the centre of mass, in B [kg m^2]
    thrust_max_m_s2: wp.float64  # Highest collective thrust over mass [m/s^2]
    motors: Motors  # Limits of the motors
    position_per_velocity_per_s: wp.float64  # Position gain over velocity gain [1/s]
    velocity_gain_per_s: wp.float64  # Acceleration per velocity error [1/s]
    attitude_gain: wp.vec3d  # About the body axes [1/s^2]
    rate_gain: wp.vec3d  # About the body axes [1/s]
    speed_max_m_s: wp.float64  # Highest correcting velocity [m/s]
    acceleration_max_m_s2: wp.float64  # Highest correcting acceleration [m/s^2]
    body_rate_max_rad_s: wp.float64  # Highest body rate asked for [rad/s]
    command_thrust_max_n: wp.float64  # Highest collective thrust that a command may ask for [N]
    command_speed_max_m_s: wp.float64  # Highest speed that a command may ask for [m/s]
    command_rate_max_rad_s: wp.float64  # Highest body or yaw rate that a command may ask for [rad/s]
    command_position_max_m: wp.float64  # Largest coordinate that a command may ask for [m]


def make_parameters(
    vehicle: MultirotorConfig, config: Se3Config, matrix: NDArray[np.float64]
) -> Se3Parameters:
    """Return what kernels need to know of a vehicle, its gains and its `allocation_matrix`."""
    parameters = Se3Parameters()
    parameters.mass_kg = vehicle.mass_kg
    parameters.gravity_m_s2 = vehicle.gravity_m_s2
    parameters.inertia = wp.mat33d(np.array(vehicle.inertia_kg_m2))
    parameters.thrust_max_m_s2 = vehicle.rotor_speed_max_rad_s**2 / matrix[:, 0].max() / vehicle.mass_kg
    parameters.motors.speed_min_rad_s = vehicle.rotor_speed_min_rad_s
    parameters.motors.speed_max_rad_s = vehicle.rotor_speed_max_rad_s
    slower = vehicle.motor_time_constant_s > config.motor_response_s
    parameters.motors.lead = vehicle.motor_time_constant_s / config.motor_response_s if slower else 1.0
    parameters.position_per_velocity_per_s = config.position_gain_per_s2 / config.velocity_gain_per_s
    parameters.velocity_gain_per_s = config.velocity_gain_per_s
    parameters.attitude_gain = wp.vec3d(
        config.attitude_gain_per_s2, config.attitude_gain_per_s2, config.yaw_gain_per_s2
    )
    parameters.rate_gain = wp.vec3d(
        config.rate_gain_per_s, config.rate_gain_per_s, config.yaw_rate_gain_per_s
    )
    parameters.speed_max_m_s = config.correction_speed_max_m_s
    parameters.acceleration_max_m_s2 = config.correction_acceleration_max_m_s2
    parameters.body_rate_max_rad_s = config.body_rate_max_rad_s
    ranges = command_ranges(vehicle)
    parameters.command_thrust_max_n = ranges.thrust_max_n
    parameters.command_speed_max_m_s = ranges.speed_max_m_s
    parameters.command_rate_max_rad_s = ranges.body_rate_max_rad_s
    parameters.command_position_max_m = ranges.position_max_m
    return parameters


@wp.struct
class VehicleState:
    """State of one vehicle."""

    position: wp.vec3d  # p_WB [m]
    velocity: wp.vec3d  # v_WB in W [m/s]
    orientation: wp.quatd  # q_WB, xyzw
    body_rate: wp.vec3d  # w_WB in B [rad/s]
    air_acceleration: wp.vec3d
    """The known acceleration by the air, in W [m/s^2]; 0 where it is not compensated."""
    air_torque: wp.vec3d
    """The known torque of the air, in B [N m]; 0 where it is not compensated."""


@wp.struct
class Wrench:
    """The command of the rotors."""

    thrust_N: wp.float64  # Collective thrust along z_B [N]
    torque: wp.vec3d  # Torque in B [N m]


@wp.func
def scale_to_squarable(largest: wp.float64) -> wp.float64:
    """Return the factor after which a vector with this largest element has a finite length; mostly 1."""
    if largest > _SQUARABLE:
        return _ONE / largest
    return _ONE


@wp.func
def shorten(vector: wp.vec3d, length_max: wp.float64) -> wp.vec3d:
    """Return `vector`, made no longer than `length_max`; any finite vector is allowed."""
    scale = scale_to_squarable(wp.max(wp.max(wp.abs(vector[0]), wp.abs(vector[1])), wp.abs(vector[2])))
    scaled = vector * scale
    length = wp.length(scaled)
    if length > length_max * scale:
        return scaled * (length_max / length)
    return vector


@wp.func
def reachable_thrust(thrust: wp.vec3d, thrust_max: wp.float64) -> wp.vec3d:
    """Return the thrust vector, made no longer than `thrust_max` by giving up its horizontal part first."""
    if wp.length(thrust) > thrust_max:
        up = clip(thrust[2], -thrust_max, thrust_max)
        horizontal_max = wp.sqrt(thrust_max * thrust_max - up * up)
        horizontal = wp.sqrt(thrust[0] * thrust[0] + thrust[1] * thrust[1])
        scale = _ZERO
        if horizontal > _ZERO:
            scale = wp.min(horizontal_max / horizontal, _ONE)
        return wp.vec3d(scale * thrust[0], scale * thrust[1], up)
    return thrust


@wp.func
def heading_of_yaw(yaw_rad: wp.float64, rate_rad_s: wp.float64, acceleration_rad_s2: wp.float64) -> Heading:
    """Return the heading of a yaw angle."""
    heading = Heading()
    heading.direction = wp.vec3d(wp.cos(yaw_rad), wp.sin(yaw_rad), _ZERO)
    heading.rate_rad_s = rate_rad_s
    heading.acceleration_rad_s2 = acceleration_rad_s2
    return heading


@wp.func
def present_heading(orientation: wp.quatd, rate_rad_s: wp.float64) -> Heading:
    """Return the heading that the body has now, turning at a rate; along x_B where y_B is vertical."""
    y = wp.quat_rotate(orientation, wp.vec3d(_ZERO, _ONE, _ZERO))
    direction = wp.vec3d(y[1], -y[0], _ZERO)
    x = wp.quat_rotate(orientation, wp.vec3d(_ONE, _ZERO, _ZERO))
    if wp.length(direction) < wp.float64(1.0e-6):
        direction = wp.vec3d(x[0], x[1], _ZERO)
    heading = Heading()
    heading.direction = wp.normalize(direction)
    heading.rate_rad_s = rate_rad_s
    return heading


@wp.func
def rate_wrench(
    parameters: Se3Parameters,
    state: VehicleState,
    thrust_N: wp.float64,
    body_rate: wp.vec3d,
    angular_acceleration: wp.vec3d,
) -> Wrench:
    """Return the wrench that closes on a body rate [rad/s]; the lowest level, used by all above.

    The rate error then obeys e' + rate_gain e = 0; without one the angular acceleration is that given
    [rad/s^2].
    """
    w = state.body_rate
    wrench = Wrench()
    wrench.thrust_N = thrust_N
    wrench.torque = (
        parameters.inertia * (wp.cw_mul(parameters.rate_gain, body_rate - w) + angular_acceleration)
        + wp.cross(w, parameters.inertia * w)
        - state.air_torque
    )
    return wrench


@wp.func
def attitude_wrench(
    parameters: Se3Parameters, state: VehicleState, thrust_N: wp.float64, reference: AttitudeReference
) -> Wrench:
    """Return the wrench of a thrust [N] that closes on a moving attitude."""
    q_DB = wp.quat_inverse(reference.orientation) * state.orientation
    sign = _TWO
    if q_DB[3] < _ZERO:
        sign = -_TWO
    error = sign * wp.vec3d(q_DB[0], q_DB[1], q_DB[2])  # 2 sin(angle / 2) axis: the same in D and in B
    rate = wp.quat_rotate_inv(q_DB, shorten(reference.body_rate, parameters.body_rate_max_rad_s))
    acceleration = wp.quat_rotate_inv(q_DB, reference.angular_acceleration) - wp.cross(state.body_rate, rate)
    return rate_wrench(
        parameters, state, thrust_N, rate, acceleration - wp.cw_mul(parameters.attitude_gain, error)
    )


@wp.func
def thrust_wrench(
    parameters: Se3Parameters,
    state: VehicleState,
    acceleration: wp.vec3d,
    jerk: wp.vec3d,
    snap: wp.vec3d,
    heading: Heading,
) -> Wrench:
    """Return the wrench that turns the rotors' thrust to where it gives an acceleration, and gives it.

    Acceleration, jerk and snap are in W [m/s^2, m/s^3, m/s^4].
    """
    thrust = reachable_thrust(
        acceleration - state.air_acceleration + wp.vec3d(_ZERO, _ZERO, parameters.gravity_m_s2),
        parameters.thrust_max_m_s2,
    )
    reference = attitude_reference(thrust, jerk, snap, heading, state.orientation)
    z_B = wp.quat_rotate(state.orientation, wp.vec3d(_ZERO, _ZERO, _ONE))
    return attitude_wrench(parameters, state, parameters.mass_kg * wp.dot(thrust, z_B), reference)


@wp.func
def velocity_wrench(
    parameters: Se3Parameters,
    state: VehicleState,
    velocity: wp.vec3d,
    acceleration: wp.vec3d,
    jerk: wp.vec3d,
    snap: wp.vec3d,
    heading: Heading,
) -> Wrench:
    """Return the wrench that closes on a velocity; the rest are the reference's derivatives, all in W."""
    correction = shorten(
        parameters.velocity_gain_per_s * (velocity - state.velocity), parameters.acceleration_max_m_s2
    )
    return thrust_wrench(parameters, state, acceleration + correction, jerk, snap, heading)


@wp.func
def point_wrench(parameters: Se3Parameters, state: VehicleState, point: PathPoint) -> Wrench:
    """Return the wrench that closes on a point of a path, with all its derivatives."""
    correction = shorten(
        parameters.position_per_velocity_per_s * (point.position - state.position), parameters.speed_max_m_s
    )
    return velocity_wrench(
        parameters,
        state,
        point.velocity + correction,
        point.acceleration,
        point.jerk,
        point.snap,
        heading_of_yaw(point.yaw, point.yaw_rate, point.yaw_acceleration),
    )
