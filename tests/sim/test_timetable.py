"""What happens in a control period: the boundaries of a run, relative to its begin."""

from __future__ import annotations

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurosim_core.clock import Rate
from neurosim_core.sim.schedule import Schedule, Timetable, boundaries

RATES = [20.0, 30.0, 50.0, 100.0, 200.0, 250.0, 333.0, 400.0, 1000.0]


def timetable(control: float, samplers: list[float], casts: list[float], images: list[dict[str, float]]):
    schedule = Schedule(
        control=Rate(control),
        samplers=tuple(map(Rate, samplers)),
        groups=tuple(map(Rate, casts)),
        instants_per_launch=16,
    )
    clocks = tuple({name: Rate(rate) for name, rate in cameras.items()} for cameras in images)
    return schedule, Timetable(schedule, clocks)


@given(
    control=st.sampled_from(RATES),
    samplers=st.lists(st.sampled_from(RATES), max_size=2),
    casts=st.lists(st.sampled_from(RATES), max_size=2),
)
def test_periods_are_those_of_a_run(control, samplers, casts):
    """Laid end to end the patterns give the boundaries of the schedule, stamp by stamp."""
    schedule, table = timetable(control, samplers, casts, [{} for _ in casts])
    now_ns, seen = 0, []
    for _ in range(12):
        pattern = table.at(now_ns)
        seen += [(now_ns + b.stamp_ns, b.samplers, b.groups) for b in pattern.boundaries]
        for cast in range(len(casts)):
            offsets_ns = pattern.offsets_ns(cast)
            ticks = [stamp for stamp, _, due in seen if cast in due and stamp > now_ns]
            assert [now_ns + offset for offset in offsets_ns[1:]] == ticks
            before = [0, *(s for s, _, due in seen if cast in due and s <= now_ns)]
            assert now_ns + offsets_ns[0] == before[-1]
            assert len(ticks) <= table.instant_count_max()
            assert len(pattern.boundaries) <= table.boundary_count_max()
        now_ns += pattern.duration_ns
    expected = [(b.stamp_ns, b.samplers, b.groups) for b in boundaries(schedule, 0, now_ns)]
    assert seen == expected


@pytest.mark.parametrize(
    ("rates", "common_ns"),
    [
        ((100.0, 200.0, 400.0), 10_000_000),
        ((100.0, 50.0), 20_000_000),
        ((200.0, 500.0), 10_000_000),
        ((30.0, 20.0), 100_000_000),
        ((100.0, 30.0), 100_000_000),
        ((333.0,), 10**9),
        ((29.97,), 10**11),
        ((29.97013, 333.33123, 17.171717, 100.0001), 0),
    ],
)
def test_when_all_clocks_tick_together(rates, common_ns):
    """Each makes a whole number of periods in it, and no shorter whole number of ns will do."""
    _, table = timetable(rates[0], list(rates[1:]), [], [])
    assert table.common_ns == common_ns
    periods = (Fraction(str(rate)) * common_ns / 10**9 for rate in rates)
    assert all(count.denominator == 1 for count in periods)


def test_pictures_are_due_at_the_end():
    _, table = timetable(100.0, [], [400.0], [{"rgb": 50.0, "depth": 100.0}])
    assert table.first().pictures == (("rgb", "depth"),)
    assert table.at(0).pictures == (("depth",),)
    assert table.at(10_000_000).pictures == (("rgb", "depth"),)
    assert table.at(10_000_000).offsets_ns(0) == (0, 2_500_000, 5_000_000, 7_500_000, 10_000_000)
    assert table.at(20_000_000) == table.at(0)
    assert table.instant_count_max() == 4
