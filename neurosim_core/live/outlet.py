"""What a vehicle publishes: its sensors, its state, where they sit, and what links did to all that."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex import Node, Publisher
from cortex import messages as msg
from neurosim_core.live import topics, translate
from neurosim_core.live.channel import Channel, payload_bytes
from neurosim_core.live.config import LinkConfig
from neurosim_core.live.loans import PictureLoan
from neurosim_core.live.pacing import Timings
from neurosim_core.packets import Delivery, Image, Odometry, Packet
from neurosim_core.record import describe_sensors
from neurosim_core.simulation import COLLISION, Model

NO_LINK = LinkConfig()
HELD_UP_NS = 50_000_000
"""Time that readers may take of the simulator between two statuses without being named [ns]."""


class Post:
    """A publisher, and what its reliable readers cost.

    Attributes:
        publisher: Where messages go.
        undelivered_count: Messages that a reliable reader lost since the last reset.
    """

    def __init__(self, publisher: Publisher[Any]) -> None:
        """Wrap a publisher."""
        self.publisher = publisher
        self.undelivered_count = 0
        self._told_count = 0
        self._held_ns = 0

    def publish(self, message: Any, send: Callable[[Any], bool] | None = None) -> None:
        """Publish a message, and count it if a reader that holds us up loses it.

        Args:
            message: What to publish.
            send: How; None: as usual.
        """
        begin_ns = time.monotonic_ns()
        if not (send or self.publisher.publish)(message):
            self.undelivered_count += 1
        self._held_ns += time.monotonic_ns() - begin_ns

    def take_held_up(self) -> bool:
        """Return whether, since the last time, readers lost messages or took much of our time."""
        held = self._held_ns > HELD_UP_NS or self.undelivered_count > self._told_count
        self._held_ns, self._told_count = 0, self.undelivered_count
        return held

    def reset(self) -> None:
        """Count from 0."""
        self.undelivered_count = self._told_count = self._held_ns = 0


class Stream(Post):
    """One topic of packets, with the link in front of it.

    Attributes:
        name: Of the sensor, or odometry, rotor_speeds, collision.
        channel: What is under way.
        loan: Room for the next picture, where these are pictures.
        late_times: How late by the wall clock messages were published, since somebody last looked [ns].
        subscriber_count: As of the last look.
        published_count: Messages since the last reset.
        delivered_ns: Stamp, as in the message, of what arrived last [ns]; None if there was nothing.
    """

    def __init__(
        self,
        publisher: Publisher[Any],
        channel: Channel,
        *,
        name: str,
        translate: Callable[[Any, Callable[[int], int] | None], Any],
        device: str = "cpu",
    ) -> None:
        """Wrap a publisher.

        Args:
            publisher: Where messages go.
            channel: What is in their way.
            name: Of the sensor.
            translate: Makes the message of a packet, with the sensor's clock if that is not simulated time.
            device: Where pictures are rendered.
        """
        super().__init__(publisher)
        self.name = name
        self.channel = channel
        self.late_times = Timings()
        self.loan = PictureLoan(publisher, device=device)
        self.subscriber_count = 0
        self.published_count = 0
        self.delivered_ns: int | None = None
        self._translate = translate
        self._last: Any = None
        self._kept: Packet | None = None

    def send(self, packet: Packet, *, at_once: bool = False) -> bool:
        """Publish a packet, if anybody listens; return whether it was published.

        Where the topic is latched, the newest packet is kept, and published with the next look: whoever comes
        gets a state that is not older than that, and it costs nothing in between.

        Args:
            packet: What to publish.
            at_once: Even if nobody listens.
        """
        config = self.channel.config
        clocked = config.clock_offset_s or config.clock_drift_ppm
        self.delivered_ns = config.clock_ns(packet.stamp_ns)
        if not (self.subscriber_count or at_once):
            self._kept = packet if self.publisher.latch else None
            return False
        message = self._translate(packet, config.clock_ns if clocked else None)
        self._kept = None
        lent = isinstance(packet, Image) and self.loan.holds(packet.data)
        self.publish(message, self.loan.publish if lent else None)
        self.published_count += 1
        if self.publisher.latch:
            self._last = message
        return True

    def look(self) -> int:
        """See who listens; return how many."""
        self.subscriber_count = self.publisher.subscriber_count
        if self._kept is not None:
            self.send(self._kept, at_once=True)
        return self.subscriber_count

    def repeat(self) -> None:
        """Publish the last message again, the same in every bit, where the topic is latched."""
        if self._last is not None:
            self.publish(self._last)

    def begin(self, *, seed: int) -> None:
        """Forget what is under way and begin again."""
        self.reset()
        self.late_times.take()
        self.channel.reset(seed=seed)
        self.published_count = 0
        self.delivered_ns = None
        self._last = self._kept = None
        self.loan.drop()  # after the packet that holds it


class Outlet:
    """Publishes what one vehicle measures, when simulated time says that it arrives.

    Packets go in with `offer` as they are computed, and out with `publish_due`. To be used by one thread.

    Attributes:
        streams: The topics by name: sensors in the order of the rig, collision, rotor_speeds, odometry.
        lateness_ns: Says for how long a simulated time [ns] has been due by the wall clock [ns]; None: time
            is not paced.
    """

    def __init__(
        self, node: Node, vehicle: str, model: Model, *, record: Callable[[Packet], None] | None = None
    ) -> None:
        """Announce the topics of a vehicle, and publish what does not change.

        Args:
            node: Whose they are.
            vehicle: Its name.
            model: What is flown.
            record: Takes every packet, and every delivery, too.
        """
        self.vehicle = vehicle
        self.record = record
        self.lateness_ns: Callable[[int], int] | None = None
        self._node = node
        self._seed = model.config.seed
        self._device = model.device
        self._delivery_posts: dict[str, Post] = {}
        self._odometry_count = 0
        self._odometry_ns = -1
        config = model.config
        sensors = describe_sensors(config.sensors)
        self.streams: dict[str, Stream] = {}
        for sensor in sensors:
            if sensor.name != "odometry":
                frame = topics.sensor_frame(vehicle, sensor.name, sensor.kind)
                self._add(
                    sensor.name,
                    translate.message_type(sensor.kind),
                    config.links,
                    frame_id=frame,
                    expected_bytes=translate.expected_bytes(config.sensors[sensor.name]),
                )
        self._add(COLLISION, msg.Collision, {})
        self._add(
            "rotor_speeds",
            msg.RotorSpeeds,
            config.links,
            latch=True,
            convert=lambda packet, clock_ns: translate.rotor_speeds(packet, clock_ns=clock_ns),
        )
        self._add("odometry", msg.Odometry, config.links, latch=True)
        self._stations = [self._describe(sensor, node) for sensor in sensors]
        self._path = node.publisher(topics.stream_topic(vehicle, "path"), msg.Path, latch=True)
        self._path.publish(translate.path_message(model.path, end_ns=model.duration_ns))
        self._sensor_names = tuple(config.sensors)

    def reset(self, *, seed: int) -> None:
        """Begin a new run at stamp 0."""
        self._seed = seed
        self._odometry_count = 0
        self._odometry_ns = -1
        for stream in self.streams.values():
            stream.begin(seed=seed)
        for post in self._delivery_posts.values():
            post.reset()

    def drop_loans(self) -> None:
        """Give back the room of pictures, on which closing topics would wait, for good."""
        with contextlib.ExitStack() as stack:  # each of them, whatever the device says to another
            for stream in self.streams.values():
                stack.callback(stream.loan.close)

    def settle_with(self, settle: Callable[[], object]) -> None:
        """Have something called before a picture is published that was lent room: it waits for the device."""
        for stream in self.streams.values():
            stream.loan.settle = settle

    def look(self) -> tuple[int, ...]:
        """See who listens, and return how many subscribers each topic has."""
        return tuple(stream.look() for stream in self.streams.values())

    def make_room(self, name: str, stamp_ns: int, picture: NDArray[Any]) -> NDArray[Any] | None:
        """Return where a picture can be written so that it is not copied again; None if that makes no sense.

        A CUDA device can write there by itself.

        That is so where it is recorded or passes a link, where nobody listens, and where it is due already:
        then it is published at once, and to copy it takes less time than to prepare that it is not. May be
        called from another thread than all else.

        Args:
            name: Of the camera.
            stamp_ns: Of the picture [ns].
            picture: Of the shape and dtype that is needed.
        """
        stream = self.streams[name]
        if self.record is not None or not stream.subscriber_count or not stream.channel.delivers_at_once:
            return None
        if self.lateness_ns is not None and self.lateness_ns(stamp_ns) >= 0:
            return None
        return stream.loan.lend(picture)

    def active(self) -> frozenset[str]:
        """Return the sensors that are listened to or recorded, as of the last look."""
        if self.record is not None:
            return frozenset(self._sensor_names)
        return frozenset(name for name in self._sensor_names if self.streams[name].subscriber_count)

    def offer(self, packets: Iterable[Packet]) -> None:
        """Send packets of one control period on their way, in the order of time.

        Pictures may be views that hold until the next period: those that are kept longer are copied.
        """
        for packet in packets:
            if packet.sensor == "odometry" and isinstance(packet, Odometry):
                self.offer_state(packet)
                continue
            stream = self.streams[packet.sensor]
            if isinstance(packet, Image) and (self.record is not None or not stream.channel.delivers_at_once):
                stream.loan.wait_for(packet.data)
                packet = dataclasses.replace(packet, data=np.array(packet.data))  # the view is short-lived
            self._send(stream, packet)
            if self.record is not None:
                self.record(packet)

    def offer_state(self, state: Odometry) -> None:
        """Send the state of the vehicle on its way, unless that of this stamp has gone already.

        The one of stamp 0 meets no link: it is what everybody knows before time begins.
        """
        if state.stamp_ns <= self._odometry_ns:
            return
        self._odometry_ns = state.stamp_ns
        packet = Odometry(  # `dataclasses.replace` takes five times as long, in every control period
            sensor="odometry",
            stamp_ns=state.stamp_ns,
            sequence=self._odometry_count,
            position=state.position,
            orientation=state.orientation,
            velocity=state.velocity,
            body_rate=state.body_rate,
            rotor_speed=state.rotor_speed,
        )
        self._odometry_count += 1
        for name in ("rotor_speeds", "odometry"):
            if packet.stamp_ns:
                self._send(self.streams[name], packet)
            else:
                self.streams[name].send(packet, at_once=True)
        if self.record is not None:
            self.record(packet)

    def repeat_state(self) -> None:
        """Publish the last state again: somebody new may have missed that it is waited for an answer."""
        for name in ("rotor_speeds", "odometry"):
            self.streams[name].repeat()

    def deliver(self, delivery: Delivery | None, link: str) -> None:
        """Tell what a link did to a message."""
        if delivery is None:
            return
        if self.record is not None:
            self.record(delivery)
        self.announce_link(link)
        self._delivery_posts[link].publish(
            msg.Delivery(
                stamp_ns=delivery.stamp_ns,
                delivered_ns=delivery.delivered_ns,
                size_bytes=delivery.size_bytes,
                sequence=delivery.sequence,
            )
        )

    def announce_link(self, link: str) -> None:
        """Open the topic of what a link does, if it is not open yet."""
        if link not in self._delivery_posts:
            self._delivery_posts[link] = Post(
                self._node.publisher(topics.delivery_topic(self.vehicle, link), msg.Delivery)
            )

    def publish_due(self, stamp_ns: int) -> int | None:
        """Publish everything that has arrived by a simulated time [ns], in the order of arrival.

        Returns:
            Stamp of the newest odometry among it, as in the message [ns]; None if there is none.
        """
        arrived = [
            (due_ns, rank, stream, packet)
            for rank, stream in enumerate(self.streams.values())
            for due_ns, packet in stream.channel.due(stamp_ns)
        ]
        arrived.sort(key=lambda entry: entry[:2])
        newest_ns = None
        for due_ns, _, stream, packet in arrived:
            late_ns = 0 if self.lateness_ns is None else self.lateness_ns(due_ns)
            if stream.send(packet) and self.lateness_ns is not None:
                stream.late_times.add(max(late_ns, 0))
            if stream.name == "odometry":
                newest_ns = stream.delivered_ns
        return newest_ns

    @property
    def other_undelivered_count(self) -> int:
        """Messages of topics that are not sensors' which a reliable reader lost since the last reset."""
        sensors = {id(self.streams[name]) for name in self._sensor_names}
        return sum(post.undelivered_count for post in self._posts() if id(post) not in sensors)

    def take_held_up(self) -> list[str]:
        """Return the topics whose reliable readers have held us up since the last time."""
        return [post.publisher.topic for post in self._posts() if post.take_held_up()]

    @property
    def next_due_ns(self) -> int | None:
        """When the next packet arrives [ns]; None if none is under way."""
        dues = [due for s in self.streams.values() if (due := s.channel.next_due_ns) is not None]
        return min(dues, default=None)

    def _posts(self) -> Iterator[Post]:
        yield from self.streams.values()
        yield from self._delivery_posts.values()

    def _send(self, stream: Stream, packet: Packet) -> None:
        channel = stream.channel
        size_bytes = 0 if channel.delivers_at_once else payload_bytes(packet)
        delivery = channel.send(packet, stamp_ns=packet.stamp_ns, size_bytes=size_bytes)
        if delivery is not None:
            self.deliver(delivery, stream.name)

    def _add(
        self,
        name: str,
        message: type[Any],
        links: dict[str, LinkConfig],
        *,
        frame_id: str = "",
        latch: bool = False,
        expected_bytes: int = 0,
        convert: Callable[[Any, Callable[[int], int] | None], Any] | None = None,
    ) -> None:
        def to_message(packet: Packet, clock_ns: Callable[[int], int] | None) -> Any:
            return translate.to_message(packet, frame_id=frame_id, clock_ns=clock_ns)

        link = links.get(name, NO_LINK)
        publisher = self._node.publisher(
            topics.stream_topic(self.vehicle, name), message, latch=latch, expected_bytes=expected_bytes
        )
        self.streams[name] = Stream(
            publisher,
            Channel(name, link, seed=self._seed),
            name=name,
            translate=convert or to_message,
            device=self._device,
        )
        if not link.delivers_at_once:
            self.announce_link(name)

    def _describe(self, sensor: Any, node: Node) -> tuple[Publisher[Any], ...]:
        """Publish where a sensor sits, unless that is the body itself, and how a camera projects."""
        publishers: list[Publisher[Any]] = []

        def announce(topic: str, message: Any) -> None:
            publisher = node.publisher(topic, type(message), latch=True)
            publisher.publish(message)
            publishers.append(publisher)

        transform = translate.mount_transform(self.vehicle, sensor)
        if transform.child != transform.parent:
            announce(topics.transform_topic(self.vehicle, sensor.name), transform)
        info = translate.camera_info(self.vehicle, sensor)
        if info is not None:
            announce(topics.info_topic(self.vehicle, sensor.name), info)
        return tuple(publishers)
