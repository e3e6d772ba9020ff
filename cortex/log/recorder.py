"""Recording topics into an MCAP file."""

from __future__ import annotations

import atexit
import contextlib
import errno
import json
import logging
import os
import select
import socket
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from cortex.context import Closed
from cortex.link import Info
from cortex.log import format as names
from cortex.log.writer import Sink, add_channel, open_writer
from cortex.node import Node
from cortex.policy import Policy, reliable
from cortex.schema import Schema, TypeMismatch
from cortex.stats import SubscriberCounters
from cortex.subscriber import Subscriber
from cortex.wakeup import Wakeup

logger = logging.getLogger(__name__)

FLUSH_NS = 500_000_000
"""What was received longer ago than this is in the file, even if the process is killed."""
_LOOK_NS = 100_000_000
_DRAIN_NS = 250_000_000
_WAIT_MS = 50.0
_TURN_MESSAGES = 64
"""Messages of one subscriber that are taken at a time, so that a busy topic does not hold up the others."""
_TURN_BYTES = 8 << 20
_CHANNELS_MAX = 65_535
"""MCAP numbers channels with 16 bits."""
_U64_MAX = 2**64 - 1
_COMPRESSIONS = ("none", "lz4", "zstd")


@dataclass(slots=True)
class TopicStats:
    """What was counted on one topic."""

    written: int = 0
    """Messages handed to the file."""
    bytes: int = 0
    lost: int = 0
    """Messages that were published after the recorder had subscribed, and never arrived."""
    overtaken: int = 0
    """Messages that gave way to newer ones; only without `reliable`."""
    rejected: int = 0
    cut_off: int = 0
    """Publishers whose end was not heard: how many of their last messages are missing is not known."""


@dataclass(frozen=True, slots=True)
class RecordStats:
    """What a recorder has done so far."""

    topics: dict[str, TopicStats]
    written: int
    unwritten: int
    """Messages that were received, but lost because the file could not be written."""
    file_bytes: int
    duration_s: float

    @property
    def lost(self) -> int:
        """Messages that were lost or overtaken before they arrived."""
        return sum(topic.lost + topic.overtaken for topic in self.topics.values())


_Taken = tuple[Info, "bytes | np.ndarray", Schema]


class Recorder:
    """Records topics from a thread of its own until it is closed.

    Should the process be killed, at most the last half second is missing and the file can still be read. If
    the disk is full, recording ends, the file holds whole messages up to there, `error` says so, and `close`
    raises it; so it does after any other failure. Memory is bounded: the subscribers' queues, and one chunk
    of 1 MiB or one message.

    Args:
        node: Where to subscribe; it stays open.
        path: The file to make.
        topics: Which; None records all, also those that appear later.
        policy: How to subscribe; None: `reliable(256)`, so that a slow disk holds up publishers before
            messages are lost, for at most 1 s each. `keep_last` never holds up anybody.
        overwrite: Replace a file that exists.
        compression: "none" (fastest), "lz4" or "zstd".

    Raises:
        ImportError: The library `mcap`, or the one for the compression, is missing.
        FileExistsError: The file exists and may not be overwritten.
        OSError: It cannot be written.
        ValueError: A topic's name is none, or the compression is unknown.
    """

    def __init__(
        self,
        node: Node,
        path: str | os.PathLike[str],
        topics: Sequence[str] | None = None,
        *,
        policy: Policy | None = None,
        overwrite: bool = False,
        compression: str = "none",
    ) -> None:
        names.require_mcap()
        if compression not in _COMPRESSIONS:
            raise ValueError(f"compression must be one of {', '.join(_COMPRESSIONS)}, got {compression!r}")
        if topics is not None and not topics:
            raise ValueError("no topics to record; None records all")
        self.path = Path(path)
        self.error: OSError | None = None
        """Why recording ended early, if it did."""
        self._node = node
        self._pid = os.getpid()
        self._policy = reliable(256) if policy is None else policy
        self._all = topics is None
        self._subscribers: dict[str, Subscriber[Any]] = {}
        self._topics: dict[str, TopicStats] = {}
        self._counters: dict[str, SubscriberCounters] = {}
        self._channels: dict[tuple[str, int], int] = {}
        self._schemas: dict[int, int] = {}
        self._busy: set[str] = set()
        self._pending: Counter[tuple[str, int]] = Counter()
        self._received = self._unwritten = 0
        self._log_ns = self._look_ns = self._flush_ns = self._chunk_end = 0
        self._stopping = False
        self._is_whole = True
        """Whether the writer's chunk holds whole messages only."""
        self._wakeup = Wakeup()
        self._start_ns = time.monotonic_ns()
        self._end_ns = 0
        # One offset for the whole recording: a clock that is set meanwhile must not tear it apart.
        self._wall_offset_ns = time.time_ns() - self._start_ns
        self._sink = Sink(self.path, overwrite=overwrite)
        try:
            self._writer: Any = open_writer(self._sink, compression)
            self._begin(topics)
            for topic in topics or ():
                self._subscribe(topic)
        except BaseException:
            self._drop_subscribers()
            self._sink.close()
            if not overwrite:
                self.path.unlink(missing_ok=True)
            raise
        self._thread = threading.Thread(target=self._run, name=f"{node.name} recorder", daemon=True)
        self._thread.start()
        atexit.register(self._close_at_exit)

    @property
    def stats(self) -> RecordStats:
        """What was counted so far."""
        self._count_losses()
        topics = {topic: replace(stats) for topic, stats in sorted(self._topics.copy().items())}
        return RecordStats(
            topics,
            sum(stats.written for stats in topics.values()),
            self._unwritten,
            self._sink.tell(),
            ((self._end_ns or time.monotonic_ns()) - self._start_ns) * 1e-9,
        )

    @property
    def running(self) -> bool:
        """Whether it records: neither closed nor ended by an error."""
        return self._thread.is_alive() and not self._stopping

    def close(self, timeout_s: float = 30.0) -> RecordStats:
        """Write what was received, and the file's summary.

        Raises:
            OSError: The file could not be written; it can be read up to there.
            TimeoutError: The disk did not take it in time.
        """
        self._stopping = True
        self._wakeup.set()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise TimeoutError(f"{self.path} was not written within {timeout_s} s")
        atexit.unregister(self._close_at_exit)
        if self.error is not None:
            raise self.error
        return self.stats

    def _close_at_exit(self) -> None:
        if self._pid != os.getpid():  # a forked child has a copy of us, but not our thread
            return
        try:
            self.close(5.0)
        except OSError as error:
            logger.error("%s", error)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self.close()
        except OSError as error:
            if kind is None:
                raise
            logger.error("%s", error)

    # The recording thread

    def _run(self) -> None:
        try:
            while not self._stopping:
                self._look_for_topics()
                self._write(self._take(_WAIT_MS))
                self._flush_old()
            deadline_ns = time.monotonic_ns() + _DRAIN_NS
            while time.monotonic_ns() < deadline_ns and self._write(self._take(0.0)):
                pass  # what had arrived when we were told to stop
            self._drop_subscribers()
            self._finish()
        except OSError as error:
            self._fail(error)
        except Exception as error:  # what we did not think of must not end the recording in silence
            logger.exception("%s: the recorder failed", self.path)
            if self._is_whole:
                with contextlib.suppress(Exception):
                    self._finish()
            self._fail(error)
        finally:
            self._end_ns = time.monotonic_ns()
            self._drop_subscribers()
            self._sink.close()

    def _subscribe(self, topic: str) -> None:
        subscriber: Subscriber[Any] = self._node.subscriber(topic, None, policy=self._policy)
        self._counters[topic] = subscriber.counters
        self._topics[topic] = TopicStats()
        self._subscribers[topic] = subscriber

    def _drop_subscribers(self) -> None:
        while self._subscribers:
            self._subscribers.popitem()[1].close()

    def _look_for_topics(self) -> None:
        now_ns = time.monotonic_ns()
        if not self._all or now_ns - self._look_ns < _LOOK_NS:
            return
        self._look_ns = now_ns
        for info in self._node.topics():
            if info.publishers and info.topic not in self._subscribers:
                try:
                    self._subscribe(info.topic)
                except Closed:
                    self._stopping = True
                    return

    def _take(self, wait_ms: float) -> list[_Taken]:
        """What has arrived, in the order of publishing; waits a little for the first."""
        taken: list[_Taken] = []
        for topic in self._ready(wait_ms):
            try:
                more = _take_from(self._subscribers[topic], taken)
            except Closed:  # the node was closed before us
                self._stopping = True
                continue
            (self._busy.add if more else self._busy.discard)(topic)
        taken.sort(key=lambda item: item[0].publish_ns)
        self._received += len(taken)
        return taken

    def _ready(self, wait_ms: float) -> list[str]:
        """Topics on which something may have come; all of them if the wait was for nothing."""
        poll, owners = select.poll(), {each.fd: each for each in self._subscribers.values()}
        for fd in (self._wakeup.fd, *owners):
            poll.register(fd, select.POLLIN)
        events = poll.poll(0.0 if self._busy else wait_ms)
        self._wakeup.clear()
        if not events:
            return list(self._subscribers)
        ready = set(self._busy)
        for fd, _ in events:
            if (subscriber := owners.get(fd)) is not None:
                subscriber.wakeup.clear()
                ready.add(subscriber.topic)
        return list(ready)

    def _write(self, taken: list[_Taken]) -> int:
        for info, body, schema in taken:
            channel = self._channel_of(info, schema)
            stats = self._topics[info.topic]
            stats.written += 1
            stats.bytes += info.size
            self._pending[info.topic, info.size] += 1
            # Within a turn messages are in the order of publishing; time in a file must never run back.
            received_ns = _clamp(info.publish_ns + info.latency_ns + self._wall_offset_ns)
            self._log_ns = max(self._log_ns, received_ns)
            self._is_whole = False
            self._writer.add_message(
                channel,
                log_time=self._log_ns,
                data=cast(bytes, body),
                publish_time=_clamp(info.publish_ns + self._wall_offset_ns),
                sequence=info.sequence & 0xFFFFFFFF,
            )
            self._is_whole = True
            self._note_chunk()
        return len(taken)

    def _flush_old(self) -> None:
        now_ns = time.monotonic_ns()
        if now_ns - self._flush_ns >= FLUSH_NS:
            self._flush_ns = now_ns
            self._writer.flush()
            self._note_chunk()

    def _note_chunk(self) -> None:
        """See whether the writer has put a chunk into the file."""
        if self._sink.tell() != self._chunk_end:
            self._chunk_end = self._sink.tell()
            self._pending.clear()

    def _channel_of(self, info: Info, schema: Schema) -> int:
        channel = self._channels.get((info.topic, info.source))
        if channel is None:
            if len(self._channels) == _CHANNELS_MAX:
                raise OSError(errno.EMFILE, f"more than {_CHANNELS_MAX} publishers", str(self.path))
            channel = self._channels[info.topic, info.source] = self._add_channel(info, schema)
        return channel

    def _add_channel(self, info: Info, schema: Schema) -> int:
        node, latch = "", False
        for record in self._node.nodes():
            for publisher in record.publishers:
                if publisher.source == info.source:
                    node, latch = record.name, publisher.latch
        return add_channel(
            self._writer, self._schemas, info.topic, schema, source=info.source, node=node, latch=latch
        )

    def _begin(self, topics: Sequence[str] | None) -> None:
        self._writer.start(profile=names.PROFILE, library="cortex")
        start = {
            "format": names.FORMAT_VERSION,
            "host": socket.gethostname(),
            "node": self._node.name,
            "domain": str(self._node.domain),
            "start_ns": str(self._start_ns + self._wall_offset_ns),
            "policy": str(self._policy),
            "topics": "all" if topics is None else " ".join(topics),
        }
        self._writer.add_metadata(names.START, start)
        self._writer.flush()
        self._note_chunk()

    def _finish(self) -> None:
        self._writer.flush()
        self._note_chunk()
        self._count_losses()
        counts = {topic: json.dumps(asdict(stats)) for topic, stats in sorted(self._topics.items())}
        self._writer.add_metadata(names.END, counts)
        self._writer.finish()

    def _fail(self, error: Exception) -> None:
        self._note_chunk()
        for (topic, size), count in self._pending.items():
            self._topics[topic].written -= count
            self._topics[topic].bytes -= size * count
        self._unwritten = self._received - sum(stats.written for stats in self._topics.values())
        number = (error.errno or errno.EIO) if isinstance(error, OSError) else errno.EIO
        has_number = isinstance(error, OSError) and error.errno
        why = os.strerror(number) if has_number else f"{type(error).__name__}: {error}"
        what = (
            f"recording ended after {self._sink.tell()} bytes, {self._unwritten} messages that had arrived "
            f"are not in the file: {why}"
        )
        self.error = OSError(number, what, str(self.path))
        logger.debug("%s: %s", self.path, what)

    def _count_losses(self) -> None:
        for topic, counters in self._counters.copy().items():
            stats = self._topics[topic]
            for name in ("lost", "overtaken", "rejected", "cut_off"):
                setattr(stats, name, getattr(counters, name))


def _clamp(time_ns: int) -> int:
    """A time as the file can hold it; that of a strange clock may be anything."""
    return min(max(time_ns, 0), _U64_MAX)


def _take_from(subscriber: Subscriber[Any], taken: list[_Taken]) -> bool:
    """Add to `taken` what has arrived; returns whether there may be more."""
    size = 0
    for _ in range(_TURN_MESSAGES):
        try:
            item = subscriber.recv_raw(0.0)
        except TimeoutError:
            return False
        except TypeMismatch as error:
            logger.warning("%s", error)
            continue
        taken.append(item)
        size += item[0].size
        if size >= _TURN_BYTES:
            return True
    return True
