"""The ECE276A reader: both key generations, mixed extrinsics, stale frames, bad input, the
published files.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.dataset_makers import (
    CAMERA,
    LEVER_M,
    R_CAM0_IMU,
    T_CAM0_IMU,
    Arrays,
    Drive,
    changed,
    ece276a_arrays,
    ece276a_new_arrays,
    edited,
    make_drive,
    make_npz,
)
from vio.calibration.egomotion import stereo_twists
from vio.datasets import open_dataset
from vio.datasets.common import read_npz
from vio.datasets.ece276a import read_ece276a
from vio.datasets.features import FeatureDataset
from vio.datasets.settings import DatasetSettings
from vio.datasets.tracks import moving_frames, tracks_from_dense
from vio.errors import CalibrationError, DataError
from vio.files.trajectories import read_trajectory
from vio.geometry.lie import (
    FloatArray,
    se3_adjoint,
    se3_from_parts,
    se3_inverse,
    se3_log,
    transform_points,
)
from vio.geometry.stereo import StereoCamera, project, triangulate
from vio.records import BoolArray, FeatureTracks

DEFAULT = DatasetSettings()


def mixed(arrays: Arrays) -> Arrays:
    """Write the camera's position into the translation, as the published files do."""
    return {**arrays, "cam_T_imu": se3_from_parts(R_CAM0_IMU, LEVER_M)}


@pytest.fixture(scope="module")
def long_drive() -> Drive:
    """A drive with enough rotation to distinguish the two extrinsics under the noise of the
    course files.
    """
    drive = make_drive(220, seed=3, pixel_sigma=0.3)
    noise = np.random.default_rng(4).standard_normal(drive.velocities.shape) * [
        0.5,
        0.5,
        0.5,
        0.05,
        0.05,
        0.05,
    ]
    return replace(drive, velocities=drive.velocities + noise)


@pytest.mark.parametrize("arrays_of", [ece276a_arrays, ece276a_new_arrays])
def test_reads_a_synthetic_file_completely(
    arrays_of: Callable[[Drive], Arrays], tmp_path: Path
) -> None:
    drive = make_drive(8)
    dataset = read_ece276a(make_npz(tmp_path / "a.npz", arrays_of(drive)), DEFAULT)
    recording = dataset.recording
    np.testing.assert_allclose(recording.camera.M, CAMERA.M, rtol=1e-12)
    np.testing.assert_allclose(recording.T_cam0_imu, T_CAM0_IMU, atol=1e-12)
    # doubles near 1.3e9 s
    np.testing.assert_allclose(np.diff(recording.frame_times_ns), 100_000_000, atol=480)
    for t in range(8):
        observed = dataset.observations(t)
        seen = np.flatnonzero(drive.features[0, :, t] != -1)
        np.testing.assert_array_equal(observed.ids, seen)
        np.testing.assert_array_equal(observed.z, drive.features[:, seen, t].T)
        assert observed.has_right.all()
        assert not observed.stale.any()
    np.testing.assert_array_equal([m.angular for m in dataset.motion], drive.velocities[:, 3:])  # type: ignore[union-attr]


def test_accepts_newer_extrinsics_in_both_directions(tmp_path: Path) -> None:
    arrays = ece276a_new_arrays(make_drive(6))
    for key in ("extL_T_imu", "extR_T_imu"):
        arrays[key] = se3_inverse(arrays[key])
    dataset = read_ece276a(make_npz(tmp_path / "a.npz", arrays), DEFAULT)
    np.testing.assert_allclose(dataset.recording.T_cam0_imu, T_CAM0_IMU, atol=1e-12)


def make_npy(path: Path, arrays: Arrays, **others: object) -> Path:
    """Write the dictionary of arrays that the course hands out since 2025: a row for each time."""
    by_time = {key: arrays[key].T for key in ("v_t", "w_t")}
    np.save(path, {**arrays, **by_time, **others}, allow_pickle=True)  # type: ignore[arg-type] # a dictionary is one object
    return path


@pytest.mark.parametrize("frames", [3, 6])
def test_a_pickled_dictionary_is_read_as_the_archive(frames: int, tmp_path: Path) -> None:
    arrays = ece276a_new_arrays(make_drive(frames))
    archive = open_dataset(make_npz(tmp_path / "a.npz", arrays))
    dataset = open_dataset(make_npy(tmp_path / "a.npy", arrays))
    assert isinstance(archive, FeatureDataset)
    assert isinstance(dataset, FeatureDataset)
    assert dataset.recording.kind == "ece276a"
    np.testing.assert_array_equal(dataset.tracks.z, archive.tracks.z)
    for ours, expected in zip(dataset.motion, archive.motion, strict=True):
        np.testing.assert_array_equal(ours.linear, expected.linear)
        np.testing.assert_array_equal(ours.angular, expected.angular)


def test_lists_of_other_lengths_beside_the_arrays_are_passed_over(tmp_path: Path) -> None:
    path = make_npy(
        tmp_path / "a.npy", ece276a_new_arrays(make_drive(6)), seen_by=[[1, 2], [3]], of={"a": 1}
    )
    assert open_dataset(path).recording.kind == "ece276a"


def test_extrinsics_of_cameras_that_look_along_x_are_turned(tmp_path: Path) -> None:
    arrays = ece276a_new_arrays(make_drive(6))
    forward = np.eye(4)  # x forward, y left, z up, from the image's x right, y down, z forward
    forward[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    for key in ("extL_T_imu", "extR_T_imu"):
        arrays[key] = forward @ arrays[key]
    dataset = read_ece276a(make_npy(tmp_path / "a.npy", arrays), DEFAULT)
    np.testing.assert_allclose(dataset.recording.T_cam0_imu, T_CAM0_IMU, atol=1e-12)
    assert dataset.recording.camera.baseline_m == pytest.approx(CAMERA.baseline_m)


class _Runs:
    """An object that a pickle makes by calling a function."""

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (Path("touched"),)


def test_a_dictionary_that_would_run_code_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = make_npy(tmp_path / "a.npy", ece276a_new_arrays(make_drive(6)), more=_Runs())
    with pytest.raises(DataError, match=r"a\.npy: no arrays can be read of it"):
        open_dataset(path)
    assert not (tmp_path / "touched").exists()


def test_a_dictionary_without_features_and_a_cut_one_are_named(tmp_path: Path) -> None:
    path = make_npy(tmp_path / "a.npy", ece276a_new_arrays(make_drive(6)), features=None)
    with pytest.raises(DataError, match=r"found K_l .* are written by vio\.write_observations"):
        open_dataset(path)
    path.write_bytes(path.read_bytes()[:900])
    with pytest.raises(DataError, match=r"a\.npy: no arrays can be read of it"):
        open_dataset(path)


def test_left_only_features_have_no_right_pixel(tmp_path: Path) -> None:
    arrays = ece276a_arrays(make_drive(6))
    j = int(np.flatnonzero(arrays["features"][0, :, 3] != -1)[0])
    arrays["features"][2:, j, 3] = -1
    observed = read_ece276a(make_npz(tmp_path / "a.npz", arrays), DEFAULT).observations(3)
    assert observed.ids[~observed.has_right].tolist() == [j]


# --- extrinsics
# --------------------------------------------------------------------------------------------------


def test_corrects_mixed_extrinsics_and_adds_a_note(long_drive: Drive, tmp_path: Path) -> None:
    path = make_npz(tmp_path / "a.npz", mixed(ece276a_arrays(long_drive)))
    recording = read_ece276a(path, DEFAULT).recording
    np.testing.assert_allclose(recording.T_cam0_imu, T_CAM0_IMU, atol=1e-12)
    extrinsics_notes = [
        note for note in recording.notes if "camera's position in the IMU frame" in note
    ]
    assert len(extrinsics_notes) == 1
    assert "corrected to t = -R t" in extrinsics_notes[0]


def test_keeps_consistent_extrinsics(long_drive: Drive, tmp_path: Path) -> None:
    recording = read_ece276a(
        make_npz(tmp_path / "a.npz", ece276a_arrays(long_drive)), DEFAULT
    ).recording
    np.testing.assert_array_equal(recording.T_cam0_imu, T_CAM0_IMU)
    assert recording.notes == ()


def test_keeps_undetermined_extrinsics_of_a_straight_drive_and_adds_a_note(tmp_path: Path) -> None:
    drive = make_drive(60, pixel_sigma=0.3, yaw_rate=0.0)
    recording = read_ece276a(
        make_npz(tmp_path / "a.npz", mixed(ece276a_arrays(drive))), DEFAULT
    ).recording
    np.testing.assert_array_equal(recording.T_cam0_imu[:3, 3], LEVER_M)
    assert "turns too little" in recording.notes[0]


@pytest.mark.parametrize(
    ("mode", "t"), [("literal", LEVER_M), ("corrected", -R_CAM0_IMU @ LEVER_M)]
)
def test_extrinsics_mode_is_a_setting(mode: str, t: FloatArray, tmp_path: Path) -> None:
    path = make_npz(tmp_path / "a.npz", mixed(ece276a_arrays(make_drive(6))))
    recording = read_ece276a(path, DatasetSettings(extrinsics=mode)).recording  # type: ignore[arg-type]
    np.testing.assert_allclose(recording.T_cam0_imu[:3, 3], t, atol=1e-12)
    assert recording.notes == ()


def test_stereo_twists_equal_the_true_motion() -> None:
    drive = make_drive(12)
    tracks = tracks_from_dense(drive.features, Path("made"))
    times = np.arange(12) * 100_000_000
    truth = drive.velocities[:-1] @ se3_adjoint(T_CAM0_IMU).T
    found = stereo_twists(CAMERA, tracks, times, np.zeros((11, 6)))
    assert found.frames.tolist() == list(range(11))
    np.testing.assert_allclose(found.twists, truth, atol=1e-6)


# --- stale frames
# -------------------------------------------------------------------------------------------------


def with_stale_frame(drive: Drive, t: int, *, changed: bool) -> FloatArray:
    """Repeat frame t - 1 in frame t. `changed`: from there on each track shows what lay at its
    old pixels.
    """
    features = drive.features.copy()
    carried = (features[0, :, t] != -1) & (features[0, :, t - 1] != -1)
    features[:, carried, t] = features[:, carried, t - 1]
    if changed:
        for k in range(t + 1, features.shape[2]):
            seen = carried & (features[0, :, k] != -1)
            features[:, seen, k] = drive.features[
                :, seen, k - 1
            ]  # the scene repeats itself at a pixel on a steady drive
    return features


def stale_frames(tracks: FeatureTracks) -> BoolArray:
    """Return the mask (F,) of frames of which more than half of the rows are stale."""
    rows = np.split(tracks.stale, tracks.offsets[1:-1])
    return np.array([len(stale) > 0 and stale.mean() > 0.5 for stale in rows])


@pytest.mark.parametrize("changed", [True, False])
def test_stale_frames_are_flagged(changed: bool, tmp_path: Path) -> None:
    drive = make_drive(14, yaw_rate=0.1)
    features = with_stale_frame(drive, 7, changed=changed)
    path = make_npz(tmp_path / "a.npz", {**ece276a_arrays(drive), "features": features})
    dataset = read_ece276a(path, DatasetSettings(repeated_tracks="flag"))
    assert np.flatnonzero(stale_frames(dataset.tracks)).tolist() == [7]
    for t in range(14):
        observed = dataset.observations(t)
        before = features[:, observed.ids, t - 1].T
        repeated = (observed.z == before).all(axis=1) & (t > 0)
        np.testing.assert_array_equal(observed.stale, repeated)
        assert observed.stale.any() == (t == 7)
    note = dataset.recording.notes[-1]
    assert note.startswith("1 of 14 feature frames are stale")
    judged = read_ece276a(path, DEFAULT)
    assert ("they show other points of the scene" in judged.recording.notes[-1]) == changed
    assert np.array_equal(judged.tracks.ids, dataset.tracks.ids) == (not changed)


def test_split_gives_every_track_a_new_id_from_its_stale_row_on(tmp_path: Path) -> None:
    drive = make_drive(14, yaw_rate=0.1)
    arrays = {**ece276a_arrays(drive), "features": with_stale_frame(drive, 7, changed=True)}
    path = make_npz(tmp_path / "a.npz", arrays)
    whole = read_ece276a(path, DatasetSettings(repeated_tracks="flag")).tracks
    split = read_ece276a(path, DatasetSettings(repeated_tracks="split")).tracks
    np.testing.assert_array_equal(split.z, whole.z)
    np.testing.assert_array_equal(split.stale, whole.stale)
    frames = whole.frames
    broken = np.unique(whole.ids[whole.stale])
    after = np.isin(whole.ids, broken) & (frames >= 7)
    np.testing.assert_array_equal(split.ids[~after], whole.ids[~after])
    fresh = drive.features.shape[1] + np.arange(len(broken))
    np.testing.assert_array_equal(split.ids[after & (frames == 7)], fresh)
    renamed = dict(zip(whole.ids[after & (frames == 7)].tolist(), fresh.tolist(), strict=True))
    assert split.ids[after].tolist() == [renamed[j] for j in whole.ids[after].tolist()]


def test_literal_mode_keeps_repeats_and_notes_the_frames(tmp_path: Path) -> None:
    drive = make_drive(14, yaw_rate=0.1)
    arrays = {**ece276a_arrays(drive), "features": with_stale_frame(drive, 7, changed=True)}
    dataset = read_ece276a(
        make_npz(tmp_path / "a.npz", arrays), DatasetSettings(repeated_tracks="literal")
    )
    assert not dataset.tracks.stale.any()
    assert dataset.recording.repeats_settled
    assert "1 of 14 feature frames are stale" in dataset.recording.notes[-1]
    assert "used as they are" in dataset.recording.notes[-1]


def test_repeats_of_a_stationary_vehicle_are_not_stale(tmp_path: Path) -> None:
    arrays = ece276a_arrays(make_drive(14))
    arrays["features"][:] = arrays["features"][:, :, :1]
    noise = np.random.default_rng(0).standard_normal((2, 3, 14))
    arrays["linear_velocity"], arrays["rotational_velocity"] = 0.5 * noise[0], 0.02 * noise[1]
    dataset = read_ece276a(make_npz(tmp_path / "a.npz", arrays), DEFAULT)
    assert not dataset.tracks.stale.any()


def test_distinguishes_motion_from_noise() -> None:
    rng = np.random.default_rng(1)
    quiet = 0.5 * rng.standard_normal((400, 3))
    still = np.zeros((400, 3))
    assert moving_frames(quiet, still).mean() < 0.02
    assert moving_frames(quiet + np.array([3.0, 0, 0]), still).all()
    assert moving_frames(still, still + np.array([0, 0, 0.3])).all()


# --- bad input
# --------------------------------------------------------------------------------------------------


def _swap_cameras(arrays: Arrays) -> Arrays:
    return {**arrays, "features": arrays["features"][[2, 3, 0, 1]]}


BAD = [
    (
        lambda a: {k: v for k, v in a.items() if k != "b"},
        DataError,
        r"needs the keys time_stamps .*; found K cam_T_imu",
    ),
    (
        changed("features", np.zeros((3, 5, 6))),
        DataError,
        r"features has shape 3 x 5 x 6 .*expected 4 x M x T",
    ),
    (
        changed("features", np.zeros((4, 5, 7))),
        DataError,
        r"time_stamps has shape 1 x 6 .*expected 1 x 7",
    ),
    (
        changed("linear_velocity", np.zeros((5, 3))),
        DataError,
        r"linear_velocity has shape 5 x 3 .*expected 3 x 6",
    ),
    (changed("K", np.eye(4)), DataError, r"K has shape 4 x 4"),
    (
        changed("K", np.ones((3, 3))),
        CalibrationError,
        r"K is no intrinsic matrix \[fu 0 cu; .* but \[\[",
    ),
    (changed("b", 0.0), CalibrationError, r"\.npz: stereo baseline must be positive, got 0 m"),
    (changed("b", -0.5), CalibrationError, r"\.npz: stereo baseline must be positive, got -0.5 m"),
    (changed("b", "wide"), DataError, r"b has shape one value and type <U4"),
    (edited("cam_T_imu", (0, 0), 2.0), CalibrationError, r"cam_T_imu: not a rotation"),
    (changed("cam_T_imu", np.diag([1.0, 1, -1, 1])), CalibrationError, r"cam_T_imu: .*reflection"),
    (edited("time_stamps", (0, 3), 0.0), DataError, r"time_stamps\[3\]: the clock runs backwards"),
    (
        edited("time_stamps", (0, 3), 1317386425.7),
        DataError,
        r"time_stamps\[3\]: the clock repeats",
    ),
    (
        edited("rotational_velocity", (1, 4), np.nan),
        DataError,
        r"rotational_velocity is not finite in 1 of 6 frames.* 4",
    ),
    (
        edited("linear_velocity", (1, 2), np.inf),
        DataError,
        r"linear_velocity is not finite in 1 of 6 frames.* 2",
    ),
    (
        edited("features", (0, 0, 0), np.nan),
        DataError,
        r"feature 0 in frame 0 is .*neither a pixel pair nor all -1",
    ),
    (_swap_cameras, DataError, r"left and right look swapped: \d+ of \d+ disparities"),
]


@pytest.mark.parametrize(("corrupt", "kind", "message"), BAD)
def test_rejects_bad_files_with_one_line_error(
    corrupt: Callable[[Arrays], Arrays], kind: type[Exception], message: str, tmp_path: Path
) -> None:
    path = make_npz(tmp_path / "bad.npz", corrupt(ece276a_arrays(make_drive(6))))
    with pytest.raises(kind, match=message) as caught:
        read_ece276a(path, DEFAULT)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("row", [0, 2])
def test_rejects_half_missing_features(row: int, tmp_path: Path) -> None:
    arrays = ece276a_arrays(make_drive(6))
    j = int(np.flatnonzero(arrays["features"][0, :, 2] != -1)[0])
    arrays["features"][row, j, 2] = -1
    with pytest.raises(DataError, match=rf"feature {j} in frame 2 is"):
        read_ece276a(make_npz(tmp_path / "bad.npz", arrays), DEFAULT)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("K_r", np.diag([7e2, 7e2, 1]), "K_l and K_r differ"),
        ("extR_T_imu", T_CAM0_IMU, "place the cameras"),
        ("extR_T_imu", se3_from_parts(np.eye(3), [0.5, 0, 0]) @ T_CAM0_IMU, "place the cameras"),
    ],
)
def test_newer_calibration_must_be_a_rectified_pair(
    key: str, value: FloatArray, message: str, tmp_path: Path
) -> None:
    path = make_npz(tmp_path / "bad.npz", {**ece276a_new_arrays(make_drive(6)), key: value})
    with pytest.raises(CalibrationError, match=message):
        read_ece276a(path, DEFAULT)


@pytest.mark.parametrize(("aside", "is_pair"), [(0.018, True), (0.022, False)])
def test_a_pair_may_be_a_little_off_its_row(aside: float, is_pair: bool, tmp_path: Path) -> None:
    """By two hundredths of the baseline, as the published files are rounded."""
    arrays = ece276a_new_arrays(make_drive(6))
    T_cam1_cam0 = se3_from_parts(np.eye(3), [-0.5, 0.0, 0.5 * aside])
    arrays["extR_T_imu"] = T_cam1_cam0 @ arrays["extL_T_imu"]
    path = make_npz(tmp_path / "a.npz", arrays)
    if is_pair:
        assert read_ece276a(path, DEFAULT).recording.camera.baseline_m == pytest.approx(0.5)
    else:
        with pytest.raises(CalibrationError, match="place the cameras"):
            read_ece276a(path, DEFAULT)


# --- the published files
# ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drive_0027(data_dir: Path) -> FeatureDataset:
    return read_ece276a(data_dir / "ece276a" / "0027.npz", DatasetSettings(repeated_tracks="flag"))


def test_published_file_0027(drive_0027: FeatureDataset) -> None:
    recording = drive_0027.recording
    assert len(recording.frame_times_ns) == 1106
    assert recording.frame_times_ns[0] == pytest.approx(1317386425562502384, abs=240)
    assert recording.camera == StereoCamera(
        707.0912, 707.0912, 601.8873, 183.1104, 0.5371506532679237
    )
    first = drive_0027.observations(0)
    assert len(first) == 64
    assert len(drive_0027.tracks.ids) == 75647
    assert int(drive_0027.tracks.stale.sum()) == 4196
    assert [note.split(" ")[0] for note in recording.notes] == ["the", "91"]
    assert "pixels move 1.09 steps afterwards" in recording.notes[1]


def test_the_second_published_file(data_dir: Path) -> None:
    dataset = read_ece276a(data_dir / "ece276a" / "0022.npz", DEFAULT)
    assert any(
        note.startswith("66 of 800 feature frames are stale") for note in dataset.recording.notes
    )
    np.testing.assert_allclose(
        dataset.recording.T_cam0_imu[:3, 3], [-0.3141, 0.7195, -1.0891], atol=1e-4
    )
    assert any("corrected to t = -R t" in note for note in dataset.recording.notes)
    assert any(
        "continue under new ids (pixels move 1.05 steps" in note for note in dataset.recording.notes
    )
    assert len(np.unique(dataset.tracks.ids)) == 3220 + 3100  # one more for each stale row


@pytest.mark.parametrize("name", ["0027", "0022"])
def test_keeps_extrinsics_of_a_corrected_published_file(
    name: str, data_dir: Path, tmp_path: Path
) -> None:
    arrays = dict(read_npz(data_dir / "ece276a" / f"{name}.npz"))
    R, t = arrays["cam_T_imu"][:3, :3], arrays["cam_T_imu"][:3, 3]
    arrays["cam_T_imu"] = se3_from_parts(R, -R @ t)
    recording = read_ece276a(make_npz(tmp_path / "consistent.npz", arrays), DEFAULT).recording
    np.testing.assert_allclose(recording.T_cam0_imu, arrays["cam_T_imu"], atol=1e-6)
    assert not any("cam_T_imu" in note for note in recording.notes)


def _reprojection(
    camera: StereoCamera,
    tracks: FeatureTracks,
    poses: FloatArray,
    source: int,
    target: int,
    ids: np.ndarray,
) -> FloatArray:
    """Pixel error |du|, |dv| (N, 2) in `target` of points triangulated in `source`, under the
    true cam0 poses.
    """
    here, there = tracks.at(source, 0), tracks.at(target, 0)
    common = np.intersect1d(np.intersect1d(here.ids, there.ids), ids)
    p, valid = triangulate(camera, here.z[np.searchsorted(here.ids, common)], min_disparity_px=1.0)
    p = transform_points(se3_inverse(poses[target]) @ poses[source], p)
    valid &= p[:, 2] > 2
    z = there.z[np.searchsorted(there.ids, common)]
    error: FloatArray = np.abs(project(camera, np.where(valid[:, None], p, 1.0)) - z)[valid, :2]
    return error


def test_repeated_rows_show_the_new_image_but_another_point(
    drive_0027: FeatureDataset, data_dir: Path
) -> None:
    poses = read_trajectory(
        data_dir / "ece276a" / "kitti_odometry_07_poses.txt", fmt="kitti"
    ).T_world_body
    camera, tracks, stale = (
        drive_0027.recording.camera,
        drive_0027.tracks,
        stale_frames(drive_0027.tracks),
    )
    to_new, to_old, control = [], [], []
    for t in np.flatnonzero(stale):
        if not 3 <= t < len(poses) - 2 or stale[t - 2 : t + 3].sum() > 1:
            continue
        observed = tracks.at(int(t), 0)
        # all or new
        assert np.array_equal(observed.stale, np.isin(observed.ids, tracks.at(int(t) - 1, 0).ids))
        repeated = observed.ids[observed.stale]
        to_new.append(_reprojection(camera, tracks, poses, int(t) + 1, int(t), repeated))
        to_old.append(_reprojection(camera, tracks, poses, int(t) - 1, int(t) + 1, repeated))
        control.append(_reprojection(camera, tracks, poses, int(t) - 2, int(t) - 1, repeated))
    medians = [np.median(np.concatenate(errors), axis=0) for errors in (to_new, to_old, control)]
    assert (medians[0] < 0.4).all()  # measured 0.25, 0.32 px
    assert (medians[1] > [5.0, 2.0]).all()  # measured 6.2, 2.5 px
    assert (medians[2] < 0.4).all()  # measured 0.25, 0.31 px


def test_the_corrected_extrinsic_agrees_with_ground_truth(
    drive_0027: FeatureDataset, data_dir: Path
) -> None:
    """The corrected lever arm fits camera velocity and body velocity to rigid-body motion best."""
    poses = read_trajectory(
        data_dir / "ece276a" / "kitti_odometry_07_poses.txt", fmt="kitti"
    ).T_world_body
    dt = np.diff(drive_0027.recording.frame_times_ns[: len(poses)]) * 1e-9
    truth = se3_log(se3_inverse(poses[:-1]) @ poses[1:]) / dt[:, None]
    u = np.array([[*m.linear, *m.angular] for m in drive_0027.motion[: len(poses)]])  # type: ignore[union-attr]
    T = drive_0027.recording.T_cam0_imu
    R, t = T[:3, :3], T[:3, 3]
    omega = truth[:, 3:] @ R
    gap = truth[:, :3] @ R - (u[:-1, :3] + u[1:, :3]) / 2
    turning = np.linalg.norm(omega, axis=1) > 0.2
    corrected = -R.T @ t
    literal = -R.T @ corrected  # the file's translation is the camera's position itself
    errors = [
        np.abs(
            (gap - np.cross(omega, lever_arm))[turning, :2] - np.median(gap[~turning, :2], axis=0)
        ).mean()
        for lever_arm in (corrected, literal)
    ]
    assert errors[0] < 0.75 * errors[1]
