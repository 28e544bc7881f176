"""The few compiled functions of SciPy that every run needs, without the packages around them.

`import scipy.special` or `import scipy.linalg` runs SciPy's support of other array libraries, which
costs more time than all else that a short run imports. The extension modules alone need none of it.
They are those that the packages import, too, whichever comes first, so results are the same to the
bit.
"""

from __future__ import annotations

import importlib
import importlib.machinery
import importlib.util
import sys
from pathlib import Path
from types import ModuleType


def _extension(package: str, name: str, functions: tuple[str, ...]) -> ModuleType:
    """Return an extension module of a package of SciPy that has some functions.

    Where a version of SciPy keeps them elsewhere, that is the package itself.
    """
    whole = f"scipy.{package}"
    full_name = f"{whole}.{name}"
    if whole not in sys.modules:
        module = _alone(package, full_name)
        if all(hasattr(module, function) for function in functions):
            assert module is not None
            return module
    return importlib.import_module(_PUBLIC[name])


def _alone(package: str, full_name: str) -> ModuleType | None:
    """Load an extension module without the packages around it; None: it is not there, or needs
    them.
    """
    scipy = importlib.util.find_spec("scipy")
    folders = None if scipy is None else scipy.submodule_search_locations
    if not folders:
        return None
    folder = str(Path(folders[0]) / package)
    spec = importlib.machinery.PathFinder.find_spec(full_name, [folder])
    if spec is None or spec.loader is None:
        return None
    try:
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    except ImportError:
        return None
    return module


_PUBLIC = {
    "_flapack": "scipy.linalg.lapack",
    "_special_ufuncs": "scipy.special",
}
lapack = _extension("linalg", "_flapack", ("dpotrf", "dpotrs", "dpstrf", "dsygst", "dtrtrs"))
special = _extension("special", "_special_ufuncs", ("gammainc", "gammaincinv"))
