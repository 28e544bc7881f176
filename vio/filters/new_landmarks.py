"""Which points become landmarks of the state: those that are known best when their tracks leave the
window.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.cameras.rectification_error import CONSIDERED
from vio.filters.multiview import relative_stereo_sigma
from vio.filters.rig_calibration import RigCalibration
from vio.filters.stereo_calibration import StereoColumns
from vio.filters.window import Window
from vio.filters.window_fit import WindowFit
from vio.filters.window_tracks import LinearTracks
from vio.geometry.lie import FloatArray, so3_hat, transform_points
from vio.records import BoolArray, IntArray


class _LandmarkRules(NamedTuple):
    """How well a point must be known."""

    # Standard deviations of a point's inverse depth over itself, at most. A landmark is
    # linearised and marginalised frame by frame as a Cartesian point, which biases scale in
    # second order of it where the depth comes from motion. With left images and an IMU, position
    # NEES after 2 s is 24 of 3 at 0.2, 15 at 0.05, 6 at 0.02, 2.8 at 0.01, 2.5 without any.
    depth_sigma: float = 0.01  # by all views
    stereo_sigma: float = 0.1  # or by the right views alone, which know the scale
    # Standard deviation of the baseline over it, and that of a point's stereo depth by the
    # rectification, over it, at most: while the scale is open, the same bias falls on the
    # baseline, and on the field. With a prior of 5 % and a baseline that is off by 9.5 %, 15 s of
    # a flight with an IMU end at 4.07 +- 0.03 % with landmarks from the start, at 9.02 +- 0.29 %
    # without any. Where no right image gives depths any more, the bias is the lesser evil: on
    # MH_01 36 such frames by images alone cost 86 mm without landmarks, 4 mm with them.
    scale_sigma: float = 0.001


_RULES = _LandmarkRules()


class NewLandmarks:
    """Makes landmarks of the points of tracks."""

    def __init__(self, rig: RigCalibration, fit: WindowFit, most: int) -> None:
        """Prepare; `most`: of the landmarks in the state."""
        self._rig = rig
        self._fit = fit
        self._most = most

    def promote(
        self,
        window: Window,
        tracks: LinearTracks,
        columns: StereoColumns | None,
        candidates: BoolArray,
        depth_sigma: FloatArray,
        stereo: bool,
    ) -> IntArray:
        """Make landmarks of the best known points whose tracks leave the window; return which
        tracks (indices).

        Args:
            window: receives the landmarks.
            tracks: linearised at its means.
            columns: theirs of the coefficients estimated and of those considered; None: there are
                none.
            candidates: mask (F,) of the tracks that may become landmarks.
            depth_sigma: (F,) standard deviation of each inverse depth, over itself.
            stereo: whether this frame has right pixels, from which the next tracks will get their
                depths.
        """
        room = self._most - len(window.landmarks)
        unsure = _scale_sigma(window) > _RULES.scale_sigma
        if room <= 0 or unsure or not candidates.any():
            return np.zeros(0, dtype=np.int64)
        chosen = candidates.nonzero()[0]
        by_stereo = np.sqrt(self._fit.tracks.variance) * relative_stereo_sigma(
            tracks.at, tracks.information.q, chosen
        )
        chosen = chosen[
            (depth_sigma[chosen] < _RULES.depth_sigma) | (by_stereo < _RULES.stereo_sigma)
        ]
        field = self._rig.field(window)
        if field is not None:
            p = transform_points(window.T_cam0_world(-1)[0], tracks.p_world[chosen])
            of_field = window.prior.P[window.state.stereo, window.state.stereo]
            limit = _RULES.scale_sigma if stereo else _RULES.stereo_sigma
            chosen = chosen[field.depth_sigma(p, of_field) < limit]
        if not len(chosen):
            return chosen
        covariance = self._fit.variance * tracks.information.point_covariance(chosen)
        # The best known points first: smallest largest standard deviation.
        worst = np.linalg.eigvalsh(covariance)[:, 2]
        table = self._fit.tracks.table
        best = np.lexsort((table.ids(tracks.rows[chosen]), worst))[:room]
        chosen = chosen[best]
        covariance = covariance[best]
        p = tracks.p_world[chosen]
        point_D_poses = tracks.information.point_D_clones(chosen)
        point_D_poses[:, :, -3:] += so3_hat(p)  # the anchor: rotation of the newest exposure
        ids = table.ids(tracks.rows[chosen])
        point_D_stereo = None
        by_considered = None
        if columns is not None:
            estimated = window.state.stereo.stop - window.state.stereo.start
            point_D_terms = columns.point_D_stereo(tracks.information, chosen)
            point_D_stereo = point_D_terms[..., :estimated]
            if point_D_terms.shape[2] > estimated:
                by_considered = point_D_terms[..., estimated:].reshape(-1, CONSIDERED)
        A = window.state.jacobian(point_D_poses, point_D_stereo)
        window.add_landmarks(ids, p, A.reshape(-1, window.state.size), covariance, by_considered)
        return chosen


def _scale_sigma(window: Window) -> float:
    """The larger one of the standard deviations of baseline and focal length, over them; 0 where
    they are known.
    """
    if "stereo_scale" not in window.state.blocks:
        return 0.0
    variances = window.prior.P.diagonal()[window.state.blocks["stereo_scale"]]
    return float(np.sqrt(variances.max(initial=0.0)))
