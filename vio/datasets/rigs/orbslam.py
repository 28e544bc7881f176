"""Settings of ORB-SLAM2 and ORB-SLAM3, which are OpenCV's YAML, in their old and new form, and those
of OpenVSLAM and stella_vslam.

Old: `Camera.fx … Camera.bf`, `Camera2.fx …` with `Tlr`, or `LEFT.K … RIGHT.P`; `Tbc`. New
(`File.version`): `Camera1.fx …`, `Camera2.fx …`, `Stereo.T_c1_c2` or `Stereo.b`; `IMU.T_b_c1`.

`Tlr` and `Stereo.T_c1_c2` map coordinates of the right camera to the left one, `Tbc` and
`IMU.T_b_c1` those of the left camera to the IMU; metres. `Camera.bf` is focal length times
baseline, pixels times metres. Neither form has a time shift. Noise: densities in SI units.
OpenVSLAM names it `Camera.focal_x_baseline`, the size `Camera.cols` and `Camera.rows`, and the lens
`Camera.model`; stella_vslam has them in a block `Camera:`, and raw images where there is a block
`StereoRectifier:`; with `Camera.setup: RGBD`, the depths' levels per metre are `depthmap_factor`.
Reference: ORB-SLAM3's `Settings.cc` and `Tracking.cc`, and its document Calibration_Tutorial;
stella_vslam's documentation, Parameters.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vio.cameras.rig import Rig, camera_from_matrix
from vio.datasets.common import image_size, naming
from vio.datasets.rigs.opencv import coefficients_of, rig_from_opencv
from vio.datasets.rigs.plausible import checked_rig, noting_imu_place
from vio.datasets.rigs.source import Size, Source
from vio.datasets.yaml_files import Entries, as_number, matrix, numbers, tool_lens
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel
from vio.geometry.lie import FloatArray, checked_transform, se3_inverse
from vio.records import ImuDensities

_NOISE = ("IMU.NoiseGyro", "IMU.GyroWalk", "IMU.NoiseAcc", "IMU.AccWalk")
_POSES_OF_CAMERA = ("IMU.T_b_c1", "Tbc")
# names of OpenVSLAM, and ORB-SLAM's
_OF_STELLA = {
    "Camera.cols": "Camera.width",
    "Camera.rows": "Camera.height",
    "Camera.focal_x_baseline": "Camera.bf",
}
_LENSES_OF_STELLA = {"perspective": "PinHole", "fisheye": "KannalaBrandt8"}
_SAME_BASELINE = 0.02  # share by which rounded numbers may differ
_POSES_OF_RIGHT = ("Stereo.T_c1_c2", "Tlr")


def matches(entries: Entries) -> bool:
    """Return whether entries are settings of ORB-SLAM with a camera."""
    entries = _in_its_names(entries)
    return any(key in entries for key in ("Camera.fx", "Camera1.fx", "LEFT.K"))


def read(source: Source) -> Rig:
    """Read the settings: a raw pair, a rectified one, one camera, or one with depth images.

    Raises:
        CalibrationError: an entry is missing or impossible, or the image size is not known.
    """
    entries = _in_its_names(source.entries)
    source = replace(source, entries=entries)
    rig = _cameras(source)
    pose = _transform(entries, _POSES_OF_CAMERA, source.where)
    T_cam0_imu = None if pose is None else se3_inverse(pose)
    noise = None if pose is None else _noise(entries, source.where)
    return noting_imu_place(replace(rig, T_cam0_imu=T_cam0_imu, imu_noise=noise), source.where)


def _in_its_names(entries: Entries) -> Entries:
    """Return entries of OpenVSLAM or stella_vslam by ORB-SLAM's names; others as they are."""
    named = dict(entries)
    block = entries.get("Camera")
    if isinstance(block, dict):
        named |= {f"Camera.{key}": value for key, value in block.items()}
    if "Camera.model" not in named:
        return entries
    for key, name in _OF_STELLA.items():
        if key in named:
            named.setdefault(name, named[key])
    model = str(named["Camera.model"]).lower()
    named["Camera.type"] = _LENSES_OF_STELLA.get(model, model)
    setup = str(named.get("Camera.setup", "stereo")).lower()
    if setup in ("monocular", "rgbd"):  # the baseline is that of a depth camera's projector
        named.pop("Camera.bf", None)
        if setup == "rgbd":
            named["RGBD.DepthMapFactor"] = _depthmap_factor(named)
        return named
    rectifier = entries.get("StereoRectifier")
    if isinstance(rectifier, dict) and "K_left" in rectifier:
        size = {"width": named.get("Camera.width"), "height": named.get("Camera.height")}
        fisheye = str(rectifier.get("model", model)).lower() == "fisheye"
        lens = {"distortion_model": "equidistant"} if fisheye else {}
        fx, fy, cx, cy, bf = (
            as_number(named.get(f"Camera.{key}")) for key in ("fx", "fy", "cx", "cy", "bf")
        )
        rows = [[fx, 0.0, cx, 0.0], [0.0, fy, cy, 0.0], [0.0, 0.0, 1.0, 0.0]]
        return {
            **{f"LEFT.{key}": rectifier.get(f"{key}_left") for key in "KDR"},
            **{f"RIGHT.{key}": rectifier.get(f"{key}_right") for key in "KDR"},
            **{f"LEFT.{key}": value for key, value in size.items()},
            **lens,
            "LEFT.P": rows,
            "RIGHT.P": [[fx, 0.0, cx, -bf], *rows[1:]],
            "Camera.fx": fx,
            "Camera.bf": bf,
        }
    return named


def _depthmap_factor(named: Entries) -> object:
    """Return what states the levels per metre of depth images, which is in a block or in none."""
    block = named.get("Preprocessing")
    if isinstance(block, dict) and "depthmap_factor" in block:
        return block["depthmap_factor"]
    return named.get("depthmap_factor", named.get("Camera.depthmap_factor"))


def _cameras(source: Source) -> Rig:
    entries = source.entries
    where = source.where
    if "LEFT.K" in entries and "RIGHT.K" in entries:
        return _agreeing(rig_from_opencv(entries, where, source.image_size), entries, where)
    size, stated = _size(source)
    first = "Camera1" if "Camera1.fx" in entries else "Camera"
    cam0 = _camera(entries, first, size, where)
    pose = _transform(entries, _POSES_OF_RIGHT, where)
    factor = _depth_factor(entries)
    rig = Rig(cam0, depth_factor=factor)
    if factor is None and pose is not None and "Camera2.fx" in entries:
        cam1 = _camera(entries, "Camera2", size, where)
        with naming(where):
            rig = _agreeing(Rig(cam0, cam1, se3_inverse(pose)), entries, where)
    elif factor is None and (baseline := _baseline(entries, cam0, where)) is not None:
        if cam0.model != "pinhole":
            raise CalibrationError(
                f"{where}: states Camera.bf, as of a rectified pair, and a distortion, which "
                "rectified images do not have; give the calibration of both cameras (LEFT.K …)"
            )
        with naming(where):
            rig = Rig.rectified(cam0.fu, cam0.fv, cam0.cu, cam0.cv, baseline, *size)
    return checked_rig(rig, where, size_stated=stated)


def _agreeing(rig: Rig, entries: Entries, where: str) -> Rig:
    """Return a rig whose stereo pose is stated, with a doubt where another entry states another
    baseline: ORB-SLAM takes its depths from that one.
    """
    focal = as_number(entries.get("Camera.fx", 0.0))
    key = "Stereo.b"
    other = as_number(entries.get(key))
    if key not in entries:
        key = "Camera.bf / Camera.fx"
        if focal > 0:
            other = as_number(entries.get("Camera.bf")) / focal
        else:
            other = np.nan
    if not np.isfinite(other):
        return rig
    baseline = float(np.linalg.norm(rig.right[1][:3, 3]))
    if abs(other - baseline) <= _SAME_BASELINE * baseline:
        return rig
    return rig.noting(
        f"{where}: doubtful: the pose of the right camera makes a baseline of {baseline:.4g} m, and "
        f"{key} one of {other:.4g} m; the pose is read, and if the other is right, all lengths are "
        f"off by {other / baseline:.3g}"
    )


def _size(source: Source) -> tuple[Size, bool]:
    """Return width and height, and whether the file states them (ORB-SLAM2's does not)."""
    found = [as_number(source.entries.get(f"Camera.{name}")) for name in ("width", "height")]
    if all(value >= 1 for value in found):
        return image_size(found, source.where), True
    if source.image_size is None:
        raise CalibrationError(
            f"{source.where}: states no image size; add 'Camera.width: W' and 'Camera.height: H', "
            "or pass image_size=(W, H)"
        )
    return source.image_size, False


def _camera(entries: Entries, name: str, size: Size, where: str) -> CameraModel:
    fx, fy, cx, cy = (
        numbers(entries, f"{name}.{key}", where, 1)[0] for key in ("fx", "fy", "cx", "cy")
    )
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    kind = entries.get("Camera.type", "PinHole")
    model, names = tool_lens("orbslam", kind, f"{where}, Camera.type")
    # absent ones are zero
    bend = tuple(as_number(entries.get(f"{name}.{key}", 0.0)) for key in names)
    with naming(f"{where}, {name}"):
        return camera_from_matrix(K, *size, model, coefficients_of(model, bend))


def _baseline(entries: Entries, cam0: CameraModel, where: str) -> float | None:
    """Return the baseline of a rectified pair in metres; None: there is one camera."""
    if "Stereo.b" in entries:
        return numbers(entries, "Stereo.b", where, 1)[0]
    if "Camera.bf" in entries:
        return numbers(entries, "Camera.bf", where, 1)[0] / cam0.fu
    return None


def _depth_factor(entries: Entries) -> float | None:
    """Return the levels per metre of depth images; None: there are none of 16 bits."""
    stated = as_number(entries.get("RGBD.DepthMapFactor", entries.get("DepthMapFactor")))
    return stated if stated > 1 else None


def _transform(entries: Entries, names: tuple[str, ...], where: str) -> FloatArray | None:
    name = next((name for name in names if name in entries), None)
    if name is None:
        return None
    return checked_transform(matrix(entries[name], None, f"{where}, {name}"), f"{where}, {name}")


def _noise(entries: Entries, where: str) -> ImuDensities | None:
    if not all(name in entries for name in _NOISE):
        return None
    values = [numbers(entries, name, where, 1)[0] for name in _NOISE]
    return ImuDensities(*values) if min(values) > 0 else None
