"""The UTIAS reader: conventions verified on the data, bad input, synthetic files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from tests.dataset_makers import (
    CAMERA,
    T_CAM0_IMU,
    Arrays,
    changed,
    edited,
    make_drive,
    make_mat,
    utias_arrays,
    without,
)
from vio.datasets.features import FeatureDataset
from vio.datasets.settings import DatasetSettings
from vio.datasets.utias import read_utias
from vio.errors import CalibrationError, DataError
from vio.geometry.lie import FloatArray, se3_inverse, so3_log, transform_points
from vio.geometry.stereo import StereoCamera, project, triangulate
from vio.records import VelocitySample

DEFAULT = DatasetSettings()
DRIVES = {  # file, frames, features
    "2011_09_26_drive_0001_sync_KLT.mat": (108, 707),
    "2011_09_26_drive_0005_sync_KLT.mat": (154, 911),
    "2011_09_26_drive_0036_sync_KLT.mat": (250, 1183),
    "2011_09_26_drive_0051_sync_KLT.mat": (125, 741),
    "2011_09_30_drive_0020_sync_KLT.mat": (1000, 6707),
}


def test_reads_a_synthetic_file_completely(tmp_path: Path) -> None:
    drive = make_drive(8)
    dataset = read_utias(make_mat(tmp_path / "a.mat", utias_arrays(drive)), DEFAULT)
    recording = dataset.recording
    np.testing.assert_allclose(recording.camera.M, CAMERA.M, rtol=1e-12)
    np.testing.assert_allclose(recording.T_cam0_imu, T_CAM0_IMU, atol=1e-12)
    assert recording.reference.body == "imu"
    np.testing.assert_array_equal(recording.reference.times_ns, recording.frame_times_ns)
    np.testing.assert_allclose(recording.reference.T_world_body, drive.T_world_imu, atol=1e-12)
    assert recording.landmarks_reference is None
    assert recording.notes == ("velocities cover 11 frames, features 8; the first 8 are read",)
    observed = dataset.observations(5)
    seen = np.flatnonzero(drive.features[0, :, 5] != -1)
    np.testing.assert_array_equal(observed.ids, seen)
    np.testing.assert_array_equal(observed.z, drive.features[:, seen, 5].T)


def test_pose_arrays_may_be_absent(tmp_path: Path) -> None:
    arrays = {
        k: v for k, v in utias_arrays(make_drive(8)).items() if k not in ("r_i_vk_i", "theta_vk_i")
    }
    assert read_utias(make_mat(tmp_path / "a.mat", arrays), DEFAULT).recording.reference is None


@pytest.mark.parametrize(
    ("corrupt", "kind", "message"),
    [
        (without("b", "t"), DataError, r"lacks t b; a UTIAS file needs y_k_j .*, found C_c_v"),
        (
            changed("y_k_j", np.zeros((4, 6))),
            DataError,
            r"y_k_j has shape 4 x 6; expected 4 x T x M",
        ),
        (changed("y_k_j", "text"), DataError, r"y_k_j is not an array of real numbers"),
        (
            changed("v_vk_vk_i", np.zeros((3, 4))),
            DataError,
            r"v_vk_vk_i has shape 3 x 4; expected 3 x T with T at least 6",
        ),
        (
            lambda a: {**a, "theta_vk_i": "text"},
            DataError,
            r"theta_vk_i is not an array of real numbers",
        ),
        (changed("theta_vk_i", np.zeros((3, 4))), DataError, r"theta_vk_i has shape 3 x 4"),
        (
            edited("w_vk_vk_i", (0, 2), np.nan),
            DataError,
            r"w_vk_vk_i is not finite in 1 of 6 frames, first in frame 2",
        ),
        (edited("t", (0, 2), 0.0), DataError, r"t\[2\]: the clock runs backwards"),
        (changed("b", 0.0), CalibrationError, r"\.mat: stereo baseline must be positive, got 0 m"),
        (changed("fu", [1.0, 2.0]), DataError, r"fu has shape 1 x 2; expected 1 finite"),
        (changed("C_c_v", np.diag([1.0, 1, 2])), CalibrationError, r"C_c_v: not a rotation"),
        (changed("C_c_v", np.eye(2)), DataError, r"C_c_v has shape 2 x 2"),
        (changed("rho_v_c_v", np.zeros(2)), DataError, r"rho_v_c_v has shape 1 x 2; expected 3"),
        (
            lambda a: {**a, "y_k_j": a["y_k_j"][[2, 3, 0, 1]]},
            DataError,
            r"left and right look swapped",
        ),
    ],
)
def test_rejects_bad_files_with_one_line_error(
    corrupt: Callable[[Arrays], Arrays], kind: type[Exception], message: str, tmp_path: Path
) -> None:
    path = make_mat(tmp_path / "bad.mat", corrupt(utias_arrays(make_drive(6))))
    with pytest.raises(kind, match=message) as caught:
        read_utias(path, DEFAULT)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("size", [0, 60, 128, 3000])
def test_rejects_a_truncated_file(size: int, tmp_path: Path) -> None:
    path = make_mat(tmp_path / "cut.mat", utias_arrays(make_drive(6)))
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(DataError, match=r"cut\.mat"):
        read_utias(path, DEFAULT)


def test_error_for_newer_matlab_files_states_the_remedy(tmp_path: Path) -> None:
    path = tmp_path / "new.mat"
    path.write_bytes(
        b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\x89HDF\r\n\x1a\n" + bytes(600)
    )
    with pytest.raises(DataError, match=r"MATLAB 7\.3 file; save it again with `save -v7`"):
        read_utias(path, DEFAULT)


# --- the published files
# ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drives(data_dir: Path) -> dict[str, FeatureDataset]:
    return {name: read_utias(data_dir / "utias_kitti_klt" / name, DEFAULT) for name in DRIVES}


@pytest.fixture(scope="module")
def starry_night(data_dir: Path) -> FeatureDataset:
    return read_utias(data_dir / "utias_starry_night" / "dataset3.mat", DEFAULT)


def _angular(dataset: FeatureDataset) -> FloatArray:
    return np.array([m.angular for m in dataset.motion if isinstance(m, VelocitySample)])


@pytest.mark.parametrize("name", DRIVES)
def test_published_drive(name: str, drives: dict[str, FeatureDataset]) -> None:
    dataset = drives[name]
    frames, _ = DRIVES[name]
    assert len(dataset.recording.frame_times_ns) == len(dataset.motion) == frames
    assert dataset.recording.camera.baseline_m == pytest.approx(0.53715, abs=1e-5)
    assert not dataset.tracks.stale.any()
    reference = dataset.recording.reference
    assert len(reference) == frames
    np.testing.assert_allclose(reference.T_world_body[0], np.eye(4), atol=1e-12)


@pytest.mark.parametrize("name", DRIVES)
def test_theta_is_the_rotation_vector_from_vehicle_to_inertial_axes(
    name: str, drives: dict[str, FeatureDataset]
) -> None:
    """`R_i_v = exp(theta)` agrees with the measured rates; `exp(-theta)` does not."""
    dataset = drives[name]
    reference = dataset.recording.reference
    R = reference.T_world_body[:, :3, :3]
    dt = np.diff(dataset.recording.frame_times_ns)[:, None] * 1e-9
    w = _angular(dataset)
    errors = [
        np.median(np.abs(so3_log(np.swapaxes(Q[:-1], 1, 2) @ Q[1:]) / dt - (w[:-1] + w[1:]) / 2))
        for Q in (R, np.swapaxes(R, 1, 2))
    ]
    assert errors[0] < 0.006
    assert errors[1] > 3 * errors[0]


@pytest.mark.parametrize(
    "name", ["2011_09_26_drive_0005_sync_KLT.mat", "2011_09_26_drive_0036_sync_KLT.mat"]
)
def test_features_reproject_under_the_reference_with_these_extrinsics(
    name: str, drives: dict[str, FeatureDataset]
) -> None:
    """Three frames ahead; the translation of the other convention (position in place of -R
    position) is worse.
    """
    dataset = drives[name]
    recording = dataset.recording
    other = recording.T_cam0_imu.copy()
    other[:3, 3] = -recording.T_cam0_imu[:3, :3].T @ recording.T_cam0_imu[:3, 3]
    medians = []
    for T_cam0_imu in (recording.T_cam0_imu, other):
        poses = recording.reference.T_world_body @ se3_inverse(T_cam0_imu)
        medians.append(
            np.median(
                np.concatenate([_ahead(dataset, poses, t) for t in range(0, len(poses) - 3, 2)])
            )
        )
    assert medians[0] < 2.5
    assert medians[0] < 0.95 * medians[1]


def _ahead(dataset: FeatureDataset, poses: FloatArray, t: int) -> FloatArray:
    here, there = dataset.observations(t), dataset.observations(t + 3)
    common, a, b = np.intersect1d(here.ids, there.ids, return_indices=True)
    p, valid = triangulate(dataset.recording.camera, here.z[a], min_disparity_px=2.0)
    p = transform_points(se3_inverse(poses[t + 3]) @ poses[t], p)
    valid &= p[:, 2] > 2
    error = project(dataset.recording.camera, np.where(valid[:, None], p, 1.0)) - there.z[b]
    assert len(common) == len(error)
    out: FloatArray = np.linalg.norm(error[valid, :2], axis=1)
    return out


def test_starry_night(starry_night: FeatureDataset) -> None:
    recording = starry_night.recording
    assert len(recording.frame_times_ns) == 1900
    assert recording.frame_times_ns[1] == 47002360
    assert recording.camera == StereoCamera(
        484.49984741211, 484.4998474121, 321.68048095703, 247.4814453125, 0.23997700214386
    )
    assert recording.landmarks_reference.p_world.shape == (20, 3)
    assert not recording.landmarks_reference.covariance.any()
    # it repeats integer pixels, but only while stationary
    assert not starry_night.tracks.stale.any()


def test_starry_night_reprojects_with_the_published_variance(
    data_dir: Path, starry_night: FeatureDataset
) -> None:
    """Reprojection of the known landmarks from the known poses has exactly the file's `y_var`."""
    recording = starry_night.recording
    y_var = loadmat(data_dir / "utias_starry_night" / "dataset3.mat")["y_var"].reshape(-1)
    poses = recording.reference.in_cam0(recording.T_cam0_imu).T_world_body
    frames = starry_night.tracks.frames
    p_world = recording.landmarks_reference.p_world[starry_night.tracks.ids]
    T = se3_inverse(poses)[frames]
    p_cam = np.einsum("nij,nj->ni", T[:, :3, :3], p_world) + T[:, :3, 3]
    error = starry_night.tracks.z - project(recording.camera, p_cam)
    np.testing.assert_allclose(error.var(axis=0, ddof=1), y_var, rtol=2e-3)
