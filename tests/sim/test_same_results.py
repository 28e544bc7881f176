"""What is rendered and drawn from a seed is what the last commit that says why it changed made.

Renders are compared over years: a room, a light or a noise that is half as strong again is another
recording under the same name. A commit that moves these figures renews the file by

    python -m tests.sim.test_same_results

and says in its message what moved and why.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from vio.cli import build_parser
from vio.cli.render import scenario_from
from vio.sim.motion import motion_at
from vio.sim.scenarios import plan
from vio.sim.sequence import SimulatedRecording

FILE = Path(__file__).with_name("same_results.json")
SCENES = ("room", "street", "corridor")
Figures = dict[str, float]


def _figures(scene: str) -> Figures:
    """Return the levels of one pair, the motion, and what the IMU measures."""
    argv = ["render", "--out", "x", "--realism", "real", "--scene", scene, "--seed", "5"]
    argv += ["--rig", "small", "--width", "128", "--duration", "3", "--rate", "10"]
    simulation = plan(scenario_from(build_parser().parse_args(argv))[0])
    frame = SimulatedRecording(simulation).frame(15)
    moved = motion_at(simulation.motion, simulation.taken_ns)
    out = {
        "positions": float(np.linalg.norm(moved.T_world_imu[:, :3, 3])),
        "velocities": float(np.linalg.norm(moved.velocity_world)),
        "true fu": float(simulation.rig.cam0.fu),
    }
    for name, image in (("left", frame.left), ("right", frame.right)):
        half = image.astype(np.float64)
        out[f"{name} mean"] = float(half.mean())
        out[f"{name} deviation"] = float(half.std())
        out[f"{name} edges"] = float(np.abs(np.diff(half, axis=1)).mean())
    if simulation.imu is not None:
        out["gyro"] = float(np.linalg.norm(simulation.imu.gyro))
        out["accelerometer"] = float(np.linalg.norm(simulation.imu.accel))
    return out


RUNS = {scene: partial(_figures, scene) for scene in SCENES}


@pytest.mark.parametrize("scene", SCENES)
def test_renders_are_those_of_the_last_change(scene: str) -> None:
    kept = json.loads(FILE.read_text(encoding="utf-8"))
    assert RUNS[scene]() == pytest.approx(kept[scene], rel=1e-4)


if __name__ == "__main__":
    found = {scene: run() for scene, run in RUNS.items()}
    FILE.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
