"""A right camera that was pitched after its calibration: rows apart by more than the search
along the row allows.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.frontend.test_frontend_scene import CAMERA, flight, stereo_frame
from vio.frontend.klt import KltFrontend
from vio.frontend.settings import DisparitySettings
from vio.frontend.stereo_fit import StereoFit
from vio.frontend.stereo_match import EpipolarRowModel, shifted_rows
from vio.frontend.tracks import AnchorBank
from vio.records import FrontendOutput, Image


def _moved_down(image: Image, rows: int) -> Image:
    return np.roll(image, rows, axis=0)


def _run(rows: int) -> list[FrontendOutput]:
    front = KltFrontend(CAMERA)
    out = []
    for k, T in enumerate(flight(5)):
        frame = stereo_frame(k, T)
        out.append(front.process(replace(frame, right=_moved_down(frame.right, rows))))
    return out


# -20: the wrong matches of frame 0 are 28, all contradicted
@pytest.mark.parametrize("rows", [-20, -12, 7, 24])
def test_finds_the_rows_of_a_pitched_camera_within_a_few_frames(rows: int) -> None:
    plain, pitched = _run(0), _run(rows)
    assert pitched[0].matched < 0.3 * plain[0].matched  # without the search it stays so
    last = pitched[-1]
    assert last.matched > 0.7 * plain[-1].matched
    seen = last.observations.take(last.observations.has_right)
    np.testing.assert_allclose(np.median(seen.z[:, 3] - seen.z[:, 1]), rows, atol=0.1)


def test_rows_that_agree_are_not_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(field: EpipolarRowModel, offset_px: float) -> None:
        raise AssertionError("restarted the rows of a good pair")

    monkeypatch.setattr(EpipolarRowModel, "restart", refuse)
    assert _run(0)[-1].matched > 50


@pytest.mark.parametrize("rows", [40, -40])
def test_rows_learned_beyond_the_search_are_found_again(rows: int) -> None:
    """Rows that are followed may go on to where none is searched from zero."""
    frame = stereo_frame(0, flight(1)[0])
    left, right = cv2.pyrDown(frame.left), cv2.pyrDown(_moved_down(frame.right, rows))
    height, width = frame.left.shape
    points = np.random.default_rng(0).uniform([60, 60], [width - 60, height - 60], (200, 2))
    fit = StereoFit(CAMERA, DisparitySettings(), AnchorBank(9, 9), (width, height))
    fit._rows.restart(rows + 2.0)
    fit._unmatched = 1  # now other rows are tried
    assert fit.search(left, right, points)[1].mean() > 0.5


def test_shifting_rows_repeats_the_last_one() -> None:
    image = np.arange(12, dtype=np.uint8).reshape(4, 3)
    np.testing.assert_array_equal(shifted_rows(image, 1), image[[1, 2, 3, 3]])
    np.testing.assert_array_equal(shifted_rows(image, -2), image[[0, 0, 0, 1]])
    assert shifted_rows(image, 0) is image
