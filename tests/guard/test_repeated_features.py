"""Features of another program that repeat pixels or disparities of the frame before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from tests.guard.test_matches import CAMERA, flight
from vio.config import load_config
from vio.datasets import open_dataset
from vio.datasets.observation_log import write_observations
from vio.findings import Finding
from vio.frontend.precomputed import PrecomputedFrontend
from vio.geometry.lie import so3_exp
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
from vio.runs.pipeline import run


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


def test_a_coincidence_explains_no_repetition() -> None:
    seen = flight()
    half = _at_half_the_rate(seen)
    z = half[2].z.copy()
    z[0, 1] = half[1].z[half[1].ids == half[2].ids[0], 1][0]
    half[2:4] = [replace(o, z=z) for o in half[2:4]]
    out, _ = _inspected(half)
    assert [bool(o.stale.all()) for o in out] == [k % 2 == 1 and k > 1 for k in range(len(out))]


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


STEPS_PX = [1.0, 0.5, 1.175, 1 / 16]  # the third: of images that were made smaller


def _through(motion: str, count: int = 25) -> list[Observations]:
    """Points without noise, with depths of 1 to 15 m, as a rig moves ahead, along its images' plane,
    or turns.
    """
    rng = np.random.default_rng(1)
    points = rng.uniform([-8, -5, 1], [8, 5, 15], (400, 3))
    out = []
    for k in range(count):
        if motion == "ahead":
            p = points - [0.0, 0.0, 0.05 * k]
        elif motion == "aside, in a roll":
            p = (points - [0.05 * k, 0.0, 0.0]) @ so3_exp([0.0, 0.0, 0.01 * k]).T
        else:
            p = points @ so3_exp([0.001 * k, 0.002 * k, 0.0]).T
        uv = 450 * p[:, :2] / p[:, 2:] + [376.0, 240.0]
        z = np.column_stack([uv, uv])
        z[:, 2] -= 450 * 0.11 / p[:, 2]
        ids = np.flatnonzero((p[:, 2] > 0.5) & (uv > 0).all(axis=1) & (uv < [752, 480]).all(axis=1))
        out.append(observations(k, k * 10**8, ids, z[ids]))
    return out


MOTIONS = ["ahead", "aside, in a roll", "a turn"]


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("step_px", STEPS_PX)
def test_multiples_of_a_step_may_be_equal(step_px: float, motion: str) -> None:
    rng = np.random.default_rng(2)
    seen = _through(motion)
    noisy = [o.z + rng.normal(0.0, 0.3, o.z.shape) for o in seen]
    seen = [replace(o, z=step_px * np.rint(z / step_px)) for o, z in zip(seen, noisy, strict=True)]
    out, findings = _inspected(seen)
    assert findings == []
    assert all(a is b for a, b in zip(out, seen, strict=True))


@pytest.mark.parametrize("motion", MOTIONS)
def test_steps_may_be_those_of_each_feature_s_scale(motion: str) -> None:
    """As of key points in a pyramid of images, of which each level is 1.2 times smaller."""
    rng = np.random.default_rng(2)
    scales = 1.2 ** rng.integers(0, 8, 400)
    seen = []
    for o in _through(motion):
        steps = scales[o.ids][:, None]
        z = steps * np.rint((o.z + rng.normal(0.0, 0.3, o.z.shape)) / steps)
        seen.append(replace(o, z=z))
    out, findings = _inspected(seen)
    assert findings == []
    assert all(a is b for a, b in zip(out, seen, strict=True))


@pytest.mark.parametrize("motion", MOTIONS)
def test_depths_in_whole_millimetres_may_be_equal(motion: str) -> None:
    rng = np.random.default_rng(2)
    seen = _through(motion)
    for o in seen:
        depth_m = 450 * 0.11 / (o.z[:, 0] - o.z[:, 2])
        depth_m += rng.normal(0.0, 1.0, len(o)) * 0.001 * depth_m**2
        o.z[:, :2] += rng.normal(0.0, 0.1, (len(o), 2))
        o.z[:, 2] = o.z[:, 0] - 450 * 0.11 / (np.rint(1000 * depth_m) / 1000)
        o.z[:, 3] = o.z[:, 1]
    out, findings = _inspected(seen)
    assert findings == []
    assert all(a is b for a, b in zip(out, seen, strict=True))


@pytest.mark.parametrize("digits", [np.float32, np.float64])
@pytest.mark.parametrize("motion", MOTIONS[:2])
def test_disparities_without_noise_may_stay(motion: str, digits: type) -> None:
    """Along the images' plane no depth changes."""
    seen = [replace(o, z=o.z.astype(digits).astype(float)) for o in _through(motion)]
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
        z = z + step * np.array([1.0, 0.5, 1.0, 0.5])
        out.append(observations(k, k * 10**8, np.arange(100), z))
    return out


def test_images_without_noise_may_show_a_rig_at_rest() -> None:
    out, findings = _inspected(_stopping(0.2, 6))
    assert not any(o.stale.any() for o in out)
    assert findings == []


def test_a_rig_that_stops_at_once_is_at_rest_after_some_frames() -> None:
    out, findings = _inspected(_stopping(0.8, 40))
    assert [k for k, o in enumerate(out) if o.stale.any()] == [4, 5, 6, 7, 8]
    assert [f.ended for f in findings] == [False, True]


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


@pytest.mark.parametrize("settled", [True, False])
def test_a_reader_that_knows_what_repeats_is_believed(settled: bool) -> None:
    seen = _at_half_the_rate(flight())
    source = PrecomputedFrontend(lambda index: seen[index], checks_repeats=settled)
    frontend = GuardedFrontend(source, CAMERA)
    outputs = [frontend.process(StereoFrame(o.frame_index, o.time_ns, None, None)) for o in seen]
    assert any(o.observations.stale.any() for o in outputs) is not settled
    found = {f.code for o in outputs for f in o.findings}
    assert ("frames-repeated" in found) is not settled


@pytest.mark.parametrize(
    ("overrides", "is_checked"),
    [
        ((), True),
        (("frontend.checks=false",), False),
        (("dataset.repeated_tracks=literal",), False),
    ],
)
def test_features_are_taken_as_they_are_on_request(
    overrides: tuple[str, ...], is_checked: bool, tmp_path: Path
) -> None:
    seen = _at_half_the_rate(flight())
    file = tmp_path / "tracks.npz"
    frames = [(o.ids, o.z, o.has_right) for o in seen]
    write_observations(file, CAMERA, [o.time_ns for o in seen], frames)
    config = load_config(overrides=overrides)
    result = run(open_dataset(file, config.dataset), config)
    assert any(frame.stale > 0 for frame in result.frames) is is_checked
