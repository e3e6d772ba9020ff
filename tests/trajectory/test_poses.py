"""Motions from files: what is in a row, what is between rows, and what an IMU and a camera make of it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

import neurosim_core as ns
from neurosim_core.trajectory import PosesConfig
from neurosim_core.trajectory.poses import pose_path, read_poses

COUNT = 12
TIMES_S = np.cumsum(np.random.default_rng(0).uniform(0.05, 0.15, COUNT)) + 1.7e9  # as of a clock
POSITIONS = np.random.default_rng(1).uniform(-0.5, 0.5, (COUNT, 3)) + np.array([0.0, 0.0, 1.2])
ROTATIONS = Rotation.from_euler("zyx", np.cumsum(np.random.default_rng(2).uniform(-0.6, 0.6, (COUNT, 3)), 0))
SENSORS = {
    "odometry": {"kind": "odometry", "rate_hz": 100.0},
    "imu": {
        "kind": "imu",
        "rate_hz": 100.0,
        "mount": {"position_m": [0.1, -0.05, 0.2], "rpy_rad": [0.3, 0.1, 0.2]},
    },
}


def write(folder, kind):
    """Write the poses in a format; return the file."""
    q = ROTATIONS.as_quat()
    file = folder / f"poses.{kind}"
    if kind == "euroc":
        rows = ["#timestamp [ns],p_x,p_y,p_z,q_w,q_x,q_y,q_z,v_x"]
        for time_s, p, (x, y, z, w) in zip(TIMES_S, POSITIONS, q, strict=True):
            numbers = ",".join(repr(float(v)) for v in (*p, w, x, y, z, 0.0))
            rows.append(f"{round(time_s * 1e9)},{numbers}")
        file.write_text("\n".join(rows))
    else:
        gap = " " if kind == "tum" else ","
        rows = [gap.join(repr(float(v)) for v in row) for row in np.column_stack([TIMES_S, POSITIONS, q])]
        head = "# tum" if kind == "tum" else "t,x,y,z,qx,qy,qz,qw"
        file.write_text("\n".join([head, *rows]))
    return file


def settings(path, **more):
    common = {"duration_s": 1.0, "device": "cpu", "scene": {"kind": "hall", "size_m": [8, 6, 3]}}
    return {**common, "path": {"kind": "poses", **path}, "sensors": SENSORS, **more}


@pytest.mark.parametrize("kind", ["tum", "euroc", "csv"])
def test_files_of_all_formats_give_their_poses(tmp_path, kind):
    path = pose_path(PosesConfig(file=write(tmp_path, kind), format=kind))
    expected = np.rint((TIMES_S - TIMES_S[0]) * 1e9)
    # seconds of 1.7e9 in float64 are 2.4e-7 apart; nanoseconds are read as they are
    np.testing.assert_allclose(path.knots_ns, expected, atol=500)
    np.testing.assert_allclose(path.evaluate(path.knots_ns).position, POSITIONS, atol=1e-12)


def write_bag(file, kinds):
    """Write the poses to a bag of ROS 2, on a topic for each type of message."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    vector, point = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Point"]
    turn = types["geometry_msgs/msg/Quaternion"]
    with rosbag2.Writer(file, version=9) as writer:
        for kind in kinds:
            name = f"{'nav' if kind == 'Odometry' else 'geometry'}_msgs/msg/{kind}"
            connection = writer.add_connection(f"/{kind.lower()}", name, typestore=store)
            for time_s, p, q in zip(TIMES_S, POSITIONS, ROTATIONS.as_quat(), strict=True):
                stamp_ns = round(time_s * 1e9)
                stamp = types["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
                header = types["std_msgs/msg/Header"](stamp, "map")
                pose = types["geometry_msgs/msg/Pose"](point(*p), turn(*q))
                if kind == "PoseStamped":
                    message = types[name](header, pose)
                elif kind == "TransformStamped":
                    message = types[name](
                        header, "rig", types["geometry_msgs/msg/Transform"](vector(*p), turn(*q))
                    )
                else:
                    still = types["geometry_msgs/msg/Twist"](vector(0, 0, 0), vector(0, 0, 0))
                    spread = np.zeros(36)
                    message = types[name](
                        header,
                        "rig",
                        types["geometry_msgs/msg/PoseWithCovariance"](pose, spread),
                        types["geometry_msgs/msg/TwistWithCovariance"](still, spread),
                    )
                writer.write(connection, stamp_ns, store.serialize_cdr(message, name))
    return file


@pytest.mark.parametrize("kind", ["PoseStamped", "TransformStamped", "Odometry"])
def test_a_bag_gives_the_poses_of_its_messages(tmp_path, kind):
    path = pose_path(PosesConfig(file=write_bag(tmp_path / "bag", [kind]), format="bag"))
    np.testing.assert_allclose(path.knots_ns, np.rint((TIMES_S - TIMES_S[0]) * 1e9), atol=500)
    np.testing.assert_allclose(path.evaluate(path.knots_ns).position, POSITIONS, atol=1e-12)


def test_a_bag_with_several_poses_asks_which(tmp_path):
    bag = write_bag(tmp_path / "bag", ["PoseStamped", "Odometry"])
    with pytest.raises(ValueError, match="with poses: /odometry, /posestamped"):
        pose_path(PosesConfig(file=bag, format="bag"))
    path = pose_path(PosesConfig(file=bag, format="bag", topic="/odometry"))
    assert len(path.knots_ns) == COUNT
    with pytest.raises(ValueError, match="cannot read"):
        pose_path(PosesConfig(file=tmp_path / "none", format="bag"))


def test_a_rig_follows_splines_and_its_imu_feels_them(tmp_path):
    """Against SciPy's splines, with accelerations by central differences of their rotations."""
    packets = list(ns.run(settings({"file": str(write(tmp_path, "csv")), "format": "csv"})))
    knots_s = np.rint((TIMES_S - TIMES_S[0]) * 1e9) / 1e9
    place, turn = CubicSpline(knots_s, POSITIONS), RotationSpline(knots_s, ROTATIONS)
    odometry = [packet for packet in packets if packet.sensor == "odometry"]
    times_s = np.array([packet.stamp_ns for packet in odometry]) / 1e9
    inside = times_s < knots_s[-1]
    assert inside.sum() > 50
    q = Rotation.from_quat([packet.orientation for packet in odometry])
    np.testing.assert_allclose(
        np.array([p.position for p in odometry])[inside], place(times_s[inside]), atol=1e-12
    )
    assert (q[inside].inv() * turn(times_s[inside])).magnitude().max() < 1e-12
    rate_B = np.array([p.body_rate for p in odometry])[inside]
    half_s = 1e-5
    step = turn(times_s[inside] - half_s).inv() * turn(times_s[inside] + half_s)
    # central differences: second order, 1e-10 times the third derivative; none across a knot, or the ends
    away = np.abs(times_s[inside][:, None] - knots_s).min(axis=1) > half_s
    np.testing.assert_allclose(rate_B[away], (step.as_rotvec() / (2.0 * half_s))[away], atol=1e-6)

    mount = SENSORS["imu"]["mount"]
    R_BS, r_B = Rotation.from_euler("xyz", mount["rpy_rad"]), np.array(mount["position_m"])

    def imu_position(t):
        return place(t) + turn(t).apply(r_B)

    step_s = 1e-4
    checked = 0
    for packet in (packet for packet in packets if packet.sensor == "imu"):
        t = packet.stamp_ns / 1e9
        if np.abs(knots_s - t).min() < 2.0 * step_s or not knots_s[0] < t < knots_s[-1]:
            continue
        R_WS = turn(t) * R_BS
        second = imu_position(t + step_s) - 2.0 * imu_position(t) + imu_position(t - step_s)
        force = R_WS.inv().apply(second / step_s**2 + [0.0, 0.0, 9.81])
        # the difference is second order, 1e-8 times the fourth derivative, and has rounding of 1e-16 / 1e-8
        np.testing.assert_allclose(packet.specific_force, force, atol=1e-3)
        rotated = (turn(t - step_s).inv() * turn(t + step_s)).as_rotvec() / (2.0 * step_s)
        np.testing.assert_allclose(packet.angular_rate, R_BS.inv().apply(rotated), atol=1e-4)
        checked += 1
    assert checked > 50


def test_after_the_last_pose_the_rig_rests(tmp_path):
    frames = [{"time_s": t, "position_m": [t, 0.0, 1.0]} for t in (0.0, 0.1, 0.2)]
    *_, last = (p for p in ns.run(settings({"keyframes": frames})) if p.sensor == "odometry")
    np.testing.assert_allclose(last.position, [0.2, 0.0, 1.0], atol=1e-12)
    assert not last.velocity.any()
    assert not last.rotor_speed.any()


def test_a_camera_sees_from_poses_of_its_optical_frame():
    """It looks down along -z in W from 2 m: depth is 2 m, or less where something stands on the floor."""
    down = [np.pi, 0.0, 0.0]
    frames = [{"time_s": t, "position_m": [0.1 * t, 0.0, 1.0], "rpy_rad": down} for t in (0.0, 1.0)]
    lens = {"width": 16, "height": 12, "horizontal_fov_rad": 0.2}
    camera = {"kind": "depth", "rate_hz": 10.0, "lens": lens, "mount": {"position_m": [0.0, 0.0, 0.0]}}
    config = settings({"keyframes": frames, "frame": "optical"}, duration_s=0.1)
    config["sensors"] = {"depth": camera}
    for packet in ns.run(config):
        assert packet.data.max() == pytest.approx(1.0, abs=1e-5)


def test_worlds_follow_as_a_single_run_does(tmp_path):
    config = settings({"file": str(write(tmp_path, "csv")), "format": "csv"}, control={"rate_hz": 100.0})
    worlds = ns.Simulation(config, worlds=3)
    worlds.reset()
    for _ in range(30):
        seen = worlds.step()
    alone = [p for p in ns.run({**config, "duration_s": 0.3}) if p.sensor == "odometry"][-1]
    for world in range(3):
        assert seen.state.position.numpy()[world].tolist() == alone.position.tolist()
        assert seen.state.orientation.numpy()[world].tolist() == alone.orientation.tolist()
    with pytest.raises(ValueError, match="takes no commands"):
        worlds.step(np.zeros(4), "motor_speeds")
    with pytest.raises(ValueError, match="give no position"):
        worlds.reset(position=[0.0, 0.0, 1.0])


def test_what_published_ground_truth_has(tmp_path, caplog):
    """Two poses of one time, or 40 us apart among others 20 ms apart, and quaternions of few digits."""
    rows = [f"{k / 50} {k} 0 0 0 0 0 1.001" for k in range(20)]
    (tmp_path / "clean.txt").write_text("\n".join(rows))
    rows.insert(10, f"{9 / 50} 9.0 0 0 0 0 0.3 0.954")
    rows.insert(16, f"{14 / 50 + 4e-5} 14.2 0 0 0 0 0 1")
    (tmp_path / "found.txt").write_text("\n".join(rows))
    clean, found = (read_poses(tmp_path / name, "tum") for name in ("clean.txt", "found.txt"))
    assert "2 poses come with the time of the one before" in caplog.text
    assert "line 11" in caplog.text
    for ours, expected in zip(found, clean, strict=True):
        assert np.array_equal(ours, expected)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (["0 0 0 0 0 0 0 1", "1 0 0 0 0 0 0 1", "0.9 0 0 0 0 0 0 1"], r"line 3: time must increase, got 0.9"),
        (["1 0 0 0 0 1 0 0 0 0 1 0", "1 0 0 1 0 1 0 0 0 0 1 0"], r"line 1: 12 numbers, not 8"),
        (["0 0 0 0 0 0 0 1", "1 0 0 0 0 0 0 1.1"], r"line 2: no unit quaternion, .* has length 1.1"),
        (["0 0 0 0 0 0 0 1", "1 0 0 nan 0 0 0 1"], r"line 2: not finite"),
        (["# t", "0 0 0 0 0 0 0 1", "1 0 0 0 0 0 1"], r"line 3: 7 numbers, not 8"),
        (["0 0 0 0 0 0 0 1", "1 0 0 x 0 0 0 1"], r"line 2: no numbers"),
        (["0 0 0 0 0 0 0 1"], "at least two poses, got 1"),
        ([], "at least two poses, got 0"),
    ],
)
def test_bad_rows_are_named(tmp_path, rows, message):
    file = tmp_path / "poses.txt"
    file.write_text("\n".join(rows))
    with pytest.raises(ValueError, match=message):
        pose_path(PosesConfig(file=file))


def test_one_source_of_poses_is_needed(tmp_path):
    with pytest.raises(ValueError, match="give file or keyframes"):
        PosesConfig()
    with pytest.raises(ValueError, match="cannot read"):
        pose_path(PosesConfig(file=tmp_path / "none.txt"))
    frames = [{"time_s": 0.0, "position_m": [0, 0, 0]}, {"time_s": 1.0, "position_m": [0, 0, 0]}]
    with pytest.raises(ValueError, match="start_s must be before the last pose at 1 s"):
        pose_path(PosesConfig(keyframes=frames, start_s=2.0))
