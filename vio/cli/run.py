"""`vio run`: process a recording, and write a folder of results."""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vio.cli.arguments import (
    add_config_arguments,
    add_lengths_argument,
    add_span_arguments,
    config_from,
    examples,
)
from vio.cli.output import print_result
from vio.errors import NOTE, ConfigError

if TYPE_CHECKING:
    from vio.cli.running import Shown

log = logging.getLogger(__name__)


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "run",
        help="process a recording",
        description="Process a recording and write a folder of results. The kind of SOURCE is "
        "detected from its content; 'kind:path' sets it (kitti, kitti_raw, euroc, plain, mono, "
        "rgbd, bag, video, ece276a, utias, gtsam, log).",
        **examples(
            "vio run dataset/sequences/07 --report --open  # and show the page about it",
            "vio run MH_01_easy --motion none --out images_alone  # without the IMU",
            "vio run flight.bag --calibration rig.yaml --map yard.map  # close loops in a map",
        ),
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "source", metavar="SOURCE", nargs="?", help="a recording: folder or file, or kind:path"
    )
    what.add_argument(
        "--resume", type=Path, metavar="RUN", help="go on with the unfinished run in this folder"
    )
    add_config_arguments(parser)
    parser.add_argument(
        "--reference", type=Path, metavar="F", help="ground truth (TUM, KITTI or EuRoC format)"
    )
    add_span_arguments(parser)
    add_lengths_argument(parser)
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the results (default runs/NAME)"
    )
    parser.add_argument(
        "--save-observations", action="store_true", help="also write the front end's observations"
    )
    parser.add_argument(
        "--map", type=Path, metavar="FILE", help="begin or continue a map: loops are closed in it"
    )
    parser.add_argument(
        "--map-density",
        type=int,
        metavar="N",
        help="keep features of N keyframes in a cubic metre of the map (all)",
    )
    parser.add_argument(
        "--save-calibration",
        type=Path,
        nargs="?",
        const=Path(),
        metavar="FILE",
        help="write the calibration with what the run found it to be off by, for --calibration of "
        "the next run "
        "(Kalibr's format; default camchain-imucam.yaml in the folder of results)",
    )
    parser.add_argument(
        "--view",
        nargs="?",
        const="spawn",
        metavar="WHERE",
        help="show the run in rerun: in a window, in a browser (web), or into a file *.rrd (extra "
        "view)",
    )
    parser.add_argument("--no-plot", action="store_true", help="do not draw trajectory.png")
    parser.add_argument(
        "--report", action="store_true", help="also write report.html, as `vio report` does"
    )
    parser.add_argument("--open", action="store_true", help="with --report: show it in the browser")
    parser.add_argument("--json", action="store_true", help="print the metrics as one JSON object")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


_OF_A_NEW_RUN = (
    "reference", "start", "stop", "lengths", "out", "save_observations", "map_density", "view",
    "no_plot", "set", "config", "motion", "backend", "frontend", "calibration", "camera", "topics",
)  # fmt: skip


def execute(args: argparse.Namespace) -> int:
    from vio.cli.running import RunOptions, Shown, metric_rows, process

    _check_combinations(args)

    def finished(metrics: dict[str, Any]) -> None:
        rows = metric_rows(metrics, plot=not args.no_plot, reported=args.report)
        print_result(metrics, rows, as_json=args.json)
        sys.stdout.flush()

    shown = Shown(not args.quiet, args.view, finished)
    own = None
    # no name of a setting
    if args.frontend is not None and (":" in args.frontend or args.frontend.endswith(".py")):
        own = args.frontend
        args.frontend = None
    if args.resume is not None:
        _resume(args, own, shown)
        return _reported(args.resume, args) if args.report else 0
    options = RunOptions(
        out=args.out,
        reference=args.reference,
        start=args.start,
        stop=args.stop,
        lengths_m=args.lengths,
        save_observations=args.save_observations,
        save_calibration=args.save_calibration,
        map_file=args.map,
        map_density=args.map_density,
        plot=not args.no_plot,
        frontend=own,
        command=args.command_line,
    )
    metrics = process(args.source, config_from(args), options, shown)
    if not args.report:
        return 0
    return _reported(Path(metrics["out"]), args)


def _check_combinations(args: argparse.Namespace) -> None:
    """Raise ConfigError where an option is given without the one that it belongs to."""
    if args.open and not args.report:
        raise ConfigError("--open shows the page of --report; give both")
    mapped = args.map is not None or args.resume is not None
    if args.map_density is not None and (not mapped or args.map_density < 1):
        raise ConfigError("--map-density is of a --map, and at least 1")


def _resume(args: argparse.Namespace, frontend: str | None, shown: Shown) -> None:
    """Go on with an unfinished run.

    Raises:
        ConfigError: options are given that are those of a new run.
    """
    from vio.cli.running import resume

    given = [f"--{name.replace('_', '-')}" for name in _OF_A_NEW_RUN if getattr(args, name)]
    if given:
        raise ConfigError(f"--resume goes on as the run began; leave out {', '.join(given)}")
    resume(
        args.resume,
        save_calibration=args.save_calibration,
        map_file=args.map,
        frontend=frontend,
        shown=shown,
    )


def _reported(folder: Path, args: argparse.Namespace) -> int:
    """Write the page about a run, say where it is, and show it in a browser."""
    from vio.cli.report import write

    page = write([folder], shown=args.open)
    if args.json:  # of which stdout holds one object
        log.log(NOTE, "report: %s", page)
    else:
        print_result({}, [("report", str(page))], as_json=False)
    return 0
