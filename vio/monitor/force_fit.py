"""The accelerometer against the images: the best linear map from its readings to the camera's
accelerations, (I3).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.geometry.lie import FloatArray, se3_exp, so3_exp
from vio.monitor.gyro_fit import AGREES, FIRST_EVALUATION, GyroFit
from vio.monitor.motion import Record
from vio.monitor.turned_imu import Turn
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import jackknife, median
from vio.records import BoolArray

WINDOW_S = 2.0
# of records with fewer than two of the others: enough for axes and signs that are clearly wrong
SHORT_WINDOW_S = 1.0
MIN_WINDOWS = 3  # for all but axes and signs that are clearly wrong


class _FitPriors(NamedTuple):
    """What is known of the map from readings to accelerations."""

    min_windows: int = 2
    bias_mps2: float = 0.3
    lever_arm_m: float = 1.0
    misfit_m: float = 0.02  # standard deviation of a window's positions, to weight the priors
    reweightings: Tolerance[int] = 4


_PRIORS = _FitPriors()
# information, (6,)
_PRIOR = _PRIORS.misfit_m**2 / np.repeat([_PRIORS.bias_mps2, _PRIORS.lever_arm_m], 3) ** 2
_PRIOR_MATRIX = np.diag(_PRIOR)
# information on the map's entries, (9,): keeps the fit solvable
_MAP_PRIOR = np.full(9, _PRIORS.misfit_m**2 / 400)


@dataclass(frozen=True, slots=True)
class ForceFit:
    """Normal equations of `camera acceleration - gravity = A force + b` over windows, (I3): A by
    rows, b, lever arm.
    """

    N: FloatArray  # (W, 15, 15)
    h: FloatArray  # (W, 15)
    c: FloatArray  # (W,)
    weight: FloatArray  # (W,)
    window_s: float = WINDOW_S  # length of each

    @property
    def windows(self) -> int:
        """How many there are."""
        return len(self.c)

    def reduced(self, keep: BoolArray | None = None) -> tuple[FloatArray, FloatArray, float]:
        """Return N, h, c of the cost `c - 2 h a + a N a` of a linear map a (9,), bias and lever
        arm marginalised.
        """
        w = self.weight if keep is None else self.weight * keep
        N = (w[None] @ self.N.reshape(len(w), -1)).reshape(15, 15)
        h = w @ self.h
        c = float(w @ self.c)
        right = np.concatenate([N[9:, :9], h[9:, None]], axis=1)
        K = np.linalg.solve(N[9:, 9:] + _PRIOR_MATRIX, right)
        return (
            N[:9, :9] - N[:9, 9:] @ K[:, :9],
            h[:9] - N[:9, 9:] @ K[:, 9],
            c - float(h[9:] @ K[:, 9]),
        )

    def cost(self, C: FloatArray) -> float:
        """Return the squared misfit (m^2) of a map (3, 3) from force to the camera frame."""
        N, h, c = self.reduced()
        a = C.reshape(9)
        return max(float(c - 2 * h @ a + a @ N @ a), 0.0)

    def sign(self, C: FloatArray) -> tuple[float, float]:
        """Return the best factor on a map (3, 3), and its standard error by a jackknife over
        windows.
        """
        a = C.reshape(9)
        values = []
        every = np.arange(len(self.c))
        for left_out in (-1, *every):
            N, h, _ = self.reduced(every != left_out)
            values.append(float(h @ a) / max(float(a @ N @ a), 1e-300))
        return values[0], float(jackknife(values[1:]))


@dataclass(frozen=True, slots=True)
class Evidence:
    """The fits of gyro and accelerometer to the images, and the state of the check."""

    R_cam0_imu: FloatArray  # (3, 3) as given
    gyro_fit: GyroFit
    # None: too few windows without tracking loss, or the readings have no unit
    force: ForceFit | None
    # likewise, from fewer or shorter windows: enough for axes and signs that are clearly wrong
    early_force: ForceFit | None
    force_final: bool  # `force` will not improve: what it leaves undecided is judged without it
    # readings at the end of the range were found, which make rotations appear smaller
    clipped: bool
    last: bool  # no later evaluation will follow
    # of the IMU against `R_cam0_imu`; None: not clearly, or a filter estimates it
    turn: Turn | None = None
    # in order of time, which may agree at first alone; None: they are in none
    record: Record | None = None

    @property
    def brief(self) -> bool:
        """Whether there are fewer intervals than in any evaluation during a run."""
        return self.gyro_fit.count < FIRST_EVALUATION

    @property
    def gyro_agrees(self) -> bool:
        """Whether the gyro explains the camera's rotations by some linear map."""
        return self.gyro_fit.unexplained < AGREES


@dataclass(frozen=True, slots=True)
class _Window:
    """Consecutive intervals without tracking loss, as long as a window."""

    dt: FloatArray  # (n,) seconds
    omega: FloatArray  # (n, 3) rotation rate, cam0 frame
    twists: FloatArray  # (n, 6) [v; omega] of cam0, cam0 frame
    force: FloatArray  # (n, 3) mean readings of the accelerometer


def fit_force(
    record: Record, gyro_fit: GyroFit, lever_arm: FloatArray, window_s: float = WINDOW_S
) -> ForceFit | None:
    """Fit over whole windows of a length; None: too few of them are without tracking loss.

    The gyro's fit gives the camera's rotation where it explains the images. A correction to the
    given position of the IMU in cam0, `lever_arm` (3,) in metres, is fitted, too.
    """
    windows = _windows(record, gyro_fit, window_s)
    blocks = [_normal_equations(window, lever_arm) for window in windows]
    if len(blocks) < _PRIORS.min_windows:
        return None
    N, h, c = (np.array([b[k] for b in blocks]) for k in range(3))
    weight: FloatArray = np.ones(len(blocks))
    prior = np.diag(np.concatenate([_MAP_PRIOR, _PRIOR]))
    for _ in range(_PRIORS.reweightings):
        x = np.linalg.solve(np.tensordot(weight, N, 1) + prior, weight @ h)
        misfit = np.maximum(c - 2 * h @ x + np.einsum("i,wij,j->w", x, N, x), 0)
        weight = 1 / (1 + misfit / max(4 * median(misfit), 1e-9)) ** 2
    return ForceFit(N, h, c, weight, window_s)


def _windows(record: Record, gyro_fit: GyroFit, window_s: float) -> Iterator[_Window]:
    """Yield consecutive windows; after a tracking loss the next one starts anew."""
    dt = record.end - record.begin
    joined = record.joined
    omega = (
        gyro_fit.gyro @ gyro_fit.A.T + gyro_fit.b
        if gyro_fit.unexplained < AGREES
        else record.twists[:, 3:]
    )
    first = 0
    while first < len(dt):
        last = first
        while last < len(dt) and gyro_fit.covered[last] and (last == first or joined[last]):
            last += 1
            if record.end[last - 1] - record.begin[first] >= window_s:
                rows = slice(first, last)
                yield _Window(dt[rows], omega[rows], record.twists[rows], gyro_fit.force[rows])
                break
        first = max(last, first + 1)


def _normal_equations(
    window: _Window, lever_arm: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Return normal equations N (15, 15), h (15,), c of one window; start velocity and gravity
    are projected out.
    """
    n = len(window.dt)
    dt = window.dt
    R = _rotations(window)
    position = np.cumsum(
        np.einsum("nij,nj->ni", R[:-1], se3_exp(dt[:, None] * window.twists)[:, :3, 3]), axis=0
    )
    swing = R[1:] - np.eye(3)
    X = np.concatenate([_double_integrals(window, R[:-1]), -swing], axis=2)
    y = position + swing @ lever_arm  # the correction to the given lever arm is fitted
    elapsed = np.cumsum(dt)
    Q = np.linalg.qr(np.stack([elapsed, elapsed**2], axis=1))[0]
    X = X - np.tensordot(Q, np.tensordot(Q, X, (0, 0)), (1, 0))
    y = y - Q @ (Q.T @ y)
    X = X.reshape(3 * n, 15)
    flat = y.reshape(3 * n)
    return X.T @ X / n, X.T @ flat / n, float(flat @ flat) / n


def _rotations(window: _Window) -> FloatArray:
    """Return rotations (n + 1, 3, 3) of the camera at the intervals' ends into its first frame."""
    turns = so3_exp(window.dt[:, None] * window.omega)
    R = np.empty((len(turns) + 1, 3, 3))
    R[0] = np.eye(3)
    for k, turn in enumerate(turns):
        R[k + 1] = R[k] @ turn
    return R


def _double_integrals(window: _Window, R: FloatArray) -> FloatArray:
    """Return the Jacobian (n, 3, 12) of the IMU's positions at the intervals' ends by A and b.

    R at their starts.
    """
    n = len(window.dt)
    dt = window.dt[:, None, None]
    middle = R @ so3_exp(window.dt[:, None] / 2 * window.omega)
    of_map = np.einsum("nij,nl->nijl", middle, window.force).reshape(n, 3, 9)
    gain = dt * np.concatenate([of_map, middle], axis=2)
    velocity = np.concatenate([np.zeros((1, 3, 12)), np.cumsum(gain, axis=0)])[:-1]
    return np.cumsum(dt * (velocity + gain / 2), axis=0)
