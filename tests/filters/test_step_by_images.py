"""Where a fit begins after a gap in which the body did not go on as before."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.filters.test_msckf import CAMERA, EXACT_RIG, T_CAM0_IMU
from vio.filters.msckf import Msckf
from vio.filters.step_by_images import (
    explained_share,
    is_lost,
    linked_points,
    step_by_images,
)
from vio.filters.track_records import Views
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, se3_log, transform_points
from vio.geometry.stereo import project
from vio.records import observations

MOTION = se3_exp([0.1, -0.05, -0.8, 0.02, 0.1, -0.03])


def _views(motion: FloatArray, wrong: int = 0, count: int = 60) -> Views:
    """Points in two frames; the first ones move by themselves."""
    rng = np.random.default_rng(1)
    p = np.column_stack([rng.uniform(-2, 2, (count, 2)), rng.uniform(4, 10, count)])
    later = transform_points(motion, p)
    later[:wrong] += rng.uniform(-1.0, 1.0, (wrong, 3))
    z = np.stack([project(CAMERA, p), project(CAMERA, later)], axis=1)
    weight = np.ones(z.shape)
    weight[:, :, 3] = 0.0  # the right row says nothing that the left one does not
    return Views(z + rng.normal(0, 0.2, z.shape), weight)


@pytest.mark.parametrize("wrong", [0, 20])
def test_the_motion_that_most_features_show_is_found(wrong: int) -> None:
    found = step_by_images(CAMERA, *linked_points(CAMERA, _views(MOTION, wrong)))
    assert found is not None
    assert np.linalg.norm(se3_log(se3_inverse(MOTION) @ found)[:3]) < 0.02


def test_nothing_is_found_of_few_features_or_without_a_common_motion() -> None:
    for views in (_views(MOTION, count=11), _views(MOTION, wrong=60)):
        assert step_by_images(CAMERA, *linked_points(CAMERA, views)) is None
    unseen = _views(MOTION)
    unseen.weight[:, -1, 2] = 0.0  # no right image
    assert not len(linked_points(CAMERA, unseen)[0])


@pytest.mark.parametrize("gap_s", [1.0, 3.0, 10.0])
def test_a_body_that_stops_in_a_gap_is_where_it_stopped(gap_s: float) -> None:
    """By images alone it goes on through the gap as fast as before, and all points lie behind it
    then: the pose was off by hundreds of metres, for ever.
    """
    rng = np.random.default_rng(0)
    points = rng.uniform([-15, -8, 2], [15, 8, 60], (600, 3))  # camera frame at the start
    filt = Msckf(CAMERA, T_CAM0_IMU, EXACT_RIG, motion=None)
    time_s = 0.0
    ahead_m = 0.0
    for k in range(30):
        if k:
            time_s += 0.1 if k < 12 else gap_s
            ahead_m += 1.0 if k < 12 else 0.3
        T_cam0_first = np.eye(4)
        T_cam0_first[2, 3] = -ahead_m
        p = transform_points(T_cam0_first, points)
        z = project(CAMERA, np.where(p[:, 2:] > 1.0, p, [0.0, 0.0, 1.0]))
        seen = (p[:, 2] > 1.0) & (z[:, 2] > 0) & (z[:, 0] < 752) & (z[:, 1] > 0) & (z[:, 1] < 480)
        ids = np.flatnonzero(seen)[:80]
        noisy = z[ids] + rng.normal(0, 0.3, (len(ids), 4))
        filt.update(observations(k, round(time_s * 1e9), ids, noisy))
        estimate = filt.estimate()
        T = T_CAM0_IMU @ se3_inverse(estimate.T_world_imu) @ se3_inverse(T_CAM0_IMU)
        assert np.linalg.norm(T[:3, 3] - T_cam0_first[:3, 3]) < 0.3
    assert np.sqrt(np.trace(estimate.covariance[:3, :3])) < 0.3


@pytest.mark.parametrize(("count", "found"), [(11, False), (12, True)])
def test_a_dozen_features_show_a_motion(count: int, found: bool) -> None:
    step = step_by_images(CAMERA, *linked_points(CAMERA, _views(MOTION, count=count)))
    assert (step is not None) == found


@pytest.mark.parametrize(("disparity_px", "linked"), [(1.8, 0), (2.2, 60)])
def test_features_far_away_link_no_frames(disparity_px: float, linked: int) -> None:
    views = _views(MOTION)
    views.z[:, 0, 2] = views.z[:, 0, 0] - disparity_px
    assert len(linked_points(CAMERA, views)[0]) == linked


@pytest.mark.parametrize(("off_px", "share"), [(3.5, 1.0), (4.5, 0.0)])
def test_a_feature_some_pixels_off_is_not_explained(off_px: float, share: float) -> None:
    p = np.column_stack([np.linspace(-2, 2, 20), np.zeros(20), np.full(20, 6.0)])
    z = project(CAMERA, transform_points(MOTION, p))
    z[:, 1] += off_px
    assert explained_share(CAMERA, MOTION, p, z) == share


@pytest.mark.parametrize(("moving", "found"), [(27, True), (33, False)])
def test_half_of_the_features_must_show_the_motion(moving: int, found: bool) -> None:
    p, z = linked_points(CAMERA, _views(MOTION))
    z[:moving, 1] += np.where(np.arange(moving) % 2, 90.0, -90.0)
    assert (step_by_images(CAMERA, p, z) is not None) == found


@pytest.mark.parametrize(
    ("off_px", "usable", "lost"),
    [(14.0, 20, False), (16.0, 20, True), (1.0, 11, False), (1.0, 9, True)],
)
def test_a_prediction_is_lost_where_tracks_are_far_off_or_behind(
    off_px: float, usable: int, lost: bool
) -> None:
    tracks: Any = SimpleNamespace(rows=np.arange(usable), newest_innovation=lambda: off_px)
    no_landmarks = Views(np.zeros((0, 4)), np.zeros((0, 4)))
    anything: Any = None
    assert is_lost(anything, anything, tracks, 20, no_landmarks) == lost
