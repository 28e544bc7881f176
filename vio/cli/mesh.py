"""`vio mesh`: a coloured mesh and a floor plan of what a run saw."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vio.cli.output import ProgressBar, print_result
from vio.cli.stopping import StopRequest
from vio.cli.waiting import stage
from vio.errors import ConfigError
from vio.files.printable import json_text

if TYPE_CHECKING:
    from vio.offline.mesh import DenseMap

_MIB = 1 << 20


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "mesh",
        help="reconstruct a coloured mesh and a floor plan",
        description="Compute dense depth of a run's images by semi-global matching, with the "
        "stereo calibration as the "
        "run found it, and fuse it along the run's poses: mesh.ply, mesh.glb and points.ply in "
        "colour where the "
        "recording has any, preview.png, and occupancy.pgm with occupancy.yaml, a floor plan as "
        "ROS reads it. Ctrl-C "
        "keeps what is fused so far.",
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="a run's folder")
    parser.add_argument(
        "--map", type=Path, metavar="FILE", help="a map that holds the run, for its poses"
    )
    parser.add_argument(
        "--voxel",
        type=float,
        metavar="M",
        help="size of the voxels (default: by the scene's depth)",
    )
    parser.add_argument(
        "--memory",
        type=int,
        default=256,
        metavar="MIB",
        help="of the voxels; farther ones go to a file (default 256)",
    )
    parser.add_argument(
        "--source",
        metavar="SOURCE",
        help="current path of the recording (default: as stored in the run)",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder to write (default RUN/mesh)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def execute(args: argparse.Namespace) -> int:
    from vio.dense.voxel_grid import BLOCK
    from vio.files.atomic import atomic_folder, check_replaceable, check_writable
    from vio.offline.mesh import build_mesh, facts_of, mesh_source
    from vio.runs.files import MeshFile

    if args.voxel is not None and not 1e-3 <= args.voxel <= 100:
        raise ConfigError(f"--voxel takes 0.001 to 100 m, got {args.voxel:g}")
    if not 16 <= args.memory <= 1 << 20:
        raise ConfigError(f"--memory takes 16 to {1 << 20} MiB, got {args.memory}")
    out = args.out or args.run / MeshFile.FOLDER
    made_from = mesh_source(args.run, args.map, args.voxel)
    check_replaceable(out, replace=True, marker=MeshFile.FACTS)
    check_writable(out)
    began = time.perf_counter()
    with ProgressBar(f"mesh {args.run.name}", unit="frames") as bar, StopRequest() as stop:
        done = build_mesh(
            made_from,
            source=args.source,
            most_blocks=args.memory * _MIB // BLOCK.itemsize,
            progress=bar.update,
            stop=lambda: stop.reason() is not None,
        )
        facts = {
            "out": str(out),
            "of": str(args.run),
            "stopped": stop.reason(),
            **facts_of(made_from, done),
            "seconds": time.perf_counter() - began,
        }
        with (
            stage("writing the mesh"),
            atomic_folder(out, replace=True, marker=MeshFile.FACTS) as folder,
        ):
            _write(folder, done)
            (folder / MeshFile.FACTS).write_text(
                json_text(facts, indent=2) + "\n", encoding="utf-8"
            )
    return print_result(facts, _rows(facts), as_json=args.json)


def _write(folder: Path, done: DenseMap) -> None:
    from vio.datasets.images import write_png
    from vio.files.meshes import glb_mesh, ply_points, write_ros_map
    from vio.runs.files import MeshFile

    mesh = done.mesh
    (folder / MeshFile.MESH).write_bytes(
        ply_points(mesh.vertices, mesh.colours, mesh.normals, mesh.triangles)
    )
    (folder / MeshFile.POINTS).write_bytes(ply_points(mesh.vertices, mesh.colours, mesh.normals))
    glb = glb_mesh(mesh.vertices, mesh.normals, mesh.colours, mesh.triangles, done.R_upright_world)
    (folder / MeshFile.GLTF).write_bytes(glb)
    write_png(folder / MeshFile.PICTURE, done.picture)
    if (plan := done.occupancy) is not None:
        write_ros_map(folder, MeshFile.OCCUPANCY, plan.levels, plan.cell_m, plan.origin_m)


def _rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    """Return what was made as table rows."""
    from vio.runs.files import MeshFile

    extent = " x ".join(f"{length:.1f}" for length in facts["extent_m"])
    sigmas = ", ".join(
        f"{1e3 * sigma:.0f} mm at {z} m" for z, sigma in facts["depth_sigma_m"].items()
    )
    if facts["stopped"] is None:
        stopped = ""
    else:
        stopped = f" of {facts['chosen']}, {facts['stopped']}"
    return [
        ("folder", facts["out"]),
        (
            "frames",
            f"{facts['frames']}{stopped}, poses of the {facts['poses']}, {facts['seconds']:.0f} s",
        ),
        ("depth", f"up to {facts['farthest_m']:.1f} m; standard deviation {sigmas}"),
        (
            "mesh",
            f"{facts['vertices']} vertices, {facts['triangles']} triangles, {extent} m, voxels "
            f"{facts['voxel_m']:g} m",
        ),
        ("picture", str(Path(facts["out"]) / MeshFile.PICTURE)),
        ("next", f"vio view {facts['of']}"),
    ]
