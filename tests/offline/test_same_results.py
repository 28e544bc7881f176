"""The map and the mesh of a rendered flight are those of the last commit that says why they changed;
one that moves these figures renews the file by

    python -m tests.offline.test_same_results

and says in its message what moved and why. They hold for one version of OpenCV.
"""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.commands import render
from vio.cli import main
from vio.files.trajectories import read_trajectory

FILE = Path(__file__).with_name("same_results.json")
Figures = dict[str, float]


def _json(*arguments: str | Path) -> dict[str, Any]:
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        assert main([*map(str, arguments), "--json"]) == 0
    found: dict[str, Any] = json.loads(out.getvalue())
    return found


def _figures(folder: Path) -> Figures:
    options = {"rig": "small", "width": "224", "rate": "15", "duration": "3.4", "format": "euroc"}
    flight = render(folder / "flight", **options, realism="real", seed="3")
    done = folder / "run"
    _json("run", flight, "--out", done, "--map", folder / "one.map", "--no-plot")
    mesh = _json("mesh", done)
    covariance = np.load(done / "map_covariance.npy")
    positions = read_trajectory(done / "map_trajectory.tum").positions
    return {
        "keyframes": float(len(np.load(done / "map_keyframes_covariance.npy"))),
        "covariance": float(np.linalg.norm(covariance)),
        "moved": float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()),
        "farthest": mesh["farthest_m"],
        "chosen": mesh["chosen"],
        "blocks": mesh["blocks"],
        "vertices": mesh["vertices"],
        "triangles": mesh["triangles"],
        "extent": float(np.linalg.norm(mesh["extent_m"])),
    }


def test_map_and_mesh_are_those_of_the_last_change(tmp_path: Path) -> None:
    kept = json.loads(FILE.read_text(encoding="utf-8"))
    if kept.pop("OpenCV") != cv2.__version__:
        pytest.skip("the figures are those of another version of OpenCV")
    assert _figures(tmp_path) == pytest.approx(kept, rel=1e-5)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        made = {"OpenCV": cv2.__version__, **_figures(Path(place))}
    FILE.write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
