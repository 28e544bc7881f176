"""A recording run by the calibration that a board gave, beside the true one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.board_views import board_pose
from vio import load_rig
from vio.cameras.rig import Rig
from vio.cli import main
from vio.datasets.images import write_png
from vio.datasets.rigs.kalibr import kalibr_text
from vio.targets.description import Target, target_text
from vio.targets.rendering import BoardRenderer, Exposure

BOARD = Target("aprilgrid", 5, 6, 0.06, 0.3)
PAIRS = 24


def _film(rig: Rig, folder: Path) -> None:
    """Render pairs of a board by the cameras of a rig."""
    rng = np.random.default_rng(3)
    cam1, T_cam1_cam0 = rig.right
    renderers = (BoardRenderer(BOARD, rig.cam0), BoardRenderer(BOARD, cam1))
    for name in ("left", "right"):
        (folder / name).mkdir(parents=True)
    for k in range(PAIRS):
        T = board_pose(BOARD, rng, nearest_m=0.25)
        for c, name in enumerate(("left", "right")):
            at = T_cam1_cam0 @ T if c else T
            image = renderers[c].render(at, Exposure(0.6, 2.0, seed=2 * k + c))
            write_png(folder / name / f"{k:04d}.png", image)


def _ate_m(run: Path) -> float:
    metrics = json.loads((run / "metrics.json").read_text())
    return float(metrics["ate_m"])


@pytest.mark.slow
def test_a_run_by_the_boards_calibration_is_as_good_as_by_the_true_one(tmp_path: Path) -> None:
    room = tmp_path / "room"
    render = ["render", "--rig", "euroc", "--width", "376", "--duration", "5", "--workers", "1"]
    assert main([*render, "--out", str(room)]) == 0
    truth = load_rig(room)
    _film(truth, tmp_path / "board")
    target = tmp_path / "board.yaml"
    target.write_text(target_text(BOARD))
    found = tmp_path / "found"
    command = ["calibrate-rig", str(tmp_path / "board"), "--target", str(target)]
    assert main([*command, "--lens", "radtan", "--out", str(found)]) == 0
    rig = load_rig(found / "camchain-imucam.yaml")
    # The board's recording had no IMU: its place is the true one.
    whole = tmp_path / "whole.yaml"
    whole.write_text(kalibr_text(replace(rig, T_cam0_imu=truth.T_cam0_imu)))
    ates = []
    for name, calibration in (("true", []), ("found", ["--calibration", str(whole)])):
        run = tmp_path / f"run_{name}"
        assert main(["run", str(room), *calibration, "--out", str(run)]) == 0
        ates.append(_ate_m(run))
    assert ates[0] < 0.02
    assert ates[1] < 1.5 * ates[0] + 0.002
