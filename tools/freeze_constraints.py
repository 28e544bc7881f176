"""Print the exact versions of this environment as a constraints file; the learned extra's pins are kept."""

from __future__ import annotations

import subprocess
import sys

# Pinned though not installed here: an open range takes several GB of CUDA packages on machines without a GPU.
LEARNED = {"torch": "2.13.0", "kornia": "0.9.0"}


def main() -> int:
    """Print the file to stdout."""
    frozen = subprocess.run([sys.executable, "-m", "pip", "freeze"], check=True, capture_output=True, text=True).stdout
    pins = dict(LEARNED)
    for line in frozen.splitlines():
        name, equals, version = line.partition("==")
        if equals and not line.startswith("#"):
            pins[name] = version
    print("# Exact versions that `make` installs; written by `make constraints` on Python", end=" ")
    print(f"{sys.version_info.major}.{sys.version_info.minor}.")
    for name in sorted(pins, key=str.lower):
        # Versions for another Python are that Python's own choice.
        print(f'{name}=={pins[name]} ; python_version == "{sys.version_info.major}.{sys.version_info.minor}"')
    return 0


if __name__ == "__main__":
    sys.exit(main())
