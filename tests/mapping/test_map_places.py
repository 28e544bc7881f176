"""Places recognised by features: words, pairs, and the motion between two views with its
covariance.
"""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from vio.geometry.lie import (
    FloatArray,
    se3_exp,
    se3_from_parts,
    se3_inverse,
    se3_log,
    transform_points,
)
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera, project
from vio.mapping import place_index
from vio.mapping.features import (
    KeyframeFeatures,
    _most_alike,
    _near_rows,
    extract,
    no_keyframe_features,
)
from vio.mapping.loop_geometry import MIN_INLIERS, match, verify
from vio.mapping.map_graph import MapGraph
from vio.mapping.map_store import KeyframeRow, MapStore, PlacesRow, SessionRow
from vio.mapping.place_finder import squared
from vio.mapping.place_index import SEGMENT, PlaceIndex, Segment, words_of

CAMERA = StereoCamera(400.0, 400.0, 319.5, 179.5, 0.12, 640, 360)
T_I_J = se3_exp([0.4, -0.1, 0.3, 0.05, -0.2, 0.03])
POINTS = 120


def _bits(count: int, rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 256, (count, 32), dtype=np.uint8)


def _flipped(descriptors: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Descriptors with a share of their bits wrong, as another view gives them."""
    wrong = rng.random((len(descriptors), 256)) < share
    return descriptors ^ np.packbits(wrong, axis=1)


def _views(
    seed: int, sigma_px: float = 1.0, outliers: float = 0.0, stated_px: float | None = None
) -> tuple[KeyframeFeatures, KeyframeFeatures]:
    """Two views of one place, the second at T_I_J, with pixel noise and wrong positions of some
    features.
    """
    rng = np.random.default_rng(seed)
    p = np.stack(
        [rng.uniform(-3, 3, POINTS), rng.uniform(-1.5, 1.5, POINTS), rng.uniform(3, 9, POINTS)],
        axis=1,
    )
    bits = _bits(POINTS, rng)
    out = []
    for points, names in (
        (p, bits),
        (transform_points(se3_inverse(T_I_J), p), _flipped(bits, 0.08, rng)),
    ):
        z = project(CAMERA, points) + sigma_px * rng.standard_normal((POINTS, 4))
        z[rng.random(POINTS) < outliers, :2] += 80.0
        out.append(
            KeyframeFeatures(
                z, rng.random(POINTS) < 0.8, np.full(POINTS, stated_px or sigma_px), names
            )
        )
    return out[0], out[1]


def _error(seed: int, **how: float) -> tuple[FloatArray, FloatArray, int]:
    i, j = _views(seed, **how)
    seen = verify(CAMERA, i, CAMERA, j)
    return se3_log(se3_inverse(seen.pose.T_i_j) @ T_I_J), seen.pose.covariance, seen.inliers


def test_pairs_are_those_of_the_same_points() -> None:
    i, j = _views(1)
    pairs = match(i, j)
    assert len(pairs) > 0.9 * POINTS
    np.testing.assert_array_equal(pairs[:, 0], pairs[:, 1])


def test_the_motion_between_two_views_is_found_within_its_covariance() -> None:
    """Normalised errors of 15 pairs; the covariance is inflated fourfold on purpose, so 6 is not
    reached.
    """
    squared = [float(r @ np.linalg.solve(C, r)) for r, C, _ in (_error(seed) for seed in range(15))]
    assert 0.5 < np.mean(squared) < 6.0
    assert max(squared) < 16.8  # the 99 % quantile of six degrees of freedom


def test_the_covariance_of_a_motion_follows_the_noise_of_its_pixels() -> None:
    """Key points whose pixels are better than stated, as those of rendered and of compressed
    images are.
    """
    ratios = []
    for seed in range(8):
        stated, exact = (_error(seed, sigma_px=0.4, stated_px=px)[1] for px in (1.0, 0.4))
        ratios.append(np.trace(stated) / np.trace(exact))
    assert 0.7 < np.mean(ratios) < 1.4


def test_a_third_of_wrong_pairs_changes_little() -> None:
    r, C, inliers = _error(2, outliers=0.2)
    assert inliers > 0.5 * POINTS
    assert float(r @ np.linalg.solve(C, r)) < 16.8


def test_another_place_does_not_verify() -> None:
    i, _ = _views(1)
    _, j = _views(2)
    assert verify(CAMERA, i, CAMERA, j) is None


def test_equal_descriptors_at_other_positions_do_not_verify() -> None:
    """The geometry decides: the same looks without a common motion."""
    i, j = _views(1)
    order = np.random.default_rng(0).permutation(POINTS)
    moved = KeyframeFeatures(j.z[order], j.has_right[order], j.sigma_px, j.descriptors)
    assert len(match(i, moved)) > MIN_INLIERS
    assert verify(CAMERA, i, CAMERA, moved) is None


def test_too_few_features_do_not_verify() -> None:
    i, j = _views(1)
    assert verify(CAMERA, i, CAMERA, no_keyframe_features()) is None
    few = KeyframeFeatures(j.z[:15], j.has_right[:15], j.sigma_px[:15], j.descriptors[:15])
    assert verify(CAMERA, i, CAMERA, few) is None


def test_the_best_of_near_rows_is_that_of_all_pairs() -> None:
    """Against OpenCV's matcher with a mask; some descriptors are equal, so that the first of
    them counts.
    """
    rng = np.random.default_rng(0)
    v, there, reach = (
        rng.uniform(0, 60, 50),
        rng.uniform(0, 60, 80).round(),
        rng.uniform(0.5, 5.0, 50),
    )
    b = _bits(80, rng)
    b[40:] = b[:40]
    a = _flipped(b[rng.integers(0, 80, 50)], 0.15, rng)
    i, j = _near_rows(v, there, reach)
    rows, best = _most_alike(i, j, a, b)
    mask = (np.abs(v[:, None] - there[None, :]) <= reach[:, None]).astype(np.uint8)
    assert len(i) == mask.sum()
    expected = [m for m in cv2.BFMatcher(cv2.NORM_HAMMING).match(a, b, mask) if m.distance <= 64]
    assert len(expected) > 5
    assert [(m.queryIdx, m.trainIdx) for m in expected] == list(
        zip(rows.tolist(), best.tolist(), strict=True)
    )


def _pair(gain: float) -> list[np.ndarray]:
    """Left and right image (180, 320) of a textured wall at 6.3 px of disparity; the right
    camera's gain falls off.
    """
    rng = np.random.default_rng(3)
    wall = cv2.resize(
        rng.uniform(40, 200, (60, 110)).astype(np.float32),
        (340, 180),
        interpolation=cv2.INTER_CUBIC,
    )
    left, right = (
        cv2.warpAffine(wall, np.array([[1.0, 0, -u], [0, 1, 0]]), (320, 180)) for u in (5.0, 11.3)
    )
    right = right * np.linspace(1.0, gain, 320)
    return [
        np.clip(im + rng.normal(0, 1.5, im.shape), 0, 255).astype(np.uint8) for im in (left, right)
    ]


def test_a_darker_right_camera_leaves_the_disparities_exact() -> None:
    """Cameras with their own exposure control and vignetting differ by this much."""
    errors = []
    for gain in (1.0, 0.6):
        features = extract(*_pair(gain))
        assert features.has_right.sum() > 100
        disparity = (features.z[:, 0] - features.z[:, 2])[features.has_right]
        errors.append(np.quantile(np.abs(disparity - 6.3), 0.9))
    assert max(errors) < 0.1


@pytest.mark.parametrize("earlier", [True, False])
def test_covariance_of_a_neighbour_covers_it(tmp_path: Path, earlier: bool) -> None:
    """On a straight road; a turn at the one end moves the other end, and not the one beside it."""
    sigmas = np.repeat([0.01, 0.002], 3)
    step = se3_from_parts(np.eye(3), np.array([0.0, 0.0, 2.0]))
    squares = []
    with closing(MapStore(tmp_path / "empty.db", create=True)) as store:
        for seed in range(100):
            graph = MapGraph(store)
            graph.sessions = [SessionRow("road", CAMERA, False, 0)]
            rng = np.random.default_rng(seed)
            T_odom: FloatArray = np.eye(4)
            motion = None
            for k in range(11):
                if k > 0:
                    motion = RelativePose(
                        step @ se3_exp(sigmas * rng.normal(size=6)), np.diag(sigmas**2)
                    )
                    T_odom = T_odom @ motion.T_i_j
                drift, path_m = graph.gathered(T_odom, motion)
                graph.append(KeyframeRow(0, k, k, T_odom, T_odom, drift, path_m, None, 0.0))
            origin, other = (9, 1) if earlier else (1, 9)
            found = graph.motions(origin, np.array([other]))[0]
            true = se3_from_parts(np.eye(3), np.array([0.0, 0.0, 2.0 * (other - origin)]))
            squares.append(squared(se3_log(se3_inverse(found.T_i_j) @ true), found.covariance))
    assert 0.8 < np.mean(squares) / 6 < 1.2


def test_features_of_one_corner_agree_from_near_and_from_afar() -> None:
    """An image in half the size shows each corner on other levels, at half its pixel as counted
    from the image's edge.
    """
    rng = np.random.default_rng(5)
    small = rng.uniform(20, 230, (90, 150)).astype(np.float32)
    near = cv2.resize(small, (900, 540), interpolation=cv2.INTER_CUBIC)
    afar = cv2.resize(near, (450, 270), interpolation=cv2.INTER_AREA)
    a, b = (extract(*[np.clip(image, 0, 255).astype(np.uint8)] * 2) for image in (near, afar))
    i, j = match(a, b).T
    apart = a.z[i, :2] - (2 * b.z[j, :2] + 0.5)
    same = np.abs(apart).max(axis=1) < 6
    assert same.sum() > 100
    assert np.abs(np.median(apart[same], axis=0)).max() < 0.25
    assert np.abs(apart[same].mean(axis=0)).max() < 0.25


@pytest.mark.parametrize("size", [(64, 64), (180, 320)])
def test_an_image_without_texture_has_no_features(size: tuple[int, int]) -> None:
    gray = np.full(size, 90, dtype=np.uint8)
    assert len(extract(gray, gray)) == 0


def test_the_index_finds_the_place_that_shares_most_features() -> None:
    rng = np.random.default_rng(5)
    index = PlaceIndex()
    places = [_bits(200, rng) for _ in range(40)]
    for place in places:
        index.add(place)
    query = _flipped(places[17], 0.1, rng)
    query[:80] = _bits(80, rng)  # features that are new
    found = index.candidates(query, np.ones(40, dtype=np.bool_), 3)
    assert found[0] == 17
    forbidden = np.arange(40) != 17
    assert 17 not in index.candidates(query, forbidden, 3)


def test_scores_do_not_depend_on_what_of_the_index_is_merged() -> None:
    """The weight of all shared words, counted one by one, for keyframes in the index and in its
    tail.
    """
    rng = np.random.default_rng(8)
    places = [_bits(int(rng.integers(0, 60)), rng) for _ in range(150)]
    places[7] = np.concatenate([places[7], places[7][:5]])  # a word twice
    index, query = PlaceIndex(), _flipped(np.concatenate(places[3:9]), 0.1, rng)
    for place in places:
        index.add(place)
    words, asked = [words_of(place) for place in places], words_of(query)
    expected = np.zeros(len(places))
    for table in range(len(asked)):
        for word in np.unique(asked[table]):
            shown = np.array([np.count_nonzero(w[table] == word) for w in words])
            expected += shown * np.log((len(places) + 1) / (np.count_nonzero(shown) + 1))
    expected /= np.sqrt(np.maximum([len(place) for place in places], 1))
    np.testing.assert_allclose(index.scores(query), expected, atol=1e-3)
    few = PlaceIndex()
    for place in places[:20]:  # all of them in the tail
        few.add(place)
    assert len(few.scores(query)) == 20
    assert index.nbytes < 2 * 8 * sum(len(place) for place in places) + 2 * 8 * 4 * 2**14 + 10_000


def test_places_of_a_file_give_the_same_scores(tmp_path: Path) -> None:
    """Two segments come from the file, the rest is added again; one whose words are not in order
    is refused.
    """
    rng = np.random.default_rng(9)
    places = [_bits(int(rng.integers(0, 20)), rng) for _ in range(2 * SEGMENT + 40)]
    whole, again, path = PlaceIndex(), PlaceIndex(), tmp_path / "a.map"
    store = MapStore(path, create=True)
    points, stereo = rng.normal(size=(SEGMENT, 32, 3)), np.arange(SEGMENT)
    for place in places:
        whole.add(place)
        if (words := whole.full_segment()) is not None:
            store.add_places(PlacesRow(words, points, stereo))
    store.close()
    store = MapStore(path, read_only=True)
    rows = store.places()
    store.close()
    assert len(rows) == 2
    np.testing.assert_array_equal(rows[1].points, points)
    again.restore([row.words for row in rows])
    for place in places[2 * SEGMENT :]:
        again.add(place)
    query = np.concatenate(places[::7])
    np.testing.assert_array_equal(again.scores(query), whole.scores(query))
    with pytest.raises(ValueError, match="not in order"):
        Segment.of(rows[0].words.begins[:, ::-1].copy(), rows[0].words.owners)


def test_candidates_are_of_different_places() -> None:
    rng = np.random.default_rng(6)
    index = PlaceIndex()
    one, other = _bits(200, rng), _bits(200, rng)
    for k in range(20):
        near = one if k in (4, 5, 6) else other if k in (14, 15) else _bits(200, rng)
        index.add(_flipped(near, 0.05, rng))
    query = np.concatenate([_flipped(one, 0.05, rng), _flipped(other[:100], 0.05, rng)])
    found = index.candidates(query, np.ones(20, dtype=np.bool_), 2).tolist()
    assert found[0] in (4, 5, 6)
    assert found[1] in (14, 15)


def test_an_empty_index_and_an_empty_view_have_no_candidates() -> None:
    index = PlaceIndex()
    bits = _bits(10, np.random.default_rng(0))
    assert index.candidates(bits, np.zeros(0, dtype=np.bool_), 3).tolist() == []
    index.add(no_keyframe_features().descriptors)
    assert index.candidates(bits, np.ones(1, dtype=np.bool_), 3).tolist() == []
    assert (
        index.candidates(no_keyframe_features().descriptors, np.ones(1, dtype=np.bool_), 3).tolist()
        == []
    )


def test_words_are_the_chosen_bits_and_counted_once_a_keyframe() -> None:
    rng = np.random.default_rng(0)
    descriptors = rng.integers(0, 256, (300, 32), dtype=np.uint8)
    bits, index = np.unpackbits(descriptors, axis=1).astype(np.int64), place_index.PlaceIndex()
    expected = np.stack(
        [bits[:, columns] @ (1 << np.arange(14)) for columns in place_index._chosen_bits()]
    )
    np.testing.assert_array_equal(place_index.words_of(descriptors), expected)
    index.add(descriptors)
    index.add(descriptors[:100])
    counts = [np.bincount(row, minlength=1 << 14) > 0 for row in expected]
    again = [np.bincount(row[:100], minlength=1 << 14) > 0 for row in expected]
    np.testing.assert_array_equal(index._frequency, np.add(counts, again, dtype=np.int64))


@pytest.mark.parametrize(("differing", "matched"), [(62, 1), (66, 0)])
def test_a_quarter_of_the_bits_of_two_descriptors_may_differ(differing: int, matched: int) -> None:
    bits = np.zeros(256, dtype=np.uint8)
    bits[:differing] = 1
    one = np.zeros((1, 32), dtype=np.uint8)
    zero = np.zeros(1, dtype=np.int64)
    rows, _ = _most_alike(zero, zero, one, np.packbits(bits)[None])
    assert len(rows) == matched
