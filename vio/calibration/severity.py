"""How much it matters that a stereo calibration is off: one grade and one wording for all commands.

Rows of left and right show that a calibration is off, but cost little themselves, as a row is no
depth. Disparities that are off cost lengths: a point at disparity d is taken to be nearer by the
share off / d. Rows do not tell what disparities are off by (a camera that turned about the vertical
axis shows in disparities alone); motion does.
"""

from __future__ import annotations

import math
from typing import Literal, TypeAlias, get_args

from vio.dataclass import dataclass

Grade: TypeAlias = Literal["negligible", "worth calibrating", "unusable"]


@dataclass(frozen=True, slots=True)
class _SeverityRules:
    """What an error of the calibration costs."""

    # Rows, root mean square. Good calibrations leave less than the first; with the second, matching
    # along rows fails.
    negligible_rows_px: float = 0.15
    unusable_rows_px: float = 2.0
    # Lengths, per cent. Less than the first is below the drift of images alone on a road; a
    # tenth is no measurement.
    negligible_length: float = 0.2
    unusable_length: float = 10.0
    sigmas: float = 3.0  # standard deviations of doubt


_SEVERITY = _SeverityRules()


@dataclass(frozen=True, slots=True)
class StereoError:
    """What a stereo calibration is off by."""

    rows_px: float  # root mean square of the smooth part of vl - vr
    seen_px: float  # median disparity of the features; 0: not known
    # by which disparities are too large in the middle; None: not known
    disparity_px: float | None = None
    disparity_sigma_px: float | None = None

    @property
    def length_percent(self) -> float | None:
        """By what share lengths come out wrong if nothing corrects it, %; None: not known."""
        if self.disparity_px is None or self.seen_px <= 0:
            return None
        return 100 * abs(self.disparity_px) / self.seen_px

    @property
    def grade(self) -> Grade:
        """What to do about it; of the disparities, by what they are off beyond doubt."""
        if self.seen_px < 0:
            return "unusable"
        certain = 0.0
        if self.disparity_px is not None and self.seen_px > 0:
            doubt = _SEVERITY.sigmas * (self.disparity_sigma_px or 0.0)
            certain = 100 * max(abs(self.disparity_px) - doubt, 0.0) / self.seen_px
        return max(rows_grade(self.rows_px), length_grade(certain), key=get_args(Grade).index)

    def __str__(self) -> str:
        text = f"{self.grade}: rows off by {self.rows_px:.2f} px (rms)"
        if self.seen_px < 0:
            return f"{text}, most disparities are negative"
        if self.disparity_px is None or self.length_percent is None:
            return text
        sigma_px = ""
        percent = _short(self.length_percent)
        if self.disparity_sigma_px is not None:
            sigma_px = f" ± {self.disparity_sigma_px:.2f}"
            sigma_percent = 100 * self.disparity_sigma_px / self.seen_px
            decimals = max(1 - math.floor(math.log10(max(sigma_percent, 1e-3))), 0)
            percent = f"{self.length_percent:.{decimals}f} ± {sigma_percent:.{decimals}f}"
        disparities = f"disparities by {self.disparity_px:+.2f}{sigma_px} px"
        return f"{text}, {disparities}, and so lengths by {percent} %"


def rows_grade(rows_px: float) -> Grade:
    """Grade rows that are off (root mean square, pixels)."""
    return _graded(rows_px, _SEVERITY.negligible_rows_px, _SEVERITY.unusable_rows_px)


def length_grade(percent: float) -> Grade:
    """Grade the share by which lengths come out wrong, %."""
    return _graded(percent, _SEVERITY.negligible_length, _SEVERITY.unusable_length)


def _graded(size: float, negligible: float, unusable: float) -> Grade:
    return (
        "negligible"
        if size <= negligible
        else "unusable"
        if size > unusable
        else "worth calibrating"
    )


def _short(value: float) -> str:
    """Write two significant digits without an exponent."""
    return f"{float(f'{value:.2g}'):g}"
