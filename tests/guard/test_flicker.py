"""Bands of brightness that move through the images: named and taken out; images without them
stay as they are.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.frontend.test_frontend_klt import FRAMES, step_errors
from tests.frontend.test_frontend_scene import CAMERA
from tests.frontend.test_right_camera import pair
from tests.guards import guarded_klt, lines_of
from vio.frontend.settings import FrontendSettings, GridSettings
from vio.guard.bands import BandRemoval
from vio.records import FrontendOutput, Image, StereoFrame


def banded(image: Image | None, frame: int, camera: int, gray: float = 50.0) -> Image:
    """An image with three bands at a phase of its own."""
    phase = np.random.default_rng((frame, camera)).uniform()
    bands = gray * np.sin(2 * np.pi * (3 * np.arange(len(image)) / len(image) + phase))
    return np.clip(image + bands[:, None], 0, 255).astype(np.uint8)


def test_images_without_bands_are_returned_as_they_are() -> None:
    removal, dark = BandRemoval(), np.zeros_like(pair(0)[0])
    for k in range(12):
        left, right = pair(k)
        right = dark if k % 3 == 2 else right  # a camera that loses frames makes no bands
        assert removal.flatten(k, left, right)[0] is left
    assert lines_of(removal) == []


def test_a_late_right_camera_makes_no_bands() -> None:
    """Its row means differ by what the scene has moved up or down in a frame: here by 12 rows."""
    rows = np.repeat(128 + 60 * np.sin(np.arange(400) / 25.0)[:, None], 200, axis=1)
    removal = BandRemoval()
    for k in range(12):
        left, right = (rows[12 * j : 12 * j + 150].astype(np.uint8) for j in (k + 1, k))
        assert removal.flatten(k, left, right)[0] is left
    assert lines_of(removal) == []


def test_cameras_that_set_their_exposure_alone_make_no_bands() -> None:
    """Bright sky above dark ground: a gain of one camera alone changes the difference of their
    row means.
    """
    light = np.repeat([190.0, 20.0], 75)[:, None]
    removal = BandRemoval()
    for k in range(12):
        gains = np.random.default_rng(k).uniform(0.4, 1.3, 2)
        left, right = (
            np.asarray(gain * light * (0.9 + 0.1 * np.cos(np.arange(200))), np.uint8)
            for gain in gains
        )
        assert removal.flatten(k, left, right)[0] is left
    assert lines_of(removal) == []


def test_bands_are_named_once_and_taken_out() -> None:
    removal, lines = BandRemoval(), []
    for k in range(12):
        images = tuple(banded(image, k, camera) for camera, image in enumerate(pair(k)))
        out = removal.flatten(k, *images)
        lines += lines_of(removal)
    (line,) = lines
    assert line.startswith("frame 3: bands of brightness move through the images")
    for image, flat in zip(images, out, strict=True):
        assert image.mean(axis=1).std() > 15.0
        assert flat.mean(axis=1).std() < 6.0


@pytest.mark.parametrize("removed", [True, False], ids=["removed", "control"])
def test_features_are_tracked_through_bands(removed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not removed:
        monkeypatch.setattr(BandRemoval, "flatten", lambda self, index, left, right: (left, right))
    frontend = guarded_klt(CAMERA, FrontendSettings(grid=GridSettings(target_features=150)))

    def process(frame: StereoFrame) -> FrontendOutput:
        k = frame.index
        return frontend.process(
            replace(frame, left=banded(frame.left, k, 0), right=banded(frame.right, k, 1))
        )

    outputs = [process(frame) for frame in FRAMES]
    tracked = outputs[-1].tracked
    if removed:
        assert tracked > 100
        assert np.median(step_errors(outputs, len(FRAMES) - 2)) < 0.1
    else:
        assert tracked < 75
