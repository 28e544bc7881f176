"""The unified and the double sphere camera model on the normalised image plane: lenses up to and
beyond 180 degrees.

A point is projected to one unit sphere (unified: at distance `xi` from the projection centre) or to
two (double sphere: `xi` apart, `alpha` between the second and the image plane). Both inverses are
closed.
References: Mei & Rives, Single view point omnidirectional camera calibration from planar grids
(2007); Usenko, Demmel & Cremers, The double sphere camera model (2018).
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray

BoolArray: TypeAlias = npt.NDArray[np.bool_]
_TINY = 1e-12


def unified(xi: float, p: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Normalised plane (..., 2) of points (..., 3), and a mask (...) of those that the model can
    project.
    """
    distance = np.linalg.norm(p, axis=-1)
    # Beyond the cone where the image of the sphere folds back, two points would share a pixel.
    limit = xi if xi <= 1 else 1 / xi
    valid = (p[..., 2] > -limit * distance) & (distance > _TINY)
    depth = np.where(valid, p[..., 2] + xi * distance, 1.0)
    return p[..., :2] / depth[..., None], valid


def unproject_unified(xi: float, xy: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Unit rays (..., 3) of points (..., 2) of the normalised plane, and a mask (...) of those
    inside the model.
    """
    r2 = np.einsum("...i,...i->...", xy, xy)
    root = 1 + (1 - xi * xi) * r2
    valid: BoolArray = np.isfinite(r2) & (root >= 0)
    scale = (xi + np.sqrt(np.where(valid, root, 0.0))) / (1 + np.where(valid, r2, 0.0))
    return _ray(np.where(valid[..., None], xy, 0.0), scale, scale - xi), valid


def double_sphere(xi_alpha: tuple[float, ...], p: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Normalised plane (..., 2) of points (..., 3), and a mask (...) of those that the model can
    project.
    """
    xi, alpha = xi_alpha
    d1 = np.linalg.norm(p, axis=-1)
    limit = alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
    limit = (limit + xi) / np.sqrt(2 * limit * xi + xi * xi + 1)
    valid = (p[..., 2] > -limit * d1) & (d1 > _TINY)
    shifted = xi * d1 + p[..., 2]
    d2 = np.sqrt(p[..., 0] ** 2 + p[..., 1] ** 2 + shifted**2)
    depth = np.where(valid, alpha * d2 + (1 - alpha) * shifted, 1.0)
    return p[..., :2] / depth[..., None], valid


def unproject_double_sphere(
    xi_alpha: tuple[float, ...], xy: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Unit rays (..., 3) of points (..., 2) of the normalised plane, and a mask (...) of those
    inside the model.
    """
    xi, alpha = xi_alpha
    r2 = np.einsum("...i,...i->...", xy, xy)
    root = 1 - (2 * alpha - 1) * r2
    valid: BoolArray = np.isfinite(r2) & (root >= 0)
    r2 = np.where(valid, r2, 0.0)
    mz = (1 - alpha * alpha * r2) / (alpha * np.sqrt(np.where(valid, root, 0.0)) + 1 - alpha)
    second = mz * mz + (1 - xi * xi) * r2
    valid = valid & (second >= 0)
    scale = (mz * xi + np.sqrt(np.where(valid, second, 0.0))) / (mz * mz + r2)
    return _ray(np.where(valid[..., None], xy, 0.0), scale, scale * mz - xi), valid


def _ray(xy: FloatArray, scale: FloatArray, z: FloatArray) -> FloatArray:
    ray = np.concatenate([scale[..., None] * xy, z[..., None]], axis=-1)
    # Unit length but for rounding; a pixel outside the model gets the optical axis.
    length = np.linalg.norm(ray, axis=-1, keepdims=True)
    return np.where(length > _TINY, ray / np.where(length > _TINY, length, 1.0), [0.0, 0.0, 1.0])
