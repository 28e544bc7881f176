"""The command `vio`: subcommands, one file each, of which only the one that runs is imported;
nothing heavy is imported before it runs.

Such a file has `add_parser`, which adds its options, and `execute`, which runs it and returns the
exit status.

Exit status: 0 success, 1 an expected error, reported in one line, 2 wrong usage, 130 interrupted by
Ctrl-C, 143 ended by SIGTERM, 129 by SIGHUP; the last three leave no unfinished files behind.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import difflib
import gc
import io
import logging
import os
import shlex
import signal
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from importlib import import_module
from types import FrameType, ModuleType

from vio._version import __version__
from vio.cli.waiting import SilenceBroken
from vio.errors import NOTE, StoppedError, VioError
from vio.files.printable import printable
from vio.numerics.kinds import Capacity

# The commands by what they are for, and the files of those that have another name.
BY_PURPOSE = {
    "Try it": ("demo", "course"),
    "Before a run": (
        "inspect",
        "target",
        "calibrate-rig",
        "imu-noise",
        "calibrate",
        "rectify",
        "convert",
    ),
    "Run": ("run", "config"),
    "Live": ("live", "ros2", "play"),
    "Look and compare": ("report", "view", "mesh", "eval", "export"),
    "Maps": ("map", "localise", "georeference"),
    "Check without ground truth": ("check", "refine"),
    "Measure": ("bench", "render", "reproduce"),
    "Shell": ("completion",),
}
# What is typed in the place of a command or an option, and would be taken for one spelt alike.
_MEANT = {
    **dict.fromkeys(("compare", "diff", "ape", "rpe", "ate", "traj", "evaluate"), "eval"),
    **dict.fromkeys(("plot", "html"), "report"),
    **dict.fromkeys(("show", "viz", "visualize", "visualise"), "view"),
    **dict.fromkeys(("slam", "odometry", "odom", "track", "process"), "run"),
    **dict.fromkeys(("info", "doctor", "validate"), "inspect"),
    **dict.fromkeys(("simulate", "sim"), "render"),
    **dict.fromkeys(("camera", "stream"), "live"),
    **dict.fromkeys(("gnss", "gps"), "georeference"),
}
_MEANT_OPTIONS = {
    **{f"--{role}": f"--topics {role}=/TOPIC" for role in ("left", "right", "imu")},
    **dict.fromkeys(("--gt", "--groundtruth", "--ground-truth", "--truth"), "--reference"),
    **dict.fromkeys(("--loop-closure", "--loops", "--slam"), "--map FILE"),
    **dict.fromkeys(("--mono", "--one-camera"), "--camera left"),
}
_ALIKE = 0.7  # of words, from where on one may be meant by the other
_FILES = {"eval": "evaluate", "calibrate-rig": "calibrate_rig", "imu-noise": "imu_noise"}
COMMANDS = tuple(name for names in BY_PURPOSE.values() for name in names)

# Objects made before Python looks for cycles among the young ones: a tenth of a command's start
# went into that search, over modules and samples that stay. At its end, another tenth did.
_GC_OBJECTS: Capacity[int] = 100_000
# bytes; a short run of MH_01 takes 976 MB, and OpenCV fails to load in 820
_MIN_ADDRESS_SPACE = 1_000_000_000
_LIGHT = ("config", "completion")  # commands that load no library
_ENDLESS = ("live", "ros2", "play", "view")  # that go on until they are ended: a silence is no wait
_SEE_HELP = "; vio --help lists them"
_MAX_SHOWN = 200  # characters of a path in a message
_ENDING = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]


class _Terminated(KeyboardInterrupt):
    """The process was asked to end; handled like Ctrl-C, so that nothing unfinished stays."""

    def __init__(self, number: int) -> None:
        self.number = number


@contextlib.contextmanager
def _orderly_end() -> Iterator[None]:
    """Raise `_Terminated` at SIGTERM and SIGHUP inside the block, where this is the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    owner = os.getpid()

    def end(number: int, frame: FrameType | None) -> None:
        if os.getpid() != owner:  # a forked worker ends as it would have
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        signal.signal(number, signal.SIG_IGN)  # a second one must not cut short the cleaning up
        raise _Terminated(number)

    before = {number: signal.getsignal(number) for number in _ENDING}
    for number, handler in before.items():
        if handler == signal.SIG_DFL:  # under nohup SIGHUP is ignored, and stays so
            signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler is not None:
                signal.signal(number, handler)


def command_module(name: str) -> ModuleType:
    """Return the module of a command."""
    return import_module(f"vio.cli.{_FILES.get(name, name)}")


def build_parser(names: Iterable[str] = COMMANDS) -> argparse.ArgumentParser:
    """Return the parser of the command line with some commands."""
    parser = argparse.ArgumentParser(
        prog="vio",
        description="Stereo visual-inertial odometry and SLAM: from the images of two cameras, "
        "raw or rectified, or of one with an IMU or with depth, to a trajectory with its "
        "covariance. Begin with `vio demo`, or with `vio inspect RECORDING`.",
    )
    parser.add_argument("--version", action="version", version=f"stereo-vio {__version__}")
    parser.add_argument(
        "--debug",
        action="store_true",
        help="show the traceback of an expected error, and debug logs",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in names:
        module = command_module(name)
        module.add_parser(commands)
        commands.choices[name].set_defaults(execute=module.execute)
    return parser


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line; an unknown option shows the usage of its subcommand, not that of
    `vio`.
    """
    if argv is None:
        words = sys.argv[1:]
    else:
        words = list(argv)
    command = next((word for word in words if not word.startswith("-")), None)
    if command in COMMANDS:
        parser = build_parser([command])
    else:
        parser = build_parser()
    if command is not None and command not in COMMANDS:
        parser.error(
            f"there is no command {command!r}{_near(command, COMMANDS, _MEANT) or _SEE_HELP}"
        )
    args, unknown = parser.parse_known_args(words)
    if unknown:
        chosen = next(
            a for a in parser._actions if isinstance(a, argparse._SubParsersAction)
        ).choices[args.command]
        options = chosen._option_string_actions
        first = unknown[0]
        if first.startswith("-"):
            hint = _near(first.partition("=")[0], options, _MEANT_OPTIONS)
        else:
            hint = _place(first, words, options)
        chosen.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
    args.command_line = shlex.join(["vio", *words])
    return args


def _place(word: str, words: Sequence[str], options: Iterable[str]) -> str:
    """Return a hint at where a word of a command line that is too much belongs; nothing where that
    is not clear.
    """
    names = list(options)
    if "=" in word:
        return f"; write --set {word}" if "--set" in names else ""
    for option, name, value in zip(words, words[1:], words[2:], strict=False):
        if option == "--set" and value == word and "=" not in name:
            return f"; write --set {name}={word}"
    return (
        f"; if results go there, write --out {word}" if {"--out"} & set(names) - set(words) else ""
    )


def _near(word: str, known: Iterable[str], meant: Mapping[str, str]) -> str:
    """Return a hint at the known word that another one means, else is most like; nothing where none
    is.
    """
    names = list(known)
    instead = meant.get(word)
    if instead is not None:
        return f"; did you mean {instead}?" if instead.split()[0] in names else ""
    near = difflib.get_close_matches(word, names, 1, _ALIKE)
    return f"; did you mean {near[0]}?" if near else ""


def _check_address_space(command: str) -> None:
    """Refuse a limit under which the libraries of a command end the process when they are
    loaded.
    """
    if sys.platform == "win32" or command in _LIGHT:
        return
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if 0 <= limit < _MIN_ADDRESS_SPACE:  # RLIM_INFINITY is -1
        raise VioError(
            f"the address space is limited to {limit / 1e6:.0f} MB (ulimit -v), and vio {command} "
            "loads "
            f"{_MIN_ADDRESS_SPACE / 1e6:.0f} MB of libraries; raise the limit, or limit the "
            "resident memory "
            "instead (a container, systemd-run -p MemoryMax)"
        )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    for stream in (sys.stdout, sys.stderr):
        # a terminal that cannot show a character must not end the program
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    gc.set_threshold(_GC_OBJECTS)
    atexit.register(gc.freeze)
    args = _parse(argv)
    logging.addLevelName(NOTE, "NOTE")
    logging.basicConfig(
        level=logging.DEBUG if args.debug else NOTE,
        format="%(levelname)s: %(message)s",
        stream=sys.stderr,
    )
    for library in ("matplotlib", "numba"):  # thousands of lines at the level of --debug
        logging.getLogger(library).setLevel(logging.WARNING)
    try:
        with _orderly_end():
            _check_address_space(args.command)
            called = argv is not None  # from Python
            silent = called or args.command in (*_LIGHT, *_ENDLESS) or getattr(args, "quiet", False)
            with nullcontext() if silent else SilenceBroken(f"vio {args.command}"):
                status: int = args.execute(args)
            sys.stdout.flush()
    except StoppedError as stop:
        print(printable(" ".join(str(stop).split())), file=sys.stderr)
        return stop.status
    except _Terminated as stop:
        print(f"ended by {signal.Signals(stop.number).name}; nothing was written", file=sys.stderr)
        return 128 + stop.number
    except KeyboardInterrupt:
        print("interrupted; nothing was written", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of the output closed the pipe (`vio config --show | head`): not an error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (VioError, OSError, MemoryError) as error:
        if args.debug:
            raise
        print("error:", printable(" ".join(_message(error).split())), file=sys.stderr)
        if isinstance(error, OSError) and error.filename is None:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return status


def _message(error: VioError | OSError | MemoryError) -> str:
    """Return what an expected error says."""
    if isinstance(error, MemoryError):
        return f"out of memory ({str(error)[:_MAX_SHOWN] or 'no details'}); process less at once"
    if isinstance(error, VioError):
        return str(error)
    # A path that no check foresaw: too long a name, a folder that may not be entered, a disk that
    # fails.
    file = error.filename
    if file is None:
        where = "cannot write the output"
    else:
        where = f"cannot use {str(file)[:_MAX_SHOWN]}"
    return f"{where}: {error.strerror or error}"
