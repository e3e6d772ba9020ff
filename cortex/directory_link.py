"""A node's connection to the registry."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import zmq

from cortex.control import HEARTBEAT_NS

CONNECT_FIRST_NS = 2_000_000


@dataclass(eq=False)
class DirectoryLink:
    """What is known of the connection, and through it."""

    address: str
    socket: zmq.Socket[Any]
    next_ns: int
    """When to send the next heartbeat or `Hello`."""
    heard_ns: int
    """When the other side, or the start of our waiting for it, was last heard."""
    wait_ns: int = CONNECT_FIRST_NS
    asked: bool = False
    """Whether a `Hello` has been sent and not answered yet."""
    quiet_ns: int = 0
    """Until when an `Alive` is no reason for a further `Hello`."""
    welcomed: bool = False
    epoch: int = 0
    version: int = 0
    missing: dict[int, int] = field(default_factory=dict)
    """Revisions that `Welcome` named and that have not arrived yet, by node."""
    doubted: dict[int, int] = field(default_factory=dict)
    """When to drop a node that the registry did not name in its last `Welcome` [ns]."""
    warned: bool = False

    def greet(self, now_ns: int) -> None:
        """The other side has answered."""
        if not self.welcomed:
            self.next_ns = now_ns + HEARTBEAT_NS
        self.welcomed, self.asked, self.quiet_ns = True, False, 0

    def lose(self) -> None:
        """The connection is gone. What was known through it stays, until its lease says otherwise."""
        if self.welcomed or self.asked:
            self.wait_ns = CONNECT_FIRST_NS
        self.welcomed = self.asked = False

    def count(self, version: int) -> None:
        """Take note of a change that the registry has numbered."""
        # Records of a snapshot are older than the `Welcome` before them; a gap shows at the next `Alive`.
        if self.welcomed and version == self.version + 1:
            self.version = version
