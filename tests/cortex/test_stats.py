"""The latency histogram and its quantiles."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cortex.stats import BUCKETS, SubscriberCounters, quantile_ns


def histogram(latencies_ns):
    counts = [0] * BUCKETS
    for latency in latencies_ns:
        counts[min(max(int(latency), 0).bit_length(), BUCKETS - 1)] += 1
    return counts


@given(st.lists(st.integers(0, 2**39 - 1), min_size=1, max_size=200), st.floats(0.0, 1.0))
def test_a_quantile_is_right_to_a_factor_of_two(latencies, fraction):
    """It lies in the bucket of the sample with that rank; a bucket spans a factor of two."""
    rank = max(math.ceil(fraction * len(latencies)), 1)
    exact = sorted(latencies)[rank - 1]
    low = 0.0 if exact < 1 else 2.0 ** (int(exact).bit_length() - 1)
    found = quantile_ns(histogram(latencies), fraction)
    assert low <= found <= max(2.0 * low, 1.0)


def test_the_extremes():
    assert math.isnan(quantile_ns(SubscriberCounters().latency, 0.5))
    assert quantile_ns(histogram([0]), 0.5) <= 1.0
    assert quantile_ns(histogram([2**60]), 0.5) >= 2.0 ** (BUCKETS - 2)
    assert quantile_ns([0, 0, 0, 4] + [0] * 36, 0.5) == pytest.approx(6.0)  # the middle of [4, 8)
