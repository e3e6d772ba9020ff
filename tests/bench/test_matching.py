"""Matching of events, against brute force."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim_core.bench.engine import EventArrays
from neurosim_core.bench.matching import match

TRAINS = st.lists(st.integers(0, 60), max_size=5).map(sorted)
WINDOW_US = 20


def events(times):
    one = np.ones(len(times), dtype=np.int64)
    return EventArrays(t=np.array(times, dtype=np.int64), x=0 * one, y=0 * one, polarity=one)


def pairings(a, b):
    """Yield every pairing of two trains that keeps the order, as pairs of times."""
    for count in range(min(len(a), len(b)) + 1):
        for chosen in itertools.product(itertools.combinations(a, count), itertools.combinations(b, count)):
            yield list(zip(*chosen, strict=True))


@settings(max_examples=60)
@given(TRAINS, TRAINS)
def test_against_all_pairings(a, b):
    costs, counts = [], []
    for pairs in pairings(a, b):
        shifts = [abs(s - t) for s, t in pairs]
        costs.append(len(a) + len(b) - 2 * len(pairs) + 2.0 / WINDOW_US * sum(shifts))
        counts.append(len(pairs) if all(shift <= WINDOW_US for shift in shifts) else 0)
    aligned = match(events(a), events(b), width=1, window_us=WINDOW_US, shift_cost=2.0)
    assert aligned.distance == pytest.approx(min(costs), abs=1e-9)
    matched = match(events(a), events(b), width=1, window_us=WINDOW_US)
    assert len(a) - matched.missing_count == len(b) - matched.spurious_count == max(counts)


def test_trains_are_pixels_and_polarities():
    """What is at another pixel or of another polarity is no partner; shifts are of the right event."""
    a = EventArrays(*map(np.array, ([100, 100, 200], [0, 1, 0], [0, 0, 1], [1, 1, 0])))
    b = EventArrays(*map(np.array, ([130, 100, 200], [0, 1, 0], [0, 0, 1], [1, 0, 0])))
    for shift_cost in (1e-6, 2.0):
        found = match(a, b, width=2, window_us=1000, shift_cost=shift_cost)
        assert (found.missing_count, found.spurious_count) == (1, 1)
        assert sorted(found.error_us[~np.isnan(found.error_us)]) == [0.0, 30.0]


@pytest.mark.parametrize(("a", "b"), [([], [5]), ([5], []), ([], [])])
def test_nothing_on_either_side(a, b):
    found = match(events(a), events(b), width=1, window_us=10)
    assert (found.missing_count, found.spurious_count, found.distance) == (len(a), len(b), len(a) + len(b))
