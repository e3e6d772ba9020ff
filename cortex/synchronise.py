"""Messages of several topics by their stamps: what belongs together comes together, whoever was faster."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from fractions import Fraction
from typing import TYPE_CHECKING, Any, TypeVar

from cortex.policy import reliable

if TYPE_CHECKING:
    from cortex.node import Node

T = TypeVar("T")

NS_PER_S = 1_000_000_000
SETTLE_S = 0.05
"""Wait after the last topic has a publisher: a simulator computes a sensor 20 ms after one asks."""
_DEPTH = 256


class _Follower:
    """A topic whose messages are collected for the stamps of another."""

    def __init__(self, node: Node, topic: str, type_: type[Any], rate_hz: float) -> None:
        if not rate_hz > 0.0:
            raise ValueError(f"{topic}: its rate must be above 0 Hz, got {rate_hz}")
        self.topic = topic
        self.rate_hz = rate_hz
        self.subscriber = node.subscriber(topic, type_, policy=reliable(_DEPTH))
        self._period_ns = NS_PER_S / Fraction(str(rate_hz))
        self._waiting: deque[Any] = deque()
        self._begin_ns = self._newest_ns = 0

    def begin(self, stamp_ns: int) -> None:
        """Neither wait for messages up to a stamp nor return them: they may have come before this reader."""
        self._begin_ns = self._newest_ns = stamp_ns

    def forget(self) -> None:
        """Drop what has come: time has begun again."""
        self._waiting.clear()
        self.begin(0)
        try:
            while True:
                self.subscriber.recv(0.0)
        except TimeoutError:
            pass

    def up_to(self, stamp_ns: int, deadline_s: float) -> list[Any]:
        """Return the messages that were not returned before, up to a stamp; wait for those that are due."""
        due_ns = self._stamp_ns(self._tick(stamp_ns))
        while self._newest_ns < due_ns:
            self._take(stamp_ns, due_ns, max(0.0, deadline_s - time.monotonic()))
        found = []
        while self._waiting and self._waiting[0].stamp_ns <= stamp_ns:
            found.append(self._waiting.popleft())
        return [message for message in found if message.stamp_ns > self._begin_ns]

    def _take(self, stamp_ns: int, due_ns: int, timeout_s: float) -> None:
        try:
            message = self.subscriber.recv(timeout_s)
        except TimeoutError:
            raise TimeoutError(
                f"{self.topic}: the message of {due_ns} ns has not come, which belongs to {stamp_ns} ns; "
                f"is its rate {self.rate_hz:g} Hz, and does it run?"
            ) from None
        if message.stamp_ns != self._stamp_ns(self._tick(message.stamp_ns)):
            raise ValueError(
                f"{self.topic}: its rate is not {self.rate_hz:g} Hz, as a message has the stamp "
                f"{message.stamp_ns} ns"
            )
        self._newest_ns = message.stamp_ns
        self._waiting.append(message)

    def _tick(self, stamp_ns: int) -> int:
        """Return the last tick at or before a stamp; stamps are whole nanoseconds, rounded down."""
        return -(-(stamp_ns + 1) // self._period_ns) - 1

    def _stamp_ns(self, tick: int) -> int:
        return int(tick * self._period_ns // 1)


def synchronised(
    node: Node,
    leader: tuple[str, type[T]],
    *,
    timeout_s: float = 30.0,
    **followers: tuple[str, type[Any], float],
) -> Iterator[tuple[T, dict[str, list[Any]]]]:
    """Yield every message of a topic with the messages of other topics that belong to its stamp.

    These are all messages after the stamp before and up to this one. One that is due by then and has not come
    is waited for, so the result does not depend on who was faster: a controller in lockstep that acts on what
    it is given here flies the same flight to the last bit. The first leader comes
    with nothing: what belongs to it may have been sent before this node came, and some sensors have no
    message of stamp 0. A leader that is sent again, as to a controller that has just come, is yielded again
    with nothing new. Where time begins again, so do all topics.

    Args:
        node: Subscribes to all topics, and holds up their publishers rather than lose messages.
        leader: Topic and type whose messages set the pace; the type has `stamp_ns`.
        timeout_s: Longest wait for a message that is due [s].
        **followers: By the name under which messages are yielded: topic, type with `stamp_ns`, and rate [Hz].

    Yields:
        The leader's message, and for each follower a list of its messages in the order of their stamps.

    Raises:
        ValueError: A rate is not above 0, or a follower's messages come at another.
        TimeoutError: A message that is due has not come in time, or a follower has no publisher.
        TypeMismatch: A topic has messages of another type.
        Closed: The node was closed.
    """
    subscriber = node.subscriber(leader[0], leader[1], policy=reliable(_DEPTH))
    others = {name: _Follower(node, *follower) for name, follower in followers.items()}
    first = subscriber.recv()
    deadline_s = time.monotonic() + timeout_s
    for other in others.values():
        if not other.subscriber.wait_for_publisher(max(0.0, deadline_s - time.monotonic())):
            raise TimeoutError(f"{other.topic} has no publisher")
    time.sleep(SETTLE_S if others else 0.0)
    return _messages(subscriber, first, others, timeout_s)


def _messages(
    subscriber: Any, message: Any, others: dict[str, _Follower], timeout_s: float
) -> Iterator[tuple[Any, dict[str, list[Any]]]]:
    last_ns = -1
    for other in others.values():
        other.begin(message.stamp_ns)
    while True:
        if message.stamp_ns < last_ns:
            for other in others.values():
                other.forget()
        last_ns = message.stamp_ns
        deadline_s = time.monotonic() + timeout_s
        yield message, {name: other.up_to(last_ns, deadline_s) for name, other in others.items()}
        message = subscriber.recv()
