"""Run short recordings on an emulated Arm processor, with a wheel for it, and compare with this
machine.

python -m tools.arm ROOT WHEEL SOURCE...

By hand, as it takes minutes and a gigabyte: ROOT is the file system of an aarch64 Debian or Ubuntu
with this Python (`debootstrap --arch=arm64`, or unpacked packages), WHEEL one that `make wheel`
wrote for aarch64. It needs qemu-aarch64-static (Debian: qemu-user-static). What the wheel depends on
is downloaded by pip, for aarch64 and in the versions of this environment.
"""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
import tempfile
import zipfile
from importlib import metadata
from pathlib import Path

import numpy as np
from packaging.requirements import Requirement

from tools.prebuild import TARGETS
from vio.files.trajectories import read_trajectory

_EMULATOR = "qemu-aarch64-static"
_PACKAGE = "stereo-vio"
_FRAMES = 8
_GLIBC = (17, 24, 26, 27, 28, 34)  # minor versions in the tags of wheels
_MAX_APART_M = 1e-3  # sums in another order; a wrong loop is off by far more


def main() -> int:
    """Return 0 where all recordings give the same poses, without compiling, on both machines."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", type=Path, metavar="ROOT")
    parser.add_argument("wheel", type=Path, metavar="WHEEL")
    parser.add_argument("sources", nargs="+", metavar="SOURCE")
    args = parser.parse_args()
    root = args.root.resolve()
    wheel = args.wheel.resolve()
    _name_processor(root)
    with tempfile.TemporaryDirectory() as folder:
        site = Path(folder) / "site"
        _install(wheel, site)
        far = [
            name for name in args.sources if _difference_m(root, site, name, Path(folder)) is None
        ]
    return 1 if far else 0


def _name_processor(root: Path) -> None:
    """Let programs below `root` read which instructions are emulated: older emulators show them
    the list of this machine.
    """
    file = root / "proc" / "cpuinfo"
    (flags,) = (target.flags for target in TARGETS if target.machine == "aarch64")
    file.parent.mkdir(exist_ok=True)
    if not file.exists():
        file.write_text(f"processor\t: 0\nFeatures\t: {flags}\n", encoding="utf-8")


def _install(wheel: Path, site: Path) -> None:
    """Unpack a wheel, and all that it needs, for aarch64."""
    downloads = site.with_name("wheels")
    version = f"{sys.version_info[0]}{sys.version_info[1]}"
    platforms = [f"manylinux_2_{minor}_aarch64" for minor in _GLIBC] + ["manylinux2014_aarch64"]
    options = ["--no-deps", "--only-binary=:all:", "--python-version", version]
    options += ["--implementation", "cp", "--dest", str(downloads)]
    options += [word for abi in (f"cp{version}", "abi3", "none") for word in ("--abi", abi)]
    options += [word for name in platforms for word in ("--platform", name)]
    pip = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, *options, *_requirements()], check=True)
    for file in (wheel, *downloads.glob("*.whl")):
        with zipfile.ZipFile(file) as archive:
            archive.extractall(site)


def _requirements() -> list[str]:
    """Return what the package needs on aarch64, and what that needs, as this environment has it."""
    here = {"platform_machine": "aarch64", "extra": ""}
    found: dict[str, str] = {}
    waiting = [_PACKAGE]
    while waiting:
        for text in metadata.requires(waiting.pop()) or []:
            needed = Requirement(text)
            name = needed.name.lower()
            if name in found or (needed.marker is not None and not needed.marker.evaluate(here)):
                continue
            found[name] = metadata.version(name)
            waiting.append(name)
    return [f"{name}=={version}" for name, version in found.items()]


def _difference_m(root: Path, site: Path, source: str, folder: Path) -> float | None:
    """Return by how much positions on both machines differ at most; None: they are not the same,
    or were not computed.
    """
    name = Path(source).name
    python = f"usr/bin/python{sys.version_info[0]}.{sys.version_info[1]}"
    emulated = [_EMULATOR, "-L", str(root), str(root / python), "-m", "vio"]
    options = ["run", str(Path(source).resolve()), "--stop", str(_FRAMES), "--no-plot", "--quiet"]
    paths = []
    for machine, command in (("aarch64", emulated), ("here", [sys.executable, "-m", "vio"])):
        out = folder / f"{name}_{machine}"
        environment = dict(os.environ)
        if machine == "aarch64":
            environment |= {"PYTHONPATH": str(site), "NUMBA_CACHE_DIR": str(folder / "compiled")}
        done = subprocess.run(
            [*command, *options, "--out", str(out)],
            env=environment,
            cwd=folder,
            stdout=subprocess.DEVNULL,
            check=False,
        )
        if done.returncode:
            print(f"{name}: failed on {machine}: {shlex.join(command)}", file=sys.stderr)
            return None
        paths.append(read_trajectory(out / "trajectory.tum").positions)
    if compiled := sorted(path.name for path in (folder / "compiled").rglob("*.nbi")):
        print(f"{name}: the wheel holds no machine code of {', '.join(compiled)}", file=sys.stderr)
        return None
    apart_m = float(np.abs(paths[0] - paths[1]).max())
    print(f"{name}: positions of {len(paths[0])} frames differ by {1e6 * apart_m:.2f} um at most")
    return apart_m if apart_m < _MAX_APART_M else None


if __name__ == "__main__":
    sys.exit(main())
