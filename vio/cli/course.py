"""`vio course`: copy the exercises of the course."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from vio.cli.arguments import examples


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "course",
        help="copy the exercises of the course",
        description="Copy the notebooks of the course into a folder: an EKF on SE(3), and what "
        "consistency means, with tasks that check themselves. A file that you have changed is "
        "never replaced.",
        **examples(
            "vio course  # into the folder course, for students",
            "vio course exercises --solutions  # with solutions, for the lecturer",
        ),
    )
    parser.add_argument(
        "out",
        type=Path,
        nargs="?",
        default=Path("course"),
        metavar="DIR",
        help="folder (default course)",
    )
    parser.add_argument("--solutions", action="store_true", help="copy the solutions as well")


def execute(args: argparse.Namespace) -> int:
    from vio.course import copy_course

    for path in copy_course(args.out, solutions=args.solutions):
        print(path)
    return 0
