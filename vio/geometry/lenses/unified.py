"""The unified model ("omni", MEI): a point goes to the unit sphere, and from there through a pinhole
that is `xi` off its centre; radial-tangential distortion may follow.

Lenses up to and beyond 180 degrees; the inverse is closed but for the distortion.
Reference: Mei & Rives, Single view point omnidirectional camera calibration from planar grids
(2007).
"""

from __future__ import annotations

import numpy as np

from vio.geometry.lenses.model import (
    TINY,
    BoolArray,
    Choice,
    Coefficients,
    FileNames,
    KalibrForm,
    Lens,
    ToolForm,
    plane_by_point,
    unit_ray,
)
from vio.geometry.lenses.radtan import (
    distort_by_coefficients,
    distort_by_xy,
    distorted,
    max_radius,
    undistort,
)
from vio.geometry.lie import FloatArray


def _limit(xi: float) -> float:
    """Return -cos of the angle off the axis where the image of the sphere folds back."""
    return xi if xi <= 1 else 1 / xi


def _sphere(xi: float, p: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the model without distortion."""
    distance = np.linalg.norm(p, axis=-1)
    # Beyond the cone where the image of the sphere folds back, two points would share a pixel.
    valid = (p[..., 2] > -_limit(xi) * distance) & (distance > TINY)
    depth = np.where(valid, p[..., 2] + xi * distance, 1.0)
    return p[..., :2] / depth[..., None], valid


def _sphere_ray(xi: float, xy: FloatArray) -> tuple[FloatArray, BoolArray]:
    r2 = np.einsum("...i,...i->...", xy, xy)
    root = 1 + (1 - xi * xi) * r2
    valid: BoolArray = np.isfinite(r2) & (root >= 0)
    scale = (xi + np.sqrt(np.where(valid, root, 0.0))) / (1 + np.where(valid, r2, 0.0))
    return unit_ray(np.where(valid[..., None], xy, 0.0), scale, scale - xi), valid


class Unified(Lens):
    """xi [k1 k2 p1 p2]; xi is not negative."""

    name = "unified"
    parameters = ("xi", "k1", "k2", "p1", "p2")
    counts = (1, 5)
    files = FileNames(
        kalibr={1: KalibrForm("omni", "none", 1), 5: KalibrForm("omni", "radtan", 1)},
        tools=(
            ToolForm("camodocal", "mei", ("xi", "k1", "k2", "p1", "p2")),
            ToolForm("ncamera", "unified-projection", ("xi",)),
            ToolForm("ncamera", "omni", ("xi",)),
        ),
    )
    choices = (Choice("unified", 5, 7),)

    def fault(self, c: Coefficients) -> str | None:
        if c[0] < 0:
            return f"the unified model's xi must not be negative, got {c[0]:g}"
        return None

    def project(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, BoolArray]:
        xy, valid = _sphere(c[0], p)
        if len(c) > 1:
            return distorted(c[1:], xy, valid)
        return (xy, valid)

    def unproject(self, c: Coefficients, xy: FloatArray) -> tuple[FloatArray, BoolArray]:
        valid: BoolArray = np.asarray(np.isfinite(xy).all(axis=-1))
        if len(c) > 1:
            xy, valid = undistort(c[1:], xy)
        ray, inside = _sphere_ray(c[0], xy)
        return ray, valid & inside

    def derivatives(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        xi = c[0]
        distance = np.maximum(np.linalg.norm(p, axis=-1), TINY)
        xy, valid = _sphere(xi, p)
        inverse = 1 / np.where(valid, p[..., 2] + xi * distance, 1.0)
        depth_by_p = xi * p / distance[..., None]
        depth_by_p[..., 2] += 1
        by_p = plane_by_point(p, inverse, -(inverse**2)[..., None] * depth_by_p)
        by_xi = (-xy * (inverse * distance)[..., None])[..., None]
        if len(c) == 1:
            return by_p, by_xi
        J = distort_by_xy(c[1:], xy)
        by_bend = distort_by_coefficients(c[1:], xy)
        return J @ by_p, np.concatenate([J @ by_xi, by_bend], axis=-1)

    def max_angle(self, c: Coefficients) -> float:
        fold = float(np.arccos(-_limit(c[0])))
        radius = max_radius(c[1:]) if len(c) > 1 else np.inf
        if not np.isfinite(radius):
            return fold
        ray, inside = _sphere_ray(c[0], np.array([radius, 0.0]))
        if inside:
            return min(fold, float(np.arctan2(ray[0], ray[2])))
        return fold

    def start(self, count: int) -> Coefficients:
        return (0.8, *(0.0,) * (count - 1))

    def focal_factor(self, c: Coefficients) -> float:
        return 1 + c[0]

    def bent(
        self, c: Coefficients, radial: tuple[float, float], tangential: tuple[float, float]
    ) -> tuple[str, Coefficients]:
        old = c[1:] or (0.0, 0.0, 0.0, 0.0)
        more = (*radial, *tangential)
        return self.name, (c[0], *(k + add for k, add in zip(old, more, strict=True)))


LENS = Unified()
