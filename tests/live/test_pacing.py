"""Pacing by a clock that only moves when somebody sleeps or works: every deadline is known exactly."""

from __future__ import annotations

import threading
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurosim_core.live.pacing import Pacer, Timings

MS = 1_000_000
START_NS = 123_456_789_012_345


class FakeClock:
    """A clock of whole nanoseconds, whose sleeps take `overshoot_ns` too long."""

    def __init__(self, overshoot_ns: int = 0) -> None:
        self.now_ns = START_NS
        self.overshoot_ns = overshoot_ns
        self.sleeps_ns: list[int] = []

    def clock_ns(self) -> int:
        return self.now_ns

    def sleep(self, duration_s: float) -> None:
        assert duration_s > 0.0
        self.sleeps_ns.append(round(duration_s * 1e9))
        self.now_ns += self.sleeps_ns[-1] + self.overshoot_ns


def make_pacer(clock: FakeClock, factor: float) -> Pacer:
    return Pacer(factor, clock_ns=clock.clock_ns, sleep=clock.sleep)


@pytest.mark.parametrize(
    ("factor", "numerator", "denominator"), [(1.0, 1, 1), (0.5, 1, 2), (0.3, 3, 10), (7.0, 7, 1)]
)
def test_a_million_deadlines_at_333_hz_do_not_drift(factor, numerator, denominator):
    """Step k is due at floor(stamp / factor) after the start, though every sleep takes 60 us too long."""
    clock = FakeClock(overshoot_ns=60_000)
    pacer = make_pacer(clock, factor)
    step_count = 1_000_000 if factor == 1.0 else 10_000
    for step in range(1, step_count + 1):
        stamp_ns = step * 1_000_000_000 // 333
        assert pacer.wait_until(stamp_ns) == 60_000
        assert clock.now_ns == START_NS + stamp_ns * denominator // numerator + 60_000


@given(
    factor=st.sampled_from([0.001, 0.5, 1.0, 3.0, 1000.0]),
    work_ns=st.lists(st.integers(0, 30 * MS), min_size=1, max_size=40),
    overshoot_ns=st.integers(0, 5 * MS),
)
def test_a_wait_ends_at_the_deadline_or_at_once(factor, work_ns, overshoot_ns):
    """Whatever was late before: a step never begins early, and never waits when it is overdue."""
    clock = FakeClock(overshoot_ns)
    pacer = make_pacer(clock, factor)
    for step, duration_ns in enumerate(work_ns):
        clock.now_ns += duration_ns
        came_ns = clock.now_ns
        due_ns = START_NS + int(Fraction(10 * MS * step) / Fraction(str(factor)))
        late_ns = pacer.wait_until(10 * MS * step)
        assert late_ns == clock.now_ns - due_ns
        assert clock.now_ns == came_ns if came_ns >= due_ns else 0 <= late_ns <= overshoot_ns


def test_a_sleep_that_ends_early_is_slept_again():
    """As that of an event that is set may, or one that a signal ends."""
    clock = FakeClock()
    pacer = Pacer(1.0, clock_ns=clock.clock_ns, sleep=lambda duration_s: clock.sleep(duration_s * 0.4 + 1e-9))
    assert pacer.wait_until(10 * MS) == 0
    assert len(clock.sleeps_ns) > 5


def test_deadlines_are_exact_after_thirty_years():
    pacer = make_pacer(FakeClock(), 1.0)
    assert pacer.wall_ns(10**18 + 1) == START_NS + 10**18 + 1


def test_slip_puts_off_what_follows():
    clock = FakeClock()
    pacer = make_pacer(clock, 0.5)
    pacer.wait_until(10 * MS)
    assert clock.now_ns == START_NS + 20 * MS
    clock.now_ns += 50 * MS  # the work of a step that had 20 ms
    assert pacer.lateness_ns(20 * MS) == 30 * MS
    assert pacer.slip(20 * MS) == 30 * MS
    assert pacer.wait_until(20 * MS) == 0
    assert clock.now_ns == START_NS + 70 * MS
    pacer.wait_until(30 * MS)
    assert clock.now_ns == START_NS + 90 * MS
    assert pacer.slip(40 * MS) == 0  # not due before 20 ms from now
    assert pacer.lateness_ns(40 * MS) == -20 * MS
    clock.now_ns += 21 * MS
    assert pacer.slip(40 * MS) == MS


def test_factor_0_never_waits():
    clock = FakeClock()
    pacer = make_pacer(clock, 0.0)
    for step in range(100):
        assert pacer.wait_until(step * 10**9) == 0
        clock.now_ns += 5
        assert (pacer.slip(step * 10**9), pacer.lateness_ns(step)) == (0, 0)
        assert pacer.wall_ns(step) == clock.now_ns
    assert clock.sleeps_ns == []


def test_start_lets_a_stamp_be_now():
    """As after a pause: what has passed by the wall clock meanwhile does not count."""
    clock = FakeClock()
    pacer = make_pacer(clock, 2.0)
    pacer.wait_until(10 * MS)
    clock.now_ns += 10**12
    pacer.start(10 * MS)
    begin_ns = clock.now_ns
    assert pacer.wait_until(30 * MS) == 0
    assert clock.now_ns == begin_ns + 10 * MS


@pytest.mark.parametrize(
    ("before", "after", "wanted_ms"),
    # 20 ms of simulated time are over by 40 ms of work at 0.5, 20 ms at 1; 40 ms more of it remain.
    [(0.5, 1.0, 80), (0.5, 4.0, 50), (1.0, 0.5, 100), (1.0, 1000.0, 20.04), (0.5, 0.25, 200)],
)
def test_the_pace_changes_without_a_jump_of_time(before, after, wanted_ms):
    clock = FakeClock()
    pacer = make_pacer(clock, before)
    clock.now_ns += round(20 * MS / before)
    pacer.set_factor(after)
    assert pacer.factor == after
    assert pacer.wall_ns(20 * MS) == clock.now_ns
    pacer.wait_until(60 * MS)
    assert clock.now_ns == START_NS + round(wanted_ms * MS)


def test_lateness_is_kept_when_the_pace_changes_not_multiplied():
    """5 ms behind at factor 1 are 5 ms of simulated time, also at factor 1000, where they take 5 us."""
    clock = FakeClock()
    pacer = make_pacer(clock, 1.0)
    clock.now_ns += 25 * MS
    pacer.set_factor(1000.0)
    assert pacer.lateness_ns(20 * MS) == 5_000


def test_the_pace_changes_from_and_to_as_fast_as_it_can():
    clock = FakeClock()
    pacer = make_pacer(clock, 0.0)
    pacer.wait_until(10**15)
    clock.now_ns += 17
    pacer.set_factor(0.5)
    begin_ns = clock.now_ns
    assert pacer.wait_until(10**15 + MS) == 0
    assert clock.now_ns == begin_ns + 2 * MS
    pacer.set_factor(0.0)
    assert pacer.wait_until(10**18) == 0
    assert clock.now_ns == begin_ns + 2 * MS


def test_many_changes_of_pace_lose_less_than_a_nanosecond_each():
    clock = FakeClock()
    pacer = make_pacer(clock, 1.0)
    stamp_ns = Fraction(0)
    for change in range(1000):
        factor = (1.0, 0.3, 7.0)[change % 3]
        pacer.set_factor(factor)
        clock.now_ns += 1_234_567
        stamp_ns += 1_234_567 * Fraction(str(factor))
    pacer.set_factor(1.0)
    lateness_ns = pacer.lateness_ns(int(stamp_ns))
    assert -1000 <= lateness_ns <= 0


def test_stop_ends_a_wait_within_20_ms():
    """The clock of the test counts: no wait is asleep for longer, and none begins that is to stop."""
    clock = FakeClock()
    pacer = make_pacer(clock, 0.001)
    stop_ns = START_NS + 3_333 * MS
    late_ns = pacer.wait_until(10 * MS, lambda: clock.now_ns >= stop_ns)  # due in 10 s
    assert stop_ns <= clock.now_ns <= stop_ns + 20 * MS
    assert late_ns == clock.now_ns - (START_NS + 10_000 * MS)
    assert max(clock.sleeps_ns) <= 20 * MS
    asleep = len(clock.sleeps_ns)
    assert pacer.wait_until(10 * MS, lambda: True) == late_ns
    assert len(clock.sleeps_ns) == asleep


def test_an_event_ends_a_wait_by_the_real_clock():
    """`Event.wait` ends at once, on a machine that is not busy; 100 s would be left to wait."""
    stop = threading.Event()
    pacer = Pacer(1.0, sleep=stop.wait)
    timer = threading.Timer(0.03, stop.set)
    timer.start()
    late_ns = pacer.wait_until(100 * 10**9, stop.is_set)
    timer.join()
    assert late_ns < -40 * 10**9


@pytest.mark.parametrize("factor", [-1.0, float("nan"), float("inf")])
def test_impossible_paces_are_refused(factor):
    with pytest.raises(ValueError, match=f"must be >= 0 and finite, got {factor}"):
        Pacer(factor)
    pacer = Pacer(1.0)
    with pytest.raises(ValueError, match=f"got {factor}"):
        pacer.set_factor(factor)
    assert pacer.factor == 1.0


def test_timings_are_those_since_the_last_look():
    timings = Timings()
    assert timings.take() == (0, 0)
    for duration_ns in np.random.default_rng(0).permutation(1001):
        timings.add(int(duration_ns))
    assert timings.take() == (500, 990)
    assert timings.take() == (0, 0)
    timings.add(-3)  # a clock that is early
    assert timings.take() == (-3, -3)


def test_timings_keep_the_newest():
    timings = Timings(capacity=4)
    for duration_ns in (10**12, 7, 1, 2, 3, 4):
        timings.add(duration_ns)
    assert timings.take() == (2, 4)  # of 1, 2, 3, 4: 2.5, to the even number
    for duration_ns in (5, 6):
        timings.add(duration_ns)
    assert timings.take() == (6, 6)  # what was there before the last look does not count
