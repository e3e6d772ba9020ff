"""The bridge between Cortex and ROS 2.

    ros2 launch neurosim bridge.launch.py namespace:=/neurosim config:=bridge.yaml

`ros2 launch neurosim bridge.launch.py --show-args` explains the arguments. It is a ROS node, so that
`PushRosNamespace`, `SetRemap` and `SetParameter` around an include of this file hold for it. Nothing here
imports rclpy itself.
"""

from __future__ import annotations

import os
import sys
from typing import Any

from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription

try:
    from launch_ros.actions import Node
except ImportError:  # launch alone: names can then be set by arguments only
    Node = None

PYTHON = f"{os.environ['VIRTUAL_ENV']}/bin/python" if "VIRTUAL_ENV" in os.environ else sys.executable
"""That of the virtual environment that is active: `ros2` itself runs in that of ROS."""
ARGUMENTS = {
    "config": ("", "settings of the bridge (YAML); none: all standard topics"),
    "params_file": ("", "ROS parameters of the bridge (YAML); they win over `config`"),
    "namespace": ("", "goes before all ROS topics but /clock, /tf, /tf_static and /diagnostics"),
    "backend": ("auto", "auto, rclpy or dds; or the name of a bag to write, such as run.mcap"),
    "distro": ("", "ROS distribution for the backend dds; none: ROS_DISTRO"),
    "autostart": ("true", "false: it waits until ROS configures and activates it, as a managed node"),
    "python": (PYTHON, "the Python that neurosim is installed for"),
}
"""Defaults and explanations."""


def actions(context: Any) -> list[Any]:
    """Return the processes for the given arguments."""
    values = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    arguments = ["-m", "cortex_ros2_bridge", "--backend", values["backend"]]
    for name in ("config", "distro"):
        if values[name]:
            arguments += [f"--{name}", values[name]]
    waits = [{"autostart": False}] if values["autostart"].lower() in ("false", "0") else []
    if Node is not None:
        node = Node(
            executable=values["python"],
            arguments=arguments,
            name="cortex_bridge",
            namespace=values["namespace"],
            parameters=[*([values["params_file"]] if values["params_file"] else []), *waits],
            output="screen",
        )
        return [node]
    if values["namespace"]:
        arguments += ["--namespace", values["namespace"]]
    ros = ["--params-file", values["params_file"]] if values["params_file"] else []
    ros += ["-p", "autostart:=false"] if waits else []
    arguments += ["--ros-args", *ros] if ros else []
    return [ExecuteProcess(cmd=[values["python"], *arguments], name="cortex_bridge", output="screen")]


def generate_launch_description() -> LaunchDescription:
    """Return what `ros2 launch` runs."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=actions)])
