"""The optimum of a pose graph: Jacobians, exact recovery, false loops, gravity, and consistency
of the result.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from tests.jacobians import numeric_jacobian, right_retract
from vio.geometry.lie import (
    FloatArray,
    nearest_rotation,
    se3_adjoint,
    se3_exp,
    se3_from_parts,
    se3_inverse,
    se3_log,
)
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera, project
from vio.mapping.builder import Keyframe, MapBuilder, agree
from vio.mapping.features import KeyframeFeatures
from vio.mapping.loop_geometry import Verified, pose_of_most
from vio.mapping.map_graph import MapGraph, _nearest
from vio.mapping.map_store import KeyframeRow, LoopRow, MapStore, SessionRow
from vio.mapping.place_finder import FoundPlace, PlaceFinder
from vio.mapping.pose_graph import (
    Edges,
    UpDirections,
    marginals,
    optimise,
    r_D_poses,
    residual,
    up_residual,
)
from vio.records import LoopMatches

COUNT = 60
SIGMA = np.repeat([0.02, 0.004], 3)  # of a step of the odometry, m and rad
LOOP_SIGMA = np.repeat([0.01, 0.002], 3)
RNG = np.random.default_rng
CAMERA = StereoCamera(400.0, 400.0, 320.0, 180.0, 0.1, 640, 360)
ROUND, ROUNDS = 100, 3  # keyframes of a round of a circle of 50 m, and rounds
NO_MATCHES = LoopMatches(*(np.zeros((0, 4)),) * 2, *(np.zeros(0, np.bool_),) * 2)
NOTHING = KeyframeFeatures(
    np.zeros((0, 4)), np.zeros(0, np.bool_), np.zeros(0), np.zeros((0, 32), np.uint8)
)
# as without an IMU
NO_UP_DIRECTIONS = UpDirections(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros(0))


def _circle() -> FloatArray:
    """Poses (K, 4, 4) once around a circle and a tenth of it again."""
    angle = np.linspace(0, 2.2 * np.pi, COUNT)
    T = np.broadcast_to(np.eye(4), (COUNT, 4, 4)).copy()
    T[:] = se3_exp(np.stack([0 * angle, 0 * angle, 0 * angle, 0 * angle, 0 * angle, angle], axis=1))
    T[:, :3, 3] = np.stack([10 * np.sin(angle), 10 - 10 * np.cos(angle), 0 * angle], axis=1)
    return T


def _rounds() -> FloatArray:
    """Poses (K, 4, 4) three times around a circle."""
    angle = 2 * np.pi * np.arange(ROUNDS * ROUND) / ROUND
    T = se3_exp(np.stack([*(0 * angle for _ in range(5)), angle], axis=1))
    T[:, :3, 3] = np.stack([50 * np.sin(angle), 50 - 50 * np.cos(angle), 0 * angle], axis=1)
    return T


def _measured(
    T: FloatArray, i: int, j: int, sigma: FloatArray, rng: np.random.Generator
) -> RelativePose:
    noise = se3_exp(sigma * rng.standard_normal(6))
    return RelativePose(se3_inverse(T[i]) @ T[j] @ noise, np.diag(sigma**2))


def _problem(seed: int, false_loops: int = 0) -> tuple[FloatArray, FloatArray, Edges, Edges]:
    """Truth, start by odometry, odometry and loops; the last `false_loops` loops are wrong by
    metres.
    """
    rng, T = RNG(seed), _circle()
    odometry = [(k, k + 1, _measured(T, k, k + 1, SIGMA, rng)) for k in range(COUNT - 1)]
    start = [T[0]]
    for _, _, motion in odometry:
        start.append(start[-1] @ motion.T_i_j)
    period = round((COUNT - 1) / 1.1)
    loops = [
        (k, k + period, _measured(T, k, k + period, LOOP_SIGMA, rng)) for k in range(COUNT - period)
    ]
    for _ in range(false_loops):
        i, j = sorted(rng.choice(COUNT, 2, replace=False).tolist())
        wrong = se3_exp(np.concatenate([rng.uniform(-5, 5, 3), rng.uniform(-1, 1, 3)]))
        loops.append((i, j, RelativePose(wrong, np.diag(LOOP_SIGMA**2))))
    return T, np.array(start), Edges.of(odometry), Edges.of(loops)


def _fixed() -> np.ndarray:
    return np.arange(COUNT) == 0


def _rmse_m(T: FloatArray, truth: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum((T[:, :3, 3] - truth[:, :3, 3]) ** 2, axis=1))))


def test_jacobians_of_a_motion_agree_with_differences_far_from_the_optimum() -> None:
    rng = RNG(3)
    T = se3_exp(rng.normal(size=(2, 6)))
    edges = Edges.of([(0, 1, RelativePose(se3_exp(0.8 * rng.normal(size=6)), np.eye(6)))])
    A, B = r_D_poses(T, edges, residual(T, edges))
    for number, D in ((0, A), (1, B)):

        def moved(X: FloatArray, number: int = number) -> FloatArray:
            return residual(np.array([X, T[1]] if number == 0 else [T[0], X]), edges)[0]

        np.testing.assert_allclose(
            D[0], numeric_jacobian(moved, T[number], right_retract), atol=1e-7
        )


def test_jacobian_of_the_vertical_agrees_with_differences() -> None:
    T = se3_exp(RNG(4).normal(size=(1, 6)))
    ups = UpDirections(np.array([0]), np.array([[0.0, 0.6, 0.8]]), np.array([0.1]))
    numeric = numeric_jacobian(lambda X: up_residual(X[None], ups)[0][0], T[0], right_retract)
    np.testing.assert_allclose(up_residual(T, ups)[1][0], numeric, atol=1e-8)


def test_loops_take_the_drift_away() -> None:
    T, start, odometry, loops = _problem(1)
    best = optimise(start, odometry, loops, NO_UP_DIRECTIONS, _fixed())
    assert best.kept.all()
    assert _rmse_m(best.T_map_cam, T) < 0.5 * _rmse_m(start, T)
    np.testing.assert_array_equal(best.T_map_cam[0], start[0])


def test_without_loops_the_odometry_is_the_optimum() -> None:
    _, start, odometry, _ = _problem(1)
    best = optimise(start, odometry, Edges.of([]), NO_UP_DIRECTIONS, _fixed())
    np.testing.assert_allclose(best.T_map_cam, start, atol=1e-9)


def test_false_loops_end_without_weight_and_change_nothing() -> None:
    _, start, odometry, loops = _problem(2)
    _, _, _, mixed = _problem(2, false_loops=4)
    clean = optimise(start, odometry, loops, NO_UP_DIRECTIONS, _fixed())
    robust = optimise(start, odometry, mixed, NO_UP_DIRECTIONS, _fixed())
    assert robust.kept[: len(loops)].all()
    assert not robust.kept[len(loops) :].any()
    np.testing.assert_allclose(robust.T_map_cam, clean.T_map_cam, atol=1e-5)


@pytest.mark.parametrize("wrong", [1, 3])
def test_wrong_loops_that_the_odometry_lets_pass_change_little(wrong: int) -> None:
    """Of 15 loops some are off by 0.1 to 0.3 m and a few degrees, which the odometry since does
    not contradict.
    """
    clean, mixed = [], []
    for seed in range(6):
        T, start, odometry, _ = _problem(seed)
        rng, period = RNG([seed, 1]), round((COUNT - 1) / 1.1)
        pairs = [(k, k + period + d) for k in range(1, COUNT - period - 1) for d in (-1, 0, 1)] + [
            (0, period)
        ] * 3
        loops = [(i, j, _measured(T, i, j, LOOP_SIGMA, rng)) for i, j in pairs]
        right = loops[wrong:]
        for n in range(wrong):
            off = rng.normal(size=6) * np.repeat([0.1, 0.03], 3)
            off[:3] *= max(1.0, 0.1 / np.linalg.norm(off[:3]))
            i, j, motion = loops[n]
            loops[n] = i, j, RelativePose(motion.T_i_j @ se3_exp(off), motion.covariance)
        for rows, errors in ((right, clean), (loops, mixed)):
            best = optimise(start, odometry, Edges.of(rows), NO_UP_DIRECTIONS, _fixed())
            errors.append(_rmse_m(best.T_map_cam, T))
        assert best.kept[wrong:].all()
        assert not best.kept[:wrong].any()
    assert np.mean(mixed) < 1.1 * np.mean(clean)


def test_the_error_at_the_optimum_is_that_of_its_covariance() -> None:
    """Chi-square of the last pose, whose covariance is that of odometry and loops: 6 on average."""
    squared = []
    for seed in range(12):
        _, start, odometry, loops = _problem(seed)
        best = optimise(start, odometry, loops, NO_UP_DIRECTIONS, _fixed()).T_map_cam
        r = np.concatenate([residual(best, odometry).ravel(), residual(best, loops).ravel()])
        sigma = np.concatenate([np.tile(SIGMA, len(odometry)), np.tile(LOOP_SIGMA, len(loops))])
        squared.append(float(np.sum((r / sigma) ** 2)))

    dof = 6 * (len(odometry) + len(loops) - (COUNT - 1))
    assert abs(np.mean(squared) - dof) < 4 * np.sqrt(2 * dof / 12)


def test_covariance_in_the_frame_of_all_poses_does_not_depend_on_the_pose_that_is_held() -> None:
    T, _, odometry, loops = _problem(6)
    weights = RNG(1).uniform(size=COUNT)
    held = [np.arange(COUNT) == k for k in (0, 17)]
    poses = np.array([3, 40])
    P, Q = (marginals(T, odometry, loops, NO_UP_DIRECTIONS, h, poses, frame=weights) for h in held)
    np.testing.assert_allclose(P, Q, rtol=1e-6, atol=1e-12)
    alone = marginals(T, odometry, loops, NO_UP_DIRECTIONS, held[0], poses)
    assert np.trace(P[1]) < np.trace(alone[1]), (
        "the first pose is no part of what the frame is uncertain by"
    )


def test_error_in_the_frame_of_all_poses_is_that_of_its_covariance() -> None:
    """Normalised squared errors of the last pose, 6 expected, where the optimum stands as the
    truth does on average.
    """
    weights, last, squared = np.full(COUNT, 1 / COUNT), np.array([COUNT - 1]), []
    for seed in range(20):
        T, start, odometry, loops = _problem(seed)
        best = optimise(start, odometry, loops, NO_UP_DIRECTIONS, _fixed()).T_map_cam
        P = marginals(best, odometry, loops, NO_UP_DIRECTIONS, _fixed(), last, frame=weights)[0]
        p, q = (X[:, :3, 3].mean(axis=0) for X in (T, best))
        M = np.einsum("kia,kja->ij", T[:, :3, :3], best[:, :3, :3])
        R = nearest_rotation(M + (T[:, :3, 3] - p).T @ (best[:, :3, 3] - q))
        xi = se3_log(se3_inverse(T[-1]) @ se3_from_parts(R, p - R @ q) @ best[-1])
        squared.append(float(xi @ np.linalg.solve(P, xi)))
    assert abs(np.mean(squared) - 6) < 3 * np.sqrt(12 / 20)


def test_the_vertical_keeps_the_map_upright() -> None:
    T, start, odometry, loops = _problem(5)
    ups = UpDirections(np.arange(COUNT), T[:, 2, :3], np.full(COUNT, 0.002))
    tilt = [
        np.abs(best.T_map_cam[:, 2, :3] - T[:, 2, :3]).max()
        for best in (
            optimise(start, odometry, loops, given, _fixed()) for given in (NO_UP_DIRECTIONS, ups)
        )
    ]
    assert tilt[1] < 0.3 * tilt[0]
    assert tilt[1] < 0.004


def test_fixed_poses_stay_and_the_others_follow() -> None:
    T, start, odometry, loops = _problem(6)
    fixed = np.arange(COUNT) < COUNT // 2
    start[fixed] = T[fixed]
    best = optimise(start, odometry, loops, NO_UP_DIRECTIONS, fixed)
    np.testing.assert_array_equal(best.T_map_cam[fixed], T[fixed])
    assert np.linalg.norm(se3_log(se3_inverse(best.T_map_cam[-1]) @ T[-1])[:3]) < 0.1


def test_a_tilt_of_the_first_pose_does_not_bend_the_map() -> None:
    """The filter's vertical was 5 mrad off at its first frame, and later ones agree on another."""
    truth = _circle()
    exact = [
        (k, k + 1, RelativePose(se3_inverse(truth[k]) @ truth[k + 1], np.diag(SIGMA**2)))
        for k in range(COUNT - 1)
    ]
    odometry = Edges.of(exact)
    tilt = np.eye(4)
    tilt[:3, :3] = se3_exp([0, 0, 0, 0.003, -0.004, 0.0])[:3, :3]
    start = tilt @ truth
    ups = UpDirections(np.arange(COUNT), truth[:, 2, :3], np.full(COUNT, 1e-3))
    held = optimise(start, odometry, Edges.of([]), ups, _fixed()).T_map_cam
    best = optimise(start, odometry, Edges.of([]), ups, _fixed(), levelled=0).T_map_cam
    bent, straight = (float(np.abs(residual(T, odometry)).max()) for T in (held, best))
    assert straight < 0.1 * bent
    np.testing.assert_allclose(
        best[:, 2, :3], truth[:, 2, :3], atol=1e-5, err_msg="z is up everywhere"
    )
    np.testing.assert_allclose(best[0, :3, 3], start[0, :3, 3], atol=1e-12)
    heading = [np.arctan2(T[1, 0], T[0, 0]) for T in (best[0], start[0])]
    assert abs(heading[0] - heading[1]) < 1e-4


def test_a_new_loop_moves_what_is_around_it_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three times around a circle: loops of the second round are settled, one of the third is
    new.
    """
    monkeypatch.setattr("vio.mapping.map_graph._WINDOW", 80)
    count, period, T, rng = ROUNDS * ROUND, ROUND, _rounds(), RNG(5)
    store = MapStore(tmp_path / "a.map", create=True)
    store.add_session(SessionRow("round", CAMERA, True, 0))
    graph, start = MapGraph(store), T[0]
    for k in range(count):
        if k:
            motion = _measured(T, k - 1, k, SIGMA, rng)
            graph.add_motions([(k - 1, k, motion)])
            start = start @ motion.T_i_j
        graph.append(KeyframeRow(0, k, k, start, start, np.eye(6), 0.0, None, 0.0))
    for k in range(0, 190, 3):
        graph.add_loops(
            [LoopRow(k, k + period, _measured(T, k, k + period, LOOP_SIGMA, rng), 50, True)]
        )
    for _ in range(3):  # far from the optimum at first
        graph.optimise_part(0)
    before = graph.T_map_cam.rows.copy()
    graph.add_loops([LoopRow(190, 290, _measured(T, 190, 290, LOOP_SIGMA, rng), 50, True)])
    assert not graph.optimise_near(0, 1)
    near = graph.T_map_cam.rows.copy()
    moved = np.linalg.norm(near[:, :3, 3] - before[:, :3, 3], axis=1)
    assert moved[290] > 0.01
    assert 80 <= (moved > 0).sum() < 200
    graph.optimise_part(0)

    def around(poses: FloatArray) -> FloatArray:
        """Where the keyframes of both ends stand from one of them: the rest is too soft to tell."""
        return (se3_inverse(poses[190]) @ poses[[*range(185, 196), *range(285, 295)]])[:, :3, 3]

    whole = around(graph.T_map_cam.rows)
    assert np.abs(around(near) - whole).max() < 0.5 * np.abs(around(before) - whole).max()


def _store_of_rounds(rng: np.random.Generator) -> SimpleNamespace:
    """A map at its optimum, with a loop at each tenth keyframe."""
    T, drift, rows, motions = (
        _rounds(),
        np.zeros((6, 6)),
        list[KeyframeRow](),
        list[tuple[int, int, RelativePose]](),
    )
    odom = T[0]
    for k in range(len(T)):
        if k:
            motions.append((k - 1, k, _measured(T, k - 1, k, SIGMA, rng)))
            odom = odom @ motions[-1][2].T_i_j
            A = se3_adjoint(odom)
            drift = drift + A @ motions[-1][2].covariance @ A.T
        rows.append(KeyframeRow(0, k, k, T[k], odom, drift, 3.14 * k, None, 0.0))
    pairs = [(k - ROUND, k) for k in range(ROUND, len(T), 10)]
    store = SimpleNamespace(
        path="rounds",
        sessions=lambda: [SessionRow("rounds", CAMERA, False, 0)],
        keyframes=lambda: rows,
        odometry=lambda: motions,
        loops=lambda: [
            LoopRow(i, k, _measured(T, i, k, LOOP_SIGMA, rng), 50, True) for i, k in pairs
        ],
        show_something=lambda: np.ones(len(T), dtype=np.bool_),
        places=list,
        features=lambda _: NOTHING,
    )
    graph = MapGraph(store)
    graph.optimise_part(0)
    rows[:] = [replace(row, T_map_cam=graph.T_map_cam[k]) for k, row in enumerate(rows)]
    store.loops = graph.loops.copy
    return store


def test_covariance_in_a_map_above_the_window_is_that_of_the_dense_inverse(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("vio.mapping.map_graph._WINDOW", 60)
    store = _store_of_rounds(RNG(1))
    graph = MapGraph(store)
    assert not graph.optimise_near(0, 1)
    T, w = graph.T_map_cam.rows, graph.frame_weights(graph.part == 0)
    rows = list[FloatArray]()
    for i, j, pose in [
        *store.odometry(),
        *((o.first, o.second, o.pose) for o in graph.loops if o.kept),
    ]:
        edge, row = Edges.of([(i, j, pose)]), np.zeros((6, 6 * len(T)))
        A, B = r_D_poses(T, edge, residual(T, edge))
        row[:, 6 * i : 6 * i + 6], row[:, 6 * j : 6 * j + 6] = A[0], B[0]
        rows.append(np.linalg.cholesky(edge.information[0]).T @ row)
    A = se3_adjoint(se3_inverse(T))
    AW = np.swapaxes(A, 1, 2) @ np.diag([1.0, 1, 1, 2, 2, 2]) * w[:, None, None]
    D = -A[-1] @ np.linalg.solve((AW @ A).sum(axis=0), np.hstack(AW))
    D[:, -6:] += np.eye(6)
    J = np.concatenate(rows)
    expected = D[:, 6:] @ np.linalg.inv(J[:, 6:].T @ J[:, 6:]) @ D[:, 6:].T
    found = graph.placed(0, graph.part == 0, None).covariance
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * expected.max())


def test_errors_of_a_session_in_a_map_above_the_window_are_as_its_covariance_says(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Normalised squared errors (6 expected) in the frame in which the map's keyframes stand on
    average.

    The map of 300 keyframes counts as one of 5000, whose factors are made for each fifth keyframe
    at most.
    """
    monkeypatch.setattr("vio.mapping.map_graph._WINDOW", 60)
    truth, first, size, computed = _rounds(), 20, ROUNDS * ROUND, list[int]()
    exact = MapGraph._marginals
    monkeypatch.setattr(
        MapGraph, "_marginals", lambda *a, **named: computed.append(len(a[0])) or exact(*a, **named)
    )
    squared = list[float]()
    for seed in range(15):
        rng, T = RNG([seed, 7]), np.eye(4)
        builder = MapBuilder(_store_of_rounds(rng), "on", CAMERA, upright=False, localise=True)
        graph, found = builder.graph, dict[int, FoundPlace]()
        monkeypatch.setattr(
            builder.places, "find", lambda number, _, found=found: found.get(number)
        )
        for n in range(20):
            motion = _measured(truth, first + n - 1, first + n, SIGMA, rng) if n else None
            T = T if motion is None else T @ motion.T_i_j
            if n % 2 == 0:
                pose = _measured(truth, first + n, first + n, 4 * LOOP_SIGMA, rng)
                found[size + n] = FoundPlace(
                    first + n, size + n, Verified(pose, 50, 60, NO_MATCHES), 0
                )
            update = builder.add(Keyframe(n, n, T, motion, None, 0.0), NOTHING)
            stated, true = (
                graph.T_map_cam.rows.copy(),
                np.concatenate([truth, truth[first : first + n + 1]]),
            )
            graph.keep_place(0, np.arange(len(graph)) < size, true, level=False)
            xi = se3_log(se3_inverse(true[-1]) @ graph.T_map_cam[-1])
            graph.T_map_cam.rows[:] = stated
            squared.append(float(xi @ np.linalg.solve(update.covariance, xi)))
    assert 4.5 < np.mean(squared) < 7.5  # with the map taken as exact 18
    assert 2 * 15 < len(computed) <= 4 * 15, "of the twenty keyframes of each session"


def test_loops_that_contradict_each_other_leave_a_piece_where_it_is() -> None:
    """Nothing but two loops holds the second half, and neither is more likely than the other."""
    T = np.array([se3_exp([k % 5, 0, 0, 0, 0, 0]) for k in range(10)])
    steps = [k for k in range(9) if k != 4]
    odometry = Edges.of(
        [(k, k + 1, RelativePose(se3_exp([1.0, 0, 0, 0, 0, 0]), 1e-4 * np.eye(6))) for k in steps]
    )
    aside = [RelativePose(se3_exp([0, y, 0, 0, 0, 0]), 1e-4 * np.eye(6)) for y in (-3.0, 3.0)]
    loops = Edges.of([(0, 5, aside[0]), (1, 6, aside[1])])
    best = optimise(T, odometry, loops, NO_UP_DIRECTIONS, np.arange(10) == 0)
    assert not best.kept.any()
    np.testing.assert_allclose(residual(best.T_map_cam, odometry), 0.0, atol=1e-6)


def test_a_loop_in_a_piece_without_the_first_keyframe_is_settled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The session that joined the second piece to the first was taken out of the map."""
    monkeypatch.setattr("vio.mapping.map_graph._WINDOW", 80)
    store = MapStore(tmp_path / "a.map", create=True)
    graph, step = MapGraph(store), se3_exp([1.0, 0, 0, 0, 0, 0])
    camera = StereoCamera(400.0, 400.0, 320.0, 180.0, 0.1, 640, 360)
    graph.sessions = [SessionRow(name, camera, True, 0) for name in ("first", "second", "new")]
    for session, count in enumerate((100, 20, 20)):
        T = np.eye(4)
        for k in range(count):
            if k:
                graph.add_motions(
                    [(len(graph) - 1, len(graph), RelativePose(step, 1e-4 * np.eye(6)))]
                )
                T = T @ step
            graph.append(KeyframeRow(session, k, k, T, T, np.eye(6), 0.0, None, 0.0))
    before = graph.T_map_cam.rows.copy()
    measured = RelativePose(se3_exp([0, 0.1, 0, 0, 0, 0]), 1e-4 * np.eye(6))
    graph.add_loops([LoopRow(105, 125, measured, 50, True), LoopRow(110, 130, measured, 50, True)])
    assert not graph.optimise_near(0, 2)
    moved = (graph.T_map_cam.rows - before)[:, :3, 3]
    np.testing.assert_array_equal(moved[:100], 0.0)
    np.testing.assert_allclose(
        moved[100:], [[0.0, 0.1 * (k >= 20), 0.0] for k in range(40)], atol=1e-6
    )


@pytest.mark.parametrize("ends", [[(20, 900)], [(5, 1990), (400, 700)], [(700, 705)]])
def test_the_keyframes_near_new_loops_are_those_of_a_search_of_the_whole_map(
    ends: list[tuple[int, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A chain of 2000 keyframes with 100 loops, motions of all sizes, and a piece that nothing
    joins to it.
    """
    monkeypatch.setattr("vio.mapping.map_graph._WINDOW", 80)
    rng, count = np.random.default_rng(len(ends)), 2000
    chain = np.delete(np.stack([np.arange(count - 1), np.arange(1, count)], axis=1), 1899, axis=0)
    pairs = np.concatenate([chain, np.sort(rng.integers(0, 1900, (100, 2)), axis=1)])
    links = coo_matrix((rng.uniform(0.1, 1.0, len(pairs)), pairs.T), shape=(count, count)).tocsr()
    rows = rng.random(count) < 0.9
    new = [LoopRow(i, j, RelativePose(np.eye(4), np.eye(6)), 50, True) for i, j in ends]
    away = dijkstra(links, directed=False, indices=np.ravel(ends))
    cycle = away[::2] + away[1::2]
    joined = np.isfinite(cycle.min(axis=1))
    detour = np.where(np.isfinite(cycle), cycle, np.minimum(away[::2], away[1::2]))
    detour[joined] -= cycle[joined].min(axis=1, keepdims=True)
    on_cycle = int((detour[joined] <= 1e-9).any(axis=0).sum())
    least = np.where(rows, detour.min(axis=0), np.inf)
    expected = np.sort(least)[: 80 + on_cycle]
    found = _nearest(links, new, rows)
    assert len(set(found.tolist())) == len(found)
    # All keyframes of another way between two of the cycle have one detour, so that which of them
    # is taken is open.
    np.testing.assert_allclose(np.sort(least[found]), expected[np.isfinite(expected)], atol=1e-9)


def test_verticals_do_not_pull_at_a_map_whose_z_is_not_up(tmp_path: Path) -> None:
    """A new session in a map that no loop has levelled yet: by its world of the first seconds,
    up is 2 deg off z.
    """
    graph, step = (
        MapGraph(MapStore(tmp_path / "a.map", create=True)),
        se3_exp([1.0, 0, 0, 0, 0, 0.1]),
    )
    graph.sessions = [
        SessionRow("tilted", StereoCamera(400.0, 400.0, 320.0, 180.0, 0.1, 640, 360), True, 0)
    ]
    up, T = np.array([np.sin(np.radians(2.0)), 0.0, np.cos(np.radians(2.0))]), np.eye(4)
    for k in range(30):
        if k:
            graph.add_motions([(k - 1, k, RelativePose(step, 1e-4 * np.eye(6)))])
            T = T @ step
        graph.append(KeyframeRow(0, k, k, T, T, np.eye(6), 0.0, T[:3, :3].T @ up, np.radians(0.1)))
    before = graph.T_map_cam.rows.copy()
    graph.add_loops(
        [
            LoopRow(
                3, 25, RelativePose(se3_inverse(before[3]) @ before[25], 1e-4 * np.eye(6)), 50, True
            )
        ]
    )
    fixed = np.arange(30) == 3
    graph._optimise(fixed | (np.arange(30) >= 20), fixed)
    np.testing.assert_allclose(graph.T_map_cam.rows, before, atol=1e-9)
    graph.optimise_part(0)  # the whole may be levelled
    np.testing.assert_allclose(
        graph.T_map_cam.rows[-1, :3, :3] @ (T[:3, :3].T @ up), [0.0, 0.0, 1.0], atol=1e-6
    )


@pytest.mark.parametrize("level", [False, True])
def test_the_frame_of_a_map_stays_where_its_keyframes_are_known_to_stand(
    tmp_path: Path, level: bool
) -> None:
    """The last ten of thirty came after a gap in the odometry, and were 100 m off until a loop
    placed them.
    """
    graph, step = (
        MapGraph(MapStore(tmp_path / "a.map", create=True)),
        se3_exp([1.0, 0.2, 0, 0.02, 0, 0.1]),
    )
    graph.sessions = [
        SessionRow("walk", StereoCamera(400.0, 400.0, 320.0, 180.0, 0.1, 640, 360), True, 0)
    ]
    T = se3_exp([0.0, 0.0, 0.0, 0.3, 0.0, 0.0])
    for k in range(30):
        variance = 1e-4 * k + (1e3 if k >= 20 else 0.0)
        graph.append(KeyframeRow(0, k, k, T, T, variance * np.eye(6), 0.0, None, 0.0))
        T = T @ step
    stated = (
        se3_exp([3.0, -2.0, 1.0, *((0, 0, 0.2) if level else (0.1, 0.3, 0.2))])
        @ graph.T_map_cam.rows
    )
    expected, up = stated.copy(), graph.T_map_cam.rows[:, 2, :3].copy()
    stated[20:, 0, 3] += 100.0
    graph.keep_place(0, np.ones(30, dtype=np.bool_), stated, level=level)
    assert np.abs(graph.T_map_cam.rows - expected)[:, :3, 3].max() < 1e-2
    if level:
        np.testing.assert_allclose(graph.T_map_cam.rows[:, 2, :3], up, atol=1e-12)


def test_no_call_holds_the_interpreter_for_a_frame_while_a_loop_is_settled_in_a_large_map(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A hundred rounds of a circle, 100,000 keyframes: CPU time of each call but SuperLU's,
    which lets others run.
    """
    count, period = 100_000, 1000
    angle = 2 * np.pi * np.arange(count) / period
    T = se3_exp(np.stack([*(0 * angle for _ in range(5)), angle], axis=1))
    T[:, :3, 3] = (
        np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], axis=1) * 5 * period / (2 * np.pi)
    )
    step, near = (
        RelativePose(se3_inverse(T[0]) @ T[k], v * np.eye(6)) for k, v in ((1, 3e-4), (0, 3e-3))
    )
    camera = StereoCamera(400.0, 400.0, 320.0, 180.0, 0.1, 640, 360)
    store = SimpleNamespace(
        sessions=lambda: [SessionRow("rounds", camera, False, 0)],
        keyframes=lambda: [
            KeyframeRow(0, k, k, T[k], T[k], np.eye(6), 5.0 * k, None, 0.0) for k in range(count)
        ],
        odometry=lambda: [(k - 1, k, step) for k in range(1, count)],
        loops=lambda: [
            LoopRow(k, k + period, near, 50, True) for k in range(0, count - period, 10)
        ],
    )
    graph = MapGraph(store)
    graph.add_loops([LoopRow(count - 2 * period - 5, count - 5, near, 50, True)])
    began, longest = list[float](), dict[str, float]()

    def watch(frame: object, event: str, call: Any) -> None:
        if event == "c_call":
            began.append(time.thread_time())
        elif event.startswith("c_") and began:
            name, spent = call.__name__, time.thread_time() - began.pop()
            longest[name] = max(longest.get(name, 0.0), spent)

    # Python's profiler sees no functions of Cython
    def watched(*arguments: Any, **named: Any) -> FloatArray:
        start = time.thread_time()
        away = dijkstra(*arguments, **named)
        longest["dijkstra"] = max(longest.get("dijkstra", 0.0), time.thread_time() - start)
        return away

    monkeypatch.setattr("vio.mapping.map_graph.dijkstra", watched)
    sys.setprofile(watch)
    try:
        assert not graph.optimise_near(0, 1)
    finally:
        sys.setprofile(None)
    longest.pop("gstrf")
    # s, a quarter of a frame; a search of the whole map takes 11 ms
    assert max(longest.values()) < 0.008, longest


@pytest.mark.parametrize(("off_px", "agree"), [(3.0, True), (5.0, False)])
def test_points_of_a_loop_agree_within_some_pixels(off_px: float, agree: bool) -> None:
    """Half of the points are exact; with the others, that are off to all sides, all are asked."""
    rng = np.random.default_rng(0)
    camera = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)
    p = np.column_stack([rng.uniform(-2, 2, (40, 2)), rng.uniform(4, 8, 40)])
    uv = project(camera, p)[:, :2]
    angle = rng.uniform(0, 2 * np.pi, 20)
    uv[20:] += off_px * np.column_stack([np.cos(angle), np.sin(angle)])
    assert (pose_of_most(camera, p, uv, 34) is not None) == agree


def _graph_of_sessions(tmp_path: Path, sessions: int, count: int = 20) -> MapGraph:
    """A map whose sessions drive the same way, a kilometre from where each began."""
    graph = MapGraph(MapStore(tmp_path / "a.map", create=True))
    P = np.diag(np.repeat([1e-4, 1e-5], 3)) ** 2
    motion = RelativePose(se3_exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.01])), P)
    for session in range(sessions):
        graph.sessions.append(SessionRow(f"{session}", CAMERA, False, 0))
        T = se3_exp(np.array([1000.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
        for k in range(count):
            drift, path_m = graph.gathered(T, motion if k else None)
            graph.append(KeyframeRow(session, k, k, T, T, drift, path_m, None, 0.0))
            T = T @ motion.T_i_j
    return graph


def test_odometry_is_as_exact_in_a_later_session_as_in_the_first(tmp_path: Path) -> None:
    graph = _graph_of_sessions(tmp_path, 8)
    i = np.array([0, 5, 15])
    k = np.array([19, 6, 16])
    first = graph.drift(i, k)
    assert (np.linalg.eigvalsh(first) > 0).all()
    np.testing.assert_allclose(graph.drift(140 + i, 140 + k), first, rtol=1e-6, atol=1e-16)
    assert graph.path_m[159] == graph.path_m[19]


@pytest.mark.parametrize("i", [2, 20], ids=["before the loop", "after it"])
def test_drift_by_way_of_a_loop_is_that_of_its_parts(tmp_path: Path, i: int) -> None:
    """By differences: errors of motions and of the loop, composed to a motion from i to k."""
    m, n, k = 8, 50, 90
    graph = _graph_of_sessions(tmp_path, 1, count=100)
    T = graph.T_odom_cam
    C_loop = np.diag([1e-4, 2e-4, 3e-4, 1e-5, 2e-5, 3e-5]) ** 2
    loop = RelativePose(se3_inverse(T[m]) @ T[n], C_loop)
    own: Any = SimpleNamespace(_graph=graph, newest=LoopRow(m, n, loop, 50, kept=True))
    stated = PlaceFinder.drift_since(own, np.array([i]), k, systematic=0.0)[0]

    def motion(first: int, last: int, at: int, error: FloatArray) -> FloatArray:
        out = np.eye(4)
        for row in range(first, last):
            out = out @ se3_inverse(T[row]) @ T[row + 1]
            out = out @ se3_exp(error) if row == at else out
        return out

    def end(at: int, error: FloatArray) -> FloatArray:
        begin = motion(i, m, at, error) if i < m else se3_inverse(motion(m, i, at, error))
        return (
            begin @ loop.T_i_j @ se3_exp(error if at < 0 else 0 * error) @ motion(n, k, at, error)
        )

    expected = np.zeros((6, 6))
    P = np.diag(np.repeat([1e-4, 1e-5], 3)) ** 2
    steps = [*range(min(i, m), max(i, m)), *range(n, k)]
    for at, C in [(-1, C_loop), *((row, P) for row in steps)]:
        ends = [end(at, s * 1e-5 * e) for s in (1, -1) for e in np.eye(6)]
        plus, minus = np.array(ends).reshape(2, 6, 4, 4)
        J = se3_log(se3_inverse(minus) @ plus).T / 2e-5
        expected += J @ C @ J.T
    np.testing.assert_allclose(stated, expected, rtol=1e-3, atol=1e-12)


def test_nothing_is_known_of_the_motion_between_sessions(tmp_path: Path) -> None:
    graph = _graph_of_sessions(tmp_path, 3)
    between = graph.drift(np.array([19, 0]), np.array([20, 59]), systematic=0.0)
    assert (np.linalg.eigvalsh(between) > 1e5).all()


def test_loops_to_the_end_of_one_session_and_the_start_of_another_must_agree(
    tmp_path: Path,
) -> None:
    """Where the first session ended, the second had gathered as much path: none are neighbours."""
    graph = _graph_of_sessions(tmp_path, 3)

    def place(first: int, second: int, off_m: float) -> FoundPlace:
        at = np.linalg.inv(graph.T_map_cam[first]) @ graph.T_map_cam[second]
        off = se3_exp(np.array([off_m, 0.0, 0.0, 0.0, 0.0, 0.0]))
        pose = RelativePose(at @ off, 1e-4 * np.eye(6))
        return FoundPlace(first, second, Verified(pose, 30, 40, NO_MATCHES), 1)

    assert agree(graph, place(5, 45, 0.0), place(25, 46, 0.0))
    assert not agree(graph, place(5, 45, 0.0), place(25, 46, 5.0))
