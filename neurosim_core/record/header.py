"""What goes with the packets of a flight: settings, seed, calibration, scene, path.

The same description heads a recording and tells a live viewer where the cameras sit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from neurosim_core.sensors.base import SensorConfig


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """A pinhole camera: u = fx x/z + cx, v = fy y/z + cy; pixel centres are at +0.5."""

    width: int
    """Columns [px]."""
    height: int
    """Rows [px]."""
    fx: float
    """Focal length along x [px]."""
    fy: float
    """Focal length along y [px]."""
    cx: float
    """Column of the optical axis [px]."""
    cy: float
    """Row of the optical axis [px]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SensorDescription:
    """One sensor: what it is and where it sits."""

    name: str
    """Name in the configuration; the `sensor` of its packets."""
    kind: str
    """event_camera, rgb, depth, imu or odometry."""
    rate_hz: float
    """Packets a second [Hz]."""
    position: NDArray[np.float64]
    """p_BS [m], shape [3]: its origin in the body frame."""
    orientation: NDArray[np.float64]
    """q_BS, xyzw, shape [4]: takes S to body coordinates; S of a camera is its optical frame."""
    intrinsics: Intrinsics | None = None
    """The lens, for cameras."""
    settings: str = "{}"
    """All settings of the sensor (thresholds, noise, ...), as JSON."""


def _no_times() -> NDArray[np.int64]:
    return np.zeros(0, dtype=np.int64)


def _no_points() -> NDArray[np.float64]:
    return np.zeros((0, 3), dtype=np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class FlightHeader:
    """Everything about a flight that does not change during it."""

    config_yaml: str
    """The resolved configuration; `load_config` reads it back."""
    seed: int
    """Seed of the sensor noise."""
    version: str
    """Version of Neurosim that flew it."""
    scene: str = ""
    """Name of the scene."""
    sensors: tuple[SensorDescription, ...] = ()
    """The sensors, in the order of the configuration."""
    path_stamp_ns: NDArray[np.int64] = field(default_factory=_no_times)
    """Times at which the planned path is sampled [ns], shape [n]."""
    path_position: NDArray[np.float64] = field(default_factory=_no_points)
    """Planned p_WB at these times [m], shape [n, 3]."""


def describe_sensors(sensors: Mapping[str, SensorConfig]) -> tuple[SensorDescription, ...]:
    """Describe the sensors of a configuration, in its order."""
    return tuple(_describe(name, sensor) for name, sensor in sensors.items())


def _describe(name: str, sensor: SensorConfig) -> SensorDescription:
    position = np.zeros(3)
    orientation = np.array([0.0, 0.0, 0.0, 1.0])
    intrinsics = None
    if sensor.kind == "odometry":
        rate_hz = sensor.rate_hz
    elif sensor.kind == "imu":
        rate_hz = sensor.rate_hz
        position = np.array(sensor.mount.position_m)
        orientation = sensor.mount.rotation().as_quat()
    else:
        rate_hz = sensor.packets.rate_hz if sensor.kind == "event_camera" else sensor.rate_hz
        position = np.array(sensor.mount.position_m)
        orientation = sensor.mount.optical_quaternion()
        K = sensor.lens.intrinsics()
        intrinsics = Intrinsics(
            width=sensor.lens.width, height=sensor.lens.height, fx=K.fx, fy=K.fy, cx=K.cx, cy=K.cy
        )
    return SensorDescription(
        name=name,
        kind=sensor.kind,
        rate_hz=rate_hz,
        position=position,
        orientation=orientation,
        intrinsics=intrinsics,
        settings=sensor.model_dump_json(),
    )
