"""The rectified stereo camera: projection, its Jacobian, triangulation and its uncertainty.

Pixels: u right, v down, the centre of the top-left pixel is (0, 0). `z = [ul vl ur vr]`.

Two projections have epipolar planes as rows. With `rho = hypot(y, z)`, the distance from the line
of the baseline:

    pinhole    u = cu + fu x / z,    v = cv + fv y / z
    cylinder   u = cu + fu x / rho,  v = cv + fv atan2(y, z)

The cylinder about the baseline is the pinhole turned about the baseline to each row: it agrees with
the pinhole to first order in the middle row, disparity is `fu baseline / rho`, and rows reach
beyond 90 degrees off the axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from numbers import Integral, Real
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from vio.dataclass import dataclass
from vio.errors import CalibrationError
from vio.geometry.lie import FloatArray

Projection: TypeAlias = Literal["pinhole", "cylinder"]
CameraKind: TypeAlias = Literal["stereo", "rgbd", "mono"]
# Of one camera, metres: no distance in the world, but the unit of length of inverse depths. Half of
# it is the nearest depth, and a track enters the estimate once its inverse depth is known as well
# as by a stereo pair of this baseline.
MONO_UNIT_M = 0.1
DEPTH_DISPARITY_PX = 0.5  # of a pair; less is within its noise, and gives no depth
# coordinates of programs that count pixels from the corner of the first one, minus ours, which
# count from its centre
HALF_PX = 0.5


class _BaselineRules(NamedTuple):
    """Baselines of usual units."""

    min_m: float = 0.005  # baselines outside are those of another unit
    max_m: float = 5.0


_BASELINE = _BaselineRules()
_YZ: TypeAlias = tuple[FloatArray | float, FloatArray | float]


class PinholeRows:
    """Where a pinhole differs from a cylinder: depths and rows of points with coordinates y and z
    (...), metres.

    Columns follow from the depth. Rows are counted from the principal point, in the unit of the
    focal length.
    """

    def depth(self, y: FloatArray, z: FloatArray) -> FloatArray:
        """Depth as disparity measures it."""
        return z

    def depth_D_yz(self, y: FloatArray, z: FloatArray, depth: FloatArray) -> _YZ:
        """Derivatives of the depth by y and z."""
        return 0.0, 1.0

    def row(self, y: FloatArray, z: FloatArray, depth: FloatArray, focal: float) -> FloatArray:
        """Row of points of known depth."""
        return focal * y / depth

    def row_D_yz(self, y: FloatArray, z: FloatArray, depth: FloatArray, focal: float) -> _YZ:
        """Derivatives of the row by y and z."""
        return focal / depth, -focal * y / depth**2

    def ray(self, row: FloatArray) -> _YZ:
        """Coordinates y and z of unit depth in a row of focal length 1."""
        return row, 1.0

    def ray_D_row(self, row: FloatArray) -> _YZ:
        """Derivatives of `ray` by the row."""
        return 1.0, 0.0


class _CylinderRows(PinholeRows):
    """The same of a cylinder about the baseline."""

    def depth(self, y: FloatArray, z: FloatArray) -> FloatArray:
        return np.hypot(y, z)

    def depth_D_yz(self, y: FloatArray, z: FloatArray, depth: FloatArray) -> _YZ:
        return y / depth, z / depth

    def row(self, y: FloatArray, z: FloatArray, depth: FloatArray, focal: float) -> FloatArray:
        return focal * np.arctan2(y, z)

    def row_D_yz(self, y: FloatArray, z: FloatArray, depth: FloatArray, focal: float) -> _YZ:
        return focal * (z / depth) / depth, -focal * (y / depth) / depth

    def ray(self, row: FloatArray) -> _YZ:
        return np.sin(row), np.cos(row)

    def ray_D_row(self, row: FloatArray) -> _YZ:
        return np.cos(row), -np.sin(row)


PROJECTIONS: Mapping[Projection, PinholeRows] = {
    "pinhole": PinholeRows(),
    "cylinder": _CylinderRows(),
}


def _check_size(name: str, size: int | None) -> None:
    if size is not None and not (isinstance(size, Integral) and size > 0):
        raise CalibrationError(
            f"the image {name} is a positive whole number of pixels, got {size!r}"
        )


@dataclass(frozen=True, slots=True)
class StereoCamera:
    """A rectified stereo pair: one intrinsic matrix, image rows aligned, cam1 at +baseline on
    cam0's x axis.

    One camera with depth images ("rgbd") is a pair with a virtual right camera:
    `ur = ul - fu baseline / depth`. One camera alone ("mono") has no right pixels; its `baseline_m`
    is a unit of length, `MONO_UNIT_M`.
    """

    fu: float  # focal length, pixels, along u
    fv: float  # focal length, pixels, along v
    cu: float  # principal point, pixels
    cv: float  # principal point, pixels
    baseline_m: float  # distance from cam0 to cam1, positive
    width: int | None = None  # image size in pixels; None where only features are given
    height: int | None = None
    projection: Projection = "pinhole"  # of both images; see above
    # where right pixels come from: a right camera, depth images, or nowhere
    kind: CameraKind = "stereo"
    # by how much pixels are known to be off still (rms): what no lens model of the rig holds
    residual_px: float = 0.0
    # of a rolling shutter, from the exposure of the first row to that of the last, s; stamps are
    # those of the middle row
    readout_s: float = 0.0

    def __post_init__(self) -> None:
        values = (self.fu, self.fv, self.cu, self.cv, self.baseline_m)
        if not all(isinstance(value, Real) for value in values):
            raise CalibrationError(f"camera intrinsics are single numbers, got {values!r}"[:300])
        _check_size("width", self.width)
        _check_size("height", self.height)
        if not np.all(np.isfinite(values)):
            raise CalibrationError(
                f"camera intrinsics are not finite: {values}; check the calibration file"
            )
        if self.fu <= 0 or self.fv <= 0:
            raise CalibrationError(
                f"focal lengths must be positive, got fu={self.fu:g}, fv={self.fv:g}"
            )
        if self.baseline_m <= 0:
            raise CalibrationError(
                f"stereo baseline must be positive, got {self.baseline_m:g} m; a zero or negative "
                "baseline "
                "means that both projection matrices are the same or that the cameras are swapped"
            )

    @property
    def baseline_fault(self) -> str | None:
        """The warning on a baseline that no rig has, as that of a calibration in millimetres; None:
        it is plausible.

        Of stereo pairs; those of one camera and of depth images are made up.
        """
        if self.kind != "stereo" or _BASELINE.min_m <= self.baseline_m <= _BASELINE.max_m:
            return None
        return (
            f"a baseline of {self.baseline_m:g} m is implausible; translations are metres: check "
            "the unit of the "
            "calibration"
        )

    @property
    def is_cylinder(self) -> bool:
        """Whether rows are azimuths about the baseline, in the place of a pinhole's."""
        return self.projection == "cylinder"

    @property
    def M(self) -> FloatArray:
        """The paper's stereo calibration matrix (4, 4) of a pinhole: `z = M pi(q)`."""
        fu = self.fu
        fv = self.fv
        cu = self.cu
        cv = self.cv
        return np.array(
            [
                [fu, 0, cu, 0],
                [0, fv, cv, 0],
                [fu, 0, cu, -fu * self.baseline_m],
                [0, fv, cv, 0],
            ],
            dtype=np.float64,
        )

    @property
    def K(self) -> FloatArray:
        """Intrinsic matrix (3, 3) of both cameras, pixels; of a cylinder, that of the pinhole at
        its middle row.
        """
        return intrinsic_matrix(self.fu, self.fv, self.cu, self.cv)


def intrinsic_matrix(fu: float, fv: float, cu: float, cv: float) -> FloatArray:
    """Return the matrix (3, 3) of a pinhole's focal lengths and principal point, pixels."""
    return np.array(
        [
            [fu, 0, cu],
            [0, fv, cv],
            [0, 0, 1],
        ],
        dtype=np.float64,
    )


def one_camera(
    fu: float, fv: float, cu: float, cv: float, width: int | None = None, height: int | None = None
) -> StereoCamera:
    """Return an undistorted camera without a right one; the arguments are those of
    `StereoCamera`, in pixels.
    """
    return StereoCamera(fu, fv, cu, cv, MONO_UNIT_M, width, height, kind="mono")


def left_alone(camera: StereoCamera) -> StereoCamera:
    """Return the left camera of a pair as one camera."""
    return replace(camera, baseline_m=MONO_UNIT_M, kind="mono")


def depth_of(camera: StereoCamera, p_cam: npt.ArrayLike) -> FloatArray:
    """Depth (...) of points (..., 3) in the cam0 frame, metres, as disparity measures it:
    `fu baseline / disparity`.

    Along the optical axis of a pinhole; from the line of the baseline, and never negative, for a
    cylinder.
    """
    p = np.asarray(p_cam, dtype=np.float64)
    return PROJECTIONS[camera.projection].depth(p[..., 1], p[..., 2])


def facing(
    camera: StereoCamera, pixels: npt.ArrayLike, p_cam: npt.ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Turn the camera about its baseline until left pixels lie in its middle row; a pinhole stays
    as it is.

    About there a cylinder is a pinhole of the same `fu`, `fv`, `cu`, `cv`, to first order along v
    and exactly along u, so that the geometry of pinholes applies to each feature in its own turned
    camera.

    Args:
        camera: rectified pair.
        pixels: left pixels (N, 2).
        p_cam: points or directions (..., N, 3) or (..., 1, 3), cam0 frame.

    Returns:
        The pixels (N, 2), and the points (..., N, 3) in the turned frame of each pixel; a pinhole's
        as given.
    """
    uv = np.asarray(pixels, dtype=np.float64)
    p = np.asarray(p_cam, dtype=np.float64)
    if not camera.is_cylinder:
        return uv, p
    azimuth = (uv[..., 1] - camera.cv) / camera.fv
    s = np.sin(azimuth)
    c = np.cos(azimuth)
    y_p = p[..., 1]
    z_p = p[..., 2]
    x, y, z = np.broadcast_arrays(p[..., 0], c * y_p - s * z_p, s * y_p + c * z_p)
    turned = np.stack([x, y, z], axis=-1)
    return np.stack([uv[..., 0], np.full_like(uv[..., 0], camera.cv)], axis=-1), turned


def project(camera: StereoCamera, p_cam: npt.ArrayLike) -> FloatArray:
    """Stereo pixels (..., 4) of points (..., 3) in the cam0 frame, metres; their depth must not
    be zero.
    """
    p = np.asarray(p_cam, dtype=np.float64)
    depth = depth_of(camera, p)
    out = np.empty((*p.shape[:-1], 4))
    out[..., 0] = camera.fu * p[..., 0] / depth + camera.cu
    out[..., 2] = out[..., 0] - camera.fu * camera.baseline_m / depth
    row = PROJECTIONS[camera.projection].row(p[..., 1], p[..., 2], depth, camera.fv)
    out[..., 1] = out[..., 3] = row + camera.cv
    return out


def left_rays(camera: StereoCamera, pixels: npt.ArrayLike) -> FloatArray:
    """Rays (..., 3) of unit depth (`depth_of`) in the cam0 frame through left pixels (..., 2)."""
    uv = np.asarray(pixels, dtype=np.float64)
    out = np.empty((*uv.shape[:-1], 3))
    out[..., 0] = (uv[..., 0] - camera.cu) / camera.fu
    row = (uv[..., 1] - camera.cv) / camera.fv
    out[..., 1], out[..., 2] = PROJECTIONS[camera.projection].ray(row)
    return out


def z_D_p_cam(camera: StereoCamera, p_cam: npt.ArrayLike) -> FloatArray:
    """Jacobian (..., 4, 3) of `project` with respect to the point in the cam0 frame (pixels per
    metre).
    """
    p = np.asarray(p_cam, dtype=np.float64)
    x = p[..., 0]
    depth = depth_of(camera, p)
    projection = PROJECTIONS[camera.projection]
    yz = p[..., 1], p[..., 2], depth
    out = np.zeros((*p.shape[:-1], 4, 3))
    out[..., 0, 0] = out[..., 2, 0] = camera.fu / depth
    depth_D_y, depth_D_z = projection.depth_D_yz(*yz)
    for column, across in ((0, x), (2, x - camera.baseline_m)):
        u_D_depth = -camera.fu * across / depth**2
        out[..., column, 1] = u_D_depth * depth_D_y
        out[..., column, 2] = u_D_depth * depth_D_z
    out[..., 1, 1], out[..., 1, 2] = projection.row_D_yz(*yz, camera.fv)
    out[..., 3, :] = out[..., 1, :]
    return out


def triangulate(
    camera: StereoCamera, z: npt.ArrayLike, *, min_disparity_px: float = 0.1
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Points (N, 3) in the cam0 frame from stereo pixels (N, 4), and a mask (N,) of valid ones.

    The vertical coordinate is the mean of both images. A disparity `ul - ur` below
    `min_disparity_px` (a point behind the cameras, or too far away) has False in the mask and an
    arbitrary finite point.
    """
    z = np.asarray(z, dtype=np.float64)
    disparity = z[..., 0] - z[..., 2]
    valid = np.isfinite(z).all(axis=-1) & (disparity >= min_disparity_px)
    safe = np.where(valid[..., None], z, 0.0)
    depth = camera.fu * camera.baseline_m / np.where(valid, disparity, 1.0)
    row = (safe[..., 1] + safe[..., 3]) / 2
    middle = np.stack([safe[..., 0], row], axis=-1)
    return left_rays(camera, middle) * depth[..., None], valid


def p_cam_D_z(camera: StereoCamera, z: npt.ArrayLike) -> FloatArray:
    """Jacobian (..., 3, 4) of `triangulate` with respect to the stereo pixels (metres per
    pixel).
    """
    z = np.asarray(z, dtype=np.float64)
    disparity = z[..., 0] - z[..., 2]
    depth = camera.fu * camera.baseline_m / disparity
    depth_D_ul = -depth / disparity
    ray_x = (z[..., 0] - camera.cu) / camera.fu
    row = ((z[..., 1] + z[..., 3]) / 2 - camera.cv) / camera.fv
    projection = PROJECTIONS[camera.projection]
    out = np.zeros((*z.shape[:-1], 3, 4))
    out[..., 0, 0] = depth / camera.fu + ray_x * depth_D_ul
    out[..., 0, 2] = -ray_x * depth_D_ul
    for axis, ray, ray_D_row in zip(
        (1, 2), projection.ray(row), projection.ray_D_row(row), strict=True
    ):
        out[..., axis, 0] = ray * depth_D_ul
        out[..., axis, 2] = -ray * depth_D_ul
        out[..., axis, 1] = out[..., axis, 3] = ray_D_row * depth / (2 * camera.fv)
    return out
