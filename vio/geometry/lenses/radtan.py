"""The radial-tangential model, with OpenCV's rational terms where there are eight coefficients.

References: Brown, Close-range camera calibration (1971), as OpenCV, EuRoC and KITTI write it with
`k1 k2 p1 p2 [k3]`; OpenCV's `k4 k5 k6` divide the radial factor.
"""

from __future__ import annotations

from functools import lru_cache
from typing import ClassVar

import numpy as np

from vio.geometry.lenses.model import (
    BoolArray,
    Choice,
    Coefficients,
    FileNames,
    KalibrForm,
    Lens,
    ToolForm,
)
from vio.geometry.lenses.pinhole import pinhole, pinhole_by_point
from vio.geometry.lie import FloatArray
from vio.numerics.compiled import compiled
from vio.numerics.kinds import Capacity, Tolerance

_NEWTON_STEPS: Tolerance[int] = 30
_NEWTON_TOLERANCE: Tolerance[float] = 1e-11  # on the normalised image plane: about 1e-8 px
_MAX_NEWTON_STEP = 0.5  # on the normalised image plane
_MIN_DETERMINANT: Tolerance[float] = 1e-6
_SAME_POINT: Tolerance[float] = 1e-8  # on the normalised image plane


def _five(c: Coefficients) -> tuple[float, float, float, float, float]:
    """Return the radial-tangential coefficients k1 k2 p1 p2 k3; an absent k3 is zero."""
    k1, k2, p1, p2 = c[:4]
    return k1, k2, p1, p2, c[4] if len(c) > 4 else 0.0


@lru_cache(maxsize=256)
def _eight(c: Coefficients) -> FloatArray:
    """Return all coefficients (8,); those that are absent are zero, and change nothing."""
    return np.array([*c, *(0.0,) * (8 - len(c))])


def _divisor(c: Coefficients, r2: FloatArray) -> FloatArray | None:
    """Divisor of the rational model's radial factor; None: not rational."""
    if len(c) < 8:
        return None
    k4, k5, k6 = c[5:]
    return 1 + r2 * (k4 + r2 * (k5 + r2 * k6))


@compiled
def _distorted_point(k: FloatArray, x: float, y: float) -> tuple[float, float]:
    """Return a point of the plane of tangents with distortion by coefficients (8,)."""
    r2 = x * x + y * y
    radial = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    radial = radial / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
    u = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x)
    v = y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y
    return u, v


@compiled
def _distorted_by_point(k: FloatArray, x: float, y: float) -> tuple[float, float, float]:
    """Derivatives of `_distorted_point`: u by x, v by y, and u by y, which is v by x."""
    r2 = x * x + y * y
    below = 1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    below_D_r2 = k[5] + r2 * (2 * k[6] + r2 * 3 * k[7])
    above = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    above_D_r2 = 2 * k[0] + r2 * (4 * k[1] + r2 * 6 * k[4])  # twice
    radial = above / below
    slope = (above_D_r2 - 2 * above * below_D_r2 / below) / below
    u_D_x = radial + slope * x * x + 2 * k[2] * y + 6 * k[3] * x
    v_D_y = radial + slope * y * y + 6 * k[2] * y + 2 * k[3] * x
    return u_D_x, v_D_y, slope * x * y + 2 * k[2] * x + 2 * k[3] * y


@compiled
def _distort_points(
    k: FloatArray, limit: float, xy: FloatArray, valid: BoolArray, out: FloatArray
) -> None:
    """Write the valid points (N, 2) with distortion, and clear `valid` (N,) beyond a radius; the
    others are written as zero.
    """
    for n in range(len(xy)):
        x = xy[n, 0]
        y = xy[n, 1]
        if not valid[n] or not np.sqrt(x * x + y * y) < limit:
            valid[n] = False
            x = 0.0
            y = 0.0
        out[n, 0], out[n, 1] = _distorted_point(k, x, y)


@compiled
def _distort_points_by_xy(k: FloatArray, xy: FloatArray, out: FloatArray) -> None:
    """Write the derivatives (N, 2, 2) of points (N, 2) with distortion by the points."""
    for n in range(len(xy)):
        u_D_x, v_D_y, u_D_y = _distorted_by_point(k, xy[n, 0], xy[n, 1])
        out[n, 0, 0] = u_D_x
        out[n, 1, 1] = v_D_y
        out[n, 0, 1] = out[n, 1, 0] = u_D_y


@compiled
def _undistort_points(
    k: FloatArray, limit: float, target: FloatArray, xy: FloatArray, valid: BoolArray
) -> None:
    """Improve points xy (N, 2) by Newton's method until their distorted ones are those wanted
    (N, 2), all with the same number of steps; write where that was reached within a radius (N,).
    """
    for step in range(_NEWTON_STEPS + 1):
        is_found = True
        for n in range(len(xy)):
            u, v = _distorted_point(k, xy[n, 0], xy[n, 1])
            du = abs(u - target[n, 0])
            dv = abs(v - target[n, 1])
            is_found = is_found and du < _NEWTON_TOLERANCE and dv < _NEWTON_TOLERANCE
        if is_found or step == _NEWTON_STEPS:
            break
        for n in range(len(xy)):
            x = xy[n, 0]
            y = xy[n, 1]
            u, v = _distorted_point(k, x, y)
            u_D_x, v_D_y, u_D_y = _distorted_by_point(k, x, y)
            det = u_D_x * v_D_y - u_D_y * u_D_y
            if abs(det) < _MIN_DETERMINANT:
                det = _MIN_DETERMINANT
            du = u - target[n, 0]
            dv = v - target[n, 1]
            dx = (v_D_y * du - u_D_y * dv) / det
            dy = (u_D_x * dv - u_D_y * du) / det
            xy[n, 0] = x - min(max(dx, -_MAX_NEWTON_STEP), _MAX_NEWTON_STEP)
            xy[n, 1] = y - min(max(dy, -_MAX_NEWTON_STEP), _MAX_NEWTON_STEP)
    for n in range(len(xy)):
        x = xy[n, 0]
        y = xy[n, 1]
        u, v = _distorted_point(k, x, y)
        du = u - target[n, 0]
        dv = v - target[n, 1]
        near = np.sqrt(du * du + dv * dv) < _SAME_POINT
        valid[n] = valid[n] and near and np.sqrt(x * x + y * y) < limit


def distort_by_xy(c: Coefficients, xy: FloatArray) -> FloatArray:
    """Derivative (..., 2, 2) of points (..., 2) with distortion by these points."""
    points = np.ascontiguousarray(xy).reshape(-1, 2)
    out = np.empty((len(points), 2, 2))
    _distort_points_by_xy(_eight(c), points, out)
    return out.reshape(*xy.shape, 2)


def distort_by_coefficients(c: Coefficients, xy: FloatArray) -> FloatArray:
    """Derivative (..., 2, n) of points (..., 2) with distortion by the n coefficients."""
    k1, k2, _, _, k3 = _five(c)
    x = xy[..., 0]
    y = xy[..., 1]
    r2 = x * x + y * y
    divisor = _divisor(c, r2)
    above = xy if divisor is None else xy / divisor[..., None]
    powers = [r2, r2 * r2, r2**3]
    out = np.empty((*xy.shape[:-1], 2, len(c)))
    out[..., 0] = above * powers[0][..., None]
    out[..., 1] = above * powers[1][..., None]
    both = 2 * x * y
    out[..., 2] = np.stack([both, r2 + 2 * y * y], axis=-1)
    out[..., 3] = np.stack([r2 + 2 * x * x, both], axis=-1)
    if len(c) > 4:
        out[..., 4] = above * powers[2][..., None]
    if divisor is not None:
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / divisor
        for k, power in enumerate(powers):
            out[..., 5 + k] = -above * (radial * power)[..., None]
    return out


@lru_cache(maxsize=256)
def max_radius(c: Coefficients) -> float:
    """Radius on the undistorted plane where the radial polynomial stops growing: the model folds
    back beyond it.
    """
    k1, k2, _, _, k3 = _five(c)
    if len(c) == 8:
        return _rational_max_radius((1.0, k1, k2, k3), (1.0, *c[5:]))
    # In 1/r^2 the polynomial is monic, which avoids dividing by a small coefficient.
    roots = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3])
    inverse = [float(root.real) for root in roots if abs(root.imag) < 1e-12 and root.real > 1e-12]
    if inverse:
        return float(1 / np.sqrt(max(inverse)))
    return np.inf


def _rational_max_radius(above: tuple[float, ...], below: tuple[float, ...]) -> float:
    """Radius where `r above(r^2) / below(r^2)` stops growing, or the divisor vanishes; ascending
    powers of r^2.
    """
    n = np.polynomial.Polynomial(above)
    d = np.polynomial.Polynomial(below)
    s = np.polynomial.Polynomial([0.0, 1.0])
    slope = n * d + 2 * s * (n.deriv() * d - n * d.deriv())
    roots = [*slope.roots(), *d.roots()]
    positive = [float(root.real) for root in roots if abs(root.imag) < 1e-9 and root.real > 1e-12]
    if positive:
        return float(np.sqrt(min(positive)))
    return np.inf


def distorted(c: Coefficients, xy: FloatArray, valid: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Return points (..., 2) with distortion, and which of the valid ones (...) are inside the
    model's radius; the others' values are finite.
    """
    points = np.ascontiguousarray(xy).reshape(-1, 2)
    inside = np.array(valid).reshape(-1)
    out = np.empty(points.shape)
    _distort_points(_eight(c), max_radius(c), points, inside, out)
    return out.reshape(xy.shape), inside.reshape(valid.shape)


def undistort(c: Coefficients, target: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return points (..., 2) without distortion, by Newton's method, and where it converged."""
    finite = np.isfinite(target)
    goal = np.where(finite, target, 0.0).reshape(-1, 2)
    xy = goal.copy()
    valid = finite.all(axis=-1).reshape(-1)
    _undistort_points(_eight(c), max_radius(c), goal, xy, valid)
    return xy.reshape(target.shape), valid.reshape(target.shape[:-1])


class RadialTangential(Lens):
    """k1 k2 p1 p2 [k3 [k4 k5 k6]]; limited to where the radial factor grows, before the camera."""

    name = "radtan"
    parameters = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    counts = (4, 5, 8)
    files = FileNames(
        distortion=(
            "radial-tangential",
            "radtan",
            "plumb_bob",
            "rational_polynomial",
            "radialtangential",  # OKVIS
            "radialtangential8",
            "plumb_bob8",  # OKVIS2
        ),
        # Kalibr itself has four coefficients.
        kalibr=dict.fromkeys((4, 5, 8), KalibrForm("pinhole", "radtan", 0)),
        ros={4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"},
        basalt="pinhole-radtan8",
        basalt_constants={"rpmax": 0.0},  # no limit of the radius
        tools=(
            ToolForm("camodocal", "pinhole", ("k1", "k2", "p1", "p2")),
            ToolForm("camodocal", "pinhole_full", parameters),
            ToolForm("orbslam", "pinhole", parameters[:5]),
            ToolForm("monado", "pinhole_radtan5", parameters[:5]),
            ToolForm("depthai", "perspective"),
        ),
        sensor_yaml="radial-tangential",
        opencv=True,
        colmap={4: ("OPENCV", 4), 5: ("FULL_OPENCV", 8), 8: ("FULL_OPENCV", 8)},
    )
    choices = (Choice("radtan", 4, 1), Choice("radtan5", 5, 6), Choice("rational", 8, 8))
    planar = True
    linear_tiles: ClassVar[Capacity[int]] = 2
    zero_is_pinhole = True

    def project(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, BoolArray]:
        return distorted(c, *pinhole(p))

    def unproject(self, c: Coefficients, xy: FloatArray) -> tuple[FloatArray, BoolArray]:
        xy, valid = undistort(c, xy)
        ray = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        return ray / np.linalg.norm(ray, axis=-1, keepdims=True), valid

    def derivatives(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        xy, _ = pinhole(p)
        return distort_by_xy(c, xy) @ pinhole_by_point(p), distort_by_coefficients(c, xy)

    def max_angle(self, c: Coefficients) -> float:
        return float(np.arctan(max_radius(c)))

    def start(self, count: int) -> Coefficients:
        return (0.0,) * count

    def radius_powers(self, count: int) -> tuple[int, ...]:
        return (2, 4, 1, 1, 6, 2, 4, 6)[:count]

    def bent(
        self, c: Coefficients, radial: tuple[float, float], tangential: tuple[float, float]
    ) -> tuple[str, Coefficients]:
        more = (*radial, *tangential)
        return self.name, (*(old + add for old, add in zip(c, more, strict=False)), *c[4:])


LENS = RadialTangential()
