"""A pair whose disparities are far off has a baseline and a focal length that are less known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.filters.test_filter_truth import CAMERA, SETTINGS, Course, fly
from vio.filters.rig_calibration import field_doubt, scale_sigma
from vio.filters.settings import MsckfSettings
from vio.records import Observations

USUAL = np.radians(MsckfSettings().stereo_yaw_sigma_deg)  # of the mean disparity, focal lengths
COURSE = Course(20, 2.5, velocity=(0.4, 0.5, 0.0), yaw_rate=0.2, depth=(2.0, 8.0), features=80)


def _doubt(mean: float, sigma: float = 0.0) -> float:
    field = np.zeros(8)
    field[0] = mean
    covariance = np.zeros((8, 8))
    covariance[0, 0] = sigma**2
    return field_doubt(CAMERA, MsckfSettings(), field, covariance)


def test_a_usual_calibration_is_as_good_as_stated() -> None:
    assert _doubt(0.0) == _doubt(0.99 * USUAL) == 0.0


@pytest.mark.parametrize("times", [2.0, 5.0])
def test_scale_and_disparities_are_off_alike(times: float) -> None:
    usual = scale_sigma(MsckfSettings())
    assert np.hypot(_doubt(times * USUAL), usual) == pytest.approx(times * usual)


def test_features_without_a_known_size_of_the_images_are_doubted_as_well() -> None:
    unknown = replace(CAMERA, width=None, height=None)
    field = np.array([3.0 * USUAL, *np.zeros(7)])
    assert field_doubt(unknown, MsckfSettings(), field, np.zeros((8, 8))) > 0.0


def test_what_noise_explains_is_no_error_of_the_rig() -> None:
    assert _doubt(2.0 * USUAL, sigma=2.0 * USUAL) == 0.0


def test_the_covariance_of_a_run_holds_it() -> None:
    """Of the same points, seen by a pair whose right camera is turned by half a degree."""
    off_px = np.array([0.0, 0.0, 10.0 * USUAL * CAMERA.fu, 0.0])

    def turned(k: int, seen: Observations) -> Observations:
        return replace(seen, z=seen.z + off_px)

    settings = replace(SETTINGS, calibrate_stereo="on", stereo_baseline_sigma=0.005)
    shares = []
    for spoil in (None, turned):
        last = fly(COURSE, None, settings, spoil=spoil).estimates[-1]
        sigma_m = np.sqrt(np.trace(last.covariance[:3, :3]))
        shares.append(sigma_m / np.linalg.norm(last.T_world_imu[:3, 3]))
    assert shares[1] > 3.0 * shares[0]
    assert shares[1] == pytest.approx(10.0 * scale_sigma(settings), rel=0.4)
