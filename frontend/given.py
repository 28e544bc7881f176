"""Front ends and detectors of the caller's own."""

from __future__ import annotations

import importlib.util
import inspect
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType

from vio.errors import ConfigError, DataError
from vio.frontend.settings import FrontendSettings
from vio.geometry.stereo import StereoCamera
from vio.protocols import Detector, Frontend
from vio.records import FrontendOutput, Observations, StereoFrame


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


def checked_output(frontend: Frontend, output: object, frame: StereoFrame) -> FrontendOutput:
    """Return what a front end returned for a frame, where it is an output of that frame.

    Raises:
        DataError: it is something else.
    """
    name = f"{type(frontend).__name__}.process()"
    if not isinstance(output, FrontendOutput):
        raise DataError(
            f"{name} returned a {type(output).__name__}; it returns a FrontendOutput(observations)"
        )
    found = output.observations
    if not isinstance(found, Observations):
        raise DataError(
            f"{name} returned a FrontendOutput whose observations are a {type(found).__name__}; "
            "make them with vio.records.observations(frame.index, frame.time_ns, ids, z)"
        )
    if (found.frame_index, found.time_ns) != (frame.index, frame.time_ns):
        raise DataError(
            f"{name} returned observations of frame {found.frame_index} for frame {frame.index}"
        )
    return output


def load_given(text: str, camera: StereoCamera, settings: FrontendSettings) -> Frontend:
    """Return the front end or detector that `FILE.py:NAME` or `package.module:NAME` names.

    A module is searched in the environment, then in the working folder.

    Raises:
        ConfigError: there is no such file, module or name, or it makes no front end.
    """
    place, _, name = text.rpartition(":")
    if not place or not name.isidentifier():
        raise ConfigError(f"--frontend {text}: give FILE.py:CLASS or package.module:CLASS")
    if place.endswith(".py"):
        module = _module_of_file(Path(place))
    else:
        module = _module_named(place)
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
