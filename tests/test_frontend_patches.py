"""Patches, alignment, the search along the row and the detector, each against a slow or exact twin."""

from __future__ import annotations

import numpy as np
import pytest

from frontend.align import align, cut_patches, shift_warps, templates
from frontend.detect import (
    cell_index,
    corner_response,
    detect_corners,
    feature_spacing,
    grid_shape,
    local_maxima,
    min_distance_px,
)
from frontend.patches import bilinear_patches, inside, warped_patches
from frontend.settings import KltSettings
from frontend.stereo_match import match_rows, row_correlation, row_pyramid
from vio.geometry.lie import FloatArray
from vio.records import Image


def waves(u: FloatArray, v: FloatArray, seed: int = 0) -> FloatArray:
    """A random texture, known at every real-valued pixel; wavelengths 6 to 50 px."""
    rng = np.random.default_rng(seed)
    wavelength, angle, phase = np.exp(rng.uniform(np.log(6), np.log(50), 30)), *rng.uniform(0, 2 * np.pi, (2, 30))
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
POINTS = np.random.default_rng(5).uniform([40, 40], [260, 160], (60, 2))


def test_bilinear_patches_equal_a_loop() -> None:
    patches = bilinear_patches(PLAIN, POINTS[:5], 2)
    for point, patch in zip(POINTS[:5], patches, strict=True):
        for dy in range(-2, 3):
            for dx in range(-2, 3):
                u, v = point[0] + dx, point[1] + dy
                i, j, a, b = int(u), int(v), u % 1, v % 1
                rows = [(1 - a) * float(PLAIN[j + k, i]) + a * float(PLAIN[j + k, i + 1]) for k in (0, 1)]
                assert patch[dy + 2, dx + 2] == pytest.approx((1 - b) * rows[0] + b * rows[1], abs=1e-3)


def test_warped_patches_without_warp_equal_bilinear_ones() -> None:
    plain = bilinear_patches(PLAIN, POINTS, 6)
    np.testing.assert_allclose(warped_patches(PLAIN, shift_warps(POINTS), 6), plain, atol=0.02)


def test_inside_refuses_what_is_not_a_number() -> None:
    points = np.array([[10.0, 10.0], [np.nan, 10.0], [-1.0, 10.0], [299.0, 199.0]])
    np.testing.assert_array_equal(inside(PLAIN, points, 0.0), [True, False, False, True])


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.6, 30.0)])
def test_affine_alignment_finds_a_known_warp(gain: float, offset: float) -> None:
    """The second picture is turned, scaled, shifted and of another exposure."""
    linear = np.array([[1.04, 0.03, -4.0], [-0.02, 0.97, 3.0], [0.0, 0.0, 1.0]])
    other = np.clip(np.rint(gain * picture(linear).astype(np.float64) + offset), 0, 255).astype(np.uint8)
    expected = POINTS @ np.linalg.inv(linear)[:2, :2].T + np.linalg.inv(linear)[:2, 2]
    start = expected + np.random.default_rng(1).uniform(-1.5, 1.5, POINTS.shape)
    warp, score = align(templates(cut_patches(PLAIN, POINTS, 7)), other, shift_warps(start), "affine", 15)
    error = np.linalg.norm(warp[:, :2, 2] - expected, axis=1)
    assert np.median(error) < 0.02
    assert np.mean(error < 0.1) > 0.9
    assert np.median(score) > 0.99
    np.testing.assert_allclose(np.median(warp[:, :2, :2], axis=0), np.linalg.inv(linear)[:2, :2], atol=0.01)


def test_row_alignment_leaves_the_rows_straight() -> None:
    sheared = np.array([[1.05, 0.2, -20.0], [0.0, 1.0, 0.3], [0.0, 0.0, 1.0]])
    other = picture(sheared)
    expected = POINTS @ np.linalg.inv(sheared)[:2, :2].T + np.linalg.inv(sheared)[:2, 2]
    warp, _ = align(templates(cut_patches(PLAIN, POINTS, 6)), other, shift_warps(expected + 0.7), "row", 10)
    assert np.median(np.linalg.norm(warp[:, :2, 2] - expected, axis=1)) < 0.02
    np.testing.assert_array_equal(warp[:, 1, :2], np.tile([0.0, 1.0], (60, 1)))


def test_row_correlation_equals_numpys() -> None:
    other = picture(np.eye(3), seed=1)
    centres = np.array([[50, 60], [120, 100]])
    score = row_correlation(PLAIN, other, centres, np.array([40, 110]), 9, 3)
    for n in range(2):
        u, v = centres[n]
        a = PLAIN[v - 3 : v + 4, u - 3 : u + 4].ravel().astype(np.float64)
        for k in range(9):
            c = (40, 110)[n] + k
            b = other[v - 3 : v + 4, c - 3 : c + 4].ravel().astype(np.float64)
            assert score[n, k] == pytest.approx(np.corrcoef(a, b)[0, 1], abs=1e-4)


def test_row_correlation_beyond_the_image_is_minus_one() -> None:
    score = row_correlation(PLAIN, PLAIN, np.array([[5, 60]]), np.array([-6]), 10, 3)
    np.testing.assert_array_equal(score[0, :9], -1.0)
    assert score[0, 9] > -1.0


@pytest.mark.parametrize("slope", [0.0, 0.08])
def test_matching_finds_known_disparities_with_and_without_a_guess(slope: float) -> None:
    """On a surface whose disparity grows down the image, like a road."""
    settings = KltSettings()
    right = picture(np.array([[1.0, slope, 13.3], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), shape=(200, 300))
    true = slope * POINTS[:, 1] + 13.3
    left, right_pyramid = row_pyramid(PLAIN), row_pyramid(right)
    for guess in (np.full(60, np.nan), true + 1.7):
        match = match_rows(left, right_pyramid, POINTS, guess, settings)
        error = POINTS[:, 0] - match.right[:, 0] - true
        assert match.valid.mean() > 0.8
        assert np.median(np.abs(error[match.valid])) < 0.03
        assert np.abs(error[match.valid]).max() < 0.5


def test_disparity_outside_the_gates_is_refused() -> None:
    settings = KltSettings(min_disparity_px=2.0)
    for shift in (1.0, -6.0, 80.0):
        right = picture(np.array([[1.0, 0.0, shift], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
        match = match_rows(row_pyramid(PLAIN), row_pyramid(right), POINTS, np.full(60, np.nan), settings)
        assert match.valid.mean() < 0.1


def test_rows_that_do_not_agree_are_refused() -> None:
    lifted = picture(np.array([[1.0, 0.0, 13.0], [0.0, 1.0, 1.6], [0.0, 0.0, 1.0]]))
    nothing = np.full(60, np.nan)
    strict = match_rows(row_pyramid(PLAIN), row_pyramid(lifted), POINTS, nothing, KltSettings())
    loose = match_rows(row_pyramid(PLAIN), row_pyramid(lifted), POINTS, nothing, KltSettings(max_epipolar_px=2.0))
    assert strict.valid.mean() < 0.1
    assert loose.valid.mean() > 0.6
    assert np.median((POINTS[:, 1] - loose.right[:, 1])[loose.valid]) == pytest.approx(1.6, abs=0.03)


def test_matching_nothing_gives_nothing() -> None:
    match = match_rows(row_pyramid(PLAIN), row_pyramid(PLAIN), np.zeros((0, 2)), np.zeros(0), KltSettings())
    assert match.right.shape == (0, 2)


def test_corner_response_is_the_mean_squared_gradient_in_the_weakest_direction() -> None:
    """Against the structure tensor by central differences, on a texture smooth enough for both."""
    v, u = np.mgrid[0:60, 0:60].astype(np.float64)
    image = np.clip(np.rint(128 + 60 * np.sin(u / 6) * np.sin(v / 7)), 0, 255).astype(np.uint8)
    gy, gx = np.gradient(image.astype(np.float64))
    window = (slice(28, 33), slice(26, 31))
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


def test_new_corners_go_where_tracks_are_missing() -> None:
    settings = KltSettings(target_features=120)
    left_half = detect_corners(PLAIN, np.zeros((0, 2)), 120, settings)
    left_half = left_half[left_half[:, 0] < 150]
    new = detect_corners(PLAIN, left_half, 30, settings)
    assert len(new) == 30
    assert np.mean(new[:, 0] > 150) > 0.9


def test_nothing_wanted_or_a_tiny_image_gives_no_corners() -> None:
    assert detect_corners(PLAIN, POINTS, 0, KltSettings()).shape == (0, 2)
    assert detect_corners(PLAIN[:20, :20], np.zeros((0, 2)), 10, KltSettings()).shape == (0, 2)


@pytest.mark.parametrize(("width", "height"), [(640, 360), (752, 480), (1242, 375)])
def test_one_set_of_defaults_scales_with_the_image(width: int, height: int) -> None:
    settings = KltSettings()
    rows, columns = grid_shape(width, height, settings)
    assert rows * columns * settings.cell_features == pytest.approx(settings.target_features, rel=0.15)
    assert 0.75 < (width / columns) / (height / rows) < 1.35
    assert min_distance_px(width, height, settings) < 0.5 * feature_spacing(width, height, settings)
    corners = np.array([[0.0, 0.0], [width - 1.0, height - 1.0]])
    np.testing.assert_array_equal(cell_index(corners, width, height, (rows, columns)), [0, rows * columns - 1])
