"""Each limit of finding a board, and of what is said of a calibration by it, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from tests.board_views import GRID, LEFT
from tests.refused import is_refused
from vio.geometry.lie import FloatArray, se3_from_parts, so3_exp
from vio.targets import calibrate, corners, diagnosis, lenses, recording, seeds
from vio.targets.bundle import MEDIAN_TO_SIGMA, BoardAdjustment
from vio.targets.calibrate import chosen_views, lens_finding
from vio.targets.corners import CornerDetector, Corners
from vio.targets.imu_checks import _agrees, _intervals, _is_still
from vio.targets.inertial import (
    _disagreement_findings,
    _drift_findings,
    _Problem,
    _size_findings,
    _weak,
)
from vio.targets.lenses import LensChoice, _squared, rivals_of
from vio.targets.noise import AllanCurve, axis_noise
from vio.targets.printing import page_of
from vio.targets.recording import Filmed, _frames_wanted
from vio.targets.verdict import (
    Halves,
    _inflation,
    _unequal,
    _unsynchronised,
    coverage_findings,
)
from vio.targets.views import Sightings, View

Says = Callable[[float], bool]


# Corners


DETECTOR: Any = CornerDetector(GRID)
IDS = np.arange(len(GRID.points_m))


def _seen(scale_px: float = 300.0) -> FloatArray:
    """Pixels of the board's corners, facing the camera, so many pixels a metre."""
    return scale_px * GRID.points_m + 50.0


def _kept(off_px: float, noise_px: float = 0.0) -> bool:
    """Whether a corner that is off is believed, among others with noise."""
    uv = _seen() + noise_px * np.random.default_rng(0).normal(size=(len(IDS), 2))
    uv[60, 0] = _seen()[60, 0] + off_px
    return bool(DETECTOR._agree(IDS, uv)[60])


def _enough(count: int) -> bool:
    return bool(DETECTOR._agree(IDS[:count], _seen()[:count]).any())


def _is_reached(pitches: float) -> bool:
    at = GRID.points_m[:1] - [[pitches * GRID.pitch_m, 0.0]]
    return bool(np.isin(0, DETECTOR._within_reach(IDS, at)))


def _refined(
    scale_px: float = 300.0, blur_px: float = 0.5, like: float = 1.0, at: FloatArray | None = None
) -> tuple[bool, str]:
    """Whether a corner is found, and by what: the half window of its saddle point, or print."""
    used: list[str] = []
    n = 60
    H = np.diag([scale_px, scale_px, 1.0])
    H[:2, 2] = (
        200.0 - scale_px * GRID.points_m[n] if at is None else at - scale_px * GRID.points_m[n]
    )
    uv = (H @ np.array([*GRID.points_m[n], 1.0]))[None, :2]

    def saddles(image: Any, uv: FloatArray, half: int) -> FloatArray:
        used.append(str(half))
        return uv

    def prints(image: Any, ids: Any, uv: FloatArray, *_: Any) -> tuple[FloatArray, FloatArray]:
        used.append("print")
        return uv, np.full(len(uv), like)

    image = np.zeros((480, 752), np.uint8)
    with (
        patch.object(corners, "subpixel", saddles),
        patch.object(DETECTOR._aligner, "aligned", prints),
        patch.object(DETECTOR._templates, "likeness", lambda *_: np.full(1, like)),
    ):
        good = DETECTOR._refined(image, np.array([n]), uv, H[None], blur_px)[1]
    return bool(good[0]), used[0] if used else ""


def _looks_alike(contrast: float) -> bool:
    """Whether an image of the print itself is believed, with such a standard deviation."""
    templates = DETECTOR._templates
    light = templates._light[[60]]
    values = contrast * (light - light.mean()) / light.std()
    with patch.object(corners, "gray_at", lambda image, at: values):
        like = templates.likeness(
            np.zeros((480, 752), np.uint8), np.array([60]), np.zeros((1, 2)), _homography()
        )
    return bool(like[0] > 0.9)


def _homography() -> FloatArray:
    H = np.diag([300.0, 300.0, 1.0])
    H[:2, 2] = 50.0
    return H[None]


def _begins(seeds: int) -> bool:
    """Whether a board is found from so many corners."""
    with (
        patch.object(DETECTOR, "_seeds", lambda image: (GRID.points_m[:seeds], _seen()[:seeds])),
        patch.object(DETECTOR, "_blur_px", lambda *_: 0.5),
        patch.object(DETECTOR, "_grown", lambda *_: _seen()),
    ):
        return len(DETECTOR.detect(np.zeros((480, 752), np.uint8))) > 0


# Views


def _filmed(*shifts_px: float, count: int = 20, cameras: int = 1) -> Filmed:
    uv = np.random.default_rng(0).uniform(100.0, 400.0, (count, 2))
    views = [
        View(k, (Corners(np.arange(count), uv + np.array([shift, 0.0])),) * cameras)
        for k, shift in enumerate(shifts_px)
    ]
    return Filmed(views, ((752, 480),) * cameras, 99, None, ())


def _check_views(views: int = 20, count: int = 20) -> bool:
    filmed = _filmed(*(50.0 * np.arange(views)), count=count)
    with (
        patch.object(calibrate, "_diagnosis", lambda *_: None),
        patch.object(calibrate, "clearly_other_board", lambda *_: None),
    ):
        return not is_refused(lambda: calibrate._check_views(filmed, GRID))


def _used_views(views: int) -> int:
    corner = np.tile(np.arange(20), views)
    seen = Sightings(
        GRID.points_m,
        views,
        1,
        np.repeat(np.arange(views), 20),
        np.zeros(20 * views, np.int64),
        corner,
        np.zeros((20 * views, 2)),
    )
    return chosen_views(seen).views


def _fitis_refused(residual_px: float, reason: str | None) -> bool:
    adjusted: Any = SimpleNamespace(residuals_px=np.tile([residual_px, 0.0], (9, 1)))
    with patch.object(calibrate, "_diagnosis", lambda *_: reason):
        return is_refused(lambda: calibrate._check_fit(adjusted, 0, _filmed(), GRID))


def _pairis_refused(refused: float = 0.0, off_px: float = 0.1, turn_deg: float = 0.0) -> bool:
    used = np.arange(1000) >= round(1000 * refused)
    T = se3_from_parts(so3_exp([np.radians(turn_deg), 0.0, 0.0]), np.array([-0.1, 0.0, 0.0]))
    at = SimpleNamespace(T_cam_cam0=np.stack([np.eye(4), T]))
    found: Any = SimpleNamespace(used=used, sigma_px=np.array([off_px]), at=at)
    with patch.object(calibrate, "_shown_twice", lambda *_: None):
        return is_refused(lambda: calibrate._check_pair(found, _filmed(), GRID))


def _rival_is_named(off_px: float, sigma_px: float = 0.0) -> bool:
    rival: Any = SimpleNamespace(off_px=np.array([0.0, off_px]), name="a")
    verdict: Any = SimpleNamespace(
        inflation=1.0,
        projection_sigma_px=(np.full(2, sigma_px),),
        grid=(np.array([[0.0, 0.0], [700.0, 400.0]]),),
    )
    return lens_finding("b", (rival,), verdict) is not None


def _wanted(seconds: float) -> int:
    raw: Any = SimpleNamespace(times_ns=[0, round(1e9 * seconds)])
    return _frames_wanted(raw, has_imu=True)


def _sizes_are_all_read(files: int) -> bool:
    read: list[Any] = []

    def load(file: Any) -> Any:
        read.append(file)
        return (np.zeros((4, 4), np.uint8),)

    with patch.object(recording, "load_gray", load):
        recording._usual_size(list(range(files)))  # type: ignore[arg-type]
    return len(read) == files


# Verdicts


def _is_inflated(ratio: float) -> bool:
    return _inflation(Halves((), 0.0, ratio, 10, ratio)) > 1.0


def _is_empty(share: float) -> bool:
    """Whether a part of the image is called empty that holds a share of the corners."""
    cells = np.stack(np.meshgrid(np.arange(3), np.arange(3)), axis=-1).reshape(-1, 2)
    counts = np.full(9, 1000)
    counts[4] = round(8000 * share / (1.0 - share))
    uv = np.repeat((cells + 0.5) * [752 / 3, 480 / 3], counts, axis=0)
    seen: Any = SimpleNamespace(uv=uv, camera=np.zeros(len(uv), np.int64))
    return bool(coverage_findings(seen, [LEFT]))


def _unsynchronised_by(ratio: float) -> bool:
    found: Any = SimpleNamespace(sigma_px=np.array([ratio, 1.0]))
    return bool(_unsynchronised(found, [1.0, 1.0]))


def _fit_agrees(offset_s: float, unexplained: float) -> bool:
    fit: Any = SimpleNamespace(offset_s=offset_s, unexplained=unexplained)
    return _agrees(fit)


def _gives_rate(step_s: float) -> bool:
    times = np.array([0, round(1e9 * step_s)])
    return len(_intervals(times, np.tile(np.eye(4), (2, 1, 1)))) > 0


def _imu_rests(turn: float = 0.0, push: float = 0.0) -> bool:
    """Whether an IMU is at rest that turns and is pushed so much, over what is seen and gravity."""
    signs = np.where(np.arange(100) % 2, 1.0, -1.0)
    readings = np.zeros((100, 6))
    readings[:, 0] = turn * signs
    readings[:, 3] = 9.81 * push * signs
    readings[:, 5] = 9.81
    readings = np.concatenate([readings, np.tile([0, 0, 0, 0, 0, 9.81], (1, 1))])
    record: Any = SimpleNamespace(means=lambda at: [readings[None]], twists=np.ones((101, 6)))
    record.twists[:, 3:] = [1.0, 0.0, 0.0]
    return _is_still(record)


def _weak_by(place: int, sigma: float) -> bool:
    sigmas = np.zeros(7)
    sigmas[place] = sigma
    return bool(_weak(sigmas))


def _imu_problem(chi: float, views: int = 1001) -> Any:
    """A problem one of whose views is off, by chi-square over its degrees of freedom; others by 1,
    or all as much.
    """
    rows = np.ones((views, 6))
    rows[0] = np.sqrt(chi)
    problem: Any = SimpleNamespace(_camera=lambda at: rows)
    problem._pose_scale = lambda at: _Problem._pose_scale(problem, at)
    return problem


def _weight_of_view(chi: float) -> float:
    problem = _imu_problem(chi)
    weights = _Problem._weights(problem, problem)
    return float(weights[0] / _Problem._weights(_imu_problem(0.0), problem)[0])


# Weights of corners


def _adjustment(views: int = 1, count: int = 1000) -> BoardAdjustment:
    number = np.tile(np.arange(count) % len(IDS), views)
    seen = Sightings(
        GRID.points_m,
        views,
        1,
        np.repeat(np.arange(views), count),
        np.zeros(views * count, np.int64),
        number,
        np.zeros((views * count, 2)),
    )
    return BoardAdjustment(seen)


def _weight_of(sigmas: float, *, cut: bool) -> float:
    """Of a corner that is off by so many standard deviations of the others, over one that fits."""
    r = np.tile([MEDIAN_TO_SIGMA, 0.0], (1000, 1))
    r[0, 0] = sigmas
    r[1, 0] = 0.0
    weights = _adjustment()._weights(r, cut=cut)
    return float(weights[0] / weights[1])


def _usual_sigma() -> float:
    """Of corners whose coordinates have a standard deviation of one."""
    r = np.random.default_rng(0).normal(size=(10_000, 2))
    return float(_adjustment(10)._sigmas(r)[0])


def _least_sigma() -> float:
    return float(_adjustment()._sigmas(np.zeros((1000, 2)))[0])


def _sigma_of_few() -> float:
    """Of an image of eight corners with twice its camera's usual standard deviation."""
    adjustment = _adjustment(1, 8)
    return float(adjustment._by_image(np.full(8, 4.0), np.ones(8, np.bool_), np.ones(1))[0])


def _image_is_used(ratio: float) -> bool:
    """Whether an image is, whose corners are so many times as far off as those of nine others."""
    r = np.tile([MEDIAN_TO_SIGMA, 0.0], (10_000, 1))
    r[:1000] *= ratio
    return bool(_adjustment(10)._weights(r, cut=True)[:1000].any())


def _cost(coefficient: float = 0.0, bow: float = 0.0) -> float:
    """What a lens and the board's bow cost before any view."""
    lens = SimpleNamespace(coefficients=(coefficient,))
    at: Any = SimpleNamespace(cameras=(lens,), bow=np.array([bow, 0.0]))
    return _adjustment()._cost(np.zeros((1000, 2)), np.zeros(1000), at)


WIDTH_M = float(np.ptp(GRID.points_m, axis=0).max())

# Lenses


def _rivals(equal: int) -> int:
    """How many models are compared, of so many that are no worse."""
    choice = LensChoice("a", (), tuple(lenses.LENSES)[:equal])
    seen: Any = None
    with (
        patch.object(
            lenses, "one_camera", lambda *_: SimpleNamespace(at=SimpleNamespace(cameras=[0]))
        ),
        patch.object(lenses, "projection_difference", lambda a, b: np.zeros(1)),
    ):
        return len(rivals_of(choice, LEFT, seen, (752, 480)))


def _judged_models(ratio: float) -> int:
    """How many of two models are judged, the second of which leaves more by a ratio."""
    sigmas = iter([1.0, ratio])
    seen: Any = None
    with (
        patch.object(
            lenses, "one_camera", lambda *_: SimpleNamespace(sigma_px=np.array([next(sigmas)]))
        ),
        patch.object(lenses, "_score", lambda name, seen, whole: name),
    ):
        return len(lenses._scores(seen, (752, 480), list(lenses.LENSES)[:2]))


def _largest_residual() -> float:
    """What a corner counts that is far off, over the others."""
    r = np.tile([1.0, 0.0], (20, 1))
    r[0, 0] = 100.0
    views = SimpleNamespace(view=np.repeat(np.arange(20), 1))
    seen: Any = SimpleNamespace(of_views=lambda chosen: views)
    squared = _squared(r, seen, np.arange(20))
    return float(np.sqrt(squared[0] / squared[1]))


# Markers


def _at_two_places(apart: float) -> bool:
    """Whether a marker is one of two boards, that is read at two places so many sides apart."""
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    reads = [
        seeds.Read(3, 50.0 * square, 0.9),
        seeds.Read(3, 50.0 * (square + np.array([apart, 0.0])), 0.8),
    ]
    return bool(seeds._at_two_places(reads))


PRINTS: Any = seeds._Prints(GRID.markers(), GRID.border_bits)


def _is_read(whole: float = 1.0, code: float = 1.0, second: float = 0.0) -> bool:
    """Whether a candidate is a marker, by its correlation with one and with another."""
    count = len(PRINTS._id)
    is_other = (PRINTS._id != PRINTS._id[0]) | (PRINTS._turn != PRINTS._turn[0])

    def correlation(values: FloatArray, looks: Any, weight: FloatArray) -> FloatArray:
        if looks is PRINTS._whole_looks:
            return np.full((len(values), count), whole)
        return np.tile(np.where(is_other, second, code), (len(values), 1))

    with (
        patch.object(seeds, "_correlation", correlation),
        patch.object(PRINTS, "_sampled", lambda image, quads: np.zeros((len(quads), 1))),
    ):
        found = PRINTS.read(np.zeros((9, 9), np.uint8), np.zeros((1, 4, 2)))
    return len(found) > 0


def _looks(markers: int, rows: int = 6, cols: int = 6) -> int:
    """How often a board is looked at in which so many markers are read at once."""
    reader = seeds.MarkerReader(replace(GRID, rows=rows, cols=cols))
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    reads = [seeds.Read(k, 50.0 * square + 100.0 * k, 0.9) for k in range(markers)]
    looks: list[float] = []
    with (
        patch.object(reader, "_quads", lambda image, scale, grown: looks.append(scale)),
        patch.object(reader._prints, "read", lambda image, quads: reads),
    ):
        reader.find(np.zeros((9, 9), np.uint8))
    return len(looks)


def _has_contrast(deviation: float) -> bool:
    values = deviation * np.where(np.arange(100) % 2, 1.0, -1.0)[None]
    looks = (values / np.linalg.norm(values)).astype(np.float32)
    return bool(seeds._correlation(values, looks, np.ones(100))[0, 0] > 0.9)


def _is_dark(level: int, share: float = 1.0) -> bool:
    """Whether images are called dark, a share of whose pixels are no brighter than a level."""
    image = np.full(10_000, 255, np.uint8)
    image[: round(10_000 * share)] = level
    return diagnosis._darkness([image.reshape(100, 100)]) is not None


def _is_overexposed(share: float) -> bool:
    image = np.zeros(10_000, np.uint8)
    image[: round(10_000 * share)] = 255
    return diagnosis._glare([image.reshape(100, 100)]) is not None


def _other_board(best: float, described: float, read: int = 9) -> bool:
    """Whether another arrangement is named, by the misfits of both."""
    other = SimpleNamespace(cols=9, legacy=False, ratio=0.3)

    def misfit(read: Any, target: Any) -> float:
        return best if target is other else described

    with (
        patch.object(diagnosis, "_most_read", lambda *_: []),
        patch.object(diagnosis, "_close_together", lambda found: [0] * read),
        patch.object(diagnosis, "_arrangements", lambda target: [other]),
        patch.object(diagnosis, "_misfit", misfit),
    ):
        return diagnosis._other_arrangement([], GRID) is not None


def _compared(markers: int) -> int:
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    reads = [seeds.Read(k, 9.0 * square + 20.0 * k, 0.9) for k in range(markers)]
    return len(diagnosis._close_together(reads))


# Noise at rest, and prints


def _white_noise() -> FloatArray:
    """What a curve shows as white noise and as instability, over the noise of up to 0.7 s; that of
    up to a second is twice as much, and then four times.
    """
    tau = 10.0 ** np.arange(-1.0, 2.01, 0.1)
    times = np.where(tau < 0.7, 1.0, np.where(tau < 1.01, 2.0, 4.0))
    curve = AllanCurve(tau, times / np.sqrt(tau), np.full(len(tau), 0.1))
    found = axis_noise(curve)
    return np.array([found.white.value, found.instability.value / curve.deviation.min()])


def _page() -> FloatArray:
    """Left and upper margin, the ruler's ticks and the height below a board, mm."""
    page = page_of(GRID)
    board = len(GRID.dark_rectangles())
    ticks = page.rectangles[board:-1]
    below = page.height - page.rectangles[:board, 3].max()
    left, top = page.rectangles[:board, :2].min(axis=0)
    return np.array([left, top, ticks[1, 0] - ticks[0, 0], below])


def test_a_ruler_has_centimetres() -> None:
    assert _page()[2] == pytest.approx(10.0)


def test_instability_is_that_of_flicker_noise() -> None:
    """IEEE Std 952: the lowest Allan deviation is sqrt(2 ln 2 / pi) of it."""
    assert 1 / _white_noise()[1] == pytest.approx(np.sqrt(2 * np.log(2) / np.pi), rel=1e-3)


LIMITS: dict[str, tuple[Says, float, float]] = {
    "corners: off": (lambda x: not _kept(x), 0.28, 0.33),
    "corners: off, among noise": (lambda x: not _kept(x, 0.2), 1.4, 1.7),
    "corners: few": (lambda n: _enough(int(n)), 7, 8),
    "corners: seeds": (lambda n: _begins(int(n)), 3, 4),
    "corners: reach": (lambda x: not _is_reached(x), 1.4, 1.5),
    "corners: border": (lambda x: _refined(at=np.array([x, 200.0]))[0], 2.9, 3.1),
    "corners: tag": (lambda x: _refined(x / GRID.size_m)[0], 11.5, 12.5),
    "corners: smallest window": (
        lambda n: int(_refined(12.5 / GRID.size_m)[1]) < n,
        2,
        3,
    ),
    "corners: largest window": (lambda n: int(_refined(3e3)[1]) < n, 9, 10),
    "corners: like the print": (lambda x: _refined(like=x)[0], 0.45, 0.55),
    "corners: blurred": (lambda x: _refined(blur_px=x)[1] == "print", 1.4, 1.6),
    "corners: like the blurred print": (
        lambda x: _refined(blur_px=3.0, like=x)[0],
        0.75,
        0.85,
    ),
    "corners: contrast": (_looks_alike, 11.0, 13.0),
    "views: few": (lambda n: _check_views(int(n)), 7, 8),
    "views: corners": (lambda n: _check_views(count=int(n)), 11, 12),
    "views: used": (lambda n: _used_views(int(n)) < n, 60, 61),
    "views: differ": (lambda x: calibrate._places(_filmed(0.0, x), 0) > 1, 1.9, 2.1),
    "fit: doubtful": (lambda x: _fitis_refused(x, "a"), 0.45, 0.55),
    "fit: refused": (lambda x: _fitis_refused(x, None), 2.8, 3.2),
    "pair: corners": (lambda x: _pairis_refused(x), 0.28, 0.32),
    "pair: off": (lambda x: _pairis_refused(off_px=x), 2.8, 3.2),
    "pair: turned": (lambda x: _pairis_refused(turn_deg=x), 58.0, 62.0),
    "lens: differs": (_rival_is_named, 0.09, 0.11),
    "lens: differs in sigmas": (lambda x: _rival_is_named(x, 1.0), 1.9, 2.1),
    "frames: with an IMU": (lambda x: _wanted(x) > _wanted(0.0), 15.0, 17.0),
    "frames: most": (lambda x: _wanted(x) == _wanted(1e4), 78.0, 81.0),
    "frames: measured": (lambda n: not _sizes_are_all_read(int(n)), 5, 6),
    "halves": (_is_inflated, 1.48, 1.57),
    "image: empty": (lambda x: not _is_empty(x), 0.009, 0.011),
    "pair: moments": (_unsynchronised_by, 1.45, 1.55),
    "pair: unequal": (lambda x: bool(_unequal([1.0, x])), 1.9, 2.1),
    "IMU: weak position": (lambda x: _weak_by(0, x), 0.0048, 0.0052),
    "IMU: weak rotation": (lambda x: _weak_by(3, np.radians(x)), 0.19, 0.21),
    "IMU: weak time": (lambda x: _weak_by(6, x), 0.95e-3, 1.05e-3),
    "IMU: drift": (lambda x: bool(_drift_findings(x, 1e-6, 1e4)), 4.8e-6, 5.2e-6),
    "IMU: drift over the record": (lambda x: bool(_drift_findings(1.0, 0.0, x)), 0.95e-3, 1.05e-3),
    "IMU: disagrees": (lambda x: bool(_disagreement_findings(x)), 3.8, 4.2),
    "IMU: size": (lambda x: bool(_size_findings(x, 0.0)), 0.019, 0.021),
    "IMU: size in sigmas": (lambda x: bool(_size_findings(x, 1.0)), 3.8, 4.2),
    "IMU: weight of a view": (lambda x: _weight_of_view(x) < 0.5, 8.5, 9.5),
    "IMU: least scale": (
        lambda x: _Problem._pose_scale(_imu_problem(0.01, 1), None) < x,  # type: ignore[arg-type]
        0.9,
        1.1,
    ),
    "noise: white": (lambda x: bool(_white_noise()[0] < x), 1.1, 1.3),
    "print: margin": (lambda x: bool(_page()[0] < x), 14.0, 16.0),
    "print: ruler": (lambda x: bool(_page()[3] < x), 32.0, 34.0),
    "corner: usual sigma": (lambda x: _usual_sigma() < x, 0.98, 1.02),
    "corner: a quarter": (lambda x: _weight_of(x, cut=False) < 0.25, 2.8, 3.2),
    "corner: cut": (lambda x: _weight_of(x, cut=True) == 0.0, 4.3, 4.7),
    "corner: least sigma": (lambda x: _least_sigma() < x, 0.009, 0.011),
    "image: few corners": (lambda x: _sigma_of_few() < x, 1.5, 1.66),
    "image: far off": (lambda x: not _image_is_used(x), 4.6, 5.4),
    "lens: prior": (lambda x: _cost(x) > 1.0, 9.0, 11.0),
    "board: bow": (lambda x: _cost(bow=x * WIDTH_M) > 1.0, 0.009, 0.011),
    "board: enough markers": (lambda n: _looks(int(n)) == 1, 7, 8),
    "board: enough of few markers": (lambda n: _looks(int(n), 2, 3) == 1, 3, 4),
    "lens: rivals": (lambda n: _rivals(int(n)) < n, 2, 3),
    "lens: hopeless": (lambda x: _judged_models(x) < 2, 2.8, 3.2),
    "lens: far corners": (lambda x: _largest_residual() < x, 2.8, 3.2),
    "marker: two places": (_at_two_places, 0.45, 0.55),
    "marker: likeness": (lambda x: _is_read(whole=x), 0.7, 0.8),
    "marker: code": (lambda x: _is_read(code=x), 0.65, 0.75),
    "marker: lead": (lambda x: _is_read(second=1.0 - x), 0.09, 0.11),
    "marker: contrast": (_has_contrast, 4.5, 5.5),
    "images: dark": (lambda n: not _is_dark(int(n)), 39, 42),
    "images: dark pixels": (lambda x: _is_dark(9, x), 0.985, 0.995),
    "images: bright": (_is_overexposed, 0.28, 0.32),
    "board: another": (lambda x: not _other_board(0.1 * x, 0.1), 0.38, 0.42),
    "board: misfit": (lambda x: not _other_board(x, 1.0), 0.14, 0.16),
    "board: markers": (lambda n: _other_board(0.0, 1.0, int(n)), 3, 4),
    "board: compared": (lambda n: _compared(int(n)) < n, 9, 10),
    "IMU: near": (lambda x: not _fit_agrees(x, 0.06), 0.14, 0.16),
    "IMU: far": (lambda x: not _fit_agrees(1.0, x), 0.045, 0.055),
    "IMU: steps": (lambda x: not _gives_rate(x), 0.45, 0.55),
    "IMU: turns": (lambda x: not _imu_rests(x), 0.045, 0.055),
    "IMU: is pushed": (lambda x: not _imu_rests(0.0, x), 0.045, 0.055),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_boards(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
