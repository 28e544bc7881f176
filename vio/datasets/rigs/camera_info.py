"""ROS CameraInfo, as messages of a bag or as YAML files of `camera_calibration` (a pair:
`left.yaml`, `right.yaml`).

`K` and `D` are those of the raw image, `R` rotates the camera to the rectified one,
`P = K' [I | t]` projects from the rectified left camera; `P[0, 3]` of the right camera is -focal
length times baseline. Size, K and P are those of the whole sensor; its images may be a part of it
(`roi`, in pixels of the sensor) and binned: a pixel u of the sensor is (u - x_offset) / binning_x.
Reference: the definition of sensor_msgs/CameraInfo, and image_geometry's PinholeCameraModel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vio.cameras.rig import Rig, camera_from_matrix
from vio.datasets.common import image_size, naming
from vio.datasets.rigs.opencv import coefficients_of
from vio.datasets.rigs.plausible import check_projection, checked_rig
from vio.datasets.sides import first_pair, pairs_of
from vio.datasets.yaml_files import (
    Entries,
    as_number,
    lens_model,
    matrix,
    numbers,
    read_yaml_file,
    section,
)
from vio.errors import CalibrationError, VioError
from vio.geometry.distortion import CameraModel, DistortionModel
from vio.geometry.lie import FloatArray, checked_transform, se3_from_parts
from vio.geometry.rectify import vertical_fault

_MIN_BASELINE_M = 0.005  # no stereo camera has less
_SAME_MATRIX = 1e-6  # relative, of the two P: beyond it each rectified image has its own
_MAX_BASELINE_M = 1.0  # another reading makes no more than this


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """One camera as ROS states it."""

    where: str  # file or topic, for messages
    width: int  # pixels
    height: int
    model: str  # ROS's name of the distortion
    D: tuple[float, ...]
    K: FloatArray  # (3, 3) raw
    R: FloatArray  # (3, 3) from the raw to the rectified camera
    P: FloatArray  # (3, 4) of the rectified image
    binning: tuple[int, int] = (1, 1)  # pixels of the sensor in one of the image, along u and v
    # part of the sensor: x_offset, y_offset, width, height in its pixels; None: the whole
    roi: tuple[int, int, int, int] | None = None

    @property
    def states_size(self) -> bool:
        """Whether the size of the images is stated: some drivers leave it at 0."""
        return self.width > 0 and self.height > 0

    def of_images(self, size: tuple[int, int] | None) -> CameraInfo:
        """Return what describes the images themselves, which may be binned, or a part.

        Args:
            size: width and height of the images, where known; images of the whole sensor's size
                are neither, whatever the message states.
        """
        if not self.states_size and size is not None:
            return replace(self, width=size[0], height=size[1], binning=(1, 1), roi=None)
        x, y, width, height = self.roi or (0, 0, self.width, self.height)
        along_u = max(self.binning[0], 1)
        along_v = max(self.binning[1], 1)
        whole = size == (self.width, self.height)
        if whole or (self.roi is None and along_u == along_v == 1):
            return self
        change = np.array(
            [
                [1 / along_u, 0, -x / along_u],
                [0, 1 / along_v, -y / along_v],
                [0, 0, 1],
            ]
        )
        return replace(
            self,
            width=width // along_u,
            height=height // along_v,
            K=change @ self.K,
            P=change @ self.P,
            binning=(1, 1),
            roi=None,
        )


def is_camera_info(entries: Entries) -> bool:
    """Return whether entries are those of a CameraInfo file, or of a message that was printed."""
    if _printed(entries) is not None:
        return True
    return "camera_matrix" in entries and (
        "projection_matrix" in entries or "image_width" in entries
    )


def _printed(entries: Entries) -> dict[str, object] | None:
    """Return the entries of a message as `rostopic echo` prints it, by their names in files.

    None: it is none. ROS 1 and ROS 2 write its matrices in capitals and in small letters.
    """
    found = {name: entries.get(name, entries.get(name.upper())) for name in "dkrp"}
    if any(found[name] is None for name in "krp") or "width" not in entries:
        return None
    return {
        **entries,
        "image_width": entries["width"],
        "image_height": entries.get("height"),
        "distortion_coefficients": found["d"] or [],
        "camera_matrix": {"rows": 3, "cols": 3, "data": found["k"]},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": found["r"]},
        "projection_matrix": {"rows": 3, "cols": 4, "data": found["p"]},
    }


def pair_of_files(path: Path) -> tuple[Path, Path] | None:
    """Return the left and right file of a pair, given a folder or one of the two.

    None: there is no pair, or several.
    """
    folder = path if path.is_dir() else path.parent
    pairs = pairs_of(sorted(file.name for file in filter(_is_yaml, folder.iterdir())))
    if path.is_dir():
        found = [
            (left, right)
            for left, right in pairs
            if _holds_camera_info(folder / left) and _holds_camera_info(folder / right)
        ]
    else:
        found = [pair for pair in pairs if path.name in pair]
    pair = first_pair(found)
    if pair is None:
        return None
    return (folder / pair[0], folder / pair[1])


def _is_yaml(file: Path) -> bool:
    return file.suffix in (".yaml", ".yml") and file.is_file()


def _holds_camera_info(file: Path) -> bool:
    try:
        return is_camera_info(read_yaml_file(file))
    except VioError:
        return False


def read_camera_info(path: Path) -> CameraInfo:
    """Read the YAML file of one camera; that of a camera alone may lack the entries of a
    rectification.

    Raises:
        CalibrationError: an entry is missing or malformed.
    """
    read = read_yaml_file(path, "the camera's calibration")
    entries: Entries = _printed(read) or read
    where = str(path)
    size = [numbers(entries, key, where, 1)[0] for key in ("image_width", "image_height")]
    width, height = image_size(size, where)
    alone = "projection_matrix" not in entries
    wanted = (
        ("camera_matrix",)
        if alone
        else ("camera_matrix", "rectification_matrix", "projection_matrix")
    )
    found = {key: section(entries, key, where) for key in wanted}
    D = entries.get("distortion_coefficients", [] if alone else None)
    K = matrix(found["camera_matrix"], (3, 3), f"{where}, camera_matrix")
    R = np.eye(3)
    P = np.zeros((3, 4))
    if not alone:
        R = matrix(found["rectification_matrix"], (3, 3), f"{where}, rectification_matrix")
        P = matrix(found["projection_matrix"], (3, 4), f"{where}, projection_matrix")
    return CameraInfo(
        where,
        width,
        height,
        str(entries.get("distortion_model") or ""),
        tuple(np.ravel(matrix(D, None, f"{where}, distortion_coefficients")).tolist()),
        P[:, :3] if _is_cut_projection(K, P) else K,
        R,
        P,
        _binning_of(entries),
        _roi_of(entries),
    )


def _is_cut_projection(K: FloatArray, P: FloatArray) -> bool:
    """Return whether K (3, 3) holds the first nine numbers of `K [I | 0]` (3, 4), as RTAB-Map wrote
    them for years, and P (3, 4) has the same focal lengths, so that it tells K.
    """
    whole = np.column_stack([P[:, :3], np.zeros(3)])
    return bool(P[0, 0] > 0 and (K.ravel() == whole.ravel()[:9]).all())


def _binning_of(entries: Entries) -> tuple[int, int]:
    """Return the binning that a file may state; a dump of the message does."""
    along_u, along_v = (as_number(entries.get(f"binning_{axis}", 1)) for axis in "xy")
    return (int(along_u) if along_u >= 1 else 1, int(along_v) if along_v >= 1 else 1)


def _roi_of(entries: Entries) -> tuple[int, int, int, int] | None:
    block = entries.get("roi")
    if not isinstance(block, dict):
        return None
    names = ("x_offset", "y_offset", "width", "height")
    return region_of([as_number(block.get(name, 0)) for name in names])


def region_of(values: Sequence[float]) -> tuple[int, int, int, int] | None:
    """Return a region x_offset, y_offset, width, height; None: it is empty, which stands for the
    whole image.
    """
    if not all(np.isfinite(values)) or min(values[2:]) < 1:
        return None
    x, y, width, height = (int(value) for value in values)
    return x, y, width, height


def rig_from_camera_infos(
    infos: Sequence[CameraInfo],
    *,
    rectified: bool = False,
    image_size: tuple[int, int] | None = None,
) -> Rig:
    """Return the rig of the CameraInfo of one camera, or of those of a left and a right camera.

    Args:
        infos: one, or left and right.
        rectified: the images are those after ROS's rectification (`image_rect`), so that only P
            applies.
        image_size: width and height of the images, where known; see `CameraInfo.of_images`.

    Raises:
        CalibrationError: a camera is not calibrated (K or P of zeros; of one camera, the one that
            applies), a matrix was written from integers, its lens is not read, or the two are no
            stereo pair.
    """
    for info in infos:
        _check_numbers(info)
    sized = all(info.states_size for info in infos)
    infos = [info.of_images(image_size) for info in infos]
    rig = _rig(infos, rectified=rectified)
    doubt = None if rig.cam1 is None else _metres_doubt(rig, infos[1])
    if doubt is not None:
        rig = rig.noting(doubt)
    return checked_rig(rig, infos[0].where, size_stated=sized)


def _check_numbers(info: CameraInfo) -> None:
    """Refuse a matrix of integers whose bits were written as those of doubles, which are subnormal,
    as rosbags does with an array of int64.
    """
    for name, values in (("K", info.K), ("R", info.R), ("P", info.P)):
        size = np.abs(values)
        if ((size > 0) & (size < np.finfo(np.float64).smallest_normal)).any():
            raise CalibrationError(
                f"{info.where}: {name} holds numbers of the size of {size[size > 0].min():.1g}: it "
                "was written from an array of integers; write it from one of float64, or give the "
                "calibration with --calibration FILE"
            )


def _rig(infos: Sequence[CameraInfo], *, rectified: bool) -> Rig:
    if len(infos) == 1:
        return _mono_rig(infos[0], rectified=rectified)
    for info in infos:
        if not (info.K[0, 0] > 0 and info.P[0, 0] > 0):
            raise CalibrationError(
                f"{info.where}: not calibrated (K or P is zero); give a calibration file"
            )
    left, right = infos
    shift = _rectified_shift(left, right)
    if rectified:
        cam0, cam1 = (_camera(info, rectified=True) for info in infos)
        if not np.allclose(left.P[:, :3], right.P[:, :3], rtol=_SAME_MATRIX):
            return Rig(cam0, cam1, se3_from_parts(np.eye(3), shift))
        with naming(left.where):
            return Rig.rectified(
                cam0.fu, cam0.fv, cam0.cu, cam0.cv, float(-shift[0]), cam0.width, cam0.height
            )
    R0, R1 = (_rectification(info) for info in infos)
    cam0, cam1 = (_camera(info, rectified=False) for info in infos)
    return Rig(cam0, cam1, se3_from_parts(R1.T @ R0, R1.T @ shift))


def _rectification(info: CameraInfo) -> FloatArray:
    """Return R (3, 3) of a raw image; some drivers of rectified images leave it at zeros, and then
    it is the identity.

    Raises:
        CalibrationError: R is no rotation, or is zero although the lens or P say that the images
            are not rectified.
    """
    if info.R.any():
        T = np.column_stack([info.R, np.zeros(3)])
        return checked_transform(T, f"{info.where}, R")[:3, :3]
    if any(info.D) or not np.allclose(info.K, info.P[:, :3], rtol=1e-6, atol=1e-6):
        raise CalibrationError(
            f"{info.where}: R is zero, so how the images are to be rectified is not stated (D and "
            "the difference of K and P say that they are not); give the pair's calibration with "
            "--calibration FILE"
        )
    return np.eye(3)


def _metres_doubt(rig: Rig, right: CameraInfo) -> str | None:
    """Return the doubt about a P[0, 3] that makes less than any baseline, with the readings that
    make one; None: it makes one, or none does.
    """
    baseline = float(np.linalg.norm(rig.right[1][:3, 3]))
    stated = abs(float(right.P[0, 3]))
    if baseline >= _MIN_BASELINE_M:
        return None
    readings = []
    if _MIN_BASELINE_M < stated < _MAX_BASELINE_M:
        readings.append(
            f"if it is the baseline itself, {stated:g} m, multiply it by the focal length"
        )
    if _MIN_BASELINE_M < 1000 * baseline < _MAX_BASELINE_M:
        readings.append(
            f"if it was divided by 1000 once too often, the baseline is {1000 * baseline:.3g} m"
        )
    if not readings:
        return None
    return (
        f"{right.where}: doubtful: P[0, 3] is -focal * baseline, so that {right.P[0, 3]:g} makes a "
        f"baseline of {baseline:.2g} m; {'; '.join(readings)}"
    )


def _mono_rig(info: CameraInfo, *, rectified: bool) -> Rig:
    K, name = (info.P[:, :3], "P") if rectified else (info.K, "K")
    if not K[0, 0] > 0:
        raise CalibrationError(
            f"{info.where}: not calibrated ({name} is zero); give a calibration file"
        )
    return Rig(_camera(info, rectified=rectified))


def _rectified_shift(left: CameraInfo, right: CameraInfo) -> FloatArray:
    """Return the translation (3,) from the rectified left to the rectified right camera in m.

    Raises:
        CalibrationError: it is none of a pair, or the cameras are swapped.
    """
    for info in (left, right):
        check_projection(info.P, info.K @ info.R, f"{info.where}: P")
    offsets = [np.linalg.solve(info.P[:, :3], info.P[:, 3]) for info in (left, right)]
    shift: FloatArray = offsets[1] - offsets[0]
    if (fault := vertical_fault(shift)) is not None:
        raise CalibrationError(f"{right.where}: {fault}")
    if not shift[0] < 0:
        raise CalibrationError(f"{right.where}: {_no_baseline(right, float(-shift[0]))}")
    return shift


def _no_baseline(right: CameraInfo, baseline: float) -> str:
    """Return why a pair has no positive baseline by its right CameraInfo, and what to do."""
    stated = float(right.P[0, 3])
    if baseline != 0.0:
        return (
            f"P gives a stereo baseline of {baseline:g} m, not a positive one (P[0, 3] of the right "
            "camera is -focal * baseline); the cameras are swapped, or its sign is wrong: if this "
            f"is the right camera, it is {-abs(stated):g}"
        )
    remedy = "give the pair's calibration with --calibration FILE"
    if stated == 0.0:
        return (
            "P[0, 3] is 0 here and of the left camera, so no baseline is stated, as of cameras that "
            f"were calibrated one by one; {remedy}"
        )
    return (
        f"P[0, 3] is {stated:g} here and of the left camera, so both are at one place; that of the "
        f"left camera is 0 by ROS's convention: correct its CameraInfo, or {remedy}"
    )


def _camera(info: CameraInfo, *, rectified: bool) -> CameraModel:
    model, D = ("pinhole", ()) if rectified else _lens(info)
    K, name = (info.P[:, :3], "P") if rectified else (info.K, "K")
    with naming(info.where):
        return camera_from_matrix(K, info.width, info.height, model, D, name)


def _lens(info: CameraInfo) -> tuple[DistortionModel, tuple[float, ...]]:
    model = lens_model(info.model or "plumb_bob", info.where)
    with naming(info.where):
        return model, coefficients_of(model, info.D)
