"""RANSAC on the camera motion, with depth and without: robust to outliers and to large moving
objects.
"""

from __future__ import annotations

import numpy as np
import pytest

from vio.frontend import outliers
from vio.frontend.outliers import (
    MotionPriors,
    RansacProblem,
    bearing_consensus,
    epipolar_distance,
    pixel_errors,
    rigid_consensus,
    static_tracks,
)
from vio.geometry.lie import FloatArray, se3_exp, se3_log, transform_points
from vio.geometry.stereo import StereoCamera, project

CAMERA = StereoCamera(fu=720.0, fv=720.0, cu=610.0, cv=170.0, baseline_m=0.54)
LIMIT_PX = 1.0
# a car driving 1.1 m forward and turning
T_TRUE = se3_exp([0.05, -0.02, -1.1, 0.004, -0.02, 0.003])


def make_problem(seed: int = 0) -> RansacProblem:
    return RansacProblem(CAMERA, LIMIT_PX, np.random.default_rng(seed))


def scene(n: int, seed: int, depth: tuple[float, float] = (5.0, 40.0)) -> FloatArray:
    """Points (n, 3) in front of the camera."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(*depth, n)
    return np.stack([rng.uniform(-0.7, 0.7, n) * z, rng.uniform(-0.2, 0.2, n) * z, z], axis=1)


def pixels(T: FloatArray, p: FloatArray, seed: int, noise: float = 0.2) -> FloatArray:
    """Noisy left pixels (n, 2) of moved points."""
    noise_px = noise * np.random.default_rng(seed).standard_normal((len(p), 2))
    return project(CAMERA, transform_points(T, p))[:, :2] + noise_px


@pytest.mark.parametrize("share", [0.0, 0.3, 0.5])
def test_ransac_separates_outliers_from_inliers(share: float) -> None:
    p = scene(300, 1)
    uv = pixels(T_TRUE, p, 2)
    bad = np.arange(300) < 300 * share
    uv[bad] += (
        np.random.default_rng(3).choice([-1, 1], (bad.sum(), 2))
        * np.linspace(8, 60, bad.sum())[:, None]
    )
    found = rigid_consensus(make_problem(), p, uv, np.eye(4), None, None)
    assert not found.inliers[bad].any()
    assert found.inliers[~bad].mean() > 0.99
    error = se3_log(found.T_curr_prev @ np.linalg.inv(T_TRUE))
    assert np.linalg.norm(error[:3]) < 0.02
    assert np.linalg.norm(error[3:]) < 5e-4


def test_same_seed_gives_identical_consensus() -> None:
    p = scene(200, 4)
    uv = pixels(T_TRUE, p, 5, noise=1.0)
    a, b = (rigid_consensus(make_problem(7), p, uv, np.eye(4), None, None) for _ in range(2))
    np.testing.assert_array_equal(a.T_curr_prev, b.T_curr_prev)
    np.testing.assert_array_equal(a.inliers, b.inliers)


def test_standstill_gives_zero_motion() -> None:
    p = scene(100, 6)
    found = rigid_consensus(make_problem(), p, pixels(np.eye(4), p, 7), T_TRUE, None, None)
    assert np.linalg.norm(se3_log(found.T_curr_prev)) < 0.02
    assert found.inliers.all()


@pytest.mark.parametrize("n", [0, 1, 7])
def test_too_few_points_give_no_consensus(n: int) -> None:
    p = scene(n, 8)
    assert rigid_consensus(make_problem(), p, pixels(T_TRUE, p, 9), np.eye(4), None, None) is None


def test_scattered_pixels_give_no_consensus() -> None:
    p = scene(100, 10)
    uv = np.random.default_rng(11).uniform([0, 0], [1242, 375], (100, 2))
    assert rigid_consensus(make_problem(), p, uv, np.eye(4), None, None) is None


def crossing_truck() -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Points, pixels and the mask of the truck: 65 % of the points, crossing in front of a
    stationary camera.
    """
    wall, truck = scene(70, 12, (15.0, 40.0)), scene(130, 13, (7.0, 8.0))
    uv = np.concatenate(
        [pixels(np.eye(4), wall, 14), pixels(se3_exp([0.8, 0.0, 0.0, 0.0, 0.0, 0.0]), truck, 15)],
    )
    return np.concatenate([wall, truck]), uv, np.arange(200) >= 70


def test_crossing_truck_wins_consensus_without_prior() -> None:
    """Control for the next test, which would be trivial otherwise."""
    p, uv, truck = crossing_truck()
    found = rigid_consensus(make_problem(), p, uv, np.eye(4), None, None)
    assert found.inliers[truck].mean() > 0.9


def turning_truck() -> tuple[FloatArray, FloatArray, np.ndarray]:
    """As above, but the truck also turns, so that its apparent motion is a wrong camera
    rotation.
    """
    p, uv, truck = crossing_truck()
    uv[truck] = pixels(se3_exp([0.8, 0.0, 0.0, 0.0, 0.1, 0.0]), p[truck], 16)
    return p, uv, truck


@pytest.mark.parametrize("predicted", ["rotation", "motion", "both"])
@pytest.mark.parametrize("turning", [False, True])
def test_prior_rejects_crossing_truck(turning: bool, predicted: str) -> None:
    p, uv, truck = turning_truck() if turning else crossing_truck()
    R_prior = None if predicted == "motion" else np.eye(3)
    T_prior = None if predicted == "rotation" else se3_exp([0.05, 0.0, -0.1, 0.0, 0.002, 0.0])
    found = rigid_consensus(make_problem(), p, uv, np.eye(4), R_prior, T_prior)
    if predicted == "rotation" and not turning:
        # A prior rotation cannot reject a truck that only translates; known limit.
        assert found.inliers[truck].mean() > 0.9
        return
    assert found.inliers[~truck].mean() > 0.95
    assert not found.inliers[truck].any()
    assert np.linalg.norm(se3_log(found.T_curr_prev)) < 0.05


def test_wrong_prior_rotation_does_not_override_consensus() -> None:
    p = scene(200, 17)
    wrong = se3_exp([0.0, 0.0, 0.0, 0.0, 0.1, 0.0])[:3, :3]
    found = rigid_consensus(make_problem(), p, pixels(T_TRUE, p, 18), np.eye(4), wrong, None)
    assert found.inliers.mean() > 0.99


def test_wrong_prior_motion_does_not_override_consensus() -> None:
    p = scene(200, 17)
    wrong = se3_exp([0.5, 0.0, 0.0, 0.0, 0.1, 0.0])
    uv = pixels(T_TRUE, p, 18)
    found = rigid_consensus(make_problem(), p, uv, np.eye(4), None, wrong)
    assert found.inliers.mean() > 0.99


def test_prior_rejects_truck_that_turns_the_other_way() -> None:
    """The camera turns by 3 degrees one way, the truck's points by 3 degrees the other way."""
    wall, truck = scene(70, 12, (15.0, 40.0)), scene(130, 13, (7.0, 8.0))
    T_wall, T_truck = (
        se3_exp([x, 0.0, 0.0, 0.0, turn, 0.0]) for x, turn in ((0.0, -0.05), (0.8, 0.05))
    )
    uv = np.concatenate([pixels(T_wall, wall, 14), pixels(T_truck, truck, 15)])
    found = rigid_consensus(
        make_problem(), np.concatenate([wall, truck]), uv, np.eye(4), T_wall[:3, :3], None
    )
    assert found.inliers[:70].mean() > 0.95
    assert not found.inliers[70:].any()


def test_wrong_rotation_that_shares_the_inliers_does_not_override_consensus() -> None:
    """Half of the static points are at one depth, where translation resembles rotation; many
    others are outliers.
    """
    rng = np.random.default_rng(0)
    board = np.stack(
        [rng.uniform(-0.6, 0.6, 70), rng.uniform(-0.5, 0.5, 70), rng.uniform(7.9, 8.1, 70)], axis=1
    )
    p = np.concatenate([board, scene(60, 100, (15.0, 60.0)), scene(80, 200)])
    uv = pixels(T_TRUE, p, 0)
    uv[130:] += rng.choice([-1, 1], (80, 2)) * rng.uniform(20, 80, (80, 2))
    wrong = se3_exp([0.0, 0.0, 0.0, 0.0, np.radians(2.0), 0.0])[:3, :3] @ T_TRUE[:3, :3]
    found = rigid_consensus(make_problem(), p, uv, np.eye(4), wrong, None)
    assert found.inliers[:130].mean() > 0.98
    assert np.linalg.norm(se3_log(found.T_curr_prev @ np.linalg.inv(T_TRUE))) < 0.02


def test_points_behind_the_camera_have_infinite_error() -> None:
    behind = se3_exp([0.0, 0.0, -50.0, 0.0, 0.0, 0.0])
    p = scene(5, 19)
    assert np.isinf(pixel_errors(CAMERA, behind, p, np.zeros((5, 2)))).all()


@pytest.mark.parametrize("turn", [0.0, 1.0, 2.5])
def test_fit_converges_near_its_start_at_any_rotation(turn: float) -> None:
    T = se3_exp([0.5, -0.3, 0.8, 0.2 * turn, turn, -0.3 * turn])
    after = scene(60, 30)
    start = se3_exp([0.1, 0.05, -0.1, 0.02, -0.05, 0.03]) @ T
    before, seen, free = (
        transform_points(np.linalg.inv(T), after),
        project(CAMERA, after)[:, :2],
        slice(0, 6),
    )
    near = outliers._gauss_newton(
        CAMERA, start[None], before[None], seen[None], np.ones((1, 60)), steps=5, free=free
    )
    found = outliers._refine(CAMERA, near[0], before, seen, LIMIT_PX, free)
    np.testing.assert_allclose(found, T, atol=1e-6)


def test_epipolar_distance_is_zero_at_any_allowed_depth_and_grows_across_the_line() -> None:
    p = scene(100, 22)
    before, after = project(CAMERA, p)[:, :2], pixels(T_TRUE, p, 0, noise=0.0)
    distance = epipolar_distance(CAMERA, T_TRUE, before, after, near_m=3.0)
    np.testing.assert_allclose(distance, 0.0, atol=1e-6)
    along = after - project(CAMERA, p @ T_TRUE[:3, :3].T)[:, :2]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(
        along, axis=1, keepdims=True
    )
    shifted = epipolar_distance(CAMERA, T_TRUE, before, after + 5 * across, near_m=3.0)
    np.testing.assert_allclose(shifted, 5.0, atol=1e-6)


@pytest.mark.parametrize("forward_m", [0.5, 2.0, 3.5])
def test_epipolar_distance_is_zero_where_the_camera_passes_the_nearest_depth(
    forward_m: float,
) -> None:
    """As at 35 m/s and 10 images a second: what was nearer than the way is not seen any more."""
    p = scene(100, 22)
    T = se3_exp([0.06, 0.02, -forward_m, 0.002, 0.01, 0.001])
    p = p[transform_points(T, p)[:, 2] > 0.3]
    assert len(p) > 50
    before, after = project(CAMERA, p)[:, :2], pixels(T, p, 0, noise=0.0)
    distance = epipolar_distance(CAMERA, T, before, after, near_m=0.5)
    np.testing.assert_allclose(distance, 0.0, atol=1e-6)
    off = epipolar_distance(CAMERA, T, before, before, near_m=0.5)
    assert np.median(off) > 2.0  # control: what moves with the camera is off the line


def test_epipolar_distance_at_standstill_is_the_pixel_distance() -> None:
    before = scene(20, 23)[:, :2] + 100
    distance = epipolar_distance(
        CAMERA, np.eye(4), before, before + np.array([3.0, 4.0]), near_m=3.0
    )
    np.testing.assert_allclose(distance, 5.0)


# --- two views, no depth
# ----------------------------------------------------------------------------------------------

MOTIONS = {
    "driving": T_TRUE,
    "turning hard": se3_exp([0.1, 0.0, -0.3, 0.0, 0.2, 0.05]),
    "sideways": se3_exp([0.3, 0.0, 0.0, 0.0, 0.002, 0.0]),
    "hardly moving": se3_exp([0.01, 0.0, -0.02, 0.0, 0.0, 0.0]),
    "standing": np.eye(4),
    "only turning": se3_exp([0.0, 0.0, 0.0, 0.01, 0.05, 0.02]),
}


def turned(T: FloatArray, degrees: float) -> FloatArray:
    """The rotation (3, 3) of a motion, wrong by an angle about the vertical."""
    return se3_exp([0.0, 0.0, 0.0, 0.0, np.radians(degrees), 0.0])[:3, :3] @ T[:3, :3]


def two_views(
    T: FloatArray, seed: int, share: float, noise: float = 0.2
) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Noisy pixels in two frames, and the mask of outliers, 8 to 60 px off in all directions."""
    p = scene(300, seed)
    before, after = pixels(np.eye(4), p, seed + 100, noise), pixels(T, p, seed + 200, noise)
    bad = np.arange(300) < 300 * share
    rng = np.random.default_rng(seed + 300)
    angle, length = rng.uniform(0, 2 * np.pi, bad.sum()), rng.uniform(8, 60, bad.sum())
    after[bad] += length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return before, after, bad


def agreeing(
    before: FloatArray, after: FloatArray, R_prior: FloatArray | None, seed: int = 0
) -> np.ndarray | None:
    return bearing_consensus(make_problem(seed), before, after, np.eye(3), R_prior)


@pytest.mark.parametrize("prior_error_deg", [None, 0.0, 1.0, 5.0])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.45])
@pytest.mark.parametrize("name", MOTIONS)
def test_two_views_reject_outliers_and_keep_inliers(
    name: str, share: float, prior_error_deg: float | None
) -> None:
    """Holds without parallax and with a wrong prior rotation, too.

    An outlier on its epipolar ray cannot be detected: 16 of 360 degrees at 8 px, fewer at larger
    errors.
    """
    R_prior = None if prior_error_deg is None else turned(MOTIONS[name], prior_error_deg)
    good, missed = [], []
    for seed in range(2):
        before, after, bad = two_views(MOTIONS[name], seed, share)
        kept = agreeing(before, after, R_prior)
        good.append(kept[~bad].mean())
        missed.append(kept[bad].mean() if share else 0.0)
    assert min(good) > 0.97
    assert np.mean(missed) < 0.1


def test_known_rotation_needs_two_tracks_for_the_direction(monkeypatch: pytest.MonkeyPatch) -> None:
    """With known rotation, 12 pairs of tracks give the direction among 45 % outliers."""
    before, after, bad = two_views(T_TRUE, 5, 0.45)
    monkeypatch.setattr(outliers, "_RANSAC", outliers._RANSAC._replace(samples=12))
    kept = bearing_consensus(make_problem(), before, after, np.eye(3), T_TRUE[:3, :3])
    assert kept[~bad].mean() > 0.97
    assert kept[bad].mean() < 0.1


def test_two_views_are_deterministic() -> None:
    before, after, _ = two_views(T_TRUE, 6, 0.3, noise=0.6)
    for R_prior in (None, T_TRUE[:3, :3], turned(T_TRUE, 5.0)):
        a, b = (agreeing(before, after, R_prior) for _ in range(2))
        assert a is not None
        assert b is not None
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("n", [0, 1, 7])
def test_two_views_of_too_few_tracks_give_no_consensus(n: int) -> None:
    before, after, _ = two_views(T_TRUE, 7, 0.0)
    assert agreeing(before[:n], after[:n], None) is None


def test_scattered_pixels_in_two_views_give_no_consensus() -> None:
    rng = np.random.default_rng(8)
    before, after = rng.uniform([0, 0], [1242, 375], (2, 200, 2))
    assert agreeing(before, after, None) is None
    assert agreeing(before, after, np.eye(3)) is None


def test_two_views_of_identical_pixels_do_not_fail() -> None:
    same = np.tile([[300.0, 200.0]], (20, 1))
    kept = agreeing(same, same, None)
    assert kept is None or kept.all()


@pytest.mark.parametrize("with_prior", [False, True])
def test_prior_rotation_rejects_turning_truck_in_two_views(with_prior: bool) -> None:
    """The truck wins the two-view consensus unless a rotation is predicted.

    The camera is stationary, so its direction of translation is arbitrary and part of the truck is
    on epipolar rays.
    """
    p, after, truck = turning_truck()
    kept = agreeing(project(CAMERA, p)[:, :2], after, np.eye(3) if with_prior else None)
    assert kept is not None
    if with_prior:
        assert kept[~truck].mean() > 0.95
        assert kept[truck].mean() < 0.5
    else:
        assert kept[~truck].mean() < 0.5
        assert kept[truck].mean() > 0.9


# --- depth and two views
# ----------------------------------------------------------------------------------------------


def test_static_tracks_use_depth_or_fall_back_to_two_views() -> None:
    """With enough depth, tracks without depth are all kept; otherwise two views reject moving
    tracks.
    """
    before, after, bad = two_views(T_TRUE, 9, 0.3)
    p = scene(300, 9)
    deep = np.arange(300) % 2 == 0
    kept, motion = static_tracks(make_problem(), before, p, deep, after, np.eye(4), MotionPriors())
    np.testing.assert_array_equal(kept[deep], motion.inliers)
    assert not kept[deep & bad].any()
    assert kept[~deep].all()
    few = np.arange(300) < 5
    kept, motion = static_tracks(make_problem(), before, p, few, after, np.eye(4), MotionPriors())
    assert motion is None
    assert kept[bad].mean() < 0.15
    assert kept[~bad].mean() > 0.97
    kept, motion = static_tracks(
        make_problem(), before[:5], p[:5], few[:5], after[:5], np.eye(4), MotionPriors()
    )
    assert motion is None
    assert kept.all()  # too few for a consensus: nothing is dropped


@pytest.mark.parametrize(("inliers", "is_sampled"), [(0.73, False), (0.65, True)])
def test_a_motion_that_most_points_follow_is_not_searched_further(
    inliers: float, is_sampled: bool
) -> None:
    """Minimal sets cost more than they find beside a start that seven in ten points follow."""
    p = scene(200, 5)
    uv = pixels(T_TRUE, p, 6)
    wrong = np.arange(200) >= round(inliers * 200)
    uv[wrong] += np.random.default_rng(7).uniform(20.0, 60.0, (int(wrong.sum()), 2))
    problem = make_problem()
    before = problem.rng.bit_generator.state
    found = rigid_consensus(problem, p, uv, T_TRUE, None, None)
    assert found is not None
    assert found.inliers.mean() == pytest.approx(inliers, abs=0.01)
    assert (problem.rng.bit_generator.state != before) == is_sampled
