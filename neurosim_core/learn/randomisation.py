"""The parameters that are randomised in each episode."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Randomisation:
    """Parameters that differ from episode to episode and from world to world, besides the initial state."""

    thrust_factor: tuple[float, float] = (0.9, 1.1)
    """Range of thrust per commanded thrust: a battery, or a mass that is not known; not of velocities."""
    latency_steps: int = 1
    """Most steps between an action and its effect; each episode has its own, from 0 on."""
    lag_s: tuple[float, float] = (0.0, 0.0)
    """Range of the time constant with which thrust and rates follow their commands [s]: slower motors, say,
    than those of the vehicle, whose own lag is there besides."""
    threshold_factor: tuple[float, float] = (0.8, 1.25)
    """Range of each threshold of the event camera against the nominal one."""
    mass_factor: tuple[float, float] = (1.0, 1.0)
    """Range of the mass; with the inertia of the same shape."""
    inertia_factor: tuple[float, float] = (1.0, 1.0)
    """Range of the inertia besides."""
    drag_factor: tuple[float, float] = (1.0, 1.0)
    """Range of rotor drag and parasitic drag."""
    mount_m: float = 0.0
    """Largest displacement of the event camera along each axis of B [m]."""
    mount_rad: float = 0.0
    """Largest part of its turn on the body about each axis of B, a rotation vector [rad]."""
    focal_factor: tuple[float, float] = (1.0, 1.0)
    """Range of its focal length against that of its lens. Episodes share `cameras.LENS_COUNT` lenses."""
    axis_shift: float = 0.0
    """Largest shift of its optical axis along rows and along columns, as a share of the width."""
    distortion: tuple[float, float] = (0.0, 0.0)
    """Range of what is added to k1 of its lens: barrels are below 0."""
    light_factor: tuple[float, float] = (1.0, 1.0)
    """Range of all light, even in its logarithm: event cameras see it against `render.dark_floor`. The noise
    of their pixels does not follow it."""
    wind_m_s: float = 0.0
    """Strongest wind, level and constant in an episode [m/s]; if > 0, in place of the vehicle's."""
    gyro_bias_rad_s: float = 0.0
    """Largest bias of the gyroscope about each axis, constant in an episode [rad/s]."""
    gyro_noise_rad_s: float = 0.02
    """Standard deviation of the gyroscope [rad/s]."""
    gravity_noise: float = 0.01
    """Standard deviation of each part of the measured direction of gravity."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            low, high = value if isinstance(value, tuple) else (0, value)
            least = -math.inf if name == "distortion" else 0
            if not least <= low <= high < math.inf:
                raise ValueError(f"{name} must be finite, not negative, and in order, got {value}")
            if name.endswith("_factor") and name != "drag_factor" and low <= 0.0:
                raise ValueError(f"{name} must be above 0, got {value}")

    @property
    def airframes_differ(self) -> bool:
        """Mass, inertia, drag or wind are drawn."""
        factors = self.mass_factor, self.inertia_factor, self.drag_factor
        return self.wind_m_s > 0.0 or any(factor != (1.0, 1.0) for factor in factors)

    @property
    def cameras_differ(self) -> bool:
        """Mount or lens of the event camera or the light are drawn."""
        factors = self.focal_factor, self.light_factor
        ranges = self.mount_m, self.mount_rad, self.axis_shift, *self.distortion
        return any(ranges) or any(factor != (1.0, 1.0) for factor in factors)


NO_RANDOMISATION = Randomisation(
    thrust_factor=(1.0, 1.0),
    latency_steps=0,
    threshold_factor=(1.0, 1.0),
    gyro_noise_rad_s=0.0,
    gravity_noise=0.0,
)
"""All worlds are as configured."""
