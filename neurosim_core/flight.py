"""A flight as a user asks for it: fly, record, draw, and say what happened."""

from __future__ import annotations

import contextlib
import functools
import itertools
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
import yaml
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from neurosim_core import __version__
from neurosim_core.config import SimulationConfig, as_config, load_config, to_yaml
from neurosim_core.flight_report import FlightReport, print_plan, print_report
from neurosim_core.packets import Events, Packet
from neurosim_core.record import Recording, RecordingHeader, RecordingWriter, describe_sensors
from neurosim_core.scene.bodies import make_bodies
from neurosim_core.scene.reader import SceneReader
from neurosim_core.signals import stop_at_signals
from neurosim_core.sim.model import Model, make_model
from neurosim_core.sim.rollout import run_model, warm_flight
from neurosim_core.sim.state import make_state
from neurosim_core.sinks import SinkConfig, Sinks
from neurosim_core.warp_start import has_kernels


def new_folder(out: Path | None, *, overwrite: bool = False) -> Path:
    """Return the folder for a new flight; `fly` makes it once there is something to put in it.

    `out`: where the user wants it; None: ./flight, or ./flight-2, ... if there is one already. `overwrite`:
    replace a flight that is already in `out`.
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
    config: SimulationConfig | Mapping[str, Any] | str | Path | None,
    folder: str | Path,
    *,
    rerun: bool = True,
    console: Console | None = None,
    began_s: float | None = None,
    reader: SceneReader | None = None,
) -> FlightReport:
    """Fly a configuration, hand its packets to its sinks, and leave config.yaml and their files in a folder.

    By default these are flight.h5, flight.rrd and overview.png. What cannot be written because an extra is
    not installed is left out, and said. When the disk is nearly full, flight.rrd is given up, which can be
    made again from flight.h5. When flight.h5 cannot grow any more, the flight ends, and the report says up to
    when it is kept.

    Args:
        config: What `load_config` returns or accepts.
        folder: Where to leave the flight; made if need be.
        rerun: Write flight.rrd, if that is among the sinks.
        console: Where to print; standard output if None.
        began_s: When the command began, as `time.perf_counter` says; None: now.
        reader: Reads the scene in another process; None: it is read here.

    Raises:
        DynamicsError: The integration failed; the recording holds everything up to there.
        OSError: The folder cannot be written to, or the disk is full.
        Exception: What a controller, sensor or sink of another package raises; the files hold all before.
    """
    config = as_config(config)
    folder = Path(folder)
    console = console or Console(soft_wrap=not sys.stdout.isatty())  # no lines broken in a pipe
    report = FlightReport()
    begin = time.perf_counter()
    began_s = begin if began_s is None else began_s
    report.libraries_s = begin - began_s
    sinks = {name: sink for name, sink in config.sinks.items() if rerun or sink.kind != "rerun"}
    for name, sink in sinks.items():
        sink.check(name, config.sensors)
    for sink in sinks.values():
        sink.prepare()
    if not has_kernels():
        console.print(
            "first flight here: its kernels are compiled, which takes 10 s to a minute, and kept in "
            f"{wp.config.kernel_cache_dir}",
            highlight=False,
        )
    with _new_folder(folder), console.status("preparing") as status:
        model = make_model(
            config,
            reader=reader,
            on_phase=lambda phase: status.update(f"preparing: {phase}"),
            meanwhile=functools.partial(_load, sinks=sinks),
        )
        status.update("preparing: kernels (compiled once, then kept)")
        state = make_state(model)
        packets = run_model(model, state)
        first = next(packets, None)  # builds all kernels; there is none without sensors
        report.setup_s = time.perf_counter() - began_s
        (folder / "config.yaml").write_text(to_yaml(config, comments=True), encoding="utf-8")
    report.setup_wall_s = dict(state.wall_s)
    print_plan(console, model)

    sees_events = any(issubclass(sensor.packet_class, Events) for sensor in config.sensors.values())
    stop = threading.Event()
    begin = time.perf_counter()

    def say(text: str) -> None:
        console.print(text, style="yellow", markup=False, soft_wrap=True)

    on_stop: list[Callable[[], object]] = []
    context = {
        "folder": folder,
        "stem": "flight",
        "model": model,
        "header": header_of(model),
        "begin_s": begin,
    }
    with (
        stop_at_signals(stop, on_stop=lambda: [stop_waiting() for stop_waiting in on_stop]),
        Sinks(sinks, say=say, on_stop=on_stop, **context) as files,
    ):
        try:
            with _progress(console) as progress:
                task = progress.add_task("flying", total=model.duration_ns, rate="", factor="")
                for packet in packets if first is None else itertools.chain([first], packets):
                    if stop.is_set():
                        report.interrupted = True
                        break
                    files.write(packet)
                    report.note(packet)
                    report.flight_s = time.perf_counter() - begin
                    if packet.stamp_ns > report.simulated_ns:
                        report.simulated_ns = packet.stamp_ns
                        progress.update(
                            task,
                            completed=packet.stamp_ns,
                            rate=f"{report.event_count / report.simulated_ns * 1e3:.2f} M events/s"
                            if sees_events
                            else "",
                            factor=f"{report.real_time_factor:.2f} x real time",
                        )
        except Exception as error:  # raised again; it may be that of an outside controller or sink
            report.failure = error
        report.flight_s = time.perf_counter() - begin
        try:
            files.close()
        except Exception as error:
            report.failure = report.failure or error
    report.closing_s = time.perf_counter() - begin - report.flight_s
    print_report(console, model, state, report, folder)
    if report.failure is not None:
        raise report.failure
    return report


def rerun_file(flight: Path, *, save: Path | None = None) -> Path:
    """Return the Rerun file of a flight; write it from the recording if there is none, or to `save` if given.

    `flight`: the folder that `fly` left, its flight.h5 or flight.rrd, or any file or folder of events.
    """
    from neurosim_core.io.transfer import as_recording
    from neurosim_core.view.rerun_log import RerunLogger
    from neurosim_core.view.rerun_sdk import RerunStream
    from neurosim_core.view.rerun_shapes import scene_shapes

    recorded = recorded_file(flight)
    # events.raw and events.csv may be different events: each has a Rerun file of its own
    is_flight = recorded.suffix in (".h5", ".rrd")
    made = recorded.with_suffix(".rrd") if is_flight else recorded.with_name(f"{recorded.name}.rrd")
    is_newer = made.exists() and (is_flight or made.stat().st_mtime_ns > recorded.stat().st_mtime_ns)
    if save is None and is_newer:
        return made
    check_recorded(flight)
    with as_recording(recorded) as file, Recording(file) as source:
        header = source.header
        settings = yaml.safe_load(header.config_yaml)
        vehicle, scene = "video", None  # a conversion of a video has neither vehicle nor scene
        if "conversion" not in settings:
            config = load_config(settings)
            vehicle = next(iter(config.vehicles))
            scene = scene_shapes(config.scene.load(), make_bodies(config.bodies))
        recording = RerunStream(save or made)
        try:
            with RerunLogger(recording, vehicles={vehicle: header.sensors}, scene=scene) as logger:
                logger.log_path(header.path_position)
                for packet in source.packets():
                    logger.log(packet)
        except BaseException:
            (save or made).unlink(missing_ok=True)  # the next call must not take it for the whole
            raise
    return save or made


def recorded_file(flight: Path) -> Path:
    """Return the file of a folder of `fly`; other files, and folders with events, are what they are."""
    from neurosim_core.io import is_event_file

    return flight / "flight.h5" if flight.is_dir() and not is_event_file(flight) else flight


def check_recorded(flight: Path) -> None:
    """Raise a FileNotFoundError where there is neither a flight nor a file of events."""
    from neurosim_core.io import is_event_file

    recorded = recorded_file(flight)
    if not recorded.exists():
        folder = flight if flight.suffix == "" else "DIR"
        raise FileNotFoundError(f"no flight at {recorded}; `neurosim run --out {folder}` makes one")
    if not is_event_file(recorded):
        raise FileNotFoundError(
            f"no flight at {recorded}: neither a recording nor a file of events; "
            f"`neurosim convert {recorded} events.h5` makes events of a video"
        )


def header_of(model: Model, config: SimulationConfig | None = None) -> RecordingHeader:
    """Return what goes with the packets of a flight.

    `config`: settings that hold in place of those of the model.
    """
    config = model.config if config is None else config
    stamps = np.linspace(0, model.duration_ns, 1001).astype(np.int64)
    return RecordingHeader(
        config_yaml=to_yaml(config),
        seed=config.seed,
        version=__version__,
        scene=model.scene.name,
        sensors=describe_sensors(config.sensors),
        path_stamp_ns=stamps,
        path_position=model.path.evaluate(stamps).position,
    )


@contextlib.contextmanager
def saved_flight(file: Path, model: Model) -> Iterator[Callable[[Packet], None]]:
    """Give what takes the packets of a flight, and write them to a file at the end.

    `file`: a recording (.h5), or an animation of it (.webp, .gif).
    """
    from neurosim_core.view.animation import SUFFIXES, save_animation

    if file.suffix not in (".h5", *SUFFIXES):
        raise ValueError(f"a flight is saved to a file that ends in .h5, {' or '.join(SUFFIXES)}, got {file}")
    with tempfile.TemporaryDirectory() as folder:
        recording = file if file.suffix == ".h5" else Path(folder) / "flight.h5"
        with RecordingWriter(recording, header_of(model)) as writer:
            yield writer.write
        if recording != file:
            save_animation(recording, file)


@contextlib.contextmanager
def _new_folder(folder: Path) -> Iterator[None]:
    """Make a folder and try to write in it; remove it again if the block fails."""
    made = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OSError(f"cannot write to {folder}: {error.strerror}") from None
    try:
        yield
    except BaseException:
        if made and not any(folder.iterdir()):
            folder.rmdir()
        raise


def _load(model: Model, is_lit: Callable[[], bool], *, sinks: Mapping[str, SinkConfig]) -> None:
    """Load what is used later while the scene is lit: kernels, then libraries as long as there is time."""
    warm_flight(model)
    for sink in sinks.values():
        if is_lit():
            break
        with contextlib.suppress(ImportError):  # what is left out for want of it is told when it is opened
            sink.load()


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
