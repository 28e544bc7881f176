"""`vio check`: a second opinion on a run, by COLMAP from its images."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vio.colmap import ModelImages, Reconstructed
    from vio.mapping import Comparison, SavedRun
    from vio.records import IntArray

MARKER = "check.json"
KEYFRAMES = 40
_COLOURS = {"incremental": "#d9822b", "global": "#3a9d5d"}


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
    import shutil

    from vio import colmap
    from vio.atomic import atomic_folder
    from vio.cli.running import rendering
    from vio.errors import ConfigError
    from vio.mapping import choose_keyframes, compare_keyframes, read_saved_run

    if args.threads < 1 or args.keyframes < 2:
        raise ConfigError("--threads must be at least 1 and --keyframes at least 2")
    colmap.quiet()
    run = read_saved_run(args.run)
    mappers: tuple[colmap.Mapper, ...] = ("incremental", "global") if args.mapper == "both" else (args.mapper,)
    out = args.run / "check"
    with rendering(f"check {args.run.name}") as show, atomic_folder(out, replace=True, marker=MARKER) as folder:
        keyframes = choose_keyframes(run, most=args.keyframes)
        names = _write_images(run, args.source, keyframes, folder / "images")
        show(1, 2 + len(mappers))
        database = folder / "database.db"
        colmap.match_images(database, folder / "images", names, run.camera, threads=args.threads)
        show(2, 2 + len(mappers))
        results: dict[str, Reconstructed | None] = {}
        for k, mapper in enumerate(mappers):
            results[mapper] = colmap.reconstruct(
                database, folder / "images", names, mapper, folder / mapper, threads=args.threads
            )
            show(3 + k, 2 + len(mappers))
        comparisons = {
            name: None if found is None else compare_keyframes(run, keyframes[found.keyframes], found.T_world_cam0)
            for name, found in results.items()
        }
        report = {
            "out": str(out),
            "of": str(args.run),
            "keyframes": len(keyframes),
            "mappers": {name: _facts(run, results[name], comparisons[name]) for name in mappers},
        }
        _draw(folder / "check.png", run, keyframes, comparisons)
        shutil.rmtree(folder / "images")
        database.unlink()
        (folder / MARKER).write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    if args.json:
        print(json.dumps(report))
        return 0
    for name in mappers:
        for key, value in _rows(run, len(keyframes), results[name], comparisons[name]):
            print(f"{name:<12} {key:<10} {value}")
    print(f"{'picture':<12} {out / 'check.png'}")
    return 0


def _write_images(run: SavedRun, source: str | None, keyframes: IntArray, folder: Path) -> ModelImages:
    from vio.colmap import ModelImages
    from vio.mapping import stereo_frames, write_png

    frames = run.frames[keyframes].tolist()
    names = ModelImages(tuple(f"left/{k:06d}.png" for k in frames), tuple(f"right/{k:06d}.png" for k in frames))
    for side in ("left", "right"):
        (folder / side).mkdir(parents=True)
    for k, frame in enumerate(stereo_frames(run, source, keyframes)):
        assert frame.left is not None
        assert frame.right is not None
        write_png(folder / names.left[k], frame.left)
        write_png(folder / names.right[k], frame.right)
    return names


def _verdict(registered: int, total: int, comparison: Comparison | None) -> str:
    if comparison is None:
        return (
            "not observable because COLMAP could not connect the keyframes; too few images, no overlap between them, "
            "or too little texture"
        )
    left_out = "" if registered == total else f"; {total - registered} of {total} keyframes could not be connected"
    if comparison.scale is None:
        return f"poses compared, scale not observable because {comparison.why_no_scale}{left_out}"
    where = f"disagrees in {len(comparison.segments)} segments" if comparison.segments else "agrees all along"
    return f"{where}{left_out}"


def _facts(run: SavedRun, found: Reconstructed | None, comparison: Comparison | None) -> dict[str, Any]:
    from dataclasses import asdict

    registered = 0 if found is None else len(found.keyframes)
    if found is None or comparison is None:
        return {"verdict": _verdict(registered, 0, None), "registered": registered}
    facts = {key: value for key, value in asdict(comparison).items() if key != "aligned"}
    return {
        "verdict": _verdict(registered, comparison.total, comparison),
        "registered": registered,
        "points": found.points,
        "mean_reprojection_error_px": found.mean_reprojection_error_px,
        **facts,
        "frames": comparison.frames.tolist(),
        "difference_m": comparison.difference_m.tolist(),
        "difference_deg": comparison.difference_deg.tolist(),
    }


def _rows(
    run: SavedRun, total: int, found: Reconstructed | None, comparison: Comparison | None
) -> list[tuple[str, str]]:
    if found is None or comparison is None:
        return [("verdict", _verdict(0, total, None))]
    rows = [
        ("keyframes", f"{len(found.keyframes)} of {total} connected, {found.points} points"),
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
    rows.append(("verdict", _verdict(len(found.keyframes), total, comparison)))
    return rows


def _draw(path: Path, run: SavedRun, keyframes: IntArray, comparisons: dict[str, Comparison | None]) -> None:
    """Both trajectories seen from above, and their distance along the way."""
    import numpy as np
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5), dpi=110, layout="constrained")
    above, along = figure.subplots(1, 2)
    p = run.trajectory.positions
    axes = np.linalg.svd(p - p.mean(axis=0), full_matrices=False)[2][:2]
    above.plot(*((p - p[0]) @ axes.T).T, color="#1f5fbf", label="run")
    for name, comparison in comparisons.items():
        if comparison is None:
            continue
        q = (comparison.aligned[:, :3, 3] - p[0]) @ axes.T
        above.plot(*q.T, ".", color=_COLOURS[name], label=f"COLMAP, {name}")
        along.plot(comparison.frames, 1e3 * comparison.difference_m, ".-", color=_COLOURS[name], label=name)
        for segment in comparison.segments:
            along.axvspan(segment.first_frame, segment.last_frame, color=_COLOURS[name], alpha=0.2)
    above.set_aspect("equal", "datalim")
    above.set_xlabel("m, plane of largest extent")
    along.set_xlabel("frame")
    along.set_ylabel("distance to the run, mm")
    for panel in (above, along):
        if panel.get_legend_handles_labels()[0]:
            panel.legend()
        panel.grid(alpha=0.3)
    figure.savefig(path)
