"""Message definitions, and records of messages."""

from __future__ import annotations

import array
from pathlib import Path

import numpy as np
import pytest

from cortex_ros2_bridge import cdr, msgs
from cortex_ros2_bridge.convert import RULES
from cortex_ros2_bridge.msgs import (
    Actuators,
    AttitudeTarget,
    DiagnosticStatus,
    Image,
    Imu,
    KeyValue,
    NavSatStatus,
    PointCloud2,
    PointField,
    PoseWithCovariance,
    SimulatorStatus,
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


def test_defaults():
    imu = Imu()
    assert (imu.orientation.x, imu.orientation.w) == (0.0, 1.0)
    assert NavSatStatus().status == -2
    assert imu.header.frame_id == ""
    assert imu.orientation_covariance.tolist() == [0.0] * 9
    assert imu.orientation_covariance.dtype == np.float64
    assert (Image().data.dtype, len(Image().data)) == (np.uint8, 0)
    assert TFMessage().transforms == []
    assert Image().header is not Image().header
    first, second = PoseWithCovariance(), PoseWithCovariance()
    first.covariance[0] = 1.0
    assert second.covariance[0] == 0.0


def test_constants_are_on_class_and_message():
    assert (PointField.FLOAT32, PointField().FLOAT32) == (7, 7)
    assert DiagnosticStatus.ERROR == 2
    bits = "ROLL_RATE", "PITCH_RATE", "YAW_RATE", "THRUST", "ATTITUDE"
    assert [getattr(AttitudeTarget, f"IGNORE_{bit}") for bit in bits] == [1, 2, 4, 64, 128]
    assert SimulatorStatus.RUNNING == "running"


def test_attributes_that_do_not_exist_cannot_be_set():
    with pytest.raises(AttributeError, match="Imu has no field 'acceleration', its fields are header"):
        Imu().acceleration = 3
    with pytest.raises(AttributeError, match="no field 'w', its fields are x, y, z"):
        Vector3(w=1.0)


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda: Vector3(x="1"), "cannot encode a geometry_msgs/msg/Vector3"),
        (lambda: Image(height=-1), "cannot encode a sensor_msgs/msg/Image"),
        (lambda: Image(height=2**32), "cannot encode a sensor_msgs/msg/Image"),
        (lambda: Image(height=1.0), "cannot encode a sensor_msgs/msg/Image"),
        (lambda: Image(encoding=b"rgb8"), "cannot encode a sensor_msgs/msg/Image"),
        (lambda: Image(header=Vector3()), "cannot encode a sensor_msgs/msg/Image"),
        (lambda: Image(data=[256]), "256"),
        (lambda: Image(data="ab"), "one axis, got 'ab'"),
        (lambda: Image(data=[0.5]), r"\[0.5\] has numbers that are no uint8"),
        (lambda: Image(data=np.zeros((2, 6), np.uint8)), "one axis"),
        (lambda: Imu(orientation_covariance=np.zeros(8)), "cannot encode a sensor_msgs/msg/Imu"),
        (lambda: Imu(orientation_covariance=[0.0] * 8), "cannot encode a sensor_msgs/msg/Imu"),
        (lambda: PointCloud2(fields=[Vector3()]), "cannot encode a sensor_msgs/msg/PointCloud2"),
        (lambda: DiagnosticStatus(level=b"1"), "cannot encode a diagnostic_msgs/msg/DiagnosticStatus"),
        (lambda: AttitudeTarget(thrust=1e39), "cannot encode a mavros_msgs/msg/AttitudeTarget"),
    ],
)
def test_values_of_a_wrong_type_or_range_are_refused(make, reason):
    """Where they are set, or at the latest where they are encoded."""
    with pytest.raises((TypeError, OverflowError, cdr.CdrError), match=reason):
        cdr.encode(make())


def test_rows_are_arrays_whatever_they_are_made_of():
    flat = np.arange(12, dtype=np.uint8)
    for data in (
        flat,
        flat.tobytes(),
        bytearray(flat.tobytes()),
        list(range(12)),
        array.array("B", range(12)),
    ):
        image = Image(data=data)
        assert image.data.tolist() == list(range(12))
        assert image.data.dtype == np.uint8
    assert Image(data=flat[::2]).data.tolist() == [0, 2, 4, 6, 8, 10]
    assert Actuators(velocity=[1, 2]).velocity.dtype == np.float64
    ours = np.ones(9)
    assert Imu(orientation_covariance=ours).orientation_covariance is ours


def test_every_type_has_a_class():
    for type_name in typestore().fielddefs:
        kind = message_class(type_name)
        assert message_class(type_name) is kind
        data = bytes(cdr.encode(kind()))
        assert bytes(cdr.encode(cdr.decode(data, kind))) == data, type_name


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


if __name__ == "__main__":
    HASHES.write_text("".join(f"{name} {type_hash(name)}\n" for name in ROUTED), encoding="utf-8")
