"""Features of the last good pair, followed in the right images alone while the left camera gives
nothing new.

Neither the records nor the filters have views of the right camera alone, so each is moved into the
left image by the disparity that is predicted for it: by the filter's point, else by the motion. The
residual at the filter's prediction is then that of the right pixel; the Jacobian differs by that of
the disparity, a few percent of it. Only features whose depth the last pair has measured are
followed, and no new ones are found.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vio.dataclass import dataclass
from vio.frontend.align import ITERATIONS, MIN_CORRELATION, align, on_peak
from vio.frontend.columns import take
from vio.frontend.flow import track_with_retries
from vio.frontend.frame_images import FrameImages
from vio.frontend.one_camera import with_prior_depths
from vio.frontend.outliers import RansacProblem, pixel_errors, rigid_consensus
from vio.frontend.patches import ImageLevels
from vio.frontend.prediction import moved_pixels
from vio.frontend.stereo_fit import StereoFit
from vio.frontend.tracks import AnchorBank, PreviousFrame, Tracks, no_tracks
from vio.geometry.lie import (
    FloatArray,
    se3_exp,
    se3_from_parts,
    se3_inverse,
    se3_log,
    transform_points,
)
from vio.geometry.stereo import StereoCamera, depth_of
from vio.records import BoolArray, Image, TrackPrior

_MIN_POINTS = 20  # a few features that have slipped together would pass for a motion


class RightFollower:
    """Follows the features of the last good pair while the left camera is frozen."""

    def __init__(self, bank: AnchorBank, levels: int) -> None:
        """Prepare; the bank has the features' anchors, and `levels` are those of tracking."""
        self._bank = bank
        self._levels = levels
        self._alone: RightAlone | None = None

    @property
    def active(self) -> bool:
        """Whether the last frame was followed so."""
        return self._alone is not None

    def end(self) -> None:
        """Begin anew with the next pair."""
        self._alone = None

    def follow(
        self,
        images: FrameImages,
        previous: PreviousFrame,
        problem: RansacProblem,
        prior: TrackPrior | None,
    ) -> Tracks:
        """Return the features of the last good pair by the right image of a frame, at left
        pixels.
        """
        if images.right is None:
            return no_tracks()
        last = self._alone or RightAlone.after(problem.camera, previous)
        alone = last.next(
            images.frame.time_ns, problem, self._bank, images.right, prior, self._levels
        )
        if alone is None:
            return no_tracks()
        self._alone = alone
        return alone.in_left(problem.camera, images.stereo)


@dataclass(frozen=True, slots=True)
class RightAlone:
    """The last right image, and the features as if the right camera were the left one."""

    time_ns: int
    half: Image  # (H/2, W/2)
    tracks: Tracks
    twist_per_s: FloatArray  # (6,) of the right camera

    @classmethod
    def after(cls, camera: StereoCamera, previous: PreviousFrame) -> RightAlone:
        """Begin with what the right camera saw in the last good pair."""
        assert previous.right_half is not None
        tracks = take(
            previous.tracks,
            previous.tracks.has_right & previous.tracks.has_point & previous.tracks.shown,
        )
        warp = tracks.warp.copy()
        warp[:, :, :2] += tracks.skew
        to_right = se3_from_parts(np.eye(3), np.array([-camera.baseline_m, 0.0, 0.0]))
        moved = se3_log(to_right @ se3_exp(previous.twist_per_s) @ se3_inverse(to_right))
        tracks = replace(
            tracks, left=tracks.right, point=transform_points(to_right, tracks.point), warp=warp
        )
        return cls(previous.time_ns, previous.right_half, tracks, moved)

    def next(
        self,
        time_ns: int,
        problem: RansacProblem,
        bank: AnchorBank,
        right: ImageLevels,
        prior: TrackPrior | None,
        levels: int,
    ) -> RightAlone | None:
        """Follow the features in the next right image.

        None: no motion of the camera explains what is found.
        """
        old = self.tracks
        camera = problem.camera
        step_s = (time_ns - self.time_ns) * 1e-9
        expected = se3_exp(self.twist_per_s * step_s)
        if prior is not None and prior.R_cam_prev is not None:
            expected = se3_from_parts(prior.R_cam_prev, expected[:3, 3])
        guess = moved_pixels(camera, expected, old.point, old.left)
        found, seen = track_with_retries(self.half, right, old.left, guess, True, levels)
        motion = rigid_consensus(problem, old.point[seen], found[seen], expected, None, None)
        if motion is None:
            return None
        T = motion.T_curr_prev
        rows = np.flatnonzero(seen)[motion.inliers]
        warp = old.warp[rows]
        start = found[rows]
        point = transform_points(T, old.point[rows])
        warp[:, :, :2] *= (depth_of(camera, old.point[rows]) / depth_of(camera, point))[
            :, None, None
        ]
        warp[:, :, 2] = start
        warp, score = align(bank.store, old.slot[rows], right.full, warp, ITERATIONS)
        good: BoolArray = (score >= MIN_CORRELATION) & on_peak(warp[:, :, 2], start)
        errors_px = pixel_errors(camera, T, old.point[rows], warp[:, :, 2])
        good &= errors_px <= problem.limit_px
        if good.sum() < _MIN_POINTS:
            return None
        tracks = replace(take(old, rows), left=warp[:, :, 2].copy(), point=point, warp=warp)
        tracks = with_prior_depths(camera, take(tracks, good), prior)
        return RightAlone(time_ns, right.half, tracks, se3_log(T) / step_s)

    def in_left(self, camera: StereoCamera, stereo: StereoFit) -> Tracks:
        """The features at the left pixels that their right ones and their predicted disparities
        give.
        """
        tracks = self.tracks
        disparity = camera.fu * camera.baseline_m / depth_of(camera, tracks.point)
        left = tracks.left + np.stack([disparity, np.zeros(len(tracks))], axis=1)
        left[:, 1] -= stereo.row_differences(left)
        return replace(
            tracks, left=left, right=tracks.left, has_right=np.zeros(len(tracks), dtype=np.bool_)
        )
