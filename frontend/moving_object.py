"""Which of two motions is the camera's, where an object that moves on its own covers much of the
image.

The larger consensus wins RANSAC, and that may be the object's. The prediction of a motion sensor
decides: each motion is tested by chi-square against the predicted one, with the covariance of the
prediction and that of the fit; where both fail, the one that is clearly nearer is used. With an
IMU that is known to millimetres and the test decides nearly always. Otherwise the points vote that
have been static for longest: what has come into view just now cannot outvote them. Where they are
few or at odds, the prediction is that of a body that goes on as before, and where both motions are
possible the larger consensus is used, and it is said.

A stereo calibration that is off makes two groups of a static scene, too: its depths are wrong by
their size, and so is a prediction that no sensor has measured. Where the rows show such a
calibration, both are believed as far as disparities can be off, and a group that the camera's
motion explains at depths within that is no object.

A consensus far off the prediction, further than those of the frames before, that none of the older
points supports, is either the rig's, after a shock, or that of an object that hides the scene.
Nothing tells which: it is used, and reported at once.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from vio.dataclass import dataclass
from vio.findings import Finder, Finding
from vio.frontend.columns import share_of
from vio.frontend.outliers import (
    Consensus,
    RansacProblem,
    bearing_consensus,
    best_motion,
    pixel_errors,
)
from vio.geometry.lie import FloatArray, circledot, se3_inverse, se3_log, transform_points
from vio.geometry.stereo import StereoCamera, depth_of, left_rays, project, z_D_p_cam
from vio.numerics.statistics import chi_square_quantile
from vio.records import BoolArray, IntArray, MotionPrior

Decision: TypeAlias = Literal["predicted", "voted", "undecided", "unsupported"]


class _AgreementRules(NamedTuple):
    """When a motion agrees with a measured one."""

    probability: float = 0.9999  # of a motion that agrees with the prediction to pass the test
    # ratio of two motions' squared distances from a measured one, above which the nearer agrees
    nearer_ratio: float = 10.0
    bound_sigmas: float = 3.0  # of the bound of the disparities' error
    pixel_sigma_px: float = 0.5  # of a point's position by its depth and its track
    # errors of neighbours have much in common: a fit is no better than that of so many points
    independent_points: int = 50
    # share of a consensus without depths that a measured motion must explain
    min_static_share: float = 0.8
    far_m: float = 1e4  # depth of what is infinitely far away
    # of the length of a fitted translation: depths of one frame have errors in common
    scale_sigma: float = 0.01


_AGREEMENT = _AgreementRules()
_LIMIT = float(chi_square_quantile(_AGREEMENT.probability, 6))  # of its squared distance


class _SecondMotion(NamedTuple):
    """When a second motion counts."""

    min_points: int = 12  # of a second motion
    # points of a second motion that may replace the first, over the first's
    min_support_share: float = 0.1
    large_share: float = 0.25  # share of all points above which a second motion is reported
    # of the smaller group's points that no depth within the disparities' error explains: an object
    seen_share: float = 0.5


_SECOND = _SecondMotion()


class _VoteRules(NamedTuple):
    """How points that were static for long vote."""

    # errors of points of the scene over the median of those that are static for long: of 1000 one more
    following_ratio: float = 3.2
    voters: int = 50  # how many points vote, and for how many frames each must have been static
    static_frames: int = 5
    clear_share: float = 0.7  # share of the voting points that must follow a motion


_VOTE = _VoteRules()


class _EventRules(NamedTuple):
    """When an object is reported, and hides the scene."""

    reported_frames: int = 5  # in a row before an object is reported
    known_frames: int = 2  # in a row before an object is known, and may hide the scene
    # of the points that the scene has, during an event, below which the object hides it …
    hidden_share: float = 0.1
    hidden_frames: int = 3  # … in so many frames in a row
    clear_frames: int = 20  # without one before the next is another event


_EVENT = _EventRules()


@dataclass(frozen=True, slots=True)
class TwoMotions:
    """The camera's motion, and that of the other large group of points if there is one."""

    motion: Consensus
    object_share: float  # share of the points that follow another motion; 0: no large group does
    decision: Decision | None  # what chose between the two; None: there is one motion only


def choose_motion(
    problem: RansacProblem,
    p_prev: FloatArray,
    pixels: FloatArray,
    found: Consensus,
    predicted: MotionPrior | None,
    *,
    voting: BoolArray | None = None,
    in_event: bool = False,
    disparity_error_px: float = 0.0,
) -> TwoMotions:
    """Choose between the consensus motion and that of its outliers.

    Args:
        problem: camera, thresholds and random generator.
        p_prev: points (N, 3) triangulated in the previous frame, metres, previous cam0 frame.
        pixels: left pixels (N, 2) of the same points in the current frame.
        found: the consensus over them.
        predicted: the motion that the filter expects, with its covariance; None: it expects
            nothing.
        voting: (N,) which points have been static for long; None: none.
        in_event: whether an object has been seen in the frames before. It may hide all but a few
            points of the scene, and then the prediction is taken in place of a consensus that
            contradicts it.
        disparity_error_px: bound of the error of the disparities that the points are triangulated
            from, pixels. Where it is not 0, no motion explains all of a static scene, and a
            prediction that is not measured is off with the depths.
    """
    measured = predicted is not None and predicted.measured
    expected = (
        None if predicted is None else _Expected(problem.camera, predicted, disparity_error_px)
    )
    if voting is not None and not measured:
        voted = _voted(problem, p_prev, pixels, found, voting)
        if voted is not None and not _prediction_overrules(p_prev, found, voted, expected):
            return TwoMotions(voted, _if_large((found.inliers & ~voted.inliers).mean()), "voted")
    others = np.flatnonzero(~found.inliers)
    least = max(_SECOND.min_points, _SECOND.min_support_share * found.inliers.sum())
    of_first = np.inf
    is_far = expected is not None and expected.is_beyond(found.T_curr_prev, _LIMIT)
    if expected is not None and (len(others) >= least or in_event or is_far):
        of_first = expected.distance(found.T_curr_prev, p_prev[found.inliers])
    contradicted = is_far and of_first > _LIMIT
    if expected is not None and measured and contradicted and voting is not None:
        slow = _without_slow_object(problem, p_prev, pixels, found, expected, voting)
        if slow is not None:
            return TwoMotions(slow, _if_large((found.inliers & ~slow.inliers).mean()), "predicted")
    if len(others) < least and not (in_event or contradicted):
        return TwoMotions(found, 0.0, None)
    second = np.eye(4)
    support = np.zeros(len(others), dtype=np.bool_)
    if len(others) >= least:
        starts = np.stack([np.eye(4) if predicted is None else predicted.T_curr_prev, np.eye(4)])
        second, support = best_motion(problem, p_prev[others], pixels[others], starts)
    large = bool(support.sum() >= least)
    reported = _if_large(support.sum() / len(p_prev)) if large else 0.0
    # the prediction is that of a body that goes on as before
    if expected is not None and contradicted and not measured:
        near = _near_prediction(problem, p_prev, pixels, found, expected)
        if near is not None:
            second = near.T_curr_prev
            support = near.inliers[others]
            large = True
    follows_second = (
        _followers(problem, second, p_prev, pixels)
        if large
        else np.zeros(len(p_prev), dtype=np.bool_)
    )
    if large and not measured and voting is not None:
        elected = _elected(found.inliers[voting], follows_second[voting])
        if elected == "second":
            object_share = _if_large((found.inliers & ~follows_second).mean())
            return TwoMotions(Consensus(second, follows_second), object_share, "voted")
        if elected == "first":
            return TwoMotions(found, reported, "voted" if reported else None)
    if predicted is None or expected is None:
        return TwoMotions(found, reported, "undecided" if reported else None)
    if not (large or in_event):
        return TwoMotions(found, 0.0, None)
    of_second = expected.distance(second, p_prev[others[support]]) if large else np.inf
    nearer, farther = sorted((of_first, of_second))
    limit = _LIMIT
    if measured and large and nearer * _AGREEMENT.nearer_ratio <= farther:
        # the sensor is worse than its covariance, but leaves no doubt which one it is
        limit = max(limit, nearer)
    first_agrees = of_first <= limit
    second_agrees = of_second <= limit
    if not (second_agrees or in_event or reported):
        return TwoMotions(found, 0.0, None)  # whether the first agrees or not
    if first_agrees or not (second_agrees or in_event):
        return TwoMotions(
            found, reported, "predicted" if first_agrees and not second_agrees else "undecided"
        )
    if not second_agrees:
        second = predicted.T_curr_prev
        follows_second = _followers(problem, predicted.T_curr_prev, p_prev, pixels)
    return TwoMotions(
        Consensus(second, follows_second), _if_large(share_of(found.inliers)), "predicted"
    )


def _prediction_overrules(
    p_prev: FloatArray, found: Consensus, voted: Consensus, expected: _Expected | None
) -> bool:
    """Return whether a prediction agrees with the consensus, and better than with the vote.

    The oldest points may all be far away: what they vote for is a rotation, and a translation that
    they hardly know. An object that comes into view has no prediction on its side.
    """
    if expected is None or found.inliers.sum() < voted.inliers.sum():
        return False
    of_found, of_voted = (
        expected.distance(each.T_curr_prev, p_prev[each.inliers]) for each in (found, voted)
    )
    return of_found <= min(of_voted, _LIMIT)


def _if_large(share: float) -> float:
    """The share of an object that is reported; 0 for a small one."""
    return float(share) if share >= _SECOND.large_share else 0.0


def _followers(
    problem: RansacProblem, T: FloatArray, p_prev: FloatArray, pixels: FloatArray
) -> BoolArray:
    """Mask (N,) of the points whose pixels a motion (4, 4) explains."""
    return np.asarray(pixel_errors(problem.camera, T, p_prev, pixels) <= problem.limit_px)


def _near_prediction(
    problem: RansacProblem,
    p_prev: FloatArray,
    pixels: FloatArray,
    found: Consensus,
    expected: _Expected,
) -> Consensus | None:
    """The motion near a predicted one that the consensus contradicts, if some points follow this
    one alone.

    A compromise between an object and what is far away can win the consensus, and leaves no second
    group.
    """
    start = expected.prior.T_curr_prev
    near = pixel_errors(problem.camera, start, p_prev, pixels) <= 2.0 * problem.limit_px
    if near.sum() < _SECOND.min_points:
        return None
    T, _ = best_motion(problem, p_prev[near], pixels[near], start[None])
    inliers = _followers(problem, T, p_prev, pixels)
    alone = inliers & ~found.inliers
    others = found.inliers & ~inliers
    if alone.sum() < max(_SECOND.min_points, _SECOND.min_support_share * others.sum()):
        return None
    return Consensus(T, inliers) if expected.distance(T, p_prev[inliers]) <= _LIMIT else None


def _without_slow_object(
    problem: RansacProblem,
    p_prev: FloatArray,
    pixels: FloatArray,
    found: Consensus,
    expected: _Expected,
    voting: BoolArray,
) -> Consensus | None:
    """The motion of the points that have been static for long, and those that follow it as well as
    they do, if it agrees with a predicted one that the consensus contradicts.

    What moves by less than the limit of an outlier in a frame is part of the consensus, and drags
    it along.
    """
    old = voting & found.inliers
    if old.sum() < _SECOND.min_points:
        return None
    T, _ = best_motion(problem, p_prev[old], pixels[old], expected.prior.T_curr_prev[None])
    errors = pixel_errors(problem.camera, T, p_prev, pixels)
    usual_px = _VOTE.following_ratio * float(np.median(errors[old]))
    follows = np.asarray(errors <= min(usual_px, problem.limit_px))
    moving = found.inliers & ~follows
    # old points that do not follow: the scene is no better known than what came into view
    if moving.sum() < max(_SECOND.min_points, _SECOND.large_share * len(p_prev)):
        return None
    if (moving & voting).sum() > (1.0 - _VOTE.clear_share) * voting.sum():
        return None
    return Consensus(T, follows) if expected.distance(T, p_prev[old]) <= _LIMIT else None


def _elected(first: BoolArray, second: BoolArray) -> Literal["first", "second"] | None:
    """Which of two motions most of the voting points follow, of those (N,) that only one of them
    explains.

    What is far away follows both, if they turn alike, and does not vote.
    """
    for_first = int((first & ~second).sum())
    for_second = int((second & ~first).sum())
    if max(for_first, for_second) < max(
        _SECOND.min_points, _VOTE.clear_share * (for_first + for_second)
    ):
        return None
    return "first" if for_first > for_second else "second"


def _votes_for(found: Consensus, voting: BoolArray) -> bool:
    """Whether most of the voting points (N,) follow a motion."""
    return bool(
        voting.sum() >= _SECOND.min_points and found.inliers[voting].mean() >= _VOTE.clear_share
    )


def _voted(
    problem: RansacProblem,
    p_prev: FloatArray,
    pixels: FloatArray,
    found: Consensus,
    voting: BoolArray,
) -> Consensus | None:
    """Return the motion that most of the voting points (N,) follow, where the consensus is not
    theirs; else None.
    """
    if voting.sum() < _SECOND.min_points or _votes_for(found, voting):
        return None
    starts = np.stack([found.T_curr_prev, np.eye(4)])
    T, follows = best_motion(problem, p_prev[voting], pixels[voting], starts)
    if follows.mean() < _VOTE.clear_share:
        return None
    inliers = _followers(problem, T, p_prev, pixels)
    # the oldest points may all be far away
    T, _ = best_motion(problem, p_prev[inliers], pixels[inliers], T[None])
    return Consensus(T, _followers(problem, T, p_prev, pixels))


def static_by_prediction(
    problem: RansacProblem,
    before: FloatArray,
    after: FloatArray,
    kept: BoolArray,
    predicted: MotionPrior,
    near_m: float,
) -> BoolArray:
    """Which points of unknown depth (N,) are static, if those that one motion explains contradict
    the predicted one.

    An object ahead of a turning camera keeps its place in the image; to move sideways explains it
    as well.

    Args:
        problem: camera, thresholds and random generator.
        before: left pixels (N, 2) in the previous frame.
        after: left pixels (N, 2) in the current frame.
        kept: (N,) those that one motion explains.
        predicted: the motion by a sensor.
        near_m: the smallest depth.
    """
    static = _agree_with(problem.camera, predicted, before, after, near_m, problem.limit_px)
    if static.sum() < _SECOND.min_points or share_of(static[kept]) >= _AGREEMENT.min_static_share:
        return kept
    return static


def _agree_with(
    camera: StereoCamera,
    predicted: MotionPrior,
    before: FloatArray,
    after: FloatArray,
    near_m: float,
    sigma_px: float,
) -> BoolArray:
    """Which of some points of unknown depth may be static under a predicted motion, by chi-square.

    Each is taken at the depth, beyond `near_m`, at which the motion brings it nearest to where it
    is seen.

    Args:
        camera: the rectified pair.
        predicted: the motion.
        before: left pixels (N, 2) in the previous frame.
        after: left pixels (N, 2) in the current frame.
        near_m: the smallest depth.
        sigma_px: standard deviation of a pixel.
    """
    T = predicted.T_curr_prev
    turned = left_rays(camera, before) @ T[:3, :3].T
    seen = left_rays(camera, after)
    # g x (R f + t / z) = 0
    across = np.cross(seen, T[:3, 3])
    off = np.cross(seen, turned)
    inverse = -np.sum(across * off, axis=1) / (np.sum(across * across, axis=1) + 1e-12)
    p = turned / np.clip(inverse, 1.0 / _AGREEMENT.far_m, 1.0 / near_m)[:, None] + T[:3, 3]
    ahead = depth_of(camera, p) > 0.0
    p[~ahead] = [0.0, 0.0, 1.0]
    J = _pixel_D_motion(camera, p)
    S = J @ predicted.covariance @ J.transpose(0, 2, 1) + sigma_px**2 * np.eye(2)
    d = after - project(camera, p)[:, :2]
    squared = np.sum(d * np.linalg.solve(S, d[..., None])[..., 0], axis=1)
    return np.asarray(ahead & (squared <= float(chi_square_quantile(_AGREEMENT.probability, 1))))


def one_motion_explains(
    problem: RansacProblem,
    chosen: TwoMotions,
    p_prev: FloatArray,
    pixels: FloatArray,
    disparity_error_px: float,
) -> bool:
    """Return whether the camera's motion explains the second group of points too, at depths of
    their own that disparities with an error allow.

    Args:
        problem: camera, thresholds and random generator.
        chosen: the motions by the points' depths.
        p_prev: points (N, 3) triangulated in the previous frame, metres, previous cam0 frame.
        pixels: left pixels (N, 2) of the same points in the current frame.
        disparity_error_px: bound of the error of the disparities, pixels.
    """
    if chosen.object_share == 0.0 or chosen.decision == "unsupported":
        return False
    motion = chosen.motion
    before = project(problem.camera, p_prev)[:, :2]
    static = bearing_consensus(problem, before, pixels, motion.T_curr_prev[:3, :3], None)
    if static is None:
        return False
    off = ~static | ~_within_depths(problem, motion.T_curr_prev, p_prev, pixels, disparity_error_px)
    # of the groups: the larger one is fitted
    smaller = min(chosen.object_share, share_of(motion.inliers))
    return float(off.mean()) < _SECOND.seen_share * smaller


def _within_depths(
    problem: RansacProblem,
    T: FloatArray,
    p_prev: FloatArray,
    pixels: FloatArray,
    disparity_error_px: float,
) -> BoolArray:
    """Which points (N, 3) a motion (4, 4) moves to left pixels (N, 2), along their epipolar lines,
    at a depth that disparities with an error allow.
    """
    camera = problem.camera
    constant = camera.fu * camera.baseline_m
    disparity = constant / depth_of(camera, p_prev)
    # A yaw moves them by more beside the middle, (R1). Twice: those that the motion was fitted to
    # are off, too.
    aside = p_prev[:, 0] / p_prev[:, 2]
    span = 2.0 * disparity_error_px * (1.0 + aside * aside)
    ends = []
    for off in (-span, span):
        changed = np.maximum(disparity + off, constant / _AGREEMENT.far_m)
        p = transform_points(T, p_prev * (disparity / changed)[:, None])
        ahead = depth_of(camera, p) > 0.0
        p[~ahead] = [0.0, 0.0, 1.0]
        ends.append(project(camera, p)[:, :2])
    start, end = ends
    along = end - start
    length = np.linalg.norm(along, axis=1) + 1e-12
    place_px = np.sum((pixels - start) * along, axis=1) / length
    limit = problem.limit_px
    return np.asarray((place_px >= -limit) & (place_px <= length + limit))


@dataclass(frozen=True, slots=True)
class _Expected:
    """A predicted motion, and what fits to points are off by beside it."""

    camera: StereoCamera
    prior: MotionPrior
    disparity_error_px: float  # see `choose_motion`

    def distance(self, T: FloatArray, p_prev: FloatArray) -> float:
        """Squared distance of a motion (4, 4), fitted to points (N, 3), from the prediction, over
        their covariance.
        """
        p = transform_points(T, p_prev)
        J = _pixel_D_motion(self.camera, p).reshape(-1, 6)
        points = min(len(p), _AGREEMENT.independent_points)
        fit = _AGREEMENT.pixel_sigma_px**2 * np.linalg.inv(
            points * J.T @ J / len(p) + 1e-9 * np.eye(6)
        )
        moved_m2 = float(T[:3, 3] @ T[:3, 3])
        fit[:3, :3] += _AGREEMENT.scale_sigma**2 * moved_m2 * np.eye(3)
        if self.disparity_error_px > 0.0:
            # a translation is off as its depths are; one that no sensor has measured is, too
            depth = float(np.median(depth_of(self.camera, p_prev)))
            f_baseline = self.camera.fu * self.camera.baseline_m
            scale = self.disparity_error_px / _AGREEMENT.bound_sigmas * depth / f_baseline
            if not self.prior.measured:
                t = self.prior.T_curr_prev[:3, 3]
                moved_m2 += float(t @ t)
            fit[:3, :3] += scale**2 * moved_m2 * np.eye(3)
        return self._distance(T, self.prior.covariance + fit)

    def is_beyond(self, T: FloatArray, limit: float) -> bool:
        """Whether a motion (4, 4) is further off than a limit over the prediction's covariance
        alone: that of a fit to points is added only if it is.
        """
        return self._distance(T, self.prior.covariance) > limit

    def _distance(self, T: FloatArray, covariance: FloatArray) -> float:
        xi = se3_log(T @ se3_inverse(self.prior.T_curr_prev))
        return float(xi @ np.linalg.solve(covariance, xi))


def _pixel_D_motion(camera: StereoCamera, p: FloatArray) -> FloatArray:
    """Jacobian (N, 2, 6) of the left pixels of points (N, 3) by the camera's motion,
    `[rho; phi]`.
    """
    J: FloatArray = z_D_p_cam(camera, p)[:, :2] @ circledot(p)[:, :3]
    return J


def voters(age: IntArray) -> BoolArray:
    """Which points (N,), static for some frames (N,), have a vote: the oldest of those that are not
    new.

    What has come into view, and moves slowly enough to pass for static, is younger than what was
    there before.
    """
    oldest = (
        np.partition(age, len(age) - _VOTE.voters)[len(age) - _VOTE.voters]
        if len(age) > _VOTE.voters
        else 0
    )
    return np.asarray(age >= max(oldest, _VOTE.static_frames))


class ObjectReport(Finder):
    """Reports once per event that an object covers much of the image, and what decided which
    motion is the camera's.
    """

    def __init__(self) -> None:
        super().__init__()
        # squared distances from the prediction of motions that older points support
        self._usual = deque[float](maxlen=_EVENT.clear_frames)
        self._frames = 0  # with an object, in a row
        self._since = 0  # the first of them
        self._clear = 0  # without one, in a row
        self._hidden = 0  # that an object hides, in a row
        self._reported: str | None = None  # code of the event that goes on
        self._hidden_reported = False
        self._active = False

    @property
    def active(self) -> bool:
        """Whether the prediction has distinguished an object from the scene in some of the last
        frames.
        """
        return self._active

    def questioned(
        self,
        motions: TwoMotions,
        camera: StereoCamera,
        p_prev: FloatArray,
        predicted: MotionPrior,
        voting: BoolArray,
        disparity_error_px: float,
    ) -> TwoMotions:
        """Return the motions of a frame, as unsupported ones where the camera's is far off an
        extrapolated prediction, and no older point supports it.

        Arguments as of `choose_motion`; the camera's motion is the only one.
        """
        motion = motions.motion
        expected = _Expected(camera, predicted, disparity_error_px)
        supported = int((motion.inliers & voting).sum()) >= _SECOND.min_points
        limit = _LIMIT if supported else _AGREEMENT.nearer_ratio * max([_LIMIT, *self._usual])
        distance = 0.0
        if expected.is_beyond(motion.T_curr_prev, limit):
            distance = expected.distance(motion.T_curr_prev, p_prev[motion.inliers])
        if supported:
            self._usual.append(distance)
        if supported or not self._usual or distance <= limit:
            return motions
        return replace(motions, object_share=share_of(motion.inliers), decision="unsupported")

    def hides_scene(self, index: int, motions: TwoMotions) -> bool:
        """Return whether a known object has left too few points of the scene for some frames, so
        that none is used.
        """
        hidden = self._active and float(motions.motion.inliers.mean()) < _EVENT.hidden_share
        self._hidden = self._hidden + 1 if hidden else 0
        if self._hidden >= _EVENT.hidden_frames and not self._hidden_reported:
            self._hidden_reported = True
            message = (
                f"frame {index}: fewer than {100 * _EVENT.hidden_share:.0f} % of the points are left of "
                "the scene: the object hides it, and no feature is used"
            )
            self._found.append(Finding("object-hides-scene", message, index, lasts=True))
        return self._hidden >= _EVENT.hidden_frames

    def frame(self, index: int, motions: TwoMotions) -> None:
        """Take the motions of a frame."""
        if motions.object_share == 0.0:
            self._no_object(index)
            return
        if self._frames == 0:
            self._since = index
        self._frames = self._frames + 1
        self._clear = 0
        if motions.decision == "unsupported":
            self._report_unsupported(index, motions)
            return
        undecided = motions.decision == "undecided"
        self._active = self._active or (self._frames >= _EVENT.known_frames and not undecided)
        if self._frames >= _EVENT.reported_frames and self._reported is None:
            self._report(index, motions)

    def _no_object(self, index: int) -> None:
        self._frames = 0
        self._clear = self._clear + 1
        self._active = self._active and self._clear < _EVENT.reported_frames
        if self._reported is None or self._clear < _EVENT.clear_frames:
            return
        message = f"frame {index}: no object covers much of the image any more"
        self._found.append(Finding(self._reported, message, index, ended=True))
        if self._hidden_reported:
            self._found.append(Finding("object-hides-scene", message, index, ended=True))
        self._reported = None
        self._hidden_reported = False

    def _report_unsupported(self, index: int, motions: TwoMotions) -> None:
        if self._reported == "object-or-scene":
            return
        if self._reported is not None:
            self._found.append(
                Finding(self._reported, f"frame {index}: see below", index, ended=True)
            )
        self._reported = "object-or-scene"
        share = round(100 * motions.object_share)
        message = (
            f"frame {index}: {share} % of the points move as the rig did not before, and hardly "
            "one of them was seen before: the rig was pushed, or an object hides the scene; they "
            "are taken for the scene"
        )
        figures = {"object_share": motions.object_share}
        self._found.append(
            Finding("object-or-scene", message, index, index, lasts=True, figures=figures)
        )

    def _report(self, index: int, motions: TwoMotions) -> None:
        share = round(100 * motions.object_share)
        self._reported = "object-covers-image"
        by = "the points seen before" if motions.decision == "voted" else "its predicted motion"
        message = (
            f"frame {index}: {share} % of the points move together, but not as the camera does by "
            f"{by}: an object that moves on its own covers much of the image; its points are left "
            "out"
        )
        if motions.decision == "undecided":
            self._reported = "object-or-scene"
            rest = round(100 * float(motions.motion.inliers.mean()))
            message = (
                f"frame {index}: two groups of points move differently, {rest} % and {share} % of "
                "all: an object that moves on its own covers much of the image, and the predicted "
                "motion does not tell which group it is; the larger one is taken for the scene"
            )
        figures = {"object_share": motions.object_share}
        self._found.append(
            Finding(self._reported, message, index, self._since, lasts=True, figures=figures)
        )
