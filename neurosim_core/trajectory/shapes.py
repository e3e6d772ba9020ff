"""Paths with a closed form: hover, line, circle, figure eight and other Lissajous curves.

A curve p(theta) is flown with a phase theta(t) whose rate rises smoothly from rest and falls back to it. The
path is its piecewise degree-9 Hermite interpolant: position and four derivatives are those of the closed
form at each knot, and between knots it is off by less than a nanometre for the spacing chosen here.
"""

from __future__ import annotations

import itertools
import math
from typing import Annotated, Literal

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray
from pydantic import Field, model_validator

from neurosim_core.clock import NS_PER_S, to_ns
from neurosim_core.frames import Vector3
from neurosim_core.settings import BaseConfig
from neurosim_core.trajectory.heading import follow_travel
from neurosim_core.trajectory.minsnap import hermite_matrix, minimum_snap
from neurosim_core.trajectory.path import Path

Array = NDArray[np.float64]

Cycles = Annotated[int, Field(ge=1, le=16)]

_ORDER = 5
"""Values given at each knot: position to snap."""
_PIECES_MAX = 1_000_000
_LARGEST = 1e6
"""Of lengths [m], speeds [m/s], times [s] and laps."""
_RAMP = Polynomial([0.0] * 5 + [126.0, -420.0, 540.0, -315.0, 70.0])
"""Rises from 0 to 1 on [0, 1] with four derivatives zero at both ends."""


class ShapeConfig(BaseConfig):
    """Settings that all closed-form paths have."""

    yaw: Literal["travel"] | float = 0.0
    """Heading [rad], or travel: the direction of flight."""
    yaw_rate_max_rad_s: float = Field(default=3.0, gt=0.0)
    """Largest yaw rate with `yaw: travel` [rad/s]."""


class HoverConfig(ShapeConfig):
    """Hovering at one place."""

    kind: Literal["hover"] = "hover"
    position_m: Vector3 | None = None
    """Position in W [m]; null: the middle of free space."""


class LineConfig(ShapeConfig):
    """A straight minimum-snap line from rest to rest."""

    kind: Literal["line"] = "line"
    start_m: Vector3
    """Start position in W [m]."""
    end_m: Vector3
    """End position in W [m]."""
    speed_max_m_s: float = Field(default=2.0, gt=0.0, le=_LARGEST)
    """Largest speed, half-way [m/s]."""

    @model_validator(mode="after")
    def _ends_differ(self) -> LineConfig:
        if self.start_m == self.end_m:
            raise ValueError(f"end_m must differ from start_m, got {self.end_m} twice")
        return self


class PeriodicConfig(ShapeConfig):
    """Settings that all closed curves have."""

    center_m: Vector3 | None = None
    """Centre of the curve [m]; null: the middle of free space."""
    speed_max_m_s: float = Field(default=2.0, gt=0.0, le=_LARGEST)
    """Largest speed [m/s]."""
    laps: float = Field(default=2.0, gt=0.0, le=_LARGEST)
    """Number of laps, including the parts in which speed rises and falls."""
    ramp_s: float = Field(default=2.0, gt=0.0, le=_LARGEST)
    """Time from rest to full speed, and from full speed to rest [s]; shortened if the laps take less."""


class CircleConfig(PeriodicConfig):
    """A level circle, counter-clockwise from its easternmost point."""

    kind: Literal["circle"] = "circle"
    radius_m: float = Field(default=1.0, gt=0.0, le=_LARGEST)
    """Radius [m]."""


class FigureEightConfig(PeriodicConfig):
    """A level figure eight, x = length/2 sin(theta), y = width/2 sin(2 theta); fastest in the middle."""

    kind: Literal["figure_eight"] = "figure_eight"
    length_m: float = Field(default=3.0, gt=0.0, le=_LARGEST)
    """Length along x [m]."""
    width_m: float = Field(default=1.5, gt=0.0, le=_LARGEST)
    """Width along y [m]."""


class LissajousConfig(PeriodicConfig):
    """A Lissajous curve in space: axis i is amplitude sin(cycles theta + phase)."""

    kind: Literal["lissajous"] = "lissajous"
    amplitude_m: Vector3 = (1.5, 0.75, 0.3)
    """Half the size along x, y, z [m]."""
    cycles: tuple[Cycles, Cycles, Cycles] = (1, 2, 3)
    """Oscillations per lap along x, y, z."""
    phase_rad: Vector3 = (0.0, 0.0, 0.0)
    """Phase along x, y, z [rad]."""

    @model_validator(mode="after")
    def _moves(self) -> LissajousConfig:
        if not 0.0 < max(map(abs, self.amplitude_m)) <= _LARGEST:
            raise ValueError(
                f"amplitude_m must not be all zero, and at most {_LARGEST:g} m, got {self.amplitude_m}"
            )
        return self


def hover(config: HoverConfig, *, position: Array) -> Path:
    """Return a path that rests, for ever."""
    coefficients = np.zeros((1, 4, 1))
    coefficients[0, :3, 0] = position if config.position_m is None else config.position_m
    coefficients[0, 3, 0] = 0.0 if config.yaw == "travel" else config.yaw
    return Path(np.array([0, NS_PER_S]), coefficients)


def line(config: LineConfig) -> Path:
    """Return a straight line of least snap; its largest speed is 35/16 of the mean."""
    distance = math.dist(config.start_m, config.end_m)
    knots_ns = [0, to_ns(35.0 / 16.0 * distance / config.speed_max_m_s)]
    return _with_heading(minimum_snap([config.start_m, config.end_m], knots_ns), config)


def circle(config: CircleConfig, *, center: Array) -> Path:
    """Return a circle, parallel to the ground.

    Args:
        config: Radius, speed and heading.
        center: Its centre in W [m], shape [3], unless `config` gives one.
    """
    radius = config.radius_m
    return _periodic(config, center, (radius, radius, 0.0), (1, 1, 1), (0.5 * math.pi, 0.0, 0.0))


def figure_eight(config: FigureEightConfig, *, center: Array) -> Path:
    """Return a figure eight, parallel to the ground; arguments as of `circle`."""
    amplitude = (0.5 * config.length_m, 0.5 * config.width_m, 0.0)
    return _periodic(config, center, amplitude, (1, 2, 1), (0.0, 0.0, 0.0))


def lissajous(config: LissajousConfig, *, center: Array) -> Path:
    """Return a Lissajous curve; arguments as of `circle`."""
    return _periodic(config, center, config.amplitude_m, config.cycles, config.phase_rad)


def _periodic(
    config: PeriodicConfig, center: Array, amplitude: Vector3, cycles: tuple[int, int, int], phase: Vector3
) -> Path:
    size, rate, shift = np.array(amplitude), np.array(cycles, dtype=np.float64), np.array(phase)
    middle = center if config.center_m is None else np.array(config.center_m)
    if not np.isfinite(middle).all():
        raise ValueError(f"the centre must be finite, got {middle.tolist()}")
    theta = np.linspace(0.0, 2.0 * math.pi, 20_001)  # finds the largest speed to 1e-5 at 16 cycles
    tangent = size * rate * np.cos(theta[:, None] * rate + shift)
    omega = config.speed_max_m_s / float(np.linalg.norm(tangent, axis=1).max())
    lap_phase = 2.0 * math.pi * config.laps
    ramp_ns = to_ns(min(config.ramp_s, lap_phase / omega))
    # two ramps cover as much phase as one at full speed
    end_ns = ramp_ns + max(to_ns(lap_phase / omega), ramp_ns)

    fastest = omega * float(rate[size != 0.0].max())
    spacing_ns = min(to_ns(0.4 / fastest), ramp_ns // 16)
    if spacing_ns < 1 or end_ns // spacing_ns > _PIECES_MAX:
        raise ValueError(
            f"{config.laps:g} laps at {config.speed_max_m_s:g} m/s with ramps of {config.ramp_s:g} s take "
            f"{end_ns / NS_PER_S:.3g} s, {fastest:.3g} rad/s and more than {_PIECES_MAX:,} pieces of path"
        )
    marks = sorted({0, ramp_ns, end_ns - ramp_ns, end_ns})
    knots = [np.zeros(1, dtype=np.int64)]
    for a, b in itertools.pairwise(marks):
        parts = -(-(b - a) // spacing_ns)
        knots.append(a + np.arange(1, parts + 1, dtype=np.int64) * (b - a) // parts)
    knots_ns = np.concatenate(knots)
    jets = _jets(knots_ns, ramp_ns=ramp_ns, end_ns=end_ns, omega=omega)
    taylor = np.stack([size[a] * _sine(rate[a] * jets, shift[a]) for a in range(3)], axis=1)
    taylor[:, :, 0] += middle
    return _with_heading(_hermite(knots_ns, taylor), config)


def _jets(knots_ns: NDArray[np.int64], *, ramp_ns: int, end_ns: int, omega: float) -> Array:
    """Taylor coefficients of the phase at each knot, in powers of seconds, shape [knot, 5].

    The phase rises as omega times the integral of the ramp, then evenly, then as the mirror image of its
    start.
    """
    ramp_s = ramp_ns / NS_PER_S
    rising = _RAMP.integ() * (omega * ramp_s)
    derivatives = [rising, *(rising.deriv(k) for k in range(1, _ORDER))]
    last = omega * (end_ns - ramp_ns) / NS_PER_S  # phase at the end
    jets = np.zeros((len(knots_ns), _ORDER))
    jets[:, 0] = omega * (knots_ns / NS_PER_S - 0.5 * ramp_s)
    jets[:, 1] = omega
    begins, ends = knots_ns < ramp_ns, knots_ns > end_ns - ramp_ns
    for k, function in enumerate(derivatives):
        scale = 1.0 / (ramp_s**k * math.factorial(k))
        jets[begins, k] = function(knots_ns[begins] / ramp_ns) * scale
        jets[ends, k] = (last if k == 0 else 0.0) - (-1.0) ** k * function(
            (end_ns - knots_ns[ends]) / ramp_ns
        ) * scale
    return jets


def _sine(jets: Array, shift: float) -> Array:
    """Taylor coefficients of sin(theta(t) + shift) from those of theta: s' = c theta', c' = -s theta'."""
    sine, cosine = np.zeros_like(jets), np.zeros_like(jets)
    sine[:, 0], cosine[:, 0] = np.sin(jets[:, 0] + shift), np.cos(jets[:, 0] + shift)
    for n in range(1, jets.shape[1]):
        for k in range(1, n + 1):
            sine[:, n] += k * jets[:, k] * cosine[:, n - k] / n
            cosine[:, n] -= k * jets[:, k] * sine[:, n - k] / n
    return sine


def _hermite(knots_ns: NDArray[np.int64], taylor: Array) -> Path:
    """Interpolate Taylor coefficients [knot, 3, 5] at the knots by pieces of degree 9."""
    durations_s = np.diff(knots_ns) / NS_PER_S
    orders = np.arange(_ORDER)
    factorial = np.array([math.factorial(k) for k in orders], dtype=np.float64)
    scale = (durations_s[:, None] ** orders * factorial)[:, None, :]
    origin = np.zeros_like(taylor[:-1])  # the left end: relative to it the end values are small numbers
    origin[:, :, 0] = taylor[:-1, :, 0]
    ends = np.concatenate([(taylor[:-1] - origin) * scale, (taylor[1:] - origin) * scale], axis=2)
    coefficients = np.einsum("ij,saj->sai", hermite_matrix(_ORDER), ends)
    coefficients[:, :, 0] += origin[:, :, 0]
    return Path(knots_ns, np.pad(coefficients, ((0, 0), (0, 1), (0, 0))))


def _with_heading(path: Path, config: ShapeConfig) -> Path:
    if config.yaw == "travel":
        return follow_travel(path, lookahead_s=0.3, rate_max_rad_s=config.yaw_rate_max_rad_s)
    return path.with_yaw(np.full((len(path.coefficients), 1), config.yaw))
