"""The command `neurosim bench`: what can be measured, and with which options.

What measures is imported when it is asked for: this module costs next to nothing.
"""

from __future__ import annotations

import argparse
import shlex
import signal
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from neurosim_core.install import install_hint
from neurosim_core.overrides import add_set_option, read_settings
from neurosim_core.signals import handle_signals

if TYPE_CHECKING:
    from rich.console import Console

    from neurosim_core.bench.report import Chapter

Progress: TypeAlias = Callable[[str], None]
"""Told what is measured next."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """A question that a chapter of the report answers."""

    name: str
    help: str
    description: str
    chapter: Callable[[Mapping[str, Any], Progress], Chapter]
    """Measures under options, such as quick, and returns the answer."""
    options: frozenset[str] = frozenset()
    """What it takes besides `quick`, some of scene, device, width, height, worlds and seconds."""
    then: str = ""
    """Study of that device that follows where a device is named; its options are taken as well."""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `bench` to the commands of `neurosim`."""
    parser = commands.add_parser("bench", help="measure speed and error on this machine")
    questions = parser.add_subparsers(required=True, metavar="WHAT")
    for study in STUDIES:
        _add_study(questions.add_parser(study.name, help=study.help, description=study.description), study)
    _add_all(questions.add_parser("all", help=f"{', '.join(s.name for s in STUDIES)} in one report"))
    _add_step(questions.add_parser("step", help="whole steps a second with one event camera"))
    _add_closed_loop(questions)
    _add_streaming(questions)
    _add_delay(questions)


def _add_study(parser: argparse.ArgumentParser, study: Study) -> None:
    _add_out(parser, study.name)
    _add_quick(parser)
    _add_strict(parser)
    _add_options(
        parser, frozenset().union(study.options, *(s.options for s in STUDIES if s.name == study.then))
    )
    parser.set_defaults(command=lambda arguments: _bench_study(study, arguments))


def _add_all(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Measure one after the other and leave one report. What fails is said in its chapter, the others "
        "are measured nevertheless, and the exit status is 1."
    )
    _add_out(parser, "report")
    _add_quick(parser)
    _add_strict(parser)
    _add_options(parser, frozenset().union(*(study.options for study in STUDIES)))
    parser.set_defaults(command=_bench_all)


def _add_quick(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--quick", action="store_true", help="a small version, to see what it looks like; figures are rough"
    )


def _add_strict(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--strict",
        action="store_true",
        help="exit with status 1 if a bar is missed; otherwise the last line says how many are, and the "
        "status is 0",
    )


def _add_options(parser: argparse.ArgumentParser, options: frozenset[str]) -> None:
    """What may be chosen; what is not given is up to the study."""
    if "scene" in options:
        parser.add_argument(
            "--scene", type=Path, metavar="FILE", help="mesh file; default: a generated scene"
        )
    if "device" in options:
        parser.add_argument("--device", help="auto, cpu, cuda:0, ...")
    if "worlds" in options:
        parser.add_argument(
            "--worlds", type=_counts, metavar="N,...", help="worlds (default: 1 to 128, on CUDA to 4096)"
        )
    if "seconds" in options:
        parser.add_argument(
            "--seconds", type=float, metavar="S", help="how long to step each number of worlds (default: 3)"
        )
    for name, side in (("width", "columns"), ("height", "rows")):
        if name in options:
            parser.add_argument(
                f"--{name}", type=int, metavar="PX", help=f"{side} of the camera (default: 64, and 128)"
            )


def _add_step(parser: argparse.ArgumentParser) -> None:
    _add_view(parser, width=640, height=480, camera="event camera")
    parser.add_argument("--instants", type=int, default=16, metavar="K", help="renders per launch")
    parser.add_argument("--steps", type=int, default=1600, metavar="N", help="steps per repetition (of five)")
    parser.add_argument(
        "--max-displacement",
        type=float,
        metavar="PX",
        help="render only so often that nothing moves further between two renders (default: at every step)",
    )
    parser.set_defaults(command=_bench_step)


def _add_closed_loop(questions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    loop = questions.add_parser(
        "closed-loop",
        help="simulator and controller as processes: from command to image, images a second",
        description="Fly a simulator from another process at several rates, in lockstep and in real time; "
        "leave closed-loop.csv and closed-loop.png.",
    )
    loop.add_argument(
        "--rates",
        type=_numbers,
        default="100,200,500,1000,2000,5000",
        metavar="HZ,...",
        help="commands and images a second (default: %(default)s)",
    )
    loop.add_argument(
        "--renderer",
        default="synthetic",
        choices=["synthetic", "warp"],
        help="synthetic: a test card, to measure all but rendering; warp: the scene",
    )
    _add_view(loop, width=640, height=480, camera="camera")
    loop.add_argument(
        "--seconds", type=float, default=3.0, metavar="S", help="how long to measure each rate [s]"
    )
    _add_out(loop, "closed-loop")
    _add_set(loop)
    loop.set_defaults(command=_bench_closed_loop)


def _add_streaming(questions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    streaming = questions.add_parser(
        "streaming",
        help="a flight in real time: how punctual an IMU is beside an event camera",
        description="Fly in real time with an IMU at 1 kHz and an event camera that is rendered as often as "
        "this machine can; leave streaming.csv, arrivals.csv and streaming.png.",
    )
    _add_view(streaming, width=346, height=260, camera="event camera")
    streaming.add_argument(
        "--sampling-rate",
        type=float,
        metavar="HZ",
        help="renders of the event camera a second (default: as this machine can)",
    )
    streaming.add_argument(
        "--seconds", type=float, default=60.0, metavar="S", help="how long to measure [s] (default: 60)"
    )
    _add_out(streaming, "streaming")
    _add_set(streaming)
    streaming.set_defaults(command=_bench_streaming)


def _add_delay(questions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    delay = questions.add_parser(
        "delay",
        help="a slow controller in real time against the same delay in lockstep",
        description="Fly tours with a controller that sleeps, in real time, and with the same delay in "
        "lockstep, simulated; leave delay.csv.",
    )
    delay.add_argument(
        "--delays",
        type=_numbers,
        default="0,0.02,0.05",
        metavar="S,...",
        help="what the controller sleeps before each command [s] (default: %(default)s)",
    )
    delay.add_argument("--tours", type=int, default=3, metavar="N", help="how many paths to fly")
    delay.add_argument(
        "--mode",
        default="velocity",
        choices=["motor_speeds", "velocity", "position"],
        help="what to command (default: velocity)",
    )
    delay.add_argument("--seconds", type=float, default=4.0, metavar="S", help="length of a flight [s]")
    delay.add_argument(
        "--factor", type=float, default=1.0, metavar="F", help="real-time factor of the slow controller"
    )
    _add_out(delay, "delay")
    _add_set(delay)
    delay.set_defaults(command=_bench_delay)


def _add_view(parser: argparse.ArgumentParser, *, width: int, height: int, camera: str) -> None:
    """What is looked at, by what, and where that is computed."""
    parser.add_argument(
        "--scene", type=Path, metavar="FILE", help="mesh file; default: the generated apartment"
    )
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda:0, ...")
    parser.add_argument("--width", type=int, default=width, metavar="PX", help=f"columns of the {camera}")
    parser.add_argument("--height", type=int, default=height, metavar="PX", help=f"rows of the {camera}")


def _add_out(parser: argparse.ArgumentParser, folder: str) -> None:
    parser.add_argument(
        "--out", type=Path, default=Path(folder), metavar="DIR", help=f"where to leave files (./{folder})"
    )


def _add_set(parser: argparse.ArgumentParser) -> None:
    add_set_option(parser, "any further setting by its dotted key, such as scene.rooms=2")


def _counts(text: str) -> list[int]:
    """Read whole numbers from 1 on that are separated by commas."""
    numbers = _numbers(text)
    if any(number < 1.0 or number != int(number) for number in numbers):
        raise argparse.ArgumentTypeError(f"takes whole numbers from 1 on, got {text!r}")
    return [int(number) for number in numbers]


def _numbers(text: str) -> list[float]:
    """Read numbers that are separated by commas."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"takes numbers with commas between them, got {text!r}") from None


def _dynamics(options: Mapping[str, Any], progress: Progress) -> Chapter:
    from neurosim_core.bench.dynamics import dynamics_chapter, measure_dynamics

    return dynamics_chapter(measure_dynamics(**options, progress=progress))


def _events(options: Mapping[str, Any], progress: Progress) -> Chapter:
    from neurosim_core.bench.events import events_chapter, measure_events

    return events_chapter(measure_events(**options, progress=progress))


def _pixel(options: Mapping[str, Any], progress: Progress) -> Chapter:
    from neurosim_core.bench.pixel import measure_pixel, pixel_chapter

    return pixel_chapter(measure_pixel(**options, progress=progress))


def _render(options: Mapping[str, Any], progress: Progress) -> Chapter:
    from neurosim_core.bench.render import measure_render, render_chapter

    return render_chapter(measure_render(**options, progress=progress))


def _throughput(options: Mapping[str, Any], progress: Progress) -> Chapter:
    from neurosim_core.bench.throughput import measure_throughput, throughput_chapter

    return throughput_chapter(measure_throughput(**options, progress=progress))


def _worlds(options: Mapping[str, Any], progress: Progress) -> Chapter:
    from neurosim_core.bench.worlds import measure_worlds, worlds_chapter

    return worlds_chapter(measure_worlds(**options, progress=progress))


def _shared_walk(options: Mapping[str, Any], progress: Progress) -> Chapter:
    from neurosim_core.bench.shared_walk import measure_shared_walk, shared_walk_chapter

    return shared_walk_chapter(measure_shared_walk(**options, progress=progress))


def _leave_out(options: Mapping[str, Any], progress: Progress) -> Chapter:
    from neurosim_core.bench.leave_out import leave_out_chapter, measure_leave_out

    return leave_out_chapter(measure_leave_out(**options, progress=progress))


STUDIES: Sequence[Study] = (
    Study(
        name="dynamics",
        help="error against run time of the flight dynamics, and stiff and extreme cases",
        description="Integrate flights by several methods at several step sizes, against a reference; "
        "then what is stiff or extreme.",
        chapter=_dynamics,
    ),
    Study(
        name="events",
        help="error against run time of the events of a flight",
        description="Render a flight at fixed rates and as often as its motion asks for, and compare the "
        "events with those of a far higher rate. By default 64x48 pixels on a CPU, which takes about "
        "5 minutes on two cores, and 346x260 on CUDA.",
        chapter=_events,
        options=frozenset({"scene", "device", "width", "height"}),
    ),
    Study(
        name="pixel",
        help="a test bench of the event pixel: ramp, step, sine, bar, darkness",
        description="Show patterns of light to the models of real event cameras, and compare what they do "
        "with closed forms.",
        chapter=_pixel,
        options=frozenset({"device"}),
    ),
    Study(
        name="render",
        help="error against run time of rendering, and false events from aliasing",
        description="Render with several settings of sampling and filtering, against many samples a pixel; "
        "then pan slowly over a fine checkerboard and count false events. Where --device names one, measure "
        "as well how fast it is (`neurosim bench throughput`, which flies in --scene).",
        chapter=_render,
        options=frozenset({"device"}),
        then="throughput",
    ),
    Study(
        name="throughput",
        help="whole steps a second, where their time goes, and what the device could do",
        description="Fly with an event camera of several sizes, exactly and adaptively, in scenes of up to "
        "two million triangles; split the time of a step; measure its parts alone beside the ceilings of the "
        "device and a naive event camera. Two to five minutes.",
        chapter=_throughput,
        options=frozenset({"scene", "device"}),
    ),
    Study(
        name="shared-walk",
        help="rays that share a walk through the scene's tree: same bits, and how much sooner",
        description="Look at a slow and a fast part of a flight with rays that each walk by themselves, and "
        "with tiles of rays that share walks over 1 to 16 instants; compare bits and events. "
        "By default 346x260 pixels.",
        chapter=_shared_walk,
        options=frozenset({"scene", "device", "width", "height"}),
    ),
    Study(
        name="worlds",
        help="many worlds stepped together for learning: renders a second of all",
        description="Turn on the spot in many worlds with an event camera each, all on the device, and in "
        "single simulations beside it. By default up to 128 worlds on a CPU, which takes two to three "
        "minutes on two cores, and up to 4096 on CUDA.",
        chapter=_worlds,
        options=frozenset({"scene", "device", "width", "height", "worlds", "seconds"}),
    ),
    Study(
        name="leave-out",
        help="what a scene does not need is not computed: kernels, memory, libraries, time",
        description="Count what runs with few and with many sensors and terms launch, allocate and import.",
        chapter=_leave_out,
    ),
)
"""What `neurosim bench all` measures, in this order."""


def _bench_study(study: Study, arguments: argparse.Namespace) -> int:
    from rich.console import Console

    console = Console()
    with handle_signals(signal.default_int_handler):
        parts = _parts(study, arguments)
        if study.then and len(parts) == 1 and getattr(arguments, "scene", None):
            told = f"--scene is not used: it is for the chapter {study.then}, which --device asks for"
            console.print(told, style="yellow", markup=False, highlight=False)
        chapters = [_measure(part, arguments, console) for part in parts]
        _write(chapters, arguments.out, console)
    return _judge(chapters, console, strict=arguments.strict)


def _parts(study: Study, arguments: argparse.Namespace) -> list[Study]:
    """Return a study, and what follows it where a device is named."""
    named = study.then if getattr(arguments, "device", None) else ""
    return [study, *(other for other in STUDIES if other.name == named)]


def _bench_all(arguments: argparse.Namespace) -> int:
    from rich.console import Console

    console = Console()
    chapters: list[Chapter] = []
    status = 0
    with handle_signals(signal.default_int_handler):
        try:
            for number, study in enumerate(STUDIES, 1):
                prefix = f"({number} of {len(STUDIES)}) "
                try:
                    chapter = _measure(study, arguments, console, prefix=prefix)
                except Exception as error:  # whatever it is, it is told, and the other studies go on
                    chapter, status = _failed(study, error, arguments, console), 1
                chapters.append(chapter)
        except KeyboardInterrupt:
            status = 130
    if chapters:
        _write(chapters, arguments.out, console)
        status = status or _judge(chapters, console, strict=arguments.strict)
    return status


def _judge(chapters: Sequence[Chapter], console: Console, *, strict: bool) -> int:
    """Say how many bars are met; return the exit status."""
    verdicts = [bar.met for chapter in chapters for bar in chapter.bars]
    missed = verdicts.count(False)
    said = [f"{missed} missed", f"{verdicts.count(True)} met"]
    if unknown := verdicts.count(None):
        said.append(f"{unknown} not measured here")
    console.print(
        f"bars: {', '.join(said)}", style="bold red" if missed else None, markup=False, highlight=False
    )
    return int(strict and missed > 0)


def _measure(study: Study, arguments: argparse.Namespace, console: Console, *, prefix: str = "") -> Chapter:
    """Measure one thing and print it."""
    from neurosim_core.bench.report import print_chapter

    begin = time.perf_counter()
    with console.status(f"{prefix}{study.name}") as status:
        chapter = study.chapter(
            _options(study, arguments), lambda what: status.update(f"{prefix}{study.name}: {what}")
        )
    chapter = replace(chapter, command=_command(chapter.command, _options(study, arguments)))
    print_chapter(chapter, console)
    console.print(f"{study.name} took {time.perf_counter() - begin:.0f} s\n", style="dim", highlight=False)
    return chapter


def _options(study: Study, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what a study is told: whether to be quick, and what was given of what it takes."""
    given = {name: getattr(arguments, name) for name in study.options}
    return {"quick": arguments.quick, **{name: value for name, value in given.items() if value is not None}}


def _command(said: str, options: Mapping[str, Any]) -> str:
    """Return a chapter's command with the options that were given and that it does not say itself."""
    words = shlex.split(said)
    for name, value in sorted(options.items()):
        option = f"--{name}"
        if name == "quick":
            words += [option] if value and option not in words else []
        elif option not in words:
            words += [option, ",".join(map(str, value)) if isinstance(value, list) else str(value)]
    return shlex.join(words)


def _failed(study: Study, error: Exception, arguments: argparse.Namespace, console: Console) -> Chapter:
    """Say why something could not be measured, and return a chapter of that."""
    from neurosim_core.bench.report import Bar, Chapter

    reason = "".join(traceback.format_exception_only(error)).strip()
    console.print(f"{study.name} failed: {reason}\n", style="bold red", markup=False, highlight=False)
    trace = "".join(traceback.format_exception(error)).replace("```", "'''")
    return Chapter(
        name=study.name,
        title=f"{study.name}: failed",
        summary=f"**This could not be measured.** {study.description}\n\n```\n{trace}```",
        command=_command(f"neurosim bench {study.name}", _options(study, arguments)),
        bars=[Bar(text="it can be measured", measured=reason, met=False)],
    )


def _write(chapters: Sequence[Chapter], folder: Path, console: Console) -> None:
    from neurosim_core.bench.figures import can_draw
    from neurosim_core.bench.report import write_report

    page = write_report(chapters, folder)
    if not can_draw():
        console.print(f"plots are left out: {install_hint('view')}", style="yellow", markup=False)
    console.print(f"left in {folder}: {page.name}, report.md, tables and plots", markup=False, soft_wrap=True)


def _bench_step(arguments: argparse.Namespace) -> int:
    from rich.console import Console

    from neurosim_core.bench.step import measure_steps, print_steps

    times = measure_steps(
        scene=arguments.scene,
        device=arguments.device,
        width=arguments.width,
        height=arguments.height,
        instants=arguments.instants,
        step_count=arguments.steps,
        max_displacement_px=arguments.max_displacement,
    )
    print_steps(times, Console())
    return 0


def _bench_closed_loop(arguments: argparse.Namespace) -> int:
    from rich.console import Console

    from neurosim_core.bench.closed_loop import bench_closed_loop

    with handle_signals(signal.default_int_handler):
        bench_closed_loop(
            arguments.out,
            Console(),
            rates_hz=arguments.rates,
            seconds=arguments.seconds,
            renderer=arguments.renderer,
            width=arguments.width,
            height=arguments.height,
            device=arguments.device,
            scene=arguments.scene,
            settings=read_settings(arguments.settings),
        )
        return 0


def _bench_streaming(arguments: argparse.Namespace) -> int:
    from rich.console import Console

    from neurosim_core.bench.streaming import bench_streaming

    with handle_signals(signal.default_int_handler):
        bench_streaming(
            arguments.out,
            Console(),
            seconds=arguments.seconds,
            width=arguments.width,
            height=arguments.height,
            device=arguments.device,
            scene=arguments.scene,
            sampling_rate_hz=arguments.sampling_rate,
            settings=read_settings(arguments.settings),
        )
        return 0


def _bench_delay(arguments: argparse.Namespace) -> int:
    from rich.console import Console

    from neurosim_core.bench.delay import bench_delay

    with handle_signals(signal.default_int_handler):
        bench_delay(
            arguments.out,
            Console(),
            delays_s=arguments.delays,
            tours=arguments.tours,
            mode=arguments.mode,
            seconds=arguments.seconds,
            real_time_factor=arguments.factor,
            settings=read_settings(arguments.settings),
        )
        return 0
