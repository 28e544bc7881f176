"""Two maps made into one: the later one is added as it is, and the first one's places are looked
for in its keyframes.

Each keyframe is looked for in the first map alone, so that the search divides over processes and
its result is the same however many there are: first where nothing is known of where the maps lie,
then, where places were found, once more with what they say.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from vio.errors import DataError, VioError
from vio.geometry.lie import se3_adjoint, se3_inverse, se3_log
from vio.mapping.builder import CONFIRM_WITHIN, agree, check_sessions, join_parts
from vio.mapping.files import describe_map, new_map
from vio.mapping.map_database import check_path
from vio.mapping.map_graph import MapGraph
from vio.mapping.map_store import LoopRow, MapStore
from vio.mapping.place_finder import FoundPlace, PlaceFinder
from vio.numerics.threads import start_worker
from vio.records import IntArray

log = logging.getLogger(__name__)

_ROUNDS = 2  # of the search; the second knows where the maps lie
_Map: TypeAlias = Callable[
    [Callable[[IntArray], list[FoundPlace]], Iterable[IntArray]], Iterable[list[FoundPlace]]
]


def merge_maps(first: Path, second: Path, out: Path, *, workers: int = 1) -> dict[str, Any]:
    """Write a map that holds the sessions of two, joined where they show one place; return what it
    holds.

    Nothing is written where they hold the same recording, or show no place in common. Motions and
    loops of both stay as they are; places of the map recorded first are looked for in the keyframes
    of the other one, and all poses optimised with them. The order of the two does not matter: the
    frame is that of the map recorded first. Where only the other one is on the earth, its place is
    brought into that frame; of two places, that of the frame's map is kept.

    Args:
        first: a map.
        second: another one.
        out: a new file.
        workers: processes that search; the result is the same with any number.

    Raises:
        DataError: a file is no map, both hold the same recording or no common place, or `out`
            exists or cannot be written.
        VioError: a process ended unexpectedly.
    """
    if out.exists():
        raise DataError(f"{out}: exists; give another name for the merged map")
    check_path(out)
    if first.exists() and second.exists() and first.samefile(second):
        raise DataError(f"{second}: is the same map as {first}; give two different ones")
    first, second = sorted((first, second), key=_begin)
    with new_map(out) as written:
        source = MapStore(first, read_only=True)
        source.copy_to(written, known_as=out)
        source.close()
        other = MapStore(second, read_only=True)
        store = MapStore(written, known_as=out)
        with contextlib.closing(other), contextlib.closing(store):
            if shared := len(store.images() & other.images()):
                raise DataError(
                    f"{second}: {shared} of its keyframes are in {first} already: both hold one "
                    "recording; "
                    "vio map drop takes a session out of one"
                )
            before = len(store.keyframes())
            _append(other, store, first)
            if not _Merge(store, before).join(written, workers):
                raise DataError(
                    f"{second}: shows no place of {first}; keep two maps, or record a way between "
                    "them"
                )
            _merge_earth(store, other)
    return describe_map(out)


def _begin(path: Path) -> tuple[Any, ...]:
    """What orders two maps: one whose z is up first, then by the time of the first keyframe,
    then by its features.
    """
    store = MapStore(path, read_only=True)
    with contextlib.closing(store):
        sessions = store.sessions()
        keyframes = store.keyframes()
        if not keyframes:
            return True, 0, 0, b""
        seen = store.features(0)
        return (
            not sessions[0].upright,
            keyframes[0].time_ns,
            len(keyframes),
            seen.descriptors.tobytes(),
        )


def _append(other: MapStore, store: MapStore, first: Path) -> None:
    """Add all that a map holds to another one, a copy of the first, in parts of its own."""
    sessions = len(store.sessions())
    rows = store.keyframes()
    loops = other.loops()
    for session in other.sessions():
        check_sessions(store, session.camera, f"{other.path}", place=first)
        store.add_session(replace(session, part=session.part + sessions))
    for k, row in enumerate(other.keyframes()):
        store.add_keyframe(replace(row, session=row.session + sessions), other.features(k))
    for i, j, motion in other.odometry():
        store.add_odometry(len(rows) + i, len(rows) + j, motion)
    for loop in loops:
        store.add_loop(replace(loop, first=len(rows) + loop.first, second=len(rows) + loop.second))
    store.commit()


class _Merge:
    """Joins the keyframes of a map from `before` on to those before, in its file."""

    def __init__(self, store: MapStore, before: int) -> None:
        self._store = store
        self._before = before
        self._graph = MapGraph(store)
        shows = store.show_something()
        # of the keyframes that show something, by which neighbours are counted
        self._order = np.cumsum(shows)
        self._rows = before + np.flatnonzero(shows[before:])
        self._session = self._graph.session
        self._found: list[FoundPlace] = []  # accepted

    def join(self, path: Path, workers: int) -> bool:
        """Look for places, and optimise with them; return whether there are any.

        Args:
            path: the file.
            workers: processes that search.
        """
        with contextlib.ExitStack() as stack:
            each: _Map = map
            if workers > 1:  # not threads, which would share one interpreter
                pool = ProcessPoolExecutor(
                    workers, multiprocessing.get_context("spawn"), start_worker
                )
                each = stack.enter_context(pool).map
            try:
                self._look(
                    partial(places_found, path, self._store.path, self._before), each, workers
                )
            except BrokenProcessPool as error:
                fault = f"{self._store.path}: a process that searches ended unexpectedly; try fewer workers"
                raise VioError(fault) from error
        if self._found:  # writes what finds the keyframes again
            graph = self._graph
            own = len(self._graph.sessions) - 1
            PlaceFinder(self._store, graph, graph.sessions[own].camera, own, writes=True)
        return bool(self._found)

    def _look(self, search: Callable[[IntArray], list[FoundPlace]], each: _Map, parts: int) -> None:
        """Search in rounds, and optimise after each, until nothing new is found."""
        left = self._rows
        for _ in range(_ROUNDS):
            found = [
                *self._found,
                *(place for part in each(search, np.array_split(left, parts)) for place in part),
            ]
            known = {o.second for o in self._found}
            new = self._accepted([o for o in self._confirmed(found) if o.second not in known])
            if not new:
                break
            self._optimise(new)
            self._found += new
            seen = np.array([o.second for o in self._found])
            joined = np.isin(self._session[self._rows], self._session[seen])
            left = self._rows[joined & ~np.isin(self._rows, seen)]

    def _confirmed(self, found: Sequence[FoundPlace]) -> list[FoundPlace]:
        """Return the places that other keyframes confirm, before or after them."""
        found = sorted(found, key=lambda o: o.second)
        out = list[FoundPlace]()
        for n, place in enumerate(found):  # one a keyframe
            near = found[max(n - CONFIRM_WITHIN, 0) : n + CONFIRM_WITHIN + 1]
            others = [
                o
                for o in near
                if o is not place and self._confirms(*sorted((o, place), key=lambda p: p.second))
            ]
            if len(others) >= min(o.needed for o in (place, *others)):
                out.append(place)
        return out

    def _confirms(self, a: FoundPlace, b: FoundPlace) -> bool:
        near = self._order[b.second] - self._order[a.second] <= CONFIRM_WITHIN
        return bool(
            near and self._session[a.second] == self._session[b.second] and agree(self._graph, a, b)
        )

    def _accepted(self, found: Sequence[FoundPlace]) -> list[FoundPlace]:
        """Join the parts of the map by the surest places; return those that agree with them, in
        their order.
        """
        graph = self._graph
        out = list[FoundPlace]()
        own = len(self._graph.sessions) - 1
        finder = PlaceFinder(
            self._store, graph, graph.sessions[own].camera, own, writes=False, most=0
        )
        for place in sorted(found, key=lambda o: -o.seen.inliers):
            i = place.first
            k = place.second
            if graph.part[i] != graph.part[k]:
                join_parts(
                    graph, graph.sessions[0].part, i, k, graph.T_map_cam[i] @ place.seen.pose.T_i_j
                )
            else:
                finder.newest = _nearest(
                    graph, self._session, [_loop(o) for o in [*self._found, *out]], k
                )
                if not finder.fits(i, k, place.seen, finder.drift_since(np.array([i]), k)[0]):
                    continue
            out.append(place)
        return sorted(out, key=lambda o: o.second)

    def _optimise(self, new: Sequence[FoundPlace]) -> None:
        """Add loops, optimise the parts that have them, and write poses, loops and parts."""
        graph = self._graph
        store = self._store
        rows = [_loop(o) for o in new]
        graph.add_loops(rows)
        for row in rows:
            store.add_loop(row)
        for part in sorted({int(graph.part[o.first]) for o in new}):
            stated = graph.T_map_cam.rows.copy()
            graph.optimise_part(part)
            stays = (graph.part == part) & (np.arange(len(graph)) < self._before)
            graph.keep_place(part, stays, stated, level=True)
        store.set_poses(dict(enumerate(graph.T_map_cam.rows)))
        store.set_kept({n: o.kept for n, o in enumerate(graph.loops)})
        store.set_parts([s.part for s in graph.sessions])
        store.commit()


def _loop(place: FoundPlace) -> LoopRow:
    return LoopRow(place.first, place.second, place.seen.pose, place.seen.inliers, kept=True)


def _nearest(
    graph: MapGraph, session: IntArray, loops: Sequence[LoopRow], k: int
) -> LoopRow | None:
    """Return the loop whose later keyframe is closest to keyframe k along the path of its
    session, of (K,).
    """
    own = [o for o in loops if session[o.second] == session[k]]
    return min(own, key=lambda o: abs(graph.path_m[o.second] - graph.path_m[k]), default=None)


def places_found(path: Path, known_as: Path, before: int, rows: IntArray) -> list[FoundPlace]:
    """Return the places among the first `before` keyframes of a map that others (N,) show, one a
    keyframe at most.

    Args:
        path: the map's file.
        known_as: what messages call it.
        before: number of keyframes that may be found.
        rows: later keyframes, increasing.

    Raises:
        DataError: the file cannot be used.
    """
    out = list[FoundPlace]()
    finders = dict[int, PlaceFinder]()
    with contextlib.closing(MapStore(path, read_only=True, known_as=known_as)) as store:
        graph = MapGraph(store)
        session = graph.session
        loops = [o for o in graph.loops if o.kept and o.first < before <= o.second]
        for k in rows.tolist():
            own = int(session[k])
            if own not in finders:
                camera = graph.sessions[own].camera
                finders[own] = PlaceFinder(store, graph, camera, own, writes=False, most=before)
            finder = finders[own]
            finder.newest = _nearest(graph, session, loops, k)
            place = finder.find(k, finder.features(k))
            if place is not None:
                out.append(place)
    return out


def _merge_earth(store: MapStore, other: MapStore) -> None:
    """Give a merged map the place on the earth of the map that was taken up, where it has none of
    its own.

    Each keyframe k of both says how the frames lie, `T_store_k T_other_k^-1`. That of the one in
    the middle is taken, and the mean square of the others' difference from it is added to the
    covariance.

    Args:
        store: the merged map.
        other: the map that was taken up; its keyframes are the last ones of the merged map.
    """
    earth = other.earth()
    if earth is None:
        return
    if store.earth() is not None:
        log.warning(
            "%s: both maps are on the earth; the place of that recorded first is kept", store.path
        )
        return
    rows = store.keyframes()
    before = other.keyframes()
    sessions = store.sessions()
    home = sessions[0].part
    home_before = other.sessions()[0].part
    parts = [s.part for s in other.sessions()]
    pairs = [
        (now.T_map_cam, row.T_map_cam)
        for now, row in zip(rows[len(rows) - len(before) :], before, strict=True)
        if sessions[now.session].part == home and parts[row.session] == home_before
    ]
    if not pairs:
        log.warning(
            "%s: what was on the earth is not joined to the first session; its place is left out",
            store.path,
        )
        return
    T_now, T_before = (np.array(T) for T in zip(*pairs, strict=True))
    middle = int(
        np.argmin(np.linalg.norm(T_now[:, :3, 3] - np.median(T_now[:, :3, 3], axis=0), axis=1))
    )
    T_other_store = T_before @ se3_inverse(T_now)
    # In the frame of the keyframe in the middle, in which a rotation moves least.
    xi = se3_log(
        se3_inverse(T_now[middle])
        @ se3_inverse(T_other_store[middle])
        @ T_other_store
        @ T_now[middle]
    )
    A = se3_adjoint(se3_inverse(T_other_store[middle]))
    B = se3_adjoint(T_now[middle])
    scatter = xi.T @ xi / len(xi)
    covariance = A @ earth.covariance @ A.T + B @ scatter @ B.T
    store.set_earth(
        replace(earth, T_enu_map=earth.T_enu_map @ T_other_store[middle], covariance=covariance)
    )
