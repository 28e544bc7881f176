"""The camera's motion across a time without usable images: key points of the last good pair, found
again after it.

A tracker's patches prove nothing once the prediction is off by many pixels. Key points of the whole
image are matched by descriptor, and the motion that they show must hold in both cameras: it brings
the points of the last pair to their pixels in the left image, and to the depths that the new pair
measures.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.frontend.columns import share_of
from vio.frontend.frame_images import FrameImages
from vio.frontend.outliers import RansacProblem, best_motion
from vio.frontend.patches import ImageLevels
from vio.frontend.settings import MatchSettings
from vio.frontend.stereo_fit import StereoFit
from vio.frontend.tracks import PreviousFrame
from vio.geometry.lie import FloatArray, so3_log, transform_points
from vio.geometry.stereo import depth_of, left_rays
from vio.numerics.statistics import chi_square_quantile
from vio.records import MotionPrior, TrackPrior


class _ReappearanceRules(NamedTuple):
    """When key points show the motion across a time without images."""

    min_points: int = 15  # that must agree on the motion …
    min_share: float = 0.4  # … and of all matches with depths
    # share of these whose new disparity must be that of the moved point
    min_depths_share: float = 0.5
    rotation_sigma_deg: float = 0.3  # of a motion by key points
    rotation_probability: float = 0.9999  # of a rotation measured beside it
    disparity_px: float = 2.0  # as far as whole pixels at half resolution tell


_AGAIN = _ReappearanceRules()


class _LongGapRules(NamedTuple):
    """When tracks are not followed over a gap."""

    min_s: float = 0.8  # a rig that flies or is carried shows other things after it …
    min_steps: float = 5.0  # … where frames usually come so many times as often


_LONG_GAP = _LongGapRules()


def is_long_gap(gap_ns: int, step_ns: int) -> bool:
    """Whether so many frames are missing that similar patches are no evidence of the same points.

    Args:
        gap_ns: time since the last frame.
        step_ns: time between that one and the one before it.
    """
    return gap_ns > max(_LONG_GAP.min_s * 1e9, _LONG_GAP.min_steps * step_ns)


def motion_after_gap(
    problem: RansacProblem,
    images: FrameImages,
    previous: PreviousFrame,
    expected: FloatArray,
    prior: TrackPrior | None,
) -> FloatArray | None:
    """Return the camera's motion (4, 4) `T_curr_prev` since the last good pair, by key points of
    both pairs; None: none is proved.

    A facade repeats itself at the same depth; a gyro that contradicts tells.

    Args:
        problem: camera, inlier threshold for key points, and random generator.
        images: of this frame.
        previous: the last good pair.
        expected: motion (4, 4) by the last one.
        prior: usable prior, or None.
    """
    if images.right is None or previous.right_half is None:
        return None
    starts = np.stack([expected, np.eye(4)])
    T = motion_across(problem, images.stereo, previous, images.left, images.right, starts)
    if T is None or (prior is not None and contradicts_gyro(T, prior.motion)):
        return None
    return T


def contradicts_gyro(T_curr_prev: FloatArray, predicted: MotionPrior | None) -> bool:
    """Whether the rotation of a motion (4, 4) is not the one that a motion sensor has measured,
    where there is one.
    """
    if predicted is None or not predicted.measured:
        return False
    phi = so3_log(T_curr_prev[:3, :3] @ predicted.T_curr_prev[:3, :3].T)
    covariance = predicted.covariance[3:, 3:] + np.radians(_AGAIN.rotation_sigma_deg) ** 2 * np.eye(
        3
    )
    return bool(
        phi @ np.linalg.solve(covariance, phi) > chi_square_quantile(_AGAIN.rotation_probability, 3)
    )


def motion_across(
    problem: RansacProblem,
    stereo: StereoFit,
    previous: PreviousFrame,
    left: ImageLevels,
    right: ImageLevels,
    starts: FloatArray,
) -> FloatArray | None:
    """Return the camera's motion (4, 4) `T_curr_prev` since the last good pair; None: none is
    proved.

    Args:
        problem: camera, inlier threshold for key points, and random generator.
        stereo: finds the disparities of both pairs.
        previous: the last good pair.
        left: the present left image.
        right: the present right image.
        starts: motions (S, 4, 4) to try, beside those of minimal sets of points.
    """
    from vio.frontend.keypoints import MutualNearest, sift_extractor

    assert previous.right_half is not None
    camera = problem.camera
    before, now = sift_extractor(MatchSettings())(previous.left.full, left.full)
    pairs = MutualNearest()(before, now, np.ones((len(before), len(now)), dtype=np.bool_))
    a = before.pixels[pairs[:, 0]]
    b = now.pixels[pairs[:, 1]]
    d_before, known = stereo.search(previous.left.half, previous.right_half, a)
    known &= d_before > 0.0
    a = a[known]
    b = b[known]
    d_before = d_before[known]
    if len(a) < _AGAIN.min_points:
        return None
    f_baseline = camera.fu * camera.baseline_m
    points = left_rays(camera, a) * (f_baseline / d_before)[:, None]
    T, agree = best_motion(problem, points, b, starts)
    if agree.sum() < max(_AGAIN.min_points, _AGAIN.min_share * len(agree)):
        return None
    d_now, known = stereo.search(left.half, right.half, b[agree])
    depth = depth_of(camera, transform_points(T, points[agree]))
    same = np.abs(d_now - f_baseline / np.maximum(depth, 1e-3)) <= _AGAIN.disparity_px
    if known.sum() < _AGAIN.min_points or share_of(same[known]) < _AGAIN.min_depths_share:
        return None
    return T
