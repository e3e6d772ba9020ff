"""The fast path of a message in: `recv` and `async for` where nothing special is to be done.

That is: there is one publisher, nothing waits in the queue, and the next frame is the message that follows.
All else takes the slow path, `Subscriber._receive`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import zmq

from cortex.link import Item, Link
from cortex.native import NativeFastReceive
from cortex.receive_lock import ReceiveLock
from cortex.stats import SubscriberCounters

PAUSE_NS = 1_000_000
PAUSE_COUNT = 1024
"""An asyncio loop that always finds a message runs other tasks after so long, or so many messages."""


class _Nothing:
    """Stands for a message that did not come, or could not be read."""


NOTHING: Any = _Nothing()


class FastReceive:
    """Takes the messages of one subscriber, and counts them: in C. Without C it takes none."""

    def __init__(self) -> None:
        self.exhausted = True
        """Whether the last look into the sockets found nothing."""
        self.left = 0
        """Messages that `soon` may still take."""
        self.until_ns = 0
        """How long it may do so, on the monotonic clock."""
        self.taken_ns = 0
        """When the last message was taken, on the monotonic clock."""
        self.is_open = False

    def open(self, link: Link | None, coder: Any, /) -> None:
        """Read a link from now on; None: every message takes the slow path. The lock is held."""

    def __call__(self, may_wait: bool, /) -> Any:
        """Take the next message, after waiting a little for it if that is allowed; `NOTHING` if none came.

        Also if it went to the queue, because it takes more care.
        """
        return NOTHING

    def drain(self, link: Link, messages: deque[Any], limit: int, may_wait: bool, /) -> bytes | None:
        """Read the frames of a link with a coder that follow one another, and append their messages.

        The lock is held.

        Returns:
            What ended it: a frame that is something else; None if there was no more, or `limit` were read.
        """
        raise NotImplementedError("links have coders in C only")

    def soon(self) -> Any:
        """As a call with False, while an asyncio task may go on: `left` and `until_ns` say so."""
        return NOTHING


def make_fast_receive(
    receive_lock: ReceiveLock,
    queue: deque[Item],
    counters: SubscriberCounters,
    accept: Callable[[Link, bytes], None],
) -> FastReceive:
    """Build the fast path of one subscriber."""
    if NativeFastReceive is None:
        return FastReceive()
    fast_receive: FastReceive = NativeFastReceive(
        receive_lock.lock, receive_lock, queue, counters, zmq.Again, accept, NOTHING
    )
    return fast_receive
