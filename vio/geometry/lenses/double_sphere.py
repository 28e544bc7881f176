"""The double sphere model: a point goes to one unit sphere, from there to a second one `xi` away, and
from there through a pinhole `alpha / (1 - alpha)` off its centre.

Lenses up to and beyond 180 degrees; the inverse is closed.
Reference: Usenko, Demmel & Cremers, The double sphere camera model (2018).
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
from vio.geometry.lie import FloatArray


def _limit(c: Coefficients) -> float:
    """Return -cos of the angle off the axis up to which the model projects (equation 43)."""
    xi, alpha = c
    if alpha <= 0.5:
        limit = alpha / (1 - alpha)
    else:
        limit = (1 - alpha) / alpha
    return float((limit + xi) / np.sqrt(2 * limit * xi + xi * xi + 1))


class DoubleSphere(Lens):
    """xi alpha; -1 < xi <= 1 and 0 <= alpha < 1."""

    name = "double_sphere"
    parameters = ("xi", "alpha")
    counts = (2,)
    files = FileNames(
        kalibr={2: KalibrForm("ds", "none", 2)},
        basalt="ds",
        # the unified model in Basalt's parameters is a double sphere with one centre
        tools=(ToolForm("basalt", "ucm", ("", "alpha")),),
    )
    choices = (Choice("double_sphere", 2, 3),)

    def fault(self, c: Coefficients) -> str | None:
        xi, alpha = c
        if -1 < xi <= 1 and 0 <= alpha < 1:
            return None
        return (
            "the double sphere model needs -1 < xi <= 1 and 0 <= alpha < 1, got "
            f"xi={xi:g}, alpha={alpha:g}; "
            "check their order"
        )

    def project(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, BoolArray]:
        xi, alpha = c
        d1 = np.linalg.norm(p, axis=-1)
        valid = (p[..., 2] > -_limit(c) * d1) & (d1 > TINY)
        shifted = xi * d1 + p[..., 2]
        d2 = np.sqrt(p[..., 0] ** 2 + p[..., 1] ** 2 + shifted**2)
        depth = np.where(valid, alpha * d2 + (1 - alpha) * shifted, 1.0)
        return p[..., :2] / depth[..., None], valid

    def unproject(self, c: Coefficients, xy: FloatArray) -> tuple[FloatArray, BoolArray]:
        xi, alpha = c
        r2 = np.einsum("...i,...i->...", xy, xy)
        root = 1 - (2 * alpha - 1) * r2
        valid: BoolArray = np.isfinite(r2) & (root >= 0)
        r2 = np.where(valid, r2, 0.0)
        divisor = alpha * np.sqrt(np.where(valid, root, 0.0)) + 1 - alpha
        mz = (1 - alpha * alpha * r2) / divisor
        second = mz * mz + (1 - xi * xi) * r2
        valid = valid & (second >= 0)
        scale = (mz * xi + np.sqrt(np.where(valid, second, 0.0))) / (mz * mz + r2)
        return unit_ray(np.where(valid[..., None], xy, 0.0), scale, scale * mz - xi), valid

    def derivatives(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        xi, alpha = c
        d1 = np.maximum(np.linalg.norm(p, axis=-1), TINY)
        xy, valid = self.project(c, p)
        shifted = xi * d1 + p[..., 2]
        square = p[..., 0] ** 2 + p[..., 1] ** 2 + shifted**2
        d2 = np.maximum(np.sqrt(square), TINY)
        inverse = 1 / np.where(valid, alpha * d2 + (1 - alpha) * shifted, 1.0)
        shifted_by_p = xi * p / d1[..., None]
        shifted_by_p[..., 2] += 1
        d2_by_p = shifted[..., None] * shifted_by_p
        d2_by_p[..., :2] += p[..., :2]
        depth_by_p = alpha * d2_by_p / d2[..., None] + (1 - alpha) * shifted_by_p
        by_p = plane_by_point(p, inverse, -(inverse**2)[..., None] * depth_by_p)
        depth_by_c = np.stack([(alpha * shifted / d2 + 1 - alpha) * d1, d2 - shifted], axis=-1)
        by_c = -xy[..., None] * (inverse[..., None] * depth_by_c)[..., None, :]
        return by_p, by_c

    def max_angle(self, c: Coefficients) -> float:
        return float(np.arccos(-_limit(c)))

    def start(self, count: int) -> Coefficients:
        return (0.0, 0.5)


LENS = DoubleSphere()
