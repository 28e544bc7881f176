"""`vio play`: a recording, published to a ROS 2 graph as a robot's drivers would."""

from __future__ import annotations

import argparse
import contextlib
from typing import Any

from vio.cli.ros2 import add_transport_arguments
from vio.cli.stopping import StopRequest
from vio.errors import ConfigError


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "play",
        help="publish a recording to ROS 2 (extra ros2)",
        description="Publish the rectified images of a recording with their CameraInfo, its IMU "
        "samples and the IMU's "
        "pose on /tf_static, once somebody subscribes.",
    )
    parser.add_argument(
        "source", metavar="SOURCE", help="a recording: folder or file, or kind:path"
    )
    parser.add_argument(
        "--ros2",
        action="store_true",
        required=True,
        help="to a ROS 2 graph; there is no other way yet",
    )
    parser.add_argument(
        "--left", default="/cam0/image_raw", metavar="TOPIC", help="(default /cam0/image_raw)"
    )
    parser.add_argument(
        "--right", default="/cam1/image_raw", metavar="TOPIC", help="(default /cam1/image_raw)"
    )
    parser.add_argument("--imu", default="/imu0", metavar="TOPIC", help="(default /imu0)")
    parser.add_argument(
        "--rate", default="1", metavar="X", help="times real time, or max (default 1)"
    )
    parser.add_argument("--stop", type=int, metavar="N", help="frame after the last one")
    parser.add_argument("--now", action="store_true", help="do not wait for a subscriber")
    add_transport_arguments(parser, "waits for slow subscribers")


def execute(args: argparse.Namespace) -> int:
    from vio.datasets import open_dataset
    from vio.ros2.opening import open_transport
    from vio.ros2.play import Playing, play
    from vio.ros2.sensors import SensorTopics

    rate = _rate(args.rate)
    dataset = open_dataset(args.source)
    with (
        contextlib.closing(open_transport(args.transport, args.domain)) as transport,
        StopRequest() as asked,
    ):
        played = play(
            transport,
            dataset,
            SensorTopics(args.left, args.right, args.imu),
            Playing(
                rate,
                "reliable" if args.reliable else "sensor",
                wait=not args.now,
                stop=args.stop,
            ),
            asked.reason,
        )
    print(f"{played.frames} frames and {played.samples} IMU samples published")
    return 0


def _rate(text: str) -> float | None:
    """Return a rate over real time; None: as fast as it goes."""
    if text == "max":
        return None
    try:
        rate = float(text)
    except ValueError as error:
        raise ConfigError(f"--rate {text}: give a number, or max") from error
    if not 0 < rate < float("inf"):
        raise ConfigError(f"--rate {text}: give a positive number, or max")
    return rate
