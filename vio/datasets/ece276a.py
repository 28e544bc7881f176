"""ECE276A course files: velocities, stereo features and calibration in one `.npz` or `.npy`.

Two generations of key names are read:
`time_stamps features linear_velocity rotational_velocity K b cam_T_imu`, and
`timestamps features v_t w_t K_l K_r extL_T_imu extR_T_imu`. The latter is handed out as a pickled
dictionary of arrays in an `.npy`, with a row of `v_t` and `w_t` for each time.

In the published files of the first kind `cam_T_imu` mixes two conventions: its rotation maps the
IMU frame to the camera, but its translation is the camera's position in the IMU frame. The
consistent transform has `t = -R t_file`. The matrix alone does not reveal this, so the recording's
motion decides: see `vio.calibration.lever_arm.judge_lever_arms`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vio.calibration.lever_arm import LeverArmVerdict, judge_lever_arms
from vio.datasets.common import (
    begins_as_zip,
    check_intrinsics,
    clock_ns,
    finite_rows,
    naming,
    npz_names,
    read_npz,
    shape_text,
)
from vio.datasets.features import FeatureDataset
from vio.datasets.kitti import RECTIFIED_SHARE
from vio.datasets.pickled import begins_as_npy, is_pickled_dictionary, read_pickled_arrays
from vio.datasets.reader import Reader
from vio.datasets.samples import velocity_samples
from vio.datasets.settings import DatasetSettings, ExtrinsicsMode
from vio.datasets.tracks import moving_frames, resolve_repeats, tracks_from_dense
from vio.errors import CalibrationError, DataError
from vio.geometry.lie import FloatArray, checked_transform, se3_from_parts, se3_inverse
from vio.geometry.stereo import StereoCamera
from vio.records import FeatureTracks, IntArray, Recording

OLD_KEYS = (
    "time_stamps",
    "features",
    "linear_velocity",
    "rotational_velocity",
    "K",
    "b",
    "cam_T_imu",
)
NEW_KEYS = ("timestamps", "features", "v_t", "w_t", "K_l", "K_r", "extL_T_imu", "extR_T_imu")


class _RigRules(NamedTuple):
    """How the rig of a file is understood."""

    # difference below which both interpretations of the translation are the same
    same_m: float = 1e-3
    # largest deviation from identity of the rotation between rectified cameras
    max_deviation: float = 2e-3


_RIG = _RigRules()
# axes of an image, x right and z forward, from those of a robot, x forward and z up
_OPTICAL_FROM_FORWARD = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


@dataclass(frozen=True, slots=True)
class _Calibration:
    camera: StereoCamera
    T_cam0_imu: FloatArray  # as in the file
    ambiguous: bool  # the translation may follow either convention


def read_ece276a(path: Path, settings: DatasetSettings) -> FeatureDataset:
    """Read a course file.

    Raises:
        DataError: keys, shapes, clocks or values are wrong; the message names which and the
            expected form.
        CalibrationError: the calibration is invalid.
    """
    if begins_as_npy(path):
        arrays = read_pickled_arrays(path)
        names = frozenset(arrays)
    else:
        arrays = read_npz(path, (*OLD_KEYS, *NEW_KEYS))
        names = npz_names(path)
    if set(OLD_KEYS) <= set(arrays):
        time_key = "time_stamps"
        linear_key = "linear_velocity"
        angular_key = "rotational_velocity"
        calibration = _old_calibration(arrays, path)
    elif set(NEW_KEYS) <= set(arrays):
        time_key = "timestamps"
        linear_key = "v_t"
        angular_key = "w_t"
        calibration = _new_calibration(arrays, path)
    else:
        raise DataError(
            f"{path}: an ECE276A file needs the keys {' '.join(OLD_KEYS)} (or "
            f"{' '.join(NEW_KEYS)}); "
            f"found {' '.join(sorted(names)) or 'none'}; features of a tracker of yours are written "
            "by vio.write_observations"
        )
    features = _array(
        arrays, "features", path, lambda s: len(s) == 3 and s[0] == 4 and s[2] > 1, "4 x M x T"
    )
    count = features.shape[2]
    times_ns = clock_ns(
        _array(
            arrays,
            time_key,
            path,
            lambda s: s in ((count,), (1, count), (count, 1)),
            f"1 x {count}",
        ).reshape(-1),
        lambda k: f"{path}, {time_key}[{k}]",
    )
    linear = _velocities(arrays, linear_key, path, count)
    angular = _velocities(arrays, angular_key, path, count)
    tracks, notes = resolve_repeats(
        tracks_from_dense(features, path), moving_frames(linear, angular), settings.repeated_tracks
    )
    T_cam0_imu, extrinsics_notes = _resolve_extrinsics(
        calibration,
        tracks,
        times_ns,
        np.concatenate([linear, angular], axis=1),
        settings.extrinsics,
    )
    recording = Recording(
        kind="ece276a",
        path=path,
        camera=calibration.camera,
        T_cam0_imu=T_cam0_imu,
        frame_times_ns=times_ns,
        has_images=False,
        motion=frozenset({"velocity"}),
        reference=None,
        notes=(*extrinsics_notes, *notes),
        repeats_settled=True,
    )
    motion = velocity_samples(times_ns, linear, angular)
    return FeatureDataset(recording, tracks, motion, np.arange(count))


def _array(
    arrays: Mapping[str, np.ndarray],
    key: str,
    path: Path,
    fits: Callable[[tuple[int, ...]], bool],
    wanted: str,
) -> FloatArray:
    """One array as float64, of a fitting shape."""
    value = arrays[key]
    if not fits(value.shape) or value.dtype.kind not in "fiu":
        raise DataError(
            f"{path}: {key} has shape {shape_text(value)} and type {value.dtype}; expected "
            f"{wanted} real numbers"
        )
    return value.astype(np.float64)


def _velocities(arrays: Mapping[str, np.ndarray], key: str, path: Path, count: int) -> FloatArray:
    values = _array(
        arrays, key, path, lambda s: s in ((3, count), (count, 3)), f"3 x {count} or {count} x 3"
    )
    # of three frames the form of the file decides: a dictionary has a row for each time
    by_time = values.shape == (count, 3) and (count != 3 or begins_as_npy(path))
    rows = values if by_time else values.T
    return np.ascontiguousarray(finite_rows(rows, f"{path}: {key}"))


def _intrinsics(arrays: Mapping[str, np.ndarray], key: str, path: Path) -> FloatArray:
    K = _array(arrays, key, path, lambda s: s == (3, 3), "3 x 3")
    check_intrinsics(K, f"{path}: {key}")
    return K


def _camera(K: FloatArray, baseline_m: float, path: Path) -> StereoCamera:
    with naming(path):
        return StereoCamera(
            float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), baseline_m
        )


def _old_calibration(arrays: Mapping[str, np.ndarray], path: Path) -> _Calibration:
    K = _intrinsics(arrays, "K", path)
    b = float(_array(arrays, "b", path, lambda s: int(np.prod(s)) == 1, "one value").reshape(()))
    T = checked_transform(
        _array(arrays, "cam_T_imu", path, lambda s: s == (4, 4), "4 x 4"), f"{path}, cam_T_imu"
    )
    return _Calibration(_camera(K, b, path), T, ambiguous=True)


def _new_calibration(arrays: Mapping[str, np.ndarray], path: Path) -> _Calibration:
    """Read the newer calibration; the two extrinsics of a rectified pair determine which way
    they map, and whether their cameras look along z, as images do, or along x.
    """
    K = _intrinsics(arrays, "K_l", path)
    K_right = _intrinsics(arrays, "K_r", path)
    if not np.allclose(K, K_right, rtol=1e-6):
        raise CalibrationError(
            f"{path}: K_l and K_r differ, so the features are not rectified; rectify them first"
        )
    given = [
        checked_transform(
            _array(arrays, key, path, lambda s: s == (4, 4), "4 x 4"), f"{path}, {key}"
        )
        for key in ("extL_T_imu", "extR_T_imu")
    ]
    inverses = [se3_inverse(T) for T in given]
    # of cameras along x in the stated direction alone: the other one is that of exchanged cameras
    for left, right in (given, inverses, [_OPTICAL_FROM_FORWARD @ T for T in given]):
        T_cam1_cam0 = right @ se3_inverse(left)
        x, y, z = T_cam1_cam0[:3, 3]
        aligned = np.abs(T_cam1_cam0[:3, :3] - np.eye(3)).max() < _RIG.max_deviation
        if aligned and x < 0 and np.hypot(y, z) < RECTIFIED_SHARE * -x:
            return _Calibration(_camera(K, float(-x), path), left, ambiguous=False)
    T_cam1_cam0 = given[1] @ inverses[0]
    raise CalibrationError(
        f"{path}: extL_T_imu and extR_T_imu place the cameras "
        f"{np.round(T_cam1_cam0[:3, 3], 4).tolist()} m apart; the "
        "right camera of a rectified pair is on the left one's positive x axis, with the same "
        "orientation"
    )


def _resolve_extrinsics(
    calibration: _Calibration,
    tracks: FeatureTracks,
    times_ns: IntArray,
    velocities: FloatArray,
    mode: ExtrinsicsMode,
) -> tuple[FloatArray, tuple[str, ...]]:
    """Choose between the literal translation and the corrected one."""
    literal = calibration.T_cam0_imu
    if not calibration.ambiguous or mode == "literal":
        return literal, ()
    R = literal[:3, :3]
    t = literal[:3, 3]
    corrected = se3_from_parts(R, -R @ t)
    if np.abs(corrected - literal).max() < _RIG.same_m:
        return literal, ()
    if mode == "corrected":
        return corrected, ()
    verdict = judge_lever_arms(calibration.camera, tracks, times_ns, velocities, R, (-R.T @ t, t))
    if verdict.better == 1:
        return corrected, (_explain(verdict, t),)
    if verdict.better is None:
        return literal, (
            "cam_T_imu is taken literally: this recording turns too little to decide whether its "
            "translation is the "
            "camera's position in the IMU frame, as in the published files; set dataset.extrinsics "
            "if it is known",
        )
    return literal, ()


def _explain(verdict: LeverArmVerdict, t: FloatArray) -> str:
    x, y, z = t
    return (
        f"the translation of cam_T_imu ({x:.2f}, {y:.2f}, {z:.2f}) is the camera's position in the "
        "IMU frame, not the "
        "IMU's in the camera frame as its rotation demands: velocities and features estimate it at "
        f"{verdict.place:+.2f} +- {verdict.place_sigma:.2f} between literal (-1) and corrected "
        "(+1); "
        "corrected to t = -R t (dataset.extrinsics=literal keeps it)"
    )


READERS = (
    Reader(
        kind="ece276a",
        looked_for="an ECE276A .npz or .npy",
        read=read_ece276a,
        # a log of observations is asked for before
        is_file=lambda path: begins_as_zip(path) or is_pickled_dictionary(path),
    ),
)
