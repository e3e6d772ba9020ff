"""Messages of several topics by stamp: complete, in order, and the same whoever is faster."""

from __future__ import annotations

import itertools
import random
import threading
import time

import pytest
from processes import SOON_S

from cortex import TypeMismatch, message, synchronised


@message
class Tick:
    stamp_ns: int


@message
class Reading:
    stamp_ns: int
    value: float


MS = 1_000_000
ODD = [tick * 10**9 // 30 for tick in range(20)]  # 30 Hz: stamps are rounded down


def publish(node, plan, *, delays=None):
    """Publish (topic, stamp) pairs from a thread, once both topics have a subscriber."""
    ticks = node.publisher("/ticks", Tick)
    readings = node.publisher("/readings", Reading)

    def run():
        assert ticks.wait_for_subscribers(timeout_s=SOON_S)
        assert readings.wait_for_subscribers(timeout_s=SOON_S)
        for topic, stamp_ns in plan:
            time.sleep(0.0 if delays is None else next(delays))
            if topic == "tick":
                ticks.publish(Tick(stamp_ns=stamp_ns))
            else:
                readings.publish(Reading(stamp_ns=stamp_ns, value=float(stamp_ns)))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


def collect(node, count, rate_hz, **options):
    rows = synchronised(node, ("/ticks", Tick), readings=("/readings", Reading, rate_hz), **options)
    return [(t.stamp_ns, [r.stamp_ns for r in new["readings"]]) for t, new in itertools.islice(rows, count)]


@pytest.mark.parametrize("seed", range(3))
def test_what_belongs_to_a_stamp_comes_with_it(make_node, seed):
    """Whatever order the two topics are published in, each tick gets the readings since the one before."""
    rng = random.Random(seed)
    ticks = [("tick", k * 5 * MS) for k in range(1, 61)]
    readings = [("reading", stamp_ns) for stamp_ns in ODD[:10]]
    plan = sorted(ticks + readings, key=lambda item: item[1] + rng.uniform(-60 * MS, 60 * MS))
    plan = [("tick", 0), *in_order(plan)]
    delays = (rng.choice([0.0, 0.0, 2e-3]) for _ in itertools.count())
    publish(make_node("publisher"), plan, delays=delays)
    rows = collect(make_node("reader"), 61, 30.0, timeout_s=SOON_S)
    assert [stamp_ns for stamp_ns, _ in rows] == [k * 5 * MS for k in range(61)]
    for stamp_ns, new in rows:
        assert new == [s for s in ODD if s > 0 and stamp_ns - 5 * MS < s <= stamp_ns]


def in_order(plan):
    """Each topic in the order of its stamps."""
    queues = {name: iter(sorted(s for n, s in plan if n == name)) for name in ("tick", "reading")}
    return [(name, next(queues[name])) for name, _ in plan]


def test_a_message_that_does_not_come_is_an_error(make_node):
    publish(make_node("publisher"), [("tick", 0), ("tick", 5 * MS), ("tick", 10 * MS)])
    with pytest.raises(
        TimeoutError, match="/readings: the message of 10000000 ns has not come, which belongs"
    ):
        collect(make_node("reader"), 3, 100.0, timeout_s=0.5)


def test_another_rate_is_an_error(make_node):
    publish(make_node("publisher"), [("tick", 0), ("reading", 7 * MS), ("tick", 50 * MS)])
    with pytest.raises(
        ValueError, match="/readings: its rate is not 100 Hz, as a message has the stamp 7000000"
    ):
        collect(make_node("reader"), 2, 100.0, timeout_s=SOON_S)
    with pytest.raises(ValueError, match="/readings: its rate must be above 0 Hz, got 0"):
        collect(make_node("other"), 1, 0.0)


def test_time_that_begins_again_begins_again_for_all(make_node):
    """Readings of before, which nobody waited for, are not taken for those of after."""
    plan = [("tick", 0), ("reading", 10 * MS), ("tick", 10 * MS), ("reading", 20 * MS), ("reading", 30 * MS)]
    again = [("tick", 0), ("tick", 5 * MS), ("reading", 10 * MS), ("tick", 10 * MS)]
    delays = itertools.chain([0.0] * len(plan), [0.3], itertools.repeat(0.1))
    publish(make_node("publisher"), plan + again, delays=delays)
    rows = collect(make_node("reader"), 5, 100.0, timeout_s=SOON_S)
    assert rows == [(0, []), (10 * MS, [10 * MS]), (0, []), (5 * MS, []), (10 * MS, [10 * MS])]


def test_a_reader_that_comes_late_waits_for_nothing_of_before(make_node):
    """As a controller that is started again in lockstep: the reading of its first tick is not sent twice."""
    publish(make_node("publisher"), [("tick", 20 * MS)])
    assert collect(make_node("reader"), 1, 100.0, timeout_s=2.0) == [(20 * MS, [])]


def test_a_leader_of_another_type_is_a_mismatch(make_node):
    publisher = make_node("publisher").publisher("/ticks", Reading, latch=True)
    publisher.publish(Reading(stamp_ns=0, value=0.0))
    with pytest.raises(TypeMismatch):
        synchronised(make_node("reader"), ("/ticks", Tick))
