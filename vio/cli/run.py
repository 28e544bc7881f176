"""`vio run`: a recording in, a folder of results out."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def add_parser(commands: Any) -> None:
    """Add the subcommand."""
    parser = commands.add_parser(
        "run",
        help="process a recording",
        description="Process a recording and write a folder of results. The kind of SOURCE is seen from its content; "
        "'kind:path' forces it (kitti, kitti_raw, euroc, ece276a, utias, log).",
    )
    parser.add_argument("source", metavar="SOURCE", help="a recording: folder or file, or kind:path")
    add_config_arguments(parser)
    parser.add_argument("--reference", type=Path, metavar="F", help="ground truth (TUM, KITTI or EuRoC form)")
    parser.add_argument("--start", type=int, default=0, metavar="N", help="first frame (default 0)")
    parser.add_argument("--stop", type=int, metavar="N", help="frame after the last one")
    parser.add_argument("--lengths", type=lengths, metavar="M,M", help="path lengths of the drift (default 100,…,800)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the results (default runs/NAME)")
    parser.add_argument("--save-observations", action="store_true", help="also write what the front end saw")
    parser.add_argument("--json", action="store_true", help="print the metrics as one JSON object")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(execute=execute)


def add_config_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that change the configuration."""
    parser.add_argument(
        "--config", type=Path, metavar="F", help="YAML file with settings that differ from the defaults"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="a.b=c", help="change one setting; may be repeated"
    )
    parser.add_argument("--motion", metavar="NAME", help="imu, velocity, none or auto: same as --set motion=NAME")
    parser.add_argument("--backend", metavar="NAME", help="same as --set backend=NAME")
    parser.add_argument("--frontend", metavar="NAME", help="same as --set frontend.name=NAME")


def lengths(text: str) -> tuple[float, ...]:
    """Parse '25,50' into metres."""
    values = tuple(float(part) for part in text.split(","))
    if not values or any(not 0 < v < float("inf") for v in values):
        raise ValueError(text)
    return values


def config_from(args: argparse.Namespace) -> Any:
    """Build the configuration that the arguments ask for."""
    from vio.config import load_config

    overrides = list(args.set)
    for key, value in (("motion", args.motion), ("backend", args.backend), ("frontend.name", args.frontend)):
        if value is not None:
            # Quoted: to YAML a bare `none` is text but `null`, `on` or `no` would not be.
            overrides.append(f'{key}="{value}"')
    return load_config(args.config, overrides)


def execute(args: argparse.Namespace) -> int:
    """Run the subcommand."""
    from vio.cli.running import process

    config = config_from(args)
    metrics = process(
        args.source,
        config,
        out=args.out,
        reference=args.reference,
        start=args.start,
        stop=args.stop,
        lengths_m=args.lengths,
        save_observations=args.save_observations,
        progress=not args.quiet,
    )
    from vio.cli.running import report

    report(metrics, as_json=args.json)
    return 0
