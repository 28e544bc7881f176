"""All keyframes of a map with their poses, the odometry between them, and the loops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from vio.geometry.lie import (
    FloatArray,
    nearest_rotation,
    se3_adjoint,
    se3_from_parts,
    se3_inverse,
    so3_exp,
)
from vio.geometry.relative_pose import RelativePose
from vio.geometry.upright import mean_up, nearest_yaw, rotation_to_up
from vio.mapping.map_store import KeyframeRow, LoopRow, MapStore, SessionRow
from vio.mapping.pose_graph import Edges, UpDirections, marginals, optimise
from vio.numerics.kinds import Capacity, Tolerance
from vio.records import BoolArray, IntArray

# What the odometry may be off by beyond its own covariance, since errors of the calibration add up
# along the path: 1 % and 0.5 deg/100 m; peers reach 1.2 % and 0.3 deg/100 m with stereo on KITTI.
_DRIFT_SHARE = 0.01
_DRIFT_RAD_PER_M = float(np.radians(0.005))


@dataclass(frozen=True, slots=True)
class _GraphRules:
    """How many keyframes take part in an optimisation."""

    # of the search for them, in mean variances of a motion; and from try to try
    first_reach: Capacity[float] = 30.0
    further: Capacity[float] = 2.0
    max_exact: Capacity[int] = (
        200  # keyframes whose covariance is computed, beside the first of each session
    )
    min_variance_m2: Tolerance[float] = 1e-8  # of a keyframe's position since its session began


_GRAPH = _GraphRules()
_WINDOW: Capacity[int] = (
    1000  # keyframes that are optimised for a new loop, beside those of its cycle
)
# variance of the motion from one session to the next, m^2 and rad^2: nothing is known of it
UNKNOWN: Tolerance[float] = 1e6


class Rows:
    """An array that grows along its first axis."""

    def __init__(self, *shape: int) -> None:
        self._data: FloatArray = np.zeros((64, *shape))
        self._size = 0

    def append(self, row: npt.ArrayLike) -> None:
        """Add a row."""
        self.extend([row])

    def extend(self, rows: Sequence[npt.ArrayLike] | npt.NDArray[Any]) -> None:
        """Add rows."""
        end = self._size + len(rows)
        while end > len(self._data):
            self._data = np.concatenate([self._data, np.zeros_like(self._data)])
        if len(rows):
            self._data[self._size : end] = np.asarray(rows)
        self._size = end

    @property
    def rows(self) -> FloatArray:
        """All rows, to be read and written."""
        return self._data[: self._size]

    def __getitem__(self, index: int | slice | IntArray | tuple[slice, int | slice]) -> FloatArray:
        return self.rows[index]


@dataclass(frozen=True, slots=True)
class Placed:
    """How well a keyframe is known after an optimisation, in the frame in which the map stands
    on average.
    """

    keyframe: int
    covariance: FloatArray  # (6, 6) of xi in T_map_cam = T_hat exp(xi)
    centre: FloatArray  # (3,) of the map, in it: from there a wrong scale moves all that it holds
    computed_for: int  # the keyframe for which the covariance was computed


class MapGraph:
    """Sessions, keyframes, odometry and loops; keyframes are numbered in the order in which they
    came.
    """

    def __init__(self, store: MapStore) -> None:
        self.sessions: list[SessionRow] = store.sessions()
        self.T_map_cam = Rows(4, 4)
        self.T_odom_cam = Rows(4, 4)
        self._drift = Rows(6, 6)
        self.path_m = Rows()
        self._session = Rows()
        self._frame = Rows()
        self._times: list[int] = []  # ns; too large for float64
        self._ups: list[tuple[int, FloatArray, float]] = []
        self._T_motion = Rows(4, 4)  # of the odometry, with its covariance
        self._C_motion = Rows(6, 6)
        # of each of them: its keyframes, and the variance of its position, m^2
        self._links = Rows(3)
        self.add_motions(store.odometry())
        self.loops: list[LoopRow] = []
        self._loop_links = Rows(3)  # of each loop, likewise
        self.add_loops(store.loops())
        self.odometry_scale = 1.0  # on the covariance of the odometry, so that the loops fit to it
        self.extend(store.keyframes())

    def __len__(self) -> int:
        return len(self.path_m.rows)

    @property
    def session(self) -> IntArray:
        """Session (K,) of each keyframe."""
        return self._session.rows.astype(np.int64)

    @property
    def part(self) -> IntArray:
        """Part (K,) of the map that each keyframe is in; loops join parts."""
        return np.array([s.part for s in self.sessions], dtype=np.int64)[self.session]

    def frame(self, keyframe: int) -> int:
        """Frame number of a keyframe in its recording."""
        return int(self._frame.rows[keyframe])

    def time_ns(self, keyframe: int) -> int:
        """Time of a keyframe."""
        return self._times[keyframe]

    def append(self, row: KeyframeRow) -> None:
        """Add a keyframe."""
        self.extend([row])

    def extend(self, rows: Sequence[KeyframeRow]) -> None:
        """Add keyframes."""
        self._ups += [
            (k, row.up_cam, row.up_sigma_rad)
            for k, row in enumerate(rows, len(self))
            if row.up_cam is not None
        ]
        self.T_map_cam.extend([row.T_map_cam for row in rows])
        self.T_odom_cam.extend([row.T_odom_cam for row in rows])
        self._drift.extend([row.drift for row in rows])
        self.path_m.extend([row.path_m for row in rows])
        self._session.extend([row.session for row in rows])
        self._frame.extend([row.frame for row in rows])
        self._times += [row.time_ns for row in rows]

    def add_motions(self, motions: Sequence[tuple[int, int, RelativePose]]) -> None:
        """Add what the odometry says of motions between two keyframes each."""
        self._T_motion.extend([motion.T_i_j for _, _, motion in motions])
        self._C_motion.extend([motion.covariance for _, _, motion in motions])
        self._links.extend(_links(motions))

    def add_loops(self, rows: Sequence[LoopRow]) -> None:
        """Add loops."""
        self.loops += rows
        self._loop_links.extend(_links([(o.first, o.second, o.pose) for o in rows]))

    def set_loop(self, number: int, row: LoopRow) -> None:
        """Replace a loop by a newer measurement of it."""
        self.loops[number] = row
        self._loop_links.rows[[number]] = _links([(row.first, row.second, row.pose)])

    def gathered(
        self, T_odom_cam: FloatArray, motion: RelativePose | None
    ) -> tuple[FloatArray, float]:
        """Return the covariance (6, 6) and the path that the odometry has gathered at a new
        keyframe since its session began; no motion: it begins.

        The covariance is that of right-invariant errors, which add up:
        `xi_k = xi_i + Ad(T_k) xi_i_k`. What other sessions have gathered is not part of the sum, as
        its digits would be missing in the differences.
        """
        if motion is None:
            return np.zeros((6, 6)), 0.0
        A = se3_adjoint(T_odom_cam)
        moved = float(np.linalg.norm(motion.T_i_j[:3, 3]))
        return self._drift.rows[-1] + A @ motion.covariance @ A.T, float(
            self.path_m.rows[-1]
        ) + moved

    def drift(self, i: IntArray, k: IntArray, *, systematic: float = 1.0) -> FloatArray:
        """Covariance (N, 6, 6) of the motion between keyframes i and k (N,) along the path, in the
        frame of the later; `UNKNOWN` from one session to another.

        Args:
            i: keyframes.
            k: keyframes.
            systematic: share that is added of what errors of the calibration may do.
        """
        late = np.maximum(i, k)
        early = np.minimum(i, k)
        A = se3_adjoint(se3_inverse(self.T_odom_cam[late]))
        between = self._drift[late] - self._drift[early]
        C: FloatArray = A @ between @ np.swapaxes(A, 1, 2)
        session = self.session
        C[session[late] != session[early]] = UNKNOWN * np.eye(6)
        if systematic:
            path = (self.path_m[late] - self.path_m[early])[:, None]
            sigma = systematic * path * np.repeat([_DRIFT_SHARE, _DRIFT_RAD_PER_M], 3)
            C = C + sigma[:, :, None] ** 2 * np.eye(6)
        return C

    def motions(self, origin: int, rows: IntArray) -> list[RelativePose]:
        """Return where keyframes (N,) are in the frame of another one by the map, with the
        covariance of the odometry in between.
        """
        T = se3_inverse(self.T_map_cam[origin]) @ self.T_map_cam[rows]
        C = self.drift(np.full(len(rows), origin), rows, systematic=0.0)
        A = se3_adjoint(se3_inverse(T))
        A[rows >= origin] = np.eye(6)  # `drift` is in the frame of the later one
        C = A @ C @ np.swapaxes(A, 1, 2)
        return [RelativePose(T[n], C[n]) for n in range(len(rows))]

    def join(self, moved: int, into: int, T_into_moved: FloatArray) -> None:
        """Take the keyframes of one part into the frame of another."""
        rows = self.part == moved
        self.T_map_cam.rows[rows] = T_into_moved @ self.T_map_cam.rows[rows]
        self.sessions = [replace(s, part=into) if s.part == moved else s for s in self.sessions]

    def optimise_part(self, part: int) -> None:
        """Optimise all keyframes of a part; of the first one of a connected component, roll and
        pitch alone at most.

        What the filter took for the vertical at its first frame is less exact than what it knows of
        it later.
        """
        rows = self.part == part
        self._optimise(rows, np.zeros(len(self), dtype=np.bool_), level=True)

    def optimise_near(self, part: int, newest: int) -> bool:
        """Optimise what the newest loops move most; keyframes around it stay, as anchors.

        A loop closes a cycle with what was known before. The keyframes of the shortest one, by the
        variance of its motions, carry most of what it corrects, and others the less the longer the
        way by them.

        Args:
            part: of the loops.
            newest: number of loops that no optimisation has seen, at least one.

        Returns:
            Whether that is the whole part.
        """
        rows = self.part == part
        if int(rows.sum()) <= _WINDOW:
            self.optimise_part(part)
            return True
        free = np.zeros(len(self), dtype=np.bool_)
        kept = np.array([o.kept for o in self.loops[:-newest]], dtype=np.bool_)
        known = self._linked(self._loop_links[:-newest][kept])
        free[_nearest(known, self.loops[-newest:], rows)] = True
        free[int(np.argmax(rows))] = False
        pairs = self._linked(self._loop_links.rows)
        around = (pairs + pairs.T) @ free.astype(np.float64) > 0
        self._optimise(free | around, around & ~free)
        return False

    def keep_place(self, part: int, stays: BoolArray, T_before: FloatArray, *, level: bool) -> None:
        """Move and turn the frame of a part as a whole, so that keyframes stand on average where
        they stood: (G7).

        Args:
            part: of the map.
            stays: (K,) keyframes of it.
            T_before: (K, 4, 4) poses of all keyframes, those of `stays` where they should stand.
            level: turn about the vertical alone, where z is up.
        """
        rows = self.part == part
        w = self.frame_weights(stays)[stays]
        T = self.T_map_cam.rows[stays]
        B = T_before[stays]
        p = w @ T[:, :3, 3]
        q = w @ B[:, :3, 3]
        from_q = B[:, :3, 3] - q
        from_p = T[:, :3, 3] - p
        M = np.einsum("k,ki,kj->ij", w, from_q, from_p)
        # directions, which a straight path leaves open
        M += np.einsum("k,kia,kja->ij", w, B[:, :3, :3], T[:, :3, :3])
        if level and self._is_upright(rows):
            R = so3_exp(np.array([0.0, 0.0, nearest_yaw(M)]))
        else:
            R = nearest_rotation(M)
        self.T_map_cam.rows[rows] = se3_from_parts(R, q - R @ p) @ self.T_map_cam.rows[rows]

    def frame_weights(self, stays: BoolArray) -> FloatArray:
        """Weights (K,) by which the frame is that of keyframes `stays` (K,), w in (G7); their
        sum is 1.
        """
        numbers = np.flatnonzero(stays)
        session = self.session
        begins = np.unique(session, return_index=True)[1][session[numbers]]
        variance = np.trace(
            self.drift(begins, numbers, systematic=0.0)[:, :3, :3], axis1=1, axis2=2
        )
        w = np.zeros(len(self))
        w[numbers] = 1.0 / (variance + np.median(variance) + _GRAPH.min_variance_m2)
        return w / w.sum()

    def placed(self, part: int, stays: BoolArray, before: Placed | None) -> Placed:
        """Return how well the newest keyframe, of a part, is known in the frame of keyframes
        `stays` (K,).

        What that costs grows with the map. So, after what is around the newest loops was optimised
        alone, the keyframe is taken to be known as well as the one before at which loops were, for
        as many keyframes as the part has thousands, unless the odometry between the two says less
        than the newest loop, (G10).

        Args:
            part: of the keyframe.
            stays: keyframes that define the frame.
            before: how well the one before is known; None: how well the newest one is, is computed.
        """
        rows = self.part == part
        newest = len(self) - 1
        count = int(rows.sum())
        if before is not None and (newest - before.computed_for) * _WINDOW < count:
            loop = self.loops[-1]
            if not loop.kept:
                return before
            since = self.drift(np.array([before.keyframe]), np.array([newest]), systematic=0.0)[0]
            if self.odometry_scale * since[:3, :3].trace() < loop.pose.covariance[:3, :3].trace():
                R_newest = self.T_map_cam[newest][:3, :3]
                R_before = self.T_map_cam[before.keyframe][:3, :3]
                R = R_newest.T @ R_before
                A = np.kron(np.eye(2), R)
                return replace(before, keyframe=newest, covariance=A @ before.covariance @ A.T)
        w = self.frame_weights(stays)
        P = self._marginals(rows, np.array([count - 1]), frame=w[rows])[0]
        return Placed(newest, P, w @ self.T_map_cam.rows[:, :3, 3], newest)

    def covariances(self, part: int) -> FloatArray:
        """Covariances (K, 6, 6) of xi in `T_map_cam exp(xi)` of the keyframes of a part, relative
        to its first one.

        Of many, those of some: the others have that of one before them, grown by the odometry
        since.
        """
        rows = self.part == part
        numbers = np.flatnonzero(rows)
        if not len(numbers):
            return np.zeros((0, 6, 6))
        begins = np.unique(self.session[numbers], return_index=True)[1]
        few = np.linspace(0, len(numbers) - 1, min(_GRAPH.max_exact, len(numbers))).astype(np.int64)
        exact = np.union1d(begins, few)
        P = self._marginals(rows, exact)
        T = self.T_map_cam.rows[rows]
        before = np.searchsorted(exact, np.arange(len(T)), side="right") - 1
        i = exact[before]
        A = se3_adjoint(se3_inverse(T) @ T[i])
        grown = self.odometry_scale * self.drift(numbers[i], numbers, systematic=0.0)
        return np.asarray(A @ P[before] @ np.swapaxes(A, 1, 2) + grown)

    def _marginals(
        self, rows: BoolArray, poses: IntArray, frame: FloatArray | None = None
    ) -> FloatArray:
        """Return `marginals` of some of the keyframes of a mask (K,), by their places among
        them.
        """
        inside = [
            n for n, o in enumerate(self.loops) if o.kept and rows[o.first] and rows[o.second]
        ]
        ups = self._up_directions(rows)
        T = self.T_map_cam.rows[rows]
        fixed = np.zeros(len(T), dtype=np.bool_)
        levelled = 0 if len(ups.pose) else None
        return marginals(
            T, *self._edges(rows, inside), ups, fixed, poses, levelled=levelled, frame=frame
        )

    def _linked(self, loops: FloatArray) -> coo_matrix:
        """Return the variances of the motions (K, K) between keyframes, by the odometry and by
        loops (L, 3).
        """
        first, second, variance = np.concatenate([self._links.rows, loops]).T
        ends = first.astype(np.int64), second.astype(np.int64)
        return coo_matrix((variance, ends), shape=(len(self), len(self))).tocsr()

    def _optimise(self, rows: BoolArray, fixed: BoolArray, *, level: bool = False) -> None:
        """Optimise the keyframes of a mask (K,); mark the loops that contradict the rest.

        Args:
            rows: keyframes.
            fixed: (K,) those of them that stay.
            level: let the roll and pitch of the first one follow the verticals, if there are any.
        """
        inside = [n for n, o in enumerate(self.loops) if rows[o.first] and rows[o.second]]
        up_directions = self._up_directions(rows)
        T_upright_map = se3_from_parts(self._level_of(fixed), np.zeros(3))
        levelled = None
        if level and len(up_directions.pose):
            levelled = 0
        best = optimise(
            T_upright_map @ self.T_map_cam.rows[rows],
            *self._edges(rows, inside),
            up_directions,
            fixed[rows],
            levelled=levelled,
        )
        self.T_map_cam.rows[rows] = se3_inverse(T_upright_map) @ best.T_map_cam
        for n, kept in zip(inside, best.kept.tolist(), strict=True):
            self.loops[n] = replace(self.loops[n], kept=kept)

    def _edges(self, rows: BoolArray, inside: Sequence[int]) -> tuple[Edges, Edges]:
        """Return the odometry between the keyframes of a mask (K,), and some loops, by their
        places among them.
        """
        place = np.cumsum(rows) - 1
        ends = self._links.rows[:, :2].astype(np.int64)
        near = np.flatnonzero(rows[ends].all(axis=1))
        information = np.asarray(
            np.linalg.inv(self.odometry_scale * self._C_motion[near]), dtype=np.float64
        )
        odometry = Edges(
            place[ends[near, 0]], place[ends[near, 1]], self._T_motion[near], information
        )
        loops = [
            (int(place[o.first]), int(place[o.second]), o.pose)
            for o in (self.loops[n] for n in inside)
        ]
        return odometry, Edges.of(loops)

    def _up_directions(self, rows: BoolArray) -> UpDirections:
        place = np.cumsum(rows) - 1
        ups = []
        if self._is_upright(rows):
            ups = [up for up in self._ups if rows[up[0]]]
        return UpDirections(
            np.array([place[k] for k, _, _ in ups], dtype=np.int64),
            np.array([up for _, up, _ in ups]).reshape(-1, 3),
            np.array([sigma for _, _, sigma in ups]),
        )

    def _level_of(self, fixed: BoolArray) -> FloatArray:
        """Rotation (3, 3) that turns up the mean vertical of keyframes that stay; the identity
        where they say nothing.

        Until a part is optimised as a whole, its frame is that of its odometry, whose first seconds
        may have been wrong about the vertical.
        """
        ups = [(self.T_map_cam[k][:3, :3] @ up, sigma) for k, up, sigma in self._ups if fixed[k]]
        if not ups or not self._is_upright(fixed):
            return np.eye(3)
        up, sigma = (np.array(values) for values in zip(*ups, strict=True))
        return rotation_to_up(mean_up(up, sigma))

    def _is_upright(self, rows: BoolArray) -> bool:
        """Whether z is up in the frame of these keyframes: it is that of the first one's
        session.
        """
        return self.sessions[int(self._session.rows[int(np.argmax(rows))])].upright


def _links(motions: Sequence[tuple[int, int, RelativePose]]) -> FloatArray:
    """Return the keyframes of motions and the variances of their positions (M, 3)."""
    covariances = [motion.covariance for _, _, motion in motions]
    variance = [P[0, 0] + P[1, 1] + P[2, 2] for P in covariances]
    return np.array([(i, j, v) for (i, j, _), v in zip(motions, variance, strict=True)]).reshape(
        -1, 3
    )


def _nearest(links: coo_matrix, new: Sequence[LoopRow], rows: BoolArray) -> IntArray:
    """Return the keyframes of the shortest cycles that new loops close, and those with the smallest
    detour from them.

    The search goes no further than it must, since it holds the interpreter: what lies beyond
    `reach` of an end has a detour of more than `2 (reach - least)`, where `least` is the length of
    the cycle.

    Args:
        links: (K, K) variances of the motions known before.
        new: the loops.
        rows: (K,) keyframes that may be taken.
    """
    ends = [k for o in new for k in (o.first, o.second)]
    reach = _GRAPH.first_reach * float(links.data.mean())
    both = (links + links.T).tocsr()
    while True:
        away = np.stack([dijkstra(both, indices=k, limit=reach) for k in ends])
        # (L, K) length of the shortest cycle of each loop by each keyframe
        cycle = away[::2] + away[1::2]
        least = cycle.min(axis=1, keepdims=True)
        # others are of two pieces, which the loops are the first to join
        joined = np.isfinite(least[:, 0])
        detour = np.where(joined[:, None], cycle, np.minimum(away[::2], away[1::2]))
        detour[joined] -= least[joined]
        nearest = np.where(rows, detour.min(axis=0), np.inf)
        on_cycle = int((detour[joined] <= 1e-9 * least[joined]).any(axis=0).sum())
        chosen = np.argsort(nearest, kind="stable")[: _WINDOW + on_cycle]
        if reach == np.inf or (
            joined.all() and nearest[chosen[-1]] <= 2 * (reach - float(least.max()))
        ):
            return chosen[np.isfinite(nearest[chosen])]
        if reach < links.data.sum():
            reach = _GRAPH.further * reach
        else:
            reach = np.inf
