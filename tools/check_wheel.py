"""Install a wheel into a new environment outside the repository, and run its demo there.

python tools/check_wheel.py dist

What the wheel needs is installed as a user gets it: the newest versions that it allows.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import venv
from pathlib import Path


def main(argv: list[str]) -> int:
    """Return 0 where the installed command runs the demo."""
    if len(argv) != 1:
        print(__doc__)
        return 2
    wheels = sorted(Path(argv[0]).resolve().glob("*.whl"))
    if len(wheels) != 1:
        print(f"error: {argv[0]} holds {len(wheels)} wheels; run `make wheel`", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory() as folder:
        environment = Path(folder) / "env"
        venv.create(environment, with_pip=True)
        programs = environment / ("Scripts" if os.name == "nt" else "bin")
        pip = [str(programs / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        demo = [str(programs / "vio"), "demo", "--out", "demo"]
        for command in ([*pip, str(wheels[0])], demo):
            subprocess.run(command, cwd=folder, env=clean, check=True)
    print(f"{wheels[0].name} installs and runs alone")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
