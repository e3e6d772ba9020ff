"""The jobs of a child process, and the libraries that do them, each used as its manual advises.

Where bytes are sent, a message is a header of 64 bytes (sequence, stamp, room) and the payload, of which the
receiver gets a NumPy view.
"""

from __future__ import annotations

import array
import importlib
import importlib.util
import os
import struct
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zmq

from cortex.bench.tally import Floats, Handler

PATIENCE_S = 30.0
"""Longest wait for one message, before the other side counts as dead [s]."""
PONG_FLOATS = 10
"""Items of the answer in a round trip: 40 bytes."""

_HEADER = struct.Struct("<qq48x")
_HEADER_BYTES = _HEADER.size
_F32 = np.dtype(np.float32)
_VIEW: Any = np.ndarray

Send = Callable[[int, Floats], object]
"""Sends a sequence and a payload, and rather blocks than loses, where that is possible."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One repetition of one contestant, as its processes see it."""

    peer: str
    floats: int
    seconds: float = 0.5
    """How long to publish [s], if ``count`` is 0."""
    count: int = 0
    """How many messages to publish; 0: as many as go into ``seconds``."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """What the peer wants to know besides: policy, way of receiving, and so on."""
    folder: Path = Path()
    port: int = 0

    @property
    def payload_bytes(self) -> int:
        """Size of the payload."""
        return 4 * self.floats

    @property
    def depth(self) -> int:
        """How many messages may wait between the two sides: 1000, or 64 MB of them."""
        return max(1, min(1000, 64_000_000 // self.payload_bytes))

    @property
    def slots(self) -> int:
        """How many messages a ring of shared memory holds: about 4 MB of them, 4 to 64."""
        return max(4, min(64, 4_000_000 // self.payload_bytes))


class Peer(NamedTuple):
    """How to use one library."""

    publisher: Callable[[Job, str], Send]
    """Opens a topic, named by the second argument."""
    receive: Callable[[Job, str, Handler, str], None]
    """Hands each message of a topic to the handler until that raises `Finished`, in the way of receiving that
    the last argument names, if there are several."""
    needs: str = ""
    close: Callable[[], object] = lambda: None
    """Lets what was sent last arrive."""


# pyzmq: XPUB_NODROP and bounded queues make the publisher wait instead of losing anything. Options: `frames`
# (1 or 2), `tcp` (an address).


def _zmq_publisher(job: Job, topic: str) -> Send:
    socket = _zmq_socket(job, topic, zmq.PUB)
    send: Any = socket.send
    pack, now, more = _HEADER.pack, time.monotonic_ns, zmq.SNDMORE

    def send_one(sequence: int, data: Floats) -> None:
        send(pack(sequence, now()) + data.tobytes())

    def send_two(sequence: int, data: Floats) -> None:
        send(pack(sequence, now()), more)
        send(data, copy=False)

    return send_two if job.options.get("frames") == 2 and topic != "pong" else send_one


def _zmq_receive(job: Job, topic: str, handle: Handler, how: str) -> None:
    socket = _zmq_socket(job, topic, zmq.SUB)
    recv, unpack, view, dtype = socket.recv, _HEADER.unpack_from, _VIEW, _F32
    shape = (PONG_FLOATS if topic == "pong" else job.floats,)
    if job.options.get("frames") == 2 and topic != "pong":
        while True:
            header = recv()
            handle(unpack(header)[0], view(shape, dtype, recv(copy=False)))
    while True:
        frame = recv()
        handle(unpack(frame)[0], view(shape, dtype, frame, _HEADER_BYTES))


def _zmq_socket(job: Job, topic: str, kind: int) -> zmq.Socket[Any]:
    """Open a socket; who publishes a flood or a ping binds, the other one connects."""
    socket: zmq.Socket[Any] = zmq.Context.instance().socket(kind)
    socket.sndhwm = socket.rcvhwm = job.depth
    socket.sndtimeo = socket.rcvtimeo = int(PATIENCE_S * 1000)
    socket.copy_threshold = 0  # two frames "without copy" means it, also for small payloads
    if kind == zmq.SUB:
        socket.subscribe(b"")
    else:
        socket.setsockopt(zmq.XPUB_NODROP, 1)
    address = job.options.get("tcp")
    attach = socket.bind if (kind == zmq.PUB) == (topic != "pong") else socket.connect
    attach(f"tcp://{address}:{job.port}" if address else f"ipc://{job.folder}/{topic}")
    return socket


# Cyclone DDS by its own Python binding: typed messages, reliable, everything kept until it is acknowledged.


def _dds(job: Job, topic: str) -> tuple[Any, Any, Any, Any]:
    load = importlib.import_module
    types, qos = load("cyclonedds.idl.types"), load("cyclonedds.qos")
    fields = {"stamp_ns": types.int64, "data": types.sequence[types.float32]}
    kind = load("cyclonedds.idl").make_idl_struct("Sample", "bench.Sample", fields)
    participant = load("cyclonedds.domain").DomainParticipant(job.port % 200)
    policies = qos.Qos(
        qos.Policy.Reliability.Reliable(max_blocking_time=int(PATIENCE_S * 1e9)),
        qos.Policy.History.KeepAll,
        qos.Policy.ResourceLimits(max_samples=job.depth),
    )
    return participant, load("cyclonedds.topic").Topic(participant, topic, kind), policies, kind


def _dds_publisher(job: Job, topic: str) -> Send:
    participant, dds_topic, policies, kind = _dds(job, topic)
    writer = importlib.import_module("cyclonedds.pub").DataWriter(participant, dds_topic, policies)
    return lambda sequence, data: writer.write(kind(sequence, data.tolist()))


def _dds_receive(job: Job, topic: str, handle: Handler, how: str) -> None:
    participant, dds_topic, policies, _ = _dds(job, topic)
    reader = importlib.import_module("cyclonedds.sub").DataReader(participant, dds_topic, policies)
    for sample in reader.take_iter(timeout=int(PATIENCE_S * 1e9)):
        handle(sample.stamp_ns, np.asarray(sample.data, _F32))


# ROS 2 through rclpy: std_msgs/Float32MultiArray, reliable, received in a callback of the usual executor. The
# offset of an array, which carries the sequence, is unsigned, and END is -2.


def _rclpy_node(job: Job) -> tuple[Any, Any, Any, Any]:
    rclpy, qos = importlib.import_module("rclpy"), importlib.import_module("rclpy.qos")
    rclpy.init(domain_id=job.port % 100)
    keep_all, reliable = qos.HistoryPolicy.KEEP_ALL, qos.ReliabilityPolicy.RELIABLE
    profile = qos.QoSProfile(history=keep_all, reliability=reliable)
    kind = importlib.import_module("std_msgs.msg").Float32MultiArray
    return rclpy, rclpy.create_node("bench"), kind, profile


def _rclpy_publisher(job: Job, topic: str) -> Send:
    _, node, kind, profile = _rclpy_node(job)
    publisher = node.create_publisher(kind, topic, profile)

    def send(sequence: int, data: Floats) -> None:
        message = kind(data=array.array("f", data.tobytes()))
        message.layout.data_offset = sequence + 2
        publisher.publish(message)

    return send


def _rclpy_receive(job: Job, topic: str, handle: Handler, how: str) -> None:
    rclpy, node, kind, profile = _rclpy_node(job)
    node.create_subscription(kind, topic, lambda m: handle(m.layout.data_offset - 2, m.data), profile)
    rclpy.spin(node)


PEERS = {
    "pyzmq": Peer(_zmq_publisher, _zmq_receive, close=lambda: zmq.Context.instance().destroy(1000)),
    "Cyclone DDS": Peer(_dds_publisher, _dds_receive, "cyclonedds"),
    "rclpy": Peer(_rclpy_publisher, _rclpy_receive, "rclpy"),
}


def missing(peer: str) -> str:
    """Return why a peer cannot be measured here, in words; empty if it can."""
    needs = PEERS[peer].needs if peer in PEERS else ""
    return "not installed" if needs and importlib.util.find_spec(needs) is None else ""


def peer_of(job: Job) -> Peer:
    """Return how to use a job's library, Cortex being that of the checkout that option ``checkout`` names."""
    if job.peer in PEERS:
        return PEERS[job.peer]
    if checkout := job.options.get("checkout"):
        import_cortex(checkout)
    peer: Peer = importlib.import_module("cortex.bench.peer_cortex").PEER
    return peer


def import_cortex(checkout: str) -> None:
    """Let `cortex` be that of another checkout in this process, all but the benchmark."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "cortex"]:
        if not name.startswith("cortex.bench") or name == "cortex.bench.peer_cortex":
            del sys.modules[name]
    sys.path.insert(0, checkout)
    os.environ["CORTEX_RUNTIME_DIR"] = str(runtime_dir(checkout))
    importlib.import_module("cortex")


def runtime_dir(checkout: str = "") -> Path:
    """Return where the nodes of this run find each other: those of another checkout keep to themselves."""
    return Path(os.environ["CORTEX_BENCH_DIR"], "rt-before" if checkout else "rt")
