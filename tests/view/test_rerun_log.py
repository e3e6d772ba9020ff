"""Rerun recordings, read back from the file."""

from __future__ import annotations

import dataclasses
import io
import sys
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
import rerun as rr
import rerun.chunk
import trimesh
from rerun_file import read, scalars
from scipy.spatial.transform import Rotation
from test_plan import make_scene

from neurosim_core.packets import Collision, Delivery, EventArrays, Events, Image, ImuSample, Odometry, Packet
from neurosim_core.record import Intrinsics, SensorDescription
from neurosim_core.scene.bodies import BodyConfig, MotionConfig, make_bodies
from neurosim_core.scene.body_shapes import CheckerSurface, SphereShape
from neurosim_core.scene.scene import Material, Texture
from neurosim_core.view.pictures import PALETTE, event_classes, event_picture
from neurosim_core.view.rerun_log import RerunLogger
from neurosim_core.view.rerun_sdk import RerunStream
from neurosim_core.view.rerun_shapes import class_colors, encode_classes, encode_picture, scene_shapes

MS = 1_000_000
LENS = Intrinsics(width=32, height=24, fx=30.0, fy=31.0, cx=16.0, cy=12.0)


def describe(name: str, kind: str, *, lens: Intrinsics | None = None) -> SensorDescription:
    return SensorDescription(
        name=name,
        kind=kind,
        rate_hz=100.0,
        position=np.array([0.1, 0.0, 0.03]),
        orientation=np.array([-0.5, 0.5, -0.5, 0.5]),
        intrinsics=lens,
    )


SENSORS = (
    describe("dvs", "event_camera", lens=LENS),
    describe("rgb", "rgb", lens=LENS),
    describe("z", "depth", lens=LENS),
    describe("imu", "imu"),
    describe("truth", "odometry"),
)
NOTHING: dict[str, tuple[SensorDescription, ...]] = {"drone": ()}


def make_events(k: int, count: int = 50) -> Events:
    rng = np.random.default_rng(k)
    return Events(
        stamp_ns=(k + 1) * 10 * MS,
        start_ns=k * 10 * MS,
        sensor="dvs",
        t=np.sort(rng.integers(k * 10_000 + 1, (k + 1) * 10_000 + 1, count)),
        x=rng.integers(0, 32, count).astype(np.uint16),
        y=rng.integers(0, 24, count).astype(np.uint16),
        polarity=rng.integers(0, 2, count).astype(np.uint8),
        width=32,
        height=24,
    )


def make_odometry(k: int) -> Odometry:
    return Odometry(
        stamp_ns=k * 5 * MS + 1,
        sensor="truth",
        position=np.array([0.1 * k, 1.0, 2.0]),
        orientation=np.array([0.0, 0.0, 0.0, 1.0]),
        velocity=np.array([3.0, 4.0, 0.0]),
        body_rate=np.zeros(3),
        rotor_speed=np.arange(4.0) + k,
    )


def make_imu(k: int) -> ImuSample:
    return ImuSample(
        stamp_ns=k * 2 * MS + 1,
        sensor="imu",
        specific_force=np.array([k, 0.0, 9.81]),
        angular_rate=np.arange(3.0),
    )


def make_image(stamp_ns: int, sensor: str = "rgb") -> Image:
    return Image(stamp_ns=stamp_ns, sensor=sensor, data=np.full((24, 32, 3), 90, np.uint8), encoding="rgb8")


def record(
    path: Path, packets: list[Packet], **options: Any
) -> dict[str, list[tuple[int | None, dict[str, Any]]]]:
    with RerunLogger(RerunStream(path), vehicles={"drone": SENSORS}, **options) as logger:
        for packet in packets:
            logger.log(packet)
    return read(path)


def test_scalars_and_poses_are_read_back(tmp_path):
    """Every sample, at its nanosecond."""
    packets: list[Packet] = [*(make_odometry(k) for k in range(50)), *(make_imu(k) for k in range(130))]
    rows = record(tmp_path / "f.rrd", sorted(packets, key=lambda p: p.stamp_ns))
    force = [(t, v["scalars"]) for t, v in rows["/plots/drone/imu/specific_force"] if t is not None]
    assert force == [(k * 2 * MS + 1, [k, 0.0, 9.81]) for k in range(130)]
    speed = [(t, v["scalars"]) for t, v in rows["/plots/drone/truth/speed"] if t is not None]
    assert speed == [(k * 5 * MS + 1, [5.0]) for k in range(50)]
    rotors = [v["scalars"] for t, v in rows["/plots/drone/truth/rotor_speed"] if t is not None]
    assert rotors == [[k, k + 1.0, k + 2.0, k + 3.0] for k in range(50)]
    poses = [(t, v["translation"]) for t, v in rows["/world/vehicles/drone"] if t is not None]
    assert [t for t, _ in poses] == [k * 5 * MS + 1 for k in range(50)]
    assert np.array([p[0] for _, p in poses])[:, 0] == pytest.approx(0.1 * np.arange(50), rel=1e-6)  # float32
    strokes = [v["strips"][0] for _, v in rows["/world/trails/drone"]]
    assert [stroke[0] for stroke in strokes[1:]] == [stroke[-1] for stroke in strokes[:-1]]
    trail = np.concatenate([stroke[1:] for stroke in strokes])
    assert trail[:, 0] == pytest.approx(0.1 * np.arange(50), rel=1e-6)
    assert 4 <= len(strokes) <= 6  # one per 50 ms


def test_events_become_one_picture_per_window(tmp_path):
    """Two packets of 10 ms make a window of 20 ms; its picture is the one of event_picture, without loss."""
    packets = [make_events(k) for k in range(6)]
    rows = record(tmp_path / "f.rrd", list(packets))["/world/vehicles/drone/dvs/image"]
    assert [t for t, _ in rows] == [20 * MS, 40 * MS, 60 * MS]
    for k, (_, values) in enumerate(rows):
        joined = EventArrays(
            *(
                np.concatenate(columns)
                for columns in zip(*(p.numpy() for p in packets[2 * k : 2 * k + 2]), strict=True)
            )
        )
        with PIL.Image.open(io.BytesIO(bytes(values["blob"][0]))) as found:
            assert (np.asarray(found.convert("RGB")) == event_picture(joined, width=32, height=24)).all()


def test_labels_and_flow_lie_over_a_colour_camera_with_the_same_view(tmp_path):
    """Each is logged once: below that camera, half transparent; other lenses stay cameras of their own."""
    wide = dataclasses.replace(LENS, fx=20.0)
    kinds = {"ids": "instance", "flow": "optical_flow", "z": "depth"}
    sensors = [describe("rgb", "rgb", lens=LENS), *(describe(n, k, lens=LENS) for n, k in kinds.items())]
    sensors.append(describe("wide", "instance", lens=wide))
    labels = np.ones((24, 32), dtype=np.int32)
    flow = np.ones((24, 32, 2), dtype=np.float32)
    packets = [make_image(0)]
    packets += [Image(sensor=name, data=labels, encoding="32SC1") for name in ("ids", "wide")]
    packets.append(Image(sensor="flow", data=flow, encoding="32FC2"))
    with RerunLogger(RerunStream(tmp_path / "f.rrd"), vehicles={"drone": tuple(sensors)}) as logger:
        for packet in packets:
            logger.log(packet)
    rows = read(tmp_path / "f.rrd")
    at = "/world/vehicles/drone"
    pictures = {entity.removeprefix(f"{at}/"): found for entity, found in rows.items() if "image" in entity}
    assert sorted(pictures) == ["rgb/flow/image", "rgb/ids/image", "rgb/image", "wide/image"]
    opacity = {name: found[0][1].get("opacity") for name, found in pictures.items()}
    assert opacity["rgb/ids/image"] == opacity["rgb/flow/image"] == [0.5]
    assert opacity["wide/image"] == [1.0]
    assert f"{at}/rgb/flow/arrows" in rows
    cameras = [e for e, found in rows.items() if any("image_from_camera" in values for _, values in found)]
    assert sorted(cameras) == [f"{at}/rgb", f"{at}/wide", f"{at}/z"]


def test_cameras_are_described(tmp_path):
    rows = record(tmp_path / "f.rrd", [])
    for name in ("dvs", "rgb", "z"):
        values: dict[str, Any] = {}
        for stamp_ns, part in rows[f"/world/vehicles/drone/{name}"]:
            assert stamp_ns is None
            values |= {key: value for key, value in part.items() if value is not None}
        assert values["resolution"] == [[32.0, 24.0]]
        assert values["image_from_camera"] == [
            [30.0, 0.0, 0.0, 0.0, 31.0, 0.0, 16.0, 12.0, 1.0]
        ]  # column by column
        assert values["quaternion"] == [[-0.5, 0.5, -0.5, 0.5]]
        assert values["translation"][0] == pytest.approx([0.1, 0.0, 0.03], rel=1e-6)  # float32
    assert len(rerun.chunk.RrdReader(tmp_path / "f.rrd").blueprints()) == 1


def test_image_rate_is_limited_per_sensor(tmp_path):
    packets = [make_image(k * 10 * MS, sensor) for k in range(21) for sensor in ("rgb", "other")]
    packets.append(make_image(0))  # after a reset time starts again, and the first picture is shown
    rows = record(tmp_path / "f.rrd", list(packets), image_rate_max_hz=20.0)
    assert [t for t, _ in rows["/world/vehicles/drone/rgb/image"]] == [
        0,
        0,
        50 * MS,
        100 * MS,
        150 * MS,
        200 * MS,
    ]
    assert [t for t, _ in rows["/world/vehicles/drone/other/image"]] == [
        0,
        50 * MS,
        100 * MS,
        150 * MS,
        200 * MS,
    ]


def test_collisions_clearance_and_path(tmp_path):
    path = np.arange(9.0).reshape(3, 3)
    with RerunLogger(RerunStream(tmp_path / "f.rrd"), vehicles=NOTHING) as logger:
        logger.log_path(path)
        logger.log(
            Collision(stamp_ns=7, sensor="collision", position=np.array([1.0, 2.0, 3.0]), clearance_m=-0.1)
        )
        logger.log_values("plots/drone/clearance", 5, {"clearance": 0.25})
    rows = read(tmp_path / "f.rrd")
    assert [(t, v["positions"]) for t, v in rows["/world/collisions/drone"]] == [(7, [[1.0, 2.0, 3.0]])]
    [(stamp_ns, line)] = rows["/plots/drone/collisions"]
    assert stamp_ns == 7
    assert "at (1.00, 2.00, 3.00) m" in str(line)
    assert [(t, v["scalars"]) for t, v in rows["/plots/drone/clearance"] if t is not None] == [(5, [0.25])]
    assert rows["/world/paths/drone"][0][1]["strips"] == [path.tolist()]


def test_depth_is_in_millimetres_and_zero_is_nothing():
    depth = np.array([[0.5, 1.2345], [np.inf, 100.0]], dtype=np.float32)
    encoded = encode_picture(Image(data=depth, encoding="32FC1"))
    assert encoded.meter.as_arrow_array().to_pylist() == [1000.0]
    blob = encoded.blob.as_arrow_array()[0].as_py()
    with PIL.Image.open(io.BytesIO(bytes(blob))) as found:
        assert np.asarray(found).tolist() == [[500, 1235], [0, 65535]]


def test_pictures_for_a_viewer_are_not_compressed():
    """Raw pixels, depth in millimetres, events as classes that have their colours."""
    data = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    raw = encode_picture(Image(data=data, encoding="rgb8"), compress=False)
    assert raw.buffer.as_arrow_array().to_pylist() == [data.ravel().tolist()]
    depth = np.array([[0.5, np.inf], [1.0, 70.0]], dtype=np.float32)
    encoded = encode_picture(Image(data=depth, encoding="32FC1"), compress=False)
    assert encoded.meter.as_arrow_array().to_pylist() == [1000.0]
    found = bytes(encoded.buffer.as_arrow_array()[0].as_py())
    assert np.frombuffer(found, np.uint16).tolist() == [500, 0, 1000, 65535]

    events = make_events(0).numpy()
    drawn = encode_classes(event_classes(events, width=32, height=24), PALETTE, compress=False)
    classes = drawn.buffer.as_arrow_array()[0].as_py()
    context = class_colors(PALETTE, ("1", "2", "3", "4 or more events")).context
    infos = [item["class_description"]["info"] for item in context.as_arrow_array()[0].as_py()]
    palette = {info["id"]: tuple(info["color"].to_bytes(4, "big")[:3]) for info in infos}
    picture = np.array([palette[k] for k in classes], dtype=np.uint8).reshape(24, 32, 3)
    assert (picture == event_picture(events, width=32, height=24)).all()
    assert [info["label"] for info in infos][8] == "brighter, 4 or more events"


def test_several_vehicles_are_kept_apart(tmp_path):
    """Each has its pose, plots and path; a packet without a vehicle is of the first."""
    vehicles = {"alpha": SENSORS, "beta": SENSORS}
    with RerunLogger(RerunStream(tmp_path / "f.rrd"), vehicles=vehicles) as logger:
        logger.log(make_odometry(1))
        logger.log(make_odometry(2), vehicle="beta")
        logger.log(make_events(0), vehicle="beta")
        logger.log(make_events(1), vehicle="beta")
        logger.log_path(np.eye(3), vehicle="beta")
    rows = read(tmp_path / "f.rrd")
    for name, k in (("alpha", 1), ("beta", 2)):
        poses = [v["translation"][0][0] for t, v in rows[f"/world/vehicles/{name}"] if t is not None]
        assert poses == pytest.approx([0.1 * k], rel=1e-6)
        assert len(rows[f"/world/trails/{name}"]) == 1
        assert len(scalars(rows, f"/plots/{name}/truth/speed")) == 1
    assert len(rows["/world/vehicles/beta/dvs/image"]) == 1
    assert "/world/vehicles/alpha/dvs/image" not in rows
    assert "/world/paths/alpha" not in rows
    assert "/world/paths/beta" in rows
    with pytest.raises(ValueError, match="at least one vehicle"):
        RerunLogger(RerunStream(), vehicles={})


def test_the_pose_comes_from_one_sensor(tmp_path):
    """A second odometry, which a link may hold up, does not make the vehicle jump."""
    sensors = (*SENSORS, describe("odometry", "odometry"))
    with RerunLogger(RerunStream(tmp_path / "f.rrd"), vehicles={"drone": sensors}) as logger:
        for k in range(5):
            logger.log(make_odometry(k))  # which comes first
            if k:
                logger.log(dataclasses.replace(make_odometry(k), sensor="odometry"))
    rows = read(tmp_path / "f.rrd")
    assert len([t for t, _ in rows["/world/vehicles/drone"] if t is not None]) == 4
    assert len(scalars(rows, "/plots/drone/truth/speed")) == 5


def test_commands_are_plotted(tmp_path):
    """An attitude as angles: roll, then pitch, then yaw, as SciPy has them."""
    angles = np.array([0.3, -0.4, 2.0])
    attitude = Rotation.from_euler("ZYX", angles[::-1]).as_quat()
    with RerunLogger(RerunStream(tmp_path / "f.rrd"), vehicles=NOTHING) as logger:
        logger.log_command("attitude", 1, [5.0, *(3.0 * attitude)])
        logger.log_command("attitude", 2, [5.0, 0.0, 0.0, 0.0, 0.0])
        logger.log_command("motor_speeds", 3, np.arange(6))
        logger.log_command("position", 4, [1.0, 2.0, 3.0, 0.5])
    rows = read(tmp_path / "f.rrd")
    (_, first), (_, second) = scalars(rows, "/plots/drone/command/attitude")
    assert first == pytest.approx([5.0, *angles], rel=1e-12)
    assert second[0] == 5.0
    assert np.isnan(second[1:]).all()
    assert scalars(rows, "/plots/drone/command/motor_speeds") == [(3, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0])]
    names = next(v["names"] for t, v in rows["/plots/drone/command/position"] if t is None)
    assert names == ["x [m]", "y [m]", "z [m]", "yaw [rad]"]


def test_deliveries_are_plotted_as_delays(tmp_path):
    """In milliseconds, by link; what was lost is a gap."""
    with RerunLogger(RerunStream(tmp_path / "f.rrd"), vehicles=NOTHING) as logger:
        for stamp_ns, delivered_ns in ((10 * MS, 18 * MS), (20 * MS, -1)):
            logger.log(
                Delivery(stamp_ns=stamp_ns, sensor="imu_link", delivered_ns=delivered_ns, size_bytes=40)
            )
    (first, lost) = scalars(read(tmp_path / "f.rrd"), "/plots/drone/links/imu")
    assert first == (10 * MS, [8.0])
    assert np.isnan(lost[1][0])


def test_live_is_sent_when_told_and_limited_by_the_wall_clock(tmp_path):
    """Rows wait for `send`, or for 1024 of their kind; pictures pass by wall-clock time, not by stamps."""
    now_ns = 0
    logger = RerunLogger(
        RerunStream(tmp_path / "f.rrd", footer=False),
        vehicles={"drone": SENSORS},
        image_rate_max_hz=10.0,
        live=True,
        clock_ns=lambda: now_ns,
    )
    with logger:
        for k in range(1500):
            logger.log(make_imu(k))
            assert len(logger._tables["plots/drone/imu/angular_rate"]._stamp_ns) == (k + 1) % 1024
        logger.send()
        assert not logger._tables["plots/drone/imu/angular_rate"]._stamp_ns
        for k in range(201):  # a picture every 30 ms of wall-clock time
            now_ns = k * 30 * MS
            logger.log(make_image(k))
        for k in range(2, 2000):  # events of 20 s, at once
            logger.log(make_events(k, count=3))
    rows = read(tmp_path / "f.rrd")
    assert len(scalars(rows, "/plots/drone/imu/angular_rate")) == 1500
    shown = np.array([t for t, _ in rows["/world/vehicles/drone/rgb/image"]]) * 30
    assert len(shown) == 61  # 10 a second during 6 s, though none comes at 100 ms
    assert np.diff(shown).min() >= 90
    assert len(rows["/world/vehicles/drone/dvs/image"]) == 26  # those of the first half second


def test_scene_is_split_by_material_and_ceiling():
    """Triangles are the scene's, vertices only those in use, v counts from the top, textures are small."""
    floor = trimesh.creation.box(extents=(4, 4, 0.2))
    ceiling = trimesh.creation.box(extents=(4, 4, 0.2)).apply_translation((0, 0, 2.5))
    mesh = trimesh.util.concatenate([floor, ceiling])
    texture = Texture(name="t", srgb=np.zeros((512, 1024, 3), np.uint8))
    scene = make_scene(
        mesh,
        uv=np.tile(np.float32([0.25, 0.75]), (16, 1)),
        materials=(Material(name="a", base_color=(1.0, 0.0, 0.0), texture=texture), Material(name="b")),
        face_material=np.repeat([0, 1], 12).astype(np.int32),
    )
    shapes = scene_shapes(scene)
    meshes = dict(shapes.meshes)
    assert (shapes.bounds_m == scene.bounds_m).all()
    assert sorted(meshes) == ["world/scene/ceiling/1", "world/scene/room/0"]
    for part, first in (("world/scene/room/0", 0), ("world/scene/ceiling/1", 12)):
        vertices = np.array(meshes[part].vertex_positions.as_arrow_array().to_pylist())
        triangles = np.array(meshes[part].triangle_indices.as_arrow_array().to_pylist())
        assert len(vertices) == 8
        assert (vertices[triangles] == mesh.triangles[first : first + 12].astype(np.float32)).all()
    room = meshes["world/scene/room/0"]
    assert room.vertex_texcoords.as_arrow_array().to_pylist() == [[0.25, 0.25]] * 8
    assert room.albedo_texture_format.as_arrow_array().to_pylist()[0]["width"] == 256
    assert room.albedo_factor.as_arrow_array().to_pylist() == [0xFF0000FF]


def test_bodies_move_with_the_stamps_of_the_first_vehicle(tmp_path):
    """A mesh once, in the frame of the body; a pose at each stamp of odometry, its function of time."""
    motion = MotionConfig(
        position_m=(1.0, 2.0, 3.0), velocity_m_s=(0.5, 0.0, 0.0), spin_rad_s=(0.0, 0.0, 2.0)
    )
    ball = BodyConfig(shape=SphereShape(radius_m=0.5), surface=CheckerSurface(), motion=motion)
    waiting = ball.model_copy(update={"present": False})
    bodies = make_bodies({"ball": ball, "waiting": waiting})
    shapes = scene_shapes(make_scene(trimesh.creation.box((4, 4, 4))), bodies)
    assert list(shapes.bodies) == ["ball"]
    rows = record(tmp_path / "f.rrd", [make_odometry(k) for k in range(50)], scene=shapes)
    mesh = [values for t, values in rows["/world/bodies/ball/0"] if t is None]
    assert len(mesh) == 1
    assert np.linalg.norm(mesh[0]["vertex_positions"], axis=1) == pytest.approx(0.5, rel=1e-6)
    assert "albedo_texture_buffer" in mesh[0]
    poses = rows["/world/bodies/ball"]
    assert [t for t, _ in poses] == [k * 5 * MS + 1 for k in range(50)]
    for t, values in poses:
        assert values["translation"][0] == pytest.approx([1.0 + 0.5e-9 * t, 2.0, 3.0], rel=1e-6)  # float32
        assert values["quaternion"][0] == pytest.approx(
            [0.0, 0.0, np.sin(1e-9 * t), np.cos(1e-9 * t)], abs=1e-6
        )


def test_memory_is_bounded(tmp_path):
    """Rows wait for at most 50 ms or 1024 rows."""
    with RerunLogger(RerunStream(tmp_path / "f.rrd"), vehicles=NOTHING) as logger:
        for k in range(3000):
            sample = make_imu(k)
            logger.log(
                ImuSample(
                    stamp_ns=k,
                    sensor="imu",
                    specific_force=sample.specific_force,
                    angular_rate=sample.angular_rate,
                )
            )
            assert all(len(table._stamp_ns) < 1024 for table in logger._tables.values())
    rows = read(tmp_path / "f.rrd")["/plots/drone/imu/specific_force"]
    assert [t for t, _ in rows if t is not None] == list(range(3000))


def test_wrong_input_is_refused(tmp_path):
    strange = Image(data=np.zeros((2, 2), np.int32), encoding="64FC9")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="encoding '64FC9', known: rgb8, mono8, rgb16"):
        encode_picture(strange)
    with pytest.raises(ValueError, match=r"no field of shape \[H, W\]"):
        encode_picture(make_imu(0))
    with pytest.raises(OSError, match=r"cannot write .*nowhere"):
        RerunStream(tmp_path / "nowhere" / "f.rrd")


def test_missing_rerun_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    for call in (RerunStream, lambda: class_colors(PALETTE, "1234")):
        with pytest.raises(ImportError, match=r"pip install -e '\.\[view\]'"):
            call()


def test_no_wall_clock_is_recorded(tmp_path):
    """Files of equal flights differ in nothing but identifiers."""
    record(tmp_path / "f.rrd", [make_imu(0), make_image(0)])
    names = set()
    for chunk in rerun.chunk.RrdReader(tmp_path / "f.rrd").stream():
        names |= set(chunk.timeline_names)
    assert names == {"sim_time"}
    assert rr.get_global_data_recording() is None  # nothing was made the default of the process
