"""References whose clock or axes are others than the estimate's: named, and not where an estimate is
merely wrong.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vio.errors import DataError
from vio.evaluation.trajectories import evaluate
from vio.files.trajectories import read_trajectory
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse, so3_exp
from vio.records import Trajectory

COUNT = 400
START_NS = 1_700_000_000_000_000_000


def _positions(times: FloatArray) -> FloatArray:
    """A path that turns, climbs, and changes its speed."""
    phase = 0.4 * times + 0.3 * np.sin(0.7 * times)
    return np.stack(
        [3 * np.sin(phase), 2 * np.cos(1.3 * phase), 0.6 * np.sin(2.1 * phase) + 0.1 * times], 1
    )


def _trajectory(*, shift_s: float = 0.0, count: int = COUNT) -> Trajectory:
    times = 0.05 * np.arange(count)
    R = so3_exp(np.stack([0.1 * np.sin(times), 0.2 * times, 0.1 * np.cos(times)], 1))
    stamps = START_NS + np.round(1e9 * (times + shift_s)).astype(np.int64)
    return Trajectory(se3_from_parts(R, _positions(times)), stamps, "imu")


def _odometry(scale: float, turn_rad: float, noise: float) -> Trajectory:
    """An estimate that drifts: of a wrong scale, turning by an angle a frame, with noise."""
    truth = _trajectory()
    rng = np.random.default_rng(3)
    poses = [truth.T_world_body[0]]
    for step in se3_inverse(truth.T_world_body[:-1]) @ truth.T_world_body[1:]:
        length = float(np.linalg.norm(step[:3, 3]))
        moved = scale * step[:3, 3] + noise * length * rng.standard_normal(3)
        R = step[:3, :3] @ so3_exp(np.array([0.0, 0.0, turn_rad]))
        poses.append(poses[-1] @ se3_from_parts(R, moved))
    return replace(truth, T_world_body=np.array(poses))


@pytest.mark.parametrize(
    ("shift_s", "words"), [(0.5, "0.500 s late"), (-1.0, "1.000 s early"), (3.0, "3.000 s late")]
)
def test_a_reference_of_another_clock_is_named(shift_s: float, words: str) -> None:
    notes = evaluate(_odometry(1.02, 1e-4, 0.02), _trajectory(shift_s=shift_s)).notes
    assert [note for note in notes if words in note and "its clock is not the estimate's" in note]
    assert not [note for note in notes if "body with other axes" in note]


def test_a_left_handed_reference_is_named() -> None:
    truth = _trajectory()
    poses = truth.T_world_body.copy()
    poses[:, 1, 3] *= -1
    notes = evaluate(_odometry(1.0, 1e-4, 0.02), replace(truth, T_world_body=poses)).notes
    assert len([note for note in notes if "its axes are left-handed" in note]) == 1


@pytest.mark.parametrize("scale", [0.9, 1.0, 1.1])
@pytest.mark.parametrize("turn_rad", [0.0, 1e-3, -3e-3])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_an_estimate_that_drifts_is_no_fault_of_its_reference(
    scale: float, turn_rad: float, noise: float
) -> None:
    notes = evaluate(_odometry(scale, turn_rad, noise), _trajectory()).notes
    assert not [note for note in notes if "the positions agree where" in note]


def test_few_poses_say_nothing_of_a_clock() -> None:
    short = _trajectory(count=19)
    notes = evaluate(short, _trajectory(shift_s=0.2)).notes
    assert not [note for note in notes if "the positions agree where" in note]


def test_degrees_are_no_metres(tmp_path: Path) -> None:
    file = tmp_path / "gnss.csv"
    for names in ("time,lat,lon,alt", "timestamp,Latitude [deg],Longitude [deg],Height"):
        file.write_text(f"{names}\n1700000000.0,48.1,11.5,510\n1700000001.0,48.2,11.6,511\n")
        with pytest.raises(DataError, match="latitude and longitude, which are no metres"):
            read_trajectory(file)
    file.write_text("time,x,y,z\n1700000000.0,48.1,11.5,510\n1700000001.0,48.2,11.6,511\n")
    assert len(read_trajectory(file)) == 2
