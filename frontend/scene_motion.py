"""Which points of a frame are of the scene, where an object that moves on its own covers much of the
image: the decision of `moving_object` and its report, for front ends and for the checks of features
that come from elsewhere.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.findings import Finding
from vio.frontend.moving_object import (
    MIN_POINTS,
    MovedPoints,
    TwoMotions,
    choose_motion,
    one_motion_explains,
    voters,
    without_young_object,
)
from vio.frontend.object_report import ObjectReport
from vio.frontend.outliers import Consensus, RansacProblem
from vio.frontend.rig_in_view import RigInView
from vio.geometry.lie import FloatArray, transform_points
from vio.geometry.stereo import StereoCamera, depth_of, project
from vio.numerics.robust import median
from vio.records import BoolArray, TrackPrior


@dataclass(frozen=True, slots=True)
class SceneChoice:
    """What a frame shows of the scene."""

    motion: Consensus  # the camera's, over the points
    object_share: float  # share of the points that follow another motion; 0: no large group does
    hidden: bool  # an object has left too few points of the scene: none is to be used
    # (N,) points of an object that moves too slowly to be lost: they are not followed further
    slow: BoolArray | None = None

    @property
    def static(self) -> BoolArray:
        """Which points (N,) may be used."""
        if self.hidden:
            return np.zeros_like(self.motion.inliers)
        return self.motion.inliers


class _ViewRules(NamedTuple):
    """When what was in view is gone, and when it has been left behind."""

    # in a row, with fewer than so many points of the last frame that had them: a chain, as points
    # live for a few frames only in rain
    unseen_frames: int = 3
    min_seen: int = 4
    min_flow_px: float = 1.0  # of a motion that can be told from none
    extrapolated_frames: int = 10  # for which a motion goes on as it was, at most
    kept_share: float = 0.25  # of the points, that must still be in view by it to be missed
    # that points have been static for while an object was told from them, to be of the scene
    static_frames: int = 10
    # below which what was in view has left it: some of it is so far away that it stays
    left_share: float = 0.2


_VIEW = _ViewRules()


@dataclass(frozen=True, slots=True)
class _Scene:
    """The points of a frame, and the camera's motion."""

    index: int
    p_prev: FloatArray  # (N, 3) metres, cam0 frame of the frame before
    motion: Consensus

    def is_in_view(self, camera: StereoCamera, index: int) -> bool:
        """Whether a later frame should still show the scene's points, if the motion goes on."""
        frames = index - self.index
        if frames > _VIEW.extrapolated_frames:
            return False
        T = np.linalg.matrix_power(self.motion.T_curr_prev, frames + 1)
        p = transform_points(T, self.p_prev[self.motion.inliers])
        return _share_in_view(camera, p) > _VIEW.kept_share

    def goes_on(self, camera: StereoCamera, T: FloatArray, p_prev: FloatArray) -> bool:
        """Whether pixels of points (N, 3) move both by a motion (4, 4) and by that of the scene: what
        moves with the rig does not.
        """
        before = project(camera, p_prev)[:, :2]
        for motion in (self.motion.T_curr_prev, T):
            after = project(camera, transform_points(motion, p_prev))[:, :2]
            flow_px = np.linalg.norm(after - before, axis=1)
            if median(flow_px) <= _VIEW.min_flow_px:
                return False
        return True


class SceneMotion:
    """Chooses the camera's motion in each frame, and reports objects."""

    def __init__(self) -> None:
        self._report = ObjectReport()
        self._rig = RigInView()
        # (M, 3) current cam0 frame, metres: what was in view when the last points that are older
        # than an object were lost; None: there are such points
        self._view: FloatArray | None = None
        self._scene: _Scene | None = None  # the last frame that shows points of the one before it
        self._unseen = 0  # frames since then, in a row

    @property
    def active(self) -> bool:
        """Whether an object was seen in some of the last frames."""
        return self._report.active

    def take_findings(self) -> tuple[Finding, ...]:
        """Return the findings since the last call."""
        return self._report.take_findings() + self._rig.take_findings()

    def choose(
        self,
        index: int,
        problem: RansacProblem,
        points: MovedPoints,
        found: Consensus,
        prior: TrackPrior | None,
        disparity_error_px: float,
    ) -> SceneChoice:
        """Choose between the consensus of a frame and other motions.

        Args:
            index: frame number.
            problem: camera, thresholds and random generator.
            points: of known depth.
            found: the consensus over them.
            prior: what the filter expects; None: nothing.
            disparity_error_px: bound of the error of the points' disparities; see `choose_motion`.
        """
        expected = None if prior is None else prior.motion
        measured = None if prior is None else prior.measured_motion
        by_sensor = None if measured is None else measured.T_curr_prev
        is_lost = self._rig.is_lost(index, points, found)
        if is_lost and (self._scene is None or self._scene.is_in_view(problem.camera, index)):
            self._rig.replace(index, problem.camera)
        else:
            self._rig.see(index, problem, points, found, by_sensor)
        voting = voters(points.age)
        chosen = choose_motion(
            problem,
            points.p_prev,
            points.pixels,
            found,
            expected,
            voting=voting,
            in_event=self._report.active
            or (
                measured is not None
                and self._scene is not None
                and not self._goes_on(index, points, found)
            ),
            disparity_error_px=disparity_error_px,
        )
        if self._is_one_motion(problem, chosen, points, disparity_error_px):
            chosen = replace(chosen, object_share=0.0)
        if chosen.decision is None and expected is not None and measured is None:
            chosen = self._report.questioned(
                chosen, problem.camera, points.p_prev, expected, voting, disparity_error_px
            )
        slow = None
        is_apart = chosen.object_share > 0.0 and chosen.decision in ("predicted", "voted")
        self._see_scene(index, problem.camera, points, chosen, measured=measured is not None)
        event = self._report.since
        old = None if event is None else points.age > index - event
        if old is not None and chosen.object_share == 0.0:
            young = without_young_object(problem, points.p_prev, points.pixels, chosen.motion, old)
            if young is not None:
                slow = chosen.motion.inliers & ~young.motion.inliers
                chosen = young
        proven = measured is not None or old is None or _are_enough(chosen.motion.inliers & old)
        if proven:
            self._view = None
            if is_apart:
                self._report.prove(index - _VIEW.static_frames)
        else:
            proven = self._has_passed(index, problem.camera, points.p_prev, chosen)
        self._report.frame(index, chosen, proven=proven)
        hidden = self._report.hides_scene(index, chosen) and measured is None
        return SceneChoice(chosen.motion, chosen.object_share, hidden, slow)

    def _goes_on(self, index: int, points: MovedPoints, motion: Consensus) -> bool:
        """Whether points of the last frame of the scene follow a motion."""
        frames = 1 if self._scene is None else index - self._scene.index
        again = motion.inliers & (points.age >= frames)
        return int(again.sum()) >= _VIEW.min_seen

    def _see_scene(
        self,
        index: int,
        camera: StereoCamera,
        points: MovedPoints,
        chosen: TwoMotions,
        *,
        measured: bool,
    ) -> None:
        """Report that all points of the scene are gone that should still be in view, where no
        sensor measures the motion and no object was seen.
        """
        motion = chosen.motion
        if self._report.since is not None:
            self._scene = None
            return
        goes_on = self._goes_on(index, points, motion)
        if not goes_on and self._scene is not None:
            goes_on = self._scene.goes_on(camera, motion.T_curr_prev, points.p_prev)
        if goes_on:
            self._scene = _Scene(index, points.p_prev, motion)
            self._unseen = 0
            return
        self._unseen += 1
        scene = self._scene
        if scene is None or measured or self._unseen < _VIEW.unseen_frames:
            return
        self._scene = None
        if scene.is_in_view(camera, index):
            self._report.lost(index, scene.index)

    def _has_passed(
        self, index: int, camera: StereoCamera, p_prev: FloatArray, chosen: TwoMotions
    ) -> bool:
        """Whether all that was in view when the last older points were lost has left it since, by
        the motion relative to it: then it was of the scene, or is gone.
        """
        T = chosen.motion.T_curr_prev
        if self._view is None or chosen.decision == "unsupported":
            self._view = p_prev[chosen.motion.inliers]
        self._view = transform_points(T, self._view)
        if _share_in_view(camera, self._view) > _VIEW.left_share:
            return False
        self._report.prove(index)
        self._view = None
        return True

    def _is_one_motion(
        self,
        problem: RansacProblem,
        chosen: TwoMotions,
        points: MovedPoints,
        disparity_error_px: float,
    ) -> bool:
        """Whether wrong disparities alone make two groups of a static scene."""
        return disparity_error_px > 0.0 and one_motion_explains(
            problem, chosen, points.p_prev, points.pixels, disparity_error_px
        )


def _are_enough(rows: BoolArray) -> bool:
    """Whether a mask (N,) is of enough points to prove a motion."""
    return int(rows.sum()) >= MIN_POINTS


def _share_in_view(camera: StereoCamera, p: FloatArray) -> float:
    """Share of points (N, 3), cam0 frame, that the left image shows; 1 of none."""
    if len(p) == 0:
        return 1.0
    ahead = depth_of(camera, p) > 0.0
    u, v = project(camera, np.where(ahead[:, None], p, [0.0, 0.0, 1.0]))[:, :2].T
    width = camera.width or 2.0 * camera.cu
    height = camera.height or 2.0 * camera.cv
    inside = ahead & (u >= 0.0) & (u < width) & (v >= 0.0) & (v < height)
    return float(inside.mean())
