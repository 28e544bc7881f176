"""Features of another program that repeat pixels or disparities of the frame before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from tests.guard.test_matches import CAMERA, flight
from vio.findings import Finding
from vio.guard.guarded import GuardedFrontend
from vio.guard.repeated_features import RepeatedFeatures
from vio.records import (
    FrontendOutput,
    Observations,
    StereoFrame,
    TrackPrior,
    observations,
    shared_rows,
)


def _inspected(seen: Sequence[Observations]) -> tuple[list[Observations], list[Finding]]:
    check = RepeatedFeatures()
    return [check.inspect(o) for o in seen], list(check.take_findings())


def _at_half_the_rate(seen: Sequence[Observations]) -> list[Observations]:
    return [
        replace(seen[k - k % 2], frame_index=o.frame_index, time_ns=o.time_ns)
        for k, o in enumerate(seen)
    ]


def _with_lost(seen: Sequence[Observations]) -> list[Observations]:
    """Points that leave the view stay where they were seen last."""
    last: dict[int, np.ndarray] = {}
    out = []
    for o in seen:
        for point, z in zip(o.ids.tolist(), o.z, strict=True):
            last[point] = z
        ids = sorted(last)
        z = np.array([last[point] for point in ids])
        out.append(observations(o.frame_index, o.time_ns, ids, z))
    return out


def _with_first_disparities(seen: Sequence[Observations], share: float = 1.0) -> list[Observations]:
    """A share of the points keeps the disparity of its first sight."""
    disparity: dict[int, float] = {}
    out = []
    for o in seen:
        z = o.z.copy()
        for row, point in enumerate(o.ids.tolist()):
            disparity.setdefault(point, float(z[row, 0] - z[row, 2]))
            if point % 100 < 100 * share:
                z[row, 2] = z[row, 0] - disparity[point]
        out.append(observations(o.frame_index, o.time_ns, o.ids, z))
    return out


def test_features_that_are_measured_anew_are_handed_on_as_they_are() -> None:
    seen = flight()
    out, findings = _inspected(seen)
    assert findings == []
    assert all(a is b for a, b in zip(out, seen, strict=True))


def test_a_tracker_at_half_the_rate_gives_every_second_frame() -> None:
    out, findings = _inspected(_at_half_the_rate(flight()))
    # the first repetition may be a rig at rest: no motion is known yet
    assert [bool(o.stale.all()) for o in out] == [k % 2 == 1 and k > 1 for k in range(len(out))]
    assert [(f.code, f.effect, f.since) for f in findings] == [("frames-repeated", "degraded", 3)]
    assert "pixels of 100 %" in findings[0].message


def test_points_that_stay_while_others_move_are_lost() -> None:
    seen = flight()
    out, findings = _inspected(_with_lost(seen))
    for new, old in zip(out[1:], seen[1:], strict=True):
        assert set(new.ids[~new.stale].tolist()) == set(old.ids.tolist())
    assert [f.code for f in findings] == ["frames-repeated"]


@pytest.mark.parametrize("share", [0.2, 1.0])
def test_a_disparity_that_stays_is_measured_once(share: float) -> None:
    seen = flight()
    out, findings = _inspected(_with_first_disparities(seen, share))
    known: set[int] = set()
    for before, now in pairwise(out):
        known |= set(before.ids.tolist())
        carried = np.isin(now.ids, list(known)) & (now.ids % 100 < 100 * share)
        rows = shared_rows(before.ids, now.ids)[1]
        again = np.isin(np.arange(len(now)), rows)
        assert not now.has_right[carried & again].any()
        assert now.has_right[~carried].all()
        assert not now.stale.any()
    assert [f.code for f in findings] == ["frames-repeated"]
    assert "disparities of" in findings[0].message


def test_whole_pixels_may_be_equal() -> None:
    seen = [replace(o, z=np.rint(o.z)) for o in flight()]
    out, findings = _inspected(seen)
    assert findings == []
    assert all(a is b for a, b in zip(out, seen, strict=True))


def test_parts_of_a_pixel_may_be_equal_disparities() -> None:
    """A matcher's disparities are sixteenths of a pixel, and the left pixels are not."""
    seen = flight()
    for o in seen:
        o.z[:, 2] = o.z[:, 0] - np.rint(16 * (o.z[:, 0] - o.z[:, 2])) / 16
    out, findings = _inspected(seen)
    assert findings == []
    assert all(a is b for a, b in zip(out, seen, strict=True))


def _stopping(slow: float, still: int) -> list[Observations]:
    """Features without noise of a rig that slows down to `slow` px a frame, and stops."""
    rng = np.random.default_rng(4)
    z = np.column_stack([rng.uniform([50, 50], [600, 430], (100, 2))] * 2)
    z[:, 2] -= rng.uniform(5, 40, 100)
    out = []
    for k, step in enumerate([3.0, 2.0, 1.0, slow] + [0.0] * still):
        z = z + np.array([step, 0.0, step, 0.0])
        out.append(observations(k, k * 10**8, np.arange(100), z))
    return out


@pytest.mark.parametrize(("slow_px", "stands"), [(0.2, True), (0.8, False)])
def test_images_without_noise_may_show_a_rig_at_rest(slow_px: float, stands: bool) -> None:
    out, findings = _inspected(_stopping(slow_px, 6))
    assert any(o.stale.any() for o in out) is not stands
    assert (findings == []) is stands


def test_an_object_before_a_rig_at_rest_repeats_nothing() -> None:
    """Without noise, 30 features of 100 move on while the rig stands still."""
    seen = _stopping(0.2, 8)
    for k, o in enumerate(seen[4:]):
        o.z[:30] += [4.0 * k, 0.0, 4.0 * k, 0.0]
    out, findings = _inspected(seen)
    assert findings == []
    assert not any(o.stale.any() for o in out)


def test_features_that_move_again_end_the_finding() -> None:
    seen = flight()
    half = _at_half_the_rate(seen[:12])
    _, findings = _inspected([*half, *seen[12:]])
    assert [f.ended for f in findings] == [False, True]


class _Replayed:
    """A front end of the caller's own."""

    def __init__(self, seen: Sequence[Observations]) -> None:
        self._seen = seen

    def process(self, frame: StereoFrame, prior: TrackPrior | None = None) -> FrontendOutput:
        seen = self._seen[frame.index]
        return FrontendOutput(seen, len(seen), len(seen), 0, {})


def test_every_front_end_that_does_not_check_itself_is_asked() -> None:
    seen = _at_half_the_rate(flight())
    frontend = GuardedFrontend(_Replayed(seen), CAMERA)
    stale = [
        bool(
            frontend.process(
                StereoFrame(o.frame_index, o.time_ns, None, None)
            ).observations.stale.all()
        )
        for o in seen
    ]
    assert stale == [k % 2 == 1 and k > 1 for k in range(len(seen))]
