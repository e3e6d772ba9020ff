"""Why a vehicle is held: the codes in `MultirotorArrays.status`."""

import warp as wp

STATUS_OK = wp.constant(wp.int32(0))
STATUS_COMMAND = wp.constant(wp.int32(1))
STATUS_VELOCITY = wp.constant(wp.int32(2))
STATUS_BODY_RATE = wp.constant(wp.int32(3))
STATUS_COLLISION = wp.constant(wp.int32(4))

STATUS_TERMS = ("ok", "rotor_speed_command", "velocity", "body_rate", "collision")
"""What each status code means: the quantity that was not finite or that cannot be integrated; "collision":
whoever flies the vehicles holds this one, because it has touched something."""
