"""The paper's experiment: the configuration files are rows of its table, with the same figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.dataset_makers import ece276a_arrays, make_drive, make_npz
from vio.config import load_config
from vio.datasets import open_dataset
from vio.evaluation.trajectories import evaluate
from vio.files.trajectories import read_trajectory, write_tum
from vio.offline.reproduce import FIGURES, VARIANTS, reproduce
from vio.records import Trajectory
from vio.runs.pipeline import run

ROOT = Path(__file__).resolve().parents[2]
rows = pytest.mark.parametrize(
    ("file", "row"),
    [("paper.yaml", "paper, all features"), ("paper_one_seventh.yaml", "paper, most seen 1/7")],
)


@rows
def test_configuration_file_is_a_row_of_the_table(file: str, row: str) -> None:
    variant = next(v for v in VARIANTS if v.name == row)
    assert load_config(ROOT / "configs" / file) == variant.config


@rows
def test_configuration_file_gives_the_published_figures(
    file: str, row: str, data_dir: Path
) -> None:
    recording = data_dir / "ece276a" / "0027.npz"
    if not recording.is_file():
        pytest.skip(f"{recording} is not there")
    config = load_config(ROOT / "configs" / file)
    result = run(open_dataset(recording, config.dataset), config)
    truth = read_trajectory(data_dir / "ece276a" / "kitti_odometry_07_poses.txt")
    score = evaluate(result.trajectory, truth, T_cam0_imu=result.T_cam0_body)
    system = {"paper, all features": "letter", "paper, most seen 1/7": "letter_seventh"}[row]
    runs = json.loads((ROOT / "docs" / "results.json").read_text())["paper"]["runs"]
    (published,) = (figures for _, name, _, figures, *_ in runs if name == system)
    figures = {name: published[name] for name in ("ate_m", "drift_percent", "drift_deg_per_100m")}
    found = (score.ate_m.rmse, score.kitti.t_err_percent, score.kitti.r_err_deg_per_100m)
    assert found == pytest.approx(tuple(figures.values()), rel=5e-4)  # three digits on any machine


@pytest.mark.parametrize("with_truth", [True, False])
def test_the_papers_figures_are_drawn_beside_ours(
    with_truth: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: Any
) -> None:
    needed = {name for _, _, variants in FIGURES for name in variants}
    assert all(variants[-1] == "sliding window" for _, _, variants in FIGURES)
    monkeypatch.setattr("vio.offline.reproduce.VARIANTS", [v for v in VARIANTS if v.name in needed])
    drive = make_drive(15)
    file = make_npz(tmp_path / "0027.npz", ece276a_arrays(drive))
    truth = None
    if with_truth:
        truth = tmp_path / "truth.tum"
        times_ns = open_dataset(file).recording.frame_times_ns
        write_tum(truth, Trajectory(drive.T_world_imu, times_ns, "imu"))
    said: list[str] = []
    reproduce(file, truth, tmp_path / "out", said.append)
    count = len(needed)
    assert [line.partition(":")[0] for line in said] == [
        f"0027, {k} of {count}" for k in range(1, count + 1)
    ]
    sizes = [
        (tmp_path / "out" / "0027" / f"{name}.png").stat().st_size
        for name in ("trajectories", *(name for name, _, _ in FIGURES))
    ]
    assert min(sizes) > 10_000
    assert "was not drawn" not in caplog.text
