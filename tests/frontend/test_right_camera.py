"""A right camera that is frozen, dark or displaced: named, and not used until it agrees with the
left one again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.frontend.test_frontend_scene import (
    CAMERA,
    SLANTED,
    eight_bit,
    flight,
    right_of,
    stereo_frame,
    truth,
    view,
)
from tests.guards import codes, guarded_klt, lines_of, messages
from vio.frontend.prediction import prior_depths
from vio.frontend.right_camera import RightCamera
from vio.frontend.right_turn import RightTurn
from vio.frontend.settings import FrontendSettings, GridSettings
from vio.frontend.stereo_fit import common_offset
from vio.geometry.lie import FloatArray, se3_exp
from vio.guard.frozen_image import FrozenCamera
from vio.records import FrontendOutput, Image, StereoFrame, TrackPrior

SETTINGS = FrontendSettings(grid=GridSettings(target_features=150))
FROZEN = range(3, 8)  # frames with the right image of frame 2
FRAMES = 12
RNG = np.random.default_rng(0)
TEXTURE = cv2.GaussianBlur(RNG.integers(0, 256, (150, 400)).astype(np.uint8), (0, 0), 2.0)
TEXTURE = cv2.normalize(TEXTURE, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)  # type: ignore[call-overload]

Pair = tuple[Image, Image]


def pair(k: int) -> Pair:
    """Images of frame k of a camera that moves sideways, with sensor noise, and a right camera
    of another gain.
    """
    rng = np.random.default_rng(k)
    crops = (TEXTURE[:, 100 + 3 * k : 300 + 3 * k], TEXTURE[:, 110 + 3 * k : 310 + 3 * k] * 0.6)
    left, right = (np.clip(c + rng.normal(0, 1.0, c.shape), 0, 255).astype(np.uint8) for c in crops)
    return left, right


def noisy(image: Image, seed: int) -> Image:
    """The image as an encoder might repeat it: off by one gray level here and there."""
    off = np.random.default_rng(seed).integers(-1, 2, image.shape)
    return np.clip(image.astype(np.int16) + off, 0, 255).astype(np.uint8)


def run(frames: list[Pair]) -> tuple[list[bool], list[bool], list[str]]:
    """Whether the right image could be used, whether the left one was frozen, and the lines,
    frame by frame.
    """
    camera = FrozenCamera()
    usable, frozen, lines = [], [], []
    for k, (left, right) in enumerate(frames):
        frozen.append(camera.left_is_frozen(k, left, right))
        usable.append(camera.right_usable)
        lines += lines_of(camera)
    return usable, frozen, lines


def test_moving_and_standing_cameras_are_silent() -> None:
    moving = [pair(k) for k in range(8)]
    standing = [(noisy(a, k), noisy(b, 100 + k)) for k in range(8) for a, b in [pair(0)]]
    equal = [pair(0)] * 8  # without any noise: whether it is frozen is for the IMU to say
    for frames in (moving, standing, equal):
        usable, frozen, lines = run(frames)
        assert (all(usable), any(frozen), lines) == (True, False, [])


@pytest.mark.parametrize(
    "repeat", [lambda image, k: image, noisy], ids=["equal to the bit", "re-encoded"]
)
def test_a_frozen_right_image_is_not_used_and_named_once(
    repeat: Callable[[Image, int], Image],
) -> None:
    frames = [pair(k) for k in range(14)]
    for k in FROZEN:
        frames[k] = frames[k][0], repeat(frames[2][1], k)
    usable, frozen, lines = run(frames)
    assert not any(frozen)
    assert [k for k, good in enumerate(usable) if not good] == [*FROZEN]
    said, again = lines
    assert said.startswith("frame 5: the right camera is frozen")
    assert "since frame 2; going on with the left images" in said
    assert again == "frame 8: the right camera gives new images again"


def test_a_single_repeated_right_image_is_not_used_and_not_an_event() -> None:
    frames = [pair(k) for k in range(10)]
    frames[4] = frames[4][0], frames[3][1]
    usable, _, lines = run(frames)
    assert not usable[4]
    assert usable[-1]
    assert lines == []


def test_a_frozen_left_image_is_known_and_named_once() -> None:
    frames = [pair(k) for k in range(12)]
    for k in FROZEN:
        frames[k] = frames[2][0], frames[k][1]
    _, frozen, lines = run(frames)
    assert [k for k, bad in enumerate(frozen) if bad] == [*FROZEN]
    line, again = lines
    assert again == "frame 8: the left camera gives new images again"
    assert line.startswith(
        "frame 5: the left camera is frozen: it gives earlier images again since frame 2"
    )


def test_an_exposure_of_its_own_that_clips_the_left_image_freezes_no_camera() -> None:
    """The rig stands still; the left camera's exposure is long in one frame, so that a fifth of
    its pixels clip.
    """
    smooth = cv2.GaussianBlur(TEXTURE, (0, 0), 3.0)
    frames = [(noisy(smooth[:, :200], k), noisy(smooth[:, 10:210], 20 + k)) for k in range(7)]
    bright = np.clip(frames[4][0] * 1.8, 0, 255).astype(np.uint8)
    assert np.mean(bright == 255) > 0.15
    frames[4] = bright, frames[4][1]
    usable, frozen, lines = run(frames)
    assert (all(usable), any(frozen), lines) == (True, False, [])


def test_a_dark_right_image_is_named() -> None:
    frames = [pair(k) for k in range(12)]
    for k in FROZEN:
        frames[k] = frames[k][0], np.full_like(frames[k][1], 3)
    usable, _, lines = run(frames)
    assert not any(usable[k] for k in FROZEN)
    assert lines[0].startswith("frame 5: the right camera is dark or covered")


def test_matches_decide_where_the_images_are_plausible() -> None:
    """Most points of known depth are not where they should be, for six frames: said once, and
    when it is over.
    """
    camera, lines = RightCamera(), []
    for k in range(16):
        matched = np.arange(40) < (4 if 5 <= k < 11 else 36)
        assert camera.check_matches(k, matched, moved=True) == (not 5 <= k < 13)
        lines += lines_of(camera)
    assert [line.partition(",")[0] for line in lines] == [
        "frame 8: the right image contradicts the left one",
        "frame 13: the right images agree with the left ones again",
    ]


def test_few_points_or_an_unknown_motion_contradict_nothing() -> None:
    camera = RightCamera()
    assert camera.check_matches(0, np.zeros(10, dtype=np.bool_), moved=True)
    assert camera.check_matches(0, np.zeros(80, dtype=np.bool_), moved=False)


def _contradicted() -> RightCamera:
    camera = RightCamera()
    for k in range(-3, 4):
        camera.check_matches(k, np.full(80, k < 0), moved=True)
    assert not camera.usable
    lines_of(camera)
    return camera


def test_six_points_suffice_to_agree_again() -> None:
    for count, usable in ((6, True), (5, False)):
        camera = _contradicted()
        for k in range(4, 7):
            camera.check_matches(k, np.arange(count) > 0, moved=True)
        assert camera.usable == usable


def test_where_no_feature_is_left_the_right_image_is_tried_again() -> None:
    """By images alone: depths that the left images give from then on are of any scale.

    A frozen image stays one.
    """
    camera = _contradicted()
    camera.try_again(4)
    assert camera.usable
    assert lines_of(camera) == [
        "frame 4: no feature is left that contradicts the right images; they are used again"
    ]
    frozen = RightCamera()
    frozen.by_image(3, usable=False)
    frozen.try_again(4)
    assert not frozen.usable


def test_prior_gives_the_depth_of_the_features_that_it_names() -> None:
    z = np.array([[100.0, 50.0, 80.0, 50.0], [200.0, 60.0, 200.0, 60.0]])
    depth, known = prior_depths(
        CAMERA, np.array([-1, 7, 5, -1, 9]), TrackPrior(np.array([7, 9]), z[::-1])
    )
    assert known.tolist() == [False, False, False, False, True]  # a disparity of zero is no depth
    assert depth[4] == pytest.approx(CAMERA.fu * CAMERA.baseline_m / 20.0)


def run_frozen(camera: str) -> tuple[list[StereoFrame], list[FrontendOutput]]:
    """A flight with a camera that is frozen in some frames; the prior knows the true pixels, as
    a filter does.
    """
    poses = flight(FRAMES)
    frames = [stereo_frame(k, pose) for k, pose in enumerate(poses)]
    frames = [
        replace(f, **{camera: getattr(frames[2], camera)}) if f.index in FROZEN else f
        for f in frames
    ]
    frontend = guarded_klt(CAMERA, SETTINGS)
    outputs: list[FrontendOutput] = []
    for k, frame in enumerate(frames):
        prior = None
        if k:
            seen = outputs[-1].observations
            prior = TrackPrior(seen.ids, truth(SLANTED, poses[k - 1], seen.z[:, :2], poses[k]))
        outputs.append(frontend.process(frame, prior))
    return frames, outputs


@pytest.fixture(scope="module")
def frozen_run() -> tuple[list[StereoFrame], list[FrontendOutput]]:
    return run_frozen("right")


def test_the_right_images_carry_the_features_of_a_frozen_left_camera() -> None:
    """They are output at the left pixels where that camera would see them, and go on in it
    afterwards.
    """
    poses, (_, outputs) = flight(FRAMES), run_frozen("left")
    first = outputs[2].observations
    for k in [*FROZEN, 8]:
        seen = outputs[k].observations
        _, a, b = np.intersect1d(first.ids, seen.ids, return_indices=True)
        error = seen.z[b, :2] - truth(SLANTED, poses[2], first.z[a, :2], poses[k])[:, :2]
        assert len(error) > 60
        assert np.median(np.abs(error)) < 0.1
        assert np.mean(np.abs(error) > 1.0) < 0.01
        assert seen.has_right.any() == (k == 8)
    assert codes(outputs) == ["left-image-frozen", "-left-image-frozen"]


@pytest.mark.parametrize("camera", ["left", "right"])
def test_a_frozen_image_is_not_taken_for_the_other_cameras(camera: str) -> None:
    """The rig moves by more than a baseline, so that a frozen image is one from the other
    camera's far side.
    """
    step = np.array([0.08 if camera == "right" else -0.08, 0.0, 0.0, 0.0, 0.0, 0.0])
    frames = [stereo_frame(k, se3_exp(k * step)) for k in range(FRAMES)]
    frames = [
        replace(f, **{camera: getattr(frames[2], camera)}) if f.index in FROZEN else f
        for f in frames
    ]
    frontend = guarded_klt(CAMERA, SETTINGS)
    lines = [line for frame in frames for line in messages(frontend.process(frame))]
    assert lines
    assert not [line for line in lines if "exchanged" in line]


def test_front_end_goes_on_with_the_left_images_of_a_frozen_pair(
    frozen_run: tuple[list[StereoFrame], list[FrontendOutput]],
) -> None:
    """No right pixel of a frozen image is output, no track is lost for it, and right pixels are
    right again later.
    """
    poses, (_, outputs) = flight(FRAMES), frozen_run
    for k in range(1, FRAMES):
        seen = outputs[k].observations
        assert seen.has_right.any() == (k not in [*FROZEN, 8, 9])
        assert outputs[k].tracked > 0.8 * SETTINGS.grid.target_features
        matched = seen.take(seen.has_right)
        expected = truth(SLANTED, poses[k], matched.z[:, :2], poses[k])
        assert np.abs(matched.z[:, 2] - expected[:, 2]).max(initial=0.0) < 1.0
    assert outputs[-1].observations.has_right.mean() > 0.6
    assert codes(outputs) == ["right-image-frozen", "-right-image-frozen"]


def turned_frame(index: int, pose: FloatArray, yaw_deg: float) -> StereoFrame:
    """A frame whose right camera has turned about its vertical axis."""
    turn = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, np.radians(yaw_deg), 0.0]))
    right = eight_bit(view(SLANTED, right_of(pose) @ turn), 2 * index + 1)
    return replace(stereo_frame(index, pose), right=right)


def flight_with_turns(yaw_deg: Callable[[int], float]) -> list[FrontendOutput]:
    frontend = guarded_klt(CAMERA, SETTINGS)
    return [
        frontend.process(turned_frame(k, pose, yaw_deg(k))) for k, pose in enumerate(flight(FRAMES))
    ]


@pytest.mark.parametrize("yaw_deg", [0.26, -0.26])
def test_a_right_camera_that_turns_a_little_is_used_without_the_offset(yaw_deg: float) -> None:
    """A quarter of a degree moves all disparities by 1.4 px and more, in single frames."""
    outputs = flight_with_turns(lambda k: yaw_deg if k in (3, 6) else 0.0)
    assert [line for output in outputs for line in messages(output)] == []
    for k, pose in enumerate(flight(FRAMES)):
        seen = outputs[k].observations
        assert seen.has_right.mean() > 0.6
        matched = seen.take(seen.has_right)
        off = matched.z[:, 2] - truth(SLANTED, pose, matched.z[:, :2], pose)[:, 2]
        if k in (3, 6):
            assert abs(np.median(off)) < 0.3 * CAMERA.fu * np.radians(abs(yaw_deg))


@pytest.mark.parametrize("yaw_deg", [0.13, 0.2])
def test_a_right_camera_that_stays_turned_is_named_once_and_put_back(yaw_deg: float) -> None:
    """Depths remain those of the pair as it was, those of new features too; 0.13 degrees are
    0.7 px, and lose no match.
    """
    outputs = flight_with_turns(lambda k: yaw_deg if k >= 3 else 0.0)
    found = [finding for output in outputs for finding in output.findings]
    (turned,) = [f for f in found if f.code == "right-camera-turned"]
    assert (turned.frame, turned.since) == (8, 3)
    assert abs(turned.figures["turned_deg"]) == pytest.approx(yaw_deg, rel=0.1)
    for k, (output, pose) in enumerate(zip(outputs, flight(FRAMES), strict=True)):
        seen = output.observations
        matched = seen.take(seen.has_right)
        assert len(matched) > 0.6 * len(seen)
        off = matched.z[:, 2] - truth(SLANTED, pose, matched.z[:, :2], pose)[:, 2]
        assert abs(np.median(off)) < 0.1, k


def test_offsets_that_change_are_no_turn_that_stays() -> None:
    shaking = RightTurn(700.0)
    offsets = np.random.default_rng(5).normal(0.0, 2.0, 400)
    assert all(shaking.frame(k, float(o)) is None for k, o in enumerate(offsets))
    assert shaking.take_findings() == ()
    apart = RightTurn(700.0)  # five in a row, and one after a frame without
    for k, offset in enumerate([2.0] * 5 + [None, 2.0]):
        assert apart.frame(k, offset) is None
    ramp = RightTurn(700.0)
    assert all(ramp.frame(k, 1.0 + 0.1 * k) is None for k in range(10))


def test_small_offsets_of_a_pair_that_shakes_are_taken_out_too() -> None:
    turn = RightTurn(700.0)
    assert not turn.may_stay
    assert not turn.is_offset(0.2)
    for k in range(10):
        turn.frame(k, 1.0 + k if k % 2 else None)
    assert turn.may_stay
    assert turn.is_offset(0.2)
    for k in range(10, 40):
        turn.frame(k, 0.1)
    assert not turn.may_stay
    assert not turn.is_offset(0.2)
    # beside a turn that stays, what is off is off from there
    for k in range(40, 46):
        turn.frame(k, 2.0)
    assert turn.is_offset(0.0)
    assert not turn.is_offset(2.1)


def test_a_right_camera_that_turns_far_is_not_used() -> None:
    outputs = flight_with_turns(lambda k: 1.0 if k >= 5 else 0.0)
    assert [output.observations.has_right.any() for output in outputs] == [
        k < 5 for k in range(FRAMES)
    ]
    (line,) = [line for output in outputs for line in messages(output)]
    assert line.startswith("frame 8: the right image contradicts the left one")


def test_offset_and_factor_of_disparities_are_told_apart() -> None:
    """Depths of one camera's motion have a factor in common; a tenth of wrong matches changes
    little.
    """
    rng = np.random.default_rng(5)
    expected = rng.uniform(3.0, 60.0, 150)
    off = 1.2 + 0.15 * expected + rng.normal(0.0, 0.2, 150)
    off[::10] = rng.uniform(-40.0, 40.0, 15)
    offset, slope = common_offset(expected, off)
    assert offset == pytest.approx(1.2, abs=0.3)
    assert slope == pytest.approx(0.15, abs=0.02)
    near = np.full(50, 20.0)
    # at one depth nothing tells them apart
    assert common_offset(near, near * 0.0 + 0.7) == (pytest.approx(0.7), 0.0)


@pytest.mark.parametrize(("agreeing", "unknown"), [(2, True), (8, False)])
def test_images_that_contradict_from_the_start_leave_lengths_unknown(
    agreeing: int, unknown: bool
) -> None:
    """KITTI 06, right camera yawed by 1 degree: 23 m off at 22 standard deviations."""
    camera = RightCamera()
    shares = [1.0] * agreeing + [0.1] * 5 + [1.0] * 3
    for k, share in enumerate(shares):
        camera.check_matches(k, np.arange(40) < 40 * share, moved=True)
    found = [f for f in camera.take_findings() if f.code == "right-matches-missing"]
    assert [(f.first_frame, f.effect, f.ended) for f in found if not f.ended] == (
        [(0, "unusable", False)] if unknown else []
    )
    assert [f.ended for f in found] == ([False, True] if unknown else [])


@pytest.mark.parametrize(("blind", "usable"), [(39, False), (40, True)])
def test_the_right_image_is_tried_again_after_long_without_points(blind: int, usable: bool) -> None:
    """Two seconds in which nothing can be tested, at 20 Hz."""
    camera = _contradicted()
    for k in range(blind):
        camera.check_matches(4 + k, np.zeros(5, dtype=np.bool_), moved=True)
    assert camera.usable == usable


@pytest.mark.parametrize(("matched", "usable"), [(27, False), (33, True)])
def test_three_of_ten_points_that_match_contradict_nothing(matched: int, usable: bool) -> None:
    camera = RightCamera()
    assert camera.check_matches(0, np.arange(100) < matched, moved=True) == usable


@pytest.mark.parametrize(("matched", "usable"), [(55, False), (65, True)])
def test_six_of_ten_points_agree_again(matched: int, usable: bool) -> None:
    camera = _contradicted()
    for k in range(3):
        camera.check_matches(4 + k, np.arange(100) < matched, moved=True)
    assert camera.usable == usable


@pytest.mark.parametrize(("points", "usable"), [(19, True), (20, False)])
def test_fewer_than_twenty_points_contradict_nothing(points: int, usable: bool) -> None:
    camera = RightCamera()
    assert camera.check_matches(0, np.zeros(points, dtype=np.bool_), moved=True) == usable
