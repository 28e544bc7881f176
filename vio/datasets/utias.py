"""UTIAS course files: KITTI drives tracked by KLT, and the Starry Night rig, as MATLAB `.mat`.

Conventions, verified on the data by the tests: `p_c = C_c_v (p_v - rho_v_c_v)`, and `theta_vk_i` is
the rotation vector of `R_i_v`, which maps the vehicle's axes to the inertial frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from vio.datasets.common import clock_ns, finite_rows, naming, shape_text
from vio.datasets.features import FeatureDataset
from vio.datasets.mat_files import read_variables
from vio.datasets.reader import Reader
from vio.datasets.samples import velocity_samples
from vio.datasets.settings import DatasetSettings
from vio.datasets.tracks import moving_frames, resolve_repeats, tracks_from_dense
from vio.errors import DataError
from vio.geometry.lie import FloatArray, checked_transform, se3_from_parts, so3_exp
from vio.geometry.stereo import StereoCamera
from vio.records import IntArray, Landmarks, Recording, Trajectory

KEYS = ("y_k_j", "t", "v_vk_vk_i", "w_vk_vk_i", "fu", "fv", "cu", "cv", "b", "C_c_v", "rho_v_c_v")
OPTIONAL_KEYS = ("r_i_vk_i", "theta_vk_i", "rho_i_pj_i")


def read_utias(path: Path, settings: DatasetSettings) -> FeatureDataset:
    """Read a course file; velocities and poses after the last feature frame are ignored.

    Raises:
        DataError: variables, shapes, clocks or values are wrong; the message names which and the
            expected form.
        CalibrationError: the calibration is invalid.
    """
    arrays = _read_mat(path)
    features = arrays["y_k_j"]
    if features.ndim != 3 or features.shape[0] != 4 or features.shape[1] < 2:
        raise DataError(
            f"{path}: y_k_j has shape {shape_text(features)}; expected 4 x T x M with at least two "
            "frames"
        )
    count = features.shape[1]
    times_ns = clock_ns(_rows(arrays, "t", path, 1, count)[:, 0], lambda k: f"{path}, t[{k}]")
    linear = _finite(arrays, "v_vk_vk_i", path, count)
    angular = _finite(arrays, "w_vk_vk_i", path, count)
    tracks, notes = resolve_repeats(
        tracks_from_dense(np.swapaxes(features, 1, 2), path),
        moving_frames(linear, angular),
        settings.repeated_tracks,
    )
    longest = max(arrays[key].shape[1] for key in ("v_vk_vk_i", "w_vk_vk_i"))
    if longest > count:
        notes = (
            f"velocities cover {longest} frames, features {count}; the first {count} are read",
            *notes,
        )
    recording = Recording(
        kind="utias",
        path=path,
        camera=_camera(arrays, path),
        T_cam0_imu=_extrinsics(arrays, path),
        frame_times_ns=times_ns,
        has_images=False,
        motion=frozenset({"velocity"}),
        reference=_reference(arrays, path, times_ns),
        landmarks_reference=_landmarks(arrays, path, features.shape[2]),
        notes=notes,
        repeats_settled=True,
    )
    motion = velocity_samples(times_ns, linear, angular)
    return FeatureDataset(recording, tracks, motion, np.arange(count))


def _read_mat(path: Path) -> Mapping[str, FloatArray]:
    known = (*KEYS, *OPTIONAL_KEYS)
    shapes, raw = read_variables(path, lambda _: known)
    _check_names(shapes, path)
    wanted = [name for name in known if name in shapes]
    for key in wanted:
        if not isinstance(raw.get(key), np.ndarray) or raw[key].dtype.kind not in "fiu":
            raise DataError(f"{path}: {key} is not an array of real numbers; save it again as one")
    return {key: raw[key].astype(np.float64) for key in wanted}


def _check_names(names: Iterable[str], path: Path) -> None:
    """Raise DataError where a variable is missing among those of a file."""
    held = sorted(name for name in names if not name.startswith("__"))
    if missing := [key for key in KEYS if key not in held]:
        raise DataError(
            f"{path}: lacks {' '.join(missing)}; a UTIAS file needs {' '.join(KEYS)}, found "
            f"{' '.join(held)}"
        )


def _rows(
    arrays: Mapping[str, FloatArray], key: str, path: Path, rows: int, count: int
) -> FloatArray:
    """The first `count` columns of a (rows, >= count) array, as (count, rows)."""
    value = arrays[key]
    if value.ndim != 2 or value.shape[0] != rows or value.shape[1] < count:
        raise DataError(
            f"{path}: {key} has shape {shape_text(value)}; expected {rows} x T with T at least "
            f"{count}"
        )
    return np.ascontiguousarray(value[:, :count].T)


def _finite(arrays: Mapping[str, FloatArray], key: str, path: Path, count: int) -> FloatArray:
    """The first `count` columns of a finite (3, >= count) array, as (count, 3)."""
    return finite_rows(_rows(arrays, key, path, 3, count), f"{path}: {key}")


def _vector(arrays: Mapping[str, FloatArray], key: str, path: Path, size: int) -> FloatArray:
    value = arrays[key].reshape(-1)
    if len(value) != size or not np.isfinite(value).all():
        raise DataError(
            f"{path}: {key} has shape {shape_text(arrays[key])}; expected {size} finite value(s)"
        )
    return value


def _camera(arrays: Mapping[str, FloatArray], path: Path) -> StereoCamera:
    fu, fv, cu, cv, b = (
        float(_vector(arrays, key, path, 1)[0]) for key in ("fu", "fv", "cu", "cv", "b")
    )
    with naming(path):
        return StereoCamera(fu, fv, cu, cv, b)


def _extrinsics(arrays: Mapping[str, FloatArray], path: Path) -> FloatArray:
    C = arrays["C_c_v"]
    rho = _vector(arrays, "rho_v_c_v", path, 3)
    if C.shape != (3, 3):
        raise DataError(f"{path}: C_c_v has shape {shape_text(C)}; expected 3 x 3")
    return checked_transform(np.concatenate([C, (-C @ rho)[:, None]], axis=1), f"{path}, C_c_v")


def _reference(
    arrays: Mapping[str, FloatArray], path: Path, times_ns: IntArray
) -> Trajectory | None:
    if not {"r_i_vk_i", "theta_vk_i"} <= set(arrays):
        return None
    count = len(times_ns)
    r = _finite(arrays, "r_i_vk_i", path, count)
    theta = _finite(arrays, "theta_vk_i", path, count)
    return Trajectory(se3_from_parts(so3_exp(theta), r), times_ns, "imu", np.arange(count))


def _landmarks(arrays: Mapping[str, FloatArray], path: Path, count: int) -> Landmarks | None:
    if "rho_i_pj_i" not in arrays:
        return None
    p = _finite(arrays, "rho_i_pj_i", path, count)
    return Landmarks(np.arange(count), p, np.zeros((count, 3, 3)))


def _is_matlab_file(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(6) == b"MATLAB"


READERS = (
    Reader(kind="utias", looked_for="a UTIAS .mat", read=read_utias, is_file=_is_matlab_file),
)
