"""The checks of right matches by their columns: features of another program, and none of them
images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tools.faults.changes import Period
from tools.faults.columns import (
    COLUMNS,
    ColumnChange,
    changed_features,
    during,
    onwards,
    turned,
)
from vio.config import load_config
from vio.errors import DataError
from vio.findings import Finding
from vio.frontend import build_frontend
from vio.frontend.precomputed import PrecomputedFrontend, with_right_of
from vio.frontend.settings import FrontendSettings
from vio.geometry.lie import FloatArray, so3_exp
from vio.geometry.stereo import StereoCamera
from vio.guard.frozen_matches import FrozenMatches
from vio.guard.guarded import GuardedFrontend
from vio.guard.lost_matches import LostMatches
from vio.guard.match_check import Hysteresis, SharedMatches, shared_matches
from vio.guard.matches import RightMatches
from vio.guard.object_matches import ObjectMatches
from vio.guard.shifted_matches import common_change
from vio.records import Observations, Recording, StereoFrame, Trajectory, observations
from vio.runs.pipeline import RunResult, run

CAMERA = StereoCamera(fu=500.0, fv=500.0, cu=320.0, cv=240.0, baseline_m=0.3, width=640, height=480)
FRAMES = 40
STEP_NS = 100_000_000
PERIOD = Period(15 * STEP_NS, 25 * STEP_NS)
FAULT = range(15, 25)
CODES = {
    "right frozen": ["right-image-frozen", "-right-image-frozen"],
    "exchanged": ["images-exchanged", "-images-exchanged"],
    "right dark": ["right-matches-lost", "-right-matches-lost"],
    "right late": ["pairs-shifted"],
    "right rolled": ["right-contradicts-left"],
    "right yawed": ["right-contradicts-left"],
    "object": ["object-covers-image"],
}


def poses(nod: float = 0.7) -> FloatArray:
    """Poses (F, 4, 4) of a camera that goes ahead and nods, by `nod` rad of its period a frame."""
    out = np.tile(np.eye(4), (FRAMES, 1, 1))
    for k in range(FRAMES):
        out[k, :3, :3] = so3_exp(np.array([0.02 * np.sin(nod * k), 0.01 * np.sin(0.3 * k), 0.0]))
        out[k, :3, 3] = [0.02 * k, 0.1 * np.sin(0.5 * k), 0.3 * k]
    return out


def flight(noise_px: float = 0.2, visible: float = 1.0, nod: float = 0.7) -> list[Observations]:
    """What a rig sees of points ahead; a share of them has right pixels."""
    rng = np.random.default_rng(3)
    points = rng.uniform([-15.0, -8.0, 3.0], [15.0, 8.0, 45.0], (900, 3))
    has_right = rng.random(len(points)) < visible
    frames = []
    for k, T in enumerate(poses(nod)):
        p = (points - T[:3, 3]) @ T[:3, :3]
        depth = np.maximum(p[:, 2], 0.1)
        left = p[:, :2] / depth[:, None] * 500.0 + [320.0, 240.0]
        right = left - np.column_stack([150.0 / depth, np.zeros(len(p))])
        z = np.hstack([left, right]) + rng.normal(0.0, noise_px, (len(p), 4))
        inside = (z > 0).all(axis=1) & (z < [640, 480, 640, 480]).all(axis=1) & (p[:, 2] > 2)
        ids = np.flatnonzero(inside)
        frames.append(observations(k, k * STEP_NS, ids, z[ids], has_right[ids]))
    return frames


def changed(change: ColumnChange, seen: Sequence[Observations]) -> list[Observations]:
    return [change(seen, k, CAMERA, PERIOD) for k in range(len(seen))]


def inspected(seen: Sequence[Observations]) -> tuple[list[Observations], list[Finding]]:
    checks = RightMatches(CAMERA)
    objects = ObjectMatches(CAMERA)
    out = [objects.inspect(checks.inspect(o), None) for o in seen]
    return out, [*checks.take_findings(), *objects.take_findings()]


def codes(findings: Sequence[Finding]) -> list[str]:
    return [f"-{f.code}" if f.ended else f.code for f in findings]


def test_healthy_matches_are_handed_on_as_they_are() -> None:
    seen = flight()
    out, findings = inspected(seen)
    assert codes(findings) == []
    assert all(a is b for a, b in zip(out, seen, strict=True))


@pytest.mark.parametrize("name", COLUMNS)
def test_every_fault_of_the_columns_is_named_once(name: str) -> None:
    assert codes(inspected(changed(COLUMNS[name], flight()))[1]) == CODES[name]


@pytest.mark.parametrize("name", ["right frozen", "right rolled", "right yawed"])
def test_no_right_pixel_of_a_fault_is_output(name: str) -> None:
    out, _ = inspected(changed(COLUMNS[name], flight()))
    assert not any(out[k].has_right.any() for k in FAULT)
    assert all(out[k].has_right.all() for k in range(FAULT.start))


def test_only_features_of_the_scene_are_output_beside_an_object() -> None:
    """At first sight nothing tells; the wall is half of the image, and has most of the features."""
    seen = flight()
    covered = changed(COLUMNS["object"], seen)
    out, _ = inspected(covered)
    for k in FAULT[2:]:
        known = np.isin(covered[k].ids, covered[k - 1].ids)
        wall = known & ~np.isin(covered[k].ids, seen[k].ids)
        scene = known & ~wall
        kept = np.isin(covered[k].ids, out[k].ids)
        assert wall.sum() > 0.5 * known.sum()
        assert kept[wall].mean() < 0.05
        assert kept[scene].mean() > 0.95
    assert all(a is b for a, b in zip(out[: FAULT.start], seen, strict=False))


def test_features_that_scatter_are_no_object() -> None:
    objects = ObjectMatches(CAMERA)
    seen = flight(noise_px=4.0)
    assert all(objects.inspect(o, None) is o for o in seen)
    assert codes(objects.take_findings()) == []


@pytest.mark.parametrize("noise_px", [1.0, 3.0])
def test_noise_of_the_rows_is_no_delay(noise_px: float) -> None:
    """An error of a left pixel is in its row and in its flow, as a delay of the right camera is."""
    assert codes(inspected(flight(noise_px=noise_px, nod=0.1))[1]) == []


@pytest.mark.parametrize("columns", [[0, 1, 2, 3], [3]], ids=["features", "right rows"])
def test_single_wrong_features_are_left_out(columns: list[int]) -> None:
    rng = np.random.default_rng(8)
    seen = flight()
    wrong = [rng.random(len(o)) < 0.3 for o in seen]
    off = rng.choice([-1.0, 1.0], (900, 4)) * rng.uniform(15.0, 30.0, (900, 4))
    for o, mask in zip(seen, wrong, strict=True):
        o.z[np.ix_(mask, columns)] += off[o.ids[mask]][:, columns]
    out, findings = inspected(seen)
    assert codes(findings) == []
    for o, before, now, mask in zip(out[6:], seen[5:], seen[6:], wrong[6:], strict=False):
        left = o.ids if columns != [3] else o.ids[o.has_right]
        # where a feature should be is told by the frame before, where it is right there
        told = np.isin(now.ids, before.ids[~wrong[before.frame_index]])
        assert np.isin(now.ids[mask & told], left).mean() < 0.05
        assert np.isin(now.ids[~mask & told], left).mean() > 0.97


@pytest.mark.parametrize("share", [0.2, 0.5])
@pytest.mark.parametrize("roll_rad", [0.0, 0.03])
def test_right_pixels_of_other_features_are_left_out_from_the_first_frame(
    share: float, roll_rad: float
) -> None:
    rng = np.random.default_rng(9)
    seen = flight()
    wrong = []
    for o in seen[:4]:
        o.z[:, 3] += roll_rad * (o.z[:, 2] - CAMERA.cu)
        true = o.z[:, 3].copy()
        chosen = rng.permutation(len(o))[: int(share * len(o))]
        o.z[chosen, 2:] = np.roll(o.z[chosen, 2:], 1, axis=0)
        wrong.append(np.abs(o.z[:, 3] - true) > 10.0)
    checks = RightMatches(CAMERA)
    for o, mask in zip(seen, wrong, strict=False):
        out = checks.inspect(o)
        assert not out.has_right[mask].any()
        assert out.has_right[~mask].mean() > 0.95


def test_a_wrong_depth_in_the_frame_before_takes_no_feature() -> None:
    """Its pixels are right in this frame, and fit the motion at another depth."""
    rng = np.random.default_rng(8)
    seen = flight()
    for o in seen[::2]:
        o.z[rng.random(len(o)) < 0.1, 2] -= 12.0
    objects = ObjectMatches(CAMERA)
    out = [objects.inspect(o, None) for o in seen]
    assert sum(map(len, out)) > 0.998 * sum(map(len, seen))


def test_exchanged_pixels_are_put_back_to_the_bit() -> None:
    seen = flight(visible=0.8)
    out, _ = inspected(changed(COLUMNS["exchanged"], seen))
    for k in FAULT:
        np.testing.assert_array_equal(out[k].z, seen[k].z[seen[k].has_right])


def test_a_recording_that_begins_exchanged_is_refused() -> None:
    exchanged = [replace(o, z=o.z[:, [2, 3, 0, 1]]) for o in flight()]
    with pytest.raises(DataError, match="frame 2: left and right pixels look exchanged"):
        inspected(exchanged)


@pytest.mark.parametrize(("share", "named"), [(0.5, False), (0.7, True)])
def test_most_disparities_must_be_negative(share: float, named: bool) -> None:
    def some(
        seen: Sequence[Observations], k: int, camera: StereoCamera, period: Period
    ) -> Observations:
        rows = np.arange(len(seen[k])) < share * len(seen[k])
        return replace(seen[k], z=np.where(rows[:, None], seen[k].z[:, [2, 3, 0, 1]], seen[k].z))

    found = codes(inspected(changed(during(some), flight()))[1])
    assert ("images-exchanged" in found) == named


@pytest.mark.parametrize(("rows_px", "named"), [(0.4, False), (1.2, True)])
def test_rows_must_jump_clearly(rows_px: float, named: bool) -> None:
    def pitched(
        seen: Sequence[Observations], k: int, camera: StereoCamera, period: Period
    ) -> Observations:
        return replace(seen[k], z=seen[k].z + np.array([0.0, 0.0, 0.0, rows_px]))

    found = codes(inspected(changed(during(pitched), flight(noise_px=0.05)))[1])
    assert found == (["right-contradicts-left", "-right-contradicts-left"] if named else [])


def test_rows_that_are_off_from_the_start_are_a_matter_of_the_calibration() -> None:
    pitched = [replace(o, z=o.z + np.array([0.0, 0.0, 0.0, 5.0])) for o in flight()]
    assert codes(inspected(pitched)[1]) == []


@pytest.mark.parametrize(("degrees", "named"), [(0.05, False), (0.1, True), (-0.1, True)])
def test_disparities_must_jump_clearly(degrees: float, named: bool) -> None:
    """The limit is 0.07 degrees; half a pixel is 0.057 of them here."""
    yawed = onwards(turned(degrees, (0.0, 1.0, 0.0)))
    found = inspected(changed(yawed, flight()))[1]
    assert codes(found) == (["right-contradicts-left"] if named else [])
    if named:
        assert found[0].first_frame == FAULT.start
        assert found[0].figures["offset_px"] == pytest.approx(-500 * np.radians(degrees), abs=0.1)


def test_right_pixels_that_shift_back_are_used_again() -> None:
    yawed = during(turned(0.5, (0.0, 1.0, 0.0)))
    out, found = inspected(changed(yawed, flight()))
    assert codes(found) == ["right-contradicts-left", "-right-contradicts-left"]
    assert all(record.has_right.any() == (k not in FAULT) for k, record in enumerate(out))


def test_a_shift_that_descriptors_lose_for_some_frames_is_found() -> None:
    """No feature of a frame has the right pixel that it had before; later ones have others."""

    def lost(
        seen: Sequence[Observations], k: int, camera: StereoCamera, period: Period
    ) -> Observations:
        if k in (15, 16, 17):
            return replace(seen[k], has_right=seen[k].ids % 50 == k)
        yawed = onwards(turned(0.5, (0.0, 1.0, 0.0)))
        return yawed(seen, k, camera, period)

    assert codes(inspected(changed(lost, flight()))[1])[-1] == "right-contradicts-left"


@pytest.mark.parametrize(("degrees", "named"), [(0.0, False), (0.01, False), (0.04, True)])
def test_right_pixels_of_a_pair_that_shakes_count_less(degrees: float, named: bool) -> None:
    """By another angle in each frame; the limit is 0.02 degrees."""
    angles = degrees * np.random.default_rng(5).normal(size=FRAMES)

    def shaken(
        seen: Sequence[Observations], k: int, camera: StereoCamera, period: Period
    ) -> Observations:
        return turned(angles[k], (0.0, 1.0, 0.0))(seen, k, camera, period)

    seen = changed(shaken, flight())
    out, found = inspected(seen)
    assert codes(found) == (["right-camera-shakes"] if named else [])
    assert all(record.has_right.all() for record in out)
    sigma = out[-1].sigma
    assert (sigma is not None) == named
    if sigma is not None:
        # all of a frame together are as uncertain as what they have in common
        common_px = 500.0 * np.radians(degrees)
        assert 0.5 < sigma[:, 2].mean() / (np.sqrt(len(sigma)) * common_px / 0.3) < 1.5
        assert np.all(sigma[:, :2] == 1.0)


@pytest.mark.parametrize(("noise_px", "named"), [(0.1, True), (0.6, False)])
def test_a_change_that_is_not_known_well_is_no_shake(noise_px: float, named: bool) -> None:
    """Shaken by 0.03 degrees, 0.26 px, as 40 matches show."""
    angles = 0.03 * np.random.default_rng(5).normal(size=FRAMES)

    def shaken(
        seen: Sequence[Observations], k: int, camera: StereoCamera, period: Period
    ) -> Observations:
        return turned(angles[k], (0.0, 1.0, 0.0))(seen, k, camera, period)

    _, found = inspected(changed(shaken, flight(noise_px=noise_px, visible=0.1)))
    assert codes(found) == (["right-camera-shakes"] if named else [])


def test_a_camera_that_shakes_after_it_has_turned_is_still_turned() -> None:
    rng = np.random.default_rng(5)
    seen = flight()
    for k in range(15, FRAMES):
        degrees = 0.5 + (0.04 * rng.normal() if k > 17 else 0.0)
        seen[k] = turned(degrees, (0.0, 1.0, 0.0))(seen, k, CAMERA, PERIOD)
    out, found = inspected(seen)
    assert codes(found) == ["right-contradicts-left", "right-camera-shakes"]
    assert not any(record.has_right.any() for record in out[15:])


@pytest.mark.parametrize("nearest_m", [3.0, 10.0, 19.0])
def test_what_disparities_have_in_common_is_known_as_well_as_stated(nearest_m: float) -> None:
    """Of a camera that goes ahead, sideways and turns; depths that are more alike say less."""
    rng = np.random.default_rng(8)
    ratios = []
    sigmas = []
    for _ in range(60):
        points = rng.uniform([-10.0, -6.0, nearest_m], [10.0, 6.0, 20.0], (80, 3))
        R = so3_exp(rng.normal(0.0, 0.03, 3))
        both = []
        for p in (points, points @ R.T - rng.uniform(-0.5, 0.5, 3)):
            left = p[:, :2] / p[:, 2:] * 500.0 + [320.0, 240.0]
            right = left - np.column_stack([150.0 / p[:, 2], np.zeros(len(p))])
            both.append(np.hstack([left, right]) + rng.normal(0.0, 0.2, (len(p), 4)))
        both[1][:, 2] += 1.5 * (1.0 + ((both[1][:, 2] - 320.0) / 500.0) ** 2)
        found = common_change(CAMERA, SharedMatches(np.arange(80), *both, 0.1))
        assert found is not None
        ratios.append((found[0] + 1.5) / found[1])
        sigmas.append(found[1])
    assert 0.6 < np.std(ratios) < 2.0
    assert abs(np.mean(ratios)) < 0.5
    assert (np.median(sigmas) > 0.3) == (nearest_m > 15.0)


def test_noisy_rows_are_usual() -> None:
    assert codes(inspected(flight(noise_px=1.0))[1]) == []


@pytest.mark.parametrize(
    ("left_px", "share", "frozen"),
    [
        (10.0, 0.05, True),
        (10.0, 0.2, False),
        (1.5, 0.0, False),
    ],
)
def test_right_pixels_must_stay_while_left_ones_move(
    left_px: float, share: float, frozen: bool
) -> None:
    z = np.tile([300.0, 200.0, 280.0, 200.0], (30, 1))
    seen = []
    for k in range(6):
        moved = k * left_px * np.array([1.0, 0.0, share, 0.0])
        seen.append(observations(k, k * STEP_NS, np.arange(30), z + moved))
    assert ("right-image-frozen" in codes(inspected(seen)[1])) == frozen


@pytest.mark.parametrize(("share", "lost"), [(0.1, True), (0.25, False)])
def test_hardly_any_match_must_be_left(share: float, lost: bool) -> None:
    check = LostMatches()
    nothing = shared_matches(None, flight()[0])
    for k in range(20):
        has_right = np.arange(100) < 100 * (share if k >= 10 else 1.0)
        seen = observations(k, k, np.arange(100), np.zeros((100, 4)), has_right)
        assert check.inspect(seen, nothing) is seen
    assert codes(check.take_findings()) == (["right-matches-lost"] if lost else [])


def test_few_right_matches_may_be_usual() -> None:
    assert codes(inspected(flight(visible=0.2))[1]) == []


def test_a_delay_that_is_no_whole_frame_is_taken_out() -> None:
    """The right pixels are those of 0.4 frames before; then the rows agree again."""
    seen = flight(noise_px=0.05, nod=0.3)
    late = []
    for k, now in enumerate(seen):
        before = with_right_of(now, seen[max(k - 1, 0)])
        z = now.z.copy()
        z[:, 2:] = 0.6 * now.z[:, 2:] + 0.4 * before.z[:, 2:]
        late.append(replace(now, z=z, has_right=before.has_right))
    out, findings = inspected(late)
    assert codes(findings) == ["right-image-late"]
    assert findings[0].figures["delay_frames"] == pytest.approx(0.4, abs=0.05)
    used = [k for k in range(30, FRAMES) if out[k].has_right.any()]
    assert used

    def error(k: int, record: Observations) -> float:
        rows = record.has_right
        return float(np.median(np.abs(record.z - seen[k].z)[rows, 2:]))

    assert all(error(k, out[k]) < 0.5 * error(k, late[k]) for k in used)


# The paths that call the checks


def fed(frontend: GuardedFrontend, seen: Sequence[Observations]) -> list[Finding]:
    frames = [StereoFrame(o.frame_index, o.time_ns, None, None) for o in seen]
    return [f for frame in frames for f in frontend.process(frame).findings]


@pytest.mark.parametrize("checked", [False, True])
def test_what_a_run_of_ours_has_checked_is_not_checked_again(checked: bool) -> None:
    seen = changed(COLUMNS["right frozen"], flight())
    source = PrecomputedFrontend(lambda index: seen[index], checks_matches=checked)
    found = codes(fed(GuardedFrontend(source, CAMERA), seen))
    assert found == ([] if checked else CODES["right frozen"])


def test_one_camera_has_no_right_matches() -> None:
    seen = flight(visible=0.0)
    source = PrecomputedFrontend(lambda index: seen[index])
    assert fed(GuardedFrontend(source, replace(CAMERA, kind="mono")), seen) == []


@pytest.mark.parametrize("delay", [-1, 1])
def test_late_right_pixels_are_paired_anew_by_the_ids(delay: int) -> None:
    seen = flight()
    late = [
        with_right_of(seen[k], seen[k - delay]) for k in range(FRAMES) if 0 <= k - delay < FRAMES
    ]
    frontend = PrecomputedFrontend(lambda index: late[index] if index < len(late) else None)
    frontend.right_delay = delay
    out = frontend.process(StereoFrame(5, 5 * STEP_NS, None, None)).observations
    # left and right of one frame, of which the number is that of the earlier one or its own
    true = seen[late[5].frame_index + (delay < 0)]
    out = out.take(out.has_right)
    _, rows, others = np.intersect1d(out.ids, true.ids, return_indices=True)
    assert len(rows) == len(out) > 50
    np.testing.assert_array_equal(out.z[rows], true.z[others])


def recording() -> Recording:
    times_ns = np.arange(FRAMES) * STEP_NS
    reference = Trajectory(poses(), times_ns, "cam0")
    return Recording("log", Path("made"), CAMERA, None, times_ns, False, frozenset(), reference)


def run_with(change: ColumnChange) -> RunResult:
    features = changed_features(recording(), flight(), change, PERIOD)
    return run(features, load_config(overrides=["motion=none"]))


def path_error_m(result: RunResult) -> float:
    T = result.trajectory.T_world_body
    truth = poses()[result.trajectory.frame_indices]
    first = T[0, :3, :3].T @ (T[-1, :3, 3] - T[0, :3, 3])
    true = truth[0, :3, :3].T @ (truth[-1, :3, 3] - truth[0, :3, 3])
    return float(np.linalg.norm(first - true))


@pytest.mark.parametrize("name", COLUMNS)
def test_a_run_of_features_names_each_fault_and_keeps_its_path(name: str) -> None:
    result = run_with(COLUMNS[name])
    named = "pairs-put-right" if name == "right late" else CODES[name][0]
    assert named in [finding.code for finding in result.findings]
    assert path_error_m(result) < 0.15  # of 12 m


def test_the_replaying_front_end_knows_who_checked_its_features() -> None:
    features = changed_features(recording(), flight(), lambda seen, k, *_: seen[k], PERIOD)
    settings = FrontendSettings()
    other = build_frontend("precomputed", CAMERA, settings, features)
    ours = replace(features, recording=replace(features.recording, run_motion="none"))
    assert isinstance(other, PrecomputedFrontend)
    assert not other.checks_matches
    again = build_frontend("precomputed", CAMERA, settings, ours)
    assert isinstance(again, PrecomputedFrontend)
    assert again.checks_matches


# The state with hysteresis


def test_a_state_is_reported_after_some_frames_and_ends_after_others() -> None:
    state = Hysteresis(to_report=2, to_end=2, blind=3)
    said = []
    for k, sign in enumerate([True, None, True, False, True, False, False, False]):
        state.show(k, sign)
        if state.to_report():
            said.append(f"begins {k} since {state.since}")
        if state.ends():
            said.append(f"ends {k}")
    assert said == ["begins 2 since 0", "ends 6"]


def test_a_state_without_a_sign_for_long_is_given_up() -> None:
    state = Hysteresis(to_report=1, to_end=1, blind=3)
    state.show(0, True)
    assert state.to_report()
    ends = []
    for k in range(1, 4):
        state.show(k, None)
        ends.append(state.ends())
    assert ends == [False, False, True]
    assert state.since is None


def test_shared_matches_are_those_of_both_frames() -> None:
    z = np.arange(12.0).reshape(3, 4)
    before = observations(0, 0, [1, 2, 3], z, [True, True, False])
    now = observations(1, STEP_NS, [4, 2, 1], z, [True, True, False])
    shared = shared_matches(before, now)
    assert isinstance(shared, SharedMatches)
    assert shared.rows.tolist() == [1]
    np.testing.assert_array_equal(shared.before, z[[1]])
    assert shared.seconds == pytest.approx(0.1)


def _shared(count: int, left_px: float, right_px: float) -> SharedMatches:
    before = np.full((count, 4), 100.0)
    now = before + np.array([left_px, 0.0, right_px, 0.0])
    return SharedMatches(np.arange(count), before, now, 0.1)


def _frozen_frames(shared: SharedMatches) -> list[str]:
    check = FrozenMatches()
    for seen in flight()[:4]:
        check.inspect(seen, shared)
    return [finding.code for finding in check.take_findings()]


@pytest.mark.parametrize(
    ("count", "left_px", "right_px", "is_frozen"),
    [
        (8, 10.0, 0.0, True),
        (7, 10.0, 0.0, False),  # too few to tell
        (20, 2.1, 0.0, True),
        (20, 1.9, 0.0, False),  # at rest both stay
        (20, 10.0, 0.9, True),
        (20, 10.0, 1.1, False),  # a twist moves one camera's pixels less
    ],
)
def test_right_pixels_that_stay_while_left_ones_move_are_frozen(
    count: int, left_px: float, right_px: float, is_frozen: bool
) -> None:
    found = _frozen_frames(_shared(count, left_px, right_px))
    assert found == (["right-image-frozen"] if is_frozen else [])


@pytest.mark.parametrize(("share", "is_lost"), [(0.17, True), (0.23, False)])
def test_matches_are_lost_below_a_fifth_of_the_usual_share(share: float, is_lost: bool) -> None:
    check = LostMatches()
    nothing = _shared(0, 0.0, 0.0)
    seen = flight()
    for k, frame in enumerate(seen[:10]):
        has_right = np.arange(len(frame)) < (1.0 if k < 5 else share) * len(frame)
        check.inspect(replace(frame, has_right=has_right), nothing)
    found = [finding.code for finding in check.take_findings()]
    assert found == (["right-matches-lost"] if is_lost else [])


def _matches_found(shares: list[float], count: int = 60) -> list[str]:
    """Codes of what is found by the shares of features with a right match, frame by frame."""
    check = LostMatches()
    nothing = _shared(0, 0.0, 0.0)
    seen = flight()
    codes = []
    for k, share in enumerate(shares):
        frame = seen[k % len(seen)].take(np.arange(count))
        some = np.arange(count) < round(share * count)
        check.inspect(replace(frame, frame_index=k, has_right=some), nothing)
        codes += [f.code + " ended" * f.ended for f in check.take_findings()]
    return codes


@pytest.mark.parametrize(("share", "is_back"), [(0.45, False), (0.55, True)])
def test_matches_are_back_from_half_of_the_usual_share_on(share: float, is_back: bool) -> None:
    found = _matches_found([1.0] * 5 + [0.05] * 5 + [share] * 5)
    assert found == ["right-matches-lost", "right-matches-lost ended"][: 1 + is_back]


@pytest.mark.parametrize(("usual", "is_lost"), [(0.28, False), (0.32, True)])
def test_where_few_features_match_anyway_none_are_lost(usual: float, is_lost: bool) -> None:
    found = _matches_found([usual] * 5 + [0.0] * 5)
    assert found == (["right-matches-lost"] if is_lost else [])


def _straight_drive() -> list[Observations]:
    """A drive straight ahead: rows of near points move more from frame to frame."""
    rng = np.random.default_rng(5)
    points = rng.uniform([-15.0, -4.0, 5.0], [15.0, 2.0, 80.0], (900, 3))
    frames = []
    for k in range(FRAMES):
        depth = np.maximum(points[:, 2] - 1.0 * k, 0.1)
        left = points[:, :2] / depth[:, None] * 500.0 + [320.0, 240.0]
        right = left - np.column_stack([150.0 / depth, np.zeros(len(depth))])
        z = np.hstack([left, right]) + rng.normal(0.0, 0.2, (len(depth), 4))
        inside = (z > 0).all(axis=1) & (z < [640, 480, 640, 480]).all(axis=1) & (depth > 3)
        ids = np.flatnonzero(inside)
        frames.append(observations(k, k * STEP_NS, ids, z[ids]))
    return frames


@pytest.mark.parametrize("delay", [-1, 1])
def test_pairs_a_frame_apart_on_a_straight_drive_are_found(delay: int) -> None:
    seen = _straight_drive()
    # the left pixels of each frame with the right ones of `delay` frames before
    apart = [
        with_right_of(seen[k], seen[k - delay]) for k in range(FRAMES) if 0 <= k - delay < FRAMES
    ]
    (found,) = [f for f in inspected(apart)[1] if f.code == "pairs-shifted"]
    assert found.figures["delay_frames"] == delay
    assert found.first_frame <= 12


def test_pairs_of_a_straight_drive_are_not_apart() -> None:
    assert codes(inspected(_straight_drive())[1]) == []


def _bent_pixels(seen: Sequence[Observations]) -> float:
    """Root mean square of what rows of right pixels differ by, towards the end."""
    last = seen[-1]
    return float(np.sqrt(np.mean((last.z[last.has_right, 3] - last.z[last.has_right, 1]) ** 2)))


@pytest.mark.parametrize("nod", [0.7, 1.5, 3.0])
def test_right_pixels_that_are_a_frame_early_are_taken_from_the_frame_before(nod: float) -> None:
    seen = flight(nod=nod)
    out, found = inspected([with_right_of(seen[k], seen[k + 1]) for k in range(FRAMES - 1)])
    assert codes(found) == ["pairs-shifted"]
    assert found[0].figures["delay_frames"] == -1.0
    assert _bent_pixels(out) < 1.2 * _bent_pixels(seen)
