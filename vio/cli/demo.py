"""`vio demo`: render a stereo recording, process it, and print errors and the path of the plot."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from vio.cli.output import ProgressBar, print_result


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "demo",
        help="render a small recording and process it",
        description="Render a stereo recording with ground truth, process it from the images, and "
        "print the errors.",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("demo"), metavar="DIR", help="folder (default demo)"
    )
    parser.add_argument("--json", action="store_true", help="print the metrics as one JSON object")


def execute(args: argparse.Namespace) -> int:
    from vio.cli.running import RunOptions, check_out, metric_rows, process
    from vio.config import load_config
    from vio.live.first_use import compiled_beside
    from vio.sim.scenarios import write_demo_recording

    check_out(args.out / "run")
    with compiled_beside(("frontend", "filter"), "velocity"):  # while the street is rendered
        with ProgressBar("rendering the street", announced=True) as bar:
            recording = write_demo_recording(args.out / "street", bar.update)
        metrics = process(str(recording), load_config(), RunOptions(out=args.out / "run"))
    return print_result(metrics, metric_rows(metrics), as_json=args.json)
