"""An IMU that is shocked, or whose gyro's bias jumps: the images show another motion than it does,
the same one in all old tracks.

A scene that stands still, seen by a body whose gyro is wrong, is off by one rotation in all its
tracks; a shock may move it, too. Things that move by themselves contradict the rest of the scene,
and what comes into view is not old. Where one motion explains nearly all old tracks, the newest
pose takes it and becomes uncertain by its size; where the rate repeats, the gyro's bias does, too.
The images estimate both anew: equation (N15) of docs/math.md.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vio.filters.multiview import CAUCHY
from vio.filters.navigation import Growth
from vio.filters.noise import (
    ROTATION,
    SLIGHTLY_INFORMED,
    TRANSLATION,
    StepErrors,
    turn_shown,
    whitened_correction,
)
from vio.filters.track_records import Residuals
from vio.filters.window import Window
from vio.filters.window_tracks import VIEW_PROBABILITY, LinearTracks, chi_square_table
from vio.geometry.lie import FloatArray, length, so3_exp, so3_hat, so3_log
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import median
from vio.numerics.statistics import chi_square_quantile
from vio.records import MAX_GYRO_BIAS_RADPS, BoolArray


class _MotionRules(NamedTuple):
    """The motion that old tracks show."""

    min_old_views: int = 4  # of a track before the newest: what it shows has been part of the scene
    min_old_tracks: int = 15
    min_agreeing_share: float = 0.8  # share of the old tracks that one motion must explain
    # information of a translation that may be off, over what it has as predicted: a thousand
    # times its standard deviation
    weight_of_unknown: float = 1e-6
    # from what was predicted; renders along real flights whose gyro is right come to 8, half a
    # step of one that has jumped by 0.05 rad/s to 12
    sigmas: float = 10.0
    steps: Tolerance[int] = 8  # of the robust fit
    max_moves: Tolerance[int] = 6  # of the pose, with the tracks linearised anew
    small_turn: Tolerance[float] = 0.01  # rad, of which the square moves no pixel by a tenth


_MOTION = _MotionRules()


class _JumpRules(NamedTuple):
    """When the gyro's bias has jumped."""

    # of a filter that has begun, after which a shock is told from what it did not know yet
    first_steps: int = 20
    # and a bias that jumps from one that is learned
    start_steps: int = 30
    # A jump comes after steps that agreed: of so many before the newest ones (which may belong to
    # it) so few are off. A gyro that is wrong all the time (its axes, clock, scale) is no gyro that
    # jumped.
    quiet_steps: int = 20
    newest_steps: int = 3
    max_off_steps: int = 3
    # innovations over their standard deviation (median): more, and the gyro may have jumped
    innovation_sigmas: float = 1.4
    changed_sigmas: float = 3.0  # of the bias before and now: less is no jump
    known_again: float = 2.0  # standard deviations of before; the bias is as well known again
    # of the larger one: rates of two steps that differ by less are one jump
    alike_share: float = 0.5
    # cosine of the angle between two rates of which the second is larger, above which it is one:
    # what was not taken back in one step adds to the next
    alike_direction: float = 0.95


_JUMP = _JumpRules()


class _LastingRules(NamedTuple):
    """When corrections of several steps show one wrong rate, each of them too small to show it.

    A gyro is known far better than what the images of one step show, so that they correct little of
    a small jump.
    """

    # newest ones that are summed, those of a large and of a small jump
    few_steps: int = 5
    steps: int = 10
    # chi-square probability beyond which the sum is an exception; simulated flights and drives
    # with drawn rigs come to 16 of 3 degrees of freedom, a jump of 0.03 rad/s to 230 in ten steps,
    # renders along real flights with their IMU to 460 while its noise is learned
    probability: float = 0.99999
    # of the squared length that corrections in one direction would sum to; 1 / steps where they
    # have nothing in common
    min_coherence: float = 0.7


_LASTING = _LastingRules()
_LASTING_LIMIT = chi_square_quantile(_LASTING.probability, np.arange(1, 4)).tolist()


class Contradiction(NamedTuple):
    """The motion of the body, world frame, by which images contradict a predicted step."""

    turn: FloatArray  # (3,) rad
    shift: FloatArray | None  # (3,) m; None: the translation is as predicted


class _OldTracks(NamedTuple):
    """The newest pixels of old tracks, linearised by the body's motion about itself."""

    D_motion: FloatArray  # (F, 4, 6)
    r: FloatArray  # (F, 4)
    variance: float  # of a pixel


def _old_tracks(predicted: LinearTracks, p_body: FloatArray) -> _OldTracks:
    """Return what the newest clone sees of old tracks, of a body at (3,)."""
    old = _is_old(predicted.at)
    J = predicted.at.z_D_p[old, -1]
    arms = predicted.p_world[old] - p_body
    D_motion = np.concatenate([-J, J @ so3_hat(arms)], axis=2)  # points move the other way
    return _OldTracks(D_motion, predicted.at.r[old, -1], predicted.variance)


class ShownMotion:
    """Fits the motion of the body by which the newest pixels of old tracks differ from the
    predicted ones, and moves the newest pose by it.
    """

    def __init__(
        self, window: Window, moved: FloatArray, linearise: Callable[[], LinearTracks]
    ) -> None:
        """Take a window at its prediction.

        Args:
            window: whose newest pose is moved.
            moved: covariance (6, 6) of its motion since the clone before, `[rho; phi]` on the
                world's side.
            linearise: returns the tracks at the window's present means.
        """
        self._window = window
        self._linearise = linearise
        about_body = np.eye(6)
        about_body[:3, 3:] = -so3_hat(window.nav.T_world_imu[:3, 3])
        self._expected = about_body @ moved @ about_body.T
        self._turned = np.eye(3)
        self._shift = np.zeros(3)

    def find(self, predicted: LinearTracks) -> Contradiction | None:
        """Fit it to tracks that are linearised at the prediction.

        None: its rotation is within what was predicted, or no single motion explains nearly all
        old tracks; the pose is where it was.
        """
        window = self._window
        before = window.nav, window.clones
        found = self._found(_old_tracks(predicted, before[0].T_world_imu[:3, 3]))
        if found is None:
            window.nav, window.clones = before
        return found

    def _found(self, old: _OldTracks) -> Contradiction | None:
        if len(old.r) < _MOTION.min_old_tracks:
            return None
        held = np.zeros((6, 6))
        held[:3, :3] = np.linalg.inv(self._expected[:3, :3])
        free = _MOTION.weight_of_unknown * held
        motion, P, _ = _robust_fit(old, held)
        if not self._is_beyond(motion[ROTATION], P, ROTATION):
            return None
        old = self._moved(motion, held, shifts=False)
        if len(old.r) < _MOTION.min_old_tracks:
            return None
        # it may be the translation instead that is not as predicted, or both
        motion, P, _ = _robust_fit(old, free)
        is_shifted = self._is_beyond(motion[TRANSLATION], P, TRANSLATION)
        if is_shifted:
            old = self._moved(motion, free, shifts=True)
            if len(old.r) < _MOTION.min_old_tracks:
                return None
        _, P, left = _robust_fit(old, free if is_shifted else held)
        turn = so3_log(self._turned)
        if not self._is_beyond(turn, P, ROTATION):
            return None
        pixels = np.any(old.D_motion[:, :, :3] != 0.0, axis=2).sum(axis=1)
        width = CAUCHY * CAUCHY * old.variance
        limits = width * chi_square_table(VIEW_PROBABILITY)[pixels]
        if np.mean(np.sum(left**2, axis=1) < limits) <= _MOTION.min_agreeing_share:
            return None
        return Contradiction(turn, self._shift if is_shifted else None)

    def _moved(self, motion: FloatArray, information: FloatArray, *, shifts: bool) -> _OldTracks:
        """Move the pose by Gauss-Newton steps, of which the first one (6,) is given; return the
        tracks where it is.
        """
        window = self._window
        for _ in range(_MOTION.max_moves):
            shift = motion[TRANSLATION] if shifts else np.zeros(3)
            window.move_newest(motion[ROTATION], shift)
            self._turned = so3_exp(motion[ROTATION]) @ self._turned
            self._shift = self._shift + shift
            old = _old_tracks(self._linearise(), window.nav.T_world_imu[:3, 3])
            is_small = length(motion[ROTATION]) < _MOTION.small_turn
            if is_small or len(old.r) < _MOTION.min_old_tracks:
                break
            motion = _robust_fit(old, information)[0]
        return old

    def _is_beyond(self, error: FloatArray, P: FloatArray, part: slice) -> bool:
        """Whether a part (3,) of a motion with its covariance (6, 6) is beyond what was predicted
        by far.
        """
        covariance = self._expected[part, part] + P[part, part]
        return float(error @ np.linalg.solve(covariance, error)) > _MOTION.sigmas**2


def _noise_of(growth: Growth, motion: FloatArray, part: int) -> FloatArray:
    """Return the covariance (15, 15) that a step lacks in which noise of the accelerometer (part
    0) or of the gyro (1) made a shift or a rotation (3,).
    """
    Q = growth.Q_parts[part]
    made = Q[3 * part : 3 * part + 3, 3 * part : 3 * part + 3]
    out: FloatArray = Q * (motion @ motion / (np.trace(made) / 3))
    return out


def _bias_doubt(growth: Growth, turn: FloatArray, seconds: float) -> FloatArray:
    """Return the covariance (15, 15) that a navigation state lacks after a step with a growth of
    its error, in which a bias made such a rotation.
    """
    by_bias = growth.Phi[:, 9:12] * (length(turn) / seconds)
    out: FloatArray = by_bias @ by_bias.T
    return out


class GyroJump:
    """Tells a gyro whose bias has jumped from single steps that contradict it, as shocks do."""

    def __init__(self) -> None:
        self._steps = 0  # of the filter since its start
        self._off = deque[bool](maxlen=_JUMP.quiet_steps + _JUMP.newest_steps)  # which were off
        self._rate: FloatArray | None = None  # (3,) that the last step was off by
        # the newest steps, and how long they took
        self._recent = deque[tuple[StepErrors, float]](maxlen=_LASTING.steps)
        # (3,) the bias before it was doubted, and its standard deviations then; None: it is not
        self._before: tuple[FloatArray, FloatArray] | None = None

    def take(self, *, off: bool) -> None:
        """Take a step, and whether the images contradicted its rotation."""
        self._steps += 1
        self._off.append(off)

    def is_asked(self, innovation_ratio: float | None) -> bool:
        """Whether innovations over their standard deviation, median, contradict the prediction,
        after a start that learns bias and tilt and steps that agreed; None: there are none.
        """
        return (innovation_ratio or 0.0) > _JUMP.innovation_sigmas and self._settled

    def doubt_step(self, window: Window, shown: Contradiction, growth: Growth) -> None:
        """Make what the images contradict of the newest step uncertain; the gyro's bias, too, if
        they did so by the like in the step before.

        Args:
            window: whose newest step it is; its pose is where the images show it.
            shown: by which motion they contradict it.
            growth: of the state's error over the step.
        """
        seconds = window.last_step_s
        rate = shown.turn / seconds
        if shown.shift is not None:
            window.inflate_process_noise(_noise_of(growth, shown.shift, 0))
        is_bias = self._knows_bias and length(rate) <= MAX_GYRO_BIAS_RADPS
        if self.repeats(rate) and is_bias:
            self._doubt_gyro(window, shown.turn, growth, seconds)
        else:
            window.inflate_process_noise(_noise_of(growth, shown.turn, 1))

    def doubts_lasting(self, window: Window, step: StepErrors, growth: Growth) -> bool:
        """Take the correction of a step that the images do not contradict; return whether they
        show one wrong rate with those before, by which the bias becomes uncertain then.

        Args:
            window: whose newest step it is.
            step: its correction.
            growth: of the state's error over the step.
        """
        if not self._settled or not self._knows_bias:
            return False
        self._recent.append((step, window.last_step_s))
        recent = list(self._recent)
        for count in (_LASTING.few_steps, _LASTING.steps):
            newest = recent[-count:]
            if len(newest) < count:
                return False
            turn = _common_turn([step for step, _ in newest])
            if turn is not None:
                self._doubt_gyro(window, turn, growth, sum(seconds for _, seconds in newest))
                self._recent.clear()
                return True
        return False

    def _doubt_gyro(self, window: Window, turn: FloatArray, growth: Growth, seconds: float) -> None:
        """Make the bias uncertain by a rotation (3,) over some seconds up to the newest step."""
        self.doubt(window.nav.gyro_bias, bias_sigma(window))
        lacking = _noise_of(growth, turn, 1) + _bias_doubt(growth, turn, seconds)
        window.inflate_process_noise(lacking)

    @property
    def _knows_bias(self) -> bool:
        return self._steps > _JUMP.start_steps

    @property
    def _settled(self) -> bool:
        before = list(self._off)[: -_JUMP.newest_steps]
        return self._steps > _JUMP.first_steps and sum(before) <= _JUMP.max_off_steps

    def repeats(self, rate: FloatArray) -> bool:
        """Take the rate (3,) that a step was off by; return whether the last step was off by the
        like.
        """
        last = self._rate
        self._rate = rate
        if last is None:
            return False
        size = length(rate)
        before = length(last)
        if length(rate - last) < _JUMP.alike_share * max(size, before):
            return True
        return size > before and float(rate @ last) > _JUMP.alike_direction * size * before

    def doubt(self, bias: FloatArray, sigma: FloatArray) -> None:
        """Take the bias (3,) and its standard deviations (3,) as they were before they are
        doubted.
        """
        if self._before is None:
            self._before = bias, sigma

    def agrees(self, bias: FloatArray, sigma: FloatArray) -> float | None:
        """Take the bias (3,) and its standard deviations after a step that the gyro has predicted.

        Return by how much it has changed since it was doubted, rad/s, as soon as that is known;
        None: it was not doubted, it is not known yet, or the bias has come back.
        """
        self._rate = None
        if self._before is None:
            return None
        before, sigma_before = self._before
        usual = length(sigma_before)
        now = length(sigma)
        changed = length(bias - before)
        if changed > _JUMP.changed_sigmas * math.hypot(usual, now):
            self._before = None
            return changed
        if now < _JUMP.known_again * usual:
            self._before = None
        return None


def bias_sigma(window: Window) -> FloatArray:
    """Standard deviations (3,) of the gyro's bias."""
    sigma: FloatArray = np.sqrt(window.prior.P.diagonal()[9:12])
    return sigma


def _common_turn(steps: list[StepErrors]) -> FloatArray | None:
    """Return the rotation (3,) over some steps that their corrections show as one wrong rate; None:
    they show none.
    """
    total = steps[0]
    for step in steps[1:]:
        total = total + step
    test = whitened_correction(total, ROTATION, SLIGHTLY_INFORMED)
    if not test.dof or test.squared < _LASTING_LIMIT[test.dof - 1]:
        return None
    corrections = np.array([step.correction[ROTATION] for step in steps])
    lengths = float(np.sum(corrections**2)) * len(steps)
    if float(np.sum(total.correction[ROTATION] ** 2)) < _LASTING.min_coherence * lengths:
        return None
    return turn_shown(total)


def _is_old(at: Residuals) -> BoolArray:
    """Which tracks (F,) the newest clone sees, and several before it have seen."""
    seen = np.any(at.z_D_p != 0.0, axis=(2, 3))
    old: BoolArray = seen[:, -1] & (seen[:, :-1].sum(axis=1) >= _MOTION.min_old_views)
    return old


def _robust_fit(
    old: _OldTracks, information: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fit a motion (6,) with a prior's information (6, 6) to tracks by Cauchy weights.

    Returns:
        The motion, `r = D_motion motion + noise`, its covariance (6, 6), and the residuals left
        (F, 4).
    """
    B, r, variance = old
    width = CAUCHY * CAUCHY * variance
    left: FloatArray = r
    H = B.reshape(-1, 6)
    z = r.ravel()
    # the first scale is that of the residuals themselves, as all of them are off together
    squared: FloatArray = np.einsum("fi,fi->f", r, r)
    scale = max(width, median(squared))
    for _ in range(_MOTION.steps):
        weighted = np.repeat(1 / (1 + squared / scale), 4)[:, None] * H / variance
        A = weighted.T @ H + information
        motion = np.asarray(np.linalg.solve(A, weighted.T @ z), dtype=np.float64)
        left = r - B @ motion
        squared = np.einsum("fi,fi->f", left, left)
        scale = max(width, 0.25 * scale)
    return motion, np.asarray(np.linalg.inv(A), dtype=np.float64), left
