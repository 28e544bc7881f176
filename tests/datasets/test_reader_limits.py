"""Each limit of the readers of recordings, calibrations and tables, from both sides."""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, patch

import cv2
import numpy as np
import pytest

import vio.datasets
from tests.refused import is_refused
from vio.cameras.rig import Rig
from vio.datasets import (
    common,
    ece276a,
    image_pairs,
    images,
    lost_images,
    plain,
    tables,
    videos,
    yaml_files,
)
from vio.datasets.bags.clock_steps import mended
from vio.datasets.bags.index import _split_mixed
from vio.datasets.bags.storage_order import _goes_back
from vio.datasets.bags.store import Topic
from vio.datasets.bags.topics import _one_camera
from vio.datasets.companions import imu_on_camera_clock
from vio.datasets.frame_times import FrameRateLimit, pair_stamps
from vio.datasets.gnss_fixes import GnssFixes, checked_fixes
from vio.datasets.kitti import read_calibration
from vio.datasets.kitti_raw import find_above
from vio.datasets.levels import FULL_SCALE, band_of, is_mosaic, levels_of, to_8_bits
from vio.datasets.png import _size_of_gray_8
from vio.datasets.rigs import depthai, formats
from vio.datasets.rigs.kalibr import _apart
from vio.datasets.rigs.kitti_odometry import kitti_rig
from vio.datasets.rigs.opencv import _name
from vio.datasets.rigs.plausible import checked_rig, unit_doubt
from vio.datasets.settings import DatasetSettings
from vio.datasets.tracks import moving_frames
from vio.datasets.tum_rgbd import associated_images
from vio.datasets.unused import listed
from vio.datasets.yaml_files import read_yaml_file
from vio.errors import VioError
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import FloatArray, se3_from_parts, so3_exp
from vio.records import ImuRecord

Says = Callable[[float], bool]
MS = 1_000_000


@contextmanager
def _folder() -> Iterator[Path]:
    with TemporaryDirectory() as name:
        yield Path(name)


# Folders


def _recordings(names: list[str]) -> Any:
    """A folder of such names, those of which are recordings that begin with z."""
    reader = MagicMock(kind="plain")
    reader.is_folder.return_value = reader.may_be_folder.return_value = False
    path = MagicMock()
    path.iterdir.return_value = [Path(name) for name in names]
    return path, (
        patch.object(vio.datasets, "_readers", lambda: [reader]),
        patch.object(vio.datasets, "_is_named", lambda file, reader: file.name.startswith("z")),
    )


def _finds_recording(others: int) -> bool:
    path, patches = _recordings([*(f"a{k:04d}" for k in range(others)), "z"])
    with patches[0], patches[1]:
        return bool(vio.datasets._recordings_in(path))


def _names_all(recordings: int) -> bool:
    path, patches = _recordings([f"z{k}" for k in range(recordings)])
    with patches[0], patches[1], pytest.raises(VioError) as error:
        vio.datasets._kind_of_folder(path)
    return "more" not in str(error.value)


def _finds_images(depth: int = 1, others: int = 0) -> bool:
    """Whether an image so deep, and beside so many folders, is found."""

    def inside(folder: Path) -> list[Any]:
        is_deep = len(folder.parts) - 1 == depth and folder.name == "z"
        names = ["0.png"] if is_deep else ["z"] if folder.name in ("r", "z") else []
        names += [f"a{k:04d}" for k in range(others)] if folder == Path("r") else []
        return [
            SimpleNamespace(name=name, path=folder / name, is_dir=lambda: not is_deep)
            for name in names
        ]

    with patch.object(plain.os, "scandir", inside):
        return bool(plain.image_folders(Path("r")))


def _finds_above(levels: int) -> bool:
    with _folder() as path:
        (path / "calib.txt").touch()
        return find_above(path.joinpath(*["a"] * levels), "calib.txt") is not None


def _finds_calibration(others: int) -> bool:
    with _folder() as path, patch.object(formats, "_is_known", lambda file: file.stem == "z"):
        for name in (*(f"a{k:04d}" for k in range(others)), "z"):
            (path / f"{name}.yaml").touch()
        with patch.object(formats, "_is_of_one_camera", lambda file: False):
            return formats._by_content(path) is not None


def _calibration_fits(size: float) -> bool:
    file = MagicMock()
    file.stat.return_value.st_size = size
    with patch.object(yaml_files, "text_lines", lambda path: [(1, "a: 1")]):
        return not is_refused(lambda: read_yaml_file(file))


# Bags and arrays


def _is_split(gyro: float, accel: float) -> bool:
    """Whether a topic is one of two sensors, by the shares of messages with one of them alone."""
    values = np.ones((1000, 6))
    first = round(1000 * gyro)
    values[:first, 3:] = 0.0
    values[first : first + round(1000 * accel), :3] = 0.0
    index = MagicMock()
    index.imu.values = values
    index.imu.__len__.return_value = 1000
    _split_mixed(index, MagicMock(accel=None))
    return bool(index.notes.append.called)


def _raw_images_are_taken(share: float) -> bool:
    raw = Topic("/left", "sensor_msgs/msg/Image", round(1000 * share))
    compressed = Topic("/left/compressed", "sensor_msgs/msg/CompressedImage", 1000)
    return _one_camera([raw, compressed])[0] == raw


def _clock_is_set(back_ms: float = 0.0, ahead_ms: float = 0.0, topics: int = 2) -> bool:
    """Whether a clock is mended that was set while topics with a message a millisecond were
    recorded.
    """
    logged = MS * np.arange(2000)
    stamps = logged.copy()
    stamps[1000:] += round(MS * (ahead_ms - back_ms))
    streams = {str(k): (stamps, logged) for k in range(topics)}
    return bool(mended(streams)[1])


def _is_gravity_of_gyro(norm: float) -> bool:
    values = np.zeros((10, 6))
    values[:, 0] = norm
    return is_refused(lambda: common.check_gravity_column(values, "a", "b", "c"))


def _names_shift(seconds: float) -> bool:
    record = ImuRecord(10**12 + np.arange(5), np.zeros((5, 3)), np.zeros((5, 3)))
    rig: Any = SimpleNamespace(time_offset_s=seconds)
    with pytest.raises(VioError) as error:
        imu_on_camera_clock(record, rig, np.arange(5), "a")
    return "moved by" in str(error.value)


# Calibrations


def _kitti(off_axis_m: float) -> Path:
    """KITTI's matrices of a pair at 0.5 m, the right camera of which is off the axis."""
    K = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
    lines = []
    for k in range(4):
        P = np.column_stack([K, K @ ([-0.5, 0.0, -off_axis_m] if k % 2 else np.zeros(3))])
        lines.append(f"P{k}: " + " ".join(f"{x:.9e}" for x in P.ravel()))
    return Path("\n".join(lines))


def _is_rectified(share: float) -> bool:
    with _folder() as path:
        (path / "calib.txt").write_text(str(_kitti(0.5 * share)))
        return not is_refused(lambda: read_calibration(path / "calib.txt", (0, 1)))


def _notes_off_axis(off_m: float) -> bool:
    with _folder() as path:
        (path / "calib.txt").write_text(str(_kitti(off_m)))
        return bool(kitti_rig(path / "calib.txt", (640, 480), (0, 1))[0].notes)


def _new_course_rig(turn_rad: float = 0.0, off_axis: float = 0.0) -> bool:
    """Whether the two extrinsics of a course file are those of a rectified pair."""
    right = se3_from_parts(so3_exp([0.0, 0.0, turn_rad]), np.array([-0.5, 0.0, 0.5 * off_axis]))
    K = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
    arrays = {"K_l": K, "K_r": K, "extL_T_imu": np.eye(4), "extR_T_imu": right}
    return not is_refused(lambda: ece276a._new_calibration(arrays, Path("a")))


def _is_corrected(apart_m: float) -> bool:
    T = np.eye(4)
    T[0, 3] = 0.5 * apart_m
    calibration: Any = SimpleNamespace(T_cam0_imu=T, ambiguous=True)
    none: Any = None
    found, _ = ece276a._resolve_extrinsics(calibration, none, none, none, "corrected")
    return bool(found[0, 3] < 0)


def _read_rig(**changes: float) -> tuple[str, ...]:
    """The notes about a calibration of images of 1000 x 800, whose size is not stated."""
    values = {"fu": 500.0, "fv": 500.0, "cu": 500.0, "cv": 400.0} | changes
    camera = CameraModel(*values.values(), 1000, 800, "pinhole", ())
    return checked_rig(Rig(camera), "a", size_stated=False).notes


def _of_other_size(ratio: float) -> str:
    return " ".join(_read_rig(cu=500.0 * ratio, cv=400.0 * ratio))


def _far_imu(distance_m: float) -> bool:
    T = np.eye(4)
    T[0, 3] = distance_m
    camera = CameraModel(500.0, 500.0, 500.0, 400.0, 1000, 800, "pinhole", ())
    return bool(checked_rig(Rig(camera, T_cam0_imu=T), "a").notes)


def _moved(shift_m: float = 0.0, turn_rad: float = 0.0) -> FloatArray:
    return se3_from_parts(so3_exp([0.0, 0.0, turn_rad]), np.array([shift_m, 0.0, 0.0]))


def _oak_is_scaled(ratio: float) -> bool:
    """Whether a camera is that of images of half the width, and of a height off by a ratio."""
    K = [[800.0, 0.0, 640.0], [0.0, 800.0, 400.0], [0.0, 0.0, 1.0]]
    block = {"width": 1280, "height": 8000, "intrinsicMatrix": K, "distortionCoeff": [0.0] * 14}
    camera = depthai._camera(block, (640, round(4000 / (1.0 + ratio))), "a")
    return camera.width == 640


def _name_is_found(name: str) -> bool:
    """Whether a name of OpenCV's files is found in capitals, too."""
    return _name({name.upper(): 1}, "D0") == name.upper()


# Images


def _levels_of_bright(share: float) -> int:
    pixels = np.full(100_000, 100, np.uint16)
    pixels[: round(100_000 * share)] = 4000
    return levels_of([band_of(pixels)]).white


def _mosaic(ratio: float) -> bool:
    """Whether pixels are a mosaic whose neighbours differ by a ratio more than those two apart."""
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(200, 200))
    board = np.indices((200, 200)).sum(axis=0) % 2 - 0.5
    low = 0.0
    high = 10.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        values = noise + middle * board
        near = np.abs(np.diff(values, axis=0)).mean()
        far = np.abs(values[2:] - values[:-2]).mean()
        low, high = (middle, high) if near < ratio * far else (low, middle)
    return is_mosaic(noise + low * board)


def _exif_is_found(at: int) -> bool:
    entry = struct.pack(">HHIHH", 0x0112, 3, 1, 6, 0)
    tiff = b"MM\0*" + struct.pack(">IH", 8, 1) + entry
    with _folder() as path:
        file = path / "a.jpg"
        file.write_bytes(b"\xff\xd8" + b"\1" * (at - 2 - 28) + b"Exif\0\0" + tiff)
        return images.exif_turn(file) != ""


def _png_is_read_here(rows: int) -> bool:
    header = struct.pack(">IIBBBBB", 8192, rows, 8, 0, 0, 0, 0)
    return _size_of_gray_8(header, 0) is not None


def _all_skipped_are_named(count: int) -> bool:
    frames: list[Any] = [image_pairs.BadFrame(k, "dark") for k in range(count)]
    good = MagicMock(spec=image_pairs.StereoFrame)
    settings = DatasetSettings(max_bad_frames=None)
    with patch.object(image_pairs, "logger") as log:
        list(image_pairs.readable_frames(lambda item: item, [*frames, good], settings))
    return all("first" not in str(call.args[0]) for call in log.warning.call_args_list)


def _tells_after_standstill(frames: int) -> bool:
    """Whether lost images are found of a rig that stands still at the start."""
    files: Any = lost_images.CountedApart([0] * 200, [0] * 200)  # type: ignore[arg-type]
    search = lost_images._Search(MagicMock(), files)
    search._offset = lambda first: 0 if first >= frames else None  # type: ignore[method-assign]
    return search.steps() is not None


# Times


def _is_paired(off_ms: float) -> bool:
    left = 100 * MS * np.arange(20)
    right = left + MS
    right[7] += round(MS * off_ms)
    return len(pair_stamps(left, right)[0]) == 20


def _takes_early(share: float) -> bool:
    limit = FrameRateLimit(10.0)
    return limit.takes(0) and limit.takes(round(100 * MS * (1.0 - share)))


def _table_fits(late: int = 1, apart: float = 1.0) -> bool:
    """Whether lines were written late, so many of 100, each a part of the usual step apart."""
    times = 10 * MS * np.arange(100)
    is_late = np.zeros(100, np.bool_)
    is_late[10 : 10 + 4 * late : 4] = True
    times[is_late] += round(10 * MS * (1.0 - apart))
    return tables._fits(times, is_late)


def _video_rate(rate_hz: float) -> float:
    capture = MagicMock()
    capture.get.side_effect = lambda what: rate_hz if what == cv2.CAP_PROP_FPS else 9
    capture.read.return_value = (True, np.zeros((4, 4, 3), np.uint8))
    with (
        patch.object(cv2, "VideoCapture", lambda *_: capture),
        patch.object(videos, "_stated_times", lambda file: None),
    ):
        return videos._facts(Path("a.mp4")).rate_hz


def _is_even(off_ms: float) -> bool:
    times = 100 * MS * np.arange(10)
    times[5] += round(MS * off_ms)
    return videos._is_even(times, 10.0)


def _videos_are_paired(share: float) -> bool:
    left = 100 * MS * np.arange(10)
    facts: Any = [SimpleNamespace(times_ns=left), SimpleNamespace(times_ns=None)]
    facts[1].times_ns = left + round(100 * MS * share)
    return not is_refused(
        lambda: videos._uneven_times((Path("a"), Path("b")), facts)  # type: ignore[call-arg]
    )


def _depth_is_near(apart_ms: float) -> bool:
    with _folder() as path:
        (path / "rgb.txt").write_text("1.0 rgb/1.png\n2.0 rgb/2.png\n")
        later = 1.0 + 1e-3 * apart_ms
        (path / "depth.txt").write_text(f"{later:.6f} depth/1.png\n{later + 1:.6f} depth/2.png\n")
        return not is_refused(lambda: associated_images(path))


# Positions by GNSS


def _fixes(height_m: float = 100.0, sigma_m: float | None = None) -> GnssFixes:
    covariance = None if sigma_m is None else np.tile(sigma_m**2 * np.eye(3), (3, 1, 1))
    geodetic = np.tile([48.0, 8.0, height_m], (3, 1))
    return checked_fixes(np.arange(3), geodetic, covariance, "a")


def _sigma_m(axis: int, stated_m: float | None = None) -> float:
    return float(np.sqrt(_fixes(sigma_m=stated_m).covariance[0, axis, axis]))


def _is_moving(mean_mps: float) -> bool:
    """Of a velocity sensor with noise of 1 m/s, which is alternating."""
    linear = np.zeros((100, 3))
    linear[:, 0] = mean_mps + np.where(np.arange(100) % 2, 1.0, -1.0)
    return bool(moving_frames(linear, np.zeros((100, 3)))[[50, 51]].all())


LIMITS: dict[str, tuple[Says, float, float]] = {
    "folder: looked at": (lambda n: not _finds_recording(int(n)), 199, 200),
    "folder: named": (lambda n: not _names_all(int(n)), 3, 4),
    "folder: depth": (lambda n: not _finds_images(int(n)), 3, 4),
    "folder: folders": (lambda n: not _finds_images(others=int(n)), 198, 199),
    "folder: above": (lambda n: not _finds_above(int(n)), 3, 4),
    "folder: calibrations": (lambda n: not _finds_calibration(int(n)), 39, 40),
    "folder: listed": (lambda n: "more" in listed(["a"] * int(n)), 12, 13),
    "calibration: size": (lambda n: not _calibration_fits(n), 0.95e6, 1.05e6),
    "bag: one of two sensors": (lambda x: _is_split(x, 0.98 - x), 0.09, 0.11),
    "bag: both sensors": (lambda x: _is_split(0.5 * x, 0.5 * x), 0.88, 0.92),
    "bag: raw images": (_raw_images_are_taken, 0.88, 0.92),
    "bag: set back": (lambda x: _clock_is_set(back_ms=x), 9.0, 11.0),
    "bag: set forward": (lambda x: _clock_is_set(ahead_ms=x), 95.0, 105.0),
    "bag: streams": (lambda n: _clock_is_set(ahead_ms=500.0, topics=int(n)), 1, 2),
    "bag: disorder": (
        lambda x: _goes_back([0, 1000 * MS, round(MS * (1000 - x))]),
        9.0,
        11.0,
    ),
    "arrays": (
        lambda x: is_refused(lambda: common.check_array_bytes({"a": round(x)}, Path("a"))),
        1.9 * 2**30,
        2.1 * 2**30,
    ),
    "gravity: less": (_is_gravity_of_gyro, 9.81 - 1.6, 9.81 - 1.4),
    "gravity: more": (lambda x: not _is_gravity_of_gyro(x), 9.81 + 1.4, 9.81 + 1.6),
    "clocks: shift": (_names_shift, 0.9, 1.1),
    "KITTI: rectified": (lambda x: not _is_rectified(x), 0.018, 0.022),
    "KITTI: off axis": (_notes_off_axis, 0.9e-3, 1.1e-3),
    "course: rectified": (lambda x: not _new_course_rig(off_axis=x), 0.018, 0.022),
    "course: turned": (lambda x: not _new_course_rig(x), 1.8e-3, 2.2e-3),
    "course: readings": (_is_corrected, 0.9e-3, 1.1e-3),
    "size: noted": (lambda x: "some cameras" in _of_other_size(x), 1.018, 1.022),
    "size: doubtful": (lambda x: "doubtful" in _of_other_size(x), 1.045, 1.055),
    "size: doubtful, smaller": (lambda x: "doubtful" in _of_other_size(1.0 / x), 1.045, 1.055),
    "size: cropped": (lambda x: bool(_read_rig(cu=500.0 * x)), 1.28, 1.32),
    "size: stretched": (lambda x: bool(_read_rig(fv=500.0 * x)), 1.09, 1.11),
    "size: one axis": (
        lambda x: "some cameras" not in str(_read_rig(cu=500.0 * x, cv=400.0 * 1.03)),
        1.09,
        1.11,
    ),
    "view": (lambda x: is_refused(lambda: _read_rig(fu=500.0 / x, fv=500.0 / x)), 11.0, 12.0),
    "IMU: far": (_far_imu, 9.5, 10.5),
    "baseline: squares": (lambda x: unit_doubt(x, "a") is not None, 0.95, 1.05),
    "Kalibr: shift": (lambda x: _apart(_moved(x), np.eye(4)), 1.9e-3, 2.1e-3),
    "Kalibr: turn": (lambda x: _apart(_moved(0.0, x), np.eye(4)), 4.8e-3, 5.2e-3),
    "OAK: scaled": (lambda x: not _oak_is_scaled(x), 0.009, 0.011),
    "OpenCV: long names": (lambda n: _name_is_found(["dist1", "D_left"][int(n)]), 0, 1),
    "levels: bright pixels": (lambda x: _levels_of_bright(x) > 1023, 0.0008, 0.0012),
    "mosaic": (_mosaic, 1.15, 1.25),
    "EXIF": (lambda n: not _exif_is_found(int(n)), 4080, 4110),
    "PNG: pixels": (lambda n: not _png_is_read_here(int(n)), 8192, 8193),
    "skipped frames": (lambda n: not _all_skipped_are_named(int(n)), 5, 6),
    "lost images: windows": (lambda n: not _tells_after_standstill(int(n)), 40, 41),
    "pairs: jitter": (lambda x: not _is_paired(x), 0.9, 1.1),
    "frames: early": (lambda x: not _takes_early(x), 0.09, 0.11),
    "table: late lines": (lambda n: not _table_fits(int(n)), 5, 6),
    "table: place of its own": (lambda x: _table_fits(apart=x), 0.45, 0.55),
    "video: slow": (lambda x: _video_rate(x) > 0.0, 0.9, 1.1),
    "video: quick": (lambda x: _video_rate(x) == 0.0, 950.0, 1050.0),
    "video: even": (lambda x: not _is_even(x), 1.8, 2.2),
    "video: pairs": (lambda x: not _videos_are_paired(x), 0.23, 0.27),
    "TUM: depth": (lambda x: not _depth_is_near(x), 19.0, 21.0),
    "GNSS: sigma": (lambda x: _sigma_m(0) < x, 2.8, 3.2),
    "GNSS: up": (lambda x: _sigma_m(2) < x * _sigma_m(0), 1.9, 2.1),
    "GNSS: least sigma": (lambda x: _sigma_m(0, 1e-6) < x, 0.009, 0.011),
    "GNSS: low": (lambda x: bool(_fixes(x).has_height[0]), -1100.0, -900.0),
    "GNSS: high": (lambda x: not _fixes(x).has_height[0], 48e3, 52e3),
    "moving: window": (_is_moving, 1.05, 1.4),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_reading(says: Says, below: float, above: float) -> None:
    logging.disable(logging.WARNING)
    try:
        assert not says(below)
        assert says(above)
    finally:
        logging.disable(logging.NOTSET)


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_levels_are_those_of_the_fewest_bits_that_hold_the_images(bits: int) -> None:
    assert levels_of([(0.0, 2.0**bits - 1)]).white == 2**bits - 1
    assert levels_of([(0.0, 2.0**bits)]).white > 2**bits


def test_16_bits_are_scaled_to_8() -> None:
    highest = np.iinfo(np.uint16).max
    pixels = np.array([[0, highest // 2, highest]], np.uint16)
    assert to_8_bits(pixels, FULL_SCALE).tolist() == [[0, 127, 255]]
    assert levels_of([(0.0, float(highest))]) == FULL_SCALE
