"""Each limit of the front end's rules, from both sides."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.frontend.test_frontend_scene import CAMERA
from vio.findings import Finding
from vio.frontend.expected_motion import AGREEMENT_LIMIT, ExpectedMotion
from vio.frontend.moving_object import TwoMotions, _elected, _if_large
from vio.frontend.object_report import ObjectReport
from vio.frontend.outliers import Consensus
from vio.frontend.reappearance import contradicts_gyro, is_long_gap
from vio.frontend.right_camera import RightCamera
from vio.frontend.right_delay import PairingCounts, RightDelay
from vio.frontend.right_turn import PairShake, RightTurn
from vio.geometry.lie import se3_exp
from vio.records import MotionPrior

Says = Callable[[float], bool]


def _codes(found: tuple[Finding, ...]) -> list[str]:
    return [f"-{finding.code}" if finding.ended else finding.code for finding in found]


# The right camera


def _usable(share: float, points: int = 100) -> bool:
    matched = np.arange(points) < round(share * points)
    return RightCamera().check_matches(0, matched, moved=True)


def _usable_again(points: int, share: float = 1.0, frames: int = 3, *, moved: bool = True) -> bool:
    """Whether a right camera that contradicted is, after frames that agree or tell nothing."""
    camera = RightCamera()
    camera.check_matches(0, np.zeros(50, dtype=np.bool_), moved=True)
    matched = np.arange(points) < round(share * points)
    return [camera.check_matches(k, matched, moved=moved) for k in range(1, frames + 1)][-1]


def _reported(frames: int) -> list[str]:
    camera = RightCamera()
    for k in range(20):
        camera.check_matches(k, np.ones(50, dtype=np.bool_), moved=True)
    for k in range(20, 20 + frames):
        camera.check_matches(k, np.zeros(50, dtype=np.bool_), moved=True)
    return _codes(camera.take_findings())


def _stays(offsets: list[float]) -> bool:
    turn = RightTurn(100.0)
    return [turn.frame(k, offset) for k, offset in enumerate(offsets)][-1] is not None


def _shaking(off: int, on: int = 0) -> bool:
    """Whether all offsets count, after frames that are off by another amount each."""
    turn = RightTurn(100.0)
    offsets = [(-1.0) ** k * (1.0 + k) for k in range(off)] + [0.0] * on
    for k, offset in enumerate(offsets):
        turn.frame(k, offset)
    return turn.is_offset(0.05)


def _shake(px: float, frames: int = 20) -> PairShake:
    shake = PairShake(100.0)
    for k in range(frames):
        shake.frame(k, px * (-1) ** k, 100)
    return shake


RIGHT: dict[str, tuple[Says, float, float]] = {
    "contradicts": (_usable, 0.27, 0.33),
    "contradicts: points": (lambda n: not _usable(0.0, int(n)), 19, 20),
    "agrees: points": (lambda n: _usable_again(int(n)), 5, 6),
    "agrees: share": (lambda x: _usable_again(100, x), 0.55, 0.65),
    "agrees: frames": (lambda n: _usable_again(50, frames=int(n)), 2, 3),
    "nothing to test by": (lambda n: _usable_again(0, frames=int(n), moved=False), 39, 40),
    "contradicts: frames": (lambda n: _reported(int(n)) != [], 3, 4),
    "turned: frames": (lambda n: _stays([2.0] * int(n)), 5, 6),
    "turned: alike": (lambda x: not _stays([2.0 + 2 * x, 2.0 - 2 * x] * 3), 0.043, 0.057),
    "turned: offset": (lambda x: _stays([x] * 6), 0.26, 0.34),
    "turned: jump": (lambda x: RightTurn(100.0).is_jump(x), 0.43, 0.57),
    "shakes: frames that are off": (lambda n: _shaking(int(n)), 4, 5),
    "shakes: frames since": (lambda n: not _shaking(5, int(n)), 14, 17),
    "shakes: scatter": (lambda x: _shake(x).right_factor > 1.0, 0.095, 0.13),
    "shakes: frames that are known": (lambda n: _shake(1.0, int(n)).right_factor > 1.0, 9, 10),
    "shakes: weight": (lambda x: _shake(x).right_factor > 10.0, 0.26, 0.34),
}


@pytest.mark.parametrize(("says", "below", "above"), RIGHT.values(), ids=RIGHT)
def test_limits_of_the_right_camera(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


# Objects


def _two(share: float, of_scene: float = 0.5) -> TwoMotions:
    inliers = np.arange(100) < round(100 * of_scene)
    return TwoMotions(Consensus(np.eye(4), inliers), share, "predicted" if share else None)


def _said(frames: list[bool]) -> list[str]:
    report = ObjectReport()
    for k, has_object in enumerate(frames):
        report.frame(k, _two(0.4 * has_object))
    return _codes(report.take_findings())


def _hidden(of_scene: float, known: int = 3, frames: int = 3) -> bool:
    report = ObjectReport()
    for k in range(known):
        report.frame(k, _two(0.4))
    return [report.hides_scene(k, _two(0.4, of_scene)) for k in range(frames)][-1]


def _now_and_then(every: int) -> list[bool]:
    return [k % every == 0 for k in range(4 * every + 1)]


OBJECTS: dict[str, tuple[Says, float, float]] = {
    "frames": (lambda n: _said([True] * int(n)) != [], 4, 5),
    "frames among the last": (lambda every: _said(_now_and_then(int(every))) == [], 3, 4),
    "over": (lambda n: len(_said([True] * 5 + [False] * int(n))) == 2, 19, 20),
    "hides: share": (lambda x: not _hidden(x), 0.09, 0.12),
    "hides: known": (lambda n: _hidden(0.0, known=int(n)), 1, 2),
    "hides: frames": (lambda n: _hidden(0.0, frames=int(n)), 2, 3),
}


@pytest.mark.parametrize(("says", "below", "above"), OBJECTS.values(), ids=OBJECTS)
def test_limits_of_objects(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


def _disagrees(
    off: list[float], points: int = 200, ahead_m: float = 0.0, error_px: float = 0.0
) -> bool:
    """Whether a motion that is fitted to points is too far off an exact prediction."""
    rng = np.random.default_rng(0)
    p = rng.uniform([-3.0, -2.0, 5.0], [3.0, 2.0, 10.0], (points, 3))
    predicted = se3_exp([0.0, 0.0, ahead_m, 0.0, 0.0, 0.0])
    expected = ExpectedMotion(CAMERA, MotionPrior(predicted, 1e-14 * np.eye(6)), error_px)
    return expected.distance(se3_exp(off) @ predicted, p) > AGREEMENT_LIMIT


EXPECTED: dict[str, tuple[Says, float, float]] = {
    "rotation": (lambda x: _disagrees([0, 0, 0, 0, 1e-3 * x, 0]), 1.05, 1.3),
    "rotation, few points": (lambda x: _disagrees([0, 0, 0, 0, 1e-3 * x, 0], 20), 1.65, 2.1),
    "length": (lambda x: _disagrees([0, 0, x, 0, 0, 0], ahead_m=20.0), 1.05, 1.3),
    "disparities": (
        lambda x: _disagrees([0, 0, x, 0, 0, 0], ahead_m=20.0, error_px=0.3),
        1.65,
        2.1,
    ),
}


@pytest.mark.parametrize(("says", "below", "above"), EXPECTED.values(), ids=EXPECTED)
def test_limits_of_expected_motions(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


# A right camera that is late, tracks after gaps, votes


def _suspected(points: int, late: int, same: int, early: int, frames: int = 2) -> bool:
    delay = RightDelay(CAMERA)
    counts = PairingCounts(points, same, late, early)
    return [delay.suspect(k, counts, 0.1) for k in range(frames)][-1]


def _found_delay(
    frames_late: float,
    frames: int = 40,
    matches: int = 200,
    noise_px: float = 0.05,
    then: float | None = None,
) -> float:
    """The delay that is taken out, of rows that move by it; `then`: the delay of two hundred
    frames more.
    """
    rng = np.random.default_rng(0)
    delay = RightDelay(CAMERA)
    late = [frames_late] * frames + ([] if then is None else [then] * 200)
    for k, each in enumerate(late):
        left = rng.uniform([10.0, 10.0], [300.0, 200.0], (matches, 2))
        flow = rng.normal([0.0, 6.0 * np.sin(0.7 * k)], 1.0, (matches, 2))
        rows = -each * flow[:, 1] + rng.normal(0.0, noise_px, matches)
        delay.update(k, left, flow, rows, 0.1)
    return delay.frames


def _contradicts(deg: float) -> bool:
    motion = MotionPrior(se3_exp(np.zeros(6)), 1e-10 * np.eye(6))
    return contradicts_gyro(se3_exp([0, 0, 0, 0, np.radians(deg), 0]), motion)


def _elects(first: int, second: int) -> bool:
    follows = np.arange(first + second) < first
    return _elected(follows, ~follows) is not None


OTHERS: dict[str, tuple[Says, float, float]] = {
    "late: share": (lambda n: _suspected(100, int(n), 10, 10), 38, 42),
    "late: clearly": (lambda n: _suspected(100, int(n), 40, 10), 58, 62),
    "late: points": (lambda n: _suspected(int(n), int(n), 0, 0), 29, 30),
    "late: frames": (lambda n: _suspected(100, 90, 10, 10, int(n)), 1, 2),
    "late: by rows": (lambda x: _found_delay(x) != 0.0, 0.22, 0.28),
    "late: frames by rows": (lambda n: _found_delay(0.5, int(n)) != 0.0, 9, 10),
    "late: matches by rows": (lambda n: _found_delay(0.5, matches=int(n)) != 0.0, 29, 30),
    "late: whole frames": (lambda x: _found_delay(1.0 - x) != 1.0, 0.13, 0.17),
    "late: explained": (lambda x: _found_delay(0.5, 300, 900, x) == 0.0, 3.0, 4.0),
    "late: forgotten": (lambda x: _found_delay(0.5, then=x) != 0.0, 0.085, 0.115),
    "late: sigmas": (lambda x: _found_delay(0.5, 10, 40, noise_px=x) == 0.0, 1.5, 2.0),
    "gap: seconds": (lambda x: is_long_gap(round(1e9 * x), 10_000_000), 0.72, 0.88),
    "gap: steps": (lambda x: is_long_gap(round(4e8 * x), 400_000_000), 4.5, 5.5),
    "gap: contradicts the gyro": (_contradicts, 1.2, 1.45),
    "votes: points": (lambda n: _elects(int(n), 0), 11, 12),
    "votes: share": (lambda n: _elects(int(n), 100 - int(n)), 66, 74),
    "votes: object": (lambda x: _if_large(x) > 0.0, 0.22, 0.28),
}


@pytest.mark.parametrize(("says", "below", "above"), OTHERS.values(), ids=OTHERS)
def test_limits_of_delays_gaps_and_votes(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
