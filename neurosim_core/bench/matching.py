# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,no-untyped-call,call-overload"
# mypy: disable-error-code="untyped-decorator,assignment"
"""The difference of two streams of events: the cheapest way to turn one into the other.

The events of one pixel and polarity are a spike train. To delete or insert an event costs 1, to shift one
within a window costs in proportion to the time. What is deleted is missing, what is inserted is spurious.
With G(i, j) the distance of the first i events a of one train and the first j events b of the other,

    G(i, j) = min(G(i-1, j) + 1, G(i, j-1) + 1, G(i-1, j-1) + q |a_i - b_j|).

Where no event of either train falls into a window the two sides are independent: trains are cut there.

Reference: Victor, Purpura (1996), Nature and precision of temporal coding in visual cortex, J. Neurophysiol.
    76.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels as objects.

import math
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.bench.engine import EventArrays

_TIME_BITS = 40
_CELLS_MAX = 1 << 24
"""Cells of all tables of a launch, 8 bytes each; a single larger table gets a launch of its own."""


@wp.kernel(enable_backward=False)
def _align(
    # Model:
    window_us: wp.int64,
    cost_per_us: wp.float64,
    # In:
    first: int,
    begin: wp.array2d[wp.int64],
    count: wp.array2d[wp.int64],
    cell: wp.array[wp.int64],
    a_us: wp.array[wp.int64],
    b_us: wp.array[wp.int64],
    # In/out:
    cells: wp.array[wp.float64],
    # Out:
    distance_out: wp.array[wp.float64],
    error_us_out: wp.array[float],
) -> None:
    group = first + wp.tid()
    rows = int(count[0, group])
    columns = int(count[1, group])
    a = int(begin[0, group])
    b = int(begin[1, group])
    base = int(cell[group] - cell[first])
    width = columns + 1
    one = wp.float64(1.0)
    for column in range(width):
        cells[base + column] = wp.float64(column)
    for row in range(1, rows + 1):
        at = base + row * width
        cells[at] = wp.float64(row)
        for column in range(1, width):
            shift_us = wp.abs(a_us[a + row - 1] - b_us[b + column - 1])
            best = wp.min(cells[at + column - width], cells[at + column - 1]) + one
            if shift_us <= window_us:
                best = wp.min(best, cells[at + column - width - 1] + cost_per_us * wp.float64(shift_us))
            cells[at + column] = best
    distance_out[group] = cells[base + rows * width + columns]
    row = rows
    column = columns
    while row > 0 and column > 0:
        at = base + row * width + column
        error_us = b_us[b + column - 1] - a_us[a + row - 1]
        shifted = cells[at - width - 1] + cost_per_us * wp.float64(wp.abs(error_us))
        if wp.abs(error_us) <= window_us and cells[at] == shifted:
            error_us_out[a + row - 1] = float(error_us)
            row -= 1
            column -= 1
        elif cells[at] == cells[at - width] + one:
            row -= 1
        else:
            column -= 1


class Alignment(NamedTuple):
    """The cheapest way from a reference to another stream of events."""

    distance: float
    """Sum of the distances of all trains."""
    error_us: NDArray[np.float32]
    """Delay of each event of the reference in the other stream [us], nan where it is missing."""
    spurious_count: int
    """Events of the other stream that are none of the reference."""

    @property
    def missing_count(self) -> int:
        """Events of the reference that the other stream does not have."""
        return int(np.isnan(self.error_us).sum())


def match(
    reference: EventArrays,
    other: EventArrays,
    *,
    width: int,
    window_us: float,
    shift_cost: float = 1e-6,
    device: str = "cpu",
) -> Alignment:
    """Find the cheapest way to turn a reference into another stream of events.

    The sensor has `width` columns and fewer than 2^22 pixels. Events further apart than the window are not
    the same. A shift by the window costs `shift_cost`: 2 gives the distance of Victor and Purpura, and next
    to nothing as many pairs as possible.
    """
    a, b = _sorted_keys(reference, width), _sorted_keys(other, width)
    begin, count = _groups(a, b, window_us)
    mixed = (count > 0).all(axis=0)
    alone = float(count[:, ~mixed].sum())
    error_us = wp.full(len(a), value=math.nan, dtype=float, device=device)
    begin, count = begin[:, mixed], count[:, mixed]
    sizes = (count + 1).prod(axis=0)
    cell = np.concatenate([[0], np.cumsum(sizes)])
    uploaded: list[Any] = [wp.array(v, dtype=wp.int64, device=device) for v in (begin, count, cell, a, b)]
    distances = wp.zeros(len(sizes), dtype=wp.float64, device=device)
    room = max(min(_CELLS_MAX, int(cell[-1])), int(sizes.max(initial=1)))
    cells = wp.empty(room, dtype=wp.float64, device=device)
    first = 0
    while first < len(sizes):
        last = max(first + 1, int(np.searchsorted(cell, cell[first] + _CELLS_MAX, side="right")) - 1)
        inputs = [int(window_us), shift_cost / window_us, first, *uploaded, cells]
        wp.launch(_align, dim=last - first, inputs=inputs, outputs=[distances, error_us], device=device)
        first = last
    found_us = error_us.numpy()
    return Alignment(
        distance=alone + float(distances.numpy().sum()),
        error_us=found_us,
        spurious_count=len(b) - int((~np.isnan(found_us)).sum()),
    )


def _sorted_keys(events: EventArrays, width: int) -> NDArray[np.int64]:
    """Return a key for each event, sorted: its train, one for each pixel and polarity, and then its time."""
    t, x, y, polarity = (np.asarray(column, dtype=np.int64) for column in events)
    return np.sort((2 * (y * width + x) + polarity) << _TIME_BITS | t)


def _groups(
    a: NDArray[np.int64], b: NDArray[np.int64], window_us: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the beginnings in a and b, and the lengths, of stretches of trains that are independent."""
    both = np.concatenate([a << 1, b << 1 | 1])
    both.sort()
    # Another train is further away than any window.
    starts = np.flatnonzero(np.diff(both >> 1, prepend=-(1 << 62)) > window_us)
    b_count = np.add.reduceat(both & 1, starts) if len(starts) else starts
    count = np.stack([np.diff(np.append(starts, len(both))) - b_count, b_count])
    return np.cumsum(count, axis=1) - count, count
