"""Each limit of keyframes, places and loops of a map, from both sides."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, patch

import cv2
import numpy as np
import pytest

from vio.geometry.lie import FloatArray, so3_exp
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import StereoCamera
from vio.mapping import builder, place_finder
from vio.mapping import session as sessions
from vio.mapping.builder import MapBuilder, agree
from vio.mapping.features import DESCRIPTOR_BYTES, KeyframeFeatures, _equal_contrast, extract
from vio.mapping.guided_search import _corners, _in_reach, _weakened
from vio.mapping.map_graph import MapGraph
from vio.mapping.map_store import MapStore
from vio.mapping.place_finder import FoundPlace, PlaceFinder
from vio.mapping.session import MapSession, _inflated

Says = Callable[[float], bool]
MOTION = RelativePose(np.eye(4), np.eye(6))


# Keyframes


def _is_due(shared: float = 1.0, since: int = 0, sigma_m: float = 0.0, **state: bool) -> bool:
    """Whether a frame becomes a keyframe that shows a share of what the last one showed."""
    own: Any = SimpleNamespace(
        _unconfirmed=False,
        _localise=False,
        _since=since,
        _ids=np.arange(100),
        covariance=np.diag([sigma_m**2, 0, 0, 0, 0, 0]),
    )
    for name, value in state.items():
        setattr(own, f"_{name}", value)
    return MapSession._is_due(own, np.arange(round(100 * shared)), MOTION)


def _is_considered(features: int, most: int = 1000) -> bool:
    """Whether a frame with so many features may become a keyframe."""
    own = MagicMock()
    own._most_features = most
    own.newest = None
    seen = MagicMock()
    seen.take.return_value.__len__.return_value = features
    MapSession.frame(own, MagicMock(), seen, MagicMock(), MagicMock())
    return bool(own._consider.called)


def _is_held_back(waiting: int) -> bool:
    own = MagicMock(_wait=False, _waiting=[0] * waiting, _held=[], _since=0, _newest=None)
    MapSession._consider(own, MagicMock(), np.arange(3), MagicMock(), MOTION)
    return not own._hold.called


def _is_followed(features: int) -> bool:
    """Whether a frame with so many features is one that the odometry follows, after darkness."""
    own = MagicMock()
    own._is_lost.return_value = True
    MapSession._follow(own, MagicMock(), features, MagicMock(), MagicMock())
    return own._motion_to.call_args.args[2] is sessions._unknown


def _is_dark(seconds: float) -> bool:
    own: Any = SimpleNamespace(_alone=True, _seen_ns=0)
    return MapSession._is_lost(own, round(1e9 * seconds))


def _sigmas(T: FloatArray, sigma: float) -> FloatArray:
    return np.asarray(np.sqrt(np.diag(_inflated(RelativePose(T, sigma**2 * np.eye(6))).covariance)))


def _moved(metres: float = 0.0, rad: float = 0.0) -> FloatArray:
    T = np.eye(4)
    T[0, 3] = metres
    T[:3, :3] = so3_exp([rad, 0.0, 0.0])
    return T


def _frames_until(event: str) -> int:
    """Frames from a keyframe until its motion is settled, or its result is taken over."""
    own = MagicMock(_frames=100, _held=[], _waiting=[], _features=[None], _moves=[])
    own._vertical.return_value = (None, 0.0)
    with (
        patch.object(sessions, "Keyframe", MagicMock()),
        patch.object(sessions, "replace", lambda keyframe, motion: keyframe),
    ):
        MapSession._hold(own, MagicMock(), np.arange(3), MagicMock(), None)
        held = own._held[0]
        if event == "settled":
            return int(held.due - 100)
        MapSession._hand_over(own, held)
    return int(own._waiting[0][0] - 100)


# Key points


def _texture(contrast: float = 60.0, shift_px: int = 0) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """An image of blobs of several sizes, moved to the left by some pixels."""
    rng = np.random.default_rng(0)
    total = np.zeros((360, 960))
    for size in (1, 2, 4, 8, 16):
        small = rng.normal(size=(360 // size, 960 // size))
        total += cv2.resize(small, (960, 360), interpolation=cv2.INTER_CUBIC)
    total *= contrast / total.std()
    moved = total[:, shift_px : shift_px + 480]
    return np.clip(np.round(128.0 + moved), 0, 255).astype(np.uint8)


def _extracted(shift_px: int = 10, rows_px: int = 0) -> KeyframeFeatures:
    right = np.roll(_texture(shift_px=shift_px), rows_px, axis=0)
    return extract(_texture(), right)


def _contrast_left(deviation: float) -> float:
    """Of a chequered image with such a standard deviation, after its contrast was made equal."""
    signs = np.where(np.indices((60, 60)).sum(axis=0) % 2, 1.0, -1.0)
    image = np.round(120.0 + deviation * signs).astype(np.uint8)
    return float(_equal_contrast(image)[20:40, 20:40].std())


def _brightness() -> float:
    return float(_equal_contrast(np.full((60, 60), 90, np.uint8)).mean())


def _reach_of_step() -> int:
    """How many columns beside a step of brightness it changes."""
    image = np.full((40, 80), 90, np.uint8)
    image[:, 40:] = 150
    return int((_equal_contrast(image)[20] != 128).sum())


# Places


def _is_looked_for(
    ago: int = 50, passed: float = 1e3, apart: float = 0.0, sigma_m: float = 0.0
) -> bool:
    """Whether a keyframe may be seen again, in median depths of a metre."""
    graph = MagicMock()
    graph.session = np.zeros(100)
    graph.part = np.zeros(100)
    graph.path_m = np.where(np.arange(100) == 99, passed, 0.0)
    graph.T_map_cam = np.tile(np.eye(4), (100, 1, 1))
    graph.T_map_cam[99, 0, 3] = apart
    covariance = np.zeros((99, 3, 3))
    covariance[:, 0, 0] = sigma_m**2
    own: Any = SimpleNamespace(_graph=graph, _own=0)
    return bool(PlaceFinder._may_be_seen(own, 99, 1.0, covariance)[99 - ago])


def _is_sure(inliers: int) -> bool:
    seen: Any = SimpleNamespace(inliers=inliers)
    return FoundPlace(0, 1, seen, 1).is_sure


def _found(sigma_m: float = 0.0, inliers: int = 30) -> list[FoundPlace]:
    own = MagicMock()
    own._index.candidates = lambda features, allowed, count: np.arange(count)
    drift = np.zeros((100, 6, 6))
    drift[:, 0, 0] = sigma_m**2
    seen = SimpleNamespace(inliers=inliers)
    with patch.object(place_finder, "verify", lambda *_: seen):
        return PlaceFinder._candidates(own, 200, MagicMock(), np.ones(100, np.bool_), drift)


def _is_rival(inliers: float = 1.0, apart_m: float = 10.0, depth_m: float = 0.0) -> bool:
    """Whether another place makes one ambiguous, by its share of inliers and its distance."""
    own: Any = SimpleNamespace(_graph=SimpleNamespace(part=np.zeros(2)))
    places: Any = [
        SimpleNamespace(first=0, seen=SimpleNamespace(inliers=100)),
        SimpleNamespace(first=1, seen=SimpleNamespace(inliers=100 * inliers)),
    ]
    own._position = lambda place: np.array([apart_m * place.first, 0.0, 0.0])
    return PlaceFinder._is_rival(own, places[1], places[0], depth_m)


def _is_searched(sigma_m: float) -> bool:
    """Whether a place is looked for by geometry that the odometry knows so well."""
    own = MagicMock()
    own._graph.part = np.zeros(3)
    own._graph.T_map_cam = np.tile(np.eye(4), (3, 1, 1))
    own.drift_since.return_value = np.diag([sigma_m**2, 0, 0, 0, 0, 0])[None]
    return bool(PlaceFinder._priors(own, np.array([1]), 2))


def _expected(score: float, row: int = 1, places: int = 1) -> int:
    """How many places are searched, of some in each of which keyframes in a row show so much."""
    own = MagicMock()
    count = 40 * places + 40
    scores = np.zeros(count)
    for k in range(places):
        scores[40 * k + 20 : 40 * k + 20 + row] = score
    own._index.__len__.return_value = count
    own._graph.T_map_cam = np.tile(np.eye(4), (count, 1, 1))
    own._overlaps.expected.return_value = scores
    return len(PlaceFinder._expected_places(own, 0, np.arange(count)))


def _corner_px() -> float:
    """How far apart features are that count as two, along a row."""
    z = np.zeros((8000, 4))
    z[:, 0] = 0.1 * np.arange(8000)
    return 800.0 / _corners(z)


def _prior_variance() -> float:
    weak = _weakened(MOTION)
    assert weak is not None
    return float(weak.covariance[0, 0])


def _may_show(beside_px: float) -> bool:
    """Whether a point is looked for that is so far outside of the image."""
    camera = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)
    place: Any = SimpleNamespace(p=np.array([[-(320.0 + beside_px) / 400.0, 0.0, 1.0]]))
    return len(_in_reach(place, camera, np.eye(4))) > 0


# Loops


def _is_confirmed(keyframes: int) -> bool:
    """Whether a loop so many keyframes before confirms another one."""
    own = MagicMock()
    own.places.find.return_value = SimpleNamespace(needed=1, first=3, second=100)
    own._pending = [SimpleNamespace(first=2, second=100 - keyframes)]
    own.graph.loops = []
    with patch.object(builder, "agree", lambda *_: True):
        return bool(MapBuilder._close_loops(own, 100, MagicMock()))


def _agree(path_m: float) -> bool:
    """Whether loops agree that only the map's own drift makes so, between two places of it."""
    graph = MagicMock()
    graph.T_map_cam = np.tile(np.eye(4), (4, 1, 1))
    graph.T_odom_cam = graph.T_map_cam
    graph.path_m = np.array([0.0, path_m, 0.0, 0.0])
    graph.session = np.zeros(4)
    graph.drift = lambda i, k, **_: (1e4 if i[0] == 0 else 1e-4) * np.eye(6)[None]

    def place(first: int, second: int, shift_m: float) -> Any:
        pose = RelativePose(_moved(shift_m), 1e-4 * np.eye(6))
        return SimpleNamespace(first=first, second=second, seen=SimpleNamespace(pose=pose))

    return agree(graph, place(0, 2, 0.0), place(1, 3, 5.0))


def _optimises(error: float = 0.0, waiting: int = 0) -> bool:
    """Whether a new loop is optimised at once, by its error and by how many wait."""
    own = MagicMock(_own=0, _optimised=True, _waiting=waiting)
    own.graph.part = np.zeros(2)
    own.graph.session = np.arange(2)
    own.graph.T_map_cam = np.tile(np.eye(4), (2, 1, 1))
    loop: Any = SimpleNamespace(first=0, second=1, seen=MagicMock(pose=MOTION))
    with (
        patch.object(builder, "squared", lambda r, C: error),
        patch.object(builder, "se3_log", lambda T: np.ones(6)),
        patch.object(builder, "LoopEvent", MagicMock()),
    ):
        MapBuilder._accept(own, loop)
    return bool(own._optimise.called)


def _is_corrected(moved_px: float) -> bool:
    own = MagicMock(_own=0)
    features = MagicMock(has_right=np.ones(5, np.bool_))
    before = MagicMock()
    before.at.return_value = np.zeros((5, 4))
    field = MagicMock()
    field.at.return_value = np.full((5, 4), moved_px)
    own.graph.sessions = [SimpleNamespace(field=before)]
    with patch.object(builder, "replace", lambda session, field: session):
        MapBuilder._correct(own, field, features)
    return bool(own.places.forget_pixels.called)


def _drift_m(path_m: float) -> float:
    """What errors of a calibration may do over a path."""
    none = np.zeros((2, 6, 6))
    own: Any = SimpleNamespace(
        _drift=none, T_odom_cam=np.tile(np.eye(4), (2, 1, 1)), path_m=np.array([0.0, path_m])
    )
    own.session = np.zeros(2)
    C = MapGraph.drift(own, np.array([0]), np.array([1]), systematic=1.0)[0]
    return float(np.sqrt(C[0, 0]))


def _tells(features: int) -> bool:
    """Whether images with so many features are told from others."""
    database = sqlite3.connect(":memory:")
    database.execute("CREATE TABLE features (descriptors BLOB)")
    bits = b"\1" * DESCRIPTOR_BYTES * features
    database.execute("INSERT INTO features VALUES (?)", (bits,))
    own: Any = SimpleNamespace(_db=database, _errors=contextlib.nullcontext)
    return bool(MapStore.images(own))


LIMITS: dict[str, tuple[Says, float, float]] = {
    "keyframe: shares little": (lambda x: not _is_due(x), 0.58, 0.6),
    "keyframe: unconfirmed": (lambda n: _is_due(since=int(n), unconfirmed=True), 2, 3),
    "keyframe: without a place": (
        lambda n: _is_due(since=int(n), localise=True, sigma_m=9.0),
        2,
        3,
    ),
    "keyframe: localised": (lambda n: _is_due(since=int(n), localise=True), 4, 5),
    "keyframe: lost": (lambda x: _is_due(since=3, localise=True, sigma_m=x), 0.9, 1.1),
    "keyframe: features": (lambda n: _is_considered(int(n)), 29, 30),
    "keyframe: waiting": (lambda n: _is_held_back(int(n)), 2, 3),
    "keyframe: followed": (lambda n: _is_followed(int(n)), 5, 6),
    "keyframe: dark": (_is_dark, 0.45, 0.55),
    "motion: sigma": (lambda x: bool(_sigmas(np.eye(4), 1.0)[0] < x), 1.9, 2.1),
    "motion: length": (lambda x: bool(_sigmas(_moved(1000.0), 0.0)[0] < x), 0.45, 0.55),
    "motion: angle": (lambda x: bool(_sigmas(_moved(0.0, 1.0), 0.0)[3] < 1e-4 * x), 1.8, 2.2),
    "frames: settled": (lambda n: _frames_until("settled") < n, 3, 4),
    "frames: taken over": (lambda n: _frames_until("taken over") < n, 10, 11),
    "points: most": (lambda n: len(_extracted()) < n, 600, 601),
    "points: scale": (lambda x: float(_extracted().sigma_px.max()) < x, 3.5, 3.7),
    "points: disparity": (
        lambda n: _extracted(int(n)).has_right.mean() < 0.1,
        180,
        204,
    ),
    "points: rows": (lambda n: _extracted(rows_px=int(n)).has_right.mean() < 0.3, 1, 3),
    "points: brightness": (lambda x: _brightness() < x, 127.0, 129.0),
    "points: strong contrast": (lambda x: _contrast_left(100.0) < x, 35.0, 40.0),
    "points: weak contrast": (lambda x: _contrast_left(6.0) < x, 18.5, 21.5),
    "points: corners": (
        lambda x: len(extract(_texture(x), _texture(x))) > 100,
        3.0,
        4.0,
    ),
    "points: step": (lambda n: _reach_of_step() < n, 14, 15),
    "place: recent": (lambda n: _is_looked_for(int(n)), 9, 10),
    "place: path": (lambda x: _is_looked_for(passed=x), 1.4, 1.6),
    "place: view": (lambda x: not _is_looked_for(apart=x), 1.4, 1.6),
    "place: view, uncertain": (lambda x: not _is_looked_for(apart=x, sigma_m=1.0), 4.3, 4.7),
    "place: sure": (lambda n: _is_sure(int(n)), 59, 60),
    "place: candidates": (lambda n: len(_found()) < n, 3, 4),
    "place: lost": (lambda x: _found(x)[0].needed > _found()[0].needed, 2.8, 3.2),
    "place: lost and sure": (lambda n: _found(9.0, int(n))[0].needed == 1, 59, 60),
    "place: confirmations": (lambda n: _found()[0].needed < n, 1, 2),
    "place: confirmations, lost": (lambda n: _found(9.0)[0].needed < n, 2, 3),
    "rival: inliers": (_is_rival, 0.48, 0.52),
    "rival: apart": (lambda x: _is_rival(apart_m=x), 0.09, 0.11),
    "rival: apart by depth": (lambda x: _is_rival(apart_m=x, depth_m=100.0), 9.5, 10.5),
    "searched: known": (lambda x: not _is_searched(x), 0.45, 0.55),
    "searched: places": (lambda n: _expected(20.0, places=int(n)) < n, 3, 4),
    "searched: neighbours": (lambda x: _expected(x, row=7) > 0, 1.65, 1.75),
    "searched: neighbours, many": (lambda x: _expected(x, row=20) > 0, 1.65, 1.75),
    "searched: corners": (lambda x: _expected(x) > 0, 11.5, 12.5),
    "searched: corner": (lambda x: _corner_px() < x, 7.5, 8.5),
    "searched: prior": (lambda x: _prior_variance() < x, 9.0, 11.0),
    "searched: beside the image": (lambda x: not _may_show(x), 62.0, 68.0),
    "loop: within": (lambda n: not _is_confirmed(int(n)), 6, 7),
    "loop: neighbours": (lambda x: not _agree(x), 48.0, 52.0),
    "loop: error": (_optimises, 5.5, 6.5),
    "loop: waiting": (lambda n: _optimises(waiting=int(n)), 6, 7),
    "rig: moved": (_is_corrected, 0.018, 0.022),
    "drift: length": (lambda x: _drift_m(100.0) < x, 0.95, 1.05),
    "image: tells": (lambda n: _tells(int(n)), 19, 20),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_keyframes_and_places(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
