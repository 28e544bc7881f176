"""Seeds of a board in an image: markers that are read, or a whole checkerboard.

OpenCV's quadrilaterals are candidates for markers; each is read by correlation with what the board
prints, not by thresholds of its modules, so that blurred and distant markers are read as well. An
image is looked at in several sizes, and with light that has grown, which parts tags from the dark
squares that touch their corners.
References: Garrido-Jurado et al., Automatic generation and detection of highly reliable fiducial
markers under occlusion (2014), for the candidates; Lewis, Fast normalized cross-correlation (1995).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray
from vio.records import Image
from vio.targets.description import UNIT_SQUARE, Marker, Target, marker_dictionary
from vio.targets.homography import gray_at, homographies, mapped

# Scale of the image in which candidates are looked for, and the pixels there by which light grows.
_LOOKS = ((0.5, 3), (1.0, 3), (0.5, 1), (0.5, 5), (1.0, 5), (0.25, 1), (0.25, 3))
_LOOKS_ALONE = ((0.5, 1), (1.0, 1), (0.25, 1), (1.0, 3))  # where nothing touches a marker


class _MarkerRules(NamedTuple):
    """When a marker is read."""

    enough_markers: int = 8  # markers, from which all others are found
    enough_share: float = 0.6  # of the board's markers
    samples_per_side: int = 24  # along a side of what is correlated
    margin_modules: float = 1.0  # modules of paper around a marker that are correlated with it
    min_correlation: float = 0.75  # of a marker with its border and the paper around
    min_code_correlation: float = 0.7  # correlation of what lies within the border
    min_lead: float = 0.1  # of that over any other marker's, or turn's
    min_contrast: float = 5.0  # standard deviation of the gray values
    same_place_share: float = 0.5  # of a marker's side


_MARKERS = _MarkerRules()
_GROWTHS = (1.0, 1.12, 1.25, 1.4)  # of a candidate, which grown light has made smaller
_BLURS = (0.3, 0.7, 1.2)  # standard deviations of the board's print, modules


Single: TypeAlias = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Read:
    """A marker that was read."""

    id: int
    uv: FloatArray  # (4, 2) pixels: top left, top right, bottom right, bottom left as printed
    correlation: float

    @property
    def side_px(self) -> float:
        """Its least side."""
        return float(np.linalg.norm(self.uv - np.roll(self.uv, 1, axis=0), axis=1).min())


class MarkerReader:
    """Finds the coded squares of a board in images."""

    def __init__(self, target: Target) -> None:
        import cv2

        settings = cv2.aruco.DetectorParameters()
        settings.markerBorderBits = target.border_bits
        settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
        settings.minMarkerPerimeterRate = 0.02
        settings.adaptiveThreshWinSizeMin = 9
        settings.adaptiveThreshWinSizeMax = 33
        settings.adaptiveThreshWinSizeStep = 24
        dictionary = marker_dictionary(target.dictionary)
        self._detector: Any = cv2.aruco.ArucoDetector(dictionary, settings)
        markers = target.markers()
        self._wanted = min(_MARKERS.enough_markers, _MARKERS.enough_share * len(markers))
        self._looks = _LOOKS if target.kind == "aprilgrid" else _LOOKS_ALONE
        self._prints = _Prints(markers, target.border_bits)

    def find(self, image: Image) -> list[Read]:
        """Return the markers that are read, each once."""
        found: list[Read] = []
        for scale, grown_px in self._looks:
            found = _each_once(
                found + self._prints.read(image, self._quads(image, scale, grown_px))
            )
            if len(found) >= self._wanted:
                break
        return found

    def repeated(self, image: Image) -> int:
        """Return how many markers are read at two places, as two boards show them."""
        found: list[Read] = []
        for scale, grown_px in self._looks:
            found += self._prints.read(image, self._quads(image, scale, grown_px))
        return len(_at_two_places(found))

    def _quads(self, image: Image, scale: float, grown_px: int) -> FloatArray:
        """Quadrilaterals (Q, 4, 2) that may be markers, clockwise."""
        import cv2

        size = (round(scale * image.shape[1]), round(scale * image.shape[0]))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        if grown_px > 1:
            small = cv2.dilate(small, np.ones((grown_px, grown_px), dtype=np.uint8))
        found, _, refused = self._detector.detectMarkers(small)
        quads = [np.asarray(q, dtype=np.float64).reshape(4, 2) for q in (*found, *refused)]
        return (np.array(quads).reshape(-1, 4, 2) + 0.5) / scale - 0.5


def _each_once(found: Sequence[Read]) -> list[Read]:
    """Return the best of each marker's readings; none where it was read at two places."""
    elsewhere = _at_two_places(found)
    best: dict[int, Read] = {}
    for one in sorted(found, key=lambda read: -read.correlation):
        best.setdefault(one.id, one)
    return [one for one in best.values() if one.id not in elsewhere]


def _at_two_places(found: Sequence[Read]) -> set[int]:
    """Return the numbers of markers that were read at two places."""
    best: dict[int, Read] = {}
    out = set[int]()
    for one in sorted(found, key=lambda read: -read.correlation):
        other = best.setdefault(one.id, one)
        apart = float(np.linalg.norm(other.uv.mean(axis=0) - one.uv.mean(axis=0)))
        if apart > _MARKERS.same_place_share * max(one.side_px, other.side_px):
            out.add(one.id)
    return out


class _Prints:
    """What the markers of a board look like, by each blur and turn."""

    def __init__(self, markers: Sequence[Marker], border_bits: int) -> None:
        import cv2

        modules = len(markers[0].is_dark)
        margin = _MARKERS.margin_modules / modules
        steps = (
            -margin
            + (1 + 2 * margin)
            * (np.arange(_MARKERS.samples_per_side) + 0.5)
            / _MARKERS.samples_per_side
        )
        self._at = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        cells = np.floor(modules * steps).astype(int)
        inside = (cells >= 0) & (cells < modules)
        coded = (cells >= border_bits) & (cells < modules - border_bits)
        # Dark squares may touch a marker's corners from outside.
        self._whole = (inside[:, None] | inside).ravel().astype(np.float64)
        self._code = (coded[:, None] & coded).ravel().astype(np.float64)
        known = np.clip(cells, 0, modules - 1)
        looks: list[FloatArray] = []
        ids: list[int] = []
        turns: list[int] = []
        sigma_samples = (
            np.array(_BLURS) * _MARKERS.samples_per_side / (modules + 2 * _MARKERS.margin_modules)
        )
        for marker in markers:
            dark = marker.is_dark[np.ix_(known, known)] & inside[:, None] & inside
            for sigma in sigma_samples.tolist():
                light = cv2.GaussianBlur(1.0 - dark, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
                for turn in range(4):
                    looks.append(np.asarray(np.rot90(light, turn), dtype=np.float64).ravel())
                    ids.append(marker.id)
                    turns.append(turn)
        self._whole_looks = _unit_rows(np.array(looks), self._whole)[0]
        self._code_looks = _unit_rows(np.array(looks), self._code)[0]
        self._id = np.array(ids)
        self._turn = np.array(turns)

    def read(self, image: Image, quads: FloatArray) -> list[Read]:
        """Return the candidates (Q, 4, 2) that are markers of the board."""
        if not len(quads):
            return []
        centre = quads.mean(axis=1, keepdims=True)
        grown = np.stack([centre + g * (quads - centre) for g in _GROWTHS], axis=1)
        values = self._sampled(image, grown.reshape(-1, 4, 2))
        whole = _correlation(values, self._whole_looks, self._whole)
        likely = np.flatnonzero(whole.max(axis=1) > _MARKERS.min_correlation)
        # All markers have the border in common; the code tells them apart.
        code = np.full_like(whole, -1.0)
        by_code = _correlation(values[likely], self._code_looks, self._code)
        code[likely] = np.where(whole[likely] > _MARKERS.min_correlation, by_code, -1.0)
        out: list[Read] = []
        for n, scores in enumerate(code.reshape(len(quads), len(_GROWTHS), -1)):
            g, k = np.unravel_index(int(np.argmax(scores)), scores.shape)
            best = float(scores[g, k])
            others = (self._id != self._id[k]) | (self._turn != self._turn[k])
            second = float(scores[:, others].max(initial=0.0))
            if best > _MARKERS.min_code_correlation and best - second > _MARKERS.min_lead:
                # Turned by 90 degrees against the clock, the print's first corner comes last.
                uv = np.roll(grown[n, g], self._turn[k], axis=0)
                out.append(Read(int(self._id[k]), uv, best))
        return out

    def _sampled(self, image: Image, quads: FloatArray) -> FloatArray:
        """Gray values (K, S) of quadrilaterals (K, 4, 2)."""
        H = homographies(np.broadcast_to(UNIT_SQUARE, quads.shape), quads)
        return gray_at(image, mapped(H, self._at[None]))


def _unit_rows(values: FloatArray, weight: FloatArray) -> tuple[Single, FloatArray]:
    """Rows (K, S) without their mean and of length one, and their standard deviations (K,), by
    weights (S,) of 0 and 1.
    """
    total = weight.sum()
    free = (values - (values @ weight / total)[:, None]) * weight
    length = np.linalg.norm(free, axis=1)
    unit = free / np.maximum(length, 1e-9)[:, None]
    return unit.astype(np.float32), np.asarray(length / np.sqrt(total))


def _correlation(values: FloatArray, looks: Single, weight: FloatArray) -> Single:
    """Normalised correlation (K, L) of rows of gray values (K, S) with prints (L, S) as unit rows;
    zero where there is no contrast.
    """
    rows, contrast = _unit_rows(values, weight)
    return np.asarray((rows * (contrast > _MARKERS.min_contrast)[:, None]) @ looks.T)


def checkerboard_seeds(image: Image, target: Target) -> tuple[FloatArray, FloatArray]:
    """All inner corners of a checkerboard: (N, 2) on the board, (N, 2) pixels; or none. The board may
    be turned by quarters if it is square, and else by 180 degrees.
    """
    import cv2

    size = (target.cols - 1, target.rows - 1)
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    done, found = cv2.findChessboardCornersSB(image, size, flags=flags)
    if not done:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        done, found = cv2.findChessboardCorners(image, size, flags=flags | cv2.CALIB_CB_FAST_CHECK)
    if not done:
        return np.zeros((0, 2)), np.zeros((0, 2))
    uv = np.asarray(found, dtype=np.float64).reshape(-1, 2)
    grid = uv.reshape(target.rows - 1, target.cols - 1, 2)
    across = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0)
    down = grid[-1].mean(axis=0) - grid[0].mean(axis=0)
    # A board without codes looks the same when it is turned, and not when it is mirrored.
    if across[0] * down[1] - across[1] * down[0] < 0:
        grid = grid[:, ::-1]
    return target.points_m, grid.reshape(-1, 2)
