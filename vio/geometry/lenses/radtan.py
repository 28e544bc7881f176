"""The radial-tangential model, with OpenCV's rational terms where there are eight coefficients.

References: Brown, Close-range camera calibration (1971), as OpenCV, EuRoC and KITTI write it with
`k1 k2 p1 p2 [k3]`; OpenCV's `k4 k5 k6` divide the radial factor.
"""

from __future__ import annotations

from functools import lru_cache

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

_NEWTON_STEPS = 30
_NEWTON_TOLERANCE = 1e-11  # on the normalised image plane: about 1e-8 px


def _five(c: Coefficients) -> tuple[float, float, float, float, float]:
    """Return the radial-tangential coefficients k1 k2 p1 p2 k3; an absent k3 is zero."""
    k1, k2, p1, p2 = c[:4]
    return k1, k2, p1, p2, c[4] if len(c) > 4 else 0.0


def _divisor(c: Coefficients, r2: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Divisor of the rational model's radial factor and its derivative with respect to `r2`.

    None: not rational.
    """
    if len(c) < 8:
        return None
    k4, k5, k6 = c[5:]
    return 1 + r2 * (k4 + r2 * (k5 + r2 * k6)), k4 + r2 * (2 * k5 + r2 * 3 * k6)


def distort(c: Coefficients, xy: FloatArray) -> FloatArray:
    """Return points (..., 2) of the plane of tangents with the lens's distortion."""
    k1, k2, p1, p2, k3 = _five(c)
    x = xy[..., 0]
    y = xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if (divisor := _divisor(c, r2)) is not None:
        radial = radial / divisor[0]
    out = np.empty(xy.shape)
    out[..., 0] = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    out[..., 1] = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return out


def distort_by_xy(c: Coefficients, xy: FloatArray) -> FloatArray:
    """Derivative (..., 2, 2) of `distort` by its points (..., 2)."""
    k1, k2, p1, p2, k3 = _five(c)
    x = xy[..., 0]
    y = xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * k1 + r2 * (4 * k2 + r2 * 6 * k3)
    if (divisor := _divisor(c, r2)) is not None:
        below, below_D_r2 = divisor
        radial, slope = radial / below, (slope - 2 * radial * below_D_r2 / below) / below
    out = np.empty((*xy.shape[:-1], 2, 2))
    out[..., 0, 0] = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    out[..., 1, 1] = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    out[..., 0, 1] = out[..., 1, 0] = slope * x * y + 2 * p1 * x + 2 * p2 * y
    return out


def distort_by_coefficients(c: Coefficients, xy: FloatArray) -> FloatArray:
    """Derivative (..., 2, n) of `distort` by its n coefficients."""
    k1, k2, _, _, k3 = _five(c)
    x = xy[..., 0]
    y = xy[..., 1]
    r2 = x * x + y * y
    divisor = _divisor(c, r2)
    above = xy if divisor is None else xy / divisor[0][..., None]
    powers = [r2, r2 * r2, r2**3]
    out = np.empty((*xy.shape[:-1], 2, len(c)))
    out[..., 0] = above * powers[0][..., None]
    out[..., 1] = above * powers[1][..., None]
    out[..., 2] = np.stack([2 * x * y, r2 + 2 * y * y], axis=-1)
    out[..., 3] = np.stack([r2 + 2 * x * x, 2 * x * y], axis=-1)
    if len(c) > 4:
        out[..., 4] = above * powers[2][..., None]
    if divisor is not None:
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / divisor[0]
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
    return float(1 / np.sqrt(max(inverse))) if inverse else np.inf


def _rational_max_radius(above: tuple[float, ...], below: tuple[float, ...]) -> float:
    """Radius where `r above(r^2) / below(r^2)` stops growing, or the divisor vanishes; ascending
    powers of r^2.
    """
    n = np.polynomial.Polynomial(above)
    d = np.polynomial.Polynomial(below)
    s = np.polynomial.Polynomial([0.0, 1.0])
    roots = [*(n * d + 2 * s * (n.deriv() * d - n * d.deriv())).roots(), *d.roots()]
    positive = [float(root.real) for root in roots if abs(root.imag) < 1e-9 and root.real > 1e-12]
    return float(np.sqrt(min(positive))) if positive else np.inf


def _radius(xy: FloatArray) -> FloatArray:
    """Distance (...) of points (..., 2) from the origin."""
    x = xy[..., 0]
    y = xy[..., 1]
    return np.sqrt(x * x + y * y)


def distorted(c: Coefficients, xy: FloatArray, valid: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Return points (..., 2) with distortion, and which of the valid ones (...) are inside the
    model's radius; the others' values are finite.
    """
    valid = valid & (_radius(xy) < max_radius(c))
    return distort(c, xy if valid.all() else np.where(valid[..., None], xy, 0.0)), valid


def undistort(c: Coefficients, target: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return points (..., 2) without distortion, by Newton's method, and where it converged."""
    xy = np.where(np.isfinite(target), target, 0.0)
    goal = xy
    for _ in range(_NEWTON_STEPS):
        now = distort(c, xy)
        residual = now - goal
        if np.abs(residual).max(initial=0.0) < _NEWTON_TOLERANCE:
            break
        J = distort_by_xy(c, xy)
        det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
        det = np.where(np.abs(det) < 1e-6, 1e-6, det)
        step = np.empty(xy.shape)
        step[..., 0] = J[..., 1, 1] * residual[..., 0] - J[..., 0, 1] * residual[..., 1]
        step[..., 1] = J[..., 0, 0] * residual[..., 1] - J[..., 1, 0] * residual[..., 0]
        xy = xy - np.minimum(np.maximum(step / det[..., None], -0.5), 0.5)
    else:
        now = distort(c, xy)
    found = _radius(now - target) < 1e-8
    return xy, np.logical_and(found, _radius(xy) < max_radius(c))


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
    linear_tiles = 2
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
