"""Pairing the events of two streams, against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from neurosim_core.bench.event_matching import match_events, take
from neurosim_core.packets import EventArrays


def events(rows):
    t, x, y, polarity = np.array(rows, dtype=np.int64).reshape(-1, 4).T
    return EventArrays(t, x.astype(np.uint16), y.astype(np.uint16), polarity.astype(np.uint8))


def some_events(rng, count):
    t = rng.integers(0, 200, count)
    return events(np.stack([t, *rng.integers(0, 2, (2, count)), rng.integers(0, 2, count)], axis=1))


@pytest.mark.parametrize("seed", range(20))
def test_as_many_pairs_as_an_assignment_finds(seed):
    """The Hungarian method on all pairs that are allowed gives the largest number of pairs."""
    rng = np.random.default_rng(seed)
    first, second = some_events(rng, 40), some_events(rng, 50)
    tolerance_us = int(rng.integers(0, 30))
    found = match_events(first, second, tolerance_us=tolerance_us)
    near = np.abs(first.t[:, None] - second.t[None, :]) <= tolerance_us
    for a, b in zip(first[1:], second[1:], strict=True):
        near &= a[:, None] == b[None, :]
    rows, columns = linear_sum_assignment(near, maximize=True)
    assert len(found.reference) == near[rows, columns].sum()
    assert near[found.reference, found.candidate].all()
    for matched, left, stream in (
        (found.reference, found.missing, first),
        (found.candidate, found.spurious, second),
    ):
        np.testing.assert_array_equal(np.sort(np.concatenate([matched, left])), np.arange(len(stream.t)))
        assert (np.diff(left) > 0).all()


def test_polarity_pixel_and_time_must_fit():
    truth = events([(100, 3, 4, 1)])
    for other, pairs in (
        ((105, 3, 4, 1), 1),
        ((95, 3, 4, 1), 1),
        ((106, 3, 4, 1), 0),
        ((94, 3, 4, 1), 0),
        ((100, 3, 4, 0), 0),
        ((100, 4, 4, 1), 0),
        ((100, 3, 5, 1), 0),
    ):
        assert len(match_events(truth, events([other]), tolerance_us=5).reference) == pairs, other


def test_streams_may_be_empty():
    nothing, one = events([]), events([(1, 2, 3, 1)])
    assert match_events(nothing, nothing, tolerance_us=5).missing.size == 0
    assert match_events(one, nothing, tolerance_us=5).missing.tolist() == [0]
    assert match_events(nothing, one, tolerance_us=5).spurious.tolist() == [0]


def test_take_keeps_columns_together():
    stream = events([(1, 2, 3, 1), (4, 5, 6, 0)])
    assert [column.tolist() for column in take(stream, [1])] == [[4], [5], [6], [0]]
