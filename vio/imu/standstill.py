"""Standstill by an IMU's samples: white noise averages out over a tenth of a second, a motion does
not.

A steady turn and a steady acceleration look the same to an IMU. Equation (N10) of docs/math.md uses
the result.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vio.geometry.lie import FloatArray
from vio.numerics.statistics import chi_square_quantile

STANDSTILL_S = 0.5  # samples that are judged, and parts whose means are compared


class _BlockRules(NamedTuple):
    """Means of samples that are compared for a standstill."""

    length_s: float = 0.1
    min_blocks: int = 4  # with samples in them for a standstill to be concluded
    probability: float = 0.999  # of the chi-square test: a standstill passes so often


_BLOCKS = _BlockRules()
# by which a rig's noise may exceed the data sheet's, as the filter takes it at the start
NOISE_FACTOR = 5.0


def blocks_agree(times_s: FloatArray, values: FloatArray, density: float) -> bool:
    """Chi-square test that the means of a signal over blocks differ by white noise alone.

    Args:
        times_s: (N,) relative to the last sample, so zero or negative; down to `-STANDSTILL_S`.
        values: (N, 3).
        density: of the white noise by the data sheet, in the signal's unit per sqrt(Hz).
    """
    blocks = np.minimum(
        (-times_s / _BLOCKS.length_s).astype(np.int64), round(STANDSTILL_S / _BLOCKS.length_s) - 1
    )
    present = np.flatnonzero(np.bincount(blocks))
    if len(present) < _BLOCKS.min_blocks:
        return False
    means = np.array([values[blocks == k].mean(axis=0) for k in present])
    statistic = np.sum((means - means.mean(axis=0)) ** 2) / (
        (NOISE_FACTOR * density) ** 2 / _BLOCKS.length_s
    )
    return bool(statistic < chi_square_quantile(_BLOCKS.probability, 3 * (len(present) - 1)))
