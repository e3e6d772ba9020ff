"""Message definitions, and stand-ins that behave as the classes of rclpy do."""

from __future__ import annotations

import array
import copy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cortex_ros2_bridge import cdr, msgs
from cortex_ros2_bridge.convert import RULES
from cortex_ros2_bridge.msgs import (
    Actuators,
    AttitudeTarget,
    CameraInfo,
    DiagnosticStatus,
    Empty,
    Header,
    Image,
    Imu,
    KeyValue,
    NavSatStatus,
    PointCloud2,
    PointField,
    PolygonStamped,
    PoseWithCovariance,
    Quaternion,
    SimulatorStatus,
    String,
    TFMessage,
    Vector3,
    message_class,
)
from cortex_ros2_bridge.typestore import (
    DISTROS,
    UnknownTypeError,
    check_type,
    definitions,
    type_hash,
    typestore,
)

WRONG = (AssertionError, OverflowError, TypeError, cdr.CdrError)
"""What is raised where a value is set, with and without ROS_PYTHON_CHECK_FIELDS=1, or where it is encoded."""
ROUTED = sorted({rule.ros_type for rule in RULES})
HASHES = Path(__file__).with_name("golden") / "type_hashes.txt"
REAL_HASHES = {
    # As `ros2 topic info -v` of a Jazzy installation shows them.
    "sensor_msgs/msg/Imu": "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
    "sensor_msgs/msg/Image": "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    "rmw_dds_common/msg/ParticipantEntitiesInfo": (  # it has a char
        "RIHS01_91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e"
    ),
    "std_msgs/msg/String": "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
}


@pytest.mark.parametrize(("type_name", "expected"), REAL_HASHES.items())
def test_type_hashes_are_those_of_real_nodes(type_name, expected):
    assert type_hash(type_name) == expected


def test_no_routed_type_has_changed():
    """Nodes built before would not understand us; `python tests/bridge/test_types.py` writes them anew."""
    before = dict(line.split() for line in HASHES.read_text(encoding="utf-8").splitlines())
    assert {name: type_hash(name) for name in ROUTED} == before


@pytest.mark.parametrize("type_name", ROUTED)
def test_what_is_routed_is_the_same_in_all_distributions(type_name):
    assert len({type_hash(type_name, distro) for distro in DISTROS}) == 1


def test_names_of_types():
    with pytest.raises(UnknownTypeError, match="is it sensor_msgs/msg/Imu"):
        check_type("sensor_msgs/Imu")
    with pytest.raises(UnknownTypeError, match="unknown message type 'a/msg/B' in ROS humble"):
        check_type("a/msg/B", "humble")
    with pytest.raises(ValueError, match="'foxy', known: humble, iron, jazzy"):
        typestore("foxy")


def test_all_definitions_are_in_the_store():
    assert {"event_camera_msgs/msg/EventPacket", "neurosim/msg/Reset"} <= definitions().keys()
    assert definitions().keys() <= typestore().fielddefs.keys()


FIELDS = {
    # As `get_fields_and_field_types()` of rclpy's classes shows them.
    Imu: {
        "header": "std_msgs/Header",
        "orientation": "geometry_msgs/Quaternion",
        "orientation_covariance": "double[9]",
        "angular_velocity": "geometry_msgs/Vector3",
        "angular_velocity_covariance": "double[9]",
        "linear_acceleration": "geometry_msgs/Vector3",
        "linear_acceleration_covariance": "double[9]",
    },
    Image: {
        "header": "std_msgs/Header",
        "height": "uint32",
        "width": "uint32",
        "encoding": "string",
        "is_bigendian": "uint8",
        "step": "uint32",
        "data": "sequence<uint8>",
    },
    PointCloud2: {
        "header": "std_msgs/Header",
        "height": "uint32",
        "width": "uint32",
        "fields": "sequence<sensor_msgs/PointField>",
        "is_bigendian": "boolean",
        "point_step": "uint32",
        "row_step": "uint32",
        "data": "sequence<uint8>",
        "is_dense": "boolean",
    },
    DiagnosticStatus: {
        "level": "octet",
        "name": "string",
        "message": "string",
        "hardware_id": "string",
        "values": "sequence<diagnostic_msgs/KeyValue>",
    },
    Actuators: {
        "header": "std_msgs/Header",
        "position": "sequence<double>",
        "velocity": "sequence<double>",
        "normalized": "sequence<double>",
    },
    Empty: {},
}


@pytest.mark.parametrize(("kind", "expected"), FIELDS.items(), ids=lambda v: getattr(v, "__name__", ""))
def test_fields_and_their_types(kind, expected):
    assert kind.get_fields_and_field_types() == expected
    assert list(kind.get_fields_and_field_types()) == list(expected)
    assert [slot for slot in kind.__slots__ if slot != "_check_fields"] == [f"_{name}" for name in expected]
    kind.get_fields_and_field_types().clear()  # a copy
    assert kind.get_fields_and_field_types() == expected


def test_limits_are_part_of_a_type():
    shape = message_class("shape_msgs/msg/SolidPrimitive")
    assert shape.get_fields_and_field_types()["dimensions"] == "sequence<double, 3>"


def test_defaults():
    imu = Imu()
    assert (imu.orientation.x, imu.orientation.w) == (0.0, 1.0)
    assert Quaternion.W__DEFAULT == 1.0
    assert NavSatStatus().status == -2
    assert imu.header.frame_id == ""
    assert imu.orientation_covariance.tolist() == [0.0] * 9
    assert imu.orientation_covariance.dtype == np.float64
    image = Image()
    assert image.data == array.array("B")
    assert image.data.typecode == "B"
    assert DiagnosticStatus().level == b"\0"
    assert TFMessage().transforms == []
    assert Image().header is not Image().header
    first, second = PoseWithCovariance(), PoseWithCovariance()
    first.covariance[0] = 1.0
    assert second.covariance[0] == 0.0


def test_constants_are_on_class_and_message():
    assert (PointField.FLOAT32, PointField().FLOAT32) == (7, 7)
    assert DiagnosticStatus.ERROR == b"\x02"
    bits = "ROLL_RATE", "PITCH_RATE", "YAW_RATE", "THRUST", "ATTITUDE"
    assert [getattr(AttitudeTarget, f"IGNORE_{bit}") for bit in bits] == [1, 2, 4, 64, 128]
    assert SimulatorStatus.RUNNING == "running"


def test_constructor_takes_fields_by_name_only():
    message = Vector3(x=1.0, z=-2.0)
    assert (message.x, message.y, message.z) == (1.0, 0.0, -2.0)
    with pytest.raises(AssertionError, match="Invalid arguments passed to constructor: w"):
        Vector3(w=1.0)
    with pytest.raises(TypeError):
        Vector3(1.0, 2.0, 3.0)


def test_attributes_that_do_not_exist_cannot_be_set():
    with pytest.raises(AttributeError):
        Imu().acceleration = 3


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda: Vector3(x="1"), "cannot encode a geometry_msgs/msg/Vector3"),
        (lambda: Image(height=-1), "cannot encode a sensor_msgs/msg/Image"),
        (lambda: Image(height=2**32), "cannot encode a sensor_msgs/msg/Image"),
        (lambda: Image(height=1.0), "cannot encode a sensor_msgs/msg/Image"),
        (lambda: Image(encoding=b"rgb8"), "cannot encode a sensor_msgs/msg/Image"),
        (lambda: Image(header=Vector3()), "cannot encode a sensor_msgs/msg/Image"),
        (lambda: Image(data=[256]), "unsigned byte integer is greater than maximum"),
        (lambda: Image(data="ab"), "cannot use a str"),
        (lambda: Image(data=[0.5]), "float"),
        (lambda: Image(data=array.array("f", [1.0])), "type code 'f' for one of 'B'"),
        (lambda: Imu(orientation_covariance=np.zeros(9, np.float32)), "of float32 for one of"),
        (lambda: Imu(orientation_covariance=np.zeros(8)), "cannot encode a sensor_msgs/msg/Imu"),
        (lambda: Imu(orientation_covariance=[0.0] * 8), "cannot encode a sensor_msgs/msg/Imu"),
        (lambda: PointCloud2(fields=[Vector3()]), "cannot encode a sensor_msgs/msg/PointCloud2"),
        (lambda: DiagnosticStatus(level=1), "cannot encode a diagnostic_msgs/msg/DiagnosticStatus"),
        (lambda: DiagnosticStatus(level=b"12"), "cannot encode a diagnostic_msgs/msg/DiagnosticStatus"),
        (lambda: AttitudeTarget(thrust=1e39), "cannot encode a mavros_msgs/msg/AttitudeTarget"),
    ],
)
def test_values_of_a_wrong_type_or_range_are_refused(make, reason):
    """Where they are set, or at the latest where they are encoded."""
    is_ours = issubclass(Imu, msgs.Message)
    with pytest.raises(WRONG, match=reason if is_ours else None):  # rclpy has other words for each
        cdr.encode(make())


def test_arrays_are_those_of_rclpy_whatever_they_are_made_of():
    pixels = np.arange(12, dtype=np.uint8).reshape(2, 6)
    flat = pixels.reshape(-1)
    for data in (flat, pixels.tobytes(), bytearray(pixels), list(range(12)), array.array("B", range(12))):
        assert Image(data=data).data == array.array("B", range(12))
    assert Image(data=flat[::2]).data.tolist() == [0, 2, 4, 6, 8, 10]
    assert Actuators(velocity=[1, 2]).velocity == array.array("d", [1.0, 2.0])
    imu = Imu(orientation_covariance=[0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0])
    assert imu.orientation_covariance.dtype == np.float64
    ours = np.ones(9)
    imu.orientation_covariance = ours
    assert imu.orientation_covariance is ours
    assert CameraInfo(k=[float(n) for n in range(9)]).k.shape == (9,)
    assert CameraInfo(k=list(range(9))).k.tolist() == [float(n) for n in range(9)]
    message = Actuators()
    message.velocity.extend([3.0, 4.0])
    assert message.velocity.tolist() == [3.0, 4.0]


def test_an_array_of_more_dimensions_is_refused_as_rclpy_does():
    """Else what was written without ROS would fail where ROS is."""
    picture = np.zeros((2, 6), np.uint8)
    with pytest.raises(WRONG):
        Image(data=picture)
    message = Image()
    with pytest.raises(WRONG):
        message.data = picture


def test_equality():
    one, other = Imu(), Imu()
    assert one == other
    other.angular_velocity_covariance[:] = 1.0  # where only some differ, the classes of Jazzy see none
    assert one != other
    assert Header(frame_id="a") != Header(frame_id="b")
    assert Header() != String()
    with pytest.raises(TypeError):
        hash(Header())


def test_text():
    header = Header(frame_id="map")
    assert repr(header) == (
        "std_msgs.msg.Header(stamp=builtin_interfaces.msg.Time(sec=0, nanosec=0), frame_id='map')"
    )
    assert repr(Actuators(header=header, velocity=[1.0, 2.5])).endswith(
        "position=[], velocity=[1.0, 2.5], normalized=[])"
    )
    assert repr(KeyValue(key="a", value="b")) == "diagnostic_msgs.msg.KeyValue(key='a', value='b')"


def test_copies():
    message = PolygonStamped()
    message.header.frame_id = "map"
    message.polygon.points.append(message_class("geometry_msgs/msg/Point32")(x=0.5))
    same = copy.deepcopy(message)
    assert same == message
    same.polygon.points[0].x = 1.0
    assert message.polygon.points[0].x == 0.5


def test_every_type_has_a_class():
    for type_name in typestore().fielddefs:
        kind = message_class(type_name)
        assert kind() == kind(), type_name
        assert repr(kind()).startswith(type_name.replace("/", ".") + "(")
        assert message_class(type_name) is kind


def test_names_that_do_not_exist():
    with pytest.raises(ImportError, match="NoSuchMessage"):
        from cortex_ros2_bridge.msgs import NoSuchMessage  # noqa: F401
    with pytest.raises(UnknownTypeError, match="no_msgs/msg/Imu"):
        message_class("no_msgs/msg/Imu")
    assert {"Imu", "message_class", "Collision"} <= set(dir(msgs))


def test_packages_do_not_hide_each_other():
    """Names that are in two packages mean one of them, and always the same."""
    assert KeyValue is message_class("diagnostic_msgs/msg/KeyValue")
    assert msgs.GoalStatus is message_class("action_msgs/msg/GoalStatus")


REAL = """
class Imu:
    @classmethod
    def get_fields_and_field_types(cls):
        return {}

Imu.__module__ = "sensor_msgs.msg._imu"
"""
USER = """
from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.msgs import Imu, Image

print(Imu.__module__, Image.__module__, cdr.type_name_of(Imu()), cdr.type_name_of(Image()))
"""


def test_the_real_class_is_used_where_ros_is_sourced(tmp_path: Path):
    """In a process of its own, which finds a package `sensor_msgs` that has Imu and no Image."""
    package = tmp_path / "sensor_msgs" / "msg"
    package.mkdir(parents=True)
    (tmp_path / "sensor_msgs" / "__init__.py").touch()
    (package / "__init__.py").write_text(REAL)
    root = Path(__file__).resolve().parents[2]
    said = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path[:0] = [{str(tmp_path)!r}, {str(root)!r}]\n{USER}"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    assert said == [
        "sensor_msgs.msg._imu",
        "cortex_ros2_bridge.msgs",
        "sensor_msgs/msg/Imu",
        "sensor_msgs/msg/Image",
    ]


def test_stand_ins_conform_to_rclpy():
    """Where ROS is sourced: fields, their types and defaults of the classes that it has."""
    pytest.importorskip("rclpy")
    compared = 0
    for type_name in typestore().fielddefs:
        real = msgs._ros_class(type_name)
        if real is None:
            continue
        ours = msgs._make_class(type_name)
        assert ours.get_fields_and_field_types() == real.get_fields_and_field_types(), type_name
        assert repr(ours()) == repr(real()), type_name
        compared += 1
    assert compared > 50


if __name__ == "__main__":
    HASHES.write_text("".join(f"{name} {type_hash(name)}\n" for name in ROUTED), encoding="utf-8")
