# mypy: disable-error-code="index,attr-defined,misc,operator,arg-type,valid-type,assignment"
# mypy: disable-error-code="no-untyped-call,untyped-decorator"
"""The contact switch: closed where its tip touches the scene or the ground; moving bodies are not felt."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import warp as wp
from numpy.typing import NDArray
from pydantic import Field

from neurosim_core.frames import Mount
from neurosim_core.packets import FieldSpec, Packet
from neurosim_core.registry import register
from neurosim_core.scene.freespace import DistanceField, scene_distance
from neurosim_core.sensors.base import RateHz, SamplerContext, StateSensorConfig
from neurosim_core.sensors.state_sampler import Motion, StateSampler

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True, kw_only=True, eq=False)
class Contact(Packet):
    """What a contact switch says."""

    closed: bool
    """It touches something."""
    distance_m: Annotated[float, FieldSpec(unit="m")]
    """Distance from its tip to the nearest surface, minus the radius [m]; exact up to 10 cm."""


@register("sensor", "contact")
class ContactConfig(StateSensorConfig):
    """A switch that closes where a small sphere at its mount touches something."""

    kind: Literal["contact"] = "contact"
    rate_hz: RateHz = 100.0
    """Readings a second [Hz]."""
    mount: Mount = Mount(position_m=(0.0, 0.0, -0.1))
    """Where its tip is on the body."""
    radius_m: Annotated[float, Field(ge=0.0)] = 0.03
    """Radius of the tip [m]: with `on_collision: end`, the vehicle itself must not touch before."""

    packet_type = Contact

    def make(self, context: SamplerContext) -> "ContactSwitch":
        """Return the sensor at work."""
        return ContactSwitch(self, context)


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
    motion: Motion,
    seeds: wp.array[wp.uint64],
    active: wp.array[wp.int32],
    sample: wp.array[wp.int64],
    memory: wp.array2d[wp.vec3d],
    slot: int,
    distance_out: wp.array2d[float],
) -> None:
    world = wp.tid()
    if active[world] == 0:
        return
    p = motion.position[world] + wp.quat_rotate(motion.orientation[world], model.position)
    point = wp.vec3(float(p[0]), float(p[1]), float(p[2]))
    distance = scene_distance(fields[scene[world]], point, model.radius + 0.1)
    distance_out[slot, world] = wp.min(distance, float(p[2] - model.ground_height)) - model.radius


class ContactSwitch(StateSampler):
    """The switches of all worlds."""

    def __init__(self, config: ContactConfig, context: SamplerContext) -> None:
        model, surfaces = _Model(), context.surfaces
        model.position, model.radius = wp.vec3d(*config.mount.position_m), config.radius_m
        model.ground_height = surfaces.ground_height_m
        further = (surfaces.fields, surfaces.scene)
        super().__init__(context, _measure, model, outputs={"distance_m": float}, further=further)

    def packet(self, rows: Mapping[str, NDArray[Any]], **header: Any) -> Contact:
        """Return one sample as a packet."""
        distance_m = float(rows["distance_m"])
        return Contact(closed=distance_m <= 0.0, distance_m=distance_m, **header)
