"""Objects that move on their own and cover much of the image, by the features' columns.

The motion of the camera between two frames is that of points of the frame before, in which they have
right pixels, to their left pixels in this one. Two large groups of points that move differently are
told apart as in the front end `klt` (`vio.frontend.moving_object`): by the prediction of a sensor, by
the points that have been static for long, or not at all, which makes the estimates unusable.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.findings import Finder
from vio.frontend.frames import usable_prior
from vio.frontend.moving_object import MovedPoints
from vio.frontend.outliers import (
    Consensus,
    RansacProblem,
    epipolar_distance,
    pixel_errors,
    predicted_motion,
    rigid_consensus,
)
from vio.frontend.prediction import prior_pixels
from vio.frontend.scene_motion import SceneMotion
from vio.frontend.stereo_match import EpipolarRowModel
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, se3_log
from vio.geometry.stereo import StereoCamera, triangulate
from vio.numerics.robust import median
from vio.records import BoolArray, IntArray, Observations, TrackPrior, shared_rows


@dataclass(frozen=True, slots=True)
class _ObjectRules:
    """How features of any front end are compared with a motion."""

    limit_px: float = 1.5  # of a static point, at least …
    limit_ratio: float = 3.0  # … and over the usual median of all points' errors
    usual_gain: float = 0.1  # how fast that is learned
    max_usual_px: float = 5.0  # beyond which it is not believed
    min_frames: int = 5  # that it was learned from
    wrong_ratio: float = 4.0  # of the limit: a feature beyond is none of that point
    seed: int = 0  # of the consensus


_OBJECTS = _ObjectRules()
_NO_IDS: IntArray = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class _Shared:
    """The features that two frames share."""

    rows: IntArray  # (K,) in the frame
    before: FloatArray  # (K, 4) pixels [ul vl ur vr] in the frame before
    left: FloatArray  # (K, 2) left pixels in the frame
    point: FloatArray  # (K, 3) metres, cam0 in the frame before; arbitrary without a depth
    has_depth: BoolArray  # (K,)
    age: IntArray  # (K,) frames for which each was static


class ObjectMatches(Finder):
    """Removes the features of an object that covers much of the image."""

    def __init__(self, camera: StereoCamera) -> None:
        super().__init__()
        self._camera = camera
        width = camera.width or round(2.0 * camera.cu)
        height = camera.height or round(2.0 * camera.cv)
        self._near_m = camera.fu * camera.baseline_m / width
        self._rows = EpipolarRowModel(width, height)
        self._scene = SceneMotion()
        self._before: Observations | None = None
        self._age = _NO_IDS  # (N,) of the features of the frame before
        self._moving = _NO_IDS  # ids that were found on an object that is still there
        self._twist_per_s = np.zeros(6)
        self._usual_px = 0.0
        self._frames = 0  # that were learned from

    def inspect(self, seen: Observations, prior: TrackPrior | None) -> Observations:
        """Return the features of a frame that may be of the scene.

        Args:
            seen: of the frame, after the checks of right matches.
            prior: what the filter expects; None: nothing.
        """
        before = self._before
        self._before = seen
        age = self._age
        self._age = np.zeros(len(seen), dtype=np.int64)
        if self._camera.kind == "mono" or before is None:
            return seen
        matched = seen.has_right
        self._rows.update(seen.z[matched, :2], seen.z[matched, 2:])
        shared = self._shared(before, seen, age)
        dropped = self._dropped(seen, before, shared, usable_prior(prior))
        self._found += self._scene.take_findings()
        self._age[shared.rows] = shared.age + 1
        if not (dropped.any() or len(self._moving)):
            return seen
        self._age[dropped] = 0
        dropped |= np.isin(seen.ids, self._moving)
        self._moving = (
            np.union1d(self._moving, seen.ids[dropped]) if self._scene.active else _NO_IDS
        )
        return seen.take(~dropped)

    def _shared(self, before: Observations, seen: Observations, age: IntArray) -> _Shared:
        old, new = shared_rows(before.ids, seen.ids)
        fresh = ~(before.stale[old] | seen.stale[new])
        old = old[fresh]
        new = new[fresh]
        z = before.z[old]
        point, valid = triangulate(self._camera, z)
        return _Shared(new, z, seen.z[new, :2], point, valid & before.has_right[old], age[old])

    def _dropped(
        self,
        seen: Observations,
        before: Observations,
        shared: _Shared,
        prior: TrackPrior | None,
    ) -> BoolArray:
        """Which features of a frame (N,) an object has, or an object that hides the scene."""
        dropped = np.zeros(len(seen), dtype=np.bool_)
        deep = shared.has_depth
        points = MovedPoints(shared.point[deep], shared.left[deep], shared.age[deep])
        limit_px = max(_OBJECTS.limit_px, _OBJECTS.limit_ratio * self._usual_px)
        rng = np.random.default_rng((_OBJECTS.seed, seen.frame_index))
        problem = RansacProblem(self._camera, limit_px, rng)
        seconds = (seen.time_ns - before.time_ns) * 1e-9
        found = self._consensus(problem, points, seen.ids[shared.rows[deep]], prior, seconds)
        if found is None:
            return dropped
        if self._frames < _OBJECTS.min_frames:
            self._twist_per_s = se3_log(found.T_curr_prev) / seconds
            self._learn(points, found)
            return dropped
        chosen = self._scene.choose(
            seen.frame_index,
            problem,
            points,
            found,
            prior,
            self._rows.disparity_error_px(self._camera.fu),
        )
        self._twist_per_s = se3_log(chosen.motion.T_curr_prev) / seconds
        if chosen.hidden:
            dropped[:] = True
        elif chosen.object_share > 0.0:
            dropped[shared.rows] = ~self._static(problem, shared, chosen.motion)
        else:
            errors_px = self._learn(points, found)
            dropped[shared.rows[deep]] = errors_px > _OBJECTS.wrong_ratio * limit_px
            self._keep_of_other_depth(dropped, seen, shared, found, limit_px)
        return dropped

    def _keep_of_other_depth(
        self,
        dropped: BoolArray,
        seen: Observations,
        shared: _Shared,
        found: Consensus,
        limit_px: float,
    ) -> None:
        """Keep the features that only their depth in the frame before contradicts: by the depth that
        they have in this one, else at any depth, they fit the motion.

        Args:
            dropped: (N,) of a frame; changed.
            seen: of the frame.
            shared: of it and the frame before.
            found: the motion between them.
            limit_px: how far off the motion a feature may be.
        """
        rows = np.flatnonzero(dropped[shared.rows])
        if not len(rows):
            return
        T = found.T_curr_prev
        left_before = shared.before[rows, :2]
        off_px = epipolar_distance(self._camera, T, left_before, shared.left[rows], self._near_m)
        now = shared.rows[rows]
        points, valid = triangulate(self._camera, seen.z[now])
        deep = valid & seen.has_right[now]
        back = se3_inverse(T)
        off_px[deep] = pixel_errors(self._camera, back, points[deep], left_before[deep])
        dropped[now[off_px <= limit_px]] = False

    def _consensus(
        self,
        problem: RansacProblem,
        points: MovedPoints,
        ids: IntArray,
        prior: TrackPrior | None,
        seconds: float,
    ) -> Consensus | None:
        """The motion of most points, whose ids (N,) a prior may contain."""
        expected = se3_exp(self._twist_per_s * seconds)
        if prior is None:
            return rigid_consensus(problem, points.p_prev, points.pixels, expected, None, None)
        named, pixels = prior_pixels(ids, prior)
        T_prior = predicted_motion(self._camera, points.p_prev[named], pixels, expected)
        return rigid_consensus(
            problem, points.p_prev, points.pixels, expected, prior.R_cam_prev, T_prior
        )

    def _learn(self, points: MovedPoints, found: Consensus) -> FloatArray:
        """Learn how far features usually are from one motion; return how far (N,) these are, px."""
        errors = pixel_errors(self._camera, found.T_curr_prev, points.p_prev, points.pixels)
        median_px = min(median(errors), _OBJECTS.max_usual_px)
        self._frames += 1
        gain = max(_OBJECTS.usual_gain, 1.0 / self._frames)
        self._usual_px += gain * (median_px - self._usual_px)
        return errors

    def _static(self, problem: RansacProblem, shared: _Shared, motion: Consensus) -> BoolArray:
        """Which features (K,) follow the camera's motion, by their depths or at any depth."""
        static = np.ones(len(shared.rows), dtype=np.bool_)
        static[shared.has_depth] = motion.inliers
        flat = ~shared.has_depth
        distance = epipolar_distance(
            self._camera,
            motion.T_curr_prev,
            shared.before[flat, :2],
            shared.left[flat],
            self._near_m,
        )
        static[flat] = distance <= problem.limit_px
        return static
