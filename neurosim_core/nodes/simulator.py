"""`neurosim serve`: the simulator as a node, which flies for controllers in other processes.

One thread flies, reads commands, publishes and answers requests, in the order of simulated time; in streaming
on a CPU another one renders (`cameras.py`), and a third writes the recording (`recorder.py`).
"""

from __future__ import annotations

import contextlib
import functools
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType

from rich.console import Console

from cortex import Node
from cortex.messages import Clock, Reset, Simulation, SimulatorStatus, Step
from neurosim_core import __version__
from neurosim_core.clock import to_ns
from neurosim_core.config import SimulationConfig, to_yaml
from neurosim_core.nodes import topics
from neurosim_core.nodes.cameras import Cameras, sees_inline
from neurosim_core.nodes.console import StatusLine, print_end, print_plan, stop_at_signals
from neurosim_core.nodes.craft import Craft
from neurosim_core.nodes.helm import Command
from neurosim_core.nodes.meetings import Meetings
from neurosim_core.nodes.recorder import Recorder, open_folders
from neurosim_core.nodes.requests import Request, Requests
from neurosim_core.nodes.status import Meter
from neurosim_core.pacing import Pacer
from neurosim_core.packets import Packet
from neurosim_core.simulation import Model, StartState, State, make_fleet
from neurosim_core.vehicle import DynamicsError

STATUS_INTERVAL_S = 0.2
LOOK_INTERVAL_S = 0.005
"""How often it is looked who listens, at most [s]."""
SETTLE_S = 0.1
"""For so long nobody must have come or gone before time begins [s]."""
SETTLE_MAX_S = 2.0
LATE_S = 0.1
"""A command that takes longer than this is said to be waited for [s]."""
HICCUP_NS = 10_000_000
"""The machine may be this late, or a control period if that is longer, and catch up [ns]."""
BEHIND_MAX_NS = 500_000_000
"""How far the machine may be behind where camera frames give way [ns]."""


class Simulator:
    """Flies the vehicles of a configuration as others command, and publishes what they measure.

    A context manager. All methods but `run` and `close` are its own.

    Attributes:
        config: Settings that hold now.
        crafts: The vehicles.
        stamp_ns: Simulated time [ns].
        on_status: Called with every status, about five times a second; None: nobody wants to know.
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
    ) -> None:
        """Prepare everything, and announce topics and services.

        Args:
            config: What to fly, and how.
            node: Whose the topics are; by default one of its own.
            models: What `make_fleet` gives for the configuration, if it has been made already.
            record: Folder to record to.
            overwrite: Replace a recording that is there.
            on_phase: Told the name of each part of the preparation when it begins.

        Raises:
            ValueError: The scene cannot be loaded, no path exists, or the device is not there.
            FileExistsError: There is a recording already.
        """
        folders = None
        if record is not None:
            folders = open_folders(record, list(config.vehicles), overwrite=overwrite)
        self.config = config
        models = make_fleet(config, on_phase=on_phase) if models is None else models
        if on_phase is not None:
            on_phase("kernels (compiled on the first run, then cached)")
        self.stamp_ns = 0
        self.on_status: Callable[[SimulatorStatus], None] | None = None
        self._control = next(iter(models.values())).schedule.control
        self._stop = threading.Event()
        self._bell = threading.Event()
        """Rung when the loop has something to do before what it waits for."""
        self._tick = 0
        self._paused = False
        self._ended = False
        self._exit: int | None = None
        self._reason = ""
        self._stepping: Request | None = None
        self._steps_left = 0
        self._listeners: tuple[int, ...] = ()
        self._changed_s = self._looked_s = self._told_s = 0.0
        self._told_phase = ""
        self._meter = Meter()
        self._meetings = Meetings()
        self._pacer = Pacer(config.live.real_time_factor, sleep=self._bell.wait)
        with contextlib.ExitStack() as stack:
            node = node or stack.enter_context(Node("simulator"))
            services = stack.enter_context(Node("simulator services"))
            self._recorder = None if folders is None else Recorder(folders, models)
            if self._recorder is not None:
                stack.callback(self._recorder.close)
            self.crafts = [
                Craft(node, name, model, record=self._record(name)) for name, model in models.items()
            ]
            device = next(iter(models.values())).device
            inline = config.live.mode == "lockstep" or sees_inline(device)
            self._cameras = Cameras(inline=inline, on_packets=self._bell.set)
            stack.callback(self._cameras.close)
            self._clock = node.publisher(topics.CLOCK, Clock)
            self._status = node.publisher(topics.STATUS, SimulatorStatus)
            self._simulation = node.publisher(topics.SIMULATION, Simulation, latch=True)
            self._begin({craft.name: craft.state for craft in self.crafts}, self._seeds(None))
            self._simulation.publish(
                Simulation(
                    config=to_yaml(config),
                    version=__version__,
                    vehicles=list(models),
                    mode=config.live.mode,
                    control_rate_hz=config.control.rate_hz,
                )
            )
            self._requests = Requests(
                services,
                node,
                config=lambda: self.config,
                state=lambda: (self.stamp_ns, self.phase),
                on_request=self._bell.set,
            )
            stack.callback(self._requests.close)
            self._resources = stack.pop_all()

    @property
    def phase(self) -> str:
        """What it does: "waiting", "running", "paused" or "ended"."""
        if self._ended:
            return "ended"
        if self._paused and not self._steps_left:
            return "paused"
        return "waiting" if self._reason or self._tick == 0 else "running"

    @property
    def reason(self) -> str:
        """Why it waits or has ended; empty if there is nothing to say."""
        if self.phase == "waiting" and not self._reason:
            return "for the first command"
        return self._reason

    def run(self, stop: threading.Event) -> int:
        """Fly until told to stop.

        Args:
            stop: Ends it within a few hundredths of a second.

        Returns:
            0 if it was stopped or the flight is over, 1 if the flight ended with an error.

        Raises:
            OSError: The recording cannot be written.
            RuntimeError: The cameras failed.
        """
        self._stop = stop
        while not stop.is_set() and self._exit is None:
            self._answer_requests()
            self._look()
            self._tell()
            if self._ended or (self._paused and not self._steps_left):
                self._bell.wait(0.02)
                self._bell.clear()
            elif self._receive():
                self._fly()
        if not self._ended:
            self._cameras.clear()
            self._flush()
        self._tell(at_once=True)
        return self._exit or 0

    def close(self) -> None:
        """Close the recording, answer whoever waits, and leave the topics.

        Raises:
            OSError, ValueError: The recording cannot be written.
        """
        self._resources.close()

    def __enter__(self) -> Simulator:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # A control period

    def _receive(self) -> bool:
        """Take in the commands of a control period; False if something else has to be done first.

        The first commands of a run begin its time, once those who came with them are connected.
        """
        live, first = self.config.live, self._tick == 0
        for craft in self.crafts:
            if live.mode == "streaming" and not first:
                command = craft.inbox.poll()
                if command is not None:
                    craft.obey(command, self.stamp_ns)
            elif craft.answers_ns is not None and self._tick % live.command_every == 0:
                command = self._wait_for_command(craft, craft.answers_ns)
                if command is None:
                    return False
                craft.obey(command, self.stamp_ns)
        if first:
            self._settle()
            self._pacer.start(0)
        return True

    def _fly(self) -> None:
        """Fly a control period, and publish what arrives in it."""
        begin_ns = time.monotonic_ns()
        end_ns = self._control.stamp_ns(self._tick + 1)
        try:
            if self.config.live.mode == "lockstep":
                for craft in self.crafts:
                    craft.step(self.stamp_ns)
            else:
                self._fly_ahead()
        except DynamicsError as error:
            self._end(f"the motion of {self._culprit(error)} cannot be computed: {error}")
            return
        self._meetings.check(self.crafts)
        self._meter.step_times.add(time.monotonic_ns() - begin_ns)
        if self.config.live.mode == "streaming" and not self._publish_on_time(end_ns):
            return
        for craft in self.crafts:
            newest_ns = craft.outlet.publish_due(end_ns)
            craft.answers_ns = newest_ns
        self._end_period(end_ns)

    def _fly_ahead(self) -> None:
        """Fly a control period and leave the cameras to their thread."""
        drop = self.config.live.overrun == "drop" and self._pacer.factor > 0.0
        for craft in self.crafts:
            if drop:
                self._cameras.leave_out(self.stamp_ns - craft.lanes.lag_ns)
            self._cameras.wait_for_room(craft.state, craft.lanes.batch_count, self._stop.is_set)
            self._cameras.look(craft.name, craft.model, craft.state, craft.fly(self.stamp_ns))

    def _publish_on_time(self, end_ns: int) -> bool:
        """Publish what arrives in a control period when the wall clock says so, and wait for its end [ns].

        Returns:
            Whether it came to the end.
        """
        late_ns = self._pacer.lateness_ns(end_ns)
        if late_ns > 0:
            self._meter.overrun_count += 1
            wall_ns = self._pacer.wall_ns(end_ns) - self._pacer.wall_ns(self.stamp_ns)
            slow = self.config.live.overrun == "slow"
            if late_ns > (max(wall_ns, HICCUP_NS) if slow else BEHIND_MAX_NS):
                self._meter.slipped_ns += self._pacer.slip(end_ns)
        while not self._stop.is_set():
            self._bell.clear()
            self._offer_seen()
            due_ns = min([end_ns, *(d for c in self.crafts if (d := c.outlet.next_due_ns) is not None)])
            late_ns = self._pacer.wait_until(due_ns, self._is_called)
            if late_ns < 0:
                continue
            if due_ns == end_ns:
                self._meter.late_times.add(late_ns)
                return True
            for craft in self.crafts:
                craft.outlet.publish_due(due_ns)
        return False

    def _end_period(self, end_ns: int) -> None:
        """Move time on to a tick [ns], and see whether that was the last."""
        self._tick += 1
        self.stamp_ns = end_ns
        self._meter.step_count += 1
        live = self.config.live
        self._clock.publish(
            Clock(
                stamp_ns=end_ns,
                wall_ns=time.time_ns(),
                real_time_factor=live.real_time_factor if live.mode == "streaming" else 0.0,
                sequence=self._tick - 1,
            )
        )
        if self._steps_left:
            self._steps_left -= 1
            if not self._steps_left:
                self._stop_stepping()
        ended = next((craft for craft in self.crafts if craft.state.ended), None)
        if ended is not None:
            self._end(f"{ended.name} collided at {ended.state.stamp_ns / 1e9:.3f} s")
        elif not live.run_on and end_ns >= to_ns(self.config.duration_s):
            self._end(f"the {self.config.duration_s:g} s are over")

    # Waiting

    def _wait_for_command(self, craft: Craft, stamp_ns: int) -> Command | None:
        """Wait for the command that the control period needs; None if something else has to be done first."""
        live = self.config.live
        begin_s = time.monotonic()
        limited = live.mode == "lockstep" and self._tick > 0
        deadline_s = begin_s + live.command_deadline_s if limited else None

        def wake() -> bool:
            if limited and time.monotonic() - begin_s > LATE_S:
                self._reason = f"for the command of {craft.name} that answers {stamp_ns} ns"
            self._look()
            self._tell()
            return self._is_called()

        command = craft.inbox.wait(
            functools.partial(craft.answers, lockstep=live.mode == "lockstep"),
            deadline_s=deadline_s,
            wake=wake,
        )
        self._reason = ""
        if command is None and deadline_s is not None and time.monotonic() >= deadline_s:
            self._fail(self._why_no_command(craft, stamp_ns))
        return command

    def _why_no_command(self, craft: Craft, stamp_ns: int) -> str:
        """Say which command did not come, and what did."""
        mode = "any mode" if craft.helm.holds is None else f"mode {craft.helm.holds.mode}"
        count = craft.inbox.publisher_count
        missed = craft.inbox.missed
        other = "" if missed is None else f"; the last other command answered {missed.stamp_ns} ns"
        return (
            f"no command for {craft.name} within {self.config.live.command_deadline_s:g} s: control period "
            f"{self._tick} waits for one of {mode} that answers the odometry of {stamp_ns} ns, and "
            f"{count} publisher(s) of its commands are connected{other}"
        )

    def _settle(self) -> None:
        """Wait until nobody comes or goes any more: who sends the first command may have just subscribed."""
        give_up_s = time.monotonic() + SETTLE_MAX_S
        while not self._stop.is_set() and time.monotonic() < give_up_s:
            self._look(at_once=True)
            left_s = self._changed_s + SETTLE_S - time.monotonic()
            if left_s <= 0.0:
                return
            self._stop.wait(min(left_s, LOOK_INTERVAL_S))

    def _is_called(self) -> bool:
        """Whether something has to be done before what is waited for."""
        return self._stop.is_set() or bool(self._requests) or self._cameras.has_packets

    def _look(self, *, at_once: bool = False) -> None:
        """See who listens."""
        now_s = time.monotonic()
        if not at_once and now_s - self._looked_s < LOOK_INTERVAL_S:
            return
        self._looked_s = now_s
        listeners = tuple(count for craft in self.crafts for count in craft.look())
        if listeners != self._listeners:
            self._listeners, self._changed_s = listeners, now_s

    def _tell(self, *, at_once: bool = False) -> None:
        """Publish the status, if it is time."""
        now_s = time.monotonic()
        phase = self.phase
        if not at_once and phase == self._told_phase and now_s - self._told_s < STATUS_INTERVAL_S:
            return
        self._told_s, self._told_phase = now_s, phase
        if self.on_status is None and not self._status.subscriber_count:
            return
        status = self._meter.status(
            self.crafts,
            self._cameras.dropped,
            self.config,
            stamp_ns=self.stamp_ns,
            phase=phase,
            reason=self.reason,
        )
        self._status.publish(status)
        if self.on_status is not None:
            self.on_status(status)

    # Beginning and end

    def _begin(self, states: Mapping[str, State], seeds: Mapping[str, int]) -> None:
        """Begin a run at stamp 0, and publish where everybody is."""
        self._cameras.clear()
        if self._recorder is not None:
            self._recorder.begin(seeds, replace=self._tick == 0)
        self._tick = self.stamp_ns = 0
        self._ended, self._reason = False, ""
        self._meter.reset()
        self._meetings.reset()
        for craft in self.crafts:
            craft.begin(states[craft.name], seed=seeds[craft.name])

    def _end(self, reason: str) -> None:
        """End the run, but not the simulator, unless that was all there was to do."""
        self._ended, self._reason = True, reason
        self._stop_stepping(f"the run has ended: {reason}")
        self._cameras.finish(self._stop.is_set)
        self._flush()
        if not self.config.live.run_on:
            self._exit = 0

    def _fail(self, reason: str) -> None:
        """End everything, with an error."""
        self._end(reason)
        self._exit = 1

    def _flush(self) -> None:
        """Publish what is known up to now, events of a window that has only begun included."""
        self._offer_seen()
        for craft in self.crafts:
            craft.finish()
            craft.outlet.publish_due(max(self.stamp_ns, craft.state.stamp_ns))

    def _offer_seen(self) -> None:
        """Send on their way what the cameras have seen."""
        for name, packets in self._cameras.take():
            next(craft for craft in self.crafts if craft.name == name).outlet.offer(packets)

    def _culprit(self, error: DynamicsError) -> str:
        return next(craft.name for craft in self.crafts if craft.state.failure is error)

    def _seeds(self, seed: int | None) -> dict[str, int]:
        """Return the seed of each vehicle, for a common one or that of the settings."""
        config = self.config if seed is None else self.config.model_copy(update={"seed": seed})
        return {craft.name: config.of(craft.name).seed for craft in self.crafts}

    def _record(self, vehicle: str) -> Callable[[Packet], None] | None:
        return None if self._recorder is None else functools.partial(self._recorder.write, vehicle)

    # Requests

    def _answer_requests(self) -> None:
        """Do what has been asked for."""
        if self._stepping is not None and self._stepping.abandoned:
            self._stop_stepping("nobody waits for it any more")
        while (request := self._requests.take()) is not None:
            if request.service == "/step":
                self._start_steps(request)
            elif request.service == "/reset":
                request.answer(self._reset(request.message))
            elif request.service == "/set_parameters":
                request.answer(self._change(request.config))
            else:
                self._pause(paused=request.service == "/pause")
                request.answer()

    def _reset(self, message: Reset) -> str:
        """Begin again; return why not, empty if it was done."""
        names = [craft.name for craft in self.crafts]
        start = StartState(
            position=message.position,
            orientation=message.orientation,
            velocity=message.velocity,
            body_rate=message.body_rate,
        )
        moved = start != StartState()
        if message.vehicle and message.vehicle not in names:
            return f"unknown vehicle {message.vehicle!r}, known: {', '.join(names)}"
        if moved and not message.vehicle and len(names) > 1:
            return f"say which vehicle starts elsewhere: one of {', '.join(names)}"
        if message.seed is not None and message.seed < 0:
            return f"seed must be 0 or more, got {message.seed}"
        seeds = self._seeds(message.seed)
        try:
            states = {
                craft.name: craft.make_state(
                    seed=seeds[craft.name],
                    start=start if moved and message.vehicle in ("", craft.name) else None,
                )
                for craft in self.crafts
            }
        except ValueError as error:
            return str(error)
        self._stop_stepping("the run was reset")
        self._begin(states, seeds)
        return ""

    def _pause(self, *, paused: bool) -> None:
        """Stop time, or let it go on."""
        self._stop_stepping("paused" if paused else "resumed")
        if self._paused and not paused:
            self._pacer.start(self.stamp_ns)
        self._paused = paused

    def _start_steps(self, request: Request) -> None:
        """Let a paused run go on for some control periods; the answer comes when they are over."""
        step: Step = request.message
        if self._ended:
            request.answer(f"the run has ended: {self._reason}")
        elif not self._paused:
            request.answer("it is not paused: call /pause first")
        elif not step.count:
            request.answer()
        else:
            self._stepping, self._steps_left = request, step.count
            self._pacer.start(self.stamp_ns)

    def _stop_stepping(self, reason: str = "") -> None:
        """Answer the request for steps, if there is one: they are over, or there is a reason why not."""
        request, self._stepping, self._steps_left = self._stepping, None, 0
        if request is not None:
            request.answer(reason)

    def _change(self, config: SimulationConfig | None) -> str:
        """Change settings; return why not, empty if it was done."""
        assert config is not None
        if config.live.real_time_factor != self.config.live.real_time_factor:
            self._pacer.set_factor(config.live.real_time_factor)
        self.config = config
        for craft in self.crafts:
            craft.configure(config.of(craft.name))
        return ""


def serve(config: SimulationConfig, *, record: Path | None = None, overwrite: bool = False) -> int:
    """Simulate for controllers in other processes until interrupted, and say on the console what goes on.

    Args:
        config: What to fly, and how.
        record: Folder to record to.
        overwrite: Replace a recording that is there.

    Returns:
        The exit status: 0 done, 1 ended with an error, 130 interrupted.

    Raises:
        ValueError: The scene cannot be loaded, no path exists, or the device is not there.
        OSError: There is a recording already, or it cannot be written.
    """
    console = Console()
    stop = threading.Event()
    with stop_at_signals(stop):
        with console.status("preparing") as status:
            simulator = Simulator(
                config,
                record=record,
                overwrite=overwrite,
                on_phase=lambda phase: status.update(f"preparing: {phase}"),
            )
        with simulator:
            print_plan(console, simulator.crafts, config)
            with StatusLine(console) as line:
                simulator.on_status = line.show
                code = simulator.run(stop)
            print_end(console, line.last, record)
    return 130 if stop.is_set() else code
