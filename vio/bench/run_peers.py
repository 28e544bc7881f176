"""Run another system on the sequences of a suite, in an environment of its own.

Nothing of these systems is shipped or a dependency: an environment is made when a user asks for it,
from packages of PyPI, under the licence that is said.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vio.bench.suite import Sequence, Suite
from vio.bench.tasks import source_of
from vio.datasets import open_dataset
from vio.datasets.frame_times import frames_between, parse_bound
from vio.datasets.settings import DatasetSettings
from vio.errors import ConfigError, DataError, MissingDependencyError
from vio.offline.convert_spectacularai import write_spectacularai

_LONGEST_S = 3600.0  # a replay
_PLAYER = Path(__file__).parent / "spectacularai_player.py"


@dataclass(frozen=True, slots=True)
class Peer:
    """A system that a user would install in our place."""

    package: str  # with its version, as pip takes it
    licence: str  # said before it is installed
    programs: tuple[str, ...]  # that must be on the path, and what has them
    system: str  # its name in tables


PEERS = {
    "spectacularai": Peer(
        "spectacularAI==1.54.0",
        "free for non-commercial use only (Spectacular AI Ltd)",
        ("ffmpeg", "ffprobe"),
        "spectacularai_imu",
    )
}


def run_peer(name: str, suite: Suite, data: Path, kept: Path, say: Callable[[str], None]) -> Path:
    """Run a system on all recordings of a suite; trajectories that are there are kept.

    Args:
        name: a key of `PEERS`.
        suite: its sequences must have a recording, two cameras and an IMU.
        data: folder of the recordings.
        kept: the environment and the trajectories are written below it.
        say: takes a line for the user.

    Returns:
        The folder of files SEQUENCE.SYSTEM.tum, as `--peers` takes it.

    Raises:
        MissingDependencyError: a program is missing, or the package cannot be installed.
        ConfigError: no sequence can be replayed.
    """
    peer = PEERS[name]
    lacking = [program for program in peer.programs if shutil.which(program) is None]
    if lacking:
        raise MissingDependencyError(
            f"{name} needs {', '.join(lacking)} and gives no pose without; install Debian's package "
            "ffmpeg, or put them on the path"
        )
    sequences = [s for s in suite.sequences if s.source is not None and not s.covered]
    if not sequences:
        raise ConfigError(f"{suite.name} has no sequence with a recording that {name} can replay")
    python = environment(kept / "environments" / peer.package.replace("==", "-"), peer, say)
    folder = kept / "peers"
    folder.mkdir(parents=True, exist_ok=True)
    for sequence in sequences:
        out = folder / f"{sequence.name}.{peer.system}.tum"
        if out.is_file():
            continue
        say(f"{name}: {sequence.name}")
        _replay(python, sequence, data, out)
    return folder


def environment(folder: Path, peer: Peer, say: Callable[[str], None]) -> Path:
    """Return the Python of a peer's environment, which is made where it is not there.

    Raises:
        MissingDependencyError: it cannot be made.
    """
    python = folder / "bin" / "python"
    done = folder / "installed"
    if done.is_file():
        return python
    say(f"installing {peer.package} into {folder}; licence: {peer.licence}")
    shutil.rmtree(folder, ignore_errors=True)
    _call([sys.executable, "-m", "venv", str(folder)], peer.package)
    _call([str(python), "-m", "pip", "--quiet", "install", peer.package], peer.package)
    done.touch()
    return python


def _call(command: list[str], package: str) -> None:
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    if finished.returncode:
        last = finished.stderr.strip().splitlines()[-1:] or ["no message"]
        raise MissingDependencyError(
            f"{package} cannot be installed ({last[0]}); check the network and the disk"
        )


def _replay(python: Path, sequence: Sequence, data: Path, out: Path) -> None:
    """Convert a sequence, replay it, and write its trajectory.

    Raises:
        DataError: the system gives no pose.
    """
    assert sequence.source is not None
    dataset = open_dataset(source_of(sequence.source, data), DatasetSettings(projection="pinhole"))
    stop = None if sequence.stop is None else parse_bound(sequence.stop)
    first, last = frames_between(dataset.recording, parse_bound(sequence.start), stop)
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
