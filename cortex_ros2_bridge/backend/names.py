"""Names of topics, services and types in ROS 2, and what they are called in DDS."""

from __future__ import annotations

import re

NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_TYPE = re.compile(r"([A-Za-z][A-Za-z0-9_]*)/(msg|srv)/([A-Za-z][A-Za-z0-9_]*)")
_DDS_TYPE = re.compile(r"([A-Za-z0-9_]+)::(msg|srv)::dds_::([A-Za-z0-9_]+)_")

TOPIC_PREFIX = "rt"
REQUEST_PREFIX = "rq"
REPLY_PREFIX = "rr"


def check_name(name: str) -> str:
    """Return an absolute ROS name.

    Raises:
        ValueError: ROS does not allow it.
    """
    if not NAME.fullmatch(name) or "__" in name:
        raise ValueError(
            f"invalid ROS name {name!r}: it must look like '/drone/imu', of letters, digits and single '_', "
            "and no part may begin with a digit"
        )
    return name


def check_kind(backend: str) -> str:
    """Return the name of a backend, or that of a bag.

    Raises:
        ValueError: It is neither.
    """
    if backend not in ("auto", "rclpy", "dds") and not backend.endswith(".mcap"):
        raise ValueError(f"a backend is auto, rclpy, dds or a path that ends in .mcap, got {backend!r}")
    return backend


def check_node_name(name: str, namespace: str) -> tuple[str, str]:
    """Return a node's name and its namespace, which is "/" for an empty one.

    Raises:
        ValueError: ROS does not allow them.
    """
    check_name(f"/{name}")
    namespace = "/" + namespace.strip("/")
    return name, namespace if namespace == "/" else check_name(namespace)


def split_type(type_name: str) -> tuple[str, str, str]:
    """Return ("sensor_msgs", "msg", "Imu") for "sensor_msgs/msg/Imu".

    Raises:
        ValueError: That is no name of a type.
    """
    match = _TYPE.fullmatch(type_name)
    if match is None:
        raise ValueError(f"invalid ROS type {type_name!r}: it must look like 'sensor_msgs/msg/Imu'")
    return match.group(1), match.group(2), match.group(3)


def ros_topic(dds_topic: str) -> str | None:
    """Return the ROS name of a DDS topic; None if it is none of a ROS topic (a service, say)."""
    prefix = TOPIC_PREFIX + "/"
    return dds_topic[len(prefix) - 1 :] if dds_topic.startswith(prefix) else None


def ros_type(dds_type: str) -> str:
    """Return the ROS name of a DDS type; other types keep their name."""
    match = _DDS_TYPE.fullmatch(dds_type)
    return "/".join(match.groups()) if match else dds_type


def dds_type_of(type_name: str) -> str:
    """Return what DDS calls a ROS type: sensor_msgs/msg/Imu is sensor_msgs::msg::dds_::Imu_."""
    package, kind, name = split_type(type_name)
    return f"{package}::{kind}::dds_::{name}_"


def service_path(name: str) -> str:
    """Return what a service of a type is called: set_parameters for SetParameters."""
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in name).strip("_")
