"""Tables of IMUs without a header, and files of JSON Lines, as data sets and SDKs have them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.plain_maker import make_plain
from vio.datasets import open_dataset
from vio.geometry.lie import FloatArray
from vio.records import ImuSample, Recording

ZEROS = ",".join(["0.0"] * 9)


def _read(folder: Path) -> tuple[Recording, list[tuple[int, list[float]]]]:
    dataset = open_dataset(folder)
    samples = [event for event in dataset.events() if isinstance(event, ImuSample)]
    return dataset.recording, [(s.time_ns, [*s.gyro, *s.accel]) for s in samples]


def _rows(folder: Path) -> list[tuple[int, FloatArray]]:
    """The times and readings of a folder's imu.csv, which is removed."""
    lines = (folder / "imu.csv").read_text().splitlines()[1:]
    (folder / "imu.csv").unlink()
    cells = [line.split(",") for line in lines]
    return [(int(c[0]), np.array([float(x) for x in c[1:]])) for c in cells]


def _text(values: FloatArray) -> str:
    return ",".join(map(repr, values.tolist()))


def _message(t: int, r: FloatArray) -> str:
    stamp = f"{t // 10**9},{t % 10**9},imu_link"
    return f"{stamp},0.0,0.0,0.0,1.0,{ZEROS},{_text(r[:3])},{ZEROS},{_text(r[3:])},{ZEROS}"


def _kaist(t: int, r: FloatArray) -> str:
    return f"{t},0,0,0,1,0.1,0.2,0.3,{_text(r)},0.2,-0.1,0.4"


def _nclt(t: int, r: FloatArray) -> str:
    return f"{t // 1000},0.2,-0.1,0.4,{_text(r[3:])},{_text(r[:3])}"


def _edex(t: int, r: FloatArray) -> str:
    gyro, accel = r[:3].tolist(), r[3:].tolist()
    named = {"AccelerometerXYZMeterPerSecSec": accel, "GyroscopeXYZRadPerSec": gyro}
    return json.dumps({**named, "timestamp": t})


def _spectacular(t: int, r: FloatArray) -> str:
    time = f"{t // 10**9}.{t % 10**9:09d}"
    lines = [
        f'{{"sensor": {{"type": "{kind}", "values": {values.tolist()}}}, "time": {time}}}'
        for kind, values in (("gyroscope", r[:3]), ("accelerometer", r[3:]))
    ]
    frame = f'{{"frames": [{{"cameraInd": 0}}], "number": 0, "time": {time}}}'
    return "\n".join([*lines, frame])


FORMS = {
    "imu.csv": _message,
    "xsens_imu.csv": _kaist,
    "sensor_data/xsens_imu.csv": _kaist,
    "ms25.csv": _nclt,
    "IMU.jsonl": _edex,
    "data.jsonl": _spectacular,
}


@pytest.mark.parametrize("name", FORMS)
def test_imus_of_data_sets_and_sdks_are_read(name: str, tmp_path: Path) -> None:
    folder = make_plain(tmp_path / "plain")
    _, expected = _read(folder)
    assert len(expected) > 20
    rows = _rows(folder)
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).write_text("".join(f"{FORMS[name](t, r)}\n" for t, r in rows))
    recording, found = _read(folder)
    assert found == expected
    assert not any("not used" in note for note in recording.notes)


def test_an_imu_of_unknown_pose_is_noted_and_the_images_are_used(tmp_path: Path) -> None:
    folder = make_plain(tmp_path / "plain")
    rows = _rows(folder)
    camchain = folder / "camchain-imucam.yaml"
    text = camchain.read_text()
    for camera in ("cam0", "cam1"):
        start = text.index("  T_cam_imu:", text.index(f"{camera}:"))
        end = start + len("\n".join(text[start:].split("\n")[:5])) + 1
        text = text[:start] + text[end:]
    camchain.write_text(text)
    (folder / "IMU.jsonl").write_text("".join(f"{_edex(t, r)}\n" for t, r in rows))
    recording, found = _read(folder)
    assert found == []
    assert any("IMU.jsonl: not read, as the pose of its sensor" in n for n in recording.notes)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{}\n", "holds no readings of the gyro; write them as"),
        ("{\n", "line 1: is no JSON"),
        ('{"gyro": ["a", "b", "c"], "time": 1}\n', "holds no readings of the gyro"),
        ("[" * 100_000, "line 1: is no JSON"),
        ('{}\n{"time": \n{}\n', "line 2: is no JSON"),
    ],
)
def test_other_json_lines_are_noted(text: str, words: str, tmp_path: Path) -> None:
    folder = make_plain(tmp_path / "plain", imu=False)
    (folder / "data.jsonl").write_text(text)
    recording, found = _read(folder)
    assert found == []
    assert any("not read: " in note and words in note for note in recording.notes)


def test_a_last_line_that_was_cut_is_left_out(tmp_path: Path) -> None:
    folder = make_plain(tmp_path / "plain")
    _, expected = _read(folder)
    text = "".join(f"{_edex(t, r)}\n" for t, r in _rows(folder))
    (folder / "imu.jsonl").write_text(text[:-20])
    recording, found = _read(folder)
    assert len(found) >= len(expected) - 1 > 0
    assert found == expected[: len(found)]
    assert any("the last line was cut, and is left out" in note for note in recording.notes)


def test_ten_columns_of_another_name_are_refused(tmp_path: Path) -> None:
    folder = make_plain(tmp_path / "plain")
    (folder / "imu.csv").write_text("".join(f"{_nclt(t, r)}\n" for t, r in _rows(folder)))
    with pytest.raises(Exception, match="10 values instead of 7"):
        open_dataset(folder)


def test_times_may_lie_above_the_folders_of_rectified_images(tmp_path: Path) -> None:
    """As of DSEC: images/left/rectified, with the times in images."""
    inside = ("images/left/rectified", "images/right/rectified")
    folder = make_plain(tmp_path / "dsec", folders=inside, imu=False, reference=False)
    (folder / "times.txt").unlink()
    times_us = [51_000_000_000 + 50_000 * k for k in range(4)]
    (folder / "images" / "timestamps.txt").write_text("".join(f"{t}\n" for t in times_us))
    (folder / "images" / "exposures.txt").write_text("1\n")
    recording = open_dataset(folder).recording
    np.testing.assert_array_equal(recording.frame_times_ns, 1000 * np.array(times_us))
    assert "not used: images/exposures.txt" in recording.notes
