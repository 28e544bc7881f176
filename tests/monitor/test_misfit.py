"""Tracks that fit no common motion: found by what their patches do not explain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vio.geometry.stereo import StereoCamera
from vio.monitor.misfit import TrackMisfit
from vio.monitor.run import RunMonitor
from vio.records import Estimate, Observations, UpdateReport, observations

STEP_NS = 50_000_000
COUNT = 60  # features of a frame


def _frame(k: int, sigma_px: float | None = 0.05, count: int = COUNT) -> Observations:
    seen = observations(k, k * STEP_NS, np.arange(count), np.ones((count, 4)))
    if sigma_px is None:
        return seen
    return replace(seen, sigma=np.full((count, 3), sigma_px, dtype=np.float32))


def _found(
    misfits: list[float], sigmas_px: list[float | None] | None = None, count: int = COUNT
) -> list[tuple[int | None, int | None, bool]]:
    """Frame, first frame and whether it ended, of all findings of frames with such misfits."""
    check = TrackMisfit()
    found = []
    for k, misfit in enumerate(misfits):
        sigma_px = 0.05 if sigmas_px is None else sigmas_px[k]
        found += check.frame(_frame(k, sigma_px, count), misfit)
    return [(f.frame, f.first_frame, f.ended) for f in found]


def test_errors_that_patches_do_not_explain_are_named_from_where_their_tracks_began() -> None:
    assert _found([1.0] * 20 + [1.65] * 10) == [(22, 13, False)]  # three of five frames
    assert _found([1.0] * 20 + [1.55] * 10) == []
    assert _found([1.0] * 20 + [1.65] * 2 + [1.0] * 10) == []


def test_it_is_over_after_twenty_frames_that_agree() -> None:
    misfits = [1.0] * 20 + [2.0] * 10 + [1.0] * 30
    assert _found(misfits) == [(22, 13, False), (51, 51, True)]
    again = [*misfits[:40], 2.0, 2.0, 2.0, *[1.0] * 30]
    assert _found(again) == [(22, 13, False), (64, 64, True)]


@pytest.mark.parametrize("noise", [1.5, 3.0, 10.0])
def test_noise_that_sets_in_is_in_patches_as_in_tracks(noise: float) -> None:
    """The filter learns the noise of pixels by up to 7 % in a frame."""
    learned = np.minimum(1.0 * 4.0 ** (0.05 * np.arange(80)), noise**2)
    misfits = [1.0] * 20 + list(noise**2 / learned)
    sigmas_px: list[float | None] = [0.05] * 20 + [0.05 * noise] * 80
    assert _found(misfits, sigmas_px) == []
    assert _found(misfits) != []


def test_sharper_images_excuse_nothing_and_accuse_nothing() -> None:
    sharp: list[float | None] = [0.05] * 20 + [0.02] * 20
    assert _found([1.0] * 40, sharp) == []
    assert _found([1.0] * 20 + [1.65] * 20, sharp) == [(22, 13, False)]


def test_features_whose_patches_state_nothing_are_not_judged() -> None:
    assert _found([3.0] * 40, [None] * 40) == []
    assert _found([3.0] * 40, [0.0] * 40) == []  # none of them was aligned
    assert _found([3.0] * 40, count=29) == []
    assert _found([3.0] * 40, count=30) != []


def updated(
    monitor: RunMonitor, seen: Observations, misfit: float = 1.0, *, measured: bool = False
) -> Estimate:
    """Give a monitor a frame of a rig that moves along x, and return its estimate."""
    k = seen.frame_index
    monitor.observations(seen)
    T = np.eye(4)
    T[0, 3] = 0.05 * k
    estimate = Estimate(seen.time_ns, T, 1e-6 * np.eye(6))
    update = UpdateReport(100, 0, 0, 0, 0.3, 1.0, misfit=misfit)
    monitor.update(k, update, estimate, measured=measured)
    return monitor.judged(k, estimate)


@pytest.mark.parametrize("measured", [True, False])
def test_estimates_of_a_motion_that_nothing_measures_are_degraded(measured: bool) -> None:
    monitor = RunMonitor(StereoCamera(400, 400, 320, 240, 0.1), np.eye(4), imu=False)
    estimates = [
        updated(monitor, _frame(k), 2.0 if k >= 20 else 1.0, measured=measured) for k in range(40)
    ]
    codes = [finding.code for finding in monitor.findings]
    assert codes == ([] if measured else ["tracks-disagree"])
    assert estimates[-1].integrity == ("nominal" if measured else "degraded")
    marks = monitor.take_marks()
    assert [(m.since, m.before) for m in marks] == ([] if measured else [(13, 22)])
