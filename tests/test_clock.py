"""Integer time: ticks are exact for every rate, against rational arithmetic."""

from __future__ import annotations

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurosim_core.clock import Rate, to_ns

rates = st.one_of(
    st.sampled_from([1.0, 20.0, 29.97, 30.0, 333.0, 400.0, 1000.0, 1009.6, 1e6, 1e9, 0.1]),
    st.decimals(min_value="0.01", max_value="100000", places=3).map(float).filter(lambda f: f > 0),
)


@pytest.mark.parametrize(
    ("rate_hz", "tick", "stamp_ns"),
    [
        (30.0, 1, 33_333_333),
        (30.0, 2, 66_666_666),
        (30.0, 3, 100_000_000),
        (333.0, 333, 10**9),
        (400.0, 1, 2_500_000),
    ],
)
def test_known_ticks(rate_hz, tick, stamp_ns):
    assert Rate(rate_hz).stamp_ns(tick) == stamp_ns


def test_an_hour_at_30_hz_does_not_drift():
    assert Rate(30.0).stamp_ns(30 * 3600) == 3600 * 10**9


@given(rates, st.integers(min_value=0, max_value=10**9))
def test_tick_is_the_floor_of_the_exact_time(rate_hz, tick):
    exact = tick * 10**9 / Fraction(str(rate_hz))
    assert Rate(rate_hz).stamp_ns(tick) <= exact < Rate(rate_hz).stamp_ns(tick) + 1


@given(rates, st.integers(min_value=0, max_value=10**12))
def test_first_tick_is_the_first_at_or_after(rate_hz, stamp_ns):
    rate = Rate(rate_hz)
    tick = rate.first_tick(stamp_ns)
    assert rate.stamp_ns(tick) >= stamp_ns
    assert tick == 0 or rate.stamp_ns(tick - 1) < stamp_ns
    assert rate.has_tick(rate.stamp_ns(tick))
    assert rate.has_tick(stamp_ns) == (rate.stamp_ns(tick) == stamp_ns)


@given(rates, st.lists(st.integers(min_value=0, max_value=10**8), min_size=3, max_size=3))
def test_intervals_can_be_cut_anywhere(rate_hz, cuts):
    rate = Rate(min(rate_hz, 1e5))
    start, middle, end = sorted(cuts)
    end = min(end, start + 10**7)
    middle = min(middle, end)
    parts = [*rate.stamps(start, middle), *rate.stamps(middle, end)]
    assert parts == list(rate.stamps(start, end))


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan"), float("inf"), 2e9])
def test_impossible_rates_are_refused(rate_hz):
    with pytest.raises(ValueError, match="rate_hz must be in"):
        Rate(rate_hz)


def test_seconds_round_to_the_nearest_nanosecond():
    assert to_ns(0.1) == 100_000_000
    assert to_ns(4.0) == 4 * 10**9
    with pytest.raises(ValueError, match="finite"):
        to_ns(float("nan"))


@pytest.mark.parametrize("rate_hz", [20.0, 30.0, 333.0, 500.0, 1000.0])
@pytest.mark.parametrize("other_hz", [30.0, 100.0, 333.0])
def test_ticks_within_a_period_of_another_clock(rate_hz, other_hz):
    """No period has more; the one with most has as many, or one less. Of a multiple all have as many."""
    rate, other = Rate(rate_hz), Rate(other_hz)
    counts = [len(list(rate.stamps(other.stamp_ns(k) + 1, other.stamp_ns(k + 1) + 1))) for k in range(1000)]
    assert rate.ticks_within(other) - 1 <= max(counts) <= rate.ticks_within(other)
    if rate.contains(other):
        assert set(counts) == {rate.ticks_within(other)}
