"""A robot in ROS: what the bridge makes of a simulator's messages comes back as it was."""

from __future__ import annotations

import contextlib
import dataclasses
from typing import Any

import numpy as np
import pytest
from bridge_rig import rig_of
from processes import wait_for

from cortex import messages as msg
from cortex import reliable
from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.config import ConfigError, load
from cortex_ros2_bridge.convert import RULES, Context, ConvertError

PERIOD_NS = 20_000_000


def conversion(cortex_type: str, *, robot: bool, direction: str) -> Any:
    """Return the first rule of a type."""
    return next(
        rule.convert
        for rule in RULES
        if (rule.cortex_type, rule.robot, rule.direction) == (f"cortex/{cortex_type}", robot, direction)
    )


def window(step: int, count: int) -> msg.Events:
    """Return the events of a window, the last of them at its end."""
    rng = np.random.default_rng(step)
    t = np.sort(rng.integers(20_000 * (step - 1) + 1, 20_000 * step + 1, count))
    t[count - 1 :] = 20_000 * step
    x, y = (rng.integers(0, 48, count).astype(np.uint16) for _ in range(2))
    polarity = rng.integers(0, 2, count).astype(np.uint8)
    return msg.Events(
        stamp_ns=PERIOD_NS * step, t=t, x=x, y=y, polarity=polarity, width=48, height=48, sequence=step
    )


def test_odometry_there_and_back():
    q = np.array([0.1, -0.2, 0.3, 0.9])
    sent = msg.Odometry(
        stamp_ns=3_000_000_007,
        position=np.array([1.0, 2.0, 3.0]),
        orientation=q / np.linalg.norm(q),
        velocity=np.array([0.4, -0.5, 0.6]),
        body_rate=np.array([0.1, 0.2, -0.3]),
    )
    data = conversion("Odometry", robot=False, direction="out")(sent, Context(vehicle="drone"))
    back = conversion("Odometry", robot=True, direction="in")(data, Context(vehicle="drone"))
    assert back.stamp_ns == sent.stamp_ns
    for name in ("position", "orientation", "velocity", "body_rate"):
        np.testing.assert_allclose(getattr(back, name), getattr(sent, name), atol=1e-12, err_msg=name)


@pytest.mark.parametrize("encoding", ["evt3", "mono"])
def test_events_there_and_back(encoding):
    """Windows, one of them empty, then time begins again: stamps are the ends of the windows."""
    there = Context(vehicle="drone", options={"encoding": encoding})
    back = Context(vehicle="drone", options={"packet_rate_hz": 50.0})
    out = conversion("Events", robot=False, direction="out")
    into = conversion("Events", robot=True, direction="in")
    for step, count in ((900, 40), (901, 0), (902, 1), (903, 500), (1, 30), (2, 30)):
        if step == 1:
            there = Context(vehicle="drone", options={"encoding": encoding})
        sent = window(step, count)
        got = into(bytes(out(sent, there)), back)
        for name in ("stamp_ns", "width", "height", "sequence"):
            assert getattr(got, name) == getattr(sent, name), (step, name)
        for name in ("t", "x", "y", "polarity"):
            np.testing.assert_array_equal(getattr(got, name), getattr(sent, name), err_msg=f"{step} {name}")


def test_events_without_a_rate_have_the_stamp_of_the_last_one():
    sent = window(7, 20)
    sent.t[:] -= 500
    data = conversion("Events", robot=False, direction="out")(sent, Context(vehicle="drone"))
    got = conversion("Events", robot=True, direction="in")(bytes(data), Context(vehicle="drone"))
    assert got.stamp_ns == PERIOD_NS * 7 - 500_000


def test_packets_that_cannot_be_read_are_refused():
    data = bytes(conversion("Events", robot=False, direction="out")(window(1, 3), Context(vehicle="drone")))
    other = data.replace(b"evt3", b"evt2")
    with pytest.raises(
        ConvertError, match=r"EventPacket\.encoding must be evt3, mono, libcaer or libcaer_cmp, got 'evt2'"
    ):
        conversion("Events", robot=True, direction="in")(other, Context(vehicle="drone"))


def test_packets_beyond_the_sensor_or_of_no_time():
    """Events beyond the sensor are left out; a time that no clock has is an error."""
    options = Context(vehicle="drone", options={"encoding": "mono"})
    data = conversion("Events", robot=False, direction="out")(window(1, 40), options)
    packet = cdr.decode(data, "event_camera_msgs/msg/EventPacket")
    into = conversion("Events", robot=True, direction="in")
    narrow = into(cdr.encode(dataclasses.replace(packet, width=20)), Context(vehicle="drone"))
    sent = window(1, 40)
    np.testing.assert_array_equal(narrow.x, sent.x[sent.x < 20])
    with pytest.raises(ConvertError, match="time_base"):
        into(cdr.encode(dataclasses.replace(packet, time_base=2**63)), Context(vehicle="drone"))


def test_only_what_a_robot_has_crosses(runtime):
    """A controller that subscribes to odometry gets it from ROS, its command goes there; all else stays."""
    settings = {"robot": True, "routes": [{"cortex": "*/command/rates", "options": {"max_thrust_n": 10.0}}]}
    with rig_of(settings) as rig:
        states = rig.simulator.subscriber("/drone/odometry", msg.Odometry, policy=reliable(8))
        commands = rig.simulator.publisher("/drone/command/rates", msg.RateThrustCommand)
        rig.simulator.publisher("/drone/imu", msg.Imu)
        (subscription,) = rig.subscribes("/drone/odometry")
        (publisher,) = rig.opens("/drone/attitude_target")
        assert set(rig.backend.publishers) & {"/drone/imu", "/clock"} == set()
        still = np.zeros(3)
        state = msg.Odometry(
            stamp_ns=5,
            position=still,
            orientation=np.array([0.0, 0.0, 0.0, 1.0]),
            velocity=still,
            body_rate=still,
        )
        data = conversion("Odometry", robot=False, direction="out")(state, Context(vehicle="drone"))
        subscription.put(bytes(data))

        def arrived() -> Any:
            with contextlib.suppress(TimeoutError):
                return states.recv(0.01)

        assert rig.update_until(arrived).stamp_ns == 5
        with rig.listening(commands, "/drone/attitude_target"):
            commands.publish(
                msg.RateThrustCommand(
                    stamp_ns=5, thrust_n=2.5, body_rate=np.array([0.1, 0.2, 0.3]), sequence=0
                )
            )
            (target,) = wait_for(publisher.messages)
        assert target.thrust == 0.25
        assert (target.type_mask, target.header.stamp.nanosec) == (128, 5)


def test_a_bag_is_no_robot():
    with pytest.raises(ConfigError, match="robot: true: nothing comes out of a bag"):
        load({"backend": "run.mcap", "robot": True})
