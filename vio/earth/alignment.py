"""A trajectory on the earth: GNSS positions as factors on the graph of its poses, with a robust
loss.

The unknowns are the poses in east, north, up at an origin, and the logarithm of the scale. Motions
between neighbours (and across loops) are those of the finished trajectory, which itself never
changes. A position by GNSS measures the antenna between two poses; its horizontal and its vertical
part are decided on apart, by truncated least squares with graduated non-convexity (Yang et al.,
2020), so that jumps and wrong heights end with weight zero. Equations (E1) to (E4) of docs/math.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix

from vio.datasets.gnss_fixes import GnssFixes
from vio.earth.geodesy import LocalFrame
from vio.errors import EstimationError
from vio.files.epochs import epoch_hint
from vio.geometry.lie import (
    FloatArray,
    se3_adjoint,
    se3_exp,
    se3_from_parts,
    se3_inverse,
    se3_left_jacobian,
    se3_log,
    so3_hat,
)
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import CUT_OFF_PROBABILITY, MU_GROWTH, truncated_weights
from vio.numerics.sparse import factors
from vio.numerics.statistics import chi_square_quantile
from vio.records import BoolArray, IntArray


@dataclass(frozen=True, slots=True)
class _AlignmentRules:
    """How a trajectory is fitted to GNSS positions."""

    # What odometry drifts by between neighbours beyond its scale: 0.2 m and 0.3 deg over 100 m, as
    # random walks.
    drift_m: float = 0.02  # per square root of a metre
    min_m: Tolerance[float] = 1e-3  # of a motion at standstill
    min_rad: Tolerance[float] = 1e-5
    correlated_s: float = 5.0  # errors of GNSS last: positions within it count as one
    # of the antenna beside the stated error: 10 ms of the clocks at 10 m/s, the lever arm
    timing_m: float = 0.1
    max_steps: Tolerance[int] = 40
    settled: Tolerance[float] = 1e-5
    start_steps: Tolerance[int] = 20  # of the robust alignment that it starts from
    min_fixes: int = 3
    max_extents: float = 1.25  # of the spreads of positions and trajectory: beyond, they are others
    extent_sigmas: float = 3.0  # of a position along an axis, by which the spreads must differ, too
    # of the spread of radians as degrees, times 57; that of longitudes is larger beside the equator
    of_radians: tuple[float, float] = (0.8, 2.2)
    height_sigma_m: float = 1e3  # of the first pose, where no position states a height
    metre_per_rad: float = 100.0  # weights a turn of a pose against its position in the rigid fit


_ALIGNMENT = _AlignmentRules()
_DRIFT_RAD = float(np.radians(0.03))
_SCALE_SIGMA = 0.01  # prior
_UNKNOWN = "the GNSS positions do not determine where the trajectory is; drive farther, with a turn"


# of N positions: pose before, share of the way to the next one, (N, 3) in east, north, up, their
# covariances (N, 3, 3), and whether each has a height
_OfFixes = tuple[IntArray, FloatArray, FloatArray, FloatArray, BoolArray]


@dataclass(frozen=True, slots=True)
class Path:
    """A finished trajectory as a graph; K poses."""

    times_ns: IntArray  # (K,) increasing within a session
    T_map_body: FloatArray  # (K, 4, 4)
    first: IntArray  # (E,) motions that the trajectory knows, besides those of neighbours: loops
    second: IntArray  # (E,)
    up_map: FloatArray  # (3,) unit vector upwards in its frame
    up_sigma_rad: float
    # rows at which a new session begins; no GNSS position is between it and the row before
    breaks: IntArray


@dataclass(frozen=True, slots=True)
class Georeference:
    """Where a trajectory is on the earth."""

    frame: LocalFrame
    T_enu_map: FloatArray  # (4, 4) the rigid fit of the whole trajectory
    covariance: FloatArray  # (6, 6) of xi in T_enu_map exp(xi)
    T_enu_body: FloatArray  # (K, 4, 4) the poses, bent as GNSS and scale demand
    position_covariance: FloatArray  # (K, 3, 3) of them, in east, north, up
    scale: float  # of the trajectory's lengths, by which they were multiplied
    scale_sigma: float
    used: BoolArray  # (N,) positions whose horizontal part agrees
    used_height: BoolArray  # (N,)
    inside: BoolArray  # (N,) positions within the trajectory's time
    residuals: FloatArray  # (N, 3) position minus antenna, m; NaN outside


def heading_deg(T_enu_map: FloatArray, covariance: FloatArray) -> tuple[float, float]:
    """Return the heading of a map's x axis from east, and its standard deviation.

    Args:
        T_enu_map: (4, 4).
        covariance: (6, 6) of xi in T_enu_map exp(xi).
    """
    R = T_enu_map[:3, :3]
    east, north, up = R[:, 0].tolist()
    heading = np.arctan2(north, east)
    P_world = R @ covariance[3:, 3:] @ R.T
    # of an axis that points upwards, a roll moves the heading as well
    level = max(east**2 + north**2, 1e-12)
    by_turn = np.array([-up * east / level, -up * north / level, 1.0])
    sigma = np.sqrt(by_turn @ P_world @ by_turn)
    return float(np.degrees(heading)), float(np.degrees(sigma))


def georeference(
    path: Path, fixes: GnssFixes, lever_arm_m: FloatArray, time_offset_ns: int = 0
) -> Georeference:
    """Return where a trajectory is on the earth.

    Args:
        path: the trajectory.
        fixes: positions of an antenna.
        lever_arm_m: (3,) the antenna in the body frame.
        time_offset_ns: added to the stamps of the positions.

    Raises:
        EstimationError: fewer than three positions are within the trajectory's time, or they
            determine nothing.
    """
    before, share, inside = places_between(path, fixes.times_ns + time_offset_ns)
    if int(inside.sum()) < _ALIGNMENT.min_fixes:
        own_ns = fixes.times_ns + time_offset_ns
        spans = [_span_text(times_ns) for times_ns in (own_ns, path.times_ns)]
        raise EstimationError(
            f"only {int(inside.sum())} GNSS positions ({spans[0]}) are within the trajectory "
            f"({spans[1]}); give "
            "those of this drive, or the offset of the clocks with --time-offset"
            f"{epoch_hint(_span(path.times_ns), _span(own_ns), 'the positions')}"
        )
    frame = LocalFrame(fixes.geodetic[int(np.argmax(inside))].copy())
    measured = frame.enu(fixes.geodetic)[inside]
    of_fixes = (
        before[inside],
        share[inside],
        measured,
        fixes.covariance[inside],
        fixes.has_height[inside],
    )
    problem = _Problem(path, *of_fixes, lever_arm_m)
    _check_extents(
        measured, problem.antenna(path.T_map_body), path.up_map, fixes.covariance[inside]
    )
    T, log_scale, weight = problem.solve()
    normal = problem.factorised(T, log_scale, weight)
    used, used_height = (np.zeros(len(fixes), dtype=np.bool_) for _ in range(2))
    residuals = np.full((len(fixes), 3), np.nan)
    used[inside] = weight[:, 0] > 0.5
    used_height[inside] = weight[:, 1] > 0.5
    if 2 * int(used.sum()) < int(inside.sum()):
        _check_hand(path, of_fixes, lever_arm_m, int(used.sum()))
    if int(used.sum()) < _ALIGNMENT.min_fixes:
        raise EstimationError(
            f"only {int(used.sum())} of {int(inside.sum())} GNSS positions agree with the "
            "trajectory"
        )
    residuals[inside] = measured - problem.antenna(T)
    T_enu_map, gain = _rigid_fit(path.T_map_body, T)
    spread = normal.solve(np.concatenate([gain.T, np.zeros((1, 6))]))
    covariance = gain @ spread[:-1]
    positions = _position_covariances(normal, T)
    # rounding is larger than what is determined
    if not ((np.diag(covariance) > 0).all() and (np.linalg.eigvalsh(positions) > 0).all()):
        raise EstimationError(_UNKNOWN)
    unit = np.zeros((6 * len(T) + 1, 1))
    unit[-1] = 1.0
    return Georeference(
        frame=frame,
        T_enu_map=T_enu_map,
        covariance=covariance,
        T_enu_body=T,
        position_covariance=positions,
        scale=float(np.exp(log_scale)),
        scale_sigma=float(np.sqrt(normal.solve(unit)[-1, 0])),
        used=used,
        used_height=used_height,
        inside=inside,
        residuals=residuals,
    )


def _span(times_ns: IntArray) -> tuple[int, int]:
    return int(times_ns[0]), int(times_ns[-1])


def _check_extents(
    measured: FloatArray, antenna: FloatArray, up_map: FloatArray, covariance: FloatArray
) -> None:
    """Raise EstimationError where positions (N, 3) spread over another length than the trajectory's
    antenna (N, 3) does in its map, by more than their noise.
    """
    level = antenna - np.outer(antenna @ up_map, up_map)
    own_m, gnss_m = (_spread_m(points) for points in (level, measured[:, :2]))
    sigma_m = float(np.sqrt(np.median(np.trace(covariance[:, :2, :2], axis1=1, axis2=2)) / 2))
    ratio = gnss_m / max(own_m, 1e-12)
    apart = max(ratio, 1 / max(ratio, 1e-12)) > _ALIGNMENT.max_extents
    if not apart or abs(gnss_m - own_m) < _ALIGNMENT.extent_sigmas * sigma_m:
        return
    low, high = _ALIGNMENT.of_radians
    if low < ratio * np.degrees(1.0) < high:
        why = "they seem to be in radians: give degrees"
    else:
        why = (
            "give those of this drive, in degrees, latitude before longitude; a trajectory of one camera "
            "alone, or of a wrong baseline, has another scale"
        )
    raise EstimationError(
        f"the GNSS positions spread over {gnss_m:.3g} m (median from their middle) and the trajectory at "
        f"these times over {own_m:.3g} m; {why}"
    )


def _check_hand(path: Path, of_fixes: _OfFixes, lever_arm_m: FloatArray, used: int) -> None:
    """Raise EstimationError where most positions agree with the trajectory once they are mirrored.

    A mirrored east, a mirrored north and the two swapped differ by a turn about the vertical, which
    is estimated: one mirror tries all three.

    Args:
        path: the trajectory.
        of_fixes: the positions within its time.
        lever_arm_m: (3,) the antenna in the body frame.
        used: how many positions agree as they are.
    """
    before, share, measured, covariance, has_height = of_fixes
    mirror = np.array([-1.0, 1.0, 1.0])
    problem = _Problem(
        path,
        before,
        share,
        measured * mirror,
        covariance * np.outer(mirror, mirror),
        has_height,
        lever_arm_m,
    )
    _, _, weight = problem.solve()
    agreeing = int((weight[:, 0] > 0.5).sum())
    if 2 * agreeing > len(measured):
        raise EstimationError(
            f"the GNSS positions are mirrored: {used} of {len(measured)} agree with the trajectory, "
            f"and {agreeing} with east or north reversed; change the sign of one of them, as for "
            "CARLA 0.9.16, or exchange them"
        )


def _spread_m(points: FloatArray) -> float:
    """Return the median distance of points (N, K) from their median."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


def _span_text(times_ns: IntArray) -> str:
    begin_s = times_ns[0] * 1e-9
    end_s = times_ns[-1] * 1e-9
    return f"{begin_s:.3f} to {end_s:.3f} s"


def places_between(path: Path, times_ns: IntArray) -> tuple[IntArray, FloatArray, BoolArray]:
    """Return the pose before each time (N,), its share of the way to the next one, and whether
    it is between two.
    """
    starts = np.concatenate([[0], path.breaks, [len(path.times_ns)]]).astype(np.int64)
    before = np.zeros(len(times_ns), dtype=np.int64)
    share = np.zeros(len(times_ns))
    inside = np.zeros(len(times_ns), dtype=np.bool_)
    for start, stop in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        own = path.times_ns[start:stop]
        if len(own) < 2:
            continue
        here = (times_ns >= own[0]) & (times_ns <= own[-1]) & ~inside
        asked_ns = times_ns[here]
        k = np.clip(np.searchsorted(own, asked_ns, side="right") - 1, 0, len(own) - 2)
        before[here] = start + k
        share[here] = (asked_ns - own[k]) / (own[k + 1] - own[k])
        inside |= here
    return before, share, inside


class _Problem:
    """Residuals and normal equations of the graph."""

    def __init__(
        self,
        path: Path,
        before: IntArray,
        share: FloatArray,
        measured: FloatArray,
        covariance: FloatArray,
        has_height: BoolArray,
        lever_arm_m: FloatArray,
    ) -> None:
        self._path = path
        self._before = before
        self._share = share
        self._measured = measured
        self._has_height = has_height
        self._lever = lever_arm_m
        k = np.arange(len(path.times_ns) - 1)
        self._i = np.concatenate([k, path.first])
        self._j = np.concatenate([k + 1, path.second])
        self._T_i_j = se3_inverse(path.T_map_body[self._i]) @ path.T_map_body[self._j]
        length = np.linalg.norm(self._T_i_j[:, :3, 3], axis=1)
        turned_rad = np.linalg.norm(se3_log(self._T_i_j)[:, 3:], axis=1)
        root = np.sqrt(length + turned_rad)
        sigma_m = np.maximum(_ALIGNMENT.drift_m * root, _ALIGNMENT.min_m)
        sigma_rad = np.maximum(_DRIFT_RAD * root, _ALIGNMENT.min_rad)
        sigmas = np.stack([sigma_m, sigma_rad], axis=1)
        self._edge_weight = 1 / np.repeat(sigmas, 3, axis=1) ** 2
        self._up_body = path.up_map @ path.T_map_body[:, :3, :3]
        covariance = covariance + _ALIGNMENT.timing_m**2 * np.eye(3)
        self._horizontal = np.linalg.inv(covariance[:, :2, :2])
        self._vertical = 1 / covariance[:, 2, 2]
        times = (1 - share) * path.times_ns[before] + share * path.times_ns[before + 1]
        gap_s = (
            float(np.median(np.diff(times))) * 1e-9 if len(times) > 1 else _ALIGNMENT.correlated_s
        )
        self._independent = float(
            np.clip(gap_s / _ALIGNMENT.correlated_s, 1e-3, 1.0)
        )  # share of information

    def antenna(self, T: FloatArray) -> FloatArray:
        """Return where the antenna is (N, 3) at the times of the positions."""
        k = self._before
        a = T[:, :3, :3] @ self._lever + T[:, :3, 3]
        out: FloatArray = a[k] + self._share[:, None] * (a[k + 1] - a[k])
        return out

    def solve(self) -> tuple[FloatArray, float, FloatArray]:
        """Return the poses (K, 4, 4), the logarithm of the scale, and the weights (N, 2)
        horizontal and vertical.
        """
        T = (
            _start(self.antenna(self._path.T_map_body), self._measured, self._path.up_map)
            @ self._path.T_map_body
        )
        known = np.stack([np.ones(len(self._measured)), self._has_height], axis=1).astype(
            np.float64
        )
        log_scale = 0.0
        weight = known
        limits = np.array(
            [chi_square_quantile(CUT_OFF_PROBABILITY, n) for n in (2, 1)], dtype=np.float64
        )
        mu = None
        for _ in range(_ALIGNMENT.max_steps):
            squared = self._squared(T)
            if mu is None:
                worst = (squared / limits * (weight > 0)).max(axis=0)
                mu = 1 / np.maximum(2 * worst - 1, 1e-3)
            weight = truncated_weights(squared, mu, limits) * known
            moved = 0.0
            for _ in range(2):
                T, log_scale, moved = self._step(T, log_scale, weight)
            if (mu > 1e3).all() or (
                ((weight == 0) | (weight == 1)).all()
                and moved < _ALIGNMENT.settled
                and (mu > 1).all()
            ):
                break
            mu = mu * MU_GROWTH
        weight = (self._squared(T) < limits) * known
        for _ in range(_ALIGNMENT.max_steps):
            T, log_scale, moved = self._step(T, log_scale, weight)
            if moved < _ALIGNMENT.settled:
                break
        return T, log_scale, weight

    def factorised(self, T: FloatArray, log_scale: float, weight: FloatArray) -> _Factors:
        """Return the factors of the normal matrix (6K + 1, 6K + 1)."""
        return _Factors(self._normal(T, log_scale, weight)[0])

    def _squared(self, T: FloatArray) -> FloatArray:
        """Return the squared normalised residuals (N, 2), horizontal and vertical."""
        r = self._measured - self.antenna(T)
        return np.stack(
            [
                np.einsum("ni,nij,nj->n", r[:, :2], self._horizontal, r[:, :2]),
                self._vertical * r[:, 2] ** 2,
            ],
            1,
        )

    def _step(
        self, T: FloatArray, log_scale: float, weight: FloatArray
    ) -> tuple[FloatArray, float, float]:
        H, g = self._normal(T, log_scale, weight)
        x = _Factors(H).solve(g[:, None])[:, 0]
        moved = T @ se3_exp(x[:-1].reshape(-1, 6))
        largest_step = float(np.abs(x).max())
        return moved, log_scale + float(x[-1]), largest_step

    def _normal(
        self, T: FloatArray, log_scale: float, weight: FloatArray
    ) -> tuple[csc_matrix, FloatArray]:
        """Return the normal matrix and the right-hand side of the step, for T <- T exp(xi)."""
        count = len(T)
        g = np.zeros(6 * count + 1)
        rows = []
        columns = []
        values = []

        def add(at: list[IntArray], J: list[FloatArray], r: FloatArray, W: FloatArray) -> None:
            """Add factors: Jacobians (F, m, n) at first columns (F,), residuals (F, m),
            information (F, m, m).
            """
            for a, Ja in zip(at, J, strict=True):
                JW = np.swapaxes(Ja, 1, 2) @ W
                ia = a[:, None] + np.arange(Ja.shape[2])
                np.add.at(g, ia, -np.einsum("fij,fj->fi", JW, r))
                for b, Jb in zip(at, J, strict=True):
                    ib = b[:, None] + np.arange(Jb.shape[2])
                    block = JW @ Jb
                    rows.append(np.broadcast_to(ia[:, :, None], block.shape).ravel())
                    columns.append(np.broadcast_to(ib[:, None, :], block.shape).ravel())
                    values.append(block.ravel())

        scaled = self._T_i_j.copy()
        scaled[:, :3, 3] *= np.exp(log_scale)
        predicted = se3_inverse(scaled) @ se3_inverse(T[self._i])
        r = se3_log(predicted @ T[self._j])
        r_D_j = np.asarray(np.linalg.inv(se3_left_jacobian(-r)), dtype=np.float64)
        T_j_i = se3_inverse(T[self._j]) @ T[self._i]
        r_D_i: FloatArray = -r_D_j @ se3_adjoint(T_j_i)
        # A longer motion is T_i_j exp([R^T t ds; 0]) before what follows it: minus the left
        # Jacobian's inverse.
        r_D_scale = np.zeros((len(r), 6, 1))
        r_D_scale[:, :3, 0] = -np.einsum("eji,ej->ei", scaled[:, :3, :3], scaled[:, :3, 3])
        r_D_scale = np.linalg.inv(se3_left_jacobian(r)) @ r_D_scale
        last = np.full(len(r), 6 * count)
        add(
            [6 * self._i, 6 * self._j, last],
            [r_D_i, r_D_j, r_D_scale],
            r,
            self._edge_weight[:, :, None] * np.eye(6),
        )
        k = self._before
        share = self._share[:, None, None]
        p = self._measured - self.antenna(T)
        W = np.zeros((len(p), 3, 3))
        W[:, :2, :2] = self._horizontal * weight[:, 0, None, None]
        W[:, 2, 2] = self._vertical * weight[:, 1]
        antenna_D_pose = np.concatenate([np.eye(3), -so3_hat(self._lever)], axis=1)
        move = T[:, :3, :3] @ antenna_D_pose
        J = [-(1 - share) * move[k], -share * move[k + 1]]
        add([6 * k, 6 * k + 6], J, p, self._independent * W)
        up = T[:, 2, :3]
        D = np.zeros((count, 3, 6))
        D[:, :, 3:] = so3_hat(up)
        # The vertical has one error in all poses: so many count as one.
        variance = self._path.up_sigma_rad**2 * count
        tilt = np.broadcast_to(np.eye(3) / variance, (count, 3, 3))
        add([6 * np.arange(count)], [D], up - self._up_body, tilt)
        if not weight[:, 1].any():
            rise = np.zeros((1, 1, 6))
            rise[0, 0, :3] = T[0, 2, :3]
            add(
                [np.zeros(1, dtype=np.int64)],
                [rise],
                T[:1, 2, 3:4],
                np.full((1, 1, 1), _ALIGNMENT.height_sigma_m**-2),
            )
        add(
            [np.array([6 * count])],
            [np.ones((1, 1, 1))],
            np.array([[log_scale]]),
            np.full((1, 1, 1), _SCALE_SIGMA**-2),
        )
        size = 6 * count + 1
        H = coo_matrix(
            (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
            shape=(size, size),
        )
        return H.tocsc(), g


class _Factors:
    """The factors of a sparse symmetric matrix whose last row is full: it is eliminated last."""

    def __init__(self, H: csc_matrix) -> None:
        try:
            self._rest = factors(H[:-1, :-1])
        except RuntimeError as error:  # exactly singular
            raise EstimationError(_UNKNOWN) from error
        self._border = H[:-1, -1:].toarray()
        self._solved = self._rest(self._border)
        eliminated = self._border.T @ self._solved
        self._last = float(H[-1, -1] - eliminated[0, 0])
        if not self._last > 0:  # NaN, too
            raise EstimationError(_UNKNOWN)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the solution (6K + 1, n) for a right-hand side."""
        first = self._rest(np.ascontiguousarray(right[:-1]))
        last = (right[-1:] - self._border.T @ first) / self._last
        return np.concatenate([first - self._solved @ last, last])


def _start(p: FloatArray, measured: FloatArray, up: FloatArray) -> FloatArray:
    """Return the transform (4, 4) of points (N, 3) to others that fits most, with `up` (3,) as
    z, reweighted.
    """
    least_along = int(np.argmin(np.abs(up)))
    side = np.cross(up, np.eye(3)[least_along])
    side /= np.linalg.norm(side)
    level = np.stack([side, np.cross(up, side), up])
    p = p @ level.T
    T = np.eye(4)
    weight = np.ones(len(p))
    for _ in range(_ALIGNMENT.start_steps):
        share = weight / weight.sum()
        mean_p = share @ p
        mean_m = share @ measured
        q = (p - mean_p)[:, :2]
        m = share[:, None] * (measured - mean_m)[:, :2]
        crossed = q[:, 0] * m[:, 1] - q[:, 1] * m[:, 0]
        yaw = np.arctan2(np.sum(crossed), np.sum(q * m))
        R = np.array(
            [
                [np.cos(yaw), -np.sin(yaw), 0],
                [np.sin(yaw), np.cos(yaw), 0],
                [0, 0, 1.0],
            ]
        )
        T = se3_from_parts(R @ level, mean_m - R @ mean_p)
        residual_m = measured - p @ R.T - T[:3, 3]
        off = np.linalg.norm(residual_m[:, :2], axis=1)
        usual_m = max(2 * float(np.median(off)), 1e-3)
        weight = 1 / (1 + (off / usual_m) ** 2)
    return T


def _rigid_fit(T_map: FloatArray, T_enu: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the transform (4, 4) that takes poses (K, 4, 4) nearest to others, and its Jacobian
    (6, 6K) by those.
    """
    W = np.repeat([1.0, _ALIGNMENT.metre_per_rad], 3) ** 2
    T = T_enu[len(T_enu) // 2] @ se3_inverse(T_map[len(T_map) // 2])
    A = se3_adjoint(se3_inverse(T_map))
    AW = np.swapaxes(A, 1, 2) * W
    normal = np.sum(AW @ A, axis=0)
    for _ in range(10):
        e = se3_log(se3_inverse(T_map) @ se3_inverse(T) @ T_enu)
        T = T @ se3_exp(np.linalg.solve(normal, np.einsum("kij,kj->i", AW, e)))
    gain = np.linalg.solve(normal, AW).transpose(1, 0, 2).reshape(6, -1)
    return T, gain


def _position_covariances(normal: _Factors, T: FloatArray) -> FloatArray:
    """Return the covariances (K, 3, 3) of the poses' positions, exact at some of them and
    interpolated between.
    """
    count = len(T)
    rows = np.unique(np.linspace(0, count - 1, min(count, 200)).astype(np.int64))
    out = np.empty((len(rows), 3, 3))
    for n, k in enumerate(rows.tolist()):
        unit = np.zeros((6 * count + 1, 3))
        unit[6 * k : 6 * k + 3] = np.eye(3)
        R = T[k, :3, :3]
        column = normal.solve(unit)
        out[n] = R @ column[6 * k : 6 * k + 3] @ R.T
    at = np.arange(count)
    return np.stack(
        [np.interp(at, rows, out[:, i, j]) for i in range(3) for j in range(3)], axis=1
    ).reshape(-1, 3, 3)
