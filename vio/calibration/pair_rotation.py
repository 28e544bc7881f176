"""By how much the right camera of a rectified pair is turned against its calibration, by points
that were matched without regard to rows.

A rotation `exp(w)`, by which a right camera shows the points p of its rectified frame, moves all
right pixels. About the axes x and z it moves rows by several pixels a tenth of a degree, whatever
the depth: a single pair tells both. About y it moves rows by `x y w_y`, which a tangential
distortion p2 does as well, equation (R2) of docs/math.md, and all disparities by the same number of
pixels: only motion tells it from depth. So the yaw comes from two pairs between which the rig has moved.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vio.dataclass import dataclass
from vio.geometry.lie import FloatArray, so3_exp
from vio.geometry.stereo import StereoCamera, left_rays
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import robust_sigma
from vio.records import BoolArray


class _Fit(NamedTuple):
    """How rotations are fitted to pixels."""

    # of Cauchy's weights, one for each iteration, so that outliers lose theirs step by step; a turn
    # of 2 degrees moves rows by 60 px in the corner of a large image
    widths_px: tuple[float, ...] = (60.0, 30.0, 15.0, 8.0, 4.0, 2.0, 1.0, 0.5, 0.5, 0.5)
    near_px: float = 1.5  # rows of right matches differ by less after the fit
    min_points: int = 30
    sigma_px: float = 0.3  # of a pixel, at least
    prior_rad: float = 3.0 * np.pi / 180.0  # standard deviation of each angle before
    prior_p2: float = 2e-3  # of tangential distortion that a calibration leaves
    # three of these: with more, outliers or points that move have led to another minimum
    max_p2: float = 6e-3
    step: Tolerance[float] = 1e-6  # of numeric derivatives by angles, distortion, motion and points
    iterations: Tolerance[int] = 12
    # squared standard deviations that a step is long
    converged: Tolerance[float] = 1e-4
    min_disparity_px: float = 0.5  # of points from which the motion starts
    rounding: Tolerance[float] = 1e-9  # share of normal equations below which they are none


_FIT = _Fit()
# Of a rotation. Calibrations of real recordings have at most 0.06 about x and z, and 0.2 about y:
# four of the standard deviations that the filter takes for it (`msckf.stereo_yaw_sigma_deg`).
MIN_TURN_DEG = 0.2
# of one about y by rows alone: a right lens whose tangential distortion is off looks like 0.6
# degrees in all rows of KITTI
MIN_ROW_YAW_DEG = 0.9
_SHARED = 10  # unknowns of two pairs: rotation, p2, and the motion's rotation and translation


@dataclass(frozen=True, slots=True)
class PairRotation:
    """A right camera that is turned against its calibration."""

    rotation: FloatArray  # (3,) rad: it shows points p of its rectified frame as `exp(rotation) p`
    covariance: FloatArray  # (3, 3) rad²
    points: int  # that agree with it
    share: float  # of all points

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations (3,) of the angles, rad."""
        return np.sqrt(np.diag(self.covariance))


def is_turned_by_rows(turn_deg: FloatArray) -> bool:
    """Whether a rotation (3,) by rows, degrees about x, y and z, is more than that of a usual
    calibration; rows tell yaw badly.
    """
    x, y, z = np.abs(turn_deg).tolist()
    return bool(max(x, z) >= MIN_TURN_DEG or y >= MIN_ROW_YAW_DEG)


def turned_pixels(camera: StereoCamera, rotation: FloatArray) -> FloatArray:
    """Return the homography (3, 3) from pixels of a right camera as calibrated to those of one that
    is turned by `rotation` (3,) rad.
    """
    K = camera.K
    return np.asarray(K @ so3_exp(rotation) @ np.linalg.inv(K), dtype=np.float64)


def rotation_by_rows(camera: StereoCamera, z: FloatArray) -> PairRotation | None:
    """Return the rotation after which rows of left and right pixels agree; None: too few do.

    The yaw is that of a right lens without tangential distortion.

    Args:
        camera: rectified pinholes.
        z: (N, 4) matched pixels `[ul vl ur vr]`, wrong matches among them.
    """
    if len(z) < _FIT.min_points:
        return None
    rows = left_rays(camera, z[:, :2])[:, 1]
    rays = left_rays(camera, z[:, 2:])  # both cameras have the same intrinsics

    def off(w: FloatArray) -> FloatArray:
        return camera.fv * (_undone(rays, so3_exp(w))[..., 1] - rows)

    prior: FloatArray = np.eye(3) / _FIT.prior_rad**2
    w: FloatArray = np.zeros(3)
    normal = prior
    for width in _FIT.widths_px:
        r = off(w)
        J = (off(w + _FIT.step * np.eye(3)) - r).T / _FIT.step
        weights = 1.0 / (1.0 + (r / width) ** 2)
        sigma = max(_FIT.sigma_px, robust_sigma(r[np.abs(r) < 2 * width]))
        normal = (J.T * weights) @ J / sigma**2 + prior
        gradient = (J.T * weights) @ r / sigma**2 + prior @ w
        w = w - np.linalg.solve(normal, gradient)
    near = np.abs(off(w)) < _FIT.near_px
    if near.sum() < _FIT.min_points:
        return None
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    return PairRotation(w, covariance, int(near.sum()), float(near.mean()))


def rotation_by_motion(
    camera: StereoCamera, first: FloatArray, second: FloatArray, start: FloatArray
) -> PairRotation | None:
    """Return the rotation by the pixels of points in two pairs, by a bundle adjustment of motion
    and points; None: too few points agree.

    Its yaw is as uncertain as distortion p2 allows where the rig has not moved between the pairs.

    Args:
        camera: rectified pinholes.
        first: (N, 4) pixels `[ul vl ur vr]` in one pair, wrong matches among them.
        second: (N, 4) pixels of the same points in the other pair.
        start: (3,) rotation by rows.
    """
    if len(first) < _FIT.min_points:
        return None
    seen = _SeenTwice(camera, first, second)
    shared, near = _start(seen, start)
    seen = seen.take(near)
    try:
        return _adjusted(seen, shared, len(first))
    except np.linalg.LinAlgError:  # points without parallax, at the same place
        return None


def _adjusted(seen: _SeenTwice, shared: FloatArray, count: int) -> PairRotation | None:
    """Return the rotation after a bundle adjustment from unknowns (10,) on; see
    `rotation_by_motion`.
    """
    points = seen.points(shared[:3])
    information = np.zeros(_SHARED)
    information[:3] = 1.0 / _FIT.prior_rad**2
    information[3] = 1.0 / _FIT.prior_p2**2
    for _ in range(_FIT.iterations):
        reduced, gradient, change = seen.equations(shared, points)
        # without motion between the pairs all is determined but for rounding
        reduced[np.diag_indices(_SHARED)] += information + _FIT.rounding * np.diag(reduced)
        step = np.linalg.solve(reduced, -gradient - information * shared)
        shared = shared + step
        points = np.add(points, change(np.asarray(step, dtype=np.float64)))
        if step @ reduced @ step < _FIT.converged:
            break
    r = seen.residuals(shared, points)
    agree = np.abs(r).max(axis=1) < 4.0 * max(_FIT.sigma_px, robust_sigma(r))
    if agree.sum() < _FIT.min_points or not abs(shared[3]) < _FIT.max_p2:
        return None
    covariance = np.asarray(np.linalg.inv(reduced)[:3, :3], dtype=np.float64)
    return PairRotation(shared[:3], covariance, int(agree.sum()), float(agree.sum() / count))


def _undone(rays: FloatArray, R: FloatArray, p2: FloatArray | None = None) -> FloatArray:
    """Return where a right camera as calibrated shows rays (N, 3) of one that is turned by R
    (..., 3, 3) and has tangential distortion p2 (...): (..., N, 2), focal lengths.
    """
    if p2 is not None:
        x = rays[:, 0]
        y = rays[:, 1]
        bend_u = 3 * x * x + y * y
        bend_v = 2 * x * y
        bend = np.stack([bend_u, bend_v, np.zeros(len(rays))], axis=1)
        rays = rays - p2[..., None, None] * bend
    turned = rays @ R
    return np.asarray(turned[..., :2] / turned[..., 2:], dtype=np.float64)


class _SeenTwice:
    """Points in two pairs, and what their pixels say of the rotation.

    A point is the place (u, v) at which the left camera shows it in the first pair, and its inverse
    depth in baselines, d, all in focal lengths.
    """

    def __init__(self, camera: StereoCamera, first: FloatArray, second: FloatArray) -> None:
        self._camera = camera
        self._pixels = (first, second)
        self._left = tuple(left_rays(camera, z[:, :2])[:, :2] for z in (first, second))
        self._rays = tuple(left_rays(camera, z[:, 2:]) for z in (first, second))

    def take(self, rows: BoolArray) -> _SeenTwice:
        """Return some of the points, by a mask (N,)."""
        first, second = self._pixels
        return _SeenTwice(self._camera, first[rows], second[rows])

    def points(self, rotation: FloatArray) -> FloatArray:
        """Return the points (N, 3) by the first pair."""
        left = self._left[0]
        right = _undone(self._rays[0], so3_exp(rotation))
        row = 0.5 * (left[:, 1] + right[:, 1])
        disparity = left[:, 0] - right[:, 0]
        return np.stack([left[:, 0], row, disparity], axis=1)

    @property
    def focal_px(self) -> float:
        """Focal length, pixels."""
        return self._camera.fu

    @property
    def later(self) -> FloatArray:
        """Where the left camera shows the points in the second pair (N, 2), focal lengths."""
        return self._left[1]

    def residuals(self, shared: FloatArray, points: FloatArray) -> FloatArray:
        """Return residuals (..., N, 8), pixels, of unknowns (..., 10) and points (..., N, 3)."""
        R = so3_exp(shared[..., :3])
        p2 = shared[..., 3]
        place = points[..., :2]
        d = points[..., 2:]
        right_of = np.concatenate([d, np.zeros_like(d)], axis=-1)
        rays = np.concatenate([place, np.ones_like(d)], axis=-1)
        motion = so3_exp(shared[..., 4:7])
        moved = rays @ motion.swapaxes(-1, -2) + d * shared[..., None, 7:]
        depth = moved[..., 2:]
        off = np.broadcast_arrays(
            self._left[0] - place,
            _undone(self._rays[0], R, p2) - (place - right_of),
            self._left[1] - moved[..., :2] / depth,
            _undone(self._rays[1], R, p2) - (moved[..., :2] - right_of) / depth,
        )
        return self._camera.fu * np.concatenate(off, axis=-1)

    def equations(
        self, shared: FloatArray, points: FloatArray
    ) -> tuple[FloatArray, FloatArray, Callable[[FloatArray], FloatArray]]:
        """Return the normal equations (10, 10) and gradient (10,) of the shared unknowns, the
        points eliminated, and the change (N, 3) of the points for a step (10,) of these.
        """
        r = self.residuals(shared, points)
        sigma = max(_FIT.sigma_px, robust_sigma(r))
        h = _FIT.step
        by_shared = self.residuals(shared + h * np.eye(_SHARED), points)
        A = np.moveaxis(by_shared - r, 0, -1) / h
        by_point = self.residuals(shared, points + h * np.eye(3)[:, None])
        B = np.moveaxis(by_point - r, 0, -1) / h
        squared = (r * r).mean(axis=1) / sigma**2
        weights = 1.0 / (1.0 + squared) / sigma**2
        Aw = A * weights[:, None, None]
        Bw = B * weights[:, None, None]
        V = np.linalg.inv(np.einsum("nki,nkj->nij", Bw, B) + _FIT.rounding * np.eye(3))
        W = np.einsum("nki,nkj->nij", Aw, B)
        g = np.einsum("nki,nk->ni", Bw, r)
        WV = W @ V
        reduced = np.einsum("nki,nkj->ij", Aw, A) - np.einsum("nij,nkj->ik", WV, W)
        gradient = np.einsum("nki,nk->i", Aw, r) - np.einsum("nij,nj->i", WV, g)

        def change(step: FloatArray) -> FloatArray:
            back = g + np.einsum("nij,i->nj", W, step)
            return np.asarray(-np.einsum("nij,nj->ni", V, back), dtype=np.float64)

        return reduced, gradient, change


def _start(seen: _SeenTwice, rotation: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the unknowns (10,) to start at, and the points (N,) that agree with that motion.

    The motion is that of the left camera by the points of the first pair.
    """
    import cv2

    focal = seen.focal_px
    points = seen.points(rotation)
    d = np.maximum(points[:, 2], _FIT.min_disparity_px / focal)
    homogeneous = np.stack([points[:, 0], points[:, 1], np.ones(len(d))], axis=1)
    p = homogeneous / d[:, None]
    shared = np.zeros(_SHARED)
    shared[:3] = rotation
    known, turn, shift, rows = cv2.solvePnPRansac(
        p, seen.later, np.eye(3), None, reprojectionError=_FIT.widths_px[4] / focal
    )
    if not known or rows is None or len(rows) < _FIT.min_points:
        return shared, np.ones(len(d), dtype=np.bool_)
    shared[4:7] = turn.ravel()
    shared[7:] = shift.ravel()
    near = np.zeros(len(d), dtype=np.bool_)
    near[rows.ravel()] = True
    return shared, near
