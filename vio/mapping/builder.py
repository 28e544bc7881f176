"""Keyframes in, a map out: places recognised, loops confirmed, poses optimised.

A loop is accepted where `place_finder` finds a place, and another keyframe close by finds the same.
All follows from the keyframes alone, so that equal keyframes give equal maps.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vio.calibration.stereo_field import DisplacementField
from vio.errors import ConfigError, DataError
from vio.geometry.lie import FloatArray, se3_adjoint, se3_inverse, se3_log
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera
from vio.mapping.density import spread
from vio.mapping.features import KeyframeFeatures
from vio.mapping.map_graph import MapGraph, Placed
from vio.mapping.map_store import KeyframeRow, LoopRow, MapStore, SessionRow
from vio.mapping.place_finder import GATE, FoundPlace, PlaceFinder, squared
from vio.numerics.kinds import Capacity
from vio.records import BoolArray, LoopEvent

log = logging.getLogger(__name__)

CONFIRM_WITHIN = 6  # keyframes


class _SettlingRules(NamedTuple):
    """When new loops are optimised and stored."""

    # path between two places up to which the map's own drift between them is counted
    neighbours_m: float = 50.0
    # squared error of a new loop, its expected value, up to which the optimisation can wait …
    settled_error: float = 6.0
    waiting_loops: int = 8  # … for so many loops
    commit_keyframes: Capacity[int] = 20  # keyframes


_SETTLING = _SettlingRules()
_ONLY = ("pinhole", "stereo")  # projection and kind of the cameras that maps know


class _RigRules(NamedTuple):
    """When a rig is that of the map."""

    # by which two calibrations of one rig may differ in focal length and baseline
    max_difference: float = 0.03
    # by which a rectification error moves the pixels of a keyframe before all are corrected anew
    field_moved_px: float = 0.02


_RIG = _RigRules()
_OF_THE_FILE = ("_store", "_stored_poses", "_stored_kept")


def check_camera(path: Path, camera: StereoCamera) -> None:
    """Raise ConfigError unless a map can be made of a camera's images."""
    if (camera.projection, camera.kind) != _ONLY:
        raise ConfigError(
            f"{path}: a map is made of the rectified images of a pinhole stereo pair, not of "
            f"{_text(camera)}; "
            "set dataset.projection to pinhole, and give a recording of two cameras"
        )


def check_sessions(
    store: MapStore,
    camera: StereoCamera,
    what: str = "this recording",
    *,
    place: Path | None = None,
) -> None:
    """Warn where a map was made with another rig; raise DataError where with another kind of
    camera.

    Args:
        store: the map.
        camera: of what is looked for in it.
        what: that, for messages.
        place: the map's file, for messages; None: that of the store.
    """
    place = place or store.path
    others = [s.camera for s in store.sessions()]
    for other in others:
        if (other.projection, other.kind) != _ONLY:
            raise DataError(
                f"{place}: is a map of {_text(other)}; use another map for {_text(camera)}"
            )
    if others and not any(_is_alike(other, camera) for other in others):
        log.warning(
            "%s: was made with another rig, %s; %s is of %s: places are looked for all "
            "the same, and if "
            "this is the same rig, one of the calibrations is wrong",
            place,
            _text(others[-1]),
            what,
            _text(camera),
        )


def _is_alike(a: StereoCamera, b: StereoCamera) -> bool:
    """Whether two cameras may be one rig with two calibrations."""
    lengths, others = ((c.fu, c.fv, c.baseline_m) for c in (a, b))
    return (a.width, a.height) == (b.width, b.height) and np.allclose(
        lengths, others, rtol=_RIG.max_difference, atol=0
    )


def _text(camera: StereoCamera) -> str:
    if camera.width is None:
        size = ""
    else:
        size = f"{camera.width}x{camera.height} pixels, "
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
    # Standard deviations of what the calibration leaves open: scale, over it, and direction of the
    # optical axis, rad.
    rig_sigmas: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class MapUpdate:
    """What a keyframe made of the map."""

    T_map_odom: FloatArray | None  # (4, 4); None: the session has not found its place in the map
    # (4, 4) of the keyframe, once a loop holds it; None: it moves with the odometry
    T_map_cam: FloatArray | None
    # (6, 6) of xi in T_map_cam = T_hat exp(xi), in the map's frame; None: no place
    covariance: FloatArray | None
    loops: tuple[LoopEvent, ...]
    # whether the session, which has no place yet, may have found it, as another may confirm
    unconfirmed: bool = False


class MapBuilder:
    """Builds, continues, or only reads a map, one keyframe after the other."""

    def __init__(
        self,
        store: MapStore,
        source: str,
        camera: StereoCamera,
        *,
        upright: bool,
        localise: bool,
        density: int | None = None,
    ) -> None:
        """Begin a session in a map.

        Args:
            store: the map, open.
            source: names the recording.
            camera: rectified pair.
            upright: whether z of the odometry's world is up.
            localise: find poses in the map, and leave it as it is.
            density: keyframes a cubic metre that can be found again, others keep poses and motions
                alone; None: all.

        Raises:
            ConfigError: the images are not those of a pinhole stereo pair.
            DataError: those of the map are not.
        """
        check_camera(store.path, camera)
        check_sessions(store, camera)
        self._store = store
        self._camera = camera
        self._localise = localise
        self._density = density
        self.graph = MapGraph(store)
        self.first = len(self.graph)  # keyframe of this session
        sessions = self.graph.sessions
        self._own = len(sessions)
        # the part whose frame is the map's
        if sessions:
            self._home = sessions[0].part
        else:
            self._home = self._own
        # in the file from its first keyframe on
        sessions.append(SessionRow(source, camera, upright, self._own))
        self.places = PlaceFinder(store, self.graph, camera, self._own, writes=not localise)
        self._pending: list[FoundPlace] = []
        self._waiting = 0  # loops since the last optimisation
        # whether loops hold this session: until then it is reported as the odometry has it
        self._optimised = False
        # how well the newest keyframe was known when loops were last optimised
        self._placed: Placed | None = None
        self._moved = False  # poses since the last commit
        # As the file has them:
        self._stored_poses = self.graph.T_map_cam.rows.copy()
        self._stored_kept = [o.kept for o in self.graph.loops]

    @property
    def path(self) -> Path:
        """The map's file."""
        return self._store.path

    @property
    def is_joined(self) -> bool:
        """Whether this session's poses are in the map's frame."""
        return self.graph.sessions[self._own].part == self._home

    def add(self, keyframe: Keyframe, features: KeyframeFeatures) -> MapUpdate:
        """Take the next keyframe of the session, with what `extract` made of its images.

        Raises:
            DataError: the file cannot be written or read.
        """
        graph = self.graph
        number = len(self.graph)
        motion = keyframe.motion
        drift, path = graph.gathered(keyframe.T_odom_cam, motion)
        T = keyframe.T_odom_cam
        # the filter's poses jump where it learns what it was off by; this motion does not
        if motion is not None:
            T = graph.T_map_cam[-1] @ motion.T_i_j
        up = keyframe.up_cam
        sigma = keyframe.up_sigma_rad
        row = KeyframeRow(
            self._own,
            keyframe.frame,
            keyframe.time_ns,
            T,
            keyframe.T_odom_cam,
            drift,
            path,
            up,
            sigma,
        )
        graph.append(row)
        if motion is not None:
            graph.add_motions([(number - 1, number, motion)])
        if not self._localise:
            if number == self.first:
                self._store.add_session(graph.sessions[self._own])
            self._store.add_keyframe(row, features)
            if motion is not None:
                self._store.add_odometry(number - 1, number, motion)
        if keyframe.field is not None:
            self._correct(keyframe.field, features)
        features = features.without(self.graph.sessions[self._own].field)
        events = self._close_loops(number, features)
        if not self._localise:
            self.places.remember(self._camera, features)
            self._forget(graph.part == graph.part[number], np.floor(graph.T_map_cam[number][:3, 3]))
            if number % _SETTLING.commit_keyframes == 0:
                self.commit()
        return self._update(events, keyframe.rig_sigmas)

    def finish(self, field: DisplacementField | None = None) -> MapUpdate:
        """Optimise once more, write everything, and return the last correction.

        Args:
            field: what the session found its stereo calibration to be off by at its end: loops are
                measured again in pixels without it.
        """
        if field is not None and not self._localise and len(self.graph) > self.first:
            self._correct(field, None)
            if self._waiting:
                self._optimise()
            self._measure_again()
        if self._optimised or self._waiting:
            self._optimise(whole=True)
        if not self._optimised:
            own = slice(self.first, None)
            self.graph.T_map_cam.rows[own] = self.graph.T_odom_cam.rows[own]
            self._moved = True
        if self._density is not None and not self._localise:
            self._forget(np.ones(len(self.graph), dtype=np.bool_))
            self._store.clear_features(np.flatnonzero(~self.places.shows_something))
        self.commit()
        return self._update((), (0.0, 0.0))

    def commit(self) -> None:
        """Bring everything to the disk as one step."""
        if self._localise or len(self.graph) == self.first:
            return
        if self._moved:
            T = self.graph.T_map_cam.rows
            kept = [o.kept for o in self.graph.loops]
            before = len(self._stored_poses)
            moved = np.ones(len(T), dtype=np.bool_)
            moved[:before] = (T[:before] != self._stored_poses).any(axis=(1, 2))
            self._store.set_poses({k: T[k] for k in np.flatnonzero(moved).tolist()})
            known = dict(enumerate(self._stored_kept))
            self._store.set_kept({n: now for n, now in enumerate(kept) if now != known.get(n)})
            self._stored_poses = T.copy()
            self._stored_kept = kept
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
        """Go on from a checkpoint with the file as it was then: what was added since is
        forgotten.
        """
        self._store = store
        self._stored_poses = np.zeros((0, 4, 4))
        self._stored_kept = []
        graph = self.graph
        if not self._localise:
            store.truncate(len(graph.sessions), len(graph), len(graph.loops))
            self._moved = True
        self.places.reopen(store, self.first if self._localise else len(graph))

    def _correct(self, field: DisplacementField, features: KeyframeFeatures | None) -> None:
        """Take a newer estimate of the rectification error of this session, where it differs in a
        keyframe's features.

        All that was made of pixels before is forgotten.
        """
        sessions = self.graph.sessions
        own = self._own
        before = sessions[own].field
        if before is not None and features is not None:
            moved = (field.at(features.z) - before.at(features.z))[features.has_right]
            if not len(moved) or np.sqrt(np.mean(moved**2)) < _RIG.field_moved_px:
                return
        sessions[own] = replace(sessions[own], field=field)
        self.places.forget_pixels()

    def _forget(self, rows: BoolArray, cell: FloatArray | None = None) -> None:
        """Find no more what exceeds the density among keyframes (K,), of one cubic metre (3,) or
        of all.
        """
        if self._density is None:
            return
        graph = self.graph
        rows = rows & self.places.shows_something
        if cell is not None:
            rows &= (np.floor(graph.T_map_cam.rows[:, :3, 3]) == cell).all(axis=1)
        near = np.flatnonzero(rows)
        if len(near) > self._density:
            ends = [k for o in graph.loops if o.kept for k in (o.first, o.second)]
            loops = np.bincount(ends, minlength=len(graph))
            self.places.forget(
                near[~spread(graph.T_map_cam[near], graph.part[near], loops[near], self._density)]
            )

    def _measure_again(self) -> None:
        """Measure the loops of this session once more, from where the map has its keyframes now."""
        again = dict[int, LoopRow]()
        for n, loop in enumerate(self.graph.loops):
            if (
                loop.second >= self.first
                and (measured := self.places.measured_again(loop)) is not None
            ):
                again[n] = measured
                self.graph.set_loop(n, measured)
        self._waiting += len(again)
        self._store.set_loops(again)

    def _update(self, events: tuple[LoopEvent, ...], rig_sigmas: tuple[float, float]) -> MapUpdate:
        graph = self.graph
        k = len(self.graph) - 1
        if not self.is_joined:
            return MapUpdate(
                None, None, None, events, unconfirmed=any(o.second == k for o in self._pending)
            )
        if k < self.first:  # an empty map
            return MapUpdate(np.eye(4), None, np.zeros((6, 6)), events)
        T_map_odom = (
            graph.T_map_cam[k] @ se3_inverse(graph.T_odom_cam[k]) if self._optimised else np.eye(4)
        )
        if self.places.newest is None:
            T_map_cam = None
        else:
            T_map_cam = graph.T_map_cam[k].copy()
        return MapUpdate(T_map_odom, T_map_cam, self._covariance(k, rig_sigmas), events)

    def _covariance(self, k: int, rig_sigmas: tuple[float, float]) -> FloatArray:
        """Covariance (6, 6) of keyframe k: as last optimised, with the odometry since and the rig's
        errors, (G9).

        That by the newest loop alone, with the map as exact, where it says more than the odometry
        since (which may have begun anew).
        """
        graph = self.graph
        newest = self.places.newest
        by_loop = self.places.drift_since(
            np.array([self.first if newest is None else newest.first]), k
        )[0]
        if self._placed is None:
            return by_loop
        placed = self._placed
        T = graph.T_odom_cam
        since = (
            graph.odometry_scale
            * graph.drift(np.array([placed.keyframe]), np.array([k]), systematic=0.0)[0]
        )
        if since[:3, :3].trace() > by_loop[:3, :3].trace():
            return by_loop
        A = se3_adjoint(se3_inverse(T[k]) @ T[placed.keyframe])
        T_map_cam = graph.T_map_cam[k]
        d = np.append(
            rig_sigmas[0] * (T_map_cam[:3, 3] - placed.centre) @ T_map_cam[:3, :3], np.zeros(3)
        )
        axis = rig_sigmas[1] ** 2 * np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 0.0])
        return np.asarray(A @ placed.covariance @ A.T + since + np.outer(d, d) + axis)

    # Loops

    def _close_loops(self, number: int, features: KeyframeFeatures) -> tuple[LoopEvent, ...]:
        """Look for places seen again, and return what was accepted."""
        loop = self.places.find(number, features)
        if loop is None:
            return ()
        near = [o for o in self._pending if number - o.second <= CONFIRM_WITHIN]
        others = [o for o in near if agree(self.graph, o, loop)]
        self._pending = [*near, loop]
        if len(others) < loop.needed:
            return ()
        known = {(o.first, o.second) for o in self.graph.loops[-4 * CONFIRM_WITHIN :]}
        return tuple(self._accept(o) for o in [*others, loop] if (o.first, o.second) not in known)

    def _accept(self, loop: FoundPlace) -> LoopEvent:
        """Add a confirmed loop to the graph, and optimise where it moves the map."""
        graph = self.graph
        i = loop.first
        k = loop.second
        pose = loop.seen.pose
        joined = bool(graph.part[i] != graph.part[k])
        if joined:
            join_parts(graph, self._home, i, k, graph.T_map_cam[i] @ pose.T_i_j)
            self._placed = None
        r = se3_log(se3_inverse(graph.T_map_cam[k]) @ graph.T_map_cam[i] @ pose.T_i_j)
        if not joined and graph.session[i] == graph.session[k]:
            drift = graph.drift(np.array([i]), np.array([k]), systematic=0.0)[0]
            excess = squared(r, drift + pose.covariance) / GATE
            graph.odometry_scale = max(graph.odometry_scale, excess)
        row = LoopRow(i, k, pose, loop.seen.inliers, kept=True)
        graph.add_loops([row])
        if not self._localise:
            self._store.add_loop(row)
        self.places.newest = row
        self._moved = True
        self._waiting += 1
        settled = self._optimised and squared(r, pose.covariance) <= _SETTLING.settled_error
        if joined or not settled or self._waiting >= _SETTLING.waiting_loops:
            self._optimise()
        keyframe_frame = None
        if graph.session[i] == self._own:
            keyframe_frame = graph.frame(i)
        return LoopEvent(
            frame=graph.frame(k),
            time_ns=graph.time_ns(k),
            keyframe=i,
            keyframe_time_ns=graph.time_ns(i),
            inliers=row.inliers,
            gap_m=float(np.linalg.norm(r[:3])),
            joined=joined,
            keyframe_frame=keyframe_frame,
            matches=loop.seen.matches,
        )

    def _optimise(self, *, whole: bool = False) -> None:
        graph = self.graph
        part = self.graph.sessions[self._own].part
        own = graph.session == self._own
        stated = graph.T_map_cam.rows.copy()
        stays = graph.part == part
        # the frame is that of the map, whose keyframes are no more exact than it knows them
        if self._localise:
            stays &= ~own
        elif not self._optimised:  # until then the odometry's poses stood for those in the map
            alone = not (stays & ~own).any()
            stays, stated = (own, graph.T_odom_cam.rows.copy()) if alone else (stays & ~own, stated)
        if whole:
            graph.optimise_part(part)
        if whole or graph.optimise_near(part, self._waiting):
            graph.keep_place(part, stays, stated, level=whole)
            self._placed = None
        self._placed = graph.placed(part, stays, self._placed)
        if self.places.newest is not None and not self.graph.loops[-1].kept:
            self.places.newest = None
        self._waiting = 0
        self._moved = True
        self._optimised = True


def agree(graph: MapGraph, a: FoundPlace, b: FoundPlace) -> bool:
    """Whether two loops, of which b is the later one, say the same of where their session is in
    the map.
    """
    if graph.part[a.first] != graph.part[b.first]:
        return False
    T = graph.T_map_cam
    T_second = se3_inverse(T[a.second]) @ T[b.second]
    r = se3_log(
        se3_inverse(T[a.first] @ a.seen.pose.T_i_j @ T_second) @ T[b.first] @ b.seen.pose.T_i_j
    )
    A = se3_adjoint(se3_inverse(T_second))
    C = A @ a.seen.pose.covariance @ A.T + b.seen.pose.covariance
    C = C + graph.drift(np.array([a.second]), np.array([b.second]))[0]
    apart_m = abs(graph.path_m[a.first] - graph.path_m[b.first])
    if graph.session[a.first] == graph.session[b.first] and apart_m < _SETTLING.neighbours_m:
        C = C + graph.drift(np.array([a.first]), np.array([b.first]))[0]
    return squared(r, C) < GATE


def join_parts(graph: MapGraph, home: int, i: int, k: int, T_map_k: FloatArray) -> None:
    """Bring the parts of keyframes i and k into one frame: that of part `home`, if one of them is
    in it, or that of i.

    Args:
        graph: their map.
        home: the part whose frame is the map's.
        i: a keyframe.
        k: another one.
        T_map_k: (4, 4) pose of k in the frame of i.
    """
    part = graph.part
    T = T_map_k @ se3_inverse(graph.T_map_cam[k])
    if part[k] == home:
        graph.join(int(part[i]), int(part[k]), se3_inverse(T))
    else:
        graph.join(int(part[k]), int(part[i]), T)
