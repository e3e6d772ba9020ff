"""Eclipse zenoh with shared memory: reliable, blocking when congested, two peers on loopback, no scouting.

Its Python binding hands shared memory over as bytes, so each side copies once.
"""

from __future__ import annotations

import importlib
import json
import socket
import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from cortex.bench.job import PATIENCE_S, Job, Sender
from cortex.bench.tally import Floats, Tally

_HEADER = struct.Struct("<q56x")
_KEY = "cortex/bench"


def sender(job: Job) -> Sender:
    """Open a session that listens."""
    return _Sender(job)


class _Sender:
    def __init__(self, job: Job) -> None:
        zenoh = importlib.import_module("zenoh")
        shm = importlib.import_module("zenoh.shm")
        endpoint = f"tcp/127.0.0.1:{_free_port()}"
        self.address: Mapping[str, Any] = {"endpoint": endpoint}
        self._session = zenoh.open(_config(zenoh, "listen", endpoint))
        self._publisher = self._session.declare_publisher(
            _KEY, congestion_control=zenoh.CongestionControl.BLOCK, reliability=zenoh.Reliability.RELIABLE
        )
        self._size = _HEADER.size + job.payload_bytes
        slots = max(4, min(64, 4_000_000 // self._size))
        self._provider = shm.ShmProvider.default_backend((self._size + 4096) * slots + 65536)
        self._policy = shm.BlockOn(shm.GarbageCollect())

    def send(self, sequence: int, data: Floats) -> None:
        buffer = self._provider.alloc(self._size, self._policy)
        buffer[0 : self._size] = _HEADER.pack(sequence) + data.tobytes()
        self._publisher.put(buffer)

    def report(self) -> dict[str, Any]:
        return {}

    def close(self) -> None:
        self._session.close()


def receive(job: Job, connected: Callable[[], None]) -> dict[str, Any]:
    """Count the messages of one flood, taken from zenoh's own queue."""
    done: list[bool] = []
    tally = Tally(job.floats, connected=connected, finish=lambda: done.append(True))
    handle = tally.copying_handler() if job.options.get("consume") else tally.handler()
    zenoh = importlib.import_module("zenoh")
    session = zenoh.open(_config(zenoh, "connect", job.address["endpoint"]))
    subscriber = session.declare_subscriber(_KEY)
    dtype = np.dtype(np.float32)
    while not done:
        payload = subscriber.recv().payload.to_bytes()
        handle(_HEADER.unpack_from(payload)[0], np.ndarray((job.floats,), dtype, payload, _HEADER.size))
    session.close()
    return tally.report()


def _config(zenoh: Any, role: str, endpoint: str) -> Any:
    config = zenoh.Config()
    for key, value in {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": True,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": int(PATIENCE_S * 1e6),
        "listen/endpoints": [endpoint] if role == "listen" else [],
        "connect/endpoints": [endpoint] if role == "connect" else [],
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port
