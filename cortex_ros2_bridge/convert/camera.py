"""Pictures, their calibration, and clouds of points."""

from __future__ import annotations

import functools
import io
import re
from typing import Any

import numpy as np

from cortex import messages
from cortex_ros2_bridge.convert.context import Context, ConvertError
from cortex_ros2_bridge.convert.records import header, record
from cortex_ros2_bridge.convert.registry import FRAMES, LATCHED, standard

_FLOAT32 = ("<f4", 7)
_POINT_TYPES = {"intensity": _FLOAT32, "ring": ("<u2", 4), "t": ("<u4", 6)}
"""What fields of points are, in NumPy and in sensor_msgs/PointField."""
_NAMED_PIXELS = {
    "mono8": ("u1", 1),
    "mono16": ("u2", 1),
    "rgb8": ("u1", 3),
    "bgr8": ("u1", 3),
    "rgba8": ("u1", 4),
    "bgra8": ("u1", 4),
    "rgb16": ("u2", 3),
    "bgr16": ("u2", 3),
    **{f"bayer_{order}8": ("u1", 1) for order in ("rggb", "bggr", "gbrg", "grbg")},
    **{f"bayer_{order}16": ("u2", 1) for order in ("rggb", "bggr", "gbrg", "grbg")},
}
_PIXEL = re.compile(r"(8|16|32|64)([USF])C([1-9][0-9]*)")


@standard(messages.Image, "sensor_msgs/Image", "{topic}/image_raw", FRAMES)
def image(message: messages.Image, context: Context) -> Any:
    """Convert to sensor_msgs/Image; encodings are called the same."""
    data = np.ascontiguousarray(message.data)
    if data.ndim != 3:
        raise ConvertError(f"an image must have rows, columns and channels, got shape {data.shape}")
    height, width, channels = data.shape
    dtype, expected = pixel_type(message.encoding)
    if data.dtype.newbyteorder("=") != dtype or channels != expected:
        raise ConvertError(
            f"{message.encoding} means {expected} channels of {dtype}, got {channels} of {data.dtype}"
        )
    return record("sensor_msgs/msg/Image")(
        header(message.stamp_ns, message.frame_id or context.frame_id, context),
        height,
        width,
        message.encoding,
        int(data.dtype.byteorder == ">"),
        width * channels * data.itemsize,
        data.reshape(-1).view(np.uint8),
    )


@standard(
    messages.Image,
    "sensor_msgs/CompressedImage",
    "{topic}/image_raw/compressed",
    FRAMES,
    "compression",
    default=False,
)
def compressed_image(message: messages.Image, context: Context) -> Any:
    """Convert to sensor_msgs/CompressedImage: png if the option `compression` says so, else jpeg.

    Raises:
        ConvertError: It is neither rgb8 nor mono8.
        ImportError: Pillow is not installed.
    """
    from PIL import Image as Picture  # it takes 50 ms to import

    if message.encoding not in ("rgb8", "mono8") or np.ndim(message.data) != 3:
        raise ConvertError(f"only rgb8 and mono8 are compressed, not {message.encoding}")
    kind, data = context.option("compression"), np.asarray(message.data)
    out = io.BytesIO()
    Picture.fromarray(data[:, :, 0] if data.shape[2] == 1 else data).save(out, kind, quality=90)
    return record("sensor_msgs/msg/CompressedImage")(
        header(message.stamp_ns, message.frame_id or context.frame_id, context),
        f"{message.encoding}; {kind} compressed {'bgr8' if data.shape[2] == 3 else 'mono8'}",
        np.frombuffer(out.getbuffer(), np.uint8),
    )


@standard(messages.Image, "sensor_msgs/CameraInfo", "{topic}/camera_info")
def image_camera_info(message: messages.Image, context: Context) -> Any:
    """Return the calibration of the camera, as sensor_msgs/CameraInfo with the stamp of a picture.

    None, as long as the calibration is not known.
    """
    return calibration(message.stamp_ns, context.camera_info, context)


@standard(messages.CameraInfo, "sensor_msgs/CameraInfo", "{parent}/camera_info", LATCHED)
def camera_info(message: messages.CameraInfo, context: Context) -> Any:
    """Convert to sensor_msgs/CameraInfo.

    In ROS the centre of the first pixel is at 0, in Cortex at 0.5: the principal point moves by half a pixel.
    """
    return calibration(message.stamp_ns, message, context)


@standard(messages.PointCloud, "sensor_msgs/PointCloud2", "{topic}", FRAMES)
def point_cloud(message: messages.PointCloud, context: Context) -> Any:
    """Convert to sensor_msgs/PointCloud2 with fields x, y, z and, where they are, intensity, ring and t.

    Its stamp is that of the first ray, from which `t` counts [ns], as drivers and odometry of LiDARs have it;
    that of the last ray, if points are deskewed or have no `t`.
    """
    count = len(message.points)
    names = [name for name in _POINT_TYPES if getattr(message, name, None) is not None]
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), *((name, _POINT_TYPES[name][0]) for name in names)]
    points = np.zeros(count, np.dtype(kinds, align=True))
    for axis, name in enumerate("xyz"):
        points[name] = message.points[:, axis]
    for name in names:
        values = getattr(message, name)
        if len(values) != count:
            raise ConvertError(f"a point cloud with {count} points and {len(values)} values of {name}")
        points[name] = values
    is_timed = message.t is not None and not message.deskewed
    describe = record("sensor_msgs/msg/PointField")
    fields = [
        describe(name, place[1], _POINT_TYPES.get(name, _FLOAT32)[1], 1)
        for name, place in (points.dtype.fields or {}).items()
    ]
    return record("sensor_msgs/msg/PointCloud2")(
        header(
            message.start_ns if is_timed else message.stamp_ns, message.frame_id or context.frame_id, context
        ),
        1,
        count,
        fields,
        False,
        points.itemsize,
        points.nbytes,
        points.view(np.uint8),
        bool(np.isfinite(message.points).all()),
    )


@standard(messages.Image, "sensor_msgs/PointCloud2", "{topic}/points", FRAMES, "depth_max_m", default=False)
def point_cloud_of_depth(message: messages.Image, context: Context) -> Any:
    """Convert a picture of depths [m] (32FC1) to sensor_msgs/PointCloud2, in its optical frame.

    Depth is measured along the axis. Pixels without a finite depth, and beyond the option `depth_max_m`, have
    no point. A distortion is not undone.

    Returns:
        None, as long as the calibration is not known.
    """
    if message.encoding != "32FC1" or np.ndim(message.data) != 3:
        raise ConvertError(f"only a picture of depths (32FC1) becomes a cloud, not one of {message.encoding}")
    lens = context.camera_info
    if lens is None:
        return None
    depth = np.asarray(message.data, np.float32)[:, :, 0]
    if depth.shape != (lens.height, lens.width):
        raise ConvertError(f"a picture of {depth.shape} pixels, calibrated for {lens.height, lens.width}")
    depth_max_m = context.option("depth_max_m")
    row, column = np.nonzero(depth < (np.inf if depth_max_m is None else depth_max_m))
    z = depth[row, column]
    fx, fy, cx, cy = lens.matrix[0, 0], lens.matrix[1, 1], lens.matrix[0, 2], lens.matrix[1, 2]
    points = np.stack([(column + 0.5 - cx) / fx * z, (row + 0.5 - cy) / fy * z, z], axis=1)
    cloud = messages.PointCloud(message.stamp_ns, points.astype(np.float32), frame_id=message.frame_id)
    return point_cloud(cloud, context)


def calibration(stamp_ns: int, message: messages.CameraInfo | None, context: Context) -> Any:
    """Return a calibration as sensor_msgs/CameraInfo, with another stamp [ns]; None of none."""
    if message is None:
        return None
    matrix = np.array(message.matrix, np.float64)
    matrix[0, 2] -= 0.5
    matrix[1, 2] -= 0.5
    projection = np.zeros((3, 4))
    projection[:, :3] = matrix
    distortion = np.array(message.distortion, np.float64)
    if not message.distortion_model:
        distortion = np.zeros(5)
    return record("sensor_msgs/msg/CameraInfo")(
        header(stamp_ns, message.frame_id or context.frame_id, context),
        message.height,
        message.width,
        message.distortion_model or "plumb_bob",
        distortion,
        matrix.reshape(-1),
        np.eye(3).reshape(-1),
        projection.reshape(-1),
        0,
        0,
        record("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False),
    )


@functools.cache
def pixel_type(encoding: str) -> tuple[np.dtype[Any], int]:
    """Return what one channel is, and how many there are."""
    kind, channels = _NAMED_PIXELS.get(encoding, ("", 0))
    general = _PIXEL.fullmatch(encoding)
    if general is not None:
        bits, letter, count = general.groups()
        kind, channels = f"{ {'U': 'u', 'S': 'i', 'F': 'f'}[letter] }{int(bits) // 8}", int(count)
    if not kind or kind == "f1":
        known = ", ".join(_NAMED_PIXELS)
        raise ConvertError(f"unknown encoding {encoding!r} of an image, known: {known}, and such as 32FC1")
    return np.dtype(kind), channels
