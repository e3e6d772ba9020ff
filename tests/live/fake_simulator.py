"""A stand-in for the simulator: publishes made-up data of one vehicle on the topics of the real one."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Any

import numpy as np
from processes import SOON_S

from cortex import Node, Publisher
from cortex import messages as msg
from neurosim_core.config import load_config, to_yaml
from neurosim_core.live import topics
from neurosim_core.live.messages import message_type

MS = 1_000_000
WIDTH, HEIGHT = 32, 24
_LENS = {"width": WIDTH, "height": HEIGHT, "horizontal_fov_rad": 1.5}
SENSORS: dict[str, Any] = {
    "dvs": {"kind": "event_camera", "lens": _LENS},
    "rgb": {"kind": "rgb", "lens": _LENS},
    "z": {"kind": "depth", "lens": _LENS},
    "imu": {"kind": "imu"},
}
ROTORS = np.array([400.0, 410.0, 420.0, 430.0])


def make_events(k: int, *, count: int = 40, width: int = WIDTH, height: int = HEIGHT) -> msg.Events:
    """The events of window k of 10 ms."""
    rng = np.random.default_rng(k)
    return msg.Events(
        stamp_ns=(k + 1) * 10 * MS,
        start_ns=k * 10 * MS,
        t=np.sort(rng.integers(k * 10_000 + 1, (k + 1) * 10_000 + 1, count)),
        x=rng.integers(0, width, count).astype(np.uint16),
        y=rng.integers(0, height, count).astype(np.uint16),
        polarity=rng.integers(0, 2, count).astype(np.uint8),
        width=width,
        height=height,
        sequence=k,
    )


class FakeSimulator:
    """Publishes when told to. A context manager.

    Attributes:
        node: The node.
        sensors: Publisher of each sensor.
        odometry: Its publisher, and so on.
    """

    def __init__(
        self, scene_file: str = "", *, run_on: bool = True, overrides: Mapping[str, Any] | None = None
    ):
        config = load_config(
            {
                "scene": {"kind": "mesh", "file": scene_file},
                "sensors": SENSORS,
                "live": {"run_on": run_on},
                **(overrides or {}),
            }
        )
        self.config = config
        self.node = Node("simulator")
        self._status_count = 0
        self._announcements = self._publisher(topics.SIMULATION, msg.Simulation, latch=True)
        self.statuses = self._publisher(topics.STATUS, msg.SimulatorStatus)
        self.sensors = {
            name: self._publisher(f"/drone/{name}", message_type(sensor.packet_class))
            for name, sensor in config.sensors.items()
        }
        self.odometry = self._publisher("/drone/odometry", msg.Odometry, latch=True)
        self.rotor_speeds = self._publisher("/drone/rotor_speeds", msg.RotorSpeeds, latch=True)
        self.path = self._publisher("/drone/path", msg.Path, latch=True)
        self.collisions = self._publisher("/drone/collision", msg.Collision)
        self.commands = {
            mode: self._publisher(topics.command_topic("drone", mode), kind)
            for mode, kind in topics.COMMANDS.items()
        }

    def change(self, settings: Mapping[str, Any]) -> None:
        """Announce other settings, as after `/set_parameters`."""
        self.config = load_config(self.config.model_dump(mode="json"), overrides=settings)
        self.announce()

    def announce(self, *, wait: bool = True) -> None:
        """Say what there is; wait until the viewer listens to all of it but the cameras."""
        self.path.publish(msg.Path(stamp_ns=0, time_ns=np.arange(3), position=np.arange(9.0).reshape(3, 3)))
        self._announcements.publish(
            msg.Simulation(
                config=to_yaml(self.config),
                version="0",
                vehicles=list(self.config.vehicles),
                mode="streaming",
                control_rate_hz=200.0,
            )
        )
        if not wait:
            return
        for publisher in (self.odometry, self.rotor_speeds, self.statuses, self.path, self.collisions):
            assert publisher.wait_for_subscribers(timeout_s=SOON_S)
        for publisher in self.commands.values():
            assert publisher.wait_for_subscribers(timeout_s=SOON_S)

    def wait_for_cameras(self) -> None:
        """Wait until the viewer listens to every sensor, and to the state."""
        for publisher in (*self.sensors.values(), self.odometry, self.rotor_speeds):
            assert publisher.wait_for_subscribers(timeout_s=SOON_S)

    def state(self, k: int) -> None:
        """Publish odometry, rotor speeds and a sample of the IMU at 5 k ms."""
        stamp_ns = 5 * MS * k
        self.rotor_speeds.publish(msg.RotorSpeeds(stamp_ns=stamp_ns, speed=ROTORS + k, sequence=k))
        self.odometry.publish(
            msg.Odometry(
                stamp_ns=stamp_ns,
                position=np.array([0.01 * k, 1.0, 2.0]),
                orientation=np.array([0.0, 0.0, 0.0, 1.0]),
                velocity=np.array([3.0, 4.0, 0.0]),
                body_rate=np.zeros(3),
                sequence=k,
            )
        )
        self.sensors["imu"].publish(
            msg.Imu(
                stamp_ns=stamp_ns,
                specific_force=np.array([k, 0.0, 9.81]),
                angular_rate=np.arange(3.0),
                sequence=k,
            )
        )

    def image(self, k: int) -> None:
        """Publish a picture and a depth at 50 k ms."""
        grey = np.full((HEIGHT, WIDTH, 3), k % 256, dtype=np.uint8)
        self.sensors["rgb"].publish(msg.Image(stamp_ns=50 * MS * k, data=grey, encoding="rgb8", sequence=k))
        depth = np.full((HEIGHT, WIDTH, 1), 2.0, dtype=np.float32)
        self.sensors["z"].publish(msg.Image(stamp_ns=50 * MS * k, data=depth, encoding="32FC1", sequence=k))

    def status(self, stamp_ns: int, phase: str = "running", *, dropped: int = 0) -> None:
        """Publish a status."""
        self._status_count += 1
        self.statuses.publish(
            msg.SimulatorStatus(
                stamp_ns=stamp_ns,
                wall_ns=0,
                phase=phase,
                reason="it is over" if phase == "ended" else "",
                mode="streaming",
                real_time_factor_wanted=1.0,
                real_time_factor=0.5,
                step_count=stamp_ns // (5 * MS),
                step_median_ns=2 * MS,
                step_p99_ns=3 * MS,
                late_median_ns=MS // 2,
                late_p99_ns=MS,
                overrun_count=7,
                slipped_ns=250 * MS,
                sensors=[
                    msg.SensorStatus(
                        vehicle="drone",
                        name=name,
                        active=name != "z",
                        subscriber_count=1,
                        published_count=stamp_ns // (10 * MS),
                        dropped_count=dropped,
                        undelivered_count=2 if name == "rgb" else 0,
                    )
                    for name in self.sensors
                ],
                vehicles=[
                    msg.VehicleStatus(
                        name="drone",
                        command_mode="rates",
                        command_count=1,
                        refused_count=2,
                        superseded_count=0,
                        lost_count=3,
                        command_age_ns=5 * MS,
                        fail_safe=phase == "running" and stamp_ns > 900 * MS,
                        fail_safe_count=1,
                        collision_count=0,
                        undelivered_count=1,
                    )
                ],
                sequence=self._status_count,
            )
        )

    def _publisher(self, topic: str, kind: type[Any], *, latch: bool = False) -> Publisher[Any]:
        return self.node.publisher(topic, kind, latch=latch)

    def close(self) -> None:
        """Leave."""
        self.node.close()

    def __enter__(self) -> FakeSimulator:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
