"""How batches share a device: streams, the fences between them, and graphs. It changes no result.

A batch goes through three stages: its flight, its renders, and the scans of its frames. With several batches
in flight each stage has streams of its own, and the next batch flies while this one is rendered. With one,
all its launches are one graph, where they may be.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from neurosim_core.runtime.cuda import Fence, GraphCache, Launches, make_stream, use_stream
from neurosim_core.runtime.timing import timed


class Pipeline:
    """The stages of batches, which are counted; each is launched by one thread at a time.

    Args:
        device: Where to launch.
        wall_s: Wall-clock time by phase [s], which is added to.
        in_flight: The most batches that are launched and not read.
        flown_ahead: The most batches that are flown and not rendered.
        as_one: All launches of a `batch` are one graph; nothing of it is launched before its end.
        chooses: The flight has to be known before what is rendered is.

    Attributes:
        graphs: The launches that came before.
    """

    def __init__(
        self,
        device: str,
        wall_s: dict[str, float],
        *,
        in_flight: int,
        flown_ahead: int,
        as_one: bool,
        chooses: bool,
    ) -> None:
        self.in_flight, self.flown_ahead = in_flight, flown_ahead
        self.graphs = GraphCache(device)
        self._wall_s = wall_s
        self._as_one = as_one
        self._waiting: list[Launches] | None = None
        """Launches of the batch that is launched as one; None: there is none."""
        streams = in_flight > 1  # with one batch in flight nothing overlaps
        self._flight_stream = make_stream(device, high_priority=True) if streams else None
        # of each batch in flight: the last rays of one and the first of the next fill the device together
        self._render_streams = [make_stream(device) if streams else None for _ in range(in_flight)]
        self._scan_stream = make_stream(device, high_priority=True) if streams else None
        self._choice_stream = make_stream(device, high_priority=True) if streams and chooses else None
        self._flown = [Fence(device) for _ in range(flown_ahead)]
        self._rendered = Fence(device)
        self._done = [Fence(device) for _ in range(in_flight)]

    def run(self, launches: Launches) -> None:
        """Launch in a stage; in a batch that is launched as one, at its end."""
        if self._waiting is None:
            self.graphs.run(*launches)
        else:
            self._waiting.append(launches)

    @contextmanager
    def batch(self, number: int) -> Iterator[None]:
        """Launch all stages of a batch."""
        if not self._as_one:
            yield
            return
        self._waiting = []
        try:
            yield
        finally:
            waiting, self._waiting = self._waiting, None
        with timed(self._wall_s, "launches"):
            self.graphs.run_all(waiting)
            self._flown[number % self.flown_ahead].set()
            self._done[number % self.in_flight].set()

    @contextmanager
    def flight(self, number: int) -> Iterator[None]:
        """Launch the flight of a batch."""
        with timed(self._wall_s, "dynamics and control"), use_stream(self._flight_stream):
            yield
            self._end(self._flown[number % self.flown_ahead])

    @contextmanager
    def choice(self, number: int) -> Iterator[None]:
        """Find what is rendered of a batch that flies, ahead of the renderers."""
        with timed(self._wall_s, "choice of renders"), use_stream(self._choice_stream):
            self._flown[number % self.flown_ahead].wait_on_stream()
            yield

    @contextmanager
    def renders(self, number: int) -> Iterator[None]:
        """Launch the renders of a batch whose flight was launched."""
        stream = self._render_streams[number % self.in_flight]
        with timed(self._wall_s, "render"), use_stream(stream):
            self._wait(self._flown[number % self.flown_ahead])
            yield
            self._end(self._rendered)

    @contextmanager
    def scans(self, number: int) -> Iterator[None]:
        """Launch the scans of the frames that were rendered last; that is the end of the batch."""
        with timed(self._wall_s, "events"), use_stream(self._scan_stream):
            self._wait(self._rendered)
            yield
            self._end(self._done[number % self.in_flight])

    def wait_flown(self, number: int) -> None:
        """Wait for the flight of a batch."""
        self._flown[number % self.flown_ahead].wait()

    def wait(self, number: int) -> None:
        """Wait for the end of a batch."""
        self._done[number % self.in_flight].wait()

    def wait_all(self) -> None:
        """Wait for all batches."""
        for done in self._done:
            done.wait()

    def _wait(self, fence: Fence) -> None:
        if self._waiting is None:
            fence.wait_on_stream()

    def _end(self, fence: Fence) -> None:
        if self._waiting is None:
            fence.set()
