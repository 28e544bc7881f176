"""Frames that are estimated again, as their IMU was wrong: what was found of their images stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vio.findings import Finding
from vio.geometry.stereo import StereoCamera
from vio.imu.findings import ImuVerdict
from vio.monitor.run import RunMonitor
from vio.monitor.update_checks import UpdatedFrame
from vio.records import (
    Estimate,
    Observations,
    StereoFieldEstimate,
    StereoScaleEstimate,
    UpdateReport,
    observations,
)

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


def _unseen(k: int) -> UpdatedFrame:
    """A frame that the back end uses no feature of."""
    frame = _updated(k)
    report = UpdateReport(0, 0, 0, 0, None, None, IDS[:0], innovation_ratio=None)
    return UpdatedFrame(frame.seen, report, frame.estimate)


def _given(monitor: RunMonitor, frames: list[UpdatedFrame]) -> None:
    for frame in frames:
        assert frame.seen is not None
        index = frame.seen.frame_index
        monitor.observations(frame.seen)
        monitor.update(index, frame.report, frame.estimate)
        monitor.judged(index, frame.estimate)


def test_what_lasts_of_estimates_that_are_replaced_ends_with_them() -> None:
    """But for what the new ones show, too."""
    unseen = [_updated(k) if k < 20 else _unseen(k) for k in range(FRAMES)]
    for again, ended in ((unseen, False), ([_updated(k) for k in range(FRAMES)], True)):
        monitor = RunMonitor(CAMERA, np.eye(4), imu=True)
        _given(monitor, unseen)
        monitor.begun_again(FRAMES, ImuVerdict(usable=False), again)
        (begun, *ends) = [f for f in monitor.findings if f.code == "no-features"]
        assert begun.lasts
        assert [(f.frame, f.ended) for f in ends] == ended * [(FRAMES, True)]


def test_distorted_pixels_are_in_doubt_though_rows_that_differ_are_not_any_more() -> None:
    """Both checks have one code; the end of the one that updates ask ended the other's, too."""
    field = StereoFieldEstimate(np.zeros(8), np.eye(8), 30.0)
    frames = [_updated(k) for k in range(FRAMES)]
    off = [replace(f, estimate=replace(f.estimate, stereo_field=field)) for f in frames]
    for distorted in (True, False):
        monitor = RunMonitor(CAMERA, np.eye(4), imu=True)
        if distorted:
            monitor.add(Finding("other-calibration", "", 0, lasts=True))
        _given(monitor, off)
        assert "other-calibration" in {f.code for f in monitor.findings if f.frame == 0}
        again = monitor.begun_again(FRAMES, ImuVerdict(usable=False), frames)
        after = monitor.judged(FRAMES, _updated(FRAMES).estimate)
        for estimate in (again[FRAMES - 1], after):
            assert ("other-calibration" in estimate.findings) == distorted


def test_a_restart_of_a_back_end_that_takes_all_again_is_reported() -> None:
    monitor = _monitor(speed_mps=0.0)
    frames = [_updated(k) for k in range(FRAMES)]
    frames[40] = replace(frames[40], restarted="frame 40: the filter diverged")
    again = monitor.begun_again(FRAMES, ImuVerdict(usable=False), frames)
    (found,) = [f for f in monitor.findings if f.code == "estimate-restarted"]
    assert found.frame == 40
    assert "estimate-restarted" in again[40].findings


def test_images_alone_contradict_no_imu() -> None:
    monitor = _monitor(speed_mps=0.0)
    far = [_updated(k) for k in range(FRAMES)]
    far = [replace(f, report=replace(f.report, innovation_ratio=6.0)) for f in far]
    monitor.begun_again(FRAMES, ImuVerdict(usable=False), far)
    assert "imu-disagrees" not in {f.code for f in monitor.findings}
    monitor.begun_again(FRAMES, ImuVerdict(), far)
    assert "imu-disagrees" in {f.code for f in monitor.findings}


def test_a_contradiction_ends_where_the_run_goes_on_without_the_imu() -> None:
    monitor = RunMonitor(CAMERA, np.eye(4), imu=True)
    far = [_updated(k) for k in range(FRAMES)]
    _given(monitor, [replace(f, report=replace(f.report, innovation_ratio=6.0)) for f in far])
    monitor.goes_on_from(FRAMES, ImuVerdict(usable=False))
    found = [f.ended for f in monitor.findings if f.code == "imu-disagrees"]
    assert found == [False, True]


def test_a_scale_by_estimates_that_are_replaced_is_not_reported() -> None:
    monitor = _monitor(speed_mps=0.0)
    off = StereoScaleEstimate(np.array([0.2, 0.0]), np.diag([1e-6, 1e-6]))
    frame = _updated(FRAMES)
    assert frame.seen is not None
    _given(monitor, [replace(frame, estimate=replace(frame.estimate, stereo_scale=off))])
    monitor.begun_again(FRAMES + 1, ImuVerdict(usable=False), [_updated(k) for k in range(FRAMES)])
    monitor.close()
    assert "scale-off" not in {f.code for f in monitor.findings}
