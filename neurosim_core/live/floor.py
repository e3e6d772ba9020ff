"""What a transport cannot be faster than: how long it takes on this machine to wake another process.

A process of its own sends at a rate, and sleeps in between as a simulator does that waits for the wall clock.
In turn it sends the time through a pipe, and a small message through Cortex. The listener sleeps until each
comes. So both meet the same machine.
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cortex import Node, reliable
from cortex.messages import Clock

_MODULE = "neurosim_core.live.floor"
"""This one, which the other process runs."""
_TOPIC = "/floor/clock"
_START_S = 60.0
"""Longest wait for the first message."""
_SILENCE_S = 10.0
"""Longest wait for any other."""
_LEAD_NS = 50_000_000
"""Between the first sign of life and the first message [ns]."""


class FloorError(RuntimeError):
    """The sender was silent, or ended; the message says so."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FloorTrace:
    """Times from sending to having [ns], each of shape [n]."""

    wake_ns: NDArray[np.int64]
    """Eight bytes through a pipe to a thread that sleeps in `poll` until they are there."""
    message_ns: NDArray[np.int64]
    """A message of 40 bytes through Cortex."""


def measure_floor(rate_hz: float, *, seconds: float) -> FloorTrace:
    """Measure how long messages take that come at a rate.

    Args:
        rate_hz: Of the messages, of both kinds together [Hz].
        seconds: How long [s]; at least 10 messages of each kind are sent.

    Raises:
        FloorError: The sender was silent, or ended.
    """
    count = max(round(rate_hz * seconds / 2), 10)
    wake: list[int] = []
    messages: list[int] = []
    with Node("floor listener") as node:
        clocks = node.subscriber(_TOPIC, Clock, policy=reliable(timeout_s=_SILENCE_S))
        with _sender(rate_hz, count) as pipe:
            for turn in range(count):
                sent_ns = _read_time(pipe, _SILENCE_S if turn else _START_S)
                wake.append(time.monotonic_ns() - sent_ns)
                try:
                    _, info = clocks.recv_with_info(_SILENCE_S)
                except TimeoutError as error:
                    raise FloorError(f"the sender of the floor was silent: {error}") from None
                messages.append(info.latency_ns)
    return FloorTrace(wake_ns=np.array(wake, dtype=np.int64), message_ns=np.array(messages, dtype=np.int64))


def _read_time(pipe: int, limit_s: float) -> int:
    """Take the next time from a pipe [ns]."""
    poll = select.poll()
    poll.register(pipe, select.POLLIN)
    if not poll.poll(limit_s * 1e3):
        raise FloorError(f"the sender of the floor was silent for {limit_s:g} s")
    data = os.read(pipe, 8)
    if len(data) < 8:
        raise FloorError("the sender of the floor has ended")
    return int.from_bytes(data, sys.byteorder)


@contextmanager
def _sender(rate_hz: float, count: int) -> Iterator[int]:
    """Start the other process; yields the end of the pipe to read from."""
    reading, writing = os.pipe()
    try:
        arguments = [str(value) for value in (rate_hz, count, writing)]
        process = subprocess.Popen(
            [sys.executable, "-m", _MODULE, *arguments],
            pass_fds=[writing],
            stdin=subprocess.DEVNULL,
        )
        os.close(writing)
        try:
            yield reading
        finally:
            process.kill()
            process.wait()
    finally:
        os.close(reading)


def _send(rate_hz: float, count: int, pipe: int) -> None:
    """Be the other process."""
    with Node("floor sender") as node:
        clock = node.publisher(_TOPIC, Clock)
        if not clock.wait_for_subscribers(1, timeout_s=_START_S):
            raise FloorError("nobody listens to the floor")
        origin_ns = time.monotonic_ns() + _LEAD_NS
        for turn in range(2 * count):
            while (left_ns := origin_ns + round(turn * 1e9 / rate_hz) - time.monotonic_ns()) > 0:
                time.sleep(left_ns * 1e-9)
            if turn % 2:
                clock.publish(Clock(stamp_ns=turn, wall_ns=time.time_ns(), sequence=turn))
            else:
                os.write(pipe, time.monotonic_ns().to_bytes(8, sys.byteorder))
        time.sleep(_SILENCE_S)  # the listener ends this process when it has everything


if __name__ == "__main__":
    _send(float(sys.argv[1]), *(int(value) for value in sys.argv[2:]))
