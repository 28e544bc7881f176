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

from functools import cached_property
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from vio.dataclass import dataclass
from vio.frontend.columns import share_of
from vio.frontend.expected_motion import (
    AGREEMENT_LIMIT,
    AGREEMENT_PROBABILITY,
    ExpectedMotion,
    pixel_D_motion,
)
from vio.frontend.outliers import (
    Consensus,
    RansacProblem,
    bearing_consensus,
    best_motion,
    pixel_errors,
)
from vio.geometry.lie import FloatArray, transform_points
from vio.geometry.stereo import StereoCamera, depth_of, left_rays, project
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import median, quantile
from vio.numerics.statistics import chi_square_quantile
from vio.records import BoolArray, IntArray, MotionPrior

Decision: TypeAlias = Literal["predicted", "voted", "undecided", "unsupported"]

# ratio of two motions' squared distances from a measured one, above which the nearer agrees
CLEARLY_NEARER = 10.0
MIN_POINTS = 12  # of a second motion
STATIC_FRAMES = 5  # that a voting point must have been static for


class _SecondMotion(NamedTuple):
    """When a second motion counts."""

    # points of a second motion that may replace the first, over the first's
    min_support_share: float = 0.1
    large_share: float = 0.25  # share of all points above which a second motion is reported
    # of the smaller group's points that no depth within the disparities' error explains: an object
    seen_share: float = 0.5


_SECOND = _SecondMotion()


class _AgreementRules(NamedTuple):
    """When a motion agrees with a measured one."""

    # share of a consensus without depths that a measured motion must explain
    min_static_share: float = 0.8
    far_m: Tolerance[float] = 1e4  # depth of what is infinitely far away


_AGREEMENT = _AgreementRules()


class _VoteRules(NamedTuple):
    """How points that were static for long vote."""

    # errors of points of the scene over the median of those that are static for long: of 1000 one
    # more
    following_ratio: float = 3.2
    voters: int = 50  # how many points vote
    clear_share: float = 0.7  # share of the voting points that must follow a motion


_VOTE = _VoteRules()
_TORN_SHARE = 0.9  # of the points of either part of a torn image that are on its side of the tear


@dataclass(frozen=True, slots=True)
class MovedPoints:
    """Points of known depth, and where the current frame shows them."""

    p_prev: FloatArray  # (N, 3) triangulated in the previous frame, metres, previous cam0 frame
    pixels: FloatArray  # (N, 2) left pixels in the current frame
    age: IntArray  # (N,) frames for which each has been static

    def __len__(self) -> int:
        return len(self.p_prev)


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
    expected = (
        None if predicted is None else ExpectedMotion(problem.camera, predicted, disparity_error_px)
    )
    case = _Case(problem, p_prev, pixels, found, expected, voting, in_event)
    chosen = _outvoted(case)
    if chosen is not None:
        return chosen
    first = _judged_first(case)
    chosen = _freed_of_slow_object(case, first)
    if chosen is not None:
        return chosen
    if len(case.others) < case.min_support and not (in_event or first.contradicted):
        return TwoMotions(found, 0.0, None)
    second = _second_motion(case, first)
    chosen = _of_one_exposure(case, first, second)
    if chosen is not None:
        return chosen
    chosen = _elected_motion(case, second)
    return _predicted_motion(case, first, second) if chosen is None else chosen


@dataclass(frozen=True)
class _Case:
    """What is known of a frame; arguments as of `choose_motion`."""

    problem: RansacProblem
    p_prev: FloatArray
    pixels: FloatArray
    found: Consensus
    expected: ExpectedMotion | None
    voting: BoolArray | None
    in_event: bool

    @property
    def prior(self) -> MotionPrior | None:
        """The predicted motion."""
        return None if self.expected is None else self.expected.prior

    @property
    def measured(self) -> bool:
        """Whether a sensor has measured the predicted motion."""
        return self.prior is not None and self.prior.measured

    @cached_property
    def others(self) -> IntArray:
        """Rows (K,) of the points that do not follow the consensus."""
        return (~self.found.inliers).nonzero()[0]

    @property
    def min_support(self) -> float:
        """Points that a second motion needs."""
        return float(max(MIN_POINTS, _SECOND.min_support_share * self.found.inliers.sum()))

    def followers(self, T: FloatArray) -> BoolArray:
        """Mask (N,) of the points whose pixels a motion (4, 4) explains."""
        return _followers(self.problem, T, self.p_prev, self.pixels)

    def without(self, kept: BoolArray) -> float:
        """The share of points that follow the consensus alone, where it is that of an object."""
        return _if_large((self.found.inliers & ~kept).mean())


@dataclass(frozen=True, slots=True)
class _First:
    """The consensus beside the prediction."""

    distance: float  # squared; infinite where it was not needed
    contradicted: bool  # the prediction, with its covariance and that of the fit, excludes it


@dataclass(frozen=True, slots=True)
class _Second:
    """The motion of a group that does not follow the consensus."""

    T: FloatArray  # (4, 4); arbitrary where there is no such group
    support: BoolArray  # (K,) of the points beside the consensus
    follows: BoolArray  # (N,) of all points; none where there is no group
    exists: bool
    object_share: float  # that is reported where the consensus is the camera's motion


def _outvoted(case: _Case) -> TwoMotions | None:
    """The motion of the points that have been static for long, where the consensus is not theirs
    and no sensor tells.
    """
    if case.voting is None or case.measured:
        return None
    voted = _voted(case.problem, case.p_prev, case.pixels, case.found, case.voting)
    if voted is None or _prediction_overrules(case.p_prev, case.found, voted, case.expected):
        return None
    return TwoMotions(voted, case.without(voted.inliers), "voted")


def _judged_first(case: _Case) -> _First:
    """Compare the consensus with the prediction, where a decision may need it."""
    found = case.found
    expected = case.expected
    if expected is None:
        return _First(np.inf, contradicted=False)
    is_far = expected.is_beyond(found.T_curr_prev, AGREEMENT_LIMIT)
    distance = np.inf
    if len(case.others) >= case.min_support or case.in_event or is_far:
        distance = expected.distance(found.T_curr_prev, case.p_prev[found.inliers])
    return _First(distance, contradicted=is_far and distance > AGREEMENT_LIMIT)


def _freed_of_slow_object(case: _Case, first: _First) -> TwoMotions | None:
    """The measured motion's own points, where a slow object has dragged the consensus off it."""
    if not (first.contradicted and case.measured):
        return None
    if case.expected is None or case.voting is None:
        return None
    slow = _without_slow_object(
        case.problem, case.p_prev, case.pixels, case.found, case.expected, case.voting
    )
    if slow is None:
        return None
    return TwoMotions(slow, case.without(slow.inliers), "predicted")


def _second_motion(case: _Case, first: _First) -> _Second:
    """The motion of the outliers, or the one near a prediction that the consensus contradicts."""
    others = case.others
    T = np.eye(4)
    support = np.zeros(len(others), dtype=np.bool_)
    if len(others) >= case.min_support:
        prior = case.prior
        starts = np.stack([np.eye(4) if prior is None else prior.T_curr_prev, np.eye(4)])
        T, support = best_motion(case.problem, case.p_prev[others], case.pixels[others], starts)
    exists = bool(support.sum() >= case.min_support)
    object_share = 0.0
    if exists:
        object_share = _if_large(support.sum() / len(case.p_prev))
    # the prediction is that of a body that goes on as before
    if case.expected is not None and first.contradicted and not case.measured:
        near = _near_prediction(case.problem, case.p_prev, case.pixels, case.found, case.expected)
        if near is not None:
            T = near.T_curr_prev
            support = near.inliers[others]
            exists = True
    if exists:
        follows = case.followers(T)
    else:
        follows = np.zeros(len(case.p_prev), dtype=np.bool_)
    return _Second(T, support, follows, exists, object_share)


def _of_one_exposure(case: _Case, first: _First, second: _Second) -> TwoMotions | None:
    """The second motion where an image is torn: the consensus is that of rows of another exposure,
    and the other rows go on as predicted.

    Points of the scene are older in either part, and the prediction may allow a stop.
    """
    if not second.exists or case.expected is None:
        return None
    found = case.found.inliers
    rows = case.pixels[:, 1]
    if not _lie_apart(rows[found & ~second.follows], rows[second.follows & ~found]):
        return None
    distance = case.expected.distance(second.T, case.p_prev[case.others[second.support]])
    if distance > AGREEMENT_LIMIT or distance * CLEARLY_NEARER > first.distance:
        return None
    motion = Consensus(second.T, second.follows)
    return TwoMotions(motion, case.without(second.follows), "predicted")


def _lie_apart(rows: FloatArray, other: FloatArray) -> bool:
    """Whether nearly all rows (N,) of some pixels are above, or below, those (M,) of others."""
    if min(len(rows), len(other)) < MIN_POINTS:
        return False
    share = _TORN_SHARE
    low, high = (quantile(rows, part) for part in (1.0 - share, share))
    other_low, other_high = (quantile(other, part) for part in (1.0 - share, share))
    return high < other_low or other_high < low


def _elected_motion(case: _Case, second: _Second) -> TwoMotions | None:
    """Which of two motions the points follow that have been static for long; None: they do not
    tell, or a sensor will.
    """
    if not second.exists or case.measured or case.voting is None:
        return None
    found = case.found
    elected = _elected(found.inliers[case.voting], second.follows[case.voting])
    if elected == "second":
        object_share = case.without(second.follows)
        return TwoMotions(Consensus(second.T, second.follows), object_share, "voted")
    if elected == "first":
        return TwoMotions(found, second.object_share, "voted" if second.object_share else None)
    return None


def _predicted_motion(case: _Case, first: _First, second: _Second) -> TwoMotions:
    """Which of two motions agrees with the prediction; both may, and neither."""
    found = case.found
    reported = second.object_share
    prior = case.prior
    if case.expected is None or prior is None:
        return TwoMotions(found, reported, "undecided" if reported else None)
    if not (second.exists or case.in_event):
        return TwoMotions(found, 0.0, None)
    of_second = np.inf
    if second.exists:
        of_second = case.expected.distance(second.T, case.p_prev[case.others[second.support]])
    nearer, farther = sorted((first.distance, of_second))
    limit = AGREEMENT_LIMIT
    if case.measured and second.exists and nearer * CLEARLY_NEARER <= farther:
        # the sensor is worse than its covariance, but leaves no doubt which one it is
        limit = max(limit, nearer)
    first_agrees = first.distance <= limit
    second_agrees = of_second <= limit
    if not (second_agrees or case.in_event or reported):
        return TwoMotions(found, 0.0, None)  # whether the first agrees or not
    if first_agrees or not (second_agrees or case.in_event):
        told = first_agrees and not second_agrees
        return TwoMotions(found, reported, "predicted" if told else "undecided")
    motion = Consensus(second.T, second.follows)
    if not second_agrees:
        motion = Consensus(prior.T_curr_prev, case.followers(prior.T_curr_prev))
    return TwoMotions(motion, _if_large(share_of(found.inliers)), "predicted")


def _prediction_overrules(
    p_prev: FloatArray, found: Consensus, voted: Consensus, expected: ExpectedMotion | None
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
    return of_found <= min(of_voted, AGREEMENT_LIMIT)


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
    expected: ExpectedMotion,
) -> Consensus | None:
    """The motion near a predicted one that the consensus contradicts, if some points follow this
    one alone.

    A compromise between an object and what is far away can win the consensus, and leaves no second
    group.
    """
    start = expected.prior.T_curr_prev
    near = pixel_errors(problem.camera, start, p_prev, pixels) <= 2.0 * problem.limit_px
    if near.sum() < MIN_POINTS:
        return None
    T, _ = best_motion(problem, p_prev[near], pixels[near], start[None])
    inliers = _followers(problem, T, p_prev, pixels)
    alone = inliers & ~found.inliers
    others = found.inliers & ~inliers
    if alone.sum() < max(MIN_POINTS, _SECOND.min_support_share * others.sum()):
        return None
    return (
        Consensus(T, inliers) if expected.distance(T, p_prev[inliers]) <= AGREEMENT_LIMIT else None
    )


def _without_slow_object(
    problem: RansacProblem,
    p_prev: FloatArray,
    pixels: FloatArray,
    found: Consensus,
    expected: ExpectedMotion,
    voting: BoolArray,
) -> Consensus | None:
    """The motion of the points that have been static for long, and those that follow it as well as
    they do, if it agrees with a predicted one that the consensus contradicts.

    What moves by less than the limit of an outlier in a frame is part of the consensus, and drags
    it along.
    """
    old = voting & found.inliers
    if old.sum() < MIN_POINTS:
        return None
    T, _ = best_motion(problem, p_prev[old], pixels[old], expected.prior.T_curr_prev[None])
    errors = pixel_errors(problem.camera, T, p_prev, pixels)
    usual_px = _VOTE.following_ratio * median(errors[old])
    follows = np.asarray(errors <= min(usual_px, problem.limit_px))
    moving = found.inliers & ~follows
    # old points that do not follow: the scene is no better known than what came into view
    if moving.sum() < max(MIN_POINTS, _SECOND.large_share * len(p_prev)):
        return None
    if (moving & voting).sum() > (1.0 - _VOTE.clear_share) * voting.sum():
        return None
    if expected.distance(T, p_prev[old]) <= AGREEMENT_LIMIT:
        return Consensus(T, follows)
    return None


def without_young_object(
    problem: RansacProblem,
    p_prev: FloatArray,
    pixels: FloatArray,
    found: Consensus,
    old: BoolArray,
) -> TwoMotions | None:
    """The motion of the points (N,) that were there before an object, and those that follow it as
    well as they do; None: they are few, or all follow.

    An object that has stopped moves by less than the limit of an outlier, and its points pass for
    static ones.
    """
    static = old & found.inliers
    if static.sum() < max(MIN_POINTS, _VOTE.clear_share * old.sum()):
        return None
    T, _ = best_motion(problem, p_prev[static], pixels[static], found.T_curr_prev[None])
    errors = pixel_errors(problem.camera, T, p_prev, pixels)
    usual_px = _VOTE.following_ratio * median(errors[static])
    kept = static | (errors <= min(usual_px, problem.limit_px))
    moving = found.inliers & ~kept
    if not moving.any():
        return None
    object_share = _if_large(share_of(moving))
    return TwoMotions(Consensus(T, kept), object_share, "voted" if object_share else None)


def _elected(first: BoolArray, second: BoolArray) -> Literal["first", "second"] | None:
    """Which of two motions most of the voting points follow, of those (N,) that only one of them
    explains.

    What is far away follows both, if they turn alike, and does not vote.
    """
    for_first = int((first & ~second).sum())
    for_second = int((second & ~first).sum())
    if max(for_first, for_second) < max(MIN_POINTS, _VOTE.clear_share * (for_first + for_second)):
        return None
    return "first" if for_first > for_second else "second"


def _votes_for(found: Consensus, voting: BoolArray) -> bool:
    """Whether most of the voting points (N,) follow a motion."""
    return bool(voting.sum() >= MIN_POINTS and found.inliers[voting].mean() >= _VOTE.clear_share)


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
    if voting.sum() < MIN_POINTS or _votes_for(found, voting):
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
    if static.sum() < MIN_POINTS or share_of(static[kept]) >= _AGREEMENT.min_static_share:
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
    inverse_depth = np.clip(inverse, 1.0 / _AGREEMENT.far_m, 1.0 / near_m)
    p = turned / inverse_depth[:, None] + T[:3, 3]
    ahead = depth_of(camera, p) > 0.0
    p[~ahead] = [0.0, 0.0, 1.0]
    J = pixel_D_motion(camera, p)
    by_motion = J @ predicted.covariance @ J.transpose(0, 2, 1)
    S = by_motion + sigma_px**2 * np.eye(2)
    d = after - project(camera, p)[:, :2]
    whitened = np.linalg.solve(S, d[..., None])[..., 0]
    squared = np.sum(d * whitened, axis=1)
    return np.asarray(ahead & (squared <= float(chi_square_quantile(AGREEMENT_PROBABILITY, 1))))


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
    return np.asarray(age >= max(oldest, STATIC_FRAMES))
