"""The options of `neurosim bench`: each question takes some of them."""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote


def _numbers(kind: type) -> Callable[[str], tuple[Any, ...]]:
    def read(text: str) -> tuple[Any, ...]:
        try:
            return tuple(kind(part) for part in text.split(","))
        except ValueError:
            what = "whole numbers" if kind is int else "numbers"
            raise argparse.ArgumentTypeError(f"takes {what} with commas between them, got {text!r}") from None

    return read


def _whole(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number, at least 1, got {text}")
    return int(text)


def _paths(text: str) -> tuple[Path, ...]:
    return tuple(Path(part) for part in text.split(","))


def _option(text: str, default: Any = None, **argument: Any) -> Any:
    return field(default=default, metadata={"help": text, **argument})


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of a benchmark; None leaves the choice to the benchmark."""

    quick: bool = _option("short run with rough figures", False, action="store_true")
    scene: Path | None = _option("mesh file; default: a generated scene", type=Path, metavar="FILE")  # noqa: RUF009
    device: str = _option("auto, cpu, cuda:0, ... (default: auto)", default="auto")
    width: int | None = _option("columns of the camera", type=_whole, metavar="PX")
    height: int | None = _option("rows of the camera", type=_whole, metavar="PX")
    samples: tuple[int, ...] | None = _option("rays per pixel", type=_numbers(int), metavar="N,...")
    seconds: float | None = _option("duration of each case [s]", type=float, metavar="S")
    worlds: tuple[int, ...] | None = _option("numbers of worlds", type=_numbers(int), metavar="N,...")
    instants: int = _option("renders per launch (default: 16)", 16, type=_whole, metavar="K")
    steps: int = _option("steps per repetition (default: 1600)", 1600, type=_whole, metavar="N")
    max_displacement: float | None = _option(
        "adaptive sampling: largest motion of a point between two renders [px]", type=float, metavar="PX"
    )
    rates: tuple[float, ...] | None = _option(
        "command and image rates [Hz]", type=_numbers(float), metavar="HZ,..."
    )
    renderer: str = _option(
        "synthetic: a test pattern, to measure all but rendering; warp: the scene (default: synthetic)",
        "synthetic",
        choices=["synthetic", "warp"],
    )
    sampling_rate: float | None = _option(
        "renders of the event camera a second (default: 25, on a GPU 500)", type=float, metavar="HZ"
    )
    delays: tuple[float, ...] | None = _option(
        "sleeps of the controller before commands [s]", type=_numbers(float), metavar="S,..."
    )
    tours: int | None = _option("number of paths to fly", type=int, metavar="N")
    mode: str = _option(
        "type of command (default: velocity)", "velocity", choices=["motor_speeds", "velocity", "position"]
    )
    logs: tuple[Path, ...] | None = _option(
        "logs of flights: time [s], accelerometer [g], gyroscope [deg/s], commands of four motors [PWM]",
        type=_paths,
        metavar="FILE,...",
    )
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Further settings by dotted key."""
    progress: Callable[[str], None] = field(default=lambda _: None, repr=False)
    """Is told what is measured next."""
    stages: Path | None = None
    """Folder of what has been measured before the chapter is complete; None: it is not kept."""

    def stage(self, name: str, measure: Callable[[], Any]) -> Any:
        """Return what a stage of a question finds, or what an interrupted run with these options left of it.

        What it finds is something that JSON has, or numbers of NumPy.
        """
        if self.stages is None:
            return measure()
        file = self.stages / f"{quote(name, safe=' ')}.json"
        asked = repr(dataclasses.replace(self, stages=None))
        if file.exists():
            options, found = json.loads(file.read_text(encoding="utf-8"))
            if options == asked:
                return found
        found = measure()
        self.stages.mkdir(parents=True, exist_ok=True)
        written = file.with_suffix(".tmp")
        written.write_text(json.dumps([asked, found], default=lambda number: number.item()), encoding="utf-8")
        written.replace(file)
        return found


def add_option(parser: argparse.ArgumentParser, name: str) -> None:
    """Let a command take an option, a field of `Options`."""
    (found,) = (field for field in dataclasses.fields(Options) if field.name == name)
    parser.add_argument(f"--{name.replace('_', '-')}", default=found.default, **found.metadata)
