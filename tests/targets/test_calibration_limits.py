"""Each limit of finding a board, and of what is said of a calibration by it, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from tests.board_views import GRID, LEFT
from vio.errors import VioError
from vio.geometry.lie import FloatArray, se3_from_parts, so3_exp
from vio.targets import calibrate, corners, recording
from vio.targets.calibrate import chosen_views, lens_finding
from vio.targets.corners import CornerDetector, Corners
from vio.targets.imu_checks import _agrees, _intervals, _is_still
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


def _is_refused(call: Callable[[], object]) -> bool:
    try:
        call()
    except VioError:
        return True
    return False


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
        return not _is_refused(lambda: calibrate._check_views(filmed, GRID))


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


def _fit_is_refused(residual_px: float, reason: str | None) -> bool:
    adjusted: Any = SimpleNamespace(residuals_px=np.tile([residual_px, 0.0], (9, 1)))
    with patch.object(calibrate, "_diagnosis", lambda *_: reason):
        return _is_refused(lambda: calibrate._check_fit(adjusted, 0, _filmed(), GRID))


def _pair_is_refused(refused: float = 0.0, off_px: float = 0.1, turn_deg: float = 0.0) -> bool:
    used = np.arange(1000) >= round(1000 * refused)
    T = se3_from_parts(so3_exp([np.radians(turn_deg), 0.0, 0.0]), np.array([-0.1, 0.0, 0.0]))
    at = SimpleNamespace(T_cam_cam0=np.stack([np.eye(4), T]))
    found: Any = SimpleNamespace(used=used, sigma_px=np.array([off_px]), at=at)
    with patch.object(calibrate, "_shown_twice", lambda *_: None):
        return _is_refused(lambda: calibrate._check_pair(found, _filmed(), GRID))


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
    "fit: doubtful": (lambda x: _fit_is_refused(x, "a"), 0.45, 0.55),
    "fit: refused": (lambda x: _fit_is_refused(x, None), 2.8, 3.2),
    "pair: corners": (lambda x: _pair_is_refused(x), 0.28, 0.32),
    "pair: off": (lambda x: _pair_is_refused(off_px=x), 2.8, 3.2),
    "pair: turned": (lambda x: _pair_is_refused(turn_deg=x), 58.0, 62.0),
    "lens: differs": (_rival_is_named, 0.09, 0.11),
    "lens: differs in sigmas": (lambda x: _rival_is_named(x, 1.0), 1.9, 2.1),
    "frames: with an IMU": (lambda x: _wanted(x) > _wanted(0.0), 15.0, 17.0),
    "frames: most": (lambda x: _wanted(x) == _wanted(1e4), 78.0, 81.0),
    "frames: measured": (lambda n: not _sizes_are_all_read(int(n)), 5, 6),
    "halves": (_is_inflated, 1.48, 1.57),
    "image: empty": (lambda x: not _is_empty(x), 0.009, 0.011),
    "pair: moments": (_unsynchronised_by, 1.45, 1.55),
    "pair: unequal": (lambda x: bool(_unequal([1.0, x])), 1.9, 2.1),
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
