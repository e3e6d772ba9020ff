"""The pipeline of batches on a device: streams, the fences between them, and graphs. It changes no result.

A batch passes three stages: its flight, its renders, and the scans of its frames. With several batches in
flight, each stage has its own streams, and the next batch flies while this one is rendered. With one batch in
flight, all its launches form one graph if `single_graph` allows it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import warp as wp

from neurosim_core.runtime.cuda import Fence, GraphCache, Launches, make_stream, use_stream
from neurosim_core.runtime.timing import timed


class Pipeline:
    """Runs the stages of numbered batches on a device. One thread at a time launches a stage.

    Args:
        device: Where to launch.
        wall_s: Wall-clock time by phase [s]; the pipeline adds to it.
        in_flight: Largest number of batches that are launched and not read.
        flown_ahead: Largest number of batches that are flown and not rendered.
        single_graph: Collect all launches of a `batch` and launch them as one graph at its end.
        adaptive: The motion of a batch decides which instants are rendered.

    Attributes:
        graphs: The cache of recorded graphs.
    """

    def __init__(
        self,
        device: str,
        wall_s: dict[str, float],
        *,
        in_flight: int,
        flown_ahead: int,
        single_graph: bool,
        adaptive: bool,
    ) -> None:
        self.in_flight, self.flown_ahead = in_flight, flown_ahead
        self.graphs = GraphCache(device)
        self._wall_s = wall_s
        self._single_graph = single_graph
        self._waiting: list[Launches] | None = None
        """Launches of the batch that becomes one graph; None outside such a batch."""
        streams = in_flight > 1  # with one batch in flight nothing overlaps
        self._flight_stream = make_stream(device, high_priority=True) if streams else None
        # one per batch in flight: the last rays of one and the first of the next fill the device together
        self._render_streams = [make_stream(device) if streams else None for _ in range(in_flight)]
        self._scan_stream = make_stream(device, high_priority=True) if streams else None
        self._choice_stream = make_stream(device, high_priority=True) if streams and adaptive else None
        self._flight_done = [Fence(device) for _ in range(flown_ahead)]
        self._rendered = Fence(device)
        self._done = [Fence(device) for _ in range(in_flight)]

    def run(self, launches: Launches) -> None:
        """Launch in a stage, or at the end of the batch if the batch becomes one graph."""
        if self._waiting is None:
            self.graphs.run(*launches)
        else:
            self._waiting.append(launches)

    def batch(self, number: int) -> AbstractContextManager[None]:
        """Return the context in which all stages of a batch are launched."""
        return self._whole(number) if self._single_graph else nullcontext()

    @contextmanager
    def _whole(self, number: int) -> Iterator[None]:
        self._waiting = []
        try:
            yield
        finally:
            waiting, self._waiting = self._waiting, None
        with timed(self._wall_s, "launches"):
            self.graphs.run_all(waiting)
            self._flight_done[number % self.flown_ahead].set()
            self._done[number % self.in_flight].set()

    def flight(self, number: int) -> AbstractContextManager[None]:
        """Return the context in which the flight of a batch is launched."""
        end = self._flight_done[number % self.flown_ahead]
        return self._stage("dynamics and control", self._flight_stream, None, end)

    def choice(self, number: int) -> AbstractContextManager[None]:
        """Return the context in which the instants to render are chosen, ahead of the renders."""
        flown = self._flight_done[number % self.flown_ahead]
        return self._stage("choice of renders", self._choice_stream, flown, None)

    def renders(self, number: int) -> AbstractContextManager[None]:
        """Return the context in which the renders of a batch are launched, after its flight."""
        flown = self._flight_done[number % self.flown_ahead]
        stream = self._render_streams[number % self.in_flight]
        return self._stage("render", stream, flown, self._rendered)

    def scans(self, number: int) -> AbstractContextManager[None]:
        """Return the context in which the last rendered frames are scanned, the last stage of a batch."""
        end = self._done[number % self.in_flight]
        return self._stage("events", self._scan_stream, self._rendered, end)

    def _stage(
        self, phase: str, stream: wp.Stream | None, after: Fence | None, end: Fence | None
    ) -> AbstractContextManager[None]:
        if self._waiting is not None:  # nothing is launched yet
            after = end = None
        return _Stage(self._wall_s, phase, stream, after, end)

    def wait_flight(self, number: int) -> None:
        """Wait for the flight of a batch."""
        self._flight_done[number % self.flown_ahead].wait()

    def wait(self, number: int) -> None:
        """Wait for the end of a batch."""
        self._done[number % self.in_flight].wait()

    def wait_all(self) -> None:
        """Wait for all batches."""
        for done in self._done:
            done.wait()


class _Stage(timed):
    """Runs a block on a stream (None: the current one), between a fence to wait for and one to set."""

    __slots__ = ("_after", "_end", "_on")

    def __init__(
        self,
        wall_s: dict[str, float],
        phase: str,
        stream: wp.Stream | None,
        after: Fence | None,
        end: Fence | None,
    ) -> None:
        super().__init__(wall_s, phase)
        self._on = None if stream is None else use_stream(stream)
        self._after, self._end = after, end

    def __enter__(self) -> None:
        super().__enter__()
        if self._on is not None:
            self._on.__enter__()
        if self._after is not None:
            self._after.wait_on_stream()

    def __exit__(self, *_: object) -> None:
        if self._end is not None:
            self._end.set()
        if self._on is not None:
            self._on.__exit__(None, None, None)
        super().__exit__()
