"""Which tracks enter an update, how far they are believed, and what a wrong view costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from tests.numpy_twins import point_D_pose
from vio.filters.settings import MsckfSettings
from vio.filters.stereo_calibration import eliminate_points
from vio.filters.track_records import Residuals
from vio.filters.window_tracks import MIN_PIXEL_SIGMA_PX, WindowTracks
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, transform_points
from vio.geometry.stereo import StereoCamera, project
from vio.records import observations

CAMERA = StereoCamera(460.0, 458.0, 370.0, 240.0, 0.11, 752, 480)
SETTINGS = MsckfSettings()
T_CAM0_WORLD = se3_exp(np.cumsum(np.random.default_rng(0).normal(0, 0.1, (4, 6)), axis=0))


def _points(n: int) -> FloatArray:
    p_cam = np.random.default_rng(1).uniform([-1.0, -0.8, 3.0], [1.0, 0.8, 6.0], (n, 3))
    return transform_points(se3_inverse(T_CAM0_WORLD[0]), p_cam)


def _tracks(
    p: FloatArray, frames: int = 4, noise_px: float = 0.0, settings: MsckfSettings = SETTINGS
) -> WindowTracks:
    tracks, rng = WindowTracks(CAMERA, settings), np.random.default_rng(2)
    for k in range(frames):
        z = project(CAMERA, transform_points(T_CAM0_WORLD[k], p)) + rng.normal(
            0, noise_px, (len(p), 4)
        )
        tracks.table.add_frame(k, observations(k, k, np.arange(len(p)), z))
    return tracks


def test_the_gate_knows_how_many_pixels_were_seen() -> None:
    """Three stereo views of three pixels each, less the three of the point: 6 degrees of freedom;
    left views alone: 3.

    The right row is measured in none.
    """
    tracks = WindowTracks(CAMERA, SETTINGS)
    J = np.ones((4, 3, 4, 3))
    J[:, :, 3] = 0.0
    J[2:, :, 2] = 0.0  # seen left only
    r = np.zeros((4, 3, 4))
    limits = tracks.variance * np.repeat(chi2.ppf(SETTINGS.gate_probability, [6, 3]), 2)
    r[:, 1, 0] = np.sqrt(limits * [0.999, 1.001, 0.999, 1.001])
    passed, squares, dof = tracks.gate(
        Residuals(r, J, np.ones(4, dtype=np.bool_), np.ones(r.shape))
    )
    assert passed.tolist() == [True, False, True, False]
    assert dof.tolist() == [6, 6, 3, 3]
    np.testing.assert_allclose(squares, r[:, 1, 0] ** 2 / tracks.variance)


@pytest.mark.parametrize(("ending", "going_on"), [(300, 15), (100, 50), (0, 150)])
def test_the_newest_pose_is_not_left_to_a_few_tracks_where_nearly_all_end(
    ending: int, going_on: int
) -> None:
    """Behind a cover hundreds of tracks end at once, and a wrong one among a few that go on
    would decide.
    """
    tracks, p = WindowTracks(CAMERA, SETTINGS), _points(500)
    for k in range(1, 4):
        ids = np.arange(ending if k == 3 else 0, 500)
        tracks.table.add_frame(
            k, observations(k, k, ids, project(CAMERA, transform_points(T_CAM0_WORLD[k], p[ids])))
        )
    chosen = tracks.choose(4)
    assert len(chosen) == SETTINGS.max_features == 150
    assert int((tracks.table.ids(chosen) >= ending).sum()) == going_on


def test_the_gate_of_a_track_as_long_as_the_table_of_quantiles_or_longer() -> None:
    tracks = WindowTracks(CAMERA, SETTINGS)
    J = np.ones((1, 80, 4, 3))
    assert tracks.gate(
        Residuals(np.zeros((1, 80, 4)), J, np.ones(1, np.bool_), np.ones((1, 80, 4)))
    )[2].tolist() == [199]


@pytest.mark.parametrize("moving", [0, 40, 65])
def test_a_blurred_frame_is_no_frame_of_outliers(moving: int) -> None:
    """All residuals have three times the variance that is believed; of 80 tracks, some are on what
    moves.

    The others pass as they do with the noise known, and what moves does not.
    """
    tracks, rng = WindowTracks(CAMERA, SETTINGS), np.random.default_rng(3)
    J = np.ones((80, 3, 4, 3))
    J[:, :, 3] = 0.0
    # nine pixels, six degrees of freedom
    r = rng.normal(0.0, np.sqrt(3 * tracks.variance * 6 / 9), (80, 3, 4))
    r[:, :, 3] = 0.0
    r[80 - moving :] += 20.0 * np.sqrt(tracks.variance)
    passed, _, _ = tracks.gate(Residuals(r, J, np.ones(80, dtype=np.bool_), np.ones(r.shape)))
    assert passed[: 80 - moving].mean() > 0.9
    assert not passed[80 - moving :].any()
    few = Residuals(r[:10], J[:10], np.ones(10, dtype=np.bool_), np.ones((10, *r.shape[1:])))
    assert tracks.gate(few)[0].mean() < 0.8  # too few to tell noise from outliers


def test_what_moves_slowly_is_no_blur() -> None:
    """Half of 80 tracks are off by two standard deviations in every pixel, and the others by
    what is believed.
    """
    tracks, rng = WindowTracks(CAMERA, SETTINGS), np.random.default_rng(4)
    J = np.ones((80, 3, 4, 3))
    J[:, :, 3] = 0.0
    r = rng.normal(0.0, np.sqrt(tracks.variance * 6 / 9), (80, 3, 4))
    r[:40] += 2.0 * np.sqrt(tracks.variance)
    r[:, :, 3] = 0.0
    passed, _, _ = tracks.gate(Residuals(r, J, np.ones(80, dtype=np.bool_), np.ones(r.shape)))
    assert passed[40:].mean() > 0.9
    assert passed[:40].mean() < 0.1


def test_the_misfit_is_known_beyond_the_noise_that_all_tracks_may_have() -> None:
    """Residuals are four and eight times what is believed."""
    tracks, rng = WindowTracks(CAMERA, SETTINGS), np.random.default_rng(4)
    J = np.ones((80, 3, 4, 3))
    J[:, :, 3] = 0.0
    r = rng.normal(0.0, 4.0 * np.sqrt(tracks.variance * 6 / 9), (80, 3, 4))
    r[:, :, 3] = 0.0
    misfits = []
    for factor in (1.0, 2.0):
        tracks.gate(Residuals(factor * r, J, np.ones(80, dtype=np.bool_), np.ones(r.shape)))
        assert tracks.common_noise == 4.0
        misfits.append(tracks.misfit)
    assert 8.0 < misfits[0] < 32.0
    assert misfits[1] == pytest.approx(4.0 * misfits[0])


@pytest.mark.parametrize(("off", "noise_px"), [(0.0, 0.1), (5e-4, 0.1), (5e-4, 0.15)])
def test_a_pose_that_is_off_is_no_noise_of_all_tracks(off: float, noise_px: float) -> None:
    """A tenth of a pixel is believed; pixels have more, or the newest pose is off by half a
    millimetre and milliradian.

    The common noise is that of the pixels within a sixth, where the pose makes it 1.5 to 3 times as
    much.
    """
    tracks = _tracks(
        _points(300), noise_px=noise_px, settings=replace(SETTINGS, pixel_sigma_px=0.1)
    )
    T = T_CAM0_WORLD.copy()
    T[-1] = se3_exp(np.full(6, off)) @ T[-1]
    linear = tracks.linearise(T, tracks.choose(4), 5)
    _, nis, dof = tracks.gate(linear.at)
    assert off == 0 or tracks.common_noise > 1.5 * (noise_px / 0.1) ** 2
    tracks.leave_motion_out(linear, nis, dof)
    np.testing.assert_allclose(tracks.common_noise, (noise_px / 0.1) ** 2, rtol=1 / 6)


@pytest.mark.parametrize("dof", [1, 3, 6, 45, 199])
@pytest.mark.parametrize(
    ("ratio", "count", "change"),
    [
        (1.0, 15, 1.0),
        (2.0, 15, 2.0),
        (0.5, 15, 0.5),
        (9e9, 15, 4.0),
        (0.0, 15, 0.25),
        (9.0, 14, 1.0),
    ],
)
def test_pixel_noise_follows_the_median_slowly(
    ratio: float, count: int, change: float, dof: int
) -> None:
    """By the twentieth root of its ratio to the median of chi-square, at most four; not where
    few tracks tell.
    """
    tracks = WindowTracks(CAMERA, SETTINGS)
    for _ in range(20):
        tracks.update_pixel_noise(np.full(600, chi2.ppf(0.5, 45)), np.full(600, 45), -3.0)
    before = tracks.variance
    np.testing.assert_allclose(before, SETTINGS.pixel_sigma_px**2)
    values = np.full(count, ratio * chi2.ppf(0.5, dof))
    values[:6] = 1e6  # wrong tracks below half
    values = np.append(values, np.full(6, 0.0)) if count >= 15 else values
    tracks.update_pixel_noise(values, np.full(len(values), dof), -3.0)
    np.testing.assert_allclose(tracks.variance, before * change**0.05)


def test_pixel_noise_is_learned_in_the_first_frame() -> None:
    tracks, dof = WindowTracks(CAMERA, SETTINGS), np.full(200, 3)
    truth = (0.2 * SETTINGS.pixel_sigma_px) ** 2
    tracks.update_pixel_noise(np.full(200, chi2.ppf(0.5, 3)) * 0.2**2, dof, 0.0)
    np.testing.assert_allclose(np.sqrt(tracks.variance / truth), 1.0, rtol=0.2)


@pytest.mark.parametrize("spent", [0, 30, 1000])
def test_pixel_noise_counts_what_was_spent_on_the_poses(spent: float) -> None:
    """60 tracks, 180 degrees of freedom; three go to the noise itself, at most three in four are
    believed spent.
    """
    tracks = WindowTracks(CAMERA, SETTINGS)
    tracks.update_pixel_noise(np.full(60, chi2.ppf(0.5, 3)), np.full(60, 3), spent)
    change = 180 / max(180 - 3 - spent, 45)
    np.testing.assert_allclose(tracks.variance, SETTINGS.pixel_sigma_px**2 * change ** (1 / 1.1))


@pytest.mark.parametrize("dofs", [(3, 3), (4, 8), (45, 45), (3, 45)])
def test_pixel_noise_is_learned_without_bias_whatever_the_degrees_of_freedom(
    dofs: tuple[int, int],
) -> None:
    """Squared residuals of tracks of 3 to 45 degrees of freedom, drawn from chi-square for a noise
    of 0.4 px.

    The median of 60 ratios has a standard deviation of 14 % at 3 degrees of freedom. The gain of
    0.05 makes 2.3 % of it, and the mean over 600 frames, of which about 40 count as one, 0.6 %: the
    bound is three standard deviations.
    """
    tracks, rng, values = WindowTracks(CAMERA, SETTINGS), np.random.default_rng(0), []
    for _ in range(800):
        dof = rng.integers(dofs[0], dofs[1] + 1, 60)
        tracks.update_pixel_noise(0.4**2 * rng.chisquare(dof) / tracks.variance, dof, -3.0)
        values.append(tracks.variance)
    np.testing.assert_allclose(np.mean(values[200:]), 0.4**2, rtol=0.02)


def test_pixel_noise_stays_in_its_bounds() -> None:
    tracks = WindowTracks(CAMERA, SETTINGS)
    for _ in range(200):
        tracks.update_pixel_noise(np.full(20, 100.0), np.full(20, 5), 0.0)
    assert tracks.variance == SETTINGS.pixel_sigma_max_px**2
    for _ in range(500):
        tracks.update_pixel_noise(np.zeros(20), np.full(20, 5), 0.0)
    assert tracks.variance == MIN_PIXEL_SIGMA_PX**2


def test_tracks_that_end_come_first_then_the_longest() -> None:
    """Ids 0, 1: ended; 2, 3: begun later; 4, 5: there all along, the oldest view leaves; 6: one
    view alone.
    """
    tracks = WindowTracks(CAMERA, replace(SETTINGS, max_features=4))
    for k, ids in enumerate([[4, 5], [0, 1, 4, 5], [0, 1, 2, 3, 4, 5], [2, 3, 4, 5, 6]]):
        tracks.table.add_frame(
            k, observations(k, k, ids, np.tile([300.0, 200, 280, 200], (len(ids), 1)))
        )
    assert tracks.table.ids(tracks.choose(4)).tolist() == [0, 1, 4, 5]
    tracks = WindowTracks(CAMERA, replace(SETTINGS, max_features=2))
    for k, ids in enumerate([[9], [1, 2, 3], [1, 2, 3], [2, 3]]):
        tracks.table.add_frame(
            k, observations(k, k, ids, np.tile([300.0, 200, 280, 200], (len(ids), 1)))
        )
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
    """Eliminate the points, solve for the poses, move the points: the same as solving for both
    at once.
    """
    # points step in inverse depth, so the same to first order
    tracks = _tracks(_points(5), noise_px=1e-4)
    linear = tracks.linearise(T_CAM0_WORLD, tracks.choose(4), 2)
    A, b = eliminate_points(linear.information, np.ones(5, dtype=np.bool_))
    prior = np.eye(24) * 1e3
    poses = np.linalg.solve(A + prior, b)
    before = linear.p_world.copy()
    tracks.move_points(linear, linear.stereo, poses, np.zeros(0))
    H, r = np.zeros((5 * 16, 24 + 15)), np.zeros(5 * 16)
    lever = point_D_pose(before)
    weight = 1 / (
        1 + np.sum(linear.at.r**2, axis=2) / (4 * _scales(linear.at, tracks.variance) * 9.0)
    )
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
    np.testing.assert_allclose(
        tracks.table.points[linear.rows] - before, expected[24:].reshape(5, 3), atol=1e-7
    )


def _scales(at: Residuals, variance: float) -> FloatArray:
    """The robust weights' squared scale of each clone (N,)."""
    return np.maximum(variance, np.median(np.sum(at.r**2, axis=2), axis=0) / 2.37)


def test_images_agree_where_four_fifths_of_the_newest_views_fit() -> None:
    tracks = WindowTracks(CAMERA, SETTINGS)
    J, r = np.ones((10, 3, 4, 3)), np.zeros((10, 3, 4))
    r[:, 0] = 50.0  # old views are not asked
    r[0, -1, 0] = 50.0
    assert tracks.agree(Residuals(r, J, np.ones(10, dtype=np.bool_), np.ones(r.shape)))
    r[1, -1, 0] = 50.0
    assert not tracks.agree(Residuals(r, J, np.ones(10, dtype=np.bool_), np.ones(r.shape)))
    # nothing seen
    assert not tracks.agree(Residuals(r * 0, J * 0, np.ones(10, dtype=np.bool_), np.ones(r.shape)))


def test_a_frame_ends_what_it_does_not_show() -> None:
    tracks = _tracks(_points(4), frames=3)
    tracks.table.add_frame(
        3, observations(3, 3, [1, 2, 3], np.tile([300.0, 200, 280, 200], (3, 1)))
    )
    row = {
        int(i): r
        for i, r in zip(tracks.table.ids(tracks.table.rows()), tracks.table.rows(), strict=True)
    }
    tracks.end_frame(spent=np.array([row[1]]), promoted=np.array([row[2]]), newest=3)
    assert tracks.table.ids(tracks.table.rows()).tolist() == [1, 3]
    assert not tracks.table.seen(np.array([row[1]])).any()  # lives on, its pixels have been used
    assert tracks.table.seen(np.array([row[3]]))[0, :4].all()
    linear = tracks.linearise(T_CAM0_WORLD[:3], np.array([row[3]]), 1)
    assert linear.newest_innovation() is not None
