"""Which tracked features are of the static scene: those that one motion of the camera explains."""

from __future__ import annotations

import numpy as np

from vio.findings import Finding
from vio.frontend.frame_images import FrameImages
from vio.frontend.moving_object import MovedPoints, static_by_prediction
from vio.frontend.outliers import (
    Consensus,
    MotionPriors,
    RansacProblem,
    epipolar_distance,
    predicted_motion,
    static_tracks,
)
from vio.frontend.prediction import prior_rows
from vio.frontend.right_images import RightImages
from vio.frontend.scene_motion import SceneMotion
from vio.frontend.tracks import Tracks
from vio.geometry.lie import FloatArray
from vio.records import BoolArray, TrackPrior


class StaticFeatures:
    """Selects the features that a motion of the camera explains, and reports objects that move."""

    def __init__(self, right: RightImages) -> None:
        """Prepare; `right` says whether depths need a right image."""
        self._right = right
        self._scene = SceneMotion()

    def take_findings(self) -> tuple[Finding, ...]:
        """Return what was found since the last call."""
        return self._scene.take_findings()

    def select(
        self,
        problem: RansacProblem,
        old: Tracks,
        found: FloatArray,
        seen: BoolArray,
        prior: TrackPrior | None,
        expected: FloatArray,
        images: FrameImages,
    ) -> tuple[BoolArray, Consensus | None, BoolArray | None]:
        """Return the mask (N,) of the found features that are static, the consensus motion if there
        is one, and the mask (N,) of those that are not to be followed further; None: all are.

        Args:
            problem: camera, thresholds and random generator.
            old: features of the previous frame.
            found: their left pixels (N, 2) in this one.
            seen: mask (N,) of those that were found.
            prior: usable prior, or None.
            expected: motion (4, 4) `T_curr_prev` by the last one.
            images: of this frame.
        """
        camera = problem.camera
        stereo = images.stereo
        slow: BoolArray | None = None
        rows = seen.nonzero()[0]
        has_depth = (old.has_point & (old.has_right | (not self._right.needed)))[rows]
        deep = has_depth.nonzero()[0]
        point = old.point.take(rows, axis=0)
        deep_point = old.point.take(rows[deep], axis=0)
        priors = MotionPriors()
        if prior is not None:
            known, predicted = prior_rows(old, rows[deep], prior)
            priors = MotionPriors(
                prior.R_cam_prev, predicted_motion(camera, old.point[known], predicted, expected)
            )
        before = old.left.take(rows, axis=0)
        after = found.take(rows, axis=0)
        kept, motion = static_tracks(problem, before, point, has_depth, after, expected, priors)
        near_m = camera.fu * camera.baseline_m / stereo.max_disparity_px
        measured = None if prior is None else prior.measured_motion
        if motion is None and measured is not None:
            kept = static_by_prediction(problem, before, after, kept, measured, near_m)
        if motion is not None:
            points = MovedPoints(deep_point, after.take(deep, axis=0), old.age[rows[deep]])
            chosen = self._scene.choose(
                images.frame.index, problem, points, motion, prior, stereo.disparity_error_px
            )
            if chosen.hidden:
                return np.zeros(len(old), dtype=np.bool_), None, None
            motion = chosen.motion
            kept[has_depth] = motion.inliers
            if chosen.slow is not None:
                slow = np.zeros(len(old), dtype=np.bool_)
                slow[rows[deep]] = chosen.slow
        if motion is not None and not has_depth.all():
            distance = epipolar_distance(
                camera, motion.T_curr_prev, before[~has_depth], after[~has_depth], near_m
            )
            kept[~has_depth] = distance <= problem.limit_px
        keep = np.zeros(len(old), dtype=np.bool_)
        keep[rows[kept]] = True
        return keep, motion, slow
