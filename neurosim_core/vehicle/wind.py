# mypy: disable-error-code="index,attr-defined,misc,call-overload,operator,assignment,arg-type,valid-type"
# mypy: disable-error-code="no-untyped-def"
"""Wind: a constant, discrete gusts, and Dryden turbulence that a vehicle meets on its way.

Turbulence follows the low-altitude model: a frozen field that passes the vehicle at its air speed V, with
scale lengths and intensities that depend on the height h above ground [ft] and on the wind at 20 ft:

    L_w = h,    L_u = L_v = h / (0.177 + 0.000823 h)^1.2
    sigma_w = 0.1 W_20,    sigma_u = sigma_v = sigma_w / (0.177 + 0.000823 h)^0.4

In dimensionless time theta = V t / L the components over sigma are white noise through 1.414 / (1 + p) along
the mean wind and through (1 + 1.732 p) / (1 + p)^2 across it and vertically. Their autocorrelations are
exp(-theta) and (1 - theta / 2) exp(-theta). The filters are sampled at fixed ticks: with the exact transition
matrix and the exact covariance of the noise between two ticks, and with random numbers addressed by the tick,
with scale lengths and intensities for height and air speed at the tick before. Intervals are cut at ticks, so
the same wind blows on the same flight whatever the intervals, sensors and batches are. Between ticks it is
linear.

Left out: the angular gusts p, q, r of the model, so all rotors and the frame meet one wind, and it turns a
vehicle only by what it does to rotors and frame alike; and the shear of the mean wind with height.

Reference: MIL-F-8785C (1980), 3.7.1.2 and 3.7.2.3 (Dryden form), 3.7.1.3 (discrete gust), 3.7.3.4 (low
altitude); MIL-HDBK-1797 (1997), appendix A, which has half the lateral and vertical scale lengths in formulas
that have twice, hence the same spectra.
"""

import math
from collections.abc import Sequence
from typing import Annotated, Any

import warp as wp
from pydantic import Field, field_validator

from neurosim_core.clock import to_ns
from neurosim_core.frames import Vector3
from neurosim_core.random import normal2, random_bits, stream_id
from neurosim_core.settings import BaseConfig
from neurosim_core.vehicle.aerodynamics import Airframe

_TICK_COUNT = 2  # ticks of turbulence that are kept for each vehicle: it flies between them
_FOOT_M = 0.3048
_STREAM = wp.constant(wp.uint32(stream_id("vehicle/turbulence")))
_SQRT_2 = wp.constant(wp.float64(math.sqrt(2.0)))
_SQRT_3 = wp.constant(wp.float64(math.sqrt(3.0)))
_SERIES_BELOW = wp.constant(wp.float64(0.05))  # where the closed forms of the covariance cancel
_SERIES_TERM_COUNT = wp.constant(wp.int32(12))

_vec5d = wp.types.vector(length=5, dtype=wp.float64)


_Wind = Annotated[float, Field(ge=-200.0, le=200.0)]
WindVector = tuple[_Wind, _Wind, _Wind]
"""Velocity of the air [m/s], up to twice a hurricane's: what is faster passes walls between two checks."""


class GustConfig(BaseConfig):
    """A discrete gust that rises and falls as 1 - cos, the same everywhere."""

    velocity_m_s: WindVector
    """Velocity of the air at full strength, added to the wind, in W [m/s]: amplitude and direction."""
    start_s: Annotated[float, Field(ge=0.0, le=1e6)]
    """Start time [s]."""
    rise_s: Annotated[float, Field(gt=0.0, le=1e6)]
    """Time to full strength, and to fall from it [s]: length of the gust over air speed."""
    hold_s: Annotated[float, Field(ge=0.0, le=1e6)] | None = None
    """Time at full strength [s]; null: for good, as in MIL-F-8785C; 0: a single pulse of twice `rise_s`, as
    in CS-25.341."""


class TurbulenceConfig(BaseConfig):
    """Dryden turbulence at low altitude (10 to 1000 ft)."""

    wind_20ft_m_s: Annotated[float, Field(gt=0.0, le=100.0)]
    """Mean wind at 20 ft above ground, which sets the intensity [m/s]: light 7.7, moderate 15.4, severe 23.1.
    It does not blow by itself: see `wind_m_s`."""
    altitude_m: Annotated[float, Field(ge=10 * _FOOT_M, le=1000 * _FOOT_M)] | None = None
    """Height above ground for scale lengths and intensities [m]; null: that of the vehicle above the ground
    (z = 0 without one) at each tick, within the 3.048 to 304.8 m that the model is for."""
    airspeed_m_s: Annotated[float, Field(gt=0.0, le=1000.0)] | None = None
    """Speed at which the field passes the vehicle [m/s]; null: that of the vehicle relative to `wind_m_s` at
    each tick, at least 1 m/s."""
    sample_s: Annotated[float, Field(ge=1e-4, le=1.0)] = 0.01
    """Time between two ticks of the turbulence [s]; linear in between. No step is longer."""

    @field_validator("sample_s")
    @classmethod
    def _whole_ns(cls, value: float) -> float:
        if abs(value * 1e9 - round(value * 1e9)) > 1e-6:
            raise ValueError("sample_s must be a whole number of nanoseconds")
        return value


@wp.struct
class Gust:
    """A discrete gust as the kernels read it."""

    velocity: wp.vec3d
    start: wp.float64
    rise: wp.float64
    fall: wp.float64  # when it begins to fall, after the start; infinite: never


@wp.struct
class Wind:
    """What blows, besides the constant wind of the airframe."""

    gusts: wp.array(dtype=Gust)
    seeds: wp.array(dtype=wp.uint64)  # of each vehicle, [N]
    tick_ns: wp.int64
    sigma_w: wp.float64
    along: wp.vec3d  # horizontal direction of the mean wind
    altitude: wp.float64  # 0: that of the vehicle
    ground_height: wp.float64
    airspeed: wp.float64  # 0: that of the vehicle
    ring: wp.array2d(dtype=wp.vec3d)  # turbulence in W at tick k in column k modulo 2, [N, 2]
    filters: wp.array(dtype=_vec5d)  # states of the filters as of the last tick: u; v and w two each, [N]
    last_tick: wp.array(dtype=wp.int64)  # [N]


def make_wind(
    gusts: Sequence[GustConfig],
    turbulence: TurbulenceConfig | None,
    *,
    turbulent: bool,
    wind_m_s: Vector3,
    ground_height_m: float,
    seeds: Any,
    count: int,
    device: Any,
) -> Wind:
    """Allocate what gusts and turbulence need, for a number of vehicles; nothing for what there is not.

    If it is `turbulent` without parameters, the air is still in the place of turbulence, which is aligned
    with the mean wind `wind_m_s`. Seeds are those of each vehicle, device array of uint64, shape [N].
    """
    wind = Wind()
    if gusts:
        rows = []
        for config in gusts:
            gust = Gust()
            gust.velocity = wp.vec3d(*config.velocity_m_s)
            gust.start, gust.rise = config.start_s, config.rise_s
            gust.fall = math.inf if config.hold_s is None else config.rise_s + config.hold_s
            rows.append(gust)
        wind.gusts = wp.array(rows, dtype=Gust, device=device)
    if turbulent:
        sigma_w = 0.1 * turbulence.wind_20ft_m_s if turbulence is not None else 0.0
        turbulence = turbulence or TurbulenceConfig(wind_20ft_m_s=1.0)
        horizontal = math.hypot(wind_m_s[0], wind_m_s[1])
        along = (wind_m_s[0] / horizontal, wind_m_s[1] / horizontal) if horizontal > 0.0 else (1.0, 0.0)
        wind.seeds = seeds
        wind.tick_ns = to_ns(turbulence.sample_s)
        wind.sigma_w = sigma_w
        wind.along = wp.vec3d(*along, 0.0)
        wind.ground_height = ground_height_m
        wind.altitude = turbulence.altitude_m or 0.0
        wind.airspeed = turbulence.airspeed_m_s or 0.0
        wind.ring = wp.zeros((count, _TICK_COUNT), dtype=wp.vec3d, device=device)
        wind.filters = wp.zeros(count, dtype=_vec5d, device=device)
        wind.last_tick = wp.zeros(count, dtype=wp.int64, device=device)
    return wind


@wp.func
def gust_share(gust: Gust, t: wp.float64) -> wp.float64:
    """Return how much of a gust blows at a time [s], 0 to 1."""
    half = wp.float64(0.5)
    pi = wp.float64(wp.static(math.pi))
    since = t - gust.start
    falling = since - gust.fall
    if since <= wp.float64(0.0) or falling >= gust.rise:
        return wp.float64(0.0)
    if since < gust.rise:
        return half * (wp.float64(1.0) - wp.cos(pi * since / gust.rise))
    if falling > wp.float64(0.0):
        return half * (wp.float64(1.0) + wp.cos(pi * falling / gust.rise))
    return wp.float64(1.0)


@wp.func
def _noise_moment(theta: wp.float64, power: wp.int32) -> wp.float64:
    """Integral of s^power exp(-2 s) over [0, theta], power 0, 1 or 2."""
    two = wp.float64(2.0)
    if theta < _SERIES_BELOW:
        moment = wp.float64(0.0)
        term = wp.float64(1.0)
        for k in range(_SERIES_TERM_COUNT):
            moment += term / wp.float64(k + power + 1)
            term *= -two * theta / wp.float64(k + 1)
        return moment * wp.pow(theta, wp.float64(power + 1))
    decay = wp.exp(-two * theta)
    if power == 0:
        return (wp.float64(1.0) - decay) / two
    if power == 1:
        return (wp.float64(1.0) - decay * (wp.float64(1.0) + two * theta)) / wp.float64(4.0)
    return (wp.float64(1.0) - decay * (wp.float64(1.0) + two * theta + two * theta * theta)) / wp.float64(4.0)


@wp.func
def _next_across(z: wp.vec2d, theta: wp.float64, noise: wp.vec2d) -> wp.vec2d:
    """States of 1 / (1 + p) and 1 / (1 + p)^2 after theta, driven by white noise of unit intensity."""
    decay = wp.exp(-theta)
    q_11 = _noise_moment(theta, 0)
    q_12 = _noise_moment(theta, 1)
    q_22 = _noise_moment(theta, 2)
    root = wp.sqrt(q_11)  # Cholesky factor of the covariance
    side = q_12 / root
    rest = wp.sqrt(wp.max(q_22 - side * side, wp.float64(0.0)))
    return wp.vec2d(
        decay * z[0] + root * noise[0], decay * (z[1] + theta * z[0]) + side * noise[0] + rest * noise[1]
    )


@wp.func
def _next_along(z: wp.float64, theta: wp.float64, noise: wp.float64) -> wp.float64:
    return wp.exp(-theta) * z + wp.sqrt(wp.float64(2.0) * _noise_moment(theta, 0)) * noise


@wp.func
def _noise(wind: Wind, vehicle: wp.int32, tick: wp.int64, axis: wp.int32) -> wp.vec2d:
    return normal2(random_bits(wind.seeds[vehicle], _STREAM, tick, axis))


@wp.func
def _height_ft(wind: Wind, p_WB: wp.vec3d) -> wp.float64:
    height_m = p_WB[2] - wind.ground_height
    if wind.altitude > wp.float64(0.0):
        height_m = wind.altitude
    return wp.clamp(height_m / wp.float64(_FOOT_M), wp.float64(10.0), wp.float64(1000.0))


@wp.func
def _output(wind: Wind, z: _vec5d, height_ft: wp.float64) -> wp.vec3d:
    """Velocity of the turbulence in W."""
    profile = wp.float64(0.177) + wp.float64(0.000823) * height_ft
    sigma_u = wind.sigma_w / wp.pow(profile, wp.float64(0.4))
    one = wp.float64(1.0)
    u = sigma_u * z[0]
    v = sigma_u * (_SQRT_3 * z[1] + (one - _SQRT_3) * z[2])
    w = wind.sigma_w * (_SQRT_3 * z[3] + (one - _SQRT_3) * z[4])
    return wp.vec3d(u * wind.along[0] - v * wind.along[1], u * wind.along[1] + v * wind.along[0], w)


@wp.func
def start_turbulence(wind: Wind, vehicle: wp.int32, p_WB: wp.vec3d):
    """Draw turbulence at tick 0 from its stationary distribution."""
    tick = wp.int64(0)
    n_u = _noise(wind, vehicle, tick, 0)
    n_v = _noise(wind, vehicle, tick, 1)
    n_w = _noise(wind, vehicle, tick, 2)
    # across: covariance ((1/2, 1/4), (1/4, 1/4))
    a = wp.float64(1.0) / _SQRT_2
    b = wp.float64(0.5) * a
    z = _vec5d(n_u[0], a * n_v[0], b * (n_v[0] + n_v[1]), a * n_w[0], b * (n_w[0] + n_w[1]))
    wind.filters[vehicle] = z
    wind.ring[vehicle, 0] = _output(wind, z, _height_ft(wind, p_WB))
    wind.last_tick[vehicle] = tick


@wp.func
def draw_turbulence(
    wind: Wind, airframe: Airframe, vehicle: wp.int32, now_ns: wp.int64, p_WB: wp.vec3d, v_W: wp.vec3d
):
    """Draw the next tick if now is the one before it, at the height and air speed of now."""
    tick = now_ns / wind.tick_ns
    if tick < wind.last_tick[vehicle]:
        return
    tick += wp.int64(1)
    height_ft = _height_ft(wind, p_WB)
    profile = wp.float64(0.177) + wp.float64(0.000823) * height_ft
    length_m = wp.float64(_FOOT_M) * height_ft / wp.pow(profile, wp.float64(1.2))
    airspeed = wp.max(wp.length(v_W - airframe.wind), wp.float64(1.0))
    if wind.airspeed > wp.float64(0.0):
        airspeed = wind.airspeed
    passed_m = airspeed * wp.float64(wind.tick_ns) * wp.float64(1e-9)
    theta = passed_m / length_m
    theta_w = passed_m / (wp.float64(_FOOT_M) * height_ft)
    z = wind.filters[vehicle]
    u = _next_along(z[0], theta, _noise(wind, vehicle, tick, 0)[0])
    v = _next_across(wp.vec2d(z[1], z[2]), theta, _noise(wind, vehicle, tick, 1))
    w = _next_across(wp.vec2d(z[3], z[4]), theta_w, _noise(wind, vehicle, tick, 2))
    z = _vec5d(u, v[0], v[1], w[0], w[1])
    wind.ring[vehicle, wp.int32(tick % wp.int64(_TICK_COUNT))] = _output(wind, z, height_ft)
    wind.filters[vehicle] = z
    wind.last_tick[vehicle] = tick


@wp.func
def _turbulence_at(wind: Wind, vehicle: wp.int32, start_ns: wp.int64, t: wp.float64) -> wp.vec3d:
    tick = start_ns / wind.tick_ns
    tick_s = wp.float64(wind.tick_ns) * wp.float64(1e-9)
    s = (wp.float64(start_ns - tick * wind.tick_ns) * wp.float64(1e-9) + t) / tick_s
    whole = wp.floor(s)
    tick += wp.int64(whole)
    count = wp.int64(_TICK_COUNT)
    before = wind.ring[vehicle, wp.int32(tick % count)]
    after = wind.ring[vehicle, wp.int32((tick + wp.int64(1)) % count)]
    return before + (s - whole) * (after - before)


@wp.func
def time_to_tick(wind: Wind, now_ns: wp.int64) -> wp.int64:
    """Return the time to the next tick of the turbulence, where its slope jumps, > 0 [ns]."""
    return wind.tick_ns - now_ns % wind.tick_ns


def make_wind_at(terms: frozenset[str]) -> Any:
    """Return the function of the wind of the given terms: of wind, gusts and turbulence.

    (airframe, wind, vehicle, start_ns, t) -> velocity of the air in W [m/s] at t [s] after `start_ns`.
    """
    constant = "wind" in terms
    gusts = "gusts" in terms
    turbulence = "turbulence" in terms

    @wp.func
    def wind_at(airframe: Airframe, wind: Wind, vehicle: wp.int32, start_ns: wp.int64, t: wp.float64):
        velocity = wp.vec3d()
        if wp.static(constant):
            velocity = airframe.wind
        if wp.static(gusts):
            now = wp.float64(start_ns) * wp.float64(1e-9) + t
            for gust in range(wind.gusts.shape[0]):
                velocity += gust_share(wind.gusts[gust], now) * wind.gusts[gust].velocity
        if wp.static(turbulence):
            velocity += _turbulence_at(wind, vehicle, start_ns, t)
        return velocity

    return wind_at
