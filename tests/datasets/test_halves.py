"""Images that hold those of both cameras, where one camera is read, and right images in depth/."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.euroc_maker import RADTAN_RIG
from tests.plain_maker import make_plain, rig_of
from vio.datasets import open_dataset
from vio.datasets.halves import halves_note
from vio.datasets.images import UnreadableImageError
from vio.datasets.rigs.kalibr import kalibr_text
from vio.errors import DataError
from vio.records import Image

SIZE = (160, 100)  # of a half


def _texture(seed: int, width: int = SIZE[0]) -> Image:
    noise = np.random.default_rng(seed).normal(size=(SIZE[1], width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return (128 + 40 * smooth / smooth.std()).clip(0, 255).astype(np.uint8)


def _pair(k: int, disparity_px: int, rows_px: int = 0, noise: float = 5.0) -> Image:
    scene = _texture(k, SIZE[0] + 40)
    left = scene[:, : SIZE[0]]
    right = np.roll(scene, rows_px, axis=0)[:, disparity_px : disparity_px + SIZE[0]]
    both = np.hstack([left, right]).astype(np.float64)
    return (
        (both + noise * np.random.default_rng(k).normal(size=both.shape))
        .clip(0, 255)
        .astype(np.uint8)
    )


@pytest.mark.parametrize(("disparity_px", "rows_px"), [(0, 0), (12, 0), (30, 3)])
@pytest.mark.parametrize("squeezed", [False, True])
def test_halves_of_one_scene_are_doubted(disparity_px: int, rows_px: int, squeezed: bool) -> None:
    def load(k: int) -> Image:
        image = _pair(k, disparity_px, rows_px)
        return cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA) if squeezed else image

    note = halves_note(40, load)
    assert note is not None
    assert "seem to hold both images of a pair side by side" in note


def test_views_of_one_camera_are_not_doubted() -> None:
    assert halves_note(40, lambda k: _texture(k, 2 * SIZE[0])) is None
    assert halves_note(3, lambda k: np.zeros(SIZE[::-1], dtype=np.uint8)) is None
    assert halves_note(0, lambda k: _texture(k)) is None
    # two of five views that repeat themselves, as of a row of windows
    repeated = lambda k: _pair(k, 0) if k < 20 else _texture(k, 2 * SIZE[0])  # noqa: E731
    assert halves_note(41, repeated) is None


def _repeating(scene: str, width: int = 640) -> Image:
    """A view that looks the same along its rows, (480, width)."""
    y, x = np.mgrid[:480, :width]
    shades = {
        "horizon": np.where(y < 200, 200, 90),
        "tilted horizon": np.where(y < 200 + 0.05 * x, 200, 90),
        "bricks": 100 + 60 * (((y // 24) % 2 * 20 + x) % 40 > 3) * (y % 24 > 3),
        "fence": 80 + 100 * (x % 32 < 10),
        "wide fence": 80 + 100 * (x % 107 < 36),
        "checkerboard": 60 + 140 * ((x // 60 + y // 60) % 2),
        "small checkerboard": 60 + 140 * ((x // 20 + y // 20) % 2),
        "large checkerboard": 60 + 140 * ((x // 80 + y // 80) % 2),
    }
    noise = np.random.default_rng(0).normal(0, 6, y.shape)
    return (shades[scene] + noise).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    "scene",
    [
        *("horizon", "tilted horizon", "bricks", "fence", "wide fence"),
        *("checkerboard", "small checkerboard", "large checkerboard"),
    ],
)
@pytest.mark.parametrize("turned", [False, True])
def test_views_that_are_alike_along_their_rows_are_not_doubted(scene: str, turned: bool) -> None:
    image = _repeating(scene)
    assert halves_note(40, lambda k: image[:, ::-1] if turned else image) is None


def test_a_pair_with_a_horizon_is_doubted() -> None:
    def load(k: int) -> Image:
        both = 0.5 * _pair(k, 12).astype(np.float64)
        both[: SIZE[1] // 2] += 100
        return both.astype(np.uint8)

    assert halves_note(40, load) is not None


def test_unreadable_images_are_not_judged() -> None:
    def load(k: int) -> Image:
        raise UnreadableImageError("no")

    assert halves_note(9, load) is None


def test_a_recording_of_one_camera_says_that_its_images_hold_two(tmp_path: Path) -> None:
    folder = make_plain(tmp_path, frames=6)
    camera = RADTAN_RIG.cam0
    shutil.rmtree(folder / "right")
    (folder / "camchain-imucam.yaml").write_text(kalibr_text(rig_of(RADTAN_RIG).left_alone()))
    alone = open_dataset(folder)
    assert not any("side by side" in note for note in alone.recording.notes)
    for k in range(6):
        both = cv2.resize(_pair(k, 12), (camera.width, camera.height))
        cv2.imwrite(str(folder / "left" / f"{k}.png"), both)
    notes = open_dataset(folder).recording.notes
    assert any(
        "doubtful: the left and the right half of the images show one scene" in n for n in notes
    )


def test_right_images_among_the_depths_are_named(tmp_path: Path) -> None:
    folder = make_plain(tmp_path, frames=3)
    (folder / "right").rename(folder / "depth")
    with pytest.raises(
        DataError, match=r"0.png: has 8 bits, too few for depths; where depth/ holds"
    ):
        open_dataset(folder)
