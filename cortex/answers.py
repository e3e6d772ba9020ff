"""What a node answers to frames that come to its control sockets."""

from __future__ import annotations

import contextlib
import logging
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import cast

import zmq

from cortex.codec import MalformedMessage
from cortex.control import control_types
from cortex.places import Reach
from cortex.records import StatsReply, StatsRequest
from cortex.service import Server
from cortex.wire import REQUEST, control_frame, parse_control, unpack_header

logger = logging.getLogger(__name__)


class Answers:
    """Takes in requests and sends replies, on the node's control thread; `reply` may be called by any.

    Args:
        name: The node's, for what is logged.
        server: Handles requests of services.
        stats: Says what the node has counted.
        wake: Called when there is a reply to be sent.
    """

    def __init__(
        self,
        name: str,
        server: Server,
        *,
        stats: Callable[[], StatsReply],
        wake: Callable[[], None],
    ) -> None:
        self._name = name
        self._server = server
        self._stats = stats
        self._wake = wake
        self._replies: deque[tuple[zmq.Socket[bytes], bytes, bytes]] = deque()
        self.rejected = 0
        """Frames that made no sense."""

    def handle(self, router: zmq.Socket[bytes]) -> None:
        """Take in what has come to a ROUTER."""
        for _ in range(256):
            try:
                parts = router.recv_multipart(zmq.DONTWAIT)
            except zmq.Again:
                return
            try:
                if len(parts) != 2:
                    raise MalformedMessage(f"a control message of {len(parts)} frames")
                self._answer(router, parts[0], parts[1])
            except MalformedMessage as error:
                self.rejected += 1
                if self.rejected == 1:
                    logger.warning("%s: rejected a control frame: %s", self._name, error)

    def _answer(self, router: zmq.Socket[bytes], identity: bytes, frame: bytes) -> None:
        header = unpack_header(frame)
        if header.kind == REQUEST:
            self._server.handle(frame, partial(self._reply, router, identity))
        else:
            _, header = parse_control(frame, control_types(StatsRequest))
            self._reply(router, identity, control_frame(self._stats(), header.sequence))

    def _reply(self, router: zmq.Socket[bytes], identity: bytes, frame: bytes) -> None:
        self._replies.append((router, identity, frame))
        self._wake()

    def send(self) -> None:
        """Send the replies that there are."""
        while self._replies:
            router, identity, frame = self._replies.popleft()
            with contextlib.suppress(zmq.Again, zmq.ZMQError):  # an asker that is gone gets nothing
                router.send_multipart([identity, frame], zmq.DONTWAIT)


def ask_stats(place: Reach, asker: int, timeout_s: float) -> StatsReply | None:
    """Ask a node for its counters; None if it did not answer in time."""
    deadline_s = time.monotonic() + timeout_s
    types = control_types(StatsReply)
    with place.open() as socket:
        socket.send(control_frame(StatsRequest(asker)), zmq.DONTWAIT)
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            if socket.poll(max(1, int(left_s * 1000.0))):
                with contextlib.suppress(MalformedMessage):
                    reply, _ = parse_control(socket.recv(zmq.DONTWAIT), types)
                    return cast(StatsReply, reply)
    return None
