"""A controller as a foreign node: it speaks DDS by public functions of cyclonedds, with types of its own.

Its arguments are the DDS domain and modes of commands. It flies the figure eight with one mode after the
other, asks for a reset after each, and prints a line of JSON for each flight. It knows nothing of Cortex and
of the bridge. `test_bridge_flight` flies the same law without any of it.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp
from cyclonedds import idl
from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from neurosim_core import SimulationConfig, load_config
from neurosim_core.control import PathFollower
from neurosim_core.sim.model import plan_paths
from neurosim_core.trajectory import Path
from neurosim_core.trajectory.path import PathCursor

MAX_THRUST_N = 20.0
DURATION_S = 4.0
SETTINGS: dict[str, Any] = {
    "duration_s": DURATION_S,
    "device": "cpu",
    "scene": {"kind": "apartment", "rooms": 2},
    "vehicle": {"on_collision": "report"},
    "path": {"kind": "figure_eight", "speed_max_m_s": 2.5, "ramp_s": 1.0, "center_m": [0.0, 0.0, 1.2]},
    "control": {"rate_hz": 50},
    "sensors": {"imu": {"kind": "imu", "rate_hz": 50}},
    "live": {"mode": "lockstep", "command_deadline_s": 60.0, "command_timeout_s": 5.0},
}

Law = Callable[..., np.ndarray]


def struct(name: str, **fields: Any) -> Any:
    """Return a type of DDS."""
    return idl.make_idl_struct(name.rpartition(".")[2], name, fields)


types: Any = idl.types
"""Types of fields; mypy does not see that they take parameters."""
f64 = types.float64
Time = struct("builtin_interfaces.msg.dds_.Time_", sec=types.int32, nanosec=types.uint32)
Header = struct("std_msgs.msg.dds_.Header_", stamp=Time, frame_id=str)
Point = struct("geometry_msgs.msg.dds_.Point_", x=f64, y=f64, z=f64)
Vector3 = struct("geometry_msgs.msg.dds_.Vector3_", x=f64, y=f64, z=f64)
Quaternion = struct("geometry_msgs.msg.dds_.Quaternion_", x=f64, y=f64, z=f64, w=f64)
Pose = struct("geometry_msgs.msg.dds_.Pose_", position=Point, orientation=Quaternion)
Twist = struct("geometry_msgs.msg.dds_.Twist_", linear=Vector3, angular=Vector3)
Covariance = types.array[types.float64, 36]
PoseWithCovariance = struct("geometry_msgs.msg.dds_.PoseWithCovariance_", pose=Pose, covariance=Covariance)
TwistWithCovariance = struct(
    "geometry_msgs.msg.dds_.TwistWithCovariance_", twist=Twist, covariance=Covariance
)
Odometry = struct(
    "nav_msgs.msg.dds_.Odometry_",
    header=Header,
    child_frame_id=str,
    pose=PoseWithCovariance,
    twist=TwistWithCovariance,
)
Actuators = struct(
    "actuator_msgs.msg.dds_.Actuators_",
    header=Header,
    position=types.sequence[types.float64],
    velocity=types.sequence[types.float64],
    normalized=types.sequence[types.float64],
)
AttitudeTarget = struct(
    "mavros_msgs.msg.dds_.AttitudeTarget_",
    header=Header,
    type_mask=types.uint8,
    orientation=Quaternion,
    body_rate=Vector3,
    thrust=types.float32,
)
Empty = struct("std_msgs.msg.dds_.Empty_", structure_needs_at_least_one_member=types.uint8)

IGNORE_RATES = 1 + 2 + 4


def qos(depth: int) -> Qos:
    """Return what ROS has by default, with a depth."""
    return Qos(
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Reliability.Reliable(duration(milliseconds=100)),
        Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
    )


def make_law(mode: str, settings: SimulationConfig, path: Path) -> Law:
    """Return a function of a state, by names; position and velocity in W, xyzw, rates in B.

    motor_speeds: the geometric controller of `neurosim_core.control`. attitude: its outer loop, in Python.
    """
    airframe = settings.vehicle.airframe()
    if mode == "motor_speeds":
        return PathFollower(path, airframe, settings.control.gains, mode="motor_speeds").command
    gains, cursor = settings.control.gains, PathCursor(path)

    def attitude(*, stamp_ns: int, position: Any, velocity: Any, orientation: Any, **_: Any) -> np.ndarray:
        point = cursor.at(stamp_ns)
        force = point["acceleration"] + np.array([0.0, 0.0, 9.81])
        force = force + gains.position_gain_per_s2 * (point["position"] - position)
        force = force + gains.velocity_gain_per_s * (point["velocity"] - velocity)
        x, y, z, w = orientation
        up = np.array([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)])
        thrust_n = float(np.clip(airframe.mass_kg * force @ up, 0.0, MAX_THRUST_N))
        # The shortest turn from the vertical to the force, after one about the vertical.
        axis = force / np.linalg.norm(force)
        tilt = np.array([-axis[1], axis[0], 0.0, 1.0 + axis[2]])
        tilt /= np.linalg.norm(tilt)
        half = 0.5 * float(point["yaw"])
        s, c = math.sin(half), math.cos(half)
        a, b, _, d = tilt
        return np.array([thrust_n, a * c + b * s, b * c - a * s, d * s, d * c])

    return attitude


class Errors:
    """Distance from a path, over a flight."""

    def __init__(self, path: Path) -> None:
        self._cursor = PathCursor(path)
        self.squares: list[float] = []

    def add(self, stamp_ns: int, position: Any) -> None:
        """Take in where the vehicle was."""
        self.squares.append(float(np.sum((self._cursor.at(stamp_ns)["position"] - position) ** 2)))

    @property
    def rms_m(self) -> float:
        """Root of the mean square [m]."""
        return math.sqrt(sum(self.squares) / len(self.squares))


class Ear:
    """Receives from a topic."""

    def __init__(self, participant: Any, topic: str, kind: Any) -> None:
        self.reader = DataReader(participant, Topic(participant, topic, kind), qos(100))
        condition = ReadCondition(self.reader, SampleState.Any | ViewState.Any | InstanceState.Alive)
        self.waitset = WaitSet(participant)
        self.waitset.attach(condition)

    def take(self) -> Any:
        """Return the next message."""
        while not (samples := self.reader.take(1)):
            if not self.waitset.wait(duration(seconds=30)):
                raise TimeoutError(f"nothing comes on {self.reader.topic.name}")
        return samples[0]


def stamp_ns(header: Any) -> int:
    """Return a stamp [ns]."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def turn(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return a vector of the body in the world; q is xyzw."""
    u = 2.0 * np.cross(q[:3], v)
    turned: np.ndarray = v + q[3] * u + np.cross(q[:3], u)
    return turned


def numbers(*parts: Any) -> np.ndarray:
    """Return numbers as an array."""
    return np.array(parts, np.float64)


class Pilot:
    """One flight after the other."""

    def __init__(self, domain: int) -> None:
        self.settings = load_config(SETTINGS)
        (self.path,) = plan_paths(self.settings).values()
        participant = DomainParticipant(domain)
        self.odometry = Ear(participant, "rt/sim/drone/odometry", Odometry)
        self.rotors = Ear(participant, "rt/sim/drone/rotor_speeds", Actuators)
        self.writers = {
            name: DataWriter(participant, Topic(participant, f"rt/sim/{topic}", kind), qos(1))
            for name, topic, kind in (
                ("motor_speeds", "drone/actuators", Actuators),
                ("attitude", "drone/attitude_target", AttitudeTarget),
                ("reset", "reset", Empty),
            )
        }

    def rotor_speed(self, wanted_ns: int) -> np.ndarray:
        """Return the speeds that belong to a state: they come on a topic of their own."""
        while True:
            message = self.rotors.take()
            if stamp_ns(message.header) == wanted_ns:
                return np.array(message.velocity)

    def fly(self, mode: str) -> dict[str, Any]:
        """Fly one figure eight, and return its error."""
        law, errors = make_law(mode, self.settings, self.path), Errors(self.path)
        end_ns, last_ns, row = round(DURATION_S * 1e9), -1, numbers()
        while True:
            state = self.odometry.take()
            now_ns = stamp_ns(state.header)
            if last_ns < 0 < now_ns:
                continue  # of the flight before
            if now_ns == last_ns:  # once more: nobody has heard the answer
                self.command(mode, state.header, row.tolist())
                continue
            last_ns = now_ns
            pose, twist = state.pose.pose, state.twist.twist
            position = numbers(pose.position.x, pose.position.y, pose.position.z)
            q = pose.orientation
            orientation = numbers(q.x, q.y, q.z, q.w)
            errors.add(now_ns, position)
            if now_ns >= end_ns:
                return {"mode": mode, "rms_m": errors.rms_m, "count": len(errors.squares)}
            forward = numbers(twist.linear.x, twist.linear.y, twist.linear.z)
            row = law(
                stamp_ns=now_ns,
                position=position,
                velocity=turn(orientation, forward),
                orientation=orientation,
                body_rate=numbers(twist.angular.x, twist.angular.y, twist.angular.z),
                rotor_speed=self.rotor_speed(now_ns),
            )
            self.command(mode, state.header, row.tolist())

    def command(self, mode: str, header: Any, row: list[float]) -> None:
        """Send a command with the stamp of the state that it answers."""
        if mode == "motor_speeds":
            command = Actuators(header=header, position=[], velocity=row, normalized=[])
        else:
            command = AttitudeTarget(
                header=header,
                type_mask=IGNORE_RATES,
                orientation=Quaternion(*row[1:]),
                body_rate=Vector3(0.0, 0.0, 0.0),
                thrust=row[0] / MAX_THRUST_N,
            )
        self.writers[mode].write(command)

    def reset(self) -> None:
        """Ask for a new run."""
        self.writers["reset"].write(Empty(structure_needs_at_least_one_member=0))


def main() -> None:
    """Fly."""
    wp.config.log_level = wp.LOG_WARNING
    pilot = Pilot(int(sys.argv[1]))
    for mode in sys.argv[2:]:
        print(json.dumps(pilot.fly(mode)), flush=True)
        pilot.reset()


if __name__ == "__main__":
    main()
