"""The header of a recording: settings, seed, calibration, scene, path; also what a live viewer is told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.packets import schema_of

if TYPE_CHECKING:
    from neurosim_core.sensors.base import SensorConfig


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """A camera: u = fx x_d + cx, v = fy y_d + cy; pixel centres are at +0.5.

    (x_d, y_d) is (x/z, y/z) of a pinhole, or what distortion makes of it (`render.lenses`).
    """

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
    distortion_model: str = ""
    """Name in sensor_msgs/CameraInfo (plumb_bob, rational_polynomial, equidistant), or double_sphere, or
    ray_table, whose fx to cy hold around the centre only; empty for a pinhole."""
    distortion: tuple[float, ...] = ()
    """Coefficients of the model."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SensorDescription:
    """One sensor: what it is and where it sits."""

    name: str
    """Name in the configuration; the `sensor` of its packets."""
    kind: str
    """Kind of the sensor, such as event_camera, rgb or imu."""
    rate_hz: float
    """Packets a second [Hz]."""
    position: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    """p_BS [m], shape [3]: its origin in the body frame."""
    orientation: NDArray[np.float64] = field(default_factory=lambda: np.array([0.0, 0.0, 0.0, 1.0]))
    """q_BS, xyzw, shape [4]: takes S to body coordinates; S of a camera is its optical frame."""
    intrinsics: Intrinsics | None = None
    """The lens, for cameras."""
    settings: str = "{}"
    """All settings of the sensor (thresholds, noise, ...), as JSON."""
    has_events: bool = False
    """Whether its packets are known to hold events."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordingHeader:
    """The data of a recording besides its packets."""

    config_yaml: str
    """The resolved configuration; `load_config` reads it back."""
    seed: int
    """Seed of the sensor noise."""
    version: str
    """Version of Neurosim that wrote the recording."""
    scene: str = ""
    """Name of the scene."""
    sensors: tuple[SensorDescription, ...] = ()
    """The sensors, in the order of the configuration."""
    path_stamp_ns: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Times at which the planned path is sampled [ns], shape [n]."""
    path_position: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    """Planned p_WB at these times [m], shape [n, 3]."""


def describe_sensors(sensors: Mapping[str, SensorConfig]) -> tuple[SensorDescription, ...]:
    """Describe the sensors of a configuration, in its order.

    A sensor without a mount is at the origin of the body. One with a lens is a camera.
    """
    return tuple(_describe(name, sensor) for name, sensor in sensors.items())


def _describe(name: str, sensor: Any) -> SensorDescription:
    mount, lens = getattr(sensor, "mount", None), getattr(sensor, "lens", None)
    more: dict[str, Any] = {"has_events": schema_of(sensor.packet_class).has_events}
    if mount is not None:
        more["position"] = np.array(mount.position_m)
        more["orientation"] = mount.quaternion() if lens is None else mount.optical_quaternion()
    if lens is not None:
        more["intrinsics"] = Intrinsics(
            width=lens.width,
            height=lens.height,
            **lens.intrinsics()._asdict(),
            distortion_model=lens.distortion_model,
            distortion=lens.distortion_coefficients,
        )
    rate_hz, settings = sensor.packets.rate_hz, sensor.model_dump_json()
    return SensorDescription(name=name, kind=sensor.kind, rate_hz=rate_hz, settings=settings, **more)
