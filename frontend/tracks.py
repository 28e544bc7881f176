"""The features that the front end `klt` tracks, and the anchor patches that it aligns them with."""

from __future__ import annotations

import numpy as np

from vio.dataclass import dataclass
from vio.frontend.align import INSIDE, cut_patches, empty_templates, replace_templates, shift_warps
from vio.frontend.blurring import MARGIN_PX, spread_out
from vio.frontend.columns import joined
from vio.frontend.patches import ImageLevels, Patches
from vio.geometry.lie import FloatArray, se3_exp, se3_log
from vio.numerics.kinds import Capacity
from vio.records import BoolArray, Image, IntArray, SigmaArray

ANCHOR_RADIUS_PX = 9  # of the anchor patch that a feature is aligned with
# at least so far from the image's border features stay
ANCHOR_REACH_PX = round(INSIDE * ANCHOR_RADIUS_PX)
_BANK_FACTOR: Capacity[int] = 3  # templates allocated, over the number of features
INLIER_PX = 1.0  # largest reprojection error of a static feature under the consensus motion


@dataclass(frozen=True, slots=True)
class Tracks:
    """The active features after a frame; older features come first."""

    ids: IntArray  # (N,) assigned when a feature is first output; arbitrary before
    left: FloatArray  # (N, 2) pixels
    right: FloatArray  # (N, 2) pixels, arbitrary where has_right is False
    has_right: BoolArray  # (N,)
    left_only_frames: IntArray  # (N,) frames in a row without a right match
    age: IntArray  # (N,) frames since detection
    shown: BoolArray  # (N,) output as observations
    point: FloatArray  # (N, 3) cam0 frame, metres; arbitrary where has_point is False
    has_point: BoolArray  # (N,)
    slot: IntArray  # (N,) row of the anchor in the bank
    warp: FloatArray  # (N, 2, 3) from offsets in the anchor to pixels of the left image
    skew: FloatArray  # (N, 2, 2) added to the linear part of the warp for the right image

    def __len__(self) -> int:
        return self.ids.size


@dataclass(frozen=True, slots=True)
class PreviousFrame:
    """State kept from the last frame that was not skipped."""

    time_ns: int
    left: ImageLevels
    right_half: Image | None  # None: there is no right camera
    tracks: Tracks
    twist_per_s: FloatArray  # (6,) camera motion `[rho; phi]` per second, from the last consensus
    trusted: bool  # the last motion had a consensus

    def expected_motion(self, time_ns: int) -> FloatArray:
        """The camera's motion (4, 4) `T_curr_prev` until a time, if it goes on as it was."""
        return se3_exp(self.twist_per_s * ((time_ns - self.time_ns) * 1e-9))

    def twist_until(self, time_ns: int, T_curr_prev: FloatArray) -> FloatArray:
        """The twist (6,) per second of a motion (4, 4) from this frame until a time."""
        return se3_log(T_curr_prev) / ((time_ns - self.time_ns) * 1e-9)


def new_tracks(left: FloatArray, slot: IntArray) -> Tracks:
    """New features at left pixels (N, 2), with anchors in slots (N,)."""
    n = len(left)
    return Tracks(
        ids=np.zeros(n, dtype=np.int64),
        left=left,
        right=np.zeros((n, 2)),
        has_right=np.zeros(n, dtype=np.bool_),
        left_only_frames=np.zeros(n, dtype=np.int64),
        age=np.zeros(n, dtype=np.int64),
        shown=np.zeros(n, dtype=np.bool_),
        point=np.zeros((n, 3)),
        has_point=np.zeros(n, dtype=np.bool_),
        slot=slot,
        warp=shift_warps(left),
        skew=np.zeros((n, 2, 2)),
    )


def no_tracks() -> Tracks:
    """No features."""
    return new_tracks(np.zeros((0, 2)), np.zeros(0, dtype=np.int64))


class AnchorBank:
    """Anchor templates of the active features, in reusable slots: anchors keep their slot while
    rows of tracks move.
    """

    def __init__(self, count: int, radius_px: int) -> None:
        self.store = empty_templates(count, radius_px)
        self.radius_px = radius_px
        side = 2 * (radius_px + 1 + MARGIN_PX) + 1
        self._sharp = np.zeros((count, side, side), np.float32)  # the patches as they were cut
        # (M, 2) of each anchor in the image that it was cut from, px/s; NaN: not known yet
        self.velocity: FloatArray = np.full((count, 2), np.nan)
        # (M, 3) by which each is blurred: variances along u and v, covariance, px^2
        self.spread: FloatArray = np.zeros((count, 3))
        self._taken = np.zeros(count, dtype=np.bool_)

    @classmethod
    def for_features(cls, count: int) -> AnchorBank:
        """Return a bank with room for the anchors of so many features at a time."""
        return cls(_BANK_FACTOR * count, ANCHOR_RADIUS_PX)

    @property
    def size(self) -> int:
        """Number of slots."""
        return len(self._taken)

    def add(self, image: Image, centres: FloatArray) -> IntArray:
        """Cut new anchors around pixels (N, 2) of an image; return their slots (N,)."""
        free = (~self._taken).nonzero()[0][: len(centres)]
        if len(free) < len(centres):
            self._grow(len(self._taken) + len(centres))
            free = (~self._taken).nonzero()[0][: len(centres)]
        self._taken[free] = True
        self.store.sigma[free] = 0.0
        self.replace(free, image, centres)
        return free

    def replace(self, slots: IntArray, image: Image, centres: FloatArray) -> None:
        """Replace the anchors in slots (N,) by the patches around pixels (N, 2) of an image."""
        self._sharp[slots] = cut_patches(image, centres, self.radius_px + MARGIN_PX)
        self.velocity[slots] = np.nan
        self.spread[slots] = 0.0
        self.blur(slots)

    def blurred(self, slots: IntArray) -> Patches:
        """Patches (N, 2r + 3, 2r + 3) of the anchors in slots (N,), blurred by their spread."""
        return spread_out(self._sharp, self.spread, slots)

    def blur(self, slots: IntArray) -> None:
        """Prepare the anchors in slots (N,) anew, blurred by their spread."""
        replace_templates(self.store, slots, self.blurred(slots))

    def sigma(self, slots: IntArray, *, depth_image: bool) -> SigmaArray:
        """Standard deviations (N, 3) of features in slots (N,) as in `Observations`; of a depth
        image that of `ul`.
        """
        out = self.store.sigma[slots]
        if depth_image:
            out[:, 2] = out[:, 0]
        return out

    def keep_only(self, slots: IntArray) -> None:
        """Free all slots but these."""
        self._taken[:] = False
        self._taken[slots] = True

    def _grow(self, count: int) -> None:
        """Add `count` empty slots."""
        more = AnchorBank(count, self.radius_px)
        self.store = joined(self.store, more.store)
        self._sharp = np.concatenate([self._sharp, more._sharp])
        self.velocity = np.concatenate([self.velocity, more.velocity])
        self.spread = np.concatenate([self.spread, more.spread])
        self._taken = np.concatenate([self._taken, more._taken])
