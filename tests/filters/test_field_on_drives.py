"""The rectification error found on recorded drives: whatever the prior, and in a bend."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vio.config import load_config
from vio.datasets import open_dataset
from vio.evaluation.trajectories import evaluate
from vio.filters.prior import Prior
from vio.geometry.lie import FloatArray
from vio.runs.pipeline import RunResult, run


def _replay(data_dir: Path, name: str, *overrides: str) -> RunResult:
    path = data_dir / "observations" / f"{name}.npz"
    if not path.is_file():
        pytest.skip(f"{path.name} is not in the data folder: it holds a drive's observations")
    config = load_config(overrides=overrides)
    return run(open_dataset(path, config.dataset), config)


def _ate_m(result: RunResult) -> float:
    reference = result.recording.reference
    assert reference is not None
    return evaluate(result.trajectory, reference).ate_m.rmse


def _disparity_off_px(result: RunResult) -> float:
    """By how much disparities at the principal point are off."""
    field = result.estimates[-1].stereo_field
    assert field is not None
    return float(-result.recording.camera.fu * field.coefficients[0])


@pytest.mark.parametrize("repeated", [1.0, 2.5, 6.0])
def test_a_prior_counts_by_its_information_beside_repeated_measurements(repeated: float) -> None:
    """A constant with the prior 0 ± 1, measured as 1 with small information again and again, as
    often repeated as given: a Kalman filter of so much larger noise.
    """
    prior = Prior(np.eye(2))
    information: FloatArray = np.diag([0.0, 0.05])
    vector = np.array([0.0, 0.05])
    for _ in range(4000):
        prior.absorb(information, vector, repeated=(slice(1, 2), repeated))  # seen from a mean of 0
    total = 1.0 + 4000 * 0.05 / repeated
    left_of_prior = 1.0 + prior.delta[1]
    assert prior.P[1, 1] == pytest.approx(1.0 / total, rel=0.05)
    assert left_of_prior == pytest.approx(1.0 / total, rel=0.05)


@pytest.mark.parametrize(
    ("name", "most_px"),
    [
        pytest.param("kitti_01_51", 0.05, id="a motorway: 0.02 px, 0.08 before"),
        pytest.param("kitti_00_15_200", 0.01, id="a town: 0.001 px, 0.06 before"),
    ],
)
def test_the_prior_of_the_yaw_hardly_moves_what_drives_show(
    data_dir: Path, name: str, most_px: float
) -> None:
    """Priors of 0.4 and 2.5 px beside information of 0.02 px."""
    found = []
    for yaw_deg in (0.03, 0.2):
        prior = f"msckf.stereo_yaw_sigma_deg={yaw_deg}"
        found.append(_disparity_off_px(_replay(data_dir, name, prior)))
    assert abs(found[1] - found[0]) < most_px


@pytest.mark.parametrize(
    ("name", "most_m"),
    [
        pytest.param("kitti_00_15_200", 0.15, id="a town with a bend, 0.21 m before"),
        pytest.param("kitti_01_51", 0.11, id="a motorway, 0.15 m before"),
    ],
)
def test_two_drives_with_one_rig_come_out_well(data_dir: Path, name: str, most_m: float) -> None:
    assert _ate_m(_replay(data_dir, name)) < most_m
