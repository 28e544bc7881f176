"""Patches, alignment, stereo search and the detector, each against a slow or exact reference."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import pytest

from vio.frontend import detect
from vio.frontend.align import align, cut_patches, rounded, shift_warps, templates, warped_patches
from vio.frontend.columns import changed, joined, take
from vio.frontend.detect import (
    cell_index,
    corner_response,
    detect_corners,
    feature_spacing,
    grid_shape,
    local_maxima,
    min_distance_px,
    noise_gradient,
)
from vio.frontend.patches import ImageLevels, half_image, inside
from vio.frontend.prediction import moved_pixels, prior_pixels
from vio.frontend.settings import DisparitySettings, GridSettings
from vio.frontend.stereo_fit import StereoFit
from vio.frontend.stereo_match import EpipolarRowModel, correlate, match_rows
from vio.frontend.tracks import ANCHOR_RADIUS_PX, AnchorBank, Tracks, new_tracks
from vio.geometry.lie import FloatArray, se3_exp
from vio.geometry.stereo import StereoCamera, triangulate
from vio.guard.probe import RowProbe
from vio.records import BoolArray, Image, IntArray, TrackPrior


def waves(u: FloatArray, v: FloatArray, seed: int = 0) -> FloatArray:
    """A random texture, defined at every real-valued pixel; wavelengths 6 to 50 px."""
    rng = np.random.default_rng(seed)
    wavelength, angle, phase = (
        np.exp(rng.uniform(np.log(6), np.log(50), 30)),
        *rng.uniform(0, 2 * np.pi, (2, 30)),
    )
    total = np.zeros(np.broadcast_shapes(u.shape, v.shape))
    for w, a, s in zip(wavelength, angle, phase, strict=True):
        total += np.sqrt(w) * np.cos(2 * np.pi / w * (np.cos(a) * u + np.sin(a) * v) + s)
    return 128 + 40 * total / np.sqrt(wavelength.sum() / 2)


def picture(warp: FloatArray, seed: int = 0, shape: tuple[int, int] = (200, 300)) -> Image:
    """The texture as an 8-bit image whose pixel (u, v) shows the texture at `warp @ [u, v, 1]`."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float64)
    x, y = (warp[i, 0] * u + warp[i, 1] * v + warp[i, 2] for i in (0, 1))
    return np.clip(np.rint(waves(x, y, seed)), 0, 255).astype(np.uint8)


PLAIN = picture(np.eye(3))
NEAR_CAMERA = StereoCamera(200.0, 200.0, 149.5, 99.5, 0.3, 300, 200)
POINTS = np.random.default_rng(5).uniform([40, 40], [260, 160], (60, 2))


def test_stated_standard_deviations_follow_the_noise_of_the_patches() -> None:
    """They are short of the errors by a factor that is the same whatever the noise is (F1).

    Noise of the template is in its gradients too, and neighbouring pixels of an interpolated image
    share theirs.
    """
    rng, shift, centres = np.random.default_rng(8), np.array([0.3, -0.2]), rounded(POINTS)
    there, slots = (
        picture(np.array([[1.0, 0.0, -shift[0]], [0.0, 1.0, -shift[1]]])),
        np.arange(len(POINTS)),
    )
    median_px, ratio = [], []
    for gray in (2.0, 6.0):
        noisy = [
            np.clip(np.rint(i + rng.normal(0, gray, i.shape)), 0, 255).astype(np.uint8)
            for i in (PLAIN, there)
        ]
        store = templates(cut_patches(noisy[0], centres, 7))
        left, _ = align(store, slots, noisy[1], shift_warps(centres), 8)
        right, _ = align(store, slots, noisy[1], shift_warps(centres), 8, centres[:, 1] + shift[1])
        error = (
            np.concatenate([left[:, :, 2], right[:, :1, 2]], axis=1)
            - (centres + shift)[:, [0, 1, 0]]
        )
        ratio.append(np.sqrt(np.mean((error / store.sigma) ** 2, axis=0)))
        median_px.append(np.median(store.sigma, axis=0))
    assert (np.array(ratio) > 1.0).all()
    assert (np.array(ratio) < 2.0).all()
    np.testing.assert_allclose(ratio[1], ratio[0], rtol=0.25)
    np.testing.assert_allclose(median_px[1] / median_px[0], 3.0, rtol=0.2)


def test_warped_patches_equal_a_loop() -> None:
    """Coordinates are rounded to 1/32 pixel, so the loop uses rounded ones."""
    warp = shift_warps(POINTS[:5])
    warp[:, :, :2] += np.random.default_rng(3).normal(0, 0.1, (5, 2, 2))
    patches = warped_patches(PLAIN, warp, 2).reshape(5, 5, 5)
    for W, patch in zip(warp, patches, strict=True):
        for dy in range(-2, 3):
            for dx in range(-2, 3):
                u, v = np.rint(32 * (W @ [dx, dy, 1])) / 32
                i, j, a, b = int(u), int(v), u % 1, v % 1
                rows = [
                    (1 - a) * float(PLAIN[j + k, i]) + a * float(PLAIN[j + k, i + 1])
                    for k in (0, 1)
                ]
                assert patch[dy + 2, dx + 2] == pytest.approx(
                    (1 - b) * rows[0] + b * rows[1], abs=2.0
                )


def test_patches_cut_at_rounded_points_hold_exact_pixels() -> None:
    points = rounded(POINTS)
    centre = cut_patches(PLAIN, points, 4)[:, 5, 5]
    i, j = np.floor(points).astype(int).T
    a, b = (points % 1).T
    rows = [
        (1 - a) * PLAIN[j + k, i].astype(float) + a * PLAIN[j + k, i + 1].astype(float)
        for k in (0, 1)
    ]
    np.testing.assert_allclose(centre, (1 - b) * rows[0] + b * rows[1], atol=1e-3)


def test_inside_rejects_nan() -> None:
    points = np.array([[10.0, 10.0], [np.nan, 10.0], [-1.0, 10.0], [299.0, 199.0]])
    np.testing.assert_array_equal(inside(PLAIN, points, 0.0), [True, False, False, True])


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.6, 30.0)])
def test_affine_alignment_finds_a_known_warp(gain: float, offset: float) -> None:
    """The second image is rotated, scaled, shifted and differs in exposure."""
    linear = np.array([[1.04, 0.03, -4.0], [-0.02, 0.97, 3.0], [0.0, 0.0, 1.0]])
    other = np.clip(np.rint(gain * picture(linear).astype(np.float64) + offset), 0, 255).astype(
        np.uint8
    )
    expected = POINTS @ np.linalg.inv(linear)[:2, :2].T + np.linalg.inv(linear)[:2, 2]
    start = expected + np.random.default_rng(1).uniform(-1.5, 1.5, POINTS.shape)
    warp, score = fitted(PLAIN, other, ANCHOR_RADIUS_PX, start, 15)
    error = np.linalg.norm(warp[:, :, 2] - expected, axis=1)
    assert np.median(error) < 0.02
    assert np.mean(error < 0.1) > 0.9
    assert np.median(score) > 0.99
    np.testing.assert_allclose(
        np.median(warp[:, :, :2], axis=0), np.linalg.inv(linear)[:2, :2], atol=0.01
    )


def fitted(
    source: Image,
    target: Image,
    radius: int,
    start: FloatArray,
    steps: int,
    rows: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Templates cut at POINTS of one image, aligned with another."""
    centres = rounded(POINTS)
    store = templates(cut_patches(source, centres, radius))
    warp, score = align(store, np.arange(60), target, shift_warps(start), steps, rows)
    # Undo the rounding of the centres, so that the warps start at the points themselves.
    warp[:, :, 2] += (warp[:, :, :2] @ (POINTS - centres)[:, :, None])[:, :, 0]
    return warp, score


def test_what_is_at_another_depth_at_the_rim_hardly_moves_the_centre() -> None:
    """The centre's surface moves by 1 px, that above a line half a radius away by half as much."""
    rng, radius, errors = np.random.default_rng(21), ANCHOR_RADIUS_PX, []
    near, far = 128 + 40 * rng.normal(0, 1, (2, 200, 300)).astype(np.float32)
    v, u = np.mgrid[0:200, 0:300].astype(np.float32)
    for row in rounded(rng.uniform(20, 180, 60)):
        pictures = []
        for moved in (0.0, 1.0):
            layers = [cv2.GaussianBlur(layer, (0, 0), 2.0) * 5 - 512 for layer in (near, far)]
            below, above = (
                cv2.remap(*layer, cv2.INTER_LINEAR) for layer in _moved(layers, u, v, moved)
            )
            seen = np.where(v > row - 0.5 * radius + moved, below, above)
            pictures.append(np.clip(np.rint(seen), 0, 255).astype(np.uint8))
        at = np.array([[150.0, row]])
        store = templates(cut_patches(pictures[0], at, radius))
        warp, _ = align(store, np.zeros(1, dtype=np.int64), pictures[1], shift_warps(at), 8)
        errors.append(warp[0, 1, 2] - row - 1.0)
    assert abs(np.mean(errors)) < 0.035  # 0.044 where all pixels of a square count alike


def _moved(layers: list[Any], u: Any, v: Any, moved: float) -> list[tuple[Any, Any, Any]]:
    """Arguments of `cv2.remap` for two surfaces, of which the second one moves half as far."""
    return [(layer, u, v - step) for layer, step in zip(layers, (moved, 0.5 * moved), strict=True)]


def test_alignment_with_expected_rows_leaves_the_rows_straight() -> None:
    sheared = np.array([[1.05, 0.2, -20.0], [0.0, 1.0, 0.3], [0.0, 0.0, 1.0]])
    other = picture(sheared)
    expected = POINTS @ np.linalg.inv(sheared)[:2, :2].T + np.linalg.inv(sheared)[:2, 2]
    warp, _ = fitted(PLAIN, other, ANCHOR_RADIUS_PX, expected + 0.7, 10, rows=expected[:, 1])
    assert np.median(np.linalg.norm(warp[:, :, 2] - expected, axis=1)) < 0.02
    np.testing.assert_allclose(warp[:, 1, :2], np.tile([0.0, 1.0], (60, 1)), atol=1e-12)


def test_expected_row_resolves_the_aperture_problem() -> None:
    """On a slanted edge the patch determines only the shift across it; the expected row
    determines the rest.
    """
    v, u = np.mgrid[0:200, 0:300].astype(np.float64)
    edge = 128 + 80 * np.tanh((u - 0.5 * v - 60 + 12) / 2)
    moved = 128 + 80 * np.tanh((u - 0.5 * v - 60) / 2)
    noise = np.random.default_rng(2).normal(0, 2, (2, 200, 300))
    pictures = [
        np.clip(np.rint(p + n), 0, 255).astype(np.uint8)
        for p, n in zip((edge, moved), noise, strict=True)
    ]
    row = np.arange(60.0, 140.0, 5)
    on_edge = np.stack([0.5 * row + 48, row], axis=1)
    store = templates(cut_patches(pictures[0], on_edge, 6))
    start = shift_warps(on_edge + np.array([11.0, 0.0]))
    free, _ = align(store, np.arange(16), pictures[1], start, 6)
    held, score = align(store, np.arange(16), pictures[1], start, 6, rows=row)
    assert score.min() > 0.9
    slide_free, slide_held = (np.abs(warp[:, 1, 2] - row) for warp in (free, held))
    assert np.median(slide_held) < 0.15
    assert np.median(slide_free) > 2 * np.median(slide_held)
    assert np.abs(held[:, 0, 2] - on_edge[:, 0] - 12).max() < 0.25


def row_correlation(
    target: Image, centres: list[list[int]], first: list[int], count: int
) -> FloatArray:
    """Correlations (N, count) of patches of PLAIN, 7 x 7."""
    score = np.empty((len(centres), count), np.float32)
    correlate(PLAIN, target, np.array(centres), np.array(first), 3, score)
    return score


def test_row_correlation_equals_numpy() -> None:
    other = picture(np.eye(3), seed=1)
    centres = [[50, 60], [120, 100]]
    score = row_correlation(other, centres, [40, 110], 9)
    for n in range(2):
        u, v = centres[n]
        a = PLAIN[v - 3 : v + 4, u - 3 : u + 4].ravel().astype(np.float64)
        for k in range(9):
            c = (40, 110)[n] + k
            b = other[v - 3 : v + 4, c - 3 : c + 4].ravel().astype(np.float64)
            assert score[n, k] == pytest.approx(np.corrcoef(a, b)[0, 1], abs=1e-4)


def test_row_correlation_beyond_the_image_is_minus_one() -> None:
    score = row_correlation(PLAIN, [[5, 60]], [-6], 10)
    np.testing.assert_array_equal(score[0, :9], -1.0)
    assert score[0, 9] > -1.0


@pytest.mark.parametrize("slope", [0.0, 0.08])
def test_search_finds_known_disparities(slope: float) -> None:
    """On a surface whose disparity grows down the image, like a road."""
    right = picture(np.array([[1.0, slope, 13.3], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    true = slope * POINTS[:, 1] + 13.3
    disparity, valid = match_rows(half_image(PLAIN), half_image(right), POINTS, 48.0, 0.6, 0.03)
    error = np.abs(disparity - true)[valid]
    assert valid.mean() > 0.8
    assert np.median(error) < 0.3
    assert error.max() < 1.5


def test_disparity_outside_the_range_is_rejected() -> None:
    for shift in (-6.0, 80.0):
        right = picture(np.array([[1.0, 0.0, shift], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
        _, valid = match_rows(half_image(PLAIN), half_image(right), POINTS, 48.0, 0.6, 0.03)
        assert valid.mean() < 0.35  # chance matches, which the fine alignment rejects


def _moved_right(shift: float) -> ImageLevels:
    image = picture(np.array([[1.0, 0.0, shift], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    return ImageLevels(image, half_image(image))


def _wall(stereo: StereoFit, disparity: float) -> Tracks:
    """Features on a wall, as they have been matched."""
    left = POINTS[POINTS[:, 0] > 130]
    matched, shift = np.ones(len(left), dtype=np.bool_), np.array([disparity, 0.0])
    new = new_tracks(left, np.arange(len(left)))
    point = triangulate(NEAR_CAMERA, np.concatenate([left, left - shift], axis=1))[0]
    return replace(new, right=left - shift, has_right=matched, point=point, has_point=matched)


def test_the_search_reaches_further_where_the_scene_is_near() -> None:
    """A wall at 0.4 of the image width, beyond the setting."""
    stereo = StereoFit(
        NEAR_CAMERA, DisparitySettings(), AnchorBank(100, ANCHOR_RADIUS_PX), (300, 200)
    )
    half, points = half_image(PLAIN), POINTS[POINTS[:, 0] > 170]
    disparity, unique = stereo.search(half, _moved_right(120.0).half, points)
    assert unique.mean() > 0.8
    assert np.abs(disparity[unique] - 120.0).max() < 1.5
    assert stereo.max_disparity_px > 120.0


def test_the_search_follows_features_that_come_nearer() -> None:
    """A wall at 0.15 of the width comes to 0.2: its points know their depth, and matched in the
    last frame.
    """
    stereo = StereoFit(
        NEAR_CAMERA, DisparitySettings(), AnchorBank(100, ANCHOR_RADIUS_PX), (300, 200)
    )
    near = _wall(stereo, 60.0)
    stereo.track_right(
        changed(near, has_right=np.zeros(len(near), dtype=np.bool_)), _moved_right(60.0), moved=True
    )
    assert stereo.max_disparity_px == 48.0  # depths that no pair has confirmed
    stereo.track_right(near, _moved_right(60.0), moved=True)
    assert stereo.max_disparity_px == 96.0


def test_chance_matches_do_not_make_the_search_reach_further() -> None:
    stereo = StereoFit(
        NEAR_CAMERA, DisparitySettings(), AnchorBank(100, ANCHOR_RADIUS_PX), (300, 200)
    )
    other = half_image(picture(np.eye(3), seed=1))
    first = stereo.max_disparity_px
    stereo.search(
        half_image(PLAIN), other, np.random.default_rng(1).uniform([40, 40], [260, 160], (400, 2))
    )
    assert stereo.max_disparity_px == first


def test_a_near_scene_with_repeated_texture_does_not_look_exchanged() -> None:
    """Each point has a match to the left, beyond the usual reach, and one to the right within
    it.
    """
    near, again = _moved_right(120.0).full, _moved_right(-15.0).full
    right = np.where(np.arange(300) < 150, near, again)
    views, points = [half_image(i) for i in (PLAIN, right)], POINTS[POINTS[:, 0] > 170]
    probe = RowProbe()
    assert probe.positive(*views, points) > 0.7 * len(points)
    assert probe.negative(*views, points) > 0.7 * len(points)
    unlike = half_image(picture(np.eye(3), seed=1))
    assert probe.positive(views[0], unlike, points) < 0.1 * len(points)


def test_points_beside_the_right_image_or_beyond_the_reach_are_not_testable() -> None:
    stereo = StereoFit(
        NEAR_CAMERA, DisparitySettings(), AnchorBank(100, ANCHOR_RADIUS_PX), (300, 200)
    )
    tracks = _wall(stereo, 30.0)
    assert stereo.testable(tracks).all()
    assert not stereo.testable(_wall(stereo, 60.0)).any()
    beside = changed(tracks, left=tracks.left - [tracks.left[0, 0] - 35.0, 0.0])
    assert not stereo.testable(beside)[0]


def test_a_match_at_the_end_of_the_searched_row_is_none() -> None:
    """The correlation of a smooth texture still grows there: the point is nearer than the search
    reaches.
    """
    for shift in (41.0, 43.0):
        _, valid = match_rows(half_image(PLAIN), _moved_right(shift).half, POINTS, 40.0, 0.6, 0.03)
        assert valid.mean() < 0.1


def test_matching_no_points_gives_no_disparities() -> None:
    disparity, valid = match_rows(
        half_image(PLAIN), half_image(PLAIN), np.zeros((0, 2)), 48.0, 0.6, 0.03
    )
    assert disparity.shape == valid.shape == (0,)


def test_row_field_estimates_rectification_error() -> None:
    """Rows differ by a relative roll and a shift, with noise and 10 % wrong matches."""
    rng = np.random.default_rng(4)
    field = EpipolarRowModel(640, 360)
    for _ in range(10):
        left = rng.uniform([0, 0], [640, 360], (150, 2))
        off = 0.3 + 0.001 * (left[:, 0] - 320) + 5e-6 * (left[:, 0] - 320) * (left[:, 1] - 180)
        right = left + np.stack([np.full(150, -20.0), off + rng.normal(0, 0.15, 150)], axis=1)
        right[:15, 1] += rng.uniform(-5, 5, 15)
        field.update(left, right)
    grid = np.stack(
        np.meshgrid(np.arange(20.0, 640, 60), np.arange(20.0, 360, 40)), axis=-1
    ).reshape(-1, 2)
    expected = 0.3 + 0.001 * (grid[:, 0] - 320) + 5e-6 * (grid[:, 0] - 320) * (grid[:, 1] - 180)
    assert np.abs(field.rows(grid) - grid[:, 1] - expected).max() < 0.1


def test_initial_row_field_is_zero() -> None:
    np.testing.assert_array_equal(EpipolarRowModel(300, 200).rows(POINTS), POINTS[:, 1])


def test_corner_response_is_the_mean_squared_gradient_in_the_weakest_direction() -> None:
    """Against the structure tensor by central differences, on a texture smooth enough for both."""
    v, u = np.mgrid[0:60, 0:60].astype(np.float64)
    image = np.clip(np.rint(128 + 60 * np.sin(u / 6) * np.sin(v / 7)), 0, 255).astype(np.uint8)
    gy, gx = np.gradient(image.astype(np.float64))
    window = (slice(29, 32), slice(27, 30))
    tensor = [[np.mean((a * b)[window]) for a in (gx, gy)] for b in (gx, gy)]
    assert corner_response(image)[30, 28] == pytest.approx(np.linalg.eigvalsh(tensor)[0], rel=0.1)


def test_local_maxima_keep_their_distance_from_each_other_and_from_tracks() -> None:
    response = corner_response(PLAIN)
    occupied = np.array([[100.0, 100.0], [150.0, 50.0]])
    found = local_maxima(response, occupied, 9, 12, 1.0)
    assert len(found) > 20
    gap = np.abs(found[:, None] - found[None]).max(axis=2)
    np.fill_diagonal(gap, 99)
    assert gap.min() > 9
    assert np.abs(found[:, None] - occupied[None]).max(axis=2).min() > 9
    assert inside(PLAIN, found.astype(np.float64), 12).all()


@pytest.mark.parametrize("width", [31, 32, 37, 40])
def test_local_maxima_are_all_there_are(width: int) -> None:
    """Against each pixel's neighbourhood, in equal steps with many ties, and in rows of any
    length.
    """
    response = np.random.default_rng(width).integers(0, 9, (29, width)).astype(np.float32)
    for distance, border, least in ((1, 1, 3.0), (2, 4, 0.0), (5, 7, 8.0)):
        found = local_maxima(response, np.zeros((0, 2)), distance, border, least)
        padded = np.pad(response, distance)
        shape = (2 * distance + 1, 2 * distance + 1)
        largest = response >= np.lib.stride_tricks.sliding_window_view(padded, shape).max(
            axis=(2, 3)
        )
        largest &= response >= max(least, 1e-12)
        inner = np.zeros_like(largest)
        inner[border:-border, border:-border] = True
        np.testing.assert_array_equal(found[:, ::-1], np.argwhere(largest & inner))


HALF = half_image(PLAIN)


def test_new_corners_go_where_tracks_are_missing() -> None:
    grid = GridSettings(target_features=120)
    left_side = detect_corners(HALF, np.zeros((0, 2)), 120, grid)
    left_side = left_side[left_side[:, 0] < 150]
    new = detect_corners(HALF, left_side, 30, grid)
    assert len(new) == 30
    assert np.mean(new[:, 0] > 150) > 0.9


def test_corners_are_found_at_corners_of_squares() -> None:
    """White squares on black: the corners found at half resolution are those of the squares, to
    about a pixel.
    """
    image = np.zeros((200, 300), dtype=np.uint8)
    for v in range(30, 170, 50):
        for u in range(30, 270, 60):
            image[v : v + 20, u : u + 24] = 200
    found = detect_corners(
        half_image(image), np.zeros((0, 2)), 200, GridSettings(target_features=200)
    )
    true = np.array(
        [
            [u + a, v + b]
            for v in range(30, 170, 50)
            for u in range(30, 270, 60)
            for a in (-0.5, 23.5)
            for b in (-0.5, 19.5)
        ]
    )
    gap = np.abs(found[:, None] - true).max(axis=2).min(axis=1)
    assert len(found) >= 40
    assert np.median(gap) < 2.0


def test_mask_excludes_corners() -> None:
    allowed = np.ones(HALF.shape, dtype=np.bool_)
    allowed[:, :75] = False
    found = detect_corners(HALF, np.zeros((0, 2)), 200, GridSettings(), allowed)
    assert len(found) > 20
    assert found[:, 0].min() >= 149.0


def test_weak_corner_next_to_a_strong_one_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.full((200, 300), 60, dtype=np.uint8)
    image[60:80, 60:80] = 250
    image[60:80, 100:120] = 75
    nothing = np.zeros((0, 2))
    wide = GridSettings(target_features=4)  # one cell is nearly half of the image
    monkeypatch.setattr(detect, "_CORNERS", detect._CORNERS._replace(min_distance_share=0.05))
    strict = detect_corners(half_image(image), nothing, 50, wide)
    monkeypatch.setattr(detect, "_CORNERS", detect._CORNERS._replace(min_relative_gradient=0.0))
    loose = detect_corners(half_image(image), nothing, 50, wide)
    assert np.abs(strict - [70, 70]).max(axis=1).max() < 16
    assert np.mean(np.abs(loose - [110, 70]).max(axis=1) < 16) > 0.3


def test_no_corners_if_none_wanted_or_image_tiny() -> None:
    assert detect_corners(HALF, POINTS, 0, GridSettings()).shape == (0, 2)
    assert detect_corners(HALF[:10, :10], np.zeros((0, 2)), 10, GridSettings()).shape == (0, 2)


@pytest.mark.parametrize(("width", "height"), [(640, 360), (752, 480), (1242, 375)])
def test_defaults_scale_with_the_image(width: int, height: int) -> None:
    grid = GridSettings()
    rows, columns = grid_shape(width, height, grid)
    assert rows * columns * detect._CORNERS.cell_features == pytest.approx(
        grid.target_features, rel=0.15
    )
    assert 0.75 < (width / columns) / (height / rows) < 1.35
    assert min_distance_px(width, height, grid) < 0.5 * feature_spacing(width, height, grid)
    corners = np.array([[0.0, 0.0], [width - 1.0, height - 1.0]])
    np.testing.assert_array_equal(
        cell_index(corners, width, height, (rows, columns)), [0, rows * columns - 1]
    )


def noisy(level: float, sigma: float, seed: int) -> Image:
    noise = sigma * np.random.default_rng(seed).standard_normal((240, 320))
    return np.clip(np.rint(level + noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("sigma", [1.0, 2.0, 6.0])
def test_noise_gradient_is_estimated_from_the_image(sigma: float) -> None:
    """Compared with the Sobel derivative of pure noise; gradients and straight edges have no
    effect.
    """
    image = noisy(100, sigma, 1).astype(np.float64)
    du = image[:, 2:] - image[:, :-2]
    sobel = (du[:-2] + 2 * du[1:-1] + du[2:]) / 8
    assert noise_gradient(noisy(100, sigma, 1)) == pytest.approx(
        np.sqrt(np.mean(sobel**2)), rel=0.05
    )
    slope = np.linspace(-60, 60, 320) + np.where(np.arange(320) > 160, 30.0, 0.0)
    sloped = np.clip(np.rint(image + slope), 0, 255).astype(np.uint8)
    assert noise_gradient(sloped) == pytest.approx(noise_gradient(noisy(100, sigma, 1)), rel=0.1)


def test_noise_in_the_dark_gives_few_corners(monkeypatch: pytest.MonkeyPatch) -> None:
    """The threshold decreases with the noise, but stays above the gradient of the noise."""
    for sigma in (0.5, 1.5, 3.0):
        half = half_image(noisy(8, sigma, 2))
        assert len(detect_corners(half, np.zeros((0, 2)), 1000, GridSettings())) <= 3
        with monkeypatch.context() as patch:
            patch.setattr(detect, "_CORNERS", detect._CORNERS._replace(min_gradient_over_noise=1.0))
            found = len(detect_corners(half, np.zeros((0, 2)), 1000, GridSettings()))
        assert found > (30 if sigma > 1 else 3)  # control: without the threshold there are corners


# --- records, anchors, predictions
# ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Inner:
    flags: BoolArray


@dataclass(frozen=True, slots=True)
class Outer:
    names: IntArray
    places: FloatArray
    inner: Inner


def test_take_and_joined_work_on_nested_records() -> None:
    record = Outer(
        np.arange(4), np.arange(8.0).reshape(4, 2), Inner(np.array([True, False, True, False]))
    )
    odd = take(record, np.array([3, 1]))
    assert odd.names.tolist() == [3, 1]
    np.testing.assert_array_equal(odd.places, [[6.0, 7.0], [2.0, 3.0]])
    assert not odd.inner.flags.any()
    both = joined(take(record, record.inner.flags), odd)
    assert both.names.tolist() == [0, 2, 3, 1]
    assert both.inner.flags.tolist() == [True, True, False, False]


def test_anchors_keep_their_slots_when_the_bank_grows() -> None:
    image = PLAIN
    points = rounded(POINTS)  # as anchors are cut
    bank = AnchorBank(4, 3)
    first = bank.add(image, points[:3])
    before = bank.store.patch[first].copy()
    more = bank.add(image, points[3:20])
    assert not set(first) & set(more)
    np.testing.assert_array_equal(bank.store.patch[first], before)
    np.testing.assert_array_equal(
        bank.store.patch[more], templates(cut_patches(image, points[3:20], 3)).patch
    )
    bank.keep_only(first)
    again = bank.add(image, points[20:22])
    assert not set(first) & set(again)
    assert set(again) <= set(more) | {3}  # free slots are reused


def test_points_behind_the_camera_keep_their_pixels() -> None:
    camera = StereoCamera(fu=300.0, fv=310.0, cu=150.0, cv=100.0, baseline_m=0.1)
    p_prev = np.array([[0.1, 0.2, 5.0], [0.1, 0.2, 1.0], [-1.0, 0.5, 9.0]])
    T_curr_prev = se3_exp([0.02, -0.01, -2.0, 0.0, 0.05, 0.01])
    left = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    found = moved_pixels(camera, T_curr_prev, p_prev, left)
    p = p_prev @ T_curr_prev[:3, :3].T + T_curr_prev[:3, 3]
    expected = np.stack(
        [300.0 * p[:, 0] / p[:, 2] + 150.0, 310.0 * p[:, 1] / p[:, 2] + 100.0], axis=1
    )
    np.testing.assert_allclose(found[[0, 2]], expected[[0, 2]])
    np.testing.assert_array_equal(found[1], left[1])


def test_prior_pixels_are_matched_by_id() -> None:
    prior = TrackPrior(np.array([3, 7, 9]), np.arange(12.0).reshape(3, 4))
    rows, predicted = prior_pixels(np.array([9, 1, 3]), prior)
    assert dict(zip(rows.tolist(), predicted.tolist(), strict=True)) == {
        0: [8.0, 9.0],
        2: [0.0, 1.0],
    }


@pytest.mark.parametrize("count", [4, 12, 100])
def test_rows_are_held_at_zero_by_as_much_as_four_matches(count: int) -> None:
    field = EpipolarRowModel(640, 360)
    centre = np.tile([320.0, 180.0], (count, 1))
    field.update(centre, centre + np.array([0.0, 0.01]))  # a small one, of full weight
    assert field.offset_px == pytest.approx(0.01 * count / (count + 4), rel=0.02)
