"""What a header or a list states of stamps and readings goes before any guess; a guess names both
readings.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.plain_maker import make_plain
from vio.datasets import open_dataset
from vio.datasets.tables import read_imu_table
from vio.errors import DataError
from vio.files.stamps import FRAME_PACE, SAMPLE_PACE, parse_stamps
from vio.files.units import ACCEL_UNITS, GYRO_UNITS, factor_of, time_unit, without_unit
from vio.records import ImuSample

DEG = np.pi / 180
G = 9.80665


@pytest.mark.parametrize(
    ("cell", "factor"),
    [
        *((f"wx [{unit}]", 1.0) for unit in ("rad/s", "rad s^-1", "rad·s⁻¹", "rad/sec", "rad s-1")),
        *((f"gyro_x_{unit}", 1.0) for unit in ("radps", "rads", "rad_s", "rad/s")),
        *((f"wx ({unit})", DEG) for unit in ("deg/s", "°/s", "º/s", "dps", "deg s^-1", "deg/sec")),
        *((f"gyr_x_{unit}", DEG) for unit in ("dps", "degps", "deg_s", "deg/s", "DPS")),
        ("Gyroscope X [degrees per second]", DEG),
        ("gyro_dps_x", DEG),
        ("wx [mdps]", 1e-3 * DEG),
        ("gyro_x_mdps", 1e-3 * DEG),
        ("wx [mrad/s]", 1e-3),
        ("wx [deg/h]", DEG / 3600),
        ("gx", None),
        ("w_RS_S_x", None),
    ],
)
def test_units_of_a_gyro(cell: str, factor: float | None) -> None:
    assert factor_of(cell, GYRO_UNITS) == (None if factor is None else pytest.approx(factor))


@pytest.mark.parametrize(
    ("cell", "factor"),
    [
        *((f"ax [{unit}]", 1.0) for unit in ("m/s^2", "m s^-2", "m/s²", "m·s⁻²", "m/s/s", "m/s2")),
        *((f"acc_x_{unit}", 1.0) for unit in ("mps2", "ms2", "m_s2", "m/s^2")),
        *((cell, G) for cell in ("ax [g]", "ax (G)", "accel_x_g", "AccX/g", "acc_g_x")),
        *((cell, 1e-3 * G) for cell in ("ax [mg]", "acc_x_mg", "ax(mg)", "ax [milli-g]")),
        ("ax [cm/s^2]", 1e-2),
        ("ax [m/(s^2)]", 1.0),
        ("accel_x", None),
    ],
)
def test_units_of_an_accelerometer(cell: str, factor: float | None) -> None:
    assert factor_of(cell, ACCEL_UNITS) == (None if factor is None else pytest.approx(factor))
    assert "x" in without_unit(cell)


def test_units_of_a_time() -> None:
    spellings = {
        "ns": ("#timestamp [ns]", "time_ns", "nanoseconds", "stamp.nsec", "t[ns]"),
        "us": ("time [us]", "t (µs)", "timestamp_usec", "microseconds"),
        "ms": ("Time(ms)", "time_msec", "milliseconds"),
        "s": ("timestamp(s)", "time [sec]", "time_s", "% time (seconds)"),
    }
    for unit, cells in spellings.items():
        assert {time_unit(cell) for cell in cells} == {unit}
    assert {time_unit(cell) for cell in ("timestamp", "timestamps", "stamps", "t", "s")} == {None}


def _imu_file(folder: Path, header: str, separator: str = ",") -> Path:
    """Write 5 readings: gyro 18, 36, 54 and accelerometer 0, 0, 1 in the header's units."""
    rows = [
        separator.join(map(str, (1_700_000_000_000_000_000 + 5_000_000 * k, 18, 36, 54, 0, 0, 1)))
        for k in range(5)
    ]
    file = folder / "imu.csv"
    file.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return file


@pytest.mark.parametrize(
    "header",
    [
        "time_ns,gyr_x_dps,gyr_y_dps,gyr_z_dps,acc_x_g,acc_y_g,acc_z_g",
        "t,gx [°/s],gy [°/s],gz [°/s],ax [g],ay [g],az [g]",
        "# t [ns]  gx [deg/s] gy [deg/s] gz [deg/s] ax [g] ay [g] az [g]",
        "time;gx;gy;gz;ax;ay;az\n[ns];[deg/s];[deg/s];[deg/s];[g];[g];[g]",
        "# gyro in deg/s, accelerometer in g\n# t,gx,gy,gz,ax,ay,az",
        "time\tGyro X (deg/s)\tGyro Y (deg/s)\tGyro Z (deg/s)\tAcc X (g)\tAcc Y (g)\tAcc Z (g)",
    ],
)
def test_an_imu_is_converted_as_its_header_states(header: str, tmp_path: Path) -> None:
    names = header.splitlines()[-1]
    separator = "," if "," in names else ";" if ";" in names else "\t" if "\t" in names else " "
    record, notes = read_imu_table(_imu_file(tmp_path, header, separator))
    np.testing.assert_allclose(np.degrees(record.gyro[0]), [18, 36, 54])
    np.testing.assert_allclose(record.accel[0], [0, 0, G])
    assert ["gyro" in note for note in notes] == [True, False]


def test_signs_of_units_in_latin_1_are_read(tmp_path: Path) -> None:
    file = _imu_file(tmp_path, "t,gx [°/s],gy [°/s],gz [°/s],ax [m/s²],ay [m/s²],az [m/s²]")
    file.write_bytes(file.read_text(encoding="utf-8").encode("latin-1"))
    record, _ = read_imu_table(file)
    np.testing.assert_allclose(np.degrees(record.gyro[0]), [18, 36, 54])


def test_named_columns_are_found_among_others(tmp_path: Path) -> None:
    header = "timestamp [ns],temperature,ax_g,ay_g,az_g,gx_dps,gy_dps,gz_dps,mag_x,mag_y,mag_z"
    row = "1700000000000000000,31,0,0,1,18,36,54,0.1,0.2,0.3"
    (tmp_path / "imu.csv").write_text(f"{header}\n{row}\n")
    record, _ = read_imu_table(tmp_path / "imu.csv")
    np.testing.assert_allclose(np.degrees(record.gyro[0]), [18, 36, 54])
    np.testing.assert_allclose(record.accel[0], [0, 0, G])


def test_an_unknown_or_a_double_unit_is_named(tmp_path: Path) -> None:
    file = _imu_file(tmp_path, "t,gx [LSB],gy [LSB],gz [LSB],ax,ay,az")
    assert "the unit 'lsb' of the gyro is not known" in read_imu_table(file)[1][0]
    file = _imu_file(tmp_path, "t,gx [deg/s],gy [rad/s],gz [rad/s],ax,ay,az")
    with pytest.raises(DataError, match="several units of the gyro"):
        read_imu_table(file)


def test_a_sensor_that_was_not_recorded_is_named(tmp_path: Path) -> None:
    rows = "".join(f"{1_700_000_000_000_000_000 + 5_000_000 * k},0,0,0,0,0,9.8\n" for k in range(9))
    (tmp_path / "imu.csv").write_text(rows)
    assert "the gyro is 0 in all 9 samples" in read_imu_table(tmp_path / "imu.csv")[1][0]


# --- stamps


@pytest.mark.parametrize("start", [0, 9_000, 1_700_000_000])
@pytest.mark.parametrize(("unit", "power"), [("ms", 3), ("us", 6), ("ns", 9)])
def test_stamps_from_any_zero_are_read_by_how_far_apart_they_are(
    start: int, unit: str, power: int
) -> None:
    seconds = start + 0.05 * np.arange(20)
    texts = [str(round(second * 10**power)) for second in seconds]
    doubts: list[str] = []
    times = parse_stamps(texts, str, pace=FRAME_PACE, doubts=doubts)
    np.testing.assert_allclose(np.diff(times) * 1e-9, 0.05, atol=2e-6)
    assert times[0] == start * 10**9
    by_size = start > 10**9
    assert len(doubts) == (0 if by_size else 1)
    assert by_size or "if that is wrong, state the unit in a header" in doubts[0]


def test_bursts_and_pauses_do_not_change_the_unit_of_stamps() -> None:
    burst = [f"{second + 1e-6 * k:.6f}" for second in range(9) for k in range(200)]
    doubts: list[str] = []
    times = parse_stamps(burst, str, pace=SAMPLE_PACE, doubts=doubts)
    assert (times[200], doubts) == (10**9, [])
    pause = [str(t) for t in (*range(5), 4000)]
    assert parse_stamps(pause, str, pace=FRAME_PACE, doubts=doubts)[-1] == 4000 * 10**9
    assert doubts == []


@pytest.mark.parametrize(
    "text",
    ["# time [ms]\n{}", "time_ms\n{}", "# times in milliseconds\n{}", "# frame, time (ms)\n{}"],
)
def test_a_list_of_times_states_its_unit(text: str, tmp_path: Path) -> None:
    folder = make_plain(tmp_path, times=False, imu=False, reference=False)
    (folder / "times.txt").write_text(text.format("0\n10000\n20000\n30000\n"))
    times = open_dataset(folder).recording.frame_times_ns
    assert times.tolist() == [0, 10**10, 2 * 10**10, 3 * 10**10]


@pytest.mark.parametrize("boot_s", [90, 9_000, 90_000, 900_000])
@pytest.mark.parametrize("listed", [False, True])
def test_names_in_nanoseconds_since_boot(boot_s: int, listed: bool, tmp_path: Path) -> None:
    boot_ns = boot_s * 10**9
    folder = make_plain(
        tmp_path,
        folders=("mav0/cam0/data", "mav0/cam1/data"),
        name=lambda side, k: f"{boot_ns + 50_000_000 * k}.png",
        times=False,
        imu=False,
        reference=False,
    )
    if listed:
        for camera in ("cam0", "cam1"):
            rows = [f"{boot_ns + 50_000_000 * k},{boot_ns + 50_000_000 * k}.png" for k in range(4)]
            text = "\n".join(["#timestamp [ns],filename", *rows])
            (folder / "mav0" / camera / "data.csv").write_text(f"{text}\n")
    recording = open_dataset(folder).recording
    assert recording.frame_times_ns.tolist() == [boot_ns + 50_000_000 * k for k in range(4)]
    assert len(recording.notes) == (0 if listed else 1)
    assert listed or "taken for nanoseconds" in recording.notes[0]


def test_the_times_of_a_list_go_before_the_names(tmp_path: Path) -> None:
    folder = make_plain(
        tmp_path,
        folders=("mav0/cam0/data", "mav0/cam1/data"),
        name=lambda side, k: f"{1_400_000_000_000_000_000 + k}.png",
        times=False,
        imu=False,
        reference=False,
    )
    rows = [f"{1_500_000_000 + 0.05 * k:.2f},{1_400_000_000_000_000_000 + k}.png" for k in range(4)]
    text = "\n".join(["#timestamp [s],filename", *rows])
    (folder / "mav0" / "cam0" / "data.csv").write_text(f"{text}\n")
    times = open_dataset(folder).recording.frame_times_ns
    assert times.tolist() == [1_500_000_000_000_000_000 + 50_000_000 * k for k in range(4)]


NAMES = {
    "seconds, zeros cut": lambda side, k: f"{(1700000000.95 + 0.05 * k):.2f}".rstrip("0").rstrip(
        "."
    ),
    "right 0.4 ms later": lambda side, k: f"{1700000000 + 0.05 * k + 0.0004 * side:.6f}",
    "right 0.4 ms later, ms": lambda side, k: f"{1700000000000 + 50 * k}",
    "number, then camera": lambda side, k: f"{k:06d}_cam{side}",
    "camera, then stamp": lambda side, k: f"cam{side}_{1700000000_000000000 + 50_000_000 * k}",
    "stamp, then side": lambda side, k: (
        f"{1700000000_000000000 + 50_000_000 * k}_{('left', 'right')[side]}"
    ),
}


@pytest.mark.parametrize("form", NAMES)
def test_pairs_of_names_as_people_have_them(form: str, tmp_path: Path) -> None:
    def name(side: int, k: int) -> str:
        return f"{NAMES[form](side, k)}.png"

    folder = make_plain(tmp_path, 12, name=name, times=False, imu=False, reference=False)
    recording = open_dataset(folder).recording
    steps = np.diff(recording.frame_times_ns)
    assert len(recording.frame_times_ns) == 12
    np.testing.assert_allclose(steps * 1e-9, 0.1 if "number" in form else 0.05, atol=1e-6)


def test_real_readings_in_degrees_and_g_are_those_of_the_published_record(
    data_dir: Path, tmp_path: Path
) -> None:
    """EuRoC MH_01's, in the units that many loggers write; 20 frames turn by 0.22 rad/s (median)."""
    mav = data_dir / "euroc" / "MH_01_head" / "mav0"
    table = np.loadtxt(mav / "imu0" / "data.csv", delimiter=",", skiprows=1)
    stamps_ns = np.loadtxt(
        mav / "imu0" / "data.csv", delimiter=",", skiprows=1, usecols=0, dtype=np.int64
    )
    gyro = table[:, 1:4]
    accel = table[:, 4:7]
    header = "time_ns,acc_x_g,acc_y_g,acc_z_g,gyr_x_dps,gyr_y_dps,gyr_z_dps"
    values = np.hstack([accel / G, gyro / DEG])
    rows = [
        ",".join([str(t), *map(repr, row)])
        for t, row in zip(stamps_ns.tolist(), values.tolist(), strict=True)
    ]
    file = tmp_path / "imu.csv"
    file.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    record, _ = read_imu_table(file)
    np.testing.assert_allclose(record.gyro, gyro, atol=1e-12)
    np.testing.assert_allclose(record.accel, accel, atol=1e-12)
    frames = sorted(int(path.stem) for path in (mav / "cam0" / "data").glob("*.png"))
    shown = (record.times_ns >= frames[0]) & (record.times_ns <= frames[20])
    assert np.median(np.linalg.norm(record.gyro[shown], axis=1)) == pytest.approx(0.2205, abs=2e-3)


@pytest.mark.parametrize("names", [("gyro.csv", "accel.csv"), ("gyroscope.txt", "acc.csv")])
def test_a_gyro_and_an_accelerometer_in_two_files_are_joined(
    names: tuple[str, str], tmp_path: Path
) -> None:
    """The accelerometer has half of the rate, an offset of 1 ms, g and another order of axes."""
    folder = make_plain(tmp_path, 8)
    whole = read_imu_table(folder / "imu.csv")[0]
    (folder / "imu.csv").unlink()
    gyro = [f"{t},{x},{y},{z}" for t, (x, y, z) in zip(whole.times_ns, whole.gyro, strict=True)]
    slow = slice(0, None, 2)
    accel = [
        f"{t + 1_000_000},{z / G},{x / G},{y / G}"
        for t, (x, y, z) in zip(whole.times_ns[slow], whole.accel[slow], strict=True)
    ]
    (folder / names[0]).write_text("\n".join(["timestamp [ns],wx,wy,wz", *gyro]) + "\n")
    (folder / names[1]).write_text("\n".join(["timestamp [ns],az [g],ax,ay", *accel]) + "\n")
    dataset = open_dataset(folder)
    assert dataset.recording.motion == {"imu"}
    assert any("are joined" in note for note in dataset.recording.notes)
    samples = [e for e in dataset.events() if isinstance(e, ImuSample)]
    assert len(samples) > len(whole.times_ns) - 4
    for sample in samples:
        k = int(np.flatnonzero(whole.times_ns == sample.time_ns)[0])
        np.testing.assert_allclose(sample.gyro, whole.gyro[k])
        np.testing.assert_allclose(sample.accel[:2], whole.accel[k, :2], atol=1e-9)
        assert sample.accel[2] == pytest.approx(
            whole.accel[k, 2] + 0.2, abs=1e-6
        )  # falls by 1 in 5 ms


def test_a_gyro_and_an_accelerometer_of_other_times_are_refused(tmp_path: Path) -> None:
    folder = make_plain(tmp_path)
    (folder / "imu.csv").unlink()
    for name, first in (("gyro", 0), ("accel", 10**11)):
        rows = [f"{first + k * 5_000_000},0.1,0.2,0.3" for k in range(50)]
        (folder / f"{name}.csv").write_text("\n".join(["timestamp [ns],x,y,z", *rows]) + "\n")
    with pytest.raises(DataError, match="none of its times lies between"):
        open_dataset(folder)
