"""`vio imu-noise`: the noise of an IMU from a record at rest."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vio.cli.output import print_result
from vio.errors import DataError

if TYPE_CHECKING:
    from vio.targets.noise import AxisNoise, ImuNoise


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "imu-noise",
        help="measure the noise of an IMU from a record at rest",
        description="Compute the overlapping Allan deviation of an IMU's record at rest (an hour "
        "or more; five minutes at least): white noise, bias instability and random walk with "
        "intervals of 95 %, a plot, and Kalibr's imu.yaml for use while moving.",
    )
    parser.add_argument("imu", type=Path, metavar="FILE", help="imu.csv: time, gyro, accelerometer")
    parser.add_argument(
        "--out", type=Path, default=Path("imu.yaml"), metavar="FILE", help="(default imu.yaml)"
    )
    parser.add_argument("--plot", type=Path, metavar="PNG", help="draw the Allan deviations")
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def execute(args: argparse.Namespace) -> int:
    from dataclasses import asdict

    from vio.datasets.tables import read_imu_table
    from vio.datasets.yaml_files import densities_text
    from vio.files.atomic import atomic_write_text, check_writable
    from vio.records import ImuDensities
    from vio.targets.noise import MOVING_FACTOR, measure_noise

    if args.imu.is_dir():
        tables = (args.imu / name for name in ("mav0/imu0/data.csv", "imu.csv"))
        there = next((str(table) for table in tables if table.is_file()), "its imu.csv")
        raise DataError(f"{args.imu}: is a folder; give the table of IMU samples: {there}")
    check_writable(args.out)
    record, notes = read_imu_table(args.imu)
    noise = measure_noise(record)
    notes += noise.notes
    at_rest = noise.densities
    moving = ImuDensities(
        MOVING_FACTOR * at_rest.gyro,
        MOVING_FACTOR * at_rest.gyro_walk,
        MOVING_FACTOR * at_rest.accel,
        MOVING_FACTOR * at_rest.accel_walk,
    )
    words = f"# by vio imu-noise: {MOVING_FACTOR:g} times what {args.imu.name} shows at rest\n"
    atomic_write_text(args.out, words + densities_text(moving, units=True))
    if args.plot is not None:
        _draw(noise, args.plot)
    facts = {
        "gyro": asdict(noise.gyro),
        "accel": asdict(noise.accel),
        "moving_factor": MOVING_FACTOR,
        "out": str(args.out),
        "notes": list(notes),
    }
    rows = [
        *_rows("gyro", noise.gyro, "rad/s"),
        *_rows("accel", noise.accel, "m/s^2"),
        *(("note", note) for note in notes),
        ("written", f"{args.out}: {MOVING_FACTOR:g} times as much, for use while moving"),
    ]
    return print_result(facts, rows, as_json=args.json, name_width=20)


def _rows(name: str, noise: AxisNoise, unit: str) -> list[tuple[str, str]]:
    rows = []
    for what, density, its_unit in (
        ("white", noise.white, f"{unit}/sqrt(Hz)"),
        ("instability", noise.instability, unit),
        ("walk", noise.walk, f"{unit}/s/sqrt(Hz)"),
    ):
        text = f"{density.value:.3e} ({density.low:.3e} to {density.high:.3e}) {its_unit}"
        if what == "walk" and noise.walk_is_bound:
            text += ", at most: a longer record would show it"
        rows.append((f"{name} {what}", text))
    return rows


def _draw(noise: ImuNoise, path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2)
    for k, (title, unit) in enumerate((("gyroscope", "rad/s"), ("accelerometer", "m/s^2"))):
        for axis, curve in zip("xyz", noise.curves[3 * k : 3 * k + 3], strict=True):
            axes[k].loglog(curve.tau_s, curve.deviation, label=axis)
        axes[k].set_title(f"{title}: Allan deviation, {unit}")
        axes[k].set_xlabel("averaging time, s")
        axes[k].grid(True, which="both", alpha=0.3)
        axes[k].legend()
    figure.savefig(path, dpi=100)
