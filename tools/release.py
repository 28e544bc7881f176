"""Everything of a release but the upload: names of the version agree, the archives build, are
valid, install and run.

python -m tools.release            # in dist/; needs `pip install build twine`
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
from pathlib import Path

from tools import check_wheel
from vio._version import __version__

ROOT = Path(__file__).resolve().parent.parent


def problems(root: Path, version: str) -> list[str]:
    """Return what disagrees with the version that is to be released, one line each."""
    changes, citation, readme = (
        (root / name).read_text(encoding="utf-8")
        for name in ("CHANGELOG.md", "CITATION.cff", "README.md")
    )
    found = []
    section = re.search(rf"^## \[{re.escape(version)}\] - (\S+)$", changes, re.MULTILINE)
    if section is None:
        found.append(f"CHANGELOG.md: has no section '## [{version}] - DATE'")
    if changes.partition("## [Unreleased]")[2].partition("\n## ")[0].strip():
        found.append(f"CHANGELOG.md: Unreleased is not empty; move its entries to {version}")
    if f"\nversion: {version}\n" not in citation:
        found.append(f"CITATION.cff: version is not {version}")
    if section is not None and f"\ndate-released: {section[1]}\n" not in citation:
        found.append(f"CITATION.cff: date-released is not {section[1]}, as in CHANGELOG.md")
    if f"stereo_vio-{version}-py3-none-any.whl" not in readme:
        found.append("README.md: Install names the wheel of another version")
    return found


def main() -> int:
    """Return 0 where only the upload is left to do."""
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    found = problems(ROOT, __version__)
    changed = subprocess.run(
        ["git", "status", "--porcelain"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    if changed.stdout:
        found.append("git: there are changes that are not committed")
    for line in found:
        print(line, file=sys.stderr)
    dist = ROOT / "dist"
    shutil.rmtree(dist, ignore_errors=True)
    shutil.rmtree(ROOT / "build", ignore_errors=True)
    # The wheel is built from the unpacked sdist.
    subprocess.run([sys.executable, "-m", "build", "--outdir", str(dist), str(ROOT)], check=True)
    archives = sorted(map(str, dist.iterdir()))
    subprocess.run([sys.executable, "-m", "twine", "check", "--strict", *archives], check=True)
    if check_wheel.check(dist):
        return 1
    print(
        "not ready: see above"
        if found
        else f"ready: git tag v{__version__} && git push origin v{__version__}"
    )
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
