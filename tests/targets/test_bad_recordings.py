"""What `vio calibrate-rig` says about files that cannot be used: one line with what to record."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.board_views import SMALL, write_imu
from tests.calibration.test_camera_imu import T_CAM_IMU, hand_imu
from vio import load_rig
from vio.cli import main
from vio.datasets.images import load_gray, write_png
from vio.geometry.lie import FloatArray, so3_log
from vio.records import Image, ImuRecord
from vio.targets.description import target_text

FEW = 9  # pairs: one more than are needed

Change = Callable[[FloatArray, str, int], FloatArray]  # of the image of a side, with its number


def _changed(pairs: Path, folder: Path, change: Change, count: int = FEW) -> Path:
    """Write the first pairs with each image changed."""
    for side in ("left", "right"):
        (folder / side).mkdir(parents=True)
        for k, file in enumerate(sorted((pairs / side).glob("*.png"))[:count]):
            image = change(load_gray(file)[0].astype(np.float64), side, k)
            write_png(folder / side / file.name, _as_image(image))
    return folder


def _as_image(values: FloatArray) -> Image:
    return np.ascontiguousarray(np.clip(np.rint(values), 0, 255).astype(np.uint8))


def _right_alone(change: Callable[[FloatArray], FloatArray]) -> Change:
    return lambda image, side, k: change(image) if side == "right" else image


def _refusal(folder: Path, target: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that the command ends with."""
    out = folder.parent / "rig"
    command = ["calibrate-rig", str(folder), "--target", str(target), "--lens", "radtan"]
    assert main([*command, "--out", str(out)]) == 1
    assert not out.exists()
    error = [line for line in capsys.readouterr().err.splitlines() if "NOTE" not in line]
    assert len(error) == 1
    return error[0]


BAD_IMAGES: dict[str, tuple[Change, str]] = {
    "mirrored": (lambda image, side, k: image[:, ::-1], "left camera: the images are mirrored"),
    "right mirrored": (_right_alone(np.fliplr), "right camera: the images are mirrored"),
    "inverted": (lambda image, side, k: 255 - image, "the images are inverted"),
    "overexposed": (lambda image, side, k: 6 * image, "overexposed, 9[0-9] % of their pixels"),
    "dark": (lambda image, side, k: 0.05 * image, "the images are dark, .* record with more light"),
    "right covered": (
        _right_alone(np.zeros_like),
        "right camera: the images are dark",
    ),
    "right turned": (
        _right_alone(lambda image: image[::-1, ::-1]),
        "the right camera is turned by 180 degrees against the left one: turn the images",
    ),
    "both turned": (lambda image, side, k: image[::-1, ::-1], "exchange left and right images"),
}


@pytest.mark.parametrize("name", BAD_IMAGES)
def test_says_what_is_wrong_with_images(
    name: str,
    board_pairs: Path,
    board_file: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    change, words = BAD_IMAGES[name]
    folder = _changed(board_pairs, tmp_path / "pairs", change)
    message = _refusal(folder, board_file, capsys)
    assert re.search(words, message)


def test_names_one_view_that_is_repeated(
    board_pairs: Path, board_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    first: dict[str, FloatArray] = {}

    def same(image: FloatArray, side: str, k: int) -> FloatArray:
        shown = first.setdefault(side, image)
        return shown + 2 * rng.normal(size=image.shape)

    folder = _changed(board_pairs, tmp_path / "pairs", same)
    message = _refusal(folder, board_file, capsys)
    assert "in 9 frames, and of these only 1 differ, and 8 are needed: move the board" in message


def test_names_too_few_pairs(
    board_pairs: Path, board_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = _changed(board_pairs, tmp_path / "pairs", lambda image, side, k: image, 5)
    assert "sees the board in all 5 frames, and 8 are needed: record 30 s" in _refusal(
        folder, board_file, capsys
    )


def test_names_cameras_that_never_see_the_board_together(
    board_pairs: Path, board_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def in_turns(image: FloatArray, side: str, k: int) -> FloatArray:
        return image if (side == "left") == (k % 2 == 0) else np.full_like(image, 120)

    folder = _changed(board_pairs, tmp_path / "pairs", in_turns, 16)
    message = _refusal(folder, board_file, capsys)
    assert "the cameras see the board together in 0 frames, and 4 are needed" in message


def test_names_a_camera_that_is_out_of_focus(
    board_pairs: Path, board_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    blur = _right_alone(lambda image: np.asarray(cv2.GaussianBlur(image, (0, 0), 3.0), float))
    folder = _changed(board_pairs, tmp_path / "pairs", blur, 12)
    command = ["calibrate-rig", str(folder), "--target", str(board_file), "--lens", "radtan"]
    assert main([*command, "--out", str(tmp_path / "rig")]) == 0
    assert re.search(
        "the right camera's corners are [0-9.]+ times less accurate", capsys.readouterr().out
    )


TEXT = target_text(SMALL)
CHARUCO = "target_type: charuco\nsquaresX: 5\nsquaresY: 7\nsquareSize: 0.04\nmarkerSize: 0.028\n"

BAD_TARGETS = {
    "fewer columns": (TEXT.replace("tagCols: 4", "tagCols: 3"), "rows of 4 tags, .* says 3"),
    "many columns": (TEXT.replace("tagCols: 4", "tagCols: 99"), "rows of 4 tags, .* says 99"),
    "other spacing": (
        TEXT.replace("tagSpacing: 0.3", "tagSpacing: 0.2"),
        "tagSpacing is about 0.3 in the images, and 0.2 in the target file",
    ),
    "other numbers": (TEXT + "codeOffset: 20\n", "an AprilGrid with tags 0 to 11"),
    "other family": (TEXT + "tagFamily: t16h5\n", "'tagFamily' is 't16h5', .* tags of 36h11"),
    "dictionary": (TEXT + "dictionary: DICT_4X4_50\n", "'dictionary' is 'DICT_4X4_50'"),
    "too many tags": (
        TEXT.replace("Cols: 4", "Cols: 99").replace("Rows: 3", "Rows: 9"),
        "36h11 has 587 markers",
    ),
    "true": (TEXT.replace("tagCols: 4", "tagCols: true"), "'tagCols' is True, no number"),
    "no dictionary": (CHARUCO + "dictionary: DICT_4X4_51\n", "such as DICT_4X4_50 or DICT_"),
    "no size": (CHARUCO.replace("0.04", "0"), "'squareSize' is 0, no length in metres"),
    "text for a flag": (CHARUCO + "legacyPattern: 'no'\n", "write true or false"),
    "empty": ("\n", "is empty; give Kalibr's YAML"),
    "truncated": (TEXT[: len(TEXT) // 2], "has no entry 'tagSpacing'; add it"),
    "binary": (bytes(range(256)).decode("latin1"), "not a text file"),
}


@pytest.mark.parametrize("name", BAD_TARGETS)
def test_says_what_is_wrong_with_the_target_file(
    name: str, board_pairs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text, words = BAD_TARGETS[name]
    file = tmp_path / "board.yaml"
    file.write_bytes(text.encode("latin1"))
    message = _refusal(board_pairs, file, capsys)
    assert re.search(words, message)
    if "camera" not in message:
        assert str(file) in message


def test_names_a_board_that_was_moved_before_a_rig_at_rest(
    board_record: Path, board_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(board_record, tmp_path / "record")
    moved = hand_imu(1, 12.0, np.zeros(15))
    rng = np.random.default_rng(2)
    shape = moved.gyro.shape
    gyro = [0.01, -0.02, 0.005] + 2e-3 * rng.normal(size=shape)
    accel = [0.1, 3.0, 9.3] + 2e-2 * rng.normal(size=shape)
    write_imu(folder / "imu.csv", ImuRecord(moved.times_ns, gyro, accel))
    message = _refusal(folder, board_file, capsys)
    assert "the board was moved, not the rig: fix the board" in message
    assert "--no-imu" in message


def test_calibrates_one_camera_with_its_imu_and_names_a_size_that_the_imu_contradicts(
    board_record: Path, board_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder of images and samples alone: no calibration lies beside them."""
    out = tmp_path / "rig"
    command = ["calibrate-rig", str(board_record), "--target", str(board_file)]
    assert main([*command, "--lens", "radtan", "--size", "0.084", "--out", str(out)]) == 0
    assert "by the IMU the board is 4." in capsys.readouterr().out
    found = load_rig(out / "camchain-imucam.yaml").T_cam0_imu
    assert found is not None
    assert np.degrees(np.linalg.norm(so3_log(found[:3, :3] @ T_CAM_IMU[:3, :3].T))) < 0.05
