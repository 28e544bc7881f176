"""Key points with descriptors: extracted by OpenCV, spread over the image, matched by the nearest
descriptor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from vio.frontend.detect import filling
from vio.frontend.settings import MatchSettings
from vio.geometry.lie import FloatArray
from vio.numerics.compiled import compiled, compiled_sums
from vio.numerics.kinds import Capacity
from vio.records import BoolArray, Image, IntArray

Vectors: TypeAlias = npt.NDArray[np.float32]
Descriptors: TypeAlias = Vectors | npt.NDArray[np.uint8]


class _SpreadRules(NamedTuple):
    """How many key points are found, for those that are taken to be spread over the image."""

    candidates: Capacity[int] = 16  # of ORB, over those wanted
    fast_threshold: int = 7  # gray levels, of ORB's corners
    sift_contrast: float = 0.02
    in_cell: Capacity[int] = 4  # of those wanted, on average


_SPREAD = _SpreadRules()
_MAX_RATIO = 0.8  # of a descriptor's distance to that of the second-nearest, of a match


@dataclass(frozen=True, slots=True)
class Keypoints:
    """The key points of one image, strongest first."""

    pixels: FloatArray  # (N, 2)
    descriptors: Descriptors  # (N, D) unit vectors, or (N, D / 8) bytes of D bits

    def __len__(self) -> int:
        return len(self.pixels)


class Extractor(Protocol):
    """Finds and describes key points."""

    def __call__(self, *images: Image) -> list[Keypoints]:
        """Return the key points of each of some images of one size, strongest first."""


class Matcher(Protocol):
    """Pairs key points of two images."""

    def __call__(self, a: Keypoints, b: Keypoints, allowed: BoolArray) -> IntArray:
        """Return pairs (K, 2) of rows of `a` and `b`; only pairs in `allowed` (N, M), no row
        twice.
        """


@dataclass(frozen=True, slots=True)
class MutualNearest:
    """Mutual nearest neighbours among the allowed pairs that pass the ratio test.

    Reference: Lowe, Distinctive image features from scale-invariant keypoints, IJCV (2004), section
    7.1.
    """

    ratio: float = _MAX_RATIO  # largest distance over that of the second-nearest

    def __call__(self, a: Keypoints, b: Keypoints, allowed: BoolArray) -> IntArray:
        """Return pairs (K, 2); see `Matcher`."""
        if len(a) == 0 or len(b) == 0:
            return np.zeros((0, 2), dtype=np.int64)
        best = np.empty(len(a), dtype=np.int64)
        good = np.empty(len(a), dtype=np.bool_)
        bits = a.descriptors.dtype == np.uint8
        ratio = np.float32(self.ratio)
        _nearest(_vectors(a.descriptors), _vectors(b.descriptors), bits, allowed, ratio, best, good)
        return np.stack([good.nonzero()[0], best[good]], axis=1)


def _vectors(descriptors: Descriptors) -> Vectors:
    """Vectors (N, D) whose products give the distances: the descriptors, or -1 and 1 for the
    bits of bytes.
    """
    if descriptors.dtype != np.uint8:
        return np.ascontiguousarray(descriptors, dtype=np.float32)
    return 2 * np.unpackbits(descriptors.astype(np.uint8), axis=1).astype(np.float32) - 1


@compiled
def _nearest(
    a: Vectors,
    b: Vectors,
    bits: bool,
    allowed: BoolArray,
    ratio: np.float32,
    best: IntArray,
    good: BoolArray,
) -> None:
    """Write the nearest of the allowed rows of b (M, D) for each of a (N, D), and whether it is a
    match.

    The distance is Euclidean for unit vectors, Hamming for `bits`. Of equal distances the first one
    counts.
    """
    size = np.float32(a.shape[1])
    far = np.float32(np.inf)
    least = np.empty(len(b), np.float32)
    back = np.empty(len(b), np.int64)
    for j in range(len(b)):
        least[j] = far
        back[j] = -1
    for i in range(len(a)):
        first = second = far
        best[i] = 0
        for j in range(len(b)):
            if not allowed[i, j]:
                continue
            product = _product(a[i], b[j])
            if bits:
                distance = np.float32(0.5) * (size - product)
            else:
                distance = np.sqrt(
                    max(np.float32(2.0) - np.float32(2.0) * product, np.float32(0.0))
                )
            if distance < first:
                first, second, best[i] = distance, first, j
            elif distance < second:
                second = distance
            if distance < least[j]:
                least[j] = distance
                back[j] = i
        good[i] = first < far and first <= ratio * second
    for i in range(len(a)):
        good[i] &= back[best[i]] == i


@compiled_sums
def _product(a: Vectors, b: Vectors) -> np.float32:
    total = np.float32(0.0)
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


# More than are wanted, of which those are taken that are spread over the image.
_OPENCV: dict[str, Callable[[int], cv2.Feature2D]] = {
    "orb": lambda most: cv2.ORB.create(
        nfeatures=_SPREAD.candidates * most, fastThreshold=_SPREAD.fast_threshold
    ),
    "sift": lambda most: cv2.SIFT.create(contrastThreshold=_SPREAD.sift_contrast),
}


@dataclass(frozen=True, slots=True)
class OpenCvExtractor:
    """ORB or SIFT of OpenCV, which an unfinished run keeps as its settings."""

    name: str
    max_keypoints: int
    engine: cv2.Feature2D = field(init=False, repr=False, compare=False)  # without a state

    def __post_init__(self) -> None:
        object.__setattr__(self, "engine", _OPENCV[self.name](self.max_keypoints))

    def __getstate__(self) -> dict[str, Any]:
        return {"name": self.name, "max_keypoints": self.max_keypoints}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for key, value in state.items():
            object.__setattr__(self, key, value)
        self.__post_init__()

    def __call__(self, *images: Image) -> list[Keypoints]:
        """Return the key points of each image; see `Extractor`."""
        return [self._keypoints(image) for image in images]

    def _keypoints(self, image: Image) -> Keypoints:
        found = self.engine.detect(image, None)
        values = _values(found)
        chosen = spread_rows(values[:, :2], values[:, 2], self.max_keypoints, image.shape)
        # in another order, where there are octaves
        described, descriptors = self.engine.compute(image, [found[k] for k in chosen])
        values = _values(described)
        order = np.lexsort((values[:, 1], values[:, 0], -values[:, 2]))
        pixels = values[order, :2]
        if self.name == "orb":
            bits = np.zeros((0, 32)) if descriptors is None else np.asarray(descriptors)[order]
            return Keypoints(pixels, bits.astype(np.uint8))
        # Root-SIFT. Reference: Arandjelovic & Zisserman, Three things everyone should know, CVPR
        # (2012).
        vectors = np.zeros((0, 128)) if descriptors is None else np.asarray(descriptors)[order]
        unit = vectors.astype(np.float32)
        return Keypoints(pixels, np.sqrt(unit / np.maximum(unit.sum(axis=1, keepdims=True), 1e-6)))


def _values(found: Sequence[cv2.KeyPoint]) -> FloatArray:
    """Pixels and responses (N, 3) of key points."""
    return np.array([(*k.pt, k.response) for k in found], dtype=np.float64).reshape(-1, 3)


def spread_rows(
    pixels: FloatArray, strength: FloatArray, count: int, shape: tuple[int, ...]
) -> IntArray:
    """Select up to `count` rows (K,) of points (N, 2) of an image (H, W), by strengths (N,): the
    strongest of each cell first, then the second ones, so that one well-textured thing does not
    take all.

    Reference: Mur-Artal, Montiel & Tardos, ORB-SLAM, IEEE T-RO (2015), section V.A, for the need.
    """
    height, width = shape
    side = math.sqrt(_SPREAD.in_cell * height * width / count)
    column, row = (pixels // side).astype(np.int64).T
    columns = 1 + int(width / side)
    cell = row * columns + column
    order = np.lexsort((pixels[:, 1], pixels[:, 0], -strength, cell))
    rank = filling(cell[order], cell[:0], columns * (1 + int(height / side)))
    return order[np.lexsort((-strength[order], rank))[:count]]


def orb_extractor(settings: MatchSettings) -> OpenCvExtractor:
    """ORB. Reference: Rublee et al., ORB: an efficient alternative to SIFT or SURF, ICCV (2011)."""
    return OpenCvExtractor("orb", settings.max_keypoints)


def sift_extractor(settings: MatchSettings) -> OpenCvExtractor:
    """SIFT.

    Reference: Lowe, Distinctive image features from scale-invariant keypoints, IJCV (2004).
    """
    return OpenCvExtractor("sift", settings.max_keypoints)
