# mypy: disable-error-code="index,attr-defined,misc,no-untyped-call,arg-type,operator,untyped-decorator"
"""Which events of one stream are those of another: same pixel, same polarity, nearly the same time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.packets import EventArrays


@dataclass(frozen=True, kw_only=True, eq=False)
class Matching:
    """Pairs of events, and what is left on both sides."""

    reference: NDArray[np.int64]
    """Index of the reference event of each pair, shape [P]."""
    candidate: NDArray[np.int64]
    """Index of the candidate event of each pair, shape [P]."""
    missing: NDArray[np.int64]
    """Indices of the reference events without a partner, ascending."""
    spurious: NDArray[np.int64]
    """Indices of the candidate events without a partner, ascending."""


@wp.kernel(enable_backward=False)
def _pair(
    # In:
    reference_end: wp.array[wp.int64],
    candidate_end: wp.array[wp.int64],
    reference_us: wp.array[wp.int64],
    candidate_us: wp.array[wp.int64],
    tolerance_us: wp.int64,
    # Out:
    partner_out: wp.array[wp.int64],
) -> None:
    channel = wp.tid()
    row = wp.int64(0)
    column = wp.int64(0)
    if channel > 0:
        row = reference_end[channel - 1]
        column = candidate_end[channel - 1]
    while row < reference_end[channel] and column < candidate_end[channel]:
        late_us = candidate_us[column] - reference_us[row]
        if late_us < -tolerance_us:
            column += wp.int64(1)
        elif late_us > tolerance_us:
            row += wp.int64(1)
        else:
            partner_out[row] = column
            row += wp.int64(1)
            column += wp.int64(1)


def match_events(reference: EventArrays, candidate: EventArrays, *, tolerance_us: int) -> Matching:
    """Pair events of the same pixel and polarity that are at most a tolerance apart, as many as possible.

    In each pixel the earlier of two unpaired events is given up if the other is out of its reach, else they
    are paired: for windows of one width no other choice makes more pairs.

    Args:
        reference: The true events, in any order.
        candidate: Those to be judged.
        tolerance_us: Largest difference in time of a pair [us].
    """
    both = (reference, candidate)
    width = 1 + max((int(events.x.max()) for events in both if len(events.x)), default=0)
    channels = [_channels(events, width) for events in both]
    channel_count = 1 + max((int(channel.max()) for channel in channels if len(channel)), default=0)
    orders = [np.lexsort((events.t, channel)) for events, channel in zip(both, channels, strict=True)]
    ends = [np.cumsum(np.bincount(channel, minlength=channel_count)) for channel in channels]
    times = [np.asarray(events.t, dtype=np.int64)[order] for events, order in zip(both, orders, strict=True)]
    partner = wp.full(len(times[0]), -1, dtype=wp.int64, device="cpu")
    wp.launch(
        _pair,
        dim=channel_count,
        inputs=[*(wp.array(a, dtype=wp.int64, device="cpu") for a in (*ends, *times)), tolerance_us],
        outputs=[partner],
        device="cpu",
    )
    column = partner.numpy()
    matched, judged = orders[0][column >= 0], orders[1][column[column >= 0]]
    return Matching(
        reference=matched,
        candidate=judged,
        missing=_others(matched, len(times[0])),
        spurious=_others(judged, len(times[1])),
    )


def _channels(events: EventArrays, width: int) -> NDArray[np.int64]:
    """Return a number for each pixel and polarity."""
    y, x, polarity = (np.asarray(column, dtype=np.int64) for column in (events.y, events.x, events.polarity))
    return (y * width + x) * 2 + polarity


def _others(index: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return which of 0 ... count - 1 are not among the indices."""
    left = np.ones(count, dtype=np.bool_)
    left[index] = False
    return np.flatnonzero(left)


def take(events: EventArrays, index: Any) -> EventArrays:
    """Return the events at indices or under a mask."""
    return EventArrays(*(column[index] for column in events))
