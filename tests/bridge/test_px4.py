"""The offboard topics of PX4, by the converters of `examples/ros2_px4/px4.py`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bridge_rig import odometry, rig_of
from processes import ROOT, SOON_S, wait_for
from scipy.spatial.transform import Rotation

from cortex import messages as msg
from cortex_ros2_bridge.convert import registry
from cortex_ros2_bridge.convert.registry import load_converters
from cortex_ros2_bridge.msgs import message_class

EXAMPLE = str(ROOT / "examples" / "ros2_px4" / "px4.py")
FIELDS = {
    "TrajectorySetpoint": (
        "uint64 timestamp\nfloat32[3] position\nfloat32[3] velocity\nfloat32[3] acceleration\n"
        "float32[3] jerk\nfloat32 yaw\nfloat32 yawspeed\n"
    ),
    "VehicleRatesSetpoint": (
        "uint64 timestamp\nfloat32 roll\nfloat32 pitch\nfloat32 yaw\nfloat32[3] thrust_body\n"
        "bool reset_integral\n"
    ),
    "VehicleOdometry": (
        "uint64 timestamp\nuint64 timestamp_sample\nuint8 pose_frame\nfloat32[3] position\nfloat32[4] q\n"
        "uint8 velocity_frame\nfloat32[3] velocity\nfloat32[3] angular_velocity\n"
        "float32[3] position_variance\nfloat32[3] orientation_variance\nfloat32[3] velocity_variance\n"
        "uint8 reset_counter\nint8 quality\n"
    ),
}
"""As in the package; it is not copied here, and need not be installed."""
NAN = [math.nan] * 3


@pytest.fixture(autouse=True)
def converters(runtime: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A ROS installation that has only these definitions; what is registered is forgotten after a test."""
    folder = tmp_path / "share" / "px4_msgs" / "msg"
    folder.mkdir(parents=True)
    for name, text in FIELDS.items():
        (folder / f"{name}.msg").write_text(text, encoding="utf-8")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    before = dict(registry.ADDED)
    assert load_converters([EXAMPLE]) == []
    yield
    registry.ADDED.clear()
    registry.ADDED.update(before)


def setpoint(**fields: Any) -> Any:
    made = message_class("px4_msgs/msg/TrajectorySetpoint")(
        timestamp=8_000_000, yaw=math.nan, yawspeed=math.nan
    )
    made.position, made.velocity = np.full(3, np.nan, np.float32), np.full(3, np.nan, np.float32)
    for name, value in fields.items():
        setattr(made, name, np.array(value, np.float32) if isinstance(value, list) else value)
    return made


def test_setpoints_become_commands_in_our_frames() -> None:
    """2 m north, 1 m east, 3 m up, the nose to the east: in ENU (1, 2, 3), yaw 0."""
    with rig_of() as rig:
        poses = rig.simulator.subscriber("/drone/command/position", msg.PoseCommand)
        velocities = rig.simulator.subscriber("/drone/command/velocity", msg.VelocityCommand)
        rates = rig.simulator.subscriber("/drone/command/rates", msg.RateThrustCommand)
        (topic,) = rig.subscribes("/drone/fmu/in/trajectory_setpoint")
        (turns,) = rig.subscribes("/drone/fmu/in/vehicle_rates_setpoint")
        rig.update_until(lambda: sum("/fmu/" in r.ros_topic for r in rig.bridge.routes()) == 3)
        for each in (poses, velocities, rates):
            assert each.wait_for_publisher(SOON_S)
        topic.put(setpoint(position=[2.0, 1.0, -3.0], yaw=0.5 * math.pi))
        pose = poses.recv(SOON_S)
        assert (pose.stamp_ns, pose.position.tolist()) == (8_000_000_000, [1.0, 2.0, 3.0])
        assert pose.yaw_rad == pytest.approx(0.0, abs=1e-7)  # float32 of pi / 2
        topic.put(setpoint(velocity=[0.5, 0.25, -1.0], yawspeed=0.5))
        velocity = velocities.recv(SOON_S)
        assert velocity.velocity.tolist() == [0.25, 0.5, 1.0]
        assert velocity.yaw_rate_rad_s == -0.5
        topic.put(setpoint(position=[1.0, math.nan, math.nan]))
        topic.put(setpoint())
        route = "/drone/command/position <- /drone/fmu/in/trajectory_setpoint"
        assert rig.tally(route).refused == 1
        assert rig.tally(route.replace("position", "velocity")).refused == 1
        made = message_class("px4_msgs/msg/VehicleRatesSetpoint")(timestamp=1, roll=0.5, pitch=0.25, yaw=1.0)
        made.thrust_body = np.array([0.0, 0.0, -0.5], np.float32)
        turns.put(made)
        command = rates.recv(SOON_S)
        assert command.body_rate.tolist() == [0.5, -0.25, -1.0]
        assert command.thrust_n == pytest.approx(0.5 * 50.13)


def test_odometry_is_that_of_px4() -> None:
    """Against SciPy: the attitude takes FRD to NED."""
    with rig_of() as rig:
        state = rig.simulator.publisher("/drone/odometry", msg.Odometry, latch=True)
        (out,) = rig.opens("/drone/fmu/out/vehicle_odometry")
        ours = odometry(5_000_000)
        q = Rotation.from_euler("xyz", [0.1, -0.2, 2.0]).as_quat()
        with rig.listening(state, "/drone/fmu/out/vehicle_odometry"):
            state.publish(msg.Odometry(5_000_000, ours.position, q, ours.velocity, ours.body_rate))
            wait_for(lambda: out.sent)
        (found,) = out.messages()
    to_ned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    flip = np.diag([1.0, -1.0, -1.0])
    expected = to_ned @ Rotation.from_quat(q).as_matrix() @ flip
    matrix = Rotation.from_quat(np.roll(found.q, -1)).as_matrix()
    np.testing.assert_allclose(matrix, expected, atol=1e-6)  # float32
    assert (found.timestamp, found.pose_frame) == (5000, 1)
    assert found.position.tolist() == [2.0, 1.0, -3.0]
    np.testing.assert_allclose(found.angular_velocity, [0.1, -0.2, -0.3], rtol=1e-6)


def test_without_the_package_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/nowhere")
    (problem,) = load_converters([EXAMPLE])
    assert "px4_msgs is not installed" in problem
