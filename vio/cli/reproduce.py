"""`vio reproduce`: the paper's experiment on the ECE276A files."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

from vio.cli.arguments import examples
from vio.cli.waiting import working
from vio.errors import NOTE
from vio.files.printable import json_text

log = logging.getLogger(__name__)


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "reproduce",
        help="repeat the paper's experiment",
        description="Repeat the paper's experiment on ECE276A .npz files: dead reckoning, mapping, "
        "SLAM with all "
        "features and with the most seen 1/7, and the recommended setting. For each drive one "
        "table, a figure of all paths, and the paper's three figures (dead reckoning, landmarks, "
        "all features against 1/7), each beside ours. About 3 minutes a drive.",
        **examples(
            "vio reproduce 0027.npz=poses_07.txt  # the course's drive with its ground truth",
            "vio reproduce 0022.npz 0027.npz --out figures  # without ground truth",
        ),
    )
    parser.add_argument(
        "files",
        nargs="+",
        metavar="FILE[=REF]",
        help="an .npz file, with its ground truth after '='",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("reproduce"),
        metavar="DIR",
        help="folder (default reproduce)",
    )
    parser.add_argument("--json", action="store_true", help="print the table as one JSON object")


def execute(args: argparse.Namespace) -> int:
    from vio.offline.reproduce import reproduce

    now = "reproduce"

    def say(text: str) -> None:
        nonlocal now
        now = text
        log.log(NOTE, "%s", text)

    with working(lambda: now):
        tables = [reproduce(*_split(text), args.out, say) for text in args.files]
    if args.json:
        print(json_text([table.as_dict() for table in tables]))
    else:
        for table in tables:
            print(table.as_text())
    return 0


def _split(text: str) -> tuple[Path, Path | None]:
    file, equals, reference = text.partition("=")
    return Path(file), Path(reference) if equals else None
