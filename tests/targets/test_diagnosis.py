"""Why a board is not found: each reason in one line that says what to do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.board_views import SMALL, SMALL_LEFT, made_views, render_pairs, render_twice
from vio.cli import main
from vio.datasets.images import load_gray, write_png
from vio.errors import DataError
from vio.geometry.lie import se3_from_parts, so3_exp
from vio.records import Image
from vio.targets.calibrate import calibrate_cameras
from vio.targets.description import Target, target_text
from vio.targets.diagnosis import diagnose, shown_twice
from vio.targets.recording import Filmed
from vio.targets.rendering import BoardRenderer, Exposure
from vio.targets.seeds import checkerboard_seeds

CHARUCO = Target("charuco", 6, 8, 0.05, 0.7, "DICT_4X4_50")
CHECKERBOARD = Target("checkerboard", 6, 9, 0.05)


@pytest.fixture(scope="module")
def images() -> dict[str, Image]:
    """One image of each kind of board, which nearly fills it."""
    out: dict[str, Image] = {}
    for target in (SMALL, CHARUCO, CHECKERBOARD):
        R = so3_exp([0.3, -0.2, 0.1])
        centre = np.array([*(0.5 * np.array(target.extent_m)), 0.0])
        T = se3_from_parts(R, [0.0, 0.0, 0.45] - R @ centre)
        out[target.kind] = BoardRenderer(target, SMALL_LEFT).render(T, Exposure(0.6, 2.0))
    return out


@pytest.mark.parametrize(
    ("described", "words"),
    [
        (replace(SMALL, rows=4, cols=3), "rows of 4 tags, and the target file says 3"),
        (replace(SMALL, ratio=0.2), "tagSpacing is about 0.3 in the images, and 0.2"),
        (replace(CHARUCO, cols=7), "rows of 8 squares, and the target file says 7"),
        (replace(CHARUCO, legacy=True), "legacyPattern: false"),
        (replace(CHARUCO, dictionary="DICT_5X5_100"), "markers of DICT_4X4_1000"),
        (replace(CHECKERBOARD, cols=8), "checkerboard of 6 x 9 squares"),
        # The larger board holds this one twice.
        (replace(CHECKERBOARD, rows=5, cols=4), "6 x 9 squares (5 x 8 inner corners)"),
    ],
    ids=["columns", "spacing", "charuco columns", "legacy", "dictionary", "checkerboard", "half"],
)
def test_names_another_board_than_the_files(
    described: Target, words: str, images: dict[str, Image]
) -> None:
    reason = diagnose([images[described.kind]], described)
    assert reason is not None
    assert words in reason
    assert "\n" not in reason


def test_sees_no_board_in_corners_of_anything() -> None:
    noise = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (480, 640)), (0, 0), 4)
    image = (255 * (noise - noise.min()) / np.ptp(noise)).astype(np.uint8)
    few = replace(CHECKERBOARD, rows=6, cols=4)
    assert len(checkerboard_seeds(image, few)[1])  # by OpenCV
    assert shown_twice([image], few) is None


@pytest.mark.parametrize("shown", [SMALL, CHECKERBOARD], ids=lambda target: target.kind)
def test_names_a_board_of_another_kind(shown: Target, images: dict[str, Image]) -> None:
    reason = diagnose([images[shown.kind]], CHARUCO)
    kind = "an AprilGrid" if shown is SMALL else "a checkerboard"
    assert reason is not None
    assert f"the images show {kind}" in reason


@pytest.mark.parametrize("target", [SMALL, CHARUCO], ids=lambda target: target.kind)
def test_does_not_name_the_right_board_that_is_hardly_seen(
    target: Target, images: dict[str, Image]
) -> None:
    part = images[target.kind].copy()
    part[:, : part.shape[1] // 2] = 120
    part[part.shape[0] // 2 :] = 120
    assert diagnose([part], target) is None


@pytest.mark.parametrize("target", [SMALL, CHARUCO], ids=lambda target: target.kind)
def test_names_mirrored_images(target: Target, images: dict[str, Image]) -> None:
    mirrored = np.ascontiguousarray(images[target.kind][:, ::-1])
    reason = diagnose([mirrored], target)
    assert reason is not None
    assert "mirrored" in reason


@pytest.mark.parametrize("target", [SMALL, CHARUCO, CHECKERBOARD], ids=lambda target: target.kind)
def test_names_a_board_that_is_shown_twice(target: Target) -> None:
    camera = replace(SMALL_LEFT, width=752, cu=374.0)
    reason = diagnose([render_twice(target, camera, 0.5)], target)
    assert reason is not None
    assert "the images show the board twice" in reason


@pytest.mark.parametrize("target", [SMALL, CHARUCO, CHECKERBOARD], ids=lambda target: target.kind)
def test_finds_nothing_wrong_with_the_right_file(target: Target, images: dict[str, Image]) -> None:
    assert diagnose([images[target.kind]], target) is None
    empty = np.full_like(images[target.kind], 120)
    assert diagnose([empty], target) is None
    assert diagnose([images[target.kind], empty], target) is None


def test_the_command_names_mirrored_images_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = render_pairs(tmp_path / "pairs", 3)
    for file in folder.glob("*/*.png"):
        write_png(file, np.ascontiguousarray(load_gray(file)[0][:, ::-1]))
    target = tmp_path / "target.yaml"
    target.write_text(target_text(SMALL))
    assert main(["calibrate-rig", str(folder), "--target", str(target)]) == 1
    message = capsys.readouterr().err
    assert "left camera: the images are mirrored" in message
    assert message.count("\n") == 1


def test_a_wrong_file_whose_views_fit_badly_is_named(images: dict[str, Image]) -> None:
    """Corners are found, as tags are read one by one, but no lens explains them."""
    views = made_views(3, 10)
    described = Target("aprilgrid", 6, 6, 0.088, 0.5)
    filmed = Filmed(views, ((752, 480), (752, 480)), 10, None, (), ((images["aprilgrid"],) * 2,))
    with pytest.raises(DataError, match=r"rows of 4 tags, and the target file says 6"):
        calibrate_cameras(replace(filmed, views=views[:3]), described)
    with pytest.raises(Exception, match=r"rows of 4 tags, and the target file says 6"):
        calibrate_cameras(filmed, described, "radtan")
