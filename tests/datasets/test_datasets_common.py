"""Clocks, transforms, the order of events, opening by kind or content, and the contract of all
readers.
"""

from __future__ import annotations

import re
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.dataset_makers import (
    CAMERA,
    T_CAM0_IMU,
    ece276a_arrays,
    ece276a_new_arrays,
    make_drive,
    make_kitti,
    make_mat,
    make_npz,
    utias_arrays,
)
from vio.datasets import MODULES, DatasetSettings, _detect, open_dataset, readers
from vio.datasets.common import clock_ns, merge_events, read_npz, seconds_to_ns
from vio.datasets.observation_log import write_observation_log
from vio.datasets.reader import never
from vio.errors import CalibrationError, ConfigError, DataError
from vio.geometry.lie import checked_transform
from vio.records import ImuSample, Recording, StereoFrame, VelocitySample

SOURCES = ("kitti", "ece276a", "ece276a_new", "utias", "log")


def make_source(kind: str, folder: Path) -> Path:
    """A small recording of each kind."""
    if kind == "kitti":
        return make_kitti(folder / "kitti", frames=6)
    drive = make_drive(6)
    if kind == "ece276a":
        return make_npz(folder / "old.npz", ece276a_arrays(drive))
    if kind == "ece276a_new":
        return make_npz(folder / "new.npz", ece276a_new_arrays(drive))
    if kind == "utias":
        return make_mat(folder / "drive.mat", utias_arrays(drive))
    dataset = open_dataset(make_source("ece276a", folder))
    observed = [dataset.observations(k) for k in range(6)]
    samples = [event for event in dataset.events() if isinstance(event, VelocitySample)]
    write_observation_log(
        folder / "run.npz", dataset.recording, [o for o in observed if o is not None], samples
    )
    return folder / "run.npz"


@pytest.mark.parametrize("kind", SOURCES)
def test_every_reader_satisfies_the_contract(kind: str, tmp_path: Path) -> None:
    dataset = open_dataset(make_source(kind, tmp_path))
    recording = dataset.recording
    assert recording.kind == kind.removesuffix("_new")
    assert recording.frame_times_ns.shape == (6,)
    assert recording.motion == {"velocity"}
    assert recording.T_cam0_imu is not None

    events = list(dataset.events())
    assert all(a.time_ns <= b.time_ns for a, b in pairwise(events))
    frames = [event for event in events if isinstance(event, StereoFrame)]
    samples = [event for event in events if isinstance(event, VelocitySample)]
    assert [frame.index for frame in frames] == list(range(6))
    assert [frame.time_ns for frame in frames] == recording.frame_times_ns.tolist()
    assert [sample.time_ns for sample in samples] == recording.frame_times_ns.tolist()
    for event, following in pairwise(events):
        if isinstance(following, VelocitySample):  # a sample precedes the frame of its time
            assert event.time_ns < following.time_ns

    for frame in frames:
        observed = dataset.observations(frame.index)
        assert (observed is None) == recording.has_images == (frame.left is not None)
        if observed is not None:
            assert (observed.frame_index, observed.time_ns) == (frame.index, frame.time_ns)
            assert len(np.unique(observed.ids)) == len(observed) > 0


@pytest.mark.parametrize("kind", SOURCES)
def test_events_of_a_range_include_its_motion_samples(kind: str, tmp_path: Path) -> None:
    dataset = open_dataset(make_source(kind, tmp_path))
    times = dataset.recording.frame_times_ns
    events = list(dataset.events(2, 5, images=False))
    frames = [event for event in events if isinstance(event, StereoFrame)]
    assert [frame.index for frame in frames] == [2, 3, 4]
    assert all(frame.left is None and frame.right is None for frame in frames)
    assert [e.time_ns for e in events if isinstance(e, VelocitySample)] == times[2:5].tolist()
    assert [f.index for f in dataset.events(4, 99, images=False) if isinstance(f, StereoFrame)] == [
        4,
        5,
    ]


@pytest.mark.parametrize(("start", "stop"), [(6, None), (-1, 3), (3, 3)])
def test_rejects_a_range_without_frames(start: int, stop: int | None, tmp_path: Path) -> None:
    dataset = open_dataset(make_source("ece276a", tmp_path))
    with pytest.raises(DataError, match="holds frames 0 to 5"):
        dataset.events(start, stop)


@settings(deadline=None)
@given(
    st.lists(st.integers(0, 40), max_size=30),
    st.integers(0, 3),
    st.integers(4, 6),
    st.sets(st.integers(0, 5)),
)
def test_events_are_in_time_order_at_any_rates(
    ticks: list[int], start: int, stop: int, lost: set[int]
) -> None:
    recording = _recording()
    motion = [VelocitySample(10**7 * t, np.zeros(3), np.zeros(3)) for t in sorted(ticks)]
    chosen = range(start, stop)
    frames = (
        StereoFrame(k, int(recording.frame_times_ns[k]), None, None)
        for k in chosen
        if k not in lost
    )
    events = list(merge_events(recording, chosen, motion, frames))
    assert all(a.time_ns <= b.time_ns for a, b in pairwise(events))
    first, last = recording.frame_times_ns[start], recording.frame_times_ns[stop - 1]
    inside = [sample.time_ns for sample in motion if first <= sample.time_ns <= last]
    assert [event.time_ns for event in events if isinstance(event, VelocitySample)] == inside
    for event, following in pairwise(events):
        assert not (isinstance(event, StereoFrame) and event.time_ns == following.time_ns)


def test_imu_samples_end_with_the_first_at_or_after_the_last_frame() -> None:
    """Readings are interpolated to the last exposure; frames stand at 0, 60, … ms."""
    recording, zero = _recording(), np.zeros(3)

    def last(times_ms: list[int], stop: int) -> int:
        frames = (StereoFrame(k, int(recording.frame_times_ns[k]), None, None) for k in range(stop))
        motion = [ImuSample(1_000_000 * t, zero, zero) for t in times_ms]
        return max(
            e.time_ns
            for e in merge_events(recording, range(stop), motion, frames)
            if isinstance(e, ImuSample)
        )

    assert last([-5, 5, 115, 125, 135], 3) == 125_000_000
    assert last([-5, 5, 120, 125, 135], 3) == 120_000_000
    assert last([-5, 5, 115], 3) == 115_000_000


def _recording() -> Recording:
    return Recording(
        "made", Path("made"), CAMERA, None, np.arange(6) * 60_000_000, False, frozenset(), None
    )


@settings(deadline=None)
@given(st.integers(0, 4 * 10**9), st.integers(0, 999_999))
def test_seconds_keep_their_microseconds(whole: int, micro: int) -> None:
    ns = int(seconds_to_ns(np.array([whole + micro * 1e-6]))[0])
    assert abs(ns - (whole * 10**9 + micro * 1000)) <= 480  # a double near 4e9 s steps by 477 ns


@pytest.mark.parametrize(
    ("seconds", "message"),
    [
        (
            [0.0, 0.1, 0.1],
            r"times, entry 2: the clock repeats \(0\.100000000 s after 0\.100000000 s\)",
        ),
        ([0.0, 0.2, 0.1], "times, entry 2: the clock runs backwards"),
        ([0.0, np.nan], "times, entry 1: the time nan is not a time"),
    ],
)
def test_clocks_must_increase(seconds: list[float], message: str) -> None:
    with pytest.raises(DataError, match=message):
        clock_ns(seconds, lambda k: f"times, entry {k}")


@pytest.mark.parametrize(
    ("T", "message"),
    [
        (np.diag([1.0, 1.0, -1.0, 1.0]), "a reflection"),
        (np.diag([1.0, 1.1, 1.0, 1.0]), "not a rotation"),
        (np.full((4, 4), np.nan), "not a finite"),
        (np.zeros((3, 3)), "3x4 or 4x4"),
        (np.ones((4, 4)), "the last row"),
    ],
)
def test_transforms_must_be_rigid(T: np.ndarray, message: str) -> None:
    with pytest.raises(CalibrationError, match=rf"^here: .*{message}"):
        checked_transform(T, "here")


def test_orthonormalises_a_rounded_transform_and_keeps_an_exact_one() -> None:
    assert np.array_equal(checked_transform(T_CAM0_IMU, "here"), T_CAM0_IMU)
    rounded = checked_transform(np.round(T_CAM0_IMU, 6), "here")
    assert np.abs(rounded[:3, :3].T @ rounded[:3, :3] - np.eye(3)).max() < 1e-14
    np.testing.assert_allclose(rounded, T_CAM0_IMU, atol=2e-6)


@pytest.mark.parametrize("kind", ["kitti", "ece276a", "utias", "log"])
def test_accepts_a_named_kind(kind: str, tmp_path: Path) -> None:
    path = make_source(kind, tmp_path)
    assert open_dataset(f"{kind}:{path}").recording.kind == kind
    assert open_dataset(path).recording.path == path


def test_detects_the_kind_from_content_not_suffix(tmp_path: Path) -> None:
    path = make_source("ece276a", tmp_path)
    assert open_dataset(path.rename(tmp_path / "renamed.bin")).recording.kind == "ece276a"


def test_a_drive_letter_is_no_kind(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"C:\\data\\07 does not exist"):
        open_dataset("C:\\data\\07")


def test_a_path_with_a_colon_is_a_path_when_it_exists(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    make_npz(tmp_path / "run:1", ece276a_arrays(make_drive(6)))
    assert open_dataset("run:1").recording.kind == "ece276a"


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("nowhere", "nowhere does not exist; check the path"),
        ("no/where", "no/where does not exist, nor does no; check"),
        ("demo/street", "demo/street does not exist; 'vio demo' renders it"),
        ("empti", "empti does not exist; did you mean empty"),
        (
            "holiday",
            "holiday: holds images, but not in folders; put those of a stereo camera into left and "
            "right",
        ),
        ("holiday/IMG_1.JPG", r"IMG_1\.JPG: is one image; give a folder with left and right"),
        ("film.mp4", r"film\.mp4: is one video; give a folder with left\.mp4, right\.mp4"),
        ("half", "half: holds images in right but none of a left camera; add them"),
        (
            "kiti:nowhere",
            "'kiti' in 'kiti:nowhere' is no kind of recording; .*did you mean 'kitti'",
        ),
        ("kitti:nowhere", "nowhere does not exist"),
        ("kitti:", "names no path; write kitti:PATH"),
        ("empty", "empty is empty; give a ROS bag .*, a KITTI folder"),
        ("other", "other: no known recording; looked for a ROS bag .*, a KITTI folder"),
        ("root", re.escape("root holds several KITTI sequences")),
        ("several", r"several: is no recording, but holds a\.npz \(ece276a\), b\.npz "),
        ("text.txt", "text.txt: no known recording, but numbers or text"),
        ("half.npz", "half.npz: is damaged"),
        ("log:text.txt", "text.txt: is damaged or no .npz archive"),
    ],
)
def test_rejects_unknown_sources_with_one_line_error(
    source: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("empty", "other/stuff", "root/sequences/00"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("text.txt", "film.mp4", "holiday/IMG_1.JPG", "half/right/0.png", "half/calib.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("hello\n")
    (tmp_path / "several").mkdir()
    for name in ("a.npz", "b.npz"):
        make_npz(tmp_path / "several" / name, ece276a_arrays(make_drive(6)))
    (tmp_path / "half.npz").write_bytes(make_source("ece276a", tmp_path).read_bytes()[:2000])
    with pytest.raises(DataError, match=message) as caught:
        open_dataset(source)
    assert "\n" not in str(caught.value)


def test_pickles_are_never_loaded(tmp_path: Path) -> None:
    path = make_npz(tmp_path / "objects.npz", {"features": np.array([{"a": 1}], dtype=object)})
    with pytest.raises(DataError, match="holds pickled objects"):
        read_npz(path)
    np.save(tmp_path / "one.npy", np.zeros(3))
    with pytest.raises(DataError, match=r"one\.npy: is damaged or no \.npz archive"):
        read_npz(tmp_path / "one.npy")


@pytest.mark.parametrize("name", ["max_bad_frames", "prefetch_frames"])
def test_settings_are_checked(name: str) -> None:
    values: dict[str, Any] = {name: -1}
    with pytest.raises(ConfigError, match=f"dataset.{name} must be at least 0"):
        DatasetSettings(**values)


@pytest.mark.parametrize(
    ("target", "message"), [("folder", "cannot list"), ("file.npz", "cannot read")]
)
def test_a_place_that_may_not_be_read_is_an_error_in_one_line(
    target: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / target
    if target == "folder":
        path.mkdir()
    else:
        path.write_bytes(b"PK")

    def denied(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir" if target == "folder" else "open", denied)
    with pytest.raises(DataError, match=f"{message} .*{target}: Permission denied"):
        open_dataset(path)
    if target != "folder":
        monkeypatch.setattr("zipfile.ZipFile", denied)
        monkeypatch.setattr("zipfile.is_zipfile", lambda _: True)
        with pytest.raises(DataError, match="Permission denied; give a readable file"):
            read_npz(path)


OWN_READER = """
from vio.datasets.plain import read_kitti
from vio.datasets.reader import Reader

READERS = (
    Reader(
        kind="mine",
        looked_for="a folder with mine.txt",
        read=read_kitti,
        is_folder=lambda path: (path / "mine.txt").is_file(),
    ),
)
"""


def test_a_reader_is_one_file_and_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is found by content and by name, and named where nothing is found."""
    (tmp_path / "my_readers").mkdir()
    (tmp_path / "my_readers" / "__init__.py").touch()
    (tmp_path / "my_readers" / "mine.py").write_text(OWN_READER)
    monkeypatch.syspath_prepend(tmp_path)
    folder = make_kitti(tmp_path / "recording")
    assert open_dataset(folder).recording.kind == "kitti"
    (folder / "mine.txt").touch()
    monkeypatch.setattr("vio.datasets.MODULES", ["my_readers.mine", *MODULES])
    assert _detect(folder) == "mine"
    assert open_dataset(f"mine:{folder}").recording.camera.kind == "stereo"
    (tmp_path / "nothing").mkdir()
    (tmp_path / "nothing" / "a.txt").touch()
    with pytest.raises(DataError, match=r"a folder with mine\.txt, a ROS bag"):
        open_dataset(tmp_path / "nothing")
    with pytest.raises(DataError, match="kind mine has its own"):
        open_dataset(folder, DatasetSettings(calibration=folder / "calib.txt"))


def test_every_kind_is_read_by_one_reader() -> None:
    found = [reader for name in MODULES for reader in _module(name).READERS]
    kinds = [reader.kind for reader in found]
    assert len(set(kinds)) == len(kinds)
    assert list(readers()) == kinds
    for reader in found:
        signs = (reader.is_folder, reader.may_be_folder, reader.is_file)
        assert any(sign is not never for sign in signs), f"{reader.kind} is never found"


def _module(name: str) -> Any:
    return import_module(f"vio.datasets.{name}")
