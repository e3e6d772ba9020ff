"""Bags of ROS 2: a flight there and back, by readers of others, and events as drivers send them."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from cortex.log import LogWriter
from cortex_ros2_bridge.typestore import typestore
from neurosim_core import cli
from neurosim_core.data import Dataset
from neurosim_core.io import EventFileError, open_events
from neurosim_core.live.messages import to_message
from neurosim_core.packets import Events, Image, ImuSample, Odometry
from neurosim_core.record import Recording, RecordingHeader, RecordingWriter
from neurosim_core.sensors.barometer import Pressure
from neurosim_core.sensors.event_labels import LabelledEvents

WIDTH, HEIGHT, STEP_NS = 64, 48, 10_000_000
BEGIN_NS = 17_000_000_000
"""Beyond the 16.8 s after which EVT3 begins to count again."""


def fly(path: Path) -> Path:
    """A recording of 0.2 s with every kind of packet that a bag can give back."""
    rng = np.random.default_rng(5)
    turn = np.array([0.1, 0.2, 0.3, 0.9]) / np.linalg.norm([0.1, 0.2, 0.3, 0.9])
    header = RecordingHeader(config_yaml="conversion: {}\n", seed=0, version="1", sensors=())
    with RecordingWriter(path, header) as writer:
        for step in range(1, 21):
            now_ns = BEGIN_NS + step * STEP_NS
            head = {"stamp_ns": now_ns, "sequence": step - 1}
            count = 0 if step == 3 else 300
            t = np.sort(rng.integers((now_ns - STEP_NS) // 1000 + 1, now_ns // 1000 + 1, count))
            x, y = (rng.integers(0, size, count).astype(np.uint16) for size in (WIDTH, HEIGHT))
            polarity = rng.integers(0, 2, count).astype(np.uint8)
            writer.write(
                Events(
                    **head, sensor="events", start_ns=now_ns - STEP_NS, width=WIDTH, height=HEIGHT,
                    t=t, x=x, y=y, polarity=polarity,
                )
            )  # fmt: skip
            force, rate, place, velocity = rng.normal(size=(4, 3))
            writer.write(ImuSample(**head, sensor="imu", specific_force=force, angular_rate=rate))
            state = {"position": place, "orientation": turn, "velocity": velocity, "body_rate": rate}
            writer.write(Odometry(**head, sensor="odometry", rotor_speed=np.zeros(4), **state))
            if step % 5 == 0:
                sequence = {**head, "sequence": step // 5 - 1}
                depth = rng.random((HEIGHT, WIDTH), np.float32)
                depth[0, 0] = np.inf
                flow = rng.random((HEIGHT, WIDTH, 2), np.float32)
                rgb = rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
                for name, data, encoding in (
                    ("depth", depth, "32FC1"),
                    ("flow", flow, "32FC2"),
                    ("rgb", rgb, "rgb8"),
                ):
                    writer.write(Image(**sequence, sensor=name, data=data, encoding=encoding))
    return path


def convert(*arguments: object) -> int:
    return cli.main(["convert", *map(str, arguments)])


def test_a_log_of_cortex_has_labelled_events(tmp_path):
    """Also where nothing has imported their class, nor that of another sensor."""
    columns = {
        "t": np.array([4001, 4500]),
        "x": np.array([1, 2], np.uint16),
        "y": np.array([3, 4], np.uint16),
    }
    columns |= {"polarity": np.array([0, 1], np.uint8), "depth": np.array([1.5, np.inf], np.float32)}
    none = {
        "instance": np.zeros(0, np.int32),
        "semantic": np.zeros(0, np.int32),
        "cause": np.zeros(0, np.uint8),
    }
    header = {"stamp_ns": 5_000_000, "start_ns": 4_000_000, "width": WIDTH, "height": HEIGHT, "labels": "{}"}
    events = LabelledEvents(**header, **columns, **none, flow=np.zeros((0, 2), np.float32))
    with LogWriter(tmp_path / "log.mcap") as log:
        log.write("/drone/cam", to_message(events), 1)
        log.write("/drone/air", to_message(Pressure(stamp_ns=5_000_000, pressure_pa=1e5)), 2)
    words = [sys.executable, "-m", "neurosim_core", "convert", "log.mcap", "log.h5"]
    environment = {**os.environ, "PYTHONPATH": str(Path(cli.__file__).parents[1])}
    subprocess.run(words, cwd=tmp_path, env=environment, check=True, timeout=120)
    with Recording(tmp_path / "log.h5") as recording:
        kept = [*recording.packets()]
    assert sum(packet.pressure_pa for packet in kept if isinstance(packet, Pressure)) == 1e5
    (found,) = (packet for packet in kept if isinstance(packet, Events))
    for name in ("t", "x", "y", "polarity"):
        np.testing.assert_array_equal(getattr(found, name), columns[name])


@pytest.mark.parametrize("name", ["flight.mcap", "bag", "flight.sqlite3"])
def test_a_flight_there_and_back(name, tmp_path):
    source = fly(tmp_path / "flight.h5")
    assert convert(source, tmp_path / name) == 0
    assert convert(tmp_path / name, tmp_path / "back.h5") == 0
    assert not list(tmp_path.glob(".*"))  # no unfinished copy is left
    with Recording(source) as one, Recording(tmp_path / "back.h5") as two:
        assert set(two.sensors) == set(one.sensors)
        for sensor, fields in {
            "events": ("t", "x", "y", "polarity"),
            "imu": ("stamp_ns", "sequence", "specific_force", "angular_rate"),
            "odometry": ("stamp_ns", "position", "orientation", "body_rate"),
            **dict.fromkeys(("depth", "flow", "rgb"), ("stamp_ns", "sequence", "data")),
        }.items():
            for field in fields:
                assert np.array_equal(one.column(sensor, field), two.column(sensor, field)), (sensor, field)
        velocities = (bag.column("odometry", "velocity") for bag in (one, two))
        assert np.allclose(*velocities, atol=1e-14)  # in a bag it is turned into the body frame


def test_windows_of_a_bag_are_those_of_the_recording(tmp_path):
    source = fly(tmp_path / "flight.h5")
    assert convert(source, tmp_path / "data" / "bag") == 1  # no such folder
    (tmp_path / "data").mkdir()
    assert convert(source, tmp_path / "data" / "bag") == 0
    one, two = Dataset(source, window_s=0.05), Dataset(tmp_path / "data", window_s=0.05)
    assert len(one) == len(two) == 4
    for a, b in zip(one, two, strict=True):
        assert np.array_equal(a.depth, b.depth)
        assert np.array_equal(a.flow, b.flow)
        assert np.array_equal(a.events.x, b.events.x)
        assert np.array_equal(a.events.t - a.start_ns // 1000, b.events.t - b.start_ns // 1000)


def test_a_library_of_others_decodes_it_by_the_schemas_inside(tmp_path):
    """As Foxglove does: by the text of the definitions in the file; EVT3 by a library for cameras."""
    read_ros2_messages = pytest.importorskip("mcap_ros2.reader").read_ros2_messages
    faery = pytest.importorskip("faery")
    assert convert(fly(tmp_path / "flight.h5"), tmp_path / "flight.mcap") == 0
    by_topic: dict[str, list] = {}
    for each in read_ros2_messages(str(tmp_path / "flight.mcap")):
        assert each.schema.encoding == "ros2msg"
        by_topic.setdefault(each.channel.topic, []).append(each)
    assert {"/drone/events", "/drone/imu", "/drone/odometry", "/drone/depth/image_raw", "/tf"} <= set(
        by_topic
    )
    with Recording(tmp_path / "flight.h5") as recording:
        forces = recording.column("imu", "specific_force")
        depths = recording.column("depth", "data")
        events = [recording.column("events", name) for name in ("t", "x", "y", "polarity")]
    imus = [each.ros_msg.linear_acceleration for each in by_topic["/drone/imu"]]
    assert np.array_equal([(v.x, v.y, v.z) for v in imus], forces)
    assert by_topic["/drone/imu"][0].log_time_ns == BEGIN_NS + STEP_NS
    picture = by_topic["/drone/depth/image_raw"][0].ros_msg
    assert (picture.width, picture.height, picture.encoding) == (WIDTH, HEIGHT, "32FC1")
    assert np.array_equal(np.frombuffer(bytes(picture.data), "<f4"), depths[0].reshape(-1))
    packets = [each.ros_msg for each in by_topic["/drone/events"]]
    assert {packet.encoding for packet in packets} == {"evt3"}
    raw = f"% evt 3.0\n% format EVT3;height={HEIGHT};width={WIDTH}\n% geometry {WIDTH}x{HEIGHT}\n% end\n"
    (tmp_path / "all.raw").write_bytes(raw.encode() + b"".join(bytes(p.events) for p in packets))
    found = np.concatenate([*faery.events_stream_from_file(tmp_path / "all.raw")])
    columns = [found[field] for field in found.dtype.names]
    assert np.array_equal(columns[0], events[0] % (1 << 24))  # 24 bits are in the packets
    for column, expected in zip(columns[1:], events[1:], strict=True):
        assert np.array_equal(column, expected)


def write_bag(path: Path, kind: str, messages: list[bytes]) -> Path:
    """A bag with one topic, by rosbags itself."""
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as bag:
        topic = bag.add_connection("/cam/events", kind, typestore=typestore())
        for number, message in enumerate(messages):
            bag.write(topic, number, message)
    return path


def head(second: int) -> bytes:
    """CDR up to the name of the frame, which has 3 letters: the next number is at a multiple of 4."""
    return b"\0\1\0\0" + struct.pack("<iII", second, 0, 4) + b"cam\0"


def test_dvs_msgs_of_others(tmp_path):
    """Written byte by byte: rows of x, y, time and polarity, aligned as CDR has it."""
    rows = [(3, 4, 7, 5000, 1), (60, 47, 7, 9999, 0), (0, 0, 8, 1000, 1)]
    body = head(7) + struct.pack("<III", HEIGHT, WIDTH, len(rows))
    for x, y, second, nanosecond, polarity in rows:
        body += struct.pack("<HH", x, y)
        body += bytes(-(len(body) - 4) % 4) + struct.pack("<iIB", second, nanosecond, polarity)
        body += bytes(-(len(body) - 4) % 2)
    bag = write_bag(tmp_path / "bag", "dvs_msgs/msg/EventArray", [body, body[:30]])
    reader = open_events(bag)
    assert (reader.width, reader.height) == (WIDTH, HEIGHT)
    with pytest.raises(EventFileError, match="/cam/events"):  # the second message is cut off
        list(reader.blocks())
    reader.close()
    claimed = head(7) + struct.pack("<III", HEIGHT, WIDTH, 2**32 - 1)  # would need 69 GB
    with pytest.raises(EventFileError, match="4294967295 events need more"):
        open_events(write_bag(tmp_path / "claiming_bag", "dvs_msgs/msg/EventArray", [claimed]))
    reader = open_events(write_bag(tmp_path / "whole_bag", "dvs_msgs/msg/EventArray", [body]))
    (events,) = reader.blocks()
    reader.close()
    assert events.t.tolist() == [7_000_005, 7_000_009, 8_000_001]
    assert list(zip(events.x.tolist(), events.y.tolist(), events.polarity.tolist(), strict=True)) == [
        (3, 4, 1),
        (60, 47, 0),
        (0, 0, 1),
    ]


def test_a_bag_of_ros_1(tmp_path):
    """Events written byte by byte: ROS 1 has no gaps, and a number at the begin of each header."""
    rows = [(3, 4, 7, 5000, 1), (60, 47, 7, 9999, 0), (0, 0, 8, 1000, 1)]
    events_body = struct.pack("<IIII3sIII", 9, 8, 0, 3, b"cam", HEIGHT, WIDTH, len(rows))
    events_body += b"".join(struct.pack("<HHIIB", *row) for row in rows)
    store = get_typestore(Stores.ROS1_NOETIC)
    made = {
        name.rpartition("/")[2]: kind for name, kind in store.types.items() if name != "std_msgs/msg/Time"
    }
    unknown = np.zeros(9)
    imu = made["Imu"](
        header=made["Header"](seq=1, stamp=made["Time"](sec=7, nanosec=2_000), frame_id="imu"),
        orientation=made["Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=unknown,
        angular_velocity=made["Vector3"](x=1.0, y=2.0, z=3.0),
        angular_velocity_covariance=unknown,
        linear_acceleration=made["Vector3"](x=4.0, y=5.0, z=6.0),
        linear_acceleration_covariance=unknown,
    )
    with Ros1Writer(tmp_path / "davis.bag") as writer:
        text = "std_msgs/Header header\nuint32 height\nuint32 width\nEvent[] events\n" + "=" * 80
        text += "\nMSG: dvs_msgs/Event\nuint16 x\nuint16 y\ntime ts\nbool polarity\n"
        camera = writer.add_connection(
            "/dvs/events", "dvs_msgs/msg/EventArray", msgdef=text, md5sum="5e8beee5"
        )
        inertial = writer.add_connection("/dvs/imu", "sensor_msgs/msg/Imu", typestore=store)
        writer.write(camera, 8_000_000_000, events_body)
        writer.write(inertial, 8_000_000_001, store.serialize_ros1(imu, "sensor_msgs/msg/Imu"))
    reader = open_events(tmp_path / "davis.bag")
    (events,) = reader.blocks()
    (sample,) = reader.packets()
    reader.close()
    assert (reader.width, reader.height) == (WIDTH, HEIGHT)
    assert events.t.tolist() == [7_000_005, 7_000_009, 8_000_001]
    assert list(zip(events.x.tolist(), events.y.tolist(), events.polarity.tolist(), strict=True)) == [
        (3, 4, 1),
        (60, 47, 0),
        (0, 0, 1),
    ]
    assert (sample.sensor, sample.stamp_ns) == ("imu", 7_000_002_000)
    assert sample.specific_force.tolist() == [4.0, 5.0, 6.0]
    assert sample.angular_rate.tolist() == [1.0, 2.0, 3.0]


def test_drivers_stamp_by_another_clock(tmp_path):
    """Then time is that of the sensor, its wraps counted from packet to packet."""

    def packet(second: int, *words: int) -> bytes:
        body = head(second) + struct.pack("<II", HEIGHT, WIDTH)
        body += bytes(-(len(body) - 4) % 8) + struct.pack("<QQ", 0, 0)
        body += struct.pack("<I", 5) + b"evt3\0" + b"\0"
        body += bytes(-(len(body) - 4) % 4) + struct.pack("<I", 2 * len(words))
        return body + struct.pack(f"<{len(words)}H", *words)

    first = packet(1_700_000_000, 0x8FFF, 0x6001, 0x0005, 0x2803)  # the last high half, 1 us, row 5, column 3
    second = packet(1_700_000_001, 0x8000, 0x6002, 0x0006, 0x2004)  # wrapped
    reader = open_events(write_bag(tmp_path / "bag", "event_camera_msgs/msg/EventPacket", [first, second]))
    (events,) = reader.blocks()
    reader.close()
    assert events.t.tolist() == [0xFFF001, (1 << 24) + 2]
    assert events.x.tolist() == [3, 4]
    assert events.y.tolist() == [5, 6]
    assert events.polarity.tolist() == [1, 0]


def test_what_is_no_bag(tmp_path):
    (tmp_path / "bag").mkdir()
    with pytest.raises(EventFileError, match="bag"):
        open_events(tmp_path / "bag")
    (tmp_path / "bag" / "metadata.yaml").write_text("rosbag2_bagfile_information: 3\n")
    with pytest.raises(EventFileError, match="not a readable bag"):
        open_events(tmp_path / "bag")
    with pytest.raises(EventFileError, match="no event camera 'left'"):
        open_events(write_bag(tmp_path / "one_bag", "sensor_msgs/msg/Imu", []), sensor="left")
