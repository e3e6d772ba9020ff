"""A simulator's side, a bridge with a recording backend, and what tests wait for."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import numpy as np
from processes import SOON_S, wait_for
from recording_backend import RecordingBackend

from cortex import Node
from cortex import messages as msg
from cortex_ros2_bridge import bridge, incoming, outgoing, tally
from cortex_ros2_bridge.config import load


class Clock:
    """The module `time` of the bridge, whose monotonic clock can be put forward, and stopped."""

    def __init__(self) -> None:
        self._stopped_s: float | None = None
        self._ahead_s = 0.0

    def __getattr__(self, name: str) -> Any:
        return getattr(time, name)

    def monotonic(self) -> float:
        return self._ahead_s + (time.monotonic() if self._stopped_s is None else self._stopped_s)

    def stop(self) -> None:
        """Let time pass only where it is put forward."""
        self._stopped_s = time.monotonic()

    def put_forward(self, span_s: float) -> None:
        self._ahead_s += span_s


class Rig:
    """Everything in one process; `update_until` is the bridge's clockwork."""

    def __init__(self, settings: Any = None) -> None:
        self._patches = contextlib.ExitStack()
        self.clock = Clock()
        for module in (bridge, incoming, outgoing, tally):
            self._patches.enter_context(mock.patch.object(module, "time", self.clock))
        self.backend = RecordingBackend()
        self.simulator = Node("simulator")
        self.node = Node("bridge")
        try:
            self.bridge = bridge.Bridge(load(settings), self.backend, self.node)
        except BaseException:
            self.node.close()
            self.simulator.close()
            self._patches.close()
            raise

    def update_until(
        self, condition: Callable[[], object], timeout_s: float = SOON_S, *, every_s: float = 0.0
    ) -> Any:
        """Let the bridge look until something holds, with its clock put forward before each look."""

        def look() -> object:
            self.clock.put_forward(every_s)
            self.bridge.update()
            return condition()

        return wait_for(look, timeout_s)

    def updates_during(self, count: int = 20, *, every_s: float = 0.0) -> None:
        """Let the bridge look some times, with its clock put forward before each look."""
        for _ in range(count):
            self.clock.put_forward(every_s)
            self.bridge.update()

    def has_seen(self, name: str, **values: Any) -> bool:
        """Whether the bridge knows something of a vehicle: `now_ns`, `max_thrust_n`."""
        vehicle = self.bridge._connections._vehicles[name]
        return all(getattr(vehicle, what) == value for what, value in values.items())

    def opens(self, *topics: str) -> list[Any]:
        """Wait until the bridge publishes ROS topics."""
        self.update_until(lambda: all(topic in self.backend.publishers for topic in topics))
        return [self.backend.publishers[topic] for topic in topics]

    def subscribes(self, *topics: str) -> list[Any]:
        """Wait until the bridge subscribes to ROS topics."""
        self.update_until(lambda: all(topic in self.backend.subscriptions for topic in topics))
        return [self.backend.subscriptions[topic] for topic in topics]

    @contextlib.contextmanager
    def listening(self, publisher: Any, *topics: str) -> Iterator[list[Any]]:
        """Somebody in ROS listens to topics, and the Cortex publisher has got its subscriber."""
        with self.backend.listening(*topics) as found:
            self.update_until(lambda: publisher.subscriber_count == 1)
            yield found

    def has_calibration(self, topic: str) -> bool:
        """Whether the calibration that goes with each picture has come to what publishes on a topic."""
        feeds = self.bridge._connections.feeds.values()
        outputs = [o for f in feeds for o in f._outputs if o.route.ros_topic == topic]
        return bool(outputs) and all(o.context.camera_info is not None for o in outputs)

    def tally(self, name: str) -> Any:
        return self.bridge.totals()[name]

    def close(self) -> None:
        self.bridge.close()
        self.node.close()
        self.simulator.close()
        self._patches.close()


@contextlib.contextmanager
def rig_of(settings: Any = None) -> Iterator[Rig]:
    rig = Rig(settings)
    try:
        yield rig
    finally:
        rig.close()


def odometry(stamp_ns: int, *, sequence: int = 0) -> msg.Odometry:
    """At (1, 2, 3), turned by 90 degrees about z, flying to the north: forward."""
    half = np.sqrt(0.5)
    return msg.Odometry(
        stamp_ns=stamp_ns,
        position=np.array([1.0, 2.0, 3.0]),
        orientation=np.array([0.0, 0.0, half, half]),
        velocity=np.array([0.0, 2.0, 0.0]),
        body_rate=np.array([0.1, 0.2, 0.3]),
        sequence=sequence,
    )


def imu(stamp_ns: int, *, sequence: int = 0) -> msg.Imu:
    return msg.Imu(
        stamp_ns=stamp_ns,
        specific_force=np.array([0.1, 0.2, 9.81]),
        angular_rate=np.array([1.0, 2.0, 3.0]),
        sequence=sequence,
    )


def image(stamp_ns: int, *, width: int = 4, height: int = 3) -> msg.Image:
    data = np.arange(height * width * 3, dtype=np.uint8).reshape(height, width, 3)
    return msg.Image(stamp_ns=stamp_ns, data=data, encoding="rgb8", frame_id="drone/rgb_optical_frame")


def camera_info(sensor: str, *, width: int = 4, height: int = 3) -> msg.CameraInfo:
    return msg.CameraInfo(
        stamp_ns=0,
        width=width,
        height=height,
        matrix=np.array([[2.0, 0.0, 2.0], [0.0, 2.0, 1.5], [0.0, 0.0, 1.0]]),
        distortion_model="",
        distortion=np.zeros(0),
        frame_id=f"drone/{sensor}_optical_frame",
    )


def transform(sensor: str, *, x: float = 0.1) -> msg.Transform:
    return msg.Transform(
        stamp_ns=0,
        parent="drone/base_link",
        child=f"drone/{sensor}",
        translation=np.array([x, 0.0, 0.0]),
        rotation=np.array([0.0, 0.0, 0.0, 1.0]),
    )


def stamp_ns(header: Any) -> int:
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
