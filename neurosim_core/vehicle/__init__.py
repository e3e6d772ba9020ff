"""Multirotor dynamics: `Multirotor(preset("hummingbird"))` is a vehicle to fly."""

from neurosim_core.vehicle.airframe import TERMS, MultirotorConfig, preset
from neurosim_core.vehicle.arrays import DynamicsError, MultirotorArrays, MultirotorState
from neurosim_core.vehicle.config import VehicleConfig, VehicleContext
from neurosim_core.vehicle.ground import GroundConfig
from neurosim_core.vehicle.host_vehicle import HostVehicle
from neurosim_core.vehicle.multirotor import Acceleration, Effort, Integrator, Multirotor
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
