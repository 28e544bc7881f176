"""The numbers of a rectified pair by their names: `fx fy cx cy` in pixels and `baseline`.

YAML, JSON or lines `fx: 700` or `fx = 700`; names in small or capital letters, in one block or in
several, as Cityscapes' `intrinsic: {fx fy u0 v0}` and `extrinsic: {baseline}`. Without `fy`, it is
`fx`. `cx1` is that of the right camera. The baseline is in metres, or in the unit that ends its
name (`baseline_mm`). The size may be stated as `width height`. Distortions are refused: raw images
have no baseline alone.
Reference: the description of Cityscapes' camera files; `stereodemo_calibration.json` of stereodemo.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from vio.cameras.rig import Rig
from vio.datasets.common import image_size, naming
from vio.datasets.rigs.plausible import baseline_doubt, checked_rig
from vio.datasets.rigs.source import Source, no_image_size
from vio.datasets.yaml_files import Entries, as_number
from vio.errors import CalibrationError
from vio.files.text import text_lines
from vio.geometry.lie import se3_from_parts

_NAMES: dict[str, tuple[str, ...]] = {
    "fu": ("fx", "fu", "f", "focal", "focal_length", "focal_length_px", "fl_x"),
    "fv": ("fy", "fv", "fl_y"),
    "cu": ("cx", "cu", "cx0", "u0", "ppx"),
    "cv": ("cy", "cv", "cy0", "v0", "ppy"),
    "cu1": ("cx1", "cx_right"),
    "width": ("width", "w", "image_width"),
    "height": ("height", "h", "image_height"),
}
_BASELINES = {
    "baseline": 1.0, "baseline_m": 1.0, "baseline_meters": 1.0, "baseline_metres": 1.0,
    "baseline_cm": 1e-2, "baseline_mm": 1e-3,
}  # fmt: skip
_DISTORTION = re.compile(r"[kp]\d|dist(ortion)?(_coeff(icient)?s)?")
_LINE = re.compile(r"\s*(\w+)\s*[:=]\s*(\S+)\s*")


def read_lines(path: Path) -> dict[str, object]:
    """Return the lines `name: value` and `name = value` of a text file."""
    found = (_LINE.fullmatch(line.split("#")[0]) for _, line in text_lines(path))
    return {line[1]: line[2] for line in found if line is not None}


def is_rectified_pair(path: Path) -> bool:
    """Return whether a text file has such lines."""
    return matches(read_lines(path))


def matches(entries: Entries) -> bool:
    """Return whether entries name a focal length, a principal point and a baseline."""
    return _named(entries).keys() >= {"fu", "cu", "cv"} and _baseline(entries) is not None


def read(source: Source) -> Rig:
    """Read the pair.

    Raises:
        CalibrationError: a number is impossible, a distortion is stated, or no size of the images
            is stated or given.
    """
    where = source.where
    named = _named(source.entries)
    baseline = _baseline(source.entries)
    assert baseline is not None
    baseline_m, unit_stated = baseline
    if lens := _distortions(source.entries):
        raise CalibrationError(
            f"{where}: states a distortion ({', '.join(lens)}) and a baseline alone, which is that of "
            "rectified images; take the distortion out where they are, or give the pair's R and T too"
        )
    size = source.image_size
    size_stated = named.keys() >= {"width", "height"}
    if size_stated:
        size = image_size([named["width"], named["height"]], where)
    if size is None:
        raise no_image_size(source.path)
    fu = named["fu"]
    fv = named.get("fv", fu)
    cu = named["cu"]
    cu1 = named.get("cu1", cu)
    with naming(where):
        rig = Rig.rectified(fu, fv, cu, named["cv"], baseline_m, *size)
        if cu1 != cu:
            right = Rig.rectified(fu, fv, cu1, named["cv"], baseline_m, *size).cam0
            rig = Rig(rig.cam0, right, se3_from_parts(np.eye(3), [-baseline_m, 0.0, 0.0]))
    rig = checked_rig(rig, where, size_stated=size_stated)
    doubt = None if unit_stated else baseline_doubt(baseline_m, where)
    return rig if doubt is None else rig.noting(doubt)


def _named(entries: Entries) -> dict[str, float]:
    """Return the finite numbers of entries by our names."""
    numbers = _numbers(entries)
    return {
        key: numbers[name]
        for key, names in _NAMES.items()
        for name in reversed(names)
        if name in numbers
    }


def _baseline(entries: Entries) -> tuple[float, bool] | None:
    """Return the baseline in metres, and whether its name states the unit; None: there is none."""
    numbers = _numbers(entries)
    found = next((name for name in _BASELINES if name in numbers), None)
    return None if found is None else (_BASELINES[found] * numbers[found], found != "baseline")


def _numbers(entries: Entries) -> dict[str, float]:
    """Return the finite numbers of entries and of their blocks, by names in small letters."""
    numbers = dict[str, float]()
    for name, value in _flat(entries):
        number = as_number(value)
        if np.isfinite(number):
            numbers.setdefault(name, number)
    return numbers


def _distortions(entries: Entries) -> list[str]:
    """Return the names of coefficients of a lens that are not all zero."""
    return [
        name
        for name, value in _flat(entries)
        if _DISTORTION.fullmatch(name)
        and any(as_number(item) != 0 for item in (value if isinstance(value, list) else [value]))
    ]


def _flat(entries: Entries) -> list[tuple[str, object]]:
    """Return entries, and those of their blocks, by names in small letters."""
    flat = list[tuple[str, object]]()
    for name, value in entries.items():
        inner: Mapping[object, object] = value if isinstance(value, dict) else {name: value}
        flat += [(str(key).lower(), item) for key, item in inner.items()]
    return flat
