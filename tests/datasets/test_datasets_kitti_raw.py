"""KITTI raw drives: calibration consistent with KITTI's images, exact clocks, an error that
names each defect.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.euroc_maker import KITTI_RIG, RECT_SIZE, T_CAM0_VELO, T_VELO_IMU, make_kitti_raw
from tests.same_events import frames_of
from vio.cameras.rig import Rig
from vio.datasets import DatasetSettings, open_dataset
from vio.datasets.image_pairs import ImageDataset
from vio.datasets.images import load_gray
from vio.datasets.kitti_raw import KittiRawCalibration, read_cam_to_cam
from vio.datasets.plain import read_kitti_raw
from vio.datasets.rigs.kalibr import kalibr_text
from vio.errors import CalibrationError, DataError
from vio.geometry.distortion import CameraModel, project_point
from vio.geometry.lie import FloatArray, se3_inverse, so3_exp, so3_log
from vio.geometry.rectify import rectified_cameras, rectifying_rotations
from vio.records import StereoFrame


def _read(path: Path) -> ImageDataset:
    return read_kitti_raw(path, DatasetSettings())


@pytest.mark.parametrize("above", [False, True], ids=["calibration beside", "calibration above"])
def test_calibration_is_read(above: bool, tmp_path: Path) -> None:
    path = make_kitti_raw(tmp_path, above=above)
    recording = open_dataset(path).recording
    expected = rectified_cameras(
        replace(KITTI_RIG, T_imu_cam0=np.eye(4), T_imu_cam1=KITTI_RIG.T_cam0_cam1)
    )
    assert recording.kind == "kitti_raw"
    assert recording.motion == frozenset()
    assert recording.reference is None
    assert recording.camera.fu == pytest.approx(expected.camera.fu, rel=1e-9)
    assert recording.camera.baseline_m == pytest.approx(expected.camera.baseline_m, rel=1e-9)
    assert (recording.camera.width, recording.camera.height) == (64, 48)
    np.testing.assert_allclose(
        recording.T_cam0_imu, expected.T_rect0_imu @ T_CAM0_VELO @ T_VELO_IMU, atol=1e-9
    )
    assert open_dataset(f"kitti_raw:{path}").recording.camera == recording.camera


@pytest.mark.parametrize("lines", [4, 110], ids=["a line an image", "a line a frame of the drive"])
def test_a_drive_keeps_its_clock_with_a_calibration_that_a_run_saved(
    lines: int, tmp_path: Path
) -> None:
    path = make_kitti_raw(tmp_path)
    rig = _read(path).rectifier.rig
    kept = tmp_path / "camchain.yaml"
    kept.write_text(kalibr_text(Rig(rig.cam0, rig.cam1, se3_inverse(rig.T_cam0_cam1))))
    for name in ("image_00", "image_01"):
        stamps = "".join(f"2011-09-26 14:02:{k / 7:012.9f}\n" for k in range(lines))
        (path / name / "timestamps.txt").write_text(stamps)
    again = open_dataset(path, DatasetSettings(calibration=kept)).recording
    assert again.frame_times_ns.tolist() == open_dataset(path).recording.frame_times_ns.tolist()


def test_frames_are_rectified_as_opencv_would(tmp_path: Path) -> None:
    dataset = _read(make_kitti_raw(tmp_path))
    camera, rig = dataset.recording.camera, dataset.rectifier.rig
    for frame in frames_of(dataset):
        for image, path, model, R in zip(
            (frame.left, frame.right),
            dataset.pairs[frame.index],
            (rig.cam0, rig.cam1),
            rectifying_rotations(rig)[:2],
            strict=True,
        ):
            D = np.array([model.coefficients])
            maps = cv2.initUndistortRectifyMap(model.K, D, R, camera.K, (64, 48), cv2.CV_32FC1)
            expected = cv2.remap(
                load_gray(path)[0], *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            difference = np.abs(image.astype(int) - expected.astype(int))
            assert difference.max() <= 3
            assert (difference > 1).mean() < 0.002


def test_images_rectified_by_kitti_pass_through(tmp_path: Path) -> None:
    dataset = _read(make_kitti_raw(tmp_path, rectified=True))
    camera = dataset.recording.camera
    assert (camera.fu, camera.cu, camera.cv) == (38.0, 27.0, 19.0)
    assert camera.baseline_m == pytest.approx(0.11, abs=1e-9)
    assert (camera.width, camera.height) == RECT_SIZE
    R_rect = so3_exp([0.004, 0.01, -0.002])
    expected = (
        R_rect @ (T_CAM0_VELO @ T_VELO_IMU)[:3, :3],
        R_rect @ (T_CAM0_VELO @ T_VELO_IMU)[:3, 3],
    )
    np.testing.assert_allclose(dataset.recording.T_cam0_imu[:3, :3], expected[0], atol=1e-9)
    np.testing.assert_allclose(dataset.recording.T_cam0_imu[:3, 3], expected[1], atol=1e-9)
    for frame in frames_of(dataset):
        np.testing.assert_array_equal(frame.left, load_gray(dataset.pairs[frame.index][0])[0])


def test_without_the_laser_scanner_the_body_is_the_camera(tmp_path: Path) -> None:
    make_kitti_raw(tmp_path)
    (tmp_path / "calib_imu_to_velo.txt").unlink()
    recording = _read(tmp_path).recording
    assert recording.T_cam0_imu is None
    assert any("calib_imu_to_velo.txt not found" in note for note in recording.notes)


# --- clock
# --------------------------------------------------------------------------------------------------


def test_times_follow_from_frame_numbers_where_there_are_none(tmp_path: Path) -> None:
    recording = _read(make_kitti_raw(tmp_path, [7, 8, 10])).recording
    assert recording.frame_times_ns.tolist() == [700_000_000, 800_000_000, 1_000_000_000]
    assert (
        "timestamps.txt is missing; times follow from the frame numbers at 10 Hz"
        in recording.notes[0]
    )


def _stamp(k: int) -> str:
    return f"2011-09-26 14:02:{25 + k // 10}.{k % 10}51199337"


@pytest.mark.parametrize(
    ("lines", "rows"), [(3, [0, 1, 2]), (12, [7, 8, 10])], ids=["an image", "whole drive"]
)
def test_timestamps_are_read_to_the_nanosecond(lines: int, rows: list[int], tmp_path: Path) -> None:
    path = make_kitti_raw(tmp_path, [7, 8, 10])
    (path / "image_00" / "timestamps.txt").write_text(
        "".join(f"{_stamp(k)}\n" for k in range(lines))
    )
    recording = _read(path).recording
    assert recording.notes == ()
    first = 1317045745_051199337  # 2011-09-26 14:02:25.051199337 UTC
    assert recording.frame_times_ns.tolist() == [first + 100_000_000 * k for k in rows]


# --- bad input
# --------------------------------------------------------------------------------------------------

Corruption = Callable[[Path], object]


def _entry(name: str, values: str | None) -> Corruption:
    def corrupt(folder: Path) -> None:
        path = folder / "calib_cam_to_cam.txt"
        text, count = re.subn(
            rf"^{name}:.*\n",
            "" if values is None else f"{name}: {values}\n",
            path.read_text(),
            flags=re.M,
        )
        assert count == 1
        path.write_text(text)

    return corrupt


def _times(*lines: str) -> Corruption:
    return lambda folder: (folder / "image_00" / "timestamps.txt").write_text(
        "\n".join(lines) + "\n"
    )


def _images(folder: Path, camera: int) -> list[Path]:
    return sorted((folder / f"image_0{camera}" / "data").iterdir())


BAD: dict[str, tuple[Corruption, type[DataError], str]] = {
    "no right camera": (
        lambda d: (d / "image_01").rename(d / "image_03"),
        DataError,
        "holds no image_01/data; give a KITTI raw drive",
    ),
    "counts differ": (
        lambda d: (d / "image_01/data/0000000101.png").unlink(),
        DataError,
        r"holds 4 images and .* 3: .*0000000101.png is missing",
    ),
    "no calibration": (
        lambda d: (d / "calib_cam_to_cam.txt").unlink(),
        CalibrationError,
        "calib_cam_to_cam.txt is neither there nor in the folders above",
    ),
    "no K": (_entry("K_01", None), CalibrationError, "calib_cam_to_cam.txt: has no entry K_01"),
    "short D": (
        _entry("D_00", "-0.3 0.2 0 0"),
        CalibrationError,
        "D_00 holds 4 values, expected 5",
    ),
    "NaN in T": (
        _entry("T_01", "-0.5 nan 0"),
        CalibrationError,
        "T_01 holds values that are not finite",
    ),
    "text for a number": (_entry("T_01", "-0.5 a 0"), CalibrationError, "T_01 holds no number"),
    "no matrix": (
        _entry("K_00", "1 2 3 4 5 6 7 8 9"),
        CalibrationError,
        "camera 00 is no intrinsic matrix",
    ),
    "negative focal": (
        _entry("K_00", "-40 0 31 0 40 24 0 0 1"),
        CalibrationError,
        "camera 00 is no intrinsic matrix .* fu and fv positive",
    ),
    "mirrored": (
        _entry("R_01", "1 0 0 0 1 0 0 0 -1"),
        CalibrationError,
        "R_01: not a rotation but a reflection",
    ),
    "swapped": (
        _entry("T_01", "0.11 0 0"),
        CalibrationError,
        "cam_to_cam.txt: .*the cameras may be swapped",
    ),
    "no baseline": (_entry("T_01", "0 0 0"), CalibrationError, "the baseline is zero"),
    "an entry twice": (
        lambda d: (d / "calib_cam_to_cam.txt").write_text(
            (d / "calib_cam_to_cam.txt").read_text() * 2
        ),
        CalibrationError,
        "repeats an entry",
    ),
    "a line without a name": (
        lambda d: (d / "calib_velo_to_cam.txt").write_text("1 0 0\n"),
        CalibrationError,
        r"calib_velo_to_cam.txt, line 1: is not of the form 'name: values'",
    ),
    "half a pixel": (
        _entry("S_00", "64.5 48"),
        CalibrationError,
        "calib_cam_to_cam.txt, S_00: an image of 64.5 x 48 pixels; give whole, positive numbers",
    ),
    "another size": (
        _entry("S_00", "100 80"),
        DataError,
        r"is for images of 100 x 80 \(raw\) or 56 x 40 \(rectified\), not 64 x 48 pixels",
    ),
    "images without frame numbers": (
        lambda d: [
            (d / f"image_0{k}/data/0000000101.png").rename(d / f"image_0{k}/data/b.png")
            for k in (0, 1)
        ],
        DataError,
        "b.png: an image of KITTI raw is named by its frame number",
    ),
    "numbers of several lengths": (
        lambda d: [
            (d / f"image_0{k}/data/0000000101.png").rename(d / f"image_0{k}/data/0100.png")
            for k in (0, 1)
        ],
        DataError,
        "0100.png: its frame number does not increase after 0000000100.png",
    ),
    "too few times": (
        _times(_stamp(0), _stamp(1)),
        DataError,
        "holds 2 times for 4 images up to number 103",
    ),
    "times repeat": (
        _times(_stamp(0), _stamp(1), _stamp(1), _stamp(2)),
        DataError,
        "timestamps.txt, line 3: the clock repeats",
    ),
    "times backwards": (
        _times(_stamp(0), _stamp(2), _stamp(1), _stamp(3)),
        DataError,
        "timestamps.txt, line 3: the clock runs backwards",
    ),
    "times before nanoseconds": (
        _times(*(f"0001-01-01 00:00:00.{k}" for k in range(4))),
        DataError,
        "line 1: '0001-01-01 00:00:00.0' is no time of the form",
    ),
    "long names": (
        lambda d: [p.rename(p.with_name("9" * 20 + p.name)) for k in (0, 1) for p in _images(d, k)],
        DataError,
        "0000000100.png: an image of KITTI raw is named by its frame number",
    ),
    "no times": (
        _times(_stamp(0), "yesterday", _stamp(1), _stamp(3)),
        DataError,
        "line 2: 'yesterday' is no time of the form",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_rejects_bad_drives_with_one_line_error(case: str, tmp_path: Path) -> None:
    corrupt, kind, message = BAD[case]
    corrupt(make_kitti_raw(tmp_path))
    with pytest.raises(kind, match=message) as caught:
        open_dataset(tmp_path)
    assert "\n" not in str(caught.value)


# --- the real drive
# -------------------------------------------------------------------------------------------------


def _real(data_dir: Path) -> tuple[ImageDataset, KittiRawCalibration]:
    folder = data_dir / "kitti_0039_unrectified"
    return _read(folder), read_cam_to_cam(folder / "calib_cam_to_cam.txt")


def test_real_rectification_agrees_with_kitti_up_to_a_rotation_about_the_baseline(
    data_dir: Path,
) -> None:
    dataset, published = _real(data_dir)
    R_rect_cam0, R_rect_cam1, baseline_m = rectifying_rotations(dataset.rectifier.rig)
    turns = []
    for ours, theirs in (
        (R_rect_cam0, published.R_rect_cam0),
        (R_rect_cam1, published.R_rect_cam1),
    ):
        np.testing.assert_allclose(ours[0], theirs[0], atol=2e-6)  # KITTI prints seven digits
        turns.append(so3_log(ours @ theirs.T))
    np.testing.assert_allclose(turns[0], turns[1], atol=5e-6)
    assert np.degrees(np.linalg.norm(turns[0])) < 0.5
    assert baseline_m == pytest.approx(-published.T_rect1_rect0[0, 3], abs=2e-5)


def _kitti_maps(
    model: CameraModel, rect: CameraModel, R: FloatArray
) -> tuple[np.ndarray, np.ndarray]:
    v, u = np.mgrid[0 : rect.height, 0 : rect.width]
    rays = np.stack([(u - rect.cu) / rect.fu, (v - rect.cv) / rect.fv, np.ones(u.shape)], axis=-1)
    uv, valid = project_point(model, rays @ R)
    assert valid.all()
    return uv[..., 0].astype(np.float32), uv[..., 1].astype(np.float32)


def test_the_lens_model_reproduces_the_rectified_image_of_kitti(data_dir: Path) -> None:
    """Frame 100 of the drive is image 76 of the rectified clip: equal to rounding, so order and
    signs are KITTI's.
    """
    dataset, published = _real(data_dir)
    models = (
        (published.cam0, published.rect0, published.R_rect_cam0),
        (published.cam1, published.rect1, published.R_rect_cam1),
    )
    for k, (raw_path, parts) in enumerate(zip(dataset.pairs[0], models, strict=True)):
        ours = cv2.remap(load_gray(raw_path)[0], *_kitti_maps(*parts), cv2.INTER_LINEAR)
        theirs = load_gray(data_dir / "kitti_0039" / f"image_{k}" / "000076.png")[0]
        difference = (ours.astype(float) - theirs)[10:-10, 10:-10]
        assert np.sqrt(np.mean(difference**2)) < 0.4


def test_real_extrinsics_agree_with_the_odometry_folder(data_dir: Path) -> None:
    """`T_cam0_imu` of the rectified clip is R_rect_00 T_cam0_velo T_velo_imu; this one differs
    by a known rotation.
    """
    dataset, published = _real(data_dir)
    other = open_dataset(data_dir / "kitti_0039").recording.T_cam0_imu
    R_rect_cam0 = rectifying_rotations(dataset.rectifier.rig)[0]
    expected = R_rect_cam0 @ published.R_rect_cam0.T @ other[:3]
    np.testing.assert_allclose(dataset.recording.T_cam0_imu[:3], expected, atol=1e-4)


def test_real_rectified_images_show_features_where_those_of_kitti_do(data_dir: Path) -> None:
    """Corners of our images of frame 100, turned as KITTI's, are found by their texture where
    KITTI's own show them.
    """
    dataset, published = _real(data_dir)
    frame = next(e for e in dataset.events(0, 1) if isinstance(e, StereoFrame))
    clip = open_dataset(data_dir / "kitti_0039")
    theirs = next(e for e in clip.events(76, 77) if isinstance(e, StereoFrame))
    R_ours = rectifying_rotations(dataset.rectifier.rig)[:2]
    K_ours, K_theirs = dataset.recording.camera.K, clip.recording.camera.K
    window = {"winSize": (21, 21), "maxLevel": 2}
    moved = []
    pairs = (
        (frame.left, theirs.left, published.R_rect_cam0),
        (frame.right, theirs.right, published.R_rect_cam1),
    )
    for (ours, other, R_theirs), R in zip(pairs, R_ours, strict=True):
        H = K_theirs @ R_theirs @ R.T @ np.linalg.inv(K_ours)
        turned = cv2.warpPerspective(ours, H, other.shape[::-1])
        corners = cv2.goodFeaturesToTrack(turned[20:-20, 20:-20], 300, 0.01, 12) + np.float32(20)
        found, status, _ = cv2.calcOpticalFlowPyrLK(turned, other, corners, None, **window)  # type: ignore[call-overload]
        assert status.mean() > 0.95
        moved.append((found - corners)[status[:, 0] == 1, 0])
    for shift in moved:
        assert np.median(np.abs(shift[:, 1])) < 0.05  # rows: the epipolar residual
        assert np.median(np.linalg.norm(shift, axis=1)) < 0.05
    assert abs(np.median(moved[0][:, 1]) - np.median(moved[1][:, 1])) < 0.02
