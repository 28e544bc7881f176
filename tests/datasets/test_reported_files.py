"""Files as people report that they have them: read as they are meant, doubted, or refused with the
cause.
"""

from __future__ import annotations

import re
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import vio
from tests.euroc_maker import RADTAN_RIG
from tests.plain_maker import make_plain
from vio.datasets import open_dataset
from vio.datasets.image_pairs import ImageDataset
from vio.datasets.image_times import overflow_notes
from vio.datasets.images import UnreadableImageError, exif_turn, load_gray
from vio.datasets.rigs.kalibr import kalibr_text
from vio.datasets.sides import split_sides
from vio.errors import CalibrationError, DataError, VioError
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import quat_xyzw_from_rotation, se3_exp, se3_from_parts, so3_exp
from vio.records import ImuSample, StereoFrame

RADTAN_PAIR = (RADTAN_RIG.cam0, RADTAN_RIG.cam1)
STAMPS = [1700000000_000000000 + 50_000_000 * k for k in range(4)]


def _samples(folder: Path) -> tuple[list[int], np.ndarray]:
    dataset = open_dataset(folder)
    assert isinstance(dataset, ImageDataset)
    samples = [sample for sample in dataset.motion if isinstance(sample, ImuSample)]
    return [e.time_ns for e in samples], np.array([[*e.gyro, *e.accel] for e in samples])


def _rewritten(change: Callable[[str], str | bytes]) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        file = folder / "imu.csv"
        found = change(file.read_text())
        file.write_bytes(found.encode() if isinstance(found, str) else found)

    return write


def _decimal_commas(separator: str) -> Callable[[str], str]:
    return lambda text: text.replace(",", separator).replace(".", ",")


def _seconds_and_nanoseconds(text: str) -> str:
    head, *lines = text.splitlines()
    split = [re.sub(r"^(\d+)(\d{9}),", r"\1,\2,", line) for line in lines]
    return "\n".join([head.replace("#timestamp [ns]", "sec,nanosec"), *split]) + "\n"


IMU_FORMS: dict[str, Callable[[str], str | bytes]] = {
    "Windows' line ends and a byte order mark": lambda t: ("\ufeff" + t).replace("\n", "\r\n"),
    "UTF-16, as PowerShell writes": lambda t: t.encode("utf-16"),
    "decimal commas between semicolons": _decimal_commas(";"),
    "decimal commas between tabs": _decimal_commas("\t"),
    "cells in quotes": lambda t: re.sub(r"[^,\n]+", lambda cell: f'"{cell[0]}"', t),
    "a comma at each line's end": lambda t: t.replace("\n", ",\n"),
    "seconds and nanoseconds in two columns": _seconds_and_nanoseconds,
}


@pytest.mark.parametrize("form", IMU_FORMS)
def test_an_imu_is_read_alike_in_the_forms_of_other_programs(form: str, tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    times_ns, values = _samples(folder)
    _rewritten(IMU_FORMS[form])(folder)
    found_ns, found = _samples(folder)
    assert found_ns == times_ns
    np.testing.assert_array_equal(found, values)


def test_a_recording_that_was_cut_in_its_last_line_is_read(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    times_ns, values = _samples(folder)
    _rewritten(lambda text: text[:-20])(folder)
    found_ns, found = _samples(folder)
    assert found_ns == times_ns[:-1]
    np.testing.assert_array_equal(found, values[:-1])
    assert any("ends too early" in note for note in open_dataset(folder).recording.notes)


def test_readings_of_a_driver_that_has_none_yet_are_left_out(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    times_ns, values = _samples(folder)
    _rewritten(lambda text: re.sub(r"^(\d+),.*$", r"\1" + 6 * ",nan", text, count=2, flags=re.M))(
        folder
    )
    found_ns, found = _samples(folder)
    assert found_ns == times_ns[2:]
    np.testing.assert_array_equal(found, values[2:])
    notes = open_dataset(folder).recording.notes
    assert any("2 readings are not numbers and are left out" in note for note in notes)


def test_a_unit_in_another_language_is_doubted(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    _rewritten(lambda text: text.replace("wx,wy,wz", "wx [Grad/s],wy [Grad/s],wz [Grad/s]"))(folder)
    (doubt,) = [n for n in open_dataset(folder).recording.notes if "doubtful" in n]
    assert "'grad/s' of the gyro is not known" in doubt


TIME_LISTS: dict[str, Callable[[list[tuple[int, str]]], str | bytes]] = {
    "UTF-16": lambda rows: "".join(f"{s}\r\n" for _, s in rows).encode("utf-16"),
    "a number before each time": lambda rows: "".join(f"{k} {s}\n" for k, s in rows),
    "numbers from one": lambda rows: "".join(f"{k + 1} {s}\n" for k, s in rows),
    "a header": lambda rows: "frame,timestamp\n" + "".join(f"{k},{s}\n" for k, s in rows),
    "the time before the name": lambda rows: "".join(f"{s} left/{k}.png\n" for k, s in rows),
}


@pytest.mark.parametrize("form", TIME_LISTS)
def test_lists_of_times_are_read(form: str, tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    rows = [(k, f"{t // 10**9}.{t % 10**9:09d}") for k, t in enumerate(STAMPS)]
    found = TIME_LISTS[form](rows)
    (folder / "times.txt").write_bytes(found.encode() if isinstance(found, str) else found)
    assert open_dataset(folder).recording.frame_times_ns.tolist() == STAMPS


@pytest.mark.parametrize(
    ("folder", "name"),
    [
        ("images", lambda side, k: f"{('left', 'right')[side]}{k:02d}.png"),
        ("images", lambda side, k: f"frame{k:04d}_cam{side}.png"),
        (".", lambda side, k: f"{k}-{'LR'[side]}.png"),
        # the Málaga dataset's
        ("Images", lambda side, k: f"img_CAMERA1_{k}.918590_{('left', 'right')[side]}.png"),
    ],
)
def test_both_cameras_in_one_folder_are_a_pair(
    folder: str, name: Callable[[int, int], str], tmp_path: Path
) -> None:
    """They were read as one camera, of which every second image was the other's."""
    apart = open_dataset(make_plain(tmp_path / "apart"))
    made = make_plain(tmp_path / "together", folders=("a", "b"), name=name)
    (made / folder).mkdir(exist_ok=True)
    for side in ("a", "b"):
        for file in (made / side).iterdir():
            file.rename(made / folder / file.name)
        (made / side).rmdir()
    together = open_dataset(made)
    assert together.recording.kind == "plain"
    both = ([e for e in d.events() if isinstance(e, StereoFrame)] for d in (apart, together))
    for a, b in zip(*both, strict=True):
        assert a.time_ns == b.time_ns
        np.testing.assert_array_equal(a.left, b.left)
        np.testing.assert_array_equal(a.right, b.right)


def test_names_of_one_camera_have_no_sides() -> None:
    assert split_sides(["0.png", "1.png", "2.png"]) is None
    assert split_sides(["left0.png", "left1.png"]) is None
    assert split_sides(["image0.png", "image1.png"]) is None
    assert split_sides(["cam0_0.png", "cam0_1.png"]) is None
    assert split_sides(["a_l.png", "a_r.png", "b_l.png"]) == (["a_l.png"], ["a_r.png"])


def test_stamps_of_two_cameras_that_are_apart_are_said_to_be(tmp_path: Path) -> None:
    name = lambda side, k: f"{STAMPS[k] + side * 20_000_000}.png"  # noqa: E731
    folder = make_plain(tmp_path, name=name, times=False)
    with pytest.raises(DataError, match=r"are \+20 ms apart .* within 3 ms"):
        open_dataset(folder)


def _jpeg_with_exif(path: Path, orientation: int, order: str) -> None:
    """Replace a PNG by a JPEG that asks to be turned."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    data = cv2.imencode(".jpg", image)[1].tobytes()
    start = b"MM\0*" if order == ">" else b"II*\0"
    entry = struct.pack(f"{order}IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    block = b"Exif\0\0" + start + entry
    path.unlink()
    head = b"\xff\xe1" + struct.pack(">H", len(block) + 2)
    path.with_suffix(".jpg").write_bytes(data[:2] + head + block + data[2:])


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(
    ("orientation", "turn"),
    [(1, ""), (2, "mirrored"), (3, "turned by 180 degrees"), (8, "turned by 270 degrees")],
)
def test_images_that_ask_to_be_turned_or_mirrored_are_doubted(
    orientation: int, turn: str, order: str, tmp_path: Path
) -> None:
    folder = make_plain(tmp_path)
    for file in list(folder.glob("*/*.png")):
        _jpeg_with_exif(file, orientation, order)
    assert exif_turn(folder / "left" / "0.jpg") == turn
    said = [note for note in open_dataset(folder).recording.notes if "EXIF" in note]
    assert len(said) == bool(turn)
    assert all(f"doubtful: the images ask to be {turn} (EXIF)" in note for note in said)


def _bare(folder: Path, text: str) -> vio.Rig:
    (folder / "intrinsics.txt").write_text(text)
    return vio.load_rig(folder, image_size=(752, 480))


def test_intrinsics_with_decimal_commas_are_read(tmp_path: Path) -> None:
    """They were eight numbers: fx 458, fy 654, k1 367."""
    for text in ("458,654 457,296 367,215 248,375\n", "458.654, 457.296, 367.215, 248.375\n"):
        camera = _bare(tmp_path, text).cam0
        assert (camera.fu, camera.fv, camera.cu, camera.cv) == (458.654, 457.296, 367.215, 248.375)
        assert camera.model == "pinhole"


@pytest.mark.parametrize("text", ["4.2 4.2 367.2 248.3", "0.6099 0.9527 0.4883 0.5174"])
def test_focal_lengths_that_are_no_pixels_are_refused(text: str, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="must be pixels, not millimetres or shares"):
        _bare(tmp_path, text)


def test_intrinsics_in_another_order_are_doubted(tmp_path: Path) -> None:
    (doubt,) = _bare(tmp_path, "458.654 367.215 457.296 248.375").notes
    assert "doubtful: its focal lengths" in doubt
    assert "check the order" in doubt


def _kitti_note(folder: Path, scale: float) -> list[str]:
    c = [scale * value for value in (700.0, 640.0, 360.0)]
    P = lambda shift: f"{c[0]} 0 {c[1]} {shift} 0 {c[0]} {c[2]} 0 0 0 1 0"  # noqa: E731
    (folder / "calib.txt").write_text(f"P0: {P(0)}\nP1: {P(-70)}\n")
    return list(vio.load_rig(folder / "calib.txt", image_size=(1280, 720)).notes)


def test_a_principal_point_of_a_little_larger_images_is_noted_and_not_doubted(
    tmp_path: Path,
) -> None:
    """Real ones are off by as much."""
    assert _kitti_note(tmp_path, 1.015) == []
    for scale, size in ((1.03, "1318 x 742"), (1 / 1.04, "1231 x 692")):
        (note,) = _kitti_note(tmp_path, scale)
        assert "doubtful" not in note
        assert f"images of about {size} pixels, lengths are off by as much" in note
    (doubt,) = _kitti_note(tmp_path, 1.06)
    assert "doubtful" in doubt


def test_tabs_in_a_calibration_are_named_with_what_to_do(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    file = folder / "camchain-imucam.yaml"
    file.write_text(file.read_text().replace("  camera_model", "\tcamera_model"))
    with pytest.raises(CalibrationError, match="replace tabs by spaces"):
        vio.load_rig(file)


def test_a_lever_arm_in_millimetres_is_doubted(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    rig = vio.load_rig(folder)
    assert rig.T_cam0_imu is not None
    arm_m = float(np.linalg.norm(rig.T_cam0_imu[:3, 3]))
    assert arm_m > 0.02
    assert not [note for note in rig.notes if "doubtful" in note]
    far = rig.T_cam0_imu.copy()
    far[:3, 3] *= 1000
    (folder / "camchain-imucam.yaml").write_text(
        kalibr_text(vio.Rig(rig.cam0, rig.cam1, rig.T_cam1_cam0, far))
    )
    (doubt,) = [note for note in vio.load_rig(folder).notes if "doubtful" in note]
    assert f"it is {arm_m:.4g} m" in doubt


@pytest.mark.parametrize(
    ("baseline_m", "distance_m", "is_doubted"),
    [
        (0.11, 6.9, True),  # 69 mm in centimetres
        (0.05, 2.9, False),
        (0.12, 4.7, False),
        (0.12, 4.9, True),
        (0.54, 9.9, False),
    ],
)
def test_a_lever_arm_in_centimetres_is_doubted_beside_a_short_baseline(
    baseline_m: float, distance_m: float, is_doubted: bool, tmp_path: Path
) -> None:
    T = np.eye(4)
    T[0, 3] = distance_m
    rig = vio.Rig.rectified(300.0, 300.0, 159.5, 119.5, baseline_m, 320, 240, T_cam0_imu=T)
    file = tmp_path / "camchain-imucam.yaml"
    file.write_text(kalibr_text(rig))
    doubts = [note for note in vio.load_rig(file).notes if "doubtful" in note]
    assert bool(doubts) is is_doubted
    if is_doubted:
        assert f"if it is the centimetre, it is {distance_m / 100:.4g} m" in doubts[0]


def test_a_lever_arm_in_centimetres_is_doubted_in_files_beside_the_cameras(
    tmp_path: Path,
) -> None:
    """ORB-SLAM's settings, whose IMU is read after the cameras, and T_cam0_imu.txt."""
    T = np.eye(4)
    T[0, 3] = 6.9
    rig = vio.Rig.rectified(300.0, 300.0, 159.5, 119.5, 0.11, 320, 240)
    text = "%YAML:1.0\n" + "".join(
        f"Camera.{key}: {value}\n"
        for key, value in zip(
            ("fx", "fy", "cx", "cy", "bf", "width", "height"),
            (300.0, 300.0, 159.5, 119.5, 33.0, 320, 240),
            strict=True,
        )
    )
    values = ", ".join(str(value) for value in np.linalg.inv(T).ravel())
    text += f"Tbc: !!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: d\n   data: [{values}]\n"
    (tmp_path / "cam.yaml").write_text(text)
    (doubt,) = [note for note in vio.load_rig(tmp_path / "cam.yaml").notes if "doubtful" in note]
    assert "if it is the centimetre, it is 0.069 m" in doubt

    folder = make_plain(tmp_path / "plain", frames=4)
    assert not open_dataset(folder).recording.doubts
    np.savetxt(folder / "T_cam0_imu.txt", T)
    for file in folder.glob("*.yaml"):
        file.unlink()
    (folder / "camchain.yaml").write_text(kalibr_text(rig))
    (doubt,) = open_dataset(folder).recording.doubts
    assert "T_cam0_imu.txt: doubtful: the IMU is 6.9 m" in doubt


def test_stamps_behind_names_of_several_words_pair_images(tmp_path: Path) -> None:
    """Argoverse's `stereo_front_left_315966070522…`, a millisecond apart."""
    folder = make_plain(
        tmp_path,
        folders=("stereo_front_left", "stereo_front_right"),
        name=lambda side, k: (
            f"stereo_front_{('left', 'right')[side]}_{STAMPS[k] + side * 1_000_000}.png"
        ),
        times=False,
        imu=False,
        reference=False,
    )
    assert open_dataset(folder).recording.frame_times_ns.tolist() == STAMPS


def test_a_number_of_the_kind_of_image_may_stand_before_a_stamp(tmp_path: Path) -> None:
    """AirSim's `img_Drone_front_left_custom_0_1700…`."""
    folder = make_plain(
        tmp_path,
        name=lambda side, k: f"img_Drone_front_{('left', 'right')[side]}_custom_0_{STAMPS[k]}.png",
        times=False,
        imu=False,
        reference=False,
    )
    assert open_dataset(folder).recording.frame_times_ns.tolist() == STAMPS


def test_a_second_calibration_is_named(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    chain = (folder / "camchain-imucam.yaml").read_text()
    (folder / "calibration.yaml").write_text(chain)
    notes = open_dataset(folder).recording.notes
    assert any("not used: camchain-imucam.yaml" in note for note in notes)


def test_a_time_shift_in_milliseconds_is_named_where_nothing_overlaps(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    file = folder / "camchain-imucam.yaml"
    file.write_text(re.sub(r"timeshift_cam_imu: .*", "timeshift_cam_imu: 12.5", file.read_text()))
    with pytest.raises(VioError, match=r"moved by the calibration's time shift of 12\.5 s"):
        open_dataset(folder)


def _make_eth3d(folder: Path) -> vio.Rig:
    """Write a pair as ETH3D publishes it; the poses are those of `rgb`, which is the right camera."""
    make_plain(
        folder,
        folders=("rgb2", "rgb"),
        name=lambda side, k: f"6502.{400000 + 50000 * k}.png",
        imu=False,
        times=False,
        calibration=False,
        reference=False,
    )
    left, right = (CameraModel(c.fu, c.fv, c.cu, c.cv, c.width, c.height) for c in RADTAN_PAIR)
    T_right_left = se3_from_parts(so3_exp([0.01, -0.02, 0.03]), [-0.1, 0.002, -0.003])
    for name, c in (("calibration2.txt", left), ("calibration.txt", right)):
        (folder / name).write_text(f"{c.fu} {c.fv} {c.cu} {c.cv}\n")
    np.savetxt(folder / "extrinsics_1_2.txt", T_right_left[:3], fmt="%.17g")
    return vio.Rig(left, right, T_right_left)


def test_the_second_camera_of_eth3d_is_the_left_one(tmp_path: Path) -> None:
    truth = _make_eth3d(tmp_path)
    found = vio.load_rig(
        tmp_path / "extrinsics_1_2.txt", image_size=(truth.cam0.width, truth.cam0.height)
    )
    assert found.cameras == truth.cameras
    np.testing.assert_allclose(found.right[1], truth.right[1], atol=1e-12)
    T_world_right = [se3_exp([0.1 * k, 0.2, 0.3 * k, 0.1, 0.2 * k, 0.0]) for k in range(4)]
    lines = []
    for k, T in enumerate(T_world_right):
        q = quat_xyzw_from_rotation(T[:3, :3])
        lines.append(" ".join(map(repr, [6502.4 + 0.05 * k, *T[:3, 3].tolist(), *q.tolist()])))
    (tmp_path / "groundtruth.txt").write_text(
        "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines)
    )
    dataset = open_dataset(tmp_path)
    recording = dataset.recording
    assert recording.kind == "plain"
    assert np.diff(recording.frame_times_ns).tolist() == [50_000_000] * 3
    assert isinstance(dataset, ImageDataset)
    left, right = dataset.pairs[0]
    assert (left.parent.name, right.parent.name) == ("rgb2", "rgb")
    assert recording.reference is not None
    # the centre of the left camera, which rectifying does not move
    centres = [(T @ truth.right[1])[:3, 3] for T in T_world_right]
    np.testing.assert_allclose(recording.reference.T_world_body[:, :3, 3], centres, atol=1e-9)


@pytest.mark.parametrize("name", ["times.csv", "timestamps.csv"])
def test_lists_of_times_may_be_csv(name: str, tmp_path: Path) -> None:
    folder = make_plain(tmp_path, 5)
    expected = open_dataset(folder).recording.frame_times_ns
    (folder / "times.txt").unlink()
    rows = "".join(f"{k},{stamp}\n" for k, stamp in enumerate(expected.tolist()))
    (folder / name).write_text(f"frame,timestamp_ns\n{rows}")
    recording = open_dataset(folder).recording
    assert recording.frame_times_ns.tolist() == expected.tolist()
    assert not any("not used" in note for note in recording.notes)


def test_pgm_as_text_is_read_and_a_truncated_one_is_named(tmp_path: Path) -> None:
    levels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    text = "P2\n# a comment\n4 3\n255\n" + " ".join(map(str, levels.ravel())) + "\n"
    (tmp_path / "a.pgm").write_text(text)
    np.testing.assert_array_equal(load_gray(tmp_path / "a.pgm")[0], levels)
    (tmp_path / "b.pgm").write_text(text[:-8])
    with pytest.raises(UnreadableImageError, match="the PGM or PPM is truncated"):
        load_gray(tmp_path / "b.pgm")


def test_jpeg_may_be_named_jfif(tmp_path: Path) -> None:
    folder = make_plain(tmp_path, 4)
    for file in list(folder.glob("*/*.png")):
        image = load_gray(file)[0]
        cv2.imwrite(str(file.with_suffix(".jpg")), image)
        file.with_suffix(".jpg").rename(file.with_suffix(".JFIF"))
        file.unlink()
    assert len(open_dataset(folder).recording.frame_times_ns) == 4


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("left.zip", "left.zip: is an archive; unpack it"),
        ("bag.db3.zstd", "its folder with metadata.yaml is read as it is"),
        ("left/0.jp2", "holds 1 files .jp2, which are not read; write the images as PNG"),
        ("left/0.heic", "holds 1 files .heic, which are not read"),
        ("left.h265", "is a stream of images without times, which is not read; pack it"),
        ("VID_00.insv", "a video of several lenses, which is not read; export one mp4 a lens"),
        ("flight.ulg", "a log of PX4, which is not read; write its IMU as a table"),
        ("map.db", "a database, as of RTAB-Map"),
    ],
)
def test_files_of_other_forms_are_named_with_what_to_do(
    name: str, said: str, tmp_path: Path
) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(b"something")
    with pytest.raises(DataError, match=re.escape(said)):
        open_dataset(tmp_path)


def test_a_zipped_recording_is_named(tmp_path: Path) -> None:
    make_plain(tmp_path / "made")
    archive = shutil.make_archive(str(tmp_path / "recording"), "zip", tmp_path / "made")
    with pytest.raises(DataError, match=re.escape("recording.zip: is an archive; unpack it")):
        open_dataset(archive)


def test_a_camchain_whose_cameras_are_counted_from_one_says_so(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    file = folder / "camchain-imucam.yaml"
    text = file.read_text().replace("cam1:", "cam2:").replace("cam0:", "cam1:")
    file.write_text(text)
    with pytest.raises(CalibrationError, match="names its cameras cam1, cam2; Kalibr's are cam0"):
        open_dataset(folder)


def test_a_doubt_about_stretched_images_has_a_factor_for_each_axis(tmp_path: Path) -> None:
    file = tmp_path / "calib.txt"
    K = "700 0 640 {} 0 700 360 0 0 0 1 0"
    file.write_text(f"P0: {K.format(0)}\nP1: {K.format(-70)}\n")
    (note,) = vio.load_rig(file, image_size=(1024, 648)).notes
    assert "divide its focal lengths and principal points by 1.25 along x and 1.11 along y" in note
    assert "if it is that of rectified images and these are raw ones" in note
    (note,) = vio.load_rig(file, image_size=(1024, 576)).notes
    assert "raw ones" not in note  # one factor


def _with_counters(path: Path) -> None:
    """Put both cameras' images into `img`, list them by camera, and count the lines of the IMU."""
    (path / "img").mkdir()
    for side, name in enumerate(("left", "right")):
        lines = ["# id timestamp image_name"]
        for k, stamp in enumerate(STAMPS):
            moved = f"img/image_{side}_{k}.png"
            (path / name / f"{k}.png").rename(path / moved)
            lines.append(f"{k} {stamp // 10**9}.{stamp % 10**9:09d} {moved}")
        (path / f"{name}_images.txt").write_text("\n".join(lines) + "\n")
        (path / name).rmdir()
    head, *rows = (path / "imu.csv").read_text().splitlines()
    rows = [f"{k},{row}" for k, row in enumerate(rows)]
    (path / "imu.csv").write_text("\n".join([head.replace("#", "# id,"), *rows]) + "\n")


def test_a_folder_with_counters_in_its_lists_is_read(tmp_path: Path) -> None:
    """As UZH-FPV is published: `img/image_0_12.png`, lists of id, time and name."""
    expected = _samples(make_plain(tmp_path / "apart"))
    folder = make_plain(tmp_path / "counted", times=False)
    _with_counters(folder)
    dataset = open_dataset(folder)
    assert dataset.recording.kind == "plain"
    assert dataset.recording.frame_times_ns.tolist() == STAMPS
    found = _samples(folder)
    assert found[0] == expected[0]
    np.testing.assert_array_equal(found[1], expected[1])
    assert split_sides(["image_0_5.png", "image_1_5.png", "image_0_6.png", "image_1_6.png"])


def test_files_of_a_phones_logger_are_found(tmp_path: Path) -> None:
    """`Gyro.txt` and `Accel.txt` were named as not used, and `gyro_accel.csv` too."""
    expected = _samples(make_plain(tmp_path / "apart"))
    one = make_plain(tmp_path / "one")
    table = (one / "imu.csv").rename(one / "gyro_accel.csv").read_text().splitlines()[1:]
    two = make_plain(tmp_path / "two", imu=False)
    rows = [line.split(",") for line in table]
    (two / "Gyro.txt").write_text("".join(f"{','.join(row[:4])}\n" for row in rows))
    (two / "Accel.txt").write_text("".join(f"{','.join([row[0], *row[4:]])}\n" for row in rows))
    for folder in (one, two):
        found = _samples(folder)
        assert found[0] == expected[0]
        np.testing.assert_allclose(found[1], expected[1], atol=1e-12)


@pytest.mark.parametrize("rows", [2, 3])
def test_images_of_twice_the_height_may_be_those_of_both_cameras(rows: int, tmp_path: Path) -> None:
    folder = make_plain(tmp_path, folders=("left", "other"), imu=False)
    for file in (folder / "left").iterdir():
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        assert cv2.imwrite(str(file), np.vstack([image] * rows))
    shutil.rmtree(folder / "other")
    with pytest.raises(DataError, match="pixels") as caught:
        list(open_dataset(folder).events())
    assert ("one above the other" in str(caught.value)) is (rows == 2)


def test_names_that_are_times_stand_behind_them(tmp_path: Path) -> None:
    """Lines `1700000000000000000 1700000000000000000.png` were read as name and time."""
    name = lambda side, k: f"{STAMPS[k]}.png"  # noqa: E731
    folder = make_plain(tmp_path, name=name, times=False)
    lines = [f"{stamp + 7} {stamp}.png" for stamp in STAMPS]
    (folder / "timestamps.txt").write_text("\n".join(lines) + "\n")
    times = open_dataset(folder).recording.frame_times_ns
    assert times.tolist() == [stamp + 7 for stamp in STAMPS]


def test_readings_may_be_dated(tmp_path: Path) -> None:
    expected = _samples(make_plain(tmp_path / "apart"))
    folder = make_plain(tmp_path / "dated")
    head, *rows = (folder / "imu.csv").read_text().splitlines()
    zones = ("{}Z", ","), ("{}+00:00", ";"), ("{}", ","), ("{}+02:00", ","), ("{}-0930", ",")
    for form, separator in zones:
        ahead_ns = {"{}+02:00": 7200 * 10**9, "{}-0930": -34200 * 10**9}.get(form, 0)
        lines = [head.replace("#timestamp [ns]", "time").replace(",", separator)]
        for row in rows:
            stamp, *values = row.split(",")
            date = np.datetime64(int(stamp) + ahead_ns, "ns").astype(str)
            lines.append(separator.join([form.format(date), *values]))
        (folder / "imu.csv").write_text("\n".join(lines) + "\n")
        found = _samples(folder)
        assert found[0] == expected[0]
        np.testing.assert_array_equal(found[1], expected[1])


@pytest.mark.parametrize(("late_ns", "is_read"), [(1_000_000, True), (60_000_000, False)])
def test_a_list_may_have_the_times_of_both_cameras(
    late_ns: int, is_read: bool, tmp_path: Path
) -> None:
    name = lambda side, k: f"frame_{k}.png"  # noqa: E731
    folder = make_plain(tmp_path, name=name, times=False, imu=False)
    lines = [f"{k},{stamp},{stamp + late_ns}" for k, stamp in enumerate(STAMPS)]
    (folder / "times.csv").write_text("\n".join(["frame,left [ns],right [ns]", *lines]) + "\n")
    if is_read:
        assert open_dataset(folder).recording.frame_times_ns.tolist() == STAMPS
        return
    with pytest.raises(DataError, match="there must be one time an image"):
        open_dataset(folder)


@pytest.mark.parametrize("name", ["rec.svo2", "rec.vrs", "rec.db"])
def test_a_file_of_another_program_is_no_damaged_bag(name: str, tmp_path: Path) -> None:
    beginning = {"rec.svo2": b"\x89MCAP0\r\n", "rec.db": b"SQLite format 3\0"}
    (tmp_path / name).write_bytes(beginning.get(name, b"VisionRe") + bytes(64))
    with pytest.raises(DataError, match=re.escape(f"{name}: is a")) as caught:
        open_dataset(tmp_path / name)
    assert "which is not read" in str(caught.value)


def test_what_systems_leave_in_folders_is_no_recording(tmp_path: Path) -> None:
    for name in ("Thumbs.db", "._rec.db"):
        (tmp_path / name).write_bytes(b"left")
    with pytest.raises(DataError, match="no known recording"):
        open_dataset(tmp_path)


def test_videos_that_are_no_pair_are_listed(tmp_path: Path) -> None:
    for side in ("left", "right"):
        for part in (1, 2):
            (tmp_path / f"{side}_GH0{part}0001.mp4").write_bytes(b"film")
    with pytest.raises(DataError, match=r"holds the videos left_GH010001.mp4, .* no pair"):
        open_dataset(tmp_path)


def _numbered(folder: Path, numbers: list[int]) -> Path:
    name = lambda side, k: f"IMG_{numbers[k]:04d}.png"  # noqa: E731
    return make_plain(folder, len(numbers), name=name, times=False, imu=False, reference=False)


@pytest.mark.parametrize(
    ("numbers", "begun_again"),
    [
        ([9997, 9998, 9999, 1, 2], True),
        ([998, 999, 0, 1], True),
        ([9996, 9997, 9998, 1, 2], False),
        ([9998, 9999, 5, 6], False),
        ([9997, 9998, 9999], False),
        ([*range(990, 993), 999, *range(1, 3)], False),
    ],
)
def test_a_counter_that_began_again_amid_a_recording_is_doubted(
    numbers: list[int], begun_again: bool, tmp_path: Path
) -> None:
    """The images of the end came first, and a run called it a view that changes."""
    notes = open_dataset(_numbered(tmp_path, numbers)).recording.notes
    assert any("counter began again" in note for note in notes) is begun_again


def test_a_lost_image_before_the_last_number_is_no_counter_that_began_again(tmp_path: Path) -> None:
    files = tuple(Path(f"{k:04d}.png") for k in range(1000) if k != 998)
    assert overflow_notes(tuple(zip(files, files, strict=True))) == ()


def test_numbers_that_are_dates_are_no_counter() -> None:
    files = tuple(Path(f"{k}.png") for k in (0, 1, 20240512140400010000, 99999999999999999999))
    assert overflow_notes(tuple(zip(files, files, strict=True))) == ()


def test_files_of_several_images_are_doubted(tmp_path: Path) -> None:
    folder = make_plain(tmp_path, imu=False, reference=False)
    for side in ("left", "right"):
        for k in range(4):
            image = cv2.imread(str(folder / side / f"{k}.png"), cv2.IMREAD_GRAYSCALE)
            assert image is not None
            (folder / side / f"{k}.png").unlink()
            assert cv2.imwritemulti(str(folder / side / f"{k}.tif"), [image] * (3 if k == 0 else 1))
    (doubt,) = [n for n in open_dataset(folder).recording.notes if "holds 3 images" in n]
    assert doubt.startswith("doubtful: ")


def test_what_lies_beside_images_in_an_unpacked_folder_is_read(tmp_path: Path) -> None:
    """The calibration beside them was not found."""
    inner = make_plain(tmp_path / "archive" / "2024-01-01")
    expected = _samples(inner)
    found = _samples(tmp_path)
    assert found[0] == expected[0]
    recording = open_dataset(tmp_path).recording
    assert recording.reference is not None
    assert recording.frame_times_ns.tolist() == STAMPS


def test_ground_truth_by_another_name_is_named(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    (folder / "reference.tum").rename(folder / "vicon_room.txt")
    (folder / "poses.csv").write_text("made with another program\n")
    shutil.copy(folder / "vicon_room.txt", folder / "estimate.txt")
    notes = open_dataset(folder).recording.notes
    (note,) = [note for note in notes if "if it is the ground truth" in note]
    assert "vicon_room.txt: poses, not read; name it reference.txt" in note
