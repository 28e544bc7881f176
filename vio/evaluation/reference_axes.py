"""What makes orientations of a reference differ from an estimate whose positions agree: other
axes, another order.
"""

from __future__ import annotations

import numpy as np

from vio.evaluation.errors_along_path import rotation_angle_deg
from vio.geometry.lie import (
    FloatArray,
    nearest_rotation,
    quat_xyzw_from_rotation,
    rotation_from_quat_xyzw,
    so3_log,
)

# median attitude error that no odometry has whose positions agree; other axes are 90 deg off or
# more
_LARGE_DEG = 20.0
_CONSTANT = 0.2  # of that error may vary where one rotation explains it
# by which another order of the numbers must explain it better than other axes of the body do
_BETTER = 3.0
_SIGMAS = 5.0  # of the rotation about the path, where the positions leave it uncertain
_NO_MEASURE = ", so attitude, RPE and drift, which use them, say nothing of the error"
# a rotation so near one of the 24 that exchange axes is called by its whole degrees
_AXES_DEG = 5.0


def attitude_note(R_est: FloatArray, R_ref: FloatArray, sigma_rad: float) -> str | None:
    """Return which convention explains a large attitude error; None: the error is small.

    Args:
        R_est: (M, 3, 3) world from body, by the estimate, in the reference's world by an alignment
            of positions.
        R_ref: (M, 3, 3) world from body, by the reference.
        sigma_rad: standard deviation of the alignment's rotation about the path.
    """
    off_deg = float(np.median(rotation_angle_deg(np.swapaxes(R_ref, 1, 2) @ R_est)))
    if off_deg < max(_LARGE_DEG, _SIGMAS * float(np.degrees(sigma_rad))):
        return None
    head = f"the attitudes differ by {off_deg:.0f} deg (median)"
    if _varies_deg(R_ref) < 1.0 and _varies_deg(R_est) > _LARGE_DEG:
        return (
            f"{head}: the reference's never change; its orientations are placeholders{_NO_MEASURE}"
        )
    x, y, z, w = quat_xyzw_from_rotation(R_ref).T
    w_last = rotation_from_quat_xyzw(np.stack([y, z, w, x], axis=1))
    body = np.swapaxes(R_ref, 1, 2) @ R_est
    others = {
        "in a world with other axes than its positions": R_est @ np.swapaxes(R_ref, 1, 2),
        "inverse (body from world)": R_ref @ R_est,
        "quaternions with w first, read as if w came last": np.swapaxes(w_last, 1, 2) @ R_est,
    }
    left = {words: _spread_deg(differences) for words, differences in others.items()}
    words = min(left, key=lambda name: left[name])
    of_body = _spread_deg(body)
    if min(of_body, left[words]) > _CONSTANT * off_deg:
        return f"{head}, and no exchange of axes explains it; check what the reference's orientations mean"
    if _BETTER * left[words] < of_body:
        return f"{head}: the reference's orientations are {words}{_NO_MEASURE}; correct the file it was written from"
    return (
        f"{head}, always by the same rotation ({_name(_mean(body))}): the reference describes a "
        "body with other axes"
        f"{_NO_MEASURE}; compare positions, or turn the reference's poses by it"
    )


def _varies_deg(R: FloatArray) -> float:
    """Return the largest angle of rotations (M, 3, 3) from the first one."""
    return float(rotation_angle_deg(R[0].T @ R).max())


def _mean(R: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) nearest to rotations (M, 3, 3)."""
    return nearest_rotation(R.sum(axis=0))


def _spread_deg(R: FloatArray) -> float:
    """Return the median angle of rotations (M, 3, 3) from their mean."""
    return float(np.median(rotation_angle_deg(_mean(R).T @ R)))


def _name(R: FloatArray) -> str:
    """Return a rotation in words: whole axes where it exchanges them, else its angle and axis."""
    axes = np.rint(R)
    if (
        np.array_equal(np.abs(axes).sum(axis=0), np.ones(3))
        and float(rotation_angle_deg(axes.T @ R)) < _AXES_DEG
    ):
        signed = (
            ("-" if row.sum() < 0 else "+") + "xyz"[int(np.argmax(np.abs(row)))] for row in axes
        )
        return f"its x, y, z are the estimate's {' '.join(signed)}"
    phi = np.degrees(so3_log(R))
    return f"{phi[0]:+.0f} {phi[1]:+.0f} {phi[2]:+.0f} deg about x y z"
