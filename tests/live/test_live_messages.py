"""Packets as messages and back: standard types for known packets, derived types for all others."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import pytest
import warp as wp
from live_rig import LiveRig, make_config
from numpy.typing import NDArray
from processes import SOON_S

from cortex import Node, reliable
from cortex import messages as msg
from cortex.schema import schema_of
from neurosim_core.live.config import LinkConfig
from neurosim_core.live.messages import command_of, message_type, setpoint_of, to_message, to_packet
from neurosim_core.live.topics import COMMANDS
from neurosim_core.packets import Collision, Delivery, Events, FieldSpec, Image, ImuSample, Odometry, Packet
from neurosim_core.registry import register
from neurosim_core.sensors import RateHz, Sampler, SamplerContext, StateSensorConfig

HEADER: dict[str, Any] = {"stamp_ns": 5_000_000, "sequence": 7, "sensor": "x"}


@dataclass(frozen=True, kw_only=True, eq=False)
class RangeScan(Packet):
    """A packet that the live stack has never seen."""

    ranges: Annotated[NDArray[np.float32], FieldSpec("beams", unit="m")]
    corners: Annotated[NDArray[Any], FieldSpec("n", 3, unit="m", frame="sensor")]
    angle_rad: float
    ring: int
    is_valid: bool
    end_ns: int
    mode: str


def a_scan(**changes: Any) -> RangeScan:
    values: dict[str, Any] = {
        "ranges": np.arange(5, dtype=np.float32),
        "corners": np.ones((2, 3)),
        "angle_rad": 0.5,
        "ring": 3,
        "is_valid": True,
        "end_ns": 9,
        "mode": "dual",
    }
    return RangeScan(**HEADER | values | changes)


def packets() -> Iterator[Packet]:
    t = np.array([4001, 4500], dtype=np.int64)
    x, polarity = np.array([1, 2], dtype=np.uint16), np.array([0, 1], dtype=np.uint8)
    yield Events(
        **HEADER, t=t, x=x, y=x, polarity=polarity, width=8, height=6, start_ns=4_000_000, dropped_count=2
    )
    yield Image(**HEADER, data=np.arange(24, dtype=np.uint8).reshape(2, 4, 3), encoding="rgb8")
    yield Image(**HEADER, data=np.ones((2, 4), np.float32), encoding="32FC1")
    yield ImuSample(**HEADER, specific_force=np.arange(3.0), angular_rate=np.ones(3))
    vectors = {name: np.arange(3.0) for name in ("position", "velocity", "body_rate")}
    yield Odometry(**HEADER, **vectors, orientation=np.arange(4.0), rotor_speed=np.zeros(0))
    yield Collision(**HEADER, position=np.ones(3), clearance_m=-0.1)
    yield Delivery(**HEADER, delivered_ns=6_000_000, size_bytes=48)
    yield a_scan()


@pytest.mark.parametrize("packet", list(packets()), ids=lambda packet: type(packet).__name__)
def test_a_message_says_what_its_packet_does(packet: Packet, shared_runtime: Any):
    """Also over the wire."""
    message = to_message(packet, frame_id="drone/x")
    with Node("sender") as sender, Node("receiver") as receiver:
        publisher = sender.publisher("/x", type(message))
        subscriber = receiver.subscriber("/x", type(message), policy=reliable())
        assert publisher.wait_for_subscribers(1, SOON_S)
        publisher.publish(message)
        back = to_packet(subscriber.recv(SOON_S), "x")
    assert type(back) is type(packet)
    for field in dataclasses.fields(packet):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(packet, field.name))
    if hasattr(message, "frame_id"):
        assert message.frame_id == "drone/x"


def test_known_packets_keep_their_types_on_the_wire():
    kinds = {type(packet): message_type(type(packet)) for packet in packets()}
    assert [kinds[kind] for kind in (Events, Image, ImuSample, Odometry, Collision, Delivery)] == [
        msg.Events,
        msg.Image,
        msg.Imu,
        msg.Odometry,
        msg.Collision,
        msg.Delivery,
    ]


def test_a_derived_type_has_the_units_of_its_packet():
    schema = schema_of(message_type(RangeScan))
    assert schema.name == "neurosim/RangeScan"
    assert {f.name: (f.unit, f.frame) for f in schema.fields if f.unit} == {
        "stamp_ns": ("ns", ""),
        "ranges": ("m", ""),
        "corners": ("m", "sensor"),
        "angle_rad": ("rad", ""),
        "end_ns": ("ns", ""),
    }
    assert message_type(RangeScan) is message_type(RangeScan)


def test_a_packet_that_cannot_be_a_message_is_refused():
    @dataclass(frozen=True, kw_only=True, eq=False)
    class Loose(Packet):
        ranges: NDArray[np.float32]

    with pytest.raises(TypeError, match=r"Loose\.ranges: the array needs axes, such as Annotated"):
        message_type(Loose)
    with pytest.raises(TypeError, match="no packet for a message of type Text"):
        to_packet(msg.Text(stamp_ns=0, text="x"), "x")


def test_a_sensor_has_its_own_clock():
    """Half a second ahead and 1000 ppm fast: stamps move, and event times with them, linearly in a window."""
    clock_ns = LinkConfig(clock_offset_s=0.5, clock_drift_ppm=1000.0).clock_ns
    events, *_ = packets()
    message = to_message(events, clock_ns=clock_ns)
    assert (message.start_ns, message.stamp_ns) == (504_004_000, 505_005_000)
    assert message.t.tolist() == [504_005, 504_504]  # 4001 + 500004.0 and 4500 + 500004.5, floored
    assert to_message(a_scan(), clock_ns=clock_ns).stamp_ns == 505_005_000


@pytest.mark.parametrize("mode", COMMANDS)
def test_a_command_is_its_row_of_setpoints(mode: str):
    row = np.arange(1.0, 6.0 if mode == "attitude" else 5.0)
    command = command_of(mode, row, stamp_ns=8, sequence=2)
    assert (type(command), command.stamp_ns, command.sequence) == (COMMANDS[mode], 8, 2)
    np.testing.assert_array_equal(setpoint_of(mode, command), row)


def test_an_unknown_mode_is_refused():
    with pytest.raises(ValueError, match="unknown command mode 'warp', known: motor_speeds, rates"):
        command_of("warp", [1.0], stamp_ns=0)


@register("sensor", "test_scanner")
class ScannerConfig(StateSensorConfig):
    """A sensor of a new kind."""

    kind: Literal["test_scanner"] = "test_scanner"
    rate_hz: RateHz = 200.0

    packet_type = RangeScan

    def make(self, context: SamplerContext) -> Sampler:
        return Scanner(context)


class Scanner(Sampler):
    """It measures nothing, and gives the same each time."""

    def __init__(self, context: SamplerContext) -> None:
        shape = (context.slot_count, context.vehicle.count)
        self.arrays = {"nothing": wp.zeros(shape, dtype=float, device="cpu")}

    def measure(self, slot: int) -> None:
        pass

    def packet(self, rows: Any, **header: Any) -> Packet:
        return a_scan(**header)


def test_a_new_packet_is_published_under_the_topic_of_its_sensor(shared_runtime: Any):
    """Nothing in the live stack knows the sensor or its packets."""
    config = make_config(sensors={"scanner": {"kind": "test_scanner"}}, **{"live.mode": "lockstep"})
    with LiveRig(config) as rig:
        scans = rig.listen("/drone/scanner", message_type(RangeScan))
        rig.fly(rig.listen("/drone/odometry", msg.Odometry), 3)
        first, second = scans.recv(SOON_S), scans.recv(SOON_S)
    assert (first.stamp_ns, second.stamp_ns, second.ranges.tolist()) == (
        0,
        5_000_000,
        [0.0, 1.0, 2.0, 3.0, 4.0],
    )
