"""What the filters, records and front ends refuse from Python, with the package's own errors,
and stay usable.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.dataset_makers import CAMERA, FRAME_S, T_CAM0_IMU, make_drive
from vio.config import Config
from vio.errors import CalibrationError, ConfigError, DataError
from vio.filters.msckf import Msckf
from vio.filters.settings import MsckfSettings, VislamSettings
from vio.filters.vislam import Vislam
from vio.frontend import FrontendSettings, build_frontend
from vio.geometry.stereo import StereoCamera
from vio.records import Estimate, ImuSample, Observations, StereoFrame, VelocitySample, observations

DRIVE = make_drive(6)
STEP_NS = round(FRAME_S * 1e9)
REST = np.array([0.0, 0.0, 9.81])

Filter = Msckf | Vislam


def _msckf(motion: str | None = "velocity", **others: Any) -> Msckf:
    given = {"camera": CAMERA, "T_cam0_imu": T_CAM0_IMU, "settings": MsckfSettings(), **others}
    return Msckf(given["camera"], given["T_cam0_imu"], given["settings"], motion=motion)  # type: ignore[arg-type]


def _vislam(**others: Any) -> Vislam:
    given = {"camera": CAMERA, "T_cam0_imu": T_CAM0_IMU, "settings": VislamSettings(), **others}
    return Vislam(given["camera"], given["T_cam0_imu"], given["settings"], motion_sensor=True)


def _velocity(k: float) -> VelocitySample:
    u = DRIVE.velocities[int(k)]
    return VelocitySample(round(k * STEP_NS), u[:3], u[3:])


def _seen(k: int, frame: int | None = None) -> Observations:
    z = DRIVE.features[:, :, k].T
    ids = np.flatnonzero(z[:, 0] >= 0)
    return observations(
        k if frame is None else frame, (k if frame is None else frame) * STEP_NS, ids, z[ids]
    )


def _with_pixel(value: float, column: int, *, has_right: bool = True) -> Observations:
    seen = _seen(3)
    z, right = seen.z.copy(), seen.has_right.copy()
    z[1, column], right[1] = value, has_right
    return replace(seen, z=z, has_right=right)


def _doubled() -> Observations:
    seen = _seen(3)
    ids = seen.ids.copy()
    ids[4] = ids[2]
    return replace(seen, ids=ids)


def _nan_sample(k: int) -> VelocitySample:
    return VelocitySample(k * STEP_NS, np.array([1.0, np.nan, 0.0]), np.zeros(3))


WRONG: dict[str, tuple[Callable[[Filter], object], str]] = {
    "sample doubled": (lambda f: f.propagate(_velocity(2)), "is not after the last one"),
    "sample swapped": (lambda f: f.propagate(_velocity(1.5)), "is not after the last one"),
    "sample not finite": (
        lambda f: f.propagate(_nan_sample(3)),
        "the velocity sample at 300000000 ns holds .*nan",
    ),
    "frame doubled": (
        lambda f: f.update(_seen(2)),
        "frame 2 at 200000000 ns is not after the last frame",
    ),
    "frame backwards": (
        lambda f: f.update(_seen(1)),
        "frame 1 at 100000000 ns is not after the last frame",
    ),
    "pixel not finite": (
        lambda f: f.update(_with_pixel(np.nan, 1)),
        "frame 3: feature .* is at the pixels",
    ),
    "right pixel infinite": (
        lambda f: f.update(_with_pixel(np.inf, 2)),
        "frame 3: feature .* is at the pixels",
    ),
    "ids doubled": (lambda f: f.update(_doubled()), "frame 3 observes feature .* twice"),
}


def _after_three_frames(make: Callable[[], Filter]) -> Filter:
    f = make()
    for k in range(3):
        f.propagate(_velocity(k))
        f.update(_seen(k))
    return f


def _rest_of_the_drive(f: Filter) -> Estimate:
    for k in range(3, 6):
        f.propagate(_velocity(k))
        f.update(_seen(k))
    return f.estimate()


@pytest.mark.parametrize("make", [_msckf, _vislam])
@pytest.mark.parametrize("fault", WRONG)
def test_wrong_input_is_refused_and_changes_nothing(make: Callable[[], Filter], fault: str) -> None:
    call, message = WRONG[fault]
    f = _after_three_frames(make)
    with pytest.raises(DataError, match=message):
        call(f)
    refused, untouched = _rest_of_the_drive(f), _rest_of_the_drive(_after_three_frames(make))
    np.testing.assert_array_equal(refused.T_world_imu, untouched.T_world_imu)
    np.testing.assert_array_equal(refused.covariance, untouched.covariance)


@pytest.mark.parametrize("make", [_msckf, _vislam])
def test_right_pixels_are_arbitrary_where_there_is_no_right_match(
    make: Callable[[], Filter],
) -> None:
    f, other = _after_three_frames(make), _after_three_frames(make)
    f.update(_with_pixel(np.nan, 2, has_right=False))
    other.update(_with_pixel(7.0, 2, has_right=False))
    np.testing.assert_array_equal(f.estimate().T_world_imu, other.estimate().T_world_imu)


@pytest.mark.parametrize("make", [_msckf, _vislam])
def test_velocities_and_frames_keep_one_order(make: Callable[[], Filter]) -> None:
    f = _after_three_frames(make)
    f.propagate(_velocity(4))
    with pytest.raises(DataError, match="frame 3 at 300000000 ns is before the last velocity"):
        f.update(_seen(3))
    f = make()
    f.propagate(_velocity(0))
    f.update(_seen(2))
    with pytest.raises(DataError, match="the velocity at 100000000 ns is before the last frame"):
        f.propagate(_velocity(1))


def test_a_first_frame_before_the_first_velocity_is_refused() -> None:
    """The state has gone on to the velocity: a step back would take its process noise away."""
    vislam = _vislam(settings=VislamSettings(motion_model="twist"))
    vislam.propagate(_velocity(2))
    with pytest.raises(DataError, match="frame 1 at 100000000 ns is before the last velocity"):
        vislam.update(_seen(1))
    vislam.update(_seen(3))
    assert np.linalg.eigvalsh(vislam.estimate().covariance).min() >= 0.0


@pytest.mark.parametrize(("time_ns", "gyro"), [(5, 0.0), (10, 0.0), (20, np.nan), (20, np.inf)])
def test_imu_samples_out_of_order_or_not_finite_are_refused(time_ns: int, gyro: float) -> None:
    f = _msckf("imu")
    f.propagate(ImuSample(10, np.zeros(3), REST))
    with pytest.raises(DataError, match="the IMU sample at"):
        f.propagate(ImuSample(time_ns, np.full(3, gyro), REST))


TILTED = np.eye(4)
TILTED[0, 0] = 1.1


@pytest.mark.parametrize("make", [_msckf, _vislam])
@pytest.mark.parametrize(
    ("others", "error", "message"),
    [
        ({"T_cam0_imu": np.eye(3)}, CalibrationError, r"shape \(3, 3\) instead of \(4, 4\)"),
        ({"T_cam0_imu": np.eye(4)[:3]}, CalibrationError, r"shape \(3, 4\) instead of \(4, 4\)"),
        ({"T_cam0_imu": "identity"}, CalibrationError, "is no matrix of numbers"),
        ({"T_cam0_imu": np.full((4, 4), np.nan)}, CalibrationError, "not finite"),
        ({"T_cam0_imu": TILTED}, CalibrationError, "not a rotation"),
        ({"T_cam0_imu": np.diag([1.0, 1.0, -1.0, 1.0])}, CalibrationError, "reflection"),
        ({"camera": CAMERA.K}, ConfigError, "takes a StereoCamera, got ndarray"),
        ({"settings": Config()}, ConfigError, "takes .*Settings, got Config; give its own section"),
    ],
)
def test_wrong_parts_are_refused(
    make: Callable[..., Filter], others: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        make(**others)


def test_unknown_motion_is_refused() -> None:
    with pytest.raises(ConfigError, match="no model for motion 'imuu'"):
        _msckf("imuu")


SEEN = _seen(0)


@pytest.mark.parametrize(
    "build",
    [
        lambda: ImuSample(0, [0.0, 0.0, 0.0], REST),  # type: ignore[arg-type]
        lambda: ImuSample(0, np.zeros(4), REST),
        lambda: ImuSample(0, np.zeros(3, dtype=np.float32), REST),  # type: ignore[arg-type]
        lambda: ImuSample(0.5, np.zeros(3), REST),  # type: ignore[arg-type]
        lambda: VelocitySample(0, np.zeros(3), None),  # type: ignore[arg-type]
        lambda: replace(SEEN, ids=SEEN.ids.astype(np.int32)),
        lambda: replace(SEEN, z=SEEN.z.astype(np.float32)),
        lambda: replace(SEEN, z=SEEN.z[:, :2]),
        lambda: replace(SEEN, z=SEEN.z[1:]),
        lambda: replace(SEEN, has_right=SEEN.has_right[:-1]),
        lambda: replace(SEEN, stale=SEEN.stale.astype(np.int64)),
        lambda: replace(SEEN, time_ns=0.1),
        lambda: observations(0, 0, [1.5], [[1, 2, 3, 4]]),
        lambda: observations(0, 0, [1], [["a", 2, 3, 4]]),
        lambda: observations(0, 0, [2**70], [[1, 2, 3, 4]]),
    ],
)
def test_records_of_wrong_types_are_refused(build: Callable[[], object]) -> None:
    with pytest.raises(DataError):
        build()


@pytest.mark.parametrize(
    "wrong",
    [
        {"fu": "700"},
        {"cu": None},
        {"fv": np.zeros(2)},
        {"width": -1},
        {"height": 3.5},
        {"width": "640"},
    ],
)
def test_cameras_of_wrong_types_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(CalibrationError):
        replace(CAMERA, **wrong)


GRAY = np.zeros((24, 32), dtype=np.uint8)


@pytest.mark.parametrize("name", ["klt", "orb"])
@pytest.mark.parametrize(
    "frame",
    [
        GRAY,
        StereoFrame(0, 0, GRAY.tolist(), GRAY),  # type: ignore[arg-type]
        StereoFrame(0, 0, GRAY, GRAY[:0]),
        StereoFrame(0, 0, GRAY.astype(float), GRAY),  # type: ignore[arg-type]
        StereoFrame(0, 0, np.stack([GRAY] * 3, axis=-1), GRAY),
    ],
)
def test_front_ends_refuse_what_is_no_frame(name: str, frame: Any) -> None:
    camera = StereoCamera(30.0, 30.0, 16.0, 12.0, 0.1)
    with pytest.raises(DataError, match="front end"):
        build_frontend(name, camera, FrontendSettings(), None).process(frame)  # type: ignore[arg-type]


def test_front_ends_refuse_wrong_parts() -> None:
    for camera, settings in ((CAMERA, Config()), (CAMERA.K, FrontendSettings())):
        with pytest.raises(
            ConfigError, match="build_frontend takes a StereoCamera and FrontendSettings"
        ):
            build_frontend("klt", camera, settings, None)  # type: ignore[arg-type]


def test_samples_at_once_are_taken_as_one_by_one_and_a_wrong_one_is_named() -> None:
    at_once = Msckf(CAMERA, T_CAM0_IMU, MsckfSettings(), motion="imu")
    good = [ImuSample(k, np.zeros(3), REST) for k in (10, 20, 30)]
    at_once.propagate_all(good[:2])
    with pytest.raises(DataError, match="at 20 ns is not after the last one"):
        at_once.propagate_all([good[2], good[1]])
    with pytest.raises(DataError, match="at 40 ns holds"):
        at_once.propagate_all([ImuSample(40, np.array([np.nan, 0.0, 0.0]), REST)])
    with pytest.raises(ConfigError, match="got a VelocitySample"):
        at_once.propagate_all([VelocitySample(50, np.zeros(3), np.zeros(3))])
    at_once.propagate_all([ImuSample(31, np.zeros(3), REST)])  # all before the wrong one were taken
    with pytest.raises(DataError, match="at 31 ns is not after the last one"):
        at_once.propagate_all([ImuSample(31, np.zeros(3), REST)])
