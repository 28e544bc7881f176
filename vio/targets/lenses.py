"""Choice of a lens model by cross-validation.

Each model is fitted to every other view and judged on the rest, where only the poses of the board
are free. The first model that is no worse than the best one by more than a standard error of
their difference is chosen.
Reference: Hastie, Tibshirani & Friedman, The elements of statistical learning (2009), section 7.10,
for the rule of one standard error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vio.errors import CalibrationError
from vio.geometry.distortion import DistortionModel
from vio.geometry.lenses import registry
from vio.geometry.lie import FloatArray
from vio.records import IntArray
from vio.targets.bundle import Adjusted, BoardAdjustment, RigFit
from vio.targets.start import one_camera, pose_only, spread_views
from vio.targets.views import Sightings

# Models and numbers of coefficients, in the order in which they are preferred.
LENSES: dict[str, tuple[DistortionModel, int]] = {
    choice.name: (model.name, choice.count)
    for choice, model in sorted(
        ((choice, model) for model in registry.LENSES.values() for choice in model.choices),
        key=lambda pair: pair[0].rank,
    )
}
_VIEWS = 16  # that are used for the choice, and every other corner of them
_HOPELESS = 3.0  # times the least residual, beyond which a model is not judged further
_CAP = 3.0  # times the median of the residuals, beyond which a corner counts as so far off


@dataclass(frozen=True, slots=True)
class LensScore:
    """How a lens model explains views that it was not fitted to."""

    name: str
    rms_px: float  # of corners of the views left out
    by_view: FloatArray  # (V,) mean squared residual, px^2


def choose_lens(seen: Sightings, size: tuple[int, int]) -> tuple[str, list[LensScore]]:
    """Return the name of the lens model of one camera, and the scores of all that fit.

    Args:
        seen: corners in the images of one camera.
        size: width and height of the images, pixels.

    Raises:
        CalibrationError: no model fits.
    """
    few = seen.of_views(spread_views(seen.views, _VIEWS))
    few = few.take(np.arange(0, len(few.uv), 2))
    least_px = np.inf
    scores: list[LensScore] = []
    for name, (model, count) in LENSES.items():
        try:
            whole = one_camera(few, size, model, count)
            least_px = min(least_px, float(whole.sigma_px[0]))
            if whole.sigma_px[0] < _HOPELESS * least_px:
                scores.append(_score(name, few, whole))
        except (CalibrationError, np.linalg.LinAlgError):
            continue
    if not scores:
        raise CalibrationError(
            "no lens model explains the corners of the board; check that the target file is that "
            "of the board in the images"
        )
    best = min(scores, key=lambda score: score.rms_px)
    for score in scores:
        worse = score.by_view - best.by_view
        error = float(worse.std(ddof=1) / np.sqrt(len(worse)))
        if float(worse.mean()) <= error:
            return score.name, scores
    return best.name, scores


def _score(name: str, seen: Sightings, whole: Adjusted) -> LensScore:
    by_view = np.zeros(seen.views)
    for part in (0, 1):
        fitted = np.arange(1 - part, seen.views, 2)
        left_out = np.arange(part, seen.views, 2)
        start = replace(whole.at, T_cam0_board=whole.at.T_cam0_board[fitted])
        fit = BoardAdjustment(seen.of_views(fitted)).solve(start).at
        by_view[left_out] = _squared(_residuals_of(fit, seen, left_out), seen, left_out)
    return LensScore(name, float(np.sqrt(by_view.mean())), by_view)


def _residuals_of(fit: RigFit, seen: Sightings, views: IntArray) -> FloatArray:
    """Return residuals (R, 2) of some views whose poses alone are adjusted."""
    return pose_only(fit, seen.of_views(views))[1].residuals_px


def _squared(r: FloatArray, seen: Sightings, views: IntArray) -> FloatArray:
    """Mean squared residual (C,) of a coordinate in each view, far ones capped."""
    squared = 0.5 * np.sum(r**2, axis=1)
    squared = np.minimum(squared, _CAP**2 * np.median(squared))
    view = seen.of_views(views).view
    total = np.bincount(view, squared, minlength=len(views))
    return np.asarray(total / np.maximum(np.bincount(view, minlength=len(views)), 1))
