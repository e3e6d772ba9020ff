"""Messages of sensors."""

from __future__ import annotations

from typing import Annotated

from cortex.message_types import Array, UInt32, UInt64, Unit, message


@message(name="cortex/Events")
class Events:
    """The events of one window of time of an event camera, sorted by time.

    The window is the half-open interval (`start_ns`, `stamp_ns`].
    """

    stamp_ns: Annotated[int, Unit("ns")]
    """End of the window [ns]."""
    x: Annotated[Array["uint16", "n"], Unit("px")]
    """Column [px], shape [n]."""
    y: Annotated[Array["uint16", "n"], Unit("px")]
    """Row [px], shape [n]."""
    t: Annotated[Array["int64", "n"], Unit("us")]
    """Time of each event since the same origin as `stamp_ns` [us], shape [n]."""
    polarity: Array["uint8", "n"]
    """1: brighter, 0: darker, shape [n]."""
    width: Annotated[UInt32, Unit("px")]
    """Width of the sensor [px]."""
    height: Annotated[UInt32, Unit("px")]
    """Height of the sensor [px]."""
    start_ns: Annotated[int, Unit("ns")] = 0
    """Start of the window, not part of it [ns]."""
    dropped_count: UInt64 = 0
    """Events of the window that did not fit into a buffer and are lost."""
    frame_id: str = ""
    """Name of the camera's frame."""
    sequence: UInt64 = 0
    """Counts the windows of one camera from 0."""


@message(name="cortex/Image")
class Image:
    """One picture: colour, grey, depth, flow or labels.

    Encodings are named as in ROS: rgb8 is uint8 in sRGB, mono8 uint8, 32FC1 float32 (depth: planar z [m], inf
    where nothing was hit), 32FC2 float32 (flow [px]), 32SC1 int32 (labels).
    """

    stamp_ns: Annotated[int, Unit("ns")]
    """Time of the exposure [ns]."""
    data: Array["any", "height", "width", "channels"]
    """Pixels, row-major, shape [height, width, channels]; one channel for grey, depth and labels."""
    encoding: str
    """What a pixel is."""
    frame_id: str = ""
    """Name of the camera's frame."""
    sequence: UInt64 = 0
    """Counts the pictures of one camera from 0."""


@message(name="cortex/CameraInfo")
class CameraInfo:
    """How a camera projects: pixel column = fx * x_d + cx, row = fy * y_d + cy, in the camera's frame.

    (x_d, y_d) is (x / z, y / z) of a pinhole, or what the distortion model makes of it.
    """

    stamp_ns: Annotated[int, Unit("ns")]
    """From when on it holds [ns]."""
    width: Annotated[UInt32, Unit("px")]
    """Width of the picture [px]."""
    height: Annotated[UInt32, Unit("px")]
    """Height of the picture [px]."""
    matrix: Annotated[Array["float64", 3, 3], Unit("px")]
    """Camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] [px], shape [3, 3]; pixel centres are at +0.5."""
    distortion_model: str
    """Name of the model, such as "plumb_bob"; empty for a pinhole."""
    distortion: Array["float64", "k"]
    """Coefficients of the model, shape [k]."""
    frame_id: str = ""
    """Name of the camera's frame."""
    sequence: UInt64 = 0
    """Counts the messages of one camera from 0."""


@message(name="cortex/Imu")
class Imu:
    """What an inertial measurement unit reads, in its own frame; of fixed size."""

    stamp_ns: Annotated[int, Unit("ns")]
    """Time of the measurement [ns]."""
    specific_force: Annotated[Array["float64", 3], Unit("m/s^2", frame="sensor")]
    """Acceleration minus gravity [m/s^2], shape [3]; at rest it points up with 9.81."""
    angular_rate: Annotated[Array["float64", 3], Unit("rad/s", frame="sensor")]
    """Angular velocity against the world [rad/s], shape [3]."""
    sequence: UInt64 = 0
    """Counts the measurements of one unit from 0."""


@message(name="cortex/PointCloud")
class PointCloud:
    """Points in the frame of a sensor."""

    stamp_ns: Annotated[int, Unit("ns")]
    """Time of the last point [ns]."""
    points: Annotated[Array["float32", "n", 3], Unit("m", frame="sensor")]
    """Positions [m], shape [n, 3]."""
    intensity: Array["float32", "n"] | None = None
    """Strength of each return, shape [n]."""
    ring: Array["uint16", "n"] | None = None
    """Which laser of the sensor measured each point, shape [n]."""
    t: Annotated[Array["uint32", "n"], Unit("ns")] | None = None
    """When each point was measured, since `start_ns` [ns], shape [n]."""
    start_ns: Annotated[int, Unit("ns")] = 0
    """When the first ray was cast [ns]."""
    deskewed: bool = False
    """Points are seen from the sensor's pose at `stamp_ns`; else each from that at its own time."""
    frame_id: str = ""
    """Name of the sensor's frame."""
    sequence: UInt64 = 0
    """Counts the clouds of one sensor from 0."""
