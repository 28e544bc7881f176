"""New features: how many corners are detected, which of them become features and are output, and
where the right image shows features without a match.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.frontend.align import rounded
from vio.frontend.columns import changed, joined, take
from vio.frontend.detect import detect_corners
from vio.frontend.frame_images import FrameImages
from vio.frontend.outliers import Consensus
from vio.frontend.patches import ImageLevels, inside
from vio.frontend.right_images import RightImages
from vio.frontend.settings import GridSettings
from vio.frontend.tracks import AnchorBank, Tracks, new_tracks
from vio.geometry.lie import FloatArray, transform_points
from vio.geometry.stereo import StereoCamera, depth_of, left_rays, project
from vio.protocols import Detector
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
    # extra corners tried, over the number of missing features; the best stereo matches are kept
    spare_corners: float = 1.5
    # share of the features; detection takes more time than it is worth for fewer
    few_missing_share: float = 0.1


class _OutputRules(NamedTuple):
    """When new features are output."""

    # for which a new corner must be tracked, in time and stereo, before it is output
    probation_frames: int = 1
    very_few_share: float = 0.25  # share of the target below which new features are output at once


_NEW = _NewRules()
_OUTPUT = _OutputRules()


class NewFeatures:
    """Detect corners, search right matches for them and for features without one, and add the best
    corners as new features.
    """

    def __init__(
        self,
        camera: StereoCamera,
        grid: GridSettings,
        bank: AnchorBank,
        right: RightImages,
        detector: Detector | None = None,
    ) -> None:
        """Prepare; the bank receives the new features' anchors.

        `right` says whether right images may be used, and a `detector` finds corners in place of
        the built-in one.
        """
        self._camera = camera
        self._grid = grid
        self._bank = bank
        self._right = right
        self._detector = detector
        self._next_id = 0
        self._rested = False  # whether the last frame was one in which no corners were detected

    def detect(self, images: FrameImages, tracks: Tracks) -> FloatArray:
        """Return corners (K, 2) for new features beside those of a frame, best first."""
        wanted = self._wanted_corners(len(tracks))
        left = images.left
        occupied = tracks.left
        if self._detector is None:
            return detect_corners(left.half, occupied, wanted, self._grid, images.allowed)
        from vio.frontend.given_corners import given_corners

        return given_corners(
            self._detector, left.full, occupied, wanted, self._grid, images.allowed
        )

    def _wanted_corners(self, active: int) -> int:
        """Number of corners to detect beside active features; none in every other frame while
        few are missing.
        """
        target = self._grid.target_features
        missing = target - active
        self._rested = not self._rested and missing <= _NEW.few_missing_share * target
        if self._rested:
            return 0
        return round(missing * (1.0 + _NEW.spare_corners))

    def add(
        self,
        images: FrameImages,
        tracks: Tracks,
        corners: FloatArray,
        motion: Consensus | None,
    ) -> Tracks:
        """Return the features of a frame with right matches where they lacked one, and with new
        features at corners (K, 2).

        While right images are of another time, a corner is matched once two frames have seen it.

        Args:
            images: of this frame.
            tracks: its features.
            corners: left pixels, best first.
            motion: consensus motion since the previous frame, if there is one.
        """
        right = images.right if self._right.usable else None
        # Without a second camera no corner is searched along the row either: all are taken without
        # a depth.
        delayed = images.right is None or self._right.delayed
        left = images.left.full
        tracks, disparity_new, unique = self._search_right(
            images, right, tracks, corners, motion, delayed
        )
        if not len(corners):
            return tracks
        stays = self._stay_visible(corners, disparity_new, motion, left)
        chosen, with_depth = self._select_corners(tracks, unique, stays, delayed)
        centres = rounded(corners[chosen])
        new = new_tracks(centres, self._bank.add(left, centres))
        if right is not None:
            new = images.stereo.match_near(
                new, right, np.arange(with_depth), disparity_new[chosen[:with_depth]]
            )
        new = changed(new, left_only_frames=np.where(new.has_right, 0, 1))
        room = max(0, self._grid.target_features - len(tracks))
        good = (new.has_right | (len(chosen) > with_depth)).nonzero()[0]
        matched_first = (~new.has_right[good]).argsort(kind="stable")
        return joined(tracks, take(new, good[matched_first][:room]))

    def output(self, tracks: Tracks) -> Tracks:
        """Output features that passed their probation from now on, under new ids; all features
        if these are few.
        """
        proven = tracks.has_right | (not self._right.needed)
        proven = tracks.shown | ((tracks.age >= _OUTPUT.probation_frames) & proven)
        if proven.sum() < _OUTPUT.very_few_share * self._grid.target_features:
            proven[:] = True
        ids = tracks.ids.copy()
        first = proven & ~tracks.shown
        ids[first] = np.arange(int(first.sum())) + self._next_id
        self._next_id += int(first.sum())
        return changed(tracks, ids=ids, shown=proven)

    def _search_right(
        self,
        images: FrameImages,
        right: ImageLevels | None,
        tracks: Tracks,
        corners: FloatArray,
        motion: Consensus | None,
        delayed: bool,
    ) -> tuple[Tracks, FloatArray, BoolArray]:
        """Search features without a right match and corners (K, 2) along the row of the right
        image.

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
        stereo = images.stereo
        disparity, unique = stereo.search(
            images.left.half, right.half, np.concatenate([tracks.left[rows], corners])
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
        safe = np.where(ahead[:, None], moved, [0.0, 0.0, 1.0])
        pixels = project(self._camera, safe)[:, :2]
        return np.asarray(ahead & inside(image, pixels, 0.0))
