"""Single stereo pairs: SIFT matches, relative pose by RANSAC, and bundle adjustment of the rig
over all pairs.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import pycolmap

from vio.calibration.stereo import RayMatches
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import HALF_PX
from vio.offline.colmap import SEED, SIFT_FEATURES
from vio.offline.colmap.adjustment import adjustment_config, solve, solver_options
from vio.offline.colmap.model import (
    LEFT,
    RIG,
    RIGHT,
    add_frame,
    frame_id,
    image_id,
    numbered_images,
    pinhole,
    pose_rows,
    rig_model,
    without_scale,
)
from vio.records import BoolArray, Image


class _PairRules(NamedTuple):
    """Which matches of two images agree."""

    max_ratio: float = 0.8  # of the distances to the best and the second best descriptor
    virtual_px: float = 500.0  # focal length of the camera that projects rays to pixels
    essential_px: float = 1.0


_PAIRS = _PairRules()
# required by COLMAP; without effect
_VIRTUAL_SIZE = (round(2 * _PAIRS.virtual_px), round(2 * _PAIRS.virtual_px))
_VIRTUAL_PARAMS = (_PAIRS.virtual_px, _PAIRS.virtual_px, 0.0, 0.0)


def sift_matches(left: Image, right: Image) -> tuple[FloatArray, FloatArray]:
    """Return pixels (N, 2) and (N, 2) of mutual best SIFT matches of two images (H, W), including
    outliers.

    By OpenCV: a quarter of the time of COLMAP's, and rows of rectified pairs spread by a fifth
    less.
    """
    sift = cv2.SIFT_create(SIFT_FEATURES, enable_precise_upscale=True)  # type: ignore[attr-defined] # not in the stubs
    (keys0, features0), (keys1, features1) = (
        sift.detectAndCompute(image, None) for image in (left, right)
    )
    if len(keys0) < 2 or len(keys1) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    norm0 = np.sum(features0**2, axis=1)
    norm1 = np.sum(features1**2, axis=1)
    distance = norm0[:, None] + norm1[None, :] - 2 * features0 @ features1.T
    best1 = np.argmin(distance, axis=1)
    best0 = np.argmin(distance, axis=0)
    two = np.partition(distance, 1, axis=1)[:, :2]
    mutual = best0[best1] == np.arange(len(keys0))
    distinct = two[:, 0] < _PAIRS.max_ratio**2 * two[:, 1]
    good = mutual & distinct
    uv0, uv1 = (np.array([key.pt for key in keys], dtype=np.float64) for keys in (keys0, keys1))
    return uv0[good], uv1[best1[good]]


def relative_pose(matches: RayMatches) -> tuple[FloatArray, FloatArray] | None:
    """Estimate `R_cam1_cam0` (3, 3) and the unit direction (3,) of cam1 in cam0, by RANSAC over all
    matches.

    None: no consensus.
    """
    pixels = _virtual_pixels(matches)
    camera = pinhole(LEFT, _VIRTUAL_SIZE, _VIRTUAL_PARAMS)
    options = pycolmap.RANSACOptions(
        max_error=_PAIRS.essential_px,
        random_seed=SEED,
        min_num_trials=200,
        max_num_trials=2000,
        num_threads=1,
    )
    found = pycolmap.estimate_essential_matrix(*pixels, camera, camera, options)
    if found is None:
        return None
    return without_scale(pose_rows(found["cam2_from_cam1"]))


def adjust_rig(
    matches: RayMatches, R_cam1_cam0: FloatArray, direction: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Bundle-adjust the pose of cam1 in a rig over the matches (inliers) of all pairs; same form as
    the input.

    Each pair is a frame of one rig with its own points. Only the rig's extrinsics and the points
    are free; the result is without scale, which two cameras do not determine.

    Raises:
        EstimationError: the solver failed.
    """
    rig = pycolmap.Rigid3d(pycolmap.Rotation3d(R_cam1_cam0), -R_cam1_cam0 @ direction)
    model = rig_model(_VIRTUAL_SIZE, _VIRTUAL_PARAMS, rig)
    points, valid = _two_view_points(matches, R_cam1_cam0, direction)
    matches = matches.take(valid)
    points = points[valid]
    names, pair = np.unique(matches.pair, return_inverse=True)
    left, right = _virtual_pixels(matches)
    order = np.argsort(pair, kind="stable")
    for k in range(len(names)):
        rows = order[pair[order] == k]
        add_frame(
            model,
            k,
            np.eye(4),
            numbered_images(len(names)),
            left[rows] - HALF_PX,
            right[rows] - HALF_PX,
        )
        for at, row in enumerate(rows.tolist()):
            track = pycolmap.Track(
                [
                    pycolmap.TrackElement(image_id(k, LEFT), at),
                    pycolmap.TrackElement(image_id(k, RIGHT), at),
                ]
            )
            model.add_point3D(points[row], track, np.zeros(3, dtype=np.uint8))
    config = adjustment_config(model)
    for k in range(len(names)):
        config.set_constant_rig_from_world_pose(frame_id(k))
    options = solver_options(0.5, 1)
    options.refine_sensor_from_rig = True
    options.refine_rig_from_world = False
    solve(pycolmap.create_default_bundle_adjuster(options, config, model))
    return without_scale(pose_rows(model.rig(RIG).sensor_from_rig(model.camera(RIGHT).sensor_id)))


def _virtual_pixels(matches: RayMatches) -> tuple[FloatArray, FloatArray]:
    """Return COLMAP's pixels (N, 2) of the rays of both cameras in pinhole cameras without
    distortion.
    """
    left, right = (
        _PAIRS.virtual_px * ray[:, :2] / ray[:, 2:] for ray in (matches.ray0, matches.ray1)
    )
    return left, right


def _two_view_points(
    matches: RayMatches, R_cam1_cam0: FloatArray, direction: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return points (N, 3) in cam0, in units of the baseline, nearest to both rays, and a mask
    of those ahead.
    """
    a = matches.ray0
    b = matches.ray1 @ R_cam1_cam0
    cosine = np.sum(a * b, axis=1)
    along_a = a @ direction
    along_b = b @ direction
    sine2 = 1 - cosine**2
    valid = sine2 > 1e-6
    safe = np.where(valid, sine2, 1.0)
    s = (along_a - cosine * along_b) / safe
    t = (cosine * along_a - along_b) / safe
    valid &= (s > 0.5) & (t > 0.5)
    points = (s[:, None] * a + direction + t[:, None] * b) / 2
    return points, valid
