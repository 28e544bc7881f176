"""A right camera that gives way in its mount during a run: its rows show it, and put the columns in
doubt.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.filters.test_filter_truth import CAMERA, SETTINGS, Course, fly
from vio.filters.stereo_calibration import VerticalDisparityModel
from vio.records import Observations

COURSE = Course(20, 2.5, velocity=(0.4, 0.5, 0.0), yaw_rate=0.2, depth=(2.0, 8.0), features=80)
ON = replace(SETTINGS, calibrate_stereo="on")
MOVED_AT = 30  # frame, of 50
COLUMNS_PX = 2.0
ROWS_PX = 0.3  # after it; before, as much the other way, so that their size stays


BEFORE_PX = np.array([0.0, 0.0, 0.0, -ROWS_PX])
OFF_PX = np.array([0.0, 0.0, COLUMNS_PX, ROWS_PX])


def _off(k: int, seen: Observations) -> Observations:
    return replace(seen, z=seen.z + OFF_PX)


def _moved(k: int, seen: Observations) -> Observations:
    return replace(seen, z=seen.z + (OFF_PX if k >= MOVED_AT else BEFORE_PX))


@pytest.fixture
def anew(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How often rows were learned anew."""
    calls: list[int] = []
    forget = VerticalDisparityModel.forget

    def spy(model: VerticalDisparityModel) -> None:
        calls.append(1)
        forget(model)

    monkeypatch.setattr(VerticalDisparityModel, "forget", spy)
    return calls


def test_columns_follow_a_right_camera_whose_rows_move(anew: list[int]) -> None:
    run = fly(COURSE, None, ON, spoil=_moved)
    field = run.estimates[-1].stereo_field
    assert field is not None
    off_px = float(field.coefficients[0]) * CAMERA.fu - COLUMNS_PX
    sigma_px = float(np.sqrt(field.covariance[0, 0])) * CAMERA.fu
    assert len(anew) > 1  # the first one is the start
    assert abs(off_px) < 3 * sigma_px
    assert field.rows is not None
    assert field.rows[0] * CAMERA.fv == pytest.approx(ROWS_PX, abs=0.1)


def test_rows_of_a_rig_that_stays_are_learned_once(anew: list[int]) -> None:
    """Half a pixel of noise, and a rig that is off from the start."""
    noisy = replace(COURSE, pixel_sigma_px=0.5)
    fly(noisy, None, replace(ON, pixel_sigma_px=0.5), spoil=_off)
    assert len(anew) == 1
