"""`vio bench compare`: what is called better or worse, how often by chance, and the exit status."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from tests.commands import json_of, refused
from tools.verdicts import verdicts
from vio.bench.compare import compare_outcomes, comparison_lines, holm
from vio.bench.tables import Outcome
from vio.cli import main
from vio.errors import EvaluationError


def runs(
    ate_m: Sequence[Sequence[float | None]],
    *,
    coverage: float = 1.0,
    system: str = "x",
    cpu_ms: float = 30.0,
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
    logs = rng.normal(np.log(1.3), 0.2, (12, 1))
    a, b = runs(before.tolist()), runs((before * np.exp(logs)).tolist())
    worse = next(c for c in compare_outcomes(a, b).changes if c.metric == "ate_m")
    assert worse.verdict == "worse"
    exact = stats.t.interval(0.95, 11, logs.mean(), stats.sem(logs[:, 0]))
    assert (worse.effect.n, worse.effect.ratio) == (12, pytest.approx(float(np.exp(logs.mean()))))
    assert (worse.effect.low, worse.effect.high) == pytest.approx(tuple(np.exp(exact)))
    assert compare_outcomes(a, b).verdict == "worse"
    assert _verdicts(b, a)["ate_m"] == "better"
    assert compare_outcomes(b, a).verdict == "better"


def test_eight_sequences_that_are_all_nearly_twice_as_large_are_worse() -> None:
    before = [[0.01 * (k + 1)] for k in range(8)]
    for spread in (0.0, 0.1):
        noise = np.random.default_rng(6).lognormal(np.log(1.9), spread, 8)
        after = [[v[0] * float(f)] for v, f in zip(before, noise, strict=True)]
        assert compare_outcomes(runs(before), runs(after)).verdict == "worse"


@pytest.mark.parametrize("noise", ["normal", "heavy tails", "one in ten breaks"])
def test_chance_alone_is_called_worse_once_in_twenty_at_most(noise: str) -> None:
    """As docs/bench.md has it, of fewer: 5 % of 150 are 13 at most with a probability of 0.98."""
    for n in (5, 20):
        ate, whole = verdicts(n, 1.0, noise, 150)
        assert max(ate["worse"], ate["better"]) <= 9  # 2.5 % each
        assert whole["worse"] <= 13
    assert verdicts(20, 1.5, noise, 20)[0]["worse"] > 10, "and what is there is seen"


def test_figures_beside_the_ate_are_adjusted_for_their_number() -> None:
    """Twenty configurations with one figure at p = 0.03: chance does that."""
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5, 0.9]) == [1.0, 1.0]
    assert holm([]) == []


def test_few_or_scattered_sequences_cannot_tell_and_equal_ones_are_not_worse() -> None:
    before = runs([[0.1], [0.2], [0.3]])
    result = compare_outcomes(before, runs([[0.11], [0.2], [0.36]]))
    assert result.verdict == "cannot tell"
    assert compare_outcomes(before, before).verdict == "not worse"
    assert compare_outcomes(before, runs([[0.101], [0.2], [0.299]])).verdict == "not worse", (
        "by 10 % or more"
    )
    assert compare_outcomes(runs([[0.1]]), runs([[0.101]])).verdict == "cannot tell", (
        "one sequence has no interval"
    )


def test_a_change_of_a_thousandth_is_none_however_certain() -> None:
    before = [[0.01 * (k + 1)] for k in range(8)]
    for change, verdict in ((1.001, "not worse"), (1.02, "worse")):
        assert (
            compare_outcomes(runs(before), runs([[v[0] * change] for v in before])).verdict
            == verdict
        )


def test_equal_seeds_count_once() -> None:
    """Seeds that change nothing are no repetitions: a change of 0.1 %, or of a factor of 3, is
    not certain by them.
    """
    small = compare_outcomes(runs([[0.1] * 5]), runs([[0.1001] * 5]))
    assert (small.sequences, small.changes[0].effect.n) == ((), 1)
    (large,) = compare_outcomes(runs([[0.1] * 5]), runs([[0.3] * 5])).sequences
    assert (large.effect.n, large.verdict) == (1, "cannot tell")
    several = runs([[0.1, 0.1, 0.2]]), runs([[0.1, 0.1, 0.4]])
    assert compare_outcomes(*several).changes[0].effect.ratio == pytest.approx(np.sqrt(2)), (
        "two runs, not three"
    )


def test_renders_drawn_anew_with_each_seed_are_cases_of_their_own() -> None:
    rng = np.random.default_rng(7)
    values = rng.lognormal(-3, 0.5, (2, 8))
    after = values * rng.lognormal(np.log(1.5), 0.2, (2, 8))
    a, b = runs(values.tolist()), runs(after.tolist())
    drawn = compare_outcomes(a, b, drawn_each_seed=["sequence0", "sequence1"])
    assert (drawn.changes[0].effect.n, drawn.verdict) == (16, "worse")
    assert compare_outcomes(a, b).changes[0].effect.n == 2


def test_a_larger_coverage_is_better() -> None:
    values = [[0.1 * (k + 1)] for k in range(12)]
    a, b = runs(values), runs(values, coverage=0.9)
    assert _verdicts(a, b) == {"ate_m": "not worse", "coverage": "worse", "cpu_ms": "not worse"}
    change = next(c for c in compare_outcomes(a, b).changes if c.metric == "coverage")
    assert change.effect.ratio == pytest.approx(0.9)
    assert _verdicts(b, a)["coverage"] == "better"


def test_a_slower_machine_is_told_but_no_regression() -> None:
    values = [[0.1 * (k + 1)] for k in range(12)]
    result = compare_outcomes(runs(values), runs(values, cpu_ms=60.0))
    assert next(c for c in result.changes if c.metric == "cpu_ms").verdict == "worse"
    assert result.verdict == "not worse"


def test_one_sequence_that_breaks_is_always_shown() -> None:
    """Of twelve, eleven as before: without other seeds nobody can tell whether it was chance."""
    before = [[0.1 * (k + 1)] for k in range(12)]
    result = compare_outcomes(runs(before), runs([*before[:-1], [30.0]]))
    (broken,) = result.sequences
    assert (broken.sequence, broken.verdict, broken.after) == ("sequence11", "cannot tell", 30.0)
    assert result.verdict == "cannot tell"
    assert any("sequence11, x: ATE 1.2 to 30 m" in line for line in comparison_lines(result))
    assert not compare_outcomes(runs(before), runs([*before[:-1], [2.0]])).sequences, (
        "a factor of 1.7"
    )
    assert compare_outcomes(runs(before), runs([*before[:-1], [2.0]]), factor=1.5).sequences
    assert compare_outcomes(runs([*before[:-1], [30.0]]), runs(before)).verdict != "worse"


def test_a_sequence_that_breaks_with_every_seed_is_worse() -> None:
    calm = [[0.100, 0.101, 0.099, 0.100 + 1e-4]]
    (found,) = compare_outcomes(runs(calm), runs([[0.31, 0.30, 0.32, 0.31]])).sequences
    assert (found.verdict, found.effect.n) == ("worse", 4)
    (chance,) = compare_outcomes(
        runs([[0.1, 0.14, 0.08, 0.12]]), runs([[0.1, 0.2, 3.0, 0.5]])
    ).sequences
    assert chance.verdict == "cannot tell"


def test_a_run_that_fails_now_is_worse_and_one_that_works_now_is_told() -> None:
    values: list[list[float | None]] = [[0.1], [0.2]]
    result = compare_outcomes(runs(values), runs([[0.1], [None]]))
    assert result.lost == (("sequence1", "x", "it diverged"),)
    assert result.verdict == "worse"
    result = compare_outcomes(runs([[0.1], [None]]), runs(values))
    assert result.won == (("sequence1", "x"),)
    assert result.verdict != "worse"
    assert any("has a result now" in line for line in comparison_lines(result))


def test_benches_without_a_common_run_are_refused() -> None:
    with pytest.raises(EvaluationError, match="no run of the same sequence"):
        compare_outcomes(runs([[0.1]]), runs([[0.1]], system="y"))


def test_the_command_tells_by_its_exit_status(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, factor in (("a", 1.0), ("b", 1.9), ("c", 1.0)):
        values = [[0.1 * (k + 1) * (factor if k or name != "c" else 5.0)] for k in range(8)]
        (tmp_path / name).mkdir()
        peer = replace(runs([[0.3]])[0], system="other", seed=None)
        outcomes = [
            outcome.as_dict() for outcome in [*runs(values), *runs(values[:4], system="y"), peer]
        ]
        (tmp_path / name / "bench.json").write_text(json.dumps({"outcomes": outcomes}))
    a, b, c = (str(tmp_path / name) for name in "abc")
    assert main(["bench", "compare", a, b]) == 1
    printed = capsys.readouterr().out
    assert "1.9 to 1.9" in printed
    assert printed.endswith("\nworse\n")
    assert json_of(capsys, "bench", "compare", b, a)["verdict"] == "better"
    assert main(["bench", "compare", a, a]) == 0
    assert capsys.readouterr().out.endswith("not worse by 10 % or more\n")
    assert main(["bench", "compare", a, c]) == 3
    assert "sequence0, x: ATE 0.1 to 0.5 m" in capsys.readouterr().out
    assert main(["bench", "compare", a, "--between", "x", "y"]) == 0, "two systems of one bench"
    assert "x to y" in capsys.readouterr().out
    assert main(["bench", "compare", a, b, "--between", "x", "y", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["changes"][0]["effect"]["n"] == 4
    assert main(["bench", "compare", a, "--between", "x", "other"]) == 3, (
        "one trajectory without a seed"
    )
    assert "ATE 0.1 to 0.3 m" in capsys.readouterr().out
    assert "no such system; choose of x, y, other" in refused(
        capsys, "bench", "compare", a, "--between", "x", "z"
    )
    assert "--factor must be above 1" in refused(capsys, "bench", "compare", a, b, "--factor", "1")
    (tmp_path / "b" / "bench.json").write_text('{"outcomes": [{}]}')
    assert "is damaged" in refused(capsys, "bench", "compare", a, b)


# --- the simulation of a schedule
# -----------------------------------------------------------------------------------
