"""The course kit: solutions pass their own checks; exercises are the same without them, and fail
until solved.
"""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib
import pytest

from tests.commands import refused
from tools.exercises import FOLDER, exercise, pairs
from vio.cli import main

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


def test_the_command_copies_tasks_and_solutions(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tasks = {"README.md", "consistency.ipynb", "ekf_on_se3.ipynb"}
    assert main(["course", str(tmp_path / "a")]) == 0
    assert {path.name for path in (tmp_path / "a").iterdir()} == tasks
    assert main(["course", str(tmp_path / "a"), "--solutions"]) == 0, "equal files stay"
    solutions = {solution.name for solution, _ in _PAIRS}
    assert {path.name for path in (tmp_path / "a").iterdir()} == tasks | solutions
    for solution, exercises in _PAIRS:
        for path in (solution, exercises):
            assert (tmp_path / "a" / path.name).read_bytes() == path.read_bytes()


def test_the_work_of_a_student_is_not_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    work = tmp_path / "ekf_on_se3.ipynb"
    work.write_text("solved")
    assert "perhaps by your work" in refused(capsys, "course", tmp_path, "--solutions")
    assert work.read_text() == "solved"
    assert len(list(tmp_path.iterdir())) == 1, "and nothing is half copied"


def test_the_list_of_exercises_names_every_notebook() -> None:
    text = (FOLDER / "README.md").read_text(encoding="utf-8")
    for _, exercises in _PAIRS:
        assert f"`{exercises.name}`" in text
