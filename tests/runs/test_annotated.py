"""The annotated image of a run: which frame, and what is drawn."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from vio.records import StereoFrame, observations
from vio.view.annotated import AnnotatedImage


def _result(index: int, *, images: bool = True) -> Any:
    left = np.full((100, 200), 10 * index, np.uint8) if images else None
    seen = observations(
        index, index, [1, 2, 3], [[50, 50, 46, 50], [150, 50, 110, 50], [100, 80, 0, 0]], [1, 1, 0]
    )
    return SimpleNamespace(
        frame=StereoFrame(index, index, left, left), output=SimpleNamespace(observations=seen)
    )


def _drawn(view: AnnotatedImage) -> np.ndarray:
    data = view.jpeg()
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)


def test_the_frame_in_the_middle_is_drawn() -> None:
    view = AnnotatedImage(9)
    for k in range(9):
        view.frame(_result(k))
    assert abs(int(_drawn(view)[10, 10, 0]) - 40) < 3


def test_near_features_are_red_far_ones_blue_with_strokes_as_long_as_the_disparity() -> None:
    view = AnnotatedImage(1)
    view.frame(_result(0))
    image = _drawn(view).astype(int)
    assert image[50, 50, 0] > image[50, 50, 2]  # blue, green, red
    assert image[50, 150, 2] > image[50, 150, 0] + 50
    assert image[50, 113:148].max(axis=1).min() > 40
    assert image[50, 90:105].max() < 40


def test_a_wide_image_has_a_legend_and_one_without_features_is_shown() -> None:
    view = AnnotatedImage(1)
    frame = StereoFrame(0, 0, np.zeros((100, 1600), np.uint8), np.zeros((100, 1600), np.uint8))
    nothing = observations(0, 0, [], np.zeros((0, 4)), [])
    view.frame(SimpleNamespace(frame=frame, output=SimpleNamespace(observations=nothing)))
    assert _drawn(view).shape == (78 + 26, 1240, 3)


def test_a_resumed_run_counts_the_frames_before_and_one_without_images_has_none() -> None:
    view = AnnotatedImage(8)
    view.skip(6)
    view.frame(_result(6))
    view.frame(_result(7))
    assert abs(int(_drawn(view)[10, 10, 0]) - 60) < 3
    blind = AnnotatedImage(2)
    blind.frame(_result(0, images=False))
    assert blind.jpeg() is None
