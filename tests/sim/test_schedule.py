"""The schedule of a run against a brute-force list of ticks."""

from __future__ import annotations

import itertools
from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from neurosim_core.clock import Rate
from neurosim_core.sim.schedule import (
    TICKS_PER_INSTANT,
    Schedule,
    batch_end_ns,
    boundaries,
    boundary_count_max,
)

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
        cuts.append(batch_end_ns(schedule, cuts[-1], duration_ns))
    return list(itertools.pairwise(cuts))


@given(schedules)
def test_batches_meet_every_tick_once(schedule):
    duration_ns = 200_000_000
    seen = [b for start, end in batches(schedule, duration_ns) for b in boundaries(schedule, start, end)]
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


@given(schedules)
def test_no_batch_exceeds_its_buffers(schedule):
    for start, end in batches(schedule, 200_000_000):
        batch = boundaries(schedule, start, end)
        assert len(batch) <= boundary_count_max(schedule)
        for index in range(len(schedule.groups)):
            assert sum(index in b.groups for b in batch) <= schedule.ticks_per_batch(index)


def test_a_batch_ends_with_the_last_instant_of_a_launch():
    schedule = Schedule(
        control=Rate(200.0), samplers=(), groups=(Rate(500.0), Rate(30.0)), instants_per_launch=16
    )
    assert batch_end_ns(schedule, 0, 10**9) == 32_000_000
    assert batch_end_ns(schedule, 4_000_000, 10**9) == 36_000_000
    assert batch_end_ns(schedule, 0, 15_000_000) == 15_000_000
    assert batch_end_ns(replace(schedule, groups=()), 0, 10**9) == 80_000_000


def test_a_batch_takes_more_ticks_of_a_cast_that_renders_only_some():
    schedule = Schedule(
        control=Rate(200.0),
        samplers=(),
        groups=(Rate(10_000.0), Rate(30.0)),
        instants_per_launch=16,
        sparse=frozenset({0}),
    )
    assert schedule.ticks_per_batch(0) == 16 * TICKS_PER_INSTANT
    assert schedule.ticks_per_batch(1) == 16
    assert batch_end_ns(schedule, 0, 10**9) == 1_600_000 * TICKS_PER_INSTANT
