"""The ways to the graph: which of them is installed, or was asked for."""

from __future__ import annotations

import importlib.util
from typing import Literal, TypeAlias

from vio.errors import MissingDependencyError, extra_text
from vio.ros2.transport import Transport

TransportName: TypeAlias = Literal["auto", "dds", "rclpy"]


def open_transport(name: TransportName = "auto", domain: int | None = None) -> Transport:
    """Join the graph: with rclpy where ROS 2 is installed, else over DDS.

    Args:
        name: "dds" and "rclpy" choose one.
        domain: the graph's number; None: that of the environment (ROS_DOMAIN_ID), or 0.

    Raises:
        MissingDependencyError: neither is installed, or not the one that is named.
    """
    if name == "rclpy" or (name == "auto" and importlib.util.find_spec("rclpy") is not None):
        from vio.ros2.rclpy_transport import RclpyTransport  # which needs an installed ROS 2

        return RclpyTransport(domain)
    if importlib.util.find_spec("cyclonedds") is None:
        raise MissingDependencyError(
            "ROS 2 needs the package cyclonedds, or an installed ROS 2 whose setup.bash was "
            f"sourced; {extra_text('ros2')}"
        )
    from vio.ros2.dds import DdsTransport  # which needs the extra

    return DdsTransport(domain)
