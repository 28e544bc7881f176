"""TUM RGB-D: images and depth images in `rgb/` and `depth/`, listed with their stamps in `rgb.txt`
and `depth.txt`.

Reference: Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS (2012), and its
site.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vio.cameras.rig import Rig
from vio.datasets.frame_times import nearest
from vio.datasets.tables import table_rows
from vio.errors import DataError
from vio.files.text import parse_stamps
from vio.geometry.distortion import CameraModel
from vio.records import IntArray

LISTS = ("rgb.txt", "depth.txt")
_FACTOR = 5000.0  # levels per metre of TUM's depth images
# as TUM's own tool associates colour and depth, which have exposures of their own
_ASSOCIATED_NS = 20_000_000
# Intrinsics and radial-tangential distortion that TUM publishes for its three cameras, whose
# sequences have no file of them, and ROS's default for others.
_CAMERAS = {
    "freiburg1": (
        517.306408,
        516.469215,
        318.643040,
        255.313989,
        0.262383,
        -0.953104,
        -0.005358,
        0.002628,
        1.163314,
    ),
    "freiburg2": (
        520.908620,
        521.007327,
        325.141442,
        249.701764,
        0.231222,
        -0.784899,
        -0.003257,
        -0.000105,
        0.917205,
    ),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
    "default": (525.0, 525.0, 319.5, 239.5),
}


def is_tum_folder(path: Path) -> bool:
    """Return whether a folder holds the two lists of TUM RGB-D."""
    return all((path / name).is_file() for name in LISTS)


def associated_images(path: Path) -> tuple[list[Path], list[Path], IntArray, tuple[str, ...]]:
    """Return the images (F,), the depth image nearest to each, their times (F,), and notes.

    Raises:
        DataError: a list cannot be read, or no depth image is near an image.
    """
    (times_ns, files), (depth_ns, depths) = (_read_list(path / name) for name in LISTS)
    rows_of = nearest(times_ns, depth_ns)
    near = np.abs(depth_ns[rows_of] - times_ns) <= _ASSOCIATED_NS
    if not near.any():
        raise DataError(
            f"{path / 'depth.txt'}: no depth is within {_ASSOCIATED_NS / 1e6:g} ms of an image of "
            "rgb.txt; both must "
            "use one clock"
        )
    alone = int((~near).sum())
    notes = (
        (f"{alone} images have no depth within {_ASSOCIATED_NS / 1e6:g} ms and are skipped",)
        if alone
        else ()
    )
    rows = np.flatnonzero(near)
    return [files[k] for k in rows], [depths[k] for k in rows_of[rows]], times_ns[near], notes


def _read_list(file: Path) -> tuple[IntArray, list[Path]]:
    """Read the stamps (N,) and files of a list."""
    _, *rows = table_rows(file, 2, "time file")
    times_ns = parse_stamps(
        [time for _, (time, _) in rows], lambda k: f"{file}, line {rows[k][0]}", "s"
    )
    return times_ns, [file.parent / name for _, (_, name) in rows]


def published_camera(path: Path, size: tuple[int, int]) -> Rig:
    """Return the camera that TUM publishes for a folder of this name, for images of a width and
    height in pixels.
    """
    name = next((name for name in _CAMERAS if name in path.absolute().name), "default")
    fu, fv, cu, cv, *bend = _CAMERAS[name]
    note = f"{path}: no calibration; that of TUM's camera {name!r} is taken (give another with --calibration)"
    model = CameraModel(fu, fv, cu, cv, *size, "radtan" if bend else "pinhole", tuple(bend))
    return Rig(model, notes=(note,), depth_factor=_FACTOR)
