"""The IMU in a file of JSON Lines, one object a line.

Spectacular AI's `data.jsonl` has
`{"sensor": {"type": "gyroscope", "values": [x, y, z]}, "time": s}` (rad/s; m/s^2 of the
`accelerometer`) among other lines; cuVSLAM's `IMU.jsonl` (EDEX) lists both
sensors by name beside a `timestamp`.

Reference: Spectacular AI, "Data format", and the tools of cuVSLAM for EDEX.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vio.datasets.tables import NumberTable, in_order, sensor_of, stamps_ns
from vio.errors import DataError
from vio.files.stamps import FRAME_PACE, SAMPLE_PACE, parse_stamps
from vio.files.text import lines_of
from vio.geometry.lie import FloatArray
from vio.imu.sampling import sampling_notes
from vio.imu.two_sensors import joined_record
from vio.records import ImuRecord, IntArray

_TIMES = ("time", "timestamp", "t", "timestamp_ns", "timestamp_s", "time_s", "stamp")
_FORM = '{"sensor": {"type": "gyroscope", "values": [x, y, z]}, "time": seconds}'


class _Reading(NamedTuple):
    """A reading of one sensor."""

    sensor: str  # w: gyro, a: accelerometer
    header: str  # the name of its time
    stamp: str
    values: list[float]  # (3,)
    line: int


def read_imu_lines(path: Path) -> tuple[ImuRecord, tuple[str, ...]]:
    """Read the gyro (rad/s) and the accelerometer (m/s^2) of a file of JSON Lines; lines of other
    content, and a last line that was cut, are skipped.

    Returns:
        The record, with the acceleration interpolated where the stamps differ, and notes.

    Raises:
        DataError: a line is no JSON, or there are no readings of one of the two.
    """
    found: list[str] = []
    readings = list(_readings(path, found))
    gyro = _of_sensor(path, [r for r in readings if r.sensor == "w"], "gyro", found)
    accel = _of_sensor(path, [r for r in readings if r.sensor == "a"], "accelerometer", found)
    notes = dict.fromkeys(found)  # the unit of the times is that of both
    record: ImuRecord | None
    if np.array_equal(gyro[0], accel[0]):
        record = ImuRecord(gyro[0], gyro[1], accel[1])
    else:
        record = joined_record(gyro, accel)
    if record is None:
        raise DataError(f"{path}: no time of the gyro lies between those of the accelerometer")
    return record, (*notes, *sampling_notes(record, str(path)))


def read_frame_times(path: Path) -> IntArray:
    """Read the times (F,) of the frames of Spectacular AI's `data.jsonl`, whose lines
    `{"frames": [{"cameraInd": 0, "time": s}, ...], "time": s}` are in the order of its videos; that
    of the first camera where it has its own.

    Raises:
        DataError: a line is no JSON, or the times do not increase.
    """
    found = []
    for number, entry in _entries(path, []):
        frames = entry.get("frames")
        if not isinstance(frames, list):
            continue
        first = next((f for f in frames if isinstance(f, dict) and f.get("cameraInd") == "0"), {})
        stamp = first.get("time", entry.get("time"))
        if isinstance(stamp, str):
            found.append((number, stamp))
    stamps = [stamp for _, stamp in found]
    return parse_stamps(stamps, lambda k: f"{path}, line {found[k][0]}", "s", pace=FRAME_PACE)


def _readings(path: Path, notes: list[str]) -> Iterator[_Reading]:
    for number, entry in _entries(path, notes):
        key = next((key for key in _TIMES if isinstance(entry.get(key), str)), None)
        if key is None:
            continue
        for name, values in _vectors(entry):
            sensor = sensor_of(name)
            if sensor:
                yield _Reading(sensor, key, entry[key], values, number)


def _entries(path: Path, notes: list[str]) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the number and the object of each line that holds one, its numbers as text; a last line
    that was cut is noted.

    Raises:
        DataError: another line is no JSON.
    """
    fault: DataError | None = None  # of the line before, which may be the last one
    is_first = True
    for number, line in lines_of(path):
        if not line.strip():
            continue
        if fault is not None:
            raise fault
        try:
            # numbers as they are written, so that no stamp is rounded
            entry = json.loads(line, parse_float=str, parse_int=str)
        except (ValueError, RecursionError) as error:
            fault = DataError(
                f"{path}, line {number}: is no JSON ({error}); write one object a line, as {_FORM}"
            )
            if is_first:
                raise fault from error
            continue
        is_first = False
        if isinstance(entry, dict):
            yield number, entry
    if fault is not None:
        notes.append(f"{path}: the last line was cut, and is left out")


def _vectors(entry: dict[str, Any]) -> Iterator[tuple[str, list[float]]]:
    """Yield the names and values of all triples of numbers of a line."""
    sensor = entry.get("sensor")
    named = dict(entry)
    if isinstance(sensor, dict):
        named[str(sensor.get("type"))] = sensor.get("values")
    for name, values in named.items():
        if isinstance(values, dict) and set(values) == set("xyz"):
            values = [values[axis] for axis in "xyz"]
        if (
            isinstance(values, list)
            and len(values) == 3
            and all(isinstance(v, str) for v in values)
        ):
            try:
                yield name.lower(), list(map(float, values))
            except ValueError:
                continue


def _of_sensor(
    path: Path, readings: list[_Reading], name: str, notes: list[str]
) -> tuple[IntArray, FloatArray]:
    """Return the times (N,) and the readings (N, 3) of a sensor."""
    if not readings:
        raise DataError(f"{path}: holds no readings of the {name}; write them as {_FORM}")
    table = NumberTable(
        path,
        (readings[0].header,),
        (),
        tuple(reading.stamp for reading in readings),
        np.array([reading.values for reading in readings]),
        [reading.line for reading in readings],
    )
    table, times_ns = in_order(table, stamps_ns(table, SAMPLE_PACE, notes), notes)
    lost = ~np.isfinite(table.values).all(axis=1)
    if lost.any():
        raise DataError(
            f"{table.where(int(np.argmax(lost)))}: a reading of the {name} is not finite"
        )
    return times_ns, table.values
