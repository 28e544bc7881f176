"""`vio inspect`: what it says of sound recordings, and that each fault is found, with exit
status 1 and a remedy.
"""

from __future__ import annotations

import json
import logging
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from tests.commands import refused
from tests.dataset_makers import FRAME_S, make_kitti
from tests.euroc_maker import RADTAN_RIG
from tests.frontend.test_frontend_scene import CAMERA
from tests.guard.test_guard import shifted
from tests.monitor import test_lens_distortion
from tests.plain_maker import make_plain, rig_of
from vio.cli import main
from vio.datasets import open_dataset
from vio.datasets.image_pairs import ImageRecording
from vio.frontend import build_frontend
from vio.frontend.precomputed import PrecomputedFrontend
from vio.frontend.settings import FrontendSettings, GridSettings
from vio.geometry.lie import so3_exp
from vio.guard.guarded import GuardedFrontend, guarded
from vio.inspection.inertial import allan_deviation, noise_part, rest_part
from vio.inspection.inspect import (
    _pairs_parts,
    _reference_part,
    _track,
    _tracking_parts,
    clock_facts,
    inspect_recording,
)
from vio.inspection.pictures import GrayLevels, _image_faults, rows_part
from vio.records import Event, FrontendOutput, ImuDensities, ImuRecord, StereoFrame


def inspect(
    folder: Path, capsys: pytest.CaptureFixture[str], *options: str
) -> tuple[int, dict[str, Any]]:
    """Run the command and return its status and facts."""
    capsys.readouterr()
    status = main(["inspect", str(folder), "--json", "--pairs", "3", "--frames", "8", *options])
    facts: dict[str, Any] = json.loads(capsys.readouterr().out)
    return status, facts


def test_a_sound_recording(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, facts = inspect(flight, capsys)
    assert (status, facts["faults"], facts["kind"]) == (0, [], "euroc")
    parts = facts["parts"]
    assert parts["frames"]["rate_hz"] == pytest.approx(20)
    assert parts["IMU"]["rate_hz"] == pytest.approx(200)
    assert parts["IMU"]["gaps"] == 0
    assert abs(parts["stereo"]["rows_median_px"]) < 0.1
    assert parts["stereo"]["positive_disparity"] == 1.0
    assert parts["rest"]["force_norm_mps2"] == pytest.approx(9.8, abs=0.5)
    assert parts["tracking"]["tracked_median"] > 50
    assert parts["missing"]["missing"] == []


def test_tracks_without_the_checks_on_request(
    flight: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the run does that the settings are of."""
    checked = []
    process = GuardedFrontend.process

    def counted(self: GuardedFrontend, *args: Any) -> FrontendOutput:
        checked.append(args)
        return process(self, *args)

    monkeypatch.setattr(GuardedFrontend, "process", counted)
    inspect(flight, capsys)
    assert checked
    checked.clear()
    _, facts = inspect(flight, capsys, "--set", "frontend.checks=false")
    assert facts["parts"]["tracking"]["tracked_median"] > 50
    assert not checked


def test_the_clock_of_velocities_is_described(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, facts = inspect(make_kitti(tmp_path / "kitti", frames=6), capsys)
    velocity = facts["parts"]["velocity"]
    assert (velocity["count"], velocity["covered"]) == (6, 1.0)
    assert velocity["rate_hz"] == pytest.approx(1 / FRAME_S, rel=1e-3)


def _turn_right_camera(folder: Path, w_deg: list[float]) -> None:
    """Turn the right camera of an EuRoC folder, not its calibration."""
    sheet = yaml.safe_load(
        (folder / "mav0" / "cam1" / "sensor.yaml").read_text().removeprefix("%YAML:1.0")
    )
    fu, fv, cu, cv = sheet["intrinsics"]
    K = np.array([[fu, 0, cu], [0, fv, cv], [0, 0, 1]])
    H = K @ so3_exp(np.radians(w_deg)) @ np.linalg.inv(K)
    for file in (folder / "mav0" / "cam1" / "data").glob("*.png"):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        size = image.shape[1], image.shape[0]
        cv2.imwrite(str(file), cv2.warpPerspective(image, H, size, borderMode=cv2.BORDER_REPLICATE))


@pytest.mark.parametrize("copied", [False, True])
def test_a_focal_length_and_centre_that_both_lenses_have_are_named_where_rows_are_off(
    copied: bool,
) -> None:
    rng = np.random.default_rng(5)
    left = cv2.GaussianBlur(rng.integers(0, 256, (240, 320), dtype=np.uint8), (0, 0), 2.0)
    left = cv2.normalize(left, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    frame = StereoFrame(0, 0, left, np.roll(left, (6, -12), axis=(0, 1)))
    lens = replace(RADTAN_RIG.cam0, fu=250.0, fv=250.0, cu=160.0, cv=120.0, width=320, height=240)
    other = replace(lens, cu=160.0 if copied else 161.5, coefficients=(-0.27, 0.06, 1e-4, 0.0))
    rig = replace(RADTAN_RIG, cam0=lens, cam1=other)
    part, _ = rows_part([frame], (rig, rig_of(rig).rectifier().camera), lambda done, of: None)
    (fault,) = part.faults
    assert fault.startswith("rows differ by -6.0 px")
    assert ("those of one were written for both" in fault) == copied


@pytest.mark.parametrize(
    ("w_deg", "where", "in_run"),
    [
        ([2.0, 0.0, 0.0], "a camera has been turned", "the right camera is turned"),
        # near points, and no motion yet, from which the yaw is told
        ([0.0, 2.0, 0.0], "unusable: rows off by", "the stereo calibration is off"),
    ],
)
def test_a_turned_right_camera_is_named_before_and_in_the_run(
    w_deg: list[float],
    where: str,
    in_run: str,
    flight: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    folder = tmp_path / "turned"
    shutil.copytree(flight, folder)
    _turn_right_camera(folder, w_deg)
    main(["inspect", str(folder), "--pairs", "3", "--frames", "0"])
    assert where in capsys.readouterr().out
    assert (
        main(
            [
                "run",
                str(folder),
                "--motion",
                "none",
                "--stop",
                "12",
                "--out",
                str(tmp_path / "out"),
                "--quiet",
            ]
        )
        == 0
    )
    named = [line for line in caplog.messages if in_run in line]
    assert len(named) == 1


def test_a_turned_right_camera_is_calibrated_with_features_tracked_along_its_rows(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "turned"
    shutil.copytree(flight, folder)
    _turn_right_camera(folder, [0.3, 0.0, 1.2])
    out = tmp_path / "found"
    assert main(["calibrate", str(folder), "--out", str(out), "--pairs", "8", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert [finding["fault"] for finding in facts["findings"]] == ["left-right rotation wrong"]
    x, _, z = map(float, re.findall(r"[-+]\d\.\d\d", facts["findings"][0]["detail"]))
    assert (x, z) == (pytest.approx(0.3, abs=0.03), pytest.approx(1.2, abs=0.03))
    assert facts["rows"]["rms_px"] > 1.0, "that of the calibration as given"
    found = str(out / "camchain-imucam.yaml")
    command = ["run", str(folder), "--calibration", found, "--motion", "none", "--stop", "12"]
    assert main([*command, "--quiet", "--json", "--out", str(tmp_path / "out")]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["right_images"] is None
    assert metrics["stereo_field"]["rows_rms_px"] < 0.2


def test_inspection_and_run_state_one_figure_of_a_calibration_that_is_off(
    flight: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    folder = tmp_path / "turned"
    shutil.copytree(flight, folder)
    _turn_right_camera(folder, [0.2, 0.0, 0.1])
    dataset = open_dataset(folder)
    report = inspect_recording(
        dataset,
        lambda d: guarded(
            build_frontend("auto", d.recording.camera, FrontendSettings(), d), d.recording.camera
        ),
        pairs=3,
        tracked=12,
    )
    before = next(part for part in report.parts if part.name == "calibration")
    ran = tmp_path / "ran"
    command = ["run", str(folder), "--motion", "none", "--stop", "12", "--out", str(ran), "--quiet"]
    assert main(command) == 0
    after = json.loads((ran / "metrics.json").read_text())["stereo_field"]
    assert before.facts["rows_rms_px"] > 0.3
    assert before.facts["rows_rms_px"] == pytest.approx(after["rows_rms_px"], rel=0.03)
    named = [line for line in caplog.messages if "the stereo calibration is off" in line]
    assert len(named) == 1
    assert " px" not in named[0]  # the size is stated once, at the end


def test_one_screen_for_people(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(flight), "--pairs", "2", "--frames", "0"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 24
    assert lines[-2:] == [
        "verdict              can be run",
        f"next                 vio run {flight}",
    ]


def test_the_next_command_reads_what_was_examined(
    flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--camera", "left", "--set", "imu.gravity_mps2=9.8"]
    assert main(["inspect", str(flight), "--pairs", "1", "--frames", "0", *options]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.split()[1:] == ["vio", "run", str(flight), *options]


def _imu(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def mend(folder: Path) -> None:
        file = folder / "mav0" / "imu0" / "data.csv"
        lines = file.read_text().splitlines()
        rows = change(np.array([[float(x) for x in line.split(",")] for line in lines[1:]]))
        text = "\n".join(",".join([str(int(row[0])), *map(repr, row[1:].tolist())]) for row in rows)
        file.write_text(f"{lines[0]}\n{text}\n")

    return mend


def _scaled_accel(row: np.ndarray) -> np.ndarray:
    return np.hstack([row[:, :4], row[:, 4:] / 9.81])


def _black(folder: Path) -> None:
    for file in folder.glob("mav0/cam?/data/*.png"):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        assert cv2.imwrite(str(file), np.zeros_like(image))


def _swapped(folder: Path) -> None:
    a, b = (folder / "mav0" / name / "data" for name in ("cam0", "cam1"))
    a.rename(folder / "x")
    b.rename(a)
    (folder / "x").rename(b)


def _same(folder: Path) -> None:
    shutil.rmtree(folder / "mav0" / "cam1" / "data")
    shutil.copytree(folder / "mav0" / "cam0" / "data", folder / "mav0" / "cam1" / "data")


def _shifted_rows(folder: Path) -> None:
    for file in (folder / "mav0" / "cam1" / "data").iterdir():
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        assert cv2.imwrite(str(file), np.roll(image, 6, axis=0))


def _turned(folder: Path) -> None:
    for file in (folder / "mav0" / "cam1" / "data").iterdir():
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        assert cv2.imwrite(str(file), image[::-1, ::-1])


FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "accelerometer in g": (
        _imu(_scaled_accel),
        "rest: accelerometer units: .* in g: multiply by 9.81",
    ),
    "IMU at 10 Hz": (
        _imu(lambda rows: rows[::20]),
        "IMU: 10 Hz are too few to integrate .*; record at least 50 Hz",
    ),
    "black images": (
        _black,
        "images: .* are black, white or without content; correct the exposure",
    ),
    "exchanged cameras": (
        _swapped,
        "stereo: .* left and right images are exchanged; exchange the folders",
    ),
    "right camera upside down": (
        _turned,
        "stereo: the right images are turned by about 180 degrees against the left ones: turn them",
    ),
    "one camera twice": (_same, "images: left and right are the same images"),
    "rows shifted": (
        _shifted_rows,
        r"stereo: rows differ by -6\.. px .* exchanged, .*; run `vio calibrate`",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_found_with_their_remedy(
    name: str, flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change, message = FAULTS[name]
    folder = tmp_path / "flight"
    shutil.copytree(flight, folder)
    change(folder)
    status, facts = inspect(folder, capsys, "--frames", "0")
    assert status == 1
    assert any(re.search(message, fault) for fault in facts["faults"]), facts["faults"]
    assert all("\n" not in fault for fault in facts["faults"])


@pytest.mark.parametrize(
    ("delay", "named"),
    [
        (1, "each right image comes a frame later than the left one of its time"),
        (-2, "each left image comes 2 frames later than the right one of its time"),
        (0, None),
    ],
)
def test_pairs_of_different_times_are_named(delay: int, named: str | None) -> None:
    pairs = shifted(delay)[:9]
    recording = SimpleNamespace(camera=CAMERA, motion=(), T_cam0_imu=None)
    dataset: Any = SimpleNamespace(recording=recording, events=lambda *span: iter(pairs))
    settings = FrontendSettings(grid=GridSettings(target_features=60))
    seen = _track(
        dataset,
        guarded(build_frontend("klt", CAMERA, settings), CAMERA),
        range(len(pairs)),
        lambda done, total: None,
    )
    parts = _tracking_parts(dataset.recording, seen)
    faults = [fault for part in parts if part.name == "pairs" for fault in part.faults]
    assert len(faults) == (named is not None)
    assert named is None or faults[0].startswith(named)


@pytest.mark.parametrize("k1", [-0.1, 0.0])
def test_pixels_that_are_still_distorted_are_named(k1: float) -> None:
    lens = test_lens_distortion.radial(k1)
    seen = test_lens_distortion.frames_seen(lens, lens, 25)
    camera = test_lens_distortion.CAMERA
    frames = [StereoFrame(o.frame_index, o.time_ns, None, None) for o in seen]
    recording = SimpleNamespace(camera=camera, motion=(), T_cam0_imu=None)
    dataset: Any = SimpleNamespace(recording=recording, events=lambda *span: iter(frames))
    source = PrecomputedFrontend(lambda index: seen[index])
    tracked = _track(dataset, source, range(len(frames)), lambda done, total: None)
    parts = _tracking_parts(dataset.recording, tracked)
    faults = [fault for part in parts if part.name == "lenses" for fault in part.faults]
    assert [fault.startswith("rows of near and far points") for fault in faults] == [True] * bool(
        k1
    )


# --- figures
# --------------------------------------------------------------------------------------------------


def test_rates_jitter_and_gaps() -> None:
    times = np.arange(100, dtype=np.int64) * 50_000_000
    facts = clock_facts(np.delete(times, [40, 41, 80]))
    assert facts["rate_hz"] == pytest.approx(20)
    assert (facts["gaps"], facts["longest_gap_s"]) == (2, pytest.approx(0.15))
    assert facts["jitter_ms"] == 0
    noisy = times + np.random.default_rng(0).normal(0, 1e6, 100).astype(np.int64)
    assert clock_facts(noisy)["jitter_ms"] == pytest.approx(np.sqrt(2), rel=0.3)


def test_allan_deviation_of_white_noise_falls_with_the_root_of_time() -> None:
    """White noise of density d has a deviation of d / sqrt(tau); the estimate is within a few
    percent.
    """
    density, step_s = 2e-3, 0.005
    values = np.random.default_rng(1).normal(0, density / np.sqrt(step_s), (20000, 3))
    for tau in (0.05, 0.2, 1.0):
        assert allan_deviation(values, step_s, tau) == pytest.approx(
            density / np.sqrt(tau), rel=0.1
        )


def record_at_rest(density: float, seconds: float = 6.0) -> ImuRecord:
    """A resting IMU of 200 Hz with white noise."""
    rng = np.random.default_rng(2)
    count = int(200 * seconds)
    noise = rng.normal(0, density / np.sqrt(0.005), (2, count, 3))
    return ImuRecord(
        np.arange(count, dtype=np.int64) * 5_000_000, noise[0], noise[1] + [0, 0, 9.81]
    )


def test_noise_at_rest_is_compared_with_the_data_sheet() -> None:
    part = noise_part(record_at_rest(5e-4), ImuDensities(1e-4, 1e-5, 5e-4, 1e-4))
    assert part.facts["gyro_density"] == pytest.approx(5e-4, rel=0.2)
    assert re.search(
        r"gyro .* \([45]\.\d times the stated\); state the measured one, accel [^;]*, at rest",
        part.text,
    )
    assert noise_part(record_at_rest(5e-4, 2.0), None) is None, "too short"


def test_rest_and_the_direction_of_gravity() -> None:
    # the IMU's z is the camera's -y
    upright = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    part = rest_part(record_at_rest(5e-4), upright)
    assert part.facts["still_share"] == 1.0
    assert part.facts["camera_tilt_deg"] == pytest.approx(0, abs=0.1)
    assert part.faults == []
    moving = record_at_rest(5e-4)
    shaken = ImuRecord(
        moving.times_ns, moving.gyro + np.sin(np.arange(1200) / 9)[:, None], moving.accel
    )
    assert rest_part(shaken, None).facts["still_share"] == 0.0


@pytest.mark.parametrize("name", ["tumvi_room1_head", "ros2_s3e_db3"])
def test_real_recordings(name: str, data_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if name == "ros2_s3e_db3":
        pytest.importorskip("rosbags", reason="needs rosbags")
        assert "holds no CameraInfo" in refused(capsys, "inspect", data_dir / name)
        return
    status, facts = inspect(data_dir / name, capsys, "--frames", "0", "--pairs", "1")
    assert status == 0, facts["faults"]
    assert facts["parts"]["IMU"]["count"] > 500


def test_a_span_of_the_recording_is_examined_alone(
    flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--pairs", "2", "--frames", "3", "--start", "2", "--stop", "7"]
    parts = inspect(flight, capsys, *options)[1]["parts"]
    assert parts["frames"]["count"] == 5
    assert parts["tracking"]["frames"] == 3
    assert parts["frames"]["duration_s"] < parts["IMU"]["duration_s"]
    assert parts["IMU"]["covered"] == 1.0
    whole = inspect(flight, capsys, "--frames", "0")[1]["parts"]
    assert whole["IMU"]["count"] > parts["IMU"]["count"]


def test_stamps_that_are_even_but_for_rounding_have_no_jitter(
    flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["inspect", str(flight), "--pairs", "1", "--frames", "0"]) == 0
    out = capsys.readouterr().out
    assert "Hz, even, no gap" in out
    assert "e-0" not in out
    assert "(1: blurred by 2 px or more)" in out


@pytest.mark.parametrize(("mean", "is_named"), [(11.0, True), (13.0, False), (242.0, False)])
@pytest.mark.parametrize("spread", [20.0])
def test_names_images_without_light(mean: float, spread: float, is_named: bool) -> None:
    image = np.zeros((4, 4), np.uint8)
    levels = GrayLevels(mean, spread, 0.0, 2.0)
    faults = _image_faults([(image,)] * 3, [[levels] * 3])
    assert [fault.startswith("3 of 3 images are black") for fault in faults] == [True] * is_named


@pytest.mark.parametrize(("mean", "spread"), [(244.0, 20.0), (100.0, 2.8)])
def test_names_images_that_are_white_or_flat(mean: float, spread: float) -> None:
    image = np.zeros((4, 4), np.uint8)
    assert len(_image_faults([(image,)], [[GrayLevels(mean, spread, 0.0, 2.0)]])) == 1
    assert _image_faults([(image,)], [[GrayLevels(100.0, 3.2, 0.0, 2.0)]]) == []


def test_windows_of_pairs_that_overlap_read_no_frame_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A short recording has fewer frames than the windows that are looked at."""
    dataset = open_dataset(make_plain(tmp_path, 20))
    read: list[int] = []
    events = ImageRecording.events

    def noted(
        self: ImageRecording, start: int = 0, stop: int | None = None, **options: bool
    ) -> Iterator[Event]:
        read.extend(range(start, stop or 0))
        return events(self, start, stop, **options)

    monkeypatch.setattr(ImageRecording, "events", noted)
    _pairs_parts(dataset, range(20))
    assert sorted(read) == list(range(20))


def test_ground_truth_of_another_clock_is_named(tmp_path: Path) -> None:
    """It covered '0 % of the frames', and nothing was missing."""
    folder = make_plain(tmp_path)
    file = folder / "reference.tum"
    shifted_s = lambda match: f"{int(match[1]) + 18}."  # noqa: E731
    recording = open_dataset(folder).recording
    assert "another clock" not in _reference_part(recording, recording.frame_times_ns).text
    file.write_text(re.sub(r"(?m)^(\d+)\.", shifted_s, file.read_text()))
    recording = open_dataset(folder).recording
    text = _reference_part(recording, recording.frame_times_ns).text
    assert "over 0 % of the frames: of another clock or recording; it begins +18.000 s" in text
    assert "the ground truth were late by 18 s (GPS time and UTC)" in text
