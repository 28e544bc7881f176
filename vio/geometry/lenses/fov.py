"""The field-of-view model (FOV, ATAN): the radius is an arc tangent of the pinhole's, of one
parameter `w`, the lens's field of view if it is an ideal one.

`r' = atan2(2 tan(w / 2) r, z) / w`. The authors define it before the camera (z > 0); the arc tangent
of two arguments continues it without a fold to points behind, as Basalt does.
Reference: Devernay & Faugeras, Straight lines have to be straight (2001), equations 13 and 14.
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
    near_axis,
    plane_by_point,
)
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Tolerance

_STRAIGHT: Tolerance[float] = 1e-6  # radians: below, the lens is a pinhole to 1e-13 of the radius
_MARGIN: Tolerance[float] = (
    1e-6  # radians about the backward axis, all of which would be one circle of pixels
)


def _slopes(w: float) -> tuple[float, float]:
    """Return `2 tan(w / 2)` and its derivative by w."""
    t = 2 * float(np.tan(0.5 * w))
    return t, 1 + 0.25 * t * t


class FieldOfView(Lens):
    """w, radians; 0 <= w < pi. Zero is a pinhole."""

    name = "fov"
    parameters = ("w",)
    counts = (1,)
    files = FileNames(
        distortion=("fov", "atan"),
        kalibr={1: KalibrForm("pinhole", "fov", 0)},
        basalt="fov",
        colmap={1: ("FOV", 1)},
    )
    choices = (Choice("fov", 1, 5),)
    zero_is_pinhole = True

    def fault(self, c: Coefficients) -> str | None:
        if 0 <= c[0] < np.pi:
            return None
        return f"the fov model's w is an angle in radians, 0 <= w < pi, got {c[0]:g}"

    def project(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, BoolArray]:
        w = max(c[0], _STRAIGHT)
        t, _ = _slopes(w)
        radius, on_axis = near_axis(p)
        z = p[..., 2]
        angle = np.arctan2(t * radius, z)
        valid = (angle < np.pi - _MARGIN) & (np.linalg.norm(p, axis=-1) > TINY)
        scale = np.where(on_axis, 0.0, angle / (w * radius))
        return p[..., :2] * scale[..., None], valid

    def unproject(self, c: Coefficients, xy: FloatArray) -> tuple[FloatArray, BoolArray]:
        w = max(c[0], _STRAIGHT)
        t, _ = _slopes(w)
        finite: BoolArray = np.asarray(np.isfinite(xy).all(axis=-1))
        xy = np.where(finite[..., None], xy, 0.0)
        radius = np.maximum(np.linalg.norm(xy, axis=-1), TINY)
        angle = w * radius
        valid = finite & (angle < np.pi - _MARGIN)
        angle = np.where(valid, angle, 0.0)
        scale = np.where(valid, np.sin(angle) / (t * radius), 0.0)
        ray = np.concatenate([scale[..., None] * xy, np.cos(angle)[..., None]], axis=-1)
        return ray / np.linalg.norm(ray, axis=-1, keepdims=True), valid

    def derivatives(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        w = max(c[0], _STRAIGHT)
        t, t_by_w = _slopes(w)
        radius, on_axis = near_axis(p)
        z = p[..., 2]
        angle = np.arctan2(t * radius, z)
        scale = angle / (w * radius)
        turn = t / (w * radius * ((t * radius) ** 2 + z * z))  # of scale, by the pinhole's radius
        along = p[..., :2] / radius[..., None]
        by_p = np.empty(p.shape)
        by_p[..., :2] = (turn * z - scale / radius)[..., None] * along
        by_p[..., 2] = -turn * radius
        by_p = np.where(on_axis[..., None], 0.0, by_p)
        scale_by_w = turn * radius * z * t_by_w / t - scale / w
        return plane_by_point(p, scale, by_p), (p[..., :2] * scale_by_w[..., None])[..., None]

    def max_angle(self, c: Coefficients) -> float:
        t, _ = _slopes(max(c[0], _STRAIGHT))
        return float(np.pi - np.arctan2(np.sin(_MARGIN), t * np.cos(_MARGIN)))

    def start(self, count: int) -> Coefficients:
        return (0.9,)

    def focal_factor(self, c: Coefficients) -> float:
        w = max(c[0], _STRAIGHT)
        return w / _slopes(w)[0]


LENS = FieldOfView()
