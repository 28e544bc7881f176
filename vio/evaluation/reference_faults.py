"""What makes the positions of a reference differ from an estimate of the same motion: a clock that
is apart, axes that are left-handed, inverse poses, poses that are placeholders or held, another
point of the body.
"""

from __future__ import annotations

import math
from collections.abc import Sized
from typing import NamedTuple

import numpy as np

from vio.evaluation.alignment import Alignment, align_poses
from vio.evaluation.errors_along_path import path_length_m
from vio.geometry.lie import FloatArray, se3_inverse, so3_exp, so3_hat
from vio.numerics.kinds import Tolerance
from vio.records import NS_PER_S, BoolArray, IntArray, Trajectory


class _FaultRules(NamedTuple):
    """When another clock, or another hand, explains the distances of positions."""

    min_share: float = 0.005  # of the path, that an error must be for other faults than a clock
    min_poses: int = 20
    max_poses: int = 500  # of a long record, evenly chosen
    explained: float = 0.33  # of the error, that may be left by what explains it
    max_shift_s: float = 40.0  # the 37 s between TAI and UTC, and the 18 s of GPS
    clearly: float = 0.1  # likewise, of an error below min_share, by another clock
    overlap: float = 0.5  # share of the poses that must have a reference at a shift
    steps: int = 200  # of the first search, on either side
    finer: int = 10  # steps on either side of the best one, twice
    min_jump_m: float = 0.01  # to the identity: below, a body may stand at its start
    begun: float = 5.0  # of the largest further step, that a body does not jump by at its start
    smooth: float = 0.9  # quantile of the steps' differences: jumps are fewer than the rest
    sudden: float = 0.5  # share of a jump by which the reference's own speed must change
    max_arm_m: float = 5.0  # of a reference's point from the body that is estimated
    fits: Tolerance[int] = 10  # of a lever arm beside an alignment


_FAULT = _FaultRules()
_ROUNDING: Tolerance[float] = 1e-9  # of a reference's extent: errors below it are none


def position_fault(
    estimate: Trajectory,
    reference: Trajectory,
    T_est: FloatArray,
    T_ref: FloatArray,
    clock: IntArray,
) -> str | None:
    """Return what explains the distances between positions after an alignment with scale; None:
    nothing does, or they are small.

    A scale is part of every alignment here, as one that is off passes for a shift where a body
    speeds up. A clock is looked for however small the distances are: those of a shift grow with the
    speed, not with the path. Where they are small, it is not named if another point of the body
    explains them as well, as on a car's front.

    Args:
        estimate: the whole trajectory.
        reference: likewise.
        T_est: (M, 4, 4) poses that were paired.
        T_ref: (M, 4, 4) the poses of the reference.
        clock: (M,) times or numbers of these pairs, increasing.
    """
    lost = _placeholders(estimate, "estimate") or _placeholders(reference, "reference")
    if lost is not None:
        return lost
    x = T_est[:, :3, 3]
    y = T_ref[:, :3, 3]
    if len(x) < _FAULT.min_poses:
        return None
    path_m = path_length_m(y)
    error_m = float(_errors(x, y)[0])
    if not error_m > _FAULT.min_share * path_m:
        shifted = _clock_fault(estimate, reference, _FAULT.clearly)
        return shifted if shifted is None or _explaining_arm(T_est, T_ref) is None else None
    mirrored_m = float(_errors(x, y * [-1.0, 1.0, 1.0])[0])
    if mirrored_m < _FAULT.explained * error_m:
        return (
            "the positions agree where one axis of the reference is mirrored (ATE after Sim(3) "
            f"{mirrored_m:.3g} m, {error_m:.3g} m without): its axes are left-handed, as those of some "
            "simulators; change the sign of one of them"
        )
    if "none" not in (estimate.orientations, reference.orientations):
        inverted = {
            "estimate": float(_errors(se3_inverse(T_est)[:, :3, 3], y)[0]),
            "reference": float(_errors(x, se3_inverse(T_ref)[:, :3, 3])[0]),
        }
        fits = [name for name, left_m in inverted.items() if left_m < _FAULT.explained * error_m]
        if fits:
            which = f"the {fits[0]}" if len(fits) == 1 else "one of the two"
            return (
                f"the positions agree where the poses of {which} are inverted (ATE after Sim(3) "
                f"{min(inverted.values()):.3g} m, {error_m:.3g} m without): one file has the world in "
                "the body, as some programs write, and the other the body in the world; invert its "
                "poses"
            )
    return (
        _held_fault(x, y, error_m)
        or _jump_fault(x, y, clock, error_m)
        or _clock_fault(estimate, reference, _FAULT.explained)
    )


def _held_fault(x: FloatArray, y: FloatArray, error_m: float) -> str | None:
    """Return the note on positions y (M, 3) of a reference that repeat the one before to the bit;
    None: there are none, or they explain nothing of the error.

    A body at rest repeats them as well, and then they agree.
    """
    held = np.concatenate([[False], (y[1:] == y[:-1]).all(axis=1)])
    if not held.any() or len(y) - held.sum() < _FAULT.min_poses:
        return None
    left_m = float(_errors(x, y[None], ~held[None])[0])
    if not left_m < _FAULT.explained * error_m:
        return None
    return (
        f"{held.sum()} positions of the reference repeat the one before to the bit while the estimate "
        f"moves (ATE after Sim(3) {left_m:.3g} m without them, {error_m:.3g} m with): it holds its last "
        "pose where it lost the body; remove these rows"
    )


def _jump_fault(x: FloatArray, y: FloatArray, clock: IntArray, error_m: float) -> str | None:
    """Return the note on single steps of a reference that the estimate does not make, as where a
    receiver or a camera system takes another solution; None: there are none, or they explain
    nothing of the error.

    A step that the reference's own speed explains is none: there the estimate lost the body.

    Args:
        x: (M, 3) positions of the estimate.
        y: (M, 3) of the reference.
        clock: (M,) their times or numbers, increasing.
        error_m: between them, after a similarity.
    """
    own = np.diff(x, axis=0)
    other = np.diff(y, axis=0)
    own_m = np.linalg.norm(own, axis=1)
    other_m = np.linalg.norm(other, axis=1)
    moving = own_m >= own_m.mean()  # others may be noise of a body at rest
    scale = float(np.median(other_m[moving]) / max(np.median(own_m[moving]), _ROUNDING))
    further_m = other_m - scale * own_m
    sudden_m = _sudden_m(other, np.diff(clock))
    jumps = (
        (further_m > _least_jump_m(further_m))
        & (sudden_m > _least_jump_m(sudden_m))
        & (sudden_m > _FAULT.sudden * further_m)
    )
    if not jumps.any():
        return None
    U, _, Vt = np.linalg.svd(other[~jumps].T @ own[~jumps])
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    other[jumps] = scale * own[jumps] @ R.T
    left_m = float(_errors(x, np.concatenate([y[:1], y[0] + np.cumsum(other, axis=0)]))[0])
    if not left_m < _FAULT.explained * error_m:
        return None
    first = int(np.flatnonzero(jumps)[0]) + 2
    count = int(jumps.sum())
    return (
        f"the reference jumps {count} time{'s' * (count > 1)} by up to "
        f"{further_m[jumps].max():.3g} m, first at pose {first} of {len(y)} that were compared, where the "
        f"estimate does not (ATE after Sim(3) {left_m:.3g} m without the jumps, {error_m:.3g} m with): "
        "leave out what lies between them, or the part that is off"
    )


def _sudden_m(steps: FloatArray, spans: IntArray) -> FloatArray:
    """Return by how much each of N steps (N, 3), of spans (N,) of a clock, differs from what the
    speeds of the steps before and after it make of its span.
    """
    speeds = steps / np.maximum(spans, 1)[:, None]
    before = np.concatenate([speeds[1:2], speeds[:-1]])
    after = np.concatenate([speeds[1:], speeds[-2:-1]])
    usual = 0.5 * (before + after) * np.maximum(spans, 1)[:, None]
    out: FloatArray = np.linalg.norm(steps - usual, axis=1)
    return out


def _least_jump_m(lengths_m: FloatArray) -> float:
    """Return the length beyond which those of single steps (N,) are no scatter of all."""
    usual_m = float(np.quantile(np.abs(lengths_m), _FAULT.smooth))
    return max(_FAULT.begun * usual_m, _FAULT.min_jump_m)


def lever_arm_note(T_est: FloatArray, T_ref: FloatArray) -> str | None:
    """Return the note on a reference that describes another point of the body; None: the positions
    agree, or no lever arm explains their distances.

    It must explain them beside a scale as well, which bends a short path alike.

    Args:
        T_est: (M, 4, 4) poses that were paired, in the estimate's world.
        T_ref: (M, 4, 4) the poses of the reference.
    """
    found = _explaining_arm(T_est, T_ref)
    if found is None:
        return None
    without_m, left_m, arm = found
    path_m = path_length_m(T_ref[:: _every(T_ref), :3, 3])
    length_m = float(np.linalg.norm(arm))
    if not (without_m > _FAULT.min_share * path_m and without_m < length_m < _FAULT.max_arm_m):
        return None
    return (
        f"the positions agree where the reference's are {length_m:.3g} m beside the estimate's, at "
        f"{arm[0]:+.3f} {arm[1]:+.3f} {arm[2]:+.3f} m in its body (ATE {left_m:.3g} m, "
        f"{without_m:.3g} m without): the reference seems to describe another point of the body, such "
        "as a camera, a prism or an antenna; move its poses by it, or ATE and scale are those of the "
        "distance"
    )


def _explaining_arm(T_est: FloatArray, T_ref: FloatArray) -> tuple[float, float, FloatArray] | None:
    """Return the distances, m, without a lever arm and with it, and the arm (3,), where it explains
    them beside a scale as well; None: it does not.
    """
    every = _every(T_est)
    T_est = T_est[::every]
    y = T_ref[::every, :3, 3]
    if len(y) < _FAULT.min_poses:
        return None
    arms = []
    for scaled in (False, True):
        start = align_poses(T_est, T_ref[::every], "sim3" if scaled else "se3")
        without_m, _ = _beside_arm(T_est, y, start, scaled=scaled, arm=False)
        left_m, arm = _beside_arm(T_est, y, start, scaled=scaled, arm=True)
        if not (math.isfinite(without_m) and left_m < _FAULT.explained * without_m):
            return None
        arms.append((without_m, left_m, arm))
    return arms[0]


def _every(poses: Sized) -> int:
    """Return of how many poses one is used, so that there are `max_poses` at most."""
    return -(-len(poses) // _FAULT.max_poses)


def _beside_arm(
    T_est: FloatArray, y: FloatArray, start: Alignment, *, scaled: bool, arm: bool
) -> tuple[float, FloatArray]:
    """Return the root mean square distance, m, of `s R (p + R_est l) + t` from y, and l (3,).

    Gauss-Newton on R, t, where wanted s and l; each step is linear.

    Args:
        T_est: (M, 4, 4).
        y: (M, 3) positions of the reference.
        start: alignment to begin from.
        scaled: whether s is free.
        arm: whether l is free; otherwise it is zero.
    """
    R = start.R
    t = start.t
    s = start.scale
    lever: FloatArray = np.zeros(3)
    for _ in range(_FAULT.fits):
        turned = s * np.einsum("ij,mj->mi", R, T_est[:, :3, 3] + T_est[:, :3, :3] @ lever)
        error = y - turned - t
        columns = [-so3_hat(turned), np.tile(np.eye(3), (len(y), 1, 1))]
        if scaled:
            columns.append(turned[:, :, None])
        if arm:
            columns.append(s * R @ T_est[:, :3, :3])
        J = np.concatenate(columns, axis=2).reshape(3 * len(y), -1)
        if not np.isfinite(J).all():  # of a diverged estimate
            return math.inf, lever
        step = np.linalg.lstsq(J, error.ravel(), rcond=None)[0]
        R = so3_exp(step[:3]) @ R
        t = t + step[3:6]
        if scaled:
            s *= float(np.exp(step[6]))
        if arm:
            lever = lever + step[-3:]
    moved = s * np.einsum("ij,mj->mi", R, T_est[:, :3, 3] + T_est[:, :3, :3] @ lever) + t
    return float(np.sqrt(np.mean(np.sum((y - moved) ** 2, axis=1)))), lever


def _placeholders(trajectory: Trajectory, name: str) -> str | None:
    """Return the note on poses before the first one, or that are the identity to the bit amid others
    that are not; None: there are none.

    Where a body stands at its start they are the first ones, and it moves on from there.
    """
    T = trajectory.T_world_body
    moved = np.flatnonzero((T[0] != T).any(axis=(1, 2)))
    if not len(moved):
        return None
    begun = int(moved[0])
    steps = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
    jump_m = float(steps[begun - 1])
    if trajectory.times_ns is not None:  # the step over a gap of a recording is no jump
        steps = steps / np.diff(trajectory.times_ns)
    usual = float(steps[begun:].max(initial=0.0))
    jumps = jump_m > _FAULT.min_jump_m and steps[begun - 1] > _FAULT.begun * usual
    if begun > 1 and jumps:
        return (
            f"the first {begun} poses of the {name} are the same to the bit, {jump_m:.3g} m from the "
            "next one: placeholders from before the body was found; remove these rows"
        )
    alike = (np.eye(4) == T).all(axis=(1, 2))
    alike[:begun] = False
    if not alike.any():
        return None
    first = int(np.argmax(alike))
    jump_m = float(np.linalg.norm(trajectory.positions[first - 1]))
    if jump_m < _FAULT.min_jump_m:
        return None
    return (
        f"{alike.sum()} poses of the {name}, from row {first} on, are the identity to the bit, "
        f"{jump_m:.3g} m from the one before: placeholders of frames without a pose, as some programs "
        "write where they are lost; remove these rows"
    )


def _clock_fault(estimate: Trajectory, reference: Trajectory, explained: float) -> str | None:
    """Return the note on a reference whose clock is apart; None: no shift leaves less than a share,
    explained, of the error.
    """
    if estimate.times_ns is None or reference.times_ns is None:
        return None
    start_ns = int(estimate.times_ns[0])
    chosen = slice(None, None, _every(estimate))
    times = (estimate.times_ns[chosen] - start_ns) / NS_PER_S
    known = (reference.times_ns - start_ns) / NS_PER_S
    span_s = min(float(np.ptp(times)), float(np.ptp(known)))
    reach_s = min(_FAULT.max_shift_s, (1 - _FAULT.overlap) * span_s)
    step_s = reach_s / _FAULT.steps
    shift_s = 0.0
    count = _FAULT.steps
    for _ in range(3):
        shifts: FloatArray = shift_s + step_s * np.arange(-count, count + 1, dtype=np.float64)
        left, ratios = _of_shifts(
            estimate.positions[chosen], times, reference.positions, known, shifts
        )
        best = int(np.argmin(ratios))
        shift_s = float(shifts[best])
        step_s /= _FAULT.finer
        count = _FAULT.finer
    if not ratios[best] < explained or abs(shift_s) < _usual_step_s(estimate.times_ns) / 4:
        return None
    way = "late" if shift_s > 0 else "early"
    return (
        f"the positions agree where the reference's times are {abs(shift_s):.3f} s {way} (ATE after "
        f"Sim(3) {left[best]:.3g} m, {left[best] / ratios[best]:.3g} m without): its clock is not the "
        f"estimate's; {'subtract this from' if shift_s > 0 else 'add this to'} its times"
    )


def _usual_step_s(times_ns: IntArray) -> float:
    return float(np.median(np.diff(times_ns))) / NS_PER_S


def _of_shifts(
    x: FloatArray, times: FloatArray, y: FloatArray, known: FloatArray, shifts: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the errors (S,) that are left where a reference is late by shifts (S,), and their ratio
    to those of the same poses without; infinite where too few have a reference.
    """
    at = times + shifts[:, None]
    used = (at >= known[0]) & (at <= known[-1]) & (times >= known[0]) & (times <= known[-1])
    moved = np.stack([np.interp(at, known, y[:, axis]) for axis in range(3)], axis=-1)
    given = np.stack([np.interp(times, known, y[:, axis]) for axis in range(3)], axis=-1)
    enough = used.sum(axis=1) >= max(_FAULT.min_poses, _FAULT.overlap * len(times))
    left = np.full(len(shifts), np.inf)
    ratios = np.full(len(shifts), np.inf)
    if enough.any():
        left[enough] = _errors(x, moved[enough], used[enough])
        without = _errors(x, given, used[enough])
        rounding = _ROUNDING * max(float(np.ptp(given)), np.finfo(np.float64).tiny)
        ratios[enough] = (left[enough] + rounding) / (without + rounding)
    return left, ratios


def _errors(x: FloatArray, y: FloatArray, used: BoolArray | None = None) -> FloatArray:
    """Return the root mean square distances (B,) of points x (M, 3) to y (M, 3) or (B, M, 3) after
    the similarity that makes them least; of those that are used (B, M), all if None.

    Reference: Umeyama (1991), equation 34.
    """
    if used is None:
        weights = np.ones((1, len(x)))
    else:
        weights = used.astype(np.float64)
    weights = (weights / weights.sum(axis=1, keepdims=True))[..., None]
    x = x - np.sum(weights * x, axis=1, keepdims=True)
    y = y - np.sum(weights * y, axis=1, keepdims=True)
    U, d, Vt = np.linalg.svd(np.swapaxes(y, 1, 2) @ (weights * x))
    d[:, 2] *= np.sign(np.linalg.det(U @ Vt))
    squares = np.sum(weights * x**2, axis=(1, 2))
    gain = np.divide(d.sum(axis=1) ** 2, squares, out=np.zeros(len(x)), where=squares > 0)
    rest = np.sum(weights * y**2, axis=(1, 2)) - gain
    out: FloatArray = np.sqrt(np.maximum(rest, 0.0))
    return out
