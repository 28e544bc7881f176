"""Anchors as blurred as the image that they are aligned with.

While the shutter is open, a feature moves: the image is blurred along its path, and an anchor that
was cut from a slower one is too sharp for it. By equation (F2), a velocity spreads a point by a
covariance; by how much the image spreads it more than the anchor, the anchor is blurred before both
are aligned. How long the shutter is open is learned from what alignments leave: by how much more the
image is blurred along the motion than across it, as noise and focus do both alike.
Reference: Jin, Favaro & Cipolla, Visual tracking in the presence of motion blur, CVPR (2005).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.frontend.align import Disc, Pixels, disc_of, warped_discs
from vio.frontend.blurring import MAX_SPREAD_PX2
from vio.frontend.tracks import AnchorBank
from vio.geometry.lie import FloatArray
from vio.numerics.compiled import compiled, dot, invert_positive
from vio.numerics.kinds import Tolerance
from vio.records import Image, IntArray


class _BlurRules(NamedTuple):
    """How the time that the shutter is open is learned."""

    memory: float = 0.95  # per frame, of what earlier ones have shown
    # standard deviation of a feature's blur beside what the noise of its pixels makes, px^2
    spread_px2: float = 0.2
    certain: float = 5.0  # standard deviations above zero before anchors are blurred
    features: int = 60  # that are asked in a frame


_RULES = _BlurRules()
_MIN_MOVED_PX: Tolerance[float] = 1.5  # since the last frame; others show nothing
_LEAST_PX2: Tolerance[float] = 0.02  # blur below which an anchor stays as it is
# Of a blur, by which it changes before an anchor is blurred anew, which moves what is aligned with it
# a little.
_CHANGE: Tolerance[float] = 0.4


class MotionBlur:
    """Learns how long the shutter is open, and blurs the anchors by it."""

    def __init__(self, bank: AnchorBank) -> None:
        """Prepare; the bank contains the anchors."""
        self._bank = bank
        self._sums: FloatArray = np.zeros(4)  # of w, w s^2, w s z, w z^2
        self.shutter_s2 = 0.0  # twelfth of the squared time, s^2; 0 until that is certain

    def apply(self, slots: IntArray, warp: FloatArray, velocity: FloatArray) -> None:
        """Blur the anchors in slots (N,) as the image is where warps (N, 2, 3) take them.

        Args:
            slots: of the anchors.
            warp: from anchors to the image.
            velocity: of the features in the image (N, 2), px/s.
        """
        bank = self._bank
        stale = np.empty(len(slots), np.int64)
        count = _set_spread(
            slots, warp, velocity, self.shutter_s2, bank.velocity, bank.spread, stale
        )
        if count:
            bank.blur(stale[:count])

    def learn(
        self, image: Image, slots: IntArray, warp: FloatArray, moved: FloatArray, step_s: float
    ) -> None:
        """Take in what the alignment of features (N,) has left.

        Args:
            image: that they were aligned with.
            slots: of their anchors.
            warp: that was fitted (N, 2, 3).
            moved: by how many pixels they have moved since the last frame (N, 2).
            step_s: time since then.
        """
        self._sums *= _RULES.memory
        rows = (np.abs(moved).max(axis=1, initial=0.0) >= _MIN_MOVED_PX).nonzero()[0]
        rows = rows[:: -(-len(rows) // _RULES.features) or 1]
        if not len(rows):
            return
        slots = slots[rows]
        bank = self._bank
        _add_features(
            bank.blurred(slots),
            warped_discs(image, warp[rows], bank.radius_px),
            disc_of(bank.radius_px),
            _Moving(
                warp[rows],
                moved[rows] / step_s,
                bank.velocity.take(slots, axis=0),
                bank.spread.take(slots, axis=0),
            ),
            (self.shutter_s2, _RULES.spread_px2**2),
            self._sums,
        )
        self.shutter_s2 = _certain(*self._sums.tolist())


def _certain(weight: float, information: float, product: float, squares: float) -> float:
    """The slope of z over s from their weighted sums; 0 where it is not certainly positive."""
    if not product > 0.0:
        return 0.0
    slope = product / information
    # Features that disagree by more than stated make it less certain. What one shows, such as by
    # depths that differ within its patch, it shows in every frame, so only one frame's count as many.
    disagreement = max((squares - slope * product) / weight, 1.0)
    independent = (1.0 - _RULES.memory) * information / disagreement
    certain = slope * slope * independent > _RULES.certain**2
    return slope if certain else 0.0


class _Moving(NamedTuple):
    """Features and their anchors in motion."""

    warp: FloatArray  # (N, 2, 3) from anchors to the image
    velocity: FloatArray  # (N, 2) in the image, px/s
    of_anchor: FloatArray  # (N, 2) of the anchor in its own image, px/s; not finite: unknown
    spread: FloatArray  # (N, 3) variances along u, v and covariance by which the anchor is blurred


@compiled
def _in_anchor(warp: FloatArray, u: float, v: float) -> tuple[float, float]:
    """A direction of the image, in pixels of the anchor that a warp (2, 3) takes there."""
    det = warp[0, 0] * warp[1, 1] - warp[0, 1] * warp[1, 0]
    return (warp[1, 1] * u - warp[0, 1] * v) / det, (warp[0, 0] * v - warp[1, 0] * u) / det


@compiled
def _faster(u: float, v: float, u0: float, v0: float) -> tuple[float, float, float]:
    """The square by which a velocity (u, v) is faster than (u0, v0) and the unit direction
    along which that is most: what is positive of `q q^T - q0 q0^T`.
    """
    a = u * u - u0 * u0
    b = v * v - v0 * v0
    c = u * v - u0 * v0
    half = 0.5 * (a - b)
    root = np.sqrt(half * half + c * c)
    most = 0.5 * (a + b) + root
    if not most > 0.0:
        return 0.0, 1.0, 0.0
    angle = 0.5 * np.arctan2(c, half)
    return most, np.cos(angle), np.sin(angle)


@compiled
def _set_spread(
    slots: IntArray,
    warp: FloatArray,
    velocity: FloatArray,
    shutter_s2: float,
    of_anchor: FloatArray,
    spread: FloatArray,
    stale: IntArray,
) -> int:
    """Write how far anchors in slots (N,) are to be spread, equation (F2); `stale` (N,) gets the
    slots of those that change, and their number is returned.

    An anchor that is aligned for the first time was cut at the velocity that it has now.
    """
    count = 0
    for n, slot in enumerate(slots):
        u, v = _in_anchor(warp[n], velocity[n, 0], velocity[n, 1])
        if np.isnan(of_anchor[slot, 0]):
            of_anchor[slot, 0] = u
            of_anchor[slot, 1] = v
        faster, x, y = _faster(u, v, of_anchor[slot, 0], of_anchor[slot, 1])
        wide = min(shutter_s2 * faster, MAX_SPREAD_PX2)
        if not wide >= _LEAST_PX2:
            wide = 0.0
        held = spread[slot, 0] + spread[slot, 1]
        change = abs(wide * x * x - spread[slot, 0])
        change = max(change, abs(wide * y * y - spread[slot, 1]))
        change = max(change, abs(wide * x * y - spread[slot, 2]))
        if change > _CHANGE * max(wide, held):
            spread[slot, 0] = wide * x * x
            spread[slot, 1] = wide * y * y
            spread[slot, 2] = wide * x * y
            stale[count] = slot
            count += 1
    return count


@compiled
def _add_features(
    patches: Pixels,
    views: Pixels,
    of: Disc,
    moving: _Moving,
    known: tuple[float, float],
    sums: FloatArray,
) -> None:
    """Add what features (N,) show of the shutter to the sums (4,) of w, w s^2, w s z, w z^2.

    Args:
        patches: their anchors as they were aligned (N, 2r + 3, 2r + 3).
        views: the image there (N, S).
        of: offsets (2, S) of the pixels from a patch's centre, and their weights (S,).
        moving: how they move.
        known: what `shutter_s2` is at present, and the variance of a blur beside that by noise.
        sums: that are added to.
    """
    xy = of.xy
    weights = of.weights
    shutter_s2, variance = known
    size = len(weights)
    side = patches.shape[1]
    at = np.empty(size, np.int64)  # of the pixels in a patch, row by row
    for k in range(size):
        at[k] = (side // 2 + int(xy[1, k])) * side + side // 2 + int(xy[0, k])
    columns = np.empty((5, size))
    weighted = np.empty((5, size))
    normal = np.empty((4, 4))
    inverse = np.empty((4, 4))
    product = np.empty(4)
    fit = np.empty(4)
    for n in range(len(patches)):
        spread = moving.spread[n]
        u, v = _in_anchor(moving.warp[n], moving.velocity[n, 0], moving.velocity[n, 1])
        faster, x, y = _faster(u, v, moving.of_anchor[n, 0], moving.of_anchor[n, 1])
        if not 0.0 < shutter_s2 * faster <= MAX_SPREAD_PX2 and not (
            shutter_s2 == 0.0 and faster > 0.0
        ):
            continue
        # The view is gain (patch + y (more along, less across) / 2 + m (more of both)) + offset.
        patch = patches[n].reshape(side * side)
        for k in range(size):
            m = at[k]
            twice = 2.0 * patch[m]
            uu = patch[m - 1] - twice + patch[m + 1]
            vv = patch[m - side] - twice + patch[m + side]
            uv = (
                patch[m + side + 1]
                - patch[m + side - 1]
                - patch[m - side + 1]
                + patch[m - side - 1]
            )
            columns[0, k] = patch[m] - 128.0
            columns[1, k] = 1.0
            columns[2, k] = 0.5 * (uu + vv)
            columns[3, k] = 0.25 * ((x * x - y * y) * (uu - vv) + x * y * uv)
            columns[4, k] = views[n, k] - 128.0
        for a in range(5):
            for k in range(size):
                weighted[a, k] = weights[k] * columns[a, k]
        for a in range(4):
            product[a] = dot(weighted[a], columns[4])
            for b in range(a + 1):
                normal[a, b] = dot(weighted[a], columns[b])
        square = dot(weighted[4], columns[4])
        for a in range(4):
            normal[a, a] += 1e-9 * normal[a, a] + 1e-9
        invert_positive(normal, inverse)
        for a in range(4):
            fit[a] = 0.0
            for b in range(4):
                fit[a] += inverse[a, b] * product[b]
        for a in range(4):
            square -= fit[a] * product[a]
        if not fit[0] > 0.1:
            continue
        noise = max(square, 0.0) / size * inverse[3, 3] / fit[0] ** 2
        held = (
            x * x * (spread[0] - spread[1])
            + y * y * (spread[1] - spread[0])
            + 4.0 * x * y * spread[2]
        )
        z = fit[3] / fit[0] + held
        w = 1.0 / (noise + variance)
        sums[0] += w
        sums[1] += w * faster * faster
        sums[2] += w * faster * z
        sums[3] += w * z * z
