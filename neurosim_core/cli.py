"""The command `neurosim`; `neurosim --help` lists what it does."""

from __future__ import annotations

import argparse
import atexit
import contextlib
import faulthandler
import gc
import importlib
import logging
import os
import re
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias

from neurosim_core import __version__
from neurosim_core.garbage import no_collection
from neurosim_core.overrides import add_settings, load_settings, settings_of
from neurosim_core.signals import INTERRUPTED_LINE, handle_signals, leave_at_once, raise_at_signals

if TYPE_CHECKING:
    from neurosim_core.config import SimulationConfig
    from neurosim_core.scene.reader import SceneReader

    _Commands: TypeAlias = argparse._SubParsersAction[argparse.ArgumentParser]


_PIPED_COLUMNS = 120


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status: 0 done, 1 failed, 2 wrong use, 130 interrupted."""
    with handle_signals(leave_at_once):  # commands with something to close have handlers of their own
        return _run_command(argv)


def _run_command(argv: Sequence[str] | None) -> int:
    gc.set_threshold(200_000, 10, 10)  # what imports make stays: to look after every 700 objects takes 0.4 s
    atexit.register(gc.freeze)  # a last collection looks at every object again: 0.4 s with a scene in memory
    if not faulthandler.is_enabled():
        with contextlib.suppress(ValueError, OSError, RuntimeError):  # standard error may be no file
            faulthandler.enable()  # a crash of native code says where it was
    if not sys.stdout.isatty():
        os.environ.setdefault("COLUMNS", str(_PIPED_COLUMNS))  # rich would take 80
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "true")  # it would look through all that is installed
    began_s = time.perf_counter()
    argv = sys.argv[1:] if argv is None else argv
    arguments = _parser(argv).parse_args(argv)
    if not arguments.many_blas_threads:  # matrices are small, and threads cost time; learning has large ones
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    arguments.began_s = began_s
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    try:
        if arguments.computes:
            from neurosim_core.warp_start import start_warp

            start_warp()
        return int(arguments.command(arguments))
    except (ValueError, OSError, ImportError, RuntimeError, ArithmeticError) as error:
        if arguments.debug:
            raise
        print(f"neurosim: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(INTERRUPTED_LINE, file=sys.stderr)
        return 130


class _Parser(argparse.ArgumentParser):
    """Takes no abbreviations of options: what `--ou` means may change with the next option.

    A wrong word is answered in one line, with the word that is most like it.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**{**options, "allow_abbrev": False})

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Refuse unknown options here, where it is known which command they were given to."""
        parsed, unknown = super().parse_known_args(args, namespace)
        if unknown:
            from neurosim_core.config_errors import suggestion

            options = [option for action in self._actions for option in action.option_strings]
            hint = suggestion(unknown[0].partition("=")[0], options) if unknown[0].startswith("-") else ""
            self.error(f"unrecognized arguments: {' '.join(unknown)}; {hint}")
        return parsed, unknown

    def error(self, message: str) -> NoReturn:
        """Say in one line what is wrong and where to read on; exit with 2."""
        wrong = re.search(r"invalid choice: '?([^' ]*)'? \(choose from (.*)\)", message)
        if wrong:
            from neurosim_core.config_errors import suggestion

            message += f"; {suggestion(wrong[1], re.findall(r'[^ ,]+', wrong[2].replace(chr(39), '')))}"
        message = message.rstrip("; ")
        stop = "" if message.endswith("?") else ";"
        self.exit(2, f"{self.prog}: {message}{stop} `{self.prog} --help` lists what there is\n")


def _parser(argv: Sequence[str] = ()) -> argparse.ArgumentParser:
    """Return a parser of all commands; if `argv` begins with one of this module, of those alone."""
    parser: argparse.ArgumentParser = _Parser(
        prog="neurosim",
        description="Event cameras, RGB, depth and IMU on agile multirotors.",
    )
    parser.set_defaults(computes=True, many_blas_threads=False)
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser.add_argument("--version", action="version", version=f"neurosim {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for add in (_add_run, _add_serve, _add_fly, _add_up, _add_call, _add_top, _add_scene, _add_view):
        add(commands)
    if argv and argv[0] in commands.choices:
        return parser
    from neurosim_core.bench import commands as bench  # with the others 0.03 s
    from neurosim_core.convert import command as convert
    from neurosim_core.data import command as dataset
    from neurosim_core.fit import command as fit
    from neurosim_core.learn import command as learn

    convert.add_parser(commands)
    dataset.add_parser(commands)
    dataset.add_compare_parser(commands)
    fit.add_parser(commands)
    bench.add_parser(commands)
    learn.add_parsers(commands)
    return parser


def _add_run(commands: _Commands) -> None:
    run = commands.add_parser("run", help="fly, record, and draw an overview")
    add_settings(run)
    _add_print_config(run)
    run.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of the flight (default: ./flight, flight-2, ...)"
    )
    run.add_argument("--overwrite", action="store_true", help="replace a flight that is already in --out")
    run.add_argument("--no-rrd", action="store_true", help="leave out flight.rrd")
    run.set_defaults(command=_run, computes=False)  # it starts Warp itself


def _add_serve(commands: _Commands) -> None:
    serve = commands.add_parser("serve", help="simulate for controllers in other processes, over Cortex")
    add_settings(serve)
    _add_live(serve)
    serve.set_defaults(command=_serve, computes=False)  # it starts Warp itself


def _add_fly(commands: _Commands) -> None:
    fly = commands.add_parser("fly", help="run the controller that follows the path, in its own process")
    add_settings(fly, default="those of the simulator")
    fly.add_argument("--vehicle", metavar="NAME", help="vehicle to fly (default: all)")
    fly.add_argument(
        "--mode",
        default="motor_speeds",
        choices=["motor_speeds", "velocity", "position"],
        help="type of command (default: motor_speeds)",
    )
    fly.add_argument(
        "--delay", type=float, default=0.0, metavar="S", help="sleep before every command, to test delay [s]"
    )
    fly.add_argument(
        "--policy",
        metavar="NAME",
        help="fly a throw with a trained policy in this process, without a simulator: hover, or a .onnx file",
    )
    fly.add_argument(
        "--save",
        type=Path,
        metavar="FILE",
        help="--policy: write a recording (.h5) or an animation (.webp, .gif) of the flight",
    )
    fly.set_defaults(command=_fly)


def _add_up(commands: _Commands) -> None:
    up = commands.add_parser("up", help="run simulator, controller and viewer together; Ctrl-C ends all")
    add_settings(up)
    _add_live(up)
    up.add_argument(
        "--viewer",
        default="auto",
        metavar="HOW",
        help="native, web, none, or a .rrd file; auto: native where there is a display, else web",
    )
    up.add_argument(
        "--web",
        action="store_const",
        dest="viewer",
        const="web",
        help="as --viewer web: a page with the viewer, and buttons that pause, step and reset the run",
    )
    up.set_defaults(command=_up)


def _add_call(commands: _Commands) -> None:
    call = commands.add_parser("call", help="control a running simulator: reset, step, pause, resume, set")
    requests = call.add_subparsers(required=True, metavar="WHAT", dest="what")
    reset = requests.add_parser("reset", help="restart at stamp 0")
    reset.add_argument("--seed", type=int, help="seed of all noise (default: as configured)")
    reset.add_argument("--vehicle", default="", metavar="NAME", help="vehicle that starts elsewhere")
    reset.add_argument(
        "--position", type=float, nargs=3, metavar=("X", "Y", "Z"), help="start in the world [m]"
    )
    step = requests.add_parser("step", help="advance a paused run by some control periods")
    step.add_argument("count", type=int, nargs="?", default=1, help="number of control periods (default: 1)")
    requests.add_parser("pause", help="pause simulated time")
    requests.add_parser("resume", help="resume simulated time")
    change = requests.add_parser("set", help="change settings of the run")
    change.add_argument(
        "settings", nargs="+", metavar="KEY=VALUE", help="such as links.command.latency_s=0.008"
    )
    requests.add_parser("status", help="print the status of the run")
    for request in requests.choices.values():
        request.add_argument("--timeout", type=float, default=10.0, metavar="S", help="longest wait [s]")
    call.set_defaults(command=_call, computes=False)


def _add_top(commands: _Commands) -> None:
    top = commands.add_parser(
        "top", help="watch a running simulator: real-time factor, rates, losses, latency"
    )
    top.add_argument("--once", action="store_true", help="print once, and exit")
    top.add_argument(
        "--timeout", type=float, default=10.0, metavar="S", help="longest wait for a simulator [s]"
    )
    top.set_defaults(command=_top, computes=False)


def _add_scene(commands: _Commands) -> None:
    scene = commands.add_parser("scene", help="summarise a scene file, and draw it")
    scene.add_argument("file", type=Path, help="glTF, GLB, OBJ, PLY or STL")
    scene.add_argument("--out", type=Path, metavar="PNG", help="picture to write (default: NAME.png)")
    scene.set_defaults(command=_scene)


def _add_view(commands: _Commands) -> None:
    view = commands.add_parser("view", help="show a running simulator, or a recorded flight, in Rerun")
    view.add_argument(
        "flight",
        nargs="?",
        type=Path,
        help="folder of `neurosim run`, a flight.h5, or a file of events; default: the running simulator",
    )
    view.add_argument("--web", action="store_true", help="show it in a browser instead of a window")
    view.add_argument(
        "--save",
        type=Path,
        metavar="FILE",
        help="write a Rerun file (.rrd), or of a flight an animation (.webp, .gif), instead of a window",
    )
    view.add_argument(
        "--only", metavar="NAMES", help="live: show only these sensors, such as events,imu; others stay off"
    )
    view.add_argument(
        "--event-window",
        type=float,
        default=0.02,
        metavar="S",
        help="event window of a picture [s] (default: 0.02)",
    )
    view.add_argument(
        "--image-rate",
        type=float,
        default=15.0,
        metavar="HZ",
        help="live: largest image rate of a sensor [Hz] (default: 15); events have a separate limit",
    )
    view.add_argument("--port", type=int, default=0, help="--web: port of the page (default: any)")
    view.add_argument("--no-browser", action="store_true", help="--web: print the address only")
    view.set_defaults(command=_view)


def _add_print_config(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--print-config", action="store_true", help="print the settings as commented YAML, and exit"
    )


def _add_live(parser: argparse.ArgumentParser) -> None:
    """Options of a simulator besides its settings."""
    _add_print_config(parser)
    parser.add_argument(
        "--lockstep", action="store_true", help="wait for the command of every control period"
    )
    parser.add_argument(
        "--factor", type=float, metavar="F", help="real-time factor; 0: as fast as possible (default: 1)"
    )
    parser.add_argument("--record", type=Path, metavar="DIR", help="record everything to DIR/flight.h5")
    parser.add_argument("--overwrite", action="store_true", help="replace a flight that is already there")


def _run(arguments: argparse.Namespace) -> int:
    if arguments.print_config:
        return _print_config(load_settings(arguments))
    with _prepare(arguments, "neurosim_core.flight") as (config, reader):
        from neurosim_core.flight import fly, new_folder

        folder = new_folder(arguments.out, overwrite=arguments.overwrite)
        report = fly(config, folder, rerun=not arguments.no_rrd, began_s=arguments.began_s, reader=reader)
    return 130 if report.interrupted else 0


@contextlib.contextmanager
def _prepare(arguments: argparse.Namespace, module: str) -> Iterator[tuple[SimulationConfig, SceneReader]]:
    """Import a module, while processes read the scene and prepare to plan; give settings and reader."""
    from neurosim_core.path_process import PlanningProcess, may_need_planning
    from neurosim_core.scene.reader import SceneReader
    from neurosim_core.settings_file import unchecked_settings

    settings = unchecked_settings(arguments.config, settings_of(arguments))
    planning = PlanningProcess() if may_need_planning(settings) else contextlib.nullcontext()
    with planning as planner, SceneReader(settings, planner=planner) as reader:
        from rich.console import Console

        with (
            no_collection(),
            Console(stderr=True).status("preparing: libraries"),  # on the screen before they are there
            ThreadPoolExecutor(max_workers=1) as aside,
        ):
            from neurosim_core.warp_start import start_device

            aside.submit(start_device, settings.get("device", "auto"))  # `make_model` reports errors
            config = load_settings(arguments)
            importlib.import_module(module)
        yield config, reader


def _print_config(config: SimulationConfig) -> int:
    from neurosim_core.config import to_yaml

    print(to_yaml(config, comments=True), end="")
    return 0


def _serve(arguments: argparse.Namespace) -> int:
    if arguments.print_config:
        return _print_config(load_settings(arguments))
    with _prepare(arguments, "neurosim_core.live.serve") as (config, reader):
        from neurosim_core.live.serve import serve

        return serve(config, record=arguments.record, overwrite=arguments.overwrite, reader=reader)


def _fly(arguments: argparse.Namespace) -> int:
    if arguments.policy is not None:
        from neurosim_core.learn.command import fly_policy

        return fly_policy(arguments, settings_of(arguments))
    if arguments.save is not None:
        raise ValueError("--save goes with --policy; `neurosim serve --record DIR` records other flights")
    from neurosim_core.live.controller import fly

    config = load_settings(arguments) if arguments.config is not None or settings_of(arguments) else None
    return fly(config, vehicle=arguments.vehicle, mode=arguments.mode, delay_s=arguments.delay)


def _up(arguments: argparse.Namespace) -> int:
    config = load_settings(arguments)
    if arguments.print_config:
        return _print_config(config)
    from neurosim_core.live.up import up

    return up(config, viewer=arguments.viewer, record=arguments.record, overwrite=arguments.overwrite)


def _call(arguments: argparse.Namespace) -> int:
    from neurosim_core.live.call import call

    with raise_at_signals():
        return call(arguments)


def _top(arguments: argparse.Namespace) -> int:
    from neurosim_core.live.call import top

    return top(once=arguments.once, timeout_s=arguments.timeout)


def _scene(arguments: argparse.Namespace) -> int:
    from neurosim_core.scene.report import report_scene

    report_scene(arguments.file, arguments.out)
    return 0


def _view(arguments: argparse.Namespace) -> int:
    kinds = (".rrd",) if arguments.flight is None else (".rrd", ".webp", ".gif")
    if arguments.save is not None and arguments.save.suffix not in kinds:
        what = "a live run as .rrd" if arguments.flight is None else "a flight as .rrd, .webp or .gif"
        raise ValueError(f"--save writes {what}, got {arguments.save}")
    if arguments.flight is None:
        from neurosim_core.live.viewer import view

        return view(
            web=arguments.web and arguments.save is None,
            save=arguments.save,
            only=None if arguments.only is None else arguments.only.split(","),
            event_window_s=arguments.event_window,
            image_rate_hz=arguments.image_rate,
            port=arguments.port,
            open_browser=not arguments.no_browser,
        )
    from neurosim_core.flight import check_recorded, recorded_file, rerun_file

    if arguments.save is not None and arguments.save.suffix != ".rrd":
        from neurosim_core.view.animation import save_animation

        check_recorded(arguments.flight)
        save_animation(recorded_file(arguments.flight), arguments.save)
        print(f"wrote {arguments.save}")
        return 0
    file = rerun_file(arguments.flight, save=arguments.save)
    if arguments.save is not None:
        print(f"wrote {file}")
        return 0
    from neurosim_core.view.rerun_viewer import show_file

    return show_file(file, web=arguments.web, port=arguments.port, open_browser=not arguments.no_browser)
