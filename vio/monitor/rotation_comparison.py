"""The camera's rotation about the axes of its image against the gyro's: they differ where the
focal length is off.
"""

from __future__ import annotations

import numpy as np

from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.imu.findings import InertialFinding
from vio.monitor.gyro_fit import AGREES, GyroFit
from vio.monitor.motion import Record
from vio.numerics.kinds import Tolerance
from vio.records import ROTATION_NOT_COMPARABLE, RotationComparison

_BLOCKS: Tolerance[int] = 10  # of the record, for the jackknife
_IMAGE = [0, 1]  # the camera's axes
_OPTICAL = [2]


def compare_rotations(record: Record, fit: GyroFit, R_cam0_imu: FloatArray) -> RotationComparison:
    """Compare the rates of camera and gyro about the axes of the image, and about the optical axis;
    equation (I5).

    The gyro's rates are those at the best clock offset, and `R_cam0_imu` (3, 3) is as given.
    """
    used = fit.covered
    if fit.unexplained > AGREES or not fit.fits(R_cam0_imu) or not used.any():
        return ROTATION_NOT_COMPARABLE
    camera = record.twists[used, 3:]
    gyro = fit.gyro[used] @ R_cam0_imu.T
    (image, sigma), (optical, optical_sigma) = (
        _factor(camera[:, axes], gyro[:, axes], fit.weight[used]) for axes in (_IMAGE, _OPTICAL)
    )
    excess = image - 1
    agrees = abs(optical - 1) < abs(excess) / 2 and optical_sigma < abs(excess) / 4
    return RotationComparison(excess, sigma, agrees)


def _factor(camera: FloatArray, gyro: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Return the factor from the gyro's rates (K, n) to the camera's, and its standard deviation
    by a jackknife.
    """
    blocks = np.arange(len(weight)) * _BLOCKS // len(weight)
    # all, and all but one
    weights = np.concatenate([weight[None], weight * (blocks != np.arange(_BLOCKS)[:, None])])
    total = np.maximum(weights.sum(axis=1), 1e-12)
    mean_c, mean_g = (weights @ x / total[:, None] for x in (camera, gyro))
    products = weights @ np.sum(camera * gyro, axis=1) - total * np.sum(mean_c * mean_g, axis=1)
    squares = weights @ np.sum(gyro**2, axis=1) - total * np.sum(mean_g**2, axis=1)
    if squares.min() <= 0:
        return 1.0, np.inf
    factors = products / squares
    spread = float(np.sum((factors[1:] - factors[1:].mean()) ** 2))
    return float(factors[0]), float(np.sqrt((_BLOCKS - 1) / _BLOCKS * spread))


def judge_rotations(compared: RotationComparison, camera: StereoCamera) -> list[InertialFinding]:
    """Report rotations that differ by the gyro's scale or by the focal length."""
    if not compared.differ:
        return []
    cause = "the focal length or the lens is not as calibrated"
    if not compared.gyro_agrees:
        cause += ", or the gyro's scale is off"
    estimate = (
        ""
        if camera.is_cylinder
        else ", or have the focal length estimated (msckf.calibrate_scale: on, "
        "msckf.stereo_focal_sigma: 0.05)"
    )
    return [
        InertialFinding(
            "camera turns",
            f"about the axes of the image the camera turns {100 * abs(compared.excess):.1f} ± "
            f"{100 * compared.sigma:.1f} % {'more' if compared.excess > 0 else 'less'} than the "
            "gyro says",
            f"{cause}; calibrate the cameras anew{estimate}",
            certain=False,
        )
    ]
