"""`vio localise`: find the poses of a recording in a map."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from vio.cli.arguments import add_config_arguments, add_span_arguments, config_from
from vio.cli.output import print_result


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "localise",
        help="find a recording's poses in a map",
        description="Process a recording and find its poses in a map, which is left as it is. The "
        "folder of results "
        "holds map_causal.tum, the poses in the map's frame of all frames whose place was known at "
        "the time, "
        "map_covariance.npy, their covariances, and map_trajectory.tum, all poses as known at the "
        "end.",
    )
    parser.add_argument(
        "source", metavar="RECORDING", help="a recording: folder or file, or kind:path"
    )
    parser.add_argument(
        "--map", type=Path, required=True, metavar="FILE", help="a map that vio run --map made"
    )
    add_config_arguments(parser)
    add_span_arguments(parser)
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the results (default runs/NAME)"
    )
    parser.add_argument("--json", action="store_true", help="print the metrics as one JSON object")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def execute(args: argparse.Namespace) -> int:
    from vio.cli.running import RunOptions, Shown, metric_rows, process

    options = RunOptions(
        out=args.out, start=args.start, stop=args.stop, map_file=args.map, localise=True
    )
    shown = Shown(progress=not args.quiet)
    metrics = process(args.source, config_from(args), options, shown)
    return print_result(metrics, metric_rows(metrics), as_json=args.json)
