"""Bags of rosbag2: read back with rosbags, and with the library of MCAP."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from bridge_rig import rig_of
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from runtime_directory import own_directory

from cortex import messages as msg
from cortex.log import LogWriter, open_log
from cortex_ros2_bridge.backend.bag import BagBackend, bag_directory, stamp_reader
from cortex_ros2_bridge.backend.base import BackendError, Qos
from cortex_ros2_bridge.backend.choose import open_backend
from cortex_ros2_bridge.bag_file import BagReader, BagWriter
from cortex_ros2_bridge.cli import main
from cortex_ros2_bridge.routes import look
from cortex_ros2_bridge.typestore import type_hash, typestore

CLOCK = "rosgraph_msgs/msg/Clock"
IMU = "sensor_msgs/msg/Imu"
STRING = "std_msgs/msg/String"
TF = "tf2_msgs/msg/TFMessage"
STORE = typestore()


def stamp(seconds: float) -> Any:
    nanoseconds = round(seconds * 1e9)
    return STORE.types["builtin_interfaces/msg/Time"](
        sec=nanoseconds // 1_000_000_000, nanosec=nanoseconds % 1_000_000_000
    )


def header(seconds: float) -> Any:
    return STORE.types["std_msgs/msg/Header"](stamp=stamp(seconds), frame_id="drone/base_link")


def clock(seconds: float) -> bytes:
    return bytes(STORE.serialize_cdr(STORE.types[CLOCK](clock=stamp(seconds)), CLOCK))


def imu(seconds: float) -> bytes:
    vector = STORE.types["geometry_msgs/msg/Vector3"](x=1.0, y=2.0, z=3.0)
    turn = STORE.types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    nine = np.arange(9.0)
    message = STORE.types[IMU](header(seconds), turn, nine, vector, nine, vector, nine)
    return bytes(STORE.serialize_cdr(message, IMU))


def text(words: str) -> bytes:
    return bytes(STORE.serialize_cdr(STORE.types[STRING](data=words), STRING))


def transforms(*seconds: float) -> bytes:
    kind = STORE.types
    at = kind["geometry_msgs/msg/Transform"](
        translation=kind["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0),
        rotation=kind["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    several = [kind["geometry_msgs/msg/TransformStamped"](header(second), "camera", at) for second in seconds]
    return bytes(STORE.serialize_cdr(kind[TF](transforms=several), TF))


def read(directory: Path) -> list[tuple[str, int, bytes]]:
    """Topic, time [ns] and bytes of all messages, in order of time."""
    with Reader(directory) as bag:
        return [(connection.topic, time_ns, bytes(data)) for connection, time_ns, data in bag.messages()]


def test_a_flight_is_read_back(tmp_path: Path) -> None:
    """By rosbags with types, and by the MCAP library with schemas, as Foxglove reads it."""
    bag = open_backend(tmp_path / "flight.mcap", distro="jazzy")
    latched = Qos(durability="transient_local", depth=1)
    clocks = bag.publisher("/clock", CLOCK, Qos(reliability="best_effort", depth=1))
    imus = bag.publisher("/drone/imu", IMU, Qos(depth=100))
    fixed = bag.publisher("/tf_static", TF, latched)
    assert imus.subscriber_count == 1
    fixed.publish(memoryview(transforms(0.0)))
    for step in range(1, 400):
        imus.publish(imu(step * 0.0025))
        if step % 4 == 0:
            clocks.publish(bytearray(clock(step * 0.0025)))
    bag.close()
    bag.close()

    with Reader(tmp_path / "flight") as found:
        kinds = {connection.topic: connection for connection in found.connections}
        assert {topic: one.msgtype for topic, one in kinds.items()} == {
            "/clock": CLOCK,
            "/drone/imu": IMU,
            "/tf_static": TF,
        }
        assert kinds["/drone/imu"].digest == type_hash(IMU)
        qos = kinds["/tf_static"].ext.offered_qos_profiles[0]
        assert (qos.durability.name, qos.reliability.name, qos.depth) == ("TRANSIENT_LOCAL", "RELIABLE", 1)
        rows = list(found.messages(connections=[kinds["/drone/imu"]]))
        assert [time_ns for _, time_ns, _ in rows] == [step * 2_500_000 for step in range(1, 400)]
        first = STORE.deserialize_cdr(rows[0][2], IMU)
        assert (first.header.frame_id, first.linear_acceleration.z) == ("drone/base_link", 3.0)

    with (tmp_path / "flight" / "flight.mcap").open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 1 + 399 + 99
        assert reader.get_header().profile == "ros2"
        imus_read = 0
        for schema, channel, message in reader.iter_messages(topics=["/drone/imu"]):
            assert schema is not None
            assert (schema.name, schema.encoding, channel.message_encoding) == (IMU, "ros2msg", "cdr")
            assert b"geometry_msgs/Vector3 linear_acceleration" in schema.data
            imus_read += message.data == imu(message.log_time * 1e-9)
        assert imus_read == 399

    with (tmp_path / "flight" / "metadata.yaml").open() as stream:
        metadata = yaml.safe_load(stream)["rosbag2_bagfile_information"]
    assert (metadata["version"], metadata["storage_identifier"]) == (8, "mcap")
    assert metadata["relative_file_paths"] == ["flight.mcap"]
    by_topic = {row["topic_metadata"]["name"]: row for row in metadata["topics_with_message_count"]}
    assert by_topic["/clock"]["message_count"] == 99
    assert by_topic["/drone/imu"]["topic_metadata"]["type_description_hash"] == type_hash(IMU)
    offered = yaml.safe_load(by_topic["/tf_static"]["topic_metadata"]["offered_qos_profiles"])[0]
    assert (offered["durability"], offered["reliability"], offered["history"]) == (1, 1, 1)


def test_messages_are_where_the_clock_was(tmp_path: Path) -> None:
    """Early ones by their stamps, late ones and those without stamps by the clock, which never goes back."""
    bag = BagBackend(tmp_path / "bag")
    clocks = bag.publisher("/clock", CLOCK, Qos())
    imus = bag.publisher("/imu", IMU, Qos())
    words = bag.publisher("/words", STRING, Qos())
    names: list[tuple[str, float]] = []

    def put(publisher: Any, message: bytes, expected_s: float) -> None:
        publisher.publish(message)
        names.append((message.hex(), expected_s))

    put(words, text("before anything"), 0.0)
    put(clocks, clock(1.0), 1.0)
    put(imus, imu(1.5), 1.5)  # ahead of the clock that goes with it
    put(imus, imu(0.5), 1.0)  # a link delayed it
    put(words, text("now"), 1.0)
    put(imus, imu(1e9), 1.0)  # another clock
    put(clocks, clock(2.0), 2.0)
    put(imus, imu(0.25), 2.0)  # of the next episode, before its clock
    put(clocks, clock(0.0), 2.0)  # reset
    put(imus, imu(0.75), 2.75)
    put(clocks, clock(1.0), 3.0)
    bag.close()
    came = {message.hex(): time_ns * 1e-9 for _, time_ns, message in read(tmp_path / "bag")}
    assert len(came) == len(names) - 1  # clock(1.0) is there twice
    for message, expected_s in names[2:]:
        assert came[message] == pytest.approx(expected_s, abs=1e-9), message


def test_without_a_clock_stamps_are_the_time(tmp_path: Path) -> None:
    """As of real sensors, whose stamps are those of the wall."""
    bag = BagBackend(tmp_path / "bag")
    imus = bag.publisher("/imu", IMU, Qos())
    words = bag.publisher("/words", STRING, Qos())
    for seconds in (1_700_000_000.0, 1_700_000_001.0):
        imus.publish(imu(seconds))
    words.publish(text("last"))
    bag.close()
    times = [(topic, time_ns) for topic, time_ns, _ in read(tmp_path / "bag")]
    second = 10**9
    assert times[:2] == [("/imu", 1_700_000_000 * second), ("/imu", 1_700_000_001 * second)]
    assert times[2] == ("/words", 1_700_000_001 * second)


def test_stamps_are_found_in_all_kinds_of_messages() -> None:
    assert stamp_reader(IMU, STORE)(imu(1.25)) == 1_250_000_000
    assert stamp_reader(CLOCK, STORE)(clock(2.5)) == 2_500_000_000
    assert stamp_reader(TF, STORE)(transforms(3.5, 9.0)) == 3_500_000_000
    assert stamp_reader(TF, STORE)(transforms()) is None
    assert stamp_reader(STRING, STORE)(text("12345678901234567890")) is None
    assert stamp_reader("std_msgs/msg/Empty", STORE)(b"\0\1\0\0\0") is None
    assert stamp_reader(IMU, STORE)(imu(1.25)[:8]) is None
    for type_name, message in ((IMU, imu(1.0)), (TF, transforms(1.0))):  # all types can be asked
        assert stamp_reader(type_name, STORE)(message) == 10**9
    for type_name in STORE.fielddefs:
        stamp_reader(type_name, STORE)


def test_a_topic_that_comes_back_goes_on(tmp_path: Path) -> None:
    bag = BagBackend(tmp_path / "bag")
    for word in ("a", "b"):
        publisher = bag.publisher("/words", STRING, Qos())
        publisher.publish(text(word))
        publisher.close()
        with pytest.raises(BackendError, match="publisher of /words is closed"):
            publisher.publish(text("late"))
    other = bag.publisher("/words", STRING, Qos(depth=3))
    other.publish(text("c"))
    bag.close()
    assert [message for _, _, message in read(tmp_path / "bag")] == [text("a"), text("b"), text("c")]


def test_nobody_else_is_there(tmp_path: Path) -> None:
    bag = BagBackend(tmp_path / "bag")
    with pytest.raises(BackendError, match="/cmd_vel: nobody else is there in a bag"):
        bag.subscription("/cmd_vel", "geometry_msgs/msg/Twist", Qos(), print)
    with pytest.raises(BackendError, match="nobody else is there in a bag"):
        bag.service("/reset", "std_srvs/srv/Trigger", lambda request, response: None)
    assert bag.topics() == []
    bag.close()


def test_errors(tmp_path: Path) -> None:
    bag = BagBackend(tmp_path / "bag")
    with pytest.raises(ValueError, match="unknown message type 'a/msg/B'"):
        bag.publisher("/a", "a/msg/B", Qos())
    with pytest.raises(ValueError, match="invalid ROS name 'a'"):
        bag.publisher("a", STRING, Qos())
    publisher = bag.publisher("/a", STRING, Qos())
    for bad in (b"", b"\0\0\0\0abcd", b"\0\1\0\0"):
        with pytest.raises(BackendError, match="not little-endian CDR"):
            publisher.publish(bad)
    with pytest.raises(BackendError, match=r"bag .*bag cannot be made: .*exists"):
        BagBackend(tmp_path / "bag.mcap")
    (tmp_path / "file").write_text("")
    with pytest.raises(BackendError, match="cannot be made"):
        BagBackend(tmp_path / "file" / "bag")
    bag.close()
    with pytest.raises(BackendError, match="closed"):
        publisher.publish(text("late"))
    with pytest.raises(BackendError, match="closed"):
        bag.publisher("/a", STRING, Qos())
    assert bag_directory(Path("a/b.mcap")) == Path("a/b")
    assert bag_directory(Path("a/b.1")) == Path("a/b.1")


SPEEDS = np.array([100.0, 200.0, 300.0, 400.0])
TURN = np.array([0.0, 0.6, 0.0, 0.8])
THREE = np.array([1.0, -2.0, 3.5])
COMMANDS: dict[str, Any] = {
    "motor_speeds": msg.MotorCommand(5_000_000_001, SPEEDS),
    "attitude": msg.AttitudeCommand(5_000_000_002, 10.0, TURN),
    "rates": msg.RateThrustCommand(5_000_000_003, 12.5, THREE),
    "velocity": msg.VelocityCommand(5_000_000_004, THREE, -0.25),
    "position": msg.PoseCommand(5_000_000_005, THREE, 1.25),
}
RECORDED = {"/simulation", "/drone/command/rates"}
ROS_TOPICS = {
    "/drone/actuators": "actuator_msgs/msg/Actuators",
    "/drone/attitude_target": "mavros_msgs/msg/AttitudeTarget",
    "/drone/command_velocity": "geometry_msgs/msg/TwistStamped",
    "/drone/command_pose": "geometry_msgs/msg/PoseStamped",
}


def test_commands_there_and_back(tmp_path: Path) -> None:
    """As the topics by which ROS would give them, so that a bag that is played flies."""
    with contextlib.closing(BagWriter(tmp_path / "flight.mcap")) as bag:
        for mode, command in COMMANDS.items():
            bag.write(f"/drone/command/{mode}", command)
        bag.write("/drone/rotor_speeds", msg.RotorSpeeds(5_000_000_006, SPEEDS))
    with contextlib.closing(BagReader(tmp_path / "flight.mcap")) as found:
        assert found.commands == ROS_TOPICS
        assert list(found.messages()) == []
        read_back = [command for _, command in found.messages(*found.commands)]
    assert [type(each) for each in read_back] == [type(each) for each in COMMANDS.values()]
    for before, after in zip(COMMANDS.values(), read_back, strict=True):
        assert after.stamp_ns == before.stamp_ns
        for name in {"speed", "thrust_n", "orientation", "body_rate", "velocity", "position"}:
            if hasattr(before, name):  # a thrust is a float32 in AttitudeTarget
                assert getattr(after, name) == pytest.approx(getattr(before, name), rel=1e-6), name
    assert read_back[3].yaw_rate_rad_s == -0.25
    assert read_back[4].yaw_rad == pytest.approx(1.25)


def test_commands_for_the_first_state_stay_so(tmp_path: Path) -> None:
    """In ROS a stamp of 0 means now: played again later, they would answer another state."""
    with contextlib.closing(BagWriter(tmp_path / "flight.mcap")) as bag:
        for mode, command in COMMANDS.items():
            bag.write(f"/drone/command/{mode}", dataclasses.replace(command, stamp_ns=0))
    with Reader(tmp_path / "flight.mcap") as reader:
        stamps = [
            STORE.deserialize_cdr(data, each.msgtype).header.stamp for each, _, data in reader.messages()
        ]
    assert [(each.sec, each.nanosec) for each in stamps] == [(0, 1)] * len(COMMANDS)
    with contextlib.closing(BagReader(tmp_path / "flight.mcap")) as found:
        assert [command.stamp_ns for _, command in found.messages(*found.commands)] == [0] * len(COMMANDS)


def test_the_bridge_records_the_commands_of_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """With thrusts as parts of what the simulator says the vehicle has; into a bag only."""
    simulation = msg.Simulation("", "", ["drone"], "streaming", 100.0, thrust_max_n=[25.0])
    for settings, opened in (({"backend": "run.mcap"}, True), ({}, False)):
        with own_directory(monkeypatch), rig_of(settings) as rig:
            said = rig.simulator.publisher("/simulation", msg.Simulation, latch=True)
            said.publish(simulation)
            commands = rig.simulator.publisher("/drone/command/rates", msg.RateThrustCommand)
            rig.update_until(lambda: {topic.topic for topic in look(rig.node).topics} >= RECORDED)
            rig.updates_during()
            assert ("/drone/attitude_target" in rig.backend.publishers) == opened
            if not opened:
                continue
            with rig.listening(commands, "/drone/attitude_target") as (target,):
                rig.update_until(lambda: rig.has_seen("drone", max_thrust_n=25.0))
                commands.publish(COMMANDS["rates"])
                (told,) = rig.update_until(target.messages)
        assert (told.type_mask, told.thrust, told.body_rate.y) == (128, 0.5, -2.0)
        assert told.header.frame_id == "drone/base_link"


def test_a_bag_becomes_a_log_and_the_log_a_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Commands, IMU and pictures, with their times; what Cortex has no type for is named."""
    picture = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    sent = {
        "/drone/imu": msg.Imu(5_000_000_000, THREE, 2 * THREE),
        "/drone/rgb": msg.Image(5_000_000_001, picture, "rgb8", "drone/rgb"),
        **{f"/drone/command/{mode}": command for mode, command in COMMANDS.items()},
    }
    times_ns = {topic: 7_000_000_000 + index for index, topic in enumerate(sent)}
    with contextlib.closing(BagWriter(tmp_path / "one.bag")) as bag:
        for topic, message in sent.items():
            assert bag.write(topic, message, at_ns=times_ns[topic]) == 1
        bag.write("/clock", msg.Clock(6_000_000_000, 0), at_ns=8_000_000_000)
    for source, target in (("one.bag", "one.mcap"), ("one.mcap", "two.bag"), ("two.bag", "two.mcap")):
        assert main(["--convert", str(tmp_path / source), str(tmp_path / target)]) == 0
        printed = capsys.readouterr()
        assert dict(line.split() for line in printed.out.splitlines()) == dict.fromkeys(sent, "1")
        assert ("/clock" in printed.err) == (source == "one.bag")
    for name in ("one.mcap", "two.mcap"):
        with open_log(tmp_path / name) as log:
            found = {topic: (message, info.log_ns) for topic, message, info in log.messages()}
        assert {topic: at_ns for topic, (_, at_ns) in found.items()} == times_ns
        assert np.array_equal(found["/drone/rgb"][0].data, picture)
        for topic, message in sent.items():
            assert found[topic][0].stamp_ns == message.stamp_ns
        assert np.allclose(found["/drone/imu"][0].angular_rate, 2 * THREE)


@pytest.mark.parametrize(
    ("source", "target"), [("a.bag", "b.mcap"), ("a.mcap", "b.bag"), ("a.mcap", "b.mcap")]
)
@pytest.mark.parametrize("error", [OSError("no space left"), KeyboardInterrupt()])
def test_half_a_conversion_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, target: str, error: BaseException
) -> None:
    """But what was there before stays."""
    imu = msg.Imu(5_000_000_000, THREE, THREE)
    with contextlib.closing(BagWriter(tmp_path / "a.bag")) as bag:
        bag.write("/drone/imu", imu)
    with LogWriter(tmp_path / "a.mcap") as log:
        log.write("/drone/imu", imu, 1)
    before = sorted(tmp_path.rglob("*"))
    real = {kind: kind.write for kind in (BagWriter, LogWriter)}
    for kind, write in real.items():

        def fail(*arguments: Any, write: Any = write, **options: Any) -> None:
            write(*arguments, **options)
            raise error

        monkeypatch.setattr(kind, "write", fail)
    assert main(["--convert", str(tmp_path / source), str(tmp_path / target)]) != 0
    assert main(["--convert", str(tmp_path / source), str(tmp_path / "a.mcap")]) != 0  # it is there
    assert sorted(tmp_path.rglob("*")) == before
