"""The backend that a user names, or that fits this machine."""

from __future__ import annotations

import importlib
import importlib.util
import logging
from pathlib import Path

from cortex_ros2_bridge.backend.base import Backend, BackendError
from cortex_ros2_bridge.backend.names import check_kind

_log = logging.getLogger(__name__)

INSTALL = "pip install 'cyclonedds>=11,<12' (no wheels for Python 3.14 and ARM Linux: source a ROS there)"


def open_backend(
    kind: str | Path,
    *,
    node_name: str = "cortex_bridge",
    namespace: str = "",
    distro: str | None = None,
    domain: int | None = None,
) -> Backend:
    """Open the way to ROS 2.

    Args:
        kind: "rclpy": through the ROS 2 installation whose setup file was sourced; "dds": without one;
            "auto": the first of these that is there; a path that ends in ".mcap": a bag, in the directory of
            that name.
        node_name: Name of the node that others see.
        namespace: Namespace of the node.
        distro: Distribution of ROS, such as "humble"; None: ROS_DISTRO, else what is found out.
        domain: DDS domain; None: ROS_DOMAIN_ID, else 0.

    Raises:
        ValueError: The kind is unknown, or a name or the environment is not valid.
        BackendError: The backend is not installed, or does not start.
    """
    if isinstance(kind, Path) or kind.endswith(".mcap"):
        from cortex_ros2_bridge.backend.bag import BagBackend

        return BagBackend(kind, distro=distro)
    check_kind(kind)
    if kind == "rclpy" or (kind == "auto" and _has_rclpy()):
        if not _has_rclpy():
            raise BackendError(
                "rclpy cannot be imported: source the setup file of a ROS 2 installation, in the Python that "
                "belongs to it, or use the backend 'dds', which needs none"
            )
        from cortex_ros2_bridge.backend.rclpy_ import RclpyBackend

        if distro is not None:
            _log.warning("--distro %s has no effect: rclpy speaks for the distribution it is of", distro)
        return RclpyBackend(node_name=node_name, namespace=namespace, domain=domain)
    if importlib.util.find_spec("cyclonedds") is None:
        raise BackendError(f"neither rclpy nor cyclonedds is installed: {INSTALL}")
    from cortex_ros2_bridge.backend.dds import DdsBackend

    return DdsBackend(node_name=node_name, namespace=namespace, distro=distro, domain=domain)


def _has_rclpy() -> bool:
    """Return whether rclpy imports: a workspace of another Python shows it, but its library does not load."""
    try:
        importlib.import_module("rclpy")
    except ImportError:
        return False
    return True
