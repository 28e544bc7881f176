"""Whether what is estimated of the stereo calibration moves further than its covariance allows.

Errors of a calibration are constants to the filter, but for a slow walk. An estimate of a constant
changes by no more than its standard deviation was before: the change from one frame to a later one
has the covariance that the estimate has lost between them. One that moves further shows that
something else is in the pixels: a mount that gives, a lens that slides or breathes, another
rectification, or errors of pixels that images share and the filter does not know of. Whatever it
is, disparities were off by as much meanwhile, and so was the length of the motion.

With the change `x` (8,) of the coefficients of (R3) in docs/math.md, `P` their covariance before,
and `D` (N, 8) what they do to the disparities `d` (N,) of the features seen, lengths are off by the
share `s = g' x`, `g = D' d / d' d`, by least squares: its part beyond `_DRIFT.sigmas` of its
standard deviation `(g' P g)^1/2` is in doubt. So is the present standard deviation times as much as
the change as a whole, `x' P^-1 x`, is beyond its quantile: other terms that move say that the
covariance is too small.

Before motion has told much of the calibration, an estimate that moves is one whose prior was off,
which is another matter: then nothing is concluded. Nor is it across a new start of the filter,
which gives up what was known.
Reference for the change of an estimate: Hausman, Specification tests in econometrics, Econometrica
(1978).
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from vio.cameras.rectification_error import ErrorColumns
from vio.dataclass import dataclass
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.numerics.statistics import chi_square_quantile, squared_distance
from vio.records import FIELD_TERMS, Estimate, Observations


class _DriftRules(NamedTuple):
    """When estimates of constants move."""

    # Frames from the earlier estimate to the present one: a knock shows within the first, a sag of
    # seconds over the last.
    spans: tuple[int, ...] = (10, 20, 40)
    # Standard deviations that a change is usual up to. The largest of healthy rooms is 3; where
    # scenes are far, 9, and real lenses, which no polynomial describes, come to 7.6 of small ones.
    sigmas: float = 3.0
    # standard deviation of the share over the first one, up to which an estimate is known
    known_share: float = 0.5
    min_disparity_px: float = 1.0  # of a feature whose disparity tells a length
    min_features: int = 10


_DRIFT = _DriftRules()
_LIMIT = float(chi_square_quantile(0.999, FIELD_TERMS))


@dataclass(frozen=True, slots=True)
class ScaleDrift:
    """That lengths were measured with a calibration that moves."""

    share: float  # of them, that they may be off by, as a standard deviation; 0: by no more than stated
    frames: int  # since the calibration was another one


@dataclass(frozen=True, slots=True)
class _Known:
    """What was known of the field of right columns after a frame."""

    coefficients: FloatArray  # (8,) in focal lengths
    covariance: FloatArray  # (8, 8)


class CalibrationDrift:
    """Compares what is known of the stereo calibration with what was known some frames ago."""

    def __init__(self, camera: StereoCamera) -> None:
        self._columns = ErrorColumns(camera, np.arange(FIELD_TERMS))
        self._first: FloatArray | None = None  # covariance (8, 8) before anything was learned
        # after the last frames; None: it was not estimated
        self._known = deque[_Known | None](maxlen=max(_DRIFT.spans) + 1)

    def frame(self, seen: Observations, estimate: Estimate) -> ScaleDrift:
        """Return by how much lengths are in doubt after a frame that showed some features."""
        field = estimate.stereo_field
        now = None if field is None else _Known(field.coefficients, field.covariance)
        self._known.append(now)
        by_field = None if now is None else self._scale_by_field(seen)
        if now is None or by_field is None:
            return ScaleDrift(0.0, 0)
        if self._first is None:
            self._first = now.covariance
        most = _DRIFT.known_share**2 * float(by_field @ self._first @ by_field)
        drifts = [ScaleDrift(0.0, 0)]
        for span in _DRIFT.spans:
            before = self._known[-1 - span] if len(self._known) > span else None
            if before is not None and by_field @ before.covariance @ by_field < most:
                drifts.append(ScaleDrift(_doubted(before, now, by_field), span))
        return max(drifts, key=lambda drift: drift.share)

    def begin_anew(self) -> None:
        """Forget earlier estimates: the filter was started again, and knows less than before."""
        self._known.clear()

    def _scale_by_field(self, seen: Observations) -> FloatArray | None:
        """The share (8,) of lengths by one unit of each coefficient; None: too few features tell."""
        z = seen.z[seen.has_right]
        z = z[z[:, 0] - z[:, 2] > _DRIFT.min_disparity_px]
        if len(z) < _DRIFT.min_features:
            return None
        J = self._columns.jacobian(z)
        disparity = z[:, 0] - z[:, 2]
        return np.asarray(disparity @ (J[:, 0] - J[:, 2]) / (disparity @ disparity))


def _doubted(before: _Known, now: _Known, by_field: FloatArray) -> float:
    """The share of lengths that is in doubt by a change, `by_field` (8,) being their share by one
    unit of each coefficient.
    """
    change = now.coefficients - before.coefficients
    variance = float(by_field @ before.covariance @ by_field)
    beyond = float(by_field @ change) ** 2 - _DRIFT.sigmas**2 * variance
    # NaN, which exceeds nothing, where a back end holds terms constant
    squared = squared_distance(change, before.covariance, 0.0)
    enlarged = (squared / _LIMIT - 1.0) * float(by_field @ now.covariance @ by_field)
    return float(np.sqrt(max(0.0, beyond, enlarged)))
