# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def"
"""A horizontal ground: feet that press into it and slip on it, and rotors that push harder above it.

A foot at depth d > 0 that sinks at a speed s is pushed up by k d (1 + c s), never pulled down: a spring with
the damping of Hunt and Crossley, which has no jump at touch-down. Friction is mu times that, against the slip
u, over sqrt(u^2 + u_0^2): Coulomb's law, made smooth below u_0. At rest n feet carry m g at d = m g / (n k).

Ground effect multiplies the thrust by 1 / (1 - (R / 4 z)^2), z the height of the hubs above ground with the
frame level; the law holds from z = R / 2 up, and its value there, 4 / 3, is kept below.

Reference: Hunt, Crossley (1975), Coefficient of restitution interpreted as damping in vibroimpact; Cheeseman,
Bennett (1955), The effect of the ground on a helicopter rotor in forward flight, ARC R&M 3021 (in hover).
"""

from typing import Annotated, Any

import numpy as np
import warp as wp
from pydantic import Field

from neurosim_core.frames import Vector3
from neurosim_core.settings import BaseConfig


class GroundConfig(BaseConfig):
    """A horizontal plane that the vehicle can stand on; to touch it is no collision."""

    height_m: Annotated[float, Field(ge=-1e6, le=1e6)] = 0.0
    """z of the plane in W [m]."""
    foot_position_m: Annotated[tuple[Vector3, ...], Field(min_length=1)] | None = None
    """Contact points of the vehicle, in B [m]; null: one below each rotor hub, 5 cm under the centre of
    mass."""
    stiffness_n_m: Annotated[float, Field(gt=0.0, le=1e9)] = 2000.0
    """Force on a contact point per depth of penetration [N/m]."""
    damping_s_m: Annotated[float, Field(ge=0.0, le=1e6)] = 2.0
    """Relative growth of this force per sinking speed [s/m]; 0: the vehicle bounces for ever."""
    friction: Annotated[float, Field(ge=0.0, le=100.0)] = 0.6
    """Coefficient of friction."""
    slip_speed_m_s: Annotated[float, Field(gt=0.0, le=1e3)] = 0.01
    """Slip speed at which friction reaches 71 % [m/s]; below, it is viscous."""
    rotor_radius_m: Annotated[float, Field(ge=0.0, le=100.0)] = 0.0
    """Radius of the rotors, which sets the ground effect [m]; 0: no ground effect."""


@wp.struct
class Ground:
    """A ground as the kernels read it."""

    height: wp.float64
    stiffness: wp.float64
    damping: wp.float64
    friction: wp.float64
    slip_speed2: wp.float64
    hub_height: wp.float64  # of the rotors above the centre of mass
    radius_quarter: wp.float64
    feet: wp.array(dtype=wp.vec3d)


def make_ground(config: GroundConfig | None, rotor_position_m: tuple[Vector3, ...], device: Any) -> Ground:
    """Put a ground on a device; None: one that touches nothing."""
    ground = Ground()
    if config is None:
        return ground
    hubs = np.array(rotor_position_m)
    below = hubs * [1.0, 1.0, 0.0] - [0.0, 0.0, 0.05]
    feet = below if config.foot_position_m is None else np.array(config.foot_position_m)
    ground.height = config.height_m
    ground.stiffness = config.stiffness_n_m
    ground.damping = config.damping_s_m
    ground.friction = config.friction
    ground.slip_speed2 = config.slip_speed_m_s**2
    ground.hub_height = hubs[:, 2].mean()
    ground.radius_quarter = 0.25 * config.rotor_radius_m
    ground.feet = wp.array(feet, dtype=wp.vec3d, device=device)
    return ground


@wp.func
def touches(ground: Ground, height: wp.float64, up: wp.vec3d) -> wp.bool:
    """Return whether a foot is in the ground; height is that of the centre of mass, up is world z in B."""
    for foot in range(ground.feet.shape[0]):
        if height + wp.dot(up, ground.feet[foot]) < wp.float64(0.0):
            return wp.bool(True)
    return wp.bool(False)


@wp.func
def contact_wrench(ground: Ground, height: wp.float64, up: wp.vec3d, velocity: wp.vec3d, w: wp.vec3d):
    """Return force [N] and torque [N m] of the ground on the vehicle, in B.

    Height is that of the centre of mass above the plane [m]; world z, its velocity over ground [m/s] and the
    body rate [rad/s] are in B.
    """
    force = wp.vec3d()
    torque = wp.vec3d()
    one = wp.float64(1.0)
    for foot in range(ground.feet.shape[0]):
        r = ground.feet[foot]
        depth = -(height + wp.dot(up, r))
        if depth > wp.float64(0.0):
            slip = velocity + wp.cross(w, r)
            rise = wp.dot(up, slip)
            slip -= rise * up
            push = wp.max(ground.stiffness * depth * (one - ground.damping * rise), wp.float64(0.0))
            grip = ground.friction / wp.sqrt(wp.length_sq(slip) + ground.slip_speed2)
            at_foot = push * (up - grip * slip)
            force += at_foot
            torque += wp.cross(r, at_foot)
    return force, torque


@wp.func
def lifted(ground: Ground, height: wp.float64, quadratic: wp.vec4d) -> wp.vec4d:
    """Return the sums over the rotors of `aerodynamics.quadratic_weights` with the thrust near the ground."""
    z = height + ground.hub_height
    share = wp.float64(0.0)
    if ground.radius_quarter > wp.float64(0.0):
        share = wp.float64(0.5)
    if z > wp.float64(2.0) * ground.radius_quarter:
        share = ground.radius_quarter / z
    gain = wp.float64(1.0) / (wp.float64(1.0) - share * share)
    return wp.vec4d(gain * quadratic[0], gain * quadratic[1], gain * quadratic[2], quadratic[3])
