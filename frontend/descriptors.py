"""Front ends that detect key points in every left image, and follow features by matching their
descriptors.

What was not detected again is looked for where it is predicted, then where the camera's motion
takes it; anchors, right matches and checks are those of `vio.frontend.tracking`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.frontend.align import MIN_CORRELATION, align, on_peak
from vio.frontend.columns import take
from vio.frontend.keypoints import Descriptors, Extractor, Keypoints, Matcher
from vio.frontend.patches import ImageLevels, inside
from vio.frontend.settings import FrontendSettings
from vio.frontend.tracking import TrackingFrontend
from vio.frontend.tracks import AnchorBank, PreviousFrame, Tracks
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.numerics.compiled import compiled
from vio.numerics.kinds import Tolerance
from vio.records import BoolArray, Image, IntArray


class _MatchRules(NamedTuple):
    """Which key points are compared with features."""

    # half side of the search window around the predicted pixel, over the image width
    search_share: float = 0.06
    # key points closer to the image border are dropped: their patch would not fit
    border_px: float = 8.0
    # of a feature from its key point, whose detection has about a pixel of error
    same_px: float = 1.5


_MATCHES = _MatchRules()
_REFINEMENTS: Tolerance[int] = 6  # iterations on a match


class DescriptorFrontend(TrackingFrontend):
    """Match key points from frame to frame by descriptor."""

    def __init__(
        self,
        camera: StereoCamera,
        settings: FrontendSettings,
        name: str,
        extract: Extractor,
        match: Matcher,
    ) -> None:
        """Prepare; the name is for messages."""
        bank = AnchorBank.for_features(settings.grid.target_features)
        flow = KeypointFlow(bank, extract, match)
        super().__init__(camera, settings, name, bank, flow, flow)


class KeypointFlow:
    """Follows features by key points that are matched by descriptor, and finds new ones among them;
    see `vio.frontend.flow.Flow`.
    """

    def __init__(self, bank: AnchorBank, extract: Extractor, match: Matcher) -> None:
        """Prepare; the bank contains the features' anchors."""
        self._bank = bank
        self._extract = extract
        self._match = match
        self._points: Keypoints | None = None  # of the present image
        # (M, ...) of the features by the slots of their anchors, as last detected; None: of none
        self._descriptors: Descriptors | None = None

    def see(self, image: Image) -> bool:
        """Extract the key points of the left image (H, W) of a frame."""
        (points,) = self._extract(image)
        self._points = take(points, inside(image, points.pixels, _MATCHES.border_px))
        return True

    def detect(self, image: Image) -> FloatArray:
        """Return the pixels (K, 2) of the image's key points, strongest first; see
        `vio.protocols.Detector`.
        """
        return self._seen.pixels

    def follow(
        self, previous: PreviousFrame, image: ImageLevels, guess: FloatArray, *, trusted: bool
    ) -> tuple[FloatArray, BoolArray]:
        """Return pixels (N, 2) of features and a mask (N,) of those found, at a key point, else
        where they are predicted; see `Flow`.
        """
        old = previous.tracks
        points = self._seen
        found = old.left.copy()
        seen = np.zeros(len(old), dtype=np.bool_)
        if self._descriptors is None:
            return found, seen
        near = _near_guess(guess, old.left, points.pixels, image.full.shape[1])
        pairs = self._match(Keypoints(old.left, self._descriptors[old.slot]), points, near)
        rows = pairs[:, 0]
        start = points.pixels[pairs[:, 1]]
        pixels, good = self._aligned(old, rows, start, image.full)
        found[rows] = np.where(good[:, None], pixels, start)
        seen[rows] = True
        lost = (~seen).nonzero()[0]
        found[lost], seen[lost] = self._aligned(old, lost, guess[lost], image.full)
        return found, seen

    def _aligned(
        self, old: Tracks, rows: IntArray, start: FloatArray, image: Image
    ) -> tuple[FloatArray, BoolArray]:
        """Return the pixels (K, 2) of features in rows (K,) by their anchors, from pixels (K, 2)
        on, and a mask (K,) of those that look like them there.
        """
        warp = old.warp[rows]
        warp[:, :, 2] = start
        warp, score = align(self._bank.store, old.slot[rows], image, warp, _REFINEMENTS)
        pixels = warp[:, :, 2]
        return pixels, (score >= MIN_CORRELATION) & on_peak(pixels, start)

    def keep(self, tracks: Tracks) -> None:
        """Remember the descriptors of the key points where a frame's features are.

        A feature without one keeps its last one: that of a match elsewhere is another thing's.
        """
        points = self._seen
        if self._descriptors is None or len(self._descriptors) < self._bank.size:
            self._descriptors = _grown(self._descriptors, points.descriptors, self._bank.size)
        if len(points):
            nearest = np.empty(len(tracks), dtype=np.int64)
            _nearest_point(tracks.left, points.pixels, _MATCHES.same_px, nearest)
            there = nearest >= 0
            self._descriptors[tracks.slot[there]] = points.descriptors[nearest[there]]

    @property
    def _seen(self) -> Keypoints:
        assert self._points is not None
        return self._points


def _grown(stored: Descriptors | None, like: Descriptors, count: int) -> Descriptors:
    """Room for `count` descriptors, with those stored."""
    out: Descriptors = np.zeros((count, like.shape[1]), dtype=like.dtype)
    if stored is not None:
        out[: len(stored)] = stored
    return out


def _near_guess(guess: FloatArray, old: FloatArray, points: FloatArray, width: int) -> BoolArray:
    """Pairs (N, M) of features and key points (M, 2) of an image of a width that are close to the
    predicted pixel (N, 2) or the old one, as the last motion may be wrong.
    """
    near = np.empty((len(old), len(points)), dtype=np.bool_)
    _near_either(guess, old, np.ascontiguousarray(points.T), _MATCHES.search_share * width, near)
    return near


@compiled
def _near_either(
    one: FloatArray, other: FloatArray, points: FloatArray, reach: float, out: BoolArray
) -> None:
    """Write which points (2, M) are in the squares (half side `reach`) around one or other
    centres (N, 2).
    """
    us = points[0]
    vs = points[1]
    for i in range(len(one)):
        u = one[i, 0]
        v = one[i, 1]
        u_other = other[i, 0]
        v_other = other[i, 1]
        row = out[i]
        for j in range(len(us)):
            in_one = (abs(u - us[j]) <= reach) & (abs(v - vs[j]) <= reach)
            row[j] = in_one | ((abs(u_other - us[j]) <= reach) & (abs(v_other - vs[j]) <= reach))


@compiled
def _nearest_point(pixels: FloatArray, points: FloatArray, reach: float, nearest: IntArray) -> None:
    """Write which point (M, 2) is nearest to each pixel (N, 2), in the maximum norm; -1: none is
    within reach. Of equally near ones the first one counts.
    """
    for i in range(len(pixels)):
        least = reach
        nearest[i] = -1
        for j in range(len(points)):
            off = max(abs(pixels[i, 0] - points[j, 0]), abs(pixels[i, 1] - points[j, 1]))
            if off < least or (off == least and nearest[i] < 0):
                least = off
                nearest[i] = j
