"""The bridge between Cortex and a backend that records: what flows, when, and what is counted."""

from __future__ import annotations

import dataclasses
import itertools
import logging
import os
import threading

import numpy as np
import pytest
from bridge_rig import camera_info, image, imu, odometry, rig_of, stamp_ns, transform
from processes import SOON_S, wait_for
from runtime_directory import own_directory

from cortex import Node, message
from cortex import messages as msg
from cortex_ros2_bridge import links
from cortex_ros2_bridge.backend.base import BackendError, Qos, TopicInfo
from cortex_ros2_bridge.config import ConfigError
from cortex_ros2_bridge.msgs import message_class
from cortex_ros2_bridge.routes import look
from cortex_ros2_bridge.typestore import typestore

IMU = "/drone/imu -> /drone/imu"


@pytest.fixture(scope="module", autouse=True)
def one_registry():
    """All tests of this module share a runtime directory."""
    with pytest.MonkeyPatch.context() as monkeypatch, own_directory(monkeypatch):
        yield


# Cortex to ROS


def test_nothing_is_subscribed_to_until_ros_listens():
    """The sensor is not even computed: its publisher has no subscriber before and after."""
    with rig_of() as rig:
        sent = rig.simulator.publisher("/drone/imu", msg.Imu)
        (ros,) = rig.opens("/drone/imu")
        rig.updates_during()
        sent.publish(imu(1))
        assert sent.subscriber_count == 0
        with rig.listening(sent, "/drone/imu"):
            sent.publish(imu(5_000_000_007))
            got = wait_for(lambda: ros.messages())
        rig.update_until(lambda: sent.subscriber_count == 0)
        sent.publish(imu(9))
        rig.updates_during()
        assert len(ros.sent) == 1
        assert rig.tally(IMU).sent == rig.tally(IMU).received == 1
    assert stamp_ns(got[0].header) == 5_000_000_007
    assert got[0].angular_velocity.z == 3.0
    assert got[0].header.frame_id == "drone/imu"


def test_code_for_a_type_is_generated_before_its_first_message():
    """With the first message it would hold up all streams, for longer than Cortex keeps events at 10 MHz."""
    store = typestore()
    for cached in (links._warm_up.cache_clear, store.cache.clear):
        cached()
    with rig_of() as rig:
        rig.simulator.publisher("/drone/rgb", msg.Image)
        rig.opens("/drone/rgb/image_raw")
        assert "sensor_msgs/msg/Image" in store.cache


def test_an_image_and_its_calibration_have_one_stamp():
    with rig_of() as rig:
        info = rig.simulator.publisher("/drone/rgb/info", msg.CameraInfo, latch=True)
        info.publish(camera_info("rgb"))
        sent = rig.simulator.publisher("/drone/rgb", msg.Image)
        names = "/drone/rgb/image_raw", "/drone/rgb/camera_info"
        pictures, infos = rig.opens(*names)
        rig.update_until(lambda: info.subscriber_count == 1)
        with rig.listening(sent, *names):
            stamps = itertools.count(33_333_333, 33_333_333)

            def take_two() -> bool:
                sent.publish(image(next(stamps)))
                return len(infos.sent) >= 2

            wait_for(take_two, every_s=0.02)
        found = [stamp_ns(m.header) for m in infos.messages()]
        assert found[1] == found[0] + 33_333_333
        assert set(found) <= {stamp_ns(m.header) for m in pictures.messages()}
        picture, calibration = pictures.messages()[0], infos.messages()[0]
    assert (picture.width, picture.height, picture.encoding, picture.step) == (4, 3, "rgb8", 12)
    assert bytes(picture.data) == bytes(range(36))
    assert (calibration.width, calibration.height) == (4, 3)
    assert picture.header.frame_id == calibration.header.frame_id == "drone/rgb_optical_frame"


def test_a_calibration_that_is_seen_before_its_image():
    """First it is a latched topic of its own; then it goes with the image, as the image does."""
    with rig_of() as rig:
        info = rig.simulator.publisher("/drone/rgb/info", msg.CameraInfo, latch=True)
        info.publish(camera_info("rgb"))
        (alone,) = rig.opens("/drone/rgb/camera_info")
        rig.update_until(lambda: alone.sent)
        assert alone.qos.durability == "transient_local"
        sent = rig.simulator.publisher("/drone/rgb", msg.Image)
        rig.opens("/drone/rgb/image_raw")
        (together,) = rig.opens("/drone/rgb/camera_info")
        assert alone.closed
        assert together.qos.durability == "volatile"
        with rig.listening(sent, "/drone/rgb/camera_info"):
            rig.update_until(lambda: info.subscriber_count == 1)
            wait_for(lambda: sent.publish(image(7)) and together.sent, every_s=0.02)
        assert stamp_ns(together.messages()[0].header) == 7


def test_the_state_of_a_simulator_that_has_gone_is_not_repeated():
    with rig_of() as rig, Node("another") as another:
        state = another.publisher("/drone/odometry", msg.Odometry, latch=True)
        state.publish(odometry(7))
        ros, moving = rig.opens("/drone/odometry", "/tf")
        rig.clock.stop()
        with rig.backend.listening("/drone/odometry"):
            rig.update_until(lambda: ros.sent)
            another.close()
            rig.update_until(lambda: not look(rig.node).topics)
            rig.updates_during(1)
            rig.updates_during(every_s=0.2)
            assert len(ros.sent) == 1
            with rig.backend.listening("/tf"):
                rig.updates_during()
                assert moving.sent == []


def test_who_comes_later_to_a_latched_state_gets_it():
    """While odometry is subscribed to for one listener, another one on /tf hears of the state that holds."""
    with rig_of() as rig:
        state = rig.simulator.publisher("/drone/odometry", msg.Odometry, latch=True)
        state.publish(odometry(3_000_000_000))
        ros, moving = rig.opens("/drone/odometry", "/tf")
        with rig.listening(state, "/drone/odometry"):
            wait_for(lambda: ros.sent)
            craft = Craft(rig, velocity=msg.VelocityCommand)
            (twist,) = rig.subscribes("/drone/cmd_vel")
            with rig.backend.listening("/tf"):
                rig.update_until(lambda: moving.sent)
                assert stamp_ns(moving.messages()[0].transforms[0].header) == 3_000_000_000
            rig.update_until(craft.connected)
            twist.put(message_class("geometry_msgs/msg/Twist")())
            assert craft.recv("velocity").stamp_ns == 3_000_000_000


def test_only_what_is_listened_to_is_converted():
    """With a listener for the calibration only, no picture is converted."""
    with rig_of() as rig:
        info = rig.simulator.publisher("/drone/rgb/info", msg.CameraInfo, latch=True)
        info.publish(camera_info("rgb"))
        sent = rig.simulator.publisher("/drone/rgb", msg.Image)
        pictures, infos = rig.opens("/drone/rgb/image_raw", "/drone/rgb/camera_info")
        rig.update_until(lambda: rig.has_calibration("/drone/rgb/camera_info"))
        with rig.listening(sent, "/drone/rgb/camera_info"):
            sent.publish(image(1))
            wait_for(lambda: infos.sent)
        assert pictures.sent == []
        assert rig.tally("/drone/rgb -> /drone/rgb/image_raw").received == 0


def test_frames_hang_together():
    """/tf_static has, in one message, map to odom and every sensor; /tf moves the vehicle in odom."""
    with rig_of() as rig:
        state = rig.simulator.publisher("/drone/odometry", msg.Odometry, latch=True)
        for sensor in ("imu", "rgb"):
            mount = rig.simulator.publisher(f"/drone/{sensor}/transform", msg.Transform, latch=True)
            mount.publish(transform(sensor))
        moving, static = rig.opens("/tf", "/tf_static")
        rig.update_until(lambda: static.sent and len(static.messages()[-1].transforms) == 3)
        links = {(t.header.frame_id, t.child_frame_id) for t in static.messages()[-1].transforms}
        with rig.listening(state, "/tf"):
            state.publish(odometry(2_000_000_000))
            wait_for(lambda: moving.sent)
        (moved,) = moving.messages()[-1].transforms
    assert links == {
        ("map", "drone/odom"),
        ("drone/base_link", "drone/imu"),
        ("drone/base_link", "drone/rgb"),
    }
    assert (moved.header.frame_id, moved.child_frame_id) == ("drone/odom", "drone/base_link")
    assert (moved.transform.translation.x, moved.transform.translation.z) == (1.0, 3.0)
    assert static.qos.durability == "transient_local"
    assert static.qos.depth == 1


BAD_TRANSFORMS = {
    "not finite": {"translation": np.array([np.nan, 0.0, 0.0])},
    "its rotation is zero": {"rotation": np.zeros(4)},
    "a transform from": {"parent": ""},
    "its parent is itself": {"parent": "drone/imu"},
    "seconds have 32 bits": {"stamp_ns": 2**62},
}


@pytest.mark.parametrize("reason", BAD_TRANSFORMS)
def test_a_transform_that_is_none_is_refused_and_the_old_one_stays(reason, caplog):
    """It must not end the bridge: the next bridge would get it too, as it is latched."""
    with rig_of() as rig:
        mount = rig.simulator.publisher("/drone/imu/transform", msg.Transform, latch=True)
        mount.publish(transform("imu", x=0.5))
        (static,) = rig.opens("/tf_static")
        rig.update_until(lambda: static.sent)
        mount.publish(dataclasses.replace(transform("imu"), **BAD_TRANSFORMS[reason]))
        rig.update_until(lambda: rig.tally("/drone/imu/transform -> /tf_static").refused == 1)
        rig.updates_during()
        (kept,) = static.messages()[-1].transforms
        assert kept.transform.translation.x == 0.5
        assert rig.tally("/drone/imu/transform -> /tf_static").sent == 1
    assert reason in caplog.text


def test_static_transforms_stay_as_long_as_their_topic():
    """Also those of frames that are not named after a vehicle, as a real sensor's; then nobody gets them."""
    with rig_of() as rig, Node("sensor") as sensor:
        mount = sensor.publisher("/robot/cam/transform", msg.Transform, latch=True)
        mount.publish(dataclasses.replace(transform("x"), parent="base_link", child="cam_link"))
        (static,) = rig.opens("/tf_static")
        rig.update_until(lambda: static.sent)
        rig.simulator.publisher("/robot/imu", msg.Imu)
        rig.opens("/robot/imu")
        rig.updates_during()
        assert [t.child_frame_id for t in static.messages()[-1].transforms] == ["cam_link"]
        sensor.close()
        rig.update_until(lambda: static.closed or static.messages()[-1].transforms == [], every_s=1.0)


def test_a_mistake_in_the_bridge_is_said_and_does_not_end_it(monkeypatch, caplog):
    with rig_of() as rig:
        stop, looks = threading.Event(), []

        def fail() -> None:
            looks.append(1)
            if len(looks) == 3:
                stop.set()
            raise ZeroDivisionError("it cannot be")

        monkeypatch.setattr(rig.bridge, "update", fail)
        rig.bridge.run(stop)
        assert len(looks) == 3
        assert caplog.text.count("ZeroDivisionError: it cannot be") == 1
        monkeypatch.undo()
        with rig.backend.listening("/diagnostics") as (diagnostics,):
            rig.update_until(lambda: len(diagnostics.sent) > 1, every_s=1.0)
        then, now = (message.status[0] for message in diagnostics.messages()[:2])
        assert (then.level, now.level) == (2, 1)  # no simulator runs
        assert "ZeroDivisionError: it cannot be" in then.message


def test_the_transform_of_a_sensor_that_moved_replaces_the_old_one():
    with rig_of() as rig:
        mount = rig.simulator.publisher("/drone/imu/transform", msg.Transform, latch=True)
        mount.publish(transform("imu"))
        (static,) = rig.opens("/tf_static")
        rig.update_until(lambda: static.sent)
        mount.publish(transform("imu", x=0.5))
        rig.update_until(lambda: static.messages()[-1].transforms[0].transform.translation.x == 0.5)
        assert len(static.messages()[-1].transforms) == 1


def test_new_topics_appear_and_old_ones_are_closed():
    """A topic that comes back in time finds its ROS publisher, and so do the subscribers in ROS."""
    with rig_of() as rig:
        rig.simulator.publisher("/drone/imu", msg.Imu)
        rig.opens("/drone/imu")
        second = rig.simulator.publisher("/drone/gyro", msg.Imu)
        (before,) = rig.opens("/drone/gyro")
        second.close()
        rig.update_until(lambda: len(look(rig.node).topics) == 1)
        rig.updates_during()
        assert not before.closed
        second = rig.simulator.publisher("/drone/gyro", msg.Imu)
        with rig.listening(second, "/drone/gyro"):
            second.publish(imu(3))
            wait_for(lambda: before.sent)
        second.close()
        rig.update_until(lambda: len(look(rig.node).topics) == 1)
        rig.updates_during(1)
        rig.updates_during(5, every_s=1.0)
        assert not before.closed
        rig.updates_during(6, every_s=1.0)
        assert before.closed
        assert set(rig.backend.publishers) == {"/drone/imu", "/diagnostics"}
        assert list(rig.bridge.totals()) == [IMU]


def test_a_topic_that_came_back_stays():
    """The time that it had to come back is over, and nothing happens."""
    with rig_of() as rig:
        first = rig.simulator.publisher("/drone/imu", msg.Imu)
        (ros,) = rig.opens("/drone/imu")
        first.close()
        rig.update_until(lambda: not look(rig.node).topics)
        rig.updates_during()
        rig.simulator.publisher("/drone/imu", msg.Imu)
        rig.update_until(lambda: look(rig.node).topics)
        rig.updates_during(every_s=1.0)
        assert not ros.closed


def test_a_latched_state_is_sent_again_to_a_subscriber_that_may_have_been_too_early():
    """DDS counts a subscriber before that one hears us, and nobody else repeats the state of stamp 0."""
    with rig_of() as rig:
        state = rig.simulator.publisher("/drone/odometry", msg.Odometry, latch=True)
        state.publish(odometry(0))
        ros, moving = rig.opens("/drone/odometry", "/tf")
        rig.clock.stop()
        with rig.backend.listening("/drone/odometry"):
            for count, wait_s in ((1, 0.11), (2, 0.4), (3, 1.5), (4, 10.0)):
                rig.update_until(lambda count=count: len(ros.sent) == count)
                rig.updates_during()
                assert len(ros.sent) == count
                rig.clock.put_forward(wait_s)
            rig.updates_during()
            assert len(ros.sent) == 4
            assert len(set(ros.sent)) == 1
            assert moving.sent == []
        rig.update_until(lambda: state.subscriber_count == 0)
        with rig.backend.listening("/drone/odometry"):
            rig.update_until(lambda: state.subscriber_count == 1)
            for stamp in range(5, 255):
                before = len(ros.sent)
                state.publish(odometry(stamp))
                wait_for(lambda before=before: len(ros.sent) > before)
                rig.updates_during(1, every_s=0.01)
        new = [data for data in ros.sent if data != ros.sent[0]]
        assert len(set(new)) == len(new) == 250  # what streams is not repeated


def test_what_cannot_be_converted_is_counted_and_the_next_one_goes_through(caplog):
    with rig_of() as rig, caplog.at_level(logging.WARNING, "cortex_ros2_bridge"):
        sent = rig.simulator.publisher("/drone/rgb", msg.Image)
        (ros,) = rig.opens("/drone/rgb/image_raw")
        with rig.listening(sent, "/drone/rgb/image_raw"):
            bad = image(1)
            sent.publish(msg.Image(stamp_ns=1, data=bad.data, encoding="klingon"))
            sent.publish(image(2))
            wait_for(lambda: ros.sent)
        counts = rig.tally("/drone/rgb -> /drone/rgb/image_raw")
    assert (counts.received, counts.sent, counts.refused) == (2, 1, 1)
    assert any("refused 1" in r.getMessage() and "klingon" in r.getMessage() for r in caplog.records)


def test_a_backend_that_does_not_take_a_message_loses_it_counted():
    with rig_of() as rig:
        sent = rig.simulator.publisher("/drone/imu", msg.Imu)
        (ros,) = rig.opens("/drone/imu")
        with rig.listening(sent, "/drone/imu"):
            ros.error = "the network is on fire"
            sent.publish(imu(1))
            wait_for(lambda: rig.tally(IMU).lost == 1)
            ros.error = None
            sent.publish(imu(2))
            wait_for(lambda: ros.sent)
        assert (rig.tally(IMU).received, rig.tally(IMU).sent) == (2, 1)


def test_a_bridge_that_is_too_slow_loses_messages_counted_and_holds_nobody_up():
    """What was sent is what was sent on and what was lost; publishing is not delayed by a blocked backend."""
    with rig_of({"routes": [{"cortex": "/drone/imu", "options": {"queue": 4}}]}) as rig:
        sent = rig.simulator.publisher("/drone/imu", msg.Imu)
        (ros,) = rig.opens("/drone/imu")
        go_on, publish = threading.Event(), ros.publish

        def blocked(data):
            assert go_on.wait(SOON_S)
            publish(data)

        ros.publish = blocked
        with rig.listening(sent, "/drone/imu"):
            for n in range(3000):
                sent.publish(imu(n, sequence=n))
            go_on.set()
            rig.update_until(lambda: (c := rig.tally(IMU)).received == 3000 == c.sent + c.lost)
            assert rig.tally(IMU).lost > 1000


def test_a_route_that_ros_refuses_is_said_and_the_others_work(caplog):
    with rig_of() as rig, caplog.at_level(logging.WARNING, "cortex_ros2_bridge"):
        rig.backend.refuse["/drone/imu"] = ValueError("such a topic must not be")
        rig.simulator.publisher("/drone/imu", msg.Imu)
        rig.simulator.publisher("/drone/gyro", msg.Imu)
        rig.opens("/drone/gyro")
        rig.updates_during()
        assert rig.bridge.problems == [f"no route {IMU}: such a topic must not be"]
    said = [r for r in caplog.records if "must not be" in r.getMessage()]
    assert len(said) == 1


def test_a_route_that_fails_for_now_is_tried_again():
    with rig_of() as rig:
        rig.backend.refuse["/drone/imu"] = BackendError("the network is down")
        rig.simulator.publisher("/drone/imu", msg.Imu)
        rig.update_until(lambda: rig.bridge.problems)
        assert "the network is down" in rig.bridge.problems[0]
        del rig.backend.refuse["/drone/imu"]
        rig.clock.put_forward(1.0)
        rig.opens("/drone/imu")
        assert rig.bridge.problems == []


def test_foreign_types_are_said_once(caplog):
    @message(name="lab/Sonar")
    class Sonar:
        range_m: float | None = None

    with rig_of() as rig, caplog.at_level(logging.WARNING, "cortex_ros2_bridge"):
        rig.simulator.publisher("/drone/sonar", Sonar)
        rig.simulator.publisher("/drone/imu", msg.Imu)
        rig.opens("/drone/imu")
        rig.update_until(lambda: rig.bridge.problems)
        rig.simulator.publisher("/drone/gyro", msg.Imu)
        rig.opens("/drone/gyro")
    said = [r.getMessage() for r in caplog.records if "lab/Sonar" in r.getMessage()]
    (text,) = said
    assert text.startswith(
        "no route for /drone/sonar of type lab/Sonar: its field range_m has no counterpart"
    )


def test_wrong_names_of_frames_are_refused():
    with pytest.raises(ConfigError, match="frames"), rig_of({"frames": {"wrold": "map"}}):
        pass


# ROS to Cortex


def actuators(*speeds, stamp=0, frame=""):
    command = message_class("actuator_msgs/msg/Actuators")()
    stamped(command.header, stamp, frame)
    command.velocity = list(speeds)
    return command


def stamped(header, stamp, frame=""):
    header.stamp.sec, header.stamp.nanosec = divmod(stamp, 1_000_000_000)
    header.frame_id = frame


def attitude_target(*, mask, stamp=0, thrust=0.5):
    command = message_class("mavros_msgs/msg/AttitudeTarget")()
    stamped(command.header, stamp)
    command.type_mask, command.thrust = mask, thrust
    command.orientation.w = 1.0
    command.body_rate.z = 0.25
    return command


class Craft:
    """The inbox of a simulator."""

    def __init__(self, rig, **kinds):
        self.subscribers = {
            mode: rig.simulator.subscriber(f"/drone/command/{mode}", kind) for mode, kind in kinds.items()
        }

    def connected(self):
        return all(subscriber.publisher_count == 1 for subscriber in self.subscribers.values())

    def recv(self, mode):
        return self.subscribers[mode].recv(SOON_S)


def test_every_command_reaches_its_topic():
    """One message of each ROS type; AttitudeTarget goes where its mask says."""
    with rig_of({"routes": [{"cortex": "*", "type": "mavros_msgs/AttitudeTarget",
                             "options": {"max_thrust_n": 20.0}}]}) as rig:  # fmt: skip
        craft = Craft(
            rig,
            motor_speeds=msg.MotorCommand,
            rates=msg.RateThrustCommand,
            attitude=msg.AttitudeCommand,
            velocity=msg.VelocityCommand,
            position=msg.PoseCommand,
        )
        state = rig.simulator.publisher("/drone/odometry", msg.Odometry, latch=True)
        state.publish(odometry(1_000_000_000))
        topics = ("actuators", "attitude_target", "cmd_vel", "command_velocity", "command_pose")
        rotors, target, twist, twist_stamped, pose = rig.subscribes(*(f"/drone/{t}" for t in topics))
        twist.publisher_count = 1
        rig.update_until(lambda: craft.connected() and state.subscriber_count == 1)
        rig.update_until(lambda: rig.has_seen("drone", now_ns=1_000_000_000))

        rotors.put(actuators(1.0, 2.0, 3.0, 4.0, stamp=1_000_000_000))
        command = craft.recv("motor_speeds")
        np.testing.assert_array_equal(command.speed, [1.0, 2.0, 3.0, 4.0])
        assert command.stamp_ns == 1_000_000_000

        target.put(attitude_target(mask=128, stamp=1_000_000_000))
        command = craft.recv("rates")
        np.testing.assert_array_equal(command.body_rate, [0.0, 0.0, 0.25])
        assert command.thrust_n == 10.0
        target.put(attitude_target(mask=7, stamp=1_000_000_000))
        np.testing.assert_array_equal(craft.recv("attitude").orientation, [0.0, 0.0, 0.0, 1.0])

        velocity = message_class("geometry_msgs/msg/Twist")()
        velocity.linear.x, velocity.angular.z = 1.5, 0.2
        twist.put(velocity)
        command = craft.recv("velocity")
        # Forward is north: the vehicle is turned by 90 degrees. No stamp: that of the newest state.
        np.testing.assert_allclose(command.velocity, [0.0, 1.5, 0.0], atol=1e-12)
        assert (command.yaw_rate_rad_s, command.stamp_ns) == (0.2, 1_000_000_000)
        command = message_class("geometry_msgs/msg/TwistStamped")()
        stamped(command.header, 1_000_000_000, "map")
        command.twist.linear.x = 1.5
        twist_stamped.put(command)
        np.testing.assert_allclose(craft.recv("velocity").velocity, [1.5, 0.0, 0.0], atol=1e-12)

        command = message_class("geometry_msgs/msg/PoseStamped")()
        stamped(command.header, 1_000_000_000, "map")
        command.pose.position.z = 2.0
        pose.put(command)
        assert craft.recv("position").position[2] == 2.0
        totals = rig.bridge.totals()
    assert {name: (t.received, t.sent, t.refused) for name, t in totals.items() if "<-" in name} == {
        "/drone/command/motor_speeds <- /drone/actuators": (1, 1, 0),
        "/drone/command/rates <- /drone/attitude_target": (1, 1, 0),
        "/drone/command/attitude <- /drone/attitude_target": (1, 1, 0),
        "/drone/command/velocity <- /drone/cmd_vel": (1, 1, 0),
        "/drone/command/velocity <- /drone/command_velocity": (1, 1, 0),
        "/drone/command/position <- /drone/command_pose": (1, 1, 0),
        "/drone/command/position <- /drone/command_trajectory": (0, 0, 0),
    }


ROTORS = "/drone/command/motor_speeds <- /drone/actuators"


def test_commands_that_must_not_fly_are_refused_counted_and_reported(caplog):
    """Stale, from another clock, not finite, truncated and garbage; good ones pass."""
    with rig_of() as rig, caplog.at_level(logging.WARNING, "cortex_ros2_bridge"):
        craft = Craft(rig, motor_speeds=msg.MotorCommand)
        state = rig.simulator.publisher("/drone/odometry", msg.Odometry, latch=True)
        state.publish(odometry(10_000_000_000))
        (rotors,) = rig.subscribes("/drone/actuators")
        rotors.publisher_count = 1
        rig.update_until(lambda: craft.connected() and state.subscriber_count == 1)
        rig.update_until(lambda: rig.has_seen("drone", now_ns=10_000_000_000))
        for command in (
            actuators(1.0, stamp=9_400_000_000),
            actuators(1.0, stamp=1_763_764_000_000_000_000),
            actuators(float("nan"), stamp=10_000_000_000),
            b"\x00\x01\x00\x00\x01\x00\x00\x00",
            b"",
            b"\x00\x07garbage that is no CDR at all",
            b"\x00\x01\x00\x00" + b"\xff" * 64,
        ):
            rotors.put(command)
            rig.clock.put_forward(1.0)
        rig.clock.stop()
        for _ in range(6):  # within a second one is said
            rotors.put(b"")
        assert rig.tally(ROTORS).refused == rig.tally(ROTORS).received == 13
        rotors.put(actuators(5.0, stamp=9_600_000_000))
        assert craft.recv("motor_speeds").speed[0] == 5.0
        rotors.put(actuators(6.0))
        assert craft.recv("motor_speeds").stamp_ns == 10_000_000_000
        assert rig.tally(ROTORS).sent == 2
    said = [r.getMessage() for r in caplog.records if "refused" in r.getMessage()]
    assert len(said) == 8
    assert all(each.startswith(f"{ROTORS}: refused 1: ") for each in said)
    assert "0.600 s before the newest state" in said[0]
    assert "after the newest state" in said[1]
    assert "use_sim_time" in said[1]
    assert "finite" in said[2]


def test_after_a_reset_the_clock_of_the_new_run_counts():
    """Odometry of stamp 0 makes a command of stamp 0 a fresh one, and those of the old run stale."""
    with rig_of() as rig:
        craft = Craft(rig, motor_speeds=msg.MotorCommand)
        state = rig.simulator.publisher("/drone/odometry", msg.Odometry, latch=True)
        clock = rig.simulator.publisher("/clock", msg.Clock)
        state.publish(odometry(100_000_000_000))
        (rotors,) = rig.subscribes("/drone/actuators")
        rotors.publisher_count = 1
        rig.update_until(lambda: craft.connected() and clock.subscriber_count == 1)
        clock.publish(msg.Clock(100_000_000_000, 0))
        rig.update_until(lambda: rig.has_seen("drone", now_ns=100_000_000_000))
        rotors.put(actuators(1.0, stamp=100_000_000_000))
        state.publish(odometry(0))
        wait_for(lambda: rig.has_seen("drone", now_ns=0))
        rotors.put(actuators(2.0, stamp=100_000_000_000))
        rotors.put(actuators(3.0, stamp=0))
        assert [craft.recv("motor_speeds").speed[0] for _ in range(2)] == [1.0, 3.0]
        assert rig.tally(ROTORS).refused == 1


@pytest.mark.parametrize(
    ("options", "stamp", "passes"),
    [
        ({"stale_s": 2.0}, 9_000_000_000, True),
        ({"stale_s": 0.1}, 9_800_000_000, False),
        ({"stale_s": None}, 5, True),
        ({"stamp": "now"}, 1_763_764_000_000_000_000, True),
    ],
)
def test_options_of_staleness(options, stamp, passes):
    with rig_of({"routes": [{"cortex": "/drone/command/*", "options": options}]}) as rig:
        craft = Craft(rig, motor_speeds=msg.MotorCommand)
        clock = rig.simulator.publisher("/clock", msg.Clock)
        (rotors,) = rig.subscribes("/drone/actuators")
        rotors.publisher_count = 1
        rig.update_until(lambda: craft.connected() and clock.subscriber_count == 1)
        clock.publish(msg.Clock(10_000_000_000, 0))
        wait_for(lambda: rig.has_seen("drone", now_ns=10_000_000_000))
        rotors.put(actuators(1.0, stamp=stamp))
        assert rig.tally(ROTORS).sent == passes
        if options == {"stamp": "now"}:
            assert craft.recv("motor_speeds").stamp_ns == 10_000_000_000


def test_a_refusal_counts_for_the_route_that_the_message_was_meant_for():
    """Of two targets, the mask says which; a mask that neither has is refused, too."""
    with rig_of() as rig:
        craft = Craft(rig, attitude=msg.AttitudeCommand, rates=msg.RateThrustCommand)
        (target,) = rig.subscribes("/drone/attitude_target")
        rig.update_until(craft.connected)
        target.put(attitude_target(mask=7, thrust=2.0))
        target.put(attitude_target(mask=128, thrust=-1.0))
        target.put(attitude_target(mask=128, thrust=-1.0))
        for mode, count in (("attitude", 1), ("rates", 2)):
            assert rig.tally(f"/drone/command/{mode} <- /drone/attitude_target").refused == count


def test_state_and_time_are_followed_only_while_somebody_commands():
    with rig_of() as rig:
        Craft(rig, motor_speeds=msg.MotorCommand)
        state = rig.simulator.publisher("/drone/odometry", msg.Odometry, latch=True)
        (rotors,) = rig.subscribes("/drone/actuators")
        rig.opens("/drone/odometry")
        rig.updates_during()
        assert state.subscriber_count == 0
        rig.simulator.subscriber("/bravo/command/motor_speeds", msg.MotorCommand)
        other = rig.simulator.publisher("/bravo/odometry", msg.Odometry, latch=True)
        rig.subscribes("/bravo/actuators")
        rig.opens("/bravo/odometry")
        rotors.publisher_count = 1
        rig.update_until(lambda: state.subscriber_count == 1)
        rig.updates_during()
        assert other.subscriber_count == 0
        rotors.publisher_count = 0
        rig.update_until(lambda: state.subscriber_count == 0)


def test_who_comes_to_command_is_told_the_state_again():
    """What it answered when DDS knew it only halfway was heard by nobody."""
    with rig_of() as rig:
        Craft(rig, motor_speeds=msg.MotorCommand)
        state = rig.simulator.publisher("/drone/odometry", msg.Odometry, latch=True)
        state.publish(odometry(0))
        (rotors,) = rig.subscribes("/drone/actuators")
        (ros,) = rig.opens("/drone/odometry")
        rig.clock.stop()
        with rig.listening(state, "/drone/odometry"):
            wait_for(lambda: ros.sent)
            rig.updates_during(every_s=0.2)  # it is told again as it may have come too early itself
            told = len(ros.sent)
            rig.updates_during(every_s=0.2)
            assert len(ros.sent) == told
            rotors.publisher_count = 1
            rig.updates_during(every_s=0.2)
        assert len(ros.sent) == 2 * told - 1
        assert len(set(ros.sent)) == 1


def test_a_command_waits_for_a_simulator_that_is_about_to_listen():
    """The newest of those that came too early; one that nobody ever takes is lost, and counted."""
    with rig_of() as rig, Node("other") as other:
        early = other.subscriber("/drone/command/motor_speeds", msg.MotorCommand)
        (rotors,) = rig.subscribes("/drone/actuators")
        rig.update_until(lambda: early.publisher_count == 1)
        early.close()
        publisher = rig.bridge._connections._cortex_publishers.values()[0]
        wait_for(lambda: publisher.subscriber_count == 0)
        rotors.put(actuators(1.0))
        rotors.put(actuators(2.0))
        craft = Craft(rig, motor_speeds=msg.MotorCommand)
        rig.update_until(lambda: rig.tally(ROTORS).sent == 1)
        assert craft.recv("motor_speeds").speed[0] == 2.0
        assert rig.tally(ROTORS).lost == 1
        craft.subscribers["motor_speeds"].close()
        wait_for(lambda: publisher.subscriber_count == 0)
        rotors.put(actuators(3.0))
        rig.update_until(lambda: rig.tally(ROTORS).lost == 2, every_s=0.5)


def test_requests_as_topics_and_as_services():
    """Empty and UInt32 become requests; a refusal is an answer, a service that is gone an error in time."""
    asked = []

    def answer(request):
        asked.append(request)
        refused = isinstance(request, msg.Step) and request.count > 5
        return msg.SimulatorReply(not refused, "not so many" if refused else "", 0, "paused")

    with rig_of() as rig, Node("services") as server:
        for name, kind in (("/reset", msg.Reset), ("/step", msg.Step), ("/pause", msg.Trigger)):
            server.service(name, kind, msg.SimulatorReply, answer)
        reset, step, pause = rig.subscribes("/reset", "/step", "/pause")
        reset.put(message_class("std_msgs/msg/Empty")())
        wait_for(lambda: asked)
        step.put(message_class("std_msgs/msg/UInt32")(data=3))
        wait_for(lambda: len(asked) == 2)
        pause.put(message_class("std_msgs/msg/Empty")())
        wait_for(lambda: len(asked) == 3)
        assert asked == [msg.Reset(), msg.Step(3), msg.Trigger()]
        done = rig.backend.services["/reset"].call()
        assert (done.success, done.message) == (True, "")
        step.put(message_class("std_msgs/msg/UInt32")(data=6))
        wait_for(lambda: rig.tally("/step <- /step").refused == 1)
        step.put(b"\x00\x01\x00\x00\x01")
        assert rig.tally("/step <- /step").refused == 2
        assert rig.tally("/reset <- /reset").sent == 2


def test_closing_gives_up_a_call_that_is_under_way():
    release = threading.Event()

    def answer(request):
        release.wait(SOON_S)
        return msg.SimulatorReply(True, "", 0, "running")

    with rig_of() as rig, Node("services") as server:
        server.service("/step", msg.Step, msg.SimulatorReply, answer)
        (step,) = rig.subscribes("/step")
        for _ in range(10):
            step.put(message_class("std_msgs/msg/UInt32")(data=1))
        assert rig.tally("/step <- /step").refused >= 4
        threads = {t.name for t in threading.enumerate()}
        rig.bridge.close()
        assert "call /step" in threads
        assert "call /step" not in {t.name for t in threading.enumerate()}
        release.set()


# Both


def status_of(phase, reason, vehicle):
    return msg.SimulatorStatus(1, 2, phase, reason, "streaming", 1, 1, 7, 1, 2, 3, 4, 5, 6, [], [vehicle])


def test_another_type_on_a_topic_is_said_with_the_topic_for_it(caplog):
    """The classical mistake: a Twist where a TwistStamped is wanted."""
    with rig_of() as rig:
        Craft(rig, velocity=msg.VelocityCommand)
        rig.simulator.publisher("/drone/imu", msg.Imu)
        rig.opens("/drone/imu")
        rig.subscribes("/drone/command_velocity")
        rig.backend.others = [
            TopicInfo("/drone/command_velocity", "geometry_msgs/msg/Twist", (Qos(),), ()),
            TopicInfo("/drone/imu", "sensor_msgs/msg/Image", (), (Qos(),)),
            TopicInfo("/drone/cmd_vel", "geometry_msgs/msg/Twist", (Qos(),), ()),
            TopicInfo("/elsewhere", "geometry_msgs/msg/Twist", (Qos(),), (Qos(),)),
            TopicInfo("/drone/command_vel", "geometry_msgs/msg/TwistStamped", (Qos(),), ()),
            TopicInfo("/drone/command_speed", "geometry_msgs/msg/TwistStamped", (Qos(),), (Qos(),)),
            TopicInfo("/drone/command_velocity_raw", "geometry_msgs/msg/Twist", (), (Qos(),)),
            TopicInfo("/goal", "geometry_msgs/msg/TwistStamped", (Qos(),), ()),
        ]
        with rig.backend.listening("/diagnostics") as (diagnostics,):
            rig.update_until(lambda: diagnostics.sent, every_s=1.0)
            rig.update_until(lambda: "wanted is" in diagnostics.messages()[-1].status[0].message, every_s=1.0)
            rig.updates_during(every_s=0.2)
            assert diagnostics.messages()[-1].status[0].level == 1
            rig.backend.others = []
            rig.update_until(lambda: diagnostics.messages()[-1].status[0].level == 0, every_s=1.0)
    said = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert said == [
        "/drone/command_velocity: a node publishes geometry_msgs/msg/Twist, wanted is "
        "geometry_msgs/msg/TwistStamped; for geometry_msgs/msg/Twist: /drone/cmd_vel",
        "/drone/imu: a node subscribes to it as sensor_msgs/msg/Image, it is sensor_msgs/msg/Imu",
        "/drone/command_vel: a node publishes geometry_msgs/msg/TwistStamped, which nobody reads; did you "
        "mean /drone/command_velocity?",
    ]


def test_what_does_not_meet_is_said(caplog):
    """A subscriber that wants more than is published, and a publisher of commands that gives less."""
    settings = {
        "routes": [
            {"cortex": "/drone/imu", "qos": "sensor_data"},
            {"cortex": "*", "type": "geometry_msgs/TwistStamped", "qos": "latched"},
        ]
    }
    less, more = Qos(reliability="best_effort"), Qos(durability="transient_local")
    with rig_of(settings) as rig:
        Craft(rig, velocity=msg.VelocityCommand)
        for topic in ("/drone/imu", "/drone/gyro"):
            rig.simulator.publisher(topic, msg.Imu)
        rig.opens("/drone/imu", "/drone/gyro")
        rig.subscribes("/drone/command_velocity")
        rig.backend.others = [
            TopicInfo("/drone/imu", "sensor_msgs/msg/Imu", (), (less, Qos(), Qos())),
            TopicInfo("/drone/gyro", "sensor_msgs/msg/Imu", (), (less, Qos())),
            TopicInfo("/drone/command_velocity", "geometry_msgs/msg/TwistStamped", (more, Qos()), ()),
        ]
        rig.update_until(lambda: "transient local" in caplog.text, every_s=1.0)
        rig.updates_during()
    assert sorted(record.getMessage() for record in caplog.records if "reach" in record.getMessage()) == [
        "/drone/command_velocity does not reach a node: its subscriber wants it transient local, its "
        "publisher is volatile",
        "/drone/imu does not reach a node: its subscriber wants it reliable, its publisher is not",
    ]


def test_the_end_of_a_run_and_what_the_simulator_refuses_are_said(caplog):
    """Once, whoever asks for the status; another run may end again."""
    quiet = msg.VehicleStatus("drone", "motor_speeds", 9, 0, 0, 0, 5, False, 0, 0)
    refusing = dataclasses.replace(
        quiet, refused_count=3, refused_reason="motor_speeds takes 4 numbers, got 3"
    )
    ended = status_of("ended", "drone collided at 2.748 s", refusing)
    with rig_of({"namespace": "/sim"}) as rig:
        sent = rig.simulator.publisher("/status", msg.SimulatorStatus)
        rig.update_until(lambda: sent.subscriber_count == 1)
        for count, statuses_of_run in enumerate(([ended, ended], [ended]), 1):
            for status in (status_of("running", "", quiet), *statuses_of_run):
                sent.publish(status)
            wait_for(lambda count=count: caplog.text.count("refused") >= count)
            rig.clock.put_forward(1.0)
    assert (caplog.text.count("the run has ended"), caplog.text.count("refused")) == (2, 2)
    assert (
        "the run has ended: drone collided at 2.748 s; the service /sim/reset begins another" in caplog.text
    )
    assert "drone: the simulator: refused 3: motor_speeds takes 4 numbers, got 3" in caplog.text


def test_another_bridge_is_said_and_named(caplog):
    """At once if Cortex shows it, else after a while: DDS remembers a bridge that was killed for 10 s."""
    with rig_of() as rig:
        for topic in ("/drone/imu", "/drone/gyro"):
            rig.simulator.publisher(topic, msg.Imu)
        rig.opens("/drone/imu", "/drone/gyro")
        rig.backend.others = [
            TopicInfo("/clock", "rosgraph_msgs/msg/Clock", (Qos(),), ()),
            TopicInfo("/drone/imu", "sensor_msgs/msg/Imu", (Qos(),), ()),
            TopicInfo("/drone/gyro", "sensor_msgs/msg/Imu", (Qos(),), ()),
        ]
        rig.updates_during(every_s=0.3)
        assert "ROS gets all of it twice" not in caplog.text
        with Node("bridge"):
            rig.update_until(lambda: "ROS gets all of it twice" in caplog.text, every_s=0.01)
        assert f"another bridge (bridge, process {os.getpid()} on" in caplog.text
        assert "publishes /drone/gyro and 1 more of our topics too" in caplog.text
        rig.update_until(lambda: "another node publishes /drone/gyro" in caplog.text, every_s=1.0)


def test_settings_that_fit_nothing_are_said_after_a_while(caplog):
    with rig_of({"routes": [{"cortex": "/dron/imu", "qos": "sensor_data"}]}) as rig:
        rig.simulator.publisher("/drone/imu", msg.Imu)
        said = "no Cortex topic fits /dron/imu, did you mean /drone/imu?"
        rig.update_until(lambda: said in caplog.text, every_s=1.0)


def test_events_that_a_sensor_dropped_are_shown():
    none = np.zeros(0, np.uint16)
    with rig_of() as rig:
        sent = rig.simulator.publisher("/drone/events", msg.Events)
        (ros,) = rig.opens("/drone/events")
        with rig.listening(sent, "/drone/events"), rig.backend.listening("/diagnostics") as (told,):
            sent.publish(
                msg.Events(10_000_000, none, none, np.zeros(0, np.int64), none.astype(np.uint8), 4, 3, 0, 17)
            )
            wait_for(lambda: ros.sent)
            name = "/drone/events -> /drone/events"
            rig.update_until(lambda: statuses(told).get(name, {}).get("dropped") == "17", every_s=1.0)
            texts = [s.message for m in told.messages() for s in m.status if s.name.endswith(name)]
            assert any("17 events dropped by the sensor" in text for text in texts)


def test_a_picture_of_events_and_its_calibration_have_one_stamp():
    none = np.zeros(0, np.uint16)
    with rig_of() as rig:
        info = rig.simulator.publisher("/drone/events/info", msg.CameraInfo, latch=True)
        info.publish(camera_info("events"))
        sent = rig.simulator.publisher("/drone/events", msg.Events)
        names = "/drone/events/image", "/drone/events/camera_info"
        pictures, infos = rig.opens(*names)
        rig.update_until(lambda: rig.has_calibration(names[1]))
        with rig.listening(sent, *names):
            for end_ms in range(100, 300, 5):
                begin_ns, end_ns = (end_ms - 5) * 1_000_000, end_ms * 1_000_000
                empty = none, none, np.zeros(0, np.int64), none.astype(np.uint8)
                sent.publish(msg.Events(end_ns, *empty, 4, 3, begin_ns))
            wait_for(lambda: len(pictures.sent) == len(infos.sent) == 6)
        stamps = [stamp_ns(message.header) for message in infos.messages()]
        assert stamps == [stamp_ns(message.header) for message in pictures.messages()]
        assert stamps == [n * 1_000_000 for n in (100, 135, 170, 200, 235, 270)]


def test_the_simulator_says_what_full_thrust_is():
    """Thrust 1 of the vehicle that is commanded, not of the one that is flown by default."""
    with rig_of() as rig:
        craft = Craft(rig, rates=msg.RateThrustCommand)
        about = rig.simulator.publisher("/simulation", msg.Simulation, latch=True)
        ranges = [msg.CommandRanges(False, 900.0, n, 10.0, 4.0, 50.0) for n in (40.0, 8.0)]
        about.publish(msg.Simulation("", "1", ["other", "drone"], "streaming", 100.0, [40.0, 8.0], ranges))
        (target,) = rig.subscribes("/drone/attitude_target")
        rig.update_until(lambda: about.subscriber_count == 1)
        rig.update_until(lambda: rig.has_seen("drone", max_thrust_n=8.0))
        rig.update_until(craft.connected)
        target.put(message_class("mavros_msgs/msg/AttitudeTarget")(type_mask=128, thrust=0.5))
        assert craft.recv("rates").thrust_n == 4.0
        fast = message_class("mavros_msgs/msg/AttitudeTarget")(type_mask=128, thrust=0.5)
        fast.body_rate.x = 1e308
        target.put(fast)
        clamped = craft.recv("rates").body_rate.tolist()
        assert clamped == pytest.approx([4.0, 0.0, 0.0], rel=1e-13)
        assert clamped[0] <= 4.0
        (counts,) = [each for route, each in rig.bridge.totals().items() if "rates <-" in route]
        assert (counts.sent, counts.clamped, counts.refused) == (2, 1, 0)


def test_diagnostics_say_how_each_route_is_doing():
    with rig_of() as rig:
        Craft(rig, motor_speeds=msg.MotorCommand)
        sent = rig.simulator.publisher("/drone/imu", msg.Imu)
        (rotors,) = rig.subscribes("/drone/actuators")
        (ros,) = rig.opens("/drone/imu")
        diagnostics = rig.backend.publishers["/diagnostics"]
        rig.updates_during(every_s=0.5)
        assert diagnostics.sent == []
        with rig.listening(sent, "/drone/imu"), rig.backend.listening("/diagnostics"):
            sent.publish(imu(1))
            wait_for(lambda: ros.sent)
            rotors.put(actuators(float("inf")))
            rig.update_until(lambda: statuses(diagnostics).get(ROTORS, {}).get("refused") == "1", every_s=1.0)
            found = statuses(diagnostics)
            level = {s.name: s.level for s in diagnostics.messages()[-1].status}
            rig.update_until(lambda: statuses(diagnostics)[ROTORS]["message"] == "idle", every_s=1.0)
    assert found[IMU] | {"rate_hz": "", "message": ""} == {
        "message": "",
        "received": "1",
        "sent": "1",
        "lost": "0",
        "refused": "0",
        "clamped": "0",
        "dropped": "0",
        "rate_hz": "",
        "listeners": "1",
        "types": "cortex/Imu and sensor_msgs/msg/Imu",
    }
    assert found["bridge"]["backend"] == "recording"
    assert level[f"cortex_bridge: {ROTORS}"] == 1
    assert "1 refused" in found[ROTORS]["message"]
    assert "finite" in found[ROTORS]["message"]


def test_a_simulator_that_vanishes_is_an_error_in_diagnostics():
    with rig_of() as rig, rig.backend.listening("/diagnostics") as (diagnostics,):

        def told(name):
            found = statuses(diagnostics).get(name)
            level = {
                s.name.partition(": ")[2]: s.level for s in diagnostics.messages()[-1:] for s in s.status
            }
            return found and (level[name], found["message"])

        rig.update_until(lambda: told("bridge") == (1, "no Cortex topics: no simulator runs"), every_s=1.0)
        with Node("short-lived") as simulator:
            simulator.publisher("/drone/imu", msg.Imu)
            rig.update_until(lambda: told("bridge") == (0, "1 routes"), every_s=1.0)
            assert told(IMU) == (0, "idle")
        rig.update_until(lambda: told("bridge") == (2, "the Cortex side has gone"), every_s=0.1)
        assert told(IMU) == (3, "its Cortex topic has gone")


def test_a_backend_that_fails_ends_the_bridge_and_is_told():
    with rig_of() as rig, rig.backend.listening("/diagnostics") as (diagnostics,):
        rig.backend.failure = "it is dead"
        with pytest.raises(BackendError, match="it is dead"):
            rig.bridge.run(threading.Event())
        last = diagnostics.messages()[-1].status[0]
        assert last.level == 2
        assert "it is dead" in last.message


def statuses(publisher):
    """Values of the newest diagnostics, by the name of what they are about."""
    if not publisher.sent:
        return {}
    return {
        status.name.partition(": ")[2]: {"message": status.message} | {v.key: v.value for v in status.values}
        for status in publisher.messages()[-1].status
    }


def test_closing_leaves_nothing_open():
    with rig_of() as rig:
        Craft(rig, motor_speeds=msg.MotorCommand, rates=msg.RateThrustCommand, attitude=msg.AttitudeCommand)
        for name, kind in (("imu", msg.Imu), ("odometry", msg.Odometry), ("rgb", msg.Image)):
            rig.simulator.publisher(f"/drone/{name}", kind)
        rig.opens("/drone/imu", "/tf_static", "/drone/rgb/image_raw")
        rig.subscribes("/drone/actuators", "/drone/attitude_target")
        rig.bridge.close()
        assert rig.backend.publishers == {}
        assert rig.backend.subscriptions == {}
        assert rig.bridge.routes() == []
        assert rig.node.topics() == [] or all("bridge" not in t.publishers for t in rig.node.topics())
        rig.bridge.update()
        rig.bridge.close()
