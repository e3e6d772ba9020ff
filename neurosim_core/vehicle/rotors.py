# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def,no-untyped-call,no-any-return,untyped-decorator"
"""What the airframe sees of its rotors: sums over them of Omega and Omega^2, as functions of time.

Within an interval Omega = c + d exp(-t / tau), c the command held and d = Omega_0 - c. Where all rotors have
one tau, three sums hold for the whole interval: of the constant part, of what decays, and of what decays
twice as fast. Where they have not, each step sums over the rotors again.
"""

from typing import Any, NamedTuple

import warp as wp

from neurosim_core.vehicle.aerodynamics import Airframe, vec10d
from neurosim_core.vehicle.motor import projected_exponential


@wp.struct
class RotorSums:
    """The sums over rotors of one time constant."""

    quadratic_cc: wp.vec4d  # of `aerodynamics.quadratic_weights` times Omega^2 = c^2 + 2 c d + d^2
    quadratic_cd: wp.vec4d
    quadratic_dd: wp.vec4d
    linear_c: vec10d  # of `aerodynamics.linear_weights` times Omega = c + d
    linear_d: vec10d
    rate: wp.float64  # 1 / time constant [1/s]


@wp.struct
class RotorLag:
    """The lag of one rotor in steps of one length: see `motor.LagConstants`."""

    speed_nodes: wp.vec3d
    square_nodes: wp.vec3d
    rate: wp.float64
    step: wp.float64  # [s]


@wp.struct
class Rotors:
    """The rotors one by one, of all vehicles, as of the beginning of the interval."""

    quadratic_weight: wp.array(dtype=wp.vec4d)
    linear_weight: wp.array(dtype=vec10d)
    lags: wp.array2d(dtype=RotorLag)  # [1, R]; where parts of an interval have steps of their own, [N, R]
    command: wp.array2d(dtype=wp.float64)
    speed: wp.array2d(dtype=wp.float64)


class RotorFunctions(NamedTuple):
    """What depends on the terms."""

    at: Any
    """(airframe, sums, rotors, vehicle, t) -> sums times Omega^2 and Omega at t [s] in the interval."""
    set_step: Any
    """(rotors, vehicle, step) -> none: makes the lags of one vehicle those of steps of another length [s]."""
    nodes: Any
    """(airframe, rotors, vehicle, t) -> the same as the stages of a step from t see them, for rotors of
    unequal lags: three sums times Omega^2, three times Omega."""


@wp.func
def held_command(airframe: Airframe, command: wp.array2d[wp.float64], vehicle: wp.int32, rotor: wp.int32):
    """Return the command of a rotor within its range [rad/s]."""
    return wp.clamp(command[vehicle, rotor], airframe.rotor_speed_min, airframe.rotor_speed_max)


def make_rotor_functions(terms: frozenset[str], *, air_terms: bool) -> RotorFunctions:
    """Return the sums over the rotors that the given terms need."""
    motor_lag = "motor_lag" in terms
    rotor_lags = "rotor_lags" in terms
    own_lags = "turbulence" in terms

    @wp.func
    def sums_at(airframe: Airframe, sums: RotorSums, rotors: Rotors, vehicle: wp.int32, t: wp.float64):
        quadratic = sums.quadratic_cc
        linear = sums.linear_c
        if wp.static(rotor_lags):
            for rotor in range(rotors.lags.shape[1]):
                c = held_command(airframe, rotors.command, vehicle, rotor)
                d = (rotors.speed[vehicle, rotor] - c) * wp.exp(-rotors.lags[0, rotor].rate * t)
                quadratic += (wp.float64(2.0) * c + d) * d * rotors.quadratic_weight[rotor]
                if wp.static(air_terms):
                    linear += d * rotors.linear_weight[rotor]
        elif wp.static(motor_lag):
            left = wp.exp(-sums.rate * t)
            quadratic = quadratic + left * sums.quadratic_cd + left * left * sums.quadratic_dd
            if wp.static(air_terms):
                linear = linear + left * sums.linear_d
        return quadratic, linear

    @wp.func
    def lagging_nodes(airframe: Airframe, rotors: Rotors, vehicle: wp.int32, t: wp.float64):
        quadratic_1 = wp.vec4d()
        quadratic_2 = wp.vec4d()
        quadratic_4 = wp.vec4d()
        linear_1 = vec10d()
        linear_2 = vec10d()
        linear_4 = vec10d()
        row = wp.int32(0)
        if wp.static(own_lags):
            row = vehicle
        for rotor in range(rotors.lags.shape[1]):
            c = held_command(airframe, rotors.command, vehicle, rotor)
            lag = rotors.lags[row, rotor]
            d = (rotors.speed[vehicle, rotor] - c) * wp.exp(-lag.rate * t)
            cd = wp.float64(2.0) * c * d
            dd = d * d
            weight = rotors.quadratic_weight[rotor]
            quadratic_1 += (lag.speed_nodes[0] * cd + lag.square_nodes[0] * dd) * weight
            quadratic_2 += (lag.speed_nodes[1] * cd + lag.square_nodes[1] * dd) * weight
            quadratic_4 += (lag.speed_nodes[2] * cd + lag.square_nodes[2] * dd) * weight
            if wp.static(air_terms):
                linear_1 += lag.speed_nodes[0] * d * rotors.linear_weight[rotor]
                linear_2 += lag.speed_nodes[1] * d * rotors.linear_weight[rotor]
                linear_4 += lag.speed_nodes[2] * d * rotors.linear_weight[rotor]
        return quadratic_1, quadratic_2, quadratic_4, linear_1, linear_2, linear_4

    @wp.func
    def set_step(rotors: Rotors, vehicle: wp.int32, step: wp.float64):
        for rotor in range(rotors.lags.shape[1]):
            lag = rotors.lags[vehicle, rotor]
            if lag.step != step:
                lag.speed_nodes = projected_exponential(lag.rate * step)
                lag.square_nodes = projected_exponential(wp.float64(2.0) * lag.rate * step)
                lag.step = step
                rotors.lags[vehicle, rotor] = lag

    return RotorFunctions(sums_at, set_step, lagging_nodes)
