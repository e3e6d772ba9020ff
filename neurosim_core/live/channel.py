"""What a stream of messages passes on its way: a simulated link, or nothing, which then costs nothing."""

from __future__ import annotations

from collections import deque
from dataclasses import fields
from typing import Any

import numpy as np

from neurosim_core.live.config import LinkConfig
from neurosim_core.live.links import Link
from neurosim_core.packets import Delivery, Packet


class Channel:
    """Holds messages from when they are sent until they are due, in the order in which they were sent.

    Not for more than one thread.

    Attributes:
        config: Settings of the link.
    """

    def __init__(self, name: str, config: LinkConfig, *, seed: int) -> None:
        """Make an empty channel.

        Args:
            name: What travels on it, such as "command".
            config: Settings of the link.
            seed: Seed of the link.
        """
        self.config = config
        self._link = Link(config, seed=seed, name=name)
        self._is_direct = config.delivers_at_once
        self._direct: deque[tuple[int, Any]] = deque()

    def send(self, item: Any, *, stamp_ns: int, size_bytes: int) -> Delivery | None:
        """Send a message, not before the one sent last.

        Returns:
            What the link does to it; None if there is nothing in its way.
        """
        if self.delivers_at_once:
            self._direct.append((stamp_ns, item))
            return None
        return self._link.send(item, stamp_ns=stamp_ns, size_bytes=size_bytes)

    def due(self, stamp_ns: int) -> list[tuple[int, Any]]:
        """Take what has arrived by a time [ns]: pairs of arrival [ns] and message, in order."""
        if not (self._direct or len(self._link)):
            return []
        arrived: list[tuple[int, Any]] = []
        while self._direct and self._direct[0][0] <= stamp_ns:
            arrived.append(self._direct.popleft())
        if len(self._link):
            arrived += self._link.due(stamp_ns)
        return arrived

    @property
    def delivers_at_once(self) -> bool:
        """Whether nothing is in the way of the next message."""
        return self._is_direct and not len(self._link)

    @property
    def next_due_ns(self) -> int | None:
        """When the next message arrives [ns]; None if there is none under way."""
        return self._direct[0][0] if self._direct else self._link.next_due_ns

    @property
    def lost_count(self) -> int:
        """Messages that the link lost since the last reset."""
        return self._link.lost_count

    def configure(self, config: LinkConfig) -> None:
        """Change the link for what is sent from now on."""
        self.config = config
        self._is_direct = config.delivers_at_once
        self._link.configure(config)

    def reset(self, *, seed: int) -> None:
        """Forget what is under way and begin again."""
        self._direct.clear()
        self._link.reset(seed=seed)


def payload_bytes(packet: Packet) -> int:
    """Size of what a sensor measured, as far as it takes bandwidth: its arrays and its stamp [bytes]."""
    values = (getattr(packet, field.name) for field in fields(packet))
    return 8 + sum(value.nbytes for value in values if isinstance(value, np.ndarray))
