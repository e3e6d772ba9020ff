"""The topics of a vehicle: its sensors, its state, the poses of its sensors, deliveries of its links."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex import Node, Publisher
from cortex import messages as msg
from neurosim_core.live import messages, topics
from neurosim_core.live.config import NO_LINK
from neurosim_core.live.links import Link, payload_bytes
from neurosim_core.live.loans import PictureLoan
from neurosim_core.live.pacing import Timings
from neurosim_core.packets import Delivery, Image, Odometry, Packet, schema_of
from neurosim_core.record import describe_sensors
from neurosim_core.sensors.base import CameraConfig, SensorConfig
from neurosim_core.sim import COLLISION, Model

_PIXEL_EVENTS_HZ = 100.0
_EVENT_BYTES = 13
_RESERVED_MAX_BYTES = 8 << 20


class PacketTopic:
    """One topic of packets, with the link in front of it.

    Attributes:
        name: Of the sensor, or odometry, rotor_speeds, collision.
        publisher: Where messages go.
        link: Messages in flight.
        loan: Memory for its next picture; None: pictures are copied.
        late_times: How late by the wall clock messages were published since the last status [ns].
        subscriber_count: As of the last `update`.
        is_recorded: Whether packets count that nobody subscribes to.
        published_count: Messages since the last reset.
        delivered_ns: Stamp in the message that arrived last [ns]; None if there was none.
    """

    def __init__(
        self, name: str, publisher: Publisher[Any], link: Link, convert: Callable[..., Any], **options: Any
    ) -> None:
        """Put a link in front of a publisher; `convert` makes messages of packets, with further `options`."""
        self.name = name
        self.publisher = publisher
        self.link = link
        self.loan: PictureLoan | None = None
        self.late_times = Timings()
        self.subscriber_count = 0
        self.is_recorded = False
        self._convert = convert
        self._options = options
        self._latched = publisher.latch
        self.begin()

    def begin(self) -> None:
        """Begin a new run."""
        self._lost_before = self.publisher.counters.timeouts
        self.late_times.take()
        self.published_count = 0
        self.delivered_ns: int | None = None
        self._last: Any = None
        self._kept: Packet | None = None
        if self.loan is not None:
            self.loan.release()  # after the packet that holds it

    @property
    def undelivered_count(self) -> int:
        """Messages that a reliable reader lost since the last reset."""
        return self.publisher.counters.timeouts - self._lost_before

    def send(self, packet: Packet, *, at_once: bool = False) -> bool:
        """Publish a packet if there are subscribers; return whether it was published.

        A latched topic without subscribers keeps the newest packet and publishes it with the next `update`.
        With `at_once` a packet is published without subscribers, too.
        """
        config = self.link.config
        clocked = config.clock_offset_s or config.clock_drift_ppm
        self.delivered_ns = config.clock_ns(packet.stamp_ns)
        self.published_count += self.is_recorded and packet is not self._kept
        if not (self.subscriber_count or at_once):
            self._kept = packet if self._latched else None
            return False
        message = self._convert(packet, clock_ns=config.clock_ns if clocked else None, **self._options)
        self._kept = None
        if self.loan is not None and isinstance(packet, Image) and self.loan.holds(packet.data):
            self.loan.publish(message)
        else:
            self.publisher.publish(message)
        self.published_count += not self.is_recorded
        if self._latched:
            self._last = message
        return True

    def update(self) -> int:
        """Return how many subscribers there are now."""
        self.subscriber_count = self.publisher.subscriber_count
        if self._kept is not None:
            self.send(self._kept, at_once=True)
        return self.subscriber_count

    def repeat(self) -> None:
        """Publish the last message of a latched topic again, bit for bit."""
        if self._last is not None:
            self.publisher.publish(self._last)


class PacketPublisher:
    """Publishes the packets of one vehicle when simulated time says that they arrive. Not thread-safe.

    `offer` takes packets as they are computed, `publish_due` publishes them.

    Attributes:
        topics: The topics by name: sensors in the order of the configuration, collision, rotor_speeds,
            odometry.
        lateness_ns: Returns how long a simulated time [ns] has been due by the wall clock [ns]; None: time is
            not paced.
    """

    def __init__(
        self, node: Node, vehicle: str, model: Model, *, record: Callable[[Packet], None] | None = None
    ) -> None:
        """Open the topics of a vehicle on a node, and publish what does not change.

        `record`: called with every packet and every delivery.
        """
        self.vehicle = vehicle
        self.record = record
        self.lateness_ns: Callable[[int], int] | None = None
        self._node = node
        self._device = model.device
        self._deliveries: dict[str, Publisher[Any]] = {}
        self._lost_counts: dict[str, int] = {}
        config = model.config
        self._sensor_names = tuple(config.sensors)
        sensors = describe_sensors(config.sensors)
        self._image_names: list[str] = []
        self.topics: dict[str, PacketTopic] = {}

        def add(
            name: str, message: type[Any], convert: Callable[..., Any], *, latch: bool, **options: str
        ) -> None:
            link = NO_LINK if name == COLLISION else config.links.get(name, NO_LINK)
            size_bytes = _expected_bytes(config.sensors.get(name))
            topic = topics.stream_topic(vehicle, name)
            publisher = node.publisher(topic, message, latch=latch, expected_bytes=size_bytes)
            queue = Link(link, seed=config.seed, name=name)
            self.topics[name] = PacketTopic(name, publisher, queue, convert, **options)
            self.topics[name].is_recorded = record is not None
            if message is msg.Image:
                self._image_names.append(name)
            if not link.delivers_at_once:
                self.open_delivery(name)

        for sensor in sensors:
            if sensor.name != "odometry":
                message = messages.message_type(config.sensors[sensor.name].packet_class)
                frame_id = topics.sensor_frame(vehicle, sensor)
                add(sensor.name, message, messages.to_message, latch=False, frame_id=frame_id)
        add(COLLISION, msg.Collision, messages.to_message, latch=False)
        add("rotor_speeds", msg.RotorSpeeds, messages.rotor_speeds, latch=True)
        add("odometry", msg.Odometry, messages.to_message, latch=True)
        path = messages.path_message(model.path, end_ns=model.duration_ns)
        constants: list[tuple[str, Any]] = [(topics.stream_topic(vehicle, "path"), path)]
        for sensor in sensors:
            transform = messages.mount_transform(vehicle, sensor)
            if transform.child != transform.parent:
                constants.append((topics.stream_topic(vehicle, f"{sensor.name}/transform"), transform))
            if (info := messages.camera_info(vehicle, sensor)) is not None:
                constants.append((topics.stream_topic(vehicle, f"{sensor.name}/info"), info))
        self._constants = [node.publisher(topic, type(message), latch=True) for topic, message in constants]
        for publisher, (_, message) in zip(self._constants, constants, strict=True):
            publisher.publish(message)
        self.reset(seed=config.seed)

    def reset(self, *, seed: int) -> None:
        """Begin a new run at stamp 0."""
        self._odometry_count = 0
        self._odometry_ns = -1
        for topic in self.topics.values():
            topic.link.reset(seed=seed)
            topic.begin()
        self._lost_before = sum(publisher.counters.timeouts for publisher in self._publishers())

    def write_in_place(self, settle: Callable[[], object]) -> None:
        """Let the device write images into the memory of the topics; `settle` waits until it has."""
        for name in self._image_names:
            topic = self.topics[name]
            topic.loan = PictureLoan(topic.publisher, device=self._device, settle=settle)

    def acquire_buffer(self, name: str, _stamp_ns: int, picture: NDArray[Any]) -> NDArray[Any] | None:
        """Return memory into which the device can write the next picture of a camera.

        There is none if the picture is recorded or passes a link, or if the camera has no subscriber.
        `picture`: of the shape and dtype needed.
        """
        topic = self.topics[name]
        if self.record is not None or not topic.subscriber_count or topic.loan is None:
            return None
        passes_link = not topic.link.config.delivers_at_once or len(topic.link)
        return None if passes_link else topic.loan.acquire(picture)

    def close_loans(self) -> None:
        """Give back the memory of pictures; call it before the topics close."""
        with contextlib.ExitStack() as stack:  # each of them, whatever another one raises
            for topic in self.topics.values():
                if topic.loan is not None:
                    stack.callback(topic.loan.close)

    def update(self) -> tuple[int, ...]:
        """Return how many subscribers each topic has now."""
        return tuple(topic.update() for topic in self.topics.values())

    def active(self) -> frozenset[str]:
        """Return the sensors that are subscribed to or recorded, as of the last `update`."""
        if self.record is not None:
            return frozenset(self._sensor_names)
        return frozenset(name for name in self._sensor_names if self.topics[name].subscriber_count)

    def offer(self, packets: Iterable[Packet]) -> None:
        """Send packets of one control period, in the order of time.

        Pictures may be views that are valid until the next period: those that are kept longer are copied.
        """
        for packet in packets:
            if packet.sensor == "odometry" and isinstance(packet, Odometry):
                self.offer_state(packet)
                continue
            topic = self.topics[packet.sensor]
            if isinstance(packet, Image) and (
                self.record is not None or not topic.link.is_free(packet.stamp_ns)
            ):
                if topic.loan is not None and topic.loan.holds(packet.data):
                    topic.loan.settle()
                packet = dataclasses.replace(packet, data=np.array(packet.data))
            self._send(topic, packet)
            if self.record is not None:
                self.record(packet)

    def offer_state(self, state: Odometry) -> None:
        """Send the state of the vehicle, unless that of this stamp was sent already.

        The state of stamp 0 passes no link: everybody knows it before time begins.
        """
        if state.stamp_ns <= self._odometry_ns:
            return
        self._odometry_ns = state.stamp_ns
        # `dataclasses.replace` takes five times as long, in every control period
        packet = Odometry(**vars(state) | {"sensor": "odometry", "sequence": self._odometry_count})
        self._odometry_count += 1
        for name in ("rotor_speeds", "odometry"):
            if packet.stamp_ns:
                self._send(self.topics[name], packet)
            else:
                self.topics[name].send(packet, at_once=True)
        if self.record is not None:
            self.record(packet)

    def repeat_state(self) -> None:
        """Publish the last state again, for a new controller that may have missed it."""
        for name in ("rotor_speeds", "odometry"):
            self.topics[name].repeat()

    def deliver(self, delivery: Delivery | None, link: str) -> None:
        """Publish what a link did to a message; None: nothing."""
        if delivery is None:
            return
        if self.record is not None:
            self.record(delivery)
        self.open_delivery(link)
        self._deliveries[link].publish(messages.to_message(delivery))

    def open_delivery(self, link: str) -> None:
        """Open the topic of what a link does, if it is not open yet."""
        if link not in self._deliveries:
            topic = topics.stream_topic(self.vehicle, f"{link}/delivery")
            self._deliveries[link] = self._node.publisher(topic, msg.Delivery)

    def publish_due(self, stamp_ns: int) -> int | None:
        """Publish everything that has arrived by a simulated time [ns], in the order of arrival.

        Returns the stamp in the newest odometry message among it [ns]; None if there is none.
        """
        arrived = [
            (due_ns, rank, topic, packet)
            for rank, topic in enumerate(self.topics.values())
            for due_ns, packet in topic.link.due(stamp_ns)
        ]
        arrived.sort(key=lambda entry: entry[:2])
        newest_ns = None
        for due_ns, _, topic, packet in arrived:
            late_ns = 0 if self.lateness_ns is None else self.lateness_ns(due_ns)
            if topic.send(packet) and self.lateness_ns is not None:
                topic.late_times.add(max(late_ns, 0))
            if topic.name == "odometry":
                newest_ns = topic.delivered_ns
        return newest_ns

    @property
    def other_undelivered_count(self) -> int:
        """Messages of topics other than those of sensors that a reliable reader lost since the last reset."""
        lost = sum(publisher.counters.timeouts for publisher in self._publishers()) - self._lost_before
        return lost - sum(self.topics[name].undelivered_count for name in self._sensor_names)

    def take_lossy_topics(self) -> list[str]:
        """Return the topics whose reliable readers have lost messages since the last call."""
        before = self._lost_counts
        self._lost_counts = {each.topic: each.counters.timeouts for each in self._publishers()}
        return [topic for topic, count in self._lost_counts.items() if count > before.get(topic, 0)]

    @property
    def next_due_ns(self) -> int | None:
        """When the next packet arrives [ns]; None if none is in flight."""
        return min((t.link.next_due_ns for t in self.topics.values() if len(t.link)), default=None)  # type: ignore[type-var]

    def _publishers(self) -> list[Publisher[Any]]:
        return [*(topic.publisher for topic in self.topics.values()), *self._deliveries.values()]

    def _send(self, topic: PacketTopic, packet: Packet) -> None:
        free = topic.link.is_free(packet.stamp_ns)
        size_bytes = 0 if free else payload_bytes(packet)
        self.deliver(topic.link.send(packet, stamp_ns=packet.stamp_ns, size_bytes=size_bytes), topic.name)


def _expected_bytes(sensor: SensorConfig | None) -> int:
    """Return a size that messages of an event camera hardly exceed [bytes]; 0 for other sensors.

    Memory that is made before the flight delays no message in it: pixels fire at most about 100 times a
    second on average, also in fast flight.
    """
    if not (isinstance(sensor, CameraConfig) and schema_of(sensor.packet_class).has_events):
        return 0
    window_s = sensor.packets.stamp_ns(1) * 1e-9
    count = _PIXEL_EVENTS_HZ * window_s * sensor.lens.width * sensor.lens.height
    return min(round(count) * _EVENT_BYTES, _RESERVED_MAX_BYTES)
