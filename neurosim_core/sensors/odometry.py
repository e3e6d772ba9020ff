# mypy: disable-error-code="index,attr-defined,misc,call-overload"
"""The true state of the vehicle, as a sensor."""

from typing import Literal

import warp as wp

from neurosim_core.packets import Odometry
from neurosim_core.registry import register
from neurosim_core.sensors.base import RateHz, SamplerContext, StateSensorConfig
from neurosim_core.sensors.state_sampler import Sampling, StateSampler

wp.set_module_options({"enable_backward": False})


@register("sensor", "odometry")
class OdometrySensorConfig(StateSensorConfig):
    """The true state of the vehicle, as a sensor."""

    kind: Literal["odometry"] = "odometry"
    rate_hz: RateHz = 200.0
    """Sample rate [Hz]."""

    packet_type = Odometry

    def make(self, context: SamplerContext) -> StateSampler:
        """Return the sensor at work; also where a world is not active it says where the vehicle is."""
        rotor_speed = context.vehicle.arrays.rotor_speed
        outputs = {
            "position": wp.vec3d,
            "orientation": wp.quatd,
            "velocity": wp.vec3d,
            "body_rate": wp.vec3d,
            "rotor_speed": (wp.float64, rotor_speed.shape[1]),
        }
        return StateSampler(context, _copy_state, (rotor_speed,), Odometry, outputs=outputs)


@wp.kernel
def _copy_state(
    # In:
    rotor_speed: wp.array2d[wp.float64],
    at: Sampling,
    slot: int,
    # Out:
    position_out: wp.array2d[wp.vec3d],
    orientation_out: wp.array2d[wp.quatd],
    velocity_out: wp.array2d[wp.vec3d],
    body_rate_out: wp.array2d[wp.vec3d],
    rotor_speed_out: wp.array3d[wp.float64],
) -> None:
    world = wp.tid()
    position_out[slot, world] = at.motion.position[world]
    orientation_out[slot, world] = at.motion.orientation[world]
    velocity_out[slot, world] = at.motion.velocity[world]
    body_rate_out[slot, world] = at.motion.body_rate[world]
    for rotor in range(rotor_speed.shape[1]):
        rotor_speed_out[slot, world, rotor] = rotor_speed[world, rotor]
