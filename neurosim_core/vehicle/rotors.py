# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def"
"""What the airframe sees of its rotors: sums over them of Omega and Omega^2, as functions of time.

Within an interval Omega = c + d exp(-t / tau), c the command held and d = Omega_0 - c, so three sums hold for
the whole interval: of the constant part, of what decays, and of what decays twice as fast.
"""

from typing import Any

import warp as wp

from neurosim_core.vehicle.aerodynamics import Airframe, vec10d


@wp.struct
class RotorSums:
    """The sums over rotors."""

    quadratic_cc: wp.vec4d  # of `aerodynamics.quadratic_weights` times Omega^2 = c^2 + 2 c d + d^2
    quadratic_cd: wp.vec4d
    quadratic_dd: wp.vec4d
    linear_c: vec10d  # of `aerodynamics.linear_weights` times Omega = c + d
    linear_d: vec10d
    rate: wp.float64  # 1 / time constant [1/s]


@wp.struct
class Rotors:
    """What each rotor weighs in the sums, [R]."""

    quadratic_weight: wp.array(dtype=wp.vec4d)
    linear_weight: wp.array(dtype=vec10d)


@wp.func
def held_command(airframe: Airframe, command: wp.array2d[wp.float64], vehicle: wp.int32, rotor: wp.int32):
    """Return the command of a rotor within its range [rad/s]."""
    return wp.clamp(command[vehicle, rotor], airframe.rotor_speed_min, airframe.rotor_speed_max)


def make_sums_at(terms: frozenset[str], *, air_terms: bool) -> Any:
    """Return the function (sums, t) -> sums times Omega^2 and Omega at t [s] in the interval."""
    motor_lag = "motor_lag" in terms

    @wp.func
    def sums_at(sums: RotorSums, t: wp.float64):
        quadratic = sums.quadratic_cc
        linear = sums.linear_c
        if wp.static(motor_lag):
            left = wp.exp(-sums.rate * t)
            quadratic = quadratic + left * sums.quadratic_cd + left * left * sums.quadratic_dd
            if wp.static(air_terms):
                linear = linear + left * sums.linear_d
        return quadratic, linear

    return sums_at
