"""A right camera that turns about the vertical: the disparities of a frame are off by one amount.

Rows show nothing of it. But a point that a motion brings from disparity `d` to `d'` has, with left
pixels (x, y) after it over the focal length, `d = d' (1 + a x + b y + c) + g d d'` whatever its
depth, where a and b are the rotation about the image's axes, c is of second order in it, and g is
the motion along the optical axis over focal length and baseline. So what all disparities of a frame
have in common beyond that is the right camera's: `psi (1 + x'^2)` for a turn by psi over the focal
length, x' being the column of the right pixel.

One that stays makes the right pixels useless until it is gone; image checks then look for the
rotation (`vio.guard.turned_pair`). Of a pair that shakes, right pixels count less.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vio.findings import begun, ended
from vio.frontend.right_turn import PairShake, jump_limit_px
from vio.frontend.weighted_fit import add_equations
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.guard.match_check import (
    Hysteresis,
    MatchCheck,
    SharedMatches,
    shared_matches,
    without_right,
)
from vio.numerics.compiled import solve_positive
from vio.numerics.kinds import Tolerance
from vio.numerics.robust import median, robust_sigma
from vio.records import Observations, SigmaArray


class _ShiftRules(NamedTuple):
    """When all disparities of a frame are off."""

    min_matches: int = 20  # that two frames share
    # frames in a row without a jump, before one is a turn: images of two times jump whenever the
    # rig turns
    min_calm: int = 10
    clear_sigmas: float = 5.0  # of what they have in common
    # of the size from which on a pair shakes: largest standard deviation of a change that tells
    known_share: float = 0.5
    max_turn_rad: float = 0.1  # standard deviation of a rotation between two frames
    max_second_order: float = 0.005  # half of its square
    # frames that share too few with the last one that was compared, before another one counts as
    # that: descriptors first lose the matches of a camera that turns
    max_missed: int = 5
    steps: Tolerance[int] = 5  # of reweighting


_SHIFT = _ShiftRules()
_PRECISIONS = np.diag([0.0, *[_SHIFT.max_turn_rad**-2] * 2, _SHIFT.max_second_order**-2, 0.0])
_RIDGE = 1e-12  # of the diagonal: depths that are all alike determine no more than one term
_MIN_NOISE_PX = 0.05  # of a disparity against that of the frame before: less is luck
_CODE = "right-contradicts-left"


class ShiftedMatches(MatchCheck):
    """Removes right pixels while all disparities are off, and inflates them where a pair shakes."""

    def __init__(self, camera: StereoCamera) -> None:
        super().__init__()
        self._camera = camera
        self._compared: Observations | None = None  # the last frame that was
        self._missed = 0  # frames since
        self._limit_px = jump_limit_px(camera.fu)
        self._calm = 0  # frames since the last jump
        self._jumped = 0  # frame of the last one
        self._off_px = 0.0  # of the disparities, since they were those of the calibration
        self._shake = PairShake(camera.fu)
        self._state = Hysteresis(to_report=3, to_end=3, blind=40)

    def inspect(self, seen: Observations, shared: SharedMatches) -> Observations:
        """Compare the disparities of a frame with those of an earlier one, as other checks have left
        both.
        """
        index = seen.frame_index
        shared = shared_matches(self._compared, seen)
        change = common_change(self._camera, shared)
        self._missed = 0 if change is not None else self._missed + 1
        if self._missed == 0 or self._compared is None or self._missed > _SHIFT.max_missed:
            self._compared = seen
            self._missed = 0
        if change is not None:
            self._take_jump(index, *change)
        # one that is known less well says nothing of a pair that shakes
        known = change is not None and change[1] < _SHIFT.known_share * self._shake.limit_px
        self._shake.frame(index, change[0] if change is not None and known else None, len(shared))
        self._found += self._shake.take_findings()
        factor = self._shake.right_factor
        if factor > 1.0 and abs(self._off_px) < _SHIFT.clear_sigmas * self._shake.sigma_px:
            self._off_px = 0.0  # what jumped was a shake
        is_off = self._is_off
        # what jumps from frame to frame is no turn
        self._state.show(index, None if change is None or (is_off and not self._calm) else is_off)
        self._report(index)
        if is_off:
            return without_right(seen)
        return seen if factor == 1.0 else _inflated(seen, factor)

    @property
    def _is_off(self) -> bool:
        return abs(self._off_px) > self._limit_px

    def _take_jump(self, index: int, px: float, sigma_px: float) -> None:
        """Take by what the disparities of a frame differ from those before."""
        if abs(px) <= max(self._limit_px, _SHIFT.clear_sigmas * sigma_px):
            self._calm += 1
            return
        if not self._is_off:
            self._jumped = index
        if self._is_off or self._calm >= _SHIFT.min_calm:
            self._off_px += px
        self._calm = 0

    def _report(self, index: int) -> None:
        state = self._state
        if state.to_report():
            text = (
                "the right pixels contradict the left ones since frame "
                f"{self._jumped}: all disparities are off by {self._off_px:.2g} px; the right camera "
                "has turned in its mount, or the pairs have become others; going on with the left "
                "pixels"
            )
            figures = {"offset_px": self._off_px}
            self._found.append(begun(_CODE, index, text, self._jumped, figures=figures))
        if state.ends():
            self._off_px = 0.0
            self._found.append(
                ended(_CODE, index, "the right pixels agree with the left ones again")
            )


def common_change(camera: StereoCamera, shared: SharedMatches) -> tuple[float, float] | None:
    """Return by what the disparities of two frames differ at all depths, whatever the motion
    between them, and its standard deviation; pixels at the middle column.

    None: they share too few matches. Depths that are alike say little, and the deviation is large.
    """
    if len(shared) < _SHIFT.min_matches:
        return None
    old = shared.before[:, 0] - shared.before[:, 2]
    new = shared.now[:, 0] - shared.now[:, 2]
    x = (shared.now[:, 0] - camera.cu) / camera.fu
    y = (shared.now[:, 1] - camera.cv) / camera.fv
    right = (shared.now[:, 2] - camera.cu) / camera.fu
    terms = np.stack([1.0 + right**2, -new * x, -new * y, -new, -old * new], axis=1)
    change = new - old
    fitted: FloatArray = np.array([median(change), 0.0, 0.0, 0.0, 0.0])
    for _ in range(_SHIFT.steps):
        residuals = change - terms @ fitted
        noise_px = max(robust_sigma(residuals), _MIN_NOISE_PX)
        normal = _PRECISIONS * noise_px**2
        moment: FloatArray = np.zeros(len(fitted))
        add_equations(terms, change, fitted, 2.0 * noise_px, normal, moment)
        normal += _RIDGE * np.diag(normal.diagonal())
        solve_positive(normal.copy(), moment)
        fitted = moment
    variance = noise_px**2 * np.linalg.inv(normal)[0, 0]
    return float(fitted[0]), float(np.sqrt(variance))


def _inflated(seen: Observations, factor: float) -> Observations:
    """Return features whose right pixels are less certain."""
    sigma: SigmaArray = np.ones((len(seen), 3), dtype=np.float32)
    if seen.sigma is not None:
        sigma = seen.sigma.copy()
    sigma[:, 2] *= factor
    return replace(seen, sigma=sigma)
