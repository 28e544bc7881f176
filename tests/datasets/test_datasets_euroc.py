"""EuRoC folders: exact calibration and clocks, rectified frames, and an error that names each
defect.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.dataset_makers import edit
from tests.euroc_maker import (
    EQUIDISTANT_RIG,
    HEIGHT,
    RADTAN_RIG,
    RECTIFIED_RIG,
    START_NS,
    STEP_NS,
    T_IMU_CAM0,
    WIDTH,
    camera_stamps,
    imu_stamps,
    make_euroc,
    matrix,
    sensor_yaml,
    truth_poses,
    write_imu,
)
from tests.same_events import frames_of
from tests.sift import match_sift
from vio.cameras.rig import Rig, rectifier_of
from vio.cli.running import RunOptions, process
from vio.config import load_config
from vio.datasets import DatasetSettings, open_dataset
from vio.datasets.companions import imu_on_camera_clock
from vio.datasets.euroc import read_euroc
from vio.datasets.euroc_files import camera_yaml, read_camera_yaml, rig_read_as
from vio.datasets.frame_times import pair_stamps
from vio.datasets.image_pairs import ImageDataset
from vio.datasets.images import load_gray
from vio.errors import NOTE, CalibrationError, DataError
from vio.geometry.distortion import StereoRig
from vio.geometry.lie import se3_exp, se3_from_parts, se3_inverse, so3_exp
from vio.geometry.rectify import rectified_cameras, rectifying_rotations
from vio.geometry.stereo import StereoCamera
from vio.records import ImuDensities, ImuRecord, ImuSample, Recording, StereoFrame
from vio.sim.rigs import euroc_like_rig


def _read(path: Path, **settings: object) -> ImageDataset:
    return read_euroc(path, replace(DatasetSettings(), **settings))  # type: ignore[arg-type] # names are checked by replace


def test_calibration_clock_and_truth_are_read(tmp_path: Path) -> None:
    dataset = _read(make_euroc(tmp_path))
    recording, expected = dataset.recording, rectified_cameras(RADTAN_RIG)
    assert recording.kind == "euroc"
    assert recording.camera == expected.camera
    np.testing.assert_allclose(recording.T_cam0_imu, expected.T_rect0_imu, atol=1e-12)
    assert recording.frame_times_ns.tolist() == camera_stamps(4)
    assert recording.motion == {"imu"}
    assert recording.notes == ()
    assert dataset.imu_noise == ImuDensities(
        gyro=1.6968e-4, gyro_walk=1.9393e-5, accel=2e-3, accel_walk=3e-3
    )
    assert recording.reference.body == "imu"
    assert recording.reference.times_ns.tolist() == camera_stamps(4)
    np.testing.assert_allclose(recording.reference.T_world_body, truth_poses(4), atol=1e-9)
    assert dataset.observations(0) is None


@pytest.mark.parametrize("source", ["{}", "{}/mav0", "euroc:{}", "euroc:{}/mav0"])
def test_detects_the_folder_or_its_mav0_from_content(source: str, tmp_path: Path) -> None:
    make_euroc(tmp_path, truth="tum")
    recording = open_dataset(source.format(tmp_path)).recording
    assert recording.kind == "euroc"
    np.testing.assert_allclose(recording.reference.T_world_body, truth_poses(4), atol=1e-9)


def test_events_are_in_time_order_with_imu_samples_first(tmp_path: Path) -> None:
    dataset = _read(make_euroc(tmp_path))
    events = list(dataset.events(1, 3))
    assert [e.index for e in events if isinstance(e, StereoFrame)] == [1, 2]
    stamps = camera_stamps(4)
    assert [e.time_ns for e in events if isinstance(e, ImuSample)] == [
        t for t in imu_stamps(4) if stamps[1] - 10**9 <= t <= stamps[2]
    ], "raw IMU begins up to a second before the first frame"
    order = [(e.time_ns, isinstance(e, StereoFrame)) for e in events]
    assert order == sorted(order)
    at = next(k for k, e in enumerate(events) if isinstance(e, StereoFrame))
    assert events[at - 1].time_ns == events[at].time_ns, "the sample with the frame's time first"
    first = events[0]
    k = imu_stamps(4).index(first.time_ns)
    assert first.gyro.tolist() == [k + 0.5, 0.1, -0.2]
    assert first.accel.tolist() == [9.81, -k, 0.25]
    assert all(e.left is None for e in dataset.events(images=False) if isinstance(e, StereoFrame))


def _opencv_maps(rig: StereoRig) -> list[tuple[np.ndarray, np.ndarray]]:
    """Lookup maps from OpenCV's undistortion, with this package's rotations and rectified
    camera.
    """
    camera = rectified_cameras(rig).camera
    rotations = rectifying_rotations(rig)[:2]
    maps = []
    for model, R in zip((rig.cam0, rig.cam1), rotations, strict=True):
        make = (
            cv2.fisheye.initUndistortRectifyMap
            if model.model == "equidistant"
            else cv2.initUndistortRectifyMap
        )
        maps.append(
            make(
                model.K, np.array([model.coefficients]), R, camera.K, (WIDTH, HEIGHT), cv2.CV_32FC1
            )
        )
    return maps


@pytest.mark.parametrize("rig", [RADTAN_RIG, EQUIDISTANT_RIG], ids=["radtan", "equidistant"])
def test_frames_are_rectified_as_opencv_would(rig: StereoRig, tmp_path: Path) -> None:
    dataset = _read(make_euroc(tmp_path, rig=rig))
    maps = _opencv_maps(rig)
    for frame in frames_of(dataset):
        for image, path, (u, v) in zip(
            (frame.left, frame.right), dataset.pairs[frame.index], maps, strict=True
        ):
            expected = cv2.remap(
                load_gray(path)[0], u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            difference = np.abs(image.astype(int) - expected.astype(int))
            assert difference.max() <= 3
            assert (difference > 1).mean() < 0.002
            assert np.abs(image.astype(int) - load_gray(path)[0]).mean() > 5, (
                "the raw image is another one"
            )


def test_interpolation_is_a_setting(tmp_path: Path) -> None:
    make_euroc(tmp_path)
    lefts = {}
    for name in ("linear", "cubic", "lanczos4"):
        left = frames_of(_read(tmp_path, interpolation=name))[0].left
        lefts[name] = left.astype(int)
    for other in ("cubic", "lanczos4"):
        assert 0 < np.abs(lefts["linear"] - lefts[other]).mean() < 3


def _rounded(rig: StereoRig, digits: int) -> StereoRig:
    return replace(
        rig,
        T_imu_cam0=np.round(rig.T_imu_cam0, digits),
        T_imu_cam1=np.round(rig.T_imu_cam1, digits),
    )


@pytest.mark.parametrize(
    "rig", [RECTIFIED_RIG, _rounded(RECTIFIED_RIG, 6)], ids=["exact", "six digits"]
)
def test_a_rectified_folder_passes_through_unchanged(rig: StereoRig, tmp_path: Path) -> None:
    dataset = _read(make_euroc(tmp_path, rig=rig))
    camera = dataset.recording.camera
    assert (camera.fu, camera.fv, camera.cu, camera.cv) == (40, 40, 31.5, 23.5)
    assert camera.baseline_m == pytest.approx(0.11, abs=1e-6)
    np.testing.assert_allclose(dataset.recording.T_cam0_imu, se3_inverse(T_IMU_CAM0), atol=2e-6)
    for frame in frames_of(dataset):
        for image, path in zip((frame.left, frame.right), dataset.pairs[frame.index], strict=True):
            np.testing.assert_array_equal(image, load_gray(path)[0])


@pytest.mark.parametrize(
    "turn", [[0, 0, 0, 2e-4, 0, 0], [0, 1e-4, 0, 0, 0, 0]], ids=["turned by 0.01 deg", "0.1 mm up"]
)
def test_a_pair_that_is_nearly_rectified_is_rectified(turn: list[float], tmp_path: Path) -> None:
    rig = replace(RECTIFIED_RIG, T_imu_cam1=RECTIFIED_RIG.T_imu_cam1 @ se3_exp(turn))
    assert _read(make_euroc(tmp_path, rig=rig)).rectifier.maps is not None


def test_the_imu_frame_is_the_body_frame(tmp_path: Path) -> None:
    """The same rig in another body frame: only the world-to-body poses of the ground truth
    change.
    """
    T_body_imu = se3_from_parts(so3_exp([0.3, -0.2, 0.5]), [0.1, 0.2, -0.05])
    moved = replace(
        RADTAN_RIG,
        T_imu_cam0=T_body_imu @ RADTAN_RIG.T_imu_cam0,
        T_imu_cam1=T_body_imu @ RADTAN_RIG.T_imu_cam1,
    )
    write_imu(make_euroc(tmp_path, rig=moved) / "mav0" / "imu0", 4, T_body_imu)
    recording = _read(tmp_path).recording
    np.testing.assert_allclose(
        recording.T_cam0_imu, rectified_cameras(RADTAN_RIG).T_rect0_imu, atol=1e-9
    )
    np.testing.assert_allclose(
        recording.reference.T_world_body, truth_poses(4) @ T_body_imu, atol=1e-9
    )


def test_truth_of_the_raw_camera_is_moved_to_the_imu(tmp_path: Path) -> None:
    path = make_euroc(tmp_path, truth="tum") / "groundtruth_tum.txt"
    path.write_text("# body: cam0\n" + path.read_text())
    reference = _read(tmp_path).recording.reference
    assert reference.body == "imu"
    np.testing.assert_allclose(
        reference.T_world_body, truth_poses(4) @ se3_inverse(T_IMU_CAM0), atol=1e-9
    )


def test_folder_without_imu_and_ground_truth(tmp_path: Path) -> None:
    dataset = _read(make_euroc(tmp_path, imu=False, truth=None))
    assert dataset.recording.motion == frozenset()
    assert dataset.recording.reference is None
    assert dataset.recording.T_cam0_imu is not None
    assert dataset.imu_noise is None
    assert len(list(dataset.events())) == 4


# --- lists and clocks that do not quite agree
# -----------------------------------------------------------------------


def test_finds_images_with_another_extension(tmp_path: Path) -> None:
    dataset = _read(make_euroc(tmp_path, suffix=".jpg"))
    assert [note for note in dataset.recording.notes if "another extension" in note] == [
        "8 images have another extension than listed in their data.csv; matched by their stem"
    ]
    assert len(frames_of(dataset)) == 4


def test_a_copy_that_ended_early_is_used_as_far_as_it_goes(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Right images are missing at the end, and the last line of the IMU's record is cut: both
    are said.
    """
    mav = make_euroc(tmp_path, 6) / "mav0"
    for image in sorted((mav / "cam1" / "data").iterdir())[-2:]:
        image.unlink()
    record = mav / "imu0" / "data.csv"
    lines = record.read_text().splitlines()
    record.write_text("\n".join([*lines[:-1], ",".join(lines[-1].split(",")[:3])]))
    dataset = open_dataset(tmp_path)
    assert len(dataset.recording.frame_times_ns) == 4
    notes = dataset.recording.notes
    assert "the last 2 of 6 listed images of cam1 are missing; 4 pairs are used" in notes
    assert any(
        f"line {len(lines)}: the last line ends too early (3 of 7 values); left out" in note
        for note in notes
    )
    for motion, said in (("imu", 1), ("none", 0)):
        caplog.clear()
        with caplog.at_level(NOTE):
            process(
                str(tmp_path),
                load_config(overrides=[f"motion={motion}"]),
                RunOptions(out=tmp_path / motion, plot=False),
            )
        assert sum("ends too early" in record.getMessage() for record in caplog.records) == said
    samples = [event for event in dataset.events() if isinstance(event, ImuSample)]
    assert samples[-1].time_ns <= int(lines[-2].split(",")[0])
    assert sum(isinstance(event, StereoFrame) for event in dataset.events()) == 4


def test_skips_and_counts_unmatched_images(tmp_path: Path) -> None:
    make_euroc(tmp_path, 6)
    left, right = (tmp_path / "mav0" / name / "data.csv" for name in ("cam0", "cam1"))
    _drop_lines(left, [1])
    _drop_lines(right, [3, 6])
    recording = _read(tmp_path).recording
    assert recording.frame_times_ns.tolist() == [camera_stamps(6)[k] for k in (1, 3, 4)]
    assert recording.notes == (
        "1 images of cam0 and 2 of cam1 are not listed in their data.csv and are skipped",
        "2 images of cam0 and 1 of cam1 have no partner and are skipped",
    )


def _drop_lines(path: Path, numbers: list[int]) -> None:
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for k, line in enumerate(lines) if k not in numbers))


def test_pairs_images_at_a_constant_clock_offset(tmp_path: Path) -> None:
    offsets = [1_200_000, 1_190_000, 1_210_000, 1_200_000, 9_000_000, -1_400_000]
    dataset = _read(make_euroc(tmp_path, 6, right_offsets_ns=offsets))
    assert dataset.recording.frame_times_ns.tolist() == camera_stamps(6)[:4]
    assert "median +1.200 ms" in " ".join(dataset.recording.notes)
    assert "2 images of cam0 and 2 of cam1" in " ".join(dataset.recording.notes)
    assert all(int(right.stem) - int(left.stem) > 1e6 for left, right in dataset.pairs)


@pytest.mark.parametrize("seed", range(8))
def test_pairing_agrees_with_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = np.arange(40) * STEP_NS + rng.integers(0, STEP_NS // 4, 40)
    offset = int(rng.integers(-1_900_000, 1_900_000))
    kept = rng.random((2, 40)) < 0.8
    a, b = pair_stamps(true[kept[0]], true[kept[1]] + offset)
    both = np.flatnonzero(kept[0] & kept[1])
    np.testing.assert_array_equal(true[kept[0]][a], true[both])
    np.testing.assert_array_equal((true[kept[1]] + offset)[b], true[both] + offset)


def test_pairing_single_stamps() -> None:
    one = np.array([START_NS])
    assert [x.tolist() for x in pair_stamps(one, one + 5)] == [[0], [0]]
    assert [len(x) for x in pair_stamps(one, one + 5_000_000)] == [0, 0]


# --- sensor.yaml
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "rig", [RADTAN_RIG, EQUIDISTANT_RIG, RECTIFIED_RIG], ids=["radtan", "equidistant", "pinhole"]
)
def test_camera_yaml_round_trips(rig: StereoRig, tmp_path: Path) -> None:
    path = tmp_path / "sensor.yaml"
    path.write_text(camera_yaml(rig.cam0, rig.T_imu_cam0, comment="written", rate_hz=20))
    camera, T = read_camera_yaml(path)
    assert camera == rig.cam0
    np.testing.assert_array_equal(T, rig.T_imu_cam0)


def test_other_spellings_of_a_calibration_are_read(tmp_path: Path) -> None:
    text = sensor_yaml(RADTAN_RIG.cam0, T_IMU_CAM0)
    path = tmp_path / "sensor.yaml"
    rows = "[" + ", ".join(f"[{matrix(row)}]" for row in T_IMU_CAM0) + "]"
    for changed in (
        text.replace("%YAML:1.0\n", ""),
        text.replace("%YAML:1.0\n", "%YAML:1.0\n---\n").replace("T_BS:", "T_BS: !!opencv-matrix"),
        re.sub(r"T_BS:.*?\]\n", f"T_BS: {rows}\n", text, flags=re.DOTALL),
        text.replace("radial-tangential", "radtan")
        .replace("2e-05", "2e-5")
        .replace("camera_model: pinhole\n", ""),
    ):
        path.write_text(changed)
        camera, T = read_camera_yaml(path)
        assert camera == RADTAN_RIG.cam0
        np.testing.assert_allclose(T, T_IMU_CAM0, atol=1e-12)


# --- bad input
# --------------------------------------------------------------------------------------------------

Corruption = Callable[[Path], object]


def _edit(name: str, old: str, new: str) -> Corruption:
    return lambda mav: edit(mav / name, old, new)


def _line(name: str, number: int, text: str) -> Corruption:
    def corrupt(mav: Path) -> None:
        lines = (mav / name).read_text().splitlines()
        lines[number - 1] = text
        (mav / name).write_text("\n".join(lines) + "\n")

    return corrupt


def _swap_cameras(mav: Path) -> None:
    for name, T in (("cam0", RADTAN_RIG.T_imu_cam1), ("cam1", RADTAN_RIG.T_imu_cam0)):
        (mav / name / "sensor.yaml").write_text(sensor_yaml(RADTAN_RIG.cam0, T))


def _same_place(mav: Path) -> None:
    (mav / "cam1" / "sensor.yaml").write_text(sensor_yaml(RADTAN_RIG.cam1, T_IMU_CAM0))


def _shift_clock(name: str, by_ns: int) -> Corruption:
    def corrupt(mav: Path) -> None:
        path = mav / name / "data.csv"
        head, *lines = path.read_text().splitlines()
        moved = [re.sub(r"^\d+", lambda m: str(int(m[0]) + by_ns), line) for line in lines]
        path.write_text("\n".join([head, *moved]) + "\n")

    return corrupt


_T0, _T1 = camera_stamps(4)[:2]
_NO_YAML_MESSAGE = r"cam1/sensor.yaml is missing; it holds the sensor's calibration"
BAD: dict[str, tuple[Corruption, type[DataError], str]] = {
    "no cam1 in euroc:FOLDER": (
        lambda mav: (mav / "cam1").rename(mav / "camB"),
        DataError,
        r"mav0: holds no cam1; give an EuRoC folder",
    ),
    "no sensor.yaml": (
        lambda mav: (mav / "cam1/sensor.yaml").unlink(),
        CalibrationError,
        _NO_YAML_MESSAGE,
    ),
    "no list of images": (
        lambda mav: (mav / "cam0/data.csv").unlink(),
        DataError,
        r"cannot read .*cam0/data.csv",
    ),
    "yaml is a list": (
        lambda mav: (mav / "cam0/sensor.yaml").write_text("- 1\n"),
        CalibrationError,
        "no calibration",
    ),
    "yaml is broken": (
        _edit("cam0/sensor.yaml", "T_BS:", "T_BS: ["),
        CalibrationError,
        r"sensor.yaml: not a YAML file",
    ),
    "unknown lens": (
        _edit("cam0/sensor.yaml", "radial-tangential", "double-sphere"),
        CalibrationError,
        "'double-sphere' is not read; known: none, radial-tangential, radtan, plumb_bob, "
        "rational_polynomial,",
    ),
    "unknown camera": (
        _edit("cam0/sensor.yaml", "camera_model: pinhole", "camera_model: omni"),
        CalibrationError,
        "camera_model 'omni' is not supported",
    ),
    "no intrinsics": (
        _edit("cam0/sensor.yaml", "intrinsics", "extras"),
        CalibrationError,
        "has no entry 'intrinsics'",
    ),
    "three intrinsics": (
        _edit("cam0/sensor.yaml", "intrinsics: [41.0, ", "intrinsics: ["),
        CalibrationError,
        r"'intrinsics' is .* instead of 4 finite numbers",
    ),
    "text in intrinsics": (
        _edit("cam0/sensor.yaml", "intrinsics: [41.0", "intrinsics: [wide"),
        CalibrationError,
        r"'intrinsics' is .* instead of 4 finite numbers",
    ),
    "negative focal": (
        _edit("cam0/sensor.yaml", "intrinsics: [41.0", "intrinsics: [-41.0"),
        CalibrationError,
        r"cam0/sensor.yaml: focal lengths and image size must be positive",
    ),
    "three coefficients": (
        _edit(
            "cam0/sensor.yaml", "distortion_coefficients: [-0.28, ", "distortion_coefficients: ["
        ),
        CalibrationError,
        r"cam0/sensor.yaml: the radtan model takes 4 distortion coefficients or 5 or 8, got 3",
    ),
    "short T_BS": (
        _edit("cam0/sensor.yaml", "data: [", "data: [0]\n  rest: ["),
        CalibrationError,
        "T_BS must hold 16",
    ),
    "T_BS mirrors": (
        lambda mav: (mav / "cam0/sensor.yaml").write_text(
            sensor_yaml(RADTAN_RIG.cam0, np.diag([1.0, 1, -1, 1]))
        ),
        CalibrationError,
        r"cam0/sensor.yaml, T_BS: not a rotation but a reflection",
    ),
    "T_BS stretches": (
        lambda mav: (mav / "cam0/sensor.yaml").write_text(
            sensor_yaml(RADTAN_RIG.cam0, np.diag([1.0, 1.1, 1, 1]))
        ),
        CalibrationError,
        r"cam0/sensor.yaml, T_BS: not a rotation",
    ),
    "swapped cameras": (_swap_cameras, CalibrationError, r"mav0: .*the cameras may be swapped"),
    "no baseline": (
        _same_place,
        CalibrationError,
        r"mav0: .*the baseline is zero; check both T_BS",
    ),
    "image missing": (
        lambda mav: (mav / f"cam1/data/{_T1}.png").unlink(),
        DataError,
        rf"cam1/data.csv, line 3: .*{_T1}.png is missing \(1 of 4 listed images are\)",
    ),
    "clock repeats": (
        _line("cam0/data.csv", 3, f"{_T0},{_T0}.png"),
        DataError,
        r"line 3: the clock repeats",
    ),
    "clock backwards": (
        _line("cam0/data.csv", 3, f"12,{_T0}.png"),
        DataError,
        r"line 3: the clock runs backwards",
    ),
    "float stamp": (
        _line("cam0/data.csv", 3, f"1.4e18,{_T1}.png"),
        DataError,
        "'1.4e18' is no time in whole nano",
    ),
    "stamps in seconds": (
        _line("imu0/data.csv", 4, "1403715273.257142976,0,0,0,0,0,9.8"),
        DataError,
        r"line 4: '1403715273.257142976' is no time .*; write seconds times 1e9, without a point "
        r"or exponent",
    ),
    "gravity among the gyro's columns": (
        lambda mav: (mav / "imu0/data.csv").write_text(
            "".join(f"{_T0 + k},0,0,9.8,0,0,0.1\n" for k in range(9))
        ),
        DataError,
        r"imu0/data.csv: gravity is in the columns 2 to 4 \(median 9.80\).*; exchange these "
        r"columns with 5 to 7",
    ),
    "three columns": (
        _line("cam0/data.csv", 3, f"{_T1},a,b"),
        DataError,
        r"line 3: 3 values instead of 2",
    ),
    "empty list": (
        lambda mav: (mav / "cam0/data.csv").write_text("#timestamp [ns],filename\n"),
        DataError,
        r"cam0/data.csv: holds no line of data",
    ),
    "no partners": (
        _shift_clock("cam1", 20_000_000),
        DataError,
        r"no image of cam0 .* has one of cam1 .* within 3 ms",
    ),
    "a NaN in the IMU readings": (
        _line("imu0/data.csv", 4, f"{imu_stamps(4)[2]},0,nan,0,0,0,9.8"),
        DataError,
        r"imu0/data.csv, line 4: a reading is not a finite number",
    ),
    "text in the IMU readings": (
        _line("imu0/data.csv", 4, f"{imu_stamps(4)[2]},0,x,0,0,0,9.8"),
        DataError,
        r"imu0/data.csv, line 4: a reading is not a finite number",
    ),
    "an IMU with three columns": (
        _line("imu0/data.csv", 4, "1,2,3"),
        DataError,
        r"imu0/data.csv, line 4: 3 values instead of 7",
    ),
    "IMU stamps that repeat": (
        _line("imu0/data.csv", 4, f"{imu_stamps(4)[1]},0,0,0,0,0,9.8"),
        DataError,
        r"imu0/data.csv, line 4: the clock repeats",
    ),
    "an empty IMU": (
        lambda mav: (mav / "imu0/data.csv").write_text("#t\n"),
        DataError,
        r"imu0/data.csv: holds no line",
    ),
    "an IMU without data": (
        lambda mav: (mav / "imu0/data.csv").unlink(),
        DataError,
        r"cannot read .*imu0/data.csv",
    ),
    "an IMU of another time": (
        _shift_clock("imu0", 10**12),
        DataError,
        r"no sample is within the time of the images",
    ),
    "IMU noise of zero": (
        _edit(
            "imu0/sensor.yaml",
            "accelerometer_random_walk: 3.0000e-3",
            "accelerometer_random_walk: 0",
        ),
        CalibrationError,
        "accelerometer_random_walk is 0; a noise density must be positive",
    ),
    "half of the IMU noise": (
        _edit("imu0/sensor.yaml", "gyroscope_random_walk", "gyroscope"),
        CalibrationError,
        "has no entry 'gyroscope_random_walk'",
    ),
    "ground truth that turns by no rotation": (
        _line("state_groundtruth_estimate0/data.csv", 3, f"{_T1},1,2,3,1,1,1,1,0,0,0,0,0,0,0,0,0"),
        DataError,
        r"state_groundtruth_estimate0/data.csv, line 3: the quaternion has norm 2",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_rejects_bad_folders_with_one_line_error(case: str, tmp_path: Path) -> None:
    corrupt, kind, message = BAD[case]
    corrupt(make_euroc(tmp_path) / "mav0")
    with pytest.raises(kind, match=message) as caught:
        # of itself, a folder without cam1 is a recording of one camera
        open_dataset(f"euroc:{tmp_path}")
    assert "\n" not in str(caught.value)


def test_unreadable_images_are_skipped_up_to_a_limit(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    make_euroc(tmp_path)
    file = tmp_path / "mav0" / "cam1" / "data" / f"{_T1}.png"
    file.write_bytes(file.read_bytes()[:300])
    dataset = _read(tmp_path)
    assert [frame.index for frame in frames_of(dataset)] == [0, 2, 3]
    assert f"{_T1}.png: the PNG is truncated" in caplog.text
    with pytest.raises(DataError, match=r"truncated.*max_bad_frames allows 0"):
        frames_of(_read(tmp_path, max_bad_frames=0))


def test_rejects_images_of_another_size_than_the_calibration(tmp_path: Path) -> None:
    make_euroc(tmp_path)
    for file in (tmp_path / "mav0" / "cam1" / "data").iterdir():
        cv2.imwrite(str(file), np.zeros((20, 30), np.uint8))
    message = r"none of 4 frames can be used; the first: .*png is 30 x 20 pixels but .*cam1/sensor.yaml is for 64 x 48"
    with pytest.raises(DataError, match=message):
        frames_of(_read(tmp_path))


def test_an_imu_without_calibration_is_noted(tmp_path: Path) -> None:
    (make_euroc(tmp_path) / "mav0" / "imu0" / "sensor.yaml").unlink()
    dataset = _read(tmp_path)
    assert dataset.imu_noise is None
    assert (
        "imu0/sensor.yaml is missing; the IMU is assumed to be the body frame"
        in dataset.recording.notes[0]
    )


# --- real recordings
# ------------------------------------------------------------------------------------------------


def _real(data_dir: Path, name: str) -> ImageDataset:
    dataset = open_dataset(data_dir / "euroc" / name)
    assert isinstance(dataset, ImageDataset)
    return dataset


def _check_real(recording: Recording, frames: int) -> None:
    assert recording.notes == ()
    assert len(recording.frame_times_ns) == frames
    assert recording.camera.baseline_m == pytest.approx(0.1100778, abs=1e-6)
    assert (recording.camera.width, recording.camera.height) == (752, 480)


def test_real_keyframes_have_matching_rows(data_dir: Path) -> None:
    dataset = _real(data_dir, "V1_01_keyframes")
    _check_real(dataset.recording, 100)
    reference = dataset.recording.reference
    assert len(reference) == 2895
    assert reference.body == "imu"
    assert len(dataset.motion) == 29120
    rows = []
    for index in (10, 40, 70):
        frame = next(e for e in dataset.events(index, index + 1) if isinstance(e, StereoFrame))
        pl, pr = match_sift(frame.left, frame.right)
        rows.append(pl[:, 1] - pr[:, 1])
    dv = np.abs(np.concatenate(rows))
    assert len(dv) > 300
    assert np.median(dv) <= 0.2
    assert np.percentile(dv, 95) <= 0.8


def test_real_stationary_start_measures_gravity(data_dir: Path) -> None:
    dataset = _real(data_dir, "V1_01_static")
    _check_real(dataset.recording, 12)
    accel = np.mean([s.accel for s in dataset.motion if isinstance(s, ImuSample)], axis=0)
    assert np.linalg.norm(accel) == pytest.approx(9.81, abs=0.15)
    down_in_cam = dataset.recording.T_cam0_imu[:3, :3] @ -accel / np.linalg.norm(accel)
    assert down_in_cam[1] > 0.8, "the cameras are upright: gravity points down the image"


def test_a_rectified_pair_is_read_from_its_poses_to_the_last_bit() -> None:
    """EuRoC's calibration, whose printed rotation is one to 13 digits only: inverting twice
    moved it by 2e-14 m.
    """
    pair = rectified_cameras(euroc_like_rig())
    again = rectifier_of(rig_read_as(pair.camera, pair.T_rect0_imu))
    assert again.camera == pair.camera
    np.testing.assert_array_equal(again.T_rect0_imu, pair.T_rect0_imu)


def test_poses_that_no_inverse_gives_are_read_to_their_last_place() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        T = se3_from_parts(
            np.round(so3_exp(rng.normal(0, 2, 3)), 12), np.round(rng.normal(0, 0.3, 3), 12)
        )
        camera = StereoCamera(431.7, 431.7, 364.3, 254.2, float(rng.uniform(0.05, 0.6)), 752, 480)
        again = rectifier_of(rig_read_as(camera, T))
        np.testing.assert_array_equal(again.T_rect0_imu[:3, :3], T[:3, :3])
        np.testing.assert_allclose(again.T_rect0_imu, T, rtol=0, atol=4e-16)
        assert again.camera.baseline_m == pytest.approx(camera.baseline_m, abs=4e-16)


@pytest.mark.parametrize(("offset_s", "is_named"), [(0.9, False), (1.1, True), (-1.1, True)])
def test_a_long_shift_of_the_calibration_is_named_where_no_sample_fits(
    offset_s: float, is_named: bool
) -> None:
    """A time shift in milliseconds is taken for one in seconds."""
    times_ns = np.arange(100, dtype=np.int64) * 10_000_000
    zeros = np.zeros((100, 3))
    record = ImuRecord(times_ns + 60_000_000_000, zeros, zeros)
    rig = replace(Rig.rectified(40.0, 40.0, 31.5, 23.5, 0.11, 64, 48), time_offset_s=offset_s)
    with pytest.raises(DataError) as error:
        imu_on_camera_clock(record, rig, times_ns, "imu.csv")
    assert ("moved by the calibration's time shift" in str(error.value)) == is_named
