"""What the bridge costs on this machine: latencies from `publish` in Cortex to the callback in ROS.

    python3 examples/ros2_tour/latency.py [--backend rclpy] [--seconds 5]

There are three processes: a Cortex publisher, the bridge, and a subscriber in ROS. Messages are stamped when
they are published. It prints one `name value unit` a line.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from cortex import Node
from cortex.messages import Events, Image, Imu

WIDTH, HEIGHT = 640, 480
TICK_NS = 1_000_000
MATCH_S = 20.0
"""Longest wait until everybody has found each other [s]."""
PROFILE = "<CycloneDDS><Domain id='any'><General><Interfaces><NetworkInterface name='lo' multicast='false'/>\
</Interfaces><AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>\
<Peers><Peer address='127.0.0.1'/></Peers></Discovery></Domain></CycloneDDS>"
"""Only this machine, unless the environment says otherwise."""
QUANTILES = {"median": 0.5, "p90": 0.9, "p99": 0.99, "max": 1.0}


class Stream(NamedTuple):
    """One stream of the benchmark."""

    topic: str
    ros_topic: str
    ros_type: str


STREAMS = {
    "image": Stream("/bench/rgb", "/bench/rgb/image_raw", "sensor_msgs/msg/Image"),
    "events": Stream("/bench/events", "/bench/events", "event_camera_msgs/msg/EventPacket"),
    "imu": Stream("/bench/imu", "/bench/imu", "sensor_msgs/msg/Imu"),
}
"""The Imu comes at 1 kHz, and so do packets of events."""


@dataclass(frozen=True, kw_only=True)
class Load:
    """What is sent, and how."""

    seconds: float = 5.0
    """For how long [s]."""
    encoding: str = "evt3"
    """Of the events."""
    backend: str = "dds"
    """Of bridge and subscriber."""
    image_hz: int = 50
    """Pictures a second [Hz], a divisor of 1000."""
    events_per_s: int = 2_000_000
    """Events a second."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """What became of one stream."""

    sent: int
    received: int
    lost_in_bridge: int
    """As /diagnostics say; others were lost in ROS."""
    latency_ms: dict[str, float]
    """By the names of `QUANTILES` [ms]."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; return the exit status."""
    parser = argparse.ArgumentParser(description="measure the bridge on this machine")
    default = Load()
    parser.add_argument("--seconds", type=float, default=default.seconds, help="of each measurement [s]")
    parser.add_argument("--encoding", default=default.encoding, choices=["evt3", "mono"], help="of events")
    parser.add_argument("--backend", default=default.backend, choices=["dds", "rclpy"])
    parser.add_argument("--image-hz", type=int, default=default.image_hz, help="640x480 pictures a second")
    parser.add_argument("--events-per-s", type=int, default=default.events_per_s)
    parser.add_argument("--role", choices=["publish", "subscribe"], help=argparse.SUPPRESS)
    parser.add_argument("--streams", default="", help=argparse.SUPPRESS)
    given = vars(parser.parse_args(arguments))
    role, streams = given.pop("role"), given.pop("streams")
    load = Load(**given)
    if load.seconds <= 0.0 or load.image_hz < 1 or 1000 % load.image_hz or load.events_per_s < 1000:
        parser.error("--seconds must be > 0, --image-hz divide 1000, --events-per-s be 1000 or more")
    if role == "publish":
        return _publish(streams.split(","), load)
    if role == "subscribe":
        return _subscribe(streams.split(","), load.backend)
    print(f"# {platform.machine()}, {os.cpu_count()} CPUs at a load of {os.getloadavg()[0]:.1f}, "
          f"Python {platform.python_version()}, NumPy {np.__version__}; {load}")  # fmt: skip
    for together in (("imu",), ("image", "events"), ("image", "events", "imu")):
        for name, result in end_to_end(together, load).items():
            title = f"{'+'.join(together)}.{name}"
            print(f"{title}.received {result.received} of {result.sent} messages")
            print(f"{title}.lost_in_bridge {result.lost_in_bridge} messages")
            for which, value in result.latency_ms.items():
                print(f"{title}.latency_{which} {value:.3f} ms", flush=True)
    return 0


def end_to_end(streams: Sequence[str], load: Load) -> dict[str, Result]:
    """Send streams of `STREAMS` through a bridge, all at once; return what became of each.

    Raises:
        RuntimeError: A process ended early, or they did not find each other.
    """
    with tempfile.TemporaryDirectory(prefix="ctx-") as folder:
        settings = {"routes": [{"cortex": STREAMS["events"].topic, "type": STREAMS["events"].ros_type,
                                "options": {"encoding": load.encoding}}]}  # fmt: skip
        config = Path(folder, "bridge.yaml")
        config.write_text(yaml.safe_dump(settings), encoding="utf-8")
        environment = {
            **os.environ,
            "CORTEX_RUNTIME_DIR": folder,
            "ROS_DOMAIN_ID": str(1 + secrets.randbelow(100)),
            "CYCLONEDDS_URI": os.environ.get("CYCLONEDDS_URI", PROFILE),
        }
        given = [f"--{name.replace('_', '-')}={value}" for name, value in vars(load).items()]

        def run(*words: str) -> contextlib.AbstractContextManager[subprocess.Popen[str]]:
            return _process([sys.executable, *words], environment)

        def part(role: str) -> contextlib.AbstractContextManager[subprocess.Popen[str]]:
            return run(__file__, "--role", role, "--streams", ",".join(streams), *given)

        with (
            run("-m", "cortex_ros2_bridge", "--backend", load.backend, "--config", str(config)),
            part("subscribe") as subscriber,
            part("publish") as publisher,
        ):
            sent = _hear(publisher)
            print("end", file=subscriber.stdin, flush=True)
            got = _hear(subscriber)
    return {name: Result(sent=sent[name], **got[name]) for name in streams}


def _makers(count: int) -> dict[str, Callable[[int, int], Any]]:
    """Return what makes the message of a stream of a stamp [ns] and a number; packets have `count` events."""
    rng = np.random.default_rng(1)
    pool = [
        (rng.integers(0, WIDTH, count, np.uint16), rng.integers(0, HEIGHT, count, np.uint16),
         np.sort(rng.integers(0, 1000, count)) * (np.arange(count) > 0), rng.integers(0, 2, count, np.uint8))
        for _ in range(32)
    ]  # fmt: skip
    picture = np.full((HEIGHT, WIDTH, 3), 127, np.uint8)

    def events(stamp_ns: int, number: int) -> Events:
        """Return events of the next millisecond: in ROS a packet has the stamp of its first event, now."""
        x, y, t, polarity = pool[number % len(pool)]
        return Events(
            stamp_ns + TICK_NS, x, y, t + stamp_ns // 1000, polarity, WIDTH, HEIGHT, stamp_ns,
            frame_id="bench/events_optical_frame", sequence=number,
        )  # fmt: skip

    return {
        "image": lambda stamp_ns, number: Image(stamp_ns, picture, "rgb8", "bench/rgb_optical_frame", number),
        "events": events,
        "imu": lambda stamp_ns, number: Imu(stamp_ns, np.array([0.0, 0.0, 9.81]), np.zeros(3), number),
    }


def _publish(streams: Sequence[str], load: Load) -> int:
    """Publish at the given rates, and print how many messages of each stream that were."""
    makers, every = _makers(load.events_per_s // 1000), {"image": 1000 // load.image_hz}
    kinds: dict[str, type[Any]] = {"image": Image, "events": Events, "imu": Imu}
    sent = dict.fromkeys(streams, 0)
    with Node("bench") as node:
        publishers = {name: node.publisher(STREAMS[name].topic, kinds[name]) for name in streams}
        for name, publisher in publishers.items():
            if not publisher.wait_for_subscribers(1, MATCH_S):
                raise RuntimeError(f"nobody subscribes to {STREAMS[name].topic}")
        time.sleep(0.5)  # until DDS has matched for good, too
        begin_ns = time.monotonic_ns()
        for tick in range(int(load.seconds * 1e9) // TICK_NS):
            wait_ns = begin_ns + tick * TICK_NS - time.monotonic_ns()
            if wait_ns > 0:
                time.sleep(wait_ns * 1e-9)
            for name, publisher in publishers.items():
                if tick % every.get(name, 1) == 0:
                    publisher.publish(makers[name](time.monotonic_ns(), sent[name]))
                    sent[name] += 1
        time.sleep(1.5)  # until all has arrived, and the bridge has said what it lost
    print(json.dumps(sent), flush=True)
    return 0


def _subscribe(streams: Sequence[str], backend_name: str) -> int:
    """Receive until told to end, and print how much that was and how late."""
    from cortex_ros2_bridge import cdr, diagnostics
    from cortex_ros2_bridge.backend.base import Qos
    from cortex_ros2_bridge.backend.choose import open_backend

    latencies: dict[str, list[int]] = {name: [] for name in streams}
    diagnosed: list[bytes] = []

    def taker(name: str) -> Callable[[bytes], None]:
        append = latencies[name].append

        def take(data: bytes) -> None:
            sec, nanosec = np.frombuffer(data, "<u4", 2, 4).tolist()
            append(time.monotonic_ns() - (sec * 1_000_000_000 + nanosec))

        return take

    backend = open_backend(backend_name, node_name="bench_subscriber")
    try:
        for name in streams:
            stream = STREAMS[name]
            backend.subscription(stream.ros_topic, stream.ros_type, Qos(depth=1000), taker(name))
        backend.subscription(diagnostics.TOPIC, diagnostics.TYPE, Qos(), diagnosed.append)
        sys.stdin.readline()
    finally:
        backend.close()
    # Read only now: what it takes to read them the first time would hold up the streams for 0.2 s.
    lost = {
        status.name.rpartition(" -> ")[2]: int(pair.value)
        for data in diagnosed
        for status in cdr.decode(data, diagnostics.TYPE).status
        for pair in status.values
        if pair.key == "lost"
    }
    found = {}
    for name, values in latencies.items():
        at = np.quantile(values, list(QUANTILES.values())) / 1e6 if values else [np.nan] * len(QUANTILES)
        found[name] = {
            "received": len(values),
            "lost_in_bridge": lost.get(STREAMS[name].ros_topic, 0),
            "latency_ms": dict(zip(QUANTILES, map(float, at), strict=True)),
        }
    print(json.dumps(found), flush=True)
    return 0


@contextlib.contextmanager
def _process(command: Sequence[str], environment: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    """Run a process for the time of the block."""
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, env=environment, stdin=pipe, stdout=pipe, stderr=pipe, text=True)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


def _hear(process: subprocess.Popen[str]) -> dict[str, Any]:
    """Return the next line that a process prints.

    Raises:
        RuntimeError: It has ended without one.
    """
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        assert process.stderr is not None
        lines = process.stderr.read().strip().splitlines() or ["it says nothing"]
        raise RuntimeError(f"a process of the benchmark has ended: {lines[-1]}")
    heard: dict[str, Any] = json.loads(line)
    return heard


if __name__ == "__main__":
    sys.exit(main())
