"""Which vehicle carries the sensors: the settings of a vehicle, by kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from neurosim_core.config_errors import explain
from neurosim_core.registry import register
from neurosim_core.settings import Settings
from neurosim_core.vehicle.airframe import MultirotorConfig, preset
from neurosim_core.vehicle.multirotor import Integrator, Multirotor

if TYPE_CHECKING:
    from neurosim_core.vehicle.host_vehicle import Vehicle


@dataclass(frozen=True, kw_only=True, eq=False)
class VehicleContext:
    """What a vehicle is made for."""

    count: int
    """How many worlds there are, each with one."""
    device: str
    """Where its state has to be."""
    max_step_ns: int
    """Longest integration step [ns]."""
    seeds: Any
    """Seed of each world, device array of uint64, shape [N]."""


class VehicleConfig(Settings):
    """Settings that all vehicles have. A kind adds its `kind`, what it needs, `airframe` and `make`."""

    kind: str
    """Under which name the class is registered."""
    max_step_s: Annotated[float, Field(ge=1e-6, le=0.1)] = 0.001
    """Longest integration step [s]; intervals end exactly on control and sensor stamps."""
    collision_radius_m: Annotated[float, Field(gt=0.0)] = 0.2
    """Radius of the sphere around the vehicle that must not touch the scene [m]. Where `parameters.ground`
    is set, the sphere shrinks near that plane to end 1 cm above it: to land is no collision."""
    on_collision: Literal["end", "report"] = "end"
    """end: the run stops at the first touch; report: it flies on, through things, and yields Collision
    packets."""

    @property
    def title(self) -> str:
        """What to call it where people read."""
        return self.kind

    def airframe(self) -> MultirotorConfig:
        """Return what planners, controllers and IMUs take the vehicle for: mass, inertia, rotors, ranges."""
        raise NotImplementedError

    def make(self, context: VehicleContext) -> Vehicle:
        """Return the vehicles of all worlds."""
        raise NotImplementedError


@register("vehicle", "multirotor")
class MultirotorVehicleConfig(VehicleConfig):
    """The multirotor that carries the sensors."""

    kind: Literal["multirotor"] = "multirotor"
    preset: str = "hummingbird"
    """Name of the airframe: crazyflie, hummingbird or racer."""
    parameters: dict[str, Any] = Field(default_factory=dict)
    """Parameters to change, by name (see `MultirotorConfig`), of the airframe, such as {mass_kg: 0.6}, and of
    what it flies in: {wind_m_s: [3, 0, 0], gusts: [{velocity_m_s: [5, 0, 0], start_s: 1, rise_s: 0.5,
    hold_s: 2}], turbulence: {wind_20ft_m_s: 7.7}, ground: {height_m: 0, rotor_radius_m: 0.1}}. A gust without
    hold_s stays for good."""
    integrator: Integrator = "rkmk4"
    """rkmk4: fixed steps, and adaptive ones for intervals that these cannot resolve. dormand_prince: adaptive
    steps only."""

    @model_validator(mode="after")
    def _airframe_exists(self) -> MultirotorVehicleConfig:
        try:
            self.airframe()
        except ValidationError as error:
            lines = explain(MultirotorConfig, error)
            whole = any(not item["loc"] for item in error.errors())
            before = "parameters: " if whole else "parameters."
            raise ValueError("; ".join(f"{before}{line}" for line in lines)) from None
        return self

    @property
    def title(self) -> str:
        """Name of the airframe."""
        return self.preset

    def airframe(self) -> MultirotorConfig:
        """Return all parameters of the airframe."""
        return preset(self.preset, **self.parameters)

    def make(self, context: VehicleContext) -> Multirotor:
        """Return the multirotors of all worlds."""
        return Multirotor(
            self.airframe(),
            count=context.count,
            device=context.device,
            max_step_ns=context.max_step_ns,
            integrator=self.integrator,
            seeds=context.seeds,
        )
