# mypy: disable-error-code="index,arg-type,no-untyped-call,var-annotated,union-attr,type-arg"
"""One frame a call: loops that render, scan and have the host read a count, ours and a naive one."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
import warp as wp

from neurosim_core.bench.throughput_result import LOOP, LOOP_AT_ONCE, Comparison
from neurosim_core.bench.throughput_stages import FRAME_US, Views, make_camera, make_naive, seconds_per_call
from neurosim_core.clock import NS_PER_US
from neurosim_core.runtime.cuda import Fence, GraphCache, make_stream, use_stream

_AHEAD = 2
"""Frames whose renders are launched before the count of one is read: more of them are no faster."""
_HANDED_OUT = 16
"""Frames after which our events are sorted and handed out."""
_ROUNDS = 5
"""One round alone comes out up to a tenth higher or lower."""


class _Eyes:
    """Renders one view a call on a device, each in a stream and with a picture of its own, as a run does.

    Args:
        views: What to see, forth and back.
        streams: They take turns.

    Attributes:
        count: Views that were rendered.
    """

    def __init__(self, views: Views, streams: Sequence[wp.Stream | None]) -> None:
        self.count = 0
        self._views = views
        self._order = [*range(views.count), *reversed(range(views.count))]
        self._streams = streams
        self._graphs = GraphCache(views.device)
        self._renderers = [views.renderer("log_radiance", instants=1) for _ in streams]
        self._seen = [Fence(views.device) for _ in streams]

    def see(self) -> tuple[wp.array | None, Fence]:
        """Launch the render of the next view; return where its log radiance will be, and when."""
        eye, view = self.count % len(self._renderers), self._order[self.count % len(self._order)]
        self.count += 1
        renderer, stream = self._renderers[eye], self._streams[eye]
        self._graphs.run(
            (eye, view), lambda: self._views.render(renderer, first=view, count=1), stream=stream
        )
        self._seen[eye].set(stream)
        return renderer.log_radiance, self._seen[eye]


class _Loop:
    """Our loop: each call renders a frame, scans one, and reads how many events one has.

    Args:
        views: What to see.
        ahead: How many frames are rendered before the count of one is read; 0: it is that of the same call.
    """

    def __init__(self, views: Views, ahead: int) -> None:
        self._camera = make_camera(views, scan_count_max=1)
        self._camera.reset(views.frames[0], 0)
        self.stream = make_stream(views.device, high_priority=True)
        """Where calls are to be made."""
        streams = [make_stream(views.device) for _ in range(ahead + 1)] if ahead else [self.stream]
        self._eyes = _Eyes(views, streams)
        self._ahead = ahead
        self._rendered: deque[tuple[wp.array | None, Fence]] = deque()
        self._scanned_count = self._read_count = 0
        self.event_count = 0
        """Events that were handed out."""

    @property
    def events_per_frame(self) -> float:
        """Return how many events a frame had."""
        return self.event_count / self._read_count

    def call(self) -> None:
        """Render the next frame."""
        self._rendered.append(self._eyes.see())
        if self._scanned_count > self._read_count:
            self._read()
        if len(self._rendered) >= self._ahead:
            self._scan()
        if self._ahead == 0:
            self._read()

    def end(self) -> None:
        """Read what has been scanned, and hand out the events that are left."""
        self.event_count += len(self._camera.collect().numpy().t)
        self._read_count = self._scanned_count

    def _scan(self) -> None:
        """Launch the scan of the oldest frame that has been rendered."""
        frames, seen = self._rendered.popleft()
        self._scanned_count += 1
        seen.wait_on_stream()
        self._camera.feed_device(frames, [_stamp_ns(self._scanned_count)])

    def _read(self) -> None:
        """Wait for the scan, and read how many events its frame has."""
        self._read_count += 1
        ends = [_stamp_ns(self._read_count)] if self._read_count % _HANDED_OUT == 0 else []
        packets = self._camera.collect_windows(ends, scan_count=1)
        self.event_count += sum(len(packet.numpy().t) for packet in packets)


def _stamp_ns(frame: int) -> int:
    return frame * FRAME_US * NS_PER_US


def compare_loops(views: Views, *, seconds: float) -> tuple[Comparison, Comparison]:
    """Return frames a second where every call renders one frame, scans it and has the host read a count.

    The naive camera has the count of its frame read at once. So has ours in the second comparison; in the
    first a call reads the count of the frame two before, while others render. Renders are graphs that are
    replayed, as in a run. Each 16 frames our events are sorted and handed out as well; the naive ones stay
    where they are, unsorted. The loops take turns, and the median of the rounds counts.

    Args:
        views: What to see.
        seconds: How long a round of each is, about.
    """
    loops = [_Loop(views, _AHEAD), _Loop(views, 0)]
    naive = make_naive(views)
    naive_stream = make_stream(views.device)
    naive_eyes = _Eyes(views, [naive_stream])
    frame = naive_eyes.see()[0][0]  # where each of them will be
    theirs = 0

    def call_naive() -> None:
        nonlocal theirs
        naive_eyes.see()
        theirs += naive.feed(frame, naive_eyes.count * FRAME_US)

    wp.synchronize_device(views.device)  # what was made on other streams is there
    rounds_s = []
    for _ in range(_ROUNDS):
        round_s = []
        for loop in loops:
            with use_stream(loop.stream):
                round_s.append(seconds_per_call(loop.call, views.device, seconds=seconds))
        with use_stream(naive_stream):
            round_s.append(seconds_per_call(call_naive, views.device, seconds=seconds))
        rounds_s.append(round_s)
    *ours_s, naive_s = np.median(rounds_s, axis=0)
    for loop in loops:
        loop.end()
    ahead, at_once = (
        Comparison(
            name=name,
            ours_per_s=1.0 / loop_s,
            naive_per_s=1.0 / naive_s,
            ours_events=loop.events_per_frame,
            naive_events=theirs / (naive_eyes.count - 1),  # the first was not fed
        )
        for name, loop, loop_s in zip((LOOP, LOOP_AT_ONCE), loops, ours_s, strict=True)
    )
    return ahead, at_once
