"""`vio live`: odometry from a camera."""

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
    examples,
    kept_from,
    map_from,
    mavlink_from,
)
from vio.cli.stopping import StopRequest
from vio.errors import VioError


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "live",
        help="odometry from a camera",
        description="Run on a camera until Ctrl-C. SOURCE is v4l2:/dev/video0, a URL as rtsp://…, "
        "video:FILE, "
        "realsense:[SERIAL] (extra realsense) or oak:[ID] (extra oak).",
        **examples(
            "vio live realsense: --view  # with the device's own calibration",
            "vio live v4l2:/dev/video0 --calibration rig.yaml --record kept  # a webcam pair",
            "vio live oak: --mavlink udp:192.168.1.10:14550  # poses to an autopilot",
        ),
    )
    parser.add_argument("source", metavar="SOURCE", help="the camera")
    parser.add_argument(
        "--calibration", type=Path, metavar="FILE", help="in place of the device's own"
    )
    parser.add_argument(
        "--layout",
        choices=("side-by-side", "top-bottom", "single"),
        default="side-by-side",
        help="how the images lie in a video (default side-by-side)",
    )
    parser.add_argument(
        "--target",
        type=Path,
        metavar="FILE",
        help="film this printed board for vio calibrate-rig in place of odometry: says what is "
        "still missing, and stops when nothing is",
    )
    add_settings_arguments(parser)
    parser.add_argument(
        "--record", type=Path, metavar="DIR", help="keep images and samples, for vio run DIR"
    )
    parser.add_argument(
        "--record-as",
        choices=("plain", "rosbag2", "mcap"),
        default="plain",
        help="folder or ROS 2 bag (default plain)",
    )
    add_map_arguments(parser)
    add_mavlink_arguments(parser)
    parser.add_argument(
        "--view", nargs="?", const="spawn", metavar="WHERE", help="show it in rerun (extra view)"
    )


def execute(args: argparse.Namespace) -> int:
    from vio.datasets.rigs import load_rig
    from vio.errors import CalibrationError
    from vio.sources.run import LiveOptions, run_source
    from vio.sources.source import is_recorded, layout_hint, open_source

    args.drop = args.drop or ("block" if is_recorded(args.source) else "oldest")
    if args.target is not None:
        return _film_board(args)
    config = config_from(args)
    map_use = map_from(args)
    mavlink = mavlink_from(args)
    kept = kept_from(args, args.source)
    source = open_source(args.source, args.layout)
    try:
        rig = None
        if args.calibration is not None:
            rig = load_rig(
                args.calibration,
                image_size=source.image_size,
                cameras=1 if args.layout == "single" else 2,
            )
            size = (rig.cam0.width, rig.cam0.height)
            if source.image_size is not None and source.image_size != size:
                raise CalibrationError(layout_hint(args.layout, source.image_size, size))
    except VioError:
        source.close()
        raise
    viewers: list[Any] = []

    outputs = contextlib.ExitStack()

    def show(odometry: Any, rig: Any) -> Any:
        if mavlink is not None:
            from vio.mavlink.output import MavlinkOutput

            outputs.enter_context(MavlinkOutput(odometry, mavlink))
        if args.view is None:
            return None
        from vio.view.live import RerunViewer, ViewedRig
        from vio.view.stream import open_stream

        stream, address = open_stream(args.view, args.source)
        if address is not None:
            print(f"shown at {address}", file=sys.stderr)
        T_cam0_body = odometry.T_cam0_body
        viewers.append(
            RerunViewer(stream, ViewedRig(odometry.camera, T_cam0_body, odometry.motion, None))
        )
        return viewers[0].frame

    with outputs, StopRequest() as asked:
        run = run_source(
            source,
            config,
            rig,
            LiveOptions(kept, args.record, args.record_as, map_use, args.drop),
            should_stop=asked.reason,
            say=lambda line: print(line, file=sys.stderr, flush=True),
            on_start=show,
        )
    for viewer in viewers:
        viewer.close()
    print(run.figures)
    if run.samples:
        print(f"{run.samples} IMU samples")
    return 0


def _film_board(args: argparse.Namespace) -> int:
    """Record a board with guidance, for `vio calibrate-rig`."""
    import shlex

    from vio.sources.board import film_board
    from vio.sources.source import open_source
    from vio.targets.description import read_target

    target = read_target(args.target)
    with StopRequest() as asked:
        lacks = film_board(
            open_source(args.source, args.layout),
            target,
            should_stop=asked.reason,
            say=lambda line: print(line, file=sys.stderr, flush=True),
            record=args.record,
            record_as=args.record_as,
            every_frame=args.drop != "oldest",
        )
    print(lacks)
    if args.record is None:
        print("nothing was kept: give --record DIR to calibrate by these views")
    else:
        folder = shlex.quote(str(args.record))
        print(f"next: vio calibrate-rig {folder} --target {shlex.quote(str(args.target))}")
    return 0
