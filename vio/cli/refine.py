"""`vio refine`: bundle adjustment over a run's keyframes."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vio.colmap import PositionPriors
    from vio.config import Config
    from vio.mapping import SavedRun
    from vio.records import IntArray

FOLDER = "refined"


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = commands.add_parser(
        "refine",
        help="bundle-adjust a run",
        description="Bundle-adjust the keyframes of a run (of `vio run --save-observations`) with the run's own "
        "tracks, the stereo rig held fixed, and write the refined trajectory and map to RUN/refined, which `vio eval` "
        "and `vio export` read like a run.",
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="a run's folder with observations.npz")
    parser.add_argument("--keyframes", type=int, metavar="N", help="at most so many keyframes (default: as needed)")
    parser.add_argument(
        "--priors",
        choices=("none", "filter"),
        default="none",
        help="hold the camera positions to the filter's, by its covariance (replays the filter; default none)",
    )
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="of the solver (default 1: repeatable)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(execute=execute)


def execute(args: argparse.Namespace) -> int:
    """Run the subcommand."""
    import json
    import time
    from dataclasses import replace

    from vio import colmap
    from vio.atomic import atomic_folder
    from vio.cli.running import rendering
    from vio.errors import ConfigError
    from vio.mapping import (
        build_tracks,
        choose_keyframes,
        fill_between,
        landmarks_of,
        position_difference_m,
        read_saved_run,
    )
    from vio.run_folder import MARKER, landmarks_ply
    from vio.threads import one_blas_thread
    from vio.trajectory_io import write_tum

    if args.threads < 1 or (args.keyframes is not None and args.keyframes < 2):
        raise ConfigError("--threads must be at least 1 and --keyframes at least 2")
    colmap.quiet()
    run = read_saved_run(args.run)
    began = time.perf_counter()
    with one_blas_thread(), rendering(f"refine {args.run.name}") as show:
        show(0, 5)
        keyframes = choose_keyframes(run, most=args.keyframes)
        T_world_cam0 = run.trajectory.T_world_body[keyframes]
        tracks = build_tracks(run, keyframes, T_world_cam0)
        priors = _priors(run, keyframes) if args.priors == "filter" else None
        show(1, 5)
        steps = iter((2, 3))
        done = colmap.adjust(
            run.camera,
            T_world_cam0,
            tracks,
            priors=priors,
            threads=args.threads,
            progress=lambda: show(next(steps), 5),
        )
        poses, aligned = fill_between(run, keyframes, done.T_world_cam0, done.tracks)
        show(4, 5)
        refined = replace(run.trajectory, T_world_body=poses)
        landmarks = landmarks_of(run.camera, done.T_world_cam0, done.tracks, done.sigma_px)
        metrics = {
            "out": str(args.run / FOLDER),
            "of": str(args.run),
            "source": run.metrics["source"],
            "kind": run.metrics["kind"],
            "body": run.metrics["body"],
            "frames": len(poses),
            "keyframes": len(keyframes),
            "frames_aligned_to_points": aligned,
            "points": len(done.tracks.ids),
            "rows": len(done.tracks.point),
            "rows_dropped": done.rows_dropped,
            "rms_before_px": done.rms_before_px,
            "rms_after_px": done.rms_after_px,
            "sigma_px": done.sigma_px,
            "priors": args.priors if priors is not None else "none",
            "moved_rms_m": position_difference_m(run.trajectory, refined),
            **_scores(run, refined.T_world_body),
            "seconds": time.perf_counter() - began,
            "T_cam0_imu": run.T_cam0_imu.tolist(),
        }
        with atomic_folder(args.run / FOLDER, replace=True, marker=MARKER) as folder:
            in_body = refined.in_imu(run.T_cam0_imu) if run.metrics["body"] == "imu" else refined
            write_tum(folder / "trajectory.tum", in_body)
            (folder / "landmarks.ply").write_bytes(landmarks_ply(landmarks))
            (folder / MARKER).write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
        show(5, 5)
    if args.json:
        print(json.dumps(metrics))
        return 0
    rows = [
        ("keyframes", f"{len(keyframes)} of {len(poses)} frames; {aligned} more aligned to the refined points"),
        ("points", f"{metrics['points']} from {metrics['rows']} stereo rows, {done.rows_dropped} dropped as outliers"),
        ("residual", f"{done.rms_before_px:.3f} px before, {done.rms_after_px:.3f} px after"),
        ("moved", f"{1e3 * metrics['moved_rms_m']:.1f} mm rms after SE(3) alignment"),
    ]
    if metrics["ate_m"] is not None:
        rows.append(("ATE", f"{metrics['ate_before_m']:.4f} m before, {metrics['ate_m']:.4f} m after"))
    rows += [("time", f"{metrics['seconds']:.1f} s"), ("results", metrics["out"])]
    for name, value in rows:
        print(f"{name:<10} {value}")
    return 0


def _scores(run: SavedRun, T_world_cam0: Any) -> dict[str, float | None]:
    """ATE before and after, against the reference in the recording; None without one."""
    import logging
    from dataclasses import replace

    from vio.errors import EvaluationError
    from vio.evaluation import evaluate

    reference = run.dataset.recording.reference
    out: dict[str, float | None] = {"ate_before_m": None, "ate_m": None}
    if reference is None:
        return out
    try:
        for name, poses in (("ate_before_m", run.trajectory.T_world_body), ("ate_m", T_world_cam0)):
            scores = evaluate(
                replace(run.trajectory, T_world_body=poses), reference, T_cam0_imu=run.T_cam0_imu
            ).as_dict()
            out[name] = scores["ate_m"]
    except EvaluationError as error:
        logging.getLogger(__name__).warning("the reference was not used: %s", error)
    return out


def _priors(run: SavedRun, keyframes: IntArray) -> PositionPriors | None:
    """Replay the filter on its saved observations for the covariance of each pose; None where it has changed since."""
    import logging

    import numpy as np

    from vio.colmap import PositionPriors
    from vio.mapping import position_covariances
    from vio.pipeline import run as process

    config = _estimator_settings(run.folder / "config.yaml")
    first, last = int(run.frames[0]), int(run.frames[-1])
    again = process(run.dataset, config, start=first, stop=last + 1)
    poses = again.trajectory.in_cam0(again.T_cam0_body).T_world_body
    if len(poses) != len(run.frames) or np.abs(poses - run.trajectory.T_world_body).max() > 1e-6:
        logging.getLogger(__name__).warning(
            "the filter does not repeat %s any more (other version or settings); refining without priors", run.folder
        )
        return None
    chosen = [again.estimates[int(k)] for k in keyframes]
    return PositionPriors(poses[keyframes, :3, 3], position_covariances(chosen, run.T_cam0_imu))


def _estimator_settings(path: Path) -> Config:
    """The settings that a run was made with, but those of its front end, whose work is done."""
    import yaml

    from vio.config import Config, merge
    from vio.errors import ConfigError

    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError) as error:
        raise ConfigError(f"cannot read {path} ({error}); repeat the run") from error
    kept = {key: value for key, value in values.items() if key not in ("frontend", "dataset")}
    return merge(Config(), kept, where=str(path))
