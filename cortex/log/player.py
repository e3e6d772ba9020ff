"""Playing a recording: what was published is published again, at the same pace or another."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Iterable, Mapping

from cortex.codec import RawMessage
from cortex.context import Closing
from cortex.log.format import LogInfo
from cortex.log.reader import Log
from cortex.node import Node
from cortex.publisher import Publisher
from cortex.topic import check_topic

logger = logging.getLogger(__name__)

SUBSCRIBERS_WAIT_S = 2.0
_SPAN_MIN_NS = 1_000_000


class Player(Closing):
    """Publishes the messages of a recording; their `stamp_ns` stay as they were.

    Args:
        node: Where to publish; it stays open.
        log: The recording; it stays open.
        topics: Which; None plays all.
        remap: New names of topics.

    Raises:
        ValueError: A topic is not in the recording, a new name is no topic, or there is nothing to play.
    """

    def __init__(
        self,
        node: Node,
        log: Log,
        *,
        topics: Iterable[str] | None = None,
        remap: Mapping[str, str] | None = None,
    ) -> None:
        present = {entry.topic for entry in log.topics}
        chosen = present if topics is None else set(topics)
        unknown = sorted((chosen | set(remap or ())) - present)
        if unknown or not present:
            raise ValueError(
                f"{log.path} has no topic {', '.join(unknown) or 'at all'}"
                + (f"; it has {', '.join(sorted(present))}" if present else "")
            )
        names = {topic: check_topic((remap or {}).get(topic, topic)) for topic in chosen}
        self._node = node
        self._log = log
        self._topics = sorted(chosen)
        self._publishers: dict[tuple[str, int], Publisher[RawMessage]] = {}
        shared: dict[tuple[str, int], Publisher[RawMessage]] = {}
        latched = {
            (names[e.topic], e.schema.fingerprint) for e in log.topics if e.topic in chosen and e.latch
        }
        for entry in log.topics:
            if entry.topic in chosen:
                key = (names[entry.topic], entry.schema.fingerprint)
                if key not in shared:
                    shared[key] = node.raw_publisher(key[0], entry.schema, latch=key in latched)
                self._publishers[entry.topic, entry.schema.fingerprint] = shared[key]
        self.published = 0
        self.late_ns = 0
        """How late the latest one was, at a finite rate [ns]."""
        self.position_s = 0.0
        """Where in the recording it is [s after the first message]."""
        self._stopped = threading.Event()

    def run(
        self,
        *,
        rate: float = 1.0,
        start_s: float = 0.0,
        duration_s: float | None = None,
        loop: bool = False,
        wait_s: float = SUBSCRIBERS_WAIT_S,
    ) -> int:
        """Play, and return when it is done or `stop` was called.

        Each message is due at an absolute time, so that delays do not add up; one that is late is published
        at once. Reliable subscribers hold up the player if they must.

        Args:
            rate: Factor of speed; `math.inf` publishes without pauses.
            start_s: Where to begin [s after the first message].
            duration_s: How much of the recording to play [s of its time]; None: to the end.
            loop: Begin anew at the end, without pause.
            wait_s: Longest time to wait at the beginning until all known subscribers are connected [s].

        Returns:
            Messages published.

        Raises:
            ValueError: An argument is not what it must be, or no message lies in the range.
        """
        if not rate > 0.0:
            raise ValueError(f"rate must be > 0, got {rate}")
        if not start_s >= 0.0 or (duration_s is not None and not duration_s > 0.0):
            raise ValueError(f"start must be >= 0 and duration > 0, got {start_s} and {duration_s}")
        end_s = None if duration_s is None else start_s + duration_s
        self._await_subscribers(wait_s)
        first_ns = self._log.start_ns + round(start_s * 1e9)
        last_ns = self._log.end_ns if end_s is None else self._log.start_ns + round(end_s * 1e9)
        span_ns = max(min(last_ns, self._log.end_ns) - first_ns, _SPAN_MIN_NS)
        before = self.published
        origin_ns = time.monotonic_ns()
        while not self._stopped.is_set():
            at_start = self.published
            for info, body, schema in self._log.raw(self._topics, start_s=start_s, end_s=end_s):
                # Receive times jitter, publish times do not; but a clock that is ahead must delay nobody.
                from_first_ns = max(0, min(info.publish_ns, info.log_ns) - first_ns)
                if not self._wait_until(origin_ns, 0 if rate == math.inf else round(from_first_ns / rate)):
                    break
                self._publish(info, body, schema.fingerprint)
            if self.published == at_start and not self._stopped.is_set():
                raise ValueError(
                    f"no message from {start_s:g} s to {'the end' if end_s is None else f'{end_s:g} s'}; "
                    f"{self._log.path} is {self._log.duration_s:.3f} s long"
                )
            if not loop:
                break
            origin_ns += 0 if rate == math.inf else round(span_ns / rate)
        return self.published - before

    def _publish(self, info: LogInfo, body: bytes, fingerprint: int) -> None:
        self.position_s = (info.log_ns - self._log.start_ns) * 1e-9
        self._publishers[info.topic, fingerprint].publish(RawMessage(body, info.stamp_ns or 0))
        self.published += 1

    def _wait_until(self, origin_ns: int, after_ns: int) -> bool:
        """Sleep until a time after the origin; False if stopped."""
        while not self._stopped.is_set():
            left_ns = origin_ns + after_ns - time.monotonic_ns()
            if left_ns <= 0:
                if after_ns:
                    self.late_ns = max(self.late_ns, -left_ns)
                return True
            time.sleep(min(left_ns * 1e-9, 0.1))  # an interrupted `wait` could keep the event's lock
        return False

    def stop(self) -> None:
        """Make `run` return; may be called from any thread."""
        self._stopped.set()

    def wait_stopped(self, timeout_s: float) -> bool:
        """Wait until `stop` is called; False if it was not in time."""
        return self._stopped.wait(timeout_s)

    def close(self) -> None:
        """Leave the topics."""
        self.stop()
        for publisher in set(self._publishers.values()):
            publisher.close()

    def _await_subscribers(self, wait_s: float) -> None:
        deadline_s = time.monotonic() + wait_s
        self._node.wait_for_registry(wait_s)
        missing: list[str] = []
        for publisher in set(self._publishers.values()):
            fits = (0, publisher.codec.fingerprint)
            expected = sum(
                subscriber.topic == publisher.topic and subscriber.fingerprint in fits
                for node in self._node.nodes()
                for subscriber in node.subscribers
            )
            left_s = max(0.0, deadline_s - time.monotonic())
            if expected and not publisher.wait_for_subscribers(expected, left_s):
                missing.append(f"{publisher.topic} ({publisher.subscriber_count} of {expected})")
        if missing:
            logger.warning("not all subscribers were connected in time: %s", ", ".join(missing))
