"""Stereo rectification: a rotation and a lookup map for each of two cameras.

The rectified cameras share the direction of the baseline as x axis, and the mean of the two optical
axes, made perpendicular to it, as z axis. References: Fusiello, Trucco & Verri, A compact algorithm
for rectification of stereo pairs (2000); Loop & Zhang, Computing rectifying homographies for stereo
vision (1999) on splitting the rotation.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.dataclass import dataclass
from vio.errors import CalibrationError
from vio.geometry.distortion import CameraModel, StereoRig, project_point, unproject_pixel
from vio.geometry.lie import FloatArray, se3_from_parts, se3_inverse
from vio.geometry.stereo import (
    PROJECTIONS,
    Projection,
    StereoCamera,
    left_rays,
    one_camera,
    project,
)
from vio.numerics.kinds import Capacity, Tolerance

MapArray = npt.NDArray[np.float32]
Interpolation: TypeAlias = Literal["linear", "cubic", "lanczos4"]
ProjectionMode: TypeAlias = Literal["auto", "pinhole", "cylinder"]


class _ViewRules(NamedTuple):
    """What of the lenses' views is kept."""

    # points along each image border that determine the common field of view
    border_samples: Tolerance[int] = 60
    # beyond about 54 degrees off axis a planar image only stretches pixels
    max_tangent: float = 1.4
    min_tangent_width: float = 0.1
    # a camera that needs a larger rotation is not one half of a stereo pair
    max_rotation_deg: float = 30.0


_VIEW = _ViewRules()
PINHOLE_REACH = float(np.arctan(_VIEW.max_tangent))  # radians
# Of a cylinder's rows, azimuths: further round, the rays of a lens of 195 degrees are its dark rim.
_MAX_ROW = {"pinhole": _VIEW.max_tangent, "cylinder": np.pi / 2}
_ROWS: Capacity[int] = (
    16  # of a map, computed at a time: the arrays between stay in the processor's cache
)


@dataclass(frozen=True, slots=True)
class RectifiedPair:
    """The rectified cameras of a rig."""

    camera: StereoCamera
    R_rect_cam0: FloatArray  # (3, 3)
    R_rect_cam1: FloatArray  # (3, 3)
    T_rect0_imu: FloatArray  # (4, 4) extrinsics of the rectified left camera


def projection_of(rig: StereoRig) -> Projection:
    """Return the projection that keeps most of what a rig sees: a cylinder where a pinhole would
    crop rows.

    A pinhole ends 54 degrees above and below the axis, a cylinder does not; along the baseline both
    end there. So only lenses that see further than that above and below, in both images, have
    anything to gain.

    Raises:
        CalibrationError: as `rectified_cameras`.
    """
    R0, R1, _ = rectifying_rotations(rig)
    low, high = _common_rectangle(rig, R0, R1, "cylinder")
    if low[1] < -PINHOLE_REACH and high[1] > PINHOLE_REACH:
        return "cylinder"
    return "pinhole"


def rectified_cameras(rig: StereoRig, projection: ProjectionMode = "pinhole") -> RectifiedPair:
    """Find the rectified pair of a rig; its images have the size of the left one and no invalid
    border.

    Raises:
        CalibrationError: the cameras coincide, diverge, are swapped, or share no field of view.
    """
    R_rect_cam0, R_rect_cam1, baseline_m = rectifying_rotations(rig)
    chosen = projection_of(rig) if projection == "auto" else projection
    low, high = _common_rectangle(rig, R_rect_cam0, R_rect_cam1, chosen)
    extent = high - low
    if extent.min() < _VIEW.min_tangent_width:
        raise CalibrationError(
            "the two cameras share no field of view; check the extrinsics T_BS of both cameras"
        )
    width = rig.cam0.width
    height = rig.cam0.height
    # One focal length for both axes, large enough that the shared field of view fills the image
    # along both.
    f = float(max((width - 1) / extent[0], (height - 1) / extent[1]))
    centre = (low + high) / 2
    cu = (width - 1) / 2 - f * centre[0]
    cv = (height - 1) / 2 - f * centre[1]
    camera = StereoCamera(f, f, float(cu), float(cv), baseline_m, width, height, chosen)
    T_cam0_imu = se3_inverse(rig.T_imu_cam0)
    return RectifiedPair(
        camera=camera,
        R_rect_cam0=R_rect_cam0,
        R_rect_cam1=R_rect_cam1,
        T_rect0_imu=se3_from_parts(R_rect_cam0, np.zeros(3)) @ T_cam0_imu,
    )


def rectifying_rotations(rig: StereoRig) -> tuple[FloatArray, FloatArray, float]:
    """Return `R_rect_cam0`, `R_rect_cam1` (3, 3) and the baseline in metres.

    Raises:
        CalibrationError: the cameras coincide, or a rectifying rotation is too large.
    """
    T_cam0_cam1 = rig.T_cam0_cam1
    t = T_cam0_cam1[:3, 3]
    R_cam0_cam1 = T_cam0_cam1[:3, :3]
    baseline_m = float(np.linalg.norm(t))
    if baseline_m < 1e-6:
        raise CalibrationError(
            "both cameras have the same position: the baseline is zero; check both T_BS"
        )
    if (fault := vertical_fault(t)) is not None:
        raise CalibrationError(fault)
    x = t / baseline_m
    forward = np.array([0.0, 0, 1]) + R_cam0_cam1[:, 2]
    z = forward - (forward @ x) * x
    if np.linalg.norm(z) < 1e-6:
        raise CalibrationError(
            "the cameras look along their baseline, or in opposite directions; check both T_BS"
        )
    z /= np.linalg.norm(z)
    R_rect_cam0 = np.stack([x, np.cross(z, x), z])
    R_rect_cam1 = R_rect_cam0 @ R_cam0_cam1
    for name, R in (("left", R_rect_cam0), ("right", R_rect_cam1)):
        angle_deg = np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))
        if angle_deg > _VIEW.max_rotation_deg:
            raise CalibrationError(
                f"rectifying would rotate the {name} camera by {angle_deg:.0f} deg; cam1 must be "
                "to the right of cam0, "
                "so the cameras may be swapped, or an extrinsic T_BS inverted"
            )
    return R_rect_cam0, R_rect_cam1, baseline_m


def vertical_fault(t: FloatArray) -> str | None:
    """Return what is wrong where one camera is above the other; None: they are side by side.

    Args:
        t: position (3,) of the right camera in the left one, or of the left one in the right, m.
    """
    across, down, ahead = np.abs(t)
    if down <= max(across, ahead):
        return None
    return (
        f"a vertical pair: the cameras are {down:g} m apart along their y axes, and "
        f"{across:g} m along x; turn the images of both by 90 degrees and calibrate these, so that "
        "the cameras are side by side"
    )


def rectify_pixels(
    camera: CameraModel, R_rect_cam: FloatArray, rectified: StereoCamera, uv: npt.ArrayLike
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Rectified pixels (N, 2) of raw pixels (N, 2) of one camera, and a mask (N,) of valid ones.

    Both rectified cameras share their intrinsics, so this applies to left and right alike.
    """
    ray, valid = unproject_pixel(camera, uv)
    plane, ahead = _on_plane(ray @ R_rect_cam.T, rectified.projection, 1e-6)
    valid = valid & ahead
    return plane * (rectified.fu, rectified.fv) + (rectified.cu, rectified.cv), valid


def field_of_view(camera: CameraModel | StereoCamera) -> tuple[float, float]:
    """Angles in radians that an image spans along its middle row and its middle column, as far as
    the lens model goes.

    Raises:
        CalibrationError: the image size is unknown.
    """
    if camera.width is None or camera.height is None:
        raise CalibrationError("a field of view needs the image size; this camera has none")
    w = camera.width - 1.0
    h = camera.height - 1.0
    s = np.linspace(0, 1, 2 * _VIEW.border_samples + 1)
    spans = []
    middle_row = np.stack([w * s, 0 * s + h / 2], axis=1)
    middle_column = np.stack([0 * s + w / 2, h * s], axis=1)
    for uv in (middle_row, middle_column):
        ray, valid = (
            (left_rays(camera, uv), None)
            if isinstance(camera, StereoCamera)
            else unproject_pixel(camera, uv)
        )
        off_axis = np.arctan2(np.hypot(ray[:, 0], ray[:, 1]), ray[:, 2])
        if valid is not None:
            off_axis = np.where(valid, off_axis, 0.0)
        spans.append(
            float(
                off_axis[: _VIEW.border_samples + 1].max() + off_axis[_VIEW.border_samples :].max()
            )
        )
    return spans[0], spans[1]


def pinhole_within(camera: StereoCamera) -> StereoCamera:
    """Return a pinhole of a cylinder's size and pose whose image lies inside the cylinder's; a
    pinhole as it is.

    Raises:
        CalibrationError: the image size is unknown.
    """
    if not camera.is_cylinder:
        return camera
    if camera.width is None or camera.height is None:
        raise CalibrationError("a cylinder needs its image size; this camera has none")
    size = np.array([camera.width - 1.0, camera.height - 1.0])
    centre = np.array([camera.cu, camera.cv])
    focal = np.array([camera.fu, camera.fv])
    low = np.clip(-centre / focal, -1.2, 1.2)
    high = np.clip((size - centre) / focal, -1.2, 1.2)
    low[1] = np.tan(low[1])
    high[1] = np.tan(high[1])
    low = np.maximum(low, -_VIEW.max_tangent)
    high = np.minimum(high, _VIEW.max_tangent)
    f = float(np.max(size / (high - low)))
    cu, cv = (size / 2 - f * (low + high) / 2).tolist()
    return StereoCamera(f, f, cu, cv, camera.baseline_m, camera.width, camera.height)


def pinhole_pixels(
    cylinder: StereoCamera, pinhole: StereoCamera, pixels: npt.ArrayLike
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Pixels (N, 2) of a pinhole where a cylinder of the same pose has (N, 2), and a mask (N,) of
    those in its image.

    Both cameras of a pair share their intrinsics, so this applies to left and right alike.
    """
    assert pinhole.width is not None
    assert pinhole.height is not None
    plane, ahead = _on_plane(left_rays(cylinder, pixels), "pinhole", 1e-3)
    uv = plane * (pinhole.fu, pinhole.fv) + (pinhole.cu, pinhole.cv)
    inside = (uv >= -0.5).all(axis=-1) & (uv <= (pinhole.width - 0.5, pinhole.height - 0.5)).all(
        axis=-1
    )
    return uv, ahead & inside


def pinhole_maps(cylinder: StereoCamera, pinhole: StereoCamera) -> tuple[MapArray, MapArray]:
    """Pixels u and v (H, W) of a cylinder's image for every pixel of a pinhole's of the same
    pose, for cv2.remap.
    """
    assert pinhole.width is not None
    assert pinhole.height is not None
    pixels = np.stack(np.meshgrid(np.arange(pinhole.width), np.arange(pinhole.height)), axis=-1)
    uv = project(cylinder, left_rays(pinhole, pixels))
    return uv[..., 0].astype(np.float32), uv[..., 1].astype(np.float32)


def _on_plane(
    ray: FloatArray, projection: Projection, least_depth: float
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Coordinates (..., 2) of unit rays (..., 3) in a rectified image of focal length 1, and a mask
    (...).

    Tangents for a pinhole; tangent and azimuth (radians) for a cylinder.
    """
    rows = PROJECTIONS[projection]
    y = ray[..., 1]
    z = ray[..., 2]
    depth = rows.depth(y, z)
    ahead = np.asarray(depth > least_depth)
    depth = np.where(ahead, depth, 1.0)
    plane = np.stack([ray[..., 0] / depth, rows.row(y, z, depth, 1.0)], axis=-1)
    return plane, ahead


def _common_rectangle(
    rig: StereoRig, R_rect_cam0: FloatArray, R_rect_cam1: FloatArray, projection: Projection
) -> tuple[FloatArray, FloatArray]:
    """Corners (2,), (2,) of the largest box, in coordinates of `_on_plane`, inside the outlines
    of both images.
    """
    low0, high0 = _inner_rectangle(rig.cam0, R_rect_cam0, projection)
    low1, high1 = _inner_rectangle(rig.cam1, R_rect_cam1, projection)
    return np.maximum(low0, low1), np.minimum(high0, high1)


def _inner_rectangle(
    camera: CameraModel, R_rect_cam: FloatArray, projection: Projection
) -> tuple[FloatArray, FloatArray]:
    """Corners (2,), (2,) of the largest box, in coordinates of `_on_plane`, inside the image's
    outline.
    """
    w = camera.width - 1.0
    h = camera.height - 1.0
    s = np.linspace(0, 1, _VIEW.border_samples)
    none = 0 * s
    sides = {
        "left": np.stack([none, h * s], axis=1),
        "right": np.stack([none + w, h * s], axis=1),
        "top": np.stack([w * s, none], axis=1),
        "bottom": np.stack([w * s, none + h], axis=1),
    }
    plane = {}
    for name, uv in sides.items():
        ray, valid = unproject_pixel(camera, uv)
        on_plane, ahead = _on_plane(ray @ R_rect_cam.T, projection, 0.1)
        ahead = valid & ahead
        # A border point behind the camera, or outside the lens model's range, sets no bound.
        direction = {"left": [-1, 0], "right": [1, 0], "top": [0, -1], "bottom": [0, 1]}[name]
        far = np.array(direction, dtype=np.float64) * 1e9
        plane[name] = np.where(ahead[:, None], on_plane, far)
    most = np.array([_VIEW.max_tangent, _MAX_ROW[projection]])
    top = max(plane["top"][:, 1].max(), -most[1])
    bottom = min(plane["bottom"][:, 1].min(), most[1])
    # the corners of a wide lens look backwards, beyond the rows that are kept
    if projection == "cylinder":
        for name, bound in (("left", -np.inf), ("right", np.inf)):
            kept = (plane[name][:, 1] >= top) & (plane[name][:, 1] <= bottom)
            plane[name][~kept, 0] = bound
    low = np.array([plane["left"][:, 0].max(), top])
    high = np.array([plane["right"][:, 0].min(), bottom])
    return np.maximum(low, -most), np.minimum(high, most)


def lookup(
    rectified: StereoCamera, camera: CameraModel, R_rect_cam: FloatArray
) -> tuple[MapArray, MapArray]:
    """Return source u and v (H, W) of each pixel of a rectified image in that of its raw camera,
    for cv2.remap.
    """
    assert rectified.width is not None
    assert rectified.height is not None
    u, v = np.empty((2, rectified.height, rectified.width), dtype=np.float32)
    for top in range(0, rectified.height, _ROWS):
        rows = np.arange(top, min(top + _ROWS, rectified.height))
        pixels = np.stack(np.meshgrid(np.arange(rectified.width), rows), axis=-1)
        uv, valid = project_point(camera, left_rays(rectified, pixels) @ R_rect_cam)
        uv[~valid] = -1e4
        u[rows] = uv[..., 0]
        v[rows] = uv[..., 1]
    return u, v


def undistorted(camera: CameraModel) -> tuple[StereoCamera, tuple[MapArray, MapArray]]:
    """Return one camera without its distortion, looking the same way, and the map of its images.

    The images keep their size and have no invalid border.
    """
    low, high = _inner_rectangle(camera, np.eye(3), "pinhole")
    span = high - low
    f = float(max((camera.width - 1) / span[0], (camera.height - 1) / span[1]))
    last_pixel = np.array([camera.width - 1, camera.height - 1])
    cu, cv = last_pixel / 2 - f * (low + high) / 2
    out = one_camera(f, f, float(cu), float(cv), camera.width, camera.height)
    return out, lookup(out, camera, np.eye(3))
