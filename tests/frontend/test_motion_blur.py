"""Motion blur: learned from the images, and done to the anchors."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from vio.frontend.align import ITERATIONS, align, rounded, shift_warps
from vio.frontend.blurring import MARGIN_PX, MAX_SPREAD_PX2, spread_out
from vio.frontend.motion_blur import MotionBlur, _certain
from vio.frontend.tracks import AnchorBank
from vio.geometry.lie import FloatArray
from vio.records import Image

_FINER = 3  # samples of the scene along a side of a pixel
_SIDE = 260
_STEP_S = 0.05
_FRAMES = 24
_GRID = np.stack(np.meshgrid(np.arange(70.0, 151.0, 16.0), np.arange(70.0, 151.0, 16.0)), -1)
_POINTS = _GRID.reshape(-1, 2)


def _scene() -> FloatArray:
    """A texture, with `_FINER` samples along a side of a pixel."""
    noise = np.random.default_rng(0).normal(size=(_FINER * _SIDE,) * 2)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.2 * _FINER)
    return np.asarray(128.0 + 35.0 * smooth / smooth.std())


def _velocity(frame: int) -> FloatArray:
    """Of the image (2,), px/s: at rest, then along a line at an angle, to and fro."""
    return 260.0 * np.sin(0.35 * max(frame - 2, 0)) * np.array([0.8, 0.6])


def _image(scene: FloatArray, at: FloatArray, velocity: FloatArray, shutter_s: float) -> Image:
    """The scene moved by pixels (2,), while the shutter is open."""
    samples = np.linspace(-0.5, 0.5, 25)[1::2] * shutter_s if shutter_s else np.zeros(1)
    total = np.zeros((_SIDE, _SIDE))
    for time_s in samples:
        u, v = _FINER * (at + time_s * velocity)
        move = np.array([[1.0, 0.0, u], [0.0, 1.0, v]])
        moved = cv2.warpAffine(scene, move, scene.shape[::-1], borderMode=cv2.BORDER_WRAP)
        total += cv2.resize(moved, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(int(1e3 * abs(at).sum())).normal(0.0, 1.5, total.shape)
    return np.clip(np.rint(total / len(samples) + noise), 0, 255).astype(np.uint8)


def _run(
    shutter_s: float, *, learns: bool = True, focus_px: float = 0.0
) -> tuple[MotionBlur, float]:
    """Follow points for some frames; return the blur and the error of their pixels, rms.

    Args:
        shutter_s: time that the shutter is open.
        learns: whether the blur is learned.
        focus_px: standard deviation by which every image but the first is out of focus.
    """
    scene = _scene()
    bank = AnchorBank(len(_POINTS), 9)
    blur = MotionBlur(bank)
    at = np.zeros(2)
    image = _image(scene, at, _velocity(0), shutter_s)
    slots = bank.add(image, rounded(_POINTS))
    errors = []
    for frame in range(1, _FRAMES):
        velocity = _velocity(frame)
        at = at + velocity * _STEP_S
        image = _image(scene, at, velocity, shutter_s)
        if focus_px:
            image = cv2.GaussianBlur(image, (0, 0), focus_px)
        warp = shift_warps(_POINTS + at)
        blur.apply(slots, warp, np.tile(velocity, (len(slots), 1)))
        warp, _ = align(bank.store, slots, image, warp, ITERATIONS)
        moved = np.tile(velocity * _STEP_S, (len(slots), 1))
        if learns:
            blur.learn(image, slots, warp, moved, _STEP_S)
        errors.append(warp[:, :, 2] - _POINTS - at)
    return blur, float(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.parametrize(
    "spread", [(0.6, 0.1, 0.2), (0.0, 1.7, 0.0), (1.5, 1.5, -1.4), (2.4, 0.6, 1.2)]
)
def test_patches_are_spread_by_the_covariance_that_is_asked_for(
    spread: tuple[float, float, float],
) -> None:
    side = 31 + 2 * MARGIN_PX
    point = np.zeros((1, side, side), np.float32)
    point[0, side // 2, side // 2] = 1.0
    out = spread_out(point, np.array([spread]), np.array([0]))[0].astype(np.float64)
    y, x = np.mgrid[-15:16, -15:16]
    assert out.shape == x.shape
    assert out.sum() == pytest.approx(1.0, abs=1e-5)
    found = [(out * part).sum() for part in (x * x, y * y, x * y)]
    assert found == pytest.approx(spread, abs=1e-4)
    assert [(out * part).sum() for part in (x, y)] == pytest.approx([0.0, 0.0], abs=1e-5)


def test_a_patch_that_is_not_spread_stays_as_it_is() -> None:
    sharp = np.random.default_rng(0).normal(size=(1, 33, 33)).astype(np.float32)
    out = spread_out(sharp, np.zeros((1, 3)), np.array([0]))
    assert np.array_equal(out[0], sharp[0, MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX])


@pytest.mark.parametrize("shutter_ms", [8.0, 15.0])
def test_how_long_the_shutter_is_open_is_learned_from_moving_features(shutter_ms: float) -> None:
    blur, _ = _run(1e-3 * shutter_ms)
    assert np.sqrt(12.0 * blur.shutter_s2) == pytest.approx(1e-3 * shutter_ms, rel=0.15)


@pytest.mark.parametrize("focus_px", [0.0, 1.0])
def test_images_without_motion_blur_leave_the_anchors_as_they_are(focus_px: float) -> None:
    blur, _ = _run(0.0, focus_px=focus_px)
    assert blur.shutter_s2 == 0.0


def test_features_are_found_more_exactly_in_blurred_images() -> None:
    _, sharp_px = _run(0.020, learns=False)
    _, blurred_px = _run(0.020)
    assert blurred_px < 0.6 * sharp_px


def _spread_at(first: float, second: float) -> FloatArray:
    """Spread (3,) of an anchor that was cut at a velocity and is aligned at another, px/s."""
    bank = AnchorBank(1, 9)
    slots = bank.add(_image(_scene(), np.zeros(2), np.zeros(2), 0.0), rounded(_POINTS[:1]))
    blur = MotionBlur(bank)
    blur.shutter_s2 = 1.0
    for velocity in (first, second):
        blur.apply(slots, shift_warps(_POINTS[:1]), np.array([[velocity, 0.0]]))
    return bank.spread[slots[0]]


def test_a_path_longer_than_the_margin_is_blurred_as_far_as_that_reaches() -> None:
    assert _spread_at(0.0, 50.0) == pytest.approx(np.array([MAX_SPREAD_PX2, 0.0, 0.0]))


def test_an_anchor_blurrier_than_the_image_stays_as_it_is() -> None:
    assert not _spread_at(1.0, 0.4).any()


def _asked(features: int) -> FloatArray:
    """Sums (4,) of so many features that show a blur of nothing, in images without noise."""
    image = _image(_scene(), np.zeros(2), np.zeros(2), 0.0)
    at = rounded(np.tile(_POINTS, (5, 1))[:features])
    bank = AnchorBank(features, 9)
    slots = bank.add(image, at)
    bank.velocity[slots] = 0.0
    blur = MotionBlur(bank)
    blur.learn(image, slots, shift_warps(at), np.tile([2.0, 0.0], (features, 1)), _STEP_S)
    return blur._sums


def _forgotten() -> float:
    """What is left of the sums after a frame at rest."""
    blur = MotionBlur(AnchorBank(1, 9))
    blur._sums += 1.0
    none = np.zeros(0, np.int64)
    blur.learn(np.zeros((9, 9), np.uint8), none, np.zeros((0, 2, 3)), np.zeros((0, 2)), _STEP_S)
    return float(blur._sums[0])


LIMITS: dict[str, tuple[Callable[[float], bool], float, float]] = {
    "memory": (lambda x: _forgotten() < x, 0.945, 0.955),
    # of a twentieth of the sums, with features that agree, and that disagree by twice what they state
    "certain": (lambda z: _certain(1.0, 20.0 * z * z, 20.0 * z * z, 20.0 * z * z) > 0.0, 4.8, 5.2),
    "disagree": (
        lambda z: _certain(1.0, 20.0 * z * z, 20.0 * z * z, 20.0 * z * z + 4.0) > 0.0,
        9.6,
        10.4,
    ),
    "blur of one feature": (lambda x: _asked(1)[0] ** -0.5 < x, 0.19, 0.21),
    "features": (lambda n: round(_asked(int(n))[0] / _asked(1)[0]) < n, 60, 61),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_what_is_learned(
    says: Callable[[float], bool], below: float, above: float
) -> None:
    assert not says(below)
    assert says(above)
