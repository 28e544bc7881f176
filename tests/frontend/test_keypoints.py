"""Key points are spread over the image; features are followed where theirs are not detected
again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.frontend.test_frontend_scene import CAMERA, SLANTED, flight, stereo_frame, truth
from vio.frontend.descriptors import DescriptorFrontend
from vio.frontend.keypoints import (
    Keypoints,
    MutualNearest,
    OpenCvExtractor,
    orb_extractor,
    spread_rows,
)
from vio.frontend.settings import FrontendSettings, GridSettings, MatchSettings
from vio.geometry.stereo import left_alone
from vio.records import BoolArray, Image, IntArray

SETTINGS = FrontendSettings(
    grid=GridSettings(target_features=150), match=MatchSettings(max_keypoints=600)
)
POSES = flight(6)
FRAMES = [stereo_frame(k, pose) for k, pose in enumerate(POSES)]


def _share_on_strong_half(extract: Callable[..., list[Keypoints]]) -> float:
    """Share of the key points on the left half of an image, which has five times the contrast."""
    noise = np.random.default_rng(0).normal(size=(60, 80)).repeat(4, 0).repeat(4, 1)
    contrast = np.where(np.arange(320) < 160, 60.0, 12.0)
    image = (128.0 + contrast * noise.clip(-2.0, 2.0)).clip(0, 255).astype(np.uint8)
    (points,) = extract(image)
    assert len(points) == 300
    return float((points.pixels[:, 0] < 160.0).mean())


@pytest.mark.parametrize("name", ["orb", "sift"])
def test_one_thing_of_much_texture_does_not_take_all_key_points(name: str) -> None:
    assert 0.4 < _share_on_strong_half(OpenCvExtractor(name, 300)) < 0.7


def test_rows_are_the_strongest_of_each_cell_then_the_second_ones() -> None:
    u = np.array([*np.arange(10.0, 20.0), 310.0])  # two cells, for eight points
    pixels = np.stack([u, np.full(11, 10.0)], axis=1)
    strength = np.arange(11.0, 0.0, -1.0)
    chosen = spread_rows(pixels, strength, 8, (160, 320))
    assert chosen.tolist() == [0, 10, 1, 2, 3, 4, 5, 6]
    assert spread_rows(pixels[:0], strength[:0], 3, (160, 320)).tolist() == []


def _seen(hidden: range) -> list[np.ndarray]:
    """Ids in each frame, of an extractor that finds nothing in some of them."""
    orb = orb_extractor(SETTINGS.match)
    count = 0

    def extract(*images: Image) -> list[Keypoints]:
        nonlocal count
        count += 1
        found = orb(*images)
        if count - 1 in hidden:
            return [Keypoints(one.pixels[:0], one.descriptors[:0]) for one in found]
        return found

    frontend = DescriptorFrontend(CAMERA, SETTINGS, "orb", extract, MutualNearest())
    return [frontend.process(frame).observations.ids for frame in FRAMES]


def test_features_outlast_key_points_that_are_not_detected_again() -> None:
    """Their pixels are then predicted by the motion of others, or by the last one."""
    orb = orb_extractor(SETTINGS.match)
    half = DescriptorFrontend(
        CAMERA,
        SETTINGS,
        "orb",
        lambda *images: [Keypoints(one.pixels[::2], one.descriptors[::2]) for one in orb(*images)],
        MutualNearest(),
    )
    outputs = [half.process(frame) for frame in FRAMES]
    shared = np.isin(outputs[1].observations.ids, outputs[-1].observations.ids)
    assert shared.mean() > 0.7
    first = outputs[1].observations
    last = outputs[-1].observations
    _, i, j = np.intersect1d(first.ids, last.ids, return_indices=True)
    expected = truth(SLANTED, POSES[1], first.z[i, :2], POSES[-1])
    assert np.median(np.linalg.norm(last.z[j] - expected, axis=1)) < 0.2


def test_features_without_a_depth_outlast_them_too() -> None:
    """No key point is given in two frames in a row, and one camera has no depths."""
    orb = orb_extractor(SETTINGS.match)
    count = 0

    def extract(*images: Image) -> list[Keypoints]:
        nonlocal count
        count += 1
        rows = slice(count % 2, None, 2)
        return [Keypoints(one.pixels[rows], one.descriptors[rows]) for one in orb(*images)]

    camera = left_alone(CAMERA)
    frontend = DescriptorFrontend(camera, SETTINGS, "orb", extract, MutualNearest())
    seen = [frontend.process(replace(frame, right=None)).observations for frame in FRAMES]
    assert not any(s.has_right.any() for s in seen)
    assert np.isin(seen[1].ids, seen[-1].ids).mean() > 0.4  # 0.09 of key points alone


def test_features_outlast_a_frame_without_key_points() -> None:
    seen = _seen(range(3, 4))
    assert len(seen[2]) > 100
    assert np.isin(seen[2], seen[3]).mean() > 0.9
    assert np.isin(seen[2], seen[5]).mean() > 0.8


def test_a_wrong_match_does_not_give_a_feature_the_descriptor_of_another() -> None:
    """It is rejected, and the feature followed by the motion of others: its own key point is found
    in the next frame.
    """
    misled: list[np.ndarray] = []  # pixels of features in frame 3
    right: list[bool] = []  # whether they are found in frame 4
    count = 0

    def match(a: Keypoints, b: Keypoints, allowed: BoolArray) -> IntArray:
        nonlocal count
        count += 1
        pairs = MutualNearest()(a, b, allowed)
        if count == 3:  # every third pair gets the key point of another
            third = np.arange(0, len(pairs), 3)
            misled.extend(truth(SLANTED, POSES[2], a.pixels[pairs[third, 0]], POSES[3])[:, :2])
            pairs[third, 1] = np.roll(pairs[third, 1], 1)
        if count == 4:
            now = a.pixels[pairs[:, 0]]
            expected = truth(SLANTED, POSES[3], now, POSES[4])[:, :2]
            found = np.abs(b.pixels[pairs[:, 1]] - expected).max(axis=1) < 3.0
            apart = np.abs(now[:, None] - np.array(misled)).max(axis=2).min(axis=1)
            right.extend(found[apart < 1.0].tolist())
        return pairs

    frontend = DescriptorFrontend(CAMERA, SETTINGS, "orb", orb_extractor(SETTINGS.match), match)
    for frame in FRAMES[:5]:
        frontend.process(frame)
    assert len(right) >= 5
    assert np.mean(right) > 0.8
