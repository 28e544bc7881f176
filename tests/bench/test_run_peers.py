"""Other systems on the recordings of a suite: here a program that takes and writes what Basalt's
does.
"""

from __future__ import annotations

import json
import stat
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vio
from tests.plain_maker import make_plain
from vio.bench.run_peers import Program, run_peer
from vio.bench.suite import Sequence, Suite
from vio.errors import ConfigError, DataError
from vio.files.trajectories import read_trajectory
from vio.targets.results import write_rig

# As `basalt_vio`: options by name; without these entries its reader of calibrations throws.
STUB = """
import json, sys, pathlib
options = dict(zip(sys.argv[1::2], sys.argv[2::2]))
block = json.load(open(options["--cam-calib"]))["value0"]
for name in ("T_imu_cam", "intrinsics", "resolution", "calib_accel_bias", "calib_gyro_bias",
             "imu_update_rate", "accel_noise_std", "gyro_noise_std", "accel_bias_std",
             "gyro_bias_std", "cam_time_offset_ns", "vignette"):
    block[name]
assert options["--dataset-type"] == "euroc" and options["--show-gui"] == "0"
assert options["--save-trajectory"] == "euroc"
mav = pathlib.Path(options["--dataset-path"]) / "mav0"
assert len((mav / "imu0/data.csv").read_text().splitlines()) > 2
stamps = [line.split(",")[0] for line in (mav / "cam0/data.csv").read_text().splitlines()[1:]]
with open("trajectory.csv", "w") as out:
    print("#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []", file=out)
    for k, stamp in enumerate(stamps):
        print(f"{stamp},{k}.5,0,-{k}.25,0.6,0.8,0,0", file=out)
"""


def _program(folder: Path, text: str = STUB) -> Program:
    path = folder / "basalt_vio"
    path.write_text(f"#!{sys.executable}\n{text}")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return Program(path)


def _suite(folder: Path) -> Suite:
    return Suite("small", folder, (Sequence("short", source="recording"),), {"plain": {}})


def test_a_program_of_basalt_is_run_on_a_suite(tmp_path: Path) -> None:
    recording = make_plain(tmp_path / "recording")
    stamps = vio.open_dataset(recording).recording.frame_times_ns
    said: list[str] = []
    suite = _suite(tmp_path)
    folder = run_peer("basalt", suite, tmp_path, tmp_path / "kept", said.append, _program(tmp_path))
    poses = read_trajectory(folder / "short.basalt_imu.tum")
    assert poses.body == "imu"
    np.testing.assert_array_equal(poses.times_ns, stamps)
    np.testing.assert_allclose(poses.T_world_body[2, :3, 3], [2.5, 0, -2.25])
    # (0.6, 0.8, 0, 0), w first: a turn about x
    np.testing.assert_allclose(poses.T_world_body[0, :3, 0], [1, 0, 0], atol=1e-12)
    assert poses.T_world_body[0, 2, 1] == pytest.approx(2 * 0.6 * 0.8)
    assert said == ["basalt: short"]
    gone = Program(tmp_path / "basalt_vio")
    gone.path.write_text(f"#!{sys.executable}\nraise SystemExit(1)\n")
    run_peer("basalt", suite, tmp_path, tmp_path / "kept", said.append, gone)  # what is there stays


def test_a_program_that_gives_no_pose_is_said_to(tmp_path: Path) -> None:
    make_plain(tmp_path / "recording")
    program = _program(tmp_path, "import sys\nsys.exit('libtbb is missing')\n")
    with pytest.raises(DataError, match=r"short: basalt_vio gives no pose \(libtbb is missing\)"):
        run_peer(
            "basalt", _suite(tmp_path), tmp_path, tmp_path / "kept", lambda text: None, program
        )


def test_a_program_is_needed_and_must_be_one(tmp_path: Path) -> None:
    suite = _suite(tmp_path)
    cases = (
        (None, "give its program with --peer-program"),
        (Program(tmp_path / "nothing"), "is no program that can be run"),
        (replace(_program(tmp_path), settings=tmp_path / "no.json"), "does not exist"),
    )
    for program, message in cases:
        with pytest.raises(ConfigError, match=message):
            run_peer("basalt", suite, tmp_path, tmp_path / "kept", lambda text: None, program)
    with pytest.raises(ConfigError, match="leave out --peer-program"):
        run_peer("spectacularai", suite, tmp_path, tmp_path, lambda text: None, _program(tmp_path))


def test_a_calibration_for_basalt_is_read_as_the_rig(tmp_path: Path) -> None:
    """The time shift was written with the wrong sign."""
    rig = replace(vio.load_rig(make_plain(tmp_path / "recording")), time_offset_s=0.0125)
    (tmp_path / "written").mkdir()
    assert "basalt.json" in write_rig(tmp_path / "written", rig)
    found = vio.load_rig(tmp_path / "written" / "basalt.json")
    assert found.time_offset_s == pytest.approx(0.0125, abs=1e-12)
    assert found.T_cam0_imu is not None
    assert rig.T_cam0_imu is not None
    np.testing.assert_allclose(found.T_cam0_imu, rig.T_cam0_imu, atol=1e-9)
    block = json.loads((tmp_path / "written" / "basalt.json").read_text())["value0"]
    assert block["imu_update_rate"] == 200.0
    assert min(block["accel_noise_std"]) > 0
