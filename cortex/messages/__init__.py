"""Standard messages.

Conventions: SI units and radians; world frame x east, y north, z up; body frame x forward, y left, z up;
camera frame x right, y down, z forward; quaternions xyzw. `q_WB` takes vectors of the body to the world,
`v_W` is expressed in the world. Stamps are integer nanoseconds of simulation time or of the robot's clock;
events are stamped in microseconds. `sequence` counts what one sensor or controller sends from 0.
"""

from cortex.messages.commands import AttitudeCommand as AttitudeCommand
from cortex.messages.commands import MotorCommand as MotorCommand
from cortex.messages.commands import PoseCommand as PoseCommand
from cortex.messages.commands import RateThrustCommand as RateThrustCommand
from cortex.messages.commands import VelocityCommand as VelocityCommand
from cortex.messages.sensors import CameraInfo as CameraInfo
from cortex.messages.sensors import Events as Events
from cortex.messages.sensors import Image as Image
from cortex.messages.sensors import Imu as Imu
from cortex.messages.sensors import PointCloud as PointCloud
from cortex.messages.session import Clock as Clock
from cortex.messages.session import Parameter as Parameter
from cortex.messages.session import Parameters as Parameters
from cortex.messages.session import Text as Text
from cortex.messages.simulation import CommandRanges as CommandRanges
from cortex.messages.simulation import Delivery as Delivery
from cortex.messages.simulation import Reset as Reset
from cortex.messages.simulation import SensorStatus as SensorStatus
from cortex.messages.simulation import Simulation as Simulation
from cortex.messages.simulation import SimulatorReply as SimulatorReply
from cortex.messages.simulation import SimulatorStatus as SimulatorStatus
from cortex.messages.simulation import Step as Step
from cortex.messages.simulation import Trigger as Trigger
from cortex.messages.simulation import VehicleStatus as VehicleStatus
from cortex.messages.state import Collision as Collision
from cortex.messages.state import Odometry as Odometry
from cortex.messages.state import Path as Path
from cortex.messages.state import RotorSpeeds as RotorSpeeds
from cortex.messages.state import Transform as Transform

__all__ = sorted(name for name, value in vars().items() if isinstance(value, type))
