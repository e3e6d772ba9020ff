"""Types of one's own cross: by converters, field by field, and without any registration."""

from __future__ import annotations

import enum
import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bridge_rig import rig_of
from processes import ROOT, wait_for

from cortex import Array, Float32, UInt8, message
from cortex.messages import CameraInfo
from cortex_ros2_bridge import cdr, cli
from cortex_ros2_bridge.convert import registry
from cortex_ros2_bridge.convert.registry import load_converters, ros_type_of, share
from cortex_ros2_bridge.msgs import message_class
from cortex_ros2_bridge.typestore import typestore
from neurosim_core.live import messages as live
from neurosim_core.sensors.event_labels import LabelledEvents

EXAMPLE = ROOT / "examples" / "ros2_custom_type"


class Mode(enum.Enum):
    IDLE = 0
    BUSY = 7


@message(name="my_robot/Joint")
class Joint:
    name: str
    angle: Float32


@message(name="my_robot/Arm")
class Arm:
    stamp_ns: int
    joints: list[Joint]
    home: Joint
    mode: Mode
    grid: Array["float32", "rows", "columns"]
    pose: Array["float64", 3]
    raw: bytes
    flags: list[bool]
    frame_id: str = ""
    sequence: UInt8 = 0


@message(name="my_robot/Gripper")
class Gripper:
    stamp_ns: int
    width_m: float
    fingers: Array["float32", "n", 2]
    label: str
    raw: bytes
    frame_id: str = ""


@message(name="my_robot/Labels")
class Labels:
    stamp_ns: int
    data: Array["int32", "H", "W"]
    labels: str
    encoding: str
    sequence: int
    frame_id: str


@message(name="my_robot/Wave")
class Wave:
    spectrum: Array["complex64", "n"]


@pytest.fixture(autouse=True)
def nothing_added(runtime: Path) -> Iterator[None]:
    """What a test registers is forgotten after it."""
    yield
    registry.ADDED.clear()


def test_names_in_ros() -> None:
    assert ros_type_of("my_robot/Battery") == "my_robot/msg/Battery"
    assert ros_type_of("cortex/Lidar") == "cortex_msgs/msg/Lidar"
    assert ros_type_of("My-Robot.v2/gas sensor") == "my_robot_v2/msg/GasSensor"


def test_an_unknown_type_goes_out_field_by_field() -> None:
    """Without registration: header, nested messages and lists of them, arrays with their shape, enums."""
    arm = Arm(
        3_000_000_007,
        [Joint("a", 0.5), Joint("b", -1.0)],
        Joint("home", 0.25),
        Mode.BUSY,
        np.arange(6, dtype=np.float32).reshape(2, 3),
        np.array([1.0, 2.0, 3.0]),
        b"xyz",
        [True, False],
        "drone/arm",
        9,
    )
    with rig_of() as rig:
        sent = rig.simulator.publisher("/drone/arm", Arm)
        (ros,) = rig.opens("/drone/arm")
        assert ros.type_name == "my_robot/msg/Arm"
        with rig.listening(sent, "/drone/arm"):
            sent.publish(arm)
            wait_for(lambda: ros.sent)
        got = ros.messages()[0]
    assert (got.header.stamp.sec, got.header.stamp.nanosec, got.header.frame_id) == (3, 7, "drone/arm")
    assert [(joint.name, joint.angle) for joint in got.joints] == [("a", 0.5), ("b", -1.0)]
    assert (got.home.name, got.mode, got.sequence, bytes(got.raw)) == ("home", 7, 9, b"xyz")
    assert (list(got.grid), list(got.grid_shape)) == ([0, 1, 2, 3, 4, 5], [2, 3])
    assert (got.pose.tolist(), list(got.flags)) == ([1.0, 2.0, 3.0], [True, False])
    fields = [name for name, _ in typestore("humble").fielddefs["my_robot/msg/Arm"][1]]
    assert fields[:2] == ["header", "joints"]


def test_a_sensor_of_an_outside_package_goes_out_from_its_packet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither its message nor its type in ROS is written anywhere: both follow from the packet's fields."""
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    proximity = importlib.import_module("custom_sensor").Proximity
    kind = live.message_type(proximity)
    reading = proximity(stamp_ns=3_000_000_007, sensor="prox", sequence=9, closed=True, height_m=0.25)
    with rig_of() as rig:
        sent = rig.simulator.publisher("/drone/prox", kind)
        (ros,) = rig.opens("/drone/prox")
        assert ros.type_name == "neurosim/msg/Proximity"
        with rig.listening(sent, "/drone/prox"):
            sent.publish(live.to_message(reading, frame_id="drone/prox"))
            wait_for(lambda: ros.sent)
        got = ros.messages()[0]
    assert (got.header.stamp.sec, got.header.stamp.nanosec, got.header.frame_id) == (3, 7, "drone/prox")
    assert (got.closed, got.height_m) == (True, 0.25)


def test_a_picture_of_any_type_goes_out_as_an_image_with_what_its_labels_mean() -> None:
    picture = Labels(
        3_000_000_007, np.arange(6, dtype=np.int32).reshape(2, 3), '{"classes":[]}', "32SC1", 0, "c"
    )
    with rig_of() as rig:
        sent = rig.simulator.publisher("/drone/labels", Labels)
        images, texts = rig.opens("/drone/labels/image_raw", "/drone/labels/labels")
        assert (images.type_name, texts.type_name) == ("sensor_msgs/msg/Image", "std_msgs/msg/String")
        with rig.listening(sent, "/drone/labels/image_raw", "/drone/labels/labels"):
            sent.publish(picture)
            wait_for(lambda: images.sent and texts.sent)
        image, text = images.messages()[0], texts.messages()[0]
    assert (image.height, image.width, image.encoding, image.step) == (2, 3, "32SC1", 12)
    np.testing.assert_array_equal(np.asarray(image.data).view(np.int32), np.arange(6))
    assert (image.header.stamp.sec, image.header.frame_id, text.data) == (3, "c", picture.labels)


def test_events_with_their_truth_go_out_as_events_and_with_it() -> None:
    """What others know is there as of any camera, its losses counted; the truth is beside it."""
    columns = {
        "t": np.array([4001, 4500]),
        "x": np.array([1, 2], np.uint16),
        "y": np.array([3, 4], np.uint16),
    }
    columns |= {"polarity": np.array([0, 1], np.uint8), "instance": np.array([7, -1], np.int32)}
    columns |= {"depth": np.array([1.5, np.inf], np.float32), "cause": np.array([0, 3], np.uint8)}
    columns |= {"flow": np.array([[1, 2], [3, 4]], np.float32), "semantic": np.array([2, -1], np.int32)}
    header = {"stamp_ns": 5_000_000, "start_ns": 4_000_000, "sensor": "events", "width": 8, "height": 6}
    events = LabelledEvents(**header, **columns, dropped_count=2, labels='{"classes":[]}')
    names = ("", "/labelled", "/image", "/camera_info")
    with rig_of() as rig:
        sent = rig.simulator.publisher("/drone/events", live.message_type(LabelledEvents))
        info = rig.simulator.publisher("/drone/events/info", CameraInfo, latch=True)
        lens = {"matrix": np.eye(3), "distortion_model": "", "distortion": np.zeros(0)}
        info.publish(CameraInfo(stamp_ns=0, width=8, height=6, **lens))
        packets, labelled, image, calibration = rig.opens(*(f"/drone/events{name}" for name in names))
        assert (packets.type_name, image.type_name, calibration.type_name) == (
            "event_camera_msgs/msg/EventPacket", "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo",
        )  # fmt: skip
        assert labelled.type_name == "neurosim/msg/LabelledEvents"
        with rig.listening(sent, "/drone/events", "/drone/events/labelled"):
            sent.publish(live.to_message(events, frame_id="drone/events"))
            wait_for(lambda: packets.sent and labelled.sent)
        packet, truth = packets.messages()[0], labelled.messages()[0]
        assert rig.tally("/drone/events -> /drone/events").dropped == 2
        assert rig.bridge.problems == []
    assert (packet.width, packet.height, packet.encoding, packet.header.frame_id) == (
        8,
        6,
        "evt3",
        "drone/events",
    )
    for name in columns:
        np.testing.assert_array_equal(np.reshape(getattr(truth, name), columns[name].shape), columns[name])
    assert (truth.labels, list(truth.flow_shape), truth.dropped_count) == (events.labels, [2, 2], 2)


def test_a_type_without_counterparts_has_no_route() -> None:
    with rig_of() as rig:
        rig.simulator.publisher("/drone/wave", Wave)
        rig.update_until(lambda: rig.bridge.problems)
        assert rig.bridge.problems == [
            "no route for /drone/wave of type my_robot/Wave: its field spectrum has no counterpart in ROS: "
            "{'array': 'complex64', 'shape': ['n']}"
        ]


def test_a_shared_type_crosses_in_both_directions() -> None:
    share(Gripper)
    gripper = Gripper(5, 0.08, np.array([[1, 2], [3, 4]], np.float32), "left", b"\1\2", "drone/gripper")
    with rig_of() as rig:
        sent = rig.simulator.publisher("/drone/gripper", Gripper)
        wanted = rig.simulator.subscriber("/drone/wanted", Gripper)
        (ros,) = rig.opens("/drone/gripper")
        (back,) = rig.subscribes("/drone/wanted")
        with rig.listening(sent, "/drone/gripper"):
            sent.publish(gripper)
            wait_for(lambda: ros.sent)
        rig.update_until(lambda: wanted.publisher_count)
        back.put(ros.sent[0])
        got = wanted.recv(60.0)
        assert (got.stamp_ns, got.width_m, got.label, got.raw) == (5, 0.08, "left", b"\1\2")
        np.testing.assert_array_equal(got.fingers, gripper.fingers)
        wrong = cdr.decode(ros.sent[0], "my_robot/msg/Gripper")
        wrong.fingers_shape = np.array([3, 2], np.uint32)
        back.put(wrong)
        wait_for(lambda: rig.tally("/drone/wanted <- /drone/wanted").refused == 1)


def test_types_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="sensor_msgs/msg/Imu has the fields header, orientation, "):
        share(Gripper, "sensor_msgs/msg/Imu")
    with pytest.raises(
        ValueError, match=r"nested fields \(joints, home, flags\) need a converter of their own"
    ):
        share(Arm)


def test_converters_come_from_files_and_entry_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What cannot be loaded is said, and the rest goes on."""
    (tmp_path / "installed_converters.py").write_text(
        "from cortex import message\nfrom cortex_ros2_bridge.convert import share\n"
        "@message(name='other/Gas')\nclass Gas:\n    level: float\nshare(Gas)\n"
    )
    info = tmp_path / "other-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[cortex_ros2_bridge.converters]\ngas = installed_converters\n")
    monkeypatch.syspath_prepend(tmp_path)
    problems = load_converters(["nothing.py", str(EXAMPLE / "battery.py")])
    assert {"other/Gas", "my_robot/Battery"} <= registry.ADDED.keys()
    (problem,) = problems
    assert problem.startswith("the converters of nothing.py cannot be loaded: FileNotFoundError: there is no")
    monkeypatch.setattr(cli, "LIST_S", 0.0)
    assert cli.main(["--list", "--converter", "no_such_module"]) == 0
    assert "the converters of no_such_module cannot be loaded: ModuleNotFoundError" in capsys.readouterr().err


def test_the_example_runs(dds_domain: int) -> None:
    """A converter in one file; it prints what has crossed."""
    done = subprocess.run(
        [sys.executable, str(EXAMPLE / "demo.py")], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.stdout.splitlines()[-1:] == ["to ROS: 14.8 V; from ROS: 11.1 V"], done.stderr


def test_a_converter_may_send_nothing_or_refuse() -> None:
    @registry.to_ros(Joint, "std_msgs/msg/String", name="{topic}/text")
    def text(joint: Joint, context: Any) -> Any:
        if joint.angle > 1.0:
            raise registry.ConvertError("too far")
        return None if not joint.name else message_class("std_msgs/msg/String")(data=joint.name)

    with rig_of() as rig:
        sent = rig.simulator.publisher("/drone/joint", Joint)
        (ros,) = rig.opens("/drone/joint/text")
        with rig.listening(sent, "/drone/joint/text"):
            for joint in (Joint("", 0.0), Joint("a", 2.0), Joint("b", 0.0)):
                sent.publish(joint)
            wait_for(lambda: ros.sent)
        assert [each.data for each in ros.messages()] == ["b"]
        assert rig.tally("/drone/joint -> /drone/joint/text").refused == 1
