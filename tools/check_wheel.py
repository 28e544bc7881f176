"""Install a wheel into a new environment outside the repository, and run there what the README
shows.

python tools/check_wheel.py dist

What the wheel needs is installed as a user gets it: the newest versions that it allows. On Linux
x86-64 and aarch64, the loops are compiled for these versions into more wheels (tools/prebuild.py);
that of this machine is run and must compile nothing.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

_COMMANDS = (
    "demo --out demo",
    "render --scene room --trajectory handheld --realism real --duration 0.5 --rig small --out "
    "room",
    "inspect demo/street",
    "run demo/street --stop 40 --out first --save-observations --report",
    "run first/observations.npz --out again",
    "eval first again demo/street --plot",
    "run room --out flight",
)


def check(dist: Path) -> int:
    """Return 0 where the installed commands run and write what they should."""
    dist = dist.resolve()
    wheels = sorted(dist.glob("*.whl"))
    if len(wheels) != 1:
        print(f"error: {dist} holds {len(wheels)} wheels; run `make wheel`", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory() as folder:
        environment = Path(folder) / "env"
        venv.create(environment, with_pip=True)
        programs = environment / ("Scripts" if os.name == "nt" else "bin")
        pip = [
            str(programs / "python"),
            "-m",
            "pip",
            "install",
            "--quiet",
            "--disable-pip-version-check",
        ]
        clean = {
            name: value
            for name, value in os.environ.items()
            if name not in ("PYTHONPATH", "NUMBA_CPU_NAME")
        }
        clean["NUMBA_CACHE_DIR"] = f"{folder}/compiled"
        installed = [[str(programs / "vio"), *command.split()] for command in _COMMANDS]
        prebuilt = sys.platform == "linux" and platform.machine() in ("x86_64", "aarch64")
        commands = [[*pip, str(wheels[0])], *installed]
        if prebuilt:
            prebuild = [
                str(programs / "python"),
                str(Path(__file__).with_name("prebuild.py")),
                str(dist),
            ]
            again = [
                *pip,
                "--no-deps",
                "--force-reinstall",
                "--no-index",
                "--find-links",
                str(dist),
                "stereo-vio",
            ]
            commands[1:1] = [[*pip, "setuptools"], prebuild, again]
        for command in commands:
            subprocess.run(command, cwd=folder, env=clean, check=True)
        if prebuilt and (
            anew := sorted(path.name for path in Path(folder, "compiled").rglob("*.nbi"))
        ):
            print(f"error: the wheel holds no machine code of {', '.join(anew)}", file=sys.stderr)
            return 1
        made = (
            "first/report.html",
            "first/features.jpg",
            "first/trajectory.png",
            "eval.png",
            "flight/trajectory.tum",
        )
        if missing := [name for name in made if not (Path(folder) / name).is_file()]:
            print(f"error: not written: {', '.join(missing)}", file=sys.stderr)
            return 1
    for wheel in sorted(dist.glob("*.whl")):
        is_other = "manylinux" in wheel.name and platform.machine() not in wheel.name
        print(f"{wheel.name} {'is written' if is_other else 'installs and runs alone'}")
    return 0


def main() -> int:
    """Check the wheels of a folder."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dist", type=Path, help="the folder of the wheels")
    return check(parser.parse_args().dist)


if __name__ == "__main__":
    sys.exit(main())
