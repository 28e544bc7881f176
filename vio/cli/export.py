"""`vio export`: a run in the form of other programs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vio.mapping import PointTracks, SavedRun
    from vio.records import IntArray

MARKER = "export.json"


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = commands.add_parser(
        "export",
        help="write a run for COLMAP and nerfstudio",
        description="Write the keyframes of a run (of `vio run --save-observations`) as a metric COLMAP model: "
        "sparse/0 with cameras, rig, poses, and points with tracks and colours; images/; nerfstudio's transforms.json "
        "with points.ply.",
    )
    parser.add_argument("form", choices=("colmap",), metavar="FORM", help="colmap (with transforms.json)")
    parser.add_argument("run", type=Path, metavar="RUN", help="a run's folder with observations.npz")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder to write (default RUN/colmap)")
    parser.add_argument("--refined", action="store_true", help="take the poses of `vio refine`")
    parser.add_argument("--keyframes", type=int, metavar="N", help="at most so many keyframes (default: as needed)")
    parser.add_argument("--source", metavar="SOURCE", help="where the recording is now (default: as the run names it)")
    parser.add_argument("--no-images", action="store_true", help="do not write the rectified images")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(execute=execute)


def execute(args: argparse.Namespace) -> int:
    """Run the subcommand."""
    import json

    from vio import colmap
    from vio.atomic import atomic_folder
    from vio.cli.running import rendering
    from vio.errors import ConfigError
    from vio.mapping import build_tracks, choose_keyframes, read_saved_run, with_poses
    from vio.threads import one_blas_thread

    if args.keyframes is not None and args.keyframes < 2:
        raise ConfigError("--keyframes must be at least 2")
    colmap.quiet()
    run = read_saved_run(args.run)
    if args.refined:
        run = with_poses(run, args.run / "refined")
    out = args.out or args.run / "colmap"
    with one_blas_thread(), rendering(f"export {args.run.name}") as show:
        keyframes = choose_keyframes(run, most=args.keyframes)
        T_world_cam0 = run.trajectory.T_world_body[keyframes]
        tracks = build_tracks(run, keyframes, T_world_cam0)
        frames = run.frames[keyframes].tolist()
        names = colmap.ModelImages(
            tuple(f"left/{k:06d}.png" for k in frames), tuple(f"right/{k:06d}.png" for k in frames)
        )
        with atomic_folder(out, replace=True, marker=MARKER) as folder:
            colours = None
            if not args.no_images:
                colours = _write_images(run, args.source, keyframes, tracks, names, folder / "images", show)
            model = colmap.build_model(run.camera, T_world_cam0, tracks, names, colours)
            (folder / "sparse" / "0").mkdir(parents=True)
            colmap.write_model(model, folder / "sparse" / "0")
            below = colmap.ModelImages(
                tuple(f"images/{name}" for name in names.left), tuple(f"images/{name}" for name in names.right)
            )
            (folder / "transforms.json").write_text(
                colmap.nerfstudio_transforms(run.camera, T_world_cam0, below), encoding="utf-8"
            )
            (folder / "points.ply").write_bytes(_ply(tracks, colours))
            facts = {
                "out": str(out),
                "of": str(args.run),
                "source": run.source,
                "poses": "refined" if args.refined else "filter",
                "keyframes": len(keyframes),
                "images": 0 if args.no_images else 2 * len(keyframes),
                "points": len(tracks.ids),
                "mean_reprojection_error_px": colmap.mean_reprojection_error_px(model),
            }
            (folder / MARKER).write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
    if args.json:
        print(json.dumps(facts))
        return 0
    rows = (
        ("folder", str(out)),
        ("keyframes", f"{len(keyframes)} stereo pairs, {facts['images']} images written"),
        ("points", f"{facts['points']}"),
        ("residual", f"{facts['mean_reprojection_error_px']:.3f} px mean reprojection error, as COLMAP computes it"),
    )
    for name, value in rows:
        print(f"{name:<10} {value}")
    return 0


def _write_images(
    run: SavedRun,
    source: str | None,
    keyframes: IntArray,
    tracks: PointTracks,
    names: Any,
    folder: Path,
    show: Any,
) -> Any:
    """Write the rectified images of the keyframes; return the colours (M, 3) of the points, seen by the left camera."""
    import numpy as np

    from vio.mapping import sample_gray, stereo_frames, write_png

    for side in ("left", "right"):
        (folder / side).mkdir(parents=True)
    total, count = np.zeros(len(tracks.ids)), np.zeros(len(tracks.ids))
    for k, frame in enumerate(stereo_frames(run, source, keyframes)):
        assert frame.left is not None
        assert frame.right is not None
        write_png(folder / names.left[k], frame.left)
        write_png(folder / names.right[k], frame.right)
        rows = tracks.keyframe == k
        np.add.at(total, tracks.point[rows], sample_gray(frame.left, tracks.z[rows, :2]))
        np.add.at(count, tracks.point[rows], 1)
        show(k + 1, len(keyframes))
    gray = np.rint(total / np.maximum(count, 1)).astype(np.uint8)
    return np.repeat(gray[:, None], 3, axis=1)


def _ply(tracks: PointTracks, colours: Any) -> bytes:
    """The points as a binary PLY: x y z in metres, red green blue."""
    import numpy as np

    fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    points = np.zeros(len(tracks.ids), dtype=fields)
    points["x"], points["y"], points["z"] = tracks.p_world.T
    if colours is not None:
        points["red"], points["green"], points["blue"] = colours.T
    kinds = {"<f4": "float", "u1": "uchar"}
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n" + "".join(
        f"property {kinds[kind]} {name}\n" for name, kind in fields
    )
    return f"{header}end_header\n".encode("ascii") + points.tobytes()
