"""A robot in ROS that a controller in Cortex flies: its sensors to Cortex, its commands to ROS."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

from cortex import messages
from cortex.evt3 import EventCodecError, EventColumns, Evt3Decoder
from cortex_ros2_bridge import frames
from cortex_ros2_bridge.convert.commands import recorded_rates, unit, xyz
from cortex_ros2_bridge.convert.context import Context, ConvertError, check_finite
from cortex_ros2_bridge.convert.records import stamp_ns_of
from cortex_ros2_bridge.convert.registry import NEWEST, PACKETS, standard
from cortex_ros2_bridge.event_codec import decode_libcaer, decode_libcaer_cmp, decode_mono


@standard(messages.Odometry, "nav_msgs/Odometry", "{topic}", PACKETS, direction="in", robot=True)
def odometry(message: Any, context: Context) -> messages.Odometry:
    """Convert nav_msgs/Odometry: the velocity is turned from the body frame to that of the pose."""
    pose, twist = message.pose.pose, message.twist.twist
    position, velocity, rate = xyz(pose.position), xyz(twist.linear), xyz(twist.angular)
    check_finite("odometry", position, velocity, rate)
    orientation = unit(pose.orientation)
    return messages.Odometry(
        stamp_ns=stamp_ns_of(message.header.stamp),
        position=position,
        orientation=orientation,
        velocity=frames.rotate(orientation, velocity),
        body_rate=rate,
        sequence=context.sequence,
    )


@standard(
    messages.Events,
    "event_camera_msgs/EventPacket",
    "{topic}",
    PACKETS,
    "packet_rate_hz",
    direction="in",
    robot=True,
)
def events(message: Any, context: Context) -> messages.Events:
    """Convert event_camera_msgs/EventPacket, in evt3, mono, libcaer or libcaer_cmp.

    A packet tells the time of its first event. Its stamp in Cortex is the end of the window in which its last
    one lies, where the option `packet_rate_hz` tells how windows follow each other; else the time of that.
    """
    stamp_ns = stamp_ns_of(message.header.stamp)
    if stamp_ns < context.memory.get("stamp_ns", 0):  # time has begun again
        context.memory.clear()
    context.memory["stamp_ns"] = stamp_ns
    try:
        if message.encoding == "evt3":
            columns = _decode_evt3(message, stamp_ns // 1000, context)
        else:
            columns = _decode_timed(message)
            columns = columns._replace(t=columns.t // 1000)
    except EventCodecError as error:
        raise ConvertError(str(error)) from error
    inside = (columns.x < message.width) & (columns.y < message.height)
    columns = EventColumns(*(column[inside] for column in columns))
    end_ns = int(columns.t[-1]) * 1000 if len(columns.t) else stamp_ns
    rate_hz = context.option("packet_rate_hz")
    if rate_hz is not None:
        period_ns = 1_000_000_000 / Fraction(str(rate_hz))
        end_ns = int(-(-end_ns // period_ns) * period_ns)
    return messages.Events(
        stamp_ns=end_ns,
        **columns._asdict(),
        width=message.width,
        height=message.height,
        start_ns=min(stamp_ns, end_ns),
        sequence=message.seq,
    )


def _decode_evt3(message: Any, stamp_us: int, context: Context) -> EventColumns:
    """Return the events of a packet, after those before it.

    Time in evt3 has 24 bits. Where packets are stamped with the time of their first event, as ours are, the
    stamp says the rest; the stamps of drivers are of another clock, so there wraps are counted.
    """
    size = {"width": message.width, "height": message.height}
    if context.memory.setdefault("is_stamped", True):
        columns = Evt3Decoder(start_us=stamp_us).decode(message.events, **size)
        if not len(columns.t) or int(columns.t[0]) == stamp_us:
            return columns
        context.memory["is_stamped"] = False
    decoder: Evt3Decoder = context.memory.setdefault("evt3", Evt3Decoder())
    return decoder.decode(message.events, **size)


def _decode_timed(message: Any) -> EventColumns:
    """Return the events of a packet that tells its time, in nanoseconds."""
    data, base_ns = message.events, message.time_base
    if base_ns >= 2**62:
        raise ConvertError(f"EventPacket.time_base must be below 2^62 ns, got {base_ns}")
    match message.encoding:
        case "mono":
            return decode_mono(data, base_ns=base_ns)
        case "libcaer":
            return decode_libcaer(data, base_ns=base_ns)
        case "libcaer_cmp":
            return decode_libcaer_cmp(data, base_ns=base_ns, width=message.width, height=message.height)
    raise ConvertError(
        f"EventPacket.encoding must be evt3, mono, libcaer or libcaer_cmp, got {message.encoding!r}"
    )


standard(
    messages.RateThrustCommand,
    "mavros_msgs/AttitudeTarget",
    "{base}/attitude_target",
    NEWEST,
    "max_thrust_n",
    robot=True,
)(recorded_rates)
