"""Streams in which the images of both cameras come in turns."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.euroc_maker import RADTAN_RIG
from tests.plain_maker import make_plain, rig_of
from vio.datasets import open_dataset
from vio.datasets.alternation import alternating_note
from vio.datasets.images import UnreadableImageError
from vio.datasets.rigs.kalibr import kalibr_text
from vio.errors import DataError
from vio.records import Image

SHAPE = (48, 96)


def _scene(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(SHAPE[0], 4 * SHAPE[1])).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return (128 + 40 * smooth / smooth.std()).clip(0, 255).astype(np.uint8)


def _seen(scene: np.ndarray, at_px: float) -> Image:
    """The part of a scene behind a place, to a fraction of a pixel."""
    moved = np.array([[1.0, 0.0, -at_px], [0.0, 1.0, 0.0]])
    return np.asarray(cv2.warpAffine(scene, moved, SHAPE[::-1]), dtype=np.uint8)


def _stream(parallax_px: float, motion_px: float, shake_px: float = 0.0) -> list[Image]:
    """Forty images of a camera that moves, every second one from a place aside."""
    scene = _scene()
    shakes = shake_px * np.random.default_rng(1).normal(size=40)
    return [
        _seen(scene, 60.0 + motion_px * k + shakes[k] + parallax_px * (k % 2)) for k in range(40)
    ]


@pytest.mark.parametrize(
    ("parallax_px", "motion_px", "shake_px", "alternate"),
    [
        (2.0, 0.5, 0.0, True),
        (2.0, 3.0, 0.3, True),
        (0.5, 0.0, 0.0, True),
        (0.1, 0.0, 0.0, False),
        (0.0, 0.0, 0.0, False),
        (0.0, 2.0, 0.0, False),
        (0.0, 0.5, 2.0, False),
        (1.0, 0.5, 2.0, False),
    ],
)
def test_views_that_alternate_are_told_from_motion(
    parallax_px: float, motion_px: float, shake_px: float, alternate: bool
) -> None:
    images = _stream(parallax_px, motion_px, shake_px)
    assert (alternating_note(len(images), images.__getitem__) is not None) is alternate


def test_views_that_alternate_later_are_found_and_few_or_unreadable_ones_say_nothing() -> None:
    images = [*_stream(0.0, 0.5)[:16], *_stream(2.0, 0.5)]
    assert alternating_note(len(images), images.__getitem__) is not None
    assert alternating_note(15, images.__getitem__) is None

    def unreadable(k: int) -> Image:
        raise UnreadableImageError("damaged")

    assert alternating_note(40, unreadable) is None


def test_a_folder_and_a_video_of_both_cameras_in_turns_are_doubted(tmp_path: Path) -> None:
    """They were one camera alone, or a video of the wrong width."""
    folder = make_plain(tmp_path / "images", 20, times=False, imu=False, reference=False)
    size = (RADTAN_RIG.cam0.width, RADTAN_RIG.cam0.height)
    images = [cv2.resize(image, size) for image in _stream(3.0, 0.5)]
    shutil.rmtree(folder / "right")
    for k, image in enumerate(images):
        assert cv2.imwrite(str(folder / "left" / f"{k}.png"), image)
    notes = open_dataset(folder).recording.notes
    assert len([note for note in notes if "alternate between two views" in note]) == 1
    film = tmp_path / "film"
    film.mkdir()
    (film / "camchain-imucam.yaml").write_text(kalibr_text(rig_of(RADTAN_RIG)))
    writer = cv2.VideoWriter(str(film / "video.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 40.0, size)
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    with pytest.raises(DataError, match=r"is the only video, .* alternate between two views"):
        open_dataset(film)
