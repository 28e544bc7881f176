"""Frames that are estimated again, as their IMU was wrong: what was found of their images stays."""

from __future__ import annotations

import numpy as np
import pytest

from vio.findings import Finding
from vio.geometry.stereo import StereoCamera
from vio.imu.findings import ImuVerdict
from vio.monitor.run import RunMonitor
from vio.monitor.update_checks import UpdatedFrame
from vio.records import Estimate, Observations, UpdateReport, observations

CAMERA = StereoCamera(400, 400, 320, 240, 0.1)
FRAMES = 60
STEP_NS = 50_000_000
IDS = np.arange(80)
PIXELS = np.random.default_rng(4).uniform([0, 0], [640, 480], (80, 2))


def _seen(k: int, *, right: bool = True) -> Observations:
    z = np.concatenate([PIXELS, PIXELS - [10.0, 0.0]], axis=1)
    return observations(k, k * STEP_NS, IDS, z, np.full(len(IDS), right))


def _updated(k: int, *, speed_mps: float = 0.0, right: bool = True) -> UpdatedFrame:
    T = np.eye(4)
    T[0, 3] = speed_mps * k * STEP_NS * 1e-9
    report = UpdateReport(80, 0, 0, 0, 0.3, 1.0, IDS, innovation_ratio=1.0)
    return UpdatedFrame(_seen(k, right=right), report, Estimate(k * STEP_NS, T, 1e-6 * np.eye(6)))


def _monitor(speed_mps: float) -> RunMonitor:
    """After a flight whose estimate by the IMU has a speed, with an object from frame 10 to 19."""
    monitor = RunMonitor(CAMERA, np.eye(4), imu=True)
    for k in range(FRAMES):
        said: tuple[Finding, ...] = ()
        if k == 10:
            said = (Finding("object-covers-image", "", k, lasts=True),)
        if k == 20:
            said = (Finding("object-covers-image", "", k, ended=True),)
        frame = _updated(k, speed_mps=speed_mps)
        assert frame.seen is not None
        monitor.observations(frame.seen, findings=said)
        monitor.update(k, frame.report, frame.estimate)
        monitor.judged(k, frame.estimate)
    return monitor


@pytest.mark.parametrize("used", [True, False])
def test_findings_of_images_hold_for_estimates_that_replace_others(used: bool) -> None:
    monitor = _monitor(speed_mps=150.0)
    assert "estimate-implausible" in {f.code for f in monitor.findings}
    again = monitor.begun_again(
        FRAMES - 1, ImuVerdict(usable=used), [_updated(k) for k in range(FRAMES)]
    )
    named = [k for k, e in again.items() if "object-covers-image" in e.findings]
    assert named == list(range(10, 20))
    if not used:
        assert named == [k for k, e in again.items() if e.integrity != "nominal"]


def test_findings_of_updates_are_those_of_the_new_ones() -> None:
    monitor = _monitor(speed_mps=0.0)
    frames = [_updated(k, speed_mps=150.0) for k in range(FRAMES)]
    again = monitor.begun_again(FRAMES - 1, ImuVerdict(usable=False), frames)
    assert again[FRAMES - 1].integrity == "unusable"
    calm = [_updated(k) for k in range(FRAMES)]
    again = monitor.begun_again(FRAMES - 1, ImuVerdict(usable=False), calm)
    assert again[FRAMES - 1].integrity == "nominal"


def test_a_doubt_of_the_imu_goes_on_after_frames_are_estimated_again() -> None:
    monitor = _monitor(speed_mps=0.0)
    monitor.add(Finding("imu-in-doubt", "", FRAMES - 1, lasts=True))
    before = monitor.judged(FRAMES - 1, _updated(FRAMES - 1).estimate)
    assert before.integrity == "degraded"
    doubted = ImuVerdict(in_doubt=True)
    again = monitor.begun_again(FRAMES, doubted, [_updated(k) for k in range(FRAMES)])
    assert again[FRAMES - 1].integrity == "nominal"
    after = monitor.judged(FRAMES, _updated(FRAMES).estimate)
    assert "imu-in-doubt" in after.findings
    assert after.integrity == "degraded"


def test_left_images_alone_leave_the_scale_uncertain() -> None:
    monitor = _monitor(speed_mps=0.0)
    frames = [_updated(k, speed_mps=1.0, right=k < 5) for k in range(FRAMES)]
    again = monitor.begun_again(FRAMES - 1, ImuVerdict(usable=False), frames)
    assert again[FRAMES - 1].covariance[0, 0] > 4.0 * frames[-1].estimate.covariance[0, 0]
