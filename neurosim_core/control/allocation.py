# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,assignment"
# mypy: disable-error-code="no-untyped-call,no-any-return"
"""Control allocation: collective thrust and torque -> rotor speeds within the motors' limits.

What the rotors cannot give is given up in a fixed order, because a multirotor that keeps its attitude can
still be flown and one that keeps its yaw cannot: first yaw torque, then collective thrust, last roll and
pitch torque (shortened, its direction kept).
"""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.vehicle.aerodynamics import quadratic_weights
from neurosim_core.vehicle.multirotor import MultirotorConfig

wp.set_module_options({"enable_backward": False})

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))


@wp.struct
class Motors:
    """What all rotors of a vehicle share."""

    speed_min_rad_s: wp.float64
    """Lowest speed [rad/s]."""
    speed_max_rad_s: wp.float64
    """Highest speed [rad/s]."""
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
        thrust=vehicle.thrust_coefficient_n_s2,
        torque=vehicle.torque_coefficient_n_m_s2,
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
def allocate(
    matrix: wp.array2d[wp.float64],
    motors: Motors,
    thrust_N: wp.float64,
    torque: wp.vec3d,
    vehicle: int,
    rotor_speed: wp.array2d[wp.float64],
    rotor_speed_command_out: wp.array2d[wp.float64],
) -> None:
    """Write the rotor speed commands [rad/s] of one vehicle.

    Args:
        matrix: See `allocation_matrix`.
        motors: Limits.
        thrust_N: Collective thrust along z_B [N].
        torque: Torque on the body, in B [N m].
        vehicle: Row to read and write.
        rotor_speed: Present speeds [rad/s], shape [N, R].
        rotor_speed_command_out: Shape [N, R].
    """
    rotors = matrix.shape[0]
    low = motors.speed_min_rad_s * motors.speed_min_rad_s
    high = motors.speed_max_rad_s * motors.speed_max_rad_s

    # Roll and pitch: the largest share for which some collective thrust keeps all rotors within limits.
    share = _ONE
    for above in range(rotors):
        for below in range(rotors):
            # above needs thrust <= (high - r) / b, below needs thrust >= (low - r) / b
            gap = high / matrix[above, 0] - low / matrix[below, 0]
            need = (matrix[above, 1] * torque[0] + matrix[above, 2] * torque[1]) / matrix[above, 0] - (
                matrix[below, 1] * torque[0] + matrix[below, 2] * torque[1]
            ) / matrix[below, 0]
            if share * need > gap:
                share = wp.max(gap / need, _ZERO)
    torque_x = share * torque[0]
    torque_y = share * torque[1]

    # Collective thrust: as near to what is asked as roll and pitch allow.
    thrust_low = wp.float64(-1.0e300)
    thrust_high = wp.float64(1.0e300)
    for rotor in range(rotors):
        tilt = matrix[rotor, 1] * torque_x + matrix[rotor, 2] * torque_y
        thrust_low = wp.max(thrust_low, (low - tilt) / matrix[rotor, 0])
        thrust_high = wp.min(thrust_high, (high - tilt) / matrix[rotor, 0])
    thrust = clip(thrust_N, thrust_low, thrust_high)

    # Yaw: the share that is left.
    share = _ONE
    for rotor in range(rotors):
        level = matrix[rotor, 0] * thrust + matrix[rotor, 1] * torque_x + matrix[rotor, 2] * torque_y
        turn = matrix[rotor, 3] * torque[2]
        if level + share * turn > high:
            share = wp.max((high - level) / turn, _ZERO)
        if level + share * turn < low:
            share = wp.max((low - level) / turn, _ZERO)
    torque_z = share * torque[2]

    for rotor in range(rotors):
        square = (
            matrix[rotor, 0] * thrust
            + matrix[rotor, 1] * torque_x
            + matrix[rotor, 2] * torque_y
            + matrix[rotor, 3] * torque_z
        )
        speed = wp.sqrt(clip(square, low, high))
        present = rotor_speed[vehicle, rotor]
        rotor_speed_command_out[vehicle, rotor] = clip(
            present + motors.lead * (speed - present), motors.speed_min_rad_s, motors.speed_max_rad_s
        )
