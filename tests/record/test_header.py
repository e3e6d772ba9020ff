"""Descriptions of sensors say what the configuration says."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neurosim_core.frames import Mount
from neurosim_core.record import Intrinsics, describe_sensors
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.sensors.depth import DepthSensorConfig
from neurosim_core.sensors.event_camera import EventSensorConfig
from neurosim_core.sensors.imu import ImuConfig
from neurosim_core.sensors.odometry import OdometrySensorConfig
from neurosim_core.sensors.rgb import RgbSensorConfig

LENS = PinholeConfig(width=20, height=10, fx=11.0, fy=12.0, cx=9.5, cy=5.5)


def test_every_kind_is_described():
    mount = Mount(position_m=(0.1, 0.2, 0.3), rpy_rad=(0.0, 0.5, 0.0))
    described = describe_sensors(
        {
            "dvs": EventSensorConfig(lens=LENS, mount=mount, sampling_rate_hz=1000.0, packet_rate_hz=50.0),
            "rgb": RgbSensorConfig(lens=LENS, mount=mount, rate_hz=30.0),
            "z": DepthSensorConfig(lens=LENS, mount=mount, rate_hz=15.0),
            "imu": ImuConfig(mount=mount, rate_hz=333.0),
            "truth": OdometrySensorConfig(rate_hz=10.0),
        }
    )
    assert [(s.name, s.kind, s.rate_hz) for s in described] == [
        ("dvs", "event_camera", 50.0),
        ("rgb", "rgb", 30.0),
        ("z", "depth", 15.0),
        ("imu", "imu", 333.0),
        ("truth", "odometry", 10.0),
    ]
    for camera in described[:3]:
        assert camera.intrinsics == Intrinsics(width=20, height=10, fx=11.0, fy=12.0, cx=9.5, cy=5.5)
        # Pitched down by 0.5 rad: the optical axis is (cos, 0, -sin) in the body.
        axis = Rotation.from_quat(camera.orientation).apply([0.0, 0.0, 1.0])
        assert axis == pytest.approx([np.cos(0.5), 0.0, -np.sin(0.5)], abs=1e-12)
    for sensor in described[:4]:
        assert sensor.position.tolist() == [0.1, 0.2, 0.3]
    imu_forward = Rotation.from_quat(described[3].orientation).apply([1.0, 0.0, 0.0])
    assert imu_forward == pytest.approx([np.cos(0.5), 0.0, -np.sin(0.5)], abs=1e-12)
    assert described[3].intrinsics is None
    assert described[4].orientation.tolist() == [0.0, 0.0, 0.0, 1.0]
    assert json.loads(described[0].settings)["sampling_rate_hz"] == 1000.0
