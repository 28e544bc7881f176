"""Runs of rendered flights, whole and with faults, are those of the last commit that says why they
changed: features, estimates, and what was found at which frame. One that moves these figures renews
the file by

    python -m tests.runs.test_same_results

and says in its message what moved and why. They hold for one version of OpenCV, whose pixels differ
from version to version.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.commands import render
from tools.faults.cameras import CAMERAS
from tools.faults.changes import Changed, Period
from tools.faults.frontends import FAULTS
from tools.faults.healthy import HEALTHY
from tools.faults.imu import IMU
from vio.config import load_config
from vio.datasets import open_dataset
from vio.errors import VioError
from vio.protocols import Dataset
from vio.runs.pipeline import run

FILE = Path(__file__).with_name("same_results.json")
PERIOD = (18, 28)  # first frame of a fault, and first one after it
VARIANTS = {**HEALTHY, **CAMERAS, **FAULTS, **IMU}
CASES = [
    ("klt", "imu", "clean"),
    *[("orb", "none", case) for case in ("clean", "right frozen", "right rolled")],
    *[
        ("klt", "none", case)
        for case in (
            "clean",
            "snow",
            "right frozen",
            "exchanged",
            "right late",
            "right rolled",
            "object",
            "left frozen",
            "both frozen",
            "slow object",
            "right yaw later",
            "right shaking",
            "every 10th repeated",
            "no frames",
        )
    ],
    *[
        ("klt", "imu", case)
        for case in (
            "zero",
            "silent",
            "spikes",
            "axes exchanged",
            "accelerometer in g",
            "bias jump",
            "gyro clipped",
            "vibration",
        )
    ],
]


def _flight(folder: Path) -> Dataset:
    options = {"rig": "small", "width": "224", "rate": "15", "duration": "3.4", "format": "euroc"}
    return open_dataset(render(folder / "flight", **options, realism="real", seed="3"))


def _period(dataset: Dataset) -> Period:
    times_ns = dataset.recording.frame_times_ns
    return Period(int(times_ns[PERIOD[0]]), int(times_ns[PERIOD[1]]))


def _figures(dataset: Dataset, front_end: str, motion: str, case: str) -> dict[str, Any]:
    config = load_config(overrides=[f"motion={motion}", f"frontend.name={front_end}"])
    known = Changed(dataset, dataset.recording, iter)
    try:
        done = run(VARIANTS[case](known, _period(dataset)), config, keep_observations=True)
    except VioError as error:
        return {"findings": [type(error).__name__]}
    seen = done.observations
    assert seen is not None
    positions = done.trajectory.positions
    return {
        "features": sum(len(frame) for frame in seen),
        "right": sum(int(frame.has_right.sum()) for frame in seen),
        "ids": max(int(frame.ids.max(initial=0)) for frame in seen),
        "pixels": sum(float(np.linalg.norm(frame.z[:, :2])) for frame in seen),
        "moved": float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()),
        "end": float(np.linalg.norm(positions[-1])),
        "findings": [f"{f.code} {f.frame} {f.since} {f.ended}" for f in done.findings],
    }


def _all(dataset: Dataset) -> dict[str, dict[str, Any]]:
    return {", ".join(case): _figures(dataset, *case) for case in CASES}


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A small flight as a camera and an IMU see it, rendered."""
    return _flight(tmp_path_factory.mktemp("same"))


@pytest.mark.parametrize("case", CASES, ids=", ".join)
def test_runs_are_those_of_the_last_change(case: tuple[str, str, str], flight: Dataset) -> None:
    kept = json.loads(FILE.read_text(encoding="utf-8"))
    if kept["OpenCV"] != cv2.__version__:
        pytest.skip(f"the figures are those of OpenCV {kept['OpenCV']}")
    found = _figures(flight, *case)
    expected = kept[", ".join(case)]
    assert found.pop("findings") == expected.pop("findings")
    assert found == pytest.approx(expected, rel=1e-6)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        made = {"OpenCV": cv2.__version__, **_all(_flight(Path(place)))}
    FILE.write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
