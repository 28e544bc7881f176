"""The list of deliberate mistakes in `tools/mutations.py` fits the code as it is; `tools/mutate.py` makes them."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

from tools.mutate import MutationError, mutated, run_tests
from tools.mutations import MUTATIONS, Mutation

ROOT = Path(__file__).resolve().parent.parent


@cache
def _read(file: str) -> tuple[str, str]:
    text = (ROOT / file).read_text(encoding="utf-8")
    return text, ast.dump(ast.parse(text))


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda m: m.name)
def test_every_mistake_can_still_be_made(mutation: Mutation) -> None:
    text, tree = _read(mutation.file)
    spoiled = mutated(mutation, text)  # the old text occurs exactly once
    assert ast.dump(ast.parse(spoiled)) != tree, "a mistake in a comment is none"
    assert "\n" not in mutation.old
    missing = [name for name in mutation.tests if not (ROOT / name).is_file()]
    assert not missing


def test_names_tell_the_mistakes_apart() -> None:
    assert len({m.name for m in MUTATIONS}) == len(MUTATIONS)
    assert len({(m.file, m.old, m.new) for m in MUTATIONS}) == len(MUTATIONS)


@pytest.mark.parametrize("text", ["a = 2\n", "a = 1\nb = 1\n"])
def test_a_text_that_is_gone_or_not_alone_is_an_error(text: str) -> None:
    with pytest.raises(MutationError, match=r"'= 1' occurs \d times in x.py"):
        mutated(Mutation("one", "x.py", "= 1", "= 3", ()), text)


def test_another_package_than_the_copy_is_an_error(tmp_path: Path) -> None:
    """An empty folder holds no vio, so the installed one would be tested instead."""
    with pytest.raises(MutationError, match="instead of"):
        run_tests(tmp_path, ["tests/test_lie.py"])
