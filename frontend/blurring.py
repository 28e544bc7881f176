"""Patches blurred by a covariance, by steps of diffusion."""

from __future__ import annotations

import numpy as np

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
    before = np.empty((whole, whole), np.float32)
    after = np.empty((whole, whole), np.float32)
    for n, slot in enumerate(slots):
        trace = spread[slot, 0] + spread[slot, 1]
        steps = int(np.ceil(trace / _STEP_PX2 - 1e-9))
        first = MARGIN_PX - steps
        for i in range(first, whole - first):
            for j in range(first, whole - first):
                before[i, j] = sharp[slot, i, j]
        share = 0.5 / max(steps, 1)
        uu = np.float32(share * spread[slot, 0])
        vv = np.float32(share * spread[slot, 1])
        uv = np.float32(0.5 * share * spread[slot, 2])
        for step in range(first + 1, MARGIN_PX + 1):
            for i in range(step, whole - step):
                for j in range(step, whole - step):
                    middle = before[i, j] + before[i, j]
                    after[i, j] = (
                        before[i, j]
                        + uu * (before[i, j - 1] - middle + before[i, j + 1])
                        + vv * (before[i - 1, j] - middle + before[i + 1, j])
                        + uv
                        * (
                            before[i + 1, j + 1]
                            - before[i + 1, j - 1]
                            - before[i - 1, j + 1]
                            + before[i - 1, j - 1]
                        )
                    )
            for i in range(step, whole - step):
                for j in range(step, whole - step):
                    before[i, j] = after[i, j]
        for i in range(out.shape[1]):
            for j in range(out.shape[1]):
                out[n, i, j] = before[MARGIN_PX + i, MARGIN_PX + j]
