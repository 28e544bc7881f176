"""`vio config`: every setting with unit and default."""

from __future__ import annotations

import argparse
from typing import Any

from vio.cli.arguments import add_config_arguments, config_from


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = commands.add_parser(
        "config", help="show or check settings", description="Show every setting, or check and print a configuration."
    )
    parser.add_argument("--show", action="store_true", help="a table of every setting: default, unit, meaning")
    add_config_arguments(parser)
    parser.set_defaults(execute=execute)


def execute(args: argparse.Namespace) -> int:
    """Run the subcommand: a table with --show, else the effective configuration as YAML."""
    from vio.config import describe, to_yaml

    config = config_from(args)
    if not args.show:
        print(to_yaml(config), end="")
        return 0
    import textwrap

    for row in describe(config):
        value = f"{row.default:g}" if isinstance(row.default, float) else str(row.default)
        unit = f" {row.unit}" if row.unit else ""
        print(f"{row.key} = {value}{unit}")
        lines = textwrap.wrap(row.doc, 100)
        if row.choices:
            lines.append(f"one of: {', '.join(row.choices)}")
        if row.range:
            lines.append(row.range)
        for line in lines:
            print(f"    {line}")
    return 0
