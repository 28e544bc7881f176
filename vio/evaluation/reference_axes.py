"""What makes orientations of a reference differ from an estimate whose positions agree: other
axes, another order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from vio.evaluation.errors_along_path import rotation_angle_deg
from vio.geometry.lie import (
    FloatArray,
    nearest_rotation,
    quat_xyzw_from_rotation,
    rotation_from_quat_xyzw,
    so3_log,
)
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import median

# median attitude error that no odometry has whose positions agree; other axes are 90 deg off or
# more
_LARGE_DEG = 20.0


@dataclass(frozen=True, slots=True)
class _AxisRules:
    """When another convention of axes explains the errors of attitude."""

    constant: float = 0.2  # of that error may vary where one rotation explains it
    # between what two causes leave: nothing tells which one it is
    alike_deg: Tolerance[float] = 1e-3
    sigmas: float = 5.0  # of the rotation about the path, where the positions leave it uncertain
    # a rotation so near one of the 24 that exchange axes is called by its whole degrees
    axes_deg: float = 5.0


_AXES = _AxisRules()
# by which another order of the numbers must explain it better than other axes of the body do
_BETTER = 3.0
_NO_MEASURE = ", so attitude, RPE and drift, which use them, say nothing of the error"
_ORDERS: dict[Literal["w last", "w first"], str] = {
    "w last": "quaternions with w first, read as if w came last",
    "w first": "quaternions with w last, read as if w came first",
}


def attitude_note(
    R_est: FloatArray,
    R_ref: FloatArray,
    sigma_rad: float,
    R_ref_est: FloatArray | None = None,
) -> str | None:
    """Return which convention explains a large attitude error; None: the error is small.

    Args:
        R_est: (M, 3, 3) world from body, by the estimate, in the reference's world by an alignment
            of positions.
        R_ref: (M, 3, 3) world from body, by the reference.
        sigma_rad: standard deviation of the alignment's rotation about the path.
        R_ref_est: (3, 3) that alignment's rotation; None: the identity.
    """
    R_align = np.eye(3) if R_ref_est is None else R_ref_est
    R_raw = R_align.T @ R_est
    off_deg = median(rotation_angle_deg(np.swapaxes(R_ref, 1, 2) @ R_est))
    if off_deg < max(_LARGE_DEG, _AXES.sigmas * float(np.degrees(sigma_rad))):
        return None
    head = f"the attitudes differ by {off_deg:.0f} deg (median)"
    if _varies_deg(R_ref) < 1.0 and _varies_deg(R_est) > _LARGE_DEG:
        return (
            f"{head}: the reference's never change; its orientations are placeholders{_NO_MEASURE}"
        )
    body = np.swapaxes(R_ref, 1, 2) @ R_est
    others = {
        ("reference", "in a world with other axes than its positions"): R_est
        @ np.swapaxes(R_ref, 1, 2),
        ("reference", "inverse (body from world)"): R_ref @ R_est,
        ("estimate", "inverse (body from world)"): (
            np.swapaxes(R_ref, 1, 2) @ R_align @ np.swapaxes(R_raw, 1, 2)
        ),
    }
    for order, words in _ORDERS.items():
        others["reference", words] = np.swapaxes(with_other_order(R_ref, order), 1, 2) @ R_est
        others["estimate", words] = (
            np.swapaxes(R_ref, 1, 2) @ R_align @ with_other_order(R_raw, order)
        )
    left = {key: _spread_deg(differences) for key, differences in others.items()}
    best = min(left.values())
    of_body = _spread_deg(body)
    if min(of_body, best) > _AXES.constant * off_deg:
        return f"{head}, and no exchange of axes explains it; check what the reference's orientations mean"
    if _BETTER * best < of_body:
        alike = [key for key in left if left[key] <= best + _AXES.alike_deg]
        causes = ", or ".join(f"the {whose}'s orientations are {words}" for whose, words in alike)
        return f"{head}: {causes}{_NO_MEASURE}; correct the file it was written from"
    return (
        f"{head}, always by the same rotation ({_name(_mean(body))}): the reference describes a "
        "body with other axes"
        f"{_NO_MEASURE}; compare positions, or turn the reference's poses by it"
    )


def with_other_order(R: FloatArray, read: Literal["w last", "w first"]) -> FloatArray:
    """Return rotations (M, 3, 3) whose quaternions were read with w last, or first, as if the other
    order were theirs.
    """
    shift = -1 if read == "w last" else 1
    return rotation_from_quat_xyzw(np.roll(quat_xyzw_from_rotation(R), shift, axis=1))


def _varies_deg(R: FloatArray) -> float:
    """Return the largest angle of rotations (M, 3, 3) from the first one."""
    return float(rotation_angle_deg(R[0].T @ R).max())


def _mean(R: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) nearest to rotations (M, 3, 3)."""
    return nearest_rotation(R.sum(axis=0))


def _spread_deg(R: FloatArray) -> float:
    """Return the median angle of rotations (M, 3, 3) from their mean."""
    return median(rotation_angle_deg(_mean(R).T @ R))


def _name(R: FloatArray) -> str:
    """Return a rotation in words: whole axes where it exchanges them, else its angle and axis."""
    axes = np.rint(R)
    if (
        np.array_equal(np.abs(axes).sum(axis=0), np.ones(3))
        and float(rotation_angle_deg(axes.T @ R)) < _AXES.axes_deg
    ):
        signed = (
            ("-" if row.sum() < 0 else "+") + "xyz"[int(np.argmax(np.abs(row)))] for row in axes
        )
        return f"its x, y, z are the estimate's {' '.join(signed)}"
    phi = np.degrees(so3_log(R))
    return f"{phi[0]:+.0f} {phi[1]:+.0f} {phi[2]:+.0f} deg about x y z"
