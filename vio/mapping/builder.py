"""Keyframes in, a map out: places recognised, loops confirmed, poses optimised.

A loop is accepted in five steps: words in common (`place_index`); PnP in both directions (`loop_geometry`); agreement
with the odometry within its covariance; no second place that fits as well; and another keyframe close by that finds the
same. All follows from the keyframes alone, so that equal keyframes give equal maps.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from vio.calibration.stereo_field import DisplacementField
from vio.errors import ConfigError, DataError
from vio.geometry.lie import FloatArray, se3_adjoint, se3_inverse, se3_log
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera, triangulate
from vio.mapping.features import KeyframeFeatures
from vio.mapping.guided_search import LEAST_CORNERS, Guided, PlaceView, Shown, place_points, search, shown
from vio.mapping.loop_geometry import LEAST_DISPARITY_PX, Verified, matches_of, verify
from vio.mapping.map_graph import UNKNOWN, MapGraph
from vio.mapping.map_store import KeyframeRow, LoopRow, MapStore, PlacesRow, SessionRow
from vio.mapping.overlap import Overlaps
from vio.mapping.place_index import SEGMENT, PlaceIndex
from vio.numerics.statistics import chi_square_quantile
from vio.records import BoolArray, IntArray, LoopEvent

log = logging.getLogger(__name__)

_CANDIDATES = 3  # keyframes that are compared by geometry
_RECENT = 10  # newest keyframes, which the filter's own tracks join
_REVISIT_DEPTHS = 1.5  # path since a keyframe, in median depths, before it counts as seen again
_VIEW_DEPTHS, _VIEW_RAD = 1.5, float(np.radians(70.0))  # how far apart two views of a place are, in median depths
_SIGMAS = 3.0
_GATE = float(chi_square_quantile(0.999, 6))
_LOST_M = 3.0  # standard deviation of the position beyond which one confirmation is not enough …
_CONFIRMATIONS, _CONFIRMATIONS_LOST = 1, 2  # other keyframes that must agree; … and how many then
_SURE_INLIERS = 60  # three times what is asked of any loop: one confirmation is enough
_CONFIRM_WITHIN = 6  # keyframes
_OTHER_PLACE = 0.5  # share of the best candidate's inliers at which one elsewhere makes the place ambiguous
_SAME_DEPTHS, _SAME_M = 0.1, 0.1  # by which what two candidates say of the position may differ
_NEIGHBOURS_M = 50.0  # path between two places up to which the map's own drift between them is counted
_SETTLED = 6.0  # squared error of a new loop, its expected value, up to which the optimisation can wait …
_PATIENCE = 8  # … for so many loops
_COMMIT_EVERY = 20  # keyframes
_GUIDED_PLACES = 3  # that are searched together
_GUIDED_NEIGHBOURS, _GUIDED_OTHERS = 3, 2  # keyframes to each side that belong to the first place, and to the others
# Of what errors of the calibration may do (`MapGraph.drift`), what a search and its gate count on: it looks where the
# odometry is right to 0.25 % and 0.12 deg/100 m, which is a quarter of what a place found without it is held against.
_GUIDED_SHARE = 0.25
_GUIDED_M = 0.5  # standard deviation of the position up to which places are searched
_SHOWN = 64  # keyframes whose points are held, 6 MB: from query to query, most of those searched are the same
_OF_THE_FILE = ("_store", "_index", "_overlaps", "_shown", "_stored_poses", "_stored_kept")
_ONLY = ("pinhole", "stereo")  # projection and kind of the cameras that maps know
_SAME_RIG = 0.03  # by which two calibrations of one rig may differ in focal length and baseline
_FIELD_MOVED_PX = 0.02  # by which a rectification error moves the pixels of a keyframe before all are corrected anew
_LOCAL = 20  # keyframes of a localised session that are optimised together


def check_camera(path: Path, camera: StereoCamera) -> None:
    """Raise ConfigError unless a map can be made of a camera's images."""
    if (camera.projection, camera.kind) != _ONLY:
        raise ConfigError(
            f"{path}: a map is made of the rectified images of a pinhole stereo pair, not of {_text(camera)}; "
            "set dataset.projection to pinhole, and give a recording of two cameras"
        )


def _check_sessions(store: MapStore, camera: StereoCamera) -> None:
    """Warn where a map was made with another rig; raise DataError where with another kind of camera."""
    others = [s.camera for s in store.sessions()]
    for other in others:
        if (other.projection, other.kind) != _ONLY:
            raise DataError(f"{store.path}: is a map of {_text(other)}; use another map for {_text(camera)}")
    if others and not any(_is_alike(other, camera) for other in others):
        log.warning(
            "%s: was made with another rig, %s; this recording is of %s: places are looked for all the same, and if "
            "this is the same rig, one of the calibrations is wrong",
            store.path,
            _text(others[-1]),
            _text(camera),
        )


def _is_alike(a: StereoCamera, b: StereoCamera) -> bool:
    """Whether two cameras may be one rig with two calibrations."""
    lengths, others = ((c.fu, c.fv, c.baseline_m) for c in (a, b))
    return (a.width, a.height) == (b.width, b.height) and np.allclose(lengths, others, rtol=_SAME_RIG, atol=0)


def _text(camera: StereoCamera) -> str:
    size = "" if camera.width is None else f"{camera.width}x{camera.height} pixels, "
    kind = "a stereo pair" if camera.kind == "stereo" else "one camera"
    return f"{kind} ({camera.projection}, {size}focal length {camera.fu:.1f} px, baseline {camera.baseline_m:.4f} m)"


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A frame that enters the map."""

    frame: int
    time_ns: int
    T_odom_cam: FloatArray  # (4, 4) by the filter
    motion: RelativePose | None  # of the camera since the last keyframe; None: the session begins
    up_cam: FloatArray | None  # (3,) unit vector against gravity; None: not known
    up_sigma_rad: float  # standard deviation of its direction
    field: DisplacementField | None = None  # what the stereo calibration is off by, as known now


@dataclass(frozen=True, slots=True)
class MapUpdate:
    """What a keyframe made of the map."""

    T_map_odom: FloatArray | None  # (4, 4); None: the session has not found its place in the map
    T_map_cam: FloatArray | None  # (4, 4) of the keyframe, once a loop holds it; None: it moves with the odometry
    covariance: FloatArray | None  # (6, 6) of xi in T_map_cam = T_hat exp(xi), given the map; None likewise
    loops: tuple[LoopEvent, ...]


@dataclass(frozen=True, slots=True)
class FoundPlace:
    """A loop before its confirmation."""

    first: int  # keyframe
    second: int  # later keyframe
    seen: Verified
    needed: int  # other keyframes that must confirm it

    @property
    def is_sure(self) -> bool:
        """Whether it shows enough to need one confirmation alone where nothing else is known of the place."""
        return self.seen.inliers >= _SURE_INLIERS


class MapBuilder:
    """Builds, continues, or only reads a map, one keyframe after the other."""

    def __init__(self, store: MapStore, source: str, camera: StereoCamera, *, upright: bool, localise: bool) -> None:
        """Begin a session in a map.

        Args:
            store: the map, open.
            source: names the recording.
            camera: rectified pair.
            upright: whether z of the odometry's world is up.
            localise: find poses in the map, and leave it as it is.

        Raises:
            ConfigError: the images are not those of a pinhole stereo pair.
            DataError: those of the map are not.
        """
        check_camera(store.path, camera)
        _check_sessions(store, camera)
        self._store, self._camera, self._localise = store, camera, localise
        self.graph = MapGraph(store)
        self._shown = lru_cache(_SHOWN)(self._read_shown)
        self._index, self._overlaps = PlaceIndex(), Overlaps()
        self._remember_all(len(self.graph))
        self.first = len(self.graph)  # keyframe of this session
        sessions = self.graph.sessions
        self._own = len(sessions)
        self._home = sessions[0].part if sessions else self._own  # the part whose frame is the map's
        sessions.append(SessionRow(source, camera, upright, self._own))
        if not localise:
            store.add_session(sessions[-1])
        self._pending: list[FoundPlace] = []
        self._last: FoundPlace | None = None  # newest accepted loop
        self._waiting = 0  # loops since the last optimisation
        self._partial = False  # whether loops were optimised with what is around them alone
        self._optimised = False  # whether loops hold this session: until then it is reported as the odometry has it
        self._moved = False  # poses since the last commit
        # As the file has them:
        self._stored_poses, self._stored_kept = self.graph.T_map_cam.rows.copy(), [o.kept for o in self.graph.loops]

    @property
    def path(self) -> Path:
        """The map's file."""
        return self._store.path

    @property
    def index_bytes(self) -> int:
        """Memory of the words of all keyframes."""
        return self._index.nbytes

    @property
    def overlap_bytes(self) -> int:
        """Memory of the points by which places are expected."""
        return self._overlaps.nbytes

    @property
    def is_joined(self) -> bool:
        """Whether this session's poses are in the map's frame."""
        return self.graph.sessions[self._own].part == self._home

    def add(self, keyframe: Keyframe, features: KeyframeFeatures) -> MapUpdate:
        """Take the next keyframe of the session, with what `extract` made of its images.

        Raises:
            DataError: the file cannot be written or read.
        """
        graph, number, motion = self.graph, len(self.graph), keyframe.motion
        drift, path = graph.gathered(keyframe.T_odom_cam, motion)
        T = keyframe.T_odom_cam
        if motion is not None:  # the filter's poses jump where it learns what it was off by; this motion does not
            T = graph.T_map_cam[-1] @ motion.T_i_j
        up, sigma = keyframe.up_cam, keyframe.up_sigma_rad
        row = KeyframeRow(self._own, keyframe.frame, keyframe.time_ns, T, keyframe.T_odom_cam, drift, path, up, sigma)
        graph.append(row)
        if motion is not None:
            graph.add_motion(number - 1, number, motion)
        if not self._localise:
            self._store.add_keyframe(row, features)
            if motion is not None:
                self._store.add_odometry(number - 1, number, motion)
        if keyframe.field is not None:
            self._correct(keyframe.field, features)
        features = features.without(self.graph.sessions[self._own].field)
        events = self._close_loops(number, features)
        if not self._localise:
            self._remember(self._camera, features)
            if number % _COMMIT_EVERY == 0:
                self.commit()
        return self._update(events)

    def finish(self, field: DisplacementField | None = None) -> MapUpdate:
        """Optimise once more, write everything, and return the last correction.

        Args:
            field: what the session found its stereo calibration to be off by at its end: loops are measured again in
                pixels without it.
        """
        if field is not None and not self._localise and len(self.graph) > self.first:
            self._correct(field, None)
            if self._waiting:
                self._optimise()
            self._measure_again()
        if self._waiting or self._partial:
            self._optimise(whole=True)
        if not self._optimised:
            own = slice(self.first, None)
            self.graph.T_map_cam.rows[own] = self.graph.T_odom_cam.rows[own]
            self._moved = True
        self.commit()
        return self._update(())

    def commit(self) -> None:
        """Bring everything to the disk as one step."""
        if self._localise:
            return
        if self._moved:
            T, kept, before = self.graph.T_map_cam.rows, [o.kept for o in self.graph.loops], len(self._stored_poses)
            moved = np.ones(len(T), dtype=np.bool_)
            moved[:before] = (T[:before] != self._stored_poses).any(axis=(1, 2))
            self._store.set_poses({k: T[k] for k in np.flatnonzero(moved).tolist()})
            known = dict(enumerate(self._stored_kept))
            self._store.set_kept({n: now for n, now in enumerate(kept) if now != known.get(n)})
            self._stored_poses, self._stored_kept = T.copy(), kept
            self._store.set_parts([s.part for s in self.graph.sessions])
        self._store.set_field(self._own, self.graph.sessions[self._own].field)
        if self._moved:
            self._moved = False
        self._store.commit()

    def close(self) -> None:
        """Let the file go."""
        self._store.close()

    def __getstate__(self) -> dict[str, Any]:
        """State for a checkpoint: all but the file and the index, which is made of it."""
        return {key: value for key, value in self.__dict__.items() if key not in _OF_THE_FILE}

    def reopen(self, store: MapStore) -> None:
        """Go on from a checkpoint with the file as it was then: what was added since is forgotten."""
        self._store, self._index, self._overlaps = store, PlaceIndex(), Overlaps()
        self._shown = lru_cache(_SHOWN)(self._read_shown)
        self._stored_poses, self._stored_kept = np.zeros((0, 4, 4)), []
        graph = self.graph
        if not self._localise:
            store.truncate(len(graph.sessions), len(graph), len(graph.loops))
            self._moved = True
        self._remember_all(self.first if self._localise else len(graph))

    def _features(self, keyframe: int) -> KeyframeFeatures:
        """Return a keyframe's features without what its session found the stereo calibration to be off by."""
        graph = self.graph
        return self._store.features(keyframe).without(graph.sessions[int(graph.session[keyframe])].field)

    def _correct(self, field: DisplacementField, features: KeyframeFeatures | None) -> None:
        """Take a newer estimate of the rectification error of this session, where it differs in a keyframe's features.

        All that was made of pixels before is forgotten.
        """
        sessions, own = self.graph.sessions, self._own
        before = sessions[own].field
        if before is not None and features is not None:
            moved = (field.at(features.z) - before.at(features.z))[features.has_right]
            if not len(moved) or np.sqrt(np.mean(moved**2)) < _FIELD_MOVED_PX:
                return
        sessions[own] = replace(sessions[own], field=field)
        self._shown.cache_clear()

    def _measure_again(self) -> None:
        """Measure the loops of this session once more, from where the map has its keyframes now.

        The prior is the odometry, as for a new loop. A loop's first measurement is none: of the pairs around it those
        that agree with it would be chosen, right or wrong.
        """
        graph, again = self.graph, dict[int, LoopRow]()
        for n, loop in enumerate(graph.loops):
            i, k = loop.first, loop.second
            if k < self.first:
                continue
            prior = self._priors(np.array([i]), k).get(i)
            views = place_points(self._views(i, i))
            seen = search(views, self._camera, self._features(k), loop.pose if prior is None else prior, prior)
            if seen is not None:
                again[n] = graph.loops[n] = replace(loop, pose=seen.pose, inliers=seen.inliers)
        self._waiting += len(again)
        self._store.set_loops(again)

    def _remember(self, camera: StereoCamera, features: KeyframeFeatures) -> None:
        """Let the next keyframe be found again."""
        self._index.add(features.descriptors)
        p, valid = triangulate(camera, features.z, min_disparity_px=LEAST_DISPARITY_PX)
        self._overlaps.add(p[valid & features.has_right])
        words = self._index.full_segment()
        if words is not None and not self._localise:
            self._store.add_places(PlacesRow(words, *self._overlaps.newest(SEGMENT)))

    def _remember_all(self, count: int) -> None:
        """Let the first keyframes of the file be found again: by what it says of places, the rest by their features."""
        places = self._store.places()[: count // SEGMENT]
        self._index.restore([row.words for row in places])
        for row in places:
            self._overlaps.restore(row.points, row.stereo)
        for k, session in enumerate(self.graph.session[len(self._index) : count].tolist(), start=len(self._index)):
            self._remember(self.graph.sessions[session].camera, self._features(k))

    def _update(self, events: tuple[LoopEvent, ...]) -> MapUpdate:
        if not self.is_joined:
            return MapUpdate(None, None, None, events)
        graph, k = self.graph, len(self.graph) - 1
        T_map_odom = graph.T_map_cam[k] @ se3_inverse(graph.T_odom_cam[k]) if self._optimised else np.eye(4)
        since = self._drift_since(np.array([self.first if self._last is None else self._last.first]), k)
        T_map_cam = None if self._last is None else graph.T_map_cam[k].copy()
        return MapUpdate(T_map_odom, T_map_cam, since[0], events)

    # Loops

    def _close_loops(self, number: int, features: KeyframeFeatures) -> tuple[LoopEvent, ...]:
        """Look for places seen again, and return what was accepted."""
        loop = self.find(number, features)
        if loop is None:
            return ()
        near = [o for o in self._pending if number - o.second <= _CONFIRM_WITHIN]
        agree = [o for o in near if self._agree(o, loop)]
        self._pending = [*near, loop]
        if len(agree) < loop.needed:
            return ()
        known = {(o.first, o.second) for o in self.graph.loops[-4 * _CONFIRM_WITHIN :]}
        return tuple(self._accept(o) for o in [*agree, loop] if (o.first, o.second) not in known)

    def find(self, number: int, features: KeyframeFeatures) -> FoundPlace | None:
        """Return the best place that fits by geometry and odometry, unless another one fits nearly as well.

        Args:
            number: of the keyframe, which is in the graph.
            features: what it shows.
        """
        depth, known = self._median_depth(features), len(self._index)
        if not known or depth is None:
            return None
        drift = self._drift_since(np.arange(known), number)
        allowed = self._may_be_seen(number, depth, drift[:, :3, :3])
        expected = self._search(number, features, allowed)
        if expected is not None:
            return expected
        found: list[FoundPlace] = []
        for i in self._index.candidates(features.descriptors, allowed, _CANDIDATES).tolist():
            camera = self.graph.sessions[int(self.graph.session[i])].camera
            seen = verify(camera, self._features(i), self._camera, features)
            if seen is not None and self._fits(i, number, seen, drift[i]):
                lost = drift[i, :3, :3].trace() > _LOST_M**2 and seen.inliers < _SURE_INLIERS
                found.append(FoundPlace(i, number, seen, _CONFIRMATIONS_LOST if lost else _CONFIRMATIONS))
        if not found:
            return None
        best = max(found, key=lambda loop: loop.seen.inliers)
        if any(self._is_rival(other, best, depth) for other in found):
            return None
        return self._refined(best, features, drift[best.first])

    def _refined(self, loop: FoundPlace, features: KeyframeFeatures, drift: FloatArray) -> FoundPlace | None:
        """Return a place with the pose by all that it shows; None: not enough of that is seen."""
        i, k = loop.first, loop.second
        views = self._views(i, i)
        prior = self._priors(np.array([i]), k).get(i)
        seen = search(place_points(views), self._camera, features, loop.seen.pose, prior)
        if seen is None:
            return None
        refined = _as_place(views, k, seen, features, loop.needed)
        return refined if self._fits(refined.first, k, refined.seen, drift) else None

    def _search(self, number: int, features: KeyframeFeatures, allowed: BoolArray) -> FoundPlace | None:
        """Look for the points of the places that should be visible by the odometry, at the pixels that it predicts.

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
            views += self._views(i, first, reach=_GUIDED_OTHERS)
        seen = search(place_points(views), self._camera, features, prior, prior)
        if seen is None:
            return None
        r = se3_log(se3_inverse(prior.T_i_j) @ seen.pose.T_i_j)
        if _squared(r, prior.covariance + seen.pose.covariance) > _GATE:
            return None
        return _as_place(views, number, seen, features, _CONFIRMATIONS)

    def _priors(self, rows: IntArray, k: int) -> dict[int, RelativePose]:
        """Return where keyframe k stands in those of keyframes `rows` from which the odometry knows it well enough."""
        graph = self.graph
        rows = rows[graph.part[rows] == graph.part[k]]
        drift = self._drift_since(rows, k, systematic=_GUIDED_SHARE)
        known = np.flatnonzero(np.trace(drift[:, :3, :3], axis1=1, axis2=2) < _GUIDED_M**2)
        T = se3_inverse(graph.T_map_cam[rows[known]]) @ graph.T_map_cam[k]
        return {int(rows[n]): RelativePose(T[m], drift[n]) for m, n in enumerate(known.tolist())}

    def _expected_places(self, number: int, rows: IntArray) -> list[int]:
        """Return the keyframes among `rows` of which most should be seen, each of another place."""
        T, out = self.graph.T_map_cam, list[int]()
        score = np.zeros(len(self._index))
        score[rows] = self._overlaps.expected(rows, T[rows], self._camera, T[number])
        kernel = np.ones(2 * _GUIDED_NEIGHBOURS + 1)
        around = np.convolve(score, kernel)[_GUIDED_NEIGHBOURS : _GUIDED_NEIGHBOURS + len(score)]
        around[score == 0] = 0.0
        while len(out) < _GUIDED_PLACES and around.max(initial=0.0) >= LEAST_CORNERS:
            middle = int(np.argmax(around))
            out.append(middle)
            around[max(middle - 2 * _GUIDED_NEIGHBOURS, 0) : middle + 2 * _GUIDED_NEIGHBOURS + 1] = 0.0
        return out

    def _views(self, i: int, origin: int, *, reach: int = _GUIDED_NEIGHBOURS) -> list[PlaceView]:
        """Return keyframe i and its neighbours in its session, with their motion from another keyframe."""
        graph, session = self.graph, self.graph.session
        rows = range(max(i - reach, 0), min(i + reach + 1, len(self._index)))
        near = np.array(sorted((m for m in rows if session[m] == session[i]), key=lambda m: abs(m - i)), dtype=np.int64)
        covariance = graph.drift(np.full(len(near), origin), near, systematic=0.0)
        motion = se3_inverse(graph.T_map_cam[origin]) @ graph.T_map_cam[near]
        return [
            PlaceView(m, self._shown(m), RelativePose(motion[n], covariance[n]), i) for n, m in enumerate(near.tolist())
        ]

    def _read_shown(self, keyframe: int) -> Shown:
        graph = self.graph
        return shown(graph.sessions[int(graph.session[keyframe])].camera, self._features(keyframe))

    def _is_rival(self, other: FoundPlace, best: FoundPlace, depth: float) -> bool:
        """Whether another place of the same part of the map fits nearly as well as the best one."""
        part = self.graph.part
        if part[other.first] != part[best.first] or other.seen.inliers < _OTHER_PLACE * best.seen.inliers:
            return False
        gap = self._position(other) - self._position(best)
        return float(np.linalg.norm(gap)) > _SAME_M + _SAME_DEPTHS * depth

    def _position(self, loop: FoundPlace) -> FloatArray:
        """Position (3,) of the later keyframe in the map, as a loop says it."""
        return (self.graph.T_map_cam[loop.first] @ loop.seen.pose.T_i_j)[:3, 3]

    def _median_depth(self, features: KeyframeFeatures) -> float | None:
        p, valid = triangulate(self._camera, features.z, min_disparity_px=1.0)
        valid &= features.has_right
        return float(np.median(p[valid, 2])) if valid.any() else None

    def _drift_since(self, i: IntArray, k: int, *, systematic: float = 1.0) -> FloatArray:
        """Covariance (N, 6, 6) of the motion from keyframes i (N,) to k, in the frame of k, before k's own loops.

        The shorter of two ways: along the path, or by the newest loop.
        """
        graph = self.graph
        direct = graph.drift(i, np.full(len(i), k), systematic=systematic)
        if self._last is None:
            return direct
        m, n = self._last.first, self._last.second
        A = se3_adjoint(se3_inverse(graph.T_odom_cam[k]) @ graph.T_odom_cam[n])
        here = A @ self._last.seen.pose.covariance @ A.T + graph.drift(
            np.array([n]), np.array([k]), systematic=systematic
        )
        there = graph.drift(i, np.full(len(i), m), systematic=systematic)
        # The drift between i and m is known in the frame of the later one of them; its size is what matters here.
        by_loop = there + here
        shorter = np.trace(by_loop[:, :3, :3], axis1=1, axis2=2) < np.trace(direct[:, :3, :3], axis1=1, axis2=2)
        return np.where(shorter[:, None, None], by_loop, direct)

    def _may_be_seen(self, number: int, depth: float, covariance: FloatArray) -> BoolArray:
        """Mask (N,) of keyframes that are not recent, and close enough to show what this one shows."""
        graph, count = self.graph, len(covariance)
        own = graph.session[:count] == self._own
        passed = graph.path_m[number] - graph.path_m[:count]
        sigma = np.sqrt(np.maximum(np.trace(covariance, axis1=1, axis2=2), 0.0))  # large numbers cancel
        near_path = (passed < _REVISIT_DEPTHS * depth) & (sigma < _LOST_M)
        recent = own & ((np.arange(count) > number - _RECENT) | near_path)
        T = se3_inverse(graph.T_map_cam[number]) @ graph.T_map_cam[:count]
        near = np.linalg.norm(T[:, :3, 3], axis=1) <= _VIEW_DEPTHS * depth + _SIGMAS * sigma
        ahead = np.arccos(np.clip(T[:, 2, 2], -1.0, 1.0)) <= _VIEW_RAD
        part = graph.part
        unknown = (part[:count] != part[number]) | (sigma > 0.5 * UNKNOWN**0.5)
        return ~recent & (unknown | (near & (ahead | (sigma > _LOST_M))))

    def _fits(self, i: int, k: int, seen: Verified, drift: FloatArray) -> bool:
        """Whether a place agrees with the odometry, where that knows anything of it."""
        graph = self.graph
        if graph.part[i] != graph.part[k]:
            return True
        r = se3_log(se3_inverse(graph.T_map_cam[k]) @ graph.T_map_cam[i] @ seen.pose.T_i_j)
        return _squared(r, drift + seen.pose.covariance) < _GATE

    def _agree(self, a: FoundPlace, b: FoundPlace) -> bool:
        """Whether two loops say the same of where the session is in the map."""
        graph = self.graph
        if graph.part[a.first] != graph.part[b.first]:
            return False
        T = graph.T_map_cam
        T_second = se3_inverse(T[a.second]) @ T[b.second]
        r = se3_log(se3_inverse(T[a.first] @ a.seen.pose.T_i_j @ T_second) @ T[b.first] @ b.seen.pose.T_i_j)
        A = se3_adjoint(se3_inverse(T_second))
        C = A @ a.seen.pose.covariance @ A.T + b.seen.pose.covariance
        C = C + graph.drift(np.array([a.second]), np.array([b.second]))[0]
        if abs(graph.path_m[a.first] - graph.path_m[b.first]) < _NEIGHBOURS_M:
            C = C + graph.drift(np.array([a.first]), np.array([b.first]))[0]
        return _squared(r, C) < _GATE

    def _accept(self, loop: FoundPlace) -> LoopEvent:
        """Add a confirmed loop to the graph, and optimise where it moves the map."""
        graph, i, k, pose = self.graph, loop.first, loop.second, loop.seen.pose
        joined = bool(graph.part[i] != graph.part[k])
        if joined:
            self._join(i, k, graph.T_map_cam[i] @ pose.T_i_j)
        r = se3_log(se3_inverse(graph.T_map_cam[k]) @ graph.T_map_cam[i] @ pose.T_i_j)
        if not joined and graph.session[i] == graph.session[k]:
            drift = graph.drift(np.array([i]), np.array([k]), systematic=0.0)[0]
            excess = _squared(r, drift + pose.covariance) / _GATE
            graph.odometry_scale = max(graph.odometry_scale, excess)
        row = LoopRow(i, k, pose, loop.seen.inliers, kept=True)
        graph.loops.append(row)
        if not self._localise:
            self._store.add_loop(row)
        self._last, self._moved = loop, True
        self._waiting += 1
        settled = self._optimised and _squared(r, pose.covariance) <= _SETTLED
        if joined or not settled or self._waiting >= _PATIENCE:
            self._optimise()
        return LoopEvent(
            frame=graph.frame(k),
            time_ns=graph.time_ns(k),
            keyframe=i,
            keyframe_time_ns=graph.time_ns(i),
            inliers=row.inliers,
            gap_m=float(np.linalg.norm(r[:3])),
            joined=joined,
            keyframe_frame=graph.frame(i) if graph.session[i] == self._own else None,
            matches=loop.seen.matches,
        )

    def _join(self, i: int, k: int, T_map_k: FloatArray) -> None:
        """Bring the parts of two keyframes into one frame: that of the map's first session, if one of them is in it."""
        part = self.graph.part
        T = T_map_k @ se3_inverse(self.graph.T_map_cam[k])
        if part[k] == self._home:
            self.graph.join(int(part[i]), int(part[k]), se3_inverse(T))
        else:
            self.graph.join(int(part[k]), int(part[i]), T)

    def _optimise(self, *, whole: bool = False) -> None:
        part = self.graph.sessions[self._own].part
        self._partial = False
        if self._localise:
            self.graph.optimise_end(max(len(self.graph) - _LOCAL, self.first))
        elif whole:
            self.graph.optimise_part(part)
        else:
            self._partial = not self.graph.optimise_near(part, self._waiting)
        if self._last is not None and not self.graph.loops[-1].kept:
            self._last = None
        self._waiting, self._moved, self._optimised = 0, True, True


def _as_place(views: list[PlaceView], number: int, seen: Guided, features: KeyframeFeatures, needed: int) -> FoundPlace:
    """Return a place found by search as a motion from the keyframe that shows most of what was found.

    Where that keyframe stands among the others enters the covariance by their points alone.
    """
    most = int(np.argmax(np.bincount(seen.view)))
    best, own = views[most], seen.view == most
    a, b, f = seen.row[own], seen.row_here[own], views[most].shown.features
    matches = matches_of(f, a, features, b)
    pose = RelativePose(se3_inverse(best.place.T_i_j) @ seen.pose.T_i_j, seen.pose.covariance)
    return FoundPlace(best.keyframe, number, Verified(pose, seen.inliers, len(seen.row), matches), needed)


def _squared(r: FloatArray, covariance: FloatArray) -> float:
    """Squared Mahalanobis distance of r (6,)."""
    return float(r @ np.linalg.solve(covariance, r))
