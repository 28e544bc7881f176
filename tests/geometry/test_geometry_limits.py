"""Limits of cameras, rectification and robust statistics, from both sides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest

from vio.cameras.rig import with_virtual_baseline
from vio.errors import CalibrationError
from vio.geometry import rectify
from vio.geometry.distortion import CameraModel, StereoRig, rectified_pair
from vio.geometry.lie import FloatArray, rigid_fault, so3_exp
from vio.geometry.stereo import one_camera
from vio.geometry.upright import upright_axes
from vio.numerics import compiling
from vio.numerics.compiling import Progress
from vio.numerics.robust import robust_sigma, robust_sigmas

Says = Callable[[float], bool]
LENS = CameraModel(400.0, 400.0, 320.0, 240.0, 640, 480)


def _rig(R: FloatArray | None = None, right: CameraModel = LENS, off_m: float = 0.0) -> StereoRig:
    """A pair whose left camera is turned on the body, and whose right one is off sideways."""
    T0 = np.eye(4)
    T0[:3, :3] = np.eye(3) if R is None else R
    T1 = T0.copy()
    T1[:3, 3] = [0.1, off_m, 0.0]
    return StereoRig(LENS, right, T0, T1)


def _is_rotated_too_far(deg: float) -> bool:
    """Whether a pair is refused that looks aside of its baseline by an angle."""
    try:
        rectify.rectifying_rotations(_rig(so3_exp([0.0, np.radians(deg), 0.0])))
    except CalibrationError:
        return True
    return False


def _shares_view(extent: float) -> bool:
    corner = np.full(2, extent)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rectify, "_common_rectangle", lambda *_: (0.0 * corner, corner))
        try:
            rectify.rectified_cameras(_rig())
        except CalibrationError:
            return False
    return True


def _is_rectified(**changes: Any) -> bool:
    return rectified_pair(_rig(**changes)) is not None


def _right_turned(rad: float) -> bool:
    rig = _rig()
    T = rig.T_imu_cam1.copy()
    T[:3, :3] = so3_exp([0.0, 0.0, rad])
    return rectified_pair(replace(rig, T_imu_cam1=T)) is not None


def _path_leads(level: float) -> bool:
    """Whether the path says what is ahead, where the camera's axis has a level part."""
    T = np.tile(np.eye(4), (2, 1, 1))
    T[:, :3, 2] = [level, 0.0, -np.sqrt(1.0 - level**2)]
    T[1, :3, 3] = [0.0, 5.0, 0.0]
    return bool(upright_axes(T, np.array([0.0, 0.0, 1.0]))[1, 1] > 0.9)


def _is_rotation(deviation: float) -> bool:
    T = np.eye(4)
    T[0, 0] = np.sqrt(1.0 + deviation)
    return rigid_fault(T) is None


def _disparity_noise_px() -> float:
    """Noise of the virtual disparities of depths whose standard deviation is a thousandth of their
    square.
    """
    camera = with_virtual_baseline(one_camera(400.0, 400.0, 320.0, 240.0, 640, 480), 1e-3)
    return camera.fu * camera.baseline_m * 1e-3


def _normal() -> FloatArray:
    shares = (np.arange(1001) + 0.5) / 1001
    return np.array([NormalDist().inv_cdf(share) for share in shares])


def _says_how_many(loops: int) -> bool:
    progress = Progress()
    progress.compiled = loops
    return "of about" in progress.line()


def _is_due(seconds: float) -> bool:
    """Whether a loop that begins so long after the last line gets one."""
    lines: list[object] = []
    now = [100.0]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiling.time, "monotonic", lambda: now[0])
        patch.setattr(compiling, "counted_by", None)
        patch.setattr(compiling.log, "log", lambda *arguments: lines.append(arguments))
        progress = Progress()
        now[0] += seconds
        progress.count()
    return bool(lines)


LIMITS: dict[str, tuple[Says, float, float]] = {
    "rectified: rotation": (_is_rotated_too_far, 27.0, 33.0),
    "rectified: view": (_shares_view, 0.087, 0.113),
    "rectified already: turn": (lambda x: not _right_turned(x), 1.7e-5, 2.3e-5),
    "rectified already: rows": (lambda x: not _is_rectified(off_m=0.1 * x), 0.87e-4, 1.13e-4),
    "rectified already: lens": (
        lambda x: not _is_rectified(right=replace(LENS, fu=400.0 * (1.0 + x))),
        0.87e-6,
        1.13e-6,
    ),
    "upright": (lambda x: not _path_leads(x), 0.087, 0.113),
    "rotation": (lambda x: not _is_rotation(x), 0.87e-3, 1.13e-3),
    "depth images": (lambda x: _disparity_noise_px() < x, 0.25, 0.32),
    "robust": (lambda x: robust_sigma(_normal()) < x, 0.9, 1.1),
    "robust: columns": (lambda x: robust_sigmas(_normal()[:, None])[0] < x, 0.9, 1.1),
    "compiling: loops": (lambda n: not _says_how_many(int(n)), 169, 170),
    "compiling: lines": (_is_due, 9.0, 11.0),
}


@pytest.mark.parametrize(("says", "below", "above"), LIMITS.values(), ids=LIMITS)
def test_limits_of_geometry(says: Says, below: float, above: float) -> None:
    assert not says(below)
    assert says(above)
