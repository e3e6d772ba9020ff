"""Making a data set: many flights of one configuration, each with seeds of its own, in several processes.

    folder/dataset.yaml           the settings, and how seeds are derived
    folder/flights/00000.h5       one recording for each flight, and beside it its statistics (.json)
    folder/README.md, sheet.png   the card
    folder/SHA256SUMS             checksums, for `sha256sum --check`

Flight k has the seed `seed + k`, the path's seed plus k, and the scene's seed plus k divided by the number of
flights that share a scene. A flight is written under another name and renamed when it is complete, and its
bytes depend on its settings alone: a data set that was interrupted anywhere, and continued, is the same.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from neurosim_core import __version__
from neurosim_core.config import SimulationConfig, load_config, to_yaml
from neurosim_core.data.sources import numbered
from neurosim_core.flight import header_of
from neurosim_core.packets import Collision, Events, Image, Odometry, Packet
from neurosim_core.record import RecordingWriter
from neurosim_core.record.disk import naming_file
from neurosim_core.render.launch import core_count, limit_cores
from neurosim_core.sim.model import Model, make_model, refit
from neurosim_core.sim.rollout import run_model
from neurosim_core.sim.state import make_state
from neurosim_core.vehicle import DynamicsError

SPEED_EDGES_M_S = tuple(0.5 * k for k in range(41))
DEPTH_EDGES_M = tuple(round(0.1 * 10.0 ** (k / 10.0), 6) for k in range(31))
"""0.1 m to 100 m."""
_FORMAT = 1


@dataclass(kw_only=True)
class FlightStats:
    """The facts of a flight for the card."""

    duration_s: float = 0.0
    """Simulated time [s]."""
    event_count: int = 0
    on_count: int = 0
    """Events that are brighter."""
    dropped_count: int = 0
    """Events that the cameras lost."""
    packet_counts: dict[str, int] = field(default_factory=dict)
    """By sensor."""
    speeds: list[int] = field(default_factory=lambda: [0] * (len(SPEED_EDGES_M_S) - 1))
    """Odometry packets by speed, between `SPEED_EDGES_M_S`."""
    depths: list[int] = field(default_factory=lambda: [0] * (len(DEPTH_EDGES_M) - 1))
    """Pixels by depth, between `DEPTH_EDGES_M`."""
    collided: bool = False
    failure: str = ""
    """Why the flight ended early, if the motion could not be integrated."""

    def add(self, packet: Packet) -> None:
        """Take a packet."""
        self.duration_s = max(self.duration_s, packet.stamp_ns * 1e-9)
        self.packet_counts[packet.sensor] = self.packet_counts.get(packet.sensor, 0) + 1
        if isinstance(packet, Events):
            events = packet.numpy()
            self.event_count += len(events.t)
            self.on_count += int(np.count_nonzero(events.polarity))
            self.dropped_count += packet.dropped_count
        elif isinstance(packet, Odometry):
            self.speeds = _count(self.speeds, np.linalg.norm(packet.velocity), SPEED_EDGES_M_S)
        elif isinstance(packet, Image) and packet.encoding == "32FC1":
            self.depths = _count(self.depths, packet.data[np.isfinite(packet.data)], DEPTH_EDGES_M)
        elif isinstance(packet, Collision):
            self.collided = True


def _count(counts: list[int], values: Any, edges: tuple[float, ...]) -> list[int]:
    found = np.histogram(np.clip(np.atleast_1d(values), edges[0], np.nextafter(edges[-1], 0.0)), edges)[0]
    return [a + b for a, b in zip(counts, found.tolist(), strict=True)]


@dataclass(frozen=True, kw_only=True)
class DatasetPlan:
    """A data set that is to be made."""

    config: SimulationConfig
    """Of one vehicle; with the seeds of flight 0."""
    folder: Path
    flight_count: int
    flights_per_scene: int = 10
    """Of generated scenes: so many flights share one."""

    def __post_init__(self) -> None:
        for name in ("flight_count", "flights_per_scene"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if len(self.config.vehicles) > 1:
            raise ValueError(f"a data set has one vehicle, got {', '.join(self.config.vehicles)}")

    @property
    def description(self) -> str:
        """What is in dataset.yaml; `flight_count` is not in it, so that a data set may grow."""
        head = {"format": _FORMAT, "version": __version__, "flights_per_scene": self.flights_per_scene}
        return yaml.safe_dump(head, sort_keys=False) + "config:\n" + _indented(to_yaml(self.config))

    def path(self, number: int) -> Path:
        """Return the recording of a flight."""
        return self.folder / "flights" / f"{number:05d}.h5"

    def settings(self, number: int) -> SimulationConfig:
        """Return the settings of a flight."""
        return numbered(self.config, number, flights_per_scene=self.flights_per_scene)

    def missing(self) -> list[int]:
        """Return the numbers of the flights that are not there yet."""
        return [number for number in range(self.flight_count) if not self.path(number).exists()]


def _indented(text: str) -> str:
    return "".join(f"  {line}\n" if line else "\n" for line in text.splitlines())


def prepare(plan: DatasetPlan) -> None:
    """Make the folder, or see that what is in it belongs to this data set."""
    described = plan.folder / "dataset.yaml"
    if described.exists():
        if described.read_text("utf-8") != plan.description:
            raise FileExistsError(
                f"{plan.folder} holds a data set of other settings or another version: name another folder"
            )
    elif plan.folder.exists() and any(plan.folder.iterdir()):
        raise FileExistsError(f"{plan.folder} is not empty, and holds no data set: name another folder")
    with naming_file(plan.folder):
        (plan.folder / "flights").mkdir(parents=True, exist_ok=True)
    for left in (plan.folder / "flights").glob(".*.part"):
        left.unlink()
    write_whole(described, plan.description.encode())


def make_flights(
    plan: DatasetPlan, *, workers: int, stopped: Callable[[], bool], seconds: float = 0.2
) -> Iterator[int]:
    """Fly what is missing; yield the number of each flight when it is there.

    `plan`: what to make; `prepare` must have been called. `workers`: processes; 0: in this one. `stopped`:
    asked now and then; when it returns true, flights that have begun are given up. `seconds`: how often it is
    asked at least [s].
    """
    missing = plan.missing()
    if workers == 0:
        for number in missing:
            if stopped():
                return
            yield fly(plan, number)
        return
    count = min(workers, max(1, len(missing)))
    stretches = [(plan, numbers) for numbers in stretches_of(plan, workers)]
    cores = core_count() // count  # more threads than cores would wait for each other
    with multiprocessing.get_context("spawn").Pool(count, begin_worker, (cores,)) as pool:
        known = {process.pid for process in pool._pool}  # type: ignore[attr-defined]
        result = pool.map_async(_fly_stretch, stretches, chunksize=1)
        while missing:
            result.wait(seconds)
            there = [number for number in missing if plan.path(number).exists()]
            missing = [number for number in missing if number not in there]
            yield from there
            if result.ready():
                result.get()  # raises what a worker has raised
            if stopped():
                return
            if known != {process.pid for process in pool._pool}:  # type: ignore[attr-defined]
                raise RuntimeError("a worker died; the same command goes on")


def stretches_of(plan: DatasetPlan, workers: int) -> list[list[int]]:
    """Return the missing flights in parts; those of one scene stay together, as a worker loads it once."""
    missing = plan.missing()
    size = max(1, min(plan.flights_per_scene, -(-len(missing) // workers)))
    return [missing[begin : begin + size] for begin in range(0, len(missing), size)]


_scene: tuple[str, Model] | None = None
"""The last scene of this worker, by its settings: the next flight may be in it."""


def begin_worker(cores: int) -> None:
    """Prepare a process that this one has spawned: it uses so many cores, and ends with this one."""
    import signal

    from neurosim_core.warp_start import start_warp

    limit_cores(cores)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    threading.Thread(target=_end_with_parent, daemon=True).start()
    start_warp()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _fly_stretch(task: tuple[DatasetPlan, list[int]]) -> None:
    plan, numbers = task
    for number in numbers:
        fly(plan, number)


def fly(plan: DatasetPlan, number: int) -> int:
    """Make one flight in this process; return its number."""
    config, path = plan.settings(number), plan.path(number)
    model = _model(config)
    part, stats = path.with_name(f".{path.name}.part"), FlightStats()
    # By size alone: the layout of the file must not depend on the clock.
    with RecordingWriter(part, header_of(model), flush_interval_s=float("inf")) as out:
        try:
            for packet in run_model(model, make_state(model)):
                out.write(packet)
                stats.add(packet)
        except DynamicsError as error:
            stats.failure = str(error)
    write_whole(path.with_suffix(".json"), (json.dumps(vars(stats)) + "\n").encode())
    part.replace(path)
    return number


def _model(config: SimulationConfig) -> Model:
    """Return the model of a flight; the scene, if it is that of the flight before, is not loaded again."""
    global _scene
    key = config.model_copy(update={"seed": 0, "path": load_config({}).path}).model_dump_json()
    if _scene is not None and _scene[0] == key:
        return refit(_scene[1], config, replan=True)
    _scene = (key, make_model(config))
    return _scene[1]


def write_checksums(plan: DatasetPlan) -> None:
    """Write SHA256SUMS."""
    lines = []
    for path in sorted(p for p in plan.folder.rglob("*") if p.is_file() and p.name[0] != "."):
        if path.name != "SHA256SUMS":
            with open(path, "rb") as file:
                lines.append(f"{_sha256(file)}  {path.relative_to(plan.folder)}\n")
    write_whole(plan.folder / "SHA256SUMS", "".join(lines).encode())


def _sha256(file: Any) -> str:
    digest = hashlib.sha256()
    while data := file.read(1 << 20):
        digest.update(data)
    return digest.hexdigest()


def write_whole(path: Path, data: bytes) -> None:
    """Write a file that is there as a whole or not at all."""
    part = path.with_name(f".{path.name}.part")
    with naming_file(path):
        part.write_bytes(data)
        part.replace(path)
