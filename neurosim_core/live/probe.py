"""Nodes that note when messages arrive, for the benchmarks of the live stack."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortex import Node, Publisher, Subscriber, keep_last, latest
from cortex.messages import Events, Image, Imu, MotorCommand, RotorSpeeds, SimulatorStatus
from neurosim_core.live.topics import STATUS, command_topic, stream_topic

Check = Callable[[], None]
"""Called about five times a second during a wait; raises if the wait is pointless."""

_SMALL_DEPTH = 8192
"""Queue of small messages."""
_WAIT_S = 0.2
_START_S = 180.0
"""Longest wait for the first message: a scene is loaded, and kernels are compiled [s]."""
_SILENCE_S = 30.0
"""Longest wait for any other [s]."""
_IMAGES_MIN = 10
"""Least number of images of a measurement."""


class ProbeError(RuntimeError):
    """Messages did not arrive; the text names the topic."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopTrace:
    """Measurements of a controller that answers every image; times are of CLOCK_MONOTONIC."""

    sent_ns: NDArray[np.int64]
    """When each command was handed to Cortex [ns], shape [commands]."""
    answered_ns: NDArray[np.int64]
    """Stamp of the state that each command answers [ns], shape [commands]."""
    image_stamp_ns: NDArray[np.int64]
    """Stamp of each image that was received after the warm-up [ns], shape [images]."""
    published_ns: NDArray[np.int64]
    """When the simulator published each image [ns], shape [images]."""
    received_ns: NDArray[np.int64]
    """When each image was in the controller's hands [ns], shape [images]."""
    image_bytes: int
    """Size of an image."""
    lost_count: int
    """Images after the warm-up that never arrived."""
    overtaken_count: int
    """Images after the warm-up that gave way to newer ones before the controller looked."""


def answer_images(
    *,
    vehicle: str,
    camera: str,
    speed_rad_s: NDArray[np.float64],
    seconds: float,
    warm_up_s: float,
    check: Check,
    spin_s: float = 0.0,
) -> LoopTrace:
    """Be a controller that answers each image with a command, and note when that happens.

    Args:
        vehicle: Whose images.
        camera: Name of its camera.
        speed_rad_s: Rotor speeds that are commanded [rad/s], shape [R].
        seconds: How long to measure [wall-clock s].
        warm_up_s: How long to fly before that [wall-clock s].
        check: Is called about five times a second while nothing comes.
        spin_s: How long to look for an image before sleeping (`Subscriber.look_out`) [s].
    """
    commands_sent: list[tuple[int, int]] = []
    images: list[tuple[int, int, int]] = []
    with Node("loop probe") as node:
        pictures = node.subscriber(stream_topic(vehicle, camera), Image, policy=latest())
        rotors = node.subscriber(
            stream_topic(vehicle, "rotor_speeds"), RotorSpeeds, policy=keep_last(_SMALL_DEPTH)
        )
        commands = node.publisher(command_topic(vehicle, "motor_speeds"), MotorCommand)

        def command(stamp_ns: int) -> None:
            message = MotorCommand(stamp_ns=stamp_ns, speed=speed_rad_s, sequence=len(commands_sent))
            commands_sent.append((time.monotonic_ns(), stamp_ns))
            commands.publish(message)

        def idle() -> None:
            """Answer what the rotors say where an image was lost: in lockstep nothing would go on."""
            try:
                while True:
                    stamp_ns = rotors.recv(0.0).stamp_ns
                    if stamp_ns > commands_sent[-1][1]:
                        command(stamp_ns)
            except TimeoutError:
                check()

        _wait_for_simulator(commands, check)
        first, _ = _receive(rotors, check, _START_S)  # from here on commands are taken
        command(first.stamp_ns)
        begin, image_bytes, end_ns, before = 0, 0, 0, (0, 0)
        while not end_ns or time.monotonic_ns() < end_ns or len(images) - begin < _IMAGES_MIN:
            if spin_s:
                pictures.look_out(spin_s)
            image, info = _receive(pictures, idle, _SILENCE_S if images else _START_S)
            if image.stamp_ns > commands_sent[-1][1]:
                command(image.stamp_ns)
            images.append((image.stamp_ns, info.publish_ns, info.publish_ns + info.latency_ns))
            if not end_ns and images[-1][2] >= images[0][2] + round(warm_up_s * 1e9):
                begin, image_bytes = len(images), image.data.nbytes
                before = (pictures.counters.lost, pictures.counters.overtaken)
                end_ns = time.monotonic_ns() + round(seconds * 1e9)
        counters = pictures.counters
    sent, answered = np.array(commands_sent, dtype=np.int64).T
    stamps, published, received = np.array(images[begin:], dtype=np.int64).T
    return LoopTrace(
        sent_ns=sent,
        answered_ns=answered,
        image_stamp_ns=stamps,
        published_ns=published,
        received_ns=received,
        image_bytes=image_bytes,
        lost_count=counters.lost - before[0],
        overtaken_count=counters.overtaken - before[1],
    )


def _wait_for_simulator(publisher: Publisher[Any], check: Check) -> None:
    deadline_s = time.monotonic() + _START_S
    while not publisher.wait_for_subscribers(1, timeout_s=_WAIT_S):
        check()
        if time.monotonic() > deadline_s:
            raise ProbeError(f"{publisher.topic} had no subscriber within {_START_S:g} s")


def _receive(subscriber: Subscriber[Any], check: Check, limit_s: float) -> tuple[Any, Any]:
    """Return the next message and its info."""
    deadline_s = time.monotonic() + limit_s
    while True:
        try:
            return subscriber.recv_with_info(_WAIT_S)
        except TimeoutError:
            check()
            if time.monotonic() > deadline_s:
                raise ProbeError(f"{subscriber.topic} was silent for {limit_s:g} s") from None


@dataclass(frozen=True, kw_only=True, eq=False)
class StreamTrace:
    """Measurements of a `StreamProbe`."""

    imu_stamp_ns: NDArray[np.int64]
    """Stamps of the samples [ns], shape [samples]."""
    imu_received_ns: NDArray[np.int64]
    """When they arrived, by `time.monotonic_ns` [ns], shape [samples]."""
    imu_lost_count: int
    packet_count: int
    """Packets of events."""
    event_count: int
    packet_lost_count: int
    event_dropped_count: int
    """Events that the simulator dropped."""
    status: SimulatorStatus
    """The last one."""
    resident_bytes: NDArray[np.int64]
    """Memory of each watched process, about once a second, shape [times, processes]; -1: unknown."""
    resident_s: NDArray[np.float64]
    """When, since the first sample [s], shape [times]."""


class StreamProbe:
    """Notes the samples of an IMU and the packets of an event camera. A context manager."""

    def __init__(self, *, vehicle: str, imu: str, camera: str) -> None:
        """Subscribe; before time begins."""
        self._node = Node("stream probe")
        topic = stream_topic(vehicle, camera)
        self._imu = self._node.subscriber(stream_topic(vehicle, imu), Imu, policy=keep_last(_SMALL_DEPTH))
        self._events = self._node.subscriber(topic, Events, self._on_events, policy=keep_last(256))
        self._statuses = self._node.subscriber(STATUS, SimulatorStatus, policy=latest())
        self._sequences: list[int] = []
        self._event_count = self._dropped_count = 0

    def __enter__(self) -> StreamProbe:
        return self

    def __exit__(self, *_: object) -> None:
        self._node.close()

    def _on_events(self, events: Events) -> None:
        self._sequences.append(events.sequence)
        self._event_count += len(events.t)
        self._dropped_count += events.dropped_count

    def listen(self, seconds: float, *, resident: Callable[[], list[int]], check: Check) -> StreamTrace:
        """Note what arrives.

        `seconds`: how long, from the first sample of the IMU on [wall-clock s]. `resident`: returns the
        memory of the watched processes [bytes]. `check`: see `Check`.
        """
        samples: list[tuple[int, int, int]] = []
        memory: list[list[int]] = []
        memory_ns: list[int] = []
        while not samples or samples[-1][1] < samples[0][1] + seconds * 1e9:
            sample, info = _receive(self._imu, check, _SILENCE_S if samples else _START_S)
            received_ns = info.publish_ns + info.latency_ns
            samples.append((sample.stamp_ns, received_ns, sample.sequence))
            if not memory_ns or received_ns >= memory_ns[-1] + 1_000_000_000:
                memory.append(resident())
                memory_ns.append(received_ns)
        memory.append(resident())
        memory_ns.append(samples[-1][1])
        try:
            status = self._statuses.recv(0.0)
        except TimeoutError:
            raise ProbeError(f"{STATUS} was silent for {seconds:g} s") from None
        stamps, times, sequences = np.array(samples, dtype=np.int64).T
        packets = self._sequences[:]
        return StreamTrace(
            imu_stamp_ns=stamps,
            imu_received_ns=times,
            imu_lost_count=_gaps(sequences.tolist()),
            packet_count=len(packets),
            event_count=self._event_count,
            packet_lost_count=_gaps(packets),
            event_dropped_count=self._dropped_count,
            status=status,
            resident_bytes=np.array(memory, dtype=np.int64),
            resident_s=1e-9 * (np.array(memory_ns) - times[0]),
        )


def _gaps(sequences: list[int]) -> int:
    """Return how many numbers are missing."""
    return sequences[-1] - sequences[0] + 1 - len(sequences) if sequences else 0
