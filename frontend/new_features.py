"""New features: which corners become features, and where the right image shows features without
a match.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.frontend.align import rounded
from vio.frontend.columns import changed, joined, take
from vio.frontend.outliers import Consensus
from vio.frontend.patches import ImageLevels, inside
from vio.frontend.settings import GridSettings
from vio.frontend.stereo_fit import StereoFit
from vio.frontend.tracks import AnchorBank, Tracks, new_tracks
from vio.geometry.lie import FloatArray, transform_points
from vio.geometry.stereo import StereoCamera, depth_of, left_rays, project
from vio.records import BoolArray, Image, IntArray


class _NewRules(NamedTuple):
    """Which corners become features."""

    # share of the target below which corners that leave the image sooner are added, too
    min_features_share: float = 0.7
    wanted_life_frames: int = 7  # for which a new corner should stay in the image
    max_left_only_frames: int = 10  # in a row without a right match, before a feature is dropped
    # share of the least number of features below which corners without depth are added
    few_share: float = 0.5
    tried_factor: float = 1.5  # corners aligned per missing feature


_NEW = _NewRules()


class NewFeatures:
    """Search right matches for new corners and for features without one; add the best new
    corners.
    """

    def __init__(self, camera: StereoCamera, grid: GridSettings, bank: AnchorBank) -> None:
        """Prepare; the bank receives the new features' anchors."""
        self._camera = camera
        self._grid = grid
        self._bank = bank

    def add(
        self,
        left: ImageLevels,
        right: ImageLevels | None,
        tracks: Tracks,
        corners: FloatArray,
        motion: Consensus | None,
        stereo: StereoFit,
        *,
        delayed: bool,
    ) -> Tracks:
        """Return the features with right matches where they lacked one, and with new features at
        corners (K, 2).

        Args:
            left: left image.
            right: right image; None: it cannot be used.
            tracks: features of this frame.
            corners: left pixels, best first.
            motion: consensus motion since the previous frame, if there is one.
            stereo: the matcher.
            delayed: whether the right image is of another time: a corner is matched once two frames
                have seen it.
        """
        tracks, disparity_new, unique = self._search_right(
            left, right, tracks, corners, motion, stereo, delayed
        )
        if not len(corners):
            return tracks
        stays = self._stay_visible(corners, disparity_new, motion, left.full)
        chosen, with_depth = self._select_corners(tracks, unique, stays, delayed)
        centres = rounded(corners[chosen])
        new = new_tracks(centres, self._bank.add(left.full, centres))
        if right is not None:
            new = stereo.match_near(
                new, right, np.arange(with_depth), disparity_new[chosen[:with_depth]]
            )
        new = changed(new, left_only_frames=np.where(new.has_right, 0, 1))
        room = max(0, self._grid.target_features - len(tracks))
        good = (new.has_right | (len(chosen) > with_depth)).nonzero()[0]
        return joined(
            tracks, take(new, good[np.argsort(~new.has_right[good], kind="stable")][:room])
        )

    def _search_right(
        self,
        left: ImageLevels,
        right: ImageLevels | None,
        tracks: Tracks,
        corners: FloatArray,
        motion: Consensus | None,
        stereo: StereoFit,
        delayed: bool,
    ) -> tuple[Tracks, FloatArray, BoolArray]:
        """Search features without a right match and corners (K, 2) along the row.

        Returns:
            The features, without those that had no match for too long; disparities (K,) of the
            corners in pixels; a mask (K,) of the corners found. Where the right image cannot be
            used, nothing is searched or dropped.
        """
        nothing = np.zeros(len(corners)), np.zeros(len(corners), dtype=np.bool_)
        if right is None:
            return tracks, *nothing
        if delayed:
            return self._without_old_left_only(tracks), *nothing
        unmatched = ~tracks.has_right
        if motion is not None:
            # A feature with a known point that was not matched near it must not be matched
            # elsewhere.
            unmatched &= ~tracks.has_point
        rows = unmatched.nonzero()[0]
        if not len(rows) + len(corners):
            return self._without_old_left_only(tracks), *nothing
        disparity, unique = stereo.search(
            left.half, right.half, np.concatenate([tracks.left[rows], corners])
        )
        old = len(rows)
        known = unique[: len(rows)]
        tracks = stereo.match_near(tracks, right, rows[known], disparity[:old][known])
        return self._without_old_left_only(tracks), disparity[old:], unique[old:]

    def _without_old_left_only(self, tracks: Tracks) -> Tracks:
        """Count frames without a right match, and drop the features that had none for too long."""
        tracks = changed(
            tracks, left_only_frames=np.where(tracks.has_right, 0, tracks.left_only_frames + 1)
        )
        return take(tracks, tracks.left_only_frames <= _NEW.max_left_only_frames)

    def _select_corners(
        self, tracks: Tracks, unique: BoolArray, stays: BoolArray, delayed: bool
    ) -> tuple[IntArray, int]:
        """Return the rows of the corners (K,) to try, in this order, and how many of them have a
        depth.

        Corners with depth (`unique` in the coarse search) that will stay in the image come first.
        Corners that will soon leave it are tried only below the least number of matched features,
        corners without depth only below half of that number.
        """
        target = self._grid.target_features
        matched = int(tracks.has_right.sum())
        room = max(0, target - len(tracks))
        least = _NEW.min_features_share * target
        tried = round(_NEW.tried_factor * room)
        staying = (unique & stays).nonzero()[0][:tried]
        leaving = (unique & ~stays).nonzero()[0][:tried]
        leaving = leaving[
            : max(
                0, round(_NEW.tried_factor * (least - matched - len(staying) / _NEW.tried_factor))
            )
        ]
        no_depth = (~unique).nonzero()[0][:room]
        if matched > _NEW.few_share * least and not delayed:
            no_depth = no_depth[:0]
        return np.concatenate([staying, leaving, no_depth]), len(staying) + len(leaving)

    def _stay_visible(
        self, corners: FloatArray, disparity: FloatArray, motion: Consensus | None, image: Image
    ) -> BoolArray:
        """Mask (K,) of corners that stay in the image for a while if the camera motion
        continues.
        """
        if motion is None:
            return np.ones(len(corners), dtype=np.bool_)
        T = np.linalg.matrix_power(motion.T_curr_prev, _NEW.wanted_life_frames)
        depth = self._camera.fu * self._camera.baseline_m / np.maximum(disparity, 0.1)
        moved = transform_points(T, left_rays(self._camera, corners) * depth[:, None])
        ahead = depth_of(self._camera, moved) > 0.5
        pixels = project(self._camera, np.where(ahead[:, None], moved, [0.0, 0.0, 1.0]))[:, :2]
        return np.asarray(ahead & inside(image, pixels, 0.0))
