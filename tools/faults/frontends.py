"""Which faults of the right camera are named, for each front end, and what they do to the path.

    python -m tools.faults.frontends --data DIR [--only RECORDING …] [--front-ends NAME …]
                                     [--faults NAME …]

Prints a table in Markdown: a row for each recording and front end, a column for each fault, with
the codes of the findings and the ATE in metres. `replayed` are the features of `klt` from the
recording without a fault, whose columns are changed as the fault does; the others see changed
images. `kornia` has its detector and descriptor that need no weights, and is left out where torch
is not installed. Codes that the recording without a fault gives as well are left out.
"""

from __future__ import annotations

import argparse
import importlib.util
import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tools.faults.cameras import Wall, frozen_images, late_images, moving_object, turned_right
from tools.faults.changes import Changed, Period, Variant, pairs, pairs_during
from tools.faults.columns import COLUMNS, changed_features, unchanged
from vio import evaluate, load_config, open_dataset
from vio.errors import VioError
from vio.protocols import Dataset
from vio.runs.pipeline import RunResult, run

FRONT_ENDS = ("klt", "orb", "sift", "kornia", "replayed")
FAULTS: dict[str, Variant] = {
    "right frozen": pairs(frozen_images, 1),
    "exchanged": pairs_during(lambda frame, left, right: (right, left)),
    "right dark": pairs_during(lambda frame, left, right: (left, np.full_like(right, 5))),
    "right late": pairs(late_images, 1),
    "right rolled": pairs(turned_right, 1.0, (0.0, 0.0, 1.0), all_along=False),
    "right yawed": pairs(turned_right, 0.5, (0.0, 1.0, 0.0), all_along=False),
    "object": pairs(moving_object, Wall(6.0)),
}


@dataclass(frozen=True, slots=True)
class Clip:
    """A recording, and the frames in which it has the fault."""

    source: str
    begin: int
    frames: int = 12

    def period(self, dataset: Dataset) -> Period:
        """The fault's period by the recording's clock."""
        times_ns = dataset.recording.frame_times_ns
        return Period(int(times_ns[self.begin]), int(times_ns[self.begin + self.frames]))


CLIPS = (Clip("kitti_06_head", 11), Clip("kitti_03_head", 21))


@dataclass(frozen=True, slots=True)
class Row:
    """One run of a clip."""

    codes: tuple[str, ...]  # of findings with an effect, each once
    ate_m: float | None  # None: the run failed
    error: str = ""

    def text(self, healthy: Row) -> str:
        """Return the row as a cell of the table, beside that of the recording without a fault."""
        if self.ate_m is None:
            return f"refused: {self.error[:60]}"
        new = [code for code in self.codes if self is healthy or code not in healthy.codes]
        return f"{', '.join(new) or '—'} {self.ate_m:.3f}"


def row_of(dataset: Dataset, name: str) -> Row:
    """Run a recording with a front end, and return what was found and how far it is off."""
    try:
        result = run(dataset, load_config(overrides=["motion=none", f"frontend.name={name}"]))
    except VioError as error:
        return Row((), None, f"{type(error).__name__}: {error}")
    return Row(_codes(result), _ate_m(result))


def _codes(result: RunResult) -> tuple[str, ...]:
    return tuple(dict.fromkeys(f.code for f in result.findings if not f.ended))


def _ate_m(result: RunResult) -> float:
    reference = result.recording.reference
    assert reference is not None
    return float(evaluate(result.trajectory, reference, T_cam0_imu=result.T_cam0_body).ate_m.rmse)


def replayed_rows(clip: Clip, dataset: Dataset, faults: Sequence[str]) -> dict[str, Row]:
    """Return the rows of the features that `klt` sees, changed by each fault."""
    config = load_config(overrides=["motion=none", "frontend.name=klt"])
    seen = run(dataset, config, keep_observations=True).observations
    assert seen is not None
    period = clip.period(dataset)
    rows = {}
    for name in ["healthy", *(fault for fault in faults if fault in COLUMNS)]:
        change = COLUMNS.get(name, unchanged)
        features = changed_features(dataset.recording, seen, change, period)
        rows[name] = row_of(features, "precomputed")
    return rows


def rows_of(clip: Clip, data: Path, front_end: str, faults: Sequence[str]) -> dict[str, Row]:
    """Return the rows of a front end by fault, that without one first."""
    dataset = open_dataset(data / clip.source)
    if front_end == "replayed":
        return replayed_rows(clip, dataset, faults)
    known = Changed(dataset, dataset.recording, iter)
    rows = {"healthy": row_of(known, front_end)}
    for name in faults:
        rows[name] = row_of(FAULTS[name](known, clip.period(dataset)), front_end)
    return rows


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="the recordings")
    parser.add_argument("--only", nargs="+", default=[], metavar="RECORDING")
    parser.add_argument("--front-ends", nargs="+", default=FRONT_ENDS, choices=FRONT_ENDS)
    parser.add_argument("--faults", nargs="+", default=list(FAULTS), choices=list(FAULTS))
    options = parser.parse_args()
    logging.basicConfig(level=logging.ERROR)
    heads = ["healthy", *options.faults]
    print(f"| recording, front end | {' | '.join(heads)} |")
    print("|---" * (len(heads) + 1) + "|")
    for clip in CLIPS:
        for front_end in options.front_ends:
            if options.only and clip.source not in options.only:
                continue
            if front_end == "kornia" and importlib.util.find_spec("kornia") is None:
                print(f"| {clip.source}, kornia | {' | '.join(['not installed'] * len(heads))} |")
                continue
            rows = rows_of(clip, options.data, front_end, options.faults)
            cells = [rows[head].text(rows["healthy"]) if head in rows else "" for head in heads]
            print(f"| {clip.source}, {front_end} | {' | '.join(cells)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
