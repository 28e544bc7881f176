"""`vio config`: the settings with unit and default."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from vio.cli.arguments import add_config_arguments, config_from

if TYPE_CHECKING:
    from vio.config import SettingInfo


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "config",
        help="show or check settings",
        description="Show the settings, or check and print a configuration.",
    )
    parser.add_argument(
        "--show", action="store_true", help="the basic settings: value, unit, meaning"
    )
    parser.add_argument("--all", action="store_true", help="every setting, in groups")
    add_config_arguments(parser)


def execute(args: argparse.Namespace) -> int:
    """Run the subcommand: a table with --show or --all, else the effective configuration as
    YAML.
    """
    from vio.config import BASIC, describe, to_yaml

    config = config_from(args)
    if not (args.show or args.all):
        print(to_yaml(config), end="")
        return 0
    rows = list(describe(config))
    if args.all:
        shown = rows
    else:
        shown = [row for row in rows if row.key in BASIC]
    _print_by_group(shown)
    if len(shown) < len(rows):
        print(f"# {len(rows) - len(shown)} more: vio config --all")
    return 0


def _print_by_group(rows: Sequence[SettingInfo]) -> None:
    """Print the rows of each group under its name."""
    for group in dict.fromkeys(row.group for row in rows):
        print(f"# {group}")
        _print_rows(row for row in rows if row.group == group)


def _print_rows(rows: Iterable[SettingInfo]) -> None:
    for row in rows:
        if isinstance(row.default, float):
            value = f"{row.default:g}"
        else:
            value = str(row.default)
        unit = f" {row.unit}" if row.unit else ""
        print(f"{row.key} = {value}{unit}")
        lines = textwrap.wrap(row.doc, 100)
        if row.choices:
            lines.append(f"one of: {', '.join(row.choices)}")
        if row.range:
            lines.append(row.range)
        for line in lines:
            print(f"    {line}")
