"""`vio eval`: comparison of a trajectory with a reference."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vio.cli.arguments import add_lengths_argument

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vio.evaluation.trajectories import Evaluation
    from vio.geometry.lie import FloatArray
    from vio.records import Trajectory

log = logging.getLogger(__name__)

_ALIGNMENTS = {
    "se3": "rotation and position",
    "sim3": "rotation, position and scale",
    "first": "the first poses made equal",
    "none": "none",
}


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = commands.add_parser(
        "eval",
        help="compare a trajectory with a reference",
        description="Compare a trajectory, or a run's folder, with a reference: ATE, RPE and KITTI drift. Files in "
        "TUM, KITTI or EuRoC format, or a COLMAP model; a reference in KITTI format, or a model whose images are "
        "numbered, is associated by frame number, others by time.",
    )
    parser.add_argument("estimate", type=Path, metavar="EST", help="a trajectory file or a run's folder")
    parser.add_argument(
        "reference",
        type=Path,
        metavar="REF",
        help="a trajectory file, a run's folder, a COLMAP model, or the recording",
    )
    parser.add_argument(
        "--align",
        choices=("se3", "sim3", "first", "none"),
        default="se3",
        help="alignment: se3 (default), sim3 (scale as well), first (at the first matched pose), none (same body and "
        "world frame only)",
    )
    add_lengths_argument(parser)
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
    from vio.cli.output import print_result
    from vio.errors import EvaluationError
    from vio.evaluation.trajectories import LEAST_POSES, evaluate

    estimate, T_cam0_imu = _read(args.estimate)
    reference, other = _read(args.reference)
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
        lengths_m=args.lengths,
    )
    if result.matched < LEAST_POSES:
        raise EvaluationError(f"only {result.matched} poses match; a comparison needs at least {LEAST_POSES}")
    for note in result.notes:
        log.warning("%s", note)
    return print_result(result.as_dict(), _rows(result), as_json=args.json)


def _rows(result: Evaluation) -> Iterator[tuple[str, str]]:
    """Yield the figures as rows of a table, one quantity each."""
    from vio.evaluation.trajectories import lengths_text, rotation_drift_text

    share = f"{100 * result.coverage.estimate:.1f} % of the estimate"
    if result.coverage.reference_span is not None:
        share += f" and {100 * result.coverage.reference_span:.1f} % of the reference's span"
    yield "compared", f"{result.matched} poses ({result.body}) by {result.association}: {share}"
    yield "path", f"{result.matched_path_length_m:.3f} m, the reference's {result.reference_path_length_m:.3f} m"
    yield "alignment", _ALIGNMENTS[result.align] + (f", scale {result.scale:.6f}" if result.align == "sim3" else "")
    for name, errors, unit in (("ATE", result.ate_m, "m"), ("attitude", result.ate_deg, "deg")):
        rest = f"mean {errors.mean:.4g}, median {errors.median:.4g}, largest {errors.max:.4g}"
        yield name, f"{errors.rmse:.4g} {unit} (rms), {rest}"
        if name == "ATE" and result.scale_free is not None:
            off = 100 * (result.scale_free.scale - 1)
            yield "scale", f"off by {off:+.3f} %; ATE {result.scale_free.ate_m:.4g} m (rms) without it, after Sim(3)"
    if result.rpe is not None:
        yield "RPE", f"{result.rpe.trans_rmse_m:.4g} m, {result.rpe.rot_rmse_deg:.4g} deg (rms) from frame to frame"
    if result.kitti is None:
        yield "drift", "the path is shorter than the lengths over which it is measured"
        return
    turned = rotation_drift_text(result.kitti.r_err_deg_per_100m, result.kitti.lengths_m, 4)
    yield "drift", f"{result.kitti.t_err_percent:.3f} %, {turned} over {lengths_text(result.kitti.lengths_m)}"
    for row in result.kitti.per_length:
        if row.t_err_percent is not None and row.r_err_deg_per_100m is not None:
            turned = rotation_drift_text(row.r_err_deg_per_100m, result.kitti.lengths_m, 4)
            yield f"  {row.length_m:g} m", f"{row.t_err_percent:8.3f} % {turned:>19} {row.segments:6d} segments"


def _read(path: Path) -> tuple[Trajectory, FloatArray | None]:
    """Read a trajectory file, a run's folder or a COLMAP model, with the extrinsics if it has them."""
    from vio.runs.files import RunFile
    from vio.runs.folder import read_run

    if path.is_dir() and not (path / RunFile.METRICS).is_file():
        from vio.offline.colmap import quiet
        from vio.offline.colmap.trajectory import model_folder, read_colmap_trajectory

        quiet()
        if model_folder(path) is not None:
            return read_colmap_trajectory(path), None
        return _truth_of(path)
    return read_run(path)


def _truth_of(path: Path) -> tuple[Trajectory, FloatArray | None]:
    """Return the ground truth of a recording, with its extrinsics.

    Raises:
        DataError: it is no recording either, or has no ground truth.
    """
    from vio.datasets import open_dataset
    from vio.errors import DataError

    try:
        recording = open_dataset(path).recording
    except DataError as error:
        text = f"{path}: no run folder, no COLMAP model, and no recording ({error})"
        raise DataError(text) from error
    if recording.reference is None:
        raise DataError(f"{path}: this recording has no ground truth; give a trajectory file")
    return recording.reference, recording.T_cam0_imu
