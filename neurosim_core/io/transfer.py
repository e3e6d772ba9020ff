"""Copying a recording from one format to another, block by block."""

from __future__ import annotations

import contextlib
import logging
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from neurosim_core.io.event_file import EventFileError
from neurosim_core.io.formats import FORMATS, create_events, format_of, is_recording, open_events
from neurosim_core.packets import Events

_log = logging.getLogger(__name__)


@dataclass(kw_only=True)
class Transfer:
    """Counts of the copied events."""

    event_count: int = 0
    packet_count: int = 0
    """Pictures, poses and other packets besides events."""
    begin_us: int = 0
    """Time of the first event [us]."""
    end_us: int = 0
    """Time of the last event [us]."""
    width: int = 0
    """[px]."""
    height: int = 0
    """[px]."""
    notes: list[str] = field(default_factory=list)


def transfer(
    source: Path,
    out: Path,
    *,
    format: str | None = None,
    out_format: str | None = None,
    size: tuple[int, int] | None = None,
    sensor: str = "",
    from_zero: bool = False,
    time_unit: str | None = None,
    on_block: Callable[[int], None] | None = None,
) -> Transfer:
    """Copy the events of a file to a file of another format; ground truth too, where both formats have it.

    The file appears under its name once it is complete. Memory is bounded.

    Args:
        source: The file to read.
        out: The file to make, replacing one that exists.
        format: Format of `source`; None: as its name and content say.
        out_format: Format of `out`; None: as its name says.
        size: Width and height of the sensor [px], where `source` does not say it.
        sensor: Event camera, of files that hold several; empty: the first.
        from_zero: Count time from the first event; where there is ground truth, from the whole second before
            it, so that pictures stay at multiples of their period.
        time_unit: Of `source`, where it does not say it; see `open_events`.
        on_block: Called with the number of events so far.
    """
    name = format_of(out, out_format)
    folder = out.with_name(f".{out.name}.part")
    part = folder / out.name
    reader = open_events(source, format=format, size=size, sensor=sensor, time_unit=time_unit)
    done = Transfer(width=reader.width, height=reader.height)
    shift_us: int | None = None if from_zero else 0
    packets = reader.packets
    try:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        writer = create_events(part, width=reader.width, height=reader.height, format=name)
        try:
            for events in reader.blocks():
                if not len(events.t):
                    continue
                if shift_us is None:
                    shift_us = int(events.t[0])
                    shift_us -= shift_us % 1_000_000 if packets is not None else 0
                moved = events._replace(t=events.t - shift_us) if shift_us else events
                writer.write(moved)
                done.begin_us = int(moved.t[0]) if not done.event_count else done.begin_us
                done.end_us = int(moved.t[-1])
                done.event_count += len(events.t)
                if on_block is not None:
                    on_block(done.event_count)
            keep = writer.write_packet
            if keep is not None:
                for packet in () if packets is None else packets():
                    if not isinstance(packet, Events):
                        keep(replace(packet, stamp_ns=packet.stamp_ns - 1000 * (shift_us or 0)))
                        done.packet_count += 1
        finally:
            writer.close()
        if out.is_dir():  # a bag
            shutil.rmtree(out)
        part.replace(out)
    except (EventFileError, OSError) as error:  # the user knows the file by its later name
        text = str(error).replace(str(folder), str(out.parent))
        if text == str(error):
            raise
        raise type(error)(text) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        reader.close()
    done.notes = list(reader.notes)
    return done


@contextlib.contextmanager
def as_recording(path: Path) -> Iterator[Path]:
    """Give a file of events as a recording: itself if it is one, else a copy that is removed afterwards."""
    if path.suffix.lower() in FORMATS["recording"].suffixes and is_recording(path):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "events.h5"
        for note in transfer(path, copy, from_zero=True).notes:
            _log.warning("%s: %s", path, note)
        yield copy
