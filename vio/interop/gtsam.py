"""GTSAM: `Pose3` and its covariance.

A `Pose3` of a body is `T_world_body`. Its tangent is on the body's side as ours, rotation first.
"""

from __future__ import annotations

from typing import Any

from vio.geometry.lie import FloatArray, checked_transform
from vio.interop.loading import exchanged_blocks, package

_INSTALL = "gtsam>=4.3,<5"


def to_pose3(T: FloatArray) -> Any:
    """Return a transform (4, 4) as `gtsam.Pose3`."""
    return package("gtsam", _INSTALL).Pose3(checked_transform(T, "pose"))


def from_pose3(pose: Any) -> FloatArray:
    """Return a `gtsam.Pose3` as a transform (4, 4)."""
    return checked_transform(pose.matrix(), "gtsam.Pose3")


def to_pose3_covariance(covariance: FloatArray) -> FloatArray:
    """Return a pose's covariance (6, 6) of [rho; phi] in the order of `Pose3`, rotation first."""
    return exchanged_blocks(covariance)


def from_pose3_covariance(covariance: FloatArray) -> FloatArray:
    """Return a covariance (6, 6) of `Pose3`, as `Marginals` gives it, in our order."""
    return exchanged_blocks(covariance)


def to_noise_model(covariance: FloatArray) -> Any:
    """Return a pose's covariance (6, 6) as the noise model of a `PriorFactorPose3` or of the
    measured pose of a `BetweenFactorPose3`.
    """
    models = package("gtsam", _INSTALL).noiseModel
    return models.Gaussian.Covariance(to_pose3_covariance(covariance))
