"""`vio check`: comparison of a run with COLMAP's reconstruction from its images."""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vio.cli.output import ProgressBar, print_result
from vio.errors import ConfigError
from vio.files.printable import json_text

if TYPE_CHECKING:
    from vio.offline.colmap.reconstruction import Mapper
    from vio.offline.verdict import MapperResult

MARKER = "check.json"
KEYFRAMES = 40


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "check",
        help="check a run without ground truth",
        description="Reconstruct keyframes of a run (of `vio run --save-observations`) from their "
        "images alone with "
        "COLMAP's incremental and global mapper, with a known stereo rig, and compare: ATE after "
        "SE(3) alignment, "
        "scale, and segments that disagree. Loops that the run closed in its map are matched as "
        "well. Writes RUN/check "
        "with a report, a plot and both models. Takes minutes.",
    )
    parser.add_argument(
        "run", type=Path, metavar="RUN", help="a run's folder with observations.npz"
    )
    parser.add_argument(
        "--mapper",
        choices=("both", "incremental", "global"),
        default="both",
        help="COLMAP's mapper (default both)",
    )
    parser.add_argument(
        "--keyframes",
        type=int,
        default=KEYFRAMES,
        metavar="N",
        help=f"largest number of keyframes (default {KEYFRAMES})",
    )
    parser.add_argument(
        "--source",
        metavar="SOURCE",
        help="current path of the recording (default: as stored in the run)",
    )
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="default 1: repeatable")
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def execute(args: argparse.Namespace) -> int:
    from vio.files.atomic import atomic_folder
    from vio.offline.check import CheckOptions, check_run
    from vio.offline.colmap import quiet
    from vio.offline.saved_run import read_saved_run
    from vio.offline.verdict import overall_verdict

    if args.threads < 1 or args.keyframes < 2:
        raise ConfigError("--threads must be at least 1 and --keyframes at least 2")
    quiet()
    run = read_saved_run(args.run)
    mappers: tuple[Mapper, ...] = (
        ("incremental", "global") if args.mapper == "both" else (args.mapper,)
    )
    out = args.run / "check"
    with (
        ProgressBar(f"check {args.run.name}") as bar,
        atomic_folder(out, replace=True, marker=MARKER) as folder,
    ):
        results = check_run(
            run,
            folder,
            mappers,
            CheckOptions(args.keyframes, args.source, args.threads),
            begin=lambda step: bar.begin(f"check {args.run.name}: {step}"),
            announce=lambda text: print(text, file=sys.stderr),
        )
        report = {
            "out": str(out),
            "of": str(args.run),
            "verdict": overall_verdict(results),
            "keyframes": results[0].total,
            "mappers": {result.mapper: _facts(result) for result in results},
        }
        (folder / MARKER).write_text(json_text(report, indent=2) + "\n", encoding="utf-8")
    rows = [("verdict", str(report["verdict"]))]
    rows += [
        (result.mapper, f"{key:<10} {value}") for result in results for key, value in _rows(result)
    ]
    return print_result(
        report, [*rows, ("plot", str(out / "check.png"))], as_json=args.json, name_width=12
    )


def _facts(result: MapperResult) -> dict[str, Any]:
    from vio.offline.colmap.reconstruction import MIN_SHARED

    if result.found is None:
        return {"verdict": result.verdict, "registered": 0}
    model, comparison = result.found
    facts = {key: value for key, value in asdict(comparison).items() if key != "aligned"}
    return {
        "verdict": result.verdict,
        "registered": len(model.keyframes),
        "points": model.points,
        "mean_reprojection_error_px": model.mean_reprojection_error_px,
        "loops": len(model.shared),
        "loops_in_model": int((model.shared >= MIN_SHARED).sum()),
        "points_across_loops": model.shared.tolist(),
        **facts,
        "piece": comparison.frames[comparison.piece].tolist(),
        "frames": comparison.frames.tolist(),
        "difference_m": comparison.difference_m.tolist(),
        "difference_deg": comparison.difference_deg.tolist(),
    }


def _rows(result: MapperResult) -> list[tuple[str, str]]:
    if result.found is None:
        return [("result", result.verdict)]
    from vio.offline.colmap.reconstruction import MIN_SHARED

    model, comparison = result.found
    apart = f"{comparison.end_m:.4f} m and {comparison.end_deg:.3f} deg"
    expected = f"{comparison.expected_end_m:.3g} m and {comparison.expected_end_deg:.3g} deg"
    whole = int(comparison.piece.sum()) == len(comparison.piece)
    in_one = (
        ""
        if whole
        else f", {int(comparison.piece.sum())} of them in one piece, which is compared below"
    )
    rows = [
        (
            "keyframes",
            f"{len(model.keyframes)} of {result.total} connected{in_one}, {model.points} points",
        ),
        (
            "ATE",
            f"{comparison.ate_m:.4f} m to the run after SE(3) alignment, {comparison.ate_deg:.3f} "
            "deg",
        ),
        ("end", f"{apart} apart at the end; up to {expected} expected"),
    ]
    if len(model.shared):
        joined = int((model.shared >= MIN_SHARED).sum())
        rows.insert(
            1,
            (
                "loops",
                f"{joined} of {len(model.shared)} in the model, with {MIN_SHARED} points or more",
            ),
        )
    if comparison.scale is not None and comparison.scale_sigma is not None:
        percent = 100 * (comparison.scale - 1)
        sigma = 100 * comparison.scale_sigma
        text = f"{percent:+.3f} +- {sigma:.3f} % (COLMAP relative to the run, both by the known baseline)"
        rows.append(("scale", text))
    for segment in comparison.segments:
        where = f"frames {segment.first_frame} to {segment.last_frame}"
        apart_mm = 1e3 * segment.difference_m
        rows.append(
            (
                "segment",
                f"{where}: motions differ by {apart_mm:.1f} mm, {segment.difference_deg:.3f} deg",
            )
        )
    if comparison.reference_ate_m is not None and comparison.run_reference_ate_m is not None:
        own = comparison.run_reference_ate_m
        percent = 100 * ((comparison.reference_scale or 1) - 1)
        text = f"COLMAP {comparison.reference_ate_m:.4f} m, the run {own:.4f} m from it at these keyframes"
        rows.append(("reference", f"{text}; COLMAP's scale {percent:+.3f} %"))
    rows.append(("result", result.verdict))
    return rows
