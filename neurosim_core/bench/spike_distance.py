# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,no-untyped-call,call-overload"
# mypy: disable-error-code="untyped-decorator,assignment"
"""How much two streams of events differ: the distance of Victor and Purpura, and the alignment behind it.

The events of one pixel and polarity are a spike train. The distance of two trains is the least cost of
turning one into the other by steps of three kinds: to delete an event costs 1, to insert one costs 1, to
shift one by dt costs q |dt|. An event is shifted rather than deleted and inserted again if that is cheaper,
so 2 / q is the window within which events of two trains can be the same event. The cheapest way is an optimal
matching that keeps the order of events: what is shifted is matched, what is deleted is missing, what is
inserted is spurious.

It is found by dynamic programming. With G(i, j) the distance of the first i events a of one train and the
first j events b of the other,

    G(i, j) = min(G(i-1, j) + 1, G(i, j-1) + 1, G(i-1, j-1) + q |a_i - b_j|).

Where no event of either train falls into a window of 2 / q the two sides are independent, so that trains are
cut there; then the tables are small.

Reference: Victor, Purpura (1996), Nature and precision of temporal coding in visual cortex: a metric-space
analysis, J. Neurophysiol. 76, D^spike[q]; Sellers (1974) for the algorithm.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels as objects.

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.render.launch import launch_split

_TIME_BITS = 40
"""Bits of the time in a key that sorts events [us]: 12 days."""
_TABLE_CELLS_MAX = 1 << 24
"""Cells of all tables of a launch, 8 bytes each; a single larger table gets a launch of its own."""


@wp.kernel(enable_backward=False)
def _align(
    first: int,
    # Model:
    cost_per_us: wp.float64,
    # In:
    group_first: int,
    group_cell: wp.array[wp.int64],
    a_begin: wp.array[wp.int32],
    b_begin: wp.array[wp.int32],
    a_count: wp.array[wp.int32],
    b_count: wp.array[wp.int32],
    a_us: wp.array[wp.int64],
    b_us: wp.array[wp.int64],
    # In/out:
    cells: wp.array[wp.float64],
    # Out:
    distance_out: wp.array[wp.float64],
    error_us_out: wp.array[float],
) -> None:
    group = group_first + first + wp.tid()
    rows = a_count[group]
    columns = b_count[group]
    a = a_begin[group]
    b = b_begin[group]
    base = wp.int32(group_cell[group] - group_cell[group_first])
    width = columns + 1
    one = wp.float64(1.0)
    for column in range(width):
        cells[base + column] = wp.float64(column)
    for row in range(1, rows + 1):
        at = base + row * width
        cells[at] = wp.float64(row)
        for column in range(1, width):
            shift = cost_per_us * wp.float64(wp.abs(a_us[a + row - 1] - b_us[b + column - 1]))
            best = wp.min(cells[at + column - width], cells[at + column - 1]) + one
            cells[at + column] = wp.min(best, cells[at + column - width - 1] + shift)
    distance_out[group] = cells[base + rows * width + columns]
    row = rows
    column = columns
    while row > 0 and column > 0:
        at = base + row * width + column
        error_us = b_us[b + column - 1] - a_us[a + row - 1]
        shift = cost_per_us * wp.float64(wp.abs(error_us))
        if cells[at] == cells[at - width - 1] + shift:
            error_us_out[a + row - 1] = float(error_us)
            row -= 1
            column -= 1
        elif cells[at] == cells[at - width] + one:
            row -= 1
        else:
            column -= 1


@dataclass(frozen=True, kw_only=True, eq=False)
class Trains:
    """Events in the order of trains, and of time within each."""

    train: NDArray[np.int64]
    """Train of each event, shape [N], rising."""
    t_us: NDArray[np.int64]
    """Its time [us], shape [N]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """The cheapest way from a reference to another stream of events."""

    distance: float
    """Sum of the distances of all trains."""
    error_us: NDArray[np.float32]
    """How much later each event of the reference is in the other stream [us], nan where it is missing; in the
    order of the reference's trains, shape [N]."""
    spurious_count: int
    """Events of the other stream that are none of the reference."""

    @property
    def missing_count(self) -> int:
        """Events of the reference that the other stream does not have."""
        return int(np.isnan(self.error_us).sum())

    @property
    def shifts_us(self) -> NDArray[np.float32]:
        """By how much events that both have differ in time [us], without sign, shape [matched]."""
        return np.abs(self.error_us[~np.isnan(self.error_us)])


def make_trains(t_us: Any, x: Any, y: Any, polarity: Any, *, width: int) -> Trains:
    """Sort events into trains, one for each pixel and polarity.

    Args:
        t_us: Times [us], integers, shape [N].
        x: Columns, shape [N].
        y: Rows, shape [N].
        polarity: 0 or 1, shape [N].
        width: Columns of the sensor [px].
    """
    train = 2 * (np.asarray(y, dtype=np.int64) * width + np.asarray(x, dtype=np.int64)) + np.asarray(
        polarity, dtype=np.int64
    )
    keys = np.sort((train << _TIME_BITS) | np.asarray(t_us, dtype=np.int64))
    return Trains(train=keys >> _TIME_BITS, t_us=keys & ((1 << _TIME_BITS) - 1))


def align(reference: Trains, other: Trains, *, cost_per_s: float, device: str = "cpu") -> Alignment:
    """Find the cheapest way to turn a reference into another stream of events.

    Args:
        reference: What is right.
        other: What is compared with it; its trains have the same numbers.
        cost_per_s: q, the cost of shifting an event by a second [1/s]; > 0.
        device: Where to compute.
    """
    groups = _Groups(reference, other, window_us=2e6 / cost_per_s)
    both = (groups.a_count > 0) & (groups.b_count > 0)
    alone = int(groups.a_count[~both].sum() + groups.b_count[~both].sum())
    error_us = np.full(len(reference.t_us), np.nan, dtype=np.float32)
    distance = float(alone)
    if both.any():
        fitted, error_us = _solve(reference, other, groups, both, cost_per_s * 1e-6, device)
        distance += fitted
    matched = int((~np.isnan(error_us)).sum())
    return Alignment(distance=distance, error_us=error_us, spurious_count=len(other.t_us) - matched)


class _Groups:
    """Stretches of trains that are independent of each other: how many events of both are in each."""

    def __init__(self, reference: Trains, other: Trains, *, window_us: float) -> None:
        streams = (reference, other)
        keys = np.concatenate([(s.train << _TIME_BITS | s.t_us) << 1 | k for k, s in enumerate(streams)])
        keys.sort()
        is_other = keys & 1
        begins = np.ones(len(keys), dtype=bool)
        begins[1:] = np.diff(keys >> 1) > window_us  # another train is further away than any window
        starts = np.flatnonzero(begins)
        self.b_count = np.add.reduceat(is_other, starts) if len(starts) else starts
        self.a_count = np.diff(np.append(starts, len(keys))) - self.b_count


def _solve(
    reference: Trains,
    other: Trains,
    groups: _Groups,
    both: NDArray[np.bool_],
    cost_per_us: float,
    device: str,
) -> tuple[float, NDArray[np.float32]]:
    """Return the sum of the distances of the groups with events of both, and the errors of all events."""
    a_begin, b_begin = (np.cumsum(c) - c for c in (groups.a_count, groups.b_count))
    sizes = ((groups.a_count + 1) * (groups.b_count + 1))[both]
    cell = np.concatenate([[0], np.cumsum(sizes)])

    def upload(values: NDArray[Any], dtype: Any) -> Any:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

    parts = [upload(v[both], wp.int32) for v in (a_begin, b_begin, groups.a_count, groups.b_count)]
    times = [upload(stream.t_us, wp.int64) for stream in (reference, other)]
    of_group = upload(cell, wp.int64)
    distance = wp.zeros(len(sizes), dtype=wp.float64, device=device)
    error_us = wp.full(len(reference.t_us), value=float("nan"), dtype=float, device=device)
    cells = wp.empty(max(_TABLE_CELLS_MAX, int(sizes.max())), dtype=wp.float64, device=device)
    begin = 0
    while begin < len(sizes):
        end = max(begin + 1, int(np.searchsorted(cell, cell[begin] + _TABLE_CELLS_MAX, side="right")) - 1)
        launch_split(
            _align,
            dim=end - begin,
            inputs=[cost_per_us, begin, of_group, *parts, *times, cells],
            outputs=[distance, error_us],
            device=device,
        )
        begin = end
    return float(distance.numpy().sum()), error_us.numpy()
