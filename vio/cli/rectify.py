"""`vio rectify`: write the rectified images of a folder of raw stereo images."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

from vio.cli.output import ProgressBar, print_result
from vio.errors import NOTE, DataError
from vio.files.printable import json_text

MARKER = "rectification.json"


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "rectify",
        help="write a rectified folder",
        description="Rectify the images of an EuRoC folder (written as an EuRoC folder with "
        "pinhole cameras, the same "
        "IMU and ground truth) or of an unrectified KITTI raw drive (written as a KITTI odometry "
        "folder). `vio run` "
        "does not need this, since it rectifies while reading; other programs may.",
    )
    parser.add_argument(
        "source", metavar="SOURCE", help="an EuRoC folder or a KITTI raw drive, or kind:path"
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder to write (atomically)"
    )
    parser.add_argument(
        "--interpolation",
        choices=("linear", "cubic", "lanczos4"),
        default="linear",
        help="interpolation between pixels (default linear, as in vio run)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def execute(args: argparse.Namespace) -> int:
    from vio.datasets import DatasetSettings, open_dataset
    from vio.datasets.image_pairs import ImageDataset
    from vio.files.atomic import atomic_folder, check_spares
    from vio.files.text import write_text
    from vio.offline.convert import convert, write_rectified_euroc
    from vio.records import need_stereo

    dataset = open_dataset(
        args.source, DatasetSettings(interpolation=args.interpolation, projection="pinhole")
    )
    recording = dataset.recording
    need_stereo(recording, "vio rectify")
    for note in recording.notes:
        logging.getLogger(__name__).log(NOTE, "%s", note)
    if recording.kind in ("plain", "bag", "video"):
        raise DataError(
            f"{recording.path} is of kind {recording.kind}; rectify it with vio convert --to euroc"
        )
    if not isinstance(dataset, ImageDataset) or dataset.rectifier.maps is None:
        raise DataError(
            f"{recording.path} is rectified already: there is nothing to do; use it as it is"
        )
    camera = recording.camera
    facts = {
        "kind": recording.kind,
        "source": recording.path.absolute().name,
        "interpolation": dataset.settings.interpolation,
        "width": camera.width,
        "height": camera.height,
        "focal_px": camera.fu,
        "baseline_m": camera.baseline_m,
    }
    check_spares(recording.path, args.out)
    with atomic_folder(args.out, replace=True, marker=MARKER) as folder:
        with ProgressBar(f"rectify {recording.path.name}") as bar:
            if recording.kind == "euroc":
                frames = write_rectified_euroc(dataset, folder, bar.update)
            else:
                frames = convert(dataset, folder, "kitti", progress=bar.update).frames
        facts["frames"] = frames
        write_text(folder / MARKER, json_text(facts, indent=2) + "\n")
    rows = (
        ("folder", str(args.out)),
        ("frames", f"{frames}"),
        ("size", f"{camera.width} x {camera.height}"),
        ("focal", f"{camera.fu:.4f} px"),
        ("baseline", f"{camera.baseline_m:.6f} m"),
    )
    return print_result({"out": str(args.out), **facts}, rows, as_json=args.json)
