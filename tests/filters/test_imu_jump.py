"""A gyro whose bias jumps during a run: the images estimate it anew; shocks and things that move
do not count as one.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.filters.test_msckf import EXACT_RIG, STEP_NS, Flight
from vio.filters.imu_jump import (
    Contradiction,
    GyroJump,
    ShownMotion,
    _common_turn,
)
from vio.filters.msckf import Msckf
from vio.filters.noise import StepErrors
from vio.filters.track_records import Residuals
from vio.filters.window_tracks import LinearTracks
from vio.geometry.lie import FloatArray, so3_exp
from vio.records import ImuSample, Observations, UpdateReport

FRAMES = 70
JUMP_FRAME = 40
SETTINGS = replace(EXACT_RIG, calibrate_camera_imu="none")


class _Noted(Msckf):
    """Keeps what each update reported."""

    def update(self, observations: Observations) -> UpdateReport:
        report = super().update(observations)
        self.jumps = [*getattr(self, "jumps", []), report.gyro_jump_radps]
        return report


class _Shaken(Flight):
    """A flight whose gyro is off by a bias (3,), and its accelerometer by a push (3,), from a
    frame on, up to another one.
    """

    def __init__(
        self, bias: FloatArray, *, push: FloatArray | None = None, last: int = FRAMES
    ) -> None:
        super().__init__(frames=FRAMES)
        self.bias = bias
        self.push = np.zeros(3) if push is None else push
        self.last = last

    def imu(self, noise: np.random.Generator, bias: FloatArray) -> list[ImuSample]:
        # the jump is within a frame's interval
        first_ns = round((JUMP_FRAME - 0.4) * STEP_NS)
        last_ns = round((self.last - 0.4) * STEP_NS)
        return [
            replace(x, gyro=x.gyro + self.bias, accel=x.accel + self.push)
            if first_ns <= x.time_ns < last_ns
            else x
            for x in super().imu(noise, bias)
        ]


@pytest.mark.parametrize("size", [0.05, 0.15, 0.4])
def test_images_estimate_a_bias_that_has_jumped(size: float) -> None:
    bias = size * np.array([0.6, -0.64, 0.48])
    flight = _Shaken(bias)
    errors, covariances, filt = flight.run(
        SETTINGS, "imu", sigma=0.2, limit=120, filter_class=_Noted
    )
    named = [k for k, jump in enumerate(filt.jumps) if jump is not None]
    assert named
    assert JUMP_FRAME <= named[0] <= JUMP_FRAME + 10
    assert filt.jumps[named[0]] == pytest.approx(size, rel=0.2)
    np.testing.assert_allclose(filt.estimate().gyro_bias, bias, atol=0.02)
    error_m = np.linalg.norm(errors[:, :3], axis=1)
    sigma_m = np.sqrt(np.trace(covariances[:, :3, :3], axis1=1, axis2=2))
    assert (error_m[5:] < 3 * sigma_m[5:]).all()


def test_a_gyro_that_stays_right_is_not_named() -> None:
    _, _, filt = Flight(frames=FRAMES).run(
        SETTINGS, "imu", sigma=0.2, limit=120, filter_class=_Noted
    )
    assert not any(filt.jumps)


def _asked(off: list[bool]) -> list[bool]:
    """Whether a gyro is asked in each step, if the images contradicted it, after steps that were
    off or not.
    """
    jump = GyroJump()
    asked = []
    for each in off:
        asked.append(jump.is_asked(9.0))
        jump.take(off=each)
    return asked


def test_steps_that_were_off_before_make_no_jump() -> None:
    """Axes, a scale or a clock that are wrong contradict the images in every turn."""
    asked = _asked([False] * 31 + [True] * 4)
    assert not any(asked[:21])
    # the first steps of a jump are off themselves
    assert all(asked[21:])
    assert not any(_asked([k % 3 == 0 for k in range(90)])[21:])


def test_few_steps_that_were_off_are_soon_forgotten() -> None:
    """More than three of the twenty steps before the newest three make the gyro a wrong one."""
    asked = _asked([40 <= k < 44 for k in range(66)])
    assert all(asked[21:47])  # only three of the four are older than the newest
    assert not any(asked[47:64])
    assert all(asked[64:])


class _Turned(Flight):
    """A flight whose gyro is turned by 15 degrees about the camera's axis."""

    def imu(self, noise: np.random.Generator, bias: FloatArray) -> list[ImuSample]:
        R = so3_exp([0.0, 0.0, np.radians(15.0)])
        return [replace(x, gyro=R @ x.gyro) for x in super().imu(noise, bias)]


def test_a_gyro_that_is_turned_has_not_jumped() -> None:
    _, _, filt = _Turned(frames=FRAMES).run(
        SETTINGS, "imu", sigma=0.2, limit=120, filter_class=_Noted
    )
    assert not any(filt.jumps)


SHOCK = np.array([0.6, -0.64, 0.48])


@pytest.mark.parametrize(
    ("gyro_radps", "accel_mps2", "frames"),
    [(2.0, 0.0, 1), (2.0, 40.0, 1), (1.5, 0.0, 4), (0.0, 60.0, 1), (0.4, 0.0, 2)],
)
def test_a_shock_costs_neither_the_pose_nor_the_bias(
    gyro_radps: float, accel_mps2: float, frames: int
) -> None:
    """The images measure the steps that the IMU does not."""
    quiet, _, clean = Flight(frames=FRAMES).run(SETTINGS, "imu", sigma=0.2, limit=120)
    flight = _Shaken(
        gyro_radps * SHOCK, push=accel_mps2 * np.array([0.8, 0.0, -0.6]), last=JUMP_FRAME + frames
    )
    errors, covariances, filt = flight.run(SETTINGS, "imu", sigma=0.2, limit=120)
    error_m = np.linalg.norm(errors[JUMP_FRAME:, :3], axis=1)
    sigma_m = np.sqrt(np.trace(covariances[JUMP_FRAME:, :3, :3], axis1=1, axis2=2))
    assert (error_m < 3 * sigma_m).all()
    assert error_m.max() < 2 * np.linalg.norm(quiet[JUMP_FRAME:, :3], axis=1).max()
    np.testing.assert_allclose(filt.estimate().gyro_bias, clean.estimate().gyro_bias, atol=0.001)


def _tracks(
    turn: FloatArray, moving: FloatArray, *, shift: FloatArray | None = None, views: int = 6
) -> LinearTracks:
    """Tracks of a camera at the origin whose points are off by a rotation and a shift, and some of
    them (N,) by a motion of their own, pixels.
    """
    rng = np.random.default_rng(3)
    count = len(moving)
    p = np.column_stack([rng.uniform(-3, 3, (count, 2)), rng.uniform(4, 9, count)])
    f = 400.0
    J = np.zeros((count, views, 4, 3))
    for row, baseline_m in ((0, 0.0), (2, 0.1)):
        x = p[:, 0] - baseline_m
        J[:, :, row, 0] = (f / p[:, 2])[:, None]
        J[:, :, row, 2] = (-f * x / p[:, 2] ** 2)[:, None]
        J[:, :, row + 1, 1] = (f / p[:, 2])[:, None]
        J[:, :, row + 1, 2] = (-f * p[:, 1] / p[:, 2] ** 2)[:, None]
    r = rng.normal(0, 0.2, (count, views, 4))
    moved = np.cross(turn, p) + (0.0 if shift is None else shift)
    r[:, -1] += np.einsum("fki,fi->fk", J[:, -1], moved)
    r[:, -1, [0, 2]] += moving[:, None]
    at = Residuals(r, J, np.ones(count, dtype=np.bool_), np.ones((count, views, 4)))
    T = np.broadcast_to(np.eye(4), (views, 4, 4)).copy()
    no_pixels = np.zeros((count, views, 4))
    return LinearTracks(None, 0.04, T, np.arange(count), p, at, no_pixels, None)  # type: ignore[arg-type]


TURN = np.array([0.004, -0.006, 0.003])
MOVED = np.diag([1e-3, 1e-3, 1e-3, 1e-4, 1e-4, 1e-4]) ** 2


def _shown(
    tracks: LinearTracks,
) -> Contradiction | None:
    """What tracks at a small motion show, of a body at the origin."""
    nav = SimpleNamespace(T_world_imu=np.eye(4))
    window: Any = SimpleNamespace(nav=nav, clones=None)
    left = tracks

    def move(turn: FloatArray, shift: FloatArray) -> None:
        """The body moves, so that its points move the other way."""
        nonlocal left
        J = left.at.z_D_p[:, -1]
        r = left.at.r.copy()
        r[:, -1] += np.einsum("fki,fi->fk", J, np.cross(turn, left.p_world) + shift)
        left = replace(left, at=left.at._replace(r=r))

    window.move_newest = move
    return ShownMotion(window, MOVED, lambda: left).find(tracks)


def test_one_rotation_of_all_old_tracks_is_found() -> None:
    found = _shown(_tracks(TURN, np.zeros(60)))
    assert found is not None
    assert found.shift is None
    np.testing.assert_allclose(found.turn, -TURN, atol=3e-4)


def test_a_shift_beside_it_is_found_however_little_it_was_expected() -> None:
    """Fifty standard deviations; held to what was predicted, it would pass for a rotation."""
    shift = np.array([0.05, -0.03, 0.02])
    found = _shown(_tracks(TURN, np.zeros(60), shift=shift))
    assert found is not None
    assert found.shift is not None
    np.testing.assert_allclose(found.shift[:2], -shift[:2], atol=3e-3)
    np.testing.assert_allclose(found.turn, -TURN, atol=6e-4)


def test_a_shift_alone_is_no_rotation() -> None:
    """A push on the accelerometer."""
    pushed = _tracks(np.zeros(3), np.zeros(60), shift=np.array([0.05, -0.03, 0.02]))
    assert _shown(pushed) is None


@pytest.mark.parametrize(("count", "found"), [(14, False), (15, True)])
def test_a_few_tracks_prove_no_rotation(count: int, found: bool) -> None:
    turn = _shown(_tracks(TURN, np.zeros(count)))
    assert (turn is not None) == found


@pytest.mark.parametrize(("moving", "found"), [(16, True), (24, False)])
def test_four_fifths_of_the_tracks_must_agree_on_a_rotation(moving: int, found: bool) -> None:
    off = np.where(np.arange(100) < moving, 6.0, 0.0)
    assert (_shown(_tracks(TURN, off)) is not None) == found


def test_things_that_move_are_no_rotation() -> None:
    moving = np.where(np.arange(60) < 25, 6.0, 0.0)
    assert _shown(_tracks(np.zeros(3), moving)) is None


def test_what_has_just_come_into_view_is_not_asked() -> None:
    """A track is old once four views before the newest one have seen it."""
    young = _tracks(TURN, np.zeros(60), views=4)
    assert _shown(young) is None
    assert _shown(_tracks(TURN, np.zeros(60), views=5)) is not None


def test_a_bias_that_comes_back_has_not_jumped() -> None:
    jump = GyroJump()
    assert not jump.repeats(np.array([0.1, 0, 0]))
    assert jump.repeats(np.array([0.12, 0.01, 0]))
    assert not jump.repeats(np.array([-0.1, 0, 0]))
    jump.doubt(np.zeros(3), np.full(3, 0.002))
    jump.doubt(np.array([0.1, 0, 0]), np.full(3, 0.05))  # the first one counts
    known = np.full(3, 0.002)
    assert jump.agrees(np.array([0.004, 0, 0]), known) is None
    jump.doubt(np.zeros(3), known)
    assert jump.agrees(np.array([0.1, 0, 0]), known) == pytest.approx(0.1)
    assert jump.agrees(np.array([0.1, 0, 0]), known) is None


def test_a_bias_that_is_not_known_yet_has_neither_jumped_nor_come_back() -> None:
    jump = GyroJump()
    off = np.array([0.05, 0.0, 0.0])
    jump.doubt(np.zeros(3), np.full(3, 0.002))
    assert jump.agrees(off, np.full(3, 0.03)) is None
    assert jump.agrees(off, np.full(3, 0.005)) == pytest.approx(0.05)
    jump.doubt(np.zeros(3), np.full(3, 0.002))
    assert jump.agrees(off, np.full(3, 0.03)) is None
    assert jump.agrees(0.1 * off, np.full(3, 0.003)) is None  # it has come back
    assert jump.agrees(off, np.full(3, 0.003)) is None


@pytest.mark.parametrize(("rate", "alike"), [(0.149, False), (0.151, True)])
def test_rates_are_alike_up_to_half_of_the_larger(rate: float, alike: bool) -> None:
    jump = GyroJump()
    jump.repeats(np.array([0.3, 0.0, 0.0]))
    assert jump.repeats(np.array([rate, 0.0, 0.0])) == alike


@pytest.mark.parametrize(("degrees", "alike"), [(17.0, True), (19.5, False)])
def test_a_rate_that_grows_in_its_direction_is_alike(degrees: float, alike: bool) -> None:
    """What one step did not take back adds to the next."""
    jump = GyroJump()
    jump.repeats(np.array([0.1, 0.0, 0.0]))
    angle = np.radians(degrees)
    assert jump.repeats(0.3 * np.array([np.cos(angle), np.sin(angle), 0.0])) == alike


E = np.diag([1e-2, 1e-2, 1e-2, 2e-8, 1e-8, 3e-8])


def _steps(turns: FloatArray, gain: float) -> list[StepErrors]:
    """Steps over which images showed rotations (N, 3), of which a filter has taken a share."""
    left = E.copy()
    left[3:, 3:] *= 1.0 - gain
    zero = np.zeros(3)
    return [StepErrors(np.concatenate([zero, gain * turn]), E, E, left) for turn in turns]


@pytest.mark.parametrize(("sigmas", "shown"), [(0.98, False), (1.02, True)])
def test_small_corrections_in_one_direction_are_a_rate(sigmas: float, shown: bool) -> None:
    """Of what images contradict, a filter that trusts its gyro corrects a twentieth; the sum has a
    probability of 1e-5, and the rotation is that of the images.
    """
    limit = np.sqrt(25.9017 / 0.05 / 6 / 3 * np.diag(E)[3:])  # of each axis and step
    turns = np.tile(sigmas * limit, (6, 1))
    found = _common_turn(_steps(turns, 0.05))
    assert (found is not None) == shown
    if found is not None:
        np.testing.assert_allclose(found, turns.sum(axis=0), rtol=1e-6)


@pytest.mark.parametrize(("share", "shown"), [(0.81, False), (0.86, True)])
def test_corrections_in_all_directions_are_no_rate(share: float, shown: bool) -> None:
    """The squared length of their sum must be 0.7 of that in one direction."""
    one = 1e-2 * np.array([0.6, 0.0, 0.8])
    other = 1e-2 * np.array([0.0, 1.0, 0.0])
    across = np.sqrt(1.0 - share**2)
    turns = np.array([share * one + (-1) ** k * across * other for k in range(6)])
    assert (_common_turn(_steps(turns, 0.05)) is not None) == shown


@pytest.mark.parametrize(("sigmas", "named"), [(2.9, False), (3.1, True)])
def test_a_change_within_three_standard_deviations_is_no_jump(sigmas: float, named: bool) -> None:
    jump = GyroJump()
    jump.doubt(np.zeros(3), np.array([0.0, 0.002, 0.0]))
    change = np.array([0.002 * sigmas, 0.0, 0.0])
    assert (jump.agrees(change, np.zeros(3)) is not None) == named
