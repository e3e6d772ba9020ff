# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def,no-untyped-call,no-any-return,untyped-decorator"
"""The kernels of a batch: fixed steps first, and adaptive ones for the vehicles where those do not do."""

import functools
from typing import Any, NamedTuple

import warp as wp

from neurosim_core.vehicle.aerodynamics import AIR_TERMS, Airframe, vec10d
from neurosim_core.vehicle.dormand_prince import RotorSums, make_dormand_prince
from neurosim_core.vehicle.equations import make_equations
from neurosim_core.vehicle.rkmk4 import make_rkmk4
from neurosim_core.vehicle.status import STATUS_COMMAND, STATUS_OK


class Kernels(NamedTuple):
    """The kernels of one set of terms."""

    advance: Any
    """Moves every vehicle by a duration."""
    accelerate: Any
    """Evaluates linear and angular acceleration at the current state."""


@functools.cache
def make_kernels(terms: frozenset[str], *, adaptive: bool = False) -> Kernels:
    """Return the kernels that compute only the given terms (see `multirotor.TERMS`).

    Args:
        terms: What is computed.
        adaptive: Take no fixed steps.
    """
    motor_lag = "motor_lag" in terms
    air_terms = any(term in terms for term in AIR_TERMS)
    wind = air_terms and "wind" in terms
    equations = make_equations(terms, air_terms=air_terms)
    wrench, angular_acceleration = equations.wrench, equations.angular_acceleration
    fly_fixed = make_rkmk4(terms, equations, air_terms=air_terms, wind=wind)
    fly_adaptive = make_dormand_prince(terms, equations, air_terms=air_terms, wind=wind)
    name = "_".join(sorted(terms)) or "rigid"
    module = wp.get_module(f"neurosim_core.vehicle.integrator.{name}" + (".adaptive" if adaptive else ""))

    @wp.kernel(module=module, enable_backward=False)
    def advance(
        # Model:
        airframe: Airframe,
        quadratic_weight: wp.array[wp.vec4d],
        linear_weight: wp.array[vec10d],
        speed_nodes: wp.vec3d,
        square_nodes: wp.vec3d,
        decay: wp.float64,
        step_s: wp.float64,
        step_count: wp.int32,
        duration_ns: wp.int64,
        lag_rate: wp.float64,
        rtol: wp.float64,
        atol: wp.float64,
        evaluation_count_max: wp.int32,
        # In:
        rotor_speed_command: wp.array2d[wp.float64],
        # In/out:
        position: wp.array[wp.vec3d],
        velocity: wp.array[wp.vec3d],
        orientation: wp.array[wp.quatd],
        body_rate: wp.array[wp.vec3d],
        rotor_speed: wp.array2d[wp.float64],
        stamp_ns: wp.array[wp.int64],
        status: wp.array[wp.int32],
        redone_count: wp.array[wp.int64],
        evaluation_count: wp.array[wp.int64],
    ):
        vehicle = wp.tid()
        if status[vehicle] != STATUS_OK:
            return
        rotor_count = rotor_speed_command.shape[1]
        for rotor in range(rotor_count):
            if not wp.isfinite(rotor_speed_command[vehicle, rotor]):
                status[vehicle] = STATUS_COMMAND
                return

        # sums over the rotors of Omega^2 = c^2 + 2 c d + d^2 and Omega = c + d, where d = Omega_0 - c decays
        quadratic_cc = wp.vec4d()
        quadratic_cd = wp.vec4d()
        quadratic_dd = wp.vec4d()
        linear_c = vec10d()
        linear_d = vec10d()
        for rotor in range(rotor_count):
            c = wp.clamp(
                rotor_speed_command[vehicle, rotor], airframe.rotor_speed_min, airframe.rotor_speed_max
            )
            d = rotor_speed[vehicle, rotor] - c
            quadratic_cc += c * c * quadratic_weight[rotor]
            if wp.static(motor_lag):
                quadratic_cd += wp.float64(2.0) * c * d * quadratic_weight[rotor]
                quadratic_dd += d * d * quadratic_weight[rotor]
            if wp.static(air_terms):
                linear_c += c * linear_weight[rotor]
                if wp.static(motor_lag):
                    linear_d += d * linear_weight[rotor]

        x = position[vehicle]
        v = velocity[vehicle]
        q = orientation[vehicle]
        w = body_rate[vehicle]
        remaining = wp.float64(0.0)
        redo = wp.bool(True)
        if wp.static(not adaptive):
            x, v, q, w, remaining, redo = fly_fixed(
                airframe, quadratic_cc, quadratic_cd, quadratic_dd, linear_c, linear_d,
                speed_nodes, square_nodes, decay, step_s, step_count, x, v, q, w,
            )  # fmt: skip
        if redo:
            rotors = RotorSums()
            rotors.quadratic_cc = quadratic_cc
            rotors.quadratic_cd = quadratic_cd
            rotors.quadratic_dd = quadratic_dd
            rotors.linear_c = linear_c
            rotors.linear_d = linear_d
            rotors.lag_rate = lag_rate
            duration_s = wp.float64(step_count) * step_s
            x, v, q, w, used, failure = fly_adaptive(
                airframe, rotors, duration_s, step_s, rtol, atol, evaluation_count_max,
                position[vehicle], velocity[vehicle], orientation[vehicle], body_rate[vehicle],
            )  # fmt: skip
            evaluation_count[vehicle] += wp.int64(used)
            if wp.static(not adaptive):
                redone_count[vehicle] += wp.int64(1)
            if failure != STATUS_OK:
                status[vehicle] = failure
                return
            if wp.static(motor_lag):
                remaining = wp.exp(-lag_rate * duration_s)

        position[vehicle] = x
        velocity[vehicle] = v
        orientation[vehicle] = q
        body_rate[vehicle] = w
        for rotor in range(rotor_count):
            c = wp.clamp(
                rotor_speed_command[vehicle, rotor], airframe.rotor_speed_min, airframe.rotor_speed_max
            )
            if wp.static(motor_lag):
                rotor_speed[vehicle, rotor] = c + remaining * (rotor_speed[vehicle, rotor] - c)
            else:
                rotor_speed[vehicle, rotor] = c
        stamp_ns[vehicle] += duration_ns

    @wp.kernel(module=module, enable_backward=False)
    def accelerate(
        # Model:
        airframe: Airframe,
        quadratic_weight: wp.array[wp.vec4d],
        linear_weight: wp.array[vec10d],
        # In:
        velocity: wp.array[wp.vec3d],
        orientation: wp.array[wp.quatd],
        body_rate: wp.array[wp.vec3d],
        rotor_speed: wp.array2d[wp.float64],
        # Out:
        acceleration_out: wp.array[wp.vec3d],
        angular_acceleration_out: wp.array[wp.vec3d],
    ):
        vehicle = wp.tid()
        quadratic = wp.vec4d()
        linear = vec10d()
        for rotor in range(rotor_speed.shape[1]):
            speed = rotor_speed[vehicle, rotor]
            quadratic += speed * speed * quadratic_weight[rotor]
            if wp.static(air_terms):
                linear += speed * linear_weight[rotor]
        q = orientation[vehicle]
        w = body_rate[vehicle]
        air = velocity[vehicle]
        if wp.static(air_terms):
            if wp.static(wind):
                air -= airframe.wind
            air = wp.quat_rotate_inv(q, air)
        force, torque = wrench(airframe, quadratic, linear, air, w)
        down = wp.vec3d(wp.float64(0.0), wp.float64(0.0), -airframe.gravity)
        acceleration_out[vehicle] = down + airframe.mass_inverse * wp.quat_rotate(q, force)
        angular_acceleration_out[vehicle] = angular_acceleration(airframe, torque, w)

    return Kernels(advance, accelerate)
