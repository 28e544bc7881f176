"""Print the exact versions of this environment as a constraints file; it must hold every extra
of the project.
"""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys

INSTALLERS = {"pip", "wheel"}  # not the project's business
# One package, at least, of each extra.
EXTRAS = ("pytest", "torch", "kornia", "distributed", "cyclonedds", "pyrealsense2")


def main() -> int:
    """Print the file to stdout."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    missing = [name for name in EXTRAS if importlib.util.find_spec(name) is None]
    if missing:
        print(
            f"error: {', '.join(missing)} not installed here; run `make constraints`",
            file=sys.stderr,
        )
        return 1
    command = [sys.executable, "-m", "pip", "freeze", "--all", "--exclude-editable"]
    frozen = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    pins = {}
    for line in frozen.splitlines():
        name, equals, version = line.partition("==")
        if equals and not line.startswith("#") and name not in INSTALLERS:
            # A build such as 2.13.0+cpu is another machine's 2.13.0.
            pins[name] = version.partition("+")[0]
    print("# Exact versions that `make` installs; written by `make constraints` on Python", end=" ")
    print(f"{sys.version_info.major}.{sys.version_info.minor}.")
    for name in sorted(pins, key=str.lower):
        # Versions for another Python are that Python's own choice.
        print(
            f"{name}=={pins[name]} ; python_version == "
            f'"{sys.version_info.major}.{sys.version_info.minor}"'
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
