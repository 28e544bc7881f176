"""Choice of a lens model by cross-validation.

Each model is fitted to every other view and judged on the rest, where only the poses of the board
are free. The first model that is no worse than the best one by more than a standard error of
their difference is chosen. Where further ones are no worse, how far they are from it over the image
is part of the result: there the views do not tell what the lens is.
Reference: Hastie, Tibshirani & Friedman, The elements of statistical learning (2009), section 7.10,
for the rule of one standard error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel, DistortionModel
from vio.geometry.lenses import registry
from vio.geometry.lie import FloatArray
from vio.records import IntArray
from vio.targets.bundle import Adjusted, BoardAdjustment, RigFit
from vio.targets.start import one_camera, pose_only, spread_views
from vio.targets.verdict import projection_difference
from vio.targets.views import Sightings

# Models and numbers of coefficients, in the order in which they are preferred.
LENSES: dict[str, tuple[DistortionModel, int]] = {
    choice.name: (model.name, choice.count)
    for choice, model in sorted(
        ((choice, model) for model in registry.LENSES.values() for choice in model.choices),
        key=lambda pair: pair[0].rank,
    )
}


class _ChoiceRules(NamedTuple):
    """How a lens model is chosen."""

    views: int = 16  # that are used for the choice, and every other corner of them
    # times the least residual, beyond which a model is not judged further
    hopeless_ratio: float = 3.0
    rivals: int = 2  # models that are compared with the chosen one
    # times the median of the residuals, beyond which a corner counts as so far off
    cap_ratio: float = 3.0


_CHOICE = _ChoiceRules()


@dataclass(frozen=True, slots=True)
class LensScore:
    """How a lens model explains views that it was not fitted to."""

    name: str
    rms_px: float  # of corners of the views left out
    by_view: FloatArray  # (V,) mean squared residual, px^2


@dataclass(frozen=True, slots=True)
class LensChoice:
    """A lens model, and what it was chosen from."""

    name: str  # a key of `LENSES`
    scores: tuple[LensScore, ...]  # of all models that fit
    equal: tuple[str, ...]  # further models that are no worse by more than a standard error


@dataclass(frozen=True, slots=True)
class Rival:
    """Another lens model that explains the views as well."""

    name: str
    off_px: FloatArray  # (G,) its distance from the chosen one over the image, see `pixel_grid`


def choose_lens(seen: Sightings, size: tuple[int, int]) -> LensChoice:
    """Choose the lens model of one camera.

    All models are compared by a part of the corners; those that are no worse there, by all.

    Args:
        seen: corners in the images of one camera.
        size: width and height of the images, pixels.

    Raises:
        CalibrationError: no model fits.
    """
    few = seen.of_views(spread_views(seen.views, _CHOICE.views))
    few = few.take(np.arange(0, len(few.uv), 2))
    scores = _scores(few, size, list(LENSES))
    if not scores:
        raise CalibrationError(
            "no lens model explains the corners of the board; check that the target file is that "
            "of the board in the images"
        )
    equal = _no_worse(scores)
    if len(equal) > 1:
        finer = {score.name: score for score in _scores(seen, size, equal)}
        if finer:
            equal = _no_worse(list(finer.values()))
            scores = [finer.get(score.name, score) for score in scores]
    return LensChoice(equal[0], tuple(scores), tuple(equal[1:]))


def _scores(seen: Sightings, size: tuple[int, int], names: Sequence[str]) -> list[LensScore]:
    """Return the scores of those models that fit, in the order of preference."""
    least_px = np.inf
    scores: list[LensScore] = []
    for name in names:
        model, count = LENSES[name]
        try:
            whole = one_camera(seen, size, model, count)
            least_px = min(least_px, float(whole.sigma_px[0]))
            if whole.sigma_px[0] < _CHOICE.hopeless_ratio * least_px:
                scores.append(_score(name, seen, whole))
        except (CalibrationError, np.linalg.LinAlgError):
            continue
    return scores


def _no_worse(scores: Sequence[LensScore]) -> list[str]:
    """Return the names of models no worse than the best by a standard error, in their order."""
    best = min(scores, key=lambda score: score.rms_px)
    out: list[str] = []
    for score in scores:
        worse = score.by_view - best.by_view
        error = float(worse.std(ddof=1) / np.sqrt(len(worse)))
        if float(worse.mean()) <= error:
            out.append(score.name)
    return out


def rivals_of(
    choice: LensChoice, camera: CameraModel, seen: Sightings, size: tuple[int, int]
) -> tuple[Rival, ...]:
    """Return how far models that the views do not tell from the chosen one are from it.

    Args:
        choice: of the model.
        camera: as calibrated with it.
        seen: corners in its images.
        size: width and height of the images, pixels.
    """
    out: list[Rival] = []
    for name in choice.equal[: _CHOICE.rivals]:
        model, count = LENSES[name]
        try:
            other = one_camera(seen, size, model, count).at.cameras[0]
        except (CalibrationError, np.linalg.LinAlgError):
            continue
        out.append(Rival(name, projection_difference(camera, other)))
    return tuple(out)


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
    squared = np.minimum(squared, _CHOICE.cap_ratio**2 * np.median(squared))
    view = seen.of_views(views).view
    total = np.bincount(view, squared, minlength=len(views))
    return np.asarray(total / np.maximum(np.bincount(view, minlength=len(views)), 1))
