"""One simulator in Rerun: the topics that are subscribed to, and what is logged of their messages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import yaml

from cortex import Closed, Node, Subscriber, TypeMismatch, keep_last, latest
from cortex import messages as msg
from neurosim_core.config import SimulationConfig, load_config
from neurosim_core.live import topics
from neurosim_core.live.call import SensorRates, describe_status
from neurosim_core.live.messages import message_type, setpoint_of, to_packet
from neurosim_core.record.header import SensorDescription, describe_sensors
from neurosim_core.scene.bodies import make_bodies
from neurosim_core.sensors.odometry import OdometrySensorConfig
from neurosim_core.view.rerun_log import RerunLogger
from neurosim_core.view.rerun_sdk import RerunFiles
from neurosim_core.view.rerun_shapes import SceneShapes, scene_shapes
from neurosim_core.view.rerun_viewer import RerunViewer

DRAIN_MAX = 1000
"""Messages of one stream that are taken before those of the next."""
QUEUE = 4096
_AHEAD_NS = 1_000_000_000
"""Commands may be stamped so far ahead [ns]."""
_PAST_NS = 100_000_000
_SETTLED_NS = 1_000_000_000


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """Options of a viewer."""

    only: Sequence[str] | None = None
    """Sensors to show; None: all."""
    event_window_ns: int = 20_000_000
    """Length of the event window in one picture [ns]."""
    image_rate_hz: float = 15.0
    """Largest image rate of a sensor, by the wall clock [Hz]."""


class RunTracker:
    """Tells to which run a message belongs, from stamps and sequences alone.

    A stream whose stamp or sequence goes back has begun again; the first one to do so begins a new run.
    During the first second of that run, streams that have not gone back and are 0.1 s ahead still deliver the
    run before.

    Attributes:
        newest_ns: Newest stamp of the present run [ns].
    """

    def __init__(self) -> None:
        self.newest_ns = 0
        self._run = 0
        self._last: dict[str, tuple[int, int, int]] = {}

    def run_of(self, stream: str, stamp_ns: int, sequence: int) -> Literal["present", "next", "past"]:
        """Return the run of a message; "next" begins a run, which is the present one from then on."""
        first = (max(self._run - 1, 0), stamp_ns, sequence)
        run, last_ns, last_sequence = self._last.get(stream, first)
        found: Literal["present", "next", "past"] = "present"
        if stamp_ns < last_ns or sequence < last_sequence:
            if run == self._run:
                found = "next"
                self._run += 1
                self.newest_ns = stamp_ns
            run = self._run
        elif run < self._run:
            if self.newest_ns >= _SETTLED_NS:
                run = self._run
            elif stamp_ns > self.newest_ns + _PAST_NS:
                found = "past"
        self._last[stream] = (run, stamp_ns, sequence)
        if found != "past":
            self.newest_ns = max(self.newest_ns, stamp_ns)
        return found


class _Stream(NamedTuple):
    """One subscription."""

    subscriber: Subscriber[Any]
    vehicle: str
    """Empty: of the simulator."""
    sensor: str
    """Empty: not of a sensor."""
    is_ordered: bool
    """Whether its stamps tell that a run has begun again."""
    log: Callable[[Any], None]


class LiveSession:
    """Shows one simulator, from its announcement to its end. A context manager that closes the recording.

    Attributes:
        phase: As in the last status; empty before the first one.
        sensors: Names of the sensors shown, by vehicle.
    """

    def __init__(
        self,
        node: Node,
        simulation: msg.Simulation,
        target: RerunViewer | RerunFiles,
        options: ViewOptions,
        *,
        number: Iterator[int],
        say: Callable[[str], None],
    ) -> None:
        """Subscribe, and open a recording.

        `say`: called with what a user should know.
        """
        config = load_config(yaml.safe_load(simulation.config))
        self._vehicles = _shown(config, options.only)
        self.sensors = {name: [s.name for s in sensors] for name, sensors in self._vehicles.items()}
        self.phase = ""
        self._rotor_counts = {n: config.of(n).vehicle.airframe().rotor_count for n in config.vehicles}
        self._node = node
        self._target = target
        self._number = number
        self._options = options
        self._say = say
        self._shapes = _load_scene(config, say)
        self._paths: dict[str, Any] = {}
        self._command_ns: dict[str, int] = {}
        self._tracker = RunTracker()
        self._rates = SensorRates()
        self._streams: list[_Stream] = []
        self._logger = self._open()
        self._subscribe("", topics.STATUS, msg.SimulatorStatus, self._log_status)
        for vehicle in self._vehicles:
            self._subscribe_vehicle(vehicle, config.of(vehicle))

    def read(self) -> None:
        """Take the messages that have arrived, and log them."""
        for stream in self._streams:
            for _ in range(DRAIN_MAX):
                try:
                    message = stream.subscriber.recv(0.0)
                except (TimeoutError, Closed):
                    break
                except TypeMismatch as error:
                    self._say(f"{stream.subscriber.topic} is of another type:\n{error}")
                    continue
                if stream.is_ordered:
                    topic = stream.subscriber.topic
                    run = self._tracker.run_of(topic, message.stamp_ns, message.sequence)
                    if run == "past":
                        continue
                    if run == "next":
                        self._begin_again()
                stream.log(message)

    def send(self) -> None:
        """Send what has been logged."""
        self._logger.send()

    def __enter__(self) -> LiveSession:
        return self

    def __exit__(self, *_: object) -> None:
        for stream in self._streams:
            stream.subscriber.close()
        self._target.close_recording(self._logger)

    def _open(self) -> RerunLogger:
        number = next(self._number)
        logger = RerunLogger(
            self._target.open(f"flight {number}"),
            vehicles=self._vehicles,
            scene=self._shapes,
            event_window_ns=self._options.event_window_ns,
            image_rate_max_hz=self._options.image_rate_hz,
            compress=self._target.compress,
            live=True,
            keep_layout=number > 1,
        )
        for vehicle, position in self._paths.items():
            logger.log_path(position, vehicle=vehicle)
        return logger

    def _begin_again(self) -> None:
        self._command_ns.clear()
        self._rates = SensorRates()
        self._target.close_recording(self._logger)
        self._logger = self._open()
        self._say("the simulator has begun again: a new recording")

    def _subscribe_vehicle(self, vehicle: str, config: SimulationConfig) -> None:
        def at(name: str) -> str:
            return topics.stream_topic(vehicle, name)

        subscribe = partial(self._subscribe, vehicle)
        subscribe(at("path"), msg.Path, partial(self._log_path, vehicle), is_ordered=False)
        subscribe(at("rotor_speeds"), msg.RotorSpeeds, partial(self._log_rotor_speeds, vehicle))
        for sensor in self._vehicles[vehicle]:
            log = partial(self._log_packet, vehicle, sensor.name)
            own = config.sensors.get(sensor.name)  # None: odometry, which is there without
            message = msg.Odometry if own is None else message_type(own.packet_class)
            subscribe(at(sensor.name), message, log, sensor=sensor.name)
        subscribe(at("collision"), msg.Collision, partial(self._log_packet, vehicle, "collision"))
        for field in ("depth", "flow"):
            log = partial(self._log_packet, vehicle, f"predicted_{field}")
            subscribe(at(f"predicted/{field}"), msg.Image, log)
        for mode, command in topics.COMMANDS.items():
            log = partial(self._log_command, vehicle, mode)
            subscribe(topics.command_topic(vehicle, mode), command, log, is_ordered=False)
        for link in dict.fromkeys(["command", *config.sensors, "odometry", "rotor_speeds"]):
            log = partial(self._log_packet, vehicle, f"{link}_link")
            subscribe(at(f"{link}/delivery"), msg.Delivery, log)

    def _subscribe(
        self,
        vehicle: str,
        topic: str,
        message: type[Any],
        log: Callable[[Any], None],
        *,
        sensor: str = "",
        is_ordered: bool = True,
    ) -> None:
        policy = latest() if message in (msg.Image, msg.Path, msg.SimulatorStatus) else keep_last(QUEUE)
        subscriber = self._node.subscriber(topic, message, policy=policy)
        self._streams.append(_Stream(subscriber, vehicle, sensor, is_ordered, log))

    def _log_path(self, vehicle: str, path: msg.Path) -> None:
        self._paths[vehicle] = path.position
        self._logger.log_path(path.position, vehicle=vehicle)

    def _log_rotor_speeds(self, vehicle: str, speeds: msg.RotorSpeeds) -> None:
        if len(speeds.speed) == self._rotor_counts[vehicle]:
            self._logger.log_rotor_speeds("odometry", speeds.stamp_ns, speeds.speed, vehicle=vehicle)

    def _log_packet(self, vehicle: str, sensor: str, message: Any) -> None:
        packet = to_packet(message, sensor)
        try:
            self._logger.log(packet, vehicle=vehicle)
        except ValueError as error:  # of a sensor that Rerun has no picture of
            self._say(f"{vehicle}/{sensor} is not shown: {error}")
            stream = next(s for s in self._streams if (s.vehicle, s.sensor) == (vehicle, sensor))
            self._streams = [other for other in self._streams if other is not stream]
            stream.subscriber.close()

    def _log_command(self, vehicle: str, mode: str, command: Any) -> None:
        setpoint = setpoint_of(mode, command)
        if mode == "motor_speeds" and len(setpoint) != self._rotor_counts[vehicle]:
            return  # the simulator refuses it, and says so
        key, newest_ns = f"{vehicle}/{mode}", self._tracker.newest_ns
        stamp_ns = command.stamp_ns
        if not self._command_ns.get(key, -1) < stamp_ns <= newest_ns + _AHEAD_NS:
            stamp_ns = newest_ns  # in streaming commands need no stamp
        self._command_ns[key] = stamp_ns
        self._logger.log_command(mode, stamp_ns, setpoint, vehicle=vehicle)

    def _log_status(self, status: msg.SimulatorStatus) -> None:
        self.phase = status.phase
        stamp_ns, log = status.stamp_ns, self._logger.log_values
        if status.phase == "running":
            times = ("step_median_ns", "step_p99_ns", "late_median_ns", "late_p99_ns")
            names = (name.removesuffix("_ns").replace("_", ", ") for name in times)
            milliseconds = {n: 1e-6 * getattr(status, t) for n, t in zip(names, times, strict=True)}
            log("simulator/timing", stamp_ns, milliseconds)
            log("simulator/real_time_factor", stamp_ns, {"real-time factor": status.real_time_factor})
        lost = self._lost()
        by_links = sum(sensor.injected_lost_count for sensor in status.sensors)
        losses = {
            "dropped by the simulator": sum(sensor.dropped_count for sensor in status.sensors) - by_links,
            "lost by links": by_links,
            "lost by reliable readers": sum(
                [s.undelivered_count for s in status.sensors] + [v.undelivered_count for v in status.vehicles]
            ),
            "commands lost or refused": sum(v.lost_count + v.refused_count for v in status.vehicles),
            "lost on the way here": sum(lost.values()),
        }
        log("simulator/losses", stamp_ns, losses)
        text = describe_status(status, rates_hz=self._rates.update(status), lost=lost)
        self._logger.log_status(stamp_ns, text)

    def _lost(self) -> Counter[tuple[str, str]]:
        """Return the messages that were published and not received, by vehicle and sensor."""
        lost: Counter[tuple[str, str]] = Counter()
        for stream in self._streams:
            counters = stream.subscriber.counters
            overtaken = counters.overtaken if stream.subscriber.policy.depth > 1 else 0
            lost[stream.vehicle, stream.sensor] += counters.lost + overtaken
        return lost


def _load_scene(config: SimulationConfig, say: Callable[[str], None]) -> SceneShapes | None:
    """Return the scene; None if it cannot be loaded, which is said."""
    try:
        return scene_shapes(config.scene.load(), make_bodies(config.bodies))
    except (ValueError, OSError) as error:
        say(f"warning: shown without the scene: {error}")
        return None


def _shown(config: SimulationConfig, only: Sequence[str] | None) -> dict[str, tuple[SensorDescription, ...]]:
    """Return the sensors to show of each vehicle; odometry, which each vehicle publishes, is always shown."""
    sensors = {name: describe_sensors(config.of(name).sensors) for name in config.vehicles}
    known = list(dict.fromkeys(["odometry", *(s.name for own in sensors.values() for s in own)]))
    if unknown := [name for name in only or () if name not in known]:
        raise ValueError(f"unknown sensor {unknown[0]!r}, known: {', '.join(known)}")
    odometry, *_ = describe_sensors({"odometry": OdometrySensorConfig(rate_hz=config.control.rate_hz)})
    shown = known if only is None else only
    return {
        name: (odometry, *(s for s in own if s.name != odometry.name and s.name in shown))
        for name, own in sensors.items()
    }
