"""SciPy: `Rotation` and `RigidTransform`.

Quaternions of `Rotation` are x y z w; exponential coordinates of `RigidTransform` have the rotation
first. `RigidTransform` is in SciPy 1.16 and later.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vio.errors import MissingDependencyError
from vio.geometry.lie import FloatArray, checked_transform
from vio.interop.loading import exchanged_blocks, package

_INSTALL = "scipy>=1.16,<2"
_TRANSFORM = "scipy.spatial.transform"


def to_rotation(T: FloatArray) -> Any:
    """Return the rotation of a transform (4, 4), or rotations of transforms (N, 4, 4)."""
    return package(_TRANSFORM, _INSTALL).Rotation.from_matrix(np.asarray(T)[..., :3, :3])


def from_rotation(rotation: Any) -> FloatArray:
    """Return matrices (3, 3), or (N, 3, 3), of a `Rotation`."""
    return np.asarray(rotation.as_matrix(), dtype=np.float64)


def to_rigid_transform(T: FloatArray) -> Any:
    """Return a transform (4, 4) as `RigidTransform`.

    Raises:
        MissingDependencyError: SciPy is older than 1.16.
    """
    module = package(_TRANSFORM, _INSTALL)
    if not hasattr(module, "RigidTransform"):
        raise MissingDependencyError(
            f"scipy has no RigidTransform before 1.16; install it with: pip install '{_INSTALL}'"
        )
    return module.RigidTransform.from_matrix(checked_transform(T, "pose"))


def from_rigid_transform(transform: Any) -> FloatArray:
    """Return a single `RigidTransform` as a transform (4, 4)."""
    return checked_transform(transform.as_matrix(), "RigidTransform")


def to_exp_coords_covariance(covariance: FloatArray) -> FloatArray:
    """Return a pose's covariance (6, 6) as that of exponential coordinates d, [rotation;
    translation], with `pose * RigidTransform.from_exp_coords(d)`.
    """
    return exchanged_blocks(covariance)


def from_exp_coords_covariance(covariance: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of such exponential coordinates in our order."""
    return exchanged_blocks(covariance)
