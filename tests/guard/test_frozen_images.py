"""Pairs that are given again: told from a rig at standstill, left out, named, and without effect
on the poses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TypeAlias

import cv2
import numpy as np
import pytest

from vio.cameras.rig import with_virtual_baseline
from vio.config import load_config
from vio.evaluation.trajectories import evaluate
from vio.geometry.lie import se3_exp
from vio.geometry.stereo import one_camera
from vio.monitor.frozen import IMAGES, FrozenImages, Repeated, RepeatReport, corner_flow
from vio.records import (
    Event,
    Image,
    ImuSample,
    IntArray,
    MotionPrior,
    Observations,
    Prediction,
    Recording,
    StereoFrame,
    TrackPrior,
    observations,
)
from vio.runs.pipeline import run
from vio.sim.imu import ImuNoise
from vio.sim.motion import hand_held
from vio.sim.rigs import small_rig
from vio.sim.sequence import SimulatedRecording, simulate
from vio.sim.world import room

STEP_NS = 50_000_000
FRAMES, FIRST, LAST = 52, 34, 43  # frames of the flight, of which 10 are repeated: 0.5 s


# One pair after another


def _texture(seed: int = 0) -> Image:
    gray = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 1, (240, 400)), (0, 0), 2.0)
    return np.clip(128 + 40 * gray / gray.std(), 0, 255).astype(np.uint8)


def _noisy(image: Image, seed: int, level: int = 1) -> Image:
    noise = np.random.default_rng(seed).integers(-level, level + 1, image.shape)
    return np.clip(image.astype(np.int64) + noise, 0, 255).astype(np.uint8)


def _shifted(image: Image, px: float) -> Image:
    return np.asarray(
        cv2.warpAffine(image, np.array([[1.0, 0, px], [0, 1, 0]]), image.shape[::-1]),
        dtype=np.uint8,
    )


GRID = (
    np.stack(np.meshgrid(np.arange(60, 340, 30), np.arange(40, 200, 30)), axis=-1)
    .reshape(-1, 2)
    .astype(float)
)
Z = np.concatenate([GRID, GRID - [12.0, 0.0]], axis=1)
IDS = np.arange(len(GRID))
LEFT, RIGHT = _texture(0), _texture(1)


def _frame(index: int, left: Image, right: Image) -> StereoFrame:
    return StereoFrame(index, index * STEP_NS, left, right)


def _expected(px: float = 2.0, sigma_m: float = 1e-3) -> Prediction:
    """All features moved by some pixels, by a motion of 5 cm of a given standard deviation."""
    motion = MotionPrior(se3_exp([0.05, 0, 0, 0, 0, 0]), np.eye(6) * sigma_m**2)
    return Prediction(TrackPrior(IDS, Z + np.array([px, 0, px, 0])), motion)


def _watching(*, shaking: bool = True, off_px: float = 0.1) -> FrozenImages:
    """After six frames whose predictions were off by some pixels, with a second of IMU samples."""
    frozen, rng = FrozenImages(), np.random.default_rng(2)
    for k in range(-5, 1):
        exact = Prediction(TrackPrior(IDS, Z), MotionPrior(np.eye(4), np.eye(6)))
        frozen.check(_frame(k, _shifted(LEFT, 5.0 * k), _shifted(RIGHT, 5.0 * k)), exact)
        frozen.observations(observations(k, k * STEP_NS, IDS, Z + off_px * (k == -3)))
    for k in range(200):
        turn = np.array([0.0, 0.4 * np.sin(0.05 * k) if shaking else 0.0, 0.0])
        gyro, accel = turn + rng.normal(0, 3e-3, 3), np.array([0, 0, 9.81]) + rng.normal(0, 0.15, 3)
        frozen.samples([ImuSample(k * 5_000_000 - 950_000_000, gyro, accel)])
    return frozen


@pytest.mark.parametrize(
    ("moved_px", "new_ids", "held"),
    [(20.0, False, 3), (1.0, False, None), (1.0, True, 3)],
    ids=["jumped", "begins to move", "all features lost"],
)
def test_equal_images_that_end_with_a_jump_were_given_again(
    moved_px: float, new_ids: bool, held: int | None
) -> None:
    """By images alone a rig that hardly moves, and stops, looks like it up to then."""
    frozen = FrozenImages()

    def take(k: int, px: float, ids: IntArray = IDS) -> None:
        left, right = _shifted(LEFT, px), _shifted(RIGHT, px)
        assert frozen.check(_frame(k, left, right), None) is None
        frozen.observations(observations(k, k * STEP_NS, ids, Z + px))

    for k, px in enumerate([0.0, 0.15, 0.2]):
        take(k, px)
    for k in range(3, 9):
        take(k, 0.2)
        assert frozen.take_held() is None
    take(9, 0.2 + moved_px, IDS + 1000 * new_ids)
    assert frozen.take_held() == held
    take(10, 0.3 + moved_px, IDS + 1000 * new_ids)
    assert frozen.take_held() is None


def test_what_moved_up_to_the_frame_before_has_not_stopped_at_once() -> None:
    frozen = FrozenImages()
    for k in range(3):
        frozen.check(_frame(k, _shifted(LEFT, 2.0 * k), _shifted(RIGHT, 2.0 * k)), None)
        frozen.observations(observations(k, k * STEP_NS, IDS, Z + 2.0 * k))
    repeated = frozen.check(_frame(3, _shifted(LEFT, 4.0), _shifted(RIGHT, 4.0)), None)
    assert repeated == Repeated(2, exact=True)


@pytest.mark.parametrize(
    ("pixels", "left_out"),
    [([0.0, 0.1, 0.2], 2), ([0.0, 0.05, 0.2], 2), ([0.0, 0.15, 0.2], 0), ([0.2, 0.2, 0.2], 0)],
    ids=["creeps", "begins to move", "slows down", "stands still"],
)
def test_the_first_equal_frames_of_a_rig_that_creeps_are_left_out(
    pixels: list[float], left_out: int
) -> None:
    """By images alone it may have stopped: nothing is said, and after two frames it has."""
    frozen = FrozenImages()
    for k, px in enumerate(pixels):
        frozen.check(_frame(k, _shifted(LEFT, px), _shifted(RIGHT, px)), None)
        frozen.observations(observations(k, k * STEP_NS, IDS, Z + px))
    found = []
    for k in range(3, 8):
        left = _shifted(LEFT, pixels[-1])
        right = _shifted(RIGHT, pixels[-1])
        found.append(frozen.check(_frame(k, left, right), None))
    assert found == left_out * [Repeated(2, True, certain=False)] + (5 - left_out) * [None]


def test_a_bit_equal_pair_is_a_repetition_where_the_imu_moves() -> None:
    repeated = _watching().check(_frame(1, LEFT.copy(), RIGHT.copy()), _expected())
    assert (repeated.of_index, repeated.exact) == (0, True)


@pytest.mark.parametrize("ago", [2, 4])
def test_a_pair_of_some_frames_ago_is_a_repetition_where_the_imu_moves(ago: int) -> None:
    """As of a ring of buffers that is read at the wrong place."""
    frozen = _watching()
    k = 1 - ago
    again = _frame(1, _shifted(LEFT, 5.0 * k), _shifted(RIGHT, 5.0 * k))
    assert frozen.check(again, _expected()) == Repeated(k, True, older=True)
    line = RepeatReport(IMAGES).frame(again, Repeated(k, True, older=True))
    assert f"as in frame {k} although the rig moves" in line[0]
    new = _frame(2, _shifted(LEFT, 5.0), _shifted(RIGHT, 5.0))
    assert frozen.check(new, _expected()) is None


@pytest.mark.parametrize("shaking", [False, True])
def test_what_a_rig_at_standstill_sees_again_is_new_and_so_are_black_images(shaking: bool) -> None:
    frozen = _watching(shaking=shaking)
    for k in range(1, 8):
        other = np.zeros_like(LEFT) if shaking else _texture(9)
        image = other if k % 2 else _texture(10 + k * shaking)
        assert frozen.check(_frame(k, image, image), _expected()) is None
        count = 0 if shaking else len(IDS)
        frozen.observations(observations(k, k * STEP_NS, IDS[:count], Z[:count]))


def test_a_bit_equal_pair_is_used_at_standstill() -> None:
    """A camera without noise: the IMU reads noise and gravity."""
    assert _watching(shaking=False).check(_frame(1, LEFT, RIGHT), _expected(0.0)) is None


@pytest.mark.parametrize("how", ["noise", "jpeg", "brightness"])
def test_a_nearly_equal_pair_is_a_repetition_where_the_prediction_moves(how: str) -> None:
    def again(image: Image, seed: int) -> Image:
        if how == "jpeg":
            return np.asarray(
                cv2.imdecode(cv2.imencode(".jpg", image)[1], cv2.IMREAD_GRAYSCALE), dtype=np.uint8
            )
        return _noisy(image, seed) if how == "noise" else image + np.uint8(3)

    repeated = _watching().check(_frame(1, again(LEFT, 5), again(RIGHT, 6)), _expected())
    assert not repeated.exact


def test_a_rig_at_standstill_is_not_frozen() -> None:
    """Read noise differs from frame to frame; the prediction agrees with no motion, or the IMU
    reads none.
    """
    pair = _frame(1, _noisy(LEFT, 5), _noisy(RIGHT, 6))
    assert _watching().check(pair, _expected(0.1)) is None  # no corner is predicted to move
    # the prediction knows little
    assert _watching().check(pair, _expected(2.0, sigma_m=0.05)) is None
    # it was off by as much shortly before
    assert _watching(off_px=1.0).check(pair, _expected(2.0)) is None
    assert _watching(shaking=False).check(pair, _expected(2.0)) is None  # a velocity that is wrong


def test_a_pair_that_moved_is_used_whatever_the_prediction() -> None:
    for px in (0.5, 2.0, 11.0):
        assert (
            _watching().check(_frame(1, _shifted(LEFT, px), _shifted(RIGHT, px)), _expected(2.0))
            is None
        )


def test_images_of_another_size_are_no_repetition() -> None:
    """They are compared with nothing: the front end refuses them, and the next pair is compared
    with no error.
    """
    frozen = _watching()
    assert frozen.check(_frame(1, LEFT[::2, ::2].copy(), RIGHT), _expected()) is None
    assert frozen.check(_frame(2, _texture(2), _texture(3)), _expected()) is None


def test_one_camera_that_repeats_is_not_a_repeated_pair() -> None:
    assert _watching().check(_frame(1, LEFT, _shifted(RIGHT, 2.0)), _expected()) is None
    assert _watching().check(_frame(1, _shifted(LEFT, 2.0), RIGHT), _expected()) is None


@pytest.mark.parametrize("noisy", [False, True])
def test_a_row_of_repetitions_lasts_until_the_images_change(noisy: bool) -> None:
    """Also once the prediction knows too little to tell."""
    frozen, vague = _watching(), _expected(50.0, sigma_m=10.0)
    for k in range(1, 5):
        left, right = (_noisy(LEFT, k), _noisy(RIGHT, 50 + k)) if noisy else (LEFT, RIGHT)
        repeated = frozen.check(_frame(k, left, right), _expected() if k == 1 else vague)
        assert repeated.of_index == 0
    assert frozen.check(_frame(5, _shifted(LEFT, 9.0), _shifted(RIGHT, 9.0)), vague) is None


def test_without_an_imu_the_prediction_alone_decides() -> None:
    frozen = FrozenImages()
    frozen.check(_frame(0, LEFT, RIGHT), None)
    frozen.observations(observations(0, 0, IDS, Z))
    assert frozen.check(_frame(1, LEFT, RIGHT), _expected(sigma_m=0.05)) is None
    assert frozen.check(_frame(2, LEFT, RIGHT), _expected()) is not None


@pytest.mark.parametrize(
    ("gray", "words"), [(0, "have one gray value everywhere"), (None, "gave them again")]
)
def test_black_images_are_not_laid_on_a_driver_that_repeats(gray: int | None, words: str) -> None:
    left, right = (
        (LEFT, RIGHT) if gray is None else (np.full_like(LEFT, gray), np.full_like(RIGHT, gray))
    )
    (line,) = RepeatReport(IMAGES).frame(_frame(2, left, right), Repeated(1, True))
    assert words in line


@pytest.mark.parametrize("exact", [True, False])
def test_of_one_camera_no_line_speaks_of_both_images(exact: bool) -> None:
    one = replace(_frame(2, LEFT, RIGHT), right=None)
    (line,) = RepeatReport(IMAGES).frame(one, Repeated(1, exact))
    assert "both" not in line
    (line,) = RepeatReport(IMAGES).frame(_frame(2, LEFT, RIGHT), Repeated(1, exact))
    assert "both images" in line


def test_corner_flow_measures_small_motions_and_leaves_out_the_border() -> None:
    at = np.concatenate([GRID, [[1.0, 1.0], [399.0, 100.0]]])
    flow = corner_flow(LEFT, _shifted(LEFT, 0.25), at)
    assert len(flow) == len(GRID)
    np.testing.assert_allclose(np.median(flow, axis=0), [0.25, 0.0], atol=0.04)
    assert len(corner_flow(LEFT, LEFT, np.zeros((0, 2)))) == 0


# A whole flight

Flight: TypeAlias = tuple[list[Event], Recording]


class Played:
    """A rendered flight, its frames changed on the way."""

    def __init__(
        self,
        events: list[Event],
        recording: Recording,
        change: Callable[[StereoFrame], StereoFrame],
    ) -> None:
        self._events, self.recording, self._change = events, recording, change

    def events(
        self, start: int = 0, stop: int | None = None, *, images: bool = True
    ) -> Iterator[Event]:
        yield from (self._change(e) if isinstance(e, StereoFrame) else e for e in self._events)

    def observations(self, index: int) -> Observations | None:
        return None


@pytest.fixture(scope="module")
def flight() -> Flight:
    simulation = simulate(
        room(1), small_rig(320, 200), hand_held(duration_s=FRAMES / 20), imu=ImuNoise(), seed=2
    )
    recording = SimulatedRecording(simulation)
    return list(recording.events()), recording.recording


def _ate(flight: Flight, change: Callable[[StereoFrame], StereoFrame]) -> tuple[float, list[str]]:
    events, recording = flight
    result = run(Played(events, recording, change), load_config(overrides=["motion=imu"]))
    assert recording.T_cam0_imu is not None
    score = evaluate(result.trajectory, recording.reference, T_cam0_imu=recording.T_cam0_imu)
    return score.ate_m.rmse, list(result.warnings)


@pytest.mark.parametrize("noisy", [False, True])
def test_a_frozen_camera_does_not_move_the_poses_and_is_named(flight: Flight, noisy: bool) -> None:
    """Half a second of repeated images, which had brought 0.07 m."""
    still = {e.index: e for e in flight[0] if isinstance(e, StereoFrame)}[FIRST - 1]
    assert still.left is not None
    assert still.right is not None
    left, right = still.left, still.right

    def frozen(frame: StereoFrame) -> StereoFrame:
        if not FIRST <= frame.index <= LAST:
            return frame
        if noisy:
            return replace(
                frame, left=_noisy(left, frame.index), right=_noisy(right, 1000 + frame.index)
            )
        return replace(frame, left=left.copy(), right=right.copy())

    error, lines = _ate(flight, frozen)
    assert error < 0.003
    assert any(f"frame {FIRST}: both images" in line for line in lines), lines
    assert any(
        f"frame {LAST + 1}: the images change again, after 10 repetitions (0.50 s)" in line
        for line in lines
    )
    assert not any("diverged" in line for line in lines)


@pytest.fixture(scope="module")
def flight_with_depth(flight: Flight) -> Flight:
    """The left camera of the flight with the noisy depths of a sensor."""
    simulation = simulate(
        room(1), small_rig(320, 200), hand_held(duration_s=FRAMES / 20), imu=ImuNoise(), seed=2
    )
    rendered, rng = SimulatedRecording(simulation), np.random.default_rng(3)
    events: list[Event] = []
    for event in flight[0]:
        if isinstance(event, StereoFrame):
            z, _ = rendered.depth(0, int(simulation.taken_ns[event.index]))
            z = np.where(np.isfinite(z), z, 0.0)
            event = replace(event, right=None, depth=z + 1.5e-3 * z**2 * rng.normal(size=z.shape))
        events.append(event)
    c = flight[1].camera
    camera = with_virtual_baseline(one_camera(c.fu, c.fv, c.cu, c.cv, c.width, c.height), 1.5e-3)
    return events, replace(flight[1], kind="rgbd", camera=camera)


def test_a_stuck_depth_camera_does_not_move_the_poses_and_is_named(
    flight_with_depth: Flight,
) -> None:
    """Half a second of the same depth image beside new images."""
    depth = {e.index: e for e in flight_with_depth[0] if isinstance(e, StereoFrame)}[
        FIRST - 1
    ].depth
    stuck, kept = depth, depth.copy()

    def frozen(frame: StereoFrame) -> StereoFrame:
        return replace(frame, depth=stuck.copy()) if FIRST <= frame.index <= LAST else frame

    right, lines = _ate(flight_with_depth, lambda frame: frame)
    assert lines == []
    error, lines = _ate(flight_with_depth, frozen)
    assert error < 2 * right
    assert (
        f"frame {FIRST}: the depth image is the same to the last bit since frame {FIRST - 1}"
        in lines[0]
    )
    assert (
        f"frame {LAST + 1}: the depth images change again, after 10 repetitions (0.50 s)"
        in lines[1]
    )
    assert lines[2:] == ["10 frames repeated earlier depth images, which were left out"]
    np.testing.assert_array_equal(stuck, kept)


def test_the_same_depth_image_is_used_at_standstill() -> None:
    depth = np.full((240, 400), 2.0)
    for shaking, repeated in ((False, False), (True, True)):
        frozen = _watching(shaking=shaking)
        for k in (1, 2):
            frame = replace(
                _frame(k, _shifted(LEFT, 5.0 * k), LEFT), right=None, depth=depth.copy()
            )
            assert frozen.check(frame, _expected()) is None
            found = frozen.check_depth(frame)
        assert (found is not None) == repeated


def test_a_clean_flight_gives_no_line(flight: Flight) -> None:
    assert _ate(flight, lambda frame: frame)[1] == []
