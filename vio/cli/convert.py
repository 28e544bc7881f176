"""`vio convert`: write a recording as an EuRoC, KITTI or plain folder."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from vio.cli.arguments import add_config_arguments, bound, config_from

MARKER = "conversion.json"


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = commands.add_parser(
        "convert",
        help="write a recording in another format",
        description="Write any recording of images, such as a ROS bag or two videos, as an EuRoC, a KITTI or a plain "
        "folder: frame by frame, rectified as a run sees them, with IMU, velocities and ground truth.",
    )
    parser.add_argument("source", metavar="SOURCE", help="a recording: folder or file, or kind:path")
    parser.add_argument("--to", choices=("euroc", "kitti", "plain"), required=True, help="form of the folder")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write (atomically)")
    parser.add_argument("--start", type=bound, default=0, metavar="N", help="first frame, or time such as 12s")
    parser.add_argument("--stop", "--end", type=bound, metavar="N", help="frame after the last one, or time")
    add_config_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(execute=execute)


def execute(args: argparse.Namespace) -> int:
    """Run the subcommand."""
    import json
    import logging
    from dataclasses import replace

    from vio.atomic import atomic_folder
    from vio.cli.output import print_result
    from vio.cli.progress import ProgressBar
    from vio.datasets import open_dataset
    from vio.datasets.span import frames_between
    from vio.offline.convert import convert
    from vio.text_files import write_text

    log = logging.getLogger(__name__)
    dataset = open_dataset(args.source, replace(config_from(args).dataset, projection="pinhole"))
    recording = dataset.recording
    for note in recording.notes:
        log.warning("%s", note)
    start, stop = frames_between(recording, args.start, args.stop)
    with atomic_folder(args.out, replace=True, marker=MARKER) as folder:
        with ProgressBar(f"convert {recording.path.name}") as bar:
            done = convert(dataset, folder, args.to, start=start, stop=stop, progress=bar.update)
        facts = {
            "source": recording.path.absolute().name,
            "kind": recording.kind,
            "form": args.to,
            "frames": done.frames,
            "imu_samples": done.imu_samples,
            "velocities": done.velocities,
            "notes": list(done.notes),
        }
        write_text(folder / MARKER, json.dumps(facts, indent=2) + "\n")
    rows = [("folder", str(args.out)), ("form", args.to), ("frames", f"{done.frames}")]
    rows += [("samples", f"{done.imu_samples} of the IMU, {done.velocities} velocities")]
    rows += [("note", note) for note in done.notes]
    return print_result({"out": str(args.out), **facts}, rows, as_json=args.json)
