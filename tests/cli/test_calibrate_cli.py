"""`vio calibrate` end to end: tracks with an IMU or velocities, and images that need
rectification.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tests.commands import refused
from tests.dataset_makers import R_CAM0_IMU, ece276a_arrays, make_drive, make_npz
from tests.dataset_makers import T_CAM0_IMU as T_OF_DRIVE
from tests.filters.test_msckf import CAMERA, STEP_NS, T_CAM0_IMU
from tests.filters.test_online_calibration import Shaking, _samples
from vio.cli import main
from vio.datasets.observation_log import write_observation_log
from vio.evaluation.errors_along_path import rotation_angle_deg
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse
from vio.records import Recording

FRAMES = 290


def _calibrate(
    capsys: pytest.CaptureFixture[str], source: Path, out: Path, pairs: int = 2
) -> dict[str, Any]:
    assert main(["calibrate", str(source), "--out", str(out), "--pairs", str(pairs), "--json"]) == 0
    facts: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert json.loads((out / "calibration.json").read_text()) == facts
    return facts


def _faults(facts: dict[str, Any]) -> list[str]:
    return [finding["fault"] for finding in facts["findings"]]


def _flight(path: Path, T_cam0_imu: FloatArray, offset_s: float) -> Path:
    """Write tracks and IMU samples of a shaking flight with a clock offset and given extrinsics."""
    flight, rng, end_ns = Shaking(FRAMES), np.random.default_rng(0), (FRAMES - 1) * STEP_NS
    seen = [flight.observe(k, 0.3, rng, 80) for k in range(FRAMES)]
    samples = [s for s in _samples(flight, offset_s, rng) if 0 <= s.time_ns <= end_ns]
    times = np.arange(FRAMES) * STEP_NS
    write_observation_log(
        path,
        Recording(
            "made", Path("made"), CAMERA, T_cam0_imu, times, False, frozenset({"imu"}), None, None
        ),
        seen,
        samples,
    )
    return path


def test_calibrates_an_imu_from_tracks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    facts = _calibrate(capsys, _flight(tmp_path / "flight.npz", T_CAM0_IMU, 0.0), tmp_path / "out")
    assert facts["findings"] == []
    assert rotation_angle_deg(np.array(facts["imu"]["R_cam0_imu"]).T @ T_CAM0_IMU[:3, :3]) < 0.05
    assert abs(facts["imu"]["time_offset_s"]) < 0.3e-3
    lever_arm, sigma = (np.array(facts["lever_arm"][key]) for key in ("t_cam0_imu", "sigma_m"))
    assert np.all(np.abs(lever_arm - T_CAM0_IMU[:3, 3]) < 3 * sigma)
    assert np.all(sigma < 0.03)
    assert rotation_angle_deg(facts["stereo"]["R_cam1_cam0"]) < 0.02


def test_prints_inverted_extrinsics_and_clock_offset(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = _flight(tmp_path / "flight.npz", se3_inverse(T_CAM0_IMU), 0.02)
    assert main(["calibrate", str(source), "--out", str(tmp_path / "out"), "--pairs", "2"]) == 0
    out = capsys.readouterr().out
    assert "IMU-camera rotation inverted: the inverse of the given one fits" in out
    assert "IMU-camera translation inverted" in out
    assert "clocks apart: IMU minus camera +" in out
    assert "IMU in cam0 " in out
    assert "no fault found" not in out


@pytest.mark.parametrize(
    ("T_cam0_imu", "faults"),
    [
        (T_OF_DRIVE, ["clocks apart"]),
        (
            se3_from_parts(R_CAM0_IMU, -R_CAM0_IMU.T @ T_OF_DRIVE[:3, 3]),
            ["clocks apart", "IMU-camera translation inverted"],
        ),
        (
            se3_inverse(T_OF_DRIVE),
            ["IMU-camera rotation inverted", "clocks apart", "IMU-camera translation inverted"],
        ),
    ],
    ids=["right", "translation", "both"],
)
def test_reports_inverted_extrinsics_by_velocities(
    T_cam0_imu: FloatArray, faults: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The drive's velocities are those of the following step, so they are half a step early;
    only yaw rotates.
    """
    arrays = ece276a_arrays(make_drive(60, pixel_sigma=0.3, yaw_rate=1.0))
    arrays["features"], arrays["cam_T_imu"] = arrays["features"][:, ::4], T_cam0_imu
    facts = _calibrate(capsys, make_npz(tmp_path / "drive.npz", arrays), tmp_path / "out")
    assert _faults(facts) == faults
    assert facts["imu"]["time_offset_s"] == pytest.approx(-0.05, abs=0.004)
    assert facts["imu"]["weak"].startswith("rotation about one axis")
    assert "contains velocities, no accelerometer" in facts["lever_arm"]["verdict"]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Render an EuRoC folder of distorted images, three seconds."""
    out = tmp_path_factory.mktemp("rendered") / "room"
    size = [
        "--rig",
        "euroc",
        "--width",
        "200",
        "--rate",
        "15",
        "--duration",
        "3",
        "--effects",
        "clean",
    ]
    assert main(["render", "--out", str(out), *size, "--workers", "1"]) == 0
    return out


def test_calibrates_images_that_need_rectification(
    rendered: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    facts = _calibrate(capsys, rendered, tmp_path / "out")
    assert facts["findings"] == []
    assert "windows of 1 s" in facts["lever_arm"]["verdict"]
    given = [
        yaml.safe_load((rendered / "mav0" / f"cam{k}" / "sensor.yaml").read_text()[10:])
        for k in (0, 1)
    ]
    T_imu_cam = [np.reshape(sheet["T_BS"]["data"], (4, 4)) for sheet in given]
    chain = yaml.safe_load((tmp_path / "out" / "camchain-imucam.yaml").read_text())
    T_cam0_imu = np.array(chain["cam0"]["T_cam_imu"])
    # measured, in the raw camera's frame
    assert rotation_angle_deg(T_cam0_imu @ T_imu_cam[0]) < 0.5
    assert not np.allclose(T_cam0_imu[:3, :3], T_imu_cam[0][:3, :3].T, atol=1e-6)
    np.testing.assert_allclose(T_cam0_imu[:3, 3], se3_inverse(T_imu_cam[0])[:3, 3])  # as given
    T_cam1_cam0 = np.array(chain["cam1"]["T_cn_cnm1"])
    assert rotation_angle_deg(T_cam1_cam0 @ se3_inverse(T_imu_cam[0]) @ T_imu_cam[1]) < 0.1
    assert chain["cam0"]["timeshift_cam_imu"] == pytest.approx(facts["imu"]["time_offset_s"])


def test_measures_cameras_that_cannot_be_rectified(
    rendered: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    swapped = tmp_path / "swapped"
    shutil.copytree(rendered, swapped)
    cam0, cam1 = (swapped / "mav0" / name for name in ("cam0", "cam1"))
    cam0.rename(swapped / "aside")
    cam1.rename(cam0)
    (swapped / "aside").rename(cam1)
    facts = _calibrate(capsys, swapped, tmp_path / "out", pairs=5)
    assert _faults(facts) == ["cameras swapped"]
    assert "the reader rejects this calibration" in facts["notes"][0]
    assert "must be corrected first" in facts["imu"]["verdict"]


@pytest.mark.parametrize("option", [("--pairs", "0"), ("--frames", "1")])
def test_rejects_numbers_that_are_too_small(
    option: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "--pairs must be at least 1 and --frames at least 2" in refused(
        capsys, "calibrate", tmp_path, *option
    )
