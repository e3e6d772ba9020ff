# mypy: disable-error-code="index,attr-defined,misc,operator,arg-type,valid-type,assignment,no-untyped-def"
"""The barometer: the pressure of the standard atmosphere at its place, up to 20 km, and its errors.

Reference: ICAO Doc 7488 (1993), Manual of the standard atmosphere, eq. (8) to (13); ISO 2533.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import warp as wp
from pydantic import Field

from neurosim_core.frames import Mount
from neurosim_core.packets import FieldSpec, Packet
from neurosim_core.registry import register
from neurosim_core.sensors.base import RateHz, SamplerContext, StateSensorConfig
from neurosim_core.sensors.state_sampler import ErrorConfig, Motion, StateSampler, make_reader

_EARTH_RADIUS_M = wp.constant(wp.float64(6_356_766.0))
_LAPSE_K_M = wp.constant(wp.float64(0.0065))
_G_OVER_R = wp.constant(wp.float64(9.80665 / 287.05287))  # [K/m]
_TROPOPAUSE_M = wp.constant(wp.float64(11_000.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class Pressure(Packet):
    """The reading of a barometer."""

    pressure_pa: Annotated[float, FieldSpec(unit="Pa")]
    """Static pressure [Pa]."""


@register("sensor", "barometer")
class BarometerConfig(StateSensorConfig):
    """A barometer, without errors by default."""

    kind: Literal["barometer"] = "barometer"
    rate_hz: RateHz = 50.0
    """Reading rate [Hz]."""
    mount: Mount = Mount()
    """Pose on the body."""
    altitude_m: Annotated[float, Field(ge=-5000.0, le=19_000.0)] = 0.0
    """Altitude of z = 0 above sea level [m]."""
    sea_level_pa: Annotated[float, Field(gt=0.0)] = 101_325.0
    """Pressure at sea level [Pa]."""
    sea_level_k: Annotated[float, Field(gt=200.0, le=340.0)] = 288.15
    """Temperature at sea level [K]."""
    errors: ErrorConfig = ErrorConfig()
    """Errors [Pa]: {white: 1.3, markov: 30, markov_time_s: 600, resolution: 0.18}; a walk models weather."""

    packet_type = Pressure

    def make(self, context: SamplerContext) -> StateSampler:
        """Return the sensor at work."""
        model = _Model()
        model.position, model.altitude = wp.vec3d(*self.mount.position_m), wp.float64(self.altitude_m)
        model.sea_level, model.temperature = wp.float64(self.sea_level_pa), wp.float64(self.sea_level_k)
        errors = {"pressure": self.errors}
        made = make_reader(
            context, _read_pressure, model, errors, Pressure, rate_hz=self.rate_hz, is_scalar=True
        )
        made.arrays = {"pressure_pa": made.arrays["pressure"]}
        return made


@wp.struct
class _Model:
    position: wp.vec3d
    altitude: wp.float64
    sea_level: wp.float64
    temperature: wp.float64


@wp.func
def standard_pressure(altitude: wp.float64, sea_level: wp.float64, temperature: wp.float64) -> wp.float64:
    """Return the pressure at a geometric altitude [m], for pressure [Pa] and temperature [K] at sea level."""
    h = _EARTH_RADIUS_M * altitude / (_EARTH_RADIUS_M + altitude)  # geopotential
    low = wp.min(h, _TROPOPAUSE_M)
    ratio = wp.pow(wp.float64(1.0) - _LAPSE_K_M * low / temperature, _G_OVER_R / _LAPSE_K_M)
    above = wp.max(h - _TROPOPAUSE_M, wp.float64(0.0))
    return sea_level * ratio * wp.exp(-_G_OVER_R * above / (temperature - _LAPSE_K_M * _TROPOPAUSE_M))


@wp.func
def _read_pressure(model: _Model, motion: Motion, world: int, output: int) -> wp.vec3d:
    p = motion.position[world] + wp.quat_rotate(motion.orientation[world], model.position)
    pressure = standard_pressure(model.altitude + p[2], model.sea_level, model.temperature)
    return wp.vec3d(pressure, wp.float64(0.0), wp.float64(0.0))
