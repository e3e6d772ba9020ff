"""The backend of rclpy, on a fake one in memory; and on the real one, where there is a ROS installation."""

from __future__ import annotations

import importlib.util
import inspect
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fake_rclpy
import pytest
from processes import SOON_S, wait_for

from cortex_ros2_bridge.backend.base import BackendError, Qos, TopicInfo
from cortex_ros2_bridge.backend.choose import open_backend
from cortex_ros2_bridge.backend.rclpy_ import RclpyBackend
from cortex_ros2_bridge.typestore import typestore

STRING = "std_msgs/msg/String"
TRIGGER = "std_srvs/srv/Trigger"
HAS_RCLPY = importlib.util.find_spec("rclpy") is not None


def text(words: str) -> bytes:
    store = typestore()
    return bytes(store.serialize_cdr(store.types[STRING](data=words), STRING))


@pytest.fixture(params=["fake", "real"])
def make(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Any]]:
    """A function that makes nodes on the fake rclpy, or on the real one where it is installed."""
    if request.param == "fake":
        fake_rclpy.install(monkeypatch)
        monkeypatch.delenv("ROS_DISTRO", raising=False)
    elif not HAS_RCLPY:
        pytest.skip("rclpy is not installed")
    threads = set(threading.enumerate())
    nodes: list[RclpyBackend] = []

    def start(**options: Any) -> RclpyBackend:
        nodes.append(RclpyBackend(domain=91, **options))
        return nodes[-1]

    yield start
    begin_s = time.monotonic()
    for node in nodes:
        node.close()
    assert time.monotonic() - begin_s < 4.9  # each thread that does not end by itself takes five
    wait_for(lambda: not set(threading.enumerate()) - threads)


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    fake_rclpy.install(monkeypatch)
    monkeypatch.delenv("ROS_DISTRO", raising=False)


def test_messages_go_both_ways(make: Any) -> None:
    node, other = make(), make(node_name="other", namespace="sim")
    got: list[bytes] = []
    subscription = other.subscription("/words", STRING, Qos(), got.append)
    publisher = node.publisher("/words", STRING, Qos())
    wait_for(lambda: (publisher.subscriber_count, subscription.publisher_count) == (1, 1))
    for form in (bytes, bytearray, memoryview):
        publisher.publish(form(text("hello")))
    wait_for(lambda: len(got) == 3)
    assert {type(message) for message in got} == {bytes}
    assert all(message.startswith(text("hello")) for message in got)
    assert subscription.lost_count == 0
    subscription.close()
    subscription.close()
    wait_for(lambda: publisher.subscriber_count == 0)
    assert subscription.publisher_count == 0
    publisher.close()
    publisher.close()
    assert publisher.subscriber_count == 0
    with pytest.raises(BackendError, match="publisher of /words is closed"):
        publisher.publish(text("late"))


def test_what_has_waited_comes_in_its_order_and_once(make: Any) -> None:
    """More than is taken in one turn, and beside a topic that is never silent."""
    node, other = make(), make(node_name="other")
    got: dict[str, list[bytes]] = {"/words": [], "/others": []}
    busy, go_on = threading.Event(), threading.Event()

    def callback(message: bytes) -> None:
        busy.set()
        assert go_on.wait(10.0)
        got["/words"].append(message)

    publishers = [node.publisher(topic, STRING, Qos(depth=500)) for topic in got]
    other.subscription("/words", STRING, Qos(depth=500), callback)
    other.subscription("/others", STRING, Qos(depth=500), got["/others"].append)
    wait_for(lambda: all(publisher.subscriber_count == 1 for publisher in publishers))
    words = [text(f"{number:03}") for number in range(200)]
    publishers[0].publish(words[0])
    assert busy.wait(10.0)
    for word in words[1:]:
        publishers[0].publish(word)
        publishers[1].publish(word)
    go_on.set()
    wait_for(lambda: (len(got["/words"]), len(got["/others"])) == (200, 199))
    assert [message[: len(words[0])] for message in got["/words"]] == words


def test_who_comes_late_gets_what_is_latched(make: Any) -> None:
    node, other = make(), make(node_name="other")
    latched = Qos(durability="transient_local", depth=1)
    publisher = node.publisher("/words", STRING, latched)
    for word in "ab":
        publisher.publish(text(word))
    got: list[bytes] = []
    other.subscription("/words", STRING, latched, got.append)
    wait_for(lambda: got)
    assert [message[8:9] for message in got] == [b"b"]


def test_the_quality_of_others_is_seen(make: Any) -> None:
    """Also of a node of the same name, such as another bridge."""
    node, other = make(), make()
    effort, latched = Qos(reliability="best_effort"), Qos(durability="transient_local")
    node.publisher("/words", STRING, Qos())
    other.publisher("/words", STRING, latched)
    other.subscription("/words", STRING, effort, print)
    wait_for(lambda: TopicInfo("/words", STRING, (latched,), (effort,)) in node.topics())


def test_a_callback_that_raises_does_not_end_the_node(make: Any, caplog: pytest.LogCaptureFixture) -> None:
    node, other = make(), make(node_name="other")
    got: list[bytes] = []

    def callback(message: bytes) -> None:
        got.append(message)
        raise ZeroDivisionError("on purpose")

    other.subscription("/words", STRING, Qos(), callback)
    publisher = node.publisher("/words", STRING, Qos())
    wait_for(lambda: publisher.subscriber_count == 1)
    for word in "ab":
        publisher.publish(text(word))
    wait_for(lambda: len(got) == 2)
    assert "the callback of /words failed" in caplog.text
    assert "on purpose" in caplog.text


def test_topics_of_others(make: Any) -> None:
    node, other = make(), make(node_name="other")
    node.publisher("/mine", STRING, Qos())
    node.subscription("/both", STRING, Qos(), print)
    other.publisher("/both", STRING, Qos())
    other.subscription("/mine", STRING, Qos(), print)

    def topics() -> list[TopicInfo]:
        return [topic for topic in node.topics() if topic.type_name == STRING]

    wait_for(
        lambda: (
            topics() == [TopicInfo("/both", STRING, (Qos(),), ()), TopicInfo("/mine", STRING, (), (Qos(),))]
        )
    )
    other.close()
    wait_for(lambda: topics() == [])
    node.close()
    node.close()
    assert node.topics() == []
    with pytest.raises(BackendError, match="closed"):
        node.publisher("/mine", STRING, Qos())


def test_errors(make: Any) -> None:
    node = make()
    with pytest.raises(ValueError, match="invalid ROS name 'words'"):
        node.publisher("words", STRING, Qos())
    with pytest.raises(ValueError, match=r"unknown ROS type 'no_msgs/msg/Thing'.*ros-\$ROS_DISTRO-no-msgs"):
        node.subscription("/words", "no_msgs/msg/Thing", Qos(), print)
    with pytest.raises(ValueError, match="unknown ROS type 'std_msgs/msg/Nothing'"):
        node.publisher("/words", "std_msgs/msg/Nothing", Qos())
    publisher = node.publisher("/words", STRING, Qos())
    for bad in (b"", b"\0\1\0\0", b"\0\0\0\0abcd"):
        with pytest.raises(BackendError, match="not little-endian CDR"):
            publisher.publish(bad)
    with pytest.raises(ValueError, match="invalid ROS name '/a b'"):
        make(node_name="a b")


def test_a_service_answers(fake: None, caplog: pytest.LogCaptureFixture) -> None:
    node, other = RclpyBackend(), RclpyBackend(node_name="other")
    answers = iter([(True, "reset"), (False, "not now")])

    def answer(request: Any, response: Any) -> Any:
        response.success, response.message = next(answers)
        return response

    service = node.service("/drone/reset", TRIGGER, answer)
    replies = [other._loop.node.call("/drone/reset") for _ in range(3)]
    assert [(reply.success, reply.message) for reply in replies] == [
        (True, "reset"),
        (False, "not now"),
        (False, ""),
    ]
    assert "the service /drone/reset failed" in caplog.text
    service.close()
    service.close()
    wait_for(lambda: not any(one.services for one in fake_rclpy.WORLD[0]))
    node.close()
    other.close()


def test_closing_a_service_waits_for_its_answer(fake: None) -> None:
    node, other = RclpyBackend(), RclpyBackend(node_name="other")
    begun, go, ended = threading.Event(), threading.Event(), []

    def serve(request: Any, response: Any) -> Any:
        begun.set()
        assert go.wait(SOON_S)
        ended.append(True)
        return response

    service = node.service("/reset", TRIGGER, serve)
    asking = threading.Thread(target=lambda: other._loop.node.call("/reset"))
    asking.start()
    assert begun.wait(SOON_S)
    threading.Timer(0.05, go.set).start()
    service.close()
    assert ended == [True]
    asking.join(SOON_S)
    node.close()
    other.close()


def test_a_slow_service_does_not_hold_up_messages(fake: None) -> None:
    node, other = RclpyBackend(), RclpyBackend(node_name="other")
    go, got, replies = threading.Event(), [], []

    def serve(request: Any, response: Any) -> Any:
        assert go.wait(SOON_S)
        response.success = True
        return response

    node.service("/reset", TRIGGER, serve)
    node.subscription("/words", STRING, Qos(), got.append)
    asking = threading.Thread(target=lambda: replies.append(other._loop.node.call("/reset")))
    asking.start()
    other.publisher("/words", STRING, Qos()).publish(text("meanwhile"))
    wait_for(lambda: got)
    assert replies == []
    go.set()
    asking.join(SOON_S)
    assert replies[0].success
    node.close()
    other.close()


def test_quality_of_service_reaches_rclpy(fake: None) -> None:
    node = RclpyBackend()
    node.publisher("/a", STRING, Qos(reliability="best_effort", depth=3))
    node.subscription("/b", STRING, Qos(durability="transient_local", depth=7), print)
    first, second = node._loop.node.pubs[0].qos_profile, node._loop.node.subs[0].qos_profile
    assert (first.depth, first.reliability.name, first.durability.name) == (3, "BEST_EFFORT", "VOLATILE")
    assert (second.depth, second.reliability.name, second.durability.name) == (
        7,
        "RELIABLE",
        "TRANSIENT_LOCAL",
    )
    assert {first.history.name, second.history.name} == {"KEEP_LAST"}
    assert node._loop.node.context.args == []  # not those of the command line
    node.close()


def test_the_end_of_the_context_is_told(fake: None, caplog: pytest.LogCaptureFixture) -> None:
    node = RclpyBackend()
    node.publisher("/words", STRING, Qos())
    assert node.failure == ""
    node._loop.node.context.shutdown()
    wait_for(lambda: "the context of rclpy was shut down from outside: nothing is received" in caplog.text)
    assert node.failure == "the context of rclpy was shut down from outside"
    with pytest.raises(BackendError, match="shut down from outside"):
        node.subscription("/words", STRING, Qos(), print)
    node.close()


def test_opening_and_closing_does_not_make_the_node_deaf(make: Any) -> None:
    """From other threads, while messages come: nothing that the executor waits for vanishes under it."""
    node, other = make(), make(node_name="other")
    got: list[bytes] = []
    other.subscription("/words", STRING, Qos(), got.append)
    publisher = node.publisher("/words", STRING, Qos())
    wait_for(lambda: publisher.subscriber_count == 1)

    def cycle() -> None:
        for _ in range(20):
            parts = [other.subscription(f"/more{n}", STRING, Qos(), print) for n in range(3)]
            parts += [other.publisher(f"/some{n}", STRING, Qos()) for n in range(2)]
            parts += [
                other.service(f"/ask_{threading.get_ident()}", TRIGGER, lambda request, response: response)
            ]
            for part in parts:
                part.close()

    threads = [threading.Thread(target=cycle) for _ in range(2)]
    for thread in threads:
        thread.start()
    sent = 0
    while any(thread.is_alive() for thread in threads):
        publisher.publish(text("x"))
        sent += 1
        time.sleep(0.001)
    publisher.publish(text("last"))
    wait_for(lambda: text("last") in [message[: len(text("last"))] for message in got])
    assert other.failure == ""


def test_an_executor_that_fails_is_told(make: Any, caplog: pytest.LogCaptureFixture) -> None:
    """Whatever breaks it: the bridge ends with the reason, and does not go on deaf."""
    node = make()

    def fail() -> None:
        raise ZeroDivisionError("on purpose")

    node._loop.defer(fail)
    wait_for(lambda: node.failure)
    assert node.failure == "the executor of rclpy has failed: ZeroDivisionError: on purpose"
    assert "on purpose: nothing is received any more" in caplog.text
    with pytest.raises(BackendError, match="on purpose"):
        node.subscription("/words", STRING, Qos(), print)


def test_choice(fake: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rclpy where it imports, else DDS; a bag by its name."""
    monkeypatch.setenv("ROS_DISTRO", "humble")
    for kind in ("auto", "rclpy"):
        node = open_backend(kind, node_name="sim", namespace="/a")
        assert (node.name, node.distro) == ("rclpy", "humble")
        assert isinstance(node, RclpyBackend)
        assert (node._loop.node.name, node._loop.node.namespace) == ("sim", "/a")
        node.close()
    for path in ("x.mcap", tmp_path / "y"):
        bag = open_backend(tmp_path / path)
        assert bag.name == "bag"
        bag.close()
    for bad in ("ros", "flight.bag", ""):
        with pytest.raises(ValueError, match="a backend is auto, rclpy, dds or a path"):
            open_backend(bad)


def test_choice_without_ros(dds_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    if HAS_RCLPY:
        monkeypatch.setitem(sys.modules, "rclpy", None)
    node = open_backend("auto", distro="jazzy")
    assert node.name == "dds"
    node.close()
    with pytest.raises(BackendError, match="rclpy cannot be imported: source the setup file"):
        open_backend("rclpy")
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    with pytest.raises(BackendError, match=r"pip install 'cyclonedds.*3\.14 and ARM"):
        open_backend("auto")


@pytest.mark.skipif(not HAS_RCLPY, reason="rclpy is not installed")
def test_the_fake_has_the_parameters_of_the_real_one() -> None:
    import rclpy
    import rclpy.node

    pairs: list[tuple[Any, Any]] = [
        (fake_rclpy.init, rclpy.init),
        (fake_rclpy.create_node, rclpy.create_node),
    ]
    for name in (
        "create_publisher",
        "create_subscription",
        "create_service",
        "count_publishers",
        "create_guard_condition",
    ):
        pairs.append((getattr(fake_rclpy.Node, name), getattr(rclpy.node.Node, name)))
    for ours, theirs in pairs:
        known = inspect.signature(theirs).parameters
        for parameter in inspect.signature(ours).parameters.values():
            assert known[parameter.name].kind == parameter.kind, (ours, parameter)
