"""Codes, columns and units of recordings' files, each by what would be read wrongly otherwise, and
limits of clocks that were set.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, patch

import numpy as np
import pytest
import yaml

from tests.refused import is_refused
from vio.datasets import gnss, gtsam, image_pairs, image_times, plain
from vio.datasets.bags import storage_order
from vio.datasets.bags.clock_steps import ClockStep, mended
from vio.datasets.bags.sdk_stamps import sdk_stamps
from vio.datasets.bags.store import Topic
from vio.datasets.bags.writer import bag_writer
from vio.datasets.frame_times import pair_stamps
from vio.datasets.image_files import FilePairs, ImageFiles
from vio.datasets.observation_log import read_observation_log, write_observation_log
from vio.datasets.png import decode_gray8
from vio.datasets.rigs import camodocal, depthai, zed
from vio.datasets.rigs.source import Source
from vio.datasets.tables import names_readings
from vio.datasets.tracks import tracks_from_dense
from vio.datasets.tum_rgbd import published_camera
from vio.datasets.unused import Layout
from vio.geometry.stereo import StereoCamera
from vio.records import IntArray, Recording
from vio.records import observations as frame_observations

Says = Callable[[float], bool]
MS = 1_000_000


def _read_text(text: str, read: Callable[[Path], object]) -> Any:
    """What a reader returns of a file with such a text."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "a.txt"
        file.write_text(text)
        return read(file)


# Clocks that were set


def _steps(stamps_ms: Sequence[IntArray], logged_ms: Sequence[IntArray]) -> list[ClockStep]:
    """The steps of topics' clocks, named by their numbers."""
    pairs = zip(stamps_ms, logged_ms, strict=True)
    streams = {str(k): (MS * stamps, MS * logged) for k, (stamps, logged) in enumerate(pairs)}
    return mended(streams)[1]


def _set_at_1000(by_ms: int, count: int = 2000) -> tuple[IntArray, IntArray]:
    """Stamps and times of messages a millisecond apart, of a clock that is set after a second."""
    logged = np.arange(count)
    return np.where(logged < 1000, logged, logged + by_ms), logged


def _other_clock_goes_on(messages: int) -> bool:
    """Whether a topic that is recorded with so many messages after two others leapt shows that no
    clock was set.
    """
    leapt, logged = _set_at_1000(500)
    other = np.arange(1000 + messages)
    return not _steps([leapt, leapt, other], [logged, logged, other])


def _slow_topic_was_set(first_ms: int) -> bool:
    """Whether the clock of a topic with a message in 200 ms is said to have been set back by 50 ms,
    with a single message so long before.
    """
    back, logged = _set_at_1000(-50)
    slow = 1000 - first_ms + 200 * np.arange(4)
    stamps = np.where(slow < 1000, slow, slow - 50)
    return "1" in _steps([back, stamps], [logged, slow])[0].first


def _are_apart(ms: int) -> bool:
    """Whether topics that were set back by 400 ms, and by so much more, had two clocks."""
    back, logged = _set_at_1000(-400)
    more, _ = _set_at_1000(-400 - ms)
    return len(_steps([back, more], [logged, logged])) == 2


def _is_set_later(*, held: int = 0, earlier: int = 20) -> bool:
    """Whether a clock that was set back by 500 ms is not said to have been set then.

    Args:
        held: messages, each second one of those after it, whose stamps are not set back.
        earlier: of the 20 stamps after it were given before.
    """
    stamps, logged = _set_at_1000(-500)
    stamps[1001 : 1001 + 2 * held : 2] += 500
    kept = np.ones(2000, np.bool_)
    kept[500 + earlier : 521] = False
    steps = _steps([stamps[kept]], [logged[kept]])
    return not steps or steps[0].logged_ns != 1000 * MS


# Bags


def _finds_set_back(chunks: int) -> bool:
    """Whether times of an MCAP file with so many chunks that go back within one of them are seen."""
    stored = [
        SimpleNamespace(message_start_time=k * 1000 * MS, message_end_time=(k + 1) * 1000 * MS)
        for k in range(chunks)
    ]
    rows = [(SimpleNamespace(id=1), time_ms * MS, b"") for time_ms in (0, 1000, 500)]
    storage = SimpleNamespace(chunks=stored, connections=(), messages_scan=lambda connections: rows)
    return storage_order.is_set_back(SimpleNamespace(storage=storage))


def _has_fix(status: int) -> bool:
    fix: Any = MagicMock(latitude=48.0, longitude=8.0, altitude=100.0, position_covariance_type=0)
    fix.status.status = status
    fix.header.stamp = SimpleNamespace(sec=1, nanosec=0)
    bag = MagicMock(topics=[Topic("/fix", "sensor_msgs/msg/NavSatFix", 1)])
    bag.__enter__.return_value = bag
    bag.messages.return_value = [MagicMock()]
    bag.decoded.return_value = fix
    with patch.object(gnss, "Bag", lambda path: bag):
        return not is_refused(lambda: gnss._read_navsatfix(Path("a"), None))


# Positions and tables


def _oxts(values: Sequence[float]) -> gnss.GnssFixes:
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "data").mkdir()
        words = map(str, [48.0, 8.0, 100.0, *values[3:]])
        (folder / "data" / "0000000000.txt").write_text(" ".join(words))
        (folder / "timestamps.txt").write_text("2011-09-26 13:02:25.964389445\n")
        return gnss._read_oxts(folder)


def _oxts_sigma_m(column: int, stated_m: float) -> float:
    values = np.zeros(30)
    values[column] = stated_m
    return float(np.sqrt(_oxts(values.tolist()).covariance[0, 0, 0]))


def _could_be_imu(columns: int) -> bool:
    line = ",".join(["1403636579763555584", *["0.5"] * (columns - 1)])
    named = lambda file: names_readings(file.rename(file.with_name("imu_a.txt")))  # noqa: E731
    return bool(_read_text(f"{line}\n", named))


def _is_seen(pixel: float) -> bool:
    return len(tracks_from_dense(np.full((4, 1, 1), pixel), Path("a")).ids) == 1


def _log_is_read(version: int) -> bool:
    camera = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)
    times_ns = np.array([0, 100 * MS])
    recording = Recording("features", Path("a"), camera, None, times_ns, False, frozenset(), None)
    seen = [
        frame_observations(k, int(times_ns[k]), [1], [[9.0, 9.0, 8.0, 9.0]], None) for k in (0, 1)
    ]
    with TemporaryDirectory() as folder:
        file = Path(folder) / "log.npz"
        write_observation_log(file, recording, seen, ())
        arrays = dict(np.load(file)) | {"version": np.int64(version)}
        np.savez(file, **arrays)
        return not is_refused(lambda: read_observation_log(file))


# Images


def _png(filter_of_row: int) -> bytes:
    """A PNG of a row of three gray pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + bytes(4)

    header = (3).to_bytes(4, "big") + (1).to_bytes(4, "big") + bytes([8, 0, 0, 0, 0])
    pixels = zlib.compress(bytes([filter_of_row, 10, 20, 30]))
    body = chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def _kitti_cameras(first: int, colour: bool) -> bool:
    """Whether the cameras of a KITTI folder are found by two numbers from one on."""
    with TemporaryDirectory() as folder:
        for k in (first, first + 1):
            (Path(folder) / f"image_{k}").mkdir()
        found = []
        if not is_refused(lambda: found.append(plain._choose_cameras(Path(folder), colour))):
            return found == [(first, first + 1)]
    return False


def _levels_are_of(images: int) -> bool:
    """Whether so many images tell the levels (`vio.datasets.levels`) of a recording of 100."""
    files = ImageFiles(Path("a"), tuple(f"{k:03d}.png" for k in range(100)))
    with (
        patch.object(image_pairs, "levels_in") as levels_in,
        patch.object(image_pairs, "_mosaic_notes", lambda pairs: ()),
        patch.object(image_pairs, "_turn_notes", lambda pairs: ()),
    ):
        levels_in.return_value.note = ()
        image_pairs.gray_levels(FilePairs(files, files))
    return len(set(levels_in.call_args.args[0])) >= images


def _names(stems: Sequence[str]) -> FilePairs:
    files = ImageFiles(Path("a"), tuple(f"{stem}.png" for stem in stems))
    return FilePairs(files, files)


def _assumed_s(frames: int) -> float:
    """Time from the first to the last of images that nothing tells the times of."""
    layout = Layout(*[Path("none")] * 4)
    pairs = _names([f"{k:06d}" for k in range(frames)])
    return float(np.ptp(image_times.frame_times(layout, pairs)[0])) / 1e9


def _counts(stems: Sequence[str]) -> bool:
    return image_times.numbers_in_names(_names(stems)) is not None


def _first_are_times(count: int) -> bool:
    """Whether images are taken for named by times as so many first ones are."""
    times = [f"7.{2 * k:03d}" for k in range(count)]
    return not _counts([*times, *(f"b{900 + k}" for k in range(50))])


# Calibrations


def _of_oak(**stated: Any) -> Any:
    """The rig of an OAK's file, whose cameras have focal lengths of 400, 500 and 600 px, and are
    7.5 (cm) apart.
    """
    cameras = []
    for socket in range(4):
        f = 400.0 + 100.0 * socket
        links = {
            "toCameraSocket": socket - 1,
            "rotationMatrix": np.eye(3).tolist(),
            "translation": {"x": 7.5, "y": 0.0, "z": 0.0},
        }
        block = {
            "width": 1280,
            "height": 800,
            "intrinsicMatrix": [[f, 0.0, 640.0], [0.0, f, 400.0], [0.0, 0.0, 1.0]],
            "distortionCoeff": [0.0] * 14,
            "cameraType": 0,
            "extrinsics": links if socket else {},
        }
        cameras.append([socket, block])
    return depthai.read(Source(Path("a"), {"cameraData": cameras, **stated}))


def _oak_baseline_m() -> float:
    return float(abs(_of_oak().T_cam1_cam0[0, 3]))


def _zed_baseline_m() -> float:
    camera = {"fx": "700", "fy": "700", "cx": "640", "cy": "360"}
    entries: dict[str, object] = {
        "LEFT_CAM_HD": camera,
        "RIGHT_CAM_HD": camera,
        "STEREO": {"baseline": "120"},
    }
    rig = zed.read(Source(Path("a"), entries, (1280, 720)))
    assert rig.T_cam1_cam0 is not None
    return float(abs(rig.T_cam1_cam0[0, 3]))


def _poses_are_doubted(estimate_extrinsic: int) -> bool:
    entries = {"estimate_extrinsic": estimate_extrinsic}
    return bool(camodocal._imu(Source(Path("a"), entries)).notes)


def _kinect() -> Any:
    return published_camera(Path("somewhere"), (640, 480))


def _view_deg() -> float:
    camera = _kinect().cam0
    return float(np.degrees(2 * np.arctan(0.5 * camera.width / camera.fu)))


def _drive_s(frames: int) -> float:
    """Time between the first and last pose of GTSAM's stereo factors, which have no times: those of a
    drive in `vio.datasets.kitti` are taken.
    """
    rows = "".join(f"{k} {j} 300 290 200 0 0 9\n" for k in range(frames) for j in range(3))
    with (
        TemporaryDirectory() as name,
        patch.object(gtsam, "_camera", lambda file: MagicMock(spec=StereoCamera)),
    ):
        file = Path(name) / "stereo_factors.txt"
        file.write_text(rows)
        return float(np.ptp(gtsam.read_gtsam(file).recording.frame_times_ns)) / 1e9


LIMITS: dict[str, tuple[Says, float, float]] = {
    "clock: others go on": (lambda n: _other_clock_goes_on(int(n)), 19, 20),
    "clock: recorded late": (lambda x: _slow_topic_was_set(int(x)), 95, 105),
    "clock: alike": (lambda x: _are_apart(int(x)), 95, 105),
    "clock: behind": (lambda n: _is_set_later(held=int(n)), 3, 4),
    "clock: given before": (lambda n: not _is_set_later(earlier=int(n)), 9, 10),
    "bag: chunks": (lambda n: not _finds_set_back(int(n)), 4, 5),
    "bag: RealSense": (
        lambda ns: sdk_stamps([(5, b"timestamp=1005.25;a=1")]).stamp_ns.tolist() == [ns],
        100_525_000,
        1_005_250_000,
    ),
    "bag: fix": (lambda n: _has_fix(int(n)), -1, 0),
    "oxts: columns": (lambda n: not is_refused(lambda: _oxts([0.0] * int(n))), 29, 30),
    "oxts: column of accuracy": (lambda n: _oxts_sigma_m(int(n), 5.0) > 4.0, 22, 23),
    "oxts: least": (lambda x: _oxts_sigma_m(23, 0.0) < x, 0.021, 0.024),
    "IMU: columns": (lambda n: _could_be_imu(int(n)), 6, 7),
    "features: not seen": (lambda x: _is_seen(x), -1, 1),
    "log: version": (lambda n: not _log_is_read(int(n)), 2, 3),
    "PNG: filters": (lambda n: decode_gray8(_png(int(n))) is None, 4, 5),
    "KITTI: gray": (lambda n: not _kitti_cameras(int(n), False), 0, 1),
    "KITTI: colour": (lambda n: _kitti_cameras(int(n), True), 1, 2),
    "levels: images": (lambda n: not _levels_are_of(int(n)), 8, 9),
    "images: assumed times": (lambda x: _assumed_s(11) < x, 0.95, 1.05),
    "images: counted": (lambda n: not _counts([str(int(n))]), 10**9 - 1, 10**9),
    "images: named by times": (lambda n: _first_are_times(int(n)), 99, 100),
    "pairs: apart": (
        lambda x: len(pair_stamps(1000 * MS * np.arange(9), round(MS * x) + 1000 * MS * np.arange(9))[0]) == 0,
        2.9,
        3.1,
    ),
    "drive: rate": (lambda x: _drive_s(11) < x, 0.95, 1.05),
    "OAK: cm": (lambda x: _oak_baseline_m() < x, 0.074, 0.076),
    "OAK: left": (lambda f: _of_oak().cam0.fu == f, 400.0, 500.0),
    "OAK: right": (lambda f: _of_oak().cam1.fu == f, 500.0, 600.0),
    "ZED: mm": (lambda x: _zed_baseline_m() < x, 0.119, 0.121),
    "VINS: unknown poses": (lambda n: _poses_are_doubted(int(n)), 1, 2),
    "TUM: levels of a metre": (lambda x: _kinect().depth_factor == x, 1000, 5000),
    "TUM: view": (lambda x: _view_deg() < x, 62.0, 63.5),
}  # fmt: skip


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_codes_and_units_of_files(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)


def test_bags_are_written_for_readers_of_version_8(tmp_path: Path) -> None:
    with bag_writer(tmp_path, "rosbag2"):
        pass
    stated = yaml.safe_load((tmp_path / "metadata.yaml").read_text())
    assert stated["rosbag2_bagfile_information"]["version"] <= 8


def test_sensors_of_an_oak_are_linked_to_its_imu() -> None:
    links = {
        "toCameraSocket": 1,
        "rotationMatrix": np.eye(3).tolist(),
        "translation": {"x": 1.0, "y": 2.0, "z": 3.0},
    }
    rig = _of_oak(imuExtrinsics=links)
    np.testing.assert_allclose(rig.T_cam0_imu[:3, 3], [0.01, 0.02, 0.03])
