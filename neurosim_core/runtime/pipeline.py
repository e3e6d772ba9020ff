"""How batches share a device: streams, the fences between them, and graphs. It changes no result.

A batch goes through three stages: its flight, its renders, and the scans of its frames. With several batches
in flight each stage has streams of its own, and the next batch flies while this one is rendered. With one,
all its launches are one graph, where they may be.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import warp as wp

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

    def batch(self, number: int) -> AbstractContextManager[None]:
        """Launch all stages of a batch."""
        return self._whole(number) if self._as_one else nullcontext()

    @contextmanager
    def _whole(self, number: int) -> Iterator[None]:
        self._waiting = []
        try:
            yield
        finally:
            waiting, self._waiting = self._waiting, None
        with timed(self._wall_s, "launches"):
            self.graphs.run_all(waiting)
            self._flown[number % self.flown_ahead].set()
            self._done[number % self.in_flight].set()

    def flight(self, number: int) -> AbstractContextManager[None]:
        """Launch the flight of a batch."""
        end = self._flown[number % self.flown_ahead]
        return self._stage("dynamics and control", self._flight_stream, None, end)

    def choice(self, number: int) -> AbstractContextManager[None]:
        """Find what is rendered of a batch that flies, ahead of the renderers."""
        flown = self._flown[number % self.flown_ahead]
        return self._stage("choice of renders", self._choice_stream, flown, None)

    def renders(self, number: int) -> AbstractContextManager[None]:
        """Launch the renders of a batch whose flight was launched."""
        flown, stream = self._flown[number % self.flown_ahead], self._render_streams[number % self.in_flight]
        return self._stage("render", stream, flown, self._rendered)

    def scans(self, number: int) -> AbstractContextManager[None]:
        """Launch the scans of the frames that were rendered last; that is the end of the batch."""
        end = self._done[number % self.in_flight]
        return self._stage("events", self._scan_stream, self._rendered, end)

    def _stage(
        self, phase: str, stream: wp.Stream | None, after: Fence | None, end: Fence | None
    ) -> AbstractContextManager[None]:
        if self._waiting is not None:  # nothing is launched yet
            after = end = None
        return _Stage(self._wall_s, phase, stream, after, end)

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


class _Stage(timed):
    """Launches a block on a stream (None: the current one), behind a fence, and sets another at its end."""

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
