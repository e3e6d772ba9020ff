"""The time of the registry's host, estimated over simulated links; real ones: test_namespaces."""

from __future__ import annotations

import random

import pytest

from cortex.clock import Clock, ClockEstimate

SECOND_NS = 10**9
HOUR_NS = 3600 * SECOND_NS


class Link:
    """Heartbeats four times a second to a registry whose clock is ahead and runs faster."""

    def __init__(self, *, ahead_ns: int, drift_ppm: float, delay_ns: int, jitter_ns: int, seed: int = 1):
        self.ahead_ns, self.drift_ppm = ahead_ns, drift_ppm
        self._delay_ns, self._jitter_ns = delay_ns, jitter_ns
        self._random = random.Random(seed)
        self.now_ns = 5 * HOUR_NS
        self.estimate = ClockEstimate(local=False)

    def truth_ns(self, at_ns: int) -> int:
        return self.ahead_ns + round(self.drift_ppm * 1e-6 * (at_ns - 5 * HOUR_NS))

    def delay_ns(self) -> int:
        return self._delay_ns + round(self._random.expovariate(1.0) * self._jitter_ns)

    def beat(self, seconds: float) -> None:
        for _ in range(round(4 * seconds)):
            asked_ns = self.now_ns
            told_at_ns = asked_ns + self.delay_ns()
            answered_ns = told_at_ns + self.delay_ns()
            self.estimate.add(asked_ns, told_at_ns + self.truth_ns(told_at_ns), answered_ns)
            self.now_ns = asked_ns + SECOND_NS // 4

    @property
    def clock(self) -> Clock | None:
        return self.estimate.clock(self.now_ns)

    @property
    def error_ns(self) -> int:
        return abs(self.estimate.offset_ns() - self.truth_ns(self.now_ns))


def test_the_first_answer_tells_the_offset_to_half_a_round_trip():
    link = Link(ahead_ns=HOUR_NS, drift_ppm=0.0, delay_ns=10**7, jitter_ns=10**6)
    assert link.clock is None
    link.beat(0.25)
    clock = link.clock
    assert link.error_ns <= clock.error_ns < 2 * 10**7


@pytest.mark.parametrize("drift_ppm", [-80.0, 0.0, 40.0])
@pytest.mark.parametrize(
    ("delay_ns", "jitter_ns", "error_ns"), [(20 * 10**6, 5 * 10**6, 2 * 10**6), (10**5, 2 * 10**4, 10**5)]
)
def test_offset_over_a_link_with_jitter(drift_ppm, delay_ns, jitter_ns, error_ns):
    """Exponential jitter each way: 2 ms after a minute by radio, 0.1 ms by cable."""
    link = Link(ahead_ns=-3 * SECOND_NS, drift_ppm=drift_ppm, delay_ns=delay_ns, jitter_ns=jitter_ns)
    link.beat(60.0)
    for _ in range(20):
        link.beat(1.0)
        assert link.error_ns < error_ns
        assert link.error_ns <= link.clock.error_ns < 2 * delay_ns


@pytest.mark.parametrize("step_ns", [-HOUR_NS, 10**8])
def test_a_registry_whose_clock_is_set(step_ns):
    link = Link(ahead_ns=0, drift_ppm=10.0, delay_ns=10**6, jitter_ns=10**5)
    link.beat(20.0)
    link.ahead_ns += step_ns
    link.beat(0.25)
    assert link.error_ns < 2 * 10**6


def test_an_error_that_is_stated_holds_while_clocks_run_apart():
    """One quick answer, then a minute of slow ones: clocks that run apart make the quick one worse."""
    link = Link(ahead_ns=0, drift_ppm=80.0, delay_ns=10**6, jitter_ns=0)
    link.beat(0.25)
    link._jitter_ns = 100 * 10**6
    for _ in range(60):
        link.beat(1.0)
        assert link.error_ns <= link.clock.error_ns


def test_a_slow_answer_moves_nothing():
    link = Link(ahead_ns=0, drift_ppm=0.0, delay_ns=10**6, jitter_ns=0)
    link.beat(20.0)
    before_ns = link.estimate.offset_ns()
    link.estimate.add(
        link.now_ns, link.now_ns + 400 * 10**6, link.now_ns + 401 * 10**6
    )  # one way took 400 ms
    assert abs(link.estimate.offset_ns() - before_ns) < 10**5
