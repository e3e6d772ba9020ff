"""The distance of Victor and Purpura against its definition, by trying all ways on small trains."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim_core.bench.spike_distance import Trains, align, make_trains

times = st.lists(st.integers(min_value=0, max_value=60_000), max_size=5).map(sorted)


def train(t_us) -> Trains:
    return Trains(train=np.zeros(len(t_us), np.int64), t_us=np.array(t_us, dtype=np.int64))


def cheapest(a, b, cost_per_us: float) -> float:
    """Return the distance by trying every way to shift some events of one train onto some of the other."""
    best = float(len(a) + len(b))
    for count in range(1, min(len(a), len(b)) + 1):
        for chosen in itertools.combinations(a, count):
            for onto in itertools.permutations(b, count):
                shifts = sum(abs(s - t) for s, t in zip(chosen, onto, strict=True))
                best = min(best, len(a) + len(b) - 2 * count + cost_per_us * shifts)
    return best


@given(times, times, st.sampled_from([50.0, 200.0, 1000.0]))
@settings(max_examples=60, deadline=None)
def test_the_distance_is_the_least_cost_of_all_ways(a, b, cost_per_s):
    found = align(train(a), train(b), cost_per_s=cost_per_s)
    assert found.distance == pytest.approx(cheapest(a, b, cost_per_s * 1e-6), abs=1e-9)


@given(times, times)
@settings(max_examples=60, deadline=None)
def test_what_is_matched_missing_and_spurious_makes_up_the_distance(a, b):
    found = align(train(a), train(b), cost_per_s=200.0)
    assert found.missing_count + len(found.shifts_us) == len(a)
    assert found.spurious_count + len(found.shifts_us) == len(b)
    cost = found.missing_count + found.spurious_count + 200e-6 * found.shifts_us.sum()
    assert found.distance == pytest.approx(cost, abs=1e-4)  # errors are float32
    assert (found.shifts_us <= 10_000).all()
    assert align(train(b), train(a), cost_per_s=200.0).distance == pytest.approx(found.distance, abs=1e-9)


def test_pixels_and_polarities_are_trains_of_their_own(device):
    rng = np.random.default_rng(0)
    count = 20_000
    t, x, y = rng.integers(0, 1_000_000, count), rng.integers(0, 9, count), rng.integers(0, 7, count)
    polarity = rng.integers(0, 2, count)
    late = t + 30
    all_at_once = align(
        make_trains(t, x, y, polarity, width=9),
        make_trains(late, x, y, polarity, width=9),
        cost_per_s=200.0,
        device=device,
    )
    assert all_at_once.missing_count == all_at_once.spurious_count == 0
    assert all_at_once.error_us.tolist() == [30.0] * count
    assert all_at_once.distance == pytest.approx(count * 30 * 200e-6)
    other = make_trains(late, x, y, 1 - polarity, width=9)
    reference = make_trains(t, x, y, polarity, width=9)
    parts = 0.0
    for number in range(2 * 9 * 7):
        a, b = (s.t_us[s.train == number] for s in (reference, other))
        parts += align(train(a), train(b), cost_per_s=200.0).distance
    whole = align(reference, other, cost_per_s=200.0, device=device)
    assert whole.distance == pytest.approx(parts)
    assert whole.distance > 1000.0


def test_events_of_nothing():
    nothing = train([])
    assert align(nothing, nothing, cost_per_s=200.0).distance == 0.0
    assert align(nothing, train([5, 9]), cost_per_s=200.0).spurious_count == 2
    assert align(train([5, 9]), nothing, cost_per_s=200.0).missing_count == 2
