"""Simulators on a cluster of Ray: as a source of windows, and to make data sets.

Needs the extra `distributed`. Every simulator is an actor or a task whose results come as a stream. Ray stops
it when a few results wait to be taken: memory does not grow where training is slower than the simulators.
"""

from __future__ import annotations

import contextlib
import itertools
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from neurosim_core.config import SimulationConfig, as_config
from neurosim_core.data.batch import Sample
from neurosim_core.data.make import DatasetPlan, fly, stretches_of, write_whole
from neurosim_core.data.sources import RunSource, fields_of, numbered
from neurosim_core.data.windows import WindowConfig, choose_sensors
from neurosim_core.install import need
from neurosim_core.render.launch import limit_cores

SEEDS_APART = 10_000
"""Difference between the seeds of the first flights of two simulators."""
_BLOCK = 16
"""Number of windows in a message."""
_WAITING = 4
"""Largest number of waiting blocks of a simulator."""


@contextlib.contextmanager
def cluster(address: str) -> Iterator[Any]:
    """Yield the module `ray`, connected to a cluster; a cluster that is started here ends with the block.

    Args:
        address: Address for `ray.init`: `local` starts a cluster on this machine, `auto` finds a running one
            on this machine, else host:port. An existing connection of the process is reused.

    Raises:
        ImportError: Ray is not installed.
        ConnectionError: There is no such cluster.
    """
    ray = need("clusters need Ray", "distributed", "ray")
    if ray.is_initialized():
        yield ray
        return
    options = {"include_dashboard": False} if address == "local" else {}
    try:
        ray.init(address=address, log_to_driver=False, **options)
    except ConnectionError as error:
        where = "on this machine (`ray start --head` starts one)" if address == "auto" else f"at {address}"
        raise ConnectionError(
            f"there is no Ray cluster {where}; `local` starts one for this command"
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()


class RaySource:
    """Simulators on a Ray cluster, each of which flies one flight after the other; see `Stream`.

    Flight k of simulator n adds `first + 10,000 n + k` to the seeds of scene, path and noise in the settings.
    Its windows equal those of the same settings in this process, to the byte.

    Args:
        config: Settings, or anything that `load_config` accepts; files of scenes must be on all machines.
        simulators: Number of parallel simulators; each uses one CPU.
        address: See `cluster`.
        first: See above.
        flights: Number of flights of each simulator; None: endless.
    """

    def __init__(
        self,
        config: SimulationConfig | Mapping[str, Any],
        *,
        simulators: int = 2,
        address: str = "local",
        first: int = 0,
        flights: int | None = None,
    ) -> None:
        self._config = as_config(config)
        self._address = address
        self._firsts = [first + SEEDS_APART * n for n in range(simulators)]
        self._flights = flights
        self.skipped_count = 0

    def samples(self, config: WindowConfig) -> Iterator[Sample]:
        """See `SampleSource.samples`; windows of different simulators come in any order.

        Raises:
            ImportError, ConnectionError: See `cluster`.
            ValueError: The settings do not have what is wanted.
        """
        choose_sensors(fields_of(self._config), config, source="a flight")
        self.skipped_count = 0
        with cluster(self._address) as ray:
            kind = ray.remote(_Simulator)
            actors = [kind.remote(self._config, begin, self._flights) for begin in self._firsts]
            options = {"num_returns": "streaming", "_generator_backpressure_num_objects": _WAITING}
            streams = (actor.fly.options(**options).remote(config) for actor in actors)
            try:
                for samples, skipped in _as_they_come(ray, streams, most=len(actors)):
                    yield from samples
                    self.skipped_count += skipped
            finally:
                for actor in actors:
                    ray.kill(actor)


class _Simulator:
    """Simulates flights in an actor of Ray."""

    def __init__(self, config: SimulationConfig, first: int, flights: int | None) -> None:
        limit_cores(1)
        self._config = config
        self._numbers = itertools.count(first) if flights is None else range(first, first + flights)

    def fly(self, config: WindowConfig) -> Iterator[tuple[list[Sample], int]]:
        """Yield windows, a few at a time, and how many without ground truth were left out."""
        for number in self._numbers:
            flight = RunSource(numbered(self._config, number))
            samples = (replace(s, source=f"flight {number}") for s in flight.samples(config))
            while block := [*itertools.islice(samples, _BLOCK)]:
                yield block, 0
            yield [], flight.skipped_count


def _as_they_come(ray: Any, streams: Iterator[Any], *, most: int) -> Iterator[Any]:
    """Yield the results of streams, `most` side by side; cancel what is left if they are given up."""
    left = [*itertools.islice(streams, most)]
    try:
        while left:
            ready, _ = ray.wait(left, num_returns=1)
            for stream in ready:
                try:
                    yield ray.get(next(stream))
                except StopIteration:
                    left.remove(stream)
                    left += itertools.islice(streams, 1)
                except ray.exceptions.RayTaskError as error:
                    raise error.cause from None  # what the simulator raised
    finally:
        for stream in left:
            ray.cancel(stream)


def make_flights_on_ray(
    plan: DatasetPlan, *, address: str, workers: int, stopped: Callable[[], bool]
) -> Iterator[int]:
    """Do what `make_flights` does, on a cluster: recordings are sent here, and no disk need be shared.

    `plan`: see `make_flights`. `address`: see `cluster`. `stopped`: see `make_flights`.
    """
    waiting = stretches_of(plan, workers)
    with cluster(address) as ray:
        task = ray.remote(_fly_there).options(num_returns="streaming", _generator_backpressure_num_objects=1)
        streams = (task.remote(plan, numbers) for numbers in waiting)
        for number, files in _as_they_come(ray, streams, most=workers):
            for suffix, data in files.items():  # the recording comes last: with it the flight is there
                write_whole(plan.path(number).with_suffix(suffix), data)
            yield number
            if stopped():
                return


def _fly_there(plan: DatasetPlan, numbers: list[int]) -> Iterator[tuple[int, dict[str, bytes]]]:
    """Yield flights as the bytes of their files."""
    limit_cores(1)
    for number in numbers:
        with tempfile.TemporaryDirectory() as folder:
            there = replace(plan, folder=Path(folder))
            there.path(number).parent.mkdir()
            fly(there, number)
            yield number, {s: there.path(number).with_suffix(s).read_bytes() for s in (".json", ".h5")}
