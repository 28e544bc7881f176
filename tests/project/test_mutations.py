"""The mutations of `tools/mutations.txt` apply to the present code; `tools/mutate.py` runs the
tests on them.
"""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

from tools.mutate import (
    MUTATIONS,
    Mutation,
    MutationError,
    constant_mutations,
    draw_constants,
    mutated,
    read_mutations,
    run_tests,
)

ROOT = Path(__file__).resolve().parents[2]


@cache
def _read(file: str) -> tuple[str, str]:
    text = (ROOT / file).read_text(encoding="utf-8")
    return text, ast.dump(ast.parse(text))


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda m: m.name)
def test_every_mistake_can_still_be_made(mutation: Mutation) -> None:
    text, tree = _read(mutation.file)
    spoiled = mutated(mutation, text)  # the old text occurs exactly once
    assert ast.dump(ast.parse(spoiled)) != tree, "a mistake in a comment is none"
    missing = [name for name in mutation.tests if not (ROOT / name).is_file()]
    assert not missing


def test_names_tell_the_mistakes_apart() -> None:
    assert len({m.name for m in MUTATIONS}) == len(MUTATIONS)
    assert len({(m.file, m.old, m.new) for m in MUTATIONS}) == len(MUTATIONS)


def test_a_list_without_old_and_new_text_is_an_error() -> None:
    one = "vio/a.py: geometry/test_lie\n  name\n  - 1\n  + 2\n"
    assert read_mutations(one) == (
        Mutation("name", "vio/a.py", "1", "2", ("tests/geometry/test_lie.py",)),
    )
    with pytest.raises(MutationError, match="'name' needs a line"):
        read_mutations(one.replace("- 1", "1"))


@pytest.mark.parametrize("text", ["a = 2\n", "a = 1\nb = 1\n"])
def test_a_text_that_is_gone_or_not_alone_is_an_error(text: str) -> None:
    with pytest.raises(MutationError, match=r"'= 1' occurs \d times in x.py"):
        mutated(Mutation("one", "x.py", "= 1", "= 3", ()), text)


def test_another_package_than_the_copy_is_an_error(tmp_path: Path) -> None:
    """An empty folder holds no vio, so the installed one would be tested instead."""
    with pytest.raises(MutationError, match="instead of"):
        run_tests(tmp_path, ["tests/geometry/test_lie.py"])


def test_constants_are_made_larger_and_smaller(tmp_path: Path) -> None:
    (tmp_path / "vio").mkdir()
    (tmp_path / "tests").mkdir()
    text = """\"\"\"A module.\"\"\"

_ONE = 1  # at least one more
_SHARE: float = 0.5
_PAIR = (-4, 2.0)
_GRID = ((1, 2), (3, 4))
_LONG = (
    # why
    2.0
)
_ZERO = 0
_STEPS: Tolerance[int] = 9
_NAME = "1"


class _Rules(NamedTuple):
    share: float = 0.25  # of all
    queue: Capacity[int] = 10


class _Other(NamedTuple):
    given: int = 1


class _Alike(NamedTuple):
    share: float = 0.25


_RULES = _Rules()
_ALIKE = _Alike()
"""
    (tmp_path / "vio" / "part.py").write_text(text)
    (tmp_path / "vio" / "unnamed.py").write_text("_A = 1\n")
    (tmp_path / "vio" / "used.py").write_text("_B = 3\n")
    (tmp_path / "vio" / "user.py").write_text("from vio import used\n")
    (tmp_path / "tests" / "test_part.py").write_text("from vio import part\n")
    (tmp_path / "tests" / "test_other.py").write_text("import vio.partner\n")
    (tmp_path / "tests" / "test_user.py").write_text("import vio.user\n")
    of_file = {"vio/part.py": list[Mutation](), "vio/used.py": list[Mutation]()}
    for mutation in constant_mutations(tmp_path):
        of_file[mutation.file].append(mutation)
    found = of_file["vio/part.py"]
    old = [mutation.old.lstrip() for mutation in found]
    assert old == sorted(old, key=text.index)  # both changes of each, in the file's order
    changed = ["".join(set(mutation.new.split("\n")) - set(text.split("\n"))) for mutation in found]
    assert changed == [
        "_ONE = 2",
        "_ONE = 0",
        "_SHARE: float = 0.75",
        "_SHARE: float = 0.3333333333333333",
        "_PAIR = (-6, 3.0)",
        "_PAIR = (-3, 1.3333333333333333)",
        "_GRID = ((2, 3), (5, 6))",
        "_GRID = ((0, 1), (2, 3))",
        "    3.0",
        "    1.3333333333333333",
        "    share: float = 0.375",
        "    share: float = 0.16666666666666666",
        "    share: float = 0.375",
        "    share: float = 0.16666666666666666",
    ]
    assert {m.tests for m in found} == {("tests/test_part.py",)}
    assert "_PAIR = (-6, 3.0)\n_GRID" in mutated(found[4], text)
    # no test names it; one names the module that imports it
    assert {m.tests for m in of_file["vio/used.py"]} == {("tests/test_user.py",)}


def test_constants_are_drawn_from_each_part(tmp_path: Path) -> None:
    for package, count in {"vio/filters": 6, "vio/bench": 3}.items():
        folder = tmp_path / package
        folder.mkdir(parents=True)
        text = "".join(f"_N{k} = {k + 2}.0\n" for k in range(count))
        (folder / "part.py").write_text(text)
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_all.py").write_text("from vio.filters import part\nvio.bench.part")
    found = constant_mutations(tmp_path)
    drawn = list(draw_constants(found, tmp_path, 3, seed=1))
    assert [m.file for m in drawn] == ["vio/filters/part.py"] * 4 + ["vio/bench/part.py"] * 2
    assert len({m.old for m in drawn}) == 3  # each times and over 1.5
    assert drawn == list(draw_constants(found, tmp_path, 3, seed=1))
    assert len(list(draw_constants(found, tmp_path, 99, seed=1))) == 18


def test_constants_of_this_checkout_can_be_changed() -> None:
    found = constant_mutations(ROOT, ["frontend/", "filters/"])
    assert len(found) > 100
    for mutation in found[::10]:
        text, tree = _read(mutation.file)
        assert ast.dump(ast.parse(mutated(mutation, text))) != tree
