"""Calibrations with a board from fixed corners, and corners of fixed images, are those of the last
commit that says why they changed; one that moves these figures renews the file by

    python -m tests.targets.test_same_results

and says in its message what moved and why. Those of images hold for one version of OpenCV.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.board_views import GRID, SMALL, SMALL_LEFT, Flaws, made_views
from vio.geometry.lie import se3_from_parts, so3_exp
from vio.targets.calibrate import calibrate_cameras
from vio.targets.corners import CornerDetector
from vio.targets.description import Target
from vio.targets.recording import Filmed
from vio.targets.rendering import BoardRenderer, Exposure

FILE = Path(__file__).with_name("same_results.json")
SIZE = (752, 480)
Figures = dict[str, float]


def _calibrated(seed: int, count: int, flaws: Flaws) -> Figures:
    """Return what is found, and how well it is known, of a pair."""
    filmed = Filmed(made_views(seed, count, flaws), (SIZE, SIZE), 40, None, ())
    done = calibrate_cameras(filmed, GRID, "radtan")
    found = done.found
    verdict = done.verdict
    halves = verdict.halves
    out = {
        "bow": float(np.linalg.norm(found.at.bow)),
        "corners": float(found.used.sum()),
        "residuals": float(np.linalg.norm(found.residuals_px[found.used])),
        "corner sigmas": float(np.linalg.norm(found.corner_sigma_px)),
        "covariance": float(np.linalg.norm(found.covariance)),
        "sigmas": float(np.sqrt(np.trace(found.covariance))),
        "depth": float(np.nanmean(verdict.depth_sigma_m)),
        "inflation": verdict.inflation,
        "halves": halves.ratio,
        "maps of halves": halves.map_ratio,
        "depth of halves": halves.depth_m,
        "findings": float(len(verdict.findings)),
    }
    for k, camera in enumerate(found.at.cameras):
        numbers = (camera.fu, camera.fv, camera.cu, camera.cv, *camera.coefficients)
        out |= {f"camera {k}, {n}": number for n, number in enumerate(numbers)}
        out[f"camera {k}, projection"] = float(np.mean(verdict.projection_sigma_px[k]))
        out[f"camera {k}, alone"] = done.alone_sigma_px[k]
    return out


def _detected(target: Target, blur_px: float) -> Figures:
    """Return how many corners are found in an image, and where."""
    R = so3_exp([0.3, -0.2, 0.1])
    centre = np.array([*(0.5 * np.array(target.extent_m)), 0.0])
    T = se3_from_parts(R, [0.01, 0.0, 0.9] - R @ centre)
    found = CornerDetector(target).detect(
        BoardRenderer(target, SMALL_LEFT).render(T, Exposure(blur_px, 2.0))
    )
    return {"corners": float(len(found)), "pixels": float(np.linalg.norm(found.uv))}


RUNS: dict[str, Callable[[], Figures]] = {
    "exact": lambda: _calibrated(3, 12, Flaws()),
    "bowed": lambda: _calibrated(4, 12, Flaws(0.1, (0.002, -0.001), 0.03)),
    "few": lambda: _calibrated(5, 9, Flaws(0.3, (0.0, 0.0), 0.0, 0.001)),
    "tags": lambda: _detected(SMALL, 0.6),
    "tags out of focus": lambda: _detected(SMALL, 2.0),
    "checkerboard": lambda: _detected(Target("checkerboard", 6, 9, 0.05), 0.8),
}


@pytest.mark.parametrize("name", RUNS)
def test_calibrations_are_those_of_the_last_change(name: str) -> None:
    kept = json.loads(FILE.read_text(encoding="utf-8"))
    if "pixels" in kept[name] and kept["OpenCV"] != cv2.__version__:
        pytest.skip("the figures are those of another version of OpenCV")
    assert RUNS[name]() == pytest.approx(kept[name], rel=1e-5, abs=1e-9)


if __name__ == "__main__":
    made = {"OpenCV": cv2.__version__, **{name: run() for name, run in RUNS.items()}}
    FILE.write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
