"""Names of topics, services and frames.

/simulation                       Simulation: settings, vehicles (latched)
/status                           SimulatorStatus, five times a second
/clock                            Clock, at every control tick
/VEHICLE/odometry                 Odometry at every control tick, and at those of the sensor (latched)
/VEHICLE/rotor_speeds             RotorSpeeds with it (latched)
/VEHICLE/path                     Path, as planned (latched)
/VEHICLE/collision                Collision
/VEHICLE/SENSOR                   Events, Image, Imu, Odometry, or a type derived from the sensor's packets
/VEHICLE/SENSOR/info              CameraInfo of a camera (latched)
/VEHICLE/SENSOR/transform         Transform: the pose of a sensor that is not at the body itself (latched)
/VEHICLE/predicted/FIELD          Image: depth or flow, as `neurosim predict` says (seen by the viewer)
/VEHICLE/LINK/delivery            Delivery: what a simulated link did to each message
/VEHICLE/command/MODE             commands of one mode; see COMMANDS
/reset /step /pause /resume /set_parameters    services; see SERVICES
"""

from __future__ import annotations

from typing import Any

from cortex.messages import (
    AttitudeCommand,
    MotorCommand,
    Parameters,
    PoseCommand,
    RateThrustCommand,
    Reset,
    SimulatorReply,
    Step,
    Trigger,
    VelocityCommand,
)
from neurosim_core.packets import Odometry
from neurosim_core.record.header import SensorDescription
from neurosim_core.registry import find

SIMULATION = "/simulation"
STATUS = "/status"
CLOCK = "/clock"

WORLD_FRAME = "world"

COMMANDS: dict[str, type[Any]] = {
    "motor_speeds": MotorCommand,
    "rates": RateThrustCommand,
    "attitude": AttitudeCommand,
    "velocity": VelocityCommand,
    "position": PoseCommand,
}
"""The message of each command mode that comes over Cortex; modes as in `control.modes.MODES`."""

SERVICES: dict[str, tuple[type[Any], type[Any]]] = {
    "/reset": (Reset, SimulatorReply),
    "/step": (Step, SimulatorReply),
    "/pause": (Trigger, SimulatorReply),
    "/resume": (Trigger, SimulatorReply),
    "/set_parameters": (Parameters, SimulatorReply),
}
"""Request and reply of each service."""
STEP_DEADLINE_S = 60.0
"""Longest wait of a request for steps, which may need the commands of a controller [s]."""


def stream_topic(vehicle: str, name: str) -> str:
    """Topic of a vehicle: a sensor, odometry, path, ..., or what is below one, such as SENSOR/info."""
    return f"/{vehicle}/{name}"


def command_topic(vehicle: str, mode: str) -> str:
    """Topic of the commands of one mode."""
    return f"/{vehicle}/command/{mode}"


def body_frame(vehicle: str) -> str:
    """Name of a vehicle's body frame."""
    return f"{vehicle}/base_link"


def sensor_frame(vehicle: str, sensor: SensorDescription) -> str:
    """Name of a sensor's frame: the optical frame of a camera, the body frame where packets are odometry."""
    if find("sensor", sensor.kind).packet_type is Odometry:  # type: ignore[attr-defined]
        return body_frame(vehicle)
    return f"{vehicle}/{sensor.name}" + ("" if sensor.intrinsics is None else "_optical_frame")
