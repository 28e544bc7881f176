"""A right camera that has turned leaves the order of depths; exchanged images reverse it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.frontend.test_frontend_scene import CAMERA
from tests.guards import codes, guarded_klt
from vio.frontend.settings import FrontendSettings, GridSettings
from vio.guard.depth_order import have_same_order, keeps_depth_order
from vio.records import Image, StereoFrame

WIDTH, HEIGHT = 480, 300
TURNED_FROM = 8
TURN_PX = 34  # more than the disparities
PAN_PX = 40  # a frame: with it, left images and right ones of other frames match


def _texture(seed: int) -> Image:
    noise = np.random.default_rng(seed).uniform(0.0, 255.0, (HEIGHT, 1600))
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5)
    return np.asarray(cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX), dtype=np.uint8)


FAR, NEAR = _texture(0), _texture(1)


def _view(column: int, disparity: bool) -> Image:
    """A far wall (6 px) and bands of a near one (20 px), seen by a camera that has panned."""
    far = column + 6 * disparity
    near = column + 20 * disparity
    image = FAR[:, far : far + WIDTH].copy()
    for row in range(20, HEIGHT - 40, 80):
        image[row : row + 40] = NEAR[row : row + 40, near : near + WIDTH]
    return image


def _pair(k: int, turn_px: int = 0) -> tuple[Image, Image]:
    column = 100 + PAN_PX * k
    return _view(column, False), _view(column - turn_px, True)


@pytest.mark.parametrize("turn_px", [-30, 0, TURN_PX, 60])
def test_a_turned_right_camera_keeps_the_order_of_depths(turn_px: int) -> None:
    left, right = _pair(1, turn_px)
    assert keeps_depth_order(_pair(0), (left, right))
    assert not keeps_depth_order(_pair(0), (right, left))


def test_depths_of_other_things_have_no_order() -> None:
    noise = np.random.default_rng(2)
    other = noise.integers(0, 256, (2, HEIGHT, WIDTH)).astype(np.uint8)
    assert not keeps_depth_order(_pair(0), (other[0], other[1]))
    assert not have_same_order(*noise.normal(size=(2, 400)))
    rising = np.arange(30.0)
    assert have_same_order(rising, rising)
    assert not have_same_order(rising[:19], rising[:19])  # too few


@pytest.mark.parametrize("direction", [-1, 1])
def test_a_right_camera_that_turns_while_the_rig_pans_is_none_of_another_time(
    direction: int,
) -> None:
    """KITTI 05, yawed by 1.5 degrees: its images were exchanged, or taken for late (14 sigma)."""
    frontend = guarded_klt(CAMERA, FrontendSettings(grid=GridSettings(target_features=150)))
    outputs = []
    for k in range(TURNED_FROM + 8):
        turn_px = TURN_PX if k >= TURNED_FROM else 0
        left, right = _pair(k if direction > 0 else 20 - k, turn_px)
        outputs.append(frontend.process(StereoFrame(k, 50_000_000 * k, left, right)))
    assert set(codes(outputs)) == {"right-contradicts-left"}
