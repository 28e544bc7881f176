"""A recording with its calibration as given, without any correction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from vio.cameras.rig import Rig
from vio.datasets import DatasetSettings, open_dataset
from vio.datasets.euroc_files import read_camera_yaml
from vio.datasets.features import FeatureDataset
from vio.datasets.image_pairs import ImageDataset, pair_images
from vio.datasets.rigs.kalibr import kalibr_text
from vio.errors import CalibrationError
from vio.geometry.distortion import StereoRig, rig_from_rectified
from vio.geometry.lie import FloatArray, se3_inverse
from vio.geometry.rectify import rectifying_rotations
from vio.protocols import Dataset, Frontend
from vio.records import (
    FeatureTracks,
    MotionSample,
    Observations,
    StereoFrame,
    feature_tracks,
    need_stereo,
)


@dataclass(frozen=True, slots=True)
class CalibrationSource:
    """The data to measure a calibration from."""

    path: Path
    rig: StereoRig | None  # as calibrated; None: features without an image size
    # image files, unrectified where the cameras are; empty: features only
    raw_pairs: Sequence[tuple[Path, Path]]
    dataset: Dataset | None  # None: images cannot be rectified with this calibration
    rejection: str | None  # the reader's error, if the images cannot be rectified

    @property
    def T_cam0_cam1(self) -> FloatArray:
        """The given pose (4, 4) of cam1 in cam0."""
        if self.rig is not None:
            return self.rig.T_cam0_cam1
        assert self.dataset is not None
        out = np.eye(4)
        out[0, 3] = self.dataset.recording.camera.baseline_m
        return out

    def rectifying(self) -> tuple[FloatArray, FloatArray] | None:
        """Return the rotations (3, 3) from raw to rectified cameras.

        None: already rectified, or not possible.
        """
        if not isinstance(self.dataset, ImageDataset) or self.dataset.rectifier.maps is None:
            return None
        return rectifying_rotations(self.dataset.rectifier.rig)[:2]

    def with_right(self, T_cam1_cam0: FloatArray) -> CalibrationSource | None:
        """Return the data with another pose (4, 4) of the right camera; None: they are no image
        files that can be rectified.
        """
        if self.rig is None or not self.raw_pairs or self.dataset is None:
            return None
        recording = self.dataset.recording
        T_cam0_imu = se3_inverse(self.rig.T_imu_cam0)
        rig = Rig(self.rig.cam0, self.rig.cam1, T_cam1_cam0, T_cam0_imu)
        with TemporaryDirectory() as folder:
            file = Path(folder, "camchain.yaml")
            file.write_text(kalibr_text(rig), encoding="utf-8")
            return open_source(f"{recording.kind}:{recording.path}", file)

    def image_size(self, z: FloatArray) -> tuple[float, float]:
        """Return width and height in pixels; where unknown, the extent of rectified pixels (N,
        4).
        """
        if self.dataset is None:
            camera = None
        else:
            camera = self.dataset.recording.camera
        if camera is not None and camera.width is not None and camera.height is not None:
            return float(camera.width), float(camera.height)
        if len(z):
            return (float(z[:, 0].max()) + 1, float(z[:, 1].max()) + 1)
        return (1.0, 1.0)


def open_source(text: str, calibration: Path | None = None) -> CalibrationSource:
    """Open a recording with its calibration unchanged, or that of a file, even if it cannot be
    rectified with it.

    Raises:
        DataError: no known recording, or it cannot be read.
        CalibrationError: the calibration is invalid, and the recording is not in EuRoC format.
    """
    try:
        settings = DatasetSettings(
            extrinsics="literal", projection="pinhole", calibration=calibration
        )
        dataset = open_dataset(text, settings)
    except CalibrationError as error:
        found = _raw_euroc(Path(text.removeprefix("euroc:")), str(error))
        if found is None:
            raise
        return found
    recording = dataset.recording
    need_stereo(recording, "a calibration of cameras")
    if isinstance(dataset, ImageDataset) and not dataset.side_by_side:
        return CalibrationSource(
            recording.path, dataset.rectifier.rig, dataset.pairs, dataset, None
        )
    known = recording.camera.width is not None
    rig = rig_from_rectified(recording.camera, recording.T_cam0_body) if known else None
    return CalibrationSource(recording.path, rig, (), dataset, None)


def _raw_euroc(path: Path, rejection: str) -> CalibrationSource | None:
    """Return rig and raw images of an EuRoC folder whose cameras cannot be rectified.

    None: another format.
    """
    if (path / "mav0").is_dir():
        mav = path / "mav0"
    else:
        mav = path
    if not all(
        (mav / name / "sensor.yaml").is_file() and (mav / name / "data").is_dir()
        for name in ("cam0", "cam1")
    ):
        return None
    (cam0, T0), (cam1, T1) = (
        read_camera_yaml(mav / name / "sensor.yaml") for name in ("cam0", "cam1")
    )
    pairs = pair_images(mav / "cam0" / "data", mav / "cam1" / "data")
    return CalibrationSource(path, StereoRig(cam0, cam1, T0, T1), pairs, None, rejection)


def track(
    dataset: Dataset,
    build_frontend: Callable[[Dataset], Frontend],
    frames: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[FeatureTracks, Sequence[MotionSample]]:
    """Return stereo tracks of the first frames, from the file or by a front end, and the motion
    samples.

    Args:
        dataset: the recording.
        build_frontend: makes the front end if the recording contains images.
        frames: largest number of frames to track.
        progress: called with (done, total) after each of them.

    Raises:
        DataError: the images cannot be read.
    """
    if isinstance(dataset, FeatureDataset):
        return dataset.tracks, dataset.motion
    count = len(dataset.recording.frame_times_ns)
    total = min(frames, count)
    front = build_frontend(dataset)
    seen: dict[int, Observations] = {}
    samples: list[MotionSample] = []
    for event in dataset.events(0, total):
        if isinstance(event, StereoFrame):
            seen[event.index] = front.process(event).observations
            progress(len(seen), total)
        else:
            samples.append(event)
    return feature_tracks(seen, count), tuple(samples)
