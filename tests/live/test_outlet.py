"""What a vehicle publishes, and what links and clocks do to it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live_rig import count_free, make_config, models_of
from processes import SOON_S, wait_for

from cortex import Node, Subscriber, reliable
from cortex.messages import CameraInfo, Collision, Events, Image, Imu, Odometry, RotorSpeeds, Transform
from cortex.messages import Delivery as DeliveryMessage
from cortex.messages import Path as PathMessage
from neurosim_core.live import outlet as outlet_module
from neurosim_core.live.outlet import Outlet
from neurosim_core.live.translate import expected_bytes
from neurosim_core.packets import Collision as CollisionPacket
from neurosim_core.packets import Delivery, ImuSample, Packet
from neurosim_core.packets import Image as ImagePacket
from neurosim_core.packets import Odometry as OdometryPacket
from neurosim_core.sensors.rig import EventSensorConfig, RgbSensorConfig

MS = 1_000_000


class Stand:
    """An outlet, and subscribers to it."""

    def __init__(self, node: Node, **settings: Any) -> None:
        self.node = node
        self.model = models_of(make_config(**settings))["drone"]
        self.recorded: list[Packet] = []
        self.outlet = Outlet(node, "drone", self.model)

    def record(self) -> None:
        self.outlet.record = self.recorded.append

    def listen(self, topic: str, message: type[Any]) -> Subscriber[Any]:
        subscriber = self.node.subscriber(topic, message, policy=reliable(4096))
        assert subscriber.wait_for_publisher(SOON_S)
        publishers = {stream.publisher.topic: stream.publisher for stream in self.outlet.streams.values()}
        if topic in publishers:
            assert publishers[topic].wait_for_subscribers(1, SOON_S)
        self.outlet.look()
        return subscriber


@pytest.fixture
def make_stand(shared_runtime: Path) -> Iterator[Callable[..., Stand]]:
    with Node("outlet") as node:
        yield lambda **settings: Stand(node, **settings)


def imu(tick: int, sequence: int | None = None) -> ImuSample:
    return ImuSample(
        sensor="imu",
        stamp_ns=5 * MS * tick,
        sequence=tick if sequence is None else sequence,
        specific_force=np.array([0.0, 0.0, 9.81]),
        angular_rate=np.array([float(tick), 0.0, 0.0]),
    )


def odometry(stamp_ns: int) -> OdometryPacket:
    return OdometryPacket(
        sensor="odometry",
        stamp_ns=stamp_ns,
        sequence=77,
        position=np.array([1.0, 2.0, 3.0]),
        orientation=np.array([0.0, 0.0, 0.0, 1.0]),
        velocity=np.zeros(3),
        body_rate=np.zeros(3),
        rotor_speed=np.array([1.0, 2.0, 3.0, 4.0]) * (1 + stamp_ns),
    )


def take(subscriber: Subscriber[Any], count: int) -> list[Any]:
    messages = [subscriber.recv(SOON_S) for _ in range(count)]
    with pytest.raises(TimeoutError):
        subscriber.recv(0.0)
    return messages


def test_what_does_not_change_is_there_for_who_comes_later(make_stand: Callable[..., Stand]):
    stand = make_stand()
    info = stand.listen("/drone/rgb/info", CameraInfo).recv(SOON_S)
    assert (info.width, info.height, info.frame_id) == (64, 48, "drone/rgb_optical_frame")
    fx = 32.0 / np.tan(0.75)
    assert info.matrix == pytest.approx(np.array([[fx, 0.0, 32.0], [0.0, fx, 24.0], [0.0, 0.0, 1.0]]))
    mount = stand.listen("/drone/rgb/transform", Transform).recv(SOON_S)
    assert (mount.parent, mount.child) == ("drone/base_link", "drone/rgb_optical_frame")
    assert mount.translation == pytest.approx([0.1, 0.0, 0.03])
    path = stand.listen("/drone/path", PathMessage).recv(SOON_S)
    assert path.time_ns[-1] == stand.model.duration_ns
    assert path.position == pytest.approx(stand.model.path.evaluate(path.time_ns).position)
    topics = {info.topic for info in stand.node.topics()}
    assert "/drone/imu/info" not in topics  # it has no lens


def test_packets_come_out_when_they_are_due(make_stand: Callable[..., Stand]):
    stand = make_stand()
    samples = stand.listen("/drone/imu", Imu)
    stand.outlet.offer([imu(1), imu(2)])
    assert stand.outlet.next_due_ns == 5 * MS
    stand.outlet.publish_due(9 * MS)
    (first,) = take(samples, 1)
    assert (first.stamp_ns, first.sequence) == (5 * MS, 1)
    assert first.angular_rate.tolist() == [1.0, 0.0, 0.0]
    stand.outlet.publish_due(10 * MS)
    assert take(samples, 1)[0].stamp_ns == 10 * MS
    assert stand.outlet.next_due_ns is None


def test_what_a_reader_that_is_too_slow_loses_is_counted(make_stand: Callable[..., Stand]):
    """A reliable reader that never reads: what it loses is counted for its topic, which is named once."""
    stand = make_stand()
    policy = reliable(1, timeout_s=0.001)
    stream = stand.outlet.streams["imu"]
    with stand.node.subscriber("/drone/imu", Imu, policy=policy):
        assert stream.publisher.wait_for_subscribers(1, SOON_S)
        stand.outlet.look()
        stand.outlet.take_held_up()
        for tick in range(100_000):
            stand.outlet.offer([imu(tick)])
            stand.outlet.publish_due(5 * MS * tick)
            if stream.undelivered_count == 3:
                break
    assert stream.undelivered_count == 3
    assert stand.outlet.take_held_up() == ["/drone/imu"]
    assert stand.outlet.take_held_up() == []
    assert stand.outlet.other_undelivered_count == 0
    stand.outlet.reset(seed=1)
    assert stream.undelivered_count == 0


class Sluggish:
    """A publisher whose reader loses every message, or none."""

    def __init__(self, topic: str, *, loses: bool) -> None:
        self.topic = topic
        self.loses = loses

    def publish(self, message: Any) -> bool:
        return not self.loses


def test_losses_on_topics_that_are_no_sensors_are_counted_too(make_stand: Callable[..., Stand]):
    stand = make_stand(links={"rgb": {"latency_s": 0.001}})
    posts = {post.publisher.topic: post for post in stand.outlet._posts()}
    for topic in ("/drone/rgb/delivery", "/drone/collision"):
        posts[topic].publisher = Sluggish(topic, loses=True)  # type: ignore[assignment]
        posts[topic].publish(None)
    assert stand.outlet.other_undelivered_count == 2
    assert sorted(stand.outlet.take_held_up()) == ["/drone/collision", "/drone/rgb/delivery"]


def test_readers_that_take_time_are_named_even_if_they_lose_nothing(
    make_stand: Callable[..., Stand], monkeypatch: pytest.MonkeyPatch
):
    now = itertools.count(0, outlet_module.HELD_UP_NS // 2 + 1)
    stand = make_stand()
    stream = stand.outlet.streams["imu"]
    stream.publisher = Sluggish("/drone/imu", loses=False)  # type: ignore[assignment]
    monkeypatch.setattr(outlet_module.time, "monotonic_ns", lambda: next(now))
    stream.publish(None)
    assert stand.outlet.take_held_up() == []  # half of what is allowed
    stream.publish(None)
    stream.publish(None)
    monkeypatch.undo()
    assert stand.outlet.take_held_up() == ["/drone/imu"]


def test_how_late_messages_are_published(make_stand: Callable[..., Stand]):
    """After the time at which they were to arrive, behind the link; what nobody hears is not counted."""
    stand = make_stand(links={"imu": {"latency_s": 0.002}})
    stand.listen("/drone/imu", Imu)
    stand.outlet.lateness_ns = lambda stamp_ns: 20 * MS - stamp_ns  # the wall clock is at 20 ms
    stand.outlet.offer([imu(1), odometry(5 * MS)])
    stand.outlet.publish_due(20 * MS)
    late = stand.outlet.streams["imu"].late_times.take()
    assert (late.count, late.max_ns) == (1, 13 * MS)
    assert stand.outlet.streams["odometry"].late_times.take().count == 0
    stand.outlet.offer([imu(5)])
    stand.outlet.publish_due(30 * MS)
    assert stand.outlet.streams["imu"].late_times.take().max_ns == 0  # not early


def test_nobody_listens_nothing_is_built(make_stand: Callable[..., Stand]):
    stand = make_stand()
    stand.outlet.look()
    assert stand.outlet.active() == frozenset()
    stand.outlet.offer([imu(1)])
    stand.outlet.publish_due(5 * MS)
    assert stand.outlet.streams["imu"].published_count == 0
    samples = stand.listen("/drone/imu", Imu)
    assert stand.outlet.active() == {"imu"}
    stand.outlet.offer([imu(2)])
    stand.outlet.publish_due(10 * MS)
    assert take(samples, 1)[0].sequence == 2
    assert stand.outlet.streams["imu"].published_count == 1
    samples.close()
    wait_for(lambda: stand.outlet.look() and not stand.outlet.active())
    stand.record()
    assert stand.outlet.active() == {"imu", "odometry", "rgb", "events"}


def test_odometry_is_that_of_ticks_and_of_the_sensor(make_stand: Callable[..., Stand]):
    """No stamp twice, numbers without a gap, rotor speeds with the same number."""
    stand = make_stand()
    states = stand.listen("/drone/odometry", Odometry)
    speeds = stand.listen("/drone/rotor_speeds", RotorSpeeds)
    stand.record()
    stand.outlet.offer_state(odometry(0))
    stand.outlet.offer([odometry(0), odometry(3 * MS), odometry(5 * MS)])
    stand.outlet.offer_state(odometry(5 * MS))
    assert stand.outlet.publish_due(4 * MS) == 3 * MS
    assert stand.outlet.publish_due(5 * MS) == 5 * MS
    assert stand.outlet.publish_due(5 * MS) is None
    found = take(states, 3)
    assert [(m.stamp_ns, m.sequence) for m in found] == [(0, 0), (3 * MS, 1), (5 * MS, 2)]
    found = take(speeds, 3)
    assert [(m.stamp_ns, m.sequence) for m in found] == [(0, 0), (3 * MS, 1), (5 * MS, 2)]
    assert found[1].speed[0] == 1.0 + 3 * MS
    assert [(p.stamp_ns, p.sequence, p.sensor) for p in stand.recorded] == [
        (0, 0, "odometry"),
        (3 * MS, 1, "odometry"),
        (5 * MS, 2, "odometry"),
    ]


def test_the_last_state_is_there_for_who_comes_later(make_stand: Callable[..., Stand]):
    stand = make_stand()
    stand.outlet.offer_state(odometry(0))
    assert stand.listen("/drone/odometry", Odometry).recv(SOON_S).stamp_ns == 0
    assert stand.listen("/drone/rotor_speeds", RotorSpeeds).recv(SOON_S).speed.tolist() == [1, 2, 3, 4]


def test_a_state_that_nobody_hears_is_built_when_somebody_may_come(make_stand: Callable[..., Stand]):
    """Once a look, not once a control period; and its stamp is known all the same."""
    stand = make_stand()
    stand.outlet.look()
    stand.outlet.offer_state(odometry(0))
    for tick in range(1, 11):
        stand.outlet.offer_state(odometry(5 * MS * tick))
        assert stand.outlet.publish_due(5 * MS * tick) == 5 * MS * tick
    stream = stand.outlet.streams["odometry"]
    assert stream.published_count == 1
    stand.outlet.look()
    assert stream.published_count == 2
    assert stand.listen("/drone/odometry", Odometry).recv(SOON_S).stamp_ns == 50 * MS
    stand.outlet.look()
    assert stream.published_count == 2


def test_a_link_delays_and_says_so(make_stand: Callable[..., Stand]):
    link = {"latency_s": 0.008}
    stand = make_stand(links={"imu": link, "odometry": link})
    samples = stand.listen("/drone/imu", Imu)
    states = stand.listen("/drone/odometry", Odometry)
    told = stand.listen("/drone/imu/delivery", DeliveryMessage)
    stand.record()
    stand.outlet.offer_state(odometry(0))
    assert take(states, 1)[0].stamp_ns == 0  # known before time begins
    stand.outlet.offer([imu(1)])
    stand.outlet.offer_state(odometry(5 * MS))
    (delivery,) = take(told, 1)
    assert (delivery.stamp_ns, delivery.delivered_ns, delivery.sequence) == (5 * MS, 13 * MS, 0)
    assert delivery.size_bytes == 8 + 6 * 8
    assert stand.outlet.publish_due(10 * MS) is None
    assert stand.outlet.next_due_ns == 13 * MS
    take(samples, 0)
    assert stand.outlet.publish_due(13 * MS) == 5 * MS
    assert take(samples, 1)[0].stamp_ns == 5 * MS
    deliveries = [packet for packet in stand.recorded if isinstance(packet, Delivery)]
    assert [(d.sensor, d.delivered_ns) for d in deliveries] == [
        ("imu_link", 13 * MS),
        ("odometry_link", 13 * MS),
    ]


def _survivors(make_stand: Callable[..., Stand], seed: int) -> list[int]:
    stand = make_stand(links={"imu": {"loss": 0.3}})
    stand.outlet.reset(seed=seed)
    samples = stand.listen("/drone/imu", Imu)
    stand.outlet.offer([imu(tick) for tick in range(1, 201)])
    stand.outlet.publish_due(1000 * MS)
    arrived = [
        samples.recv(SOON_S).sequence for _ in range(200 - stand.outlet.streams["imu"].channel.lost_count)
    ]
    for stream in stand.outlet.streams.values():
        stream.publisher.close()
    return arrived


def test_loss_is_that_of_the_seed(make_stand: Callable[..., Stand]):
    first = _survivors(make_stand, seed=1)
    assert 100 <= len(first) <= 180  # 140 expected, 6 deviations are 39
    assert first == _survivors(make_stand, seed=1)
    assert first != _survivors(make_stand, seed=2)


def test_a_sensor_has_a_clock(make_stand: Callable[..., Stand]):
    """1 ms ahead and 100 ppm too fast; the recording is in simulated time."""
    stand = make_stand(links={"imu": {"clock_offset_s": 0.001, "clock_drift_ppm": 100.0}})
    samples = stand.listen("/drone/imu", Imu)
    stand.record()
    stand.outlet.offer([imu(200)])
    stand.outlet.publish_due(1000 * MS)
    assert take(samples, 1)[0].stamp_ns == 1000 * MS + 1 * MS + 100_000
    assert stand.recorded[0].stamp_ns == 1000 * MS


def test_pictures_that_are_kept_are_copied(make_stand: Callable[..., Stand]):
    """A picture is a view that the next period overwrites."""
    stand = make_stand(links={"rgb": {"latency_s": 0.01}})
    pictures = stand.listen("/drone/rgb", Image)
    data = np.full((48, 64, 3), 5, np.uint8)
    stand.outlet.offer([ImagePacket(sensor="rgb", stamp_ns=MS, data=data, encoding="rgb8")])
    data[:] = 9
    stand.outlet.publish_due(11 * MS)
    (picture,) = take(pictures, 1)
    assert (picture.data == 5).all()
    assert (picture.encoding, picture.frame_id) == ("rgb8", "drone/rgb_optical_frame")


def test_a_picture_has_room_where_its_reader_finds_it(make_stand: Callable[..., Stand]):
    """What is written there is published without a copy, the same as any other picture."""
    stand = make_stand()
    pictures = stand.listen("/drone/rgb", Image)
    like = np.arange(160 * 150 * 3, dtype=np.uint64).astype(np.uint8).reshape(160, 150, 3)
    room = stand.outlet.make_room("rgb", 0, like)
    assert room is not None
    room[:] = like
    for sequence, data in enumerate((room, like)):
        stamp_ns = sequence * MS
        packet = ImagePacket(sensor="rgb", stamp_ns=stamp_ns, sequence=sequence, data=data, encoding="rgb8")
        stand.outlet.offer([packet])
    stand.outlet.publish_due(MS)
    found = take(pictures, 2)
    assert [(p.stamp_ns, p.sequence) for p in found] == [(0, 0), (MS, 1)]
    for picture in found:
        assert picture.data.tobytes() == like.tobytes()
        assert (picture.encoding, picture.frame_id) == ("rgb8", "drone/rgb_optical_frame")
    room[5, 6, 1] += 1
    assert found[0].data[5, 6, 1] == room[5, 6, 1]  # the same memory
    assert stand.outlet.streams["rgb"].published_count == 2


def test_no_room_for_a_picture_that_is_kept_or_that_nobody_sees(make_stand: Callable[..., Stand]):
    like = np.zeros((160, 150, 3), np.uint8)
    stand = make_stand()
    assert stand.outlet.make_room("rgb", 0, like) is None
    stand.listen("/drone/rgb", Image)
    stand.record()
    assert stand.outlet.make_room("rgb", 0, like) is None
    linked = make_stand(links={"rgb": {"latency_s": 0.01}})
    linked.listen("/drone/rgb", Image)
    assert linked.outlet.make_room("rgb", 0, like) is None


def test_no_room_for_a_picture_that_is_due(make_stand: Callable[..., Stand]):
    """It is published at once: there is no time left in which it could be copied."""
    like = np.zeros((160, 150, 3), np.uint8)
    stand = make_stand()
    stand.listen("/drone/rgb", Image)
    stand.outlet.lateness_ns = lambda stamp_ns: 5 * MS - stamp_ns
    assert stand.outlet.make_room("rgb", 5 * MS, like) is None
    assert stand.outlet.make_room("rgb", 6 * MS, like) is not None
    stand.outlet.drop_loans()


def test_room_is_given_back_at_a_reset_and_before_topics_close(make_stand: Callable[..., Stand]):
    """A flight may end between a picture and its stamp: nobody publishes it any more."""
    stand = make_stand()
    stand.listen("/drone/rgb", Image)
    like = np.zeros((160, 150, 3), np.uint8)
    publisher = stand.outlet.streams["rgb"].publisher
    assert stand.outlet.make_room("rgb", MS, like) is not None
    free = count_free(publisher, like.shape)
    stand.outlet.reset(seed=0)
    assert count_free(publisher, like.shape) == free + 1
    assert stand.outlet.make_room("rgb", MS, like) is not None
    assert count_free(publisher, like.shape) == free
    stand.outlet.drop_loans()
    assert count_free(publisher, like.shape) == free + 1


def test_collisions_are_published(make_stand: Callable[..., Stand]):
    stand = make_stand()
    collisions = stand.listen("/drone/collision", Collision)
    position = np.array([1.0, 2.0, 3.0])
    stand.outlet.offer(
        [CollisionPacket(sensor="collision", stamp_ns=MS, position=position, clearance_m=-0.01)]
    )
    stand.outlet.publish_due(MS)
    assert take(collisions, 1)[0].clearance_m == -0.01


def test_reset_begins_again(make_stand: Callable[..., Stand]):
    stand = make_stand(links={"imu": {"latency_s": 0.1}})
    states = stand.listen("/drone/odometry", Odometry)
    stand.outlet.offer_state(odometry(0))
    stand.outlet.offer([imu(1), odometry(5 * MS)])
    stand.outlet.publish_due(5 * MS)
    stand.outlet.reset(seed=0)
    assert stand.outlet.next_due_ns is None
    stand.outlet.offer_state(odometry(0))
    assert [(m.stamp_ns, m.sequence) for m in take(states, 3)] == [(0, 0), (5 * MS, 1), (0, 0)]


def test_memory_for_events_is_there_before_they_come(make_stand: Callable[..., Stand]):
    """To make it takes milliseconds, and in the flight messages would be late meanwhile."""
    stand = make_stand(**{"sensors.events.lens": {"width": 128, "height": 96, "horizontal_fov_rad": 1.5}})
    events = stand.model.config.sensors["events"]
    sent = stand.outlet.streams["events"].publisher
    stand.listen("/drone/events", Events)
    with sent._outlets.lock:
        (ring,) = sent._large._rings
    assert ring.slot_bytes >= expected_bytes(events) > 128 * 96 * 100 * 13 / events.packets.rate_hz


def test_what_is_expected_of_an_event_camera():
    """A hundred events of 13 bytes per pixel and second, and a little more, up to a limit."""

    def camera(width: int, height: int, packet_rate_hz: float) -> EventSensorConfig:
        lens = {"width": width, "height": height, "horizontal_fov_rad": 1.5}
        return EventSensorConfig.model_validate(
            {"lens": lens, "sampling_rate_hz": 1000.0, "packet_rate_hz": packet_rate_hz}
        )

    assert expected_bytes(camera(346, 260, 25.0)) == 346 * 260 * 4 * 13 + 4096
    assert expected_bytes(camera(346, 260, 1000.0)) == 346 * 26 * 13 + 4096
    assert expected_bytes(camera(1280, 720, 25.0)) == 8 << 20
    assert expected_bytes(RgbSensorConfig()) == expected_bytes(None) == 0
