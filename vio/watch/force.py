"""The accelerometer against the images: the best linear map from its readings to the camera's accelerations, (I3)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vio.geometry.lie import FloatArray, se3_exp, so3_exp
from vio.records import BoolArray
from vio.robust import jackknife
from vio.watch.motion import Record
from vio.watch.turning import AGREES, Turning

WINDOW_S = 2.0
_LEAST_WINDOWS = 3
_BIAS_PRIOR_MPS2 = 0.3
_LEVER_PRIOR_M = 1.0
_MISFIT_M = 0.02  # of a window's positions, to weigh the priors
_PRIOR = _MISFIT_M**2 / np.repeat([_BIAS_PRIOR_MPS2, _LEVER_PRIOR_M], 3) ** 2  # information on bias and lever, (6,)
_MAP_PRIOR = np.full(9, _MISFIT_M**2 / 400)  # information on the map's entries, (9,): keeps the fit solvable
_REWEIGHTINGS = 4


@dataclass(frozen=True, slots=True)
class ForceFit:
    """Normal equations of `camera acceleration - gravity = A force + b` over windows, (I3): A by rows, b, lever."""

    N: FloatArray  # (W, 15, 15)
    h: FloatArray  # (W, 15)
    c: FloatArray  # (W,)
    weight: FloatArray  # (W,)

    def reduced(self, keep: BoolArray | None = None) -> tuple[FloatArray, FloatArray, float]:
        """Cost `c - 2 h a + a N a` of a linear map a (9,) alone: bias and lever arm take their best values."""
        w = self.weight if keep is None else self.weight * keep
        N, h, c = np.tensordot(w, self.N, 1), w @ self.h, float(w @ self.c)
        K = np.linalg.solve(N[9:, 9:] + np.diag(_PRIOR), np.column_stack([N[9:, :9], h[9:]]))
        return N[:9, :9] - N[:9, 9:] @ K[:, :9], h[:9] - N[:9, 9:] @ K[:, 9], c - float(h[9:] @ K[:, 9])

    def cost(self, C: FloatArray) -> float:
        """Squared misfit (m^2) of a map (3, 3) from force to the camera frame."""
        N, h, c = self.reduced()
        a = C.reshape(9)
        return max(float(c - 2 * h @ a + a @ N @ a), 0.0)

    def sign(self, C: FloatArray) -> tuple[float, float]:
        """The factor on a map (3, 3) that fits best, and its standard error by a jackknife over windows."""
        a, values = C.reshape(9), []
        every = np.arange(len(self.c))
        for left_out in (-1, *every):
            N, h, _ = self.reduced(every != left_out)
            values.append(float(h @ a) / max(float(a @ N @ a), 1e-300))
        return values[0], float(jackknife(values[1:]))


@dataclass(frozen=True, slots=True)
class _Window:
    """Successive intervals that are tracked throughout, as long as a window."""

    dt: FloatArray  # (n,) seconds
    omega: FloatArray  # (n, 3) rotation rate, cam0 frame
    twists: FloatArray  # (n, 6) [v; omega] of cam0, cam0 frame
    force: FloatArray  # (n, 3) mean readings of the accelerometer


def fit_force(record: Record, turning: Turning, lever: FloatArray) -> ForceFit | None:
    """Fit over whole windows; None: too few of them are tracked throughout.

    Args:
        record: intervals and samples.
        turning: the gyro's fit; it turns the camera where it explains the images.
        lever: (3,) given position of the IMU in cam0, metres; a correction to it is fitted.
    """
    blocks = [_normal_equations(window, lever) for window in _windows(record, turning)]
    if len(blocks) < _LEAST_WINDOWS:
        return None
    N, h, c = (np.array([b[k] for b in blocks]) for k in range(3))
    weight: FloatArray = np.ones(len(blocks))
    prior = np.diag(np.concatenate([_MAP_PRIOR, _PRIOR]))
    for _ in range(_REWEIGHTINGS):
        x = np.linalg.solve(np.tensordot(weight, N, 1) + prior, weight @ h)
        misfit = np.maximum(c - 2 * h @ x + np.einsum("i,wij,j->w", x, N, x), 0)
        weight = 1 / (1 + misfit / max(4 * float(np.median(misfit)), 1e-9)) ** 2
    return ForceFit(N, h, c, weight)


def _windows(record: Record, turning: Turning) -> Iterator[_Window]:
    """The windows, one after the other; where the tracking breaks off, the next one begins anew."""
    dt, joined = record.end - record.begin, record.joined
    omega = turning.gyro @ turning.A.T + turning.b if turning.unexplained < AGREES else record.twists[:, 3:]
    first = 0
    while first < len(dt):
        last = first
        while last < len(dt) and turning.covered[last] and (last == first or joined[last]):
            last += 1
            if record.end[last - 1] - record.begin[first] >= WINDOW_S:
                rows = slice(first, last)
                yield _Window(dt[rows], omega[rows], record.twists[rows], turning.force[rows])
                break
        first = max(last, first + 1)


def _normal_equations(window: _Window, lever: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Normal equations N (15, 15), h (15,), c of one window; start velocity and gravity are projected out."""
    n, dt = len(window.dt), window.dt
    R = _rotations(window)
    place = np.cumsum(np.einsum("nij,nj->ni", R[:-1], se3_exp(dt[:, None] * window.twists)[:, :3, 3]), axis=0)
    swing = R[1:] - np.eye(3)
    X = np.concatenate([_double_integrals(window, R[:-1]), -swing], axis=2)
    y = place + swing @ lever  # the lever's correction to the given one is fitted
    since = np.cumsum(dt)
    Q = np.linalg.qr(np.stack([since, since**2], axis=1))[0]
    X = X - np.tensordot(Q, np.tensordot(Q, X, (0, 0)), (1, 0))
    y = y - Q @ (Q.T @ y)
    X, flat = X.reshape(3 * n, 15), y.reshape(3 * n)
    return X.T @ X / n, X.T @ flat / n, float(flat @ flat) / n


def _rotations(window: _Window) -> FloatArray:
    """Rotations (n + 1, 3, 3) of the camera at the intervals' ends into its first frame."""
    turns = so3_exp(window.dt[:, None] * window.omega)
    R = np.empty((len(turns) + 1, 3, 3))
    R[0] = np.eye(3)
    for k, turn in enumerate(turns):
        R[k + 1] = R[k] @ turn
    return R


def _double_integrals(window: _Window, R: FloatArray) -> FloatArray:
    """What the entries of A by rows and b move the IMU by (n, 3, 12) until the intervals' ends, m per unit.

    Args:
        window: the intervals.
        R: (n, 3, 3) rotations at their begins.
    """
    n, dt = len(window.dt), window.dt[:, None, None]
    middle = R @ so3_exp(window.dt[:, None] / 2 * window.omega)
    of_map = np.einsum("nij,nl->nijl", middle, window.force).reshape(n, 3, 9)
    gain = dt * np.concatenate([of_map, middle], axis=2)
    velocity = np.concatenate([np.zeros((1, 3, 12)), np.cumsum(gain, axis=0)])[:-1]
    return np.cumsum(dt * (velocity + gain / 2), axis=0)
