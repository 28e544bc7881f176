"""Arguments that several subcommands take."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vio.errors import ConfigError

if TYPE_CHECKING:
    from vio.config import Config
    from vio.datasets.frame_times import Seconds
    from vio.live.build import MapUse
    from vio.mavlink.output import MavlinkSettings
    from vio.runs.live_folder import LiveRunSettings

_EXAMPLES = "examples:"


class HelpWithExamples(argparse.HelpFormatter):
    """Wraps the description of a command, and keeps the lines of its examples."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if not text.startswith(_EXAMPLES):
            return super()._fill_text(text, width, indent)
        return "".join(f"{indent}{line}" for line in text.splitlines(keepends=True))


def examples(*lines: str) -> dict[str, Any]:
    """Return what makes the help of a command end with examples, `command  # remark` each."""
    text = [_EXAMPLES]
    for line in lines:
        command, _, remark = line.partition("  # ")
        text += [f"  {command}", f"      {remark}"]
    return {"epilog": "\n".join(text), "formatter_class": HelpWithExamples}


def add_settings_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of any setting."""
    parser.add_argument(
        "--config",
        type=Path,
        metavar="F",
        help="YAML file with settings that differ from the defaults; or fast, a preset",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="a.b=c",
        help="change one setting; may be repeated",
    )


def add_config_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that change the configuration."""
    add_settings_arguments(parser)
    parser.add_argument(
        "--motion", metavar="NAME", help="imu, velocity, none or auto: same as --set motion=NAME"
    )
    parser.add_argument("--backend", metavar="NAME", help="same as --set backend=NAME")
    parser.add_argument("--calibration", metavar="F", help="same as --set dataset.calibration=F")
    parser.add_argument(
        "--camera",
        metavar="NAME",
        help="left: one camera of two: same as --set dataset.camera=left",
    )
    parser.add_argument(
        "--topics", metavar="A=/B,…", help="topics of a bag: same as --set dataset.topics=A=/B,…"
    )
    parser.add_argument(
        "--frontend",
        metavar="NAME",
        help="same as --set frontend.name=NAME; vio run also takes FILE.py:CLASS, a front end or a "
        "detector of your own",
    )


def config_words(args: argparse.Namespace) -> list[str]:
    """Return the arguments that changed the configuration, as another command takes them."""
    words: list[str] = []
    for name in ("config", "motion", "backend", "calibration", "camera", "topics", "frontend"):
        value = getattr(args, name)
        if value is not None:
            words += [f"--{name}", str(value)]
    for override in args.set:
        words += ["--set", override]
    return words


def add_span_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the range of frames."""
    parser.add_argument(
        "--start",
        type=bound,
        default=0,
        metavar="N",
        help="first frame, or time such as 12s (default 0)",
    )
    parser.add_argument(
        "--stop",
        "--end",
        type=bound,
        metavar="N",
        help="frame after the last one, or time such as 60s",
    )


def add_map_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the map and the folder of results of a live odometry."""
    parser.add_argument("--map", type=Path, metavar="FILE", help="begin or continue a map")
    parser.add_argument(
        "--localise", action="store_true", help="find poses in --map, and leave it as it is"
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="run folder, as vio run writes it; it grows meanwhile",
    )
    parser.add_argument(
        "--save-observations",
        action="store_true",
        help="with --out, also write the log of features",
    )
    parser.add_argument(
        "--drop",
        choices=("oldest", "none", "block"),
        help="of frames that wait (default oldest, and block of a file)",
    )


def kept_from(args: argparse.Namespace, source: str) -> LiveRunSettings | None:
    """Return what is to be kept of a live run of a source; None: nothing."""
    from vio.runs.live_folder import LiveRunSettings

    if args.out is None:
        if args.save_observations:
            raise ConfigError("--save-observations needs --out DIR")
        return None
    return LiveRunSettings(
        args.out,
        source,
        save_observations=args.save_observations,
        waits=args.drop == "block",
        command=args.command_line,
    )


def map_from(args: argparse.Namespace) -> MapUse | None:
    """Return the use of the map that the arguments name; None: there is none."""
    from vio.live.build import MapUse

    if args.localise and args.map is None:
        raise ConfigError("--localise needs --map FILE")
    if args.map is None:
        return None
    return MapUse(args.map, args.localise)


def add_mavlink_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the way to a flight controller."""
    parser.add_argument(
        "--mavlink",
        metavar="ADDRESS",
        help="send poses to an autopilot: udp:HOST:PORT or serial:DEVICE[:BAUD] (extra mavlink)",
    )
    parser.add_argument(
        "--mavlink-message",
        choices=("odometry", "vision"),
        default="odometry",
        help="ODOMETRY, or VISION_POSITION_ESTIMATE",
    )
    parser.add_argument(
        "--mount",
        default="0,0,0",
        metavar="R,P,Y",
        help="how the left camera looks out of the vehicle, degrees (default 0,0,0: ahead, level)",
    )
    parser.add_argument(
        "--heading",
        type=float,
        metavar="DEG",
        help="of the vehicle at the start, from north to the right",
    )


def mavlink_from(args: argparse.Namespace) -> MavlinkSettings | None:
    """Return where the arguments send poses to; None: nowhere."""
    if args.mavlink is None:
        return None
    from vio.mavlink.output import MavlinkSettings, checked_mounting

    heading = args.heading
    if heading is not None and not abs(heading) <= 360:
        raise ConfigError(f"--heading {heading:g}: give -360 to 360 degrees")
    mounting = checked_mounting(args.mount)
    return MavlinkSettings(args.mavlink, args.mavlink_message, mounting, heading)


def bound(text: str) -> int | Seconds:
    """Parse a frame number, or a time after the first frame such as 12.5s."""
    from vio.datasets.frame_times import parse_bound

    return parse_bound(text)


def add_lengths_argument(parser: argparse.ArgumentParser) -> None:
    """Add the path lengths of the drift."""
    parser.add_argument(
        "--lengths",
        type=lengths,
        metavar="M,M",
        help="path lengths of the drift (default 100,…,800; a tenth or a hundredth of these where "
        "the path is shorter)",
    )


def lengths(text: str) -> tuple[float, ...]:
    """Parse '25,50' into metres."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if not values or any(not 0 < v < float("inf") for v in values):
        raise argparse.ArgumentTypeError(
            f"{text!r} is no list of path lengths; give metres above 0, as in 25,50"
        )
    return values


def config_from(args: argparse.Namespace) -> Config:
    """Build the configuration from the arguments."""
    from vio.config import load_config

    overrides = list(args.set)
    named = {
        "motion": "motion",
        "backend": "backend",
        "frontend.name": "frontend",
        "dataset.calibration": "calibration",
        "dataset.camera": "camera",
        "dataset.topics": "topics",
    }
    # Commands that take any setting alone have none of these, or others by the same name.
    values = (
        {}
        if not hasattr(args, "backend")
        else {key: getattr(args, name) for key, name in named.items()}
    )
    for key, value in values.items():
        if value is not None:
            # Quoted: to YAML a bare `none` is text but `null`, `on` or `no` would not be.
            overrides.append(f'{key}="{value}"')
    return load_config(args.config, overrides)
