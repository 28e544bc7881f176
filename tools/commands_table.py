"""Write the table of all commands by purpose into docs/commands.md, from what `vio --help` says of
them.

python -m tools.commands_table
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from vio.cli import BY_PURPOSE, command_module

PAGE = Path(__file__).resolve().parent.parent / "docs" / "commands.md"
_BEGIN = "<!-- commands -->\n"
_END = "<!-- end commands -->\n"


def table() -> str:
    """Return the table as Markdown."""
    rows = ["| | command | |", "|---|---|---|"]
    for purpose, names in BY_PURPOSE.items():
        commands = argparse.ArgumentParser().add_subparsers()
        for name in names:
            command_module(name).add_parser(commands)
        for k, action in enumerate(commands._choices_actions):
            rows.append(f"| {'' if k else purpose} | `vio {action.dest}` | {action.help} |")
    return "\n".join(rows) + "\n"


def with_table(text: str) -> str:
    """Return the page with the present table between its marks."""
    before, _, rest = text.partition(_BEGIN)
    return before + _BEGIN + table() + _END + rest.partition(_END)[2]


def main() -> int:
    """Rewrite the page."""
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
