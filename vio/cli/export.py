"""`vio export`: conversion of a run to the formats of other programs."""

from __future__ import annotations

import argparse
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Any

from vio.cli.output import ProgressBar, print_result
from vio.errors import ConfigError
from vio.files.printable import json_text

MARKER = "export.json"


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "export",
        help="write a run for COLMAP and nerfstudio, or for RViz and Foxglove",
        description="Write the keyframes of a run (of `vio run --save-observations`) as a metric "
        "COLMAP model: "
        "sparse/0 with cameras, rig, poses, and points with tracks and colours; images/; "
        "nerfstudio's transforms.json "
        "with points.ply. Or write any run as a ROS 2 bag: /tf, poses with covariance, path, "
        "landmarks, ground truth.",
    )
    parser.add_argument(
        "form",
        choices=("colmap", "rosbag2", "mcap"),
        metavar="FORM",
        help="colmap, rosbag2 or mcap",
    )
    parser.add_argument(
        "run", type=Path, metavar="RUN", help="a run's folder, for colmap with observations.npz"
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder to write (default RUN/FORM)"
    )
    parser.add_argument("--refined", action="store_true", help="use the poses of `vio refine`")
    parser.add_argument(
        "--keyframes",
        type=int,
        metavar="N",
        help="largest number of keyframes (default: as needed)",
    )
    parser.add_argument(
        "--source",
        metavar="SOURCE",
        help="current path of the recording (default: as stored in the run)",
    )
    parser.add_argument(
        "--no-images", action="store_true", help="do not write the rectified images"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def execute(args: argparse.Namespace) -> int:
    if args.form == "colmap":
        return _colmap(args)
    return _bag(args)


def _bag(args: argparse.Namespace) -> int:
    from vio.files.atomic import atomic_folder
    from vio.offline.export_bag import export_bag

    if args.refined or args.keyframes is not None or args.source is not None or args.no_images:
        raise ConfigError(
            "--refined, --keyframes, --source and --no-images are for colmap; leave them out"
        )
    out = args.out or args.run / args.form
    with atomic_folder(out, replace=True, marker=MARKER) as folder:
        done = export_bag(args.run, folder, args.form)
        facts = {"out": str(out), "of": str(args.run), **asdict(done)}
        (folder / MARKER).write_text(json_text(facts, indent=2) + "\n", encoding="utf-8")
    rows = [
        ("folder", str(out)),
        ("poses", f"{done.poses}, of the ground truth {done.reference_poses}"),
    ]
    return print_result(facts, [*rows, ("points", f"{done.points}")], as_json=args.json)


def _colmap(args: argparse.Namespace) -> int:
    from vio.files.atomic import atomic_folder
    from vio.numerics.threads import one_blas_thread
    from vio.offline.colmap import quiet
    from vio.offline.export import export_colmap
    from vio.offline.saved_run import read_saved_run, with_poses

    if args.keyframes is not None and args.keyframes < 2:
        raise ConfigError("--keyframes must be at least 2")
    quiet()
    run = read_saved_run(args.run)
    if args.refined:
        run = with_poses(run, args.run / "refined")
    out = args.out or args.run / "colmap"
    with (
        one_blas_thread(),
        ProgressBar(f"export {args.run.name}") as bar,
        atomic_folder(out, replace=True, marker=MARKER) as folder,
    ):
        done = export_colmap(
            run,
            folder,
            most=args.keyframes,
            images=not args.no_images,
            source=args.source,
            progress=bar.update,
        )
        facts = {
            "out": str(out),
            "of": str(args.run),
            "source": run.source,
            "poses": "refined" if args.refined else "map" if run.tracked.loops else "filter",
            **asdict(done),
        }
        (folder / MARKER).write_text(json_text(facts, indent=2) + "\n", encoding="utf-8")
    rows = (
        ("folder", str(out)),
        ("keyframes", f"{done.keyframes} stereo pairs, {done.images} images written"),
        ("points", f"{done.points}, {done.loop_points} of them across {done.loops} loops"),
        (
            "residual",
            f"{done.mean_reprojection_error_px:.3f} px mean reprojection error, as COLMAP computes "
            "it",
        ),
        ("next", f"ns-train splatfacto --data {shlex.quote(str(out))}"),
        (
            "",
            f"gsplat: python examples/simple_trainer.py default --data_dir {shlex.quote(str(out))} "
            "--data_factor 1",
        ),
    )
    return print_result(facts, rows, as_json=args.json)
