"""A left image that is that of the frame before, up to noise, while the right one is new."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vio.guard.frozen_image import FrozenCamera
from vio.records import Image

HEIGHT = 120
WIDTH = 240
STEP_PX = 6
_NOISE = np.random.default_rng(1).normal(0.0, 1.0, (HEIGHT, 6 * WIDTH)).astype(np.float32)
_BLURRED = np.asarray(cv2.GaussianBlur(_NOISE, (0, 0), 3.0), dtype=np.float64)
TEXTURE = 120.0 + 40.0 * _BLURRED / _BLURRED.std()


def _image(at_px: int, rng: np.random.Generator, noise: float = 1.0) -> Image:
    noisy = TEXTURE[:, at_px : at_px + WIDTH] + rng.normal(0.0, noise, (HEIGHT, WIDTH))
    return np.asarray(np.clip(np.rint(noisy), 0, 255), dtype=np.uint8)


def _frozen_frames(left_px: list[int], right_px: list[int]) -> list[int]:
    """Frames whose left image counts as frozen, of views that begin at some columns."""
    rng = np.random.default_rng(2)
    check = FrozenCamera()
    return [
        k
        for k, (left, right) in enumerate(zip(left_px, right_px, strict=True))
        if check.left_is_frozen(k, _image(left, rng), _image(right + 10, rng))
    ]


def test_single_left_images_that_are_repeated_with_new_noise_are_not_used() -> None:
    moving = list(range(0, 40 * STEP_PX, STEP_PX))
    repeated = moving.copy()
    for k in (10, 17, 18, 30):
        repeated[k] = repeated[k - 1]
    assert _frozen_frames(repeated, moving) == [10, 17, 18, 30]


@pytest.mark.parametrize("step_px", [0, 1, STEP_PX])
def test_cameras_that_see_the_same_motion_are_used(step_px: int) -> None:
    moving = [step_px * k for k in range(40)]
    assert not _frozen_frames(moving, moving)


def test_a_repeated_right_image_does_not_freeze_the_left_one() -> None:
    moving = list(range(0, 40 * STEP_PX, STEP_PX))
    repeated = moving.copy()
    repeated[20] = repeated[19]
    assert not _frozen_frames(moving, repeated)


@pytest.mark.parametrize("step_px", [0, 1])
@pytest.mark.parametrize("share", [0.2, 0.5, 1.0])
def test_what_covers_the_right_image_does_not_freeze_the_left_one(
    step_px: int, share: float
) -> None:
    """A hand or a wiper at a standstill, or lines that are lost."""
    rng = np.random.default_rng(2)
    check = FrozenCamera()
    frozen: list[int] = []
    for k in range(40):
        right = _image(step_px * k + 10, rng)
        if k > 10 and k % 5 < 2:
            right[:, : int(share * WIDTH)] = rng.integers(0, 255, (HEIGHT, int(share * WIDTH)))
        if check.left_is_frozen(k, _image(step_px * k, rng), right):
            frozen.append(k)
    assert not frozen


@pytest.mark.parametrize("ago", [2, 5])
@pytest.mark.parametrize("camera", [0, 1])
def test_an_image_of_some_frames_ago_is_not_used(ago: int, camera: int) -> None:
    """Of one camera: its ring of buffers was read at the wrong place."""
    rng = np.random.default_rng(2)
    moving = [[_image(STEP_PX * k + at_px, rng) for k in range(20)] for at_px in (0, 10)]
    shown = [list(images) for images in moving]
    for k in (8, 12):
        shown[camera][k] = moving[camera][k - ago]
    check = FrozenCamera()
    frozen: list[list[int]] = [[], []]
    for k, (left, right) in enumerate(zip(*shown, strict=True)):
        if check.left_is_frozen(k, left, right):
            frozen[0].append(k)
        elif not check.right_usable:
            frozen[1].append(k)
    assert frozen[camera] == [8, 12]
    assert not frozen[1 - camera]


def test_what_both_cameras_or_dark_ones_show_again_freezes_none() -> None:
    rng = np.random.default_rng(2)
    views = [(_image(STEP_PX * k, rng), _image(STEP_PX * k + 10, rng)) for k in range(8)]
    black = np.zeros_like(views[0][0])
    check = FrozenCamera()
    for k, (left, right) in enumerate([*views, *views[:4]]):
        assert not check.left_is_frozen(k, left, right)
        assert check.right_usable
    check = FrozenCamera()
    for k, (_, right) in enumerate(views):
        assert not check.left_is_frozen(k, _image(STEP_PX * k, rng) if k % 3 else black, right)
