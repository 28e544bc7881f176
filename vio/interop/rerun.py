"""rerun: `Transform3D`, `Pinhole`, `Points3D` and `Ellipsoids3D`.

A `Transform3D` logged below its parent maps the child's coordinates to the parent's. Pixels of a
`Pinhole` count from the corner of the top-left pixel, ours from its centre.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vio.errors import CalibrationError
from vio.geometry.lie import FloatArray, quat_xyzw_from_rotation
from vio.geometry.stereo import HALF_PX, StereoCamera
from vio.interop.loading import checked_covariance, package
from vio.records import Landmarks

_INSTALL = ".[view]"


def to_transform3d(T_parent_child: FloatArray) -> Any:
    """Return a transform (4, 4) as `Transform3D`."""
    rr = package("rerun", _INSTALL)
    return rr.Transform3D(translation=T_parent_child[:3, 3], mat3x3=T_parent_child[:3, :3])


def to_pinhole(camera: StereoCamera) -> Any:
    """Return the left camera of a rectified pair; x right, y down, z forward.

    Raises:
        CalibrationError: the images are cylinders, or their size is not known.
    """
    if camera.projection != "pinhole" or camera.width is None or camera.height is None:
        raise CalibrationError(
            "a Pinhole of rerun needs a pinhole's image of known size; set dataset.projection to "
            "pinhole and run on images"
        )
    rr = package("rerun", _INSTALL)
    return rr.Pinhole(
        focal_length=[camera.fu, camera.fv],
        principal_point=[camera.cu + HALF_PX, camera.cv + HALF_PX],
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
    )


def to_points3d(landmarks: Landmarks) -> Any:
    """Return landmarks as points."""
    return package("rerun", _INSTALL).Points3D(landmarks.p_world)


def to_ellipsoid(T_world_body: FloatArray, covariance: FloatArray, sigmas: float) -> Any:
    """Return the ellipsoid of the position of a pose (4, 4), in the world, at some standard
    deviations.

    Args:
        T_world_body: the pose.
        covariance: (6, 6) of xi on the body's side.
        sigmas: half axes over standard deviations.
    """
    rr = package("rerun", _INSTALL)
    R = T_world_body[:3, :3]
    values, axes = np.linalg.eigh(R @ checked_covariance(covariance)[:3, :3] @ R.T)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return rr.Ellipsoids3D(
        centers=[T_world_body[:3, 3]],
        half_sizes=[sigmas * np.sqrt(np.maximum(values, 0.0))],
        quaternions=[quat_xyzw_from_rotation(axes)],
    )
