"""`cortex-ros2-bridge bench`: what does the bridge cost here; one `name value unit` a line.

For latencies there are three processes: a Cortex publisher, the bridge, and a DDS subscriber. Messages are
stamped when they are published,
so that a latency is everything from `publish` in Cortex to the callback in DDS: both transports, the
conversion, and the bridge. At the end flights of a controller on DDS, and all bars: met or missed.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
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
EVENTS_PER_PACKET = 10_000
TICK_NS = 1_000_000
CONVERSION_MAX_MS = {"convert.events_100k_evt3": 1.0, "convert.events_100k_mono": 1.0}
LATENCY_MAX_MS = {"image": 3.0, "imu": 1.5}
RATIO_MAX = 1.1
"""What the median latencies, conversions and the error of a flight may be."""
MATCH_S = 20.0
"""Longest wait until everybody has found each other [s]."""
PROFILE = "<CycloneDDS><Domain id='any'><General><Interfaces><NetworkInterface name='lo' multicast='false'/>\
</Interfaces><AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>\
<Peers><Peer address='127.0.0.1'/></Peers></Discovery></Domain></CycloneDDS>"
"""Only this machine, unless the environment says otherwise."""


class Stream(NamedTuple):
    """One stream of the benchmark."""

    topic: str
    ros_topic: str
    ros_type: str
    every: int
    """Ticks of a millisecond between two messages."""


STREAMS = {
    "image": Stream("/bench/rgb", "/bench/rgb/image_raw", "sensor_msgs/msg/Image", 10),
    "events": Stream("/bench/events", "/bench/events", "event_camera_msgs/msg/EventPacket", 1),
    "imu": Stream("/bench/imu", "/bench/imu", "sensor_msgs/msg/Imu", 1),
}


@dataclass(frozen=True, kw_only=True)
class Result:
    """What became of one stream."""

    sent: int
    received: int
    lost_in_bridge: int
    """As /diagnostics say; others were lost in DDS."""
    latency_ms: tuple[float, float, float]
    """Median, 99th percentile and maximum [ms]."""


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="cortex-ros2-bridge bench", description="Measure the bridge on this machine."
    )
    parser.add_argument("--seconds", type=float, default=5.0, help="length of each measurement [s]")
    parser.add_argument("--encoding", default="evt3", choices=["evt3", "mono"], help="of the events")
    parser.add_argument(
        "--no-flights", dest="flights", action="store_false", help="leave out flights in a closed loop"
    )
    parser.add_argument("--role", choices=["publish", "subscribe"], help=argparse.SUPPRESS)
    parser.add_argument("--streams", default="", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.seconds <= 0.0:
        parser.error(f"--seconds must be > 0, got {options.seconds:g}")
    if options.role == "publish":
        return _publish(options.streams.split(","), options.seconds)
    if options.role == "subscribe":
        return _subscribe(options.streams.split(","))
    print(f"# {platform.machine()}, {os.cpu_count()} CPUs, Python {platform.python_version()}, "
          f"NumPy {np.__version__}, events as {options.encoding}")  # fmt: skip
    bars = Bars()
    for name, milliseconds in conversions().items():
        print(f"{name} {milliseconds:.3f} ms", flush=True)
        if name in CONVERSION_MAX_MS:
            limit = CONVERSION_MAX_MS[name]
            bars.add(f"{name} <= {limit:g} ms", milliseconds <= limit)
    for streams in (("imu",), ("image", "events"), ("image", "events", "imu")):
        for name, result in end_to_end(streams, seconds=options.seconds, encoding=options.encoding).items():
            title = f"{'+'.join(streams)}.{name}"
            print(f"{title}.received {result.received} of {result.sent} messages")
            print(f"{title}.lost_in_bridge {result.lost_in_bridge} messages")
            for which, value in zip(("median", "p99", "max"), result.latency_ms, strict=True):
                print(f"{title}.latency_{which} {value:.3f} ms", flush=True)
            if len(streams) != 1 or name == "imu":
                bars.add(f"{title}: nothing lost", result.received == result.sent)
            if name in LATENCY_MAX_MS:
                limit = LATENCY_MAX_MS[name]
                bars.add(f"{title}.latency_median <= {limit:g} ms", result.latency_ms[0] <= limit)
    for flight in closed_loops() if options.flights else ():
        title = f"flight.{flight['live_mode']}.{flight['mode']}"
        ratio = flight["rms_m"] / flight["in_process_rms_m"]
        print(f"{title}.error {1e3 * flight['rms_m']:.2f} mm")
        print(f"{title}.error_in_process {1e3 * flight['in_process_rms_m']:.2f} mm", flush=True)
        bars.add(f"{title}.error <= {RATIO_MAX:g} x in process (it is {ratio:.3f} x)", ratio <= RATIO_MAX)
    return bars.tell()


class Bars:
    """What must be reached, and what was."""

    def __init__(self) -> None:
        self._lines: list[tuple[str, bool]] = []

    def add(self, text: str, met: bool) -> None:
        """Note a bar."""
        self._lines.append((text, met))

    def tell(self) -> int:
        """Print all of them; return the exit status: 1 if one was missed."""
        for text, met in self._lines:
            print(f"# {'met   ' if met else 'MISSED'} {text}")
        return 0 if all(met for _, met in self._lines) else 1


def closed_loops() -> Iterator[dict[str, Any]]:
    """Fly with a simulator, if there is one, and a controller that only speaks DDS; yield what came of it."""
    if importlib.util.find_spec("neurosim_core") is None:
        print("# no flights: neurosim_core is not installed")
        return
    flights = subprocess.run(
        [sys.executable, "-m", "neurosim_core.bench.bridge_flight"],
        capture_output=True,
        text=True,
        check=False,
    )
    yield from (json.loads(line) for line in flights.stdout.splitlines() if line.startswith("{"))
    if flights.returncode:
        raise RuntimeError(f"the flights have failed: {flights.stderr.strip().splitlines()[-1]}")


def conversions(repeats: int = 30) -> dict[str, float]:
    """Return the median time of each conversion to CDR, by name [ms]."""
    from cortex_ros2_bridge import convert
    from cortex_ros2_bridge.frames import FrameNames

    rng = np.random.default_rng(0)
    events = make_events(rng, 100_000, stamp_ns=10_000_000)
    found = {}
    for name, message, ros_type, options in (
        ("convert.events_100k_mono", events, "event_camera_msgs/msg/EventPacket", {"encoding": "mono"}),
        ("convert.events_100k_evt3", events, "event_camera_msgs/msg/EventPacket", {"encoding": "evt3"}),
        ("convert.events_100k_dvs", events, "dvs_msgs/msg/EventArray", {}),
        ("convert.events_100k_image", events, "sensor_msgs/msg/Image", {}),
        ("convert.image_vga_rgb8", make_image(0), "sensor_msgs/msg/Image", {}),
        ("convert.imu", make_imu(0), "sensor_msgs/msg/Imu", {}),
    ):
        context = convert.Context(frames=FrameNames(), vehicle="bench", frame_id="bench", options=options)
        function: Callable[[Any, Any], Any] = convert.OUT[type(message), ros_type]
        function(message, context)
        times = []
        for _ in range(repeats):
            begin_ns = time.perf_counter_ns()
            function(message, context)
            times.append(time.perf_counter_ns() - begin_ns)
        found[name] = float(np.median(times)) / 1e6
    return found


def end_to_end(streams: Sequence[str], *, seconds: float, encoding: str = "evt3") -> dict[str, Result]:
    """Send streams through a bridge, all at once.

    Args:
        streams: Names of `STREAMS`.
        seconds: For how long [s].
        encoding: Of the events.

    Returns:
        What became of each.

    Raises:
        RuntimeError: A process ended early, or they did not find each other.
    """
    with tempfile.TemporaryDirectory(prefix="ctx-") as folder:
        settings = {"routes": [{"cortex": STREAMS["events"].topic, "type": STREAMS["events"].ros_type,
                                "options": {"encoding": encoding}}]}  # fmt: skip
        config = Path(folder, "bridge.yaml")
        config.write_text(yaml.safe_dump(settings), encoding="utf-8")
        environment = {
            **os.environ,
            "CORTEX_RUNTIME_DIR": folder,
            "ROS_DOMAIN_ID": str(1 + secrets.randbelow(100)),
            "CYCLONEDDS_URI": os.environ.get("CYCLONEDDS_URI", PROFILE),
        }
        names = ",".join(streams)
        command = [sys.executable, "-m", "cortex_ros2_bridge"]
        with (
            _process([*command, "--backend", "dds", "--config", str(config)], environment),
            _process(
                [*command, "bench", "--role", "subscribe", "--streams", names], environment
            ) as subscriber,
            _process(
                [*command, "bench", "--role", "publish", "--streams", names, "--seconds", str(seconds)],
                environment,
            ) as publisher,
        ):
            sent = _hear(publisher)
            print("end", file=subscriber.stdin, flush=True)
            got = _hear(subscriber)
    return {name: Result(sent=sent[name], **got[name]) for name in streams}


def make_events(rng: np.random.Generator, count: int, *, stamp_ns: int) -> Events:
    """Return events at random places, evenly spread over the millisecond before a stamp."""
    t = stamp_ns // 1000 - 1000 + np.sort(rng.integers(0, 1000, count))
    t[0] = stamp_ns // 1000 - 1000
    return Events(
        stamp_ns=stamp_ns,
        x=rng.integers(0, WIDTH, count, dtype=np.uint16),
        y=rng.integers(0, HEIGHT, count, dtype=np.uint16),
        t=t,
        polarity=rng.integers(0, 2, count, dtype=np.uint8),
        width=WIDTH,
        height=HEIGHT,
        start_ns=stamp_ns - TICK_NS,
        frame_id="bench/events_optical_frame",
    )


def make_image(stamp_ns: int) -> Image:
    """Return a picture."""
    data = np.full((HEIGHT, WIDTH, 3), 127, np.uint8)
    return Image(stamp_ns=stamp_ns, data=data, encoding="rgb8", frame_id="bench/rgb_optical_frame")


def make_imu(stamp_ns: int) -> Imu:
    """Return a measurement at rest."""
    return Imu(stamp_ns=stamp_ns, specific_force=np.array([0.0, 0.0, 9.81]), angular_rate=np.zeros(3))


def _publish(streams: Sequence[str], seconds: float) -> int:
    """Publish at the given rates, and print how many messages of each stream that were."""
    rng = np.random.default_rng(1)
    pool = [make_events(rng, EVENTS_PER_PACKET, stamp_ns=TICK_NS) for _ in range(32)]
    picture = make_image(0)
    kinds: dict[str, type[Any]] = {"image": Image, "events": Events, "imu": Imu}

    def events(stamp_ns: int, number: int) -> Events:
        of = pool[number % len(pool)]
        stamp_ns += TICK_NS  # a packet is stamped with its first event in ROS: that one is now
        return Events(
            stamp_ns, of.x, of.y, of.t + (stamp_ns - TICK_NS) // 1000, of.polarity, WIDTH, HEIGHT,
            stamp_ns - TICK_NS, 0, of.frame_id, number,
        )  # fmt: skip

    def image(stamp_ns: int, number: int) -> Image:
        return Image(stamp_ns, picture.data, "rgb8", picture.frame_id, number)

    def imu(stamp_ns: int, number: int) -> Imu:
        return Imu(stamp_ns, np.array([0.0, 0.0, 9.81]), np.zeros(3), number)

    makers: dict[str, Callable[[int, int], Any]] = {"image": image, "events": events, "imu": imu}
    sent = dict.fromkeys(streams, 0)
    with Node("bench") as node:
        publishers = {name: node.publisher(STREAMS[name].topic, kinds[name]) for name in streams}
        for name, publisher in publishers.items():
            if not publisher.wait_for_subscribers(1, MATCH_S):
                raise RuntimeError(f"nobody subscribes to {STREAMS[name].topic}")
        time.sleep(0.5)  # until DDS has matched for good, too
        begin_ns = time.monotonic_ns()
        for tick in range(int(seconds * 1e9) // TICK_NS):
            wait_ns = begin_ns + tick * TICK_NS - time.monotonic_ns()
            if wait_ns > 0:
                time.sleep(wait_ns * 1e-9)
            for name, publisher in publishers.items():
                if tick % STREAMS[name].every == 0:
                    publisher.publish(makers[name](time.monotonic_ns(), sent[name]))
                    sent[name] += 1
        time.sleep(1.5)  # until all has arrived, and the bridge has said what it lost
    print(json.dumps(sent), flush=True)
    return 0


def _subscribe(streams: Sequence[str]) -> int:
    """Receive until told to end, and print how much that was and how late."""
    from cortex_ros2_bridge import cdr, diagnostics
    from cortex_ros2_bridge.backend.base import Qos
    from cortex_ros2_bridge.backend.choose import open_backend

    latencies: dict[str, list[int]] = {name: [] for name in streams}
    lost = dict.fromkeys(streams, 0)

    def take_diagnostics(data: bytes) -> None:
        for status in cdr.decode(data, diagnostics.TYPE).status:
            for name in streams:
                if status.name.endswith(f"-> {STREAMS[name].ros_topic}"):
                    lost[name] = int({pair.key: pair.value for pair in status.values}["lost"])

    def taker(name: str) -> Callable[[bytes], None]:
        append = latencies[name].append

        def take(data: bytes) -> None:
            sec, nanosec = np.frombuffer(data, "<u4", 2, 4).tolist()
            append(time.monotonic_ns() - (sec * 1_000_000_000 + nanosec))

        return take

    backend = open_backend("dds", node_name="bench_subscriber")
    try:
        for name in streams:
            stream = STREAMS[name]
            backend.subscription(stream.ros_topic, stream.ros_type, Qos(depth=1000), taker(name))
        backend.subscription(diagnostics.TOPIC, diagnostics.TYPE, Qos(), take_diagnostics)
        sys.stdin.readline()
    finally:
        backend.close()
    found = {}
    for name, values in latencies.items():
        quantiles = np.quantile(values, (0.5, 0.99, 1.0)) / 1e6 if values else np.full(3, np.nan)
        found[name] = {
            "received": len(values),
            "lost_in_bridge": lost[name],
            "latency_ms": quantiles.tolist(),
        }
    print(json.dumps(found), flush=True)
    return 0


@contextlib.contextmanager
def _process(command: Sequence[str], environment: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    """Run a process for the time of the block."""
    process = subprocess.Popen(
        command,
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
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
