"""Which calibration file a folder holds, of which format it is, and what reads it. A format is a
file here and a line in `_FORMATS`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from vio.cameras.rig import Rig
from vio.datasets.common import image_size as checked_image_size
from vio.datasets.common import naming, npz_names
from vio.datasets.euroc_files import read_camera_yaml, read_imu_yaml
from vio.datasets.kitti_raw import (
    CAMERAS,
    PERSPECTIVE,
    is_driving_stereo,
    read_cam_to_cam,
    read_driving_stereo,
    read_imu_pose,
    read_perspective,
)
from vio.datasets.mat_files import HELD_OBJECT, holds_object
from vio.datasets.rigs import (
    bare,
    basalt,
    boofcv,
    camera_json,
    camodocal,
    depthai,
    dsec,
    edex,
    eth3d,
    matlab,
    monado,
    mrpt,
    okvis,
    orbslam,
    rectified_pair,
    spectacular,
    zed,
)
from vio.datasets.rigs.boofcv import is_boofcv, read_boofcv
from vio.datasets.rigs.camera_info import (
    is_camera_info,
    pair_of_files,
    read_camera_info,
    rig_from_camera_infos,
)
from vio.datasets.rigs.four_seasons import is_four_seasons, read_four_seasons
from vio.datasets.rigs.kalibr import is_camchain, read_camchain
from vio.datasets.rigs.kimera import pair_beside, read_kimera
from vio.datasets.rigs.kitti_odometry import kitti_rig
from vio.datasets.rigs.middlebury import read_middlebury
from vio.datasets.rigs.names import named_calibration
from vio.datasets.rigs.opencv import (
    UNREAD,
    is_opencv,
    read_arrays,
    read_entries,
    rig_from_opencv,
)
from vio.datasets.rigs.plausible import checked_rig
from vio.datasets.rigs.source import Source, stereo_pose_on_imu
from vio.datasets.rigs.virtual_kitti import is_virtual_kitti, read_virtual_kitti
from vio.datasets.sides import side_word
from vio.datasets.yaml_files import Entries, read_json_file
from vio.errors import CalibrationError, DataError
from vio.files.text import text_lines
from vio.geometry.lie import se3_from_parts, se3_inverse

__all__ = ["find_calibration", "load_rig"]

Size = tuple[int, int]

KNOWN = (
    "Kalibr's camchain.yaml or camchain-imucam.yaml, EuRoC's sensor.yaml (mav0), KITTI's calib.txt "
    "or calib_cam_to_cam.txt, OpenCV's stereo .yml, .xml or .npz (M1 D1 M2 D2 R T), ROS's left.yaml and "
    "right.yaml, BoofCV's stereo.xml, or MATLAB's stereo parameters; or the settings of ORB-SLAM, stella_vslam, "
    "VINS, OKVIS, Kimera or SVO, Basalt's, Monado's, DepthAI's or Spectacular AI's JSON, cuVSLAM's EDEX, or a "
    "ZED's SN*.conf; of a rectified pair, lines 'fx: …', cx, cy, baseline (metres) will do"
)
_INI = (".conf", ".ini")
_OTHERS = (
    ".yaml",
    ".yml",
    ".json",
    ".xml",
    *_INI,
    ".npz",
    edex.SUFFIX,
    matlab.SUFFIX,
)  # whose content decides in any folder
_NAMED = "relative_config_imucam"  # in OpenVINS's settings: the file of its cameras
_REPORT_BYTES = 100  # of a text, which show what it is
# what texts of other tools are, by how they begin, and what to give instead
_REPORTS = {
    b"Calibration results": "Kalibr's report in words; give the camchain-….yaml that it wrote beside it",
    b"oST version": "camera_calibration's text; give the left.yaml and right.yaml that it wrote beside it",
    b"Camera list with": "a model of COLMAP, whose cameras have no baseline; give the calibration of the rig",
}
# entries of files that describe no cameras, and what these are
_NO_CAMERAS = {
    "target_type": "a board to calibrate with",
    "gyroscope_noise_density": "an IMU alone",
}
_MAX_OTHERS = 40  # files looked into; a folder with more is no recording's
# whether entries are of a format, and what reads it; the first that fits does
_FORMATS: tuple[tuple[Callable[[Entries], bool], Callable[[Source], Rig]], ...] = (
    (is_camchain, lambda source: read_camchain(source.path, alone=source.cameras == 1)),
    (camodocal.matches, camodocal.read),
    (monado.matches, monado.read),
    (edex.matches, edex.read),
    (spectacular.matches, spectacular.read),
    (okvis.matches, okvis.read),
    (orbslam.matches, orbslam.read),
    (boofcv.matches, boofcv.read),
    (basalt.matches, basalt.read),
    (depthai.matches, depthai.read),
    (zed.matches, zed.read),
    (mrpt.matches, mrpt.read),
    (dsec.matches, dsec.read),
    (camera_json.matches, camera_json.read),
    (matlab.matches, matlab.read),
    (lambda entries: _NAMED in entries, lambda source: _openvins(source)),
    (lambda entries: _is_sensor_sheet(entries), lambda source: _euroc(source)),
    (is_camera_info, lambda source: _camera_infos(source)),
    (is_opencv, lambda source: rig_from_opencv(source.entries, source.where, source.image_size)),
    (rectified_pair.matches, rectified_pair.read),
)


def load_rig(
    path: str | os.PathLike[str],
    *,
    image_size: Size | None = None,
    cameras: Literal[1, 2] | None = None,
) -> Rig:
    """Read the calibration of one camera or of a stereo pair; the format is detected from the
    content.

    Args:
        path: a calibration file, or a folder that holds one.
        image_size: width and height of the images in pixels, for formats that do not state it
            (KITTI's calib.txt, OpenCV). With KITTI's calib_cam_to_cam.txt, the size decides between
            the raw and the rectified cameras.
        cameras: 1: of a pair, the left camera alone; 2: a pair; None: whichever the calibration
            holds.

    Raises:
        CalibrationError: there is no calibration of a known format, an entry is missing or
            impossible, the image size is neither stated nor given, or there is one camera of the
            two asked for; the message names file, entry and remedy.
    """
    if not isinstance(path, str | os.PathLike):
        raise CalibrationError(
            f"a calibration is named by one path, as text or pathlib.Path, not by {type(path).__name__}"
        )
    if cameras not in (None, 1, 2):
        raise CalibrationError(f"cameras is {cameras!r}; give 1, 2 or None")
    if image_size is not None:
        image_size = _checked_size(image_size)
    file = Path(path)
    if not file.exists():
        seen_from = "" if file.is_absolute() else f" in {Path.cwd()}"
        raise CalibrationError(f"{file} does not exist{seen_from}; give {KNOWN}")
    if file.is_dir():
        found = find_calibration(file)
        if found is None:
            raise CalibrationError(f"{file}: holds no calibration; looked for {KNOWN}")
        file = found
    rig = _read(file, image_size, cameras)
    if cameras == 2 and rig.cam1 is None:
        raise CalibrationError(
            f"{file}: is the calibration of one camera; name the pair left.yaml and right.yaml "
            "(ROS), or add cam1 and "
            "its pose (Kalibr)"
        )
    return rig.left_alone() if cameras == 1 else rig


def _checked_size(size: Size) -> Size:
    """Return the width and the height that a caller gives, as whole numbers."""
    try:
        values = np.asarray(size)
    except ValueError:  # as of ((1280, 720), 3)
        values = np.empty(0)
    if values.shape != (2,) or values.dtype.kind not in "iuf":
        raise CalibrationError(
            f"image_size is {size!r}; give the width and the height of the images, as (1280, 720)"
        )
    return checked_image_size(values.tolist(), "image_size")


def find_calibration(folder: Path) -> Path | None:
    """Return the calibration file in a folder; None where there is none.

    Usual names go first; else the content of the files there decides, that of a pair before that
    of one camera, as of settings that name a left.yaml.
    """
    if (named := named_calibration(folder)) is not None:
        is_part = side_word(named.stem) == "left" and _is_part_of_settings(named)
        return _by_content(folder) if is_part else named
    pair = pair_of_files(folder)
    return _by_content(folder) if pair is None else pair[0]


def _by_content(folder: Path) -> Path | None:
    """Return the first file of a folder whose content is that of a known format."""
    files = [f for f in folder.iterdir() if f.suffix.lower() in _OTHERS and f.is_file()]
    # archives are a recording's rather than a calibration
    files.sort(key=lambda file: (_is_archive(file), file))
    known = [file for file in files[:_MAX_OTHERS] if _is_known(file)]
    # the settings name the files of their cameras
    return min(known, key=_is_of_one_camera, default=None)


def _is_archive(file: Path) -> bool:
    return file.suffix.lower() == ".npz"


def _is_known(file: Path) -> bool:
    try:
        # arrays of a recording are not read
        if _is_archive(file) and not is_opencv(dict.fromkeys(npz_names(file), UNREAD)):
            return False
        entries = _entries(file)
    except DataError:
        return False
    return any(fits(entries) for fits, _ in _FORMATS)


def _is_part_of_settings(file: Path) -> bool:
    """Whether a file is a camera's of camodocal, which has no pose: settings beside it have."""
    return _is_known(file) and "model_type" in _entries(file)


def _is_of_one_camera(file: Path) -> bool:
    entries = _entries(file)
    return "model_type" in entries or side_word(file.stem) == "right"


def _entries(path: Path) -> Entries:
    """Return what a file holds, by its suffix."""
    suffix = path.suffix.lower()
    if suffix in (".json", edex.SUFFIX):
        return read_json_file(path)
    if suffix == ".npz":
        return read_arrays(path)
    if suffix == matlab.SUFFIX:
        return matlab.read_mat(path)
    if suffix in (*_INI, ".txt") and not path.read_bytes().startswith(b"%YAML"):
        return zed.read_conf(path)
    if suffix == ".xml":
        return {} if is_boofcv(path) else read_entries(path)
    return read_entries(path)


def _read(path: Path, image_size: Size | None, cameras: int | None) -> Rig:
    suffix = path.suffix.lower()
    if path.name == CAMERAS:
        return checked_rig(_kitti_raw(path, image_size), path)
    if path.name == PERSPECTIVE:
        rect0, rect1, T_rect1_rect0 = read_perspective(path)
        with naming(path):
            return checked_rig(Rig(rect0, rect1, T_rect1_rect0), path)
    if is_four_seasons(path):
        return read_four_seasons(path, image_size)
    if path.name == eth3d.EXTRINSICS:
        return eth3d.read_eth3d(path, image_size)
    if suffix == ".txt" and not mrpt.is_mrpt(path):
        return _read_txt(path, image_size)
    if suffix == ".xml" and is_boofcv(path):
        return read_boofcv(path)
    entries = _entries(path)
    for fits, read in _FORMATS:
        if fits(entries):
            return read(Source(path, entries, image_size, cameras))
    named = [name for name in entries if re.fullmatch(r"cam(era)?_?\d", name)]
    if named and "cam0" not in entries:
        raise CalibrationError(
            f"{path}: names its cameras {', '.join(named)}; Kalibr's are cam0 (left) and cam1: name "
            "them so"
        )
    what = next((what for name, what in _NO_CAMERAS.items() if name in entries), None)
    if what is not None:
        raise CalibrationError(
            f"{path}: describes {what}; give the file of the cameras, as Kalibr's camchain-….yaml"
        )
    if suffix == matlab.SUFFIX and holds_object(path):
        raise CalibrationError(f"{path}: {HELD_OBJECT}")
    raise CalibrationError(f"{path}: is no calibration of a known format; give {KNOWN}")


def _report_of(path: Path) -> str:
    """Return what a text is that a tool writes for people, and what to give; empty: it is none."""
    try:
        with path.open("rb") as file:
            first = file.read(_REPORT_BYTES).lstrip(b"# \t\r\n")
    except OSError:  # which its reader reports
        return ""
    return next((what for begins, what in _REPORTS.items() if first.startswith(begins)), "")


def _read_txt(path: Path, image_size: Size | None) -> Rig:
    if what := _report_of(path):
        raise CalibrationError(f"{path}: is {what}")
    if is_virtual_kitti(path):
        return read_virtual_kitti(path, image_size)
    if is_driving_stereo(path):
        rect0, rect1, T_rect1_rect0 = read_driving_stereo(path)
        with naming(path):
            return checked_rig(Rig(rect0, rect1, T_rect1_rect0), path)
    if bare.is_bare(path):
        return bare.read_bare(path, image_size)
    rig = read_middlebury(path, image_size)
    if rig is not None:
        return rig
    entries = rectified_pair.read_lines(path)
    if rectified_pair.matches(entries):
        return rectified_pair.read(Source(path, entries, image_size))
    if not any(re.match(r"P\d:", line) for _, line in text_lines(path)):
        raise CalibrationError(f"{path}: is no calibration of a known format; give {KNOWN}")
    return kitti_rig(path, image_size)[0]


def _is_sensor_sheet(entries: Entries) -> bool:
    """Return whether entries are those of a camera's `sensor.yaml`."""
    return "T_BS" in entries and ("intrinsics" in entries or "camera_model" in entries)


def _openvins(source: Source) -> Rig:
    """Read the camchain that OpenVINS's settings name, from their folder on."""
    named = source.entries[_NAMED]
    if not isinstance(named, str) or not named.strip():
        raise CalibrationError(
            f"{source.where}: {_NAMED} names no file; write that of the cameras there"
        )
    camchain = source.path.parent / named.strip()
    return read_camchain(camchain, alone=source.cameras == 1)


def _camera_infos(source: Source) -> Rig:
    pair = None if source.cameras == 1 else pair_of_files(source.path)
    infos = [read_camera_info(file) for file in pair or (source.path,)]
    rig = rig_from_camera_infos(infos, image_size=source.image_size)
    if pair is not None:
        return rig
    return _alone(rig, source, stated=bool(infos[0].P[0, 3]))


def _alone(rig: Rig, source: Source, *, stated: bool) -> Rig:
    """Return a rig of one camera with a note where it seems to be one of a pair.

    Args:
        rig: of one camera.
        source: its file.
        stated: whether the file states a baseline.
    """
    if source.cameras == 1 or not (stated or side_word(source.path.stem)):
        return rig
    return rig.noting(
        f"{source.where}: is read as one camera, and seems to be one of a pair, whose other file "
        "is not beside it; name the two left.yaml and right.yaml"
    )


def _euroc(source: Source) -> Rig:
    """Read EuRoC's `cam0/sensor.yaml`, `cam1/sensor.yaml` and, where it is beside them,
    `imu0/sensor.yaml`; of Kimera, the three files of one folder.
    """
    path = source.path
    cameras = source.cameras
    if path.name != "sensor.yaml":
        pair = None if cameras == 1 else pair_beside(path)
        if pair is not None:
            return read_kimera(*pair)
        camera, T_body_cam = read_camera_yaml(path)
        rig = Rig(camera, T_cam0_imu=se3_inverse(T_body_cam))
        return _alone(checked_rig(rig, path), source, stated=False)
    mav = path.parent.parent
    T_body_imu = np.eye(4)
    noise = None
    if (imu := mav / "imu0" / "sensor.yaml").is_file():
        T_body_imu, noise = read_imu_yaml(imu)
    if cameras == 1 or (cameras is None and not (mav / "cam1" / "sensor.yaml").is_file()):
        camera, T_body_cam = read_camera_yaml(path)
        rig = Rig(camera, T_cam0_imu=se3_inverse(T_body_cam) @ T_body_imu, imu_noise=noise)
        rig = checked_rig(rig, path)
        return _alone(rig, source, stated=(mav / "cam1").is_dir())
    (cam0, T_body_cam0), (cam1, T_body_cam1) = (
        read_camera_yaml(mav / name / "sensor.yaml") for name in ("cam0", "cam1")
    )
    T_imu_cam0, T_imu_cam1 = (se3_inverse(T_body_imu) @ T for T in (T_body_cam0, T_body_cam1))
    T_cam1_cam0 = stereo_pose_on_imu(T_imu_cam0, T_imu_cam1, str(mav))
    with naming(mav):
        return checked_rig(Rig(cam0, cam1, T_cam1_cam0, se3_inverse(T_imu_cam0), noise), mav)


def _kitti_raw(path: Path, image_size: Size | None) -> Rig:
    """Read `calib_cam_to_cam.txt`: the raw gray pair, or KITTI's rectified one where the images
    have its size.
    """
    c = read_cam_to_cam(path)
    T_cam0_imu, notes = read_imu_pose(path.parent)
    raw = (c.cam0.width, c.cam0.height)
    rectified = (c.rect0.width, c.rect0.height)
    if image_size is not None and image_size not in (raw, rectified):
        raise CalibrationError(
            f"{path}: is for images of {raw[0]} x {raw[1]} (raw) or {rectified[0]} x "
            f"{rectified[1]} (rectified), not "
            f"{image_size[0]} x {image_size[1]} pixels; give the calibration of these images"
        )
    with naming(path):
        if image_size == rectified != raw:
            turn = se3_from_parts(c.R_rect_cam0, np.zeros(3))
            T = None if T_cam0_imu is None else turn @ T_cam0_imu
            return Rig(c.rect0, c.rect1, c.T_rect1_rect0, T, notes=notes)
        return Rig(c.cam0, c.cam1, c.T_cam1_cam0, T_cam0_imu, notes=notes)
