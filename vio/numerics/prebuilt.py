"""Machine code of the compiled loops in an extension module, so that a run needs neither numba nor
its compiler.

`tools/prebuild.py` writes it beside this file, into a wheel or a checkout. A loop's code is used
only where bytecode and constants of the loop, and of the loops that it calls, are those that it was
made from; where Python and NumPy are those that it was made for; and on processors that have all of
its instructions. Everywhere else numba compiles.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import json
import logging
import os
import platform
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

import numpy as np

from vio.errors import NOTE

log = logging.getLogger(__name__)

FOLDER = Path(__file__).with_name("machine_code")
MANIFEST = "manifest.json"
MODULE = "vio_loops"
_CPU_INFO = Path("/proc/cpuinfo")
# Settings of numba that change no code: with others, numba compiles as they say.
_HARMLESS = {"NUMBA_CACHE_DIR", "NUMBA_NUM_THREADS"}


def environment() -> dict[str, str]:
    """Return what machine code depends on beside loops and processor."""
    return {
        "python": str(sys.implementation.cache_tag),
        "numpy": np.__version__.partition(".")[0],
        "system": f"{sys.platform} {platform.machine()}",
    }


def processor_flags(path: Path = _CPU_INFO) -> frozenset[str]:
    """Return the names of the processor's instruction sets as Linux lists them; elsewhere, the
    machine's name.
    """
    try:
        with path.open(encoding="utf-8") as file:
            listed = next((line for line in file if line.startswith(("flags", "Features"))), ":")
    except OSError:
        return frozenset([platform.node()])
    return frozenset(listed.partition(":")[2].split())


def fingerprint(function: Callable[..., Any], options: Mapping[str, Any]) -> str:
    """Return a hash of a function's bytecode and options, and of the constants and compiled
    functions that it uses.

    Raises:
        AttributeError: it uses a global of another kind.
    """
    digest = hashlib.sha256(
        repr(sorted((name, _text(value)) for name, value in options.items())).encode()
    )
    digest.update(repr(function.__defaults__).encode())
    names = _add_code(function.__code__, digest)
    for name in sorted(names & function.__globals__.keys()):
        digest.update(f"{name} {_text(function.__globals__[name])}\n".encode())
    return digest.hexdigest()


def _add_code(code: CodeType, digest: Any) -> set[str]:
    """Add the bytecode of a function and of those inside it to a hash; return the names that
    they refer to.
    """
    names = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            names |= _add_code(constant, digest)
        else:
            digest.update(repr(constant).encode())
    digest.update(code.co_code + repr((code.co_names, code.co_varnames, code.co_freevars)).encode())
    return names


def _text(value: Any) -> str:
    """Return what a value is, as text that changes with it."""
    if isinstance(value, set):
        return repr(sorted(value))
    if isinstance(value, (bool, int, float, str, tuple, type(None))):
        return repr(value)
    if value is np:
        return "numpy"
    if isinstance(value, type) and issubclass(value, tuple):  # a NamedTuple that is made inside
        return f"{value.__name__}{value._fields}{value._field_defaults}"  # type: ignore[attr-defined]
    return str(value.fingerprint)  # of a compiled function


class _UnusableError(Exception):
    """Why the extension module must not be used."""


@functools.cache
def _extension() -> tuple[ModuleType | None, Mapping[str, Mapping[str, Any]]]:
    """Return the extension module and what its manifest says of each loop; none where it must
    not be used, which a line says where there is one.
    """
    if not FOLDER.is_dir():
        return None, {}
    try:
        return _load_extension()
    except _UnusableError as error:
        log.log(NOTE, "the compiled loops in %s are not used: %s", FOLDER, error)
        return None, {}


def _load_extension() -> tuple[ModuleType, Mapping[str, Mapping[str, Any]]]:
    """Load the extension module.

    Raises:
        _UnusableError: it is for another machine, or damaged.
    """
    changed = [name for name in os.environ if name.startswith("NUMBA_") and name not in _HARMLESS]
    if changed:
        raise _UnusableError(f"{', '.join(sorted(changed))} set, which numba compiles for")
    try:
        manifest = json.loads((FOLDER / MANIFEST).read_bytes())
        loops: Mapping[str, Mapping[str, Any]] = manifest["loops"]
        file = FOLDER / manifest["file"]
        made_for = manifest["environment"]
        lacking = set(manifest["flags"]) - processor_flags()
        is_whole = hashlib.sha256(file.read_bytes()).hexdigest() == manifest["sha256"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise _UnusableError("files are missing or damaged; install again") from error
    if made_for != environment():
        here = " ".join(environment().values())
        raise _UnusableError(f"they are for {' '.join(made_for.values())}, this is {here}")
    if lacking:
        raise _UnusableError(f"this processor has no {' '.join(sorted(lacking))}")
    if not is_whole:
        raise _UnusableError(f"{file.name} is damaged; install again")
    return _import(file), loops


def _import(file: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(MODULE, file)
    assert spec is not None
    assert spec.loader is not None
    try:
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    except ImportError as error:  # it asks for newer libraries
        raise _UnusableError(str(error)) from error
    return module


def is_usable() -> bool:
    """Whether there is an extension module for this machine."""
    return _extension()[0] is not None


def code_of(function: Callable[..., Any], made_from: Callable[[], str]) -> list[Callable[..., Any]]:
    """Return a function's machine code, one for each set of types; none where there is none for it
    as it is now.

    Each raises TypeError, before it computes anything, where its arguments are of other types.

    Args:
        function: the function.
        made_from: returns its fingerprint.
    """
    module, loops = _extension()
    known = loops.get(name_of(function))
    if module is None or known is None:
        return []
    try:
        current = made_from()
    except AttributeError:
        return []
    symbols: Iterable[str] = known["symbols"] if known["fingerprint"] == current else ()
    return [getattr(module, symbol) for symbol in symbols]


def name_of(function: Callable[..., Any]) -> str:
    """Return the name that a function has in the manifest."""
    return f"{function.__module__}.{function.__qualname__}"
