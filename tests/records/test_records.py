"""Observations joined into one table and taken out of it again."""

from __future__ import annotations

import numpy as np
import pytest

from vio.errors import DataError
from vio.records import Trajectory, feature_tracks, observations, shared_rows


def test_frames_come_back_out_of_the_table_and_missing_ones_are_empty() -> None:
    seen = {
        3: observations(3, 30, [7, 9], np.arange(8).reshape(2, 4), stale=[False, True]),
        1: observations(1, 10, [7], [[1, 2, 3, 4]], has_right=[False]),
    }
    tracks = feature_tracks(seen, 5)
    assert tracks.frames.tolist() == [1, 3, 3]
    for k in range(5):
        again = tracks.at(k, 10 * k)
        assert (again.frame_index, again.time_ns) == (k, 10 * k)
        wanted = seen.get(k, observations(k, 10 * k, [], np.zeros((0, 4))))
        for name in ("ids", "z", "has_right", "stale"):
            np.testing.assert_array_equal(getattr(again, name), getattr(wanted, name))


def test_no_observations_are_a_table_too() -> None:
    tracks = feature_tracks({}, 2)
    assert tracks.offsets.tolist() == [0, 0, 0]
    assert tracks.z.shape == (0, 4)


def test_observations_that_contradict_themselves_are_refused() -> None:
    with pytest.raises(DataError, match="disagree in length: 2 ids, 1 z"):
        observations(0, 0, [1, 2], [[1, 2, 3, 4]])
    with pytest.raises(DataError, match="frame 5: an id occurs twice among 3 observations"):
        observations(5, 0, [1, 2, 1], np.zeros((3, 4)))


@pytest.mark.parametrize("shape", [(4, 6), (6, 2), (3, 8)])
def test_pixels_that_are_no_rows_of_four_are_refused_not_reshaped(shape: tuple[int, int]) -> None:
    with pytest.raises(DataError, match=r"z has the shape .*; give \(N, 4\)"):
        observations(0, 0, range(6), np.arange(float(np.prod(shape))).reshape(shape))


def test_shared_rows_are_those_of_the_common_ids_in_their_order() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        ids, other = (rng.permutation(30)[: rng.integers(0, 20)] for _ in range(2))
        rows, others = shared_rows(ids, other)
        common = sorted(set(ids.tolist()) & set(other.tolist()))
        assert ids[rows].tolist() == other[others].tolist() == common


@pytest.mark.parametrize("kind", [np.uint64, np.uint8, np.int32, np.float64])
def test_shared_rows_are_found_of_ids_of_any_type(kind: type[np.generic]) -> None:
    """A plug-in's expected pixels have ids of its own type, and none are an empty list's floats."""
    ids = np.array([7, 3, 5], dtype=kind)
    rows, others = shared_rows(ids[:0], np.array([5, 7]))
    assert (len(rows), len(others)) == (0, 0)
    rows, others = shared_rows(np.array([5, 7, 9]), ids)
    assert (rows.tolist(), others.tolist()) == ([0, 1], [2, 0])


def test_a_trajectory_is_moved_to_the_other_frame_once() -> None:
    T_cam0_imu = np.eye(4)
    T_cam0_imu[:3, 3] = [1.0, 2.0, 3.0]
    imu = Trajectory(np.tile(np.eye(4), (2, 1, 1)), None, "imu")
    assert imu.in_imu(T_cam0_imu) is imu
    cam0 = imu.in_cam0(T_cam0_imu)
    np.testing.assert_allclose(cam0.positions, [[-1.0, -2.0, -3.0]] * 2)
    np.testing.assert_allclose(cam0.in_imu(T_cam0_imu).positions, 0.0)


@pytest.mark.parametrize("spread", [1, 7, 10**6, 2**60])
def test_shared_rows_are_in_the_order_of_the_ids(spread: int) -> None:
    """Also of ids that are far apart, as hashes are, whose differences overflow."""
    rng = np.random.default_rng(2)
    for _ in range(200):
        ids, others = (
            (rng.permutation(16)[:count] - 8) * spread for count in rng.integers(0, 12, 2)
        )
        rows, of_others = shared_rows(ids, others)
        common = sorted(set(ids.tolist()) & set(others.tolist()))
        assert ids[rows].tolist() == others[of_others].tolist() == common
