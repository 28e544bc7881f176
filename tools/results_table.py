"""One table of every method on every recording: the figures of docs/results.md.

    python tools/results_table.py RECORDING[=REFERENCE] … [--lengths 25,50] [--json FILE]

Each recording is run whole, from its images where it has some, by every method that it has the sensors for: dead
reckoning (velocities alone), the paper's filter, and the sliding window, with and without motion sensor. ATE in
metres after SE(3) alignment, KITTI drift in per cent and degrees per 100 m, times in ms a frame (medians).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vio.config import Config, load_config
from vio.datasets import open_dataset
from vio.errors import VioError
from vio.evaluation import Evaluation
from vio.pipeline import run
from vio.records import Recording
from vio.run_folder import score
from vio.threads import one_blas_thread
from vio.trajectory_io import read_trajectory

_HEAD = "| recording | method | ATE m | t % | deg/100 m | read | front end | select | filter | 95 % |"


def main() -> int:
    """Run everything and print markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", metavar="RECORDING[=REFERENCE]")
    parser.add_argument("--lengths", default="100,200,300,400,500,600,700,800", help="path lengths of the drift, m")
    parser.add_argument("--stop", type=int, default=None, help="frame after the last one")
    parser.add_argument("--json", type=Path, default=None, help="also write the rows to this file")
    args = parser.parse_args()

    lengths = [float(x) for x in args.lengths.split(",")]
    rows: list[dict[str, Any]] = []
    sys.stdout.write(f"{_HEAD}\n|---|---|---:|---:|---:|---:|---:|---:|---:|---:|\n")
    for text in args.recordings:
        source, _, reference = text.partition("=")
        for row in _rows(source, reference or None, lengths, args.stop):
            rows.append(row)
            sys.stdout.write(_line(row) + "\n")
            sys.stdout.flush()
    if args.json is not None:
        args.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 0


def _methods(recording: Recording) -> Iterator[tuple[str, Config]]:
    """Name and configuration of every method that a recording allows."""
    yield "paper's filter, images alone", load_config(None, ["backend=vislam", 'motion="none"'])
    if "velocity" in recording.motion:
        yield "paper's filter, velocities", load_config(None, ["backend=vislam", "motion=velocity"])
    yield "sliding window, images alone", load_config(None, ['motion="none"'])
    for source, name in (("velocity", "velocities"), ("imu", "IMU")):
        if source in recording.motion:
            yield f"sliding window, {name}", load_config(None, [f"motion={source}"])


def _rows(source: str, reference: str | None, lengths: list[float], stop: int | None) -> Iterator[dict[str, Any]]:
    """One dictionary for each method."""
    dataset = open_dataset(source)
    truth = dataset.recording.reference if reference is None else read_trajectory(Path(reference))
    told_dead_reckoning = False
    for method, config in _methods(dataset.recording):
        try:
            with one_blas_thread():
                result = run(open_dataset(source, config.dataset), config, stop=stop)
        except VioError as error:
            yield {"recording": Path(source).name, "method": method, "failed": str(error)}
            continue
        own, dead_reckoning = score(result, truth, lengths_m=lengths)
        if dead_reckoning is not None and not told_dead_reckoning:
            told_dead_reckoning = True
            yield {"recording": Path(source).name, "method": "dead reckoning", **_accuracy(dead_reckoning)}
        frames = result.frames[1:]
        stages = {s: [getattr(f, f"{s}_ms") for f in frames] for s in ("read", "frontend", "select", "filter")}
        yield {
            "recording": Path(source).name,
            "method": method,
            **_accuracy(own),
            **{f"{name}_ms": float(np.median(values)) for name, values in stages.items()},
            "frame_ms_95": float(np.percentile(np.sum(list(stages.values()), axis=0), 95)),
        }


def _accuracy(evaluation: Evaluation | None) -> dict[str, float | None]:
    if evaluation is None:
        return {"ate_m": None, "t_percent": None, "r_deg_per_100m": None}
    told = evaluation.as_dict()
    return {
        "ate_m": told["ate_m"],
        "t_percent": told["t_err_percent"],
        "r_deg_per_100m": told["r_err_deg_per_100m"],
    }


def _line(row: dict[str, Any]) -> str:
    if "failed" in row:
        return f"| {row['recording']} | {row['method']} | lost: {row['failed']} | | | | | | | |"

    def cell(key: str, digits: int) -> str:
        value = row.get(key)
        return "–" if value is None else f"{value:.{digits}f}"

    accuracy = [cell("ate_m", 4), cell("t_percent", 2), cell("r_deg_per_100m", 2)]
    times = [cell(f"{s}_ms", 1) for s in ("read", "frontend", "select", "filter")]
    return "| " + " | ".join([row["recording"], row["method"], *accuracy, *times, cell("frame_ms_95", 0)]) + " |"


if __name__ == "__main__":
    sys.exit(main())
