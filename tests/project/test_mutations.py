"""The mutations of `tools/mutations.txt` apply to the present code; `tools/mutate.py` runs the
tests on them.
"""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

from tools.mutate import MUTATIONS, Mutation, MutationError, mutated, read_mutations, run_tests

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
