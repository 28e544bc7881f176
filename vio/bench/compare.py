"""What became better or worse from one bench, configuration or system to another: effect sizes,
intervals, tests.

Runs are paired by sequence and seed. Of each figure the logarithm of the ratio B / A is averaged
over the seeds of a sequence, where pairs of runs that are equal count once. Where each seed has a
render of its own, each is a case of its own. Over the cases, Student's t gives the interval of the
mean and the test: under the hypothesis of no change A and B are exchangeable, so the differences
are symmetric about zero, and tails that are heavier than normal make the test conservative. ATE is
the primary figure; the p-values of the others are adjusted together.

Reference: Holm, A simple sequentially rejective multiple test procedure, Scand. J. Statist. 6
(1979).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.bench.bench import read_bench
from vio.bench.tables import METRICS, Metric, Outcome, number
from vio.errors import EvaluationError

Verdict: TypeAlias = Literal["better", "worse", "not worse", "cannot tell"]
# chance of calling the primary figure changed when nothing has; the same for all others together
LEVEL = 0.05
# 2 is wrong usage
EXIT_STATUS: Mapping[Verdict, int] = {"better": 0, "not worse": 0, "worse": 1, "cannot tell": 3}
_PRIMARY = METRICS[0]
_JUDGED = ("ate_m", "rpe_m", "drift_percent", "drift_deg_per_100m", "coverage")
# Reported, but no regression: times depend on the machine, the others say why the judged figures
# changed.
_NOT_JUDGED = ("ate_sim3_m", "refused_share", "cpu_ms", "memory_mib")
_MIN_CHANGE = 0.01  # a mean change below is none, however certain
# Below this, in the unit of the figure, two values are the same: ATE of 0.01 mm is that of a
# recording at rest.
FLOOR = 1e-5

_RunKey: TypeAlias = tuple[str, str, int]  # sequence, system, seed
_Pair: TypeAlias = tuple[Outcome, Outcome]


@dataclass(frozen=True, slots=True)
class Effect:
    """The geometric mean of B / A over n independent cases."""

    n: int
    ratio: float
    low: float | None  # of the 95 % interval; None: one case has none
    high: float | None
    p: float  # two-sided, of no change


@dataclass(frozen=True, slots=True)
class Change:
    """One figure of one configuration, over all sequences that both sides have."""

    system: str
    metric: str
    effect: Effect
    # by Holm: the primary figure over the configurations, the others over all of them
    p_adjusted: float
    verdict: Verdict

    @property
    def is_judged(self) -> bool:
        """Whether a worse figure is a regression."""
        return self.metric in _JUDGED


@dataclass(frozen=True, slots=True)
class SequenceChange:
    """One sequence whose ATE changed by more than a factor."""

    sequence: str
    system: str
    before: float  # median over the seeds
    after: float
    effect: Effect  # over the seeds that differ
    verdict: Verdict  # by a test over the seeds


@dataclass(frozen=True, slots=True)
class Comparison:
    """All that differs between two sides."""

    changes: tuple[Change, ...]
    sequences: tuple[SequenceChange, ...]
    # sequence, system, why: had a result in A, and has none in B
    lost: tuple[tuple[str, str, str], ...]
    won: tuple[tuple[str, str], ...]
    only_in_one: int  # runs without a partner
    margin: float  # "not worse" is a change that is below this factor with 97.5 % confidence

    def _has_worse(self) -> bool:
        judged = [c.verdict for c in self.changes if c.is_judged]
        return "worse" in judged or any(s.verdict == "worse" for s in self.sequences)

    @property
    def verdict(self) -> Verdict:
        """Worse where anything judged is; else as the ATE says, over all sequences and of single
        ones.
        """
        if self.lost or self._has_worse():
            return "worse"
        if any(s.verdict == "cannot tell" and s.after > s.before for s in self.sequences):
            return "cannot tell"
        return _verdict_of([c.verdict for c in self.changes if c.metric == _PRIMARY.name])

    def as_dict(self) -> dict[str, Any]:
        """Return the comparison for JSON."""
        return {**asdict(self), "verdict": self.verdict}


def _verdict_of(verdicts: Sequence[Verdict]) -> Verdict:
    """Return the verdict of several systems' ATE, none of which is worse."""
    if not verdicts or "cannot tell" in verdicts:
        return "cannot tell"
    return "better" if "better" in verdicts else "not worse"


def compare(
    a: Path,
    b: Path,
    *,
    between: tuple[str, str] | None = None,
    factor: float = 2.0,
    margin: float = 1.1,
) -> Comparison:
    """Compare the results of two output folders, or two systems of them.

    Args:
        a: before.
        b: after; the same folder where two of its systems are compared.
        between: the system of A and the system of B, each a configuration or another system's name;
            None: each configuration of A with that of the same name of B.
        factor: by which the ATE of a single sequence must change to be shown.
        margin: a change below this factor counts as none where the interval says so.

    Raises:
        VioError: a folder holds no bench, or the two sides have no run in common.
    """
    for name, value in (("--factor", factor), ("--margin", margin)):
        if not 1 < value < math.inf:
            raise EvaluationError(f"{name} must be above 1, got {value:g}")
    (before, facts) = read_bench(a)
    (after, _) = read_bench(b)
    what = f"{a} and {b}"
    if between is not None:
        before, after = _sides(before, after, between)
        what = f"{between[0]} of {a} and {between[1]} of {b}"
    drawn = facts.get("drawn_each_seed", ())
    return compare_outcomes(
        before, after, drawn_each_seed=drawn, factor=factor, margin=margin, what=what
    )


def _sides(
    a: Iterable[Outcome], b: Iterable[Outcome], between: tuple[str, str]
) -> tuple[tuple[Outcome, ...], tuple[Outcome, ...]]:
    """Return the runs of two systems under one name; a trajectory of another system stands for
    all seeds.
    """
    before = _runs_of(a, between[0], as_system=" to ".join(between))
    after = _runs_of(b, between[1], as_system=" to ".join(between))
    seeds = sorted({o.seed for o in before + after if o.seed is not None}) or [0]
    return _spread(before, seeds), _spread(after, seeds)


def _runs_of(outcomes: Iterable[Outcome], system: str, *, as_system: str) -> list[Outcome]:
    """Return the runs of a system under another name.

    Raises:
        EvaluationError: there is none.
    """
    known = tuple(outcomes)
    own = [replace(o, system=as_system) for o in known if o.system == system]
    if not own:
        names = ", ".join(dict.fromkeys(o.system for o in known))
        raise EvaluationError(f"--between {system}: there is no such system; choose of {names}")
    return own


def _spread(outcomes: Iterable[Outcome], seeds: Sequence[int]) -> tuple[Outcome, ...]:
    """Return the runs, with those that have no seed once for each seed."""
    return tuple(
        replace(o, seed=seed) for o in outcomes for seed in (seeds if o.seed is None else [o.seed])
    )


def compare_outcomes(
    a: Iterable[Outcome],
    b: Iterable[Outcome],
    *,
    drawn_each_seed: Collection[str] = (),
    factor: float = 2.0,
    margin: float = 1.1,
    what: str = "the two",
) -> Comparison:
    """Compare two lists of runs; `drawn_each_seed` are the sequences of which each seed has a
    render of its own.

    Raises:
        EvaluationError: they have no run in common.
    """
    before = _by_run(a)
    after = _by_run(b)
    pairs = _pairs_of(before, after, what)
    systems = list(dict.fromkeys(old.system for old, _ in pairs))
    changes = list[Change]()
    for names in ((_PRIMARY.name,), _JUDGED[1:], _NOT_JUDGED):
        changes += _tested(pairs, systems, names, drawn_each_seed, margin)
    fails_now = []
    failed_before = []
    for old, new in pairs:
        if _fails_first(new, old):
            fails_now.append((old.sequence, old.system, new.failure or ""))
        if _fails_first(old, new):
            failed_before.append((old.sequence, old.system))
    return Comparison(
        tuple(sorted(changes, key=lambda c: systems.index(c.system))),
        tuple(_sequence_changes(pairs, systems, factor)),
        tuple(fails_now),
        tuple(failed_before),
        len(before) + len(after) - 2 * len(pairs),
        margin,
    )


def _by_run(outcomes: Iterable[Outcome]) -> dict[_RunKey, Outcome]:
    """Return the runs, not the trajectories of others, by sequence, system and seed."""
    return {(o.sequence, o.system, o.seed): o for o in outcomes if o.seed is not None}


def _pairs_of(
    before: Mapping[_RunKey, Outcome], after: Mapping[_RunKey, Outcome], what: str
) -> list[_Pair]:
    """Return the runs that both have.

    Raises:
        EvaluationError: there is none.
    """
    pairs = [(old, after[key]) for key, old in before.items() if key in after]
    if not pairs:
        raise EvaluationError(
            f"{what} have no run of the same sequence, configuration and seed; compare one suite"
        )
    return pairs


def _tested(
    pairs: Sequence[_Pair],
    systems: Iterable[str],
    names: Collection[str],
    drawn_each_seed: Collection[str],
    margin: float,
) -> Iterator[Change]:
    """Yield the changes of a family of figures, tested together."""
    metrics = [metric for metric in METRICS if metric.name in names]
    tested = [
        (system, metric, effect)
        for system in systems
        for metric, effect in _effects(pairs, system, metrics, drawn_each_seed)
    ]
    adjusted = holm([effect.p for _, _, effect in tested])
    for (system, metric, effect), p in zip(tested, adjusted, strict=True):
        verdict = _verdict(effect, p, margin, metric.larger_is_better)
        yield Change(system, metric.name, effect, p, verdict)


def _fails_first(run: Outcome, other: Outcome) -> bool:
    """Whether a run failed, and the other did not."""
    return run.failure is not None and other.failure is None


def _effects(
    pairs: Sequence[_Pair],
    system: str,
    metrics: Iterable[Metric],
    drawn_each_seed: Collection[str],
) -> Iterator[tuple[Metric, Effect]]:
    """Yield the effects on a system's figures, of those that both sides have."""
    own = [pair for pair in pairs if pair[0].system == system]
    for metric in metrics:
        cases = _cases(own, metric, drawn_each_seed)
        if cases:
            yield metric, effect_of([float(np.mean(v)) for v in cases.values()])


def _cases(
    pairs: Sequence[_Pair], metric: Metric, drawn_each_seed: Collection[str] = ()
) -> dict[Any, list[float]]:
    """Return log ratios B / A by case, those of equal pairs of values once; above 0 B is larger."""
    found: dict[Any, set[tuple[float, float]]] = {}
    for old, new in pairs:
        x = old.value(metric)
        y = new.value(metric)
        if x is not None and y is not None:
            case: Any = old.sequence
            if old.sequence in drawn_each_seed:
                case = (old.sequence, old.seed)
            found.setdefault(case, set()).add((max(x, FLOOR), max(y, FLOOR)))
    logs = {}
    for case, values in found.items():
        logs[case] = [math.log(y / x) for x, y in sorted(values)]
    return logs


def effect_of(logs: npt.ArrayLike) -> Effect:
    """Return the effect of log ratios (N,), one of each independent case."""
    from scipy import stats

    d = np.asarray(logs, dtype=np.float64)
    ratio = math.exp(float(d.mean()))
    n = len(d)
    if not d.any():
        return Effect(n, 1.0, 1.0, 1.0, 1.0)
    if n == 1:
        return Effect(n, ratio, None, None, 1.0)
    if np.ptp(d) < 1e-12:  # the same factor in each
        return Effect(n, ratio, ratio, ratio, 0.0)
    test = stats.ttest_1samp(d, 0.0)
    interval = test.confidence_interval(1 - LEVEL)
    return Effect(
        n, ratio, math.exp(float(interval.low)), math.exp(float(interval.high)), float(test.pvalue)
    )


def holm(p: Sequence[float]) -> list[float]:
    """Return p-values adjusted for their number: below a level with at most its probability if
    nothing has changed.
    """
    adjusted = [0.0] * len(p)
    largest = 0.0
    for rank, k in enumerate(sorted(range(len(p)), key=lambda k: p[k])):
        largest = max(largest, min(1.0, (len(p) - rank) * p[k]))
        adjusted[k] = largest
    return adjusted


def _verdict(effect: Effect, p: float, margin: float, larger_is_better: bool = False) -> Verdict:
    change = math.log(effect.ratio) * (-1 if larger_is_better else 1)
    if p <= LEVEL and abs(change) >= math.log1p(_MIN_CHANGE):
        return "worse" if change > 0 else "better"
    if effect.low is None or effect.high is None:
        return "cannot tell"
    worst = 1 / effect.low if larger_is_better else effect.high
    return "not worse" if worst <= margin else "cannot tell"


def _sequence_changes(
    pairs: Sequence[_Pair], systems: Sequence[str], factor: float
) -> Iterator[SequenceChange]:
    """Yield sequences whose ATE changed by more than the factor, with what a test over their
    seeds says.
    """
    tested = list(_effects_on_primary(pairs, systems))
    adjusted = holm([effect.p for _, _, effect in tested])
    for (system, name, effect), p in zip(tested, adjusted, strict=True):
        if abs(math.log(effect.ratio)) <= math.log(factor):
            continue
        both = [pair for pair in pairs if (pair[0].sequence, pair[0].system) == (name, system)]
        before = _median_primary(old for old, _ in both)
        after = _median_primary(new for _, new in both)
        verdict: Verdict = "worse" if effect.ratio > 1 else "better"
        if p > LEVEL:
            verdict = "cannot tell"
        yield SequenceChange(name, system, before, after, effect, verdict)


def _effects_on_primary(
    pairs: Sequence[_Pair], systems: Sequence[str]
) -> Iterator[tuple[str, str, Effect]]:
    """Yield system, sequence and the effect on the figure that decides."""
    for system in systems:
        own = [p for p in pairs if p[0].system == system]
        for name, logs in _cases(own, _PRIMARY).items():
            yield system, name, effect_of(logs)


def _median_primary(outcomes: Iterable[Outcome]) -> float:
    """Return the median of the figure that decides, over the runs that have it."""
    return float(np.median([v for o in outcomes if (v := o.value(_PRIMARY)) is not None]))


def comparison_lines(result: Comparison) -> Iterator[str]:
    """Yield a comparison as text: figures over all sequences, then single sequences, then what
    was lost.
    """
    titles = {metric.name: metric.title for metric in METRICS}
    width = 16
    if result.changes:
        width = max(16, *(len(c.system) for c in result.changes))
    head = f"{'configuration':<{width}} {'figure':<14} {'B / A':>8}  {'95 % interval':<18} "
    yield f"{head} {'n':>3} {'p (Holm)':>9}  verdict"
    for c in result.changes:
        verdict: str = c.verdict
        if not c.is_judged:
            verdict = f"({verdict}, not judged)"
        ratio = number(c.effect.ratio, 4)
        interval = _interval(c.effect)
        head = f"{c.system:<{width}} {titles[c.metric]:<14} {ratio:>8}"
        yield f"{head}  {interval:<18} {c.effect.n:>3} {c.p_adjusted:>9.4f}  {verdict}"
    for s in result.sequences:
        values = f"ATE {number(s.before, 3)} to {number(s.after, 3)} m"
        by = f"B / A {number(s.effect.ratio, 3)}, {_interval(s.effect)} over n = {s.effect.n} different seeds"
        yield f"{s.sequence}, {s.system}: {values} ({by}): {s.verdict}"
    yield from (
        f"{sequence}, {system}: worse, no result any more: {why}"
        for sequence, system, why in result.lost
    )
    yield from (
        f"{sequence}, {system}: better, has a result now" for sequence, system in result.won
    )
    if result.only_in_one:
        yield f"{result.only_in_one} runs are in one of the two only and were not compared"
    share = number(100 * (result.margin - 1), 3)
    yield {
        "worse": "worse",
        "better": "better",
        "not worse": f"not worse by {share} % or more",
        "cannot tell": f"cannot tell whether it is worse by {share} % or more: more sequences or "
        "seeds are needed",
    }[result.verdict]


def _interval(effect: Effect) -> str:
    if effect.low is None or effect.high is None:
        return "no interval"
    return f"{number(effect.low, 3)} to {number(effect.high, 3)}"
