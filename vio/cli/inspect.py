"""`vio inspect`: examine a recording before a run."""

from __future__ import annotations

import argparse
import shlex
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from vio.cli.arguments import (
    add_config_arguments,
    add_span_arguments,
    config_from,
    config_words,
    examples,
)
from vio.cli.output import ProgressBar, print_result
from vio.errors import ConfigError

if TYPE_CHECKING:
    from vio.inspection.finding import Inspection


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "inspect",
        help="examine a recording before a run",
        description="Say what was found in a recording and how it was understood: clocks, "
        "calibration, images, stereo "
        "rows or depths, IMU (units, standstill, gravity, noise against the data sheet, agreement "
        "with images), ground "
        "truth, and what is missing. Exit status 1 where a run makes no sense, with the remedy.",
        **examples(
            "vio inspect cameras  # a folder of images with a calibration",
            "vio inspect flight.bag --topics left=/cam0/image_raw,right=/cam1/image_raw  # a ROS bag",
            "vio inspect cameras --start 60s --stop 90s --pairs 30  # a part of it, closely",
        ),
    )
    parser.add_argument(
        "source", metavar="SOURCE", help="a recording: folder or file, or kind:path"
    )
    add_config_arguments(parser)
    add_span_arguments(parser)
    parser.add_argument(
        "--pairs", type=int, default=12, metavar="N", help="frames looked at (default 12)"
    )
    parser.add_argument(
        "--frames", type=int, default=60, metavar="N", help="frames tracked (default 60; 0: none)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def execute(args: argparse.Namespace) -> int:
    from vio.datasets import open_dataset
    from vio.datasets.frame_times import frames_between
    from vio.frontend import build_frontend
    from vio.guard.guarded import guarded
    from vio.inspection.inspect import inspect_recording
    from vio.numerics.threads import one_blas_thread

    if args.pairs < 1 or args.frames < 0:
        raise ConfigError("--pairs must be at least 1, and --frames at least 0")
    config = config_from(args)
    # A limit on the frame rate is a run's: here any frame may be looked at.
    dataset = open_dataset(args.source, replace(config.dataset, max_frame_rate=None))
    recording = dataset.recording
    span = frames_between(recording, args.start, args.stop)
    with one_blas_thread(), ProgressBar(f"inspect {recording.path.name}") as bar:
        report = inspect_recording(
            dataset,
            lambda d: guarded(
                build_frontend(config.frontend.name, d.recording.camera, config.frontend, d),
                d.recording.camera,
                checks=config.frontend.checks,
            ),
            pairs=args.pairs,
            tracked=args.frames,
            span=span,
            begin=lambda part: bar.begin(f"inspect {recording.path.name}: {part}"),
            progress=bar.update,
        )
    facts = {"source": str(recording.path), "kind": recording.kind, **_facts(report)}
    title = ("recording", f"{recording.path} (kind {recording.kind})")
    run = shlex.join(["vio", "run", args.source, *config_words(args)])
    print_result(facts, [title, *_rows(report, run)], as_json=args.json, name_width=20)
    return 1 if report.faults else 0


def _facts(report: Inspection) -> dict[str, Any]:
    from vio.records import doubts_among

    return {
        "parts": {part.name: dict(part.facts) for part in report.parts},
        "faults": list(report.faults),
        "doubts": list(doubts_among(report.notes)),
        "notes": list(report.notes),
    }


def _rows(report: Inspection, run: str) -> list[tuple[str, str]]:
    from vio.records import doubts_among

    rows = [(part.name, part.text) for part in report.parts]
    doubts = doubts_among(report.notes)
    rows += [("note", note) for note in report.notes if note not in doubts]
    rows += [("DOUBT", note) for note in doubts]
    rows += [("FAULT", fault) for fault in report.faults]
    if report.faults:
        return rows
    verdict = "can be run; settle the doubt above first" if doubts else "can be run"
    return [*rows, ("verdict", verdict), ("next", run)]
