"""The command `neurosim bench`: which questions there are, and what each takes.

A question is a module of this package. Its function `measure` takes `options.Options` and returns a
`report.Chapter`. What measures is imported when it is asked for.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import neurosim_core
from neurosim_core.bench.options import Options, add_option
from neurosim_core.overrides import add_set_option, read_settings
from neurosim_core.signals import handle_signals

if TYPE_CHECKING:
    from rich.console import Console

    from neurosim_core.bench.report import Chapter


@dataclass(frozen=True)
class Question:
    """A question that one module answers with one chapter."""

    name: str
    help: str
    options: tuple[str, ...] = ()
    """Fields of `Options` that it takes besides `quick`."""
    in_all: bool = True
    """Whether `bench all` asks it: those with processes in real time want a machine for themselves."""

    def measure(self, options: Options) -> Chapter:
        """Return the answer."""
        module = importlib.import_module(f"neurosim_core.bench.{self.name.replace('-', '_')}")
        chapter: Chapter = module.measure(options)
        return chapter


_VIEW = ("scene", "device", "width", "height")
_STEPS = ("instants", "steps", "max_displacement", "samples")
_LOOP = ("rates", "renderer", "seconds", "settings")
_STREAM = ("sampling_rate", "seconds", "settings")
_DELAY = ("delays", "tours", "mode", "seconds", "settings")

QUESTIONS: Sequence[Question] = (
    Question("dynamics", "error against run time of the flight dynamics, and stiff and extreme flights"),
    Question("replay", "recorded flights of a Crazyflie compared with the vehicle model", ("logs",), False),
    Question("events", "error against run time, over renders a second and rays", (*_VIEW, "samples")),
    Question("pixel", "a test bench of the event pixel: ramp, step, sine, noise of the presets", ("device",)),
    Question("render", "error against run time of rendering", ("scene", "device", "samples")),
    Question("throughput", "whole steps a second, and the time of each part", ("scene", "device", "samples")),
    Question("worlds", "renders a second of many worlds stepped together", (*_VIEW, "worlds", "seconds")),
    Question("data", "windows a second from a recording, for learning"),
    Question("leave-out", "kernels, memory, libraries and time that unused terms save"),
    Question("step", "whole steps a second with one event camera", (*_VIEW, *_STEPS), False),
    Question("closed-loop", "latency from command to image between processes", (*_VIEW, *_LOOP), False),
    Question("streaming", "an IMU beside an event camera in real time", (*_VIEW, *_STREAM), False),
    Question("delay", "a slow controller compared with the same delay simulated in lockstep", _DELAY, False),
)
"""All questions; `bench all` asks in this order."""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `bench` to the commands of `neurosim`."""
    parser = commands.add_parser("bench", help="measure speed and error on this machine")
    names = parser.add_subparsers(required=True, metavar="WHAT")
    for question in QUESTIONS:
        _add(names.add_parser(question.name, help=question.help, description=question.help), [question])
    asked = [question for question in QUESTIONS if question.in_all]
    text = f"{', '.join(question.name for question in asked)} in one report"
    more = "; if a chapter fails, the others still run, and the exit status is 1"
    _add(names.add_parser("all", help=text, description=text + more), asked, folder="report")


def _add(parser: argparse.ArgumentParser, questions: list[Question], folder: str = "") -> None:
    folder = folder or questions[0].name
    parser.add_argument("--out", default=folder, metavar="DIR", help=f"folder of the results (./{folder})")
    parser.add_argument("--json", action="store_true", help="print the chapters as JSON only")
    parser.add_argument("--resume", action="store_true", help="keep what is already in --out")
    parser.add_argument("--strict", action="store_true", help="exit with status 1 if a claim is missed")
    for option in dict.fromkeys(option for question in questions for option in ("quick", *question.options)):
        if option == "settings":
            add_set_option(parser, "any further setting by its dotted key, such as scene.rooms=2")
        else:
            add_option(parser, option)
    parser.set_defaults(command=lambda arguments: _bench(questions, arguments))


def _bench(questions: Sequence[Question], arguments: argparse.Namespace) -> int:
    """Answer questions in turn, leave each chapter at once, and return the exit status."""
    from rich.console import Console

    from neurosim_core.bench.render_report import write_report
    from neurosim_core.bench.report import chapter_to_json

    console = Console(stderr=arguments.json)
    chapters: list[Chapter] = []
    status = 0
    with handle_signals(signal.default_int_handler):
        try:
            for number, question in enumerate(questions, 1):
                prefix = f"({number} of {len(questions)}) " if len(questions) > 1 else ""
                try:
                    chapter = _answer(question, arguments, console, prefix)
                except Exception as error:
                    if len(questions) == 1:
                        raise
                    chapter, status = _failed(question, error, console), 1
                chapters.append(chapter)
                write_report(chapters, arguments.out, console)
                shutil.rmtree(_stages(question, arguments), ignore_errors=True)
        except KeyboardInterrupt:
            console.print("interrupted; the same command with --resume goes on", style="yellow")
            status = 130
    if arguments.json:
        sys.stdout.write("[" + ",\n".join(map(chapter_to_json, chapters)) + "]\n")
    verdicts = [claim.met for chapter in chapters for claim in chapter.claims]
    missed, met, unknown = (verdicts.count(verdict) for verdict in (False, True, None))
    if verdicts:
        said = f"claims: {missed} missed, {met} met, {unknown} not measured here"
        console.print(said, style="bold red" if missed else None)
    return status or int(arguments.strict and missed > 0)


def _stages(question: Question, arguments: argparse.Namespace) -> Path:
    return Path(arguments.out) / f"{question.name}-stages"


def _answer(question: Question, arguments: argparse.Namespace, console: Console, prefix: str) -> Chapter:
    """Measure and print, or take what an earlier run has left."""
    from neurosim_core.bench.render_report import print_chapter
    from neurosim_core.bench.report import read_chapter

    if arguments.resume and (kept := read_chapter(arguments.out, question.name)):
        console.print(f"{prefix}{question.name}: kept from {arguments.out}", style="dim", soft_wrap=True)
        return kept
    given = {name: getattr(arguments, name) for name in ("quick", *question.options)}
    if "settings" in given:
        given["settings"] = read_settings(given["settings"])
    stages = _stages(question, arguments)
    if not arguments.resume:
        shutil.rmtree(stages, ignore_errors=True)
    facts, begin_s = describe_machine(), time.monotonic()
    with console.status(f"{prefix}{question.name}") as line:

        def tell(what: str) -> None:
            line.update(f"{prefix}{question.name}, {time.monotonic() - begin_s:.0f} s: {what}")

        chapter = question.measure(Options(**given, progress=tell, stages=stages))
    facts["took"] = f"{time.monotonic() - begin_s:.0f} s"
    chapter = replace(chapter, facts=facts)
    if not arguments.json:
        print_chapter(chapter, console)
    console.print(f"{prefix}{question.name} took {facts['took']}\n", style="dim", highlight=False)
    return chapter


def _failed(question: Question, error: Exception, console: Console) -> Chapter:
    """Say why a question has no answer, and return a chapter of that."""
    from neurosim_core.bench.report import Chapter, Claim

    reason = "".join(traceback.format_exception_only(error)).strip()
    console.print(f"{question.name} failed: {reason}\n", style="bold red", markup=False, highlight=False)
    return Chapter(
        name=f"{question.name}-failed",
        title=f"{question.name}: failed",
        summary="This could not be measured.\n\n" + "".join(traceback.format_exception(error)),
        claims=[Claim("it can be measured", "this command", reason, False)],
    )


def describe_machine() -> dict[str, str]:
    """Return date, command, processor, devices and versions: term -> text."""
    import warp as wp

    load = " ".join(f"{value:.2f}" for value in os.getloadavg())
    libraries = ("numpy", "scipy", "warp-lang")
    versions = {
        "Neurosim": " ".join(filter(None, (neurosim_core.__version__, _commit()))),
        "Python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in libraries},
    }
    facts = {
        "date": f"{datetime.now().astimezone():%Y-%m-%d %H:%M %Z}",
        "command": shlex.join([Path(sys.argv[0]).name or "python", *sys.argv[1:]]),
        "machine": f"{os.cpu_count()} cores, {_processor()}, {platform.system()}, load {load}",
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
    }
    if devices := [str(device.name) for device in wp.get_cuda_devices()]:
        facts["CUDA devices"] = ", ".join(devices)
    return facts


def _commit() -> str:
    """Return the commit of the checkout that this program runs from; empty where there is none."""
    root = Path(neurosim_core.__file__).resolve().parent.parent
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=10.0)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def _processor() -> str:
    """Return the name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
