# mypy: disable-error-code="index,arg-type,no-untyped-call,var-annotated,union-attr,type-arg"
"""One frame a call: loops that render, scan and have the host read a count, ours and a naive one."""

from __future__ import annotations

import numpy as np
import warp as wp

from neurosim_core.bench.throughput_result import LOOP, Comparison
from neurosim_core.bench.throughput_stages import FRAME_US, Views, make_camera, make_naive, seconds_per_call
from neurosim_core.clock import NS_PER_US
from neurosim_core.streams import Graphs, Milestone, make_stream, on

_ROUNDS = 5
"""One round alone comes out up to a tenth higher or lower."""


class _Eyes:
    """Renders one view a call on a device, each in a stream and with a picture of its own, as a run does.

    Args:
        views: What to see.
        count: How many may be under way.
    """

    def __init__(self, views: Views, count: int) -> None:
        self._views = views
        self._graphs = Graphs(views.device)
        self._renderers = [views.renderer("log_radiance", instants=1) for _ in range(count)]
        self._streams = [make_stream(views.device) for _ in range(count)]
        self._seen = [Milestone(views.device) for _ in range(count)]

    def see(self, number: int, view: int) -> tuple[wp.array | None, Milestone]:
        """Launch the render of a view; return where its log radiance will be, and when."""
        eye = number % len(self._renderers)
        renderer = self._renderers[eye]
        with on(self._streams[eye], after=False):
            self._graphs.run((eye, view), lambda: self._views.render(renderer, first=view, count=1))
            self._seen[eye].set()
        return renderer.log_radiance, self._seen[eye]


def compare_loops(views: Views, *, seconds: float) -> Comparison:
    """Return frames a second where every call renders one frame, scans it and has the host read a count.

    The naive camera has the count of its frame read at once. Ours first lets the next frame render, and then
    waits for the scan of the one before: the count that a call reads is that one's. Our renders are graphs
    that are replayed, as in a run; those of the naive loop are launched. Each 16 frames our events are sorted
    and handed out as well; the naive ones stay where they are, unsorted. The two take turns, and the median
    of the rounds counts.

    Args:
        views: What to see.
        seconds: How long a round of either is, about.
    """
    camera, naive = make_camera(views, scan_count_max=1), make_naive(views)
    camera.reset(views.frames[0], 0)
    order = [*range(views.count), *reversed(range(views.count))]
    eyes = _Eyes(views, 2)  # while one frame is scanned, the next is rendered
    scans = make_stream(views.device, urgent=True)
    renderer = views.renderer("log_radiance", instants=1)
    ours_shown, ours, naive_shown, theirs = 0, 0, 0, 0

    def stamp_ns(frame: int) -> int:
        return frame * FRAME_US * NS_PER_US

    def read(frame: int) -> int:
        """Read how many events a frame has; return how many were handed out."""
        ends = [stamp_ns(frame)] if frame % 16 == 0 else []
        return sum(len(packet.numpy().t) for packet in camera.collect_windows(ends, scan_count=1))

    def call_ours() -> None:
        nonlocal ours_shown, ours
        frames, seen = eyes.see(ours_shown, order[ours_shown % len(order)])
        with on(scans, after=False):
            if ours_shown > 0:
                ours += read(ours_shown)
            ours_shown += 1
            seen.hold()
            camera.feed_device(frames, [stamp_ns(ours_shown)])

    def call_naive() -> None:
        nonlocal naive_shown, theirs
        views.render(renderer, first=order[naive_shown % len(order)], count=1)
        naive_shown += 1
        assert renderer.log_radiance is not None
        theirs += naive.feed(renderer.log_radiance[0], naive_shown * FRAME_US)

    wp.synchronize_device(views.device)  # what was made on other streams is there
    rounds = [
        [seconds_per_call(call, views.device, seconds=seconds) for call in (call_ours, call_naive)]
        for _ in range(_ROUNDS)
    ]
    ours += len(camera.collect().numpy().t)
    ours_s, naive_s = np.median(rounds, axis=0)
    return Comparison(
        name=LOOP,
        ours_per_s=1.0 / ours_s,
        naive_per_s=1.0 / naive_s,
        ours_events=ours / ours_shown,
        naive_events=theirs / naive_shown,
    )
