"""Boards to calibrate with: AprilGrid, ChArUco and checkerboard, and the files that describe them.

The board's frame: x right, y down and z into the paper as printed, the origin in the top-left
corner of the pattern (of the top-left tag, or of the first square). Kalibr counts tags from the
bottom left, row by row; its tags have a border of two bits and are turned by 180 degrees against
those of OpenCV's dictionary.
References: Olson, AprilTag (2011); Wang & Olson, AprilTag 2 (2016), for 36h11; the page "calibration
targets" of Kalibr's documentation; OpenCV's `calibration.cpp` sample; BoofCV's
`ConfigCalibrationTarget`.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.datasets.rigs.opencv import read_entries
from vio.datasets.yaml_files import as_number, read_yaml_file
from vio.errors import CalibrationError
from vio.geometry.lie import FloatArray
from vio.records import IntArray

Kind: TypeAlias = Literal["aprilgrid", "charuco", "checkerboard"]
Bits: TypeAlias = npt.NDArray[np.bool_]

APRILTAG = "DICT_APRILTAG_36h11"
_KALIBR_BORDER_BITS = 2
_CHARUCO_BORDER_BITS = 1
_FAMILY_KEYS = (
    "dictionary",
    "tagFamily",
    "family",
)  # by which other tools name an AprilGrid's tags
UNIT_SQUARE: FloatArray = np.array(  # corners (4, 2) in order
    [
        [0.0, 0.0],
        [1.0, 0.0],
        [1.0, 1.0],
        [0.0, 1.0],
    ]
)
MAX_SIZE_M = 1.0  # of a tag or square; a larger value is in millimetres
MAX_COUNT = 100  # tags or squares along a side
KNOWN = (
    "Kalibr's YAML (target_type: aprilgrid or checkerboard), one of a ChArUco board "
    "(target_type: charuco), OpenCV's calibration settings, BoofCV's target, or the YAML that "
    "vio target writes"
)


@dataclass(frozen=True, slots=True)
class Marker:
    """A coded square of a board."""

    id: int
    corners_m: FloatArray  # (4, 2) top left, top right, bottom right, bottom left as printed
    is_dark: Bits  # (M, M) modules with the border, rows from the top as printed


@dataclass(frozen=True, slots=True)
class Target:
    """A printed board; see the module for its frame."""

    kind: Kind
    rows: int  # of tags, or of squares
    cols: int
    size_m: float  # side of a tag with its border, or of a square
    # gap between tags over `size_m` (AprilGrid), or a marker's side over `size_m` (ChArUco)
    ratio: float = 0.0
    dictionary: str = APRILTAG  # OpenCV's name
    first_id: int = 0
    legacy: bool = False  # ChArUco before OpenCV 4.6: boards with even rows begin with a marker

    def __post_init__(self) -> None:
        least = 1 if self.kind == "aprilgrid" else 3
        if not (least <= self.rows <= MAX_COUNT and least <= self.cols <= MAX_COUNT):
            raise CalibrationError(
                f"a {self.kind} of {self.cols} x {self.rows} cannot be used; give {least} to "
                f"{MAX_COUNT} along a side"
            )
        if not 0 < self.size_m <= MAX_SIZE_M:
            raise CalibrationError(
                f"the {'tag' if self.kind == 'aprilgrid' else 'square'}'s side is "
                f"{self.size_m:g} m; measure it on the print and give it in metres (--size)"
            )
        if self.kind != "checkerboard" and not 0 < self.ratio < 1:
            name = "tagSpacing" if self.kind == "aprilgrid" else "marker side / square side"
            raise CalibrationError(
                f"{name} is {self.ratio:g}; it is a ratio of lengths between 0 and 1"
            )

    @property
    def pitch_m(self) -> float:
        """Distance from a tag or square to the next one."""
        if self.kind == "aprilgrid":
            return self.size_m * (1 + self.ratio)
        return self.size_m

    @property
    def border_bits(self) -> int:
        """Width of a marker's dark border in modules."""
        return _KALIBR_BORDER_BITS if self.kind == "aprilgrid" else _CHARUCO_BORDER_BITS

    @property
    def extent_m(self) -> tuple[float, float]:
        """Width and height of the pattern: from the first to the last tag, or of all squares."""
        gap = self.pitch_m - self.size_m
        return self.cols * self.pitch_m - gap, self.rows * self.pitch_m - gap

    @property
    def points_m(self) -> FloatArray:
        """Corners (N, 2) on the board; their numbers are the ids of detected corners.

        AprilGrid: four of each tag (top left, top right, bottom right, bottom left), tag by tag.
        Others: the inner corners of the squares, row by row from the top left.
        """
        if self.kind == "aprilgrid":
            return np.concatenate([self._tag_corners(n) for n in range(self.rows * self.cols)])
        down, right = np.mgrid[1 : self.rows, 1 : self.cols]
        return self.size_m * np.column_stack([right.ravel(), down.ravel()]).astype(np.float64)

    def _tag_corners(self, number: int) -> FloatArray:
        """Corners (4, 2) of the tag with a number, counted from the bottom left."""
        from_bottom, col = divmod(number, self.cols)
        row = self.rows - 1 - from_bottom
        return self.pitch_m * np.array([col, row]) + self.size_m * UNIT_SQUARE

    def markers(self) -> list[Marker]:
        """Return the coded squares; none on a checkerboard."""
        return [
            Marker(self.first_id + n, found, self.modules_of(self.first_id + n))
            for n, found in enumerate(self.marker_corners())
        ]

    def symmetries(self) -> tuple[IntArray, ...]:
        """Return the orders (N,) of `points_m` in which the board, turned, looks as it is; the first
        is that of its frame. A checkerboard alone has others.
        """
        points = np.arange(len(self.points_m))
        if self.kind != "checkerboard":
            return (points,)
        grid = points.reshape(self.rows - 1, self.cols - 1)
        quarters: tuple[int, ...] = (0,)
        if self.rows == self.cols and self.rows % 2 == 1:
            quarters = (0, 1, 2, 3)
        elif (self.rows + self.cols) % 2 == 0:
            quarters = (0, 2)
        return tuple(np.rot90(grid, quarter).ravel() for quarter in quarters)

    def marker_corners(self) -> list[FloatArray]:
        """Return the corners (4, 2) of the coded squares, in the order of their numbers."""
        if self.kind == "checkerboard":
            return []
        if self.kind == "aprilgrid":
            return [self._tag_corners(n) for n in range(self.rows * self.cols)]
        inset = 0.5 * self.size_m * (1 - self.ratio)
        side = self.ratio * self.size_m
        marker = side * UNIT_SQUARE + inset
        corners = []
        for row in range(self.rows):
            for col in range(self.cols):
                if not self.square_is_dark(row, col):
                    square_at = self.size_m * np.array([col, row])
                    corners.append(marker + square_at)
        return corners

    def square_is_dark(self, row: int, col: int) -> bool:
        """Return whether a square of a ChArUco or checkerboard is dark, counted from the top
        left.
        """
        flipped = self.kind == "charuco" and self.legacy and self.rows % 2 == 0
        return (row + col + flipped) % 2 == 0

    def modules_of(self, number: int) -> Bits:
        """Return which modules (M, M) of the marker with an id are dark.

        Raises:
            CalibrationError: the dictionary has no such marker.
        """
        import cv2

        dictionary = marker_dictionary(self.dictionary)
        if not 0 <= number < len(dictionary.bytesList):
            raise CalibrationError(
                f"{self.dictionary} has {len(dictionary.bytesList)} markers, and the board needs "
                f"number {number}; choose a larger dictionary or a smaller board"
            )
        side = int(dictionary.markerSize) + 2 * self.border_bits
        drawn = cv2.aruco.generateImageMarker(dictionary, number, side, borderBits=self.border_bits)
        is_dark = np.asarray(drawn) < 128
        return np.rot90(is_dark, 2) if self.kind == "aprilgrid" else is_dark

    def dark_rectangles(self) -> FloatArray:
        """Return what is printed dark: rectangles (N, 4) of left, top, right, bottom, metres."""
        out: list[tuple[float, float, float, float]] = []
        for marker in self.markers():
            left, top = marker.corners_m[0]
            module = (marker.corners_m[1, 0] - left) / len(marker.is_dark)
            for row, dark in enumerate(marker.is_dark):
                for first, last in _runs(dark):
                    out.append(
                        (
                            left + module * first,
                            top + module * row,
                            left + module * last,
                            top + module * (row + 1),
                        )
                    )
        if self.kind == "aprilgrid":
            gap = self.pitch_m - self.size_m
            for row in range(self.rows + 1):
                for col in range(self.cols + 1):
                    left = col * self.pitch_m - gap
                    top = row * self.pitch_m - gap
                    out.append((left, top, left + gap, top + gap))
            return np.array(out)
        for row in range(self.rows):
            for col in range(self.cols):
                if self.square_is_dark(row, col):
                    left = col * self.size_m
                    top = row * self.size_m
                    out.append((left, top, left + self.size_m, top + self.size_m))
        return np.array(out)

    def __str__(self) -> str:
        one = "tags" if self.kind == "aprilgrid" else "squares"
        return f"{self.kind} of {self.cols} x {self.rows} {one} of {1e3 * self.size_m:g} mm"


def _runs(values: Bits) -> list[tuple[int, int]]:
    """First and one past the last index of the runs of true values."""
    steps = np.diff(np.concatenate([[0], values.astype(np.int64), [0]]))
    first = np.flatnonzero(steps == 1).tolist()
    last = np.flatnonzero(steps == -1).tolist()
    return list(zip(first, last, strict=True))


def marker_dictionary(name: str) -> Any:
    """Return OpenCV's dictionary of markers by its name.

    Raises:
        CalibrationError: OpenCV has none of this name.
    """
    import cv2

    number = None
    if name.startswith("DICT_"):
        number = getattr(cv2.aruco, name, None)
    if not isinstance(number, int):
        known = sorted(key for key in dir(cv2.aruco) if key.startswith("DICT_"))
        near = difflib.get_close_matches(name, known, 2) or ["DICT_4X4_50", "DICT_6X6_250"]
        raise CalibrationError(
            f"{name!r} is no dictionary of OpenCV's markers; give its name, such as "
            f"{' or '.join(near)}"
        )
    return cv2.aruco.getPredefinedDictionary(number)


def target_text(target: Target) -> str:
    """Return the YAML of a board: Kalibr's where Kalibr has such boards."""
    if target.kind == "aprilgrid":
        lines = {
            "target_type": "'aprilgrid'",
            "tagCols": target.cols,
            "tagRows": target.rows,
            "tagSize": f"{target.size_m!r}  # [m] side of a tag with its border: measure it",
            "tagSpacing": f"{target.ratio!r}  # gap between tags / tagSize",
        }
        if target.first_id:
            lines["codeOffset"] = target.first_id
    elif target.kind == "checkerboard":
        lines = {
            "target_type": "'checkerboard'",
            "targetCols": f"{target.cols - 1}  # inner corners",
            "targetRows": target.rows - 1,
            "rowSpacingMeters": f"{target.size_m!r}  # [m] side of a square: measure it",
            "colSpacingMeters": f"{target.size_m!r}",
        }
    else:
        lines = {
            "target_type": "'charuco'",
            "squaresX": target.cols,
            "squaresY": target.rows,
            "squareSize": f"{target.size_m!r}  # [m] side of a square: measure it",
            "markerSize": f"{target.ratio * target.size_m:.9g}  # [m]",
            "dictionary": target.dictionary,
            "legacyPattern": str(target.legacy).lower(),
        }
    return "".join(f"{key}: {value}\n" for key, value in lines.items())


def read_target(path: Path, size_m: float | None = None) -> Target:
    """Read the description of a board.

    Args:
        path: one of the known forms.
        size_m: side of a tag or square as measured on the print; None: that of the file.

    Raises:
        CalibrationError: the form is not known, an entry is missing or impossible, or the side is
            not in metres; the message names the file and the remedy.
    """
    if not path.is_file():
        raise CalibrationError(f"{path} is no file; give {KNOWN}, or write one by vio target")
    if not path.read_bytes().strip():
        raise CalibrationError(f"{path}: is empty; give {KNOWN}, or write one by vio target")
    if path.suffix.lower() == ".xml":
        entries: Mapping[str, Any] = read_entries(path)
    else:
        entries = read_yaml_file(path, "the description of a board")
    try:
        target = _from_entries(entries, path, size_m)
        _check_markers(target)
    except CalibrationError as error:
        text = str(error)
        raise CalibrationError(text if str(path) in text else f"{path}: {text}") from error
    return target


def _check_markers(target: Target) -> None:
    """Refuse a board that needs more markers than its dictionary has."""
    needed = len(target.marker_corners())
    if needed:
        target.modules_of(target.first_id)
        target.modules_of(target.first_id + needed - 1)


def _kind_by_entries(entries: Mapping[str, Any]) -> str:
    """Return the kind of Kalibr's boards that a file without `target_type` describes; "": none."""
    if "tagCols" in entries:
        return "aprilgrid"
    return "checkerboard" if "targetCols" in entries else ""


def _from_entries(entries: Mapping[str, Any], path: Path, size_m: float | None) -> Target:
    stated = str(entries.get("target_type", "")).lower()
    kind = stated or _kind_by_entries(entries)
    reader = _Entries(entries, path, size_m)
    readers = {
        "aprilgrid": reader.aprilgrid,
        "checkerboard": reader.kalibr_checkerboard,
        "charuco": reader.charuco,
    }
    if kind in readers:
        return readers[kind]()
    settings = entries.get("Settings", entries)
    if isinstance(settings, dict) and "BoardSize_Width" in settings:
        return _Entries(settings, path, size_m).opencv()
    for key, value in entries.items():
        if str(key).endswith("ConfigCalibrationTarget") and isinstance(value, dict):
            return _Entries(value.get("grid", {}), path, size_m).boofcv()
    named = f"target_type {stated!r}" if stated else "its content"
    raise CalibrationError(f"{path}: {named} is no board that is read; give {KNOWN}")


@dataclass(frozen=True, slots=True)
class _Entries:
    """Entries of a file, and the side that was measured."""

    entries: Mapping[str, Any]
    path: Path
    size_m: float | None

    def number(self, *keys: str) -> float:
        """Return the first of some entries that exists."""
        key = next((key for key in keys if key in self.entries), None)
        if key is None:
            raise CalibrationError(f"{self.path}: has no entry '{keys[0]}'; add it")
        value = as_number(self.entries[key])
        if not np.isfinite(value) or isinstance(self.entries[key], bool):
            raise CalibrationError(f"{self.path}: '{key}' is {self.entries[key]!r}, no number")
        return value

    def count(self, *keys: str) -> int:
        """Return a whole number."""
        value = self.number(*keys)
        if value != int(value):
            raise CalibrationError(f"{self.path}: '{keys[0]}' is {value:g}, no whole number")
        return int(value)

    def ratio(self, part: tuple[str, ...], whole: tuple[str, ...]) -> float:
        """Return the ratio of two lengths."""
        length = self.number(*whole)
        if length <= 0:
            raise CalibrationError(f"{self.path}: '{whole[0]}' is {length:g}, no length in metres")
        return self.number(*part) / length

    def flag(self, key: str) -> bool:
        """Return whether an entry is true; one that is missing is not."""
        value = self.entries.get(key, False)
        if value not in (True, False):
            raise CalibrationError(f"{self.path}: '{key}' is {value!r}; write true or false")
        return bool(value)

    def side(self, *keys: str) -> float:
        """Return the side of a tag or square."""
        stated = self.number(*keys)
        return stated if self.size_m is None else self.size_m

    def aprilgrid(self) -> Target:
        """Read Kalibr's (and Basalt's) AprilGrid."""
        for key in _FAMILY_KEYS:
            family = str(self.entries.get(key, "36h11")).lower()
            if not family.endswith("36h11"):
                raise CalibrationError(
                    f"{self.path}: '{key}' is {self.entries[key]!r}, and an AprilGrid is read with "
                    "tags of 36h11, as Kalibr prints it; print such a board by vio target"
                )
        offset = self.count("codeOffset") if "codeOffset" in self.entries else 0
        return Target(
            "aprilgrid",
            self.count("tagRows"),
            self.count("tagCols"),
            self.side("tagSize"),
            self.number("tagSpacing"),
            first_id=offset,
        )

    def kalibr_checkerboard(self) -> Target:
        """Read Kalibr's checkerboard, which counts inner corners."""
        side = self.side("rowSpacingMeters")
        if self.number("colSpacingMeters", "rowSpacingMeters") != self.number("rowSpacingMeters"):
            raise CalibrationError(
                f"{self.path}: rowSpacingMeters and colSpacingMeters differ; squares are needed"
            )
        return Target(
            "checkerboard", self.count("targetRows") + 1, self.count("targetCols") + 1, side
        )

    def charuco(self) -> Target:
        """Read a ChArUco board by the names of OpenCV's class."""
        ratio = self.ratio(("markerSize", "markerLength"), ("squareSize", "squareLength"))
        return Target(
            "charuco",
            self.count("squaresY"),
            self.count("squaresX"),
            self.side("squareSize", "squareLength"),
            ratio,
            str(self.entries.get("dictionary", "DICT_4X4_50")),
            legacy=self.flag("legacyPattern"),
        )

    def opencv(self) -> Target:
        """Read the settings of OpenCV's calibration sample."""
        kind = str(self.entries.get("Calibrate_Pattern", "CHESSBOARD")).strip('"').upper()
        width = self.count("BoardSize_Width")
        height = self.count("BoardSize_Height")
        side = self.side("Square_Size")
        if kind == "CHESSBOARD":
            return Target("checkerboard", height + 1, width + 1, side)
        if kind != "CHARUCOBOARD":
            raise CalibrationError(
                f"{self.path}: Calibrate_Pattern {kind} is not read; print a board by vio target"
            )
        ratio = self.ratio(("Marker_Size",), ("Square_Size",))
        name = str(self.entries.get("ArUco_Dict_Name", "DICT_4X4_50")).strip('"')
        return Target("charuco", height, width, side, ratio, name)

    def boofcv(self) -> Target:
        """Read BoofCV's checkerboard, which counts squares and knows no unit.

        Raises:
            CalibrationError: a square has the side 1, which is the unit and no length.
        """
        if self.side("shapeSize") == 1:
            raise CalibrationError(
                f"{self.path}: shapeSize is 1, and BoofCV states no unit; measure a square and give "
                "its side in metres (--size)"
            )
        return Target(
            "checkerboard", self.count("numRows"), self.count("numCols"), self.side("shapeSize")
        )
