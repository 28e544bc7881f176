"""`vio calibrate-rig`: calibrate cameras and an IMU with a printed board."""

from __future__ import annotations

import argparse
import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vio.cli.output import ProgressBar, print_result
from vio.errors import ConfigError, DataError
from vio.files.printable import json_text

if TYPE_CHECKING:
    from vio.records import ImuDensities
    from vio.targets.calibrate import CameraCalibration
    from vio.targets.inertial import CameraImu

MARKER = "calibration.json"
PAGE = "report.html"
_AUTO = "auto"


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "calibrate-rig",
        help="calibrate cameras and an IMU with a printed board",
        description="Calibrate one camera or a stereo pair from a recording of a printed board "
        "(AprilGrid, ChArUco, checkerboard): lenses, the pair's pose and the board's bow in one "
        "robust least-squares problem, with standard deviations, halves of the views against each "
        "other, and what to record where something is missing; and the pose "
        "and clock of an IMU that the recording has. The recording needs no calibration. "
        "Writes Kalibr's camchain-imucam.yaml, which vio run --calibration takes, and the files of "
        "ROS, OpenCV and Basalt, and a page about it, report.html.",
    )
    parser.add_argument(
        "source", metavar="RECORDING", help="any recording with images, or a folder of pairs"
    )
    parser.add_argument(
        "--target", type=Path, required=True, metavar="FILE", help="description of the board"
    )
    parser.add_argument(
        "--size", type=float, metavar="M", help="side of a tag or square as measured, metres"
    )
    parser.add_argument(
        "--lens",
        type=_lens,
        default=_AUTO,
        metavar="NAME",
        help="lens model, such as radtan or eucm (default: all are compared)",
    )
    parser.add_argument(
        "--imu-noise",
        type=Path,
        metavar="FILE",
        help="Kalibr's imu.yaml, as vio imu-noise writes it (default: those of a usual MEMS)",
    )
    parser.add_argument(
        "--imu-terms",
        choices=("off", "scale", "full"),
        default="off",
        help="estimate scales of the IMU's axes, or their misalignment, too (default off)",
    )
    parser.add_argument("--no-imu", action="store_true", help="calibrate the cameras alone")
    parser.add_argument(
        "--frames", type=int, metavar="N", help="frames in which the board is looked for"
    )
    parser.add_argument("--topics", metavar="A=/B,…", help="topics of a bag, as for vio run")
    parser.add_argument(
        "--image-size", metavar="WxH", help="of the images, where no file states it"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="(default calibrations/NAME)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def _lens(name: str) -> str:
    if name == _AUTO:
        return name
    from vio.targets.lenses import LENSES

    if name not in LENSES:
        raise argparse.ArgumentTypeError(f"{name!r} is none of {_AUTO}, {', '.join(LENSES)}")
    return name


def execute(args: argparse.Namespace) -> int:
    from vio.cli.running import free_folder
    from vio.files.atomic import atomic_folder, check_replaceable, check_writable
    from vio.numerics.threads import one_blas_thread
    from vio.targets.calibrate import calibrate_cameras, calibrate_with_imu
    from vio.targets.corners import CornerDetector
    from vio.targets.description import read_target
    from vio.targets.page import write_page
    from vio.targets.picture import draw
    from vio.targets.recording import film, open_raw
    from vio.targets.results import CAMCHAIN, write_rig

    if args.frames is not None and args.frames < 1:
        raise ConfigError("--frames must be at least 1")
    target = read_target(args.target, args.size)
    raw = open_raw(args.source, topics=args.topics, size=_size(args.image_size))
    out = args.out or free_folder(raw.path, Path("calibrations"))
    check_replaceable(out.absolute(), replace=True, marker=MARKER)
    check_writable(out)
    with one_blas_thread(), ProgressBar("look for the board", unit="frames") as bar:
        filmed = film(raw, CornerDetector(target), max_frames=args.frames, progress=bar.update)
        lens = None if args.lens == _AUTO else args.lens
        found = calibrate_cameras(filmed, target, lens, bar.begin)
        rig = found.rig
        inertial = None
        if filmed.imu is not None and not args.no_imu:
            densities = _densities(args.imu_noise)
            bar.begin("adjust the IMU")
            try:
                inertial = calibrate_with_imu(filmed, target, found, densities, args.imu_terms)
            except DataError as error:
                raise DataError(f"{error}; or leave the IMU out by --no-imu") from error
            rig = replace(
                rig,
                T_cam0_imu=inertial.T_cam0_imu,
                time_offset_s=inertial.time_offset_s,
                imu_noise=densities,
            )
    facts = {"out": str(out), "target": str(target), **_facts(found)}
    if inertial is not None:
        facts["imu"] = _imu_facts(inertial)
    results = [
        ("target", str(target)),
        ("frames", f"{filmed.frames}, the board in {len(filmed.views)}; {found.seen.views} used"),
        *_rows(found),
        *([] if inertial is None else _imu_rows(inertial)),
    ]
    with atomic_folder(out, replace=True, marker=MARKER) as folder:
        files = write_rig(folder, rig)
        draw(found, folder / "calibration.png")
        write_page(folder / PAGE, f"Calibration of {raw.path.name}", found, inertial, results)
        (folder / MARKER).write_text(json_text(facts, indent=2) + "\n", encoding="utf-8")
    command = f"vio run {shlex.quote(args.source)} --calibration {shlex.quote(str(out / CAMCHAIN))}"
    rows = [
        *results,
        ("results", f"{out}: {', '.join(files)}, {PAGE}, calibration.png"),
        ("next", command),
    ]
    return print_result(facts, rows, as_json=args.json, name_width=16)


def _densities(file: Path | None) -> ImuDensities:
    """Return the IMU's noise: a file's, or that of the settings."""
    from vio.config import Config
    from vio.datasets.yaml_files import imu_densities, read_yaml_file

    if file is None:
        return Config().imu.densities
    found = imu_densities(read_yaml_file(file, "Kalibr's IMU noise"), file)
    if found is None:
        raise ConfigError(f"{file}: holds no noise densities; write them by vio imu-noise")
    return found


def _imu_facts(found: CameraImu) -> dict[str, Any]:
    import numpy as np

    return {
        "T_cam0_imu": found.T_cam0_imu.tolist(),
        "time_offset_s": found.time_offset_s,
        "sigmas": np.sqrt(np.diag(found.covariance)).tolist(),
        "gyro_bias": found.gyro_bias.tolist(),
        "accel_bias": found.accel_bias.tolist(),
        "up_board": found.up_board.tolist(),
        "chi": found.chi,
        "views": found.views,
        "weak": list(found.weak),
        "board_scale": found.board_scale,
        "board_scale_sigma": found.board_scale_sigma,
        "terms": found.terms.tolist(),
        "term_sigmas": found.term_sigmas.tolist(),
    }


def _imu_rows(found: CameraImu) -> list[tuple[str, str]]:
    import numpy as np

    from vio.geometry.lie import so3_log

    sigma = np.sqrt(np.diag(found.covariance))
    x, y, z = (1e3 * found.T_cam0_imu[:3, 3]).tolist()
    turn = np.degrees(so3_log(found.T_cam0_imu[:3, :3]))
    return [
        (
            "IMU in cam0",
            f"{x:+.1f} {y:+.1f} {z:+.1f} mm ± {1e3 * sigma[:3].max():.2f}, rotation "
            f"{turn[0]:+.3f} {turn[1]:+.3f} {turn[2]:+.3f} deg ± "
            f"{np.degrees(sigma[3:6].max()):.3f}",
        ),
        (
            "IMU clock",
            f"{1e3 * found.time_offset_s:+.3f} ms ± {1e3 * sigma[6]:.3f} (exposure = stamp + it)",
        ),
        (
            "IMU fit",
            f"{found.views} views; squared errors of poses and IMU are {found.chi:.2f} times those "
            "expected",
        ),
        (
            "board by the IMU",
            f"{100 * (found.board_scale - 1):+.2f} ± {100 * found.board_scale_sigma:.2f} % larger "
            "than in the target file (accelerometers are off by up to 1 %)",
        ),
        *_term_rows(found),
        *(("FOUND", text) for text in found.weak),
    ]


def _term_rows(found: CameraImu) -> list[tuple[str, str]]:
    """Scales in per cent and misalignments in degrees, of those that were estimated."""
    import numpy as np

    from vio.records import IMU_ENTRIES

    parts: dict[str, list[str]] = {}
    for (sensor, row, column), value, sigma in zip(
        IMU_ENTRIES, found.terms.tolist(), found.term_sigmas.tolist(), strict=True
    ):
        if sigma == 0:
            continue
        name = ("accelerometer", "gyro")[sensor]
        if row == column:
            text = f"{'xyz'[row]} {100 * value:+.2f} ± {100 * sigma:.2f} %"
        else:
            turn, turn_sigma = np.degrees([value, sigma]).tolist()
            text = f"{'xyz'[row]}{'xyz'[column]} {turn:+.2f} ± {turn_sigma:.2f} deg"
        parts.setdefault(name, []).append(text)
    return [(name, ", ".join(texts)) for name, texts in parts.items()]


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdecimal() and int(part) > 0 for part in parts):
        raise ConfigError(f"--image-size {text!r} is no size; write 752x480")
    return int(parts[0]), int(parts[1])


def _facts(found: CameraCalibration) -> dict[str, Any]:
    import numpy as np

    from vio.targets.bundle import layout_of

    at = found.found.at
    layout = layout_of(at.cameras)
    sigma = found.verdict.inflation * np.sqrt(np.diag(found.found.covariance))
    cameras = [
        {
            "model": camera.model,
            "fu_fv_cu_cv": [camera.fu, camera.fv, camera.cu, camera.cv],
            "coefficients": list(camera.coefficients),
            "sigmas": sigma[lens].tolist(),
            "residual_px": float(found.found.sigma_px[c]),
            "residual_of_images_px": list(_residual_of_images(found, c)),
            "residual_alone_px": found.alone_sigma_px[c],
            "halves_rms_px": found.verdict.halves.rms_px[c],
            "halves_max_px": found.verdict.halves.max_px[c],
        }
        for c, (camera, lens) in enumerate(zip(at.cameras, layout.lenses, strict=True))
    ]
    facts: dict[str, Any] = {
        "lens": found.lens,
        "compared": {score.name: score.rms_px for score in found.choice.scores}
        if found.choice
        else {},
        "rivals_max_px": {r.name: float(np.nanmax(r.off_px)) for r in found.rivals},
        "views": found.seen.views,
        "cameras": cameras,
        "bow_m": at.bow.tolist(),
        "bow_sigma_m": sigma[layout.bow].tolist(),
        "inflation": found.verdict.inflation,
        "findings": list(found.verdict.findings),
    }
    if layout.poses:
        facts |= {
            "T_cam1_cam0": at.T_cam_cam0[1].tolist(),
            "T_cam1_cam0_sigmas": sigma[layout.poses[0]].tolist(),
            "depth_sigma_at_5m": found.verdict.depth_m,
            "depth_halves_at_5m": found.verdict.halves.depth_m,
        }
    return facts


def _residual_of_images(found: CameraCalibration, camera: int) -> tuple[float, float]:
    """Standard deviations of a coordinate in a camera's images, which nine of ten images exceed,
    and which one of ten exceeds, pixels.
    """
    import numpy as np

    rows = found.seen.camera == camera
    _, first = np.unique(found.seen.view[rows], return_index=True)
    low, high = np.percentile(found.found.corner_sigma_px[rows][first], [10, 90]).tolist()
    return low, high


def _rows(found: CameraCalibration) -> list[tuple[str, str]]:
    import numpy as np

    from vio.geometry.lie import so3_log
    from vio.targets.bundle import layout_of
    from vio.targets.verdict import DEPTH_M

    at = found.found.at
    layout = layout_of(at.cameras)
    verdict = found.verdict
    sigma = verdict.inflation * np.sqrt(np.diag(found.found.covariance))
    rows: list[tuple[str, str]] = []
    if found.choice is not None:
        scored = ", ".join(f"{score.name} {score.rms_px:.3f}" for score in found.choice.scores)
        rows.append(("lens", f"{found.lens}; views left out are off by (px) {scored}"))
    for rival in found.rivals:
        worst = float(np.nanmax(rival.off_px))
        rows.append(
            ("", f"{rival.name} explains them as well, and differs by {worst:.2f} px at worst")
        )
    names: tuple[str, ...] = ("camera",)
    if len(at.cameras) > 1:
        names = ("left", "right")
    for c, (name, camera) in enumerate(zip(names, at.cameras, strict=True)):
        own = sigma[layout.lenses[c]]
        values = zip(
            ("fx", "fy", "cx", "cy"),
            (camera.fu, camera.fv, camera.cu, camera.cv),
            own,
            strict=False,
        )
        text = ", ".join(f"{key} {value:.2f} ± {s:.2f}" for key, value, s in values)
        best, worst = _residual_of_images(found, c)
        residual = f"residual {found.found.sigma_px[c]:.3f} px, in images {best:.3f} to {worst:.3f}"
        rows.append((name, f"{text}; {residual}"))
        off_px = verdict.inflation * float(np.nanmax(verdict.projection_sigma_px[c]))
        halves = verdict.halves
        rows.append(
            (
                "",
                f"projection ± {off_px:.2f} px at worst; halves {halves.rms_px[c]:.2f} px apart "
                f"(rms), {halves.max_px[c]:.2f} at worst",
            )
        )
    if layout.poses:
        T = at.T_cam_cam0[1]
        pose = sigma[layout.poses[0]]
        length = 1e3 * float(np.linalg.norm(T[:3, 3]))
        turn = np.degrees(so3_log(T[:3, :3]))
        rows.append(
            (
                "pair",
                f"baseline {length:.2f} mm ± {1e3 * float(np.linalg.norm(pose[:3])):.2f}, rotation "
                f"{turn[0]:+.3f} {turn[1]:+.3f} {turn[2]:+.3f} deg "
                f"± {np.degrees(np.linalg.norm(pose[3:])):.3f}",
            )
        )
        rows.append(
            (
                f"at {DEPTH_M:g} m",
                f"depth ± {1e3 * verdict.depth_m:.0f} mm; halves {1e3 * verdict.halves.depth_m:.0f} "
                "mm; and as many per cent as the board's measured size is off",
            )
        )
    bow = zip(1e3 * at.bow, 1e3 * sigma[layout.bow], strict=True)
    rows.append(("bow of the board", ", ".join(f"{b:+.2f} ± {s:.2f} mm" for b, s in bow)))
    refused = 100 * float(np.mean(~found.found.used))
    rows.append(("corners", f"{len(found.seen.uv)}, {refused:.1f} % refused"))
    rows += [("FOUND", finding) for finding in verdict.findings]
    if not verdict.findings:
        rows.append(("verdict", "nothing is missing"))
    return rows
