"""When sensors sample, and from where cameras look: each by its own clock, whatever the others do."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import neurosim_core as ns
from neurosim_core.clock import Rate
from neurosim_core.frames import Mount
from neurosim_core.render.synthetic_renderer import read_pose

LENS = {"width": 10, "height": 4, "horizontal_fov_rad": 1.5}
hertz = st.sampled_from([20.0, 30.0, 50.0, 100.0, 200.0, 250.0, 333.0, 400.0, 1000.0])


def config(control_hz: float, sensors: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """Return settings of a hall with pictures that show the pose of their camera."""
    return {
        "duration_s": 0.2,
        "device": "cpu",
        "renderer": "synthetic",
        "scene": {"kind": "hall", "size_m": [8, 6, 3]},
        "control": {"rate_hz": control_hz},
        "vehicle": {"on_collision": "report"},
        "path": {"kind": "hover", "position_m": [0.0, 0.0, 1.5]},
        "sensors": sensors,
        **changes,
    }


@given(
    control_hz=hertz,
    imu_hz=hertz,
    odometry_hz=hertz,
    rgb_hz=hertz,
    events_hz=hertz,
    instants=st.integers(min_value=1, max_value=16),
)
@settings(max_examples=10)
def test_every_sensor_samples_at_every_tick_of_its_clock(
    control_hz, imu_hz, odometry_hz, rgb_hz, events_hz, instants
):
    sensors = {
        "imu": {"kind": "imu", "rate_hz": imu_hz},
        "odometry": {"kind": "odometry", "rate_hz": odometry_hz},
        "rgb": {"kind": "rgb", "lens": LENS, "rate_hz": rgb_hz},
        "events": {
            "kind": "event_camera",
            "lens": LENS,
            "sampling_rate_hz": events_hz,
            "packet_rate_hz": events_hz,
        },
    }
    packets = list(ns.run(config(control_hz, sensors, instants_per_launch=instants)))
    order = [(packet.stamp_ns, list(sensors).index(packet.sensor)) for packet in packets]
    assert order == sorted(order)
    duration_ns = 200_000_000
    for name, rate_hz in (("imu", imu_hz), ("odometry", odometry_hz), ("rgb", rgb_hz)):
        stamps = [packet.stamp_ns for packet in packets if packet.sensor == name]
        assert stamps == list(Rate(rate_hz).stamps(0, duration_ns + 1))
    windows = [packet.stamp_ns for packet in packets if packet.sensor == "events"]
    assert windows == list(Rate(events_hz).stamps(1, duration_ns + 1))


@pytest.mark.parametrize(
    ("rates", "common_ns"),
    [
        ((100.0, 200.0, 400.0), 10_000_000),
        ((100.0, 50.0), 20_000_000),
        ((200.0, 500.0), 10_000_000),
        ((30.0, 20.0), 100_000_000),
        ((100.0, 30.0), 100_000_000),
        ((333.0,), 10**9),
        ((29.97,), 10**11),
        ((29.97013, 333.33123, 17.171717, 100.0001), 0),
    ],
)
def test_when_all_clocks_tick_together(rates, common_ns):
    """Each makes a whole number of periods in it, and no shorter whole number of ns will do."""
    sensors = {f"imu{k}": {"kind": "imu", "rate_hz": hz} for k, hz in enumerate(rates[1:])}
    worlds = ns.Simulation(config(rates[0], sensors, renderer="warp"))
    assert worlds.common_ns == common_ns
    periods = (Fraction(str(rate)) * common_ns / 10**9 for rate in rates)
    assert all(count.denominator == 1 for count in periods)


def test_a_camera_looks_from_its_mount_on_the_body():
    """T_WC = T_WB T_BC, and the optical frame is x right, y down, z forward: pitch up looks down."""
    position_m, rpy_rad = (0.1, -0.2, 0.3), (0.1, 0.2, 0.3)
    mount = {"position_m": position_m, "rpy_rad": rpy_rad}
    sensors = {
        "rgb": {"kind": "rgb", "lens": LENS, "rate_hz": 100, "mount": mount},
        "odometry": {"kind": "odometry", "rate_hz": 100},
    }
    circle = {"kind": "circle", "radius_m": 1.0, "center_m": [0.0, 0.0, 1.5], "ramp_s": 0.05}
    packets = list(ns.run(config(100, sensors, path=circle)))
    bodies = {packet.stamp_ns: packet for packet in packets if packet.sensor == "odometry"}
    pictures = [packet for packet in packets if packet.sensor == "rgb"]
    R_BC = Rotation.from_euler("ZYX", rpy_rad[::-1]) * Rotation.from_matrix(
        [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    )
    assert len(pictures) == 21
    for picture in pictures:
        body, pose = bodies[picture.stamp_ns], read_pose(picture.data)
        R_WB = Rotation.from_quat(body.orientation)
        p_WC = body.position + R_WB.apply(position_m)
        np.testing.assert_allclose(pose[:3], p_WC, atol=1e-6)  # float32
        R_WC = Rotation.from_quat(pose[3:]).as_matrix()
        np.testing.assert_allclose(R_WC, (R_WB * R_BC).as_matrix(), atol=1e-6)
    down = Rotation.from_quat(Mount(rpy_rad=(0.0, 0.5, 0.0)).optical_quaternion()).apply([0, 0, 1])
    np.testing.assert_allclose(down, [np.cos(0.5), 0.0, -np.sin(0.5)], atol=1e-15)
