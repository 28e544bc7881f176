"""The pinhole: no distortion."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from vio.geometry.lenses.model import (
    BoolArray,
    Coefficients,
    FileNames,
    KalibrForm,
    Lens,
    ToolForm,
    plane_by_point,
)
from vio.geometry.lie import FloatArray
from vio.numerics.kinds import Capacity, Tolerance

_MIN_DEPTH: Tolerance[float] = 1e-9


def pinhole(p: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Tangents (..., 2) of points (..., 3), and a mask (...) of those before the camera."""
    valid = np.greater(p[..., 2], _MIN_DEPTH)
    depth = np.where(valid, p[..., 2], 1.0)
    tangents = np.empty((*p.shape[:-1], 2))
    np.divide(p[..., 0], depth, out=tangents[..., 0])
    np.divide(p[..., 1], depth, out=tangents[..., 1])
    return tangents, valid


def pinhole_by_point(p: FloatArray) -> FloatArray:
    """Derivative (..., 2, 3) of the tangents by points (..., 3)."""
    inverse = 1 / np.where(p[..., 2] > _MIN_DEPTH, p[..., 2], 1.0)
    by_p = np.zeros(p.shape)
    by_p[..., 2] = -inverse * inverse
    return plane_by_point(p, inverse, by_p)


class Pinhole(Lens):
    """No coefficients."""

    name = "pinhole"
    counts = (0,)
    files = FileNames(
        distortion=("none", ""),
        kalibr={0: KalibrForm("pinhole", "none", 0)},
        ros={0: "plumb_bob"},
        basalt="pinhole",
        tools=(ToolForm("orbslam", "rectified"),),
        sensor_yaml="radial-tangential",
        opencv=True,
        colmap={0: ("PINHOLE", 0)},
    )
    planar = True
    linear_tiles: ClassVar[Capacity[int]] = 4

    def project(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, BoolArray]:
        return pinhole(p)

    def unproject(self, c: Coefficients, xy: FloatArray) -> tuple[FloatArray, BoolArray]:
        valid: BoolArray = np.asarray(np.isfinite(xy).all(axis=-1))
        xy = np.where(valid[..., None], xy, 0.0)
        ray = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        return ray / np.linalg.norm(ray, axis=-1, keepdims=True), valid

    def derivatives(self, c: Coefficients, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        return pinhole_by_point(p), np.zeros((*p.shape[:-1], 2, 0))

    def max_angle(self, c: Coefficients) -> float:
        return float(np.pi / 2)

    def start(self, count: int) -> Coefficients:
        return ()

    def bent(
        self, c: Coefficients, radial: tuple[float, float], tangential: tuple[float, float]
    ) -> tuple[str, Coefficients]:
        return "radtan", (*radial, *tangential)


LENS = Pinhole()
