# mypy: disable-error-code="attr-defined,call-overload,assignment"
"""The parameters of a multirotor: as settings, and on a device as the kernels read them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field, model_validator

from neurosim_core.frames import Vector3
from neurosim_core.settings import BaseConfig
from neurosim_core.settings_file import read_table
from neurosim_core.vehicle.aerodynamics import (
    AIR_TERMS,
    Airframe,
    Rotors,
    lift_moments,
    linear_weights,
    quadratic_weights,
    vec8d,
    vec10d,
)
from neurosim_core.vehicle.command_ranges import CommandRangesConfig
from neurosim_core.vehicle.ground import GroundConfig
from neurosim_core.vehicle.wind import GustConfig, TurbulenceConfig, WindVector

TERMS = (
    "motor_lag",
    *AIR_TERMS,
    "wind",
    "gusts",
    "turbulence",
    "ground",
    "ground_effect",
    "full_inertia",
)
"""Terms of the equations of motion that a vehicle may do without."""

NonNegative = Annotated[float, Field(ge=0.0)]


class MultirotorConfig(BaseConfig):
    """Parameters of a multirotor whose rotors all push along body z; terms with 0 are not computed."""

    mass_kg: Annotated[float, Field(gt=0.0)]
    """Mass [kg]."""
    inertia_kg_m2: tuple[Vector3, Vector3, Vector3]
    """Inertia about the centre of mass in B, as three rows [kg m^2]."""
    rotor_position_m: tuple[Vector3, ...]
    """Position of each rotor hub relative to the centre of mass, in B [m]."""
    rotor_direction: tuple[Literal[-1, 1], ...]
    """Sign of each rotor's reaction torque about body z: 1 if it turns clockwise seen from above."""
    thrust_coefficient_n_s2: NonNegative
    """Thrust of a rotor per squared speed [N/(rad/s)^2]."""
    torque_coefficient_n_m_s2: NonNegative
    """Reaction torque of a rotor per squared speed [N m/(rad/s)^2]."""
    rotor_thrust_scale: tuple[NonNegative, ...] = ()
    """Thrust coefficient of each rotor as a multiple of the common one; empty: 1 for all; 0: a lost rotor."""
    rotor_torque_scale: tuple[NonNegative, ...] = ()
    """Torque coefficient of each rotor as a multiple of the common one; empty: 1 for all."""
    rotor_drag_kg: NonNegative = 0.0
    """Drag of a rotor in its plane, per rotor speed and air speed [N/(rad/s)/(m/s)]."""
    rotor_inflow_kg: NonNegative = 0.0
    """Loss of thrust per rotor speed and air speed along the axis [N/(rad/s)/(m/s)]."""
    translational_lift_kg_m: NonNegative = 0.0
    """Thrust of a rotor gained per squared air speed in its plane [N/(m/s)^2]."""
    flapping_kg_m: NonNegative = 0.0
    """Flapping torque of a rotor per rotor speed and air speed [N m/(rad/s)/(m/s)]."""
    parasitic_drag_kg_m: tuple[NonNegative, NonNegative, NonNegative] = (0.0, 0.0, 0.0)
    """Drag of the frame along body x, y, z per squared air speed [N/(m/s)^2]."""
    motor_time_constant_s: NonNegative = 0.0
    """Time to close 63 % of a step in commanded rotor speed [s]; 0: no lag."""
    rotor_speed_min_rad_s: NonNegative = 0.0
    """Slowest speed of a rotor [rad/s]; commands below saturate there, as in the motor controller."""
    rotor_speed_max_rad_s: Annotated[float, Field(gt=0.0)]
    """Fastest speed of a rotor [rad/s]; commands above saturate there."""
    gravity_m_s2: NonNegative = 9.81
    """Gravity along world -z [m/s^2]."""
    wind_m_s: WindVector = (0.0, 0.0, 0.0)
    """Velocity of the air in W [m/s]."""
    gusts: tuple[GustConfig, ...] = ()
    """Discrete gusts, which add up; empty: none."""
    turbulence: TurbulenceConfig | None = None
    """Random wind (Dryden turbulence); null: none."""
    ground: GroundConfig | None = None
    """A horizontal plane to land on; null: there is none, and the vehicle can fall for ever."""
    command_ranges: CommandRangesConfig = CommandRangesConfig()
    """The largest commands that the vehicle accepts."""

    @model_validator(mode="after")
    def _is_a_body(self) -> MultirotorConfig:
        inertia = np.array(self.inertia_kg_m2)
        if not np.allclose(inertia, inertia.T, rtol=1e-9, atol=0.0):
            raise ValueError(f"inertia_kg_m2 must be symmetric, got {self.inertia_kg_m2}")
        moments = np.linalg.eigvalsh(inertia)
        if not moments[0] > 0.0:
            raise ValueError(
                f"inertia_kg_m2 must be positive definite, got principal moments {moments.tolist()}"
            )
        # measured moments may miss the inequality a little: those published for the crazyflie do by 1 %
        if moments[0] + moments[1] < 0.98 * moments[2]:
            raise ValueError(
                "inertia_kg_m2: no body has principal moments of which one exceeds the sum of the others, "
                f"got {moments.tolist()}"
            )
        if not self.rotor_position_m or len(self.rotor_position_m) != len(self.rotor_direction):
            raise ValueError(
                "rotor_position_m and rotor_direction must have one entry for each rotor, "
                f"got {len(self.rotor_position_m)} and {len(self.rotor_direction)}"
            )
        for name in ("rotor_thrust_scale", "rotor_torque_scale"):
            if len(scale := getattr(self, name)) not in (0, self.rotor_count):
                raise ValueError(
                    f"{name} must have one entry for each of {self.rotor_count} rotors, or none, "
                    f"got {len(scale)}"
                )
        if not self.rotor_speed_min_rad_s < self.rotor_speed_max_rad_s:
            raise ValueError(
                "rotor_speed_min_rad_s must be below "
                f"rotor_speed_max_rad_s = {self.rotor_speed_max_rad_s:g}, got {self.rotor_speed_min_rad_s:g}"
            )
        air = {"wind_m_s": any(self.wind_m_s), "gusts": self.gusts, "turbulence": self.turbulence}
        if (moved := [name for name, given in air.items() if given]) and not self._feels_air:
            raise ValueError(
                f"{', '.join(moved)}: moving air does nothing to a vehicle without drag; give it "
                "rotor_drag_kg, parasitic_drag_kg_m or another coefficient of the air"
            )
        return self

    @property
    def rotor_count(self) -> int:
        """Number of rotors."""
        return len(self.rotor_position_m)

    @property
    def thrust_coefficients_n_s2(self) -> NDArray[np.float64]:
        """Thrust of each rotor per squared speed [N/(rad/s)^2], shape [R]."""
        return self._of_each(self.thrust_coefficient_n_s2, self.rotor_thrust_scale)

    @property
    def torque_coefficients_n_m_s2(self) -> NDArray[np.float64]:
        """Reaction torque of each rotor per squared speed [N m/(rad/s)^2], shape [R]."""
        return self._of_each(self.torque_coefficient_n_m_s2, self.rotor_torque_scale)

    @property
    def hover_rotor_speed_rad_s(self) -> float:
        """Speed at which equal rotors carry the weight in still air [rad/s]; within their range."""
        thrust = self.thrust_coefficients_n_s2.sum()
        speed = np.sqrt(self.mass_kg * self.gravity_m_s2 / thrust) if thrust > 0.0 else 0.0
        return float(np.clip(speed, self.rotor_speed_min_rad_s, self.rotor_speed_max_rad_s))

    @property
    def hover_thrust_n(self) -> float:
        """The weight [N]."""
        return self.mass_kg * self.gravity_m_s2

    @property
    def thrust_max_n(self) -> float:
        """Thrust of all rotors at their highest speed [N]."""
        return float(self.thrust_coefficients_n_s2.sum() * self.rotor_speed_max_rad_s**2)

    def _of_each(self, common: float, scale: tuple[float, ...]) -> NDArray[np.float64]:
        return common * np.array(scale or self.rotor_count * (1.0,))

    @property
    def _feels_air(self) -> bool:
        of_rotors = (self.rotor_drag_kg, self.rotor_inflow_kg, self.translational_lift_kg_m)
        return any((*of_rotors, self.flapping_kg_m, *self.parasitic_drag_kg_m))

    def terms(self) -> tuple[str, ...]:
        """Return the terms (of `TERMS`) that these parameters need.

        Drag of rotors and body and translational lift come together, and so do constant wind and gusts, which
        also come with turbulence, though some may be 0: each set of terms is a set of kernels to compile
        (2 s), and alone they save 0.3 us of a control period.
        """
        inertia = np.array(self.inertia_kg_m2)
        needed = {
            "motor_lag": self.motor_time_constant_s > 0.0,
            "rotor_drag": self._feels_air,
            "translational_lift": self._feels_air,
            "flapping": self.flapping_kg_m > 0.0,
            "parasitic_drag": self._feels_air,
            "ground": self.ground is not None,
            "ground_effect": self.ground is not None and self.ground.rotor_radius_m > 0.0,
            "full_inertia": bool(np.any(inertia - np.diag(np.diag(inertia)))),
        }
        needed["turbulence"] = self.turbulence is not None
        windy = any(self.wind_m_s) or bool(self.gusts) or needed["turbulence"]
        needed["wind"] = needed["gusts"] = windy
        return tuple(term for term in TERMS if needed[term])


def preset(name: str, **overrides: Any) -> MultirotorConfig:
    """Return the parameters of an airframe of `presets.yaml`.

    Args:
        name: crazyflie, hummingbird or racer.
        **overrides: Parameters to change, such as `mass_kg=0.6`; checked like all others.

    Raises:
        ValueError: The name or a parameter is unknown, or a value is out of range.
    """
    return MultirotorConfig(**preset_values(name) | overrides)


def preset_values(name: str) -> dict[str, Any]:
    """Return the parameters of an airframe as they are in `presets.yaml`.

    Raises:
        ValueError: The name is unknown.
    """
    airframes = read_table(__file__, "presets")
    if name not in airframes:
        raise ValueError(f"unknown airframe {name!r}, known: {sorted(airframes)}")
    values: dict[str, Any] = airframes[name]
    return values


def make_airframe(config: MultirotorConfig, device: Any) -> tuple[Airframe, Rotors]:
    """Return the parameters of a multirotor, and of its rotors on a device, as the kernels read them.

    Raises:
        ValueError: There is no such device.
    """
    position = np.array(config.rotor_position_m)
    drag = np.array([config.rotor_drag_kg, config.rotor_drag_kg, config.rotor_inflow_kg])
    quadratic = quadratic_weights(
        position,
        np.array(config.rotor_direction, dtype=np.float64),
        thrust=config.thrust_coefficients_n_s2,
        torque=config.torque_coefficients_n_m_s2,
    )
    inertia = np.array(config.inertia_kg_m2)
    airframe = Airframe()
    airframe.gravity = config.gravity_m_s2
    airframe.mass_inverse = 1.0 / config.mass_kg
    airframe.inertia = wp.mat33d(inertia)
    airframe.inertia_inverse = wp.mat33d(np.linalg.inv(inertia))
    airframe.inertia_diagonal = wp.vec3d(np.diag(inertia))
    airframe.inertia_diagonal_inverse = wp.vec3d(1.0 / np.diag(inertia))
    airframe.rotor_drag = wp.vec3d(drag)
    airframe.flapping = config.flapping_kg_m
    airframe.translational_lift = config.translational_lift_kg_m
    airframe.lift_force = vec8d(lift_moments(position, np.ones(len(position))))
    airframe.lift_torque_x = vec8d(lift_moments(position, position[:, 1]))
    airframe.lift_torque_y = vec8d(lift_moments(position, -position[:, 0]))
    airframe.parasitic_drag = wp.vec3d(*config.parasitic_drag_kg_m)
    airframe.wind = wp.vec3d(*config.wind_m_s)
    airframe.rotor_speed_min = config.rotor_speed_min_rad_s
    airframe.rotor_speed_max = config.rotor_speed_max_rad_s
    rotors = Rotors()
    rotors.quadratic_weight = wp.array(quadratic, dtype=wp.vec4d, device=device)
    rotors.linear_weight = wp.array(linear_weights(position, drag), dtype=vec10d, device=device)
    return airframe, rotors


def alike(airframe: Airframe, count: int, device: Any) -> Any:
    """Return an airframe for each of N vehicles, device array of `Airframe`, shape [N]."""
    row = np.array([airframe.numpy_value()], dtype=Airframe.numpy_dtype())
    return wp.array(np.repeat(row, count), dtype=Airframe, device=device)
