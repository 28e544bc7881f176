"""Front ends and detectors of the caller's own."""

from __future__ import annotations

import importlib.util
import inspect
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np

from vio.errors import ConfigError, DataError
from vio.frontend.detect import cell_index, grid_shape, min_distance_px
from vio.frontend.settings import FrontendSettings, GridSettings
from vio.frontend.tracks import ANCHOR_REACH_PX
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.protocols import Detector, Frontend
from vio.records import BoolArray, Image

_BORDER_PX = ANCHOR_REACH_PX + 4  # from the image's edge; the template of a corner needs so much
_MAX_IN_CELL = 8  # corners that are added in one cell of the grid


def as_frontend(
    given: Frontend | Detector, camera: StereoCamera, settings: FrontendSettings
) -> Frontend:
    """Return a front end itself, and a detector with tracking and stereo matching by `klt`.

    Args:
        given: an object with `process`, or with `detect`.
        camera: the rectified camera or pair.
        settings: of the front end `klt`, for a detector.

    Raises:
        ConfigError: it has neither method, or is a class instead of an object.
    """
    if isinstance(given, type):
        raise ConfigError(
            f"{given.__name__} is a class; give an object of it, such as {given.__name__}(camera)"
        )
    if callable(getattr(given, "process", None)):
        _check_process(given)
        return given  # type: ignore[return-value]
    if isinstance(given, Detector):
        from vio.frontend.klt import KltFrontend

        return KltFrontend(camera, settings, detector=given)
    raise ConfigError(
        f"{type(given).__name__} is no front end and no detector; a front end has "
        "process(frame, prior) -> FrontendOutput, a detector detect(image) -> corners (K, 2)"
    )


def _check_process(given: object) -> None:
    """Raise where `process` does not take a frame and a prior."""
    process = given.process  # type: ignore[attr-defined]
    try:
        inspect.signature(process).bind(None, None)
    except TypeError as error:
        raise ConfigError(
            f"{type(given).__name__}.process() cannot be called with a frame and a prior "
            f"({error}); define it as process(self, frame, prior=None)"
        ) from error
    except ValueError:  # of a class made in C
        return


def build_given(
    build: Callable[..., object],
    camera: StereoCamera,
    settings: FrontendSettings | None = None,
) -> Frontend:
    """Return the front end that a class or function of the caller's own makes.

    Args:
        build: called with the camera, or with nothing where it takes no argument; returns a front
            end or a detector.
        camera: the rectified camera or pair.
        settings: of the front end `klt`, for a detector; None: the defaults.

    Raises:
        ConfigError: it cannot be called so, or what it returns has neither method.
    """
    settings = FrontendSettings() if settings is None else settings
    if not callable(build):
        raise ConfigError(
            f"a {type(build).__name__} cannot be called; give a class or function that takes the "
            "camera and returns a front end or a detector"
        )
    name = getattr(build, "__name__", type(build).__name__)
    try:
        signature = inspect.signature(build)
    except ValueError:  # of a class made in C
        return as_frontend(build(camera), camera, settings)  # type: ignore[arg-type]
    for arguments in ((camera,), ()):
        try:
            signature.bind(*arguments)
        except TypeError:
            continue
        return as_frontend(build(*arguments), camera, settings)  # type: ignore[arg-type]
    raise ConfigError(
        f"{name}{signature} is called with the camera alone; give the others defaults"
    )


def load_given(text: str, camera: StereoCamera, settings: FrontendSettings) -> Frontend:
    """Return the front end or detector that `FILE.py:NAME` or `package.module:NAME` names.

    A module is searched in the environment, then in the working folder.

    Raises:
        ConfigError: there is no such file, module or name, or it makes no front end.
    """
    place, _, name = text.rpartition(":")
    if not place or not name.isidentifier():
        raise ConfigError(f"--frontend {text}: give FILE.py:CLASS or package.module:CLASS")
    module = _module_of_file(Path(place)) if place.endswith(".py") else _module_named(place)
    build = getattr(module, name, None)
    if build is None:
        raise ConfigError(f"--frontend {text}: {place} has no {name}")
    return build_given(build, camera, settings)


def _module_of_file(path: Path) -> ModuleType:
    if not path.is_file():
        raise ConfigError(f"--frontend {path}: there is no such file")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules.setdefault(path.stem, module)  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
    except (ImportError, SyntaxError) as error:
        raise ConfigError(f"--frontend {path}: cannot be imported ({error})") from error
    return module


def _module_named(name: str) -> ModuleType:
    here = str(Path.cwd())
    sys.path.append(here)
    try:
        return import_module(name)
    except (ImportError, SyntaxError) as error:
        raise ConfigError(
            f"--frontend {name}: cannot be imported ({error}); it is searched in the environment "
            "and in the working folder"
        ) from error
    finally:
        sys.path.remove(here)


def given_corners(
    detector: Detector,
    image: Image,
    occupied: FloatArray,
    wanted: int,
    grid: GridSettings,
    allowed: BoolArray | None = None,
) -> FloatArray:
    """Return up to `wanted` of a detector's corners (K, 2), best first, where no feature is.

    They keep the least distance between features, and no cell of the grid takes more than a few.

    Args:
        detector: finds corners, the best first.
        image: (H, W).
        occupied: tracked points (N, 2).
        wanted: largest number of corners.
        grid: number of features.
        allowed: mask (H/2, W/2) of pixels that may be corners; None: all.

    Raises:
        DataError: what the detector returns is not an array (K, 2) of finite pixels of the image.
    """
    if wanted <= 0:
        return np.zeros((0, 2))
    found = _checked(detector, detector.detect(image), image)
    height, width = image.shape
    border = np.array([_BORDER_PX, _BORDER_PX])
    good = np.all((found >= border) & (found < [width, height] - border), axis=1)
    if allowed is not None:
        column, row = np.minimum(found.astype(np.int64) // 2, np.array(allowed.shape)[::-1] - 1).T
        good &= allowed[row, column]
    corners = np.ascontiguousarray(found[good])
    return corners[_spread(corners, occupied, wanted, image, grid)]


def _checked(detector: Detector, found: object, image: Image) -> FloatArray:
    """Return what a detector found as an array (K, 2)."""
    name = type(detector).__name__
    try:
        corners = np.asarray(found, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(
            f"{name}.detect() returned a {type(found).__name__}; it returns corners (K, 2) [u v]"
        ) from error
    if corners.size == 0:
        return np.zeros((0, 2))
    if corners.ndim != 2 or corners.shape[1] != 2 or not np.isfinite(corners).all():
        raise DataError(
            f"{name}.detect() returned an array {corners.shape}; it returns finite corners (K, 2), "
            "[u v] in pixels, best first"
        )
    height, width = image.shape
    if np.any((corners < -0.5) | (corners > [width - 0.5, height - 0.5])):
        raise DataError(
            f"{name}.detect() returned corners outside of the image of {width} x {height} pixels; "
            "each is [u v]: column, row"
        )
    return corners


def _spread(
    corners: FloatArray, occupied: FloatArray, wanted: int, image: Image, grid: GridSettings
) -> BoolArray:
    """Return the mask (K,) of the corners to add, in their order."""
    height, width = image.shape
    distance = min_distance_px(width, height, grid) - 1
    shape = grid_shape(width, height, grid)
    cell = cell_index(corners, width, height, shape)
    room = np.full(shape[0] * shape[1], _MAX_IN_CELL)
    taken = np.zeros(image.shape, dtype=np.bool_)
    chosen = np.zeros(len(corners), dtype=np.bool_)

    def take(u: int, v: int) -> None:
        rows = slice(max(v - distance, 0), v + distance + 1)
        columns = slice(max(u - distance, 0), u + distance + 1)
        taken[rows, columns] = True

    for u, v in np.rint(occupied).astype(np.int64).tolist():
        take(u, v)
    for k, (u, v) in enumerate(np.rint(corners).astype(np.int64).tolist()):
        if taken[v, u] or not room[cell[k]]:
            continue
        take(u, v)
        chosen[k] = True
        room[cell[k]] -= 1
        if chosen.sum() == wanted:
            break
    return chosen
