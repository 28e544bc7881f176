"""`vio georeference`: place a run or a map on the earth."""

from __future__ import annotations

import argparse
import logging
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vio.cli.output import print_result
from vio.errors import NOTE, ConfigError, DataError
from vio.files.printable import json_text

if TYPE_CHECKING:
    from vio.geometry.lie import FloatArray

_LONG_ARM_M = 20.0  # of an antenna on a vehicle, beyond which its unit is doubted


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "georeference",
        help="place a run or a map on the earth by GNSS positions",
        description="Fuse a finished run, or the keyframes of a map, with GNSS positions as robust "
        "factors: "
        "earth.json with T_enu_map and its covariance, the path in east, north, up, and path and "
        "landmarks as GeoJSON, "
        "KML and in UTM. A run stays as it is. A map keeps T_enu_map, which places runs that were "
        "localised in it.",
    )
    parser.add_argument(
        "path", type=Path, metavar="RUN|MAP", help="a run's folder, or a map's file"
    )
    parser.add_argument(
        "gnss",
        type=Path,
        metavar="GNSS",
        help="a table (time, latitude, longitude, height, and where known the standard deviations "
        "east, north, up), a "
        "KITTI raw drive with oxts, a ROS bag with NavSatFix, or the map of a run, once that is "
        "placed",
    )
    parser.add_argument(
        "--lever-arm",
        default="0,0,0",
        metavar="X,Y,Z",
        help="the antenna in the body frame of the run (IMU or left camera), or in the left camera "
        "of a map, in metres "
        "(--lever-arm=-0.1,0,0.3)",
    )
    parser.add_argument(
        "--time-offset", type=float, default=0.0, metavar="S", help="added to the positions' times"
    )
    parser.add_argument("--topic", metavar="T", help="of a bag with several topics of NavSatFix")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder to write (default RUN/earth or MAP.earth)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def execute(args: argparse.Namespace) -> int:
    from vio.datasets.gnss import read_gnss
    from vio.files.atomic import atomic_folder
    from vio.mapping.map_store import is_map
    from vio.numerics.threads import one_blas_thread
    from vio.offline.georeference import FACTS, keep_in_map, place_by_map, place_on_earth, placed

    lever_arm_m = _lever_arm(args.lever_arm)
    if not math.isfinite(args.time_offset) or abs(args.time_offset) > 4e9:
        raise ConfigError(f"--time-offset takes seconds, got {args.time_offset:g}")
    if args.path.is_file() and not is_map(args.path):
        raise DataError(
            f"{args.path}: is neither the folder of a run nor a map; that comes first, then the GNSS "
            "positions"
        )
    of = placed(args.path)
    if is_map(args.gnss):
        fixes = None
    else:
        fixes = read_gnss(args.gnss, args.topic)
    for note in () if fixes is None else fixes.notes:
        logging.getLogger(__name__).log(NOTE, "%s", note)
    is_run = args.path.is_dir()
    out = args.out or _usual_folder(args.path)
    with one_blas_thread(), atomic_folder(out, replace=True, marker=FACTS) as folder:
        facts = {"out": str(out), "of": str(args.path), "gnss": str(args.gnss)}
        if fixes is None:
            facts |= place_by_map(of, args.path, args.gnss, folder)
        else:
            facts |= place_on_earth(of, fixes, lever_arm_m, args.time_offset, folder)
        (folder / FACTS).write_text(json_text(facts, indent=2) + "\n", encoding="utf-8")
    if fixes is not None and not is_run:
        keep_in_map(args.path, facts)
    return print_result(facts, _rows(facts), as_json=args.json)


def _lever_arm(text: str) -> FloatArray:
    """Return the position (3,) of the antenna in the body frame in metres.

    Raises:
        ConfigError: the text is no three numbers, or they are too large.
    """
    import numpy as np

    try:
        lever_arm_m = np.array([float(word) for word in text.split(",")])
    except ValueError:
        lever_arm_m = np.zeros(0)
    if lever_arm_m.shape != (3,) or not (np.abs(lever_arm_m) < 1e3).all():
        raise ConfigError(
            f"--lever-arm takes three numbers in metres such as 0.1,0,-0.5, got {text}"
        )
    length_m = float(np.linalg.norm(lever_arm_m))
    if length_m > _LONG_ARM_M:
        logging.getLogger(__name__).warning(
            "the lever arm is %.4g m long, longer than a vehicle; --lever-arm takes metres",
            length_m,
        )
    return lever_arm_m


def _usual_folder(path: Path) -> Path:
    """Return the folder of the results: in a run's folder, or beside a map."""
    if path.is_dir():
        return path / "earth"
    return path.with_name(f"{path.name}.earth")


def _rows(f: dict[str, Any]) -> list[tuple[str, str]]:
    """Return where it is as table rows."""
    origin = f["origin"]
    doubtful = "; drive farther, with a turn" if f["heading_sigma_deg"] > 5 else ""
    rows = [
        ("folder", f["out"]),
        (
            "origin",
            f"{origin['latitude_deg']:.7f}, {origin['longitude_deg']:.7f}, "
            f"{origin['height_m']:.2f} m (WGS84)",
        ),
        (
            "heading",
            f"{f['heading_deg']:+.2f} ± {f['heading_sigma_deg']:.2f} deg from east to the map's "
            f"x{doubtful}",
        ),
        ("UTM", f["crs"]),
    ]
    if "positions" not in f:  # by the map that the run is in
        return rows
    return [
        *rows,
        ("GNSS", f"{f['positions_used']} of {f['positions_inside']} positions used, "
                 f"{f['heights_used']} heights; "
                 f"residuals {f['residual_median_m']:.2f} m (median), {f['residual_90_m']:.2f} m "
                 "(90 %)"),
        ("scale", f"{100 * (f['scale'] - 1):+.2f} ± {100 * f['scale_sigma']:.2f} % by which the "
                  "path was too short"),
        ("path", f"known to {f['sigma_horizontal_m']:.2f} m, {f['sigma_up_m']:.2f} m in height; "
                 f"{f['bent_rms_m']:.2f} m from the map moved as a whole"),
    ]  # fmt: skip
