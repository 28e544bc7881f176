"""The KLT front end on images with known ground truth, on invalid images, and on a real drive."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.frontend.test_frontend_scene import (
    CAMERA,
    SLANTED,
    Wall,
    eight_bit,
    flight,
    right_of,
    stereo_frame,
    truth,
    view,
)
from tests.guards import guarded_klt, messages
from vio.errors import ConfigError, DataError
from vio.frontend import detect, flow, frame_images, new_features, one_opencv_thread, stereo_fit
from vio.frontend.detect import cell_index, grid_shape, min_distance_px
from vio.frontend.klt import KltFrontend
from vio.frontend.outliers import _refine
from vio.frontend.patches import half_image
from vio.frontend.reappearance import contradicts_gyro
from vio.frontend.settings import FrontendSettings, GridSettings, KltSettings
from vio.frontend.tracks import INLIER_PX
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, se3_log
from vio.geometry.stereo import StereoCamera, triangulate
from vio.guard import contrast, image_check
from vio.records import FrontendOutput, MotionPrior, StereoFrame, TrackPrior

GRID = GridSettings(target_features=200)
SETTINGS = FrontendSettings(grid=GRID)
POSES = flight(6)
FRAMES = [stereo_frame(k, pose) for k, pose in enumerate(POSES)]


def run(frames: list[StereoFrame], settings: FrontendSettings = SETTINGS) -> list[FrontendOutput]:
    frontend = guarded_klt(CAMERA, settings)
    return [frontend.process(frame) for frame in frames]


def with_klt(**changes: Any) -> FrontendSettings:
    return replace(SETTINGS, klt=KltSettings(**changes))


@pytest.fixture(scope="module")
def outputs() -> list[FrontendOutput]:
    return run(FRAMES)


def common(a: FrontendOutput, b: FrontendOutput) -> tuple[FloatArray, FloatArray]:
    """Pixels (N, 4) of the features that are in both outputs."""
    _, i, j = np.intersect1d(a.observations.ids, b.observations.ids, return_indices=True)
    return a.observations.z[i], b.observations.z[j]


def track_errors(
    a: FrontendOutput, b: FrontendOutput, T_world_a: FloatArray, T_world_b: FloatArray
) -> FloatArray:
    """Distances (N,) in pixels between the tracked and the true pixels in `b` of the features of
    `a`.
    """
    before, after = common(a, b)
    expected = truth(SLANTED, T_world_a, before[:, :2], T_world_b)[:, :2]
    return np.asarray(np.linalg.norm(after[:, :2] - expected, axis=1))


def step_errors(outputs: list[FrontendOutput], k: int) -> FloatArray:
    """The same, from frame k of the flight to the next."""
    return track_errors(outputs[k], outputs[k + 1], POSES[k], POSES[k + 1])


def test_temporal_tracks_are_accurate_to_a_twentieth_of_a_pixel(
    outputs: list[FrontendOutput],
) -> None:
    error = np.concatenate([step_errors(outputs, k) for k in range(len(POSES) - 1)])
    assert len(error) > 700
    assert np.median(error) < 0.05
    assert np.mean(error > 1.0) < 0.005


def test_tracks_do_not_drift_over_five_frames(outputs: list[FrontendOutput]) -> None:
    error = track_errors(outputs[0], outputs[5], POSES[0], POSES[5])
    assert len(error) > 100
    assert np.median(error) < 0.08


def test_tracks_do_not_drift_while_the_camera_oscillates() -> None:
    """After 24 frames features are as accurate as after six: each is aligned with its first
    patch, not its last.
    """
    oscillation = 4 * np.sin(2 * np.pi * np.arange(25) / 24)
    poses = [se3_exp(share * se3_log(POSES[1])) for share in oscillation]
    outputs = run([stereo_frame(k, pose) for k, pose in enumerate(poses)])
    errors = []
    for k in (6, 24):
        first, later = common(outputs[0], outputs[k])
        assert len(first) > 0.8 * GRID.target_features
        expected = truth(SLANTED, poses[0], first[:, :2], poses[k])[:, :2]
        errors.append(np.median(np.linalg.norm(later[:, :2] - expected, axis=1)))
    assert errors[1] < 0.03  # with a new anchor in every frame: 0.06
    assert errors[1] < 1.3 * errors[0]


def test_disparities_are_accurate_and_unbiased(outputs: list[FrontendOutput]) -> None:
    errors = []
    for pose, output in zip(POSES, outputs, strict=True):
        seen = output.observations.take(output.observations.has_right)
        expected = truth(SLANTED, pose, seen.z[:, :2], pose)
        errors.append(seen.z[:, 2:] - expected[:, 2:])
    error = np.concatenate(errors)
    assert np.median(np.abs(error[:, 0])) < 0.04
    assert abs(np.median(error[:, 0])) < 0.01
    assert np.percentile(np.abs(error[:, 0]), 95) < 0.15
    assert np.median(np.abs(error[:, 1])) < 0.04


def test_most_features_are_kept_and_the_counts_add_up(outputs: list[FrontendOutput]) -> None:
    assert outputs[0].tracked == 0
    for output in outputs:
        assert len(output.observations) == output.tracked + output.detected
        assert output.matched == output.observations.has_right.sum()
        assert output.matched > 0.7 * GRID.target_features
        assert len(output.observations) <= GRID.target_features
    assert all(output.tracked > 0.8 * GRID.target_features for output in outputs[1:])
    assert {"prepare", "track", "reject", "align", "detect", "stereo"} <= set(outputs[-1].stages_ms)


def test_stereo_matches_have_positive_disparity_on_one_row(outputs: list[FrontendOutput]) -> None:
    for output in outputs:
        z = output.observations.z[output.observations.has_right]
        assert (z[:, 0] - z[:, 2] > 0).all()
        assert (np.abs(z[:, 1] - z[:, 3]) <= stereo_fit._MAX_ROW_DIFFERENCE_PX).all()


def _with_black_frames(n: int) -> list[StereoFrame]:
    """Two frames, n black ones, and the second frame again."""
    black = np.zeros_like(FRAMES[0].left)
    dark = [StereoFrame(2 + k, (2 + k) * 50_000_000, black, black) for k in range(n)]
    return [
        FRAMES[0],
        FRAMES[1],
        *dark,
        replace(FRAMES[1], index=2 + n, time_ns=(2 + n) * 50_000_000),
    ]


@pytest.mark.parametrize("n", [1, 5])
def test_tracks_continue_after_black_frames(n: int) -> None:
    outputs = run(_with_black_frames(n))
    assert [len(output.observations) for output in outputs[2:-1]] == [0] * n
    before, after = common(outputs[1], outputs[-1])
    assert len(before) > 0.95 * len(outputs[1].observations)
    assert np.abs(before - after).max() < 0.2  # the picture is the same


def test_tracks_are_dropped_when_the_camera_stays_black() -> None:
    outputs = run(_with_black_frames(6))
    assert len(outputs[-1].observations) > 100
    assert outputs[-1].observations.ids.min() > outputs[1].observations.ids.max()


def test_ids_are_never_reused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A black frame ends every track; features found afterwards are new, even in the same image."""
    monkeypatch.setattr(contrast, "_CONTRAST", contrast._CONTRAST._replace(max_frames=0))
    outputs = run(_with_black_frames(1))
    assert len(outputs[2].observations) == 0
    early = np.concatenate([output.observations.ids for output in outputs[:2]])
    assert len(outputs[3].observations) > 100
    assert outputs[3].observations.ids.min() > early.max()


@pytest.mark.parametrize("level", [0, 255])
def test_images_without_contrast_give_no_features(level: int) -> None:
    flat = np.full((300, 480), level, dtype=np.uint8)
    for output in run([StereoFrame(k, k * 50_000_000, flat, flat) for k in range(3)]):
        assert len(output.observations) == 0
        assert output.observations.z.shape == (0, 4)


def test_noise_alone_gives_no_tracks() -> None:
    """Corners of noise are uncorrelated between frames and between left and right."""
    rng = np.random.default_rng(1)
    frames = [
        StereoFrame(k, k * 50_000_000, *rng.integers(0, 255, (2, 300, 480), dtype=np.uint8))
        for k in range(3)
    ]
    for output in run(frames)[1:]:
        assert output.tracked < 5
        assert output.matched < 5


def test_features_keep_their_distance_and_fill_the_grid(outputs: list[FrontendOutput]) -> None:
    shape = grid_shape(480, 300, GRID)
    for output in outputs:
        left = output.observations.z[:, :2]
        gap = np.abs(left[:, None] - left[None]).max(axis=2)
        np.fill_diagonal(gap, np.inf)
        assert gap.min() >= 0.5 * min_distance_px(480, 300, GRID)
        held = np.bincount(cell_index(left, 480, 300, shape), minlength=shape[0] * shape[1])
        assert held.max() <= 3 * detect._CORNERS.cell_features
        assert np.mean(held > 0) > 0.85


def test_features_without_right_match_stay_as_left_only_rows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A part of the right image is covered; its tracks continue in the left one for a limited
    number of frames.
    """
    monkeypatch.setattr(new_features, "_NEW", new_features._NEW._replace(max_left_only_frames=2))

    def covered(frame: StereoFrame) -> StereoFrame:
        right = frame.right.copy()
        right[:120] = 128
        return replace(frame, right=right)

    outputs = run([FRAMES[0], *(covered(frame) for frame in FRAMES[1:5])])
    seen = outputs[0].observations
    upper = seen.ids[seen.has_right & (seen.z[:, 1] < 100)]
    assert len(upper) > 30
    alive = [np.isin(upper, output.observations.ids).mean() for output in outputs]
    assert alive[1] > 0.85
    assert alive[2] > 0.75
    assert alive[3] == 0.0
    later = outputs[1].observations
    assert not later.has_right[np.isin(later.ids, upper)].any()


def test_tracks_outlast_a_right_camera_that_loses_its_contrast(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The limit on frames without a right match is for features, not for a camera: tracks
    continue in the left one.
    """
    monkeypatch.setattr(new_features, "_NEW", new_features._NEW._replace(max_left_only_frames=2))
    gray = np.full_like(FRAMES[0].right, 128)
    outputs = run([FRAMES[0], *(replace(frame, right=gray) for frame in FRAMES[1:5])])
    seen, later = outputs[0].observations, outputs[4].observations
    assert np.isin(seen.ids[seen.has_right], later.ids).mean() > 0.8
    assert not later.has_right.any()
    (line,) = [line for output in outputs for line in messages(output)]
    assert line.startswith("frame 3: the right camera is dark or covered")


@pytest.mark.parametrize("with_prior", [False, True])
def test_moving_features_without_depth_are_rejected(
    with_prior: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The right camera has no contrast; in the fourth frame a part of the left image jumps up by
    8 px.
    """
    gray = np.full_like(FRAMES[0].right, 128)
    frames = [replace(frame, right=gray) for frame in FRAMES[:4]]
    left = frames[3].left
    left = left.copy()
    left[60:180, 140:300] = left[68:188, 140:300]
    frames[3] = replace(frames[3], left=left)

    def jumped() -> tuple[float, int, int]:
        frontend = KltFrontend(CAMERA, SETTINGS)
        outputs = [frontend.process(frame) for frame in frames[:3]]
        step = se3_inverse(POSES[3]) @ POSES[2]
        prior = TrackPrior(np.zeros(0, dtype=np.int64), np.zeros((0, 4)), step[:3, :3])
        outputs.append(frontend.process(frames[3], prior if with_prior else None))
        error = step_errors(outputs, 2)
        return float(np.median(error)), int((error < 1).sum()), int((error > 4).sum())

    median, good, wrong = jumped()
    monkeypatch.setattr("vio.frontend.outliers.bearing_consensus", lambda *_: None)
    _, all_good, all_wrong = jumped()
    assert all_wrong >= 15  # control: without rejection there are outliers
    assert wrong <= 0.15 * all_wrong
    assert good >= 0.97 * all_good
    assert median < 0.05


def test_occluded_tracks_are_dropped() -> None:
    """A board with another texture covers a part of the next frame."""
    board = view(Wall(np.array([0.0, 0.0, 1.0]), 2.0, seed=9), POSES[1])
    left, right = FRAMES[1].left, FRAMES[1].right
    left, right = left.copy(), right.copy()
    left[60:220, 150:330] = eight_bit(board, 90)[60:220, 150:330]
    right[60:220, 120:300] = eight_bit(board, 91)[60:220, 150:330]
    outputs = run([FRAMES[0], replace(FRAMES[1], left=left, right=right)])
    before, _ = common(*outputs)
    expected = truth(SLANTED, POSES[0], before[:, :2], POSES[1])[:, :2]
    margin = 8
    hidden = (np.abs(expected[:, 0] - 239.5) < 90 - margin) & (
        np.abs(expected[:, 1] - 139.5) < 80 - margin
    )
    started = outputs[0].observations.z[:, :2]
    behind = (np.abs(started[:, 0] - 239.5) < 70) & (np.abs(started[:, 1] - 139.5) < 60)
    assert behind.sum() > 15
    assert hidden.sum() <= 1


def test_prior_bridges_a_jump_too_large_for_tracking_alone() -> None:
    """Between the two frames the camera turns by 12 degrees, about 64 pixels."""
    first, second = POSES[0], POSES[0].copy()
    angle = np.radians(12.0)
    second[:3, :3] = [
        [np.cos(angle), 0, np.sin(angle)],
        [0, 1, 0],
        [-np.sin(angle), 0, np.cos(angle)],
    ]
    frames = [stereo_frame(0, first), stereo_frame(1, second)]
    settings = with_klt(pyramid_levels=1)
    without_prior = run(frames, settings)[1]
    frontend = guarded_klt(CAMERA, settings)
    seen = frontend.process(frames[0]).observations
    z = truth(SLANTED, first, seen.z[:, :2], second) + np.random.default_rng(0).normal(
        0, 2, (len(seen), 4)
    )
    by_pixels = frontend.process(frames[1], TrackPrior(seen.ids, z))
    frontend = guarded_klt(CAMERA, settings)
    frontend.process(frames[0])
    nothing = TrackPrior(
        np.zeros(0, dtype=np.int64), np.zeros((0, 4)), (se3_inverse(second) @ first)[:3, :3]
    )
    by_rotation = frontend.process(frames[1], nothing)
    assert without_prior.tracked < 0.3 * len(seen)
    for output in (by_pixels, by_rotation):
        assert output.tracked > 0.6 * len(seen)
        assert np.median(track_errors(FrontendOutput(seen, 0, 0, 0), output, first, second)) < 0.08


def test_last_motion_is_scaled_by_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three frames 10 ms apart, the next one 150 ms later: 50 pixels that only the last motion
    predicts.
    """
    step = np.array([0.4, -0.1, 0.1, 0.01, -0.02, 0.01])
    frames = [
        replace(stereo_frame(k, se3_exp(share * step)), time_ns=ms * 1_000_000)
        for k, (share, ms) in enumerate([(0.0, 0), (0.1, 10), (0.2, 20), (1.7, 170)])
    ]
    monkeypatch.setattr(flow, "_TRACKING", flow._TRACKING._replace(trusted_levels=0))
    outputs = run(frames, with_klt(pyramid_levels=0))
    assert outputs[-1].tracked > 0.7 * outputs[-2].tracked


def after_gap(wall: Wall, right_wall: Wall, pose: FloatArray) -> FrontendOutput:
    """What is seen three seconds after three frames, the filter predicting nothing."""
    late = replace(stereo_frame(3, pose, wall), time_ns=FRAMES[2].time_ns + 3_000_000_000)
    return run([*FRAMES[:3], replace(late, right=stereo_frame(3, pose, right_wall).right)])[-1]


def test_features_are_found_again_after_a_long_gap(outputs: list[FrontendOutput]) -> None:
    """The camera has come nearer by 0.5 m and turned by 5 degrees; nothing predicts where the
    features are.
    """
    pose = POSES[2] @ se3_exp(np.array([0.3, -0.1, 0.5, 0.03, -0.06, 0.06]))
    again = after_gap(SLANTED, SLANTED, pose)
    error = track_errors(outputs[2], again, POSES[2], pose)
    assert len(error) > 80
    assert np.median(error) < 0.1
    assert np.mean(error > 1.0) < 0.02


@pytest.mark.parametrize(
    ("wall", "right_wall"),
    [
        (replace(SLANTED, seed=77), replace(SLANTED, seed=77)),
        (SLANTED, replace(SLANTED, offset=5.0)),
        (SLANTED, replace(SLANTED, seed=77)),
    ],
    ids=[
        "another scene",
        "the left scene at another depth",
        "a right camera that shows something else",
    ],
)
def test_similar_patches_after_a_long_gap_are_no_evidence(wall: Wall, right_wall: Wall) -> None:
    """Where one of the cameras does not show the same scene at its depths, features begin anew."""
    again = after_gap(wall, right_wall, POSES[3])
    assert again.tracked == 0
    assert len(again.observations) > 20
    assert not np.isin(again.observations.ids, run(FRAMES[:3])[-1].observations.ids).any()


@pytest.mark.parametrize(
    ("off_deg", "measured", "refused"), [(3.0, True, True), (0.1, True, False), (3.0, False, False)]
)
def test_a_motion_across_a_gap_must_not_contradict_the_gyro(
    off_deg: float, measured: bool, refused: bool
) -> None:
    moved, off = (
        se3_exp([0.3, 0.0, 0.2, 0.0, 0.1, 0.0]),
        se3_exp([0, 0, 0, 0, np.radians(off_deg), 0]),
    )
    assert contradicts_gyro(moved, MotionPrior(off @ moved, 1e-6 * np.eye(6), measured)) is refused
    assert not contradicts_gyro(moved, None)


def test_a_prediction_bridges_a_long_gap() -> None:
    assert (
        run([*FRAMES[:3], replace(FRAMES[3], time_ns=FRAMES[2].time_ns + 600_000_000)])[-1].tracked
        > 100
    )
    frontend = KltFrontend(CAMERA, SETTINGS)
    seen = [frontend.process(frame) for frame in FRAMES[:3]][-1].observations
    prior = TrackPrior(seen.ids, truth(SLANTED, POSES[2], seen.z[:, :2], POSES[3]))
    late = replace(FRAMES[3], time_ns=FRAMES[2].time_ns + 3_000_000_000)
    assert frontend.process(late, prior).tracked > 100


def test_features_failing_the_forward_backward_check_are_dropped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(flow, "_TRACKING", flow._TRACKING._replace(max_forward_backward_px=1e-4))
    assert run(FRAMES[:2])[1].tracked < 10


def test_swapped_images_are_detected() -> None:
    frontend = guarded_klt(CAMERA, SETTINGS)
    swapped = [replace(frame, left=frame.right, right=frame.left) for frame in FRAMES]
    for frame in swapped[:2]:
        assert frontend.process(frame).matched < 30
    with pytest.raises(DataError, match="frame 2: left and right images look swapped"):
        frontend.process(swapped[2])
    assert frontend.process(FRAMES[3]).observations.has_right.any()  # nothing is refused for good


def test_unrelated_right_image_is_not_reported_as_swapped() -> None:
    other = [
        eight_bit(view(Wall(SLANTED.normal, SLANTED.offset, seed=77), right_of(pose)), 50)
        for pose in POSES[:5]
    ]
    outputs = run(
        [replace(frame, right=image) for frame, image in zip(FRAMES[:5], other, strict=True)]
    )
    assert max(output.matched for output in outputs) < 20


def test_swapped_images_of_a_real_drive_are_detected(data_dir: Path) -> None:
    camera, frames, _ = kitti(data_dir / "kitti_05_clip", 12)
    frontend = guarded_klt(camera)
    swapped = [replace(frame, left=frame.right, right=frame.left) for frame in frames]
    frontend.process(swapped[0])
    frontend.process(swapped[1])
    for frame in swapped[2:]:
        with pytest.raises(DataError, match="look swapped"):
            frontend.process(frame)


def test_rejects_invalid_images() -> None:
    image = np.zeros((300, 480), dtype=np.uint8)
    cases = [
        (StereoFrame(4, 0, image, None), "frame 4 has no images"),
        (
            StereoFrame(4, 0, image[:, :400], image[:, :400]),
            "400x300, but the calibration is for 480x300",
        ),
        (StereoFrame(4, 0, image, image[:200]), "right image is 480x200"),
    ]
    for frame, message in cases:
        with pytest.raises(DataError, match=message):
            KltFrontend(CAMERA, SETTINGS).process(frame)


def test_first_frame_sets_the_size_if_the_calibration_has_none() -> None:
    frontend = KltFrontend(replace(CAMERA, width=None, height=None), SETTINGS)
    frontend.process(FRAMES[0])
    small = np.zeros((200, 480), dtype=np.uint8)
    with pytest.raises(DataError, match="one size"):
        frontend.process(StereoFrame(1, 50_000_000, small, small))


def test_darker_right_camera_keeps_accuracy() -> None:
    """Different gain left and right, as in EuRoC V2_03: the patches are normalised."""
    dark = []
    for frame in FRAMES[:3]:
        dark.append(
            replace(frame, right=(0.6 * frame.right.astype(np.float64) + 5).astype(np.uint8))
        )
    for pose, output in zip(POSES[:3], run(dark), strict=True):
        seen = output.observations.take(output.observations.has_right)
        assert output.matched > 0.7 * GRID.target_features
        error = seen.z[:, 2] - truth(SLANTED, pose, seen.z[:, :2], pose)[:, 2]
        assert np.median(np.abs(error)) < 0.05


def test_images_may_be_overwritten_after_the_call(outputs: list[FrontendOutput]) -> None:
    """A reader may reuse its buffer."""
    frontend = KltFrontend(CAMERA, SETTINGS)
    left, right = FRAMES[0].left.copy(), FRAMES[0].right.copy()
    frontend.process(StereoFrame(0, 0, left, right))
    left[:], right[:] = 0, 0
    np.testing.assert_array_equal(
        frontend.process(FRAMES[1]).observations.z, outputs[1].observations.z
    )


def test_new_features_are_output_after_probation(monkeypatch: pytest.MonkeyPatch) -> None:
    """A feature with a new id was detected at least one frame earlier."""
    settings = FrontendSettings(grid=GridSettings(target_features=300))
    held = run(FRAMES, settings)
    monkeypatch.setattr(new_features, "_OUTPUT", new_features._OUTPUT._replace(probation_frames=0))
    free = run(FRAMES, settings)
    late = [
        later.observations.ids[later.observations.ids > held[0].observations.ids.max()]
        for later in held[1:]
    ]
    assert sum(map(len, late)) > 0
    assert held[1].detected <= free[1].detected + free[0].detected
    shares = []
    for frames in (held, free):
        ids, counts = np.unique(
            np.concatenate([o.observations.ids for o in frames]), return_counts=True
        )
        # Those first output in the last two frames cannot live for three.
        early = np.isin(ids, np.concatenate([o.observations.ids for o in frames[:-2]]))
        shares.append(np.mean(counts[early] == 1))
    assert shares[0] <= shares[1]


def test_rectification_error_is_estimated_and_does_not_bias_disparity() -> None:
    """The right camera is rolled by 0.15 degrees: rows differ by up to 0.6 px at the sides."""
    roll = np.radians(0.15)
    frames = []
    for frame in FRAMES:
        turn = np.array([[np.cos(roll), -np.sin(roll), 0.0], [np.sin(roll), np.cos(roll), 0.0]])
        centre = np.array([CAMERA.cu, CAMERA.cv])
        turn[:, 2] = centre - turn[:, :2] @ centre
        rolled = cv2.warpAffine(
            frame.right, turn, (480, 300), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
        )
        frames.append(replace(frame, right=np.asarray(rolled, dtype=np.uint8)))
    for pose, output in list(zip(POSES, run(frames), strict=True))[2:]:
        seen = output.observations.take(output.observations.has_right)
        assert len(seen) > 0.7 * GRID.target_features
        expected = truth(SLANTED, pose, seen.z[:, :2], pose)[:, 2:]
        turned = expected @ turn[:, :2].T + turn[:, 2]
        assert np.median(np.abs(seen.z[:, 3] - turned[:, 1])) < 0.06
        assert np.median(np.abs(seen.z[:, 2] - turned[:, 0])) < 0.05


def test_tracks_survive_exposure_steps(outputs: list[FrontendOutput]) -> None:
    brighter = []
    for k, frame in enumerate(FRAMES[:4]):
        gain = 1.0 if k % 2 == 0 else 0.7
        pair = [
            np.rint(gain * image.astype(np.float64)).astype(np.uint8)
            for image in (frame.left, frame.right)
        ]
        brighter.append(replace(frame, left=pair[0], right=pair[1]))
    stepped = run(brighter)
    for k in range(3):
        error = step_errors(stepped, k)
        assert len(error) > 0.8 * len(stepped[k].observations)
        assert np.median(error) < 0.06


def at_night(share: float, read_noise: float) -> list[StereoFrame]:
    """The flight with a share of the light and constant read noise."""
    rng, frames = np.random.default_rng(11), []
    for k, pose in enumerate(POSES[:4]):
        pair = [
            np.clip(
                np.rint(share * view(SLANTED, T) + read_noise * rng.standard_normal((300, 480))),
                0,
                255,
            )
            for T in (pose, right_of(pose))
        ]
        frames.append(StereoFrame(k, k * 50_000_000, *(image.astype(np.uint8) for image in pair)))
    return frames


def test_tracks_in_the_dark_where_noise_is_low(monkeypatch: pytest.MonkeyPatch) -> None:
    """Mean gray level 6: weak corners are usable if they exceed the noise."""
    frames = at_night(0.05, 0.5)
    outputs = run(frames)
    monkeypatch.setattr(detect, "_CORNERS", detect._CORNERS._replace(min_gradient_over_noise=1e6))
    absolute = run(frames)
    assert max(output.matched for output in absolute) < 0.4 * GRID.target_features
    for k in range(3):
        assert outputs[k + 1].matched > 0.6 * GRID.target_features
        error = step_errors(outputs, k)
        assert len(error) > 0.7 * len(outputs[k].observations)
        assert np.median(error) < 0.2
        assert np.mean(error > 1) < 0.03


def test_noise_threshold_is_inactive_in_good_light(
    outputs: list[FrontendOutput], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(detect, "_CORNERS", detect._CORNERS._replace(min_gradient_over_noise=1e6))
    for a, b in zip(outputs, run(FRAMES), strict=True):
        np.testing.assert_array_equal(a.observations.z, b.observations.z)


def test_mask_excludes_features(tmp_path: Path) -> None:
    mask = np.full((300, 480), 255, dtype=np.uint8)
    mask[150:] = 0
    path = tmp_path / "mask.png"
    cv2.imwrite(str(path), mask)
    first = run(FRAMES[:1], with_klt(mask=path))[0].observations
    assert len(first) > 50
    assert first.z[:, 1].max() < 151


def test_rejects_invalid_mask(tmp_path: Path) -> None:
    small = tmp_path / "small.png"
    cv2.imwrite(str(small), np.zeros((20, 30), dtype=np.uint8))
    with pytest.raises(ConfigError, match="mask is 30x20, but the images are 480x300"):
        run(FRAMES[:1], with_klt(mask=small))
    black = tmp_path / "black.png"
    cv2.imwrite(str(black), np.dstack([np.zeros((300, 480, 3)), np.full((300, 480), 255)]))
    with pytest.raises(ConfigError, match="black all over, which excludes every pixel"):
        run(FRAMES[:1], with_klt(mask=black))
    with pytest.raises(ConfigError, match="cannot be read as an image"):
        KltFrontend(CAMERA, with_klt(mask=tmp_path / "none.png"))


def test_wrong_prior_is_discarded() -> None:
    """The prior is off by 60 px everywhere; the search is repeated from the old pixels."""
    frontend = KltFrontend(CAMERA, SETTINGS)
    seen = frontend.process(FRAMES[0]).observations
    wrong = TrackPrior(seen.ids, seen.z + np.array([60.0, 25.0, 60.0, 25.0]))
    assert frontend.process(FRAMES[1], wrong).tracked > 0.8 * len(seen)


def test_prior_with_unknown_ids_and_nan_is_harmless() -> None:
    plain, with_prior = KltFrontend(CAMERA, SETTINGS), KltFrontend(CAMERA, SETTINGS)
    seen = plain.process(FRAMES[0]).observations
    with_prior.process(FRAMES[0])
    ids = np.concatenate([seen.ids[:5], np.array([10**6, 10**6 + 1])])
    nothing = TrackPrior(ids, np.full((7, 4), np.nan))
    a, b = plain.process(FRAMES[1]), with_prior.process(FRAMES[1], nothing)
    assert abs(a.tracked - b.tracked) <= 2


def kitti(folder: Path, count: int) -> tuple[StereoCamera, list[StereoFrame], FloatArray]:
    """Camera, frames and cam0 poses of the first frames of a folder in KITTI odometry layout."""
    rows = [
        line.split() for line in (folder / "calib.txt").read_text().splitlines() if line.strip()
    ]
    P0, P1 = (np.array(row[1:13], dtype=np.float64).reshape(3, 4) for row in rows[:2])
    frames = []
    for k in range(count):
        images = [
            cv2.imread(str(folder / f"image_{i}" / f"{k:06d}.png"), cv2.IMREAD_GRAYSCALE)
            for i in (0, 1)
        ]
        frames.append(
            StereoFrame(
                k, k * 100_000_000, *(np.asarray(image, dtype=np.uint8) for image in images)
            )
        )
    height, width = frames[0].left.shape
    camera = StereoCamera(
        P0[0, 0], P0[1, 1], P0[0, 2], P0[1, 2], -P1[0, 3] / P0[0, 0], width, height
    )
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3] = np.loadtxt(folder / "poses.txt")[:count].reshape(-1, 3, 4)
    return camera, frames, poses


def test_real_drive_agrees_with_ground_truth(data_dir: Path) -> None:
    """Stereo points of one frame, moved by one rigid motion per pair, must agree with the tracks in
    the next frame.

    The motion is fitted to the tracks and then compared with the ground truth, because the
    reference poses of this drive (GPS and inertial, not synchronised with the camera) jump by up to
    50 mm per frame.
    """
    camera, frames, poses = kitti(data_dir / "kitti_0039", 8)
    frontend = KltFrontend(camera)
    outputs = [frontend.process(frame) for frame in frames]
    assert min(output.matched for output in outputs) >= 200
    fitted, raw = [], []
    for k in range(len(frames) - 1):
        a, b = outputs[k], outputs[k + 1]
        before, after = common(
            replace(a, observations=a.observations.take(a.observations.has_right)), b
        )
        p, valid = triangulate(camera, before)
        assert valid.all()
        T_true = se3_inverse(poses[k + 1]) @ poses[k]
        T = _refine(camera, T_true, p, after[:, :2], INLIER_PX, slice(0, 6))
        difference = se3_log(T @ se3_inverse(T_true))
        assert np.linalg.norm(difference[:3]) < 0.08
        assert np.degrees(np.linalg.norm(difference[3:])) < 0.1
        for motion, errors in ((T, fitted), (T_true, raw)):
            q = p @ motion[:3, :3].T + motion[:3, 3]
            uv = np.stack(
                [
                    camera.fu * q[:, 0] / q[:, 2] + camera.cu,
                    camera.fv * q[:, 1] / q[:, 2] + camera.cv,
                ],
                axis=1,
            )
            errors.append(np.linalg.norm(uv - after[:, :2], axis=1))
    assert np.median(np.concatenate(fitted)) < 0.35
    assert np.percentile(np.concatenate(fitted), 95) < 1.5
    assert np.median(np.concatenate(raw)) < 1.2


def test_only_doubtful_points_are_tracked_backward(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the last motion predicts the pixels, the way back confirms nothing new; without a
    motion it is needed.
    """
    tracked: list[int] = []
    flow = cv2.calcOpticalFlowPyrLK

    def counted(*args: Any, **kwargs: Any) -> Any:
        tracked.append(len(args[2]))
        return flow(*args, **kwargs)

    monkeypatch.setattr(cv2, "calcOpticalFlowPyrLK", counted)
    frontend = KltFrontend(CAMERA, SETTINGS)
    counts = []
    for frame in FRAMES[:4]:
        tracked.clear()
        outputs = frontend.process(frame)
        counts.append(list(tracked))
    assert len(counts[1]) == 2  # no motion is known yet: forward and backward
    assert counts[1][1] > 0.8 * counts[1][0]
    assert sum(counts[3][1:]) < 0.3 * counts[3][0]
    assert outputs.tracked > 0.8 * GRID.target_features


def test_corners_are_detected_in_every_other_frame_while_few_are_missing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(new_features, "_NEW", new_features._NEW._replace(spare_corners=0.0))
    features = KltFrontend(CAMERA, SETTINGS)._new_features
    few, many = GRID.target_features - 10, GRID.target_features // 2
    assert [features._wanted_corners(active) for active in (few, few, few, many, many, few)] == [
        0,
        10,
        0,
        100,
        100,
        0,
    ]


def test_opencv_has_its_threads_back_after_a_run_that_failed() -> None:
    before = cv2.getNumThreads()
    inside = []

    def failing() -> None:
        with one_opencv_thread():
            inside.append(cv2.getNumThreads())
            raise DataError("a frame cannot be read")

    with pytest.raises(DataError):
        failing()
    assert inside == [1]
    assert cv2.getNumThreads() == before


def test_each_image_is_halved_once(monkeypatch: pytest.MonkeyPatch) -> None:
    halved: list[object] = []
    for module in (frame_images, image_check):
        monkeypatch.setattr(
            module, "half_image", lambda image: (halved.append(image), half_image(image))[1]
        )
    run(FRAMES[:3])
    assert len(halved) == 6
