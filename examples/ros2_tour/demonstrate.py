"""All rows of the bridge's README, tried from a node of ROS 2: prints a table, and exits with 1 if one fails.

    source /opt/ros/jazzy/setup.bash
    python3 examples/ros2_tour/demonstrate.py --backend rclpy       # or dds
    python3 examples/ros2_tour/demonstrate.py --python .venv/bin/python     # the Python with Neurosim

It starts a simulator and a bridge of its own. Messages whose ROS package is not installed are skipped.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

HERE = Path(__file__).resolve().parent
SOON_S = 40.0
START_S = 300.0
"""Longest wait for a simulator that compiles its kernels [s]."""


def any_message(message: Any) -> bool:
    """That one came is enough."""
    return True


OUT: tuple[tuple[str, str, str, Callable[[Any], Any]], ...] = (
    ("Image", "rgb/image_raw", "sensor_msgs/Image", lambda m: (m.width, m.encoding) == (160, "rgb8")),
    ("its calibration", "rgb/camera_info", "sensor_msgs/CameraInfo", lambda m: m.k[0] > 0.0),
    ("depth", "depth/image_raw", "sensor_msgs/Image", lambda m: m.encoding == "32FC1"),
    ("Events", "events", "event_camera_msgs/EventPacket", lambda m: m.encoding == "evt3"),
    ("picture of events", "events/image", "sensor_msgs/Image", lambda m: m.width == 160),
    ("its calibration", "events/camera_info", "sensor_msgs/CameraInfo", lambda m: m.width == 160),
    ("Imu", "imu", "sensor_msgs/Imu", lambda m: m.orientation_covariance[0] == -1.0),
    ("PointCloud", "lidar", "sensor_msgs/PointCloud2", lambda m: m.width * m.height > 1000),
    ("Range", "range", "sensor_msgs/Range", lambda m: m.range > 0.0),
    ("FluidPressure", "barometer", "sensor_msgs/FluidPressure", lambda m: 9e4 < m.fluid_pressure < 1.1e5),
    ("MagneticField", "compass", "sensor_msgs/MagneticField", any_message),
    ("NavSatFix", "gps", "sensor_msgs/NavSatFix", any_message),
    ("Odometry", "odometry", "nav_msgs/Odometry", lambda m: m.child_frame_id == "drone/base_link"),
    ("Odometry in tf", "/tf", "tf2_msgs/TFMessage", lambda m: len(m.transforms) == 1),
    ("Transform", "/tf_static", "tf2_msgs/TFMessage", lambda m: len(m.transforms) > 5),
    ("RotorSpeeds", "rotor_speeds", "actuator_msgs/Actuators", lambda m: len(m.velocity) == 4),
    ("Path", "path", "nav_msgs/Path", any_message),
    ("Clock", "/clock", "rosgraph_msgs/Clock", lambda m: m.clock.sec + m.clock.nanosec > 0),
    ("SimulatorStatus", "/status", "neurosim/SimulatorStatus", lambda m: m.phase == "running"),
    ("the same", "/diagnostics", "diagnostic_msgs/DiagnosticArray", lambda m: m.status),
    ("Simulation", "/simulation", "std_msgs/String", lambda m: "sensors" in m.data),
)
LATCHED = {"/tf_static", "/simulation", "path"}


def _attitude(message: Any, mask: int) -> None:
    message.type_mask, message.thrust, message.orientation.w = mask, 0.3, 1.0


def _trajectory(message: Any) -> None:
    point = _class("trajectory_msgs/MultiDOFJointTrajectoryPoint")()
    transform = _class("geometry_msgs/Transform")()
    transform.translation.z, transform.rotation.w = 1.2, 1.0
    point.transforms = [transform]
    message.points = [point]


def _down(message: Any) -> None:
    message.linear.z = -1.0


def _pose(message: Any) -> None:
    message.header.frame_id, message.pose.position.z = "map", 1.2
    message.pose.orientation.w = 1.0


IN: tuple[tuple[str, str, str, str, Callable[[Any], None]], ...] = (
    ("rotor speeds", "actuators", "actuator_msgs/Actuators", "motor_speeds",
     lambda m: m.velocity.extend([700.0] * 4)),
    ("attitude", "attitude_target", "mavros_msgs/AttitudeTarget", "attitude", lambda m: _attitude(m, 7)),
    ("body rates", "attitude_target", "mavros_msgs/AttitudeTarget", "rates", lambda m: _attitude(m, 128)),
    ("Twist", "cmd_vel", "geometry_msgs/Twist", "velocity", lambda m: None),
    ("TwistStamped", "command_velocity", "geometry_msgs/TwistStamped", "velocity", lambda m: None),
    ("PoseStamped", "command_pose", "geometry_msgs/PoseStamped", "position", _pose),
    ("MultiDOFJointTrajectory", "command_trajectory", "trajectory_msgs/MultiDOFJointTrajectory", "position",
     _trajectory),
)  # fmt: skip
CALLS: tuple[tuple[str, str, dict[str, Any], Callable[[Any], Any]], ...] = (
    ("/pause", "std_srvs/Trigger", {}, lambda r: r.success),
    ("/step", "std_srvs/Trigger", {}, lambda r: r.success),
    ("/resume", "std_srvs/Trigger", {}, lambda r: r.success),
    ("/reset", "std_srvs/Trigger", {}, lambda r: r.success),
    ("/reset_to", "neurosim/Reset", {}, lambda r: r.success),
    ("/get_simulator_features", "simulation_interfaces/GetSimulatorFeatures", {},
     lambda r: r.features.features),
    ("/get_entities", "simulation_interfaces/GetEntities", {}, lambda r: r.entities == ["drone"]),
    ("/get_entity_state", "simulation_interfaces/GetEntityState", {"entity": "drone"},
     lambda r: r.state.header.frame_id == "map"),
    ("/get_spawnables", "simulation_interfaces/GetSpawnables", {},
     lambda r: [each.uri for each in r.spawnables] == ["body:ball"]),
    ("/spawn_entity", "simulation_interfaces/SpawnEntity", {"uri": "body:ball"},
     lambda r: r.entity_name == "ball"),
    ("/delete_entity", "simulation_interfaces/DeleteEntity", {"entity": "ball"},
     lambda r: r.result.result == 1),
    ("/set_parameters", "rcl_interfaces/SetParameters", {}, lambda r: list(r.results) == []),
    ("/cortex_bridge/get_state", "lifecycle_msgs/GetState", {}, lambda r: r.current_state.label == "active"),
    ("/cortex_bridge/list_parameters", "rcl_interfaces/ListParameters", {}, lambda r: r.result.names),
)  # fmt: skip


def _class(name: str, kind: str = "msg") -> Any:
    package, _, base = name.partition("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), base)


class Tour:
    """A node that tries one row after the other, and remembers what came of it."""

    def __init__(self, *processes: subprocess.Popen[bytes]) -> None:
        self.node = rclpy.create_node("tour")
        self._processes = processes
        self.rows: list[tuple[str, str, str, str]] = []

    def until(self, condition: Callable[[], Any], timeout_s: float = SOON_S) -> bool:
        """Spin until a condition holds; returns whether it did in time."""
        deadline_s = time.monotonic() + timeout_s
        while not condition() and time.monotonic() < deadline_s:
            if any(process.poll() is not None for process in self._processes):
                raise RuntimeError("the simulator or the bridge has ended")
            rclpy.spin_once(self.node, timeout_sec=0.05)
        return bool(condition())

    def note(
        self, row: str, topic: str, kind: str, attempt: Callable[[Any], bool], where: str = "msg"
    ) -> None:
        """Try one row, with the class of its type."""
        try:
            said = "ok" if attempt(_class(kind, where)) else "FAILED"
        except (ImportError, AttributeError):
            said = f"skipped: {kind} is not installed"
        self.rows.append((row, topic, kind, said))
        print(f"{row:24} {topic:32} {kind:44} {said}", flush=True)

    def hears(self, topic: str, kind: Any, check: Callable[[Any], Any], *, latched: bool) -> bool:
        """Return whether a message comes that is as it should be."""
        qos = QoSProfile(
            depth=10,
            reliability=ReliabilityPolicy.RELIABLE if latched else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        found: list[Any] = []
        taken = self.node.create_subscription(
            kind, topic, lambda m: found.extend([m] if check(m) else []), qos
        )
        heard = self.until(lambda: found)
        self.node.destroy_subscription(taken)
        return heard

    def commands(self, topic: str, kind: Any, mode: str, fill: Callable[[Any], None]) -> bool:
        """Return whether the vehicle flies by the command, as /diagnostics says."""
        said = f"commands: {mode}"
        diagnostics = _class("diagnostic_msgs/DiagnosticArray")
        with self._repeating(topic, kind, fill):
            return self.hears(
                "/diagnostics",
                diagnostics,
                lambda m: any(s.name == "vehicle drone" and said in s.message for s in m.status),
                latched=False,
            )

    def collides(self, kind: Any) -> bool:
        """Return whether a collision is told, of a vehicle that is sent into the floor."""
        with self._repeating("/drone/cmd_vel", _class("geometry_msgs/Twist"), _down):
            return self.hears("/drone/collision", kind, any_message, latched=False)

    @contextlib.contextmanager
    def _repeating(self, topic: str, kind: Any, fill: Callable[[Any], None]) -> Iterator[None]:
        """Publish a command 50 times a second."""
        publisher, message = self.node.create_publisher(kind, topic, 1), kind()
        fill(message)
        timer = self.node.create_timer(0.02, lambda: publisher.publish(message))
        yield
        self.node.destroy_timer(timer)
        self.node.destroy_publisher(publisher)

    def calls(self, name: str, kind: Any, fields: dict[str, Any], check: Callable[[Any], Any]) -> bool:
        """Return whether a service answers as it should."""
        client = self.node.create_client(kind, name)
        if not self.until(client.service_is_ready):
            return False
        future = client.call_async(kind.Request(**fields))
        return self.until(future.done) and bool(check(future.result()))


@contextlib.contextmanager
def _running(*command: str) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.terminate()
        process.wait(10.0)


def main(arguments: Sequence[str] | None = None) -> int:
    """Try everything; returns 1 if something failed."""
    parser = argparse.ArgumentParser(description="try all that the bridge does, from a node of ROS 2")
    parser.add_argument("--backend", default="auto", choices=["auto", "rclpy", "dds"])
    parser.add_argument("--python", default=sys.executable, help="the Python that Neurosim is installed for")
    options = parser.parse_args(arguments)
    print(f"# ROS {os.environ.get('ROS_DISTRO')}, {rclpy.get_rmw_implementation_identifier()}, "
          f"backend {options.backend}")  # fmt: skip
    serve = (options.python, "-m", "neurosim_core", "serve", str(HERE / "tour.yaml"))
    bridge = (options.python, "-m", "cortex_ros2_bridge", "--backend", options.backend)
    rclpy.init()
    with _running(*serve) as simulator, _running(*bridge) as bridged:
        tour = Tour(simulator, bridged)
        tour.until(lambda: tour.node.count_publishers("/clock"), START_S)
        for row, name, kind, check in OUT:
            topic = name if name.startswith("/") else f"/drone/{name}"
            latched = name in LATCHED
            tour.note(row, topic, kind, lambda c, t=topic, f=check, d=latched: tour.hears(t, c, f, latched=d))
        for row, name, kind, mode, fill in IN:
            topic = f"/drone/{name}"
            tour.note(row, topic, kind, lambda c, t=topic, m=mode, f=fill: tour.commands(t, c, m, f))
        tour.note("Collision", "/drone/collision", "neurosim/Collision", tour.collides)
        for name, kind, fields, check in CALLS:
            tour.note(
                "service", name, kind, lambda c, n=name, a=fields, f=check: tour.calls(n, c, a, f), "srv"
            )
    rclpy.shutdown()
    ends = [said for *_, said in tour.rows]
    print(f"# {ends.count('ok')} ok, {ends.count('FAILED')} failed, {len(ends)} rows")
    return 1 if "FAILED" in ends else 0


if __name__ == "__main__":
    sys.exit(main())
