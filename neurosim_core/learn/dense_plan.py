"""Processes that plan the paths of the next flights of worlds while the present ones are flown.

`python -m neurosim_core.learn.dense_plan` is one of them: it answers each pickled list of settings on its
standard input with their paths on its standard output, until the input ends.
"""

from __future__ import annotations

import contextlib
import functools
import pickle
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from neurosim_core.config import SimulationConfig
from neurosim_core.render.launch import core_count, limit_cores, single_threaded_blas
from neurosim_core.scene.freespace import FreeSpace, FreeSpaceConfig, make_free_space
from neurosim_core.sim.model import plan_path
from neurosim_core.trajectory import Path
from neurosim_core.warp_start import start_warp

_PROCESSES_MAX = 8
_SPACES_MAX = 8
"""Free spaces that a process keeps."""


class PathPlanner:
    """Plans paths in other processes: half as many as there are cores, at most eight.

    Use it in a `with` statement, which ends the processes; without, they end with this process.
    """

    def __init__(self) -> None:
        environment = {**single_threaded_blas(), "CUDA_VISIBLE_DEVICES": ""}
        self._processes = [
            subprocess.Popen(
                [sys.executable, "-m", __name__],
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
            )
            for _ in range(max(1, min(_PROCESSES_MAX, core_count() // 2)))
        ]
        self._asked_of: list[int] = []
        """Number of the process that plans each path."""

    def __enter__(self) -> PathPlanner:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes:
            process.kill()
            process.communicate()

    def begin(self, flights: Sequence[SimulationConfig]) -> None:
        """Begin to plan the paths of some flights; `result` must have been called for those before."""
        count = len(self._processes)
        # A process is asked for the same scenes again, which it has read.
        self._asked_of = [getattr(flight.scene, "seed", k) % count for k, flight in enumerate(flights)]
        for index, process in enumerate(self._processes):
            own = [flight for of, flight in zip(self._asked_of, flights, strict=True) if of == index]
            assert process.stdin is not None
            pickle.dump(own, process.stdin)
            process.stdin.flush()

    def result(self) -> list[Path]:
        """Wait for the paths that were begun, and return them in their order."""
        answers: list[Iterator[Path]] = []
        for process in self._processes:
            assert process.stdout is not None
            try:
                answer = pickle.load(process.stdout)
            except EOFError:
                raise RuntimeError("a process that plans paths has died") from None
            if isinstance(answer, ValueError):
                raise answer
            answers.append(iter(answer))
        return [next(answers[index]) for index in self._asked_of]


@functools.lru_cache(maxsize=_SPACES_MAX)
def _free_space(scene: Any, config: FreeSpaceConfig) -> FreeSpace:
    return make_free_space(scene.load(pictures=False), config)


def _paths(flights: Sequence[SimulationConfig]) -> list[Path] | ValueError:
    paths = []
    for flight in flights:
        try:
            space = _free_space(flight.scene, flight.free_space)
            paths.append(plan_path(flight, space))
        except ValueError as error:
            return error
    return paths


def _answer() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that asks ends this one
    limit_cores(1)
    start_warp()
    answers, sys.stdout = sys.stdout.buffer, sys.stderr  # what is printed is no answer
    with contextlib.suppress(EOFError, BrokenPipeError):  # so it ends where the other process has ended
        while True:
            pickle.dump(_paths(pickle.load(sys.stdin.buffer)), answers)
            answers.flush()


if __name__ == "__main__":
    _answer()
