"""`vio convert`: write a recording as a folder or bag of another form, or a trajectory as
another file.
"""

from __future__ import annotations

import argparse
import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

from vio.cli.arguments import add_config_arguments, add_span_arguments, config_from
from vio.cli.output import ProgressBar, print_result
from vio.errors import NOTE, ConfigError

MARKER = "conversion.json"
_FORMS = ("euroc", "kitti", "plain", "rosbag2", "mcap", "spectacularai")
_TRAJECTORIES = ("tum", "kitti", "euroc")
_TEXTS = (".txt", ".csv", ".log", ".tum")  # of poses in forms that their first line does not tell


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "convert",
        help="write a recording or a trajectory in another format",
        description="Write any recording of images, such as a ROS bag or two videos, as an EuRoC, "
        "a KITTI or a plain "
        "folder, as a ROS 2 bag, or for the SDK of Spectacular AI: frame by frame, rectified as a "
        "run sees them, with IMU, "
        "velocities and ground "
        "truth. Write a trajectory file (TUM, KITTI, EuRoC) in another of these forms; --to tum "
        "writes a recording's "
        "ground truth.",
    )
    parser.add_argument(
        "source", metavar="SOURCE", help="a recording (folder, file or kind:path), or a trajectory"
    )
    parser.add_argument("--to", choices=(*_FORMS, "tum"), required=True, help="form of the output")
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="OUT",
        help="folder or file to write (atomically)",
    )
    parser.add_argument(
        "--times", type=Path, metavar="FILE", help="times of a KITTI trajectory, one a line"
    )
    add_span_arguments(parser)
    add_config_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def execute(args: argparse.Namespace) -> int:
    holds_poses = _is_trajectory(Path(args.source))
    if args.to == "tum" or holds_poses:
        return _trajectory(args, holds_poses=holds_poses)
    return _recording(args)


def _is_trajectory(path: Path) -> bool:
    """Return whether a file, or a folder of matrices, holds poses in any form that is read."""
    from vio.errors import DataError
    from vio.files.pose_matrices import are_matrix_files
    from vio.files.trajectories import is_trajectory_file, read_trajectory

    if path.is_dir():
        return are_matrix_files(path)
    if is_trajectory_file(path):
        return True
    if not path.is_file() or path.suffix.lower() not in _TEXTS:
        return False
    try:
        read_trajectory(path)
    except DataError:
        return False
    return True


def _trajectory(args: argparse.Namespace, *, holds_poses: bool) -> int:
    """Write a trajectory, or the ground truth of a recording, which holds more than poses."""
    from vio.datasets import open_dataset
    from vio.files.atomic import check_new_file
    from vio.offline.convert_trajectory import convert_trajectory, write_reference

    source = Path(args.source)
    config = config_from(args)
    if args.start or args.stop is not None:
        raise ConfigError(
            "--start and --end choose frames of a recording to convert, not poses; leave them out"
        )
    check_new_file(args.out)
    if not holds_poses:
        written = write_reference(open_dataset(args.source, config.dataset), args.out)
    elif args.to in _TRAJECTORIES:
        calibration = config.dataset.calibration
        written = convert_trajectory(
            source, args.out, args.to, times=args.times, calibration=calibration
        )
    else:
        raise ConfigError(
            f"{source} is a trajectory: choose --to {', '.join(_TRAJECTORIES)}, not {args.to}"
        )
    facts = {"out": str(args.out), "form": args.to, "poses": len(written), "body": written.body}
    rows = [
        ("file", str(args.out)),
        ("form", args.to),
        ("poses", f"{len(written)} of {written.body}"),
    ]
    return print_result(facts, rows, as_json=args.json)


def _recording(args: argparse.Namespace) -> int:
    """Write a recording."""
    from vio.datasets import open_dataset
    from vio.datasets.frame_times import frames_between
    from vio.files.atomic import atomic_folder, check_spares
    from vio.files.text import write_text
    from vio.offline.convert import convert
    from vio.records import need_stereo

    log = logging.getLogger(__name__)
    dataset = open_dataset(args.source, replace(config_from(args).dataset, projection="pinhole"))
    recording = dataset.recording
    need_stereo(recording, "vio convert")
    for note in recording.notes:
        log.log(NOTE, "%s", note)
    start, stop = frames_between(recording, args.start, args.stop)
    check_spares(recording.path, args.out)
    with atomic_folder(args.out, replace=True, marker=MARKER, own=_written(args.out)) as folder:
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
            "files": sorted({MARKER, *(child.name for child in folder.iterdir())}),
        }
        write_text(folder / MARKER, json.dumps(facts, indent=2) + "\n")
    rows = [
        ("folder", str(args.out)),
        ("form", args.to),
        ("frames", f"{done.frames}"),
    ]
    rows += [("samples", f"{done.imu_samples} of the IMU, {done.velocities} velocities")]
    rows += [("note", note) for note in done.notes]
    return print_result({"out": str(args.out), **facts}, rows, as_json=args.json)


def _written(out: Path) -> list[str] | None:
    """Return the names that an earlier conversion wrote into a folder.

    None: there is none, or it is not known.
    """
    try:
        files = json.loads((out / MARKER).read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if not isinstance(files, list):
        return None
    return [str(name) for name in files]
