"""What `tools/measures.py` counts, on code whose counts are known, and on this checkout."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tools.measures import complexity, count_arguments, main, measure, number_constants
from tools.parts import part_of, wrong_way

ROOT = Path(__file__).resolve().parents[2]
_CODE = '''"""A module."""

from vio.records import Image

_ONE = 1.0  # counts
_TWO: int = 2 * 10**6  # counts
_THREE = (-1, 2.5)  # counts
_NAME = "1"
_FLAG = True
_COMPUTED = float(_ONE)


class Pair:
    """No constant: a field."""

    size: int = 3

    def both(self, a, b, *rest, c, d=1, **more):
        """Four arguments."""
        if a and b or c:
            return [x for x in rest if x]
        return a if d else b


def plain(a):

    def inner(b):
        while b:
            b -= 1

    return inner(a)
'''


def _functions() -> dict[str, ast.FunctionDef]:
    tree = ast.parse(_CODE)
    return {node.name: node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def test_numbers_at_the_top_of_a_module_are_constants() -> None:
    assert list(number_constants(ast.parse(_CODE))) == ["_ONE", "_TWO", "_THREE"]


def test_arguments_are_counted_without_self_and_collectors() -> None:
    assert {name: count_arguments(node) for name, node in _functions().items()} == {
        "both": 4,
        "plain": 1,
        "inner": 1,
    }


def test_decisions_are_counted_for_the_function_that_makes_them() -> None:
    # if, and, or; comprehension and its condition; conditional expression: six more than one.
    assert {name: complexity(node) for name, node in _functions().items()} == {
        "both": 7,
        "plain": 1,
        "inner": 2,
    }


def test_a_checkout_is_measured(tmp_path: Path) -> None:
    for name, text in (
        ("vio/__init__.py", '"""Top."""\n'),
        ("vio/records.py", "def f() -> None:\n    from vio.runs.folder import g\n"),
        ("vio/runs/folder.py", '"""Two\nlines."""\n\nimport vio.records\n\ng = 1  # one\n'),
        ("vio/runs/batch.py", "_A: Capacity[int] = 8\n_B: int = 8\n_C: Tolerance = 1e-3\n"),
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    measures = measure(tmp_path)
    assert measures.code_lines == 7
    batch = ("vio.runs.batch _A", "vio.runs.batch _B", "vio.runs.batch _C")
    assert measures.constants == (*batch, "vio.runs.folder g")
    assert measures.deciding == (*batch[1:], "vio.runs.folder g")
    assert measures.edges == (
        ("vio.records", "vio.runs.folder"),
        ("vio.runs.folder", "vio.records"),
    )
    assert measures.wrong == (("vio.records", "vio.runs.folder"),)


def test_a_module_without_a_part_is_an_error() -> None:
    assert part_of("vio.offline.reproduce") == "laboratory"
    assert part_of("vio.offline.refine") == "offline"
    assert part_of("vio") == "command line"
    with pytest.raises(KeyError, match=r"vio\.newpackage\.x is in no part"):
        part_of("vio.newpackage.x")
    assert wrong_way([("vio.cli", "vio.records"), ("vio.records", "vio.cli")]) == [
        ("vio.records", "vio.cli")
    ]


def test_this_checkout_is_measured(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["measures", "--root", str(ROOT), "--list"])
    assert main() == 0
    printed = capsys.readouterr().out
    measures = measure(ROOT)
    assert f"| code lines | {measures.code_lines:,} |" in printed
    assert measures.code_lines > 10_000
    assert len(measures.edges) > 1000
    assert "vio.geometry.stereo" in measures.klt_imports
    assert all(form.place in printed for form in measures.functions_with_many_arguments())
