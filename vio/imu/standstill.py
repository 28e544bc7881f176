"""Standstill by an IMU's samples: white noise averages out over a tenth of a second, a motion does
not.

A steady turn and a steady acceleration look the same to an IMU. Equation (N10) of docs/math.md uses
the result.
"""

from __future__ import annotations

import numpy as np

from vio.geometry.lie import FloatArray
from vio.numerics.statistics import chi_square_quantile

STANDSTILL_S = 0.5  # samples that are judged, and parts whose means are compared
_BLOCK_S = 0.1
# by which a rig's noise may exceed the data sheet's, as the filter takes it at the start
NOISE_FACTOR = 5.0
_MIN_BLOCKS = 4  # with samples in them for a standstill to be concluded
_PROBABILITY = 0.999  # of the chi-square test: a standstill passes so often


def blocks_agree(times_s: FloatArray, values: FloatArray, density: float) -> bool:
    """Chi-square test that the means of a signal over blocks differ by white noise alone.

    Args:
        times_s: (N,) relative to the last sample, so zero or negative; down to `-STANDSTILL_S`.
        values: (N, 3).
        density: of the white noise by the data sheet, in the signal's unit per sqrt(Hz).
    """
    blocks = np.minimum((-times_s / _BLOCK_S).astype(np.int64), round(STANDSTILL_S / _BLOCK_S) - 1)
    present = np.flatnonzero(np.bincount(blocks))
    if len(present) < _MIN_BLOCKS:
        return False
    means = np.array([values[blocks == k].mean(axis=0) for k in present])
    statistic = np.sum((means - means.mean(axis=0)) ** 2) / (
        (NOISE_FACTOR * density) ** 2 / _BLOCK_S
    )
    return bool(statistic < chi_square_quantile(_PROBABILITY, 3 * (len(present) - 1)))
