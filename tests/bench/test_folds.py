"""`vio bench --folds`: a setting is chosen on one half of the rigs and judged on the other."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vio.bench.folds import _splits, cross_validate, fold_lines
from vio.bench.tables import Outcome
from vio.cli import main
from vio.errors import EvaluationError


def _run(rig: str, system: str, ate_m: float, sequence: str | None = None) -> Outcome:
    name = rig if sequence is None else sequence
    return Outcome(name, system, 0, name + system, {"ate_m": ate_m}, {}, None, None, rig=rig)


def _runs(ratios: dict[str, float], before_m: float = 0.1) -> list[Outcome]:
    """Two configurations, of which `new` has these multiples of the ATE of `old`, by rig."""
    old = [_run(rig, "old", before_m) for rig in ratios]
    return old + [_run(rig, "new", before_m * ratio) for rig, ratio in ratios.items()]


def test_a_setting_that_helps_everywhere_wins_both_ways() -> None:
    result = cross_validate(_runs({"a": 0.8, "b": 0.8, "c": 0.8, "d": 0.8}))
    assert result.wins
    assert [fold.winner for fold in result.folds] == ["new", "new"]
    assert result.folds[0].chosen_on == ("a", "c") == result.folds[1].judged_on
    assert result.folds[0].judged_on == ("b", "d") == result.folds[1].chosen_on
    assert [fold.ratio_judged for fold in result.folds] == pytest.approx([0.8, 0.8])
    assert (result.splits, result.better) == (3, 1.0)


def test_a_setting_that_is_tuned_to_one_half_does_not_win() -> None:
    result = cross_validate(_runs({"a": 0.5, "b": 1.5, "c": 0.5, "d": 1.5}))
    assert not result.wins
    assert (result.folds[0].winner, result.folds[1].winner) == ("new", "old")
    assert result.folds[0].ratio_chosen == pytest.approx(0.5)
    assert result.folds[0].ratio_judged == pytest.approx(1.5)
    assert result.folds[1].ratio_judged == 1.0, "the baseline is chosen, which is no gain"
    assert "does not win both ways" in list(fold_lines(result))[-1]


def test_chance_alone_is_no_gain_in_the_mean() -> None:
    """Of ten settings that change nothing in the mean, the best of one half is none on the other."""
    rng = np.random.default_rng(0)
    judged = []
    for _ in range(40):
        runs = [_run(rig, "old", 0.1) for rig in "abcdef"]
        for k in range(9):
            ratios = np.exp(rng.normal(0, 0.2, 6))
            runs += [_run(rig, f"new{k}", 0.1 * r) for rig, r in zip("abcdef", ratios, strict=True)]
        result = cross_validate(runs)
        assert all(fold.ratio_chosen <= 1 for fold in result.folds)
        judged += [np.log(fold.ratio_judged) for fold in result.folds]
    assert abs(np.mean(judged)) < 3 * np.std(judged) / np.sqrt(len(judged))


def test_of_too_many_splits_some_are_drawn_evenly() -> None:
    """No pair of rigs is together in all of them, as in the first ones of a list."""
    rigs = [f"r{k:02d}" for k in range(18)]
    splits = list(_splits(rigs))
    assert len({frozenset(half) for half, _ in splits}) == len(splits) == 2000
    assert len({frozenset(half) for both in splits for half in both}) == 4000
    assert all(sorted((*half, *rest)) == rigs for half, rest in splits)
    together = [sum((rig in half) == (rigs[0] in half) for half, _ in splits) for rig in rigs[1:]]
    assert np.mean(together) == pytest.approx(2000 * 8 / 17)
    assert np.ptp(together) < 8 * np.sqrt(2000 / 4)
    few = list(_splits(rigs[:6]))
    assert len(few) == 10


def test_each_rig_counts_once_however_many_drives_it_has() -> None:
    many = [
        _run("a", system, ate, f"a{k}")
        for k in range(9)
        for system, ate in (("old", 0.1), ("new", 0.05))
    ]
    few = _runs({"b": 1.9, "c": 1.9, "d": 1.9})
    result = cross_validate(sorted([*many, *few], key=lambda o: o.system != "old"))
    assert result.folds[0].chosen_on == ("a", "c")
    assert result.folds[0].ratio_chosen == pytest.approx(np.sqrt(0.5 * 1.9))
    assert result.folds[0].winner == "new"


def test_rigs_without_ground_truth_are_left_out_and_too_few_are_refused() -> None:
    blind = [replace(o, figures={}) for o in _runs({"e": 1.0})]
    assert cross_validate([*_runs(dict.fromkeys("abcd", 0.9)), *blind]).splits == 3
    with pytest.raises(EvaluationError, match="four rigs or more with ground truth, got 3"):
        cross_validate([*_runs(dict.fromkeys("abc", 0.9)), *blind])
    with pytest.raises(EvaluationError, match="needs two or more"):
        cross_validate([o for o in _runs(dict.fromkeys("abcd", 0.9)) if o.system == "old"])
    lost = [replace(o, failure="it diverged") for o in _runs({"e": 1.0})]
    with pytest.raises(EvaluationError, match="e, old, e, new"):
        cross_validate([*_runs(dict.fromkeys("abcd", 0.9)), *lost])


def test_two_benches_are_cross_validated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, system in (("before", "old"), ("after", "new")):
        outcomes = [o.as_dict() for o in _runs(dict.fromkeys("abcd", 0.9)) if o.system == system]
        folder = tmp_path / name
        folder.mkdir()
        (folder / "bench.json").write_text(json.dumps({"outcomes": outcomes}))
    command = ["bench", "compare", str(tmp_path / "before"), str(tmp_path / "after"), "--folds"]
    assert main(command) == 0
    assert "B: new" in capsys.readouterr().out
    assert main([*command[:2], command[3], command[2], "--folds", "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["wins"] is False
