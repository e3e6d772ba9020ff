"""The simulator, the bridge to ROS 2 and, if wanted, a controller, RViz and Rerun.

    ros2 launch neurosim simulation.launch.py scene:=house.yaml rviz:=true

The vehicle hovers until somebody commands it; `controller:=path` flies its path.

`ros2 launch neurosim simulation.launch.py --show-args` explains the arguments. When the simulator ends, all
ends. Nothing here imports rclpy.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path
from typing import Any

from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    IncludeLaunchDescription,
    OpaqueFunction,
    Shutdown,
)
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription

PYTHON = f"{os.environ['VIRTUAL_ENV']}/bin/python" if "VIRTUAL_ENV" in os.environ else sys.executable
"""That of the virtual environment that is active: `ros2` itself runs in that of ROS."""
ARGUMENTS = {
    "scene": ("", "settings of the simulation (YAML): scene, vehicle, sensors; none: a generated apartment"),
    "lockstep": ("false", "wait for the command of every control period instead of running in real time"),
    "factor": ("", "how much faster than real time; none: as in the settings"),
    "record": ("", "directory to record everything to"),
    "controller": (
        "hover",
        "hover: hover until the first command; path: fly the path; none: time begins with the first command",
    ),
    "namespace": ("", "goes before all ROS topics but /clock, /tf, /tf_static and /diagnostics"),
    "bridge_config": ("", "settings of the bridge (YAML); none: all standard topics"),
    "params_file": ("", "ROS parameters of the bridge (YAML)"),
    "backend": ("auto", "of the bridge: auto, rclpy or dds"),
    "distro": ("", "ROS distribution for the backend dds; none: ROS_DISTRO"),
    "rviz": ("false", "open RViz"),
    "rviz_config": ("", "what RViz shows; none: images, events, tf, trail and points of `vehicle`"),
    "vehicle": ("drone", "the vehicle that RViz shows"),
    "rerun": ("false", "open Rerun"),
    "python": (PYTHON, "the Python that neurosim is installed for"),
}
"""Defaults and explanations."""

BRIDGE = ("namespace", "params_file", "backend", "distro", "python")
"""Arguments that the bridge has, too."""
CONTROLLERS = ("hover", "path", "none")

HERE = Path(__file__).resolve().parent
RVIZ_CONFIG = HERE.parent / "rviz" / "neurosim.rviz"


def actions(context: Any) -> list[Any]:
    """Return the processes for the given arguments."""
    values = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    neurosim = [values["python"], "-m", "neurosim_core"]
    serve = [*neurosim, "serve", *([values["scene"]] if values["scene"] else [])]
    serve += ["--lockstep"] if _is_true("lockstep", values) else []
    serve += ["--factor", values["factor"]] if values["factor"] else []
    serve += ["--record", values["record"]] if values["record"] else []
    if values["controller"] not in CONTROLLERS:
        raise ValueError(f"controller must be {' or '.join(CONTROLLERS)}, got {values['controller']!r}")
    serve += ["--set", "live.begin=hover"] if values["controller"] == "hover" else []
    found: list[Any] = [
        ExecuteProcess(
            cmd=serve, name="simulator", output="screen", on_exit=Shutdown(reason="the simulator has ended")
        ),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(HERE / "bridge.launch.py")),
            launch_arguments={
                "config": values["bridge_config"],
                **{name: values[name] for name in BRIDGE},
            }.items(),
        ),
    ]
    if values["controller"] == "path":
        found.append(ExecuteProcess(cmd=[*neurosim, "fly"], name="controller", output="screen"))
    if _is_true("rerun", values):
        found.append(ExecuteProcess(cmd=[*neurosim, "view"], name="rerun", output="screen"))
    if _is_true("rviz", values):
        config = values["rviz_config"] or rviz_config(values["vehicle"], values["namespace"])
        command = ["rviz2", "-d", config, "--ros-args", "-p", "use_sim_time:=true"]
        found.append(ExecuteProcess(cmd=command, name="rviz", output="screen"))
    return found


def rviz_config(vehicle: str, namespace: str) -> str:
    """Return the file that shows a vehicle whose topics have a namespace."""
    prefix = f"/{namespace.strip('/')}" if namespace.strip("/") else ""
    if vehicle == "drone" and not prefix:
        return str(RVIZ_CONFIG)
    text = RVIZ_CONFIG.read_text(encoding="utf-8")
    text = text.replace(" /drone/", f" {prefix}/{vehicle}/").replace(" drone/", f" {vehicle}/")
    with tempfile.NamedTemporaryFile("w", prefix="neurosim-", suffix=".rviz", delete=False) as file:
        file.write(text)
    return file.name


def generate_launch_description() -> LaunchDescription:
    """Return what `ros2 launch` runs."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=actions)])


def _is_true(name: str, values: dict[str, str]) -> bool:
    """Return what an argument says.

    Raises:
        ValueError: It says neither.
    """
    text = values[name].lower()
    if text not in ("true", "1", "false", "0"):
        raise ValueError(f"{name} must be true or false, got {values[name]!r}")
    return text in ("true", "1")
