"""Evaluation: equal to evo, to brute force and to hand-computed cases; association, degenerate
motion, NEES.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from vio.cli import main
from vio.errors import EvaluationError
from vio.evaluation.alignment import AlignMode, align_poses, apply_alignment, settle_rotation
from vio.evaluation.association import associate, associate_times
from vio.evaluation.consistency import nees, nees_bounds
from vio.evaluation.errors_along_path import (
    KITTI_LENGTHS_M,
    kitti_error,
    path_length_m,
    relative_error_distance,
    relative_error_frames,
    rotation_angle_deg,
)
from vio.evaluation.trajectories import evaluate, lengths_text, metres_texts
from vio.files.trajectories import read_trajectory, write_tum
from vio.geometry.lie import (
    FloatArray,
    nearest_rotation,
    quat_xyzw_from_rotation,
    rotation_from_quat_xyzw,
    se3_exp,
    se3_from_parts,
    se3_inverse,
    so3_exp,
)
from vio.records import BodyFrame, Trajectory

properties = settings(max_examples=30, deadline=None)
MODES: tuple[AlignMode, ...] = ("se3", "sim3", "none", "first")
T_CAM0_IMU = se3_exp([0.3, -0.1, 0.8, 1.2, -1.2, 1.1])
REAL = ("kitti_0039/poses.txt", "kitti_06_head/poses.txt", "ece276a/kitti_odometry_07_poses.txt")


def wander(n: int, seed: int = 0, step_m: float = 1.0) -> FloatArray:
    """A smooth random motion (n, 4, 4)."""
    rng = np.random.default_rng(seed)
    twist = np.array([0, 0, step_m, 0, 0.01, 0]) + rng.normal(size=(n, 6)) * [
        0.1,
        0.1,
        0.2,
        0.02,
        0.05,
        0.02,
    ]
    T = np.empty((n, 4, 4))
    T[0] = se3_exp(rng.normal(size=6))
    for k in range(1, n):
        T[k] = T[k - 1] @ se3_exp(twist[k])
    return T


def drift(T: FloatArray, seed: int = 1, sigma: float = 0.01) -> FloatArray:
    """The same motion as estimated by noisy odometry, from another start."""
    rng = np.random.default_rng(seed)
    out = np.empty_like(T)
    out[0] = se3_exp(rng.normal(size=6))
    for k in range(1, len(T)):
        out[k] = out[k - 1] @ se3_inverse(T[k - 1]) @ T[k] @ se3_exp(sigma * rng.normal(size=6))
    return out


def kitti_form(T: FloatArray, body: BodyFrame = "cam0") -> Trajectory:
    return Trajectory(T, None, body)


def timed(
    T: FloatArray, step_ns: int = 100_000_000, start_ns: int = 0, body: BodyFrame = "cam0"
) -> Trajectory:
    return Trajectory(T, start_ns + step_ns * np.arange(len(T), dtype=np.int64), body)


# Equal to evo


def evo_pair(T_est: FloatArray, T_ref: FloatArray, align: AlignMode) -> tuple[Any, Any]:
    from evo.core.trajectory import PosePath3D

    ref, est = PosePath3D(poses_se3=list(T_ref.copy())), PosePath3D(poses_se3=list(T_est.copy()))
    if align == "first":
        est.align_origin(ref)
    elif align != "none":
        est.align(ref, correct_scale=align == "sim3")
    return ref, est


def evo_statistics(metric: Any, pair: tuple[Any, Any]) -> dict[str, float]:
    metric.process_data(pair)
    return dict(metric.get_all_statistics())


def assert_equals_evo(
    T_est: FloatArray, T_ref: FloatArray, align: AlignMode, *, straight: bool = False
) -> None:
    """All figures but those of orientations on a straight path, where evo leaves the rotation
    about it open.
    """
    from evo.core import metrics

    ours = evaluate(
        kitti_form(T_est), kitti_form(T_ref), align=align, rpe_delta_frames=3, rpe_delta_m=7.0
    )
    pair = evo_pair(T_est, T_ref, align)
    relation = metrics.PoseRelation
    settled = straight and align in ("se3", "sim3")
    assert (ours.rotation_from == "direction and orientations") == settled
    for mine, which in (
        (ours.ate_m, relation.translation_part),
        (ours.ate_deg, relation.rotation_angle_deg),
    ):
        if settled and mine is ours.ate_deg:
            continue
        theirs = evo_statistics(metrics.APE(which), pair)
        for name in ("rmse", "mean", "median", "max"):
            assert getattr(mine, name) == pytest.approx(theirs[name], rel=1e-9), (which, name)
    for rpe, delta, unit in (
        (ours.rpe, 3, metrics.Unit.frames),
        (ours.rpe_distance, 7.0, metrics.Unit.meters),
    ):
        for value, which in (
            (rpe.trans_rmse_m, relation.translation_part),
            (rpe.rot_rmse_deg, relation.rotation_angle_deg),
        ):
            metric = metrics.RPE(which, delta, unit, all_pairs=True, pairs_from_reference=True)
            assert value == pytest.approx(evo_statistics(metric, pair)["rmse"], rel=1e-9), (
                which,
                unit,
            )
            assert rpe.pairs == len(metric.error)
    if not settled:
        np.testing.assert_allclose(ours.aligned.T_world_body, pair[1].poses_se3, atol=1e-9)
    assert ours.path_length_m == pytest.approx(
        evo_pair(T_est, T_ref, "none")[1].path_length, rel=1e-12
    )


@pytest.mark.parametrize("align", MODES)
@pytest.mark.parametrize("seed", range(5))
def test_equals_evo_on_random_trajectories(align: AlignMode, seed: int) -> None:
    T_ref = wander(120, seed)
    T_est = drift(T_ref, seed + 100, sigma=0.02)
    T_est[:, :3, 3] *= 0.9 + 0.1 * seed
    assert_equals_evo(T_est, T_ref, align)


@pytest.mark.parametrize("align", MODES)
@pytest.mark.parametrize("name", REAL)
def test_equals_evo_on_real_ground_truth(data_dir: Path, align: AlignMode, name: str) -> None:
    T_ref = read_trajectory(data_dir / name).T_world_body
    assert_equals_evo(drift(T_ref, sigma=0.005), T_ref, align, straight=name.startswith("kitti_0"))


def test_association_by_time_pairs_what_evo_pairs() -> None:
    from evo.core import sync
    from evo.core.trajectory import PoseTrajectory3D

    rng = np.random.default_rng(0)
    a = np.cumsum(rng.integers(40_000_000, 60_000_000, size=100))
    b = np.sort(a[::2] + rng.integers(-6_000_000, 6_000_000, size=50))
    rows, reference_rows = associate_times(a, b, max_difference_ns=4_000_000)
    identity = np.tile(np.eye(4), (100, 1, 1))
    first, second = (
        PoseTrajectory3D(poses_se3=list(identity[: len(t)]), timestamps=t / 1e9) for t in (a, b)
    )
    theirs = sync.associate_trajectories(first, second, max_diff=0.004)
    np.testing.assert_allclose(a[rows] / 1e9, theirs[0].timestamps)
    np.testing.assert_allclose(b[reference_rows] / 1e9, theirs[1].timestamps)
    assert 20 < len(rows) < 50


@pytest.mark.parametrize(
    ("step_ns", "mode", "count"),
    [(100_000_000, "frame", 40), (104_000_000, "time", 40), (99_000_000, "time", 7)],
)
def test_assumed_times_are_those_of_no_clock(step_ns: int, mode: str, count: int) -> None:
    frames = np.arange(40)
    poses = np.tile(np.eye(4), (40, 1, 1))
    reference = Trajectory(poses, 104_000_000 * frames, "cam0", frames)
    estimate = Trajectory(poses, step_ns * frames, "cam0", frames)
    found, rows, reference_rows = associate(estimate, reference)
    assert (found, len(rows)) == (mode, count)
    if mode == "frame":
        np.testing.assert_array_equal(rows, reference_rows)
    # a reference without numbers has times alone
    alone = Trajectory(poses, reference.times_ns, "cam0")
    assert associate(estimate, alone)[0] == "time"


@pytest.mark.parametrize("every", [1, 2])
def test_times_that_both_have_are_no_assumed_ones(every: int) -> None:
    frames = np.arange(40)
    poses = np.tile(np.eye(4), (40, 1, 1))
    estimate = Trajectory(poses, 100_000_000 * frames, "cam0", frames)
    # a part of the same simulation, whose own numbers begin at 0
    part = frames[10:30:every]
    reference = Trajectory(poses[part], 100_000_000 * part, "cam0", np.arange(len(part)))
    mode, rows, _ = associate(estimate, reference)
    assert mode == "time"
    np.testing.assert_array_equal(rows, part)


# The KITTI metric


def brute_force_kitti(
    T_est: FloatArray, T_ref: FloatArray, lengths: Sequence[float]
) -> tuple[float, float, int]:
    """The metric written from its definition: loops, 4x4 inverses, and angles by scipy."""
    errors_t, errors_r = [], []
    for first in range(0, len(T_ref), 10):
        for length in lengths:
            gone, last = 0.0, None
            for k in range(first + 1, len(T_ref)):
                gone += float(np.linalg.norm(T_ref[k, :3, 3] - T_ref[k - 1, :3, 3]))
                if gone > length:
                    last = k
                    break
            if last is None:
                continue
            motion_ref = np.linalg.inv(T_ref[first]) @ T_ref[last]
            motion_est = np.linalg.inv(T_est[first]) @ T_est[last]
            error = np.linalg.inv(motion_est) @ motion_ref
            errors_t.append(float(np.linalg.norm(error[:3, 3])) / length)
            errors_r.append(float(Rotation.from_matrix(error[:3, :3]).magnitude()) / length)
    return 100 * float(np.mean(errors_t)), 100 * float(np.degrees(np.mean(errors_r))), len(errors_t)


@pytest.mark.parametrize("seed", range(3))
def test_kitti_error_equals_brute_force(seed: int) -> None:
    T_ref = wander(450, seed, step_m=1.3)
    T_est = drift(T_ref, seed)
    lengths = (50.0, 100.0, 200.0, 400.0, 800.0)
    ours = kitti_error(T_est, T_ref, lengths)
    t_err, r_err, segments = brute_force_kitti(T_est, T_ref, lengths)
    assert ours.segments == segments
    assert ours.t_err_percent == pytest.approx(t_err, rel=1e-9)
    assert ours.r_err_deg_per_100m == pytest.approx(r_err, rel=1e-9)
    for row in ours.per_length[:4]:
        t_err, r_err, segments = brute_force_kitti(T_est, T_ref, (row.length_m,))
        assert row.segments == segments
        assert row.t_err_percent == pytest.approx(t_err, rel=1e-9)
        assert row.r_err_deg_per_100m == pytest.approx(r_err, rel=1e-9)
    assert ours.per_length[4].segments == 0
    assert ours.per_length[4].t_err_percent is None
    assert ours.per_length[4].r_err_deg_per_100m is None


def test_kitti_error_equals_brute_force_on_sequence_07(data_dir: Path) -> None:
    T_ref = read_trajectory(data_dir / REAL[2]).T_world_body
    T_est = drift(T_ref, sigma=0.003)
    ours = evaluate(kitti_form(T_est), kitti_form(T_ref)).kitti
    t_err, r_err, segments = brute_force_kitti(T_est, T_ref, range(100, 801, 100))
    assert (ours.segments, [row.segments for row in ours.per_length]) == (
        segments,
        [89, 79, 58, 44, 30, 17, 0, 0],
    )
    assert ours.t_err_percent == pytest.approx(t_err, rel=1e-9)
    assert ours.r_err_deg_per_100m == pytest.approx(r_err, rel=1e-9)


def straight(n: int, step_m: float = 1.0) -> FloatArray:
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 2, 3] = step_m * np.arange(n)
    return T


def test_a_scale_error_of_one_percent_is_one_percent_drift() -> None:
    # A step of 1 m: the first pose more than 100 m away is the 101st, so the error is 1.01 m per
    # 100 m.
    ours = evaluate(kitti_form(straight(301, 1.01)), kitti_form(straight(301)), align="none").kitti
    assert ours.per_length[0].t_err_percent == pytest.approx(1.01)
    assert ours.per_length[1].t_err_percent == pytest.approx(0.01 * 201 / 200 * 100)
    assert ours.r_err_deg_per_100m == pytest.approx(0, abs=1e-12)
    fine = kitti_error(straight(30001, 0.0101), straight(30001, 0.01), (100.0,), step_frames=500)
    assert fine.t_err_percent == pytest.approx(1.0, rel=2e-4)


def test_sim3_takes_the_scale_error_out() -> None:
    ours = evaluate(kitti_form(straight(301, 1.01)), kitti_form(straight(301)), align="sim3")
    assert ours.scale == pytest.approx(1 / 1.01)
    assert ours.kitti.t_err_percent == pytest.approx(0, abs=1e-9)
    assert ours.path_length_m == pytest.approx(303)


def test_a_constant_rotation_rate_error_is_the_rotational_drift() -> None:
    T_ref = straight(301)
    T_est = T_ref.copy()
    T_est[:, :3, :3] = so3_exp(
        np.radians(0.02) * np.arange(301)[:, None] * [0, 0, 1.0]
    )  # about the direction of travel
    ours = kitti_error(T_est, T_ref, (100.0, 200.0))
    assert ours.per_length[0].r_err_deg_per_100m == pytest.approx(0.02 * 101)
    assert ours.t_err_percent == pytest.approx(0, abs=1e-9)


def test_a_record_shorter_than_every_length_asked_for_has_no_kitti_metric(data_dir: Path) -> None:
    reference = read_trajectory(data_dir / REAL[0])
    assert evaluate(reference, reference, lengths_m=KITTI_LENGTHS_M).kitti is None
    short = evaluate(reference, reference, lengths_m=(50.0,)).kitti
    assert short.t_err_percent == pytest.approx(0, abs=1e-10)


@pytest.mark.parametrize(
    ("path_m", "lengths"),
    [(250, (100, 200)), (95, (10, 20, 30, 40, 50, 60, 70, 80)), (4.5, (1, 2, 3, 4)), (0.9, ())],
)
def test_the_drift_of_a_short_path_is_that_over_tenths_of_the_lengths(
    path_m: float, lengths: tuple[float, ...]
) -> None:
    T_ref = straight(1000)
    T_ref[:, :3, 3] *= path_m / 999
    T_est = T_ref.copy()
    T_est[:, :3, 3] *= 1.01
    found = evaluate(kitti_form(T_est), kitti_form(T_ref), align="first")
    if not lengths:
        assert found.kitti is None
        return
    assert found.kitti.lengths_m == pytest.approx(lengths)
    assert found.as_dict()["drift_lengths_m"] == pytest.approx(lengths)
    step = path_m / 999  # a segment ends with the first pose beyond its length
    assert 1.0 <= found.kitti.t_err_percent <= 1.0 * (1 + step / lengths[0]) + 1e-9
    assert lengths_text(found.kitti.lengths_m) == f"{lengths[0]} to {lengths[-1]} m"


def test_a_drift_of_rotation_over_metres_is_given_by_the_metre(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """0.02 degrees a metre would be 2 degrees for 100 m, of a path of four."""
    for path_m, unit in ((4.5, "0.0200 deg/m"), (250, "2.0000 deg/100 m")):
        T_ref = straight(1000)
        T_ref[:, :3, 3] *= path_m / 999
        turns = np.radians(0.02) * np.linalg.norm(T_ref[:, :3, 3] - T_ref[0, :3, 3], axis=1)
        T_est = se3_from_parts(so3_exp(turns[:, None] * [0, 0, 1.0]), T_ref[:, :3, 3])
        for name, T in (("est", T_est), ("ref", T_ref)):
            write_tum(tmp_path / name, timed(T))
        assert main(["eval", str(tmp_path / "est"), str(tmp_path / "ref"), "--align", "none"]) == 0
        lines = [line for line in capsys.readouterr().out.splitlines() if " deg/" in line]
        assert len(lines) > 2
        assert all(unit[:4] in line and unit.split()[1] in line for line in lines)
        assert ("deg/100 m" in lines[0]) == (path_m > 10)


def test_exactly_the_length_is_not_yet_a_segment() -> None:
    assert kitti_error(straight(101), straight(101), (100.0,)) is None
    assert kitti_error(straight(102), straight(102), (100.0,)) is not None
    assert kitti_error(straight(102), straight(102), ()) is None


@pytest.mark.parametrize(
    ("lengths", "step"), [((0.0,), 10), ((100.0, -1.0), 10), ((float("nan"),), 10), ((50.0,), 0)]
)
def test_rejects_invalid_segment_lengths(lengths: tuple[float, ...], step: int) -> None:
    with pytest.raises(EvaluationError, match="must be positive"):
        kitti_error(straight(200), straight(200), lengths, step)


# Alignment


@properties
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 20), st.sampled_from(MODES[:2]))
def test_errors_do_not_depend_on_the_world_frame_nor_sim3_on_scale(
    seed: int, scale: float, align: AlignMode
) -> None:
    T_ref = wander(40, seed)
    T_est = drift(T_ref, seed + 1)
    first = evaluate(kitti_form(T_est), kitti_form(T_ref), align=align)
    moved = se3_exp(np.random.default_rng(seed).normal(size=6) * 3) @ T_est
    if align == "sim3":
        moved[:, :3, 3] *= scale
    second = evaluate(kitti_form(moved), kitti_form(T_ref), align=align)
    np.testing.assert_allclose(second.errors_m, first.errors_m, atol=1e-9)
    np.testing.assert_allclose(second.errors_deg, first.errors_deg, atol=1e-6)
    np.testing.assert_allclose(second.aligned.T_world_body, first.aligned.T_world_body, atol=1e-8)
    if align == "sim3":
        assert second.scale * scale == pytest.approx(first.scale, rel=1e-9)


@properties
@given(st.integers(0, 2**32 - 1), st.sampled_from(MODES[:2]))
def test_no_neighbouring_alignment_is_better(seed: int, align: AlignMode) -> None:
    rng = np.random.default_rng(seed)
    T_ref = wander(30, seed)
    T_est = drift(T_ref, seed + 1, sigma=0.1)
    best = align_poses(T_est, T_ref, align)

    def cost(x: FloatArray) -> float:
        R, t = so3_exp(x[:3]) @ best.R, best.t + x[3:6]
        p = best.scale * np.exp(x[6]) * T_est[:, :3, 3] @ R.T + t
        return float(np.sum((p - T_ref[:, :3, 3]) ** 2))

    for step in 1e-3 * rng.normal(size=(20, 7)):
        assert cost(np.zeros(7)) <= cost(step * ([1] * 6 + [align == "sim3"])) + 1e-9


@properties
@given(st.integers(0, 2**32 - 1), st.floats(0.1, 10))
def test_a_known_similarity_is_found(seed: int, scale: float) -> None:
    T_est = wander(20, seed)
    truth = se3_exp(np.random.default_rng(seed).normal(size=6) * 2)
    T_ref = truth @ se3_from_parts(T_est[:, :3, :3], scale * T_est[:, :3, 3])
    found = align_poses(T_est, T_ref, "sim3")
    assert found.scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(se3_from_parts(found.R, found.t), truth, atol=1e-8 * (1 + scale))
    np.testing.assert_allclose(apply_alignment(found, T_est), T_ref, atol=1e-8 * (1 + scale))


def test_a_mirrored_motion_is_aligned_by_a_rotation() -> None:
    T_ref = wander(50)
    T_est = T_ref.copy()
    T_est[:, 0, 3] *= -1
    assert np.linalg.det(align_poses(T_est, T_ref, "se3").R) == pytest.approx(1)


def degenerate(kind: str) -> FloatArray:
    rotations = wander(8)[:, :3, :3]
    line = np.array([[1.0, -2.0, 0.5]]) * np.array([0, 1, 2, 2.5, 4, 6, 7, 9.0])[:, None] + 100
    match kind:
        case "one pose":
            return se3_from_parts(rotations[:1], [[1.0, 2, 3]])
        case "two poses":
            return se3_from_parts(rotations[:2], line[:2])
        case "straight":
            return se3_from_parts(rotations, line)
        case "stationary to rounding":
            return se3_from_parts(rotations, 5.0 + 1e-15 * np.arange(24).reshape(8, 3) ** 2)
        case _:
            return se3_from_parts(rotations, np.full((8, 3), 5.0))


@pytest.mark.parametrize(
    "kind", ["one pose", "two poses", "straight", "stationary", "stationary to rounding"]
)
@pytest.mark.parametrize("seed", range(3))
def test_orientations_determine_alignment_where_positions_do_not(kind: str, seed: int) -> None:
    T_ref = degenerate(kind)
    truth = se3_exp(np.random.default_rng(seed).normal(size=6) * 2)
    found = evaluate(kitti_form(se3_inverse(truth) @ T_ref), kitti_form(T_ref))
    np.testing.assert_allclose(found.T_ref_est, truth, atol=1e-6)
    assert found.ate_m.max < 1e-9
    assert found.ate_deg.max < 1e-6


@pytest.mark.parametrize("kind", ["two poses", "straight"])
def test_sim3_along_a_line_is_defined(kind: str) -> None:
    T_ref = degenerate(kind)
    truth = se3_exp([1, 2, 3, 0.5, -1.0, 2.0])
    T_est = se3_inverse(truth) @ T_ref
    T_est[:, :3, 3] /= 3
    found = evaluate(kitti_form(T_est), kitti_form(T_ref), align="sim3")
    assert found.scale == pytest.approx(3, rel=1e-9)
    assert found.ate_m.max < 1e-9
    assert found.ate_deg.max < 1e-6


@pytest.mark.parametrize("kind", ["one pose", "stationary", "stationary to rounding"])
def test_rejects_sim3_without_motion(kind: str) -> None:
    T = degenerate(kind)
    with pytest.raises(EvaluationError, match="align with se3 or none"):
        evaluate(kitti_form(T), kitti_form(T), align="sim3")
    moving = wander(8)[: len(T)]
    with pytest.raises(EvaluationError, match="align with se3 or none"):
        evaluate(kitti_form(moving), kitti_form(T), align="sim3")


def test_a_motionless_estimate_of_a_motion_has_the_spread_of_the_reference_as_error() -> None:
    T_ref = wander(50)
    found = evaluate(kitti_form(np.tile(T_ref[0], (50, 1, 1))), kitti_form(T_ref))
    p = T_ref[:, :3, 3]
    assert found.ate_m.rmse == pytest.approx(
        np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=1)))
    )


def test_alignment_none_is_the_identity() -> None:
    T_ref = wander(10)
    T_est = T_ref.copy()
    T_est[:, 0, 3] += 3.0
    found = evaluate(kitti_form(T_est), kitti_form(T_ref), align="none")
    np.testing.assert_array_equal(found.T_ref_est, np.eye(4))
    np.testing.assert_allclose(found.errors_m, 3.0, rtol=1e-14)
    assert found.scale == 1.0


@pytest.mark.parametrize(("own", "other"), [("imu", "cam0"), ("cam0", "imu")])
def test_different_bodies_have_different_worlds(own: BodyFrame, other: BodyFrame) -> None:
    """Each trajectory starts at the identity of its own frame, as a run and a KITTI file do."""
    truth = timed(wander(60), body=other)
    seen = truth.in_imu(T_CAM0_IMU) if own == "imu" else truth.in_cam0(T_CAM0_IMU)
    estimate = replace(seen, T_world_body=se3_inverse(seen.T_world_body[0]) @ seen.T_world_body)
    with pytest.raises(
        EvaluationError, match=rf"describes {own} and the reference {other}, .* take align first"
    ):
        evaluate(estimate, truth, align="none", T_cam0_imu=T_CAM0_IMU)
    assert evaluate(estimate, truth, align="first", T_cam0_imu=T_CAM0_IMU).ate_m.max < 1e-12


def test_alignment_first_starts_at_the_first_match() -> None:
    T_ref = wander(60)
    T_est = drift(T_ref)
    found = evaluate(timed(T_est), timed(T_ref[10:40], start_ns=1_000_000_000), align="first")
    np.testing.assert_allclose(found.aligned.T_world_body[10], T_ref[10], atol=1e-12)
    assert found.errors_m[0] < 1e-12
    assert (found.rotation_from, found.scale) == ("first pose", 1.0)


# Rotation about a nearly straight path


def road(n: int = 120, *, curve_m: float = 0.0) -> FloatArray:
    """A drive along z that rises by 0.3 m and bends to the side."""
    s = np.linspace(0, 1, n)
    p = np.stack([curve_m * s**2, 0.3 * s**2, 100 * s], axis=1)
    return se3_from_parts(np.tile(np.eye(3), (n, 1, 1)), p)


def drifting_aside(T: FloatArray) -> FloatArray:
    """The same in another world, with a heading that drifts by 0.5 degrees over 100 m."""
    s = np.linspace(0, 1, len(T))
    R = so3_exp(np.outer(np.radians(0.5) * s, [0, 1.0, 0])) @ T[:, :3, :3]
    p = T[:, :3, 3] + np.outer(50 * np.radians(0.5) * s**2, [1.0, 0, 0])
    return se3_exp([3, -2, 5, 0.3, 0.9, -1.1]) @ se3_from_parts(R, p)


@pytest.mark.parametrize("align", ["se3", "sim3"])
def test_straight_path_does_not_leave_the_rotation_about_it_open(align: AlignMode) -> None:
    """Least squares rotate the sideward drift into the rise, by 40 degrees and more."""
    T_ref = road()
    T_est = drifting_aside(T_ref)
    least_squares = align_poses(T_est, T_ref, align)
    wrong_deg = rotation_angle_deg(
        np.swapaxes(T_ref[:, :3, :3], 1, 2) @ least_squares.R @ T_est[:, :3, :3]
    )
    assert wrong_deg.min() > 30
    found = evaluate(kitti_form(T_est), kitti_form(T_ref), align=align)
    assert found.ate_deg.max < 0.6
    assert found.rotation_from == found.as_dict()["rotation_from"] == "direction and orientations"
    distances = np.linalg.norm(
        apply_alignment(least_squares, T_est)[:, :3, 3] - T_ref[:, :3, 3], axis=1
    )
    np.testing.assert_array_equal(found.errors_m, distances)  # the ATE stays that of least squares
    np.testing.assert_allclose(
        found.T_ref_est[:3, :3] @ T_est[0, :3, :3], T_ref[0, :3, :3], atol=0.02
    )


@pytest.mark.parametrize("name", REAL[:2])
def test_straight_drives_on_real_ground_truth(data_dir: Path, name: str) -> None:
    T_ref = read_trajectory(data_dir / name).T_world_body
    T_est = drift(T_ref, sigma=0.005)
    least_squares = align_poses(T_est, T_ref, "se3")
    wrong_deg = rotation_angle_deg(
        np.swapaxes(T_ref[:, :3, :3], 1, 2) @ least_squares.R @ T_est[:, :3, :3]
    )
    assert np.median(wrong_deg) > 50
    best = nearest_rotation(np.einsum("nij,nkj->ik", T_ref[:, :3, :3], T_est[:, :3, :3]))
    drifted_deg = rotation_angle_deg(np.swapaxes(T_ref[:, :3, :3], 1, 2) @ best @ T_est[:, :3, :3])
    assert evaluate(kitti_form(T_est), kitti_form(T_ref)).ate_deg.rmse < 1.5 * np.sqrt(
        np.mean(drifted_deg**2)
    )


def test_curved_path_is_aligned_by_its_positions_alone() -> None:
    T_ref = road(curve_m=20)
    T_est = drifting_aside(T_ref)
    found = evaluate(kitti_form(T_est), kitti_form(T_ref))
    assert found.rotation_from == "positions"
    np.testing.assert_array_equal(found.T_ref_est[:3, :3], align_poses(T_est, T_ref, "se3").R)


def test_orientations_that_contradict_the_positions_are_not_taken() -> None:
    """A reference from GPS carries no orientations: identities, constant as those of a straight
    drive are.
    """
    T_ref = road(curve_m=20)
    T_est = se3_inverse(se3_exp([0, 0, 0, 0, 0, 2.0])) @ T_ref
    T_est[:, :3, :3] = np.eye(3)
    T_est[:, :3, 3] += np.random.default_rng(0).normal(size=(len(T_ref), 3)) * 0.3
    assert (
        settle_rotation(align_poses(T_est, T_ref, "se3"), T_est, T_ref).rotation_from == "positions"
    )


# Association


@pytest.mark.parametrize(
    ("a", "b", "limit", "expected"),
    [
        ([0, 10, 20], [0, 10, 20], 0, [(0, 0), (1, 1), (2, 2)]),
        ([0, 10, 20], [1, 11, 21], 0, []),
        ([0, 10, 20], [1, 11, 21], 1, [(0, 0), (1, 1), (2, 2)]),
        ([0, 10, 20], [5, 15, 25], 5, [(0, 0), (1, 1), (2, 2)]),  # all equally close: in order
        ([0, 10], [9], 20, [(1, 0)]),  # one to one: the closer one
        ([9], [0, 10], 20, [(0, 1)]),
        ([0, 9], [8, 20], 20, [(1, 0)]),  # never crossing: 0 with 20 would overtake 9 with 8
        ([0, 1, 2, 3, 4], [2], 9, [(2, 0)]),
        ([10, 11, 12], [0, 11, 30], 5, [(1, 1)]),
        ([], [1, 2], 5, []),
        ([1, 2], [], 5, []),
        # not distinguishable as floats
        ([1403715273262142976], [1403715273262142977], 1, [(0, 0)]),
        ([1403715273262142976], [1403715273262142977], 0, []),
    ],
)
def test_association_by_time(
    a: list[int], b: list[int], limit: int, expected: list[tuple[int, int]]
) -> None:
    rows, reference_rows = associate_times(a, b, max_difference_ns=limit)
    assert list(zip(rows.tolist(), reference_rows.tolist(), strict=True)) == expected


def test_the_time_of_an_association_grows_with_the_poses() -> None:
    """Eight times as many take about eight times as long."""
    rng = np.random.default_rng(0)
    seconds = []
    for count in (10_000, 80_000):
        a = 5_000_000 * np.arange(count)
        b = a + rng.integers(-2_000_000, 2_000_000, count)
        began = time.process_time()
        rows, _ = associate_times(a, b, max_difference_ns=10_000_000)
        seconds.append(time.process_time() - began)
        assert len(rows) > 0.99 * count
    assert seconds[1] < 16 * seconds[0]


times = st.lists(st.integers(0, 200), max_size=25, unique=True).map(sorted)


@properties
@given(times, times, st.integers(0, 40))
def test_association_is_one_to_one_in_order_and_leaves_no_close_pair(
    a: list[int], b: list[int], limit: int
) -> None:
    rows, reference_rows = (r.tolist() for r in associate_times(a, b, max_difference_ns=limit))
    assert rows == sorted(set(rows))
    assert reference_rows == sorted(set(reference_rows))
    distances = {i: abs(a[i] - b[j]) for i, j in zip(rows, reference_rows, strict=True)}
    assert all(d <= limit for d in distances.values())
    partner = dict(zip(reference_rows, rows, strict=True))
    for i, time_ns in enumerate(a):
        for j, other in enumerate(b):
            d = abs(time_ns - other)
            if d < min(
                limit + 1, distances.get(i, limit + 1), distances.get(partner.get(j, -1), limit + 1)
            ):
                # A closer pair may stay apart only where it would cross one that is closer still.
                crossing = [
                    d2
                    for i2, j2 in zip(rows, reference_rows, strict=True)
                    if (i2 - i) * (j2 - j) <= 0
                    for d2 in [abs(a[i2] - b[j2])]
                ]
                assert min(crossing) <= d


def test_a_sparse_reference_evaluates_its_frames() -> None:
    T = wander(100)
    reference = Trajectory(T[10:90:4], 100_000_000 * np.arange(10, 90, 4) + 3_000_000, "cam0")
    found = evaluate(timed(T), reference)
    assert found.association == "time"
    np.testing.assert_array_equal(found.rows, np.arange(10, 90, 4))
    assert found.ate_m.max < 1e-9
    assert found.coverage.estimate == pytest.approx(0.2)
    assert found.coverage.reference_span == 1.0
    assert found.coverage.longest_gap_s == pytest.approx(0.4)


def test_coverage_reports_a_late_start_and_a_gap() -> None:
    T = wander(101)
    full = timed(T)
    kept = np.r_[20:50, 80:101]
    found = evaluate(replace(full, T_world_body=T[kept], times_ns=full.times_ns[kept]), full)
    assert found.coverage.estimate == 1.0
    assert found.coverage.reference_span == pytest.approx(0.8)
    assert found.coverage.longest_gap_s == pytest.approx(3.1)


def test_time_association_respects_the_limit() -> None:
    T = wander(10)
    late = timed(T, start_ns=15_000_000)
    with pytest.raises(
        EvaluationError, match=r"no poses within 0.01 s.*closest pair 0.015 s; check the clocks"
    ):
        evaluate(late, timed(T))
    assert evaluate(late, timed(T), max_time_difference_s=0.015).matched == 10


@pytest.mark.parametrize(("unit", "factor"), [("milliseconds", 10**3), ("microseconds", 10**6)])
def test_error_names_the_unit_in_which_the_reference_covers_the_estimate(
    unit: str, factor: int
) -> None:
    T = wander(40)
    estimate = timed(T, start_ns=300_000_000)
    truth = timed(T)
    wrong = replace(truth, times_ns=truth.times_ns * factor + 7 * factor)
    with pytest.raises(EvaluationError, match=f"are {unit}, .* divide them by {factor}$"):
        evaluate(estimate, wrong)


def test_error_names_no_unit_in_which_the_reference_covers_a_part_alone() -> None:
    """Of points that are surveyed each 5 s, which are within a second once they are divided."""
    estimate = timed(wander(40))
    reference = timed(wander(20))
    sparse = replace(reference, times_ns=5 * 10**9 * np.arange(20) + 37 * 10**6)
    with pytest.raises(EvaluationError, match=r"or allow a larger difference$"):
        evaluate(estimate, sparse, max_time_difference_s=0.01)


def test_error_reports_different_clocks() -> None:
    T = wander(10)
    with pytest.raises(
        EvaluationError, match=r"estimate covers 0.000 to 0.900 s, the reference 1403715273.000 to"
    ):
        evaluate(timed(T), timed(T, start_ns=1_403_715_273 * 10**9))


def test_a_kitti_reference_is_associated_by_frame_and_may_be_shorter() -> None:
    T = wander(50)
    found = evaluate(timed(T), kitti_form(T[:30]))
    assert found.association == "frame"
    np.testing.assert_array_equal(found.rows, np.arange(30))
    assert found.coverage.estimate == pytest.approx(0.6)
    assert found.coverage.reference_span == 1.0


def test_frame_numbers_of_the_estimate_are_honoured() -> None:
    T = wander(50)
    frames = np.array([10, 11, 14, 20, 49, 60])
    estimate = replace(timed(T[np.minimum(frames, 49)]), frame_indices=frames)
    found = evaluate(estimate, kitti_form(T), align="none")
    np.testing.assert_array_equal(found.rows, np.arange(5))
    assert found.ate_m.max == 0.0
    assert found.coverage.estimate == pytest.approx(5 / 6)
    assert found.coverage.reference_span == pytest.approx(39 / 49)
    np.testing.assert_array_equal(found.reference.frame_indices, frames[:5])


def test_frame_numbers_of_the_reference_are_honoured() -> None:
    T = wander(50)
    reference = replace(kitti_form(T[5:25]), frame_indices=np.arange(5, 25))
    mode, rows, reference_rows = associate(timed(T), reference)
    assert mode == "frame"
    np.testing.assert_array_equal(rows, np.arange(5, 25))
    np.testing.assert_array_equal(reference_rows, np.arange(20))


def test_no_common_frame_is_an_error() -> None:
    T = wander(10)
    with pytest.raises(
        EvaluationError, match="estimate has frames 100 to 109, the reference 0 to 9"
    ):
        evaluate(replace(timed(T), frame_indices=np.arange(100, 110)), kitti_form(T))


def test_an_estimate_without_times_needs_as_many_poses_as_a_timed_reference() -> None:
    T = wander(10)
    assert evaluate(kitti_form(T), timed(T)).association == "frame"
    with pytest.raises(
        EvaluationError, match="9 poses without times and the reference 10 poses with times"
    ):
        evaluate(kitti_form(T[:9]), timed(T))


@pytest.mark.parametrize("empty", ["estimate", "reference"])
def test_nothing_to_compare_is_an_error(empty: Literal["estimate", "reference"]) -> None:
    T = wander(5)
    pair = (timed(T[:0]), timed(T)) if empty == "estimate" else (timed(T), timed(T[:0]))
    with pytest.raises(EvaluationError, match="cannot compare"):
        evaluate(*pair)


# Frames


@pytest.mark.parametrize(("own", "other"), [("imu", "cam0"), ("cam0", "imu")])
def test_lever_arm_does_not_enter_the_error(own: BodyFrame, other: BodyFrame) -> None:
    truth = timed(wander(60), body=other)
    estimate = truth.in_imu(T_CAM0_IMU) if own == "imu" else truth.in_cam0(T_CAM0_IMU)
    found = evaluate(estimate, truth, align="first", T_cam0_imu=T_CAM0_IMU)
    assert found.body == found.aligned.body == other
    assert found.ate_m.max < 1e-12
    assert found.ate_deg.max < 1e-6
    with pytest.raises(
        EvaluationError, match=f"describes {own} and the reference {other}; give the extrinsic"
    ):
        evaluate(estimate, truth)
    with pytest.raises(EvaluationError, match="finite 4x4"):
        evaluate(estimate, truth, T_cam0_imu=np.eye(3))
    leaked = evaluate(replace(estimate, body=other), truth)
    assert leaked.ate_m.max > 0.01


# References of other recordings


def test_notes_of_the_right_reference_are_empty() -> None:
    T = wander(100)
    assert evaluate(timed(drift(T)), timed(T)).notes == ()
    assert (
        evaluate(
            timed(T), Trajectory(T[10:90:10], 100_000_000 * np.arange(10, 90, 10), "cam0")
        ).notes
        == ()
    )
    numbered = replace(timed(T[:20]), frame_indices=np.arange(20))
    assert evaluate(numbered, kitti_form(T[:20])).notes == ()
    assert evaluate(numbered, kitti_form(T).numbered()).notes == ()
    small = se3_from_parts(T[:, :3, :3], 1e-3 * T[:, :3, 3])
    assert evaluate(timed(small), timed(se3_from_parts(T[:, :3, :3], np.ones(3)))).notes == ()


def test_reference_of_another_path_length_is_noted() -> None:
    T = wander(100)
    fast = wander(300, seed=3, step_m=2.0)
    note = evaluate(timed(T), kitti_form(fast)).as_dict()["notes"][0]
    assert re.fullmatch(
        r"over the same poses the estimate travels 9\d\.\d m and the reference 1\d\d\.\d m; is .*",
        note,
    )
    large = se3_from_parts(T[:, :3, :3], 2 * T[:, :3, 3])
    # the scale is known to be open
    assert evaluate(kitti_form(large), kitti_form(T), align="sim3").notes == ()


@pytest.mark.parametrize(("factor", "unit"), [(1000, "millimetres"), (100, "centimetres")])
def test_a_reference_in_another_unit_is_named(factor: float, unit: str) -> None:
    T = wander(100)
    large = se3_from_parts(T[:, :3, :3], factor * T[:, :3, 3])
    assert (
        evaluate(timed(drift(T)), timed(large))
        .notes[0]
        .endswith(f"; the reference seems to be in {unit}")
    )
    assert (
        evaluate(timed(large), timed(T)).notes[0].endswith(f"; the estimate seems to be in {unit}")
    )


def test_reference_that_hardly_matches_is_noted() -> None:
    T = wander(100)
    found = evaluate(timed(T), timed(T, start_ns=7_000_000_000))
    assert any(
        note.startswith("only 30 poses match, of 100 of the estimate and 100")
        for note in found.notes
    )


def test_conventions_of_a_references_orientations_are_named() -> None:
    """Positions agree, whatever the orientations mean, so that the alignment does not show it."""
    T = wander(200)
    R, p, estimate = T[:, :3, :3], T[:, :3, 3], timed(drift(T, sigma=0.001))
    turned, upside, tilted = (
        so3_exp(np.radians(v)) for v in ([0, 0, 90], [180, 0, 0], [0, 35, 10])
    )
    w_first = quat_xyzw_from_rotation(R)[:, [3, 0, 1, 2]]
    for other, words in (
        (
            R @ turned,
            r"differ by (8|9)\d deg .*its x, y, z are the estimate's \+y -x \+z\): .* body with "
            r"other axes",
        ),
        (R @ upside, r"differ by 1(79|80) deg .* \+x -y -z\)"),
        (R @ tilted, r"differ by 3\d deg .* -3\d -\d+ deg about x y z\)"),
        (turned @ R, "in a world with other axes than its positions"),
        (np.swapaxes(R, 1, 2), r"inverse \(body from world\)"),
        (rotation_from_quat_xyzw(w_first), "quaternions with w first"),
        (np.tile(np.eye(3), (len(R), 1, 1)), "never change; its orientations are placeholders"),
        (
            so3_exp(np.random.default_rng(0).normal(0, 2, (len(R), 3))),
            "no exchange of axes explains it",
        ),
    ):
        found = evaluate(estimate, timed(se3_from_parts(other, p)))
        assert found.ate_m.rmse < 0.5
        (note,) = found.notes
        assert re.search(words, note), note
        explained = "no exchange" not in words
        assert (
            "attitude, RPE and drift, which use them, say nothing of the error" in note
        ) == explained


def test_a_rotation_that_straight_paths_leave_open_is_no_convention() -> None:
    """With noise about a straight path, positions determine the rotation about it to tens of
    degrees only.
    """
    n, rng = 200, np.random.default_rng(0)
    p = np.stack([np.zeros(n), np.zeros(n), 0.1 * np.arange(n)], axis=1)
    truth = se3_from_parts(np.tile(np.eye(3), (n, 1, 1)), p + rng.normal(0, 0.02, (n, 3)))
    # not better about the path than the positions
    wobble = so3_exp(rng.normal(0, [0.02, 0.02, 0.3], (n, 3)))
    estimate = se3_from_parts(wobble, p + rng.normal(0, 0.02, (n, 3)))
    found = evaluate(timed(estimate), timed(truth))
    assert found.ate_deg.median > 90
    assert found.notes == ()


# The record


def test_as_dict_is_json_with_null_where_undefined() -> None:
    T = wander(5)
    scores = json.loads(
        json.dumps(evaluate(timed(T), timed(T), lengths_m=(100,)).as_dict(), allow_nan=False)
    )
    assert scores["ate_m"] == pytest.approx(0, abs=1e-12)
    assert scores["t_err_percent"] is None
    assert scores["r_err_deg_per_100m"] is None
    assert scores["rpe_distance"] is None
    assert scores["rpe"]["pairs"] == 4
    single = json.loads(json.dumps(evaluate(timed(T[:1]), timed(T[:1])).as_dict(), allow_nan=False))
    assert single["rpe"] is None
    assert single["coverage"] == {"estimate": 1.0, "reference_span": None, "longest_gap_s": None}
    T = wander(200)
    scores = json.loads(
        json.dumps(evaluate(timed(drift(T)), timed(T), rpe_delta_m=5.0).as_dict(), allow_nan=False)
    )
    assert scores["t_err_percent"] > 0
    assert scores["kitti_per_length"][0]["length_m"] == 100
    assert scores["rpe_distance"]["unit"] == "m"


def test_series_match_the_statistics_and_the_rows() -> None:
    T = wander(50)
    found = evaluate(timed(drift(T, sigma=0.001)), timed(T[10:40], start_ns=1_000_000_000))
    assert found.rotation_from == "positions"
    assert found.errors_m.shape == found.errors_deg.shape == found.rows.shape == (30,)
    assert len(found.aligned) == 50
    assert len(found.reference) == 30
    distance = np.linalg.norm(
        found.aligned.positions[found.rows] - found.reference.positions, axis=1
    )
    np.testing.assert_allclose(found.errors_m, distance)
    assert found.ate_m.rmse == pytest.approx(np.sqrt(np.mean(distance**2)))
    assert found.ate_m.max == pytest.approx(distance.max())


def test_inputs_are_not_modified() -> None:
    T_ref = wander(30)
    estimate, reference = timed(drift(T_ref)), timed(T_ref)
    before = estimate.T_world_body.copy(), reference.T_world_body.copy()
    evaluate(estimate, reference, align="sim3", rpe_delta_m=3.0)
    np.testing.assert_array_equal(estimate.T_world_body, before[0])
    np.testing.assert_array_equal(reference.T_world_body, before[1])


@pytest.mark.parametrize("which", ["estimate", "reference"])
def test_non_finite_poses_are_named(which: str) -> None:
    T = wander(10)
    broken = T.copy()
    broken[7:, 1, 3] = np.nan
    pair = (timed(broken), timed(T)) if which == "estimate" else (timed(T), timed(broken))
    with pytest.raises(
        EvaluationError, match=rf"pose 7 of the {which} is not finite \(3 of 10 are not\)"
    ):
        evaluate(*pair)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"align": "affine"}, "unknown alignment 'affine'; choose one of se3, sim3, first, none"),
        ({"max_time_difference_s": -1.0}, "largest time difference"),
        ({"max_time_difference_s": float("nan")}, "largest time difference"),
        ({"rpe_delta_frames": 0}, "at least 1 frame"),
        ({"rpe_delta_m": 0.0}, "must be positive"),
        ({"lengths_m": (-5.0,)}, "must be positive"),
    ],
)
def test_rejects_invalid_options(options: dict[str, Any], match: str) -> None:
    T = wander(10)
    with pytest.raises(EvaluationError, match=match):
        evaluate(timed(T), timed(T), **options)


# Relative error and small functions


def test_relative_error_of_a_known_step_error() -> None:
    T_ref, T_est = straight(11), straight(11, 1.5)
    one, four = relative_error_frames(T_est, T_ref, 1), relative_error_frames(T_est, T_ref, 4)
    assert (one.pairs, four.pairs) == (10, 7)
    assert one.trans_rmse_m == pytest.approx(0.5)
    assert four.trans_rmse_m == pytest.approx(2.0)
    assert relative_error_frames(T_est, T_ref, 11) is None


def test_relative_error_over_a_distance_on_uneven_steps_and_stops() -> None:
    T_ref = np.tile(np.eye(4), (7, 1, 1))
    T_ref[:, 0, 3] = [0, 0, 1.0, 2.05, 2.05, 4.0, 4.1]
    T_est = T_ref.copy()
    T_est[3:, 1, 3] = 1.0  # a jump of 1 m between poses 2 and 3
    # Of delta 2 m, within 0.2 m: 0-3, 1-3, 3-5, 4-5; pose 2 has 2.05 - 1 = 1.05 m and 3 m, neither
    # close.
    found = relative_error_distance(T_est, T_ref, 2.0)
    assert found.pairs == 4
    assert found.trans_rmse_m == pytest.approx(np.sqrt(2 / 4))
    assert relative_error_distance(T_est, T_ref, 50.0) is None
    assert relative_error_distance(T_est[:1], T_ref[:1], 1.0) is None


def test_path_length_and_rotation_angle() -> None:
    assert path_length_m([[0, 0, 0], [3, 4, 0], [3, 4, 12]]) == 17.0
    assert path_length_m(np.zeros((1, 3))) == 0.0
    angles = np.array([0.0, 1e-9, 1.0, 90.0, 179.9999, 180.0])
    found = rotation_angle_deg(so3_exp(np.radians(angles)[:, None] * [0, 0.6, 0.8]))
    np.testing.assert_allclose(found, angles, atol=1e-13)


# NEES


def test_nees_equals_the_quadratic_form_with_the_inverse() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(20, 6, 6))
    P, e = A @ A.transpose(0, 2, 1) + np.eye(6), rng.normal(size=(20, 6))
    np.testing.assert_allclose(
        nees(e, P), np.einsum("ni,nij,nj->n", e, np.linalg.inv(P), e), rtol=1e-10
    )
    assert nees([[2.0, 0.0]], [np.diag([4.0, 1.0])])[0] == pytest.approx(1.0)
    assert nees(np.zeros((0, 3)), np.zeros((0, 3, 3))).shape == (0,)


def test_nees_of_a_consistent_estimate_is_within_bounds() -> None:
    rng = np.random.default_rng(1)
    P = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.3], [0.0, 0.3, 4.0]])
    e = rng.multivariate_normal(np.zeros(3), P, size=400)
    low, high = nees_bounds(3, 400)
    assert low < nees(e, np.tile(P, (400, 1, 1))).mean() < high
    assert not low < nees(1.3 * e, np.tile(P, (400, 1, 1))).mean() < high


@pytest.mark.parametrize(("d", "runs"), [(1, 1), (6, 50), (3, 1000), (15, 2)])
def test_nees_bounds_are_quantiles_of_chi_square(d: int, runs: int) -> None:
    expected = stats.chi2.ppf([0.025, 0.975], d * runs) / runs
    np.testing.assert_allclose(nees_bounds(d, runs), expected, rtol=1e-9)


@pytest.mark.parametrize(
    ("errors", "covariances", "match"),
    [
        (
            np.zeros((2, 2)),
            np.stack([np.eye(2), np.diag([1.0, -1.0])]),
            "covariance 1 is not positive definite",
        ),
        (np.zeros((2, 2)), np.zeros((2, 3, 3)), "needs errors"),
        (np.zeros(2), np.eye(2), "needs errors"),
        (np.full((1, 2), np.nan), np.eye(2)[None], "not finite"),
    ],
)
def test_rejects_invalid_nees_arguments(
    errors: FloatArray, covariances: FloatArray, match: str
) -> None:
    with pytest.raises(EvaluationError, match=match):
        nees(errors, covariances)


def test_separates_a_scale_error_from_the_rest() -> None:
    rng = np.random.default_rng(3)
    T = np.array([se3_exp(rng.normal(0, 0.5, 6)) for _ in range(40)])
    longer = T.copy()
    longer[:, :3, 3] *= 1.05
    score = evaluate(timed(longer), timed(T))
    assert score.scale_free.scale == pytest.approx(1.05, abs=1e-9)
    assert score.scale_free.ate_m < 1e-9 < 1e-3 < score.ate_m.rmse
    assert score.as_dict()["scale_free"]["scale"] == score.scale_free.scale


def test_no_scale_without_motion_or_with_two_poses() -> None:
    still = np.tile(np.eye(4), (5, 1, 1))
    assert evaluate(timed(still), timed(still)).scale_free is None
    two = np.array([np.eye(4), se3_exp(np.array([1.0, 0, 0, 0, 0, 0]))])
    assert evaluate(timed(two), timed(two)).scale_free is None


def test_notes_an_estimate_with_few_references() -> None:
    T = np.array([se3_exp(np.array([0.1 * k, 0, 0, 0, 0, 0])) for k in range(60)])
    score = evaluate(timed(T), timed(T[:10]))
    assert any("covers 15 % of the estimate" in note for note in score.notes)


def test_lengths_that_are_compared_have_one_unit() -> None:
    assert metres_texts(0.00888, 0.319, 1.5) == ["8.88 mm", "319 mm", "1500 mm"]
    assert metres_texts(0.0123, 0.319) == ["0.012 m", "0.319 m"]
    assert metres_texts() == []
