"""`vio check`: a second opinion on a run, by COLMAP from its images."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vio.colmap.reconstruction import Mapper
    from vio.offline.check import Opinion

MARKER = "check.json"
KEYFRAMES = 40


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = commands.add_parser(
        "check",
        help="check a run without ground truth",
        description="Reconstruct keyframes of a run (of `vio run --save-observations`) from their images alone with "
        "COLMAP's incremental and global mapper, the stereo rig known, and compare: ATE after SE(3) alignment, scale, "
        "where the two disagree. Writes RUN/check with a report, a picture and both models. Takes minutes.",
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="a run's folder with observations.npz")
    parser.add_argument(
        "--mapper", choices=("both", "incremental", "global"), default="both", help="COLMAP's mapper (default both)"
    )
    parser.add_argument(
        "--keyframes", type=int, default=KEYFRAMES, metavar="N", help=f"at most so many (default {KEYFRAMES})"
    )
    parser.add_argument("--source", metavar="SOURCE", help="where the recording is now (default: as the run names it)")
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="default 1: repeatable")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(execute=execute)


def execute(args: argparse.Namespace) -> int:
    """Run the subcommand."""
    import json

    from vio.atomic import atomic_folder
    from vio.cli.output import answer
    from vio.cli.progress import ProgressBar
    from vio.colmap import quiet
    from vio.errors import ConfigError
    from vio.offline.check import check_run
    from vio.saved_run import read_saved_run

    if args.threads < 1 or args.keyframes < 2:
        raise ConfigError("--threads must be at least 1 and --keyframes at least 2")
    quiet()
    run = read_saved_run(args.run)
    mappers: tuple[Mapper, ...] = ("incremental", "global") if args.mapper == "both" else (args.mapper,)
    out = args.run / "check"
    with ProgressBar(f"check {args.run.name}") as bar, atomic_folder(out, replace=True, marker=MARKER) as folder:
        opinions = check_run(
            run, folder, mappers, most=args.keyframes, source=args.source, threads=args.threads, progress=bar.update
        )
        report = {
            "out": str(out),
            "of": str(args.run),
            "keyframes": opinions[0].total,
            "mappers": {opinion.mapper: _facts(opinion) for opinion in opinions},
        }
        (folder / MARKER).write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    rows = [(opinion.mapper, f"{key:<10} {value}") for opinion in opinions for key, value in _rows(opinion)]
    return answer(report, [*rows, ("picture", str(out / "check.png"))], as_json=args.json, name_width=12)


def _facts(opinion: Opinion) -> dict[str, Any]:
    from dataclasses import asdict

    if opinion.found is None:
        return {"verdict": opinion.verdict, "registered": 0}
    model, comparison = opinion.found
    facts = {key: value for key, value in asdict(comparison).items() if key != "aligned"}
    return {
        "verdict": opinion.verdict,
        "registered": len(model.keyframes),
        "points": model.points,
        "mean_reprojection_error_px": model.mean_reprojection_error_px,
        **facts,
        "frames": comparison.frames.tolist(),
        "difference_m": comparison.difference_m.tolist(),
        "difference_deg": comparison.difference_deg.tolist(),
    }


def _rows(opinion: Opinion) -> list[tuple[str, str]]:
    if opinion.found is None:
        return [("verdict", opinion.verdict)]
    model, comparison = opinion.found
    rows = [
        ("keyframes", f"{len(model.keyframes)} of {opinion.total} connected, {model.points} points"),
        ("ATE", f"{comparison.ate_m:.4f} m to the run after SE(3) alignment, {comparison.ate_deg:.3f} deg"),
    ]
    if comparison.scale is not None and comparison.scale_sigma is not None:
        percent, sigma = 100 * (comparison.scale - 1), 100 * comparison.scale_sigma
        rows.append(("scale", f"{percent:+.3f} +- {sigma:.3f} % (COLMAP over run, both by the known baseline)"))
    for segment in comparison.segments:
        rows.append(
            (
                "segment",
                f"frames {segment.first_frame} to {segment.last_frame}: motions differ by "
                f"{1e3 * segment.difference_m:.1f} mm, {segment.difference_deg:.3f} deg",
            )
        )
    if comparison.reference_ate_m is not None and comparison.run_reference_ate_m is not None:
        rows.append(
            (
                "reference",
                f"COLMAP {comparison.reference_ate_m:.4f} m, the run {comparison.run_reference_ate_m:.4f} m from it at "
                f"these keyframes; COLMAP's scale {100 * ((comparison.reference_scale or 1) - 1):+.3f} %",
            )
        )
    rows.append(("verdict", opinion.verdict))
    return rows
