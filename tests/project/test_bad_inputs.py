"""The site's page of bad inputs lists what the tests make: no more, no fewer."""

from __future__ import annotations

import re

import pytest

pytest.importorskip("rosbags", reason="needs rosbags")

from tools.bad_inputs import MODULES, cases, page


def test_every_case_has_a_row_with_its_message() -> None:
    sections = re.split(r"^## ", page(), flags=re.MULTILINE)[1:]
    rows = {
        section.splitlines()[0]: re.findall(r"^\| (.+?) \| (.+) \|$", section, re.MULTILINE)[1:]
        for section in sections
    }
    labels = {title: [label for label, _ in found] for title, found in rows.items()}
    assert labels == {title: list(cases(module)) for module, title in MODULES.items()}
    assert sum(map(len, rows.values())) >= 40
    assert not [message for found in rows.values() for _, message in found if len(message) < 15]
