"""Folders of images by the names that people give them, and of published data sets."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from tests.dataset_makers import make_kitti
from tests.plain_maker import make_plain
from vio.cli import main
from vio.datasets import DatasetSettings, open_dataset
from vio.datasets.image_files import ImageFiles
from vio.datasets.image_times import pair_files
from vio.datasets.sides import is_pair, pairs_of, without_side
from vio.errors import DataError
from vio.geometry.lie import quat_xyzw_from_rotation, se3_exp

NAMES = [
    ("fisheye1", "fisheye2"),
    ("stereo_left", "stereo_right"),
    ("stereo/left", "stereo/right"),
    ("img_l", "img_r"),
    ("CamLeft", "CamRight"),
    ("front/cam_0", "front/cam_1"),
    ("imgs-LEFT", "imgs-RIGHT"),
]


@pytest.mark.parametrize("names", NAMES, ids=lambda n: n[0])
def test_folders_that_differ_in_their_side_are_a_pair(
    names: tuple[str, str], tmp_path: Path
) -> None:
    usual = open_dataset(make_plain(tmp_path / "usual", imu=False))
    other = open_dataset(make_plain(tmp_path / "other", imu=False, folders=names))
    assert other.recording.kind == "plain"
    assert other.recording.camera == usual.recording.camera
    assert len(other.recording.frame_times_ns) == 4
    assert not any("not used" in note for note in other.recording.notes)


def test_folders_named_by_setting_or_counted_in_the_message(tmp_path: Path) -> None:
    folder = make_plain(tmp_path / "r", imu=False, folders=("a1", "b7"))
    with pytest.raises(DataError, match=r"holds a1 and b7 with 4 images each, but it is not clear"):
        open_dataset(folder)
    recording = open_dataset(folder, DatasetSettings(folders="a1,b7")).recording
    assert recording.kind == "plain"
    for given in ("a1,c", "a1", "a1,a1"):
        with pytest.raises(
            DataError, match=r"names no two folders of images, .* it holds a1 and b7"
        ):
            open_dataset(folder, DatasetSettings(folders=given))


def test_three_cameras_of_unknown_names_are_not_guessed(tmp_path: Path) -> None:
    folder = make_plain(tmp_path / "r", imu=False, folders=("top_1", "top_2"))
    shutil.copytree(folder / "top_2", folder / "top_3")
    with pytest.raises(DataError, match=r"top_1, top_2 and top_3 with 4 images each, but"):
        open_dataset(folder)


def test_sides_of_names() -> None:
    assert is_pair("image_lcam_front", "image_rcam_front")
    assert is_pair("cam00", "cam01")
    assert not is_pair("right", "left")
    assert not is_pair("cam0_left", "cam1_right"), "they differ twice"
    assert pairs_of(["cam1", "cam0", "depth"]) == [("cam0", "cam1")]
    assert without_side("000012_cam0") == without_side("000012_cam1") == "000012_"
    assert without_side("left_000012") == "_000012"
    assert without_side("cam0") == "cam0", "nothing else is there"


@pytest.mark.parametrize(
    "name",
    [
        lambda side, k: f"{k:06d}_cam{side}.png",
        lambda side, k: f"cam{side}_{k:06d}.png",
        lambda side, k: f"{'LR'[side]}_{k}.png",
        lambda side, k: f"frame{k}-{('left', 'right')[side]}.png",
        lambda side, k: f"image_{side}_{k}.png",
    ],
)
def test_images_named_by_their_camera_are_paired_by_the_rest(name: object) -> None:
    sides = [
        ImageFiles(Path("x"), tuple(name(side, k) for k in range(3)))  # type: ignore[operator]
        for side in range(2)
    ]
    pairs, notes = pair_files(*sides)
    assert [(a.name, b.name) for a, b in pairs] == [
        (name(0, k), name(1, k))  # type: ignore[operator]
        for k in range(3)
    ]
    assert notes == ()


def _four_seasons(folder: Path) -> tuple[Path, np.ndarray]:
    """As published: undistorted images, calibration beside the recordings."""
    recording = folder / "recording_2020-03-24_17-36-22"
    rng = np.random.default_rng(2)
    ids = [1585068000000000000 + 50_000_000 * k for k in range(3)]
    for side in range(2):
        images = recording / "undistorted_images" / f"cam{side}"
        images.mkdir(parents=True)
        for frame in ids:
            image = rng.integers(0, 256, (48, 64), dtype=np.uint8)
            assert cv2.imwrite(str(images / f"{frame}.png"), image)
    calibration = folder / "calibration"
    calibration.mkdir()
    for k in range(2):
        text = "Pinhole 50.1 50.1 31.5 23.9 0\n64 48\ncrop\n64 48\n"
        (calibration / f"undistorted_calib_{k}.txt").write_text(text)
    pose = "1 0 0 -0.3004\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    (calibration / "undistorted_calib_stereo.txt").write_text(pose)
    (calibration / "camchain.yaml").write_text(yaml.safe_dump({"cam0": {"intrinsics": [1]}}))
    times = [f"{t} {t // 10**9}.{t % 10**9:09d} 2.5\n" for t in ids]
    (recording / "times.txt").write_text("".join(times))
    rows = [f"{t} 0.01 0.02 0.03 0.1 9.8 0.2\n" for t in range(ids[0], ids[-1] + 1, 500_000)]
    (recording / "imu.txt").write_text("".join(rows))
    T = se3_exp([0.1, 0.2, 0.3, 0.01, -0.02, 0.03])
    numbers = [*T[:3, 3].tolist(), *quat_xyzw_from_rotation(T[:3, :3]).tolist()]
    (recording / "Transformations.txt").write_text(
        "# transform_S_AS: translation vector, rotation quaternion\n0,0,0,0,0,0,1\n"
        f"# TS_cam_imu: translation vector, rotation quaternion\n{','.join(map(repr, numbers))}\n"
    )
    return recording, T


def test_four_seasons_as_published(tmp_path: Path) -> None:
    folder, T_cam0_imu = _four_seasons(tmp_path)
    recording = open_dataset(folder).recording
    assert recording.camera.baseline_m == pytest.approx(0.3004)
    assert recording.motion == {"imu"}
    assert recording.T_cam0_imu is not None
    np.testing.assert_allclose(recording.T_cam0_imu, T_cam0_imu, atol=1e-9)
    assert recording.frame_times_ns[0] == 1585068000000000000


def test_kitti_360_as_published(tmp_path: Path) -> None:
    drive = tmp_path / "data_2d_raw" / "2013_05_28_drive_0000_sync"
    rng = np.random.default_rng(2)
    for side in range(2):
        images = drive / f"image_0{side}" / "data_rect"
        images.mkdir(parents=True)
        for k in range(3):
            image = rng.integers(0, 256, (48, 64), dtype=np.uint8)
            assert cv2.imwrite(str(images / f"{k:010d}.png"), image)
    text = "calib_time: 28-May-2013\n"
    for k, offset in enumerate((0.0, -30.0)):
        text += f"S_0{k}: 64 48\nK_0{k}: 50 0 30 0 50 25 0 0 1\nD_0{k}: -0.3 0.1 0 0 0\n"
        text += f"R_0{k}: 1 0 0 0 1 0 0 0 1\nT_0{k}: {-0.6 * k} 0 0\nS_rect_0{k}: 64 48\n"
        text += f"R_rect_0{k}: 1 0 0 0 1 0 0 0 1\n"
        text += f"P_rect_0{k}: 50 0 31 {offset} 0 50 22 0 0 0 1 0\n"
    (tmp_path / "calibration").mkdir()
    (tmp_path / "calibration" / "perspective.txt").write_text(text)
    recording = open_dataset(drive).recording
    camera = recording.camera
    assert (camera.fu, camera.cu, camera.cv) == (50, 31, 22), "published images are rectified"
    assert camera.baseline_m == pytest.approx(0.6)


def test_monado_folder_with_basalts_calibration(tmp_path: Path) -> None:
    from tests.calibration_forms import basalt

    rng = np.random.default_rng(2)
    names = [f"{9_000_000_000_000 + 50_000_000 * k}" for k in range(2)]
    for side in range(2):
        images = tmp_path / "mav0" / f"cam{side}" / "data"
        images.mkdir(parents=True)
        for name in names:
            image = rng.integers(0, 256, (720, 1280), dtype=np.uint8)
            assert cv2.imwrite(str(images / f"{name}.png"), image)
        rows = "".join(f"{name},{name}.png\n" for name in names)
        (images.parent / "data.csv").write_text("#timestamp [ns],filename\n" + rows)
    (tmp_path / "extras").mkdir()
    basalt("equidistant", tmp_path / "extras")
    recording = open_dataset(tmp_path).recording
    assert recording.camera.baseline_m == pytest.approx(0.11, abs=1e-3)


def test_inspect_names_a_doubt_and_its_verdict_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A calibration for images of 32 x 24 pixels, which does not state their size."""
    folder = make_kitti(tmp_path / "seq", frames=3)
    rng = np.random.default_rng(2)
    for side in ("image_0", "image_1"):
        for file in (folder / side).iterdir():
            assert cv2.imwrite(str(file), rng.integers(0, 256, (36, 48), dtype=np.uint8))
    assert len(open_dataset(folder).recording.doubts) == 1
    main(["inspect", str(folder), "--frames", "0", "--json"])
    (doubt,) = json.loads(capsys.readouterr().out)["doubts"]
    assert "the middle of images of about 32 x 24 pixels, not of 48 x 36" in doubt
    main(["inspect", str(folder), "--frames", "0"])
    out = capsys.readouterr().out
    assert "DOUBT" in out
    assert ("settle the doubt above first" in out) == ("FAULT" not in out)
