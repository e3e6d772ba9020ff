# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,assignment"
"""Control allocation: collective thrust and torque -> rotor speeds within the motors' limits.

A wrench within limits is given exactly. Of any other, a multirotor gives up in a fixed order what it can best
do without: first yaw torque; then, without any, collective thrust; last roll and pitch torque, which are
shortened together so that their direction stays.
"""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.vehicle.aerodynamics import quadratic_weights
from neurosim_core.vehicle.airframe import MultirotorConfig

wp.set_module_options({"enable_backward": False})

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))


@wp.struct
class Motors:
    """Parameters that all rotors of a vehicle share."""

    speed_min_rad_s: wp.float64  # Lowest speed [rad/s]
    speed_max_rad_s: wp.float64  # Highest speed [rad/s]
    lead: wp.float64
    """Time constant of the motors over the one they shall seem to have; 1 commands the speed that is
    wanted."""


def allocation_matrix(vehicle: MultirotorConfig) -> NDArray[np.float64]:
    """Return the matrix that takes (collective thrust, torque) to squared rotor speeds, shape [R, 4].

    It is the inverse for four rotors and the pseudo-inverse for more: the least sum of fourth powers of
    speed.

    Raises:
        ValueError: If the rotors cannot produce every torque, or if collective thrust without torque needs a
            rotor to pull down or stand still (the centre of mass is not inside the ring of rotors).
    """
    wrench = quadratic_weights(
        np.array(vehicle.rotor_position_m),
        np.array(vehicle.rotor_direction, dtype=np.float64),
        thrust=vehicle.thrust_coefficients_n_s2,
        torque=vehicle.torque_coefficients_n_m_s2,
    ).T
    scale = np.abs(wrench).max(
        axis=1, keepdims=True
    )  # newtons against newton metres: rank means nothing without
    if not (scale > 0.0).all() or np.linalg.matrix_rank(wrench / scale) < 4:
        raise ValueError(
            f"the {vehicle.rotor_count} rotors cannot produce thrust and torque about every axis"
        )
    matrix: NDArray[np.float64] = np.linalg.pinv(wrench / scale) / scale.T
    if not (matrix[:, 0] > 0.0).all():
        raise ValueError(
            "the centre of mass is not inside the ring of rotors: thrust without torque needs every rotor to "
            f"push up, got shares {(matrix[:, 0] / matrix[:, 0].sum()).tolist()}"
        )
    return matrix


@wp.func
def clip(value: wp.float64, low: wp.float64, high: wp.float64) -> wp.float64:
    """Return `value` limited to [low, high]; unlike `wp.clamp`, nan stays nan, so that it is seen."""
    if value < low:
        return low
    if value > high:
        return high
    return value


@wp.func
def yaw_share(
    matrix: wp.array2d[wp.float64],
    low: wp.float64,
    high: wp.float64,
    thrust_N: wp.float64,
    torque: wp.vec3d,
) -> wp.float64:
    """Return the largest share of yaw torque, in [0, 1], that goes with the rest; -1 if none does.

    Squared rotor speeds are within `low` and `high` [rad^2/s^2]; torque in B [N m]; see `allocation_matrix`.
    """
    least = _ZERO
    most = _ONE
    for rotor in range(matrix.shape[0]):
        level = matrix[rotor, 0] * thrust_N + matrix[rotor, 1] * torque[0] + matrix[rotor, 2] * torque[1]
        turn = matrix[rotor, 3] * torque[2]
        if turn > _ZERO:
            least = wp.max(least, (low - level) / turn)
            most = wp.min(most, (high - level) / turn)
        elif turn < _ZERO:
            least = wp.max(least, (high - level) / turn)
            most = wp.min(most, (low - level) / turn)
        elif level < low or level > high:
            return -_ONE
    if least > most:
        return -_ONE
    return most


@wp.func
def allocate(
    matrix: wp.array2d[wp.float64],
    motors: Motors,
    thrust_N: wp.float64,
    torque: wp.vec3d,
    vehicle: int,
    rotor_speed: wp.array2d[wp.float64],
    rotor_speed_command_out: wp.array2d[wp.float64],
) -> None:
    """Write the rotor speed commands [rad/s] of one vehicle for a thrust along z_B [N] and a torque in B."""
    rotors = matrix.shape[0]
    low = motors.speed_min_rad_s * motors.speed_min_rad_s
    high = motors.speed_max_rad_s * motors.speed_max_rad_s
    thrust = thrust_N
    tilt = _ONE
    yaw = yaw_share(matrix, low, high, thrust, torque)
    if yaw < _ZERO:
        # the largest share of roll and pitch for which there is a thrust that keeps all rotors within limits:
        # a rotor at the top needs thrust <= (high - r) / b, one at the bottom thrust >= (low - r) / b
        for top in range(rotors):
            for bottom in range(rotors):
                room = high / matrix[top, 0] - low / matrix[bottom, 0]
                need = (matrix[top, 1] * torque[0] + matrix[top, 2] * torque[1]) / matrix[top, 0] - (
                    matrix[bottom, 1] * torque[0] + matrix[bottom, 2] * torque[1]
                ) / matrix[bottom, 0]
                if tilt * need > room:
                    tilt = wp.max(room / need, _ZERO)
        # of these thrusts, the one nearest to what is asked
        thrust_low = wp.float64(-1.0e300)
        thrust_high = wp.float64(1.0e300)
        for rotor in range(rotors):
            level = tilt * (matrix[rotor, 1] * torque[0] + matrix[rotor, 2] * torque[1])
            thrust_low = wp.max(thrust_low, (low - level) / matrix[rotor, 0])
            thrust_high = wp.min(thrust_high, (high - level) / matrix[rotor, 0])
        thrust = clip(thrust_N, thrust_low, thrust_high)
        rest = wp.vec3d(tilt * torque[0], tilt * torque[1], torque[2])
        yaw = wp.max(yaw_share(matrix, low, high, thrust, rest), _ZERO)  # -1: a limit is met up to rounding

    for rotor in range(rotors):
        square = (
            matrix[rotor, 0] * thrust
            + tilt * (matrix[rotor, 1] * torque[0] + matrix[rotor, 2] * torque[1])
            + yaw * matrix[rotor, 3] * torque[2]
        )
        speed = wp.sqrt(clip(square, low, high))
        present = rotor_speed[vehicle, rotor]
        rotor_speed_command_out[vehicle, rotor] = clip(
            present + motors.lead * (speed - present), motors.speed_min_rad_s, motors.speed_max_rad_s
        )
