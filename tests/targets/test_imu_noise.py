"""Allan deviation of an IMU at rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.commands import refused
from vio.cli import main
from vio.datasets.yaml_files import imu_densities, read_yaml_file
from vio.errors import DataError
from vio.records import ImuRecord
from vio.targets.noise import (
    allan_curve,
    axis_noise,
    measure_noise,
    overlapping_allan,
)

RATE_HZ = 50.0


def _record(seconds: float, seed: int = 0) -> ImuRecord:
    rng = np.random.default_rng(seed)
    count = int(seconds * RATE_HZ)
    times = (np.arange(count) * (1e9 / RATE_HZ)).astype(np.int64)

    def signal(white: float, walk: float) -> np.ndarray:
        bias = np.cumsum(walk / np.sqrt(RATE_HZ) * rng.standard_normal((count, 3)), axis=0)
        return bias + white * np.sqrt(RATE_HZ) * rng.standard_normal((count, 3))

    gravity = np.array([0, 0, 9.81])
    accel = signal(2e-3, 2e-4) + gravity
    return ImuRecord(times, signal(2e-4, 1e-5), accel)


def test_the_deviation_is_that_of_its_definition() -> None:
    values = np.random.default_rng(1).standard_normal(200)
    m = 7
    means = np.convolve(values, np.ones(m) / m, "valid")
    differences = means[m:] - means[:-m]
    expected = np.sqrt(0.5 * np.mean(differences**2))
    found = overlapping_allan(values, RATE_HZ, np.array([m]))
    assert found[0] == pytest.approx(expected, rel=1e-9)


def test_finds_the_densities_of_a_simulated_imu() -> None:
    noise = measure_noise(_record(1800))
    assert noise.gyro.white.value == pytest.approx(2e-4, rel=0.05)
    assert noise.accel.white.value == pytest.approx(2e-3, rel=0.05)
    assert noise.gyro.walk.low < 1e-5 < noise.gyro.walk.high * 1.5
    assert noise.accel.walk.low < 2e-4 < noise.accel.walk.high * 1.5


def test_a_short_record_bounds_the_random_walk() -> None:
    rng = np.random.default_rng(2)
    noise = axis_noise(allan_curve(rng.standard_normal(20_000), RATE_HZ))
    assert noise.white.value == pytest.approx(1 / np.sqrt(RATE_HZ), rel=0.03)


def test_says_what_to_record(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="record an hour"):
        measure_noise(_record(60))
    record = _record(400)
    record.gyro[10_000:10_100] += 0.5
    with pytest.raises(DataError, match="moved at second"):
        measure_noise(record)
    gap = np.r_[0:5000, 5100:20000]
    with pytest.raises(DataError, match="are missing for 2"):
        measure_noise(ImuRecord(record.times_ns[gap], record.gyro[gap], record.accel[gap]))


@pytest.mark.parametrize(
    ("gyro", "accel", "words"),
    [
        (1.0, 1 / 9.80665, "its unit seems to be g"),
        (1.0, 1000 / 9.80665, "its unit seems to be mg"),
        (1.0, 0.5, "state its unit in a header"),
        (0.0, 1.0, "gyro x are all the same"),
    ],
)
def test_readings_in_other_units_are_refused(gyro: float, accel: float, words: str) -> None:
    record = _record(400)
    with pytest.raises(DataError, match=words):
        measure_noise(ImuRecord(record.times_ns, gyro * record.gyro, accel * record.accel))


def test_gravity_in_another_place_is_named() -> None:
    record = _record(400)
    with pytest.raises(DataError, match="the gyro's columns show it"):
        measure_noise(ImuRecord(record.times_ns, record.accel, record.gyro))
    with pytest.raises(DataError, match="linear acceleration"):
        measure_noise(ImuRecord(record.times_ns, record.gyro, record.accel - [0, 0, 9.81]))


def test_copies_and_knocks_are_not_called_motion() -> None:
    record = _record(400)
    held = np.arange(len(record.times_ns)) // 2 * 2
    with pytest.raises(DataError, match="50 % of the samples repeat"):
        measure_noise(ImuRecord(record.times_ns, record.gyro[held], record.accel[held]))
    record.gyro[10_010, 1] += 5
    with pytest.raises(DataError, match=r"gyro y shows .* at second 200\.20"):
        measure_noise(record)


def test_what_the_densities_are_not_is_noted() -> None:
    record = _record(1200)
    assert measure_noise(record).notes == ()
    turned = measure_noise(ImuRecord(record.times_ns, np.degrees(record.gyro), record.accel))
    assert [note for note in turned.notes if "in deg/s, state that" in note]
    seconds = 1e-9 * record.times_ns
    warm = record.gyro + np.outer(seconds / seconds[-1], [0.0, 0.01, 0.0])
    (note,) = measure_noise(ImuRecord(record.times_ns, warm, record.accel)).notes
    assert note.startswith("gyro y drifts steadily, by +0.0")
    shaken = record.accel + 0.3 * np.sin(2 * np.pi * 11.3 * seconds)[:, None] * [0, 0, 1]
    noise = measure_noise(ImuRecord(record.times_ns, record.gyro, shaken))
    assert [note for note in noise.notes if note.startswith("accel z is ")]
    assert noise.accel.walk.value > 0


@pytest.mark.parametrize("seed", range(1, 7))
def test_healthy_records_have_no_notes(seed: int) -> None:
    assert measure_noise(_record(900, seed)).notes == ()


def test_the_command_writes_kalibrs_file(tmp_path: Path) -> None:
    record = _record(400)
    rows = np.column_stack([record.gyro, record.accel])
    lines = [
        f"{t},{','.join(f'{x:.9g}' for x in row)}"
        for t, row in zip(record.times_ns.tolist(), rows, strict=True)
    ]
    header = "timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z\n"
    file = tmp_path / "imu.csv"
    file.write_text(header + "\n".join(lines) + "\n")
    out = tmp_path / "out.yaml"
    plot = tmp_path / "allan.png"
    assert main(["imu-noise", str(file), "--out", str(out), "--plot", str(plot)]) == 0
    densities = imu_densities(read_yaml_file(out), out)
    assert densities is not None
    assert densities.gyro == pytest.approx(5.0 * 2e-4, rel=0.1)  # as the tutorial says
    assert plot.stat().st_size > 10_000


def test_a_folder_is_answered_with_the_table_in_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "give the table of IMU samples: its imu.csv" in refused(capsys, "imu-noise", tmp_path)
    table = tmp_path / "mav0" / "imu0" / "data.csv"
    table.parent.mkdir(parents=True)
    table.touch()
    assert f"samples: {table}" in refused(capsys, "imu-noise", tmp_path)
