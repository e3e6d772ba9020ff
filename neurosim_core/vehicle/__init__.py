"""Multirotor dynamics: `Multirotor(preset("hummingbird"))` is a vehicle to fly."""

from neurosim_core.vehicle.multirotor import (
    TERMS,
    Acceleration,
    DynamicsError,
    Effort,
    Integrator,
    Multirotor,
    MultirotorArrays,
    MultirotorConfig,
    MultirotorState,
)
from neurosim_core.vehicle.presets import preset

__all__ = [
    "TERMS",
    "Acceleration",
    "DynamicsError",
    "Effort",
    "Integrator",
    "Multirotor",
    "MultirotorArrays",
    "MultirotorConfig",
    "MultirotorState",
    "preset",
]
