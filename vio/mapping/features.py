"""What a keyframe keeps of its images: ORB key points with their pixels in both images.

ORB (Rublee et al. 2011) from OpenCV: its bits are compared in a microsecond and its words need no
training (`place_index`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from vio.calibration.stereo_field import DisplacementField
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import DEPTH_DISPARITY_PX
from vio.records import BoolArray, Image, IntArray

Bits: TypeAlias = npt.NDArray[np.uint8]

DESCRIPTOR_BYTES = 32
MAX_BITS = 64  # in which the descriptors of one point differ: a quarter
# of a keyframe; 30 kB, so that 10 minutes of driving (2000 keyframes) need 60 MB
MAX_FEATURES = 600


@dataclass(frozen=True, slots=True)
class _Extraction:
    """What features a keyframe keeps."""

    # key points found for each that is kept, so that they can be spread over the image
    detected: int = 3
    corner_contrast: int = 7  # gray levels; low, since the best ones of each cell are kept
    # of a left and a right key point, at the scale of the detector's first level
    rows_px: float = 2.0
    lk_window: int = 11  # pixels
    # pixels; the images are brought to one brightness and contrast over squares of this size
    lk_contrast: int = 15
    lk_gray: float = 128.0  # mean and standard deviation then; below 6 gray levels less
    lk_deviation: float = 40.0
    lk_min: float = 6.0
    # by which the rows of a refined match may differ: rectifications are off by up to a pixel
    lk_rows_px: float = 2.0


_EXTRACTION = _Extraction()


class _KeyPointRules(NamedTuple):
    """Which key points a keyframe keeps."""

    cells: int = 10  # along the larger side of the image
    levels: int = 8  # pyramid of the detector: up to 3.6 times nearer
    scale: float = 1.2
    max_disparity_share: float = 0.4  # of the width


_KEY_POINTS = _KeyPointRules()
# bits of a byte
_ONES = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(axis=1, dtype=np.uint16)


@dataclass(frozen=True, slots=True)
class KeyframeFeatures:
    """The key points of one keyframe."""

    # (N, 4) rectified pixels [ul vl ur vr]; ur, vr are arbitrary where has_right is False
    z: FloatArray
    has_right: BoolArray  # (N,)
    # (N,) standard deviation of a pixel coordinate: larger on the coarse levels
    sigma_px: FloatArray
    descriptors: Bits  # (N, 32)
    # that was taken out of z; one object for all keyframes that share it
    field: DisplacementField | None = None
    z_seen: FloatArray | None = None  # (N, 4) pixels with it, as they were measured; None: z

    def __len__(self) -> int:
        return len(self.z)

    def without(self, field: DisplacementField | None) -> KeyframeFeatures:
        """Return them without what the stereo calibration is off by; None: it is right."""
        if field is None:
            return self
        return replace(self, z=field.without(self.z, self.has_right), field=field, z_seen=self.z)

    @property
    def measured(self) -> FloatArray:
        """Pixels (N, 4) as the images show them."""
        return self.z if self.z_seen is None else self.z_seen


def no_keyframe_features() -> KeyframeFeatures:
    """Return the features of a keyframe that shows none."""
    return KeyframeFeatures(
        np.zeros((0, 4)),
        np.zeros(0, dtype=np.bool_),
        np.zeros(0),
        np.zeros((0, DESCRIPTOR_BYTES), dtype=np.uint8),
    )


def extract(left: Image, right: Image, *, most: int = MAX_FEATURES) -> KeyframeFeatures:
    """Find and describe key points (N <= `most`) of the left image (H, W), and match them in the
    right one.
    """
    orb = cv2.ORB.create(
        _EXTRACTION.detected * most,
        _KEY_POINTS.scale,
        _KEY_POINTS.levels,
        fastThreshold=_EXTRACTION.corner_contrast,
    )
    found = orb.detect(left, None)
    if not found:
        return no_keyframe_features()
    chosen = [found[k] for k in _spread(found, left.shape, most)]
    points, described = orb.compute(left, chosen)
    if described is None or not len(points):
        return no_keyframe_features()
    bits = np.asarray(described, dtype=np.uint8)
    uv = np.array([p.pt for p in points], dtype=np.float64)
    scale = np.array([_KEY_POINTS.scale**p.octave for p in points])
    order = np.lexsort((uv[:, 1], uv[:, 0]))  # OpenCV's own order is that of the levels
    uv = uv[order]
    bits = bits[order]
    sigma = scale[order].astype(np.float32).astype(np.float64)
    centre = level_centre_px(sigma)
    ur, has_right = _right_pixels(orb, left, right, uv + centre, scale[order], bits)
    # as a map file keeps it
    z = np.concatenate([uv, ur - centre], axis=1).astype(np.float32) + centre
    return KeyframeFeatures(z, has_right, sigma, bits)


def level_centre_px(scale: FloatArray) -> FloatArray:
    """Return how far (N, 1) the centre of a pixel of a pyramid's level lies from where OpenCV
    gives it, along u and v.

    OpenCV multiplies the pixel's number by the level's scale (N,); its centre is at
    `(number + 1/2) scale - 1/2`. Without it, features of one corner on two levels would differ by
    up to 1.3 pixels.
    """
    return (scale[:, None] - 1.0) / 2.0


def _spread(
    found: Sequence[cv2.KeyPoint], shape: tuple[int, ...], most: int
) -> npt.NDArray[np.int64]:
    """Choose up to `most` key points: the strongest of each cell first, then the second ones,
    and so on.
    """
    uv = np.array([p.pt for p in found])
    strength = np.array([p.response for p in found])
    cell = (uv // (max(shape) / _KEY_POINTS.cells)).astype(np.int64)
    code = cell[:, 1] * _KEY_POINTS.cells + cell[:, 0]
    order = np.lexsort((uv[:, 1], uv[:, 0], -strength, code))
    begins = np.flatnonzero(np.diff(code[order], prepend=-1))
    rank = np.arange(len(order)) - np.repeat(begins, np.diff(begins, append=len(order)))
    best: npt.NDArray[np.int64] = order[np.lexsort((-strength[order], rank))][:most]
    return best


def _right_pixels(
    orb: cv2.ORB, left: Image, right: Image, uv: FloatArray, scale: FloatArray, bits: Bits
) -> tuple[FloatArray, BoolArray]:
    """Match key points at (N, 2) in the right image by descriptor near their row, and refine by
    Lucas-Kanade.

    Lucas-Kanade takes both images to be equally bright, which two cameras with their own exposure
    are not.
    """
    out = np.zeros_like(uv)
    valid = np.zeros(len(uv), dtype=np.bool_)
    there, there_bits = orb.detectAndCompute(right, None)
    if there_bits is None:
        return out, valid
    size = np.array([_KEY_POINTS.scale**p.octave for p in there])
    at = np.array([p.pt for p in there]) + level_centre_px(size)
    i, j = _near_rows(uv[:, 1], at[:, 1], _EXTRACTION.rows_px * scale)
    shift = uv[i, 0] - at[j, 0]
    allowed = (shift > -1.0) & (shift < _KEY_POINTS.max_disparity_share * left.shape[1])
    log_ratio = np.log(scale[i] / size[j])
    allowed &= np.abs(log_ratio) < 1.5 * np.log(_KEY_POINTS.scale)
    rows, best = _most_alike(i[allowed], j[allowed], bits, np.asarray(there_bits, dtype=np.uint8))
    if not len(rows):
        return out, valid
    start = at[best].astype(np.float32)[:, None]
    refined, status, _ = cv2.calcOpticalFlowPyrLK(
        _equal_contrast(left),
        _equal_contrast(right),
        uv[rows].astype(np.float32)[:, None],
        start.copy(),
        winSize=(_EXTRACTION.lk_window, _EXTRACTION.lk_window),
        maxLevel=0,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    found = refined[:, 0].astype(np.float64)
    off_row_px = np.abs(found[:, 1] - uv[rows, 1])
    good = (status[:, 0] > 0) & (off_row_px <= _EXTRACTION.lk_rows_px)
    off_start_px = np.abs(found[:, 0] - start[:, 0, 0])
    good &= off_start_px <= _EXTRACTION.rows_px * scale[rows]
    good &= uv[rows, 0] - found[:, 0] >= DEPTH_DISPARITY_PX
    out[rows[good]] = found[good]
    valid[rows[good]] = True
    return out, valid


def _near_rows(v: FloatArray, there: FloatArray, reach: FloatArray) -> tuple[IntArray, IntArray]:
    """Return all pairs (P,) of rows v (N,) and rows `there` (M,) that differ by at most `reach`
    (N,).
    """
    order = np.argsort(there, kind="stable")
    begin = np.searchsorted(there[order], v - reach, side="left")
    counts = np.searchsorted(there[order], v + reach, side="right") - begin
    i = np.repeat(np.arange(len(v)), counts)
    shift = begin - np.cumsum(counts) + counts
    return i, order[np.arange(len(i)) + np.repeat(shift, counts)]


def _most_alike(i: IntArray, j: IntArray, a: Bits, b: Bits) -> tuple[IntArray, IntArray]:
    """Of pairs (P,) of descriptors a (N, 32) and b (M, 32), return the best of each i, if it is
    good enough.
    """
    differing = _ONES[a[i] ^ b[j]].sum(axis=1)
    order = np.lexsort((j, differing, i))
    rows, first = np.unique(i[order], return_index=True)
    best = order[first]
    good = differing[best] <= MAX_BITS
    return rows[good], j[best[good]]


def _equal_contrast(image: Image) -> Image:
    """Return an image (H, W) with the same mean and standard deviation around each pixel."""
    gray = image.astype(np.float32)
    mean, squared = (
        cv2.blur(x, (_EXTRACTION.lk_contrast, _EXTRACTION.lk_contrast)) for x in (gray, gray * gray)
    )
    deviation = np.sqrt(np.maximum(squared - mean * mean, 0.0))
    out = _EXTRACTION.lk_gray + _EXTRACTION.lk_deviation * (gray - mean) / (
        deviation + _EXTRACTION.lk_min
    )
    return np.clip(out, 0, 255).astype(np.uint8)
