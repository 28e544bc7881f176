"""Compile the loops ahead of the first run: into the wheel, or for a checkout.

python -m tools.prebuild dist     # beside the wheel in dist/, write one for this Python on Linux x86-64
python -m tools.prebuild          # fill numba's cache of this checkout, for its first run
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from vio.numerics import prebuilt

# Recordings of a second or two, small enough that nearly all of the time goes into compiling.
_RENDERED = {
    "flight": "--rig small --width 320 --rate 10 --duration 3 --format euroc",
    "drive": "--scene street --trajectory car --width 320 --duration 0.8",
    "depth": "--rig small --width 320 --rate 10 --duration 0.8 --format rgbd",
}
_COMMANDS = (
    "run flight --map flight.map --out mapped",
    "localise flight --map flight.map --out localised",
    "run flight --no-plot --out landmarks --set msckf.calibrate_stereo=off --set msckf.calibrate_camera_imu=both",
    "run flight --no-plot --out cylinder --set dataset.projection=cylinder --stop 10",
    "run flight --no-plot --out mono --camera left",
    "run drive --out driven",
    "run depth --no-plot --out depths",
)
_TAG = f"cp{sys.version_info[0]}{sys.version_info[1]}-none-manylinux_2_17_x86_64"


def compile_loops() -> None:
    """Run small recordings, so that all loops of usual runs are compiled; results are thrown away."""
    from vio.cli import main as vio

    with tempfile.TemporaryDirectory() as folder, redirect_stdout(sys.stderr):
        for name, options in _RENDERED.items():
            _check(vio(["render", "--out", f"{folder}/{name}", *options.split(), "--workers", "1"]))
        before = os.getcwd()
        os.chdir(folder)
        for command in _COMMANDS:
            _check(vio(command.split()))
        os.chdir(before)


def _check(status: int) -> None:
    if status:
        raise RuntimeError("a recording could not be processed: see above")


def compiled_loops() -> list[Any]:
    """Return the loops of this process."""
    from numba.core.dispatcher import Dispatcher

    modules = [(name, module) for name, module in sorted(sys.modules.items()) if name.partition(".")[0] == "vio"]
    found = [(name, f) for name, module in modules for f in vars(module).values() if isinstance(f, Dispatcher)]
    return [loop for name, loop in found if loop.py_func.__module__ == name]


def write_code(folder: Path, loops: Iterable[Any]) -> None:
    """Write the machine code of loops that this process has compiled, and its manifest, into a new folder."""
    from numba.core.serialize import dumps

    folder.mkdir(parents=True)
    places: dict[str, dict[str, tuple[int, int, str]]] = {}
    with open(folder / prebuilt.CODE, "wb") as file:
        for loop in loops:
            for signature, result in loop.overloads.items():
                parts = list(result._reduce())
                parts[6] = ""  # types as text, for printing
                code: bytes = dumps(tuple(parts))  # type: ignore[no-untyped-call]
                place = file.tell(), len(code), hashlib.sha256(code).hexdigest()
                places.setdefault(prebuilt.name_of(loop.py_func), {})[str(signature)] = place
                file.write(code)
    manifest = {"environment": prebuilt.environment(), "sources": prebuilt.source_hash(), "loops": places}
    (folder / prebuilt.MANIFEST).write_text(json.dumps(manifest, indent=1), encoding="utf-8")


def write_wheel(plain: Path) -> Path:
    """Write a wheel with machine code beside one without, and return it."""
    name, version, *_ = plain.name.split("-")
    made = plain.with_name(f"{name}-{version}-{_TAG}.whl")
    with tempfile.TemporaryDirectory() as temporary:
        site, code = Path(temporary) / "site", Path(temporary) / "code"
        with zipfile.ZipFile(plain) as archive:
            archive.extractall(site)
        environment = os.environ | {
            "PYTHONPATH": str(site),
            "NUMBA_CACHE_DIR": f"{temporary}/cache",
            "NUMBA_CPU_NAME": prebuilt.CPU_NAME,
            "NUMBA_CPU_FEATURES": prebuilt.FEATURES,
            "NUMBA_DISABLE_INTEL_SVML": "1",
        }
        subprocess.run([sys.executable, __file__, "--write", str(code)], env=environment, check=True)
        target = site / "vio" / "numerics" / prebuilt.FOLDER.name
        code.rename(target)
        info = f"{name}-{version}.dist-info"
        header = site / info / "WHEEL"
        text = header.read_text(encoding="utf-8").replace("Tag: py3-none-any", f"Tag: {_TAG}")
        header.write_text(text.replace("Root-Is-Purelib: true", "Root-Is-Purelib: false"), encoding="utf-8")
        record = f"{info}/RECORD"
        lines = []
        with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in sorted(p for p in site.rglob("*") if p.is_file()):
                inside, content = path.relative_to(site).as_posix(), path.read_bytes()
                if inside == record or "__pycache__" in inside:
                    continue
                digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
                lines.append(f"{inside},sha256={digest},{len(content)}\n")
                _add(archive, inside, content)
            _add(archive, record, "".join([*lines, f"{record},,\n"]).encode())
    return made


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    """Add a file that everybody may read; without a date, so that equal files give equal wheels."""
    entry = zipfile.ZipInfo(name)
    entry.external_attr, entry.compress_type = 0o644 << 16, zipfile.ZIP_DEFLATED
    archive.writestr(entry, content)


def main(argv: list[str]) -> int:
    """Compile for a wheel or a checkout."""
    if argv[:1] == ["--write"]:
        compile_loops()
        write_code(Path(argv[1]), compiled_loops())
    elif argv:
        (plain,) = Path(argv[0]).glob("*-py3-none-any.whl")
        print(write_wheel(plain))
    else:
        compile_loops()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
