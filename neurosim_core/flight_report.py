"""The texts that `neurosim run` prints: the plan before the flight, and the report after it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from neurosim_core.clock import NS_PER_S
from neurosim_core.config import SimulationConfig, default_sensors
from neurosim_core.packets import Collision, Events, Odometry, Packet
from neurosim_core.sensors.render_plan import RenderGroup
from neurosim_core.sim.model import Model
from neurosim_core.sim.render_group import render_terms
from neurosim_core.sim.state import State
from neurosim_core.vehicle.multirotor import MultirotorVehicleConfig


@dataclass(kw_only=True, eq=False)
class FlightReport:
    """Times and counts of a flight, for the report."""

    setup_s: float = 0.0
    """Wall-clock time until the first packet, from the beginning of the command [s]."""
    libraries_s: float = 0.0
    """The part of `setup_s` before the settings were known [s]."""
    setup_wall_s: dict[str, float] = field(default_factory=dict)
    """`State.wall_s` at the first packet."""
    flight_s: float = 0.0
    """Wall-clock time of the flight, recording included [s]."""
    closing_s: float = 0.0
    """Wall-clock time to complete its files, and to draw the overview [s]."""
    simulated_ns: int = 0
    event_count: int = 0
    packet_counts: dict[str, int] = field(default_factory=dict)
    """By sensor."""
    lost_counts: dict[str, int] = field(default_factory=dict)
    """How many of each sensor are lost between its packets."""
    collisions: list[Collision] = field(default_factory=list)
    positions: list[tuple[int, NDArray[np.float64]]] = field(default_factory=list)
    """Stamp [ns] and p_WB [m] of every odometry packet."""
    interrupted: bool = False
    failure: Exception | None = None
    """The error that ended the flight early."""

    @property
    def real_time_factor(self) -> float:
        """Simulated time over wall-clock time."""
        return self.simulated_ns / NS_PER_S / self.flight_s if self.flight_s > 0.0 else 0.0

    def note(self, packet: Packet) -> None:
        """Count one packet."""
        count = self.packet_counts.get(packet.sensor, 0) + 1
        self.packet_counts[packet.sensor] = count
        self.lost_counts[packet.sensor] = packet.sequence + 1 - count
        if isinstance(packet, Events):
            self.event_count += len(packet)
        elif isinstance(packet, Collision):
            self.collisions.append(packet)
        elif isinstance(packet, Odometry):
            self.positions.append((packet.stamp_ns, packet.position.copy()))


def print_plan(console: Console, model: Model) -> None:
    """Print what is about to be flown."""
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
    who = f"[bold]{config.vehicle.title}[/] flies"
    if model.path.attitude is not None:
        who = f"[bold]{getattr(config.path, 'file', None) or 'keyframes'}[/]: the rig moves"
    console.print(
        f"{who} {length:.1f} m in {config.duration_s:g} s, "
        f"at most {speed.max():.1f} m/s, on {model.device}{rest}",
        highlight=False,
    )


def print_report(console: Console, model: Model, state: State, report: FlightReport, folder: Path) -> None:
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
    if model.config.sensors:
        counts_of = (_describe_packets(name, report, state) for name in model.config.sensors)
        facts.add_row("packets", ", ".join(counts_of))
    if any(issubclass(sensor.packet_class, Events) for sensor in model.config.sensors.values()):
        rate = report.event_count / simulated_s / 1e6 if simulated_s else 0.0
        dropped = counts["events dropped"]
        facts.add_row("events", f"{report.event_count:,} ({rate:.2f} M/s), {dropped:,} dropped")
    if report.positions:
        stamp_ns, position = map(np.array, zip(*report.positions, strict=True))
        errors_cm = 100.0 * np.linalg.norm(position - model.path.evaluate(stamp_ns).position, axis=1)
        rms_cm = np.sqrt((errors_cm**2).mean())
        facts.add_row("path", f"followed to {rms_cm:.1f} cm RMS, {errors_cm.max():.1f} cm at most")
    ending = "; the run ended there" if state.ended else ""
    if model.path.attitude is None:
        facts.add_row("collisions", f"{_describe_collisions(report)}{ending}")
    for name, terms in _terms(model, state).items():
        facts.add_row(f"compiled {name}", ", ".join(terms) or "nothing optional")
    for name, sensor in model.config.sensors.items():
        for title, describe in sensor.reported.items():
            facts.add_row(f"{title} of {name}", describe(sensor))
    console.print()
    console.print(facts, highlight=False)

    spent = Table(box=None, pad_edge=False, header_style="dim")
    spent.add_column("time went to", min_width=24)
    spent.add_column("s", justify="right")
    spent.add_column("share", justify="right")
    setup = {"set-up: libraries, settings": report.libraries_s}
    setup |= {f"set-up: {phase}": seconds for phase, seconds in model.setup_s.items()}
    setup["set-up: kernels, first packet"] = max(0.0, report.setup_s - sum(setup.values()))
    inside = {phase: seconds - report.setup_wall_s.get(phase, 0.0) for phase, seconds in state.wall_s.items()}
    inside["recording and drawing"] = max(0.0, report.flight_s - sum(inside.values()))
    inside["files completed"] = report.closing_s
    rows = [*setup.items(), *inside.items()]
    total = sum(seconds for _, seconds in rows)
    for name, seconds in rows:
        if seconds < 0.005:
            continue
        spent.add_row(name, f"{seconds:.2f}", f"{100 * seconds / total:.0f} %")
    spent.add_row("all", f"{total:.2f}", "100 %")
    console.print()
    console.print(spent, highlight=False)
    console.print()
    if report.interrupted:
        console.print(f"[yellow]interrupted at {simulated_s:.3f} s; what was flown is kept[/]")
    left = ", ".join(sorted(path.name for path in folder.iterdir() if path.is_file()))
    console.print(f"{folder}/: {left}", highlight=False, soft_wrap=True)


def absent_sensors(config: SimulationConfig) -> str:
    """Return one sentence on the sensors of the default set that a configuration leaves out; "" if none."""
    absent = [name for name in default_sensors() if name not in config.sensors]
    if not absent:
        return ""
    return (
        f"Absent of the default sensors: {', '.join(absent)}. `sensors` replaces the default set, "
        "`sensors+` adds to it."
    )


def _describe_steps(model: Model, counts: Mapping[str, int]) -> str:
    """Say how the dynamics were integrated."""
    if model.path.attitude is not None:
        return "none: a motion is followed"
    vehicle, commands = model.config.vehicle, f"{counts['commands']:,} commands"
    if not isinstance(vehicle, MultirotorVehicleConfig):
        return f"{counts['steps']:,} of the vehicle {vehicle.title!r}, {commands}"
    if vehicle.integrator != "rkmk4":
        return f"adaptive, of {vehicle.integrator}; {commands}"
    redone = counts["redone intervals"]
    more = f"; {redone:,} intervals were too rough for that, and redone in adaptive steps" if redone else ""
    steps = f"rkmk4, at most {1e3 * vehicle.max_step_s:g} ms{more}"
    return f"{counts['steps']:,} of the dynamics ({steps}), {commands}"


def _describe_packets(name: str, report: FlightReport, state: State) -> str:
    """Say how many packets a sensor has given, and how many it has lost."""
    count, lost = report.packet_counts.get(name, 0), report.lost_counts.get(name, 0)
    if count == 0 and (samples := state.sequence.get(name, 0)):
        return f"[yellow]{name} none of {samples:,}: its packet() returned None each time[/]"
    return f"{name} {count:,}" + (f" ({lost:,} lost)" if lost else "")


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


def _describe_collisions(report: FlightReport) -> str:
    if not report.collisions:
        return "none"
    first = report.collisions[0]
    where = ", ".join(f"{x:.2f}" for x in first.position)
    return f"[red]{len(report.collisions)}, first at {first.stamp_ns / NS_PER_S:.3f} s, ({where}) m[/]"


def _terms(model: Model, state: State) -> dict[str, tuple[str, ...]]:
    """Return the optional terms that each kernel computes."""
    terms: dict[str, tuple[str, ...]] = {"dynamics": state.vehicle.terms}
    terms |= {name: sampler.terms for name, sampler in state.samplers.items()}
    for group, seeing in zip(model.groups, state.groups, strict=True):
        terms[", ".join(group.names)] = (*sorted(group.outputs), *render_terms(seeing))
    return terms
