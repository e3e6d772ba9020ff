"""Neurosim: event cameras, RGB, depth and IMU on agile multirotors.

Everything is imported on first use: `import neurosim_core` starts no device and loads no heavy library.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neurosim_core import data, learn, packets, registry, scene, sensors
    from neurosim_core.config import ConfigError, SimulationConfig, load_config, to_yaml
    from neurosim_core.control.setpoints import AttitudeThrust, BodyRates, MotorSpeeds, Position, Velocity
    from neurosim_core.frames import Mount
    from neurosim_core.live.messages import message_type, to_packet
    from neurosim_core.packets import Collision, Events, Image, ImuSample, Odometry, Packet
    from neurosim_core.record import Recording
    from neurosim_core.registry import register
    from neurosim_core.render.camera import PinholeConfig
    from neurosim_core.render.renderer import make_renderer, upload_scene
    from neurosim_core.sensors.event_batch import EventCameraBatch
    from neurosim_core.sensors.event_config import EventCameraConfig
    from neurosim_core.sensors.events import EventCamera
    from neurosim_core.sim.model import Model, make_model
    from neurosim_core.sim.rollout import run, run_model, step
    from neurosim_core.sim.simulation import Simulation
    from neurosim_core.sim.state import State, make_state
    from neurosim_core.vehicle import DynamicsError, Multirotor, MultirotorConfig, preset

__version__ = "0.1.0"

_HOMES = {
    "neurosim_core.config": ("ConfigError", "SimulationConfig", "load_config", "to_yaml"),
    "neurosim_core.control.setpoints": (
        "AttitudeThrust",
        "BodyRates",
        "MotorSpeeds",
        "Position",
        "Velocity",
    ),
    "neurosim_core.frames": ("Mount",),
    "neurosim_core.live.messages": ("message_type", "to_packet"),
    "neurosim_core.packets": ("Collision", "Events", "Image", "ImuSample", "Odometry", "Packet"),
    "neurosim_core.record": ("Recording",),
    "neurosim_core.registry": ("register",),
    "neurosim_core.render.camera": ("PinholeConfig",),
    "neurosim_core.render.renderer": ("make_renderer", "upload_scene"),
    "neurosim_core.sensors.event_batch": ("EventCameraBatch",),
    "neurosim_core.sensors.event_config": ("EventCameraConfig",),
    "neurosim_core.sensors.events": ("EventCamera",),
    "neurosim_core.sim.model": ("Model", "make_model"),
    "neurosim_core.sim.rollout": ("run", "run_model", "step"),
    "neurosim_core.sim.simulation": ("Simulation",),
    "neurosim_core.sim.state": ("State", "make_state"),
    "neurosim_core.vehicle": ("DynamicsError", "Multirotor", "MultirotorConfig", "preset"),
}
_MODULES = ("data", "learn", "packets", "registry", "scene", "sensors")
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "AttitudeThrust",
    "BodyRates",
    "Collision",
    "ConfigError",
    "DynamicsError",
    "EventCamera",
    "EventCameraBatch",
    "EventCameraConfig",
    "Events",
    "Image",
    "ImuSample",
    "Model",
    "MotorSpeeds",
    "Mount",
    "Multirotor",
    "MultirotorConfig",
    "Odometry",
    "Packet",
    "PinholeConfig",
    "Position",
    "Recording",
    "Simulation",
    "SimulationConfig",
    "State",
    "Velocity",
    "data",
    "learn",
    "load_config",
    "make_model",
    "make_renderer",
    "make_state",
    "message_type",
    "packets",
    "preset",
    "register",
    "registry",
    "run",
    "run_model",
    "scene",
    "sensors",
    "step",
    "to_packet",
    "to_yaml",
    "upload_scene",
]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"neurosim_core.{name}")
    if name not in _HOME:
        raise AttributeError(f"module 'neurosim_core' has no attribute {name!r}, known: {__all__}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
