"""`vio target`: a board to print, and the file that describes it."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from vio.cli.output import print_result
from vio.errors import ConfigError

_SUFFIXES = (".svg", ".pdf")
_DEFAULTS = {
    # rows, columns, side in metres, ratio
    "aprilgrid": (6, 6, 0.03, 0.3),
    "charuco": (7, 10, 0.025, 0.75),
    "checkerboard": (7, 10, 0.025, 0.0),
}


_PAPERS_MM = {
    "A4": (210, 297),
    "A3": (297, 420),
    "A2": (420, 594),
    "A1": (594, 841),
    "A0": (841, 1189),
}


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "target",
        help="write a board to print, for calibrate-rig",
        description="Write a calibration board as SVG or PDF with a ruler below it, and beside it "
        "the YAML that describes it (Kalibr's where Kalibr has such boards). Print it without "
        "scaling, glue it to something flat, measure the side of a tag or square over many of "
        "them, and write what you measured into the YAML.",
    )
    parser.add_argument("out", type=Path, metavar="FILE", help="board.pdf or board.svg")
    parser.add_argument("--kind", choices=tuple(_DEFAULTS), default="aprilgrid")
    parser.add_argument("--rows", type=int, metavar="N", help="of tags or squares")
    parser.add_argument("--cols", type=int, metavar="N", help="of tags or squares")
    parser.add_argument("--size", type=float, metavar="M", help="side of a tag or square, metres")
    parser.add_argument(
        "--spacing",
        type=float,
        metavar="R",
        help="AprilGrid: gap between tags over their side; ChArUco: marker's side over the square's",
    )
    parser.add_argument(
        "--dictionary", metavar="NAME", help="of a ChArUco board (default DICT_5X5_100)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def _paper(width_mm: float, height_mm: float) -> str | None:
    """Return the smallest paper that holds a page; None: none does."""
    least, most = sorted((width_mm, height_mm))
    for name, (short, long) in _PAPERS_MM.items():
        if least <= short and most <= long:
            return name
    return None


def execute(args: argparse.Namespace) -> int:
    from vio.files.atomic import atomic_write_text, check_writable
    from vio.targets.description import APRILTAG, Target, target_text
    from vio.targets.printing import page_of, write_page

    if args.out.suffix.lower() not in _SUFFIXES:
        raise ConfigError(f"{args.out}: name it *.pdf or *.svg")
    check_writable(args.out)
    rows, cols, size_m, ratio = _DEFAULTS[args.kind]
    target = Target(
        args.kind,
        rows if args.rows is None else args.rows,
        cols if args.cols is None else args.cols,
        size_m if args.size is None else args.size,
        ratio if args.spacing is None else args.spacing,
        (args.dictionary or "DICT_5X5_100") if args.kind == "charuco" else APRILTAG,
    )
    page = page_of(target)
    write_page(target, args.out)
    paper = _paper(page.width, page.height)
    sheet = args.out.with_suffix(".yaml")
    atomic_write_text(sheet, target_text(target))
    facts = {
        "target": str(target),
        "page": str(args.out),
        "description": str(sheet),
        "width_mm": page.width,
        "height_mm": page.height,
        "paper": paper,
    }
    size = f"{page.width:.0f} x {page.height:.0f} mm"
    rows_out = [
        ("target", str(target)),
        ("page", f"{args.out}, {size}: print on {paper or 'paper larger than A0'} without scaling"),
        ("measure", f"the printed side, and write it into {sheet}"),
        ("next", f"vio calibrate-rig RECORDING --target {sheet}"),
    ]
    return print_result(facts, rows_out, as_json=args.json)
