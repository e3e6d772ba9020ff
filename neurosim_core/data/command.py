"""The commands `neurosim dataset` and `neurosim compare`."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from neurosim_core.overrides import add_settings, load_settings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from neurosim_core.data.make import DatasetPlan


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `dataset` to the commands of `neurosim`."""
    parser = commands.add_parser(
        "dataset",
        help="make a data set: many flights with different seeds",
        description="Fly a configuration many times, with different seeds, and write recordings, a data card "
        "and checksums. After an interruption, the same command resumes; the bytes are the same.",
    )
    add_settings(parser)
    parser.add_argument("--flights", type=int, required=True, metavar="N", help="number of flights")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the data set")
    parser.add_argument(
        "--workers", type=int, default=1, metavar="N", help="processes (default: 1); 0: this process"
    )
    parser.add_argument(
        "--ray",
        nargs="?",
        const="auto",
        metavar="ADDRESS",
        help="fly on a Ray cluster: local, host:port, or auto (default), --workers flights at a time",
    )
    parser.add_argument(
        "--flights-per-scene", type=int, default=10, metavar="N", help="flights in one generated scene"
    )
    parser.add_argument(
        "--webdataset", type=Path, metavar="DIR", help="also write windows of 50 ms as shards for WebDataset"
    )
    parser.set_defaults(command=_make)


def _make(arguments: argparse.Namespace) -> int:
    import threading

    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from neurosim_core.data.card import write_card
    from neurosim_core.data.make import DatasetPlan, prepare, write_checksums
    from neurosim_core.render.launch import single_threaded_blas
    from neurosim_core.signals import stop_at_signals

    if arguments.workers < 0:
        raise ValueError(f"--workers must be at least 0, got {arguments.workers}")
    plan = DatasetPlan(
        config=load_settings(arguments),
        folder=arguments.out,
        flight_count=arguments.flights,
        flights_per_scene=arguments.flights_per_scene,
    )
    shards = arguments.webdataset
    if shards is not None and (shards.exists() or plan.folder.resolve() in shards.resolve().parents):
        raise FileExistsError(f"--webdataset {shards}: name a new folder, outside of {plan.folder}")
    prepare(plan)
    os.environ.update(single_threaded_blas())  # of the workers
    console = Console(soft_wrap=not sys.stdout.isatty())
    stop = threading.Event()
    left = len(plan.missing())
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with stop_at_signals(stop), Progress(*columns, console=console) as progress:
        task = progress.add_task("flights", total=plan.flight_count, completed=plan.flight_count - left)
        for _ in _flights(plan, arguments, stop.is_set):
            progress.advance(task)
    missing = len(plan.missing())
    if missing:
        console.print(
            f"interrupted; {_flight_count(missing)} missing: the same command goes on", style="yellow"
        )
        return 130
    # Who flies changes no byte, and so is no part of the command.
    who = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    who.add_argument("--workers")
    who.add_argument("--ray", nargs="?")
    write_card(plan, command=shlex.join(["neurosim", *who.parse_known_args(sys.argv[1:])[1]]))
    write_checksums(plan)
    if shards is not None:
        from neurosim_core.data import Dataset, write_shards

        windows = Dataset(plan.folder)
        count = len(write_shards((windows[k] for k in range(len(windows))), shards))
        console.print(f"{shards}/: {len(windows):,} windows in {count} shards")
    console.print(f"{plan.folder}/: README.md, sheet.png, SHA256SUMS, {_flight_count(plan.flight_count)}")
    return 0


def _flight_count(count: int) -> str:
    return f"{count} flight{'s' * (count != 1)}"


def _flights(plan: DatasetPlan, arguments: argparse.Namespace, stopped: Callable[[], bool]) -> Iterator[int]:
    if arguments.ray is None:
        from neurosim_core.data.make import make_flights

        return make_flights(plan, workers=arguments.workers, stopped=stopped)
    from neurosim_core.data.ray_source import make_flights_on_ray

    workers = max(1, arguments.workers)
    return make_flights_on_ray(plan, address=arguments.ray, workers=workers, stopped=stopped)


def add_compare_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `compare` to the commands of `neurosim`."""
    parser = commands.add_parser(
        "compare",
        help="compare the statistics of event files, such as a simulated and a real one",
        description="Event rate, intervals, polarity and spatial spectrum of files of any format, as a table "
        "and on one page of plots.",
    )
    parser.add_argument("files", nargs="+", type=Path, help="files of events, or folders of them")
    parser.add_argument(
        "--out", type=Path, default=Path("compare.png"), help="PNG, PDF or SVG to write (./compare.png)"
    )
    parser.add_argument("--size", metavar="WxH", help="resolution, for files that do not give it")
    parser.add_argument("--sensor", default="", metavar="NAME", help="event camera (default: the first)")
    parser.set_defaults(command=_compare)


_COLUMNS = (
    "interval: median time between two events of a pixel; silent: pixels without events; cycles/px: mean\n"
    "spatial frequency of 20 ms of events, higher where edges are sharper or noise is"
)


def _compare(arguments: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.table import Table

    from neurosim_core.convert.command import print_notes
    from neurosim_core.convert.geometry import read_size
    from neurosim_core.data.compare import draw_comparison, measure_events
    from neurosim_core.data.stream import find_recordings

    size = None if arguments.size is None else read_size(arguments.size)
    console = Console(soft_wrap=not sys.stdout.isatty())
    table = Table(box=None, pad_edge=False, header_style="dim")
    columns = ("file", "pixels", "events", "s", "M/s", "brighter", "interval", "silent", "cycles/px")
    for name in columns:
        table.add_column(name, justify="left" if name == "file" else "right", overflow="fold")
    stats = []
    files = find_recordings(arguments.files)
    names = Counter(path.name for path in files)
    with console.status("reading") as status:
        for path in files:
            status.update(f"reading {path}")
            one = measure_events(path, size=size, sensor=arguments.sensor)
            if names[path.name] > 1:  # each flight has a flight.h5
                one.name = str(path)
            stats.append(one)
            table.add_row(
                one.name,
                f"{one.width}x{one.height}",
                f"{one.event_count:,}",
                f"{one.duration_s:.3f}",
                f"{one.mean_rate_hz / 1e6:.3f}",
                f"{100 * one.on_share:.1f} %",
                f"{one.median_interval_us / 1000.0:.3g} ms",
                f"{100 * one.silent_share:.1f} %",
                f"{one.centroid:.3f}",
            )
        status.update("drawing")
        draw_comparison(stats, arguments.out)
    console.print(table)
    console.print(_COLUMNS, style="dim", highlight=False)
    print_notes((note for one in stats for note in one.notes), console)
    console.print(f"{arguments.out}", markup=False, highlight=False)
    return 0
