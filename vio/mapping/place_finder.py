"""Which places of a map a new keyframe shows again: those that the odometry expects, else those
with words in common.

A place is accepted in four steps: words in common (`place_index`); PnP in both directions
(`loop_geometry`); agreement with the odometry within its covariance; and no second place that fits
as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from vio.geometry.lie import FloatArray, se3_adjoint, se3_inverse, se3_log
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera, triangulate
from vio.mapping.features import KeyframeFeatures
from vio.mapping.guided_search import (
    MIN_CORNERS,
    Guided,
    PlaceView,
    Shown,
    place_points,
    search,
    shown,
)
from vio.mapping.loop_geometry import MIN_DISPARITY_PX, Verified, matches_of, verify
from vio.mapping.map_graph import UNKNOWN, MapGraph
from vio.mapping.map_store import LoopRow, MapStore, PlacesRow
from vio.mapping.overlap import Overlaps
from vio.mapping.place_index import SEGMENT, PlaceIndex
from vio.numerics.kinds import Capacity
from vio.numerics.statistics import chi_square_quantile
from vio.records import BoolArray, IntArray


@dataclass(frozen=True, slots=True)
class _PlaceRules:
    """What finds and proves a place."""

    candidates: int = 3  # keyframes that are compared by geometry
    recent: int = 10  # newest keyframes, which the filter's own tracks join
    # path since a keyframe, in median depths, before it counts as seen again
    revisit_depths: float = 1.5
    view_depths: float = 1.5  # how far apart two views of a place are, in median depths
    # standard deviation of the position beyond which one confirmation is not enough …
    lost_m: float = 3.0
    confirmations: int = 1  # other keyframes that must agree; … and how many then
    confirmations_lost: int = 2
    sure_inliers: int = 60  # three times what is asked of any loop: one confirmation is enough
    # share of the best candidate's inliers at which one elsewhere makes the place ambiguous
    other_place: float = 0.5
    same_depths: float = 0.1  # by which what two candidates say of the position may differ
    same_m: float = 0.1
    guided_places: int = 3  # that are searched together
    # keyframes to each side that belong to the first place, and to the others
    guided_neighbours: int = 3
    guided_others: int = 2
    # Of what errors of the calibration may do (`MapGraph.drift`), what a search and its gate
    # count on: it looks where the odometry is right to 0.25 % and 0.12 deg/100 m, which is a
    # quarter of what a place found without it is held against.
    guided_share: float = 0.25
    guided_m: float = 0.5  # standard deviation of the position up to which places are searched
    # keyframes whose points are held, 6 MB: from query to query, most of those searched are the
    # same
    shown: Capacity[int] = 64


_PLACES = _PlaceRules()
_VIEW_RAD = float(np.radians(70.0))
_SIGMAS = 3.0
GATE = float(chi_square_quantile(0.999, 6))
_OF_THE_FILE = ("_store", "_index", "_overlaps", "_shown")


@dataclass(frozen=True, slots=True)
class FoundPlace:
    """A loop before its confirmation."""

    first: int  # keyframe
    second: int  # later keyframe
    seen: Verified
    needed: int  # other keyframes that must confirm it

    @property
    def is_sure(self) -> bool:
        """Whether it shows enough to need one confirmation alone where nothing else is known of
        the place.
        """
        return self.seen.inliers >= _PLACES.sure_inliers


class PlaceFinder:
    """What finds the keyframes of a map again, made of their features."""

    def __init__(
        self,
        store: MapStore,
        graph: MapGraph,
        camera: StereoCamera,
        own: int,
        *,
        writes: bool,
        most: int | None = None,
    ) -> None:
        """Remember the keyframes of a map.

        Args:
            store: the map, open.
            graph: its keyframes.
            camera: of the session that looks for places.
            own: number of that session.
            writes: whether the file keeps what finds keyframes again.
            most: the first ones alone; None: all.
        """
        count = len(graph) if most is None else most
        self._graph = graph
        self._camera = camera
        self._own = own
        self._writes = writes
        self.newest: LoopRow | None = None  # accepted loop
        # Keyframes that are found no more.
        self._forgotten = set(np.flatnonzero(~store.show_something()[:count]).tolist())
        self.reopen(store, count)

    def reopen(self, store: MapStore, keyframes: int) -> None:
        """Begin again with so many keyframes of the file."""
        self._store = store
        self._index = PlaceIndex()
        self._overlaps = Overlaps()
        self._shown = lru_cache(_PLACES.shown)(self._read_shown)
        self._restore(keyframes)

    def __getstate__(self) -> dict[str, Any]:
        """State for a checkpoint: all but what is made of the file."""
        return {key: value for key, value in self.__dict__.items() if key not in _OF_THE_FILE}

    @property
    def shows_something(self) -> BoolArray:
        """Mask (N,) of the keyframes that can be found again."""
        shows = np.ones(len(self._index), dtype=np.bool_)
        shows[sorted(self._forgotten)] = False
        return shows

    def forget(self, keyframes: IntArray) -> None:
        """Find keyframes no more."""
        self._forgotten.update(keyframes.tolist())

    def forget_pixels(self) -> None:
        """Forget what was made of the pixels of keyframes, as the estimate of the rectification
        error has changed.
        """
        self._shown.cache_clear()

    def measured_again(self, loop: LoopRow) -> LoopRow | None:
        """Return a loop as measured from where the map has its keyframes now; None: not enough is
        seen.

        The prior is the odometry, as for a new loop. A loop's first measurement is none: of the
        pairs around it those that agree with it would be chosen, right or wrong.
        """
        i = loop.first
        k = loop.second
        if self._forgotten & {i, k}:
            return None
        prior = self._priors(np.array([i]), k).get(i)
        views = place_points(self._views(i, i))
        seen = search(
            views, self._camera, self.features(k), loop.pose if prior is None else prior, prior
        )
        if seen is None:
            return None
        return replace(loop, pose=seen.pose, inliers=seen.inliers)

    def remember(self, camera: StereoCamera, features: KeyframeFeatures) -> None:
        """Let the next keyframe be found again."""
        self._index.add(features.descriptors)
        p, valid = triangulate(camera, features.z, min_disparity_px=MIN_DISPARITY_PX)
        self._overlaps.add(p[valid & features.has_right])
        words = self._index.full_segment()
        if words is not None and self._writes:
            self._store.add_places(PlacesRow(words, *self._overlaps.newest(SEGMENT)))

    def _restore(self, count: int) -> None:
        """Let the first keyframes of the file be found again: by what it says of places, the
        rest by their features.
        """
        places = self._store.places()[: count // SEGMENT]
        self._index.restore([row.words for row in places])
        for row in places:
            self._overlaps.restore(row.points, row.stereo)
        for k, session in enumerate(
            self._graph.session[len(self._index) : count].tolist(), start=len(self._index)
        ):
            self.remember(self._graph.sessions[session].camera, self.features(k))

    def features(self, keyframe: int) -> KeyframeFeatures:
        """Return a keyframe's features without what its session found the stereo calibration to
        be off by.
        """
        graph = self._graph
        return self._store.features(keyframe).without(
            graph.sessions[int(graph.session[keyframe])].field
        )

    def find(self, number: int, features: KeyframeFeatures) -> FoundPlace | None:
        """Return the best place that fits by geometry and odometry, unless another one fits nearly
        as well.

        Args:
            number: of the keyframe, which is in the graph.
            features: what it shows.
        """
        depth = self._median_depth(features)
        known = len(self._index)
        if not known or depth is None:
            return None
        drift = self.drift_since(np.arange(known), number)
        allowed = self._may_be_seen(number, depth, drift[:, :3, :3]) & self.shows_something
        expected = self._search(number, features, allowed)
        if expected is not None:
            return expected
        found = self._candidates(number, features, allowed, drift)
        if not found:
            return None
        best = max(found, key=lambda loop: loop.seen.inliers)
        if any(self._is_rival(other, best, depth) for other in found):
            return None
        return self._refined(best, features, drift[best.first])

    def _candidates(
        self, number: int, features: KeyframeFeatures, allowed: BoolArray, drift: FloatArray
    ) -> list[FoundPlace]:
        """Return the similar keyframes that fit by geometry and odometry.

        Args:
            number: of the keyframe that is looked for.
            features: what it shows.
            allowed: (K,) keyframes that may be found.
            drift: (K, 6, 6) covariance of the odometry since each of them.
        """
        candidates = self._index.candidates(features.descriptors, allowed, _PLACES.candidates)
        found: list[FoundPlace] = []
        for i in candidates.tolist():
            camera = self._graph.sessions[int(self._graph.session[i])].camera
            seen = verify(camera, self.features(i), self._camera, features)
            if seen is None or not self.fits(i, number, seen, drift[i]):
                continue
            far = drift[i, :3, :3].trace() > _PLACES.lost_m**2
            lost = far and seen.inliers < _PLACES.sure_inliers
            needed = _PLACES.confirmations_lost if lost else _PLACES.confirmations
            found.append(FoundPlace(i, number, seen, needed))
        return found

    def _refined(
        self, loop: FoundPlace, features: KeyframeFeatures, drift: FloatArray
    ) -> FoundPlace | None:
        """Return a place with the pose by all that it shows; None: not enough of that is seen."""
        i = loop.first
        k = loop.second
        views = self._views(i, i)
        prior = self._priors(np.array([i]), k).get(i)
        seen = search(place_points(views), self._camera, features, loop.seen.pose, prior)
        if seen is None:
            return None
        refined = _as_place(views, k, seen, features, loop.needed)
        if not self.fits(refined.first, k, refined.seen, drift):
            return None
        return refined

    def _search(
        self, number: int, features: KeyframeFeatures, allowed: BoolArray
    ) -> FoundPlace | None:
        """Look for the points of the places that should be visible by the odometry, at the pixels
        that it predicts.

        Args:
            number: of the keyframe.
            features: what it shows.
            allowed: (N,) keyframes that may be found.
        """
        priors = self._priors(np.flatnonzero(allowed), number)
        places = self._expected_places(number, np.array(list(priors), dtype=np.int64))
        if not places:
            return None
        prior = priors[places[0]]
        first, *others = places
        views = self._views(first, first)
        for i in others:
            views += self._views(i, first, reach=_PLACES.guided_others)
        seen = search(place_points(views), self._camera, features, prior, prior)
        if seen is None:
            return None
        r = se3_log(se3_inverse(prior.T_i_j) @ seen.pose.T_i_j)
        if squared(r, prior.covariance + seen.pose.covariance) > GATE:
            return None
        return _as_place(views, number, seen, features, _PLACES.confirmations)

    def _priors(self, rows: IntArray, k: int) -> dict[int, RelativePose]:
        """Return where keyframe k stands in those of keyframes `rows` from which the odometry
        knows it well enough.
        """
        graph = self._graph
        rows = rows[graph.part[rows] == graph.part[k]]
        drift = self.drift_since(rows, k, systematic=_PLACES.guided_share)
        variance = np.trace(drift[:, :3, :3], axis1=1, axis2=2)
        known = np.flatnonzero(variance < _PLACES.guided_m**2)
        T = se3_inverse(graph.T_map_cam[rows[known]]) @ graph.T_map_cam[k]
        return {int(rows[n]): RelativePose(T[m], drift[n]) for m, n in enumerate(known.tolist())}

    def _expected_places(self, number: int, rows: IntArray) -> list[int]:
        """Return the keyframes among `rows` of which most should be seen, each of another place."""
        T = self._graph.T_map_cam
        out = list[int]()
        score = np.zeros(len(self._index))
        score[rows] = self._overlaps.expected(rows, T[rows], self._camera, T[number])
        kernel = np.ones(2 * _PLACES.guided_neighbours + 1)
        around = np.convolve(score, kernel)[
            _PLACES.guided_neighbours : _PLACES.guided_neighbours + len(score)
        ]
        around[score == 0] = 0.0
        while len(out) < _PLACES.guided_places and around.max(initial=0.0) >= MIN_CORNERS:
            middle = int(np.argmax(around))
            out.append(middle)
            around[
                max(middle - 2 * _PLACES.guided_neighbours, 0) : middle
                + 2 * _PLACES.guided_neighbours
                + 1
            ] = 0.0
        return out

    def _views(
        self, i: int, origin: int, *, reach: int = _PLACES.guided_neighbours
    ) -> list[PlaceView]:
        """Return keyframe i and its neighbours in its session, with their motion from another
        keyframe.
        """
        graph = self._graph
        session = self._graph.session
        around = range(max(i - reach, 0), min(i + reach + 1, len(self._index)))
        rows = [m for m in around if m not in self._forgotten]
        near = np.array(
            sorted((m for m in rows if session[m] == session[i]), key=lambda m: abs(m - i)),
            dtype=np.int64,
        )
        motions = graph.motions(origin, near)
        return [
            PlaceView(m, self._shown(m), motion, i)
            for m, motion in zip(near.tolist(), motions, strict=True)
        ]

    def _read_shown(self, keyframe: int) -> Shown:
        graph = self._graph
        return shown(graph.sessions[int(graph.session[keyframe])].camera, self.features(keyframe))

    def _is_rival(self, other: FoundPlace, best: FoundPlace, depth: float) -> bool:
        """Whether another place of the same part of the map fits nearly as well as the best one."""
        part = self._graph.part
        if (
            part[other.first] != part[best.first]
            or other.seen.inliers < _PLACES.other_place * best.seen.inliers
        ):
            return False
        gap = self._position(other) - self._position(best)
        return float(np.linalg.norm(gap)) > _PLACES.same_m + _PLACES.same_depths * depth

    def _position(self, loop: FoundPlace) -> FloatArray:
        """Position (3,) of the later keyframe in the map, as a loop says it."""
        return (self._graph.T_map_cam[loop.first] @ loop.seen.pose.T_i_j)[:3, 3]

    def _median_depth(self, features: KeyframeFeatures) -> float | None:
        p, valid = triangulate(self._camera, features.z, min_disparity_px=1.0)
        valid &= features.has_right
        if not valid.any():
            return None
        return float(np.median(p[valid, 2]))

    def drift_since(self, i: IntArray, k: int, *, systematic: float = 1.0) -> FloatArray:
        """Covariance (N, 6, 6) of the motion from keyframes i (N,) to k, in the frame of k, before
        k's own loops.

        The shorter of two ways: along the path, or by the newest loop.
        """
        graph = self._graph
        direct = graph.drift(i, np.full(len(i), k), systematic=systematic)
        if self.newest is None:
            return direct
        m = self.newest.first
        n = self.newest.second
        A = se3_adjoint(se3_inverse(graph.T_odom_cam[k]) @ graph.T_odom_cam[n])
        here = A @ self.newest.pose.covariance @ A.T + graph.drift(
            np.array([n]), np.array([k]), systematic=systematic
        )
        there = graph.drift(i, np.full(len(i), m), systematic=systematic)
        T = graph.T_map_cam
        # `drift` is in the frame of the later keyframe
        B = se3_adjoint(se3_inverse(T[k]) @ T[np.maximum(i, m)])
        by_loop = B @ there @ np.swapaxes(B, 1, 2) + here
        shorter = np.trace(by_loop[:, :3, :3], axis1=1, axis2=2) < np.trace(
            direct[:, :3, :3], axis1=1, axis2=2
        )
        return np.where(shorter[:, None, None], by_loop, direct)

    def _may_be_seen(self, number: int, depth: float, covariance: FloatArray) -> BoolArray:
        """Mask (N,) of keyframes that are not recent, and close enough to show what this one
        shows.
        """
        graph = self._graph
        count = len(covariance)
        own = graph.session[:count] == self._own
        passed = graph.path_m[number] - graph.path_m[:count]
        # large numbers cancel
        sigma = np.sqrt(np.maximum(np.trace(covariance, axis1=1, axis2=2), 0.0))
        near_path = (passed < _PLACES.revisit_depths * depth) & (sigma < _PLACES.lost_m)
        recent = own & ((np.arange(count) > number - _PLACES.recent) | near_path)
        T = se3_inverse(graph.T_map_cam[number]) @ graph.T_map_cam[:count]
        distance_m = np.linalg.norm(T[:, :3, 3], axis=1)
        near = distance_m <= _PLACES.view_depths * depth + _SIGMAS * sigma
        ahead = np.arccos(np.clip(T[:, 2, 2], -1.0, 1.0)) <= _VIEW_RAD
        part = graph.part
        unknown = (part[:count] != part[number]) | (sigma > 0.5 * UNKNOWN**0.5)
        return ~recent & (unknown | (near & (ahead | (sigma > _PLACES.lost_m))))

    def fits(self, i: int, k: int, seen: Verified, drift: FloatArray) -> bool:
        """Whether a place agrees with the odometry, where that knows anything of it."""
        graph = self._graph
        if graph.part[i] != graph.part[k]:
            return True
        r = se3_log(se3_inverse(graph.T_map_cam[k]) @ graph.T_map_cam[i] @ seen.pose.T_i_j)
        return squared(r, drift + seen.pose.covariance) < GATE


def _as_place(
    views: list[PlaceView], number: int, seen: Guided, features: KeyframeFeatures, needed: int
) -> FoundPlace:
    """Return a place found by search as a motion from the keyframe that shows most of what was
    found.

    Where that keyframe stands among the others enters the covariance by their points alone.
    """
    most = int(np.argmax(np.bincount(seen.view)))
    best = views[most]
    own = seen.view == most
    a = seen.row[own]
    b = seen.row_here[own]
    f = views[most].shown.features
    matches = matches_of(f, a, features, b)
    pose = RelativePose(se3_inverse(best.place.T_i_j) @ seen.pose.T_i_j, seen.pose.covariance)
    return FoundPlace(
        best.keyframe, number, Verified(pose, seen.inliers, len(seen.row), matches), needed
    )


def squared(r: FloatArray, covariance: FloatArray) -> float:
    """Squared Mahalanobis distance of r (6,)."""
    return float(r @ np.linalg.solve(covariance, r))
