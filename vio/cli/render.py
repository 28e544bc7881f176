"""`vio render`: render a scene along a trajectory to an EuRoC or KITTI folder with ground truth."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from vio.cli.output import ProgressBar, print_result
from vio.errors import ConfigError

if TYPE_CHECKING:
    from vio.sim.scenarios import Conditions, Scenario

_EFFECTS = (
    "clean exposure gain gain-high blur noise dark bare-wall moving dropped duplicated time-offset"
)


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "render",
        help="render a recording with ground truth",
        description="Render a stereo-inertial recording with ground truth along a built-in or "
        "recorded trajectory, and "
        "write it as an EuRoC or KITTI folder that any odometry system can read.",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder to write (atomically)"
    )
    parser.add_argument(
        "--scene",
        choices=("room", "street", "corridor", "doors"),
        default="room",
        help="the scene (default room; it is built around a recorded trajectory)",
    )
    parser.add_argument(
        "--trajectory",
        default="handheld",
        metavar="T",
        help="handheld (default), car, a TUM file of the IMU's poses, or the folder of a recorded "
        "flight with "
        "groundtruth_tum.txt and, used where they exist, image_timestamps_ns.txt and imu0.csv",
    )
    parser.add_argument(
        "--frame-times",
        type=Path,
        metavar="F",
        help="frame times of a recorded trajectory: ns, one per line",
    )
    parser.add_argument(
        "--imu",
        metavar="F",
        help="simulated, none, or EuRoC's csv of a recorded IMU (default: that of the flight)",
    )
    parser.add_argument(
        "--velocity",
        choices=("none", "paper", "exact"),
        help="body velocity in KITTI folders (default there: paper, which is 0.5 m/s and 0.05 "
        "rad/s of noise)",
    )
    parser.add_argument(
        "--rig",
        choices=("euroc", "euroc-rectified", "kitti", "fisheye", "wide", "small"),
        help="cameras and their extrinsics to the IMU (default: euroc-rectified for handheld, "
        "kitti for car, euroc, "
        "which is unrectified, for a recorded trajectory)",
    )
    parser.add_argument(
        "--width", type=int, metavar="PX", help="image width, with the same field of view"
    )
    parser.add_argument(
        "--rate", type=float, metavar="HZ", help="frames per second (default 20; 10 for car)"
    )
    parser.add_argument(
        "--duration", type=float, metavar="S", help="length (default 30 s, or the whole flight)"
    )
    parser.add_argument(
        "--realism",
        choices=("plain", "real", "drawn"),
        default="plain",
        help="real: what real cameras do, all at once: exposure control with lag and jumps, motion "
        "blur of its shutter "
        "time, noise of its gain, unequal cameras, vignetting, glare, uneven light, blank walls, "
        "walking people, and a "
        "calibration that is slightly off; --set switches single ones off. drawn: the same, with "
        "a rig drawn from calibration_sigmas (default plain)",
    )
    parser.add_argument(
        "--effects", metavar="NAME,…", default="", help=f"in addition, of {_EFFECTS}"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="a.b=c",
        help="one value of effects, faults, imu_noise, calibration or calibration_sigmas, or of "
        "the scene "
        "(bare_wall, moving, people, lighting), such as effects.blur_exposure_ms=20 or people=0; "
        "may be repeated",
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="seed of all random numbers"
    )
    parser.add_argument(
        "--format",
        choices=("euroc", "kitti", "rgbd"),
        help="of the folder (default kitti for that rig)",
    )
    parser.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="processes (default up to 2); the images are the same",
    )
    parser.add_argument("--json", action="store_true", help="print the summary as one JSON object")


def execute(args: argparse.Namespace) -> int:
    from vio.numerics.threads import one_blas_thread
    from vio.sim.export import export_euroc, export_kitti, export_rgbd
    from vio.sim.scenarios import ParallelRecording, default_workers, plan
    from vio.sim.sequence import SimulatedRecording

    if args.workers is not None and not 1 <= args.workers <= 64:
        raise ConfigError(f"--workers takes 1 to 64 processes, got {args.workers}")
    scenario, form = scenario_from(args)
    start = time.perf_counter()
    simulation = plan(scenario)
    frames = len(simulation.stamps_ns)
    if args.workers is None:
        workers = default_workers(frames)
    else:
        workers = args.workers

    def write(recording: SimulatedRecording) -> None:
        with ProgressBar(f"rendering the {scenario.scene}") as bar:
            if form == "kitti":
                export_kitti(recording, args.out, replace=True, progress=bar.update)
            elif form == "rgbd":
                export_rgbd(recording, args.out, replace=True, progress=bar.update)
            else:
                noise = scenario.conditions.imu_noise.densities
                export_euroc(recording, args.out, replace=True, noise=noise, progress=bar.update)

    with one_blas_thread():
        if workers == 1:
            write(SimulatedRecording(simulation))
        else:
            with ParallelRecording(scenario, workers=workers, simulation=simulation) as recording:
                write(recording)
    seconds = time.perf_counter() - start
    camera = simulation.rig.cam0
    span_ns = int(simulation.stamps_ns[-1] - simulation.stamps_ns[0])
    summary = {
        "out": str(args.out),
        "format": form,
        "scene": scenario.scene,
        "trajectory": args.trajectory,
        "rig": scenario.rig,
        "camera": camera.model,
        "frames": frames,
        "duration_s": span_ns * 1e-9,
        "width": camera.width,
        "height": camera.height,
        "realism": args.realism,
        "imu": "recorded" if isinstance(scenario.imu, Path) else scenario.imu,
        "seed": scenario.seed,
        "workers": workers,
        "seconds": round(seconds, 2),
        "pairs_per_s": round(frames / seconds, 2),
        "bytes": sum(path.stat().st_size for path in args.out.rglob("*") if path.is_file()),
    }
    return print_result(summary, _rows(summary), as_json=args.json)


def _rows(summary: dict[str, Any]) -> tuple[tuple[str, str], ...]:
    return (
        (
            "scene",
            f"{summary['scene']}, trajectory {summary['trajectory']}, seed {summary['seed']}",
        ),
        (
            "cameras",
            f"{summary['rig']} ({summary['camera']}), {summary['width']} x {summary['height']}",
        ),
        ("frames", f"{summary['frames']} over {summary['duration_s']:.2f} s, IMU {summary['imu']}"),
        (
            "time",
            f"{summary['seconds']:.1f} s, {summary['pairs_per_s']:.1f} pairs/s, processes: "
            f"{summary['workers']}",
        ),
        ("folder", f"{summary['out']} ({summary['format']}, {summary['bytes'] / 1e6:.1f} MB)"),
    )


def scenario_from(args: argparse.Namespace) -> tuple[Scenario, str]:
    """Convert the arguments to a scenario and the format of the folder.

    Raises:
        VioError: arguments contradict each other, or name what does not exist.
    """
    from vio.sim.scenarios import Scenario

    car = args.trajectory == "car"
    usual_hz = 10.0 if car else 20.0
    if args.frame_times is not None and args.rate is not None:
        raise ConfigError("--frame-times and --rate exclude each other; give one of them")
    trajectory, frame_times, imu = _flight(args)
    rig: Any = args.rig or _usual_rig(trajectory, car=car)
    form = _form_of(args, rig, imu)
    usual_velocity: Literal["none", "paper"] = "none"
    if form == "kitti":
        imu = "none"
        usual_velocity = "paper"
    elif imu is None:
        imu = "simulated"
    scenario = Scenario(
        scene=args.scene,
        trajectory=trajectory,
        frame_times=frame_times,
        imu=imu if imu in ("simulated", "none") else Path(imu),
        velocity=args.velocity or usual_velocity,
        rig=rig,
        width=args.width,
        rate_hz=usual_hz if args.rate is None else args.rate,
        duration_s=args.duration,
        conditions=_conditions(args),
        seed=args.seed,
    )
    return scenario, form


def _usual_rig(trajectory: object, *, car: bool) -> str:
    """Return the rig that goes with a flight of a file, with a car, or with a simulated flight."""
    if isinstance(trajectory, Path):
        return "euroc"
    return "kitti" if car else "euroc-rectified"


def _flight(args: argparse.Namespace) -> tuple[Any, Any, Any]:
    """Return trajectory, frame times and IMU, those of a recorded flight where none are given.

    Raises:
        VioError: the trajectory does not exist.
    """
    from vio.sim.scenarios import READY_MOTIONS, flight_files

    trajectory: Any = args.trajectory
    frame_times = args.frame_times
    imu = args.imu
    if trajectory not in READY_MOTIONS:
        trajectory = Path(trajectory)
        if trajectory.is_dir():
            trajectory, own_times, own_imu = flight_files(trajectory)
            if frame_times is None and args.rate is None:
                frame_times = own_times
            imu = own_imu if imu is None else imu
        elif not trajectory.exists():
            raise ConfigError(
                f"--trajectory {trajectory}: there is no such file; give "
                f"{', '.join(READY_MOTIONS)}, a TUM file or the "
                "folder of a recorded flight"
            )
    return trajectory, frame_times, imu


def _form_of(args: argparse.Namespace, rig: Any, imu: Any) -> str:
    """Return the format of the folder.

    Raises:
        ConfigError: it cannot hold what was asked for.
    """
    form: str = args.format or ("kitti" if rig == "kitti" else "euroc")
    if form == "euroc" and imu == "none":
        raise ConfigError(
            "an EuRoC folder needs an IMU; give --imu simulated or a recorded one, or --format "
            "kitti"
        )
    if form == "euroc" and args.velocity not in (None, "none"):
        raise ConfigError("an EuRoC folder cannot contain body velocities; give --format kitti")
    if form == "kitti" and args.imu not in (None, "none"):
        raise ConfigError("a KITTI folder cannot contain an IMU; give --format euroc")
    return form


def _conditions(args: argparse.Namespace) -> Conditions:
    """Return the named effects with single values replaced."""
    from vio.config import merge_override
    from vio.sim.scenarios import Conditions, conditions_of, real_conditions

    real = args.realism != "plain"
    if real:
        level = real_conditions(args.scene, drawn_rig=args.realism == "drawn")
    else:
        level = Conditions()
    conditions = conditions_of(
        [name.strip() for name in args.effects.split(",") if name.strip()], level
    )
    for override in args.set:
        conditions = merge_override(conditions, override, example="effects.gamma=2.2")
    return conditions
