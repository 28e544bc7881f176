"""Which tracks enter an update, how far they are believed, and what a wrong view costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from vio.filters.multiview import Residuals, eliminate_points, point_D_pose
from vio.filters.settings import MsckfSettings
from vio.filters.window_tracks import WindowTracks
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, transform_points
from vio.geometry.stereo import StereoCamera, project
from vio.records import observations

CAMERA = StereoCamera(460.0, 458.0, 370.0, 240.0, 0.11, 752, 480)
SETTINGS = MsckfSettings()
T_CAM0_WORLD = se3_exp(np.cumsum(np.random.default_rng(0).normal(0, 0.1, (4, 6)), axis=0))


def _points(n: int) -> FloatArray:
    p_cam = np.random.default_rng(1).uniform([-1.0, -0.8, 3.0], [1.0, 0.8, 6.0], (n, 3))
    return transform_points(se3_inverse(T_CAM0_WORLD[0]), p_cam)


def _tracks(p: FloatArray, frames: int = 4, noise_px: float = 0.0, settings: MsckfSettings = SETTINGS) -> WindowTracks:
    tracks, rng = WindowTracks(CAMERA, settings), np.random.default_rng(2)
    for k in range(frames):
        z = project(CAMERA, transform_points(T_CAM0_WORLD[k], p)) + rng.normal(0, noise_px, (len(p), 4))
        tracks.table.add_frame(k, observations(k, k, np.arange(len(p)), z))
    return tracks


def _moving_by(pixels: FloatArray, settings: MsckfSettings = SETTINGS) -> WindowTracks:
    """Tracks whose left pixels move by (K,) between two frames."""
    tracks, ids = WindowTracks(CAMERA, settings), np.arange(len(pixels))
    z = np.tile([300.0, 200, 280, 200], (len(ids), 1))
    tracks.table.add_frame(0, observations(0, 0, ids, z))
    tracks.table.add_frame(1, observations(1, 1, ids, z + np.outer(pixels, [0.6, 0.8, 0.6, 0.8])))
    return tracks


def test_the_gate_knows_how_many_pixels_were_seen() -> None:
    """Three views of two pairs each, less the three of the point: 9 degrees of freedom; left views alone: 3."""
    tracks = WindowTracks(CAMERA, SETTINGS)
    J = np.ones((4, 3, 4, 3))
    J[2:, :, 2:] = 0.0  # seen left only
    r = np.zeros((4, 3, 4))
    limits = tracks.variance * np.repeat(chi2.ppf(SETTINGS.gate_probability, [9, 3]), 2)
    r[:, 1, 0] = np.sqrt(limits * [0.999, 1.001, 0.999, 1.001])
    passed, nis_per_dof = tracks.gate(Residuals(r, J, np.ones(4, dtype=np.bool_)))
    assert passed.tolist() == [True, False, True, False]
    np.testing.assert_allclose(nis_per_dof, r[:, 1, 0] ** 2 / tracks.variance / [9, 9, 3, 3])


@pytest.mark.parametrize(
    ("nis", "count", "change"),
    [(0.85, 15, 1.0), (1.7, 15, 2.0), (0.425, 15, 0.5), (9e9, 15, 4.0), (0.0, 15, 0.25), (9.0, 14, 1.0)],
)
def test_pixel_noise_follows_the_median_slowly(nis: float, count: int, change: float) -> None:
    """By the twentieth root of its ratio, at most four; not where few tracks tell."""
    tracks = WindowTracks(CAMERA, SETTINGS)
    before = tracks.variance
    values = np.full(count, nis)
    values[:6] = 1e6  # wrong tracks below half
    tracks.update_pixel_noise(np.append(values, np.full(6, 0.0)) if count >= 15 else values)
    np.testing.assert_allclose(tracks.variance, before * change**0.05)


def test_pixel_noise_stays_in_its_bounds() -> None:
    tracks = WindowTracks(CAMERA, SETTINGS)
    for _ in range(200):
        tracks.update_pixel_noise(np.full(20, 100.0))
    assert tracks.variance == SETTINGS.pixel_sigma_max_px**2
    for _ in range(500):
        tracks.update_pixel_noise(np.zeros(20))
    assert tracks.variance == SETTINGS.pixel_sigma_min_px**2


@pytest.mark.parametrize(
    ("pixels", "still"),
    [
        (np.full(15, 0.24), True),
        (np.full(15, 0.26), False),
        (np.full(14, 0.0), False),  # too few to tell
        (np.append(np.full(17, 0.1), np.full(3, 0.6)), False),  # more than a tenth moves
        (np.append(np.full(19, 0.1), 5.0), True),  # one that passes by
    ],
)
def test_the_image_stands_still_where_nearly_all_of_it_does(pixels: FloatArray, still: bool) -> None:
    assert _moving_by(pixels).is_stationary(2) is still
    assert not _moving_by(pixels).is_stationary(1)
    assert not _moving_by(pixels, replace(SETTINGS, still_px=0.0)).is_stationary(2)


def test_tracks_that_end_come_first_then_the_longest() -> None:
    """Ids 0, 1: ended; 2, 3: begun later; 4, 5: there all along, the oldest view leaves; 6: one view alone."""
    tracks = WindowTracks(CAMERA, replace(SETTINGS, max_features=4))
    for k, ids in enumerate([[4, 5], [0, 1, 4, 5], [0, 1, 2, 3, 4, 5], [2, 3, 4, 5, 6]]):
        tracks.table.add_frame(k, observations(k, k, ids, np.tile([300.0, 200, 280, 200], (len(ids), 1))))
    assert tracks.table.ids(tracks.choose(4)).tolist() == [0, 1, 4, 5]
    tracks = WindowTracks(CAMERA, replace(SETTINGS, max_features=2))
    for k, ids in enumerate([[9], [1, 2, 3], [1, 2, 3], [2, 3]]):
        tracks.table.add_frame(k, observations(k, k, ids, np.tile([300.0, 200, 280, 200], (len(ids), 1))))
    assert tracks.table.ids(tracks.choose(4)).tolist() == [1, 2]  # 1 has ended; 2 and 3 are as long


def test_a_wrong_view_is_dropped_for_good_and_the_rest_of_its_track_stays() -> None:
    p = _points(6)
    tracks = _tracks(p, noise_px=0.1)
    z = project(CAMERA, transform_points(T_CAM0_WORLD[2], p[:1]))
    tracks.table.add_frame(2, observations(2, 2, [0], z + np.array([4.0, -3.0, 4.0, -3.0])))
    rows = tracks.choose(4)
    linear = tracks.linearise(T_CAM0_WORLD, rows, 5)
    mended = tracks.without_wrong_views(linear)
    assert tracks.table.ids(mended.rows).tolist() == [0, 1, 2, 3, 4, 5]
    assert not tracks.table.seen(rows)[0, 2]
    assert tracks.table.seen(rows).sum() == 23
    assert not mended.at.r[0, 2].any()
    assert not mended.at.z_D_p[0, 2].any()
    again = tracks.linearise(T_CAM0_WORLD, rows, 10)
    assert np.linalg.norm(again.p_world[0] - p[0]) < np.linalg.norm(linear.p_world[0] - p[0])
    np.testing.assert_allclose(again.p_world, p, atol=0.05)


def test_a_track_of_two_views_does_not_outlive_a_wrong_one() -> None:
    p = _points(20)
    tracks = _tracks(p, frames=2)
    z = project(CAMERA, transform_points(T_CAM0_WORLD[1], p[:1]))
    tracks.table.add_frame(1, observations(1, 1, [0], z + np.array([0.0, 60.0, 0.0, 60.0])))
    linear = tracks.linearise(T_CAM0_WORLD[:2], tracks.choose(2), 5)
    assert tracks.table.ids(tracks.without_wrong_views(linear).rows).tolist() == list(range(1, 20))


def test_nothing_wrong_changes_nothing() -> None:
    tracks = _tracks(_points(5))
    linear = tracks.linearise(T_CAM0_WORLD, tracks.choose(4), 3)
    assert tracks.without_wrong_views(linear) is linear


def test_points_follow_the_poses_as_the_joint_problem_says() -> None:
    """Eliminate the points, solve for the poses, move the points: the same as solving for both at once."""
    tracks = _tracks(_points(5), noise_px=1e-4)  # points step in inverse depth, so the same to first order
    linear = tracks.linearise(T_CAM0_WORLD, tracks.choose(4), 2)
    A, b = eliminate_points(linear.information, np.ones(5, dtype=np.bool_))
    prior = np.eye(24) * 1e3
    poses = np.linalg.solve(A + prior, b)
    before = linear.p_world.copy()
    tracks.move_points(linear, poses)
    H, r = np.zeros((5 * 16, 24 + 15)), np.zeros(5 * 16)
    lever = point_D_pose(before)
    weight = 1 / (1 + np.sum(linear.at.r**2, axis=2) / (4 * _scales(linear.at, tracks.variance) * 9.0))
    for f in range(5):
        for n in range(4):
            rows = slice(16 * f + 4 * n, 16 * f + 4 * n + 4)
            root = np.sqrt(weight[f, n])
            H[rows, 6 * n : 6 * n + 6] = root * linear.at.z_D_p[f, n] @ lever[f]
            H[rows, 24 + 3 * f : 27 + 3 * f] = root * linear.at.z_D_p[f, n]
            r[rows] = root * linear.at.r[f, n]
    joint = H.T @ H
    joint[:24, :24] += prior
    expected = np.linalg.solve(joint, H.T @ r)
    np.testing.assert_allclose(poses, expected[:24], atol=1e-8)
    np.testing.assert_allclose(tracks.table.points[linear.rows] - before, expected[24:].reshape(5, 3), atol=1e-7)


def _scales(at: Residuals, variance: float) -> FloatArray:
    """The robust weights' squared scale of each clone (N,)."""
    return np.maximum(variance, np.median(np.sum(at.r**2, axis=2), axis=0) / 3.36)


def test_images_agree_where_four_fifths_of_the_newest_views_fit() -> None:
    tracks = WindowTracks(CAMERA, SETTINGS)
    J, r = np.ones((10, 3, 4, 3)), np.zeros((10, 3, 4))
    r[:, 0] = 50.0  # old views are not asked
    r[0, -1, 0] = 50.0
    assert tracks.agree(Residuals(r, J, np.ones(10, dtype=np.bool_)))
    r[1, -1, 0] = 50.0
    assert not tracks.agree(Residuals(r, J, np.ones(10, dtype=np.bool_)))
    assert not tracks.agree(Residuals(r * 0, J * 0, np.ones(10, dtype=np.bool_)))  # nothing seen


def test_a_frame_ends_what_it_does_not_show() -> None:
    tracks = _tracks(_points(4), frames=3)
    tracks.table.add_frame(3, observations(3, 3, [1, 2, 3], np.tile([300.0, 200, 280, 200], (3, 1))))
    row = {int(i): r for i, r in zip(tracks.table.ids(tracks.table.rows()), tracks.table.rows(), strict=True)}
    tracks.end_frame(spent=np.array([row[1]]), promoted=np.array([row[2]]), newest=3)
    assert tracks.table.ids(tracks.table.rows()).tolist() == [1, 3]
    assert not tracks.table.seen(np.array([row[1]])).any()  # lives on, its pixels have been used
    assert tracks.table.seen(np.array([row[3]]))[0, :4].all()
    linear = tracks.linearise(T_CAM0_WORLD[:3], np.array([row[3]]), 1)
    assert linear.newest_innovation() is not None
