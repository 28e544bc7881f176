"""Tables whose lines repeat, were written late, or were stamped with lost digits."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.plain_maker import make_plain
from vio.datasets import open_dataset
from vio.datasets.tables import read_imu_table, read_velocity_table
from vio.errors import DataError
from vio.files.stamps import parse_stamps
from vio.files.trajectories import read_trajectory
from vio.imu.two_sensors import parted_sensors

HEADER = "timestamp [ns],wx,wy,wz,ax,ay,az"
START_NS = 1700000000_000000000
STEP_NS = 5_000_000


def _lines(count: int = 400) -> list[str]:
    rng = np.random.default_rng(count)
    readings = rng.normal([0, 0, 0, 0, 0, 9.81], 0.1, (count, 6))
    return [
        f"{START_NS + STEP_NS * k}," + ",".join(f"{value:.6f}" for value in row)
        for k, row in enumerate(readings)
    ]


def _read(folder: Path, lines: list[str]) -> tuple[list[int], np.ndarray, tuple[str, ...]]:
    file = folder / "imu.csv"
    file.write_text("\n".join([HEADER, *lines]) + "\n")
    record, notes = read_imu_table(file)
    return record.times_ns.tolist(), np.hstack([record.gyro, record.accel]), notes


def _twice(lines: list[str]) -> list[str]:
    return [line for line in lines for _ in range(2)]


def _late(lines: list[str]) -> list[str]:
    out = lines.copy()
    for k in range(20, len(out) - 3, 100):
        out[k : k + 3] = [out[k + 1], out[k + 2], out[k]]
    return out


def _appended(lines: list[str]) -> list[str]:
    return [*lines[:200], HEADER, *lines[200:]]


@pytest.mark.parametrize(
    ("change", "note"),
    [
        (_twice, "400 lines repeat the one above and are left out"),
        (_late, "4 lines were written late and are sorted"),
        (_appended, ""),
    ],
)
def test_lines_that_repeat_or_came_late_leave_the_record_as_it_is(
    change: Callable[[list[str]], list[str]], note: str, tmp_path: Path
) -> None:
    times_ns, values, before = _read(tmp_path, _lines())
    found_ns, found, notes = _read(tmp_path, change(_lines()))
    assert found_ns == times_ns
    np.testing.assert_array_equal(found, values)
    assert [n.partition(": ")[2] for n in notes if n not in before] == ([note] if note else [])


def test_velocities_that_repeat_are_left_out(tmp_path: Path) -> None:
    file = tmp_path / "velocity.csv"
    rows = [f"{k / 10},{k},0,0,0,0,0" for k in range(5) for _ in range(2)]
    file.write_text("time_s,vx_mps,vy_mps,vz_mps,wx_radps,wy_radps,wz_radps\n" + "\n".join(rows))
    notes = list[str]()
    assert len(read_velocity_table(file, notes)) == 5
    assert "5 lines repeat" in notes[0]


@pytest.mark.parametrize("back_ns", [2 * STEP_NS + 1_000_000, 2 * STEP_NS, 50 * STEP_NS // 2])
def test_a_clock_that_was_set_back_is_not_sorted(back_ns: int, tmp_path: Path) -> None:
    """Its two periods would interleave."""
    lines = _lines()
    moved = [f"{int(line[:19]) - back_ns}{line[19:]}" for line in lines[300:]]
    with pytest.raises(DataError, match="runs backwards"):
        _read(tmp_path, [*lines[:300], *moved])


def test_readings_of_one_stamp_that_differ_are_refused(tmp_path: Path) -> None:
    lines = _lines()
    lines[7] = lines[6][:19] + lines[7][19:]
    with pytest.raises(DataError, match=r"line 9: the clock repeats .* reorder that entry"):
        _read(tmp_path, lines)


@pytest.mark.parametrize("form", ["{:.5E}", "{:.7E}"])
def test_stamps_with_too_few_digits_are_said_to_be(form: str, tmp_path: Path) -> None:
    """As spreadsheets save them."""
    lines = [f"{form.format(int(line[:19]))}{line[19:]}" for line in _lines()]
    with pytest.raises(DataError, match="written with too few digits; write all their digits"):
        _read(tmp_path, lines)


@pytest.mark.parametrize("where", ["imu.csv", "times.txt"])
def test_nanoseconds_without_their_zeros_are_said_to_be(where: str, tmp_path: Path) -> None:
    """1700000000.50000000 for 50 ms after the second: as a decimal it is half a second."""
    folder = make_plain(tmp_path, frames=30)
    file = folder / where
    lost = lambda found: f"{found[1]}.{int(found[2])}"  # noqa: E731
    text = re.sub(r"\[ns\]", "[s]", file.read_text())
    file.write_text(re.sub(r"^(\d{10})\.?(\d{9})", lost, text, flags=re.MULTILINE))
    with pytest.raises(DataError, match=r"lack their leading zeros; write 1\d{9}\.0\d{8} for"):
        open_dataset(folder)


def test_decimals_of_any_length_are_no_nanoseconds() -> None:
    texts = ["3.9", "4", "4.05", "4.1", "4.15", "4.2"]
    assert parse_stamps(texts, str).tolist() == [round(float(t) * 1e9) for t in texts]


def test_names_whose_nanoseconds_lack_their_zeros_are_said_to(tmp_path: Path) -> None:
    """Without an IMU they were numbers of frames 0.1 s apart."""
    name = lambda side, k: f"1700000000.{50_000_000 * k + 12_000_000}.png"  # noqa: E731
    folder = make_plain(tmp_path, name=name, times=False, imu=False)
    with pytest.raises(DataError, match=r"lack their leading zeros.*write 1700000000\.012000000"):
        open_dataset(folder)


@pytest.mark.parametrize("separator", [".", "_", "-"])
@pytest.mark.parametrize(("digits", "unit"), [(9, "nanoseconds"), (6, "microseconds")])
def test_counts_behind_seconds_in_names_need_their_zeros(
    digits: int, unit: str, separator: str, tmp_path: Path
) -> None:
    """Names at 15 Hz, of which few end with a zero, and one of three after the second is short."""
    ns = [1700000000_400000000 + 66_666_667 * k for k in range(20)]
    part = lambda t: t % 10**9 // 10 ** (9 - digits)  # noqa: E731
    names = {
        "whole": lambda side, k: f"{ns[k] // 10**9}{separator}{part(ns[k]):0{digits}d}.png",
        "cut": lambda side, k: f"{ns[k] // 10**9}{separator}{part(ns[k])}.png",
    }
    if separator != "." and digits == 6:
        return  # a number of six digits may be a frame's
    whole = make_plain(tmp_path / "whole", 20, name=names["whole"], times=False)
    read = open_dataset(whole).recording.frame_times_ns
    assert read.tolist() == [t // 10 ** (9 - digits) * 10 ** (9 - digits) for t in ns]
    cut = make_plain(tmp_path / "cut", 20, name=names["cut"], times=False, imu=False)
    short = next(t for t in ns if part(t) < 10 ** (digits - 1))
    right = f"{short // 10**9}.{part(short):0{digits}d}"
    with pytest.raises(DataError, match=f"{unit} lack their leading zeros.*write {right} for"):
        open_dataset(cut)


def test_names_of_a_time_and_a_frame_have_no_nanoseconds(tmp_path: Path) -> None:
    """`1700000000_000012`: the number does not belong to the time."""
    name = lambda side, k: f"{1700000000 + k}_{k + 12:06d}.png"  # noqa: E731
    folder = make_plain(tmp_path, name=name, times=False, imu=False)
    assert np.diff(open_dataset(folder).recording.frame_times_ns).tolist() == [10**8] * 3


@pytest.mark.parametrize("separator", [" ", ","])
@pytest.mark.parametrize("digits", ["", "09"])
def test_lists_of_seconds_and_nanoseconds_are_read(
    digits: str, separator: str, tmp_path: Path
) -> None:
    ns = [1700000000_400000000 + 66_666_667 * k for k in range(20)]
    folder = make_plain(tmp_path, 20, imu=False, reference=False)
    lines = [f"{t // 10**9}{separator}{t % 10**9:{digits}}" for t in ns]
    (folder / "times.txt").write_text("\n".join(lines) + "\n")
    assert open_dataset(folder).recording.frame_times_ns.tolist() == ns


@pytest.mark.parametrize("separator", [" ", "  ", "\t", "; "])
def test_decimal_commas_stand_between_any_separators_but_commas(
    separator: str, tmp_path: Path
) -> None:
    values = [[1700000000.25 + 0.005 * k, 0.1, -0.2, 0.3, 0.5, -9.25, 1 + k] for k in range(20)]
    lines = [separator.join(f"{x:.3f}".replace(".", ",") for x in row) for row in values]
    (tmp_path / "imu.csv").write_text("\n".join(lines) + "\n")
    record, _ = read_imu_table(tmp_path / "imu.csv")
    np.testing.assert_array_equal(np.hstack([record.gyro, record.accel]), [v[1:] for v in values])
    assert record.times_ns[1] == 1700000000_255000000
    turned = [[*row[:4], 0.0, 0.0, 0.0, 1.0] for row in values]
    lines = [separator.join(f"{x:.3f}".replace(".", ",") for x in row) for row in turned]
    (tmp_path / "poses.txt").write_text("\n".join(lines) + "\n")
    found = read_trajectory(tmp_path / "poses.txt")
    np.testing.assert_array_equal(found.T_world_body[:, :3, 3], [row[1:4] for row in values])


@pytest.mark.parametrize("head", ["", "type,timestamp,x,y,z\n"])
def test_lines_of_sensors_by_their_names_are_to_be_parted(head: str, tmp_path: Path) -> None:
    lines = [
        f"{name},{START_NS + STEP_NS * k},0.1,0.2,0.3"
        for k in range(20)
        for name in ("GYRO", "ACC")
    ]
    (tmp_path / "imu.csv").write_text(head + "\n".join(lines) + "\n")
    with pytest.raises(DataError, match=r"begins with a word: .* gyro\.csv and accel\.csv"):
        read_imu_table(tmp_path / "imu.csv")


def test_whole_numbers_between_commas_and_spaces_are_no_decimals(tmp_path: Path) -> None:
    lines = [f"{START_NS + STEP_NS * k}, 1, 2, 3, 4, 5, 6" for k in range(20)]
    (tmp_path / "imu.csv").write_text("\n".join(lines) + "\n")
    record, _ = read_imu_table(tmp_path / "imu.csv")
    assert record.times_ns[1] == START_NS + STEP_NS
    assert np.hstack([record.gyro, record.accel])[1].tolist() == [1, 2, 3, 4, 5, 6]


def test_samples_with_readings_of_one_sensor_each_are_joined(tmp_path: Path) -> None:
    """As of a driver that gives two sensors in one form."""
    stamps = 1700000000_000000000 + 2_500_000 * np.arange(400)
    readings = np.column_stack([np.arange(400)] * 6) * 1e-3 + [0.1, 0.2, 0.3, 0.4, 0.5, 9.8]
    readings[1::2, :3] = 0.0
    readings[::2, 3:] = 0.0
    lines = [
        f"{t},{','.join(map(repr, row))}" for t, row in zip(stamps, readings.tolist(), strict=True)
    ]
    file = tmp_path / "imu.csv"
    file.write_text("timestamp [ns],wx,wy,wz,ax,ay,az\n" + "\n".join(lines) + "\n")
    record, notes = read_imu_table(file)
    np.testing.assert_array_equal(record.times_ns, stamps[2::2])
    np.testing.assert_allclose(record.gyro[:, 0], 0.1 + 1e-3 * np.arange(2, 400, 2))
    np.testing.assert_allclose(record.accel[:, 2], 9.8 + 1e-3 * np.arange(2, 400, 2))
    assert any("interpolated at the gyro's stamps" in note for note in notes)


def test_zeros_of_a_sensor_that_fails_are_left_to_the_run() -> None:
    readings = np.column_stack([np.arange(400)] * 6) * 1e-3 + 0.1
    readings[1::3, :3] = 0.0
    assert parted_sensors(readings[:, :3], readings[:, 3:]) is None


def test_names_whose_last_zeros_were_cut_are_times(tmp_path: Path) -> None:
    ns = [1700000000_000000000 + 37_512_000 * k for k in range(6)]
    name = lambda side, k: f"{ns[k] // 10**9}.{ns[k] % 10**9:09d}".rstrip("0") + ".png"  # noqa: E731
    folder = make_plain(tmp_path, 6, name=lambda s, k: name(s, k).replace("..", "."), times=False)
    assert open_dataset(folder).recording.frame_times_ns.tolist() == ns


def _named(folder: Path, name: Callable[[int], str]) -> list[int]:
    made = make_plain(folder, name=lambda _, k: f"{name(k)}.png", times=False)
    return open_dataset(made).recording.frame_times_ns.tolist()


@pytest.mark.parametrize(
    "form",
    [
        "2024-05-12_14-{0}-{1}-{2:03d}000",
        "2024-05-12T14:{0}:{1}.{2:03d}000000Z",
        "20240512_14{0}{1}_{2:03d}",
        "left_2024051214{0}{1}{2:03d}",
        "2024051214{0}{1}{2:03d}000",
    ],
)
def test_names_may_be_dates(form: str, tmp_path: Path) -> None:
    """They were counted at 10 Hz, or read as milliseconds with a leap at each minute."""
    seconds = [59.96, 60.01, 60.06, 60.11]
    name = lambda k: form.format(  # noqa: E731
        f"{3 + int(seconds[k]) // 60:02d}",
        f"{int(seconds[k]) % 60:02d}",
        round(1000 * (seconds[k] % 1)),
    )
    made = make_plain(
        tmp_path, name=lambda _, k: f"{name(k)}.png", times=False, imu=False, reference=False
    )
    times_ns = open_dataset(made).recording.frame_times_ns
    assert np.diff(times_ns).tolist() == [50_000_000] * 3
    assert times_ns[1] == np.datetime64("2024-05-12T14:04:00.010", "ns").astype(np.int64)


def test_a_stamp_behind_the_number_of_the_frame_is_its_time(tmp_path: Path) -> None:
    ns = [1700000000_000000000 + 50_000_000 * k for k in range(4)]
    assert _named(tmp_path, lambda k: f"{k:06d}_{ns[k]}") == ns


def test_a_date_and_a_number_are_no_stamp(tmp_path: Path) -> None:
    made = make_plain(
        tmp_path, name=lambda _, k: f"240512_{10_000_000_000 + k}.png", times=False, imu=False
    )
    assert np.diff(open_dataset(made).recording.frame_times_ns).tolist() == [100_000_000] * 3


def test_lists_of_times_may_be_dates_of_iso_8601(tmp_path: Path) -> None:
    folder = make_plain(tmp_path, imu=False)
    lines = [f"2023-11-14T22:13:20.{50 * k:03d}Z" for k in range(4)]
    (folder / "times.txt").write_text("\n".join(lines) + "\n")
    times_ns = open_dataset(folder).recording.frame_times_ns
    assert times_ns.tolist() == [1700000000_000000000 + 50_000_000 * k for k in range(4)]


@pytest.mark.parametrize(("first", "doubted"), [(97, True), (90, False)])
def test_a_counter_that_began_again_is_doubted(first: int, doubted: bool, tmp_path: Path) -> None:
    """Images 97, 98, 99, 00, 01 … in the order of their numbers begin with 00."""
    folder = make_plain(
        tmp_path, 6, name=lambda _, k: f"img{(first + k) % 100:02d}.png", times=False, imu=False
    )
    doubts = [note for note in open_dataset(folder).recording.notes if "doubtful" in note]
    assert len(doubts) == doubted
    assert all("img97.png is the first image" in doubt for doubt in doubts)


def _sharing(share: float, jitter_ns: int, run: int = 1) -> list[str]:
    """Lines of which some have the time of the one above: `run` each, a share of all."""
    rng = np.random.default_rng(1)
    rows = [line.split(",") for line in _lines()]
    for k, row in enumerate(rows):
        row[0] = str(int(row[0]) + int(rng.integers(0, jitter_ns + 1)))
        if k and k % round(1 / share) < run:
            row[0] = rows[k - 1][0]
    return [",".join(row) for row in rows]


def test_other_readings_at_the_time_of_the_line_above_are_left_out(tmp_path: Path) -> None:
    """As drivers stamp gyro and accelerometer that they join."""
    lines = _sharing(0.2, 1000)
    times, _, notes = _read(tmp_path, lines)
    assert times == sorted({int(line.split(",")[0]) for line in lines})
    assert any("79 of 400 lines have the time of the one above" in note for note in notes)


@pytest.mark.parametrize(
    "lines",
    [_sharing(0.2, 0), _sharing(0.5, 1000), _sharing(0.2, 1000, run=2)],
    ids=["rounded", "every second one", "in a row"],
)
def test_times_that_may_be_rounded_or_of_a_clock_that_stood_are_refused(
    lines: list[str], tmp_path: Path
) -> None:
    with pytest.raises(DataError, match="the clock repeats"):
        _read(tmp_path, lines)
