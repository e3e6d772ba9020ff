# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,assignment"
"""Differential flatness of a multirotor: thrust, yaw and their derivatives -> attitude, its rates.

Reference: Mellinger, Kumar (2011), Minimum snap trajectory generation and control for quadrotors, section III
(which flat outputs determine the state); Lee, Leok, McClamroch (2010), Geometric tracking control of a
quadrotor UAV on SE(3), section III (the desired attitude b1, b2, b3). The derivatives here are those of the
constraints z = a / |a| and y . b1(yaw) = 0, taken twice; a test compares them with numerical differentiation.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

THRUST_MIN_M_S2 = wp.constant(wp.float64(1.0e-2))
"""Below this thrust per mass its direction means nothing, and the attitude is held [m/s^2]."""
HEADING_MIN = wp.constant(wp.float64(1.0e-2))
"""Below this length of the heading's projection onto the rotor plane (0.6 degrees), the heading is held."""
_ZERO = wp.constant(wp.float64(0.0))


@wp.struct
class AttitudeReference:
    """An attitude to follow, with its derivatives."""

    orientation: wp.quatd  # q_WD of the desired body frame D, xyzw
    body_rate: wp.vec3d  # w_WD in D [rad/s]
    angular_acceleration: wp.vec3d  # Time derivative of `body_rate` [rad/s^2]


@wp.struct
class Heading:
    """Yaw and its derivatives; y_D is kept orthogonal to `direction`, as in a Z-X-Y Euler sequence."""

    direction: wp.vec3d  # b1 = (cos yaw, sin yaw, 0) in W
    rate_rad_s: wp.float64  # Time derivative of yaw [rad/s]
    acceleration_rad_s2: wp.float64  # Second time derivative of yaw [rad/s^2]


@wp.func
def attitude_reference(
    thrust: wp.vec3d,
    thrust_rate: wp.vec3d,
    thrust_acceleration: wp.vec3d,
    heading: Heading,
    orientation: wp.quatd,
) -> AttitudeReference:
    """Return the attitude whose z axis is along the thrust and whose heading is as asked.

    Degenerate cases: without thrust (free fall) the z axis stays where the body's is, at rest. Where the
    heading is parallel to the thrust, the y axis is the one nearest to the body's, and it does not turn about
    z. Where the thrust points below the horizon, (y, -y) both satisfy the heading and the one nearer to the
    body's is taken, so that a flip about any axis is continuous.

    Thrust is per mass, in W (acceleration minus gravity) [m/s^2], with its time derivatives.
    """
    magnitude = wp.length(thrust)
    y_B = wp.quat_rotate(orientation, wp.vec3d(_ZERO, wp.float64(1.0), _ZERO))
    z = wp.quat_rotate(orientation, wp.vec3d(_ZERO, _ZERO, wp.float64(1.0)))
    z_rate = wp.vec3d()
    z_acceleration = wp.vec3d()
    if not (magnitude < THRUST_MIN_M_S2):  # nan goes on, so that it is seen
        z = thrust / magnitude
        magnitude_rate = wp.dot(z, thrust_rate)
        z_rate = (thrust_rate - magnitude_rate * z) / magnitude
        magnitude_acceleration = wp.dot(z_rate, thrust_rate) + wp.dot(z, thrust_acceleration)
        z_acceleration = (
            thrust_acceleration - magnitude_acceleration * z - wp.float64(2.0) * magnitude_rate * z_rate
        ) / magnitude

    b1 = heading.direction
    b2 = wp.vec3d(-b1[1], b1[0], _ZERO)
    y = wp.cross(z, b1)
    projection = wp.length(y)  # x . b1
    held = projection < HEADING_MIN
    if held:
        y = y_B - wp.dot(y_B, z) * z
        if wp.length(y) < HEADING_MIN:  # the body's y is along the thrust: its x cannot be
            y = wp.cross(z, wp.quat_rotate(orientation, wp.vec3d(wp.float64(1.0), _ZERO, _ZERO)))
        y = wp.normalize(y)
    else:
        y = y / projection
        if z[2] < _ZERO and wp.dot(y, y_B) < _ZERO:
            y = -y
            projection = -projection
    x = wp.cross(y, z)

    # rate: z' = w cross z, and d/dt (y . b1) = 0
    w_x = -wp.dot(y, z_rate)
    w_y = wp.dot(x, z_rate)
    w_z = wp.float64(0.0)
    if not held:
        w_z = (w_x * wp.dot(z, b1) + heading.rate_rad_s * wp.dot(y, b2)) / projection
    # acceleration: z'' = w' cross z + w cross z', and d2/dt2 (y . b1) = 0
    rate_W = w_x * x + w_y * y + w_z * z
    bend = z_acceleration - wp.cross(rate_W, z_rate)
    a_x = -wp.dot(y, bend)
    a_y = wp.dot(x, bend)
    a_z = wp.float64(0.0)
    if not held:
        yaw_rate = heading.rate_rad_s
        a_z = (
            a_x * wp.dot(z, b1)
            + w_x * (wp.dot(z_rate, b1) + yaw_rate * wp.dot(z, b2))
            + w_z * (w_y * wp.dot(z, b1) - yaw_rate * wp.dot(x, b2))
            + heading.acceleration_rad_s2 * wp.dot(y, b2)
            + yaw_rate * (w_x * wp.dot(z, b2) - w_z * wp.dot(x, b2))
        ) / projection

    reference = AttitudeReference()
    reference.orientation = wp.quat_from_matrix(wp.matrix_from_cols(x, y, z))
    reference.body_rate = wp.vec3d(w_x, w_y, w_z)
    reference.angular_acceleration = wp.vec3d(a_x, a_y, a_z)
    return reference
