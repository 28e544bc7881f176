"""Plain folders: names, numbers, times, samples, calibrations, what is not used, and one-line
errors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.dataset_makers import calib_text, edit, make_kitti
from tests.euroc_maker import (
    KITTI_RIG,
    RADTAN_RIG,
    RECTIFIED_RIG,
    make_euroc,
    make_kitti_raw,
    truth_poses,
)
from tests.plain_maker import STEP_S, make_plain, rig_of
from tests.same_events import frames_of
from vio.datasets import DatasetSettings, open_dataset
from vio.datasets.images import UnreadableImageError, load_gray, other_damage
from vio.datasets.plain import read_plain
from vio.datasets.rigs.kalibr import kalibr_text
from vio.datasets.tables import read_imu_table
from vio.errors import CalibrationError, DataError, VioError
from vio.files.stamps import parse_stamps
from vio.records import ImuSample

DEFAULT = DatasetSettings()


# --- images
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "folders",
    [
        ("left", "right"),
        ("image_0", "image_1"),
        ("cam0/images", "cam1/images"),
        ("image_00/data", "image_01/data"),
        ("L", "R"),
        ("camera_left", "camera_right"),
    ],
    ids=lambda f: f[0],
)
def test_usual_folder_names_are_found(folders: tuple[str, str], tmp_path: Path) -> None:
    folder = make_plain(tmp_path, folders=folders)
    dataset = open_dataset(folder if folders[0] != "image_00/data" else f"plain:{folder}")
    recording = dataset.recording
    assert recording.kind == "plain"
    assert recording.motion == {"imu"}
    np.testing.assert_allclose(np.diff(recording.frame_times_ns), STEP_S * 1e9)
    assert recording.frame_times_ns[0] == 1700000000_000000000
    np.testing.assert_allclose(recording.reference.T_world_body, truth_poses(4), atol=1e-12)
    assert recording.notes == ()


def test_numbers_without_padding_are_sorted_as_numbers(tmp_path: Path) -> None:
    """left1, left2, …, left12: as text, left10 would come second."""
    folder = make_plain(
        tmp_path, 12, name=lambda side, k: f"{('left', 'right')[side]}{k + 1}.jpg", imu=False
    )
    pairs = read_plain(folder, DEFAULT).pairs
    assert [left.name for left, _ in pairs] == [f"left{k + 1}.jpg" for k in range(12)]
    assert [right.name for _, right in pairs] == [f"right{k + 1}.jpg" for k in range(12)]


@pytest.mark.parametrize("suffix", [".bmp", ".tif", ".pgm", ".webp"])
def test_other_image_types_are_read_and_truncated_ones_refused(suffix: str, tmp_path: Path) -> None:
    pixels = np.tile(np.arange(0, 248, 8, dtype=np.uint8), (24, 1))
    options = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == ".webp" else []
    assert cv2.imwrite(str(tmp_path / f"a{suffix}"), pixels, options)
    image, bits = load_gray(tmp_path / f"a{suffix}")
    assert bits == 8
    np.testing.assert_allclose(image.astype(int), pixels, atol=2)
    data = (tmp_path / f"a{suffix}").read_bytes()
    (tmp_path / f"b{suffix}").write_bytes(data[: len(data) // 2])
    with pytest.raises(UnreadableImageError, match=r"truncated|does not decode"):
        load_gray(tmp_path / f"b{suffix}")


def test_twelve_bits_in_sixteen_are_scaled_and_said(tmp_path: Path) -> None:
    folder = make_plain(tmp_path, imu=False, rig=RECTIFIED_RIG)
    expected = frames_of(open_dataset(folder))
    for file in folder.glob("*/*.png"):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert cv2.imwrite(str(file), image.astype(np.uint16) * 16)
    assert (
        "the images have 16 bits but use 12: the levels 0 to 4095 are scaled to 8 bits"
        in open_dataset(folder).recording.notes
    )
    for dark, bright in zip(frames_of(open_dataset(folder)), expected, strict=True):
        np.testing.assert_allclose(dark.left, bright.left, atol=1)


def test_unknown_image_data_is_named() -> None:
    assert other_damage(b"GIF89a") == "neither PNG nor JPEG, BMP, TIFF, PGM, PPM or WebP"
    assert other_damage(b"P5 nothing") == "the PGM or PPM has no valid header"


def test_images_without_a_partner_are_skipped_and_said(tmp_path: Path) -> None:
    folder = make_plain(tmp_path, times=False, imu=False, reference=False)
    (folder / "right" / "2.png").unlink()
    (folder / "left" / "3.png").unlink()
    recording = open_dataset(folder).recording
    assert len(recording.frame_times_ns) == 2
    assert "1 left and 1 right images have no partner and are skipped" in recording.notes


def test_stamps_of_two_clocks_in_names_are_paired(tmp_path: Path) -> None:
    stamp = 1700000000_000000000
    folder = make_plain(
        tmp_path,
        times=False,
        name=lambda side, k: f"{stamp + 50_000_000 * k + 1_000_000 * side}.png",
        reference=False,
    )
    dataset = read_plain(folder, DEFAULT)
    assert dataset.recording.frame_times_ns.tolist() == [stamp + 50_000_000 * k for k in range(4)]
    assert [int(b.stem) - int(a.stem) for a, b in dataset.pairs] == [1_000_000] * 4


# --- times and samples
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["0", "0.1"], [0, 100_000_000]),
        (["1700000000.000000001", "1700000000.1"], [1700000000_000000001, 1700000000_100000000]),
        (["1700000000123", "1700000000223"], [1700000000_123000000, 1700000000_223000000]),
        (["1700000000123456", "1700000000223456"], [1700000000_123456000, 1700000000_223456000]),
        (
            ["1700000000123456789", "1700000000223456789"],
            [1700000000_123456789, 1700000000_223456789],
        ),
        (["1.7e9", "1.7000000001e9"], [1700000000_000000000, 1700000000_100000000]),
    ],
)
def test_stamps_keep_every_digit_in_any_unit(texts: list[str], expected: list[int]) -> None:
    assert parse_stamps(texts, str).tolist() == expected


def test_times_may_name_the_images(tmp_path: Path) -> None:
    folder = make_plain(tmp_path, times=False)
    (folder / "times.txt").write_text(
        "# name time\n" + "".join(f"{k}.png 1700000000.{5 * k:02d}\n" for k in range(9))
    )
    assert np.diff(open_dataset(folder).recording.frame_times_ns).tolist() == [50_000_000] * 3


def test_times_in_milliseconds_since_the_start_are_read_and_doubted(tmp_path: Path) -> None:
    folder = make_plain(tmp_path, times=False, imu=False, reference=False)
    (folder / "times.txt").write_text("0\n50\n100\n150\n")
    recording = open_dataset(folder).recording
    (note,) = recording.notes
    assert "times are taken for milliseconds (frames 0.05 s apart)" in note
    assert "as they would be 50 s apart in seconds" in note
    assert recording.frame_times_ns.tolist() == [0, 50_000_000, 100_000_000, 150_000_000]


def test_without_times_images_alone_are_read_and_it_is_said(tmp_path: Path) -> None:
    recording = open_dataset(
        make_plain(tmp_path, times=False, imu=False, reference=False)
    ).recording
    assert np.diff(recording.frame_times_ns).tolist() == [100_000_000] * 3
    assert "frames are taken to be 0.1 s apart" in recording.notes[0]


def _numbered(tmp_path: Path, numbers: Sequence[int]) -> Path:
    """Write a folder without times whose images have these numbers."""
    folder = make_plain(tmp_path, times=False, imu=False, reference=False)
    for side in ("left", "right"):
        files = sorted((folder / side).iterdir())
        for file in files[len(numbers) :]:
            file.unlink()
        for file, number in reversed(list(zip(files, numbers, strict=False))):
            file.rename(file.with_name(f"{number:06d}{file.suffix}"))
    return folder


@pytest.mark.parametrize(
    ("numbers", "counts"),
    [
        ((0, 1, 2, 4), (0, 1, 2, 4)),  # lost images take their time
        ((10, 20, 40, 50), (0, 1, 3, 4)),
        ((0, 5, 10, 15), (0, 1, 2, 3)),
        ((3, 4, 9, 11), (0, 1, 2, 3)),  # chosen images: no even series
        ((0, 1, 2, 9), (0, 1, 2, 3)),  # more than half is missing
    ],
)
def test_without_times_the_numbers_of_lost_images_take_their_time(
    numbers: tuple[int, ...], counts: tuple[int, ...], tmp_path: Path
) -> None:
    recording = open_dataset(_numbered(tmp_path, numbers)).recording
    assert recording.frame_times_ns.tolist() == [100_000_000 * count for count in counts]
    holes = counts[-1] + 1 - len(counts)
    assert (f"with the {holes} that the numbers leave out" in recording.notes[0]) == (holes > 0)


def test_pairs_without_their_partner_take_their_time(tmp_path: Path) -> None:
    folder = make_plain(tmp_path, times=False, imu=False, reference=False)
    sorted((folder / "right").iterdir())[1].unlink()
    recording = open_dataset(folder).recording
    assert recording.frame_times_ns.tolist() == [0, 200_000_000, 300_000_000]


def test_an_empty_folder_of_right_images_is_named(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    for file in (folder / "right").iterdir():
        file.unlink()
    recording = open_dataset(folder).recording
    assert recording.camera.kind == "mono"
    assert f"{folder / 'right'} holds no images" in recording.notes[0]


@pytest.mark.parametrize(
    "header",
    [
        "# timestamp[ns] a.x a.y a.z w.x w.y w.z",
        "time_ns,ax_mps2,ay_mps2,az_mps2,gyro_x,gyro_y,gyro_z",
    ],
)
def test_a_header_names_the_order_of_the_readings(header: str, tmp_path: Path) -> None:
    separator = "," if "," in header else " "
    rows = [
        separator.join(map(str, [10**18 + 5_000_000 * k, 1, 2, 9.8, 0.1, 0.2, 0.3]))
        for k in range(3)
    ]
    (tmp_path / "imu.csv").write_text("\n".join([header, *rows]) + "\n")
    record, notes = read_imu_table(tmp_path / "imu.csv")
    assert notes == ()
    np.testing.assert_array_equal(record.gyro[0], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(record.accel[0], [1, 2, 9.8])


def test_units_of_the_header_are_converted_and_said(tmp_path: Path) -> None:
    header = "timestamp [s],w_x [deg/s],w_y [deg/s],w_z [deg/s],a_x [g],a_y [g],a_z [g]"
    rows = [f"{0.005 * k},90,0,0,0,0,1" for k in range(3)]
    (tmp_path / "imu.csv").write_text("\n".join([header, *rows]) + "\n")
    record, notes = read_imu_table(tmp_path / "imu.csv")
    np.testing.assert_allclose(record.gyro[0], [np.pi / 2, 0, 0])
    np.testing.assert_allclose(record.accel[0], [0, 0, 9.80665])
    assert len(notes) == 2
    assert np.diff(record.times_ns).tolist() == [5_000_000] * 2


def test_the_clock_offset_of_the_calibration_moves_the_imu(tmp_path: Path) -> None:
    """Kalibr: t_imu = t_cam + shift, so a sample's time on the camera's clock is its stamp less
    the shift.
    """
    folder = make_plain(tmp_path)
    path = folder / "camchain-imucam.yaml"
    path.write_text(path.read_text().replace("timeshift_cam_imu: 0.0", "timeshift_cam_imu: 0.0025"))
    dataset = open_dataset(folder)
    first = next(iter(dataset.events()))
    assert isinstance(first, ImuSample)
    assert first.time_ns == 1700000000_000000000 - 12_500_000
    assert (
        "the IMU's stamps are moved by -2.500 ms, as the calibration states"
        in dataset.recording.notes
    )


def test_a_slow_imu_is_said(tmp_path: Path) -> None:
    folder = make_plain(tmp_path, 40)
    lines = (folder / "imu.csv").read_text().splitlines()
    (folder / "imu.csv").write_text("\n".join([lines[0], *lines[1::20]]) + "\n")
    assert (
        "the IMU has 10 Hz, too few to integrate the motion between images"
        in open_dataset(folder).recording.notes[0]
    )


def test_velocities_and_kitti_calibration(tmp_path: Path) -> None:
    """KITTI's names with an IMU, which the KITTI reader does not read: nothing is left out."""
    folder = make_kitti(tmp_path)
    times = [float(x) for x in (folder / "times.txt").read_text().split()]
    rows = [f"{times[0] + 0.005 * k},0,0,0.1,0,0,9.8" for k in range(-2, 80)]
    (folder / "imu.csv").write_text("time_s,wx,wy,wz,ax,ay,az\n" + "\n".join(rows) + "\n")
    recording = open_dataset(folder).recording
    assert recording.kind == "plain"
    assert recording.motion == {"imu", "velocity"}
    assert recording.notes == ()
    assert recording.reference is not None


def test_poses_of_a_raw_camera_are_turned_to_the_rectified_one(tmp_path: Path) -> None:
    folder = make_plain(tmp_path, imu=False)
    (folder / "camchain-imucam.yaml").write_text(kalibr_text(rig_of(RADTAN_RIG, imu=False)))
    truth = (folder / "reference.tum").read_text()
    (folder / "reference.tum").write_text(truth.replace("# body: imu", "# body: cam0"))
    dataset = read_plain(folder, DEFAULT)
    R_rect_cam0 = dataset.rectifier.T_rect0_imu[:3, :3]
    assert np.abs(R_rect_cam0 - np.eye(3)).max() > 1e-3
    expected = truth_poses(4)[:, :3, :3] @ R_rect_cam0.T
    np.testing.assert_allclose(
        dataset.recording.reference.T_world_body[:, :3, :3], expected, atol=1e-12
    )


# --- what is used and what is not
# -----------------------------------------------------------------------------------


def test_what_is_not_used_is_named_once(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    (folder / "lidar").mkdir()
    (folder / "gps.csv").write_text("1,2\n")
    (folder / "README.md").write_text("hello\n")
    assert open_dataset(folder).recording.notes == ("not used: gps.csv, lidar/",)


def test_another_calibration_may_be_named(tmp_path: Path) -> None:
    for kind, folder in (
        ("plain", make_plain(tmp_path / "a", calibration=False)),
        ("euroc", make_euroc(tmp_path / "b")),
        ("kitti_raw", make_kitti_raw(tmp_path / "c")),
    ):
        rig = rig_of(KITTI_RIG if kind == "kitti_raw" else RADTAN_RIG)
        (tmp_path / "mine.yaml").write_text(kalibr_text(rig))
        recording = open_dataset(
            folder, DatasetSettings(calibration=tmp_path / "mine.yaml")
        ).recording
        assert recording.kind == "plain", kind
        assert recording.camera.baseline_m == pytest.approx(rig.camera.baseline_m), kind


def test_tumvi_export_without_sensor_yaml_is_read(tmp_path: Path) -> None:
    folder = make_euroc(tmp_path)
    for sensor in ("cam0", "cam1", "imu0"):
        (folder / "mav0" / sensor / "sensor.yaml").unlink()
    (folder / "dso").mkdir()
    (folder / "dso" / "camchain.yaml").write_text(kalibr_text(rig_of(RADTAN_RIG)))
    recording = open_dataset(folder).recording
    assert (recording.kind, recording.motion, len(recording.frame_times_ns)) == (
        "plain",
        {"imu"},
        4,
    )
    assert recording.reference is not None


# --- bad folders
# --------------------------------------------------------------------------------------------------


def _break(change: Callable[[Path], object], **options: bool) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        change(make_plain(folder, **options))  # type: ignore[arg-type]
        return folder

    return make


def _edit(name: str, old: str, new: str) -> Callable[[Path], Path]:
    return _break(lambda folder: edit(folder / name, old, new))


def _write(name: str, text: str, **options: bool) -> Callable[[Path], Path]:
    return _break(lambda f: (f / name).write_text(text), **options)


def _without_extrinsics(folder: Path) -> None:
    (folder / "camchain-imucam.yaml").write_text(kalibr_text(rig_of(RADTAN_RIG, imu=False)))


def _shifted(folder: Path) -> None:
    lines = (folder / "imu.csv").read_text().splitlines()
    moved = [
        ",".join([str(int(line.split(",")[0]) // 1000), *line.split(",")[1:]]) for line in lines[1:]
    ]
    (folder / "imu.csv").write_text("\n".join([lines[0], *moved]) + "\n")


BAD = {
    "no calibration": (
        lambda f: make_plain(f, calibration=False),
        "no calibration; add one as calibration.yaml",
    ),
    "names that fit nothing": (
        lambda f: make_plain(f, name=lambda side, k: f"{'ab'[side]}.png", frames=1),
        "no name of the one fits one of the other",
    ),
    "too few times": (_write("times.txt", "1\n2\n"), r"times\.txt holds 2 times for 4 image pairs"),
    "times that run backwards": (
        _write("times.txt", "1\n3\n2\n4\n"),
        "line 3: the clock runs backwards",
    ),
    "times that are no numbers": (_write("times.txt", "1\nx\n2\n4\n"), "line 2: 'x' is no time"),
    "times out of range": (
        _write("times.txt", "1\n2\n3\n1e99\n"),
        "line 4: '1e99' is out of range",
    ),
    "times out of reach": (
        _write("times.txt", "1\n2\n3\n1e999999999\n"),
        "line 4: '1e999999999' is out of range",
    ),
    "an IMU without times": (
        lambda f: make_plain(f, times=False),
        r"imu\.csv: needs the times of the images",
    ),
    "an IMU without its pose": (
        _break(_without_extrinsics),
        r"imu\.csv: needs the pose of its sensor; add T_cam0_imu",
    ),
    "unsorted IMU stamps": (
        _edit("imu.csv", "1699999999995000000", "1699999999989000000"),
        "runs backwards",
    ),
    "an IMU of another epoch": (
        _break(_shifted),
        "no sample is within the time of the images; clocks without overlap",
    ),
    "an IMU with six columns": (
        _edit("imu.csv", ",0.25,9.81,0", ",0.25,9.81"),
        "line 2: 6 values instead of 7",
    ),
    "an IMU with a digit separator": (
        _edit("imu.csv", "9.81", "9_81"),
        "line 2: a reading is not a finite number",
    ),
    "an IMU with a NaN": (
        _edit("imu.csv", "9.81", "nan"),
        "line 2: a reading is not a finite number",
    ),
    "an IMU with other names": (
        _edit("imu.csv", "wx,wy,wz", "mx,my,mz"),
        "does not name gyro and accel",
    ),
    "an empty IMU": (_write("imu.csv", "#timestamp,wx,wy,wz,ax,ay,az\n"), "holds no line of data"),
    "an IMU with times of another form": (
        _write("imu.csv", "time,wx,wy,wz,ax,ay,az\n12:00:00.5,0.1,0.1,0.1,0.1,9.8,0.1\n"),
        r"line 2, '12:00:00\.5,0\.1,0\.1,0\.1,0\.1,9\.8,0\.1', does not begin with a number \(decimals "
        r"need a point\)",
    ),
    "gravity among the gyro's columns": (
        _write(
            "imu.csv", "".join(f"{1700000000 + k / 200:.3f},0,0,9.8,0,0,0.1\n" for k in range(40))
        ),
        "gravity is in the columns 2 to 4",
    ),
    "a velocity without header": (
        _write("velocity.csv", "0,1,2,3,4,5,6\n"),
        "line 1: expected the header time_s",
    ),
    "more poses than images": (
        _break(
            lambda f: (
                (f / "reference.tum").unlink(),
                (f / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 9),
            )
        ),
        "holds 9 poses for 4 images",
    ),
    "images of another size": (
        _break(
            lambda f: [cv2.imwrite(str(p), np.zeros((40, 50), np.uint8)) for p in f.glob("*/*.png")]
        ),
        r"is 50 x 40 pixels but .*camchain-imucam\.yaml is for 64 x 48",
    ),
    "a calibration that is missing": (
        lambda f: make_plain(f) and f / "none",
        "none does not exist",
    ),
    "swapped cameras": (
        _write("calib.txt", calib_text(0.0, -0.5), calibration=False),
        r"calib\.txt: P0 and P1 imply a stereo baseline of -0.5 m",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_folders_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    make, message = BAD[name]
    with pytest.raises(VioError, match=message) as caught:
        list(open_dataset(make(tmp_path / "r")).events())
    assert "\n" not in str(caught.value).strip()
    assert isinstance(caught.value, (DataError, CalibrationError))


def test_settings_that_a_recording_cannot_take_are_refused(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    with pytest.raises(
        DataError, match="--topics names topics of a ROS bag, but this is of kind plain"
    ):
        open_dataset(folder, DatasetSettings(topics="left=/a"))
    with pytest.raises(CalibrationError, match=r"none\.yaml does not exist"):
        open_dataset(folder, DatasetSettings(calibration=tmp_path / "none.yaml"))


def test_tumvi(data_dir: Path) -> None:
    """The `dso` form: 16 bits, fisheye, stamps in the names, Kalibr's files beside."""
    recording = open_dataset(data_dir / "tumvi_room1_head").recording
    assert (recording.kind, len(recording.frame_times_ns), recording.motion) == (
        "plain",
        5,
        {"imu"},
    )
    assert len(recording.reference) > 16000
    assert recording.notes[-2:] == (
        "photometric calibration is not applied, as the tracks gain nothing by it: "
        "cam0/pcalib.txt, cam0/vignette.png, "
        "cam1/pcalib.txt, cam1/vignette.png",
        "not used: cam0/camera_left.txt, cam1/camera_right.txt, cam1/times.txt",
    )


def test_boofcv_library(data_dir: Path) -> None:
    """Numbers without padding and BoofCV's XML."""
    dataset = read_plain(data_dir / "boofcv_library", DEFAULT)
    assert [left.name for left, _ in dataset.pairs] == [f"left{k + 1}.jpg" for k in range(346)]
