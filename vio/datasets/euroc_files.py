"""Read and write the files of an EuRoC (ASL) folder: `sensor.yaml` and `data.csv` of cameras and
IMU.

Times are integer nanoseconds; numbers are written with all their digits. `T_BS` maps sensor
coordinates to the body.
Reference: Burri et al., The EuRoC micro aerial vehicle datasets (2016).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from vio.datasets.common import image_size, naming
from vio.datasets.yaml_files import (
    as_number,
    densities_text,
    imu_densities,
    lens_model,
    numbers,
    read_yaml_file,
)
from vio.errors import CalibrationError
from vio.files.text import exact_text, write_text
from vio.geometry.distortion import (
    CameraModel,
    StereoRig,
    rectified_pair,
    rig_from_rectified,
    simplest_lens,
)
from vio.geometry.lie import (
    FloatArray,
    checked_transform,
    quat_xyzw_from_rotation,
    se3_from_parts,
    se3_inverse,
)
from vio.geometry.stereo import StereoCamera
from vio.numerics.kinds import Tolerance
from vio.records import NS_PER_S, ImuDensities, ImuRecord, IntArray

STATE_CSV = Path("state_groundtruth_estimate0", "data.csv")  # ground truth, within mav0
TUM_FILE = "groundtruth_tum.txt"  # ground truth beside mav0
# units in the last place within which a translation is looked for that is read back as it was
_ULPS: Tolerance[int] = 2
_IMAGES_HEADER = "#timestamp [ns],filename"
_IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
_STATE_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z "
    "[], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], "
    "b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], "
    "b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]"
)

# --- sensor.yaml
# --------------------------------------------------------------------------------------------------


def read_camera_yaml(path: Path) -> tuple[CameraModel, FloatArray]:
    """Read a camera's `sensor.yaml`: its model, and `T_BS` (4, 4) from the camera to the body.

    Raises:
        CalibrationError: the file is missing, lacks an entry, or holds an impossible one.
    """
    entries = read_yaml_file(path)
    if (kind := entries.get("camera_model", "pinhole")) != "pinhole":
        raise CalibrationError(
            f"{path}: camera_model {kind!r} is not supported; only 'pinhole' is (with distortion)"
        )
    model = lens_model(entries.get("distortion_model", "none"), path)
    coefficients = () if model == "pinhole" else numbers(entries, "distortion_coefficients", path)
    model, coefficients = simplest_lens(model, coefficients)
    fu, fv, cu, cv = numbers(entries, "intrinsics", path, 4)
    width, height = image_size(numbers(entries, "resolution", path, 2), f"{path}, resolution")
    with naming(path):
        camera = CameraModel(fu, fv, cu, cv, width, height, model, coefficients)
    return camera, _T_BS(entries, path)


def camera_yaml(
    camera: CameraModel, T_body_cam: FloatArray, *, comment: str, rate_hz: float
) -> str:
    """The text of a camera's `sensor.yaml`, with all digits; `T_body_cam` (4, 4) becomes its
    `T_BS`.

    Raises:
        CalibrationError: the format has no name for the lens model.
    """
    if (name := camera.lens.files.sensor_yaml) is None:
        raise CalibrationError(
            f"EuRoC's sensor.yaml has no {camera.model} lens; rectify the images first"
        )
    return (
        f"%YAML:1.0\nsensor_type: camera\ncomment: {comment}\n\n"
        f"{_T_BS_yaml(T_body_cam)}\n"
        f"rate_hz: {rate_hz:.6g}\nresolution: [{camera.width}, {camera.height}]\ncamera_model: "
        "pinhole\n"
        f"intrinsics: [{exact_text((camera.fu, camera.fv, camera.cu, camera.cv), ', ')}] #fu, fv, "
        "cu, cv\n"
        f"distortion_model: {name}\n"
        f"distortion_coefficients: [{exact_text(camera.coefficients or (0.0,) * 4, ', ')}]\n"
    )


def read_imu_yaml(path: Path) -> tuple[FloatArray, ImuDensities | None]:
    """Read the IMU's `sensor.yaml`: its `T_BS` (4, 4) to the body, and its noise where given.

    Raises:
        CalibrationError: the file is missing, lacks an entry, or holds an impossible one.
    """
    entries = read_yaml_file(path)
    return _T_BS(entries, path), imu_densities(entries, path)


def imu_yaml(T_body_imu: FloatArray, noise: ImuDensities, *, comment: str, rate_hz: float) -> str:
    """The text of the IMU's `sensor.yaml`, with all digits; `T_body_imu` (4, 4) becomes its
    `T_BS`.
    """
    return (
        f"%YAML:1.0\nsensor_type: imu\ncomment: {comment}\n\n"
        f"{_T_BS_yaml(T_body_imu)}\nrate_hz: {rate_hz:.6g}\n{densities_text(noise, units=True)}"
    )


def median_rate_hz(times_ns: IntArray) -> float:
    """Return the median rate of sample times (N,); 0 for a single time."""
    if len(times_ns) > 1:
        return NS_PER_S / float(np.median(np.diff(times_ns)))
    return 0.0


def _T_BS(entries: Mapping[str, object], path: Path) -> FloatArray:
    """Read the transform from the sensor to the body, given as an OpenCV matrix or a list of
    rows.
    """
    entry = entries.get("T_BS")
    values = entry.get("data") if isinstance(entry, dict) else entry
    if isinstance(values, list) and all(isinstance(row, list) for row in values):
        values = [value for row in values for value in row]
    if not isinstance(values, list) or len(values) != 16:
        raise CalibrationError(
            f"{path}: T_BS must hold 16 numbers, the 4x4 transform from the sensor to the body"
        )
    return checked_transform(
        np.array([as_number(v) for v in values]).reshape(4, 4), f"{path}, T_BS"
    )


def _T_BS_yaml(T_body_sensor: FloatArray) -> str:
    rows = ",\n         ".join(exact_text(row, ", ") for row in T_body_sensor)
    return f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{rows}]\n"


def rig_read_as(camera: StereoCamera, T_cam0_imu: FloatArray) -> StereoRig:
    """Return the rig of a rectified pair whose poses `T_BS`, when they are read, give this very
    pair, to the last bit.

    The files hold the inverses of `T_cam0_imu` (4, 4) and of the right camera's pose, and inverting
    twice rounds. Of the translations within a few units in the last place one is taken that does
    not; where there is none, the nearest.

    Raises:
        CalibrationError: the image size is unknown.
    """
    rig = rig_from_rectified(camera, T_cam0_imu)
    R = rig.T_imu_cam0[:3, :3]
    baseline = np.array([camera.baseline_m, 0.0, 0.0])
    T0 = rig.T_imu_cam0.copy()
    T1 = rig.T_imu_cam1.copy()

    def left_fits(t: FloatArray) -> bool:
        return np.array_equal(se3_inverse(se3_from_parts(R, t)), T_cam0_imu)

    def right_fits(t: FloatArray) -> bool:
        found = rectified_pair(replace(rig, T_imu_cam0=T0, T_imu_cam1=se3_from_parts(R, t)))
        return found is not None and found.baseline_m == camera.baseline_m

    # R is a rotation to its own digits only, so its transpose is not its inverse.
    T0[:3, 3] = _first(
        _neighbours(np.asarray(np.linalg.solve(R.T, -T_cam0_imu[:3, 3]), dtype=np.float64)),
        left_fits,
    )
    right: FloatArray = np.asarray(T0[:3, 3] + np.linalg.solve(R.T, baseline), dtype=np.float64)
    T1[:3, 3] = _first(_neighbours(right), right_fits)
    return replace(rig, T_imu_cam0=T0, T_imu_cam1=T1)


def _first(values: Sequence[FloatArray], fits: Callable[[FloatArray], bool]) -> FloatArray:
    """Return the first value that fits, else the first one."""
    return next((value for value in values if fits(value)), values[0])


def _neighbours(t: FloatArray) -> list[FloatArray]:
    """Return a vector (3,) and those around it, the nearest first, by units in the last place of
    its numbers.
    """
    steps = sorted(
        product(range(-_ULPS, _ULPS + 1), repeat=3), key=lambda step: max(map(abs, step))
    )
    return [t + np.array(step) * np.spacing(np.abs(t)) for step in steps]


def write_cameras(
    mav: Path,
    rig: StereoRig,
    times_ns: IntArray,
    last_ns: int,
    *,
    kind: str,
    T_body_imu: FloatArray | None = None,
) -> None:
    """Write `sensor.yaml` and `data.csv` of both cameras.

    Args:
        mav: the folder of `cam0` and `cam1`, which exist.
        rig: the cameras.
        times_ns: (N,) of their images.
        last_ns: by whose digits images are named.
        kind: of the images, for comments.
        T_body_imu: (4, 4); None: the body is the IMU.
    """
    for name, camera, T_imu_cam in (
        ("cam0", rig.cam0, rig.T_imu_cam0),
        ("cam1", rig.cam1, rig.T_imu_cam1),
    ):
        T = T_imu_cam if T_body_imu is None else T_body_imu @ T_imu_cam
        text = camera_yaml(camera, T, comment=f"{kind} {name}", rate_hz=median_rate_hz(times_ns))
        write_text(mav / name / "sensor.yaml", text)
        write_text(mav / name / "data.csv", image_list_csv(times_ns, last_ns))


# --- data.csv
# --------------------------------------------------------------------------------------------------


def image_name(time_ns: int, last_ns: int) -> str:
    """The file name of an image by its time, with the digits of the last one's, so that names
    sort by time as text.
    """
    return f"{time_ns:0{len(str(last_ns))}d}.png"


def image_list_csv(times_ns: IntArray, last_ns: int) -> str:
    """The text of a camera's `data.csv` for images named by their times (N,) and the last one,
    nanoseconds.
    """
    return (
        "\n".join([_IMAGES_HEADER, *(f"{t},{image_name(t, last_ns)}" for t in times_ns.tolist())])
        + "\n"
    )


def imu_csv(record: ImuRecord) -> str:
    """The text of the IMU's `data.csv`, with all digits."""
    return _stamped_csv(_IMU_HEADER, record.times_ns, np.hstack([record.gyro, record.accel]))


def state_csv(
    times_ns: IntArray, T_world_body: FloatArray, velocity_world: FloatArray, biases: FloatArray
) -> str:
    """The text of the ground truth, with all digits.

    Args:
        times_ns: (N,).
        T_world_body: (N, 4, 4).
        velocity_world: (N, 3) m/s.
        biases: (N, 6) of gyroscope (rad/s) and accelerometer (m/s^2).
    """
    q_wxyz = np.roll(quat_xyzw_from_rotation(T_world_body[:, :3, :3]), 1, axis=1)
    return _stamped_csv(
        _STATE_HEADER, times_ns, np.hstack([T_world_body[:, :3, 3], q_wxyz, velocity_world, biases])
    )


def _stamped_csv(header: str, times_ns: IntArray, values: FloatArray) -> str:
    rows = (f"{t},{exact_text(row, ',')}" for t, row in zip(times_ns.tolist(), values, strict=True))
    return "\n".join([header, *rows]) + "\n"
