"""`vio eval`: one trajectory against another."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from vio.cli.run import lengths


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = commands.add_parser(
        "eval",
        help="compare a trajectory with a reference",
        description="Compare a trajectory, or a run's folder, with a reference: ATE, RPE and KITTI drift. Files in "
        "TUM, KITTI or EuRoC form; a reference in KITTI form is associated by frame number, others by time.",
    )
    parser.add_argument("estimate", type=Path, metavar="EST", help="a trajectory file or a run's folder")
    parser.add_argument("reference", type=Path, metavar="REF", help="a trajectory file or a run's folder")
    parser.add_argument("--align", choices=("se3", "sim3", "none"), default="se3", help="alignment (default se3)")
    parser.add_argument("--lengths", type=lengths, metavar="M,M", help="path lengths of the drift (default 100,…,800)")
    parser.add_argument(
        "--max-time-difference",
        type=float,
        default=0.01,
        metavar="S",
        help="association by time, seconds (default 0.01)",
    )
    parser.add_argument("--extrinsics", type=Path, metavar="F", help="T_cam0_imu, 3 or 4 rows of 4 numbers")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(execute=execute)


def execute(args: argparse.Namespace) -> int:
    """Run the subcommand."""
    import json

    from vio.evaluation import KITTI_LENGTHS_M, evaluate
    from vio.run_folder import read_run

    estimate, T_cam0_imu = read_run(args.estimate)
    reference, other = read_run(args.reference)
    if args.extrinsics is not None:
        from vio.datasets.kitti import read_extrinsics
        from vio.errors import DataError

        T_cam0_imu = read_extrinsics(args.extrinsics)
        if T_cam0_imu is None:
            raise DataError(f"{args.extrinsics} does not exist; give a file with T_cam0_imu, 3 or 4 rows of 4 numbers")
    result = evaluate(
        estimate,
        reference,
        align=args.align,
        max_time_difference_s=args.max_time_difference,
        T_cam0_imu=other if T_cam0_imu is None else T_cam0_imu,
        lengths_m=args.lengths or KITTI_LENGTHS_M,
    )
    scores = result.as_dict()
    if args.json:
        print(json.dumps(scores))
    else:
        for key, value in scores.items():
            if not isinstance(value, (list, dict)):
                print(f"{key:<22} {'–' if value is None else value if isinstance(value, str) else f'{value:.6g}'}")
    return 0
