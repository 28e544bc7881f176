"""`vio view`: show a finished run in rerun."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "view",
        help="show a finished run in rerun",
        description="Show a finished run again: path, covariance, curves, map; features where the "
        "run was made with "
        "--save-observations, and its images where the recording still is. Needs the extra view.",
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="a folder that `vio run` wrote")
    parser.add_argument(
        "where",
        nargs="?",
        default="spawn",
        metavar="WHERE",
        help="web, or a file *.rrd (default: a window)",
    )


def execute(args: argparse.Namespace) -> int:
    from vio.runs.finished import read_finished_run
    from vio.view.finished import show_finished_run
    from vio.view.stream import open_stream, wait_for_interrupt

    run = read_finished_run(args.run)
    stream, address = open_stream(args.where, run.name)
    show_finished_run(stream, run)
    if address is not None:
        wait_for_interrupt(address)
    elif args.where != "spawn":
        print(args.where)
    return 0
