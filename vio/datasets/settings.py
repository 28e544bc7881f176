"""Settings of the readers."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal, TypeAlias

from vio.dataclass import dataclass
from vio.geometry.rectify import Interpolation, ProjectionMode
from vio.setting import Section, setting

ExtrinsicsMode: TypeAlias = Literal["auto", "literal", "corrected"]
RepeatsMode: TypeAlias = Literal["auto", "split", "flag", "literal"]


@dataclass(frozen=True, slots=True)
class DatasetSettings(Section):
    """How recordings are read."""

    section: ClassVar[str] = "dataset"

    colour: bool | None = setting(
        None,
        "KITTI folders: use image_2/image_3 (true) or image_0/image_1 (false); null: gray where "
        "there is any",
    )
    extrinsics: ExtrinsicsMode = setting(
        "auto",
        "ECE276A files: the translation of cam_T_imu as stored (literal), read as the camera's "
        "position in the "
        "IMU frame (corrected), or whichever the file's own velocities and features support (auto)",
    )
    repeated_tracks: RepeatsMode = setting(
        "auto",
        "feature files, rows that repeat old pixels while the vehicle moves: mark them stale and "
        "give the track a new "
        "id from there on (split), mark them and keep the id (flag), use them as they are "
        "(literal), or decide by the "
        "motion of the pixels afterwards whether the track switched to another point (auto: split "
        "if so, else flag)",
    )
    calibration: Path | None = setting(
        None,
        "plain folders, bags and videos: the calibration file, in the place of the recording's own",
    )
    folders: str | None = setting(
        None,
        "folders of images: those of the left and the right camera within the recording, such as "
        "img_l,img_r, in the place of those found by their names",
    )
    camera: Literal["both", "left"] = setting(
        "both",
        "stereo recordings: use both cameras, or the left one alone, which needs an IMU for the "
        "scale",
    )
    depth_factor: float | None = setting(
        None,
        "depth images: levels per metre; null: the calibration's, or 5000 for TUM RGB-D",
        above=0,
    )
    depth_noise: float = setting(
        1.5e-3,
        "depth images: k of a depth's standard deviation k depth^2; structured light has 0.0012 to "
        "0.0019",
        unit="1/m",
        above=0,
    )
    topics: str | None = setting(
        None,
        "bags: topics by name, such as left=/a,right=/b,imu=/c, in the place of those found by "
        "type",
    )
    interpolation: Interpolation = setting(
        "linear",
        "unrectified images: how gray values between pixels are interpolated in rectifying (cubic "
        "and lanczos4 cost 5 "
        "and 15 times as much for barely better tracks)",
    )
    projection: ProjectionMode = setting(
        "auto",
        "unrectified images: rectify to the image of a pinhole, or to a cylinder about the "
        "baseline, which keeps what "
        "a wide lens sees above and below; auto: a cylinder where a pinhole would crop there, "
        "beyond 54 degrees",
    )
    max_bad_frames: int | None = setting(
        None,
        "image folders: stereo frames with unreadable images or images of another size that are "
        "skipped before the "
        "reader stops with an error; null: all but the last usable one",
        at_least=0,
    )
    max_frame_rate: float | None = setting(
        None,
        "frames that come sooner are left out, unread where images are files, so that a slow "
        "computer follows a fast "
        "camera; a tenth of an interval does not count; null: all are used",
        unit="Hz",
        above=0,
    )
    prefetch_frames: int = setting(
        4,
        "image folders: stereo frames decoded ahead in a thread; 0: no thread",
        at_least=0,
        at_most=1000,
    )

    @property
    def cameras(self) -> int:
        """How many images of a stereo frame are decoded."""
        return 1 if self.camera == "left" else 2
