"""`--ros-args` and ROS parameters: names, remappings, values from everywhere, and changes while it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from bridge_process import BridgeProcess
from bridge_rig import Rig, imu
from processes import wait_for

from cortex import Node
from cortex import messages as msg
from cortex_ros2_bridge import cdr, cli
from cortex_ros2_bridge.backend.base import Qos
from cortex_ros2_bridge.backend.dds import DdsBackend
from cortex_ros2_bridge.config import BridgeConfig, load
from cortex_ros2_bridge.msgs import message_class
from cortex_ros2_bridge.parameters import Parameters
from cortex_ros2_bridge.ros_args import expand, flatten, nest, split
from cortex_ros2_bridge.routes import Seen, make_routes

FILE = """
/**:
  ros__parameters: {exclude: ["*/depth"], use_sim_time: true}
/sim/other: {ros__parameters: {exclude: ["nothing"]}}
sim:
  cortex_bridge:
    ros__parameters:
      frames: {map: world}
      routes:
        imu: {cortex: /drone/imu, ros: /gyro, qos: {depth: 7}, options: {queue: 5}}
"""


def config_of(*arguments: str) -> BridgeConfig:
    others, ros = split(arguments)
    make, given = cli._settings(cli._parser().parse_args(others), ros)
    return make(given)


def routes_of(config: BridgeConfig, *topics: tuple[str, type[Any]]) -> list[Any]:
    from test_routes import topic

    routes, problems = make_routes(Seen(tuple(topic(*each) for each in topics)), config)
    assert problems == []
    return routes


@pytest.mark.parametrize(
    ("name", "full"),
    [("/a", "/a"), ("a/b", "/ns/a/b"), ("~/a", "/ns/node/a"), ("~", "/ns/node"), ("{node}_x", "/ns/node_x")],
)
def test_names_are_expanded(name: str, full: str) -> None:
    assert expand(name, "node", "/ns") == full


def test_what_launch_appends_is_understood() -> None:
    """Name, namespace, remappings of topics, absolute and relative, rules for others, log levels."""
    config = config_of(
        *("--distro", "humble", "--ros-args", "-r", "__node:=eye", "-r", "__ns:=/sim"),
        *("--remap", "drone/imu:=/gyro", "-r", "other:/sim/clock:=/x", "-r", "/tf:=tf", "-r", "~/a:=b"),
        *("--log-level", "debug", "--disable-rosout-logs", "--", "--namespace", "/ignored"),
    )
    assert (config.node, config.namespace, config.distro) == ("eye", "/sim", "humble")
    topics = ("/drone/imu", msg.Imu), ("/clock", msg.Clock), ("/drone/odometry", msg.Odometry)
    names = {route.ros_topic for route in routes_of(config, *topics)}
    assert names == {"/clock", "/gyro", "/sim/drone/odometry", "/sim/tf"}
    assert config.ros.remap("/sim/eye/a", "eye", "/sim") == "/sim/b"


def test_parameters_come_from_files_and_the_command_line(tmp_path: Path) -> None:
    """Wildcards, nodes in namespaces, entries of routes by labels; the last one wins."""
    path = tmp_path / "parameters.yaml"
    path.write_text(FILE)
    config = config_of(
        *("--namespace", "/sim", "--ros-args", "--params-file", str(path), "-p", "routes.imu.qos.depth:=9"),
        *("-p", "cortex_bridge:include:=['/drone/*']", "-p", "elsewhere:include:=['/x']"),
    )
    assert (config.exclude, config.include, config.frames.map) == (("*/depth",), ("/drone/*",), "world")
    (route,) = routes_of(config, ("/drone/imu", msg.Imu))
    assert (route.ros_topic, route.qos.depth, route.options) == ("/sim/gyro", 9, {"queue": 5})
    assert config_of("--ros-args", "--params-file", str(path)).frames.map == "map"  # in another namespace


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["-r", "a"], r"-r takes \[NODE:\]NAME:=VALUE, got 'a'"),
        (["-p"], "-p needs a value"),
        (["--params-file", "nothing.yaml"], "cannot read nothing.yaml"),
        (["--log-level", "loud"], "--log-level is one of debug, info, warn, error, fatal, got 'loud'"),
        (["--verbose"], "unknown argument '--verbose', known: -r"),
        (["-p", "a:=[1"], "not YAML"),
        (["-r", "__node:=a b"], "invalid ROS name '/a b'"),
        (["-p", "include:=3"], "include must be a list, got 3"),
        (
            ["-p", "routes.x.qos.depth:=0", "-p", "routes.x.cortex:=/a"],
            "depth: Input should be greater than or equal to 1",
        ),
    ],
)
def test_wrong_arguments_are_refused(arguments: list[str], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        config_of("--ros-args", *arguments)


def test_a_file_without_nodes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "parameters.yaml"
    path.write_text("exclude: ['*/depth']\n")
    with pytest.raises(ValueError, match="'exclude' must be a mapping with ros__parameters"):
        config_of("--ros-args", "--params-file", str(path))


def test_unknown_parameters_are_said(caplog: pytest.LogCaptureFixture) -> None:
    """They may be meant for another node of the same file."""
    config_of("--ros-args", "-p", "exclud:=['/a']", "-p", "use_sim_time:=true", "-e", "/secure")
    assert "no parameter is called exclud, known: backend" in caplog.text
    assert "-e /secure has no effect" in caplog.text
    assert "use_sim_time" not in caplog.text


def test_flat_and_nested_names_are_inverse() -> None:
    nested = {"a": {"b": {"c": 1, "d": [2]}, "e": {}}, "f": None}
    assert nest(dict(flatten(nested))) == nested


def test_a_namespace_may_hold_everything() -> None:
    """Also what every node expects at the root, and the names of frames."""
    config = load({"namespace": "/one", "isolate": True})
    routes = routes_of(config, ("/clock", msg.Clock), ("/drone/odometry", msg.Odometry))
    assert {route.ros_topic for route in routes} == {"/one/clock", "/one/drone/odometry", "/one/tf"}
    assert config.frame_names.odom_of("drone") == "one/drone/odom"
    assert config.ros_topic("/diagnostics") == "/one/diagnostics"


def parameter(name: str, **value: Any) -> Any:
    made = message_class("rcl_interfaces/msg/Parameter")(name=name)
    made.value = message_class("rcl_interfaces/msg/ParameterValue")(**value)
    return made


@pytest.fixture
def parameters(runtime: Path) -> Any:
    rig = Rig()
    rig.simulator.publisher("/drone/imu", msg.Imu)
    rig.opens("/drone/imu")
    yield rig, Parameters(rig.bridge, rig.backend, lambda given: load(None, given), {})
    rig.close()


def test_parameters_are_listed_and_described(parameters: Any) -> None:
    rig, _ = parameters
    ask = {name.rpartition("/")[2]: service for name, service in rig.backend.services.items()}
    assert {name.rpartition("/")[0] for name in rig.backend.services} == {"/cortex_bridge"}
    names = ask["list_parameters"].call().result.names
    assert {"backend", "include", "frames.map", "routes.drone_imu_Imu.qos.depth"} <= set(names)
    frames = ask["list_parameters"].call(prefixes=["frames"]).result.names
    assert sorted(frames) == ["frames.map", "frames.odom", "frames.prefix"]
    values = ask["get_parameters"].call(names=["backend", "include", "routes.drone_imu_Imu.qos.depth", "no"])
    backend, include, depth, no = values.values
    assert (backend.type, backend.string_value) == (4, "auto")
    assert (include.type, list(include.string_array_value)) == (9, ["*"])
    assert (depth.type, depth.integer_value, no.type) == (2, 1000, 0)
    fixed, live = ask["describe_parameters"].call(names=["backend", "include"]).descriptors
    assert (fixed.read_only, live.read_only, live.type) == (True, False, 9)
    assert list(ask["get_parameter_types"].call(names=["backend", "no"]).types) == [4, 0]


def test_routes_change_while_it_runs(parameters: Any) -> None:
    """A route is closed and opened with what was set; what is wrong is refused with a reason."""
    rig, _ = parameters
    change = rig.backend.services["/cortex_bridge/set_parameters"].call
    label = "routes.drone_imu_Imu"
    done = change(parameters=[parameter(f"{label}.qos.depth", type=2, integer_value=3)])
    assert [each.successful for each in done.results] == [True]
    rig.update_until(lambda: rig.backend.publishers["/drone/imu"].qos.depth == 3)
    assert change(parameters=[parameter(f"{label}.enabled", type=1, bool_value=False)]).results[0].successful
    rig.update_until(lambda: "/drone/imu" not in rig.backend.publishers)
    assert change(parameters=[parameter(f"{label}.enabled", type=1, bool_value=True)]).results[0].successful
    rig.opens("/drone/imu")
    for name, value, reason in (
        (f"{label}.qos.depth", {"type": 2, "integer_value": 0}, "greater than or equal to 1"),
        ("namespace", {"type": 4, "string_value": "/x"}, "from the start to the end"),
        ("nothing", {"type": 4, "string_value": "/x"}, "unknown parameter 'nothing'"),
    ):
        (result,) = change(parameters=[parameter(name, **value)]).results
        assert not result.successful
        assert reason in result.reason
    together = rig.backend.services["/cortex_bridge/set_parameters_atomically"].call(
        parameters=[parameter("exclude", type=9, string_array_value=["/drone/*"])]
    )
    assert together.result.successful
    rig.update_until(lambda: "/drone/imu" not in rig.backend.publishers)


def test_the_command_does_what_launch_asks(dds_domain: int, runtime: Path) -> None:
    """Through DDS, without rclpy: node, namespace and topic are as they were remapped."""
    ros = DdsBackend(distro="jazzy", node_name="listener")
    got: list[bytes] = []
    arguments = (
        "-r",
        "__node:=eye",
        "-r",
        "__ns:=/sim",
        "-r",
        "/sim/drone/imu:=/gyro",
        "-p",
        "exclude:=['*/x']",
    )
    try:
        with Node("simulator") as simulator:
            sent = simulator.publisher("/drone/imu", msg.Imu)
            with BridgeProcess(
                "-v", "--backend", "dds", "--distro", "jazzy", "--ros-args", *arguments
            ) as bridge:
                bridge.wait_for("/drone/imu -> /gyro")
                assert "/sim/eye: dds" in bridge.said
                ros.subscription("/gyro", "sensor_msgs/msg/Imu", Qos(), got.append)
                wait_for(lambda: sent.subscriber_count)
                wait_for(lambda: sent.publish(imu(7)) and got)
                with BridgeProcess("--backend", "run.bag", "--ros-args", *arguments) as wrong:
                    assert wrong.process.wait(60.0) == 1
                    wrong.hear()
                    assert "backend: a backend is auto, rclpy, dds or a path that ends in .mcap" in wrong.said
                with BridgeProcess("--backend", "dds", "--ros-args", *arguments) as second:
                    assert second.process.wait(60.0) == 1
                    second.hear()
                    assert f"another bridge runs already (eye in ROS domain {dds_domain}, /sim" in second.said
                    assert f"process {bridge.process.pid} on" in second.said
                with BridgeProcess("--beside", "--backend", "dds", "--ros-args", *arguments) as told:
                    told.wait_for("waiting for Cortex topics")
        assert cdr.decode(got[0], "sensor_msgs/msg/Imu").header.stamp.nanosec == 7
    finally:
        ros.close()
