"""docs/neighbours.md: every mark leads to a test or a finding that is there, and no finding is
left out.
"""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "neighbours.md").read_text(encoding="utf-8")
TABLES, _, TESTS = PAGE.partition("## What ran it")
MARKS = dict(re.findall(r'^\| <a id="\w+"></a>(T\d+) \| `([^`]+)`', TESTS, re.MULTILINE))
INDEX = re.findall(
    r"^\| (F\d+) \| `(\w+\.sh)`",
    (ROOT / "findings" / "README.md").read_text(encoding="utf-8"),
    re.MULTILINE,
)


def test_every_mark_of_a_test_is_a_link_to_what_ran_it() -> None:
    assert set(re.findall(r"\[(T\d+)\]\(#", TABLES)) == set(MARKS)
    assert re.findall(r"(?<![\w\[])[TF]\d+(?![\w\]])(?=[^\n]*\|$)", TABLES, re.MULTILINE) == []
    for mark, target in MARKS.items():
        file, _, test = target.partition("::")
        text = (ROOT / file).read_text(encoding="utf-8")
        assert not test or re.search(rf"^def {test}\(", text, re.MULTILINE), mark


def test_every_finding_is_marked_and_in_the_index() -> None:
    marks = [mark for mark, _ in INDEX]
    assert len(marks) == len(set(marks))
    assert set(re.findall(r"\[(F\d+)\](?!\()", TABLES)) == set(marks)
    assert sorted(script for _, script in INDEX) == sorted(
        path.name for path in (ROOT / "findings").glob("*.sh")
    )
