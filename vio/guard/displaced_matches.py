"""A right camera that turns in its mount: its rows jump, all at once and for good.

Rows of left and right pixels differ by a smooth field that a wrong calibration makes, which is
learned here from all matches. Where the matches of a frame are off that field by far more than
usual, the right camera is not where it was, and its pixels are not used until they fit again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vio.findings import begun, ended
from vio.frontend.weighted_fit import ROW_SIGMA_PX, add_equations
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.guard.match_check import Hysteresis, MatchCheck, SharedMatches, without_right
from vio.numerics.compiled import solve_positive
from vio.numerics.robust import cauchy_fit, median
from vio.records import Observations


@dataclass(frozen=True, slots=True)
class _RowRules:
    """When the rows of right pixels contradict those so far."""

    min_matches: int = 20  # in a frame that tells
    min_frames: int = 5  # that the field was learned from
    memory: float = 0.97  # per frame, of the normal equations
    first_steps: int = 10  # of the fit to the first frame, in which wrong rows lose their weight
    # median distance from the field that contradicts it: that of rows that are random within 1.5
    # px, in which descriptors are matched …
    min_rows_px: float = 0.75
    clear_ratio: float = 5.0  # … and times the usual one
    agreeing_ratio: float = 0.5  # of the distance that contradicts, below which the rows fit again
    usual_gain: float = 0.2  # how fast the usual distance is learned
    # a single row that is off by so much, and by so many times the usual distance, is no match
    min_wrong_px: float = 3.0
    wrong_ratio: float = 10.0


_ROWS = _RowRules()
_TERMS = 6
_CODE = "right-contradicts-left"


class DisplacedMatches(MatchCheck):
    """Removes right pixels whose rows contradict those so far."""

    def __init__(self, camera: StereoCamera) -> None:
        super().__init__()
        self._camera = camera
        self._normal: FloatArray = np.zeros((_TERMS, _TERMS))
        self._moment: FloatArray = np.zeros(_TERMS)
        self._field: FloatArray = np.zeros(_TERMS)
        self._frames = 0
        self._usual_px = 0.0
        self._state = Hysteresis(to_report=3, to_end=3, blind=40)

    def inspect(self, seen: Observations, shared: SharedMatches) -> Observations:
        """Compare the rows of left and right pixels with the field."""
        index = seen.frame_index
        state = self._state
        z = seen.z[seen.has_right]
        if len(z) < _ROWS.min_matches:
            state.show(index, None)
            return seen if state.since is None else without_right(seen)
        terms = self._terms(z)
        rows = z[:, 3] - z[:, 1]
        if not self._frames:
            self._field[0] = median(rows)
            self._field = cauchy_fit(terms, rows, self._field, ROW_SIGMA_PX, _ROWS.first_steps)
        distance_px = np.abs(rows - terms @ self._field)
        off_px = median(distance_px)
        limit_px = max(_ROWS.min_rows_px, _ROWS.clear_ratio * self._usual_px)
        sign = self._sign(off_px, limit_px)
        state.show(index, sign)
        if not sign and state.since is None:
            self._learn(terms, rows, off_px)
        if state.to_report():
            text = (
                "the right pixels contradict the left ones since frame "
                f"{state.since}: their rows are off by {off_px:.1f} px more than before; the right "
                "camera has turned in its mount, or the pairs have become others; going on with "
                "the left pixels"
            )
            self._found.append(begun(_CODE, index, text, state.since, figures={"rows_px": off_px}))
        if state.ends():
            self._found.append(
                ended(_CODE, index, "the right pixels agree with the left ones again")
            )
        if state.since is not None:
            return without_right(seen)
        return self._without_wrong(seen, distance_px)

    def _without_wrong(self, seen: Observations, distance_px: FloatArray) -> Observations:
        """Return features without right pixels that are far off the field by themselves.

        Args:
            seen: of a frame.
            distance_px: (N,) of the rows of those with a right pixel from the field.
        """
        limit_px = max(_ROWS.min_wrong_px, _ROWS.wrong_ratio * self._usual_px)
        wrong = distance_px > limit_px
        if not wrong.any():
            return seen
        dropped = np.zeros(len(seen), dtype=np.bool_)
        dropped[seen.has_right] = wrong
        return without_right(seen, dropped)

    def _sign(self, off_px: float, limit_px: float) -> bool | None:
        if self._frames < _ROWS.min_frames:
            return None
        if off_px > limit_px:
            return True
        return False if off_px <= _ROWS.agreeing_ratio * limit_px else None

    def _terms(self, z: FloatArray) -> FloatArray:
        """The terms (N, 6) of the field at left pixels of `z` (N, 4)."""
        x = (z[:, 0] - self._camera.cu) / self._camera.fu
        y = (z[:, 1] - self._camera.cv) / self._camera.fv
        return np.array([np.ones(len(x)), x, y, x * y, x * x, y * y]).T.copy()

    def _learn(self, terms: FloatArray, rows: FloatArray, off_px: float) -> None:
        self._normal *= _ROWS.memory
        self._moment *= _ROWS.memory
        add_equations(terms, rows, self._field, ROW_SIGMA_PX, self._normal, self._moment)
        self._field = self._moment.copy()
        solve_positive(self._normal + 1e-6 * np.eye(_TERMS), self._field)
        self._frames += 1
        gain = max(_ROWS.usual_gain, 1.0 / self._frames)
        self._usual_px += gain * (off_px - self._usual_px)
