"""Refused features: quiet on usual shares, one line with the cause that the evidence names."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vio.geometry.lie import FloatArray
from vio.geometry.stereo import StereoCamera
from vio.imu.findings import ImuVerdict
from vio.monitor.health import RefusalReport
from vio.monitor.run import RunMonitor
from vio.records import (
    BoolArray,
    Estimate,
    Observations,
    StereoFieldEstimate,
    UpdateReport,
    observations,
)

_PIXELS = np.stack(
    np.meshgrid(np.linspace(10, 630, 16), np.linspace(10, 470, 12)), axis=-1
).reshape(-1, 2)
_ALL = np.ones(len(_PIXELS), dtype=bool)
_CORNER = (_PIXELS[:, 0] > 500) & (_PIXELS[:, 1] < 120)


def _lines(
    refused: BoolArray,
    *,
    share: float,
    ratio: float = 1.0,
    imu: bool = False,
    rows_px: float = 0.0,
    first_id: int = 0,
) -> list[str]:
    """Lines over 2 s of frames of which a share of the features is refused, drawn among those of
    a mask.
    """
    report, rng, ids = RefusalReport(imu=imu), np.random.default_rng(0), np.arange(len(_PIXELS))
    field = StereoFieldEstimate(np.zeros(8), np.eye(8), rows_px, np.ones(7), 1e-4 * np.eye(7))
    lines: list[str] = []
    for k in range(40):
        gone = rng.permutation(ids[refused])[: int(share * len(ids))]
        z: FloatArray = np.concatenate([_PIXELS, _PIXELS], axis=1)
        seen = Observations(
            k, k * 50_000_000, ids, z, np.ones(len(ids), dtype=bool), np.zeros(len(ids), dtype=bool)
        )
        update = UpdateReport(
            100,
            int(100 * share / (1 - share)),
            0,
            0,
            0.3,
            1.0,
            gone + first_id,
            innovation_ratio=ratio,
        )
        found = report.frame(
            seen, update, replace(Estimate(seen.time_ns, np.eye(4), np.eye(6)), stereo_field=field)
        )
        lines += [finding.message for finding in found]
    return lines


def test_the_share_of_healthy_recordings_is_not_reported() -> None:
    assert _lines(_ALL, share=0.3, ratio=5.0, imu=True, rows_px=1.0) == []


def test_many_refused_features_are_reported_once_with_the_cause() -> None:
    (spread,) = _lines(_ALL, share=0.5)
    assert spread.startswith("frame 20: 50 % of the features of the last second")
    assert "spread over the image; blurred" in spread
    (calibration,) = _lines(_ALL, share=0.5, rows_px=0.8)
    assert "rows differ by 0.80 px" in calibration
    (by_imu,) = _lines(_ALL, share=0.5, ratio=4.0, imu=True, rows_px=0.8)
    assert "4.0 standard deviations beside where the IMU predicts them; check the IMU" in by_imu
    assert "IMU" not in _lines(_ALL, share=0.5, ratio=4.0)[0]


def test_refused_features_that_lie_together_are_something_that_moves() -> None:
    (line,) = _lines(_CORNER, share=0.5, ratio=1.5, imu=True, rows_px=0.8)
    assert "most lie together in the image, around (5" in line


def test_where_nothing_says_which_features_are_refused_they_are_not_said_to_be_spread() -> None:
    (line,) = _lines(_ALL, share=0.5, first_id=1_000)  # of tracks that have ended
    assert line.endswith(
        "contradict the others: blurred images, repeated texture, or many things that move"
    )
    (calibration,) = _lines(_ALL, share=0.5, rows_px=0.8, first_id=1_000)
    assert calibration.endswith(
        "rows differ by 0.80 px (rms) in a smooth pattern; calibrate the cameras (vio calibrate)"
    )


@pytest.mark.parametrize("usable", [True, False])
def test_an_imu_that_is_not_used_any_more_predicts_nothing(usable: bool) -> None:
    monitor, ids = (
        RunMonitor(StereoCamera(400, 400, 320, 240, 0.1), np.eye(4), imu=True),
        np.arange(len(_PIXELS)),
    )
    monitor.begun_again(0, ImuVerdict(usable=usable), [])
    for k in range(1, 40):
        seen = observations(k, k * 50_000_000, ids, np.concatenate([_PIXELS, _PIXELS], axis=1))
        monitor.observations(seen)
        update = UpdateReport(100, 100, 0, 0, 0.3, 1.0, ids[::2], innovation_ratio=4.0)
        monitor.update(k, update, Estimate(seen.time_ns, np.eye(4), np.eye(6)))
    (line,) = (line for line in monitor.lines if "refused" in line)
    assert ("check the IMU" in line) == usable
