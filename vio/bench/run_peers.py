"""Run another system on the sequences of a suite, in an environment of its own, or by a program
that the user has built.

Nothing of these systems is shipped or a dependency: an environment is made when a user asks for it,
from packages of PyPI, under the licence that is said. Basalt has no package; `basalt_vio` takes an
EuRoC folder and a `calibration.json`, and writes `trajectory.csv` into the folder where it runs, in
EuRoC's form: the poses of the IMU, quaternions w first, whole nanoseconds.
Reference: Basalt's `src/vio.cpp` (its options, and `--save-trajectory euroc`).
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from vio.bench.suite import Sequence, Suite
from vio.bench.tasks import source_of
from vio.datasets import open_dataset
from vio.datasets.frame_times import frames_between, parse_bound
from vio.datasets.rigs import load_rig
from vio.datasets.settings import DatasetSettings
from vio.errors import ConfigError, DataError, MissingDependencyError
from vio.files.trajectories import read_trajectory, write_tum
from vio.numerics.kinds import Capacity
from vio.offline.convert import convert
from vio.offline.convert_spectacularai import write_spectacularai
from vio.protocols import Dataset
from vio.records import S_PER_NS
from vio.targets.results import basalt_text

_LONGEST_S: Capacity[float] = 3600.0  # a replay
_PLAYER = Path(__file__).parent / "spectacularai_player.py"


@dataclass(frozen=True, slots=True)
class Peer:
    """A system that a user would install in our place."""

    # with its version, as pip takes it; None: the user gives its program
    package: str | None
    licence: str  # said before it is installed
    programs: tuple[str, ...]  # that must be on the path, and what has them
    system: str  # its name in tables


@dataclass(frozen=True, slots=True)
class Program:
    """A program of a system that the user has built."""

    path: Path
    settings: Path | None = None  # its file of settings; None: its own defaults


PEERS = {
    "spectacularai": Peer(
        "spectacularAI==1.54.0",
        "free for non-commercial use only (Spectacular AI Ltd)",
        ("ffmpeg", "ffprobe"),
        "spectacularai_imu",
    ),
    "basalt": Peer(None, "BSD-3-Clause", (), "basalt_imu"),
}


def _check_helpers(name: str, peer: Peer) -> None:
    """Raise MissingDependencyError where a program is missing that a system calls."""
    lacking = [program for program in peer.programs if shutil.which(program) is None]
    if lacking:
        raise MissingDependencyError(
            f"{name} needs {', '.join(lacking)} and gives no pose without; install Debian's package "
            "ffmpeg, or put them on the path"
        )


def run_peer(
    name: str,
    suite: Suite,
    data: Path,
    kept: Path,
    say: Callable[[str], None],
    program: Program | None = None,
) -> Path:
    """Run a system on all recordings of a suite; trajectories that are there are kept.

    Args:
        name: a key of `PEERS`.
        suite: its sequences must have a recording, two cameras and an IMU.
        data: folder of the recordings.
        kept: the environment and the trajectories are written below it.
        say: takes a line for the user.
        program: of a system that has no package.

    Returns:
        The folder of files SEQUENCE.SYSTEM.tum, as `--peers` takes it.

    Raises:
        MissingDependencyError: a program is missing, or the package cannot be installed.
        ConfigError: no sequence can be replayed, or the program is missing.
    """
    peer = PEERS[name]
    _check_program(name, peer, program)
    _check_helpers(name, peer)
    sequences = [s for s in suite.sequences if s.source is not None and not s.covered]
    if not sequences:
        raise ConfigError(f"{suite.name} has no sequence with a recording that {name} can replay")
    if peer.package is not None:
        where = kept / "environments" / peer.package.replace("==", "-")
        python = environment(where, peer.package, peer.licence, say)
        replay: Callable[[Sequence, Path, Path], None] = partial(_replay, python)
    else:
        assert program is not None
        replay = partial(_replay_basalt, program)
    folder = kept / "peers"
    folder.mkdir(parents=True, exist_ok=True)
    for sequence in sequences:
        out = folder / f"{sequence.name}.{peer.system}.tum"
        if out.is_file():
            continue
        say(f"{name}: {sequence.name}")
        replay(sequence, data, out)
    return folder


def _check_program(name: str, peer: Peer, program: Program | None) -> None:
    """Raise ConfigError unless a program is given where one is needed, and can be run."""
    if peer.package is not None:
        if program is not None:
            raise ConfigError(f"{name} is installed as {peer.package}; leave out --peer-program")
        return
    if program is None:
        raise ConfigError(
            f"{name} is no package that could be installed; build it, and give its program with "
            f"--peer-program PATH (basalt_vio)"
        )
    if not (program.path.is_file() and os.access(program.path, os.X_OK)):
        raise ConfigError(f"--peer-program {program.path}: is no program that can be run")
    if program.settings is not None and not program.settings.is_file():
        raise ConfigError(f"--peer-settings {program.settings}: does not exist")


def environment(folder: Path, package: str, licence: str, say: Callable[[str], None]) -> Path:
    """Return the Python of a peer's environment, which is made where it is not there.

    Raises:
        MissingDependencyError: it cannot be made.
    """
    python = folder / "bin" / "python"
    done = folder / "installed"
    if done.is_file():
        return python
    say(f"installing {package} into {folder}; licence: {licence}")
    shutil.rmtree(folder, ignore_errors=True)
    _call([sys.executable, "-m", "venv", str(folder)], package)
    _call([str(python), "-m", "pip", "--quiet", "install", package], package)
    done.touch()
    return python


def _call(command: list[str], package: str) -> None:
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    if finished.returncode:
        last = finished.stderr.strip().splitlines()[-1:] or ["no message"]
        raise MissingDependencyError(
            f"{package} cannot be installed ({last[0]}); check the network and the disk"
        )


def _opened(sequence: Sequence, data: Path) -> tuple[Dataset, int, int | None]:
    """Return the recording of a sequence, its first frame and the one after its last."""
    assert sequence.source is not None
    dataset = open_dataset(source_of(sequence.source, data), DatasetSettings(projection="pinhole"))
    stop = None if sequence.stop is None else parse_bound(sequence.stop)
    return dataset, *frames_between(dataset.recording, parse_bound(sequence.start), stop)


def _replay_basalt(program: Program, sequence: Sequence, data: Path, out: Path) -> None:
    """Convert a sequence, run Basalt on it, and write its trajectory.

    Raises:
        DataError: the recording has no IMU, or Basalt gives no pose.
    """
    dataset, first, last = _opened(sequence, data)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        written = convert(dataset, folder, "euroc", start=first, stop=last)
        if not written.imu_samples:
            raise DataError(f"{sequence.name}: has no IMU, which Basalt needs here")
        times_ns = dataset.recording.frame_times_ns[first:last]
        duration_s = float(times_ns[-1] - times_ns[0]) * S_PER_NS
        hz = max(written.imu_samples / max(duration_s, 1e-9), 1.0)
        text = basalt_text(load_rig(folder), hz)
        assert text is not None  # of rectified images
        (folder / "calibration.json").write_text(text, encoding="utf-8")
        command = [
            *(str(program.path.absolute()), "--dataset-path", str(folder)),
            *("--dataset-type", "euroc", "--cam-calib", str(folder / "calibration.json")),
            *("--show-gui", "0", "--save-trajectory", "euroc"),
        ]
        if program.settings is not None:
            command += ["--config-path", str(program.settings.absolute())]
        finished = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=_LONGEST_S, cwd=folder
        )
        made = folder / "trajectory.csv"
        try:
            poses = read_trajectory(made, fmt="euroc", body="imu") if made.is_file() else None
        except DataError:
            poses = None
        if poses is None or len(poses) < 2:
            said = finished.stderr.strip().splitlines()[-1:] or ["it says nothing"]
            raise DataError(f"{sequence.name}: {program.path.name} gives no pose ({said[0]})")
        write_tum(out, poses)


def _replay(python: Path, sequence: Sequence, data: Path, out: Path) -> None:
    """Convert a sequence, replay it, and write its trajectory.

    Raises:
        DataError: the system gives no pose.
    """
    dataset, first, last = _opened(sequence, data)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        origin_ns = write_spectacularai(dataset, folder, first, last, lambda done, total: None)[2]
        part = folder / "poses.tum"
        command = [str(python), str(_PLAYER), str(folder), str(origin_ns), str(part)]
        finished = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=_LONGEST_S
        )
        poses = part.read_text(encoding="utf-8") if part.is_file() else ""
        if poses.count("\n") < 2:
            said = finished.stderr.strip().splitlines()[-1:] or ["it says nothing"]
            raise DataError(f"{sequence.name}: {_PLAYER.stem} gives no pose ({said[0]})")
        shutil.move(part, out)
