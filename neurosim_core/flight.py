"""A flight as a user asks for it: fly, record, draw, and say what happened."""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import itertools
import math
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import warp as wp
import yaml
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from neurosim_core import __version__
from neurosim_core.clock import NS_PER_S
from neurosim_core.config import SimulationConfig, load_config, to_yaml
from neurosim_core.flight_report import FlightReport, print_plan, print_report
from neurosim_core.install import install_hint
from neurosim_core.io import is_event_file
from neurosim_core.io.transfer import as_recording
from neurosim_core.packets import Odometry, Packet
from neurosim_core.record import Recording, RecordingHeader, RecordingWriter, describe_sensors
from neurosim_core.record.hdf5 import import_h5py
from neurosim_core.scene.bodies import make_bodies
from neurosim_core.sensors.event_camera import EventSensorConfig
from neurosim_core.signals import stop_at_signals
from neurosim_core.sim.model import Model, make_model
from neurosim_core.sim.rollout import run_model, warm_flight
from neurosim_core.sim.state import make_state
from neurosim_core.vehicle import DynamicsError
from neurosim_core.view.film import SUFFIXES as FILMS
from neurosim_core.view.film import save_film
from neurosim_core.view.overview import FlightSummary, Track
from neurosim_core.view.overview_plot import save_overview
from neurosim_core.view.rerun_batches import Table
from neurosim_core.view.rerun_log import RerunLogger
from neurosim_core.view.rerun_sdk import import_rerun, open_rerun
from neurosim_core.view.rerun_shapes import scene_shapes
from neurosim_core.warp_start import has_kernels

_LIBRARIES = {"h5py": "record", "rerun": "view", "matplotlib": "view"}
"""What a recording needs, and the extra that brings it."""
_ROOM_BYTES = 32_000_000
"""When less is left on the disk, flight.rrd gives its place to flight.h5 [bytes]."""
_CHECK_S = 1.0
_CLEARANCE_NS = 100_000_000
"""How much flight is asked for its distances at once."""


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
    config: SimulationConfig,
    folder: Path,
    *,
    rerun: bool = True,
    console: Console | None = None,
    began_s: float | None = None,
) -> FlightReport:
    """Fly a configuration and leave config.yaml, flight.h5, flight.rrd and overview.png in a folder.

    What cannot be written because an extra is not installed is left out, and said. When the disk is nearly
    full, flight.rrd is given up, which can be made again from flight.h5. When flight.h5 cannot grow any more,
    the flight ends, and the report says up to when it is kept.

    Args:
        config: What to fly.
        folder: Where to leave the flight; made if need be.
        rerun: Write flight.rrd.
        console: Where to print; standard output if None.
        began_s: When the command began, as `time.perf_counter` says; None: now.

    Raises:
        DynamicsError: The integration failed; the recording holds everything up to there.
        OSError: The folder cannot be written to, or the disk is full.
    """
    console = console or Console(soft_wrap=not sys.stdout.isatty())  # no lines broken in a pipe
    report = FlightReport()
    begin = time.perf_counter()
    began_s = begin if began_s is None else began_s
    report.libraries_s = begin - began_s
    if not has_kernels():
        console.print(
            "first flight here: its kernels are compiled, which takes 10 s to a minute, and kept in "
            f"{wp.config.kernel_cache_dir}",
            highlight=False,
        )
    with _new_folder(folder), console.status("preparing") as status:
        model = make_model(
            config,
            on_phase=lambda phase: status.update(f"preparing: {phase}"),
            meanwhile=functools.partial(_load, rerun=rerun),
        )
        status.update("preparing: kernels (compiled once, then kept)")
        state = make_state(model)
        packets = run_model(model, state)
        first = next(packets, None)  # builds all kernels; there is none without sensors
        (folder / "config.yaml").write_text(to_yaml(config, comments=True), encoding="utf-8")
    report.setup_s = time.perf_counter() - began_s
    report.setup_wall_s = dict(state.wall_s)
    print_plan(console, model)

    summary = FlightSummary(describe_sensors(config.sensors))
    sees_events = any(isinstance(sensor, EventSensorConfig) for sensor in config.sensors.values())
    stop = threading.Event()
    begin = time.perf_counter()
    loading = threading.Thread(target=_load_matplotlib, daemon=True)
    loading.start()  # for the overview, beside the flight
    with stop_at_signals(stop), _Files(model, folder, rerun=rerun, console=console) as files:
        try:
            with _progress(console) as progress:
                task = progress.add_task("flying", total=model.duration_ns, rate="", factor="")
                for packet in packets if first is None else itertools.chain([first], packets):
                    if stop.is_set():
                        report.interrupted = True
                        break
                    files.write(packet)
                    summary.log(packet)
                    report.note(packet)
                    report.flight_s = time.perf_counter() - begin
                    if packet.stamp_ns > report.simulated_ns:
                        report.simulated_ns = packet.stamp_ns
                        progress.update(
                            task,
                            completed=packet.stamp_ns,
                            rate=f"{summary.event_count / report.simulated_ns * 1e3:.2f} M events/s"
                            if sees_events
                            else "",
                            factor=f"{report.real_time_factor:.2f} x real time",
                        )
            files.close()
        except DynamicsError as error:
            report.failure = error
        except OSError as error:
            report.failure = OSError(f"{error}; flight.h5 is kept up to {files.kept_ns / NS_PER_S:.3f} s")
    report.flight_s = time.perf_counter() - begin
    report.event_count = summary.event_count
    begin = time.perf_counter()
    loading.join()
    if _has("matplotlib", console, "overview.png"):
        track = None if report.positions else _planned_track(model, state.stamp_ns)
        factor = report.real_time_factor
        try:
            save_overview(
                folder / "overview.png", summary, scene=model.scene, track=track, real_time_factor=factor
            )
        except OSError as error:
            (folder / "overview.png").unlink(missing_ok=True)
            console.print(f"overview.png is left out: {error}", style="yellow", markup=False)
    report.overview_s = time.perf_counter() - begin
    print_report(console, model, state, report, folder)
    if report.failure is not None:
        raise report.failure
    return report


def rerun_file(flight: Path, *, save: Path | None = None) -> Path:
    """Return the Rerun file of a flight; write it from the recording if there is none, or to `save` if given.

    Args:
        flight: The folder that `fly` left, its flight.h5 or flight.rrd, or any file or folder of events.
        save: Write here.

    Raises:
        FileNotFoundError: There is no flight.
        ImportError: Rerun or h5py is not installed.
    """
    recorded = flight / "flight.h5" if flight.is_dir() and not is_event_file(flight) else flight
    # events.raw and events.csv may be different events: each has a Rerun file of its own
    is_flight = recorded.suffix in (".h5", ".rrd")
    made = recorded.with_suffix(".rrd") if is_flight else recorded.with_name(f"{recorded.name}.rrd")
    is_newer = made.exists() and (is_flight or made.stat().st_mtime_ns > recorded.stat().st_mtime_ns)
    if save is None and is_newer:
        return made
    if not recorded.exists():
        folder = flight if flight.suffix == "" else "DIR"
        raise FileNotFoundError(f"no flight at {recorded}; `neurosim run --out {folder}` makes one")
    if not is_event_file(recorded):
        raise FileNotFoundError(
            f"no flight at {recorded}: neither a recording nor a file of events; "
            f"`neurosim convert {recorded} events.h5` makes events of a film"
        )
    with as_recording(recorded) as file, Recording(file) as source:
        header = source.header
        settings = yaml.safe_load(header.config_yaml)
        vehicle, scene = "video", None  # a conversion of a video has neither vehicle nor scene
        if "conversion" not in settings:
            config = load_config(settings)
            vehicle = next(iter(config.vehicles))
            scene = scene_shapes(config.scene.load(), make_bodies(config.bodies))
        recording = open_rerun(save or made)
        try:
            with RerunLogger(recording, vehicles={vehicle: header.sensors}, scene=scene) as logger:
                logger.log_path(header.path_position)
                for packet in source.packets():
                    logger.log(packet)
        except BaseException:
            (save or made).unlink(missing_ok=True)  # the next call must not take it for the whole
            raise
    return save or made


def header_of(model: Model, config: SimulationConfig | None = None) -> RecordingHeader:
    """Return what goes with the packets of a flight.

    Args:
        model: What is flown.
        config: Settings that hold in place of those of the model.
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

    Args:
        file: A recording (.h5), or a film of it (.webp, .gif).
        model: What is flown.

    Raises:
        ValueError: The file is neither, or a film has nothing to show.
        OSError: The file cannot be written.
    """
    if file.suffix not in (".h5", *FILMS):
        raise ValueError(f"a flight is saved to a file that ends in .h5, {' or '.join(FILMS)}, got {file}")
    with tempfile.TemporaryDirectory() as folder:
        recording = file if file.suffix == ".h5" else Path(folder) / "flight.h5"
        with RecordingWriter(recording, header_of(model)) as writer:
            yield writer.write
        if recording != file:
            save_film(recording, file)


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


class _Files:
    """The files that the packets of a flight are written to. A context manager."""

    def __init__(self, model: Model, folder: Path, *, rerun: bool, console: Console) -> None:
        config = model.config
        self._model, self._folder, self._console = model, folder, console
        self._recording: RecordingWriter | None = None
        self._rerun: RerunLogger | None = None
        self._positions = Table("clearance", self._log_clearance, span_ns=_CLEARANCE_NS)
        self._checked_s = -math.inf  # so before the first packet is in flight.h5
        header = header_of(model)
        if _has("h5py", console, "flight.h5"):
            self._recording = RecordingWriter(folder / "flight.h5", header)
        if rerun and _has("rerun", console, "flight.rrd"):
            self._rerun = RerunLogger(
                open_rerun(folder / "flight.rrd"),
                vehicles={next(iter(config.vehicles)): header.sensors},
                scene=scene_shapes(model.scene, model.bodies),
            )
            self._rerun.log_path(header.path_position)

    @property
    def kept_ns(self) -> int:
        """Up to which stamp the packets are in flight.h5 [ns]."""
        return 0 if self._recording is None else self._recording.kept_ns

    def write(self, packet: Packet) -> None:
        """Write one packet to all files.

        Raises:
            OSError: flight.h5 cannot be written.
        """
        if self._rerun is not None:
            self._rerun.log(packet)
            if isinstance(packet, Odometry):
                self._positions.append(packet.stamp_ns, position=packet.position)
            if time.monotonic() - self._checked_s >= _CHECK_S:
                self._check_disk()
        if self._recording is not None:
            self._recording.write(packet)

    def close(self) -> None:
        """Close all files. Closing twice is allowed.

        Raises:
            OSError: flight.h5 cannot be written.
        """
        if self._rerun is not None:
            self._check_disk()
        if self._rerun is not None:
            self._positions.send()
        logger, self._rerun = self._rerun, None
        if logger is not None:
            logger.close()
        if self._recording is not None:
            self._recording.close()

    def __enter__(self) -> _Files:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):  # it has been told
            self.close()

    def _log_clearance(self, name: str, stamp_ns: NDArray[np.int64], position: NDArray[np.float64]) -> None:
        """Plot the distance to what is nearest."""
        assert self._rerun is not None
        vehicle = next(iter(self._model.config.vehicles))
        for stamp, clearance_m in zip(stamp_ns, self._model.free_space.clearance(position), strict=True):
            self._rerun.log_values(f"plots/{vehicle}/{name}", int(stamp), {name: float(clearance_m)})

    def _check_disk(self) -> None:
        """Give flight.rrd up if it cannot be written, or takes the last room from flight.h5."""
        assert self._rerun is not None
        self._checked_s = time.monotonic()
        why = ""
        try:
            self._rerun.check()
        except OSError as error:
            why = str(error)
        if shutil.disk_usage(self._folder).free < _ROOM_BYTES:
            why = f"less than {_ROOM_BYTES / 1e6:g} MB are left on the disk"
        if why and self._recording is not None:
            with contextlib.suppress(OSError):
                self._rerun.close()
            self._rerun = None
            (self._folder / "flight.rrd").unlink(missing_ok=True)
            self._console.print(
                f"flight.rrd is given up: {why}; `neurosim view {self._folder} --save FILE.rrd` makes it "
                "from flight.h5",
                style="yellow",
                markup=False,
                soft_wrap=True,
            )


def _load(model: Model, is_lit: Callable[[], bool], *, rerun: bool) -> None:
    """Load what is used later while the scene is lit: kernels, then libraries as long as there is time."""
    warm_flight(model)
    imports: list[Callable[[], object]] = [import_h5py, *([import_rerun] if rerun else [])]
    for load in imports:
        if is_lit():
            break
        with contextlib.suppress(ImportError):  # what is left out for want of it is told by `_has`
            load()


def _load_matplotlib() -> None:
    with contextlib.suppress(ImportError):
        importlib.import_module("matplotlib.figure")


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
