"""An object over most of the image: the predicted motion tells it from the scene, and it is
said.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.frontend.test_frontend_outliers import (
    CAMERA,
    LIMIT_PX,
    T_TRUE,
    make_problem,
    pixels,
    scene,
)
from tests.guards import lines_of
from vio.frontend.frame_images import FrameImages
from vio.frontend.frames import usable_prior
from vio.frontend.moving_object import (
    MovedPoints,
    TwoMotions,
    choose_motion,
    one_motion_explains,
    static_by_prediction,
    voters,
    without_young_object,
)
from vio.frontend.object_report import ObjectReport
from vio.frontend.outliers import Consensus, pixel_errors, rigid_consensus
from vio.frontend.patches import ImageLevels
from vio.frontend.right_images import RightImages
from vio.frontend.scene_motion import SceneMotion
from vio.frontend.settings import DisparitySettings
from vio.frontend.static_features import StaticFeatures
from vio.frontend.stereo_fit import StereoFit
from vio.frontend.tracks import ANCHOR_RADIUS_PX, AnchorBank, new_tracks
from vio.geometry.lie import (
    FloatArray,
    se3_exp,
    se3_from_parts,
    se3_inverse,
    se3_log,
    so3_exp,
)
from vio.geometry.stereo import project, triangulate
from vio.records import BoolArray, MotionPrior, StereoFrame, TrackPrior

# what the camera would have done by the object's points
T_OBJECT = se3_exp([0.4, 0.1, -0.6, 0.0, 0.01, 0.0])
# covariance of a prediction over one frame, m and rad
IMU = np.diag(np.repeat([0.003, 0.0003], 3) ** 2)
NOTHING = np.diag(np.repeat([3.0, 0.3], 3) ** 2)


def prediction(T: FloatArray = T_TRUE, covariance: FloatArray = IMU) -> MotionPrior:
    """A prediction off by its own standard deviation."""
    off = np.sqrt(np.diag(covariance)) * np.random.default_rng(4).choice([-1.0, 1.0], 6)
    return MotionPrior(se3_exp(off) @ T, covariance)


def scenery(static: int, moving: int) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Points (N, 3), their pixels (N, 2), and the mask (N,) of those on the object."""
    wall, truck = scene(static, 12, (8.0, 40.0)), scene(moving, 13, (6.0, 8.0))
    uv = np.concatenate([pixels(T_TRUE, wall, 14), pixels(T_OBJECT, truck, 15)])
    return np.concatenate([wall, truck]), uv, np.arange(static + moving) >= static


def choose(
    static: int, moving: int, predicted: MotionPrior | None, *, in_event: bool = False
) -> tuple[TwoMotions, Consensus, BoolArray]:
    p, uv, truck = scenery(static, moving)
    found = rigid_consensus(make_problem(), p, uv, np.eye(4), None, None)
    assert found is not None
    return choose_motion(make_problem(), p, uv, found, predicted, in_event=in_event), found, truck


def test_prediction_chooses_the_smaller_group_that_agrees_with_it() -> None:
    """One point in five is of the scene, the others are of an object: the consensus is the
    object's.
    """
    chosen, found, truck = choose(60, 240, prediction())
    assert found.inliers[truck].mean() > 0.95  # control: the test would be trivial otherwise
    assert chosen.motion.inliers[~truck].mean() > 0.95
    assert not chosen.motion.inliers[truck].any()
    assert np.linalg.norm(se3_log(chosen.motion.T_curr_prev @ se3_inverse(T_TRUE))) < 0.02
    assert (chosen.decision, chosen.object_share) == ("predicted", pytest.approx(0.8, abs=0.02))


def test_an_object_over_the_smaller_part_is_reported_and_changes_nothing() -> None:
    chosen, found, truck = choose(160, 140, prediction())
    assert not found.inliers[truck].any()
    assert chosen.motion is found
    assert (chosen.decision, chosen.object_share) == (
        "predicted",
        pytest.approx(140 / 300, abs=0.03),
    )


@pytest.mark.parametrize(
    "predicted", [None, prediction(covariance=NOTHING)], ids=["none", "of no use"]
)
def test_without_a_useful_prediction_the_larger_group_is_used_and_called_undecided(
    predicted: MotionPrior | None,
) -> None:
    chosen, found, _ = choose(120, 180, predicted)
    assert chosen.motion is found
    assert (chosen.decision, chosen.object_share) == ("undecided", pytest.approx(0.4, abs=0.03))


def test_a_wrong_prediction_does_not_override_the_consensus() -> None:
    """A spike of the IMU: no group agrees with the prediction. Mismatches do not make one."""
    p, uv, _ = scenery(250, 0)
    uv[:50] += np.random.default_rng(1).uniform(-40, 40, (50, 2))
    found = rigid_consensus(make_problem(), p, uv, np.eye(4), None, None)
    assert found is not None
    wrong = prediction(se3_exp([0.3, 0.0, 0.0, 0.0, 0.1, 0.0]))
    chosen = choose_motion(make_problem(), p, uv, found, wrong)
    assert chosen.motion is found
    assert chosen.object_share == 0.0


@pytest.mark.parametrize("static", [40, 200])
def test_without_depths_an_object_ahead_of_a_turning_camera_contradicts_the_imu(
    static: int,
) -> None:
    """It keeps its place in the image, which a camera that moves sideways as it turns sees, too."""
    turn = se3_exp([0.02, 0.0, -0.8, 0.0, 0.05, 0.0])
    wall, truck = scene(static, 12, (8.0, 40.0)), scene(160, 13, (6.0, 8.0)) * [0.3, 1.0, 1.0]
    p = np.concatenate([wall, truck])
    before, moves = project(CAMERA, p)[:, :2], np.arange(len(p)) >= static
    after = np.where(moves[:, None], before, pixels(turn, p, 14))
    everything, imu = np.ones(len(p), dtype=np.bool_), prediction(turn)
    for kept in (moves, everything):
        used = static_by_prediction(make_problem(), before, after, kept, imu, 1.0)
        assert used[~moves].mean() > 0.95
        assert used[moves].mean() < 0.2
    np.testing.assert_array_equal(
        static_by_prediction(make_problem(), before, after, ~moves, imu, 1.0), ~moves
    )
    useless = replace(imu, covariance=1e3 * NOTHING)
    np.testing.assert_array_equal(
        static_by_prediction(make_problem(), before, after, moves, useless, 1.0), moves
    )


def test_of_two_motions_off_the_prediction_the_one_far_nearer_is_used() -> None:
    """The IMU is ten times worse than it says, by a late stamp say: the scene contradicts it,
    the object far more.
    """
    late = prediction(se3_exp([0.02, 0.0, 0.0, 0.0, 0.003, 0.0]) @ T_TRUE)
    for static, moving in ((60, 240), (240, 60)):
        chosen, found, truck = choose(static, moving, late)
        assert found.inliers[truck].mean() > 0.95 or static > moving  # control
        assert chosen.motion.inliers[~truck].mean() > 0.95
        assert not chosen.motion.inliers[truck].any()
    chosen, found, _ = choose(120, 180, replace(late, measured=False))
    assert chosen.motion is found


def test_an_object_that_hides_the_scene_does_not_become_the_scene() -> None:
    """Six points of the scene are left, too few for a motion: while the object is known, the
    prediction is used.
    """
    before, found, truck = choose(6, 300, prediction())
    assert before.motion is found  # control
    for measured in (True, False):
        chosen, _, _ = choose(6, 300, replace(prediction(), measured=measured), in_event=True)
        assert not chosen.motion.inliers[truck].any()
        assert chosen.motion.inliers[~truck].sum() >= 4
        np.testing.assert_allclose(chosen.motion.T_curr_prev, prediction().T_curr_prev)


def test_points_seen_before_outvote_what_has_come_into_view() -> None:
    """No sensor, and a prediction that fits the object: the older points of the scene decide,
    four of five or one.
    """
    for static, moving in ((60, 240), (240, 60)):
        p, uv, truck = scenery(static, moving)
        found = rigid_consensus(make_problem(), p, uv, np.eye(4), None, None)
        assert found is not None
        age = np.where(truck, 9, 30)
        age[-5:] = 30  # some wrong ones
        guess = replace(prediction(T_OBJECT), measured=False)
        chosen = choose_motion(
            make_problem(), p, uv, found, guess, voting=voters(age), in_event=True
        )
        assert chosen.motion.inliers[~truck].mean() > 0.95
        assert not chosen.motion.inliers[truck].any()
        assert (chosen.decision, chosen.object_share > 0) == (
            ("voted", True) if moving > static else (None, False)
        )


def test_points_vote_from_their_fifth_static_frame_on() -> None:
    """The oldest fifty of those, and all that are as old as the youngest of them."""
    ages = np.array([4, 5, 6])
    assert voters(ages).tolist() == [False, True, True]
    ages = np.repeat([10, 20, 30], [40, 12, 39])
    assert voters(ages).tolist() == (ages >= 20).tolist()
    ages = np.repeat([10, 20, 30], [40, 12, 37])
    assert voters(ages).all()


def test_a_compromise_between_slow_object_and_scene_is_outvoted() -> None:
    """One motion fits the object and a part of the scene, so that no second group of points is
    left that agrees.
    """
    wall, truck = scene(100, 12, (8.0, 40.0)), scene(260, 13, (6.0, 8.0))
    slow = pixels(T_TRUE, truck, 15)
    slow[:, 0] += 5.0
    uv = np.concatenate([pixels(T_TRUE, wall, 14), slow])
    p, on_truck = np.concatenate([wall, truck]), np.arange(360) >= 100
    found = rigid_consensus(make_problem(), p, uv, np.eye(4), None, None)
    assert 0.3 < found.inliers[~on_truck].mean() < 0.7  # control
    chosen = choose_motion(
        make_problem(), p, uv, found, None, voting=voters(np.where(on_truck, 6, 30))
    )
    assert chosen.motion.inliers[~on_truck].mean() > 0.95
    assert np.linalg.norm(se3_log(chosen.motion.T_curr_prev @ se3_inverse(T_TRUE))) < 0.02


def compromise() -> tuple[FloatArray, FloatArray, Consensus, FloatArray]:
    """An object, and a scene most of which is so far away that a turn explains it under the
    object's motion, too.
    """
    far, near, truck = (
        scene(110, 12, (400.0, 900.0)),
        scene(25, 13, (5.0, 9.0)),
        scene(115, 14, (6.0, 8.0)),
    )
    of_object = se3_exp([0.25, 0.0, 0.0, 0.0, 0.0, 0.0]) @ T_TRUE
    p = np.concatenate([far, near, truck])
    uv = np.concatenate(
        [pixels(T_TRUE, far, 15), pixels(T_TRUE, near, 16), pixels(of_object, truck, 17)]
    )
    found = rigid_consensus(make_problem(), p, uv, np.eye(4), None, None)
    assert found is not None
    return p, uv, found, np.repeat([0, 1, 2], [110, 25, 115])


def test_the_prediction_outweighs_an_object_that_shares_what_is_far_away_with_the_scene() -> None:
    """The oldest points are all far away and follow both motions, so that their votes say
    nothing.
    """
    p, uv, found, part = compromise()
    assert found.inliers[part == 2].mean() > 0.9  # control
    assert found.inliers[part == 0].mean() > 0.9
    voting = voters(np.where(part == 0, 30, 6))
    guess = replace(prediction(), measured=False)
    chosen = choose_motion(make_problem(), p, uv, found, guess, voting=voting)
    assert chosen.decision == "predicted"
    assert chosen.motion.inliers[part < 2].mean() > 0.9
    assert not chosen.motion.inliers[part == 2].any()
    for changed in ({"predicted": None}, {"predicted": guess, "disparity_error_px": 50.0}):
        assert choose_motion(make_problem(), p, uv, found, voting=voting, **changed).motion is found


def test_a_jolt_that_nearly_all_points_follow_is_no_object() -> None:
    p, uv = scene(200, 12, (5.0, 40.0)), np.empty((200, 2))
    uv[:] = pixels(T_TRUE, p, 14)
    uv[::15] += 30.0  # wrong tracks
    found = rigid_consensus(make_problem(), p, uv, np.eye(4), None, None)
    still = MotionPrior(np.eye(4), IMU, measured=False)
    chosen = choose_motion(make_problem(), p, uv, found, still, voting=voters(np.full(200, 30)))
    assert chosen.motion is found
    assert chosen.object_share == 0.0


def test_an_object_slower_than_an_outlier_is_told_from_the_scene_by_the_imu() -> None:
    """It moves by less than a pixel in a frame: one motion passes for that of all points."""
    hover = se3_exp([0.01, 0.0, -0.03, 0.0, 0.002, 0.0])
    p = scene(390, 12, (8.0, 40.0))
    uv = pixels(hover, p, 14, noise=0.05)
    slow = np.arange(len(p)) >= 130
    uv[slow, 0] += 0.9
    # between both: what moves sideways in the image is explained by a turn
    dragged = se3_exp([0.0, 0.0, 0.0, 0.0, 0.45 / CAMERA.fu, 0.0]) @ hover
    found = Consensus(dragged, np.ones(len(p), dtype=np.bool_))
    assert (pixel_errors(CAMERA, dragged, p, uv) < LIMIT_PX).mean() > 0.95  # control
    voting = voters(np.where(slow, 0, 30))
    imu = prediction(hover, np.diag(np.repeat([3e-4, 3e-5], 3) ** 2))
    chosen = choose_motion(make_problem(), p, uv, found, imu, voting=voting)
    assert chosen.decision == "predicted"
    assert chosen.object_share > 0.4
    assert not chosen.motion.inliers[slow].any()
    turned = se3_log(chosen.motion.T_curr_prev @ se3_inverse(hover))[3:]
    assert np.linalg.norm(turned) < 0.2 * 0.45 / CAMERA.fu
    # without it the same is a motion of the rig
    guess = replace(imu, measured=False)
    assert choose_motion(make_problem(), p, uv, found, guess, voting=voting).motion is found
    # and so it is where the points seen before move likewise
    everything = voters(np.full(len(p), 30))
    assert choose_motion(make_problem(), p, uv, found, imu, voting=everything).motion is found


def test_a_sudden_motion_that_no_older_point_supports_is_reported_at_once() -> None:
    report = ObjectReport()
    p = scene(200, 12, (5.0, 40.0))
    found = Consensus(np.eye(4), np.ones(200, dtype=np.bool_))
    alone = TwoMotions(found, 0.0, None)
    expected = prediction(covariance=np.diag(np.repeat([0.03, 0.003], 3) ** 2))
    expected = replace(expected, measured=False)
    old = np.ones(200, dtype=np.bool_)

    def questioned(motion: Consensus, voting: BoolArray) -> TwoMotions:
        motions = TwoMotions(motion, 0.0, None)
        return report.questioned(motions, CAMERA, p, expected, voting, 0.0)

    # at the start nothing could support a motion
    assert questioned(found, ~old).decision is None
    going_on = Consensus(T_TRUE, old)
    for _ in range(3):
        assert questioned(going_on, old).decision is None
    assert questioned(going_on, ~old).decision is None  # as before: new points will do
    stopped = questioned(found, ~old)
    assert (stopped.decision, stopped.object_share) == ("unsupported", 1.0)
    report.frame(7, stopped)
    (finding,) = report.take_findings()
    assert (finding.code, finding.frame, finding.lasts) == ("object-or-scene", 7, True)
    # a jolt that the points seen before show, and others of its size after it
    assert questioned(found, old).decision is None
    assert questioned(found, ~old).decision is None
    for k in range(8, 40):
        report.frame(k, alone)
    (finding,) = report.take_findings()
    assert (finding.code, finding.ended) == ("object-or-scene", True)


def test_few_or_divided_votes_decide_nothing() -> None:
    p, uv, _ = scenery(60, 240)
    found = rigid_consensus(make_problem(), p, uv, np.eye(4), None, None)
    assert found is not None
    without = choose_motion(make_problem(), p, uv, found, None)
    for age in (
        np.where(np.arange(300) < 11, 30, 2),
        np.full(300, 30),
        np.zeros(300, dtype=np.int64),
    ):
        voting = voters(age) & ((np.arange(300) < 120) | (age < 30))
        chosen = choose_motion(make_problem(), p, uv, found, None, voting=voting)
        assert (chosen.decision, chosen.object_share) == (without.decision, without.object_share)


def test_a_scene_that_is_nearly_hidden_is_not_used_and_it_is_said() -> None:
    report = ObjectReport()
    half = TwoMotions(Consensus(np.eye(4), np.arange(100) < 40), 0.5, "voted")
    little = TwoMotions(Consensus(np.eye(4), np.arange(100) < 8), 0.9, "voted")
    # no object is known: wrong matches, say
    assert not any(report.hides_scene(k, little) for k in range(5))
    for k in range(5, 10):
        report.frame(k, half)
    assert report.active
    assert [
        report.hides_scene(k, motions) for k, motions in enumerate([half, *[little] * 5, half])
    ] == ([False] * 3 + [True] * 3 + [False])
    (line,) = [line for line in lines_of(report) if "hides it" in line]
    assert line.startswith("frame 3: fewer than 10 % of the points are left of the scene")


def test_an_object_is_reported_once_per_event_with_what_decided() -> None:
    everything = Consensus(np.eye(4), np.arange(10) < 6)
    nothing, object_ = TwoMotions(everything, 0.0, None), TwoMotions(everything, 0.4, "predicted")
    report = ObjectReport()

    def lines_during(frames: range, motions: TwoMotions) -> list[str]:
        for k in frames:
            report.frame(k, motions)
        return lines_of(report)

    assert lines_during(range(1), object_) == []
    assert not report.active
    assert lines_during(range(1, 4), object_) == []
    assert report.active  # and may hide the scene, before it is reported
    assert lines_during(range(4, 9), nothing) == []
    assert not report.active
    lines = lines_during(range(9, 40), object_)
    # the fifth of the last frames in which one was decided
    assert [line[:36] for line in lines] == ["frame 9: 40 % of the points move tog"]
    assert "its points are left out" in lines[0]
    assert report.active
    (line,) = lines_during(range(40, 70), nothing)
    assert line == "frame 59: no object covers much of the image any more"
    assert not report.active
    undecided = TwoMotions(everything, 0.4, "undecided")
    (line,) = lines_during(range(70, 80), undecided)
    assert "60 % and 40 % of all" in line
    assert "does not tell which group it is; the larger one is taken for the scene" in line


@pytest.mark.parametrize(("every", "named"), [(3, True), (4, False)])
def test_a_slow_object_that_some_frames_show_is_reported(every: int, named: bool) -> None:
    """Moving by whole pixels now and then, it follows the scene's motion in between."""
    everything = Consensus(np.eye(4), np.ones(10, dtype=np.bool_))
    report = ObjectReport()
    for k in range(24):
        object_share = 0.4 if k % every == 0 else 0.0
        report.frame(k, TwoMotions(everything, object_share, "voted" if object_share else None))
    found = report.take_findings()
    assert [f.code for f in found] == (["object-covers-image"] if named else [])
    assert [f.since for f in found] == ([0] if named else [])


def _stopped(old: int, young: int, shift_px: float) -> tuple[FloatArray, FloatArray, Consensus]:
    """Points (N, 3) of the scene and of an object that moves by some pixels beside it, their pixels
    (N, 2), and the consensus, which all of them follow.
    """
    p = scene(old + young, 12, (8.0, 40.0))
    turn = se3_exp([0.0, 0.0, 0.0, 0.0, shift_px / CAMERA.fu, 0.0])
    uv = pixels(T_TRUE, p, 3, 0.05)
    uv[old:] = pixels(turn @ T_TRUE, p[old:], 4, 0.05)
    return p, uv, Consensus(T_TRUE, np.ones(len(p), dtype=np.bool_))


@pytest.mark.parametrize(("shift_px", "object_share"), [(0.6, 0.75), (0.0, 0.0)])
def test_an_object_that_has_nearly_stopped_is_told_by_the_points_older_than_it(
    shift_px: float, object_share: float
) -> None:
    p, uv, found = _stopped(60, 180, shift_px)
    old = np.arange(len(p)) < 60
    chosen = without_young_object(make_problem(), p, uv, found, old)
    kept = found.inliers if chosen is None else chosen.motion.inliers
    assert kept[old].all()
    assert kept[~old].mean() == pytest.approx(1.0 - object_share / 0.75, abs=0.05)
    share = 0.0 if chosen is None else chosen.object_share
    assert share == pytest.approx(object_share, abs=0.05)


def test_an_object_that_has_nearly_stopped_is_left_as_it_is_where_few_older_points_are_left() -> (
    None
):
    p, uv, found = _stopped(11, 180, 0.6)
    assert without_young_object(make_problem(), p, uv, found, np.arange(len(p)) < 11) is None


def test_points_of_an_object_that_walks_in_and_stops_are_not_followed_further() -> None:
    p, moving, _ = scenery(120, 100)
    age = np.where(np.arange(len(p)) < 120, 50, 0)
    motion = SceneMotion()
    p_stopped, stopped, everything = _stopped(120, 100, 0.6)
    slow = []
    for index in range(14):
        points = MovedPoints(p, moving, age + index)
        found = rigid_consensus(make_problem(), p, moving, T_TRUE, None, None)
        if index >= 8:
            points = MovedPoints(p_stopped, stopped, age + index)
            found = everything
        assert found is not None
        slow.append(motion.choose(index, make_problem(), points, found, None, 0.0).slow)
    assert [f.code for f in motion.take_findings()] == ["object-covers-image"]
    assert slow[7] is None
    for mask in slow[8:]:
        assert mask is not None
        assert mask[120:].mean() > 0.95
        assert not mask[:120].any()


def _lines(p: FloatArray, z: FloatArray, uv: FloatArray) -> list[str]:
    """What six frames say, after a second of matches to learn rows from.

    Features at stereo pixels z (N, 4), taken for points p (N, 3), move to left pixels uv (N, 2).
    """
    bank = AnchorBank(len(p), ANCHOR_RADIUS_PX)
    stereo = StereoFit(CAMERA, DisparitySettings(), bank, (1220, 480))
    static = StaticFeatures(RightImages(CAMERA))
    blank = ImageLevels(np.zeros((480, 1220), np.uint8), np.zeros((240, 610), np.uint8))
    everything = np.ones(len(p), dtype=np.bool_)
    new = new_tracks(z[:, :2].copy(), np.zeros(len(p), dtype=np.int64))
    tracks = replace(new, right=z[:, 2:], has_right=everything, point=p, has_point=everything)
    for _ in range(20):
        stereo.update_rows(tracks)
    for k in range(6):
        images = FrameImages(StereoFrame(k, 0, None, None), blank, None, stereo)
        static.select(make_problem(), tracks, uv, everything, None, np.eye(4), images)
    return [finding.message for finding in static.take_findings()]


def _yawed(z: FloatArray) -> FloatArray:
    """Stereo pixels (N, 4) of a right camera that is turned by 1 deg about its vertical axis."""
    rays = np.column_stack([(z[:, 2:] - [CAMERA.cu, CAMERA.cv]) / CAMERA.fu, np.ones(len(z))])
    turned = rays @ so3_exp([0.0, np.radians(-1.0), 0.0]).T
    out = z.copy()
    out[:, 2:] = turned[:, :2] / turned[:, 2:] * CAMERA.fu + [CAMERA.cu, CAMERA.cv]
    return out


def _two_walls() -> FloatArray:
    """Points (300, 3) on walls 16 m and 6 m ahead, the nearer 120 last."""
    far, near = scene(180, 12, (16.0, 16.8)), scene(120, 13, (6.0, 6.3))
    p = np.concatenate([far, near]) * [0.6, 1.5, 1.0]
    p[:, 1] += 0.1 * p[:, 2]  # within the image's 480 rows
    return p


def test_wrong_depths_of_a_yawed_right_camera_are_no_moving_object() -> None:
    """With 12.6 px of disparity too much, 16 m become 10 and 6 m become 5: the walls seem to
    move apart.
    """
    p = _two_walls()
    z, uv = _yawed(project(CAMERA, p)), pixels(T_TRUE, p, 14)
    wrong, _ = triangulate(CAMERA, z)
    found = rigid_consensus(make_problem(), wrong, uv, np.eye(4), None, None)
    assert found is not None
    assert choose_motion(make_problem(), wrong, uv, found, None).object_share > 0.25  # control
    assert _lines(wrong, z, uv) == []


def test_a_moving_object_is_reported_where_the_rows_are_off() -> None:
    p = _two_walls()
    z = _yawed(project(CAMERA, p))
    uv = np.concatenate([pixels(T_TRUE, p[:180], 14), pixels(T_OBJECT, p[180:], 15)])
    (line,) = _lines(triangulate(CAMERA, z)[0], z, uv)
    assert "two groups of points move differently" in line


def test_a_wall_that_keeps_its_place_in_the_image_is_reported_where_the_rows_are_off() -> None:
    """On a straight road it passes for something far away, as the epipolar lines say; 25 px of
    disparity are not none because the rows are off by half a pixel.
    """
    far, wall = scene(180, 12, (12.0, 40.0)), scene(180, 13, (15.0, 16.0))
    p = np.concatenate([far, wall]) * [0.6, 1.5, 1.0]
    p[:, 1] += 0.1 * p[:, 2]
    z = project(CAMERA, p)
    z[:, 3] += 0.5  # a pitch of the right camera
    straight = se3_exp([0.0, 0.0, -1.1, 0.0, 0.0, 0.0])
    uv = np.concatenate([pixels(straight, p[:180], 14), z[180:, :2] + 0.05])
    lines = _lines(triangulate(CAMERA, z)[0], z, uv)
    assert sum("two groups of points move differently" in line for line in lines) == 1


def test_left_images_show_an_object_that_covers_most_of_them() -> None:
    """Their epipolar geometry is the object's then, and the scene's few points are off it."""
    p, uv, _ = scenery(60, 240)
    chosen, _, _ = choose(60, 240, prediction())
    assert chosen.object_share > 0.7
    assert not one_motion_explains(make_problem(), chosen, p, uv, 5.0)


def test_an_object_that_moves_along_the_road_is_reported_where_the_rows_agree() -> None:
    """Its points stay on the epipolar lines of the scene: without its depths it would pass for
    static.
    """
    p = np.concatenate([scene(180, 12, (12.0, 40.0)), scene(120, 13, (6.0, 8.0))])
    T_car = se3_from_parts(T_TRUE[:3, :3], 0.4 * T_TRUE[:3, 3])
    uv = np.concatenate([pixels(T_TRUE, p[:180], 14), pixels(T_car, p[180:], 15)])
    (line,) = _lines(p, project(CAMERA, p), uv)
    assert "two groups of points move differently" in line


def test_a_prediction_that_is_no_number_is_not_used() -> None:
    broken = MotionPrior(np.full((4, 4), np.nan), IMU)
    prior = usable_prior(
        TrackPrior(np.array([1]), np.array([[1.0, 2.0, 0.0, 2.0]]), np.eye(3), broken)
    )
    assert prior.motion is None
    good = usable_prior(
        TrackPrior(np.array([1]), np.array([[1.0, 2.0, 0.0, 2.0]]), np.eye(3), prediction())
    )
    assert good.motion is not None


def test_the_rows_of_another_exposure_are_left_out_of_a_torn_image() -> None:
    """The larger part does not move, the other moves as predicted; points of both are old."""
    p = scene(400, 12, (8.0, 40.0))
    before = project(CAMERA, p)[:, :2]
    upper = before[:, 1] < np.quantile(before[:, 1], 0.6)
    uv = np.where(upper[:, None], before, pixels(T_TRUE, p, 14))
    expected = replace(prediction(), measured=False)
    expected = replace(expected, covariance=np.diag(np.repeat([0.3, 0.03], 3) ** 2))
    found = Consensus(np.eye(4), pixel_errors(CAMERA, np.eye(4), p, uv) <= LIMIT_PX)
    old = np.ones(len(p), dtype=np.bool_)
    chosen = choose_motion(make_problem(), p, uv, found, expected, voting=old)
    assert chosen.decision == "predicted"
    assert chosen.motion.T_curr_prev == pytest.approx(T_TRUE, abs=0.02)
    assert chosen.motion.inliers[upper].mean() < 0.2
    assert chosen.motion.inliers[~upper].mean() > 0.9
    # the same two groups, spread over all rows: an object, on which the old points do not agree
    mixed = np.arange(len(p)) % 5 < 3
    uv = np.where(mixed[:, None], before, pixels(T_TRUE, p, 14))
    found = Consensus(np.eye(4), pixel_errors(CAMERA, np.eye(4), p, uv) <= LIMIT_PX)
    chosen = choose_motion(make_problem(), p, uv, found, expected, voting=old)
    assert chosen.motion.T_curr_prev == pytest.approx(np.eye(4), abs=0.02)


class _Run:
    """Frames whose points all follow one motion."""

    def __init__(self) -> None:
        self.motion = SceneMotion()
        self.index = 0
        self.said: list[str] = []
        self._p = scene(200, 12, (5.0, 20.0))
        self._age = np.zeros(200, dtype=np.int64)

    def frames(self, count: int, T: FloatArray, *, measured: MotionPrior | None = None) -> None:
        prior = None
        if measured is not None:
            prior = TrackPrior(np.zeros(0, np.int64), np.zeros((0, 4)), None, measured)
        for _ in range(count):
            points = MovedPoints(self._p, pixels(T, self._p, 3, 0.05), self._age)
            found = Consensus(T, np.ones(len(self._p), dtype=np.bool_))
            chosen = self.motion.choose(self.index, make_problem(), points, found, prior, 0.0)
            self._age = np.where(chosen.static, self._age + 1, 0)
            self.said += [f"-{f.code}" if f.ended else f.code for f in self.motion.take_findings()]
            self.index += 1

    def lose(self, kept: int, skipped: int = 0) -> None:
        """All points but a few are replaced by others, after frames without a motion."""
        self._age[kept:] = 0
        self.index += skipped

    def renew(self, part: int) -> None:
        """A third of the points are replaced by others."""
        self._age[part::3] = 0


STILL = np.eye(4)
SLOW = se3_exp([0.002, 0.0, -0.001, 0.0, 0.0002, 0.0])
MOVING = se3_exp([0.02, 0.0, -0.01, 0.0, 0.002, 0.0])


def test_what_replaces_all_points_of_the_scene_at_once_is_doubted_while_it_stays() -> None:
    run = _Run()
    run.frames(8, SLOW)
    run.lose(0, skipped=3)
    run.frames(60, STILL)
    assert run.said == ["object-or-scene"]


def test_points_of_the_scene_that_are_left_prove_its_motion() -> None:
    for motion in (SLOW, MOVING):
        run = _Run()
        run.frames(8, motion)
        run.lose(5)
        run.frames(60, motion)
        assert run.said == []


def test_what_replaces_nearly_all_points_and_stays_at_its_pixels_is_of_the_rig() -> None:
    run = _Run()
    run.frames(8, MOVING)
    run.lose(5)
    run.frames(60, STILL)
    assert run.said == ["rig-in-view"]


def test_new_points_are_no_event_where_the_motion_has_left_the_old_ones_behind() -> None:
    run = _Run()
    run.frames(8, se3_exp([0.0, 0.0, -1.5, 0.0, 0.15, 0.0]))
    run.lose(0, skipped=5)
    run.frames(30, SLOW)
    assert run.said == []


def test_what_was_doubted_is_the_scene_once_all_of_it_has_passed() -> None:
    run = _Run()
    run.frames(8, SLOW)
    run.lose(0)
    run.frames(10, STILL)
    assert run.said == ["object-or-scene"]
    run.frames(60, se3_exp([0.0, 0.0, -1.0, 0.0, 0.0, 0.0]))
    assert run.said == ["object-or-scene", "-object-or-scene"]


def test_an_object_that_has_hidden_the_scene_is_doubted_when_it_stops() -> None:
    """No point is older than it any more."""
    p, uv, truck = scenery(120, 100)
    motion = SceneMotion()
    age = np.where(truck, 0, 50)
    codes = []
    for index in range(60):
        points = MovedPoints(p, uv, age)
        found = rigid_consensus(make_problem(), p, uv, T_TRUE, None, None)
        if index >= 8:
            points = MovedPoints(p, pixels(STILL, p, 3, 0.05), np.full(len(p), index - 8))
            found = Consensus(STILL, np.ones(len(p), dtype=np.bool_))
        assert found is not None
        motion.choose(index, make_problem(), points, found, None, 0.0)
        codes += [f"-{f.code}" if f.ended else f.code for f in motion.take_findings()]
    assert codes == [
        "object-covers-image",
        "-object-covers-image",
        "object-or-scene",
        "rig-in-view",
    ]


def test_a_sensor_overrules_what_replaces_all_points_of_the_scene() -> None:
    moving = se3_exp([0.02, 0.0, -0.05, 0.0, 0.002, 0.0])
    run = _Run()
    run.frames(8, moving, measured=prediction(moving))
    run.lose(0)
    run.frames(10, STILL, measured=prediction(moving))
    assert run.said == ["object-hides-scene", "object-covers-image", "rig-in-view"]
    run.frames(40, moving, measured=prediction(moving))
    assert run.said[3:] == ["-rig-in-view", "-object-covers-image", "-object-hides-scene"]


def test_points_that_live_for_a_few_frames_only_are_of_the_scene_as_long_as_they_overlap() -> None:
    """As in rain."""
    run = _Run()
    run.frames(8, SLOW)
    for part in range(30):
        run.renew(part % 3)
        run.frames(1, SLOW)
    assert run.said == []


def test_another_view_of_a_rig_that_moves_on_is_the_scene() -> None:
    """Joined recordings: what moves with the rig would not move in the image."""
    run = _Run()
    run.frames(8, se3_exp([0.05, 0.0, -0.1, 0.0, 0.01, 0.0]))
    run.lose(0)
    run.frames(30, se3_exp([-0.1, 0.02, -0.1, 0.01, 0.0, 0.0]))
    assert run.said == []
