"""Places found by looking for points where they should be seen, where descriptors alone do not
tell them apart.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, se3_log, transform_points
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera, project
from vio.mapping.builder import Keyframe, MapBuilder
from vio.mapping.features import KeyframeFeatures
from vio.mapping.guided_search import PlaceView, _pairs, _Target, place_points, search, shown
from vio.mapping.loop_geometry import Terms, points_of, verify
from vio.mapping.map_store import MapStore
from vio.mapping.overlap import Overlaps, is_visible

CAMERA = StereoCamera(400.0, 400.0, 319.5, 179.5, 0.12, 640, 360)
T_I_K = se3_exp([0.5, -0.1, 0.3, 0.04, -0.15, 0.03])
OFF = RelativePose(
    se3_exp([0.10, -0.08, 0.10, 0.01, -0.015, 0.01]), np.diag(np.repeat([0.08**2, 0.01**2], 3))
)
PATTERNS = 40  # of a wallpaper: so many different descriptors


class Wallpaper:
    """Points around the origin whose few patterns repeat, so that no descriptor is one point's
    alone.
    """

    def __init__(self, seed: int, points: int = 400, patterns: int = PATTERNS) -> None:
        self._rng = np.random.default_rng(seed)
        self.p = self._rng.uniform((-4, -2, 3), (4, 2, 9), (points, 3))
        self._bits = self._rng.integers(0, 256, (patterns, 32), dtype=np.uint8)[
            np.arange(points) % patterns
        ]

    def seen_from(self, T: FloatArray) -> KeyframeFeatures:
        """Features of a camera at a pose (4, 4), with half a pixel of noise and a tenth of the
        bits wrong.
        """
        p, rng = transform_points(se3_inverse(T), self.p), self._rng
        rows = np.flatnonzero(
            (p[:, 2] > 1)
            & (np.abs(project(CAMERA, p)[:, :2] - [320, 180]) < [300, 170]).all(axis=1)
        )
        z = project(CAMERA, p[rows]) + rng.normal(0, 0.5, (len(rows), 4))
        wrong = np.packbits(rng.random((len(rows), 256)) < 0.1, axis=1)
        return KeyframeFeatures(
            z, rng.random(len(rows)) < 0.8, np.full(len(rows), 1.0), self._bits[rows] ^ wrong
        )


def _place(paper: Wallpaper) -> list[PlaceView]:
    """Two views of it, the second one a little to the side."""
    aside = RelativePose(se3_exp([0.2, 0.0, 0.1, 0.0, 0.05, 0.0]), 1e-8 * np.eye(6))
    origin = RelativePose(np.eye(4), np.zeros((6, 6)))
    return [
        PlaceView(n, shown(CAMERA, paper.seen_from(r.T_i_j)), r)
        for n, r in enumerate((origin, aside))
    ]


def _start(T: FloatArray) -> RelativePose:
    return RelativePose(T @ OFF.T_i_j, OFF.covariance)


def test_repeated_patterns_are_told_apart_by_where_they_should_be() -> None:
    squared = []
    for seed in range(8):
        paper = Wallpaper(seed)
        views, here = _place(paper), paper.seen_from(T_I_K)
        assert verify(CAMERA, views[0].shown.features, CAMERA, here) is None
        seen = search(place_points(views), CAMERA, here, _start(T_I_K), None)
        r = se3_log(se3_inverse(seen.pose.T_i_j) @ T_I_K)
        squared.append(float(r @ np.linalg.solve(seen.pose.covariance, r)))
        assert np.linalg.norm(r[:3]) < 0.02
        assert seen.inliers > 5 * seen.chance
        assert set(seen.view) == {0, 1}, "points of both views"
    # of six degrees of freedom; the covariance is inflated on purpose
    assert 0.3 < np.mean(squared) < 6.0


def test_a_prior_decides_only_what_the_pixels_leave_open() -> None:
    """Near points say where the camera is, whatever the prior says; far ones leave its position
    open.
    """
    paper = Wallpaper(1)
    prior = RelativePose(T_I_K @ se3_exp([0.05, 0.0, 0.0, 0.0, 0.0, 0.0]), 0.05**2 * np.eye(6))
    seen = search(place_points(_place(paper)), CAMERA, paper.seen_from(T_I_K), _start(T_I_K), prior)
    assert np.linalg.norm(se3_log(se3_inverse(seen.pose.T_i_j) @ T_I_K)[:3]) < 0.01
    paper.p *= 4
    start, exact = (
        RelativePose(T_I_K, 0.01**2 * np.eye(6)),
        RelativePose(T_I_K, 0.001**2 * np.eye(6)),
    )
    here, points, errors = paper.seen_from(T_I_K), place_points(_place(paper)), []
    for known in (None, exact):
        seen = search(points, CAMERA, here, start, known)
        errors.append(np.linalg.norm(se3_log(se3_inverse(seen.pose.T_i_j) @ T_I_K)[:3]))
        assert np.sqrt(seen.pose.covariance[:3, :3].trace()) > 0.02, "it is that of the pixels"
    assert errors[1] < 0.2 * errors[0]


def test_a_loop_is_no_echo_of_the_odometry() -> None:
    """Of a prior as good as the pixels, and two standard deviations off, it has little: the map
    has that already.
    """
    pulls = []
    for seed in range(6):
        paper = Wallpaper(seed)
        points, here = place_points(_place(paper)), paper.seen_from(T_I_K)
        start = RelativePose(T_I_K, 0.01**2 * np.eye(6))
        alone = search(points, CAMERA, here, start, None)
        C = alone.pose.covariance / 4  # without the inflation that covariances of loops have
        variance, V = np.linalg.eigh(C)
        off = 2 * np.sqrt(variance[-1]) * V[:, -1]
        seen = search(points, CAMERA, here, start, RelativePose(alone.pose.T_i_j @ se3_exp(off), C))
        pulls.append(se3_log(se3_inverse(alone.pose.T_i_j) @ seen.pose.T_i_j) @ off / (off @ off))
    assert np.mean(pulls) < 0.15


def test_a_place_with_many_points_is_found_among_much_that_looks_alike() -> None:
    """Fifty of the corners that agree are more than eleven of chance, as windows on blank walls
    have them.
    """
    ratios = []
    for seed in range(4):
        paper = Wallpaper(seed, patterns=3)
        views = _place(paper)
        # another time
        paper.p[70:] = np.random.default_rng(seed + 50).uniform((-4, -2, 3), (4, 2, 9), (330, 3))
        start = RelativePose(T_I_K, 0.01**2 * np.eye(6))
        seen = search(place_points(views), CAMERA, paper.seen_from(T_I_K), start, start)
        assert np.linalg.norm(se3_log(se3_inverse(seen.pose.T_i_j) @ T_I_K)[:3]) < 0.03
        ratios.append(seen.inliers / seen.chance)
        assert seen.chance > 7
    assert min(ratios) < 6


def test_where_another_stretch_of_the_path_stands_is_no_measurement() -> None:
    """What the map takes to be between two places is wrong by 4 cm; the loop with the first one
    is not.
    """
    paper = Wallpaper(2)
    views, here = _place(paper), paper.seen_from(T_I_K)
    T = se3_exp([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    wrong = RelativePose(T @ se3_exp([0.0, 0.04, 0.0, 0.0, 0.0, 0.0]), 0.01**2 * np.eye(6))
    views.append(PlaceView(90, shown(CAMERA, paper.seen_from(T)), wrong, 90))
    seen = search(place_points(views), CAMERA, here, _start(T_I_K), None)
    assert np.linalg.norm(se3_log(se3_inverse(seen.pose.T_i_j) @ T_I_K)[:3]) < 0.01
    assert set(seen.view) == {0, 1}


@pytest.mark.parametrize("patterns", [400, PATTERNS, 1])
def test_another_place_is_not_found_where_this_one_is_expected(patterns: int) -> None:
    """Of one pattern alone, each window holds something that looks right."""
    for seed in range(4):
        paper, other = Wallpaper(seed, patterns=patterns), Wallpaper(seed + 100, patterns=patterns)
        if patterns == 1:
            other._bits = paper._bits
        start = _start(T_I_K)
        assert (
            search(place_points(_place(paper)), CAMERA, other.seen_from(T_I_K), start, start)
            is None
        )


def test_few_features_are_no_place() -> None:
    paper = Wallpaper(0)
    here = paper.seen_from(T_I_K)
    few = KeyframeFeatures(
        here.z[:11], here.has_right[:11], here.sigma_px[:11], here.descriptors[:11]
    )
    assert search(place_points(_place(paper)), CAMERA, few, _start(T_I_K), None) is None


def test_the_keyframe_that_shows_most_is_expected_most() -> None:
    overlaps, p = Overlaps(), Wallpaper(0).p
    overlaps.add(p)
    overlaps.add(p)
    overlaps.add(np.zeros((0, 3)))
    T = np.array([np.eye(4), se3_exp([0, 0, 0, 0, 1.5, 0]), np.eye(4)])
    ahead, aside, empty = overlaps.expected(np.arange(3), T, CAMERA, np.eye(4))
    assert ahead > 0.5 * len(p)
    assert aside < 0.2 * ahead
    assert empty == 0


def test_a_walk_back_along_a_wallpaper_closes_loops(tmp_path: Path) -> None:
    """Descriptors alone show no place; odometry with half a centimetre of error a step says
    where to look.
    """
    paper, rng = Wallpaper(3, points=2400), np.random.default_rng(0)
    paper.p[:, 0] *= 3
    x = np.concatenate([np.linspace(-9, 9, 20), np.linspace(9, -9, 20)])
    T = se3_exp(np.stack([x, 0.1 * np.sin(x), 0 * x, 0 * x, 0.05 * np.cos(x), 0 * x], axis=1))
    T[20:, 2, 3] += 0.3
    sigma = np.repeat([0.005, 0.0005], 3)
    builder = MapBuilder(
        MapStore(tmp_path / "a.map", create=True), "walk", CAMERA, upright=False, localise=False
    )
    T_odom = T[0]
    for k in range(40):
        motion = None
        if k:
            step = se3_inverse(T[k - 1]) @ T[k] @ se3_exp(sigma * rng.standard_normal(6))
            motion, T_odom = RelativePose(step, np.diag(sigma**2)), T_odom @ step
        builder.add(Keyframe(k, 10**9 * k, T_odom, motion, None, 0.0), paper.seen_from(T[k]))
    builder.close()
    loops = builder.graph.loops
    assert len({o.second for o in loops}) >= 0.8 * 15, (
        "of the keyframes of the way back that are not recent"
    )
    for o in loops:
        gap = se3_log(se3_inverse(o.pose.T_i_j) @ se3_inverse(T[o.first]) @ T[o.second])
        assert np.linalg.norm(gap[:3]) < 0.03


def test_the_step_of_a_fit_is_that_of_finite_differences() -> None:
    """Normal equations of whitened residuals at a pose, in both directions, with wide weights."""
    paper = Wallpaper(5, points=60)
    i, k = paper.seen_from(np.eye(4)), paper.seen_from(np.eye(4))
    rows, T = np.arange(min(len(i), len(k))), se3_exp([0.01, -0.02, 0.01, 0.002, 0.001, -0.002])
    for inverse in (True, False):
        terms = Terms(points_of(CAMERA, i, rows), CAMERA, k, rows, inverse=inverse)

        def cost(xi: FloatArray, terms: Terms = terms) -> float:
            squared = terms.add(T @ se3_exp(xi), 1e6, np.zeros((6, 6)), np.zeros(6))
            return 0.5 * float(squared[np.isfinite(squared)].sum())

        normal, pull = np.zeros((6, 6)), np.zeros(6)
        terms.add(T, 1e6, normal, pull)
        step = 1e-5 * np.eye(6)
        slope = np.array([(cost(e) - cost(-e)) / 2e-5 for e in step])
        np.testing.assert_allclose(-pull, slope, atol=0.02 * np.abs(slope).max())
        assert np.linalg.eigvalsh(normal)[0] > 0


def test_windows_are_as_wide_as_the_covariance_of_the_pose_makes_them() -> None:
    """Against central differences of the predicted pixels."""
    p = np.random.default_rng(0).uniform([-1, -1, 4], [1, 1, 8], (6, 3))
    T, C = (
        se3_exp([0.1, 0.0, 0.05, 0.02, -0.03, 0.01]),
        np.diag(np.array([0.02, 0.03, 0.05, 0.01, 0.006, 0.02]) ** 2),
    )
    seen = KeyframeFeatures(
        project(CAMERA, p), np.ones(6, bool), np.ones(6), np.zeros((6, 32), np.uint8)
    )
    place = place_points(
        [PlaceView(0, shown(CAMERA, seen), RelativePose(np.eye(4), np.zeros((6, 6))))]
    )
    pairs = _pairs(place, _Target.of(CAMERA, seen), T, C)
    step = 1e-6 * np.eye(6)
    ahead, back = (
        np.array(
            [
                project(CAMERA, transform_points(se3_inverse(T @ se3_exp(s * e)), p))[:, :2]
                for e in step
            ]
        )
        for s in (1, -1)
    )
    D = (ahead - back) / 2e-6
    sigma = np.sqrt(np.einsum("inc,ij,jnc->nc", D, C, D).max(axis=1))
    np.testing.assert_allclose(
        pairs.radius, 3.0 * np.maximum(pairs.size_px, 1.0) + 3.0 * sigma, rtol=1e-6
    )


@pytest.mark.parametrize(("ahead_m", "seen"), [(0.09, False), (0.11, True), (-1.0, False)])
def test_points_are_visible_from_a_decimetre_ahead(ahead_m: float, seen: bool) -> None:
    point = np.array([0.0, 0.0, ahead_m])
    assert is_visible(point, np.zeros(3), point, np.zeros(3)) == seen
