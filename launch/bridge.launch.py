"""The bridge between Cortex and ROS 2.

    ros2 launch neurosim bridge.launch.py namespace:=/neurosim config:=bridge.yaml

`ros2 launch neurosim bridge.launch.py --show-args` explains the arguments. Nothing here imports rclpy.
"""

from __future__ import annotations

import sys
from typing import Any

from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription

ARGUMENTS = {
    "config": ("", "settings of the bridge (YAML); none: all standard topics"),
    "namespace": ("", "goes before all ROS topics but /clock, /tf, /tf_static and /diagnostics"),
    "backend": ("auto", "auto, rclpy or dds; or the name of a bag to write, such as run.mcap"),
    "distro": ("", "ROS distribution for the backend dds; none: ROS_DISTRO"),
    "python": (sys.executable, "the Python that neurosim is installed for"),
}
"""Defaults and explanations."""


def actions(context: Any) -> list[Any]:
    """Return the processes for the given arguments."""
    values = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    command = [values["python"], "-m", "cortex_ros2_bridge", "--backend", values["backend"]]
    for name in ("config", "namespace", "distro"):
        if values[name]:
            command += [f"--{name}", values[name]]
    return [ExecuteProcess(cmd=command, name="cortex_bridge", output="screen")]


def generate_launch_description() -> LaunchDescription:
    """Return what `ros2 launch` runs."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=actions)])
