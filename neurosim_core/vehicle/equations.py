# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def,no-untyped-call,no-any-return,untyped-decorator"
"""The equations of motion with only the terms that a vehicle needs: one right-hand side, all integrators."""

from typing import Any, NamedTuple

import warp as wp

from neurosim_core.vehicle.aerodynamics import Airframe, make_wrench, vec10d
from neurosim_core.vehicle.chart import rotation_series


class Equations(NamedTuple):
    """Device functions of one set of terms."""

    wrench: Any
    """(airframe, quadratic, linear, air, w) -> force and torque in B; see `aerodynamics.make_wrench`."""
    solve_inertia: Any
    """(airframe, torque) -> J^-1 torque."""
    angular_acceleration: Any
    """(airframe, torque, w) -> dw/dt in B."""
    rates: Any
    """(airframe, quadratic, linear, u, air_0, w) -> specific force in B0 and dw/dt in B, B being B0 turned by
    exp(u), and air_0 the air speed in B0."""


def make_equations(terms: frozenset[str], *, air_terms: bool) -> Equations:
    """Return the equations with the given terms (see `multirotor.TERMS`).

    Args:
        terms: What is computed.
        air_terms: Some of it depends on the air speed.
    """
    full_inertia = "full_inertia" in terms
    wrench = make_wrench(terms)

    @wp.func
    def solve_inertia(airframe: Airframe, torque: wp.vec3d) -> wp.vec3d:
        if wp.static(full_inertia):
            return airframe.inertia_inverse * torque
        else:
            return wp.cw_mul(airframe.inertia_diagonal_inverse, torque)

    @wp.func
    def angular_acceleration(airframe: Airframe, torque: wp.vec3d, w: wp.vec3d) -> wp.vec3d:
        momentum = wp.cw_mul(airframe.inertia_diagonal, w)
        if wp.static(full_inertia):
            momentum = airframe.inertia * w
        return solve_inertia(airframe, torque - wp.cross(w, momentum))

    @wp.func
    def rates(
        airframe: Airframe, quadratic: wp.vec4d, linear: vec10d, u: wp.vec3d, air_0: wp.vec3d, w: wp.vec3d
    ):
        series = rotation_series(u)
        air = air_0
        if wp.static(air_terms):
            turn = wp.cross(u, air_0)
            air = air_0 - series[0] * turn + series[1] * wp.cross(u, turn)
        force, torque = wrench(airframe, quadratic, linear, air, w)
        swing = wp.cross(u, force)
        force_0 = force + series[0] * swing + series[1] * wp.cross(u, swing)
        return airframe.mass_inverse * force_0, angular_acceleration(airframe, torque, w)

    return Equations(wrench, solve_inertia, angular_acceleration, rates)
