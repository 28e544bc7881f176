"""A run in the rerun viewer, frame by frame.

Reference: rerun's Python SDK, https://ref.rerun.io/docs/python. Entities below `world/run` are in
the world of the run, which `world` turns upright (`vio.geometry.upright`); pixels are those of the
rectified left image.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from vio.geometry.lie import FloatArray, se3_inverse, transform_points
from vio.geometry.stereo import StereoCamera, left_rays
from vio.geometry.upright import rotated, upright_view
from vio.numerics.kinds import Capacity, Tolerance
from vio.records import (
    BoolArray,
    Estimate,
    FrameResult,
    Image,
    IntArray,
    Landmarks,
    LoopEvent,
    Observations,
    Trajectory,
    UpdateReport,
)

if TYPE_CHECKING:
    import rerun as rr

_LEFT = "world/run/camera"  # the left camera; below it, what is drawn into its image
_MARKS = ("features", "tracks_by_age")
_OUTLINE = f"{_LEFT}/outline"  # of what a camera sees whose image is not a pinhole's


@dataclass(frozen=True, slots=True)
class _Picture:
    """What the pictures of the viewer show."""

    side: Tolerance[int] = 25  # points of a side of it
    outline_baselines: float = 5.0  # distance from the camera at which it is drawn
    # of the run's time that images, tracks and points may take; the rest is drawn in every frame
    share: float = 0.08
    widest_px: int = 752  # images are shown at this width at most
    jpeg_quality: int = 75
    # poses of a path that are sent together; the last chunk is sent again with every pose
    chunk: Capacity[int] = 64
    tail: int = 12  # positions of a track that are drawn
    min_disparity_px: float = 3.0  # of points drawn from one stereo pair
    sigmas: float = 3.0
    old_frames: int = 40  # age of a track whose colour is the last of the scale


_PICTURE = _Picture()
_STATES = {
    "used": (31, 95, 191),
    "landmark": (46, 139, 87),
    "gated": (200, 40, 40),
    "stereo, not used": (154, 165, 177),
    "left only": (217, 130, 43),
}
SERIES: dict[str, Sequence[str]] = {
    "features": ("tracked", "matched", "selected", "used", "gated"),
    "innovation": ("median px", "NIS per dof"),
    "time": ("read", "frontend", "filter"),
    "velocity": ("right", "ahead", "up"),
    "gyro_bias": ("x", "y", "z"),
    "accel_bias": ("x", "y", "z"),
    "stereo_calibration": ("a0", "a1", "a2"),
}


@dataclass(frozen=True, slots=True)
class ViewedRig:
    """What the viewer must know of a run before its first frame."""

    camera: StereoCamera
    T_cam0_body: FloatArray  # (4, 4)
    motion: str | None  # the run's motion input
    reference: Trajectory | None


class RerunViewer:
    """Shows a run frame by frame."""

    def __init__(
        self,
        stream: rr.RecordingStream,
        rig: ViewedRig,
        *,
        address: str | None = None,
        share: float = _PICTURE.share,
    ) -> None:
        """Draw what does not change.

        Args:
            stream: of `open_stream`, or any other.
            rig: of the run.
            address: of the page, where the run is shown in a browser.
            share: of the time since the first frame that images, tracks and points may take; 1: all
                of them are shown.
        """
        self._stream = stream
        self._rig = rig
        self._share = share
        self.address = address
        self._T_view_world: FloatArray | None = None
        self._start_ns: int | None = None  # of the first frame that was shown
        self._path: list[FloatArray] = []  # positions of the present chunk
        self._chunks = 0
        # of the image that is shown
        self._scale = min(_PICTURE.widest_px / (rig.camera.width or _PICTURE.widest_px), 1.0)
        self._tails: dict[int, list[FloatArray]] = {}
        self._ages: dict[int, int] = {}
        self._places: dict[int, FloatArray] = {}  # positions of the keyframes of a map, by frame
        self._loops: list[list[FloatArray]] = []  # from a frame to the keyframe that it sees again
        self._spent_s = 0.0
        self._began_s = time.perf_counter()
        self._layout()

    def frame(self, result: FrameResult) -> None:
        """Show one frame."""
        output = result.output
        report = result.report
        chosen = result.selection.chosen
        numbers: dict[str, Sequence[float | None]] = {
            "features": [
                output.tracked,
                output.matched,
                int(chosen.sum()),
                report.used,
                report.gated,
            ],
            "innovation": [report.innovation_median_px, report.nis_per_dof],
            "time": [getattr(result.log, f"{name}_ms") for name in SERIES["time"]],
        }
        states = states_of(output.observations, chosen, report)
        self.show(
            result.frame.index,
            result.estimate,
            numbers,
            result.frame.left,
            output.observations,
            states,
        )
        self.places(
            result.frame.index, result.estimate, is_keyframe=result.is_keyframe, loops=result.loops
        )

    def show(
        self,
        index: int,
        estimate: Estimate,
        numbers: Mapping[str, Sequence[float | None]],
        image: Image | None = None,
        seen: Observations | None = None,
        states: IntArray | None = None,
    ) -> None:
        """Show what is known of one frame.

        Args:
            index: number of the frame.
            estimate: after it.
            numbers: curves by name, see `SERIES`.
            image: left, (H, W).
            seen: its features.
            states: of the features (N,), see `states_of`.
        """
        self._stream.set_time("frame", sequence=index)
        if self._start_ns is None:
            self._start_ns = estimate.time_ns
        self._stream.set_time("recording", duration=1e-9 * (estimate.time_ns - self._start_ns))
        self._pose(estimate)
        self._numbers(estimate, numbers)
        if seen is not None:
            self._follow(seen)
        start = time.perf_counter()
        if self._spent_s <= self._share * (start - self._began_s):
            if image is not None:
                self._image(image)
            if seen is not None and states is not None:
                self._tracks(seen, states)
                self._points(seen, estimate)
            self._spent_s += time.perf_counter() - start

    def places(
        self, index: int, estimate: Estimate, *, is_keyframe: bool, loops: Sequence[LoopEvent]
    ) -> None:
        """Show keyframes of a map, and its loops within this run as lines between the odometry's
        positions.
        """
        import rerun as rr

        if is_keyframe:
            self._places[index] = estimate.T_world_imu[:3, 3]
            marks = rr.Points3D(
                list(self._places.values()),
                colors=_STATES["landmark"],
                radii=rr.Radius.ui_points(3),
            )
            self._stream.log("world/run/keyframes", marks)
        for loop in loops:
            other = (
                "an earlier session"
                if loop.keyframe_frame is None
                else f"frame {loop.keyframe_frame}"
            )
            match = f"{loop.inliers} features, {loop.gap_m:.3f} m off"
            text = f"frame {loop.frame} sees the place of {other} again: {match}"
            self._stream.log("loops", rr.TextLog(text))
            ends = [self._places[k] for k in (loop.frame, loop.keyframe_frame) if k in self._places]
            self._loops += [ends] if len(ends) == 2 else []
        if loops and self._loops:
            lines = rr.LineStrips3D(
                self._loops, colors=_STATES["gated"], radii=rr.Radius.ui_points(2)
            )
            self._stream.log("world/run/loops", lines)

    def landmarks(self, landmarks: Landmarks) -> None:
        """Show the map at the end of the run."""
        import rerun as rr

        self._stream.log(
            "world/run/landmarks", rr.Points3D(landmarks.p_world, radii=rr.Radius.ui_points(1.5))
        )

    def close(self) -> None:
        """Send what is not sent yet."""
        self._stream.flush()

    def _layout(self) -> None:
        import rerun as rr
        import rerun.blueprint as rrb

        plots = rrb.Tabs(
            *(rrb.TimeSeriesView(origin=f"plots/{name}", name=name) for name in SERIES)
        )
        camera = self._rig.camera
        # a pinhole's image is also drawn in space
        flat = (*_MARKS, "image") if camera.is_cylinder else _MARKS
        in_space = ["+ $origin/**", *(f"- /{_LEFT}/{name}" for name in flat)]
        in_image = ["+ $origin/**", f"- /{_OUTLINE}"]
        views = rrb.Horizontal(
            rrb.Spatial3DView(origin="world", name="world", contents=in_space),
            rrb.Vertical(
                rrb.Spatial2DView(origin=_LEFT, name="left image", contents=in_image), plots
            ),
        )
        self._stream.send_blueprint(rrb.Blueprint(views, collapse_panels=True))
        self._stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        legend = [
            rr.AnnotationInfo(k, name, colour) for k, (name, colour) in enumerate(_STATES.items())
        ]
        self._stream.log(_LEFT, rr.AnnotationContext(legend), static=True)
        for name, series in SERIES.items():
            self._stream.log(f"plots/{name}", rr.SeriesLines(names=list(series)), static=True)
        if camera.is_cylinder:
            strips = [
                _PICTURE.outline_baselines * camera.baseline_m * strip for strip in outline(camera)
            ]
            self._stream.log(_OUTLINE, rr.LineStrips3D(strips, colors=_STATES["used"]), static=True)
            return
        scale = self._scale
        size = scale * np.array(_size(camera))
        focal = scale * np.array([camera.fu, camera.fv])
        centre = self._pixels(np.array([camera.cu, camera.cv]))
        self._stream.log(
            _LEFT,
            rr.Pinhole(focal_length=focal, principal_point=centre, resolution=size),
            static=True,
        )

    def _start(self, T_world_body: FloatArray) -> FloatArray:
        """Set the upright frame from the first pose, and draw the reference from there; return
        `T_view_world`.
        """
        import rerun as rr

        view = upright_view(T_world_body[None], self._rig.T_cam0_body, self._rig.motion)
        self._stream.log(
            "world/run", rr.Transform3D(translation=view[:3, 3], mat3x3=view[:3, :3]), static=True
        )
        return view

    def _pose(self, estimate: Estimate) -> None:
        import rerun as rr

        T = estimate.T_world_imu
        if self._T_view_world is None:
            self._T_view_world = self._start(T)
            self._reference(estimate)
        T_world_cam0 = T @ se3_inverse(self._rig.T_cam0_body)
        send = self._stream.log
        send(_LEFT, rr.Transform3D(translation=T_world_cam0[:3, 3], mat3x3=T_world_cam0[:3, :3]))
        self._path.append(T[:3, 3])
        path = rr.LineStrips3D([self._path], colors=_STATES["used"], radii=rr.Radius.ui_points(1.5))
        send(f"world/run/path/{self._chunks:05d}", path)
        if len(self._path) >= _PICTURE.chunk:
            self._path = self._path[-1:]
            self._chunks = self._chunks + 1
        values, axes = np.linalg.eigh(rotated(T[:3, :3], estimate.covariance[:3, :3]))
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        send("world/run/sigma", rr.Transform3D(translation=T[:3, 3], mat3x3=axes))
        sizes = _PICTURE.sigmas * np.sqrt(np.maximum(values, 0.0))
        send(
            "world/run/sigma",
            rr.Ellipsoids3D(half_sizes=[sizes], centers=[[0, 0, 0]], colors=[_STATES["landmark"]]),
        )

    def _reference(self, first: Estimate) -> None:
        """Draw the reference so that it agrees with the first pose."""
        import rerun as rr

        truth = self._rig.reference
        if truth is None:
            return
        own = (
            "imu"
            if self._rig.motion == "imu" or not np.array_equal(self._rig.T_cam0_body, np.eye(4))
            else "cam0"
        )
        poses = (
            truth.in_imu(self._rig.T_cam0_body)
            if own == "imu"
            else truth.in_cam0(self._rig.T_cam0_body)
        )
        near = (
            0 if truth.times_ns is None else int(np.argmin(np.abs(truth.times_ns - first.time_ns)))
        )
        T = first.T_world_imu @ se3_inverse(poses.T_world_body[near])
        line = rr.LineStrips3D([transform_points(T, poses.positions)], colors=(120, 120, 120))
        self._stream.log("world/run/reference", line, static=True)

    def _numbers(self, estimate: Estimate, numbers: Mapping[str, Sequence[float | None]]) -> None:
        import rerun as rr

        view = self._T_view_world
        assert view is not None
        known = dict(numbers)
        if estimate.velocity_world is not None:
            known["velocity"] = (view[:3, :3] @ estimate.velocity_world).tolist()
        if self._rig.motion == "imu":
            biases = {"gyro_bias": estimate.gyro_bias, "accel_bias": estimate.accel_bias}
            known |= {name: b.tolist() for name, b in biases.items() if b is not None}
        if estimate.stereo_field is not None:
            known["stereo_calibration"] = (
                self._rig.camera.fu * estimate.stereo_field.coefficients[:3]
            ).tolist()
        for name, values in known.items():
            plain = np.array(values, dtype=np.float64)  # None is NaN
            if np.isfinite(plain).any():
                self._stream.log(f"plots/{name}", rr.Scalars(plain))

    def _follow(self, seen: Observations) -> None:
        """Note where features were, for their tails and ages."""
        tails: dict[int, list[FloatArray]] = {}
        for name, pixel in zip(seen.ids.tolist(), seen.z[:, :2], strict=True):
            tails[name] = [*self._tails.get(name, [])[1 - _PICTURE.tail :], pixel]
        self._ages = {name: self._ages.get(name, -1) + 1 for name in tails}
        self._tails = tails

    def _image(self, image: Image) -> None:
        import cv2
        import rerun as rr

        shown: Any = image
        if self._scale < 1:
            shown = cv2.resize(
                image, None, fx=self._scale, fy=self._scale, interpolation=cv2.INTER_AREA
            )
        good, data = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, _PICTURE.jpeg_quality])
        if good:
            self._stream.log(
                f"{_LEFT}/image", rr.EncodedImage(contents=data.tobytes(), media_type="image/jpeg")
            )

    def _tracks(self, seen: Observations, states: IntArray) -> None:
        import rerun as rr

        pixels = self._pixels(seen.z[:, :2])
        self._stream.log(
            f"{_LEFT}/features", rr.Points2D(pixels, class_ids=states, radii=rr.Radius.ui_points(3))
        )
        tails = [self._tails[name] for name in seen.ids.tolist()]
        long = [k for k, tail in enumerate(tails) if len(tail) > 1]
        ages = np.array([self._ages[name] for name in seen.ids[long].tolist()])
        strips = rr.LineStrips2D(
            [self._pixels(np.array(tails[k])) for k in long], colors=age_colours(ages)
        )
        self._stream.log(f"{_LEFT}/tracks_by_age", strips)

    def _pixels(self, pixels: FloatArray) -> FloatArray:
        """Return pixels (..., 2) of the shown image; rerun counts from the first one's corner,
        we from its centre.
        """
        return self._scale * (pixels + 0.5)

    def _points(self, seen: Observations, estimate: Estimate) -> None:
        """Draw the features of this frame where their stereo views see them."""
        import rerun as rr

        camera = self._rig.camera
        z = seen.z
        near = seen.has_right & (z[:, 0] - z[:, 2] > _PICTURE.min_disparity_px)
        depth = camera.fu * camera.baseline_m / (z[near, 0] - z[near, 2])
        p_cam = left_rays(camera, z[near, :2]) * depth[:, None]
        T_world_cam0 = estimate.T_world_imu @ se3_inverse(self._rig.T_cam0_body)
        points = rr.Points3D(transform_points(T_world_cam0, p_cam), radii=rr.Radius.ui_points(2))
        self._stream.log("world/run/points_of_this_frame", points)


def _size(camera: StereoCamera) -> tuple[float, float]:
    """Return width and height of the left image, pixels; of features alone, what the principal
    point suggests.
    """
    return camera.width or 2 * camera.cu, camera.height or 2 * camera.cv


def outline(camera: StereoCamera) -> list[FloatArray]:
    """Return lines (N, 3) in the cam0 frame: the left image's border at depth 1, and from the
    camera to its corners.

    The border of a pinhole is a plane rectangle, that of a cylinder lies on the cylinder about the
    baseline.
    """
    width, height = _size(camera)
    corners = (
        np.array(
            [
                [0, 0],
                [width, 0],
                [width, height],
                [0, height],
                [0, 0],
            ]
        )
        - 0.5
    )
    share = np.linspace(0, 1, _PICTURE.side)[:, None]
    border = np.concatenate([a + share * (b - a) for a, b in pairwise(corners)])
    return [
        left_rays(camera, border),
        *(np.stack([np.zeros(3), ray]) for ray in left_rays(camera, corners[:4])),
    ]


def states_of(seen: Observations, chosen: BoolArray, report: UpdateReport) -> IntArray:
    """Return the state (N,) of each feature as a number of `_STATES`: what the filter made of
    it.
    """
    names = list(_STATES)
    out = np.where(seen.has_right, names.index("stereo, not used"), names.index("left only"))
    out[chosen] = names.index("used")
    out[np.isin(seen.ids, report.landmark_ids)] = names.index("landmark")
    out[np.isin(seen.ids, report.gated_ids)] = names.index("gated")
    return np.asarray(out, dtype=np.int64)


def age_colours(ages: IntArray) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return colours (N, 3) of ages (N,) in frames, from yellow for new tracks to blue for old
    ones.
    """
    share: FloatArray = np.clip(np.asarray(ages, dtype=np.float64) / _PICTURE.old_frames, 0, 1)[
        :, None
    ]
    new = np.array([255.0, 214.0, 10.0])
    old = np.array([20.0, 60.0, 200.0])
    colours = np.round(new + share * (old - new))
    return np.asarray(colours, dtype=np.uint8)
