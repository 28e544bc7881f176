"""Bundle adjustment of a board: lenses, the pair's pose, the bow of the board, and each view's pose.

One robust least-squares problem over all views and cameras. Its normal equations are arrow-shaped:
the poses of the views are eliminated (Schur complement), which leaves some thirty unknowns. Corners
of a far, tilted or blurred board are less accurate: each image has a standard deviation of its own.
References: Triggs et al., Bundle adjustment: a modern synthesis (2000); Geman & McClure,
Statistical methods for tomographic image reconstruction (1987), for the weights; Förstner, Ein
Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten (1979), for the images' variances.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel, project_point, uv_D_camera, uv_D_point
from vio.geometry.lie import FloatArray, se3_exp, so3_hat
from vio.numerics.kinds import Tolerance
from vio.numerics.least_squares import Damping
from vio.numerics.robust import median
from vio.targets.views import Sightings

BoolArray = npt.NDArray[np.bool_]

_INTRINSIC = 4  # fu fv cu cv, before a lens's coefficients
_BOW = 2
_POSE = 6


class _Iterations(NamedTuple):
    """When the adjustment ends."""

    max_steps: Tolerance[int] = 60
    converged_share: Tolerance[float] = 1e-6  # relative change of the cost
    max_damping: Tolerance[float] = 1e8


_ITERATIONS = _Iterations()


class _CornerWeights(NamedTuple):
    """How much a corner counts."""

    quarter_sigmas: float = 3.0  # standard deviations at which a corner's weight is a quarter
    cut_sigmas: float = 4.5  # standard deviations beyond which a corner has no weight at the end
    min_sigma_px: float = 0.01
    min_used: int = 4  # corners of a view
    behind_px: float = 100.0  # residual of a corner that the lens cannot project
    # of the camera's usual image: how many count with those of an image for its variance
    usual_corners: float = 5.0
    # standard deviation of an image over its camera's, beyond which its pose is called wrong
    max_image_ratio: float = 5.0


_WEIGHTS = _CornerWeights()


class _Priors(NamedTuple):
    """What is known before any view."""

    # by which coefficients of a lens may be off zero: holds those that no view shows
    coefficient_sigma: float = 10.0
    bow_share: float = 0.01  # of the board's width: standard deviation of its bow before any view


_PRIORS = _Priors()
MEDIAN_TO_SIGMA = 1.1774  # of the length of a vector of two Gaussian components


@dataclass(frozen=True, slots=True)
class RigFit:
    """Unknowns of the adjustment."""

    cameras: tuple[CameraModel, ...]
    T_cam_cam0: FloatArray  # (C, 4, 4) the first one is the identity
    T_cam0_board: FloatArray  # (V, 4, 4)
    bow: FloatArray  # (2,) height of the board's middle over its edges, along x and along y, metres


@dataclass(frozen=True, slots=True)
class Adjusted:
    """Where an adjustment ended."""

    at: RigFit
    sigma_px: FloatArray  # (C,) of a corner's coordinate, of each camera, as its residuals show
    corner_sigma_px: FloatArray  # (R,) of each corner's coordinate, as its image's residuals show
    covariance: FloatArray  # (S, S) of the shared unknowns, see `Layout`
    used: BoolArray  # (R,) corners with weight
    residuals_px: FloatArray  # (R, 2) measured minus expected


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the shared unknowns lie: lens by lens, poses of the further cameras, the bow."""

    lenses: tuple[slice, ...]
    poses: tuple[slice, ...]  # xi of `exp(xi) T_cam_cam0` of cameras 1 and on
    bow: slice
    size: int


def layout_of(cameras: tuple[CameraModel, ...]) -> Layout:
    """Return where the shared unknowns of cameras lie."""
    lenses: list[slice] = []
    start = 0
    for camera in cameras:
        lenses.append(slice(start, start + _INTRINSIC + len(camera.coefficients)))
        start = lenses[-1].stop
    poses: list[slice] = []
    for _ in cameras[1:]:
        poses.append(slice(start, start + _POSE))
        start += _POSE
    return Layout(tuple(lenses), tuple(poses), slice(start, start + _BOW), start + _BOW)


def lens_moved(camera: CameraModel, step: FloatArray) -> CameraModel:
    """Return a camera with intrinsics and coefficients changed by a step (4 + n,).

    Raises:
        CalibrationError: the lens model does not allow the result.
    """
    pinhole = (camera.fu, camera.fv, camera.cu, camera.cv)
    values = np.array([*pinhole, *camera.coefficients]) + step
    fu, fv, cu, cv, *coefficients = values.tolist()
    return replace(camera, fu=fu, fv=fv, cu=cu, cv=cv, coefficients=tuple(coefficients))


def bow_shape(points_m: FloatArray) -> FloatArray:
    """Return the depths (N, 2) in the board's frame by each term of a bow, at points (N, 2)."""
    low = points_m.min(axis=0)
    half = 0.5 * (points_m.max(axis=0) - low)
    return np.asarray(1 - ((points_m - low - half) / half) ** 2)


class BoardAdjustment:
    """Adjusts a rig to what it saw of a board."""

    def __init__(self, seen: Sightings, *, fixed_lenses: bool = False) -> None:
        order = np.argsort(seen.view, kind="stable")
        self.seen = seen.take(order)
        self._order = order
        self._first = np.searchsorted(self.seen.view, np.arange(seen.views + 1))
        self._image = self.seen.view * seen.cameras + self.seen.camera
        self._shape = bow_shape(seen.points_m)
        self._fixed = fixed_lenses  # and the pair and the bow: only the views' poses are found
        self._bow_sigma_m = _PRIORS.bow_share * float(np.ptp(seen.points_m, axis=0).max())

    def solve(self, start: RigFit, steps: int = _ITERATIONS.max_steps) -> Adjusted:
        """Return the optimum from a start on.

        Raises:
            CalibrationError: the views do not determine the lens.
        """
        try:
            return self._solved(start, steps)
        except np.linalg.LinAlgError as error:
            raise CalibrationError(
                f"the views do not determine a {start.cameras[0].model} lens with "
                f"{len(start.cameras[0].coefficients)} coefficients: show the board in every part "
                "of the images, tilted, or choose a lens with fewer by --lens"
            ) from error

    def _solved(self, start: RigFit, steps: int) -> Adjusted:
        at = self._descend(start, steps, cut=False)
        at = self._descend(at, steps, cut=True)
        r = self._residuals(at)
        used = self._weights(r, cut=True) > 0
        # A view with fewer corners has no pose.
        used &= np.bincount(self.seen.view, used)[self.seen.view] >= _WEIGHTS.min_used
        sigma = self._final_sigmas(r, used)
        corner_sigma = self._by_image(self._image_squares(r, used), used, sigma)
        weight = used / corner_sigma**2
        A, B, C, _, _ = self._normal(at, weight)
        S = C - np.einsum("vij,vik->jk", B, np.linalg.solve(A, B))
        if self._fixed:
            covariance = np.zeros_like(S)
        else:
            covariance = np.asarray(np.linalg.inv(S))
        back = np.argsort(self._order)
        covariance = 0.5 * (covariance + covariance.T)
        return Adjusted(at, sigma, corner_sigma[back], covariance, used[back], r[back])

    def pose_information(self, found: Adjusted) -> tuple[FloatArray, FloatArray]:
        """Return what is known of xi in `exp(xi) T_cam0_board` of each view: its inverse covariance
        (V, 6, 6), lenses and pair as known, and its derivative (V, 6, S) by these, see `Layout`.
        """
        used = found.used[self._order]
        A, B, _, _, _ = self._normal(found.at, used / found.corner_sigma_px[self._order] ** 2)
        return np.asarray(A), np.asarray(-np.linalg.solve(A, B))

    def _descend(self, at: RigFit, steps: int, *, cut: bool) -> RigFit:
        damping = Damping(_ITERATIONS.max_damping)
        for _ in range(steps):
            r = self._residuals(at)
            weight = self._weights(r, cut=cut)
            before = self._cost(r, weight, at)
            new = self._step(at, weight, before, damping)
            if new is None:
                return at
            at, after = new
            if before - after < _ITERATIONS.converged_share * before:
                return at
        return at

    def _step(
        self, at: RigFit, weight: FloatArray, before: float, damping: Damping
    ) -> tuple[RigFit, float] | None:
        """Return a fit that costs no more, and its cost; None: no step leads to one."""
        system = self._normal(at, weight)

        def moved(value: float) -> RigFit | None:
            return self._moved(at, *_solved(system, value, fixed=self._fixed))

        def cost(new: RigFit | None) -> float:
            if new is None:
                return np.inf
            return self._cost(self._residuals(new), weight, new)

        found = damping.step(moved, cost, before)
        if found is None or found[0] is None:
            return None
        return found[0], found[1]

    def _points_cam0(self, at: RigFit) -> FloatArray:
        """Corners (R, 3) of the rows in the first camera."""
        depth = self._shape @ at.bow
        p = np.column_stack([self.seen.points_m, depth])[self.seen.point]
        T = at.T_cam0_board[self.seen.view]
        return np.asarray(np.einsum("rij,rj->ri", T[:, :3, :3], p) + T[:, :3, 3])

    def _residuals(self, at: RigFit) -> FloatArray:
        """Measured minus expected pixels (R, 2)."""
        p_cam0 = self._points_cam0(at)
        out = np.empty((len(p_cam0), 2))
        for c, camera in enumerate(at.cameras):
            rows = np.flatnonzero(self.seen.camera == c)
            T = at.T_cam_cam0[c]
            p_cam = p_cam0[rows] @ T[:3, :3].T + T[:3, 3]
            uv, valid = project_point(camera, p_cam)
            out[rows] = np.where(valid[:, None], self.seen.uv[rows] - uv, _WEIGHTS.behind_px)
        return out

    def _sigmas(self, r: FloatArray) -> FloatArray:
        """Robust standard deviation (C,) of a coordinate, of each camera."""
        length = np.linalg.norm(r, axis=1)
        out = np.full(self.seen.cameras, _WEIGHTS.min_sigma_px)
        for c in range(self.seen.cameras):
            mine = length[self.seen.camera == c]
            if len(mine):
                out[c] = max(median(mine) / MEDIAN_TO_SIGMA, _WEIGHTS.min_sigma_px)
        return out

    def _final_sigmas(self, r: FloatArray, used: BoolArray) -> FloatArray:
        """Root mean square (C,) of the residuals that are used, freed of the fit's own unknowns."""
        out = np.full(self.seen.cameras, _WEIGHTS.min_sigma_px)
        for c in range(self.seen.cameras):
            rows = used & (self.seen.camera == c)
            unknowns = _POSE * len(np.unique(self.seen.view[rows])) / self.seen.cameras
            freedom = max(2 * int(rows.sum()) - unknowns - 10, 1)
            out[c] = max(float(np.sqrt(np.sum(r[rows] ** 2) / freedom)), _WEIGHTS.min_sigma_px)
        return out

    def _image_medians(self, r: FloatArray) -> FloatArray:
        """Robust variance (R,) of a coordinate in the image of each corner, its pose as known."""
        length = np.linalg.norm(r, axis=1)
        order = np.lexsort((length, self._image))
        _, first, image, count = np.unique(
            self._image[order], return_index=True, return_inverse=True, return_counts=True
        )
        below_middle = order[first + (count - 1) // 2]
        above_middle = order[first + count // 2]
        middle = 0.5 * (length[below_middle] + length[above_middle])
        out = np.empty(len(length))
        out[order] = (middle / MEDIAN_TO_SIGMA)[image] ** 2
        return out

    def _image_squares(self, r: FloatArray, used: BoolArray) -> FloatArray:
        """Mean square (R,) of the used coordinates in the image of each corner."""
        total = np.bincount(self._image, used * np.sum(r**2, axis=1))
        count = np.bincount(self._image, used)
        return np.asarray((0.5 * total / np.maximum(count, 1))[self._image])

    def _by_image(self, variance: FloatArray, used: BoolArray, usual: FloatArray) -> FloatArray:
        """Standard deviation (R,) of a coordinate by the variance in its image (R,), freed of the
        pose, and by that of its camera's usual image (C,), which holds an image of few corners.
        """
        count = np.bincount(self._image, used)[self._image]
        freedom = np.maximum(2 * count - _POSE / self.seen.cameras, 1)
        weight = freedom / (freedom + 2 * _WEIGHTS.usual_corners)
        own = np.maximum(np.sqrt(variance * 2 * count / freedom), _WEIGHTS.min_sigma_px)
        return np.asarray(own**weight * usual[self.seen.camera] ** (1 - weight))

    def _weights(self, r: FloatArray, *, cut: bool) -> FloatArray:
        """Weights (R,) of squared residuals: Geman and McClure's with one standard deviation for
        each camera, as a start may fit images differently, or all or nothing with one for each
        image.
        """
        sigma = self._sigmas(r)
        if cut:
            every = np.ones(len(r), dtype=bool)
            own = self._by_image(self._image_medians(r), every, sigma)
            is_near = np.sum(r**2, axis=1) < (_WEIGHTS.cut_sigmas * own) ** 2
            is_near &= own < _WEIGHTS.max_image_ratio * sigma[self.seen.camera]
            return np.asarray(is_near / own**2)
        variance = sigma[self.seen.camera] ** 2
        squared = np.sum(r**2, axis=1) / variance
        return np.asarray(1 / (1 + squared / _WEIGHTS.quarter_sigmas**2) ** 2 / variance)

    def _cost(self, r: FloatArray, weight: FloatArray, at: RigFit) -> float:
        prior = 0.0
        for camera in at.cameras:
            prior += float(np.sum(np.square(camera.coefficients))) / _PRIORS.coefficient_sigma**2
        prior += float(np.sum(at.bow**2)) / self._bow_sigma_m**2
        return float(weight @ np.sum(r**2, axis=1)) + prior

    def _normal(self, at: RigFit, weight: FloatArray) -> tuple[FloatArray, ...]:
        """Blocks of the normal equations: views (V, 6, 6), views by shared (V, 6, S), shared
        (S, S), and the right-hand sides (V, 6) and (S,).
        """
        layout = layout_of(at.cameras)
        seen = self.seen
        p_cam0 = self._points_cam0(at)
        shared = np.zeros((len(p_cam0), 2, layout.size))
        own = np.zeros((len(p_cam0), 2, _POSE))
        r = np.zeros((len(p_cam0), 2))
        for c, camera in enumerate(at.cameras):
            rows = np.flatnonzero(seen.camera == c)
            T = at.T_cam_cam0[c]
            p_cam = p_cam0[rows] @ T[:3, :3].T + T[:3, 3]
            uv, valid = project_point(camera, p_cam)
            D = uv_D_point(camera, p_cam) * valid[:, None, None]
            by_cam0 = D @ T[:3, :3]
            shared[rows, :, layout.lenses[c]] = uv_D_camera(camera, p_cam) * valid[:, None, None]
            if c:
                shared[rows, :, layout.poses[c - 1]] = _by_twist(D, p_cam)
            axis = at.T_cam0_board[seen.view[rows], :3, 2]
            along = np.einsum("rij,rj->ri", by_cam0, axis)
            shape = self._shape[seen.point[rows]]
            shared[rows, :, layout.bow] = along[:, :, None] * shape[:, None]
            own[rows] = _by_twist(by_cam0, p_cam0[rows])
            r[rows] = np.where(valid[:, None], seen.uv[rows] - uv, 0.0)
        scale = np.sqrt(weight)[:, None]
        r = r * scale
        own = own * scale[..., None]
        flat = (shared * scale[..., None]).reshape(-1, layout.size)
        C = flat.T @ flat
        g = flat.T @ r.ravel()
        self._add_priors(C, g, at, layout)
        A = np.zeros((seen.views, _POSE, _POSE))
        B = np.zeros((seen.views, _POSE, layout.size))
        b = np.zeros((seen.views, _POSE))
        for v in range(seen.views):
            rows_of = slice(2 * self._first[v], 2 * self._first[v + 1])
            J = own.reshape(-1, _POSE)[rows_of]
            A[v] = J.T @ J + 1e-12 * np.eye(_POSE)
            if not weight[self._first[v] : self._first[v + 1]].any():
                A[v] = np.eye(_POSE)  # without a corner, the view stays where it is
            B[v] = J.T @ flat[rows_of]
            b[v] = J.T @ r.ravel()[rows_of]
        return A, B, C, b, g

    def _add_priors(self, C: FloatArray, g: FloatArray, at: RigFit, layout: Layout) -> None:
        """Add what is known before any view to the shared equations."""
        for camera, lens in zip(at.cameras, layout.lenses, strict=True):
            rows = np.arange(lens.start + _INTRINSIC, lens.stop)
            C[rows, rows] += 1 / _PRIORS.coefficient_sigma**2
            g[rows] -= np.array(camera.coefficients) / _PRIORS.coefficient_sigma**2
        rows = np.arange(layout.bow.start, layout.bow.stop)
        C[rows, rows] += 1 / self._bow_sigma_m**2
        g[rows] -= at.bow / self._bow_sigma_m**2

    def _moved(self, at: RigFit, own: FloatArray, shared: FloatArray) -> RigFit | None:
        """Return the unknowns moved by a step; None: a lens model does not allow it."""
        T_cam0_board = se3_exp(own) @ at.T_cam0_board
        if self._fixed:
            return replace(at, T_cam0_board=T_cam0_board)
        layout = layout_of(at.cameras)
        try:
            cameras = tuple(
                lens_moved(camera, shared[lens])
                for camera, lens in zip(at.cameras, layout.lenses, strict=True)
            )
        except CalibrationError:
            return None
        T_cam_cam0 = at.T_cam_cam0.copy()
        for c, pose in enumerate(layout.poses):
            T_cam_cam0[c + 1] = se3_exp(shared[pose]) @ T_cam_cam0[c + 1]
        return RigFit(cameras, T_cam_cam0, T_cam0_board, at.bow + shared[layout.bow])


def _by_twist(uv_D_p: FloatArray, p: FloatArray) -> FloatArray:
    """Derivative (N, 2, 6) by xi of `exp(xi) p`."""
    return np.concatenate([uv_D_p, -uv_D_p @ so3_hat(p)], axis=2)


def _solved(
    system: tuple[FloatArray, ...], damping: float, *, fixed: bool
) -> tuple[FloatArray, FloatArray]:
    """Steps of the views (V, 6) and of the shared unknowns (S,)."""
    A, B, C, b, g = system
    A = A + damping * A * np.eye(_POSE)
    own_alone = np.asarray(np.linalg.solve(A, b[..., None])[..., 0], dtype=np.float64)
    if fixed:
        return own_alone, np.zeros_like(g)
    A_B = np.linalg.solve(A, B)
    S = C + damping * np.diag(np.diag(C)) - np.einsum("vij,vik->jk", B, A_B)
    shared = np.linalg.solve(S, g - np.einsum("vij,vi->j", B, own_alone))
    own: FloatArray = own_alone - A_B @ shared
    return own, np.asarray(shared, dtype=np.float64)
