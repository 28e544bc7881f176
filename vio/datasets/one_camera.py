"""Recordings of one camera: a folder of images with an IMU (`mono`), or with depth images (`rgbd`).

`mono` is a plain folder with one image folder (`left`, `cam0`, `image_0`, …) or an EuRoC folder with cam0 alone.
`rgbd` is the layout of TUM RGB-D (`rgb/`, `depth/`, `rgb.txt`, `depth.txt`, associated by their stamps), or a plain
folder with an image folder and `depth/`, whose files are named alike. Depth images have 16 bits, 0 being unknown, and
show what the images show, pixel by pixel.
Reference: Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS (2012), and its site.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from vio.cameras.camera_rig import CameraRig, Undistorter
from vio.datasets.common import blank_frames, chosen_frames, merge_events, naming
from vio.datasets.companions import calibration_beside, read_motion, read_reference, sources_of, with_extrinsics
from vio.datasets.image_files import FilePairs
from vio.datasets.image_pairs import BadFrame, ImageSize, first_readable, full_scale, readable_frames
from vio.datasets.images import SUFFIXES, UnreadableImageError, list_images, load_depth, load_gray
from vio.datasets.plain import frame_times
from vio.datasets.rigs.one_camera import load_camera
from vio.datasets.settings import DatasetSettings
from vio.datasets.tables import parse_stamps
from vio.datasets.unused import Layout, unused_note
from vio.errors import CalibrationError, DataError
from vio.files.text import text_lines
from vio.geometry.distortion import CameraModel
from vio.records import Event, ImuDensities, IntArray, MotionSample, Observations, Recording, StereoFrame

_FOLDERS = ("left", "Left", "cam0", "image_0", "image_00", "image", "images", "rgb", "color", "mono")
_INSIDE = ("data", "images", "")
_TUM_LISTS = ("rgb.txt", "depth.txt")
_TUM_FACTOR = 5000.0  # levels per metre of TUM's depth images
_ASSOCIATED_NS = 20_000_000  # as TUM's own tool associates colour and depth, which have exposures of their own
# Intrinsics and radial-tangential distortion that TUM publishes for its three cameras, whose sequences have no file of
# them, and ROS's default for others.
_TUM_CAMERAS = {
    "freiburg1": (517.306408, 516.469215, 318.643040, 255.313989, 0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    "freiburg2": (520.908620, 521.007327, 325.141442, 249.701764, 0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
    "default": (525.0, 525.0, 319.5, 239.5),
}


@dataclass(frozen=True, slots=True)
class OneCameraDataset:
    """Implements `vio.protocols.Dataset` over the image files of one camera, with depth images or without."""

    recording: Recording
    files: Sequence[Path]
    depth_files: Sequence[Path] | None  # None: there are none
    motion: Sequence[MotionSample] = field(repr=False)  # in time order
    size: ImageSize
    settings: DatasetSettings
    undistorter: Undistorter
    white: int  # level of white of 16-bit images
    depth_factor: float  # levels of a depth image per metre
    imu_noise: ImuDensities | None = None

    def events(self, start: int = 0, stop: int | None = None, *, images: bool = True) -> Iterator[Event]:
        """Yield events of the frames `start <= index < stop` in time order; see `vio.protocols.Dataset`.

        Raises:
            DataError: the range holds no frame, or none that can be used, or more are unusable than the settings allow.
        """
        chosen = chosen_frames(self.recording, start, stop, self.settings.max_frame_rate)
        frames = readable_frames(self._load, chosen, self.settings) if images else blank_frames(self.recording, chosen)
        return merge_events(self.recording, chosen, self.motion, frames)

    def observations(self, index: int) -> Observations | None:
        """Return None: the recording holds images only."""
        return None

    def _load(self, index: int) -> StereoFrame | BadFrame:
        """Read one frame; runs in the prefetch thread."""
        depth = None
        try:
            image = load_gray(self.files[index], self.white)[0]
            self.size.check(image, self.files[index])
            if self.depth_files is not None:
                levels = load_depth(self.depth_files[index])
                if levels.shape != image.shape:
                    raise UnreadableImageError(
                        f"{self.depth_files[index]} is {levels.shape[1]} x {levels.shape[0]} pixels, but its image is "
                        f"{image.shape[1]} x {image.shape[0]}; depth images must be registered to the images"
                    )
                depth = self.undistorter.depth(levels / self.depth_factor)
        except UnreadableImageError as error:
            return BadFrame(index, str(error))
        time_ns = int(self.recording.frame_times_ns[index])
        return StereoFrame(index, time_ns, self.undistorter(image), None, depth)


def images_of_one_camera(path: Path) -> Path | None:
    """Return the folder of images that a folder holds, whether or not anything else identifies them."""
    layout = _layout(path)
    return None if layout is None else layout.left


def is_mono_folder(path: Path) -> bool:
    """Return whether a folder holds the images of one camera, and a calibration or an IMU identifies them."""
    layout = _layout(path)
    return layout is not None and calibration_beside(layout) is not None


def is_rgbd_folder(path: Path) -> bool:
    """Return whether a folder holds images and depth images."""
    if all((path / name).is_file() for name in _TUM_LISTS):
        return True
    layout = _layout(path)
    return layout is not None and _holds_images(layout.base / "depth")


def _layout(path: Path) -> Layout | None:
    for base in (path, path / "mav0"):
        for name in _FOLDERS:
            for inside in _INSIDE:
                if _holds_images(folder := base / name / inside):
                    return Layout(path, base, folder, folder)
    return None


def _holds_images(folder: Path) -> bool:
    return folder.is_dir() and any(child.suffix.lower() in SUFFIXES for child in folder.iterdir())


def read_mono(path: Path, settings: DatasetSettings) -> OneCameraDataset:
    """Read the folder of one camera.

    Raises:
        DataError: images, times or samples cannot be used; the message names file and remedy.
        CalibrationError: there is no calibration, or it is invalid.
    """
    layout = _layout(path)
    if layout is None:
        raise DataError(f"{path}: holds no folder of images ({', '.join(_FOLDERS[:4])} or others); give one with left/")
    files = list_images(layout.left)
    pairs = FilePairs(files, files)
    times_ns, times_file, notes = frame_times(layout, pairs)
    frames = _Frames(files, None, times_ns, times_file, notes)
    return _read(layout, frames, settings, "mono")


def read_rgbd(path: Path, settings: DatasetSettings) -> OneCameraDataset:
    """Read a folder of images and depth images.

    Raises:
        DataError: images, times or samples cannot be used; the message names file and remedy.
        CalibrationError: there is no calibration, it is invalid, or the unit of the depths is not given.
    """
    if all((path / name).is_file() for name in _TUM_LISTS):
        frames = _tum_frames(path)
        return _read(Layout(path, path, frames.files[0].parent, frames.files[0].parent), frames, settings, "rgbd")
    layout = _layout(path)
    if layout is None or not _holds_images(layout.base / "depth"):
        raise DataError(f"{path}: holds no images beside depth/; give rgb.txt and depth.txt, or left/ and depth/")
    images, depth_images = list_images(layout.left), list_images(layout.base / "depth")
    depths = {file.stem: k for k, file in enumerate(depth_images)}
    files = images.take(k for k, file in enumerate(images) if file.stem in depths)
    if not files:
        raise DataError(f"{layout.base / 'depth'}: no file is named as one of {layout.left}; name them alike")
    times_ns, times_file, notes = frame_times(layout, FilePairs(files, files))
    frames = _Frames(files, depth_images.take(depths[file.stem] for file in files), times_ns, times_file, notes)
    return _read(layout, frames, settings, "rgbd")


@dataclass(frozen=True, slots=True)
class _Frames:
    """Files and times of the frames."""

    files: Sequence[Path]
    depths: Sequence[Path] | None
    times_ns: IntArray
    times_file: Path | None  # where the times are from; None: assumed
    notes: tuple[str, ...]


def _tum_frames(path: Path) -> _Frames:
    """Associate the images and depth images of TUM RGB-D by their stamps, each image with the nearest depth."""
    (times_ns, files), (depth_ns, depths) = (_tum_list(path / name) for name in _TUM_LISTS)
    after = np.clip(np.searchsorted(depth_ns, times_ns), 1, max(len(depth_ns) - 1, 1))
    before = np.maximum(after - 1, 0)
    after = np.minimum(after, len(depth_ns) - 1)
    nearest = np.where(np.abs(depth_ns[after] - times_ns) < np.abs(times_ns - depth_ns[before]), after, before)
    near = np.abs(depth_ns[nearest] - times_ns) <= _ASSOCIATED_NS
    if not near.any():
        raise DataError(
            f"{path / 'depth.txt'}: no depth is within {_ASSOCIATED_NS / 1e6:g} ms of an image of rgb.txt; both must "
            "use one clock"
        )
    alone = int((~near).sum())
    notes = (f"{alone} images have no depth within {_ASSOCIATED_NS / 1e6:g} ms and are skipped",) if alone else ()
    rows = np.flatnonzero(near)
    chosen = tuple(files[k] for k in rows), tuple(depths[k] for k in nearest[rows])
    return _Frames(*chosen, times_ns[near], path / "rgb.txt", notes)


def _tum_list(file: Path) -> tuple[IntArray, list[Path]]:
    """Read the stamps (N,) and files of a list of TUM RGB-D."""
    rows = [(n, line.split()) for n, line in text_lines(file) if line.strip() and not line.startswith("#")]
    wrong = next((n for n, fields in rows if len(fields) != 2), None)
    if wrong is not None or not rows:
        raise DataError(f"{file}, line {wrong or 1}: expected lines 'time file'; copy it again")
    times_ns = parse_stamps([fields[0] for _, fields in rows], lambda k: f"{file}, line {rows[k][0]}", "s")
    return times_ns, [file.parent / fields[1] for _, fields in rows]


def _read(layout: Layout, frames: _Frames, settings: DatasetSettings, kind: str) -> OneCameraDataset:
    pairs = FilePairs(frames.files, frames.files)
    _, image, _ = first_readable(pairs)
    white, white_notes = full_scale(pairs)
    file, rig = _calibration(layout, settings, (image.shape[1], image.shape[0]), tum=frames.times_file)
    rig, used = with_extrinsics(rig, layout, file)
    motion, motion_files, motion_notes = read_motion(layout, rig, frames.times_ns, frames.times_file is not None)
    with_depth = frames.depths is not None
    with naming(file):
        undistorter = rig.undistorter(settings.interpolation, depth_noise=settings.depth_noise if with_depth else None)
    factor, factor_notes = _depth_factor(rig, settings, layout.root) if with_depth else (1.0, ())
    reference, reference_file = read_reference(layout, rig, undistorter, frames.times_ns)
    sources = [file, frames.times_file, *used, *motion_files, reference_file]
    if frames.times_file == layout.left:  # EuRoC's list repeats the times that the images are named by
        sources.append(layout.left.parent / "data.csv")
    if with_depth:
        sources += [layout.base / "depth", *(layout.root / name for name in _TUM_LISTS)]
    unused = unused_note(layout, [s for s in sources if s is not None])
    notes = (*frames.notes, *white_notes, *rig.notes, *factor_notes, *motion_notes, *unused)
    recording = Recording(
        kind=kind,
        path=layout.root,
        camera=undistorter.camera,
        T_cam0_imu=rig.T_cam0_imu if motion_files else None,
        frame_times_ns=frames.times_ns,
        has_images=True,
        motion=sources_of(motion_files),
        reference=reference,
        notes=notes,
    )
    size = ImageSize(rig.cam0.width, rig.cam0.height, file)
    return OneCameraDataset(
        recording, frames.files, frames.depths, motion, size, settings, undistorter, white, factor, rig.imu_noise
    )


def _calibration(
    layout: Layout, settings: DatasetSettings, size: tuple[int, int], *, tum: Path | None
) -> tuple[Path, CameraRig]:
    """Return the calibration and its file; TUM RGB-D has none; its folder's name identifies the camera.

    Raises:
        CalibrationError: there is none.
    """
    file = settings.calibration or calibration_beside(layout)
    if file is not None:
        return file, load_camera(file, image_size=size)
    if tum is None or tum.name != _TUM_LISTS[0]:
        raise CalibrationError(
            f"{layout.root}: no calibration; add one as calibration.yaml (Kalibr's camchain with cam0), or name it "
            "with --calibration FILE"
        )
    name = next((name for name in _TUM_CAMERAS if name in layout.root.absolute().name), "default")
    fu, fv, cu, cv, *bend = _TUM_CAMERAS[name]
    note = f"{layout.root}: no calibration; that of TUM's camera {name!r} is taken (give another with --calibration)"
    model = CameraModel(fu, fv, cu, cv, *size, "radtan" if bend else "pinhole", tuple(bend))
    return tum, CameraRig(model, notes=(note,), depth_factor=_TUM_FACTOR)


def _depth_factor(rig: CameraRig, settings: DatasetSettings, where: Path) -> tuple[float, tuple[str, ...]]:
    """Return the levels per metre of depth images, and a note where setting and calibration differ.

    Raises:
        CalibrationError: nothing states them.
    """
    factor = settings.depth_factor or rig.depth_factor
    if factor is None:
        raise CalibrationError(
            f"{where}: the unit of its depth images is not given; add depth_factor (levels per metre, 1000 for "
            "millimetres) to cam0 of the calibration, or --set dataset.depth_factor=1000"
        )
    if settings.depth_factor is None or rig.depth_factor in (None, factor):
        return factor, ()
    return factor, (f"dataset.depth_factor {factor:g} takes the place of the calibration's {rig.depth_factor:g}",)
