"""LCM over UDP multicast: no back-pressure, so what it loses is shown."""

from __future__ import annotations

import importlib
import struct
import zlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from cortex.bench.job import Job, Sender
from cortex.bench.tally import Floats, Tally

_HEADER = struct.Struct("<q56x")
_CHANNEL = "bench"
_RECEIVE_BUFFER = 4 << 20


def sender(job: Job) -> Sender:
    """Open LCM on a port of this repetition's own."""
    return _Sender(job)


class _Sender:
    def __init__(self, job: Job) -> None:
        port = 20000 + zlib.crc32(bytes(job.folder)) % 20000
        url = f"udpm://239.255.76.67:{port}?ttl=0&recv_buf_size={_RECEIVE_BUFFER}"
        self.address: Mapping[str, Any] = {"url": url}
        self._lcm = importlib.import_module("lcm").LCM(url)

    def send(self, sequence: int, data: Floats) -> None:
        self._lcm.publish(_CHANNEL, _HEADER.pack(sequence) + data.tobytes())

    def report(self) -> dict[str, Any]:
        return {}

    def close(self) -> None:
        del self._lcm


def receive(job: Job, connected: Callable[[], None]) -> dict[str, Any]:
    """Count the messages of one flood."""
    done: list[bool] = []
    tally = Tally(job.floats, connected=connected, finish=lambda: done.append(True))
    handle = tally.handler()
    dtype = np.dtype(np.float32)

    def on_message(_channel: str, payload: bytes) -> None:
        handle(_HEADER.unpack_from(payload)[0], np.ndarray((job.floats,), dtype, payload, _HEADER.size))

    lcm = importlib.import_module("lcm").LCM(job.address["url"])
    subscription = lcm.subscribe(_CHANNEL, on_message)
    subscription.set_queue_capacity(0)
    while not done:
        lcm.handle_timeout(50)
    return tally.report()
