"""The enhanced unified model (EUCM): a point goes to an ellipsoid of shape `beta`, and from there
through a pinhole `alpha / (1 - alpha)` off its centre.

`x' = x / (alpha d + (1 - alpha) z)` with `d = sqrt(beta (x^2 + y^2) + z^2)`; beta = 1 is the
unified model in other parameters. Lenses up to and beyond 180 degrees; the inverse is closed.
Reference: Khomutenko, Garcia & Martinet, An enhanced unified camera model (2016); its limits as
written by Usenko, Demmel & Cremers (2018), section 2.3.
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


def _limit(alpha: float) -> float:
    """Return -z / d beyond which the ellipsoid's image folds back, or lies behind the pinhole."""
    if alpha <= 0.5:
        return alpha / (1 - alpha)
    return (1 - alpha) / alpha


class EnhancedUnified(Lens):
    """alpha beta; 0 <= alpha < 1 and beta > 0."""

    name = "eucm"
    parameters = ("alpha", "beta")
    counts = (2,)
    files = FileNames(
        kalibr={2: KalibrForm("eucm", "none", 2)},
        basalt="eucm",
        tools=(ToolForm("okvis", "eucm", ("alpha", "beta")),),
        colmap={2: ("EUCM", 2)},
    )
    choices = (Choice("eucm", 2, 4),)

    def fault(self, c: Coefficients) -> str | None:
        alpha, beta = c
        if 0 <= alpha < 1 and beta > 0:
            return None
        return (
            f"the eucm model needs 0 <= alpha < 1 and beta > 0, got alpha={alpha:g}, "
            f"beta={beta:g}; check their order"
        )

    def project(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, BoolArray]:
        alpha, _ = c
        z = p[..., 2]
        d = self._distance(c, p)
        valid = (z > -_limit(alpha) * d) & (np.linalg.norm(p, axis=-1) > TINY)
        depth = np.where(valid, alpha * d + (1 - alpha) * z, 1.0)
        return p[..., :2] / depth[..., None], valid

    def unproject(self, c: Coefficients, xy: FloatArray) -> tuple[FloatArray, BoolArray]:
        alpha, beta = c
        r2 = np.einsum("...i,...i->...", xy, xy)
        root = 1 - (2 * alpha - 1) * beta * r2
        valid: BoolArray = np.isfinite(r2) & (root >= 0)
        r2 = np.where(valid, r2, 0.0)
        below = alpha * np.sqrt(np.where(valid, root, 1.0)) + 1 - alpha
        mz = (1 - beta * alpha * alpha * r2) / below
        return unit_ray(np.where(valid[..., None], xy, 0.0), np.ones_like(mz), mz), valid

    def derivatives(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        alpha, beta = c
        z = p[..., 2]
        d = np.maximum(self._distance(c, p), TINY)
        xy, valid = self.project(c, p)
        inverse = 1 / np.where(valid, alpha * d + (1 - alpha) * z, 1.0)
        depth_by_p = alpha * p * [beta, beta, 1.0] / d[..., None]
        depth_by_p[..., 2] += 1 - alpha
        by_p = plane_by_point(p, inverse, -(inverse**2)[..., None] * depth_by_p)
        across2 = np.einsum("...i,...i->...", p[..., :2], p[..., :2])
        depth_by_c = np.stack([d - z, 0.5 * alpha * across2 / d], axis=-1)
        by_c = -xy[..., None] * (inverse[..., None] * depth_by_c)[..., None, :]
        return by_p, by_c

    def max_angle(self, c: Coefficients) -> float:
        alpha, beta = c
        limit = _limit(alpha)
        # z = -limit d: the angle behind the image plane
        beyond = np.arctan2(limit * np.sqrt(beta), np.sqrt(1 - limit * limit))
        return float(np.pi / 2 + beyond)

    def start(self, count: int) -> Coefficients:
        return (0.5, 1.0)

    def _distance(self, c: Coefficients, p: FloatArray) -> FloatArray:
        x = p[..., 0]
        y = p[..., 1]
        z = p[..., 2]
        return np.asarray(np.sqrt(c[1] * (x * x + y * y) + z * z))


LENS = EnhancedUnified()
