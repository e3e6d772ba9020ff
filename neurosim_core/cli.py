"""The command `neurosim`: run | scene | view | bench."""

from __future__ import annotations

import argparse
import logging
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from neurosim_core import __version__


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status: 0 done, 1 failed, 2 wrong use, 130 interrupted."""
    arguments = _parser().parse_args(argv)
    _start_warp()
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    try:
        return int(arguments.command(arguments))
    except (ValueError, OSError, ImportError, RuntimeError, ArithmeticError) as error:
        print(f"neurosim: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("neurosim: interrupted", file=sys.stderr)
        return 130


def _start_warp() -> None:
    """Start Warp without its lines about modules, and about a GPU on a machine that has none.

    The latter is written by native code straight to the standard error stream: the stream is held back while
    Warp starts, and what else was written to it is written again.
    """
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    sys.stderr.flush()
    stderr = os.dup(2)
    with tempfile.TemporaryFile() as held:
        os.dup2(held.fileno(), 2)
        try:
            wp.init()  # type: ignore[no-untyped-call]
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
        held.seek(0)
        lines = held.read().decode(errors="replace").splitlines(keepends=True)
    sys.stderr.write("".join(line for line in lines if "NVIDIA CUDA driver" not in line))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="neurosim",
        description="Event cameras, RGB, depth and IMU on agile multirotors.",
    )
    parser.add_argument("--version", action="version", version=f"neurosim {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="fly, record, and draw a picture of it")
    run.add_argument(
        "config", nargs="?", type=Path, help="settings file (YAML); default: a generated apartment"
    )
    run.add_argument("--duration", type=float, metavar="S", help="simulated time [s]")
    run.add_argument("--seed", type=int, help="seed of the sensor noise")
    run.add_argument("--device", help="auto, cpu, cuda:0, ...")
    run.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
                     help="any setting by its dotted key, such as scene.seed=3; may be repeated")  # fmt: skip
    run.add_argument(
        "--out", type=Path, metavar="DIR", help="where to leave the flight (default: ./flight, flight-2, ...)"
    )
    run.add_argument("--overwrite", action="store_true", help="replace a flight that is already in --out")
    run.add_argument("--no-rrd", action="store_true", help="leave out flight.rrd")
    run.add_argument(
        "--print-config", action="store_true", help="print the settings as commented YAML, and stop"
    )
    run.set_defaults(command=_run)

    scene = commands.add_parser("scene", help="say what is in a scene file, and draw it")
    scene.add_argument("file", type=Path, help="glTF, GLB, OBJ, PLY or STL")
    scene.add_argument(
        "--out", type=Path, metavar="PNG", help="where to leave the picture (default: NAME.png)"
    )
    scene.set_defaults(command=_scene)

    view = commands.add_parser("view", help="look at a flight in Rerun")
    view.add_argument("flight", type=Path, help="folder that `neurosim run` left, or a flight.h5")
    view.add_argument("--web", action="store_true", help="show it in a browser instead of a window")
    view.add_argument(
        "--save", type=Path, metavar="RRD", help="write the Rerun file instead of opening a window"
    )
    view.set_defaults(command=_view)

    bench = commands.add_parser("bench", help="measure speed on this machine")
    bench.add_argument("what", choices=["step"], help="step: whole steps a second with one event camera")
    bench.add_argument(
        "--scene", type=Path, metavar="FILE", help="mesh file; default: the generated apartment"
    )
    bench.add_argument("--device", default="auto", help="auto, cpu, cuda:0, ...")
    bench.add_argument("--width", type=int, default=640, metavar="PX", help="columns of the event camera")
    bench.add_argument("--height", type=int, default=480, metavar="PX", help="rows of the event camera")
    bench.add_argument("--instants", type=int, default=16, metavar="K", help="renders per launch")
    bench.add_argument(
        "--steps", type=int, default=1600, metavar="N", help="renders per repetition (of five)"
    )
    bench.set_defaults(command=_bench)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    from neurosim_core.config import load_config, to_yaml

    overrides: dict[str, Any] = {}
    for setting in arguments.settings:
        key, separator, text = setting.partition("=")
        if not separator or not key:
            raise ValueError(f"--set takes KEY=VALUE, got {setting!r}")
        overrides[key] = yaml.safe_load(text)
    for key, value in (
        ("duration_s", arguments.duration),
        ("seed", arguments.seed),
        ("device", arguments.device),
    ):
        if value is not None:
            overrides[key] = value
    config = load_config(arguments.config, overrides=overrides)
    if arguments.print_config:
        print(to_yaml(config, comments=True), end="")
        return 0

    from neurosim_core.flight import fly, new_folder

    folder = new_folder(arguments.out, overwrite=arguments.overwrite)
    report = fly(config, folder, rerun=not arguments.no_rrd)
    return 130 if report.interrupted else 0


def _scene(arguments: argparse.Namespace) -> int:
    from neurosim_core.scene.report import report_scene

    report_scene(arguments.file, arguments.out)
    return 0


def _bench(arguments: argparse.Namespace) -> int:
    from rich.console import Console

    from neurosim_core.bench.step import measure_steps, print_steps

    times = measure_steps(
        scene=arguments.scene,
        device=arguments.device,
        width=arguments.width,
        height=arguments.height,
        instants=arguments.instants,
        step_count=arguments.steps,
    )
    print_steps(times, Console())
    return 0


def _view(arguments: argparse.Namespace) -> int:
    from neurosim_core.flight import rerun_file

    file = rerun_file(arguments.flight, save=arguments.save)
    if arguments.save is not None:
        print(f"wrote {file}")
        return 0
    beside = str(Path(sys.executable).parent)  # a virtual environment need not be active
    viewer = shutil.which("rerun", path=os.pathsep.join([beside, *os.get_exec_path()]))
    if viewer is None:
        raise ImportError("the Rerun viewer is not installed: pip install 'neurosim[view]'")
    options = ["--web-viewer", "--bind", "127.0.0.1"] if arguments.web else []
    return subprocess.run([viewer, str(file), *options], check=False).returncode
