"""docs/settings.md lists the settings that there are: no more, no fewer, with today's defaults
and units.
"""

from __future__ import annotations

from pathlib import Path

from tools import commands_table
from tools.settings_page import page
from vio.cli import COMMANDS
from vio.config import BASIC, Config, describe

PAGE = Path(__file__).resolve().parents[2] / "docs" / "settings.md"


def test_page_is_that_of_todays_settings() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), (
        "run: python tools/settings_page.py > docs/settings.md"
    )


def test_every_setting_has_one_row_and_about_twenty_are_basic() -> None:
    keys = [info.key for info in describe(Config())]
    text = page()
    assert [text.count(f"\n| `{key}` |") for key in keys] == [1] * len(keys)
    basic = text.partition("\n## Others")[0]
    assert [key for key in keys if f"\n| `{key}` |" in basic] == list(BASIC)
    assert 15 <= len(BASIC) <= 25


def test_the_table_of_commands_is_that_of_todays_commands() -> None:
    text = commands_table.PAGE.read_text(encoding="utf-8")
    assert commands_table.with_table(text) == text, "run: python -m tools.commands_table"
    assert commands_table.table().count("`vio ") == len(COMMANDS) == len(set(COMMANDS))
