"""`vio bench compare`: what is called better or worse, how often by chance, and the exit status."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from vio.bench.compare import (
    _student_quantile,
    bootstrap_interval,
    compare_outcomes,
    comparison_lines,
    sign_flip_p,
)
from vio.bench.tables import Outcome
from vio.cli import main
from vio.errors import EvaluationError


def runs(
    ate_m: Sequence[Sequence[float | None]], *, coverage: float = 1.0, system: str = "x", cpu_ms: float = 30.0
) -> list[Outcome]:
    """Sequences with the ATE of each seed; None: that run failed."""
    return [
        Outcome(
            f"sequence{k}",
            system,
            seed,
            f"{k}{seed}",
            {} if value is None else {"ate_m": value, "coverage": coverage},
            {"cpu_ms": cpu_ms},
            "it diverged" if value is None else None,
            None,
        )
        for k, values in enumerate(ate_m)
        for seed, value in enumerate(values)
    ]


def _verdicts(a: list[Outcome], b: list[Outcome]) -> dict[str, str]:
    return {change.metric: change.verdict for change in compare_outcomes(a, b).changes}


def test_a_change_of_all_sequences_is_seen_and_its_size_told() -> None:
    rng = np.random.default_rng(1)
    before = rng.lognormal(-3, 1, (12, 1))
    after = before * rng.lognormal(np.log(1.3), 0.2, (12, 1))
    a, b = runs(before.tolist()), runs(after.tolist())
    worse = next(c for c in compare_outcomes(a, b).changes if c.metric == "ate_m")
    assert worse.verdict == "worse"
    assert worse.ratio == pytest.approx(float(np.exp(np.log(after / before).mean())))
    assert 1 < worse.low < worse.ratio < worse.high
    assert compare_outcomes(a, b).is_worse
    assert _verdicts(b, a)["ate_m"] == "better"
    assert not compare_outcomes(b, a).is_worse


def test_chance_alone_is_called_a_change_once_in_twenty_at_most() -> None:
    """Over 120 comparisons of the same system with itself, figures of few sequences scattered by 30 %."""
    rng = np.random.default_rng(2)
    called = 0
    for _ in range(120):
        values = rng.lognormal(-3, 1, (8, 1))
        a, b = (runs((values * rng.lognormal(0, 0.3, (8, 1))).tolist()) for _ in range(2))
        called += _verdicts(a, b)["ate_m"] in ("better", "worse")
    # 5 % over both judged figures, so 2.5 % here: 3 expected, more than 8 with a probability of 0.004. The
    # bootstrap alone, whose intervals are too short for eight values, would call 9 %.
    assert called <= 8


def test_few_sequences_cannot_say_and_equal_ones_are_identical() -> None:
    before = runs([[0.1], [0.2], [0.3]])
    assert _verdicts(before, runs([[0.11], [0.22], [0.33]]))["ate_m"] == "too few sequences to say"
    assert _verdicts(before, before)["ate_m"] == "identical"
    assert not compare_outcomes(before, before).is_worse


def test_a_larger_coverage_is_better() -> None:
    values = [[0.1 * (k + 1)] for k in range(12)]
    a, b = runs(values), runs(values, coverage=0.9)
    assert _verdicts(a, b) == {"ate_m": "identical", "coverage": "worse", "cpu_ms": "identical"}
    change = next(c for c in compare_outcomes(a, b).changes if c.metric == "coverage")
    assert change.ratio == pytest.approx(0.9)
    assert _verdicts(b, a)["coverage"] == "better"


def test_a_slower_machine_is_told_but_no_regression() -> None:
    values = [[0.1 * (k + 1)] for k in range(12)]
    result = compare_outcomes(runs(values), runs(values, cpu_ms=60.0))
    assert next(c for c in result.changes if c.metric == "cpu_ms").verdict == "worse"
    assert not result.is_worse


def test_one_sequence_that_breaks_is_not_lost_in_the_mean() -> None:
    """Of twelve, eleven as before: the mean says nothing, the sequence's own figure does."""
    before = [[0.1 * (k + 1)] for k in range(12)]
    after = [*before[:-1], [30.0]]
    result = compare_outcomes(runs(before), runs(after))
    assert next(c for c in result.changes if c.metric == "ate_m").verdict == "no change beyond chance"
    (broken,) = result.sequences
    assert (broken.sequence, broken.verdict, broken.after) == ("sequence11", "worse", 30.0)
    assert result.is_worse
    assert not compare_outcomes(runs(before), runs([*before[:-1], [2.0]])).is_worse, "a factor of 1.7"
    assert compare_outcomes(runs(before), runs([*before[:-1], [2.0]]), factor=1.5).is_worse


def test_the_spread_over_seeds_judges_a_sequence() -> None:
    noisy = [[0.1, 0.14, 0.08, 0.12]]
    assert not compare_outcomes(runs(noisy), runs([[0.12, 0.1, 0.16, 0.11]])).sequences
    calm = [[0.100, 0.101, 0.099, 0.100]]
    (found,) = compare_outcomes(runs(calm), runs([[0.112, 0.111, 0.110, 0.112]])).sequences
    assert found.verdict == "worse"
    assert "4 seeds" in found.reason


def test_a_run_that_fails_now_is_worse_and_one_that_works_now_is_told() -> None:
    values: list[list[float | None]] = [[0.1], [0.2]]
    result = compare_outcomes(runs(values), runs([[0.1], [None]]))
    assert result.lost == (("sequence1", "x", "it diverged"),)
    assert result.is_worse
    result = compare_outcomes(runs([[0.1], [None]]), runs(values))
    assert result.won == (("sequence1", "x"),)
    assert not result.is_worse
    assert any("has a result now" in line for line in comparison_lines(result))


def test_benches_without_a_common_run_are_refused() -> None:
    with pytest.raises(EvaluationError, match="no run of the same sequence"):
        compare_outcomes(runs([[0.1]]), runs([[0.1]], system="y"))


def test_sign_flips_equal_all_enumerated() -> None:
    values = np.random.default_rng(3).normal(0.4, 1, 9)
    means = [abs(np.dot(signs, values)) for signs in product((-1, 1), repeat=9)]
    assert sign_flip_p(values) == pytest.approx(np.mean([m >= abs(values.sum()) - 1e-12 for m in means]))
    many = np.random.default_rng(4).normal(0.3, 1, 40)
    assert sign_flip_p(many) == pytest.approx(stats.ttest_1samp(many, 0).pvalue, abs=0.02)


def test_the_bootstrap_covers_the_mean_and_repeats() -> None:
    values = np.random.default_rng(5).normal(2.0, 1.0, 60)
    low, high = bootstrap_interval(values, 0.05)
    exact = stats.t.interval(0.95, 59, values.mean(), stats.sem(values))
    assert (low, high) == pytest.approx(exact, abs=0.03)
    assert bootstrap_interval(values, 0.05) == (low, high)


@pytest.mark.parametrize("freedom", [1, 4, 30])
def test_students_quantile_is_that_of_scipy(freedom: int) -> None:
    for probability in (0.9, 0.975, 0.9995):
        assert _student_quantile(probability, freedom) == pytest.approx(stats.t.ppf(probability, freedom), rel=1e-9)


def test_the_command_ends_with_one_where_something_is_worse(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, ate_m in (("a", 0.1), ("b", 0.5)):
        (tmp_path / name).mkdir()
        outcomes = [outcome.as_dict() for outcome in runs([[ate_m]])]
        (tmp_path / name / "bench.json").write_text(json.dumps({"outcomes": outcomes}))
    a, b = str(tmp_path / "a"), str(tmp_path / "b")
    assert main(["bench", "compare", a, b]) == 1
    printed = capsys.readouterr().out
    assert "sequence0, x: worse, ATE 0.1 to 0.5 m" in printed
    assert printed.endswith("something became worse\n")
    assert main(["bench", "compare", b, a, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["is_worse"] is False
    assert main(["bench", "compare", a, a]) == 0
    assert "identical" in capsys.readouterr().out
    assert main(["bench", "compare", a, b, "--factor", "1"]) == 1
    assert "--factor must be above 1" in capsys.readouterr().err
    (tmp_path / "b" / "bench.json").write_text('{"outcomes": [{}]}')
    assert main(["bench", "compare", a, b]) == 1
    assert "is damaged" in capsys.readouterr().err


# --- the simulation of a schedule -----------------------------------------------------------------------------------
