"""Motion samples held as arrays: what an hour of an IMU takes, and the order of samples of equal
times.
"""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vio.datasets.euroc_files import imu_csv
from vio.datasets.samples import (
    MotionSamples,
    imu_samples,
    in_time_order,
    motion_samples,
    velocity_samples,
)
from vio.datasets.tables import read_imu_table
from vio.errors import DataError
from vio.files.text import lines_of
from vio.records import ImuRecord, ImuSample, VelocitySample

_SAMPLES = 20_000  # 100 s at 200 Hz
_ROW_BYTES = 8 + 48 + 1  # of a time, six readings and the kind


def _record(samples: int) -> ImuRecord:
    readings = np.random.default_rng(0).normal(size=(samples, 6))
    return ImuRecord(10**18 + 5_000_000 * np.arange(samples), readings[:, :3], readings[:, 3:])


def test_reading_an_imu_takes_its_numbers_and_little_more(tmp_path: Path) -> None:
    """Records of all samples took 330 bytes each, and the lists of the lines and fields twice as
    much meanwhile.
    """
    path, record = tmp_path / "data.csv", _record(_SAMPLES)
    path.write_text(imu_csv(record))
    text_bytes = path.stat().st_size
    tracemalloc.start()
    samples = imu_samples(read_imu_table(path, whole_ns=True)[0])
    held, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 2 * _ROW_BYTES * _SAMPLES  # the record and the samples share the times
    # the file's bytes and its text, and arrays that grow
    assert peak < 2 * text_bytes + 4 * _ROW_BYTES * _SAMPLES
    assert np.array_equal(samples.times_ns, record.times_ns)
    assert np.array_equal(samples.values, np.hstack([record.gyro, record.accel]))


def test_samples_are_those_that_went_in() -> None:
    gyro, speed = np.arange(3.0), np.arange(3.0, 6.0)
    mixed = [
        VelocitySample(10, speed, gyro),
        ImuSample(10, gyro, speed),
        ImuSample(20, speed, gyro),
    ]
    arrays = motion_samples(mixed)
    assert motion_samples(arrays) is arrays
    assert [type(x) for x in arrays] == [VelocitySample, ImuSample, ImuSample]
    assert [x.time_ns for x in arrays] == [10, 10, 20]
    first, last = arrays[0], arrays[-1]
    assert np.array_equal([first.linear, first.angular], [speed, gyro])
    assert np.array_equal([last.gyro, last.accel], [speed, gyro])
    assert type(last.time_ns) is int  # as those of records are, and as checkpoints hold them
    assert [type(x) for x in arrays[1:]] == [ImuSample, ImuSample]
    with pytest.raises(IndexError):
        arrays[3]


def test_of_equal_times_an_earlier_part_comes_first() -> None:
    zero = np.zeros((2, 3))
    imu = imu_samples(ImuRecord(np.array([10, 20]), zero, zero))
    speeds = velocity_samples(np.array([10, 15]), zero, zero)
    assert [type(x) for x in in_time_order(imu, speeds)] == [
        ImuSample,
        VelocitySample,
        VelocitySample,
        ImuSample,
    ]
    assert [type(x) for x in in_time_order(speeds, imu)] == [
        VelocitySample,
        ImuSample,
        VelocitySample,
        ImuSample,
    ]
    assert len(in_time_order()) == 0


def test_readings_of_another_type_are_refused_at_once() -> None:
    values = np.zeros((2, 6), dtype=np.float32)
    with pytest.raises(DataError, match=r"gyro is an array .* of float32"):
        MotionSamples(np.array([1, 2]), values, np.ones(2, dtype=np.bool_))


@settings(max_examples=30, deadline=None)
@given(
    text=st.text(alphabet=" ab\n\r\x0b\x0c\x1c\x85\u2028é", max_size=60), piece=st.integers(1, 8)
)
@example(text="a\r\n\r\nb\n \n\t", piece=1)
def test_lines_read_in_pieces_are_those_of_the_whole(
    text: str, piece: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("lines") / "text"
    path.write_bytes(text.encode())
    whole = text.splitlines()
    while whole and not whole[-1].strip():
        whole.pop()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vio.files.text._PIECE", piece)
        assert list(lines_of(path)) == list(enumerate(whole, start=1))
