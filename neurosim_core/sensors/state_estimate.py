# mypy: disable-error-code="index,attr-defined,misc,operator,arg-type,valid-type,assignment"
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"
"""The state as an estimator gives it: noisy, drifting, late, and at times not at all.

What drifts are position and yaw, as in visual-inertial odometry, where they are not observable (Kelly and
Sukhatme 2011); the yaw turns position and velocity about the origin of W too.
"""

import functools
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import model_validator

from neurosim_core.frames import quaternion_exp
from neurosim_core.packets import Odometry
from neurosim_core.random import stream_id
from neurosim_core.registry import register
from neurosim_core.sensors.base import RateHz, SamplerContext, StateSensorConfig
from neurosim_core.sensors.state_sampler import (
    ErrorConfig,
    Errors,
    Motion,
    NonNegative,
    Probability,
    StateSampler,
    delay_count,
    error_adder,
    is_lost,
    make_errors,
    numbers,
)

_FIELDS = {"position": wp.vec3d, "orientation": wp.quatd, "velocity": wp.vec3d, "body_rate": wp.vec3d}


@register("sensor", "state_estimate")
class StateEstimateConfig(StateSensorConfig):
    """The state as an estimator gives it, exact and at once by default."""

    kind: Literal["state_estimate"] = "state_estimate"
    rate_hz: RateHz = 200.0
    """Estimates a second [Hz]."""
    delay_s: NonNegative = 0.0
    """Age of an estimate when it comes, at the stamp [s]; a multiple of 1 / rate_hz."""
    position_errors: ErrorConfig = ErrorConfig()
    """In W [m], such as {white: 0.005, walk: 0.01}: a walk is drift."""
    attitude_errors: ErrorConfig = ErrorConfig()
    """Rotation vector in B [rad], such as {white: 0.002}; no walk, which is `yaw_errors`."""
    yaw_errors: ErrorConfig = ErrorConfig()
    """Turn of the whole frame about z [rad], such as {walk: 0.001}; the first number counts."""
    velocity_errors: ErrorConfig = ErrorConfig()
    """In W [m/s]."""
    body_rate_errors: ErrorConfig = ErrorConfig()
    """In B [rad/s]."""
    dropout_probability: Probability = 0.0
    """Share of estimates that do not come."""

    packet_type = Odometry

    @model_validator(mode="after")
    def _delay_is_whole(self) -> "StateEstimateConfig":
        delay_count(self.delay_s, self.rate_hz)
        return self

    def make(self, context: SamplerContext) -> "StateEstimator":
        """Return the sensor at work."""
        return StateEstimator(self, context)

    def groups(self) -> dict[str, ErrorConfig]:
        """Return the errors by the name of what they are added to."""
        names = ("position", "attitude", "yaw", "velocity", "body_rate")
        return {name: getattr(self, f"{name}_errors") for name in names}


@wp.struct
class _Model:
    position: Errors
    attitude: Errors
    yaw: Errors
    velocity: Errors
    body_rate: Errors
    lost: wp.float64
    stream: wp.uint32


@functools.cache
def make_kernel(terms: tuple[tuple[str, ...], ...]) -> Any:
    """Return the kernel with the given errors, of each group."""
    to_position, to_attitude, to_yaw, to_velocity, to_rate = (error_adder(each) for each in terms)
    name = "_and_".join(
        "".join(term[:2] for term in each) for each in terms
    )  # a file cannot have 255 letters

    @wp.kernel(module=wp.get_module(f"neurosim_core.sensors.state_estimate.{name}"), enable_backward=False)
    def measure(
        model: _Model,
        motion: Motion,
        seeds: wp.array[wp.uint64],
        active: wp.array[wp.int32],
        sample: wp.array[wp.int64],
        memory: wp.array2d[wp.vec3d],
        slot: int,
        position_out: wp.array2d[wp.vec3d],
        orientation_out: wp.array2d[wp.quatd],
        velocity_out: wp.array2d[wp.vec3d],
        body_rate_out: wp.array2d[wp.vec3d],
        came_out: wp.array2d[wp.int32],
    ):
        world = wp.tid()
        if active[world] == 0:
            return
        seed, k = seeds[world], sample[world]
        p = motion.position[world]
        v = motion.velocity[world]
        q = motion.orientation[world]
        w = to_rate(model.body_rate, seed, k, motion.body_rate[world], memory, world, 4)
        if wp.static(bool(terms[2])):
            yaw = to_yaw(model.yaw, seed, k, wp.vec3d(), memory, world, 2)
            turn = quaternion_exp(wp.vec3d(wp.float64(0.0), wp.float64(0.0), yaw[0]))
            p = wp.quat_rotate(turn, p)
            v = wp.quat_rotate(turn, v)
            q = turn * q
        if wp.static(bool(terms[1])):
            q = wp.normalize(
                q * quaternion_exp(to_attitude(model.attitude, seed, k, wp.vec3d(), memory, world, 1))
            )
        position_out[slot, world] = to_position(model.position, seed, k, p, memory, world, 0)
        orientation_out[slot, world] = q
        velocity_out[slot, world] = to_velocity(model.velocity, seed, k, v, memory, world, 3)
        body_rate_out[slot, world] = w
        came_out[slot, world] = wp.where(is_lost(seed, model.stream, k, model.lost), 0, 1)
        sample[world] = k + wp.int64(1)

    return measure


class StateEstimator(StateSampler):
    """The estimators of all worlds."""

    def __init__(self, config: StateEstimateConfig, context: SamplerContext) -> None:
        model, groups = _Model(), config.groups()
        for name, errors in groups.items():
            setattr(model, name, make_errors(errors, rate_hz=config.rate_hz, name=f"{context.name}/{name}"))
        model.lost = wp.float64(config.dropout_probability)
        model.stream = wp.uint32(stream_id(f"{context.name}/lost"))
        super().__init__(
            context,
            make_kernel(tuple(errors.terms() for errors in groups.values())),
            model,
            outputs={**_FIELDS, "came": wp.int32},
            terms=tuple(f"{name} {term}" for name, errors in groups.items() for term in errors.terms()),
            group_count=len(groups),
            delay_count=delay_count(config.delay_s, config.rate_hz),
        )

    def packet(self, rows: Mapping[str, NDArray[Any]], **header: Any) -> Odometry | None:
        """Return one sample as a packet, without rotor speeds; None: it does not come."""
        if not rows["came"]:
            return None
        return Odometry(rotor_speed=np.zeros(0), **{name: numbers(rows, name) for name in _FIELDS}, **header)
