"""SciPy's compiled functions that every run needs, without the packages around them.

`scipy.linalg` and `scipy.special` load 170 modules that nothing here uses, of NumPy's compiler for Fortran among them:
half of SciPy's loading time and 25 MiB.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.machinery import EXTENSION_SUFFIXES, ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from typing import Any

import scipy


def _extension(name: str, wanted: tuple[str, ...], public: str) -> Any:
    """Return SciPy's extension module of a name, or the public module where it has not all that is wanted."""
    if name not in sys.modules:
        path = Path(scipy.__file__).parent.joinpath(*name.split(".")[1:])
        for suffix in EXTENSION_SUFFIXES:
            file = path.with_name(path.name + suffix)
            loader = ExtensionFileLoader(name, str(file))
            spec = spec_from_loader(name, loader)
            if file.is_file() and spec is not None:
                module = module_from_spec(spec)
                loader.exec_module(module)
                return module if all(hasattr(module, function) for function in wanted) else import_module(public)
    return import_module(public)


blas = _extension("scipy.linalg._fblas", ("dtrsm", "dsyrk"), "scipy.linalg.blas")
lapack = _extension("scipy.linalg._flapack", ("dpotrf", "dpotrs", "dsygst", "dsygv"), "scipy.linalg.lapack")
special = _extension("scipy.special._special_ufuncs", ("gammainc", "gammaincinv"), "scipy.special")
