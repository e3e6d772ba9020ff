"""Events: as packets, as arrays, and drawn as pictures."""

from __future__ import annotations

from typing import Any

import numpy as np

from cortex import messages
from cortex.evt3 import EventCodecError, EventColumns, Evt3Encoder, check_pixels
from cortex_ros2_bridge.backend.base import Qos
from cortex_ros2_bridge.convert.camera import calibration
from cortex_ros2_bridge.convert.context import Context, ConvertError
from cortex_ros2_bridge.convert.records import header, record
from cortex_ros2_bridge.convert.registry import FRAMES, PACKETS, standard
from cortex_ros2_bridge.event_codec import encode_mono

_COLORS = np.array([[255, 255, 255], [220, 30, 30], [30, 60, 220]], np.uint8)
"""Red, green, blue of a pixel without events, that became darker, that became brighter."""


@standard(messages.Events, "event_camera_msgs/EventPacket", "{topic}", PACKETS, "encoding")
def event_packet(message: messages.Events, context: Context) -> Any:
    """Convert to event_camera_msgs/EventPacket; the option `encoding` is evt3 (default) or mono.

    As drivers do it, its stamp is the time of the first event; of a packet without events, the end of its
    window. `time_base` is that time in mono, and 0 in evt3, where it has no meaning.
    """
    encoding = context.option("encoding")
    stamp_ns = int(message.t[0]) * 1000 if len(message.t) else message.stamp_ns
    base_us = stamp_ns // 1000
    columns = EventColumns(message.t, message.x, message.y, message.polarity)
    size = {"width": message.width, "height": message.height}
    try:
        if encoding == "mono":
            if base_us < 0:
                raise ConvertError(f"mono holds no time before 0, got {base_us} us")
            data = encode_mono(columns, **size, base_us=base_us)
        else:
            data = context.memory.setdefault("evt3", Evt3Encoder()).encode(columns, **size, end_us=base_us)
    except EventCodecError as error:
        raise ConvertError(str(error)) from error
    return record("event_camera_msgs/msg/EventPacket")(
        header(stamp_ns, message.frame_id or context.frame_id, context),
        message.height,
        message.width,
        message.sequence,
        base_us * 1000 if encoding == "mono" else 0,
        encoding,
        False,
        data,
    )


@standard(messages.Events, "sensor_msgs/Image", "{topic}/image", FRAMES, "period_s")
def event_image(message: messages.Events, context: Context) -> Any:
    """Draw events, and return a sensor_msgs/Image (rgb8) each time that the option `period_s` has passed.

    White where there was no event, else the last one: blue is brighter, red is darker. The default is 1/30 s
    of simulated time. A picture ends with the window in which a multiple of the period lies, and has its
    stamp.
    """
    shape = int(message.height), int(message.width)
    last = context.memory.get("picture")
    if last is None or last.shape != shape:
        last = context.memory["picture"] = np.zeros(shape, np.uint8)
    if message.stamp_ns < context.memory.get("seen_until_ns", message.stamp_ns):  # time was set back
        last[:] = 0
    ends = _ends_picture(message, context)
    try:
        check_pixels(message.x, message.y, message.polarity, shape[1], shape[0])
    except EventCodecError as error:
        raise ConvertError(str(error)) from error
    last[message.y, message.x] = message.polarity + np.uint8(1)
    if not ends:
        return None
    data = _COLORS.take(last, axis=0)
    last[:] = 0
    return record("sensor_msgs/msg/Image")(
        header(message.stamp_ns, message.frame_id or context.frame_id, context),
        *shape,
        "rgb8",
        0,
        3 * shape[1],
        data.reshape(-1),
    )


@standard(messages.Events, "sensor_msgs/CameraInfo", "{topic}/camera_info", Qos(), "period_s")
def events_camera_info(message: messages.Events, context: Context) -> Any:
    """Return the calibration of an event camera with the stamp of a picture of `event_image`.

    None between these pictures, and as long as the calibration is not known. The option `period_s` must be
    that of the pictures.
    """
    if not _ends_picture(message, context):
        return None
    return calibration(message.stamp_ns, context.camera_info, context)


def _ends_picture(message: messages.Events, context: Context) -> bool:
    """Return whether a multiple of the period lies in the window, or between it and the one before.

    So all who see the same windows, to draw or to calibrate, find the same ones, whenever they began.
    """
    period_ns = max(round(context.option("period_s") * 1e9), 1)
    until_ns: int = context.memory.get("seen_until_ns", message.start_ns)
    context.memory["seen_until_ns"] = message.stamp_ns
    begin_ns = until_ns if until_ns <= message.stamp_ns else message.start_ns
    return bool(message.stamp_ns // period_ns > begin_ns // period_ns)
