"""`vio calibrate`: measure and check a recording's calibration."""

from __future__ import annotations

import argparse
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from vio.cli.output import ProgressBar, print_result
from vio.errors import ConfigError
from vio.files.printable import json_text

if TYPE_CHECKING:
    from collections.abc import Callable

    from vio.calibration.findings import NotObservable
    from vio.calibration.inertial import ImuAlignment
    from vio.calibration.intrinsics import Intrinsics
    from vio.calibration.lever_arm import LeverArm
    from vio.calibration.stereo import RowResiduals, StereoEstimate
    from vio.offline.calibrate import CalibrationReport
    from vio.offline.self_calibration import SelfCalibration
    from vio.protocols import Dataset, Frontend

MARKER = "calibration.json"
_PAIRS = 30
_FRAMES = 1200
_Rows: TypeAlias = list[tuple[str, str]]
_Part = TypeVar("_Part")


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "calibrate",
        help="measure and check a calibration",
        description="Measure from a recording itself: left-right rotation and baseline direction "
        "(the length is taken "
        "as given), IMU-camera rotation, time offset and lever arm where the motion makes them "
        "observable; compare "
        "with the given calibration and report its faults; focal length and principal point, too, "
        "where the cameras "
        "turn. Writes a Kalibr-style and EuRoC-style YAML, which --calibration of `vio run` takes. "
        "The length of the "
        "baseline is taken as given.",
    )
    parser.add_argument(
        "source", metavar="SOURCE", help="a recording: folder or file, or kind:path"
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder for report and YAML (default calibrations/NAME)",
    )
    parser.add_argument(
        "--pairs",
        type=int,
        default=_PAIRS,
        metavar="N",
        help=f"stereo pairs matched (default {_PAIRS})",
    )
    parser.add_argument(
        "--frames",
        type=int,
        default=_FRAMES,
        metavar="N",
        help=f"frames tracked for the IMU (default {_FRAMES})",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def execute(args: argparse.Namespace) -> int:
    from vio.cli.running import free_folder
    from vio.files.atomic import atomic_folder, check_replaceable, check_writable
    from vio.numerics.threads import one_blas_thread
    from vio.offline.calibrate import measure
    from vio.offline.calibration_files import CAMCHAIN, write_calibration_report
    from vio.offline.colmap import quiet
    from vio.offline.source import open_source

    if args.pairs < 1 or args.frames < 2:
        raise ConfigError("--pairs must be at least 1 and --frames at least 2")
    quiet()
    source = open_source(args.source)
    out = args.out or free_folder(source.path, Path("calibrations"))
    check_replaceable(out.absolute(), replace=True, marker=MARKER)
    check_writable(out)
    with one_blas_thread(), ProgressBar(f"calibrate {source.path.name}") as bar:
        report = measure(
            source,
            _frontend,
            pairs=args.pairs,
            frames=args.frames,
            begin=lambda part: bar.begin(f"calibrate {source.path.name}: {part}"),
            progress=bar.update,
        )
    facts = {"out": str(out), **_facts(report)}
    with atomic_folder(out, replace=True, marker=MARKER) as folder:
        write_calibration_report(folder, report)
        (folder / MARKER).write_text(json_text(facts, indent=2) + "\n", encoding="utf-8")
        written = (folder / CAMCHAIN).is_file()
    rows = [*_rows(report), ("results", str(out))]
    if written:
        rows.append(
            (
                "next",
                f"vio run {shlex.quote(args.source)} --calibration "
                f"{shlex.quote(str(out / CAMCHAIN))}",
            )
        )
    return print_result(facts, rows, as_json=args.json, name_width=22)


def _frontend(dataset: Dataset) -> Frontend:
    """Return the default front end."""
    from vio.frontend import FrontendSettings, build_frontend
    from vio.guard.guarded import guarded

    camera = dataset.recording.camera
    return guarded(build_frontend("auto", camera, FrontendSettings(), dataset), camera)


def _facts(report: CalibrationReport) -> dict[str, Any]:
    return {
        "source": str(report.source.path),
        "stereo": _plain(report.stereo),
        "rows": _plain(report.rows),
        "intrinsics": _plain(report.intrinsics),
        "in_motion": None if report.in_motion is None else _parameters(report.in_motion),
        "imu": _plain(report.imu.alignment),
        "lever_arm": _plain(report.imu.lever_arm),
        "grade": None if report.stereo_error is None else report.stereo_error.grade,
        "findings": [{"fault": f.fault, "detail": f.detail} for f in report.findings],
        "notes": list(report.notes),
    }


def _plain(record: Any) -> dict[str, Any]:
    """Return a result as plain JSON types, which have no NaN."""
    import numpy as np

    from vio.calibration.findings import NotObservable

    if isinstance(record, NotObservable):
        return {"verdict": str(record)}
    none = np.array(None)
    return {
        key: np.where(np.isfinite(v), v.astype(object), none).tolist()
        if isinstance(v, np.ndarray)
        else v
        for key, v in asdict(record).items()
    }


def _parameters(found: SelfCalibration) -> dict[str, Any]:
    """Return the results of a bundle adjustment on the calibration, by name."""
    from vio.offline.self_calibration import NAMES

    rows = zip(NAMES, found.values.tolist(), found.sigmas.tolist(), strict=True)
    return {
        "off": {name: {"value": value, "sigma": sigma} for name, value, sigma in rows},
        "segments": found.segments,
        "points": found.points,
        "residual_px": found.residual_px,
    }


def _rows(report: CalibrationReport) -> list[tuple[str, str]]:
    rows = _observed("left and right", report.stereo, _stereo_rows)
    rows += _observed("rows", report.rows, _alignment_rows)
    rows += _observed("intrinsics", report.intrinsics, _intrinsics_rows)
    rows += _observed("IMU", report.imu.alignment, _imu_rows)
    rows += _observed("lever arm", report.imu.lever_arm, _lever_arm_rows)
    rows += [("note", note) for note in report.notes]
    rows.append(("not checked", "; ".join(_unchecked(report))))
    rows += [("FOUND", str(finding)) for finding in report.findings]
    off = report.stereo_error
    if off is None:
        return (
            rows
            if report.findings
            else [*rows, ("verdict", "no fault found in what could be observed")]
        )
    return [*rows, ("verdict", str(off))]


def _observed(name: str, found: _Part | NotObservable, rows: Callable[[_Part], _Rows]) -> _Rows:
    """Return the rows of a part of the calibration, or why it was not observable."""
    from vio.calibration.findings import NotObservable

    if isinstance(found, NotObservable):
        return [(name, str(found))]
    return rows(found)


def _intrinsics_rows(found: Intrinsics) -> _Rows:
    (u, v) = found.centre_off_px
    (su, sv) = found.centre_sigma_px
    off = 100 * found.focal_off
    sigma = 100 * found.focal_sigma
    return [
        ("focal length", f"off by {off:+.1f} %, sigma {sigma:.1f} (given {found.focal_px:.1f} px)"),
        ("principal point", f"off by {u:+.1f} {v:+.1f} px, sigma {su:.1f} {sv:.1f}"),
    ]


def _unchecked(report: CalibrationReport) -> list[str]:
    """Return what the report does not cover."""
    from vio.calibration.findings import NotObservable

    out = ["the length of the baseline"]
    parts = {
        "left and right": report.stereo,
        "focal length and principal point": report.intrinsics,
        "IMU-camera rotation and clocks": report.imu.alignment,
        "lever arm": report.imu.lever_arm,
    }
    out += [name for name, part in parts.items() if isinstance(part, NotObservable)]
    if report.in_motion is None:
        out.append("lens distortion")
    return [*out, "cameras exposed at different times"]


def _stereo_rows(stereo: StereoEstimate) -> _Rows:
    import numpy as np

    from vio.geometry.lie import so3_log

    x, y, z = np.degrees(so3_log(stereo.R_cam1_cam0))
    (u, v, w) = stereo.direction
    sigmas = stereo.rotation_sigmas_deg
    sigma = f"{stereo.rotation_sigma_deg:.4f}"
    if sigmas is not None:
        sigma = " ".join(f"{each:.4f}" for each in sigmas)
    return [
        (
            "left-right rotation",
            f"{x:+.4f} {y:+.4f} {z:+.4f} deg (cam0 to cam1), sigma {sigma}",
        ),
        (
            "baseline direction",
            f"{u:+.5f} {v:+.5f} {w:+.5f} in cam0, sigma {stereo.direction_sigma_deg:.3f} deg",
        ),
        (
            "matches",
            f"{stereo.matches} in {stereo.pairs} pairs, epipolar spread "
            f"{60 * stereo.residual_deg:.2f} arcmin",
        ),
    ]


def _alignment_rows(r: RowResiduals) -> _Rows:
    import numpy as np

    summary = (
        f"median {r.median_px:+.3f} px, spread {r.spread_px:.3f} px; "
        f"{100 * r.positive_disparity:.1f} % of "
        f"{r.matches} matches have a positive disparity"
    )
    grid = (
        " ".join("    –  " if np.isnan(c) else f"{c:+7.3f}" for c in line) for line in r.grid_px
    )
    return [("rows vl - vr", summary), *(("  over the image", line) for line in grid)]


def _imu_rows(a: ImuAlignment) -> _Rows:
    import numpy as np

    from vio.geometry.lie import so3_log

    x, y, z = np.degrees(so3_log(a.R_cam0_imu))
    p, q, r = a.rotation_sigma_deg
    rows = [
        (
            "IMU-camera rotation",
            f"{x:+.3f} {y:+.3f} {z:+.3f} deg (IMU to cam0), sigma {p:.3f} {q:.3f} {r:.3f}",
        ),
        (
            "IMU minus camera clock",
            f"{1e3 * a.time_offset_s:+.2f} ms, sigma {1e3 * a.time_offset_sigma_s:.2f} ms",
        ),
    ]
    weak = (
        []
        if a.weak is None
        else [("  not observable", f"the motion leaves unobservable the {a.weak}")]
    )
    return rows + weak


def _lever_arm_rows(found: LeverArm) -> _Rows:
    (x, y, z) = found.t_cam0_imu
    (p, q, r) = found.sigma_m
    return [("IMU in cam0", f"{x:+.4f} {y:+.4f} {z:+.4f} m, sigma {p:.4f} {q:.4f} {r:.4f}")]
