"""Cross-validation of settings: chosen on one half of the rigs, judged on the other, both ways.

A setting that wins on the recordings it was chosen on has learned them in part. Rigs are the units,
as drives of one rig share their faults; a sequence that names none is a rig of its own. Of each half
the configuration with the smallest geometric mean ATE is chosen, each rig counting once, and what
it is worth is its mean on the other half, over the first configuration's.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import numpy as np

from vio.bench.compare import FLOOR
from vio.bench.tables import METRICS, Outcome, number
from vio.errors import EvaluationError
from vio.numerics.kinds import Capacity

_ATE = METRICS[0]
_MAX_SPLITS: Capacity[int] = 2000
_LogRatios = Mapping[str, Mapping[str, float]]  # over the first configuration's, by system and rig


@dataclass(frozen=True, slots=True)
class Fold:
    """One half of the rigs to choose on, and the other to judge on."""

    chosen_on: tuple[str, ...]  # rigs
    judged_on: tuple[str, ...]
    winner: str  # configuration
    ratio_chosen: float  # its mean ATE over the first configuration's, where it was chosen
    ratio_judged: float  # and where it was not


@dataclass(frozen=True, slots=True)
class CrossValidation:
    """Both ways of one split, and how it goes over all splits."""

    baseline: str  # the first configuration
    folds: tuple[Fold, Fold]
    splits: int  # of the rigs into halves, each both ways: folds; all, or 2000 that are drawn
    # share of these folds whose winner is better than the baseline where it is judged
    better: float
    ratio_judged: float  # geometric mean over all folds

    @property
    def wins(self) -> bool:
        """Whether both ways choose a configuration that is better where it was not chosen."""
        return all(f.winner != self.baseline and f.ratio_judged < 1 for f in self.folds)

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for JSON."""
        return {**asdict(self), "wins": self.wins}


def cross_validate(outcomes: Iterable[Outcome]) -> CrossValidation:
    """Choose a configuration on one half of the rigs and judge it on the other.

    The split shown takes every second rig, in the suite's order.

    Args:
        outcomes: runs of one suite; the first one's configuration is the baseline.

    Raises:
        EvaluationError: there are fewer than two configurations, or fewer than four rigs with an ATE
            under all of them; or a run has no result where the baseline has one.
    """
    runs = [o for o in outcomes if o.seed is not None]
    systems = list(dict.fromkeys(o.system for o in runs))
    if len(systems) < 2:
        raise EvaluationError("--folds compares configurations: the suite needs two or more")
    _check_complete(runs)
    ratios = _log_ratios(runs, systems)
    rigs = list(ratios[systems[0]])
    if len(rigs) < 4:
        raise EvaluationError(
            f"--folds needs four rigs or more with ground truth, got {len(rigs)}; name those of "
            "the suite's sequences with rig:"
        )
    shown = _both_ways(ratios, tuple(rigs[::2]), tuple(rigs[1::2]))
    folds = [fold for half, rest in _splits(rigs) for fold in _both_ways(ratios, half, rest)]
    judged = [math.log(fold.ratio_judged) for fold in folds]
    return CrossValidation(
        systems[0],
        shown,
        len(folds) // 2,
        float(np.mean([value < 0 for value in judged])),
        math.exp(float(np.mean(judged))),
    )


def _check_complete(runs: Iterable[Outcome]) -> None:
    """Raise EvaluationError where a run has no result."""
    lost = [f"{o.sequence}, {o.system}" for o in runs if o.failure is not None]
    if lost:
        raise EvaluationError(f"--folds needs a result of every run; without: {', '.join(lost)}")


def _log_ratios(runs: Sequence[Outcome], systems: Sequence[str]) -> _LogRatios:
    """Return mean logarithms of ATE over that of the first configuration, by configuration and rig."""
    ate: dict[str, dict[str, dict[tuple[str, int | None], float]]] = {}
    for run in runs:
        value = run.value(_ATE)
        if value is not None:
            rig = run.rig or run.sequence
            by_rig = ate.setdefault(rig, {}).setdefault(run.system, {})
            by_rig[run.sequence, run.seed] = math.log(max(value, FLOOR))
    out: dict[str, dict[str, float]] = {system: {} for system in systems}
    for rig, by_system in ate.items():
        if len(by_system) < len(systems):
            continue
        before = by_system[systems[0]]
        for system in systems:
            after = by_system[system]
            changes = [after[k] - before[k] for k in before if k in after]
            out[system][rig] = float(np.mean(changes))
    return out


def _splits(rigs: Sequence[str]) -> Iterator[tuple[tuple[str, ...], tuple[str, ...]]]:
    """Yield the splits into halves, each once; of more than `_MAX_SPLITS` so many, drawn. Of an odd
    number one half is larger by one.
    """
    first, *others = rigs
    sizes = sorted({len(rigs) // 2, len(rigs) - len(rigs) // 2})
    halves: Iterable[tuple[str, ...]]
    if sum(math.comb(len(others), size - 1) for size in sizes) <= _MAX_SPLITS:
        halves = ((first, *rest) for size in sizes for rest in combinations(others, size - 1))
    else:
        halves = _drawn_halves(rigs)
    for half in halves:
        yield half, tuple(rig for rig in rigs if rig not in half)


def _drawn_halves(rigs: Sequence[str]) -> list[tuple[str, ...]]:
    """Return `_MAX_SPLITS` halves of rigs, no two of which are of one split."""
    rng = np.random.default_rng(0)
    drawn: dict[frozenset[int], tuple[str, ...]] = {}
    while len(drawn) < _MAX_SPLITS:
        order = rng.permutation(len(rigs)).tolist()
        half = order[: len(rigs) // 2]
        has_first = half if 0 in half else order[len(half) :]
        drawn.setdefault(frozenset(has_first), tuple(rigs[k] for k in sorted(half)))
    return list(drawn.values())


def _both_ways(
    ratios: _LogRatios, half: tuple[str, ...], rest: tuple[str, ...]
) -> tuple[Fold, Fold]:
    return _fold(ratios, half, rest), _fold(ratios, rest, half)


def _fold(ratios: _LogRatios, chosen_on: tuple[str, ...], judged_on: tuple[str, ...]) -> Fold:
    """Choose on some rigs; of equals, the earliest configuration."""

    def mean(system: str, rigs: Sequence[str]) -> float:
        return float(np.mean([ratios[system][rig] for rig in rigs]))

    winner = min(ratios, key=lambda system: mean(system, chosen_on))
    return Fold(
        chosen_on,
        judged_on,
        winner,
        math.exp(mean(winner, chosen_on)),
        math.exp(mean(winner, judged_on)),
    )


def fold_lines(result: CrossValidation) -> Iterator[str]:
    """Yield a cross-validation as a Markdown table and a sentence."""
    yield "| chosen on | wins there | its ATE there | judged on | its ATE there |"
    yield "|---|---|---:|---|---:|"
    for fold in result.folds:
        halves = (", ".join(fold.chosen_on), ", ".join(fold.judged_on))
        chosen = number(fold.ratio_chosen, 3)
        judged = number(fold.ratio_judged, 3)
        yield f"| {halves[0]} | {fold.winner} | {chosen} | {halves[1]} | {judged} |"
    yield ""
    share = number(100 * result.better, 3)
    mean = number(result.ratio_judged, 3)
    verdict = "wins both ways" if result.wins else "does not win both ways"
    yield (
        f"ATE over that of {result.baseline}, geometric mean over rigs: the choice {verdict}. "
        f"Over {result.splits} splits into halves it is better where it was not chosen in "
        f"{share} % of the cases, {mean} in the mean."
    )
