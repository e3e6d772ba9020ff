# mypy: disable-error-code="index,attr-defined,misc,operator,arg-type,valid-type,assignment,no-untyped-def"
"""The GPS receiver: geodetic position and velocity, late, with errors that come and go.

The world W is a tangent plane of the WGS84 ellipsoid: east, north, up at an origin.

Reference: NIMA TR8350.2 (2000), World Geodetic System 1984. Rankin (1994), An error model for sensor
simulation GPS and differential GPS: Gauss-Markov processes for what satellites and atmosphere do.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field

from neurosim_core.frames import Mount
from neurosim_core.packets import FieldSpec, Packet
from neurosim_core.registry import register
from neurosim_core.sensors.base import RateHz, SamplerContext
from neurosim_core.sensors.state_sampler import (
    ErrorConfig,
    LateConfig,
    Motion,
    StateSampler,
    axes,
    make_reader,
)

_SEMI_MAJOR_M = 6_378_137.0
_FLATTENING = 1.0 / 298.257223563
_ECCENTRICITY_2 = _FLATTENING * (2.0 - _FLATTENING)


@dataclass(frozen=True, kw_only=True, eq=False)
class GpsFix(Packet):
    """The fix of a GPS receiver; it was there `delay_s` before the stamp."""

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
class GpsConfig(LateConfig):
    """A GPS receiver, without errors and without delay by default."""

    kind: Literal["gps"] = "gps"
    rate_hz: RateHz = 10.0
    """Rate of position fixes [Hz]."""
    mount: Mount = Mount()
    """Position of the antenna on the body."""
    latitude_rad: Annotated[float, Field(gt=-1.57, lt=1.57)] = math.radians(47.4)
    """Geodetic latitude of the world origin [rad]."""
    longitude_rad: Annotated[float, Field(ge=-math.pi, le=math.pi)] = math.radians(8.55)
    """Longitude of the world origin [rad]."""
    altitude_m: float = 450.0
    """Altitude of the world origin above the ellipsoid [m]."""
    position_errors: ErrorConfig = ErrorConfig()
    """Errors east, north, up [m], such as {white: 0.1, markov: [1.5, 1.5, 3], markov_time_s: 100}."""
    velocity_errors: ErrorConfig = ErrorConfig()
    """Errors east, north, up [m/s]."""

    packet_type = GpsFix

    def make(self, context: SamplerContext) -> StateSampler:
        """Return the sensor at work; on the device, positions are those in W [m]."""
        return make_reader(
            context,
            _read_antenna,
            wp.vec3d(*self.mount.position_m),
            {"position": self.position_errors, "velocity": self.velocity_errors},
            self._packet,
            rate_hz=self.rate_hz,
            late=self,
        )

    def _packet(self, position: NDArray[np.float64], velocity: NDArray[np.float64], **header: Any) -> GpsFix:
        latitude_rad, longitude_rad, altitude_m = geodetic(
            position, self.latitude_rad, self.longitude_rad, self.altitude_m
        )
        return GpsFix(
            latitude_rad=latitude_rad,
            longitude_rad=longitude_rad,
            altitude_m=altitude_m,
            velocity=velocity,
            position_std=np.hypot(axes(self.position_errors.white), axes(self.position_errors.markov)),
            **header,
        )


@wp.func
def _read_antenna(antenna: wp.vec3d, motion: Motion, world: int, output: int) -> wp.vec3d:
    q = motion.orientation[world]
    if output == 0:
        return motion.position[world] + wp.quat_rotate(q, antenna)
    return motion.velocity[world] + wp.quat_rotate(q, wp.cross(motion.body_rate[world], antenna))


def geodetic(
    position: NDArray[np.float64], latitude_rad: float, longitude_rad: float, altitude_m: float
) -> tuple[float, float, float]:
    """Return latitude [rad], longitude [rad] and altitude [m] of a place in W, to 1e-9 m.

    The place is east, north, up of an origin [m], shape [3], of which the others are given.
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
