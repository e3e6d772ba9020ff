"""The schedule of a run against a brute-force list of ticks."""

from __future__ import annotations

import itertools
from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from neurosim_core.clock import Rate
from neurosim_core.sim.schedule import TICKS_PER_INSTANT, Boundary, Schedule

hertz = st.sampled_from([20.0, 30.0, 100.0, 200.0, 333.0, 400.0, 500.0])
schedules = st.builds(
    Schedule,
    control=hertz.map(Rate),
    samplers=st.lists(hertz.map(Rate), max_size=2).map(tuple),
    groups=st.lists(hertz.map(Rate), max_size=2).map(tuple),
    instants_per_launch=st.integers(min_value=1, max_value=16),
    sparse=st.sets(st.integers(min_value=0, max_value=1)).map(frozenset),
)


def batches(schedule: Schedule, duration_ns: int) -> list[tuple[int, int]]:
    cuts = [0]
    while cuts[-1] < duration_ns:
        cuts.append(schedule.batch_end_ns(cuts[-1], duration_ns))
    return list(itertools.pairwise(cuts))


def boundaries(schedule: Schedule, start_ns: int, end_ns: int) -> list[Boundary]:
    """Return the boundaries in (start_ns, end_ns] at their stamps."""
    stretch = schedule.stretch(start_ns, end_ns)
    assert stretch.duration_ns == sum(stretch.elapsed_ns) == end_ns - start_ns
    return [b._replace(stamp_ns=start_ns + b.stamp_ns) for b in stretch.boundaries]


@given(schedules)
def test_batches_meet_every_tick_once_and_fit_their_buffers(schedule):
    duration_ns = 200_000_000
    seen: list[Boundary] = []
    for start_ns, end_ns in batches(schedule, duration_ns):
        batch = boundaries(schedule, start_ns, end_ns)
        assert len(batch) <= schedule.boundary_count_max()
        for index in range(len(schedule.groups)):
            assert sum(index in b.groups for b in batch) <= schedule.ticks_per_batch(index)
        seen += batch
    for index, rate in enumerate(schedule.groups):
        expected = list(rate.stamps(1, duration_ns + 1))
        assert [b.stamp_ns for b in seen if index in b.groups] == expected
    for index, rate in enumerate(schedule.samplers):
        expected = list(rate.stamps(1, duration_ns + 1))
        assert [b.stamp_ns for b in seen if index in b.samplers] == expected
    assert [b.stamp_ns for b in seen if b.control] == list(schedule.control.stamps(1, duration_ns + 1))
    stamps = [b.stamp_ns for b in seen]
    assert stamps == sorted(set(stamps))
    assert stamps[-1] == duration_ns


def test_a_batch_ends_with_the_last_instant_of_a_launch():
    schedule = Schedule(
        control=Rate(200.0), samplers=(), groups=(Rate(500.0), Rate(30.0)), instants_per_launch=16
    )
    assert schedule.batch_end_ns(0, 10**9) == 32_000_000
    assert schedule.batch_end_ns(4_000_000, 10**9) == 36_000_000
    assert schedule.batch_end_ns(0, 15_000_000) == 15_000_000
    assert replace(schedule, groups=()).batch_end_ns(0, 10**9) == 80_000_000


def test_a_batch_takes_more_ticks_of_a_group_that_renders_only_some():
    schedule = Schedule(
        control=Rate(200.0),
        samplers=(),
        groups=(Rate(10_000.0), Rate(30.0)),
        instants_per_launch=16,
        sparse=frozenset({0}),
    )
    assert schedule.ticks_per_batch(0) == 16 * TICKS_PER_INSTANT
    assert schedule.ticks_per_batch(1) == 16
    assert schedule.batch_end_ns(0, 10**9) == 1_600_000 * TICKS_PER_INSTANT


@given(schedules)
def test_stretches_come_again_when_all_clocks_tick_together(schedule):
    """Periods laid end to end are the same list of boundaries, and those that are remembered no others."""
    for start_ns, end_ns in itertools.pairwise(schedule.control.stamps(0, 150_000_001)):
        assert schedule.period_end_ns(start_ns) == end_ns
        stretch = schedule.stretch(start_ns, end_ns)
        assert stretch == schedule.stretch(start_ns + schedule.common_ns, end_ns + schedule.common_ns)
        assert stretch == replace(schedule).stretch(start_ns, end_ns)  # which remembers none
        assert len(stretch.boundaries) <= schedule.boundary_count_max(1.0 / schedule.control.rate_hz)
        for index in range(len(schedule.groups)):
            assert sum(index in b.groups for b in stretch.boundaries) <= schedule.instants_per_period()


def test_pictures_are_due_at_the_end():
    schedule = Schedule(
        control=Rate(100.0),
        samplers=(),
        groups=(Rate(400.0),),
        images={"rgb": Rate(50.0), "depth": Rate(100.0)},
        instants_per_launch=16,
    )
    assert schedule.first().pictures == {"rgb", "depth"}
    assert schedule.stretch(0, 10_000_000).pictures == {"depth"}
    assert schedule.stretch(10_000_000, 20_000_000).pictures == {"rgb", "depth"}
    assert schedule.instants_per_period() == 4
