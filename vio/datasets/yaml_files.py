"""Read calibration files in YAML, OpenCV's dialect included, as plain entries, and their numbers
with strict checks.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from vio.errors import CalibrationError
from vio.files.text import text_lines
from vio.files.yaml_text import read_yaml as read_yaml_text
from vio.geometry.distortion import DistortionModel
from vio.geometry.lenses.registry import LENSES
from vio.geometry.lie import FloatArray
from vio.records import ImuDensities

Entries: TypeAlias = Mapping[str, object]

# entries of an IMU's noise, as EuRoC and Kalibr name them, in the order of `ImuDensities`
NOISE_UNITS = {
    "gyroscope_noise_density": "rad / s / sqrt(Hz)",
    "gyroscope_random_walk": "rad / s^2 / sqrt(Hz)",
    "accelerometer_noise_density": "m / s^2 / sqrt(Hz)",
    "accelerometer_random_walk": "m / s^3 / sqrt(Hz)",
}
# 'data:[1, 2]' and 'Viewer.PointSize:2', which OpenCV's reader takes for 'key: value'
_LAX_KEY = re.compile(r"^(\s*(?:- )?[A-Za-z_][\w.\-]*):(?=[^\s:/\\])", re.MULTILINE)
_END_OF_MESSAGE = re.compile(r"^---[ \t]*$", re.MULTILINE)
MAX_BYTES = 1_000_000  # a calibration is some kilobytes; a larger file is another one


def read_yaml_file(path: Path, what: str = "the sensor's calibration") -> dict[str, object]:
    """Read a YAML file of `key: value` lines.

    Raises:
        CalibrationError: the file is missing, too large, no YAML, or uses tags other than OpenCV's.
    """
    if not path.is_file():
        raise CalibrationError(f"{path} is missing; it holds {what}")
    if (size := path.stat().st_size) > MAX_BYTES:
        raise CalibrationError(
            f"{path}: {size} bytes are too many for a calibration; give the right file"
        )
    # OpenCV's writer begins with '%YAML:1.0', which is no YAML directive, and tags its matrices.
    lines = [line for _, line in text_lines(path) if not line.startswith("%YAML")]
    text = "\n".join(lines).replace("!!opencv-matrix", "")
    try:
        entries = _first_message(text)
    except ValueError as error:
        tabs = "character '\\t'" in str(error)
        remedy = "replace tabs by spaces" if tabs else "write plain numbers, or copy it again"
        raise CalibrationError(
            f"{path}: not a YAML file of plain values ({error}); {remedy}"
        ) from error
    if not isinstance(entries, dict):
        raise CalibrationError(
            f"{path}: holds no calibration (expected 'key: value' lines); copy it again"
        )
    return {str(key): value for key, value in entries.items()}


def _first_message(text: str) -> Any:
    """Return the data of a YAML text, or of the first message where `rostopic echo` wrote it, which
    ends each with a line of its own.

    Raises:
        ValueError: it is no YAML, or holds several documents of other entries.
    """
    parts = [part for part in _END_OF_MESSAGE.split(text) if part.strip()]
    if not parts or not _END_OF_MESSAGE.search(text.lstrip()):
        return _strict_or_lax(text)
    first = _strict_or_lax(parts[0])
    if len(parts) == 1:
        return first
    second = _strict_or_lax(parts[1])
    is_alike = (
        isinstance(first, dict) and isinstance(second, dict) and first.keys() == second.keys()
    )
    return first if is_alike else _strict_or_lax(text)


def _strict_or_lax(text: str) -> Any:
    """Return the data of a YAML text, or of one that only OpenCV's lax reader takes.

    Raises:
        ValueError: it is neither; the message is that of strict YAML.
    """
    try:
        return read_yaml_text(text)
    except ValueError:
        lax = _LAX_KEY.sub(r"\1: ", text.replace("\t", "    "))
        if lax == text:
            raise
        try:
            return read_yaml_text(lax)
        except ValueError:
            pass
        raise


def read_json_file(path: Path) -> dict[str, object]:
    """Read a JSON file that holds one object, or a list whose first item is one.

    Raises:
        CalibrationError: the file is missing, too large, or no JSON object.
    """
    if not path.is_file() or path.stat().st_size > MAX_BYTES:
        raise CalibrationError(f"{path}: is missing or too large for a calibration")
    try:
        entries = json.loads("\n".join(line for _, line in text_lines(path)))
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path}: not a JSON file ({error}); copy it again") from error
    if isinstance(entries, list) and entries and isinstance(entries[0], dict):
        entries = entries[0]  # of cuVSLAM's scenes, which are lists
    if not isinstance(entries, dict):
        raise CalibrationError(f"{path}: holds no calibration (expected a JSON object)")
    return {str(key): value for key, value in entries.items()}


def section(entries: Entries, key: str, where: str) -> dict[str, Any]:
    """Return a nested block.

    Raises:
        CalibrationError: it is missing or no block.
    """
    value = entries.get(key)
    if not isinstance(value, dict):
        raise CalibrationError(f"{where}: has no block '{key}:'; copy the calibration again")
    return {str(k): v for k, v in value.items()}


def lens_model(name: object, where: Path | str) -> DistortionModel:
    """Return the lens model of a distortion that a calibration names.

    Raises:
        CalibrationError: the name is not known.
    """
    known = {word: model for model, lens in LENSES.items() for word in lens.files.distortion}
    if (model := known.get(str(name).lower())) is None:
        words = ", ".join(word for word in known if word)
        raise CalibrationError(f"{where}: distortion_model {name!r} is not read; known: {words}")
    return model


def tool_lens(
    tool: str,
    name: object,
    where: Path | str,
    others: Mapping[str, tuple[DistortionModel, tuple[str, ...]]] | None = None,
) -> tuple[DistortionModel, tuple[str, ...]]:
    """Return the lens model that a tool's file names, and the names of its coefficients there, of
    which an empty one is a zero.

    Args:
        tool: as `ToolForm.tool`.
        name: in the file, in any case.
        where: the file and the entry, for messages.
        others: further names that the tool's files have, with what is returned for them.

    Raises:
        CalibrationError: the name is not known.
    """
    known = dict(others or {})
    known |= {
        form.name: (lens.name, form.coefficients)
        for lens in LENSES.values()
        for form in lens.files.tools
        if form.tool == tool
    }
    found = known.get(str(name).lower())
    if found is None:
        raise CalibrationError(
            f"{where}: the lens model {name!r} is not read; calibrate with {', '.join(known)}"
        )
    return found


def as_number(value: object) -> float:
    """Parse a number from YAML or csv (PyYAML reads 1e-3 as text); NaN where it is none."""
    try:
        return float(value) if isinstance(value, (int, float, str)) else float("nan")
    except (ValueError, OverflowError):
        return float("nan")


def numbers(
    entries: Entries, key: str, where: Path | str, count: int | None = None
) -> tuple[float, ...]:
    """Return a list of finite numbers, or a single one as a list.

    Raises:
        CalibrationError: the entry is missing, or is not `count` finite numbers.
    """
    if key not in entries:
        raise CalibrationError(f"{where}: has no entry '{key}'; copy the calibration again")
    value = entries[key]
    found = tuple(as_number(v) for v in (value if isinstance(value, list) else [value]))
    if (count is not None and len(found) != count) or not np.all(np.isfinite(found)):
        wanted = "finite numbers" if count is None else f"{count} finite number{'s' * (count > 1)}"
        raise CalibrationError(f"{where}: '{key}' is {value!r} instead of {wanted}")
    return found


def imu_densities(entries: Entries, where: Path | str) -> ImuDensities | None:
    """Return the noise densities of an IMU; None where none is given.

    Raises:
        CalibrationError: some are missing, or not positive.
    """
    if not any(key in entries for key in NOISE_UNITS):
        return None
    values = [numbers(entries, key, where, 1)[0] for key in NOISE_UNITS]
    for key, value in zip(NOISE_UNITS, values, strict=True):
        if not value > 0:
            raise CalibrationError(f"{where}: {key} is {value:g}; a noise density must be positive")
    return ImuDensities(*values)


def densities_text(noise: ImuDensities, *, units: bool) -> str:
    """Return the entries of an IMU's noise, with all digits, and `units` as comments."""
    values = (noise.gyro, noise.gyro_walk, noise.accel, noise.accel_walk)
    lines = zip(NOISE_UNITS.items(), values, strict=True)
    return "".join(
        f"{key}: {value!r}{f'  # [ {unit} ]' if units else ''}\n" for (key, unit), value in lines
    )


def matrix(value: object, shape: tuple[int, int] | None, where: str) -> FloatArray:
    """Return a matrix given as rows, as a flat list, or as OpenCV's block of `rows`, `cols` and
    `data`.

    Args:
        value: the entry.
        shape: expected rows and columns; None: any, as stated by the block or the rows.
        where: names the file and the entry, for the message.

    Raises:
        CalibrationError: it holds other counts, or a value is not a finite number.
    """
    stated, values = _stated_shape(value)
    found = np.array([as_number(x) for x in values])
    size = shape or stated or (1, len(found))
    if len(found) != size[0] * size[1] or not np.isfinite(found).all():
        raise CalibrationError(
            f"{where} holds {len(found)} values, expected {size[0]} x {size[1]} finite numbers"
        )
    return found.reshape(size)


def count_numbers(value: object) -> int:
    """Return how many values an entry has that `matrix` reads."""
    return len(_stated_shape(value)[1])


def _stated_shape(value: object) -> tuple[tuple[int, int] | None, list[Any]]:
    """Return the rows and columns that an entry states (None: it does not), and its values in one
    list.
    """
    stated: tuple[int, int] | None = None
    if isinstance(value, dict):
        rows = as_number(value.get("rows"))
        cols = as_number(value.get("cols", value.get("columns")))
        if min(rows, cols) >= 1:
            stated = (int(rows), int(cols))
        value = value.get("data")
    if not isinstance(value, list):
        return stated, [value]
    if value and all(isinstance(row, list) for row in value):
        return stated or (len(value), len(value[0])), [x for row in value for x in row]
    return stated, value
