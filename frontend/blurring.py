"""Patches blurred by a covariance, by steps of diffusion."""

from __future__ import annotations

import numpy as np

from vio.frontend.align import Pixels
from vio.frontend.patches import Patches
from vio.geometry.lie import FloatArray
from vio.numerics.compiled import compiled
from vio.numerics.kinds import Tolerance
from vio.records import IntArray

_STEP_PX2: Tolerance[float] = 0.5  # of a diffusion, which takes a pixel of the margin
MARGIN_PX = 6  # of a patch, beyond what is returned of it
MAX_SPREAD_PX2 = MARGIN_PX * _STEP_PX2  # trace of a covariance: a path of 6 px


def spread_out(sharp: Patches, spread: FloatArray, slots: IntArray) -> Patches:
    """Blur patches and cut their margin off.

    A step of diffusion by half a covariance, `p + (c_uu p_uu + 2 c_uv p_uv + c_vv p_vv) / 2`, blurs
    by exactly that covariance.

    Args:
        sharp: patches (M, s, s).
        spread: variances along u and v and covariance (M, 3), px^2; trace at most `MAX_SPREAD_PX2`.
        slots: rows (N,) of those that are returned.

    Returns:
        Patches (N, s - 2 m, s - 2 m), m being `MARGIN_PX`.
    """
    side = sharp.shape[1] - 2 * MARGIN_PX
    out = np.empty((len(slots), side, side), np.float32)
    _spread_out(sharp, spread, slots, out)
    return out


@compiled
def _spread_out(sharp: Patches, spread: FloatArray, slots: IntArray, out: Patches) -> None:
    whole = sharp.shape[1]
    pixels = whole * whole
    side = out.shape[1]
    buffers = np.empty((2, pixels), np.float32)
    for n, slot in enumerate(slots):
        trace = spread[slot, 0] + spread[slot, 1]
        steps = int(np.ceil(trace / _STEP_PX2 - 1e-9))
        share = 0.5 / max(steps, 1)
        uu = np.float32(share * spread[slot, 0])
        vv = np.float32(share * spread[slot, 1])
        uv = np.float32(0.5 * share * spread[slot, 2])
        patch = sharp[slot].reshape(pixels)
        for step in range(MARGIN_PX - steps + 1, MARGIN_PX + 1):
            after = buffers[step % 2]
            first = step * (whole + 1)
            _diffuse(patch, first, pixels - 2 * first, whole, uu, vv, uv, after)
            patch = after
        for i in range(side):
            first = (MARGIN_PX + i) * whole + MARGIN_PX
            for j in range(side):
                out[n, i, j] = patch[first + j]


@compiled
def _diffuse(
    before: Pixels,
    first: int,
    count: int,
    whole: int,
    uu: np.float32,
    vv: np.float32,
    uv: np.float32,
    after: Pixels,
) -> None:
    """Write a step for `count` pixels from `first` on, row by row of `whole` pixels.

    Pixels at the ends of the rows get neighbours of other rows: they are of the margin. One loop
    over all rows, without indices that may be negative, takes the processor's vectors.
    """
    above = before[first - whole - 1 :]
    row = before[first - 1 :]
    below = before[first + whole - 1 :]
    out = after[first:]
    one = np.uint64(1)
    two = np.uint64(2)
    for k in range(np.uint64(count)):
        pixel = row[k + one]
        middle = pixel + pixel
        out[k] = (
            pixel
            + uu * (row[k] - middle + row[k + two])
            + vv * (above[k + one] - middle + below[k + one])
            + uv * (below[k + two] - below[k] - above[k + two] + above[k])
        )
