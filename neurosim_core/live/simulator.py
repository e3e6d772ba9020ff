"""The simulator as a node: it flies vehicles for controllers in other processes.

One thread flies, reads commands, publishes and answers requests, in the order of simulated time. In streaming
a second one renders (`streaming.py`).
"""

from __future__ import annotations

import contextlib
import functools
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from cortex import Node
from cortex.messages import Reset, SimulatorStatus
from neurosim_core.clock import to_ns
from neurosim_core.config import SimulationConfig
from neurosim_core.live.commands import Command
from neurosim_core.live.pacing import Pacer
from neurosim_core.live.recorder import Recorder, open_folders
from neurosim_core.live.services import Request, Services, Steps
from neurosim_core.live.status import RunStats, StatusPublisher, SubscriberMonitor
from neurosim_core.live.streaming import CameraThread, StreamingLoop
from neurosim_core.live.vehicle import ResetState, VehicleNode, make_reset, report_touches
from neurosim_core.packets import Packet
from neurosim_core.scene.reader import SceneReader
from neurosim_core.sim import Model, make_fleet, warm_flight, warm_up
from neurosim_core.trajectory import PosesConfig
from neurosim_core.vehicle import DynamicsError

LATE_S = 0.1
"""A wait for a command is reported when it is longer [s]."""
FIRST_STEP_S = 2.0
"""How long steps that begin the run wait for its first command [s]."""
POLL_S = 0.02
"""How often a run that stands looks for something to do [s]."""


class Simulator:
    """Flies the vehicles of a configuration as commanded, and publishes what they measure. A context manager.

    Attributes:
        config: The settings that hold.
        vehicles: The vehicles.
        stamp_ns: Simulated time [ns].
        status: What it publishes of itself.
    """

    def __init__(
        self,
        config: SimulationConfig,
        node: Node | None = None,
        *,
        models: Mapping[str, Model] | None = None,
        record: Path | None = None,
        overwrite: bool = False,
        on_phase: Callable[[str], None] | None = None,
        reader: SceneReader | None = None,
    ) -> None:
        """Prepare everything, and announce topics and services.

        `node`: owner of the topics; by default a new one. `models`: what `make_fleet` returned for the
        configuration, to save its time. `record`: folder to record to. `overwrite`: replace a recording that
        exists. `on_phase`: called with the name of each part of the preparation when it begins. `reader`:
        reads the scene in another process; None: it is read here.

        Raises:
            ValueError: The scene cannot be loaded, no path exists, there is no such device, or nothing can be
                commanded.
            FileExistsError: There is a recording already.
        """
        _require_vehicles(config)
        folders = None
        if record is not None:
            folders = open_folders(record, list(config.vehicles), overwrite=overwrite)
        self.config = config
        if models is None:
            models = make_fleet(config, reader=reader, on_phase=on_phase, meanwhile=warm_flight)
            if on_phase is not None:
                on_phase("kernels (compiled on the first run, then cached)")
            for model in models.values():
                warm_up(model)
        self.stamp_ns = 0
        self._control = next(iter(models.values())).schedule.control
        self._stop = threading.Event()
        self._wakeup = threading.Event()
        """Set when there is something to do before what the loop waits for."""
        self._tick = 0
        self._is_flown = False
        """The control period has been computed, and its end is waited for."""
        self._is_paused = self._is_ended = False
        self._exit: int | None = None
        self._reason = ""
        self._steps = Steps()
        self._touching: set[tuple[str, str]] = set()
        """Pairs of vehicles that touch each other."""
        self._pacer = Pacer(config.live.real_time_factor, sleep=self._wakeup.wait)
        self._is_streaming = config.live.mode == "streaming"
        with contextlib.ExitStack() as stack:
            node = node or stack.enter_context(Node("simulator"))
            services = stack.enter_context(Node("simulator services"))
            self.status = StatusPublisher(node)  # before the commands: by it a second simulator sees this one
            self._recorder = None if folders is None else Recorder(folders, models)
            if self._recorder is not None:
                stack.callback(self._recorder.close)
            self.vehicles = [
                VehicleNode(node, name, model, record=self._record(name)) for name, model in models.items()
            ]
            for vehicle in self.vehicles:
                stack.callback(vehicle.close_loans)
            self._cameras = CameraThread(inline=self.vehicles[0].is_cuda, on_packets=self._wakeup.set)
            stack.callback(self._cameras.close)
            self._stats = RunStats(self.vehicles)
            self._streaming = StreamingLoop(
                vehicles=self.vehicles,
                cameras=self._cameras,
                pacer=self._pacer,
                stats=self._stats,
                live=lambda: self.config.live,
                stop=lambda: self._stop.is_set(),
                requested=lambda: bool(self._services),
                wakeup=self._wakeup,
            )
            for vehicle in self.vehicles if self._is_streaming else ():
                vehicle.publisher.lateness_ns = self._pacer.lateness_ns
            self._subscribers = SubscriberMonitor(self.vehicles, self.status)
            self._begin(make_reset(self.vehicles, config, Reset()))
            self.status.announce(config)
            self._services = Services(
                services,
                node,
                config=lambda: self.config,
                state=lambda: (self.stamp_ns, self.phase),
                on_request=self._wakeup.set,
            )
            stack.callback(self._services.close)
            self._resources = stack.pop_all()

    @property
    def phase(self) -> str:
        """One of "waiting", "running", "paused" and "ended"."""
        if self._is_ended:
            return "ended"
        if self._is_paused and not self._steps:
            return "paused"
        return "waiting" if self._reason or self._tick == 0 else "running"

    @property
    def reason(self) -> str:
        """Why it waits or has ended; empty otherwise."""
        if self.phase == "waiting" and not self._reason:
            return "for the first command"
        return self._reason

    @property
    def is_over(self) -> bool:
        """Whether `run` returns with the end of the flight, or has."""
        return self._exit is not None

    def run(self, stop: threading.Event) -> int:
        """Fly until told to stop; return 1 if the flight ended with an error, else 0.

        `stop`: ends it within a few hundredths of a second, unless a reliable reader holds it up; see
        `Node.stop_waiting`.

        Raises:
            OSError: The recording cannot be written.
            RuntimeError: The cameras failed.
        """
        self._stop = stop
        fly = self._fly_streaming if self._is_streaming else self._fly_lockstep
        while not stop.is_set() and self._exit is None:
            self._answer_requests()
            self._housekeep()
            if self._is_ended or (self._is_paused and not self._steps):
                if self._tick and not self._is_ended:
                    self._streaming.publish_rendered(self.stamp_ns)
                self._wakeup.wait(POLL_S)
                self._wakeup.clear()
            else:
                try:
                    fly()
                except DynamicsError as error:
                    name = next(v.name for v in self.vehicles if v.state.failure is error)
                    self._end(f"the motion of {name} cannot be computed: {error}")
        if not self._is_ended:
            self._flush()
        self._publish_status(at_once=True)
        return self._exit or 0

    def close(self) -> None:
        """Close the recording, answer all clients, and leave the topics.

        Raises:
            OSError, ValueError: The recording cannot be written.
        """
        self._resources.close()

    def __enter__(self) -> Simulator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # A control period

    def _fly_lockstep(self) -> None:
        """Wait for the commands of a control period, fly it, and publish what arrives in it."""
        if not self._receive_commands(every=self.config.live.command_every):
            return
        begin_ns = time.monotonic_ns()
        end_ns = self._control.stamp_ns(self._tick + 1)
        with contextlib.ExitStack() as ends:  # each step that has begun is ended, whatever another one raises
            for vehicle in self.vehicles:  # on a CUDA device, all at the same time
                ends.callback(vehicle.begin_step(self.stamp_ns))
            self._housekeep()  # while the device works
        report_touches(self.vehicles, self._touching)
        self._stats.step_times.add(time.monotonic_ns() - begin_ns)
        self._publish_end(end_ns)
        for vehicle in self.vehicles:
            vehicle.prepare_step()
        self._end_period(end_ns)

    def _fly_streaming(self) -> None:
        """Fly a control period, and publish its packets when they are due."""
        if self._tick == 0 and not self._is_flown and not self._receive_commands(every=1):
            return
        begin_ns = time.monotonic_ns()
        end_ns = self._control.stamp_ns(self._tick + 1)
        if not self._is_flown:
            if not self._streaming.fly(self.stamp_ns, end_ns):
                return
            report_touches(self.vehicles, self._touching)
            self._stats.step_times.add(time.monotonic_ns() - begin_ns)
            self._is_flown = True
        if not self._streaming.publish_until(self.stamp_ns, end_ns):
            return
        self._is_flown = False
        self._take_commands(end_ns)  # before this stamp is published: its answers count from the next tick on
        self._publish_end(end_ns)
        self._streaming.yield_to_readers(self.stamp_ns, end_ns)
        self._end_period(end_ns)

    def _receive_commands(self, *, every: int) -> bool:
        """Take the commands that begin a control period; False if something else has to be done first.

        The first commands of a run begin its time, when the subscribers that came with them are connected;
        with `live.begin: hover` it begins at once.
        """
        first, live = self._tick == 0, self.config.live
        hovers = live.mode == "streaming" and live.begin == "hover"
        for vehicle in () if hovers else self.vehicles:
            if vehicle.awaited_ns is not None and self._tick % every == 0:
                command = self._wait_for_command(vehicle)
                if command is None:
                    return False
                vehicle.obey(command, self.stamp_ns)
        if first:
            self._subscribers.settle(self._stop.wait)
            for vehicle in self.vehicles:
                vehicle.forget_new_publishers()
            self._pacer.start(0)
        return True

    def _take_commands(self, stamp_ns: int) -> None:
        """Send the commands that have arrived by a tick [ns] through their links."""
        for vehicle in self.vehicles:
            command = vehicle.subscriber.poll()
            if command is not None:
                vehicle.obey(command, stamp_ns)

    def _publish_end(self, end_ns: int) -> None:
        """Publish what arrives by the end of a control period [ns]."""
        for vehicle in self.vehicles:
            vehicle.awaited_ns = vehicle.publisher.publish_due(end_ns)

    def _end_period(self, end_ns: int) -> None:
        """Move time on to a tick [ns], and end the run if that was the last."""
        self._tick += 1
        self.stamp_ns = end_ns
        self._stats.step_count += 1
        live = self.config.live
        self.status.publish_clock(end_ns, live, sequence=self._tick - 1)
        if self._steps.is_last:
            self._streaming.catch_up(end_ns)
        self._steps.count()
        collided = next((vehicle for vehicle in self.vehicles if vehicle.state.ended), None)
        if collided is not None:
            self._end(f"{collided.name} collided at {collided.state.stamp_ns / 1e9:.3f} s")
        elif not live.run_on and end_ns >= to_ns(self.config.duration_s):
            self._end(f"the {self.config.duration_s:g} s are over")

    # Waiting

    def _wait_for_command(self, vehicle: VehicleNode) -> Command | None:
        """Wait for the command of a control period; None if something else has to be done first."""
        live = self.config.live
        begin_s = time.monotonic()
        limited = live.mode == "lockstep" and self._tick > 0
        deadline_s = begin_s + live.command_deadline_s if limited else None

        def wake() -> bool:
            waited_s = time.monotonic() - begin_s
            if limited and waited_s > LATE_S:
                self._reason = f"for the command of {vehicle.name} that answers {vehicle.awaited_ns} ns"
            self._housekeep()
            vehicle.repeat_state()
            if self._tick == 0 and self._steps and waited_s > FIRST_STEP_S:
                self._steps.stop(f"no command for {vehicle.name} has come yet: time begins with the first")
                return True
            return self._stop.is_set() or bool(self._services)

        command = vehicle.subscriber.wait(vehicle.accepts, deadline_s=deadline_s, wake=wake)
        self._reason = ""
        if command is None and deadline_s is not None and time.monotonic() >= deadline_s:
            self._end(
                f"no command for {vehicle.name} within live.command_deadline_s = {live.command_deadline_s:g} "
                f"s at control period {self._tick}: {vehicle.describe_missing_command()}"
            )
            self._exit = 1
        return command

    def _housekeep(self) -> None:
        """Count subscribers and publish a status, if it is time."""
        self._subscribers.update()
        self._publish_status()

    def _publish_status(self, *, at_once: bool = False) -> None:
        self.status.publish_status(self.phase, self._make_status, at_once=at_once)

    def _make_status(self) -> SimulatorStatus:
        return self._stats.make_status(
            self.config.live,
            self._cameras.dropped,
            stamp_ns=self.stamp_ns,
            phase=self.phase,
            reason=self.reason,
        )

    # Beginning and end

    def _begin(self, reset: ResetState) -> None:
        """Begin a run at stamp 0, and publish where the vehicles are."""
        self._cameras.reset()
        if self._recorder is not None:
            self._recorder.begin(reset.seeds, replace=self._tick == 0)
        self._tick = self.stamp_ns = 0
        self._is_flown = self._is_ended = False
        self._reason = ""
        self._stats.reset()
        self._touching.clear()
        for vehicle in self.vehicles:
            vehicle.begin(reset.states[vehicle.name], seed=reset.seeds[vehicle.name])

    def _end(self, reason: str) -> None:
        """End the run; the simulator goes on if `live.run_on` says so."""
        self._is_ended, self._reason = True, reason
        self._steps.stop(f"the run has ended: {reason}")
        self._cameras.finish(self._stop.is_set)
        self._flush()
        if not self.config.live.run_on:
            self._exit = 0

    def _flush(self) -> None:
        """Publish what is known, including the events of windows that have not ended.

        What is not rendered yet is dropped and counted.
        """
        at_rest = self._cameras.drop_rest()
        self._streaming.offer_rendered()
        for vehicle in self.vehicles:
            if at_rest:
                vehicle.finish()
            vehicle.publisher.publish_due(max(self.stamp_ns, vehicle.state.stamp_ns))

    def _record(self, vehicle: str) -> Callable[[Packet], None] | None:
        return None if self._recorder is None else functools.partial(self._recorder.write, vehicle)

    # Requests

    def _answer_requests(self) -> None:
        self._steps.check()
        while (request := self._services.take()) is not None:
            if request.service == "/step":
                self._start_steps(request)
            elif request.service == "/reset":
                request.answer(self._reset(request.message))
            elif request.service == "/set_parameters":
                assert request.config is not None
                self._configure(request.config)
                request.answer()
            else:
                self._pause(paused=request.service == "/pause")
                request.answer()

    def _reset(self, request: Reset) -> str:
        """Begin again; return why not, empty if it was done."""
        try:
            reset = make_reset(self.vehicles, self.config, request)
        except ValueError as error:
            return str(error)
        self._steps.stop("the run was reset")
        self._begin(reset)
        return ""

    def _pause(self, *, paused: bool) -> None:
        """Stop time, or let it go on."""
        if paused and not self._is_ended and self._tick:
            self._streaming.catch_up(self.stamp_ns)
        self._steps.stop("paused" if paused else "resumed")
        if self._is_paused and not paused:
            self._resume()
        self._is_paused = paused

    def _start_steps(self, request: Request) -> None:
        """Let a paused run go on for some control periods."""
        if self._is_ended:
            request.answer(f"the run has ended: {self._reason}")
        elif not self._is_paused:
            request.answer("it is not paused: call /pause first")
        else:
            self._resume()
            self._steps.start(request)

    def _resume(self) -> None:
        """Let a paused run go on, with the commands that came meanwhile."""
        self._pacer.start(self.stamp_ns)
        if self._is_streaming and self._tick:
            self._take_commands(self.stamp_ns)

    def _configure(self, config: SimulationConfig) -> None:
        """Change settings."""
        if config.live.real_time_factor != self.config.live.real_time_factor:
            self._pacer.set_factor(config.live.real_time_factor)
        if config.bodies != self.config.bodies:
            self._cameras.finish(self._stop.is_set)
        self.config = config
        for vehicle in self.vehicles:
            vehicle.configure(config.of(vehicle.name))
        if self._recorder is not None:
            self._recorder.change(config, stamp_ns=self.stamp_ns)
        self.status.announce(config)


def _require_vehicles(config: SimulationConfig) -> None:
    """Refuse a rig that follows a file: controllers would wait for something to command."""
    for name in config.vehicles:
        if isinstance(config.of(name).path, PosesConfig):
            raise ValueError(
                f"vehicle {name!r} follows path.kind poses and takes no commands: `neurosim run` plays it"
            )
