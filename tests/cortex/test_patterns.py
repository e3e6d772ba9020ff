"""Subscribers of several topics, callbacks for publishers that come and go, and types that have grown."""

from __future__ import annotations

import time
from enum import Enum

import numpy as np
import pytest
from peer import Number, OtherNumber
from processes import SOON_S, wait_for

from cortex import Array, TypeMismatch, reliable
from cortex.evolution import differences, is_evolved
from cortex.message_types import message
from cortex.schema import schema_of
from cortex.topic import check_pattern, matches


@pytest.mark.parametrize(
    ("pattern", "fitting", "others"),
    [
        ("/*/imu", ["/a/imu", "/b_2/imu"], ["/imu", "/a/b/imu", "/a/imu2"]),
        ("/drone/**", ["/drone", "/drone/a", "/drone/a/b"], ["/drones/a", "/other"]),
        ("/**/imu", ["/imu", "/a/imu", "/a/b/imu"], ["/a/imu/raw"]),
        ("/**", ["/a", "/a/b"], []),
        ("/a/imu", ["/a/imu"], ["/a/imu/x"]),
    ],
)
def test_what_fits_a_pattern(pattern, fitting, others):
    assert check_pattern(pattern) == pattern
    assert [topic for topic in fitting + others if matches(pattern, topic)] == fitting


@pytest.mark.parametrize("pattern", ["*", "/a*", "/***", "/a/*/", "", "/a.b/*", "/*" * 101])
def test_what_is_no_pattern(pattern):
    with pytest.raises(ValueError, match="named like"):
        check_pattern(pattern)


def test_a_pattern_hears_all_topics_of_its_type(make_node, start_child):
    """Those that are there, those that come later, those of other processes; it passes over other types."""
    node = make_node()
    first = node.publisher("/a/number", Number)
    other = node.publisher("/b/number", OtherNumber)
    subscriber = make_node("reader").subscriber("/*/number", Number, policy=reliable())
    child = start_child("peer")
    child.ask(do="publisher", topic="/c/number", type="Number")
    last = node.publisher("/d/number", Number)
    for publisher in (first, last):
        assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    assert child.ask(do="await_subscribers", topic="/c/number")["ok"]
    other.publish(OtherNumber(9, 9.0))
    first.publish(Number(1, 1))
    last.publish(Number(2, 2))
    child.ask(do="publish", topic="/c/number", count=1, start=3)
    heard = [subscriber.recv_with_info(SOON_S) for _ in range(3)]
    topics = {info.topic: received.value for received, info in heard}
    assert topics == {"/a/number": 1, "/d/number": 2, "/c/number": 3}
    with pytest.raises(TimeoutError):
        subscriber.recv(0.05)
    told = {info.topic: info.subscribers for info in node.topics() if info.publishers}
    assert told == {
        "/a/number": ("reader",),
        "/b/number": (),
        "/c/number": ("reader",),
        "/d/number": ("reader",),
    }


def test_a_callback_for_publishers_that_come_and_die(make_node, start_child):
    """Of this node, and of a process that is killed: that is known long before its lease has run out."""
    node = make_node("here")
    seen: list[tuple] = []
    own = node.publisher("/a/number", Number)
    stop = node.watch("/*/number", lambda change: seen.append((change.topic, change.node_name, change.alive)))
    wait_for(lambda: seen == [("/a/number", "here", True)])

    def took_s() -> float:
        child = start_child("peer", name="there")
        seen.clear()
        child.ask(do="publisher", topic="/b/number", type="Number")
        child.ask(do="publisher", topic="/other", type="Number")
        wait_for(lambda: seen == [("/b/number", "there", True)])
        child.kill()
        begin_s = time.monotonic()
        wait_for(lambda: len(seen) == 2)
        assert seen[1] == ("/b/number", "there", False)
        return time.monotonic() - begin_s

    wait_for(lambda: took_s() < 0.5)  # a busy machine makes some of them late, but not each
    own.close()
    wait_for(lambda: seen[-1] == ("/a/number", "here", False))
    stop()
    node.publisher("/c/number", Number)
    again: list[object] = []
    node.watch("/c/number", again.append)
    wait_for(lambda: again)  # the callback thread has run what came before
    assert seen[-1] == ("/a/number", "here", False)


class Gear(Enum):
    PARKED = 0
    FAST = 1


@message
class Wheel:
    speed: float


@message(name="Car")
class Car:
    stamp_ns: int
    gear: Gear
    wheels: list[Wheel]
    ranges: Array["float32", "n"]


@message(name="Car")
class NewCar:
    stamp_ns: int
    gear: Gear
    wheels: list[Wheel]
    ranges: Array["float32", "n"]
    spare: Wheel | None
    label: str | None


def test_a_subscriber_takes_types_that_grew_and_types_that_have_not(make_node):
    node = make_node()
    old = node.publisher("/old", Car)
    new = node.publisher("/new", NewCar)
    of_old = node.subscriber("/old", NewCar, policy=reliable())
    of_new = node.subscriber("/new", Car, policy=reliable())
    for publisher in (old, new):
        assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    wheels, ranges = [Wheel(1.0), Wheel(2.0)], np.arange(40_000, dtype=np.float32)
    for size in (3, 40_000):  # in the frame, and in shared memory
        old.publish(Car(5, Gear.FAST, wheels, ranges[:size]))
        new.publish(NewCar(6, Gear.PARKED, wheels, ranges[:size], Wheel(3.0), "x"))
        grown, info = of_old.recv_with_info(SOON_S)
        shrunk = of_new.recv(SOON_S)
        assert type(grown) is NewCar
        assert (grown.gear, grown.wheels, grown.spare, grown.label) == (Gear.FAST, wheels, None, None)
        assert info.stamp_ns == 5
        assert type(shrunk) is Car
        assert (shrunk.stamp_ns, shrunk.gear) == (6, Gear.PARKED)
        for received in (grown, shrunk):
            np.testing.assert_array_equal(received.ranges, ranges[:size])


def test_other_changes_are_still_refused(make_node):
    """A field of another type is none that may change; the text names it."""
    node = make_node()
    node.publisher("/numbers", Number)
    with pytest.raises(TypeMismatch, match="float64"):
        node.subscriber("/numbers", OtherNumber).recv(SOON_S)
    assert not is_evolved(schema_of(Number), schema_of(OtherNumber))
    assert not is_evolved(schema_of(Number), schema_of(Number))
    assert list(differences(schema_of(Number), schema_of(OtherNumber))) == [
        "field 1: value int64 -> value float64"
    ]
    assert list(differences(schema_of(Car), schema_of(NewCar))) == [
        "field 4: + spare optional message Wheel",
        "field 5: + label optional str",
    ]
