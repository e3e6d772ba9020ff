"""Graphs on a CPU: launches that come again are recorded and replayed, as they are on a CUDA device.

What a key does not tell apart then shows: a replay does what the recorded launches did.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any

import pytest
import warp as wp

from neurosim_core.runtime.cuda import GraphCache, RecordedLaunch


class CpuGraphs:
    """Counts what is launched.

    Attributes:
        replayed_count: Graphs that were replayed.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.replayed_count = 0
        recorded: dict[tuple[int, Hashable], Any] = {}
        kept: list[object] = []

        def run(cache: GraphCache, key: Hashable | None, launch: Callable[[], object]) -> None:
            place = id(cache), key
            if key is None or place not in recorded:
                kept.append((cache, launch()))
                recorded.setdefault(place, None)
                return
            if recorded[place] is None:
                with wp.ScopedCapture("cpu") as capture:
                    kept.append(launch())
                recorded[place] = capture.graph
            wp.capture_launch(recorded[place])
            self.replayed_count += 1

        def relaunch(
            self: RecordedLaunch, dim: Any, arguments: Sequence[Any], *, key: Hashable | None = None
        ) -> None:
            wp.launch(self._kernel, dim=dim, inputs=list(arguments), device="cpu")

        monkeypatch.setattr(GraphCache, "run", run)
        monkeypatch.setattr(RecordedLaunch, "launch", relaunch)


@pytest.fixture
def cpu_graphs(monkeypatch: pytest.MonkeyPatch) -> Iterator[CpuGraphs]:
    """Return the graphs of one core, on which each kernel is one launch."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    yield CpuGraphs(monkeypatch)
    os.sched_setaffinity(0, allowed)
