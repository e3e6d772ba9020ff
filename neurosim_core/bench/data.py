"""Data for learning: windows a second from a recording, against its plain read."""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from neurosim_core.bench.options import Options
from neurosim_core.bench.report import Chapter, Claim, Row, Table
from neurosim_core.data.stream import Stream
from neurosim_core.io import create_events
from neurosim_core.io.event_file import BLOCK_EVENTS
from neurosim_core.packets import EventArrays
from neurosim_core.record.hdf5 import import_h5py

WIDTH, HEIGHT = 346, 260
EVENTS_HZ = 2_000_000
_ROUNDS = 3


def measure(options: Options) -> Chapter:
    """Write a recording of random events, and cut it into windows."""
    seconds = 2.0 if options.quick else 10.0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "events.h5")
        options.progress("write")
        with closing(create_events(path, width=WIDTH, height=HEIGHT, format="recording")) as writer:
            for block in _blocks(seconds):
                writer.write(block)
        return _chapter(_windows(path, options), seconds)


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


def _windows(path: Path, options: Options) -> list[Row]:
    def plain() -> int:
        with import_h5py().File(path) as file:
            return sum(len(file[f"events/{name}"][:]) for name in "txyp") // 4

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
    best = dict.fromkeys(cases, 0.0)
    for _, (name, read) in itertools.product(range(_ROUNDS), cases.items()):  # by turns, on the same machine
        options.progress(name)
        begin = time.process_time()
        count = read()
        best[name] = max(best[name], count / (time.process_time() - begin))
    return [
        {
            "what": name,
            "M events/s": pace / 1e6,
            "windows/s": pace / (0.05 * EVENTS_HZ),
            "of the plain read": pace / best["plain HDF5 read"],
        }
        for name, pace in best.items()
    ]


def _chapter(windows: list[Row], seconds: float) -> Chapter:
    by_name = {row["what"]: row for row in windows}
    voxels = by_name["voxels, 5 bins"]["windows/s"]
    ratio, with_voxels = (by_name[name]["of the plain read"] for name in ("events", "voxels, 5 bins"))
    events_m = seconds * EVENTS_HZ / 1e6
    note = f"CPU time of one core; {events_m:.0f} M events at {EVENTS_HZ / 1e6:g} M/s, 346x260."
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
        ],
        tables=[Table("windows", "Windows of 50 ms from a recording", windows, note)],
    )  # fmt: skip
