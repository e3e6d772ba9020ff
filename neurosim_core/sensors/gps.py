# mypy: disable-error-code="index,attr-defined,misc,operator,arg-type,valid-type,assignment"
# mypy: disable-error-code="no-untyped-def,no-untyped-call,untyped-decorator"
"""The GPS receiver: geodetic position and velocity, late, with errors that come and go.

The world W is a tangent plane of the WGS84 ellipsoid: east, north, up at an origin.

Reference: NIMA TR8350.2 (2000), World Geodetic System 1984. Rankin (1994), An error model for sensor
simulation GPS and differential GPS: Gauss-Markov processes for what satellites and atmosphere do.
"""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field, model_validator

from neurosim_core.frames import Mount
from neurosim_core.packets import FieldSpec, Packet
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
    axes,
    delay_count,
    error_adder,
    is_lost,
    make_errors,
    numbers,
)

_SEMI_MAJOR_M = 6_378_137.0
_FLATTENING = 1.0 / 298.257223563
_ECCENTRICITY_2 = _FLATTENING * (2.0 - _FLATTENING)


@dataclass(frozen=True, kw_only=True, eq=False)
class GpsFix(Packet):
    """What a GPS receiver says; it was there `delay_s` before the stamp."""

    latitude_rad: Annotated[float, FieldSpec(unit="rad")]
    """Geodetic, WGS84 [rad]."""
    longitude_rad: Annotated[float, FieldSpec(unit="rad")]
    """WGS84 [rad]."""
    altitude_m: Annotated[float, FieldSpec(unit="m")]
    """Above the ellipsoid [m]."""
    velocity: Annotated[NDArray[np.float64], FieldSpec(3, unit="m/s", frame="world")]
    """East, north, up [m/s], shape [3]."""
    position_std: Annotated[NDArray[np.float64], FieldSpec(3, unit="m")]
    """Standard deviation of the position, east, north, up [m], shape [3]."""


@register("sensor", "gps")
class GpsConfig(StateSensorConfig):
    """A GPS receiver, without errors and at once by default."""

    kind: Literal["gps"] = "gps"
    rate_hz: RateHz = 10.0
    """Fixes a second [Hz]."""
    mount: Mount = Mount()
    """Where the antenna is on the body."""
    latitude_rad: Annotated[float, Field(gt=-1.57, lt=1.57)] = math.radians(47.4)
    """Geodetic latitude of the origin of W [rad]."""
    longitude_rad: Annotated[float, Field(ge=-math.pi, le=math.pi)] = math.radians(8.55)
    """Longitude of the origin of W [rad]."""
    altitude_m: float = 450.0
    """Altitude of the origin of W above the ellipsoid [m]."""
    delay_s: NonNegative = 0.0
    """Age of a fix when it comes, at the stamp [s]; a multiple of 1 / rate_hz."""
    position_errors: ErrorConfig = ErrorConfig()
    """In m, east, north, up, such as {white: 0.1, markov: [1.5, 1.5, 3], markov_time_s: 100}."""
    velocity_errors: ErrorConfig = ErrorConfig()
    """In m/s, likewise."""
    dropout_probability: Probability = 0.0
    """Share of fixes that do not come."""

    packet_type = GpsFix

    @model_validator(mode="after")
    def _delay_is_whole(self) -> "GpsConfig":
        delay_count(self.delay_s, self.rate_hz)
        return self

    def make(self, context: SamplerContext) -> "GpsReceiver":
        """Return the sensor at work."""
        return GpsReceiver(self, context)


@wp.struct
class _Model:
    antenna: wp.vec3d
    position: Errors
    velocity: Errors
    lost: wp.float64
    stream: wp.uint32


@functools.cache
def make_kernel(position_terms: tuple[str, ...], velocity_terms: tuple[str, ...]) -> Any:
    """Return the kernel with the given errors."""
    add_to_position, add_to_velocity = error_adder(position_terms), error_adder(velocity_terms)
    name = "_".join((*position_terms, "and", *velocity_terms))

    @wp.kernel(module=wp.get_module(f"neurosim_core.sensors.gps.{name}"), enable_backward=False)
    def measure(
        model: _Model,
        motion: Motion,
        seeds: wp.array[wp.uint64],
        active: wp.array[wp.int32],
        sample: wp.array[wp.int64],
        memory: wp.array2d[wp.vec3d],
        slot: int,
        position_out: wp.array2d[wp.vec3d],
        velocity_out: wp.array2d[wp.vec3d],
        came_out: wp.array2d[wp.int32],
    ):
        world = wp.tid()
        if active[world] == 0:
            return
        seed, k = seeds[world], sample[world]
        q = motion.orientation[world]
        p = motion.position[world] + wp.quat_rotate(q, model.antenna)
        v = motion.velocity[world] + wp.quat_rotate(q, wp.cross(motion.body_rate[world], model.antenna))
        position_out[slot, world] = add_to_position(model.position, seed, k, p, memory, world, 0)
        velocity_out[slot, world] = add_to_velocity(model.velocity, seed, k, v, memory, world, 1)
        came_out[slot, world] = wp.where(is_lost(seed, model.stream, k, model.lost), 0, 1)
        sample[world] = k + wp.int64(1)

    return measure


class GpsReceiver(StateSampler):
    """The receivers of all worlds; on the device, positions are those in W [m]."""

    def __init__(self, config: GpsConfig, context: SamplerContext) -> None:
        self._config = config
        position, velocity = config.position_errors, config.velocity_errors
        model = _Model()
        model.antenna = wp.vec3d(*config.mount.position_m)
        model.position = make_errors(position, rate_hz=config.rate_hz, name=f"{context.name}/position")
        model.velocity = make_errors(velocity, rate_hz=config.rate_hz, name=f"{context.name}/velocity")
        model.lost = wp.float64(config.dropout_probability)
        model.stream = wp.uint32(stream_id(f"{context.name}/lost"))
        super().__init__(
            context,
            make_kernel(position.terms(), velocity.terms()),
            model,
            outputs={"position": wp.vec3d, "velocity": wp.vec3d, "came": wp.int32},
            terms=(*position.terms(), *velocity.terms()),
            group_count=2,
            delay_count=delay_count(config.delay_s, config.rate_hz),
        )
        self._deviation = np.hypot(axes(position.white), axes(position.markov))

    def packet(self, rows: Mapping[str, NDArray[Any]], **header: Any) -> GpsFix | None:
        """Return one sample as a packet; None: it does not come."""
        if not rows["came"]:
            return None
        config = self._config
        latitude_rad, longitude_rad, altitude_m = geodetic(
            rows["position"], config.latitude_rad, config.longitude_rad, config.altitude_m
        )
        return GpsFix(
            latitude_rad=latitude_rad,
            longitude_rad=longitude_rad,
            altitude_m=altitude_m,
            velocity=numbers(rows, "velocity"),
            position_std=self._deviation,
            **header,
        )


def geodetic(
    position: NDArray[np.float64], latitude_rad: float, longitude_rad: float, altitude_m: float
) -> tuple[float, float, float]:
    """Return latitude [rad], longitude [rad] and altitude [m] of a place in W, to 1e-9 m.

    Args:
        position: East, north, up of the origin [m], shape [3].
        latitude_rad: Of the origin, likewise the others.
        longitude_rad: See above.
        altitude_m: See above.
    """
    sin, cos = math.sin(latitude_rad), math.cos(latitude_rad)
    east, north, up = (float(value) for value in position)
    normal_m = _SEMI_MAJOR_M / math.sqrt(1.0 - _ECCENTRICITY_2 * sin * sin)
    out = (normal_m + altitude_m + up) * cos - north * sin  # in the meridian of the origin
    z = (normal_m * (1.0 - _ECCENTRICITY_2) + altitude_m + up) * sin + north * cos
    r = math.hypot(out, east)
    latitude = latitude_rad
    for _ in range(5):  # of the order of the eccentricity^2 better each time
        sin = math.sin(latitude)
        normal_m = _SEMI_MAJOR_M / math.sqrt(1.0 - _ECCENTRICITY_2 * sin * sin)
        latitude = math.atan2(z + _ECCENTRICITY_2 * normal_m * sin, r)
    sin, cos = math.sin(latitude), math.cos(latitude)
    altitude = r * cos + z * sin - _SEMI_MAJOR_M * math.sqrt(1.0 - _ECCENTRICITY_2 * sin * sin)
    longitude = longitude_rad + math.atan2(east, out)
    return latitude, math.remainder(longitude, 2.0 * math.pi), altitude
