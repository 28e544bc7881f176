"""Left and right images exchanged for some frames: put back, refused where they do not fit, and
named.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.frontend.test_frontend_klt import FRAMES
from tests.frontend.test_frontend_scene import CAMERA
from tests.frontend.test_right_camera import pair
from tests.guards import guarded_klt, lines_of
from vio.frontend.settings import FrontendSettings, GridSettings
from vio.guard.exchange import ExchangeDetector, MatchCounts
from vio.guard.probe import RowProbe
from vio.records import FrontendOutput, Image

SETTINGS = FrontendSettings(grid=GridSettings(target_features=150))
IN_ORDER, SWAPPED, CROOKED = MatchCounts(80, 70, 3), MatchCounts(80, 20, 75), MatchCounts(80, 4, 25)
FEW = MatchCounts(80, 3, 5)


def run(swapped: range, there: MatchCounts = SWAPPED) -> tuple[list[str], list[str], int]:
    """The order of each of ten frames, the lines, and how often matches were counted."""
    detector, orders, lines, counted = ExchangeDetector(RowProbe()), [], [], []
    for k in range(10):
        left, right = pair(k)[:: -1 if k in swapped else 1]

        def count(k: int = k) -> MatchCounts:
            counted.append(k)
            return there if k in swapped else IN_ORDER

        orders.append(detector.order(k, left, right, count, suspicious=False))
        lines += lines_of(detector)
    return orders, lines, len(counted)


def test_matches_are_not_counted_while_the_images_are_in_order() -> None:
    assert run(range(0)) == (["given"] * 10, [], 0)


def test_exchanged_frames_are_put_back_and_named_once() -> None:
    orders, lines, _ = run(range(4, 7))
    assert orders == ["given"] * 4 + ["exchanged"] * 3 + ["given"] * 3
    exchanged, again = lines
    assert exchanged.startswith("frame 4: left and right images are exchanged from here on")
    assert exchanged.endswith("they are put back")
    assert again == "frame 7: left and right images are in order again"


def test_exchanged_frames_that_do_not_fit_when_put_back_are_refused() -> None:
    """As with cameras whose images were rectified with each other's maps: rows differ, and a
    part matches only.
    """
    orders, lines, _ = run(range(4, 7), CROOKED)
    assert orders == ["given"] * 4 + ["refused"] * 3 + ["given"] * 3
    assert lines[0].endswith("the frames are skipped")


@pytest.mark.parametrize(
    "there", [IN_ORDER, FEW, MatchCounts(5, 0, 5)], ids=["in order", "few", "few points"]
)
def test_what_looks_exchanged_but_does_not_match_so_is_used_as_given(there: MatchCounts) -> None:
    orders, lines, counted = run(range(4, 7), there)
    assert orders == ["given"] * 10
    assert lines == []
    assert counted > 0


def test_front_end_gives_the_same_output_to_the_bit_where_two_frames_are_exchanged() -> None:
    def outputs(swapped: range) -> list[FrontendOutput]:
        frontend = guarded_klt(CAMERA, SETTINGS)
        return [
            frontend.process(replace(f, left=f.right, right=f.left) if f.index in swapped else f)
            for f in FRAMES[:5]
        ]

    for expected, found in zip(outputs(range(0)), outputs(range(2, 4)), strict=True):
        np.testing.assert_array_equal(found.observations.ids, expected.observations.ids)
        np.testing.assert_array_equal(found.observations.z, expected.observations.z)
        assert bool(found.findings) == (found.observations.frame_index in (2, 4))


def _far_pair(disparity_px: int) -> tuple[Image, Image]:
    """Left and right images of a smooth wall that is far away."""
    noise = np.random.default_rng(0).uniform(0.0, 255.0, (120, 301))
    smooth = cv2.GaussianBlur(noise, (0, 0), 3.0)
    wall = np.asarray(
        cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX, dtype=cv2.CV_8U), dtype=np.uint8
    )
    left = np.ascontiguousarray(wall[:, 10:290])
    return left, np.ascontiguousarray(wall[:, 10 + disparity_px : 290 + disparity_px])


@pytest.mark.parametrize("disparity_px", [1, 2])
def test_small_disparities_have_one_sign(disparity_px: int) -> None:
    """Of a far scene, patches match almost as well with no disparity at all: in an image rendered
    along MH_03, two seconds of exchanged images were used for that (47 sigma).
    """
    probe = RowProbe()
    left, right = _far_pair(disparity_px)
    points = probe.corners(right)
    exchanged = MatchCounts(
        len(points), probe.positive(right, left, points), probe.negative(right, left, points)
    )
    assert exchanged.negative > 2 * exchanged.positive
    assert probe.positive(left, right, points) > 2 * probe.negative(left, right, points)
