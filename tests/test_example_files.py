"""The examples run, and end on the number that they should."""

from __future__ import annotations

import ctypes.util
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import neurosim_core as ns

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def load(name: str):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def test_a_sensor_of_an_outside_package_is_flown_recorded_and_shown(tmp_path):
    from neurosim_core.record import Recording

    example = load("custom_sensor")
    closed = example.main(tmp_path)
    assert 0 < closed < 201
    with Recording(tmp_path / "flight.h5") as flight:
        readings = list(flight.packets("proximity"))
    assert (len(readings), sum(reading.closed for reading in readings)) == (201, closed)
    assert [reading.closed for reading in readings] == [reading.height_m < 1.45 for reading in readings]
    assert (tmp_path / "flight.rrd").stat().st_size > 10_000


def test_a_sink_of_an_outside_package_writes_poses_beside_the_recording(tmp_path):
    assert load("own_sink").main(tmp_path) == 101
    poses = np.loadtxt(tmp_path / "poses.txt")
    with ns.Recording(tmp_path / "flight.h5") as flight:
        positions = flight.column("odometry", "position")
    assert np.abs(poses[:, 1:4] - positions).max() < 1e-9
    assert (tmp_path / "overview.png").exists()


NUMBERS = {
    "first_events": lambda events: events > 10_000,
    "anemometer": lambda wind_m_s: 4.0 < wind_m_s < 5.5,  # the vehicle gives way; white noise of 0.05
    "own_scene": lambda distance_m: distance_m == pytest.approx(3.9, abs=1e-4),  # 4 m less the mount of 0.1 m
    "own_controller": lambda error_m: error_m < 0.01,
    "noise_term": lambda counts: counts == sorted(counts, reverse=True) and counts[0] > 10 * counts[-1] > 0,
    "pursuit_controller": lambda errors_m: errors_m[1] < 0.02 < errors_m[0] < 0.2,
    "many_worlds": lambda counts: counts == sorted(counts, reverse=True) and counts[-1] > 1000,
    "training_windows": lambda windows: windows[0] == 10 and windows[1] > 10_000,
    "frames_to_events": lambda events: events == 32 * 48 * 6,
    "imu_dead_reckoning": lambda error_m_s: 0.0 < error_m_s < 0.02,
    "lidar_cloud": lambda height_m: height_m == pytest.approx(-0.656, abs=0.005),  # mount 0.056 m above B
}


@pytest.mark.parametrize("name", NUMBERS)
def test_an_example_ends_on_its_number(name, capsys):
    assert NUMBERS[name](load(name).main())
    assert capsys.readouterr().out


def test_an_anemometer_reads_gusts_and_turbulence_in_all_worlds():
    load("anemometer")
    gust = {"velocity_m_s": [0.0, 6.0, 0.0], "start_s": 0.0, "rise_s": 0.03}
    parameters = {"wind_m_s": [1.0, 0.0, 0.0], "gusts": [gust], "turbulence": {"wind_20ft_m_s": 15.0}}
    exact = {"kind": "anemometer", "errors": {"white": 0.0, "markov": 0.0}}
    config = {
        "duration_s": 0.1,
        "scene": {"rooms": 1},
        "device": "cpu",
        "path": {"kind": "hover"},
        "control": {"rate_hz": 100},
        "vehicle": {"parameters": parameters},
        "sensors": {"wind": exact, "odometry": {"kind": "odometry", "rate_hz": 100}},
    }
    packets = list(ns.run({**config, "seed": 7}))
    states = [packet for packet in packets if packet.sensor == "odometry"]
    read = [packet.air for packet in packets if packet.sensor == "wind"]
    turned = [Rotation.from_quat(state.orientation) for state in states]
    air = np.array([turn.apply(a) + s.velocity for turn, a, s in zip(turned, read, states, strict=True)])
    steady = np.array([[1.0, 6.0 * np.sin(0.5 * np.pi * min(k / 3, 1.0)) ** 2, 0.0] for k in range(11)])
    assert 0.1 < np.abs(air - steady).max() < 8.0  # turbulence of 1.5 m/s vertically, more across
    worlds = ns.Simulation(config, worlds=3, seeds=[5, 6, 7])
    worlds.reset()
    for k in range(1, 11):
        seen = worlds.rollout(1)
        rows = seen.samples["wind"].arrays["air"].numpy()[-1]
        assert rows[2].tobytes() == read[k].tobytes()
        assert (rows[0] != rows[2]).all()
        velocity = seen.state.air_velocity.numpy() - seen.state.velocity.numpy()
        at = Rotation.from_quat(seen.state.orientation.numpy())
        np.testing.assert_allclose(at.inv().apply(velocity), rows, atol=1e-12)


def test_examples_are_short_and_tested():
    names = {file.stem for file in EXAMPLES.glob("*.py")}
    assert len(names) >= 10
    for name in names:
        assert len((EXAMPLES / f"{name}.py").read_text(encoding="utf-8").splitlines()) <= 80
    assert set(NUMBERS) <= names


def test_a_kind_that_is_taken_is_refused():
    from neurosim_core.sensors.base import StateSensorConfig

    taken = r"the sensor kind 'imu' is taken by neurosim_core\.sensors\.imu\.ImuConfig"
    with pytest.raises(ValueError, match=taken):

        @ns.register("sensor", "imu")
        class Other(StateSensorConfig):
            pass


def test_an_unknown_seam_or_kind_is_said():
    from neurosim_core import registry

    with pytest.raises(ValueError, match="unknown category 'sensors', known: sensor, vehicle"):
        registry.kinds("sensors")
    with pytest.raises(ValueError, match=r"unknown sensor kind 'sonar', known: .*'depth'"):
        registry.find("sensor", "sonar")


def test_a_renderer_in_another_process_conforms(monkeypatch):
    """The other process imports the example by its name."""
    monkeypatch.syspath_prepend(EXAMPLES)
    pytest.importorskip("pyrender")
    if ctypes.util.find_library("EGL") is None:
        pytest.skip("OpenGL without a display needs EGL")
    assert load("remote_renderer").main() == (10, [])


@pytest.mark.parametrize(
    ("name", "module", "extra"),
    [
        ("custom_task", "torch", "learn"),
        ("ray_train", "ray", "distributed"),
        ("remote_renderer", "pyrender", "render"),
        ("rotorpy_vehicle", "rotorpy", "dev"),
    ],
)
def test_an_example_without_its_library_names_it_and_the_extra(name, module, extra, tmp_path):
    (tmp_path / f"{module}.py").write_text(f"raise ImportError('No module named {module}')")
    path = os.pathsep.join([str(tmp_path), str(EXAMPLES.parent)])
    done = subprocess.run(
        [sys.executable, EXAMPLES / f"{name}.py"],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    first, *more = done.stderr.splitlines()
    assert done.returncode == 1
    assert f"No module named {module}" in first
    assert f"pip install -e '.[{extra}]'" in first
    assert more == ["the process that renders has ended"] * (name == "remote_renderer")


def test_tutorials_include_the_examples_that_they_speak_of():
    """A line that a formatter has touched includes nothing, and says so nowhere."""
    included = 0
    for page in (EXAMPLES.parent / "docs").rglob("*.md"):
        for line in page.read_text(encoding="utf-8").splitlines():
            if line.startswith("--8"):
                name = re.fullmatch(r'--8<-- "(.+)"', line)
                assert name is not None, (page, line)
                assert (EXAMPLES.parent / name[1]).is_file(), (page, line)
                included += 1
    assert included >= 6
