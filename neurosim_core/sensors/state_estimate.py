# mypy: disable-error-code="index,attr-defined,misc,operator,arg-type,valid-type,assignment,no-untyped-def"
"""The state as an estimator gives it: noisy, drifting, late, and at times not at all.

What drifts are position and yaw, as in visual-inertial odometry, where they are not observable (Kelly and
Sukhatme 2011); the yaw turns position and velocity about the origin of W too.
"""

import functools
from typing import Any, Literal

import numpy as np
import warp as wp

from neurosim_core.frames import quaternion_exp
from neurosim_core.packets import Odometry
from neurosim_core.registry import register
from neurosim_core.render.launch import kernel_variant
from neurosim_core.sensors.base import RateHz, SamplerContext
from neurosim_core.sensors.state_sampler import (
    ErrorConfig,
    Errors,
    LateConfig,
    Sampling,
    StateSampler,
    error_adder,
    make_errors,
)

_GROUPS = ("position", "attitude", "yaw", "velocity", "body_rate")
_FIELDS = {"position": wp.vec3d, "orientation": wp.quatd, "velocity": wp.vec3d, "body_rate": wp.vec3d}


@register("sensor", "state_estimate")
class StateEstimateConfig(LateConfig):
    """The output of a state estimator, without errors and without delay by default."""

    kind: Literal["state_estimate"] = "state_estimate"
    rate_hz: RateHz = 200.0
    """Estimate rate [Hz]."""
    position_errors: ErrorConfig = ErrorConfig()
    """Position errors in W [m], such as {white: 0.005, walk: 0.01}: a walk is drift."""
    attitude_errors: ErrorConfig = ErrorConfig()
    """Attitude errors, a rotation vector in B [rad], such as {white: 0.002}; no walk, see `yaw_errors`."""
    yaw_errors: ErrorConfig = ErrorConfig()
    """Rotation of the whole frame about z [rad], such as {walk: 0.001}; only the first number counts."""
    velocity_errors: ErrorConfig = ErrorConfig()
    """Velocity errors in W [m/s]."""
    body_rate_errors: ErrorConfig = ErrorConfig()
    """Body rate errors in B [rad/s]."""

    packet_type = Odometry

    def make(self, context: SamplerContext) -> StateSampler:
        """Return the sensor at work; its packets have no rotor speeds."""
        model, terms = _Model(), []
        for name in _GROUPS:
            errors = getattr(self, f"{name}_errors")
            setattr(model, name, make_errors(errors, rate_hz=self.rate_hz, name=f"{context.name}/{name}"))
            terms.append(errors.terms())
        return StateSampler(
            context,
            _make_kernel(tuple(terms)),
            (model,),
            functools.partial(Odometry, rotor_speed=np.zeros(0)),
            outputs=_FIELDS,
            terms=tuple(f"{name} {term}" for name, each in zip(_GROUPS, terms, strict=True) for term in each),
            group_count=len(_GROUPS),
            late=self,
        )


@wp.struct
class _Model:
    position: Errors
    attitude: Errors
    yaw: Errors
    velocity: Errors
    body_rate: Errors


@functools.cache
def _make_kernel(terms: tuple[tuple[str, ...], ...]) -> Any:
    """Return the kernel with the given errors, of each of `_GROUPS`."""
    to_position, to_attitude, to_yaw, to_velocity, to_rate = (error_adder(each) for each in terms)
    short = ("".join(term[:2] for term in each) for each in terms)  # a file cannot have 255 letters

    @kernel_variant(__name__, "_and_".join(short))
    def measure(
        model: _Model,
        at: Sampling,
        slot: int,
        # Out:
        position_out: wp.array2d[wp.vec3d],
        orientation_out: wp.array2d[wp.quatd],
        velocity_out: wp.array2d[wp.vec3d],
        body_rate_out: wp.array2d[wp.vec3d],
    ):
        world = wp.tid()
        if at.active[world] == 0:
            return
        p = at.motion.position[world]
        v = at.motion.velocity[world]
        q = at.motion.orientation[world]
        if wp.static(bool(terms[2])):
            yaw = to_yaw(model.yaw, wp.vec3d(), at, world, 2)
            turn = quaternion_exp(wp.vec3d(wp.float64(0.0), wp.float64(0.0), yaw[0]))
            p = wp.quat_rotate(turn, p)
            v = wp.quat_rotate(turn, v)
            q = turn * q
        if wp.static(bool(terms[1])):
            q = wp.normalize(q * quaternion_exp(to_attitude(model.attitude, wp.vec3d(), at, world, 1)))
        position_out[slot, world] = to_position(model.position, p, at, world, 0)
        orientation_out[slot, world] = q
        velocity_out[slot, world] = to_velocity(model.velocity, v, at, world, 3)
        body_rate_out[slot, world] = to_rate(model.body_rate, at.motion.body_rate[world], at, world, 4)
        at.sample[world] += wp.int64(1)

    return measure
