"""Conversions against values computed by hand, and with input that cannot be used.

Each message that goes out is written a second time as rosbags' own record, field by field, in `EXPECTED`; its
bytes are those of rosbags.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cortex import messages
from cortex.evt3 import Evt3Decoder
from cortex_ros2_bridge import cdr, frames
from cortex_ros2_bridge.convert import RULES, Context, ConvertError, static_transforms, transform_of
from cortex_ros2_bridge.event_codec import decode_mono
from cortex_ros2_bridge.frames import FrameNames
from cortex_ros2_bridge.msgs import (
    Actuators,
    AttitudeTarget,
    Empty,
    MultiDOFJointTrajectory,
    MultiDOFJointTrajectoryPoint,
    PoseStamped,
    Quaternion,
    Reset,
    Transform,
    Twist,
    TwistStamped,
    UInt32,
    Vector3,
)
from cortex_ros2_bridge.options import OPTIONS as OPTIONS_OF_ROUTES
from cortex_ros2_bridge.options import check_option
from cortex_ros2_bridge.typestore import typestore

OUT = {(r.cortex_type, r.ros_type): r for r in RULES if r.direction == "out" and not r.robot}
IN = {(r.ros_type, r.cortex_type): r for r in RULES if r.direction in ("in", "call") and not r.robot}
convert = SimpleNamespace(
    **{
        rule.convert.__name__: rule.convert for rule in RULES if rule.direction != "record" and not rule.robot
    },
    static_transforms=static_transforms,
    transform_of=transform_of,
)
TURN = np.array([0.5, 0.5, 0.5, 0.5])
"""Takes x to y, y to z and z to x: so v_W = (c, a, b) for v_B = (a, b, c), exactly."""
STAMP_NS = 3_000_000_007
S, N = 3, 7
U8, F64 = np.uint8, np.float64


def record(type_name: str, *values: Any) -> Any:
    package, name = type_name.split("/")
    return typestore().types[f"{package}/msg/{name}"](*values)


def header(frame: str, second: int = S, nanosecond: int = N) -> Any:
    return record("std_msgs/Header", record("builtin_interfaces/Time", second, nanosecond), frame)


def vector(*values: float) -> Any:
    return record("geometry_msgs/Vector3", *values)


def point(*values: float) -> Any:
    return record("geometry_msgs/Point", *values)


def quaternion(*values: float) -> Any:
    return record("geometry_msgs/Quaternion", *values)


def covariance(size: int, *diagonal: float) -> Any:
    matrix = np.zeros((size, size))
    for index, value in enumerate(diagonal):
        matrix[index, index] = value
    return matrix.reshape(-1)


def transform(parent: str, child: str, translation: Any, rotation: Any, *stamp: int) -> Any:
    return record(
        "geometry_msgs/TransformStamped",
        header(parent, *stamp),
        child,
        record("geometry_msgs/Transform", vector(*translation), quaternion(*rotation)),
    )


def image_record(frame: str, height: int, width: int, encoding: str, step: int, data: Any) -> Any:
    return record("sensor_msgs/Image", header(frame), height, width, encoding, 0, step, np.array(data, U8))


def camera_record(frame: str, *stamp: int) -> Any:
    """Of CAMERA: in ROS the centre of the first pixel is at 0, so that the axis goes through 319.5, 239.5."""
    return record(
        "sensor_msgs/CameraInfo",
        header(frame, *stamp),
        480,
        640,
        "plumb_bob",
        np.zeros(5),
        np.array([400.0, 0.0, 319.5, 0.0, 401.0, 239.5, 0.0, 0.0, 1.0]),
        np.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        np.array([400.0, 0.0, 319.5, 0.0, 0.0, 401.0, 239.5, 0.0, 0.0, 0.0, 1.0, 0.0]),
        0,
        0,
        record("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False),
    )


def float_bytes(*values: float) -> list[int]:
    return list(np.array(values, "<f4").tobytes())


CAMERA = messages.CameraInfo(
    stamp_ns=0,
    width=640,
    height=480,
    matrix=np.array([[400.0, 0.0, 320.0], [0.0, 401.0, 240.0], [0.0, 0.0, 1.0]]),
    distortion_model="",
    distortion=np.zeros(0),
    frame_id="drone/rgb_optical_frame",
)
IMU = messages.Imu(
    stamp_ns=STAMP_NS, specific_force=np.array([0.5, -0.25, 9.81]), angular_rate=np.array([1.0, 2.0, -3.0])
)
ODOMETRY = messages.Odometry(
    stamp_ns=STAMP_NS,
    position=np.array([1.0, -2.0, 3.0]),
    orientation=TURN,
    velocity=np.array([10.0, 20.0, 30.0]),
    body_rate=np.array([0.1, 0.2, 0.3]),
)
IMAGE = messages.Image(
    stamp_ns=STAMP_NS,
    data=np.arange(12, dtype=U8).reshape(2, 2, 3),
    encoding="rgb8",
    frame_id="drone/rgb_optical_frame",
)
DEPTH = messages.Image(
    stamp_ns=STAMP_NS,
    data=np.array([[[1.5], [np.inf]]], np.float32),
    encoding="32FC1",
    frame_id="drone/depth_optical_frame",
)
EVENTS = messages.Events(
    stamp_ns=STAMP_NS,
    x=np.array([7, 2], np.uint16),
    y=np.array([3, 4], np.uint16),
    t=np.array([2_999_999, 3_000_000]),
    polarity=np.array([1, 0], U8),
    width=8,
    height=5,
    start_ns=2_900_000_000,
    frame_id="drone/events_optical_frame",
    sequence=42,
)
STATUS = messages.SimulatorStatus(
    stamp_ns=STAMP_NS,
    wall_ns=1,
    phase="running",
    reason="",
    mode="streaming",
    real_time_factor_wanted=1.0,
    real_time_factor=0.5,
    step_count=100,
    step_median_ns=10,
    step_p99_ns=20,
    late_median_ns=0,
    late_p99_ns=0,
    overrun_count=4,
    slipped_ns=2_500_000_000,
    sensors=[
        messages.SensorStatus("drone", "imu", True, 1, 1000, 2, 2),
        messages.SensorStatus("drone", "rgb", False, 0, 30, 5, 0, 3),
    ],
    vehicles=[messages.VehicleStatus("drone", "rates", 9, 3, 0, 0, 5, True, 1, 2, 0, "three rotors")],
)

# By hand: 2 999 999 us = 0x2DC6BF, 3 000 000 us = 0x2DC6C0: high halves 0x2DC, low halves 0x6BF and 0x6C0.
EVT3 = [0x82DC, 0x66BF, 0x0003, 0x2807, 0x66C0, 0x0004, 0x2002]
MONO = [1 << 63 | 3 << 48 | 7 << 32, 4 << 48 | 2 << 32 | 1000]


def context(**changes: Any) -> Context:
    return Context(vehicle="drone", frame_id="drone/imu", **changes)


EXPECTED: dict[str, tuple[Callable[..., Any], Any, Context, str, Any]] = {
    "clock": (
        convert.clock,
        messages.Clock(stamp_ns=STAMP_NS, wall_ns=5),
        context(),
        "rosgraph_msgs/Clock",
        record("rosgraph_msgs/Clock", record("builtin_interfaces/Time", S, N)),
    ),
    "imu": (
        convert.imu,
        IMU,
        context(options={"angular_velocity_std_rad_s": 0.5, "linear_acceleration_std_m_s2": 2.0}),
        "sensor_msgs/Imu",
        record(
            "sensor_msgs/Imu",
            header("drone/imu"),
            quaternion(0.0, 0.0, 0.0, 1.0),
            covariance(3, -1.0),
            vector(1.0, 2.0, -3.0),
            covariance(3, 0.25, 0.25, 0.25),
            vector(0.5, -0.25, 9.81),
            covariance(3, 4.0, 4.0, 4.0),
        ),
    ),
    "odometry": (
        convert.odometry,
        ODOMETRY,
        context(
            options={
                "position_std_m": 2.0,
                "orientation_std_rad": 3,
                "velocity_std_m_s": 4.0,
                "angular_velocity_std_rad_s": 5.0,
            }
        ),
        "nav_msgs/Odometry",
        record(
            "nav_msgs/Odometry",
            header("drone/odom"),
            "drone/base_link",
            record(
                "geometry_msgs/PoseWithCovariance",
                record("geometry_msgs/Pose", point(1.0, -2.0, 3.0), quaternion(0.5, 0.5, 0.5, 0.5)),
                covariance(6, 4.0, 4.0, 4.0, 9.0, 9.0, 9.0),
            ),
            record(
                "geometry_msgs/TwistWithCovariance",
                # v_W = (10, 20, 30) = (c, a, b), so v_B = (20, 30, 10)
                record("geometry_msgs/Twist", vector(20.0, 30.0, 10.0), vector(0.1, 0.2, 0.3)),
                covariance(6, 16.0, 16.0, 16.0, 25.0, 25.0, 25.0),
            ),
        ),
    ),
    "odometry_transform": (
        convert.odometry_transform,
        ODOMETRY,
        context(),
        "tf2_msgs/TFMessage",
        record("tf2_msgs/TFMessage", [transform("drone/odom", "drone/base_link", (1.0, -2.0, 3.0), TURN)]),
    ),
    "pose_stamped": (
        convert.pose_stamped,
        ODOMETRY,
        context(),
        "geometry_msgs/PoseStamped",
        record(
            "geometry_msgs/PoseStamped",
            header("drone/odom"),
            record("geometry_msgs/Pose", point(1.0, -2.0, 3.0), quaternion(*TURN)),
        ),
    ),
    "transform": (
        convert.transform,
        messages.Transform(
            stamp_ns=STAMP_NS,
            parent="drone/base_link",
            child="drone/rgb_optical_frame",
            translation=np.array([0.1, 0.2, 0.3]),
            rotation=-TURN,
        ),
        context(),
        "tf2_msgs/TFMessage",
        record(
            "tf2_msgs/TFMessage",
            [transform("drone/base_link", "drone/rgb_optical_frame", (0.1, 0.2, 0.3), -TURN)],
        ),
    ),
    "image": (
        convert.image,
        IMAGE,
        context(),
        "sensor_msgs/Image",
        image_record("drone/rgb_optical_frame", 2, 2, "rgb8", 6, range(12)),
    ),
    "depth": (
        convert.image,
        DEPTH,
        context(),
        "sensor_msgs/Image",
        image_record("drone/depth_optical_frame", 1, 2, "32FC1", 8, float_bytes(1.5, math.inf)),
    ),
    "image_camera_info": (
        convert.image_camera_info,
        IMAGE,
        context(camera_info=CAMERA),
        "sensor_msgs/CameraInfo",
        camera_record("drone/rgb_optical_frame"),
    ),
    "camera_info": (
        convert.camera_info,
        CAMERA,
        context(),
        "sensor_msgs/CameraInfo",
        camera_record("drone/rgb_optical_frame", 0, 0),
    ),
    "events_camera_info": (
        convert.events_camera_info,
        EVENTS,
        context(camera_info=CAMERA),
        "sensor_msgs/CameraInfo",
        camera_record("drone/rgb_optical_frame"),  # as the picture that ends with the window
    ),
    "events_evt3": (
        convert.event_packet,
        EVENTS,
        context(),
        "event_camera_msgs/EventPacket",
        record(
            "event_camera_msgs/EventPacket",
            header("drone/events_optical_frame", 2, 999_999_000),
            5,
            8,
            42,
            0,
            "evt3",
            False,
            np.frombuffer(np.array(EVT3, "<u2").tobytes(), U8),
        ),
    ),
    "events_mono": (
        convert.event_packet,
        EVENTS,
        context(options={"encoding": "mono"}),
        "event_camera_msgs/EventPacket",
        record(
            "event_camera_msgs/EventPacket",
            header("drone/events_optical_frame", 2, 999_999_000),
            5,
            8,
            42,
            2_999_999_000,
            "mono",
            False,
            np.frombuffer(np.array(MONO, "<u8").tobytes(), U8),
        ),
    ),
    "point_cloud": (
        convert.point_cloud,
        messages.PointCloud(
            stamp_ns=STAMP_NS + 66_051,
            points=np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], np.float32),
            intensity=np.array([0.5, 0.25], np.float32),
            ring=np.array([7, 258], np.uint16),
            t=np.array([0, 66_051], np.uint32),
            start_ns=STAMP_NS,
            frame_id="drone/lidar",
        ),
        context(),
        "sensor_msgs/PointCloud2",
        record(
            "sensor_msgs/PointCloud2",
            header("drone/lidar"),
            1,
            2,
            [
                record("sensor_msgs/PointField", name, offset, kind, 1)
                for name, offset, kind in (
                    *(("x", 0, 7), ("y", 4, 7), ("z", 8, 7)),
                    *(("intensity", 12, 7), ("ring", 16, 4), ("t", 20, 6)),
                )
            ],
            False,
            24,
            48,
            np.array(
                [
                    *(*float_bytes(1.0, 2.0, 3.0, 0.5), 7, 0, 0, 0, 0, 0, 0, 0),
                    *(*float_bytes(4.0, 5.0, 6.0, 0.25), 2, 1, 0, 0, 3, 2, 1, 0),
                ],
                U8,
            ),
            True,
        ),
    ),
    "rotor_speeds": (
        convert.rotor_speeds,
        messages.RotorSpeeds(stamp_ns=STAMP_NS, speed=np.array([1.0, 2.0, 3.0, 4.0])),
        context(),
        "actuator_msgs/Actuators",
        record(
            "actuator_msgs/Actuators",
            header("drone/base_link"),
            np.zeros(0),
            np.array([1.0, 2.0, 3.0, 4.0]),
            np.zeros(0),
        ),
    ),
    "path": (
        convert.path,
        messages.Path(
            stamp_ns=STAMP_NS,
            time_ns=np.array([0, 1_000_000_002]),
            position=np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]),
            frame_id="world",
        ),
        context(),
        "nav_msgs/Path",
        record(
            "nav_msgs/Path",
            header("map"),
            [
                record(
                    "geometry_msgs/PoseStamped",
                    header("map", *stamp),
                    record("geometry_msgs/Pose", point(*place), quaternion(0.0, 0.0, 0.0, 1.0)),
                )
                for stamp, place in (((0, 0), (1.0, 2.0, 3.0)), ((1, 2), (4.0, 5.0, 6.0)))
            ],
        ),
    ),
    "text": (
        convert.text,
        messages.Text("grüß"),
        context(),
        "std_msgs/String",
        record("std_msgs/String", "grüß"),
    ),
    "simulation": (
        convert.simulation,
        messages.Simulation("vehicle: {}", "1.0", ["drone"], "lockstep", 100.0),
        context(),
        "std_msgs/String",
        record("std_msgs/String", "vehicle: {}"),
    ),
    "collision": (
        convert.collision,
        messages.Collision(stamp_ns=STAMP_NS, position=np.array([1.0, 2.0, 3.0]), clearance_m=-0.5),
        context(),
        "neurosim/Collision",
        record("neurosim/Collision", header("map"), point(1.0, 2.0, 3.0), -0.5),
    ),
    "simulator_status": (
        convert.simulator_status,
        STATUS,
        context(),
        "neurosim/SimulatorStatus",
        record(
            "neurosim/SimulatorStatus",
            header(""),
            "running",
            "",
            "streaming",
            0.5,
            1.0,
            100,
            4,
            record("builtin_interfaces/Duration", 2, 500_000_000),
            7,
            3,
            2,
            True,
        ),
    ),
}
"""What is converted, how, and what comes out."""


@pytest.mark.parametrize("name", EXPECTED)
def test_out_is_what_rosbags_writes(name):
    convert_it, message, given, ros_type, expected = EXPECTED[name]
    data = bytes(convert_it(message, given))
    theirs = bytes(typestore().serialize_cdr(expected, ros_type.replace("/", "/msg/")))
    assert data == theirs + bytes(-len(theirs) % 4)


def test_every_way_out_is_tested():
    tested = {
        (f"cortex/{type(message).__name__}", kind.replace("/", "/msg/")): function
        for function, message, _, kind, _ in EXPECTED.values()
    }
    below = {
        ("cortex/Events", "sensor_msgs/msg/Image"),
        ("cortex/Image", "sensor_msgs/msg/PointCloud2"),
        ("cortex/Image", "sensor_msgs/msg/CompressedImage"),
        ("cortex/SimulatorStatus", "diagnostic_msgs/msg/DiagnosticArray"),
    }
    assert OUT.keys() - tested.keys() == below
    assert all(OUT[key].convert is function for key, function in tested.items() if key in OUT)
    others = [rule for rule in RULES if rule.direction == "record" or rule.robot]  # test_bag, test_robot
    assert len(OUT) + len(IN) + len(others) == len(RULES)


def test_event_image_is_drawn_until_its_period_is_over():
    """Of two windows the second one is due."""
    drawn = context(options={"period_s": 0.1})
    first = dataclasses.replace(EVENTS, start_ns=2_950_000_000, stamp_ns=STAMP_NS - 10_000_000)
    assert convert.event_image(first, drawn) is None
    one = {"x": EVENTS.x[1:], "y": EVENTS.y[1:], "polarity": np.ones(1, U8), "t": np.array([3_040_000])}
    later = dataclasses.replace(EVENTS, **one, start_ns=first.stamp_ns, stamp_ns=3_050_000_000)
    data = convert.event_image(later, drawn)
    image = cdr.decode(data, "sensor_msgs/msg/Image")
    pixels = image.data.reshape(5, 8, 3)
    white, _, blue = ([255, 255, 255], [220, 30, 30], [30, 60, 220])
    assert pixels[3, 7].tolist() == blue
    assert pixels[4, 2].tolist() == blue  # was darker first
    assert (pixels == white).all(axis=2).sum() == 5 * 8 - 2
    assert (image.height, image.width, image.step, image.encoding) == (5, 8, 24, "rgb8")
    assert (image.header.stamp.sec, image.header.stamp.nanosec) == (3, 50_000_000)
    assert image.header.frame_id == "drone/events_optical_frame"


def test_event_images_come_at_their_rate():
    """Windows of 1 ms and pictures of 1/30 s; again after time was set back; a new size is a new picture."""
    drawn = context()
    none = np.zeros(0, np.uint16)

    def window(end_ms: int, width: int = 4) -> Any:
        return convert.event_image(
            messages.Events(
                stamp_ns=end_ms * 1_000_000,
                start_ns=(end_ms - 1) * 1_000_000,
                x=none,
                y=none,
                t=np.zeros(0, np.int64),
                polarity=none.astype(U8),
                width=width,
                height=3,
            ),
            drawn,
        )

    for _ in range(2):
        sent = [end_ms for end_ms in range(1, 1001) if window(end_ms) is not None]
        assert len(sent) == 30
        assert sent[:4] == [34, 67, 100, 134]
    assert window(1001, width=5) is None
    assert window(2001, width=5) is not None  # late, and but once
    assert window(2002, width=5) is None


# Frames


def test_names_of_frames():
    names = FrameNames()
    assert names.ros("world") == "map"
    assert names.ros("drone/rgb_optical_frame") == "drone/rgb_optical_frame"
    assert names.ros("") == ""
    assert (names.odom_of("drone"), names.body_of("drone")) == ("drone/odom", "drone/base_link")
    assert (names.odom_of(""), names.body_of("")) == ("odom", "base_link")
    other = FrameNames(prefix="sim/", map="earth", rename={"drone/base_link": "base_link"})
    assert (other.ros("world"), other.odom_of("drone")) == ("sim/earth", "sim/drone/odom")
    assert (other.body_of("drone"), other.ros("drone/imu")) == ("base_link", "sim/drone/imu")
    for wrong in ({"map": ""}, {"map": "/map"}, {"prefix": "a b"}, {"rename": {"a": ""}}):
        with pytest.raises(ValueError, match=f"frames.{next(iter(wrong))}"):
            FrameNames(**wrong)


def test_what_frames_commands_may_name():
    names = FrameNames(prefix="sim/")
    kinds = {
        "world": ("map", "sim/map", "world", "odom", "sim/drone/odom", "/map"),
        "body": ("base_link", "drone/base_link", "sim/drone/base_link"),
        "heading": ("base_footprint", "drone/base_footprint", "sim/drone/base_footprint"),
        None: ("other/base_link", "drone/rgb_optical_frame", "drone", ""),
    }
    for kind, frames_of_kind in kinds.items():
        for frame in frames_of_kind:
            assert names.kind_of(frame, "drone") == kind, frame


def test_rotations():
    assert frames.rotate(TURN, (1.0, 2.0, 3.0)).tolist() == [3.0, 1.0, 2.0]
    assert frames.rotate_back(TURN, (1.0, 2.0, 3.0)).tolist() == [2.0, 3.0, 1.0]
    assert frames.rotate((0.0, 0.0, 1.0, 0.0), (1.0, 2.0, 3.0)).tolist() == [-1.0, -2.0, 3.0]
    assert frames.yaw_rad(TURN) == math.pi / 2
    assert frames.yaw_rad((0.0, 0.0, 0.0, 1.0)) == 0.0
    tilted = np.array([0.1, -0.3, 0.5, 0.806225774829855])  # where it turns the x axis, seen from above
    east, north, _ = frames.rotate(tilted, (1.0, 0.0, 0.0))
    assert frames.yaw_rad(tilted) == pytest.approx(math.atan2(north, east), abs=1e-14)
    assert frames.yaw_rad((0.0, 0.0, math.sin(-0.6), math.cos(-0.6))) == pytest.approx(-1.2, abs=1e-15)


def test_static_transforms_are_one_message_from_the_map_on():
    mount = messages.Transform(
        stamp_ns=STAMP_NS,
        parent="a/base_link",
        child="a/imu",
        translation=np.array([0.1, 0.2, 0.3]),
        rotation=TURN,
    )
    names = FrameNames(map="earth")
    data = static_transforms([transform_of(mount, names)], ["a", "b"], names)
    identity = (0.0, 0.0, 0.0, 1.0)
    expected = record(
        "tf2_msgs/TFMessage",
        [
            transform("earth", "a/odom", (0.0, 0.0, 0.0), identity, 0, 0),
            transform("earth", "b/odom", (0.0, 0.0, 0.0), identity, 0, 0),
            transform("a/base_link", "a/imu", (0.1, 0.2, 0.3), TURN),
        ],
    )
    assert bytes(data) == bytes(cdr.encode(expected))


def test_frames_of_a_flight_form_one_tree():
    """From map over odom and base_link to a sensor, each with one parent, by the names of other messages."""
    mount = messages.Transform(0, "drone/base_link", "drone/imu", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    parents = {}
    for data in (
        static_transforms([transform_of(mount, FrameNames())], ["drone"], FrameNames()),
        convert.odometry_transform(ODOMETRY, context()),
    ):
        for each in cdr.decode(data, "tf2_msgs/msg/TFMessage").transforms:
            assert each.child_frame_id not in parents
            parents[each.child_frame_id] = each.header.frame_id
    assert parents == {"drone/odom": "map", "drone/base_link": "drone/odom", "drone/imu": "drone/base_link"}
    imu = cdr.decode(convert.imu(IMU, context()), "sensor_msgs/msg/Imu")
    state = cdr.decode(convert.odometry(ODOMETRY, context()), "nav_msgs/msg/Odometry")
    assert imu.header.frame_id in parents
    assert (state.header.frame_id, state.child_frame_id) == ("drone/odom", "drone/base_link")


# What goes out, in particular


def test_a_camera_sees_the_same_pixel_in_both_conventions():
    """The middle of 640 pixels is 320 where their centres are at +0.5, and 319.5 where they are at 0."""
    sent = cdr.decode(convert.camera_info(CAMERA, context()) or b"", "sensor_msgs/msg/CameraInfo")
    ray = np.array([0.1, -0.2, 1.0])
    column, row, _ = CAMERA.matrix @ ray
    ros_column, ros_row, _ = sent.k.reshape(3, 3) @ ray
    assert (ros_column + 0.5, ros_row + 0.5) == (pytest.approx(column), pytest.approx(row))
    assert np.array_equal(sent.p.reshape(3, 4)[:, :3], sent.k.reshape(3, 3))


def test_a_distorted_camera_keeps_its_model():
    lens = messages.CameraInfo(
        0, 640, 480, np.eye(3), "equidistant", np.array([0.1, 0.2, 0.3, 0.4]), "drone/rgb_optical_frame"
    )
    sent = cdr.decode(convert.camera_info(lens, context()) or b"", "sensor_msgs/msg/CameraInfo")
    assert (sent.distortion_model, sent.d.tolist()) == ("equidistant", [0.1, 0.2, 0.3, 0.4])


def test_there_is_no_camera_info_before_the_calibration():
    assert convert.image_camera_info(IMAGE, context()) is None
    assert convert.events_camera_info(EVENTS, context()) is None


@pytest.mark.parametrize(
    ("data", "encoding"),
    [
        (np.zeros((2, 3, 1), U8), "mono8"),
        (np.zeros((2, 3, 1), np.uint16), "16UC1"),
        (np.zeros((2, 3, 2), np.float32), "32FC2"),
        (np.zeros((2, 3, 1), np.int32), "32SC1"),
        (np.zeros((2, 6, 1), np.float32)[:, ::2], "32FC1"),
        (np.zeros((0, 0, 3), U8), "rgb8"),
    ],
)
def test_images_of_all_kinds(data, encoding):
    data = data.copy() if data.flags.c_contiguous else data
    sent = cdr.decode(
        convert.image(messages.Image(stamp_ns=0, data=data, encoding=encoding), context()),
        "sensor_msgs/msg/Image",
    )
    height, width, channels = data.shape
    assert (sent.height, sent.width, sent.encoding) == (height, width, encoding)
    assert sent.step == width * channels * data.itemsize
    assert bytes(sent.data) == data.tobytes()
    assert sent.header.frame_id == "drone/imu"  # no frame of its own


def test_images_that_are_not_what_their_encoding_says_are_refused():
    for data, encoding, reason in (
        (np.zeros((2, 3, 1), U8), "rgb8", "3 channels of uint8, got 1"),
        (np.zeros((2, 3, 3), np.int8), "rgb8", "got 3 of int8"),
        (np.zeros((2, 3, 1), np.float64), "32FC1", "1 channels of float32"),
        (np.zeros((2, 3, 1), U8), "jpeg", "unknown encoding 'jpeg'"),
        (np.zeros((2, 3, 1), U8), "8FC1", "unknown encoding '8FC1'"),
    ):
        with pytest.raises(ConvertError, match=reason):
            convert.image(messages.Image(stamp_ns=0, data=data, encoding=encoding), context())


def test_an_imu_without_options_has_unknown_covariances():
    sent = cdr.decode(convert.imu(IMU, context()), "sensor_msgs/msg/Imu")
    assert sent.orientation_covariance.tolist() == [-1.0] + [0.0] * 8
    assert not sent.angular_velocity_covariance.any()
    assert not sent.linear_acceleration_covariance.any()


def test_stamps_before_zero_and_beyond_what_ros_can_hold():
    sent = cdr.decode(convert.clock(messages.Clock(-1, 0), context()), "rosgraph_msgs/msg/Clock")
    assert (sent.clock.sec, sent.clock.nanosec) == (-1, 999_999_999)
    convert.clock(messages.Clock(2**31 * 10**9 - 1, 0), context())
    for stamp_ns in (2**31 * 10**9, -(2**31) * 10**9 - 1):
        with pytest.raises(ConvertError, match="32 bits"):
            convert.clock(messages.Clock(stamp_ns, 0), context())


def many_events(count: int, begin_us: int = 0) -> messages.Events:
    rng = np.random.default_rng(count)
    return messages.Events(
        stamp_ns=(begin_us + 10_000) * 1000,
        x=rng.integers(0, 640, count).astype(np.uint16),
        y=rng.integers(0, 480, count).astype(np.uint16),
        t=np.sort(rng.integers(begin_us + 1, begin_us + 10_001, count)),
        polarity=rng.integers(0, 2, count).astype(U8),
        width=640,
        height=480,
        start_ns=begin_us * 1000,
    )


@pytest.mark.parametrize("encoding", ["evt3", "mono"])
def test_event_packets_are_decoded_again(encoding):
    """Packets of a flight, some empty, one after nearly a whole wrap: the message says all that is needed."""
    given = context(options={"encoding": encoding})
    decoder = Evt3Decoder()
    gap_us = (1 << 24) - 5 * 4096
    for begin_us, count in ((0, 100), (4, 0), (8, 1), (8 + gap_us, 33), (2 * gap_us, 0), (3 * gap_us, 2000)):
        events = many_events(count, begin_us)
        data = convert.event_packet(events, given)
        assert len(data) % 4 == 0
        sent = cdr.decode(data, "event_camera_msgs/msg/EventPacket")
        stamp_ns = sent.header.stamp.sec * 10**9 + sent.header.stamp.nanosec
        if encoding == "evt3":
            decoded = decoder.decode(sent.events, width=sent.width, height=sent.height)
            t_ns = decoded.t * 1000
        else:
            decoded = decode_mono(sent.events, base_ns=sent.time_base)
            t_ns = decoded.t
        assert np.array_equal(t_ns, events.t * 1000)
        assert np.array_equal(decoded.x, events.x)
        assert np.array_equal(decoded.y, events.y)
        assert np.array_equal(decoded.polarity, events.polarity)
        assert stamp_ns == (t_ns[0] if count else events.stamp_ns)


def test_events_that_cannot_be_encoded_are_refused():
    outside = messages.Events(
        0, np.array([8], np.uint16), np.array([0], np.uint16), np.array([5]), np.array([1], U8), 8, 5
    )
    for encoding in ("evt3", "mono"):
        with pytest.raises(ConvertError, match="column 8"):
            convert.event_packet(outside, context(options={"encoding": encoding}))
    with pytest.raises(ConvertError, match="column 8"):
        convert.event_image(outside, context())
    before = messages.Events(
        0, np.array([1], np.uint16), np.array([0], np.uint16), np.array([-5]), np.array([1], U8), 8, 5
    )
    with pytest.raises(ConvertError, match="before 0"):
        convert.event_packet(before, context(options={"encoding": "mono"}))


def test_clouds():
    points = np.array([[1.0, 2.0, np.nan]], np.float32)
    sent = cdr.decode(
        convert.point_cloud(messages.PointCloud(0, points, frame_id="drone/lidar"), context()),
        "sensor_msgs/msg/PointCloud2",
    )
    assert (sent.is_dense, sent.point_step, [f.name for f in sent.fields]) == (False, 12, ["x", "y", "z"])
    t = np.array([5], np.uint32)
    for deskewed, stamp_ns in ((False, 3), (True, 9)):
        cloud = messages.PointCloud(9, points, t=t, start_ns=3, deskewed=deskewed)
        sent = cdr.decode(convert.point_cloud(cloud, context()), "sensor_msgs/msg/PointCloud2")
        assert sent.header.stamp.nanosec == stamp_ns
    with pytest.raises(ConvertError, match="1 points and 2 values of intensity"):
        convert.point_cloud(messages.PointCloud(0, points, np.zeros(2, np.float32)), context())


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_states_that_are_not_finite_are_refused(bad):
    """RViz and tf would stumble over them."""
    wrong = ODOMETRY.__class__(
        stamp_ns=0,
        position=np.array([0.0, bad, 0.0]),
        orientation=TURN,
        velocity=np.zeros(3),
        body_rate=np.zeros(3),
    )
    for convert_it in (convert.odometry, convert.odometry_transform):
        with pytest.raises(ConvertError, match="odometry: not finite"):
            convert_it(wrong, context())
    mount = messages.Transform(0, "a", "b", np.zeros(3), np.array([bad, 0.0, 0.0, 1.0]))
    with pytest.raises(ConvertError, match="'b': not finite"):
        convert.transform(mount, context())
    with pytest.raises(ConvertError, match="rotation is zero"):
        convert.transform(messages.Transform(0, "a", "b", np.zeros(3), np.zeros(4)), context())


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf, "0.5", True])
def test_options_that_are_no_numbers_are_refused(value):
    with pytest.raises(ValueError, match="angular_velocity_std_rad_s must be a number >= 0"):
        context(options={"angular_velocity_std_rad_s": value})


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("queue", [1, 65_536, None], [0, 65_537, 1.5, True, "7"]),
        ("encoding", ["evt3", "mono"], ["evt2", None]),
        ("period_s", [0, 0.1], [-0.1, None]),
        ("stale_s", [0.1, 5, None], [0, math.inf, "fast"]),
        ("stamp", ["header", "now"], [True, "later"]),
        ("max_thrust_n", [None, 1e-3, 100], [0, -1.0, math.nan, "a lot"]),
        ("frame", ["map", "other/base_link"], ["", 3]),
    ],
)
def test_what_options_must_be(name, good, bad):
    for value in [*good, OPTIONS_OF_ROUTES[name].default]:
        check_option(name, value)
    for value in bad:
        with pytest.raises(ValueError, match=f"option {name} must be"):
            check_option(name, value)


def test_measurements_that_are_not_finite_are_refused():
    wrong = messages.Imu(0, np.zeros(3), np.array([0.0, math.nan, 0.0]))
    with pytest.raises(ConvertError, match="imu: not finite"):
        convert.imu(wrong, context())
    fallen = messages.Odometry(0, np.zeros(3), np.zeros(4), np.zeros(3), np.zeros(3))
    for convert_it in (convert.odometry, convert.odometry_transform):
        with pytest.raises(ConvertError, match="orientation is zero"):
            convert_it(fallen, context())


def test_diagnostics_say_what_a_simulator_does():
    """In words, and all of its numbers."""
    data = convert.simulator_diagnostics(STATUS, context())
    sent = cdr.decode(data, "diagnostic_msgs/msg/DiagnosticArray")
    assert (sent.header.stamp.sec, sent.header.stamp.nanosec, sent.header.frame_id) == (S, N, "")
    assert [(each.level, each.name, each.message, each.hardware_id) for each in sent.status] == [
        (
            1,
            "simulator",
            "running, 0.5 x real time; 4 steps were late, and 2.500 s slipped so far",
            "simulator",
        ),
        (0, "sensor drone/imu", "2 dropped so far, as its link is configured", "drone"),
        (1, "sensor drone/rgb", "5 dropped so far; 3 lost by reliable readers so far", "drone"),
        (
            1,
            "vehicle drone",
            "no command has come in time: the fail-safe flies; 3 commands refused so far (three rotors); "
            "2 collisions so far; commands: rates",
            "drone",
        ),
    ]
    for told, each in zip(sent.status, (STATUS, *STATUS.sensors, *STATUS.vehicles), strict=True):
        numbers = dataclasses.asdict(each)
        for lists in ("sensors", "vehicles"):
            numbers.pop(lists, None)
        assert {entry.key: entry.value for entry in told.values} == {k: str(v) for k, v in numbers.items()}


def test_diagnostics_judge_the_last_period():
    """What went wrong once is no warning for ever; the sums stay."""
    given = context()

    def told(**changes: Any) -> Any:
        data = convert.simulator_diagnostics(dataclasses.replace(STATUS, **changes), given)
        return None if data is None else cdr.decode(data, "diagnostic_msgs/msg/DiagnosticArray").status

    quiet = [messages.VehicleStatus("drone", "rates", 9, 3, 0, 0, 5, False, 1, 2)]
    assert told() is not None
    assert told(wall_ns=200_000_001) is None
    assert told(wall_ns=300_000_001, phase="paused") is not None
    later = told(wall_ns=1_000_000_001, vehicles=quiet)
    assert [status.level for status in later] == [0] * 4
    assert (later[0].message, later[3].message) == ("running, 0.5 x real time", "commands: rates")
    assert {pair.key: pair.value for pair in later[0].values}["overrun_count"] == "4"
    more = [dataclasses.replace(quiet[0], refused_count=5)]
    again = told(wall_ns=3_000_000_001, overrun_count=7, vehicles=more)
    assert again[0].level == 1
    assert "3 steps were late, and 0.000 s slipped in 2.0 s" in again[0].message
    assert again[3].message == "2 commands refused in 2.0 s; commands: rates"
    anew = told(wall_ns=5_000_000_001, overrun_count=1, vehicles=quiet)  # after a reset
    assert "1 steps were late" in anew[0].message
    assert told(wall_ns=6_000_000_001, phase="ended", reason="it hit a wall")[0].level == 2


def test_a_picture_of_depths_becomes_a_cloud():
    """By hand: z along the axis; the centre of pixel (row, column) is at (column + 0.5, row + 0.5)."""
    lens = messages.CameraInfo(
        0, 2, 2, np.array([[2.0, 0.0, 1.0], [0.0, 4.0, 1.0], [0.0, 0.0, 1.0]]), "", np.zeros(0), "lens"
    )
    depth = np.array([[[2.0], [np.inf]], [[np.nan], [8.0]]], np.float32)
    picture = messages.Image(STAMP_NS, depth, "32FC1", "drone/depth_optical_frame")

    def points(**options: float) -> Any:
        data = convert.point_cloud_of_depth(picture, context(camera_info=lens, options=options))
        sent = cdr.decode(data, "sensor_msgs/msg/PointCloud2")
        assert sent.header.frame_id == "drone/depth_optical_frame"
        return np.array(sent.data, U8).view("<f4").reshape(-1, 3).tolist()

    assert points() == [[-0.5, -0.25, 2.0], [2.0, 1.0, 8.0]]
    assert points(depth_max_m=5.0) == [[-0.5, -0.25, 2.0]]
    assert convert.point_cloud_of_depth(picture, context()) is None
    for wrong, reason in ((IMAGE, "not one of rgb8"), (DEPTH, "calibrated for")):
        with pytest.raises(ConvertError, match=reason):
            convert.point_cloud_of_depth(wrong, context(camera_info=lens))


def test_options_belong_to_conversions():
    known = {"queue", "stale_s", "stamp"}.union(*(rule.options for rule in RULES))
    assert known == OPTIONS_OF_ROUTES.keys()


# What comes in


def stamped(message: Any, frame: str = "", second: int = S, nanosecond: int = N) -> Any:
    message.header.stamp.sec, message.header.stamp.nanosec = second, nanosecond
    message.header.frame_id = frame
    return message


def take(convert_it: Callable[..., Any], message: Any, **changes: Any) -> Any:
    return convert_it(cdr.encode(message), context(now_ns=99, sequence=5, **changes))


def state(orientation: Any) -> messages.Odometry:
    return messages.Odometry(0, np.zeros(3), np.array(orientation), np.zeros(3), np.zeros(3))


def test_actuators_are_rotor_speeds():
    command = take(convert.actuators, stamped(Actuators(velocity=[1.0, 2.0, 3.0, 0.0])))
    assert isinstance(command, messages.MotorCommand)
    assert command.speed.tolist() == [1.0, 2.0, 3.0, 0.0]
    assert (command.stamp_ns, command.sequence) == (STAMP_NS, 5)
    command = take(
        convert.actuators, stamped(Actuators(normalized=[0.5, 1.0])), options={"max_speed_rad_s": 1000}
    )
    assert command.speed.tolist() == [500.0, 1000.0]


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (Actuators(), "velocity is empty"),
        (Actuators(position=[1.0]), "velocity is empty"),
        (Actuators(velocity=[1.0, math.nan]), "not finite"),
        (Actuators(velocity=[1.0, math.inf]), "not finite"),
        (Actuators(velocity=[1.0, -2.0]), ">= 0, got -2.0"),
        (Actuators(normalized=[0.5]), "option max_speed_rad_s"),
    ],
)
def test_actuators_that_cannot_be_used_are_refused(message, reason):
    with pytest.raises(ConvertError, match=reason):
        take(convert.actuators, message)


@pytest.mark.parametrize("value", [1.5, math.nan, -0.5])
def test_normalized_actuators_beyond_their_range_are_refused(value):
    with pytest.raises(ConvertError):
        take(convert.actuators, Actuators(normalized=[value]), options={"max_speed_rad_s": 1.0})


def test_a_command_without_a_stamp_answers_the_newest_state():
    assert take(convert.actuators, Actuators(velocity=[1.0])).stamp_ns == 99
    assert take(convert.twist, Twist(), options={"frame": "map"}).stamp_ns == 99
    assert take(convert.actuators, stamped(Actuators(velocity=[1.0]), "", 0, 2)).stamp_ns == 2


def test_an_answer_to_the_first_state_is_none_to_the_newest():
    """A stamp of 0 would mean now: said again, it would answer a state that it does not know."""
    command = messages.RateThrustCommand(0, thrust_n=5.0, body_rate=np.zeros(3))
    (out,) = (r for r in RULES if r.direction == "record" and r.cortex_type == "cortex/RateThrustCommand")
    sent = out.convert(command, context())
    assert convert.rates(sent, context(now_ns=99)).stamp_ns == 0


@pytest.mark.parametrize(("second", "nanosecond"), [(-1, 0), (0, 10**9), (5, 2**32 - 1)])
def test_stamps_that_are_none_are_refused(second, nanosecond):
    with pytest.raises(ConvertError, match="stamp"):
        take(convert.actuators, stamped(Actuators(velocity=[1.0]), "", second, nanosecond))


def target(**fields: Any) -> Any:
    return stamped(AttitudeTarget(**fields), "")


def test_attitude_target_with_an_attitude():
    """Half of 20 N; FLU and ENU on both sides, so that the orientation stays what it is."""
    for mask in (7, 0, 3):
        message = target(type_mask=mask, thrust=0.5, orientation=Quaternion(x=0.5, y=0.5, z=0.5, w=0.5))
        command = take(convert.attitude, message, options={"max_thrust_n": 20.0})
        assert isinstance(command, messages.AttitudeCommand)
        assert (command.thrust_n, command.orientation.tolist()) == (10.0, [0.5, 0.5, 0.5, 0.5])
        assert (command.stamp_ns, command.sequence) == (STAMP_NS, 5)
        assert take(convert.rates, message) is None


def test_attitude_target_with_rates():
    message = target(type_mask=128, thrust=1.0, body_rate=Vector3(x=1.0, y=-2.0, z=3.0))
    message.orientation.w = math.nan  # ignored
    command = take(convert.rates, message)
    assert isinstance(command, messages.RateThrustCommand)
    assert command.body_rate.tolist() == [1.0, -2.0, 3.0]
    assert command.thrust_n == pytest.approx(4 * 5.57e-6 * 1500.0**2, rel=1e-4)  # the default airframe
    assert take(convert.attitude, message) is None


def test_the_vehicle_says_what_full_thrust_is():
    """An option wins over what the simulator says, and that over the default."""
    message = target(type_mask=128, thrust=0.5)
    assert take(convert.rates, message, max_thrust_n=8.0).thrust_n == 4.0
    assert take(convert.rates, message, max_thrust_n=8.0, options={"max_thrust_n": 20.0}).thrust_n == 10.0
    assert take(convert.rates, message, options={"max_thrust_n": None}).thrust_n == 0.5 * 50.13


def test_ignored_rates_may_be_anything():
    message = target(type_mask=7, thrust=0.5, body_rate=Vector3(x=math.nan, y=math.inf, z=math.nan))
    assert take(convert.attitude, message) is not None
    message.type_mask = 5
    with pytest.raises(ConvertError, match=r"body_rate\.y: not finite"):
        take(convert.attitude, message)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"type_mask": 64 + 7}, "ignores thrust"),
        ({"type_mask": 64 + 128}, "ignores thrust"),
        ({"type_mask": 16}, "does not define: 16"),
        ({"type_mask": 128 + 32}, "does not define: 32"),
        ({"type_mask": 128 + 1}, "all three"),
        ({"type_mask": 128 + 7}, "all three"),
        ({"type_mask": 128, "body_rate": Vector3(z=math.nan)}, "body rates: not finite"),
        ({"type_mask": 7, "orientation": Quaternion(w=0.0)}, "no unit quaternion"),
        ({"type_mask": 7, "orientation": Quaternion(w=90.0)}, "no unit quaternion"),
        ({"type_mask": 7, "orientation": Quaternion(x=math.nan)}, "orientation: not finite"),
        ({"type_mask": 7, "thrust": 1.5}, "0 to 1"),
        ({"type_mask": 128, "thrust": -0.125}, "0 to 1, got -0.125"),
        ({"type_mask": 7, "thrust": math.nan}, "0 to 1, got nan"),
    ],
)
def test_attitude_targets_that_cannot_be_used_are_refused_once(fields, reason):
    """By the one conversion that they are meant for."""
    message = target(**fields)
    mine, other = (convert.rates, convert.attitude)[:: 1 if message.type_mask & 128 else -1]
    assert take(other, message) is None
    with pytest.raises(ConvertError, match=reason):
        take(mine, message)


def test_a_quaternion_that_is_nearly_one_is_made_one():
    message = target(type_mask=7, orientation=Quaternion(z=0.7, w=0.71))
    command = take(convert.attitude, message)
    assert math.hypot(*command.orientation) == pytest.approx(1.0, abs=1e-15)


def velocity(x: float = 1.0, y: float = 2.0, z: float = 3.0, yaw: float = 0.5) -> Twist:
    return Twist(linear=Vector3(x=x, y=y, z=z), angular=Vector3(z=yaw))


@pytest.mark.parametrize(
    ("frame", "expected"),
    [
        ("map", [1.0, 2.0, 3.0]),
        ("drone/odom", [1.0, 2.0, 3.0]),
        ("base_link", [3.0, 1.0, 2.0]),
        ("drone/base_link", [3.0, 1.0, 2.0]),
        ("base_footprint", [-2.0, 1.0, 3.0]),  # the nose points north: forward is +y, left is -x, up stays up
    ],
)
def test_velocities_are_turned_to_the_world(frame, expected):
    command = take(
        convert.twist_stamped, stamped(TwistStamped(twist=velocity()), frame), odometry=state(TURN)
    )
    assert isinstance(command, messages.VelocityCommand)
    assert command.velocity == pytest.approx(expected, abs=1e-15)
    assert (command.yaw_rate_rad_s, command.stamp_ns, command.sequence) == (0.5, STAMP_NS, 5)
    plain = take(convert.twist, velocity(), odometry=state(TURN), options={"frame": frame})
    assert plain.velocity == pytest.approx(expected, abs=1e-15)


def test_velocities_without_a_frame():
    """Who names none flies level: relative to the tilted body it would sink while it accelerates."""
    command = take(convert.twist_stamped, stamped(TwistStamped(twist=velocity())), odometry=state(TURN))
    assert command.velocity == pytest.approx([-2.0, 1.0, 3.0], abs=1e-15)
    command = take(convert.twist, velocity(), odometry=state(TURN))
    assert command.velocity == pytest.approx([-2.0, 1.0, 3.0], abs=1e-15)


def test_velocities_that_cannot_be_used_are_refused():
    for message, reason in (
        (velocity(x=math.nan), "not finite"),
        (velocity(yaw=math.inf), "not finite"),
        (Twist(angular=Vector3(x=0.1)), "angular.x and angular.y must be 0"),
    ):
        with pytest.raises(ConvertError, match=reason):
            take(convert.twist, message, odometry=state(TURN))
    with pytest.raises(ConvertError, match="no odometry yet"):
        take(convert.twist, velocity())
    with pytest.raises(
        ConvertError, match=r"frame 'other/base_link', known: map, drone/odom, .*base_footprint$"
    ):
        take(convert.twist_stamped, stamped(TwistStamped(), "other/base_link"), odometry=state(TURN))


RANGES = messages.CommandRanges(
    refuse=False,
    rotor_speed_max_rad_s=900.0,
    thrust_max_n=20.0,
    speed_max_m_s=10.0,
    body_rate_max_rad_s=4.0,
    position_max_m=50.0,
)


def asked_for(largest: float) -> list[tuple[Callable[..., Any], Any, str, list[float]]]:
    """Return a command of each kind beyond `RANGES`: its conversion, message, field, and what is flown."""
    pose = PoseStamped()
    pose.pose.position.y = -largest
    rate = AttitudeTarget(type_mask=128, thrust=0.5)
    rate.body_rate.x, rate.body_rate.y = 0.6 * largest, 0.8 * largest
    flying = velocity(x=0.6 * largest, y=0.0, z=0.8 * largest, yaw=0.0)
    return [
        (convert.twist, flying, "velocity", [6.0, 0.0, 8.0]),
        (convert.twist, Twist(angular=Vector3(z=-largest)), "yaw_rate_rad_s", [-4.0]),
        (convert.twist_stamped, stamped(TwistStamped(twist=flying), "map"), "velocity", [6.0, 0.0, 8.0]),
        (convert.rates, stamped(rate), "body_rate", [2.4, 3.2, 0.0]),
        (convert.pose, stamped(pose, "map"), "position", [0.0, -50.0, 0.0]),
        (convert.actuators, stamped(Actuators(velocity=[1.0, largest])), "speed", [1.0, 900.0]),
    ]


@pytest.mark.parametrize("largest", [1e3, 1e308])
def test_commands_out_of_range_are_clamped_or_refused(largest):
    """By what the simulator says of its vehicle; options of the route come first."""
    for function, message, field, flown in asked_for(largest):
        at = context(now_ns=99, ranges=RANGES, options={"frame": "map"} if function is convert.twist else {})
        command = function(cdr.encode(message), at)
        assert np.atleast_1d(getattr(command, field)) == pytest.approx(flown, rel=1e-14)
        assert re.match(r"a [a-z ]+ of \S+ \S+ is out of range: up to", at.excess)
        for refusing in (
            {"ranges": dataclasses.replace(RANGES, refuse=True)},
            {"ranges": RANGES, "options": {"beyond": "refuse"}},
        ):
            with pytest.raises(ConvertError, match="is out of range"):
                take(function, message, odometry=state(TURN), **refusing)
    option = {"max_speed_m_s": 2.0, "frame": "map"}
    slow = take(convert.twist, velocity(x=5.0), ranges=RANGES, options=option).velocity
    assert np.linalg.norm(slow) == pytest.approx(2.0, rel=1e-14)
    free = context(now_ns=99, ranges=RANGES, options={"frame": "map"})
    assert convert.twist(cdr.encode(velocity()), free).velocity.tolist() == [1.0, 2.0, 3.0]
    assert free.excess == ""


@pytest.mark.parametrize("known", [None, RANGES])
def test_no_finite_command_becomes_one_that_is_not_finite(known):
    """Numbers of all magnitudes, in every frame, whether the simulator has said its ranges or not."""
    random = np.random.default_rng(5)
    for _ in range(300):
        x, y, z, yaw = random.choice([-1.0, 1.0], 4) * 1.7 * 10.0 ** random.uniform(-300.0, 308.0, 4)
        for frame in ("map", "base_link", "base_footprint"):
            message = stamped(TwistStamped(twist=velocity(x, y, z, yaw)), frame)
            command = take(convert.twist_stamped, message, odometry=state(TURN), ranges=known)
            assert np.linalg.norm(command.velocity) <= (100.0 if known is None else 10.0) * (1.0 + 1e-14)
            assert abs(command.yaw_rate_rad_s) <= (34.9 if known is None else 4.0)


@pytest.mark.parametrize("frame", ["", "map", "drone/odom", "world"])
def test_poses(frame):
    message = stamped(PoseStamped(), frame)
    message.pose.position.x, message.pose.position.z = 1.0, -2.0
    message.pose.orientation = Quaternion(z=math.sin(0.6), w=math.cos(0.6))
    command = take(convert.pose, message)
    assert isinstance(command, messages.PoseCommand)
    assert command.position.tolist() == [1.0, 0.0, -2.0]
    assert command.yaw_rad == pytest.approx(1.2, abs=1e-15)
    assert (command.stamp_ns, command.sequence) == (STAMP_NS, 5)


def test_poses_that_cannot_be_used_are_refused():
    message = stamped(PoseStamped(), "map")
    message.pose.position.y = math.nan
    with pytest.raises(ConvertError, match="position: not finite"):
        take(convert.pose, message)
    message = stamped(PoseStamped(), "map")
    message.pose.orientation.w = 0.0
    with pytest.raises(ConvertError, match="no unit quaternion"):
        take(convert.pose, message)
    with pytest.raises(ConvertError, match=r"frame 'base_link', known: map, drone/odom, odom, world$"):
        take(convert.pose, stamped(PoseStamped(), "base_link"))


def test_a_trajectory_is_its_first_point():
    first = Transform(translation=Vector3(x=1.0, y=2.0, z=3.0), rotation=Quaternion(z=1.0, w=0.0))
    points = [MultiDOFJointTrajectoryPoint(transforms=[each]) for each in (first, Transform())]
    command = take(convert.trajectory, stamped(MultiDOFJointTrajectory(points=points), "map"))
    assert isinstance(command, messages.PoseCommand)
    assert command.position.tolist() == [1.0, 2.0, 3.0]
    assert command.yaw_rad == pytest.approx(math.pi)
    assert command.stamp_ns == STAMP_NS
    with pytest.raises(ConvertError, match="without points"):
        take(convert.trajectory, stamped(MultiDOFJointTrajectory(), "map"))
    empty = MultiDOFJointTrajectory(points=[MultiDOFJointTrajectoryPoint()])
    with pytest.raises(ConvertError, match="no transform"):
        take(convert.trajectory, stamped(empty, "map"))


def test_requests():
    assert take(convert.steps, UInt32(data=7)) == messages.Step(7)
    with pytest.raises(ConvertError, match="0 control periods"):
        take(convert.steps, UInt32())
    assert take(convert.trigger, Empty()) == messages.Trigger(5)
    assert take(convert.reset_empty, Empty()) == messages.Reset()
    assert take(convert.reset, Reset()) == messages.Reset()


def test_a_reset_with_everything():
    message = Reset(vehicle="drone", use_seed=True, seed=-3, use_pose=True, use_twist=True)
    message.pose.position.x, message.pose.orientation = 4.0, Quaternion(z=1.0, w=0.0)
    message.twist = velocity()
    request = take(convert.reset, message)
    assert (request.vehicle, request.seed) == ("drone", -3)
    assert request.position.tolist() == [4.0, 0.0, 0.0]
    assert request.orientation.tolist() == [0.0, 0.0, 1.0, 0.0]
    assert request.velocity.tolist() == [1.0, 2.0, 3.0]
    assert request.body_rate.tolist() == [0.0, 0.0, 0.5]
    message.twist.linear.x = math.nan
    with pytest.raises(ConvertError, match="twist: not finite"):
        take(convert.reset, message)
    message.use_twist = False
    assert take(convert.reset, message).velocity is None


@pytest.mark.parametrize(("ros_type", "kind"), IN)
def test_everything_that_comes_in_is_checked_for_its_length(ros_type, kind):
    whole = cdr.encode(cdr.decode(cdr.encode(_default(ros_type)), ros_type))
    for data in (whole[:-4], bytes(whole) + bytes(8), b"\0\1\0\0", b""):
        with pytest.raises(cdr.CdrError):
            IN[ros_type, kind].convert(data, context())


def _default(ros_type: str) -> Any:
    from cortex_ros2_bridge.msgs import message_class

    return message_class(ros_type)()


def test_a_clamped_vector_is_not_beyond_its_limit_by_a_rounding():
    """Else the simulator, which has the same limit, clamps it again."""
    context = Context(options={"max_speed_m_s": 51.3838})
    rng = np.random.default_rng(1)
    for vector in rng.normal(size=(2000, 3)) * 10.0 ** rng.uniform(2, 300, (2000, 1)):
        assert np.linalg.norm(context.within("velocity", vector, "max_speed_m_s", "m/s")) <= 51.3838
