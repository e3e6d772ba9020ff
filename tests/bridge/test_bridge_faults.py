"""What goes wrong between processes: nothing stalls, nothing grows, and what is lost is counted."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from bridge_process import BridgeProcess
from bridge_rig import image, imu, odometry
from foreigners import Foreigner
from processes import SOON_S, wait_for
from runtime_directory import own_directory

from cortex import Node
from cortex import messages as msg
from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.backend.base import Qos
from cortex_ros2_bridge.backend.dds import DdsBackend
from cortex_ros2_bridge.msgs import message_class

STALL_S = 10.0
"""A machine that does a lot besides may hold up a call for so long; a bridge that blocks would for ever."""


@pytest.fixture(scope="module", autouse=True)
def one_registry() -> Iterator[None]:
    """All tests of this module share a runtime directory, and a registry that is in no test's DDS domain."""
    with (
        pytest.MonkeyPatch.context() as monkeypatch,
        own_directory(monkeypatch),
        Node("first") as node,
    ):
        assert node.wait_for_registry()
        yield


@pytest.fixture
def ros(dds_domain: int) -> Iterator[DdsBackend]:
    """A node on the ROS side."""
    backend = DdsBackend(distro="jazzy", node_name="tester")
    yield backend
    backend.close()


@pytest.fixture
def start(ros: DdsBackend) -> Iterator[Callable[..., BridgeProcess]]:
    """A function that starts bridges, which end with the test."""
    started: list[BridgeProcess] = []

    def begin(*arguments: str) -> BridgeProcess:
        started.append(BridgeProcess("--verbose", "--backend", "dds", "--distro", "jazzy", *arguments))
        return started[-1]

    yield begin
    for bridge in started:
        bridge.__exit__()


class Listener:
    """A ROS subscription that keeps what comes."""

    def __init__(self, ros: DdsBackend, topic: str, type_name: str, depth: int = 100) -> None:
        self.type_name = type_name
        self.received: list[bytes] = []
        self.subscription = ros.subscription(topic, type_name, Qos(depth=depth), self.received.append)

    def last(self) -> Any:
        return cdr.decode(self.received[-1], self.type_name) if self.received else None


class Ticker:
    """A simulator's side: publishes in a thread, as fast as an IMU, and notes how long that took."""

    def __init__(self, publisher: Any, make: Callable[[int], Any], period_s: float = 2e-3) -> None:
        self.publisher, self.make, self.period_s = publisher, make, period_s
        self.longest_s = 0.0
        self.count = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ticker")

    def _run(self) -> None:
        while not self._stop.wait(self.period_s):
            self.count += 1
            begin_s = time.monotonic()
            self.publisher.publish(self.make(self.count))
            self.longest_s = max(self.longest_s, time.monotonic() - begin_s)

    def __enter__(self) -> Ticker:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


def diagnostics(listener: Listener) -> dict[str, dict[str, str]]:
    """Values of the newest diagnostics, by route."""
    message = listener.last()
    if message is None:
        return {}
    return {s.name.partition(": ")[2]: {v.key: v.value for v in s.values} for s in message.status}


def test_a_bridge_that_is_killed_is_replaced_by_the_next(ros, start):
    """Publisher and subscriber stay as they are; both directions work again."""
    heard = Listener(ros, "/drone/imu", "sensor_msgs/msg/Imu")
    command = message_class("actuator_msgs/msg/Actuators")(velocity=[1.0, 2.0])
    commands = ros.publisher("/drone/actuators", "actuator_msgs/msg/Actuators", Qos())
    with Node("simulator") as node:
        inbox = node.subscriber("/drone/command/motor_speeds", msg.MotorCommand)
        with Ticker(node.publisher("/drone/imu", msg.Imu), imu) as ticker:
            for _ in range(2):
                bridge = start()
                wait_for(lambda: heard.received)
                wait_for(lambda: arrives(commands, command, inbox))
                bridge.kill()
                heard.received.clear()
                while arrived(inbox):
                    pass
            assert ticker.longest_s < STALL_S


def arrived(inbox: Any, timeout_s: float = 0.0) -> bool:
    """Whether a command arrives in Cortex."""
    try:
        inbox.recv(timeout_s)
    except TimeoutError:
        return False
    return True


def arrives(commands: Any, command: Any, inbox: Any) -> bool:
    """Whether a command that is published in ROS arrives in Cortex."""
    commands.publish(cdr.encode(command))
    return arrived(inbox, 0.1)


def test_a_simulator_that_is_restarted_finds_the_bridge_as_it_was(ros, start):
    """The bridge, and what ROS subscribed to, stay; time begins at 0 again, as for commands."""
    heard = Listener(ros, "/drone/odometry", "nav_msgs/msg/Odometry")
    commands = ros.publisher("/drone/actuators", "actuator_msgs/msg/Actuators", Qos())
    bridge = start()
    for run in range(2):
        with Node("simulator") as node:
            inbox = node.subscriber("/drone/command/motor_speeds", msg.MotorCommand)
            state = node.publisher("/drone/odometry", msg.Odometry, latch=True)
            state.publish(odometry(0))
            wait_for(lambda: heard.received)
            assert heard.last().header.stamp.sec == 0
            assert inbox.wait_for_publisher(SOON_S)
            wait_for(lambda: commands.subscriber_count == 1)
            command = message_class("actuator_msgs/msg/Actuators")(velocity=[float(run)])
            commands.publish(cdr.encode(command))
            assert inbox.recv(SOON_S).speed[0] == run
            state.publish(odometry(100_000_000_000))
            wait_for(lambda: heard.last().header.stamp.sec == 100)
            assert heard.subscription.publisher_count == 1
        if run == 0:
            wait_for(lambda: "Cortex side has gone" in bridge.said or bridge.hear())
        heard.received.clear()  # nothing of the old run comes any more


def test_a_stopped_subscriber_holds_nobody_up(ros, start, foreigner):
    """Another subscriber gets its images on time, the bridge does not grow, the stopped one comes back."""
    bridge = start()
    with Node("simulator") as node:
        sent = node.publisher("/drone/rgb", msg.Image)
        bridge.wait_for("/drone/rgb/image_raw")
        other: Foreigner = foreigner()
        assert other.do("subscribe", topic="rt/drone/rgb/image_raw", kind="Image", depth=2) == 1
        heard = Listener(ros, "/drone/rgb/image_raw", "sensor_msgs/msg/Image", depth=5)
        picture = image(0, width=640, height=480)
        with Ticker(sent, lambda n: msg.Image(n, picture.data, "rgb8"), 10e-3) as ticker:
            wait_for(lambda: len(heard.received) > 10)
            assert other.do("collect", topic="rt/drone/rgb/image_raw", count=2)
            with other.stopped():
                heard.received.clear()
                before = bridge.resident_bytes
                wait_for(lambda: len(heard.received) > 100)
                assert bridge.resident_bytes - before < 50_000_000  # 100 images are 92 MB
            assert other.do("collect", topic="rt/drone/rgb/image_raw", count=2)
            assert ticker.longest_s < STALL_S


def test_a_subscriber_that_is_killed_is_not_served_any_more(short_lease, ros, start, foreigner):
    """DDS misses it after its lease; then the sensor is off again."""
    bridge = start()
    with Node("simulator") as node:
        sent = node.publisher("/drone/rgb", msg.Image)
        bridge.wait_for("/drone/rgb/image_raw")
        other = foreigner()
        other.do("subscribe", topic="rt/drone/rgb/image_raw", kind="Image")
        wait_for(lambda: sent.subscriber_count == 1)
        other.kill()
        wait_for(lambda: sent.subscriber_count == 0)


def test_a_flood_of_events_neither_stalls_nor_grows_and_is_accounted_for(ros, start):
    """200 packets of 100,000 events at once: 20 M events. What did not get through is in /diagnostics."""
    bridge = start()
    heard = Listener(ros, "/drone/events", "event_camera_msgs/msg/EventPacket")
    health = Listener(ros, "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    count, packets = 100_000, 200
    rng = np.random.default_rng(0)
    columns = {
        "x": rng.integers(0, 640, count, dtype=np.uint16),
        "y": rng.integers(0, 480, count, dtype=np.uint16),
        "polarity": rng.integers(0, 2, count, dtype=np.uint8),
    }
    t = np.sort(rng.integers(0, 10_000, count))

    def packet(n: int) -> msg.Events:
        return msg.Events(
            stamp_ns=10_000_000 * (n + 1), t=t + 10_000 * n, width=640, height=480, sequence=n, **columns
        )

    with Node("simulator") as node:
        sent = node.publisher("/drone/events", msg.Events)
        wait_for(lambda: sent.subscriber_count == 1)
        longest_s = 0.0
        for n in range(packets):
            begin_s = time.monotonic()
            sent.publish(packet(n))
            longest_s = max(longest_s, time.monotonic() - begin_s)
            peak = bridge.resident_bytes if n else 0
        wait_for(lambda: accounted(health, packets))
        assert int(diagnostics(health)["/drone/events -> /drone/events"]["refused"]) == 0
        assert longest_s < STALL_S
        assert max(peak, bridge.resident_bytes) < 700_000_000  # 128 packets of 1.3 MB may wait
        sent.publish(packet(packets))
        wait_for(lambda: heard.last() is not None and heard.last().seq == packets)


def accounted(health: Listener, count: int) -> bool:
    """Return whether all packets were received, and each was sent or lost: the last one may be in flight."""
    values = diagnostics(health).get("/drone/events -> /drone/events", {})
    received, sent, lost = (int(values.get(name, 0)) for name in ("received", "sent", "lost"))
    return received == sent + lost == count


def test_noise_on_a_command_topic_is_refused_and_the_next_command_flies(ros, start):
    """Numbers that are not finite, over real DDS; the refusal is on /diagnostics."""
    start()
    health = Listener(ros, "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    commands = ros.publisher("/drone/actuators", "actuator_msgs/msg/Actuators", Qos())
    with Node("simulator") as node:
        inbox = node.subscriber("/drone/command/motor_speeds", msg.MotorCommand)
        wait_for(lambda: commands.subscriber_count == 1 and inbox.publisher_count == 1)
        actuators = message_class("actuator_msgs/msg/Actuators")
        route = "/drone/command/motor_speeds <- /drone/actuators"
        # We know the bridge; until it knows us, what we send is lost.
        wait_for(lambda: diagnostics(health).get(route, {}).get("listeners") == "1")
        commands.publish(cdr.encode(actuators(velocity=[float("nan")])))
        wait_for(lambda: diagnostics(health).get(route, {}).get("refused") == "1")
        commands.publish(cdr.encode(actuators(velocity=[7.0])))
        assert inbox.recv(SOON_S).speed[0] == 7.0
        wait_for(lambda: diagnostics(health)[route]["sent"] == "1")
