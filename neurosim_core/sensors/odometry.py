# mypy: disable-error-code="index,attr-defined,misc,call-overload"
"""The true state of the vehicle, as a sensor."""

from collections.abc import Mapping
from typing import Any, Literal

import warp as wp
from numpy.typing import NDArray

from neurosim_core.packets import Odometry
from neurosim_core.registry import register
from neurosim_core.runtime.cuda import RecordedLaunch
from neurosim_core.sensors.base import RateHz, Sampler, SamplerContext, StateSensorConfig

wp.set_module_options({"enable_backward": False})


@register("sensor", "odometry")
class OdometrySensorConfig(StateSensorConfig):
    """The true state of the vehicle, as a sensor."""

    kind: Literal["odometry"] = "odometry"
    rate_hz: RateHz = 200.0
    """Samples a second [Hz]."""

    packet_type = Odometry

    def make(self, context: SamplerContext) -> "OdometrySampler":
        """Return the sensor at work."""
        return OdometrySampler(context)


@wp.kernel
def _copy_state(
    # In:
    position: wp.array[wp.vec3d],
    orientation: wp.array[wp.quatd],
    velocity: wp.array[wp.vec3d],
    body_rate: wp.array[wp.vec3d],
    rotor_speed: wp.array2d[wp.float64],
    slot: int,
    # Out:
    position_out: wp.array2d[wp.vec3d],
    orientation_out: wp.array2d[wp.quatd],
    velocity_out: wp.array2d[wp.vec3d],
    body_rate_out: wp.array2d[wp.vec3d],
    rotor_speed_out: wp.array3d[wp.float64],
) -> None:
    world = wp.tid()
    position_out[slot, world] = position[world]
    orientation_out[slot, world] = orientation[world]
    velocity_out[slot, world] = velocity[world]
    body_rate_out[slot, world] = body_rate[world]
    for rotor in range(rotor_speed.shape[1]):
        rotor_speed_out[slot, world, rotor] = rotor_speed[world, rotor]


class OdometrySampler(Sampler):
    """Copies of the states of all vehicles, named as the fields of an `Odometry` packet."""

    def __init__(self, context: SamplerContext) -> None:
        state = context.vehicle.arrays
        names = ("position", "orientation", "velocity", "body_rate", "rotor_speed")
        self._sources: list[Any] = [getattr(state, name) for name in names]
        self.arrays = {
            name: wp.zeros((context.slot_count, *source.shape), dtype=source.dtype, device=source.device)
            for name, source in zip(names, self._sources, strict=True)
        }
        self._count = context.vehicle.count
        self._launch = RecordedLaunch(_copy_state, context.vehicle.device)

    def measure(self, slot: int) -> None:
        """Copy the present states into a slot."""
        self._launch.launch(self._count, [*self._sources, slot, *self.arrays.values()])

    def packet(self, rows: Mapping[str, NDArray[Any]], **header: Any) -> Odometry:
        """Return one sample as a packet."""
        return Odometry(**header, **dict[str, Any](rows))
