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
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.tables import table_rows
from vio.errors import DataError
from vio.files.stamps import parse_stamps
from vio.geometry.distortion import CameraModel
from vio.records import IntArray

LISTS = ("rgb.txt", "depth.txt")
DEPTH_FACTOR = 5000.0  # levels per metre of TUM's depth images
# as TUM's own tool associates colour and depth, which have exposures of their own
_ASSOCIATED_NS = 20_000_000
# Words of the folder's name, and the intrinsics with radial-tangential distortion of the camera
# that is published for it, where the sequences have no file of them: TUM's three cameras, Bonn's
# dynamic sequences (Palazzolo et al., ReFusion, 2019), and ICL-NUIM's rendered rooms (Handa et al.,
# 2014).
_PUBLISHED: tuple[tuple[str, tuple[str, ...], tuple[float, ...]], ...] = (
    ("TUM's freiburg1", ("freiburg1",),
     (517.306408, 516.469215, 318.643040, 255.313989, 0.262383, -0.953104, -0.005358, 0.002628, 1.163314)),
    ("TUM's freiburg2", ("freiburg2",),
     (520.908620, 521.007327, 325.141442, 249.701764, 0.231222, -0.784899, -0.003257, -0.000105, 0.917205)),
    ("TUM's freiburg3", ("freiburg3",), (535.4, 539.2, 320.1, 247.6)),
    ("Bonn's", ("rgbd_bonn", "bonn_"),
     (542.822841, 542.576870, 315.593520, 237.756098, 0.039903, -0.099343, -0.000730, -0.000144, 0.0)),
    ("ICL-NUIM's", ("frei_png", "living_room_traj", "office_room_traj", "office_traj", "icl_nuim", "icl-nuim"),
     (481.20, 480.0, 319.5, 239.5)),
)  # fmt: skip
_DEFAULT = (525.0, 525.0, 319.5, 239.5)  # ROS's of a Kinect


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
    """Return the camera that is published for a folder of this name, for images of a width and
    height in pixels.

    For a name that is not known it is that of a Kinect by default, which is doubted.
    """
    folder = path.absolute().name.lower()
    named = next(
        ((whose, values) for whose, words, values in _PUBLISHED if any(w in folder for w in words)),
        None,
    )
    whose, values = named or ("a Kinect's default", _DEFAULT)
    fu, fv, cu, cv, *bend = values
    note = f"{path}: no calibration; that of {whose} camera is taken, by the folder's name"
    if named is None:
        note = (
            f"{path}: doubtful: no calibration, and the folder is named as no data set that is "
            f"known; {fu:g} px, a Kinect's default, is taken"
        )
    note += " (give another with --calibration, or as calibration.txt with 'fx fy cx cy')"
    model = CameraModel(fu, fv, cu, cv, *size, "radtan" if bend else "pinhole", tuple(bend))
    rig = Rig(model, notes=(note,), depth_factor=DEPTH_FACTOR)
    return checked_rig(rig, path, size_stated=False)
