"""One simulator in Rerun: its topics, and what is logged of their messages."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import yaml

from cortex import Node, Subscriber, keep_last, latest
from cortex import messages as msg
from cortex.schema import TypeMismatch
from neurosim_core.config import SimulationConfig, load_config
from neurosim_core.live import topics
from neurosim_core.live.episodes import Episodes
from neurosim_core.live.scene_loader import SceneLoader
from neurosim_core.live.status_text import status_text
from neurosim_core.live.translate import message_type, setpoint_of, to_packet
from neurosim_core.packets import Delivery
from neurosim_core.record.header import SensorDescription, describe_sensors
from neurosim_core.view.rerun_log import RerunLogger
from neurosim_core.view.rerun_shapes import SceneShapes
from neurosim_core.view.rerun_targets import RerunTarget

DRAIN_MAX = 1000
"""Messages of one stream that are taken before the next one has its turn."""
QUEUE = 4096
RATE_NS = 1_000_000_000
"""Rates are taken over as much simulated time [ns], or over as many statuses."""
STATUS_MAX = 50
APART_S = 1.0
"""Recordings begin at least so far apart [s]."""
_AHEAD_NS = 1_000_000_000
_NAME = "flight {}"


class _Stream(NamedTuple):
    """One subscription, and what is done with its messages."""

    key: str
    vehicle: str
    """Empty: of the simulator."""
    sensor: str
    """Name of the sensor; empty: it is none."""
    subscriber: Subscriber[Any]
    of_simulator: bool
    """Whether it is the simulator that sends it, so that what others send is ignored."""
    ordered: bool
    """Whether its stamps tell that a run has begun again."""
    take: Callable[[Any], None]


class Show:
    """Shows one simulator, from its announcement to its end. A context manager that closes the recording."""

    def __init__(
        self,
        node: Node,
        simulation: msg.Simulation,
        source: int,
        outlet: RerunTarget,
        *,
        number: Iterator[int],
        only: Sequence[str] | None,
        event_window_ns: int,
        image_rate_hz: float,
        say: Callable[[str], None],
        scene: SceneLoader,
    ) -> None:
        """Subscribe, and open a recording.

        Args:
            node: What to listen through.
            simulation: Announcement of the simulator.
            source: The publisher that it came from.
            outlet: Where recordings are opened.
            number: Numbers of recordings.
            only: Sensors to show; None: all.
            event_window_ns: Time in one picture of events [ns].
            image_rate_hz: Most images of a sensor a second [Hz].
            say: Told what a user should know.
            scene: Loads the scene.

        Raises:
            ValueError: `only` names no sensor of this simulator, or its settings cannot be read.
        """
        config = load_config(yaml.safe_load(simulation.config))
        self._vehicles = _shown(config, only)
        self._rotor_counts = {
            name: config.of(name).vehicle.airframe().rotor_count for name in config.vehicles
        }
        self._node = node
        self._siblings = _Siblings(node, source)
        self._outlet = outlet
        self._number = number
        self._window_ns = event_window_ns
        self._image_rate_hz = image_rate_hz
        self._say = say
        self._scene = scene
        self._shapes: SceneShapes | None = None
        self._paths: dict[str, Any] = {}
        self._command_ns: dict[str, int] = {}
        self._links: dict[str, list[str]] = _links(config)
        self._episodes = Episodes()
        self._statuses: deque[msg.SimulatorStatus] = deque()
        self._streams: list[_Stream] = []
        self.phase = ""
        """As the last status says; empty before the first one."""
        self._hurried = False
        self._opened_s = 0.0
        scene.load(config)
        self._logger = self._open()
        self._subscribe()

    @property
    def sensors(self) -> dict[str, list[str]]:
        """Names of the sensors shown, by vehicle."""
        return {name: [s.name for s in sensors] for name, sensors in self._vehicles.items()}

    @property
    def settled(self) -> bool:
        """Whether its recording began long enough ago for another one to begin."""
        return time.monotonic() - self._opened_s >= APART_S

    def change(self, simulation: msg.Simulation) -> None:
        """Listen to links that do something since the settings were changed.

        Their delays are logged at once; a recording that begins later has their plot in its layout.

        Raises:
            ValueError: The settings cannot be read.
        """
        for vehicle, links in _links(load_config(yaml.safe_load(simulation.config))).items():
            known = self._links.setdefault(vehicle, [])
            for link in links:
                if link not in known:
                    known.append(link)
                    self._subscribe_link(vehicle, link)

    def read(self) -> None:
        """Take what has come, and log it."""
        for stream in self._streams:
            for _ in range(DRAIN_MAX):
                try:
                    message, info = stream.subscriber.recv_with_info(0.0)
                except TimeoutError:
                    break
                except TypeMismatch as error:
                    self._say(f"{stream.subscriber.topic} is of another type:\n{error}")
                    continue
                if not stream.of_simulator or info.source in self._siblings:
                    self._take(stream, message)
        if self._shapes is None and (shapes := self._scene.shapes()) is not None:
            self._shapes = shapes
            self._logger.log_scene(shapes)

    def send(self) -> None:
        """Send what has been collected."""
        self._logger.send()

    def __enter__(self) -> Show:
        return self

    def __exit__(self, *_: object) -> None:
        self._unsubscribe()
        self._outlet.close_recording(self._logger)

    def _open(self) -> RerunLogger:
        self._opened_s = time.monotonic()
        number = next(self._number)
        logger = RerunLogger(
            self._outlet.open(_NAME.format(number)),
            vehicles=self._vehicles,
            scene=self._shapes,
            event_window_ns=self._window_ns,
            image_rate_max_hz=self._image_rate_hz,
            compress=self._outlet.compress,
            live=True,
            keep_layout=number > 1,
        )
        for vehicle, position in self._paths.items():
            logger.log_path(position, vehicle=vehicle)
        return logger

    def _begin_again(self) -> None:
        self._command_ns.clear()
        self._statuses.clear()
        if self.settled:
            self._outlet.close_recording(self._logger)
            self._logger = self._open()
            self._say("the simulator has begun again: a new recording")
        elif not self._hurried:
            self._hurried = True
            self._say(f"the simulator begins again within {APART_S:g} s: such runs share a recording")

    def _take(self, stream: _Stream, message: Any) -> None:
        if stream.ordered:
            run = self._episodes.sort(stream.key, message.stamp_ns, message.sequence)
            if run == "past":
                return
            if run == "next":
                self._begin_again()
        stream.take(message)

    def _subscribe(self) -> None:
        self._add(topics.STATUS, msg.SimulatorStatus, self._take_status)
        for vehicle, sensors in self._vehicles.items():
            self._subscribe_vehicle(vehicle, sensors)

    def _subscribe_vehicle(self, vehicle: str, sensors: tuple[SensorDescription, ...]) -> None:
        def on_path(path: msg.Path) -> None:
            self._paths[vehicle] = path.position
            self._logger.log_path(path.position, vehicle=vehicle)

        def on_rotor_speeds(speeds: msg.RotorSpeeds) -> None:
            if len(speeds.speed) == self._rotor_counts[vehicle]:
                self._logger.log_rotor_speeds("odometry", speeds.stamp_ns, speeds.speed, vehicle=vehicle)

        def on_packet(name: str) -> Callable[[Any], None]:
            return lambda message: self._logger.log(to_packet(message, name), vehicle=vehicle)

        def on_command(mode: str) -> Callable[[Any], None]:
            return lambda command: self._take_command(vehicle, mode, command)

        def at(name: str) -> str:
            return topics.stream_topic(vehicle, name)

        add = self._add
        add(at("path"), msg.Path, on_path, vehicle, ordered=False)
        add(at("rotor_speeds"), msg.RotorSpeeds, on_rotor_speeds, vehicle)
        for sensor in sensors:
            kind = message_type(sensor.kind)
            add(at(sensor.name), kind, on_packet(sensor.name), vehicle, sensor=sensor.name)
        add(at("collision"), msg.Collision, on_packet("collision"), vehicle)
        for mode, command in topics.COMMANDS.items():
            topic = topics.command_topic(vehicle, mode)
            add(topic, command, on_command(mode), vehicle, of_simulator=False, ordered=False)
        for link in self._links.get(vehicle, ()):
            self._subscribe_link(vehicle, link)

    def _subscribe_link(self, vehicle: str, link: str) -> None:
        def on_delivery(found: msg.Delivery) -> None:
            delivery = Delivery(
                stamp_ns=found.stamp_ns,
                sequence=found.sequence,
                sensor=f"{link}_link",
                delivered_ns=found.delivered_ns,
                size_bytes=found.size_bytes,
            )
            self._logger.log(delivery, vehicle=vehicle)

        self._add(topics.delivery_topic(vehicle, link), msg.Delivery, on_delivery, vehicle)

    def _add(
        self,
        topic: str,
        message: type[Any],
        take: Callable[[Any], None],
        vehicle: str = "",
        *,
        sensor: str = "",
        of_simulator: bool = True,
        ordered: bool = True,
    ) -> None:
        policy = latest() if message in (msg.Image, msg.Path, msg.SimulatorStatus) else keep_last(QUEUE)
        subscriber = self._node.subscriber(topic, message, policy=policy)
        self._streams.append(_Stream(topic, vehicle, sensor, subscriber, of_simulator, ordered, take))

    def _unsubscribe(self) -> None:
        for stream in self._streams:
            stream.subscriber.close()

    def _take_command(self, vehicle: str, mode: str, command: Any) -> None:
        setpoint = setpoint_of(mode, command)
        if mode == "motor_speeds" and len(setpoint) != self._rotor_counts[vehicle]:
            return  # the simulator refuses it, and says so
        key, newest_ns = f"{vehicle}/{mode}", self._episodes.newest_ns
        stamp_ns = command.stamp_ns
        if not self._command_ns.get(key, -1) < stamp_ns <= newest_ns + _AHEAD_NS:
            stamp_ns = newest_ns  # in streaming nobody needs to stamp commands
        self._command_ns[key] = stamp_ns
        self._logger.log_command(mode, stamp_ns, setpoint, vehicle=vehicle)

    def _take_status(self, status: msg.SimulatorStatus) -> None:
        self.phase = status.phase
        self._statuses.append(status)
        while len(self._statuses) > 2 and status.stamp_ns - self._statuses[1].stamp_ns >= RATE_NS:
            self._statuses.popleft()
        while len(self._statuses) > STATUS_MAX:
            self._statuses.popleft()
        stamp_ns, log = status.stamp_ns, self._logger.log_simulator
        if status.phase == "running":
            timing = {
                "step, median": status.step_median_ns,
                "step, p99": status.step_p99_ns,
                "late, median": status.late_median_ns,
                "late, p99": status.late_p99_ns,
            }
            log("timing", stamp_ns, {name: 1e-6 * value for name, value in timing.items()})
            log("real_time_factor", stamp_ns, {"real-time factor": status.real_time_factor})
        lost = self._lost()
        log(
            "losses",
            stamp_ns,
            {
                "dropped by the simulator": sum(
                    s.dropped_count - s.injected_lost_count for s in status.sensors
                ),
                "lost by links": sum(s.injected_lost_count for s in status.sensors),
                "lost by reliable readers": sum(s.undelivered_count for s in status.sensors)
                + sum(v.undelivered_count for v in status.vehicles),
                "commands lost or refused": sum(v.lost_count + v.refused_count for v in status.vehicles),
                "lost on the way here": sum(lost.values()),
            },
        )
        self._logger.log_status(stamp_ns, status_text(status, self._statuses[0], lost))

    def _lost(self) -> dict[tuple[str, str], int]:
        """Messages that were published and never came, by vehicle and sensor."""
        lost: dict[tuple[str, str], int] = {}
        for stream in self._streams:
            counters = stream.subscriber.counters
            count = counters.lost + (counters.overtaken if stream.subscriber.policy.depth > 1 else 0)
            key = (stream.vehicle, stream.sensor)
            lost[key] = lost.get(key, 0) + count
        return lost


class _Siblings:
    """The publishers of the node that a publisher belongs to, as far as others do not have them."""

    def __init__(self, node: Node, source: int) -> None:
        self._node = node
        self._owners: dict[int, int] = {}
        self._look()
        self._owner = self._owners.get(source)

    def __contains__(self, source: int) -> bool:
        if source not in self._owners:
            self._look()
        owner = self._owners.get(source)  # none: it has left, and nobody can tell
        return owner is None or self._owner is None or owner == self._owner

    def _look(self) -> None:
        """Remember who has which publisher, since those who leave are forgotten by the node."""
        self._owners.update(
            (pub.source, record.node) for record in self._node.nodes() for pub in record.publishers
        )


def _shown(config: SimulationConfig, only: Sequence[str] | None) -> dict[str, tuple[SensorDescription, ...]]:
    """The sensors to show of each vehicle; its odometry, which every vehicle has, is always among them.

    Raises:
        ValueError: `only` names a sensor that no vehicle has.
    """
    rigs = {name: describe_sensors(config.of(name).sensors) for name in config.vehicles}
    known = list(dict.fromkeys(["odometry", *(s.name for rig in rigs.values() for s in rig)]))
    if unknown := [name for name in only or () if name not in known]:
        raise ValueError(f"unknown sensor {unknown[0]!r}, known: {', '.join(known)}")
    odometry = SensorDescription(
        name="odometry",
        kind="odometry",
        rate_hz=config.control.rate_hz,
        position=np.zeros(3),
        orientation=np.array([0.0, 0.0, 0.0, 1.0]),
    )
    return {
        name: (
            odometry,
            *(s for s in rig if s.kind != "odometry" and (only is None or s.name in only)),
        )
        for name, rig in rigs.items()
    }


def _links(config: SimulationConfig) -> dict[str, list[str]]:
    """Links of each vehicle that do something to their messages."""
    links = {
        name: [link for link, settings in config.of(name).links.items() if not settings.delivers_at_once]
        for name in config.vehicles
    }
    return {name: found for name, found in links.items() if found}
