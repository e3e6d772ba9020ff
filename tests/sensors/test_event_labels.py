"""The truth of each event against closed forms of what its pixel sees, and causes of what pixels do."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

import neurosim_core as ns
from neurosim_core.live.messages import to_message, to_packet
from neurosim_core.packets import Events
from neurosim_core.record.hdf5 import RecordingWriter
from neurosim_core.record.header import RecordingHeader
from neurosim_core.record.recording import Recording
from neurosim_core.scene.bodies import BodyConfig, body_poses
from neurosim_core.sensors.event_labels import LabelledEvents
from neurosim_core.sensors.event_noise_model import CAUSES

W, H, F = 48, 36, 40.0
LENS = {"width": W, "height": H, "fx": F, "fy": F, "cx": W / 2, "cy": H / 2}
HALF_M = np.array([4.0, 3.0, 1.5])
CENTRE_M = np.array([0.0, 0.0, 1.5])
R_BC = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # an optical frame that looks along x
P_BC = np.array([0.1, 0.05, 0.02])
ALL = ["depth", "flow", "instance", "semantic", "cause"]
BALL = {
    "shape": {"kind": "sphere", "radius_m": 0.4},
    "surface": {"kind": "checker", "square_m": 0.1},
    "motion": {
        "position_m": [2.0, 0.2, 1.4],
        "orbit": {"radius_m": 0.3, "rate_hz": 1},
        "spin_rad_s": [1, 2, 3],
    },
}
AGILE = [
    {"time_s": 0.0, "position_m": [-0.5, 0.0, 1.2]},
    {"time_s": 0.1, "position_m": [-0.2, 0.1, 1.3], "rpy_rad": [0.1, 0.1, 0.2]},
    {"time_s": 0.2, "position_m": [0.2, 0.1, 1.2], "rpy_rad": [-0.1, 0.2, 0.5]},
]
STILL = [{"time_s": t, "position_m": [0.0, 0.0, 1.2]} for t in (0.0, 1.0)]


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A box seen from within."""
    file = tmp_path_factory.mktemp("room") / "room.ply"
    box = trimesh.creation.box(2 * HALF_M, trimesh.transformations.translation_matrix(CENTRE_M))
    box.invert()
    box.export(file)
    return {"kind": "mesh", "file": str(file), "inside_m": [0, 0, 1.2]}


def settings(scene, labels, frames=AGILE, pixel=None, **more):
    camera = {
        "kind": "event_camera", "lens": LENS, "sampling_rate_hz": 500, "packet_rate_hz": 20, "labels": labels,
        "pixel": pixel or {}, "mount": {"position_m": P_BC.tolist()},
    }  # fmt: skip
    return {
        "scene": scene, "duration_s": 0.15, "device": "cpu", "sensors": {"events": camera},
        "path": {"kind": "poses", "keyframes": frames},
        "render": {"lighting": {"mode": "unshadowed"}, "samples_per_pixel": 1}, **more,
    }  # fmt: skip


def fly(config):
    """Return the arrays of all packets, joined, and the last packet."""
    packets = [p for p in ns.run(config) if isinstance(p, Events)]
    names = ["t", "x", "y", "polarity"]
    if isinstance(packets[0], LabelledEvents):
        names += ALL
    return {n: np.concatenate([getattr(p, n) for p in packets]) for n in names}, packets[-1]


def camera_poses(t_us):
    """Return p_WC and R_WC at times of events: the splines of SciPy through the keyframes."""
    times = [frame["time_s"] for frame in AGILE]
    rpy = [frame.get("rpy_rad", [0.0, 0.0, 0.0]) for frame in AGILE]
    R_WB = RotationSpline(times, Rotation.from_euler("xyz", rpy))(1e-6 * t_us)
    p_WB = CubicSpline(times, [frame["position_m"] for frame in AGILE])(1e-6 * t_us)
    return p_WB + R_WB.apply(P_BC), R_WB * R_BC


def to_picture(points, p_WC, R_WC):
    p = R_WC.inv().apply(points - p_WC)
    return p[:, :2] / p[:, 2:] * F + (W / 2, H / 2)


def test_events_say_what_their_pixels_see(room):
    config = settings(room, ALL, bodies={"ball_7": BALL})
    found, last = fly(config)
    assert len(found["t"]) > 2000
    t, rays = found["t"], np.stack([(found["x"] + 0.5 - W / 2) / F, (found["y"] + 0.5 - H / 2) / F], axis=-1)
    rays = np.concatenate([rays, np.ones((len(t), 1))], axis=-1)
    p_WC, R_WC = camera_poses(t)
    ways = R_WC.apply(rays)  # a step of 1 m of depth each
    meaning = json.loads(last.labels)
    names = np.array([meaning["instances"][k][0] for k in found["instance"]])
    classes = np.array(meaning["classes"])[found["semantic"]]
    is_ball = names == "ball_7"
    assert 200 < is_ball.sum() < len(t) - 200
    np.testing.assert_array_equal(classes == "ball", is_ball)
    points = p_WC + found["depth"][:, None] * ways
    # the walls: the nearest of the planes before the camera
    wall = np.where(ways > 0, (CENTRE_M + HALF_M - p_WC) / ways, (CENTRE_M - HALF_M - p_WC) / ways).min(
        axis=1
    )
    np.testing.assert_allclose(found["depth"][~is_ball], wall[~is_ball], rtol=1e-5)
    ball, _ = body_poses({"ball": BodyConfig(**BALL)}, t[is_ball] * 1000)
    off = np.linalg.norm(points[is_ball] - ball[:, 0], axis=1)
    assert (np.abs(off - 0.4) < 0.01).all()  # of triangles
    # flow: where the same points are 50 us before and after
    moved = []
    for step_us in (-50, 50):
        at = np.clip(t + step_us, 0, None)
        p, R = camera_poses(at)
        world = points.copy()
        here, q_here = body_poses({"ball": BodyConfig(**BALL)}, t[is_ball] * 1000)
        there, q_there = body_poses({"ball": BodyConfig(**BALL)}, at[is_ball] * 1000)
        turn = Rotation.from_quat(q_there[:, 0]) * Rotation.from_quat(q_here[:, 0]).inv()
        world[is_ball] = there[:, 0] + turn.apply(points[is_ball] - here[:, 0])
        moved.append(to_picture(world, p, R))
    slope = (moved[1] - moved[0]) / 1e-4
    inside = t > 50
    assert np.abs(found["flow"] - slope)[inside].max() < 2e-3 * np.abs(slope).max()
    assert (found["cause"] == 0).all()


def test_labels_change_no_event_and_no_batch_changes_a_label(room):
    pixel = {"threshold_spread": {"sigma_on": 0.02, "sigma_off": 0.02}, "leak": {"rate_hz": 5.0}}
    plain, first = fly(settings(room, [], pixel=pixel))
    assert type(first) is Events
    labelled, _ = fly(settings(room, ALL, pixel=pixel))
    again, _ = fly(settings(room, ALL, pixel=pixel, instants_per_launch=3))
    order = [np.lexsort([f["polarity"], f["x"], f["y"], f["t"]]) for f in (plain, labelled)]
    for name in ("t", "x", "y", "polarity"):
        np.testing.assert_array_equal(plain[name][order[0]], labelled[name][order[1]])
    for name, values in labelled.items():
        assert again[name].tobytes() == values.tobytes()
    assert {0, 1} == set(np.unique(labelled["cause"]))
    only, _ = fly(settings(room, ["depth"]))
    assert len(only["depth"]) == len(only["t"]) > 0
    assert all(len(only[name]) == 0 for name in ALL[1:])


@pytest.mark.parametrize(
    ("pixel", "cause"),
    [
        ({"leak": {"rate_hz": 50.0}}, "leak"),
        ({"shot_noise": {"rate_hz": 50.0}}, "shot noise"),
        ({"hot_pixels": {"fraction": 0.2, "rate_hz": 100.0}}, "hot pixel"),
        (
            {"stochastic": {"k1": 1.0, "k2": 0.0, "k3": 0.0, "k4": 0.0, "k5": 0.0, "k6": 1e-4}},
            "threshold noise",
        ),
    ],
)
def test_a_camera_at_rest_fires_for_one_cause(room, pixel, cause):
    found, _ = fly(settings(room, ["cause"], STILL, pixel=pixel))
    assert len(found["t"]) > 20
    assert {CAUSES[k] for k in np.unique(found["cause"])} == {cause}
    assert found["x"].max() < W


def test_causes_of_a_moving_camera_with_noise(room):
    """As many noise events as at rest, to their spread; the others are of the signal."""
    pixel = {"shot_noise": {"rate_hz": 20.0}, "hot_pixels": {"fraction": 0.05, "rate_hz": 100.0}}
    moving, _ = fly(settings(room, ["cause"], pixel=pixel, bodies={"ball": BALL}))
    counts = np.bincount(moving["cause"], minlength=5)
    hot = W * H * 0.05 * 100.0 * 0.15
    assert abs(counts[3] - hot) < 0.25 * hot  # which pixels are hot is drawn: 10 % on 86 of them
    assert counts[2] > 50
    assert counts[0] > 1000
    assert counts[1] == counts[4] == 0


def test_recordings_and_messages_have_the_truth(tmp_path, room):
    packets = [p for p in ns.run(settings(room, ["flow", "semantic"])) if isinstance(p, Events)]
    with RecordingWriter(tmp_path / "a.h5", RecordingHeader(config_yaml="", seed=0, version="0")) as writer:
        for packet in packets:
            writer.write(packet)
    with Recording(tmp_path / "a.h5") as recording:
        read = list(recording.packets())
    for packet, *others in zip(
        packets, read, (to_packet(to_message(p), "events") for p in packets), strict=True
    ):
        for other in others:
            assert type(other) is LabelledEvents
            assert other.labels == packet.labels
            for name in ("t", "x", "y", "polarity", *ALL):
                np.testing.assert_array_equal(getattr(other, name), getattr(packet, name))


def test_what_has_no_truth_says_so(room):
    config = settings(room, ["depth"], control={"rate_hz": 100.0})
    with pytest.raises(ValueError, match="labels of 'events' are for single runs"):
        ns.Simulation(config, worlds=2)
    with pytest.raises(ValueError, match="only the renderer 'warp' has them"):
        next(iter(ns.run({**config, "renderer": "synthetic"})))
