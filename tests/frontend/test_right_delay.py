"""A right camera that is late or early against the left one: measured, named, and taken out of
the matches.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.frontend.test_frontend_scene import CAMERA, SLANTED, stereo_frame, truth
from tests.guards import lines_of, messages
from vio.frontend.klt import KltFrontend
from vio.frontend.right_delay import PairingCounts, RightDelay, at_exposure, at_present
from vio.frontend.right_turn import RightTurn
from vio.frontend.settings import FrontendSettings, GridSettings
from vio.frontend.tracks import new_tracks
from vio.geometry.lie import FloatArray, se3_exp, transform_points
from vio.geometry.stereo import project
from vio.records import FrontendOutput, StereoFrame

FRAME_S = 0.05
FRAMES = 18


def feed(
    delay: float, *, field: float = 0.3, noise: float = 0.2, flow_px: float = 4.0
) -> tuple[RightDelay, list[str]]:
    """Matches of 40 frames: rows off by a constant field over the image, by noise, and by the
    delay.
    """
    rng, estimator, lines = np.random.default_rng(0), RightDelay(CAMERA), []
    for k in range(40):
        left = rng.uniform([0, 0], [480, 300], (80, 2))
        flow = np.array([5.0, flow_px * np.sin(0.4 * k)]) + rng.normal(0, 0.5, (80, 2))
        x, y = (left - [CAMERA.cu, CAMERA.cv]).T / CAMERA.fu
        rows = field * (1 + x - 0.5 * y + x * y) - delay * flow[:, 1] + rng.normal(0, noise, 80)
        rows[:8] += rng.uniform(-20, 20, 8)  # mismatches
        estimator.update(k, left, flow, rows, FRAME_S)
        lines += lines_of(estimator)
    return estimator, lines


@pytest.mark.parametrize(
    ("delay", "found", "text"), [(1.0, 1.0, "late by "), (-0.4, -0.4, "early by ")]
)
def test_finds_the_delay_beside_a_wrong_rectification(
    delay: float, found: float, text: str
) -> None:
    estimator, lines = feed(delay)
    assert estimator.frames == pytest.approx(found, abs=0.05)
    (line,) = lines
    assert f"the right camera is {text}" in line
    assert "synchronise the cameras" in line


@pytest.mark.parametrize("flow_px", [0.0, 4.0])
@pytest.mark.parametrize("field", [0.0, 0.8])
def test_simultaneous_cameras_are_silent(flow_px: float, field: float) -> None:
    estimator, lines = feed(0.0, field=field, flow_px=flow_px)
    assert (estimator.frames, lines) == (0.0, [])


def test_a_small_delay_is_left_alone() -> None:
    assert feed(0.1)[0].frames == 0.0


def test_the_pairing_that_matches_names_a_whole_frame() -> None:
    """Images of another frame contradict the left one too much for their rows to be measured."""
    # An early image is used with the next left one, and then on time.
    for late, early, frames in ((120, 20, 1.0), (20, 120, 0.0)):
        estimator = RightDelay(CAMERA)
        counts = PairingCounts(points=150, same=30, late=late, early=early)
        assert not estimator.suspect(0, counts, FRAME_S)
        assert estimator.suspect(1, counts, FRAME_S)
        assert estimator.frames == frames
        assert len(lines_of(estimator)) == 1
    for counts in (
        PairingCounts(150, 100, 120, 90),
        PairingCounts(150, 5, 30, 5),
        PairingCounts(150, 90, 120, 119),
    ):
        estimator = RightDelay(CAMERA)
        assert not any(estimator.suspect(k, counts, FRAME_S) for k in range(5))


def test_an_early_camera_that_is_on_time_again_is_late_against_its_repair() -> None:
    estimator = RightDelay(CAMERA)
    early, late = PairingCounts(150, 30, 20, 120), PairingCounts(150, 30, 120, 20)
    assert [estimator.suspect(k, early, FRAME_S) for k in range(2)] == [False, True]
    assert [estimator.suspect(k, late, FRAME_S) for k in range(2, 4)] == [False, True]
    assert estimator.frames == 0.0
    assert lines_of(estimator)[-1] == "frame 3: the right camera is no longer late or early"


def test_matches_of_a_late_image_are_brought_to_the_present_exactly() -> None:
    """The right pixels that a point has now follow from those that it had a frame ago and from
    the motion since.
    """
    T = se3_exp([0.05, -0.02, -0.3, 0.01, -0.02, 0.03])
    rng = np.random.default_rng(1)
    p_then = np.stack(
        [rng.uniform(-1, 1, 30), rng.uniform(-0.6, 0.6, 30), rng.uniform(2, 6, 30)], axis=1
    )
    p_now = transform_points(T, p_then)
    z_then, z_now = project(CAMERA, p_then), project(CAMERA, p_now)
    tracks = replace(
        new_tracks(z_now[:, :2], np.arange(30)), point=p_now, has_point=np.ones(30, dtype=np.bool_)
    )
    then = at_exposure(tracks, z_now[:, :2] - z_then[:, :2], T, 1.0)
    np.testing.assert_allclose(then.left, z_then[:, :2], atol=1e-9)
    np.testing.assert_allclose(then.warp[:, :, 2], then.left, atol=1e-9)
    np.testing.assert_allclose(then.point, p_then, atol=1e-9)
    then = replace(then, right=z_then[:, 2:], has_right=np.arange(30) < 20)
    now = at_present(CAMERA, tracks, then, T, 1.0)
    np.testing.assert_allclose(now.right[:20], z_now[:20, 2:], atol=1e-6)
    assert now.has_right.tolist() == [True] * 20 + [False] * 10


def late_flight(frames_late: int) -> tuple[list[FloatArray], list[StereoFrame]]:
    """A flight with vertical motion that comes and goes, whose right images are those of another
    frame.
    """
    heights = 0.06 * np.sin(0.6 * np.arange(FRAMES))
    poses = [se3_exp([0.02 * k, heights[k], 0.02 * k, 0.0, 0.0, 0.0]) for k in range(FRAMES)]
    frames = [stereo_frame(k, pose) for k, pose in enumerate(poses)]
    shown = np.clip(np.arange(FRAMES) - frames_late, 0, FRAMES - 1)
    return poses, [replace(frame, right=frames[shown[k]].right) for k, frame in enumerate(frames)]


@pytest.mark.parametrize(("frames_late", "named"), [(1, "late"), (-1, "early")])
def test_front_end_matches_a_late_or_early_right_camera_as_if_it_were_on_time(
    frames_late: int, named: str
) -> None:
    poses, frames = late_flight(frames_late)
    frontend = KltFrontend(CAMERA, FrontendSettings(grid=GridSettings(target_features=150)))
    outputs: list[FrontendOutput] = [frontend.process(frame) for frame in frames]

    def median_error(k: int) -> float:
        seen = outputs[k].observations.take(outputs[k].observations.has_right)
        assert len(seen) > 60
        expected = truth(SLANTED, poses[k], seen.z[:, :2], poses[k])
        return float(np.median(np.abs(seen.z[:, 2] - expected[:, 2])))

    line = [line for output in outputs for line in messages(output)][-1]
    assert f"the right camera is {named} by 50 ms (1.00 frames)" in line
    begun = int(line.split()[1].rstrip(":"))
    assert begun < 12
    assert not outputs[begun - 1].observations.has_right.any()  # control: the fault does harm
    # An early image is kept from the second frame on; the last frame of the flight has no later
    # right image.
    first, last = (begun + 1, FRAMES) if frames_late > 0 else (begun + 3, FRAMES - 1)
    assert max(median_error(k) for k in range(first, last)) < 0.1


def _swaying(frames: float) -> FloatArray:
    """A pose on a way to the right, with vertical motion that comes and goes."""
    return se3_exp([0.03 * frames, 0.02 * np.sin(0.6 * frames), 0.02 * frames, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("missing", [(), (18, 19, 23)])
def test_depths_of_cameras_that_expose_apart_are_right_also_where_frames_are_missing(
    missing: tuple[int, ...],
) -> None:
    """Half a frame late in a steady motion to the right looks like a turned camera at first; what
    was taken out for it was left in all disparities, 1.2 px. After a missing frame, the motion
    since the last one is that of two.
    """
    frontend = KltFrontend(CAMERA, FrontendSettings(grid=GridSettings(target_features=150)))
    lines: list[str] = []
    for k in range(27):
        late = stereo_frame(k, _swaying(max(k - 0.5, 0.0)))
        frame = replace(stereo_frame(k, _swaying(k)), right=late.right)
        if k in missing:
            continue
        output = frontend.process(frame)
        lines += messages(output)
        if k < 13:
            continue
        seen = output.observations.take(output.observations.has_right)
        assert len(seen) > 100, k
        expected = truth(SLANTED, _swaying(k), seen.z[:, :2], _swaying(k))
        assert np.median(np.abs(seen.z[:, 2] - expected[:, 2])) < 0.1, k
    said = " ".join(lines)
    assert "the right camera is late by 25 ms" in said
    assert "the right camera has not turned" in said


@pytest.mark.parametrize(
    ("late", "fast", "most_px"), [(0.5, 1.0, 0.1), (-0.5, 1.0, 0.25), (0.3, 2.0, 0.1)]
)
def test_new_features_have_depths_beside_a_camera_that_exposes_earlier_or_later(
    late: float, fast: float, most_px: float
) -> None:
    """They are searched in the two images that were exposed nearest to one another: with the last
    left image, where the right camera is early, two thirds had none, and six of seven where it is
    late by less than half a frame.
    """

    def pose(frames: float) -> FloatArray:
        along = fast * frames
        return se3_exp(
            [0.03 * along, 0.02 * fast * np.sin(0.6 * frames), 0.02 * frames, 0.0, 0.0, 0.0]
        )

    frontend = KltFrontend(CAMERA, FrontendSettings(grid=GridSettings(target_features=150)))
    for k in range(22):
        right = stereo_frame(k, pose(max(k - late, 0.0))).right
        output = frontend.process(replace(stereo_frame(k, pose(k)), right=right))
    seen = output.observations.take(output.observations.has_right)
    assert len(seen) > 100
    expected = truth(SLANTED, pose(21), seen.z[:, :2], pose(21))
    assert np.median(np.abs(seen.z[:, 2] - expected[:, 2])) < most_px


def test_a_turn_that_no_delay_explains_stays() -> None:
    turn = RightTurn(700.0)
    for k in range(6):
        turn.frame(k, 2.0, -3.0)
    turn.take_findings()
    assert not turn.explained(10, 0.5)
    assert turn.take_findings() == ()
    assert turn.explained(11, -0.6)
    (ended,) = turn.take_findings()
    assert ended.ended


def test_times_between_frames_are_counted_in_usual_ones() -> None:
    delay = RightDelay(CAMERA)
    steps_s = [0.05, 0.051, 0.1, 0.049, 0.05, 0.1505, 0.05]
    assert [delay.count(s) for s in steps_s] == pytest.approx([1, 1, 2, 1, 1, 3, 1], abs=0.05)
