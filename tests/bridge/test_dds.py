"""The backend that speaks DDS: bytes to and from real processes that do not have our code."""

from __future__ import annotations

import logging
import re
import resource
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from foreigners import Foreigner
from processes import SOON_S, wait_for

from cortex_ros2_bridge.backend.base import BackendError, Qos, TopicInfo
from cortex_ros2_bridge.backend.dds import DdsBackend, _Part
from cortex_ros2_bridge.typestore import typestore

PRIMITIVES = (
    *("Bool", "Byte", "Char", "Float32", "Float64"),
    *("Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32", "UInt64"),
)
IMAGE = "sensor_msgs/msg/Image"
TRIGGER = "std_srvs/srv/Trigger"
STRING = "std_msgs/msg/String"
SOME = np.arange(1001, dtype=np.uint32).astype(np.uint8)  # odd: CDR is padded
LARGE = np.tile(np.arange(256, dtype=np.uint8), 3600)  # 0.9 MB
Start = Callable[..., Foreigner]


@pytest.fixture
def backend(dds_domain: int) -> Iterator[DdsBackend]:
    node = DdsBackend(distro="jazzy")
    yield node
    node.close()


def image(data: np.ndarray[Any, Any] = SOME, second: int = 1) -> bytes:
    """CDR of an image."""
    store = typestore()
    kind = store.types
    header = kind["std_msgs/msg/Header"](
        stamp=kind["builtin_interfaces/msg/Time"](sec=second, nanosec=2), frame_id="lens"
    )
    message = kind[IMAGE](
        header=header, height=1, width=data.size, encoding="mono8", is_bigendian=0, step=data.size, data=data
    )
    return bytes(store.serialize_cdr(message, IMAGE))


def text(words: str) -> bytes:
    """CDR of a string."""
    store = typestore()
    return bytes(store.serialize_cdr(store.types[STRING](data=words), STRING))


def seen_of(data: np.ndarray[Any, Any], second: int = 1) -> list[Any]:
    """What a foreigner says of an image."""
    return [second, "lens", "mono8", data.size, zlib.crc32(data.tobytes())]


def test_bytes_reach_a_foreign_subscriber(dds_domain: int, foreigner: Start) -> None:
    with_close = DdsBackend(distro="jazzy")
    try:
        publisher = with_close.publisher("/lens/image", IMAGE, Qos())
        assert publisher.subscriber_count == 0
        other = foreigner()
        assert other.do("subscribe", topic="rt/lens/image", kind="Image") == 1
        wait_for(lambda: publisher.subscriber_count == 1)
        for second, form in enumerate((bytes, bytearray, memoryview)):
            publisher.publish(form(image(second=second)))
        got = other.do("collect", topic="rt/lens/image", count=3)
        assert got == [seen_of(SOME, second) for second in range(3)]
    finally:
        with_close.close()


def test_bytes_arrive_from_a_foreign_publisher(dds_domain: int, foreigner: Start) -> None:
    """What the foreign serialiser writes is what rosbags writes, padded to whole words."""
    node = DdsBackend(distro="jazzy")
    try:
        got: list[bytes] = []
        subscription = node.subscription("/lens/image", IMAGE, Qos(), got.append)
        assert subscription.publisher_count == 0
        other = foreigner()
        assert other.do("advertise", topic="rt/lens/image", kind="Image") == 1
        wait_for(lambda: subscription.publisher_count == 1)
        other.do("publish", topic="rt/lens/image", data=SOME.tolist())
        wait_for(lambda: got)
        expected = image()
        assert got == [expected + bytes(-len(expected) % 4)]
        assert subscription.lost_count == 0
    finally:
        node.close()


def test_the_end_of_a_publisher_is_no_message(dds_domain: int, foreigner: Start) -> None:
    node = DdsBackend(distro="jazzy")
    try:
        got: list[bytes] = []
        subscription = node.subscription("/words", STRING, Qos(), got.append)
        other = foreigner()
        for word in "ab":
            other.do("advertise", topic="rt/words", kind="String")
            other.do("publish", topic="rt/words", data=word)
            other.do("retract", topic="rt/words")
            wait_for(lambda: subscription.publisher_count == 0)
        wait_for(lambda: len(got) == 2)
        assert [message[8:9] for message in got] == [b"a", b"b"]
    finally:
        node.close()


@pytest.mark.parametrize(
    "message", [b"", b"\0\1\0\0", image()[:20], image()[:-1000], image()[:4] + b"\xff" * 40]
)
def test_a_malformed_message_is_refused(dds_domain: int, message: bytes) -> None:
    node = DdsBackend(distro="jazzy")
    try:
        got: list[bytes] = []
        node.subscription("/lens/image", IMAGE, Qos(), got.append)
        publisher = node.publisher("/lens/image", IMAGE, Qos())
        with pytest.raises(BackendError, match=r"/lens/image \(sensor_msgs/msg/Image\) cannot be sent"):
            publisher.publish(message)
        publisher.publish(image())
        wait_for(lambda: got)
        assert len(got) == 1
    finally:
        node.close()


def test_names_and_types_are_checked(backend: DdsBackend) -> None:
    for name in ("image", "/a//b", "/a/", "/1a", "/a-b", "/a__b", "", "/a b"):
        with pytest.raises(ValueError, match="invalid ROS name"):
            backend.publisher(name, IMAGE, Qos())
        with pytest.raises(ValueError, match="invalid ROS name"):
            backend.subscription(name, IMAGE, Qos(), print)
        with pytest.raises(ValueError, match="invalid ROS name"):
            backend.service(name, TRIGGER, print)
    with pytest.raises(ValueError, match=r"sensor_msgs/msg/Imagee.*jazzy"):
        backend.publisher("/image", "sensor_msgs/msg/Imagee", Qos())
    with pytest.raises(ValueError, match="invalid ROS name"):
        DdsBackend(node_name="my node")
    with pytest.raises(ValueError, match="unknown ROS distribution 'foxy'"):
        DdsBackend(distro="foxy")


def test_every_type_of_the_distributions_can_be_published(backend: DdsBackend) -> None:
    """DDS takes the types that we make from definitions, all of them."""
    from cortex_ros2_bridge.backend.idl import idl_struct

    for distro in ("humble", "jazzy"):
        for number, type_name in enumerate(sorted(typestore(distro).fielddefs)):
            if type_name.split("/")[0] in (
                "sensor_msgs",
                "nav_msgs",
                "tf2_msgs",
                "actuator_msgs",
                "mavros_msgs",
            ):
                kind = idl_struct(type_name, distro)
                _Part(backend)._make("writer", f"rt/{distro}{number}", kind, Qos(), b"")
            else:
                idl_struct(type_name, distro)


PACKAGES = {
    "DiagnosticStatus": "diagnostic_msgs",
    "PoseWithCovariance": "geometry_msgs",
    "Actuators": "actuator_msgs",
    "Image": "sensor_msgs",
}


def test_each_kind_of_field_is_that_of_hand_written_types(backend: DdsBackend, foreigner: Start) -> None:
    """A node that compares the types does not hear what is declared otherwise: a byte is an octet."""
    publishers = {}
    for kind in [*PRIMITIVES, "String", *PACKAGES]:
        type_name = f"{PACKAGES.get(kind, 'std_msgs')}/msg/{kind}"
        publishers[kind] = backend.publisher(f"/kinds/{kind}", type_name, Qos())
    other = foreigner()
    for kind in publishers:
        other.do("subscribe", topic=f"rt/kinds/{kind}", kind=kind, matched=False)
    silent = set(publishers)

    def all_match() -> bool:
        silent.intersection_update(kind for kind, one in publishers.items() if not one.subscriber_count)
        return not silent

    try:
        wait_for(all_match)
    finally:
        assert not silent


def test_reliable_messages_all_arrive_in_order(backend: DdsBackend, foreigner: Start) -> None:
    publisher = backend.publisher("/words", STRING, Qos(depth=500))
    other = foreigner()
    other.do("subscribe", topic="rt/words", kind="String", depth=500)
    wait_for(lambda: publisher.subscriber_count == 1)
    words = [f"word {number}" for number in range(500)]
    for word in words:
        publisher.publish(text(word))
    assert other.do("collect", topic="rt/words", count=500) == words


def test_reliability_is_matched_as_ros_does(backend: DdsBackend, foreigner: Start) -> None:
    """A reliable publisher serves both; one of best effort has no reliable subscriber, which is seen."""
    reliable = backend.publisher("/reliable", STRING, Qos())
    effort = backend.publisher("/effort", STRING, Qos(reliability="best_effort"))
    other = foreigner()
    assert other.do("subscribe", topic="rt/reliable", kind="String", reliable=False) == 1
    assert other.do("subscribe", topic="rt/effort", kind="String", reliable=False) == 1
    wait_for(lambda: (reliable.subscriber_count, effort.subscriber_count) == (1, 1))
    other.do("subscribe", topic="rt/effort", kind="String", reliable=True, matched=False)
    wait_for(lambda: any(Qos() in each.subscribers for each in backend.topics() if each.topic == "/effort"))
    assert effort.subscriber_count <= 1
    reliable.publish(text("a"))
    assert other.do("collect", topic="rt/reliable", count=1) == ["a"]


def test_who_comes_late_gets_what_is_latched(backend: DdsBackend, foreigner: Start) -> None:
    latched = backend.publisher("/latched", STRING, Qos(durability="transient_local", depth=2))
    fleeting = backend.publisher("/fleeting", STRING, Qos(depth=2))
    for publisher in (latched, fleeting):
        for word in "abc":
            publisher.publish(text(word))
    other = foreigner()
    other.do("subscribe", topic="rt/latched", kind="String", durable=True)
    other.do("subscribe", topic="rt/fleeting", kind="String")
    wait_for(lambda: fleeting.subscriber_count == 1)
    assert other.do("collect", topic="rt/latched", count=2) == ["b", "c"]
    fleeting.publish(text("d"))
    assert other.do("collect", topic="rt/fleeting", count=1) == ["d"]


def test_what_others_latched_arrives_late_too(backend: DdsBackend, foreigner: Start) -> None:
    other = foreigner()
    other.do("advertise", topic="rt/latched", kind="String", durable=True, depth=1, matched=False)
    for word in "ab":
        other.do("publish", topic="rt/latched", data=word)
    got: list[bytes] = []
    backend.subscription("/latched", STRING, Qos(durability="transient_local", depth=1), got.append)
    wait_for(lambda: got)
    assert [message.rstrip(b"\0")[-1:] for message in got] == [b"b"]


def test_a_killed_peer_is_forgotten(short_lease: None, backend: DdsBackend, foreigner: Start) -> None:
    publisher = backend.publisher("/words", STRING, Qos())
    subscription = backend.subscription("/answers", STRING, Qos(), print)
    other = foreigner()
    other.do("subscribe", topic="rt/words", kind="String")
    other.do("advertise", topic="rt/answers", kind="String")
    wait_for(lambda: (publisher.subscriber_count, subscription.publisher_count) == (1, 1))
    wait_for(lambda: len(backend.topics()) == 2)
    other.kill()
    wait_for(lambda: (publisher.subscriber_count, subscription.publisher_count) == (0, 0))
    wait_for(lambda: backend.topics() == [])
    publisher.publish(text("to nobody"))
    again = foreigner()
    again.do("subscribe", topic="rt/words", kind="String")
    wait_for(lambda: publisher.subscriber_count == 1)
    publisher.publish(text("hello"))
    assert again.do("collect", topic="rt/words", count=1) == ["hello"]


def test_a_killed_peer_does_not_hold_up_the_end(backend: DdsBackend, foreigner: Start) -> None:
    other = foreigner()
    publishers = [backend.publisher(f"/words{number}", STRING, Qos()) for number in range(12)]
    for number in range(12):
        other.do("subscribe", topic=f"rt/words{number}", kind="String")
    wait_for(lambda: all(publisher.subscriber_count for publisher in publishers))
    other.kill()
    for publisher in publishers:
        publisher.publish(text("to nobody"))
    begin_s = time.monotonic()
    backend.close()
    assert time.monotonic() - begin_s < 10.0  # by default Cyclone DDS waits for a second for each


def test_a_stopped_subscriber_holds_up_nobody(backend: DdsBackend, foreigner: Start) -> None:
    """Writes stay quick, the other subscriber gets everything, memory stays bounded by the depth."""
    publisher = backend.publisher("/lens/image", IMAGE, Qos(depth=5))
    stopped, other = foreigner(), foreigner()
    for process in (stopped, other):
        process.do("subscribe", topic="rt/lens/image", kind="Image", depth=5)
    wait_for(lambda: publisher.subscriber_count == 2)
    messages = [image(LARGE, second) for second in range(4)]
    slow_count = 0
    with stopped.stopped():
        used_kb = 0
        for number in range(60):
            begin_s = time.monotonic()
            publisher.publish(messages[number % 4])
            slow_count += time.monotonic() - begin_s > 0.09
            if number == 20:
                used_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            if number % 4 == 3:
                got = other.do("collect", topic="rt/lens/image", count=4)
                assert got == [seen_of(LARGE, second) for second in range(4)]
        grown_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - used_kb
    assert slow_count < 10  # a writer of DDS that waits for it would wait 0.1 s, each of 60 times
    assert grown_kb < 10_000  # 40 messages of 0.9 MB
    wait_for(lambda: publisher.subscriber_count == 2)
    publisher.publish(image(SOME, 9))
    assert stopped.do("collect", topic="rt/lens/image", count=1)


def test_a_stopped_subscription_goes_on_with_the_newest(backend: DdsBackend, foreigner: Start) -> None:
    """As many as its depth wait for it; what they have pushed out is no error."""
    publisher = backend.publisher("/words", STRING, Qos(depth=10))
    other = foreigner()
    other.do("listen", topic="/words", type_name=STRING, depth=3)
    wait_for(lambda: publisher.subscriber_count == 1)
    with other.stopped():
        for number in range(2000):
            publisher.publish(text(f"{number} " + "x" * 1000))
        publisher.publish(text("last"))
    lengths = wait_for(lambda: [found for found in [other.do("heard")] if found["lengths"][-1:] == [16]])
    assert len(lengths[0]["lengths"]) <= 2001


def test_a_writer_of_another_type_is_not_heard(backend: DdsBackend, foreigner: Start) -> None:
    """Neither one that says so, nor one whose messages of this name are others."""
    got: list[bytes] = []
    image_subscription = backend.subscription("/a", IMAGE, Qos(), got.append)
    text_subscription = backend.subscription("/b", STRING, Qos(), got.append)
    other = foreigner()
    other.do("advertise", topic="rt/a", kind="String", matched=False)
    other.do("advertise", topic="rt/b", kind="Impostor", matched=False)
    wait_for(
        lambda: (
            backend.topics() == [TopicInfo("/a", STRING, (Qos(),), ()), TopicInfo("/b", STRING, (Qos(),), ())]
        )
    )
    other.do("publish", topic="rt/a", data="no image")
    other.do("publish", topic="rt/b", number=1.5)
    honest = foreigner()
    honest.do("advertise", topic="rt/b", kind="String")
    honest.do("publish", topic="rt/b", data="good")
    honest.do("advertise", topic="rt/a", kind="String", matched=False)
    wait_for(lambda: backend.topics()[0] == TopicInfo("/a", STRING, (Qos(), Qos()), ()))
    wait_for(lambda: got)
    assert got == [text("good") + bytes(-len(text("good")) % 4)]
    assert image_subscription.publisher_count == 0
    assert text_subscription.publisher_count == 1


def test_a_callback_that_raises_is_told_and_goes_on(
    backend: DdsBackend, caplog: pytest.LogCaptureFixture
) -> None:
    got: list[bytes] = []

    def callback(message: bytes) -> None:
        got.append(message)
        if len(got) <= 3:
            raise ZeroDivisionError("on purpose")

    backend.subscription("/words", STRING, Qos(), callback)
    publisher = backend.publisher("/words", STRING, Qos())
    for word in "abcd":
        publisher.publish(text(word))
    wait_for(lambda: len(got) == 4)
    assert "the callback of /words failed" in caplog.text
    assert "on purpose" in caplog.text
    assert sum("failed" in record.message for record in caplog.records) == 1  # once per second


def test_a_busy_callback_holds_up_its_own_topic_only(backend: DdsBackend) -> None:
    """At most `depth` messages wait for it: the newest."""
    go, entered = threading.Event(), threading.Event()
    slow: list[bytes] = []
    quick: list[bytes] = []

    def callback(message: bytes) -> None:
        slow.append(message)
        entered.set()
        go.wait(SOON_S)

    backend.subscription("/slow", STRING, Qos(depth=2), callback)
    backend.subscription("/quick", STRING, Qos(), quick.append)
    publishers = [backend.publisher(topic, STRING, Qos()) for topic in ("/slow", "/quick")]
    publishers[0].publish(text("0"))
    assert entered.wait(SOON_S)
    for number in range(1, 6):
        for publisher in publishers:
            publisher.publish(text(str(number)))
    wait_for(lambda: len(quick) == 5)
    go.set()
    wait_for(lambda: len(slow) == 3)
    assert [message[8:9] for message in slow] == [b"0", b"4", b"5"]


def test_a_closed_subscription_does_not_call(backend: DdsBackend) -> None:
    """close() waits for a call that is under way; from within the callback it ends after it."""
    entered, go = threading.Event(), threading.Event()
    got: list[bytes] = []

    def callback(message: bytes) -> None:
        entered.set()
        go.wait(SOON_S)
        got.append(message)

    subscription = backend.subscription("/words", STRING, Qos(), callback)
    publisher = backend.publisher("/words", STRING, Qos())
    publisher.publish(text("a"))
    assert entered.wait(SOON_S)
    publisher.publish(text("b"))
    closing = threading.Thread(target=subscription.close)
    closing.start()
    wait_for(lambda: subscription._receiver._deliver._closed)
    assert closing.is_alive()
    go.set()
    closing.join(SOON_S)
    assert len(got) == 1
    assert publisher.subscriber_count == 0

    own: list[Any] = []
    own.append(
        backend.subscription("/words", STRING, Qos(), lambda message: (got.append(message), own[0].close()))
    )
    publisher.publish(text("c"))
    wait_for(lambda: publisher.subscriber_count == 0)
    publisher.publish(text("d"))
    assert [message[8:9] for message in got] == [b"a", b"c"]
    own[0].close()


def test_what_is_closed_is_gone(dds_domain: int, foreigner: Start) -> None:
    """Publishers, then the node; also twice, and with another node of this process in the same domain."""
    other = foreigner()
    node, stays = DdsBackend(distro="jazzy"), DdsBackend(distro="jazzy", node_name="stays")
    publisher = node.publisher("/words", STRING, Qos())
    kept = stays.publisher("/kept", STRING, Qos())
    other.do("subscribe", topic="rt/words", kind="String")
    other.do("subscribe", topic="rt/kept", kind="String")

    def topics() -> set[str]:
        return {endpoint["topic"] for endpoint in other.do("look").values() if endpoint["writer"]}

    wait_for(lambda: {"rt/words", "rt/kept", "ros_discovery_info"} <= topics())
    publisher.close()
    publisher.close()
    wait_for(lambda: "rt/words" not in topics())
    assert publisher.subscriber_count == 0
    with pytest.raises(BackendError, match="is closed"):
        publisher.publish(text("a"))
    node.close()
    node.close()
    with pytest.raises(BackendError, match="is closed"):
        node.publisher("/words", STRING, Qos())
    wait_for(lambda: kept.subscriber_count == 1)
    kept.publish(text("still here"))
    assert other.do("collect", topic="rt/kept", count=1) == ["still here"]
    stays.close()
    wait_for(lambda: topics() == set())


def test_threads_publish_at_once(backend: DdsBackend) -> None:
    """Writes run beside Python, and beside each other."""
    counts = [0] * 4
    senders = []
    for number in range(4):

        def count(message: bytes, number: int = number) -> None:
            counts[number] += 1

        topic = f"/lens{number}"
        backend.subscription(topic, IMAGE, Qos(depth=200), count)
        publisher = backend.publisher(topic, IMAGE, Qos(depth=200))
        messages = [image(SOME, second) for second in range(100)]
        senders.append(
            threading.Thread(
                target=lambda p=publisher, m=messages: [p.publish(one) for one in m], daemon=True
            )
        )
    for sender in senders:
        sender.start()
    for sender in senders:
        sender.join(SOON_S)
    wait_for(lambda: counts == [100] * 4)


def test_a_service_answers(backend: DdsBackend, foreigner: Start, caplog: pytest.LogCaptureFixture) -> None:
    """The header of the request comes back; a callback that raises is an answer too."""
    answers = iter([(True, "reset, t = 0 s"), (False, "")])

    def answer(request: Any, response: Any) -> Any:
        response.success, response.message = next(answers)
        return response

    service = backend.service("/drone/reset", TRIGGER, answer)
    other = foreigner()
    guid = "0x123456789abcdef0"
    assert other.do("call", name="/drone/reset", number=7) == [[guid, 7, True, "reset, t = 0 s"]]
    assert other.do("call", name="/drone/reset", number=8) == [[guid, 8, False, ""]]
    with caplog.at_level(logging.CRITICAL):
        failed = other.do("call", name="/drone/reset", number=9)
    assert failed == [[guid, 9, False, ""]]
    endpoints = [one for one in other.do("look").values() if "drone/reset" in str(one["topic"])]
    ids = {one["user_data"] for one in endpoints if one["user_data"]}
    assert len(ids) == 1  # clients recognise a service by the id that both its topics share
    assert re.fullmatch("serviceid=[0-9a-f.]+;typehash=RIHS01_0{64};", ids.pop())
    service.close()
    service.close()
