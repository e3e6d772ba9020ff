"""Rolling shutters in flight: each line is that of a picture at the line's time, whatever moves."""

from __future__ import annotations

import numpy as np
import pytest
from small_room import room_scene

import neurosim_core as ns

LENS = {"width": 16, "height": 8, "horizontal_fov_rad": 1.2}
BODIES = {
    "ball": {
        "shape": {"kind": "sphere", "radius_m": 0.3},
        "motion": {"orbit": {"radius_m": 0.4, "rate_hz": 2.0}, "position_m": [1.2, 0.0, 1.3]},
    }
}
FRAMES = [
    {"time_s": 0.0, "position_m": [0.0, 0.0, 1.2]},
    {"time_s": 0.04, "position_m": [0.1, 0.05, 1.3], "rpy_rad": [0.1, 0.2, 0.4]},
    {"time_s": 0.08, "position_m": [0.3, 0.0, 1.2], "rpy_rad": [-0.2, 0.1, 0.9]},
]


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    """Return settings of a rig in a small room."""
    scene = room_scene(tmp_path_factory.mktemp("room"))
    return lambda sensors, **more: {
        "scene": scene,
        "duration_s": 0.05,
        "device": "cpu",
        "bodies": BODIES,
        "path": {"kind": "poses", "keyframes": FRAMES},
        "sensors": sensors,
        **more,
    }


def camera(rate_hz, **shutter):
    return {"kind": "depth", "lens": LENS, "rate_hz": rate_hz, "shutter": shutter}


def pictures(config):
    found = {}
    for packet in ns.run(config):
        found.setdefault(packet.sensor, {})[packet.stamp_ns] = packet.data
    return found


@pytest.fixture(scope="module")
def at_all_times(settings):
    """Pictures of a global shutter at every millisecond."""
    return pictures(settings({"all": camera(1000.0)}))["all"]


def rolled(at_all_times, stamp_ns):
    """Row r of 8 is read at the stamp - (7 - r) ms; before stamp 0 the rig is where it begins."""
    rows = [at_all_times[max(0, stamp_ns - (7 - r) * 1_000_000)][r] for r in range(8)]
    return np.array(rows)


def test_rows_are_those_of_pictures_at_their_times(settings, at_all_times):
    """A camera at 1 kHz makes every row time a boundary: then the bytes are equal."""
    sensors = {"all": camera(1000.0), "roll": camera(50.0, readout_s=0.008)}
    found = pictures(settings(sensors))["roll"]
    assert list(found) == [0, 20_000_000, 40_000_000]
    for stamp_ns, picture in found.items():
        assert picture.tobytes() == rolled(at_all_times, stamp_ns).tobytes()
    assert found[40_000_000].tobytes() != at_all_times[40_000_000].tobytes()


def test_poses_between_boundaries_are_interpolated(settings, at_all_times):
    """Without such a camera the history has 500 entries a second."""
    found = pictures(settings({"roll": camera(50.0, readout_s=0.008)}))["roll"]
    for stamp_ns, picture in found.items():
        expected = rolled(at_all_times, stamp_ns)
        close = np.isclose(picture, expected, rtol=1e-5)
        assert close.mean() > 0.98  # but for a pixel at an edge of the ball


def test_batches_change_no_byte(settings):
    """Times before a batch come from batches before."""
    sensors = {"roll": camera(50.0, readout_s=0.018, exposure_s=0.004)}
    many = pictures(settings(sensors))["roll"]
    few = pictures(settings(sensors, instants_per_launch=1))["roll"]
    assert len(many) == 3
    assert [p.tobytes() for p in many.values()] == [p.tobytes() for p in few.values()]


def test_worlds_roll_as_single_runs_do(settings):
    sensors = {"roll": camera(50.0, readout_s=0.012)}
    config = settings(sensors, control={"rate_hz": 100.0})
    alone = pictures(config)["roll"]
    worlds = ns.Simulation(config, worlds=3)
    seen = worlds.reset()
    assert seen.images["roll"].numpy()[2].tobytes() == alone[0].tobytes()
    for _ in range(4):
        seen = worlds.step()
    for world in range(3):
        assert seen.images["roll"].numpy()[world].tobytes() == alone[40_000_000].tobytes()


def test_other_renderers_refuse(settings):
    config = settings({"roll": camera(50.0, readout_s=0.01)}, renderer="synthetic", bodies={})
    with pytest.raises(ValueError, match=r"roll: a shutter .* needs renderer: warp"):
        next(iter(ns.run(config)))
