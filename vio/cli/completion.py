"""`vio completion`: a script that completes the command line in a shell."""

from __future__ import annotations

import argparse
from typing import Any

_SHELLS = ("bash", "zsh", "tcsh")


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "completion",
        help="print a script that completes commands and options in a shell",
        description="Print a script that completes commands, options and their choices in a shell. "
        "bash: put "
        '`eval "$(vio completion bash)"` into ~/.bashrc; zsh: `vio completion zsh > DIR/_vio` for '
        "a DIR of $fpath.",
    )
    parser.add_argument("shell", choices=_SHELLS)


def execute(args: argparse.Namespace) -> int:
    import shtab

    from vio.cli import build_parser

    print(shtab.complete(build_parser(), shell=args.shell))
    return 0
