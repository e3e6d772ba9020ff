"""What other nodes see of ours, and ours of them: names, types, hashes, in Humble and in later ones."""

from __future__ import annotations

import logging
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from foreigners import Foreigner
from processes import wait_for

from cortex_ros2_bridge.backend import environment
from cortex_ros2_bridge.backend.base import Qos, TopicInfo
from cortex_ros2_bridge.backend.dds import DdsBackend
from cortex_ros2_bridge.backend.environment import chosen_distro, cyclone_config, domain_id
from cortex_ros2_bridge.backend.names import (
    check_name,
    check_node_name,
    dds_type_of,
    ros_topic,
    ros_type,
    split_type,
)

IMU = "sensor_msgs/msg/Imu"
STRING = "std_msgs/msg/String"
IMU_HASH = "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b"  # of the real Jazzy
# Of rmw_dds_common/msg/ParticipantEntitiesInfo with an id of uint8[16], as rosidl reads char[16].
DISCOVERY_HASH = "RIHS01_91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e"
GID_BYTES = {"humble": 24, "jazzy": 16}
Start = Callable[..., Foreigner]


@pytest.fixture
def make(dds_domain: int) -> Iterator[Callable[..., DdsBackend]]:
    """A function that makes nodes, which are closed at the end."""
    nodes: list[DdsBackend] = []

    def start(**options: Any) -> DdsBackend:
        nodes.append(DdsBackend(**options))
        return nodes[-1]

    yield start
    for node in nodes:
        node.close()


def ros_node(other: Foreigner, distro: str) -> None:
    """Let a process look like a node of a distribution, with a publisher on /chatter."""
    endpoint_data = "" if distro == "humble" else f"typehash=RIHS01_{'0' * 64};"
    other.do("join", user_data="enclave=/;", endpoint_data=endpoint_data)
    other.do("advertise", topic="rt/chatter", kind="String", matched=False)


def announced(other: Foreigner, gid_bytes: int, name: str = "cortex_bridge") -> Any:
    """What the newest announcement says of a node: its participant, and the rest."""
    for participant, nodes in other.do("nodes", gid_bytes=gid_bytes).items():
        for node in nodes:
            if node["name"] == name:
                return participant, node
    return None


@pytest.mark.parametrize("distro", ["humble", "jazzy"])
def test_others_see_a_node_with_its_endpoints(make: Any, foreigner: Start, distro: str) -> None:
    """Ids in the announcement are those of discovery; endpoints show the hash of their type."""
    other = foreigner()
    node = make(distro=distro, node_name="bridge", namespace="/sim/a")
    publisher = node.publisher("/drone/imu", IMU, Qos())
    node.subscription("/drone/name", STRING, Qos(), print)
    size = GID_BYTES[distro]
    pad = "00" * (size - 16)

    def whole() -> Any:
        found = announced(other, size, "bridge")
        return found if found and found[1]["readers"] and found[1]["writers"] else None

    participant, told = wait_for(whole)
    seen = other.do("look")
    by_topic = {one["topic"]: key for key, one in seen.items() if one["topic"]}
    assert told["namespace"] == "/sim/a"
    assert told["writers"] == [by_topic["rt/drone/imu"] + pad]
    assert told["readers"] == [by_topic["rt/drone/name"] + pad]
    imu = seen[by_topic["rt/drone/imu"]]
    assert imu["type"] == "sensor_msgs::msg::dds_::Imu_"
    assert imu["participant"] + pad == participant
    assert imu["user_data"] == f"typehash={IMU_HASH};"
    assert seen[imu["participant"]]["user_data"] == "enclave=/;"
    discovery = next(one for one in seen.values() if one["topic"] == "ros_discovery_info" and one["writer"])
    assert discovery["user_data"] == ("" if distro == "humble" else f"typehash={DISCOVERY_HASH};")

    publisher.close()
    wait_for(lambda: announced(other, size, "bridge")[1]["writers"] == [])
    assert other.do("nodes", gid_bytes=40 - size) == {}  # nothing in the other layout


@pytest.mark.parametrize("distro", ["humble", "jazzy"])
def test_the_layout_is_that_of_the_first_node(make: Any, foreigner: Start, distro: str) -> None:
    """Nothing is announced before it is known; processes without ROS and other bridges say nothing of it."""
    stranger = foreigner()
    stranger.do("advertise", topic="rt/words", kind="String", matched=False)
    kin = make(node_name="kin")
    kin.publisher("/kin", STRING, Qos())
    node = make()
    node.publisher("/drone/imu", IMU, Qos())
    wait_for(lambda: {"/words", "/kin"} <= {topic.topic for topic in node.topics()})
    assert (node.graph.layout, kin.graph.layout) == (None, None)
    assert stranger.do("nodes", gid_bytes=16) == stranger.do("nodes", gid_bytes=24) == {}

    ros = foreigner()
    ros_node(ros, distro)
    size = GID_BYTES[distro]
    wait_for(lambda: announced(ros, size) and announced(ros, size)[1]["writers"])
    assert (node.graph.layout, kin.graph.layout) == (distro, distro)
    assert ros.do("nodes", gid_bytes=40 - size) == {}


def test_humble_wins_where_both_are(make: Any, foreigner: Start, caplog: pytest.LogCaptureFixture) -> None:
    node = make(distro="jazzy")
    ros_node(foreigner(), "humble")
    wait_for(lambda: "nodes of ROS Humble are here too" in caplog.text)
    assert node.graph.layout == "jazzy"
    ros_node(foreigner(), "jazzy")
    wait_for(lambda: node.topics() == [TopicInfo("/chatter", STRING, (Qos(), Qos()), ())])
    late = make(node_name="late")
    wait_for(lambda: late.graph.layout is not None)
    assert late.graph.layout == "humble"
    assert caplog.text.count("nodes of ROS Humble are here too") == 1


def test_ros_distro_is_believed(
    make: Any, foreigner: Start, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    other = foreigner()
    monkeypatch.setenv("ROS_DISTRO", "humble")
    node = make()
    assert (node.distro, node.graph.layout) == ("humble", "humble")
    wait_for(lambda: announced(other, 24))
    assert chosen_distro("jazzy") == "jazzy"
    monkeypatch.setenv("ROS_DISTRO", "zebra")
    assert chosen_distro() == "jazzy"
    assert "ROS_DISTRO=zebra is not known" in caplog.text
    monkeypatch.setenv("ROS_DISTRO", "")
    assert chosen_distro() is None
    with pytest.raises(ValueError, match=r"'zebra', known: humble.*jazzy"):
        chosen_distro("zebra")


def test_topics_of_others(short_lease: None, make: Any, foreigner: Start) -> None:
    """Both directions are counted; own endpoints, services and what is no topic of ROS are left out."""
    node = make(distro="jazzy")
    node.publisher("/mine", STRING, Qos())
    node.service("/drone/reset", "std_srvs/srv/Trigger", lambda request, response: response)
    other, another = foreigner(), foreigner()
    other.do("advertise", topic="rt/b", kind="String", matched=False)
    other.do("advertise", topic="elsewhere", kind="String", matched=False)
    another.do("advertise", topic="rt/b", kind="String", matched=False)
    other.do("subscribe", topic="rt/b", kind="String")
    other.do("subscribe", topic="rt/mine", kind="String")
    other.do("advertise", topic="rt/a/image", kind="Image", matched=False)
    expected = [
        TopicInfo("/a/image", "sensor_msgs/msg/Image", (Qos(),), ()),
        TopicInfo("/b", STRING, (Qos(), Qos()), (Qos(),)),
        TopicInfo("/mine", STRING, (), (Qos(),)),
    ]
    wait_for(lambda: node.topics() == expected)
    another.kill()
    wait_for(lambda: TopicInfo("/b", STRING, (Qos(),), (Qos(),)) in node.topics())


def test_a_closed_node_is_gone(make: Any, foreigner: Start, caplog: pytest.LogCaptureFixture) -> None:
    other = foreigner()
    node = make(distro="jazzy")
    node.publisher("/a", STRING, Qos())
    wait_for(lambda: announced(other, 16))
    with caplog.at_level(logging.DEBUG):
        node.close()
    wait_for(lambda: not any(one["writer"] for one in other.do("look").values()))
    assert caplog.text == ""


def test_names() -> None:
    assert check_name("/drone/imu_2") == "/drone/imu_2"
    assert check_node_name("a", "") == ("a", "/")
    assert check_node_name("a", "/") == ("a", "/")
    assert check_node_name("a", "b/c") == ("a", "/b/c")
    assert split_type(IMU) == ("sensor_msgs", "msg", "Imu")
    assert dds_type_of(IMU) == "sensor_msgs::msg::dds_::Imu_"
    for wrong in ("sensor_msgs/Imu", "Imu", "", "sensor_msgs/msg/"):
        with pytest.raises(ValueError, match=f"invalid ROS type '{wrong}'"):
            dds_type_of(wrong)
    with pytest.raises(ValueError, match="invalid ROS name '/a b'"):
        check_node_name("a", "a b")
    assert ros_topic("rt/drone/imu") == "/drone/imu"
    assert ros_topic("rq/drone/resetRequest") is None
    assert ros_topic("ros_discovery_info") is None
    assert ros_type("sensor_msgs::msg::dds_::Imu_") == IMU
    assert ros_type("HelloWorld") == "HelloWorld"


def settings(distro: str | None = None, **environment: str) -> dict[str, Any]:
    """What our part of the configuration sets, by path."""
    ours = cyclone_config(distro, environment).partition("</CycloneDDS>")
    found: dict[str, Any] = {}

    def walk(element: ElementTree.Element, path: str) -> None:
        for child in element:
            name = f"{path}/{child.tag}".removeprefix("/Domain/")
            if "address" in child.attrib:
                found.setdefault(name, []).append(child.attrib["address"])
            elif "max" in child.attrib:
                found[name] = child.attrib["max"]
            elif len(child):
                walk(child, f"{path}/{child.tag}")
            else:
                found[name] = child.text

    walk(ElementTree.fromstring(ours[0] + ours[1]), "")
    assert found.pop("Internal/WriterLingerDuration") == "50 ms"
    assert found.pop("Internal/SocketReceiveBufferSize") == "4MB"
    return found


INDEX = {"Discovery/ParticipantIndex": "auto", "Discovery/MaxAutoParticipantIndex": "32"}


def test_environment_of_ros_becomes_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    """As rmw_cyclonedds of Humble and of Jazzy reads it."""
    assert settings() == settings("jazzy", ROS_AUTOMATIC_DISCOVERY_RANGE="subnet") == INDEX
    assert settings(ROS_STATIC_PEERS="10.0.0.1;host") == {
        **INDEX,
        "Discovery/Peers/Peer": ["10.0.0.1", "host"],
    }
    local = {**INDEX, "General/AllowMulticast": "false", "Discovery/Peers/Peer": ["localhost"]}
    monkeypatch.setattr(environment, "_both_interfaces", lambda: "")
    assert settings(ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST") == local
    for distro in ("jazzy", None):
        assert settings(distro, ROS_LOCALHOST_ONLY="1", ROS_STATIC_PEERS="host") == local
    only = {
        **INDEX,
        "General/Interfaces/NetworkInterface": ["127.0.0.1"],
        "Discovery/Peers/Peer": ["localhost"],
    }
    assert settings("humble", ROS_LOCALHOST_ONLY="1") == only
    assert settings("humble", ROS_LOCALHOST_ONLY="0") == INDEX
    unknown_to_it = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": "host"}
    assert settings("humble", **unknown_to_it) == INDEX
    assert settings("humble", ROS_LOCALHOST_ONLY="1", **unknown_to_it) == only
    off = settings(ROS_AUTOMATIC_DISCOVERY_RANGE="OFF", ROS_STATIC_PEERS="host")
    assert off.pop("Discovery/Tag").startswith("ros_discovery_off_")
    assert off == {"General/AllowMulticast": "false", "Discovery/ParticipantIndex": "none"}
    theirs = "file:///etc/cyclone.xml"
    assert cyclone_config(None, {"CYCLONEDDS_URI": theirs}).endswith(f"</CycloneDDS>,{theirs}")
    with pytest.raises(ValueError, match=r"ROS_AUTOMATIC_DISCOVERY_RANGE must be one of SUBNET.*'HOUSE'"):
        cyclone_config(None, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "HOUSE"})
    with pytest.raises(ValueError, match="ROS_LOCALHOST_ONLY must be 0 or 1, got 'yes'"):
        cyclone_config(None, {"ROS_LOCALHOST_ONLY": "yes"})


def test_cyclone_accepts_both_interfaces_or_the_only_one() -> None:
    """Where 127.0.0.1 is the only one, naming it as well would be refused."""
    chosen = environment._both_interfaces()
    both = '<NetworkInterface autodetermine="true"/><NetworkInterface address="127.0.0.1"/>'
    assert chosen in ("", f"<Interfaces>{both}</Interfaces>")


def test_interfaces_of_the_user_are_the_only_ones(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(environment, "_both_interfaces", lambda: "<Interfaces>both</Interfaces>")
    path = tmp_path / "cyclone.xml"
    path.write_text("<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo'/></Interfaces>")
    local = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    for uri in (f"file://{path}", f"<CycloneDDS/>,file://{path}", path.read_text()):
        assert "both" not in cyclone_config(None, {**local, "CYCLONEDDS_URI": uri})
    for uri in ("", "file:///etc/no_such_file.xml", "<CycloneDDS><Domain/></CycloneDDS>"):
        assert "both" in cyclone_config(None, {**local, "CYCLONEDDS_URI": uri})


@pytest.mark.parametrize(
    "peer",
    [
        "<AllowMulticast>false</AllowMulticast>",
        "<Interfaces><NetworkInterface address='127.0.0.1'/></Interfaces>",
    ],
    ids=["as rmw_cyclonedds of Jazzy", "as that of Humble"],
)
def test_on_this_host_only_nodes_that_start_later_are_found(
    make: Any, foreigner: Start, monkeypatch: pytest.MonkeyPatch, peer: str
) -> None:
    """Both of those that search on this host only, and those that keep to 127.0.0.1."""
    discovery = "<ParticipantIndex>auto</ParticipantIndex><Peers><Peer address='localhost'/></Peers>"
    monkeypatch.delenv("CYCLONEDDS_URI")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    words = make(distro="jazzy").publisher("/words", STRING, Qos())
    uri = f"<Domain><General>{peer}</General><Discovery>{discovery}</Discovery></Domain>"
    other = foreigner(CYCLONEDDS_URI=f"<CycloneDDS>{uri}</CycloneDDS>")
    assert other.do("subscribe", topic="rt/words", kind="String") == 1
    wait_for(lambda: words.subscriber_count == 1)


def test_domain_number() -> None:
    assert domain_id(None, {}) == domain_id(None, {"ROS_DOMAIN_ID": ""}) == 0
    assert domain_id(None, {"ROS_DOMAIN_ID": "42"}) == 42
    assert domain_id(7, {"ROS_DOMAIN_ID": "42"}) == 7
    for bad in ("-1", "233", "x", "1.5"):
        with pytest.raises(ValueError, match=rf"ROS_DOMAIN_ID must be a number from 0 to 232, got '{bad}'"):
            domain_id(None, {"ROS_DOMAIN_ID": bad})
    with pytest.raises(ValueError, match="domain must be a number from 0 to 232, got '233'"):
        domain_id(233, {})


@pytest.mark.parametrize(
    "environment",
    [
        {"ROS_LOCALHOST_ONLY": "1"},
        {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": "127.0.0.1"},
        {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"},
    ],
)
def test_cyclone_accepts_each_configuration(
    make: Any, foreigner: Start, monkeypatch: pytest.MonkeyPatch, environment: dict[str, str]
) -> None:
    """Two nodes that obey it meet, if it allows that; those that it shuts off do not."""
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    if "ROS_LOCALHOST_ONLY" not in environment:  # the test's own settings would win
        monkeypatch.delenv("CYCLONEDDS_URI")
    node = make(distro="jazzy")
    other = foreigner()
    other.do("listen", topic="/words", type_name=STRING, depth=1)
    if environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE") != "OFF":
        wait_for(lambda: node.topics() == [TopicInfo("/words", STRING, (), (Qos(),))])
    else:
        assert node.topics() == []


def test_a_domain_that_cannot_be_joined_is_an_error(make: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from cortex_ros2_bridge.backend.base import BackendError

    monkeypatch.setenv("CYCLONEDDS_URI", "<CycloneDDS><Domain><Nonsense/></Domain></CycloneDDS>")
    with pytest.raises(BackendError, match=r"DDS domain \d+ cannot be joined.*Nonsense"):
        make()
