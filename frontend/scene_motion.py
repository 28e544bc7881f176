"""Which points of a frame are of the scene, where an object that moves on its own covers much of the
image: the decision of `moving_object` and its report, for front ends and for the checks of features
that come from elsewhere.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vio.dataclass import dataclass
from vio.findings import Finding
from vio.frontend.moving_object import (
    TwoMotions,
    choose_motion,
    one_motion_explains,
    voters,
    without_young_object,
)
from vio.frontend.object_report import ObjectReport
from vio.frontend.outliers import Consensus, RansacProblem
from vio.geometry.lie import FloatArray
from vio.records import BoolArray, IntArray, TrackPrior


@dataclass(frozen=True, slots=True)
class MovedPoints:
    """Points of known depth, and where the current frame shows them."""

    p_prev: FloatArray  # (N, 3) triangulated in the previous frame, metres, previous cam0 frame
    pixels: FloatArray  # (N, 2) left pixels in the current frame
    age: IntArray  # (N,) frames for which each has been static

    def __len__(self) -> int:
        return len(self.p_prev)


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


class SceneMotion:
    """Chooses the camera's motion in each frame, and reports objects."""

    def __init__(self) -> None:
        self._report = ObjectReport()

    @property
    def active(self) -> bool:
        """Whether an object was seen in some of the last frames."""
        return self._report.active

    def take_findings(self) -> tuple[Finding, ...]:
        """Return the findings since the last call."""
        return self._report.take_findings()

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
        voting = voters(points.age)
        chosen = choose_motion(
            problem,
            points.p_prev,
            points.pixels,
            found,
            expected,
            voting=voting,
            in_event=self._report.active,
            disparity_error_px=disparity_error_px,
        )
        if self._is_one_motion(problem, chosen, points, disparity_error_px):
            chosen = replace(chosen, object_share=0.0)
        if chosen.decision is None and expected is not None and measured is None:
            chosen = self._report.questioned(
                chosen, problem.camera, points.p_prev, expected, voting, disparity_error_px
            )
        slow = None
        event = self._report.since
        if event is not None and chosen.object_share == 0.0:
            old = points.age > index - event
            young = without_young_object(problem, points.p_prev, points.pixels, chosen.motion, old)
            if young is not None:
                slow = chosen.motion.inliers & ~young.motion.inliers
                chosen = young
        self._report.frame(index, chosen)
        hidden = self._report.hides_scene(index, chosen) and measured is None
        return SceneChoice(chosen.motion, chosen.object_share, hidden, slow)

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
