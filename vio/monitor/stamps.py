"""Jitter of the camera's stamps: their intervals scatter, but the rotation between exposures follows a steady clock."""

from __future__ import annotations

import numpy as np

from vio.imu.findings import InertialFinding
from vio.monitor.motion import Record
from vio.numerics.robust import robust_sigma

_LEAST_INTERVALS = 40
_LEAST_RATE_RADPS = 0.1  # where a millisecond is 0.1 mrad, about what the images resolve
_LEAST_JITTER_S = 5e-4  # standard deviation of the intervals; smaller does little harm
_SLOPE = 0.7, 1.3  # of the time missed by the gyro over the stamps' deviation: 1 for jitter, 0 for true intervals
_LEAST_CORRELATION = 0.7


def judge_stamps(record: Record) -> InertialFinding | None:
    """Compare each interval's deviation from the usual one with the time that the camera's rotation took by the gyro.

    Over an interval of stamps `dt` the gyro turns at a mean rate `w`; the images show an angle `a`, so the exposures
    lay `a / w` apart. Where `a / w - dt` is the negative of `dt - median(dt)`, the stamps are wrong, not the exposures.
    """
    means, covered = record.means(np.zeros(1))
    gyro = np.linalg.norm(means[0, :, :3], axis=1)
    camera = np.linalg.norm(record.twists[:, 3:], axis=1)
    dt = record.end - record.begin
    usual = float(np.median(dt)) if len(dt) else 0.0
    used = covered[0] & (gyro > _LEAST_RATE_RADPS) & (np.abs(dt - usual) < 0.5 * usual)
    if used.sum() < _LEAST_INTERVALS or robust_sigma(dt[used] - usual) < _LEAST_JITTER_S:
        return None
    weight = gyro[used]  # the angle's error is the same everywhere, the time's error falls with the rate
    deviation = weight * (dt[used] - usual)
    missed = weight * (dt[used] - dt[used] * camera[used] / gyro[used])
    slope = float(deviation @ missed / (deviation @ deviation))
    correlation = float(deviation @ missed / np.sqrt((deviation @ deviation) * (missed @ missed)))
    if not _SLOPE[0] < slope < _SLOPE[1] or correlation < _LEAST_CORRELATION:
        return None
    jitter_ms = 1e3 * robust_sigma(dt[used] - usual) / np.sqrt(2)
    return InertialFinding(
        "camera stamps",
        f"the frames' intervals scatter as if each stamp were off by {jitter_ms:.1f} ms (standard deviation), but the "
        f"gyro shows exposures at a steady {1e3 * usual:.1f} ms",
        "the stamps jitter, perhaps taken when the image arrived; stamp frames at the exposure, by the camera's clock",
    )
