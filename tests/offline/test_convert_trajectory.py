"""`vio convert` of trajectory files between the forms of TUM, KITTI and EuRoC."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.commands import refused
from tests.dataset_makers import T_CAM0_IMU, make_drive
from vio.cli import main
from vio.datasets.kitti import write_calibration
from vio.files.trajectories import read_trajectory, write_euroc, write_kitti, write_tum
from vio.geometry.stereo import StereoCamera
from vio.records import Trajectory

TIMES_NS = 1403715523912143104 + 50_000_000 * np.arange(12)
TRUTH = Trajectory(make_drive(12).T_world_imu, TIMES_NS, "imu")


def convert(source: Path, to: str, out: Path, *options: str) -> Trajectory:
    assert main(["convert", str(source), "--to", to, "--out", str(out), *options]) == 0
    return read_trajectory(out)


@pytest.fixture
def extrinsics(tmp_path: Path) -> str:
    write_calibration(tmp_path, StereoCamera(700.0, 700.0, 600.0, 180.0, 0.5), T_CAM0_IMU)
    return str(tmp_path / "T_cam0_imu.txt")


def test_tum_and_euroc_keep_poses_and_nanoseconds(tmp_path: Path) -> None:
    write_tum(tmp_path / "a.tum", TRUTH)
    there = convert(tmp_path / "a.tum", "euroc", tmp_path / "b.csv")
    back = convert(tmp_path / "b.csv", "tum", tmp_path / "c.tum")
    for found in (there, back):
        assert found.body == "imu"
        assert found.times_ns.tolist() == TIMES_NS.tolist()
        np.testing.assert_allclose(found.T_world_body, TRUTH.T_world_body, atol=1e-14)


def test_kitti_describes_the_camera_and_gets_its_times_back(
    tmp_path: Path, extrinsics: str
) -> None:
    write_tum(tmp_path / "a.tum", TRUTH)
    there = convert(tmp_path / "a.tum", "kitti", tmp_path / "b.txt", "--calibration", extrinsics)
    assert (there.body, there.times_ns) == ("cam0", None)
    np.testing.assert_allclose(
        there.T_world_body, TRUTH.in_cam0(T_CAM0_IMU).T_world_body, atol=1e-13
    )
    times = tmp_path / "times.txt"
    times.write_text("".join(f"{t}\n" for t in TIMES_NS))
    back = convert(
        tmp_path / "b.txt",
        "euroc",
        tmp_path / "c.csv",
        "--times",
        str(times),
        "--calibration",
        extrinsics,
    )
    assert back.times_ns.tolist() == TIMES_NS.tolist()
    np.testing.assert_allclose(back.T_world_body, TRUTH.T_world_body, atol=1e-13)


def test_the_ground_truth_of_a_recording_becomes_a_tum_file(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    written = convert(flight, "tum", tmp_path / "truth.tum", "--json")
    facts = json.loads(capsys.readouterr().out)
    assert (facts["body"], facts["poses"]) == ("imu", len(written))


def _camera(path: Path) -> None:
    write_tum(path, Trajectory(TRUTH.T_world_body, TIMES_NS, "cam0"))


BAD = {
    "the IMU's poses for KITTI": (
        lambda p: write_tum(p, TRUTH),
        "kitti",
        (),
        "describes imu, not cam0 as",
    ),
    "the camera's poses for EuRoC": (
        _camera,
        "euroc",
        (),
        "describes cam0, not imu as the form must",
    ),
    "no times": (
        lambda p: write_kitti(p, Trajectory(TRUTH.T_world_body, None, "cam0")),
        "tum",
        (),
        "states no times, which tum form needs; name them with --times FILE",
    ),
    "too few times": (
        lambda p: (
            write_kitti(p, Trajectory(TRUTH.T_world_body, None, "cam0")),
            (p.parent / "t").write_text("1\n2\n"),
        ),
        "tum",
        ("--times", "t"),
        "t holds 2 times for 12 poses",
    ),
    "a bag of poses alone": (
        lambda p: write_euroc(p, TRUTH),
        "mcap",
        (),
        "is a trajectory: choose --to tum, kitti",
    ),
    "a part": (
        lambda p: write_euroc(p, TRUTH),
        "tum",
        ("--start", "3"),
        "choose frames of a recording",
    ),
    "a column too many": (
        lambda p: p.write_text("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1 9\n"),
        "euroc",
        (),
        "line 2: 9 columns instead of 8",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_trajectories_are_refused_in_one_line(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    make, form, options, message = BAD[name]
    monkeypatch.chdir(tmp_path)
    make(tmp_path / "a.txt")
    (line,) = refused(
        capsys, "convert", "a.txt", "--to", form, "--out", "out.txt", *options
    ).splitlines()
    assert message in line
    assert not (tmp_path / "out.txt").exists()
