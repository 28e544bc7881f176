"""COLMAP models: two pinhole cameras in a rig, a frame for each keyframe, points with tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pycolmap

from vio.errors import DataError
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.stereo import HALF_PX, StereoCamera
from vio.offline.points import PointTracks
from vio.records import IntArray

ColourArray = npt.NDArray[np.uint8]

LEFT = 1  # camera ids
RIGHT = 2
RIG = LEFT  # as its reference
_GRAY = 128  # of points without an image


@dataclass(frozen=True, slots=True)
class ModelImages:
    """Image files of a model's keyframes."""

    left: tuple[str, ...]  # K names relative to the folder of images
    right: tuple[str, ...]

    def below(self, folder: str) -> ModelImages:
        """Return the same names with a parent folder as prefix."""
        left, right = (
            tuple(f"{folder}/{name}" for name in side) for side in (self.left, self.right)
        )
        return ModelImages(left, right)


def keyframe_images(frames: IntArray) -> ModelImages:
    """Name the image files of keyframes by frame numbers (K,): left images in one folder, right
    ones in another.
    """
    left, right = (
        tuple(f"{side}/{k:06d}.png" for k in frames.tolist()) for side in ("left", "right")
    )
    return ModelImages(left, right)


def numbered_images(count: int) -> ModelImages:
    """Name the images of a model that is never written."""
    return ModelImages(tuple(f"{k}" for k in range(count)), tuple(f"{k}r" for k in range(count)))


def pinhole(camera_id: int, size: tuple[int, int], params: Sequence[float]) -> pycolmap.Camera:
    """Return a camera with an image of (width, height) pixels and `params` fu, fv, cu, cv in
    COLMAP's pixels.
    """
    return pycolmap.Camera(
        camera_id=camera_id,
        model="PINHOLE",
        width=size[0],
        height=size[1],
        params=list(params),
        has_prior_focal_length=True,
    )


def rig_model(
    size: tuple[int, int], params: Sequence[float], cam1_from_cam0: pycolmap.Rigid3d
) -> pycolmap.Reconstruction:
    """Return an empty model of two equal cameras, as `pinhole` makes them, in a rig whose
    reference is the left one.
    """
    model = pycolmap.Reconstruction()
    for camera_id in (LEFT, RIGHT):
        model.add_camera(pinhole(camera_id, size, params))
    rig = pycolmap.Rig(rig_id=RIG)
    rig.add_ref_sensor(model.camera(LEFT).sensor_id)
    rig.add_sensor(model.camera(RIGHT).sensor_id, cam1_from_cam0)
    model.add_rig(rig)
    return model


def without_scale(T_cam1_cam0: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotation `R_cam1_cam0` (3, 3) and unit direction (3,) from cam0 to cam1 in cam0, of
    a transform (4, 4).
    """
    R = T_cam1_cam0[:3, :3]
    direction = -R.T @ T_cam1_cam0[:3, 3]
    return R, direction / np.linalg.norm(direction)


def build_model(
    camera: StereoCamera,
    T_world_cam0: FloatArray,
    tracks: PointTracks,
    names: ModelImages,
    colours: ColourArray | None = None,
) -> pycolmap.Reconstruction:
    """Build a COLMAP model: two pinhole cameras in a rig, a frame for each keyframe, points with
    tracks and colours.

    Args:
        camera: the rectified pair; its image size must be known.
        T_world_cam0: (K, 4, 4) poses of the keyframes, metres.
        tracks: the points.
        names: image files of the keyframes.
        colours: (M, 3) of the points; None: gray.

    Raises:
        DataError: the image size is unknown.
    """
    if camera.width is None or camera.height is None:
        raise DataError(
            "a COLMAP model needs the image size, which these features lack; run on images"
        )
    params = [camera.fu, camera.fv, camera.cu + HALF_PX, camera.cv + HALF_PX]
    model = rig_model((camera.width, camera.height), params, rectified_rig(camera))
    begins = np.searchsorted(tracks.keyframe, np.arange(len(T_world_cam0) + 1))
    right_index = np.full(len(tracks.point), -1, dtype=np.int64)
    for k, T_cam0_world in enumerate(se3_inverse(T_world_cam0)):
        rows = slice(int(begins[k]), int(begins[k + 1]))
        z = tracks.z[rows]
        right = tracks.has_right[rows]
        right_index[rows][right] = np.arange(int(right.sum()))
        add_frame(model, k, T_cam0_world, names, z[:, :2], z[right, 2:])
    _add_points(model, tracks, begins, right_index, colours)
    model.update_point_3d_errors()
    return model


def _add_points(
    model: pycolmap.Reconstruction,
    tracks: PointTracks,
    begins: IntArray,
    right_index: IntArray,
    colours: ColourArray | None,
) -> None:
    """Add the points with their tracks and colours (M, 3) to a model that has the frames.

    The pixels of a keyframe's left image are its rows from `begins` (K + 1,) on, in order;
    `right_index` (R,) is the index of each row among the pixels of its right image, -1 where it has
    none.
    """
    by_point = np.argsort(tracks.point, kind="stable")
    parts = np.searchsorted(tracks.point[by_point], np.arange(len(tracks.ids) + 1))
    for m, p in enumerate(tracks.p_world):
        elements = []
        for row in by_point[parts[m] : parts[m + 1]].tolist():
            k = int(tracks.keyframe[row])
            elements.append(pycolmap.TrackElement(image_id(k, LEFT), row - int(begins[k])))
            if tracks.has_right[row]:
                elements.append(pycolmap.TrackElement(image_id(k, RIGHT), int(right_index[row])))
        if colours is None:
            colour = np.full(3, _GRAY, dtype=np.uint8)
        else:
            colour = colours[m]
        model.add_point3D(p, pycolmap.Track(elements), colour)


def image_id(keyframe: int, camera_id: int) -> int:
    """Return the id of a keyframe's image by one camera in a model."""
    return 2 * keyframe + camera_id


def frame_id(keyframe: int) -> int:
    """Return the id of a keyframe in a model."""
    return keyframe + 1


def rectified_rig(camera: StereoCamera) -> pycolmap.Rigid3d:
    """Return the rig of a rectified pair."""
    return pycolmap.Rigid3d(pycolmap.Rotation3d(), -np.array([camera.baseline_m, 0.0, 0.0]))


def add_frame(
    model: pycolmap.Reconstruction,
    keyframe: int,
    T_cam0_world: FloatArray,
    names: ModelImages,
    left: FloatArray,
    right: FloatArray,
) -> None:
    """Add a keyframe with both images.

    Args:
        model: already contains cameras and rig.
        keyframe: its index.
        T_cam0_world: (4, 4).
        names: image files of all keyframes.
        left: (N, 2) pixels in the left image, in our convention.
        right: (M, 2) in the right one.
    """
    images = [
        pycolmap.Image(
            name=name,
            camera_id=camera_id,
            image_id=image_id(keyframe, camera_id),
            points2D=pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in uv + HALF_PX]),
        )
        for name, camera_id, uv in (
            (names.left[keyframe], LEFT, left),
            (names.right[keyframe], RIGHT, right),
        )
    ]
    frame = pycolmap.Frame(frame_id=frame_id(keyframe), rig_id=RIG)
    for image in images:
        image.frame_id = frame.frame_id
        frame.add_data_id(image.data_id)
    frame.rig_from_world = pycolmap.Rigid3d(np.ascontiguousarray(T_cam0_world[:3]))
    model.add_frame(frame)
    for image in images:
        model.add_image(image)
    model.register_frame(frame.frame_id)


def pose_rows(T: pycolmap.Rigid3d | None) -> FloatArray:
    """Convert a transform of COLMAP to (4, 4)."""
    assert T is not None
    out = np.eye(4)
    out[:3] = T.matrix()
    return out


def mean_reprojection_error_px(model: pycolmap.Reconstruction) -> float:
    """Return COLMAP's mean reprojection error: the mean over points of their mean residual
    length.
    """
    model.update_point_3d_errors()
    return float(model.compute_mean_reprojection_error())
