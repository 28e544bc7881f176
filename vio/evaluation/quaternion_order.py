"""The order of a quaternion's numbers where a file does not state it: w first or last, whichever
the other trajectory bears out.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vio.errors import EvaluationError
from vio.evaluation.alignment import align_poses
from vio.evaluation.association import associate
from vio.evaluation.errors_along_path import rotation_angle_deg
from vio.evaluation.reference_axes import with_other_order
from vio.geometry.lie import FloatArray, nearest_rotation
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import median
from vio.records import Trajectory


class _OrderRules(NamedTuple):
    """When the order of quaternions is doubted."""

    large_deg: float = 5.0  # of a spread, below which no order is doubted
    better_ratio: float = 5.0  # by which the right order must explain the attitudes better
    rounding_deg: Tolerance[float] = 1e-3  # of spreads that are one


_ORDER = _OrderRules()


def settled_orders(
    estimate: Trajectory, reference: Trajectory, max_time_difference_s: float
) -> tuple[Trajectory, Trajectory, tuple[str, ...]]:
    """Return both trajectories, one of them in the other order where that order was assumed and the
    other trajectory contradicts it, and a note that names both readings.

    The positions must determine how the worlds are turned to each other: then the attitudes differ
    by one rotation of the body in the right order, and by any in the wrong one.

    Args:
        estimate: as it was read, in the body that its file describes.
        reference: likewise.
        max_time_difference_s: poses further apart in time are not compared.
    """
    given = {"estimate": estimate, "reference": reference}
    assumed = {
        name: _exchanged(trajectory)
        for name, trajectory in given.items()
        if trajectory.orientations.endswith("assumed")
    }
    if not assumed or "none" in (estimate.orientations, reference.orientations):
        return estimate, reference, ()
    as_read = _spread_deg(estimate, reference, max_time_difference_s)
    if as_read == math.inf or as_read < _ORDER.large_deg:
        return estimate, reference, ()
    left = {
        name: _spread_deg(**(given | {name: exchanged}), limit_s=max_time_difference_s)
        for name, exchanged in assumed.items()
    }
    spread = min(left.values())
    if _ORDER.better_ratio * spread >= as_read:
        return estimate, reference, ()
    # Where neither file states its order, the better explanation counts. Both read wrong agree as
    # both read right do, in one world: TUM's form has w last, lines with commas have either.
    alike = [name for name in left if left[name] <= max(spread, _ORDER.rounding_deg)]
    name = min(alike, key=lambda name: given[name].orientations != "w first, assumed")
    pair = given | {name: assumed[name]}
    note = _exchange_note(name, assumed[name], left[name], as_read)
    return pair["estimate"], pair["reference"], (note,)


def _exchange_note(name: str, exchanged: Trajectory, spread: float, as_read: float) -> str:
    """Return what is said of a trajectory read in the other order, with both spreads in deg."""
    read = "first" if exchanged.orientations == "w first, assumed" else "last"
    other = "last" if read == "first" else "first"
    return (
        f"the {name} does not state the order of its quaternions: they are read with w "
        f"{read}, which leaves {spread:.2g} deg between the attitudes, and w {other} would "
        f"leave {as_read:.0f} deg; name the columns in its header (qx,qy,qz,qw)"
    )


def _exchanged(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory in the order that was not assumed."""
    first = trajectory.orientations == "w first, assumed"
    poses = trajectory.T_world_body.copy()
    poses[:, :3, :3] = with_other_order(poses[:, :3, :3], "w first" if first else "w last")
    other = "w last, assumed" if first else "w first, assumed"
    return replace(trajectory, T_world_body=poses, orientations=other)  # type: ignore[arg-type]


def _spread_deg(estimate: Trajectory, reference: Trajectory, limit_s: float) -> float:
    """Return by how much the attitudes differ (median) beside a constant rotation of the body.

    Infinite where the positions do not determine the rotation between the worlds, or no poses
    match.
    """
    try:
        _, rows, reference_rows = associate(estimate, reference, max_time_difference_s=limit_s)
        T_est = estimate.T_world_body[rows]
        T_ref = reference.T_world_body[reference_rows]
        alignment = align_poses(T_est, T_ref, "se3")
    except EvaluationError:
        return math.inf
    if alignment.rotation_from != "positions":
        return math.inf
    R_ref_world = np.swapaxes(T_ref[:, :3, :3], 1, 2)
    R = R_ref_world @ alignment.R @ T_est[:, :3, :3]
    mean: FloatArray = nearest_rotation(R.sum(axis=0))
    return median(rotation_angle_deg(mean.T @ R))
