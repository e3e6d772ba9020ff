# mypy: disable-error-code="index,attr-defined,misc,operator,arg-type,valid-type,assignment"
"""The contact switch: closed where its tip touches the scene or the ground; moving bodies are not felt."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import warp as wp
from pydantic import Field

from neurosim_core.frames import Mount
from neurosim_core.packets import FieldSpec, Packet
from neurosim_core.registry import register
from neurosim_core.scene.freespace import DistanceField, scene_distance
from neurosim_core.sensors.base import RateHz, SamplerContext, StateSensorConfig
from neurosim_core.sensors.state_sampler import Sampling, StateSampler

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True, kw_only=True, eq=False)
class Contact(Packet):
    """The state of a contact switch."""

    closed: bool
    """It touches something."""
    distance_m: Annotated[float, FieldSpec(unit="m")]
    """Distance from its tip to the nearest surface, minus the radius [m]; exact up to 10 cm."""


@register("sensor", "contact")
class ContactConfig(StateSensorConfig):
    """A switch that closes when a small sphere at its mount touches something."""

    kind: Literal["contact"] = "contact"
    rate_hz: RateHz = 100.0
    """Reading rate [Hz]."""
    mount: Mount = Mount(position_m=(0.0, 0.0, -0.1))
    """Position of the tip on the body."""
    radius_m: Annotated[float, Field(ge=0.0)] = 0.03
    """Radius of the tip [m]; with `on_collision: end`, the vehicle itself must not touch first."""

    packet_type = Contact

    def make(self, context: SamplerContext) -> StateSampler:
        """Return the sensor at work."""
        model, surfaces = _Model(), context.surfaces
        model.position, model.radius = wp.vec3d(*self.mount.position_m), self.radius_m
        model.ground_height = surfaces.ground_height_m
        inputs = (model, surfaces.fields, surfaces.scene)
        return StateSampler(context, _measure, inputs, _packet, outputs={"distance_m": float})


@wp.struct
class _Model:
    position: wp.vec3d
    radius: float
    ground_height: wp.float64


@wp.kernel
def _measure(
    model: _Model,
    fields: wp.array[DistanceField],
    scene: wp.array[int],
    at: Sampling,
    slot: int,
    # Out:
    distance_out: wp.array2d[float],
) -> None:
    world = wp.tid()
    if at.active[world] == 0:
        return
    p = at.motion.position[world] + wp.quat_rotate(at.motion.orientation[world], model.position)
    point = wp.vec3(float(p[0]), float(p[1]), float(p[2]))
    distance = scene_distance(fields[scene[world]], point, model.radius + 0.1)
    distance_out[slot, world] = wp.min(distance, float(p[2] - model.ground_height)) - model.radius


def _packet(distance_m: float, **header: Any) -> Contact:
    return Contact(closed=distance_m <= 0.0, distance_m=distance_m, **header)
