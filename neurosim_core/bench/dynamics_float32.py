# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def,no-untyped-call,no-any-return,untyped-decorator"
"""One integrator in two formats of number, to see what single precision costs; for this study only.

The product's kernels are float64 throughout and cannot be built otherwise. This one is a rigid body under
gravity and a force and torque that are constant in B, integrated by RK4 on the quaternion; it is compiled
from one source for float32 and for float64.
"""

import functools
from typing import Any

import warp as wp


@functools.cache
def make_body_kernel(scalar: Any) -> Any:
    """Return the kernel that moves rigid bodies; all its numbers are of the type `scalar`.

    Its arguments: specific force and angular acceleration without gyroscopic part in B, inertia (diagonal),
    gravity, step [s], number of steps, and the arrays of position, velocity, orientation and body rate.
    """
    vec3 = wp.types.vector(length=3, dtype=scalar)
    quat = wp.types.quaternion(dtype=scalar)

    @wp.struct
    class Body:
        position: vec3
        velocity: vec3
        orientation: quat
        body_rate: vec3

    @wp.func
    def body_rates(specific_force: vec3, torque: vec3, inertia: vec3, gravity: scalar, s: Body) -> Body:
        w = s.body_rate
        rate = Body()
        rate.position = s.velocity
        rate.velocity = wp.quat_rotate(wp.normalize(s.orientation), specific_force) - vec3(
            scalar(0.0), scalar(0.0), gravity
        )
        rate.orientation = s.orientation * quat(w[0], w[1], w[2], scalar(0.0)) * scalar(0.5)
        rate.body_rate = wp.cw_div(torque - wp.cross(w, wp.cw_mul(inertia, w)), inertia)
        return rate

    @wp.func
    def moved(s: Body, rate: Body, h: scalar) -> Body:
        end = Body()
        end.position = s.position + h * rate.position
        end.velocity = s.velocity + h * rate.velocity
        end.orientation = s.orientation + h * rate.orientation
        end.body_rate = s.body_rate + h * rate.body_rate
        return end

    @wp.kernel(module=wp.get_module(f"{__name__}.{scalar.__name__}"), enable_backward=False)
    def move(
        # Model:
        specific_force: vec3,
        torque: vec3,
        inertia: vec3,
        gravity: scalar,
        step_s: scalar,
        step_count: wp.int32,
        # In/out:
        position: wp.array(dtype=vec3),
        velocity: wp.array(dtype=vec3),
        orientation: wp.array(dtype=quat),
        body_rate: wp.array(dtype=vec3),
    ):
        body = wp.tid()
        s = Body()
        s.position = position[body]
        s.velocity = velocity[body]
        s.orientation = orientation[body]
        s.body_rate = body_rate[body]
        h = step_s
        half = h / scalar(2.0)
        sixth = h / scalar(6.0)
        third = h / scalar(3.0)
        for _step in range(step_count):
            k_1 = body_rates(specific_force, torque, inertia, gravity, s)
            k_2 = body_rates(specific_force, torque, inertia, gravity, moved(s, k_1, half))
            k_3 = body_rates(specific_force, torque, inertia, gravity, moved(s, k_2, half))
            k_4 = body_rates(specific_force, torque, inertia, gravity, moved(s, k_3, h))
            s = moved(moved(moved(moved(s, k_1, sixth), k_2, third), k_3, third), k_4, sixth)
            s.orientation = wp.normalize(s.orientation)
        position[body] = s.position
        velocity[body] = s.velocity
        orientation[body] = s.orientation
        body_rate[body] = s.body_rate

    return move
