"""The launch files start what they say, with and without a ROS installation; RViz shows topics that exist."""

from __future__ import annotations

import ast
import importlib.util
import sys
import types
from pathlib import Path

import pytest
import yaml
from test_routes import topic

from cortex.messages import Events, Image, Odometry
from cortex.messages import Path as PathMessage
from cortex_ros2_bridge.cli import _parser
from cortex_ros2_bridge.config import load as settings
from cortex_ros2_bridge.routes import Seen, make_routes

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted((ROOT / "launch").glob("*.launch.py"))


class Action:
    """An action of the fake `launch`: it remembers its arguments."""

    def __init__(self, *arguments, **keywords):
        self.arguments, self.keywords = arguments, keywords


class DeclareLaunchArgument(Action): ...


class ExecuteProcess(Action): ...


class IncludeLaunchDescription(Action): ...


class Node(Action): ...


class OpaqueFunction(Action): ...


class Shutdown(Action): ...


class LaunchConfiguration:
    def __init__(self, name):
        self.name = name

    def perform(self, context):
        return context[self.name]


@pytest.fixture
def fake_launch(monkeypatch):
    """A `launch` of a few lines in sys.modules, and no virtual environment."""
    monkeypatch.delenv("VIRTUAL_ENV", raising=False)
    launch = types.ModuleType("launch")
    launch.LaunchDescription = lambda entities: entities
    launch.actions = types.ModuleType("launch.actions")
    for kind in (DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription, OpaqueFunction, Shutdown):
        setattr(launch.actions, kind.__name__, kind)
    launch.substitutions = types.ModuleType("launch.substitutions")
    launch.substitutions.LaunchConfiguration = LaunchConfiguration
    launch.launch_description_sources = types.ModuleType("launch.launch_description_sources")
    launch.launch_description_sources.PythonLaunchDescriptionSource = lambda path: path
    for module in (launch, launch.actions, launch.substitutions, launch.launch_description_sources):
        monkeypatch.setitem(sys.modules, module.__name__, module)


@pytest.fixture
def fake_launch_ros(fake_launch, monkeypatch):
    """A `launch_ros` beside it."""
    package, actions = types.ModuleType("launch_ros"), types.ModuleType("launch_ros.actions")
    actions.Node = Node
    monkeypatch.setitem(sys.modules, "launch_ros", package)
    monkeypatch.setitem(sys.modules, "launch_ros.actions", actions)


def load(path):
    spec = importlib.util.spec_from_file_location(path.name.replace(".", "_"), path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(path, **given):
    """The actions of a launch file for some arguments; what is declared decides about the others."""
    entities = load(path).generate_launch_description()
    declared = [e for e in entities if isinstance(e, DeclareLaunchArgument)]
    values = {d.arguments[0]: d.keywords["default_value"] for d in declared}
    assert all(d.keywords["description"] for d in declared)
    assert not set(given) - set(values)
    (opaque,) = [e for e in entities if isinstance(e, OpaqueFunction)]
    return opaque.keywords["function"](values | given)


def commands(actions):
    return {a.keywords["name"]: a.keywords["cmd"] for a in actions if isinstance(a, ExecuteProcess)}


def test_the_bridge_with_all_its_arguments(fake_launch):
    """What is started is understood by the command itself."""
    path = ROOT / "launch" / "bridge.launch.py"
    assert commands(run(path))["cortex_bridge"] == [
        sys.executable,
        "-m",
        "cortex_ros2_bridge",
        "--backend",
        "auto",
    ]
    given = {"config": "a.yaml", "namespace": "/sim", "backend": "dds", "distro": "humble"}
    command = commands(run(path, **given))["cortex_bridge"]
    options = _parser().parse_args(command[3:])
    assert {name: getattr(options, name) for name in given} == given
    command = commands(run(path, params_file="p.yaml"))["cortex_bridge"]
    assert command[-3:] == ["--ros-args", "--params-file", "p.yaml"]
    command = commands(run(path, params_file="p.yaml", autostart="false"))["cortex_bridge"]
    assert command[-5:] == ["--ros-args", "--params-file", "p.yaml", "-p", "autostart:=false"]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_the_virtual_environment_that_is_active_runs_it(fake_launch, monkeypatch, path):
    """Though `ros2 launch` runs in the Python of ROS."""
    monkeypatch.setenv("VIRTUAL_ENV", "/home/me/ws/venv")
    assert {command[0] for command in commands(run(path)).values()} == {"/home/me/ws/venv/bin/python"}


def test_the_bridge_is_a_node_where_launch_ros_is(fake_launch_ros):
    """So that namespaces, remappings and parameters around it hold for it."""
    path = ROOT / "launch" / "bridge.launch.py"
    (node,) = run(path, namespace="/sim", distro="humble", params_file="p.yaml", autostart="false")
    assert isinstance(node, Node)
    assert node.keywords == {
        "executable": sys.executable,
        "arguments": ["-m", "cortex_ros2_bridge", "--backend", "auto", "--distro", "humble"],
        "name": "cortex_bridge",
        "namespace": "/sim",
        "parameters": ["p.yaml", {"autostart": False}],
        "output": "screen",
    }


def test_the_simulation_alone(fake_launch):
    """By default the simulator, which hovers, and the bridge; everything ends with the simulator."""
    actions = run(ROOT / "launch" / "simulation.launch.py")
    assert commands(actions) == {
        "simulator": [sys.executable, "-m", "neurosim_core", "serve", "--set", "live.begin=hover"]
    }
    none = commands(run(ROOT / "launch" / "simulation.launch.py", controller="none"))
    assert none == {"simulator": [sys.executable, "-m", "neurosim_core", "serve"]}
    assert isinstance(actions[0].keywords["on_exit"], Shutdown)
    include = actions[1]
    assert Path(include.arguments[0]) == ROOT / "launch" / "bridge.launch.py"
    bridge = dict(include.keywords["launch_arguments"])
    assert commands(run(ROOT / "launch" / "bridge.launch.py", **bridge))["cortex_bridge"][-1] == "auto"


def test_the_simulation_with_everything(fake_launch):
    actions = run(
        ROOT / "launch" / "simulation.launch.py",
        scene="house.yaml",
        lockstep="true",
        factor="2.0",
        record="out",
        controller="path",
        namespace="/neurosim",
        bridge_config="bridge.yaml",
        backend="dds",
        rviz="true",
        rerun="1",
        python="python3",
    )
    found = commands(actions)
    assert found["simulator"] == [
        *("python3", "-m", "neurosim_core", "serve", "house.yaml", "--lockstep"),
        *("--factor", "2.0", "--record", "out"),
    ]
    assert found["controller"][-1] == "fly"
    assert found["rerun"][-1] == "view"
    assert dict(actions[1].keywords["launch_arguments"]) == {
        "config": "bridge.yaml",
        "namespace": "/neurosim",
        "backend": "dds",
        "distro": "",
        "params_file": "",
        "python": "python3",
    }
    config = Path(found["rviz"][found["rviz"].index("-d") + 1])
    assert "use_sim_time:=true" in found["rviz"]
    assert "/neurosim/drone/rgb/image_raw" in topics_of(config)
    config.unlink()


def test_simulator_arguments_are_those_of_the_command(fake_launch):
    """The command line that is started is one that `neurosim serve` takes."""
    from neurosim_core.cli import _parser as neurosim_parser

    found = commands(
        run(
            ROOT / "launch" / "simulation.launch.py",
            lockstep="1",
            factor="2",
            record="a",
            controller="path",
            rerun="1",
        )
    )
    for command in found.values():
        neurosim_parser().parse_args(command[3:])


def test_an_argument_that_is_neither_true_nor_false(fake_launch):
    with pytest.raises(ValueError, match="rviz must be true or false, got 'yes please'"):
        run(ROOT / "launch" / "simulation.launch.py", rviz="yes please")
    with pytest.raises(ValueError, match="controller must be hover or path or none, got 'true'"):
        run(ROOT / "launch" / "simulation.launch.py", controller="true")


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_no_launch_file_imports_rclpy(path):
    """They run where only `launch` is installed."""
    allowed = {"__future__", "launch", "launch_ros", "os", "pathlib", "sys", "tempfile", "typing"}
    for node in ast.walk(ast.parse(path.read_text())):
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        names += [node.module] if isinstance(node, ast.ImportFrom) else []
        assert {name.partition(".")[0] for name in names} <= allowed


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_launch_files_run_with_the_real_launch(path):
    """In a ROS installation: the description builds, and its actions come out with default arguments."""
    launch = pytest.importorskip("launch")
    if not hasattr(launch, "LaunchService"):
        pytest.skip("the package `launch` is not that of ROS")
    context = launch.LaunchContext()
    entities = load(path).generate_launch_description().entities
    for entity in entities:
        if isinstance(entity, launch.actions.DeclareLaunchArgument):
            entity.visit(context)
    opaque = next(e for e in entities if isinstance(e, launch.actions.OpaqueFunction))
    actions = opaque.visit(context)
    assert any(isinstance(action, launch.actions.ExecuteProcess) for action in actions)


def topics_of(path):
    """The topics that RViz subscribes to or publishes, with their durability and reliability."""
    manager = yaml.safe_load(path.read_text())["Visualization Manager"]
    entries = [*manager["Displays"], *manager["Tools"]]
    return {entry["Topic"]["Value"]: entry["Topic"] for entry in entries if "Topic" in entry}


DISPLAYS = {
    "nav_msgs/msg/Odometry": "Odometry",
    "nav_msgs/msg/Path": "Path",
    "sensor_msgs/msg/PointCloud2": "PointCloud2",
    "sensor_msgs/msg/Image": "Image",
}


def test_rviz_shows_what_the_bridge_publishes():
    """Every topic has the name, the type and a quality of service that fits its route.

    The cloud of the depth camera is there on request, so its display is off. No tool commands a vehicle: one
    message is no command for longer than `live.command_timeout_s`, and RViz stamps it with another time.
    """
    seen = Seen(
        (
            topic("/drone/odometry", Odometry),
            topic("/drone/path", PathMessage),
            topic("/drone/rgb", Image),
            topic("/drone/depth", Image),
            topic("/drone/events", Events),
        )
    )
    asked = {"routes": [{"cortex": "/drone/depth", "type": "sensor_msgs/PointCloud2"}]}
    routes = {route.ros_topic: route for route in make_routes(seen, settings(asked))[0]}
    path = ROOT / "rviz" / "neurosim.rviz"
    manager = yaml.safe_load(path.read_text())["Visualization Manager"]
    shown = set()
    for entry in [*manager["Displays"], *manager["Tools"]]:
        if "Topic" in entry:
            route = routes[entry["Topic"]["Value"]]
            kind = entry["Class"].rpartition("/")[2]
            assert DISPLAYS[route.ros_type] == kind
            if entry["Topic"]["Durability Policy"] == "Transient Local":
                assert route.qos.durability == "transient_local"
            shown.add(route.ros_type)
    assert shown == set(DISPLAYS)
    assert not any("Topic" in tool for tool in manager["Tools"])
    (cloud,) = [one for one in manager["Displays"] if one["Class"].endswith("/PointCloud2")]
    assert not cloud["Enabled"]
    assert manager["Global Options"]["Fixed Frame"] == "map"
    assert any(display["Class"].endswith("/TF") for display in manager["Displays"])


def test_rviz_for_another_vehicle(fake_launch, tmp_path):
    module = load(ROOT / "launch" / "simulation.launch.py")
    assert Path(module.rviz_config("drone", "")) == ROOT / "rviz" / "neurosim.rviz"
    path = Path(module.rviz_config("alpha", "/sim/"))
    try:
        assert all(name.startswith("/sim/alpha/") for name in topics_of(path))
        assert len(topics_of(path)) == 6
    finally:
        path.unlink()
