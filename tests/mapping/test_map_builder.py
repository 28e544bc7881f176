"""A map from rendered keyframes: loops where there are some, none in a corridor that repeats
from door to door.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.replaced_rules import replaced
from vio.calibration.stereo_field import DisplacementField
from vio.errors import DataError
from vio.geometry.lie import (
    FloatArray,
    se3_exp,
    se3_from_parts,
    se3_inverse,
    se3_log,
    transform_points,
)
from vio.geometry.relative_pose import RelativePose
from vio.geometry.stereo import project, triangulate
from vio.mapping.builder import Keyframe, MapBuilder
from vio.mapping.features import KeyframeFeatures, extract
from vio.mapping.files import prune_map
from vio.mapping.map_store import EarthRow, MapStore
from vio.mapping.merging import merge_maps
from vio.records import LoopEvent
from vio.runs.checkpoint import load_checkpoint, save_checkpoint
from vio.sim.motion import look_rotation, spline_from_waypoints
from vio.sim.rigs import small_rig
from vio.sim.sequence import SimulatedRecording, simulate
from vio.sim.world import World, equal_doors, room

RIG = small_rig(320, 180)
STEP_SIGMA = np.repeat([0.01, 0.002], 3)  # of the odometry between two keyframes, m and rad


class Walk:
    """Images of a walk through a world, and its true camera poses."""

    def __init__(self, world: World, x: FloatArray, y: FloatArray, yaw: FloatArray) -> None:
        R = look_rotation(np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=1))
        motion = spline_from_waypoints(
            se3_from_parts(R, np.stack([x, y, np.full_like(x, 1.4)], axis=1)), 1.0
        )
        self._recording = SimulatedRecording(simulate(world, RIG, motion, rate_hz=1.0))
        trajectory = self._recording.recording.reference
        self.T = trajectory.T_world_body @ RIG.T_imu_cam0
        self.camera = self._recording.recording.camera
        self.features = [extract(*self._recording.images(k)) for k in range(len(self._recording))]

    def keyframes(
        self, *, seed: int, rows: slice = slice(None)
    ) -> Iterator[tuple[Keyframe, KeyframeFeatures]]:
        """Keyframes with the odometry's errors, in a world of its own where they begin."""
        rng = np.random.default_rng(seed)
        chosen = range(len(self.T))[rows]
        T_odom, before = np.eye(4), None
        for k in chosen:
            motion = None
            if before is not None:
                step = (
                    se3_inverse(self.T[before])
                    @ self.T[k]
                    @ se3_exp(STEP_SIGMA * rng.standard_normal(6))
                )
                motion = RelativePose(step, np.diag(STEP_SIGMA**2))
                T_odom = T_odom @ step
            before = k
            yield Keyframe(k, 10**9 * k, T_odom, motion, None, 0.0), self.features[k]


@pytest.fixture(scope="module")
def room_walk() -> Walk:
    """Once around in a room and half of it again, from other positions."""
    angle = np.linspace(0, 3 * np.pi, 37)
    radius = np.where(angle < 2 * np.pi, 1.1, 1.25)
    return Walk(
        room(seed=1, texel_m=0.006),
        radius * np.cos(angle),
        0.8 * radius * np.sin(angle),
        angle + np.pi / 2,
    )


@pytest.fixture(scope="module")
def doors_walk() -> Walk:
    """Along six equal doors, and four of them back, looking ahead all the time."""
    x = np.concatenate([np.linspace(2.0, 20.0, 19), np.linspace(18.0, 7.5, 6)])
    return Walk(equal_doors(seed=1, texel_m=0.008), x, 0 * x, 0 * x)


@pytest.fixture(scope="module")
def whole_events() -> list[LoopEvent]:
    """Takes the loops of `whole_map`."""
    return []


@pytest.fixture(scope="module")
def whole_map(
    room_walk: Walk, whole_events: list[LoopEvent], tmp_path_factory: pytest.TempPathFactory
) -> MapBuilder:
    """Of the whole walk in the room, finished and closed."""
    builder = _map(room_walk, tmp_path_factory.mktemp("maps") / "whole.map", events=whole_events)
    builder.finish()
    builder.close()
    return builder


@pytest.fixture(scope="module")
def first_round(room_walk: Walk, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a map of the first round."""
    path = tmp_path_factory.mktemp("maps") / "first.map"
    builder = _map(room_walk, path, rows=slice(0, 25))
    builder.finish()
    builder.close()
    return path


@pytest.fixture(scope="module")
def doors_map(doors_walk: Walk, tmp_path_factory: pytest.TempPathFactory) -> MapBuilder:
    """Of the walk along equal doors, closed."""
    builder = _map(doors_walk, tmp_path_factory.mktemp("maps") / "doors.map")
    builder.close()
    return builder


def _map(
    walk: Walk,
    path: Path,
    *,
    seed: int = 0,
    rows: slice = slice(None),
    localise: bool = False,
    density: int | None = None,
    events: list[LoopEvent] | None = None,
) -> MapBuilder:
    store = MapStore(path, create=not localise, read_only=localise)
    builder = MapBuilder(
        store, "walk", walk.camera, upright=False, localise=localise, density=density
    )
    for keyframe, features in walk.keyframes(seed=seed, rows=rows):
        found = builder.add(keyframe, features).loops
        if events is not None:
            events += found
    return builder


def _errors_m(T: FloatArray, truth: FloatArray) -> FloatArray:
    """Position errors (N,) in the frame of the first pose."""
    aligned = truth[0] @ se3_inverse(T[0]) @ T
    return np.linalg.norm(aligned[:, :3, 3] - truth[:, :3, 3], axis=1)


def test_a_second_round_closes_loops_and_takes_the_drift_away(
    room_walk: Walk, whole_map: MapBuilder
) -> None:
    graph = whole_map.graph
    loops = [o for o in graph.loops if o.kept]
    assert len({o.second for o in loops}) >= 0.8 * 12, "of the keyframes of the second round"
    for o in loops:
        truth = se3_inverse(room_walk.T[o.first]) @ room_walk.T[o.second]
        assert np.linalg.norm((se3_inverse(truth) @ o.pose.T_i_j)[:3, 3]) < 0.1, "no false loop"
    odometry, optimised = (
        _errors_m(T.rows, room_walk.T)[25:] for T in (graph.T_odom_cam, graph.T_map_cam)
    )
    assert np.sqrt(np.mean(optimised**2)) < 0.6 * np.sqrt(np.mean(odometry**2))


def test_odometry_whose_covariance_is_right_keeps_its_weight(
    room_walk: Walk, tmp_path: Path
) -> None:
    """Of fourteen loops, one is further off than usual, as one is."""
    builder = _map(room_walk, tmp_path / "a.map", seed=4)
    builder.close()
    assert len(builder.graph.loops) > 10
    assert builder.graph.odometry_scale == 1.0


def test_a_loop_names_the_frame_and_the_pixels_that_show_the_place(
    room_walk: Walk, whole_map: MapBuilder, whole_events: list[LoopEvent]
) -> None:
    assert len(whole_events) == len(whole_map.graph.loops)
    for o in whole_events:
        assert o.keyframe_frame == o.keyframe, (
            "frames and keyframes of this walk are numbered alike"
        )
        assert len(o.matches) > 10, "those of the keyframe that shows most"
        seen = o.matches.has_right_keyframe & o.matches.has_right_frame
        p, _ = triangulate(room_walk.camera, o.matches.z_keyframe[seen])
        T = se3_inverse(room_walk.T[o.frame]) @ room_walk.T[o.keyframe]
        gap = project(room_walk.camera, transform_points(T, p)) - o.matches.z_frame[seen]
        assert np.median(np.abs(gap)) < 1.5, "pixels"


def test_equal_doors_are_told_apart_by_the_odometry(
    doors_walk: Walk, doors_map: MapBuilder
) -> None:
    """Three metres away everything looks the same; the loops are those with the place itself."""
    loops = doors_map.graph.loops
    assert len(loops) >= 2
    for o in loops:
        truth = se3_inverse(doors_walk.T[o.first]) @ doors_walk.T[o.second]
        assert np.linalg.norm((se3_inverse(truth) @ o.pose.T_i_j)[:3, 3]) < 0.2


def test_who_wakes_between_equal_doors_is_told_no_place(
    doors_walk: Walk, doors_map: MapBuilder
) -> None:
    lost = _map(doors_walk, doors_map.path, seed=1, rows=slice(8, 16), localise=True)
    assert not lost.is_joined
    assert [o for o in lost.graph.loops if o.second >= lost.first] == []


def test_a_session_finds_its_place_in_an_earlier_map(room_walk: Walk, first_round: Path) -> None:
    before = first_round.read_bytes()
    found = _map(room_walk, first_round, seed=5, rows=slice(28, 35), localise=True)
    assert found.is_joined
    own = found.graph.T_map_cam.rows[25:]
    errors = np.linalg.norm((room_walk.T[0] @ own - room_walk.T[28:35])[:, :3, 3], axis=1)
    assert np.median(errors) < 0.1
    assert first_round.read_bytes() == before


def test_covariance_in_a_map_has_what_the_calibration_leaves_open(
    room_walk: Walk, first_round: Path
) -> None:
    stated = []
    for rig in ((0.0, 0.0), (0.01, 2e-3)):
        store = MapStore(first_round, read_only=True)
        builder = MapBuilder(store, "walk", room_walk.camera, upright=False, localise=True)
        for keyframe, features in room_walk.keyframes(seed=5, rows=slice(28, 35)):
            update = builder.add(replace(keyframe, rig_sigmas=rig), features)
        assert update.covariance is not None
        stated.append(update.covariance)
        builder.close()
    T, by_rig = builder.graph.T_map_cam, stated[1] - stated[0]
    d = T[len(T.rows) - 1][:3, 3] - T[slice(0, 25)][:, :3, 3].mean(axis=0)
    np.testing.assert_allclose(
        np.sqrt(np.trace(by_rig[:3, :3])), 0.01 * np.linalg.norm(d), rtol=0.15
    )
    np.testing.assert_allclose(by_rig[3:, 3:], np.diag([4e-6, 4e-6, 0.0]), atol=1e-12)


def test_covariance_after_a_gap_is_that_of_the_loop_that_ended_it(
    room_walk: Walk, first_round: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loops agree with the odometry, so that the map is not yet optimised again."""
    monkeypatch.setattr(
        "vio.mapping.builder._SETTLING",
        replaced("vio.mapping.builder._SETTLING", settled_error=np.inf),
    )
    store = MapStore(first_round, read_only=True)
    builder = MapBuilder(store, "walk", room_walk.camera, upright=False, localise=True)
    jump = np.diag(np.repeat([30.0**2, 1.0], 3))
    for n, (keyframe, features) in enumerate(room_walk.keyframes(seed=5, rows=slice(26, 35))):
        motion = keyframe.motion
        if n == 5:
            assert motion is not None
            motion = RelativePose(motion.T_i_j, jump)
        update = builder.add(replace(keyframe, motion=motion), features)
    assert update.covariance is not None
    assert np.sqrt(np.trace(update.covariance[:3, :3])) < 0.2
    builder.close()


def test_a_place_that_one_keyframe_has_found_is_said_to_wait_for_another(
    room_walk: Walk, first_round: Path
) -> None:
    store = MapStore(first_round, read_only=True)
    builder = MapBuilder(store, "walk", room_walk.camera, upright=False, localise=True)
    waits = [
        builder.add(*row).unconfirmed for row in room_walk.keyframes(seed=5, rows=slice(27, 31))
    ]
    assert waits[0]
    assert builder.is_joined
    assert not waits[-1]
    builder.close()


def test_who_is_localised_in_a_bent_map_is_not_bent_with_it(
    room_walk: Walk, tmp_path: Path
) -> None:
    """The map's odometry once was off by 0.2 m and says so: what the later session's odometry
    says counts more.
    """
    builder = MapBuilder(
        MapStore(tmp_path / "a.map", create=True),
        "w",
        room_walk.camera,
        upright=False,
        localise=False,
    )
    bend = np.eye(4)
    for keyframe, features in room_walk.keyframes(seed=0, rows=slice(0, 20)):
        motion = keyframe.motion
        if keyframe.frame == 6:
            bend = (
                keyframe.T_odom_cam
                @ se3_exp([0.2, 0, 0, 0, 0, 0])
                @ se3_inverse(keyframe.T_odom_cam)
            )
            motion = RelativePose(
                motion.T_i_j @ se3_exp([0.2, 0, 0, 0, 0, 0]), np.diag((10 * STEP_SIGMA) ** 2)
            )
        builder.add(
            replace(keyframe, T_odom_cam=bend @ keyframe.T_odom_cam, motion=motion), features
        )
    builder.finish()
    builder.close()
    found = _map(room_walk, tmp_path / "a.map", seed=5, rows=slice(25, 37), localise=True)
    found.finish()
    own = found.graph.T_map_cam.rows[20:]
    seen = {o.first < 6 for o in found.graph.loops if o.kept and o.second >= 20}
    assert seen == {True, False}, "on both sides of the bend"
    assert _errors_m(own, room_walk.T[25:37]).max() < 0.09, "0.17 m where the map is taken as exact"


def test_a_jump_of_the_odometry_that_its_motions_do_not_have_leaves_the_place(
    room_walk: Walk, first_round: Path
) -> None:
    """A filter that learns what it was off by moves its newest pose by a metre, but not its
    window's motions.
    """
    store = MapStore(first_round, read_only=True)
    builder = MapBuilder(store, "walk", room_walk.camera, upright=False, localise=True)
    jump = se3_exp([1.0, 0.0, 0.0, 0.0, 0.0, 0.3])
    for keyframe, features in room_walk.keyframes(seed=5, rows=slice(27, 37)):
        moved = jump @ keyframe.T_odom_cam if keyframe.frame > 31 else keyframe.T_odom_cam
        builder.add(replace(keyframe, T_odom_cam=moved), features)
    own = builder.graph.T_map_cam.rows[builder.first :]
    errors = np.linalg.norm((room_walk.T[0] @ own - room_walk.T[27:37])[:, :3, 3], axis=1)
    assert errors[5:].max() < 0.1
    builder.close()


def test_loops_with_the_first_keyframes_do_not_have_what_the_filter_was_off_by_there(
    room_walk: Walk, tmp_path: Path
) -> None:
    """The filter learns the vertical after its first two keyframes: poses turn by two degrees,
    motions do not.
    """
    builder = MapBuilder(
        MapStore(tmp_path / "a.map", create=True),
        "w",
        room_walk.camera,
        upright=False,
        localise=False,
    )
    turned = se3_exp([0.0, 0.0, 0.0, 0.035, 0.0, 0.0])
    for keyframe, features in room_walk.keyframes(seed=0, rows=slice(0, 33)):
        T = keyframe.T_odom_cam if keyframe.frame < 2 else turned @ keyframe.T_odom_cam
        update = builder.add(replace(keyframe, T_odom_cam=T), features)
        if not builder.graph.loops:
            np.testing.assert_allclose(update.T_map_odom, np.eye(4), atol=1e-9)
    builder.close()
    loops = [o for o in builder.graph.loops if o.first < 5]
    assert len(loops) >= 3
    for o in loops:
        gap = se3_inverse(o.pose.T_i_j) @ se3_inverse(room_walk.T[o.first]) @ room_walk.T[o.second]
        assert np.linalg.norm(se3_log(gap)[3:]) < np.radians(0.5)


def test_without_a_loop_the_map_is_what_the_odometry_says(room_walk: Walk, tmp_path: Path) -> None:
    """To the bit, and with its jumps."""
    builder = MapBuilder(
        MapStore(tmp_path / "a.map", create=True),
        "w",
        room_walk.camera,
        upright=False,
        localise=False,
    )
    for keyframe, features in room_walk.keyframes(seed=0, rows=slice(0, 8)):
        T = se3_exp([0.01 * keyframe.frame, 0, 0, 0, 0, 0]) @ keyframe.T_odom_cam
        builder.add(replace(keyframe, T_odom_cam=T), features)
    builder.finish()
    builder.close()
    np.testing.assert_array_equal(builder.graph.T_map_cam.rows, builder.graph.T_odom_cam.rows)
    store = MapStore(tmp_path / "a.map", read_only=True)
    np.testing.assert_array_equal(
        [row.T_map_cam for row in store.keyframes()], builder.graph.T_odom_cam.rows
    )
    store.close()


def test_a_continued_map_joins_both_sessions(
    room_walk: Walk, first_round: Path, tmp_path: Path
) -> None:
    path = tmp_path / "a.map"
    shutil.copyfile(first_round, path)
    second = _map(room_walk, path, seed=5, rows=slice(28, 35))
    assert second.is_joined
    second.finish()
    second.close()
    store = MapStore(path, read_only=True)
    assert [s.part for s in store.sessions()] == [0, 0]
    assert len(store.keyframes()) == 32
    store.close()


def test_after_a_gap_without_odometry_the_place_is_found_again(
    room_walk: Walk, first_round: Path, tmp_path: Path
) -> None:
    """The camera is covered and carried to the other side: the odometry knows nothing of it, and
    says so.
    """
    builder = _map(room_walk, tmp_path / "a.map", seed=2, rows=slice(0, 15))
    T_last = builder.graph.T_odom_cam[-1]
    jump = RelativePose(np.eye(4), np.diag(np.repeat([30.0**2, 1.0], 3)))
    for n, (keyframe, features) in enumerate(room_walk.keyframes(seed=3, rows=slice(25, 31))):
        motion = jump if n == 0 else keyframe.motion
        builder.add(
            replace(keyframe, T_odom_cam=T_last @ keyframe.T_odom_cam, motion=motion), features
        )
    found = room_walk.T[0] @ builder.graph.T_map_cam.rows[-3:]
    assert np.linalg.norm((found - room_walk.T[28:31])[:, :3, 3], axis=1).max() < 0.2
    builder.close()


def test_with_a_density_each_cubic_metre_keeps_features_of_so_many_keyframes(
    room_walk: Walk, whole_map: MapBuilder, tmp_path: Path
) -> None:
    """Keyframes beyond it keep their poses and motions, the map its numbers, and loops are found
    with the others.
    """
    path, density = tmp_path / "a.map", 1
    builder = _map(room_walk, path, density=density)
    builder.finish()
    builder.close()
    with closing(MapStore(path, read_only=True)) as store:
        T, shows = np.array([k.T_map_cam for k in store.keyframes()]), store.show_something()
        sizes = np.array([len(store.features(k)) for k in range(len(T))])
    np.testing.assert_array_equal(sizes > 0, shows)
    cells = np.floor(T[:, :3, 3])
    full = np.unique(cells, axis=0, return_counts=True)[1]
    assert full.max() > density, "the walk comes to a place more often"
    assert np.unique(cells[shows], axis=0, return_counts=True)[1].max() == density
    assert len(T) == len(whole_map.graph)
    found = {o.second for o in builder.graph.loops}
    assert np.sqrt(np.mean(_errors_m(T, room_walk.T) ** 2)) < 0.03
    assert len(found) >= 0.8 * 12, "of the keyframes of the second round"
    again = MapBuilder(MapStore(path), "again", room_walk.camera, upright=False, localise=False)
    np.testing.assert_array_equal(again.places.shows_something, shows)
    again.close()
    assert prune_map(path, density)["keyframes"] == shows.sum()


@pytest.mark.parametrize("density", [None, 1])
def test_a_checkpoint_goes_on_to_the_same_map(
    density: int | None, room_walk: Walk, whole_map: MapBuilder, tmp_path: Path
) -> None:
    keyframes = list(room_walk.keyframes(seed=0))
    path, whole = tmp_path / "b.map", whole_map
    if density is not None:
        whole = _map(room_walk, tmp_path / "a.map", density=density)
        whole.finish()
        whole.close()
    builder = _map(room_walk, path, rows=slice(0, 30), density=density)
    builder.commit()
    dataset = SimpleNamespace(observations=None)
    save_checkpoint(tmp_path / "state", builder, dataset)
    for keyframe, features in keyframes[30:33]:  # what the first process still did before it died
        builder.add(keyframe, features)
    builder.commit()
    builder.close()
    resumed: MapBuilder = load_checkpoint(tmp_path / "state", dataset)
    resumed.reopen(MapStore(path))
    for keyframe, features in keyframes[30:]:
        resumed.add(keyframe, features)
    resumed.finish()
    resumed.close()
    np.testing.assert_array_equal(resumed.graph.T_map_cam.rows, whole.graph.T_map_cam.rows)
    np.testing.assert_array_equal(resumed.places.shows_something, whole.places.shows_something)
    assert resumed.places.shows_something.all() == (density is None)
    rows = []
    for of in (path, whole.path):
        with closing(MapStore(of, read_only=True)) as store:
            poses = [row.T_map_cam.tobytes() for row in store.keyframes()]
            rows.append(
                (poses, [len(store.features(k)) for k in range(len(poses))], str(store.loops()))
            )
    assert rows[0] == rows[1]
    assert rows[0][0] == [T.tobytes() for T in resumed.graph.T_map_cam.rows], (
        "the file holds what was optimised"
    )


def test_the_map_is_made_of_pixels_without_what_the_calibration_is_found_to_be_off_by(
    room_walk: Walk, tmp_path: Path
) -> None:
    """The field is wrong while the session goes on, and known at its end."""
    camera, found = room_walk.camera, {}
    coefficients = np.zeros(15)
    coefficients[[0, 2, 4]] = 1e-2, 1e-2, -2e-2  # 1.6 px and more in disparities
    covariance = np.diag(np.full(15, 1e-10))
    right, none = (
        DisplacementField(camera, c, covariance) for c in (coefficients, 0 * coefficients)
    )
    for name, ended in (("right", right), ("none", none)):
        store = MapStore(tmp_path / f"{name}.map", create=True)
        builder = MapBuilder(store, "walk", camera, upright=False, localise=False)
        for keyframe, seen in room_walk.keyframes(seed=0):
            off = replace(seen, z=seen.z + right.at(seen.z))
            builder.add(replace(keyframe, field=none), off)
        builder.finish(ended)
        builder.close()
        held = MapStore(tmp_path / f"{name}.map", read_only=True)
        field = held.sessions()[0].field
        np.testing.assert_array_equal(field.coefficients, ended.coefficients)
        errors = []
        for loop in held.loops():
            E = (
                se3_inverse(loop.pose.T_i_j)
                @ se3_inverse(room_walk.T[loop.first])
                @ room_walk.T[loop.second]
            )
            errors.append(float(np.linalg.norm(E[:3, 3])))
        assert errors
        found[name] = float(np.median(errors))
    assert found["right"] < 0.7 * found["none"]
    assert found["right"] < 0.02


def test_loops_carry_the_covariance_of_the_stereo_field(room_walk: Walk, tmp_path: Path) -> None:
    """Pixels without noise, a field that is not known to a hundredth of a focal length: loops
    are no better.
    """
    camera, sigmas = room_walk.camera, []
    for sigma in (0.0, 5e-3):
        field = DisplacementField(
            camera, np.zeros(15), np.diag(np.repeat([sigma**2, 0.0], [1, 14]))
        )
        store = MapStore(tmp_path / f"{sigma}.map", create=True)
        builder = MapBuilder(store, "walk", camera, upright=False, localise=False)
        for keyframe, seen in room_walk.keyframes(seed=0):
            builder.add(replace(keyframe, field=field), seen)
        sigmas.append(
            [float(np.sqrt(loop.pose.covariance[:3, :3].trace())) for loop in builder.graph.loops]
        )
        builder.close()
    assert np.median(sigmas[1]) > 1.3 * np.median(sigmas[0])


def test_a_loop_that_was_measured_wrong_is_right_at_the_end(
    room_walk: Walk, tmp_path: Path
) -> None:
    """A first measurement that pixels do not hold, such as one by pairs of the wrong corners, is
    not its own prior.
    """
    field = DisplacementField(room_walk.camera, np.zeros(15), np.diag(np.full(15, 1e-10)))
    builder = _map(room_walk, tmp_path / "a.map")
    graph = builder.graph
    wrong = graph.loops[0]
    T = wrong.pose.T_i_j @ se3_exp([0.15, 0.0, 0.1, 0.0, 0.07, 0.0])
    graph.set_loop(0, replace(wrong, pose=RelativePose(T, wrong.pose.covariance)))
    builder.finish(field)
    builder.close()
    loop = graph.loops[0]
    E = (
        se3_inverse(loop.pose.T_i_j)
        @ se3_inverse(room_walk.T[loop.first])
        @ room_walk.T[loop.second]
    )
    assert np.linalg.norm(E[:3, 3]) < 0.03
    assert loop.kept


def test_a_sparse_map_is_merged_by_two_keyframes_that_are_far_apart(
    room_walk: Walk, first_round: Path, tmp_path: Path
) -> None:
    """Its own motions and loops stay, although the keyframes that they join show nothing any
    more.
    """
    later = tmp_path / "later.map"
    builder = _map(room_walk, later, seed=1, rows=slice(12, None))
    builder.finish()
    builder.close()
    with closing(MapStore(later)) as store:
        odometry, loops = store.odometry(), [o for o in store.loops() if o.kept]
        # of images that the first map does not have
        store.clear_features(np.setdiff1d(np.arange(25), [14, 21]))
    assert loops
    merge_maps(first_round, later, tmp_path / "both.map")
    with closing(MapStore(tmp_path / "both.map", read_only=True)) as both:
        assert len(both.sessions()) == 2
        assert repr(both.odometry()[-len(odometry) :]) == repr(
            [(i + 25, j + 25, motion) for i, j, motion in odometry]
        )
        kept = {(o.first, o.second) for o in both.loops() if o.kept}
        assert {(o.first + 25, o.second + 25) for o in loops} <= kept
        T = np.array([row.T_map_cam for row in both.keyframes()])
    errors = np.linalg.norm((room_walk.T[0] @ T[25:] - room_walk.T[12:])[:, :3, 3], axis=1)
    assert np.median(errors) < 0.1


def test_maps_of_one_corridor_of_equal_doors_are_not_merged(
    doors_walk: Walk, tmp_path: Path
) -> None:
    """What the way back shows is like several places of the way there."""
    paths = [tmp_path / "there.map", tmp_path / "back.map"]
    for path, rows in zip(paths, (slice(0, 19), slice(19, None)), strict=True):
        builder = _map(doors_walk, path, rows=rows)
        builder.finish()
        builder.close()
    with pytest.raises(DataError, match="shows no place of"):
        merge_maps(*paths, tmp_path / "both.map")


def test_a_merge_keeps_where_the_later_map_is_on_the_earth(
    room_walk: Walk, first_round: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The later map's keyframes stay where they are on the earth, although the frame is that of
    the first map.
    """
    first, later = tmp_path / "first.map", tmp_path / "later.map"
    shutil.copy(first_round, first)
    builder = _map(room_walk, later, seed=1, rows=slice(25, None))
    builder.finish()
    builder.close()
    earth = EarthRow((49.0, 8.4, 115.0), se3_exp([5.0, 6.0, 7.0, 0.1, 0.2, 2.0]), 1e-4 * np.eye(6))
    with closing(MapStore(later)) as store:
        store.set_earth(earth)
        before = [row.T_map_cam for row in store.keyframes()]
    merge_maps(first, later, tmp_path / "both.map")
    with closing(MapStore(tmp_path / "both.map", read_only=True)) as store:
        found, rows = store.earth(), store.keyframes()
    assert found.origin == earth.origin
    assert np.linalg.norm(found.T_enu_map[:3, 3] - earth.T_enu_map[:3, 3]) > 0.2, (
        "the frame is another one"
    )
    now = np.array([row.T_map_cam for row in rows[-len(before) :]])
    gap = se3_log(se3_inverse(earth.T_enu_map @ before) @ found.T_enu_map @ now)
    assert np.linalg.norm(gap[:, :3], axis=1).max() < 0.05
    assert np.linalg.eigvalsh(found.covariance - 1e-9 * np.eye(6))[0] > 0
    with closing(MapStore(first)) as store:
        store.set_earth(earth)
    merge_maps(first, later, tmp_path / "two.map")
    assert "that recorded first is kept" in caplog.text
    with closing(MapStore(tmp_path / "two.map", read_only=True)) as store:
        kept = store.earth()
    np.testing.assert_array_equal(kept.T_enu_map, earth.T_enu_map)
