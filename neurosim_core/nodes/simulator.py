"""`neurosim serve`: the simulator as a node, which flies for controllers in other processes.

One thread flies, reads commands, publishes and answers requests, in the order of simulated time; in streaming
on a CPU another one renders (`cameras.py`), and a third writes the recording (`recorder.py`).
"""

from __future__ import annotations

import contextlib
import functools
import gc
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType

from rich.console import Console

from cortex import Node
from cortex.messages import Reset, SimulatorStatus
from neurosim_core.clock import to_ns
from neurosim_core.config import SimulationConfig
from neurosim_core.nodes.audience import Audience
from neurosim_core.nodes.beginning import Beginning, make_beginning
from neurosim_core.nodes.cameras import Cameras, sees_inline
from neurosim_core.nodes.console import StatusLine, print_end, print_plan
from neurosim_core.nodes.craft import Craft
from neurosim_core.nodes.helm import Command
from neurosim_core.nodes.meetings import Meetings
from neurosim_core.nodes.presence import refuse_second
from neurosim_core.nodes.recorder import Recorder, open_folders
from neurosim_core.nodes.requests import Request, Requests, Steps
from neurosim_core.nodes.status import Board, Meter
from neurosim_core.nodes.streaming import Streaming
from neurosim_core.pacing import Pacer
from neurosim_core.packets import Packet
from neurosim_core.priority import be_punctual
from neurosim_core.signals import stop_at_signals
from neurosim_core.simulation import Begun, Model, make_fleet, warm_up
from neurosim_core.vehicle import DynamicsError

_SWITCH_S = 2e-4
"""How long the thread that renders may keep the interpreter from the one that flies [s], in place of 5 ms."""
LATE_S = 0.1
"""A command that takes longer than this is said to be waited for [s]."""
FIRST_STEP_S = 2.0
"""How long steps that are to begin the run wait for its first command [s]."""


class Simulator:
    """Flies the vehicles of a configuration as others command, and publishes what they measure.

    A context manager. All methods but `run` and `close` are its own.

    Attributes:
        config: Settings that hold now.
        crafts: The vehicles.
        stamp_ns: Simulated time [ns].
        board: What it says of itself.
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
        if models is None:
            models = make_fleet(config, on_phase=on_phase)
            if on_phase is not None:
                on_phase("kernels (compiled on the first run, then cached)")
            for model in models.values():  # else the first pictures would hold up time
                warm_up(model)
        self.stamp_ns = 0
        self._control = next(iter(models.values())).schedule.control
        self._stop = threading.Event()
        self._bell = threading.Event()
        """Rung when the loop has something to do before what it waits for."""
        self._tick = 0
        self._flown = False
        """The control period has been computed, and its end is waited for."""
        self._paused = False
        self._ended = False
        self._exit: int | None = None
        self._reason = ""
        self._steps = Steps()
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
            stack.callback(self._drop_loans)
            device = next(iter(models.values())).device
            inline = config.live.mode == "lockstep" or sees_inline(device)
            self._cameras = Cameras(inline=inline, on_packets=self._bell.set)
            stack.callback(self._cameras.close)
            self.board = Board(node)
            self._audience = Audience(self.crafts, self.board)
            self._streaming = Streaming(self.crafts, self._cameras, self._pacer, self._meter, bell=self._bell)
            self._begin(make_beginning(self.crafts, config, Reset()))
            self.board.announce(config)
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
        if self._paused and not self._steps:
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
            stop: Ends it within a few hundredths of a second, if no reliable reader is waited for then; see
                `Node.stop_waiting`.

        Returns:
            0 if it was stopped or the flight is over, 1 if the flight ended with an error.

        Raises:
            OSError: The recording cannot be written.
            RuntimeError: The cameras failed.
        """
        self._stop = stop
        if self._recorder is not None:
            self._recorder.stop = stop
        try:
            while not stop.is_set() and self._exit is None:
                self._answer_requests()
                self._mind()
                if self._ended or (self._paused and not self._steps):
                    if self._tick and not self._ended:
                        self._streaming.publish_seen(self.stamp_ns)
                    self._bell.wait(0.02)
                    self._bell.clear()
                elif self._receive():
                    self._fly()
        finally:
            self._streaming.take_usual_turns()
        if not self._ended:
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

        The first commands of a run begin its time, once those who came with them are connected; with
        `live.begin: hover` it begins at once.
        """
        live, first = self.config.live, self._tick == 0
        if live.mode == "streaming" and (self._flown or not first):
            return True  # taken in at the end of the period before
        hovers = live.mode == "streaming" and live.begin == "hover"
        for craft in () if hovers else self.crafts:
            if craft.answers_ns is not None and self._tick % live.command_every == 0:
                command = self._wait_for_command(craft)
                if command is None:
                    return False
                craft.obey(command, self.stamp_ns)
        if first:
            self._audience.settle(self._stop)
            for craft in self.crafts:
                craft.has_newcomer = False
            self._pacer.start(0)
        return True

    def _fly(self) -> None:
        """Fly a control period, and publish what arrives in it."""
        begin_ns = time.monotonic_ns()
        end_ns = self._control.stamp_ns(self._tick + 1)
        live = self.config.live
        streaming = live.mode == "streaming"
        try:
            if not streaming:
                self._step()
            elif not self._flown and not self._streaming.fly(self.stamp_ns, live, self._stop.is_set):
                return
        except DynamicsError as error:
            self._end(f"the motion of {self._culprit(error)} cannot be computed: {error}")
            return
        if not self._flown:
            self._meetings.check(self.crafts)
            self._meter.step_times.add(time.monotonic_ns() - begin_ns)
        self._flown = streaming
        if streaming and not self._wait_for_end(end_ns):
            return
        self._flown = False
        if streaming:  # before anything of this stamp goes out: an answer to it counts from the next tick on
            self._take_commands(end_ns)
        for craft in self.crafts:
            craft.answers_ns = craft.outlet.publish_due(end_ns)
        if streaming:
            self._streaming.let_readers_go_first(end_ns, end_ns - self.stamp_ns)
        else:
            for craft in self.crafts:
                craft.get_ready()
        self._end_period(end_ns)

    def _step(self) -> None:
        """Fly a control period in lockstep; on a CUDA device, all vehicles at the same time."""
        begun: list[tuple[Craft, Begun]] = []
        try:
            for craft in self.crafts:
                begun.append((craft, craft.begin_step(self.stamp_ns)))
            self._mind()  # while the device is at work
        finally:
            errors = []
            for craft, step in begun:  # all of them, whatever one of them raises
                try:
                    craft.end_step(step)
                except Exception as error:
                    errors.append(error)
            if errors:
                raise errors[0]

    def _wait_for_end(self, end_ns: int) -> bool:
        """Publish until the end of a control period [ns]; False if something else has to be done first."""
        period_ns = end_ns - self.stamp_ns
        stop, called = self._stop.is_set, self._requests.__bool__
        return self._streaming.publish_until(end_ns, period_ns, self.config.live, stop, called=called)

    def _take_commands(self, stamp_ns: int) -> None:
        """Send what has arrived by a tick [ns] on its way."""
        for craft in self.crafts:
            command = craft.inbox.poll()
            if command is not None:
                craft.obey(command, stamp_ns)

    def _end_period(self, end_ns: int) -> None:
        """Move time on to a tick [ns], and see whether that was the last."""
        self._tick += 1
        self.stamp_ns = end_ns
        self._meter.step_count += 1
        live = self.config.live
        self.board.strike(end_ns, live, sequence=self._tick - 1)
        if self._steps.end_next:
            self._streaming.catch_up(end_ns, self._stop.is_set)
        self._steps.count()
        ended = next((craft for craft in self.crafts if craft.state.ended), None)
        if ended is not None:
            self._end(f"{ended.name} collided at {ended.state.stamp_ns / 1e9:.3f} s")
        elif not live.run_on and end_ns >= to_ns(self.config.duration_s):
            self._end(f"the {self.config.duration_s:g} s are over")

    # Waiting

    def _wait_for_command(self, craft: Craft) -> Command | None:
        """Wait for the command that the control period needs; None if something else has to be done first."""
        live = self.config.live
        begin_s = time.monotonic()
        limited = live.mode == "lockstep" and self._tick > 0
        deadline_s = begin_s + live.command_deadline_s if limited else None

        def wake() -> bool:
            if limited and time.monotonic() - begin_s > LATE_S:
                self._reason = f"for the command of {craft.name} that answers {craft.answers_ns} ns"
            self._mind()
            craft.greet()
            if self._tick == 0 and self._steps and time.monotonic() - begin_s > FIRST_STEP_S:
                self._steps.stop(f"nobody has sent {craft.name} a command yet: time begins with the first")
                return True
            return self._is_called()

        command = craft.inbox.wait(
            functools.partial(craft.answers, lockstep=live.mode == "lockstep"),
            deadline_s=deadline_s,
            wake=wake,
        )
        self._reason = ""
        if command is None and deadline_s is not None and time.monotonic() >= deadline_s:
            self._fail(
                f"no command for {craft.name} within live.command_deadline_s = {live.command_deadline_s:g} s "
                f"at control period {self._tick}: {craft.describe_silence()}"
            )
        return command

    def _mind(self) -> None:
        """See who listens, and say how it is going, if it is time."""
        self._audience.look()
        self._tell()

    def _is_called(self) -> bool:
        """Whether something has to be done before what is waited for."""
        return self._stop.is_set() or bool(self._requests)

    def _tell(self, *, at_once: bool = False) -> None:
        """Say how it is going, if it is time."""
        self.board.tell(self.phase, self._make_status, at_once=at_once)

    def _make_status(self) -> SimulatorStatus:
        return self._meter.status(
            self.crafts,
            self._cameras.dropped,
            self.config,
            stamp_ns=self.stamp_ns,
            phase=self.phase,
            reason=self.reason,
        )

    # Beginning and end

    def _begin(self, beginning: Beginning) -> None:
        """Begin a run at stamp 0, and publish where everybody is."""
        self._cameras.reset()
        if self._recorder is not None:
            self._recorder.begin(beginning.seeds, replace=self._tick == 0)
        self._tick = self.stamp_ns = 0
        self._flown = self._ended = False
        self._reason = ""
        self._meter.reset()
        self._meetings.reset()
        for craft in self.crafts:
            craft.begin(beginning.states[craft.name], seed=beginning.seeds[craft.name])

    def _end(self, reason: str) -> None:
        """End the run, but not the simulator, unless that was all there was to do."""
        self._ended, self._reason = True, reason
        self._steps.stop(f"the run has ended: {reason}")
        self._cameras.finish(self._stop.is_set)
        self._flush()
        if not self.config.live.run_on:
            self._exit = 0

    def _fail(self, reason: str) -> None:
        """End everything, with an error."""
        self._end(reason)
        self._exit = 1

    def _flush(self) -> None:
        """Publish what is known up to now, events of a window that has only begun included.

        What the cameras have not looked at yet is left out and counted.
        """
        at_rest = self._cameras.give_up()
        self._streaming.offer_seen()
        for craft in self.crafts:
            if at_rest:
                craft.finish()
            craft.outlet.publish_due(max(self.stamp_ns, craft.state.stamp_ns))

    def _drop_loans(self) -> None:
        with contextlib.ExitStack() as drops:  # of all, whatever one of them raises
            for craft in reversed(self.crafts):
                drops.callback(craft.drop_loans)

    def _culprit(self, error: DynamicsError) -> str:
        return next(craft.name for craft in self.crafts if craft.state.failure is error)

    def _record(self, vehicle: str) -> Callable[[Packet], None] | None:
        return None if self._recorder is None else functools.partial(self._recorder.write, vehicle)

    # Requests

    def _answer_requests(self) -> None:
        """Do what has been asked for."""
        self._steps.check()
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

    def _reset(self, request: Reset) -> str:
        """Begin again; return why not, empty if it was done."""
        try:
            beginning = make_beginning(self.crafts, self.config, request)
        except ValueError as error:
            return str(error)
        self._steps.stop("the run was reset")
        self._begin(beginning)
        return ""

    def _pause(self, *, paused: bool) -> None:
        """Stop time, or let it go on."""
        if paused and not self._ended and self._tick:
            self._streaming.catch_up(self.stamp_ns, self._stop.is_set)
        self._steps.stop("paused" if paused else "resumed")
        if self._paused and not paused:
            self._go_on()
        self._paused = paused

    def _start_steps(self, request: Request) -> None:
        """Let a paused run go on for some control periods."""
        if self._ended:
            request.answer(f"the run has ended: {self._reason}")
        elif not self._paused:
            request.answer("it is not paused: call /pause first")
        else:
            self._go_on()
            self._steps.start(request)

    def _go_on(self) -> None:
        """Let a paused run go on from here, with the commands that came meanwhile."""
        self._pacer.start(self.stamp_ns)
        if self.config.live.mode == "streaming" and self._tick:
            self._take_commands(self.stamp_ns)

    def _change(self, config: SimulationConfig | None) -> str:
        """Change settings; return why not, empty if it was done."""
        assert config is not None
        if config.live.real_time_factor != self.config.live.real_time_factor:
            self._pacer.set_factor(config.live.real_time_factor)
        self.config = config
        for craft in self.crafts:
            craft.configure(config.of(craft.name))
        if self._recorder is not None:
            self._recorder.change(config, stamp_ns=self.stamp_ns)
        self.board.announce(config)
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
        RuntimeError: Another simulator runs in this domain.
    """
    console = Console()
    stop = threading.Event()
    with Node("simulator") as node:
        refuse_second(node)
        with console.status("preparing") as status:
            simulator = Simulator(
                config,
                node,
                record=record,
                overwrite=overwrite,
                on_phase=lambda phase: status.update(f"preparing: {phase}"),
            )
        gc.collect()
        gc.freeze()  # what is here stays: to look at it again would hold up time by a tenth of a second
        sys.setswitchinterval(_SWITCH_S)
        be_punctual()
        with stop_at_signals(stop, on_stop=node.stop_waiting), simulator:
            print_plan(console, simulator.crafts, config)
            with StatusLine(console) as line:
                simulator.board.on_status = line.show
                code = simulator.run(stop)
            redone = {craft.name: craft.state.counts["redone intervals"] for craft in simulator.crafts}
            print_end(console, line.last, record, redone=redone)
    return 130 if stop.is_set() else code
