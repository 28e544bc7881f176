"""IMU tables with the columns of flight controllers, phones and message loggers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.plain_maker import make_plain
from vio.datasets import open_dataset
from vio.datasets.image_pairs import ImageDataset
from vio.datasets.tables import names_readings, read_imu_table
from vio.errors import DataError
from vio.records import ImuSample

Row = tuple[int, np.ndarray]  # time in nanoseconds, gyro and accel (6,)


def _samples(folder: Path) -> list[Row]:
    dataset = open_dataset(folder)
    assert isinstance(dataset, ImageDataset)
    samples = [sample for sample in dataset.motion if isinstance(sample, ImuSample)]
    return [(e.time_ns, np.array([*e.gyro, *e.accel])) for e in samples]


def _text(header: str, rows: list[Row], cells: Callable[[int, list[str]], list[str]]) -> str:
    lines = [",".join(cells(t, [repr(float(x)) for x in values])) for t, values in rows]
    return "\n".join([header, *lines]) + "\n"


def _echoed(t: int, v: list[str]) -> list[str]:
    covariance = ["0"] * 3
    return [str(t + 7), "3", str(t), "imu_link", *v[:3], *covariance, *v[3:], *covariance]


ECHOED = ",".join(
    [
        "%time,field.header.seq,field.header.stamp,field.header.frame_id",
        *(f"field.angular_velocity.{axis}" for axis in "xyz"),
        *(f"field.angular_velocity_covariance{k}" for k in range(3)),
        *(f"field.linear_acceleration.{axis}" for axis in "xyz"),
        *(f"field.linear_acceleration_covariance{k}" for k in range(3)),
    ]
)
INDEXED = (
    "timestamp [ns],gyro_rad[0],gyro_rad[1],gyro_rad[2],gyro_integral_dt,"
    "accelerometer_timestamp_relative,accelerometer_m_s2[0],accelerometer_m_s2[1],"
    "accelerometer_m_s2[2],accelerometer_integral_dt,accelerometer_clipping"
)
COUNTED = (
    "#counter,sec,nsec,angular_velocity_x,angular_velocity_y,angular_velocity_z,"
    "linear_acceleration_x,linear_acceleration_y,linear_acceleration_z"
)
RATES = "Time_ns,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,T,GH,AH,GHz,AHz"
FORMS: dict[str, tuple[str, Callable[[int, list[str]], list[str]]]] = {
    "covariances, and a stamp behind the time of recording": (ECHOED, _echoed),
    "axes by an index, and times of integration": (
        INDEXED,
        lambda t, v: [str(t), *v[:3], "5000", "0", *v[3:], "5000", "0"],
    ),
    "a counter before seconds and nanoseconds": (
        COUNTED,
        lambda t, v: ["9", str(t // 10**9), str(t % 10**9), *v],
    ),
    "health and rate of both sensors": (
        RATES,
        lambda t, v: [str(t), "0", *v, "45.1", "1", "1", "2000", "1000"],
    ),
    "axes in brackets": (
        "t [ns],Gyro (z),Gyro (x),Gyro (y),Accel (z),Accel (x),Accel (y),temperature",
        lambda t, v: [str(t), v[2], *v[:2], v[5], *v[3:5], "20"],
    ),
}


FORMS |= {
    "ticks of a tenth of a millisecond": (
        "PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z,Roll,Pitch,Yaw",
        lambda t, v: ["7", str(t // 100_000), *v[3:], *v[:3], "1", "2", "3"],
    ),
    "axes before sensors": (
        "GPS TFlags,GPS Week,GPS TOW [ns],X Accel,Y Accel,Z Accel,X Gyro,Y Gyro,Z Gyro",
        lambda t, v: ["6", "2260", str(t), *v[3:], *v[:3]],
    ),
    "shortened names": (
        "timestamp [ns],imu_lin_acc_x,imu_lin_acc_y,imu_lin_acc_z,imu_ang_vel_x,imu_ang_vel_y,imu_ang_vel_z",
        lambda t, v: [str(t), *v[3:], *v[:3]],
    ),
    "dates in several columns": (
        "n,UTC_Nano,UTC_Year,UTC_Month,UTC_Day,UTC_Hour,UTC_Minute,UTC_Second,Acc_X,Acc_Y,Acc_Z,"
        "Gyr_X,Gyr_Y,Gyr_Z",
        lambda t, v: ["1", str(t % 10**9), *_date(t), *v[3:], *v[:3]],
    ),
}


_DATE = "year,month,day,hour,minute,second"
_SENSORS = "Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z"
FORMS |= {
    "a time before a date of whole seconds": (
        f"timestamp,{_DATE},{_SENSORS}",
        lambda t, v: [str(t), *_date(t), *v[3:], *v[:3]],
    ),
    "a time before a date that a receiver has not yet": (
        f"timestamp,{_DATE},{_SENSORS}",
        lambda t, v: [str(t), *"000000", *v[3:], *v[:3]],
    ),
    "a date and milliseconds": (
        f"{_DATE},Millisecond,{_SENSORS}",
        lambda t, v: [*_date(t), str(t % 10**9 // 10**6), *v[3:], *v[:3]],
    ),
    "a date and ms": (
        f"n,{_DATE},ms,{_SENSORS}",
        lambda t, v: ["1", *_date(t), str(t % 10**9 // 10**6), *v[3:], *v[:3]],
    ),
    "a date and microseconds": (
        f"{_DATE},usec,{_SENSORS}",
        lambda t, v: [*_date(t), str(t % 10**9 // 1000), *v[3:], *v[:3]],
    ),
    "decimals of seconds and their milliseconds": (
        f"{_DATE},milliseconds,{_SENSORS}",
        lambda t, v: [
            *_date(t)[:5],
            f"{int(_date(t)[5]) + t % 10**9 / 1e9:.9f}",
            str(t % 10**9 // 10**6),
            *v[3:],
            *v[:3],
        ],
    ),
}


def _date(t_ns: int) -> list[str]:
    whole = np.datetime64(t_ns // 10**9, "s").astype(object)
    return [
        str(getattr(whole, part)) for part in ("year", "month", "day", "hour", "minute", "second")
    ]


@pytest.mark.parametrize("form", FORMS)
def test_the_columns_of_a_logger_are_found_by_their_names(form: str, tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    expected = _samples(folder)
    (folder / "imu.csv").write_text(_text(FORMS[form][0], expected, FORMS[form][1]))
    found = _samples(folder)
    assert [t for t, _ in found] == [t for t, _ in expected]
    np.testing.assert_array_equal([v for _, v in found], [v for _, v in expected])
    assert not any("doubtful" in note for note in open_dataset(folder).recording.notes)


def test_a_counter_in_microseconds_is_told_by_its_steps(tmp_path: Path) -> None:
    path = tmp_path / "imu.csv"
    rows = "".join(f"{k},{7_000_000 + 8333 * k},0,0,9.8,0.1,0,0\n" for k in range(20))
    path.write_text(f"PacketCounter,SampleTimeFine,{_SENSORS}\n{rows}")
    record, _ = read_imu_table(path)
    np.testing.assert_array_equal(record.times_ns, 1000 * (7_000_000 + 8333 * np.arange(20)))


@pytest.mark.parametrize(
    "date",
    ["2024,13,1,1,1,1.5", "24,1,1,1,1,1.5", "2024,1,1,1,1,nan", "2024,1,1,1,1,inf", "0,0,0,0,0,0"],
)
def test_columns_of_no_date_are_refused(date: str, tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    cells = lambda t, v: [*date.split(","), *v]  # noqa: E731
    header = "year,month,day,hour,minute,second,gx,gy,gz,ax,ay,az"
    (folder / "imu.csv").write_text(_text(header, _samples(folder), cells))
    with pytest.raises(DataError, match="line 2: its columns of year to second hold no date"):
        _samples(folder)


def test_lines_that_name_their_sensor_are_refused_with_what_to_do(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    cells = lambda t, v: [str(t), "GYROSCOPE_RAW", *v[:3]]  # noqa: E731
    (folder / "imu.csv").write_text(_text("ts,sensor,x,y,z", _samples(folder), cells))
    with pytest.raises(DataError, match="'GYROSCOPE_RAW' says whose a line is, write the lines of"):
        _samples(folder)


def test_one_imu_of_a_log_that_holds_several_is_read(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    expected = _samples(folder)
    both = [(t, v + shift) for t, v in expected for shift in (0.0, 0.5)]
    numbers = iter([0, 1] * len(expected))
    cells = lambda t, v: [str(t), str(next(numbers)), *v]  # noqa: E731
    (folder / "imu.csv").write_text(_text("Time_ns,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", both, cells))
    found = _samples(folder)
    np.testing.assert_array_equal([v for _, v in found], [v for _, v in expected])
    notes = open_dataset(folder).recording.notes
    assert any("holds 2 IMUs; the readings of number 0 are used" in note for note in notes)


def test_sensors_of_a_phone_may_state_two_times_and_another_order(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    expected = _samples(folder)
    (folder / "imu.csv").unlink()
    reversed_axes = {"Gyroscope": slice(2, None, -1), "TotalAcceleration": slice(5, 2, -1)}
    start = expected[0][0]
    for name, axes in reversed_axes.items():
        cells = lambda t, v, axes=axes: [str(t), str((t - start) / 1e9), *v[axes]]  # noqa: E731
        (folder / f"{name}.csv").write_text(_text("time,seconds_elapsed,z,y,x", expected, cells))
    # without gravity
    (folder / "Accelerometer.csv").write_text("time,seconds_elapsed,z,y,x\n1,0,0,0,0\n")
    found = _samples(folder)
    assert [t for t, _ in found] == [t for t, _ in expected]
    np.testing.assert_allclose([v for _, v in found], [v for _, v in expected], rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "header", "wanted"),
    [
        ("flight_sensor_combined_0.csv", INDEXED, "imu.csv"),
        ("GX010001_GYRO.csv", "cts,date,gyro x,gyro y,gyro z", "gyro.csv"),
        ("GX010001_ACCL.csv", "cts,date,accel x,accel y,accel z", "accel.csv"),
        ("GX010001_GPS.csv", "cts,date,lat,lon,alt,speed,dop,fix", None),
        ("gyro_scale.csv", "x,y,z", None),
    ],
)
def test_tables_of_sensors_are_told_by_what_they_hold(
    name: str, header: str, wanted: str | None, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_text(header + "\n" + ",".join("1" for _ in header.split(",")) + "\n")
    assert names_readings(path) == wanted
