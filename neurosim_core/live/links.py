"""Simulated links between the simulator and its controllers: delay, loss and bandwidth, in simulated time.

All times are integer nanoseconds, and all random numbers are addressed by (seed, link, message number): what
a link does to message n depends on the settings, the seed and the messages before it, and on nothing else.
"""

from __future__ import annotations

from collections import deque
from dataclasses import fields
from fractions import Fraction
from typing import Any

import numpy as np

from neurosim_core.clock import NS_PER_S, to_ns
from neurosim_core.live.config import LinkConfig
from neurosim_core.packets import Delivery, Packet
from neurosim_core.random import stream_id


class Link:
    """One direction of one stream: a queue of messages in the order sent. Not thread-safe.

    A message waits until those before it have left, occupies the link for size / bandwidth, and then travels
    for latency + jitter. It never arrives before one that was sent earlier. A lost message occupies the link
    like any other, but its jitter delays no other message. A message that would wait longer than `queue_s` is
    lost without occupying the link.

    Attributes:
        config: The settings for messages sent from now on.
        lost_count: Messages lost since the last reset.
    """

    def __init__(self, config: LinkConfig, *, seed: int, name: str) -> None:
        """Make an empty link.

        `config`: its settings; those of the sensor's clock have no effect here. `seed`: seed of jitter and
        loss, 0 <= seed < 2^64. `name`: what travels on it, such as "command"; links of other names draw other
        random numbers.
        """
        self._name = name
        self._stream = stream_id(f"link/{name}")
        self.reset(seed=seed)
        self.configure(config)

    def reset(self, *, seed: int) -> None:
        """Forget all messages; message numbers start again at 0, with the random numbers of `seed`."""
        self._seed = seed
        self._sent_count = 0
        self._sent_ns = 0
        self.lost_count = 0
        self._pending: deque[tuple[int, Any]] = deque()
        self._last_delivered_ns = 0
        self._busy_until_ns = 0
        self._begin_burst(0)

    def configure(self, config: LinkConfig) -> None:
        """Change the settings for messages sent from now on; those in flight keep their arrival time."""
        self.config = config
        self._is_direct = config.delivers_at_once
        self._latency_ns = to_ns(config.latency_s)
        self._jitter_ns = to_ns(config.jitter_s)
        self._queue_ns = to_ns(config.queue_s)
        self._lost_below = int(Fraction(config.loss) * 2**64)
        rate = config.bandwidth_bytes_s
        self._ns_per_byte = None if rate is None else NS_PER_S / Fraction(rate)
        self._begin_burst(self._busy_until_ns)

    def send(self, item: Any, *, stamp_ns: int, size_bytes: int) -> Delivery | None:
        """Send a message.

        `item`: the message; kept until it is due. `stamp_ns`: when it is sent [ns], not before the message
        sent last. `size_bytes`: the bandwidth it takes [bytes]. Returns what happens to it; `delivered_ns` is
        -1 if it is lost. None if the link does nothing and no earlier message delays this one.
        """
        if stamp_ns < self._sent_ns:
            raise ValueError(
                f"link {self._name!r}: stamp_ns must be >= {self._sent_ns}, the stamp of the message before, "
                f"got {stamp_ns}"
            )
        self._sent_ns = stamp_ns
        if self.is_free(stamp_ns):
            self._pending.append((stamp_ns, item))
            return None
        number = self._sent_count
        self._sent_count += 1
        wait_ns = 0 if self._ns_per_byte is None else self._busy_until_ns - stamp_ns
        delay_ns, lost = self._latency_ns, wait_ns > self._queue_ns
        left_ns = stamp_ns if lost else self._occupy(stamp_ns, size_bytes)
        if self._jitter_ns or self._lost_below:
            jitter_bits, loss_bits = self._random_bits(number)
            delay_ns += jitter_bits * (self._jitter_ns + 1) >> 64
            lost = lost or loss_bits < self._lost_below
        if lost:
            self.lost_count += 1
            delivered_ns = -1
        else:
            delivered_ns = max(left_ns + delay_ns, self._last_delivered_ns)
            self._last_delivered_ns = delivered_ns
            self._pending.append((delivered_ns, item))
        return Delivery(
            stamp_ns=stamp_ns,
            sequence=number,
            sensor=f"{self._name}_link",
            delivered_ns=delivered_ns,
            size_bytes=size_bytes,
        )

    def is_free(self, stamp_ns: int) -> bool:
        """Return whether a message sent at a time [ns] arrives at once."""
        return self._is_direct and self._last_delivered_ns <= stamp_ns

    def due(self, stamp_ns: int) -> list[tuple[int, Any]]:
        """Take the messages that have arrived by a time [ns]: pairs of arrival [ns] and message, in order."""
        arrived = []
        while self._pending and self._pending[0][0] <= stamp_ns:
            arrived.append(self._pending.popleft())
        return arrived

    @property
    def next_due_ns(self) -> int | None:
        """When the next message arrives [ns]; None if none is in flight."""
        return self._pending[0][0] if self._pending else None

    def __len__(self) -> int:
        """Messages in flight."""
        return len(self._pending)

    def _begin_burst(self, start_ns: int) -> None:
        """Count the bytes that follow each other without a gap, so that no rounding accumulates."""
        self._burst_start_ns = start_ns
        self._burst_bytes = 0

    def _occupy(self, stamp_ns: int, size_bytes: int) -> int:
        """Put a message on the link after those before it; return when its last byte is on it [ns]."""
        if self._ns_per_byte is None:
            return stamp_ns
        if stamp_ns >= self._busy_until_ns:
            self._begin_burst(stamp_ns)
        self._burst_bytes += size_bytes
        self._busy_until_ns = self._burst_start_ns + -(-self._burst_bytes * self._ns_per_byte // 1)
        return self._busy_until_ns

    def _random_bits(self, number: int) -> tuple[int, int]:
        """Two words of 64 random bits for a message: Philox 4x64-10, keyed by seed and link."""
        words = np.random.Philox(key=self._stream << 64 | self._seed, counter=number).random_raw(2)
        return int(words[0]), int(words[1])


def payload_bytes(packet: Packet) -> int:
    """Return the bandwidth that a packet takes: its arrays and its stamp [bytes]."""
    values = (getattr(packet, field.name) for field in fields(packet))
    return 8 + sum(value.nbytes for value in values if isinstance(value, np.ndarray))
