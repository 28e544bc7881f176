"""GTSAM's stereo factor files as precomputed features."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.dataset_makers import CAMERA, T_CAM0_IMU, Drive, make_drive
from vio.config import load_config
from vio.datasets import open_dataset
from vio.datasets.features import FeatureDataset
from vio.datasets.gtsam import read_gtsam
from vio.errors import VioError
from vio.evaluation.trajectories import evaluate
from vio.geometry.lie import se3_inverse
from vio.records import Trajectory
from vio.runs.pipeline import run

FACTORS = "VO_stereo_factors_small.txt"
FIRST = 7  # number of the first frame: GTSAM's files begin at 0 and at 1
DRIVE = make_drive(12)


def T_world_cam(drive: Drive) -> np.ndarray:
    """Poses of the camera (F, 4, 4) relative to the first one."""
    poses = drive.T_world_imu @ se3_inverse(T_CAM0_IMU)
    return np.asarray(se3_inverse(poses[0]) @ poses)


def make_factors(folder: Path, name: str = FACTORS) -> Path:
    """Write the features of a drive, ordered by landmark as GTSAM does, with calibration and
    poses beside them.
    """
    rows = []
    for landmark in range(DRIVE.features.shape[1]):
        for frame in np.flatnonzero(DRIVE.features[0, landmark] != -1):
            ul, vl, ur, _ = DRIVE.features[:, landmark, frame]
            rows.append(f"{frame + FIRST} {landmark} {ul:.9g} {ur:.9g} {vl:.9g} 0 0 1")
    (folder / name).write_text("\n".join(rows))
    c = CAMERA
    (folder / "VO_calibration.txt").write_text(f"{c.fu} {c.fv} 0.0 {c.cu} {c.cv} {c.baseline_m}")
    poses = [
        f"{k + FIRST} {' '.join(f'{x:.9g}' for x in T.ravel())}"
        for k, T in enumerate(T_world_cam(DRIVE))
    ]
    (folder / name.replace("stereo_factors", "camera_poses")).write_text("\n".join(poses) + "\n")
    return folder / name


def test_factors_are_the_features_of_the_drive(tmp_path: Path) -> None:
    make_factors(tmp_path)
    dataset = open_dataset(tmp_path)
    assert isinstance(dataset, FeatureDataset)
    recording = dataset.recording
    assert (recording.kind, recording.has_images, recording.motion) == ("gtsam", False, frozenset())
    assert recording.camera == replace(CAMERA, width=None, height=None)
    assert recording.frame_times_ns.tolist() == [100_000_000 * k for k in range(12)]
    assert any("states no times" in note for note in recording.notes)
    assert any("not used: the points X Y Z" in note for note in recording.notes)
    for k in (0, 5, 11):
        seen = dataset.observations(k)
        ids = np.flatnonzero(DRIVE.features[0, :, k] != -1)
        assert seen.ids.tolist() == ids.tolist()
        np.testing.assert_allclose(seen.z, DRIVE.features[:, ids, k].T, atol=1e-5)
    assert recording.reference.body == "cam0"
    np.testing.assert_allclose(recording.reference.T_world_body, T_world_cam(DRIVE), atol=1e-7)


def test_numbers_with_gaps_keep_their_times(tmp_path: Path) -> None:
    path = make_factors(tmp_path)
    lines = [
        line
        for line in path.read_text().splitlines()
        if int(line.split()[0]) not in (FIRST + 3, FIRST + 4)
    ]
    path.write_text("\n".join(lines))
    recording = read_gtsam(path).recording
    assert recording.frame_times_ns.tolist() == [
        100_000_000 * k for k in range(12) if k not in (3, 4)
    ]
    assert recording.reference.times_ns.tolist() == recording.frame_times_ns.tolist()


def test_a_run_follows_the_drive(tmp_path: Path) -> None:
    result = run(open_dataset(make_factors(tmp_path)), load_config())
    truth = Trajectory(T_world_cam(DRIVE), result.recording.frame_times_ns, "cam0")
    assert evaluate(result.trajectory, truth).ate_m.rmse < 0.01  # exact pixels over 7 m


@pytest.mark.parametrize(("mode", "are_checked"), [("auto", True), ("literal", False)])
def test_factors_that_repeat_are_taken_as_they_are_on_request(
    mode: str, are_checked: bool, tmp_path: Path
) -> None:
    path = make_factors(tmp_path)
    rows = [line.split() for line in path.read_text().splitlines()]
    at = {(int(row[0]), row[1]): row for row in rows}
    out = []
    for frame, landmark in at:
        even = frame - (frame - FIRST) % 2
        if (even, landmark) in at:
            out.append(" ".join([str(frame), *at[even, landmark][1:]]))
    path.write_text("\n".join(out))
    config = load_config(overrides=[f"dataset.repeated_tracks={mode}"])
    result = run(open_dataset(path, config.dataset), config)
    assert any(frame.stale > 0 for frame in result.frames) is are_checked


def _with(change: Callable[[list[str]], list[str]], name: str = FACTORS) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        folder.mkdir(exist_ok=True)
        path = make_factors(folder)
        changed = folder / name
        changed.write_text("\n".join(change(changed.read_text().splitlines())) + "\n")
        return path

    return make


def _two(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    make_factors(folder)
    make_factors(folder, "VO_stereo_factors00s.txt")
    return folder


def _without(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = _with(list)(folder)
        (folder / name).unlink()
        return path

    return make


def _swapped(lines: list[str]) -> list[str]:
    rows = [line.split() for line in lines]
    return [" ".join([*r[:2], r[3], r[2], *r[4:]]) for r in rows]


_POSES = "VO_camera_poses_small.txt"
BAD = {
    "several factor files": (
        _two,
        r"holds VO_stereo_factors00s\.txt, VO_stereo_factors_small\.txt; name one",
    ),
    "no calibration": (
        _without("VO_calibration.txt"),
        "no calibration; put its 'fx fy s u0 v0 b' beside it",
    ),
    "a calibration with skew": (
        _with(lambda _: ["700 700 3 600 180 0.5"], "VO_calibration.txt"),
        "expected one line 'fx fy s u0 v0 b' with a skew s of zero",
    ),
    "seven columns": (
        _with(lambda lines: [*lines[:3], "7 1 2 3 4 5 6"]),
        "line 4: 7 values instead of 8",
    ),
    "a landmark without a number": (
        _with(lambda lines: [*lines, "7 1.5 2 1 4 0 0 1"]),
        "is no row 'pose landmark uL",
    ),
    "a pixel that is no number": (
        _with(lambda lines: [*lines, "7 9999 nan 1 4 0 0 1"]),
        "is no row 'pose landmark uL",
    ),
    "a landmark seen twice": (
        _with(lambda lines: [*lines, lines[0]]),
        "sees landmark 0 more than once",
    ),
    "exchanged cameras": (_with(_swapped), "left and right look swapped"),
    "one pose": (_with(lambda lines: lines[:1]), "holds one pose; visual odometry needs"),
    "poses that are no transforms": (
        _with(lambda lines: [lines[0].replace(" 1 ", " 2 ", 1), *lines[1:]], _POSES),
        r"poses_small\.txt, line 1: not a rotation",
    ),
    "poses of other frames": (
        _with(lambda lines: [f"9{line}" for line in lines], _POSES),
        "numbers none of the",
    ),
    "poses out of order": (
        _with(lambda lines: lines[::-1], _POSES),
        "line 2: its number does not increase",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_factors_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    make, message = BAD[name]
    with pytest.raises(VioError, match=message) as caught:
        open_dataset(make(tmp_path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("name", "frames", "length_m"), [("_large", 26, 22.9), ("00s", 77, 69.0)])
def test_gtsams_own_examples(name: str, frames: int, length_m: float, data_dir: Path) -> None:
    """The run agrees with the optimised poses that GTSAM publishes with the factors."""
    path = data_dir / "gtsam_stereo_factors" / f"VO_stereo_factors{name}.txt"
    dataset = open_dataset(path)
    reference = dataset.recording.reference
    assert len(reference) == frames
    if name == "00s":  # the other has 300 features a frame and takes ten seconds
        # as the published poses take the cameras
        as_given = load_config(overrides=["msckf.calibrate_stereo=off"])
        assert evaluate(run(dataset, as_given, stop=30).trajectory, reference).ate_m.rmse < 0.02
    assert float(
        np.linalg.norm(np.diff(reference.positions, axis=0), axis=1).sum()
    ) == pytest.approx(length_m, abs=0.1)
