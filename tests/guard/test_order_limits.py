"""Each limit of the orders of depths, of rotations of pairs and of the rarer checks of matches, from
both sides.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.guard.test_limits import NOTHING, _grays, _images, _lost, _never, _rows, _shares
from tests.guard.test_matches import CAMERA, STEP_NS
from vio.calibration.pair_rotation import PairRotation
from vio.errors import DataError
from vio.findings import Finding
from vio.frontend.keypoints import Keypoints
from vio.frontend.moving_object import MovedPoints
from vio.frontend.outliers import Consensus, RansacProblem
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import project, triangulate
from vio.guard import exchange, probe, turned_pair, turned_points
from vio.guard.depth_order import have_same_order, keeps_depth_order
from vio.guard.displaced_matches import DisplacedMatches
from vio.guard.exchanged_matches import ExchangedMatches
from vio.guard.frozen_matches import FrozenMatches
from vio.guard.guarded import _few_matches
from vio.guard.image_change import image_change
from vio.guard.late_matches import LateMatches
from vio.guard.match_check import SharedMatches
from vio.guard.object_matches import ObjectMatches
from vio.guard.pairing import PairingCheck
from vio.guard.probe import RowProbe
from vio.guard.turned_pair import TurnedPair
from vio.guard.turned_points import TurnedPoints, matched_rows
from vio.records import Observations, observations

Says = Callable[[float], bool]
DEG = np.pi / 180.0


# Orders


def _ordered(count: int, reversed_: int = 0) -> bool:
    """Whether numbers rise with others, of which some in a row come in reverse; their rank
    correlation is one less `2 m (m - 1) / (n (n - 1))`.
    """
    other = np.arange(float(count))
    other[:reversed_] = other[:reversed_][::-1].copy()
    return have_same_order(np.arange(float(count)), other)


def _points(pixels: FloatArray) -> Keypoints:
    """Key points whose descriptors are those of no other."""
    return Keypoints(pixels, (100.0 * np.eye(len(pixels))).astype(np.float32))


def _keeps_order(rows_px: float) -> bool:
    """Whether points keep their order, whose rows differ by some pixels in the pair before."""
    rng = np.random.default_rng(0)
    left = rng.uniform(50.0, 300.0, (60, 2))
    right = left - np.column_stack([rng.uniform(2.0, 20.0, 60), np.zeros(60)])
    off = right + np.array([0.0, rows_px])
    pairs = iter([[_points(left), _points(off)], [_points(left), _points(right)]])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "vio.guard.depth_order.OpenCvExtractor", lambda *_: lambda *images: next(pairs)
        )
        nothing: Any = (_grays(), _grays())
        return keeps_depth_order(nothing, nothing)


def _fine_contrast() -> float:
    """Contrast that a thumbnail has of independent pixels of contrast 50."""
    signs = np.sign(np.random.default_rng(0).normal(size=(240, 384)))
    return float(exchange._thumbnail((128.0 + 50.0 * signs).astype(np.uint8)).std())


def _is_clipped(level: int) -> bool:
    """Whether pixels are left out of a comparison that are so bright."""
    image = _grays(20.0)
    image[:60] = level
    other = image.copy()
    other[:60] = level - 30
    return image_change(image, other) < 1e-9


ORDERS: dict[str, tuple[Says, float, float]] = {
    "points": (lambda n: _ordered(int(n)), 19, 20),
    # correlations of 0.21 and 0.19
    "correlation": (lambda m: not _ordered(400, int(m)), 250, 257),
    "sigmas": (lambda m: not _ordered(20, int(m)), 11, 12),
    "rows": (lambda x: not _keeps_order(x), 1.3, 1.7),
    "clipped": (lambda n: _is_clipped(int(n)), 248, 252),
    "thumbnail": (lambda x: _fine_contrast() < x, 5.2, 6.7),
}


# Pairs that are turned


def _rotation(deg: Sequence[float] = (0, 0, 0), sigma_deg: float = 0.0, **more: Any) -> Any:
    given = {"points": 100, "share": 1.0} | more
    return PairRotation(DEG * np.array(deg), (DEG * sigma_deg) ** 2 * np.eye(3), **given)


def _is_yawed(sigma_deg: float) -> bool:
    found = _rotation((0.0, 5.0, 0.0), sigma_deg)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(turned_pair, "rotation_by_rows", lambda *_: found)
        patch.setattr(turned_pair, "rotation_by_motion", lambda *_: found)
        return TurnedPair(CAMERA, RowProbe())._is_yawed(NOTHING)


def _is_given_up(frames: int) -> bool:
    pair = TurnedPair(CAMERA, RowProbe())
    pair._onset = 7
    pair.rotation = np.zeros(3)
    for _ in range(frames):
        pair._give_up()
    return pair.rotation is None


def _pairs_taken(frames: int) -> int:
    """Pairs that are taken of a rig that does not move."""
    taken: list[object] = []
    points = SimpleNamespace(add=lambda raw: not taken.append(raw), complete=False)
    pair = TurnedPair(CAMERA, RowProbe())
    pair._looks_at = "pairs"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(turned_points, "TurnedPoints", lambda *_, **__: points)
        for _ in range(frames):
            pair._add_pair(_images(0))
    return len(taken)


def _matches_descriptor(ratio: float) -> bool:
    """Whether a descriptor is matched whose second-nearest is further by this ratio."""
    one = Keypoints(np.zeros((2, 2)), np.array([[0.0, 0.0], [90.0, 90.0]], np.float32))
    other = Keypoints(np.zeros((2, 2)), np.array([[0.0, ratio], [1.0, 0.0]], np.float32))
    return 0 in matched_rows(one, other)[0]


def _turned(**more: Any) -> Any:
    points: Any = TurnedPoints(CAMERA, rows_may_agree=True)
    for name, value in more.items():
        setattr(points, name, value)
    return points


def _by_rows(share: float) -> bool:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(turned_points, "rotation_by_rows", lambda *_: _rotation(share=share))
        return _turned()._by_rows(np.zeros((1, 4))) is not None


def _is_constant(apart_deg: float, sigma_deg: float = 0.0) -> bool:
    both = [_rotation((apart_deg * k, 0, 0), sigma_deg) for k in range(2)]
    return turned_points._is_constant(both)


def _fits_other(frames_late: int = 1, points: int = 200) -> bool:
    """Whether pairs are of images some frames apart, of which so many points agree, 100 as given."""
    pairs = [SimpleNamespace(left=-k, right=k) for k in range(7)]
    turned = _turned(_pairs=pairs, _rows=[_rotation()])
    turned._by_rows = lambda z: _rotation(points=points) if z == frames_late else None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(turned_points, "pixels_in_both", lambda left, right: right + left)
        return bool(turned._fits_another_time())


def _yaw_sigma_deg() -> float:
    turned = _turned(_pairs=[0, 1], _rows=[_rotation(), _rotation()])
    turned._by_motion = lambda *_: _rotation(sigma_deg=1e-4)
    return float(turned._rotation().sigmas[1] / DEG)


TURNED: dict[str, tuple[Says, float, float]] = {
    "yaw: sigma": (lambda x: not _is_yawed(x), 0.17, 0.23),
    "frames that contradict": (lambda n: _is_given_up(int(n)), 20, 21),
    "frames at rest": (lambda n: _pairs_taken(int(n)) > 1, 21, 22),
    "descriptors": (lambda x: not _matches_descriptor(x), 0.7, 0.8),
    "share": (_by_rows, 0.7, 0.8),
    "pairs": (lambda n: _turned(_pairs=[0] * int(n)).complete, 5, 6),
    "alike": (lambda x: not _is_constant(x), 0.087, 0.113),
    "alike: sigmas": (lambda x: not _is_constant(x, 0.1), 0.45, 0.55),
    "late: frames": (lambda n: not _fits_other(int(n)), 3, 4),
    "late: clearly": (lambda n: _fits_other(points=int(n)), 105, 115),
    "yaw: lenses": (lambda x: _yaw_sigma_deg() < x, 0.043, 0.057),
}


# Matches


def _learned_px(frames: int) -> float:
    """What a field of rows says after thirty exact frames and some that are off by half a pixel."""
    check = DisplacedMatches(CAMERA)
    for k in range(30 + frames):
        check.inspect(_rows(k, 400, 0.5 * (k >= 30), 0.02), NOTHING)
    return float(check._field[0])


def _exchanged(share: float, frames: int = 5, negative_px: float = 20.0) -> bool:
    """Whether a recording is refused of whose disparities a share is negative."""
    check = ExchangedMatches()
    try:
        for k in range(frames):
            seen = _rows(k, 100, 0.0, 0.0)
            z = seen.z.copy()
            count = round(100 * share)
            z[:count, 2] = z[:count, 0] + negative_px
            check.inspect(replace(seen, z=z))
    except DataError:
        return True
    return False


def _frozen(left_px: float = 10.0, right_px: float = 0.0, count: int = 30) -> bool:
    check = FrozenMatches()
    before = np.full((count, 4), 100.0)
    now = before + np.array([left_px, 0.0, right_px, 0.0])
    for _ in range(4):
        shared = SharedMatches(np.arange(count), before, now, 0.1)
        check.inspect(_rows(0, count, 0.0, 0.0), shared)
    return bool(check.take_findings())


def _hardly_matched(count: int, share: float) -> bool:
    return _few_matches(_shares([share], count)[0])


def _paired_anew(frames: int) -> bool:
    """Whether a delay of a whole frame that is found then was there from the start."""
    found = Finding("right-image-late", "", 0, figures={"delay_frames": 1.0})
    check = LateMatches(CAMERA)
    delay: Any = SimpleNamespace(frames=1.0, update=lambda *_: None, take_findings=lambda: (found,))
    check._delay = delay
    codes: list[str] = []
    for k in range(frames):
        check.inspect(_rows(k, 5, 0.0, 0.0), NOTHING)
        codes = [finding.code for finding in check.take_findings()]
    return "pairs-shifted" in codes


class _Scene:
    """Keeps what a choice of motions is given."""

    active = False

    def __init__(self) -> None:
        self.found: Consensus | None = None

    def take_findings(self) -> list[Finding]:
        return []

    def choose(
        self, index: int, problem: RansacProblem, points: MovedPoints, found: Consensus, *_: object
    ) -> Any:
        self.found = found
        return SimpleNamespace(motion=found, hidden=False, object_share=0.0)


def _seen(k: int, off_px: float = 0.0, noise_px: float = 0.0) -> Observations:
    """A scene at rest, of whose features the first is off, and all others scatter."""
    rng = np.random.default_rng(0)
    p = rng.uniform([-3.0, -2.0, 5.0], [3.0, 2.0, 9.0], (80, 3))
    z = project(CAMERA, p)
    angle = np.random.default_rng(k).uniform(0.0, 2.0 * np.pi, 80)
    z[:, :2] += noise_px * np.column_stack([np.cos(angle), np.sin(angle)])
    z[0, 1] += off_px
    return observations(k, k * STEP_NS, np.arange(80), z)


def _is_outlier(off_px: float, noise_px: float = 0.0) -> bool:
    objects = ObjectMatches(CAMERA)
    scene: Any = _Scene()
    objects._scene = scene
    for k in range(12):
        objects.inspect(_seen(k, off_px * (k == 11), noise_px), None)
    assert scene.found is not None
    return not scene.found.inliers[0]


def _judges(frames: int) -> bool:
    objects = ObjectMatches(CAMERA)
    scene: Any = _Scene()
    objects._scene = scene
    for k in range(frames):
        objects.inspect(_seen(k), None)
    return scene.found is not None


def _usual_px(errors_px: list[float]) -> float:
    objects = ObjectMatches(CAMERA)
    z = _seen(0).z
    p, _ = triangulate(CAMERA, z)
    still = Consensus(np.eye(4), np.ones(len(p), np.bool_))
    for px in errors_px:
        objects._learn(MovedPoints(p, z[:, :2] + [px, 0.0], np.zeros(len(p), np.int64)), still)
    return objects._usual_px


MATCHES: dict[str, tuple[Says, float, float]] = {
    "displaced: memory": (lambda n: _learned_px(int(n)) > 0.25, 18, 26),
    "exchanged: share": (_exchanged, 0.55, 0.65),
    "exchanged: frames": (lambda n: _exchanged(1.0, int(n)), 2, 3),
    "exchanged: disparity": (lambda x: _exchanged(1.0, negative_px=x), 0.85, 1.15),
    "frozen: matches": (lambda n: _frozen(count=int(n)), 7, 8),
    "frozen: motion": (_frozen, 1.7, 2.3),
    "frozen: share": (lambda x: not _frozen(right_px=10.0 * x), 0.087, 0.113),
    "few: features": (lambda n: _hardly_matched(int(n), 0.0), 19, 20),
    "few: share": (lambda x: not _hardly_matched(100, x), 0.17, 0.23),
    "late: from the start": (lambda n: not _paired_anew(int(n)), 40, 41),
    "lost: usual": (lambda x: _lost([x] * 10 + [0.0] * 4) != [], 0.27, 0.33),
    "lost: back": (lambda x: len(_lost([1.0] * 10 + [0.0] * 4 + [x])) == 2, 0.45, 0.55),
    "never: share": (lambda x: _never([x] * 6, 1000) == [], 0.055, 0.066),
    "object: least limit": (_is_outlier, 1.3, 1.7),
    "object: limit": (lambda x: _is_outlier(x, 1.0), 2.6, 3.9),
    "object: frames": (lambda n: _judges(int(n)), 6, 7),
    "object: gain": (lambda x: _usual_px([1.0] * 20 + [2.0]) < 1.0 + x, 0.085, 0.115),
    "object: largest": (lambda x: _usual_px([x]) == _usual_px([99.0]), 4.3, 5.7),
}


# Corners


def _corners(size: int) -> int:
    """Corners that are searched of an image full of them."""
    squares = np.random.default_rng(0).integers(0, 2, (size // 8, size // 8))
    image = np.kron(squares, np.full((8, 8), 200)).astype(np.uint8)
    return len(RowProbe().corners(image))


def _positive(correlation: float) -> bool:
    """Whether most points match of images whose patches have a correlation."""
    rng = np.random.default_rng(0)
    texture = rng.normal(size=(200, 320))
    other = correlation * texture + np.sqrt(1.0 - correlation**2) * rng.normal(size=texture.shape)
    left, right = (np.clip(128.0 + 30.0 * x, 0, 255).astype(np.uint8) for x in (texture, other))
    right = np.roll(right, -6, axis=1)
    points = rng.uniform([160.0, 60.0], [560.0, 340.0], (100, 2)).round()
    return RowProbe().positive(left, right, points) > 50


def _rows_found(ratio: float) -> bool:
    """Whether a row difference is taken at which more points match by a ratio."""
    rows = RowProbe()
    counts = {0: 30, 5: round(30 * ratio)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(probe, "shifted_rows", lambda image, k: k)
        patch.setattr(probe, "_well_matched", lambda left, k, *_: counts.get(k, 0))
        nothing: Any = None
        rows._search(nothing, nothing, np.zeros((100, 2)))
    return rows._rows == 5


def _agrees_at_last(alike: int) -> bool:
    """Whether a pairing is decided once so many of the last frames say the same, of five."""
    check: Any = PairingCheck(RowProbe())
    said = iter([*[None, 1] * 3, None][: 7 - alike] + [0] * alike)
    check._on_rows = lambda *_: 0
    check._looks_exchanged = lambda *_: False
    check._far_delay = lambda now: next(said)
    for k in range(7):
        half = SimpleNamespace(corners=np.zeros((50, 2)))
        check._count(k, half, half)
    return check.delay is not None


CORNERS: dict[str, tuple[Says, float, float]] = {
    "number": (lambda n: _corners(400) < n, 70, 95),
    "correlation": (_positive, 0.74, 0.9),
    "rows": (_rows_found, 1.8, 2.2),
    "pairing: frames that agree": (lambda n: _agrees_at_last(int(n)), 1, 2),
}
TABLES = {
    f"{what}: {name}": row
    for what, table in (
        ("order", ORDERS),
        ("turned", TURNED),
        ("matches", MATCHES),
        ("corners", CORNERS),
    )
    for name, row in table.items()
}


@pytest.mark.parametrize(("says", "below", "above"), TABLES.values(), ids=TABLES)
def test_limits_of_orders_and_turns(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
