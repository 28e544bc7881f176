"""The course kit: solutions pass their own checks; exercises are the same without them, and fail
until solved.
"""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib
import pytest

from tools.exercises import exercise, pairs

_PAIRS = sorted(pairs())


def _code(path: Path) -> list[str]:
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def test_there_are_two_exercises() -> None:
    assert [tasks.stem for _, tasks in _PAIRS] == ["consistency", "ekf_on_se3"]


@pytest.mark.parametrize(("solution", "tasks"), _PAIRS, ids=lambda path: path.stem)
def test_an_exercise_is_its_solution_without_the_answers(solution: Path, tasks: Path) -> None:
    text = tasks.read_text(encoding="utf-8")
    assert text == exercise(solution.read_text(encoding="utf-8")), "run: python -m tools.exercises"
    assert (
        text.count("NotImplementedError")
        == solution.read_text(encoding="utf-8").count("# begin solution")
        >= 4
    )
    assert "$$" in text


@pytest.mark.parametrize(
    "solution", [solution for solution, _ in _PAIRS], ids=lambda path: path.stem
)
def test_solutions_pass_their_checks(
    solution: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    scope: dict[str, object] = {}
    for text in _code(solution):
        exec(compile(text, solution.name, "exec"), scope)
    printed = [
        cell["outputs"]
        for cell in json.loads(solution.read_text(encoding="utf-8"))["cells"]
        if "outputs" in cell
    ]
    assert sum(bool(output) for output in printed) >= 3, "saved with what it printed"


@pytest.mark.parametrize("tasks", [tasks for _, tasks in _PAIRS], ids=lambda path: path.stem)
def test_an_unsolved_exercise_stops_at_its_first_task(tasks: Path) -> None:
    scope: dict[str, object] = {}
    whole = "\n".join(_code(tasks))
    with pytest.raises(NotImplementedError, match="your solution"):
        exec(compile(whole, tasks.name, "exec"), scope)
