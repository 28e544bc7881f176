"""`vio eval`: comparison of a trajectory with a reference."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vio.cli.arguments import add_lengths_argument, examples
from vio.cli.output import print_result
from vio.errors import ConfigError, DataError, EvaluationError
from vio.files.printable import printable

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from vio.evaluation.errors_along_path import ErrorStatistics, KittiError
    from vio.evaluation.trajectories import Evaluation
    from vio.geometry.lie import FloatArray
    from vio.records import Trajectory

log = logging.getLogger(__name__)

# `vio.runs.picture.COMPARED_COLUMNS`, which loads NumPy
_COLUMNS = ("position", "attitude", "x", "y", "z")
_NAME = 32  # letters of a trajectory's name in a table of several
_ALIGNMENTS = {
    "se3": "rotation and position",
    "sim3": "rotation, position and scale",
    "first": "the first poses made equal",
    "none": "none",
}


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "eval",
        help="compare trajectories with a reference",
        description="Compare trajectories, or runs' folders, with a reference: ATE, RPE and KITTI "
        "drift. Files in "
        "TUM, KITTI or EuRoC format, or a COLMAP model; a reference in KITTI format, or a model "
        "whose images are "
        "numbered, is associated by frame number, others by time.",
        **examples(
            "vio eval results truth.txt  # a run against a trajectory file",
            "vio eval first second MH_01_easy --plot  # two runs against a recording's ground truth",
            "vio eval results truth.txt --plot e.png --axes xz --columns position,z  # other curves",
        ),
    )
    parser.add_argument(
        "estimates",
        type=Path,
        nargs="+",
        metavar="EST",
        help="trajectory files or runs' folders, side by side",
    )
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
        help="alignment: se3 (default), sim3 (scale as well), first (at the first matched pose), "
        "none (same body and "
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
    parser.add_argument(
        "--extrinsics", type=Path, metavar="F", help="T_cam0_imu, 3 or 4 rows of 4 numbers"
    )
    parser.add_argument(
        "--plot",
        nargs="?",
        const=Path("eval.png"),
        type=Path,
        metavar="F",
        help="draw paths and errors (eval.png)",
    )
    parser.add_argument(
        "--axes",
        type=plane,
        metavar="AB",
        help="with --plot: axes of the reference's world in which paths are drawn, as xy or xz "
        "(default: the plane in which it extends furthest)",
    )
    parser.add_argument(
        "--columns",
        type=columns,
        default=("position",),
        metavar="A,B",
        help=f"with --plot: curves beside the paths: {', '.join(_COLUMNS)} (default position)",
    )
    parser.add_argument(
        "--over",
        choices=("distance", "time"),
        default="distance",
        help="with --plot: what curves are drawn over (default distance)",
    )
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object; of several by their names"
    )


def plane(text: str) -> str:
    """Parse two axes such as xz."""
    if len(text) != 2 or text[0] == text[1] or not set(text) <= set("xyz"):
        raise argparse.ArgumentTypeError(f"{text!r} is no plane; give two of x, y and z, as in xz")
    return text


def columns(text: str) -> tuple[str, ...]:
    """Parse names of curves."""
    found = tuple(part.strip() for part in text.split(","))
    unknown = [name for name in found if name not in _COLUMNS]
    if unknown or len(set(found)) != len(found):
        raise argparse.ArgumentTypeError(
            f"{text!r}: give some of {', '.join(_COLUMNS)}, separated by commas, each once"
        )
    return found


def execute(args: argparse.Namespace) -> int:
    _check_plot(args)
    estimates = {path: _read(path, args.reference) for path in args.estimates}
    if _is_of_run(args.reference) and not any(map(_is_of_run, args.estimates)):
        log.warning(
            "%s, a run, is taken for the reference as it is named last; the estimate goes first",
            args.reference,
        )
    reference = _read(args.reference)
    results = {
        str(path): _evaluated(args, estimate, _numbered(path, reference))
        for path, estimate in estimates.items()
    }
    if args.plot is not None:
        from vio.runs.picture import Compared, draw_comparison, write_picture

        named = {printable(name): r for name, r in results.items()}
        shown = Compared(args.axes, args.columns, args.over)
        write_picture(args.plot, lambda: draw_comparison(named, shown))
    if len(results) == 1:
        (result,) = results.values()
        print_result(result.as_dict(), _rows(result), as_json=args.json)
    else:
        facts = {name: result.as_dict() for name, result in results.items()}
        print_result(facts, _side_by_side(results), as_json=args.json)
    if args.plot is not None and not args.json:
        print_result({}, [("plot", str(args.plot))], as_json=False)
    return 0


def _check_plot(args: argparse.Namespace) -> None:
    """Raise VioError where the picture cannot be written, or is described and not asked for."""
    from vio.files.atomic import check_new_file

    if args.plot is not None:
        check_new_file(args.plot, b"\x89PNG")
    elif args.axes or args.over != "distance" or args.columns != ("position",):
        raise ConfigError("--axes, --columns and --over say what --plot draws; give --plot too")


def _evaluated(
    args: argparse.Namespace,
    estimate: tuple[Trajectory, FloatArray | None],
    reference: tuple[Trajectory, FloatArray | None],
) -> Evaluation:
    """Compare one trajectory with the reference, both with their extrinsics."""
    from vio.evaluation.trajectories import MIN_POSES, evaluate

    T_cam0_imu = estimate[1]
    if args.extrinsics is not None:
        from vio.datasets.kitti import read_extrinsics

        T_cam0_imu = read_extrinsics(args.extrinsics)
        if T_cam0_imu is None:
            raise DataError(
                f"{args.extrinsics} does not exist; give a file with T_cam0_imu, 3 or 4 rows of 4 "
                "numbers"
            )
    result = evaluate(
        estimate[0],
        reference[0],
        align=args.align,
        max_time_difference_s=args.max_time_difference,
        T_cam0_imu=reference[1] if T_cam0_imu is None else T_cam0_imu,
        lengths_m=args.lengths,
    )
    if result.matched < MIN_POSES:
        raise EvaluationError(
            f"only {result.matched} poses match; a comparison needs at least {MIN_POSES}"
        )
    for note in result.notes:
        log.warning("%s", note)
    return result


def _shortened(name: str) -> str:
    """The end of a name that is too long for the table's column."""
    if len(name) <= _NAME:
        return name
    return "…" + name[1 - _NAME :]


def _side_by_side(results: Mapping[str, Evaluation]) -> Iterator[tuple[str, str]]:
    """Yield the main figures of several trajectories as one table, one line each."""
    from vio.evaluation.trajectories import metres_texts

    ates = metres_texts(*(r.ate_m.rmse for r in results.values()))
    known = [name for name, r in results.items() if r.rpe is not None]
    steps = metres_texts(*(r.rpe.trans_rmse_m for r in results.values() if r.rpe is not None))
    rpes = dict(zip(known, steps, strict=True))
    names = {name: _shortened(name) for name in results}
    yield (
        "",
        f"{'':<{_NAME}} {'poses':>7} {'ATE':>10} {'attitude':>10} {'scale':>9} {'RPE':>10} "
        f"{'drift':>8}",
    )
    for (name, r), ate in zip(results.items(), ates, strict=True):
        if r.scale_free is None:
            scale = "–"
        else:
            scale = f"{100 * (r.scale_free.scale - 1):+.3f} %"
        rpe = rpes.get(name, "–")
        if r.kitti is None:
            drift = "–"
        else:
            drift = f"{r.kitti.t_err_percent:.3f} %"
        figures = (
            f"{r.matched:>7} {ate:>10} {r.ate_deg.rmse:>6.3f} deg {scale:>9} {rpe:>10} {drift:>8}"
        )
        yield "", f"{printable(names[name]):<{_NAME}} {figures}"


def _rows(result: Evaluation) -> Iterator[tuple[str, str]]:
    """Yield the figures as rows of a table, one quantity each."""
    share = f"{100 * result.coverage.estimate:.1f} % of the estimate"
    if result.coverage.reference_span is not None:
        share += f" and {100 * result.coverage.reference_span:.1f} % of the reference's span"
    yield "compared", f"{result.matched} poses ({result.body}) by {result.association}: {share}"
    yield (
        "path",
        f"{result.matched_path_length_m:.3f} m, the reference's "
        f"{result.reference_path_length_m:.3f} m",
    )
    scale = ""
    if result.align == "sim3":
        scale = f", scale {result.scale:.6f}"
    yield "alignment", _ALIGNMENTS[result.align] + scale
    small = result.ate_m.rmse < 0.01
    yield "ATE", _errors_text(result.ate_m, *((1e3, "mm") if small else (1.0, "m")))
    if result.scale_free is not None:
        off = 100 * (result.scale_free.scale - 1)
        without = _length_text(result.scale_free.ate_m, small=small)
        yield "scale", f"off by {off:+.3f} %; ATE {without} (rms) without it, after Sim(3)"
    if "none" in (result.aligned.orientations, result.reference.orientations):
        yield (
            "attitude",
            "not compared: a trajectory has positions alone, so RPE and drift say nothing",
        )
        return
    yield "attitude", _errors_text(result.ate_deg, 1.0, "deg")
    if result.rpe is not None:
        step = result.rpe.trans_rmse_m
        moved = _length_text(step, small=step < 0.01)
        yield "RPE", f"{moved}, {result.rpe.rot_rmse_deg:.4g} deg (rms) from frame to frame"
    if result.kitti is None:
        yield "drift", "the path is shorter than the lengths over which it is measured"
    else:
        yield from _drift_rows(result.kitti)


def _errors_text(errors: ErrorStatistics, factor: float, unit: str) -> str:
    """Return errors as text in a unit, which is a factor times theirs."""
    mean, middle, largest = (factor * value for value in (errors.mean, errors.median, errors.max))
    return (
        f"{factor * errors.rmse:.4g} {unit} (rms), mean {mean:.4g}, median {middle:.4g}, "
        f"largest {largest:.4g}"
    )


def _length_text(length_m: float, *, small: bool) -> str:
    if small:
        return f"{1e3 * length_m:.4g} mm"
    return f"{length_m:.4g} m"


def _drift_rows(drift: KittiError) -> Iterator[tuple[str, str]]:
    """Yield the drift over all lengths, then over each."""
    from vio.evaluation.trajectories import lengths_text, rotation_drift_text

    turned = rotation_drift_text(drift.r_err_deg_per_100m, drift.lengths_m, 4)
    yield "drift", f"{drift.t_err_percent:.3f} %, {turned} over {lengths_text(drift.lengths_m)}"
    for row in drift.per_length:
        if row.t_err_percent is not None and row.r_err_deg_per_100m is not None:
            turned = rotation_drift_text(row.r_err_deg_per_100m, drift.lengths_m, 4)
            yield (
                f"  {row.length_m:g} m",
                f"{row.t_err_percent:8.3f} % {turned:>19} {row.segments:6d} segments",
            )


def _numbered(
    estimate: Path, reference: tuple[Trajectory, FloatArray | None]
) -> tuple[Trajectory, FloatArray | None]:
    """Return a reference numbered by the frames of the recording that an estimate is of, where its
    run knows the numbers of the images.
    """
    from vio.evaluation.numbering import numbered_by_images
    from vio.runs.stated import read_image_numbers

    return numbered_by_images(reference[0], read_image_numbers(estimate)), reference[1]


def _read(path: Path, compared_with: Path | None = None) -> tuple[Trajectory, FloatArray | None]:
    """Read a trajectory file, a run's folder or a COLMAP model, with the extrinsics if it has
    them.

    Args:
        path: of it.
        compared_with: the reference that this is an estimate beside; None: this is a reference.

    Raises:
        DataError: it cannot be read, or a recording is compared with a run, not the run with it.
    """
    from vio.files.pose_matrices import are_matrix_files
    from vio.files.trajectories import read_trajectory
    from vio.runs.files import RunFile
    from vio.runs.stated import read_run

    if path.is_dir() and not (path / RunFile.METRICS).is_file():
        from vio.offline.colmap import quiet
        from vio.offline.colmap.trajectory import model_folder, read_colmap_trajectory

        quiet()
        if model_folder(path) is not None:
            return read_colmap_trajectory(path), None
        if are_matrix_files(path):
            return read_trajectory(path), None
        truth = _truth_of(path)
        if compared_with is not None and (compared_with / RunFile.METRICS).is_file():
            raise DataError(
                f"{path} is a recording, and {compared_with} a run: name the run first, then the "
                "reference"
            )
        return truth
    return read_run(path)


def _is_of_run(path: Path) -> bool:
    """Return whether a path is a run's folder, or a trajectory that the run wrote there."""
    from vio.runs.files import ESTIMATED, RunFile

    folder = path.parent if path.name in ESTIMATED else path
    return (folder / RunFile.METRICS).is_file()


def _truth_of(path: Path) -> tuple[Trajectory, FloatArray | None]:
    """Return the ground truth of a recording, with its extrinsics."""
    from vio.datasets import open_dataset

    try:
        recording = open_dataset(path).recording
    except DataError as error:
        text = f"{path}: no run folder, no COLMAP model, and no recording ({error})"
        raise DataError(text) from error
    if recording.reference is None:
        raise DataError(f"{path}: this recording has no ground truth; give a trajectory file")
    return recording.reference, recording.T_cam0_imu
