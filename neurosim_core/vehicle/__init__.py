"""Multirotor dynamics: `Multirotor(preset("hummingbird"))` is a vehicle to fly."""

from neurosim_core.vehicle.airframe import TERMS, MultirotorConfig, preset
from neurosim_core.vehicle.arrays import Acceleration, DynamicsError, MultirotorArrays, MultirotorState
from neurosim_core.vehicle.base import HostVehicle, VehicleConfig, VehicleContext
from neurosim_core.vehicle.ground import GroundConfig
from neurosim_core.vehicle.multirotor import Effort, Integrator, Multirotor
from neurosim_core.vehicle.wind import GustConfig, TurbulenceConfig

__all__ = [
    "TERMS",
    "Acceleration",
    "DynamicsError",
    "Effort",
    "GroundConfig",
    "GustConfig",
    "HostVehicle",
    "Integrator",
    "Multirotor",
    "MultirotorArrays",
    "MultirotorConfig",
    "MultirotorState",
    "TurbulenceConfig",
    "VehicleConfig",
    "VehicleContext",
    "preset",
]
