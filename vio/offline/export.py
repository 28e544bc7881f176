"""Export of a run: a metric COLMAP model and nerfstudio's transforms."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vio.files.meshes import ply_points
from vio.geometry.lie import FloatArray
from vio.geometry.stereo import HALF_PX, StereoCamera
from vio.offline.colmap.model import (
    ColourArray,
    ModelImages,
    build_model,
    keyframe_images,
    mean_reprojection_error_px,
)
from vio.offline.keyframes import choose_keyframes
from vio.offline.loop_tracks import loop_pairs
from vio.offline.points import PointTracks, build_tracks
from vio.offline.saved_run import SavedRun, write_images
from vio.records import Image, IntArray


@dataclass(frozen=True, slots=True)
class Exported:
    """Counts of the written data."""

    keyframes: int
    images: int
    points: int
    mean_reprojection_error_px: float  # as COLMAP computes it
    loops: int  # whose matches are in the model
    loop_points: int  # points that loops join


def export_colmap(
    run: SavedRun,
    folder: Path,
    *,
    most: int | None,
    images: bool,
    source: str | None,
    progress: Callable[[int, int], None],
) -> Exported:
    """Write `sparse/0`, `images`, `transforms.json` and `points.ply` into an existing, empty
    folder.

    Args:
        run: the run.
        folder: the output folder.
        most: largest number of keyframes; None: as many as needed.
        images: whether to write the rectified images, which give the points their colours.
        source: the recording, if it is not at the path stored in the run.
        progress: called with (done, total) after each keyframe's images.

    Raises:
        VioError: the run has too few views or no consistent track, or its images are not available.
    """
    keyframes = choose_keyframes(run.tracked, most=most)
    T_world_cam0 = run.tracked.trajectory.T_world_body[keyframes]
    tracks = build_tracks(run.tracked, keyframes, T_world_cam0)
    names = keyframe_images(run.tracked.frames[keyframes])
    colours = None
    if images:
        colours = _write_images(run, source, keyframes, tracks, names, folder / "images", progress)
    camera = run.tracked.camera
    model = build_model(camera, T_world_cam0, tracks, names, colours)
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_binary(folder / "sparse" / "0")
    transforms = nerfstudio_transforms(camera, T_world_cam0, names.below("images"))
    (folder / "transforms.json").write_text(transforms, encoding="utf-8")
    (folder / "points.ply").write_bytes(ply_points(tracks.p_world, colours))
    return Exported(
        keyframes=len(keyframes),
        images=2 * len(keyframes) if images else 0,
        points=len(tracks.ids),
        mean_reprojection_error_px=mean_reprojection_error_px(model),
        loops=len(loop_pairs(run.tracked.loops, run.tracked.frames[keyframes])),
        loop_points=len(np.unique(tracks.point[tracks.by_loop])),
    )


def _write_images(
    run: SavedRun,
    source: str | None,
    keyframes: IntArray,
    tracks: PointTracks,
    names: ModelImages,
    folder: Path,
    progress: Callable[[int, int], None],
) -> ColourArray:
    """Write the images of the keyframes; return the colours (M, 3) of the points, as the left
    camera sees them.
    """
    total = np.zeros((len(tracks.ids), 3))
    count = np.zeros((len(tracks.ids), 1))

    def sample_colours(keyframe: int, left: Image) -> None:
        rows = tracks.keyframe == keyframe
        np.add.at(total, tracks.point[rows], _colours_at(left, tracks.z[rows, :2]))
        np.add.at(count, tracks.point[rows], 1)
        progress(keyframe + 1, len(keyframes))

    write_images(run, source, keyframes, names, folder, sample_colours)
    return np.rint(total / np.maximum(count, 1)).astype(np.uint8)


def _colours_at(image: Image, uv: FloatArray) -> FloatArray:
    """Return red, green and blue (N, 3) of the pixels of an image (H, W) or (H, W, 3) nearest to
    (N, 2).
    """
    u = np.clip(np.rint(uv[:, 0]).astype(int), 0, image.shape[1] - 1)
    v = np.clip(np.rint(uv[:, 1]).astype(int), 0, image.shape[0] - 1)
    gray_or_colour = image[v, u].astype(np.float64).reshape(len(uv), -1)
    return np.broadcast_to(gray_or_colour, (len(uv), 3))


def nerfstudio_transforms(
    camera: StereoCamera, T_world_cam0: FloatArray, names: ModelImages
) -> str:
    """Return the text of nerfstudio's `transforms.json`; the point cloud is `points.ply` in the
    same folder.

    Poses are camera to world with x right, y up, z back (OpenGL); the world frame is that of the
    run, metric.
    """
    T_cam0_cam1 = np.eye(4)
    T_cam0_cam1[0, 3] = camera.baseline_m
    to_opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {"file_path": name, "transform_matrix": (T @ to_opengl).tolist()}
        for k, T_world in enumerate(T_world_cam0)
        for name, T in ((names.left[k], T_world), (names.right[k], T_world @ T_cam0_cam1))
    ]
    document = {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fu,
        "fl_y": camera.fv,
        "cx": camera.cu + HALF_PX,
        "cy": camera.cv + HALF_PX,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "ply_file_path": "points.ply",
        "frames": frames,
    }
    return json.dumps(document, indent=1) + "\n"
