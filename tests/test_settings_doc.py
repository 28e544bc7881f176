"""docs/settings.md lists the settings that there are: no more, no fewer, with today's defaults and units."""

from __future__ import annotations

import re
from pathlib import Path

from vio.config import Config, as_dict, describe

PAGE = Path(__file__).resolve().parent.parent / "docs" / "settings.md"
ROW = re.compile(r"^\| `([a-z0-9_.]+)` \| (.*) \|$", re.MULTILINE)
UNMOVED = "## What changed no pose\n"
WORDS = {None: "null", True: "true", False: "false"}


def rows() -> dict[str, list[str]]:
    """The cells of each setting's row in its section's table."""
    head, _, rest = PAGE.read_text(encoding="utf-8").partition(UNMOVED)
    sections = head + rest.partition("\n## ")[2]
    found = [(match[1], re.split(r" ?(?<!\\)\| ?", match[2])) for match in ROW.finditer(sections)]
    assert len(dict(found)) == len(found), "a setting has two rows"
    return dict(found)


def test_every_setting_has_a_row_and_no_row_names_one_that_is_gone() -> None:
    keys = {info.key for info in describe(Config())}
    assert rows().keys() == keys
    unmoved = PAGE.read_text(encoding="utf-8").partition(UNMOVED)[2].partition("\n## ")[0]
    assert {match[1] for match in ROW.finditer(unmoved)} <= keys


def test_defaults_and_units_are_todays() -> None:
    table = rows()
    plain = as_dict(Config())
    for info in describe(Config()):
        default = plain
        for part in info.key.split("."):
            default = default[part]
        shown = f"{default:.6g}" if isinstance(default, float) else str(default)
        if default is None or isinstance(default, bool):
            shown = WORDS[default]
        assert table[info.key][:2] == [shown, info.unit], info.key
