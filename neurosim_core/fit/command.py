"""The command `neurosim fit-sensor`: the settings of a real event camera from its recordings."""

from __future__ import annotations

import argparse
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from neurosim_core.fit.sensor import SensorFit
    from neurosim_core.io.event_file import EventReader
    from neurosim_core.packets import EventArrays

_COLORS = ("#1d2530", "#e8590c")


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `fit-sensor` to the commands of `neurosim`."""
    parser = commands.add_parser(
        "fit-sensor",
        help="estimate the settings of your event camera from recordings",
        description="Estimate leak, shot noise, hot pixels and dead time of an event camera from a recording "
        "of a still, evenly lit surface, and thresholds, their spread and jitter and the readout from one of "
        "light that is switched between two levels. Writes settings with their standard errors, and a "
        "picture of the recording beside a simulation with them. Any format that `neurosim convert` reads.",
    )
    parser.add_argument("still", type=Path, help="events of a still, evenly lit surface, 30 s or more")
    parser.add_argument("steps", type=Path, nargs="?", help="events of light that is switched up and down")
    parser.add_argument("--lux", type=float, required=True, help="illuminance of the still surface [lux]")
    parser.add_argument(
        "--contrast",
        type=float,
        metavar="RATIO",
        help="ratio of bright to dark light; required with steps",
    )
    parser.add_argument(
        "--rise",
        type=float,
        default=0.0,
        metavar="S",
        help="time of a change of light, which is linear in its logarithm [s] (default: 0)",
    )
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("my_camera.yaml"),
        metavar="YAML",
        help="settings to write (default: my_camera.yaml)",
    )
    parser.add_argument(
        "--also",
        nargs=2,
        action="append",
        default=[],
        metavar=("FILE", "LUX"),
        help="the still surface at another illuminance; may be repeated. A .npz beside the settings then "
        "has the noise rates of all pixels, and the settings refer to it",
    )
    parser.add_argument("--size", metavar="WxH", help="resolution, for files that do not give it")
    parser.add_argument("--sensor", default="", metavar="NAME", help="event camera, for files with several")
    parser.add_argument("--repeats", type=int, default=8, help="simulations for the errors (default: 8)")
    parser.add_argument("--overwrite", action="store_true", help="replace existing files")
    parser.set_defaults(command=_fit)


def _fit(arguments: argparse.Namespace) -> int:
    from rich.console import Console

    from neurosim_core.fit.sensor import Stimulus, fit_sensor
    from neurosim_core.io.event_file import check_new

    if arguments.steps is not None and arguments.contrast is None:
        raise ValueError("say how high the steps are: --contrast 4 if light goes from 1 to 4")
    if arguments.contrast is not None and not arguments.contrast > 1.0:
        raise ValueError(f"--contrast is bright over dark light, above 1, got {arguments.contrast}")
    if not (arguments.lux >= 0.0 and arguments.rise >= 0.0):
        raise ValueError(f"--lux and --rise must be >= 0, got {arguments.lux} and {arguments.rise}")
    picture, rates = (arguments.out.with_suffix(suffix) for suffix in (".png", ".npz"))
    for path in (arguments.out, picture, *([rates] if arguments.also else [])):
        check_new(path, overwrite=arguments.overwrite)
    console = Console()
    with console.status("read the recordings") as status:
        still, reader = _read(arguments.still, arguments)
        steps = None if arguments.steps is None else _read(arguments.steps, arguments)[0]
        stimulus = Stimulus(
            width=reader.width,
            height=reader.height,
            still=still,
            steps=steps,
            contrast=arguments.contrast or Stimulus.contrast,  # of no steps
            rise_s=arguments.rise,
        )
        fit = fit_sensor(stimulus, repeats=arguments.repeats, progress=status.update)
        if arguments.also:
            others = [(float(lux), _read(Path(file), arguments)[0]) for file, lux in arguments.also]
            write_noise_table(rates, [(arguments.lux, still), *others], reader.width, reader.height)
            own = ("shot_noise.", "leak.", "hot_pixels.")  # what pixels do at each light holds all of it
            kept = {key: value for key, value in fit.settings.items() if not key.startswith(own)}
            fit = replace(fit, settings=kept | {"measured_noise.file": rates.name})
    print_fit(fit, console)
    names = [path.name for path in (arguments.still, arguments.steps) if path is not None]
    arguments.out.write_text(fit_yaml(fit, stimulus.width, stimulus.height, arguments.lux, names), "utf-8")
    draw_fit(fit, picture)
    made = "\n".join(str(path) for path in (arguments.out, picture, *([rates] if arguments.also else [])))
    console.print(made, markup=False, highlight=False, soft_wrap=True)
    return 0


def _read(path: Path, arguments: argparse.Namespace) -> tuple[EventArrays, EventReader]:
    from neurosim_core.convert.geometry import read_size
    from neurosim_core.io import open_events
    from neurosim_core.packets import join_events

    size = None if arguments.size is None else read_size(arguments.size)
    with closing(open_events(path, size=size, sensor=arguments.sensor)) as reader:
        return join_events(list(reader.blocks())), reader


def write_noise_table(
    path: Path, recordings: list[tuple[float, EventArrays]], width: int, height: int
) -> None:
    """Write the rates of all pixels in several lights [lux], as `MeasuredNoiseConfig.file` has them."""
    import numpy as np

    from neurosim_core.fit.recordings import sort_still

    by_light = sorted(recordings, key=lambda one: one[0])
    stills = [sort_still(events, width, height) for _, events in by_light]
    np.savez_compressed(
        path,
        lux=np.array([lux for lux, _ in by_light]),
        on_hz=np.array([still.on / still.span_s for still in stills], dtype=np.float32),
        off_hz=np.array([still.off / still.span_s for still in stills], dtype=np.float32),
    )


def print_fit(fit: SensorFit, console: Console) -> None:
    """Print settings with errors, and statistics of the recording beside those of a simulation."""
    from rich.markup import escape
    from rich.table import Table

    from neurosim_core.convert.command import print_notes
    from neurosim_core.fit.sensor import statistics

    table = Table("setting", "value", "standard error", box=None, pad_edge=False)
    for key, value in fit.settings.items():
        error = fit.errors.get(key)
        table.add_row(key, _short(value), "" if error is None else f"{error:.2g}")
    console.print(table, highlight=False)
    table = Table("statistic", "recording", "simulation", box=None, pad_edge=False)
    simulated = statistics(fit.simulated)
    for name, value in statistics(fit.real).items():
        table.add_row(escape(name), _short(value), _short(simulated[name]) if name in simulated else "")
    console.print(table, highlight=False)
    print_notes(fit.notes, console)


def _short(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"


def fit_yaml(fit: SensorFit, width: int, height: int, lux: float, names: list[str]) -> str:
    """Return settings of an event camera as a file of settings, with the errors as comments."""
    lines = [
        f"# An event camera like that of {' and '.join(names)}, at {lux:g} lux; standard errors behind +-.",
        *(f"# {note}" for note in fit.notes),
        "sensors+:",
        "  events:",
        "    kind: event_camera",
        f"    lens: {{width: {width}, height: {height}, horizontal_fov_rad: 1.2}}  # a lens as any",
        "    pixel:",
    ]
    group = ""
    for key, value in sorted(fit.settings.items(), key=lambda item: ("." in item[0], item[0])):
        head, _, name = key.rpartition(".")
        if head != group:
            lines.append(f"      {head}:")
            group = head
        error = fit.errors.get(key)
        comment = "" if error is None else f"  # +- {error:.2g}"
        text = value if isinstance(value, str) else f"{value:.6f}" if value < 1e4 else f"{value:.0f}"
        lines.append(f"{'        ' if head else '      '}{name}: {text}{comment}")
    return "\n".join(lines) + "\n"


def draw_fit(fit: SensorFit, out: Path) -> None:
    """Draw the recording beside its simulation, as PNG, PDF or SVG."""
    import numpy as np

    from neurosim_core.data.compare import label_axes, new_figure
    from neurosim_core.record.disk import naming_file

    figure = new_figure(14.0, 4.2)
    rates, intervals, steps = figure.subplots(1, 3)
    for one, color, name in zip((fit.real, fit.simulated), _COLORS, ("recording", "simulation"), strict=True):
        still = one.still
        for count, style, sign in ((still.on, "-", "ON"), (still.off, ":", "OFF")):
            rate = np.sort(count / still.span_s)[::-1]
            place = (np.arange(len(rate)) + 0.5) / len(rate)
            rates.plot(
                place, np.maximum(rate, 0.3 / still.span_s), style, color=color, label=f"{name}, {sign}"
            )
        edges = np.geomspace(1e-6, max(still.span_s, 1e-3), 80)
        shares = np.histogram(still.interval_s, edges)[0] / max(len(still.interval_s), 1)
        intervals.step(np.sqrt(edges[1:] * edges[:-1]), shares, color=color, where="mid", label=name)
        time_s = np.linspace(0.0, one.period_s, one.period_hz.shape[1], endpoint=False)
        for rate, style in zip(one.period_hz, ("-", ":"), strict=True):
            steps.plot(time_s, rate, style, color=color)
    label_axes(
        rates, "rates of pixels in still light", "share of pixels", "events a second", x="log", y="log"
    )
    label_axes(intervals, "time between two events of a pixel", "interval [s]", "share", x="log")
    label_axes(steps, "rate of a pixel after light rises", "time [s]", "events a second")
    if not fit.real.period_hz.size:
        steps.text(0.5, 0.5, "no recording of steps", ha="center", transform=steps.transAxes)
    rates.legend(frameon=False, fontsize=9)
    intervals.legend(frameon=False, fontsize=9)
    with naming_file(out):
        figure.savefig(out)
