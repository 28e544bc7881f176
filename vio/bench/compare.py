"""What became better or worse from one bench to another, beyond chance: paired by sequence and seed.

Of each figure the logarithm of the ratio B / A is taken for every pair and averaged over the seeds of a sequence. Over
the sequences, the change is beyond chance where two independent tests of the same numbers agree: the bootstrap's
interval of the mean excludes no change, and the change is one of the few most extreme among all flips of signs. The
level is divided by the number of tests (Bonferroni). Single sequences are judged by the spread over their seeds, and
without seeds by a factor.

Reference: Efron & Tibshirani, An Introduction to the Bootstrap (1993), chapters 13 and 15.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vio.bench.bench import read_bench
from vio.bench.tables import METRICS, Metric, Outcome, number
from vio.errors import EvaluationError
from vio.geometry.lie import FloatArray

Verdict = Literal["better", "worse", "no change beyond chance", "too few sequences to say", "identical"]
LEVEL = 0.05  # chance of calling anything better or worse when nothing has changed
_RESAMPLES = 10_000
_MANY = 1000  # sequences; beyond, the mean is normal, and its interval needs fewer resamples
_EXACT_FLIPS = 14  # up to so many sequences all flips of signs are counted, beyond a sample of them
_COMPARED = ("ate_m", "rpe_m", "drift_percent", "drift_deg_per_100m", "coverage", "cpu_ms", "memory_mib")
# CPU time and memory depend on the machine: reported, but no regression.
_NOT_JUDGED = ("cpu_ms", "memory_mib")
# Below this, in the unit of the figure, two values are the same: ATE of 0.01 mm is that of a recording at rest.
_FLOOR = 1e-5


@dataclass(frozen=True, slots=True)
class Change:
    """One figure of one configuration, over all sequences that both benches have."""

    system: str
    metric: str
    sequences: int
    ratio: float  # geometric mean of B / A
    low: float  # of the bootstrap's interval of it
    high: float
    p: float  # share of flips of signs that are as extreme
    verdict: Verdict


@dataclass(frozen=True, slots=True)
class SequenceChange:
    """A change of the ATE of one sequence that is beyond its spread."""

    sequence: str
    system: str
    before: float  # median over seeds
    after: float
    verdict: Literal["better", "worse"]
    reason: str


@dataclass(frozen=True, slots=True)
class Comparison:
    """All that differs between two benches."""

    changes: tuple[Change, ...]
    sequences: tuple[SequenceChange, ...]
    lost: tuple[tuple[str, str, str], ...]  # sequence, system, why: had a result in A, and has none in B
    won: tuple[tuple[str, str], ...]
    only_in_one: int  # runs without a partner

    @property
    def is_worse(self) -> bool:
        """Whether anything became worse."""
        judged = [c.verdict for c in self.changes if c.metric not in _NOT_JUDGED]
        return "worse" in (*judged, *(s.verdict for s in self.sequences)) or bool(self.lost)

    def as_dict(self) -> dict[str, Any]:
        """Return the comparison for JSON."""
        return {**asdict(self), "is_worse": self.is_worse}


def compare(a: Path, b: Path, *, factor: float = 2.0) -> Comparison:
    """Compare the results of two output folders.

    Args:
        a: before.
        b: after.
        factor: by which the ATE of one sequence without other seeds must change to count.

    Raises:
        VioError: a folder holds no bench, or the two have no run in common.
    """
    if not factor > 1:
        raise EvaluationError(f"--factor must be above 1, got {factor:g}")
    return compare_outcomes(read_bench(a)[0], read_bench(b)[0], factor=factor, what=f"{a} and {b}")


def compare_outcomes(
    a: Iterable[Outcome], b: Iterable[Outcome], *, factor: float = 2.0, what: str = "the two"
) -> Comparison:
    """Compare two lists of runs.

    Raises:
        EvaluationError: they have no run in common.
    """
    before, after = ({(o.sequence, o.system, o.seed): o for o in runs if o.seed is not None} for runs in (a, b))
    common = [key for key in before if key in after]
    if not common:
        raise EvaluationError(f"{what} have no run of the same sequence, configuration and seed; compare one suite")
    pairs = [(before[key], after[key]) for key in common]
    systems = list(dict.fromkeys(old.system for old, _ in pairs))
    metrics = [metric for metric in METRICS if metric.name in _COMPARED]
    tables = {(s, m.name): _log_ratios([p for p in pairs if p[0].system == s], m) for s in systems for m in metrics}
    tests = sum(bool(table) for (_, name), table in tables.items() if name not in _NOT_JUDGED)
    level = LEVEL / max(tests, 1)
    changes = [
        _change(system, metric, [float(np.mean(v)) for v in table.values()], level)
        for system in systems
        for metric in metrics
        if (table := tables[system, metric.name])
    ]
    return Comparison(
        tuple(changes),
        tuple(_sequence_changes(pairs, systems, factor)),
        tuple((o.sequence, o.system, n.failure or "") for o, n in pairs if o.failure is None and n.failure is not None),
        tuple((o.sequence, o.system) for o, n in pairs if o.failure is not None and n.failure is None),
        len(before) + len(after) - 2 * len(common),
    )


def _log_ratios(pairs: Sequence[tuple[Outcome, Outcome]], metric: Metric) -> dict[str, list[float]]:
    """Return by sequence the log ratios B / A of all seeds; above 0 is worse, whichever way the figure goes."""
    out: dict[str, list[float]] = {}
    for old, new in pairs:
        x, y = old.value(metric), new.value(metric)
        if x is not None and y is not None:
            ratio = math.log(max(y, _FLOOR) / max(x, _FLOOR))
            out.setdefault(old.sequence, []).append(-ratio if metric.larger_is_better else ratio)
    return out


def _change(system: str, metric: Metric, values: Sequence[float], level: float) -> Change:
    d = np.array(values)
    low, high = bootstrap_interval(d, level)
    p = sign_flip_p(d)
    if not d.any():
        verdict: Verdict = "identical"
    elif 2.0 ** (1 - len(d)) > level:  # even if all changed the same way, chance would do that as often
        verdict = "too few sequences to say"
    elif p > level or low <= 0 <= high:
        verdict = "no change beyond chance"
    else:
        verdict = "worse" if d.mean() > 0 else "better"
    sign = -1 if metric.larger_is_better else 1
    ends = sorted((math.exp(sign * low), math.exp(sign * high)))
    return Change(system, metric.name, len(d), math.exp(sign * float(d.mean())), ends[0], ends[1], p, verdict)


def bootstrap_interval(values: FloatArray, level: float) -> tuple[float, float]:
    """Return the percentile interval of the mean of values (N,) at confidence 1 - level, always the same numbers."""
    rng = np.random.default_rng(0)
    n = len(values)
    means = np.concatenate([values[rng.integers(0, n, (rows, n))].mean(axis=1) for rows in _blocks(n)])
    low, high = np.quantile(means, [level / 2, 1 - level / 2])
    return float(low), float(high)


def sign_flip_p(values: FloatArray) -> float:
    """Return the share of all flips of signs of values (N,) whose mean is as far from zero: a two-sided p-value.

    Reference: Fisher, The Design of Experiments (1935), section 21.
    """
    n = len(values)
    if n <= _EXACT_FLIPS:
        signs = 1.0 - 2.0 * ((np.arange(2**n)[:, None] >> np.arange(n)) & 1)
        sums = np.abs(signs @ values)
    else:
        rng = np.random.default_rng(0)
        parts = [(2.0 * rng.integers(0, 2, (rows, n), dtype=np.int8) - 1.0) @ values for rows in _blocks(n)]
        sums = np.abs(np.concatenate([[values.sum()], *parts]))
    return float(np.mean(sums >= abs(values.sum()) * (1 - 1e-12)))


def _blocks(n: int) -> Iterator[int]:
    """Yield how many resamples of n values to draw at a time; of thousands of values fewer in all."""
    left = max(_RESAMPLES if n <= _MANY else _RESAMPLES // 5, 1)
    rows = max(_MANY**2 // n, 1)
    while left > 0:
        yield min(rows, left)
        left -= rows


def _sequence_changes(
    pairs: Sequence[tuple[Outcome, Outcome]], systems: Sequence[str], factor: float
) -> Iterator[SequenceChange]:
    """Yield sequences whose ATE changed by more than their seeds differ, or, with one seed, by more than a factor."""
    metric = METRICS[0]
    for system in systems:
        own = [p for p in pairs if p[0].system == system]
        logs = _log_ratios(own, metric)
        values: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in logs}
        for pair in own:
            for side, outcome in enumerate(pair):
                if (value := outcome.value(metric)) is not None and outcome.sequence in values:
                    values[outcome.sequence][side].append(value)
        for name, ratios in logs.items():
            mean = float(np.mean(ratios))
            limit, reason = _limit(values[name], len(logs) * len(systems), factor)
            if abs(mean) > limit:
                before, after = (float(np.median(v)) if v else 0.0 for v in values[name])
                yield SequenceChange(name, system, before, after, "worse" if mean > 0 else "better", reason)


def _limit(values: Sequence[Sequence[float]], tests: int, factor: float) -> tuple[float, str]:
    """Return the log ratio beyond which a sequence's change counts, and what that limit is."""
    counts = [len(v) for v in values]
    if min(counts) < 2:
        return math.log(factor), f"one seed: a change by more than a factor of {factor:g}"
    logs = [np.log(np.maximum(v, _FLOOR)) for v in values]
    freedom = sum(counts) - 2
    variance = sum(float(((x - x.mean()) ** 2).sum()) for x in logs) / freedom
    sigma = math.sqrt(variance * sum(1 / n for n in counts))
    quantile = _student_quantile(1 - LEVEL / (2 * tests), freedom)
    return quantile * sigma, f"beyond the spread over {min(counts)} seeds"


def _student_quantile(probability: float, freedom: int) -> float:
    """Return the quantile of Student's t distribution, for probabilities above one half.

    Its square is that of an F distribution, computed here from the incomplete beta function.
    """
    from scipy.special import betaincinv

    x = float(betaincinv(freedom / 2, 0.5, 2 * (1 - probability)))
    return math.sqrt(freedom * (1 - x) / x)


def comparison_lines(result: Comparison) -> Iterator[str]:
    """Yield a comparison as text: figures over all sequences, then single sequences, then what was lost."""
    titles = {metric.name: metric.title for metric in METRICS}
    yield f"{'configuration':<16} {'figure':<14} {'B / A':>8}  {'interval':<18} {'p':>7}  n  verdict"
    for c in result.changes:
        interval = f"{number(c.low, 3)} to {number(c.high, 3)}"
        verdict = f"{c.verdict} (machine, not judged)" if c.metric in _NOT_JUDGED else c.verdict
        head = f"{c.system:<16} {titles[c.metric]:<14} {number(c.ratio, 4):>8}"
        yield f"{head}  {interval:<18} {c.p:>7.4f}  {c.sequences}  {verdict}"
    for s in result.sequences:
        values = f"ATE {number(s.before, 3)} to {number(s.after, 3)} m"
        yield f"{s.sequence}, {s.system}: {s.verdict}, {values} ({s.reason})"
    yield from (f"{sequence}, {system}: worse, no result any more: {why}" for sequence, system, why in result.lost)
    yield from (f"{sequence}, {system}: better, has a result now" for sequence, system in result.won)
    if result.only_in_one:
        yield f"{result.only_in_one} runs are in one of the two only and were not compared"
    yield "something became worse" if result.is_worse else "nothing became worse beyond chance"
