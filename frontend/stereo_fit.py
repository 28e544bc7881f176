"""Right pixels of features to a fraction of a pixel: their anchors, fitted into the right image near their row.

Where a feature has a depth, it is looked for at the disparity that follows; else where a search along the row
(`frontend.stereo_match`) finds it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from frontend.align import align, on_peak
from frontend.columns import take
from frontend.flow import as_bright, circle_gaps
from frontend.patches import View
from frontend.settings import DisparitySettings, KltSettings
from frontend.stereo_match import RowField, match_rows
from frontend.tracks import AnchorBank, Tracks
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera, triangulate
from vio.records import BoolArray, Image, IntArray

_ITERATIONS = 5
_MAX_STRETCH = 0.8  # change of disparity per pixel; the road under a car reaches about 0.4
_COARSE_SLACK = 0.2  # by how much the coarse stereo search may correlate worse than the fine fit
_MIN_DEPTH_M = 0.05


class StereoFit:
    """Find features in the right image, and learn meanwhile how far matched rows differ over the image."""

    def __init__(
        self,
        camera: StereoCamera,
        settings: KltSettings,
        disparity: DisparitySettings,
        bank: AnchorBank,
        size: tuple[int, int],
    ) -> None:
        """Prepare for images of one size, width and height; the bank holds the features' anchors."""
        self.max_disparity_px = disparity.max_disparity * size[0]
        self._min_disparity_px = disparity.min_disparity_px
        self._camera = camera
        self._settings = settings
        self._bank = bank
        self._rows = RowField(*size)

    def again(self, tracks: Tracks, right: View, last_half: Image, moved: bool) -> Tracks:
        """Find features of known depth; with a known motion (`moved`) the disparity must agree with it.

        Args:
            tracks: features at their new left pixels; right pixels are still those of the last frame.
            right: the right image.
            last_half: the last right image at half resolution.
            moved: whether the depths were moved along with the camera.
        """
        rows = np.flatnonzero(tracks.placed & (tracks.point[:, 2] > _MIN_DEPTH_M))
        deep = take(tracks, rows)
        expected = self._camera.fu * self._camera.baseline_m / deep.point[:, 2]
        place, skew, valid = self._fitted(deep, right, expected)
        if moved:
            valid &= np.abs(deep.left[:, 0] - place[:, 0] - expected) <= self._settings.consensus_px
        if self._settings.circle_check:
            valid &= self._closes_circle(deep, place, last_half, right)
        return self._taken_in(tracks, rows[valid], place[valid], skew[valid])

    def near(self, tracks: Tracks, right: View, rows: IntArray, disparity: FloatArray) -> Tracks:
        """Give the named rows (K,) right pixels near their disparities (K,), where they are found."""
        place, skew, valid = self._fitted(take(tracks, rows), right, disparity)
        return self._taken_in(tracks, rows[valid], place[valid], skew[valid])

    def search(self, left: View, right: View, points: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Coarse disparities (N,) of left pixels (N, 2), and a mask (N,) of those that are unique."""
        return self._search(left.half, right.half, points, self._settings.min_correlation - _COARSE_SLACK)

    def count_mirrored(self, left: View, right: View, points: FloatArray) -> int:
        """How many left pixels (N, 2) have a match with a negative disparity."""
        a, b = (np.ascontiguousarray(view.half[:, ::-1]) for view in (left, right))
        flipped = points * [-1.0, 1.0] + [2.0 * (a.shape[1] - 1), 0.0]
        disparity, unique = self._search(a, b, flipped, self._settings.min_correlation)
        return int((unique & (disparity >= 1.0)).sum())

    def learn_rows(self, tracks: Tracks) -> None:
        """Take in how far the rows of the matches of a frame differ."""
        self._rows.learn(tracks.left[tracks.has_right], tracks.right[tracks.has_right])

    def _search(
        self, left_half: Image, right_half: Image, points: FloatArray, min_correlation: float
    ) -> tuple[FloatArray, BoolArray]:
        margin = self._settings.min_peak_margin
        return match_rows(left_half, right_half, points, self.max_disparity_px, min_correlation, margin)

    def _fitted(self, tracks: Tracks, right: View, disparity: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Fit anchors into the right image near expected disparities (N,).

        Returns:
            Right pixels (N, 2), the change of the warp's linear part (N, 2, 2), and a mask (N,) of the good ones.
        """
        rows = self._rows.rows(tracks.left)
        warp = tracks.warp.copy()
        warp[:, :, :2] += tracks.skew
        warp[:, 0, 2] -= disparity
        warp[:, 1, 2] = rows
        start = warp[:, :, 2].copy()
        warp, score = align(self._bank.store, tracks.slot, right.full, warp, _ITERATIONS, rows)
        place, skew = warp[:, :, 2], warp[:, :, :2] - tracks.warp[:, :, :2]
        found = tracks.left[:, 0] - place[:, 0]
        valid = (
            (score >= self._settings.min_correlation)
            & on_peak(place, start)
            & (np.abs(skew).max(axis=(1, 2)) <= _MAX_STRETCH)
            & (np.abs(rows - place[:, 1]) <= self._settings.max_epipolar_px)
            & (found >= self._min_disparity_px)
            & (found <= self.max_disparity_px)
        )
        return place, skew, valid

    def _closes_circle(self, tracks: Tracks, place: FloatArray, last_half: Image, right: View) -> BoolArray:
        """Mask (N,) of right pixels (N, 2) that tracking in time from the last right image leads to as well.

        Features that had no right match in the last frame have no circle to close, and pass.
        """
        closes = tracks.blind > 0
        rows = np.flatnonzero(~closes)
        last = as_bright(last_half, right.half)
        gap = circle_gaps(last, right.half, tracks.right[rows], place[rows], self._settings)
        closes[rows] = gap <= self._settings.max_circle_px
        return closes

    def _taken_in(self, tracks: Tracks, rows: IntArray, place: FloatArray, skew: FloatArray) -> Tracks:
        """Give the named rows (K,) their right pixels (K, 2), their skews (K, 2, 2), and the depth that follows."""
        right, has_right, skews = tracks.right.copy(), tracks.has_right.copy(), tracks.skew.copy()
        right[rows], has_right[rows], skews[rows] = place, True, skew
        p_cam, valid = triangulate(self._camera, np.concatenate([tracks.left[rows], place], axis=1))
        point, placed = tracks.point.copy(), tracks.placed.copy()
        point[rows[valid]], placed[rows[valid]] = p_cam[valid], True
        return replace(tracks, right=right, has_right=has_right, skew=skews, point=point, placed=placed)
