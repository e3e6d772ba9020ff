"""What the benchmarks of the live stack measure with: nodes that note when messages come."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex import Node, Publisher, Subscriber, keep_last, latest
from cortex.messages import Events, Image, Imu, MotorCommand, RotorSpeeds, SimulatorStatus
from neurosim_core.bench.loop_trace import LoopTrace, command_speed
from neurosim_core.live.topics import STATUS, command_topic, stream_topic

Check = Callable[[], None]
"""Raises if there is nothing left to wait for."""

_SMALL_DEPTH = 8192
"""Small messages that may wait until the probe looks."""
_WAIT_S = 0.2
_START_S = 180.0
"""Longest wait for the first message: a scene is loaded, and kernels are compiled."""
_SILENCE_S = 30.0
"""Longest wait for any other."""
_IMAGES_MIN = 10
"""A measurement goes on until it has as many images."""


class ProbeError(RuntimeError):
    """What was to be measured did not happen; the message says what was waited for."""


def answer_images(
    *,
    vehicle: str,
    camera: str,
    hover_rad_s: float,
    rotor_count: int,
    seconds: float,
    warm_up_s: float,
    watch_rotors: bool,
    check: Check,
    spin_s: float = 0.0,
) -> LoopTrace:
    """Be a controller that answers each image with a numbered command, and note when that happens.

    Args:
        vehicle: Whose images and rotors.
        camera: Name of its camera.
        hover_rad_s: Speed of its rotors that carries it [rad/s].
        rotor_count: How many it has.
        seconds: How long to measure [wall-clock s].
        warm_up_s: How long to fly before that [wall-clock s].
        watch_rotors: Listen to the rotors all the time, not only before the measurement.
        check: Called about five times a second while nothing comes.
        spin_s: How long to look for an image before sleeping (`Subscriber.look_out`) [s].

    Raises:
        ProbeError: Nothing came for a long time.
    """
    sent: list[int] = []
    answered: list[int] = []
    images: list[tuple[int, int, int]] = []
    reports: list[tuple[int, int, float]] = []
    with Node("loop probe") as node:
        pictures = node.subscriber(stream_topic(vehicle, camera), Image, policy=latest())
        rotors = _listen_to_rotors(node, vehicle)
        commands = node.publisher(command_topic(vehicle, "motor_speeds"), MotorCommand)

        def command(stamp_ns: int) -> None:
            number = len(sent)
            speed = np.full(rotor_count, command_speed(number, hover_rad_s))
            message = MotorCommand(stamp_ns=stamp_ns, speed=speed, sequence=number)
            answered.append(stamp_ns)
            sent.append(time.monotonic_ns())
            commands.publish(message)

        _meet(commands, check)
        first, _ = _receive(rotors, check, _START_S)  # from here on commands are taken
        reports.append(_report(first))
        command(first.stamp_ns)
        begin, image_bytes, end_ns, warm_ns = 0, 0, 0, 0
        before = (0, 0)
        watching = True

        def idle() -> None:
            """Answer what the rotors say where an image was lost: in lockstep nothing would go on."""
            nonlocal rotors, watching
            if not watching:
                rotors, watching = _listen_to_rotors(node, vehicle), True
            reports.extend(_reports(rotors))
            if reports[-1][0] > answered[-1]:
                command(reports[-1][0])
            check()

        while not end_ns or time.monotonic_ns() < end_ns or len(images) - begin < _IMAGES_MIN:
            if spin_s:
                pictures.look_out(spin_s)
            image, info = _receive(pictures, idle, _SILENCE_S if images else _START_S)
            if image.stamp_ns > answered[-1]:
                command(image.stamp_ns)
            images.append((image.stamp_ns, info.publish_ns, info.publish_ns + info.latency_ns))
            if watching:
                reports += _reports(rotors)  # while the simulator is busy with the next image
            if not warm_ns:
                warm_ns = images[0][2] + round(warm_up_s * 1e9)
            if not end_ns and images[-1][2] >= warm_ns:
                begin, image_bytes = len(images), image.data.nbytes
                if not watch_rotors:
                    rotors.close()
                    watching = False
                before = (pictures.counters.lost, pictures.counters.overtaken)
                end_ns = time.monotonic_ns() + round(seconds * 1e9)
        if watching:
            reports += _reports(rotors)
        counters = pictures.counters
    stamps, published, received = np.array(images, dtype=np.int64).T
    rotor_stamps, sequences, speeds = zip(*reports, strict=True)
    return LoopTrace(
        sent_ns=np.array(sent, dtype=np.int64),
        answered_ns=np.array(answered, dtype=np.int64),
        image_stamp_ns=stamps,
        published_ns=published,
        received_ns=received,
        rotor_stamp_ns=np.array(rotor_stamps, dtype=np.int64),
        rotor_sequence=np.array(sequences, dtype=np.int64),
        rotor_speed=np.array(speeds),
        image_bytes=image_bytes,
        begin=begin,
        lost_count=counters.lost - before[0],
        overtaken_count=counters.overtaken - before[1],
    )


def _listen_to_rotors(node: Node, vehicle: str) -> Subscriber[RotorSpeeds]:
    topic = stream_topic(vehicle, "rotor_speeds")
    return node.subscriber(topic, RotorSpeeds, policy=keep_last(_SMALL_DEPTH))


def _meet(publisher: Publisher[Any], check: Check) -> None:
    """Wait until a simulator listens."""
    deadline_s = time.monotonic() + _START_S
    while not publisher.wait_for_subscribers(1, timeout_s=_WAIT_S):
        check()
        if time.monotonic() > deadline_s:
            raise ProbeError(f"nobody took commands from {publisher.topic} within {_START_S:g} s")


def _receive(subscriber: Subscriber[Any], check: Check, limit_s: float) -> tuple[Any, Any]:
    """Take the next message, and what is known of it."""
    deadline_s = time.monotonic() + limit_s
    while True:
        try:
            return subscriber.recv_with_info(_WAIT_S)
        except TimeoutError:
            check()
            if time.monotonic() > deadline_s:
                raise ProbeError(f"{subscriber.topic} was silent for {limit_s:g} s") from None


def _reports(rotors: Subscriber[RotorSpeeds]) -> list[tuple[int, int, float]]:
    """Take what has arrived: stamp, number, speed of the first rotor."""
    found: list[tuple[int, int, float]] = []
    while True:
        try:
            message = rotors.recv(0.0)
        except TimeoutError:
            return found
        found.append(_report(message))


def _report(message: RotorSpeeds) -> tuple[int, int, float]:
    return message.stamp_ns, message.sequence, float(message.speed[0])


@dataclass(frozen=True, kw_only=True, eq=False)
class StreamTrace:
    """How an IMU and an event camera came in; times are of CLOCK_MONOTONIC, stamps of the simulation."""

    imu_stamp_ns: NDArray[np.int64]
    """Stamp of each sample [ns], shape [samples]."""
    imu_received_ns: NDArray[np.int64]
    """When each sample was in the receiver's hands [ns], shape [samples]."""
    imu_lost_count: int
    """Samples that never came: numbers that are missing."""
    packet_count: int
    """Packets of events."""
    event_count: int
    packet_lost_count: int
    """Packets of events that never came."""
    event_dropped_count: int
    """Events that did not fit into the simulator's buffer."""
    status: SimulatorStatus
    """The last that was heard."""
    resident_bytes: NDArray[np.int64]
    """Memory of each process that was watched, about once a second, shape [times, processes]; -1: unknown."""
    resident_s: NDArray[np.float64]
    """When, since the first sample [s], shape [times]."""


class _Gaps:
    """Counts numbers that are missing from a sequence."""

    def __init__(self) -> None:
        self.count = 0
        self._next: int | None = None

    def see(self, sequence: int) -> None:
        if self._next is not None:
            self.count += max(0, sequence - self._next)
        self._next = sequence + 1


class StreamProbe:
    """Listens to an IMU and to an event camera; to be there before time begins."""

    def __init__(self, *, vehicle: str, imu: str, camera: str) -> None:
        """Subscribe."""
        self._node = Node("stream probe")
        self._imu = self._node.subscriber(stream_topic(vehicle, imu), Imu, policy=keep_last(_SMALL_DEPTH))
        self._packets = self._events = self._dropped = 0
        self._camera_gaps = _Gaps()
        self._status: SimulatorStatus | None = None
        self._camera = self._node.subscriber(
            stream_topic(vehicle, camera), Events, self._on_events, policy=keep_last(256)
        )
        self._node.subscriber(STATUS, SimulatorStatus, self._on_status, policy=latest())

    def __enter__(self) -> StreamProbe:
        return self

    def __exit__(self, *_: object) -> None:
        self._node.close()

    def _on_events(self, events: Events) -> None:
        self._packets += 1
        self._events += len(events.t)
        self._dropped += events.dropped_count
        self._camera_gaps.see(events.sequence)

    def _on_status(self, status: SimulatorStatus) -> None:
        self._status = status

    def listen(self, seconds: float, *, resident: Callable[[], list[int]], check: Check) -> StreamTrace:
        """Note what comes.

        Args:
            seconds: How long, from the first sample of the IMU on [wall-clock s].
            resident: Returns the memory of the processes to watch [bytes].
            check: Called about five times a second while nothing comes.

        Raises:
            ProbeError: Nothing came for a long time.
        """
        stamps: list[int] = []
        times: list[int] = []
        memory: list[list[int]] = []
        memory_s: list[float] = []
        gaps = _Gaps()
        next_ns = 0
        while not times or times[-1] < times[0] + seconds * 1e9:
            sample, info = _receive(self._imu, check, _SILENCE_S if times else _START_S)
            gaps.see(sample.sequence)
            stamps.append(sample.stamp_ns)
            times.append(info.publish_ns + info.latency_ns)
            if times[-1] >= next_ns:
                memory.append(resident())
                memory_s.append((times[-1] - times[0]) * 1e-9)
                next_ns = times[-1] + 1_000_000_000
        memory.append(resident())
        memory_s.append((times[-1] - times[0]) * 1e-9)
        if self._status is None:
            raise ProbeError(f"{STATUS} was silent for {seconds:g} s")
        return StreamTrace(
            imu_stamp_ns=np.array(stamps, dtype=np.int64),
            imu_received_ns=np.array(times, dtype=np.int64),
            imu_lost_count=gaps.count,
            packet_count=self._packets,
            event_count=self._events,
            packet_lost_count=self._camera_gaps.count,
            event_dropped_count=self._dropped,
            status=self._status,
            resident_bytes=np.array(memory, dtype=np.int64),
            resident_s=np.array(memory_s),
        )
