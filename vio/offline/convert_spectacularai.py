"""Write a recording as Spectacular AI's SDK replays it: `data.jsonl`, `calibration.json`,
`vio_config.yaml`, and a video without loss for each camera.

Times are seconds from the first event. `imuToCamera` maps points of the IMU to the camera. The
images are rectified, so that the cameras are pinholes without distortion.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vio.errors import DataError
from vio.files.text import seconds_text, write_text
from vio.geometry.lie import FloatArray, se3_from_parts
from vio.protocols import Dataset, Progress
from vio.records import NS_PER_S, Image, ImuSample, Recording, StereoFrame

DATA = "data.jsonl"
CALIBRATION = "calibration.json"
CONFIG = "vio_config.yaml"
VIDEOS = ("data.avi", "data2.avi")  # left and right, as the SDK looks for them
_CODEC = "FFV1"
# What `sai-cli process` sets for a recording. A folder without it is replayed with the bare
# defaults of the estimator, which no wrapper of the SDK uses: on EuRoC MH_01, 0.024 m for 0.013 m.
_SETTINGS = """\
parameterSets: ["wrapper-base", "offline-base"]
useSlam: true
maxKeypoints: 1000
optimizerMaxIterations: 30
"""


def _check_imu(recording: Recording) -> None:
    if "imu" not in recording.motion or recording.T_cam0_imu is None:
        raise DataError(
            f"{recording.path}: the SDK of Spectacular AI needs an IMU, with its pose in the left "
            "camera; choose another form"
        )


def _add_images(videos: list[_Video], frame: StereoFrame) -> None:
    for video, image in zip(videos, (frame.left, frame.right), strict=True):
        assert image is not None
        video.add(image)


def write_spectacularai(
    dataset: Dataset, out: Path, start: int, stop: int | None, progress: Progress
) -> tuple[int, int, int]:
    """Write a range of a recording into an existing, empty folder.

    Args:
        dataset: of stereo images with an IMU.
        out: the folder.
        start: first frame.
        stop: frame after the last one; None: to the end.
        progress: called after each frame.

    Returns:
        The number of frames, that of IMU samples, and the time in nanoseconds from which times
        count.

    Raises:
        DataError: the recording has no IMU, or OpenCV cannot write the videos.
    """
    recording = dataset.recording
    _check_imu(recording)
    times = recording.frame_times_ns[start:stop]
    rate_hz = 1.0
    if len(times) > 1:
        rate_hz = NS_PER_S / float(np.median(np.diff(times)))
    videos = [_Video(out / name, rate_hz) for name in VIDEOS]
    lines: list[str] = []
    origin_ns: int | None = None
    frames = 0
    samples = 0
    try:
        for event in dataset.events(start, stop):
            if origin_ns is None:
                origin_ns = event.time_ns
            time_s = seconds_text(event.time_ns - origin_ns)
            if isinstance(event, ImuSample):
                samples += 1
                lines += _imu_lines(event, time_s)
            elif isinstance(event, StereoFrame):
                _add_images(videos, event)
                lines.append(_frame_line(frames, time_s))
                frames += 1
                progress(frames, len(times))
    finally:
        for video in videos:
            video.close()
    write_text(out / DATA, "\n".join([*lines, ""]))
    text = json.dumps(calibration(recording), indent=2)
    write_text(out / CALIBRATION, text + "\n")
    write_text(out / CONFIG, _SETTINGS)
    return frames, samples, origin_ns or 0


def calibration(recording: Recording) -> dict[str, Any]:
    """Return `calibration.json` of a rectified pair with an IMU."""
    camera = recording.camera
    assert recording.T_cam0_imu is not None
    T_cam1_cam0 = se3_from_parts(np.eye(3), [-camera.baseline_m, 0.0, 0.0])
    poses = (recording.T_cam0_imu, T_cam1_cam0 @ recording.T_cam0_imu)
    shared = {
        "model": "pinhole",
        "focalLengthX": camera.fu,
        "focalLengthY": camera.fv,
        "principalPointX": camera.cu,
        "principalPointY": camera.cv,
        "imageWidth": camera.width,
        "imageHeight": camera.height,
    }
    return {"cameras": [{**shared, "imuToCamera": T.tolist()} for T in poses]}


class _Video:
    """A video of gray images without loss, opened with the first of them."""

    def __init__(self, path: Path, rate_hz: float) -> None:
        self._path = path
        self._rate_hz = rate_hz
        self._writer: cv2.VideoWriter | None = None

    def add(self, image: Image) -> None:
        if self._writer is None:
            size = (image.shape[1], image.shape[0])
            codec = cv2.VideoWriter.fourcc(*_CODEC)
            self._writer = cv2.VideoWriter(str(self._path), codec, self._rate_hz, size)
            if not self._writer.isOpened():
                raise DataError(
                    f"{self._path}: OpenCV cannot write a video of {_CODEC}; install "
                    "opencv-python-headless from PyPI, which brings FFmpeg"
                )
        self._writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))

    def close(self) -> None:
        if self._writer is not None:
            self._writer.release()


def _imu_lines(sample: ImuSample, time_s: str) -> list[str]:
    return [
        _sensor_line("gyroscope", sample.gyro, time_s),
        _sensor_line("accelerometer", sample.accel, time_s),
    ]


def _sensor_line(kind: str, values: FloatArray, time_s: str) -> str:
    shown = json.dumps(values.tolist())
    return f'{{"sensor": {{"type": "{kind}", "values": {shown}}}, "time": {time_s}}}'


def _frame_line(number: int, time_s: str) -> str:
    cameras = ", ".join(f'{{"cameraInd": {k}, "time": {time_s}}}' for k in range(2))
    return f'{{"frames": [{cameras}], "number": {number}, "time": {time_s}}}'
