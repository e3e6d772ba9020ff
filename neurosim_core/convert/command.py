"""The command `neurosim convert`: a video or a folder of pictures to events, or events to another format."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurosim_core.overrides import add_set_option, read_settings
from neurosim_core.settings_file import nested
from neurosim_core.signals import raise_at_signals

if TYPE_CHECKING:
    from rich.console import Console

    from neurosim_core.convert.convert import Conversion, ConversionConfig
    from neurosim_core.convert.frames import Description

_HALVED_LOSS_MAX = 0.15
_BURST_SHARE_MAX = 0.5


_OPTIONS: dict[str, dict[str, Any]] = {
    "preset": {
        "dest": "pixel.preset",
        "help": "preset of the event camera: davis346, imx636, v2e_noisy, ...",
        "metavar": "NAME",
    },
    "size": {
        "help": "resolution of the sensor; `preset`: that of the preset (default: as it is)",
        "metavar": "WxH",
    },
    "crop": {"help": "part of the picture to convert", "metavar": "WxH+X+Y"},
    "fit": {
        "help": "how to fit --size with another aspect ratio (default: crop the middle)",
        "choices": ("crop", "stretch"),
    },
    "fps": {
        "help": "frame rate [Hz]; needed for folders (default: as the video says)",
        "type": float,
        "metavar": "HZ",
    },
    "timestamps": {"help": "file of frame times, one per line, instead of --fps", "metavar": "FILE"},
    "time-unit": {
        "help": "unit of --timestamps (default: s), or of events in a file that does not say it",
        "choices": ("s", "ms", "us", "ns"),
    },
    "slow-motion": {
        "help": "factor by which the video is slower than the world: 8 if filmed at 240 Hz and played at 30",
        "metavar": "FACTOR",
        "type": float,
    },
    "transfer": {
        "help": "transfer function of pixel values: srgb, bt709, linear, pq, ... (default: auto)",
        "metavar": "NAME",
    },
    "dark-floor": {
        "help": "luminance added before the logarithm; white is 1 (default: 0.001, or so much that a step "
        "of the stored numbers is half a threshold at most)",
        "metavar": "L",
        "type": float,
    },
    "seed": {"help": "seed of the pixel noise", "type": int},
}


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `convert` to the commands of `neurosim`."""
    parser = commands.add_parser(
        "convert",
        help="convert a video or a folder of pictures to events, or events to another format",
        description="Convert a video (needs PyAV) or the pictures of a folder to events of a simulated "
        "camera, and write them as `neurosim run` does. Log radiance is linear between frames. Or convert "
        "events from one format to another: .raw (EVT3), .evt2.raw, .dat, .csv, .npz, .aedat4, .es (read), "
        "or, with pictures, depth, poses and IMU: mvsec.h5, .h5, and bags of ROS 2: flight.mcap, bag.",
    )
    parser.add_argument("source", type=Path, help="video file, folder of pictures, or file of events")
    parser.add_argument("out", type=Path, help="file to write; HDF5 for videos and pictures")
    for name, option in _OPTIONS.items():
        parser.add_argument(f"--{name}", **option)
    events = parser.add_argument_group("events to another format")
    events.add_argument("--from", dest="source_format", metavar="FORMAT", help="default: by the suffix")
    events.add_argument("--to", dest="out_format", metavar="FORMAT", help="default: by the suffix")
    events.add_argument("--sensor", default="", metavar="NAME", help="event camera (default: the first)")
    events.add_argument("--from-zero", action="store_true", help="shift time to begin at the first event")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda:0, ...")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    add_set_option(parser, "any setting by its dotted key, such as pixel.threshold_on=0.15; may be repeated")
    parser.set_defaults(command=_convert)


def _setting(option: str) -> str:
    """Return the dotted key of the setting that an option is."""
    return str(_OPTIONS[option].get("dest", option.replace("-", "_")))


def _convert(arguments: argparse.Namespace) -> int:
    from neurosim_core.io import is_event_file

    is_events = arguments.source_format is not None or is_event_file(arguments.source)
    _check_options(arguments, is_events=is_events)
    return _transfer(arguments) if is_events else _convert_video(arguments)


def _check_options(arguments: argparse.Namespace, *, is_events: bool) -> None:
    """Refuse options that do nothing with what is converted."""
    videos = {name: _setting(name) for name in _OPTIONS if name not in ("size", "time-unit")}
    events = {"to": "out_format", "sensor": "sensor", "from-zero": "from_zero"}
    others = videos | {"set": "settings"} if is_events else events
    values = {name: getattr(arguments, key) for name, key in others.items()}
    if given := [
        f"--{name}" for name, value in values.items() if value or (value == 0 and value is not False)
    ]:
        kind = "a video, and this is a file of events" if is_events else "a file of events, and this is none"
        raise ValueError(f"{', '.join(given)}: for {kind}: {arguments.source}")


def _transfer(arguments: argparse.Namespace) -> int:
    """Copy events from one format to another."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from neurosim_core.convert.geometry import read_size
    from neurosim_core.io.event_file import check_new
    from neurosim_core.io.transfer import transfer

    out, text = arguments.out, arguments.size
    check_new(out, overwrite=arguments.overwrite)
    console = Console()
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with (
        raise_at_signals() as raise_again,
        Progress(*columns, console=console, transient=True, disable=not console.is_interactive) as progress,
    ):
        task = progress.add_task("converting", total=None)

        def on_block(count: int) -> None:
            raise_again()
            progress.update(task, description=f"{count:,} events")

        done = transfer(
            arguments.source,
            out,
            format=arguments.source_format,
            out_format=arguments.out_format,
            size=None if text is None else read_size(text),
            sensor=arguments.sensor,
            from_zero=arguments.from_zero,
            time_unit=arguments.time_unit,
            on_block=on_block,
        )
    span_s = (done.end_us - done.begin_us) * 1e-6
    more = f", {done.packet_count:,} other packets" if done.packet_count else ""
    console.print(
        f"{done.event_count:,} events of {done.width}x{done.height} pixels, {done.begin_us * 1e-6:.6f} s to "
        f"{done.end_us * 1e-6:.6f} s ({done.event_count / max(span_s, 1e-6) / 1e6:.2f} M/s){more}",
        highlight=False,
    )
    print_notes(done.notes, console)
    console.print(f"{out}", markup=False, highlight=False, soft_wrap=True)
    return 0


def _convert_video(arguments: argparse.Namespace) -> int:
    import threading

    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from neurosim_core.convert.convert import convert_video
    from neurosim_core.signals import stop_at_signals

    config = read_config(arguments)
    if arguments.out.suffix.lower() not in (".h5", ".hdf5") and not arguments.out.is_dir():
        raise ValueError(
            f"events are written as HDF5: {arguments.out.with_suffix('.h5')}, not {arguments.out}"
        )
    console = Console()
    stop = threading.Event()
    columns = [
        TextColumn("{task.description}"),
        BarColumn(bar_width=32),
        TextColumn("{task.fields[count]}"),
        TimeRemainingColumn(),
    ]
    with (
        stop_at_signals(stop),
        Progress(*columns, console=console, transient=True, disable=not console.is_interactive) as progress,
    ):
        task = progress.add_task("converting", total=None, count="")

        def on_start(source: Description) -> None:
            progress.update(task, total=source.frame_count)

        def on_stack(frame_count: int, event_count: int, _end_ns: int) -> None:
            progress.update(
                task, completed=frame_count, count=f"{frame_count:,} frames, {event_count:,} events"
            )

        conversion = convert_video(
            arguments.source,
            arguments.out,
            config,
            overwrite=arguments.overwrite,
            device=arguments.device,
            on_start=on_start,
            on_stack=on_stack,
            stopped=stop.is_set,
        )
        progress.update(task, total=conversion.frame_count)
    print_conversion(conversion, arguments.out, console)
    return 0 if conversion.complete else 130


def read_config(arguments: argparse.Namespace) -> ConversionConfig:
    """Return the settings of a command line."""
    from pydantic import ValidationError

    from neurosim_core.config_errors import explain
    from neurosim_core.convert.convert import ConversionConfig

    given = {_setting(name): getattr(arguments, _setting(name)) for name in _OPTIONS}
    settings = {key: value for key, value in given.items() if value is not None}
    more = read_settings(arguments.settings)
    for name in _OPTIONS:
        if (key := _setting(name)) in settings and key in more:
            raise ValueError(f"{key} is given twice: --{name} and --set {key}=...")
    settings |= more
    if "time_unit" in settings and "timestamps" not in settings:
        raise ValueError("--time-unit is that of --timestamps, which are not given")
    try:
        return ConversionConfig.model_validate(nested(settings))
    except ValidationError as error:
        raise ValueError("; ".join(explain(ConversionConfig, error))) from None


def print_conversion(conversion: Conversion, out: Path, console: Console) -> None:
    """Print what came of a video, and what to be aware of."""
    from rich.table import Table

    facts = Table(show_header=False, box=None, pad_edge=False)
    facts.add_column(style="dim", min_width=10)
    facts.add_column(overflow="fold")
    for name, text in _facts(conversion):
        facts.add_row(name, text)
    console.print(facts, highlight=False)
    print_notes((*conversion.source.notes, *_warnings(conversion)), console)
    if not conversion.complete:
        console.print("interrupted; what was converted is kept", style="yellow")
    console.print(f"{out}", markup=False, highlight=False, soft_wrap=True)


def print_notes(notes: Iterable[str], console: Console) -> None:
    """Print what a user should be aware of, one line each."""
    for note in notes:
        console.print(f"note: {note}", style="yellow", markup=False, highlight=False, soft_wrap=True)


def _facts(c: Conversion) -> list[tuple[str, str]]:
    from neurosim_core.sensors.event_config import describe_pixel

    source, plan, duration_s = c.source, c.plan, 1e-9 * c.duration_ns
    whole = (plan.crop.width, plan.crop.height) == (source.width, source.height)
    part = "" if whole else f", of which {plan.crop}"
    rate_hz = (c.frame_count - 1) / duration_s
    ends_ms = [1e3 / rate_hz]
    if c.interval_max_ns - c.interval_min_ns > 1_000_000:
        ends_ms = [1e-6 * c.interval_min_ns, 1e-6 * c.interval_max_ns]
    intervals = f"every {' to '.join(f'{ms:,.0f}' if ms >= 1e3 else f'{ms:.3g}' for ms in ends_ms)} ms"
    event_rate = c.event_count / duration_s / 1e6
    on_share = c.on_count / c.event_count if c.event_count else 0.0
    return [
        ("source", f"{source.name}: {source.width}x{source.height}{part}; {source.light}"),
        ("frames", f"{c.frame_count:,} in {duration_s:.3f} s, {intervals}"),
        ("sensor", f"{plan.width}x{plan.height}, {describe_pixel(c.pixel)}, dark floor {plan.dark_floor:g}"),
        (
            "events",
            f"{c.event_count:,} ({event_rate:.2f} M/s, {_percent(on_share)} brighter), "
            f"{c.dropped_count:,} dropped",
        ),
        ("time", f"{c.wall_s:.1f} s: real-time factor {c.real_time_factor:.2f}"),
        ("sampling", _sampling(c)),
    ]


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _sampling(c: Conversion) -> str:
    if math.isnan(c.halved_loss) or math.isnan(c.burst_share):
        return "events between frames are interpolated; nothing moves"
    slow = c.halved_loss > _HALVED_LOSS_MAX or c.burst_share > _BURST_SHARE_MAX
    return (
        f"{'too slow' if slow else 'fast enough'} for this motion: without every second frame "
        f"{_percent(max(c.halved_loss, 0.0))} of the events would be missing; {_percent(c.burst_share)} of "
        "the pixels that fire between two frames do so four times or more"
    )


def _warnings(c: Conversion) -> list[str]:
    notes = []
    plan, crop = c.plan, c.plan.crop
    if plan.width > crop.width or plan.height > crop.height:
        notes.append(
            f"the pictures are enlarged from {crop.width}x{crop.height} to {plan.width}x{plan.height}: "
            "details as fine as the pixels of the sensor are not there"
        )
    if c.halved_loss > _HALVED_LOSS_MAX:
        notes.append(
            "the motion is fast for this frame rate: without every second frame "
            f"{_percent(c.halved_loss)} of the events would be missing, so as many or more are missing now. "
            "Film faster, or take a part where less moves."
        )
    if c.burst_share > _BURST_SHARE_MAX:
        notes.append(
            f"{_percent(c.burst_share)} of the pixels that fire do so four times or more within one "
            "interval: edges pass them in less than that, and times within an interval are those of a "
            "cross-fade."
        )
    if plan.code_step > plan.threshold:
        notes.append(
            f"one step of the stored numbers changes log radiance by up to {plan.code_step:.2g} in the dark, "
            f"more than the threshold {plan.threshold:g}: noise of one step makes events there. A larger "
            f"--dark-floor helps, now {plan.dark_floor:g}."
        )
    if c.dropped_count:
        notes.append("dropped events were more than the readout or event_count_max lets through")
    return notes
