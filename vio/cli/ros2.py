"""`vio ros2`: a ROS 2 node, with or without ROS installed."""

from __future__ import annotations

import argparse
import contextlib
import sys
from pathlib import Path
from typing import Any

from vio.cli.arguments import (
    add_map_arguments,
    add_mavlink_arguments,
    add_settings_arguments,
    config_from,
    kept_from,
    map_from,
    mavlink_from,
)
from vio.cli.stopping import StopRequest
from vio.errors import ConfigError


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "ros2",
        help="odometry as a ROS 2 node (extra ros2)",
        description="Subscribe to images and IMU, and publish odometry, /tf, path, landmarks and "
        "/diagnostics, until "
        "Ctrl-C. Uses rclpy where ROS 2 is installed, else DDS directly.",
    )
    parser.add_argument(
        "--left", required=True, metavar="TOPIC", help="left or only camera; Image or …/compressed"
    )
    parser.add_argument(
        "--right", metavar="TOPIC", help="right camera; without it, one camera and its IMU"
    )
    parser.add_argument("--imu", metavar="TOPIC", help="IMU; without it, images alone")
    parser.add_argument(
        "--calibration", type=Path, metavar="FILE", help="default: CameraInfo and /tf_static"
    )
    add_settings_arguments(parser)
    add_map_arguments(parser)
    add_mavlink_arguments(parser)
    parser.add_argument("--prefix", default="/vio", help="of the published topics (default /vio)")
    parser.add_argument(
        "--frames",
        default="map,odom,base_link",
        metavar="A,B,C",
        help="(default map,odom,base_link)",
    )
    parser.add_argument("--no-tf", action="store_true", help="do not publish /tf")
    add_transport_arguments(parser, "needs reliable publishers, and loses nothing")


def add_transport_arguments(parser: argparse.ArgumentParser, reliable: str) -> None:
    """Add the options of the way to the graph; `reliable` says what that quality does."""
    parser.add_argument("--reliable", action="store_true", help=f"reliable transport: {reliable}")
    parser.add_argument(
        "--transport", choices=("auto", "dds", "rclpy"), default="auto", help="way to the graph"
    )
    parser.add_argument(
        "--domain", type=int, metavar="N", help="of DDS (default: ROS_DOMAIN_ID, or 0)"
    )


def execute(args: argparse.Namespace) -> int:
    from vio.datasets.rigs import load_rig
    from vio.ros2.node import NodeSettings, run_node
    from vio.ros2.opening import open_transport
    from vio.ros2.outputs import FrameNames
    from vio.ros2.sensors import SensorTopics

    config = config_from(args)
    map_use = map_from(args)
    mavlink = mavlink_from(args)
    names = args.frames.split(",")
    if len(names) != 3 or not all(names):
        raise ConfigError(f"--frames {args.frames}: give three names, map,odom,base")
    if args.right is None and args.imu is None:
        raise ConfigError("one camera needs an IMU; give --imu TOPIC, or --right TOPIC")
    rig = (
        None
        if args.calibration is None
        else load_rig(args.calibration, cameras=1 if args.right is None else 2)
    )
    topics = SensorTopics(args.left, args.right, args.imu)
    settings = NodeSettings(
        topics,
        FrameNames(*names),
        args.prefix.rstrip("/"),
        "reliable" if args.reliable else "sensor",
        args.drop or "oldest",
        not args.no_tf,
        kept_from(args, " ".join(topics.kinds)),
        map_use,
        mavlink,
    )

    def say(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    with (
        contextlib.closing(open_transport(args.transport, args.domain)) as transport,
        StopRequest() as asked,
    ):
        run_node(transport, settings, config, rig, should_stop=asked.reason, say=say)
    return 0
