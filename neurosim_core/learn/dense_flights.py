"""Flights to learn from: their settings, and processes that fly or plan the next ones meanwhile."""

from __future__ import annotations

import contextlib
import functools
import itertools
import multiprocessing
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any

from neurosim_core.config import SimulationConfig
from neurosim_core.data.make import begin_worker
from neurosim_core.data.ray_source import SEEDS_APART
from neurosim_core.render.launch import core_count, single_threaded_blas
from neurosim_core.scene.freespace import FreeSpace, FreeSpaceConfig, make_free_space
from neurosim_core.sim.model import plan_path
from neurosim_core.trajectory import Path

_PLANNERS_MAX = 8
_SPACES_MAX = 8
"""Free spaces that a process keeps."""


def flight_settings(
    size_px: int, seed: int, *, field: str = "depth", duration_s: float = 6.0, device: str = "cpu"
) -> dict[str, Any]:
    """Return the settings of a flight through an apartment of its own; one camera has events and a field."""
    lens = {"width": size_px, "height": size_px, "horizontal_fov_rad": 1.5}
    truth: dict[str, dict[str, Any]] = {
        "events": {},
        "depth": {"depth": {"kind": "depth", "lens": lens, "rate_hz": 20.0}},
        "flow": {"flow": {"kind": "optical_flow", "lens": lens, "rate_hz": 20.0, "occlusion": False}},
    }
    return {
        "duration_s": duration_s,
        "device": device,
        "seed": seed,
        "scene": {"kind": "apartment", "rooms": 1, "seed": seed},
        "path": {"kind": "tour", "seed": seed},
        "vehicle": {"on_collision": "report"},
        "sensors": {
            "events": {
                "kind": "event_camera", "lens": lens, "sampling_rate_hz": 200.0, "packet_rate_hz": 20.0,
            },
            **truth[field],
        },
    }  # fmt: skip


@contextlib.contextmanager
def live_flights(count: int, settings: Mapping[str, Any], *, seed: int = 0) -> Iterator[list[str]]:
    """Run processes that stream flights, each scene after scene, and end them.

    Yield their namespaces, for `ns.data.LiveSource`. Flight k of the first process has the seeds `seed + k`
    of scene, path and noise. They end, too, when this process is killed.
    """
    os.environ.update(single_threaded_blas())  # of the processes
    names = [f"/flight{index}" for index in range(count)]
    processes = [
        multiprocessing.get_context("spawn").Process(
            target=_stream_flights,
            args=(name, dict(settings), seed + SEEDS_APART * index, core_count() // count),
            daemon=True,
        )
        for index, name in enumerate(names)
    ]
    try:
        for process in processes:
            process.start()
        yield names
    finally:
        for process in processes:
            process.terminate()
            process.join()


def _stream_flights(namespace: str, settings: Mapping[str, Any], seed: int, cores: int) -> None:
    """Fly and publish, as fast as readers take it, until the process is ended."""
    from cortex import Node
    from cortex.messages import Simulation
    from neurosim_core import __version__
    from neurosim_core.config import load_config, to_yaml
    from neurosim_core.data.sources import numbered
    from neurosim_core.live.messages import message_type, to_message
    from neurosim_core.live.topics import SIMULATION, stream_topic
    from neurosim_core.sim.rollout import run

    begin_worker(cores)
    config = load_config(dict(settings))
    (vehicle,) = config.vehicles
    with Node(f"flights{namespace.replace('/', '_')}") as node:
        publishers = {
            name: node.publisher(
                namespace + stream_topic(vehicle, name), message_type(sensor.packet_class), max_wait_s=600.0
            )
            for name, sensor in config.sensors.items()
        }
        announcement = Simulation(
            config=to_yaml(config),
            version=__version__,
            vehicles=[vehicle],
            mode="streaming",
            control_rate_hz=100.0,
        )
        node.publisher(namespace + SIMULATION, Simulation, latch=True).publish(announcement)
        for number in itertools.count(seed):
            for packet in run(numbered(config, number)):
                for publisher in publishers.values():
                    publisher.wait_for_subscribers(1, timeout_s=600.0)
                publishers[packet.sensor].publish(to_message(packet))


class PathPlanner:
    """Plans paths in other processes: half as many as there are cores, at most eight.

    Use it in a `with` statement, which ends the processes.
    """

    def __init__(self) -> None:
        os.environ.update(single_threaded_blas())  # of the processes
        spawn = multiprocessing.get_context("spawn")
        self._processes = [
            ProcessPoolExecutor(1, spawn, _begin_planner)
            for _ in range(max(1, min(_PLANNERS_MAX, core_count() // 2)))
        ]
        self._planned: list[Future[Path]] = []

    def __enter__(self) -> PathPlanner:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes:
            process.shutdown(wait=False, cancel_futures=True)

    def begin(self, flights: Sequence[SimulationConfig]) -> None:
        """Begin to plan the paths of some flights."""
        # A process is asked for the same scenes again, which it has read.
        places = (getattr(flight.scene, "seed", k) % len(self._processes) for k, flight in enumerate(flights))
        self._planned = [
            self._processes[place].submit(_plan, flight)
            for place, flight in zip(places, flights, strict=True)
        ]

    def result(self) -> list[Path]:
        """Wait for the paths that were begun, and return them in their order."""
        return [planned.result() for planned in self._planned]


def _begin_planner() -> None:
    os.environ["CUDA_VISIBLE_DEVICES"] = ""
    begin_worker(cores=1)


def _plan(flight: SimulationConfig) -> Path:
    return plan_path(flight, _free_space(flight.scene, flight.free_space))


@functools.lru_cache(maxsize=_SPACES_MAX)
def _free_space(scene: Any, config: FreeSpaceConfig) -> FreeSpace:
    return make_free_space(scene.load(pictures=False), config)
