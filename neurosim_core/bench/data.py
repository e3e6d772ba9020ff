"""Data for learning: windows a second from a recording, against its plain read; formats there and back."""

from __future__ import annotations

import importlib.util
import itertools
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from neurosim_core.bench.options import Options, Progress, silent
from neurosim_core.bench.report import Chapter, Claim, Row, Table
from neurosim_core.data.stream import Stream
from neurosim_core.io import FORMATS, create_events, open_events
from neurosim_core.io.event_file import BLOCK_EVENTS
from neurosim_core.packets import EventArrays
from neurosim_core.record.hdf5 import import_h5py

WIDTH, HEIGHT = 346, 260
EVENTS_HZ = 2_000_000
_ROUNDS = 3


def measure(options: Options, progress: Progress = silent) -> Chapter:
    """Write random events in each format, read them back, and cut the recording into windows."""
    seconds = 2.0 if options.quick else 10.0
    with tempfile.TemporaryDirectory() as folder:
        formats = []
        for name, known in FORMATS.items():
            needs = {"aedat4": "faery", "ros2_bag": "rosbags"}.get(known.module, "h5py")
            if not known.sink or importlib.util.find_spec(needs) is None:
                continue
            progress(name)
            formats.append({"format": name, **_there_and_back(_path(Path(folder), name), name, seconds)})
        windows = _windows(_path(Path(folder), "recording"), progress)
    return _chapter(formats, windows, seconds)


def _path(folder: Path, name: str) -> Path:
    suffix = FORMATS[name].suffixes[0]
    return folder / (f"events{suffix}" if suffix.startswith(".") else suffix)


def _blocks(seconds: float) -> Iterator[EventArrays]:
    """Yield events of edges that move: runs of neighbours with one time, as cameras send them."""
    for number in range(round(seconds * EVENTS_HZ / BLOCK_EVENTS)):
        rng = np.random.default_rng(number)
        begin, span = number * BLOCK_EVENTS * 1_000_000 // EVENTS_HZ, BLOCK_EVENTS * 1_000_000 // EVENTS_HZ
        runs = BLOCK_EVENTS // 5
        t = np.sort(rng.integers(begin, begin + span, runs)).repeat(5)
        x = (rng.integers(0, WIDTH - 5, runs)[:, None] + np.arange(5)).ravel().astype(np.uint16)
        y = rng.integers(0, HEIGHT, runs).repeat(5).astype(np.uint16)
        yield EventArrays(t, x, y, rng.integers(0, 2, runs).repeat(5).astype(np.uint8))


def _there_and_back(path: Path, name: str, seconds: float) -> Row:
    count, write_s, read_s, same = 0, 0.0, 0.0, True
    with closing(create_events(path, width=WIDTH, height=HEIGHT, format=name)) as writer:
        for block in _blocks(seconds):
            begin = time.process_time()
            writer.write(block)
            write_s += time.process_time() - begin
            count += len(block.t)
        begin = time.process_time()
    write_s += time.process_time() - begin
    begin = time.process_time()
    with closing(open_events(path, size=(WIDTH, HEIGHT))) as reader:
        found = [*reader.blocks()]
    read_s = time.process_time() - begin
    for index in range(4):
        ours = np.concatenate([block[index] for block in _blocks(seconds)])
        same = same and np.array_equal(np.concatenate([block[index] for block in found]), ours)
    return {
        "bytes/event": sum(each.stat().st_size for each in (path, *path.rglob("*")) if each.is_file())
        / count,
        "write [M events/s]": count / write_s / 1e6,
        "read [M events/s]": count / read_s / 1e6,
        "identical": "yes" if same else "no",
    }


def _windows(path: Path, progress: Progress) -> list[Row]:
    def plain() -> int:
        with import_h5py().File(path) as file:
            events = [file[f"events/{name}"] for name in "txyp"]
            begins = range(0, len(events[0]), BLOCK_EVENTS)
            return sum(len(c[begin : begin + BLOCK_EVENTS]) for begin in begins for c in events) // 4

    def stream(use: Callable[[Any], object], **order: Any) -> Callable[[], int]:
        def read() -> int:
            count = 0
            for batch in Stream(path, window_s=0.05, batch=16, fields=["events"], **order):
                use(batch.events)
                count += len(batch.events.raw.t)
            return count

        return read

    cases: dict[str, Callable[[], int]] = {
        "plain HDF5 read": plain,
        "events": stream(lambda events: None),
        "voxels, 5 bins": stream(lambda events: events.voxel(5)),
        "voxels, shuffled in sequences of 4": stream(lambda e: e.voxel(5), shuffle=True, sequence=4),
        "voxels, shuffled": stream(lambda events: events.voxel(5), shuffle=True),
        "time surface": stream(lambda events: events.surface(0.03)),
    }
    best = dict.fromkeys(cases, float("inf"))
    counts = dict.fromkeys(cases, 0)
    for _, (name, read) in itertools.product(range(_ROUNDS), cases.items()):  # by turns, on the same machine
        progress(name)
        begin = time.process_time()
        counts[name] = read()
        best[name] = min(best[name], time.process_time() - begin)
    pace = {name: counts[name] / best[name] for name in cases}
    return [
        {
            "what": name,
            "M events/s": pace[name] / 1e6,
            "windows/s": pace[name] / (0.05 * EVENTS_HZ),
            "of the plain read": pace[name] / pace["plain HDF5 read"],
        }
        for name in cases
    ]


def _chapter(formats: list[Row], windows: list[Row], seconds: float) -> Chapter:
    by_name = {row["what"]: row for row in windows}
    voxels = by_name["voxels, 5 bins"]["windows/s"]
    ratio, with_voxels = (by_name[name]["of the plain read"] for name in ("events", "voxels, 5 bins"))
    exact = [row["format"] for row in formats if row["identical"] == "yes"]
    note = (
        f"CPU time of one core; {seconds * EVENTS_HZ / 1e6:.0f} M events at {EVENTS_HZ / 1e6:g} M/s, 346x260."
    )
    return Chapter(
        name="data",
        title="Data for learning",
        summary=f"One core cuts {voxels:,.0f} windows of 50 ms a second into voxels of 5 bins, where 346x260 "
        f"pixels send {EVENTS_HZ / 1e6:g} M events/s; with voxels they come at {with_voxels:.2f}, alone at "
        f"{ratio:.2f} of the speed of a plain read of the file by h5py.",
        claims=[
            Claim("60 windows of 50 ms a second with 5-bin voxels, on two cores", "one core is measured here",
                  f"{voxels:,.0f} windows/s", voxels >= 60.0),
            Claim("voxels come at 0.8 of the speed of a plain HDF5 read", "h5py on the same file, by turns",
                  f"{with_voxels:.2f}", with_voxels >= 0.8),
            Claim("all formats give back the same events", "the events that were written",
                  f"{len(exact)} of {len(formats)}: {', '.join(exact)}", len(exact) == len(formats)),
        ],
        tables=[
            Table("windows", "Windows of 50 ms from a recording", windows, note),
            Table("formats", "Event files there and back", formats, note),
        ],
    )  # fmt: skip
