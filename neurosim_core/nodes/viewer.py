"""`neurosim view`: shows what a running simulator publishes, in Rerun.

It subscribes to every sensor it shows, and so makes the simulator compute it. Of pictures it takes the
newest, of everything else all, and counts what it misses.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import sys
import threading
import time
import webbrowser
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, cast

import numpy as np
import yaml
from rich.console import Console

from cortex import Node, Subscriber, keep_last, latest
from cortex import messages as msg
from cortex.schema import TypeMismatch
from neurosim_core.config import ConfigError, SimulationConfig, load_config
from neurosim_core.nodes import topics
from neurosim_core.nodes.console import stop_at_signals
from neurosim_core.nodes.episodes import Episodes
from neurosim_core.nodes.translate import message_type, setpoint_of, to_packet
from neurosim_core.packets import Delivery
from neurosim_core.record.header import SensorDescription, describe_sensors
from neurosim_core.scene.scene import Scene
from neurosim_core.simulation import load_scene
from neurosim_core.view.rerun_log import RerunLogger
from neurosim_core.view.rerun_sdk import import_rerun, open_recording
from neurosim_core.view.rerun_shapes import SceneShapes, scene_shapes
from neurosim_core.view.rerun_viewer import RerunViewer, ViewerEnded

if TYPE_CHECKING:
    import rerun as rr

Where = Literal["native", "web", "save"]

POLL_S = 0.01
SEND_S = 0.1
"""How often what has been collected is sent to Rerun [s]."""
DRAIN_MAX = 1000
"""Messages of one stream that are taken before the next one has its turn."""
QUEUE = 4096
OVER_S = 0.3
"""How long after the end of a flight its last messages may take [s]."""
CLOSE_S = 0.3
EVENT_WINDOW_MAX_S = 10.0
RATE_NS = 1_000_000_000
"""Rates are taken over as much simulated time [ns], or over as many statuses."""
STATUS_MAX = 50
_AHEAD_NS = 1_000_000_000
_NAME = "flight {}"
_WITHOUT_WINDOW = "`neurosim view --web` serves a page, `neurosim view --save FILE.rrd` writes a file"


class Outlet(Protocol):
    """Where recordings are opened.

    Attributes:
        compress: Whether pictures should be small, rather than there at once.
    """

    compress: bool

    def open(self, name: str) -> rr.RecordingStream:
        """Open a recording of this name."""

    def check(self) -> bool:
        """Return whether there is still somebody who looks; raise if it failed."""

    def close_recording(self, logger: RerunLogger) -> None:
        """Send what is left, and close a recording."""


class ViewerOutlet:
    """Recordings go to a viewer."""

    compress = False

    def __init__(self, viewer: RerunViewer) -> None:
        self._viewer = viewer

    def open(self, name: str) -> rr.RecordingStream:
        """Open a recording; the viewer shows it."""
        return self._viewer.open(name)

    def check(self) -> bool:
        """Return False if the window was closed."""
        self._viewer.check()
        return not self._viewer.ended

    def close_recording(self, logger: RerunLogger) -> None:
        """Close a recording. A viewer that does not take it is not waited for."""
        closing = threading.Thread(target=logger.close, name="close recording", daemon=True)
        closing.start()
        closing.join(CLOSE_S)


class FileOutlet:
    """Each recording is a file: NAME.rrd, and after a reset the first free of NAME-2.rrd, NAME-3.rrd, ..."""

    compress = True

    def __init__(self, path: Path, say: Callable[[str], None]) -> None:
        """Refuse at once what cannot be written.

        Args:
            path: The first file; replaced if it is there.
            say: Told what has been written.

        Raises:
            OSError: There is no such folder.
        """
        if not path.parent.is_dir():
            raise OSError(f"cannot write {path}: there is no folder {path.parent}")
        if path.is_dir():
            raise OSError(f"cannot write {path}: it is a folder")
        self._say = say
        numbered = (path.with_name(f"{path.stem}-{k}{path.suffix}") for k in itertools.count(2))
        self._next = itertools.chain([path], (other for other in numbered if not other.exists()))
        self._path = path

    def open(self, name: str) -> rr.RecordingStream:
        """Open the next file."""
        self._path = next(self._next)
        return open_recording(self._path, name=name, footer=False)

    def check(self) -> bool:
        """Return True: files do not go away."""
        return True

    def close_recording(self, logger: RerunLogger) -> None:
        """Close a file, and say so."""
        logger.close()
        self._say(f"wrote {self._path}")


class _Stream(NamedTuple):
    """One subscription, and what is done with its messages."""

    key: str
    vehicle: str
    """Empty: of the simulator."""
    sensor: str
    """Name of the sensor; empty: it is none."""
    subscriber: Subscriber[Any]
    ordered: bool
    """Whether its stamps tell that a run has begun again."""
    take: Callable[[Any], None]


class Show:
    """Shows one simulator, from its announcement to its end. A context manager that closes the recording."""

    def __init__(
        self,
        node: Node,
        simulation: msg.Simulation,
        outlet: Outlet,
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
        self._outlet = outlet
        self._number = number
        self._window_ns = event_window_ns
        self._image_rate_hz = image_rate_hz
        self._say = say
        self._scene = scene
        self._shapes: SceneShapes | None = None
        self._paths: dict[str, Any] = {}
        self._command_ns: dict[str, int] = {}
        self._links = _links(config)
        self._episodes = Episodes()
        self._statuses: deque[msg.SimulatorStatus] = deque()
        self._streams: list[_Stream] = []
        self.phase = ""
        """As the last status says; empty before the first one."""
        scene.load(config)
        self._logger = self._open()
        self._subscribe()

    @property
    def sensors(self) -> dict[str, list[str]]:
        """Names of the sensors shown, by vehicle."""
        return {name: [s.name for s in sensors] for name, sensors in self._vehicles.items()}

    def read(self) -> None:
        """Take what has come, and log it."""
        for stream in self._streams:
            for _ in range(DRAIN_MAX):
                try:
                    message = stream.subscriber.recv(0.0)
                except TimeoutError:
                    break
                except TypeMismatch as error:
                    self._say(f"{stream.subscriber.topic} is of another type:\n{error}")
                    continue
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
        number = next(self._number)
        logger = RerunLogger(
            self._outlet.open(_NAME.format(number)),
            vehicles=self._vehicles,
            scene=self._shapes,
            event_window_ns=self._window_ns,
            image_rate_max_hz=self._image_rate_hz,
            links=bool(self._links),
            compress=self._outlet.compress,
            live=True,
            keep_layout=number > 1,
        )
        for vehicle, position in self._paths.items():
            logger.log_path(position, vehicle=vehicle)
        return logger

    def _begin_again(self) -> None:
        self._outlet.close_recording(self._logger)
        self._logger = self._open()
        self._command_ns.clear()
        self._statuses.clear()
        self._say("the simulator has begun again: a new recording")

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

        def on_delivery(link: str) -> Callable[[msg.Delivery], None]:
            return lambda found: self._logger.log(
                Delivery(
                    stamp_ns=found.stamp_ns,
                    sequence=found.sequence,
                    sensor=f"{link}_link",
                    delivered_ns=found.delivered_ns,
                    size_bytes=found.size_bytes,
                ),
                vehicle=vehicle,
            )

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
            add(topics.command_topic(vehicle, mode), command, on_command(mode), vehicle, ordered=False)
        for link in self._links.get(vehicle, ()):
            add(topics.delivery_topic(vehicle, link), msg.Delivery, on_delivery(link), vehicle)

    def _add(
        self,
        topic: str,
        message: type[Any],
        take: Callable[[Any], None],
        vehicle: str = "",
        *,
        sensor: str = "",
        ordered: bool = True,
    ) -> None:
        policy = latest() if message in (msg.Image, msg.Path, msg.SimulatorStatus) else keep_last(QUEUE)
        subscriber = self._node.subscriber(topic, message, policy=policy)
        self._streams.append(_Stream(topic, vehicle, sensor, subscriber, ordered, take))

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


def status_text(
    status: msg.SimulatorStatus,
    before: msg.SimulatorStatus,
    lost: dict[tuple[str, str], int],
) -> str:
    """Return a status as Markdown.

    Args:
        status: The newest one.
        before: An earlier one, for rates; may be the same.
        lost: Messages that never came, by vehicle and sensor.
    """
    pace = f"{status.real_time_factor:.2f} x real time"
    if status.real_time_factor_wanted:
        pace += f" (wanted: {status.real_time_factor_wanted:g})"
    lines = [
        f"**{status.phase}**{f': {status.reason}' if status.reason else ''}",
        f"{status.mode}, {status.stamp_ns / 1e9:.2f} s, {pace}",
        f"{status.overrun_count:,} overruns, held back {status.slipped_ns / 1e9:.2f} s",
    ]
    if status.phase == "running":
        lines.append(
            f"step {status.step_median_ns / 1e6:.2f} ms (p99 {status.step_p99_ns / 1e6:.2f}), "
            f"late {status.late_median_ns / 1e6:.2f} ms (p99 {status.late_p99_ns / 1e6:.2f})"
        )
    many = len(status.vehicles) > 1
    for vehicle in status.vehicles:
        mode = vehicle.command_mode or "no command yet"
        doing = (
            f"**fail-safe**, last command {vehicle.command_age_ns / 1e6:.0f} ms ago"
            if vehicle.fail_safe
            else mode
        )
        bad = [
            f"{count:,} {what}"
            for count, what in (
                (vehicle.fail_safe_count, "fail-safes"),
                (vehicle.lost_count, "commands lost"),
                (vehicle.refused_count, "refused"),
                (vehicle.collision_count, "collisions"),
            )
            if count
        ]
        lines.append(f"{vehicle.name}: {', '.join([doing, *bad])}")
    lines = ["  \n".join(lines), "", "| sensor | Hz | dropped | lost here |", "| :-- | --: | --: | --: |"]
    earlier = {(s.vehicle, s.name): s.published_count for s in before.sensors}
    elapsed_s = (status.stamp_ns - before.stamp_ns) / 1e9
    for sensor in status.sensors:
        key = (sensor.vehicle, sensor.name)
        name = f"{sensor.vehicle}/{sensor.name}" if many else sensor.name
        if not sensor.active:
            rate = "off"
        elif elapsed_s > 0.0 and key in earlier:
            rate = f"{max(sensor.published_count - earlier[key], 0) / elapsed_s:.0f}"
        else:
            rate = "-"
        lines.append(f"| {name} | {rate} | {sensor.dropped_count:,} | {lost.get(key, 0):,} |")
    return "\n".join(lines)


class SceneLoader:
    """Loads scenes in a thread, so that the stream is shown meanwhile; each only once."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._settings: Any = None
        self._shapes: SceneShapes | None = None
        self._lock = threading.Lock()

    def load(self, config: SimulationConfig) -> None:
        """Begin to load a scene, unless it is the one that is there."""
        with self._lock:
            if config.scene == self._settings:
                return
            self._settings, self._shapes = config.scene, None
        threading.Thread(target=self._load, args=(config,), name="load scene", daemon=True).start()

    def shapes(self) -> SceneShapes | None:
        """Return the scene; None if it is not there yet, or cannot be had."""
        with self._lock:
            return self._shapes

    def _load(self, config: SimulationConfig) -> None:
        try:
            scene: Scene = load_scene(config.scene)
            shapes = scene_shapes(scene)
        except (ValueError, OSError) as error:
            self._say(f"warning: shown without the scene: {error}")
            return
        with self._lock:
            if config.scene == self._settings:
                self._shapes = shapes


def view(
    *,
    how: str,
    save: Path | None = None,
    only: Sequence[str] | None = None,
    event_window_s: float = 0.02,
    image_rate_hz: float = 15.0,
    port: int = 0,
    open_browser: bool = True,
) -> int:
    """Show what a simulator publishes, until interrupted; wait for it, and for the next one when it is gone.

    Args:
        how: native (a window), web (a page for the browsers of this machine) or save (files).
        save: File to write, with "save"; after a reset NAME-2.rrd, ...
        only: Sensors to show; None: all.
        event_window_s: Time in one picture of events [s].
        image_rate_hz: Most images of a sensor a second, by the wall clock [Hz].
        port: Port of the page; 0: any.
        open_browser: Open the page.

    Returns:
        0 if the flight is over and saved, or the window was closed; 130 if interrupted.

    Raises:
        ValueError: An argument is not what it must be, there is no display, or no such sensor.
        OSError: The file cannot be written, or the port is taken.
        ViewerEnded: The viewer failed.
        ImportError: Rerun is not installed.
    """
    if how not in ("native", "web", "save"):
        raise ValueError(f"unknown way to view {how!r}, known: native, web, save")
    if (how == "save") != (save is not None):
        raise ValueError(f"a file to save to goes with how='save', got {how!r} and {save}")
    if not 1e-4 <= event_window_s <= EVENT_WINDOW_MAX_S:
        raise ValueError(f"the event window must be 0.0001 to {EVENT_WINDOW_MAX_S:g} s, got {event_window_s}")
    if not 0.0 < image_rate_hz <= 1000.0:
        raise ValueError(f"the image rate must be above 0, at most 1000 Hz, got {image_rate_hz}")
    if not 0 <= port <= 65535:
        raise ValueError(f"a port is 0 to 65535, got {port}")
    if how == "native" and _without_display():
        raise ValueError(f"there is no display to open a window on: {_WITHOUT_WINDOW}")
    import_rerun()
    console = Console(highlight=False, soft_wrap=True)
    say = cast(Callable[[str], None], lambda text: console.print(text, markup=False))
    stop = threading.Event()
    with stop_at_signals(stop), contextlib.ExitStack() as stack:
        outlet: Outlet
        if save is not None:
            outlet = FileOutlet(save, say)
        else:
            viewer = stack.enter_context(
                RerunViewer(web=how == "web", port=port, waiting=lambda: not stop.is_set())
            )
            outlet = ViewerOutlet(viewer)
            if how == "web":
                say(f"open {viewer.page_url}")
                if open_browser and not _without_display():
                    webbrowser.open(viewer.page_url)
        node = stack.enter_context(Node("viewer"))
        try:
            return watch(
                node,
                outlet,
                stop=stop,
                say=say,
                only=only,
                event_window_s=event_window_s,
                image_rate_hz=image_rate_hz,
                to_the_end=save is not None,
            )
        except ViewerEnded as error:
            if how == "web":
                raise
            raise ViewerEnded(f"{error}\n{_WITHOUT_WINDOW}") from None


def watch(
    node: Node,
    outlet: Outlet,
    *,
    stop: threading.Event,
    say: Callable[[str], None],
    only: Sequence[str] | None = None,
    event_window_s: float = 0.02,
    image_rate_hz: float = 15.0,
    to_the_end: bool = False,
) -> int:
    """Show one simulator after the other.

    Args:
        node: What to listen through.
        outlet: Where recordings are opened.
        stop: Ends it.
        say: Told what a user should know.
        only: Sensors to show; None: all.
        event_window_s: Time in one picture of events [s].
        image_rate_hz: Most images of a sensor a second, by the wall clock [Hz].
        to_the_end: Return when a simulator has left after the end of its flight.

    Returns:
        As `view`.

    Raises:
        ValueError: There is no such sensor.
        ViewerEnded: The viewer failed.
    """
    announcements = node.subscriber(topics.SIMULATION, msg.Simulation, policy=latest())
    number, scene = itertools.count(1), SceneLoader(say)
    source, send_s, over_s = 0, 0.0, None
    show: Show | None = None
    present = False
    say("waiting for a simulator (neurosim serve)")
    with contextlib.ExitStack() as shown:
        while not stop.wait(POLL_S):
            now_s = time.monotonic()
            if not outlet.check():
                return 0
            found = _announced(announcements, say)
            if found is not None and found[1] != source:
                simulation, source = found
                shown.close()
                show, present = None, True
                try:
                    show = Show(
                        node,
                        simulation,
                        outlet,
                        number=number,
                        only=only,
                        event_window_ns=round(event_window_s * 1e9),
                        image_rate_hz=image_rate_hz,
                        say=say,
                        scene=scene,
                    )
                except ConfigError as error:
                    say(f"cannot read the settings of this simulator (version {simulation.version}): {error}")
                    continue
                shown.enter_context(show)
                names = "; ".join(f"{name}: {', '.join(s)}" for name, s in show.sensors.items())
                say(f"showing {names} ({simulation.mode})")
            if show is None:
                continue
            show.read()
            if now_s >= send_s:
                send_s = now_s + SEND_S
                show.send()
            if present != (present := announcements.publisher_count > 0) and not present:
                say("the simulator is gone; waiting for the next one (neurosim serve)")
            over = to_the_end and not present and show.phase == "ended"
            over_s = (over_s or now_s) if over else None
            if over_s is not None and now_s - over_s >= OVER_S:
                return 0
    return 130


def _announced(
    announcements: Subscriber[msg.Simulation], say: Callable[[str], None]
) -> tuple[msg.Simulation, int] | None:
    """The newest announcement and who sent it; None if there is none."""
    try:
        simulation, info = announcements.recv_with_info(0.0)
    except TimeoutError:
        return None
    except TypeMismatch as error:
        say(f"a simulator of another version, which cannot be shown:\n{error}")
        return None
    return simulation, info.source


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


def _without_display() -> bool:
    return sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
