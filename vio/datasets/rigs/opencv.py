"""OpenCV's stereo calibrations: FileStorage YAML or XML with the matrices of `stereoCalibrate` and
`stereoRectify`.

`R` and `T` map points of the first camera to the second. Names are those of OpenCV's samples
(`M1 D1 M2 D2 R T` in one file, or in `intrinsics.yml` and `extrinsics.yml`), of common tutorials,
and of ORB-SLAM's `LEFT.K`. With `xi1` and `xi2` (`omnidir::stereoCalibrate`) lenses are unified ones, and
the rotation may be a vector `rvec`. A file with `P1` and `P2` and no raw matrices describes images that are
rectified already.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from zipfile import BadZipFile

import numpy as np

from vio.cameras.rig import Rig, camera_from_matrix
from vio.datasets.common import naming
from vio.datasets.rigs.plausible import check_projection, checked_rig, unit_doubt
from vio.datasets.sides import side_word
from vio.datasets.yaml_files import (
    MAX_BYTES,
    Entries,
    as_number,
    count_numbers,
    lens_model,
    matrix,
    read_yaml_file,
)
from vio.errors import CalibrationError
from vio.files.printable import printable
from vio.geometry.distortion import DistortionModel
from vio.geometry.lie import FloatArray, checked_transform, se3_from_parts, so3_exp
from vio.geometry.rectify import vertical_fault

_NAMES: dict[str, tuple[str, ...]] = {  # ours, then the names in files
    "K0": ("M1", "K1", "cameraMatrix1", "camera_matrix_1", "cameraMatrixL", "K_left", "left_camera_matrix", "LEFT.K",
            "mtxL", "KL", "leftCameraMatrix"),
    "K1": ("M2", "K2", "cameraMatrix2", "camera_matrix_2", "cameraMatrixR", "K_right", "right_camera_matrix",
            "RIGHT.K", "mtxR", "KR", "rightCameraMatrix"),
    "D0": ("D1", "distCoeffs1", "dist_coeffs_1", "distCoeffsL", "D_left", "left_distortion", "LEFT.D", "distL", "DL",
            "distortion_coefficients_1", "distCoeff1", "dist1", "distortion_left",
            "leftDistortionCoefficients"),
    "D1": ("D2", "distCoeffs2", "dist_coeffs_2", "distCoeffsR", "D_right", "right_distortion", "RIGHT.D", "distR",
            "DR", "distortion_coefficients_2", "distCoeff2", "dist2", "distortion_right",
            "rightDistortionCoefficients"),
    "xi0": ("xi1", "xi_1", "xiL", "xi_left"),
    "xi1": ("xi2", "xi_2", "xiR", "xi_right"),
    "R": ("R", "rotation", "Rot", "R_stereo", "rotation_matrix", "rotationMatrix", "Rotation", "rot",
            "rvec", "om"),
    "T": ("T", "translation", "Trns", "T_stereo", "translation_vector", "translationVector",
            "Translation", "trans", "tvec"),
    "R0": ("R1", "LEFT.R", "RL"),
    "R1": ("R2", "RIGHT.R", "RR"),
    "P0": ("P1", "LEFT.P", "projMatrixL", "PL"),
    "P1": ("P2", "RIGHT.P", "projMatrixR", "PR"),
}  # fmt: skip
_NUMBERED = re.compile(r"cam(?:era)?_?\d")  # blocks of Kalibr's form
_LONG_NAME = 6  # letters
_SAME = 1e-6  # share by which numbers that were written with fewer digits differ
_MOST_NUMBERS = 100  # of a matrix; maps of pixels have more
_FEWEST_NUMBERS = 4  # of a matrix, or of the coefficients of a lens
UNREAD = object()  # value of an entry of which the name alone is known
# Words for a matrix, and for a camera's side, of which other names consist: in small letters.
_MATRIX_WORDS = ("cameramatrix", "cammatrix", "cammtx", "intrinsicmatrix", "intrinsics", "intrinsic",
            "matrix", "mtx", "k", "m")  # fmt: skip
_DISTORTION_WORDS = ("distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff",
            "distcoefs", "distcoef", "distortion", "coeffs", "dist", "d")  # fmt: skip
_SIDES = (("left", "right"), ("l", "r"), ("1", "2"), ("cam1", "cam2"))
_SIDES_FROM_ZERO = (("0", "1"), ("cam0", "cam1"))
_ROTATION_VECTORS = ("rvec", "om")  # of `omnidir::stereoCalibrate`
_SIZES = (
    ("image_width", "image_height"),
    ("width", "height"),
    ("imageWidth", "imageHeight"),
    ("LEFT.width", "LEFT.height"),
)
_SIZE_NAMES = ("image_size", "imageSize", "imgSize", "size", "image_Size", "imageResolution")


# what both cameras of a pair have alike
_OF_A_PAIR = (*("distortion_model", "camera_model", "model"), *_SIZE_NAMES, *sum(_SIZES, ()))


def is_opencv(entries: Entries) -> bool:
    """Return whether entries hold matrices of a stereo calibration, raw or rectified."""
    entries = _without_blocks(entries)
    return all(_find(entries, key) is not None for key in ("K0", "K1")) or _is_rectified(entries)


def _without_blocks(entries: Entries) -> dict[str, object]:
    """Return entries with those of blocks, as of `left:` and `right:`, by both names joined.

    What the blocks of both sides state alike, as the lens model, and what a block of no side states,
    as the pose, goes by its own name too.
    """
    flat = dict[str, object]()
    blocks = dict[str, dict[str, object]]()
    for name, value in entries.items():
        of_another_form = _NUMBERED.fullmatch(name) is not None
        if not isinstance(value, dict) or "data" in value or of_another_form:
            flat[name] = value
        else:
            blocks[name] = {str(inner): part for inner, part in value.items()}
            flat |= {f"{name}_{inner}": part for inner, part in blocks[name].items()}
    of_sides = [block for name, block in blocks.items() if side_word(name) is not None]
    others = [block for name, block in blocks.items() if side_word(name) is None]
    alike = dict[str, object]()
    for name in _OF_A_PAIR:
        stated = [block[name] for block in of_sides if name in block]
        if stated and all(value == stated[0] for value in stated):
            alike[name] = stated[0]
    for block in (alike, *others):
        flat = {**block, **flat}
    return flat


def _is_rectified(entries: Entries) -> bool:
    return all(_find(entries, key) is not None for key in ("P0", "P1"))


def read_entries(path: Path) -> dict[str, object]:
    """Read FileStorage's YAML or XML, and `extrinsics` beside `intrinsics`.

    Raises:
        CalibrationError: a file is missing, or neither YAML nor XML.
    """
    read = _read_xml if path.suffix.lower() == ".xml" else read_yaml_file
    entries = read(path)
    for here, there in (("intrinsic", "extrinsic"), ("extrinsic", "intrinsic")):
        beside = path.with_name(path.name.replace(here, there))
        if here in path.name and beside.is_file():
            entries = {**read(beside), **entries}
    return entries


def read_arrays(path: Path) -> dict[str, object]:
    """Read matrices that NumPy saved by their names.

    Raises:
        CalibrationError: the file is no archive of NumPy, or holds pickled objects.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            read = {name: arrays[name] for name in arrays.files}
    except (OSError, ValueError, BadZipFile) as error:
        raise CalibrationError(
            f"{path}: is no archive of NumPy with plain arrays ({printable(str(error))}); save the "
            "matrices of the calibration with numpy.savez"
        ) from error
    return {name: array.tolist() for name, array in read.items() if array.size <= _MOST_NUMBERS}


def rig_from_opencv(entries: Entries, where: str, image_size: tuple[int, int] | None) -> Rig:
    """Return the rig that the entries describe.

    Args:
        entries: as `read_entries` returns them.
        where: the file, for messages.
        image_size: width and height in pixels, used where the file states none.

    Raises:
        CalibrationError: a matrix is missing or impossible, or no image size is known.
    """
    entries = _without_blocks(entries)
    width, height, stated = _size(entries, where, image_size)
    rig = (_rectified if _find(entries, "K0") is None else _raw)(entries, where, width, height)
    rig = checked_rig(rig, where, size_stated=stated)
    baseline = float(np.linalg.norm(rig.right[1][:3, 3]))
    doubt = unit_doubt(baseline, where)
    return rig if doubt is None else rig.noting(doubt)


def _raw(entries: Entries, where: str, width: int, height: int) -> Rig:
    K0, K1 = (_required(entries, key, (3, 3), where) for key in ("K0", "K1"))
    stated = entries.get("distortion_model", entries.get("camera_model", entries.get("model")))
    model = _stated_model(stated, where)
    notes: list[str] = []
    cameras = []
    for K, key, mirror in ((K0, "D0", "xi0"), (K1, "D1", "xi1")):
        found = _find(entries, key)
        D: tuple[float, ...] = ()
        if found is None:
            notes.append(_no_distortion(entries, where))
        else:
            D = tuple(matrix(found, None, f"{where}, {_name(entries, key)}").ravel().tolist())
        lens = model
        if _find(entries, mirror) is not None:
            xi = float(_required(entries, mirror, (1, 1), where)[0, 0])
            lens = "unified"
            D = (xi, *(D if any(D) else ()))
        elif len(D) == 4 and stated is None and any(D):
            notes.append(
                f"{where}: four coefficients without a model's name are read as k1 k2 p1 p2; for a "
                "fisheye lens add "
                "'distortion_model: equidistant'"
            )
        with naming(where):
            cameras.append(camera_from_matrix(K, width, height, lens, coefficients_of(lens, D)))
    pose = _stereo_pose(entries, where)
    with naming(where):
        return Rig(cameras[0], cameras[1], pose, notes=tuple(dict.fromkeys(notes)))


def _stated_model(stated: object, where: str) -> DistortionModel:
    """Return the lens model of a name; that of OpenCV where there is none but the projection's."""
    if stated is None or str(stated).lower() == "pinhole":
        return "radtan"
    return lens_model(stated, where)


def _no_distortion(entries: Entries, where: str) -> str:
    """Return the note that a camera has no distortion coefficients.

    Raises:
        CalibrationError: there are some, by a name that is not known.
    """
    known = {name for names in _NAMES.values() for name in names}
    unread = [name for name in entries if "dist" in name.lower() and name not in known]
    unread = [name for name in unread if isinstance(entries[name], (list, dict))]
    if unread:
        raise CalibrationError(
            f"{where}: the distortion coefficients may be those of {unread[0]!r}, a name that is "
            "not known; rename those of the two cameras D1 and D2"
        )
    return f"{where}: states no distortion coefficients; the lenses are read as having none"


def _stereo_pose(entries: Entries, where: str) -> FloatArray:
    """`T_cam1_cam0` (4, 4) from R and T or, where only the rectification is given, from R1, R2
    and P2.
    """
    if _find(entries, "T") is not None:
        R = _required(entries, "R", None, where)
        if R.size == 3 and _name(entries, "R") in _ROTATION_VECTORS:
            R = so3_exp(R.ravel())
        if R.size == 3:
            raise CalibrationError(
                f"{where}: R holds 3 numbers (a rotation vector); write the 3x3 matrix"
            )
        T = np.ravel(_required(entries, "T", None, where))
        if R.shape != (3, 3) or T.shape != (3,):
            raise CalibrationError(
                f"{where}: R must be 3x3 and T hold 3 numbers, not {R.shape} and {T.shape}"
            )
        return checked_transform(np.column_stack([R, T]), f"{where}, R")
    if _find(entries, "R1") is None:
        missing = [name for name in ("R", "T") if _find(entries, name) is None]
        raise CalibrationError(
            f"{where}: has no {' and no '.join(missing)}, the pose of the right camera; add it, or "
            "put the file that has it beside this one (extrinsics.yml beside intrinsics.yml)"
        )
    R0, R1 = (_required(entries, key, (3, 3), where) for key in ("R0", "R1"))
    P = _required(entries, "P1", None, where)[:3, :4]
    K1 = _required(entries, "K1", (3, 3), where)
    check_projection(P, K1 @ R1, f"{where}: {_name(entries, 'P1')}")
    return checked_transform(
        np.column_stack([R1.T @ R0, R1.T @ np.linalg.solve(P[:, :3], P[:, 3])]),
        f"{where}, rectification",
    )


def _rectified(entries: Entries, where: str, width: int, height: int) -> Rig:
    P0, P1 = (_required(entries, key, (3, 4), where) for key in ("P0", "P1"))
    with naming(where):
        cx = P0[0, 2], P1[0, 2]
        alike = P1[:, :3].copy()
        alike[0, 2] = cx[0]  # without CALIB_ZERO_DISPARITY that of the right camera is its own
        if not np.allclose(P0[:, :3], alike, rtol=_SAME, atol=_SAME):
            raise CalibrationError(
                "P1 and P2 differ in focal length or in cy, as those of no rectified pair do; give "
                "those of one call of stereoRectify"
            )
        camera = camera_from_matrix(P0[:, :3], width, height, name="P1")
        shift = np.asarray(np.linalg.solve(P1[:, :3], P1[:, 3] - P0[:, 3]), dtype=np.float64)
        if (fault := vertical_fault(shift)) is not None:
            raise CalibrationError(fault)
        baseline = -float(shift[0])
        note = f"{where}: holds P1 and P2 only, so the images are taken to be rectified"
        if not np.isclose(*cx, rtol=_SAME):
            right = camera_from_matrix(P1[:, :3], width, height, name="P2")
            T_cam1_cam0 = se3_from_parts(np.eye(3), [-baseline, 0.0, 0.0])
            return Rig(camera, right, T_cam1_cam0, notes=(note,))
        return Rig.rectified(
            camera.fu, camera.fv, camera.cu, camera.cv, baseline, width, height
        ).noting(note)


def coefficients_of(model: DistortionModel, D: Sequence[float]) -> tuple[float, ...]:
    """Return what a lens model takes of OpenCV's coefficients; an absent or shorter list ends in
    zeros.

    A fisheye lens of zeros is the ideal one, of which the radius grows as the angle; it is no
    pinhole.
    """
    if model == "pinhole":
        return ()
    if model == "equidistant":
        if len(D) not in (0, 4) and any(D[4:]):
            raise CalibrationError(f"{len(D)} distortion coefficients; a fisheye lens has 4")
        return tuple([*(float(d) for d in D[:4]), 0.0, 0.0, 0.0, 0.0][:4])
    if model == "radtan":
        return trimmed_coefficients(D)
    return tuple(float(d) for d in D)


def trimmed_coefficients(D: Sequence[float]) -> tuple[float, ...]:
    """Return OpenCV's `k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 .. s4 [tx ty]]]]` without the part that is
    zero.

    Raises:
        CalibrationError: thin-prism or tilt terms are used, or the count is none of OpenCV's.
    """
    if len(D) not in (0, 4, 5, 8, 12, 14):
        raise CalibrationError(f"{len(D)} distortion coefficients; OpenCV has 4, 5, 8, 12 or 14")
    if any(D[8:]):
        raise CalibrationError(
            "thin-prism or tilt coefficients are not read; calibrate without CALIB_THIN_PRISM_MODEL"
        )
    if any(D[5:8]):
        kept = D[:8]
    else:
        kept = D[:5]
    return tuple(float(d) for d in kept)


def _size(
    entries: Entries, where: str, image_size: tuple[int, int] | None
) -> tuple[int, int, bool]:
    """Return width and height in pixels, and whether the file states them."""
    for names in _SIZES:
        found = [as_number(entries.get(name)) for name in names]
        if all(value >= 1 for value in found):
            return int(found[0]), int(found[1]), True
    for name in _SIZE_NAMES:
        if name in entries:
            values = np.ravel(matrix(entries[name], None, f"{where}, {name}"))
            if len(values) == 2 and values.min() >= 1:
                return int(values[0]), int(values[1]), True
    if image_size is None:
        raise CalibrationError(
            f"{where}: states no image size; add 'image_width: W' and 'image_height: H', or pass "
            "image_size=(W, H)"
        )
    return image_size[0], image_size[1], False


def _find(entries: Entries, key: str) -> object | None:
    return entries.get(_name(entries, key))


def _name(entries: Entries, key: str) -> str:
    """Return the name of an entry in the file, else the first that it may have.

    Long names are found in any case; of short ones `k1` is a coefficient and `K1` a matrix.
    """
    from_zero = _of_side(entries, key, _SIDES_FROM_ZERO)
    if from_zero is not None:  # `K1` is the right camera's beside `K0`
        return from_zero
    exact = next((name for name in _NAMES[key] if name in entries), None)
    if exact is not None:
        return exact
    long = {name.lower() for name in _NAMES[key] if len(name) >= _LONG_NAME}
    by_case = next((name for name in entries if name.lower() in long), None)
    return by_case or _of_side(entries, key, _SIDES) or _NAMES[key][0]


def _of_side(entries: Entries, key: str, all_sides: tuple[tuple[str, str], ...]) -> str | None:
    """Return the entry whose name is a word for a camera's matrix, or its distortion, with that of a
    side before or behind it, where the other side has one alike. Numbers alone, as the coefficients
    `k1` and `k2` of one camera, are neither.
    """
    if key not in {"K0", "K1", "D0", "D1"}:
        return None
    words = _MATRIX_WORDS if key[0] == "K" else _DISTORTION_WORDS
    plain = {
        "".join(filter(str.isalnum, str(name))).lower(): str(name)
        for name, value in entries.items()
        if value is UNREAD or count_numbers(value) >= _FEWEST_NUMBERS
    }
    place = int(key[1])
    for word in words:
        for sides in all_sides:
            for pair in ([word + side for side in sides], [side + word for side in sides]):
                if all(name in plain for name in pair):
                    return plain[pair[place]]
    return None


def _required(entries: Entries, key: str, shape: tuple[int, int] | None, where: str) -> FloatArray:
    value = _find(entries, key)
    if value is None:
        raise CalibrationError(
            f"{where}: has no entry {' or '.join(_NAMES[key][:3])}; save the whole stereo "
            "calibration"
        )
    return matrix(value, shape, f"{where}, {_name(entries, key)}")


def _read_xml(path: Path) -> dict[str, object]:
    """Read FileStorage's XML: matrices as blocks of rows, cols and data, other entries as text."""
    root = read_xml(path)
    entries: dict[str, object] = {}
    for child in root:
        data = child.find("data")
        if data is None:
            entries[child.tag] = (child.text or "").strip()
        else:
            block: dict[str, object] = {name: child.findtext(name) for name in ("rows", "cols")}
            block["data"] = (data.text or "").split()
            entries[child.tag] = block
    return entries


def read_xml(path: Path) -> ElementTree.Element:
    """Parse an XML file.

    Raises:
        CalibrationError: the file is missing, declares entities, or is no XML.
    """
    try:
        text = path.read_bytes()
    except OSError as error:
        raise CalibrationError(
            f"cannot read {path}: {error.strerror or error}; give a readable file"
        ) from error
    if b"<!ENTITY" in text or len(text) > MAX_BYTES:
        raise CalibrationError(
            f"{path}: declares entities or is too large for a calibration; give the original file"
        )
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise CalibrationError(f"{path}: not an XML file ({error}); copy it again") from error
