"""One camera: with an IMU, whose scale must become observable first, and with depth images."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import vio
from tests.filters.test_msckf import CAMERA, STEP_NS, T_CAM0_IMU, Flight
from tests.frontend.test_frontend_scene import CAMERA as WALL_CAMERA
from tests.frontend.test_frontend_scene import SLANTED
from tests.same_events import frames_of
from tests.true_world import TrueWorld
from vio.cameras.rig import Rig, with_virtual_baseline
from vio.config import Config
from vio.datasets import DatasetSettings, open_dataset
from vio.datasets.rigs.kalibr import kalibr_text
from vio.errors import CalibrationError, ConfigError, DataError
from vio.evaluation.consistency import nees_bounds
from vio.filters import mono_start
from vio.filters.alignment import Bearings, FreeMotion, align_visual_inertial, gyro_bias
from vio.filters.mono_msckf import MonoMsckf, _for_one_camera
from vio.filters.settings import MsckfSettings
from vio.frontend import FrontendSettings, build_frontend
from vio.frontend.one_camera import disparities
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse, so3_exp, transform_points
from vio.geometry.stereo import StereoCamera, left_alone, left_rays, one_camera
from vio.live.build import build_backend
from vio.records import ImuSample, Observations, StereoFrame

LEFT = left_alone(CAMERA)
SETTINGS = MsckfSettings()
PIXEL = 0.3


class Path3(Flight):
    """A flight with its motion given by a function of time, for what can and cannot be observed."""

    def __init__(self, frames: int, kind: str) -> None:
        super().__init__(frames)
        self.kind = kind

    def state(self, t: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """R, p, v, a, omega (body) at a time."""
        if self.kind == "curve":
            return super().state(t)
        if self.kind == "coasting":
            R, p, v, a, omega = super().state(min(t, 2.0))
            return R, p + v * max(t - 2.0, 0.0), v, a * float(t < 2.0), omega * float(t < 2.0)
        zero = np.zeros(3)
        if self.kind == "steady":
            v = np.array([0.2, 0.8, 0.1])
            return np.eye(3), v * t, v, zero, zero
        s = max(t - 1.0, 0.0)  # a take-off after a second at rest
        w = np.array([1.1, 1.5, 1.3])
        size = np.array([0.8, 1.0, 0.5])
        ramp, ramp_v, ramp_a = (
            s**2 / (1 + s**2),
            2 * s / (1 + s**2) ** 2,
            (2 - 6 * s**2) / (1 + s**2) ** 3,
        )
        wave, wave_v, wave_a = np.sin(w * s), w * np.cos(w * s), -(w**2) * np.sin(w * s)
        p = size * ramp * wave
        v = size * (ramp_v * wave + ramp * wave_v)
        a = size * (ramp_a * wave + 2 * ramp_v * wave_v + ramp * wave_a) * float(s > 0)
        return np.eye(3), p, v, a, zero


class Flown:
    """A filter's way through a flight: when it began, and its errors from there."""

    def __init__(self, flight: Flight, seed: int) -> None:
        rng = np.random.default_rng(seed)
        bias = np.concatenate([rng.normal(0, 0.05, 3), rng.normal(0, 0.15, 3)])
        self.filter = MonoMsckf(LEFT, T_CAM0_IMU, SETTINGS)
        samples = flight.imu(rng, bias)
        self.begun: int | None = None
        world = TrueWorld(self.filter, upright=True)
        rows: list[list[float]] = []
        for k in range(flight.frames):
            while samples and samples[0].time_ns <= k * STEP_NS:
                self.filter.propagate(samples.pop(0))
            if not self.filter.update(_left_only(flight.observe(k, PIXEL, rng, 80))).started:
                continue
            estimate = self.filter.estimate()
            R, p, v, *_ = flight.state(k * 0.05)
            if self.begun is None:
                self.begun = k
            T = world.meet(k, se3_from_parts(R, p))
            off_v = world.T[:3, :3].T @ v - estimate.velocity_world
            off_p = T[:3, :3].T @ (p - T[:3, 3])
            C = estimate.covariance[:3, :3] + 1e-12 * np.eye(3)
            rows.append(
                [
                    float(off_p @ np.linalg.solve(C, off_p)),
                    float(off_v @ np.linalg.solve(estimate.velocity_covariance, off_v)),
                    float(np.linalg.norm(off_p)),
                    np.nan if estimate.scale_sigma is None else estimate.scale_sigma,
                    float(np.sqrt(np.linalg.eigvalsh(C)[-1])),
                ]
            )
        # (N, 5) NEES of position and of velocity, error of position, sigma of the scale, largest
        # sigma of the position
        self.rows = np.array(rows)


def _left_only(seen: Observations) -> Observations:
    return replace(seen, has_right=np.zeros(len(seen), dtype=np.bool_))


@cache
def _curves() -> tuple[Flown, ...]:
    return tuple(Flown(Path3(50, "curve"), seed) for seed in range(3))


# --- the start
# --------------------------------------------------------------------------------------------------


def test_start_in_motion_waits_and_is_as_good_as_it_says() -> None:
    """No pose before the scale is known to 10 %; then velocities are within their covariance,
    over all seeds.
    """
    for flown in _curves():
        assert 10 <= flown.begun <= 35
        start = flown.filter._begun
        assert 0.005 < start.scale_sigma <= 0.1
    first = [flown.rows[0, 1] for flown in _curves()]
    assert np.mean(first) < nees_bounds(3, len(first))[1]


def test_flight_after_the_start_is_consistent() -> None:
    """Position and velocity, whose scale the IMU alone gives, agree with their covariance at the
    end of the flights.
    """
    last = np.array([flown.rows[-1] for flown in _curves()])
    assert np.all(last[:, :2].mean(axis=0) < nees_bounds(3, len(last))[1])
    assert np.all(last[:, 2] < 0.15)
    assert np.all(last[:, 3] < 0.1)


class Turning(Path3):
    """The same flight, but all that is seen turns about a vertical axis."""

    rate_radps = 0.5

    def observe(
        self, k: int, sigma: float, noise: np.random.Generator, limit: int = 60
    ) -> Observations:
        still, centre = self.points, self.points.mean(axis=0)
        self.points = centre + (still - centre) @ so3_exp([0.0, 0.0, self.rate_radps * 0.05 * k]).T
        seen = super().observe(k, sigma, noise, limit)
        self.points = still
        return seen


def test_features_that_contradict_the_imu_start_nothing() -> None:
    """They fit each other and some motion, but one that the gyro's bias cannot explain: the
    start would be wrong.
    """
    flown = Flown(Turning(40, "curve"), 0)
    assert flown.begun is None
    assert "features and IMU contradict each other" in str(flown.filter.initialisation.waits_for)


def test_a_contradiction_that_stays_is_taken_with_what_it_costs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A clock that is off contradicts for good: the start comes, and says how little is known."""
    monkeypatch.setattr(mono_start, "_GRAVITY", mono_start._GRAVITY._replace(patience_s=0.4))
    monkeypatch.setattr(Turning, "rate_radps", 0.45)
    flown = Flown(Turning(50, "curve"), 0)
    start, squared = flown.filter._begun, flown.rows[0, 1]
    monkeypatch.setattr(mono_start, "_disagreement", lambda *_: 0.0)
    sure = Flown(Turning(50, "curve"), 0)
    assert sure.filter._begun.scale_sigma < start.scale_sigma <= 0.1
    assert squared < 0.5 * sure.rows[0, 1]


def test_a_contradiction_that_costs_too_much_starts_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(mono_start, "_GRAVITY", mono_start._GRAVITY._replace(patience_s=0.4))
    flown = Flown(Turning(50, "curve"), 0)
    assert flown.begun is None
    assert "the scale is known to" in str(flown.filter.initialisation.waits_for)


def test_tracks_on_a_moving_object_are_left_out_of_the_start() -> None:
    """A quarter of the features drifts sideways; the others begin as they would without."""

    class Passed(Path3):
        def observe(
            self, k: int, sigma: float, noise: np.random.Generator, limit: int = 60
        ) -> Observations:
            seen = super().observe(k, sigma, noise, limit)
            z = seen.z.copy()
            z[seen.ids % 4 == 0, ::2] += 1.5 * k
            return replace(seen, z=z)

    flown = Flown(Passed(40, "curve"), 0)
    assert flown.begun is not None
    assert flown.rows[0, 1] < nees_bounds(3, 1)[1]


def test_steady_flight_never_begins_as_nothing_shows_its_scale() -> None:
    flown = Flown(Path3(35, "steady"), 0)
    assert flown.begun is None
    assert flown.filter.initialisation.waits_for


def test_steady_flight_tells_nothing_more_of_the_scale() -> None:
    """The scale stays as uncertain as it was where the acceleration ended; the position becomes
    so with the path.
    """
    flown = Flown(Path3(75, "coasting"), 2)
    # the window holds no acceleration in either
    early, last = flown.rows[62 - flown.begun], flown.rows[-1]
    assert last[3] > 0.9 * early[3]
    assert last[4] > 1.1 * early[4]


def test_start_at_standstill_knows_the_velocity_and_finds_the_scale_in_flight() -> None:
    flown = Flown(Path3(70, "take-off"), 1)
    assert flown.begun <= 12
    start = flown.filter._begun
    assert start.scale_sigma is None
    assert np.sqrt(start.P.diagonal()[6:9].max()) < 0.05
    assert flown.rows[-1, 2] < 0.1
    assert flown.rows[-1, 0] < 30
    assert flown.rows[-1, 3] < 0.1


def test_linear_alignment_is_exact_without_noise() -> None:
    rng = np.random.default_rng(0)
    t = np.linspace(0, 1, 9)
    v, g = np.array([0.5, -0.3, 0.2]), 9.81 * np.array([0.1, -0.2, -np.sqrt(0.95)])
    moves = np.stack([0.3 * t**3, -0.8 * t**2 + 0.5 * t**4, 0.2 * t**3], axis=1)
    true_bias = np.array([0.03, -0.02, 0.05])
    R = so3_exp(np.stack([0.3 * t, -0.2 * t**2, 0.1 * np.sin(t)], axis=1))
    camera = np.array([0.1, 0.02, -0.05])
    centres = v * t[:, None] + 0.5 * g * t[:, None] ** 2 + moves + R @ camera
    points = rng.uniform([-3, -3, 2], [3, 3, 8], (40, 3))
    rays = np.einsum("kji,fkj->fki", R, points[:, None] - centres)
    rays = rays / np.linalg.norm(rays, axis=2, keepdims=True)
    bearings = Bearings(rays, np.ones((40, 9), dtype=np.bool_), camera)
    phi_D_bias = -t[:, None, None] * np.eye(3)  # to first order
    turned = so3_exp(np.einsum("kij,j->ki", -phi_D_bias, 1e-3 * true_bias)) @ R
    found = gyro_bias(bearings, FreeMotion(t, turned, moves, phi_D_bias), 0.1)
    np.testing.assert_allclose(found, 1e-3 * true_bias, atol=2e-6)
    aligned = align_visual_inertial(bearings, FreeMotion(t, R, moves, phi_D_bias), 9.81)
    np.testing.assert_allclose(aligned.velocity, v, atol=1e-6)
    np.testing.assert_allclose(aligned.gravity, g, atol=1e-6)


def test_one_camera_without_imu_is_refused() -> None:
    with pytest.raises(ConfigError, match="no scale"):
        build_backend(LEFT, np.eye(4), Config(), None)
    with pytest.raises(ConfigError, match="stereo pair"):
        build_backend(LEFT, T_CAM0_IMU, Config(backend="vislam"), "imu")


# --- the front end
# --------------------------------------------------------------------------------------------------


def _pose(k: int) -> FloatArray:
    return se3_from_parts(so3_exp([0.0, 0.01 * k, 0.0]), [0.05 * k, 0.0, 0.02 * k])


def _wall(k: int, camera: object = WALL_CAMERA) -> tuple[np.ndarray, FloatArray]:
    """Image and depths of a slanted wall at a pose."""
    u, v = np.meshgrid(np.arange(480.0), np.arange(300.0))
    p = SLANTED.hit(_pose(k), np.stack([u, v], axis=-1))
    image = np.clip(SLANTED.paint(p), 0, 255).astype(np.uint8)
    depth = transform_points(se3_inverse(_pose(k)), p.reshape(-1, 3))[:, 2].reshape(300, 480)
    return image, depth


@cache
def _walls() -> tuple[tuple[np.ndarray, FloatArray], ...]:
    return tuple(_wall(k) for k in range(4))


@pytest.mark.parametrize("name", ["klt", "orb", "sift"])
def test_front_end_tracks_one_camera_without_a_right_image(name: str) -> None:
    camera = left_alone(WALL_CAMERA)
    frontend = build_frontend(name, camera, FrontendSettings())
    seen = [
        frontend.process(StereoFrame(k, k * STEP_NS, _walls()[k][0], None)).observations
        for k in range(4)
    ]
    assert not any(s.has_right.any() for s in seen)
    common, a, b = np.intersect1d(seen[1].ids, seen[3].ids, return_indices=True)
    assert len(common) > 60
    p = SLANTED.hit(_pose(1), seen[1].z[a, :2])
    p = transform_points(se3_inverse(_pose(3)), p)
    true = p[:, :2] / p[:, 2:] * 300.0 + [239.5, 149.5]
    assert np.median(np.linalg.norm(seen[3].z[b, :2] - true, axis=1)) < 0.15


@pytest.mark.parametrize("name", ["klt", "orb", "sift"])
def test_depth_images_give_right_pixels_and_holes_give_left_only_tracks(name: str) -> None:
    camera = with_virtual_baseline(one_camera(300.0, 300.0, 239.5, 149.5, 480, 300), 1.5e-3)
    frontend = build_frontend(name, camera, FrontendSettings())
    seen = None
    for k in range(3):
        image, depth = _walls()[k]
        holes = depth.copy()
        holes[:, :150] = 0.0
        seen = frontend.process(StereoFrame(k, k * STEP_NS, image, None, holes)).observations
    inside, hole = seen.z[:, 0] > 151, seen.z[:, 0] < 149
    assert seen.has_right[inside].mean() > 0.95
    assert not seen.has_right[hole].any()
    assert hole.sum() > 10
    depth = camera.fu * camera.baseline_m / (seen.z[inside, 0] - seen.z[inside, 2])
    p = SLANTED.hit(_pose(2), seen.z[inside, :2])
    np.testing.assert_allclose(depth, transform_points(se3_inverse(_pose(2)), p)[:, 2], rtol=1e-6)


def test_depths_across_an_outline_are_not_used() -> None:
    camera = with_virtual_baseline(one_camera(300.0, 300.0, 9.5, 9.5, 20, 20), 1.5e-3)
    depth = np.full((20, 20), 2.0)
    depth[:, 10:] = 4.0
    d, known = disparities(
        camera, np.array([[5.3, 5.7], [9.5, 5.0], [14.2, 3.0], [25.0, 3.0]]), depth
    )
    assert known.tolist() == [True, False, True, False]
    np.testing.assert_allclose(d[[0, 2]], camera.fu * camera.baseline_m / np.array([2.0, 4.0]))


@pytest.mark.parametrize("depth_m", [0.8, 5.0])
def test_virtual_baseline_makes_the_noise_of_depths_that_of_disparities(depth_m: float) -> None:
    """`sigma_z = k z^2` is one standard deviation of the disparity, whatever the depth: sqrt(2)
    of a pixel's 0.2 px.
    """
    camera = with_virtual_baseline(one_camera(500.0, 500.0, 320.0, 240.0), 1.5e-3)
    d = camera.fu * camera.baseline_m / np.array([depth_m, depth_m + 1e-4])
    sigma_px = abs(d[1] - d[0]) / 1e-4 * 1.5e-3 * depth_m**2
    assert sigma_px == pytest.approx(0.2 * np.sqrt(2), rel=1e-3)


# --- recordings
# --------------------------------------------------------------------------------------------------

RIG = Rig(
    CameraModel(300.0, 300.0, 239.5, 149.5, 480, 300), T_cam0_imu=np.eye(4), depth_factor=1000.0
)


def _mono_folder(folder: Path) -> Path:
    (folder / "left").mkdir(parents=True)
    for k in range(4):
        cv2.imwrite(str(folder / "left" / f"{k}.png"), _walls()[k][0])
    (folder / "times.txt").write_text("\n".join(f"{k * 0.05:.2f}" for k in range(4)))
    (folder / "calibration.yaml").write_text(kalibr_text(RIG))
    rows = [f"{int(k * 5e6)},0,0,0,0,0,9.81" for k in range(60)]
    header = "#timestamp [ns],w_x [rad s^-1],w_y,w_z,a_x [m s^-2],a_y,a_z"
    (folder / "imu.csv").write_text("\n".join([header, *rows]))
    return folder


def _depth_png(k: int) -> np.ndarray:
    return np.rint(_walls()[k][1] * 1000).astype(np.uint16)


def test_folder_of_one_camera_and_imu_is_read(tmp_path: Path) -> None:
    dataset = open_dataset(_mono_folder(tmp_path))
    recording = dataset.recording
    assert (recording.kind, recording.camera.kind, recording.motion) == ("mono", "mono", {"imu"})
    frames = frames_of(dataset)
    assert all(f.right is None and f.depth is None for f in frames)
    np.testing.assert_array_equal(frames[2].left, _walls()[2][0])
    assert sum(isinstance(e, ImuSample) for e in dataset.events()) > 20


def test_folder_with_depth_images_is_read_in_metres(tmp_path: Path) -> None:
    folder = _mono_folder(tmp_path)
    (folder / "depth").mkdir()
    for k in range(4):
        cv2.imwrite(str(folder / "depth" / f"{k}.png"), _depth_png(k))
    dataset = open_dataset(folder)
    assert (dataset.recording.kind, dataset.recording.camera.kind) == ("rgbd", "rgbd")
    assert not any("depth_factor" in note for note in dataset.recording.notes)
    other = open_dataset(folder, DatasetSettings(depth_factor=2000.0))
    assert any(
        "depth_factor 2000 takes the place of the calibration's 1000" in n
        for n in other.recording.notes
    )
    frame = next(e for e in dataset.events() if isinstance(e, StereoFrame))
    np.testing.assert_allclose(frame.depth, _walls()[0][1], atol=6e-4)
    (folder / "calibration.yaml").write_text(kalibr_text(replace(RIG, depth_factor=None)))
    with pytest.raises(CalibrationError, match="depth_factor"):
        open_dataset(folder)


def _tum_folder(folder: Path) -> Path:
    lists: dict[str, list[str]] = {"rgb": ["# color images"], "depth": ["# depth maps"]}
    for name, late in (("rgb", 0.0), ("depth", 0.007)):
        (folder / name).mkdir(parents=True)
        for k in range(4):
            if name == "depth" and k == 2:
                continue
            image = _walls()[k][0] if name == "rgb" else _depth_png(k) * 5
            stamp = f"{1305031102 + 0.1 * k + late:.6f}"
            cv2.imwrite(str(folder / name / f"{stamp}.png"), image)
            lists[name].append(f"{stamp} {name}/{stamp}.png")
        (folder / f"{name}.txt").write_text("\n".join(lists[name]) + "\n")
    return folder


def test_tum_rgbd_is_associated_by_stamps_and_its_camera_is_known(tmp_path: Path) -> None:
    dataset = open_dataset(_tum_folder(tmp_path / "rgbd_dataset_freiburg3_desk"))
    recording = dataset.recording
    assert (recording.kind, len(recording.frame_times_ns)) == ("rgbd", 3)
    assert recording.camera.fu == 535.4
    notes = " ".join(recording.notes)
    assert "1 images have no depth" in notes
    assert "freiburg3" in notes
    frame = next(e for e in dataset.events() if isinstance(e, StereoFrame))
    np.testing.assert_allclose(frame.depth, _walls()[0][1], atol=6e-4)


@pytest.mark.parametrize(
    ("name", "calibration", "focal", "word"),
    [
        ("table_3", "241.2 242.3 239.5 149.5", 241.2, None),
        ("table_3", "# K\n241.2 0 239.5\n0 242.3 149.5\n0 0 1", 241.2, None),
        ("rgbd_bonn_balloon", "", 542.822841, "Bonn's"),
        ("living_room_traj0_frei_png", "", 481.2, "ICL-NUIM's"),
        ("kitchen", "", 525.0, "doubtful: no calibration"),
    ],
)
def test_rgbd_folder_has_its_own_calibration_or_the_published_one(
    name: str, calibration: str, focal: float, word: str | None, tmp_path: Path
) -> None:
    folder = _tum_folder(tmp_path / name)
    if calibration:
        (folder / "calibration.txt").write_text(calibration + "\n")
    recording = open_dataset(folder).recording
    assert recording.camera.fu == pytest.approx(focal, rel=0.2 if "bonn" in name else 1e-9)
    notes = " ".join(recording.notes)
    assert "not used: calibration.txt" not in notes
    assert word is None or word in notes
    assert (word is None) == ("no calibration" not in notes)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: (f / "depth.txt").write_text("# nothing\n"), "holds no line of data"),
        (lambda f: (f / "depth.txt").write_text("9.0 depth/a.png\n"), "one clock"),
        (
            lambda f: [
                cv2.imwrite(str(p), np.zeros((300, 480), np.uint8)) for p in (f / "depth").iterdir()
            ],
            "16 bits",
        ),
        (
            lambda f: [
                cv2.imwrite(str(p), np.ones((30, 48), np.uint16)) for p in (f / "depth").iterdir()
            ],
            "registered",
        ),
    ],
)
def test_wrong_depth_recordings_are_refused(tmp_path: Path, spoil: object, message: str) -> None:
    folder = _tum_folder(tmp_path / "rgbd")
    spoil(folder)  # type: ignore[operator]
    with pytest.raises(DataError, match=message):
        list(open_dataset(folder).events())


def test_euroc_folder_with_cam0_alone_is_one_camera(tmp_path: Path) -> None:
    cam = tmp_path / "mav0" / "cam0"
    (cam / "data").mkdir(parents=True)
    for k in range(3):
        cv2.imwrite(
            str(cam / "data" / f"{1403636579763555584 + k * 50_000_000}.png"), _walls()[k][0]
        )
    (cam / "sensor.yaml").write_text(
        "camera_model: pinhole\nintrinsics: [300, 300, 239.5, 149.5]\nresolution: [480, 300]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [-0.1, 0.01, 0, 0]\n"
        "T_BS:\n  cols: 4\n  rows: 4\n  data: [1,0,0,0.1, 0,1,0,0, 0,0,1,0, 0,0,0,1]\n"
    )
    (cam / "data.csv").write_text("#timestamp [ns],filename\n")
    dataset = open_dataset(tmp_path)
    assert dataset.recording.camera.kind == "mono"
    assert len(list(dataset.events())) == 3
    assert not any("data.csv" in note for note in dataset.recording.notes), (
        "the names of the images say the same"
    )
    (cam / "data.csv").write_text("#timestamp [ns],filename\n" + "1,a.png\n" * 5)
    assert any(
        "data.csv lists 5 images; the 3 that are there are used" in n
        for n in open_dataset(tmp_path).recording.notes
    )


def test_left_camera_of_a_pair_has_no_right_side(tmp_path: Path) -> None:
    folder = _mono_folder(tmp_path)
    alone = open_dataset(folder, DatasetSettings(camera="left"))
    assert "there is one camera only: --camera left changes nothing" in alone.recording.notes
    assert len(list(alone.events())) == len(list(open_dataset(folder).events()))
    (folder / "right").mkdir()
    for k in range(4):
        cv2.imwrite(str(folder / "right" / f"{k}.png"), _walls()[k][0])
    os.remove(folder / "calibration.yaml")
    P = "300 0 239.5 0 0 300 149.5 0 0 0 1 0"
    (folder / "calib.txt").write_text(f"P0: {P}\nP1: {P.replace('239.5 0', '239.5 -60', 1)}\n")
    (folder / "imu.csv").unlink()
    dataset = open_dataset(folder, DatasetSettings(camera="left"))
    assert dataset.recording.camera.kind == "mono"
    assert all(e.right is None for e in dataset.events() if isinstance(e, StereoFrame))


@pytest.mark.parametrize(
    "command",
    [
        ["calibrate"],
        ["convert", "--to", "euroc", "--out", "x"],
        ["run", "--save-calibration", "--out", "x"],
    ],
)
def test_commands_for_pairs_say_so_in_one_line(
    tmp_path: Path,
    command: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from vio.cli import main

    folder = _mono_folder(tmp_path / "r")
    monkeypatch.chdir(tmp_path)
    assert main([command[0], str(folder), *command[1:]]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error")]
    assert len(lines) == 1
    assert "needs a stereo pair" in lines[0]


def test_the_calibration_of_one_camera_needs_its_rig() -> None:
    camera = StereoCamera(300.0, 300.0, 79.5, 59.5, 0.1, 160, 120, kind="rgbd")
    with vio.Odometry(camera, vio.load_config(overrides=["motion=none"])) as odometry:
        image = np.random.default_rng(0).integers(0, 255, (120, 160), dtype=np.uint8)
        odometry.add_images(0, image, None, depth_m=np.full((120, 160), 2.0, np.float32))
        with pytest.raises(DataError, match="give Odometry its rig"):
            odometry.calibrated_rig()


def test_a_start_that_fails_is_explained_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    from vio.cli import main

    assert main(["run", str(_mono_folder(tmp_path / "r")), "--out", str(tmp_path / "out")]) == 1
    lines = [*caplog.messages, *capsys.readouterr().err.splitlines()]
    assert sum("frames have no pose; there are 0.15 s of frames" in line for line in lines) == 1
    assert sum("4 frames has a pose; see the warnings above" in line for line in lines) == 1


def test_an_accelerometer_in_g_is_named_before_the_start_that_it_prevents(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    from vio.cli import main

    folder = _mono_folder(tmp_path / "r")
    (folder / "times.txt").write_text("\n".join(f"{0.5 * k:.2f}" for k in range(4)))
    rng = np.random.default_rng(0)
    rows = [
        f"{int(k * 5e6)},{a[0]},{a[1]},{a[2]},{a[3]},{a[4]},{1 + a[5]}"
        for k in range(320)
        for a in [_shake(rng)]
    ]
    (folder / "imu.csv").write_text("\n".join(["#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z", *rows]))
    assert main(["run", str(folder), "--out", str(tmp_path / "out")]) == 1
    lines = [m for m in caplog.messages if "accelerometer" in m or "no pose" in m]
    assert "the IMU is in doubt: the accelerometer's median magnitude" in lines[0]
    assert "in g: multiply by 9.81" in lines[1]
    assert "have no pose; correct the fault of the IMU" in lines[2]


def _shake(rng: np.random.Generator) -> FloatArray:
    """Readings of a hand that moves: gyro in rad/s and accelerometer in g, without gravity."""
    return rng.normal(0, [0.2, 0.2, 0.2, 0.02, 0.02, 0.02])


def _inspected(folder: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any]]:
    from vio.cli import main

    status = main(["inspect", str(folder), "--frames", "3", "--json"])
    return status, json.loads(capsys.readouterr().out)


def test_inspect_shows_one_camera(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = _mono_folder(tmp_path / "r")
    status, report = _inspected(folder, capsys)
    assert (status, report["kind"], report["faults"]) == (0, "mono", [])
    parts = report["parts"]
    assert parts["camera"]["kind"] == "mono"
    assert "baseline_m" not in parts["camera"]
    assert len(parts["images"]["mean"]) == 1
    assert "stereo" not in parts
    assert parts["tracking"]["tracked_median"] > 40
    (folder / "imu.csv").unlink()
    status, report = _inspected(folder, capsys)
    assert status == 1
    assert report["faults"] == [
        "missing: one camera alone knows no scale: add an IMU (imu.csv and T_cam0_imu), depth "
        "images or a second camera"
    ]


def test_inspect_shows_depth_images_and_a_wrong_unit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = _mono_folder(tmp_path / "r")
    (folder / "depth").mkdir()
    for k in range(4):
        cv2.imwrite(str(folder / "depth" / f"{k}.png"), _depth_png(k))
    (folder / "imu.csv").unlink()
    status, report = _inspected(folder, capsys)
    assert (status, report["kind"], report["faults"]) == (0, "rgbd", [])
    true = np.median(_walls()[0][1])
    assert report["parts"]["depth"]["median_m"] == pytest.approx(true, rel=0.1)
    assert report["parts"]["tracking"]["matched_median"] > 40
    (folder / "calibration.yaml").write_text(kalibr_text(replace(RIG, depth_factor=1.0)))
    status, report = _inspected(folder, capsys)
    assert status == 1
    assert "check depth_factor" in report["faults"][0]


# --- live
# --------------------------------------------------------------------------------------------------


def test_odometry_takes_single_images_and_depths() -> None:
    odometry = vio.Odometry(replace(RIG, T_cam0_imu=None))
    for k in range(4):
        image, depth = _walls()[k]
        estimate = odometry.add_images(k * STEP_NS, image, depth_m=depth)
    expected = se3_inverse(_pose(0)) @ _pose(3)
    np.testing.assert_allclose(estimate.T_world_imu[:3, 3], expected[:3, 3], atol=3e-3)
    with pytest.raises(
        DataError, match="one image came, but this rig takes an image with its depth_m"
    ):
        odometry.add_images(10 * STEP_NS, _walls()[0][0])
    with pytest.raises(DataError, match="two images came"):
        odometry.add_stereo(10 * STEP_NS, _walls()[0][0], _walls()[0][0])


def test_odometry_of_a_pair_refuses_one_image() -> None:
    odometry = vio.Odometry(Rig.rectified(300.0, 300.0, 239.5, 149.5, 0.2, 480, 300))
    with pytest.raises(DataError, match="one image came, but this rig takes two"):
        odometry.add_images(0, _walls()[0][0])
    with pytest.raises(DataError, match=r"the left image is None, as OpenCV's imread"):
        odometry.add_stereo(0, None, None)


def test_odometry_of_one_camera_waits_for_the_scale() -> None:
    odometry = vio.Odometry(replace(RIG, depth_factor=None))
    for k in range(4):
        odometry.add_imu(k * STEP_NS, np.zeros(3), np.array([0.0, 0.0, 9.81]))
        assert odometry.add_images(k * STEP_NS, _walls()[k][0]) is None
    odometry.finish()
    assert odometry.estimate is None
    assert "no pose" in odometry.warnings[-1]


def test_rays_of_one_camera_are_those_of_its_pair() -> None:
    np.testing.assert_array_equal(left_rays(LEFT, [[1.0, 2.0]]), left_rays(CAMERA, [[1.0, 2.0]]))


def test_a_filter_that_waits_to_begin_again_keeps_its_points() -> None:
    """A run that ends there ended in an error, and all of its results were lost."""
    flight = Path3(40, "curve")
    flown = Flown(flight, 0)
    assert flown.begun is not None
    before = flown.filter.landmarks()
    seen = flight.observe(39, PIXEL, np.random.default_rng(1), 80)
    report = flown.filter.restart(replace(_left_only(seen), time_ns=39 * STEP_NS))
    assert not report.started
    after = flown.filter.landmarks()
    assert set(after.ids.tolist()) <= set(before.ids.tolist())
    assert len(after.ids)


def test_one_camera_begins_anew_where_it_was_good() -> None:
    """After a state that is impossible it waits, and then goes on from the pose that is given."""
    flight = Path3(80, "curve")
    rng = np.random.default_rng(0)
    filt = MonoMsckf(LEFT, T_CAM0_IMU, SETTINGS)
    assert filt.begin_anew(filt.estimate()) is None  # nothing to begin anew
    samples = flight.imu(rng, np.zeros(6))
    again: int | None = None
    for k in range(80):
        while samples and samples[0].time_ns <= k * STEP_NS:
            filt.propagate(samples.pop(0))
        started = filt.update(_left_only(flight.observe(k, PIXEL, rng, 80))).started
        if k == 38:
            good = filt.estimate()
        if k == 40:
            held = filt.begin_anew(good)
        if started and k > 40 and again is None:
            again = k
    assert held is not None
    np.testing.assert_array_equal(held.T_world_imu, good.T_world_imu)
    assert held.covariance[0, 0] > good.covariance[0, 0]
    assert again is not None
    assert again > 41
    last = filt.estimate()
    moved = se3_inverse(good.T_world_imu) @ last.T_world_imu
    a, b = (se3_from_parts(*flight.state(k * 0.05)[:2]) for k in (38, 79))
    off = (se3_inverse(a) @ b)[:3, 3] - moved[:3, 3]
    assert off @ np.linalg.solve(last.covariance[:3, :3], off) < 16.3  # 99.9 % of 3
    assert np.arccos(last.T_world_imu[2, :3] @ b[2, :3]) < 3.0 * last.tilt_sigma_rad


@pytest.mark.parametrize(("clones", "kept"), [(11, 20), (19, 20), (25, 25)])
def test_one_camera_keeps_a_second_of_poses(clones: int, kept: int) -> None:
    """At 20 frames per second: its depths come from motion alone."""
    assert _for_one_camera(MsckfSettings(clones=clones)).clones == kept
