"""Back-pressure: a publisher waits for full reliable readers; one thread at a time, without the lock."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from cortex.fast_send import FastSend
from cortex.pub_socket import Backoff, PubSockets


class BackPressure:
    """The waiting of one publisher. A block of it is the time of one message; the caller holds the lock."""

    def __init__(self, pub_sockets: PubSockets, fast_send: FastSend, check_open: Callable[[], None]) -> None:
        self._pub_sockets = pub_sockets
        self._fast_send = fast_send
        self._check_open = check_open
        self.until_s = math.inf
        """Nobody is waited for after this, on the monotonic clock [s]; set by any thread, without lock."""
        self.is_waiting = False
        """Whether a thread is held up: others wait until its message is sent."""
        self.waited_s = 0.0
        """For how long the message that is sent now was held up so far, by whomever [s]."""
        self._sequence = -1

    def __enter__(self) -> None:
        self.is_waiting = True
        self._fast_send.refresh_ns = 0  # other threads look at this

    def __exit__(self, *_: object) -> None:
        self.is_waiting = False

    def begin(self, sequence: int = -1) -> None:
        """Let the next message be held up anew.

        Args:
            sequence: Of the message, where this is called more than once for it.
        """
        if sequence < 0 or sequence != self._sequence:
            self.waited_s = 0.0
        self._sequence = sequence

    def is_over(self) -> bool:
        """Whether nobody is waited for any more."""
        return time.monotonic() >= self.until_s

    def sleep(self, backoff: Backoff) -> bool:
        """Sleep once, without the lock; False when its time is over, or everybody's.

        Raises:
            Closed: The publisher was closed meanwhile.
        """
        self._pub_sockets.lock.release()
        try:
            more = backoff.wait()
        finally:
            self._pub_sockets.lock.acquire()
        self._check_open()
        self._pub_sockets.refresh()
        return more and not self.is_over()

    def wait_for(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Call a function until it returns true; False if the message was held up for so long [s]."""
        begin_s, before_s = time.monotonic(), self.waited_s
        backoff = Backoff(timeout_s - before_s)
        with self:
            while not condition():
                more = self.sleep(backoff)
                self.waited_s = before_s + time.monotonic() - begin_s
                if not more:
                    return False
        return True
