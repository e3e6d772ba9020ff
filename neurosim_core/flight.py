"""A flight as a user asks for it: fly, record, draw, and say what happened."""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from neurosim_core import __version__
from neurosim_core.clock import NS_PER_S
from neurosim_core.config import SimulationConfig, absent_sensors, load_config, to_yaml
from neurosim_core.install import install_hint
from neurosim_core.packets import Collision, Odometry, Packet
from neurosim_core.record import Recording, RecordingHeader, RecordingWriter, describe_sensors
from neurosim_core.scene.bodies import make_bodies
from neurosim_core.sensors.event_config import describe_pixel
from neurosim_core.sensors.event_camera import EventSensorConfig
from neurosim_core.sensors.render_plan import RenderGroup
from neurosim_core.signals import stop_at_signals
from neurosim_core.sim.model import Model, load_scene, make_model
from neurosim_core.sim.render_group import render_terms
from neurosim_core.sim.rollout import run_model
from neurosim_core.sim.state import State, make_state
from neurosim_core.vehicle import DynamicsError
from neurosim_core.view.overview import FlightSummary, Track, save_overview
from neurosim_core.view.rerun_log import RerunLogger
from neurosim_core.view.rerun_sdk import open_rerun
from neurosim_core.view.rerun_shapes import scene_shapes

_LIBRARIES = {"h5py": "record", "rerun": "view", "matplotlib": "view"}
"""What a recording needs, and the extra that brings it."""


@dataclass(kw_only=True, eq=False)
class Report:
    """What is told about a flight besides its packets."""

    setup_s: float = 0.0
    """Wall-clock time until the first packet [s]."""
    setup_wall_s: dict[str, float] = field(default_factory=dict)
    """What of `State.wall_s` had passed by then."""
    flight_s: float = 0.0
    """Wall-clock time of the flight, recording included [s]."""
    simulated_ns: int = 0
    event_count: int = 0
    packet_count: int = 0
    collisions: list[Collision] = field(default_factory=list)
    tracking_errors_m: list[float] = field(default_factory=list)
    """Distance from the path at every odometry packet [m]."""
    interrupted: bool = False
    failure: DynamicsError | None = None

    @property
    def real_time_factor(self) -> float:
        """Simulated time over wall-clock time."""
        return self.simulated_ns / NS_PER_S / self.flight_s if self.flight_s > 0.0 else 0.0


def new_folder(out: Path | None, *, overwrite: bool = False) -> Path:
    """Return the folder for a new flight; `fly` makes it once there is something to put in it.

    Args:
        out: Where the user wants it; None: ./flight, or ./flight-2, ... if there is one already.
        overwrite: Replace a flight that is already in `out`.

    Raises:
        FileExistsError: `out` holds a flight and may not be overwritten.
    """
    if out is None:
        names = (Path("flight" if number == 1 else f"flight-{number}") for number in itertools.count(1))
        out = next(name for name in names if not name.exists())
    if out.exists() and not out.is_dir():
        raise NotADirectoryError(f"--out must name a folder, got the file {out}")
    held = [name for name in ("flight.h5", "config.yaml") if (out / name).exists()]
    if held and not overwrite:
        raise FileExistsError(
            f"{out} already holds a flight ({', '.join(held)}): add --overwrite, or name another folder"
        )
    return out


def fly(
    config: SimulationConfig, folder: Path, *, rerun: bool = True, console: Console | None = None
) -> Report:
    """Fly a configuration and leave config.yaml, flight.h5, flight.rrd and overview.png in a folder.

    What cannot be written because an extra is not installed is left out, and said.

    Args:
        config: What to fly.
        folder: Where to leave the flight; made if need be.
        rerun: Write flight.rrd.
        console: Where to print; standard output if None.

    Raises:
        DynamicsError: The integration failed; the recording holds everything up to there.
    """
    console = console or Console()
    report = Report()
    begin = time.perf_counter()
    with console.status("preparing") as status:
        model = make_model(config, on_phase=lambda phase: status.update(f"preparing: {phase}"))
        status.update("preparing: kernels (compiled on the first run, then cached)")
        state = make_state(model)
        packets = run_model(model, state)
        first = next(packets, None)  # builds all kernels; there is none without sensors
    report.setup_s = time.perf_counter() - begin
    report.setup_wall_s = dict(state.wall_s)
    _print_plan(console, model)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(to_yaml(config, comments=True), encoding="utf-8")

    summary = FlightSummary(describe_sensors(config.sensors))
    stop = threading.Event()
    begin = time.perf_counter()
    with (
        stop_at_signals(stop),
        _sinks(model, folder, rerun=rerun, console=console) as sinks,
        _progress(console) as progress,
    ):
        task = progress.add_task("flying", total=model.duration_ns, rate="", factor="")
        try:
            for packet in packets if first is None else itertools.chain([first], packets):
                if stop.is_set():
                    report.interrupted = True
                    break
                for sink in sinks:
                    sink(packet)
                summary.log(packet)
                _note(report, model, packet)
                report.flight_s = time.perf_counter() - begin
                if packet.stamp_ns > report.simulated_ns:
                    report.simulated_ns = packet.stamp_ns
                    progress.update(
                        task,
                        completed=packet.stamp_ns,
                        rate=f"{summary.event_count / report.simulated_ns * 1e3:.2f} M events/s",
                        factor=f"{report.real_time_factor:.2f} x real time",
                    )
        except DynamicsError as error:
            report.failure = error
    report.flight_s = time.perf_counter() - begin
    report.event_count = summary.event_count
    if _has("matplotlib", console, "overview.png"):
        save_overview(
            folder / "overview.png",
            scene=model.scene,
            track=summary.track() if report.tracking_errors_m else _planned_track(model, state.stamp_ns),
            snapshot=summary.snapshot(),
            event_count=report.event_count,
            real_time_factor=report.real_time_factor,
        )
    print_report(console, model, state, report, folder)
    if report.failure is not None:
        raise report.failure
    return report


def rerun_file(flight: Path, *, save: Path | None = None) -> Path:
    """Return the Rerun file of a flight; write it from the recording if there is none, or to `save` if given.

    Args:
        flight: The folder that `fly` left, or its flight.h5 or flight.rrd.
        save: Write here.

    Raises:
        FileNotFoundError: There is no flight.
        ImportError: Rerun or h5py is not installed.
    """
    recorded = flight / "flight.h5" if flight.is_dir() else flight
    made = recorded.with_suffix(".rrd")
    if save is None and made.exists():
        return made
    if not recorded.exists() or recorded.suffix != ".h5":
        raise FileNotFoundError(f"no flight at {recorded}; `neurosim run --out {flight}` makes one")
    with Recording(recorded) as source:
        header = source.header
        settings = yaml.safe_load(header.config_yaml)
        recording = open_rerun(save or made)
        if "conversion" in settings:  # of a video, which has neither vehicle nor scene
            logger = RerunLogger(recording, vehicles={"video": header.sensors})
        else:
            config = load_config(settings)
            logger = RerunLogger(
                recording,
                vehicles={next(iter(config.vehicles)): header.sensors},
                scene=scene_shapes(load_scene(config.scene), make_bodies(config.bodies)),
                links=bool(config.links),
            )
        with logger:
            logger.log_path(header.path_position)
            for packet in source.packets():
                logger.log(packet)
    return save or made


@contextlib.contextmanager
def _sinks(
    model: Model, folder: Path, *, rerun: bool, console: Console
) -> Iterator[list[Callable[[Packet], None]]]:
    """Open everything that packets go to, and close it whatever happens."""
    config = model.config
    with contextlib.ExitStack() as stack:
        sinks: list[Callable[[Packet], None]] = []
        stamps = np.linspace(0, model.duration_ns, 1001).astype(np.int64)
        path_position = model.path.evaluate(stamps).position
        if _has("h5py", console, "flight.h5"):
            header = RecordingHeader(
                config_yaml=to_yaml(config),
                seed=config.seed,
                version=__version__,
                scene=model.scene.name,
                sensors=describe_sensors(config.sensors),
                path_stamp_ns=stamps,
                path_position=path_position,
            )
            sinks.append(stack.enter_context(RecordingWriter(folder / "flight.h5", header)).write)
        if rerun and _has("rerun", console, "flight.rrd"):
            logger = RerunLogger(
                open_rerun(folder / "flight.rrd"),
                vehicles={next(iter(config.vehicles)): describe_sensors(config.sensors)},
                scene=scene_shapes(model.scene, model.bodies),
            )
            logger.log_path(path_position)
            sinks.append(stack.enter_context(logger).log)
            sinks.append(lambda packet: _log_clearance(logger, model, packet))
        yield sinks


def _log_clearance(logger: RerunLogger, model: Model, packet: Packet) -> None:
    if isinstance(packet, Odometry):
        clearance_m = float(model.free_space.clearance(packet.position)[0])
        logger.log_scalar("clearance", packet.stamp_ns, clearance_m)


def _planned_track(model: Model, end_ns: int) -> Track:
    """Return the planned path up to a stamp, for a flight without odometry."""
    samples = model.path.evaluate(np.linspace(0, end_ns, 501).astype(np.int64))
    return Track(
        stamp_ns=samples.stamps_ns,
        position=samples.position,
        velocity=samples.velocity,
        heading=np.stack([np.cos(samples.yaw), np.sin(samples.yaw)], axis=1),
    )


def _has(library: str, console: Console, product: str) -> bool:
    if importlib.util.find_spec(library) is not None:
        return True
    console.print(f"{product} is left out: {install_hint(_LIBRARIES[library])}", style="yellow", markup=False)
    return False


def _note(report: Report, model: Model, packet: Packet) -> None:
    report.packet_count += 1
    if isinstance(packet, Collision):
        report.collisions.append(packet)
    elif isinstance(packet, Odometry):
        wanted = model.path.evaluate([packet.stamp_ns]).position[0]
        report.tracking_errors_m.append(float(np.linalg.norm(packet.position - wanted)))


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=32),
        TextColumn("{task.percentage:>3.0f} %"),
        TextColumn("{task.fields[factor]}"),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
        console=console,
    )


def _print_plan(console: Console, model: Model) -> None:
    """Say what is going to happen, before it takes its time."""
    scene, config = model.scene, model.config
    size = " x ".join(f"{length:.1f}" for length in np.ptp(scene.bounds_m, axis=0))
    samples = model.path.evaluate(np.linspace(0, model.duration_ns, 1001).astype(np.int64))
    speed = np.linalg.norm(samples.velocity, axis=1)
    length = np.linalg.norm(np.diff(samples.position, axis=0), axis=1).sum()
    console.print(
        f"[bold]{scene.name}[/]: {size} m, {len(scene.faces):,} triangles, {len(scene.lights)} lights",
        highlight=False,
    )
    notes = [f"{body.name}: {note}" for body in model.bodies for note in body.solid.notes]
    for note in filter(None, (*scene.notes, *notes, *model.free_space.notes, absent_sensors(config))):
        console.print(f"  {note}", style="dim", highlight=False)
    beyond_s = (model.path.end_ns - model.duration_ns) / NS_PER_S
    rest = f"; the whole path takes {beyond_s:.1f} s more" if beyond_s > 0.0 else ""
    console.print(
        f"[bold]{config.vehicle.preset}[/] flies {length:.1f} m in {config.duration_s:g} s, "
        f"at most {speed.max():.1f} m/s, on {model.device}{rest}",
        highlight=False,
    )


def print_report(console: Console, model: Model, state: State, report: Report, folder: Path) -> None:
    """Print what was flown, what was compiled in, and where the time went."""
    simulated_s = report.simulated_ns / NS_PER_S
    facts = Table(show_header=False, box=None, pad_edge=False)
    facts.add_column(style="dim", min_width=12)
    facts.add_column(overflow="fold")
    counts = state.counts
    facts.add_row(
        "simulated",
        f"{simulated_s:.3f} s in {report.flight_s:.1f} s: real-time factor {report.real_time_factor:.2f} "
        f"(and {report.setup_s:.1f} s of set-up)",
    )
    facts.add_row("steps", _describe_steps(model, counts))
    if model.bodies:
        facts.add_row("bodies", ", ".join(body.name for body in model.bodies))
    if model.groups:
        groups = "; ".join(_describe_group(group) for group in model.groups)
        facts.add_row("renders", f"{counts['renders']:,} ({groups})")
        if model.schedule.sparse:
            facts.add_row("left out", _describe_left_out(counts))
        rate = report.event_count / simulated_s / 1e6 if simulated_s else 0.0
        dropped = counts["events dropped"]
        facts.add_row("events", f"{report.event_count:,} ({rate:.2f} M/s), {dropped:,} dropped")
    if report.tracking_errors_m:
        errors_cm = 100.0 * np.array(report.tracking_errors_m)
        rms_cm = np.sqrt((errors_cm**2).mean())
        facts.add_row("path", f"followed to {rms_cm:.1f} cm RMS, {errors_cm.max():.1f} cm at most")
    ending = "; the run ended there" if state.ended else ""
    facts.add_row("collisions", f"{_describe_collisions(report)}{ending}")
    for name, terms in _terms(model, state).items():
        facts.add_row(f"compiled {name}", ", ".join(terms) or "nothing optional")
    for name, sensor in model.config.sensors.items():
        if isinstance(sensor, EventSensorConfig):
            facts.add_row(f"pixels of {name}", describe_pixel(sensor.pixel))
    console.print()
    console.print(facts, highlight=False)

    spent = Table(box=None, pad_edge=False, header_style="dim")
    spent.add_column("time went to", min_width=24)
    spent.add_column("s", justify="right")
    spent.add_column("share", justify="right")
    setup = {f"set-up: {phase}": seconds for phase, seconds in model.setup_s.items()}
    setup["set-up: kernels, first packet"] = max(0.0, report.setup_s - sum(setup.values()))
    inside = {phase: seconds - report.setup_wall_s.get(phase, 0.0) for phase, seconds in state.wall_s.items()}
    inside["recording and drawing"] = max(0.0, report.flight_s - sum(inside.values()))
    rows = [*setup.items(), *inside.items()]
    total = sum(seconds for _, seconds in rows)
    for name, seconds in rows:
        spent.add_row(name, f"{seconds:.2f}", f"{100 * seconds / total:.0f} %")
    console.print()
    console.print(spent, highlight=False)
    console.print()
    if report.interrupted:
        console.print(f"[yellow]interrupted at {simulated_s:.3f} s; what was flown is kept[/]")
    left = ", ".join(sorted(path.name for path in folder.iterdir() if path.is_file()))
    console.print(f"{folder}/: {left}", highlight=False, soft_wrap=True)


def _describe_steps(model: Model, counts: Mapping[str, int]) -> str:
    """Say how the dynamics were integrated."""
    vehicle, commands = model.config.vehicle, f"{counts['commands']:,} commands"
    if vehicle.integrator != "rkmk4":
        return f"adaptive, of {vehicle.integrator}; {commands}"
    redone = counts["redone intervals"]
    more = f"; {redone:,} intervals were too rough for that, and redone in adaptive steps" if redone else ""
    steps = f"rkmk4, at most {1e3 * vehicle.max_step_s:g} ms{more}"
    return f"{counts['steps']:,} of the dynamics ({steps}), {commands}"


def _describe_group(group: RenderGroup) -> str:
    limit_px = group.max_displacement_px
    where = "" if limit_px is None else f" where something moves {limit_px:g} px"
    return (
        f"{group.lens.width}x{group.lens.height} at {group.rate.rate_hz:g} Hz{where} "
        f"for {', '.join(group.names)}"
    )


def _describe_left_out(counts: Mapping[str, int]) -> str:
    coarse = counts["coarse ticks"]
    advice = (
        f"; after {coarse:,} renders one step of the clock is too long: raise sampling_rate_hz"
        if coarse
        else ""
    )
    return f"{counts['ticks left out']:,} ticks without a render{advice}"


def _describe_collisions(report: Report) -> str:
    if not report.collisions:
        return "none"
    first = report.collisions[0]
    where = ", ".join(f"{x:.2f}" for x in first.position)
    return f"[red]{len(report.collisions)}, first at {first.stamp_ns / NS_PER_S:.3f} s, ({where}) m[/]"


def _terms(model: Model, state: State) -> dict[str, tuple[str, ...]]:
    """What each kernel computes, beyond what every run needs."""
    terms: dict[str, tuple[str, ...]] = {"dynamics": state.vehicle.terms}
    terms |= {name: sampler.terms for name, sampler in state.samplers.items()}
    for group, seeing in zip(model.groups, state.groups, strict=True):
        terms[", ".join(group.names)] = (*sorted(group.outputs), *render_terms(seeing))
    return terms
