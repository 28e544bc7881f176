"""The calibration that a run found: its rig, its pixels, its file, and the next run from it.

References: rigs that are moved by known parameters, and the exact world of test_filter_truth.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import vio
from tests.calibration.test_stereo_calibration import _turned_right
from tests.commands import refused
from tests.euroc_maker import EQUIDISTANT_RIG, RADTAN_RIG
from tests.filters import test_filter_truth
from tests.filters.test_filter_truth import Course
from vio.calibration.severity import StereoError
from vio.calibration.stereo_field import (
    PARAMETERS,
    DisplacementField,
    _Frame,
    calibrated_rig,
    disparity_off,
    estimated_rig,
    field_of,
    rig_off_by,
)
from vio.cameras.rig import Rig
from vio.cli import main
from vio.config import load_config
from vio.datasets.observation_log import write_observation_log
from vio.datasets.rigs.kalibr import kalibr_text
from vio.errors import CalibrationError, DataError
from vio.geometry.distortion import StereoRig, project_point
from vio.geometry.lie import FloatArray, se3_exp, se3_inverse, so3_log
from vio.geometry.rectify import rectified_cameras, rectify_pixels
from vio.geometry.stereo import StereoCamera
from vio.offline.saved_run import read_saved_run
from vio.records import Estimate, Observations, Recording, StereoFieldEstimate, StereoScaleEstimate
from vio.runs.picture import has_calibration_panel

CAMERA = replace(test_filter_truth.CAMERA, width=752, height=480)
RECTIFIED = Rig.rectified(718.0, 715.0, 607.0, 185.0, 0.54, 1242, 375)
OFF = np.array(
    [0.009, -0.012, 0.006, 1e-3, -2e-3, 1e-3, -1e-3, 1e-3, -5e-4, 3e-3, -2e-3, 5e-4, -1e-3, 4e-3]
)
TURN = np.radians(0.5)


def _of_raw(rig: StereoRig) -> Rig:
    return Rig(rig.cam0, rig.cam1, se3_inverse(rig.T_cam0_cam1))


def _estimate(coefficients: FloatArray, sigma: float = 1e-4) -> Estimate:
    P, Q = sigma**2 * np.eye(8), sigma**2 * np.eye(7)
    field = StereoFieldEstimate(coefficients[:8], P, 0.3, coefficients[8:], Q)
    return Estimate(0, np.eye(4), np.eye(6), stereo_field=field)


# The rig


@pytest.mark.parametrize("given", [RECTIFIED, _of_raw(RADTAN_RIG)], ids=["rectified", "raw"])
def test_rig_of_a_field_is_the_one_that_made_it(given: Rig) -> None:
    """Half a degree about each axis, principal point, focal lengths and distortion at once."""
    found = calibrated_rig(given, _estimate(_Frame.of(given).coefficients(OFF)))
    assert np.all(np.abs(found.parameters - OFF) < 2 * found.sigmas)
    assert np.all(found.sigmas < [*[1e-3] * 5, *[3e-4] * 2, *[1e-3] * 2, 1e-2, 1e-2, *[1e-3] * 3])
    true, frame = rig_off_by(given, OFF), _Frame.of(given)
    moved = frame.as_seen(found.parameters) - frame.as_seen(OFF)
    assert np.sqrt(np.mean(moved**2)) < 0.05
    assert found.left_px < 0.03
    assert (
        np.linalg.norm(so3_log(found.rig.T_cam1_cam0[:3, :3] @ true.T_cam1_cam0[:3, :3].T)) < 2e-3
    )


def test_a_turn_is_named_and_nothing_else() -> None:
    off = np.array([0, TURN, *[0.0] * 12])
    found = calibrated_rig(RECTIFIED, _estimate(_Frame.of(RECTIFIED).coefficients(off)))
    assert len(found.lines()) == 1
    assert found.lines()[0].startswith("right camera turned by +0.500 ± ")
    assert found.lines()[0].endswith(" deg about its vertical axis")


def test_a_turn_that_the_principal_point_takes_back_is_none() -> None:
    """As on KITTI: 1.15 deg of yaw against 14 px of principal point leave the image's centre
    where it is.
    """
    off = np.zeros(14)
    off[[PARAMETERS.index(name) for name in ("wy", "cu", "p2")]] = 0.02, -0.02, -5e-3
    found = calibrated_rig(RECTIFIED, _estimate(_Frame.of(RECTIFIED).coefficients(off)))
    assert abs(found.parameters[PARAMETERS.index("wy")]) > 0.01
    assert [line for line in found.lines() if "axis" in line or "principal" in line] == []
    assert any("p2" in line for line in found.lines())


def test_what_a_lens_model_cannot_express_is_said() -> None:
    """A Kannala-Brandt lens has no tangential distortion."""
    off = np.zeros(14)
    off[PARAMETERS.index("p2")] = 5e-3
    given = _of_raw(EQUIDISTANT_RIG)
    radtan = _of_raw(RADTAN_RIG)
    found = calibrated_rig(given, _estimate(_Frame.of(radtan).coefficients(off)))
    assert found.parameters[PARAMETERS.index("p2")] == 0.0
    assert found.left_px > 0.1
    estimate = _estimate(_Frame.of(radtan).coefficients(off))
    assert calibrated_rig(radtan, estimate).left_px < 0.02, "the other model expresses it"


@pytest.mark.parametrize("given", [RECTIFIED, _of_raw(RADTAN_RIG)], ids=["rectified", "raw"])
def test_baseline_and_focal_length_found_go_into_the_rig(given: Rig) -> None:
    """A pixel's ray comes nearer to the axis by the focal length's factor, whatever the lens."""
    scale = StereoScaleEstimate(np.log([1.03, 0.95]), np.diag([4e-6, 1e-6]))
    found = calibrated_rig(
        given, replace(_estimate(np.zeros(15)), stereo_field=None, stereo_scale=scale)
    )
    np.testing.assert_allclose(found.rig.T_cam1_cam0[:3, 3], 1.03 * given.T_cam1_cam0[:3, 3])
    np.testing.assert_array_equal(found.rig.T_cam1_cam0[:3, :3], given.T_cam1_cam0[:3, :3])
    rays = np.stack([*np.random.default_rng(0).uniform(-0.3, 0.3, (2, 50)), np.ones(50)], axis=1)
    for lens, before in ((found.rig.cam0, given.cam0), (found.rig.cam1, given.cam1)):
        np.testing.assert_allclose(
            project_point(lens, rays / [0.95, 0.95, 1.0])[0],
            project_point(before, rays)[0],
            atol=1e-9,
        )
    assert found.lines() == ("baseline off by +3.00 ± 0.20 %", "focal length off by -5.00 ± 0.10 %")


@pytest.mark.parametrize("levels", [1000.0, None], ids=["depths", "one camera"])
def test_what_was_found_of_one_camera_goes_into_its_rig(levels: float | None) -> None:
    """Extrinsics are those of the images as they are; depths are longer by both factors."""
    given = Rig(RADTAN_RIG.cam0, T_cam0_imu=np.eye(4), depth_factor=levels)
    T_cam0_imu = se3_exp(np.array([0.01, 0.02, -0.03, 0.01, -0.02, 0.005]))
    scale = StereoScaleEstimate(np.log([1.03, 0.95]), np.diag([4e-6, 1e-6]))
    estimate = Estimate(0, np.eye(4), np.eye(6), T_cam0_imu=T_cam0_imu, stereo_scale=scale)
    found = calibrated_rig(given, estimate).rig
    np.testing.assert_allclose(found.T_cam0_imu, T_cam0_imu)
    assert found.cam0.fu == pytest.approx(0.95 * given.cam0.fu)
    assert found.depth_factor == (levels and pytest.approx(levels / 1.03 / 0.95))


def test_without_an_estimate_the_rig_stays_as_given() -> None:
    found = calibrated_rig(RECTIFIED, Estimate(0, np.eye(4), np.eye(6)))
    assert found.rig is RECTIFIED
    assert found.lines() == ()


def test_estimated_extrinsics_and_clocks_go_into_the_raw_rig() -> None:
    given = replace(_of_raw(RADTAN_RIG), T_cam0_imu=np.eye(4), time_offset_s=0.01)
    T_rect0_imu = given.T_rect0_imu
    assert T_rect0_imu is not None
    estimate = Estimate(0, np.eye(4), np.eye(6), T_cam0_imu=T_rect0_imu, time_offset_s=0.002)
    rig = calibrated_rig(given, estimate).rig
    np.testing.assert_allclose(rig.T_cam0_imu, np.eye(4), atol=1e-12)
    assert rig.time_offset_s == pytest.approx(0.012)


# Pixels and images


def test_pixels_and_images_lose_the_field() -> None:
    camera, frame = RECTIFIED.camera, _Frame.of(RECTIFIED)
    field, grid = field_of(camera, OFF), frame.grid
    seen = frame.as_seen(OFF)
    seen[:, 3] += grid[:, 1] - seen[:, 1]  # the field takes the row of the left image
    error = field.without(seen, np.ones(len(seen), dtype=np.bool_)) - grid
    assert np.sqrt(np.mean(error[:, :3] ** 2)) < 0.2
    assert np.abs(field.at(grid)).max() > 5
    left_only = field.without(seen, np.zeros(len(seen), dtype=np.bool_))
    np.testing.assert_array_equal(left_only[:, 2:], seen[:, 2:])

    (u0, v0), (u1, v1) = field.maps()
    # shows its own pixels
    image = np.stack(np.meshgrid(np.arange(1242), np.arange(375)), axis=-1).astype(np.float32)
    warped = [cv2.remap(image, u, v, cv2.INTER_LINEAR) for u, v in ((u0, v0), (u1, v1))]
    inner = grid[(np.abs(grid[:, 0] - 621) < 500) & (np.abs(grid[:, 1] - 187) < 150)].astype(int)
    shown = np.concatenate(
        [warped[0][inner[:, 1], inner[:, 0]], warped[1][inner[:, 1], inner[:, 0]]], axis=1
    )
    back = field.without(shown.astype(np.float64), np.ones(len(shown), dtype=np.bool_))
    np.testing.assert_allclose(back[:, :3], inner[:, :3], atol=0.15)


# Runs in an exact world whose right camera is turned


@pytest.fixture(scope="module")
def turned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Observations of 3 s with the right camera yawed by half a degree."""
    course = Course(
        20, 3.0, velocity=(0.5, 0.3, 0.0), depth=(3.0, 12.0), pixel_sigma_px=0.15, features=100
    )
    rng = np.random.default_rng(0)
    seen = [course.observe(k, rng) for k in range(course.frames)]
    seen = [replace(o, z=_turned_right(o.z, CAMERA, np.array([0.0, TURN, 0.0]))) for o in seen]
    path = tmp_path_factory.mktemp("turned") / "log.npz"
    _write(path, CAMERA, seen)
    return path


def _write(path: Path, camera: StereoCamera, seen: list[Observations]) -> None:
    times = np.array([o.time_ns for o in seen])
    recording = Recording("made", Path("made"), camera, None, times, False, frozenset(), None, None)
    write_observation_log(path, recording, seen, [])


@pytest.fixture(scope="module")
def ran(turned: Path) -> Path:
    """Folder of the first run, with its calibration."""
    out = turned.parent / "first"
    assert (
        main(
            [
                "run",
                str(turned),
                "--save-calibration",
                "--save-observations",
                "--out",
                str(out),
                "--quiet",
            ]
        )
        == 0
    )
    return out


def test_the_next_run_from_a_saved_calibration_has_nothing_to_correct(
    turned: Path, ran: Path
) -> None:
    """Rows within 0.25 px, the field within three standard deviations of zero, right after the
    first run's file.
    """
    text = (ran / "camchain-imucam.yaml").read_text()
    angle, sigma = re.findall(
        r"# right camera turned by (\S+) ± (\S+) deg about its vertical axis", text
    )[0]
    assert abs(float(angle) - 0.5) < 2 * float(sigma) < 0.2
    rig = vio.load_rig(ran / "camchain-imucam.yaml")
    pair = rectified_cameras(rig.stereo)
    first = vio.open_dataset(turned)
    seen = []
    for k in range(60):
        o = first.observations(k)
        left, _ = rectify_pixels(rig.cam0, pair.R_rect_cam0, pair.camera, o.z[:, :2])
        right, _ = rectify_pixels(rig.cam1, pair.R_rect_cam1, pair.camera, o.z[:, 2:])
        seen.append(replace(o, z=np.concatenate([left, right], axis=1)))
    path = turned.parent / "second.npz"
    _write(path, pair.camera, seen)
    result = vio.run(vio.open_dataset(path), load_config(overrides=['msckf.calibrate_stereo="on"']))
    field = result.estimates[-1].stereo_field
    assert field.rows_rms_px < 0.25
    assert np.all(np.abs(field.coefficients) < 3 * np.sqrt(np.diag(field.covariance)))
    before = json.loads((ran / "metrics.json").read_text())["stereo_field"]
    assert before["rows_rms_px"] > 0.25
    assert abs(before["coefficients_px"][0]) > 10 * before["sigma_px"][0]
    assert not has_calibration_panel(result)


@pytest.mark.parametrize("residual_px", [0.0, 0.4])
def test_what_a_saved_calibration_leaves_widens_the_prior_of_the_lenses(
    tmp_path: Path, residual_px: float
) -> None:
    """Its rows agree, so that only the file can tell: a run that trusted it was worse than the
    one that wrote it.
    """
    rig = replace(RECTIFIED, residual_px=residual_px)
    file = tmp_path / "camchain-imucam.yaml"
    file.write_text(kalibr_text(rig))
    read = vio.load_rig(file)
    assert read.camera.residual_px == read.rectifier().camera.residual_px == residual_px
    course = Course(
        20, 0.3, velocity=(0.5, 0.3, 0.0), depth=(3.0, 12.0), pixel_sigma_px=0.1, features=60
    )
    rng, path = np.random.default_rng(0), tmp_path / "log.npz"
    _write(
        path,
        replace(CAMERA, residual_px=residual_px),
        [course.observe(k, rng) for k in range(course.frames)],
    )
    result = vio.run(vio.open_dataset(path), load_config())
    field = result.estimates[0].stereo_field
    sigma = np.sqrt(field.covariance[3, 3])
    assert sigma == pytest.approx(np.clip(3 * residual_px / CAMERA.fu, 5e-4, 2e-3), rel=0.2)
    file.write_text(kalibr_text(replace(rig, residual_px=-1.0)))
    with pytest.raises(CalibrationError, match="residual_px is -1; it must not be negative"):
        vio.load_rig(file)


def test_a_live_user_gets_the_calibrated_rig(turned: Path) -> None:
    dataset = vio.open_dataset(turned)
    odometry = vio.Odometry(CAMERA)
    with pytest.raises(DataError, match="before the first frame"):
        odometry.calibrated_rig()
    for k in range(20):
        o = dataset.observations(k)
        odometry.add_observations(o.time_ns, o.ids, o.z)
    found = odometry.calibrated_rig()
    assert abs(found.parameters[1] - TURN) < 2 * found.sigmas[1]
    assert found.rig.cam1.model == "radtan"
    assert kalibr_text(found.rig)
    sizeless = vio.Odometry(replace(CAMERA, width=None, height=None))
    sizeless.add_observations(o.time_ns, o.ids, o.z)
    with pytest.raises(DataError, match="width and height"):
        sizeless.calibrated_rig()


def test_picture_shows_a_calibration_that_moved(turned: Path) -> None:
    result = vio.run(vio.open_dataset(turned), load_config(), stop=20)
    assert has_calibration_panel(result)
    off = vio.run(
        vio.open_dataset(turned), load_config(overrides=['msckf.calibrate_stereo="off"']), stop=5
    )
    assert not has_calibration_panel(off)


def test_check_refine_and_export_take_the_calibration_of_the_run(
    ran: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The turn moves right rows by up to 1.4 px; tracks and images that later commands read are
    without it.
    """
    run = read_saved_run(ran)
    rows = [t.z[t.has_right] @ [0, -1, 0, 1] for t in (run.dataset.tracks, run.tracked.tracks)]
    before, after = (float(np.sqrt(np.mean(r**2))) for r in rows)
    assert before > 0.5
    assert after == pytest.approx(0.15 * np.sqrt(2), rel=0.1)  # noise alone
    (_, v0), (_, v1) = run.field.maps()
    assert np.abs(v1 - v0).max() > 1.0

    class Images:
        """The recording of the run, with black images but for a row of white."""

        recording = replace(run.dataset.recording, has_images=True)

        def events(self, start: int, stop: int) -> list[object]:
            image = np.zeros((480, 752), dtype=np.uint8)
            image[20] = 255
            return [vio.records.StereoFrame(start, 0, image, image)]

    monkeypatch.setattr("vio.offline.run_images.open_dataset", lambda source, options: Images())
    (frame,) = run.images.frames(run.tracked.frames[np.array([3])])
    assert abs(int(np.argmax(frame.right[:, 20])) - int(np.argmax(frame.left[:, 20]))) >= 1


def test_metrics_of_earlier_runs_have_no_field(ran: Path, tmp_path: Path) -> None:
    metrics = json.loads((ran / "metrics.json").read_text())
    for name in ("observations.npz", "trajectory.tum"):
        (tmp_path / name).write_bytes((ran / name).read_bytes())
    (tmp_path / "metrics.json").write_text(
        json.dumps({**metrics, "stereo_field": {"rows_rms_px": 0.3}})
    )
    assert read_saved_run(tmp_path).field is None
    damaged = {**metrics["stereo_field"], "rows_px": [1.0, 2.0]}
    (tmp_path / "metrics.json").write_text(json.dumps({**metrics, "stereo_field": damaged}))
    with pytest.raises(DataError, match="holds no 15 finite numbers; repeat the run"):
        read_saved_run(tmp_path)


@pytest.mark.parametrize(
    ("name", "message"),
    [("rig.txt", "ends in .yaml"), ("missing/rig.yaml", "its folder does not exist")],
)
def test_a_file_that_cannot_be_written_is_refused_before_the_run(
    name: str, message: str, turned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert message in refused(
        capsys, "run", turned, "--save-calibration", tmp_path / name, "--out", out
    )
    assert not out.exists()


def test_features_without_an_image_size_have_no_calibration_to_save(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    course, rng = Course(20, 0.2), np.random.default_rng(0)
    sizeless = replace(CAMERA, width=None, height=None)
    _write(tmp_path / "log.npz", sizeless, [course.observe(k, rng) for k in range(4)])
    assert (
        main(
            ["run", str(tmp_path / "log.npz"), "--save-calibration", "--out", str(tmp_path / "out")]
        )
        == 1
    )
    assert (
        "states no image size, which a calibration needs; leave --save-calibration out"
        in capsys.readouterr().err
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("bend", [-0.5, -1.0])
def test_a_field_that_no_rig_has_is_refused(bend: float) -> None:
    """Half or all of a radian over the image: the fit leaves the possible rigs, or misses the
    field by 1e5 px.
    """
    field = np.array([0.0] * 4 + [bend] + [0.0] * 10)
    with pytest.raises(
        CalibrationError,
        match=r"^made: no rig .* \(rows by 0\.30 px rms\); .* calibrate the cameras",
    ):
        estimated_rig(RECTIFIED, _estimate(field), CAMERA, "made")


def test_results_are_written_where_no_rig_has_the_field_that_was_found(
    ran: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def without_rig(*_: object) -> None:
        raise CalibrationError(
            "focal lengths and image size must be positive, got fu=-4e10, fv=-4e11, 752x480"
        )

    monkeypatch.setattr("vio.calibration.stereo_field._with_field", without_rig)
    out = tmp_path / "out"
    arguments = [
        "run",
        str(ran / "observations.npz"),
        "--stop",
        "20",
        "--save-calibration",
        "--out",
        str(out),
    ]
    assert main([*arguments, "--quiet"]) == 1
    assert "no calibration was saved, all other results were" in capsys.readouterr().err
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["complete"]
    assert metrics["stereo_field"]["rows_rms_px"] > 0.2
    assert metrics["stereo_field"]["rig"] is None
    assert not (out / "camchain-imucam.yaml").exists()


def test_a_run_on_a_calibration_that_another_run_saved_has_nothing_beyond_doubt() -> None:
    """A saved rig holds a field to what its fit allows: 0.07 px at this focal length, which the
    filter's own standard deviation, of 0.01 px, does not know.
    """
    found = StereoFieldEstimate(np.array([-1e-4, *[0.0] * 7]), 1e-10 * np.eye(8))
    off, sigma = disparity_off(found)
    error = StereoError(0.03, 14.0, 707 * off, 707 * sigma)
    assert error.disparity_px == pytest.approx(0.07, abs=0.01)
    assert error.grade == "negligible"


def test_pixel_field_of_an_estimate_without_rows_has_none() -> None:
    field = DisplacementField.of(
        CAMERA, StereoFieldEstimate(np.array([1e-3, *[0.0] * 7]), np.eye(8))
    )
    moved = field.at(np.array([[300.0, 100.0, 290.0, 100.0]]))
    np.testing.assert_allclose(moved, [[0, 0, 1e-3 * CAMERA.fu, 0]], atol=1e-12)


@pytest.mark.parametrize("k", [-1e3, 1e3])
def test_a_step_of_the_fit_beyond_all_cameras_leads_to_no_rig(k: float) -> None:
    """Raw images of a compressed recording under the calibration of rectified ones ended a run with
    an OverflowError.
    """
    off = np.zeros(len(PARAMETERS))
    off[PARAMETERS.index("k")] = k
    with pytest.raises(CalibrationError, match="focal lengths are off"):
        rig_off_by(RECTIFIED, off)
