"""The equidistant model: the radius is a polynomial of the angle off the axis.

Reference: Kannala & Brandt, A generic camera model (2006), with `k1 k2 k3 k4` on the angle's powers
3 to 9, as OpenCV's fisheye model.
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
    near_axis,
    plane_by_point,
)
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Tolerance

_NEWTON_STEPS: Tolerance[int] = 30
_NEWTON_TOLERANCE: Tolerance[float] = 1e-11  # on the normalised image plane: about 1e-8 px


def _polynomial(c: Coefficients, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the distorted angle and its derivative."""
    k1, k2, k3, k4 = c
    t2 = theta * theta
    value = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
    return value, slope


@lru_cache(maxsize=256)
def _max_theta(c: Coefficients) -> float:
    """Angle in radians where the distorted angle stops growing, at most pi."""
    k1, k2, k3, k4 = c
    roots = np.roots([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0])
    positive = [float(root.real) for root in roots if abs(root.imag) < 1e-9 and root.real > 0]
    return float(min([np.pi, *np.sqrt(positive)]))


class Equidistant(Lens):
    """k1 k2 k3 k4; limited to where the distorted angle grows."""

    name = "equidistant"
    parameters = ("k1", "k2", "k3", "k4")
    counts = (4,)
    files = FileNames(
        distortion=("equidistant", "equi", "fisheye", "kannala_brandt"),
        kalibr={4: KalibrForm("pinhole", "equidistant", 0)},
        ros={4: "equidistant"},
        basalt="kb4",
        tools=(
            ToolForm("camodocal", "kannala_brandt", ("k2", "k3", "k4", "k5")),
            ToolForm("orbslam", "kannalabrandt8", ("k1", "k2", "k3", "k4")),
            ToolForm("monado", "fisheye_equidistant4", ("k1", "k2", "k3", "k4")),
            ToolForm("depthai", "fisheye"),
        ),
        sensor_yaml="equidistant",
        colmap={4: ("OPENCV_FISHEYE", 4)},
    )
    choices = (Choice("equidistant", 4, 2),)

    def project(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, BoolArray]:
        radius = np.linalg.norm(p[..., :2], axis=-1)
        theta = np.arctan2(radius, p[..., 2])
        valid = (theta < _max_theta(c)) & (np.linalg.norm(p, axis=-1) > 1e-12)
        theta_d, _ = _polynomial(c, theta)
        on_axis = radius < 1e-12
        scale = np.where(on_axis, 0.0, theta_d / np.where(on_axis, 1.0, radius))
        return p[..., :2] * scale[..., None], valid

    def unproject(self, c: Coefficients, xy: FloatArray) -> tuple[FloatArray, BoolArray]:
        finite: BoolArray = np.asarray(np.isfinite(xy).all(axis=-1))
        xy = np.where(finite[..., None], xy, 0.0)
        theta_d = np.linalg.norm(xy, axis=-1)
        limit = _max_theta(c)
        theta = np.minimum(theta_d, 0.9 * limit)
        for _ in range(_NEWTON_STEPS):
            value, slope = _polynomial(c, theta)
            if np.abs(value - theta_d).max(initial=0.0) < _NEWTON_TOLERANCE:
                break
            step = (value - theta_d) / np.where(np.abs(slope) < 1e-3, 1e-3, slope)
            theta = np.clip(theta - step, 0.0, limit)
        value, _ = _polynomial(c, theta)
        valid = finite & (np.abs(value - theta_d) < 1e-8)
        on_axis = theta_d < 1e-12
        direction = xy / np.where(on_axis, 1.0, theta_d)[..., None]
        ray = np.concatenate(
            [np.sin(theta)[..., None] * direction, np.cos(theta)[..., None]], axis=-1
        )
        return ray, valid

    def derivatives(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        radius, on_axis = near_axis(p)
        z = p[..., 2]
        theta = np.arctan2(radius, z)
        theta_d, slope = _polynomial(c, theta)
        scale = np.where(on_axis, 1 / np.where(on_axis, z, 1.0), theta_d / radius)
        # d theta = (z d radius - radius dz) / |p|^2
        turn = slope / (radius * np.einsum("...i,...i->...", p, p))
        along = p[..., :2] / radius[..., None]
        by_p = np.empty(p.shape)
        by_p[..., :2] = (turn * z - theta_d / radius**2)[..., None] * along
        by_p[..., 2] = -turn * radius
        by_p = np.where(on_axis[..., None], 0.0, by_p)
        powers = np.stack([theta ** (2 * k + 3) for k in range(4)], axis=-1)
        return plane_by_point(p, scale, by_p), along[..., None] * powers[..., None, :]

    def max_angle(self, c: Coefficients) -> float:
        return _max_theta(c)

    def start(self, count: int) -> Coefficients:
        return (0.0,) * count

    def bent(
        self, c: Coefficients, radial: tuple[float, float], tangential: tuple[float, float]
    ) -> tuple[str, Coefficients]:
        k1 = c[0] + radial[0]
        k2 = c[1] + radial[1]
        return self.name, (k1, k2, *c[2:])


LENS = Equidistant()
