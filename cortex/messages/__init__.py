"""Standard messages.

Conventions: SI units and radians; world frame x east, y north, z up; body frame x forward, y left, z up;
camera frame x right, y down, z forward; quaternions xyzw. `q_WB` takes vectors of the body to the world,
`v_W` is expressed in the world. Stamps are integer nanoseconds of simulation time or of the robot's clock;
events are stamped in microseconds. `sequence` counts what one sensor or controller sends from 0.
"""

from cortex.messages.commands import (
    AttitudeCommand,
    MotorCommand,
    PoseCommand,
    RateThrustCommand,
    VelocityCommand,
)
from cortex.messages.sensors import CameraInfo, Events, Image, Imu, PointCloud
from cortex.messages.session import Clock, Parameter, Parameters, Text
from cortex.messages.simulation import (
    CommandRanges,
    Delivery,
    Reset,
    SensorStatus,
    Simulation,
    SimulatorReply,
    SimulatorStatus,
    Step,
    Trigger,
    VehicleStatus,
)
from cortex.messages.state import Collision, Odometry, Path, RotorSpeeds, Transform

__all__ = [
    "AttitudeCommand",
    "CameraInfo",
    "Clock",
    "Collision",
    "CommandRanges",
    "Delivery",
    "Events",
    "Image",
    "Imu",
    "MotorCommand",
    "Odometry",
    "Parameter",
    "Parameters",
    "Path",
    "PointCloud",
    "PoseCommand",
    "RateThrustCommand",
    "Reset",
    "RotorSpeeds",
    "SensorStatus",
    "Simulation",
    "SimulatorReply",
    "SimulatorStatus",
    "Step",
    "Text",
    "Transform",
    "Trigger",
    "VehicleStatus",
    "VelocityCommand",
]
