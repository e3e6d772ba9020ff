"""What a child process is asked to do, and the shape of a transport that can do it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from cortex.bench.tally import Floats

PATIENCE_S = 30.0
"""Longest wait for one message, before the other side counts as dead [s]."""
PONG_FLOATS = 10
"""Items of the answer in a round trip: 40 bytes."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One repetition of one contestant, as its processes see it."""

    transport: str
    """Key of `cortex.bench.transports.TRANSPORTS`."""
    floats: int
    """Items of the float32 payload."""
    seconds: float = 0.5
    """How long to publish [s], if ``count`` is 0."""
    count: int = 0
    """How many messages to publish; 0: as many as go into ``seconds``."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """What the transport wants to know besides: policy, way of receiving, and so on."""
    folder: Path = Path()
    """Private directory of this repetition."""
    address: Mapping[str, Any] = field(default_factory=dict)
    """What the side that starts first says about where it is."""

    @property
    def payload_bytes(self) -> int:
        """Size of the payload."""
        return 4 * self.floats

    @property
    def depth(self) -> int:
        """How many messages may wait between the two sides: 1000, or 64 MB of them."""
        return max(1, min(1000, 64_000_000 // self.payload_bytes))


class Sender(Protocol):
    """The publishing side of a flood."""

    address: Mapping[str, Any]

    def send(self, sequence: int, data: Floats) -> None:
        """Publish one message; block rather than lose one, where the transport can."""

    def close(self) -> None:
        """Let go of everything."""

    def report(self) -> dict[str, Any]:
        """Return what the transport itself counted."""


class Client(Protocol):
    """The asking side of a round trip."""

    address: Mapping[str, Any]

    def ping(self, sequence: int, data: Floats, timeout_s: float) -> bool:
        """Send one message and wait for its answer; False if none comes in time."""

    def close(self) -> None:
        """Send END to the server and let go of everything."""


class Transport(NamedTuple):
    """How to flood and how to make round trips over one library; None: not measured."""

    sender: Callable[[Job], Sender] | None = None
    receive: Callable[[Job, Callable[[], None]], dict[str, Any]] | None = None
    """Receive until END and return the report; calls its second argument at the first message."""
    client: Callable[[Job], Client] | None = None
    serve: Callable[[Job], None] | None = None
    """Answer until END."""
    module: str = ""
    """What has to be importable for this transport."""
