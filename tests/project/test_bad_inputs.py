"""docs/bad_inputs.md lists the bad inputs that the tests make: no more, no fewer."""

from __future__ import annotations

import re

import pytest

from tools.bad_inputs import MODULES, PAGE, cases


def test_every_case_has_a_row_and_every_row_a_case() -> None:
    pytest.importorskip("rosbags", reason="needs rosbags")
    sections = re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    titles = {
        section.splitlines()[0]: re.findall(r"^\| (.+?) \| ", section, re.MULTILINE)[1:]
        for section in sections
    }
    assert titles == {title: list(cases(module)) for module, title in MODULES.items()}
    assert sum(map(len, titles.values())) >= 40
