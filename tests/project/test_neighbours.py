"""docs/neighbours.md: every mark leads to a test or a finding that is there, and no finding is
left out.
"""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "neighbours.md").read_text(encoding="utf-8")
MARKS = dict(re.findall(r'^\| <a id="\w+"></a>(\w+) \| `([^`]+)`', PAGE, re.MULTILINE))
FINDINGS = sorted(path.name for path in (ROOT / "findings").glob("*.sh"))


def test_every_mark_is_a_link_to_what_ran_it() -> None:
    tables = PAGE.split("## What ran it")[0]
    used = set(re.findall(r"\[([TF]\d+)\]\(#", tables))
    assert used == set(MARKS)
    assert re.findall(r"(?<![\w\[])[TF]\d+(?![\w\]])(?=[^\n]*\|$)", tables, re.MULTILINE) == []
    for mark, target in MARKS.items():
        file, _, test = target.partition("::")
        text = (ROOT / file).read_text(encoding="utf-8")
        assert not test or re.search(rf"^def {test}\(", text, re.MULTILINE), mark


def test_every_finding_is_marked_and_in_the_index() -> None:
    assert sorted(Path(target).name for target in MARKS.values() if target.endswith(".sh")) == (
        FINDINGS
    )
    index = (ROOT / "findings" / "README.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^\| `(\w+\.sh)`", index, re.MULTILINE)) == FINDINGS
