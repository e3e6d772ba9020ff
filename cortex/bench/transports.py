"""Every way of carrying messages that the benchmark knows, by name."""

from __future__ import annotations

import importlib.util

from cortex.bench import peer_cortex, peer_iceoryx, peer_lcm, peer_zenoh, peer_zmq
from cortex.bench.job import Transport

TRANSPORTS: dict[str, Transport] = {
    "cortex": Transport(
        sender=peer_cortex.sender,
        receive=peer_cortex.receive,
        client=peer_cortex.client,
        serve=peer_cortex.serve,
    ),
    "cortex-latest": Transport(sender=peer_cortex.reading_sender, receive=peer_cortex.receive_latest),
    "cortex-cpp": Transport(sender=peer_cortex.sender, receive=peer_cortex.receive_cpp),
    "pyzmq": Transport(
        sender=peer_zmq.sender, receive=peer_zmq.receive, client=peer_zmq.client, serve=peer_zmq.serve
    ),
    "pyzmq-latest": Transport(sender=peer_zmq.sender, receive=peer_zmq.receive_latest),
    "zenoh": Transport(sender=peer_zenoh.sender, receive=peer_zenoh.receive, module="zenoh"),
    "iceoryx2": Transport(sender=peer_iceoryx.sender, receive=peer_iceoryx.receive, module="iceoryx2"),
    "lcm": Transport(sender=peer_lcm.sender, receive=peer_lcm.receive, module="lcm"),
}


def missing(transport: str) -> str:
    """Return why a transport cannot be measured here, in words; empty if it can."""
    module = TRANSPORTS[transport].module
    if module and importlib.util.find_spec(module) is None:
        return "not installed"
    return peer_cortex.cpp_missing() if transport == "cortex-cpp" else ""
