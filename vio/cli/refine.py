"""`vio refine`: bundle adjustment over a run's keyframes."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vio.cli.output import ProgressBar, print_result
from vio.errors import ConfigError
from vio.files.printable import json_text

if TYPE_CHECKING:
    from vio.offline.refine import Refinement
    from vio.offline.saved_run import SavedRun

FOLDER = "refined"


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "refine",
        help="bundle-adjust a run",
        description="Bundle-adjust the keyframes of a run (of `vio run --save-observations`) with "
        "the run's own "
        "tracks, the matches of its loops and a fixed stereo rig, and write the refined trajectory "
        "and map to "
        "RUN/refined, which `vio eval` and `vio export` read like a run.",
    )
    parser.add_argument(
        "run", type=Path, metavar="RUN", help="a run's folder with observations.npz"
    )
    parser.add_argument(
        "--keyframes",
        type=int,
        metavar="N",
        help="largest number of keyframes (default: as needed)",
    )
    parser.add_argument(
        "--priors",
        choices=("none", "filter"),
        default="none",
        help="use the filter's camera positions and covariances as priors (replays the filter; "
        "default none)",
    )
    parser.add_argument(
        "--imu",
        action="store_true",
        help="take in the IMU, and find what the rig is off by, scale included",
    )
    parser.add_argument(
        "--threads", type=int, default=1, metavar="N", help="of the solver (default 1: repeatable)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def execute(args: argparse.Namespace) -> int:
    from vio.numerics.threads import one_blas_thread
    from vio.offline.colmap import quiet
    from vio.offline.refine import STEPS, refine_run
    from vio.offline.saved_run import read_saved_run

    if args.threads < 1 or (args.keyframes is not None and args.keyframes < 2):
        raise ConfigError("--threads must be at least 1 and --keyframes at least 2")
    quiet()
    run = read_saved_run(args.run)
    began = time.perf_counter()
    with one_blas_thread(), ProgressBar(f"refine {args.run.name}") as bar:
        bar.update(0, STEPS + 1)
        done = refine_run(
            run,
            most=args.keyframes,
            priors=args.priors == "filter",
            threads=args.threads,
            progress=lambda step: bar.update(step, STEPS + 1),
            imu=args.imu,
        )
        metrics = {
            "out": str(args.run / FOLDER),
            "of": str(args.run),
            **_facts(run, done),
            "seconds": time.perf_counter() - began,
            "T_cam0_imu": run.T_cam0_imu.tolist(),
        }
        _write(args.run / FOLDER, run, done, metrics)
        bar.update(STEPS + 1, STEPS + 1)
    return print_result(metrics, _rows(metrics), as_json=args.json)


def _facts(run: SavedRun, done: Refinement) -> dict[str, Any]:
    return {
        **{key: run.metrics[key] for key in ("source", "kind", "body")},
        "frames": len(done.trajectory),
        "keyframes": len(done.keyframes),
        "loops": done.loops,
        "frames_aligned_to_points": done.aligned,
        "points": len(done.adjustment.tracks.ids),
        "rows": len(done.adjustment.tracks.point),
        "rows_dropped": done.adjustment.rows_dropped,
        "rms_before_px": done.adjustment.rms_before_px,
        "rms_after_px": done.adjustment.rms_after_px,
        "sigma_px": done.adjustment.sigma_px,
        "imu": done.with_imu,
        "priors": "filter" if done.with_priors else "none",
        "moved_rms_m": done.moved_rms_m,
        "ate_before_m": done.ate_before_m,
        "ate_m": done.ate_m,
    }


def _write(out: Path, run: SavedRun, done: Refinement, metrics: dict[str, Any]) -> None:
    """Write a folder that `vio eval` and `vio export` read like a run's."""
    from vio.files.atomic import atomic_folder
    from vio.files.trajectories import write_tum
    from vio.runs.files import RunFile
    from vio.runs.folder import write_landmarks_ply

    with atomic_folder(out, replace=True, marker=RunFile.METRICS) as folder:
        in_body = (
            done.trajectory.in_imu(run.T_cam0_imu)
            if run.metrics["body"] == "imu"
            else done.trajectory
        )
        write_tum(folder / RunFile.TRAJECTORY, in_body)
        write_landmarks_ply(folder / RunFile.LANDMARKS, done.landmarks)
        (folder / RunFile.METRICS).write_text(json_text(metrics, indent=2) + "\n", encoding="utf-8")


def _rows(m: dict[str, Any]) -> list[tuple[str, str]]:
    others = (
        "with the IMU"
        if m["imu"]
        else f"{m['frames_aligned_to_points']} more aligned to the refined points"
    )
    rows = [
        ("keyframes", f"{m['keyframes']} of {m['frames']} frames; {others}"),
        (
            "points",
            f"{m['points']} from {m['rows']} stereo rows, {m['rows_dropped']} dropped as outliers",
        ),
        ("residual", f"{m['rms_before_px']:.3f} px before, {m['rms_after_px']:.3f} px after"),
        ("moved", f"{1e3 * m['moved_rms_m']:.1f} mm rms after SE(3) alignment"),
    ]
    if m["loops"]:
        rows.insert(1, ("loops", f"{m['loops']}, whose matches are points; poses began in the map"))
    if m["ate_m"] is not None:
        from vio.evaluation.trajectories import metres_texts

        before, after = metres_texts(m["ate_before_m"], m["ate_m"])
        rows.append(("ATE", f"{before} before, {after} after"))
    return [*rows, ("time", f"{m['seconds']:.1f} s"), ("results", m["out"])]
