"""Parts of the rig that show more features than the scene behind them."""

from __future__ import annotations

import numpy as np
import pytest

from tests.frontend.test_frontend_outliers import CAMERA, LIMIT_PX, make_problem, scene
from vio.findings import Finding
from vio.frontend.moving_object import MovedPoints
from vio.frontend.outliers import Consensus, pixel_errors
from vio.frontend.rig_in_view import RigInView
from vio.geometry.lie import FloatArray, se3_exp, transform_points
from vio.geometry.stereo import project

STEP = se3_exp([0.0, 0.0, -0.5, 0.0, 0.02, 0.0])  # T_curr_prev of a rig that moves
REST = np.eye(4)
CLOSE = (1.0, 2.0)
FAR = (4.0, 30.0)
NONE = np.zeros((0, 3))


def _moved(p: FloatArray, T: FloatArray, seed: int) -> FloatArray:
    """Pixels (N, 2) of points (N, 3) after a motion, with noise."""
    rng = np.random.default_rng(seed)
    uv: FloatArray = project(CAMERA, transform_points(T, p))[:, :2]
    return uv + rng.normal(0.0, 0.1, uv.shape)


def _see(
    check: RigInView,
    index: int,
    stays: FloatArray,
    moves: FloatArray,
    motions: tuple[FloatArray, FloatArray] = (REST, STEP),
    *,
    measured: FloatArray | None = None,
    scatter_px: float = 0.0,
    age: int = 5,
) -> tuple[Finding, ...]:
    """What is found in a frame whose consensus is that of the first points (N, 3) and motion."""
    p = np.concatenate([stays, moves])
    uv = np.concatenate([_moved(stays, motions[0], index), _moved(moves, motions[1], index)])
    rng = np.random.default_rng(index)
    uv[len(stays) :] += rng.uniform(-scatter_px, scatter_px, (len(moves), 2))
    found = Consensus(motions[0], pixel_errors(CAMERA, motions[0], p, uv) <= LIMIT_PX)
    ages = np.full(len(p), age)
    points = MovedPoints(p, uv, ages)
    if check.is_lost(index, points, found):
        check.replace(index, CAMERA)
    else:
        check.see(index, make_problem(), points, found, measured)
    return check.take_findings()


def _found(
    frames: int = 12,
    stay: tuple[float, float] = CLOSE,
    move: tuple[float, float] = FAR,
    count: int = 40,
    motion: FloatArray = STEP,
    measured: FloatArray | None = None,
    scatter_px: float = 0.0,
) -> list[tuple[int | None, bool]]:
    check = RigInView()
    found = []
    for k in range(1, frames):
        points = scene(200, k, stay), scene(count, 100 + k, move)
        motions = (REST, motion)
        found += _see(check, k, *points, motions, measured=measured, scatter_px=scatter_px)
    return [(f.frame, f.ended) for f in found]


def test_a_scene_that_moves_behind_what_stays_is_named_in_the_fifth_frame() -> None:
    assert _found() == [(5, False)]


def _part(p: FloatArray) -> FloatArray:
    """Those of points (N, 3) that are in the left third of the view, on a third of its rows."""
    p = p.copy()
    p[:, :2] = p[:, 2:] * [-0.45, 0.0] + (p[:, :2] - p[:, 2:] * [0.0, 0.0]) / 3.0
    return p


def test_what_moves_in_front_of_a_rig_at_standstill_is_an_object() -> None:
    check = RigInView()
    for k in range(1, 20):
        moves = _part(scene(60, 100 + k, (2.0, 3.0)))
        assert not _see(check, k, scene(200, k, FAR), moves)


def test_what_moves_far_off_in_a_part_of_the_view_is_an_object() -> None:
    """As a person who walks behind what a rig at standstill sees."""
    check = RigInView()
    for k in range(1, 20):
        moves = _part(scene(60, 100 + k, FAR))
        assert not _see(check, k, scene(200, k, CLOSE), moves)


def test_a_frame_without_a_point_of_the_consensus_tells_nothing() -> None:
    check = RigInView()
    found = []
    for k in range(1, 20):
        stays = NONE if k < 8 else scene(200, k, CLOSE)
        found += _see(check, k, stays, scene(40, 100 + k, FAR), (REST, STEP))
    assert [(f.code, f.since) for f in found] == [("rig-in-view", 1)]


def test_what_moves_all_over_what_stays_is_the_scene() -> None:
    """As behind a window with reflections, whose depth is any."""
    assert _found(stay=FAR, move=FAR) == [(5, False)]
    assert _found(stay=FAR, move=CLOSE, motion=se3_exp([0.0, 0.0, -0.1, 0.0, 0.02, 0.0])) == [
        (5, False)
    ]


def test_a_sensor_that_measures_standstill_is_believed() -> None:
    assert _found(measured=REST) == []
    assert _found(measured=STEP) == [(5, False)]


@pytest.mark.parametrize(("count", "named"), [(40, True), (13, True), (8, False)])
def test_few_points_do_not_tell(count: int, named: bool) -> None:
    assert bool(_found(count=count)) == named


def test_points_that_move_each_by_itself_are_no_scene() -> None:
    """As leaves, or wrong matches."""
    assert _found(motion=REST, scatter_px=60.0) == []


def test_a_rig_at_standstill_that_moves_off_has_none_in_view() -> None:
    check = RigInView()
    none = np.zeros((0, 3))
    for k in range(1, 20):
        T = REST if k < 8 else STEP
        assert not _see(check, k, scene(200, k, FAR), none, (T, T))
    # nor does it later, when it waits beside something that passes behind a fence
    for k in range(20, 40):
        assert not _see(check, k, scene(200, k, CLOSE), scene(40, 100 + k, FAR))


def test_single_frames_do_not_tell() -> None:
    check = RigInView()
    none = np.zeros((0, 3))
    for k in range(1, 40):
        moves = none if k % 3 else scene(40, 100 + k, FAR)
        assert not _see(check, k, scene(200, k, CLOSE), moves)


def test_it_ends_once_the_consensus_moves() -> None:
    check = RigInView()
    found = []
    for k in range(1, 20):
        motions = (REST, STEP) if k < 10 else (STEP, STEP)
        found += _see(check, k, scene(200, k, CLOSE), scene(40, 100 + k, FAR), motions)
    assert [(f.code, f.frame, f.since, f.ended) for f in found] == [
        ("rig-in-view", 5, 1, False),
        ("rig-in-view", 14, None, True),
    ]


ASIDE = se3_exp([0.06, 0.0, 0.0, 0.0, 0.0, 0.0])


def _object_before(
    frames: range,
    check: RigInView,
    behind: tuple[float, float] = FAR,
    motion: FloatArray = ASIDE,
    measured: FloatArray | None = None,
) -> list[tuple[int | None, bool]]:
    """Findings on frames in which the consensus is that of what moves before a scene that stays."""
    found = []
    for k in frames:
        points = scene(200, k, CLOSE), scene(30, 100 + k, behind)
        found += _see(check, k, *points, (motion, REST), measured=measured)
    return [(f.frame, f.ended) for f in found]


def test_an_object_over_most_of_the_view_from_the_first_frame_on_is_named() -> None:
    check = RigInView()
    assert _object_before(range(1, 20), check) == [(5, False)]
    # it stops: the view stays, and ten frames later nothing is behind what moves any more
    assert _object_before(range(20, 40), check, motion=REST) == [(29, True)]


def test_a_part_of_the_rig_before_a_scene_that_moves_is_no_scene() -> None:
    check = RigInView()
    for k in range(1, 30):
        near = _part(scene(30, 100 + k, (0.6, 0.9)))
        assert not _see(check, k, scene(200, k, FAR), near, (STEP, REST))


def test_a_sensor_that_measures_motion_is_believed_beside_what_stays() -> None:
    assert _object_before(range(1, 30), RigInView(), measured=ASIDE) == []


def test_what_stays_behind_a_rig_that_moved_first_is_no_scene() -> None:
    check = RigInView()
    for k in range(1, 15):
        assert not _see(check, k, scene(200, k, FAR), NONE, (STEP, STEP))
    assert _object_before(range(15, 40), check) == []


def test_an_object_that_comes_after_a_long_standstill_holds_from_its_own_first_frame_on() -> None:
    check = RigInView()
    for k in range(1, 50):
        assert not _see(check, k, scene(200, k, FAR), NONE, (REST, REST))
    found = []
    for k in range(50, 70):
        points = scene(200, k, CLOSE), scene(30, 100 + k, FAR)
        found += _see(check, k, *points, (ASIDE, REST))
    assert [(f.frame, f.since, f.ended) for f in found] == [(54, 50, False)]


def test_what_is_found_of_an_object_outlasts_what_was_found_at_standstill() -> None:
    """It grows over the view, and is the consensus from frame 10 on."""
    check = RigInView()
    found = []
    for k in range(1, 30):
        motions = (REST, STEP) if k < 10 else (ASIDE, REST)
        found += _see(check, k, scene(200, k, CLOSE), scene(40, 100 + k, FAR), motions)
    assert [(f.frame, f.since, f.ended) for f in found] == [(5, 1, False), (14, 10, False)]


def test_a_view_that_is_replaced_beside_an_object_is_named_until_it_moves() -> None:
    check = RigInView()
    _object_before(range(1, 20), check)
    check.replace(20, CAMERA)
    found = []
    for k in range(20, 60):
        found += _see(check, k, scene(200, k, FAR), NONE, (REST, REST))
    assert [(f.frame, f.since, f.ended) for f in found] == [(24, 20, False)]


def test_parts_of_the_rig_all_around_a_scene_that_moves_are_no_scene() -> None:
    """As a cabin around a camera: nearer than what moves."""
    for motion in (STEP, ASIDE):
        check = RigInView()
        for k in range(1, 30):
            near = scene(40, 100 + k, (0.6, 0.9))
            assert not _see(check, k, scene(200, k, FAR), near, (motion, REST))


AHEAD = se3_exp([0.0, 0.0, -0.2, 0.0, 0.0, 0.0])  # a lorry that is slower than the rig


def _centre(p: FloatArray) -> FloatArray:
    """Points (N, 3) in the middle third of the view."""
    return p * [1.0 / 3.0, 1.0 / 3.0, 1.0]


def _beside(
    other: FloatArray,
    frames: range,
    check: RigInView,
    first: tuple[FloatArray, FloatArray] = (_centre(scene(200, 1, (4.0, 6.0))), AHEAD),
    motion: FloatArray = STEP,
) -> list[tuple[int | None, bool]]:
    """Findings on frames whose consensus is that of the first points and their motion, beside others
    (N, 3) and theirs.
    """
    found = []
    for k in frames:
        found += _see(check, k, first[0], other, (first[1], motion))
    return [(f.frame, f.ended) for f in found]


def test_what_moves_before_a_scene_that_moves_otherwise_is_named() -> None:
    """As a lorry ahead from the first frame on."""
    check = RigInView()
    around = scene(40, 2, (4.0, 6.0))
    assert _beside(around, range(1, 20), check) == [(5, False)]
    assert _beside(around[:12], range(20, 40), check) == []  # few tell that it goes on
    assert _beside(NONE, range(40, 60), check) == [(49, True)]


def test_some_points_that_move_otherwise_are_no_scene() -> None:
    around = scene(40, 2, (4.0, 6.0))
    for other in (around[:11], _centre(around), _centre(scene(40, 2, (2.0, 3.0)))):
        assert _beside(other, range(1, 30), RigInView()) == []


def test_what_moves_far_off_in_a_part_of_a_view_that_moves_is_an_object() -> None:
    """As cars ahead of what a rig drives by."""
    for k in range(1, 30):
        cars = _centre(scene(40, k, (30.0, 40.0)))
        ground = scene(200, k, CLOSE), STEP
        assert _beside(cars, range(1, 20), RigInView(), ground, AHEAD) == []


def test_points_that_leave_the_motion_by_little_are_of_the_scene() -> None:
    """As by wrong disparities, which make near and far ones move apart."""
    around = scene(40, 2, (4.0, 6.0))
    more = se3_exp([0.0, 0.0, -0.21, 0.0, 0.0, 0.0])
    assert _beside(around, range(1, 30), RigInView(), motion=more) == []


def _replaced(
    before: FloatArray,
    after: FloatArray,
    *,
    measured: FloatArray | None = None,
    at: int = 12,
    kept: bool = False,
    frames: int = 30,
) -> list[tuple[str, int | None, int | None, bool]]:
    """What is found where all points are replaced in a frame, and motions before and after it."""
    check = RigInView()
    found = []
    for k in range(1, frames):
        T = before if k < at else after
        age = 5 if k != at or kept else 0
        found += _see(check, k, scene(200, k, FAR), NONE, (T, T), measured=measured, age=age)
    return [(f.code, f.frame, f.since, f.ended) for f in found]


def test_what_replaces_the_view_and_stays_at_its_pixels_is_named() -> None:
    assert _replaced(STEP, REST) == [("rig-in-view", 17, 12, False)]


def test_a_light_that_is_switched_on_beside_a_rig_at_rest_is_none_of_its_parts() -> None:
    assert _replaced(REST, REST) == []


def test_a_rig_that_brakes_or_goes_on_sees_the_scene() -> None:
    assert _replaced(STEP, REST, kept=True) == []
    assert _replaced(STEP, STEP) == []


def test_a_view_that_is_replaced_moves_before_it_stays() -> None:
    """As of a rig that was turned fast and then stopped."""
    check = RigInView()
    for k in range(1, 30):
        T = STEP if k <= 13 else REST
        age = 0 if k == 12 else 5
        assert not _see(check, k, scene(200, k, FAR), NONE, (T, T), age=age)


def test_a_sensor_that_measures_standstill_is_believed_of_a_new_view() -> None:
    assert _replaced(STEP, REST, measured=REST) == []
    assert _replaced(STEP, REST, measured=STEP) == [("rig-in-view", 17, 12, False)]


def test_points_that_never_last_tell_of_no_new_view() -> None:
    """As in rain, or of a front end that finds them anew."""
    check = RigInView()
    for k in range(1, 30):
        age = 0 if k % 3 else 5
        assert not _see(check, k, scene(200, k, FAR), NONE, (REST, REST), age=age)
