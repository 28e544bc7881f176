"""Jitter of camera stamps, told from intervals that truly vary, by the gyro's rotation between
the exposures.
"""

from __future__ import annotations

import numpy as np
import pytest

from vio.geometry.lie import FloatArray
from vio.monitor.gyro_fit import judge_stamps
from vio.monitor.motion import Intervals, Record, record_of

STEP_S = 0.05


def _record(
    stamps_s: FloatArray, exposures_s: FloatArray, *, rate: float = 0.6, noise_rad: float = 2e-4
) -> Record:
    """A turn that swings about one axis, seen at exposures that carry stamps."""
    rng = np.random.default_rng(4)
    t = np.arange(0, 12, 0.005)
    gyro = rate * np.cos(1.3 * t)
    readings = np.zeros((len(t), 6))
    readings[:, 1] = gyro + rng.normal(0, 3e-3, len(t))
    angle = rate / 1.3 * np.sin(1.3 * exposures_s)
    turned = np.diff(angle) + rng.normal(0, noise_rad, len(angle) - 1)
    stamps_ns = np.round(stamps_s * 1e9).astype(np.int64)
    twists = np.zeros((len(turned), 6))
    twists[:, 4] = turned / np.diff(stamps_ns * 1e-9)
    return record_of(
        Intervals(stamps_ns[:-1], stamps_ns[1:], twists),
        np.round(t * 1e9).astype(np.int64),
        readings,
    )


STEADY = 1.0 + STEP_S * np.arange(200)
JITTER = np.random.default_rng(1).normal(0, 1, 200)


@pytest.mark.parametrize("jitter_ms", [1.0, 3.0])
def test_names_jitter_with_its_size(jitter_ms: float) -> None:
    finding = judge_stamps(_record(STEADY + 1e-3 * jitter_ms * JITTER, STEADY))
    assert finding.fault == "camera stamps"
    size_ms = float(finding.seen.split("off by ")[1].split(" ms")[0])
    assert 0.7 * jitter_ms < size_ms < 1.3 * jitter_ms  # a robust estimate by 200 intervals


def test_says_nothing_of_steady_irregular_or_motionless_frames() -> None:
    assert judge_stamps(_record(STEADY, STEADY)) is None
    irregular = STEADY + 3e-3 * JITTER  # exposures that truly come so
    assert judge_stamps(_record(irregular, irregular)) is None
    dropped = np.delete(STEADY, np.arange(7, 190, 9))
    assert judge_stamps(_record(dropped, dropped)) is None
    assert judge_stamps(_record(STEADY + 3e-3 * JITTER, STEADY, rate=0.02)) is None
    assert judge_stamps(_record(STEADY + 3e-3 * JITTER, STEADY, noise_rad=0.01)) is None
