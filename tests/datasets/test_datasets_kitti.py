"""The KITTI reader: both layouts, gray and colour, skipped images, bad input, the real
recordings.
"""

from __future__ import annotations

import logging
import re
import shutil
import threading
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.dataset_makers import T_CAM0_IMU, calib_text, edit, make_drive, make_images, make_kitti
from tests.same_events import frames_of
from vio.cameras.rig import Rig
from vio.datasets import open_dataset
from vio.datasets.kitti import read_calibration
from vio.datasets.plain import read_kitti
from vio.datasets.rigs import kitti_rig
from vio.datasets.rigs.kalibr import kalibr_text
from vio.datasets.settings import DatasetSettings
from vio.errors import CalibrationError, DataError
from vio.geometry.lie import se3_from_parts, se3_inverse, se3_log
from vio.geometry.stereo import StereoCamera
from vio.records import StereoFrame, VelocitySample

DEFAULT = DatasetSettings()
OFFICIAL_00 = """P0: 7.188560000000e+02 0.000000000000e+00 6.071928000000e+02 0.000000000000e+00 0.000000000000e+00 \
7.188560000000e+02 1.852157000000e+02 0.000000000000e+00 0.000000000000e+00 0.000000000000e+00 1.000000000000e+00 \
0.000000000000e+00
P1: 7.188560000000e+02 0.000000000000e+00 6.071928000000e+02 -3.861448000000e+02 0.000000000000e+00 \
7.188560000000e+02 1.852157000000e+02 0.000000000000e+00 0.000000000000e+00 0.000000000000e+00 1.000000000000e+00 \
0.000000000000e+00
P2: 7.188560000000e+02 0.000000000000e+00 6.071928000000e+02 4.538225000000e+01 0.000000000000e+00 7.188560000000e+02 \
1.852157000000e+02 -1.130887000000e-01 0.000000000000e+00 0.000000000000e+00 1.000000000000e+00 3.779761000000e-03
P3: 7.188560000000e+02 0.000000000000e+00 6.071928000000e+02 -3.372877000000e+02 0.000000000000e+00 \
7.188560000000e+02 1.852157000000e+02 2.369057000000e+00 0.000000000000e+00 0.000000000000e+00 1.000000000000e+00 \
4.915215000000e-03
"""


def frames_in(folder: Path, settings: DatasetSettings = DEFAULT) -> list[StereoFrame]:
    return frames_of(read_kitti(folder, settings))


def test_reads_a_self_contained_folder_completely(tmp_path: Path) -> None:
    folder = make_kitti(tmp_path / "seq", frames=5)
    dataset = read_kitti(folder, DEFAULT)
    recording = dataset.recording
    assert recording.camera == StereoCamera(700.0, 700.0, 16.0, 12.0, 0.54, width=32, height=24)
    assert recording.frame_times_ns.tolist() == [k * 100_000_000 for k in range(5)]
    np.testing.assert_allclose(recording.T_cam0_imu, T_CAM0_IMU, atol=1e-12)
    assert recording.motion == {"velocity"}
    assert recording.notes == ()
    drive = make_drive(5)
    in_imu = (
        se3_inverse(recording.T_cam0_imu) @ recording.reference.T_world_body @ recording.T_cam0_imu
    )
    np.testing.assert_allclose(in_imu, drive.T_world_imu, atol=1e-9)
    events = list(dataset.events())
    samples = [event for event in events if isinstance(event, VelocitySample)]
    np.testing.assert_array_equal([[*s.linear, *s.angular] for s in samples], drive.velocities)
    for frame in events[1::2]:
        assert frame.right is not None
        stored = cv2.imread(
            str(folder / "image_0" / f"{frame.index:06d}.png"), cv2.IMREAD_UNCHANGED
        )
        np.testing.assert_array_equal(frame.left, stored)
    assert dataset.observations(0) is None


def test_official_layout_finds_its_poses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = make_kitti(tmp_path, official=True)
    assert folder.name == "07"
    monkeypatch.chdir(folder)
    for path in (folder, Path()):
        recording = read_kitti(path, DEFAULT).recording
        assert len(recording.reference) == 4
        assert recording.motion == frozenset()
        assert recording.T_cam0_imu is None


def test_reads_a_folder_with_images_only(tmp_path: Path) -> None:
    folder = make_kitti(tmp_path / "seq")
    for name in ("poses.txt", "velocity.csv", "T_cam0_imu.txt"):
        (folder / name).unlink()
    recording = read_kitti(folder, DEFAULT).recording
    assert (recording.reference, recording.T_cam0_imu, recording.motion) == (
        None,
        None,
        frozenset(),
    )
    assert len(frames_in(folder)) == 4


def test_shorter_reference_covers_the_first_frames(tmp_path: Path) -> None:
    folder = make_kitti(tmp_path / "seq", frames=5)
    lines = (folder / "poses.txt").read_text().splitlines(keepends=True)
    (folder / "poses.txt").write_text("".join(lines[:3]))
    reference = read_kitti(folder, DEFAULT).recording.reference
    assert reference.frame_indices.tolist() == [0, 1, 2]


def test_velocities_may_have_their_own_rate(tmp_path: Path) -> None:
    folder = make_kitti(tmp_path / "seq")
    header = (folder / "velocity.csv").read_text().splitlines()[0]
    rows = [f"{0.025 * k - 0.05:.3f},{k},0,0,0,0,0" for k in range(16)]
    (folder / "velocity.csv").write_text("\n".join([header, *rows]) + "\n")
    events = list(read_kitti(folder, DEFAULT).events(1, 3, images=False))
    kinds = "".join("f" if isinstance(event, StereoFrame) else "v" for event in events)
    assert kinds == "vfvvvvf"


# --- colour
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gray", "colour", "requested", "first"),
    [(True, True, None, 0), (True, True, True, 2), (False, True, None, 2), (True, True, False, 0)],
)
def test_chooses_the_gray_or_colour_pair(
    gray: bool, colour: bool, requested: bool | None, first: int, tmp_path: Path
) -> None:
    folder = make_kitti(tmp_path / "seq", gray=gray, colour=colour)
    dataset = read_kitti(folder, DatasetSettings(colour=requested))
    assert dataset.pairs[0][0].parent.name == f"image_{first}"
    assert dataset.recording.camera.baseline_m == pytest.approx(0.54 if first == 0 else 0.53)


@pytest.mark.parametrize(
    ("gray", "colour", "requested"), [(True, False, True), (False, True, False)]
)
def test_error_names_a_missing_pair(
    gray: bool, colour: bool, requested: bool, tmp_path: Path
) -> None:
    folder = make_kitti(tmp_path / "seq", gray=gray, colour=colour)
    with pytest.raises(
        DataError,
        match=rf"holds no image_\d with image_\d \(dataset.colour is {str(requested).lower()}\)",
    ):
        read_kitti(folder, DatasetSettings(colour=requested))


def test_colour_moves_extrinsics_and_reference_to_camera_2(tmp_path: Path) -> None:
    folder = make_kitti(tmp_path / "seq", frames=6, colour=True)
    gray = read_kitti(folder, DEFAULT).recording
    colour = read_kitti(folder, DatasetSettings(colour=True)).recording
    T_cam2_cam0 = se3_from_parts(np.eye(3), [0.06, 0, 0])  # camera 2 is 6 cm left of camera 0
    np.testing.assert_allclose(colour.T_cam0_imu, T_cam2_cam0 @ gray.T_cam0_imu, atol=1e-12)
    # Both describe one motion of the body: relative poses in the imu frame agree, whichever camera
    # was watched.
    relative = [
        se3_inverse(poses[0]) @ poses[-1]
        for poses in (
            r.reference.in_imu(r.T_cam0_imu).T_world_body
            for r in (gray, colour)
            if r.reference is not None and r.T_cam0_imu is not None
        )
    ]
    np.testing.assert_allclose(relative[0], relative[1], atol=1e-12)
    np.testing.assert_allclose(colour.reference.T_world_body[0], np.eye(4), atol=1e-12)
    assert np.abs(colour.reference.positions[-1] - gray.reference.positions[-1]).max() > 1e-4
    frame = next(
        e
        for e in read_kitti(folder, DatasetSettings(colour=True)).events()
        if isinstance(e, StereoFrame)
    )
    assert frame.left.ndim == 2


def test_official_calibration_of_sequence_00(tmp_path: Path) -> None:
    """By hand: b = 386.1448 / 718.856; camera 2 is (45.38225 - 607.1928 * .003779761) / 718.856
    m to the left.
    """
    (tmp_path / "calib.txt").write_text(OFFICIAL_00)
    gray = read_calibration(tmp_path / "calib.txt", (0, 1))
    assert gray.camera.baseline_m == pytest.approx(0.5371657, abs=1e-6)
    np.testing.assert_array_equal(gray.T_left_cam0, np.eye(4))
    colour = read_calibration(tmp_path / "calib.txt", (2, 3))
    np.testing.assert_allclose(
        colour.T_left_cam0[:3, 3], [0.0599385, -0.0011312, 0.0037798], atol=1e-6
    )
    assert colour.camera.baseline_m == pytest.approx(0.5332909, abs=1e-6)
    assert colour.off_axis_m == pytest.approx(0.0033, abs=3e-4)


def test_a_pair_off_its_axis_is_noted(tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text(OFFICIAL_00)
    notes = kitti_rig(tmp_path / "calib.txt", (1241, 376), (2, 3))[0].notes
    assert len(notes) == 1
    assert "image_3 is 3." in notes[0]


# --- images that cannot be used
# -----------------------------------------------------------------------------------


def cut(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def test_truncated_images_are_skipped_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = make_kitti(tmp_path / "seq", frames=8)
    cut(folder / "image_0" / "000000.png")
    cut(folder / "image_1" / "000007.png")
    dataset = read_kitti(folder, DEFAULT)
    with caplog.at_level(logging.WARNING, "vio.datasets.kitti"):
        events = list(dataset.events())
    assert [event.index for event in events if isinstance(event, StereoFrame)] == [1, 2, 3, 4, 5, 6]
    assert sum(isinstance(event, VelocitySample) for event in events) == 8
    assert [record.getMessage().split(":")[0] for record in caplog.records] == [
        "frame 0 is skipped",
        "frame 7 is skipped",
    ]
    assert "000007.png: the PNG is truncated" in caplog.text


@pytest.mark.parametrize("prefetch", [0, 4])
def test_too_many_unreadable_images_are_an_error(prefetch: int, tmp_path: Path) -> None:
    folder = make_kitti(tmp_path / "seq", frames=8)
    for k in (2, 4, 5):
        cut(folder / "image_1" / f"{k:06d}.png")
    assert len(frames_in(folder, DatasetSettings(max_bad_frames=3, prefetch_frames=prefetch))) == 5
    with pytest.raises(
        DataError, match=r"000005\.png: the PNG is truncated.*\(3 unusable frames, .* allows 2\)"
    ):
        frames_in(folder, DatasetSettings(max_bad_frames=2, prefetch_frames=prefetch))


def test_unreadable_frames_have_no_limit_but_all_of_them(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Seven of eight frames are damaged: the run goes on with the one left; five are named, all
    are counted.
    """
    folder = make_kitti(tmp_path / "seq", frames=8)
    for k in range(7):
        cut(folder / "image_1" / f"{k:06d}.png")
    assert len(frames_in(folder)) == 1
    lines = [record.getMessage() for record in caplog.records]
    assert [line.split(":")[0] for line in lines[:5]] == [f"frame {k} is skipped" for k in range(5)]
    assert lines[5:] == ["7 of 8 frames were skipped; the first 5 are named above"]
    cut(folder / "image_1" / "000007.png")
    caplog.clear()
    with pytest.raises(
        DataError,
        match=r"none of 8 frames can be used; the first: .*000000\.png: the PNG is truncated",
    ):
        frames_in(folder)
    assert not caplog.records, "the error says it all"


@pytest.mark.parametrize("camera", ["image_1", "both"])
def test_a_frame_of_another_size_is_skipped_and_named(
    camera: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = make_kitti(tmp_path / "seq", frames=4)
    for name in ("image_0", "image_1") if camera == "both" else (camera,):
        assert cv2.imwrite(str(folder / name / "000002.png"), np.zeros((24, 30), dtype=np.uint8))
    assert [frame.index for frame in frames_in(folder)] == [0, 1, 3]
    (line,) = [record.getMessage() for record in caplog.records]
    assert "frame 2 is skipped" in line
    assert "000002.png is 30 x 24 pixels but" in line
    assert "calib.txt is for 32 x 24" in line


def test_sixteen_bits_are_noted(tmp_path: Path) -> None:
    folder = make_kitti(tmp_path / "seq")
    for name in ("image_0", "image_1"):
        shutil.rmtree(folder / name)
        make_images(folder / name, 4, depth=16)
    assert read_kitti(folder, DEFAULT).recording.notes == (
        "images have 16 bits (000000.png); scaled to 8 bits by 1/257",
    )


def test_closing_the_generator_ends_the_thread(tmp_path: Path) -> None:
    events = read_kitti(make_kitti(tmp_path / "seq", frames=12), DEFAULT).events()
    assert isinstance(next(events), VelocitySample)
    assert isinstance(next(events), StereoFrame)
    assert any(thread.name.startswith("vio-prefetch") for thread in threading.enumerate())
    events.close()  # type: ignore[attr-defined]
    assert not any(thread.name.startswith("vio-prefetch") for thread in threading.enumerate())


# --- bad input
# --------------------------------------------------------------------------------------------------


def _write(name: str, text: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text(text)


def _remove(name: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).unlink()


def _replace(name: str, old: str, new: str) -> Callable[[Path], object]:
    return lambda folder: edit(folder / name, old, new)


GOOD = calib_text(0.0, 0.54)
BAD = [
    (
        _remove("image_1/000002.png"),
        DataError,
        r"image_0 holds 4 images and .*image_1 3: .*000002\.png is missing",
    ),
    (
        _remove("calib.txt"),
        CalibrationError,
        r"calib\.txt is missing; it holds the projection matrices",
    ),
    (
        _write("calib.txt", calib_text(0.0)),
        CalibrationError,
        r"calib\.txt: 0 lines begin with 'P1:'",
    ),
    (_write("calib.txt", GOOD + GOOD), CalibrationError, r"calib\.txt: 2 lines begin with 'P0:'"),
    (
        _write("calib.txt", calib_text(0.0, 0.0)),
        CalibrationError,
        r"P0 and P1 imply a stereo baseline of 0 m",
    ),
    (
        _write("calib.txt", calib_text(0.54, 0.0)),
        CalibrationError,
        r"stereo baseline of -0\.54 m.*exchanged",
    ),
    (
        _write("calib.txt", GOOD.replace("1.6e+01", "x", 1)),
        CalibrationError,
        r"line 1: P0 holds no number",
    ),
    (
        _write("calib.txt", GOOD.replace(" 1 0", " 1", 1)),
        CalibrationError,
        r"line 1: P0 holds 11 values, expected 12",
    ),
    (
        _write("calib.txt", GOOD.replace(" 1 0", " 2 0", 1)),
        CalibrationError,
        r"line 1: P0 is no intrinsic matrix",
    ),
    (
        _write("calib.txt", GOOD.replace("P0: 7", "P0: -7")),
        CalibrationError,
        r"P0 is no intrinsic matrix .* fu and fv positive",
    ),
    (
        _write("calib.txt", re.sub("(P.): 7", r"\1: 0", GOOD)),
        CalibrationError,
        r"P0 is no intrinsic matrix .* fu and fv positive",
    ),
    (
        _write("calib.txt", GOOD.replace("1.6e+01", "1.5e+01", 1)),
        CalibrationError,
        r"P0 and P1 differ in focal length",
    ),
    (
        _write("calib.txt", GOOD.replace("1.2e+01 0 0 0 1 0\nTr", "1.2e+01 99 0 0 1 0\nTr")),
        CalibrationError,
        "off the",
    ),
    (_remove("times.txt"), DataError, r"times\.txt is missing"),
    (
        _write("times.txt", "0\n0.1\n0.2\n"),
        DataError,
        r"times\.txt holds 3 times for 4 image pairs",
    ),
    (
        _write("times.txt", "0\n0.1\n0.1\n0.2\n"),
        DataError,
        r"times\.txt, line 3: the clock repeats",
    ),
    (
        _write("times.txt", "0\n0.1\n0.05\n0.2\n"),
        DataError,
        r"times\.txt, line 3: the clock runs backwards",
    ),
    (
        _write("times.txt", "0\n0.1\nsoon\n0.2\n"),
        DataError,
        r"times\.txt, line 3: 'soon' is no time",
    ),
    (
        _write("times.txt", "0\n0.1 0.2\n0.3\n0.4\n"),
        DataError,
        r"line 2: '0\.1 0\.2' is not one time, nor the name of an image and one; there must",
    ),
    (
        _remove("T_cam0_imu.txt"),
        CalibrationError,
        r"velocity\.csv: needs the pose of its sensor; add T_cam0_imu\.txt",
    ),
    (
        _write("T_cam0_imu.txt", "1 0 0 0\n0 1 0 0\n0 0 2 0\n"),
        CalibrationError,
        r"T_cam0_imu\.txt: not a rotation",
    ),
    (
        _write("T_cam0_imu.txt", "1 0 0\n"),
        CalibrationError,
        r"T_cam0_imu\.txt: expected three or four lines",
    ),
    (
        _write("T_cam0_imu.txt", ""),
        CalibrationError,
        r"T_cam0_imu\.txt: expected three or four lines",
    ),
    (
        _replace("velocity.csv", "time_s", "t"),
        DataError,
        r"velocity\.csv, line 1: expected the header time_s,vx_mps",
    ),
    (
        _replace("velocity.csv", "\n0.100000,", "\n0.100000,nan,"),
        DataError,
        r"velocity\.csv, line 3: 8 values instead of 7",
    ),
    (
        _replace("velocity.csv", ",0.0,", ",nan,"),
        DataError,
        r"velocity\.csv, line 2: a reading is not a finite number .*1 lines in all",
    ),
    (
        _replace("velocity.csv", "\n0.200000,", "\n0.100000,"),
        DataError,
        r"velocity\.csv, line 4: the clock repeats",
    ),
    (
        _replace("velocity.csv", "\n0.200000,", "\n0.010000,"),
        DataError,
        r"velocity\.csv, line 4: the clock runs back",
    ),
    (
        _write("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n" * 5),
        DataError,
        r"poses\.txt holds 5 poses for 4 images",
    ),
    (_write("poses.txt", "1 0 0 0 0 1 0 0 0 0 1\n"), DataError, r"poses\.txt"),
]


@pytest.mark.parametrize(("corrupt", "kind", "message"), BAD)
def test_rejects_bad_folder_with_one_line_error(
    corrupt: Callable[[Path], object], kind: type[Exception], message: str, tmp_path: Path
) -> None:
    folder = make_kitti(tmp_path / "seq")
    corrupt(folder)
    with pytest.raises(kind, match=message) as caught:
        read_kitti(folder, DEFAULT)
    assert "\n" not in str(caught.value)


def test_rejects_velocities_of_another_clock(tmp_path: Path) -> None:
    folder = make_kitti(tmp_path / "seq")
    (folder / "times.txt").write_text("".join(f"{1000 + 0.1 * k:.6f}\n" for k in range(4)))
    with pytest.raises(
        DataError, match=r"velocity\.csv: no sample is within the time of the images"
    ):
        read_kitti(folder, DEFAULT)


# --- the real recordings
# ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "count", "camera"),
    [
        (
            "kitti_0039",
            110,
            StereoCamera(721.5377, 721.5377, 609.5593, 172.854, 0.5371505882506209, 1242, 375),
        ),
        (
            "kitti_06_head",
            30,
            StereoCamera(707.0912, 707.0912, 601.8873, 183.1104, 0.5371506532679237, 1226, 370),
        ),
    ],
)
def test_real_recording(name: str, count: int, camera: StereoCamera, data_dir: Path) -> None:
    dataset = read_kitti(data_dir / name, DEFAULT)
    recording = dataset.recording
    assert len(recording.frame_times_ns) == count
    assert recording.camera == camera
    assert recording.notes == ()
    assert len(recording.reference) == count
    assert (
        int(recording.frame_times_ns[1])
        == {"kitti_0039": 103783000, "kitti_06_head": 104506000}[name]
    )
    events = list(dataset.events(0, 3))
    assert len(events) == 6
    for frame in events[1::2]:
        assert frame.left.shape == frame.right.shape == (camera.height, camera.width)


@pytest.mark.parametrize("name", ["kitti_0039", "kitti_06_head"])
def test_real_extrinsics_relate_velocities_to_the_reference(name: str, data_dir: Path) -> None:
    """The reference, moved to the IMU, agrees with the velocities; with the inverse rotation it
    does not.

    These drives rotate too little to verify the translation too; the ECE276A and UTIAS tests do
    that for the same rig.
    """
    dataset = read_kitti(data_dir / name, DEFAULT)
    recording = dataset.recording
    assert recording.T_cam0_imu is not None
    u = np.array([[*s.linear, *s.angular] for s in dataset.motion])
    dt = np.diff(recording.frame_times_ns)[:, None] * 1e-9
    errors = []
    for T_cam0_imu in (recording.T_cam0_imu, se3_inverse(recording.T_cam0_imu)):
        poses = recording.reference.in_imu(T_cam0_imu).T_world_body
        twists = se3_log(se3_inverse(poses[:-1]) @ poses[1:]) / dt
        errors.append(np.median(np.abs(twists - (u[:-1] + u[1:]) / 2), axis=0))
    assert (errors[0] < [0.3, 0.1, 0.1, 0.02, 0.02, 0.01]).all()
    assert errors[1][:3].max() > 5


def test_real_images_match_along_rows(data_dir: Path) -> None:
    """The left image's patches are found in the right image on the same row, to the left: the
    pair is not swapped.
    """
    frame = next(
        e
        for e in read_kitti(data_dir / "kitti_0039", DEFAULT).events()
        if isinstance(e, StereoFrame)
    )
    corners = (
        cv2.goodFeaturesToTrack(frame.left[:, 200:-50], 60, 0.05, 20).reshape(-1, 2).astype(int)
    )
    disparities = []
    for u, v in corners + np.array([200, 0]):
        if not 10 <= v < 365:
            continue
        patch, strip = (
            frame.left[v - 7 : v + 8, u - 7 : u + 8],
            frame.right[v - 7 : v + 8, u - 130 : u + 40],
        )
        score = cv2.matchTemplate(strip, patch, cv2.TM_CCOEFF_NORMED)[0]
        if score.max() > 0.9:
            disparities.append(130 - 7 - int(score.argmax()))
    assert len(disparities) > 20
    assert np.mean(np.array(disparities) > 0) > 0.95


def test_a_calibration_kept_in_the_folder_goes_before_calib_txt(tmp_path: Path) -> None:
    """The file that `vio run --save-calibration` writes."""
    folder = make_kitti(tmp_path)
    plain = open_dataset(folder).recording
    assert plain.kind == "kitti"
    c = plain.camera
    rig = Rig.rectified(c.fu, c.fv, c.cu, c.cv, 1.01 * c.baseline_m, c.width, c.height)
    (folder / "camchain-imucam.yaml").write_text(kalibr_text(rig))
    kept = open_dataset(folder).recording
    assert kept.camera.baseline_m == pytest.approx(1.01 * c.baseline_m)
    assert kept.motion == plain.motion
