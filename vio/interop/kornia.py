"""kornia: `PinholeCamera` and `Se3`.

The extrinsics of a `PinholeCamera` are `T_cam_world`; it applies its matrix as it is given, so that
pixels are ours (the centre of the top-left pixel at (0, 0)). An `Se3` has its quaternion w x y z
and its tangent translation first, as ours.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vio.errors import CalibrationError
from vio.geometry.lie import FloatArray, checked_transform, se3_from_parts
from vio.geometry.stereo import StereoCamera
from vio.interop.loading import package

_INSTALL = ".[learned]"


def to_pinhole_cameras(camera: StereoCamera, T_cam0_world: FloatArray) -> Any:
    """Return both cameras of a rectified pair as a `PinholeCamera` of batch 2, left and right.

    Args:
        camera: a pair that is rectified to pinholes, with its image size.
        T_cam0_world: (4, 4).

    Raises:
        CalibrationError: the images are cylinders, or their size is not known.
    """
    if camera.projection != "pinhole" or camera.width is None or camera.height is None:
        raise CalibrationError(
            "a PinholeCamera of kornia needs a pinhole's image of known size; set "
            "dataset.projection to pinhole and run on images"
        )
    torch = package("torch", _INSTALL)
    kind = package("kornia.geometry.camera", _INSTALL).PinholeCamera
    K = np.eye(4)
    K[:3, :3] = camera.K
    T_cam1_cam0 = se3_from_parts(np.eye(3), [-camera.baseline_m, 0.0, 0.0])
    T = checked_transform(T_cam0_world, "pose")
    size = [torch.full((2,), float(side)) for side in (camera.height, camera.width)]
    both = torch.tensor(np.array([T, T_cam1_cam0 @ T]))
    return kind(torch.tensor(np.array([K, K])), both, *size)


def from_pinhole_cameras(cameras: Any) -> tuple[StereoCamera, FloatArray]:
    """Return a `PinholeCamera` of batch 2, left and right, as a rectified pair and its pose
    `T_cam0_world` (4, 4).

    Raises:
        CalibrationError: the two are no rectified pair.
    """
    K, other = cameras.intrinsics.detach().cpu().double().numpy()
    T_cam0_world, T_cam1_world = cameras.extrinsics.detach().cpu().double().numpy()
    T_cam1_cam0 = T_cam1_world @ np.linalg.inv(T_cam0_world)
    expected = se3_from_parts(np.eye(3), [T_cam1_cam0[0, 3], 0.0, 0.0])
    if not (np.allclose(K, other) and np.allclose(T_cam1_cam0, expected, atol=1e-6)):
        raise CalibrationError(
            "the cameras are no rectified pair: their matrices differ, or the right one is not on "
            "the left one's x axis; rectify them first"
        )
    size = (int(cameras.width[0]), int(cameras.height[0]))
    baseline_m = -float(T_cam1_cam0[0, 3])
    pair = StereoCamera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], baseline_m, *size)
    return pair, checked_transform(T_cam0_world, "PinholeCamera")


def to_se3(T: FloatArray) -> Any:
    """Return a transform (4, 4) as `kornia.geometry.liegroup.Se3`, batch 1."""
    torch = package("torch", _INSTALL)
    kind = package("kornia.geometry.liegroup", _INSTALL).Se3
    return kind.from_matrix(torch.tensor(checked_transform(T, "pose")[None]))


def from_se3(transform: Any) -> FloatArray:
    """Return an `Se3` of batch 1 as a transform (4, 4)."""
    return checked_transform(transform.matrix().detach().cpu().double().numpy()[0], "Se3")
