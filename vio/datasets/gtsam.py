"""GTSAM's stereo factor files as precomputed features: `VO_stereo_factors_large.txt` and their
like.

Each row is `pose landmark uL uR v X Y Z`: rectified pixels, and a point in the camera's frame that
is not used. The calibration `fx fy s u0 v0 b` and, where there are any, the poses (`pose` and a
row-major 4 x 4 `T_world_cam`) lie beside it, named with `calibration` and `camera_poses` in the
place of `stereo_factors`. The files state no times: frames are taken to be 0.1 s apart, as in
KITTI, on which GTSAM's examples are.
Reference: StereoVOExample_large.cpp of GTSAM, which reads these files, and Cal3_S2Stereo for the
calibration.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from vio.datasets.common import naming
from vio.datasets.features import FeatureDataset
from vio.datasets.reader import Reader
from vio.datasets.settings import DatasetSettings, are_repeats_used
from vio.datasets.tracks import refuse_swapped
from vio.errors import CalibrationError, DataError
from vio.files.stamps import ASSUMED_STEP_NS
from vio.files.text import read_numbers
from vio.geometry.lie import FloatArray, nearest_rotation, rigid_fault, se3_from_parts
from vio.geometry.stereo import StereoCamera
from vio.records import FeatureTracks, IntArray, Recording, Trajectory

_FACTORS = "stereo_factors"
_COLUMNS = "pose landmark uL uR v X Y Z"


def is_factor_file(path: Path) -> bool:
    """Return whether a file is one of stereo factors by its name, by which its calibration is
    found, too.
    """
    return _FACTORS in path.name and path.suffix == ".txt"


def factor_files(folder: Path) -> tuple[Path, ...]:
    """Return the factor files of a folder by their names."""
    return tuple(
        sorted(path for path in folder.iterdir() if is_factor_file(path) and path.is_file())
    )


def read_gtsam(path: Path, settings: DatasetSettings | None = None) -> FeatureDataset:
    """Read a file of stereo factors, or the only one of a folder.

    Raises:
        DataError: rows are malformed, repeated or swapped, or a folder holds several files.
        CalibrationError: the calibration is missing or invalid.
    """
    file = _only_file(path)
    table = read_numbers(file, 8)
    frames, ids, pixels = _checked(table, file)
    numbers, of_row = np.unique(frames, return_inverse=True)
    if len(numbers) < 2:
        raise DataError(f"{file}: holds one pose; visual odometry needs the factors of two or more")
    order = np.lexsort((ids, of_row))
    offsets = np.searchsorted(of_row[order], np.arange(len(numbers) + 1)).astype(np.int64)
    z = np.column_stack([pixels[:, 0], pixels[:, 2], pixels[:, 1], pixels[:, 2]])[order]
    rows = len(order)
    tracks = FeatureTracks(
        offsets, ids[order], z, np.ones(rows, dtype=np.bool_), np.zeros(rows, dtype=np.bool_)
    )
    refuse_swapped(tracks, file)
    times_ns: IntArray = (numbers - numbers[0]) * ASSUMED_STEP_NS
    poses_file = _beside(file, "camera_poses")
    reference = None
    if poses_file is not None:
        reference = _reference(poses_file, numbers, times_ns)
    recording = Recording(
        kind="gtsam",
        path=path,
        camera=_camera(file),
        T_cam0_imu=None,
        frame_times_ns=times_ns,
        has_images=False,
        motion=frozenset(),
        reference=reference,
        notes=(
            f"{file.name} states no times; frames are taken to be {ASSUMED_STEP_NS * 1e-9:g} s apart, so "
            "speeds are unknown",
            f"not used: the points X Y Z of {file.name}",
        ),
        repeats_settled=are_repeats_used(settings),
    )
    return FeatureDataset(recording, tracks, (), np.arange(len(numbers)))


def _only_file(path: Path) -> Path:
    if not path.is_dir():
        return path
    found = factor_files(path)
    if len(found) != 1:
        names = ", ".join(file.name for file in found) or f"no *{_FACTORS}*.txt"
        example = f", such as {found[0]}" if found else ""
        raise DataError(f"{path} holds {names}; name one file of stereo factors{example}")
    return found[0]


def _checked(table: FloatArray, file: Path) -> tuple[IntArray, IntArray, FloatArray]:
    """Return frame numbers (R,), landmark ids (R,) and pixels uL, uR, v (R, 3) of the rows."""
    whole = (table[:, :2] == np.floor(table[:, :2])) & (np.abs(table[:, :2]) < 2.0**53)
    bad = ~(whole.all(axis=1) & np.isfinite(table[:, 2:5]).all(axis=1))
    if bad.any():
        row = table[int(np.argmax(bad)), :5].tolist()
        raise DataError(
            f"{file}, line {int(np.argmax(bad)) + 1}: {row} is no row '{_COLUMNS}'; remove or "
            "correct it"
        )
    keys = table[:, :2].astype(np.int64)
    _, first, counts = np.unique(keys, axis=0, return_index=True, return_counts=True)
    if (counts > 1).any():
        pose, landmark = keys[first[int(np.argmax(counts > 1))]].tolist()
        raise DataError(
            f"{file}: pose {pose} sees landmark {landmark} more than once; keep one of these rows"
        )
    return keys[:, 0], keys[:, 1], table[:, 2:5]


def _beside(file: Path, what: str) -> Path | None:
    """Return the file named with `what` in the place of `stereo_factors`, or the same without
    its last `_word`.
    """
    name = file.name.replace(_FACTORS, what)
    candidates = (file.with_name(name), file.with_name(re.sub(rf"(?<={what})_\w+(?=\.)", "", name)))
    return next((path for path in candidates if path != file and path.is_file()), None)


def _camera(file: Path) -> StereoCamera:
    path = _beside(file, "calibration")
    if path is None:
        raise CalibrationError(
            f"{file}: no calibration; put its 'fx fy s u0 v0 b' beside it, into "
            f"{file.name.replace(_FACTORS, 'calibration')}"
        )
    values = read_numbers(path, 6)
    if values.shape != (1, 6) or values[0, 2] != 0.0:
        raise CalibrationError(
            f"{path}: expected one line 'fx fy s u0 v0 b' with a skew s of zero; copy it again"
        )
    fu, fv, _, cu, cv, baseline_m = values[0].tolist()
    with naming(path):
        return StereoCamera(fu, fv, cu, cv, baseline_m)


def _reference(path: Path, numbers: IntArray, times_ns: IntArray) -> Trajectory:
    """Return the poses of the frames that have one, as those of cam0.

    The lines hold `pose`, which numbers a frame as the factors do, and a row-major 4 x 4
    `T_world_cam` of six digits.
    """
    table = read_numbers(path, 17)
    poses = table[:, 1:].reshape(-1, 4, 4)
    own = table[:, 0]
    for row, T in enumerate(poses):
        if np.isfinite(table[row]).all():
            fault = rigid_fault(T)
        else:
            fault = "values are not finite"
        if row and not own[row] > own[row - 1]:
            fault = "its number does not increase"
        if fault:
            raise DataError(
                f"{path}, line {row + 1}: {fault}; expected 'pose' and 16 numbers of a 4x4 pose"
            )
    T_world_cam = se3_from_parts(nearest_rotation(poses[:, :3, :3]), poses[:, :3, 3])
    _, in_poses, in_frames = np.intersect1d(
        own.astype(np.int64), numbers, assume_unique=True, return_indices=True
    )
    if not len(in_poses):
        raise DataError(
            f"{path}: numbers none of the frames of the factors; give the poses of this file, or "
            "remove it"
        )
    return Trajectory(
        T_world_cam[in_poses], times_ns[in_frames], "cam0", in_frames.astype(np.int64)
    )


READERS = (
    Reader(
        kind="gtsam",
        looked_for="GTSAM's stereo factors (*stereo_factors*.txt)",
        read=read_gtsam,
        is_folder=lambda path: bool(factor_files(path)),
        is_file=is_factor_file,
    ),
)
